"""Contract of the BSDFs: what every one of them keeps, in Mitsuba's own terms.

Energy, reciprocity and derivatives against differences are measured for the table of ``docs/trust.md`` in
``trust/test_properties.py``; frozen functions, numbers of threads and sensors in ``trust/test_state.py``.
"""

import itertools
import math
import subprocess
import sys
import textwrap
from pathlib import Path

import disney_materials
import drjit as dr
import learned_bsdfs
import numpy as np
import plugin_examples as examples
import pytest
import trust_properties as trust
from arrays import aligned, numpy_of
from bsdf_queries import (
    bitmap,
    close,
    contexts,
    equal_images,
    extreme_directions,
    gradients_enabled,
    interactions,
    key_of,
    random_directions,
    sphere_scene,
    texels,
    tile,
    uniform,
    vectors,
)
from half_vectors import HalfVectorSampling
from texture_scenes import refused
from variants import VARIANTS, set_variant

from mi_diffind import plugins
from mi_diffind.arrays.tables import save_table
from mi_diffind.tasks.disney import TASK as DISNEY
from mi_diffind.tasks.ggx import TASK as GGX

#: BSDF → its plugin, and parameters besides those of the plugin's example.
BSDFS = {
    "disney": ("disney", {}),
    "neural_disney": ("neural_disney", {"storage": "float32"}),
    "neural_disney paper": ("neural_disney", {"storage": "float32", "preset": "paper"}),
    "neural_ggx": ("neural_ggx", {"specular_reflectance": 0.8}),
    "neural_ggx paper": ("neural_ggx", {"preset": "paper"}),
    "neural_ggx uint8": ("neural_ggx", {"storage": "uint8"}),
    "neural_bsdf": ("neural_bsdf", {"storage": "float32"}),
    "neural_bsdf anisotropic": ("neural_bsdf", {"filename": "anisotropic.npz", "two_sided": True}),
    "neural_bsdf family": ("neural_bsdf", {"filename": "family.npz", "storage": "float32"}),
    "neural_material": ("neural_material", {"storage": "float32"}),
}

#: One BSDF of each plugin.
PLUGINS = tuple(name for name in BSDFS if " " not in name)

#: BSDFs whose arrays can be optimised.
TRAINED = ("neural_disney", "neural_disney paper", "neural_ggx", "neural_ggx paper", "neural_bsdf",
           "neural_bsdf family", "neural_material")  # fmt: skip

#: BSDF → parameters that may be textures, each with two values between which its effects change.
TEXTURED = {
    "disney": {"roughness": (0.3, 0.6), "clearcoat": (0.0, 0.5), "sheen": (0.0, 0.5), "metallic": (0.0, 0.5),
               "flatness": (0.0, 0.5), "anisotropic": (0.0, 0.5), "specular": (0.0, 0.5)},
    "neural_ggx": {"alpha": (0.3, 0.12), "eta": (0.0, 0.5), "k": (1.0, 2.5), "specular_reflectance": (1.0, 0.6)},
    "neural_bsdf family": {"roughness": (0.1, 0.5), "metallic": (0.2, 0.9)},
}  # fmt: skip
TEXTURED["neural_disney"] = TEXTURED["neural_disney paper"] = TEXTURED["disney"]
TEXTURED["neural_ggx paper"] = TEXTURED["neural_ggx"]

FOLDER = {}


@pytest.fixture(scope="module", autouse=True)
def folder(tmp_path_factory):
    """Folder of handmade files of ``neural_bsdf``."""
    path = FOLDER["path"] = tmp_path_factory.mktemp("bsdfs")
    form = {"isotropic": False, "scale": (0.05, 0.3), "azimuth": "half", "terms": ("first", "second")}
    save_table(path / "anisotropic.npz", learned_bsdfs.handmade(**form))
    save_table(path / "family.npz", learned_bsdfs.handmade_family())
    return path


@pytest.fixture
def in_folder(tmp_path, monkeypatch):
    """A failing χ² test leaves its histogram in the present folder."""
    monkeypatch.chdir(tmp_path)


def described(name, **more):
    """Description of a BSDF."""
    plugin, parameters = BSDFS[name]
    result = examples.example(plugin, **{**parameters, **more})
    handmade = FOLDER["path"] / Path(result.get("filename", "none")).name
    return {**result, "filename": str(handmade)} if handmade.is_file() else result


def load(mi, name, **more):
    return mi.load_dict(described(name, **more))


def intensities(mi, value):
    """Channels of a value without polarisation, (n, channels)."""
    return numpy_of(mi.unpolarized_spectrum(value))


def below_horizon(name, wi, wo):
    """Lanes in which a BSDF reflects nothing: the handmade anisotropic one has two sides."""
    signs = np.sign(wi[:, 2]), np.sign(wo[:, 2])
    return signs[0] * signs[1] <= 0 if "anisotropic" in name else np.minimum(*signs) <= 0


def total(value):
    """Sum of a colour, or of a Mueller matrix of colours, in each lane."""
    return value if dr.depth_v(value) <= 1 else sum(total(v) for v in value)


