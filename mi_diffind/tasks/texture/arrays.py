"""Arrays of textures: resolutions for a number of bytes, and the initial entries.

- **The paper's** arrays follow equation 2 of the supplement, ``bytes = 3 N_p0² + N_p1 + k N_c³ N_lod``, a table of
  ratios ``ρ = N_p0 / N_c`` and a search (:func:`paper_size`). They start from ramps and a constant for each role of a
  map.
- **Ours** lie on the grids of levels of detail, so only the channels and bits of the fine arrays are chosen
  (:func:`choose`), or arrays of pages (:func:`paged`). They start from the principal components of the texture's
  levels, so at step 0 they are smaller pictures of fewer channels.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np

from ...arrays.budget import Budget, array_bytes
from ...arrays.indirection import DifferentiableArray
from ...arrays.pages import (
    SIDE_BITS,
    PagedArray,
    most_entries,
    page_counts,
    page_entries,
    page_positions,
    page_shift,
    shared_page_sizes,
)
from ...maps.layout import (
    MARGIN,
    Layout,
    channel_covariance,
    component_range,
    eigenvectors,
    linear_in_pointer,
    neighbour_covariance,
)
from ...maps.pyramid import level_sizes, taps
from . import FineArray, parse_structure
from .compressed import FineLayer, LayeredNet, LayeredStructure, PaperNet, PaperStructure

#: Best resolution ratio for compression ratios of RGB textures at 4K (the supplement's table 4).
RATIOS = {3: 80, 6: 64, 12: 64, 24: 48}

#: Best resolution ratio for compression ratios of materials at 4K (the supplement's table 4).
MATERIAL_RATIOS = {3: 128, 6: 96, 12: 96, 24: 72}

#: Entries of the cascaded array along the footprint, by the smallest side of a texture in texels.
LODS = {1024: 8, 2048: 12}

#: Sides of a primary in the paper's search are multiples of this number (supplement 1.3).
PRIMARY_STEP = 8

#: Sides of a cascaded array in the paper's search are multiples of this number.
CASCADED_STEP = 4

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

#: Structures of constant textures, whose arrays are to be optimised: fine arrays hold all coordinates of a pointer.
BLANK_LADDER: tuple[tuple[str, int], ...] = (
    ("0:1:6,1:3:8", 2),
    ("0:3:5", 1),
    ("0:3:6", 1),
    ("0:3:7", 1),
    ("0:3:8", 1),
)

#: Least smoothness of a smooth and of a constant texture, in dB (:func:`~mi_diffind.maps.layout.smoothness`).
SMOOTH_DB = 30.0
BLANK_DB = 119.0

#: Largest sides of a cascaded array of 1 to 3 dimensions that are chosen.
CASCADED_LIMITS = (128, 32, 16)

#: Least share of the bytes that a cascaded array takes, until its side reaches :data:`CASCADED_SIDE`.
CASCADED_SHARE = 0.05
CASCADED_SIDE = 12

#: Largest difference between a side of a cascaded array and that of the cube of as many entries.
SIDES_APART = 3

#: Levels with pages, and the first level of the coarse array behind them.
PAGES = (0, 2)
PAGES_SKIP = 4

#: Least mean number of entries a page.
FEWEST_ENTRIES = 3

#: Share of the bytes of the cascaded array behind pages, and its largest side.
PAGES_CASCADED = 0.06
PAGES_SIDE = 12

#: Share of the differences between two levels that lies within the range of an entry, by its bits.
WITHIN = {1: 0.7, 2: 0.97, 3: 0.99, 4: 0.998, 5: 0.998, 6: 0.998, 7: 0.998, 8: 0.998}

#: Least range of a difference, so that a flat component can still be trained, and range if all components are flat.
SMALLEST = 0.02
BLANK_RANGE = 1.0

#: Variance of all channels together below which a texture is constant.
FLAT = 1e-10


# ---------------------- The paper's resolutions ----------------------


def lod_count(height: int, width: int) -> int:
    """Return ``N_lod`` of a texture: :data:`LODS`; below 1024 texels ``log2`` of the side, within 2 … 8."""
    side = max(height, width)
    if side < min(LODS):
        return min(8, max(2, round(math.log2(side))))
    return next(n for base, n in reversed(LODS.items()) if side >= base)


def resolution_ratio(compression: float, channels: int) -> float:
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
        """Bytes of all arrays (equation 2): N_p0² is ``rows · columns``, N_p1 is ``4 · lods``."""
        return 3 * self.rows * self.columns + 4 * self.lods + self.channels * self.cascaded**3 * self.lods


def paper_size(
    nbytes: float, source_bytes: int, channels: int, height: int, width: int, rho: float | None = None
) -> PaperBudget:
    """Return the result of the paper's search over the sides ``N_c`` of the array (:meth:`.Budget.paper_side`).

    ``N_p0 = ρ N_c`` in multiples of 8 and no larger than the image; ``rho`` is by default :func:`resolution_ratio`. If
    the best is more than 5% off, primary 0 is resized to fit beside the cascaded array.
    """
    lods, budget = lod_count(height, width), Budget(nbytes)
    rho = rho or resolution_ratio(max(source_bytes / nbytes, 1e-6), channels)

    def sized(cascaded: int) -> PaperBudget:
        side = PRIMARY_STEP * max(1, round(rho * cascaded / PRIMARY_STEP))
        return PaperBudget(*_spread(side**2, height, width), lods, cascaded, channels)

    side, met = budget.paper_side(sized, channels * lods, 3, source_bytes, CASCADED_STEP)
    if met:
        return sized(side)
    entries = (nbytes - PaperBudget(0, 0, lods, side, channels).nbytes) / 3
    return PaperBudget(*_spread(max(1, entries), height, width), lods, side, channels)


def _spread(entries: float, height: int, width: int) -> tuple[int, int]:
    """Return rows and columns of at most ``entries`` entries, in the proportions of an image and within it."""
    short, long = sorted((height, width))
    one = min(max(1, int(math.sqrt(entries * short / long) + 1e-9)), short)
    other = min(max(1, int(entries / one + 1e-9)), long)
    other = min(other, one) if short == long else other
    return (one, other) if height <= width else (other, one)


# ---------------------- Our resolutions ----------------------


@dataclass(frozen=True)
class TextureBudget:
    """Resolutions of our arrays.

    - ``fine``: the fine arrays, the finest first.
    - ``skip``: first level of detail of the coarse array, whose pointers have ``dims`` coordinates of ``bits`` bits.
    - ``cascaded``: sides of the cascaded array along the coordinates, or one number for all; it has ``channels``
      channels and ``knots`` entries along the level of detail (1: no such axis).
    - ``pages``: levels with arrays of pages, which share ``page_bytes``, entries of ``page_bits`` bits.
    """

    height: int
    width: int
    channels: int
    fine: tuple[FineArray, ...]
    skip: int
    dims: int
    cascaded: int | tuple[int, ...]
    knots: int = 1
    bits: int = 8
    pages: tuple[int, ...] = ()
    page_bytes: int = 0
    page_bits: int = 5

    def __post_init__(self):
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
        coarse = (sum(map(math.prod, sizes[self.skip :])), self.dims)
        return self.page_bytes + array_bytes([
            *(((*sizes[f.level], f.channels), f.bits) for f in self.fine), (coarse, self.bits), (self._cascaded, 8),
        ])  # fmt: skip

    @property
    def sides(self) -> tuple[int, ...]:
        """Sides of the cascaded array, one for each coordinate of a pointer."""
        return self.cascaded if isinstance(self.cascaded, tuple) else (self.cascaded,) * self.dims

    @property
    def _cascaded(self) -> tuple[int, ...]:
        return (self.knots, *self.sides, self.channels)

    @property
    def page_entries(self) -> int:
        """Entries of all pages together, which share ``page_bytes`` with their indices."""
        sizes = level_sizes(self.height, self.width)
        index = array_bytes([((2, *page_counts(sizes[level])), SIDE_BITS[1]) for level in self.pages])
        return int((self.page_bytes - index) * 8 / (self.page_bits * self.dims))


def ladder(smoothness_db: float) -> tuple[tuple[str, int], ...]:
    """Return the structures to choose from for a texture of a smoothness (:func:`.layout.smoothness`)."""
    return BLANK_LADDER if smoothness_db >= BLANK_DB else SMOOTH_LADDER if smoothness_db >= SMOOTH_DB else LADDER


def choose(
    height: int,
    width: int,
    channels: int,
    nbytes: float,
    skip: int | None = None,
    fine: tuple[FineArray, ...] | None = None,
    cascaded: int | None = None,
    ladder: tuple[tuple[str, int], ...] = LADDER,
) -> TextureBudget:
    """Return our arrays for a texture of ``channels`` stored channels and at most ``nbytes`` bytes.

    The structure is that of a :func:`ladder` with the most bytes that fits, moved to coarser levels if none does; the
    cascaded array takes the rest. Bytes beyond its largest sides become bits of the fine arrays. ``skip``, ``fine`` and
    ``cascaded`` replace what is chosen. Pointers have three coordinates, fewer where the smallest arrays of three do
    not fit. If nothing fits, the result is the smallest budget. Raises ``ValueError`` for fine arrays that do not go
    together.
    """
    for dims in (3, 2, 1):
        too_large = []
        for group in [[(fine, skip)]] if fine is not None else _structures(height, width, dims, skip, ladder):
            sizes = [_sized(nbytes, height, width, channels, *where, dims, cascaded) for where in group]
            fitting = [size for size in sizes if size.nbytes <= nbytes]
            if fitting:
                size = max(fitting, key=lambda size: size.nbytes - math.prod(size._cascaded))
                size = size if fine is not None else _with_bits(size, nbytes)
                return size if cascaded is not None else _with_sides(size, nbytes)
            too_large += sizes
        if fine is not None and dims <= max(f.channels for f in fine):
            break
    return min(too_large, key=lambda size: size.nbytes)


def _structures(height: int, width: int, dims: int, skip: int | None, ladder) -> Iterator[list]:
    """Yield groups of (fine arrays, skip) to try: the ladder on the levels themselves, then on coarser ones."""
    last = len(level_sizes(height, width)) - 1
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


def _with_bits(size: TextureBudget, nbytes: float) -> TextureBudget:
    """Return the budget with more bits in its fine arrays as far as these fit, the finest first."""
    for i, array in enumerate(size.fine):
        for bits in range(array.bits + 1, 9):
            richer = replace(size, fine=(*size.fine[:i], array._replace(bits=bits), *size.fine[i + 1 :]))
            if richer.nbytes <= nbytes and richer.base == size.base:
                size = richer
    return size


def _with_sides(size: TextureBudget, nbytes: float) -> TextureBudget:
    """Return the budget whose cascaded array has the most entries that fit.

    Sides differ by a few, the first are longer. None is much longer than three times :data:`CASCADED_LIMITS`.
    """
    rest = (nbytes - replace(size, cascaded=0).nbytes) / (size.knots * size.channels)
    side = min(int(rest ** (1 / size.dims) + 1e-9), 3 * CASCADED_LIMITS[size.dims - 1])
    nearby = range(max(2, side - SIDES_APART), side + SIDES_APART + 1)
    fitting = [s for s in combinations_with_replacement(reversed(nearby), size.dims) if math.prod(s) <= rest]
    return replace(size, cascaded=max(fitting, key=lambda s: (math.prod(s), s[-1]))) if fitting else size


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
    fewest = FEWEST_ENTRIES * sum(math.prod(page_counts(sizes[level])) for level in PAGES)
    return size if fewest <= size.page_entries <= most_entries(2) else None


# ---------------------- Initial arrays ----------------------


def from_ramps(layout: Layout, size: PaperBudget, border: tuple[str, str], levels: int) -> PaperNet:
    """Return the supplement's initial arrays, not allocated."""
    primary0 = DifferentiableArray((size.rows, size.columns), 3, "ramp", fold=True, border=border)
    primary1 = DifferentiableArray((4 * size.lods,), 1, "ramp", fold=True)
    shape = (size.lods, *[size.cascaded] * 3)
    cascaded = DifferentiableArray(shape, layout.stored, "constant", layout.initial, fold=True)
    return PaperNet(primary0, primary1, cascaded, PaperStructure(levels))


