"""Classical filters of normals: they leave flat surfaces alone, and have the variance of slopes."""

import disney_formulas
import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of
from scipy.ndimage import map_coordinates

from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import from_arrays
from mi_diffind.studies.baselines import normals
from mi_diffind.tasks.texture.appearance import reader
from mi_diffind.tasks.texture.heldout import HeldOutFootprints
from mi_diffind.tasks.texture.surface import material_effects, specular_lobe, surface_of

SIDE = 32
WI, WO = np.array([0.3, 0.1, 0.95]), np.array([-0.2, 0.35, 0.9])


@pytest.fixture
def types(mi_rgb):
    from mi_diffind.core.runtime import array_module

    return array_module(mi_rgb.variant())


def encoded(slopes):
    """Slopes ``(…, 2)`` as a normal map."""
    n = np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1)
    return (0.5 + 0.5 * n / np.linalg.norm(n, axis=-1, keepdims=True)).astype(np.float32)


def material(slopes, roughness=0.4, metallic=None, seed=5):
    """A source with constant roughness and an albedo of noise (none, white, if it is a metal)."""
    shape = slopes.shape[:2]
    albedo = np.random.default_rng(seed).random((*shape, 3)).astype(np.float32)
    maps = {"normal": encoded(slopes), "roughness": np.full(shape, roughness, np.float32)}
    if metallic is not None:
        albedo, maps["metallic"] = np.ones_like(albedo), np.full(shape, metallic, np.float32)
    return from_arrays({"albedo": albedo, **maps})


def prepared(source, types):
    pyramid = Pyramid.from_source(source, types=types, border=("repeat", "repeat"))
    return pyramid, material_effects(pyramid.layout)[0]


def read_lean(pyramid, effects):
    return reader(normals.ReadMaps(normals.lean_pyramid(pyramid)), effects)


def lanes(types, u, v, level, wi=WI, wo=WO):
    wide = [types.Float(aligned(x)) for x in np.broadcast_arrays(u, v, level)]
    ways = []
    for w in (wi, wo):
        w = np.atleast_2d(np.asarray(w, float)).T
        w = np.broadcast_to(w / np.linalg.norm(w, axis=0), (3, dr.width(wide[0])))
        ways.append(types.Array3f([types.Float(aligned(c)) for c in w]))
    return (*wide, *ways)


def test_flat_surfaces(types, rng):
    """All filters leave the filtered parameters of a flat material alone; slopes make each of them differ."""
    place = lanes(types, rng.random(100), rng.random(100), 3)
    for spread in (1e-4, 0.4):
        pyramid, effects = prepared(material(rng.normal(0, spread, (SIDE, SIDE, 2)), metallic=1.0), types)
        expected = numpy_of(reader(pyramid, effects)(*place))
        toksvig = normals.with_roughness(pyramid, normals.toksvig_levels(pyramid))
        for read in (read_lean(pyramid, effects), reader(toksvig, effects)):
            difference = np.abs(numpy_of(read(*place)) - expected).mean()
            assert difference < 1e-3 if spread < 0.1 else difference > 5e-3


def test_toksvig_of_gaussian_slopes(types, rng):
    """Slopes of a small variance σ² along each axis add 2σ² to α²: Beckmann's and Gaussian slopes add up."""
    sigma, alpha = 0.02, 0.1
    n = 2 * encoded(rng.normal(0, sigma, (10**6, 2))).astype(float) - 1
    length = np.linalg.norm(n.mean(axis=0))
    assert normals.toksvig_alpha2(alpha**2, length) - alpha**2 == pytest.approx(2 * sigma**2, rel=0.05)
    assert normals.toksvig_alpha2(alpha**2, 1.0) == pytest.approx(alpha**2)
    assert normals.toksvig_alpha2(alpha**2, 0.5) > normals.toksvig_alpha2(alpha**2, 0.9) > alpha**2


