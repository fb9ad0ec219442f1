"""What decides in the training for shading: held-out footprints, gains and losses; and what that training begins with.

Sensitivities and weights of maps, reads of pixels with four samples, and arrays in between.
"""

import dataclasses
import math

import disney_formulas
import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of

from mi_diffind.core.runtime import array_module
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import from_arrays
from mi_diffind.tasks.texture import PRESETS, SHADING_PRESETS, parse_structure, shading, training
from mi_diffind.tasks.texture.appearance import reader
from mi_diffind.tasks.texture.arrays import TextureBudget, from_components
from mi_diffind.tasks.texture.compressed import neutral_extras
from mi_diffind.tasks.texture.heldout import (
    ALPHAS,
    CASES,
    LOSS,
    PLACES,
    SINGLE,
    HeldOutFootprints,
    loss_or_gain,
    mirrored_pairs,
)
from mi_diffind.tasks.texture.surface import material_effects

SIDE = 16


@pytest.fixture(scope="module")
def ad():
    return array_module("llvm")


def pyramid_of(ad, maps):
    source = from_arrays(maps)
    layout = training.source_layout(source, PRESETS["ours"])
    return Pyramid.from_source(source, layout, ad, ("repeat", "repeat"))


def almost_constant(ad, roughness=0.7, albedo=128, seed=0):
    """A flat material without metal, whose maps vary by one step of a byte."""
    rng = np.random.default_rng(seed)

    def bytes_near(value, channels):
        return (value - rng.integers(0, 2, (SIDE, SIDE, channels))).astype(np.uint8)

    normal = np.concatenate([bytes_near(128, 2), np.full((SIDE, SIDE, 1), 255, np.uint8)], axis=-1)
    return pyramid_of(
        ad, {"albedo": bytes_near(albedo, 3), "normal": normal, "roughness": bytes_near(255 * roughness, 1)}
    )


def uniform(rng, n):
    """Directions, uniform over the hemisphere."""
    z, angle = rng.random(n), 2 * np.pi * rng.random(n)
    sine = np.sqrt(1 - z**2)
    return np.stack([sine * np.cos(angle), sine * np.sin(angle), z], axis=-1)


# -- views and lights -------------------------------------------------------------------------------------------------


def test_uniform_lights(ad, rng):
    """Means of uniform views and lights that are known."""
    n = 2**18
    wi, wo, weight = mirrored_pairs(ad, [ad.Float(aligned(x)) for x in rng.random((5, n), dtype=np.float32)], 0.0)
    a, b = numpy_of(wi), numpy_of(wo)
    assert (
        np.allclose(np.linalg.norm(b, axis=1), 1, atol=1e-4) and (b[:, 2] > 0).all() and weight.numpy().mean() > 0.9999
    )
    for values, expected in ((b[:, 2], 1 / 2), (b[:, 2] ** 2, 1 / 3), (b[:, 0] ** 2, 1 / 3), (b[:, 1], 0),
                             (a[:, 2] * b[:, 2], 1 / 4)):  # fmt: skip
        assert abs(values.mean() - expected) < 4 * values.std() / np.sqrt(n)


def test_lights_about_the_mirror_direction(ad, rng):
    """Divided by the density of GGX lobes in NumPy, means are those of uniform lights."""
    n = 2**18
    wi, wo, weight = mirrored_pairs(ad, [ad.Float(aligned(x)) for x in rng.random((5, n), dtype=np.float32)], 1.0)
    a, b, w = (x.astype(float) for x in (numpy_of(wi), numpy_of(wo), weight.numpy()))
    assert set(np.unique(w)) == {0.0, 1.0}
    h = (a + b) / np.linalg.norm(a + b, axis=1, keepdims=True)
    lobes = [alpha**2 / (np.pi * (1 + (alpha**2 - 1) * h[:, 2] ** 2) ** 2) for alpha in ALPHAS]
    density = np.mean(lobes, axis=0) * h[:, 2] / (4 * (h * a).sum(axis=1))

    def highlight(wi, wo):
        h = wi + wo
        return (h[:, 2] / np.linalg.norm(h, axis=1)) ** 2000

    mirrored = w * highlight(a, b) / (2 * np.pi * density)
    plain = highlight(uniform(rng, 4 * n), uniform(rng, 4 * n))
    error = np.hypot(mirrored.std() / np.sqrt(n), plain.std() / np.sqrt(4 * n))
    assert abs(mirrored.mean() - plain.mean()) < 4 * error


