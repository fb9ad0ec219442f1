"""Folder of trained models, and fingerprints of files."""

from mi_diffind.measure.store import fingerprint, models_folder


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
