"""Classical filters of normals: they leave alone what is flat or not filtered, and have the right variance."""

import disney_formulas
import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of

from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import from_arrays
from mi_diffind.studies.baselines import normals
from mi_diffind.tasks.disney.model import Material
from mi_diffind.tasks.shading.evaluation import reader
from mi_diffind.tasks.shading.material import material_effects, surface_of

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


def lanes(types, u, v, level, wi=WI, wo=WO):
    wide = [types.Float(aligned(x)) for x in np.broadcast_arrays(u, v, level)]
    ways = []
    for w in (wi, wo):
        w = np.atleast_2d(np.asarray(w, float)).T
        w = np.broadcast_to(w / np.linalg.norm(w, axis=0), (3, dr.width(wide[0])))
        ways.append(types.Array3f([types.Float(aligned(c)) for c in w]))
    return (*wide, *ways)


def test_level_0_is_the_material(types, rng):
    """At texel centres, where nothing is averaged."""
    source = material(rng.normal(0, 0.4, (SIDE, SIDE, 2)))
    pyramid, effects = prepared(source, types)
    centres = [(rng.integers(0, SIDE, 200) + 0.5) / SIDE for _ in range(2)]
    place = lanes(types, *centres, 0)
    expected = numpy_of(normals.reader(pyramid, effects)(*place))
    for make in (normals.toksvig, normals.lean):
        np.testing.assert_allclose(numpy_of(make(source, pyramid, effects)(*place)), expected, rtol=3e-3, atol=1e-4)
    coarse = lanes(types, *centres, 3)
    expected = numpy_of(normals.reader(pyramid, effects)(*coarse))
    for make in (normals.toksvig, normals.lean):
        assert np.abs(numpy_of(make(source, pyramid, effects)(*coarse)) - expected).mean() > 0.005


def test_toksvig_of_gaussian_slopes(types, rng):
    """Slopes of a small variance σ² along each axis add 2σ² to α²: Beckmann's and Gaussian slopes add up."""
    sigma, alpha = 0.02, 0.1
    n = 2 * encoded(rng.normal(0, sigma, (10**6, 2))).astype(float) - 1
    length = np.linalg.norm(n.mean(axis=0))
    assert normals.toksvig_alpha2(alpha**2, length) - alpha**2 == pytest.approx(2 * sigma**2, rel=0.05)
    assert normals.toksvig_alpha2(alpha**2, 1.0) == pytest.approx(alpha**2)
    assert normals.toksvig_alpha2(alpha**2, 0.5) > normals.toksvig_alpha2(alpha**2, 0.9) > alpha**2


@pytest.mark.parametrize("angle", [0.0, 0.5, -1.2])
def test_lobe_of_slopes_along_one_direction(types, angle):
    """Slopes that vary along one direction make a lobe that is wide along it, and as it was across."""
    variance, alpha = 0.04, 0.25
    c, s = np.cos(angle), np.sin(angle)
    one = types.Float(1)
    covariance = [types.Float(variance * x) for x in (c * c, s * s, c * s)]
    axes = [types.Array3f(*map(float, row)) for row in np.eye(3)]
    ax, ay, s_axis, t_axis = normals.lobe(covariance, alpha**2 * one, *axes)
    assert ax[0] == pytest.approx(np.sqrt(alpha**2 + 2 * variance), rel=1e-4)
    assert ay[0] == pytest.approx(alpha, rel=1e-4)
    found = numpy_of([s_axis.x, s_axis.y, s_axis.z])[0]
    assert abs(found @ [c, s, 0]) == pytest.approx(1, abs=1e-4)
    assert numpy_of(dr.cross(s_axis, t_axis))[0] @ [0, 0, 1] == pytest.approx(1, abs=1e-4)


def test_slopes_about_a_tilted_normal(types, rng):
    """The covariance in the frame of a tilted normal, against that of slopes that are measured in it."""
    mean, spread = np.array([0.5, -0.3]), np.array([[0.03, 0.0], [0.012, 0.02]])
    slopes = mean + rng.normal(size=(10**5, 2)) @ spread.T
    n = np.array([*mean, 1]) / np.linalg.norm([*mean, 1])
    s = np.array([1, 0, 0]) - n * n[0]
    s /= np.linalg.norm(s)
    t = np.cross(n, s)
    facets = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
    local = facets @ np.stack([s, t, n]).T
    expected = np.cov((local[:, :2] / local[:, 2:]).T)
    a, b, c = (spread @ spread.T)[[0, 1, 0], [0, 1, 1]]
    axes = [types.Array3f(*map(float, w)) for w in (s, t, n)]
    ax, ay, s_axis, _ = normals.lobe([types.Float(float(x)) for x in (a, b, c)], types.Float(0), *axes)
    large = np.linalg.eigvalsh(expected)[::-1]
    assert [ax[0] ** 2 / 2, ay[0] ** 2 / 2] == pytest.approx(list(large), rel=0.05)
    direction = np.linalg.eigh(expected)[1][:, 1]
    world = direction[0] * s + direction[1] * t
    assert abs(numpy_of([s_axis.x, s_axis.y, s_axis.z])[0] @ world) == pytest.approx(1, abs=5e-3)


