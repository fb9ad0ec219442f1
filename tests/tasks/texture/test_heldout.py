"""What decides in the training for shading: held-out footprints, gains and losses; and what that training begins with.

Sensitivities and weights of maps, reads of pixels with four samples, and arrays in between.
"""

import dataclasses
import functools
import math

import disney_formulas
import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of
from bsdf_queries import random_directions
from texture_files import bumpy, pyramid_of
from texture_scenes import linear

from mi_diffind.core.runtime import array_module
from mi_diffind.tasks.texture import SHADING_PRESETS, parse_structure, shading
from mi_diffind.tasks.texture.appearance import reader
from mi_diffind.tasks.texture.arrays import TextureBudget, from_components
from mi_diffind.tasks.texture.compressed import neutral_extras
from mi_diffind.tasks.texture.heldout import (
    ALPHAS,
    CASES,
    CURVED,
    LIGHTS,
    LOSS,
    PLACES,
    RANGES,
    SINGLE,
    SKY,
    STRETCH,
    HeldOutFootprints,
    loss_or_gain,
    mirrored_pairs,
    relative_weights,
    sky_weight,
    stretched_views,
    under_skies,
)
from mi_diffind.tasks.texture.surface import material_effects

SIDE = 16


@pytest.fixture(scope="module")
def ad():
    return array_module("llvm")


def almost_constant(ad, roughness=0.7, albedo=128, seed=0):
    """A flat material without metal, whose maps vary by one step of a byte."""
    rng = np.random.default_rng(seed)

    def bytes_near(value, channels):
        return (value - rng.integers(0, 2, (SIDE, SIDE, channels))).astype(np.uint8)

    normal = np.concatenate([bytes_near(128, 2), np.full((SIDE, SIDE, 1), 255, np.uint8)], axis=-1)
    maps = {"albedo": bytes_near(albedo, 3), "normal": normal, "roughness": bytes_near(255 * roughness, 1)}
    return pyramid_of(maps, ad)[1]


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
    plain = highlight(random_directions(rng, 4 * n), random_directions(rng, 4 * n))
    error = np.hypot(mirrored.std() / np.sqrt(n), plain.std() / np.sqrt(4 * n))
    assert abs(mirrored.mean() - plain.mean()) < 4 * error


