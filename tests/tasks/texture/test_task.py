"""``fit texture``: equations, sizes, arrays that are read at levels of detail, training, files."""

import copy
import dataclasses
import math
import re

import drjit as dr
import numpy as np
import pytest
from arrays import aligned, numpy_of
from scipy.ndimage import map_coordinates
from texture_files import write_manifest

from mi_diffind.arrays.tables import TableError, load_table, save_table
from mi_diffind.commands.cli import main
from mi_diffind.core.errors import UsageError
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting import task
from mi_diffind.fitting.task import FitRequest
from mi_diffind.maps.layout import Layout
from mi_diffind.maps.pyramid import Pyramid, level_sizes
from mi_diffind.maps.source import from_arrays
from mi_diffind.tasks.texture import PRESETS, TASK, FineArray, arrays, compressed, parse_structure, training
from mi_diffind.tasks.texture.arrays import (
    BLANK_LADDER,
    LADDER,
    SMOOTH_LADDER,
    PaperBudget,
    TextureBudget,
    choose,
    paper_size,
)
from mi_diffind.tasks.texture.compressed import CompressedTexture

OURS, PAPER = PRESETS["ours"], PRESETS["paper"]


@pytest.fixture(scope="module")
def ad():
    return array_module("llvm")


def waves(height=16, width=16, channels=3, periods=1):
    y, x = np.mgrid[0:height, 0:width]
    y, x = 2 * np.pi * periods * (y + 0.5) / height, 2 * np.pi * periods * (x + 0.5) / width
    found = [np.sin(x), np.cos(y), np.sin(x + y), np.cos(x - 2 * y)]
    return np.stack([0.5 + 0.4 * found[i % 4] for i in range(channels)], axis=-1).astype(np.float32)


def material(height=32, width=24, seed=0):
    """A small one, of four stored channels: grey with noise, normals, roughness that follows the grey."""
    rng = np.random.default_rng(seed)
    albedo = np.clip(waves(height, width, 1, 2) + 0.08 * rng.standard_normal((height, width, 1)), 0, 1)
    xy = 0.5 * (waves(height, width, 2, 3) - 0.5)
    normal = 0.5 + 0.5 * np.concatenate([xy, np.sqrt(1 - (xy**2).sum(axis=-1, keepdims=True))], axis=-1)
    maps = {"albedo": albedo, "normal": normal, "roughness": 1 - albedo}
    return {name: np.rint(255 * values).astype(np.uint8) for name, values in maps.items()}


def quick(recipe=OURS, **settings):
    given = {"steps": 4, "batch": 2048, "measure_every": 4, **settings}
    return dataclasses.replace(recipe, **given)


def trained(source, size, recipe, **request):
    types = array_module("llvm")
    # Of one size and one border, mostly: what differs has to be compiled anew
    border = request.pop("border", ("repeat", "clamp"))
    pyramid = Pyramid.from_source(source, training.source_layout(source, recipe), types, border)
    request = FitRequest("ours" if recipe.layered else "paper", recipe, types, progress=False, **request)
    return training.fit_texture(source, size, recipe, request, pyramid)


def sized(source, layout=None, fine="0:1:2,1:2:4", skip=2, dims=3, cascaded=5):
    layout = layout or Layout.from_source(source, filtered=True)
    arrays = parse_structure(fine) if fine else ()
    return TextureBudget(source.height, source.width, layout.stored, arrays, skip, dims, cascaded, skip + 1)


def texture_of(source, steps=2, fine="0:1:2,1:2:4", skip=2, storage="", **request):
    table, _ = trained(source, sized(source, fine=fine, skip=skip), quick(steps=steps), **request)
    return CompressedTexture.from_table(table, array_module("llvm").TensorXf, storage), table


def read(texture, u, v, level) -> np.ndarray:
    Float = texture.types.Float
    u, v, level = (Float(aligned(x)) for x in np.broadcast_arrays(*np.atleast_1d(u, v, level)))
    return numpy_of(texture.filtered(u, v, level))


