"""Memory budgets of task 4: resolutions of the arrays for a number of bytes.

The paper's arrays follow equation 2 of the supplement, ``bytes = 3 N_p0² + N_p1 + k N_c³ N_lod``, a table of ratios
``ρ = N_p0 / N_c`` and a linear search (:func:`paper_size`). Our arrays lie on the grids of levels of detail, so only
the channels and bits of the fine arrays are chosen (:func:`choose`).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np

from ...arrays.pages import SIDE_BITS, most_entries, page_counts
from ...maps.pyramid import level_sizes

#: Best resolution ratio for compression ratios of textures at 4K (the supplement's table 4): RGB, and materials.
RATIOS = {3: 80, 6: 64, 12: 64, 24: 48}
MATERIAL_RATIOS = {3: 128, 6: 96, 12: 96, 24: 72}

#: Entries of the cascaded array along the footprint, by the smallest side of a texture in texels.
LODS = {1024: 8, 2048: 12}

#: Steps of the paper's search: sides are multiples of these (supplement 1.3).
PRIMARY_STEP, CASCADED_STEP = 8, 4

#: Largest relative difference between wanted and actual bytes that needs no explanation.
TOLERANCE = 0.05


def paper_bytes(primary: int, lods: int, cascaded: int, channels: int) -> int:
    """Return the bytes of the paper's arrays (equation 2).

    ``primary`` is N_p0², ``lods`` is N_lod (N_p1 is four times that), ``cascaded`` is N_c and ``channels`` is k.
    """
    return 3 * primary + 4 * lods + channels * cascaded**3 * lods


def lods_of(height: int, width: int) -> int:
    """Return ``N_lod`` of a texture: :data:`LODS`; below 1024 texels ``log2`` of the side, within 2 … 8."""
    side = max(height, width)
    if side < min(LODS):
        return min(8, max(2, round(math.log2(side))))
    return next(n for base, n in reversed(LODS.items()) if side >= base)


def ratio(compression: float, channels: int) -> float:
    """Return the default of ``ρ``: :data:`RATIOS` for up to three channels, else :data:`MATERIAL_RATIOS`.

    Interpolated linearly in ``log2(compression)``, constant outside of 3 … 24. The supplement gives values for 4K only.
    """
    table = RATIOS if channels <= 3 else MATERIAL_RATIOS
    return float(np.interp(math.log2(compression), np.log2(list(table)), list(table.values())))


@dataclass(frozen=True)
class PaperBudget:
    """Resolutions of the paper's arrays: ``rows`` × ``columns`` of primary 0, ``lods`` × ``cascaded``³ entries."""

    rows: int
    columns: int
    lods: int
    cascaded: int
    channels: int

    @property
    def nbytes(self) -> int:
        return paper_bytes(self.rows * self.columns, self.lods, self.cascaded, self.channels)


def paper_size(
    nbytes: float, source_bytes: int, channels: int, height: int, width: int, rho: float | None = None
) -> PaperBudget:
    """Return the result of the paper's linear search over the sides ``N_c`` = 4, 8, ….

    The search minimises the difference of compression ratios, with ``N_p0 = ρ N_c`` in multiples of 8 and no larger
    than the image; ``rho`` is by default :func:`ratio`. If the best is more than 5% off, primary 0 is resized to fit
    beside the same ``N_c``, or beside a smaller one if the cascaded array alone takes more than half of the bytes.
    """
    lods, wanted = lods_of(height, width), source_bytes / nbytes
    rho = rho or ratio(max(wanted, 1e-6), channels)
    best, distance, cascaded = None, math.inf, 0
    while True:
        cascaded += CASCADED_STEP
        side = PRIMARY_STEP * max(1, round(rho * cascaded / PRIMARY_STEP))
        size = PaperBudget(*_spread(side**2, height, width), lods, cascaded, channels)
        if abs(source_bytes / size.nbytes - wanted) < distance:
            best, distance = size, abs(source_bytes / size.nbytes - wanted)
        if size.nbytes >= nbytes:  # larger arrays only increase the difference
            break
    if abs(best.nbytes / nbytes - 1) <= TOLERANCE:
        return best
    cascaded = best.cascaded
    while cascaded > CASCADED_STEP and channels * cascaded**3 * lods > nbytes / 2:
        cascaded -= CASCADED_STEP
    entries = (nbytes - paper_bytes(0, lods, cascaded, channels)) / 3
    return PaperBudget(*_spread(max(1, entries), height, width), lods, cascaded, channels)


def _spread(entries: float, height: int, width: int) -> tuple[int, int]:
    """Return rows and columns of at most ``entries`` entries, in the proportions of an image and within it."""
    short, long = sorted((height, width))
    one = min(max(1, int(math.sqrt(entries * short / long) + 1e-9)), short)
    other = min(max(1, int(entries / one + 1e-9)), long)
    other = min(other, one) if short == long else other
    return (one, other) if height <= width else (other, one)


