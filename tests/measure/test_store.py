"""Partial results: used again under the same key, else discarded with one sentence."""

import json
import os

import pytest

from mi_diffind.core.files import OutputError
from mi_diffind.measure.store import Store, fingerprint, models_folder

KEY = {"settings": {"rounds": 3, "sides": (1, 2)}, "machine": "here", "limit": float("nan")}


def store_in(folder, key=KEY, progress=False):
    return Store(folder, "small", key, ("errors", "rounds"), progress)


@pytest.fixture
def interrupted(tmp_path):
    """A folder with the partial results of a run."""
    store = store_in(tmp_path)
    store.data["errors"]["a"] = {"db": 20.0}
    store.save()
    (tmp_path / "other.txt").write_text("stays")
    return tmp_path


def test_continued(interrupted, capsys):
    store = store_in(interrupted, progress=True)
    assert store.resumed and store.data == {"errors": {"a": {"db": 20.0}}, "rounds": {}}
    assert capsys.readouterr().err == f"continuing from {interrupted / 'tradeoff_small.partial.json'}\n"
    Store.remove(interrupted, "small")
    assert os.listdir(interrupted) == ["other.txt"]


#: Damage → function of the file of a store.
DAMAGES = {
    "cut off": lambda path: path.write_text(path.read_text()[:-20]),
    "a list": lambda path: path.write_text("[1, 2]"),
    "a section": lambda path: path.write_text(
        json.dumps({**json.loads(path.read_text()), "data": {"errors": 3, "rounds": {}}})
    ),
    "no text": lambda path: path.write_bytes(b"\xff\x00\xfe"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_results_are_discarded(interrupted, damage, capsys):
    path = interrupted / "tradeoff_small.partial.json"
    DAMAGES[damage](path)
    store = store_in(interrupted, progress=True)
    assert not store.resumed and store.data == {"errors": {}, "rounds": {}}
    assert capsys.readouterr().err == f"{path} is damaged: starting anew\n"
    assert os.listdir(interrupted) == ["other.txt"]


@pytest.mark.parametrize("change", [{"machine": "there"}, {"settings": {"rounds": 4}, "machine": "x"}, {"new": 1}])
def test_another_key_is_named(interrupted, change, capsys):
    store = store_in(interrupted, {**KEY, **change}, progress=True)
    assert not store.resumed
    names = ", ".join(change)
    path = interrupted / "tradeoff_small.partial.json"
    assert capsys.readouterr().err == f"{path} is of a run with other {names}: starting anew\n"


def test_without_a_folder_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    store = store_in(None)
    store.save()
    assert os.listdir(tmp_path) == []
    with pytest.raises(OutputError, match="does not exist"):
        store_in(tmp_path / "nowhere" / "out")


def test_fingerprint(tmp_path):
    (tmp_path / "a.py").write_text("1")
    (tmp_path / "b.py").write_text("2")
    both = fingerprint([tmp_path / "b.py", tmp_path / "a.py"])
    assert both == fingerprint([tmp_path / "a.py", tmp_path / "b.py"])
    (tmp_path / "a.py").write_text("3")
    assert both != fingerprint([tmp_path / "a.py", tmp_path / "b.py"])


def test_folder_is_emptied_for_other_sources(tmp_path):
    folder = models_folder(tmp_path, "ggx", "a")
    (folder / "model.npz").write_bytes(b"")
    assert models_folder(tmp_path, "ggx", "a") == folder and (folder / "model.npz").exists()
    assert models_folder(tmp_path, "ggx", "b") == folder and not (folder / "model.npz").exists()
