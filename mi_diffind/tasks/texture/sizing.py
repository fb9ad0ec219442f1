"""
Bytes and resolutions: how large the arrays of task 4 are for a wanted size.

The paper's are equation 2 of the supplement, ``bytes = 3 N_p0² + N_p1 + k N_c³ N_lod``, a table of ratios
``ρ = N_p0 / N_c`` and a linear search (:func:`paper_size`). Ours are all on the grids of levels of detail, so only
channels and bits of the fine arrays are to be chosen; :func:`choose` tries all of them on a model of the error.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...maps import components
from ...maps.compressed import taps
from ...maps.pyramid import level_sizes

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
class PaperSize:
    """Resolutions of the paper's arrays: ``rows`` × ``columns`` of primary 0, and the sides of the cascaded array."""

    rows: int
    columns: int
    lods: int
    cascaded: int
    channels: int

    @property
    def nbytes(self) -> int:
        return paper_bytes(self.rows * self.columns, self.lods, self.cascaded, self.channels)


def paper_size(nbytes: float, source_bytes: int, channels: int, height: int, width: int) -> PaperSize:
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
        size = PaperSize(*_spread(side**2, height, width), lods, cascaded, channels)
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
    return PaperSize(*_spread(max(1, entries), height, width), lods, cascaded, channels)


def _spread(entries: float, height: int, width: int) -> tuple[int, int]:
    """Rows and columns of at most so many entries in the proportions of an image, no larger than it."""
    short, long = sorted((height, width))
    one = min(max(1, int(math.sqrt(entries * short / long) + 1e-9)), short)
    other = min(max(1, int(entries / one + 1e-9)), long)
    other = min(other, one) if short == long else other
    return (one, other) if height <= width else (other, one)


# -- ours -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fine:
    """A fine array: the ``level`` whose grid it is on, and how many ``channels`` of how many ``bits``."""

    level: int
    channels: int
    bits: int

    def __post_init__(self):
        if self.level < 0 or not 1 <= self.channels <= 4 or not 1 <= self.bits <= 8:
            raise ValueError(f"found {self}, allowed are levels from 0 on, 1 to 4 channels and 1 to 8 bits")


@dataclass(frozen=True)
class Size:
    """
    Resolutions of our arrays: the ``fine`` ones, the finest first; the level ``skip`` from which on all levels have
    pointers of their own, with ``dims`` coordinates of ``bits``; and the side of the ``cascaded`` array, of
    ``channels`` and with ``knots`` entries along the level of detail (1: none).
    """

    height: int
    width: int
    channels: int
    fine: tuple[Fine, ...]
    skip: int
    dims: int
    cascaded: int
    knots: int = 1
    bits: int = 8

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
    def nbytes(self) -> int:
        """Bytes of all arrays, each a whole number of them."""
        sizes = level_sizes(self.height, self.width)
        fine = sum(math.ceil(math.prod(sizes[f.level]) * f.channels * f.bits / 8) for f in self.fine)
        coarse = math.ceil(sum(map(math.prod, sizes[self.skip :])) * self.dims * self.bits / 8)
        return fine + coarse + self.knots * self.cascaded**self.dims * self.channels


def parse_structure(text: str) -> tuple[Fine, ...]:
    """
    Fine arrays from ``LEVEL:CHANNELS:BITS`` of each, separated by commas, such as ``0:1:2,1:2:4``. Raises
    ``ValueError``.
    """
    if not re.fullmatch(r"\d+:\d+:\d+(,\d+:\d+:\d+)*", text, re.ASCII):
        raise ValueError(f'{text!r} is no structure, expected LEVEL:CHANNELS:BITS,… such as "0:1:2,1:2:4", or "auto"')
    fine = tuple(Fine(*map(int, part.split(":"))) for part in text.split(","))
    if [f.level for f in fine] != sorted({f.level for f in fine}):
        raise ValueError(f"{text!r}: levels have to grow, one array each")
    return fine


#: What is left of the variance of a channel's differences between levels after so many bits for it, trained: 0 to 8.
LEFT = (1, 0.5, 0.24, 0.1, 0.03, 0.009, 0.0025, 0.0007, 0.0002)

#: Largest sides of a cascaded array of 1 to 4 dimensions that are chosen.
CASCADED_LIMITS = (128, 32, 16, 8)

#: A cascaded array takes at least this share of the bytes, unless its side is this already.
CASCADED_SHARE, CASCADED_SIDE = 0.07, 12

#: dB. As many coordinates, up to three, as leave no more than this of the error of a linear model.
DIMS_DB = 45.0


