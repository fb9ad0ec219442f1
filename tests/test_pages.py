"""Arrays of pages: reads against NumPy, gradients, storage forms and files, and which page gets which resolution."""

import dataclasses
import math

import drjit as dr
import numpy as np
import pytest
from arrays import aligned
from scipy.ndimage import map_coordinates

from mi_diffind.arrays.indirection import DifferentiableArray, Indirection, unfolded
from mi_diffind.arrays.pages import (
    PagedArray,
    page_counts,
    page_entries,
    page_gain,
    page_positions,
    page_shift,
    page_sizes,
)
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import FitRequest
from mi_diffind.maps.source import from_arrays
from mi_diffind.tasks.image import PAGED, PRESETS, fit, training

SHAPES = {1: (7,), 2: (5, 3), 3: (2, 3, 2)}


def random_sizes(dims, seed=0):
    """Among them, in two dimensions, pages of 1 × 1, 1 × n and n × 1."""
    found = np.random.default_rng(seed).integers(1, {1: 40, 2: 18, 3: 6}[dims], (*SHAPES[dims], dims))
    if dims == 2:
        found[0, :, :] = [(1, 1), (1, 6), (6, 1)]
    return found


def pages_of(entries, sizes):
    """The entries of each page, in its shape."""
    flat = sizes.reshape(-1, sizes.shape[-1])
    parts = np.split(entries, np.cumsum(flat.prod(axis=1))[:-1])
    return [part.reshape(*size, -1) for part, size in zip(parts, flat, strict=True)]


def reference(entries, sizes, x, shift, border):
    """What is read at ``x``, ``(samples, d)``, in float64: SciPy's first-order spline of its page."""
    counts, pages = np.array(sizes.shape[:-1]), pages_of(np.asarray(entries, np.float64), sizes)
    t = np.where(np.array(border) == "repeat", x - np.floor(x), x) * counts - shift
    t = np.where((np.array(border) == "repeat") & (t < 0), t + counts, np.clip(t, 0, counts))
    which = np.minimum(np.floor(t), counts - 1).astype(int)
    number, place, found = np.ravel_multi_index(which.T, counts), t - which, np.empty((len(x), entries.shape[1]))
    for i in np.unique(number):
        here, table = number == i, pages[i]
        position = place[here].T * (np.array(table.shape[:-1]) - 1)[:, None]
        found[here] = np.stack([map_coordinates(table[..., c], position, order=1) for c in range(table.shape[-1])], -1)
    return found


def places(dims, count=400, seed=1, low=-0.3, high=1.3):
    """None where two pages meet: rounding decides there which is read."""
    return np.random.default_rng(seed).uniform(low, high, (count, dims)).astype(np.float32)


def read(arrays, ad, x):
    """Values of one array, or of each of several, in one kernel: ``(len(x), channels)``."""
    several = isinstance(arrays, list)
    x = [ad.Float(aligned(v)) for v in x.T]
    values = [array(x) for array in (arrays if several else [arrays])]
    dr.eval(values)
    found = [np.stack([np.broadcast_to(v.numpy(), len(x[0])) for v in channels], axis=-1) for channels in values]
    return found if several else found[0]


# -- reading ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("border", ["clamp", "repeat"])
@pytest.mark.parametrize("dims", [1, 2, 3])
def test_values(ad, dims, border):
    """Against NumPy in float64, in all storage forms, for each number of channels that is stored differently."""
    sizes, x, shift = random_sizes(dims), places(dims), (0.3,) * dims
    for channels in (1, 2, 3, 5):
        entries = np.random.default_rng(channels).random((sizes.prod(axis=-1).sum(), channels)).astype(np.float32)
        array = PagedArray(sizes, channels, entries, shift, border=border).alloc(ad.TensorXf)
        expected = reference(entries, sizes, x.astype(np.float64), shift, (border,) * dims)
        bits = [(array.to("uint8"), 255), (array.quantised(6), 63), (array.quantised(3), 7)]
        single, half, *found = read([array, array.to("float16"), *(stored for stored, _ in bits)], ad, x)
        np.testing.assert_allclose(single, expected, atol=2e-5)
        np.testing.assert_allclose(half, expected, atol=2e-3)
        for (stored, steps), values in zip(bits, found, strict=True):
            assert np.abs(stored.numpy() - entries).max() < 0.51 / steps
            rounded = reference(stored.numpy(), sizes, x.astype(np.float64), shift, (border,) * dims)
            np.testing.assert_allclose(values, rounded, atol=2e-5)