# -- equations --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("base, n", [(1024, 10), (2048, 11), (4096, 12)])
def test_powers_of_uniform_numbers(ad, rng, base, n):
    """Equations 3 to 6: half of the samples below a texel's side, and the whole distribution."""
    t = 1 / base
    assert compressed.exponent(base) == pytest.approx(n)
    assert t ** (1 / n) == pytest.approx(0.5)
    u = rng.random(200_000)
    x = np.sort(compressed.footprints(ad.Float(u), "power", base).numpy())
    np.testing.assert_allclose(x, np.sort(u) ** n, rtol=2e-4, atol=1e-7)
    for fraction in (0.1, 0.25, 0.5, 0.9):
        assert x[int(fraction * len(x))] ** (1 / n) == pytest.approx(fraction, abs=0.01)
    assert x.max() < 1


def test_exponential_samples(ad, rng):
    """Equations 7 to 9."""
    t = 1 / 1024
    rate = compressed.exponential_rate(1024)
    assert rate == pytest.approx(1024 * math.log(2))
    u = 1 - rng.random(200_000)
    u[0] = 0
    x = compressed.footprints(ad.Float(u), "exponential", 1024).numpy()
    np.testing.assert_allclose(x[1:], np.minimum(-np.log(u[1:]) / rate, 1), rtol=2e-3, atol=1e-7)
    for below in (0.5 * t, t, 3 * t):
        assert np.mean(x < below) == pytest.approx(1 - math.exp(-rate * below), abs=0.01)
    assert np.isfinite(x).all() and x.max() <= 1


def test_levels_of_footprints(ad):
    """A side of 1 is the coarsest level; half the side is one level less; what is below a texel is level 0."""
    x = ad.Float([1e-9, 2**-9, 2**-4, 0.5, 1])
    np.testing.assert_allclose(compressed.footprint_level(x, 10).numpy(), [0, 0, 5, 8, 9], atol=1e-4)
    levels = np.float32([0, 0.5, 3, 9])
    back = compressed.level_footprint(ad.Float(levels), 10)
    np.testing.assert_allclose(compressed.footprint_level(back, 10).numpy(), levels, atol=1e-4)
    assert back.numpy()[-1] == pytest.approx(1) and compressed.level_footprint(0.0, 10) == pytest.approx(2**-9)


# -- sizes ------------------------------------------------------------------------------------------------------------


def test_bytes_are_equation_2():
    assert PaperBudget(640, 640, 8, 8, 3).nbytes == 3 * 640**2 + 32 + 3 * 8**3 * 8
    assert [arrays.lod_count(n, n) for n in (1, 8, 256, 1024, 2048, 4096)] == [2, 3, 8, 8, 12, 12]
    for x, rgb, rest in ((3, 80, 128), (6, 64, 96), (12, 64, 96), (24, 48, 72)):
        assert arrays.resolution_ratio(x, 3) == rgb and arrays.resolution_ratio(x, 7) == rest


@pytest.mark.parametrize("height, width", [(4096, 4096), (1024, 1024), (300, 1000), (64, 64)])
@pytest.mark.parametrize("compression", [3, 12, 24])
def test_the_papers_sizes_are_near_what_is_asked_for(height, width, compression):
    for channels in (3, 8):
        source = height * width * channels
        size = paper_size(source / compression, source, channels, height, width)
        assert size.rows <= height and size.columns <= width
        assert size.nbytes == pytest.approx(source / compression, rel=0.06) or size.cascaded == 4


@pytest.mark.parametrize("height, width", [(1024, 1024), (300, 1000), (17, 5), (1, 9), (1, 1)])
def test_our_sizes_fit(height, width):
    for channels, ladder in ((1, LADDER), (3, LADDER), (8, LADDER), (8, SMOOTH_LADDER), (8, BLANK_LADDER)):
        before = math.inf
        for compression in (1, 3, 6, 12, 24, 100):
            nbytes = height * width * channels / compression
            size = choose(height, width, channels, nbytes, ladder=ladder)
            assert size.nbytes <= before, "less asked for, more found"
            before = size.nbytes
            if size.nbytes > nbytes:
                assert size.dims == 1 and size.sides == (2,)  # among the smallest that there are
            elif height * width > 4096 and compression <= 24:
                assert size.nbytes >= 0.99 * nbytes or compression < 6
            sizes = level_sizes(height, width)
            fine = sum(math.ceil(math.prod(sizes[f.level]) * f.channels * f.bits / 8) for f in size.fine)
            coarse = sum(r * c for r, c in sizes[size.skip :]) * size.dims
            assert size.nbytes == fine + coarse + (size.skip + 1) * math.prod(size.sides) * channels


