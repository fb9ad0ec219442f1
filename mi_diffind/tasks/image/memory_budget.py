"""Memory budgets of task 3: resolutions of the arrays for a number of bytes (the paper's supplement, section 1.3).

Equation 1, ``bytes = 4 N_p² + k N_c⁴``, is for square images, a four-dimensional cascaded array and one byte an entry.
Here the primary has ``rows × columns`` entries in place of ``N_p²`` (in the proportions of the image), ``dims``
channels of ``bits`` bits, and the cascaded array ``N_c^dims`` entries of one byte for each of the ``k`` channels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from ...core.units import largest_fitting

#: Best resolution ratio for compression ratios of RGB textures at 4K (the supplement's table 2).
RATIOS = {3: 128, 6: 128, 12: 80, 24: 72}

#: Resolution ratio that is safe at 12x, for the side of the image in texels (the supplement's section 1.3).
SAFE_RATIOS = {1024: 64, 2048: 64, 4096: 96}

#: Largest side of a cascaded array of 1 to 4 dimensions that is chosen by default.
CASCADED_LIMITS = (256, 64, 32, 16)

#: Useful range of the resolution ratio (the supplement's section 1.3).
RATIO_RANGE = (40, 128)

#: Steps of the paper's search: sides of a primary are multiples of the first, of a cascaded array of the second.
PRIMARY_STEP, CASCADED_STEP = 8, 4

#: Largest relative difference between wanted and actual bytes that needs no explanation.
TOLERANCE = 0.05


def resolution_ratio(compression: float, resolution: float) -> float:
    """Return the default of ``ρ = N_p / N_c`` for a compression ratio and the side of the image in texels.

    The side of a non-square image is the square root of its texels. :data:`RATIOS`, interpolated linearly in
    ``log2(compression)`` and constant outside of 3 … 24, times a factor for the resolution: 1 at 4096; up to 2048 the
    factor that makes the ratio at 12x the safe default, 64 (:data:`SAFE_RATIOS`); between them linear in
    ``log2(resolution)``. At 4K the best measured ratio, 80, is taken and not the safe one, 96. The product is limited
    to :data:`RATIO_RANGE`.
    """
    at_4k = np.interp(math.log2(compression), np.log2(list(RATIOS)), list(RATIOS.values()))
    factor = np.interp(math.log2(resolution), [11, 12], [SAFE_RATIOS[2048] / RATIOS[12], 1])
    return float(np.clip(at_4k * factor, *RATIO_RANGE))


@dataclass(frozen=True)
class CoarsePrimary:
    """A second primary array, of lower resolution.

    It holds ``dims`` coordinates of the pointer in ``bits`` bits; ``scale`` is its side as a multiple of the first's.
    """

    dims: int = 2
    bits: int = 6
    scale: float = 0.35

    def __post_init__(self):
        if self.dims < 1 or not 1 <= self.bits <= 8 or not 0 < self.scale <= 1:
            raise ValueError(f"found {self}, allowed are dims ≥ 1, 1 to 8 bits and a scale above 0 and up to 1")


@dataclass(frozen=True)
class ImageBudget:
    """Resolutions of the arrays of an image.

    - ``rows``, ``columns``: sides of the primary; ``dims``, ``bits``: coordinates of a pointer, bits of each.
    - ``cascaded``: side of the cascaded array of ``channels`` channels.
    - ``full``: the primary is as large as the image, or as the search allows; comparisons ignore it.
    - ``coarse``: a second primary, which holds some of the ``dims``.
    - ``paged``: the first primary consists of pages, whose entries and index together take the bytes of ``rows`` ×
      ``columns`` entries.
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
        """Bytes of all arrays, primaries without gaps between entries."""
        cascaded = self.channels * self.cascaded**self.dims
        return cascaded + sum((dims * bits * rows * columns + 7) // 8 for rows, columns, dims, bits in self.primaries)

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
        """``ρ``: the primary's side (non-square: the square root of its entries) over the cascaded array's."""
        return math.sqrt(self.rows * self.columns) / self.cascaded


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
    """Return the result of the paper's linear search over the sides ``N_c`` = 4, 8, 12, … of the cascaded array.

    The search minimises ``|compression − uncompressed_bytes / bytes|``, with ``N_p = ratio · N_c`` in multiples
    of 8. Equation 1 has squares only: for a non-square image the ``N_p²`` entries are spread in its proportions, in
    whole rows and columns. The primary is never larger than the image (square: than the largest multiple of 8 in it, if
    there is one).
    """
    best, distance = None, math.inf
    cascaded = 0
    while True:
        cascaded += CASCADED_STEP
        side = PRIMARY_STEP * max(1, round(ratio * cascaded / PRIMARY_STEP))
        size = ImageBudget(*_spread(side, height, width), cascaded, channels, dims, bits)
        achieved = uncompressed_bytes / size.nbytes
        if abs(compression - achieved) < distance:
            best, distance = size, abs(compression - achieved)
        if achieved <= compression:  # larger arrays only increase the difference
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
    """Return :func:`paper_search` with ``ratio``, corrected if it is more than 5% off.

    The default of ``ratio`` is :func:`resolution_ratio`.

    Sides in steps can miss ``compression`` by far (4K RGB at 12x becomes 13.4x at ρ = 80). Then the cascaded array is
    kept, or reduced until it takes at most half of the bytes, and the primary becomes the largest that fits
    (:func:`fit_bytes`): 1×1 for images so small that the smallest cascaded array (``N_c`` = 4) is too large.
    """
    ratio = ratio or resolution_ratio(compression, math.sqrt(height * width))
    size = paper_search(uncompressed_bytes, compression, channels, height, width, ratio, dims, bits)
    budget = uncompressed_bytes / compression
    if abs(size.nbytes / budget - 1) <= TOLERANCE:
        return size
    side = size.cascaded
    while side > CASCADED_STEP and channels * side**dims > budget / 2:
        side -= CASCADED_STEP
    return fit_bytes(budget, channels, height, width, side, dims, bits)


def cascaded_side(budget: float, channels: int, dims: int = 4, share: float = 0.08) -> int:
    """Return the side of a cascaded array that takes at most ``share`` of ``budget`` bytes.

    A multiple of 4, at least 4 and at most :data:`CASCADED_LIMITS`.
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
    """Return the largest primary that fits into ``budget`` bytes beside a cascaded array of side ``cascaded``.

    It has the proportions of the image (a square one exactly, others to 2% or one texel) and is no larger than it. Its
    least size is 1×1: only then can the bytes exceed ``budget``.
    """
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
    sides = range(max(1, math.ceil(wanted - margin)), min(short, math.floor(wanted + margin)) + 1)
    pairs = ((one, min(entries // one, long)) for one in sides if one <= entries)
    one, other = max(pairs, key=lambda pair: (pair[0] * pair[1], -abs(pair[0] - wanted), pair))
    rows, columns = (one, other) if height <= width else (other, one)
    return ImageBudget(rows, columns, cascaded, channels, dims, bits, full=(rows, columns) == (height, width))


def _fit_two(budget, channels, height, width, cascaded, dims, bits, coarse: CoarsePrimary) -> ImageBudget:
    """Return :func:`fit_bytes` of two primaries: both sides in proportion, then the longer side alone."""
    short, long = sorted((height, width))

    def sized(one: int, other: int) -> ImageBudget:
        rows, columns = (one, other) if height <= width else (other, one)
        return ImageBudget(rows, columns, cascaded, channels, dims, bits, (rows, columns) == (height, width), coarse)

    def largest(candidate) -> ImageBudget:
        return candidate(largest_fitting(lambda n: candidate(n).nbytes <= budget, 1, long + 1))

    best = largest(lambda n: sized(min(max(1, round(n * short / long)), short), n))
    if short < long:
        one = min(best.rows, best.columns)
        longer = [largest(lambda n, one=one: sized(one, n)) for one in (one, one + 1) if one <= short]
        best = max((size for size in longer if size.nbytes <= budget), key=lambda size: size.nbytes, default=best)
    return best


def _spread(side: int, height: int, width: int) -> tuple[int, int]:
    """Return rows and columns of about ``side²`` entries in the proportions of an image, and no larger than it."""
    if height == width:
        side = min(side, height // PRIMARY_STEP * PRIMARY_STEP or height)
        return side, side
    short, long = sorted((height, width))
    one = min(max(1, round(side * math.sqrt(short / long))), short)
    other = min(max(1, round(side**2 / one)), long)
    return (one, other) if height < width else (other, one)


def explain(size: ImageBudget, uncompressed_bytes: int, requested_bytes: float) -> str | None:
    """Return a sentence about a size that differs by more than 5% from the requested bytes, else ``None``."""
    if abs(size.nbytes / requested_bytes - 1) <= TOLERANCE:
        return None
    requested = f"{round(requested_bytes):,} bytes ({uncompressed_bytes / requested_bytes:.4g}x) were requested"
    result = f"{size.nbytes:,} bytes ({uncompressed_bytes / size.nbytes:.4g}x)"
    if size.nbytes > requested_bytes and size.rows * size.columns == 1:
        return f"{requested}, but the smallest table with a cascaded side of {size.cascaded} has {result}"
    if size.nbytes < requested_bytes and size.full:
        return f"{requested}, but the primary is as large as the image at {result}"
    return f"{requested}, but {result} are the nearest with whole sides and a cascaded side of {size.cascaded}"
