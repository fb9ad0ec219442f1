"""
The plugin ``neural_ggx`` inside Mitsuba: against its exact counterpart and an independent implementation, where that is
hardest, and under what scenes do to a material.
"""

import functools
import gc
import itertools
import math
import re
import subprocess
import sys
import textwrap
from types import SimpleNamespace

import drjit as dr
import ggx_formulas
import numpy as np
import pytest
from arrays import aligned
from gradients import gradients_enabled
from half_vectors import HalfVectorSampling
from spheres import key_of, sphere_scene
from variants import VARIANTS, set_variant

from mi_diffind.arrays.boxes import ValueBounds
from mi_diffind.arrays.tables import StoredArray, save_table
from mi_diffind.core import compat
from mi_diffind.measure.operations import bsdf_operations
from mi_diffind.scenes import comparison, loading
from mi_diffind.tasks.disney import TASK as DISNEY
from mi_diffind.tasks.ggx import TASK
from mi_diffind.tasks.ggx.files import encoding_of
from mi_diffind.tasks.ggx.model import ALPHA_FLOOR

EXACT = {"type": "roughconductor", "distribution": "ggx"}

#: The learned plugin in each preset and storage form.
FORMS = {
    "tables": {"type": "neural_ggx"},
    "tables float16": {"type": "neural_ggx", "storage": "float16"},
    "tables uint8": {"type": "neural_ggx", "storage": "uint8"},
    "paper": {"type": "neural_ggx", "preset": "paper"},
    "paper uint8": {"type": "neural_ggx", "preset": "paper", "storage": "uint8"},
}

PRESETS = tuple(TASK.presets)

SLOW = pytest.mark.slow


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


#: What is not said is as in the plugins' defaults: α 0.1, all is reflected.
MATERIALS = {
    "white": {},
    "copper": {"material": "Cu"},
    "rough gold": {"material": "Au", "alpha": 0.3},
    "an index": {"eta": 1.5, "k": 2.0, "alpha": 0.43},
    "a coloured index": {"eta": rgb(0.2, 0.4, 1.3), "k": rgb(2.2, 3.4, 1.3), "alpha": 0.07},
    "tinted": {"alpha": 0.03, "specular_reflectance": rgb(0.3, 0.5, 0.9)},
    "black": {"alpha": 0.2, "specular_reflectance": 0.0},
    "roughest": {"alpha": 1.0, "material": "Al"},
    "a grey roughness": {"alpha": rgb(0.3, 0.3, 0.3)},
    "a uniform roughness": {"alpha": {"type": "uniform", "value": 0.6}, "material": "none"},
}


# -- helpers -----------------------------------------------------------------------------------------------------------


def bitmap(mi, values, **more):
    """A texture of ``values``, (height, width[, channels]), read as they are."""
    values = np.asarray(values, np.float32)
    data = mi.TensorXf(aligned(values.reshape(*values.shape[:2], -1)))
    nearest = {"type": "bitmap", "data": data, "raw": True, "filter_type": "nearest", "format": "variant"}
    return mi.load_dict({**nearest, **more})


def texels(mi, values):
    """A texture of two or more ``values`` in a row, read at the ``uv`` of :func:`interactions`."""
    return bitmap(mi, [values] * 2)  # Mitsuba wants two rows


def interactions(mi, wi, texel=None, count=1):
    """Interactions that see ``wi``, at the texels with the numbers ``texel`` (of ``count``)."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wi))
    si.wi = wi
    if texel is not None:
        si.uv = mi.Point2f(mi.Float(aligned((np.asarray(texel) + 0.5) / count)), 0.5)
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(450, 520, 580, 650)
    return si


def random_directions(rng, n, low=0.0):
    """(n, 3), uniform over the part of the hemisphere with cosines above ``low``."""
    z = low + (1 - low) * rng.random(n)
    phi, r = 2 * np.pi * rng.random(n), np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1).astype(np.float32)


def vectors(mi, w):
    return mi.Vector3f(aligned(np.asarray(w, np.float32).T))


def mirrored(rng, wi, alpha):
    """Directions next to the one in which a mirror reflects, as far as a lobe of that roughness goes."""
    r, phi = np.tan(alpha) * np.sqrt(1 / rng.random(len(wi)) - 1), 2 * np.pi * rng.random(len(wi))
    h = np.stack([r * np.cos(phi), r * np.sin(phi), np.ones(len(wi))], axis=1)
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    wo = 2 * np.sum(wi * h, axis=1, keepdims=True) * h - wi
    return np.where(wo[:, 2:] > 1e-3, wo, wi * [-1, -1, 1]).astype(np.float32)


def directions(rng, n, alpha, low=0.05):
    """Pairs of directions, half of them next to each other's reflection."""
    wi = random_directions(rng, n, low)
    return wi, np.where((np.arange(n) % 2 == 0)[:, None], random_directions(rng, n, low), mirrored(rng, wi, alpha))


def uniform(mi, rng, n):
    u = [mi.Float(aligned(rng.random(n))) for _ in range(3)]
    return u[0], mi.Point2f(u[1], u[2])


def roughness_of(material):
    alpha = material.get("alpha", 0.1)
    value = alpha["value"] if isinstance(alpha, dict) else alpha
    return max(float(np.mean(value)), ALPHA_FLOOR)


def normals(form):
    """What the tables of a form say, read by NumPy and SciPy."""
    table = shipped(FORMS[form].get("preset", "tables"))
    encoding = encoding_of(table)
    return ggx_formulas.learned(table.to(FORMS[form].get("storage", table.storage)), encoding.inputs, encoding.output)


def shipped(preset):
    return TASK.load(TASK.file(preset=preset))


def total(value):
    """
    Sum of a colour, or of a Mueller matrix of colours, in each lane. ``dr.backward`` of it is that of the sum over all
    lanes, which would be a kernel of its own.
    """
    if dr.depth_v(value) <= 1:
        return value
    return sum(total(v) for v in value)


def equal_images(a, b):
    """But for a few paths that rounding sends elsewhere."""
    return (np.abs(a - b) <= 1e-4 * (np.abs(b) + 1e-2)).mean() > 0.99 and abs(a.mean() / b.mean() - 1) < 1e-3


