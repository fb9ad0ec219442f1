"""Send hostile rays and queries through all plugins: ``python tests/trust/hostile.py --count 10000000``.

Rays go through small fields, alone and in a scene, queries to each material and texture. The report counts what was
sent, and the answers that are not finite (of densities and values: or negative).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))

import hostile_inputs
import mitsuba as mi
import plugin_examples
from limited_child import LimitedChild

import mi_diffind
from mi_diffind.core.files import write_json
from mi_diffind.measure import clock

VARIANT = "llvm_ad_rgb"


def main() -> int:
    """Send them; return 1 if an answer was not finite."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=10**5, help="rays of each field, queries of each (default: 10⁵)")
    parser.add_argument("--json", type=Path, default=Path("trust_rays.json"), help="report to write")
    arguments = parser.parse_args()
    mi.set_variant(VARIANT)
    with tempfile.TemporaryDirectory() as folder:
        hostile_inputs.write_fields(Path(folder))
        with LimitedChild(Path(folder), 7200, 7200) as child:
            answer = child.check("rays", folder=folder, count=arguments.count)
    if answer["outcome"] != "loaded":
        raise SystemExit(answer["message"])
    rays, queries = answer["fields"], {}
    print(*(f"{name}: {numbers}" for name, numbers in rays.items()), sep="\n", flush=True)
    for name in filter(hostile_inputs.is_queried, plugin_examples.names()):
        faults = hostile_inputs.faults(name, arguments.count)
        sent = len(hostile_inputs.materials(name)) * arguments.count
        queries[name] = {"queries": sent, "wrong": sum(number for number, *_ in faults.values())}
        print(f"{name}: {queries[name]} {faults or ''}", flush=True)
    wrong = sum(row["not_finite"] for row in rays.values()) + sum(row["wrong"] for row in queries.values())
    report = {
        "version": mi_diffind.__version__, "machine": clock.machine(VARIANT), "date": time.strftime("%Y-%m-%d"),
        "count": arguments.count, "wrong": wrong, "rays": rays, "queries": queries,
    }  # fmt: skip
    write_json(arguments.json, report)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
