"""
Time of a training step of a radiance field's grid, and of its forward part alone, in this version and in other ones:

    mi-diffind fit field VIEWS --preset grid --colours directions --resolution 128 -o grid.npz
    git worktree add ../before COMMIT
    python tests/benchmarks/bench_field_step.py VIEWS --grid grid.npz --against ../before --json step.json

Each version runs in processes of its own, which alternate. All train the same grid on one core, by as many rays a step,
one a pixel. Older versions draw their pixels from whole views, of which a part shows nothing; ``--anywhere`` lets
this one do the same.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time

#: Steps before the measured ones, whose kernels are compiled then.
WARM = 5


def child(arguments) -> dict:
    """Return the median milliseconds of a step and of its forward part."""
    import dataclasses
    import importlib

    import drjit as dr

    from mi_diffind.core import compat
    from mi_diffind.core.runtime import array_module
    from mi_diffind.fitting import loop
    from mi_diffind.tasks.radiance import PRESETS, files, grid

    try:
        session = importlib.import_module("mi_diffind.tasks.radiance.session")
    except ImportError:
        session = importlib.import_module("mi_diffind.tasks.radiance.session")
    if arguments.anywhere:
        session.ANYWHERE = 1.0
    types = array_module("llvm")
    views = session.FieldSession.load(types, arguments.source)
    reader = files if hasattr(files, "grid_of") else importlib.import_module("mi_diffind.tasks.radiance.fit")
    begin = reader.grid_of(files.load(arguments.grid), types)
    with loop.cores(True), compat.room_for_sums(loop.LARGEST_SUMS):
        side = () if arguments.old else (1,)
        problem = grid.GridProblem(begin, views, *side)
        settings = dataclasses.replace(PRESETS["grid"].settings, batch=arguments.rays, steps=100000)
        problem.settings = settings
        trainer = loop._Trainer(problem, settings)
        steps, forwards = [], []
        for number in range(WARM + arguments.steps):
            start = time.perf_counter()
            dr.eval(trainer.take_step())
            dr.sync_thread()
            steps.append(time.perf_counter() - start)
            start = time.perf_counter()
            with dr.suspend_grad():
                loss = problem.loss(problem.net, dr.rng(seed=dr.opaque(types.UInt64, number)), arguments.rays)
                dr.eval(loss)
                dr.sync_thread()
            forwards.append(time.perf_counter() - start)
    return {
        "step_ms": 1e3 * statistics.median(steps[WARM:]), "forward_ms": 1e3 * statistics.median(forwards[WARM:]),
        "nodes": begin.nodes.count,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", metavar="VIEWS")
    parser.add_argument("--grid", required=True, metavar="FILE", help="grid, made by fit field --preset grid")
    parser.add_argument("--against", metavar="FOLDER", help="checkout of another version")
    parser.add_argument("--rays", type=int, default=16384)
    parser.add_argument("--steps", type=int, default=25)
    parser.add_argument("--pairs", type=int, default=5)
    parser.add_argument("--anywhere", action="store_true", help="pixels from whole views")
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--old", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(child(arguments)))
        return
    versions = {"this version": None} | ({"before": arguments.against} if arguments.against else {})
    records = {name: [] for name in versions}
    for _ in range(arguments.pairs):
        for name, folder in versions.items():
            command = [sys.executable, os.path.abspath(__file__), *sys.argv[1:], "--child"]
            environment = dict(os.environ)
            if folder is not None:
                environment["PYTHONPATH"] = os.path.abspath(folder)
                command.append("--old")
            result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
            if result.returncode:
                raise SystemExit(f"{name}: {result.stderr}")
            records[name].append(json.loads(result.stdout.splitlines()[-1]))
            print(name, records[name][-1], flush=True)
    rows = []
    for name, values in records.items():
        step, forward = (statistics.median(v[k] for v in values) for k in ("step_ms", "forward_ms"))
        rows.append({"name": name, "step_ms": step, "forward_ms": forward, "rest_by_forward": step / forward - 1})
    if len(rows) == 2:
        ratios = [a["step_ms"] / b["step_ms"] for a, b in zip(*records.values(), strict=True)]
        rows[0]["step_ratio"] = statistics.median(ratios)
        rows[0]["step_ratios"] = [min(ratios), max(ratios)]
    print(json.dumps(rows, indent=1))
    if arguments.json:
        from mi_diffind.core.files import write_json

        write_json(arguments.json, {"rays": arguments.rays, "nodes": records["this version"][0]["nodes"], "rows": rows})


if __name__ == "__main__":
    main()