def tile(image, i, columns, size):
    return image[size * (i // columns) : size * (i // columns + 1), size * (i % columns) : size * (i % columns + 1)]


# -- values ------------------------------------------------------------------------------------------------------------


#: A colour in the place of a number, which would depend on the wavelength; and whether the variant is spectral.
IMPOSSIBLE = ("a grey roughness", True)

#: Each of these is a way of its own through colours and polarisation, the others are not.
COLOURED = ("white", "copper", "a coloured index", "tinted", "a grey roughness")


@pytest.mark.parametrize(
    "variant, material",
    [
        (variant, material)
        for variant in VARIANTS
        for material in MATERIALS
        if variant.endswith("ad_rgb") or (material in COLOURED and (material, "spectral" in variant) != IMPOSSIBLE)
    ],
)
def test_the_exact_plugin_times_what_the_table_says(variant, rng, material):
    """
    Value and weight are those of ``roughconductor`` times D̂/D, which NumPy and SciPy read in the table file: everything
    but the distribution is equal up to rounding, Mueller matrices included. Samples and densities are equal.
    """
    mi, m, n = set_variant(variant), MATERIALS[material], 10_000
    alpha = roughness_of(m)
    wi, wo = directions(rng, n, alpha)
    si, u = interactions(mi, vectors(mi, wi)), uniform(mi, rng, n)
    exact, learned = mi.load_dict({**EXACT, **m}), mi.load_dict({**FORMS["tables"], **m})
    modes = (mi.TransportMode.Radiance, mi.TransportMode.Importance)
    for mode in modes if material == "copper" else modes[:1]:  # it exchanges Stokes bases, whatever the material
        ctx = mi.BSDFContext()
        ctx.mode = mode
        bs, weight = exact.sample(ctx, si, *u)
        value, pdf = exact.eval_pdf(ctx, si, vectors(mi, wo))
        bs_, weight_ = learned.sample(ctx, si, *u)
        value_, pdf_ = learned.eval_pdf(ctx, si, vectors(mi, wo))
        dr.eval(bs, weight, value, pdf, bs_, weight_, value_, pdf_)
        np.testing.assert_array_equal(bs_.wo.numpy(), bs.wo.numpy())
        np.testing.assert_allclose(pdf_.numpy(), pdf.numpy(), rtol=1e-5)
        valid = bs.wo.z.numpy() > 1e-3
        assert valid.mean() > 0.5
        np.testing.assert_allclose(bs_.pdf.numpy()[valid], bs.pdf.numpy()[valid], rtol=2e-3)
        assert not bs_.pdf.numpy()[bs.wo.z.numpy() <= 0].any()
        for name in ("eta", "sampled_type", "sampled_component"):
            assert (getattr(bs_, name).numpy() == getattr(bs, name).numpy()).all()
        for found, given, out in ((value_, value, wo), (weight_, weight, bs.wo.numpy().T)):
            found, given = found.numpy()[..., valid].astype(np.float64), given.numpy()[..., valid]
            sin2 = ggx_formulas.half_sin2(wi[valid], out[valid])
            ratio = normals("tables")(sin2, alpha) / ggx_formulas.distribution(sin2, alpha)
            assert np.median(np.abs(ratio - 1)) < 0.03  # that of the tail, which is the same all along
            expected = given * ratio
            scale = np.abs(expected).reshape(-1, len(sin2)).max(axis=0)
            if material == "black":
                assert not found.any() and not given.any()
                continue
            assert (np.abs(found - expected) <= 3e-3 * scale + 1e-6).all(), np.max(np.abs(found - expected) / scale)


@pytest.mark.parametrize("form", list(FORMS))
@pytest.mark.parametrize("textured", [False, True])
def test_the_independent_conductor(mi_rgb, rng, form, textured):
    """Many roughnesses, as texels or one after the other, against Walter's formulas with the table read by SciPy."""
    mi, n = mi_rgb, 4000
    alphas = [0.01, 0.0437, 0.2, 0.55, 1.0]
    eta, k = 0.3, 2.7
    wi, wo = (np.concatenate(v) for v in zip(*(directions(rng, n, a) for a in alphas), strict=True))
    lane = np.repeat(np.arange(len(alphas)), n)
    if textured:
        bsdf = mi.load_dict({**FORMS[form], "alpha": texels(mi, alphas), "eta": eta, "k": k})
        si = interactions(mi, vectors(mi, wi), lane, len(alphas))
        value, pdf = (v.numpy() for v in bsdf.eval_pdf(mi.BSDFContext(), si, vectors(mi, wo)))
    else:
        value, pdf = np.zeros((3, len(lane))), np.zeros(len(lane))
        for i, alpha in enumerate(alphas):
            bsdf = mi.load_dict({**FORMS[form], "alpha": alpha, "eta": eta, "k": k})
            assert bsdf.report()["evaluated_once"] == ["roughness"]
            si = interactions(mi, vectors(mi, wi[lane == i]))
            found = bsdf.eval_pdf(mi.BSDFContext(), si, vectors(mi, wo[lane == i]))
            value[:, lane == i], pdf[lane == i] = (v.numpy() for v in found)
    alpha = np.array(alphas)[lane]
    np.testing.assert_allclose(pdf, ggx_formulas.density(wi, wo, alpha), rtol=5e-4)
    expected = ggx_formulas.conductor(wi, wo, alpha, eta, k, normals(form))
    error = np.abs(value - expected) / (expected + 1e-3)
    # Bytes are read at 1/64 of a step, which the paper's unbounded output does not forgive
    bound = {"tables uint8": 0.02, "paper uint8": 0.3}.get(form, 4e-3)
    assert error.max() < bound and np.quantile(error, 0.99) < bound / 2


@pytest.mark.parametrize(
    "variant, form", [(v, form) for v in VARIANTS for form in FORMS if v.endswith("ad_rgb") or form == "tables"]
)
def test_eval_pdf_and_sample_agree_in_every_context(variant, rng, form):
    """
    What is read is a number in all variants: the forms, and numbers and textures, differ in none that they do not
    differ in by RGB.
    """
    mi, n = set_variant(variant), 2000
    wi, wo = random_directions(rng, n), random_directions(rng, n)
    wi[::50, 2] *= -1
    wo[::31, 2] *= -1
    alphas = [0.02, 0.1, 0.4, 1.0]
    si = interactions(mi, vectors(mi, wi), np.arange(n) % 4, 4)
    wo_, u = vectors(mi, wo), uniform(mi, rng, n)
    for alpha in (texels(mi, alphas), *((0.25,) if mi.is_rgb else ())):
        bsdf = mi.load_dict({**FORMS[form], "material": "Cu", "alpha": alpha})
        assert bsdf.component_count() == 1
        for component, mask in ((None, None), (0, None), (1, None), (None, "GlossyReflection"), (None, "Diffuse")):
            ctx = mi.BSDFContext()
            ctx.component = component if component is not None else ctx.component
            ctx.type_mask = getattr(mi.BSDFFlags, mask) if mask else ctx.type_mask
            value, pdf = bsdf.eval(ctx, si, wo_), bsdf.pdf(ctx, si, wo_)
            both = bsdf.eval_pdf(ctx, si, wo_)
            bs, weight = bsdf.sample(ctx, si, *u)
            again = bsdf.eval_pdf(ctx, si, bs.wo)
            dr.eval(value, pdf, both, bs, weight, again)
            np.testing.assert_allclose(both[0].numpy(), value.numpy(), rtol=1e-5, atol=1e-6)
            np.testing.assert_allclose(both[1].numpy(), pdf.numpy(), rtol=1e-5)
            below = (wi[:, 2] <= 0) | (wo[:, 2] <= 0)
            assert not value.numpy()[..., below].any() and not pdf.numpy()[below].any()
            valid, weight = bs.pdf.numpy() > 0, weight.numpy()
            assert not weight[..., ~valid].any()
            if component == 1 or mask == "Diffuse":
                assert not value.numpy().any() and not pdf.numpy().any() and not valid.any()
                continue
            assert valid[wi[:, 2] > 0].mean() > 0.7 and not valid[wi[:, 2] <= 0].any()
            np.testing.assert_allclose(bs.pdf.numpy()[valid], again[1].numpy()[valid], rtol=1e-4)
            expected = again[0].numpy()[..., valid] / again[1].numpy()[valid]
            np.testing.assert_allclose(weight[..., valid], expected, rtol=1e-4, atol=1e-5)
            np.testing.assert_allclose(np.linalg.norm(bs.wo.numpy()[:, valid], axis=0), 1, atol=1e-5)


def test_parameters_may_be_textures(mi_any, rng):
    """Bitmaps are read as the exact plugin reads them; in colour where it does."""
    mi, n = mi_any, 1000
    wi, wo = directions(rng, n, 0.4)
    si, wo = interactions(mi, vectors(mi, wi), np.arange(n) % 3, 3), vectors(mi, wo)
    results = {}
    for name in ("alpha", "specular_reflectance", "eta", "k"):
        values = rng.uniform(0.2, 0.9, (2, 3, 3)).astype(np.float32)
        grey = name == "alpha" or mi.is_spectral  # where a colour would have to become a spectrum
        m = {"alpha": 0.4, "eta": 0.5, "k": 0.7, name: bitmap(mi, values[..., :1] if grey else values)}
        results[name] = [
            mi.load_dict({**form, **m}).eval(mi.BSDFContext(), si, wo) for form in (FORMS["tables"], EXACT)
        ]
    dr.eval(results)
    for name, result in results.items():
        found, exact = (v.numpy() for v in result)
        scale = np.abs(exact).reshape(-1, n).max(axis=0)
        assert (np.abs(found - exact) <= 0.05 * scale + 2e-3).all(), name
        assert np.median(np.abs(found - exact) / scale) < 5e-3, name


# -- sampling ----------------------------------------------------------------------------------------------------------

CHI2_ALPHAS, CHI2_ANGLES = (1e-3, 0.05, 0.2, 1.0), (0, 45, 85, 87, 89)
CHI2_COUNT = len(PRESETS) * len(CHI2_ALPHAS) * len(CHI2_ANGLES)


@pytest.mark.parametrize(
    "preset, alpha",
    [
        *(("tables", alpha) for alpha in CHI2_ALPHAS),
        ("paper", 0.2),
        *(pytest.param("paper", alpha, marks=SLOW) for alpha in CHI2_ALPHAS if alpha != 0.2),
    ],
)
def test_chi2(mi_rgb, alpha, preset, tmp_path, monkeypatch):
    """``sample`` draws from ``pdf``, however wrong the table is: neither reads it."""
    monkeypatch.chdir(tmp_path)  # where a failing test leaves its histogram
    bsdf = mi_rgb.load_dict({**FORMS[preset], "alpha": alpha})
    for angle in CHI2_ANGLES:
        messages, valid = HalfVectorSampling(mi_rgb, bsdf, angle, alpha).faults(CHI2_COUNT)
        assert not messages, (angle, messages)
        assert valid > 1e5, "hardly a sample is valid, the test says nothing"


def test_chi2_on_the_sphere(mi_rgb, tmp_path, monkeypatch):
    """As Mitsuba's own adapter sees it: nothing is hidden by the choice of coordinates."""
    from mitsuba.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    monkeypatch.chdir(tmp_path)
    for angle in (5, 60, 85):
        theta = np.radians(angle)
        wi = dr.opaque(mi_rgb.Vector3f, [np.sin(theta), 0, np.cos(theta)])  # one kernel for all
        sample, pdf = BSDFAdapter("neural_ggx", '<float name="alpha" value="0.3"/>', wi=wi)
        test = ChiSquareTest(SphericalDomain(), sample, pdf, sample_dim=3, sample_count=1_000_000, res=101, ires=32)
        assert test.run(test_count=3, quiet=True), test.messages


@pytest.mark.parametrize("alpha, angle", [(1e-3, 45), (0.2, 85)])
def test_chi2_has_power(mi_rgb, alpha, angle, tmp_path, monkeypatch):
    """Densities that are 3% off, or of a lobe 3% too wide, are rejected at the same level."""
    monkeypatch.chdir(tmp_path)
    mi = mi_rgb
    right, wider = (
        HalfVectorSampling(mi, mi.load_dict({**FORMS["tables"], "alpha": a}), angle, alpha)
        for a in (alpha, 1.03 * alpha)
    )
    mutants = {"too high": lambda p: 1.03 * right.pdf(p), "too low": lambda p: 0.97 * right.pdf(p), "wider": wider.pdf}
    for what, pdf in mutants.items():
        assert right.faults(CHI2_COUNT, pdf)[0], what


@functools.lru_cache
def half_vector_grid(alphas, angles, side=128):
    """
    A grid of half vectors around the normal, for each roughness and angle of incidence: directions in and out (up where
    there is none above the horizon), the solid angle of ``wo`` that a point stands for (then 0), the number of its
    roughness, and value and density of the exact conductor. The polar axis is that on which a lobe of any width is
    smooth.
    """
    t, phi = (np.arange(side) + 0.5) / side, 2 * np.pi * (np.arange(side) + 0.5) / side
    wi, wo, weight = [], [], []
    for alpha, angle in itertools.product(alphas, angles):
        end = np.log1p(1 / alpha**2)
        sin2 = alpha**2 * np.expm1(t * end)
        solid = alpha**2 * np.exp(t * end) * end / side * np.pi / side / np.sqrt(1 - sin2)  # d(sin²)/(2 cos) dφ
        r = np.sqrt(sin2)[:, None]
        h = np.stack([r * np.cos(phi), r * np.sin(phi), np.sqrt(1 - sin2)[:, None] + 0 * phi], axis=-1).reshape(-1, 3)
        w = np.array([np.sin(np.radians(angle)), 0, np.cos(np.radians(angle))])
        wi_h = h @ w
        wi.append(np.broadcast_to(w, h.shape))
        wo.append(2 * wi_h[:, None] * h - w)
        weight.append(np.where(wi_h > 0, 4 * wi_h * np.repeat(solid, side), 0))
    lane = np.repeat(np.arange(len(alphas)), len(angles) * side**2)
    wi, wo, solid = (np.concatenate(v) for v in (wi, wo, weight))
    above = (wo[:, 2] > 0) & (solid > 0)
    wo, solid = np.where(above[:, None], wo, [0, 0, 1]), np.where(above, solid, 0)
    exact = [f(wi, wo, np.array(alphas)[lane]) for f in (ggx_formulas.conductor, ggx_formulas.density)]
    return wi, wo, solid, lane, *exact


@pytest.mark.parametrize("form", ["tables", "tables float16", "tables uint8", "paper"])
def test_energy(mi_rgb, rng, form):
    """
    By quadrature over half vectors, independent of sampling: the density integrates to what that of the exact conductor
    does, and to the share of samples above the horizon; the value to the mean weight, which is within 0.012 of what is
    reflected exactly (of bytes 0.016), and no more than 1.015.
    """
    mi, n = mi_rgb, 2**14
    alphas, angles = (0.001, 0.003, 0.01, 0.03, 0.07, 0.15, 0.3, 0.6, 1.0), (0, 30, 60, 75, 84, 88)
    k, a = len(alphas), len(angles)
    bsdf = mi.load_dict({**FORMS[form], "alpha": texels(mi, alphas)})
    wi, wo, solid, lane, *exact = half_vector_grid(alphas, angles)
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), interactions(mi, vectors(mi, wi), lane, k), vectors(mi, wo))
    albedo, area, expected, expected_area = (
        np.sum((v * solid).reshape(k, a, -1), axis=2)
        for v in (value.numpy()[0].astype(np.float64), pdf.numpy().astype(np.float64), *exact)
    )

    index = np.repeat(np.arange(k * a), n)
    theta = np.radians(angles)[index % a]
    seen = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1)
    side = math.isqrt(n)
    x, y = (np.tile(v.ravel(), k * a) + rng.random(len(index)) for v in np.mgrid[:side, :side])
    u = mi.Point2f(*(np.minimum(v / side, 1 - 2**-24).astype("f4") for v in (x, y)))
    si = interactions(mi, vectors(mi, seen), index // a, k)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.5), u)
    mean = weight.numpy()[0].reshape(k, a, n).mean(axis=2, dtype=np.float64)
    valid = (bs.pdf.numpy() > 0).reshape(k, a, n).mean(axis=2)

    error = np.abs(albedo - expected)
    print(f"{form}: albedo off by at most {error.max():.4f}, on average {error.mean():.4f}; at most {albedo.max():.4f}")
    np.testing.assert_allclose(area, expected_area, atol=1e-3)
    np.testing.assert_allclose(area, valid, atol=0.025)  # at the horizon, where it ends at a step, the grid is coarse
    if form == "paper":  # misses the peak of what is smooth, and more than makes up for it around it
        assert error[-2:].max() <= 0.02
        np.testing.assert_allclose(mean[-3:], albedo[-3:], atol=0.01)
    else:
        np.testing.assert_allclose(mean, albedo, atol=0.01)
        assert error.max() <= (0.016 if form == "tables uint8" else 0.012)
        assert max(albedo.max(), mean.max()) <= 1.015
        assert weight.numpy().max() < 5


@pytest.mark.parametrize("textured", [False, True])
@pytest.mark.parametrize("form", ["tables", "tables float16", "tables uint8"])
def test_nothing_is_gained_at_the_horizon(mi_rgb, rng, form, textured):
    """
    From no roughness to all of it: against the exact weights of the same samples, which are Smith's masking, no single
    weight is higher by more than a tenth, and their mean by no more than the table's own error.
    """
    mi, side = mi_rgb, 128
    alphas = [0.0, 1e-4, 2e-4, 5e-4, 7e-4, 1e-3, 0.0015, 0.003, 0.005, 0.01, 0.0133, 0.05, 0.132, 0.4, 1.0]
    alphas = alphas if textured else [0.0, 5e-4, 0.005]
    angles = (60, 89, 89.9, 89.99, 89.999, 90 - 1e-5, 90 - 1e-9)
    x, y = (v.ravel() + rng.random(side**2) for v in np.mgrid[:side, :side])
    u = [np.minimum(v / side, 1 - 2**-24).astype("f4") for v in (x, y)]
    theta = np.radians(np.repeat(angles, side**2))
    wi = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1)
    u = mi.Point2f(*(np.tile(v, len(angles)) for v in u))
    texture = texels(mi, alphas)
    for i, alpha in enumerate(alphas):
        bsdf = mi.load_dict({**FORMS[form], "alpha": texture if textured else alpha})
        si = interactions(mi, vectors(mi, wi), np.full(len(wi), i), len(alphas))
        bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.5), u)
        valid, cosine = bs.pdf.numpy() > 0, np.maximum(bs.wo.z.numpy().astype(np.float64), 1e-30)
        expected = np.where(valid, ggx_formulas.smith(cosine, max(np.float32(alpha), ALPHA_FLOOR)), 0)
        weight = weight.x.numpy().astype(np.float64)
        assert valid.mean() > 0.5
        assert (weight <= 1.1 * expected).all(), (alpha, np.max(weight[valid] / expected[valid]))
        gain = (weight - expected).reshape(len(angles), -1).mean(axis=1)
        assert gain.max() < (0.035 if form == "tables uint8" else 0.02), (alpha, gain)


