"""
How arrays are read at a place and a level of detail: the paper's layout, and ours.

Both answer ``filtered(u, v, level)`` and ``stored(u, v)``, which is level 0 and reads no more than that needs. Levels
are those of a mip pyramid: 0 is the source, each further one half as large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
from drjit import nn

from ... import lookup
from ...compat import module_of
from ...indirection import DifferentiableArray
from ...maps.pyramid import around, level_sizes
from ...pages import PagedArray
from .sampling import footprint_of


@dataclass(frozen=True)
class PaperStructure:
    """What the paper's arrays do not say themselves: the ``levels`` of the texture, and what footprints measure."""

    levels: int
    axis: str


class PaperNet(nn.Module):
    """
    The paper's arrays (the supplement's table 3): ``primary0``, read at (v, u), 3 channels, and ``primary1``, read at
    the footprint, 1 channel, point into ``cascaded``, ``N_lod × N_c³``.
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

    @property
    def border(self) -> tuple[str, str]:
        """The border of the texture along v and u."""
        return self.primary0.border

    def changed(self, change) -> PaperNet:
        """A copy with ``change(array, bits)`` in place of each array."""
        return PaperNet(*(change(a, 8) for a in self.arrays.values()), self.structure)

    def at_footprint(self, u, v, x, active=True) -> list:
        """The channels at (u, v) for a footprint in [0, 1]."""
        inside = self.primary0.is_pointer and self.primary1.is_pointer
        return self.cascaded([*self.primary1([x], active), *self.primary0([v, u], active)], active, inside)

    def filtered(self, u, v, level, active=True) -> list:
        """The channels at (u, v) and a level of detail within those that there are."""
        return self.at_footprint(u, v, footprint_of(level, self.structure.axis, self.structure.levels), active)

    def stored(self, u, v, active=True) -> list:
        """The same at level 0. The footprint's array is not read: it says one number, known when bytes are stored."""
        array, x = self.primary1, float(footprint_of(0.0, self.structure.axis, self.structure.levels))
        if array.storage == "uint8":
            entries, at = array.numpy()[:, 0], x * (array.resolution[0] - 1)
            lower = min(int(at), len(entries) - 2)
            lod = type(u)(float(entries[lower] + (at - lower) * (entries[lower + 1] - entries[lower])))
        else:
            (lod,) = array([type(u)(x)])
        return self.cascaded([lod, *self.primary0([v, u], active)], active, self.primary0.is_pointer)


@dataclass(frozen=True)
class FineLayer:
    """
    A fine array of ours: it has the size of the level of detail ``level``, and what is read of it, less
    :attr:`zero`, times the ``scale`` of each channel, is added to the pointer from the levels below ``until``, and less
    and less from there to ``until + 1``. ``bits`` are those of an entry. One that is ``paged`` consists of pages, whose
    resolution follows the content, and holds pointers themselves. (Of these, see also :class:`LayeredStructure`,
    ``scale`` is 1 and there is no zero.)
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
        """The entry, a multiple of 1 / (2^bits − 1) if there are several bits, that stands for no difference."""
        return 0.5 if self.bits == 1 else 2 ** (self.bits - 1) / (2**self.bits - 1)


@dataclass(frozen=True)
class LayeredStructure:
    """
    What our arrays do not say themselves: the size of the texture, the fine ``layers``, the finest first, the level of
    detail ``skip`` from which on each has its own pointers, and the ``bits`` of these. ``base``: the coarsest of the
    layers holds pointers, not differences, so that finer levels need not read those from ``skip`` on.
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
        """Does a layer hold pointers, not differences?"""
        return layer.paged or (self.base and layer == self.layers[-1])


