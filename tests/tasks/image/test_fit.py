"""Sizes of images by rule, by short trainings and by a wanted quality; weights of maps."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

import mi_diffind as md
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.loop import FitResult
from mi_diffind.fitting.task import FitRequest
from mi_diffind.maps import as_seen
from mi_diffind.maps.source import from_arrays
from mi_diffind.tasks.image import PAGED, PRESETS, STRUCTURES, fit, parse_weights, training
from mi_diffind.tasks.image.arrays import CompressedImage

OURS, PAPER = PRESETS["ours"], PRESETS["paper"]

pytestmark = pytest.mark.usefixtures("few_samples")

#: Request of searches whose trainings are pretended.
REQUEST = FitRequest("ours", OURS, None, options={"source": "x.png"})


def noise(height=16, width=16, channels=3):
    values = np.random.default_rng(0).integers(0, 256, (height, width, channels))
    return from_arrays({"image": values.astype(np.uint8)})


def smooth(side=24):
    y, x = 2 * np.pi * np.mgrid[0:side, 0:side] / side
    waves = [np.sin(x), np.cos(y), np.sin(2 * x + y)]
    return from_arrays({"image": np.rint(127.5 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)})


def short(steps=8, **changed):
    return dataclasses.replace(OURS, steps=steps, batch=64, measure_every=steps, **changed)


def bytes_of(size, channels):
    """Bits of the coordinates in each primary, and a byte for each channel of the cascaded array."""
    primaries = [(size.rows, size.columns, size.dims, size.bits)]
    if size.coarse is not None:
        primaries[0] = (size.rows, size.columns, size.dims - size.coarse.dims, size.bits)
        sides = [max(1, round(n * size.coarse.scale)) for n in (size.rows, size.columns)]
        primaries.append((*sides, size.coarse.dims, size.coarse.bits))
    return sum(math.ceil(math.prod(p) / 8) for p in primaries) + channels * size.cascaded**size.dims


# ---------------------- By rule ----------------------

RECIPES = [pytest.param(dataclasses.replace(OURS, structure=name), id=name) for name in STRUCTURES]


@pytest.mark.parametrize("recipe", [*RECIPES, pytest.param(PAPER, id="paper")])
@pytest.mark.parametrize("height, width", [(128, 128), (300, 700), (1, 8192)])
def test_default_sizes_have_the_requested_bytes(height, width, recipe, monkeypatch):
    """Bytes are within 5% (if few: a row), unless the primary is as large as the image or a single texel."""
    single = recipe.structure in PAGED and STRUCTURES[recipe.structure][1] is None
    for channels in (1, 3, 7):
        layout = training.source_layout(from_arrays({"other": noise(8, 8, channels).maps[0].values}), recipe)
        monkeypatch.setattr(fit, "source_layout", lambda source, recipe, layout=layout: layout)
        source = SimpleNamespace(height=height, width=width, nbytes=height * width * channels)
        for compression in (1.5, 6, 12, 48, 200):
            requested = source.nbytes / compression
            size = fit.default_size(source, requested, recipe)
            assert size.nbytes == bytes_of(size, channels)
            assert size.dims == (min(recipe.dims, max(2, channels)) if single else recipe.dims)
            assert size.paged == (recipe.structure in PAGED)
            assert (size.bits, size.coarse) == STRUCTURES[recipe.structure]
            assert 1 <= size.rows <= height and 1 <= size.columns <= width and size.cascaded % 4 == 0
            if size.full:
                assert size.nbytes < 1.05 * requested
            elif size.rows * size.columns == 1:
                assert size.nbytes > requested and size.cascaded == 4
            else:
                more = dataclasses.replace(size, rows=size.rows + 1, columns=size.columns + 1)
                few = requested < 10_000 and size.nbytes <= requested < more.nbytes
                assert few or size.nbytes == pytest.approx(requested, rel=0.05)


def test_the_structure_follows_the_image():
    """Two primary arrays for noise, one for smooth images and few dimensions, else the requested structure."""
    for source, several in ((noise(64, 64), True), (smooth(64), False)):
        chosen = training.choose_structure(source, OURS, source.nbytes / 12)
        assert (STRUCTURES[chosen][1] is not None) == several
        assert training.choose_structure(source, dataclasses.replace(OURS, structure="5 bits"), 1) == "5 bits"
    for dims in (1, 2):
        chosen = training.choose_structure(noise(64, 64), dataclasses.replace(OURS, dims=dims), 1024)
        assert STRUCTURES[chosen][1] is None


# ---------------------- By short trainings ----------------------


def pretend(quality, monkeypatch, interrupt=None):
    """Replace trainings by ``quality(size, recipe)`` in dB; return the calls, (size, recipe) each.

    Ctrl-C comes in the one with the number ``interrupt``.
    """
    calls = []

    def fit_image(source, size, recipe, request, border=None, title=None):
        assert request is REQUEST and recipe.dims == size.dims
        assert STRUCTURES[training.choose_structure(source, recipe, source.nbytes / 12)] == (size.bits, size.coarse)
        calls.append((size, recipe))
        decibel = quality(size, recipe)
        measured = {"psnr_db": decibel, "psnr_between_db": decibel + 2}
        result = FitResult({}, 1, 1, 0.0, len(calls) == interrupt, 0)
        return SimpleNamespace(nbytes=size.nbytes, measured=measured), result

    monkeypatch.setattr(fit, "fit_image", fit_image)
    return calls


def test_ratio_search_finds_a_peak(monkeypatch):
    """A quality that is best for one structure, number of dimensions and side: they are found one after the other."""
    source, base = noise(256, 256), short(structure="6 bits", dims=4)

    def peak(size, recipe):
        other = size.coarse is not None or size.paged
        return 40 - abs(size.bits - 4) - 5 * other - 3 * abs(size.dims - 3) - abs(math.log2(size.cascaded / 16))

    pretend(peak, monkeypatch)
    size, *_ = fit.ratio_search(source, 20_000, base, REQUEST)
    assert (size.dims, size.bits, size.coarse, size.cascaded) == (3, 4, None, 16)
    _, recipe, tried, _ = fit.ratio_search(source, 20_000, base, REQUEST, free=False)
    assert {(t["dims"], t["structure"]) for t in tried} == {(4, "6 bits")}
    assert recipe == base and len(tried) >= 2
    pretend(lambda size, recipe: 40 - abs(size.bits - 3) - 5 * (size.coarse is None), monkeypatch)
    size, *_ = fit.ratio_search(source, 20_000, base, REQUEST)
    assert size.bits == 3 and size.coarse is not None


@pytest.mark.parametrize("interrupt", [1, 3])
def test_ratio_search_is_interrupted(monkeypatch, interrupt):
    """The best of what was tried is kept; candidates are short trainings within the bytes."""
    calls = pretend(lambda size, recipe: 20 + 10 * math.sin(size.nbytes), monkeypatch, interrupt)
    size, chosen, tried, kept = fit.ratio_search(noise(64, 64), 3000, short(steps=400), REQUEST)
    best = max(tried, key=lambda t: t["psnr_db"])
    assert len(tried) == len(calls) == interrupt and kept[1].interrupted
    assert (size.dims, size.cascaded) == (best["dims"], best["cascaded"])
    assert chosen.common == short(steps=400).common and kept[0].measured["psnr_db"] == best["psnr_db"]
    assert all(one.nbytes <= 3150 and recipe.steps == 50 for one, recipe in calls)


# ---------------------- Weights of maps ----------------------


def decibels(weights):
    return {name: 20 * np.log10(weight) for name, weight in weights.items()}


def test_weights_follow_sensitivities():
    """Between the least weights, squares of weights are proportional; decibels of all channels sum to 0."""
    channels = {"albedo": 3, "normal": 2, "ao": 1}
    result = decibels(fit.balance_weights({"albedo": 0.11, "normal": 0.1, "ao": 0.0}, channels))
    assert result["albedo"] - result["normal"] == pytest.approx(10 * np.log10(1.1), abs=0.1)
    assert result["ao"] == pytest.approx(fit.OTHER_DB, abs=0.05)
    assert sum(channels[name] * db for name, db in result.items()) == pytest.approx(0, abs=0.2)
    result = decibels(fit.balance_weights({"albedo": 1e-4, "normal": 1.0, "ao": 0.0}, channels))
    assert result["albedo"] == pytest.approx(fit.SHOWN_DB, abs=0.05)
    assert result["normal"] == pytest.approx(-(3 * fit.SHOWN_DB + fit.OTHER_DB) / 2, abs=0.1)
    assert fit.balance_weights({"albedo": 0.0, "ao": 0.0}, channels) == {}


def test_texts_of_weights():
    assert [parse_weights(text) for text in ("auto", "equal")] == ["auto", "equal"]
    assert parse_weights("a=.5, b=1e1") == {"a": 0.5, "b": 10.0}
    for text in ("", "normal", "normal=0", "normal=-1", "normal=nan", "a=1,b", "a=101", "even"):
        with pytest.raises(ValueError, match="allowed are auto, equal, or maps"):
            parse_weights(text)


@pytest.mark.parametrize("heavy, light", [("left", "right"), ("right", "left")])
def test_initial_arrays_hold_the_heavier_map(heavy, light):
    """Two maps that vary by the same amount along different axes, in arrays with room for one component."""
    waves = np.uint8(127 + 100 * np.sin(np.mgrid[0:32, 0:32] * np.pi / 16))
    source = from_arrays({"left": waves[0], "right": waves[1]})
    recipe = dataclasses.replace(OURS, weights={heavy: 3.0}, structure="8 bits", dims=1)
    problem = training.build_problem(source, fit.default_size(source, 800, recipe), recipe, array_module("llvm"))
    decoded = CompressedImage(problem.layout, problem.net).decode()
    errors = {m.name: float(np.mean((m.values - decoded[m.name]) ** 2)) for m in source.maps}
    assert errors[heavy] < 0.3 * errors[light]
    assert problem.weights[heavy] == pytest.approx(9 * problem.weights[light])


def test_a_file_names_its_weights():
    maps = {"a": np.zeros((16, 16), np.uint8), "b": np.uint8(np.mgrid[0:16, 0:16][0] * 15)}
    maps["a"][3:9] = 200
    given = {"steps": 2, "batch": 64, "progress": False, "compression": 2}
    for weights in ("b=2.5", {"b": 2.5}):
        assert md.fit("image", maps, weights=weights, **given).table.settings["weights"] == {"b": 2.5}
    assert "weights" not in md.fit("image", maps, **given).table.settings
    with pytest.raises(UsageError, match='the map "c", allowed are a, b'):
        md.fit("image", maps, weights="c=2", **given)


def test_weights_as_seen(monkeypatch):
    """A material is weighted by its pictures, where those of initial arrays gain by it."""
    monkeypatch.setattr(as_seen, "SIZE", (16, 12))
    monkeypatch.setattr(as_seen, "sensitivities", lambda source, types: {"normal": 0.2, "ao": 0.0})
    y, x = np.mgrid[0:32, 0:32] * np.pi / 16
    tilted = np.dstack([0.5 + 0.3 * np.sin(x), 0.5 + 0 * x, 0.5 + 0 * x])
    maps = {"normal": np.uint8(255 * tilted), "ao": np.uint8(127 + 80 * np.sin(y))}
    given = {"steps": 1, "batch": 64, "progress": False, "structure": "8 bits", "dims": 1, "compression": 4}
    expected = fit.balance_weights({"normal": 0.2, "ao": 0.0}, {"normal": 3, "ao": 1})
    monkeypatch.setattr(fit, "GAIN_DB", 0.01)
    fitted = md.fit("image", maps, weights="auto", **given)
    assert fitted.table.settings["weights"] == pytest.approx(expected, abs=0.5)
    assert fitted.table.measured["seen_db"] > 0 and fitted.table.measured["angle_normal_deg"] > 0
    monkeypatch.setattr(fit, "GAIN_DB", 100)
    assert "weights" not in md.fit("image", maps, weights="auto", **given).table.settings
