"""Reads of the arrays at a place and a level of detail: the paper's structure, and ours.

Both have the methods ``filtered(u, v, level)`` and ``stored(u, v)``, which reads level 0 with fewer gathers. Levels are
those of a mip pyramid: 0 is the source, each further level is half as large.

The paper reads its arrays at a *footprint* x in [0, 1], the size of a pixel in units of the texture, and draws those of
a training so that a fraction p = 0.5 of them lies below t = 1 / N_base, where N_base is the side of the texture in
texels (the supplement's section "Sampling LODs", equations 3 to 6). It also describes an exponential distribution and
rejects it (equations 7 to 9). The supplement contradicts itself about the unit of x: it calls the footprint the
magnitude of a cross product, which is an area, but the threshold 1 / N_base is the *side* of a texel (the area is
1 / N_base²). Here x is a side. Footprints 0 and 1 belong to the most and the least detailed level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import numpy as np
from drjit import nn

from ...arrays import lookup
from ...arrays.indirection import DifferentiableArray
from ...arrays.pages import PagedArray
from ...maps.pyramid import around, level_sizes

#: Distributions that footprints are drawn from.
FOOTPRINTS = ("power", "exponential")

#: Fraction p of the samples below the threshold t.
FRACTION = 0.5


def threshold(base: int) -> float:
    """Return ``t = 1 / N_base`` for the side of a texture in texels; half of [0, 1] for a side of 1."""
    return 1 / max(2, base)


def exponent(t: float) -> float:
    """Return ``n = log_p(t)``, for which a fraction p of all ``u^n`` lies below ``t`` (equation 6)."""
    return math.log(t) / math.log(FRACTION)


def exponential_rate(t: float) -> float:
    """Return ``λ_e = −ln(1 − p) / t``, for which a fraction p of all samples lies below ``t`` (equation 9)."""
    return -math.log1p(-FRACTION) / t


def footprints(u, distribution: str, base: int):
    """Draw footprints in [0, 1] for a texture of side ``base`` from uniform numbers ``u`` in (0, 1].

    ``distribution`` is one of :data:`FOOTPRINTS`: ``x = u^n`` (equation 3), or ``x = −ln(u) / λ_e`` (equation 7), at
    most 1.
    """
    t = threshold(base)
    if distribution == "power":
        return u ** exponent(t)
    return dr.minimum(-dr.log(dr.maximum(u, 1e-30)) / exponential_rate(t), 1)


def share_below(x: np.ndarray, distribution: str, base: int) -> np.ndarray:
    """Return the fraction of footprints below ``x`` in [0, 1): ``x^(1/n)`` or ``1 − e^(−λ_e x)`` (equations 5, 8)."""
    t = threshold(base)
    return x ** (1 / exponent(t)) if distribution == "power" else 1 - np.exp(-exponential_rate(t) * x)


def footprint_histogram(distribution: str, levels: int) -> np.ndarray:
    """Return the share of footprints that is nearest to each of ``levels`` levels of detail.

    The texture has the side 2^(levels − 1). Shape ``(levels,)``; the shares sum to 1.
    """
    between = 2.0 ** (np.arange(levels - 1) + 0.5 - (levels - 1))
    below = share_below(between, distribution, 2 ** (levels - 1))
    return np.diff(np.concatenate([[0.0], below, [1.0]]))


def level_of(x, levels: int):
    """Return the level of detail in [0, levels − 1] of a footprint in [0, 1]."""
    return dr.maximum(dr.log2(dr.maximum(x, 1e-30)) + (levels - 1), 0)


def footprint_of(level, levels: int):
    """Return the footprint in [0, 1] of a level of detail: the inverse of :func:`level_of`.

    Level 0 has the footprint of one texel; smaller footprints are magnified and read level 0, too.
    """
    return dr.exp2(level - (levels - 1))


@dataclass(frozen=True)
class PaperStructure:
    """Structure of the paper's arrays: the number of ``levels`` of the texture."""

    levels: int


