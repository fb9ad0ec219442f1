"""The plugin ``neural_bsdf`` inside Mitsuba; what holds of every BSDF: ``test_bsdf_contract.py``."""

from pathlib import Path

import drjit as dr
import numpy as np
import plugin_examples as examples
import pytest
from arrays import numpy_of
from bsdf_queries import interactions, random_directions, uniform, vectors
from learned_bsdfs import formula, handmade, handmade_family, member

import mi_diffind
from mi_diffind.arrays.tables import StoredArray, load_table, save_table

LIBRARY = Path(__file__).resolve().parents[2] / "scenes" / "assets" / "library"


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bsdfs")
    for name, form in {
        "isotropic": {},
        "anisotropic": {"isotropic": False, "scale": (0.05, 0.3), "terms": ("first", "second")},
    }.items():
        save_table(folder / f"{name}.npz", handmade(**form))
    table = handmade()
    proxy = table.arrays["proxy"].entries.copy()
    proxy[[6, 15]] = 5.0  # the largest exponents that a file may hold
    table.arrays["proxy"] = StoredArray(proxy)
    save_table(folder / "beckmann.npz", table)
    save_table(folder / "family.npz", handmade_family())
    return {path.stem: str(path) for path in folder.glob("*.npz")}


#: File, parameters, and the member of a family, by default the middle of its range.
VALUES = [
    *((name, {"scale": 0.5}, None) for name in ("isotropic", "anisotropic", "beckmann")),
    *(
        ("family", {"roughness": r, "metallic": m}, (r, m))
        for r, m in ((0.05, 0.0), (0.8, 1.0), (0.13, 0.4), (0.5, 0.9))
    ),
    ("family", {}, (0.2, 0.5)),
]


@pytest.mark.parametrize("name, given, of_family", VALUES)
def test_values(mi, files, rng, name, given, of_family):
    """``eval`` is the formula times the cosine."""
    bsdf = mi.load_dict({"type": "neural_bsdf", "filename": files[name], **given})
    wi, wo = random_directions(rng, 2000, 0.05), random_directions(rng, 2000, 0.05)
    table = load_table(files[name])
    table = member(table, *of_family) if of_family else table
    expected = given.get("scale", 1) * wo[:, 2:] * formula(table, wi.astype(float), wo.astype(float))
    value = numpy_of(bsdf.eval(mi.BSDFContext(), interactions(mi, wi), vectors(mi, wo)))
    np.testing.assert_allclose(value, expected, rtol=5e-3, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(LIBRARY.glob("*.npz")), ids=lambda path: path.stem)
def test_chi2_of_the_library(mi, path, tmp_path, monkeypatch):
    """Samples of the materials of scenes/library.xml follow their density at six angles of incidence."""
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    monkeypatch.chdir(tmp_path)
    xml = f'<string name="filename" value="{path}"/>'
    for angle in (1, 20, 40, 60, 75, 85):
        theta = np.radians(angle)
        wi = dr.opaque(mi.Vector3f, [np.sin(theta), 0, np.cos(theta)])
        sample, pdf = BSDFAdapter("neural_bsdf", xml, wi=wi)
        test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3, sample_count=500_000, res=201, ires=32)
        assert test.run(test_count=72, quiet=True), f"{angle} degrees: {test.messages}"


def test_both_sides_look_alike(mi, files, rng):
    """With ``two_sided``, both sides of a surface have the same values."""
    wi, wo = random_directions(rng, 500, 0.05), random_directions(rng, 500, 0.05)
    bsdf = mi.load_dict({"type": "neural_bsdf", "filename": files["isotropic"], "two_sided": True})
    front, back = (
        numpy_of(bsdf.eval(mi.BSDFContext(), interactions(mi, wi * side), vectors(mi, wo * side)))
        for side in np.float32([[1, 1, 1], [1, 1, -1]])
    )
    assert front.min() > 0
    np.testing.assert_array_equal(front, back)


def test_changes_are_saved(mi, files, tmp_path):
    """An optimised proxy, or the table of a family, is written to a file, and read back."""
    bsdf = mi.load_dict({"type": "neural_bsdf", "filename": files["isotropic"]})
    params = mi.traverse(bsdf)
    given = {"first.alpha_u": mi.Float(0.31), "second.f0": mi.Color3f(0.5, 0.25, 0.125)}
    params.update(given)
    mi_diffind.save(bsdf, tmp_path / "saved.npz")
    again = mi.traverse(mi.load_dict({"type": "neural_bsdf", "filename": str(tmp_path / "saved.npz")}))
    for key, value in {**given, "diffuse": params["diffuse"]}.items():
        np.testing.assert_allclose(np.ravel(again[key]), np.ravel(value), rtol=1e-5)
    family = mi.load_dict({"type": "neural_bsdf", "filename": files["family"], "storage": "float32"})
    params = mi.traverse(family)
    params.update({"tables.proxy": params["tables.proxy"] - 0.05})
    mi_diffind.save(family, tmp_path / "saved.npz")
    before, after = (load_table(path).arrays["proxy"].values for path in (files["family"], tmp_path / "saved.npz"))
    np.testing.assert_allclose(after, before - 0.05, atol=5e-3)


