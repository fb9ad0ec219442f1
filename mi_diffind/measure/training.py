"""Contenders of studies: representations that are trained once, whose models and records are kept in a folder.

Only representations that are trained to convergence can be compared (:class:`ConvergenceTraining`). A representation
has converged if a run of twice as many steps, with the same schedule stretched to them, changed the result by less than
:data:`GAIN` dB. Trainings also end where twice the steps lose more, or at the longest run: the best run counts, and the
record says that it has not converged.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..core.files import replacing, write_json
from ..fitting.loop import FitSettings, Problem, fit
from .store import file_name
from .study import Candidate

#: Change by a run of twice as many steps, in dB, below which a training has converged.
GAIN = 0.5


def halve(net) -> None:
    """Round all parameters of a module to half precision, in which they are stored."""
    for key in net:
        net[key] = type(net[key])(net[key].numpy().astype(np.float16).astype(np.float32))


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays that :meth:`Contender.save_arrays` wrote."""
    with np.load(path, allow_pickle=False) as data:
        return dict(data)


@dataclass
class Contender:
    """A ``method`` at one memory ``budget``: the job that trains or encodes it, and the candidate that is measured.

    ``fit(contender, progress)`` trains or encodes: it sets :attr:`model`, writes ``file`` unless it is ``None``, and
    returns the record, or ``None`` after Ctrl-C. The record is a tree for JSON: ``seconds``, and optionally ``bytes``,
    ``errors``, ``converged`` and ``details``. It lies beside ``file``, so that a study that is run again trains nothing
    twice. ``read(contender)`` returns the model of ``file``; if nothing is in a file, ``has_file`` is false and
    ``read`` builds the model anew.

    ``label`` is the name of the method in tables, ``family`` the group that it belongs to in pictures, ``setting`` the
    budget as text.
    """

    name: str
    method: str
    budget: float
    fit: Callable[[Contender, bool], dict | None]
    read: Callable[[Contender], Any]
    label: str = ""
    family: str = ""
    setting: str = ""
    has_file: bool = True
    details: dict = field(default_factory=dict)
    folder: Path | None = None
    record: dict | None = None

    @property
    def file(self) -> Path | None:
        """File of the model, ``None`` without a folder for models."""
        return self.folder / f"{file_name(self.name)}.npz" if self.folder and self.has_file else None

    def candidate(self, **fields) -> Candidate:
        """Return the candidate to measure; ``fields`` are further ones of :class:`Candidate`."""
        label = self.label or self.method
        given = {"label": label, "details": {"kind": self.method, "asked": self.budget, **self.details}, **fields}
        return Candidate(self.name, self.family or label, self.setting, job=self.name, **given)

    def cached_record(self, folder: Path | None) -> dict | None:
        """Return the record that :meth:`run` wrote to ``folder``, if its model is there."""
        self.folder = folder
        if folder and self._record_file.is_file() and (self.file is None or self.file.is_file()):
            self.record = json.loads(self._record_file.read_text(encoding="utf-8"))
        return self.record

    @property
    def _record_file(self) -> Path:
        return self.folder / f"{file_name(self.name)}.json"

    def run(self, folder: Path | None = None, progress: bool = True) -> dict | None:
        """Train or encode, write the model to ``folder``, and return the record, or ``None`` after Ctrl-C."""
        self.folder, start = folder, time.perf_counter()
        self.record = self.fit(self, progress)
        if self.record is not None:
            self.record.setdefault("seconds", time.perf_counter() - start)
            if folder:
                write_json(self._record_file, self.record)
        return self.record

    @functools.cached_property
    def model(self):
        """The trained or encoded representation."""
        return self.read(self)

    def save_arrays(self, **arrays) -> None:
        """Write arrays to ``file``, if there is a folder for models."""
        if self.file is not None:
            with replacing(self.file) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, **arrays)


