"""Declaration of studies: a study, its plan, and the candidates and cases of the plan.

A module of :mod:`mi_diffind.studies`, or one that an entry point of the group ``mi_diffind.studies`` names, has a
:class:`Study` as its ``STUDY``. The command ``tradeoff`` imports the one
that it runs; the lines ``name`` and ``title`` at the beginning of the classes of others are read as text.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

#: Name of the floor among the queries of a case.
FLOOR = "floor"

#: Name of a whole pass among the queries.
PASS = "render"


@dataclass
class Tradeoff:
    """Result of a study: its ``figures`` as JSON holds them, ``lines`` of text, and the paths of the ``files``."""

    figures: dict
    lines: list[str]
    files: dict[str, str]

    @property
    def pictures(self) -> dict[str, str]:
        """Paths of the pictures by name; ``"png"`` is accuracy against time and bytes."""
        return {name: path for name, path in self.files.items() if path.endswith(".png")}

    def __str__(self) -> str:
        return "\n".join([*self.lines, "", "written     " + ", ".join(self.files.values())])

    def _repr_png_(self) -> bytes | None:
        pictures = self.pictures
        path = pictures.get("png") or next(iter(pictures.values()), None)
        return None if path is None else Path(path).read_bytes()


class Study:
    """Base class of studies.

    ``name``: the word of the command and of the files (``tradeoff_NAME.…``); ``title``: a phrase for the help;
    ``example``: arguments of the example in the help.

    A study that compares candidates has a :meth:`plan`; any other study overrides :meth:`run`. ``arguments`` holds all
    arguments of the command: ``out`` (the folder), ``quick``, and those of :meth:`add_arguments`.
    """

    name = ""
    title = ""
    example = ""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the study's own arguments to the parser of its command."""

    def check(self, arguments) -> None:
        """Raise ``ValueError`` with a sentence for bad arguments, before any work."""

    def plan(self, arguments) -> Plan:
        """Return the plan, in the variant that is set."""
        raise NotImplementedError(f'the study "{self.name}" has no plan')

    def run(self, arguments) -> Tradeoff | None:
        """Run a study that has no plan: measure, write the files and return the result.

        After Ctrl-C, its figures are incomplete and have ``interrupted``. ``None``, the default: the plan is measured.
        """
        return None


@dataclass
class Candidate:
    """Candidate of a comparison: a representation at a setting.

    ``errors(samples)`` measures its errors against the truth. Without it, the errors are those of its job's record, or
    it has none: the truth (``is_truth``), or a candidate that computes something else. Pictures show the truth, and
    candidates that others are compared with (``is_reference``), as lines. ``competes``: it may be on the Pareto front.
    ``bytes`` are those of its job's record, if any. ``job``: name of the job that trains it; ``operations(query)``
    counts operations that a kernel does not show; ``label`` is its name in pictures; ``details`` go to the result.
    """

    name: str
    representation: str
    setting: str = ""
    bytes: int = 0
    errors: Callable[[int], dict[str, float]] | None = None
    is_truth: bool = False
    is_reference: bool = False
    competes: bool = True
    in_picture: bool = True
    label: str = ""
    job: str = ""
    operations: Callable[[str], object] | None = None
    details: dict = field(default_factory=dict)


@dataclass
class Case:
    """Situation in which candidates are timed.

    ``queries(lanes)`` returns query → name of a candidate, or :data:`FLOOR` → function. ``passes()``, if given, returns
    name of a candidate → function of the pass number that does one whole pass, such as a render. Both are called when
    they are needed; names that are no candidates are left out. A case of passes may have no queries. ``in_picture``:
    the case has a panel, of the error ``accuracy`` (default: the plan's first measure) against the time of a pass, or
    without ``passes`` of its first query. ``details`` go to the result.
    """

    name: str
    queries: Callable[[int], dict[str, dict[str, Callable[[], object]]]]
    passes: Callable[[], dict[str, Callable[[int], object]]] | None = None
    details: dict = field(default_factory=dict)
    in_picture: bool = True
    accuracy: str = ""


@dataclass(frozen=True)
class Measure:
    """Error that a report shows for all candidates: its ``label``, its ``key`` in ``errors``, and a format of a number.

    The errors of contenders in equal bytes are compared by it; ``more`` is better, or less.
    """

    label: str
    key: str
    form: str = ".2f"
    more: bool = True


@dataclass
class Plan:
    """Plan of a measurement: candidates, cases, jobs, and the reports of a study.

    The first of the ``measures`` is the accuracy of pictures; more of it is better, as of a PSNR. ``ratios`` are pairs
    of candidates whose times are divided. ``jobs`` (:class:`.training.Contender`) train candidates before the
    measurement; a study that is run again reads their models if this package, ``details`` and ``jobs_fingerprint`` are
    unchanged.
    ``panels``: ``("bytes",)`` if the accuracy is drawn against bytes, too. ``pictures`` maps further names to functions
    of the result that draw a Matplotlib figure; ``notes`` are sentences below pictures.
    """

    study: str
    title: str
    candidates: list[Candidate]
    cases: list[Case]
    measures: tuple[Measure, ...]
    ratios: list[tuple[str, str]] = field(default_factory=list)
    details: dict = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    jobs: list = field(default_factory=list)
    jobs_fingerprint: str = ""
    panels: tuple[str, ...] = ()
    pictures: dict[str, Callable[[dict], object]] = field(default_factory=dict)
