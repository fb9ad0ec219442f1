"""Independent jobs, carried out one by one, by several processes, or by the workers of a Dask cluster.

A job is a function of one argument. Function, argument and result travel between processes: the function lies in a
module, the other two can be pickled. Importing this imports neither Dr.Jit nor Mitsuba.
"""

import collections
import concurrent.futures
import contextlib
import ctypes
import os
import pickle
import queue
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection

from .errors import DiffindError, UsageError, missing_package, reason
from .progress import interruptible, progress_bar
from .threads import LEAST_THREADS

#: Processes that may be lost with a job, one after the other, before the job has failed.
ATTEMPTS = 3

#: Option of Linux's ``prctl``.
PR_SET_PDEATHSIG = 1

#: Seconds between two looks at Ctrl-C.
POLL = 0.2

#: Seconds until a Dask scheduler counts as out of reach.
TIMEOUT = 20

#: Process of each thread that waits for one: of a Dask worker, or of a pool of this process.
_spare = threading.local()


@dataclass
class Outcome:
    """Outcome of the job ``name``: the ``value`` of its function, or the sentence of its ``failure``."""

    name: str
    value: object = None
    failure: str = ""


def run_jobs(
    function: Callable[[object], object],
    jobs: Mapping[str, object],
    workers: int | None = None,
    scheduler: str = "",
    progress: bool = True,
    title: str = "",
    unit: str = "job",
    finished: int = 0,
) -> Iterator[Outcome]:
    """Call ``function`` for the value of each of the ``jobs`` (name → value), and yield outcomes as they complete.

    - ``workers``: number of processes, which share the cores. A process that is lost, for instance by a crash or by
      ``kill -9``, is replaced, and its job is tried again, up to :data:`ATTEMPTS` times. ``None``: this process.
    - ``scheduler``: address of a Dask scheduler, in place of ``workers``. Each job runs in a process beside its worker.
    - ``progress``, ``title``, ``unit``: progress bar; ``finished`` jobs were done before.

    A job that raises an exception has failed, the others go on. After Ctrl-C the iterator ends early; what runs is
    given up. Raises :class:`.UsageError` if the scheduler cannot be reached.
    """
    if workers and scheduler:
        raise UsageError("workers: given together with a scheduler, whose cluster has its own workers")
    with interruptible() as stop, progress_bar(title, len(jobs) + finished, unit, progress, initial=finished) as bar:
        if scheduler:
            outcomes = _on_cluster(function, jobs, scheduler, stop)
        elif workers:
            outcomes = _in_processes(function, jobs, min(workers, max(1, len(jobs))), stop)
        else:
            outcomes = _here(function, jobs, stop)
        for outcome in outcomes:
            bar.update()
            yield outcome


def _attempt(name: str, function: Callable[[object], object], value: object) -> Outcome:
    try:
        return Outcome(name, function(value))
    except DiffindError as e:
        return Outcome(name, failure=str(e))
    except Exception as e:
        return Outcome(name, failure=f"{type(e).__name__}: {reason(e)}")


def _here(function, jobs: Mapping[str, object], stop: threading.Event) -> Iterator[Outcome]:
    for name, value in jobs.items():
        if stop.is_set():
            return
        try:
            outcome = _attempt(name, function, value)
        except KeyboardInterrupt:  # the function has seen the Ctrl-C itself
            return
        if outcome.failure and stop.is_set():
            return
        yield outcome


class WorkerProcess:
    """New process of Python that carries out one job at a time, with so many ``threads`` of Dr.Jit (0: without it).

    It does not run the main script again, ignores Ctrl-C, and ends with this process.
    """

    def __init__(self, threads: int):
        ours, theirs = socket.socketpair()
        code = f"from {__name__} import serve; serve({theirs.fileno()}, {threads})"
        path = os.pathsep.join(p or os.getcwd() for p in sys.path)
        with theirs:
            self.process = subprocess.Popen(
                [sys.executable, "-c", code], stdin=subprocess.DEVNULL, stdout=2, pass_fds=[theirs.fileno()],
                env={**os.environ, "PYTHONPATH": path}, start_new_session=True,
            )  # fmt: skip
        self.pipe = Connection(ours.detach())

    def carry_out(self, name: str, function: Callable[[object], object], value: object) -> Outcome:
        """Return the outcome of a job. Raises ``OSError`` or ``EOFError`` if the process ends before."""
        self.pipe.send_bytes(pickle.dumps((name, function, value)))
        return pickle.loads(self.pipe.recv_bytes())

    def close(self) -> str:
        """End the process; return how it ended, for a sentence, if it had done so before."""
        try:
            code = self.process.wait(0.5 if self.process.poll() is None else 0)
        except subprocess.TimeoutExpired:
            code = None
            self.process.kill()
            self.process.wait()
        self.pipe.close()
        if code is None:
            return "it had to be ended"
        return f"signal {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"