def test_specular_lobe(types, rng):
    """The anisotropic lobe alone, against Burley's formulas in NumPy, of a metal that has no other."""
    count, anisotropic, roughness = 300, 0.7, 0.45
    wi, wo = rng.normal(size=(2, count, 3))
    for w in (wi, wo):
        w[:, 2] = np.abs(w[:, 2]) + 0.05
        w /= np.linalg.norm(w, axis=1, keepdims=True)
    m = dict.fromkeys(disney_formulas.NAMES, np.zeros(count)) | {
        "metallic": np.ones(count), "roughness": np.full(count, roughness), "anisotropic": np.full(count, anisotropic),
    }  # fmt: skip
    colour = np.tile([0.9, 0.5, 0.2], (count, 1))
    expected = disney_formulas.brdf(colour, m, wi, wo) * wo[:, 2:]
    aspect = np.sqrt(1 - 0.9 * anisotropic)
    given = Material(**{name: types.Float(m[name].astype(np.float32)) for name in disney_formulas.NAMES})
    _, _, _, a, b = lanes(types, np.zeros(count), 0, 0, wi, wo)
    _, effects = prepared(material(np.zeros((4, 4, 2)), metallic=1.0), types)
    albedo = types.Array3f([types.Float(c.astype(np.float32)) for c in colour.T])
    alphas = [types.Float(x) for x in (roughness**2 / aspect, roughness**2 * aspect)]
    found = numpy_of(normals.specular(given, albedo, *alphas, a, b, effects))
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("sigmas", [(0.1, 0.1), (0.2, 0.02)])
def test_lean_is_the_mean_of_what_it_filters(types, rng, sigmas):
    """
    Brute force in NumPy: facets of a rough metal with Gaussian slopes, each shaded in its own frame, averaged. A GGX
    lobe under Gaussian slopes is no GGX lobe, so only nearly: what filtered parameters get wrong by half.
    """
    alpha, side = 0.2, 128
    slopes = rng.normal(size=(side, side, 2)) * sigmas
    source = material(slopes, np.sqrt(alpha), metallic=1.0)
    pyramid, effects = prepared(source, types)
    # Lights in the plane of x around the mirrored direction: the profile of the highlight
    wi = np.array([np.sin(0.3), 0, np.cos(0.3)])
    angles = np.linspace(-0.8, 0.2, 21)
    wo = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
    n = (2 * encoded(slopes).reshape(-1, 3) - 1).astype(float)
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
    place = lanes(types, np.full(len(wo), 0.5), 0.5, 7, wi, wo)
    found = numpy_of(normals.lean(source, pyramid, effects)(*place))[:, 0]
    plain = numpy_of(normals.reader(pyramid, effects)(*place))[:, 0]
    error, without = (np.abs(x - expected).mean() / np.mean(expected) for x in (found, plain))
    print(f"LEAN errs by {error:.3f}, filtered parameters by {without:.3f}")
    assert error < 0.1 and error < 0.5 * without


def test_baked_roughness(types, rng):
    """Of a surface that is flat it is its own, as on level 0; that of slopes is larger on coarser levels."""
    flat = material(rng.normal(0, 1e-3, (16, 16, 2)), 0.42, metallic=1.0)
    pyramid, effects = prepared(flat, types)
    for level in normals.bake(pyramid, effects, 4):
        np.testing.assert_allclose(level, 0.42, atol=0.01)
    rough = material(rng.normal(0, 0.15, (16, 16, 2)), 0.42, metallic=1.0)
    pyramid, effects = prepared(rough, types)
    means = [level.mean() for level in normals.bake(pyramid, effects, 16)]
    assert means[0] == pytest.approx(0.42, abs=1e-5) and 0.425 < means[1] < means[3] < 0.6


