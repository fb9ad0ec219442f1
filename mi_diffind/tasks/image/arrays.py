"""Arrays of images: a primary array of 1 to 4 channels, read at (v, u), that points into a cascaded one.

- **Resolutions** for a number of bytes (the paper's supplement, section 1.3). Equation 1, ``bytes = 4 N_p² + k N_c⁴``,
  is for square images and bytes. Here the primary has ``rows × columns`` entries in the proportions of the image, of
  ``dims`` channels of ``bits`` bits, and the cascaded array ``N_c^dims`` entries of a byte for each of ``k`` channels.
- **Initial arrays.** The supplement's primary is the uv ramp, repeated for each further channel, and its cascaded array
  is constant for each role of a map. Ours holds the image's principal components, scaled down; the cascaded array is
  the linear map back to channels. At step 0 this is a smaller picture of fewer channels.
- **Files**: :func:`to_table`, :func:`load`, and the model of a file.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ...arrays.budget import Budget, array_bytes
from ...arrays.indirection import DifferentiableArray, Indirection, ramp
from ...arrays.pages import PagedArray, page_counts, page_entries, page_positions, page_shift, page_sizes
from ...arrays.tables import PAGES, Table, load_table, to_stored_arrays
from ...core.compat import backend_module
from ...maps.layout import (
    MARGIN,
    Layout,
    channel_covariance,
    component_range,
    downscale,
    eigenvectors,
    linear_in_pointer,
    neighbour_covariance,
)
from ...maps.model import MapsModel, allocate_maps, check_arrays, read_layout
from ...maps.pyramid import CompressedMaps
from . import CoarsePrimary

#: Best resolution ratio for compression ratios of RGB textures at 4K (the supplement's table 2).
RATIOS = {3: 128, 6: 128, 12: 80, 24: 72}

#: Resolution ratio that is safe at 12x, for the side of the image in texels (the supplement's section 1.3).
SAFE_RATIOS = {1024: 64, 2048: 64, 4096: 96}

#: Largest side of a cascaded array of 1 to 4 dimensions that is chosen by default.
CASCADED_LIMITS = (256, 64, 32, 16)

#: Useful range of the resolution ratio (the supplement's section 1.3).
RATIO_RANGE = (40, 128)

#: Sides of a primary in the paper's search are multiples of this number.
PRIMARY_STEP = 8

#: Sides of a cascaded array are multiples of this number.
CASCADED_STEP = 4

#: Names of the primary arrays: the second, of lower resolution, is optional. The first may consist of pages.
PRIMARIES = ("primary", "coarse")
PRIMARY_PAGES = PRIMARIES[0] + PAGES


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

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays, primaries without gaps between entries."""
        primaries = [((rows, columns, dims), bits) for rows, columns, dims, bits in self.primaries]
        return array_bytes([((self.cascaded,) * self.dims + (self.channels,), 8), *primaries])

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
    """Return the result of the paper's search over the sides of the cascaded array (:meth:`.Budget.paper_side`).

    ``N_p = ratio · N_c`` in multiples of 8, by default of :func:`resolution_ratio`. Equation 1 has squares only: for a
    non-square image the ``N_p²`` entries are spread in its proportions, in whole rows and columns. The primary is never
    larger than the image (square: than the largest multiple of 8 in it, if there is one).

    Sides in steps can miss ``compression`` by far (4K RGB at 12x becomes 13.4x at ρ = 80). Then the primary becomes the
    largest that fits beside the cascaded array (:func:`fit_bytes`): 1×1 for images so small that the smallest cascaded
    array (``N_c`` = 4) is too large.
    """
    ratio = ratio or resolution_ratio(compression, math.sqrt(height * width))
    largest = _spread(PRIMARY_STEP * max(height, width), height, width)

    def sized(cascaded: int) -> ImageBudget:
        side = PRIMARY_STEP * max(1, round(ratio * cascaded / PRIMARY_STEP))
        rows, columns = _spread(side, height, width)
        return ImageBudget(rows, columns, cascaded, channels, dims, bits, full=(rows, columns) == largest)

    budget = Budget(uncompressed_bytes / compression)
    side, met = budget.paper_side(sized, channels, dims, uncompressed_bytes, CASCADED_STEP)
    return sized(side) if met else fit_bytes(budget.nbytes, channels, height, width, side, dims, bits)


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
    least size is 1×1: only then can the bytes exceed ``budget``. Of two primaries, both sides are in proportion first,
    then the longer side alone is extended.
    """
    short, long = sorted((height, width))

    def sized(one: int, other: int) -> ImageBudget:
        rows, columns = (one, other) if height <= width else (other, one)
        return ImageBudget(rows, columns, cascaded, channels, dims, bits, (rows, columns) == (height, width), coarse)

    if coarse is not None:
        sizes, fitting = range(1, long + 1), Budget(budget)

        def proportional(n: int) -> ImageBudget:
            return sized(min(max(1, round(n * short / long)), short), n)

        best = proportional(fitting.largest(proportional, sizes, strict=False))
        if short < long:
            one = min(best.rows, best.columns)
            longer = [
                sized(one, fitting.largest(lambda n, one=one: sized(one, n), sizes, strict=False))
                for one in (one, one + 1)
                if one <= short
            ]
            best = max((size for size in longer if size.nbytes <= budget), key=lambda size: size.nbytes, default=best)
        return best
    entries = int((budget - channels * cascaded**dims) * 8) // (dims * bits)
    entries = min(max(entries, 1), height * width)
    if height == width:
        return sized(math.isqrt(entries), math.isqrt(entries))
    wanted = short * math.sqrt(entries / (height * width))
    margin = max(1.0, 0.02 * wanted)
    sides = range(max(1, math.ceil(wanted - margin)), min(short, math.floor(wanted + margin)) + 1)
    pairs = ((one, min(entries // one, long)) for one in sides if one <= entries)
    return sized(*max(pairs, key=lambda pair: (pair[0] * pair[1], -abs(pair[0] - wanted), pair)))


def _spread(side: int, height: int, width: int) -> tuple[int, int]:
    """Return rows and columns of about ``side²`` entries in the proportions of an image, and no larger than it."""
    if height == width:
        side = min(side, height // PRIMARY_STEP * PRIMARY_STEP or height)
        return side, side
    short, long = sorted((height, width))
    one = min(max(1, round(side * math.sqrt(short / long))), short)
    other = min(max(1, round(side**2 / one)), long)
    return (one, other) if height < width else (other, one)


def from_ramp(layout: Layout, size: ImageBudget, border: tuple[str, str]) -> Indirection:
    """Return the supplement's initial arrays, not allocated."""
    primaries = [
        DifferentiableArray((rows, columns), dims, "ramp", fold=True, border=border)
        for rows, columns, dims, _ in size.primaries
    ]
    cascaded = DifferentiableArray((size.cascaded,) * size.dims, layout.stored, "constant", layout.initial, fold=True)
    return join_primaries(primaries, cascaded)


