"""Learned BSDFs: their formula, symmetries, sources, sampling, the limit of the albedo, files, and a training."""

import csv
import dataclasses
import json
import math

import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of
from bsdf_queries import interactions, random_directions, uniform
from learned_bsdfs import about_normal, formula, handmade, handmade_family, unit

import mi_diffind
from mi_diffind.arrays.tables import StoredArray, TableError, load_table, save_table
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.bsdf import TASK, energy, evaluation, measured, mixture, training
from mi_diffind.tasks.bsdf import directions as pool
from mi_diffind.tasks.bsdf import fit as bsdf_fit
from mi_diffind.tasks.bsdf.files import BSDFModel, allocate
from mi_diffind.tasks.bsdf.measured import FunctionTruth, Truth, rotate_truth
from mi_diffind.tasks.bsdf.model import TERMS, Parameter, sizes_within
from mi_diffind.tasks.bsdf.truth import recorded_source, truth_of

FORMS = {
    "isotropic": {},
    "anisotropic": {"isotropic": False, "scale": (0.05, 0.3)},
    "half": {"azimuth": "half"},
    "turned": {"isotropic": False, "scale": (0.05, 0.3), "azimuth": "half", "angle": 0.6},
    "one lobe": {"terms": ("second",)},
    "residual alone": {"terms": ()},
}


@pytest.fixture
def types(mi_rgb):
    return array_module()


@pytest.fixture
def model(types, tmp_path):
    def opened(form, storage="uint8"):
        save_table(tmp_path / f"{form}.npz", handmade(**FORMS[form]))
        return mi_diffind.open(tmp_path / f"{form}.npz", storage)

    return opened


def directions(rng, n, horizon=0.02):
    """Pairs ``(n, 3)`` above the horizon, a third of them near each other's reflection."""
    wi, wo = (random_directions(rng, n, horizon).astype(float) for _ in range(2))
    wi, wo = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in (wi, wo))
    mirrored = wi * [-1, -1, 1] + 0.02 * rng.normal(size=(n, 3))
    mirrored /= np.linalg.norm(mirrored, axis=1, keepdims=True)
    near = (np.arange(n) % 3 == 0) & (mirrored[:, 2] > horizon)
    return wi, np.where(near[:, None], mirrored, wo)


def arrays3(types, w):
    return types.Array3f(aligned(np.asarray(w).T))


def values(bsdf, types, wi, wo):
    return numpy_of(bsdf.value(arrays3(types, wi), arrays3(types, wo)))


# -- the formula -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_the_formula(types, model, rng, form):
    """Values are those of an implementation by angles and rotations."""
    wi, wo = directions(rng, 3000)
    opened = model(form)
    np.testing.assert_allclose(values(opened.bsdf, types, wi, wo), formula(opened.table, wi, wo), rtol=2e-3)


@pytest.mark.parametrize("form", FORMS)
def test_reciprocity(types, model, rng, form):
    """Exchanging the directions changes nothing but the last digits."""
    wi, wo = directions(rng, 3000, 1e-3)
    bsdf = model(form).bsdf
    np.testing.assert_allclose(values(bsdf, types, wi, wo), values(bsdf, types, wo, wi), rtol=1e-5)


def test_sizes_follow_the_bytes():
    parameters = [Parameter("a", 0.01, 1.0), Parameter("b", 0.0, 1.0), Parameter("c", 0.0, 1.0)]
    for count, nbytes in enumerate((2048, 4000, 9000, 12000)):
        assert 0.75 * nbytes < sizes_within(nbytes, parameters[:count]).nbytes <= nbytes
    assert sizes_within(8192, plain=True).first is None and sizes_within(8192, plain=True).nbytes > 7000
    for family, least in (([], "64"), (parameters, "")):
        with pytest.raises(ValueError, match=f"found 10 bytes, the smallest arrays need {least}"):
            sizes_within(10, family)


# -- sources -----------------------------------------------------------------------------------------------------------