def answers(mi, bsdf, si, wo, u, ctx=None):
    """Value, density, direction, density and weight of a sample, as NumPy arrays (n, …)."""
    ctx = ctx or mi.BSDFContext()
    value, pdf = bsdf.eval_pdf(ctx, si, wo)
    bs, weight = bsdf.sample(ctx, si, *u)
    dr.eval(value, pdf, bs, weight)
    return [intensities(mi, value), *(numpy_of(v) for v in ([pdf], bs.wo, [bs.pdf])), intensities(mi, weight)]


def check_finite(results, what):
    """Answers are finite; values, densities and weights not negative; sampled directions of length 1."""
    value, pdf, wo, sampled_pdf, weight = results
    for name, v in (("value", value), ("pdf", pdf), ("sampled pdf", sampled_pdf), ("weight", weight)):
        wrong = ~(np.isfinite(v) & (v >= 0)).all(axis=1)
        assert not wrong.any(), (what, name, np.flatnonzero(wrong)[:5])
    assert np.isfinite(wo).all(), what
    np.testing.assert_allclose(np.linalg.norm(wo[sampled_pdf[:, 0] > 0], axis=1), 1, atol=1e-3)


# -- values, densities and samples -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "variant, name", [(v, name) for v in VARIANTS for name in BSDFS if v.endswith("ad_rgb") or name in PLUGINS]
)
def test_eval_pdf_and_sample_agree_in_every_context(variant, rng, name):
    """Lobes add up to the whole, nothing is below the horizon, and a context without lobes reflects nothing."""
    mi, n = set_variant(variant), 2000
    bsdf, wi, wo = load(mi, name), random_directions(rng, n), random_directions(rng, n)
    wi[::50, 2] *= -1
    wo[::31, 2] *= -1
    si, towards, u = interactions(mi, wi, np.full(n, 0.3)), vectors(mi, wo), uniform(mi, rng, n)
    below = below_horizon(name, wi, wo)
    parts = {}
    for context, (ctx, components) in contexts(mi, bsdf).items():
        value, both = bsdf.eval(ctx, si, towards), bsdf.eval_pdf(ctx, si, towards)
        bs, weight = bsdf.sample(ctx, si, *u)
        again = bsdf.eval_pdf(ctx, si, bs.wo)
        dr.eval(value, both, bs, weight, again)
        pdf, sampled_pdf, again_pdf = numpy_of([bsdf.pdf(ctx, si, towards), bs.pdf, again[1]]).T
        parts[context] = value = intensities(mi, value)
        np.testing.assert_allclose(intensities(mi, both[0]), value, rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(both[1].numpy(), pdf, rtol=1e-5, atol=1e-9)
        assert not value[below].any() and not pdf[below].any()
        valid, weight = sampled_pdf > 0, intensities(mi, weight)
        assert not weight[~valid].any() and valid.any() == bool(components)
        if not components:
            continue
        for found, expected, rtol in (
            (sampled_pdf[valid], again_pdf[valid], 1e-3),
            ((weight[valid].T * sampled_pdf[valid]).T, intensities(mi, again[0])[valid], 2e-3),
        ):
            # Where a lobe is narrow, rounding moves a direction, in a lane of a thousand
            assert close(found, expected, rtol).mean() > 0.998 and close(found, expected, 0.1).all(), context
        chosen, kind = (np.broadcast_to(v.numpy(), n)[valid] for v in (bs.sampled_component, bs.sampled_type))
        assert np.isin(chosen, components).all() and (bs.eta.numpy() == 1).all()
        assert all(mi.has_flag(bsdf.flags(int(c)), mi.BSDFFlags(int(k))) for c, k in {*zip(chosen, kind, strict=True)})
        if context == "all":  # a density that misses where the light is shows up as a huge weight
            assert valid[~below].mean() > 0.5 and np.quantile(weight, 0.999) < 8
    components = [part for context, part in parts.items() if context.startswith("component")]
    assert close(sum(components), parts["all"], 1e-4).all()


#: Case → BSDF, parameters, and the roughness of its narrowest lobe (``None``: by the formula of ``disney``).
LOBES = {
    **{f"disney {m}": ("disney", disney_materials.MATERIALS[m], None)
       for m in ("rich", "coat_only", "glossy_coat", "sheen_only", "smoothest", "brushed_mirror", "everything")},
    "neural_disney": ("neural_disney", disney_materials.RICH, None),
    "neural_disney paper": ("neural_disney paper", disney_materials.MATERIALS["half_metal"], None),
    **{f"neural_ggx {a}": ("neural_ggx", {"alpha": a}, a) for a in (1e-3, 0.05, 1.0)},
    "neural_ggx paper": ("neural_ggx paper", {"alpha": 0.2}, 0.2),
    "neural_bsdf": ("neural_bsdf anisotropic", {}, 0.1),
    "family": ("neural_bsdf family", {"roughness": 0.3, "metallic": 0.1}, 0.1),
    "rough family": ("neural_bsdf family", {"roughness": 0.75, "metallic": 0.9}, 0.5),
    **{f"component {c}": ("disney", disney_materials.RICH, None) for c in range(3)},
}  # fmt: skip


def lobe_sampling(mi, case, angle):
    name, parameters, alpha = LOBES[case]
    alpha = alpha or disney_materials.smallest_alpha(parameters)
    bsdf = mi.load_dict(disney_materials.plugin(mi, described(name), {**disney_materials.PLAIN, **parameters})
                        if "disney" in name else described(name, **parameters))  # fmt: skip
    ctx = mi.BSDFContext()
    if case.startswith("component"):
        ctx.component = int(case[-1])
    return HalfVectorSampling(mi, bsdf, angle, alpha, ctx)


CHI2_COUNT = 3 * len(LOBES)


@pytest.mark.parametrize(
    "case, angle", [(case, angle) for case in LOBES for angle in (5, 60, 89) if angle == 60 or "component" not in case]
)
def test_chi2(mi, case, angle, in_folder):
    """``sample`` draws from ``pdf``, also in a context of one of several components, in coordinates in which a lobe of
    any width is smooth.
    """
    messages, valid = lobe_sampling(mi, case, angle).faults(CHI2_COUNT)
    assert not messages, messages
    assert valid > 1e5, "hardly a sample is valid, the test says nothing"


@pytest.mark.parametrize("name", PLUGINS)
def test_chi2_on_the_sphere(mi, name, in_folder):
    """``sample`` draws from ``pdf``: nothing is hidden by the choice of coordinates."""
    cell = trust.chi2(mi, BSDFS[name][0], trust.Effort(chi2_samples=300_000, angles=(20, 80)))
    assert cell.result == trust.HOLDS, cell


@pytest.mark.parametrize("case, angle", [("neural_ggx 0.001", 60), ("disney rich", 85), ("family", 5)])
def test_chi2_has_power(mi, case, angle, in_folder):
    """Densities that are 3% too high or too low, or seen from 1° beside, are rejected at the same level."""
    right, beside = (lobe_sampling(mi, case, a) for a in (angle, angle + 1))
    seen = beside.interactions
    for what, pdf in {
        "high": lambda p: 1.03 * right.pdf(p),
        "low": lambda p: 0.97 * right.pdf(p),
        "beside": lambda p: right.mapped(p, lambda _, wo: beside.bsdf.pdf(beside.ctx, seen(dr.width(wo)), wo)),
    }.items():
        assert right.faults(CHI2_COUNT, pdf)[0], what


# -- inputs that are hard or none --------------------------------------------------------------------------------------

#: Vectors that are no directions: short ones, zero, NaN, infinite, far too long.
NONE = np.array([
    (0, 0, 1e-30), (1e-30, 2e-30, 1e-30), (0, 0, 0), (0, 0, 1e-45), (1e-45, 0, 1e-45), (1e-20, 0, 1e-20), (0, 0, 1e-8),
    (1e-8, 0, 1e-12), (1e-4, 1e-4, 1e-4), (0, 0, -1e-30), (np.nan, 0, 0.5), (0.1, np.nan, np.nan), (np.inf, 0, 1),
    (0, 0, 1e30), (0.6, 1e20, 0.8), (-np.inf, 0.6, 0.8), (3e38, 0, 0.8),
])  # fmt: skip

DIRECTIONS = np.array([(0.3, 0.2, 0.9), (-0.5, 0.1, 0.8), (0, 0, 1), (0.9, -0.3, 1e-3)])
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)

