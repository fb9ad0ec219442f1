"""
The Disney plugins where it is hardest: what is left out because a material does not use it, energy and accuracy at the
horizon and at the peak, derivatives at the ends of parameters, and a long optimisation.
"""

import itertools

import disney_formulas
import drjit as dr
import numpy as np
import pytest
from arrays import aligned
from bsdf_queries import close, interactions, random_directions, uniform, vectors, with_cosines
from disney_materials import FORMS, PLAIN, PRESETS, RICH, SCALARS, plugin, textured
from spheres import key_of, sphere_scene

from mi_diffind.arrays.boxes import ValueBounds
from mi_diffind.fitting.loop import EXPONENTIAL_RATE
from mi_diffind.tasks.disney import TASK, training
from mi_diffind.tasks.disney.decoder import Decoder
from mi_diffind.tasks.disney.model import Material, find_effects

# -- nothing but time is saved by what is left out ---------------------------------------------------------------------


def distinct_effects():
    """
    A material for every set of parts that can be in use together: each parameter absent (0), present, or, where this
    turns something else off, full; each with a coloured, a grey and a black albedo.
    """
    full = {"flatness": (0.0, 0.5, 1.0), "metallic": (0.0, 0.5, 1.0)}
    names = ("flatness", "sheen", "sheen_tint", "metallic", "specular", "spec_tint", "anisotropic", "clearcoat")
    albedos = {"colour": (0.8, 0.3, 0.1), "grey": (0.5, 0.5, 0.5), "black": (0.0, 0.0, 0.0)}
    found = {}
    for values in itertools.product(*(full.get(name, (0.0, 0.5)) for name in names)):
        for kind, albedo in albedos.items():
            m = dict(zip(names, values, strict=True))
            known = {name: ValueBounds(v, v) for name, v in m.items()}
            known["base_color"] = ValueBounds(min(albedo), max(albedo), grey=kind != "colour")
            effects, _ = find_effects(known)
            gloss = 0.7 if m["clearcoat"] else 0.0
            found.setdefault(effects, {**m, "base_color": albedo, "roughness": 0.35, "clearcoat_gloss": gloss})
    return found


def evaluated(mi, bsdf, si, wo, u):
    ctx = mi.BSDFContext()
    value, pdf = bsdf.eval_pdf(ctx, si, wo)
    bs, weight = bsdf.sample(ctx, si, *u)
    return [value, pdf, bs.wo, bs.pdf, weight]


def check_equal_to_unculled(mi, rng, form, materials, effects=None):
    """
    Each material as a constant, with only its effects, against all of them as texels, with all effects; in batches,
    since a kernel costs more than what it computes.
    """
    n = 500
    unculled = textured(mi, form, materials, effects="all")
    wi, wo, u = random_directions(rng, n), random_directions(rng, n), uniform(mi, rng, n)
    wi_, wo_ = vectors(mi, wi), vectors(mi, wo)
    k = len(materials)
    lane = np.tile(np.arange(n), k)
    index = mi.UInt32(lane)
    everywhere = [dr.gather(type(v), v, index) for v in (wi_, wo_, *u)]
    si = interactions(mi, everywhere[0], np.repeat(np.arange(k), n), k)
    reference = [v.numpy().reshape(-1, k, n) for v in evaluated(mi, unculled, si, everywhere[1], everywhere[2:])]
    si = interactions(mi, wi_)
    for start in range(0, k, 4):
        batch = range(start, min(start + 4, k))
        bsdfs = [mi.load_dict(plugin(mi, form, materials[i])) for i in batch]
        if effects is not None:
            assert [b.report()["effects_in_use"] for b in bsdfs] == [list(effects[i].names) for i in batch]
        results = [evaluated(mi, bsdf, si, wo_, u) for bsdf in bsdfs]
        dr.eval(results)
        for i, found in zip(batch, results, strict=True):
            found = [v.numpy().reshape(-1, n) for v in found]
            expected = [v[:, i] for v in reference]
            for what, a, b in zip(("value", "pdf"), found, expected, strict=False):
                assert close(a, b, 2e-5).all(), (what, materials[i])
            # A sample next to the threshold between two lobes may belong to the other one
            same = np.abs(found[2] - expected[2]).max(axis=0) < 1e-3
            same |= (found[3][0] == 0) & (expected[3][0] == 0)
            assert same.mean() > 0.99, materials[i]
            for what, a, b in zip(("sampled pdf", "weight"), found[3:], expected[3:], strict=True):
                near = close(a[:, same], b[:, same], 5e-3)
                assert near.mean() > 0.998, (what, materials[i])  # but for rounding of directions next to a peak