def test_reports(mi, files):
    """A report names the terms in use, and those left out with the reason."""
    load = mi.load_dict
    report = load({"type": "neural_bsdf", "filename": files["anisotropic"]}).report()
    assert report["effects_in_use"] == ["residual", "first", "second", "energy"]
    assert report["effects_left_out"] == {"diffuse": "the source does not need it"}
    raw = load({"type": "neural_bsdf", "filename": files["isotropic"], "energy": "raw"}).report()
    assert raw["effects_left_out"] == {"energy": "energy is raw"}


def recorded(folder, source, **settings):
    """A file that says it was fitted to a dictionary."""
    table = handmade()
    table.settings |= {"dictionary": source, **settings}
    save_table(folder / "recorded.npz", table)
    return {"type": "neural_bsdf", "filename": str(folder / "recorded.npz"), "evaluate": "source"}


CHECKER = {"type": "checkerboard", "color0": {"type": "rgb", "value": 0.1}, "color1": {"type": "rgb", "value": 0.8}}


def test_sources_in_the_place_of_files(mi, tmp_path, rng):
    """``evaluate="source"`` is the source: Mitsuba's own object, or of textures the point that was fitted."""
    ctx = mi.BSDFContext()
    wi, wo = random_directions(rng, 64, 0.05), random_directions(rng, 64, 0.05)
    plastic = {"type": "roughplastic", "alpha": 0.2}
    given = recorded(tmp_path, plastic)
    expected = mi.load_dict(plastic)
    for changes, sign in (({}, 1), ({"two_sided": True}, -1)):
        source = mi.load_dict({**given, **changes})
        side = np.float32([1, 1, sign])
        shown = [b.eval(ctx, interactions(mi, w), vectors(mi, v))
                 for b, w, v in ((source, wi * side, wo * side), (expected, wi, wo))]  # fmt: skip
        np.testing.assert_array_equal(numpy_of(shown[0]), numpy_of(shown[1]))
        assert type(source).__name__ != "NeuralBSDF"
    checked = {"type": "diffuse", "reflectance": CHECKER}
    textured = mi.load_dict(recorded(tmp_path, checked, uv=[0.25, 0.75]))
    si, towards = interactions(mi, wi), vectors(mi, wo)
    value, pdf = textured.eval_pdf(ctx, si, towards)
    elsewhere, there = interactions(mi, wi), interactions(mi, wi)
    there.uv = mi.Point2f(0.25, 0.75)
    expected, other = (numpy_of(mi.load_dict(checked).eval(ctx, at, towards)) for at in (there, elsewhere))
    np.testing.assert_allclose(numpy_of(value), expected, rtol=1e-5)
    assert not np.allclose(expected, other)
    bs, weight = textured.sample(ctx, si, *uniform(mi, rng, 64))
    again, density = textured.eval_pdf(ctx, si, bs.wo)
    ratio, valid = numpy_of(again) / numpy_of([density]), numpy_of([bs.pdf])[:, 0] > 0
    np.testing.assert_allclose(numpy_of(weight)[valid], ratio[valid], rtol=1e-3)
    assert numpy_of([pdf]).min() > 0


def test_sources_that_cannot_stand_for_files(mi, files, tmp_path):
    plastic = {"type": "roughplastic"}
    for given, message in (
        ({"type": "neural_bsdf", "filename": files["isotropic"], "evaluate": "source"}, "cannot be opened again"),
        ({**recorded(tmp_path, plastic), "scale": 0.5}, r'parameter "scale": found 0.5, the source of .* has none'),
    ):
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict(given)


def test_compare_shows_the_source(mi, tmp_path):
    """A comparison puts the source in the file's place."""
    given = recorded(tmp_path, {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.1]}})
    del given["evaluate"]
    wall = {"to_world": mi.ScalarTransform4f().scale(9), "bsdf": {**given, "energy": "raw"}}
    scene = {
        "type": "scene", "integrator": {"type": "direct"}, "light": {"type": "constant"},
        "sensor": examples.sensor(mi, size=8), "wall": {"type": "rectangle", **wall},
    }  # fmt: skip
    result = mi_diffind.compare(scene, 64, passes=2, progress=False)
    assert result.figures["counterparts"] == ["source"] and result.figures["learned_plugins"] == 1
    np.testing.assert_allclose(result.reference.mean(axis=(0, 1)), [0.2, 0.5, 0.1], rtol=0.05)
    assert abs(result.written.mean() - result.reference.mean()) > 0.05
