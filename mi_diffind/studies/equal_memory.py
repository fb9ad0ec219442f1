"""
Equal-memory comparison: each method is trained once per memory budget (:class:`Contender`) and cached.

The models are files in a folder, so an interrupted study continues with the models that it has.
"""

from __future__ import annotations

import argparse
import functools
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from .. import task
from ..measure.study import Candidate, Job

# -- which ------------------------------------------------------------------------------------------------------------


def add_without(parser: argparse.ArgumentParser) -> None:
    """The option by which kinds are left out."""
    parser.add_argument(
        "--without", action="append", default=[], metavar="KIND",
        help="leave out a kind, as it is named in the table without its size; may be repeated",
    )  # fmt: skip


def check_without(without: Iterable[str], kinds: Iterable[str]) -> None:
    """Raise ``ValueError`` for what is no kind."""
    unknown = [name for name in without if name not in kinds]
    if unknown:
        raise ValueError(f'--without: found "{unknown[0]}", allowed are {", ".join(kinds)}')


def chosen(kinds: Iterable[str], sizes: Sequence, once: Iterable[str], without: Iterable[str]) -> list[tuple]:
    """``(kind, size)`` of all that is made: of ``once`` in the first size only."""
    kinds = [kind for kind in kinds if kind not in without]
    return [(kind, size) for size in sizes for kind in kinds if size == sizes[0] or kind not in once]


# -- how --------------------------------------------------------------------------------------------------------------


@dataclass
class Contender(Job):
    """
    A ``kind`` in a ``size``: after :meth:`known` or :meth:`run`, ``field`` is what it became. ``setting`` is what all
    of a study share; it has the module ``types``.

    A study derives from it, says how sizes are written (:meth:`text`) and has the ``labels`` of kinds and the
    ``families``, for pictures. What makes a kind derives from that: its :meth:`run` sets ``field`` and writes ``file``,
    if there is one, which :meth:`load` reads.
    """

    kind: str
    size: float
    setting: Any
    name: str = ""
    file: Path | None = None

    labels: ClassVar[Mapping[str, str]] = {}
    families: ClassVar[Mapping[str, str]] = {}

    def __post_init__(self):
        self.name = self.name or f"{self.labels[self.kind]} {self.text(self.size)}"

    @staticmethod
    def text(size) -> str:
        """A size, in names."""
        raise NotImplementedError

    def candidate(self, **more) -> Candidate:
        """The candidate that is made."""
        return Candidate(
            self.name, self.families[self.kind], self.text(self.size), job=self.name, label=self.labels[self.kind],
            details={"kind": self.kind, "asked": self.size}, **more,
        )  # fmt: skip

    def known(self, folder: Path | None, record: dict | None) -> dict | None:
        from ..measure.store import file_name

        self.file = folder / f"{file_name(self.name)}.npz" if folder else None
        self.__dict__.pop("field", None)
        return record if record and self.file is not None and self.file.is_file() else None

    @functools.cached_property
    def field(self):
        """What it became, from the file of the models' folder if it was not just made."""
        return self.load(self.file)

    def load(self, path: Path):
        """What a file holds."""
        raise NotImplementedError


class PresetContender(Contender):
    """What a task makes by one of its presets. Of a kind, :meth:`arguments` are those of ``fit``."""

    #: The task, by its name.
    task_name: ClassVar[str]

    @property
    def preset(self) -> str:
        """The preset ("": the default)."""
        raise NotImplementedError

    def arguments(self) -> dict:
        """Settings, and the task's own arguments."""
        raise NotImplementedError

    def fit(self, progress: bool) -> task.Fitted:
        """The training."""
        import mitsuba as mi

        return task.fit(
            self.task_name, self.preset, mi.variant(), progress=progress, output=self.file, deterministic=False,
            **self.arguments(),
        )  # fmt: skip

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        from ..tables import save_table

        if not self.file:
            raise ValueError("presets are measured from files: give a folder")
        start = time.perf_counter()
        fitted = self.fit(progress)
        if fitted.result.interrupted:
            return None
        save_table(self.file, fitted.table)
        model = self.model(self.file)
        self.field = model.field
        return self.fitted(model, fitted, time.perf_counter() - start)

    def fitted(self, model: task.Model, fitted: task.Fitted, seconds: float) -> dict:
        """The record of a training, which took so many ``seconds`` with everything."""
        raise NotImplementedError

    def model(self, path: Path) -> task.Model:
        """What a table file stands for."""
        return task.tasks()[self.task_name].open(self.setting.types.TensorXf, str(path))

    def load(self, path: Path):
        return self.model(path).field


# -- what was found ---------------------------------------------------------------------------------------------------


def by_size(result: dict) -> dict[Any, dict[str, dict]]:
    """Size that was asked for → name → candidate, of a result."""
    found: dict[Any, dict[str, dict]] = {}
    for name, c in result["candidates"].items():
        if c["details"].get("asked") and c["errors"]:
            found.setdefault(c["details"]["asked"], {})[name] = c
    return dict(sorted(found.items()))


def ours_of(result: dict) -> str:
    """The name of the candidate of the kind "ours" in the first size, "" if there is none."""
    first = by_size(result).get(result["details"]["first"], {})
    return next((name for name, c in first.items() if c["details"]["kind"] == "ours"), "")


def times_that_of(pairs: Mapping[str, dict], ours: str) -> list[str]:
    """``"1.20 times that of …"``, of the ratios of a result in which ``ours`` comes first."""
    found = [(pair.removeprefix(f"{ours} / "), r["median"]) for pair, r in pairs.items() if pair.startswith(ours)]
    return [f"{value:.2f} times that of {name}" for name, value in found if value == value]
