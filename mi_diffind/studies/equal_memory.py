"""Equal-memory comparison: each method is trained once per memory budget (:class:`Contender`) and cached."""

from __future__ import annotations

import argparse
import functools
import json
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from ..arrays.tables import save_table
from ..core.files import replacing, write_json
from ..fitting import task
from ..measure.store import file_name
from ..measure.study import Candidate, Job
from ..measure.training import ConvergenceTraining


def add_without_option(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--without``, which leaves methods out."""
    parser.add_argument(
        "--without", action="append", default=[], metavar="METHOD",
        help="leave out a method, named as in the table without its budget; may be repeated",
    )  # fmt: skip


def check_without(without: Iterable[str], methods: Iterable[str]) -> None:
    """Raise ``ValueError`` if ``without`` names something else than one of the ``methods``."""
    unknown = [name for name in without if name not in methods]
    if unknown:
        raise ValueError(f'--without: found "{unknown[0]}", allowed are {", ".join(methods)}')


def combinations(
    methods: Iterable[str], budgets: Sequence, first_only: Iterable[str], without: Iterable[str]
) -> list[tuple]:
    """Return the pairs ``(method, budget)`` to train; those in ``first_only`` are trained at the first budget only."""
    methods = [method for method in methods if method not in without]
    return [(m, budget) for budget in budgets for m in methods if budget == budgets[0] or m not in first_only]


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays that :meth:`Contender.save_arrays` wrote."""
    with np.load(path, allow_pickle=False) as data:
        return dict(data)


@dataclass
class Contender(Job):
    """A ``method`` at one memory ``budget``: the job that trains or encodes it, and the candidate that is measured.

    The record lies beside the model in the folder of models, so that a study that is run again trains nothing twice.

    ``fit(contender, progress)`` trains or encodes: it sets :attr:`model`, writes ``file`` unless it is ``None``, and
    returns the record (:class:`.Job`), or ``None`` after Ctrl-C. ``read(contender)`` returns the model of ``file``; if
    nothing is in a file, ``has_file`` is false and ``read`` builds the model anew.

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
    separable: bool = False
    details: dict = field(default_factory=dict)
    file: Path | None = None
    folder: Path | None = None
    record: dict | None = None

    def candidate(self, **fields) -> Candidate:
        """Return the candidate to measure; ``fields`` are further ones of :class:`Candidate`."""
        label = self.label or self.method
        given = {"label": label, "details": {"kind": self.method, "asked": self.budget, **self.details}, **fields}
        return Candidate(self.name, self.family or label, self.setting, job=self.name, **given)

    def cached_record(self, folder: Path | None, record: dict | None = None) -> dict | None:
        self.folder = folder
        self.file = folder / f"{file_name(self.name)}.npz" if folder and self.has_file else None
        self.__dict__.pop("model", None)
        if record is None and folder and self._record_file.is_file():
            record = json.loads(self._record_file.read_text(encoding="utf-8"))
        is_there = not self.has_file or (self.file is not None and self.file.is_file())
        self.record = record if is_there else None
        return self.record

    @property
    def _record_file(self) -> Path:
        return self.folder / f"{file_name(self.name)}.json"

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        start = time.perf_counter()
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


class NetworkContender(ConvergenceTraining):
    """A network at a memory budget, trained to convergence in half precision: a job and a candidate, as a contender.

    ``build(net)`` returns its model of the trained network; ``training`` are the arguments of
    :class:`.ConvergenceTraining` after the name.
    """

    family = ""

    def __init__(self, name: str, method: str, budget: float, label: str, setting: str, build: Callable, *training):
        super().__init__(name, *training)
        self.method, self.budget, self.label, self.setting, self.build = method, budget, label, setting, build
        self.details: dict = {}

    candidate = Contender.candidate

    @property
    def model(self):
        """The trained representation."""
        return self.build(self.net)


def open_preset(job: Contender, task_name: str) -> task.Model:
    """Return the task's model of the table file of a contender."""
    return task.tasks()[task_name].open(mi.TensorXf, str(job.file))


def fit_preset(
    job: Contender, progress: bool, task_name: str, part: str, preset: str, arguments: dict
) -> tuple[task.Model, task.Fitted] | None:
    """Train a contender by a task's preset (``""``: the default), as ``mi-diffind fit`` does; ``None`` after Ctrl-C.

    ``arguments`` are those of :func:`mi_diffind.fitting.task.fit`; the model of the contender is the attribute ``part``
    of the task's model. Returns the task's model and the result of the fit.
    """
    if not job.file:
        raise ValueError("presets are measured from their files: give a folder for them")
    fitted = task.fit(
        task_name, preset=preset, variant=mi.variant(), progress=progress, output=job.file, deterministic=False,
        **arguments,
    )  # fmt: skip
    if fitted.result.interrupted:
        return None
    save_table(job.file, fitted.table)
    model = open_preset(job, task_name)
    job.model = getattr(model, part)
    return model, fitted
