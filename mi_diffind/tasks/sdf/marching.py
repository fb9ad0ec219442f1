"""
Rays through a sparse grid (:class:`.nodes.SparseNodes`), from cell to cell.

A ray goes from one empty region, block or cell to the next, as bit masks say; only in the cells that the surface
crosses is anything read, all corners at once, and evaluated at :data:`SAMPLES` places along the ray. What a cell of the
spacing h is missed by that enters and leaves the solid between two places, no more than h·√3 / :data:`SAMPLES` apart.

Lengths are in spacings here, as the structure's.
"""

from __future__ import annotations

import drjit as dr
import numpy as np
from scipy.ndimage import distance_transform_cdt

from .nodes import CORNERS
from .structure import ACTIVE, BLOCK, _bits, _words

#: Places along the ray at which a cell is looked at, and steps by false position from there.
SAMPLES, ROOTS = 3, 3

#: How far a ray goes beyond the side of a cell, so that it is in the next one.
HAIR = 1e-3

#: A word of a block without crossed cells: this, the sign, and how far the next one that has some is, in blocks.
EMPTY, INSIDE = 1 << 31, 1 << 30

#: Components of a direction below this count as zero.
TINY = 1e-12

#: Eight blocks: the one of a cell's lowest corner, and those that its others may lie in.
NEIGHBOURS = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]


class Marcher:
    """
    What is made of a field's masks, once: how many regions around an empty one are empty, and their sign; for each
    block of the others its number, or the same; for each block with crossed cells, which these are, the signs of the
    others, and the numbers of the blocks beside it.
    """

    def __init__(self, field):
        self.field = field
        structure, UInt32 = field.structure, field.types.UInt32
        crossed, inside, beside, empty = cells_of(structure)
        regions, blocks = words_of(structure, crossed, inside, empty)
        words = np.concatenate([_words(crossed), _words(inside)], axis=1)
        self.cells, self.beside, self.regions, self.words = (
            UInt32(np.ascontiguousarray(v, np.uint32).reshape(-1)) for v in (words, beside, regions, blocks)
        )

    @property
    def nbytes(self) -> int:
        """Bytes of it."""
        return 4 * sum(map(dr.width, (self.regions, self.words, self.cells, self.beside)))

    # -- where a ray is -----------------------------------------------------------------------------------------------

    def locate(self, course, t, active):
        """
        Of the cell at ``t`` of a ray: whether it is crossed; the number of its block; where the ray leaves it, or what
        is empty around it; its sign (of no meaning if it is crossed).
        """
        i, j, k = cell = course.cell(t)
        types = self.field.types
        UInt32, Int32 = types.UInt32, types.Int32
        _, ny, nz = self.field.structure.regions.shape
        region = dr.gather(UInt32, self.regions, UInt32(((i >> 4) * ny + (j >> 4)) * nz + (k >> 4)), active)
        wide = region >= EMPTY
        place = UInt32((i >> 2 & 3) * 16 + (j >> 2 & 3) * 4 + (k >> 2 & 3))
        word = dr.gather(UInt32, self.words, region * 64 + place, active & ~wide)
        word = dr.select(wide, region, word)
        empty = word >= EMPTY
        low, high, low_sign, high_sign = dr.gather(types.Array4u, self.cells, word, active & ~empty)
        x, y, z = UInt32(i & 3), UInt32(j & 3), UInt32(k & 3)
        upper = x >= 2
        half, signs = dr.select(upper, high, low), dr.select(upper, high_sign, low_sign)
        bit = (x & 1) * 16 + y * 4 + z
        crossed = active & ~empty & (((half >> bit) & 1) == 1)
        # The cell and its seven neighbours in a cube of 2 × 2 × 2 are bits of one word
        alone = (half & (UInt32(0x330033) << ((y & 2) * 4 + (z & 2)))) == 0
        shift = dr.select(wide, Int32(4), dr.select(empty, 2, dr.select(alone, 1, 0)))
        reach = dr.select(empty, Int32(word & 0xFFFF), 1)
        sign = dr.select(empty, (word & INSIDE) != 0, ((signs >> bit) & 1) == 1)
        return crossed, word, dr.maximum(course.end(cell, shift, reach), t), sign

    def corners(self, number, i, j, k, active):
        """Distance and gradient, in spacings, of the eight nodes of a crossed cell, in the order of ``CORNERS``."""
        field, UInt32 = self.field, self.field.types.UInt32
        found = []
        far = [dr.select((v & 3) == 3, UInt32(m), 0) for v, m in zip((i, j, k), (4, 2, 1), strict=True)]
        for a, b, c in CORNERS:
            x, y, z = i + a, j + b, k + c
            n = number * 8
            for e, m in zip((a, b, c), far, strict=True):
                n = n + m if e else n
            own = number if not (a or b or c) else dr.gather(UInt32, self.beside, n, active)
            record = field._record(own, active)
            _, node, _ = field._in_block(record, x, y, z)
            found.append(field._node(node, record, x, y, z, active))
        return found