def test_structures():
    assert (
        parse_structure("0:1:2,2:3:8") == (FineArray(0, 1, 2), FineArray(2, 3, 8)) and parse_structure("auto") == "auto"
    )
    for wrong in ("", "0:1", "1:1:1,0:1:1", "0:5:1", "0:1:9", "a", "0:1:2,"):
        with pytest.raises(ValueError, match="structure: found"):
            parse_structure(wrong)


# -- reading ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made():
    """A material, its texture as bytes and as floats, and the table."""
    source = from_arrays(material())
    texture, table = texture_of(source, steps=8)
    return source, texture, CompressedTexture.from_table(table, array_module("llvm").TensorXf, "float32"), table


def interpolated(values, place):
    """The channels of a grid at one place."""
    return np.array([map_coordinates(channel, np.c_[place], order=1)[0] for channel in np.moveaxis(values, -1, 0)])


def reference(texture, u, v, level):
    """Return a read in NumPy, one place at a time, from the entries: pointers summed, then one read."""
    net, structure = texture.net, texture.net.structure

    def bilinear(values, u, v):
        rows, columns = ("wrap" if border == "repeat" else "edge" for border in texture.border)
        values = np.pad(np.pad(values, ((1, 1), (0, 0), (0, 0)), rows), ((0, 0), (1, 1), (0, 0)), columns)
        return interpolated(values, [x * (n - 2) + 0.5 for x, n in zip((v, u), values.shape, strict=False)])

    coarse, levels, start = net.coarse.numpy().astype(np.float64), {}, 0
    for i, (rows, columns) in enumerate(structure.sizes[structure.skip :], structure.skip):
        levels[i] = coarse[start : start + rows * columns].reshape(rows, columns, -1)
        start += rows * columns
    assert start == len(coarse)
    at = max(level, structure.skip)
    below, above = math.floor(at), min(math.floor(at) + 1, len(structure.sizes) - 1)
    pointer = (1 - at % 1) * bilinear(levels[below], u, v) + at % 1 * bilinear(levels[above], u, v)
    layers = list(zip(structure.layers, net.fine, strict=True))
    if structure.base:
        layer, array = layers.pop()
        share = min(max(layer.until + 1 - level, 0), 1)
        pointer = (1 - share) * pointer + share * bilinear(array.numpy().astype(np.float64), u, v)
    for layer, array in layers:
        share = min(max(layer.until + 1 - level, 0), 1)
        found = (bilinear(array.numpy().astype(np.float64), u, v) - layer.zero) * layer.scale
        pointer[: layer.channels] += share * found
    place = [min(level / structure.skip, 1), *np.clip(pointer, 0, 1)]
    cascaded = net.cascaded.numpy().astype(np.float64)
    return interpolated(cascaded, np.multiply(place, np.array(cascaded.shape[:-1]) - 1))


def test_reading_against_numpy(made, rng):
    """Where the coarsest fine array holds differences, and where it holds pointers."""
    based, _ = texture_of(made[0], steps=1, fine="0:1:2,1:3:6")
    assert based.net.structure.base and not made[1].net.structure.base
    for texture in (*made[1:3], based):
        u, v = rng.random((2, 60))
        level = np.concatenate([np.arange(texture.levels), rng.uniform(0, texture.levels - 1, 60 - texture.levels)])
        expected = [reference(texture, *place) for place in zip(u, v, level, strict=True)]
        np.testing.assert_allclose(read(texture, u, v, level), expected, atol=3e-3)


# -- what comes out ---------------------------------------------------------------------------------------------------


def psnr(a, b):
    return -10 * np.log10(np.mean((np.asarray(a, np.float64) - b) ** 2))


