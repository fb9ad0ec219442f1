"""The modules: construction, initialisation, fold, composition, and behaviour as ``drjit.nn`` modules."""

import drjit as dr
import numpy as np
import pytest
from arrays import aligned
from drjit import nn
from scipy.ndimage import map_coordinates

from mi_diffind import DifferentiableArray, Indirection, fold
from mi_diffind.arrays import lookup
from mi_diffind.arrays.boxes import box_interval, is_direction
from mi_diffind.arrays.indirection import unfolded
from mi_diffind.core.runtime import array_module

BELOW_ONE = np.float32(1) - np.float32(2**-23)


def interpolate(table, x):
    """Values of a clamped table, ``(samples, channels)``: SciPy's first-order spline, in float64."""
    table = np.asarray(table, np.float64)
    position = [np.clip(x[:, k], 0, 1) * (n - 1) for k, n in enumerate(table.shape[:-1])]
    channels = [map_coordinates(table[..., c], position, order=1, mode="nearest") for c in range(table.shape[-1])]
    return np.stack(channels, axis=-1)


def triangle(x):
    """The triangle wave of period 2 in float64, without its hair's breadth below 1."""
    return 1 - np.abs(1 - np.mod(np.asarray(x, np.float64), 2))


def read(module, ad, x):
    values = module([ad.Float(aligned(v)) for v in x.T])
    dr.eval(values)
    return np.stack([np.broadcast_to(v.numpy(), len(x)) for v in values], axis=-1)


def uniform(seed, samples, dims):
    return np.random.default_rng(seed).uniform(0, 1, (samples, dims)).astype(np.float32)


