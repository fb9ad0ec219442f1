"""Time limit of a whole command, shared by its stages. Importing this imports no Dr.Jit."""

from __future__ import annotations

import time
from collections.abc import Callable

from . import compat
from .errors import UsageError

#: Least time that a stage is given, in seconds: a stage that comes too late still takes one step.
LEAST = 1e-3

#: Longest time limit, in seconds: 31 years.
LONGEST = 10**9


class Deadline:
    """Moment at which a command is to be over, ``seconds`` after the deadline was created.

    A training takes the time that is left, a stage before another one a part of it. The reserve is the time of what
    follows the last training, such as the measurement of the result: nobody gets it. Raises
    :class:`.UsageError` for a time that is not positive or longer than :data:`LONGEST`.
    """

    def __init__(self, seconds: float):
        if not 0 < seconds <= LONGEST:
            raise UsageError(f"seconds: found {seconds!s:.40}, allowed are more than 0 and at most {LONGEST:,}")
        self.seconds, self.reserve = seconds, 0.0
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
        return Deadline(share * self.left())

    def rehearse(self, finish: Callable[[], object], times: float = 1.0) -> object:
        """Carry out ``finish``, return its result, and add its duration to the reserve.

        It stands for what follows the last training and takes ``times`` as long.
        """
        result, seconds = duration(finish)
        self.reserve += times * seconds
        return result


def duration(work: Callable[[], object]) -> tuple[object, float]:
    """Carry out ``work``; return its result, and the seconds that another call takes, without compiling kernels."""
    return profiled(work)[:2]


def profiled(work: Callable[[], object]) -> tuple[object, float, list[dict]]:
    """Carry out ``work``; return the result and the seconds of :func:`duration`, and Dr.Jit's kernel history."""
    import drjit as dr

    dr.sync_thread()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        start = time.perf_counter()
        result = work()
        dr.sync_thread()
        seconds = time.perf_counter() - start
        history = dr.kernel_history()
    return result, max(0.0, seconds - compat.compile_seconds(history)), history