def serve(descriptor: int, threads: int) -> None:
    """Carry out the jobs that a :class:`WorkerProcess` sends, in its process."""
    pipe, jobs = Connection(descriptor), queue.SimpleQueue()
    if sys.platform == "linux":  # the kernel ends this process with the other one, whatever it is busy with
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)

    def receive() -> None:
        try:
            while True:
                jobs.put(pipe.recv_bytes())
        except (EOFError, OSError):
            os._exit(1)  # the other process has ended or wants nothing more: whatever runs is of no use

    threading.Thread(target=receive, daemon=True).start()
    while True:
        name, function, value = pickle.loads(jobs.get())
        if threads:
            from .compat import use_threads

            use_threads(threads)
        outcome = _attempt(name, function, value)
        try:
            content = pickle.dumps(outcome)
        except Exception as e:
            content = pickle.dumps(Outcome(name, failure=f"its result cannot be sent ({reason(e)})"))
        pipe.send_bytes(content)


def _beside(
    name: str, function, value, threads: int, pool: list[WorkerProcess], stop: threading.Event
) -> Outcome:  # fmt: skip
    """Carry out a job in the process of this thread, which is begun if need be and then listed in the ``pool``."""
    end = ""
    for _ in range(ATTEMPTS):
        process = getattr(_spare, "process", None)
        if process is None or process.process.poll() is not None:
            process = _spare.process = WorkerProcess(threads)
            pool.append(process)
            if stop.is_set():  # begun after the others were ended
                process.process.kill()
        try:
            return process.carry_out(name, function, value)
        except (EOFError, OSError):
            end, _spare.process = process.close(), None
            if stop.is_set():
                break
    return Outcome(name, failure=f"the process of this job ended {ATTEMPTS} times ({end})")


def _threads_a_job(jobs_at_a_time: int) -> int:
    return max(LEAST_THREADS, (os.cpu_count() or 1) // jobs_at_a_time)


def _in_processes(function, jobs: Mapping[str, object], workers: int, stop: threading.Event) -> Iterator[Outcome]:
    processes: list[WorkerProcess] = []
    over = threading.Event()
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        threads = _threads_a_job(workers)
        futures = {
            pool.submit(_beside, name, function, value, threads, processes, over) for name, value in jobs.items()
        }
        try:
            while futures and not stop.is_set():
                done, futures = concurrent.futures.wait(futures, POLL, concurrent.futures.FIRST_COMPLETED)
                for future in done:
                    yield future.result()
        finally:
            over.set()
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.process.kill()
    for process in processes:
        process.close()


def _beside_worker(name: str, function, value, slots: Mapping[str, int]) -> Outcome:
    """Carry out a job in a process beside a Dask worker; ``slots``: jobs at a time of each machine's address."""
    import distributed

    host = distributed.get_worker().address.rpartition(":")[0]
    return _beside(name, function, value, _threads_a_job(slots.get(host, 1)), [], threading.Event())


def _on_cluster(function, jobs: Mapping[str, object], scheduler: str, stop: threading.Event) -> Iterator[Outcome]:
    try:
        import distributed
    except ImportError:
        raise UsageError(f"scheduler: needs {missing_package('distributed')}") from None
    client = distributed.Client.__new__(distributed.Client)
    try:
        client.__init__(scheduler, timeout=TIMEOUT, set_as_default=False)
    except BaseException as e:
        # Left to the garbage collector, it might be closed while the next one starts, and both want one lock
        with contextlib.suppress(Exception):  # it takes too long
            client.__del__()
        if isinstance(e, (OSError, ValueError, TypeError, ImportError)):  # a TimeoutError is an OSError
            raise UsageError(f'scheduler: "{scheduler}" cannot be reached ({reason(e)})') from None
        raise
    with client, client.as_current():
        slots = collections.Counter()
        for address, worker in client.scheduler_info(n_workers=-1)["workers"].items():
            slots[address.rpartition(":")[0]] += worker["nthreads"]
        left = {
            client.submit(_beside_worker, name, function, value, dict(slots), pure=False): name
            for name, value in jobs.items()
        }  # fmt: skip
        while left and not stop.is_set():
            try:
                completed = distributed.wait(list(left), POLL, "FIRST_COMPLETED").done
            except TimeoutError:
                continue
            for future in completed:
                name = left.pop(future)
                if future.status == "finished":
                    yield future.result()
                else:
                    error = future.exception() if future.status == "error" else "cancelled by the cluster"
                    yield Outcome(name, failure=f"the cluster gave up ({reason(error)})")
        client.cancel(list(left))
