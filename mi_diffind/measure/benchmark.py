"""Benchmark of a :class:`.study.Plan`: time, memory and operations of each candidate beside its accuracy.

*Time* is that of the kernels alone (:mod:`.clock`). All candidates run in turn, one round of all before the next round,
so that a change of clock rate or of load affects all of them alike; results are medians and quartiles of the rounds.
The *floor* is a kernel with the same inputs and outputs that computes nothing else. It is measured in the same rounds,
shown, and subtracted; a time that is hidden behind the floor is given as a bound (:mod:`.statistics`). A ratio of two
candidates is the median of the ratios of the rounds.
"""

from __future__ import annotations

import functools
import json
import math
import os
import pickle
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
from tqdm import tqdm

from ..core.jobs import run_jobs
from ..core.progress import interruptible
from ..core.runtime import use_variant
from .clock import count_query, machine, timed, total
from .statistics import pareto, ratio, spread, timing
from .store import Store, fingerprint, models_folder, sources
from .study import FLOOR, PASS, Case, Plan, in_competition

#: Times that differ by a smaller factor count as equal on the Pareto front.
SAME_TIME = 1.05

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


@dataclass(frozen=True)
class Workers:
    """Other processes for the jobs of a plan: a number of ``workers``, or those of the Dask cluster ``scheduler``.

    ``plan()`` makes the plan there; it can be pickled.
    """

    plan: Callable[[], Plan]
    workers: int | None = None
    scheduler: str = ""


@functools.lru_cache(maxsize=1)
def _load_plan(plan: bytes) -> Plan:
    return pickle.loads(plan)()


def run_separately(job: tuple[bytes, str, str, str]) -> dict | None:
    """Run a job in this process; ``job``: its pickled plan, its name, the folder of models, and the variant."""
    plan, name, folder, variant = job
    use_variant(variant)
    chosen = next(j for j in _load_plan(plan).jobs if j.name == name)
    return chosen.cached_record(Path(folder), None) or chosen.run(Path(folder), False)


class Stopped(Exception):
    """The first Ctrl-C stopped the measurement."""


