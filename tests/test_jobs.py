"""Jobs in this process, in others, and on a Dask cluster: outcomes, lost processes, Ctrl-C."""

import functools
import gc
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import worker_jobs

from mi_diffind.core import jobs
from mi_diffind.core.errors import UsageError
from mi_diffind.core.jobs import run_jobs

linux = pytest.mark.skipif(sys.platform != "linux", reason="the kernel ends such a process on Linux only")

#: A number, a word that is refused, and what raises another error.
VALUES = {"three": 3, "word": "abc", "none": None, "four": 4}


def run(function, values, *arguments, **options) -> dict:
    """Return the outcomes by name; each name comes once."""
    outcomes = list(run_jobs(function, values, *arguments, progress=False, **options))
    assert len({outcome.name for outcome in outcomes}) == len(outcomes)
    return {outcome.name: outcome for outcome in outcomes}


def check(outcomes: dict) -> set:
    """Check the outcomes of :data:`VALUES` and return the processes."""
    assert set(outcomes) == set(VALUES)
    assert (outcomes["three"].value[0], outcomes["four"].value[0]) == (9, 16)
    assert outcomes["word"].failure == "found the word abc" and outcomes["three"].failure == ""
    assert outcomes["none"].failure.startswith("TypeError: unsupported operand")
    return {outcomes["three"].value[1], outcomes["four"].value[1]}


def test_in_this_process():
    outcomes = run(worker_jobs.square, VALUES)
    assert list(outcomes) == list(VALUES) and check(outcomes) == {os.getpid()}


def test_in_processes(tmp_path):
    """Results are those of one process; what cannot be sent has failed; a job whose process is lost is tried again."""
    assert os.getpid() not in check(run(worker_jobs.square, VALUES, 2))
    assert "cannot be sent" in run(open, {"file": os.devnull}, 1)["file"].failure
    killed = run(worker_jobs.kill_once, {"a": str(tmp_path / "mark"), "b": __file__}, 2)
    assert (tmp_path / "mark").exists() and killed["a"].value and not killed["a"].failure
    assert run(os._exit, {"a": 3}, 1)["a"].failure == "the process of this job ended 3 times (exit code 3)"


def test_interrupted_here():
    """Finished jobs stay; a job that fails because of the Ctrl-C has not failed."""
    assert list(run(worker_jobs.interrupt, {"a": 1, "b": 2, "c": 3})) == ["a", "b"]
    assert list(run(worker_jobs.interrupt, {"a": 1, "b": "word", "c": 3})) == ["a"]


def test_processes_are_interrupted(tmp_path):
    """Ctrl-C gives up what runs, and no process stays behind."""
    file = tmp_path / "process"

    def interrupt():
        wait_for(lambda: file.is_file() and file.read_text())
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    thread.start()
    assert run(worker_jobs.write_process_and_sleep, {"a": str(file)}, 1) == {}
    thread.join()
    assert not exists(int(file.read_text()))


@pytest.mark.parametrize("job", ["write_process_and_sleep", pytest.param("write_process_and_hold_python", marks=linux)])
def test_processes_end_with_the_one_that_began_them(tmp_path, job):
    file = tmp_path / "process"
    code = (
        f"import sys; sys.path[:] = {sys.path}; import worker_jobs; from mi_diffind.core.jobs import run_jobs\n"
        f"list(run_jobs(worker_jobs.{job}, {{'a': {str(file)!r}}}, 1))"
    )
    parent = subprocess.Popen([sys.executable, "-c", code])
    wait_for(lambda: file.is_file() and file.read_text())
    assert exists(int(file.read_text()))
    parent.kill()
    parent.wait()
    wait_for(lambda: not exists(int(file.read_text())))


def exists(process: int) -> bool:
    """Return whether a process runs; one that has ended and was not waited for does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition):
    for _ in range(600):
        if condition():
            return
        time.sleep(0.1)
    raise AssertionError("waited in vain")


def test_on_a_cluster(tmp_path):
    """Results are those of one process, also if a worker of the cluster is lost."""
    distributed = pytest.importorskip("distributed", reason="distributed is not installed: pip install '.[cluster]'")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=2, dashboard_address=":0") as cluster:
        address = cluster.scheduler_address
        assert os.getpid() not in check(run(worker_jobs.square, VALUES, scheduler=address))
        assert "ended 3 times" in run(os._exit, {"a": 3}, scheduler=address)["a"].failure
        kill_parent = functools.partial(worker_jobs.kill_once, process=os.getppid)
        killed = run(kill_parent, {"a": str(tmp_path / "mark")}, scheduler=address)
        assert (tmp_path / "mark").exists() and killed["a"].value and not killed["a"].failure


def test_clusters_out_of_reach(monkeypatch, no_garbage_collection):
    with pytest.raises(UsageError, match="workers: given together with a scheduler"):
        run(worker_jobs.square, VALUES, 2, scheduler="tcp://127.0.0.1:1")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "distributed", None)
        with pytest.raises(UsageError, match="distributed, which is not installed: pip install"):
            run(worker_jobs.square, VALUES, scheduler="tcp://127.0.0.1:1")
    distributed = pytest.importorskip("distributed", reason="distributed is not installed: pip install '.[cluster]'")
    monkeypatch.setattr(jobs, "TIMEOUT", 1)
    for address in ("tcp://127.0.0.1:1", "nonsense", "http://nonsense:80", "tls://127.0.0.1:1"):
        with pytest.raises(UsageError, match=f'scheduler: "{address}" cannot be reached'):
            run(worker_jobs.square, VALUES, scheduler=address)
    # A client that the garbage collector would close stops the process for ever if another one starts just then
    assert {c.status for c in gc.get_objects() if isinstance(c, distributed.Client)} <= {"closed"}
