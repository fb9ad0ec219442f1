"""Layouts of task 3: which channels are stored, how maps come back, and damage that is refused."""

import json
import math
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest

from mi_diffind.maps.layout import NORMAL_FLOOR_DB, Layout, MapLayout, different_transforms
from mi_diffind.maps.pyramid import root
from mi_diffind.maps.source import from_arrays


def noise(*shape):
    return np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)


def unit_normals(height=9, width=8, tilt=0.6, seed=0):
    """Normals in [0, 1]³, of unit length to the precision of floats."""
    x, y = np.random.default_rng(seed).uniform(-tilt, tilt, (2, height, width))
    return (0.5 + 0.5 * np.stack([x, y, np.sqrt(1 - x * x - y * y)], axis=-1)).astype(np.float32)


def back(layout, source):
    """The maps that come back from the stored channels, all with NumPy."""
    stored = layout.encode(source)
    assert stored.dtype == np.float32 and stored.shape == (source.height, source.width, layout.stored)
    assert stored.size == 0 or (stored.min() >= 0 and stored.max() <= 1)
    planes = list(np.moveaxis(stored, -1, 0))
    shape = (source.height, source.width)
    return {
        m.name: np.stack([np.broadcast_to(v, shape) for v in layout.decode(m.name, planes)], axis=-1)
        for m in source.maps
    }


def assert_same(maps, source):
    for m in source.maps:
        np.testing.assert_array_equal(maps[m.name], m.values)


def test_colours_are_stored_as_they_are():
    source = from_arrays({"albedo": noise(5, 4, 3)})
    layout = Layout.from_source(source)
    assert layout.maps[0].where == (0, 1, 2) and layout.groups == ("albedo",) * 3 and layout.initial == (0.5,) * 3
    assert (layout.width, layout.height, layout.stored, layout.names) == (4, 5, 3, ("albedo",))
    assert_same(back(layout, source), source)


