"""Training of images: initial arrays, samples, targets, rounding, and files."""

import dataclasses

import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of
from scipy.ndimage import map_coordinates

from mi_diffind import DifferentiableArray, save_table
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import FitRequest
from mi_diffind.maps.layout import Layout, choose_borders, downscale, smoothness
from mi_diffind.maps.source import from_arrays
from mi_diffind.tasks.image import (
    IMPROVEMENTS,
    PAGED,
    PRESETS,
    STRUCTURES,
    TASK,
    CoarsePrimary,
    arrays,
    fit,
    training,
    without,
)
from mi_diffind.tasks.image.arrays import CompressedImage, ImageBudget

OURS = PRESETS["ours"]

pytestmark = pytest.mark.usefixtures("few_samples")


def waves(height=24, width=24, channels=3, periods=1):
    """A smooth image that repeats along both axes, of several colours, in [0.1, 0.9]."""
    y, x = np.mgrid[0:height, 0:width]
    y, x = 2 * np.pi * periods * (y + 0.5) / height, 2 * np.pi * periods * (x + 0.5) / width
    found = [np.sin(x + k) * (1, 0.5, 0)[k % 3] + np.cos(y - k) * (0, 0.5, 1)[k % 3] for k in range(channels)]
    return (0.5 + 0.4 * np.stack(found, axis=-1)).astype(np.float32)


def short(recipe=OURS, steps=3, batch=256, **settings):
    """Settings for images of a few texels."""
    return dataclasses.replace(recipe, **{"steps": steps, "batch": batch, "measure_every": steps, **settings})


def trained(source, size, recipe, types=None, border=None, **request):
    """:func:`.training.fit_image`, in silence."""
    types = types or array_module("llvm")
    request = FitRequest("ours", recipe, types, progress=False, **request)
    return training.fit_image(source, size, recipe, request, border)


def problem(ad, values, recipe=OURS, border=None, size=None):
    values = np.asarray(values, np.float32)
    source = from_arrays({"other": values})
    layout = Layout.from_source(source, once=False)
    size = size or ImageBudget(6, 6, 4, layout.stored, recipe.dims, 6)
    return training.build_problem(source, size, recipe, ad, layout, border)


def psnr(a, b):
    return -10 * np.log10(max(np.mean((np.asarray(a, np.float64) - b) ** 2), 1e-12))


def texel_centres(ad, height, width):
    v, u = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    return [ad.Float(aligned(x.ravel())) for x in (v, u)]


# -- initial arrays ---------------------------------------------------------------------------------------------------


def test_borders_of_what_tiles_and_what_does_not():
    tile = waves()
    y, x = np.mgrid[0:24, 0:24] / 24
    slope = np.stack([x, 0.2 + 0 * x], axis=-1)
    assert choose_borders(tile) == ("repeat", "repeat")
    assert choose_borders(slope) == ("repeat", "clamp")  # constant along v
    assert choose_borders(slope.transpose(1, 0, 2)) == ("clamp", "repeat")
    assert choose_borders(slope + y[..., None]) == ("clamp", "clamp")
    assert choose_borders(tile[:13]) == ("clamp", "repeat")  # half a period
    assert choose_borders(tile[:, :13]) == ("repeat", "clamp")
    assert choose_borders(tile[:1]) == ("repeat", "repeat")
    assert choose_borders(tile[:1, :1]) == ("repeat", "repeat")
    assert choose_borders(np.random.default_rng(0).random((9, 8, 2))) == ("repeat", "repeat")


@pytest.mark.parametrize("border", [("clamp", "clamp"), ("repeat", "clamp"), ("clamp", "repeat"), ("repeat", "repeat")])
@pytest.mark.parametrize("rows, columns", [(1, 1), (3, 7), (13, 20)])
def test_downscaling_is_a_tent(rows, columns, border):
    """Summed entry by entry and texel by texel; also onto more entries than there are texels."""
    height, width = 9, 12
    values = np.random.default_rng(rows).random((height, width, 2)).astype(np.float32)

    def weights(entry, entries, texels, kind):
        step = 1 / entries if kind == "repeat" else 1 / max(1, entries - 1)
        found = []
        for texel in range(texels):
            distance = abs((texel + 0.5) / texels - entry * step)
            if kind == "repeat":
                distance = min(distance, 1 - distance)
            found.append(max(0.0, 1 - distance / max(step, 1 / texels)))
        assert sum(found) > 0
        return np.array(found) / sum(found)

    expected = np.zeros((rows, columns, 2))
    for i in range(rows):
        for j in range(columns):
            w = np.outer(weights(i, rows, height, border[0]), weights(j, columns, width, border[1]))
            expected[i, j] = np.einsum("yx,yxc->c", w, values)
    found = downscale(values, rows, columns, border)
    assert found.dtype == np.float32 and found.shape == (rows, columns, 2)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
