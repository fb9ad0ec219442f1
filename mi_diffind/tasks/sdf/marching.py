"""Ray marching through a sparse grid (:class:`.nodes.SparseNodes`), from cell to cell.

A ray goes from one empty region or block to the next by the index's empty-space distances. In a block with crossed
cells it goes to where the block's *slab* begins: the space between two planes, parallel to that of the block's frame,
beyond which the sign is known. There it goes from cell to cell; nodes are read only in cells that the surface may
cross, all corners at once, and the field is evaluated at :data:`SAMPLES` places along the ray. The ray may miss a part
of the solid that it enters and leaves between two of these places, which are at most h·√3 / :data:`SAMPLES` apart in a
cell of the spacing h.

While nodes are trained, the surface may move anywhere in their cells, so there are no slabs. Lengths are in spacings,
as in the structure.
"""

import threading
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from ...arrays.boxes import box_interval, is_direction
from ...arrays.indirection import device_array
from ...arrays.lookup import mask_words
from ...arrays.sparse_grid import BLOCK, CORNERS, empty_distances, place_of_bit
from ...core import compat
from .nodes import MIDDLE, bernstein, unpack_frames

#: Places along the ray at which the field is evaluated in a cell.
SAMPLES = 3

#: Steps by false position from the places between which the sign changes.
FALSE_POSITION_STEPS = 3

#: Distance by which a ray is advanced beyond the side of a cell, so that it is in the next one.
EPSILON = 1e-3

#: Magnitude below which a component of a direction counts as zero.
TINY = 1e-12

#: Smallest rise of a ray above a plane, per spacing. With less, distances would exceed the range of whole numbers; with
#: more, the error would exceed a slab's margin in the longest grid.
LEAST_SLOPE = 1e-7

#: Flag in the word of a block without crossed cells, above the distance to the next crossed one in blocks: the word is
#: no number of a block.
EMPTY = 1 << 31

#: Flag in such a word: the block is inside.
INSIDE = 1 << 30

#: Largest height of a slab's bounds above or below the plane of its block, in spacings.
SLAB = 10.0

#: Number of steps of that height, in 16 bits.
STEPS = 65535

#: Safety margin of a slab, in spacings.
MARGIN = 1e-3

_lock = threading.RLock()  # a thread that waits for the copy of an array may load another shape

#: Blocks whose cells are processed at a time.
PART = 2**11


