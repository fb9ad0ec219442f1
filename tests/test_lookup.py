"""Multilinear reads against an independent interpolation: SciPy's, in float64.

SciPy does not know our borders: a clamped axis has its entries at ``i / (N − 1)`` and the coordinate is clipped, a
repeating one at ``i / N`` with the first entry appended once more.
"""

import itertools

import drjit as dr
import numpy as np
import pytest
from arrays import aligned
from scipy.interpolate import RegularGridInterpolator

from mi_diffind import DifferentiableArray
from mi_diffind.arrays import lookup
from mi_diffind.arrays.lookup import PART, pack_bits, unpack_bits
from mi_diffind.core.runtime import array_module

CHANNELS = (1, 2, 3, 4, 7, 12)
RESOLUTION = (5, 4, 6, 3)
DENORMAL = 1e-45

#: The smallest single-precision number that is no denormal.
SMALLEST_NORMAL = 2.0**-126
BELOW_ONE = float(np.nextafter(np.float32(1), np.float32(0)))
ABOVE_ONE = float(np.nextafter(np.float32(1), np.float32(2)))
SPECIAL = (
    0.0, -0.0, 1.0, BELOW_ONE, ABOVE_ONE, DENORMAL, -DENORMAL, 1e-38, -1e-38, -1e-9, 0.5, 2.0, -1.0,
    -5.3, 7.25, 1e9, -1e9, 3.4e38, -3.4e38, np.inf, -np.inf, np.nan,
)  # fmt: skip


def borders(dims):
    """Both borders everywhere, and mixed ones."""
    alternating = [("clamp", "repeat")[k % 2] for k in range(dims)]
    choices = {("clamp",) * dims, ("repeat",) * dims, tuple(alternating), tuple(reversed(alternating))}
    return sorted(choices)


def entries(rng, resolution, channels):
    """Random entries in [0.5, 1.5]: away from zero, so that a relative error means something for each value."""
    return rng.uniform(0.5, 1.5, (*resolution, channels)).astype(np.float32)


def normalised(x, border):
    """The coordinate that the documentation says is read, in float64."""
    x = np.asarray(x, np.float64)
    if border == "clamp":
        return np.where(np.isnan(x), 0.0, np.clip(x, 0, 1))
    return np.where(np.isfinite(x), np.mod(np.where(np.isfinite(x), x, 0), 1), 0.0)


def reference(table, x, border):
    """The interpolated values, shape ``(samples, channels)``; ``x`` has the shape ``(samples, dims)``."""
    table = np.asarray(table, np.float64)
    points, grid = [], []
    for axis, kind in enumerate(border):
        n = table.shape[axis]
        points.append(normalised(x[:, axis], kind))
        if kind == "repeat" or n == 1:
            table = np.concatenate([table, np.take(table, [0], axis)], axis)
        grid.append(np.linspace(0, 1, table.shape[axis]))
    return RegularGridInterpolator(grid, table)(np.stack(points, axis=-1))


def read(array, ad, x, **kwargs):
    x = np.asarray(x, np.float32)
    values = array([ad.Float(aligned(v)) for v in x.T], **kwargs)
    dr.eval(values)  # one kernel, not one a channel
    return np.stack([np.broadcast_to(v.numpy(), len(x)) for v in values], axis=-1)


def assert_interpolated(array, values, x, border):
    """To a relative error of 1e-5; packed reads in 1D and 2D, with 7 bits below bytes, by 1/64 of a byte more."""
    slack = np.asarray(array.scale) / 64 if array.storage == "uint8" and array.dims <= 2 else 0
    expected = reference(array.numpy(), x, border)
    assert (np.abs(values - expected) <= 1e-5 * np.abs(expected) + slack).all()


