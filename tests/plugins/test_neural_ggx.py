"""The plugin ``neural_ggx`` inside Mitsuba: against its exact counterpart and an independent implementation, and what
it leaves out. (What holds of every BSDF: ``test_bsdf_contract.py``.)
"""

import itertools
import math

import drjit as dr
import ggx_formulas
import numpy as np
import pytest
from arrays import aligned
from bsdf_queries import (
    bitmap,
    equal_images,
    extreme_directions,
    interactions,
    random_directions,
    sphere_scene,
    texels,
    uniform,
    vectors,
)
from variants import VARIANTS, set_variant

from mi_diffind.arrays.boxes import ValueBounds
from mi_diffind.measure.clock import bsdf_operations
from mi_diffind.tasks.ggx import TASK
from mi_diffind.tasks.ggx.model import ALPHA_FLOOR
from mi_diffind.tasks.ggx.training import table_encoding

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
    "smooth texels": {"alpha": {"type": "checkerboard", "color0": 0.0437, "color1": 0.0437}, "eta": 0.3, "k": 2.7},
    "a uniform roughness": {"alpha": {"type": "uniform", "value": 0.6}, "material": "none"},
}


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


def normals(form):
    """Distribution of normals of a form, read in its tables by NumPy and SciPy."""
    table = TASK.load(TASK.file(preset=FORMS[form].get("preset", "tables")))
    encoding = table_encoding(table)
    return ggx_formulas.learned(table.to(FORMS[form].get("storage", table.storage)), encoding.inputs, encoding.output)


#: A colour in the place of a number, which would depend on the wavelength; and whether the variant is spectral.
IMPOSSIBLE = ("a grey roughness", True)


#: Each of these is a way of its own through colours and polarisation, the others are not.
COLOURED = ("white", "copper", "a coloured index", "tinted", "a grey roughness")


@pytest.mark.parametrize(
    "variant, material, form",
    [
        *((variant, material, "tables") for variant in VARIANTS for material in MATERIALS
          if variant.endswith("ad_rgb") or (material in COLOURED and (material, "spectral" in variant) != IMPOSSIBLE)),
        *itertools.product(VARIANTS[:1], ("smooth texels", "rough gold", "roughest"), list(FORMS)[1:]),
    ],
)  # fmt: skip
def test_the_exact_plugin_times_what_the_table_says(variant, rng, material, form):
    """Value and weight are those of ``roughconductor`` times D̂/D, which NumPy and SciPy read in the table file:
    everything but the distribution is equal up to rounding, Mueller matrices included. Samples and densities are equal.
    """
    mi, m, n = set_variant(variant), MATERIALS[material], 10_000
    alpha = m.get("alpha", 0.1)
    alpha = max(float(np.mean(alpha.get("value", 0.0437) if isinstance(alpha, dict) else alpha)), ALPHA_FLOOR)
    wi, wo = directions(rng, n, alpha)
    si, u = interactions(mi, vectors(mi, wi)), uniform(mi, rng, n)
    exact, learned = mi.load_dict({**EXACT, **m}), mi.load_dict({**FORMS[form], **m})
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
            ratio = normals(form)(sin2, alpha) / ggx_formulas.distribution(sin2, alpha)
            # That of the tail, which is the same all along
            assert np.median(np.abs(ratio - 1)) < 0.035 or form.startswith("paper")
            expected = given * ratio
            scale = np.abs(expected).reshape(-1, len(sin2)).max(axis=0)
            if material == "black":
                assert not found.any() and not given.any()
                continue
            # Bytes are read at 1/64 of a step, which the paper's unbounded output does not forgive
            bound = {"tables uint8": 0.02, "paper uint8": 0.3}.get(form, 3e-3)
            error = np.abs(found - expected)
            assert (error <= bound * scale + (1e-6 if bound < 0.01 else 1e-3)).all(), np.max(error / scale)