# -- extreme inputs ----------------------------------------------------------------------------------------------------

SPECIAL_ALPHAS = (0.0, 1e-40, 1e-4, 1e-3, 0.05, 0.5, 1.0, 2.0, -1.0, float("nan"), float("inf"), -float("inf"))


def extreme_directions():
    """
    All pairs of directions with cosines down to 0 and below, some of them exactly opposite, and each with its opposite,
    its mirror image and next to it.
    """
    cosines = (0, 1e-40, 1e-38, 1e-30, 1e-20, 1e-15, 1e-8, 1e-6, 1e-4, 0.01, 0.5, 1 - 2**-24, 1, -1e-8, -0.5)
    w = []
    for c in cosines:
        s = math.sqrt(1 - c * c)
        w += [[s, 0, c], [-s, 0, c], [0, -s, c], [s * math.cos(1), s * math.sin(1), c]]
    w = np.array(w)
    i, j = (v.ravel() for v in np.mgrid[: len(w), : len(w)])
    mirror = w * [-1, -1, 1]
    pairs = [(w[i], w[j]), (w, -w), (w, mirror), (w, mirror + 1e-6), (w, w + np.array([1e-7, 0, 0]))]
    return (np.concatenate(v) for v in zip(*pairs, strict=True))


@pytest.mark.parametrize(
    "form, variant",
    [
        *((form, "llvm_ad_rgb") for form in FORMS),
        ("tables", "llvm_ad_mono_polarized"),
        pytest.param("paper", "llvm_ad_mono_polarized", marks=SLOW),
    ],
)
def test_extreme_inputs(form, variant):
    """
    Values, densities, weights and gradients with respect to every parameter are finite for everything, values are not
    negative and zero below the horizon; with roughnesses as texels, and as numbers.
    """
    import mitsuba as mi

    mi.set_variant(variant)
    wi, wo = extreme_directions()
    n, ctx = len(wi), mi.BSDFContext()
    below = (wi.astype("f4")[:, 2] <= 0) | (wo.astype("f4")[:, 2] <= 0)
    corners = np.array([[0, 0], [0.5, 0.5], [1 - 2**-24, 1 - 2**-24], [0, 1 - 2**-24], [1 - 2**-24, 0]])
    everything = np.repeat(np.arange(len(SPECIAL_ALPHAS)), n)
    cases = [(texels(mi, SPECIAL_ALPHAS), everything)]
    cases += [(alpha, np.zeros(n, int)) for alpha in ((0.0, 1e-3, 1.0) if variant == "llvm_ad_rgb" else ())]
    for alpha, texel in cases:
        repeats = len(texel) // n
        lane = np.tile(np.arange(n), repeats)
        tinted = {"specular_reflectance": rgb(0.5, 0.0, 0.9), "eta": rgb(0.2, 0.9, 1.1), "k": rgb(3.9, 2.4, 0.0)}
        bsdf = mi.load_dict({**FORMS[form], "alpha": alpha, **tinted})
        si = interactions(mi, vectors(mi, wi[lane]), texel, len(SPECIAL_ALPHAS))
        u = mi.Point2f(aligned(corners[lane % len(corners)].T))
        params = mi.traverse(bsdf)
        for optimised in (False, True):
            keys = [k for k in params.keys() if dr.is_diff_v(params[k]) and optimised]
            assert not optimised or len(keys) >= 4
            with gradients_enabled(mi, params, keys, len(texel)):
                value, pdf = bsdf.eval_pdf(ctx, si, vectors(mi, wo[lane]))
                bs, weight = bsdf.sample(ctx, si, mi.Float(0.5), u)
                if optimised:
                    dr.backward(total(value) + total(weight))
                gradients = {key: params[key].grad for key in keys}
                dr.eval(value, pdf, bs, weight, gradients)
            for what, v in (("value", value), ("pdf", pdf), ("weight", weight), ("sampled pdf", bs.pdf)):
                v = v.numpy()
                assert np.isfinite(v).all(), what
                intensity = v[0, 0] if v.ndim == 4 else v
                assert intensity.min() >= 0, what
            assert not value.numpy()[..., np.tile(below, repeats)].any()
            assert not pdf.numpy()[np.tile(below, repeats)].any()
            valid = bs.pdf.numpy() > 0
            np.testing.assert_allclose(np.linalg.norm(bs.wo.numpy()[:, valid], axis=0), 1, atol=1e-4)
            assert (bs.wo.z.numpy()[valid] > 0).all()
            for key, gradient in gradients.items():
                assert np.isfinite(gradient.numpy()).all(), key


def all_finite(mi, bsdf, si, wo, u, what, optimised=None):
    """… and not negative: value, density, weight; the sample itself, too; and the gradient of a parameter."""
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, wo)
    bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.5), u)
    gradient = mi.Float(0)
    if optimised is not None:
        dr.backward(total(value) + total(weight))
        gradient = optimised.grad
    dr.eval(value, pdf, bs, weight, gradient)
    assert np.isfinite(gradient.numpy()).all(), what
    for v in (value, pdf, weight, bs.pdf):
        v = v.numpy()
        assert np.isfinite(v).all() and (v[0, 0] if v.ndim == 4 else v).min() >= 0, what
    assert np.isfinite(bs.wo.numpy()).all(), what
    return value, pdf, bs, weight


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("textured", [False, True])
def test_tables_of_anything(mi_rgb, rng, preset, textured):
    """Entries may be wrong, and nothing else becomes so; gradients are finite where the entries are."""
    mi, n = mi_rgb, 2000
    wi, wo = extreme_directions()
    lane = rng.integers(len(wi), size=n)
    si = interactions(mi, vectors(mi, wi[lane]), lane % 3, 3)
    wo, u = vectors(mi, wo[lane]), uniform(mi, rng, n)[1]
    bsdf = mi.load_dict({**FORMS[preset], "alpha": texels(mi, [1e-4, 0.1, 1.0]) if textured else 0.1, "eta": 0.5})
    params = mi.traverse(bsdf)
    alpha = "alpha.data" if textured else "alpha.value"
    for key in ("tables.primary", "tables.cascaded"):
        before = params[key].numpy()
        for wrong in (float("nan"), 1e30, -1e30, float("inf"), -float("inf")):
            for share in (1, 0.2):
                values = np.where(rng.random(before.shape) < share, np.float32(wrong), before)
                params[key] = mi.TensorXf(values)
                params.update()
                all_finite(mi, bsdf, si, wo, u, (key, wrong, share))
                if not math.isfinite(wrong):
                    continue
                with gradients_enabled(mi, params, [alpha], n):
                    all_finite(mi, bsdf, si, wo, u, (key, wrong, share), params[alpha])
        params[key] = mi.TensorXf(before)
        params.update()


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "llvm_ad_mono_polarized"])
@pytest.mark.parametrize("form", PRESETS)
def test_directions_that_are_none(rng, form, variant):
    """NaN, infinities and lengths beyond all measure: nothing is reflected, and gradients know nothing of it."""
    import mitsuba as mi

    mi.set_variant(variant)
    wrong = np.array([np.nan, np.inf, -np.inf, 1e10, 1e20, -1e20, 3e38], np.float32)
    normal = np.array([0.6, 0.0, 0.8], np.float32)
    broken = []
    for value in wrong:
        for which in range(1, 8):
            w = normal.copy()
            w[[bool(which >> k & 1) for k in range(3)]] = value
            broken.append(w)
    broken = np.array(broken)
    fine = np.tile(normal, (len(broken), 1)) * [-1, 1, 1]
    wi = np.concatenate([broken, fine, broken, broken, fine])
    wo = np.concatenate([fine, broken, broken, -broken, fine])
    n, good = len(wi), np.arange(len(wi)) >= len(wi) - len(broken)
    samples = rng.random((n, 2)).astype(np.float32)
    samples[::3] = np.resize([np.nan, np.inf, -np.inf, -1, 2, 1e30], len(samples[::3]))[:, None]
    u = mi.Point2f(aligned(samples.T))
    for alpha, key in ((0.1, "alpha.value"), (texels(mi, [1e-4, 0.3]), "alpha.data")):
        bsdf = mi.load_dict({**FORMS[form], "alpha": alpha, "eta": 0.5, "k": 2.0})
        params = mi.traverse(bsdf)
        si = interactions(mi, vectors(mi, wi), np.arange(n) % 2, 2)
        with gradients_enabled(mi, params, [key], n):
            value, pdf, _, _ = all_finite(mi, bsdf, si, vectors(mi, wo), u, alpha, params[key])
        assert not value.numpy()[..., ~good].any() and not pdf.numpy()[~good].any()
        assert pdf.numpy()[good].all()


