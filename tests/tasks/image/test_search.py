"""Sizes of task 3: by rule, by short trainings, by a wanted quality."""

import dataclasses
import math
import types as python_types

import numpy as np
import pytest

from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.loop import FitResult
from mi_diffind.fitting.task import FitRequest
from mi_diffind.maps.source import from_arrays
from mi_diffind.tasks.image import memory_budget, presets, search, training
from mi_diffind.tasks.image.compressed import CompressedImage
from mi_diffind.tasks.image.memory_budget import ImageBudget
from mi_diffind.tasks.image.presets import PRESETS

OURS, PAPER = PRESETS["ours"], PRESETS["paper"]


pytestmark = pytest.mark.usefixtures("few_samples")


def image(height=16, width=16, channels=3, seed=0, dtype=np.uint8):
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels)).astype(dtype)


def smooth(side=24):
    y, x = 2 * np.pi * np.mgrid[0:side, 0:side] / side
    waves = [np.sin(x), np.cos(y), np.sin(2 * x + y)]
    return np.rint(127.5 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)


def short(recipe=OURS, steps=8, **settings):
    return presets.replaced(recipe, steps=steps, **{"batch": 64, "measure_every": steps, **settings})


#: What a training is asked for, where none takes place.
ASKED = FitRequest("ours", OURS.settings, None)


def asked():
    """What it is asked for where one does."""
    return FitRequest("ours", OURS.settings, array_module("llvm"), progress=False)


def nbytes_of(size, channels):
    """Written out again: bits of the coordinates in each primary, and a byte for each channel of the cascaded array."""
    arrays = [(size.rows, size.columns, size.dims, size.bits)]
    if size.coarse is not None:
        arrays[0] = (size.rows, size.columns, size.dims - size.coarse.dims, size.bits)
        sides = [max(1, round(n * size.coarse.scale)) for n in (size.rows, size.columns)]
        arrays.append((*sides, size.coarse.dims, size.coarse.bits))
    return sum(math.ceil(math.prod(a) / 8) for a in arrays) + channels * size.cascaded**size.dims


# -- by rule ----------------------------------------------------------------------------------------------------------


STRUCTURES = [pytest.param(dataclasses.replace(OURS, structure=name), id=name) for name in presets.STRUCTURES]


SINGLE = [name for name in presets.PAGED if presets.STRUCTURES[name][1] is None]


@pytest.mark.parametrize("recipe", [*STRUCTURES, pytest.param(PAPER, id="paper")])
@pytest.mark.parametrize("height, width", [(128, 128), (1024, 1024), (300, 700), (513, 200), (1, 8192), (4, 8192)])
def test_default_size_is_what_was_asked_for(height, width, recipe, monkeypatch):
    """Within 5% (if few: a row), unless the primary is as large as the image, or it is a single texel already."""
    for channels in (1, 3, 4, 7):
        layout = training.layout_of(from_arrays({"other": image(8, 8, channels)}), recipe)
        assert layout.stored == channels
        monkeypatch.setattr(search, "layout_of", lambda source, recipe, layout=layout: layout)
        source = python_types.SimpleNamespace(height=height, width=width, nbytes=height * width * channels)
        near = 0
        for compression in (1.5, 3, 6, 12, 24, 48, 200):
            asked = source.nbytes / compression
            size = search.default_size(source, asked, recipe)
            assert size.nbytes == nbytes_of(size, channels)
            dims = min(recipe.dims, max(2, channels)) if recipe.structure in SINGLE else recipe.dims
            assert (size.channels, size.dims) == (channels, dims)
            assert size.paged == (recipe.structure in presets.PAGED)
            assert (size.bits, size.coarse) == presets.STRUCTURES[recipe.structure]
            assert 1 <= size.rows <= height and 1 <= size.columns <= width and size.cascaded % 4 == 0
            if size.full:
                assert size.nbytes < 1.05 * asked
            elif size.rows * size.columns == 1:
                assert size.nbytes > asked and size.cascaded == 4
            else:
                more = dataclasses.replace(size, rows=size.rows + 1, columns=size.columns + 1)
                few = asked < 10_000 and size.nbytes <= asked < more.nbytes
                assert few or size.nbytes == pytest.approx(asked, rel=0.05)
                near += 1
        assert near >= 2


