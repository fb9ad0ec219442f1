"""The truth that textures are compared with: a mip pyramid, read as graphics hardware reads it."""

import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of
from scipy.ndimage import map_coordinates

from mi_diffind.images import srgb
from mi_diffind.maps.layout import Layout
from mi_diffind.maps.pyramid import Pyramid, level_sizes
from mi_diffind.maps.source import from_arrays


def filtered(pyramid, u, v, level) -> np.ndarray:
    Float = pyramid.types.Float
    u, v, level = (Float(aligned(x)) for x in np.broadcast_arrays(*np.atleast_1d(u, v, level)))
    return numpy_of(pyramid.filtered(u, v, level))


def stored(pyramid, u, v) -> np.ndarray:
    return numpy_of(pyramid.stored(*(pyramid.types.Float(aligned(x)) for x in (u, v))))


def centres(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """u and v of all texels of a level."""
    j, i = np.meshgrid(np.arange(columns), np.arange(rows))
    return (np.float32(j.ravel()) + 0.5) / columns, (np.float32(i.ravel()) + 0.5) / rows


def noise(rng, *shape) -> np.ndarray:
    return rng.random(shape, dtype=np.float32)


SIZES = [(16, 16), (13, 9), (8, 32), (1, 7), (5, 1), (1, 1)]


@pytest.mark.parametrize("size", SIZES)
def test_a_texel_is_the_mean_of_what_it_covers(rng, size):
    source = from_arrays({"data": noise(rng, *size, 2)})
    pyramid = Pyramid.from_source(source)
    assert [level.shape[:2] for level in pyramid.values] == level_sizes(*size)
    assert pyramid.values[-1].shape[:2] == (1, 1) and pyramid.levels == int(np.log2(max(size))) + 1
    for fine, coarse in zip(pyramid.values, pyramid.values[1:], strict=False):
        # By integrating the step function of the texels finely
        (n, m), (rows, columns) = fine.shape[:2], coarse.shape[:2]
        pieces = np.repeat(np.repeat(fine.astype(np.float64), rows, 0), columns, 1)
        expected = pieces.reshape(rows, n, columns, m, -1).mean(axis=(1, 3))
        np.testing.assert_allclose(coarse, expected, atol=1e-6)
    # The mean of all is kept through all levels, odd sizes or not
    if size != (1, 1):
        np.testing.assert_allclose(pyramid.values[-1][0, 0], source.maps[0].values.mean(axis=(0, 1)), atol=1e-6)


def test_the_coarsest_level_is_the_mean_everywhere(ad, rng):
    for size in SIZES:
        source = from_arrays({"data": noise(rng, *size, 3)})
        pyramid = Pyramid.from_source(source, types=ad)
        if not pyramid.layout.stored:
            continue
        u, v = rng.random((2, 50), dtype=np.float32)
        mean = source.maps[0].values.astype(np.float64).mean(axis=(0, 1))
        decoded = pyramid.decode(level=pyramid.levels - 1)["data"]
        np.testing.assert_allclose(decoded, mean.reshape(1, 1, 3), atol=1e-6)
        for level in (pyramid.levels - 1, 40, 1e30, np.inf):
            np.testing.assert_allclose(np.ptp(filtered(pyramid, u, v, level), axis=0), 0, atol=1e-6)


@pytest.mark.parametrize("border", ["repeat", "clamp"])
def test_no_footprint_is_bilinear(ad, rng, border):
    """Against SciPy; level 0, everything below, and NaN."""
    for height, width in ((13, 9), (16, 4)):
        values = noise(rng, height, width, 3)
        source = from_arrays({"data": values})
        pyramid = Pyramid.from_source(source, types=ad, border=(border, border))
        u, v = 3 * rng.random((2, 400), dtype=np.float32) - 1
        place = [np.float64(np.float32(v)) * height - 0.5, np.float64(np.float32(u)) * width - 0.5]
        mode = {"repeat": "grid-wrap", "clamp": "nearest"}[border]
        expected = np.stack([map_coordinates(values[..., c], place, order=1, mode=mode) for c in range(3)], axis=-1)
        np.testing.assert_allclose(stored(pyramid, u, v), expected, atol=2e-5)
        for level in (0, -1, -1e30, np.nan, -np.inf):
            np.testing.assert_allclose(filtered(pyramid, u, v, level), expected, atol=2e-5)


def test_levels_blend_linearly_and_continuously(ad, rng):
    pyramid = Pyramid.from_source(from_arrays({"data": noise(rng, 12, 20, 1)}), types=ad)
    u, v = rng.random((2, 200), dtype=np.float32)
    whole = [filtered(pyramid, u, v, level) for level in range(pyramid.levels)]
    for level in np.arange(0, pyramid.levels - 1, 0.125):
        i, w = int(level), level % 1
        expected = (1 - w) * whole[i] + w * whole[i + 1]
        np.testing.assert_allclose(filtered(pyramid, u, v, level), expected, atol=1e-5)
    for level in range(pyramid.levels):
        a, b = (filtered(pyramid, u, v, level + e) for e in (-1e-4, 1e-4))
        assert np.abs(a - b).max() < 3e-4


def test_constants_stay(ad):
    albedo = np.empty((7, 10, 3), np.uint8)
    albedo[:] = (200, 30, 3)
    normal = np.empty((7, 10, 3), np.uint8)
    normal[:] = (128, 128, 255)
    albedo[0, 0, 0], normal[3, 3] = 0, (255, 128, 128)  # or nothing would be stored
    source = from_arrays({"albedo": albedo, "normal": normal})
    pyramid = Pyramid.from_source(source, types=ad)
    assert [m.where[1:] for m in pyramid.layout.maps[:1]] == [(("constant", pytest.approx(30 / 255)),
                                                             ("constant", pytest.approx(3 / 255)))]  # fmt: skip
    for level in range(pyramid.levels):
        decoded = 255 * pyramid.decode(level=level)["albedo"]
        np.testing.assert_allclose(decoded[..., 1], 30, rtol=1e-6)
        np.testing.assert_allclose(decoded[..., 2], 3, rtol=1e-6)
    source = from_arrays({"albedo": np.full((7, 10, 3), 77, np.uint8)})
    pyramid = Pyramid.from_source(source, types=ad)
    assert pyramid.layout.stored == 0 and pyramid.levels == 4
    assert pyramid.filtered(ad.Float(0.5), ad.Float(0.5), ad.Float(1)) == []
    np.testing.assert_allclose(pyramid.decode(level=2)["albedo"], 77 / 255)


def test_colours_are_averaged_linearly(ad, rng):
    """And interpolated linearly; the same numbers as data are not."""
    codes = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    source = from_arrays({"albedo": codes, "data": codes[..., :2]})
    pyramid = Pyramid.from_source(source, types=ad)
    assert pyramid.layout.stored == 5  # equal channels, but of different means
    values = codes / 255.0
    block = values.reshape(4, 2, 4, 2, 3)
    np.testing.assert_allclose(
        pyramid.values[1][..., :3], srgb.from_linear(srgb.to_linear(block).mean(axis=(1, 3))), atol=1e-6
    )
    np.testing.assert_allclose(pyramid.values[1][..., 3:], block.mean(axis=(1, 3))[..., :2], atol=1e-6)
    np.testing.assert_allclose(
        pyramid.values[-1][0, 0, :3], srgb.from_linear(srgb.to_linear(values).mean(axis=(0, 1))), atol=1e-6
    )
    assert np.abs(pyramid.values[-1][0, 0, :2] - pyramid.values[-1][0, 0, 3:]).min() > 0.02
    # Half way between two texels
    found = stored(pyramid, [2 / 8], [0.5 / 8])[0]
    between = srgb.to_linear(values[0, 1:3]).mean(axis=0)
    np.testing.assert_allclose(found[:3], srgb.from_linear(between), atol=1e-5)
    np.testing.assert_allclose(found[3:], values[0, 1:3, :2].mean(axis=0), atol=1e-5)


@pytest.mark.parametrize("first", ["albedo", "data"])
def test_channels_of_two_maps_are_linear_if_both_are_colours(ad, rng, first):
    """A channel that an sRGB map shares with data is interpolated as the first map of the two has it."""
    codes = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    source = from_arrays({first: codes, **{name: codes for name in ("albedo", "data") if name != first}})
    pyramid = Pyramid.from_source(source, Layout.from_source(source), ad)
    assert pyramid.layout.stored == 3
    assert pyramid.is_linear("albedo") is (first == "albedo") and not pyramid.is_linear("data")
    u, v = (ad.Float(aligned(x)) for x in centres(8, 8))
    found = numpy_of(pyramid.interpolated(u, v, ad.Float(0))).reshape(8, 8, 3)
    expected = srgb.to_linear(codes / 255) if pyramid.is_linear("albedo") else codes / 255
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_high_dynamic_range_is_averaged_as_it_is(ad, rng):
    values = (10 ** (4 * noise(rng, 8, 8, 3) - 1)).astype(np.float32)
    source = from_arrays({"image": values})
    pyramid = Pyramid.from_source(source, types=ad)
    mean = values.astype(np.float64).mean(axis=(0, 1))
    np.testing.assert_allclose(pyramid.decode(level=3)["image"][0, 0], mean, rtol=1e-4)
    u, v = centres(8, 8)
    found = pyramid.read(ad.Float(u), ad.Float(v))["image"]
    np.testing.assert_allclose(numpy_of(found).reshape(8, 8, 3), values, rtol=1e-4)


def test_normals_stay_unit_vectors(ad, rng):
    xy = 0.9 * (noise(rng, 16, 16, 2) - 0.5)
    z = np.sqrt(1 - (xy**2).sum(axis=-1, keepdims=True))
    unit = np.concatenate([xy, z], axis=-1)
    pyramid = Pyramid.from_source(from_arrays({"normal": (0.5 + 0.5 * unit).astype(np.float32)}), types=ad)
    assert pyramid.layout.stored == 2  # the third follows at every level
    for level in range(1, pyramid.levels):
        block = 2**level
        mean = unit.reshape(16 // block, block, 16 // block, block, 3).mean(axis=(1, 3))
        expected = mean / np.linalg.norm(mean, axis=-1, keepdims=True)
        np.testing.assert_allclose(pyramid.decode(level=level)["normal"], 0.5 + 0.5 * expected, atol=1e-5)
    # Of vectors half as long the mean is brought to half the length
    short = Pyramid.from_source(from_arrays({"normal": (0.5 + 0.25 * unit).astype(np.float32)}), types=ad)
    last = 2 * short.decode(level=4)["normal"][0, 0] - 1
    assert np.linalg.norm(last) == pytest.approx(0.5, abs=1e-4)
    # What cancels out points up
    opposed = np.zeros((2, 2, 3), np.float32)
    opposed[0, :, 0], opposed[1, :, 0] = 1, -1
    up = Pyramid.from_source(from_arrays({"normal": 0.5 + 0.5 * opposed}), types=ad).decode(level=1)["normal"]
    np.testing.assert_allclose(up[0, 0], [0.5, 0.5, 1], atol=1e-5)


def test_a_flat_component_of_a_normal_is_not_a_constant(ad):
    """Renormalised, it changes from level to level, if others vary."""
    x = np.full((4, 4), 0.6, np.float32)
    y = np.where(np.arange(4)[:, None] % 2, 0.6, -0.6) * np.ones((4, 4))
    normal = 0.5 + 0.5 * np.stack([x, y, np.sqrt(1 - x**2 - y**2)], axis=-1)
    source = from_arrays({"normal": normal.astype(np.float32)})
    pyramid = Pyramid.from_source(source, types=ad)
    last = 2 * pyramid.decode(level=2)["normal"][0, 0] - 1
    z = float(np.sqrt(1 - 0.72))
    np.testing.assert_allclose(last, np.array([0.6, 0, z]) / np.hypot(0.6, z), atol=1e-5)
    assert Layout.from_source(source).stored < pyramid.layout.stored  # at level 0 alone it is one


def test_gradients_are_finite_and_right(ad, rng):
    pyramid = Pyramid.from_source(from_arrays({"albedo": rng.integers(0, 256, (9, 8, 3), dtype=np.uint8)}), types=ad)
    place = [ad.Float(aligned(rng.uniform(0.05, 0.95, 300))) for _ in range(2)]
    place.append(ad.Float(aligned(rng.integers(0, 3, 300) + rng.uniform(0.05, 0.9, 300))))
    dr.enable_grad(place)
    dr.backward(sum(pyramid.filtered(*place), ad.Float(0)))
    found = [dr.grad(x).numpy() for x in place]
    assert all(np.isfinite(g).all() for g in found)
    step = 1e-3
    for axis, g in enumerate(found):
        moved = [[x.numpy() + (s if axis == k else 0) for k, x in enumerate(place)] for s in (-step, step)]
        low, high = (filtered(pyramid, *m).sum(axis=-1) for m in moved)
        slope = (high - low) / (2 * step)
        assert np.median(np.abs(slope - g) / np.maximum(np.abs(slope), 0.05)) < 0.01