def test_one_page_is_an_ordinary_array(ad):
    """Values and all gradients."""
    entries = np.random.default_rng(0).uniform(-1, 3, (5, 7, 4)).astype(np.float32)
    plain = DifferentiableArray((5, 7), 4, entries, fold=True).alloc(ad.TensorXf)
    paged = PagedArray([[[5, 7]]], 4, entries.reshape(-1, 4), fold=True).alloc(ad.TensorXf)
    x = places(2, low=0.01, high=0.99)
    gradients = []
    for array in (plain, paged):
        inputs = [ad.Float(np.ascontiguousarray(v)) for v in x.T]
        dr.enable_grad(inputs, array.data)
        values = array(inputs)
        dr.backward(sum((k + 1) * dr.square(v) for k, v in enumerate(values)))
        of_entries = dr.grad(array.data).numpy().reshape(35, 4)
        gradients.append([dr.detach(v).numpy() for v in values] + [dr.grad(v).numpy() for v in inputs] + [of_entries])
    for one, two in zip(*gradients, strict=True):
        np.testing.assert_allclose(one, two, rtol=1e-4, atol=1e-4)
        assert np.abs(one).max() > 0.1


def test_entries_take_part_in_their_page_only(ad):
    """The gradient of a read is that of its own page, whose weights sum to 1."""
    sizes = random_sizes(2)
    array = PagedArray(sizes, 1, fold=True).alloc(ad.TensorXf)
    for page in np.ndindex(5, 3):
        dr.enable_grad(array.data)
        x = [ad.Float((i + 0.37) / n) for i, n in zip(page, (5, 3), strict=True)]
        dr.backward(array(x)[0])
        sums = [part.sum() for part in pages_of(dr.grad(array.data).numpy(), sizes)]
        assert np.argmax(sums) == np.ravel_multi_index(page, (5, 3))
        np.testing.assert_allclose(np.sort(sums), [0] * 14 + [1], atol=1e-5)
        array.data = type(array.data)(dr.detach(array.data))


@pytest.mark.parametrize("border", ["clamp", "repeat"])
def test_no_coordinate_leads_outside(ad, border):
    """Entries are read that exist, whatever the coordinate is: all are 1, what lies behind them is 0 or nothing."""
    special = [0, 1, -0.0, 1 - 2**-24, 2**-149, -(2**-149), 2, -1, 1e30, -1e30, math.inf, -math.inf, math.nan, 0.5]
    u, v = (g.ravel() for g in np.meshgrid(special, special))
    arrays = [PagedArray(random_sizes(2), 3, 1.0, s, border=border).alloc(ad.TensorXf) for s in (0.0, 0.03, 1.0)]
    for values in read([*arrays, *(array.quantised(6) for array in arrays)], ad, np.stack([u, v], axis=1)):
        np.testing.assert_allclose(values, 1, atol=1e-6)


def test_masked_lanes_are_zero(ad):
    array = PagedArray(random_sizes(2), 2, 0.5).alloc(ad.TensorXf)
    active = ad.Bool([True, False])
    for form in (array, array.to("uint8")):
        for value in form([ad.Float(0.2, 0.3), ad.Float(0.7, 0.1)], active):
            np.testing.assert_allclose(value.numpy(), [0.5, 0])


def test_the_index_is_no_parameter(ad):
    net = Indirection(PagedArray(random_sizes(2), 2, fold=True), DifferentiableArray((4, 4), 3)).alloc(ad.TensorXf)
    assert sorted(net) == ["cascaded.data", "primary.0.data"]
    copy = unfolded(net)
    assert isinstance(copy.primary[0], PagedArray) and not copy.primary[0].folded