@pytest.mark.parametrize("border", ["repeat", "clamp"])
def test_components_reproduce_a_smooth_image(ad, channels, border):
    values = waves(32, 40, channels)
    size = ImageBudget(24, 30, 5, channels, 4, 6)
    net = arrays.from_components(values, size, (border,) * 2).alloc(ad.TensorXf)
    assert net.primary[0].border == (border,) * 2
    assert net.nbytes == 4 * (24 * 30 * 4 + 5**4 * channels)
    found = numpy_of(net(texel_centres(ad, 32, 40))).reshape(values.shape)
    assert psnr(found, values) > 30
    stored = numpy_of(training.stored_form(net, [6])(texel_centres(ad, 32, 40))).reshape(values.shape)
    assert psnr(stored, values) > 28


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 7])
def test_components_in_two_arrays(ad, channels):
    """The first of two primaries is the finer one; together they reproduce what one does."""
    values = waves(32, 40, channels)
    size = ImageBudget(24, 30, 5, channels, 4, 4, coarse=CoarsePrimary(2, 8, 0.5))
    net = arrays.from_components(values, size, ("repeat", "clamp")).alloc(ad.TensorXf)
    assert [(p.resolution, p.channels) for p in net.primary] == [((24, 30), 2), ((12, 15), 2)]
    assert psnr(numpy_of(net(texel_centres(ad, 32, 40))).reshape(values.shape), values) > 30


@pytest.mark.parametrize("name", ["grey", "twice", "a row", "one colour"])
def test_components_that_do_not_vary(ad, name):
    """Channels that follow from others get no component a second time, with one array and with two."""
    values = {
        "grey": np.repeat(waves(24, 24, 1), 3, axis=-1),
        "twice": np.concatenate([waves(24, 24, 2)] * 2, axis=-1),
        "a row": waves(1, 32, 3),
        "one colour": np.full((8, 8, 3), 0.3, np.float32),
    }[name]
    height, width, channels = values.shape
    for coarse in (None, CoarsePrimary(2, 8, 0.5), CoarsePrimary(1, 8, 0.9)):
        size = ImageBudget(min(height, 20), 20, 5, channels, 4, 4, coarse=coarse)
        net = arrays.from_components(values, size, ("repeat",) * 2).alloc(ad.TensorXf)
        found = numpy_of(net(texel_centres(ad, height, width))).reshape(values.shape)
        assert psnr(found, values) > 30, coarse


def test_detail():
    """The mean of the four neighbours in place of a texel, written out again."""
    values = np.random.default_rng(0).random((6, 7, 2)).astype(np.float32)
    errors = [
        values[i, j, c] - (values[i - 1, j, c] + values[i + 1, j, c] + values[i, j - 1, c] + values[i, j + 1, c]) / 4
        for i in range(1, 5)
        for j in range(1, 6)
        for c in range(2)
    ]
    assert smoothness(values) == pytest.approx(-10 * np.log10(np.mean(np.square(errors))), abs=1e-3)
    several = [smoothness(v) for v in (values, waves(32, 32, periods=4), waves(32, 32))]
    assert several[0] < several[1] < several[2]
    y, x = np.mgrid[0:8, 0:8].astype(np.float32)
    assert smoothness((y + 2 * x)[..., None] / 30) == 120  # a plane has none
    for few in (values[:1], values[:, :2], values[:1, :1]):
        assert np.isfinite(smoothness(few))


