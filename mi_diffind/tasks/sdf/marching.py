"""
Rays through a sparse grid (:class:`.nodes.SparseNodes`), from cell to cell.

A ray goes from one empty region or block to the next, as words say that are made of the masks (:mod:`.index`). In a
block with crossed cells it goes to where the block's *slab* begins: between two planes, parallel to the one of its
frame, beyond which the sign is known. There it goes from cell to cell; only in those that the surface may cross is
anything read, all corners at once, and evaluated at :data:`SAMPLES` places along the ray. What enters and leaves the
solid between two places in a cell of the spacing h, no more than h·√3 / :data:`SAMPLES` apart, may be missed.

Nodes that are trained may move the surface anywhere in their cells: there are no slabs then. Lengths are in spacings
here, as the structure's.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from ...bits import mask_words
from . import codes
from .index import EMPTY, INSIDE, MIDDLE, SLAB, STEPS, cells_of, slabs_of, words_of
from .nodes import CORNERS

#: Places along the ray at which a cell is looked at, and steps by false position from there.
SAMPLES, ROOTS = 3, 3

#: How far a ray goes beyond the side of a cell, so that it is in the next one.
HAIR = 1e-3

#: Components of a direction below this count as zero.
TINY = 1e-12

#: The least rise of a ray above a plane, per spacing: less would be out of whole numbers' range, more beyond a slab's
#: margin in the longest grid.
LEVEL = 1e-7


class Marcher:
    """
    What rays go by, in memory: for each region, and each block of those with nodes, a word that says how many around it
    are empty and their sign, or its number; for each block with crossed cells, which these are, the signs of the
    others, the numbers of the blocks beside it, and its plane and slab.
    """

    def __init__(self, field):
        self.field = field
        structure, UInt32 = field.structure, field.types.UInt32
        crossed, inside, beside, empty, node = cells_of(structure)
        regions, blocks = words_of(structure, crossed, inside, empty)
        words = np.concatenate([mask_words(crossed), mask_words(inside)], axis=1)
        self.cells, self.beside, self.regions, self.words = (
            UInt32(np.ascontiguousarray(v, np.uint32).reshape(-1)) for v in (words, beside, regions, blocks)
        )
        self.slabs, nodes = None, field.decoded()
        if nodes is not None:
            frames = field.frames()
            slabs = np.stack([frames, slabs_of(crossed, inside, node, nodes, frames)], axis=1)
            self.slabs = UInt32(slabs.reshape(-1))

    @property
    def nbytes(self) -> int:
        """Bytes of it."""
        made = [self.regions, self.words, self.cells, self.beside, *([] if self.slabs is None else [self.slabs])]
        return 4 * sum(map(dr.width, made))

    # -- where a ray is -----------------------------------------------------------------------------------------------

    def block(self, course, t, active):
        """
        Of the block at ``t`` of a ray: whether cells of it are crossed; its number if so; where the ray leaves what is
        empty around it; whether that is inside.
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
        end = course.end(cell, dr.select(wide, Int32(4), 2), Int32(word & 0xFFFF))
        return active & (word < EMPTY), word, dr.maximum(end, t), (word & INSIDE) != 0

    def cell(self, course, t, number, active):
        """
        From the place ``t`` of a ray, in the block with this number: whether there is a crossed cell before the ray
        leaves the block; where that begins; where the ray leaves it, or what is not crossed; whether the sign at ``t``
        is known, and whether it is inside.
        """
        types = self.field.types
        UInt32, Int32, Float, Bool = types.UInt32, types.Int32, types.Float, types.Bool
        cell, start, last = course.cell(t), t, Float(dr.inf)
        off, below, within = Bool(False), Bool(False), active
        if self.slabs is not None:
            first, last, below = self.slab(course, t, number, cell, active)
            off, start = (t < first) | (t > last), dr.maximum(t, first)
            # Not if that is behind, or not in this block
            there, out = course.cell(start), Int32(0)
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
        end = dr.maximum(course.end(cell, shift, 1), start)
        end = dr.select(crossed, dr.maximum(dr.minimum(end, last), start), end)
        return crossed, start, end, off | ~crossed, dr.select(off, below, ((signs >> bit) & 1) == 1)

    def slab(self, course, t, number, cell, active):
        """
        Where a ray enters and leaves the slab of the block with this number, which holds ``cell``, and whether it is
        below the slab at ``t``.
        """
        Float = self.field.types.Float
        frame, word = dr.gather(self.field.types.Array2u, self.slabs, number, active)
        n, d, _ = codes.frames(frame, self.field.types)
        low, high = (dr.fma(Float(v), 2 * SLAB / STEPS, -SLAB) for v in (word & 0xFFFF, word >> 16))
        # The height above the plane is at + slope t
        at, slope = d, Float(0)
        for v, x, o, e in zip(n, cell, course.o, course.d, strict=True):
            at, slope = dr.fma(v, o - Float(x & ~3) - MIDDLE, at), dr.fma(v, e, slope)
        slope = dr.select(dr.abs(slope) < LEVEL, LEVEL, slope)
        inverse = dr.rcp(slope)
        one, other = (low - at) * inverse, (high - at) * inverse
        first, last = dr.minimum(one, other), dr.maximum(one, other)
        return first, last, (t < first) == (slope > 0)

    def corners(self, number, cell, active=True):
        """Distance and gradient, in spacings, of the eight nodes of a crossed cell, in the order of ``CORNERS``."""
        field, Words = self.field, dr.uint32_array_t(self.field.types.Array4f)
        owners = [w for n in (0, 1) for w in dr.gather(Words, self.beside, number * 2 + n, active)]
        # Which of the blocks beside it a corner lies in, axis by axis
        for v, m in zip(cell, (4, 2, 1), strict=True):
            last = (v & 3) == 3
            owners = [dr.select(last, w, owners[n - m]) if n & m else w for n, w in enumerate(owners)]
        found = []
        for own, corner in zip(owners, CORNERS, strict=True):
            at = [v + e for v, e in zip(cell, corner, strict=True)]
            record = field._record(own, active)
            _, node, _ = field._in_block(record, *at)
            found.append(field._node(node, record, *at, active))
        return found