#: Pairs of which ``wi`` is none, of which ``wo`` is none, and of two directions.
FROM = np.array([(a, b) for a in NONE for b in (*DIRECTIONS, *NONE)])
TO = np.array([(b, a) for a in NONE for b in DIRECTIONS])
RIGHT = np.array([(a, b) for a in DIRECTIONS for b in DIRECTIONS])

HARDEST = [
    ("disney", {"roughness": 0.0, "clearcoat_gloss": 1.0, "metallic": 1.0}), ("neural_ggx", {"alpha": 0.0}),
    ("neural_ggx", {"alpha": 1.0, "eta": 0.0, "k": 0.0}),
]  # fmt: skip


@pytest.mark.parametrize("name, more", [*((name, {}) for name in BSDFS), *HARDEST])
def test_vectors_that_are_no_directions(mi, name, more):
    """Vectors of masked lanes: values and derivatives are 0, beside those of the pairs of directions."""
    pairs, wrong = np.concatenate([FROM, TO, RIGHT]), len(FROM) + len(TO)
    bsdf, n = load(mi, name, **more), len(pairs)
    si, towards = interactions(mi, pairs[:, 0], np.full(n, 0.3)), vectors(mi, pairs[:, 1])
    params = mi.traverse(bsdf)
    keys = [k for k in params.keys() if isinstance(params[k], dr.ArrayBase) and not k.endswith("_rate")]
    with gradients_enabled(mi, params, keys, n):
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, towards)
        bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.3), mi.Point2f(0.4, 0.6))
        unseen = dr.arange(mi.UInt32, n) < len(FROM)
        dr.backward(total(value) + dr.select(unseen, total(weight), 0))
        gradients = {key: dr.grad(params[key]) for key in keys}
        dr.eval(value, pdf, bs, weight, gradients)
    for v, none in ((value, wrong), ([pdf], wrong), ([bs.pdf], len(FROM)), (weight, len(FROM)), (bs.wo, 0)):
        v = np.stack([np.broadcast_to(c.numpy(), n) for c in v], axis=1)
        assert np.isfinite(v).all() and not v[:none].any() and v[wrong:].any()
    for key, gradient in gradients.items():
        assert np.isfinite(gradient.numpy()).all(), key
        assert dr.is_tensor_v(gradient) or not gradient.numpy()[..., :wrong].any(), key
    assert not keys or any(gradient.numpy().any() for gradient in gradients.values())