# -- held-out footprints ----------------------------------------------------------------------------------------------


def test_errors_and_brightness_of_a_constant_material(ad):
    """The maps themselves read without error, at any number of samples; a darker reader has its brightness."""
    pyramid = almost_constant(ad)
    effects, _ = material_effects(pyramid.layout)
    held_out, read = HeldOutFootprints(pyramid, effects, 256), reader(pyramid, effects)
    errors = held_out.errors(read)
    assert errors.shape == (5, 2 * len(CASES), 128) and np.sqrt(errors.mean(axis=-1)).max() < 5e-3
    np.testing.assert_allclose(held_out.brightness(read), 1, atol=2e-3)
    darker = lambda *lanes: 0.8 * read(*lanes)  # noqa: E731
    np.testing.assert_allclose(held_out.brightness(darker), 0.8, atol=2e-3)
    # Errors of exposed values: those that are white in both count 0, others a fifth of the truth
    errors = held_out.errors(darker).mean(axis=-1)
    for (*_, weight, truth), by_case in zip(held_out.footprints, errors, strict=True):
        shown = held_out.exposure * numpy_of(truth)
        squared = weight.numpy() * ((np.minimum(0.8 * shown, 1) - np.minimum(shown, 1)) ** 2).mean(axis=1)
        halves = squared.reshape(2, -1).mean(axis=1)
        np.testing.assert_allclose(np.reshape(by_case, (-1, 2)), np.tile(halves, (len(CASES), 1)), rtol=0.05, atol=1e-6)


def test_exposure_makes_a_share_of_the_truth_white(ad):
    for albedo in (20, 200):
        pyramid = almost_constant(ad, albedo=albedo)
        held_out = HeldOutFootprints(pyramid, material_effects(pyramid.layout)[0], 1024)
        halves = [(truth, weight) for *_, weight, truth in held_out.footprints]
        parts = [(numpy_of(truth).mean(axis=1)[:512], weight.numpy()[:512]) for truth, weight in halves]
        values, weights = (np.concatenate(x) for x in zip(*parts, strict=True))
        assert weights[held_out.exposure * values >= 1].sum() / weights.sum() == pytest.approx(0.05, abs=2e-3)


def test_reads_of_a_pixel_with_samples(ad):
    """Samples read at places within the footprint, a level finer for each factor of four; one read at its centre."""
    pyramid = almost_constant(ad)
    held_out = HeldOutFootprints(pyramid, material_effects(pyramid.layout)[0], 64)

    def look(u, v, level, wi, wo):
        return ad.Array3f(level, dr.cos(2 * dr.pi * u), dr.cos(2 * dr.pi * v))

    for level, (u, v, stretch, *_) in enumerate(held_out.footprints):
        centre = np.stack([np.cos(2 * np.pi * x.numpy()) for x in (u, v)], axis=-1)
        for samples in CASES:
            value = numpy_of(held_out._read(look, level, samples))
            if not samples:
                expected, factor = level, 1.0
            else:
                expected = max(0, level - math.log2(math.sqrt(samples)))
                # Mean of a cosine over places along a side
                places = PLACES[samples]
                step = np.pi * 2**level / SIDE / places * np.stack([stretch.numpy(), 1 / stretch.numpy()], axis=-1)
                factor = np.sin(places * step) / (places * np.sin(step))
            np.testing.assert_allclose(value[:, 0], expected, atol=1e-5)
            np.testing.assert_allclose(value[:, 1:], factor * centre, atol=1e-4)