def test_slopes_about_a_tilted_normal(rng):
    """The covariance in the frame of a tilted normal, against that of slopes that are measured in it."""
    mean, spread = np.array([0.5, -0.3]), np.array([[0.03, 0.0], [0.012, 0.02]])
    slopes = mean + rng.normal(size=(10**5, 2)) @ spread.T
    n = np.array([*mean, 1]) / np.linalg.norm([*mean, 1])
    s = np.array([1, 0, 0]) - n * n[0]
    s /= np.linalg.norm(s)
    facets = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    local = facets @ np.stack([s, np.cross(n, s), n]).T
    values, vectors = np.linalg.eigh(np.cov((local[:, :2] / local[:, 2:]).T))
    covariance = (spread @ spread.T)[[0, 1, 0], [0, 1, 1]]
    roughness, (c, s) = normals.lobe(covariance, 0.0, n)
    across_along, axes = np.linalg.eigh(roughness**4 * np.array([[1 + c, s], [s, 1 - c]]))
    assert across_along / 2 == pytest.approx(values, rel=0.05)
    assert abs(axes[:, 1] @ vectors[:, 1]) == pytest.approx(1, abs=5e-3)


@pytest.mark.parametrize("sigmas", [(0.1, 0.1), (0.2, 0.02)])
def test_lean_is_the_mean_of_what_it_filters(types, rng, sigmas):
    """Brute force in NumPy: facets of a rough metal with Gaussian slopes, interpolated, each shaded in its own frame,
    averaged. A GGX lobe under Gaussian slopes is no GGX lobe, so only nearly: filtered parameters err twice as much.
    """
    alpha, side = 0.2, 64
    slopes = rng.normal(size=(side, side, 2)) * sigmas
    source = material(slopes, np.sqrt(alpha), metallic=1.0)
    pyramid, effects = prepared(source, types)
    # Lights in the plane of x around the mirrored direction: the profile of the highlight
    wi = np.array([np.sin(0.3), 0, np.cos(0.3)])
    angles = np.linspace(-0.8, 0.2, 21)
    wo = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
    places = np.meshgrid(*[(np.arange(4 * side) + 0.5) / 4 - 0.5] * 2, indexing="ij")
    texels = 2.0 * encoded(slopes) - 1
    n = [map_coordinates(texels[..., c], places, order=1, mode="grid-wrap").ravel() for c in range(3)]
    n = np.stack(n, axis=-1) / np.linalg.norm(n, axis=0)[:, None]
    s = np.array([1.0, 0, 0]) - n * n[:, :1]
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    t = np.cross(n, s)
    m = dict.fromkeys(disney_formulas.NAMES, np.zeros(len(n))) | {
        "metallic": np.ones(len(n)), "roughness": np.full(len(n), np.sqrt(alpha)),
    }  # fmt: skip
    expected = []
    for o in wo:
        local = [np.stack([s @ w, t @ w, n @ w], axis=-1) for w in (wi, o)]
        expected.append(np.pi * np.mean(disney_formulas.brdf(np.ones_like(n), m, *local)[:, 0] * local[1][:, 2]))
    place = lanes(types, np.full(len(wo), 0.5), 0.5, 6, wi, wo)
    found = numpy_of(read_lean(pyramid, effects)(*place))[:, 0]
    plain = numpy_of(reader(pyramid, effects)(*place))[:, 0]
    error, without = (np.abs(x - expected).mean() / np.mean(expected) for x in (found, plain))
    assert error < 0.1 and error < 0.5 * without


def test_baked_roughness(types, rng):
    """A flat surface keeps its roughness, as level 0 does; slopes make it larger on coarser levels."""
    flat = material(rng.normal(0, 1e-3, (16, 16, 2)), 0.42, metallic=1.0)
    pyramid, effects = prepared(flat, types)
    for level in normals.bake(pyramid, effects, 4):
        np.testing.assert_allclose(level, 0.42, atol=0.01)
    rough = material(rng.normal(0, 0.15, (16, 16, 2)), 0.42, metallic=1.0)
    pyramid, effects = prepared(rough, types)
    means = [level.mean() for level in normals.bake(pyramid, effects, 16)]
    assert means[0] == pytest.approx(0.42, abs=1e-5) and 0.425 < means[1] < means[3] < 0.6


def test_a_bias_that_is_known_is_chosen(types, rng):
    """A reader that is a quarter of a level off needs biases that are a quarter less, but on level 0."""
    pyramid, effects = prepared(material(rng.normal(0, 0.02, (32, 32, 2))), types)
    footprints = HeldOutFootprints(pyramid, effects, 256)
    own = normals.choose_biases(pyramid, effects, footprints)
    shifted = normals.choose_biases(normals.ReadMaps(pyramid, [0.25]), effects, footprints)
    assert set(own) <= set(normals.BIASES)
    assert shifted[1:] == [bias - 0.25 for bias in own[1:]]