class ConvergenceTraining(Contender):
    """Contender that is trained to convergence.

    ``problem()`` returns a new problem with untrained parameters; ``settings`` are those of the first, shortest run,
    ``longest`` is the largest number of steps; each run is measured ``measurements`` times. ``half``: the parameters
    are rounded to half precision. ``finish(net, record)`` returns further entries of the record, such as ``bytes`` and
    ``errors``. ``gain`` stands for :data:`GAIN`. The model, :attr:`net`, is the trained module of the best run.
    """

    def __init__(
        self, name: str, problem: Callable[[], Problem], settings: FitSettings, longest: int, measurements: int = 20,
        half: bool = False, finish: Callable[[object, dict], dict] = lambda net, record: {}, gain: float = GAIN,
    ):  # fmt: skip
        super().__init__(name, "", 0.0, ConvergenceTraining.train, lambda job: job.net)
        self.problem, self.settings, self.longest = problem, settings, longest
        self.measurements, self.half, self.finish, self.gain = measurements, half, finish, gain

    def cached_record(self, folder: Path | None) -> dict | None:
        """Return the record that :meth:`run` wrote to ``folder``, if its settings are the same."""
        record = super().cached_record(folder)
        if record and record["settings"] != json.loads(json.dumps(self._settings())):
            self.record = None
        return self.record

    @functools.cached_property
    def net(self):
        """The trained module."""
        arrays, net = load_arrays(self.file), self.problem().net
        for key in net:
            net[key] = type(net[key])(arrays[key])
        return net

    def train(self, progress: bool = True) -> dict | None:
        """Train, from the checkpoint if there is one.

        Returns the record, or ``None`` after Ctrl-C: ``name``, ``steps``, ``seconds`` and ``psnr_db`` of the best run,
        ``gain_db`` of the last doubling (``None``: there was none), ``converged``, ``entries`` (numbers trained), and
        ``steps``, ``seconds`` and ``psnr_db`` of each of the ``runs``.
        """
        runs, best, gain, steps = [], None, None, self.settings.steps
        while True:
            settings = dataclasses.replace(self.settings, steps=steps, measure_every=max(1, steps // self.measurements))
            problem = self.problem()
            checkpoint = self.file and self.file.with_name(f"{self.file.stem}_{steps}.checkpoint")
            resume = checkpoint is not None and checkpoint.is_file()
            title = f"train {self.name}" if progress else None
            result = fit(problem, settings, checkpoint, resume, progress, title=title)
            if result.interrupted:
                return None
            run = {"steps": steps, "seconds": result.seconds, "psnr_db": next(iter(result.measured.values()))}
            gain = run["psnr_db"] - runs[-1]["psnr_db"] if runs else None
            runs.append(run)
            if best is None or run["psnr_db"] >= best["psnr_db"]:
                best, self.net = run, problem.net
            if (gain is not None and gain < self.gain) or 2 * steps > self.longest:
                break
            steps *= 2
        record = {
            "name": self.name,
            **best,
            "gain_db": gain,
            "converged": gain is not None and abs(gain) < self.gain,
            "entries": sum(int(np.prod(self.net[key].shape)) for key in self.net),
            "settings": self._settings(),
            "runs": runs,
        }
        if self.half:
            halve(self.net)
        record |= self.finish(self.net, record)
        self.save_arrays(**{key: self.net[key].numpy() for key in self.net})
        for checkpoint in self.file.parent.glob(f"{self.file.stem}_*.checkpoint") if self.file else ():
            checkpoint.unlink()
        return record

    def _settings(self) -> dict:
        return {**dataclasses.asdict(self.settings), "longest": self.longest, **self.problem().identity}


class NetworkContender(ConvergenceTraining):
    """A network at a memory budget, trained to convergence in half precision.

    ``build(net)`` returns its model of the trained network; ``training`` are the arguments of
    :class:`ConvergenceTraining` after the name.
    """

    def __init__(self, name: str, method: str, budget: float, label: str, setting: str, build: Callable, *training):
        super().__init__(name, *training)
        self.method, self.budget, self.label, self.setting, self.build = method, budget, label, setting, build

    @property
    def model(self):
        """The trained representation."""
        return self.build(self.net)
