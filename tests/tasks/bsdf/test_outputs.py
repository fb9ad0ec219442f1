"""Learned BSDFs in other formats, and their sources, opened again."""

import csv
import json

import drjit as dr
import numpy as np
import pytest
from learned_bsdfs import formula, handmade

import mi_diffind
from mi_diffind.arrays.tables import TableError, load_table, save_table
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.bsdf import outputs, tensor_file
from mi_diffind.tasks.bsdf.truth import MitsubaTruth, recorded_source
from mi_diffind.tasks.bsdf.view import SphereView


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


@pytest.mark.parametrize("form", [{}, {"isotropic": False, "scale": (0.08, 0.3), "angle": 0.4}, {"azimuth": "half"}])
def test_measured_files(mi_rgb, types, model, tmp_path, form):
    """Mitsuba's ``measured`` shows nearly the learned BSDF, and samples it."""
    opened = model(**form)
    [(path, line)] = opened.decode(tmp_path / "learned.bsdf")
    assert path.stat().st_size < 10e6 and "directions, for measured in RGB" in line
    bsdf = mi_rgb.load_dict({"type": "measured", "filename": str(path)})
    truth, learned = MitsubaTruth(bsdf, "measured", ""), outputs.LearnedTruth(opened)
    assert SphereView(learned, types, side=32, samples=32).psnr(truth.value) > 45
    n = 2**14
    rng = dr.rng(seed=3)
    wi = types.Array3f(*(dr.full(types.Float, x, n) for x in (0.7, 0.1, 0.7071)))
    wo = truth.sample(wi, *(rng.random(types.Float, n) for _ in range(3)))
    pdf = truth.density(wi, wo)
    value = learned.value(wi, wo)[1]
    weights = dr.select((wo.z > 0) & (pdf > 0), value / pdf, 0).numpy()
    albedo = weights.mean()
    assert 0.1 < albedo < 1.5 and (weights**2).mean() / albedo**2 < 1.3


def test_tables_of_numbers(model, tmp_path):
    """Rows are values of the formula at directions of a seed, in degrees."""
    opened = model()
    [(path, _)] = opened.decode(tmp_path / "a.csv", rows=500, seed=3)
    opened.decode(tmp_path / "b.csv", rows=500, seed=3)
    opened.decode(tmp_path / "c.csv", rows=500)
    assert path.read_bytes() == (tmp_path / "b.csv").read_bytes() != (tmp_path / "c.csv").read_bytes()
    with open(path, newline="") as stream:
        assert tuple(next(csv.reader(stream))) == outputs.COLUMNS
        rows = np.loadtxt(stream, delimiter=",")
    assert rows.shape == (500, 8) and (rows[:, -1] > 0).all()
    wi, wo = (tensor_file._vector(*np.radians(rows[:, k : k + 2]).T) for k in (0, 2))
    np.testing.assert_allclose(rows[:, 4:7], formula(opened.table, wi, wo), rtol=1e-2)


def test_pictures(mi_rgb, types, model, tmp_path, monkeypatch):
    """A sphere stands beside its source if that can be opened again, else alone, with the reason."""
    monkeypatch.setattr(outputs, "PASSES", 1)
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
    lit = outputs.picture(white, white.source)[0][:, 256:512]
    np.testing.assert_allclose(exact, lit * [0.2, 0.5, 0.7], atol=2e-3)


def test_bad_outputs(model, tmp_path):
    opened = model()
    with pytest.raises(UsageError, match=r'found the extension ".png", allowed are .bsdf, .csv and .exr'):
        opened.decode(tmp_path / "a.png")
    with pytest.raises(UsageError, match=r"--rows and --seed need the extension \.csv"):
        opened.decode(tmp_path / "a.bsdf", seed=1)


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