@pytest.mark.parametrize("preset", PRESETS)
def test_textures_beyond_the_range_are_clamped(mi_rgb, rng, preset):
    """… and NaN is the smoothest roughness that there is: each texel by itself, whatever its neighbours are."""
    mi, n = mi_rgb, 1000
    given = [2.0, float("inf"), -1.0, 0.0, float("nan"), -float("inf"), 0.3]
    used = [1.0, 1.0, 1e-4, 1e-4, 1e-4, 1e-4, 0.3]
    si = interactions(mi, vectors(mi, random_directions(rng, n)), np.arange(n) % len(given), len(given))
    wo, u = vectors(mi, random_directions(rng, n)), uniform(mi, rng, n)
    results = []
    for values in (given, used):
        bsdf = mi.load_dict({**FORMS[preset], "alpha": texels(mi, values)})
        bs, weight = bsdf.sample(mi.BSDFContext(), si, *u)
        result = (*bsdf.eval_pdf(mi.BSDFContext(), si, wo), bs.wo, bs.pdf, weight)
        dr.eval(result)
        results.append([v.numpy() for v in result])
    for a, b in zip(*results, strict=True):
        np.testing.assert_array_equal(a, b)


def test_black_reflects_nothing(mi_any, rng):
    mi, n = mi_any, 1000
    si = interactions(mi, vectors(mi, random_directions(rng, n)))
    wo, u = vectors(mi, random_directions(rng, n)), uniform(mi, rng, n)
    results = []
    for black in (0.0, rgb(0, 0, 0), bitmap(mi, np.zeros((2, 2, 1)))):
        bsdf = mi.load_dict({**FORMS["tables"], "specular_reflectance": black})
        results.append((*bsdf.eval_pdf(mi.BSDFContext(), si, wo), bsdf.sample(mi.BSDFContext(), si, *u)[1]))
    dr.eval(results)
    for value, pdf, weight in results:
        # In spectral variants, black is a reflectance of 10⁻⁸ or so
        assert np.abs(value.numpy()).max() <= 1e-6 * pdf.numpy().max() and np.abs(weight.numpy()).max() < 1e-5
        assert pdf.numpy().max() > 0


@pytest.mark.parametrize("integrator", ["path", "prb"])
def test_grazing_light_renders(mi_rgb, integrator):
    """Strips of a floor seen at a glance, smooth, rough and textured, under a lamp on the horizon."""
    mi = mi_rgb
    noise = np.random.default_rng(0).random((8, 8))
    noise[3, 3], noise[4, 4] = np.nan, 0
    floors = {}
    for i, alpha in enumerate((0.0, 1e-3, 1.0, bitmap(mi, noise, filter_type="bilinear"))):
        strip = mi.ScalarTransform4f().translate([0.5 * i - 0.75, 0, 0]).scale([0.25, 1, 1])
        bsdf = {**FORMS["tables"], "material": "Cu", "alpha": alpha}
        floors[f"floor{i}"] = {"type": "rectangle", "to_world": strip, "bsdf": bsdf}
    scene = mi.load_dict({
        "type": "scene",
        "integrator": {"type": integrator, "max_depth": 4},
        "sensor": {
            "type": "perspective", "fov": 40.0,
            "to_world": mi.ScalarTransform4f().look_at([0, -3, 0.01], [0, 0, 0], [0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 48, "height": 24, "rfilter": {"type": "box"}},
        },
        "sky": {"type": "constant", "radiance": 0.5},
        "lamp": {"type": "point", "position": [0.3, 2.0, 1e-5], "intensity": 5.0},
        **floors,
    })  # fmt: skip
    params = mi.traverse(scene)
    keys = [f"floor{i}.bsdf.alpha.{'data' if i == 3 else 'value'}" for i in range(4)]
    if integrator == "prb":
        for key in keys:
            dr.enable_grad(params[key])
        params.update()
    image = mi.render(scene, params, spp=16)
    assert np.isfinite(image.numpy()).all() and image.numpy().min() >= 0
    if integrator == "prb":
        dr.backward(dr.mean(image, axis=None))
        for key in keys:
            assert np.isfinite(params[key].grad.numpy()).all(), key


# -- gradients ---------------------------------------------------------------------------------------------------------


def shifted_table(preset, name, index, step):
    """The shipped tables with one entry shifted, read by NumPy and SciPy."""
    table = shipped(preset)
    entries = {k: array.values.astype(np.float64) for k, array in table.arrays.items()}
    entries[name][index] += step
    encoding, arrays = encoding_of(table), {k: SimpleNamespace(values=v) for k, v in entries.items()}
    return ggx_formulas.learned(SimpleNamespace(arrays=arrays), encoding.inputs, encoding.output)


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("textured", [False, True])
def test_gradients_equal_central_differences(mi_rgb, rng, preset, textured):
    """
    Of value and weight, with respect to everything, against differences of Walter's formulas in double precision, with
    the table read by SciPy. The density is detached: the gradient of a weight is that of the value, over the density.
    """
    mi, n, alpha, eta, k, factor = mi_rgb, 4000, 0.2371, 0.6, 2.3, 0.8
    wi, wo = directions(rng, n, alpha, 0.1)
    given = [texels(mi, [v] * 2) if textured else v for v in (alpha, eta, k, factor)]
    names = ("alpha", "eta", "k", "specular_reflectance")
    bsdf = mi.load_dict({**FORMS[preset], **dict(zip(names, given, strict=True))})
    params = mi.traverse(bsdf)
    keys = [f"{name}.{'data' if textured else 'value'}" for name in names] + ["tables.primary", "tables.cascaded"]
    si = interactions(mi, vectors(mi, wi), np.arange(n) % 2, 2)
    sampled = bsdf.sample(mi.BSDFContext(), si, *uniform(mi, np.random.default_rng(1), n))[0]
    usable = sampled.pdf.numpy() > 0
    parameters, table = {"alpha": alpha, "eta": eta, "k": k, "specular_reflectance": factor}, normals(preset)
    steps = {"alpha": 1e-6, "eta": 1e-4, "k": 1e-4, "specular_reflectance": 1e-3}
    for what, out in {"value": wo, "weight": sampled.wo.numpy().T}.items():
        used, over = slice(None), 1.0
        with gradients_enabled(mi, params, keys, n):
            if what == "value":
                found = bsdf.eval(mi.BSDFContext(), si, vectors(mi, out)).x
            else:
                found = bsdf.sample(mi.BSDFContext(), si, *uniform(mi, np.random.default_rng(1), n))[1].x
                used, over = usable, ggx_formulas.density(wi[usable], out[usable], alpha)
            dr.backward(found)
            gradients = {key: params[key].grad for key in keys}
            dr.eval(gradients)

        def reference(table=table, out=out, used=used, over=over, **changed):
            p = {**parameters, **changed}
            value = ggx_formulas.conductor(wi[used], out[used], p["alpha"], p["eta"], p["k"], table)
            return np.sum(p["specular_reflectance"] * value / over)

        for name, step in steps.items():
            up, down = (reference(**{name: parameters[name] + sign * step}) for sign in (1, -1))
            gradient = gradients[f"{name}.{'data' if textured else 'value'}"].numpy().sum()
            assert gradient == pytest.approx((up - down) / (2 * step), rel=5e-3), (what, name)
        for name in ("primary", "cascaded"):
            gradient = gradients[f"tables.{name}"].numpy()
            largest = np.argsort(-np.abs(gradient).ravel())[:4]
            for index in zip(*np.unravel_index(largest, gradient.shape), strict=True):
                up, down = (reference(shifted_table(preset, name, index, sign * 1e-5)) for sign in (1, -1))
                assert gradient[index] == pytest.approx((up - down) / 2e-5, rel=0.02), (what, name, index)


def test_the_derivative_of_the_roughness_against_the_exact_one(mi_rgb, rng):
    """
    d f / d α of a table is that of a function with a kink at every entry: coarser than its value, and worst next to α =
    1. Both plugins differentiate themselves; elasticities (d ln f / d ln α) are compared, whose mean size is 1.
    """
    mi, count, n = mi_rgb, 200, 1000
    alphas = np.exp(np.linspace(np.log(1e-3), 0, count))
    wi = random_directions(rng, count * n, 0.05)
    texel = np.repeat(np.arange(count), n)
    si = interactions(mi, vectors(mi, wi), texel, count)
    exact = mi.load_dict({**EXACT, "alpha": texels(mi, alphas)})
    wo = dr.detach(exact.sample(mi.BSDFContext(), si, *uniform(mi, rng, count * n))[0].wo)
    used = wo.z.numpy() > 0.01

    def elasticity(bsdf):
        params = mi.traverse(bsdf)
        dr.enable_grad(params["alpha.data"])
        params.update()
        value = bsdf.eval(mi.BSDFContext(), si, wo).x
        dr.set_grad(params["alpha.data"], 1.0)
        dr.forward_to(value)
        gradient, value = dr.grad(value).numpy().astype(np.float64), dr.detach(value).numpy().astype(np.float64)
        assert np.isfinite(gradient).all()
        return gradient[used] * alphas[texel][used] / value[used]

    expected = elasticity(exact)
    found = elasticity(mi.load_dict({**FORMS["tables"], "alpha": texels(mi, alphas)}))
    bars = {(0.001, 0.01): (0.15, 0.95), (0.01, 0.1): (0.1, 0.985), (0.1, 0.5): (0.05, 0.995), (0.5, 1.0): (0.12, 0.95)}
    for (low, high), (mean, correlation) in bars.items():
        band = (alphas[texel][used] >= low) & (alphas[texel][used] <= high)
        a, b = found[band], expected[band]
        error, size = np.abs(a - b), np.abs(b).mean()
        quantiles = np.quantile(error, [0.5, 0.9, 0.99])
        related = np.corrcoef(a, b)[0, 1]
        print(
            f"α {low:g} to {high:g}: off by {error.mean() / size:.3f}, quantiles {quantiles}, correlation {related:.4f}"
        )
        assert error.mean() <= mean * size and related >= correlation


@pytest.mark.parametrize("preset", PRESETS)
def test_gradients_with_respect_to_directions(mi_rgb, rng, preset):
    """As a moving light or shape asks for them: against differences along great circles, and finite at the extremes."""
    mi, n, alpha, step = mi_rgb, 10_000, 0.2371, 1e-6
    bsdf = mi.load_dict({**FORMS[preset], "alpha": alpha, "eta": 0.6, "k": 2.3})

    def gradients(wi, wo):
        attached = [vectors(mi, w) for w in (wi, wo)]
        dr.enable_grad(attached)
        dr.backward(bsdf.eval(mi.BSDFContext(), interactions(mi, attached[0]), attached[1]).x)
        gradients = [w.grad for w in attached]
        dr.eval(gradients)
        return [gradient.numpy().T.astype(np.float64) for gradient in gradients]

    pair = [w.astype(np.float64) for w in directions(rng, n, alpha, 0.1)]
    for which, gradient in enumerate(gradients(*pair)):
        tangent = np.cross(pair[which], rng.standard_normal((n, 3)))
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        values = []
        for sign in (1, 0, -1):
            moved = list(pair)
            moved[which] = math.cos(sign * step) * pair[which] + math.sin(sign * step) * tangent
            values.append(ggx_formulas.conductor(*moved, alpha, 0.6, 2.3, normals(preset)))
        forward, backward = (values[0] - values[1]) / step, (values[1] - values[2]) / step
        expected, scale = (forward + backward) / 2, np.abs(gradient).max(axis=1) + 1e-2 * values[1].max()
        smooth = np.abs(forward - backward) <= 1e-3 * scale  # no edge of a cell in between
        assert smooth.mean() > 0.99
        error = np.abs(np.sum(gradient * tangent, axis=1) - expected)[smooth] / scale[smooth]
        assert np.quantile(error, 0.999) < 5e-3, ("wi", "wo")[which]
    for gradient in gradients(*extreme_directions()):
        assert np.isfinite(gradient).all()


def finite_difference(params, key, step, render):
    original = type(params[key])(params[key])
    totals = []
    for sign in (1, -1):
        params[key] = original + sign * step
        params.update()
        totals.append(float(render().array[0]))
    params[key] = original
    params.update()
    return (totals[0] - totals[1]) / (2 * step)


@pytest.mark.parametrize("integrator", ["prb", "path"])
def test_gradients_through_render(mi_rgb, integrator):
    """
    Reverse mode against finite differences of the mean of an image, both Monte Carlo estimates: they agree within 4
    standard errors (4 seeds) and 2%. The roughness shows by the lamp's highlight.
    """
    mi = mi_rgb
    bsdf = {**FORMS["tables"], "alpha": 0.437, "eta": 0.6, "k": 2.3, "specular_reflectance": 0.8}
    scene = sphere_scene(mi, bsdf, integrator, size=8, light=0.1)
    params = mi.traverse(scene)
    steps = {"alpha.value": 0.005, "eta.value": 0.02, "k.value": 0.05, "specular_reflectance.value": 0.02}
    keys = {key_of(params, name): step for name, step in steps.items()}
    found, expected = [], []
    for seed in range(4):

        def render(seed=seed):
            image = mi.render(scene, params, spp=1024, seed=seed)
            return dr.mean(image[1:4, 4:7], axis=None)

        # Only unrolled loops can be differentiated in reverse by plain automatic differentiation
        with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, integrator == "prb"):
            for key in keys:
                dr.enable_grad(params[key])
            params.update()
            dr.backward(render())
            gradients = [dr.grad(params[key]) for key in keys]
            dr.eval(gradients)
            found.append([float(gradient.numpy().sum()) for gradient in gradients])
            for key in keys:
                dr.disable_grad(params[key])
        expected.append([finite_difference(params, key, step, render) for key, step in keys.items()])
    (a, b), (da, db) = (
        [f(np.asarray(v), axis=0) for v in (found, expected)] for f in (np.mean, lambda v, axis: v.std(axis, ddof=1))
    )
    error = np.hypot(da, db) / np.sqrt(len(found))
    for key, x, y, e in zip(keys, a, b, error, strict=True):
        assert abs(x - y) <= 4 * e + 0.02 * abs(y), (key, x, y, e)
        assert e < 0.3 * abs(y), (key, x, y, e)  # or the comparison would say nothing