def enlarge(values: np.ndarray, rows: int, columns: int, border: Sequence[str]) -> np.ndarray:
    """Return a level, ``(height, width, k)``, read bilinearly at the texel centres of ``rows`` × ``columns``."""
    for axis, (n, along) in enumerate(zip((rows, columns), border, strict=True)):
        places = (np.arange(n) + 0.5) / n
        total = 0
        for index, weight in taps(places, values.shape[axis], along):
            shape = [-1 if a == axis else 1 for a in range(3)]
            total = total + np.take(values, index, axis) * weight.reshape(shape)
        values = total
    return values.astype(np.float32)


def from_components(
    values: Sequence[np.ndarray], size: TextureBudget, border: tuple[str, str], weights: np.ndarray | None = None
) -> LayeredNet:
    """Return initial arrays from the levels ``values`` of a texture, each ``(height, width, k)`` in [0, 1].

    Each fine array holds the difference between the pointers of its level and the sum of the coarser arrays.
    ``weights``, ``(k,)``, are those of squared errors of channels: components are those of weighted channels.
    """
    factors = channel_scale(weights, values[0].shape[-1])
    values = [level * factors for level in values]
    k = values[0].shape[-1]
    mean = values[0].reshape(-1, k).mean(axis=0, dtype=np.float64)
    covariance = channel_covariance(values[0], mean)
    # A constant texture starts as a read at (u, v), which can be trained
    used = min(size.dims, k) if np.trace(covariance) > FLAT else 0
    directions = eigenvectors(covariance, used)
    if used:
        # Rotated within the same space so that the first axes have the most detail: fine arrays hold only these
        detail = directions @ neighbour_covariance(values[0]) @ directions.T
        directions = eigenvectors(detail, used) @ directions
    low, high = component_range((values[0].reshape(-1, k) - mean) @ directions.T)

    def pointer(level: np.ndarray) -> np.ndarray:
        unit = MARGIN + (1 - 2 * MARGIN) * (((level - mean) @ directions.T - low) / (high - low))
        # A texture has at most as many components as channels: further coordinates start as ramps along u or v
        u, v = np.meshgrid(*((np.arange(n) + 0.5) / n for n in level.shape[1::-1]))
        further = [(u, v)[i % 2][..., None] for i in range(size.dims - used)]
        return np.concatenate([np.clip(unit, 0, 1).astype(np.float32), *further], axis=-1, dtype=np.float64)

    pointers = [pointer(level) for level in values]
    reached, level = pointers[size.skip], size.skip
    layers, fine = _pages(pointers, high - low, size, border)
    for i in reversed(range(len(size.fine))):
        spec = size.fine[i]
        rows, columns = values[spec.level].shape[:2]
        while level > spec.level:
            level -= 1
            reached = enlarge(reached, *values[level].shape[:2], border)
        until = (size.fine[i + 1].level if i + 1 < len(size.fine) else size.skip) - 1
        if size.base and i + 1 == len(size.fine):
            reached = np.clip(pointers[level], 1e-3, 1 - 1e-3)
            layers.insert(0, FineLayer(level, until, spec.bits, (1.0,) * spec.channels))
            fine.insert(0, DifferentiableArray((rows, columns), size.dims, reached, fold=True, border=border))
            continue
        rest = (pointers[level] - reached)[..., : spec.channels]
        within = np.quantile(np.abs(rest).reshape(-1, spec.channels), WITHIN[spec.bits], axis=0)
        scale = np.maximum(2 * within, SMALLEST if used else BLANK_RANGE)
        layer = FineLayer(level, until, spec.bits, tuple(float(f"{s:.6g}") for s in scale))
        entries = np.clip(rest / np.array(layer.scale) + layer.zero, 0, 1).astype(np.float32)
        layers.insert(0, layer)
        fine.insert(0, DifferentiableArray((rows, columns), spec.channels, entries, fold=True, border=border))
        reached = reached.copy()
        reached[..., : spec.channels] += ((entries - layer.zero) * layer.scale).astype(np.float32)
    coarse = np.concatenate([p.reshape(-1, size.dims) for p in pointers[size.skip :]])
    coarse = DifferentiableArray((len(coarse),), size.dims, np.clip(coarse, 1e-3, 1 - 1e-3), fold=True)
    shape = (size.knots,) * (size.knots > 1) + size.sides
    back = linear_in_pointer(mean, directions, low, high, size.sides[:used], range(used))
    back = np.clip(back / factors, 1e-3, 1 - 1e-3).astype(np.float32)
    back = back.reshape(*back.shape[:-1], *[1] * (size.dims - used), k)
    cascaded = np.broadcast_to(back, (*shape, size.channels)).astype(np.float32)
    cascaded = DifferentiableArray(shape, size.channels, cascaded, fold=True)
    structure = LayeredStructure(size.height, size.width, tuple(layers), size.skip, size.bits, size.base)
    return LayeredNet(fine, coarse, cascaded, structure, border)