def test_lights_of_a_sky(ad, rng):
    """Lanes of a block share places and views; the means of their lights are nearer to those of the hemisphere."""
    n = 2**12
    numbers = [ad.Float(aligned(x)) for x in rng.random((9, n), dtype=np.float32)]
    lane = dr.arange(ad.UInt32, n)
    *shared, c, d, e = under_skies(ad, lane < n // 2, numbers)
    for before, after in zip(numbers, (*shared, c, d, e), strict=True):
        assert np.array_equal(before.numpy()[n // 2 :], after.numpy()[n // 2 :])
    for x in shared:
        blocks = x.numpy()[: n // 2].reshape(-1, SKY)
        assert (blocks == blocks[:, :1]).all()
    _, wo, weight = mirrored_pairs(ad, [*shared[-2:], c, d, e])
    assert (weight.numpy()[: n // 2] == 1).all()
    means = np.split(numpy_of(wo).reshape(-1, SKY, 3).mean(axis=1), 2)[0]
    assert np.abs(means.mean(axis=0) - [0, 0, 0.5]).max() < 0.02
    assert (means.std(axis=0) < 0.5 * np.sqrt(np.array([1 / 3, 1 / 3, 1 / 12]) / SKY)).all()


# -- held-out footprints ----------------------------------------------------------------------------------------------


def groups_of(x, count):
    """Values of pairs, ``(pairs, …)``, as ``(lights, ranges, count, …)``."""
    return x.reshape(LIGHTS, RANGES, count, *x.shape[1:])


def test_errors_of_a_constant_material(ad):
    """The maps themselves read without error, at any number of samples; a darker reader errs as it should."""
    pyramid = almost_constant(ad)
    effects, _ = material_effects(pyramid.layout)
    held_out, read = HeldOutFootprints(pyramid, effects, 128), reader(pyramid, effects)
    errors = held_out.errors(read)
    assert len(errors) == len(CASES)
    for single, of_sky in errors:
        assert single.shape == (5, 2 * RANGES, 128) and of_sky.shape == (5, RANGES, 128 // SKY)
        assert all(np.sqrt(x.mean(axis=-1)).max() < 1e-2 for x in (single, of_sky))
    assert (held_out.psnr(read) > 55).all()
    darker = lambda *lanes: 0.8 * read(*lanes)  # noqa: E731
    # Errors of exposed values: those that are white in both count 0, others a fifth of the truth
    errors, total = held_out.errors(darker), np.zeros((5, 3 * RANGES))
    for level, (*_, weight, truth) in enumerate(held_out.footprints):
        lit = groups_of(weight.numpy()[:, None] * numpy_of(truth), 128)
        values = [lit[:2].reshape(2 * RANGES, 128, 3), lit[2].reshape(RANGES, 128 // SKY, SKY, 3).mean(axis=2)]
        exposures = np.repeat(held_out.exposures, RANGES)[:, None, None]
        shown = [exposures[: 2 * RANGES] * values[0], exposures[2 * RANGES :] * values[1]]
        expected = [((np.minimum(0.8 * x, 1) - np.minimum(x, 1)) ** 2).mean(axis=(-2, -1)) for x in shown]
        for case in errors:
            for found, mean in zip(case, expected, strict=True):
                np.testing.assert_allclose(found[level].mean(axis=-1), mean, rtol=0.05, atol=1e-6)
        total[level] = np.hstack(expected)
    np.testing.assert_allclose(held_out.psnr(darker), -10 * np.log10(total).mean(axis=1), atol=0.1)
    expected = max(np.mean(total[:, : 2 * RANGES]) / np.mean(total[:, 2 * RANGES :]), 1)
    assert sky_weight(errors) == pytest.approx(expected, rel=0.05)


def test_views_of_stretched_footprints(ad, rng):
    """A flat surface that is seen at the aspect of the footprint, along its longer side; a quarter is uniform."""
    n = 2**14
    drawn = rng.random((3, n), dtype=np.float32)
    stretch, *views = stretched_views(ad, *(ad.Float(aligned(x)) for x in drawn))
    wi = numpy_of(
        mirrored_pairs(ad, [*views, *[ad.Float(aligned(x)) for x in rng.random((3, n), dtype=np.float32)]])[0]
    )
    flat, s = drawn[1] >= CURVED, stretch.numpy()
    np.testing.assert_allclose(np.log2(s), (drawn[0] - 0.5) * 2 * STRETCH, atol=1e-4)
    np.testing.assert_allclose(wi[flat, 2], np.minimum(s**2, s**-2)[flat], atol=1e-4)
    longer = np.where(s > 1, np.abs(wi[:, 0]), np.abs(wi[:, 1]))
    assert (longer >= math.sqrt(0.499) * np.hypot(wi[:, 0], wi[:, 1]) - 1e-5)[flat].all()
    for axis in (0, 1):  # from both sides
        assert abs(np.mean(wi[flat, axis] > 0) - 0.5) < 0.02
    assert abs(wi[~flat, 2].mean() - 0.5) < 0.02 and abs((longer**2)[~flat].mean() - 1 / 3) < 0.02


def test_groups_of_footprints(ad):
    """Stretches of a group lie in its range, levels between two whole ones; pixels of a sky share all but the light."""
    pyramid, n = almost_constant(ad), 64
    for level, footprint in enumerate(HeldOutFootprints(pyramid, material_effects(pyramid.layout)[0], n).footprints):
        at, stretch = (groups_of(footprint[i].numpy(), n) for i in (2, 3))
        assert at.min() >= level and at.max() <= level + 1 and at.std() > 0.2
        ranges = np.log2(stretch) / (2 * STRETCH) + 0.5
        assert (np.floor(ranges * RANGES).clip(0, RANGES - 1) == np.arange(RANGES)[:, None]).mean() > 0.999
        assert ranges.min() < 0.05 and ranges.max() > 0.95
        for x in (*footprint[:4], footprint[4].x):
            blocks = groups_of(x.numpy(), n)[-1].reshape(-1, SKY)
            assert (blocks == blocks[:, :1]).all() and len(np.unique(blocks)) > len(blocks) // 2


def test_exposure_makes_a_share_of_the_truth_white(ad):
    for albedo in (20, 200):
        pyramid, n = almost_constant(ad, albedo=albedo), 512
        held_out = HeldOutFootprints(pyramid, material_effects(pyramid.layout)[0], n)
        for kind, exposure in enumerate(held_out.exposures):
            pairs = [(numpy_of(truth).mean(axis=1), weight.numpy()) for *_, weight, truth in held_out.footprints]
            values, weights = (
                np.concatenate([groups_of(x, n)[kind].ravel() for x in y]) for y in zip(*pairs, strict=True)
            )
            if kind == LIGHTS - 1:
                values, weights = (x.reshape(-1, SKY).mean(axis=1) for x in (values, weights))
            assert weights[exposure * values >= 1].sum() / weights.sum() == pytest.approx(0.05, abs=2e-3)


def test_reads_of_a_pixel_with_samples(ad):
    """Samples read at places within the footprint, a level finer for each factor of four; one read at its centre."""
    pyramid = almost_constant(ad)
    held_out, shares = HeldOutFootprints(pyramid, material_effects(pyramid.layout)[0], 64), []

    def look(u, v, level, wi, wo, share):
        shares.append(share.numpy().ravel())
        return ad.Array3f(level, dr.cos(2 * dr.pi * u), dr.cos(2 * dr.pi * v))

    for footprint in held_out.footprints:
        u, v, level, stretch = (x.numpy() for x in footprint[:4])
        centre = np.stack([np.cos(2 * np.pi * x) for x in (u, v)], axis=-1)
        for samples in CASES:
            reads = numpy_of(held_out._reads(look, footprint, samples))
            value = reads.reshape(len(level), -1, 3).mean(axis=1)
            if not samples:
                expected, factor = level, 1.0
            else:
                expected = np.maximum(0, level - math.log2(math.sqrt(samples)))
                # Mean of a cosine over places along a side
                places = PLACES[samples]
                step = np.pi * 2 ** level[:, None] / SIDE / places * np.stack([stretch, 1 / stretch], axis=-1)
                factor = np.sin(places * step) / (places * np.sin(step))
            np.testing.assert_allclose(value[:, 0], expected, atol=1e-5)
            np.testing.assert_allclose(value[:, 1:], factor * centre, atol=2e-4)
            # Share of a level bias that counts: squared, area over half of the squared sides
            share = (2 / (stretch**2 + stretch**-2)) ** 2
            repeated = np.repeat(share, PLACES[samples] ** 2 if samples else 1)
            np.testing.assert_allclose(shares[-1], repeated, rtol=1e-4, atol=1e-6)


def test_noise_of_a_single_render(ad):
    """The variance of reads at places, over the number of samples, is added to the squared error of their mean."""
    pyramid, n = almost_constant(ad), 64
    held_out = HeldOutFootprints(pyramid, material_effects(pyramid.layout)[0], n)
    held_out.exposures = [1.0] * LIGHTS

    def look(u, v, level, wi, wo, share):
        return ad.Array3f(0.3 + 0.2 * dr.cos(2 * dr.pi * u))

    mean, single = (held_out.errors(look, noise) for noise in (False, True))
    for level, footprint in enumerate(held_out.footprints):
        u, stretch, lit = (groups_of(footprint[i].numpy(), n)[:-1].reshape(-1, n) for i in (0, 3, 6))
        for case, samples in enumerate(CASES):
            variance = 0 * u
            if samples:
                step = np.pi * 2.0 ** groups_of(footprint[2].numpy(), n)[:-1].reshape(-1, n) / SIDE
                step *= stretch / PLACES[samples]
                once, twice = (
                    np.sin(PLACES[samples] * k * step) / (PLACES[samples] * np.sin(k * step)) for k in (1, 2)
                )
                variance = 0.04 * (0.5 + 0.5 * twice * np.cos(4 * np.pi * u) - (once * np.cos(2 * np.pi * u)) ** 2)
            expected = lit * variance / max(samples, 1)
            np.testing.assert_allclose(single[case][0][level] - mean[case][0][level], expected, atol=2e-6)


def errors_of(gains, noise=0.0, count=1000):
    """Errors that gain so many dB over errors of 1; half of them are ``noise`` above, half below.

    Gains are of levels × cases × lights × ranges. There are as many pixels of skies as of single lights.
    """
    gains = np.broadcast_to(gains, (5, len(CASES), LIGHTS, RANGES)).astype(float)
    alternating = 1 + noise * np.where(np.arange(count) % 2, 1, -1)
    errors = 10 ** (-gains / 10)[..., None] * alternating

    def split(x):
        return [[x[:, i, :2].reshape(5, 2 * RANGES, count), x[:, i, 2]] for i in range(len(CASES))]

    return split(np.ones_like(errors)), split(errors)


@pytest.mark.parametrize(
    "at",
    [(2,), (slice(None), 3, 1, 2), (1, 2, slice(None), 0)],
    ids=["a level", "a case and group", "a level, case and range"],
)
def test_what_gains_and_what_loses(at):
    """A mean that loses outweighs all gains, unless by chance."""
    single = len(at) == 4 and at[0] == 1
    gains = np.ones((5, len(CASES), LIGHTS, RANGES))
    least, scale = SINGLE if single else LOSS, 10 / math.log(10) / math.sqrt(1000 * gains[at].size)
    # A noise whose standard errors, one or two, are twice what is no loss
    noise = 2 * least / scale / (2 if single else 1)
    for loss, noisy, rejected in ((least + 0.02, 0, True), (least - 0.02, 0, False), (1.9 * least, noise, False),
                                  (2.1 * least, noise, True), (-0.1, 0, False)):  # fmt: skip
        gains[at] = -loss
        decided, mean = loss_or_gain(*errors_of(gains, noisy))
        assert mean == pytest.approx(gains.mean(), abs=1e-9)
        none = 2 * least if noisy else least
        assert decided == pytest.approx(none - loss if rejected else mean, abs=1e-3), (loss, noisy)


# -- sensitivities and weights ----------------------------------------------------------------------------------------


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
    monkeypatch.setattr(shading, "mirrored_pairs", functools.partial(mirrored_pairs, share=0.0))
    measured = shading.sensitivities(almost_constant(ad, roughness=0.6), skies=0.0)
    wi, wo = random_directions(rng, 2**17), random_directions(rng, 2**17)
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


def test_albedo_matters_more_under_skies(ad, monkeypatch):
    """Errors of normals average out over the lights of a sky, those of colours do not."""
    monkeypatch.setattr(shading, "TRIED", 2**15)
    material = almost_constant(ad, roughness=0.4)
    single, both = (shading.sensitivities(material, skies=skies) for skies in (0.0, 20.0))
    assert both["albedo"] / both["normal"] > 2 * single["albedo"] / single["normal"]


def test_weights_of_maps(ad):
    """Powers of sensitivities with a mean of 1; a map that is not shaded counts as the least of the others."""
    noise = np.random.default_rng(0).integers(0, 256, (8, 8, 4)).astype(np.uint8)
    maps = {"albedo": noise[..., :1], "roughness": noise[..., 1:2], "ao": noise[..., 2:3], "metallic": noise[..., 3:]}
    layout = pyramid_of(maps, ad)[1].layout
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


def test_relative_weights():
    """Weighted errors of the start are equal by level and light, and their mean over the drawn pairs is unchanged."""
    rng = np.random.default_rng(2)
    base = [
        [scale * rng.random((3, 2 * RANGES, 50)), 9 * scale * rng.random((3, RANGES, 8))] for scale in (1, 2, 0.1, 4)
    ]
    weights = relative_weights(base, (0.5, 0.2, 0.3), 0.6)
    means = [np.hstack([x.mean(axis=-1) for x in base[i]]).reshape(3, 3, RANGES).mean(axis=-1) for i in (0, 2)]
    weighted = weights * means
    np.testing.assert_allclose(weighted, weighted[0, 0, 0])
    shares = 0.6 ** np.arange(3)[:, None] * (0.5, 0.2, 0.3)
    np.testing.assert_allclose((shares * weighted).sum(), (shares * means).sum())


@pytest.mark.parametrize("jittered", [False, True])
def test_pixels_with_four_samples(ad, monkeypatch, jittered):
    """The loss of each second step is that of the mean of a read in each quarter, a level finer; else of one read.

    Half of the pairs are of skies: the mean of their lights counts. Weights and exposures are those of level and light.
    """
    (_, pyramid), drawn = pyramid_of(bumpy(SIDE, 0.0, 0.65), ad), {}
    effects, _ = material_effects(pyramid.layout)
    changed = {"mirrored": 0.0, "skies": 0.5, "loss": "mae", "bounded": False, "level_bias": -0.5}
    recipe = dataclasses.replace(SHADING_PRESETS["ours"], **changed)
    size = TextureBudget(SIDE, SIDE, pyramid.layout.stored, parse_structure("0:1:2,1:2:4"), 2, 3, 5, 3)
    net = from_components(pyramid.values, size, ("repeat", "repeat"))
    problem = shading.ShadingProblem(net.changed(lambda a, bits: a.alloc(ad.TensorXf)), pyramid, recipe)
    problem.jittered, problem.settings, problem.exposures = jittered, recipe, ad.Float(2, 5, 3)
    weights = np.arange(12.0).reshape(2, 2, 3) + 1  # level 1 and coarser
    problem.error_weights = [ad.Float(aligned(w.ravel())) for w in weights]

    def keep(name, function):
        def kept(*arguments, **named):
            drawn[name] = [*arguments, *named.values()]
            return function(*arguments)

        monkeypatch.setattr(shading, name, kept)

    keep("places_in_footprints", shading.places_in_footprints)
    keep("reference", lambda *a: dr.zeros(ad.Array3f, dr.width(a[2])))
    errors = problem.shading_errors(pyramid, dr.rng(seed=dr.opaque(ad.UInt64, 5)), 64).numpy()
    _, _, u, v, level, wi, wo, _, _, stretch = drawn["reference"]
    pixels = dr.width(u)
    assert pixels == (16 if jittered else 64) and np.abs(np.log2(stretch.numpy())).max() > STRETCH / 2
    read = reader(pyramid, effects)
    top, bias = float(pyramid.levels - 1), -0.5 * (2 / (stretch.numpy() ** 2 + stretch.numpy() ** -2)) ** 2
    if not jittered:
        total = numpy_of(read(u, v, ad.Float(aligned(np.clip(level.numpy() + bias, 0, top))), wi, wo))
        assert "places_in_footprints" not in drawn
    else:
        inside = np.stack([x.numpy().reshape(16, 4) for x in drawn["places_in_footprints"][-3:-1]])
        for places in inside.transpose(1, 2, 0):  # one in each quarter
            assert sorted(map(tuple, np.floor(2 * places).astype(int))) == [(0, 0), (0, 1), (1, 0), (1, 1)]
        total, extent = 0, 2 ** level.numpy().astype(float) / SIDE
        sides = extent * stretch.numpy(), extent / stretch.numpy()
        for k in range(4):
            x, y = ((c.numpy() + (inside[i, :, k] - 0.5) * sides[i]) % 1 for i, c in enumerate((u, v)))
            finer = ad.Float(aligned(np.clip(level.numpy() - 1 + bias, 0, top)))
            total = total + numpy_of(read(ad.Float(aligned(x)), ad.Float(aligned(y)), finer, wi, wo)) / 4
    sky, single = np.split(total, 2)
    sky = np.repeat(sky.reshape(-1, SKY, 3).mean(axis=1), SKY, axis=0)
    expected = np.concatenate([3 * sky, 2 * single]).sum(axis=1) / 3
    lights = np.where(np.arange(pixels) < pixels // 2, 2, 0)
    expected *= weights[int(jittered), np.minimum(level.numpy().astype(int), 1), lights]
    # Times the number of reads: a step draws as many fewer pixels
    np.testing.assert_allclose(errors, (4 if jittered else 1) * expected, rtol=2e-3, atol=2e-5)


def test_arrays_in_between(ad, rng):
    """Shares of 0 and 1 are both ends, one half is their mean, of all arrays and extras."""
    _, pyramid = pyramid_of(bumpy(SIDE, 0.0, 0.65), ad)
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