def test_the_ramp_is_the_supplements(ad):
    maps = {"albedo": waves(), "ao": waves(channels=1), "normal": waves(channels=3) * 0.7, "roughness": waves()[..., 1]}
    layout = Layout.from_source(from_arrays(maps), once=False, two_channel_normals=False)
    size = ImageBudget(8, 6, 4, 8, 4, 8)
    net = arrays.from_ramp(layout, size, ("clamp", "repeat")).alloc(ad.TensorXf)
    v, u = np.meshgrid(np.arange(8) / 7, np.arange(6) / 6, indexing="ij")
    np.testing.assert_allclose(net.primary[0].numpy(), np.stack([v, u, v, u], axis=-1), atol=1e-6)
    expected = [0.5, 0.5, 0.5, 1, 0.5, 0.5, 1, 0.5]
    np.testing.assert_allclose(net.cascaded.numpy(), np.broadcast_to(expected, (4,) * 4 + (8,)), atol=1e-6)
    assert net.primary[0].border == ("clamp", "repeat") and net.cascaded.border == ("clamp",) * 4
    two = dataclasses.replace(size, coarse=CoarsePrimary(1, 6, 0.5))
    two = arrays.from_ramp(layout, two, ("clamp", "repeat")).alloc(ad.TensorXf)
    np.testing.assert_allclose(two.primary[0].numpy(), np.stack([v, u, v], axis=-1), atol=1e-6)
    np.testing.assert_allclose(two.primary[1].numpy()[..., 0], np.repeat(np.arange(4)[:, None] / 3, 3, 1), atol=1e-6)


# -- samples and targets ----------------------------------------------------------------------------------------------


def drawn(found, ad, size, jittered=False, seed=0):
    """The inputs, ``(v, u)``, and targets of a batch as NumPy arrays."""
    found.jittered = jittered
    inputs, targets = found.batch(dr.rng(seed=dr.opaque(ad.UInt64, seed)), size)
    return [x.numpy() for x in inputs], numpy_of([c for channels in targets.values() for c in channels])