def test_sizes_of_tiny_images_are_the_smallest_there_are():
    for array in (image(1, 1), image(7, 5), image(1, 30)):
        source = from_arrays({"image": array})
        for recipe in (OURS, PAPER):
            size = search.default_size(source, source.nbytes / 12, recipe)
            stored = training.layout_of(source, recipe).stored
            assert (size.rows, size.columns, size.cascaded) == (1, 1, 4) and size.channels == max(1, stored)


def test_the_structure_follows_the_image():
    """Two primary arrays for noise, one for what is smooth and for few dimensions, what was asked for otherwise."""
    noise, waves = from_arrays({"image": image(64, 64)}), from_arrays({"image": smooth(64)})
    for source, several in ((noise, True), (waves, False)):
        found = training.structure_of(source, dataclasses.replace(OURS, structure="auto", dims=4))
        assert (presets.STRUCTURES[found][1] is not None) == several
        for name in presets.STRUCTURES:
            assert training.structure_of(source, dataclasses.replace(OURS, structure=name)) == name
    for dims in (1, 2):
        assert presets.STRUCTURES[training.structure_of(noise, dataclasses.replace(OURS, dims=dims))][1] is None


def test_a_size_with_a_given_side():
    source = from_arrays({"image": image(64, 64)})
    for dims, side in ((4, 6), (3, 11), (2, 30), (1, 200)):
        recipe = dataclasses.replace(OURS, dims=dims, structure="5 bits")
        size = search.sized(source, 8000, recipe, side)
        assert (size.cascaded, size.dims, size.bits) == (side, dims, 5)
        more = dataclasses.replace(size, rows=size.rows + 1, columns=size.columns + 1)
        assert size.nbytes <= 8000 and (size.full or more.nbytes > 8000)


# -- by short trainings -----------------------------------------------------------------------------------------------


def pretended(quality, monkeypatch, interrupt=None):
    """
    Replace trainings: ``quality(size, recipe)`` in dB instead. Returns the calls, (size, recipe) each; Ctrl-C comes in
    the one with the number ``interrupt``.
    """
    calls = []

    def fit_image(source, size, recipe, request, border=None, title=None):
        assert request is ASKED
        calls.append((size, recipe))
        assert recipe.dims == size.dims
        assert presets.STRUCTURES[training.structure_of(source, recipe)] == (size.bits, size.coarse)
        decibel = quality(size, recipe)
        table = python_types.SimpleNamespace(
            nbytes=size.nbytes, measured={"psnr_db": decibel, "psnr_between_db": decibel + 2}
        )
        return table, FitResult({}, 1, 1, 0.0, len(calls) == interrupt, 0)

    monkeypatch.setattr(search, "fit_image", fit_image)
    return calls


def test_ratio_search_picks_the_best_that_it_tried(monkeypatch):
    source = from_arrays({"image": image(64, 64)})
    for seed in range(10):
        rng = np.random.default_rng(seed)
        calls = pretended(lambda size, recipe, rng=rng: rng.uniform(20, 40), monkeypatch)
        found = search.ratio_search(source, 3000, short(steps=400), ASKED)
        assert len(found.tried) == len(calls) >= 3 and not found.interrupted
        best = max(found.tried, key=lambda t: t["psnr_db"])
        assert (found.size.dims, found.size.cascaded) == (best["dims"], best["cascaded"])
        assert (found.size.bits, found.size.coarse) == presets.STRUCTURES[best["structure"]]
        assert (found.recipe.dims, found.recipe.structure) == (best["dims"], best["structure"])
        assert found.recipe.settings == short(steps=400).settings  # not those of the short trainings
        assert found.best[0].measured["psnr_db"] == best["psnr_db"]
        for t, (size, recipe) in zip(found.tried, calls, strict=True):
            assert t["bytes"] == size.nbytes == nbytes_of(size, 3) <= 3000 * 1.05
            assert recipe.settings.steps == 50
        assert len({(t["dims"], t["structure"], t["cascaded"]) for t in found.tried}) == len(calls)  # none twice