def errors_of(gains, noise=0.0, count=1000):
    """Errors that gain so many dB on levels × cases over errors of 1; half of them are ``noise`` above, half below."""
    gains = np.broadcast_to(gains, (4, 5)).astype(float)
    alternating = 1 + noise * np.where(np.arange(count) % 2, 1, -1)
    return np.ones((4, 5, count)), 10 ** (-gains / 10)[..., None] * alternating


def test_what_gains_and_what_loses():
    """A mean of a level or a case that loses outweighs all gains, unless by chance; so does a single, large loss."""
    gains = np.ones((4, 5))
    assert loss_or_gain(*errors_of(gains)) == pytest.approx((1, 1))
    for axis in (0, 1):  # a level, a case
        at = (2, slice(None)) if axis == 0 else (slice(None), 3)
        for loss, noise, rejected in (
            (0.3, 0, True),
            (0.08, 0, True),
            (0.08, 1, False),
            (0.3, 1, True),
            (-0.1, 0, False),
        ):
            changed = gains.copy()
            changed[at] = -loss
            decided, mean = loss_or_gain(*errors_of(changed, noise))
            assert mean == pytest.approx(changed.mean(), abs=1e-9)
            doubt = min(2 * noise * 10 / math.log(10) / math.sqrt(1000 * changed[at].size), LOSS)
            assert decided == pytest.approx(doubt - loss if rejected else mean, abs=2e-4), (axis, loss, noise)
    for loss, rejected in ((SINGLE + 0.1, True), (SINGLE - 0.1, False)):
        changed = gains.copy()
        changed[1, 4] = -loss
        decided, mean = loss_or_gain(*errors_of(changed))
        assert decided == pytest.approx(-0.1 if rejected else mean)


# -- sensitivities and weights ----------------------------------------------------------------------------------------


def linear(x):
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def numpy_shaded(albedo, xy, roughness, wi, wo):
    """π · BRDF · cosine in NumPy: Burley's formulas in Mitsuba's frame of a normal map, with its shadowing."""
    x, y = (np.full(len(wi), 2 * c - 1) for c in xy)
    n = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=-1)
    n[:, :2] *= np.where((n * wi).sum(axis=1) <= 0, -1, 1)[:, None]
    s = np.array([1.0, 0, 0]) - n * n[:, :1]
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    axes = s, np.cross(n, s), n
    local = [np.stack([(w * axis).sum(axis=1) for axis in axes], axis=-1) for w in (wi, wo)]
    visible = (local[0][:, 2] > 0) & (local[1][:, 2] > 0)
    local = [np.where(visible[:, None], w, [0, 0, 1]) for w in local]
    m = dict.fromkeys(disney_formulas.NAMES, np.zeros(len(wi)))
    m |= {"roughness": np.full(len(wi), roughness), "specular": np.full(len(wi), 0.5)}
    colour = np.broadcast_to(linear(albedo), (len(wi), 3))
    alpha2 = np.minimum(0.125 * (1 - n[:, 2] ** 2) / n[:, 2] ** 2, 1)
    cosine = wo[:, 2]
    shadow = 2 * cosine / (cosine + np.sqrt(cosine**2 + alpha2 * (1 - cosine**2)))
    value = disney_formulas.brdf(colour, m, *local) * (np.pi * shadow * visible * local[1][:, 2])[:, None]
    return np.minimum(value, 1)


def test_sensitivities_against_differences_in_numpy(ad, rng, monkeypatch):
    monkeypatch.setattr(shading, "TRIED", 2**17)
    measured = shading.sensitivities(almost_constant(ad, roughness=0.6), mirrored=0.0)
    wi, wo = uniform(rng, 2**17), uniform(rng, 2**17)
    step, values = shading.DIFFERENCE, (127.5 / 255, (127.5 / 255, 127.5 / 255), 152.5 / 255)
    before = numpy_shaded(*values, wi, wo)
    changed = {
        "albedo": [(values[0] + step, *values[1:])],
        "normal": [
            (values[0], (values[1][0] + step * (i == 0), values[1][1] + step * (i == 1)), values[2]) for i in (0, 1)
        ],
        "roughness": [(*values[:2], values[2] + step)],
    }
    expected = {
        name: np.mean([((numpy_shaded(*v, wi, wo) - before) ** 2).sum(axis=1).mean() for v in variants]) / step**2
        for name, variants in changed.items()
    }
    assert measured == pytest.approx(expected, rel=0.1) and set(measured) == set(expected)


