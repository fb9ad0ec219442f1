"""
Bytes and resolutions: how large the arrays of task 4 are for a wanted size.

The paper's are equation 2 of the supplement, ``bytes = 3 N_p0² + N_p1 + k N_c³ N_lod``, a table of ratios
``ρ = N_p0 / N_c`` and a linear search (:func:`paper_size`). Ours are all on the grids of levels of detail, so only
channels and bits of the fine arrays are to be chosen (:func:`choose`).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np

from ...maps.pyramid import level_sizes
from ...pages import SIDE_BITS, most_entries, page_counts

#: Best resolution ratio for compression ratios of textures at 4K (the supplement's table 4): RGB, and materials.
RATIOS = {3: 80, 6: 64, 12: 64, 24: 48}
MATERIAL_RATIOS = {3: 128, 6: 96, 12: 96, 24: 72}

#: Entries of the cascaded array along the footprint for the side of a texture in texels, from which on it holds.
LODS = {1024: 8, 2048: 12}

#: Sides that the paper's search finds are multiples of these (the supplement's section 1.3).
PRIMARY_STEP, CASCADED_STEP = 8, 4

#: How far the bytes may be from what was asked for before somebody is told.
TOLERANCE = 0.05


def paper_bytes(primary: int, lods: int, cascaded: int, channels: int) -> int:
    """
    Equation 2: bytes of a primary of ``primary = N_p0²`` entries, ``N_p1 = 4 N_lod`` of the footprint's, and a cascaded
    array of ``N_lod × N_c³`` entries of ``channels``.
    """
    return 3 * primary + 4 * lods + channels * cascaded**3 * lods


def lods_of(height: int, width: int) -> int:
    """``N_lod`` of a texture: :data:`LODS`, for smaller ones at most as many as they have doublings (at least 2)."""
    side = max(height, width)
    found = [n for base, n in LODS.items() if side >= base]
    return found[-1] if found else min(8, max(2, round(math.log2(side)) if side > 1 else 2))


def ratio(compression: float, channels: int) -> float:
    """
    Default of ``ρ``: :data:`RATIOS` for up to three channels, else :data:`MATERIAL_RATIOS`, interpolated linearly in
    ``log2(compression)`` and constant outside of 3 … 24. (The supplement gives them for 4K only.)
    """
    table = RATIOS if channels <= 3 else MATERIAL_RATIOS
    return float(np.interp(math.log2(compression), np.log2(list(table)), list(table.values())))


@dataclass(frozen=True)
class PaperBudget:
    """Resolutions of the paper's arrays: ``rows`` × ``columns`` of primary 0, and the sides of the cascaded array."""

    rows: int
    columns: int
    lods: int
    cascaded: int
    channels: int

    @property
    def nbytes(self) -> int:
        return paper_bytes(self.rows * self.columns, self.lods, self.cascaded, self.channels)


def paper_size(nbytes: float, source_bytes: int, channels: int, height: int, width: int) -> PaperBudget:
    """
    The paper's linear search: of all sides ``N_c`` = 4, 8, … the one whose bytes are nearest to what is wanted, as a
    ratio to ``source_bytes``, with ``N_p0 = ρ N_c`` in multiples of 8 and no larger than the image. If that is more
    than 5% off, ``N_c`` is kept, unless its array alone is more than half, and primary 0 becomes what fits.
    """
    lods, wanted = lods_of(height, width), source_bytes / nbytes
    rho = ratio(max(wanted, 1e-6), channels)
    best, distance, cascaded = None, math.inf, 0
    while True:
        cascaded += CASCADED_STEP
        side = PRIMARY_STEP * max(1, round(rho * cascaded / PRIMARY_STEP))
        size = PaperBudget(*_spread(side**2, height, width), lods, cascaded, channels)
        if abs(source_bytes / size.nbytes - wanted) < distance:
            best, distance = size, abs(source_bytes / size.nbytes - wanted)
        if size.nbytes >= nbytes:  # more only lead away
            break
    if abs(best.nbytes / nbytes - 1) <= TOLERANCE:
        return best
    cascaded = best.cascaded
    while cascaded > CASCADED_STEP and channels * cascaded**3 * lods > nbytes / 2:
        cascaded -= CASCADED_STEP
    entries = (nbytes - paper_bytes(0, lods, cascaded, channels)) / 3
    return PaperBudget(*_spread(max(1, entries), height, width), lods, cascaded, channels)


def _spread(entries: float, height: int, width: int) -> tuple[int, int]:
    """Rows and columns of at most so many entries in the proportions of an image, no larger than it."""
    short, long = sorted((height, width))
    one = min(max(1, int(math.sqrt(entries * short / long) + 1e-9)), short)
    other = min(max(1, int(entries / one + 1e-9)), long)
    other = min(other, one) if short == long else other
    return (one, other) if height <= width else (other, one)


# -- ours -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FineArray:
    """A fine array: the ``level`` whose grid it is on, and how many ``channels`` of how many ``bits``."""

    level: int
    channels: int
    bits: int

    def __post_init__(self):
        if self.level < 0 or not 1 <= self.channels <= 4 or not 1 <= self.bits <= 8:
            raise ValueError(f"found {self}, allowed are levels from 0 on, 1 to 4 channels and 1 to 8 bits")