class GridCells:
    """Cells of the blocks of a field's grid, for B blocks with nodes (NumPy).

    - ``places`` (B, 3): the blocks' places in the grid of blocks;
    - ``crossed`` (B, 64) bool: whether all corners of each cell are stored;
    - ``inside`` (B, 64) bool: the sign of the other cells;
    - ``beside`` (B, 8): the blocks that the corners of cells lie in, the block itself where there is none.
    """

    def __init__(self, field):
        self.field, self.places = field, field.structure.block_positions() // BLOCK
        count, last = len(self.places), np.array(field.structure.shape) // BLOCK
        self.crossed, self.inside = np.empty((2, count, 64), bool)
        self.beside = np.repeat(np.arange(count, dtype=np.int32)[:, None], 8, axis=1)
        for part in self.parts():
            stored, _, inside = self.corners(part)
            self.crossed[part], self.inside[part] = stored.all(axis=0), (inside & ~stored).any(axis=0)
            beside = self.places[part][:, None] + CORNERS
            number, has = self._evaluate(
                field.index.block(*self._columns(BLOCK * beside), field.types.Bool((beside < last).all(-1).ravel()))[:2]
            )
            self.beside[part][has.reshape(-1, 8)] = number[has]

    def parts(self) -> list[slice]:
        """Return slices of :data:`PART` blocks, which are processed at a time."""
        return [slice(first, first + PART) for first in range(0, len(self.places), PART)]

    def corners(self, part: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return which corners of the cells of some blocks are stored, their numbers, and the signs of the others.

        All are ``(8, m, 64)``. A cell beyond the last one, where no ray comes, counts as the last one.
        """
        cells = BLOCK * self.places[part][:, None] + place_of_bit(np.arange(64))
        cells = np.minimum(cells, np.array(self.field.structure.shape) - 2)
        corners = self.field.index.corners(self._columns(cells), self.field.types.Bool(True))
        stored, number, _, _, inside = zip(*corners, strict=True)
        arrays = self._evaluate([*stored, *number, *inside])
        return tuple(np.stack(arrays[i : i + 8]).reshape(8, -1, 64) for i in (0, 8, 16))

    def _columns(self, positions: np.ndarray) -> list:
        """Return positions (…, 3) as three ``Int32``."""
        return [device_array(self.field.types.Int32, v) for v in positions.reshape(-1, 3).T.astype(np.int32)]

    @staticmethod
    def _evaluate(arrays) -> list[np.ndarray]:
        """Evaluate arrays in one kernel."""
        dr.eval(arrays)
        return [array.numpy() for array in arrays]


def slab_words(cells: GridCells, nodes, frames) -> np.ndarray:
    """Return how far above its plane P each block's solid begins and ends, words (B,) of twice 16 bits.

    P is the plane of the block's frame. A place in the block is inside where P is less than the lower bound, outside
    where P is above the upper bound. In a crossed cell f − P, a polynomial of degree 2 along each axis, lies between
    its Bernstein coefficients; where f is 0, P lies between their negatives. The signs of all other cells are kept.
    """
    (nx, ny, nz), distances, _ = unpack_frames(frames)
    normals = np.stack([nx, ny, nz], axis=1)
    lower, upper = np.full((2, len(frames)), np.inf)
    upper *= -1
    half = np.abs(normals).sum(axis=1) / 2
    for part in cells.parts():
        distance, normal = distances[part], normals[part]
        block, bit = np.nonzero(cells.crossed[part])
        at = place_of_bit(bit)[:, None] + CORNERS
        residual = nodes[cells.corners(part)[1][:, block, bit].T].astype(np.float64)
        residual[..., 0] -= distance[block, None] + np.einsum("mki,mi->mk", at - MIDDLE, normal[block])
        residual[..., 1:] -= normal[block, None]
        coefficients = bernstein(residual)
        np.minimum.at(lower[part], block, -coefficients.max(axis=1))
        np.maximum.at(upper[part], block, -coefficients.min(axis=1))
        block, bit = np.nonzero(~cells.crossed[part])
        within = cells.inside[part][block, bit]
        planes = distance[block] + np.einsum("mi,mi->m", place_of_bit(bit) - MIDDLE + 0.5, normal[block])
        np.maximum.at(upper[part], block[within], (planes + half[part][block])[within])
        np.minimum.at(lower[part], block[~within], (planes - half[part][block])[~within])
    scale = STEPS / (2 * SLAB)
    lower = np.floor((np.clip(lower - MARGIN, -SLAB, SLAB) + SLAB) * scale).astype(np.uint32)
    upper = np.ceil((np.clip(upper + MARGIN, -SLAB, SLAB) + SLAB) * scale).astype(np.uint32)
    return lower | upper << np.uint32(16)


def empty_space_words(structure, cells: GridCells) -> tuple[np.ndarray, np.ndarray]:
    """Return the words of regions and of blocks by which rays skip empty space, uint32.

    A region's word is the number of its blocks' words, or flags and distance (:data:`EMPTY`); the words of the blocks
    ``(R, 64)`` of regions that are not empty are the number of the block, or flags and distance.
    """
    sign, place = structure.empty_block_signs(), cells.places
    full, crossed = np.zeros(sign.shape, bool), cells.crossed.any(axis=1)
    full[tuple(place.T)] = crossed
    sign[tuple(place.T)] = cells.inside[:, 0]  # where no cell is crossed, all have the same
    layers, first_blocks = structure.regions.shape[0], place[:, 0] // 4
    some, region_signs, words = [], [], []
    for layer in range(layers):
        inner = slice(4 * layer, 4 * layer + 4)
        # A region that is not empty has a crossed block, at most three blocks from any other: one layer more each way
        halo = slice(max(0, inner.start - 4), min(4 * layers, inner.stop + 4))
        word = _empty_words(full[halo], sign[halo])[inner.start - halo.start :][:4]
        rows = np.arange(*np.searchsorted(first_blocks, [layer, layer + 1]))
        rows = rows[crossed[rows]]
        x, y, z = place[rows].T
        word[x - inner.start, y, z] = rows
        some.append(_by_region(full[inner]).any(axis=1))
        region_signs.append(_by_region(sign[inner])[:, 0].copy())
        words.append(_by_region(word)[some[-1]])
    some, shape = np.concatenate(some), structure.regions.shape
    regions = _empty_words(some.reshape(shape), np.concatenate(region_signs).reshape(shape)).ravel()
    regions[some] = np.arange(some.sum())
    return regions, np.concatenate(words)


def _by_region(values: np.ndarray) -> np.ndarray:
    """Return the values of a grid of blocks (4 X, 4 Y, 4 Z) by region: (X Y Z, 64)."""
    shape = [n // 4 for n in values.shape]
    return values.reshape(np.stack([shape, (4, 4, 4)], 1).ravel()).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 64)


def _empty_words(full: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Return the flags of the elements of a grid and their distances to the nearest one that is ``full``, uint32."""
    signs = np.where(sign, np.uint32(INSIDE), np.uint32(0))
    return np.uint32(EMPTY) | signs | empty_distances(full).astype(np.uint32)


class Marcher:
    """Ray-marching index: empty-space distances and per-block slabs, built once for a field.

    In memory, for each region, and each block of those with nodes, a word with its number or the distance to the next
    crossed block (:func:`empty_space_words`); for each block with nodes, its :class:`GridCells`, plane and slab.
    """

    def __init__(self, field):
        self.field = field
        structure, UInt32 = field.structure, field.types.UInt32
        cells = GridCells(field)
        regions, blocks = empty_space_words(structure, cells)
        masks = np.concatenate([mask_words(cells.crossed), mask_words(cells.inside)], axis=1)
        self.cells, self.beside, self.regions, self.words = (
            device_array(UInt32, v) for v in (masks, cells.beside, regions, blocks)
        )
        self.slabs, nodes = None, field.decoded()
        if nodes is not None:
            frames = field.frames()
            slabs = np.stack([frames, slab_words(cells, nodes, frames)], axis=1)
            self.slabs = device_array(UInt32, slabs)

    @property
    def nbytes(self) -> int:
        """Bytes of the index in memory."""
        slabs = [] if self.slabs is None else [self.slabs]
        return 4 * sum(map(dr.width, [self.regions, self.words, self.cells, self.beside, *slabs]))

    def block(self, ray, t, active):
        """Look up the block at ``t`` of a ray: ``(crossed, number, end, inside)``.

        ``crossed``: cells of the block are crossed, and ``number`` is valid; otherwise the ray leaves the empty space
        around the block at ``end``, and ``inside`` is its sign.
        """
        i, j, k = cell = ray.cell(t)
        types = self.field.types
        UInt32, Int32 = types.UInt32, types.Int32
        region = dr.gather(UInt32, self.regions, self.field.index.region(i, j, k), active)
        wide = region >= EMPTY
        place = UInt32((i >> 2 & 3) * 16 + (j >> 2 & 3) * 4 + (k >> 2 & 3))
        word = dr.gather(UInt32, self.words, region * 64 + place, active & ~wide)
        word = dr.select(wide, region, word)
        end = ray.end(cell, dr.select(wide, Int32(4), 2), Int32(word & 0xFFFF))
        return active & (word < EMPTY), word, dr.maximum(end, t), (word & INSIDE) != 0

    def cell(self, ray, t, number, active):
        """Find the next crossed cell from ``t`` in a block: ``(crossed, start, end, known, inside)``.

        ``crossed``: there is a crossed cell before the ray leaves the block, from ``start`` to ``end``; otherwise
        ``end`` is where the ray leaves the cells that are not crossed. ``known``: the sign at ``t`` is known, and is
        ``inside``.
        """
        types = self.field.types
        UInt32, Int32, Float, Bool = types.UInt32, types.Int32, types.Float, types.Bool
        cell, start, last = ray.cell(t), t, Float(dr.inf)
        off, below, within = Bool(False), Bool(False), active
        if self.slabs is not None:
            first, last, below = self.slab(ray, t, number, cell, active)
            off, start = (t < first) | (t > last), dr.maximum(t, first)
            # Ignored if it lies behind, or not in this block
            there, out = ray.cell(start), Int32(0)
            for v, w in zip(cell, there, strict=True):
                out |= (v ^ w) >> 2
            within = active & (t <= last) & (out == 0)
            start = dr.select(within, start, t)
            cell = [dr.select(within, w, v) for v, w in zip(cell, there, strict=True)]
        low, high, low_signs, high_signs = dr.gather(types.Array4u, self.cells, number, within)
        x, y, z = (UInt32(v & 3) for v in cell)
        half, signs = dr.select(x < 2, low, high), dr.select(x < 2, low_signs, high_signs)
        bit = (x & 1) * 16 + y * 4 + z
        crossed = within & (((half >> bit) & 1) == 1)
        # The cell and its seven neighbours in a cube of 2 × 2 × 2 are bits of one word
        alone = (half & (UInt32(0x330033) << ((y & 2) * 4 + (z & 2)))) == 0
        shift = dr.select(within, dr.select(alone, Int32(1), 0), 2)
        end = dr.maximum(ray.end(cell, shift, 1), start)
        end = dr.select(crossed, dr.maximum(dr.minimum(end, last), start), end)
        return crossed, start, end, off | ~crossed, dr.select(off, below, ((signs >> bit) & 1) == 1)

    def slab(self, ray, t, number, cell, active):
        """Return where a ray enters and leaves the slab of a block, and whether it is below the slab at ``t``.

        The block has this ``number`` and holds ``cell``.
        """
        Float = self.field.types.Float
        frame, word = dr.gather(self.field.types.Array2u, self.slabs, number, active)
        n, d, _ = unpack_frames(frame, Float)
        low, high = (dr.fma(Float(v), 2 * SLAB / STEPS, -SLAB) for v in (word & 0xFFFF, word >> 16))
        # The height above the plane is at + slope t
        at, slope = d, Float(0)
        for v, x, o, e in zip(n, cell, ray.o, ray.d, strict=True):
            at, slope = dr.fma(v, o - Float(x & ~3) - MIDDLE, at), dr.fma(v, e, slope)
        slope = dr.select(dr.abs(slope) < LEAST_SLOPE, LEAST_SLOPE, slope)
        inverse = dr.rcp(slope)
        one, other = (low - at) * inverse, (high - at) * inverse
        first, last = dr.minimum(one, other), dr.maximum(one, other)
        return first, last, (t < first) == (slope > 0)

    def corners(self, number, cell, active=True):
        """Return distance and gradient, in spacings, of a crossed cell's eight nodes, in the order of ``CORNERS``."""
        field, Words = self.field, dr.uint32_array_t(self.field.types.Array4f)
        owners = [w for n in (0, 1) for w in dr.gather(Words, self.beside, number * 2 + n, active)]
        # The block in which each corner lies, axis by axis
        for v, m in zip(cell, (4, 2, 1), strict=True):
            last = (v & 3) == 3
            owners = [dr.select(last, w, owners[n - m]) if n & m else w for n, w in enumerate(owners)]
        corners = []
        for owner, corner in zip(owners, CORNERS.tolist(), strict=True):
            at = [v + e for v, e in zip(cell, corner, strict=True)]
            record = field.index.record(owner, active)
            _, node, _ = field.index.node(record, *at)
            corners.append(field._node(node, record, *at, active))
        return corners


def get_marcher(field) -> Marcher:
    """Return the field's cached marcher, the same one to all threads."""
    with _lock:
        if "_marcher" not in vars(field):
            vars(field).setdefault("_marcher", Marcher(field))
        return field._marcher


def along(corners, start, d):
    """Return a function of ``t`` that gives the field's value, in spacings, on the ray ``start + t·d`` through a cell.

    The cell extends from 0 to 1 along each axis. Each corner's extrapolation is linear in t; these are blended along z,
    y and x.
    """
    lines = []
    for corner, (distance, g) in zip(CORNERS.tolist(), corners, strict=True):
        offset = [x - e for x, e in zip(start, corner, strict=True)]
        there = dr.fma(g[0], offset[0], dr.fma(g[1], offset[1], g[2] * offset[2]))
        change = dr.fma(g[0], d[0], dr.fma(g[1], d[1], g[2] * d[2]))
        lines.append((dr.fma(0.5, there, distance), 0.5 * change))

    def value(t):
        values = [dr.fma(change, t, there) for there, change in lines]
        for axis in (2, 1, 0):
            w = dr.fma(d[axis], t, start[axis])
            values = [dr.fma(w, q - p, p) for p, q in zip(values[::2], values[1::2], strict=True)]
        return values[0]

    return value


def cross(marcher, ray, low, end, number, leaving, fresh):
    """Find the first change of sign in a crossed cell between ``low`` and ``end`` along the ray: ``(hit, t, leaving)``.

    ``leaving`` is the sign at the start of the ray, which a ``fresh`` ray takes from here.
    """
    cell = ray.cell(low)
    start = [x - ray.types.Float(c) for x, c in zip(ray.o, cell, strict=True)]
    value = along(marcher.corners(number, cell), start, ray.d)

    step = (end - low) * (1 / SAMPLES)
    start, high = low, low
    a = b = value(low)
    leaving = dr.select(fresh, a < 0, leaving)
    hit = (a < 0) != leaving
    for n in range(SAMPLES):
        t = dr.fma(step, n + 1, start)
        v = value(t)
        other = (v < 0) != leaving
        high, b = dr.select(other & ~hit, t, high), dr.select(other & ~hit, v, b)
        hit |= other
        low, a = dr.select(hit, low, t), dr.select(hit, a, v)
    for _ in range(FALSE_POSITION_STEPS):
        t = dr.fma(high - low, _share(a, b), low)
        v = value(t)
        other = (v < 0) != leaving
        low, a = dr.select(other, low, t), dr.select(other, a, v)
        high, b = dr.select(other, t, high), dr.select(other, v, b)
    return hit, dr.fma(high - low, _share(a, b), low), leaving


def _share(a, b):
    """Return the share of the way at which values from a to b, of different signs, are zero; 0 if they are equal."""
    return dr.select(a == b, 0, dr.clip(a / (a - b), 0.02, 0.98))


class GridRay:
    """Ray ``o + t·d`` in a grid, with the reciprocals of its direction."""

    def __init__(self, field, o, d):
        self.types, self.last = field.types, field.index.last_cell
        self.o, self.d = list(o), list(d)
        still = [dr.abs(v) < TINY for v in d]
        self.inverse = [dr.rcp(dr.select(s, TINY, v)) for s, v in zip(still, d, strict=True)]
        self.up = [(v > 0) | s for s, v in zip(still, d, strict=True)]

    def cell(self, t):
        """Return the cell at ``t``."""
        return [
            dr.clip(self.types.Int32(dr.floor(dr.fma(v, t, x))), 0, n)
            for x, v, n in zip(self.o, self.d, self.last, strict=True)
        ]

    def end(self, cell, shift, reach):
        """Return where the ray leaves the cubes of 2^shift cells less than ``reach`` of them away from a cell."""
        sides = [
            (self.types.Float(((c >> shift) + dr.select(e, reach, 1 - reach)) << shift) - x) * r
            for x, c, e, r in zip(self.o, cell, self.up, self.inverse, strict=True)
        ]
        return dr.minimum(dr.minimum(sides[0], sides[1]), sides[2])


@compat.syntax
def march(marcher, o, d, length, fresh, active):
    """Find the first change of sign before ``length`` along rays ``o + t·d`` in the grid: ``(hit, t, leaving)``.

    ``d`` has length 1; ``o`` and ``t`` are in spacings from the grid's lower corner. A ``fresh`` ray starts with the
    sign at its origin, any other one outside.
    """
    types = marcher.field.types
    ray = GridRay(marcher.field, o, d)
    t, hit, leaving = types.Float(0), types.Bool(False), types.Bool(False)
    fresh, active = types.Bool(fresh), types.Bool(active)
    while dr.hint(active, label="crossed cells"):
        # All rays of a packet go on until each has reached a crossed cell, since reading it is expensive
        seeking, number, end = types.Bool(active), types.UInt32(0), t
        while dr.hint(seeking, label="blocks with crossed cells"):
            far = types.Bool(seeking)
            while dr.hint(far, label="empty blocks"):
                some, word, following, sign = marcher.block(ray, t, far)
                empty = far & ~some
                number = dr.select(some, word, number)
                leaving = dr.select(empty & fresh, sign, leaving)
                fresh &= ~empty
                jumped = empty & (sign != leaving)
                hit |= jumped
                t = dr.select(empty & ~jumped, following + EPSILON, t)
                active &= ~jumped & (t < length)
                far &= ~some & active
            seeking &= active
            crossed, start, following, known, sign = marcher.cell(ray, t, number, seeking)
            known &= seeking
            leaving = dr.select(fresh & known, sign, leaving)
            fresh &= ~known
            jumped = known & (sign != leaving)
            crossed &= ~jumped
            end = dr.select(crossed, following, end)
            hit |= jumped
            t = dr.select(seeking & ~jumped, dr.select(crossed, start, following + EPSILON), t)
            active &= ~jumped & (t < length)
            seeking &= ~crossed & active
        struck, place, leaving = dr.if_stmt(
            (t, end, number, leaving, fresh),
            active,
            lambda t, end, number, leaving, fresh: cross(marcher, ray, t, end, number, leaving, fresh),
            lambda t, end, number, leaving, fresh: (types.Bool(False), t, leaving),
        )
        struck &= active
        hit |= struck
        fresh &= ~active
        t = dr.select(struck, place, dr.select(active, end + EPSILON, t))
        active &= ~struck & (t < length)
    return hit & (t <= length), t, leaving


#: Shortest step, relative to the longest side; a ray may miss a solid that it crosses in less.
SHORTEST_STEP = 1e-4

#: Largest error of a hit along a sphere-traced ray, relative to the longest side.
TOLERANCE = 1e-5

#: Value at which a place counts as on the surface.
ZERO = 1e-6

#: Distance, in cells, by which a ray may exceed the safe step where the surface is expected.
RELAXATION = 1.0

#: Steps by false position before bisection takes over.
FALSE_POSITIONS = 5


@dataclass
class Hit:
    """Intersection of rays with a surface.

    ``hit``: whether the surface was hit; ``t``: the distance along the ray, infinite without a hit; ``p``: the place,
    more precise than ``o + t·d`` for a ray from afar; ``leaving``: whether the ray came from within the solid.
    """

    hit: Any
    t: Any
    p: Any
    leaving: Any


def enter(field, o, d, maxt, active=True):
    """Return the distances at which rays enter and leave the field's box: ``(near, far, active)``.

    A ray that starts in the box enters at 0. Components of ``d`` may be zero. A ray is not active if it misses the
    box, if it has no direction (:func:`.rays.is_direction`), or if anything is NaN.
    """
    Float = field.types.Float
    active = field.types.Bool(active) & is_direction(d)
    near, far, active = box_interval(o, d, *field.box, Float(0), Float(maxt), active)
    active &= (near <= far) & (far < dr.inf)  # false for NaN
    return near, far, active


def intersect(field, o, d, maxt, active=True, exact: bool = True) -> Hit:
    """Intersect rays ``o + t·d``, 0 ≤ t ≤ ``maxt``, ``d`` of length 1, with the surface, from either side.

    A ray that starts in the box starts with the field's sign, any other one outside of the solid. A direction shorter
    than ½ or longer than 2 hits nothing. If not ``exact``, only ``hit`` and ``leaving`` are valid, which is faster.
    """
    Float, Point = field.types.Float, field.types.Array3f
    with dr.suspend_grad():
        o, d, maxt = Point(dr.detach(o)), Point(dr.detach(d)), Float(dr.detach(maxt))
        near, far, active = enter(field, o, d, maxt, active)
        # From here on, numbers are small. Rounding must not leave a ray outside of the box
        start = Point(dr.clip(dr.fma(d, near, o), *field.box))
        # The difference of two large distances may be longer than the box: steps beyond it might never end
        _, length, _ = box_interval(start, d, *field.box, Float(0), far - near, active)
        if field.marched:
            scale = field.cells_per_unit
            origin = [(x - a) * scale for x, a in zip(start, field.box[0], strict=True)]
            hit, t, leaving = march(get_marcher(field), origin, d, length * scale, near == 0, active)
            t = t * field.cell
        else:
            hit, t, leaving = sphere_trace(field, start, d, length, near == 0, active, exact)
        # A solid that reaches the side of the box ends there
        cut = active & (far < maxt) & leaving & ~hit
        t = dr.select(cut, length, t)
        hit |= cut
        return Hit(hit, dr.select(hit, near + t, dr.inf), dr.fma(d, t, start), leaving)


@compat.syntax
def sphere_trace(field, start, d, length, fresh, active, exact: bool = True):
    """Find the first change of sign along rays from ``start``, a place in the box, up to ``length``.

    Returns ``(hit, t, leaving)``. A ``fresh`` ray starts with the sign at ``start``, any other one outside.
    """
    types = field.types
    Float, Bool = types.Float, types.Bool
    with dr.suspend_grad():
        active, hit = Bool(active), Bool(False)
        leaving = Bool(fresh) & (field.value(start, active) < 0)

        reach = RELAXATION * field.cell
        t, safe = Float(0), Float(0)
        low, high = Float(0), Float(dr.inf)  # the last place with the sign at the start, the first one with the other
        low_value, high_value = Float(0), Float(0)
        turns = types.UInt32(0)
        while dr.hint(active, label="sphere tracing"):
            value, step = field.safe_step(dr.fma(d, t, start), d, active)
            other = (value < 0) != leaving
            size = dr.abs(value)
            # Too far ahead: between the safe steps of both places, the sign may have changed twice
            back = ~other & ~hit & (t - dr.minimum(step, size / field.bound) > safe)
            hit |= other
            # Linear extrapolation to the zero
            ahead = dr.select(back | hit, 0, size * (t - low) / (dr.abs(low_value) - size))
            ahead = dr.select(ahead > 0, dr.minimum(dr.fma(ahead, 1.05, 0.1 * SHORTEST_STEP), reach), 0)
            high = dr.select(other, t, high)
            high_value = dr.select(other, value, high_value)
            low = dr.select(other | back, low, t)
            low_value = dr.select(other | back, low_value, value)
            safe = dr.select(back | other, safe, t + dr.maximum(step, SHORTEST_STEP))
            if dr.hint(exact, mode="scalar"):
                width = high - low
                done = hit & ((width < TOLERANCE) | ((size < ZERO) & (turns > 0)))
                share = dr.clip(low_value / (low_value - high_value), 0.03, 0.97)
                share = dr.select(turns < FALSE_POSITIONS, share, 0.5)
                turns = dr.select(hit, turns + 1, 0)
                following = dr.select(
                    hit, dr.fma(width, share, low), dr.select(back, safe, dr.maximum(safe, t + ahead))
                )
                t = dr.select(done, t, following)
                active &= ~done & (hit | (t <= length))
            else:
                t = dr.select(back, safe, dr.maximum(safe, t + ahead))
                active &= ~hit & (t <= length)
        return hit, t, leaving


def trace(field, o, d, maxt, active=True) -> tuple:
    """Return the distances at which rays hit the surface, infinite without a hit, and whether they do."""
    result = intersect(field, o, d, maxt, active)
    return result.t, result.hit


def occluded(field, o, d, maxt, active=True):
    """Return whether rays hit the surface before ``maxt``."""
    return intersect(field, o, d, maxt, active, exact=False).hit


def index_bytes(field) -> int:
    """Return the bytes of the field's ray-marching index; 0 if it is sphere-traced."""
    return get_marcher(field).nbytes if field.marched else 0