@pytest.mark.parametrize("size", [1, 10, 34, 35, 36, 1000])
def test_samples_are_stratified(ad, size):
    """One in each of ``size`` equal stretches of the image, wherever they end: of 35 texels, each once."""
    height, width = 7, 5
    texels = height * width
    found = problem(ad, (np.arange(texels) / texels).reshape(height, width, 1))
    seen = []
    for seed in range(4):
        _, targets = drawn(found, ad, size, seed=seed)
        index = np.rint(targets[:, 0] * texels).astype(int)
        low = np.arange(size) * texels // size
        high = np.maximum((np.arange(size) + 1) * texels // size, low + 1)
        assert ((low <= index) & (index < high)).all()
        seen.append(index)
    if size < texels:
        assert np.ptp(seen, axis=0).any()  # drawn anew


@pytest.mark.parametrize("border", [("repeat", "clamp"), ("clamp", "repeat")])
def test_targets_of_jittered_samples(ad, border):
    """Each place of a batch lies in its texel, and its target is the value there."""
    height, width = 6, 9
    values = np.random.default_rng(1).random((height, width, 3)).astype(np.float32)
    found = problem(ad, values, border=border)
    (v, u), targets = drawn(found, ad, 200 * height * width, jittered=True)
    index = np.arange(len(v)) % (height * width)
    dy, dx = v * height - index // width, u * width - index % width
    for d in (dy, dx):
        assert d.min() > -1e-5 and d.max() < 1 + 1e-5
        assert abs(d.mean() - 0.5) < 0.01 and abs(d.var() - 1 / 12) < 0.003
    assert abs(np.corrcoef(dx, dy)[0, 1]) < 0.03
    pad = np.pad(values, [(2, 2), (0, 0), (0, 0)], "wrap" if border[0] == "repeat" else "edge")
    pad = np.pad(pad, [(0, 0), (2, 2), (0, 0)], "wrap" if border[1] == "repeat" else "edge")
    place = [v.astype(np.float64) * height + 1.5, u.astype(np.float64) * width + 1.5]
    expected = [map_coordinates(pad[..., c].astype(np.float64), place, order=1) for c in range(3)]
    np.testing.assert_allclose(targets, np.stack(expected, axis=-1), atol=1e-4)


@pytest.mark.parametrize("share", [0, 0.25, 0.5, 1])
@pytest.mark.parametrize("rounded", [0, 0.3, 1])
def test_shares_of_the_steps(ad, share, rounded):
    found = problem(ad, waves(4, 4, 1), dataclasses.replace(OURS, jitter=share, rounded=rounded))
    kinds = []
    for step in range(40):
        name = found.begin(step, step / 40)
        kinds.append((name, found.jittered, found.rounded))
    assert sum(jittered for _, jittered, _ in kinds) == 40 * share
    assert [r for *_, r in kinds] == [step >= 40 * (1 - rounded) for step in range(40)]
    assert len({name for name, *_ in kinds}) == len(set(kinds))  # one name for each kind
    if share == 0.25:  # spread evenly, also over those that are rounded
        assert np.diff([i for i, (_, jittered, _) in enumerate(kinds) if jittered]).tolist() == [4] * 9


def test_maps_have_the_weight_of_their_channels(ad):
    maps = {"albedo": waves(8, 8), "ao": waves(8, 8, 1) * 0.9, "roughness": waves(8, 8, 1) * 0.8}
    source = from_arrays(maps)
    found = training.build_problem(source, ImageBudget(4, 4, 4, 5, 4, 6), OURS, ad)
    assert found.weights == pytest.approx({"albedo": 0.6, "ao": 0.2, "roughness": 0.2})
    _, targets = found.batch(dr.rng(seed=ad.UInt64(0)), 64)
    assert {name: len(channels) for name, channels in targets.items()} == {"albedo": 3, "ao": 1, "roughness": 1}
    outputs = found.predict(found.net, texel_centres(ad, 8, 8))
    assert {name: len(channels) for name, channels in outputs.items()} == {"albedo": 3, "ao": 1, "roughness": 1}


# -- rounding ---------------------------------------------------------------------------------------------------------


def random_net(ad, dims=3, primaries=1, channels=3, low=-1.5, high=2.5):
    """Entries on all pieces of the fold."""
    rng = np.random.default_rng(dims)
    made = []
    for k, d in enumerate([dims] if primaries == 1 else [dims - 2, 2]):
        p = rng.uniform(low, high, (15 - 4 * k, 6, d)).astype(np.float32)
        made.append(DifferentiableArray(p.shape[:2], d, p, fold=True, border=("clamp", "repeat")))
    c = rng.uniform(low, high, (4,) * dims + (channels,)).astype(np.float32)
    return arrays.join_primaries(made, DifferentiableArray((4,) * dims, channels, c, fold=True)).alloc(ad.TensorXf)


def random_places(ad, count=300):
    return [ad.Float(aligned(x)) for x in np.random.default_rng(9).random((2, count), dtype=np.float32)]


@pytest.mark.parametrize("bits, dims", [((1,), 3), ((6,), 3), ((7,), 4), ((2, 6), 3)])
def test_rounded_entries_are_the_stored_ones(ad, bits, dims):
    net, x = random_net(ad, dims, len(bits)), random_places(ad)
    stored = training.stored_form(net, bits)
    for array, made, width in zip(net.primary, stored.primary, bits, strict=True):
        codes, steps = made.codes(), 2**width - 1
        assert codes.max() <= steps and np.ptp(codes) > 0.9 * steps and made.bits == width
        folded = 1 - np.abs(1 - np.mod(array.data.numpy()[..., : array.channels].astype(np.float64), 2))
        assert np.abs(codes / steps - folded).max() <= 0.5001 / steps
    rounded = numpy_of(training.rounded(net, bits)(x))
    np.testing.assert_allclose(rounded, numpy_of(stored(x)), atol=1e-6)
    assert np.abs(rounded - numpy_of(net(x))).max() > 1e-3  # it does something


@pytest.mark.parametrize("bits", [(4,), (2, 5)])
def test_the_gradient_passes_through_rounding(ad, bits):
    """The gradient is that of arrays which hold the rounded entries, times the sign of the fold's slope."""
    net, x = random_net(ad, 3, len(bits)), random_places(ad)
    weight = np.random.default_rng(3).uniform(-1, 1, 3)
    parts = (*net.primary, net.cascaded)
    for array in parts:
        dr.enable_grad(array.data)
    dr.backward(sum(float(w) * v for w, v in zip(weight, training.rounded(net, bits)(x), strict=True)))

    exact = []
    for array, width in zip(parts, (*bits, 8), strict=True):
        entries = np.rint(array.numpy().astype(np.float64) * (2**width - 1)) / (2**width - 1)
        exact.append(DifferentiableArray.from_numpy(entries, ad.TensorXf, array.border))
        dr.enable_grad(exact[-1].data)
    pointer = [v for primary in exact[:-1] for v in primary(x)]
    dr.backward(sum(float(w) * v for w, v in zip(weight, exact[-1](pointer), strict=True)))
    for array, other in zip(parts, exact, strict=True):
        raw = array.data.numpy()[..., : array.channels]
        slope = np.where(np.mod(raw, 2) < 1, 1, -1)
        expected = other.data.grad.numpy()[..., : array.channels] * slope
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(array.data.grad.numpy()[..., : array.channels], expected, rtol=1e-4, atol=1e-4)


# -- whole trainings --------------------------------------------------------------------------------------------------


def test_reported_qualities_are_those_of_the_decoded_image(ad):
    rng = np.random.default_rng(0)
    albedo = np.rint(255 * waves(15, 13)).astype(np.uint8)
    maps = {
        "albedo": albedo,
        "roughness": rng.integers(0, 256, (15, 13), dtype=np.uint8),
        "glow": (waves(15, 13) * 20).astype(np.float32),
    }
    source = from_arrays(maps)
    recipe = short(steps=4, dims=3)
    table, _ = trained(source, ImageBudget(8, 8, 4, 7, 3, 6), recipe)
    image = CompressedImage.from_table(table, ad.TensorXf)
    decoded = image.decode()
    errors, found = [], table.measured
    for m in source.maps:
        a, b = decoded[m.name].astype(np.float64), m.values.astype(np.float64)
        if m.name == "glow":  # the logarithms that stand for what is beyond 1
            knee = float(np.median(m.values))
            a, b = (np.log1p(np.clip(x, 0, m.values.max()) / knee) / np.log1p(m.values.max() / knee) for x in (a, b))
        assert found[f"psnr_{m.name}_db"] == pytest.approx(psnr(a, b), abs=0.01)
        errors.append(np.moveaxis((a - b) ** 2, -1, 0))
    assert found["psnr_db"] == pytest.approx(-10 * np.log10(np.concatenate(errors).mean()), abs=0.01)
    assert found["psnr_mean_db"] == pytest.approx(np.mean([found[f"psnr_{n}_db"] for n in maps]), abs=0.01)
    assert next(iter(found)) == "psnr_db"


def test_the_quality_between_texels(ad):
    """The PSNR between texels is that at other random places, up to chance."""
    values = waves(15, 13)
    source = from_arrays({"image": values})
    for border, mode in (("repeat", "grid-wrap"), ("clamp", "nearest")):
        recipe = short(steps=4, dims=3)
        size = ImageBudget(8, 8, 4, 3, 3, 6)
        table, _ = trained(source, size, recipe, border=(border,) * 2)
        u, v = np.random.default_rng(1).random((2, 50_000), dtype=np.float32)
        read = CompressedImage.from_table(table, ad.TensorXf).read(ad.Float(aligned(u)), ad.Float(aligned(v)))["image"]
        place = [v.astype(np.float64) * 15 - 0.5, u.astype(np.float64) * 13 - 0.5]
        expected = np.stack([map_coordinates(values[..., c], place, order=1, mode=mode) for c in range(3)], axis=-1)
        assert table.measured["psnr_between_db"] == pytest.approx(psnr(numpy_of(read), expected), abs=0.3)


@pytest.mark.parametrize("structure", [name for name in STRUCTURES if name not in PAGED])
def test_every_structure_makes_a_file(ad, tmp_path, structure):
    """Arrays have the shapes and bits of the size, and the file has the PSNR that was measured."""
    source = from_arrays({"image": np.rint(255 * waves(15, 13)).astype(np.uint8)})
    recipe = short(steps=2, dims=3, structure=structure)
    size = fit.sized(source, 500, recipe, 4)
    table, _ = trained(source, size, recipe)
    save_table(tmp_path / "t.npz", table)
    loaded = TASK.load(tmp_path / "t.npz")
    layout = Layout.from_json(loaded.settings["layout"])
    names = [name for name in loaded.arrays if name != "cascaded"]
    assert len(names) == len(size.primaries) and loaded.nbytes == table.nbytes == size.nbytes <= 500
    for name, (rows, columns, dims, bits) in zip(names, size.primaries, strict=True):
        assert loaded.arrays[name].shape == (rows, columns, dims) and loaded.arrays[name].bits == bits
        assert loaded.arrays[name].entries.max() < 2**bits
    decoded = CompressedImage.from_table(loaded, ad.TensorXf).decode()["image"]
    assert psnr(decoded, source.maps[0].values) == pytest.approx(table.measured["psnr_db"], abs=0.01)
    single = CompressedImage.from_table(loaded, ad.TensorXf, "float32").decode()["image"]
    np.testing.assert_allclose(single, decoded, atol=2e-3)
    assert layout == training.source_layout(source, recipe)


def test_every_improvement_can_be_switched_off(ad):
    grey = np.repeat(waves(9, 11, 1), 3, axis=-1)
    x, y = 0.4 * waves(9, 11, 2).transpose(2, 0, 1)
    normal = 0.5 + 0.5 * np.stack([x, y, np.sqrt(1 - x * x - y * y)], axis=-1)
    source = from_arrays({"albedo": grey, "normal": normal.astype(np.float32)})
    small = short(OURS, batch=PRESETS["paper"].batch // 2**12, dims=2)
    stored = {}
    for name in IMPROVEMENTS:
        recipe = without(small, [name])
        assert recipe != small, name
        recipe = dataclasses.replace(recipe, steps=3, batch=64, measure_every=3)
        stored[name] = training.source_layout(source, recipe).stored
        size = fit.sized(source, 400, recipe, 8)
        table, result = trained(source, size, recipe)
        assert result.steps == 3 and result.restarts == 0 and table.measured["psnr_db"] > 5, name
        assert table.arrays["cascaded"].shape[-1] == stored[name]
    # Grey once and normals as two channels: 3 stored; all colours 5, all components 4
    assert stored.pop("once") == 5 and stored.pop("normals") == 4 and set(stored.values()) == {3}
    with pytest.raises(ValueError, match='found the improvement "speed", allowed are once, normals'):
        without(OURS, ["speed"])


def test_without_everything_it_is_the_paper():
    paper = PRESETS["paper"]
    recipe = without(OURS, IMPROVEMENTS)
    for name in ("once", "normals", "components", "jitter", "rounded", "structure"):
        assert getattr(recipe, name) == getattr(paper, name), name
    for name in ("loss", "lr", "schedule", "batch"):
        assert getattr(recipe, name) == getattr(paper, name), name
    samples = OURS.steps * OURS.batch
    assert recipe.steps * recipe.batch == pytest.approx(samples, rel=0.01)


# -- hard cases -------------------------------------------------------------------------------------------------------


def attacks():
    rng = np.random.default_rng(0)
    noise, largest = rng.random((8, 9, 3)), np.finfo(np.float32).max
    spot = np.zeros((8, 9, 3))
    spot[3, 4] = 1e30
    return {
        "1e30": noise * 1e30,
        "the largest": noise * largest,
        "the largest of both signs": np.where(noise < 0.5, -largest, largest),
        "denormal": noise * 1e-40,
        "negative denormal": -noise * 1e-40,
        "65504 or 0": np.where(noise < 0.5, 65504, 0),
        "-0": np.full((8, 9, 3), -0.0),
        "0 or -0": np.where(noise < 0.5, 0.0, -0.0),
        "a spot": spot,
        "a dark spot": 1e30 - spot,
        "a spot on grey": np.maximum(spot * 1e-25, 0.1),
        "decades apart": noise * [1e30, 1e-30, 1],
        "of both signs": (noise - 0.5) * [1e30, 1e-30, 1],
        "a hair above 1": np.where(noise < 0.5, 1.0000001, 0),
        "black and white": np.where(noise < 0.5, 1, 0),
    }


@pytest.mark.parametrize("name", attacks())
@pytest.mark.parametrize("recipe", ["ours", "paper"])
def test_strange_values(name, recipe):
    """Nothing that is not finite, no overflow (a RuntimeWarning is an error), entries and values within their range."""
    values = attacks()[name].astype(np.float32)
    source = from_arrays({"image": values})
    recipe = short(PRESETS[recipe], steps=2, dims=2, batch=72)
    stored = training.source_layout(source, recipe).stored
    size = ImageBudget(8, 8, 4, stored, 2, 4) if stored else None
    table, result = trained(source, size, recipe)
    assert np.isfinite(list(table.measured.values())).all() and result.restarts == 0
    decoded = CompressedImage.from_table(table, array_module("llvm").TensorXf).decode()["image"]
    assert np.isfinite(decoded).all()
    low, high = min(float(values.min()), 0), max(float(values.max()), 1 if values.min() >= 0 else 1e-6)
    slack = 1e-5 * max(-low, high)
    assert float(decoded.min()) >= low - slack and float(decoded.max()) <= high + slack
