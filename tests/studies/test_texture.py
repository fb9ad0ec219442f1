"""``tradeoff texture``: scenes, errors of renders and levels, a moving camera."""

import math

import numpy as np
import pytest
from texture_files import smooth

from mi_diffind.core.runtime import array_module
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import from_arrays
from mi_diffind.measure import renders
from mi_diffind.studies import materials

FILM = (24, 16)


def directions(scene, film, x, y):
    """Rays through places of the image in [0, 1], by the rules of a pinhole camera: up is up, right is right."""
    forward = np.subtract(scene.target, scene.origin)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0, 1, 0])
    right = right / np.linalg.norm(right)
    tangent = math.tan(math.radians(scene.fov) / 2)
    across, down = (2 * x - 1) * tangent, (2 * y - 1) * tangent * film[1] / film[0]
    return forward + across[..., None] * right - down[..., None] * np.cross(right, forward)


def test_areas_of_pixels(mi_rgb):
    """Areas of the plane, by hand: uv is 1 over the width of the square."""
    scene = renders.still_scenes()["plane"]
    area, inside = scene.pixel_areas(FILM)
    x, y = np.meshgrid(np.arange(FILM[0] + 1) / FILM[0], np.arange(FILM[1] + 1) / FILM[1])
    way = directions(scene, FILM, x, y)
    with np.errstate(divide="ignore"):
        places = scene.origin + way * (-scene.origin[1] / way[..., 1:2])
    ahead = way[..., 1] < 0
    near = ahead & (np.abs(places[..., [0, 2]]) < 900).all(axis=-1)
    corners = near[:-1, :-1] & near[1:, :-1] & near[:-1, 1:] & near[1:, 1:]
    assert inside[corners].all() and not inside[: FILM[1] // 8].any() and 0.5 < corners.mean() < 1
    p = places[..., [0, 2]] / 2000
    a, b = p[1:, 1:] - p[:-1, :-1], p[1:, :-1] - p[:-1, 1:]
    expected = 0.5 * np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
    rows = corners & (np.arange(FILM[1])[:, None] >= FILM[1] // 3)  # further away, single precision is not enough
    np.testing.assert_allclose(area[rows], expected[rows], rtol=0.02)
    repeats = scene.repeats(FILM, (64, 32))
    assert repeats[0] * 64 == pytest.approx(repeats[1] * 32)  # texels are square
    texels = expected * repeats[0] * 64 * repeats[1] * 32
    assert texels[-1, FILM[0] // 2] == pytest.approx(scene.texels, rel=0.02)
    far = rows & (np.abs(texels - 1) > 0.05)
    assert np.array_equal(scene.counted(FILM, (64, 32))[far], texels[far] >= 1)


def test_light_has_no_noise(mi_rgb):
    """A constant texture is shown as it is, whatever the seed; a sphere as bright as it faces the light."""
    reader = renders.TextureReader(lambda repeats: {"type": "rgb", "value": [0.8, 0.3, 0.1]})
    for name, scene in renders.still_scenes().items():
        images = [reader.render(scene, FILM, (8, 8), seed) for seed in (0, 1)]
        inside = scene.pixel_areas(FILM)[1]
        if name == "sphere":
            assert images[0].max() <= 0.91 and images[0][inside].min() < 0.5
            continue
        np.testing.assert_array_equal(images[0][inside], images[1][inside])
        expected = 1.055 * np.array([0.8, 0.3, 0.1]) ** (1 / 2.4) - 0.055
        np.testing.assert_allclose(images[0][inside], np.broadcast_to(expected, (inside.sum(), 3)), atol=1e-5)


def test_errors_are_those_of_counted_pixels():
    truth = np.random.default_rng(1).random((12, 10, 3)).astype(np.float32)
    counted = np.zeros((12, 10), bool)
    counted[3:7, 2:8] = True
    image = np.where(counted[..., None], truth, 1 - truth)
    assert renders.errors(truth, image, counted) == {"mse": 0, "flip": 0}
    image[4, 5, 1] += 0.25
    found = renders.errors(truth, image, counted)
    assert found["mse"] == pytest.approx(0.25**2 / (24 * 3), rel=1e-4) and found["flip"] > 0


def test_levels(mi_rgb):
    """Errors of each level by hand; decoded levels come back in a pyramid of the same layout."""
    source = from_arrays({"albedo": smooth(8, 16, 3), "ao": smooth(8, 16, 1, 1)})
    pyramid = Pyramid.from_source(source, types=array_module("llvm_ad_rgb"))
    truth = materials.level_images(pyramid)
    np.testing.assert_allclose(truth["albedo"][0], source.maps[0].values, atol=1e-6)
    assert [v.shape for v in truth["ao"]] == [(8, 16, 1), (4, 8, 1), (2, 4, 1), (1, 2, 1), (1, 1, 1)]
    changed = {name: [v.copy() for v in values] for name, values in truth.items()}
    changed["albedo"][1][..., 2] = np.clip(changed["albedo"][1][..., 2] * 0.9, 0, 1)
    found = materials.level_errors(truth, changed)
    mse = np.mean((changed["albedo"][1][..., 2] - truth["albedo"][1][..., 2]) ** 2)
    assert found[1] == pytest.approx(-10 * math.log10(mse / 4), abs=1e-3) and found[0] == found[2] == 120
    each = [materials.level_errors({name: truth[name]}, changed)[1] for name in ("albedo", "ao")]
    assert each == pytest.approx([-10 * math.log10(mse / 3), 120], abs=1e-3)
    decoded = materials.level_images(materials.level_pyramid(changed, pyramid))
    for name, values in changed.items():
        for a, b in zip(values, decoded[name], strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)
