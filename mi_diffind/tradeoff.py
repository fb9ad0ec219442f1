"""
What a representation costs and what it gives: time, memory and operations of each candidate beside its accuracy.

This is the frame; what fills it in for a task is a :class:`Study` (:mod:`mi_diffind.tradeoffs`): candidates, each a
representation at a setting, and cases, each a situation in which all of them are timed.

*Time* is that of the kernels alone, as Dr.Jit's own clock has it: tracing, code generation and compilation are left
out. All candidates run in turn, one round of all before the next of any, so that a change of clock or of load hits
all of them alike; given are medians and quartiles of the rounds. The *floor* is a kernel with the same inputs and
outputs that computes nothing else: it is measured likewise, shown, and subtracted. Where a ratio of two candidates is
given, it is the median of the ratios of the rounds. No derivatives are asked for.

A long run can be interrupted at any time: what is done is kept in the output folder, and the same command goes on from
there, as long as settings, versions, machine and sources are the same.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import platform
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path

import drjit as dr
import numpy as np
from tqdm import tqdm

from .convergence import Training, folder_for
from .files import writable_folder, write_json
from .interrupt import interruptible
from .operations import Operations, count

#: The name under which a case has its floor.
FLOOR = "floor"

#: What a whole pass is called where the names of queries stand: kernels alone, and everything.
PASS, PASS_WALL = "render", "render, with tracing"

#: Times that differ by a smaller factor count as equal: less is noise, and not worth an error.
SAME_TIME = 1.05

#: What takes less than this part of the floor beyond it is hidden behind input and output: no ratio is made of it.
HIDDEN = 0.2

#: The file that keeps what has been measured, until the result is written.
PARTIAL = "tradeoff_{}.partial.json"

#: A function whose result, any tree of arrays, is evaluated to measure it.
Query = Callable[[], object]


@dataclass(frozen=True)
class Settings:
    """
    How much is measured: ``lanes`` of a kernel, ``rounds`` of the queries, ``passes`` of whole jobs, ``samples`` for
    the errors.
    """

    lanes: int
    rounds: int = 31
    passes: int = 9
    samples: int = 10**6
    quick: bool = False

    @classmethod
    def choose(cls, variant: str, quick: bool = False) -> Settings:
        """For this machine: enough lanes that each core, or the GPU, gets several blocks of them."""
        blocks = 2 ** math.ceil(math.log2(max(dr.thread_count(), 2)))
        lanes = 2**22 if variant.startswith("cuda") else blocks * 2**16
        return cls(lanes // 4, 3, 2, 2**17, True) if quick else cls(lanes)


@dataclass
class Candidate:
    """
    A representation at a setting.

    ``errors(samples)`` measures it against the truth; missing, it has no errors: it is the truth itself
    (``is_truth``), or it computes something else, as ``note`` should say. ``is_reference``: it is not in competition,
    but what the others are compared with; so is the truth. ``bytes`` and ``training_seconds`` (``None``: not known)
    are what it takes beside time.
    """

    name: str
    representation: str
    setting: str = ""
    bytes: int = 0
    training_seconds: float | None = 0.0
    errors: Callable[[int], dict[str, float]] | None = None
    is_truth: bool = False
    is_reference: bool = False
    in_passes: bool = True
    note: str = ""
    label: str = ""
    training: str = ""
    operations: Callable[[str], Operations] | None = None


@dataclass
class Case:
    """
    A situation. ``queries(lanes)`` maps the name of each query to the names of all candidates and :data:`FLOOR`, and
    these to functions; ``passes()``, if there are any, maps candidates (those with ``in_passes``) to functions of the
    number of the pass, which do one pass of a whole job. Both are called when they are needed. ``candidates`` are the
    names of those that take part (default: all), ``query_names`` those of its queries (default: the study's);
    ``in_picture``: it has a panel.
    """

    name: str
    queries: Callable[[int], dict[str, dict[str, Query]]]
    passes: Callable[[], dict[str, Callable[[int], object]]] | None = None
    about: dict = field(default_factory=dict)
    candidates: tuple[str, ...] | None = None
    query_names: tuple[str, ...] | None = None
    in_picture: bool = True


@dataclass
class Study:
    """
    What a task measures.

    ``accuracy`` names the error that pictures show and the Pareto front is made with, one that is larger for better
    candidates, as a PSNR is. ``ratios`` are pairs of candidates. ``fingerprint`` tells whether what is measured is
    still the same. ``conclusions(result)`` are lines to print below the tables, ``about`` what to keep with them.
    ``trainings`` are done first, unless their results are at hand, made by the same ``training_fingerprint``;
    ``bytes_in_picture``: accuracy is also drawn against bytes.
    """

    task: str
    title: str
    candidates: list[Candidate]
    cases: list[Case]
    queries: tuple[str, ...]
    accuracy: str
    accuracy_label: str
    ratios: list[tuple[str, str]] = field(default_factory=list)
    fingerprint: str = ""
    variant: str = ""
    about: dict = field(default_factory=dict)
    conclusions: Callable[[dict], list[str]] = lambda result: []
    trainings: list[Training] = field(default_factory=list)
    training_fingerprint: str = ""
    bytes_in_picture: bool = False

    def names(self, case: Case, in_passes: bool = False) -> list[str]:
        """The candidates that take part in a case."""
        found = [c for c in self.candidates if case.candidates is None or c.name in case.candidates]
        return [c.name for c in found if c.in_passes or not in_passes]

    def queries_of(self, case: Case) -> tuple[str, ...]:
        """The queries of a case."""
        return case.query_names or self.queries


# -- measuring --------------------------------------------------------------------------------------------------------


def kernel_seconds(function: Query) -> float:
    """Seconds that the kernels take which ``function()`` and the evaluation of its result launch."""
    with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.sync_thread()
        dr.kernel_history_clear()
        dr.eval(function())
        dr.sync_thread()
        return sum(entry["execution_time"] for entry in dr.kernel_history()) / 1e3


def total(values) -> tuple[object, int]:
    """
    The sum of all numbers in a tree of arrays, and how many additions it is: little output, and the same for all.
    """
    leaves = list(_leaves(values))
    result = leaves[0]
    for leaf in leaves[1:]:
        result = result + leaf
    return result, len(leaves) - 1


def _leaves(values):
    if isinstance(values, (list, tuple)) or dr.depth_v(values) > 1:
        for value in values:
            yield from _leaves(value)
    else:
        yield values if dr.is_float_v(values) else dr.float32_array_t(type(values))(values)


def count_query(function: Query) -> Operations:
    """The operations of a query, without the additions of :func:`total`."""
    with dr.suspend_grad():
        added = 0

        def summed():
            nonlocal added
            result, added = total(function())
            return result

        found = count(summed)
    return found + Operations(add=-added, instructions=-added)


def spread(values: Iterable[float]) -> dict[str, float]:
    """Median and quartiles of the finite ones among ``values``: ``median``, ``q1``, ``q3``, NaN if there are none."""
    values = [v for v in values if math.isfinite(v)]
    q1, median, q3 = np.percentile(values, [25, 50, 75]) if values else [math.nan] * 3
    return {"median": float(median), "q1": float(q1), "q3": float(q3)}


def pareto(points: Sequence[Sequence[float]], slack: Sequence[float] | float = 0.0) -> list[bool]:
    """
    Which ``points`` are on the Pareto front, all coordinates being better when smaller: those that no other point
    beats in one coordinate without being beaten in another. Coordinates that differ by no more than ``slack`` (for
    each, or for all) are equal, and equal points share their fate; a point with a NaN is not on the front.
    """
    p = np.asarray(points, dtype=np.float64)
    if p.size == 0:
        return [False] * len(p)
    slack = np.asarray(slack)
    front = []
    for point in p:
        beaten = (p <= point + slack).all(axis=1) & (p < point - slack).any(axis=1)
        front.append(not np.isnan(point).any() and not beaten.any())
    return front


def machine(variant: str) -> dict:
    """The machine and the versions that figures are quoted with."""
    cpu = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
        cpu = found[1].strip() if found else cpu
    gpu = None
    for path in Path("/proc/driver/nvidia/gpus").glob("*/information"):
        with contextlib.suppress(OSError):
            found = re.search(r"^Model:\s*(.+)$", path.read_text(encoding="utf-8"), re.MULTILINE)
            gpu = found[1].strip() if found else gpu
    return {
        "cpu": cpu,
        "instructions": _target() if variant.startswith("llvm") else None,
        "cores": dr.thread_count(),
        "gpu": gpu,
        "variant": variant,
        "llvm": ".".join(map(str, dr.detail.llvm_version())) if variant.startswith("llvm") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in ("mitsuba", "drjit", "numpy", "mi-diffind")},
    }


def _target() -> str | None:
    """The processor that Dr.Jit compiles for on the CPU, as LLVM calls it, and its vector width."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        dr.eval(dr.arange(dr.llvm.Float, 64) + 0.5)
        text = "".join(entry["ir"].getvalue() for entry in dr.kernel_history([dr.KernelType.JIT]))
    name, width = re.search(r'"target-cpu"="([^"]+)"', text), re.search(r"<(\d+) x float>", text)
    return f"{name[1]}, {width[1]} lanes a vector" if name and width else None


class _Stopped(Exception):
    """The first Ctrl-C has been seen."""


class _Run:
    """The state of a run, kept in a file if there is a folder: what has been measured, under a key."""

    SECTIONS = ("trainings", "errors", "operations", "queries", "passes")

    def __init__(self, key: dict, folder: Path | None, task: str):
        self.key = json.loads(json.dumps(key))
        self.path = None if folder is None else folder / PARTIAL.format(task)
        self.data: dict[str, dict] = {name: {} for name in self.SECTIONS}
        self.resumed = self.discarded = False
        self._saved = time.monotonic()
        if self.path is not None and self.path.is_file():
            self.discarded = True
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                found = json.loads(self.path.read_text(encoding="utf-8"))
                if found["key"] == self.key and set(found["data"]) == set(self.SECTIONS):
                    self.data, self.resumed, self.discarded = found["data"], True, False

    def save(self, every: float = 0.0) -> None:
        """Write the state, unless that was done less than ``every`` seconds ago."""
        if self.path is not None and time.monotonic() - self._saved >= every:
            write_json(self.path, {"key": self.key, "data": self.data})
            self._saved = time.monotonic()


def measure(study: Study, settings: Settings, folder: str | os.PathLike | None = None, progress: bool = True) -> dict:
    """
    Measure everything that ``study`` asks for, or what is missing of it, if ``folder`` holds an interrupted run. What
    is measured stays there until :func:`.report.write` has written the result.

    Returns the result, a tree of numbers and strings (JSON): ``task``, ``interrupted``, ``resumed``, ``machine``,
    ``settings``, ``about``; ``candidates``: name → what it is and its ``errors``; ``cases``: name → ``queries``: name →
    candidate → ``time``, ``q1``, ``q3`` (ns a lane, floor subtracted), ``with_floor``, ``floor``, ``rounds``,
    ``operations``, ``on_front``; ``passes``: candidate → likewise in ms; ``ratios``: query → ``"a / b"`` → ``median``,
    ``q1``, ``q3``, ``with_floor``. After Ctrl-C it is what there is up to then.

    Raises :class:`~mi_diffind.files.OutputError` if the folder cannot be written.
    """
    folder = None if folder is None else writable_folder(folder, create=True)
    about_machine = machine(study.variant)
    key = {
        "task": study.task,
        "settings": asdict(settings),
        "machine": about_machine,
        "fingerprint": study.fingerprint,
        "candidates": [c.name for c in study.candidates],
        "cases": [c.name for c in study.cases],
    }
    run = _Run(key, folder, study.task)
    if progress and run.resumed:
        print(f"going on from {run.path}", file=sys.stderr)
    if progress and run.discarded:
        print(f"{run.path} is of other settings, versions or sources: starting anew", file=sys.stderr)
    interrupted = not _train(study, run, folder, progress)
    units = sum(c.errors is not None for c in study.candidates)
    for case in study.cases:
        units += len(study.queries_of(case)) * (len(study.names(case)) + 1) * (1 + settings.rounds)
        units += len(study.names(case, True)) * (1 + settings.passes) if case.passes is not None else 0
    hidden = True if interrupted or not progress else None
    bar = tqdm(total=units, desc="measure", unit="step", smoothing=0.02, disable=hidden)
    with interruptible() as stop, bar:
        steps = _Steps(study, settings, run, bar, stop)
        try:
            if interrupted:
                raise _Stopped
            steps.errors()
            for case in study.cases:
                steps.queries(case)
                if case.passes is not None:
                    steps.passes(case)
        except _Stopped:
            interrupted = True
        finally:
            run.save()
    result = _assemble(study, settings, run.data)
    result = {
        "task": study.task,
        "title": study.title,
        "interrupted": interrupted,
        "resumed": run.resumed,
        "machine": about_machine,
        "date": time.strftime("%Y-%m-%d"),
        "settings": asdict(settings),
        "accuracy": study.accuracy,
        "accuracy_label": study.accuracy_label,
        "bytes_in_picture": study.bytes_in_picture,
        "about": study.about,
        **result,
    }
    result["conclusions"] = study.conclusions(result)
    return result


def _train(study: Study, run: _Run, folder: Path | None, progress: bool) -> bool:
    """Do the trainings, each in its own progress bar; false if there was a Ctrl-C."""
    models = None
    if folder is not None and study.trainings:
        models = folder_for(folder, study.task, study.training_fingerprint)
    for i, training in enumerate(study.trainings):
        if progress:
            print(f"training {i + 1} of {len(study.trainings)}: {training.name}", file=sys.stderr)
        record = training.run(models, progress)
        if record is None:
            return False
        run.data["trainings"][training.name] = record
    return True


class _Steps:
    """The steps of a run; each does what is missing, and raises :class:`_Stopped` where it may be left off."""

    def __init__(self, study: Study, settings: Settings, run: _Run, bar: tqdm, stop: threading.Event):
        self.study, self.settings, self.run, self.bar, self.stop = study, settings, run, bar, stop

    def _tick(self) -> None:
        self.bar.update(1)
        if self.stop.is_set():
            raise _Stopped

    def errors(self) -> None:
        done = self.run.data["errors"]
        for candidate in self.study.candidates:
            if candidate.errors is None:
                continue
            if candidate.name not in done:
                done[candidate.name] = candidate.errors(self.settings.samples)
                self.run.save(5)
            self._tick()

    def queries(self, case: Case) -> None:
        """Count, which compiles, then time in rounds."""
        names, queries = self.study.names(case), self.study.queries_of(case)
        own = {c.name: c.operations for c in self.study.candidates}
        operations = self.run.data["operations"].setdefault(case.name, {})
        times = self.run.data["queries"].setdefault(case.name, [])
        kernels = len(queries) * (len(names) + 1)
        if len(times) >= self.settings.rounds:
            self.bar.update(kernels * (1 + self.settings.rounds))
            return
        functions = case.queries(self.settings.lanes)
        flat = {(q, c): functions[q][c] for q in queries for c in (FLOOR, *names)}
        for (query, name), function in flat.items():
            counted = operations.setdefault(query, {})
            if name not in counted:
                found = count_query(function)
                counted[name] = (own[name](query) if own.get(name) else found).asdict()
            self._tick()
        self.bar.update(kernels * len(times))
        while len(times) < self.settings.rounds:
            found = {}
            order = list(flat) if len(times) % 2 == 0 else list(reversed(flat))
            for query, name in order:
                function = flat[query, name]
                found.setdefault(query, {})[name] = kernel_seconds(lambda f=function: total(f())[0])
                self._tick()
            times.append(found)
            self.run.save(5)

    def passes(self, case: Case) -> None:
        names = self.study.names(case, True)
        times = self.run.data["passes"].setdefault(case.name, [])
        if len(times) >= self.settings.passes:
            self.bar.update(len(names) * (1 + self.settings.passes))
            return
        functions = case.passes()
        for name in names:
            _pass_seconds(functions[name], 0)
            self._tick()
        self.bar.update(len(names) * len(times))
        while len(times) < self.settings.passes:
            found, seed = {}, 1 + len(times)
            for name in names if seed % 2 else reversed(names):
                found[name] = _pass_seconds(functions[name], seed)
                self._tick()
            times.append(found)
            self.run.save(5)


def _pass_seconds(function: Callable[[int], object], number: int) -> dict[str, float]:
    """Seconds of one pass: of its kernels, and from beginning to end."""
    start = time.perf_counter()
    kernels = kernel_seconds(lambda: function(number))
    return {PASS: kernels, PASS_WALL: time.perf_counter() - start}


# -- the result -------------------------------------------------------------------------------------------------------


def _assemble(study: Study, settings: Settings, data: dict) -> dict:
    candidates, trainings = {}, data["trainings"]
    for c in study.candidates:
        trained = trainings.get(c.training, {})
        candidates[c.name] = {
            "representation": c.representation,
            "setting": c.setting,
            "label": c.label or c.name,
            "bytes": c.bytes,
            "training": c.training,
            "training_seconds": trained.get("seconds") if c.training else c.training_seconds,
            "converged": trained.get("converged") if c.training else None,
            "is_truth": c.is_truth,
            "is_reference": c.is_reference,
            "note": c.note,
            "errors": data["errors"].get(c.name, {}),
        }
    cases = {}
    for case in study.cases:
        rounds, passes = data["queries"].get(case.name, []), data["passes"].get(case.name, [])
        if not rounds:
            continue
        found = {"about": case.about, "in_picture": case.in_picture, "queries": {}, "passes": {}, "ratios": {}}
        for query in study.queries_of(case):
            seconds = {name: [r[query][name] for r in rounds] for name in rounds[0][query]}
            ns = {name: [t * 1e9 / settings.lanes for t in times] for name, times in seconds.items()}
            floor = spread(ns.pop(FLOOR))["median"]
            found["queries"][query] = {
                name: _timing(times, floor) | {"operations": data["operations"][case.name][query][name]}
                for name, times in ns.items()
            }
            _mark_front(found["queries"][query], candidates, study.accuracy)
            found["ratios"][query] = _ratios(study.ratios, ns, floor)
        for kind in (PASS, PASS_WALL) if passes else ():
            ms = {name: [r[name][kind] * 1e3 for r in passes] for name in passes[0]}
            found["passes"][kind] = {name: _timing(times) for name, times in ms.items()}
            found["ratios"][kind] = _ratios(study.ratios, ms, 0.0)
        cases[case.name] = found
    return {"candidates": candidates, "cases": cases, "trainings": trainings}


def _timing(values: list[float], floor: float = 0.0) -> dict:
    s = spread(values)
    return {
        "time": s["median"] - floor,
        "q1": s["q1"] - floor,
        "q3": s["q3"] - floor,
        "with_floor": s["median"],
        "floor": floor,
        "rounds": len(values),
    }


def _mark_front(timings: dict, candidates: dict, accuracy: str) -> None:
    """Set ``on_front``, ``None`` for references and the truth, which are not in competition."""
    competing = {
        name: (math.log(max(timings[name]["time"], 1e-6)), -c["errors"][accuracy])
        for name, c in candidates.items()
        if name in timings and accuracy in c["errors"] and not c["is_reference"] and not c["is_truth"]
    }
    front = dict(zip(competing, pareto(list(competing.values()), (math.log(SAME_TIME), 0)), strict=True))
    for name in timings:
        timings[name]["on_front"] = front.get(name)


def _ratios(pairs: list[tuple[str, str]], values: dict[str, list[float]], floor: float) -> dict:
    found = {}
    for a, b in pairs:
        if a in values and b in values:
            both = list(zip(values[a], values[b], strict=True))
            hidden = spread(values[b])["median"] < (1 + HIDDEN) * floor
            found[f"{a} / {b}"] = {
                **spread(math.nan if hidden or y <= floor else (x - floor) / (y - floor) for x, y in both),
                "with_floor": spread(x / y if y > 0 else math.nan for x, y in both)["median"],
            }
    return found


def fingerprint(paths: Iterable[str | os.PathLike]) -> str:
    """A hash of the contents of files, which tells whether a measurement can be gone on with."""
    digest = hashlib.sha256()
    for path in sorted(map(str, paths)):
        digest.update(Path(path).name.encode() + b"\0" + Path(path).read_bytes() + b"\0")
    return digest.hexdigest()[:16]
