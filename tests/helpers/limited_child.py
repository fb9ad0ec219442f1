"""A child process with limits of memory and time, which answers one request after the other.

A request names a function of :mod:`hostile_probes` and its arguments. A crash, a hang or a lack of memory costs the
child alone: the answer says so, and the next request starts another child.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import resource
import signal
import sys
import tempfile
import time
import traceback
from pathlib import Path

#: Outcomes of a request that are as they should be.
GOOD = ("refused", "loaded")

#: Outcomes that are faults.
FAULTS = ("sentence", "traceback", "silent", "nonfinite", "out of bounds", "memory", "crash", "hang")

#: Address space beyond that of the started child, in bytes.
ROOM = 3 << 30

#: Longest sentence, in characters.
LONGEST = 300


class Fault(Exception):
    """A fault that a probe found: outcome and message."""


class LimitedChild:
    """A child process in ``folder``, started by the first request, and again after a request that ended it.

    ``busy`` are the seconds of processor time of a request, which do not depend on what else the machine does, ``idle``
    those of the clock; ``probes`` is the module of the functions that requests name.
    """

    def __init__(self, folder: Path, busy: int = 20, idle: float = 300, probes: str = "hostile_probes"):
        self.folder, self.busy, self.idle, self.probes = Path(folder), busy, idle, probes
        self.process = None
        self.starts = 0

    def __enter__(self) -> LimitedChild:
        return self

    def __exit__(self, *_) -> None:
        """End the child."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.pipe.close()
            self.process = None

    def start(self) -> None:
        """Start the child and wait until Mitsuba is ready."""
        context = multiprocessing.get_context("spawn")
        self.pipe, other = context.Pipe()
        self.process = context.Process(target=serve, args=(other, str(self.folder), self.busy, self.probes))
        self.process.start()
        other.close()
        self.starts += 1
        answer = self._answer()
        if answer["outcome"] != "ready":
            raise RuntimeError(f"the child did not start: {answer}")

    def check(self, probe: str, **arguments) -> dict:
        """Return the answer to a request: ``outcome`` (:data:`GOOD` or :data:`FAULTS`), ``message`` and figures."""
        if self.process is None:
            self.start()
        with contextlib.suppress(OSError):  # it has ended
            self.pipe.send((probe, arguments))
        return self._answer()

    def _answer(self) -> dict:
        try:
            if self.pipe.poll(self.idle):
                return self.pipe.recv()
            self.process.kill()
            ended = {"outcome": "hang", "message": f"no answer after {self.idle} s"}
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode
            name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            ended = {"outcome": "hang" if name == "SIGXCPU" else "crash", "message": name}
        self.__exit__()
        return ended


# -- the child ---------------------------------------------------------------------------------------------------------


def status(key: str) -> int:
    """Return a number of bytes in ``/proc/self/status``, such as ``VmHWM``, the largest use of memory."""
    text = Path("/proc/self/status").read_text()
    return 1024 * int(text.partition(f"{key}:")[2].split()[0])


def fault_of_sentence(message: str) -> str:
    """Return what is wrong with a sentence for a user, "" if nothing is."""
    if len(message) > LONGEST:
        return f"{len(message)} characters"
    if not message.isprintable():
        return "control characters"
    return "" if message.strip() else "empty"


def answer_to(function, arguments: dict, log) -> dict:
    """Return the answer to one request; ``log`` is the file of all that the process prints."""
    from mi_diffind.core.errors import DiffindError

    log.seek(0)
    log.truncate()
    figures = {}
    try:
        figures, outcome, message = function(**arguments) or {}, "loaded", ""
    except Fault as e:
        outcome, message = e.args
    except DiffindError as e:
        fault = fault_of_sentence(str(e))
        outcome, message = ("sentence", f"{fault}: {e}") if fault else ("refused", str(e))
    except MemoryError as e:
        outcome, message = "memory", f"MemoryError: {e}"
    except Exception as e:
        place = traceback.extract_tb(e.__traceback__)[-1]
        outcome, message = "traceback", f"{type(e).__name__}: {e} ({Path(place.filename).name}:{place.lineno})"
    log.seek(0)
    written = log.read().decode(errors="replace")
    # Sums of several threads go to a copy of the array for each, which Dr.Jit reports, too: only reads count
    reads = [line for line in written.splitlines() if "out-of-bounds" in line and " read " in line]
    if reads and outcome in GOOD:
        outcome, message = "out of bounds", reads[0]
    return {"outcome": outcome, "message": message[:500], **figures}


def serve(pipe, folder: str, busy: int, module: str) -> None:
    """Answer requests of the parent until it ends."""
    import faulthandler

    import drjit as dr

    os.chdir(folder)
    sys.path.insert(0, folder)
    with tempfile.TemporaryFile() as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
        probes = importlib.import_module(module)
        probes.prepare()
        # Dr.Jit says of each gather and scatter outside of an array where it is
        dr.set_flag(dr.JitFlag.Debug, True)
        limit = status("VmSize") + ROOM
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        faulthandler.disable()
        pipe.send({"outcome": "ready"})
        while True:
            try:
                probe, arguments = pipe.recv()
            except EOFError:
                return
            resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + busy, resource.RLIM_INFINITY))
            pipe.send(answer_to(getattr(probes, probe), arguments, log))
