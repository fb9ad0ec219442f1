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
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass

import drjit as dr
import mitsuba as mi
from tqdm import tqdm

from ..core.files import writable_folder
from ..core.progress import interruptible
from .clock import count_query, machine, timed, total
from .statistics import finite, ratio, spread, timing
from .store import fingerprint, models_folder, sources
from .study import FLOOR, PASS, Case, Plan


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
    """Measure a plan. Trained models are kept in ``folder``, where the next run finds them.

    Returns the result, a tree of numbers and strings (JSON): ``task`` (the study), ``interrupted``, ``machine``,
    ``settings``, ``details``; ``candidates``: name → description and ``errors``; ``cases``: name → ``queries``: name →
    candidate → ``time``, ``q1``, ``q3`` (ns a lane, floor subtracted), ``with_floor``, ``floor``, ``rounds``,
    ``hidden`` (``time`` is only a bound), ``operations``; ``passes``: candidate → likewise in ms; ``ratios``: query →
    ``"a / b"`` → ``median``, ``q1``, ``q3``; ``jobs``: their records. After Ctrl-C the result is incomplete.

    Raises :class:`.OutputError` if the folder cannot be written.
    """
    interrupted = False
    with interruptible() as stop:
        benchmark = Benchmark(plan, settings, stop, progress)
        try:
            benchmark.run_jobs(folder)
            benchmark.measure_errors()
            for case in plan.cases:
                benchmark.time_queries(case)
                if case.passes is not None:
                    benchmark.time_passes(case)
        except Stopped:
            interrupted = True
    return {
        "task": plan.study,
        "title": plan.title,
        "interrupted": interrupted,
        "machine": machine(mi.variant()),
        "date": time.strftime("%Y-%m-%d"),
        "settings": asdict(settings),
        "measures": [asdict(measure) for measure in plan.measures],
        **{name: getattr(plan, name) for name in ("panels", "details", "notes")},
        "candidates": benchmark.candidates(),
        "cases": {case.name: benchmark.times(case) for case in plan.cases if benchmark.seconds.get(case.name)},
        "jobs": benchmark.records,
    }


