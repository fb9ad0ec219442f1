"""
Bytes and resolutions: how large the arrays of task 3 are for a wanted size (the paper's supplement, section 1.3).

Equation 1, ``bytes = 4 N_p² + k N_c⁴``, is for square images, a four-dimensional cascaded array and one byte an entry.
Here the primary has ``rows × columns`` entries in place of ``N_p²`` (in the proportions of the image), ``dims``
channels of ``bits`` bits, and the cascaded array ``N_c^dims`` entries of one byte for each of the ``k`` channels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from ...units import largest_fitting

#: Best resolution ratio for compression ratios of RGB textures at 4K (the supplement's table 2).
RATIOS = {3: 128, 6: 128, 12: 80, 24: 72}

#: Resolution ratio that is safe at 12x, for the side of the image in texels (the supplement's section 1.3).
SAFE_RATIOS = {1024: 64, 2048: 64, 4096: 96}

#: Largest side of a cascaded array that is chosen by itself, of 1 to 4 dimensions.
CASCADED_LIMITS = (256, 64, 32, 16)

#: Useful range of the resolution ratio (the supplement's section 1.3).
RATIO_RANGE = (40, 128)

#: Both sides of a primary that the paper's search finds are multiples of the first, the cascaded array's of the second.
PRIMARY_STEP, CASCADED_STEP = 8, 4

#: How far the bytes may be from what was asked for before :func:`explain` says why.
TOLERANCE = 0.05


def image_bytes(primary_entries: int, cascaded: int, channels: int, dims: int = 4, bits: int = 8) -> int:
    """
    Bytes of a primary array of ``primary_entries`` texels (``dims`` channels of ``bits`` bits, without gaps) and a
    cascaded array of side ``cascaded`` (``dims`` dimensions, one byte a channel).

    With ``primary_entries = N_p²`` and the defaults this is the supplement's equation 1: ``4 N_p² + k N_c⁴``.
    """
    return (dims * bits * primary_entries + 7) // 8 + channels * cascaded**dims


def ratio(compression: float, resolution: float) -> float:
    """
    Default of the resolution ratio ``ρ = N_p / N_c`` for a compression ratio and the side of the image in texels
    (non-square: the square root of its texels).

    :data:`RATIOS`, interpolated linearly in ``log2(compression)`` and constant outside of 3 … 24, times a factor for
    the resolution: 1 at 4096, and from 2048 downwards what makes it the safe default at 12x, 64 (:data:`SAFE_RATIOS`;
    at 4K the 80 that was measured best is taken, not the safe 96), interpolated linearly in ``log2(resolution)``. The
    product is limited to :data:`RATIO_RANGE`.
    """
    for name, value in (("compression", compression), ("resolution", resolution)):
        if not (value > 0 and math.isfinite(value)):
            raise ValueError(f"{name}: found {value}, allowed are finite numbers > 0")
    at_4k = np.interp(math.log2(compression), np.log2(list(RATIOS)), list(RATIOS.values()))
    factor = np.interp(math.log2(resolution), [11, 12], [SAFE_RATIOS[2048] / RATIOS[12], 1])
    return float(np.clip(at_4k * factor, *RATIO_RANGE))


_default_ratio = ratio  # where "ratio" is the argument that replaces it


@dataclass(frozen=True)
class CoarsePrimary:
    """
    A second primary array, of lower resolution: how many ``dims`` of the pointer it holds, their ``bits``, and its
    sides in units of those of the first, ``scale``.
    """

    dims: int = 2
    bits: int = 6
    scale: float = 0.35

    def __post_init__(self):
        if self.dims < 1 or not 1 <= self.bits <= 8 or not 0 < self.scale <= 1:
            raise ValueError(f"found {self}, allowed are dims ≥ 1, 1 to 8 bits and a scale above 0 and up to 1")


@dataclass(frozen=True)
class ImageBudget:
    """
    Resolutions of a pair of arrays: the primary's ``rows`` and ``columns``, the side of the ``cascaded`` array, its
    ``channels``, the ``dims`` of the pointer and the ``bits`` of each of its coordinates. With ``coarse``, so many of
    the ``dims`` are in a second primary.

    ``paged``: the first primary consists of pages, whose entries and index together take the bytes of so many rows and
    columns; where they are, the image decides.

    ``full`` says that the primary is as large as the image, or as the search lets it be; sizes compare without it.
    """

    rows: int
    columns: int
    cascaded: int
    channels: int
    dims: int = 4
    bits: int = 8
    full: bool = field(default=False, compare=False)
    coarse: CoarsePrimary | None = None
    paged: bool = False

    def __post_init__(self):
        if self.coarse is not None and self.coarse.dims >= self.dims:
            raise ValueError(f"coarse: found {self.coarse.dims} of {self.dims} dims, at least one has to remain")
        for name in ("rows", "columns", "cascaded", "channels", "dims", "bits"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: found {getattr(self, name)}, allowed are whole numbers ≥ 1")

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays, :func:`image_bytes`."""
        found = self.channels * self.cascaded**self.dims
        return found + sum((dims * bits * rows * columns + 7) // 8 for rows, columns, dims, bits in self.primaries)

    @property
    def primaries(self) -> list[tuple[int, int, int, int]]:
        """Rows, columns, dims and bits of each primary array."""
        if self.coarse is None:
            return [(self.rows, self.columns, self.dims, self.bits)]
        c = self.coarse
        sides = (max(1, round(self.rows * c.scale)), max(1, round(self.columns * c.scale)))
        return [(self.rows, self.columns, self.dims - c.dims, self.bits), (*sides, c.dims, c.bits)]

    @property
    def ratio(self) -> float:
        """``ρ``, the primary's side (non-square: the square root of its entries) over the cascaded array's."""
        return math.sqrt(self.rows * self.columns) / self.cascaded

    def compression(self, uncompressed_bytes: int) -> float:
        """How many times smaller than ``uncompressed_bytes`` this is."""
        return uncompressed_bytes / self.nbytes


# -- resolutions from bytes -------------------------------------------------------------------------------------------


def paper_search(
    uncompressed_bytes: int,
    compression: float,
    channels: int,
    height: int,
    width: int,
    ratio: float,
    dims: int = 4,
    bits: int = 8,
) -> ImageBudget:
    """
    The paper's linear search: of all sides ``N_c`` = 4, 8, 12, … of the cascaded array, the one that minimises
    ``|compression − uncompressed_bytes / bytes|``, with ``N_p = ratio · N_c`` rounded to a multiple of 8.

    Where equation 1 has squares only, a non-square image spreads the ``N_p²`` entries in its own proportions, in whole
    rows and columns. The primary is never larger than the image (a square one: than the largest multiple of 8 in it,
    as long as there is one).
    """
    _check_image(uncompressed_bytes, channels, height, width)
    if not (compression > 0 and math.isfinite(compression)):
        raise ValueError(f"compression: found {compression}, allowed are finite numbers > 0")
    if not (ratio > 0 and math.isfinite(ratio)):
        raise ValueError(f"ratio: found {ratio}, allowed are finite numbers > 0")
    best, distance = None, math.inf
    cascaded = 0
    while True:
        cascaded += CASCADED_STEP
        side = PRIMARY_STEP * max(1, round(ratio * cascaded / PRIMARY_STEP))
        size = ImageBudget(*_spread(side, height, width), cascaded, channels, dims, bits)
        achieved = size.compression(uncompressed_bytes)
        if abs(compression - achieved) < distance:
            best, distance = size, abs(compression - achieved)
        if achieved <= compression:  # more bytes only lead away
            largest = _spread(PRIMARY_STEP * max(height, width), height, width)
            return replace(best, full=(best.rows, best.columns) == largest)


def search(
    uncompressed_bytes: int,
    compression: float,
    channels: int,
    height: int,
    width: int,
    dims: int = 4,
    bits: int = 8,
    ratio: float | None = None,
) -> ImageBudget:
    """
    The resolutions for a compression ratio: :func:`paper_search` with ``ratio``, by default that of :func:`ratio`.

    Sides in such steps may miss ``compression`` by far (4K RGB asked for 12x gets 13.4x at ρ = 80). If it is by more
    than 5%, the cascaded array is kept, unless it alone is more than half of what was asked for, and the primary
    becomes what fits, :func:`fit_bytes`: down to 1×1 for images so small that even the smallest cascaded array (``N_c``
    = 4) is more than was asked for.
    """
    _check_image(uncompressed_bytes, channels, height, width)
    if ratio is None:
        ratio = _default_ratio(compression, math.sqrt(height * width))
    size = paper_search(uncompressed_bytes, compression, channels, height, width, ratio, dims, bits)
    budget = uncompressed_bytes / compression
    if abs(size.nbytes / budget - 1) <= TOLERANCE:
        return size
    side = size.cascaded
    while side > CASCADED_STEP and channels * side**dims > budget / 2:
        side -= CASCADED_STEP
    return fit_bytes(budget, channels, height, width, side, dims, bits)


def cascaded_side(budget: float, channels: int, dims: int = 4, share: float = 0.08) -> int:
    """
    The side of a cascaded array that takes about ``share`` of ``budget`` bytes: a multiple of 4 from 4 to
    :data:`CASCADED_LIMITS`, no larger than that unless it is the smallest.
    """
    side = int((max(budget * share, 1) / channels) ** (1 / dims) + 1e-9)
    return min(max(CASCADED_STEP, side // CASCADED_STEP * CASCADED_STEP), CASCADED_LIMITS[dims - 1])


def fit_bytes(
    budget: float,
    channels: int,
    height: int,
    width: int,
    cascaded: int,
    dims: int = 4,
    bits: int = 8,
    coarse: CoarsePrimary | None = None,
) -> ImageBudget:
    """
    The largest primary that fits into ``budget`` bytes beside a cascaded array of side ``cascaded``, in the proportions
    of the image (a square one exactly, others to 2% or one texel) and no larger than it. At least 1×1: only then can
    the bytes exceed ``budget``.
    """
    _check_image(1, channels, height, width)
    if not math.isfinite(budget):
        raise ValueError(f"budget: found {budget}, allowed are finite numbers of bytes")
    if coarse is not None:
        return _fit_two(budget, channels, height, width, cascaded, dims, bits, coarse)
    entries = int((budget - channels * cascaded**dims) * 8) // (dims * bits)
    entries = min(max(entries, 1), height * width)
    if height == width:
        side = math.isqrt(entries)
        return ImageBudget(side, side, cascaded, channels, dims, bits, full=side == height)
    short, long = sorted((height, width))
    wanted = short * math.sqrt(entries / (height * width))
    margin = max(1.0, 0.02 * wanted)
    best = None
    for one in range(max(1, math.ceil(wanted - margin)), min(short, math.floor(wanted + margin)) + 1):
        other = min(entries // one, long)
        if other >= 1:
            rank = (one * other, -abs(one - wanted))
            best = max(best, (rank, one, other)) if best else (rank, one, other)
    _, one, other = best
    rows, columns = (one, other) if height <= width else (other, one)
    return ImageBudget(rows, columns, cascaded, channels, dims, bits, full=(rows, columns) == (height, width))


def _fit_two(budget, channels, height, width, cascaded, dims, bits, coarse: CoarsePrimary) -> ImageBudget:
    """:func:`fit_bytes` of two primaries: the sides in proportion, then the longer one alone, both by bisection."""
    short, long = sorted((height, width))

    def sized(one: int, other: int) -> ImageBudget:
        rows, columns = (one, other) if height <= width else (other, one)
        return ImageBudget(rows, columns, cascaded, channels, dims, bits, (rows, columns) == (height, width), coarse)

    def largest(at) -> ImageBudget:
        return at(largest_fitting(lambda n: at(n).nbytes <= budget, 1, long + 1))

    best = largest(lambda n: sized(min(max(1, round(n * short / long)), short), n))
    if short < long:
        one = min(best.rows, best.columns)
        longer = [largest(lambda n, one=one: sized(one, n)) for one in (one, one + 1) if one <= short]
        best = max((size for size in longer if size.nbytes <= budget), key=lambda size: size.nbytes, default=best)
    return best


def _spread(side: int, height: int, width: int) -> tuple[int, int]:
    """Rows and columns of about ``side²`` entries in the proportions of an image, and no larger than it."""
    if height == width:
        side = min(side, height // PRIMARY_STEP * PRIMARY_STEP or height)
        return side, side
    short, long = sorted((height, width))
    one = min(max(1, round(side * math.sqrt(short / long))), short)
    other = min(max(1, round(side**2 / one)), long)
    return (one, other) if height < width else (other, one)


def _check_image(uncompressed_bytes: int, channels: int, height: int, width: int) -> None:
    for name, value in (
        ("uncompressed_bytes", uncompressed_bytes),
        ("channels", channels),
        ("height", height),
        ("width", width),
    ):
        if not value >= 1:
            raise ValueError(f"{name}: found {value}, allowed are numbers ≥ 1")


# -- what was asked for ------------------------------------------------------------------------------------------------


def explain(size: ImageBudget, uncompressed_bytes: int, asked_bytes: float) -> tuple[float, str | None]:
    """The compression ratio that ``size`` reaches and, unless its bytes are within 5% of ``asked_bytes``, why not."""
    achieved = size.compression(uncompressed_bytes)
    if abs(size.nbytes / asked_bytes - 1) <= TOLERANCE:
        return achieved, None
    asked = f"{round(asked_bytes):,} bytes ({uncompressed_bytes / asked_bytes:.4g}x) were asked for"
    found = f"{size.nbytes:,} bytes ({achieved:.4g}x)"
    if size.nbytes > asked_bytes and size.rows * size.columns == 1:
        return achieved, f"{asked}, but the smallest table with a cascaded side of {size.cascaded} has {found}"
    if size.nbytes > asked_bytes and size.cascaded <= CASCADED_STEP:
        return achieved, f"{asked}, but the smallest table with a resolution ratio of {size.ratio:.3g} has {found}"
    if size.nbytes < asked_bytes and size.full:
        return achieved, (
            f"{asked}, but at {found} the primary is as large as the image and more of it would be of no use"
        )
    return achieved, (
        f"{asked}, but {found} are the nearest that whole sides of the primary allow beside a cascaded side of "
        f"{size.cascaded}"
    )