class PaperNet(nn.Module):
    """The paper's arrays (supplement, table 3).

    ``primary0`` has 3 channels and is read at (v, u); ``primary1`` has 1 channel and is read at the footprint. Together
    they point into ``cascaded``, ``N_lod × N_c³``.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "primary0": DifferentiableArray,
        "primary1": DifferentiableArray,
        "cascaded": DifferentiableArray,
        "structure": object,
    }

    def __init__(self, primary0=None, primary1=None, cascaded=None, structure: PaperStructure | None = None):
        self.primary0, self.primary1, self.cascaded, self.structure = primary0, primary1, cascaded, structure

    @property
    def arrays(self) -> dict[str, DifferentiableArray]:
        """The arrays by name, in the order of a file."""
        return {"primary0": self.primary0, "primary1": self.primary1, "cascaded": self.cascaded}

    #: Numbers beside the channels: none
    extras = None

    @property
    def border(self) -> tuple[str, str]:
        """The border of the texture along v and u."""
        return self.primary0.border

    def extra(self, u, v, level, active=True) -> None:
        """Return ``None``, see :meth:`LayeredNet.extra`."""

    def changed(self, change) -> PaperNet:
        """Return a copy with ``change(array, bits)`` in place of each array."""
        return PaperNet(*(change(a, 8) for a in self.arrays.values()), self.structure)

    def at_footprint(self, u, v, x, active=True) -> list:
        """Return the channels at (u, v) for a footprint in [0, 1]."""
        inside = self.primary0.is_pointer and self.primary1.is_pointer
        return self.cascaded([*self.primary1([x], active), *self.primary0([v, u], active)], active, inside)

    def filtered(self, u, v, level, active=True) -> list:
        """Return the channels at (u, v) and a level of detail from 0 to ``levels − 1``."""
        return self.at_footprint(u, v, footprint_of(level, self.structure.levels), active)

    def stored(self, u, v, active=True) -> list:
        """Return the channels at level 0; with bytes, the footprint's array is one constant and is not read."""
        array, x = self.primary1, float(footprint_of(0.0, self.structure.levels))
        if array.storage == "uint8":
            entries, at = array.numpy()[:, 0], x * (array.resolution[0] - 1)
            lower = min(int(at), len(entries) - 2)
            lod = type(u)(float(entries[lower] + (at - lower) * (entries[lower + 1] - entries[lower])))
        else:
            (lod,) = array([type(u)(x)])
        return self.cascaded([lod, *self.primary0([v, u], active)], active, self.primary0.is_pointer)


@dataclass(frozen=True)
class FineLayer:
    """A fine array, on the grid of the level of detail ``level``.

    Its value, less :attr:`zero` and times the ``scale`` of each channel, is added to the pointer in full up to the
    level ``until`` and fades out from there to ``until + 1``. ``bits`` are those of an entry. A ``paged`` layer
    consists of pages, whose resolution follows the content. Layers that hold pointers
    (:meth:`LayeredStructure.is_pointer`) replace the pointer instead; their ``scale`` is 1 and they have no zero.
    """

    level: int
    until: int
    bits: int
    scale: tuple[float, ...]
    paged: bool = False

    @property
    def channels(self) -> int:
        return len(self.scale)

    @property
    def zero(self) -> float:
        """Entry that stands for no difference: a multiple of 1 / (2^bits − 1), or 0.5 for a single bit."""
        return 0.5 if self.bits == 1 else 2 ** (self.bits - 1) / (2**self.bits - 1)


@dataclass(frozen=True)
class LayeredStructure:
    """Structure of our arrays.

    - ``height``, ``width``: size of the texture in texels.
    - ``layers``: the fine arrays, the finest first.
    - ``skip``: first level of the coarse array, whose pointers have ``bits`` bits.
    - ``base``: the coarsest layer holds pointers, so finer levels do not read the coarse array.
    """

    height: int
    width: int
    layers: tuple[FineLayer, ...]
    skip: int
    bits: int = 8
    base: bool = False

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """Rows and columns of all levels."""
        return level_sizes(self.height, self.width)

    def is_pointer(self, layer: FineLayer) -> bool:
        """Return whether a layer holds pointers in place of differences."""
        return layer.paged or (self.base and layer == self.layers[-1])


#: Extras that change nothing: two for the shape of a specular lobe (an entry of 8 bits), and its weight.
NEUTRAL = (128 / 255, 128 / 255, 1.0)

#: Entries along a side of each level of the extras, at most.
EXTRA_SIDE = 8