def join_primaries(primaries: Sequence[DifferentiableArray], cascaded: DifferentiableArray) -> Indirection:
    """Return the indirection of primaries that are all read at (v, u)."""
    return Indirection(primaries, cascaded, [(0, 1)] * len(primaries))


def from_components(values: np.ndarray, size: ImageBudget, border: tuple[str, str], weights=1.0) -> Indirection:
    """Return initial arrays from the principal components of ``values``, ``(height, width, k)`` in [0, 1]; unallocated.

    ``weights``, a number for each channel, multiply differences: components and pages follow the heavier channels.

    Of two primaries, the first takes the components of the differences of neighbours, which need its resolution most;
    the second takes components of the rest. Channels beyond the image's ``k`` start as ramps along u or v.
    """
    k, values = values.shape[-1], values * np.asarray(weights, np.float32)
    mean = values.reshape(-1, k).mean(axis=0, dtype=np.float64)
    left, back = np.eye(k), mean  # projection onto remaining components; channels of the cascaded entries
    primaries, axis = [], 0
    for i, (rows, columns, dims, _) in enumerate(size.primaries):
        last = i + 1 == len(size.primaries)
        covariance = channel_covariance(values, mean) if last else neighbour_covariance(values)
        used = max(0, min(dims, k - axis))
        # The small multiple of ``left`` keeps flat directions apart from those of an earlier array
        directions = eigenvectors(left @ covariance @ left + 1e-9 * left, used)
        left = left - directions.T @ directions
        paged = size.paged and i == 0
        if paged:
            exact = ((values - mean) @ directions.T).astype(np.float32)
            sizes, shift = page_sizes(exact, border, page_budget(size, values.shape)), page_shift(values.shape[:2])
            projected = page_entries(exact, border, sizes)
        else:
            projected = (downscale(values, rows, columns, border) - mean) @ directions.T
        unit = np.zeros((*projected.shape[:-1], 0))
        if used:
            low, high = component_range(projected)
            unit = MARGIN + (1 - 2 * MARGIN) * np.clip((projected - low) / (high - low), 0, 1)
            sides = (size.cascaded,) * size.dims
            back = linear_in_pointer(back, directions, low, high, sides, range(axis, axis + used))
        if dims > used:
            further = range(dims - used)
            if paged:
                positions = page_positions(sizes, shift)[:, [j % 2 for j in further]]
            else:
                positions = ramp((rows, columns), len(further), border)
            unit = np.concatenate([unit, positions], axis=-1)
        unit = unit.astype(np.float32)
        if paged:
            primaries.append(PagedArray(sizes, dims, unit, shift, fold=True, border=border))
        else:
            primaries.append(DifferentiableArray((rows, columns), dims, unit, fold=True, border=border))
        axis += dims
    shape = (size.cascaded,) * size.dims
    back = np.clip(np.broadcast_to(back / weights, (*shape, k)), 1e-3, 1 - 1e-3)
    return join_primaries(primaries, DifferentiableArray(shape, k, back.astype(np.float32), fold=True))