@pytest.mark.parametrize("form", ["tables", "tables float16", "tables uint8", "paper"])
def test_energy(mi, rng, form):
    """Against the exact weights of the same samples, which are Smith's masking, from no roughness to all of it and down
    to the horizon: their mean is within 0.012 (of bytes 0.016) of the exact albedo, and next to the horizon not 0.02
    (0.035) above it; no single weight is higher by more than a tenth.
    """
    side = 128
    alphas = [0.0, 1e-4, 2e-4, 5e-4, 7e-4, 1e-3, 0.0015, 0.003, 0.005, 0.01, 0.0133, 0.05, 0.132, 0.3, 0.6, 1.0]
    angles = (0, 30, 60, 75, 84, 88, 89, 89.9, 89.99, 89.999, 90 - 1e-5, 90 - 1e-9)
    x, y = (np.minimum((v.ravel() + rng.random(side**2)) / side, 1 - 2**-24) for v in np.mgrid[:side, :side])
    theta = np.radians(np.repeat(angles, side**2))
    wi = np.stack([np.sin(theta), 0 * theta, np.cos(theta)], axis=1)
    u = mi.Point2f(*(aligned(np.tile(v, len(angles))) for v in (x, y)))
    bsdf = mi.load_dict({**FORMS[form], "alpha": texels(mi, alphas)})
    for i, alpha in enumerate(alphas):
        si = interactions(mi, wi, np.full(len(wi), i), len(alphas))
        bs, weight = bsdf.sample(mi.BSDFContext(), si, mi.Float(0.5), u)
        valid, cosine = bs.pdf.numpy() > 0, np.maximum(bs.wo.z.numpy().astype(np.float64), 1e-30)
        expected = np.where(valid, ggx_formulas.smith(cosine, max(np.float32(alpha), ALPHA_FLOOR)), 0)
        weight = weight.x.numpy().astype(np.float64)
        assert valid.mean() > 0.5
        gain = (weight - expected).reshape(len(angles), -1).mean(axis=1)
        if form == "paper":  # misses the peak of what is smooth, and more than makes up for it around it
            assert alpha < 0.5 or np.abs(gain[:6]).max() <= 0.02
            continue
        assert (weight <= 1.1 * expected).all(), (alpha, np.max(weight[valid] / expected[valid]))
        assert gain.max() < (0.035 if form == "tables uint8" else 0.02), (alpha, gain)
        assert alpha < 1e-3 or np.abs(gain[:6]).max() <= (0.016 if form == "tables uint8" else 0.012), (alpha, gain)


@pytest.mark.parametrize("preset", PRESETS)
def test_gradients_with_respect_to_directions(mi, rng, preset):
    """Derivatives by directions are differences along great circles, and finite at the extremes."""
    n, alpha, step = 10_000, 0.2371, 1e-6
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
    for gradient in gradients(*extreme_directions(rng, 4000)):
        assert np.isfinite(gradient).all()


def test_what_is_left_out_changes_nothing(mi, rng):
    """The Fresnel term of what reflects all, a factor of 1: as numbers, and as texels, of which nothing is known."""
    n = 2000
    wi, wo = directions(rng, n, 0.3, 0.0)
    si, wo, u = interactions(mi, vectors(mi, wi), np.zeros(n)), vectors(mi, wo), uniform(mi, rng, n)
    used = {"eta": 0.0, "k": 1.0, "specular_reflectance": 1.0, "alpha": 0.3}
    results, images = [], []
    for unknown in ((), ("eta",), ("k",), ("specular_reflectance",), ("alpha",), tuple(used)):
        m = {name: bitmap(mi, np.full((2, 2), v)) if name in unknown else v for name, v in used.items()}
        bsdf = mi.load_dict({**FORMS["tables"], **m})
        if unknown:
            bsdf._tracked["eta"].bounds = bsdf._tracked["specular_reflectance"].bounds = ValueBounds
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
    """Nothing is left out of a tinted metal; Mueller matrices are never left out."""
    effects = ["distribution", "masking", "fresnel", "specular_reflectance"]
    report = mi_any.load_dict(FORMS["tables"]).report()
    assert report["effects_in_use"] == effects[: 3 if mi_any.is_polarized else 2]
    assert report["effects_left_out"]["specular_reflectance"] == "is not given"
    assert (report["preset"], report["storage"], report["table_bytes"]) == ("tables", "float32", 2304)
    report = mi_any.load_dict({**FORMS["tables"], "material": "Cu", "specular_reflectance": 0.5}).report()
    assert report["effects_in_use"] == effects and report["effects_left_out"] == {}


def test_what_is_constant_is_not_read(mi):
    """Reads and flops of an evaluation: a row instead of the primary array, no Fresnel term, no factor."""

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