@pytest.mark.parametrize("every", [6, pytest.param(1, marks=pytest.mark.slow)])
def test_what_is_left_out_changes_nothing(mi_rgb, rng, every):
    found = distinct_effects()
    assert len(found) > 200
    check_equal_to_unculled(mi_rgb, rng, "disney", list(found.values())[::every], list(found)[::every])


@pytest.mark.parametrize("form", ["tables", "paper"])
def test_what_is_left_out_changes_nothing_in_tables(mi_rgb, rng, form):
    """Some of the sets, since what differs between presets is the factors and not what they are used for."""
    found = list(distinct_effects().items())
    chosen = [found[i] for i in rng.choice(len(found), 8, replace=False)]
    check_equal_to_unculled(mi_rgb, rng, form, [m for _, m in chosen], [e for e, _ in chosen])


# -- energy and accuracy -----------------------------------------------------------------------------------------------


def random_population(rng, n, distribution):
    """Materials as they are drawn for training, or uniform."""
    color, m, wi, wo = disney_formulas.random_case(rng, n, low_cosine=1e-5)
    if distribution == "training":
        for name in ("metallic", "roughness"):  # inverse of the exponential-like distribution's CDF
            m[name] = -np.log(1 - m[name] * (1 - np.exp(-EXPONENTIAL_RATE))) / EXPONENTIAL_RATE
    return color.astype("f4"), {k: v.astype("f4") for k, v in m.items()}, wi.astype("f4"), wo.astype("f4")


def shaded(types, decoder, case):
    color, m, wi, wo = case
    material = Material(**{name: types.Float(m[name]) for name in SCALARS})
    vectors = [types.Array3f(aligned(v.T)) for v in (color, wi, wo)]
    return training.shade(decoder, material, *vectors).numpy().T.astype(np.float64)


#: Numbers of samples.
POPULATION = pytest.mark.parametrize("n", [200_000, pytest.param(1_000_000, marks=pytest.mark.slow)])


#: Form and storage → a decibel or two less than is reached.
REACHED = {("disney", ""): 127, ("tables", "float32"): 87, ("tables", "float16"): 82.5, ("tables", "uint8"): 80.5}


def decoder_for(types, form, storage):
    return Decoder() if form == "disney" else TASK.open(types.TensorXf, "", form, storage).decoder


def check_grazing(form, name, found, expected):
    """99 of 100 within a hundredth, and none much higher than the exact value, where that is not next to nothing."""
    counts = expected > 1e-3
    relative = np.abs(found - expected)[counts] / expected[counts]
    ratio = (found[counts] / expected[counts]).max()
    print(f"{name}: 99th percentile of the relative error {np.quantile(relative, 0.99):.2g}, largest ratio {ratio:.3f}")
    assert np.isfinite(found).all() and found.min() >= 0
    percentile, largest = (5e-5, 1.03) if form == "disney" else (0.008, 1.06)
    assert np.quantile(relative, 0.99) <= percentile, name
    assert ratio <= largest, name


def near_the_horizon(rng, wi, wo):
    """One of the directions, or both, with a cosine below 0.02."""
    kind = rng.integers(0, 3, len(wi))
    low = [with_cosines(rng, np.maximum(0.02 * rng.random(len(wi)) ** 2, 1e-6)) for _ in range(2)]
    return np.where((kind != 1)[:, None], low[0], wi), np.where((kind != 0)[:, None], low[1], wo)


def near_the_peak(rng, wi):
    """Directions whose half vector is within 10⁻⁴ of the normal."""
    h = with_cosines(rng, 1 - 1e-4 * rng.random(len(wi)) ** 2).astype(np.float64)
    wo = 2 * np.sum(wi * h, axis=1, keepdims=True) * h - wi
    wo[:, 2] = np.maximum(wo[:, 2], 1e-6)
    return (wo / np.linalg.norm(wo, axis=1, keepdims=True)).astype(np.float32)