class FormulaTruth(Truth):
    """A lobe about the mirror direction, without or with each symmetry."""

    name, digest = "formula", "0"

    def __init__(self, anisotropy=0.0, skew=0.0, exchange=0.0, alpha=0.2):
        self.anisotropy, self.skew, self.exchange, self.alpha = anisotropy, skew, exchange, alpha

    def value(self, wi, wo):
        half = wi + wo
        half = half * dr.rsqrt(dr.squared_norm(half))
        lobe = 0.3 + dr.exp(-(dr.square(half.x) + (1 + self.anisotropy) * dr.square(half.y)) / self.alpha**2)
        lobe *= 1 + self.skew * (wi.x * wo.y - wi.y * wo.x) * (wi.z - wo.z) + self.exchange * wi.z
        return [wo.z * 0.2 * (k + 1) * lobe for k in range(3)]


@pytest.mark.parametrize(
    ("changes", "broken"), [({}, ()), ({"anisotropy": 1}, ("isotropy", "mirror")), ({"skew": 2}, ("mirror",)),
                            ({"exchange": 0.3}, ("reciprocity",))],
)  # fmt: skip
def test_symmetries_are_measured(types, changes, broken):
    with dr.suspend_grad():
        found = measured.measure_symmetry(FormulaTruth(**changes), types, 2**14)
    for name, value in found.items():
        assert (value > 0.02) if name in broken else (value < 1e-3), (name, value)


@pytest.mark.parametrize("degrees", [0, 0.3, 20, -40, 80])
def test_axes_are_measured(types, degrees):
    """The axes of an anisotropic source, up to a quarter turn; small angles count as none."""
    truth = rotate_truth(FormulaTruth(anisotropy=8), math.radians(degrees))
    samples = training.draw(truth, types, 2**16, 1, False)
    expected = (degrees + 45) % 90 - 45 if abs(degrees) > 0.5 else 0
    assert math.degrees(measured.axes_angle(samples, truth)) == pytest.approx(expected, abs=0.5 if expected else 0)


def test_mixtures_are_turned(types, rng):
    """Samples and densities of a file with an angle are those of one without, in turned directions."""
    table, angle = handmade(isotropic=False), 0.6
    plain, turned = (
        BSDFModel(t, allocate(t, types.TensorXf), types.TensorXf)
        for t in (table, handmade(isotropic=False, angle=angle))
    )
    wi, wo = directions(rng, 500)
    there = [arrays3(types, about_normal(w, angle)) for w in (wi, wo)]
    here = [arrays3(types, w) for w in (wi, wo)]
    u = [types.Float(aligned(rng.random(500))) for _ in range(3)]
    densities = numpy_of([plain.mixture.density(*here), turned.mixture.density(*there)])
    np.testing.assert_allclose(densities[:, 0], densities[:, 1], rtol=1e-3)
    samples = numpy_of(plain.mixture.sample(here[0], *u)), numpy_of(turned.mixture.sample(there[0], *u))
    np.testing.assert_allclose(about_normal(samples[0], angle), samples[1], atol=1e-4)


def test_merl(types, tmp_path, rng):
    """A file of the database is read at its nodes and between them, by all three angles and with all three factors."""

    def numbers(theta_h, theta_d, phi_d):
        return 1 + np.cos(theta_h) * (1 + 0.3 * np.cos(2 * phi_d) * np.sin(theta_d)) + theta_d

    h, d, p = np.meshgrid((np.arange(90) / 90) ** 2 * np.pi / 2, np.arange(90) / 90 * np.pi / 2,
                          np.arange(180) / 180 * np.pi, indexing="ij")  # fmt: skip
    grid = numbers(h, d, p)
    content = np.array([90, 90, 180], "<i4").tobytes()
    content += b"".join(
        (s * grid / f).astype("<f8").tobytes()
        for s, f in zip((1, 2, 3), (1 / 1500, 1.15 / 1500, 1.66 / 1500), strict=True)  # published factors
    )
    path = tmp_path / "made.binary"
    path.write_bytes(content)
    wi, wo = directions(rng, 2000, 0.1)
    truth = truth_of(path, types)
    read = numpy_of(truth.value(arrays3(types, wi), arrays3(types, wo)))
    half = wi + wo
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    theta, phi = np.arccos(half[:, 2]), np.arctan2(half[:, 1], half[:, 0])
    x = np.cos(phi) * wi[:, 0] + np.sin(phi) * wi[:, 1]
    y = -np.sin(phi) * wi[:, 0] + np.cos(phi) * wi[:, 1]
    phi_d = np.arctan2(y, np.cos(theta) * x - np.sin(theta) * wi[:, 2])
    expected = numbers(theta, np.arccos(np.einsum("ni,ni->n", wi, half)), phi_d) * wo[:, 2]
    np.testing.assert_allclose(read, expected[:, None] * [1, 2, 3], rtol=5e-3)
    assert truth.isotropic
    path.write_bytes(content[:-8])
    with pytest.raises(UsageError, match="is no measurement of the MERL database, which has 34,992,012 bytes"):
        truth_of(path, types)