class LayeredNet(nn.Module):
    """
    Our arrays. ``coarse`` holds pointers for all texels of the levels from ``structure.skip`` on, level by level,
    read trilinearly; ``fine`` what the pointers of finer levels differ by, each array on the grid of its level, in few
    bits and not of all channels, or, where it consists of pages, pointers; ``cascaded`` is read at what that makes. Its
    first axis is the level of detail, one entry a level up to ``structure.skip``, if it has one dimension more than
    ``coarse`` has channels.
    """

    DRJIT_STRUCT = {  # noqa: RUF012
        "fine": tuple,
        "coarse": DifferentiableArray,
        "cascaded": DifferentiableArray,
        "structure": object,
        "along": tuple,
    }

    def __init__(
        self, fine=(), coarse=None, cascaded=None, structure: LayeredStructure | None = None, border=("clamp", "clamp")
    ):
        self.fine, self.coarse, self.cascaded, self.structure = tuple(fine), coarse, cascaded, structure
        self.along = tuple(border)

    @property
    def arrays(self) -> dict[str, DifferentiableArray]:
        """The arrays by name, in the order of a file."""
        fine = {f"level{x.level}": a for x, a in zip(self.structure.layers, self.fine, strict=True)}
        return {**fine, "coarse": self.coarse, "cascaded": self.cascaded}

    @property
    def border(self) -> tuple[str, str]:
        """The border of the texture along v and u."""
        return self.along

    def changed(self, change) -> LayeredNet:
        """A copy with ``change(array, bits)`` in place of each array."""
        structure = self.structure
        fine = [change(a, x.bits) for a, x in zip(self.fine, structure.layers, strict=True)]
        return LayeredNet(fine, change(self.coarse, structure.bits), change(self.cascaded, 8), structure, self.along)

    def filtered(self, u, v, level, active=True) -> list:
        """The channels at (u, v) and a level of detail within those that there are."""
        structure, Float = self.structure, type(u)
        UInt32 = dr.uint32_array_t(Float)
        above = dr.maximum(level - structure.skip, 0)
        lower = dr.floor(above)
        weight = above - dr.detach(lower)
        index = UInt32(lower) + structure.skip
        pointer = self._coarse(u, v, index, active)
        upper = self._coarse(u, v, dr.minimum(index + 1, len(structure.sizes) - 1), active)
        pointer = [dr.fma(weight, b - a, a) for a, b in zip(pointer, upper, strict=True)]
        for x, array in reversed([*zip(structure.layers, self.fine, strict=True)]):
            share = 1 - lookup.clamp(level - x.until, 0.0, 1.0)
            self._add(pointer, x, array, u, v, share, active)
        return self._answer(pointer, level, active)

    def stored(self, u, v, active=True) -> list:
        """The same at level 0."""
        layers = [*zip(self.structure.layers, self.fine, strict=True)]
        # What is finer than the finest array that holds pointers, and this one
        last = next((i for i, (x, _) in enumerate(layers) if self.structure.is_pointer(x)), None)
        if last is None:
            pointer = self._coarse(u, v, None, active)
        else:
            _, array = layers[last]
            pointer = array(self._place(array, u, v), active)
            layers = layers[:last]
        for x, array in layers:
            self._add(pointer, x, array, u, v, None, active)
        return self._answer(pointer, type(u)(0), active)

    def _answer(self, pointer: list, level, active) -> list:
        if self.cascaded.dims > len(pointer):
            pointer = [lookup.clamp(level * (1 / max(1, self.structure.skip)), 0.0, 1.0), *pointer]
        return self.cascaded(pointer, active)

    def _add(self, pointer: list, layer: FineLayer, array: DifferentiableArray, u, v, share, active) -> None:
        """Add what a layer says to a pointer, times ``share`` (``None``: 1); pointers take its place."""
        found = array(self._place(array, u, v), active)
        if self.structure.is_pointer(layer):
            for k, value in enumerate(found):
                pointer[k] = value if share is None else dr.fma(share, value - pointer[k], pointer[k])
            return
        for k, value in enumerate(found):
            value = (value - layer.zero) * layer.scale[k]
            pointer[k] = pointer[k] + value if share is None else dr.fma(share, value, pointer[k])

    def _place(self, array: DifferentiableArray, u, v) -> list:
        """Where a fine array is read for (u, v): its entries sit at texel centres, and pages are where they are."""
        if isinstance(array, PagedArray):
            return [v, u]
        place = []
        for x, n, border in zip((v, u), array.resolution, self.along, strict=True):
            place.append(x - 0.5 / n if border == "repeat" else (x * n - 0.5) * (1 / max(1, n - 1)))
        return place

    def _coarse(self, u, v, level, active) -> list:
        """The pointer that ``coarse`` has at (u, v) of a level, a whole number for each place; ``None``: the finest."""
        structure, UInt32 = self.structure, dr.uint32_array_t(type(u))
        sizes = structure.sizes[structure.skip :]
        if level is None or len(sizes) == 1:
            (rows, columns), offset = (UInt32(n) for n in sizes[0]), UInt32(0)
        else:
            rows, columns = (dr.maximum(UInt32(n) >> level, 1) for n in (structure.height, structure.width))
            offset, start = UInt32(0), 0
            for i, size in enumerate(sizes[:-1]):
                start += math.prod(size)
                offset = dr.select(level > structure.skip + i, start, offset)
        total = None
        for row, a in around(v, rows, self.along[0]):
            for column, b in around(u, columns, self.along[1]):
                found, weight = self.coarse.entry(offset + row * columns + column, active), a * b
                total = (
                    [weight * f for f in found]
                    if total is None
                    else [dr.fma(weight, f, t) for f, t in zip(found, total, strict=True)]
                )
        return total


def coarse_texels(structure: LayeredStructure) -> int:
    """Texels of all levels from ``structure.skip`` on."""
    return sum(math.prod(size) for size in structure.sizes[structure.skip :])


def types_of(net) -> object:
    """The module of the Dr.Jit types that a net is read with."""
    return module_of(net.cascaded.data)
