"""
What a study is: how it declares itself, and what it gives to the frame (:mod:`.frame`) to be measured.

A module of :mod:`mi_diffind.studies`, or one that an entry point of the group ``mi_diffind.studies`` names, has a
:class:`Study` as its ``STUDY``. Declaring it imports neither Mitsuba nor Dr.Jit: the command line asks all of them.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

#: The name under which a case has its floor.
FLOOR = "floor"


class Study:
    """
    A study as it declares itself: ``name``, that of the subcommand and of the files that it writes
    (``tradeoff_NAME.…``), and ``title``, what is measured against what, a phrase for the help.

    One that compares candidates gives a :meth:`plan`; one of another kind has a :meth:`run` of its own. With
    ``of_scene`` it is about a scene file: the command has the argument ``scene`` and the options of scenes, and
    ``arguments.defines`` is a dictionary. All arguments of the command are in ``arguments``: ``out``, the folder,
    ``quick`` and what :meth:`add_arguments` adds.
    """

    name = ""
    title = ""
    of_scene = False

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments that only this study has."""

    def check(self, arguments) -> None:
        """Refuse arguments, before anything is loaded or made, by a ``ValueError`` with a sentence."""

    def plan(self, arguments) -> Plan:
        """What is to be measured, in the variant that is set."""
        raise NotImplementedError(f'the study "{self.name}" has no plan')

    def run(self, arguments) -> dict | None:
        """
        Of a study that has no plan: measure, write the files, print what was found. Returns the result with its
        ``files``; after Ctrl-C, what there is up to then, with ``interrupted``. ``None``: its plan is to be measured.
        """
        return None


@dataclass
class Candidate:
    """
    A representation at a setting.

    ``errors(samples)`` measures it against the truth; missing, its job does, or it has none: it is the truth itself
    (``is_truth``), or it computes something else, as ``note`` should say. ``is_reference``: it is not in competition,
    but what the others are compared with; so is the truth. ``competes``: it may be on the Pareto front. ``bytes`` and
    ``training_seconds`` (``None``: not known) are what it takes beside time, unless its job says. ``job`` is the name
    of the one that makes it; ``queries`` are those that it takes part in (default: all); ``operations(query)`` counts
    what a kernel does not show; ``details`` are kept with it.
    """

    name: str
    representation: str
    setting: str = ""
    bytes: int = 0
    training_seconds: float | None = 0.0
    errors: Callable[[int], dict[str, float]] | None = None
    is_truth: bool = False
    is_reference: bool = False
    competes: bool = True
    in_passes: bool = True
    in_picture: bool = True
    note: str = ""
    label: str = ""
    job: str = ""
    queries: tuple[str, ...] | None = None
    operations: Callable[[str], object] | None = None
    details: dict = field(default_factory=dict)


class Job:
    """
    What has to be done before anything can be measured, as a training: shared by the candidates that name it.

    A record is a tree for JSON: ``seconds``, and optionally ``bytes``, ``errors``, ``converged``, ``details``, and
    ``runs``, courses of trainings (:mod:`.training`).
    """

    name: str

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        """The record if all is done: it is in the store (``record``), or what it made is in ``folder``."""
        return record

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        """Do it, and return the record, or ``None`` after Ctrl-C; files that are kept go to ``folder``."""
        raise NotImplementedError


@dataclass
class Case:
    """
    A situation. ``queries(lanes)`` maps the name of each query to the names of all candidates and :data:`FLOOR`, and
    these to functions; ``passes()``, if there are any, maps candidates (those with ``in_passes``) to functions of the
    number of the pass, which do one pass of a whole job. Both are called when they are needed. ``candidates`` are the
    names of those that take part (default: all), ``query_names`` those of its queries (default: the plan's);
    ``in_picture``: it has a panel, which shows the error ``accuracy`` (default: the plan's) against the time of its
    first query, or if it is ``of_passes`` of a pass; so does the Pareto front. ``details`` are kept with it.
    """

    name: str
    queries: Callable[[int], dict[str, dict[str, Callable[[], object]]]]
    passes: Callable[[], dict[str, Callable[[int], object]]] | None = None
    details: dict = field(default_factory=dict)
    candidates: tuple[str, ...] | None = None
    query_names: tuple[str, ...] | None = None
    in_picture: bool = True
    accuracy: str = ""
    of_passes: bool = False


@dataclass
class Plan:
    """
    What a study asks for.

    ``accuracy`` names the error that pictures show and the Pareto front is made with, one that is larger for better
    candidates, as a PSNR is. ``ratios`` are pairs of candidates, a time divided by another. ``details`` and the
    ``fingerprint`` of ``sources`` (files beside those of this package) tell whether what is measured is still the same.
    ``jobs`` come first; ``jobs_fingerprint`` is that of the models they keep. ``panels``: what accuracy is drawn
    against, for all candidates (``"bytes"``, ``"training_seconds"``); ``bytes_by_case``: also against bytes, for those
    of each case. ``table(result)`` are lines to print before the times, ``conclusions(result)`` after them.
    ``pictures`` are further ones: kind → a function of the result that draws a Matplotlib figure. ``sampled``: errors
    are those of so many samples as the settings say.
    """

    study: str
    title: str
    variant: str
    candidates: list[Candidate]
    cases: list[Case]
    queries: tuple[str, ...]
    accuracy: str
    accuracy_label: str
    ratios: list[tuple[str, str]] = field(default_factory=list)
    sources: tuple[str, ...] = ()
    details: dict = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    jobs: list[Job] = field(default_factory=list)
    jobs_fingerprint: str = ""
    panels: tuple[str, ...] = ()
    bytes_by_case: bool = False
    pictures: dict[str, Callable[[dict], object]] = field(default_factory=dict)
    sampled: bool = True
    table: Callable[[dict], list[str]] = lambda result: []
    conclusions: Callable[[dict], list[str]] = lambda result: []

    def resolved(self, case: Case) -> Case:
        """``case`` with the names of its candidates and queries."""
        known = tuple(c.name for c in self.candidates if case.candidates is None or c.name in case.candidates)
        return dataclasses.replace(case, candidates=known, query_names=case.query_names or self.queries)

    def takers(self, case: Case, query: str) -> list[str]:
        """The names of the candidates that take part in a query of a case that is :meth:`resolved`."""
        found = [c for c in self.candidates if c.name in case.candidates]
        return [c.name for c in found if c.queries is None or query in c.queries]
