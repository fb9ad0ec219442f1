"""Sizes of task 3: equation 1, the paper's search, exact fits, and what a user may ask for."""

import itertools
import math
from types import SimpleNamespace

import pytest

from mi_diffind.core import units
from mi_diffind.core.errors import UsageError
from mi_diffind.maps.model import requested_bytes
from mi_diffind.tasks.image import arrays
from mi_diffind.tasks.image.arrays import ImageBudget, fit_bytes, search

IMAGES = [(1, 1), (1, 4096), (4096, 1), (7, 5), (64, 64), (100, 100), (333, 1000), (1024, 1024), (4096, 4096)]


@pytest.mark.parametrize("side, cascaded, channels", [(8, 4, 1), (960, 12, 3), (2048, 16, 7), (1, 1, 16)])
def test_bytes_are_equation_1(side, cascaded, channels):
    assert ImageBudget(side, side, cascaded, channels).nbytes == 4 * side**2 + channels * cascaded**4
    assert ImageBudget(10, 10, 8, 3, dims=3).nbytes == 3 * 100 + 3 * 8**3
    assert ImageBudget(4, 25, 8, 3, dims=2, bits=16).nbytes == 2 * 2 * 100 + 3 * 8**2
    assert ImageBudget(1, 3, 4, 1, dims=3, bits=5).nbytes == 6 + 64  # 45 bits


def test_ratio_is_table_2_at_4k():
    assert [arrays.resolution_ratio(e, 4096) for e in (3, 6, 12, 24)] == [128, 128, 80, 72]
    assert arrays.resolution_ratio(math.sqrt(12 * 24), 4096) == pytest.approx(76)  # half-way in log2
    assert arrays.resolution_ratio(1, 4096) == arrays.resolution_ratio(0.1, 8192) == 128
    assert arrays.resolution_ratio(1000, 4096) == 72
    assert [arrays.resolution_ratio(3, n) for n in (1, 1024, 2048)] == pytest.approx([128 * 64 / 80] * 3)
    assert arrays.resolution_ratio(3, 2048 * math.sqrt(2)) == pytest.approx(128 * 0.9)
    assert [arrays.resolution_ratio(12, n) for n in (1024, 2048)] == pytest.approx([64] * 2)  # the safe default
    values = [arrays.resolution_ratio(e, n) for e in (0.01, 1, 5, 12, 100, 1e6) for n in (1, 500, 3000, 1e5)]
    assert min(values) >= 40 and max(values) <= 128


@pytest.mark.parametrize(
    "side, channels, compression, ratio",
    [(4096, 3, 3, 128), (4096, 3, 6, 128), (4096, 3, 12, 80), (4096, 3, 24, 72), (4096, 8, 12, 96), (2048, 3, 12, 64),
     (1024, 3, 12, 64), (1024, 1, 2.5, 40)],
)  # fmt: skip
def test_search_is_the_papers(side, channels, compression, ratio):
    uncompressed = side**2 * channels
    candidates = []
    for cascaded in range(4, 257, 4):
        primary = min(round(ratio * cascaded / 8) * 8, side)
        candidates.append((cascaded, primary, 4 * primary**2 + channels * cascaded**4))
    cascaded, primary, nbytes = min(candidates, key=lambda c: abs(compression - uncompressed / c[2]))
    size = search(uncompressed, compression, channels, side, side, ratio=ratio)
    assert size.cascaded == cascaded and uncompressed / size.nbytes == pytest.approx(compression, rel=0.05)
    if size.nbytes == nbytes:
        assert size == ImageBudget(primary, primary, cascaded, channels)
    else:  # more than 5% off: the primary is resized
        assert abs(uncompressed / nbytes / compression - 1) > 0.04


def test_side_of_the_cascaded_array():
    assert arrays.cascaded_side(2**20, 4, 4, 1) == 16 and arrays.cascaded_side(2**20, 4, 4, 0.05) == 8
    assert arrays.cascaded_side(1, 16) == 4 and arrays.cascaded_side(1e12, 1) == 16
    assert arrays.cascaded_side(1e12, 1, 2) == 64
    with_share = arrays.cascaded_side(10**6, 5, 4, 0.1)
    assert 5 * with_share**4 <= 10**5 < 5 * (with_share + 4) ** 4


def test_search_keeps_the_proportions():
    square = search(2048**2 * 3, 6, 3, 2048, 2048, ratio=64)
    wide = search(2048**2 * 3, 6, 3, 1024, 4096, ratio=64)
    tall = search(2048**2 * 3, 6, 3, 4096, 1024, ratio=64)
    assert (wide.rows, wide.columns) == (tall.columns, tall.rows)
    assert wide.columns / wide.rows == pytest.approx(4, rel=0.01)
    assert wide.nbytes == pytest.approx(square.nbytes, rel=0.01)
    size = search(256**2 * 3, 12, 3, 256, 256)  # of a small image, the primary shrinks
    assert size.cascaded == 4 and 256**2 * 3 / size.nbytes == pytest.approx(12, rel=0.05)
    assert search(1, 12, 1, 1, 1) == ImageBudget(1, 1, 4, 1)