@dataclass(frozen=True)
class Components:
    """
    The principal components of a texture, as pointers of its texels: ``mean`` (``(k,)``) and ``directions`` (``(dims,
    k)``) of the channels, and ``low`` and ``high``, the range of each component, of which a little room at the ends of
    [0, 1] is left.
    """

    mean: np.ndarray
    directions: np.ndarray
    low: np.ndarray
    high: np.ndarray

    #: Room between the components' range and the ends of [0, 1], and the share of texels beyond it at either end.
    MARGIN, OUTSIDE = 0.02, 1e-3

    @staticmethod
    def of(values: np.ndarray, dims: int | None = None) -> Components:
        """Of level 0, ``(height, width, k)``; ``dims``: as many as are needed, unless given."""
        k = values.shape[-1]
        mean = values.reshape(-1, k).mean(axis=0, dtype=np.float64)
        covariance = components.covariance(values, mean)
        energies = np.linalg.eigvalsh(covariance)[::-1]
        if dims is None:
            left = [max(0.0, float(energies[d:].sum())) / k for d in range(1, 4)]
            dims = next((d for d, e in enumerate(left, 1) if e <= 10 ** (-DIMS_DB / 10)), 3)
        directions = components.strongest(covariance, min(dims, k))
        found = (values.reshape(-1, k) - mean) @ directions.T
        low, high = np.quantile(found, [Components.OUTSIDE, 1 - Components.OUTSIDE], axis=0)
        return Components(mean, directions, low, np.maximum(high, low + 1e-3))

    @property
    def dims(self) -> int:
        return len(self.directions)

    def pointers(self, values: np.ndarray) -> np.ndarray:
        """The pointers of texels, ``(height, width, dims)`` in [0, 1], float32."""
        found = ((values - self.mean) @ self.directions.T - self.low) / (self.high - self.low)
        return np.clip(self.MARGIN + (1 - 2 * self.MARGIN) * found, 0, 1).astype(np.float32)

    def back(self, side: int) -> np.ndarray:
        """The channels at the entries of a cascaded array, ``(side, …, k)``: the linear map back from pointers."""
        grid = (np.linspace(0, 1, side) - self.MARGIN) / (1 - 2 * self.MARGIN) if side > 1 else np.array([0.5])
        found = self.mean
        for d in range(self.dims):
            shape = [-1 if axis == d else 1 for axis in range(self.dims)] + [1]
            along = np.reshape(self.low[d] + grid * (self.high[d] - self.low[d]), shape)
            found = found + along * self.directions[d]
        return np.clip(found, 1e-3, 1 - 1e-3).astype(np.float32)


def enlarged(values: np.ndarray, rows: int, columns: int, border: Sequence[str]) -> np.ndarray:
    """A level, ``(height, width, k)``, read bilinearly at the texel centres of ``rows`` × ``columns``. float32."""
    for axis, (n, along) in enumerate(zip((rows, columns), border, strict=True)):
        places = (np.arange(n) + 0.5) / n
        total = 0
        for index, weight in taps(places, values.shape[axis], along):
            shape = [-1 if a == axis else 1 for a in range(3)]
            total = total + np.take(values, index, axis) * weight.reshape(shape)
        values = total
    return values.astype(np.float32)


def choose(
    values: Sequence[np.ndarray],
    nbytes: float,
    border: Sequence[str],
    skip: int | None = None,
    fine: tuple[Fine, ...] | None = None,
    cascaded: int | None = None,
) -> Size:
    """
    Our size for the levels ``values`` of a texture and so many bytes, some of it given unless ``None``.

    All combinations of up to three fine arrays are tried on a model: a component's error at a level is that of the
    level above it and the variance of what they differ by, of which :data:`LEFT` remains if it has bits; what counts
    is the sum over levels, each half as much as the finer one. What is left of the bytes goes to the cascaded array.
    """
    found = Components.of(values[0])
    height, width, channels = values[0].shape
    sizes = [level.shape[:2] for level in values]
    pointers = [(level - found.mean) @ found.directions.T for level in values]
    count = min(len(values) - 1, MAX_SKIP + MAX_FINE)
    variances = [
        ((pointers[i] - enlarged(pointers[i + 1], *sizes[i], border)) ** 2).mean(axis=(0, 1), dtype=np.float64)
        for i in range(count)
    ]
    best = None
    for where in range(count + 1) if skip is None else [skip]:
        levels = range(max(0, where - MAX_FINE), where)
        menu = [None, *((c, b) for c in range(1, found.dims + 1) for b in BITS)]
        area = [math.prod(sizes[i]) / 8 for i in levels]
        tried = itertools.product(*[menu] * len(levels)) if fine is None else [fine]
        for combination in tried:
            arrays = combination
            if fine is None:
                if sum(a * e[0] * e[1] for a, e in zip(area, combination, strict=True) if e) > nbytes:
                    continue
                arrays = tuple(Fine(i, *e) for i, e in zip(levels, combination, strict=True) if e)
            size = _sized(nbytes, height, width, channels, arrays, where, found.dims, cascaded)
            rank = (max(0, size.nbytes - nbytes), _error(variances, arrays, where, found.dims))
            if best is None or rank < best[0]:
                best = rank, size
    return best[1]


#: Fine arrays that are chosen, at most, and the coarsest level that may be the first to have pointers of its own.
MAX_FINE, MAX_SKIP = 3, 6

#: Bits that are chosen for them.
BITS = (1, 2, 3, 4, 5, 6, 8)


def _sized(nbytes, height, width, channels, fine, skip, dims, cascaded) -> Size:
    """With the largest cascaded array that is left room for, and no small one, unless its side is given."""

    def sized(side: int) -> Size:
        return Size(height, width, channels, fine, skip, dims, side, skip + 1)

    if cascaded is not None:
        return sized(cascaded)

    def side(rest: float) -> int:
        return int((max(rest, 0) / (channels * (skip + 1))) ** (1 / dims) + 1e-9)

    least = min(max(2, side(CASCADED_SHARE * nbytes)), CASCADED_SIDE)
    return sized(min(max(side(nbytes - sized(0).nbytes), least), CASCADED_LIMITS[dims - 1]))


def _error(variances: Sequence[np.ndarray], fine: Sequence[Fine], skip: int, dims: int) -> float:
    """The model of :func:`choose`."""
    by_level = {f.level: f for f in fine}
    error, total = np.full(dims, 1e-6), 0.0
    for level in reversed(range(skip)):
        error = error + variances[level]
        f = by_level.get(level)
        if f is not None:
            error = np.where(np.arange(dims) < f.channels, LEFT[f.bits] * error, error)
        total += float(error.sum()) * 0.5 ** (level + 1)
    return total
