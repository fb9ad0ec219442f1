"""Weights of maps: their balance, their words, and what they do to a training."""

import dataclasses

import numpy as np
import pytest

import mi_diffind as md
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.maps import as_seen
from mi_diffind.maps.source import from_arrays
from mi_diffind.tasks.image import presets, search, training, weights
from mi_diffind.tasks.image.compressed import CompressedImage

pytestmark = pytest.mark.usefixtures("few_samples")


def decibels(result):
    return {name: 20 * np.log10(weight) for name, weight in result.items()}


def test_weights_follow_sensitivities():
    """Between the least weights, squares of weights are proportional; decibels of all channels sum to 0."""
    channels = {"albedo": 3, "normal": 2, "ao": 1}
    result = decibels(weights.balanced({"albedo": 0.11, "normal": 0.1, "ao": 0.0}, channels))
    assert result["albedo"] - result["normal"] == pytest.approx(10 * np.log10(1.1), abs=0.1)
    assert result["ao"] == pytest.approx(weights.OTHER_DB, abs=0.05)
    assert sum(channels[name] * db for name, db in result.items()) == pytest.approx(0, abs=0.2)
    result = decibels(weights.balanced({"albedo": 1e-4, "normal": 1.0, "ao": 0.0}, channels))
    assert result["albedo"] == pytest.approx(weights.SHOWN_DB, abs=0.05)
    assert result["normal"] == pytest.approx(-(3 * weights.SHOWN_DB + weights.OTHER_DB) / 2, abs=0.1)
    assert weights.balanced({"albedo": 0.0, "ao": 0.0}, channels) == {}


@pytest.mark.parametrize("text, expected", [
    ("auto", "auto"), ("equal", "equal"), ("normal=2", {"normal": 2.0}), ("a=.5, b=1e1", {"a": 0.5, "b": 10.0}),
])  # fmt: skip
def test_words(text, expected):
    assert presets.parse_weights(text) == expected


@pytest.mark.parametrize("text", ["", "normal", "normal=0", "normal=-1", "normal=nan", "a=1,b", "a=101", "even"])
def test_words_that_mean_nothing(text):
    with pytest.raises(ValueError, match="allowed are auto, equal, or maps"):
        presets.parse_weights(text)


def two_maps():
    """Two maps that vary by the same amount, along different axes."""
    waves = np.uint8(127 + 100 * np.sin(np.mgrid[0:32, 0:32] * np.pi / 16))
    return from_arrays({"left": waves[0], "right": waves[1]})


def start(weights):
    """Mean squared error of each map of initial arrays, which have room for one component."""
    source = two_maps()
    recipe = dataclasses.replace(presets.PRESETS["ours"], weights=weights, structure="8 bits", dims=1)
    problem = training.problem_of(source, search.default_size(source, 800, recipe), recipe, array_module("llvm"))
    decoded = CompressedImage(problem.layout, problem.net).decode()
    errors = {m.name: float(np.mean((m.values - decoded[m.name]) ** 2)) for m in source.maps}
    return problem, errors


def test_initial_arrays_hold_the_heavier_map():
    for heavy, light in (("left", "right"), ("right", "left")):
        problem, errors = start({heavy: 3.0})
        assert errors[heavy] < 0.3 * errors[light]
        assert problem.weights[heavy] == pytest.approx(9 * problem.weights[light])
    assert "weights" not in start({})[0].identity


def test_a_file_names_its_weights(tmp_path):
    maps = {"a": np.zeros((16, 16), np.uint8), "b": np.uint8(np.mgrid[0:16, 0:16][0] * 15)}
    maps["a"][3:9] = 200
    given = {"steps": 2, "batch": 64, "progress": False, "compression": 2}
    first = md.fit("image", maps, weights="b=2.5", **given)
    assert first.table.settings["weights"] == {"b": 2.5}
    assert "weights" not in md.fit("image", maps, **given).table.settings
    assert md.fit("image", maps, weights={"b": 2.5}, **given).table.settings["weights"] == {"b": 2.5}
    path = first.save(tmp_path / "a.npz")
    np.testing.assert_array_equal(md.open(path).decode()["b"], first.model.decode()["b"])
    with pytest.raises(UsageError, match='the map "c", allowed are a, b'):
        md.fit("image", maps, weights="c=2", **given)


def test_measured_weights(monkeypatch):
    """With ``auto`` a material is weighted by its pictures, where those of initial arrays gain by it."""
    rng, batch = np.random.default_rng(0), {"steps": 1, "batch": 64, "progress": False}
    maps = {name: rng.integers(100, 150, (16, 16, 3), np.uint8) for name in ("albedo", "normal")}
    monkeypatch.setattr(as_seen, "SIZE", (16, 12))
    monkeypatch.setattr(as_seen, "sensitivities", lambda source, types: {"albedo": 0.1, "normal": 0.2})
    gains = {"": 30.0, "weighted": 30.6}
    monkeypatch.setattr(weights, "_start_db", lambda *given: gains["weighted" if given[-1] else ""])
    fitted = md.fit("image", maps, weights="auto", **batch)
    expected = weights.balanced({"albedo": 0.1, "normal": 0.2}, {"albedo": 3, "normal": 3})
    assert fitted.table.settings["weights"] == expected
    assert fitted.table.measured["seen_db"] > 0 and fitted.table.measured["angle_normal_deg"] > 0
    assert "weights" not in md.fit("image", maps, **batch).table.settings
    gains["weighted"] = 30.4
    assert "weights" not in md.fit("image", maps, weights="auto", **batch).table.settings


def test_initial_arrays_are_compared_as_seen(monkeypatch):
    """Weights of a map are worth its pictures: a normal map that has no room beside another map as strong."""
    monkeypatch.setattr(as_seen, "SIZE", (16, 12))
    y, x = np.mgrid[0:32, 0:32] * np.pi / 16
    tilted = np.dstack([0.5 + 0.3 * np.sin(x), 0.5 + 0 * x, 0.5 + 0 * x])
    source = from_arrays({"normal": np.uint8(255 * tilted), "ao": np.uint8(127 + 80 * np.sin(y))})
    recipe = dataclasses.replace(presets.PRESETS["ours"], structure="8 bits", dims=1)
    given = source, recipe, 900, array_module("llvm")
    equal, normal, ao = (weights._start_db(*given, w) for w in ({}, {"normal": 4.0}, {"ao": 4.0}))
    assert normal > ao + 3 and normal >= equal - 0.1


def test_what_is_flat_stays_flat():
    """A channel of one value is that value, a derived normal has length 1, whatever else the file holds."""
    y, x = np.mgrid[0:24, 0:24] / 24
    tilt = np.dstack([0.4 * np.sin(6 * x), 0.4 * np.cos(9 * y)])
    normal = np.dstack([tilt, np.sqrt(1 - (tilt**2).sum(axis=-1))])
    maps = {"normal": np.float32(0.5 + 0.5 * normal), "metallic": np.full((24, 24), 77, np.uint8)}
    maps["ao"] = np.uint8(np.dstack([255 * x, 200 + 0 * x]))
    decoded = md.fit("image", maps, steps=2, batch=64, compression=4, progress=False).model.decode()
    assert (decoded["metallic"] == np.float32(77 / 255)).all()
    assert (decoded["ao"][..., 1] == np.float32(200 / 255)).all()
    np.testing.assert_allclose(np.linalg.norm(2 * decoded["normal"] - 1, axis=-1), 1, atol=1e-5)
    assert np.ptp(decoded["normal"][..., 0]) > 0.1