@pytest.mark.parametrize(
    "target, start", [(0.25, 0.6), pytest.param(0.6, 0.2, marks=SLOW), pytest.param(0.1, 0.3, marks=SLOW)]
)
def test_the_roughness_is_recovered_from_an_image(mi_rgb, target, start):
    """Within 5% in 60 steps, none of which compiles after the first few; the image is that of the exact plugin."""
    mi = mi_rgb
    lit = {"size": 16, "light": 0.05}
    image = mi.render(sphere_scene(mi, {**EXACT, "alpha": target}, "prb", **lit), spp=512)
    scene = sphere_scene(mi, {**FORMS["tables"], "alpha": start}, "prb", **lit)
    params = mi.traverse(scene)
    key = key_of(params, "alpha.value")
    opt, found, kernels = mi.ad.Adam(lr=0.06), [], []
    opt[key] = params[key]
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for step in range(60):
            opt.set_learning_rate({key: 0.06 * 0.95**step})
            opt[key] = dr.clip(opt[key], 1e-3, 1)
            params.update(opt)
            rendered = mi.render(scene, params, spp=16, seed=step)
            dr.backward(dr.mean(dr.abs(rendered - image), axis=None))
            opt.step()
            found.append(float(opt[key][0]))
            kernels.append({k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT})
    assert set().union(*kernels[10:]) <= set().union(*kernels[:10])
    print(f"{start} → {np.mean(found[-10:]):.4f}, expected {target}")
    assert np.mean(found[-10:]) == pytest.approx(target, rel=0.05)


@pytest.mark.parametrize("preset", PRESETS)
def test_optimised_tables_stay_finite(mi_rgb, rng, preset):
    """150 steps with a learning rate that throws entries out of their range, in which the loss falls nevertheless."""
    mi, n = mi_rgb, 4096
    bsdf = mi.load_dict({**FORMS[preset], "alpha": texels(mi, [1e-4, 1e-3, 0.05, 0.3, 1.0])})
    params = mi.traverse(bsdf)
    keys = ["tables.primary", "tables.cascaded"]
    params["tables.cascaded"] = params["tables.cascaded"] * 0 + 0.5
    wi, wo = directions(rng, n, 0.2)
    si = interactions(mi, vectors(mi, wi), np.arange(n) % 5, 5)
    wo = vectors(mi, wo)
    scene = sphere_scene(mi, bsdf)
    target = mi.load_dict({**EXACT, "alpha": texels(mi, [1e-4, 1e-3, 0.05, 0.3, 1.0])}).eval(mi.BSDFContext(), si, wo)
    opt = mi.ad.Adam(lr=0.05)
    for key in keys:
        opt[key] = params[key]
    losses = []
    for _ in range(150):
        params.update(opt)
        value = bsdf.eval(mi.BSDFContext(), si, wo)
        loss = dr.mean(dr.abs(dr.log(value.x + 1e-3) - dr.log(target.x + 1e-3)))
        dr.backward(loss)
        opt.step()
        losses.append(loss)
    assert np.isfinite([float(v[0]) for v in losses]).all()
    for key in keys:
        assert np.isfinite(opt[key].numpy()).all(), key
    primary = opt["tables.primary"].numpy()
    assert primary.min() < 0 or primary.max() > 1
    assert losses[-1][0] < 0.5 * losses[0][0]
    params.update(opt)
    image = mi.render(scene, spp=4).numpy()
    assert np.isfinite(image).all() and image.min() >= 0


def test_tables_keep_their_gradients_where_the_roughness_is_constant(mi_rgb, rng):
    """A row that is evaluated once is evaluated without derivatives, which tables being trained do not want."""
    mi, n = mi_rgb, 1000
    wi, wo = directions(rng, n, 0.3)
    si, gradients = interactions(mi, vectors(mi, wi), np.zeros(n)), []
    for alpha, update in itertools.product((0.3, texels(mi, [0.3] * 2)), (False, True)):
        bsdf = mi.load_dict({**FORMS["tables"], "alpha": alpha})
        params = mi.traverse(bsdf)
        for key in ("tables.primary", "tables.cascaded"):
            dr.enable_grad(params[key])
        if update:
            params.update()
        dr.backward(bsdf.eval(mi.BSDFContext(), si, vectors(mi, wo)).x)
        gradients.append([params[key].grad for key in ("tables.primary", "tables.cascaded")])
    dr.eval(gradients)
    gradients = [[gradient.numpy() for gradient in each] for each in gradients]
    for found in gradients[1:]:
        for a, b in zip(found, gradients[0], strict=True):
            assert np.abs(b).max() > 0
            np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * np.abs(b).max())


# -- parameters that change --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kind, form",
    [
        ("number", "tables"),
        ("number", "tables uint8"),
        ("bitmap", "tables"),
        *(pytest.param(*case, marks=SLOW) for case in (("number", "paper"), ("bitmap", "tables uint8"))),
    ],
)
def test_updated_parameters_show_in_the_next_image(mi_rgb, form, kind):
    """Each image is that of a scene loaded so: also what was left out at 1, and a metal that was none."""
    mi = mi_rgb
    before = {"alpha": 0.3, "specular_reflectance": 1.0, "eta": 0.0, "k": 1.0}
    after = {"alpha": 0.1, "specular_reflectance": 0.6, "eta": 0.5, "k": 2.5}

    def load(values):
        """A sphere for each parameter that changes; the index only shows where eta is not 0."""
        bsdfs = []
        for name, value in values.items():
            value = value if kind == "number" else bitmap(mi, np.full((2, 2), value))
            changed = {**before, **({"eta": 0.5} if name == "k" else {}), name: value}
            bsdfs.append(mi.load_dict({**FORMS[form], **changed}))  # one by one, or equal ones become one
        return sphere_scene(mi, bsdfs, "direct", 24)

    # One after the other: another kernel would be compiled while a second scene is alive
    expected = [mi.render(load(values), spp=4).numpy() for values in (before, after)]
    scene = load(before)
    params = mi.traverse(scene)
    for i, name in enumerate(before):
        a, b = (tile(image, i, 2, 12) for image in expected)
        assert np.abs(a - b).max() > 1e-2, name
    for which in (0, 1, 0, 1):
        for i, (name, value) in enumerate((before, after)[which].items()):
            if kind == "number":
                params[f"shape{i}.bsdf.{name}.value"] = mi.Float(value)
            else:
                params[f"shape{i}.bsdf.{name}.data"] = mi.TensorXf(aligned(np.full((2, 2, 1), value, np.float32)))
        params.update()
        assert equal_images(mi.render(scene, params, spp=4).numpy(), expected[which]), which


