"""Measure what docs/trust.md promises: every plugin, in every variant, for every property, as one table in JSON.

    python tests/trust/measure.py -o docs/measured/trust.json [--variants llvm_ad_rgb,llvm_ad_mono] [--quick]

A cell says "holds" or "fails" with its figure, "does not apply" or "not run" with a reason. The file is written after
each cell, so that an interrupted run leaves what it has measured. Cells of other variants stay as they are in the file,
or are "not run".
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import datetime
import json
import os
import sys
import tempfile
import traceback
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))

import trust_properties as trust
from variants import VARIANTS, set_variant

from mi_diffind import plugins
from mi_diffind.core import compat
from mi_diffind.core.files import write_json
from mi_diffind.measure.clock import machine

LEFT_OUT = dataclasses.asdict(trust.Cell(trust.NOT_RUN, reason="left out of this run"))


def measured(mi, name: str, prop: str, effort: trust.Effort) -> dict:
    """Return a cell as JSON; an error is a failure with its sentence."""
    # A failed χ² test writes its histogram
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        try:
            cell = trust.PROPERTIES[prop](mi, name, effort)
        except Exception as e:
            traceback.print_exc()
            cell = trust.Cell(trust.FAILS, reason=f"{type(e).__name__}: {compat.one_sentence(e)}"[:300])
    return dataclasses.asdict(cell)


def main() -> int:
    """Run; the exit code is 1 if a cell fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", metavar="FILE.json", type=os.path.abspath, required=True)
    parser.add_argument("--variants", default=",".join(VARIANTS), help="names, with commas between them")
    parser.add_argument("--quick", action="store_true", help="fewer samples; the figures are not to be quoted")
    given = parser.parse_args()
    variants, effort = given.variants.split(","), trust.QUICK if given.quick else trust.Effort()
    if unknown := set(variants) - set(VARIANTS):
        parser.error(f"found {unknown.pop()!r}, allowed are {', '.join(VARIANTS)}")
    before = Path(given.output)
    before = json.loads(before.read_text(encoding="utf-8"))["cells"] if before.exists() else {}
    set_variant(VARIANTS[0])
    cells = {
        name: {v: {p: before.get(name, {}).get(v, {}).get(p, LEFT_OUT) for p in trust.PROPERTIES} for v in VARIANTS}
        for name in sorted(plugins.declared())
    }
    report = {"date": datetime.date.today().isoformat(), "quick": given.quick, "cells": cells, "complete": False}
    report["machine"] = machine(variants[0])
    for variant in variants:
        mi = set_variant(variant)
        for name, by_variant in cells.items():
            for prop in trust.PROPERTIES:
                cell = by_variant[variant][prop] = measured(mi, name, prop, effort)
                print(f"{variant} {name} {prop}: {cell['result']} {cell['figure']} ({cell['reason']})", flush=True)
                write_json(given.output, report)
    every = [cell for by_variant in cells.values() for row in by_variant.values() for cell in row.values()]
    report["complete"] = LEFT_OUT not in every
    write_json(given.output, report)
    results = [cell["result"] for cell in every]
    print(", ".join(f"{results.count(word)} {word}" for word in dict.fromkeys(results)))
    return int(trust.FAILS in results)


if __name__ == "__main__":
    sys.exit(main())
