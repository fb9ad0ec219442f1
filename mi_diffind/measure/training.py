"""Training to convergence: runs of twice as many steps, until a run gains next to nothing.

Only representations that are trained to convergence can be compared. A representation has converged if a run of twice
as many steps, with the same schedule stretched to them, gained less than :data:`GAIN` dB; if the longest run gained
more, the record says so. The records keep the curves of all runs.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..core.files import replacing
from ..fitting.loop import FitSettings, Problem, fit
from .store import file_name
from .study import Job

#: Gain of a run of twice as many steps, in dB, below which a training has converged.
GAIN = 0.5


def halve(net) -> None:
    """Round all parameters of a module to half precision, in which they are stored."""
    for key in net:
        net[key] = type(net[key])(net[key].numpy().astype(np.float16).astype(np.float32))


class ConvergenceTraining(Job):
    """Training of a representation to convergence.

    ``problem()`` returns a new problem with untrained parameters; ``settings`` are those of the first, shortest run,
    ``longest`` is the largest number of steps; each run is measured ``measurements`` times. After :meth:`run` or
    :meth:`cached_record`, ``net`` is the trained module of the best run. ``half``: its parameters are rounded to half
    precision. ``finish(net, record)`` returns further entries of the record, such as ``bytes`` and ``errors``.
    """

    separable = True

    def __init__(
        self, name: str, problem: Callable[[], Problem], settings: FitSettings, longest: int, measurements: int = 20,
        half: bool = False, finish: Callable[[object, dict], dict] = lambda net, record: {},
    ):  # fmt: skip
        self.name, self.problem, self.settings, self.longest = name, problem, settings, longest
        self.measurements, self.half, self.finish = measurements, half, finish
        self.net = None

    def cached_record(self, folder: Path | None, record: dict | None = None) -> dict | None:
        """Return the record that :meth:`run` wrote to ``folder``, if its settings are the same."""
        if folder is None or not self._file(folder).is_file():
            return None
        with contextlib.suppress(Exception):  # damaged, or of other settings: train again
            return self._load(self._file(folder))
        return None

    def run(self, folder: Path | None = None, progress: bool = True) -> dict | None:
        """Train, from the checkpoint if ``folder`` has one.

        Returns the record, or ``None`` after Ctrl-C: ``name``, ``steps``, ``seconds`` and ``psnr_db`` of the best run,
        ``gain_db`` of the last doubling (``None``: there was none), ``converged``, ``entries`` (numbers trained), and
        ``runs``: of each run its ``steps``, ``seconds``, and for each measurement ``curve_steps``, ``curve_loss``,
        ``curve_psnr_db``.
        """
        file = None if folder is None else self._file(folder)
        runs, best, steps = [], None, self.settings.steps
        while True:
            settings = dataclasses.replace(self.settings, steps=steps, measure_every=max(1, steps // self.measurements))
            problem = self.problem()
            checkpoint = None if file is None else file.with_name(f"{file.stem}_{steps}.checkpoint")
            resume = checkpoint is not None and checkpoint.is_file()
            title = f"train {self.name}" if progress else None
            result = fit(problem, settings, checkpoint, resume, progress, title=title)
            if result.interrupted:
                return None
            first = next(iter(result.measured))
            runs.append({
                "steps": steps,
                "seconds": result.seconds,
                "psnr_db": result.measured[first],
                "curve_steps": [h["step"] for h in result.history],
                "curve_loss": [h["loss"] for h in result.history],
                "curve_psnr_db": [h[first] for h in result.history],
            })  # fmt: skip
            if best is None or runs[-1]["psnr_db"] >= best["psnr_db"]:
                best, self.net = runs[-1], problem.net
            gain = runs[-1]["psnr_db"] - runs[-2]["psnr_db"] if len(runs) > 1 else None
            converged = gain is not None and gain < GAIN
            if converged or 2 * steps > self.longest:
                break
            steps *= 2
        record = {
            "name": self.name,
            **{key: best[key] for key in ("steps", "seconds", "psnr_db")},
            "gain_db": gain,
            "converged": converged,
            "entries": sum(int(np.prod(self.net[key].shape)) for key in self.net),
            "settings": self._settings(),
            "runs": runs,
        }
        if self.half:
            halve(self.net)
        record |= self.finish(self.net, record)
        if file is not None:
            self._save(file, record)
            for checkpoint in file.parent.glob(f"{file.stem}_*.checkpoint"):
                checkpoint.unlink()
        return record

    def _file(self, folder: Path) -> Path:
        return Path(folder) / f"{file_name(self.name)}.npz"

    def _settings(self) -> dict:
        return {**dataclasses.asdict(self.settings), "longest": self.longest, **self.problem().identity}

    def _save(self, file: Path, record: dict) -> None:
        arrays = {f"parameter/{key}": self.net[key].numpy() for key in self.net}
        with replacing(file) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, record=np.frombuffer(json.dumps(record).encode(), np.uint8), **arrays)

    def _load(self, file: Path) -> dict:
        with np.load(file, allow_pickle=False) as data:
            record = json.loads(data["record"].tobytes())
            if record["settings"] != json.loads(json.dumps(self._settings())):
                raise ValueError("the file is of other settings")
            net = self.problem().net
            for key in net:
                net[key] = type(net[key])(data[f"parameter/{key}"])
        self.net = net
        return record