def of(field) -> Marcher:
    """That of a field, made once."""
    if "_marcher" not in vars(field):
        field._marcher = Marcher(field)
    return field._marcher


def blend(corners, place):
    """The field's value in spacings at ``place`` in a cell, 0 to 1 along each axis, from its corners."""
    x, y, z = place
    # One axis after the other: what corners say of the place, blended along z, y and x
    said = []
    for (a, b, c), (d, g) in zip(CORNERS, corners, strict=True):
        said.append(d + 0.5 * (g[0] * (x - a) + g[1] * (y - b) + g[2] * (z - c)))
    for t in (z, y, x):
        said = [dr.fma(t, q - p, p) for p, q in zip(said[::2], said[1::2], strict=True)]
    return said[0]


def cross(marcher, course, low, end, number, leaving, fresh):
    """
    Whether, and where, the sign changes in a crossed cell between ``low`` and ``end`` along the ray; and what it was at
    the start. ``(found, t, leaving)``.
    """
    cell = course.cell(low)
    corners = marcher.corners(number, *cell, True)
    to = [x - course.types.Float(c) for x, c in zip(course.o, cell, strict=True)]

    def value(t):
        return blend(corners, [dr.fma(v, t, x) for x, v in zip(to, course.d, strict=True)])

    step = (end - low) * (1 / SAMPLES)
    start, high = low, low
    a = b = value(low)
    leaving = dr.select(fresh, a < 0, leaving)
    found = (a < 0) != leaving
    for n in range(SAMPLES):
        t = dr.fma(step, n + 1, start)
        v = value(t)
        other = (v < 0) != leaving
        high, b = dr.select(other & ~found, t, high), dr.select(other & ~found, v, b)
        found |= other
        low, a = dr.select(found, low, t), dr.select(found, a, v)
    for _ in range(ROOTS):
        t = dr.fma(high - low, _share(a, b), low)
        v = value(t)
        other = (v < 0) != leaving
        low, a = dr.select(other, low, t), dr.select(other, a, v)
        high, b = dr.select(other, t, high), dr.select(other, v, b)
    return found, dr.fma(high - low, _share(a, b), low), leaving


def _share(a, b):
    """Where between two places with the values a and b of different signs the value is zero; 0 if they are equal."""
    return dr.select(a == b, 0, dr.clip(a / (a - b), 0.02, 0.98))


class Course:
    """A ray ``o + t·d`` in a grid, and what of it does not change."""

    def __init__(self, field, o, d):
        self.types, self.last = field.types, [n - 2 for n in field.structure.shape]
        self.o, self.d = list(o), list(d)
        still = [dr.abs(v) < TINY for v in d]
        self.inverse = [dr.rcp(dr.select(s, TINY, v)) for s, v in zip(still, d, strict=True)]
        self.up = [(v > 0) | s for s, v in zip(still, d, strict=True)]

    def cell(self, t):
        """The cell of the place ``t``."""
        return [
            dr.clip(self.types.Int32(dr.floor(dr.fma(v, t, x))), 0, n)
            for x, v, n in zip(self.o, self.d, self.last, strict=True)
        ]

    def end(self, cell, shift, reach):
        """Where it leaves the cubes of 2^shift cells around a cell, fewer than ``reach`` in each direction."""
        sides = [
            (self.types.Float(((c >> shift) + dr.select(e, reach, 1 - reach)) << shift) - x) * r
            for x, c, e, r in zip(self.o, cell, self.up, self.inverse, strict=True)
        ]
        return dr.minimum(dr.minimum(sides[0], sides[1]), sides[2])


@dr.syntax
def march(marcher, o, d, length, fresh, active):
    """
    Rays ``o + t·d`` from within the grid, ``d`` of length 1, ``o`` and ``t`` in spacings from its lower corner:
    ``(found, t, leaving)`` of the first change of sign before ``length``. A ray that is ``fresh`` starts with the sign
    that it finds; others start outside.
    """
    types = marcher.field.types
    course = Course(marcher.field, o, d)
    t, found, leaving = types.Float(0), types.Bool(False), types.Bool(False)
    fresh, active = types.Bool(fresh), types.Bool(active)
    while dr.hint(active, label="cells that are crossed"):
        # All rays of a packet go on until each has found one: reading it is what costs
        seeking, number, end = types.Bool(active), types.UInt32(0), t
        while dr.hint(seeking, label="cells that are not"):
            crossed, word, following, sign = marcher.locate(course, t, seeking)
            leaving = dr.select(fresh & seeking & ~crossed, sign, leaving)
            fresh &= crossed | ~seeking
            jumped = seeking & ~crossed & (sign != leaving)
            number, end = dr.select(crossed, word, number), dr.select(crossed, following, end)
            found |= jumped
            seeking &= ~crossed & ~jumped
            t = dr.select(seeking, following + HAIR, t)
            active &= ~jumped & (t < length)
            seeking &= active
        hit, place, leaving = dr.if_stmt(
            (t, end, number, leaving, fresh),
            active,
            lambda t, end, number, leaving, fresh: cross(marcher, course, t, end, number, leaving, fresh),
            lambda t, end, number, leaving, fresh: (types.Bool(False), t, leaving),
        )
        hit &= active
        found |= hit
        fresh &= ~active
        t = dr.select(hit, place, dr.select(active, end + HAIR, t))
        active &= ~hit & (t < length)
    return found & (t <= length), t, leaving