def test_a_constant_that_is_optimised_and_constant_again(mi_rgb, rng):
    mi, n = mi_rgb, 1000
    wi, wo = directions(rng, n, 0.3)
    si, wo = interactions(mi, vectors(mi, wi)), vectors(mi, wo)
    bsdf = mi.load_dict({**FORMS["tables"], "alpha": 0.3})
    params = mi.traverse(bsdf)

    def value(b=bsdf):
        return b.eval(mi.BSDFContext(), si, wo).numpy()

    fresh = {alpha: value(mi.load_dict({**FORMS["tables"], "alpha": alpha})) for alpha in (0.3, 0.5)}
    assert bsdf.report()["evaluated_once"] == ["roughness"]
    np.testing.assert_array_equal(value(), fresh[0.3])
    for update in (False, True):
        dr.enable_grad(params["alpha.value"])
        if update:
            params.update()
            assert bsdf.report()["evaluated_once"] == []
        np.testing.assert_allclose(value(), fresh[0.3], rtol=1e-4)
        dr.backward(dr.sum(bsdf.eval(mi.BSDFContext(), si, wo).x))
        assert params["alpha.value"].grad[0] != 0
        dr.disable_grad(params["alpha.value"])
        if update:
            params.update()
        np.testing.assert_allclose(value(), fresh[0.3], rtol=1e-4)
    params["alpha.value"] = mi.Float(0.5)
    params.update()
    np.testing.assert_array_equal(value(), fresh[0.5])
    assert bsdf.report()["evaluated_once"] == ["roughness"]


def test_a_texture_updated_by_itself(mi_rgb, rng):
    """``mi.traverse(texture)`` knows nothing of the material that reads the texture, and nobody tells it."""
    mi, n = mi_rgb, 1000
    wi, wo = directions(rng, n, 0.3)
    si, wo = interactions(mi, vectors(mi, wi)), vectors(mi, wo)
    for name, (old, new) in {
        "alpha": (0.3, 0.5), "eta": (0.0, 2.0), "k": (1.0, 3.0), "specular_reflectance": (1.0, 0.2),
    }.items():  # fmt: skip
        texture = mi.load_dict({"type": "uniform", "value": old})
        bsdf = mi.load_dict({**FORMS["tables"], name: texture})
        bsdf.eval(mi.BSDFContext(), si, wo)
        params = mi.traverse(texture)
        params["value"] = mi.Float(new)
        params.update()
        expected = mi.load_dict({**FORMS["tables"], name: new}).eval(mi.BSDFContext(), si, wo).numpy()
        np.testing.assert_allclose(bsdf.eval(mi.BSDFContext(), si, wo).numpy(), expected, rtol=1e-4, err_msg=name)


def test_textures_that_are_something_else(mi_rgb, rng):
    """Bitmaps of bytes, read as numbers; and an attribute of a mesh, which calls itself constant."""
    mi, n = mi_rgb, 500
    wi, wo = directions(rng, n, 0.3)
    si, wo = interactions(mi, vectors(mi, wi), np.zeros(n)), vectors(mi, wo)
    grey, white = (mi.Bitmap(np.full((4, 4), v, np.uint8)) for v in (128, 255))
    bytes_ = {name: {"type": "bitmap", "bitmap": b, "raw": True} for name, b in (("alpha", grey), ("eta", white))}
    found = mi.load_dict({**FORMS["tables"], **bytes_}).eval(mi.BSDFContext(), si, wo).numpy()
    expected = mi.load_dict({**FORMS["tables"], "alpha": 128 / 255, "eta": 1.0}).eval(mi.BSDFContext(), si, wo)
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-4)

    images = []
    for alpha in ({"type": "mesh_attribute", "name": "vertex_alpha"}, 0.5):
        mesh = mi.Mesh("quad", 4, 2)
        params = mi.traverse(mesh)
        params["vertex_positions"] = mi.Float([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0])
        params["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
        params.update()
        mesh.add_attribute("vertex_alpha", 1, [0.5] * 4)
        mesh.set_bsdf(mi.load_dict({**FORMS["tables"], "alpha": alpha}))
        images.append(mi.render(sphere_scene(mi, [], "direct", columns=1, mesh=mesh), spp=4).numpy())
    assert images[0].max() > 0.1
    assert equal_images(*images)


def test_assigned_tables(mi_rgb, rng):
    """One instance only; refused if misshapen; the row that is evaluated once follows."""
    mi, n = mi_rgb, 1000
    wi, wo = directions(rng, n, 0.3)
    si, wo = interactions(mi, vectors(mi, wi), np.zeros(n)), vectors(mi, wo)
    for alpha in (0.3, texels(mi, [0.3] * 2)):
        first, second = (mi.load_dict({**FORMS["tables"], "alpha": alpha}) for _ in range(2))
        before = second.eval(mi.BSDFContext(), si, wo).numpy()
        params = mi.traverse(first)
        params["tables.cascaded"] = params["tables.cascaded"] * 2**0.25
        params.update()
        np.testing.assert_allclose(first.eval(mi.BSDFContext(), si, wo).numpy(), 2 * before, rtol=1e-4)
        np.testing.assert_array_equal(second.eval(mi.BSDFContext(), si, wo).numpy(), before)
        params["tables.cascaded"] = params["tables.cascaded"] / 2**0.25
        params["tables.primary"] = mi.TensorXf(aligned(np.full((16, 16, 2), 0.999, np.float32)))  # all the tail
        params.update()
        assert np.abs(first.eval(mi.BSDFContext(), si, wo).numpy() - before).max() > 0.01
        params["tables.primary"] = mi.TensorXf(aligned(np.zeros((16, 8, 2), np.float32)))
        with pytest.raises(RuntimeError, match=r'"tables.primary": "data" has the shape \(16, 8, 2\), expected \(16'):
            params.update()
    for form in ("tables float16", "tables uint8"):
        assert not any("tables" in key for key in mi.traverse(mi.load_dict(FORMS[form])).keys())


def test_own_tables(mi_rgb, rng, tmp_path):
    """``filename`` is read, relative to the scene, in the file's own form; its encoding is that of the file."""
    mi = mi_rgb
    wi, wo = directions(rng, 1000, 0.3)
    si, wo = interactions(mi, vectors(mi, wi)), vectors(mi, wo)
    for preset in PRESETS:
        save_table(tmp_path / "own.npz", shipped(preset).to("uint8"))
        (tmp_path / "m.xml").write_text(
            '<bsdf version="3.0.0" type="neural_ggx"><string name="filename" value="own.npz"/></bsdf>'
        )
        own = mi.load_file(str(tmp_path / "m.xml"))
        assert f"preset = {preset}, 576 bytes as uint8" in str(own)
        report = own.report()
        assert (report["preset"], report["storage"], report["table_bytes"]) == (preset, "uint8", 576)
        expected = mi.load_dict({**FORMS[preset], "storage": "uint8"}).eval(mi.BSDFContext(), si, wo).numpy()
        np.testing.assert_array_equal(own.eval(mi.BSDFContext(), si, wo).numpy(), expected)


def test_changed_roughness_shows_in_frozen_renders(mi_rgb, no_garbage_collection):
    mi = mi_rgb

    def load(alpha):
        return sphere_scene(mi, [{**FORMS["tables"], "material": "Cu", "alpha": a} for a in (alpha, 0.2)])

    seed = mi.UInt32(0)
    expected = {alpha: mi.render(load(alpha), spp=4, seed=seed).numpy() for alpha in (0.1, 0.5)}
    scene = load(0.1)
    params, key = mi.traverse(scene), "shape0.bsdf.alpha.value"

    @dr.freeze
    def frozen(scene, seed):
        return mi.render(scene, spp=4, seed=seed)

    for alpha in (0.1, 0.1, 0.5, 0.5, 0.1, 0.5):
        params[key] = mi.Float(alpha)
        params.update()
        assert equal_images(frozen(scene, seed).numpy(), expected[alpha]), alpha


def test_roughness_updated_inside_a_frozen_function(mi_rgb, no_garbage_collection):
    mi = mi_rgb

    def load(alpha):
        return sphere_scene(mi, {**FORMS["tables"], "alpha": alpha})

    values, seed = (0.3, 0.3, 0.5, 0.05, 1.0), mi.UInt32(0)
    expected = {value: mi.render(load(value), spp=4, seed=seed).numpy() for value in (*values, 0.7)}
    scene = load(0.3)
    params = mi.traverse(scene)
    key = key_of(params, "alpha.value")

    @dr.freeze
    def frozen(scene, params, value, seed):
        params[key] = value
        params.update()
        return mi.render(scene, params, spp=4, seed=seed)

    for value in values:
        image = frozen(scene, params, dr.opaque(mi.Float, value), seed).numpy()
        assert equal_images(image, expected[value]), value
    params[key] = mi.Float(0.7)  # outside of it again
    params.update()
    assert equal_images(mi.render(scene, spp=4, seed=seed).numpy(), expected[0.7])


# -- materials together ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrators", [("path", "prb"), ("direct",)])
def test_several_materials_in_one_loop(mi_rgb, tmp_path, integrators):
    """
    Each sphere looks as where all of them are alike: other roughness, storage, preset, tables, a texture. Both path
    tracers draw the same samples. Without a loop, three of the materials, each for one of these differences.
    """
    mi = mi_rgb
    table = shipped("tables")
    table.arrays["cascaded"] = StoredArray(table.arrays["cascaded"].values * np.float32(0.9))
    save_table(tmp_path / "own.npz", table)
    bsdfs = [
        {**FORMS["tables"], "alpha": 0.1, "material": "Cu"},
        {**FORMS["tables uint8"], "alpha": 0.4},
        {**FORMS["paper"], "alpha": 0.5, "specular_reflectance": 0.7},
        {"type": "neural_ggx", "filename": str(tmp_path / "own.npz"), "alpha": 0.1, "material": "Cu"},
        {**FORMS["tables float16"], "alpha": bitmap(mi, [[0.1, 0.5], [0.9, 0.3]]), "material": "Au"},
        {**EXACT, "alpha": 0.3},
        {"type": "diffuse"},
    ]

    def image(integrator, chosen):
        return mi.render(sphere_scene(mi, chosen, integrator, 24, columns=3, depth=2), spp=4).numpy()

    chosen = range(len(bsdfs)) if "path" in integrators else (1, 3, 4)
    alone = {i: tile(image(integrators[0], [bsdfs[i]] * len(bsdfs)), i, 3, 8) for i in chosen}
    for integrator in integrators:
        together = image(integrator, bsdfs)
        for i, expected in alone.items():
            assert equal_images(tile(together, i, 3, 8), expected), (integrator, i)
        assert np.abs(tile(together, 0, 3, 8) - tile(together, 3, 3, 8)).max() > 1e-3  # one's own tables
        assert np.array_equal(together, image(integrator, bsdfs))


def test_every_variant_renders(mi_any):
    """
    … what the exact plugin renders, in a path tracer. A volumetric one and the two of Mitsuba's for gradients, which
    call a material in other ways, do so in all variants alike.
    """
    mi = mi_any
    m = {"material": "Cu", "alpha": 0.3}
    for integrator in ("path", *(("volpath", "prb", "prbvolpath") if mi.is_rgb else ())):
        found, expected = (
            mi.render(sphere_scene(mi, {**form, **m}, integrator), spp=32).numpy()[..., :3]
            for form in (FORMS["tables"], EXACT)
        )
        assert np.isfinite(found).all() and found.min() >= 0
        assert found.mean() == pytest.approx(expected.mean(), rel=0.01)
        assert np.abs(found - expected).max() < 0.05 * expected.max()


def test_wrappers(mi_rgb):
    """Around the material, they do what they do around the exact one."""
    mi = mi_rgb
    rough = np.random.default_rng(0).random((4, 4)).astype(np.float32)
    flat = np.tile(np.array([0.5, 0.5, 1.0]), (4, 4, 1))

    def wrapped(form):
        inner, other = {**form, "material": "Cu", "alpha": 0.3}, {**form, "alpha": bitmap(mi, rough)}
        return {
            "twosided": {"type": "twosided", "bsdf": inner},
            "two sides": {"type": "twosided", "front": inner, "back": other},
            "blendbsdf": {"type": "blendbsdf", "weight": bitmap(mi, rough), "a": inner, "b": other},
            "mask": {"type": "mask", "opacity": 0.5, "bsdf": inner},
            "normalmap": {"type": "normalmap", "normalmap": bitmap(mi, flat + 0.1 * rough[..., None]), "bsdf": inner},
            "bumpmap": {"type": "bumpmap", "arbitrary": bitmap(mi, rough, filter_type="bilinear"), "bsdf": inner},
        }

    # A sphere for each, none of which lights another
    found, expected = (
        mi.render(sphere_scene(mi, list(wrapped(form).values()), "direct", 48, columns=3), spp=64).numpy()
        for form in (FORMS["tables"], EXACT)
    )
    for i, name in enumerate(wrapped(EXACT)):
        a, b = tile(found, i, 3, 16), tile(expected, i, 3, 16)
        assert np.isfinite(a).all() and a.min() >= 0, name
        assert a.mean() == pytest.approx(b.mean(), rel=0.01), name
        assert np.abs(a - b).max() < 0.05 * b.max(), name


def test_a_back_side_is_black_unless_it_is_twosided(mi_rgb):
    mi = mi_rgb
    turned = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 180)}
    for bsdf, black in ((FORMS["tables"], True), ({"type": "twosided", "bsdf": FORMS["tables"]}, False)):
        image = mi.render(sphere_scene(mi, [], wall={**turned, "bsdf": bsdf}, columns=1), spp=16).numpy()
        assert (image[4:12, 4:12].max() == 0) == black