def test_another_roughness_is_stored(types, rng):
    """In place of the source's, or beside what else there is."""
    noisy = from_arrays({"roughness": rng.random((8, 8)).astype(np.float32),
                         "albedo": rng.random((8, 8, 3)).astype(np.float32)})  # fmt: skip
    for source in (material(rng.normal(0, 0.2, (8, 8, 2))), noisy):
        pyramid = Pyramid.from_source(source, types=types, border=("repeat", "repeat"))
        levels = [np.full(level.shape[:2], 0.2 + 0.1 * i) for i, level in enumerate(pyramid.values)]
        changed = normals.with_roughness(pyramid, levels)
        place = lanes(types, rng.random(20), rng.random(20), 2)[:3]
        before, after = (surface_of(p, p.filtered(*place)) for p in (pyramid, changed))
        np.testing.assert_allclose(after.roughness.numpy(), 0.4, atol=1e-5)
        np.testing.assert_allclose(numpy_of(after.albedo), numpy_of(before.albedo), atol=1e-5)
        read = normals.roughness_reader(pyramid, material_effects(pyramid.layout)[0], levels)
        also = reader(changed, material_effects(changed.layout)[0])
        place = lanes(types, rng.random(20), rng.random(20), 3 * rng.random(20))
        np.testing.assert_allclose(numpy_of(read(*place)), numpy_of(also(*place)), atol=1e-4)


def test_biases(types, rng):
    source = material(rng.normal(0, 0.2, (16, 16, 2)))
    pyramid, effects = prepared(source, types)
    place, finer = (lanes(types, rng.random(50), rng.random(50), level) for level in (2, 1.5))
    finer = (*place[:2], finer[2], *place[3:])
    plain = normals.reader(pyramid, effects)
    np.testing.assert_array_equal(numpy_of(normals.biased(plain, [0] * 5)(*place)), numpy_of(plain(*place)))
    biased = normals.biased(plain, [0, 0, -0.5, 0, 0])
    np.testing.assert_allclose(numpy_of(biased(*place)), numpy_of(plain(*finer)), atol=1e-5)
    between = lanes(types, rng.random(50), rng.random(50), 1.5), lanes(types, rng.random(50), rng.random(50), 1.25)
    between = [(*place[:2], lane[2], *place[3:]) for lane in between]
    np.testing.assert_allclose(numpy_of(biased(*between[0])), numpy_of(plain(*between[1])), atol=1e-5)


def test_a_bias_that_is_known_is_found(types, rng):
    """A reader that is a quarter of a level off, of a surface on which each level looks different."""
    source = material(rng.normal(0, 0.02, (32, 32, 2)))
    pyramid, effects = prepared(source, types)
    plain = normals.reader(pyramid, effects)
    own = normals.choose_biases(plain, pyramid, effects, 2**10)
    shifted = normals.choose_biases(
        lambda u, v, level, wi, wo: plain(u, v, level + 0.25, wi, wo), pyramid, effects, 2**10
    )
    assert len(own) == pyramid.levels and set(own) <= set(normals.BIASES)
    for level in range(1, 4):
        assert shifted[level] == own[level] - 0.25 or own[level] - 0.25 < normals.BIASES[0]


@pytest.mark.parametrize("border", ["repeat", "clamp"])
def test_moments_of_what_is_interpolated(types, rng, border):
    """Against many samples of the normals that the unfiltered read of a pyramid finds."""
    source = material(rng.normal(0, 0.3, (8, 8, 2)))
    pyramid = Pyramid.from_source(source, types=types, border=(border, border))
    n, r = normals.unit_normals(source), normals.roughness(source)
    found = normals.interpolated(normals.slope_moments, n, r, (border, border), True)
    fine = 16
    x = (np.arange(8 * fine) + 0.5) / (8 * fine)
    v, u = (types.Float(a.ravel().astype(np.float32)) for a in np.meshgrid(x, x, indexing="ij"))
    read = numpy_of(surface_of(pyramid, pyramid.stored(u, v)).normal).reshape(8, fine, 8, fine, 3)
    b = read[..., :2] / read[..., 2:]
    expected = np.concatenate([b, b**2, b[..., :1] * b[..., 1:]], axis=-1).mean(axis=(1, 3))
    np.testing.assert_allclose(found[..., :5], expected, atol=0.015)
    np.testing.assert_allclose(found[..., 5], 0.4**4, rtol=1e-4)
    assert (normals.slopes(n)[..., 2:4] - found[..., 2:4]).mean() > 0.03  # where texels alone have more variance


def test_mean_cosine(types, rng):
    """A surface that hardly reflects but diffusely, lit from above: LEAN has the mean of the cosines to noise."""
    slopes = rng.normal(0, 0.3, (64, 64, 2))
    source = material(slopes, 0.9)
    pyramid, effects = prepared(source, types)
    n = normals.unit_normals(source)
    place = lanes(types, [0.5], 0.5, 6, [0, 0, 1], [0, 0, 1])
    lean, plain = (numpy_of(make)[0] for make in (normals.lean(source, pyramid, effects)(*place),
                                                normals.reader(pyramid, effects)(*place)))  # fmt: skip
    assert lean / plain == pytest.approx(n[..., 2].mean(), rel=0.02) and n[..., 2].mean() < 0.94