def neutral_extras(height: int, width: int, border: tuple[str, str]) -> DifferentiableArray:
    """Return extras for a texture of ``height`` × ``width`` texels, not allocated, all neutral.

    There is a grid for each level that is larger than a grid, and for the first that is not.
    """
    sizes = level_sizes(height, width)
    levels = next((i for i, size in enumerate(sizes) if max(size) <= EXTRA_SIDE), len(sizes) - 1) + 1
    resolution = (levels, *(min(n, EXTRA_SIDE) for n in (height, width)))
    return DifferentiableArray(resolution, len(NEUTRAL), "constant", NEUTRAL, fold=True, border=("clamp", *border))


class LayeredNet(nn.Module):
    """Our arrays.

    - ``coarse``: pointers of all texels of the levels from ``structure.skip`` on, level by level, read trilinearly.
    - ``fine``: differences of the pointers of finer levels, each array on the grid of its level, in few bits and not of
      all channels; or pointers, where arrays consist of pages.
    - ``cascaded``: the colours, read at the sum. If it has one dimension more than ``coarse`` has channels, its first
      axis is the level of detail, one entry a level up to ``structure.skip``.
    - ``extras`` (or ``None``): numbers beside the channels, in a coarse grid for each level up to one as coarse, read
      trilinearly by :meth:`extra`.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "fine": tuple,
        "coarse": DifferentiableArray,
        "cascaded": DifferentiableArray,
        "structure": object,
        "border": tuple,
        "extras": object,
    }

    def __init__(
        self, fine=(), coarse=None, cascaded=None, structure: LayeredStructure | None = None,
        border=("clamp", "clamp"), extras: DifferentiableArray | None = None,
    ):  # fmt: skip
        self.fine, self.coarse, self.cascaded, self.structure = tuple(fine), coarse, cascaded, structure
        #: The border of the texture along v and u
        self.border = tuple(border)
        self.extras = extras

    @property
    def arrays(self) -> dict[str, DifferentiableArray]:
        """The arrays by name, in the order of a file."""
        fine = {f"level{x.level}": a for x, a in zip(self.structure.layers, self.fine, strict=True)}
        extras = {} if self.extras is None else {"extras": self.extras}
        return {**fine, "coarse": self.coarse, "cascaded": self.cascaded, **extras}

    def changed(self, change) -> LayeredNet:
        """Return a copy with ``change(array, bits)`` in place of each array."""
        structure = self.structure
        fine = [change(a, x.bits) for a, x in zip(self.fine, structure.layers, strict=True)]
        extras = None if self.extras is None else change(self.extras, 8)
        coarse, cascaded = change(self.coarse, structure.bits), change(self.cascaded, 8)
        return LayeredNet(fine, coarse, cascaded, structure, self.border, extras)

    def fixed_fine(self) -> LayeredNet:
        """Return a copy without gradients of the entries that level 0 reads, nor of colours of the levels they serve.

        Its fine levels keep their values in a training.
        """
        layers = self.structure.layers
        pointers = [i for i, x in enumerate(layers) if self.structure.is_pointer(x)]
        count = pointers[0] + 1 if pointers else len(layers)
        result = LayeredNet(self.fine, self.coarse, self.cascaded, self.structure, self.border, self.extras)
        result.fine = tuple(a.fixed(None) if i < count else a for i, a in enumerate(self.fine))
        if not pointers:
            result.coarse = self.coarse.fixed(None)
        by_level = self.cascaded.dims > self.coarse.channels
        result.cascaded = self.cascaded.fixed(layers[count - 1].until + 1 if by_level and count else None)
        return result

    def extra(self, u, v, level, active=True) -> list | None:
        """Return the ``extras`` at (u, v) and a level of detail, numbers in [0, 1], or ``None`` without them."""
        if self.extras is None:
            return None
        levels, *sizes = self.extras.resolution
        coordinates = [lookup.clamp(level * (1 / max(1, levels - 1)), 0.0, 1.0)]
        return self.extras([*coordinates, *self._at(u, v, sizes)], active)

    def filtered(self, u, v, level, active=True) -> list:
        """Return the channels at (u, v) and a level of detail from 0 to the last level."""
        structure, Float = self.structure, type(u)
        UInt32 = dr.uint32_array_t(Float)
        above = dr.maximum(level - structure.skip, 0)
        lower = dr.floor(above)
        weight = above - dr.detach(lower)
        (rows, columns), offset = self._level(UInt32(lower) + structure.skip)
        pointer = self._coarse(u, v, rows, columns, offset, active)
        offset = dr.minimum(offset + rows * columns, self.coarse.resolution[0] - 1)
        rows, columns = (dr.maximum(n >> 1, 1) for n in (rows, columns))
        upper = self._coarse(u, v, rows, columns, offset, active)
        pointer = [dr.fma(weight, b - a, a) for a, b in zip(pointer, upper, strict=True)]
        for x, array in reversed([*zip(structure.layers, self.fine, strict=True)]):
            share = 1 - lookup.clamp(level - x.until, 0.0, 1.0)
            self._add(pointer, x, array, u, v, share, active)
        return self._answer(pointer, level, active)

    def stored(self, u, v, active=True) -> list:
        """Return the channels at level 0: from the finest layer that holds pointers and the finer ones alone."""
        layers = [*zip(self.structure.layers, self.fine, strict=True)]
        last = next((i for i, (x, _) in enumerate(layers) if self.structure.is_pointer(x)), None)
        if last is None:
            UInt32 = dr.uint32_array_t(type(u))
            pointer = self._coarse(u, v, *map(UInt32, self.structure.sizes[self.structure.skip]), UInt32(0), active)
        else:
            _, array = layers[last]
            pointer = array(self._place(array, u, v), active)
            layers = layers[:last]
        for x, array in layers:
            self._add(pointer, x, array, u, v, None, active)
        return self._answer(pointer, type(u)(0), active)

    def _answer(self, pointer: list, level, active) -> list:
        """Return the cascaded array at a pointer, with the level as its first coordinate if it has such an axis."""
        if self.cascaded.dims > len(pointer):
            pointer = [lookup.clamp(level * (1 / max(1, self.structure.skip)), 0.0, 1.0), *pointer]
        return self.cascaded(pointer, active)

    def _add(self, pointer: list, layer: FineLayer, array: DifferentiableArray, u, v, share, active) -> None:
        """Add a layer to ``pointer``, or replace it by a layer that holds pointers, times ``share`` (``None``: 1)."""
        values = array(self._place(array, u, v), active)
        if self.structure.is_pointer(layer):
            for k, value in enumerate(values):
                pointer[k] = value if share is None else dr.fma(share, value - pointer[k], pointer[k])
            return
        for k, value in enumerate(values):
            value = (value - layer.zero) * layer.scale[k]
            pointer[k] = pointer[k] + value if share is None else dr.fma(share, value, pointer[k])

    def _place(self, array: DifferentiableArray, u, v) -> list:
        """Return the coordinates (v, u) of a read of a fine array, whose entries lie at texel centres."""
        return [v, u] if isinstance(array, PagedArray) else self._at(u, v, array.resolution)

    def _at(self, u, v, resolution) -> list:
        """Return the coordinates (v, u) of a read of a grid, whose entries lie at texel centres."""
        place = []
        for x, n, border in zip((v, u), resolution, self.border, strict=True):
            place.append(x - 0.5 / n if border == "repeat" else (x * n - 0.5) * (1 / max(1, n - 1)))
        return place

    def _level(self, level) -> tuple:
        """Return rows and columns of a whole level for each place, and its first entry in ``coarse``."""
        structure, UInt32 = self.structure, type(level)
        sizes = structure.sizes[structure.skip :]
        if len(sizes) == 1:
            return tuple(map(UInt32, sizes[0])), UInt32(0)
        offset, start = UInt32(0), 0
        for i, size in enumerate(sizes[:-1]):
            start += math.prod(size)
            offset = dr.select(level > structure.skip + i, start, offset)
        return tuple(dr.maximum(UInt32(n) >> level, 1) for n in (structure.height, structure.width)), offset

    def _coarse(self, u, v, rows, columns, offset, active) -> list:
        """Return the pointer of ``coarse`` at (u, v) in the level of so many rows and columns from an entry on."""
        across = around(u, columns, self.border[1])
        corners = []
        for row, a in around(v, rows, self.border[0]):
            corners += [(offset + row * columns + column, a * b) for column, b in across]
        return self.coarse.blend(corners, active)
