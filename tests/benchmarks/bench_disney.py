"""
What the Disney BRDF costs in each form, beside its accuracy: run it, it only measures.

    python tests/benchmarks/bench_disney.py [--out DIR] [--quick] [--json FILE] [--variant VARIANT]

The same as ``mi-diffind tradeoff disney``.
"""

import sys

from mi_diffind.commands.cli import main

if __name__ == "__main__":
    sys.exit(main(["tradeoff", "disney", *sys.argv[1:]]))
