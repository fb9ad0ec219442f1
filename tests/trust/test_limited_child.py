"""The limits that the suite relies on: each fault is noticed, and costs the child alone."""

import json

import pytest
from hostile_files import Archive, damaged
from limited_child import GOOD, LimitedChild, fault_of_sentence
from trial_files import all_seeds

PROBES = """
import os, signal, time
import numpy as np
from hostile_probes import *

def crashed(): os.kill(os.getpid(), signal.SIGSEGV)
def slept(): time.sleep(600)
def failed(): raise KeyError("x")
def refusing(text):
    from mi_diffind.core.errors import UsageError
    raise UsageError(text)
def gathered():
    import drjit as dr
    from drjit.llvm.ad import Float, UInt32
    dr.eval(dr.gather(Float, Float([1, 2, 3]), dr.opaque(UInt32, 7)))
def grew():
    return bounded(lambda: np.ones(1 << 25), __file__) and None
"""


@pytest.fixture(scope="module")
def child(tmp_path_factory):
    """A child that knows more probes, for the faults themselves."""
    folder = tmp_path_factory.mktemp("limits")
    (folder / "more_probes.py").write_text(PROBES)
    with LimitedChild(folder, busy=20, probes="more_probes") as limited:
        yield limited


def test_each_fault_has_its_name(child):
    assert child.check("refusing", text="one sentence")["outcome"] == "refused"
    assert child.check("refusing", text="")["outcome"] == "sentence"
    failed = child.check("failed")
    assert failed["outcome"] == "traceback" and failed["message"].startswith("KeyError: 'x' (more_probes.py:")
    assert child.check("gathered")["outcome"] == "out of bounds"
    assert child.check("grew")["outcome"] == "memory"
    assert child.starts == 1 and child.check("crashed") == {"outcome": "crash", "message": "SIGSEGV"}
    assert child.check("slept")["outcome"] == "hang" and child.starts == 2


def test_sentences():
    assert fault_of_sentence("") == "empty" and fault_of_sentence("a\nb") == "control characters"
    assert fault_of_sentence("x" * 300) == ""


def test_silent_changes_are_noticed(tmp_path, child):
    """An entry that is another one, though the recipe did nothing to it."""
    path = all_seeds()["ggx_small"][1]
    changed, untouched = damaged(path.read_bytes(), [["set_entries", "primary", "one", 0.25, 3]])
    assert untouched == ["cascaded"]
    (child.folder / "changed.npz").write_bytes(changed)
    request = {"path": "changed.npz", "original": str(path)}
    assert child.check("table", **request, untouched=untouched)["outcome"] == "loaded"
    assert child.check("table", **request, untouched=None) | {"seconds": 0} == {
        "outcome": "silent", "message": "primary differs", "seconds": 0,
    }  # fmt: skip


def test_undamaged_archives_stay_what_they_are(tmp_path):
    """Written again without a step, the arrays and the description are those of the original."""
    for _, path in all_seeds().values():
        again = tmp_path / path.name
        archive = Archive.read(path)
        again.write_bytes(archive.write())
        copy = Archive.read(again)
        assert json.dumps(copy.meta) == json.dumps(archive.meta) and list(copy.arrays) == list(archive.arrays)
        assert all(copy.arrays[n].tobytes() == a.tobytes() for n, a in archive.arrays.items())


@pytest.mark.parametrize("name", all_seeds())
def test_valid_files_load(child, name):
    path = str(all_seeds()[name][1])
    answer = child.check("table", path=path, original=path, untouched=None)
    assert answer["outcome"] in GOOD[1:], answer