def test_normals_matter_more_on_glossy_materials(ad, monkeypatch):
    monkeypatch.setattr(shading, "TRIED", 2**14)
    measured = [shading.sensitivities(almost_constant(ad, roughness=r)) for r in (0.2, 0.9)]
    glossy, rough = (m["normal"] / m["albedo"] for m in measured)
    assert glossy > 5 * rough


def test_weights_of_maps(ad):
    """Powers of sensitivities with a mean of 1; a map that is not shaded counts as the least of the others."""
    noise = np.random.default_rng(0).integers(0, 256, (8, 8, 4)).astype(np.uint8)
    maps = {"albedo": noise[..., :1], "roughness": noise[..., 1:2], "ao": noise[..., 2:3], "metallic": noise[..., 3:]}
    layout = pyramid_of(ad, maps).layout
    weights = shading.map_weights({"albedo": 1.0, "roughness": 16.0, "metallic": 0.0}, layout, 0.5)
    assert np.mean([*weights.values()]) == pytest.approx(1)
    assert weights["roughness"] / weights["albedo"] == pytest.approx(4)
    assert weights["ao"] == weights["metallic"]
    assert weights["metallic"] / weights["roughness"] == pytest.approx((shading.LEAST_WEIGHT / (16 * 3 / 17)) ** 0.5)


@pytest.mark.parametrize("fine", ["0:1:2,1:2:4", ""])
def test_initial_arrays_of_weighted_channels(ad, rng, fine):
    """Equal weights change nothing; the channel with the largest weight has a smaller error."""
    levels = [rng.random((SIDE, SIDE, 6), np.float32)]
    while len(levels[-1]) > 1:
        n = len(levels[-1]) // 2
        levels.append(levels[-1].reshape(n, 2, n, 2, 6).mean(axis=(1, 3)))
    structure = parse_structure(fine) if fine else ()
    size = TextureBudget(SIDE, SIDE, 6, structure, 2 if fine else 0, 3, 5, 3)
    place = ad.Float(aligned((np.arange(SIDE) + 0.5) / SIDE))
    v, u = dr.meshgrid(place, place, indexing="ij")

    def initial(weights):
        net = from_components(levels, size, ("repeat", "repeat"), weights)
        return net.changed(lambda array, bits: array.alloc(ad.TensorXf))

    def errors(net):
        read = numpy_of(net.filtered(u, v, dr.full(ad.Float, 0, SIDE**2)))
        return ((read - levels[0].reshape(-1, 6)) ** 2).mean(axis=0)

    plain = initial(None)
    for name, array in initial(np.full(6, 3.0)).arrays.items():
        assert np.array_equal(array.data.numpy(), plain.arrays[name].data.numpy())
    weights = np.ones(6)
    weights[4] = 1000
    weighted = errors(initial(weights))
    assert weighted[4] < 0.5 * errors(plain)[4] and weighted[4] == weighted.min()
    assert (weighted < 1.1 * levels[0].var(axis=(0, 1))).all()  # others are near their means at worst


# -- trainings --------------------------------------------------------------------------------------------------------


def bumpy(ad):
    rng = np.random.default_rng(3)
    xy = 0.5 * rng.uniform(-1, 1, (SIDE, SIDE, 2))
    normal = 0.5 + 0.5 * np.concatenate([xy, np.sqrt(1 - (xy**2).sum(axis=-1, keepdims=True))], axis=-1)
    maps = {
        "albedo": rng.random((SIDE, SIDE, 3)),
        "normal": normal,
        "roughness": 0.4 + 0.5 * rng.random((SIDE, SIDE, 1)),
    }
    return pyramid_of(ad, {name: np.rint(255 * values).astype(np.uint8) for name, values in maps.items()})


