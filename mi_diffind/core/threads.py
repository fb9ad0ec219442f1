"""Threads of Dr.Jit: as many as Mitsuba needs for files, and messages for which no thread waits.

Importing this imports neither Dr.Jit nor Mitsuba.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys

from . import compat

#: Least number of threads of a process: with a single one, Mitsuba waits for ever for the content of an EXR file, which
#: its library reads and writes on Dr.Jit's threads beside the calling one.
LEAST_THREADS = 2

#: Environment variable by which processes that this one begins do not say again that there is one core.
ONE_CORE = "MI_DIFFIND_ONE_CORE"


@contextlib.contextmanager
def threads_for_files():
    """Have at least :data:`LEAST_THREADS` in this context, which reads or writes pictures or loads a scene."""
    import drjit as dr

    before = dr.thread_count()
    compat.use_threads(max(before, LEAST_THREADS))
    try:
        yield
    finally:
        compat.use_threads(before)


def settle() -> None:
    """Set up Dr.Jit, which has just been imported, such that no thread waits for ever.

    Messages do not go through Python (:func:`log_beside_python`). Where the process has one core, Dr.Jit computes on
    :data:`LEAST_THREADS` all the same, and a sentence on standard error says so.
    """
    import drjit as dr

    log_beside_python()
    if dr.thread_count() >= LEAST_THREADS:
        return
    compat.use_threads(LEAST_THREADS)
    if not os.environ.get(ONE_CORE):
        os.environ[ONE_CORE] = "1"
        print(
            "mi_diffind: this process has one core; Dr.Jit uses two threads, since with one, Mitsuba would wait for "
            "ever for EXR files",
            file=sys.stderr,
        )


def log_beside_python() -> None:
    """Have Dr.Jit write its messages to the standard error of the process by itself, and no longer through Python.

    It logs with its lock held, for instance that a kernel cannot be stored on a full disk. In a thread that loads a
    scene it would then wait for Python, while the thread that runs Python waits for the lock. Dr.Jit has no Python
    function for this; where its library lacks ``jit_set_log_level_stderr(LogLevel)``, messages stay as they are.
    """
    import drjit as dr

    level = dr.log_level()
    if level == dr.LogLevel.Disable:  # already so
        return
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(compat.core_library())["_Z24jit_set_log_level_stderr8LogLevel"](level.value)
        dr.set_log_level(dr.LogLevel.Disable)