def cells_of(structure) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    For each block with nodes: whether each of its 64 cells is crossed, that is, all its corners are stored; whether the
    others are inside, ``(B, 64)``; and the blocks that their corners lie in, ``(B, 8)``, the block itself where there
    is none. And the signs of blocks without nodes, at their places in the grid.
    """
    at = structure.block_positions() // BLOCK
    number = np.full([n // BLOCK + 1 for n in structure.shape], -1)
    number[tuple(at.T)] = np.arange(len(at))
    beside = np.stack([number[tuple((at + n).T)] for n in NEIGHBOURS], axis=1)

    # The signs of blocks without nodes, beyond the grid outside
    empty = np.zeros(number.shape, bool)
    coarse = (structure.regions & 1).astype(bool)
    for x, y, z in np.ndindex(4, 4, 4):
        part = coarse.copy()
        part[structure.regions == ACTIVE] = _bits(structure.region_signs)[:, x * 16 + y * 4 + z]
        empty[x : x + 4 * coarse.shape[0] : 4, y : y + 4 * coarse.shape[1] : 4, z : z + 4 * coarse.shape[2] : 4][
            : coarse.shape[0], : coarse.shape[1], : coarse.shape[2]
        ] = part

    nodes = np.concatenate([_bits(structure.block_masks).reshape(-1, 4, 4, 4), np.zeros((1, 4, 4, 4), bool)])
    groups = (structure.block_signs[:, None] >> np.arange(8) & 1).astype(bool).reshape(-1, 2, 2, 2)
    signs = groups.repeat(2, 1).repeat(2, 2).repeat(2, 3)
    stored, inside = np.zeros((2, len(at), 5, 5, 5), bool)
    for which, n in enumerate(NEIGHBOURS):
        to = (slice(None), *(slice(4 * e, 4 + e) for e in n))
        of = (slice(None), *(slice(0, 1 if e else 4) for e in n))
        there = beside[:, which]
        stored[to] = nodes[there][of]
        known = np.where(there[:, None, None, None] >= 0, signs[there], empty[tuple((at + n).T)][:, None, None, None])
        inside[to] = known[of]
    crossed, within = np.ones((len(at), 4, 4, 4), bool), np.zeros((len(at), 4, 4, 4), bool)
    for a, b, c in CORNERS:
        corner = (slice(None), slice(a, a + 4), slice(b, b + 4), slice(c, c + 4))
        crossed &= stored[corner]
        within |= ~stored[corner] & inside[corner]
    beside = np.where(beside < 0, np.arange(len(at))[:, None], beside)
    return crossed.reshape(-1, 64), within.reshape(-1, 64), beside, empty[:-1, :-1, :-1]


def words_of(structure, crossed, inside, empty) -> tuple[np.ndarray, np.ndarray]:
    """
    For each region the number of its blocks' words, or what is said of empty ones (:data:`EMPTY`), uint32; for each
    block of those that are not empty, ``(R, 64)``, its number, or the same.
    """
    number, full = np.zeros(empty.shape, np.uint32), np.zeros(empty.shape, bool)
    at = tuple((structure.block_positions() // BLOCK).T)
    full[at] = crossed.any(axis=1)
    number[at] = np.arange(len(crossed))
    sign = empty.copy()
    sign[at] = inside[:, 0]  # where no cell is crossed, all have the same
    shape = structure.regions.shape

    def parts(v):
        return v.reshape(np.stack([shape, (4, 4, 4)], 1).ravel()).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 64)

    blocks = parts(np.where(full, number, _free(full, sign)).astype(np.uint32))
    some = parts(full).any(axis=1)
    regions = _free(some.reshape(shape), parts(sign)[:, 0].reshape(shape)).ravel()
    regions[some] = np.arange(some.sum())
    return regions.astype(np.uint32), blocks[some]


def _free(full: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """What is said of empty parts of a grid, of which ``full`` ones are not."""
    far = distance_transform_cdt(~full, "chessboard") if full.any() else np.full(full.shape, max(full.shape))
    return np.int64(EMPTY) | np.where(sign, INSIDE, 0) | far