def channel_scale(weights: np.ndarray | None, channels: int) -> np.ndarray:
    """Return the square roots of weights over the largest, ``(channels,)``; 1 without weights."""
    if weights is None:
        return np.ones(channels, np.float32)
    return np.sqrt(np.asarray(weights) / np.max(weights)).astype(np.float32)


def _pages(pointers: list, ranges: np.ndarray, size: TextureBudget, border) -> tuple[list, list]:
    """Return the layers of pages and their arrays; ``ranges`` are those of the components."""
    if not size.pages:
        return [], []
    used = len(ranges)
    weighted = [(pointers[level][..., :used] * ranges).astype(np.float32) for level in size.pages]
    layers, fine = [], []
    ends = [*size.pages[1:], size.skip]
    sides = shared_page_sizes(weighted, border, size.page_entries)
    for level, end, sizes in zip(size.pages, ends, sides, strict=True):
        values = pointers[level]
        shift = page_shift(values.shape[:2])
        entries = np.clip(page_entries(values[..., :used].astype(np.float32), border, sizes), 0, 1)
        further = page_positions(sizes, shift)[:, [j % 2 for j in range(size.dims - used)]]
        entries = np.concatenate([entries, further], axis=-1).astype(np.float32)
        layers.append(FineLayer(level, end - 1, size.page_bits, (1.0,) * size.dims, True))
        fine.append(PagedArray(sizes, size.dims, entries, shift, fold=True, border=border))
    return layers, fine
