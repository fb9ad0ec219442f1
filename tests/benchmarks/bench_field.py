"""
What the parts of compressing a radiance field are worth, each left out or changed in turn, trained equally long:

    mi-diffind fit field out/group --preset grid -o out/group.grid.npz
    python tests/benchmarks/bench_field.py out/group --grid out/group.grid.npz --json docs/measured/bench_field.json
"""

import argparse
import dataclasses
import json
import os
import sys
import time

import numpy as np

from mi_diffind.files import write_json
from mi_diffind.runtime import array_module
from mi_diffind.task import FitRequest, tasks
from mi_diffind.tasks.radiance import compression, files, fit
from mi_diffind.tasks.radiance import grid as grids
from mi_diffind.tasks.radiance.presets import NODE_BYTES, PRESETS
from mi_diffind.tasks.radiance.training import Images, evaluate
from mi_diffind.tasks.radiance.views import load_views

#: Name of a row → what is changed.
ROWS = {
    "ours": {},
    "values alone": {"steps": 0},
    "clusters not weighted": {"weighted": False},
    "a straight curve": {"curve": 2},
    "8 bits an index": {"bits": 8},
    "10 bits an index": {"bits": 10},
    "14 bits an index": {"bits": 14},
    "paper, 50x, values alone": {"paper": True, "steps": 0},
    "paper, 50x": {"paper": True},
}


def even(largest, stored, colour):
    """In place of ``palette.importance``: all nodes count alike."""
    return np.ones(len(colour))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", metavar="FOLDER")
    parser.add_argument("--grid", required=True, metavar="FILE", help="as fit field --preset grid made it")
    parser.add_argument("--steps", type=int, default=500)
    parser.add_argument("--json", metavar="FILE")
    arguments = parser.parse_args()
    types = array_module("llvm")
    views, held = load_views(arguments.source, "train"), load_views(arguments.source, "test")
    images, tests = Images(types, views), Images(types, held)
    whole = fit.grid_of(files.load(arguments.grid), types)
    seen = grids.divided(whole, grids.visible(whole, images), 1, 0)
    dense = NODE_BYTES * int(np.prod(whole.nodes.shape))
    rows = [{"name": "grid", **evaluate(seen.field(), tests)}]
    print(json.dumps(rows[0]), flush=True)
    weigh, curve = compression.importance, compression.CURVE
    for name, change in ROWS.items():
        start, steps = time.process_time(), change.get("steps", arguments.steps)
        paper = change.get("paper", False)
        preset = "paper" if paper else "sparse"
        settings = dataclasses.replace(PRESETS[preset].settings, steps=max(1, steps), measure_every=max(1, steps))
        options = {a.name: a.default for a in tasks()["field"].arguments}
        request = FitRequest(preset, settings, types, options=options, progress=False)
        compression.CURVE = change.get("curve", curve)
        compression.importance = weigh if change.get("weighted", True) else even
        if paper:
            problem = fit.pairs_problem(seen, dense / 50, views, held, request, fit.VALUE_STEPS)
        else:
            bits = change.get("bits", compression.DEFAULT_BITS)
            problem = compression.PaletteProblem(compression.coded(seen, images, bits, 0), views, held)
        if steps:
            request.train(problem)
        field = problem.field_of(problem.net)
        row = {"name": name, **evaluate(field, tests), "cpu_seconds": time.process_time() - start}
        if not paper:
            row["bytes"] = compression.packed_bytes(seen, bits)
            row["compression"] = dense / row["bytes"]
        rows.append(row)
        print(json.dumps(row), flush=True)
    if arguments.json:
        source = os.path.basename(arguments.source)
        write_json(arguments.json, {"steps": arguments.steps, "source": source, "rows": rows})


if __name__ == "__main__":
    sys.exit(main())