class Benchmark:
    """Measurements of a plan; each method that measures raises :class:`Stopped` after Ctrl-C and keeps what it has.

    ``records``: job → record; ``errors``: candidate → errors; ``seconds``: case → query → candidate → seconds of each
    round; ``operations``: case → query → candidate → counts.
    """

    def __init__(self, plan: Plan, settings: BenchmarkSettings, stop: threading.Event, progress: bool):
        self.plan, self.settings, self.stop, self.progress = plan, settings, stop, progress
        self.records: dict[str, dict] = {}
        self.errors: dict[str, dict[str, float]] = {}
        self.seconds: dict[str, dict[str, dict[str, list[float]]]] = {}
        self.operations: dict[str, dict[str, dict[str, dict]]] = {}

    def _each(self, title: str, items: Iterable) -> Iterator:
        """Yield items with a progress bar; raise :class:`Stopped` after the one during which Ctrl-C was pressed."""
        for item in tqdm(items, title, unit="step", smoothing=0.02, disable=None if self.progress else True):
            yield item
            if self.stop.is_set():
                raise Stopped

    def run_jobs(self, folder: str | os.PathLike | None) -> None:
        """Run the jobs whose records are not in ``folder``, each with a progress bar of its own."""
        plan = self.plan
        if folder is not None:
            folder = writable_folder(folder, create=True)
            details = json.dumps(finite(plan.details))
            key = f"{fingerprint(sources())} {plan.jobs_fingerprint} {details} {self.settings.quick}"
            folder = models_folder(folder, plan.study, key) if plan.jobs else None
        for i, job in enumerate(plan.jobs):
            record = job.cached_record(folder)
            if record is None:
                if self.progress:
                    print(f"{i + 1} of {len(plan.jobs)}: {job.name}", file=sys.stderr)
                record = job.run(folder, self.progress)
            if record is not None:
                self.records[job.name] = record
            if record is None or self.stop.is_set():
                raise Stopped

    def measure_errors(self) -> None:
        """Measure the errors of the candidates that have a function for them."""
        for c in self._each("errors", [c for c in self.plan.candidates if c.errors is not None]):
            self.errors[c.name] = c.errors(self.settings.samples)

    def time_queries(self, case: Case) -> None:
        """Time the queries in rounds, and count their operations in the round before, which compiles the kernels."""
        stated = {c.name: c.operations for c in self.plan.candidates}
        functions = {
            (query, name): function
            for query, by_name in case.queries(self.settings.lanes).items()
            for name, function in by_name.items()
            if name == FLOOR or name in stated
        }
        operations = self.operations.setdefault(case.name, {})

        def seconds(query: str, name: str, i: int) -> float:
            function, known = functions[query, name], stated.get(name)
            if i == 0:
                in_kernel = count_query(function)
                operations.setdefault(query, {})[name] = (known(query) if known else in_kernel).asdict()
                return 0.0
            return timed(lambda: total(function())[0])

        self._time(case, case.name, list(functions), self.settings.rounds, seconds)

    def time_passes(self, case: Case) -> None:
        """Time whole passes in rounds; the pass before compiles the kernels."""
        names = {c.name for c in self.plan.candidates}
        passes = {name: function for name, function in case.passes().items() if name in names}
        keys, title = [(PASS, name) for name in passes], f"{case.name}, {PASS}"
        self._time(case, title, keys, self.settings.passes, lambda _, name, i: timed(lambda: passes[name](i)))

    def _time(
        self, case: Case, title: str, keys: list[tuple[str, str]], rounds: int,
        seconds: Callable[[str, str, int], float],
    ) -> None:  # fmt: skip
        """Time each query of each candidate, the ``keys``, in each round; every other round runs backwards.

        ``seconds(query, name, i)`` is called for round 0, too, which does not count. Nor does an interrupted round.
        """
        turns = [(i, *key) for i in range(rounds + 1) for key in (keys[::-1] if i and i % 2 == 0 else keys)]
        of_case, this_round = self.seconds.setdefault(case.name, {}), {}
        for i, query, name in self._each(title, turns):
            this_round[query, name] = seconds(query, name, i)
            if len(this_round) == len(keys):
                for (query, name), value in this_round.items() if i else ():
                    of_case.setdefault(query, {}).setdefault(name, []).append(value)
                this_round = {}

    def candidates(self) -> dict:
        """Return the candidates for the result, without those whose jobs have not run yet."""
        candidates = {}
        for c in self.plan.candidates:
            record = self.records.get(c.job, {})
            if record or not c.job or c.errors is not None:
                candidates[c.name] = {
                    **{k: getattr(c, k) for k in ("representation", "setting", "job", "is_truth", "is_reference")},
                    **{"competes": c.competes, "label": c.label or c.name, "in_picture": c.in_picture},
                    "bytes": record.get("bytes", c.bytes),
                    "training_seconds": record.get("seconds"),
                    "converged": record.get("converged"),
                    "details": {**c.details, **record.get("details", {})},
                    "errors": {**record.get("errors", {}), **self.errors.get(c.name, {})},
                }
        return candidates

    def times(self, case: Case) -> dict:
        """Return the times, operations and ratios of a case: queries in ns of a lane, passes in ms."""
        measured = {"details": case.details, "in_picture": case.in_picture}
        measured |= {"accuracy": case.accuracy or self.plan.measures[0].key, "queries": {}, "passes": {}, "ratios": {}}
        for query, seconds in self.seconds[case.name].items():
            section, scale = ("passes", 1e3) if query == PASS else ("queries", 1e9 / self.settings.lanes)
            times = {name: [scale * s for s in values] for name, values in seconds.items()}
            floor = spread(times.pop(FLOOR))["median"] if FLOOR in times else 0.0
            timings = measured[section][query] = {name: timing(values, floor) for name, values in times.items()}
            for name, counted in self.operations[case.name].get(query, {}).items():
                if name in timings:
                    timings[name]["operations"] = counted
            pairs = ((a, b) for a, b in self.plan.ratios if a in times and b in times)
            measured["ratios"][query] = {f"{a} / {b}": ratio(times[a], times[b], floor) for a, b in pairs}
        return measured
