"""A child process with limits of memory and time, which answers one request after the other.

The parent is :class:`LimitedChild`; run as a script, this file is the child. A request names a function of
:mod:`hostile_probes` and its arguments, an answer is one line of JSON. A crash, a hang or a lack of memory costs the
child alone: the answer says so, and the next request starts another child.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import resource
import select
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

#: Outcomes of a request that are as they should be.
GOOD = ("refused", "loaded")

#: Outcomes that are faults.
FAULTS = ("sentence", "traceback", "silent", "nonfinite", "out of bounds", "memory", "crash", "hang")

#: Address space beyond that of the started child, in bytes.
ROOM = 3 << 30

#: Limits of one request: seconds of processor time, and seconds in which no thread runs. Neither depends on what else
#: the machine does.
BUSY, IDLE = 20.0, 8

#: Longest sentence.
LONGEST = 300


class LimitedChild:
    """A child process that is started by the first request, and again after a request that ended it.

    It works in ``folder``, with ``busy`` seconds of processor time for each request and ``room`` bytes of address
    space; ``probes`` is the module of the functions that requests name.
    """

    def __init__(self, folder: Path, busy: float = BUSY, room: int = ROOM, probes: str = "hostile_probes"):
        self.folder, self.busy, self.room, self.probes = Path(folder), busy, room, probes
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
            self.process.communicate()
            os.close(self.answers)
            self.process = None

    def start(self) -> None:
        """Start the child and wait until Mitsuba is ready."""
        self.answers, write = os.pipe()
        self.log = open(self.folder / "child.log", "ab")  # noqa: SIM115
        self.process = subprocess.Popen(
            [sys.executable, __file__, str(write), str(self.room), self.probes],
            stdin=subprocess.PIPE, stdout=self.log, stderr=self.log, cwd=self.folder, pass_fds=[write],
        )  # fmt: skip
        os.close(write)
        self.log.close()
        self.starts += 1
        answer = self._answer(busy=10 * self.busy, idle=60)
        if answer.get("outcome") != "ready":
            raise RuntimeError(f"the child did not start: {answer}")

    def check(self, probe: str, **arguments) -> dict:
        """Return the answer to a request: ``outcome`` (:data:`GOOD` or :data:`FAULTS`), ``message`` and figures."""
        if self.process is None:
            self.start()
        line = json.dumps({"probe": probe, **arguments}) + "\n"
        try:
            self.process.stdin.write(line.encode())
            self.process.stdin.flush()
        except BrokenPipeError:
            return self._ended()
        return self._answer(self.busy, IDLE)

    def _answer(self, busy: float, idle: int) -> dict:
        started, last, still, line = self._seconds(), -1.0, 0, b""
        while not line.endswith(b"\n"):
            if select.select([self.answers], [], [], 1.0)[0]:
                part = os.read(self.answers, 1 << 16)
                if not part:
                    return self._ended()
                line += part
                continue
            seconds = self._seconds()
            still = still + 1 if seconds == last and not self._runs() else 0
            last = seconds
            if seconds - started > busy or still >= idle:
                self.stop()
                return {"outcome": "hang", "message": f"{seconds - started:.0f} s of processor time, then ended"}
        return json.loads(line)

    def _ended(self) -> dict:
        code = self.process.wait()
        self.stop()
        name = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        return {"outcome": "crash", "message": name}

    def _seconds(self) -> float:
        """Return the processor time of the child and of its own children that have ended."""
        with contextlib.suppress(OSError):
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
            return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
        return 0.0

    def _runs(self) -> bool:
        """Return whether a thread of the child, or of a process that it started, runs or waits for a processor."""
        with contextlib.suppress(OSError):
            for process in (self.process.pid, *_children(self.process.pid)):
                for task in Path(f"/proc/{process}/task").iterdir():
                    with contextlib.suppress(OSError):
                        if (task / "stat").read_text().rpartition(")")[2].split()[0] in "RD":
                            return True
        return False


def _children(process: int) -> list[int]:
    try:
        return list(map(int, Path(f"/proc/{process}/task/{process}/children").read_text().split()))
    except OSError:
        return []


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
    """Return the answer to one request."""
    from mi_diffind.core.errors import DiffindError

    log.seek(0)
    log.truncate()
    answer = {}
    try:
        answer = {"outcome": "loaded", "message": "", **(function(**arguments) or {})}
    except DiffindError as e:
        fault = fault_of_sentence(str(e))
        answer = {"outcome": "sentence" if fault else "refused", "message": f"{fault}: {e}" if fault else str(e)}
    except MemoryError as e:
        answer = {"outcome": "memory", "message": f"MemoryError: {e}"}
    except Exception as e:
        import traceback

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


def serve(answers: int, room: int, module: str) -> None:
    """Answer requests of the parent until it ends."""
    import faulthandler

    import drjit as dr

    with tempfile.TemporaryFile() as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
        probes = importlib.import_module(module)
        probes.prepare()
        # Dr.Jit says of each gather and scatter outside of an array where it is
        dr.set_flag(dr.JitFlag.Debug, True)
        limit = status("VmSize") + room
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        faulthandler.disable()

        def reply(answer: dict) -> None:
            os.write(answers, (json.dumps(answer) + "\n").encode())

        reply({"outcome": "ready"})
        for line in sys.stdin:
            request = json.loads(line)
            started = time.process_time()
            answer = answer_to(getattr(probes, request.pop("probe")), request, log)
            reply({**answer, "seconds": round(time.process_time() - started, 3)})


if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parent), os.getcwd()]
    serve(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3])
