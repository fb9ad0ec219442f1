"""Loads and renders of Python threads, one after the other.

In Mitsuba 3.9, two threads that render plugins written in Python end the process or raise errors of Dr.Jit, and so does
a thread that drops a scene while another one renders.
"""

from __future__ import annotations

import contextlib
import functools
import threading

from . import compat

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
    """Have ``mi.render`` wait for its turn and call ``callback(scene, integrator, sensor)`` first, as it was called.

    Mitsuba tells plugins nothing of renders: scenes, sensors and shapes have no method in Python that one calls. The
    function is the same in all variants, under two names. It stays as it is for everything else: its arguments, errors,
    documentation and signature.
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
