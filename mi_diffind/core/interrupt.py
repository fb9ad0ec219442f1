"""Ctrl-C that lets a long job finish its step and keep its result so far."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading

#: Events of all contexts that are open, from the outermost to the innermost one.
_open: list[threading.Event] = []


@contextlib.contextmanager
def interruptible():
    """Yield a ``threading.Event`` that the first Ctrl-C sets; a second one raises ``KeyboardInterrupt`` as usual.

    It sets the events of all contexts that are nested. Outside of the main thread, where no signal arrives, the event
    is never set.
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