@pytest.mark.parametrize("count", [50, pytest.param(200, marks=SLOW)])
def test_many_materials(mi_rgb, rng, count):
    """Metals, numbers, textures, presets, storage forms: some of them against scenes in which they are alone."""
    mi, columns = mi_rgb, math.ceil(math.sqrt(count))
    metals, forms = ("Cu", "Au", "Al", "Ag"), list(FORMS.values())
    bsdfs = []
    for i in range(count):
        # Ten kinds, each code of its own: two of each form, which differ in metal, texture and factor
        kind = i % 10
        alpha = float(rng.uniform(0.1, 1)) if kind % 3 else bitmap(mi, rng.uniform(0.1, 1, (2, 2)))
        m = {"alpha": alpha, "material": metals[rng.integers(len(metals))] if kind % 4 else "none"}
        if kind < 5:
            m["specular_reflectance"] = rgb(*rng.random(3).tolist())
        bsdfs.append({**forms[kind % 5], **m})
    size = 4 * columns
    scene = sphere_scene(mi, bsdfs, "direct", size, columns)
    assert len(loading.learned_instances(scene)) == count
    image = mi.render(scene, spp=4).numpy()
    assert np.isfinite(image).all() and image.min() >= 0
    assert np.array_equal(image, mi.render(scene, spp=4).numpy())
    del scene  # or the code of its materials would be compiled with that of those that follow
    black = mi.load_dict({"type": "diffuse", "reflectance": 0.0})
    for i in (0, count // 2, count - 1):
        alone = [bsdfs[i] if j == i else black for j in range(count)]
        expected = mi.render(sphere_scene(mi, alone, "direct", size, columns), spp=4).numpy()
        assert equal_images(tile(image, i, columns, 4), tile(expected, i, columns, 4)), bsdfs[i]
        assert tile(expected, i, columns, 4).max() > 0


def test_many_materials_are_loaded_while_a_render_is_running(mi_rgb):
    """Constructors that wait for a kernel take up the next task, which may be the next constructor."""
    mi = mi_rgb
    running = sphere_scene(mi, {"type": "diffuse"})
    mi.render(running, spp=16).numpy()
    image = mi.render(running, spp=10_000)
    dr.eval(image)  # begins, and does not wait
    failure = ""
    try:
        sphere_scene(mi, [{**FORMS["tables"], "material": "Cu", "alpha": 0.1 + 0.001 * i} for i in range(300)])
    except RuntimeError as e:
        failure = str(e).strip().splitlines()[-1]  # thousands of lines
    dr.sync_thread()
    assert not failure


def test_scenes_are_loaded_in_many_threads():
    """In a process of its own, which may hang without taking the tests along."""
    script = textwrap.dedent(
        """
        import threading
        import mi_diffind
        import mitsuba as mi
        mi.set_variant("llvm_ad_rgb")
        loaded, failures = [], []

        def load(k):
            mi.set_variant("llvm_ad_rgb")
            try:
                for i in range(3):
                    scene = {"type": "scene"}
                    for j in range(12):
                        bsdf = {"type": "neural_ggx", "material": ("Cu", "Au")[j % 2], "alpha": 0.05 * (j + 1)}
                        bsdf |= {"preset": "paper"} if j % 3 else {"storage": "uint8"}
                        scene[f"s{j}"] = {"type": "sphere", "center": [j, i, k], "bsdf": bsdf}
                    loaded.append(mi.load_dict(scene))
            except BaseException as e:
                failures.append(repr(e))

        threads = [threading.Thread(target=load, args=(k,)) for k in range(8)]
        [t.start() for t in threads]
        [t.join() for t in threads]
        assert not failures, failures[0]
        for scene in loaded:
            assert len(scene.shapes()) == 12
            assert all(shape.bsdf().report()["evaluated_once"] for shape in scene.shapes())
        print(len(loaded))
        """
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and done.stdout.strip() == "24", done.stderr[-2000:]


def test_materials_die_with_their_scene(mi_rgb, no_garbage_collection):
    """Without waiting for the garbage collector, which Dr.Jit does not forgive in a frozen function."""
    mi = mi_rgb

    def alive():
        return [type(o).__name__ for o in gc.get_objects()].count("NeuralGGX")

    for m in ({}, {"material": "Cu", "alpha": 0.2}, {"alpha": bitmap(mi, np.full((2, 2), 0.3))}):
        before = alive()
        scene = sphere_scene(mi, {**FORMS["tables"], **m})
        mi.render(scene, spp=1)
        assert alive() == before + 1
        del scene
        assert alive() == before, m


# -- only what is in use -----------------------------------------------------------------------------------------------


def test_what_is_left_out_changes_nothing(mi_rgb, rng):
    """The Fresnel term of what reflects all, a factor of 1: as numbers, and as texels, of which nothing is known."""
    mi, n = mi_rgb, 2000
    wi, wo = directions(rng, n, 0.3, 0.0)
    si, wo, u = interactions(mi, vectors(mi, wi), np.zeros(n)), vectors(mi, wo), uniform(mi, rng, n)
    used = {"eta": 0.0, "k": 1.0, "specular_reflectance": 1.0, "alpha": 0.3}
    results, images = [], []
    for unknown in ((), ("eta",), ("k",), ("specular_reflectance",), ("alpha",), tuple(used)):
        m = {name: bitmap(mi, np.full((2, 2), v)) if name in unknown else v for name, v in used.items()}
        bsdf = mi.load_dict({**FORMS["tables"], **m})
        if unknown:
            bsdf._tracked_ior[0].bounds = bsdf._tracked_factor.bounds = ValueBounds
        left_out = bsdf.report()["effects_left_out"]
        assert (left_out == {"fresnel": "eta is 0 and k is 1", "specular_reflectance": "is 1"}) == (not unknown)
        bs, weight = bsdf.sample(mi.BSDFContext(), si, *u)
        result = (*bsdf.eval_pdf(mi.BSDFContext(), si, wo), bs.wo, bs.pdf, weight)
        dr.eval(result)
        results.append([v.numpy() for v in result])
        if unknown in ((), tuple(used)):
            images.append(mi.render(sphere_scene(mi, bsdf), spp=4).numpy())
    for found in results[1:]:
        for a, b in zip(found, results[0], strict=True):
            np.testing.assert_allclose(a, b, rtol=2e-5, atol=1e-6)
    assert equal_images(*images)


def test_report(mi_any):
    mi = mi_any
    effects = ["distribution", "masking", "fresnel", "specular_reflectance"]
    polarised = mi.is_polarized  # Mueller matrices are not left out
    bsdf = mi.load_dict(FORMS["tables"])
    report = bsdf.report()
    assert report["effects_in_use"] == [e for e in effects[: 3 if polarised else 2]]
    assert report["effects_left_out"]["specular_reflectance"] == "is not given"
    assert report["evaluated_once"] == ["roughness"]
    assert (report["preset"], report["storage"], report["table_bytes"]) == ("tables", "float32", 2304)
    report = mi.load_dict({**FORMS["tables"], "material": "Cu", "specular_reflectance": 0.5}).report()
    assert report["effects_in_use"] == effects and report["effects_left_out"] == {}
    report = mi.load_dict({**FORMS["tables"], "specular_reflectance": 1.0}).report()
    assert report["effects_left_out"]["specular_reflectance"] == "is 1"
    textured = mi.load_dict({**FORMS["tables"], "alpha": bitmap(mi, np.full((2, 2), 0.3))})
    assert textured.report()["evaluated_once"] == []


def test_an_optimised_parameter_keeps_its_effect(mi_rgb, rng):
    """At the very values at which it is left out, with and without an update."""
    mi, n = mi_rgb, 500
    wi, wo = directions(rng, n, 0.3)
    si, wo = interactions(mi, vectors(mi, wi)), vectors(mi, wo)
    keys = ("eta.value", "k.value", "specular_reflectance.value")
    for update in (False, True):
        bsdf = mi.load_dict({**FORMS["tables"], "specular_reflectance": 1.0})
        params = mi.traverse(bsdf)
        for key in keys:
            dr.enable_grad(params[key])
        if update:
            params.update()
        assert bsdf.report()["effects_left_out"] == {}
        dr.backward(dr.sum(bsdf.eval(mi.BSDFContext(), si, wo).x))
        for key in keys:
            # Nothing absorbs less than all that is reflected: an extremum, but for the factor
            assert np.isfinite(params[key].grad.numpy()).all(), key
        assert params["specular_reflectance.value"].grad[0] > 0
        for key in keys:
            dr.disable_grad(params[key])
        params.update()
        assert set(bsdf.report()["effects_left_out"]) == {"fresnel", "specular_reflectance"}


def test_what_is_constant_is_not_read(mi_rgb):
    """Reads and flops of an evaluation: a row instead of the primary array, no Fresnel term, no factor."""
    mi = mi_rgb

    def cost(**m):
        return bsdf_operations(mi.load_dict({"type": "neural_ggx", **m}))

    plain, copper = cost(), cost(material="Cu")
    textured = cost(alpha=bitmap(mi, np.full((2, 2), 0.3)))
    texel = 1  # nearest neighbour
    assert plain["eval"].gathers == 2 + 4 and textured["eval"].gathers == 4 + 4 + texel
    assert plain["pdf"].gathers == 0 and textured["pdf"].gathers == texel  # analytic
    assert plain["sample"].gathers == plain["eval"].gathers
    assert plain["eval"].flops < copper["eval"].flops and plain["eval"].flops < textured["eval"].flops
    assert copper["eval"].gathers == plain["eval"].gathers
    packed, packed_textured = cost(storage="uint8"), cost(storage="uint8", alpha=bitmap(mi, np.full((2, 2), 0.3)))
    assert packed["eval"].gathers < packed_textured["eval"].gathers - texel + 2
    assert packed["eval"].bytes_gathered < plain["eval"].bytes_gathered


# -- scenes ------------------------------------------------------------------------------------------------------------

SCENE = """
<scene version="3.0.0">
    <integrator type="path"><integer name="max_depth" value="4"/></integrator>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, -6, 3" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="40"/>
            <rfilter type="box"/></film>
        <sampler type="independent"><integer name="sample_count" value="32"/></sampler>
    </sensor>
    <emitter type="constant"><rgb name="radiance" value="0.3"/></emitter>
    <emitter type="point"><point name="position" x="2" y="-3" z="5"/><rgb name="intensity" value="20"/></emitter>
    <shape type="rectangle"><transform name="to_world"><scale value="4"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape>
    <shape type="sphere"><point name="center" x="-1.4" y="0" z="0.6"/><float name="radius" value="0.6"/>
        <bsdf type="neural_ggx" id="copper"><string name="material" value="Cu"/>
            <float name="alpha" value="0.15"/><string name="storage" value="uint8"/></bsdf></shape>
    <shape type="sphere"><point name="center" x="0" y="0" z="0.6"/><float name="radius" value="0.6"/>
        <bsdf type="twosided"><bsdf type="neural_ggx" id="gold"><string name="material" value="Au"/>
            <float name="alpha" value="0.4"/><boolean name="sample_visible" value="true"/></bsdf></bsdf></shape>
    <shape type="sphere"><point name="center" x="1.4" y="0" z="0.6"/><float name="radius" value="0.6"/>
        <bsdf type="neural_ggx" id="checked"><texture type="checkerboard" name="alpha">
            <float name="color0" value="0.05"/><float name="color1" value="0.7"/>
            <transform name="to_uv"><scale value="8"/></transform></texture>
            <rgb name="specular_reflectance" value="0.9, 0.8, 0.6"/>
            <string name="preset" value="tables"/></bsdf></shape>
</scene>
"""


@pytest.fixture
def scene_file(tmp_path):
    (tmp_path / "metals.xml").write_text(SCENE)
    return tmp_path / "metals.xml"


def test_a_scene_and_its_exact_counterpart(mi_rgb, scene_file):
    """``scenes.load(exact=True)`` swaps the plugin, drops what only it takes and names the distribution."""
    mi = mi_rgb
    exact = loading.load(scene_file, exact=True)
    text, distribution = str(exact), '<string name="distribution" value="ggx"/>'
    assert "NeuralGGX" not in text  # a twosided one has two sides
    assert text.count("RoughConductor[") == text.count("distribution = ggx") == 4
    assert not loading.learned_instances(exact)
    written = loading.load(scene_file)
    assert str(written).count("NeuralGGX[") == 4 and "RoughConductor" not in str(written)
    by_hand = re.sub('<string name="(storage|preset)" value="[a-z0-9]*"/>', "", SCENE)
    by_hand = re.sub('type="neural_ggx" (id="[a-z]*")>', r'type="roughconductor" \1>' + distribution, by_hand)
    assert "neural" not in by_hand and by_hand.count(distribution) == 3
    expected = mi.render(mi.load_string(by_hand), spp=4).numpy()
    assert np.array_equal(mi.render(exact, spp=4).numpy(), expected)
    assert not np.array_equal(mi.render(written, spp=4).numpy(), expected)


def test_comparison(mi_rgb, scene_file):
    result = comparison.compare(scene_file, spp=64, passes=2, progress=False)
    assert result.figures["psnr_db"] >= 60  # 62.7 is reached
    assert result.figures["flip"] < 0.007
    assert result.figures["learned_plugins"] == 3
    assert result.figures["table_bytes"] == 2304 + 576  # the same file in two forms


def test_what_is_known_of_a_scene(mi_rgb, scene_file):
    learned = loading.ParsedScene(scene_file).learned_plugins()
    assert [entry["id"] for entry in learned] == ["copper", "gold", "checked"]
    assert learned[0]["parameters"] == {"material": "Cu", "alpha": pytest.approx(0.15)}
    assert learned[0]["storage"] == "uint8" and learned[2]["parameters"]["alpha"] == "texture"
    reports = {report["id"]: report for report in loading.reports(loading.load(scene_file))}
    assert reports["copper"]["effects_left_out"] == {"specular_reflectance": "is not given"}
    assert reports["checked"]["evaluated_once"] == [] and reports["gold"]["evaluated_once"] == ["roughness"]
    assert reports["copper"]["operations"]["eval"]["flops"] > 0


def test_same_scene_same_image(mi_rgb, scene_file):
    first, second = (loading.render(loading.load(scene_file), 4, seed=3, passes=2)[0] for _ in range(2))
    assert np.array_equal(first, second)


def test_changing_type_from_roughconductor_is_all_it_takes(mi_any):
    mi = mi_any
    m = {"alpha": 0.2, "eta": 0.5, "k": 2.0, "specular_reflectance": 0.9, "sample_visible": True}
    exact, learned = (mi.load_dict({**EXACT, "type": name, **m}) for name in ("roughconductor", "neural_ggx"))
    keys = set(mi.traverse(learned).keys())
    assert keys == set(mi.traverse(exact).keys()) | {"tables.primary", "tables.cascaded"}
    assert learned.flags() == exact.flags() and learned.flags(0) == exact.flags(0)
    assert not mi.has_flag(learned.flags(), mi.BSDFFlags.BackSide)
    si = interactions(mi, vectors(mi, [[0, 0, 1]]))
    a, b = (bsdf.eval_diffuse_reflectance(si).numpy() for bsdf in (learned, exact))
    np.testing.assert_allclose(a, b, rtol=0.02, atol=1e-3)
    text = str(learned)
    assert text.startswith("NeuralGGX[") and "alpha = " in text and "2304 bytes as float32" in text


# -- mistakes ----------------------------------------------------------------------------------------------------------

MISTAKES = [
    ({"alpha": 1.5}, 'parameter "alpha": found 1.5, allowed is [0, 1]'),
    ({"alpha": -0.1}, 'parameter "alpha": found -0.1, allowed is [0, 1]'),
    ({"alpha": float("nan")}, 'parameter "alpha": found nan, allowed is [0, 1]'),
    ({"alpha_u": 0.1, "alpha_v": 0.2}, 'parameter "alpha_u": the tables are isotropic, give "alpha"'),
    ({"distribution": "beckmann"}, 'parameter "distribution": found beckmann, only ggx is allowed'),
    ({"sample_visible": False}, 'parameter "sample_visible": found false, only true is allowed'),
    ({"material": "Unobtainium"}, 'parameter "material": found "Unobtainium", Mitsuba has no such preset'),
    ({"material": "Cu", "eta": 1.5}, 'parameter "material": sets "eta" and "k", give either a material or these'),
    ({"material": "Cu", "k": 1.5}, 'parameter "material": sets "eta" and "k", give either a material or these'),
    ({"storage": "float8"}, 'parameter "storage": found "float8", allowed are float32, float16, uint8'),
    ({"preset": "fast"}, 'parameter "preset": found "fast", allowed are tables, paper'),
    ({"filename": "nowhere.npz"}, "nowhere.npz: no such file"),
    ({"roughness": 0.5}, 'float "roughness"'),
    ({"specular_reflectance": rgb(1.5, 0, 0)}, "must be in the range [0, 1]"),
]


@pytest.mark.parametrize("parameters, sentence", MISTAKES)
def test_bad_parameters_are_refused(mi_rgb, parameters, sentence):
    with pytest.raises(RuntimeError) as caught:
        mi_rgb.load_dict({"type": "neural_ggx", **parameters})
    assert sentence in str(caught.value)
    assert sentence in compat.one_sentence(caught.value)
    assert "\n" not in compat.one_sentence(caught.value)


def test_bad_files_are_refused(mi_rgb, tmp_path):
    disney = DISNEY.file()
    with pytest.raises(RuntimeError, match=r'disney_tables\.npz: holds tables for the task "disney", expected "ggx"'):
        mi_rgb.load_dict({"type": "neural_ggx", "filename": str(disney)})
    own = {"type": "neural_ggx", "filename": str(TASK.file(preset="paper")), "preset": "tables"}
    with pytest.raises(RuntimeError, match='holds tables of the preset "paper", "tables" was asked for'):
        mi_rgb.load_dict(own)


def test_a_mistake_in_a_scene_names_the_file(mi_rgb, scene_file):
    scene_file.write_text(SCENE.replace('"0.4"', '"1.4"'))
    with pytest.raises(loading.SceneError, match=r'metals\.xml.*parameter "alpha": found 1.4, allowed is \[0, 1\]'):
        loading.load(scene_file)


def test_scalar_variants_are_refused():
    import mitsuba as mi

    mi.set_variant("scalar_rgb")
    with pytest.raises(RuntimeError, match='"neural_ggx" does not run in the variant "scalar_rgb"; use one of llvm_ad'):
        mi.load_dict(FORMS["tables"])