@pytest.mark.parametrize("jittered", [False, True])
def test_pixels_with_four_samples(ad, monkeypatch, jittered):
    """The loss of each second step is that of the mean of a read in each quarter, a level finer; else of one read."""
    pyramid, drawn = bumpy(ad), {}
    effects, _ = material_effects(pyramid.layout)
    recipe = dataclasses.replace(SHADING_PRESETS["ours"], mirrored=0.0, loss="mae", bounded=False, level_bias=-0.5)
    size = TextureBudget(SIDE, SIDE, pyramid.layout.stored, parse_structure("0:1:2,1:2:4"), 2, 3, 5, 3)
    net = from_components(pyramid.values, size, ("repeat", "repeat"))
    problem = shading.ShadingProblem(net.changed(lambda a, bits: a.alloc(ad.TensorXf)), pyramid, recipe)
    problem.jittered, problem.settings, problem.exposure = jittered, recipe, 1.0

    def keep(name, function):
        def kept(*arguments):
            drawn[name] = arguments, function(*arguments)
            return drawn[name][1]

        monkeypatch.setattr(shading, name, kept)

    keep("random_directions", shading.random_directions)
    keep("places_in_footprints", shading.places_in_footprints)
    keep("reference", lambda *a: dr.zeros(ad.Array3f, dr.width(a[2])))
    errors = problem.shading_errors(pyramid, dr.rng(seed=dr.opaque(ad.UInt64, 5)), 64).numpy()
    _, _, u, v, level, wi, wo, *_ = drawn["reference"][0]
    assert dr.width(u) == (16 if jittered else 64)
    read = reader(pyramid, effects)
    top = float(pyramid.levels - 1)
    if not jittered:
        expected = numpy_of(read(u, v, dr.clip(level - 0.5, 0, top), wi, wo))
        np.testing.assert_allclose(errors, expected.sum(axis=1) / 3, rtol=1e-4, atol=1e-6)
        assert "places_in_footprints" not in drawn
        return
    inside = np.stack([x.numpy().reshape(16, 4) for x in drawn["places_in_footprints"][0][-2:]])
    for places in inside.transpose(1, 2, 0):  # one in each quarter
        assert sorted(map(tuple, np.floor(2 * places).astype(int))) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    total, extent = 0, 2 ** level.numpy().astype(float) / SIDE
    for k in range(4):
        x, y = ((c.numpy() + (inside[i, :, k] - 0.5) * extent) % 1 for i, c in enumerate((u, v)))
        finer = ad.Float(aligned(np.clip(level.numpy() - 1.5, 0, top)))
        total = total + numpy_of(read(ad.Float(aligned(x)), ad.Float(aligned(y)), finer, wi, wo)) / 4
    # Times the number of reads: a step draws as many fewer pixels
    np.testing.assert_allclose(errors, 4 * total.sum(axis=1) / 3, rtol=1e-3, atol=1e-5)


def test_arrays_in_between(ad, rng):
    """Shares of 0 and 1 are both ends, one half is their mean, of all arrays and extras."""
    pyramid = bumpy(ad)
    size = TextureBudget(SIDE, SIDE, pyramid.layout.stored, parse_structure("0:1:2,1:2:4"), 2, 3, 5, 3)

    def ends():
        net = from_components(pyramid.values, size, ("repeat", "repeat"))
        net.extras = neutral_extras(SIDE, SIDE, net.border)
        return net.changed(lambda array, bits: array.alloc(ad.TensorXf))

    first, second = ends(), ends()
    for array in second.arrays.values():
        array.data = ad.TensorXf(aligned(rng.random(array.data.shape)))
    assert "extras" in first.arrays and len(first.arrays) == 5
    for share in (0.0, 0.5, 1.0):
        mixed = shading.between(first, second, share)
        for name, array in mixed.arrays.items():
            a, b = (net.arrays[name].data.numpy() for net in (first, second))
            np.testing.assert_allclose(array.data.numpy(), (1 - share) * a + share * b, atol=1e-6, err_msg=name)