SCENE = """<scene version="3.0.0">
    <bsdf type="roughplastic" id="paint"/><bsdf type="dielectric" id="glass"/><bsdf type="conductor" id="mirror"/>
    <shape type="sphere"><ref id="paint"/></shape><shape type="sphere"><ref id="glass"/></shape>
    <shape type="sphere"><ref id="mirror"/></shape>
</scene>"""


def test_sources(types, tmp_path):
    """Scenes, files and dictionaries; what cannot be fitted is refused by one sentence."""
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE)
    assert truth_of(scene, types, "paint").name == "paint"
    assert truth_of({"type": "roughplastic"}, types).name == "roughplastic"
    refused = {
        (scene, ""): r"has 3 materials: name one by its id \(material\), those with ids are glass, mirror, paint",
        (scene, "wood"): 'found "wood", the materials of .* with ids are glass, mirror, paint',
        (scene, "glass"): "glass: transmits light, only BSDFs that reflect can be fitted",
        (scene, "mirror"): "mirror: reflects into single directions, only BSDFs without delta lobes can be fitted",
        (tmp_path / "none.xml", ""): "none.xml: no such file",
        (tmp_path / "lamp.txt", ""): r'found the extension ".txt", allowed are .xml, .bsdf, .pbsdf, .mbsdf, .binary',
    }
    (tmp_path / "lamp.txt").write_text("")
    for (source, material), message in refused.items():
        with pytest.raises(UsageError, match=message):
            truth_of(source, types, material)


# -- sampling and albedo -----------------------------------------------------------------------------------------------


def test_the_mixture_follows_the_source(types):
    """Squares of weights are near their lower bound, the albedo's, for a sum of a cosine and a GGX lobe."""
    cosine, alpha = 0.4, 0.1

    class Sum(Truth):
        def value(self, wi, wo):
            p = cosine * wo.z * dr.inv_pi + (1 - cosine) * pool.density_ggx(
                wi, wo, type(wi.z)(alpha), type(wi.z)(alpha)
            )
            return [p, p, p]

    lobes, weights = mixture.fit_mixture(Sum(), types, True)
    assert min(abs(math.log(lobe.alpha_u / alpha)) for lobe in lobes) < 0.5
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    array = StoredArray(weights.astype(np.float32)).allocate(types.TensorXf)
    fitted = mixture.Mixture(array, lobes)
    assert 1 <= mixture.second_moment(Sum(), fitted, types, 0.7) < 1.03
    wide = (mixture.SampledLobe(0.5, 0.5),) * 2
    one_lobe = mixture.Mixture(StoredArray(np.float32([[1e-3, 1, 1]] * 2)).allocate(types.TensorXf), wide)
    assert mixture.second_moment(Sum(), one_lobe, types, 0.7, 2**14) > 1.3


def scaled_function(value, scale, types):
    """A function times s(θ_i) s(θ_o)."""
    array = StoredArray(scale[:, None].astype(np.float32)).allocate(types.TensorXf)

    def scaled(wi, wo):
        factor = array([dr.sqrt(wi.z)])[0] * array([dr.sqrt(wo.z)])[0]
        return [factor * v for v in value(wi, wo)]

    return scaled


