"""
Measure what docs/trust.md promises: every plugin, in every variant, for every property, as one table in JSON.

    python tests/trust/measure.py -o docs/measured/trust.json [--variants llvm_ad_rgb,llvm_ad_mono] [--quick]

A cell says "holds" or "fails" with its figure, "does not apply" or "not run" with a reason. The file is written after
each cell, so that an interrupted run leaves what it has measured. Cells of other variants and properties stay as they
are in the file, or are "not run".
"""

from __future__ import annotations

import argparse
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


def measured(mi, name: str, prop: str, effort: trust.Effort) -> dict:
    """Return a cell as JSON; an error is a failure with its sentence."""
    with tempfile.TemporaryDirectory() as folder:
        before = os.getcwd()
        os.chdir(folder)  # a failed χ² test writes its histogram
        try:
            cell = trust.PROPERTIES[prop](mi, name, effort)
        except Exception as e:
            traceback.print_exc()
            cell = trust.Cell(trust.FAILS, reason=f"{type(e).__name__}: {compat.one_sentence(e)}"[:300])
        finally:
            os.chdir(before)
    return dataclasses.asdict(cell)


def table(variants, properties, effort: trust.Effort, output: str | None, report: dict) -> dict:
    """Measure cells plugin × variant × property, and write the report after each cell."""
    set_variant(VARIANTS[0])
    names = sorted(plugins.declared())
    left_out = dataclasses.asdict(trust.Cell(trust.NOT_RUN, reason="left out of this run"))
    before = json.loads(Path(output).read_text(encoding="utf-8"))["cells"] if output and Path(output).exists() else {}

    def kept(name: str, variant: str, prop: str) -> dict:
        return before.get(name, {}).get(variant, {}).get(prop, left_out)

    cells = {name: {v: {p: kept(name, v, p) for p in trust.PROPERTIES} for v in VARIANTS} for name in names}
    report |= {"cells": cells, "complete": False}
    for variant in variants:
        mi = set_variant(variant)
        report["machine"] = report.get("machine") or machine(variant)
        for name in names:
            for prop in properties:
                cell = measured(mi, name, prop, effort)
                cells[name][variant][prop] = cell
                figure = "" if cell["figure"] is None else f" {cell['figure']:g}"
                print(f"{variant} {name} {prop}: {cell['result']}{figure} ({cell['reason']})", flush=True)
                if output:
                    write_json(output, report)
    every = [cell for by_variant in cells.values() for row in by_variant.values() for cell in row.values()]
    report["complete"] = left_out not in every
    return report


def main(arguments=None) -> int:
    """Run; the exit code is 1 if a cell fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", metavar="FILE.json", type=os.path.abspath)
    parser.add_argument("--variants", default=",".join(VARIANTS), help="names, with commas between them")
    parser.add_argument("--properties", default=",".join(trust.PROPERTIES), help="names, with commas between them")
    parser.add_argument("--quick", action="store_true", help="fewer samples; the figures are not to be quoted")
    given = parser.parse_args(arguments)
    variants, properties = given.variants.split(","), given.properties.split(",")
    for chosen, allowed in ((variants, VARIANTS), (properties, list(trust.PROPERTIES))):
        if unknown := [word for word in chosen if word not in allowed]:
            parser.error(f"found {unknown[0]!r}, allowed are {', '.join(allowed)}")
    report = {"date": datetime.date.today().isoformat(), "quick": given.quick}
    table(variants, properties, trust.QUICK if given.quick else trust.Effort(), given.output, report)
    if given.output:
        write_json(given.output, report)
    results = [c["result"] for by in report["cells"].values() for row in by.values() for c in row.values()]
    print(", ".join(f"{results.count(word)} {word}" for word in dict.fromkeys(results)))
    return int(trust.FAILS in results)


if __name__ == "__main__":
    sys.exit(main())