def of(field) -> Marcher:
    """That of a field, made once."""
    if "_marcher" not in vars(field):
        field._marcher = Marcher(field)
    return field._marcher


def along(corners, start, d):
    """
    The field's value, in spacings, on the ray ``start + t·d`` through a cell, 0 to 1 along each axis, as a function of
    ``t``: what each corner says is linear in t, and blended along z, y and x.
    """
    said = []
    for corner, (distance, g) in zip(CORNERS, corners, strict=True):
        offset = [x - e for x, e in zip(start, corner, strict=True)]
        there = dr.fma(g[0], offset[0], dr.fma(g[1], offset[1], g[2] * offset[2]))
        change = dr.fma(g[0], d[0], dr.fma(g[1], d[1], g[2] * d[2]))
        said.append((dr.fma(0.5, there, distance), 0.5 * change))

    def value(t):
        values = [dr.fma(change, t, there) for there, change in said]
        for axis in (2, 1, 0):
            w = dr.fma(d[axis], t, start[axis])
            values = [dr.fma(w, q - p, p) for p, q in zip(values[::2], values[1::2], strict=True)]
        return values[0]

    return value


def cross(marcher, course, low, end, number, leaving, fresh):
    """
    Whether, and where, the sign changes in a crossed cell between ``low`` and ``end`` along the ray; and what it was at
    the start. ``(found, t, leaving)``.
    """
    cell = course.cell(low)
    start = [x - course.types.Float(c) for x, c in zip(course.o, cell, strict=True)]
    value = along(marcher.corners(number, cell), start, course.d)

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
        while dr.hint(seeking, label="blocks with cells that are"):
            far = types.Bool(seeking)
            while dr.hint(far, label="blocks without"):
                some, word, following, sign = marcher.block(course, t, far)
                empty = far & ~some
                number = dr.select(some, word, number)
                leaving = dr.select(empty & fresh, sign, leaving)
                fresh &= ~empty
                jumped = empty & (sign != leaving)
                found |= jumped
                t = dr.select(empty & ~jumped, following + HAIR, t)
                active &= ~jumped & (t < length)
                far &= ~some & active
            seeking &= active
            crossed, start, following, known, sign = marcher.cell(course, t, number, seeking)
            known &= seeking
            leaving = dr.select(fresh & known, sign, leaving)
            fresh &= ~known
            jumped = known & (sign != leaving)
            crossed &= ~jumped
            end = dr.select(crossed, following, end)
            found |= jumped
            t = dr.select(seeking & ~jumped, dr.select(crossed, start, following + HAIR), t)
            active &= ~jumped & (t < length)
            seeking &= ~crossed & active
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