def test_the_albedo_is_limited(types, monkeypatch):
    """A BSDF that is too bright in some angles is scaled below the source + 0.1%, by random numbers, too."""
    truth = FormulaTruth()

    def bright(wi, wo):
        factor = 1 + 0.06 * dr.exp(-dr.square((wi.z - 0.5) / 0.1)) * (1 + wo.z)
        return [factor * v for v in truth.value(wi, wo)]

    scaled = scaled_function(bright, energy.fit_scale(bright, truth, types), types)
    monkeypatch.setattr(energy, "KroneckerSequence", lambda size: dr.rng(seed=dr.opaque(types.UInt64, 77)))
    cos = np.cos(np.radians(np.linspace(0, 88.5, 50)))
    source, before, after = energy.albedos([truth.value, bright, scaled], truth, types, cos)
    assert (before / source).max() > 1.08
    assert (after / source).max() < 1.001 and (after / source).min() > 0.9


def test_the_albedo_is_at_most_1(types):
    """A Lambertian source of albedo 1.3 is limited to 1; that of albedo 1 has it, by the integral itself."""
    bright, white = (FunctionTruth("", lambda wi, wo, a=a: [a / math.pi * wo.z] * 3) for a in (1.3, 1.0))
    scaled = scaled_function(bright.value, energy.fit_scale(bright.value, bright, types), types)
    cos = np.cos(np.radians(np.linspace(0, 88.5, 20)))
    limited, exact = energy.albedos([scaled, white.value], white, types, cos)
    assert 0.98 < limited.max() < 1.002 and abs(exact - 1).max() < 2e-3


def test_assumed_symmetry(types):
    """Isotropic functions count as symmetric about the plane of incidence up to 10%, rows and others up to 1%."""
    for isotropy, mirror, rows, expected in (
        (0, 0.05, False, (True, "mirror")), (0, 0.2, False, (True, "half")),
        (0, 0.05, True, (True, "half")), (0.5, 0.05, False, (False, "half")), (0.5, None, False, (False, "mirror")),
    ):  # fmt: skip
        assert bsdf_fit._assumed_symmetry({"isotropy": isotropy, "mirror": mirror}, rows) == expected
    irreciprocal = FormulaTruth(exchange=0.3)
    symmetries = measured.measure_symmetry(irreciprocal, types, 2**14)
    fitted = measured.fitted_part(irreciprocal, symmetries, True)
    assert measured.measure_symmetry(fitted, types, 2**14)["reciprocity"] < 1e-3 < symmetries["reciprocity"]
    symmetric = FormulaTruth()
    assert measured.fitted_part(symmetric, measured.measure_symmetry(symmetric, types, 2**14), True) is symmetric


# -- files and training ------------------------------------------------------------------------------------------------