def test_equal_channels_of_different_maps_are_stored_once():
    albedo = noise(5, 4, 3)
    source = from_arrays({"albedo": albedo, "height": albedo[..., 2], "other": albedo[..., 2] // 2})
    layout = Layout.from_source(source)
    assert [m.where for m in layout.maps] == [(0, 1, 2), (2,), (3,)]
    assert layout.groups == ("albedo", "albedo", "albedo", "other") and layout.needed("height") == (2,)
    assert_same(back(layout, source), source)


def test_constant_channels_are_numbers():
    image = noise(5, 4, 3)
    image[..., 1] = 77
    flat = {"metallic": np.zeros((5, 4), np.uint8), "ao": np.full((5, 4), 255, np.uint8)}
    source = from_arrays({"albedo": image, **flat})
    layout = Layout.from_source(source)
    value = float(np.float32(77) / np.float32(255))
    assert [m.where for m in layout.maps] == [(0, ("constant", value), 1), (("constant", 0.0),), (("constant", 1.0),)]
    assert layout.needed("albedo") == (0, 1) and layout.needed("ao") == ()
    assert_same(back(layout, source), source)
    assert Layout.from_source(source, once=False).stored == 5


def test_unit_normals_lose_their_third_component():
    source = from_arrays({"normal": unit_normals()})
    layout = Layout.from_source(source)
    assert layout.maps[0].where == (0, 1, "z") and layout.stored == 2
    np.testing.assert_allclose(back(layout, source)["normal"], source.maps[0].values, atol=1e-6)
    assert Layout.from_source(source, two_channel_normals=False).stored == 3


def test_normals_of_bytes_keep_their_third_component_if_it_says_more():
    """The floor is on the mean squared error of the third component, on either side of it."""
    exact = unit_normals(40, 40)
    for decibel, dropped in ((NORMAL_FLOOR_DB + 1, True), (NORMAL_FLOOR_DB - 1, False)):
        normals = exact.copy()
        normals[..., 2] -= np.float32(10 ** (-decibel / 20))
        assert (Layout.from_source(from_arrays({"normal": normals})).stored == 2) == dropped
    short = (0.5 + 0.8 * (exact - 0.5)).astype(np.float32)  # of length 0.8
    source = from_arrays({"normal": short})
    assert Layout.from_source(source).stored == 3
    np.testing.assert_array_equal(back(Layout.from_source(source), source)["normal"], short)
    assert Layout.from_source(source, two_channel_normals=True).stored == 2


def test_other_maps_keep_all_components():
    for name in ("albedo", "height"):
        assert Layout.from_source(from_arrays({name: unit_normals()})).stored == 3
    below = unit_normals()
    below[..., 2] = 1 - below[..., 2]  # the lower hemisphere does not follow from x and y
    assert Layout.from_source(from_arrays({"normal": below})).stored == 3
    assert Layout.from_source(from_arrays({"normal": 2 * unit_normals() - 1})).stored == 3  # signed: not in [0, 1]
    flat = unit_normals()
    flat[..., 0] = 0.5
    source = from_arrays({"normal": flat})
    found = back(Layout.from_source(source), source)["normal"]
    np.testing.assert_allclose(found, flat, atol=1e-6)


def hdr(largest, seed=0):
    """Values over eight decades, zero among them."""
    rng = np.random.default_rng(seed)
    values = (largest * 10 ** rng.uniform(-8, 0, (16, 16, 3))).astype(np.float32)
    values[0, 0, 0], values[0, 0, 1] = largest, 0
    return values


@pytest.mark.parametrize("largest", [1.5, 1e3, 65504.0, 1e30])
def test_high_dynamic_range_is_logarithmic(largest):
    values = hdr(largest)
    source = from_arrays({"image": values})
    layout = Layout.from_source(source)
    m = layout.maps[0]
    # Written out again, in double precision: linear below the knee, logarithmic above it
    knee = max(float(np.median(values)), 1e-3 * largest)
    expected = np.log1p(values.astype(np.float64) / knee) / math.log1p(largest / knee)
    encoded = layout.encode(source)
    np.testing.assert_allclose(encoded, expected, atol=2e-6)
    assert encoded.min() == 0 and encoded.max() == 1
    assert np.array_equal(np.argsort(encoded[..., 0], axis=None), np.argsort(values[..., 0], axis=None))
    # Bytes: within 1/255 as they are compared, and relatively precise above the knee
    stored = np.rint(encoded * 255) / 255
    found = np.stack(layout.decode("image", list(np.moveaxis(stored, -1, 0))), axis=-1)
    assert np.abs(m.encode(found) - encoded).max() <= 0.5001 / 255 + 1e-6
    step = math.log1p(largest / knee) / 255
    bright = values > knee
    assert (np.abs(found / np.maximum(values, 1e-30) - 1)[bright] <= 1.05 * step).all()
    np.testing.assert_allclose(back(layout, source)["image"], values, rtol=1e-4, atol=1e-5 * knee)


@pytest.mark.parametrize("low, high", [(-1, 1), (-3, -2), (-1e-3, 7), (-1e30, 1e30), (-65504, 0), (-1e-40, 1e-40)])
def test_negative_values_span_their_range(low, high):
    values = np.random.default_rng(1).uniform(low, high, (8, 8, 2)).astype(np.float32)
    values[0, 0] = low, high
    source = from_arrays({"height": values})
    layout = Layout.from_source(source)
    assert layout.maps[0].low == values.min() and layout.maps[0].knee == 0
    np.testing.assert_allclose(back(layout, source)["height"], values, atol=1e-6 * max(high - low, 1e-3))


@pytest.mark.parametrize(("low", "high"), [(0, 1), (-1, 0), (-1, 1)])
def test_the_largest_floats(low, high):
    """No overflow (a RuntimeWarning is an error here), and nothing that is not finite."""
    values = np.random.default_rng(1).uniform(low, high, (8, 8, 3))
    values[0, 0] = low, high, 0
    values = (values * np.finfo(np.float32).max).astype(np.float32)
    source = from_arrays({"image": values})
    found = back(Layout.from_source(source), source)["image"]
    small = np.abs(values) < 1e38
    assert np.isfinite(found).all() and (np.sign(found[small]) == np.sign(values[small])).mean() > 0.9
    assert np.abs(found[small] - values[small]).max() < 1e33


def test_what_lies_outside_becomes_the_nearest():
    plain = MapLayout("a", "other", "linear", 1, (0,))
    wide = replace(plain, low=-2.0, high=6.0)
    bright = replace(plain, high=8.0, knee=0.5)
    values = np.float32([-1e30, -2, -1, 0, 1, 8, 1e30])
    np.testing.assert_array_equal(plain.encode(values), np.float32([0, 0, 0, 0, 1, 1, 1]))
    np.testing.assert_array_equal(wide.encode(values), np.float32([0, 0, 0.125, 0.25, 0.375, 1, 1]))
    found = bright.encode(values)
    assert (found[:4] == 0).all() and 0 < found[4] < 1 and (found[5:] == 1).all()


MAPS = (
    MapLayout("albedo", "albedo", "srgb", 1, (0, 1, 2)),
    MapLayout("normal", "normal", "linear", 1, (3, 4, "z")),
    MapLayout("flat", "normal", "linear", 1, (("constant", 0.25), 4, "z")),
    MapLayout("height", "other", "linear", 4, (2,), -3.0, 5.0),
    MapLayout("glow", "other", "linear", 2, (1, 0, 0), 0.0, 4000.0, 4.0),
    MapLayout("black", "other", "linear", 1, (("constant", 0.0),)),
)
LAYOUT = Layout(4, 3, MAPS, (0.5,) * 5, ("albedo",) * 3 + ("normal",) * 2)


def test_dr_jit_decodes_as_numpy(ad):
    stored = np.random.default_rng(0).random((5, 500), dtype=np.float32)
    stored[:, :2] = 0, 1  # corners, where x² + y² is beyond 1
    for name in LAYOUT.names:
        expected = LAYOUT.decode(name, list(stored))
        found = LAYOUT.decode(name, [ad.Float(v.copy()) for v in stored], dr.exp2, root)
        assert len(found) == len(expected) == LAYOUT[name].channels
        atol = 1e-3 if "z" in LAYOUT[name].where else 2e-6 * (LAYOUT[name].high - LAYOUT[name].low)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(np.array(a), b, rtol=1e-5, atol=atol)


def test_a_normal_is_of_unit_length_or_flat(ad):
    """Where x² + y² is beyond 1, z is 0; the derivative is finite everywhere."""
    x, y = np.random.default_rng(2).random((2, 1000), dtype=np.float32)
    point = [ad.Float(x), ad.Float(y)]
    dr.enable_grad(point)
    stored = [None, None, None, *point]  # what a map does not need may be missing
    found = LAYOUT.decode("normal", stored, dr.exp2, root)
    normal = np.stack([2 * v.numpy() - 1 for v in found])
    dr.backward(found[2])
    inside = (2 * x - 1) ** 2 + (2 * y - 1) ** 2 < 0.999
    np.testing.assert_allclose(np.linalg.norm(normal, axis=0)[inside], 1, atol=1e-4)
    assert (normal[2, (2 * x - 1) ** 2 + (2 * y - 1) ** 2 > 1.001] == 0).all()
    assert all(np.isfinite(v.grad.numpy()).all() for v in point)


def test_json_round_trip():
    source = from_arrays({"normal": unit_normals(), "height": hdr(1e30)[:9, :8, 0], "ao": np.zeros((9, 8), np.uint8)})
    placed = replace(MAPS[1], transform=(2.0, 0.0, 0.25, 0.5, -1.0, 1.0))
    changed = replace(LAYOUT, maps=(MAPS[0], placed, *MAPS[2:]), double_sided=True)
    for layout in (LAYOUT, Layout.from_source(source), changed):
        assert Layout.from_json(json.loads(json.dumps(layout.to_json(), allow_nan=False))) == layout
    for transform in ([1.0] * 5, [INFINITY] * 6, [HUGE] * 6, "x", None, 3):
        damaged = changed.to_json()
        damaged["maps"][0]["transform"] = transform
        with pytest.raises((TypeError, ValueError, OverflowError)):
            Layout.from_json(damaged)
    assert different_transforms(changed.maps) == (
        'the maps "albedo" (none) and "normal" (uv transform [2 0 0.25, 0.5 -1 1]) differ in their texture transforms'
    )
    assert not different_transforms((placed, MAPS[5]))  # the last map is constant


INFINITY, HUGE = float("inf"), 10**400

#: Where in the JSON (keys and indices), and what stands there instead.
DAMAGE = [
    *((("width",), v) for v in (0, -1, None, "x", [], INFINITY, float("nan"))),
    *((("height",), v) for v in (0, -3, {}, INFINITY, 2**31, HUGE)),
    *((("maps",), v) for v in ([], None, 3, {}, "maps", [None], [{}], [[]])),
    *((("maps", 0), v) for v in (None, 7, "albedo", [])),
    *((("maps", 0, "name"), v) for v in (None, 3, "", "a b", "../albedo", "a/b", "normal", ["albedo"])),
    *((("maps", 0, "kind"), v) for v in (None, "colour", 3)),
    *((("maps", 0, "color_space"), v) for v in (None, "rec709", 3)),
    *((("maps", 0, "depth"), v) for v in (None, -1, 3, 8, "x", INFINITY)),
    *((("maps", 0, "where"), v) for v in (None, [], 3, [5], [-1], [0.5], [True], ["x"], ["z", 0, 1], [0, 1, 2, "z"])),
    *((("maps", 1, "where"), v) for v in ([0, "z"], [0, 1, "z", "z"], [[], 1, 2], [["constant"], 1, 2])),
    *((("maps", 2, "where", 0), ["constant", v]) for v in (None, "x", INFINITY, float("nan"), HUGE)),
    (("maps", 2, "where", 0), ["variable", 1.0]),
    *((("maps", 3, "low"), v) for v in (5.0, 6.0, -INFINITY, float("nan"), None, "x", -HUGE, -1e39)),
    *((("maps", 3, "high"), v) for v in (-3.0, -4, INFINITY, float("nan"), None, [], HUGE, 1e39)),
    *((("maps", 4, "knee"), v) for v in (-1.0, INFINITY, float("nan"), None, 1e-30, HUGE)),
    *((("maps", 4, "high"), v) for v in (0.0, -1.0)),
    *((("initial",), v) for v in (None, [], [0.5] * 4, [0.5] * 6, ["x"] * 5, [HUGE] * 5, 3)),
    *((("groups",), v) for v in (None, 3, [], ["albedo"] * 4, ["albedo"] * 6)),
]


@pytest.mark.parametrize("place, value", DAMAGE)
def test_damage_is_refused(place, value):
    damaged = LAYOUT.to_json()
    part = damaged
    for key in place[:-1]:
        part = part[key]
    assert part[place[-1]] != value
    part[place[-1]] = value
    with pytest.raises((KeyError, TypeError, ValueError, OverflowError)):
        Layout.from_json(damaged)


def test_incomplete_layouts_are_refused():
    for part in ((), ("maps", 0)):
        for key in LAYOUT.to_json()["maps"][0] if part else LAYOUT.to_json():
            damaged = inner = LAYOUT.to_json()
            for step in part:
                inner = inner[step]
            del inner[key]
            with pytest.raises(KeyError):
                Layout.from_json(damaged)
    for nothing in (None, [], 3, "layout"):
        with pytest.raises((KeyError, TypeError)):
            Layout.from_json(nothing)