@pytest.mark.parametrize("dims", [2, 3, 4])
@pytest.mark.parametrize("height, width", IMAGES)
@pytest.mark.parametrize("compression", [0.5, 3, 12, 1e4])
def test_search_stays_within_the_image(height, width, compression, dims):
    size = search(height * width * 3, compression, 3, height, width, dims)
    assert 1 <= size.rows <= height and 1 <= size.columns <= width
    assert size.cascaded >= 4 and size.cascaded % 4 == 0 and size.dims == dims


@pytest.mark.parametrize("dims, bits", [(4, 8), (3, 8), (2, 8), (4, 5), (4, 16)])
@pytest.mark.parametrize("height, width", IMAGES)
def test_fit_is_near_and_never_above(height, width, dims, bits):
    for budget, cascaded in itertools.product((100, 5_000, 262_144, 10_000_000), (4, 8, 12)):
        size = fit_bytes(budget, 3, height, width, cascaded, dims, bits)
        assert 1 <= size.rows <= height and 1 <= size.columns <= width and size.cascaded == cascaded
        least = ImageBudget(1, 1, cascaded, 3, dims, bits).nbytes
        assert size.nbytes <= max(budget, least)
        assert size.full == ((size.rows, size.columns) == (height, width))
        if least <= budget and not size.full:
            per_texel = dims * bits / 8
            line = per_texel * (2 * min(size.rows, size.columns) + 1) + 1  # another one is too much
            assert budget - size.nbytes <= line
            if size.rows * size.columns > 10_000 and min(size.rows, size.columns) > 50:
                assert size.rows / size.columns == pytest.approx(height / width, rel=0.05)


def test_fit_of_exactly_the_image():
    nbytes = 4 * 35 + 3 * 4**4
    size = fit_bytes(nbytes, 3, 7, 5, 4)
    assert (size.rows, size.columns, size.full) == (7, 5, True)
    assert fit_bytes(nbytes - 1, 3, 7, 5, 4).rows * 5 < 35


QUANTITIES = {
    units.parse_compression: {"12x": 12, "12": 12, " 7.5X ": 7.5, "1e2×": 100, ".5x": 0.5, 3: 3},
    units.parse_bytes: {
        "262144": 262144, "256k": 262144, "256K": 262144, "1.5M": 1572864, "1 MiB": 1048576, "2kB": 2048, "1G": 2**30,
        1000: 1000,
    },
    units.parse_bpp: {"2": 2, "0.5": 0.5, 1.25: 1.25},
}  # fmt: skip


@pytest.mark.parametrize("parse", QUANTITIES)
def test_quantities(parse):
    assert {text: parse(text) for text in QUANTITIES[parse]} == QUANTITIES[parse]


@pytest.mark.parametrize("parse", QUANTITIES)
@pytest.mark.parametrize(
    "text", ["0", "-1", "nan", "inf", "1e999", "", "x", "twelve", "1_000", "1,5", "12 x 3", "٣", "0x10", math.nan, None]
)
def test_nonsense_is_one_sentence(parse, text):
    with pytest.raises(ValueError, match=r"is not .*, allowed are finite numbers > 0") as e:
        parse(text)
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("text", ["0.5", "1e18G"])
def test_bytes_out_of_range(text):
    with pytest.raises(ValueError, match="allowed are 1 to 2"):
        units.parse_bytes(text)


def test_a_size_is_asked_for_in_one_way():
    def size(nbytes=3 * 1024**2, texels=1024**2, **given):
        options = dict.fromkeys(("compression", "bytes", "bpp")) | given
        return requested_bytes(options, SimpleNamespace(nbytes=nbytes, texels=texels))

    assert size() == size(compression=12.0) == size(bytes=262144) == size(bpp=2.0) == 262144
    assert size(3, 1, compression=1000.0) == 1
    with pytest.raises(UsageError, match="found compression, bpp, give exactly one"):
        size(compression=12.0, bpp=2.0)
    with pytest.raises(UsageError, match="out of range"):
        size(compression=1e-320)
    with pytest.raises(UsageError, match="bpp 1e308 is out of range"):
        size(bpp=1e308)


def test_more_than_fits_is_refused(monkeypatch):
    """A size that fits exactly is allowed, one byte more is not."""
    assert 2**28 < units.memory() < 2**45
    monkeypatch.setattr(units, "memory", lambda: 3 * 2**30)
    units.check_memory("batch", 10, 3 * 2**30)
    with pytest.raises(UsageError, match="batch: found 1,000, which takes about 3 GiB of memory, this machine has 3"):
        units.check_memory("batch", 1000, 3 * 2**30 + 1)
    units.check_size("bytes", 2**20, 2**20)
    with pytest.raises(UsageError, match="bytes: found 1,048,577 bytes, a table file holds at most 1,048,576"):
        units.check_size("bytes", 2**20 + 1, 2**20)


def test_largest_fitting():
    assert [units.largest_fitting(lambda n, most=most: n <= most, 0, 100) for most in (-3, 7, 250)] == [0, 7, 99]
    assert units.largest_fitting(lambda x: x * x <= 2, 0.0, 2.0, steps=40) == pytest.approx(2**0.5)