SPECIAL_VALUES = (0.0, 1.0, 0.5, 1e-40, 1e-8, 1 - 2**-24, float("nan"), float("inf"), -float("inf"), -1.0, 2.0)
SPECIAL_UNIFORM = (0.0, 0.5, 1 - 2**-24)


#: Parameters of which any number may be read from a texture.
CLAMPED = {"neural_ggx": ("alpha",), "neural_bsdf": ("roughness", "metallic")}


@pytest.mark.parametrize(
    "name, polarised",  # Mueller matrices are those of neural_ggx, or depolarise, as in disney
    [*((name, False) for name in BSDFS), ("disney", True), ("neural_ggx", True)],
)
def test_extreme_inputs(rng, name, polarised):
    """Extreme directions, random numbers and texels: values are finite and not negative, 0 below the horizon, and
    derivatives are finite.
    """
    mi, plugin, count, n = set_variant(VARIANTS[2] if polarised else VARIANTS[0]), BSDFS[name][0], 64, 2**14
    names = CLAMPED.get(plugin, disney_materials.SCALARS) if name in TEXTURED else ()
    tint = {"specular_reflectance": {"type": "rgb", "value": [0.5, 0.0, 0.9]}} if plugin == "neural_ggx" else {}
    bsdf = load(mi, name, **{p: texels(mi, np.full(count, 0.5)) for p in names}, **tint)
    params = mi.traverse(bsdf)
    keys = [key for key in params.keys() if dr.is_diff_v(params[key]) and not key.endswith("_rate")]
    for _ in range(1 if polarised else 4):
        for p in names:
            values = np.where(rng.random(count) < 0.7, rng.choice(SPECIAL_VALUES, count), rng.random(count))
            params[f"{p}.data"] = mi.TensorXf(aligned(np.stack([values[:, None]] * 2)))
        params.update()
        wi, wo = extreme_directions(rng, n)
        si = interactions(mi, wi, rng.integers(0, count, n), count)
        u = np.where(rng.random((3, n)) < 0.5, rng.choice(SPECIAL_UNIFORM, (3, n)), rng.random((3, n)))
        u = mi.Float(aligned(u[0])), mi.Point2f(aligned(u[1:]))
        with gradients_enabled(mi, params, keys, n):
            value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, vectors(mi, wo))
            bs, weight = bsdf.sample(mi.BSDFContext(), si, *u)
            dr.backward(100 * (total(value) + total(weight)))  # what follows in a chain may be more than 1
            gradients = {key: dr.grad(params[key]) for key in keys}
            dr.eval(value, pdf, bs, weight, gradients)
        value = intensities(mi, value)
        check_finite([value, *(numpy_of(v) for v in ([pdf], bs.wo, [bs.pdf])), intensities(mi, weight)], name)
        below = below_horizon(name, wi, wo)
        assert not value[below].any() and not pdf.numpy()[below].any()
        assert all(np.isfinite(gradient.numpy()).all() for gradient in gradients.values())


@pytest.mark.parametrize("name", [name for name in TEXTURED if name != "neural_disney paper"])
def test_texels_are_read_as_numbers_in_their_range(mi, rng, name):
    """Texels beyond the range count as its ends, NaN as the lower one: each by itself, whatever its neighbours are."""
    n = 3000
    low, high = (0.05, 0.8) if "family" in name else (0.0, 1.0)
    given = [2.0, math.inf, -1.0, 0.3, math.nan, -math.inf, 0.7]
    used = [high, high, low, 0.3, low, low, 0.7]
    names = list(TEXTURED[name])[:1] if "ggx" in name or "family" in name else list(TEXTURED[name])
    textured = load(mi, name, **{p: texels(mi, given) for p in names})
    lane, u = np.arange(n) % len(given), uniform(mi, rng, n)
    wi, wo = random_directions(rng, n), random_directions(rng, n)
    found = answers(mi, textured, interactions(mi, wi, lane, len(given)), vectors(mi, wo), u)
    for k, value in enumerate(used):
        expected = answers(mi, load(mi, name, **dict.fromkeys(names, value)), interactions(mi, wi), vectors(mi, wo), u)
        lanes = lane == k
        for a, b in zip(found[:2], expected[:2], strict=True):
            assert close(a[lanes], b[lanes], 2e-3).all(), (name, given[k])
        # A sample beside the threshold between two lobes may belong to the other one
        same = np.abs(found[2] - expected[2]).max(axis=1) < 1e-3
        assert same[lanes].mean() > 0.98 and close(found[4], expected[4], 0.01)[lanes & same].mean() > 0.99


