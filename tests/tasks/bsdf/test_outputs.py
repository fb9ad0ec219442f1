"""Learned BSDFs in other formats, and their sources, opened again."""

import csv
import json

import numpy as np
import pytest
from learned_bsdfs import formula, handmade, unit

import mi_diffind
from mi_diffind.arrays.tables import TableError, load_table, save_table
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.bsdf import evaluation
from mi_diffind.tasks.bsdf.truth import recorded_source


@pytest.fixture
def types(mi_rgb):
    return array_module()


@pytest.fixture
def model(types, tmp_path):
    def opened(settings=None, **form):
        table = handmade(**form)
        table.settings |= settings or {}
        save_table(tmp_path / "learned.npz", table)
        return mi_diffind.open(tmp_path / "learned.npz")

    return opened


def test_tables_of_numbers(model, tmp_path):
    """Rows are values of the formula at directions of a seed, in degrees."""
    opened = model()
    [(path, _)] = opened.decode(tmp_path / "a.csv", rows=500, seed=3)
    opened.decode(tmp_path / "b.csv", rows=500, seed=3)
    opened.decode(tmp_path / "c.csv", rows=500)
    assert path.read_bytes() == (tmp_path / "b.csv").read_bytes() != (tmp_path / "c.csv").read_bytes()
    with open(path, newline="") as stream:
        assert tuple(next(csv.reader(stream))) == evaluation.COLUMNS
        rows = np.loadtxt(stream, delimiter=",")
    assert rows.shape == (500, 8) and (rows[:, -1] > 0).all()
    wi, wo = (unit(*np.radians(rows[:, k : k + 2]).T) for k in (0, 2))
    np.testing.assert_allclose(rows[:, 4:7], formula(opened.table, wi, wo), rtol=1e-2)


def test_pictures(mi_rgb, types, model, tmp_path, monkeypatch):
    """A sphere stands beside its source if that can be opened again, else alone, with the reason."""
    monkeypatch.setattr(evaluation, "PASSES", 1)
    source = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}}
    settings = recorded_source({"source": source, "material": "", "uv": (0.5, 0.5), "angles": "", "illuminant": ""})
    assert json.loads(json.dumps(settings)) == settings
    for recorded, width in (({}, 256), (settings, 768)):
        [(path, line)] = model(recorded).decode(tmp_path / f"{width}.exr")
        image = np.array(mi_rgb.Bitmap(str(path)))
        assert image.shape == (256, width, 3) and np.isfinite(image).all() and image[128, 128].min() > 0.01
        assert ("its source, and 8 times" in line) == (width == 768), line
    learned, exact, difference = np.split(image, 3, axis=1)
    np.testing.assert_allclose(difference, 8 * np.abs(learned - exact), atol=1e-3)
    # A white surface is lit more in each channel by what a coloured one absorbs of it
    white = model({**settings, "dictionary": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1}}})
    white.table.settings.pop("source", None)
    lit = evaluation.picture(white, white.source)[0][:, 256:512]
    np.testing.assert_allclose(exact, lit * [0.2, 0.5, 0.7], atol=2e-3)


def test_bad_outputs(model, tmp_path):
    opened = model()
    with pytest.raises(UsageError, match=r'found the extension ".png", allowed are .csv and .exr'):
        opened.decode(tmp_path / "a.png")
    with pytest.raises(UsageError, match=r"--rows and --seed need the extension \.csv"):
        opened.decode(tmp_path / "a.exr", seed=1)


def test_sources_are_opened_again(model, types, tmp_path):
    """Measured is what a file's own source shows; a source in memory, lost or changed is named."""
    scene = tmp_path / "scene.xml"
    scene.write_text('<scene version="3.0.0"><bsdf type="diffuse" id="a"/><shape type="sphere"><ref id="a"/></shape>'
                     '<shape type="sphere"><bsdf type="roughplastic" id="b"/></shape></scene>')  # fmt: skip
    settings = {"material": "b", "uv": [0.5, 0.5], "source_path": "scene.xml"}
    figures = model(settings).measure()
    assert set(figures) == {"psnr_db", "albedo_excess", "sample_weight_moment"} and 0 < figures["psnr_db"] < 60
    with pytest.raises(TableError, match="was fitted to an object in memory, which cannot be opened again"):
        model().measure()
    with pytest.raises(TableError, match="its source, b, has changed since"):
        model(settings | {"source": "0"}).measure()
    scene.unlink()
    with pytest.raises(TableError, match=r"its source cannot be opened again: .*scene.xml: no such file"):
        model(settings).measure()
    assert load_table(tmp_path / "learned.npz").settings["material"] == "b"
