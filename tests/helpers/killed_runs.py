"""Runs of the command line that are killed (SIGKILL) at a chosen moment, and gone on with.

A moment is the number of a call in Python code: ``17`` kills the process in the 17th call of any function, ``replace
2`` before the second file gets its final name. It does not depend on the speed of the machine.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path


def run(arguments: list[str], folder: Path, moment: str = "", prepare: str = "") -> int | None:
    """Run a command in another process; return its number of calls, ``None`` if it was killed.

    ``prepare`` names a function of this module that is called first. Raises ``RuntimeError`` if the command fails.
    """
    request = json.dumps({"arguments": arguments, "moment": moment, "prepare": prepare})
    done = subprocess.run(
        [sys.executable, __file__, request], cwd=folder, capture_output=True, text=True, errors="replace"
    )
    if done.returncode == -signal.SIGKILL and moment:
        return None
    if done.returncode:
        raise RuntimeError(f"exit code {done.returncode}: {done.stderr[-2000:]}")
    return int(done.stdout.splitlines()[-1])


def files(folder: Path) -> dict[str, bytes]:
    """Return the content of all files in a folder, by path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def main(arguments: list[str], moment: str, prepare: str) -> None:
    """Run one command in this process."""
    from mi_diffind.commands import cli

    if prepare:
        globals()[prepare]()
    *replace, number = moment.split() or ["0"]
    last, calls, replaced = int(number), 0, 0

    def count(frame, event, argument):
        nonlocal calls, replaced
        calls += event in ("call", "c_call")
        replaced += event == "c_call" and argument is os.replace
        if last and (replaced if replace else calls) == last:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.setprofile(count)
    code = cli.main(arguments)
    sys.setprofile(None)
    print(calls)
    sys.exit(code)


def measure_little() -> None:
    """Measure results at few places."""
    from mi_diffind.tasks.disney.training import DisneyModel
    from mi_diffind.tasks.ggx.training import GGXModel

    GGXModel.measure.__defaults__ = DisneyModel.measure.__defaults__ = (2**12,)


def small_study() -> None:
    """Add a study ``killed``: the small one, with a training to convergence."""
    import numpy as np
    from small_study import Log, small_plan

    from mi_diffind.arrays.indirection import DifferentiableArray
    from mi_diffind.core.runtime import array_module
    from mi_diffind.fitting.loop import FitSettings, Problem
    from mi_diffind.measure.study import Study
    from mi_diffind.measure.training import ConvergenceTraining
    from mi_diffind.studies import studies

    types = array_module("llvm")

    class Ramp(Problem):
        def __init__(self):
            self.net = DifferentiableArray((5,), 1, "constant", 0.0).alloc(types.TensorXf)
            self.weights, self.identity = {}, {}

        def batch(self, rng, size):
            return rng.random(types.Float, size), {"y": [types.Float(1)]}

        def predict(self, net, inputs):
            return {"y": net([inputs])}

        def measure(self, net):
            return {"psnr_db": -20 * float(np.log10(max(np.abs(net.numpy() - 1).mean(), 0.01)))}

    class Killed(Study):
        name, title = "killed", "a small study"

        def plan(self, arguments):
            settings = FitSettings(steps=5, batch=64, lr=1e-1, schedule="constant", seed=3)
            plan = small_plan(Log())
            plan.study, plan.jobs = "killed", [ConvergenceTraining("training", Ramp, settings, 40)]
            return plan

    studies()["killed"] = Killed()


if __name__ == "__main__":
    main(**json.loads(sys.argv[1]))