@dataclass(frozen=True)
class TextureBudget:
    """
    Resolutions of our arrays: the ``fine`` ones, the finest first; the level ``skip`` from which on all levels have
    pointers of their own, with ``dims`` coordinates of ``bits``; and the side of the ``cascaded`` array, of
    ``channels`` and with ``knots`` entries along the level of detail (1: none). With ``pages``, the levels that have
    arrays of pages, these share ``page_bytes``.
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
            raise ValueError(f"fine arrays on the levels {levels} do not lie below level {self.skip}, one each")
        if not 0 <= self.skip < len(level_sizes(self.height, self.width)):
            raise ValueError(
                f"skip: found {self.skip}, the texture has {len(level_sizes(self.height, self.width))} levels"
            )
        if any(f.channels > self.dims for f in self.fine):
            raise ValueError(f"fine arrays have at most as many channels as pointers have coordinates, {self.dims}")

    @property
    def base(self) -> bool:
        """Does the coarsest fine array hold pointers? It does if it has all coordinates, in bits enough."""
        return bool(self.fine) and self.fine[-1].channels == self.dims and self.fine[-1].bits >= BASE_BITS

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays, each a whole number of them."""
        sizes = level_sizes(self.height, self.width)
        fine = sum(math.ceil(math.prod(sizes[f.level]) * f.channels * f.bits / 8) for f in self.fine)
        coarse = math.ceil(sum(map(math.prod, sizes[self.skip :])) * self.dims * self.bits / 8)
        return fine + coarse + self.knots * self.cascaded**self.dims * self.channels + self.page_bytes

    @property
    def page_entries(self) -> int:
        """Entries that the pages have room for, beside their indices."""
        sizes = level_sizes(self.height, self.width)
        index = sum(math.ceil(2 * SIDE_BITS[1] * math.prod(page_counts(sizes[level])) / 8) for level in self.pages)
        return int((self.page_bytes - index) * 8 / (self.page_bits * self.dims))


def parse_structure(text: str) -> tuple[FineArray, ...]:
    """
    Fine arrays from ``LEVEL:CHANNELS:BITS`` of each, separated by commas, such as ``0:1:2,1:2:4``. Raises
    ``ValueError``.
    """
    if not re.fullmatch(r"\d+:\d+:\d+(,\d+:\d+:\d+)*", text, re.ASCII):
        raise ValueError(f'{text!r} is no structure, expected LEVEL:CHANNELS:BITS,… such as "0:1:2,1:2:4", or "auto"')
    fine = tuple(FineArray(*map(int, part.split(":"))) for part in text.split(","))
    if [f.level for f in fine] != sorted({f.level for f in fine}):
        raise ValueError(f"{text!r}: levels have to grow, one array each")
    return fine


#: Bits from which on the coarsest fine array holds pointers, if it has all their coordinates.
BASE_BITS = 5

#: Structures for more and more bytes: the fine arrays and the level that all have pointers of their own from. Found by
#: trainings: from one to the next level a quarter of the entries has room for four times the bits, and a channel or two
#: are enough for the finest.
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

#: The same for smooth textures, whose finest level is not worth an array of its own before bytes are plenty.
SMOOTH_LADDER: tuple[tuple[str, int], ...] = (
    ("1:2:4,2:3:6", 3),
    ("1:3:4,2:3:6", 3),
    ("1:3:6,2:3:6", 3),
    ("1:3:8,2:3:8", 3),
    *LADDER[5:],
)

#: Largest sides of a cascaded array of 1 to 4 dimensions that are chosen.
CASCADED_LIMITS = (128, 32, 16, 8)

#: A cascaded array takes at least this share of the bytes, unless its side is this already.
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
    """
    Our size for a texture of so many stored channels and so many bytes, some of it given unless ``None``: the structure
    of :data:`LADDER` (for a ``smooth`` texture of :data:`SMOOTH_LADDER`) with the most bytes that fit, on coarser
    levels if none does; what is left goes to the cascaded array. Pointers have three coordinates, and fewer where even
    the smallest arrays of three are too large.
    """
    for dims in (3, 2, 1):
        found = []
        for group in _structures(height, width, dims, skip, fine, SMOOTH_LADDER if smooth else LADDER):
            sizes = [_sized(nbytes, height, width, channels, *where, dims, cascaded) for where in group]
            fitting = [size for size in sizes if size.nbytes <= nbytes]
            if fitting:
                return max(fitting, key=lambda size: _without(size, channels))
            found += sizes
        if fine is not None and dims <= max(f.channels for f in fine):
            break
    return min(found, key=lambda size: size.nbytes)


#: Levels that have pages, the level from which on all have pointers of their own, and entries for each page that there
#: have to be.
PAGES, PAGES_SKIP, FEWEST = (0, 2), 4, 3

#: Share of the bytes of a cascaded array behind pages, and its largest side.
PAGES_CASCADED, PAGES_SIDE = 0.06, 12


def paged(height: int, width: int, channels: int, nbytes: float, cascaded: int | None = None) -> TextureBudget | None:
    """
    A size whose fine arrays consist of pages, for so many bytes; ``None`` if the texture is too small, or the bytes are
    too few or too many for that.
    """
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
    """
    What is tried, the first choice first: groups of structures, each the fine arrays and the level from which on the
    others are. The ladder on the levels themselves, then on coarser ones.
    """
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


def _without(size: TextureBudget, channels: int) -> int:
    """Bytes of all but the cascaded array."""
    return size.nbytes - channels * size.knots * size.cascaded**size.dims


def _sized(nbytes, height, width, channels, fine, skip, dims, cascaded) -> TextureBudget:
    """With the largest cascaded array that is left room for, and no small one, unless its side is given."""

    def sized(side: int) -> TextureBudget:
        return TextureBudget(height, width, channels, fine, skip, dims, side, skip + 1)

    if cascaded is not None:
        return sized(cascaded)

    def side(rest: float) -> int:
        return int((max(rest, 0) / (channels * (skip + 1))) ** (1 / dims) + 1e-9)

    least = min(max(2 + (dims > 1), side(CASCADED_SHARE * nbytes)), CASCADED_SIDE)
    return sized(min(max(side(nbytes - sized(0).nbytes), least), CASCADED_LIMITS[dims - 1]))