def measure(
    plan: Plan,
    settings: BenchmarkSettings,
    folder: str | os.PathLike | None = None,
    progress: bool = True,
    workers: Workers | None = None,
) -> dict:
    """Measure a plan, or the rest of it if ``folder`` holds partial results of an interrupted run.

    ``workers`` do the jobs that are separable; all that is timed runs in this process, one after the other.

    Partial results stay in ``folder`` until :func:`.report.write` has written the result.

    Returns the result, a tree of numbers and strings (JSON): ``task`` (the study), ``interrupted``, ``resumed``,
    ``machine``, ``settings``, ``details``; ``candidates``: name → description and ``errors``; ``cases``: name →
    ``queries``: name → candidate → ``time``, ``q1``, ``q3`` (ns a lane, floor subtracted), ``with_floor``, ``floor``,
    ``rounds``, ``hidden`` (``time`` is only a bound), ``operations``, ``on_front``; ``passes``: candidate → likewise in
    ms; ``ratios``: query → ``"a / b"`` → ``median``, ``q1``, ``q3``, ``with_floor``, ``hidden``; ``jobs``: their
    records. After Ctrl-C the result is incomplete.

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
            steps.jobs(workers)
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
        **_assemble(plan, settings, store.data),
    }


class BenchmarkSteps:
    """The steps of a benchmark; each measures the rest of its part, and raises :class:`Stopped` after Ctrl-C."""

    def __init__(self, plan: Plan, settings: BenchmarkSettings, store: Store, stop: threading.Event, progress: bool):
        self.plan, self.settings, self.store, self.stop, self.progress = plan, settings, store, stop, progress
        self.operations = {c.name: c.operations for c in plan.candidates}

    def _bar(self, title: str, total: int) -> tqdm:
        """Return a progress bar; :meth:`_tick` after each of its steps."""
        disable = None if self.progress else True
        return tqdm(total=total, desc=title, unit="step", smoothing=0.02, disable=disable)

    def _tick(self, bar: tqdm) -> None:
        bar.update(1)
        if self.stop.is_set():
            raise Stopped

    def jobs(self, workers: Workers | None = None) -> None:
        """Run the jobs: with ``workers`` first those that are separable, then the rest, each with a progress bar."""
        plan, done = self.plan, self.store.data["jobs"]
        folder = None
        if self.store.folder is not None and plan.jobs:
            key = f"{plan.jobs_fingerprint} {json.dumps(self.store.key['details'])} {self.settings.quick}"
            folder = models_folder(self.store.folder, plan.study, key)
        if workers is not None and folder is not None:
            self._separate_jobs(workers, folder)
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

    def _separate_jobs(self, workers: Workers, folder: Path) -> None:
        """Have separable jobs run elsewhere. What fails there is left to this process, where its error is raised."""
        done = self.store.data["jobs"]
        plan, path = pickle.dumps(workers.plan), str(folder.resolve())
        todo = {
            job.name: (plan, job.name, path, mi.variant())
            for job in self.plan.jobs
            if job.separable and job.cached_record(folder, done.get(job.name)) is None
        }
        run = (run_separately, todo, workers.workers, workers.scheduler, self.progress, "jobs")
        for outcome in run_jobs(*run, finished=len(self.plan.jobs) - len(todo)) if todo else ():
            if outcome.failure and self.progress:
                print(f"{outcome.name}: {outcome.failure}", file=sys.stderr)
            if outcome.value is not None:
                done[outcome.name] = outcome.value
                self.store.save()
        if self.stop.is_set():
            raise Stopped

    def errors(self) -> None:
        """Measure the errors of the candidates that have a function for them."""
        done = self.store.data["errors"]
        todo = [c for c in self.plan.candidates if c.errors is not None and c.name not in done]
        with self._bar("errors", len(todo)) as bar:
            for candidate in todo:
                done[candidate.name] = candidate.errors(self.settings.samples)
                self.store.save(5)
                self._tick(bar)

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

        def compile_kernel(key) -> None:
            query, name = key
            counted, known = operations.setdefault(query, {}), self.operations.get(name)
            if name not in counted:
                in_kernel = count_query(functions[key])
                counted[name] = (known(query) if known else in_kernel).asdict()

        def seconds(key) -> float:
            return timed(lambda: total(functions[key]())[0]).seconds

        self._rounds(case.name, times, list(functions), self.settings.rounds, compile_kernel, seconds)

    def passes(self, case: Case) -> None:
        """Time whole passes in rounds, after a first pass of each candidate that compiles it."""
        times = self.store.data["passes"].setdefault(case.name, [])
        if len(times) >= self.settings.passes:
            return
        functions = {(PASS, name): f for name, f in case.passes().items() if name in self.operations}

        def seconds(key, number: int | None = None) -> float:
            return timed(lambda: functions[key](1 + len(times) if number is None else number)).seconds

        title = f"{case.name}, {PASS}"
        self._rounds(title, times, list(functions), self.settings.passes, lambda key: seconds(key, 0), seconds)

    def _rounds(self, title: str, times: list, keys: list, number: int, compile_kernel, seconds) -> None:
        """Append the missing rounds to ``times``: query → name → seconds; every other round runs backwards."""
        with self._bar(title, len(keys) * (1 + number - len(times))) as bar:
            for key in keys:
                compile_kernel(key)
                self._tick(bar)
            while len(times) < number:
                this_round: dict[str, dict[str, float]] = {}
                for key in keys if len(times) % 2 == 0 else reversed(keys):
                    this_round.setdefault(key[0], {})[key[1]] = seconds(key)
                    self._tick(bar)
                times.append(this_round)
                self.store.save(5)


def _assemble(plan: Plan, settings: BenchmarkSettings, data: dict) -> dict:
    candidates, records = {}, data["jobs"]
    for c in plan.candidates:
        record = records.get(c.job, {})
        if c.job and not record and c.errors is None:
            continue  # its job has not run yet
        candidates[c.name] = {
            **{k: getattr(c, k) for k in ("representation", "setting", "job", "is_truth", "is_reference", "competes")},
            **{"label": c.label or c.name, "in_picture": c.in_picture},
            "bytes": record.get("bytes", c.bytes),
            "training_seconds": record.get("seconds"),
            "converged": record.get("converged"),
            "details": {**c.details, **record.get("details", {})},
            "errors": {**record.get("errors", {}), **data["errors"].get(c.name, {})},
        }
    measured_cases = {}
    for case in plan.cases:
        rounds, passes = data["queries"].get(case.name, []), data["passes"].get(case.name, [])
        if not rounds:
            continue
        accuracy = case.accuracy or plan.measures[0].key
        measured = {"details": case.details, "in_picture": case.in_picture, "accuracy": accuracy,
                    "of_passes": case.of_passes, "queries": {}, "passes": {}, "ratios": {}}  # fmt: skip
        for query in data["operations"][case.name]:
            ns = _by_name(rounds, query, 1e9 / settings.lanes)
            floor = spread(ns.pop(FLOOR))["median"]
            counted = data["operations"][case.name][query]
            measured["queries"][query] = {
                name: timing(values, floor) | {"operations": counted[name]} for name, values in ns.items()
            }
            _mark_front(measured["queries"][query], candidates, accuracy)
            measured["ratios"][query] = _ratios(plan.ratios, ns, floor)
        if passes:
            ms = _by_name(passes, PASS, 1e3)
            measured["passes"][PASS] = {name: timing(values) for name, values in ms.items()}
            if case.of_passes:
                _mark_front(measured["passes"][PASS], candidates, accuracy)
            measured["ratios"][PASS] = _ratios(plan.ratios, ms, 0.0)
        measured_cases[case.name] = measured
    in_order = {job.name: records[job.name] for job in plan.jobs if job.name in records}
    return {"candidates": candidates, "cases": measured_cases, "jobs": in_order}


def _by_name(rounds: list[dict], query: str, scale: float) -> dict[str, list[float]]:
    """Return the scaled times of all rounds by name, in the order of the plan, which the first round has."""
    return {name: [r[query][name] * scale for r in rounds] for name in rounds[0][query]}


def _mark_front(timings: dict, candidates: dict, accuracy: str) -> None:
    """Set ``on_front``: ``None`` for candidates that do not compete, such as references and the truth."""
    competing = {
        name: (math.log(max(timings[name]["time"], 1e-6)), -c["errors"][accuracy])
        for name, c in candidates.items()
        if name in timings and accuracy in c["errors"] and in_competition(c)
    }
    front = dict(zip(competing, pareto(list(competing.values()), (math.log(SAME_TIME), 0)), strict=True))
    for name in timings:
        timings[name]["on_front"] = front.get(name)


def _ratios(pairs: list[tuple[str, str]], values: dict[str, list[float]], floor: float) -> dict:
    return {f"{a} / {b}": ratio(values[a], values[b], floor) for a, b in pairs if a in values and b in values}