@pytest.mark.parametrize("name", TRAINED)
def test_entries_of_any_value_are_harmless(mi, rng, name):
    """Each table in turn, all of it and one entry in four: answers are finite, and derivatives if the entries are."""
    n = 2000
    bsdf = load(mi, name)
    params, before, changed = mi.traverse(bsdf), None, set()
    tables = {key: np.array(params[key].numpy()) for key in params.keys() if "tables." in key}
    wi, wo = extreme_directions(rng, n)
    si, wo, u = interactions(mi, wi, np.full(n, 0.3)), vectors(mi, wo), uniform(mi, rng, n)
    before = answers(mi, bsdf, si, wo, u)
    for key, entries in tables.items():
        for wrong in (np.nan, 1e30, -1e30, np.inf, -np.inf):
            for share in (1, 0.25):
                poisoned = np.where(rng.random(entries.shape) < share, np.float32(wrong), entries)
                params[key] = mi.TensorXf(aligned(poisoned))
                params.update()
                found = answers(mi, bsdf, si, wo, u)
                check_finite(found, (key, wrong, share))
                # Beyond the rounding of another kernel: entries decide which lobes are traced
                if not np.allclose(found[0], before[0], rtol=1e-4, atol=1e-5):
                    changed.add(key)
        params[key] = mi.TensorXf(aligned(entries))
        params.update()
    # Each of them was read, but for levels of a footprint that is not empty
    assert changed == {key for key in tables if not key.endswith("coarse")}
    np.testing.assert_allclose(answers(mi, bsdf, si, wo, u)[0], before[0], rtol=1e-5)


# -- parameters that change --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["number", "bitmap", "texture"])
@pytest.mark.parametrize("name", [name for name in TEXTURED if "paper" not in name])
def test_updated_parameters_show(mi, rng, name, kind):
    """Values are those of a BSDF loaded so: of numbers, of bitmaps, and of a texture that is updated by itself, of
    which nobody tells the material; also what was left out, or evaluated once.
    """
    n = 1000
    si, wo = interactions(mi, random_directions(rng, n, 0.1), np.zeros(n)), vectors(mi, random_directions(rng, n, 0.1))
    base = {"eta": 0.5} if "ggx" in name else {"base_color": {"type": "rgb", "value": [0.6, 0.3, 0.2]}}
    base = {} if "family" in name else base

    def value(bsdf):
        return intensities(mi, bsdf.eval(mi.BSDFContext(), si, wo))

    for i, (parameter, ends) in enumerate(TEXTURED[name].items()):
        # Half of them with all effects: then, nothing but the constants themselves can be out of date
        base |= {"effects": ("used", "all")[i % 2]} if "disney" in name else {}
        texture = mi.load_dict({"type": "uniform", "value": ends[0]})
        given = {"number": ends[0], "bitmap": bitmap(mi, np.full((2, 2), ends[0])), "texture": texture}[kind]
        changed = load(mi, name, **{**base, parameter: given})
        fresh = [value(load(mi, name, **{**base, parameter: end})) for end in ends]
        assert not np.allclose(*fresh, rtol=1e-2), parameter
        np.testing.assert_allclose(value(changed), fresh[0], rtol=1e-3, atol=1e-5)
        params = mi.traverse(texture if kind == "texture" else changed)
        key = next(k for k in params.keys() if k in (parameter, f"{parameter}.value", f"{parameter}.data", "value"))
        for end in (1, 0, 1):
            new = np.full((2, 2, 1), ends[end], np.float32)
            params[key] = mi.TensorXf(aligned(new)) if kind == "bitmap" else mi.Float(ends[end])
            params.update()
            np.testing.assert_allclose(value(changed), fresh[end], rtol=1e-3, atol=1e-5, err_msg=f"{parameter} {end}")