def page_budget(size: ImageBudget, shape: Sequence[int]) -> float:
    """Return the entries of all pages of the first primary beside their index, for an image of ``shape``."""
    rows, columns, dims, bits = size.primaries[0]
    index = PagedArray(np.ones((*page_counts(shape[:2]), 2), int)).index_nbytes
    return rows * columns - 8 * index / (dims * bits)


class CompressedImage(CompressedMaps):
    """A compressed image or material.

    ``layout`` lists the maps, ``net`` maps (v, u) in [0, 1]² to the stored channels. ``net`` is ``None`` if all
    channels are constant.
    """

    def __init__(self, layout: Layout, net: Indirection | None):
        self.layout, self.net = layout, net
        self.types = None if net is None else backend_module(net.cascaded.data)
        self.border = ("clamp", "clamp") if net is None else net.primary[0].border

    @staticmethod
    def from_table(table: Table, dtype, storage: str = "") -> CompressedImage:
        """Return the image of a checked table, in a storage form (:func:`allocate`)."""
        return assemble(table, allocate(table, dtype, storage))

    def stored(self, u, v, active=True) -> list:
        """Return the stored channels at (u, v)."""
        return [] if self.net is None else self.net([v, u], active)


def allocate(table: Table, dtype, storage: str = "") -> dict[str, DifferentiableArray]:
    """Return the arrays of a checked table: :func:`~mi_diffind.maps.model.allocate_maps` of this task."""
    layout = Layout.from_json(table.settings["layout"])
    return allocate_maps(table, dtype, storage, lambda name: (layout.height, layout.width))


def assemble(table: Table, arrays: dict[str, DifferentiableArray]) -> CompressedImage:
    """Return the image of a checked table from its allocated arrays."""
    primaries = [arrays[name] for name in PRIMARIES if name in arrays]
    net = join_primaries(primaries, arrays["cascaded"]) if arrays else None
    return CompressedImage(Layout.from_json(table.settings["layout"]), net)


def to_table(image: CompressedImage, settings: dict) -> Table:
    """Return the table file of an image, with ``settings``."""
    stored = {}
    if image.net is not None:
        for name, array in (*zip(PRIMARIES, image.net.primary, strict=False), ("cascaded", image.net.cascaded)):
            stored |= to_stored_arrays(name, array)
    return Table("image", stored, settings={**settings, "layout": image.layout.to_json()})


def load(path: str | os.PathLike) -> Table:
    """Read and check a table file of this task. Raises :class:`.TableError`."""
    table = load_table(path, "image")
    layout, arrays = read_layout(table), table.arrays
    if not layout.stored:
        check_arrays(table, {}, {})
        return table
    pages = {"primary": (layout.height, layout.width)} if PRIMARY_PAGES in arrays else {}
    shapes = {name: (None,) * 3 for name in PRIMARIES if name == "primary" or name in arrays}
    pointers = sum(arrays[name].shape[-1] for name in shapes if name in arrays)
    if pages and "primary" in arrays:
        shapes["primary"] = (None, arrays["primary"].shape[-1])
    check_arrays(table, {**shapes, "cascaded": (None,) * pointers + (layout.stored,)}, pages)
    return table


class ImageModel(MapsModel):
    """Model of an image file; ``image`` is a :class:`CompressedImage`."""

    def build(self):
        self.image = assemble(self.table, self.arrays)


MODEL = ImageModel