def test_moments_of_the_interpolated_surface(types, rng):
    """Moments of level 0, against many samples of the normals that the unfiltered read of a pyramid returns."""
    pyramid, _ = prepared(material(rng.normal(0, 0.3, (8, 8, 2))), types)
    found, fine = normals.surface_moments(pyramid), 16
    x = (np.arange(8 * fine) + 0.5) / (8 * fine)
    v, u = (types.Float(a.ravel().astype(np.float32)) for a in np.meshgrid(x, x, indexing="ij"))
    read = numpy_of(surface_of(pyramid, pyramid.stored(u, v)).normal).reshape(8, fine, 8, fine, 3)
    read /= np.linalg.norm(read, axis=-1, keepdims=True)
    b = read[..., :2] / read[..., 2:]
    expected = np.concatenate([b, b**2, b[..., :1] * b[..., 1:]], axis=-1).mean(axis=(1, 3))
    np.testing.assert_allclose(found[0][..., :5], expected, atol=0.015)
    np.testing.assert_allclose(found[0][..., 5], 0.4**4, rtol=1e-4)
    np.testing.assert_allclose(found[0][..., 6:], read.mean(axis=(1, 3)), atol=0.015)
    np.testing.assert_allclose(found[3][0, 0], found[0].mean(axis=(0, 1)), rtol=1e-9)


def test_mean_cosine(types, rng):
    """LEAN has the mean of the cosines of a surface that hardly reflects but diffusely, lit from above."""
    pyramid, effects = prepared(material(rng.normal(0, 0.3, (64, 64, 2)), 0.9), types)
    mean = normals.surface_moments(pyramid)[0][..., 8].mean()
    place = lanes(types, [0.5], 0.5, 6, [0, 0, 1], [0, 0, 1])
    lean, plain = (numpy_of(read(*place))[0] for read in (read_lean(pyramid, effects), reader(pyramid, effects)))
    assert lean / plain == pytest.approx(mean, rel=0.02) and mean < 0.97


def test_other_maps_of_a_pyramid(types, rng):
    """Maps that are kept, changed or new read as their levels say; albedo is averaged as linear values."""
    pyramid, _ = prepared(material(rng.normal(0, 0.3, (16, 16, 2)), metallic=0.5), types)
    levels = {
        "albedo": [rng.random((16 >> i, 16 >> i, 3)) for i in range(5)],
        "normal": [encoded(rng.normal(0, 0.3, (16 >> i, 16 >> i, 2))) for i in range(5)],
        "lobe": [rng.random((16 >> i, 16 >> i, 2)) for i in range(5)],
    }
    changed = normals.with_maps(pyramid, levels)
    for level in range(5):
        decoded, before = changed.decode(level=level), pyramid.decode(level=level)
        for name, values in levels.items():
            np.testing.assert_allclose(decoded[name], values[level], atol=2e-3)
        for name in ("roughness", "metallic"):
            np.testing.assert_allclose(decoded[name], before[name], atol=1e-6)


def test_lobes_of_grooves(types, rng):
    """Slopes along u alone widen the highlight along u alone; the shape has the form of extras."""
    slopes = np.zeros((32, 32, 2))
    slopes[..., 0] = rng.normal(0, 0.2, (1, 32))
    pyramid, _ = prepared(material(slopes, 0.4, metallic=1.0), types)
    maps = normals.ReadMaps(normals.lean_pyramid(pyramid))
    u, v, level, *_ = lanes(types, [0.5], 0.5, 5)
    shape = specular_lobe(maps.extra(u, v, level))
    bx, _, bxx, *_ = normals.surface_moments(pyramid)[5][0, 0]
    variance, alpha2 = bxx - bx**2, 0.4**4
    assert shape.c[0] == pytest.approx(variance / (variance + alpha2), rel=0.03) and abs(shape.s[0]) < 1e-2
    assert maps.decode(["roughness"], level=5)["roughness"].item() ** 4 == pytest.approx(variance + alpha2, rel=0.03)