def inside(rng, samples, resolution, border):
    """Random coordinates well inside a cell each (periods away, if the border allows it), where slopes exist."""
    columns = []
    for n, kind in zip(resolution, border, strict=True):
        cells = n if kind == "repeat" else max(1, n - 1)
        x = (rng.integers(cells, size=samples) + rng.uniform(0.05, 0.95, samples)) / cells
        columns.append(x + (rng.integers(-2, 3, samples) if kind == "repeat" else 0))
    return np.stack(columns, axis=-1).astype(np.float32)


def assert_slopes(point, table, x, border, weight, rtol):
    """Gradients of the coordinates are central differences of the weighted sum of the reference."""
    for k, v in enumerate(point):
        h = 1e-5 * np.eye(len(point))[k]
        slope = (reference(table, x + h, border) - reference(table, x - h, border)) @ weight / 2e-5
        np.testing.assert_allclose(v.grad.numpy(), slope, rtol=rtol, atol=rtol / 10 * np.abs(slope).max())


@pytest.mark.parametrize("storage", lookup.STORAGES)
@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("dims", [1, 2, 3, 4])
def test_values_equal_scipy(ad, dims, channels, storage):
    """Each storage form interpolates what it holds to 1e-5, inside and outside [0, 1], with all borders."""
    rng = np.random.default_rng(100 * dims + channels)
    resolution = RESOLUTION[:dims]
    table = entries(rng, resolution, channels)
    x = rng.uniform(-1.2, 2.2, (300, dims)).astype(np.float32)
    x[:200] = np.mod(x[:200], 1)
    # Kernels with many half-precision gathers take long to compile: one border each, in turn.
    chosen = borders(dims)[channels % len(borders(dims)) :][:1] if storage == "float16" else borders(dims)
    for border in chosen:
        array = DifferentiableArray.from_numpy(table, ad.TensorXf, border, storage)
        values, held = read(array, ad, x), array.numpy()
        assert values.shape == (300, channels)
        assert_interpolated(array, values, x, border)
        if storage == "uint8":
            half_step = (table.max(axis=tuple(range(dims))) - table.min(axis=tuple(range(dims)))) / 255 / 2
            assert (np.abs(values - reference(table, x, border)) <= half_step * 1.001 + 1e-6).all()
            assert (np.abs(held - table) <= half_step * 1.001).all()
        elif storage == "float16":
            np.testing.assert_array_equal(held, table.astype(np.float16).astype(np.float32))
        else:
            np.testing.assert_array_equal(held, table)