#: File → changes and refusals; shapes and additional arrays of any file are those of ``test_tables.py``.
DAMAGES = {
    handmade: [
        (lambda t: t.settings.pop("form"), "its setting \"form\" is 'None', which is no form of a BSDF"),
        (lambda t: t.settings["form"].update(range=[3, -3]), "which is no form of a BSDF"),
        (lambda t: t.settings["form"].update(scale=[0, 0.1]), "which is no form of a BSDF"),
        (lambda t: t.settings["form"].update(terms=["third"]), "which is no form of a BSDF"),
        (lambda t: t.settings.update(lobes=[0.1, "x"]), r'its setting "lobes" is "\[0.1, \'x\'\]"'),
        (lambda t: t.arrays.update(proxy=StoredArray(np.zeros((5, 1), np.float32))), r"expected \(22, 1\)"),
        (lambda t: t.arrays.pop("primary_vw"), 'the array "primary_vw" is missing'),
        (lambda t: t.arrays.update(energy=StoredArray(np.full((3, 1), 2, np.float32))), "allowed is"),
    ],
    handmade_family: [
        (lambda t: t.settings.update(family=[{"name": "a b", "low": 0, "high": 1}]), "which are no parameters"),
        (lambda t: t.settings["family"].__setitem__(0, {"name": "a", "low": 1, "high": 1}), "are no parameters"),
        (lambda t: t.settings["family"].pop(), "has the shape"),
        (lambda t: t.settings.update(factors=[1]), r'its setting "factors" is \[1\]'),
        (lambda t: t.arrays.pop("mixing"), 'the array "mixing" is missing'),
        (lambda t: t.arrays.update(mixing=StoredArray(np.zeros((4, 3, 5), np.float32))), "channels, expected 15"),
        (lambda t: t.settings["form"].update(terms=[]), "a family needs a proxy"),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    "file, change, message", [(file, *damage) for file, damages in DAMAGES.items() for damage in damages]
)
def test_damaged_files_are_refused(tmp_path, file, change, message):
    table = file()
    change(table)
    save_table(tmp_path / "damaged.npz", table)
    with pytest.raises(TableError, match=message):
        TASK.load(tmp_path / "damaged.npz")


@pytest.fixture
def short(monkeypatch):
    """Trainings of a second."""
    monkeypatch.setattr(training, "SAMPLES", 2**14)
    monkeypatch.setattr(training, "STARTS", 1)
    monkeypatch.setattr(training, "PROXY", dataclasses.replace(training.PROXY, steps=60, batch=2**11))
    monkeypatch.setattr(pool.SphereView.__init__, "__defaults__", (7, 16, 16))


def test_a_plastic_is_fitted(types, short, tmp_path):
    """A fitted plastic has the picture and the albedo of its source, and a second fit writes the same bytes."""
    source = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.6]}}
    options = {"steps": 80, "batch": 2**11, "measure_every": 40, "progress": False}
    fitted = mi_diffind.fit("bsdf", source, **options)
    assert fitted.table.measured["psnr_db"] > max(65, fitted.history[0]["psnr_db"] - 1)
    assert fitted.table.measured["albedo_excess"] < 1e-3 and fitted.table.measured["sample_weight_moment"] < 1.3
    assert "isotropic" in fitted.lines[0] and "not reciprocal" not in fitted.lines[0]
    saved = load_table(fitted.save(tmp_path / "a.npz"))
    assert TASK.load(tmp_path / "a.npz").nbytes < 2300 and saved.settings["form"]["terms"] == list(TERMS)
    again = mi_diffind.fit("bsdf", source, **options).save(tmp_path / "b.npz")
    assert again.read_bytes() == (tmp_path / "a.npz").read_bytes()


@pytest.mark.parametrize("colour", [(0, 0, 0), (0.5, 0, 0.1)], ids=["black", "channel"])
def test_black_materials_are_fitted(mi_rgb, types, short, tmp_path, colour):
    """Black materials have the source's albedo in Mitsuba, in each channel, and no training is said to diverge."""
    source = {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(colour)}}
    fitted = mi_diffind.fit("bsdf", source, steps=20, batch=2**11, measure_every=20, progress=False)
    assert fitted.result.restarts == 0 and all(map(math.isfinite, fitted.table.measured.values()))
    fitted.save(tmp_path / "a.npz")
    bsdf = mi_rgb.load_dict({"type": "neural_bsdf", "filename": str(tmp_path / "a.npz")})
    si = interactions(mi_rgb, np.tile(np.float32([0.6, 0, 0.8]), (4096, 1)))
    _, weight = bsdf.sample(mi_rgb.BSDFContext(), si, *uniform(mi_rgb, np.random.default_rng(1), 4096))
    np.testing.assert_allclose(numpy_of(weight).mean(axis=0), colour, rtol=0.05, atol=1e-4 * max(colour))