def test_ratio_search_finds_a_peak(monkeypatch):
    """A quality that is best for one structure, number of dimensions and side: it gets there one after the other."""
    source = from_arrays({"image": image(256, 256)})
    base = dataclasses.replace(short(), structure="6 bits", dims=4)

    def peak(size, recipe):
        other = size.coarse is not None or size.paged
        return 40 - abs(size.bits - 4) - 5 * other - 3 * abs(size.dims - 3) - abs(math.log2(size.cascaded / 16))

    pretended(peak, monkeypatch)
    found = search.ratio_search(source, 20_000, base, ASKED)
    assert (found.size.dims, found.size.bits, found.size.coarse, found.size.cascaded) == (3, 4, None, 16)
    held = search.ratio_search(source, 20_000, base, ASKED, free=False)  # sides only
    assert {(t["dims"], t["structure"]) for t in held.tried} == {(4, "6 bits")}
    assert held.recipe == base and len(held.tried) >= 2

    pretended(lambda size, recipe: 40 - abs(size.bits - 3) - 5 * (size.coarse is None), monkeypatch)
    found = search.ratio_search(source, 20_000, base, ASKED)
    assert found.size.bits == 3 and found.size.coarse is not None


def test_ratio_search_where_nothing_fits(monkeypatch):
    source = from_arrays({"image": image(7, 5)})
    calls = pretended(lambda size, recipe: 30, monkeypatch)
    for recipe in (OURS, PAPER):
        found = search.ratio_search(source, 20, recipe, ASKED, recipe is OURS)
        assert found.tried == [] and not calls and found.recipe == recipe
        assert found.size == search.default_size(source, 20, recipe)


def test_ratio_search_is_interrupted(monkeypatch):
    source = from_arrays({"image": image(64, 64)})
    for when in (1, 2, 3):
        rng = np.random.default_rng(when)
        calls = pretended(lambda size, recipe, rng=rng: rng.uniform(20, 40), monkeypatch, interrupt=when)
        found = search.ratio_search(source, 3000, short(), ASKED)
        assert found.interrupted and len(calls) == len(found.tried) == when
        assert found.best[0].measured["psnr_db"] == max(t["psnr_db"] for t in found.tried)


def test_ratio_search_is_deterministic():
    source = from_arrays({"image": smooth(16)})
    recipe = short(dataclasses.replace(OURS, dims=2), steps=20)
    runs = [search.ratio_search(source, 1000, recipe, asked(), free=False) for _ in range(2)]
    assert runs[0].tried == runs[1].tried and runs[0].size == runs[1].size and len(runs[0].tried) >= 1
    table, _ = runs[0].best
    assert table.nbytes == max(runs[0].tried, key=lambda t: t["psnr_db"] + t["psnr_between_db"])["bytes"]


# -- by quality -------------------------------------------------------------------------------------------------------


def by_bytes(slope, bend=0.0, wobble=0.0):
    """Quality over bytes: so many dB an octave, fewer the more there are, and not quite monotonic."""

    def quality(size, recipe):
        octaves = math.log2(size.nbytes / 1000)
        return 25 + slope * octaves - bend * octaves**2 + wobble * math.sin(9 * octaves)

    return quality


@pytest.mark.parametrize("slope, bend, wobble", [(2.5, 0, 0), (0.8, 0, 0), (6, 0, 0), (2.5, 0.15, 0), (2, 0, 0.4)])
@pytest.mark.parametrize("goal", [20, 25.001, 29, 31.5])
def test_quality_search_is_small_enough(monkeypatch, slope, bend, wobble, goal):
    source = from_arrays({"image": image(256, 256)})
    quality = by_bytes(slope, bend, wobble)
    calls, log = pretended(quality, monkeypatch), []
    table, result, tried = search.psnr_search(source, goal, short(), ASKED, log=log.append)
    assert len(tried) == len(calls) == len(log) <= 8
    assert [t["bytes"] for t in tried] == [size.nbytes for size, _ in calls]
    reached = [t["bytes"] for t in tried if t["psnr_db"] >= goal]
    if table is None:  # not even the largest one does
        assert not reached and max(quality(size, None) for size, _ in calls) < goal
        assert calls[-1][0].full or len(tried) == 8
        return
    assert table.measured["psnr_db"] >= goal and table.nbytes == min(reached) and not result.interrupted
    missed = [t["bytes"] for t in tried if t["psnr_db"] < goal and t["bytes"] < table.nbytes]
    if wobble == 0 and len(tried) < 8 and missed:
        assert table.nbytes <= 1.1 * max(missed)  # few rows more make more than NEAR of a small file
    if wobble == 0 and missed:
        assert table.nbytes <= 2 * max(missed)