@POPULATION
@pytest.mark.parametrize("distribution", ["training", "uniform"])
@pytest.mark.parametrize("where", ["horizon", "peak"])
def test_accuracy_where_it_is_hardest_to_keep(mi_rgb, rng, distribution, where, n):
    import drjit.llvm.ad as types

    color, m, wi, wo = random_population(rng, n, distribution)
    if where == "horizon":
        wi, wo = near_the_horizon(rng, wi, wo)
    else:
        wo = near_the_peak(rng, wi)
    case = color, m, wi, wo
    expected = disney_formulas.brdf(*case)
    cosine = wo[:, 2:3].astype(np.float64)
    for form, storage in REACHED:
        decoder = decoder_for(types, form, storage)
        check_grazing(
            form, f"{where}, {distribution}, {form} {storage}", shaded(types, decoder, case) / cosine, expected
        )
    paper = decoder_for(types, "paper", "")
    found = shaded(types, paper, case) / cosine
    counts = expected > 1e-3
    ratio = found[counts] / expected[counts]
    print(f"{where}, {distribution}, paper: ratios from {ratio.min():.3g} to {ratio.max():.3g}")
    assert np.isfinite(found).all() and found.min() >= 0


# -- gradients where an effect is exactly off --------------------------------------------------------------------------


def gradient_cases():
    """Parameter → materials in which it is exactly 0 (or 1): everything else off, and everything else on."""
    bare = {**PLAIN, "base_color": (0.6, 0.4, 0.3), "roughness": 0.4}
    cases = [(name, {**base, name: 0.0}, 1) for name in SCALARS for base in (bare, RICH)]
    cases += [("base_color", {**base, "base_color": (0.0, 0.0, 0.0)}, 1) for base in (bare, RICH)]
    cases += [(name, {**RICH, name: 1.0}, -1) for name in ("metallic", "flatness", "clearcoat", "anisotropic")]
    return cases