def test_reported_qualities(made):
    """PSNR of each level at its texel centres, of maps at level 0, and errors of means, against the pyramid."""
    source, texture, _, table = made
    pyramid, measured = Pyramid.from_source(source, texture.layout), table.measured
    assert next(iter(measured)) == "psnr_db" and measured["psnr_db"] == measured["psnr_l0_db"]
    levels = [measured[f"psnr_l{i}_db"] for i in range(texture.levels)]
    assert measured["psnr_worst_db"] == min(levels) and f"psnr_l{texture.levels}_db" not in measured
    for i, (rows, columns) in enumerate(level_sizes(source.height, source.width)):
        v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
        got = read(texture, u.ravel(), v.ravel(), i)
        maps = [texture.layout.decode(n, list(got.T)) for n in texture.layout.names]
        true = [
            texture.layout.decode(n, list(pyramid.values[i].reshape(-1, got.shape[-1]).T)) for n in texture.layout.names
        ]
        errors = np.concatenate([np.stack(a) - np.stack(b) for a, b in zip(maps, true, strict=True)])
        # (A third component of a normal that was left out is measured against the source's own at level 0)
        assert levels[i] == pytest.approx(-10 * np.log10(np.mean(errors**2)), abs=0.1 if i == 0 else 0.02)
    decoded = texture.decode()
    means = []
    for m in source.maps:
        assert measured[f"psnr_{m.name}_db"] == pytest.approx(psnr(decoded[m.name], m.values), abs=0.01)
        means += list(np.abs(decoded[m.name].mean(axis=(0, 1)) - m.values.mean(axis=(0, 1))))
    assert measured["mean_error"] == pytest.approx(max(means), abs=1e-5)


@pytest.mark.parametrize("samples", compressed.FOOTPRINTS)
def test_the_papers_arrays(samples, tmp_path, ad, rng):
    source = from_arrays(material(64, 48))
    size = paper_size(source.nbytes / 4, source.nbytes, 5, 64, 48)
    table, _ = trained(source, size, dataclasses.replace(quick(PAPER, steps=3), samples=samples))
    assert table.arrays["primary0"].shape[-1] == 3 and table.arrays["primary1"].shape == (4 * size.lods, 1)
    assert table.arrays["cascaded"].shape == (size.lods, *[size.cascaded] * 3, 5) and table.nbytes == size.nbytes
    save_table(tmp_path / "t.npz", table)
    u, v = (ad.Float(aligned(x)) for x in rng.random((2, 100)))
    for storage in ("", "float32"):
        texture = CompressedTexture.from_table(TASK.load(tmp_path / "t.npz"), ad.TensorXf, storage)
        stored = numpy_of(texture.stored(u, v))
        first, last = (numpy_of(texture.filtered(u, v, dr.opaque(ad.Float, level, 100))) for level in (0, 4))
        np.testing.assert_allclose(stored, first, atol=1e-4)
        assert np.abs(stored - last).max() > 0
        assert np.isfinite(read(texture, 0.3, 0.4, np.float32([np.nan, np.inf, -np.inf, 77]))).all()


# -- files ------------------------------------------------------------------------------------------------------------


def damaged(table, change):
    table = copy.deepcopy(table)
    change(table)
    return table


def other(name, change):
    """Damage of a table: an array with other fields, which ``change`` makes of it."""
    return lambda t: t.arrays.update({name: dataclasses.replace(t.arrays[name], **change(t.arrays[name]))})


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda t: t.arrays.pop("level1"), "holds the arrays .*, expected cascaded, coarse, level0, level1"),
        (other("coarse", lambda a: {"entries": a.entries[:-1]}), r'"coarse" has the shape .*, expected \d+ x 3'),
        (other("level0", lambda a: {"scale": (1 / 7,), "bits": 3}), '"level0" has 3 bits an entry, expected 2'),
        (lambda t: t.settings["arrays"].update(border=["clamp", "clamp"]), '"level0" has the borders .*, expected'),
        (other("cascaded", lambda a: {"scale": tuple(2 * s for s in a.scale)}), '"cascaded" has entries outside of'),
        (lambda t: t.settings["arrays"].update(skip=99), "describe no texture .the first level of the coarse array"),
        (lambda t: t.settings["arrays"].update(kind="x"), "describe no texture .arrays of the kind 'x'"),
        (lambda t: t.settings["arrays"]["layers"][0].update(level=1), "describe no texture .the levels or bits"),
        (lambda t: t.settings["arrays"]["layers"][0].update(scale=[-1]), "describe no texture .the scales"),
        (lambda t: t.settings.pop("arrays"), "describe no texture .'arrays'"),
        (lambda t: t.settings.update(layout=3), "describe no texture"),
        (lambda t: t.settings.update(level_bias=0.5), "level_bias: found 0.5, allowed are numbers from -4 to 0"),
        (lambda t: t.settings.update(level_bias="x"), "level_bias: found 'x', allowed are numbers from -4 to 0"),
    ],
)
def test_damaged_files_are_refused(made, tmp_path, change, message):
    path = tmp_path / "t.npz"
    save_table(path, damaged(made[3], change))
    with pytest.raises(TableError, match=message) as e:
        TASK.load(path)
    assert str(path) in str(e.value) and "\n" not in str(e.value)