@pytest.mark.parametrize("name, parameter", [("disney", "clearcoat"), ("neural_ggx", "alpha")])
def test_textures_that_vary_without_saying_so(mi, name, parameter):
    """Mitsuba's ``mesh_attribute`` calls itself constant: its value at no mesh at all is not that of the material."""
    images = []
    for value in ({"type": "mesh_attribute", "name": "vertex_value"}, 0.5):
        mesh = mi.Mesh("quad", 4, 2)
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0])
        params["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
        params.update()
        mesh.add_attribute("vertex_value", 1, [0.5] * 4)
        mesh.set_bsdf(load(mi, name, **{parameter: value}))
        images.append(mi.render(sphere_scene(mi, [], "direct", columns=1, mesh=mesh), spp=4).numpy())
    assert images[0].max() > 0.1 and equal_images(*images)


#: BSDF → parameters at the values at which they are left out, with their effects.
LEFT_OUT = {
    "disney": (dict.fromkeys(("clearcoat", "sheen", "metallic", "flatness", "anisotropic"), 0.0),
               ("clearcoat", "sheen", "metal", "subsurface", "anisotropic")),
    "neural_ggx": ({"eta": 0.0, "k": 1.0, "specular_reflectance": 1.0}, ("fresnel", "specular_reflectance")),
}  # fmt: skip
LEFT_OUT["neural_disney"] = LEFT_OUT["disney"]


@pytest.mark.parametrize("update", [False, True])
@pytest.mark.parametrize("name", LEFT_OUT)
def test_an_optimised_parameter_keeps_its_effect(mi, name, update):
    """An optimised parameter at the value at which its effect is left out has a gradient, through the renderer, too."""
    values, effects = LEFT_OUT[name]
    scene = sphere_scene(mi, described(name, **values), "prb", size=8)
    params, bsdf = mi.traverse(scene), scene.shapes()[0].bsdf()
    keys = [key_of(params, f"{parameter}.value") for parameter in values]
    before = bsdf.report()["effects_in_use"]
    assert not set(effects) & set(before)
    for key in keys:
        dr.enable_grad(params[key])
    if update:
        params.update()
    dr.backward(dr.sum(mi.render(scene, params, spp=16), axis=None))
    gradients = {key: params[key].grad.numpy() for key in keys}
    assert all(np.isfinite(g).all() for g in gradients.values())
    assert all(g[0] != 0 for key, g in gradients.items() if not key.endswith(("eta.value", "k.value")))  # an extremum
    assert set(effects) <= set(bsdf.report()["effects_in_use"])
    for key in keys:
        dr.disable_grad(params[key])
    params.update()
    assert bsdf.report()["effects_in_use"] == before


@pytest.mark.parametrize("update", [False, True])
@pytest.mark.parametrize("name", ["neural_disney", "neural_disney paper", "neural_ggx", "neural_bsdf family"])
def test_tables_keep_their_gradients_where_parameters_are_constant(mi, rng, name, update):
    """Constant parameters are evaluated once, and yet tables that are trained get derivatives."""
    n, gradients = 1000, []
    si, wo = interactions(mi, random_directions(rng, n, 0.1), np.zeros(n)), vectors(mi, random_directions(rng, n, 0.1))
    constants = {p: ends[1] for p, ends in TEXTURED[name].items()}
    for given in (constants, {p: bitmap(mi, np.full((2, 2), v)) for p, v in constants.items()}):
        bsdf = load(mi, name, **given)
        params = mi.traverse(bsdf)
        keys = [k for k in params.keys() if k.startswith("tables.")]
        for key in keys:
            dr.enable_grad(params[key])
        if update:
            params.update()
        dr.backward(total(bsdf.eval(mi.BSDFContext(), si, wo)))
        gradients.append({key: params[key].grad.numpy() for key in keys})
    for key, expected in gradients[1].items():
        scale = np.abs(expected).max()
        assert scale > 0 and np.isfinite(gradients[0][key]).all(), key
        np.testing.assert_allclose(gradients[0][key], expected, rtol=1e-3, atol=2e-3 * scale, err_msg=key)


@pytest.mark.parametrize("name", TRAINED[:-1])  # the maps of one file are shared by all that read it
def test_assigned_tables_are_those_of_one_instance(mi, rng, name):
    """Tables of two instances of one file are apart."""
    n = 500
    si, wo = interactions(mi, random_directions(rng, n), np.full(n, 0.3)), vectors(mi, random_directions(rng, n))
    first, second = (load(mi, name) for _ in range(2))
    before = intensities(mi, second.eval(mi.BSDFContext(), si, wo))
    params = mi.traverse(first)
    for key in [k for k in params.keys() if "tables." in k]:
        params[key] = type(params[key])(aligned(np.float32(0.8) * params[key].numpy()))
    params.update()
    assert not np.allclose(intensities(mi, first.eval(mi.BSDFContext(), si, wo)), before, rtol=1e-2)
    np.testing.assert_array_equal(intensities(mi, second.eval(mi.BSDFContext(), si, wo)), before)


@pytest.mark.parametrize(
    "name, is_textured",
    [
        ("neural_bsdf anisotropic", False),
        *itertools.product(("neural_bsdf family", "neural_ggx", "neural_ggx paper"), (False, True)),
    ],
)
def test_gradients_against_differences(mi, rng, name, is_textured):
    """Derivatives by parameters, numbers or texels, and by tables. (``docs/trust.md`` has the default forms.)"""
    n = 2**13
    ends = TEXTURED.get(name, {})
    given = {p: texels(mi, np.linspace(*pair, 4)) if is_textured else pair[1] for p, pair in ends.items()}
    bsdf = load(mi, name, **given)
    wi, wo = random_directions(rng, n, 0.3), random_directions(rng, n, 0.3)
    params, si, towards = mi.traverse(bsdf), interactions(mi, wi, np.arange(n) % 4, 4), vectors(mi, wo)
    keys = [key for key in params.keys() if dr.is_diff_v(params[key])]
    worst, names = trust.compared(lambda: total(bsdf.eval(mi.BSDFContext(), si, towards)), params, keys, rng)
    assert worst <= 0.03 and len(names) >= 4


# -- scenes ------------------------------------------------------------------------------------------------------------


def test_every_variant_renders(mi_any):
    """A sphere for each plugin: the luminance is that of RGB, Mueller matrices and spectra included."""
    means = []
    for variant in (VARIANTS[0], mi_any.variant()):
        mi = set_variant(variant)
        image = mi.render(sphere_scene(mi, [described(name) for name in PLUGINS], size=48, columns=3, depth=2), spp=64)
        image = image.numpy() @ ([0.2127, 0.7152, 0.0722] if image.shape[2] == 3 else [1.0])
        assert np.isfinite(image).all() and image.min() >= 0
        means.append([tile(image, i, 3, 16).mean() for i in range(len(PLUGINS))])
    np.testing.assert_allclose(means[1], means[0], rtol=0.08)


@pytest.mark.parametrize("integrator", ["path", "prb", "direct"])
def test_several_materials_in_one_loop(mi, integrator):
    """Each sphere looks as it does where it is the only one that is not black: other plugins, tables and storage."""
    names = list(BSDFS)
    black = {"type": "diffuse", "reflectance": 0.0}

    def image(chosen):
        bsdfs = [described(name) if name in chosen else black for name in names]
        return mi.render(sphere_scene(mi, bsdfs, integrator, 32, columns=4, depth=2), spp=4).numpy()

    together = image(names)
    for name in ("neural_disney paper", "neural_ggx uint8", "neural_bsdf family"):
        i = names.index(name)
        assert equal_images(tile(together, i, 4, 8), tile(image([name]), i, 4, 8)), name
    assert np.array_equal(together, image(names))


@pytest.mark.parametrize("name, count", [("neural_disney", 600), ("neural_ggx", 300), ("neural_bsdf family", 200)])
def test_many_materials_are_loaded_while_a_render_is_running(mi, name, count):
    """Mitsuba constructs objects in parallel. A constructor that waits for a kernel lets its thread start on the next
    object in the meantime, one inside the other, until Python's stack is full.
    """
    parameter = "alpha" if name == "neural_ggx" else "roughness"
    running = sphere_scene(mi, {"type": "diffuse"})
    mi.render(running, spp=16).numpy()
    image = mi.render(running, spp=10_000)
    dr.eval(image)  # begins, and does not wait
    failure = ""
    try:
        scene = sphere_scene(mi, [described(name, **{parameter: 0.2 + 0.0005 * i}) for i in range(count)])
        assert len(scene.shapes()) == count
    except RuntimeError as e:
        failure = str(e).strip().splitlines()[-1]  # thousands of lines
    dr.sync_thread()
    assert not failure


def test_scenes_are_loaded_in_many_threads():
    """In a process of its own, which may hang without taking the tests along."""
    script = textwrap.dedent(
        """
        import sys, threading
        sys.path[:0] = [HELPERS]
        import mi_diffind
        import mitsuba as mi
        import plugin_examples as examples
        mi.set_variant("llvm_ad_rgb")
        # As long as a scene exists, threads do not create and free Embree's device at once
        kept = mi.load_dict({"type": "scene", "sphere": {"type": "sphere"}})
        loaded, plugins = [], ("neural_ggx", "disney", "neural_disney", "neural_bsdf", "neural_material")
        number = {"neural_ggx": "alpha", "neural_bsdf": "scale"}

        def load(k):
            mi.set_variant("llvm_ad_rgb")
            for i in range(3):
                bsdfs = [examples.example(n, **{number.get(n, "clearcoat"): 0.1}) for n in 3 * plugins]
                spheres = [{"type": "sphere", "center": [j, i, k], "bsdf": bsdf} for j, bsdf in enumerate(bsdfs)]
                loaded.append(mi.load_dict({"type": "scene", **{f"s{j}": s for j, s in enumerate(spheres)}}))

        threads = [threading.Thread(target=load, args=(k,)) for k in range(8)]
        [t.start() for t in threads]
        [t.join() for t in threads]
        assert all(len(scene.shapes()) == 15 and all(s.bsdf().report() for s in scene.shapes()) for scene in loaded)
        print(len(loaded))
        """
    ).replace("HELPERS", repr(str(Path(examples.__file__).parent)))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and done.stdout.strip() == "24", done.stderr[-2000:]


# -- files and mistakes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("plugin, task", [("neural_ggx", GGX), ("neural_disney", DISNEY)])
def test_own_tables(mi, rng, tmp_path, plugin, task):
    """``filename`` is read, relative to the scene, in the form that is asked for or its own."""
    n = 500
    si, wo = interactions(mi, random_directions(rng, n)), vectors(mi, random_directions(rng, n))
    for preset in task.presets:
        save_table(tmp_path / "own.npz", task.load(task.file(preset=preset)).to("uint8"))
        (tmp_path / "m.xml").write_text(
            f'<bsdf version="3.0.0" type="{plugin}"><string name="filename" value="own.npz"/></bsdf>'
        )
        own = mi.load_file(str(tmp_path / "m.xml"))
        shipped = mi.load_dict({"type": plugin, "preset": preset, "storage": "uint8"})
        report = own.report()
        assert (report["preset"], report["storage"]) == (preset, "uint8") and report == shipped.report()
        assert f"preset = {preset}, {report['table_bytes']} bytes as uint8" in str(own)
        values = [intensities(mi, bsdf.eval(mi.BSDFContext(), si, wo)) for bsdf in (own, shipped)]
        np.testing.assert_array_equal(*values)
        floats = mi.load_dict({"type": plugin, "filename": str(tmp_path / "own.npz"), "storage": "float32"})
        assert floats.report()["storage"] == "float32"
    with pytest.raises(RuntimeError, match='holds tables of the preset "paper", "tables" was asked for'):
        mi.load_dict({"type": plugin, "filename": str(tmp_path / "own.npz"), "preset": "tables"})


RANGES = [
    (parameter, value, f'parameter "{parameter}": found {value:g}, allowed is [0, 1]')
    for parameter, value in (("roughness", 1.5), ("metallic", -0.1), ("sheen", math.nan), ("specular", 1e30))
]

#: Plugin, parameters, and a sentence of the refusal.
MISTAKES = [
    *((plugin, {name: value}, text) for plugin in ("disney", "neural_disney") for name, value, text in RANGES),
    ("disney", {"eta": 0.5}, 'parameter "eta": found 0.5, allowed is [1, 3.0]'),
    ("disney", {"eta": 1.5, "specular": 0.5}, 'parameter "eta": sets the same reflectance as "specular"'),
    ("disney", {"flatness": 0.5, "subsurface": 0.5}, 'parameter "subsurface": is another name of "flatness"'),
    ("disney", {"spec_trans": 0.5}, 'parameter "spec_trans": found 0.5'),
    *(("disney", {"clearcoat_sampling_rate": v}, f'"clearcoat_sampling_rate": found {v:g}, allowed is [0, 1e+30]')
      for v in (-1.0, 1e31, math.nan)),
    ("disney", {"roughnes": 0.5}, '"roughnes"'),
    ("neural_disney", {"effects": "some"}, 'parameter "effects": found "some", allowed are used, all'),
    ("neural_disney", {"quality": "paper"}, '"quality"'),
    *((plugin, {"storage": "float8"}, 'parameter "storage": found "float8", allowed are float32, float16, uint8')
      for plugin in ("neural_disney", "neural_ggx")),
    *((plugin, {"preset": "best"}, 'parameter "preset": found "best", allowed are tables, paper')
      for plugin in ("neural_disney", "neural_ggx")),
    *((plugin, {"filename": "nowhere.npz"}, "nowhere.npz: no such file")
      for plugin in ("neural_disney", "neural_ggx", "neural_bsdf", "neural_material")),
    *((plugin, {"filename": str(GGX.file())}, f'holds tables for the task "ggx", expected "{task}"')
      for plugin, task in (("neural_disney", "disney"), ("neural_bsdf", "bsdf"))),
    ("neural_ggx", {"filename": str(DISNEY.file())}, 'holds tables for the task "disney", expected "ggx"'),
    *(("neural_ggx", {"alpha": v}, f'parameter "alpha": found {v:g}, allowed is [0, 1]') for v in (1.5, math.nan)),
    ("neural_ggx", {"alpha_u": 0.1, "alpha_v": 0.2}, 'parameter "alpha_u": the tables are isotropic, give "alpha"'),
    ("neural_ggx", {"distribution": "beckmann"}, 'parameter "distribution": found beckmann, only ggx is allowed'),
    ("neural_ggx", {"sample_visible": False}, 'parameter "sample_visible": found false, only true is allowed'),
    ("neural_ggx", {"material": "Unobtainium"}, 'found "Unobtainium", Mitsuba has no such preset'),
    *(("neural_ggx", {"material": "Cu", name: 1.5}, 'parameter "material": sets "eta" and "k", give either')
      for name in ("eta", "k")),
    ("neural_ggx", {"roughness": 0.5}, 'float "roughness"'),
    ("neural_bsdf", {}, 'parameter "filename": not given, a table file is needed'),
    ("neural_bsdf", {"filename": "family.npz", "roughness": 0.01}, 'found 0.01, allowed is [0.05, 0.8]'),
    ("neural_bsdf", {"filename": "family.npz", "alpha": 0.1}, '"alpha"'),
    *(("neural_bsdf", {"filename": "anisotropic.npz", **more}, text) for more, text in (
        ({"scale": 1.5}, 'parameter "scale": found 1.5, allowed is [0, 1]'),
        ({"energy": "low"}, 'parameter "energy": found "low", allowed are source, raw'),
        ({"two_sided": 3}, 'parameter "two_sided": found 3, allowed are true and false'),
        ({"evaluate": "it"}, 'parameter "evaluate": found "it", allowed are learned, source'))),
]  # fmt: skip


@pytest.mark.parametrize("plugin, parameters, sentence", MISTAKES)
def test_mistakes_are_refused(mi, folder, plugin, parameters, sentence):
    """One sentence that names the parameter, what was found and what is allowed."""
    if (folder / parameters.get("filename", "none")).is_file():
        parameters = {**parameters, "filename": str(folder / parameters["filename"])}
    assert sentence in refused(mi, {"type": plugin, **parameters})


def test_the_contract_has_every_bsdf(mi):
    assert {name for name, plugin in plugins.declared().items() if plugin.object_type == "bsdf"} == set(PLUGINS)