@pytest.mark.parametrize(
    "form, every",
    [("disney", 1), ("tables", 3), ("paper", 3), *(pytest.param(p, 1, marks=pytest.mark.slow) for p in PRESETS)],
)
def test_gradients_at_the_ends_against_finite_differences(mi_rgb, rng, form, every):
    """
    One-sided differences of second order, from texels, so that nothing is left out of them; the gradient from a
    material of constants in which only the gradient that is asked for keeps the effect in use. Each second one has its
    gradient enabled without an update afterwards.
    """
    mi, n, step = mi_rgb, 500, 4e-3
    cases = gradient_cases()[::every]
    wi, wo = random_directions(rng, n, 0.1), random_directions(rng, n, 0.1)
    shifted = []
    for name, m, sign in cases:
        for k in range(3):
            value = m[name] if name != "base_color" else m[name][0]
            value = value + sign * k * step
            shifted.append({**m, name: value if name != "base_color" else (value,) * 3})
    count = len(shifted)
    lane = np.tile(np.arange(n), count)
    si = interactions(mi, vectors(mi, wi[lane]), np.repeat(np.arange(count), n), count)
    values = textured(mi, form, shifted).eval(mi.BSDFContext(), si, vectors(mi, wo[lane])).numpy()
    totals = values.astype(np.float64).sum(axis=0).reshape(len(cases), 3, n)
    si, wo_, zeros = interactions(mi, vectors(mi, wi)), vectors(mi, wo), dr.opaque(mi.Float, 0, n)
    gradients = []
    for i, (name, m, _) in enumerate(cases):
        bsdf = mi.load_dict(plugin(mi, form, m))
        params = mi.traverse(bsdf)
        key = "specular" if name == "specular" else f"{name}.value"
        dr.enable_grad(params[key])
        if i % 2:
            params.update()
        # Repeated for each lane: gradients are summed by NumPy and not by a kernel for each
        params[key] = dr.detach(params[key]) + zeros
        dr.enable_grad(params[key])
        value = bsdf.eval(mi.BSDFContext(), si, wo_)
        # A tint of nothing may well have no gradient at all
        dr.backward(value.x + value.y + value.z, dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
        gradients.append(params[key].grad)
    dr.eval(gradients)
    for (name, m, sign), (at, near, far), gradient in zip(cases, totals, gradients, strict=True):
        each = sign * (-3 * at + 4 * near - far) / (2 * step)
        found, expected, scale = gradient.numpy().sum(), each.sum(), np.abs(each).sum()
        if name == "roughness":
            # There α is at its smallest value: flat in the formulas, and with a kink somewhere else in the tables
            assert np.isfinite(found)
            continue
        # In the paper's layout, factors that the tables make negative are set to zero: kinks next to the ends
        tolerance = 0.1 if form == "paper" else 0.02
        assert abs(found - expected) <= tolerance * scale + 1e-3, (name, m, found, expected)
        if scale > 1:
            assert found != 0, (name, m)


# -- a long optimisation -----------------------------------------------------------------------------------------------


WARM_UP = 25


def resident_bytes():
    with open("/proc/self/statm") as f:
        return int(f.read().split()[1]) * 4096


def optimise(mi, form, steps, start, target):
    """
    Recover roughness, albedo and clearcoat of ``target`` from its image. Returns what was found, and of each step its
    kernels, and the process's memory and Dr.Jit's largest, in bytes.
    """
    lamps = {
        f"lamp{i}": {"type": "point", "position": position, "intensity": 15.0}
        for i, position in enumerate(([-3.0, 1.0, 3.0], [0.0, -3.0, 4.0]))
    }
    fixed, lit = {"clearcoat_gloss": 0.3, "metallic": 0.5}, {"size": 24, "depth": 2, "light": 0.02, **lamps}
    reference = mi.render(sphere_scene(mi, plugin(mi, "disney", {**fixed, **target}), "prb", **lit), spp=512)
    scene = sphere_scene(mi, plugin(mi, form, {**fixed, **start}), "prb", **lit)
    params = mi.traverse(scene)
    keys = {name: key_of(params, f"bsdf.{name}.value") for name in ("roughness", "base_color", "clearcoat")}
    opt = mi.ad.Adam(lr=0.03)
    for key in keys.values():
        opt[key] = params[key]
    opt.set_learning_rate({keys["clearcoat"]: 0.15})
    backend = dr.backend_v(mi.Float)
    history, launched, resident, watermark = [], [], [], []
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        for step in range(steps):
            dr.detail.malloc_clear_statistics()
            for key in keys.values():
                opt[key] = dr.clip(opt[key], 0, 1)
            params.update(opt)
            image = mi.render(scene, params, spp=8, seed=step)
            loss = dr.mean(dr.square(image - reference), axis=None)
            dr.backward(loss)
            assert np.isfinite(float(loss.array[0])), step
            opt.step()
            dr.eval([opt[key] for key in keys.values()])
            kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
            launched.append({entry["hash"] for entry in kernels})
            history.append(np.concatenate([opt[key].numpy().ravel() for key in keys.values()]))
            resident.append(resident_bytes())
            watermark.append(dr.detail.malloc_watermark(backend))
    # The noise of the images makes the parameters wander: their mean
    roughness, *albedo, coat = np.mean(history[len(history) * 3 // 5 :], axis=0)
    found = {"roughness": roughness, "base_color": np.array(albedo), "clearcoat": coat}
    return found, launched, np.array(resident), np.array(watermark)


@pytest.mark.parametrize(
    "form, steps", [("disney", 80), *(pytest.param(f, 500, marks=pytest.mark.slow) for f in FORMS)]
)
def test_a_long_optimisation(mi_rgb, form, steps):
    """
    500 steps from a coat of exactly 0 recover roughness and albedo within 0.03 and the coat, of which little is seen,
    within 0.1, and fewer come close, at constant cost: after the warm-up no new kernel appears and memory stays.
    """
    start = {"roughness": 0.3, "base_color": (0.5, 0.5, 0.5), "clearcoat": 0.0}
    target = {"roughness": 0.6, "base_color": (0.7, 0.2, 0.1), "clearcoat": 0.8}
    found, launched, resident, watermark = optimise(mi_rgb, form, steps, start, target)
    grown = (resident[-1] - resident[WARM_UP]) / 2**20
    print(f"{form}: memory {grown:+.2f} MiB, {found}")
    known = set().union(*launched[:WARM_UP])
    assert known and all(kernels <= known for kernels in launched[WARM_UP:])
    assert watermark[WARM_UP:].max() <= watermark[5:WARM_UP].max() * 1.05 + 2**16
    assert grown < 16
    for name, expected in target.items():
        tolerance = (0.03 if steps == 500 else 0.05) if name != "clearcoat" else 0.1 if steps == 500 else 0.25
        assert np.allclose(found[name], expected, atol=tolerance), (name, found[name])