@pytest.mark.parametrize(
    "front, back, said",
    [(0.5, None, []), (0.5, 0.5, ["it reflects on both sides"]), (0.5, 0.2, ["its back is another material"]),
     (math.nan, None, "100.0% of its values are not finite")],
)  # fmt: skip
def test_what_a_fit_leaves_out_is_said(types, front, back, said):
    """A back of its own, and values that are no numbers."""
    sides = [{"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, x, 0.3]}} for x in (front, back) if x]
    source = sides[0] if back is None else {"type": "twosided", "front": sides[0], "back": sides[1]}
    truth = truth_of(source, types)
    samples = training.draw(truth, types, 2**10, 1, True)
    if isinstance(said, str):
        with pytest.raises(UsageError, match=said):
            truth.remarks(samples)
    else:
        remarks = truth.remarks(samples)
        assert len(remarks) == len(said) and all(part in text for part, text in zip(said, remarks, strict=True))


# -- other formats, and sources opened again ---------------------------------------------------------------------------


@pytest.fixture
def saved(types, tmp_path):
    def opened(settings=None, **form):
        table = handmade(**form)
        table.settings |= settings or {}
        save_table(tmp_path / "learned.npz", table)
        return mi_diffind.open(tmp_path / "learned.npz")

    return opened


def test_tables_of_numbers(saved, tmp_path):
    """Rows are values of the formula at directions of a seed, in degrees."""
    opened = saved()
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


def test_pictures(mi_rgb, types, saved, tmp_path, monkeypatch):
    """A sphere stands beside its source if that can be opened again, else alone, with the reason."""
    monkeypatch.setattr(evaluation, "PASSES", 1)
    source = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.5, 0.7]}}
    settings = recorded_source({"source": source, "material": "", "uv": (0.5, 0.5), "angles": "", "illuminant": ""})
    assert json.loads(json.dumps(settings)) == settings
    for recorded, width in (({}, 256), (settings, 768)):
        [(path, line)] = saved(recorded).decode(tmp_path / f"{width}.exr")
        image = np.array(mi_rgb.Bitmap(str(path)))
        assert image.shape == (256, width, 3) and np.isfinite(image).all() and image[128, 128].min() > 0.01
        assert ("its source, and 8 times" in line) == (width == 768), line
    learned, exact, difference = np.split(image, 3, axis=1)
    np.testing.assert_allclose(difference, 8 * np.abs(learned - exact), atol=1e-3)
    # A white surface is lit more in each channel by what a coloured one absorbs of it
    white = saved({**settings, "dictionary": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 1}}})
    white.table.settings.pop("source", None)
    lit = evaluation.picture(white, white.source)[0][:, 256:512]
    np.testing.assert_allclose(exact, lit * [0.2, 0.5, 0.7], atol=2e-3)


def test_bad_outputs(saved, tmp_path):
    opened = saved()
    with pytest.raises(UsageError, match=r'found the extension ".png", allowed are .csv and .exr'):
        opened.decode(tmp_path / "a.png")
    with pytest.raises(UsageError, match=r"--rows and --seed need the extension \.csv"):
        opened.decode(tmp_path / "a.exr", seed=1)


def test_sources_are_opened_again(saved, types, tmp_path):
    """Measured is what a file's own source shows; a source in memory, lost or changed is named."""
    scene = tmp_path / "scene.xml"
    scene.write_text('<scene version="3.0.0"><bsdf type="diffuse" id="a"/><shape type="sphere"><ref id="a"/></shape>'
                     '<shape type="sphere"><bsdf type="roughplastic" id="b"/></shape></scene>')  # fmt: skip
    settings = {"material": "b", "uv": [0.5, 0.5], "source_path": "scene.xml"}
    opened = saved(settings)
    figures, truth = opened.measure(), opened.source()
    names = {"psnr_db", "albedo_excess", "albedo_largest", "albedo_largest_source", "sample_weight_moment"}
    assert set(figures) == names and 0 < figures["psnr_db"] < 60
    cosines = [math.cos(math.radians(angle)) for angle in (0, 45, 80)]
    moments = [mixture.second_moment(truth, opened.mixture, types, c, 2**16) for c in cosines]
    assert figures["sample_weight_moment"] == pytest.approx(np.mean(moments), rel=1e-6)
    with pytest.raises(TableError, match="was fitted to an object in memory, which cannot be opened again"):
        saved().measure()
    with pytest.raises(TableError, match="its source, b, has changed since"):
        saved(settings | {"source": "0"}).measure()
    scene.unlink()
    with pytest.raises(TableError, match=r"its source cannot be opened again: .*scene.xml: no such file"):
        saved(settings).measure()
    assert load_table(tmp_path / "learned.npz").settings["material"] == "b"
