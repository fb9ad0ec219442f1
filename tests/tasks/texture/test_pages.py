"""``fit texture`` with arrays of pages: an independent reading, files, which textures get them, what they gain."""

import dataclasses

import numpy as np
import pytest
from arrays import aligned, numpy_of
from scipy.ndimage import map_coordinates

from mi_diffind.arrays.tables import StoredArray, TableError, load_table, save_table
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.task import FitRequest
from mi_diffind.maps.layout import gain_of_pages
from mi_diffind.maps.pyramid import Pyramid
from mi_diffind.maps.source import from_arrays
from mi_diffind.tasks.texture import PRESETS, TASK, arrays, fit, training
from mi_diffind.tasks.texture.compressed import CompressedTexture

TYPES = array_module("llvm")


def sparse(side=64):
    """Noise in a corner, one colour elsewhere."""
    values = np.full((side, side, 3), 0.4, np.float32)
    quarter = side // 4
    values[:quarter, :quarter] = np.random.default_rng(0).random((quarter, quarter, 3))
    return from_arrays({"albedo": np.rint(255 * values).astype(np.uint8)})


def recipe(steps=4):
    own = PRESETS["ours"]
    return dataclasses.replace(own, steps=steps, batch=2048, measure_every=steps)


def trained(source, size, steps=4):
    own = recipe(steps)
    pyramid = Pyramid.from_source(source, training.source_layout(source, own), TYPES, ("repeat", "clamp"))
    table, _ = training.fit_texture(source, size, own, FitRequest("ours", own, TYPES, progress=False), pyramid)
    return table


def paged(source, nbytes=3000):
    return arrays.paged(source.height, source.width, 3, nbytes, 4)


@pytest.fixture(scope="module")
def table():
    source = sparse()
    return trained(source, paged(source))


def bilinear(entries, x, y):
    """A grid whose outer entries are at 0 and 1, at (x, y) along columns and rows."""
    place = [[y * (entries.shape[0] - 1)], [x * (entries.shape[1] - 1)]]
    return np.concatenate([map_coordinates(channel, place, order=1) for channel in np.moveaxis(entries, -1, 0)])


def page_read(table, name, side, u, v):
    """Value of an array of pages, 16 texels wide from the first texel's centre on, at (u, v); u clamps, v wraps."""
    sizes = table.arrays[f"{name}_pages"].entries.astype(int) + 1
    starts = np.cumsum(sizes.prod(axis=2).ravel()) - sizes.prod(axis=2).ravel()
    pages, values = len(sizes), table.arrays[name].values
    y, x = (v % 1) * pages - 0.5 * pages / side, u * pages - 0.5 * pages / side
    y, x = y + pages if y < 0 else y, min(max(x, 0), pages)
    i, j = min(int(y), pages - 1), min(int(x), pages - 1)
    rows, columns = sizes[i, j]
    start = starts[i * pages + j]
    return bilinear(values[start : start + rows * columns].reshape(rows, columns, -1), x - j, y - i)


def test_reading_against_numpy(table):
    """Level 0 reads its pages alone; between levels 1 and 2 the pointers of both arrays are mixed."""
    texture = CompressedTexture.from_table(table, TYPES.TensorXf)
    cascaded = texture.arrays["cascaded"]
    rng = np.random.default_rng(1)
    for level in (0.0, 1.0, 1.25, 2.0):
        u, v = aligned(rng.random((2, 40)))
        fine = np.stack([page_read(table, "level0", 64, *p) for p in zip(u, v, strict=True)])
        coarse = np.stack([page_read(table, "level2", 16, *p) for p in zip(u, v, strict=True)])
        share = min(max(level - 1, 0), 1)
        pointer = (1 - share) * fine + share * coarse
        place = [np.full(40, level / 4), *pointer.T]
        expected = numpy_of(cascaded([TYPES.Float(aligned(x)) for x in place]))
        u, v, levels = (TYPES.Float(aligned(x)) for x in (u, v, np.full(40, level)))
        got = numpy_of(texture.filtered(u, v, levels))
        np.testing.assert_allclose(got, expected, atol=2e-3)
        if level == 0:
            np.testing.assert_allclose(numpy_of(texture.stored(u, v)), got, atol=1e-5)


def test_levels_are_continuous_and_any_is_allowed(table):
    texture = CompressedTexture.from_table(table, TYPES.TensorXf, "float32")
    u, v = np.random.default_rng(2).random((2, 64)).astype(np.float32)

    def read(level):
        levels = TYPES.Float(aligned(np.full(64, level)))
        return numpy_of(texture.filtered(TYPES.Float(aligned(u)), TYPES.Float(aligned(v)), levels))

    for level in (1, 2, 3, 4, 5):
        np.testing.assert_allclose(read(level - 1e-4), read(level + 1e-4), atol=2e-3)
    np.testing.assert_array_equal(read(np.nan), read(0))
    np.testing.assert_array_equal(read(np.inf), read(6))
    np.testing.assert_array_equal(read(-3), read(0))


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda t: t.arrays.pop("level0_pages"), "holds the arrays"),
        (lambda t: t.arrays.update(level0_pages=t.arrays["level2_pages"]), "has the shape"),
        (lambda t: t.arrays.update(level0=StoredArray(t.arrays["level0"].entries[:-1], ("clamp",),
                                                      t.arrays["level0"].scale, t.arrays["level0"].offset, 5)),
         "expected"),
    ],
)  # fmt: skip
def test_damaged_files_are_refused(table, tmp_path, change, message):
    save_table(tmp_path / "t.npz", table)
    found = load_table(tmp_path / "t.npz")
    change(found)
    save_table(tmp_path / "t.npz", found)
    with pytest.raises(TableError, match=message):
        TASK.load(tmp_path / "t.npz")


def test_which_textures_get_pages():
    """Textures with detail in few places get pages; noise and textures smaller than a page do not."""
    source = sparse()
    noise = np.random.default_rng(4).integers(0, 256, (64, 64, 3), np.uint8)
    for maps, more in ((source, True), (from_arrays({"albedo": noise}), False)):
        pyramid = Pyramid.from_source(maps, training.source_layout(maps, recipe()), TYPES, ("repeat", "clamp"))
        size = paged(maps)
        gain, _ = gain_of_pages(np.float32(pyramid.values[0]), size.dims, size.page_entries, pyramid.border)
        assert (gain >= fit.GAIN_DB) == more, gain
    assert arrays.paged(8, 8, 3, 100) is None and arrays.paged(1024, 1024, 3, 20000) is None
    assert arrays.paged(512, 512, 3, 65536).nbytes <= 65536


def test_pages_gain_what_they_are_for():
    """Pages gain 3 dB at equal bytes and steps where a sixteenth has detail; the worst level gains, too."""
    source = sparse()
    with_pages = trained(source, paged(source, 5000), 60).measured
    without = trained(source, arrays.choose(64, 64, 3, 5000), 60).measured
    assert with_pages["psnr_db"] > without["psnr_db"] + 3
    assert with_pages["psnr_worst_db"] > without["psnr_worst_db"]
