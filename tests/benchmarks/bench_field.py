"""
Measure the parts of the compression of a radiance field: each is left out or changed in turn, trained equally long.

    mi-diffind fit field out/group --preset grid -o out/group.grid.npz
    python tests/benchmarks/bench_field.py out/group --grid out/group.grid.npz --json docs/measured/bench_field.json
"""

import dataclasses
import json
import os
import time

from frame import parser, write

from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import FitRequest, tasks
from mi_diffind.tasks.radiance import PRESETS, compression, dense_bytes, files, fit
from mi_diffind.tasks.radiance.session import FieldSession

#: Name of a row → what is changed.
ROWS = {
    "ours": {},
    "values alone": {"steps": 0},
    "8 bits an index": {"bits": 8},
    "10 bits an index": {"bits": 10},
    "14 bits an index": {"bits": 14},
    "paper, 50x, values alone": {"paper": True, "steps": 0},
    "paper, 50x": {"paper": True},
}


def main() -> None:
    command = parser(__doc__)
    command.add_argument("source", metavar="FOLDER")
    command.add_argument("--grid", required=True, metavar="FILE", help="grid, made by fit field --preset grid")
    command.add_argument("--steps", type=int, default=500)
    arguments = command.parse_args()
    types = array_module("llvm")
    session = FieldSession.load(types, arguments.source)
    grid = files.grid_of(files.load(arguments.grid), types)
    dense = dense_bytes(grid.nodes.shape)
    rows = []
    for name, change in ROWS.items():
        start, steps = time.process_time(), change.get("steps", arguments.steps)
        paper, bits = change.get("paper", False), change.get("bits", compression.DEFAULT_BITS)
        preset = "paper" if paper else "sparse"
        settings = dataclasses.replace(PRESETS[preset], steps=max(1, steps), measure_every=max(1, steps))
        options = {a.name: a.default for a in tasks()["field"].arguments}
        request = FitRequest(preset, settings, types, options=options, progress=False)
        field_fit = fit.FieldFit(request, session)
        visible = field_fit.visible(grid)
        if not rows:
            rows.append({"name": "grid", **session.held_out_images.evaluate(visible.field())})
            print(json.dumps(rows[0]), flush=True)
        if paper:
            problem = field_fit.pairs_problem(visible, dense / 50, fit.VALUE_STEPS)
        else:
            weights = compression.importance(visible, session, 0)
            problem = compression.PaletteProblem(compression.palette_coding(visible, weights, None, bits, 0), session)
        if steps:
            request.train(problem)
        measured = session.held_out_images.evaluate(problem.field_of(problem.net))
        row = {"name": name, **measured, "cpu_seconds": time.process_time() - start}
        if not paper:
            row["bytes"] = compression.packed_bytes(visible, bits)
            row["compression"] = dense / row["bytes"]
        rows.append(row)
        print(json.dumps(row), flush=True)
    source = os.path.basename(arguments.source)
    write(arguments.json, {"steps": arguments.steps, "source": source, "rows": rows})


if __name__ == "__main__":
    main()
