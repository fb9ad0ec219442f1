"""The limits that the suite relies on: each fault is noticed, and costs the child alone."""

import pytest
from damage import Archive
from limited_child import LimitedChild, fault_of_sentence
from trial_files import all_seeds

PROBES = """
import os, signal, time
import numpy as np
from hostile_probes import *
from mi_diffind.core.errors import UsageError

def crashed(): os.kill(os.getpid(), signal.SIGSEGV)
def slept(): time.sleep(600)
def worked():
    while True: pass
def failed(): raise KeyError("x")
def refusing(text): raise UsageError(text)
def gathered():
    import drjit as dr
    from drjit.llvm.ad import Float, UInt32
    dr.eval(dr.gather(Float, Float([1, 2, 3]), dr.opaque(UInt32, 7)))
def grew(): return bounded(lambda: np.ones(1 << 25), __file__) and None
"""


@pytest.fixture(scope="module")
def child(tmp_path_factory):
    """A child that knows more probes, for the faults themselves."""
    folder = tmp_path_factory.mktemp("limits")
    (folder / "more_probes.py").write_text(PROBES)
    with LimitedChild(folder, probes="more_probes") as limited:
        yield limited


def test_each_fault_has_its_name(child, monkeypatch):
    assert fault_of_sentence("a\nb") == "control characters" and fault_of_sentence("x" * 300) == ""
    for text, outcome in (("one sentence", "refused"), ("", "sentence")):
        assert child.check("refusing", text=text)["outcome"] == outcome
    failed = child.check("failed")
    assert failed["outcome"] == "traceback" and failed["message"].startswith("KeyError: 'x' (more_probes.py:")
    assert child.check("gathered")["outcome"] == "out of bounds"
    assert child.check("grew")["outcome"] == "memory"
    assert child.starts == 1 and child.check("crashed") == {"outcome": "crash", "message": "SIGSEGV"}
    monkeypatch.setattr(child, "busy", 1)
    assert child.check("worked") == {"outcome": "hang", "message": "SIGXCPU"} and child.starts == 2
    child.start()
    monkeypatch.setattr(child, "idle", 1)
    assert child.check("slept") == {"outcome": "hang", "message": "no answer after 1 s"} and child.starts == 3


def test_silent_changes_are_noticed(child):
    """An entry that is another one, though nothing was done to it."""
    path = all_seeds()["ggx_small"]
    archive = Archive(path.read_bytes())
    archive.arrays["primary"].flat[3] = 0.25
    (child.folder / "changed.npz").write_bytes(archive.write())
    request = {"path": "changed.npz", "original": str(path)}
    assert child.check("table", **request, untouched=["cascaded"])["outcome"] == "loaded"
    answer = child.check("table", **request, untouched=None)
    assert (answer["outcome"], answer["message"]) == ("silent", "primary differs")
