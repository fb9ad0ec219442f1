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

#: Seconds of processor time of one request, which do not depend on what else the machine does.
BUSY = 20

#: Seconds of the clock after which a request that takes no processor time is ended.
IDLE = 300

#: Longest sentence, in characters.
LONGEST = 300


class LimitedChild:
    """A child process in ``folder``, started by the first request, and again after a request that ended it.

    ``busy`` and ``idle`` are the seconds of a request by the processor and by the clock; ``probes`` is the module of
    the functions that requests name.
    """

    def __init__(self, folder: Path, busy: int = BUSY, idle: float = IDLE, probes: str = "hostile_probes"):
        self.folder, self.busy, self.idle, self.probes = Path(folder), busy, idle, probes
        self.process = None
        self.starts = 0

    def __enter__(self) -> LimitedChild:
        return self

    def __exit__(self, *_) -> None:
        self.stop()

    def stop(self) -> None:
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
        self.stop()
        return ended


# -- the child ---------------------------------------------------------------------------------------------------------


def status(key: str) -> int:
    """Return a number of bytes in ``/proc/self/status``, such as ``VmHWM``, the largest use of memory."""
    text = Path("/proc/self/status").read_text()
    return 1024 * int(text.partition(f"{key}:")[2].split()[0])


class Growth:
    """Growth of the largest use of memory in a ``with`` block, in bytes."""

    def __enter__(self):
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")  # the largest use begins anew
        self.before = status("VmHWM")
        return self

    def __exit__(self, *_):
        self.bytes = status("VmHWM") - self.before


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
    try:
        answer = {"outcome": "loaded", "message": "", **(function(**arguments) or {})}
    except DiffindError as e:
        fault = fault_of_sentence(str(e))
        answer = {"outcome": "sentence" if fault else "refused", "message": f"{fault}: {e}" if fault else str(e)}
    except MemoryError as e:
        answer = {"outcome": "memory", "message": f"MemoryError: {e}"}
    except Exception as e:
        place = traceback.extract_tb(e.__traceback__)[-1]
        where = f"{Path(place.filename).name}:{place.lineno}"
        answer = {"outcome": "traceback", "message": f"{type(e).__name__}: {e} ({where})"}
    log.seek(0)
    written = log.read().decode(errors="replace")
    # Sums of several threads go to a copy of the array for each, which Dr.Jit reports, too: only reads count
    reads = [line for line in written.splitlines() if "out-of-bounds" in line and " read " in line]
    if reads and answer["outcome"] in GOOD:
        answer |= {"outcome": "out of bounds", "message": reads[0]}
    answer["message"] = answer["message"][:500]
    return answer


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
            start = time.process_time()
            resource.setrlimit(resource.RLIMIT_CPU, (int(start) + busy, resource.RLIM_INFINITY))
            answer = answer_to(getattr(probes, probe), arguments, log)
            pipe.send({**answer, "seconds": round(time.process_time() - start, 3)})
