"""Threads: as many of Dr.Jit's as Mitsuba needs for files, and turns of Python's: one loads or renders at a time.

In Mitsuba 3.9, two threads that render plugins written in Python end the process or raise errors of Dr.Jit, and so does
a thread that drops a scene while another one renders. Importing this imports neither Dr.Jit nor Mitsuba.
"""

import contextlib
import ctypes
import functools
import os
import sys
import threading

from . import compat
from .compat import dr

#: Least number of threads of a process: with a single one, Mitsuba waits for ever for the content of an EXR file, which
#: its library reads and writes on Dr.Jit's threads beside the calling one.
LEAST_THREADS = 2

#: Environment variable by which processes that this one begins do not say again that there is one core.
ONE_CORE = "MI_DIFFIND_ONE_CORE"


@contextlib.contextmanager
def threads_for_files():
    """Have at least :data:`LEAST_THREADS` in this context, which reads or writes pictures or loads a scene."""
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

    Dr.Jit logs with its lock held. In a thread that loads a scene it would then wait for Python, while the thread that
    runs Python waits for the lock. Without ``jit_set_log_level_stderr(LogLevel)``, messages stay as they are.
    """
    level = dr.log_level()
    if level == dr.LogLevel.Disable:  # already so
        return
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(compat.core_library())["_Z24jit_set_log_level_stderr8LogLevel"](level.value)
        dr.set_log_level(dr.LogLevel.Disable)


#: Held by the thread that loads or renders. A thread that holds it may load and render, as plugins do; threads that
#: Mitsuba starts to load a scene never ask for it.
LOCK = threading.RLock()

#: Scenes that other threads than the main one loaded or rendered, each in a list: they end in somebody's turn.
_scenes: list[list] = []


@contextlib.contextmanager
def turn():
    """Wait until no other thread loads or renders, and end scenes that nobody refers to any more."""
    with LOCK:
        _scenes[:] = [holder for holder in _scenes if compat.is_shared(holder)]
        yield


def _keep(scene):
    if threading.current_thread() is not threading.main_thread() and all(held is not scene for (held,) in _scenes):
        _scenes.append([scene])
    return scene


def in_turn(load):
    """Return a function that loads a scene in its turn."""

    @functools.wraps(load)
    def waiting(*args, **kwargs):
        with turn():
            return _keep(load(*args, **kwargs))

    return waiting


def before_render(callback) -> None:
    """Have ``mi.render`` wait for its turn and call ``callback(scene, integrator, sensor)`` first.

    Mitsuba tells plugins nothing of renders. The function is the same in all variants, under two names; its arguments,
    errors, documentation and signature stay.
    """
    import mitsuba as mi
    from mitsuba.python import util

    render = util.render

    @functools.wraps(render)
    def checked_render(scene, params=None, sensor=0, integrator=None, *args, **kwargs):
        with turn():
            _keep(scene)
            callback(scene, integrator, sensor)
            return render(scene, params, sensor, integrator, *args, **kwargs)

    util.render = mi.render = checked_render