@dataclass(frozen=True)
class FineArray:
    """A fine array on the grid of a ``level`` of detail, with so many ``channels`` of ``bits`` bits."""

    level: int
    channels: int
    bits: int

    def __post_init__(self):
        if self.level < 0 or not 1 <= self.channels <= 4 or not 1 <= self.bits <= 8:
            raise ValueError(f"found {self}, allowed are levels from 0 on, 1 to 4 channels and 1 to 8 bits")


@dataclass(frozen=True)
class TextureBudget:
    """Resolutions of our arrays.

    - ``fine``: the fine arrays, the finest first.
    - ``skip``: first level of detail of the coarse array, whose pointers have ``dims`` coordinates of ``bits`` bits.
    - ``cascaded``: side of the cascaded array, which has ``channels`` channels and ``knots`` entries along the level of
      detail (1: no such axis).
    - ``pages``: levels with arrays of pages, which share ``page_bytes``, entries of ``page_bits`` bits.
    """

    height: int
    width: int
    channels: int
    fine: tuple[FineArray, ...]
    skip: int
    dims: int
    cascaded: int
    knots: int = 1
    bits: int = 8
    pages: tuple[int, ...] = ()
    page_bytes: int = 0
    page_bits: int = 5

    def __post_init__(self):
        levels = [f.level for f in self.fine]
        if levels != sorted(set(levels)) or (levels and levels[-1] >= self.skip):
            raise ValueError(f"fine arrays: found the levels {levels}, allowed are different ones below {self.skip}")
        if not 0 <= self.skip < len(level_sizes(self.height, self.width)):
            raise ValueError(
                f"skip: found {self.skip}, the texture has {len(level_sizes(self.height, self.width))} levels"
            )
        if any(f.channels > self.dims for f in self.fine):
            raise ValueError(f"fine arrays: allowed are at most {self.dims} channels, the coordinates of a pointer")

    @property
    def base(self) -> bool:
        """Whether the coarsest fine array holds pointers: it has all coordinates in :data:`BASE_BITS` bits or more."""
        return bool(self.fine) and self.fine[-1].channels == self.dims and self.fine[-1].bits >= BASE_BITS

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays, each rounded up."""
        sizes = level_sizes(self.height, self.width)
        fine = sum(math.ceil(math.prod(sizes[f.level]) * f.channels * f.bits / 8) for f in self.fine)
        coarse = math.ceil(sum(map(math.prod, sizes[self.skip :])) * self.dims * self.bits / 8)
        return fine + coarse + self.knots * self.cascaded**self.dims * self.channels + self.page_bytes

    @property
    def page_entries(self) -> int:
        """Entries of all pages together, which share ``page_bytes`` with their indices."""
        sizes = level_sizes(self.height, self.width)
        index = sum(math.ceil(2 * SIDE_BITS[1] * math.prod(page_counts(sizes[level])) / 8) for level in self.pages)
        return int((self.page_bytes - index) * 8 / (self.page_bits * self.dims))


def parse_structure(text: str) -> tuple[FineArray, ...]:
    """Return the fine arrays of a text such as ``0:1:2,1:2:4`` (level, channels, bits). Raises ``ValueError``."""
    if not re.fullmatch(r"\d+:\d+:\d+(,\d+:\d+:\d+)*", text, re.ASCII):
        raise ValueError(f'structure: found {text!r}, allowed are LEVEL:CHANNELS:BITS,… as in 0:1:2,1:2:4, and "auto"')
    fine = tuple(FineArray(*map(int, part.split(":"))) for part in text.split(","))
    if [f.level for f in fine] != sorted({f.level for f in fine}):
        raise ValueError(f"structure: found {text!r}, levels have to grow from array to array")
    return fine


#: Least bits of a fine array that holds pointers in place of differences.
BASE_BITS = 5

#: Structures in the order of their bytes: fine arrays, and the first level of the coarse array. Found by trainings: a
#: level has a quarter of the entries of the one below it and room for more bits; the finest needs one or two channels.
LADDER: tuple[tuple[str, int], ...] = (
    ("0:1:2,2:2:4", 3),
    ("0:1:2,1:1:4,2:3:6", 3),
    ("0:1:2,1:2:4,2:3:6", 3),
    ("0:1:3,1:2:4,2:3:6", 3),
    ("0:1:4,1:2:4,2:3:6", 3),
    ("0:2:3,1:2:4,2:3:6", 3),
    ("0:2:3,1:3:4,2:3:6", 3),
    ("0:2:4,1:3:6", 2),
    ("0:3:4,1:3:6", 2),
    ("0:3:5,1:3:6", 2),
    ("0:3:6,1:3:6", 2),
    ("0:3:8,1:3:8", 2),
)

#: Structures of smooth textures, whose finest level needs an array only where bytes are plenty.
SMOOTH_LADDER: tuple[tuple[str, int], ...] = (
    ("1:2:4,2:3:6", 3),
    ("1:3:4,2:3:6", 3),
    ("1:3:6,2:3:6", 3),
    ("1:3:8,2:3:8", 3),
    *LADDER[5:],
)

#: Largest sides of a cascaded array of 1 to 3 dimensions that are chosen.
CASCADED_LIMITS = (128, 32, 16)

#: Least share of the bytes that a cascaded array takes until its side reaches the second number.
CASCADED_SHARE, CASCADED_SIDE = 0.05, 12


def choose(
    height: int,
    width: int,
    channels: int,
    nbytes: float,
    skip: int | None = None,
    fine: tuple[FineArray, ...] | None = None,
    cascaded: int | None = None,
    smooth: bool = False,
) -> TextureBudget:
    """Return our arrays for a texture of ``channels`` stored channels and at most ``nbytes`` bytes.

    The structure is that of :data:`LADDER` (:data:`SMOOTH_LADDER` for a ``smooth`` texture) with the most bytes that
    fits, moved to coarser levels if none does; the cascaded array takes the rest. ``skip``, ``fine`` and ``cascaded``
    replace what is chosen. Pointers have three coordinates, fewer where the smallest arrays of three do not fit. If
    nothing fits, the result is the smallest budget. Raises ``ValueError`` for fine arrays that do not go together.
    """
    for dims in (3, 2, 1):
        too_large = []
        for group in _structures(height, width, dims, skip, fine, SMOOTH_LADDER if smooth else LADDER):
            sizes = [_sized(nbytes, height, width, channels, *where, dims, cascaded) for where in group]
            fitting = [size for size in sizes if size.nbytes <= nbytes]
            if fitting:
                return max(fitting, key=lambda size: size.nbytes - size.knots * size.cascaded**size.dims * channels)
            too_large += sizes
        if fine is not None and dims <= max(f.channels for f in fine):
            break
    return min(too_large, key=lambda size: size.nbytes)


#: Levels with pages, first level of the coarse array behind them, and least entries a page.
PAGES, PAGES_SKIP, FEWEST = (0, 2), 4, 3

#: Share of the bytes of the cascaded array behind pages, and its largest side.
PAGES_CASCADED, PAGES_SIDE = 0.06, 12


def paged(height: int, width: int, channels: int, nbytes: float, cascaded: int | None = None) -> TextureBudget | None:
    """Return arrays of pages for ``nbytes`` bytes; ``None`` if the texture or the bytes are too small or too large."""
    sizes = level_sizes(height, width)
    if len(sizes) <= PAGES_SKIP:
        return None
    dims, knots = min(3, max(2, channels)), PAGES_SKIP + 1
    side = int((PAGES_CASCADED * nbytes / (channels * knots)) ** (1 / dims) + 1e-9)
    side = cascaded or min(max(4, side), PAGES_SIDE)
    bits = 6 if channels > dims else 5
    size = TextureBudget(height, width, channels, (), PAGES_SKIP, dims, side, knots, 8, PAGES, 0, bits)
    size = replace(size, page_bytes=max(0, int(nbytes) - size.nbytes))
    fewest = FEWEST * sum(math.prod(page_counts(sizes[level])) for level in PAGES)
    return size if fewest <= size.page_entries <= most_entries(2) else None


def _structures(height: int, width: int, dims: int, skip: int | None, fine: tuple[FineArray, ...] | None, ladder):
    """Yield groups of (fine arrays, skip) to try: the ladder on the levels themselves, then on coarser ones."""
    last = len(level_sizes(height, width)) - 1
    if fine is not None:
        yield [(fine, skip)]
        return
    for shift in range(last):
        group = []
        for text, start in ladder:
            start = min(start + shift, last)
            arrays = [FineArray(f.level + shift, min(f.channels, dims), f.bits) for f in parse_structure(text)]
            if skip in (None, start):
                group.append((tuple(f for f in arrays if f.level < start), start))
        yield group
    yield [((), last if skip is None else skip)]


def _sized(nbytes, height, width, channels, fine, skip, dims, cascaded) -> TextureBudget:
    """Return the budget with the largest cascaded array that fits, at least :data:`CASCADED_SHARE` of the bytes."""

    def sized(side: int) -> TextureBudget:
        return TextureBudget(height, width, channels, fine, skip, dims, side, skip + 1)

    if cascaded is not None:
        return sized(cascaded)

    def side(rest: float) -> int:
        return int((max(rest, 0) / (channels * (skip + 1))) ** (1 / dims) + 1e-9)

    least = min(max(2 + (dims > 1), side(CASCADED_SHARE * nbytes)), CASCADED_SIDE)
    return sized(min(max(side(nbytes - sized(0).nbytes), least), CASCADED_LIMITS[dims - 1]))