@pytest.mark.parametrize("storage", lookup.STORAGES)
@pytest.mark.parametrize("channels", [1, 2, 3])
@pytest.mark.parametrize("resolution", [(1,), (1, 3), (3, 1), (1, 1), (2, 1, 3), (1, 4, 1), (1, 2, 1, 2), (2, 2)])
def test_one_entry_along_an_axis(ad, resolution, channels, storage):
    """A single entry is constant along its axis, and has no slope."""
    rng = np.random.default_rng(7)
    x = rng.uniform(-0.5, 1.5, (100, len(resolution))).astype(np.float32)
    for border in borders(len(resolution)):
        table = entries(rng, resolution, channels)
        array = DifferentiableArray.from_numpy(table, ad.TensorXf, border, storage)
        assert_interpolated(array, read(array, ad, x), x, border)
        point = [ad.Float(aligned(x[:, k])) for k in range(len(resolution))]
        dr.enable_grad(point)
        dr.backward(sum(array(point)), flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
        for n, v in zip(resolution, point, strict=True):
            assert n > 1 or not v.grad.numpy().any()


@pytest.mark.parametrize("storage", lookup.STORAGES)
@pytest.mark.parametrize("border", lookup.BORDERS)
@pytest.mark.parametrize("channels", [1, 2, 3])
@pytest.mark.parametrize("dims", [1, 2, 4])
def test_special_coordinates(ad, dims, channels, border, storage):
    """Exact ends, neighbours of the ends, NaN, infinities, denormals, far away: each along each axis."""
    rng = np.random.default_rng(dims)
    table = entries(rng, RESOLUTION[:dims], channels)
    array = DifferentiableArray.from_numpy(table, ad.TensorXf, border, storage)
    x = rng.uniform(0, 1, (dims * len(SPECIAL), dims)).astype(np.float32)
    for axis in range(dims):
        x[axis * len(SPECIAL) : (axis + 1) * len(SPECIAL), axis] = SPECIAL
    x = np.concatenate([x, np.repeat(np.float32(SPECIAL)[:, None], dims, axis=1)])
    values = read(array, ad, x)
    assert_interpolated(array, values, x, (border,) * dims)


@pytest.mark.parametrize("storage", lookup.STORAGES)
@pytest.mark.parametrize("border", lookup.BORDERS)
def test_no_bit_pattern_leads_outside_the_table(ad, border, storage):
    """Any 32 bits as a coordinate: the weights sum to one over entries of the table."""
    bits = np.random.default_rng(5).integers(0, 2**32, (20000, 3), dtype=np.uint32)
    x = bits.view(np.float32)
    for resolution, channels in (((3, 2, 5), 1), ((2, 3, 2), 3)):
        table = np.full((*resolution, channels), 3.0, np.float32)
        table[0] = 2.0
        array = DifferentiableArray.from_numpy(table, ad.TensorXf, border, storage)
        values = read(array, ad, x)
        assert np.isfinite(values).all()
        assert values.min() >= 2 - 1e-6 and values.max() <= 3 + 1e-6


@pytest.mark.parametrize("storage", [*lookup.STORAGES, *range(1, 8)])
@pytest.mark.parametrize("channels", CHANNELS)
def test_masked_lanes_are_zero(ad, channels, storage):
    """Masked lanes return 0, whatever byte 0 means, and their coordinate does not matter."""
    rng = np.random.default_rng(1)
    if storage in lookup.STORAGES:
        array = DifferentiableArray.from_numpy(entries(rng, (4, 3), channels), ad.TensorXf, storage=storage)
    else:
        array, *_ = few_bits(ad, rng, (4, 3), channels, storage, "clamp")
    x = rng.uniform(0, 1, (64, 2)).astype(np.float32)
    mask = rng.integers(0, 2, 64).astype(bool)
    everything = read(array, ad, x)
    x[~mask] = np.nan
    np.testing.assert_array_equal(read(array, ad, x, active=ad.Bool(mask)), np.where(mask[:, None], everything, 0))


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("dims", [1, 2, 3, 4])
def test_gradients_equal_central_differences(ad, dims, channels):
    """With respect to the entries and to the coordinate, against differences of the float64 reference."""
    rng = np.random.default_rng(10 * dims + channels)
    resolution = (4, 3, 3, 2)[:dims]
    table = entries(rng, resolution, channels)
    weight = rng.uniform(-1, 1, channels)
    for border in borders(dims) if channels <= 4 else borders(dims)[-1:]:
        x = inside(rng, 100, resolution, border)
        array = DifferentiableArray.from_numpy(table, ad.TensorXf, border)
        point = [ad.Float(aligned(x[:, k])) for k in range(dims)]
        dr.enable_grad(array.data, *point)
        dr.backward(sum(float(w) * v for w, v in zip(weight, array(point), strict=True)))
        dr.eval(array.data.grad, [v.grad for v in point])  # one kernel

        # The reference is linear in the entries: its central difference is exact for any step. All at once: the
        # table whose channels are the unit vectors gives each entry's influence on each sample.
        count = int(np.prod(resolution))
        units = np.eye(count).reshape(*resolution, count)
        step = 0.5
        influence = (reference(units * step, x, border) - reference(-units * step, x, border)).sum(axis=0) / (2 * step)
        expected = influence.reshape(*resolution, 1) * weight
        np.testing.assert_allclose(array.data.grad.numpy()[..., :channels], expected, rtol=1e-5, atol=1e-5)

        assert_slopes(point, table, x, border, weight, rtol=1e-4)


@pytest.mark.parametrize("storage", lookup.STORAGES)
def test_slope_at_the_ends(ad, storage):
    """The first and the last cell's at exactly 0 and 1, that of the cell that is read inside, none beyond a clamp."""
    table = np.array([[1.0], [3.0], [4.0], [0.0]], np.float32)
    x = (0.0, -0.0, 1.0, BELOW_ONE, 0.5, -SMALLEST_NORMAL, -0.01, ABOVE_ONE, 1.01, np.inf, -np.inf, np.nan, -DENORMAL)
    clamped = [6, 6, -12, -12, 3, 0, 0, 0, 0, 0, 0, 0]
    around = [8, 8, 8, 4, -16, 4, 4, 8, 8, 0, 0, 0]
    for border, expected in (("clamp", clamped), ("repeat", around)):
        array = DifferentiableArray.from_numpy(table, ad.TensorXf, border, storage)
        point = ad.Float(np.float32(x))
        dr.enable_grad(point)
        dr.backward(array(point)[0])
        *slopes, denormal_slope = point.grad.numpy()
        tolerance = 1e-3 + 8 * np.abs(array.numpy()[:, 0] - table[:, 0]).max()
        np.testing.assert_allclose(slopes, expected, atol=tolerance, err_msg=border)
        assert (np.array(slopes)[np.equal(expected, 0)] == 0).all()
        # Kernels treat denormals as zero; some instructions do not: -DENORMAL is 0 or the next number below
        assert min(abs(denormal_slope - slope) for slope in (expected[0], expected[5])) <= tolerance


@pytest.mark.parametrize("channels", [3, 5, 7, 11])
@pytest.mark.parametrize("fold", [False, True])
def test_padding_has_no_influence_and_no_gradient(ad, channels, fold):
    rng = np.random.default_rng(channels)
    table = entries(rng, (4, 3), channels)
    clean = DifferentiableArray.from_numpy(table, ad.TensorXf, fold=fold)
    dirty = DifferentiableArray.from_numpy(table, ad.TensorXf, fold=fold)
    stored = dirty.data.numpy()
    assert stored.shape == (4, 3, lookup.padded_channels(channels)) and stored.shape[-1] % 4 == 0
    stored[..., channels:] = np.nan
    stored[0, 0, channels:] = 3e38
    dirty.data = ad.TensorXf(stored)
    x = rng.uniform(0, 1, (50, 2)).astype(np.float32)
    np.testing.assert_array_equal(read(dirty, ad, x), read(clean, ad, x))
    np.testing.assert_array_equal(dirty.numpy(), clean.numpy())
    for array in (clean, dirty):
        dr.enable_grad(array.data)
        dr.backward(sum(array([ad.Float(aligned(x[:, 0])), ad.Float(aligned(x[:, 1]))])))
        gradient = array.data.grad.numpy()
        assert gradient[..., :channels].all() and not gradient[..., channels:].any()


@pytest.mark.parametrize("channels", CHANNELS)
@pytest.mark.parametrize("dims", [1, 2, 3, 4])
def test_bytes_survive_packing(ad, dims, channels):
    """``codes`` returns the packed bytes, and the extreme bytes stand for the extreme values exactly."""
    rng = np.random.default_rng(dims)
    codes = rng.integers(0, 256, (*RESOLUTION[:dims], channels)).astype(np.uint8)
    scale, offset = rng.uniform(0.1, 1, channels), rng.uniform(-1, 1, channels)
    array = DifferentiableArray.from_numpy(codes, ad.TensorXf, "clamp", "uint8", quantization=(scale, offset))
    np.testing.assert_array_equal(array.codes(), codes)
    np.testing.assert_allclose(array.numpy(), offset + scale * codes, rtol=1e-6)
    assert array.nbytes == codes.nbytes

    table = entries(rng, RESOLUTION[:dims], channels)
    found, scale, offset = lookup.quantize(table, channels)
    flat, back = table.reshape(-1, channels), (offset + scale * found).reshape(-1, channels).astype(np.float32)
    np.testing.assert_array_equal(back.min(axis=0), flat.min(axis=0))
    np.testing.assert_array_equal(back.max(axis=0), flat.max(axis=0))


@pytest.mark.parametrize("storage", ["float32", "float16"])
def test_entries_are_aligned(storage):
    """From memory aligned to less than 64 bytes, reads on the CPU are two to five times slower."""
    ad = array_module("llvm")
    for size in range(2, 12):
        table = np.zeros((size, 3), np.float32)
        array = DifferentiableArray.from_numpy(table, ad.TensorXf, storage=storage)
        fresh = DifferentiableArray(size, 3, "ramp").alloc(ad.TensorXf)
        for data in (array.data, fresh.data):
            assert dr.detach(data).numpy().ctypes.data % 64 == 0  # on the CPU, this is the memory itself


def kernel_gathers(ad, array) -> int:
    """Return the number of gathers in the kernel of a read."""
    x = [dr.linspace(ad.Float, 0, 1, 123) for _ in array.resolution]
    dr.eval(x)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(array(x))
        code = "".join(k["ir"].getvalue() for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT)
    return sum("call" in line and "gather" in line for line in code.splitlines())


def few_bits(ad, rng, resolution, channels, bits, border):
    """An array of random codes, smallest and largest among them, and the entries that they stand for, in float64."""
    codes = rng.integers(0, 2**bits, (*resolution, channels)).astype(np.uint8)
    codes.reshape(-1)[-1:] = 2**bits - 1
    codes.reshape(-1)[:1] = 0
    scale, offset = rng.uniform(0.5, 2, channels) / (2**bits - 1), rng.uniform(-1, 1, channels)
    made = DifferentiableArray.from_numpy(codes, ad.TensorXf, border, "uint8", quantization=(scale, offset), bits=bits)
    return made, codes, offset + scale * codes.astype(np.float64)


@pytest.mark.parametrize(
    ("bits", "channels"), [*itertools.product(range(1, 8), range(1, 5)), *itertools.product((3, 5, 7), (5, 6, 7, 16))]
)
def test_few_bits_equal_scipy(ad, bits, channels):
    """Inside, outside, at the special coordinates; entries of several words, the last at the end of the memory."""
    rng = np.random.default_rng(10 * bits + channels)
    tables = [(RESOLUTION[:dims], border) for dims in (1, 2, 3) for border in borders(dims)[:3]]
    if channels > 4:
        tables = [((n, 3), ("clamp", "repeat")) for n in (1, 5, 32)]
    cases = []
    for resolution, border in tables:
        array, _, held = few_bits(ad, rng, resolution, channels, bits, border)
        x = rng.uniform(-1.2, 2.2, (100, len(resolution))).astype(np.float32)
        x[:60] = np.mod(x[:60], 1)
        x[: len(SPECIAL), -1] = SPECIAL
        x[-2:] = [[1] * len(resolution), [0.99] * len(resolution)]
        cases.append((held, x, border, array([ad.Float(aligned(v)) for v in x.T])))
    dr.eval([values for *_, values in cases])  # one kernel
    for held, x, border, values in cases:
        found = np.stack([v.numpy() for v in values], axis=-1)
        np.testing.assert_allclose(found, reference(held, x, border), atol=1e-5, err_msg=str(border))


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("bits", range(1, 9))
def test_bits_are_differentiable_in_the_coordinate(ad, bits, channels):
    rng = np.random.default_rng(bits)
    dims = 1 + (bits + channels) % 3
    border = (lookup.BORDERS[bits % 2],) * dims
    array, _, held = few_bits(ad, rng, RESOLUTION[:dims], channels, bits, border)
    x = inside(rng, 50, RESOLUTION[:dims], border)
    point = [ad.Float(aligned(x[:, k])) for k in range(dims)]
    dr.enable_grad(point)
    weight = rng.uniform(-1, 1, channels)
    dr.backward(sum(float(w) * v for w, v in zip(weight, array(point), strict=True)))
    dr.eval([v.grad for v in point])
    assert_slopes(point, held, x, border, weight, rtol=1e-3)


@pytest.mark.parametrize("bits", range(1, 8))
def test_few_bits_take_that_memory(ad, bits):
    rng = np.random.default_rng(bits)
    for resolution, channels in (((1,), 1), ((7, 5), 3), ((33, 2, 3), 4), ((64, 64), 2)):
        array, codes, held = few_bits(ad, rng, resolution, channels, bits, "repeat")
        expected = -(-codes.size * bits // 8)
        repeated = codes[..., :1, :].size if resolution[-1] > 1 else 0  # the first entry after the last of an axis
        held_bytes = -(-(codes.size + repeated) * bits // 8)
        assert array.nbytes == expected and held_bytes <= array.memory_nbytes <= held_bytes + 12
        assert array.memory_nbytes % 4 == 0
        np.testing.assert_array_equal(array.codes(), codes)
        np.testing.assert_allclose(array.numpy(), held, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    "resolution, bits, channels",
    [*(((5, 7), 8, c) for c in (1, 2, 3, 5, 12, 16)), *(((600, 600), 8, c) for c in (1, 2, 3, 5)),
     ((3, 4, 5), 8, 1), ((3, 4, 5), 8, 7),
     *(((5, 7), *b) for b in ((4, 4), (1, 1), (2, 4), (4, 3), (5, 3), (6, 3), (5, 4), (6, 4), (7, 4), (7, 8)))],
)  # fmt: skip
def test_gathers_that_the_kernel_makes(resolution, bits, channels):
    """A kernel has as many gathers as :func:`.gathers` says: a word each, a packet where an entry has more."""
    ad, rng = array_module("llvm"), np.random.default_rng(0)
    if bits == 8:
        array = DifferentiableArray.from_numpy(entries(rng, resolution, channels), ad.TensorXf, storage="uint8")
    else:
        array, *_ = few_bits(ad, rng, resolution, channels, bits, "clamp")
    assert kernel_gathers(ad, array) == lookup.gathers(resolution, channels, "uint8", bits)


def test_no_entry_needs_more_words_than_are_read():
    """Counted for each entry of a table: from the word with its first bit to that with its last."""
    for bits in range(1, 8):
        for channels in range(1, 17):
            width = bits * channels
            most = max((k * width + width - 1) // 32 - k * width // 32 + 1 for k in range(64))
            assert lookup.channels_words(channels, bits) == most, (bits, channels)
            most = max((k * width + 2 * width - 1) // 32 - k * width // 32 + 1 for k in range(64))
            assert lookup.channels_words(channels, bits, 2) == most, (bits, channels)


@pytest.mark.parametrize("bits", range(1, 9))
@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 31, 64, 1001, 2 * PART + 9])
def test_bits_survive_packing(bits, count):
    """Bit ``i`` of code ``k`` is bit ``k · bits + i`` of the bytes, the lowest first, also where parts join."""
    codes = np.random.default_rng(count).integers(0, 2**bits, count).astype(np.uint8)
    packed = pack_bits(codes, bits)
    assert packed.dtype == np.uint8 and packed.shape == (-(-count * bits // 8),)
    number = int("".join(f"{code:0{bits}b}" for code in codes[::-1]), 2)
    assert packed.tobytes() == number.to_bytes(len(packed), "little")
    unpacked = unpack_bits(packed, count, bits)
    assert unpacked.dtype == np.uint8
    np.testing.assert_array_equal(unpacked, codes)
    wider = codes | np.uint8(0xFF << bits & 0xFF)  # what lies above is left out
    np.testing.assert_array_equal(pack_bits(wider, bits), packed)