def test_a_level_bias_is_a_finer_level(made, tmp_path):
    """Bit for bit; in decoded images, too, which stay as they are without a bias."""
    path, (u, v, level) = tmp_path / "biased.npz", np.random.default_rng(3).random((3, 200))
    save_table(path, damaged(made[3], lambda table: table.settings.update(level_bias=-0.5)))
    plain, biased = (TASK.model(t, array_module("llvm").TensorXf).image for t in (made[3], TASK.load(path)))
    assert (plain.level_bias, biased.level_bias) == (0, -0.5)
    levels = 0.5 + 3 * level.astype(np.float32)
    assert np.array_equal(read(biased, u, v, levels), read(plain, u, v, levels - np.float32(0.5)))
    assert not np.allclose(read(biased, u, v, levels), read(plain, u, v, levels), atol=1e-3)
    (name, *_) = plain.layout.names
    assert np.array_equal(biased.decode([name], level=0)[name], plain.decode([name])[name])
    shape = {"width": 8, "height": 8}
    assert np.array_equal(biased.decode([name], **shape, level=1.5)[name], plain.decode([name], **shape, level=1)[name])


# -- the command line -------------------------------------------------------------------------------------------------


def test_fit_inspect_decode(tmp_path, monkeypatch, capsys):
    import mitsuba as mi

    monkeypatch.chdir(tmp_path)
    write_manifest(tmp_path, material())
    short = ["--steps", "3", "--batch", "2048", "--border", "clamp", "--variant", "llvm_ad_rgb"]
    assert main(["fit", "texture", "m.json", "-o", "m.npz", "--compression", "4x", "--level-bias", "-0.5", *short,
                 "--shading", "off"]) == 0  # fmt: skip
    table = load_table("m.npz")
    assert table.task == "texture" and table.preset == "ours" and table.settings["source_path"] == "m.json"
    assert table.nbytes <= 32 * 24 * 5 / 4 and table.settings["level_bias"] == -0.5
    capsys.readouterr()
    assert main(["inspect", "m.npz", "--measure", "--variant", "llvm_ad_rgb"]) == 0
    shown = capsys.readouterr().out
    assert "6 levels of detail" in shown and "PSNR worst level" in shown and "read 0.5 levels finer" in shown
    assert main(["decode", "m.npz", "-o", "d.png", "--map", "albedo", "--level", "2", "--variant", "llvm_ad_rgb"]) == 0
    assert np.array(mi.Bitmap("d.png")).shape == (8, 6)
    capsys.readouterr()
    assert main(["decode", "m.npz", "-o", "d.png", "--level", "6", "--variant", "llvm_ad_rgb"]) == 2
    assert "--level: found 6, the file has levels 0 to 5" in capsys.readouterr().err


def test_options_that_do_not_go_together(tmp_path):
    source = str(tmp_path / "no.png")
    for given, message in (
        ({}, "source: not given"),
        ({"preset": "paper", "skip": 2}, "--skip: not for the preset paper"),
        ({"preset": "paper", "structure": "0:1:1"}, "--structure: not for the preset paper"),
        (
            {"preset": "paper", "footprint_samples": "levels"},
            "--footprint-samples: found levels, allowed",
        ),
    ):
        with pytest.raises(UsageError, match=re.escape(message)):
            task.fit("texture", **({"source": source} if given else {}), **given)
    write_manifest(tmp_path, {"no": material(8, 8)["albedo"]})
    for given, message in (
        ({"skip": 4}, "--skip: found 4, the texture has levels 0 to 3"),
        ({"structure": "0:1:2,2:1:4", "skip": 2}, "--skip: found 2, the structure has a fine array on level 2"),
        ({"structure": "5:1:2"}, "--skip: found 6, the texture has levels 0 to 3"),
        ({"structure": "0:4:2"}, "--structure: fine arrays: allowed are at most"),
    ):
        with pytest.raises(UsageError, match=re.escape(message)):
            task.fit("texture", source=source, variant="llvm_ad_rgb", progress=False, **given)
