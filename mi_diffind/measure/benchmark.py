"""Benchmark of a :class:`.study.Plan`: time, memory and operations of each candidate beside its accuracy.

*Time* is that of the kernels alone (:mod:`.clock`). All candidates run in turn, one round of all before the next round,
so that a change of clock rate or of load affects all of them alike; results are medians and quartiles of the rounds.
The *floor* is a kernel with the same inputs and outputs that computes nothing else. It is measured in the same rounds,
shown, and subtracted; a time that is hidden behind the floor is given as a bound (:mod:`.statistics`). A ratio of two
candidates is the median of the ratios of the rounds.
"""

from __future__ import annotations

import json
import math
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass

import drjit as dr
import mitsuba as mi
from tqdm import tqdm

from ..core.progress import interruptible
from .clock import count_query, machine, timed, total
from .statistics import ratio, spread, timing
from .store import Store, fingerprint, models_folder, sources
from .study import FLOOR, PASS, Case, Plan

SECTIONS = ("jobs", "errors", "operations", "queries", "passes")


@dataclass(frozen=True)
class BenchmarkSettings:
    """Amount of measurement: ``lanes`` a kernel, ``rounds`` of queries, ``passes`` and ``samples`` for the errors."""

    lanes: int
    rounds: int = 31
    passes: int = 9
    samples: int = 10**6
    quick: bool = False

    @classmethod
    def choose(cls, quick: bool = False) -> BenchmarkSettings:
        """Return settings for this machine and variant: each core, or the GPU, gets several blocks of lanes."""
        blocks = 2 ** math.ceil(math.log2(max(dr.thread_count(), 2)))
        lanes = 2**22 if mi.variant().startswith("cuda") else blocks * 2**16
        return cls(lanes // 4, 3, 2, 2**17, True) if quick else cls(lanes)


class Stopped(Exception):
    """The first Ctrl-C stopped the measurement."""


def measure(
    plan: Plan, settings: BenchmarkSettings, folder: str | os.PathLike | None = None, progress: bool = True
) -> dict:
    """Measure a plan, or the rest of it if ``folder`` holds partial results of an interrupted run.

    Partial results stay in ``folder`` until :func:`.report.write` has written the result.

    Returns the result, a tree of numbers and strings (JSON): ``task`` (the study), ``interrupted``, ``resumed``,
    ``machine``, ``settings``, ``details``; ``candidates``: name → description and ``errors``; ``cases``: name →
    ``queries``: name → candidate → ``time``, ``q1``, ``q3`` (ns a lane, floor subtracted), ``with_floor``, ``floor``,
    ``rounds``, ``hidden`` (``time`` is only a bound), ``operations``; ``passes``: candidate → likewise in ms;
    ``ratios``: query → ``"a / b"`` → ``median``, ``q1``, ``q3``, ``hidden``; ``jobs``: their records. After Ctrl-C the
    result is incomplete.

    Raises :class:`.OutputError` if the folder cannot be written.
    """
    key = {
        "settings": asdict(settings),
        "machine": machine(mi.variant()),
        "sources": fingerprint(sources()),
        "details": plan.details,
        "candidates": [c.name for c in plan.candidates],
        "cases": [c.name for c in plan.cases],
    }
    store, interrupted = Store(folder, plan.study, key, SECTIONS, progress), False
    with interruptible() as stop:
        steps = BenchmarkSteps(plan, settings, store, stop, progress)
        try:
            steps.jobs()
            steps.errors()
            for case in plan.cases:
                steps.queries(case)
                if case.passes is not None:
                    steps.passes(case)
        except Stopped:
            interrupted = True
        finally:
            store.save()
    return {
        "task": plan.study,
        "title": plan.title,
        "interrupted": interrupted,
        "resumed": store.resumed,
        "machine": key["machine"],
        "date": time.strftime("%Y-%m-%d"),
        "settings": asdict(settings),
        "measures": [asdict(measure) for measure in plan.measures],
        **{name: getattr(plan, name) for name in ("panels", "details", "notes")},
        "candidates": _candidates(plan, store.data),
        "cases": {
            case.name: _times(plan, settings, case, store.data)
            for case in plan.cases
            if store.data["queries"].get(case.name) or store.data["passes"].get(case.name)
        },
        "jobs": {job.name: store.data["jobs"][job.name] for job in plan.jobs if job.name in store.data["jobs"]},
    }


class BenchmarkSteps:
    """The steps of a benchmark; each measures the rest of its part, and raises :class:`Stopped` after Ctrl-C."""

    def __init__(self, plan: Plan, settings: BenchmarkSettings, store: Store, stop: threading.Event, progress: bool):
        self.plan, self.settings, self.store, self.stop, self.progress = plan, settings, store, stop, progress
        self.operations = {c.name: c.operations for c in plan.candidates}

    def _each(self, title: str, steps: Iterable[Callable[[], None]]) -> None:
        """Take steps with a progress bar, and store the results of each."""
        steps, disable = list(steps), None if self.progress else True
        for step in tqdm(steps, title, unit="step", smoothing=0.02, disable=disable):
            step()
            self.store.save(5)
            if self.stop.is_set():
                raise Stopped

    def jobs(self) -> None:
        """Run the jobs, each with a progress bar of its own."""
        plan, done, folder = self.plan, self.store.data["jobs"], None
        if self.store.folder is not None and plan.jobs:
            key = f"{plan.jobs_fingerprint} {json.dumps(self.store.key['details'])} {self.settings.quick}"
            folder = models_folder(self.store.folder, plan.study, key)
        for i, job in enumerate(plan.jobs):
            record = job.cached_record(folder, done.get(job.name))
            if record is None:
                if self.progress:
                    print(f"{i + 1} of {len(plan.jobs)}: {job.name}", file=sys.stderr)
                record = job.run(folder, self.progress)
            if record is not None:
                done[job.name] = record
                self.store.save()
            if record is None or self.stop.is_set():
                raise Stopped

    def errors(self) -> None:
        """Measure the errors of the candidates that have a function for them."""
        done, samples = self.store.data["errors"], self.settings.samples

        def measure_one(candidate) -> None:
            done[candidate.name] = candidate.errors(samples)

        todo = [c for c in self.plan.candidates if c.errors is not None and c.name not in done]
        self._each("errors", [lambda c=c: measure_one(c) for c in todo])

    def queries(self, case: Case) -> None:
        """Count operations, which compiles the kernels, then time the queries in rounds."""
        times = self.store.data["queries"].setdefault(case.name, [])
        if len(times) >= self.settings.rounds:
            return
        functions = {
            (query, name): function
            for query, by_name in case.queries(self.settings.lanes).items()
            for name, function in by_name.items()
            if name == FLOOR or name in self.operations
        }
        operations = self.store.data["operations"].setdefault(case.name, {})

        def compile_kernel(query: str, name: str) -> None:
            counted, known = operations.setdefault(query, {}), self.operations.get(name)
            if name not in counted:
                in_kernel = count_query(functions[query, name])
                counted[name] = (known(query) if known else in_kernel).asdict()

        def seconds(query: str, name: str) -> float:
            return timed(lambda: total(functions[query, name]())[0]).seconds

        self._rounds(case.name, times, list(functions), self.settings.rounds, compile_kernel, seconds)

    def passes(self, case: Case) -> None:
        """Time whole passes in rounds, after a first pass of each candidate that compiles it."""
        times = self.store.data["passes"].setdefault(case.name, [])
        if len(times) >= self.settings.passes:
            return
        functions = {name: f for name, f in case.passes().items() if name in self.operations}

        def compile_kernel(query: str, name: str) -> None:
            timed(lambda: functions[name](0))

        def seconds(query: str, name: str) -> float:
            return timed(lambda: functions[name](1 + len(times))).seconds

        keys = [(PASS, name) for name in functions]
        self._rounds(f"{case.name}, {PASS}", times, keys, self.settings.passes, compile_kernel, seconds)

    def _rounds(
        self, title: str, times: list, keys: list[tuple[str, str]], number: int,
        compile_kernel: Callable[[str, str], None], seconds: Callable[[str, str], float],
    ) -> None:  # fmt: skip
        """Append the missing rounds to ``times``: query → name → seconds; every other round runs backwards."""
        this_round: dict[str, dict[str, float]] = {}

        def time_one(query: str, name: str) -> None:
            this_round.setdefault(query, {})[name] = seconds(query, name)
            if sum(map(len, this_round.values())) == len(keys):
                times.append(dict(this_round))
                this_round.clear()

        steps = [lambda key=key: compile_kernel(*key) for key in keys]
        for i in range(len(times), number):
            steps += [lambda key=key: time_one(*key) for key in (keys if i % 2 == 0 else reversed(keys))]
        self._each(title, steps)


def _candidates(plan: Plan, data: dict) -> dict:
    """Return the candidates of a result, without those whose jobs have not run yet."""
    candidates = {}
    for c in plan.candidates:
        record = data["jobs"].get(c.job, {})
        if record or not c.job or c.errors is not None:
            candidates[c.name] = {
                **{k: getattr(c, k) for k in ("representation", "setting", "job", "is_truth", "is_reference")},
                **{"competes": c.competes, "label": c.label or c.name, "in_picture": c.in_picture},
                "bytes": record.get("bytes", c.bytes),
                "training_seconds": record.get("seconds"),
                "converged": record.get("converged"),
                "details": {**c.details, **record.get("details", {})},
                "errors": {**record.get("errors", {}), **data["errors"].get(c.name, {})},
            }
    return candidates


def _times(plan: Plan, settings: BenchmarkSettings, case: Case, data: dict) -> dict:
    """Return the times, operations and ratios of a case: queries in ns of a lane, passes in ms."""
    accuracy = case.accuracy or plan.measures[0].key
    measured = {"details": case.details, "in_picture": case.in_picture, "accuracy": accuracy}
    measured |= {"queries": {}, "passes": {}, "ratios": {}}
    for section, scale in (("queries", 1e9 / settings.lanes), ("passes", 1e3)):
        rounds = data[section].get(case.name) or [{}]
        for query, names in rounds[0].items():  # in the order of the plan, which the first round has
            times = {name: [r[query][name] * scale for r in rounds] for name in names}
            floor = spread(times.pop(FLOOR))["median"] if FLOOR in times else 0.0
            measured[section][query] = {name: timing(values, floor) for name, values in times.items()}
            for name, counted in data["operations"][case.name].get(query, {}).items():
                if name in times:
                    measured[section][query][name]["operations"] = counted
            pairs = ((a, b) for a, b in plan.ratios if a in times and b in times)
            measured["ratios"][query] = {f"{a} / {b}": ratio(times[a], times[b], floor) for a, b in pairs}
    return measured