def test_quality_search_needs_few_trainings(monkeypatch):
    """Where quality rises by so much an octave as is supposed."""
    source = from_arrays({"image": image(256, 256)})
    for goal in (26, 28, 30, 32):
        calls = pretended(by_bytes(2.5), monkeypatch)
        table, *_ = search.psnr_search(source, goal, short(), ASKED, log=lambda text: None)
        exact = 1000 * 2 ** ((goal - 25) / 2.5)
        assert exact <= table.nbytes < 1.07 * exact and len(calls) <= 6


def test_quality_search_without_success(monkeypatch):
    """It ends at a primary as large as the image, at the latest after ``most`` trainings."""
    source = from_arrays({"image": image(64, 64)})
    calls = pretended(by_bytes(2.5), monkeypatch)
    table, result, tried = search.psnr_search(source, 100, short(), ASKED, log=lambda text: None)
    assert table is None and result is None and calls[-1][0].full and len(tried) == len(calls)
    assert not any(size.full for size, _ in calls[:-1])
    calls = pretended(by_bytes(0), monkeypatch)
    assert search.psnr_search(source, 100, short(), ASKED, most=1, log=lambda text: None)[0] is None and len(calls) == 1


def test_quality_search_below_the_smallest(monkeypatch):
    source = from_arrays({"image": image(64, 64)})
    calls = pretended(by_bytes(0), monkeypatch)
    table, _, tried = search.psnr_search(source, 1, short(), ASKED, log=lambda text: None)
    smallest = search.sized(source, 1, short(), 4)
    assert table.nbytes == smallest.nbytes == min(t["bytes"] for t in tried) and len(calls) < 8


def test_quality_search_is_interrupted(monkeypatch):
    """What was reached before is kept; without that there is nothing to keep."""
    source = from_arrays({"image": image(256, 256)})
    start = by_bytes(2.5)(search.default_size(source, source.nbytes / 12, short()), None)
    calls = pretended(by_bytes(2.5), monkeypatch, interrupt=2)
    table, result, tried = search.psnr_search(source, start - 5, short(), ASKED, log=lambda text: None)
    assert len(tried) == len(calls) == 2 and result.interrupted
    assert table.nbytes == min(t["bytes"] for t in tried if t["psnr_db"] >= start - 5)
    pretended(by_bytes(2.5), monkeypatch, interrupt=1)
    with pytest.raises(KeyboardInterrupt):
        search.psnr_search(source, start + 5, short(), ASKED, log=lambda text: None)


def test_quality_search_with_trainings():
    """The file that comes out has the quality that was asked for, by its own decoded image."""
    values = smooth(24)
    source = from_arrays({"image": values})
    recipe = short(dataclasses.replace(OURS, dims=3), steps=30, batch=576, lr=1e-2)
    goal = 24.0
    table, _, tried = search.psnr_search(source, goal, recipe, asked(), most=4, log=lambda text: None)
    decoded = CompressedImage.of(table, array_module("llvm").TensorXf).decode()["image"]
    assert -10 * np.log10(np.mean((decoded - values / 255.0) ** 2)) > goal - 0.01
    assert table.nbytes == min(t["bytes"] for t in tried if t["psnr_db"] >= goal)


def test_sides_to_try_can_be_read():
    """Each side is within what the rule allows, and what the rule says is among them or smaller than they are."""
    for dims, sides in search.SIDES.items():
        assert max(sides) <= memory_budget.CASCADED_LIMITS[dims - 1] and list(sides) == sorted(sides)
        assert all(side % memory_budget.CASCADED_STEP == 0 for side in sides)
        assert ImageBudget(1, 1, max(sides), 16, dims).nbytes < 2**21
