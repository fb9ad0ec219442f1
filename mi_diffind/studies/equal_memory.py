"""Equal-memory comparison: each method is trained once per memory budget (:class:`Contender`) and cached.

Trained models are files in a folder, so an interrupted study continues with the models that are there.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..core.files import replacing
from ..core.runtime import array_module
from ..fitting import task
from ..measure.study import Candidate, Job


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


class StudyContext:
    """Base class of what the contenders of a study share."""

    @functools.cached_property
    def types(self):
        """The module of Dr.Jit types of the current variant."""
        import mitsuba as mi

        return array_module(mi.variant())


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays that :meth:`Contender.save_arrays` wrote."""
    with np.load(path, allow_pickle=False) as data:
        return dict(data)


@dataclass
class Contender(Job):
    """A ``method`` at one memory ``budget``: the job that trains or encodes it, and the candidate that is measured.

    ``budget`` is in the study's unit (bytes, or a compression ratio), ``context`` is what all contenders of the study
    share. After :meth:`cached_record` or :meth:`run`, :attr:`model` is the trained or encoded representation.

    A study derives one class, with the ``labels`` and ``families`` of its methods and :meth:`budget_text`; each way to
    train derives from that class, with :meth:`run`, which sets ``model`` and writes ``file`` (``None``: no folder for
    models), and :meth:`load`, which reads the file.
    """

    method: str
    budget: float
    context: Any
    name: str = ""
    file: Path | None = None

    #: Method → its name in tables, and the group that it belongs to in pictures.
    labels: ClassVar[Mapping[str, str]] = {}
    families: ClassVar[Mapping[str, str]] = {}
    #: False: there is no file, the record alone is kept.
    has_file: ClassVar[bool] = True

    def __post_init__(self):
        self.name = self.name or f"{self.labels[self.method]} {self.budget_text(self.budget)}"

    @staticmethod
    def budget_text(budget) -> str:
        """Return the budget as names of contenders show it, as in "1 MiB"."""
        raise NotImplementedError

    def candidate(self, **fields) -> Candidate:
        """Return the candidate to measure; ``fields`` are further ones of :class:`Candidate`."""
        return Candidate(
            self.name, self.families[self.method], self.budget_text(self.budget), job=self.name,
            label=self.labels[self.method], details={"kind": self.method, "asked": self.budget}, **fields,
        )  # fmt: skip

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        from ..measure.store import file_name

        self.file = folder / f"{file_name(self.name)}.npz" if folder else None
        self.__dict__.pop("model", None)
        is_cached = self.file is not None and self.file.is_file()
        return record if record and (is_cached or not self.has_file) else None

    @functools.cached_property
    def model(self):
        """The trained or encoded representation, read from ``file`` unless :meth:`run` has just set it."""
        return self.load(self.file)

    def load(self, path: Path):
        """Return the representation that a file of the models folder holds."""
        raise NotImplementedError

    def save_arrays(self, **arrays) -> None:
        """Write arrays to ``file``, if there is a folder for models."""
        if self.file is not None:
            with replacing(self.file) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, **arrays)


class PresetContender(Contender):
    """A contender that a task trains by one of its presets, as ``mi-diffind fit`` does."""

    #: Name of the task, and the attribute of its models that the study measures.
    task_name: ClassVar[str]
    model_part: ClassVar[str] = "field"

    #: The task's preset; "" is its default.
    preset: str = ""

    def arguments(self) -> dict:
        """Return the training settings and the task's own arguments, those of :func:`mi_diffind.fitting.task.fit`."""
        raise NotImplementedError

    def fit(self, progress: bool) -> task.Fitted:
        """Train the preset."""
        import mitsuba as mi

        return task.fit(
            self.task_name, preset=self.preset, variant=mi.variant(), progress=progress, output=self.file,
            deterministic=False, **self.arguments(),
        )  # fmt: skip

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        from ..arrays.tables import save_table

        if not self.file:
            raise ValueError("presets are measured from their files: give a folder for them")
        start = time.perf_counter()
        fitted = self.fit(progress)
        if fitted.result.interrupted:
            return None
        save_table(self.file, fitted.table)
        task_model = self.open(self.file)
        self.model = getattr(task_model, self.model_part)
        return self.fit_record(task_model, fitted, time.perf_counter() - start)

    def fit_record(self, task_model: task.Model, fitted: task.Fitted, seconds: float) -> dict:
        """Return the record of a training that took ``seconds``, preparation and storage included."""
        raise NotImplementedError

    def open(self, path: Path) -> task.Model:
        """Return the task's model of a table file."""
        return task.tasks()[self.task_name].open(self.context.types.TensorXf, str(path))

    def load(self, path: Path):
        return getattr(self.open(path), self.model_part)


def candidates_by_budget(result: dict) -> dict[Any, dict[str, dict]]:
    """Return a map from each budget, ascending, to the measured contenders of a result: name → candidate."""
    groups: dict[Any, dict[str, dict]] = {}
    for name, candidate in result["candidates"].items():
        budget = candidate["details"].get("asked")
        if budget and candidate["errors"]:
            groups.setdefault(budget, {})[name] = candidate
    return dict(sorted(groups.items()))


def ours_and_others(result: dict) -> Iterator[tuple[Any, dict, dict[str, tuple[str, dict]]]]:
    """Yield each budget that has both with the errors of ours, and the names and errors of the others by method."""
    for budget, candidates in candidates_by_budget(result).items():
        methods = {c["details"]["kind"]: (name, c["errors"]) for name, c in candidates.items()}
        if "ours" in methods and len(methods) > 1:
            yield budget, methods.pop("ours")[1], methods


def name_of_ours(result: dict) -> str:
    """Return the name of the contender of the method "ours" at the first budget, "" if there is none."""
    first = candidates_by_budget(result).get(result["details"]["first"], {})
    return next((name for name, c in first.items() if c["details"]["kind"] == "ours"), "")


def ratio_phrases(ratios: Mapping[str, dict], ours: str) -> list[str]:
    """Return ``"1.20 times that of …"`` for each finite ratio ``"ours / other"`` of a result."""
    medians = {pair.removeprefix(f"{ours} / "): r["median"] for pair, r in ratios.items() if pair.startswith(ours)}
    return [f"{median:.2f} times that of {name}" for name, median in medians.items() if median == median]
