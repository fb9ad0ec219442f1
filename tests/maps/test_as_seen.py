"""Materials as they are seen: patches, pictures, sensitivities, and errors in degrees."""

import numpy as np
import pytest

from mi_diffind.core.runtime import array_module
from mi_diffind.maps import as_seen
from mi_diffind.maps.source import from_arrays

LLVM = array_module("llvm")


class Decoded:
    """Maps in place of a compressed image."""

    types = LLVM

    def __init__(self, maps):
        self.maps = maps

    def decode(self, names):
        return {name: self.maps[name] for name in names}


@pytest.fixture(autouse=True)
def few_pixels(monkeypatch):
    monkeypatch.setattr(as_seen, "SIZE", (24, 18))
    monkeypatch.setattr(as_seen, "DISTANCES", {"near": (16, 4, 4), "far": (24, 8, 4)})


def material(**changed):
    rng = np.random.default_rng(1)
    maps = {
        "albedo": rng.random((32, 24, 3)), "normal": 0.5 + 0.05 * rng.standard_normal((32, 24, 3)),
        "roughness": rng.random((32, 24)), "ao": rng.random((32, 24)),
    }  # fmt: skip
    maps["normal"][..., 2] = 0.99
    return from_arrays({name: np.uint8(255 * v) for name, v in maps.items()} | changed)


def values(source):
    return {m.name: m.values for m in source.maps}


def test_patches_come_from_all_of_a_map():
    """Each patch is a square of neighbours of the map, from its own cell of the grid."""
    place = np.stack(np.mgrid[0:50, 0:70], axis=-1)
    shown = as_seen.patchwork(place, 16, 4)
    assert shown.shape == (16, 16, 2)
    for i in range(4):
        for j in range(4):
            patch = shown[4 * i : 4 * i + 4, 4 * j : 4 * j + 4]
            assert (patch - patch[0, 0] == np.stack(np.mgrid[0:4, 0:4], axis=-1)).all()
            y, x = patch[0, 0]
            assert 12.5 * i - 1 <= y <= 12.5 * i + 8.5 and 17.5 * j - 1 <= x <= 17.5 * j + 13.5


@pytest.mark.parametrize("height, width", [(1, 1), (5, 16), (16, 3)])
def test_small_maps_are_shown_whole(height, width):
    place = np.arange(height * width).reshape(height, width, 1)
    np.testing.assert_array_equal(as_seen.patchwork(place, 16, 4), place)


def test_maps_without_errors_give_no_difference():
    source = material()
    result = as_seen.measure(source, Decoded(values(source)))
    assert {name for name in result if name.startswith("seen_")} == {
        "seen_db", "seen_brightness", *(f"seen_{way}_db" for way in as_seen.WAYS)
    }  # fmt: skip
    assert result["seen_db"] == result["seen_rough_far_db"] == 120 and result["seen_brightness"] == 1
    assert result["angle_normal_deg"] == 0


def test_the_noise_of_renders_is_left_out():
    """Noise of two renders that is 30 times as strong as a difference of 0.02, in squares, is none of the error."""
    noise = 0.11 * np.random.default_rng(5).standard_normal((2, 300, 300, 3))
    result = as_seen.squared_error(np.full(noise.shape, 0.5), 0.52 + noise)
    assert result == pytest.approx(0.02**2, rel=0.25)


def test_errors_are_seen_by_role():
    """Only maps that a picture shows change it; half of the base colour is half of the light, up to its reflections."""
    source = material()
    maps = values(source)
    occluded = as_seen.measure(source, Decoded({**maps, "ao": 0 * maps["ao"]}))
    assert occluded["seen_db"] == 120
    tilted = maps["normal"] + np.float32([0.05, 0, 0])
    result = as_seen.measure(source, Decoded({**maps, "normal": tilted}))
    assert 3 < result["angle_normal_deg"] < 8 and result["seen_db"] < 45
    dark = as_seen.measure(source, Decoded({**maps, "albedo": 0 * maps["albedo"]}))
    assert dark["seen_brightness"] < 0.8


def test_what_is_not_shown():
    photo = from_arrays({"image": np.zeros((8, 8, 3), np.uint8)})
    assert not as_seen.shows(photo) and as_seen.measure(photo, Decoded(values(photo))) == {}
    assert as_seen.shows(material())


def test_sensitivities_are_those_of_pictures():
    """They predict the error of another change of one map, to a factor; a flat metal has no rough colours to lose."""
    source = material()
    result = as_seen.sensitivities(source, LLVM)
    assert result["ao"] == 0 and list(result) == list(values(source))
    for name in ("albedo", "normal"):
        maps = values(source)
        sign = np.random.default_rng(7).choice(np.float32([-0.02, 0.02]), maps[name].shape)
        seen = as_seen.measure(source, Decoded({**maps, name: maps[name] + sign}))
        mse = np.mean([10 ** (-seen[f"seen_{surface}_near_db"] / 10) for surface in as_seen.SURFACES])
        assert 0.5 < mse / (3 * 0.02**2 * result[name]) < 2
