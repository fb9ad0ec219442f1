"""Ctrl-C that lets a long job finish its step and keep its result so far."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading


@contextlib.contextmanager
def interruptible():
    """Yield a ``threading.Event`` that the first Ctrl-C sets; a second one raises ``KeyboardInterrupt`` as usual.

    Outside of the main thread, where no signal arrives, the event is never set.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = signal.getsignal(signal.SIGINT)

    def handler(signum, frame):
        stop.set()
        print("stopping after this step; Ctrl-C again aborts", file=sys.stderr)
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, handler)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)