def pair(ad, seed=0, primary=(5, 6), cascaded=(4, 5), channels=3):
    """An allocated indirection with random entries: those of the primary need folding."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(-2, 3, (*primary, len(cascaded)))
    c = rng.uniform(0.5, 1.5, (*cascaded, channels))
    net = Indirection(
        DifferentiableArray(primary, len(cascaded), p, fold=True), DifferentiableArray(cascaded, channels, c)
    )
    return net.alloc(ad.TensorXf)


def test_fold_values(ad):
    x = np.concatenate([np.linspace(-7, 7, 4001), np.arange(-9, 10), np.random.default_rng(0).normal(0, 50, 4000)])
    x = x.astype(np.float32)
    y = fold(ad.Float(x)).numpy()
    np.testing.assert_allclose(y, triangle(x), atol=2.5e-7)  # one hair, one rounding
    np.testing.assert_array_equal(fold(ad.Float([0.0, 1.0, 2.0, -1.0])).numpy(), [0, BELOW_ONE, 0, BELOW_ONE])
    inside = np.random.default_rng(1).uniform(0, 1, 1000).astype(np.float32)
    np.testing.assert_array_equal(fold(ad.Float(inside)).numpy(), inside)


def test_fold_never_reaches_one(ad):
    """Around every odd number, and for any finite bit pattern: at least 0 (up to a flushed denormal) and below 1."""
    odd = np.arange(-99, 100, 2).astype(np.float32)
    bits = np.random.default_rng(3).integers(0, 2**32, 200_000, dtype=np.uint32).view(np.float32)
    near = [odd, np.nextafter(odd, np.float32(1e9)), np.nextafter(odd, np.float32(-1e9)), bits[np.isfinite(bits)]]
    y = fold(ad.Float(np.concatenate(near))).numpy()
    assert y.min() > -1e-37 and y.max() < 1


def test_fold_slope(ad):
    x = ad.Float([0.0, 0.3, 0.999, 1.0, 1.3, 1.999, 2.0, 2.5, 3.5, -0.5, -1.5, 1.0 - 2**-24])
    dr.enable_grad(x)
    dr.backward(fold(x))
    np.testing.assert_array_equal(x.grad.numpy(), [1, 1, 1, -1, -1, -1, 1, 1, -1, -1, 1, 1])


@pytest.mark.parametrize("border", lookup.BORDERS)
@pytest.mark.parametrize("resolution", [(7,), (3, 5), (4, 1, 3), (2, 3, 2, 4)])
def test_ramp(ad, resolution, border):
    """Each entry is its own position; more channels than axes start over."""
    dims = len(resolution)
    channels = dims + 2
    array = DifferentiableArray(resolution, channels, "ramp", border=border).alloc(ad.TensorXf)
    entries = array.numpy()
    for index in np.ndindex(*resolution):
        for k in range(channels):
            n = resolution[k % dims]
            expected = index[k % dims] / (n if border == "repeat" else max(1, n - 1))
            assert entries[(*index, k)] == np.float32(expected)
    if border == "clamp":  # it reads as the identity, except along a single entry
        x = uniform(0, 100, dims)
        for k, n in enumerate(resolution):
            np.testing.assert_allclose(read(array, ad, x)[:, k], x[:, k] if n > 1 else 0, atol=2e-7)


def test_random_is_seeded(ad):
    """Equal generators give equal entries, another seed gives others, and no two arrays of a pair are alike."""
    array = DifferentiableArray((8, 8), 3, "random", (-2, 1))
    first = array.alloc(ad.TensorXf).numpy()
    np.testing.assert_array_equal(array.alloc(ad.TensorXf).numpy(), first)
    same, other = (array.alloc(ad.TensorXf, rng=dr.rng(seed=s)).numpy() for s in (5, 6))
    np.testing.assert_array_equal(array.alloc(ad.TensorXf, rng=dr.rng(seed=5)).numpy(), same)
    assert not np.array_equal(same, other) and not np.array_equal(same, first)
    assert first.min() >= -2 and first.max() < 1 and first.std() > 0.5 and len(np.unique(first)) == first.size
    net = Indirection(
        [DifferentiableArray((4,), 1, "random"), DifferentiableArray((4,), 1, "random")],
        DifferentiableArray((4, 4), 1, "random"),
    ).alloc(ad.TensorXf)
    a, b, c = (net[key].numpy().ravel()[:4].tolist() for key in net)
    assert a != b != c != a


def test_half_precision_allocation(ad):
    array = DifferentiableArray((3, 3), 3, "ramp").alloc(ad.TensorXf16)
    assert array.storage == "float16" and array.nbytes == 2 * 27
    assert DifferentiableArray((3, 3), 3).alloc(ad.TensorXf).nbytes == 4 * 27
    double = DifferentiableArray((3, 3), 3, "ramp").alloc(ad.TensorXf64)  # what ``mi.TensorXf`` is in double variants
    np.testing.assert_allclose(read(double, ad, uniform(0, 9, 2))[:, :2], uniform(0, 9, 2), atol=2e-7)


@pytest.mark.parametrize("storage", lookup.STORAGES)
def test_values(ad, storage):
    # Packed 2D reads: 1/64 of a step (tests/test_lookup.py), times the slope of the cascaded array
    atol = 5e-4 if storage == "uint8" else 0
    net = pair(ad)
    x = uniform(1, 300, 2)
    before = net.primary[0].numpy()
    np.testing.assert_allclose(before, triangle(net["primary.0.data"].numpy()[..., :2]), atol=3e-7)
    net = net.to(storage)
    p, c = net.primary[0].numpy(), net.cascaded.numpy()
    assert net.nbytes == {"float32": 4, "float16": 2, "uint8": 1}[storage] * (p.size + c.size)
    assert p.min() >= 0 and p.max() <= 1
    np.testing.assert_allclose(p, before, atol={"float32": 0, "float16": 3e-4, "uint8": 0.502 / 255}[storage])
    np.testing.assert_allclose(np.stack([v.numpy() for v in net.pointer([ad.Float(v) for v in x.T.copy()])], 1),
                               interpolate(p, x), rtol=1e-5, atol=1e-6 if atol == 0 else 1 / 255 / 64)  # fmt: skip
    np.testing.assert_allclose(read(net, ad, x), interpolate(c, interpolate(p, x)), rtol=1e-5, atol=atol)


def test_gradients_equal_central_differences(ad):
    """Through both arrays and the fold, with respect to all entries and to the inputs."""
    net = pair(ad, seed=3, primary=(3, 4), cascaded=(3, 4), channels=2)
    p, c = net["primary.0.data"].numpy()[..., :2].astype(np.float64), net.cascaded.numpy().astype(np.float64)

    def value(p, c, x):
        return interpolate(c, interpolate(triangle(p), x)).sum(axis=1)

    # Points whose pointers stay away from the edges of the cascaded array's cells, where slopes jump.
    x = uniform(4, 200, 2)
    position = interpolate(triangle(p), x) * (np.array([3, 4]) - 1)
    own = x * (np.array([3, 4]) - 1)
    away = [np.abs(v - np.rint(v)).min(axis=1) > 0.02 for v in (position, own)]
    x = x[away[0] & away[1]][:40]
    assert len(x) == 40

    point = [ad.Float(v) for v in x.T.copy()]
    dr.enable_grad(net["primary.0.data"], net["cascaded.data"], *point)
    dr.backward(sum(net(point)))
    x, h = x.astype(np.float64), 1e-5
    found = [net["primary.0.data"].grad.numpy()[..., :2], net["cascaded.data"].grad.numpy()[..., :2]]
    for i, table in enumerate((p, c)):
        for index in np.ndindex(*table.shape):
            step = np.zeros_like(table)
            step[index] = h
            plus, minus = ((p + s, c) if i == 0 else (p, c + s) for s in (step, -step))
            slope = (value(*plus, x).sum() - value(*minus, x).sum()) / (2 * h)
            assert found[i][index] == pytest.approx(slope, rel=1e-3, abs=2e-4)
    for v, step in zip(point, h * np.eye(2), strict=True):
        slope = (value(p, c, x + step) - value(p, c, x - step)) / (2 * h)
        np.testing.assert_allclose(v.grad.numpy(), slope, rtol=1e-3, atol=2e-4)


def test_copies_keep_few_bits(ad):
    """Copies of an array with 5 bits an entry keep the bits; other storages hold the same values."""
    codes = np.random.default_rng(5).integers(0, 32, (5, 6, 3)).astype(np.uint8)
    array = DifferentiableArray.from_numpy(
        codes, ad.TensorXf, storage="uint8", quantization=((1 / 31,) * 3, (0.0,) * 3), bits=5
    )
    x = uniform(1, 50, 2)
    expected = interpolate(codes / 31, x)
    for copy in (array.to("uint8"), dr.copy(array)):
        assert copy.bits == 5 and copy.memory_nbytes == array.memory_nbytes
        np.testing.assert_array_equal(copy.codes(), codes)
        np.testing.assert_array_equal(read(copy, ad, x), read(array, ad, x))
    single = array.to("float32")
    assert single.nbytes == 4 * codes.size
    np.testing.assert_allclose(read(single, ad, x), expected, atol=1e-5)
    assert single.to("uint8").nbytes == codes.size  # 8 bits again
    known = read(array.at(ad.Float(0.3)), ad, x[:, :1])
    np.testing.assert_allclose(known, interpolate(codes / 31, np.stack([x[:, 0], np.full(50, 0.3)], 1)), atol=1e-5)


@pytest.mark.parametrize("storage", ["float32", "float16"])
def test_unfolded(ad, storage):
    """Arrays that hold the folded entries have equal values and gradients."""
    rng = np.random.default_rng(8)
    tables = [rng.uniform(-3, 3, s) for s in ((5, 6, 2), (4, 4, 3), (7, 2))]
    first = Indirection(*(DifferentiableArray(t.shape[:-1], t.shape[-1], t, fold=True) for t in tables[:2]))
    net = nn.Sequential(first.alloc(ad.TensorXf), DifferentiableArray((7,), 2, tables[2]).alloc(ad.TensorXf))
    if storage == "float16":
        net.layers = (net.layers[0].to("float16"), net.layers[1].to("float16"))
    x, found = uniform(9, 300, 2), []
    arrays = [net.layers[0].primary[0], net.layers[0].cascaded, net.layers[1]]
    for changed in (lambda: net, lambda: unfolded(net)):
        dr.disable_grad(arrays)
        dr.enable_grad(arrays)
        first, last = changed().layers
        values = [*first([ad.Float(v) for v in x.T]), *last([ad.Float(x[:, 0])])]
        dr.backward(sum(((i + 1) * v for i, v in enumerate(values)), 0))
        found.append([np.array(v) for v in values] + [a.data.grad.numpy() for a in arrays])
    for a, b in zip(*found, strict=True):
        assert np.abs(a).max() > 0.1
        # Several cores add gradients in any order: sums differ by the rounding of their storage
        np.testing.assert_allclose(a, b, rtol=0, atol=(4e-3 if storage == "float16" else 1e-6) * np.abs(a).max())
    assert list(unfolded(net)) == list(net) and not unfolded(net).layers[0].cascaded.folded
    assert [a.folded for a in arrays] == [storage == "float32"] * 2 + [False]  # the net is as it was


@pytest.mark.parametrize("storage", lookup.STORAGES)
def test_several_primaries(ad, storage):
    """Outputs are concatenated in the order of the primaries; ``inputs`` says who reads what."""
    rng = np.random.default_rng(5)
    tables = [rng.uniform(0, 1, s) for s in ((4, 5, 2), (6, 1), (3, 3, 1))]
    grid = rng.uniform(0.5, 1.5, (3, 4, 3, 5, 4))
    groups = ((2, 0), (1,), (0, 1))
    net = Indirection(
        [DifferentiableArray(t.shape[:-1], t.shape[-1], t, fold=True) for t in tables],
        DifferentiableArray(grid.shape[:-1], 4, grid),
        groups,
    ).alloc(ad.TensorXf)
    assert list(net) == ["primary.0.data", "primary.1.data", "primary.2.data", "cascaded.data"]
    assert list(net.cascaded) == ["data"]
    net = net.to(storage)
    x = uniform(6, 200, 3)
    pointers = [interpolate(p.numpy(), x[:, list(g)]) for p, g in zip(net.primary, groups, strict=True)]
    expected = interpolate(net.cascaded.numpy(), np.concatenate(pointers, axis=1))
    np.testing.assert_allclose(read(net, ad, x), expected, rtol=1e-5, atol=5e-4 if storage == "uint8" else 0)


def known(ad, dims, channels, storage, border="clamp", fold=False):
    """An array of random entries, beyond [0, 1] if they are to be folded."""
    low, high = (-2, 3) if fold else (0.5, 1.5)
    table = np.random.default_rng(dims).uniform(low, high, (*(3, 4, 2, 5)[-dims:], channels))
    return DifferentiableArray.from_numpy(table, ad.TensorXf, border, fold=fold).to(storage)


@pytest.mark.parametrize("storage", lookup.STORAGES)
@pytest.mark.parametrize("dims, channels", [(2, 1), (2, 2), (2, 5), (3, 3), (4, 1), (4, 2)])
@pytest.mark.parametrize("border", ["clamp", "mixed"])
def test_what_remains_where_a_coordinate_is_known(ad, dims, channels, storage, border):
    """``array.at(x)`` is read as the array is, with ``x`` as its last coordinate: inside, at entries, beyond, NaN."""
    borders = ("clamp", "repeat", "clamp", "repeat")[-dims:]
    array = known(ad, dims, channels, storage, borders if border == "mixed" else border)
    rest = uniform(dims, 100, dims - 1) * 1.4 - 0.2
    # Bytes are read at up to 1/64 of a step, and once more; the entries of a row are in single precision
    tolerance = 0.05 * max(array.scale) if storage == "uint8" else 2e-6
    for x in (0.0, 0.3, 0.5, 1.0, -0.2, 1.2, 0.999999, float("nan")):
        row = array.at(dr.opaque(ad.Float, x))
        assert row.resolution == array.resolution[:-1] and row.border == array.border[:-1]
        assert (row.channels, row.storage, row.folded) == (channels, "float32", False)
        everywhere = np.column_stack([rest, np.full(len(rest), x, np.float32)])
        values = read(row, ad, rest)
        np.testing.assert_allclose(values, read(array, ad, everywhere), atol=tolerance)
        if border == "clamp":
            position = np.nan_to_num(everywhere)
            np.testing.assert_allclose(values, interpolate(array.numpy(), position), atol=tolerance)


@pytest.mark.parametrize("dims", [2, 3, 4])
@pytest.mark.parametrize("border", lookup.BORDERS)
def test_gradients_of_what_remains(ad, dims, border):
    """With respect to the entries and to the known coordinate: those of the whole array, read there."""
    array = known(ad, dims, 3, "float32", border)
    rest, x = uniform(7, 30, dims - 1), dr.opaque(ad.Float, 0.37)
    factors = [ad.Float(aligned(w)) for w in np.random.default_rng(dims).uniform(-1, 1, (3, 30))]
    gradients = []
    for value in (lambda inputs: array.at(x)(inputs), lambda inputs: array([*inputs, x])):
        dr.disable_grad(array.data, x)
        dr.enable_grad(array.data, x)
        dr.backward(sum(v * w for v, w in zip(value([ad.Float(aligned(v)) for v in rest.T]), factors, strict=True)))
        gradients.append([np.array(array.data.grad), np.array(x.grad)])
    for found, expected in zip(*gradients, strict=True):
        assert np.abs(expected).max() > 0.01
        np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("storage", lookup.STORAGES)
def test_forms_of_the_coordinate(ad, storage):
    """Lists, tuples, vectors, numbers and other precisions mean the same; results are single precision."""
    net = pair(ad).to(storage)
    expected = [v.numpy()[0] for v in net([ad.Float(0.25), ad.Float(0.5)])]
    forms = (
        (ad.Float(0.25), ad.Float(0.5)), ad.Array2f(0.25, 0.5), [0.25, ad.Float(0.5)], [ad.Float(0.25), 0.5],
        [0.25, 0.5], [ad.Float16(0.25), ad.Float16(0.5)], [ad.Float64(0.25), ad.Float64(0.5)],
    )  # fmt: skip
    for x in forms:
        values = net(x)
        assert isinstance(values, list) and all(type(v) is ad.Float for v in values)
        np.testing.assert_array_equal([v.numpy()[0] for v in values], expected)
    line = DifferentiableArray(3, 2, "ramp").alloc(ad.TensorXf).to(storage)
    for x in (ad.Float(0.25), [ad.Float(0.25)], 0.25):
        assert [round(float(v.numpy()[0]), 2) for v in line(x)] == [0.25, 0.25]


@pytest.mark.parametrize("storage", lookup.STORAGES)
def test_cooperative_vectors(ad, storage):
    """A cooperative vector in, a cooperative vector out, with gradients."""
    net = pair(ad).to(storage)
    x = [ad.Float([0.2, 0.4]), ad.Float([0.7, 0.1])]
    for module in (net, net.cascaded):
        out = module(nn.CoopVec(*x))
        assert isinstance(out, nn.CoopVec) and len(out) == 3
        for v, w in zip(list(out), module(x), strict=True):
            np.testing.assert_array_equal(v.numpy(), w.numpy())
    dr.enable_grad(x)
    dr.backward(sum(list(net(nn.CoopVec(*x)))))
    through, _ = [v.grad.numpy() for v in x], dr.clear_grad(x)
    dr.backward(sum(net(x)))
    for a, b in zip(through, x, strict=True):
        np.testing.assert_array_equal(a, b.grad.numpy())


def test_composes_with_other_modules(ad):
    net = nn.Sequential(
        DifferentiableArray((4, 4), 3, "random", fold=True), nn.ReLU(), DifferentiableArray((3, 3, 3), 2, "random")
    )
    net = net.alloc(ad.TensorXf, 2)
    assert list(net) == ["layers.0.data", "layers.2.data"]
    x = uniform(0, 50, 2)
    out = net(nn.CoopVec(*(ad.Float(v) for v in x.T.copy())))
    expected = interpolate(net.layers[2].numpy(), interpolate(net.layers[0].numpy(), x))
    np.testing.assert_allclose(np.stack([v.numpy() for v in out], axis=1), expected, rtol=1e-5)
    with pytest.raises(ValueError, match="was given 3 input"):
        net.alloc(ad.TensorXf, 3)


def test_a_table_of_the_wrong_shape_is_refused(ad):
    array = pair(ad).cascaded
    for shape in ((4, 5, 2), (5, 4, 3), (4, 5), (60,)):
        array.data = ad.TensorXf(np.zeros(shape, np.float32))
        with pytest.raises(ValueError, match=r'"data" has the shape .*, expected \(4, 5, 3\)'):
            array([ad.Float(0), ad.Float(0)])


@pytest.mark.parametrize("channels", [1, 2, 3, 5, 6, 7])
def test_entries_without_padding(ad, channels):
    """A tensor of the logical shape reads, and gets gradients, as the padded one does."""
    table = np.random.default_rng(channels).uniform(0, 1, (4, 5, channels)).astype(np.float32)
    padded, plain = (DifferentiableArray.from_numpy(table, ad.TensorXf) for _ in range(2))
    plain.data = ad.TensorXf(table)
    x = uniform(3, 100, 2)
    np.testing.assert_array_equal(plain.numpy(), padded.numpy())
    np.testing.assert_allclose(read(plain, ad, x), read(padded, ad, x), rtol=1e-6)
    for array in (padded, plain):
        dr.enable_grad(array.data)
        dr.backward(sum(v * (k + 1) for k, v in enumerate(array([ad.Float(aligned(v)) for v in x.T]))))
    np.testing.assert_allclose(plain.data.grad.numpy(), padded.data.grad.numpy()[..., :channels], rtol=1e-5)


@pytest.mark.parametrize("storage", lookup.STORAGES)
def test_pytree(ad, storage, no_garbage_collection):
    """Traversed by Dr.Jit: evaluation, gradients on and off, frozen functions."""
    net = pair(ad).to(storage)
    dr.schedule(net)
    dr.make_opaque(net)
    dr.eval(net)
    dr.enable_grad(net)
    assert dr.grad_enabled(net.cascaded.data) == (storage != "uint8")
    dr.disable_grad(net)
    frozen = dr.freeze(lambda net, x: net(x))
    for seed in (0, 1):
        x = [dr.rng(seed=seed + k).random(ad.Float, 64) for k in (0, 9)]  # NumPy's memory is aligned by chance
        for v, w in zip(frozen(net, x), net(x), strict=True):
            np.testing.assert_allclose(v.numpy(), w.numpy(), rtol=1e-6)
    assert frozen.n_recordings == 1
    assert "Indirection(DifferentiableArray(5x6" in repr(net) and storage in repr(net)


@pytest.mark.parametrize("storage", lookup.STORAGES)
@pytest.mark.parametrize("mode", ["symbolic", "evaluated"])
def test_in_a_loop(ad, storage, mode):
    """Reading inside a recorded loop, with the net as a loop variable."""
    net = pair(ad).to(storage)
    x = [ad.Float(v) for v in uniform(8, 16, 2).T.copy()]
    expected = sum(net([x[0] * (i / 4), x[1]])[1] for i in range(4)).numpy()

    @dr.syntax
    def repeated(net, x, i, total, mode):  # ``dr.syntax`` sees no closure
        while dr.hint(i < 4, mode=mode):
            total += net([x[0] * (type(total)(i) / 4), x[1]])[1]
            i += 1
        return total

    found = repeated(net, x, ad.UInt(0), dr.zeros(ad.Float, 16), mode)
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-5)


Array, Pair = DifferentiableArray, Indirection

MISTAKES = {
    "no dimension": (lambda: Array(()), "1 to 4 dimensions"),
    "five dimensions": (lambda: Array((2,) * 5), "1 to 4 dimensions"),
    "no entries": (lambda: Array((4, 0)), "at least 1 entry"),
    "negative entries": (lambda: Array(-3), "at least 1 entry"),
    "no channel": (lambda: Array(4, 0), "channels: found 0"),
    "unknown border": (lambda: Array(4, border="mirror"), "mirror"),
    "too few borders": (lambda: Array((4, 4), border=("clamp",)), "one for each axis"),
    "unknown initialisation": (lambda: Array(4, init="noise"), '"noise"'),
    "wrong shape": (lambda: Array((4, 4), 2, np.zeros((4, 4))), r"expected \(4, 4, 2\)"),
    "not a range": (lambda: Array(4, 1, "random", 0.5), "pair"),
    "values for other channels": (lambda: Array(4, 3, value=(1, 2)), "one a channel"),
    "pointer too short": (lambda: Pair(Array((4, 4), 2), Array((4, 4, 4))), "2 channel.* 3 dimension"),
    "pointer too long": (lambda: Pair(Array(4, 2), Array(4)), "2 channel"),
    "no primary": (lambda: Pair([], Array(4)), "0 channel"),
    "inputs do not fit": (lambda: Pair(Array((4, 4), 2), Array((4, 4)), [(0,)]), "inputs: found"),
    "negative input": (lambda: Pair(Array((4, 4), 2), Array((4, 4)), [(-1, 0)]), "at least 0"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_impossible_settings(name):
    make, message = MISTAKES[name]
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_mistakes_when_reading(ad):
    net = pair(ad)
    x = ad.Float(0.5)
    for wrong in ([x], [x] * 3):
        with pytest.raises(ValueError, match=rf"2 input.* {len(wrong)} coordinate"):
            net(wrong)
        with pytest.raises(ValueError, match=rf"2 dimension.* {len(wrong)} coordinate"):
            net.cascaded(wrong)
    empty = DifferentiableArray((4, 4))
    for use in (lambda: empty([x, x]), empty.numpy, lambda: empty.to("uint8")):
        with pytest.raises(RuntimeError, match="alloc"):
            use()
    with pytest.raises(ValueError, match="uint4"):
        net.to("uint4")
    with pytest.raises(ValueError, match="float64"):
        DifferentiableArray.from_numpy(np.zeros((3, 1)), ad.TensorXf, storage="float64")
    with pytest.raises(ValueError, match="channels"):
        DifferentiableArray.from_numpy(np.zeros(3), ad.TensorXf)
    with pytest.raises(ValueError, match="float32"):
        net.cascaded.codes()
    with pytest.raises(ValueError, match="2 input"):
        net.alloc(ad.TensorXf, 3)


def test_box_interval(rng):
    ad = array_module("llvm")
    lower, upper = np.array([-1.0, 0.0, 2.0]), np.array([1.0, 0.5, 4.0])
    o = rng.uniform(-3, 5, (4000, 3))
    d = rng.normal(size=o.shape)
    d[:1000, rng.integers(3)] = 0  # parallel to two faces …
    o[:300, 0] = lower[0]  # … or within one
    d[:300, 0] = 0
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = o.astype(np.float32), d.astype(np.float32)
    rays, corners, count = (ad.Array3f(o.T), ad.Array3f(d.T)), (lower.tolist(), upper.tolist()), len(o)
    start = dr.zeros(ad.Float, count), dr.full(ad.Float, 6, count), dr.full(ad.Bool, True, count)
    near, far, active = box_interval(*rays, *corners, *start)
    near, far, active = near.numpy(), far.numpy(), active.numpy()
    t = np.linspace(0, 6, 6001)
    found = 0
    for k in range(len(o)):
        p = o[k] + t[:, None] * d[k]
        inside = ((p >= lower - 1e-6) & (p <= upper + 1e-6)).all(axis=1)
        if active[k] and far[k] - near[k] > 3e-3:
            found += 1
            assert abs(t[inside][0] - near[k]) < 2e-3 and abs(t[inside][-1] - far[k]) < 2e-3
        elif not (active[k] and abs(far[k] - near[k]) <= 3e-3):
            assert inside.sum() <= 3
    assert found > 100


def test_only_vectors_of_about_unit_length_are_directions():
    ad = array_module("llvm")
    lengths = [0, 1e-45, 1e-30, 0.4, 0.6, 1, 1.9, 2.1, 1e19, 1e30, np.inf, np.nan]
    d = ad.Array3f(np.float32([lengths, [0] * 12, [0] * 12]))
    assert is_direction(d).numpy().tolist() == [False] * 4 + [True] * 3 + [False] * 5


def test_boxes_of_special_rays():
    """NaN is in no box; denormal components are zero along a side, where products with reciprocals would be NaN."""
    ad = array_module("llvm")
    nan, middle, up, start = ad.Array3f(dr.nan, 0.5, 0.5), ad.Array3f(0.5), ad.Array3f(1, 0, 0), ad.Float(0)
    for o, d in ((nan, up), (middle, nan)):
        near, far, active = box_interval(o, d, (0, 0, 0), (1, 1, 1), start, ad.Float(dr.inf), ad.Bool(True))
        assert not (active & (near <= far) & dr.isfinite(near) & dr.isfinite(far))[0]
    for tiny in (1e-45, -1e-45, 1e-31):
        o, d = ad.Array3f(0, 0.5, -1), ad.Array3f(tiny, 0, 1)
        near, far, active = box_interval(o, d, (0, 0, 0), (1, 1, 1), start, ad.Float(9), ad.Bool(True))
        assert active[0] and near[0] == 1 and far[0] == 2