def test_bytes():
    """By hand: two bits for each of three channels of 10 entries, and two times five bits for each of two pages."""
    array = PagedArray([[[1, 1], [3, 3]]], 3).alloc(array_module("llvm").TensorXf).quantised(2)
    assert array.entries == 10 and array.nbytes == math.ceil(10 * 3 * 2 / 8) + math.ceil(2 * 10 / 8)


@pytest.mark.parametrize(
    "arguments, word",
    [
        (([[1, 1]],), "sizes"),
        (([[[0, 1]]],), "sizes"),
        (([[[33, 1]]],), "sizes"),
        (([[[1.5, 1]]],), "sizes"),
        ((np.full((65, 64, 2), 32),), "entries"),
        (([[[2, 2]]], 3, np.zeros((5, 3))), "init"),
        (([[[2, 2]]], 3, 0.5, 1.5), "shift"),
        (([[[2, 2]]], 0), "channels"),
    ],
)
def test_impossible_settings(arguments, word):
    with pytest.raises(ValueError, match=word):
        PagedArray(*arguments)


# -- which resolution, which entries ----------------------------------------------------------------------------------


def half_empty(side=64, seed=0):
    """Noise that is smooth over two texels in one corner, one colour elsewhere."""
    values = np.full((side, side, 3), 0.25, np.float32)
    noise = np.random.default_rng(seed).random((side // 4, side // 4, 3))
    values[: side // 2, : side // 2] = np.kron(noise, np.ones((2, 2, 1)))
    return values


def texel_centres(ad, height, width):
    y, x = np.mgrid[0:height, 0:width]
    return np.stack([(y.ravel() + 0.5) / height, (x.ravel() + 0.5) / width], axis=1)


@pytest.mark.parametrize("border", ["clamp", "repeat"])
@pytest.mark.parametrize("height, width", [(32, 48), (37, 20), (16, 5)])
def test_pages_as_fine_as_an_image_hold_it(ad, height, width, border):
    values = np.random.default_rng(0).random((height, width, 2)).astype(np.float32)
    sizes = np.full((*page_counts((height, width)), 2), 17)
    if height % 16 or width % 16:  # pages are then no whole number of texels wide: what is bilinear comes back
        values[...] = (np.arange(height)[:, None, None] + [1, 2]) / (2 * height) if border == "clamp" else 0.3
    entries, both = page_entries(values, (border,) * 2, sizes), (border,) * 2
    array = PagedArray(sizes, 2, entries, page_shift((height, width)), border=both).alloc(ad.TensorXf)
    found = read(array, ad, texel_centres(ad, height, width)).reshape(values.shape)
    last = -1 if (height, border) == (37, "clamp") else None  # where the ramp ends, between two samples of its page
    np.testing.assert_allclose(found[:last], values[:last], atol=1e-4)


def test_entries_are_the_best_fit(ad):
    """Of a page in the middle, against the least squares of what its reads depend on."""
    rng = np.random.default_rng(1)
    values = rng.random((48, 48, 1)).astype(np.float32)
    sizes = np.ones((3, 3, 2), int)
    sizes[1, 1] = (5, 3)
    found = pages_of(page_entries(values, ("clamp", "clamp"), sizes), sizes)[4]
    tents = [[np.interp(np.arange(17), np.linspace(0, 16, n), e) for e in np.eye(n)] for n in (5, 3)]
    ends = np.where(np.arange(17) % 16 == 0, 0.5, 1)
    weights, window = np.outer(ends, ends), values[16:33, 16:33, 0]
    matrix = np.kron(*(np.transpose(t) for t in tents)) * np.sqrt(weights.reshape(-1, 1))
    expected = np.linalg.lstsq(matrix, (window * np.sqrt(weights)).ravel(), rcond=None)[0]
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-4)
    constant = pages_of(page_entries(values, ("clamp", "clamp"), sizes), sizes)[0]
    assert constant.item() == pytest.approx(np.average(values[:17, :17, 0], weights=weights), abs=1e-5)


def test_empty_pages_have_one_entry():
    for entries in (60, 400, 1500):
        sizes = page_sizes(half_empty(), ("clamp", "clamp"), entries)
        assert sizes.shape == (4, 4, 2) and sizes.prod(axis=2).sum() <= entries
        assert (sizes[3, :] == 1).all() and (sizes[:, 3] == 1).all()
        assert sizes[:2, :2].prod(axis=2).sum() > 0.55 * entries


def test_equal_pages_share_what_there_is():
    """No resolution fits all of them: some get the next one."""
    tile = np.random.default_rng(0).random((16, 16, 1))
    for entries in (4000, 5200, 6400):
        sizes = page_sizes(np.tile(tile, (8, 8, 1)).astype(np.float32), ("repeat", "repeat"), entries)
        assert 0.9 * entries <= sizes.prod(axis=2).sum() <= entries


def test_resolution_follows_direction():
    """Stripes along u need no entries along it."""
    values = np.repeat(np.random.default_rng(0).random((64, 1, 1)), 64, axis=1).astype(np.float32)
    sizes = page_sizes(values, ("clamp", "clamp"), 300)
    assert (sizes[..., 1] == 1).all() and (sizes[..., 0] > 10).all()


def test_the_gain_tells_images_apart(ad):
    """It is what reading the fitted pages shows; where content is everywhere the same there is none."""
    values, border = half_empty(), ("clamp", "clamp")
    gain, psnr = page_gain(values, border, 500)
    sizes = page_sizes(values, border, 500)
    array = PagedArray(sizes, 3, page_entries(values, border, sizes), page_shift((64, 64))).alloc(ad.TensorXf)
    error = np.mean(np.sum((read(array, ad, texel_centres(ad, 64, 64)).reshape(values.shape) - values) ** 2, axis=-1))
    assert gain > 3 and psnr == pytest.approx(-10 * math.log10(error), abs=1.0)
    noise = np.random.default_rng(0).random((64, 64, 3)).astype(np.float32)
    assert page_gain(noise, border, 500)[0] < 1


def test_positions_of_entries():
    found = page_positions(np.array([[[2, 3], [1, 2]]]), (0.0, 0.25))
    expected = [(a, (b + 0.25) / 2) for a in (0, 1) for b in (0, 0.5, 1)] + [(0.5, 1.25 / 2), (0.5, 2.25 / 2)]
    np.testing.assert_allclose(found, expected)


# -- images -----------------------------------------------------------------------------------------------------------


def short(structure, steps=30, **changes):
    recipe = dataclasses.replace(PRESETS["ours"], steps=steps, batch=4096, measure_every=steps)
    return dataclasses.replace(recipe, structure=structure, **changes)


def trained(ad, recipe, nbytes=1500):
    source = from_arrays({"albedo": np.rint(255 * half_empty()).astype(np.uint8)})
    size = fit.default_size(source, nbytes, recipe)
    asked = FitRequest("ours", recipe, ad, progress=False)
    return training.fit_image(source, size, recipe, asked)[0]


def test_pages_are_chosen_and_win(ad):
    """An image with an empty part, in as many bytes and steps; a homogeneous one gets none."""
    paged, dense = trained(ad, short("auto")), trained(ad, short("6 bits"))
    assert paged.settings["structure"] in PAGED and dense.settings["structure"] == "6 bits"
    assert paged.nbytes <= 1.01 * dense.nbytes
    assert paged.measured["psnr_db"] > dense.measured["psnr_db"] + 2
    noise = from_arrays({"albedo": np.random.default_rng(0).integers(0, 255, (64, 64, 3)).astype(np.uint8)})
    assert training.choose_structure(noise, short("auto"), 1500) not in PAGED
    assert training.choose_structure(noise, short("auto", components=False), 1500) not in PAGED
