"""
Time of a training step of a radiance field's grid, and of its forward part alone, in this version and in another one:

    mi-diffind fit field VIEWS --preset grid --colours directions --resolution 128 -o grid.npz
    git worktree add ../before COMMIT
    python tests/benchmarks/bench_field_step.py VIEWS --grid grid.npz --against ../before --json step.json

Each version runs its own copy of this script in processes, which alternate. All train the same grid on one core, by as
many rays a step, one a pixel. Older versions draw their pixels from whole views, of which a part shows nothing;
``--anywhere`` lets this one do the same.
"""

import argparse
import dataclasses
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
from frame import ROOT, by_turns, parser, write

from mi_diffind.core import compat
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting import loop
from mi_diffind.tasks.radiance import PRESETS, files, grid, session

#: Steps before the measured ones, whose kernels are compiled then.
WARM = 5


def seconds(run) -> float:
    """Return the seconds until the result of a function is evaluated."""
    start = time.perf_counter()
    dr.eval(run())
    dr.sync_thread()
    return time.perf_counter() - start


def child(arguments) -> dict:
    """Return the median milliseconds of a step and of its forward part."""
    if arguments.anywhere:
        session.ANYWHERE = 1.0
    types = array_module("llvm")
    views = session.FieldSession.load(types, arguments.source)
    begin = files.grid_of(files.load(arguments.grid), types)
    with loop.cores(True), compat.room_for_sums(loop.LARGEST_SUMS):
        problem = grid.GridProblem(begin, views, 1)
        settings = dataclasses.replace(PRESETS["grid"], batch=arguments.rays, steps=100000)
        problem.settings = settings
        trainer = loop._Trainer(problem, settings)

        def forward():
            with dr.suspend_grad():
                return problem.loss(problem.net, dr.rng(seed=dr.opaque(types.UInt64, 0)), arguments.rays)

        times = [(seconds(trainer.take_step), seconds(forward)) for _ in range(WARM + arguments.steps)][WARM:]
    step, rest = (1e3 * statistics.median(each) for each in zip(*times, strict=True))
    return {"step_ms": step, "forward_ms": rest, "nodes": begin.nodes.count}


def main() -> None:
    command = parser(__doc__)
    command.add_argument("source", metavar="VIEWS")
    command.add_argument("--grid", required=True, metavar="FILE", help="grid, made by fit field --preset grid")
    command.add_argument("--against", type=Path, metavar="FOLDER", help="checkout of another version")
    command.add_argument("--rays", type=int, default=16384)
    command.add_argument("--steps", type=int, default=25)
    command.add_argument("--pairs", type=int, default=5)
    command.add_argument("--anywhere", action="store_true", help="pixels from whole views")
    command.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = command.parse_args()
    if arguments.child:
        print(json.dumps(child(arguments)))
        return

    def run(name: str, root: Path) -> dict:
        words = [sys.executable, root / "tests" / "benchmarks" / Path(__file__).name, *sys.argv[1:], "--child"]
        environment = {**os.environ, "PYTHONPATH": str(root)}
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{name}: {done.stderr}")
        print(name, done.stdout.splitlines()[-1], flush=True)
        return json.loads(done.stdout.splitlines()[-1])

    versions = {"this version": ROOT} | ({"before": arguments.against.resolve()} if arguments.against else {})
    records = by_turns({n: lambda n=n, root=root: run(n, root) for n, root in versions.items()}, arguments.pairs, 0)
    rows = []
    for name, values in records.items():
        step, forward = (statistics.median(v[k] for v in values) for k in ("step_ms", "forward_ms"))
        rows.append({"name": name, "step_ms": step, "forward_ms": forward, "rest_by_forward": step / forward - 1})
    if len(rows) == 2:
        ratios = [a["step_ms"] / b["step_ms"] for a, b in zip(*records.values(), strict=True)]
        rows[0] |= {"step_ratio": statistics.median(ratios), "step_ratios": [min(ratios), max(ratios)]}
    print(json.dumps(rows, indent=1))
    write(arguments.json, {"rays": arguments.rays, "nodes": records["this version"][0]["nodes"], "rows": rows})


if __name__ == "__main__":
    main()
