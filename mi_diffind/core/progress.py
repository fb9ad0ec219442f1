"""Progress, interruption and time limit of long runs. Importing this imports no Dr.Jit and no tqdm."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable

from . import compat
from .compat import dr
from .errors import UsageError

#: Seconds between two lines where stderr is no terminal; shorter jobs say nothing.
EVERY = 10.0

#: Least time that a stage is given, in seconds: a stage that comes too late still takes one step.
LEAST = 1e-3

#: Longest time limit, in seconds: 31 years.
LONGEST = 10**9

#: Events of all contexts of :func:`interruptible` that are open, from the outermost to the innermost one.
_open: list[threading.Event] = []


class _Lines:
    """Text file for a progress bar that writes each state as a line of text."""

    def __init__(self, stream):
        self.stream = stream

    def write(self, text: str) -> None:
        if text := text.strip():
            self.stream.write(f"{text}\n")

    def flush(self) -> None:
        self.stream.flush()


def in_terminal() -> bool:
    """Return whether stderr is a terminal, where a bar can be redrawn."""
    return hasattr(sys.stderr, "isatty") and sys.stderr.isatty()


def progress_bar(
    title: str | None, total: float, unit: str = "pass", progress: bool = True, initial: int = 0, line: str = "",
    **options,
):  # fmt: skip
    """Return a progress bar (``tqdm``) on stderr; without ``progress`` it stays hidden.

    Where stderr is no terminal, each state is a line of text, written every :data:`EVERY` seconds. ``line`` is its
    format (``bar_format`` of ``tqdm``); ``options`` are those of ``tqdm`` in a terminal.
    """
    from tqdm import tqdm

    if progress and not in_terminal():
        line = line or "{n_fmt} of {total_fmt} {unit}, {elapsed} so far, {remaining} left{postfix}"
        line = f"{title}: {line}" if title else line
        options = {"mininterval": EVERY, "delay": EVERY, "bar_format": line, "file": _Lines(sys.stderr)}
    return tqdm(total=total, initial=initial, desc=title, unit=unit, disable=not progress, **options)


@contextlib.contextmanager
def interruptible():
    """Yield a ``threading.Event`` that the first Ctrl-C sets; a second one raises ``KeyboardInterrupt`` as usual.

    The first Ctrl-C sets the events of all contexts that are nested. Outside of the main thread, where no signal
    arrives, the event is never set.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.getsignal(signal.SIGINT)
    outermost = not _open

    def handler(signum, frame):
        for event in _open:
            event.set()
        print("stopping after this step; Ctrl-C again aborts", file=sys.stderr)
        signal.signal(signal.SIGINT, before)

    _open.append(stop)
    try:
        if outermost:
            signal.signal(signal.SIGINT, handler)
        yield stop
    finally:
        _open.remove(stop)
        if outermost:
            signal.signal(signal.SIGINT, before)


class Deadline:
    """Moment at which a command is to be over, ``seconds`` after the deadline was created.

    A training takes the time that is left, a stage before another one a part of it. The reserve is the time of what
    follows the last training, such as the measurement of the result: no training gets it. ``total`` are the seconds of
    the whole command, for the deadline of a part, too. Raises :class:`.UsageError` for a time that is not positive or
    longer than :data:`LONGEST`.
    """

    def __init__(self, seconds: float, total: float | None = None):
        if not 0 < seconds <= LONGEST:
            raise UsageError(f"seconds: found {seconds!s:.40}, allowed are more than 0 and at most {LONGEST:,}")
        self.seconds, self.total, self.reserve = seconds, total or seconds, 0.0
        self.end = time.perf_counter() + seconds

    def spent(self) -> float:
        """Return the seconds since the deadline was created."""
        return time.perf_counter() - self.end + self.seconds

    def left(self) -> float:
        """Return the seconds that are left for trainings, at least :data:`LEAST`."""
        return max(LEAST, self.end - time.perf_counter() - self.reserve)

    @property
    def passed(self) -> bool:
        """True if no time is left for trainings."""
        return self.left() <= LEAST

    def part(self, share: float) -> Deadline:
        """Return the deadline of a stage that takes a ``share`` of the seconds that are left."""
        return Deadline(share * self.left(), self.total)

    def rehearse(self, finish: Callable[[], object], times: float = 1.0) -> object:
        """Carry out ``finish``, return its result, and add its duration to the reserve.

        The call stands for what follows the last training and takes ``times`` as long.
        """
        result, seconds = duration(finish)
        self.reserve += times * seconds
        return result


def duration(work: Callable[[], object]) -> tuple[object, float]:
    """Carry out ``work``; return its result, and the seconds that another call takes, without compiling kernels."""
    return profiled(work)[:2]


def profiled(work: Callable[[], object]) -> tuple[object, float, list[dict]]:
    """Carry out ``work``; return the result and the seconds of :func:`duration`, and Dr.Jit's kernel history."""
    dr.sync_thread()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        start = time.perf_counter()
        result = work()
        dr.sync_thread()
        seconds = time.perf_counter() - start
        history = dr.kernel_history()
    return result, max(0.0, seconds - compat.compile_seconds(history)), history
