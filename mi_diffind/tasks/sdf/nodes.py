"""Sparse signed distance field: nodes near the surface that hold a distance and a normal, read by indirection.

Reading a cell whose eight nodes are stored blends their linear extrapolations (§ 1.6 of the supplement describes dense
arrays only; this layout is ours):

    f(x) = Σ wᵢ (dᵢ + ½ gᵢ · (x − xᵢ))

with trilinear weights w, which is exact for quadratic functions. Everywhere else only the sign is known.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from ...arrays.lookup import mask_flags
from . import codes
from .field import DistanceField
from .structure import ACTIVE, BLOCK, Structure, first_ranks, place_of

#: Largest distance that a field returns, in spacings.
BAND = 2.0

#: Blocks whose nodes are decoded at a time.
PART = 2**10

CORNERS = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]

#: Middle of a block, relative to its first node.
MIDDLE = (BLOCK - 1) / 2


class SparseNodes(DistanceField):
    """Field of the nodes of a ``structure``, in one of two forms.

    Decoded nodes can be trained: ``nodes`` is a tensor (n, 4) of distances in spacings and gradients. Coded nodes are
    ``pointers`` (words, with ``bits`` bits each) into ``entries`` (words, with the :func:`.codes.entry_scale`
    ``offset`` and ``step``), relative to the ``frames`` of their blocks (words).
    """

    marched = True

    def __init__(self, types, structure: Structure, slope: float, *, nodes=None, frames=None, pointers=None, bits=0,
                 entries=None, offset=None, step=None):  # fmt: skip
        h = structure.spacing
        super().__init__(types, structure.lower, structure.upper, h, BAND * h)
        self.structure, self.slope = structure, float(slope)
        UInt32 = types.UInt32
        regions = structure.regions.reshape(-1).astype(np.uint32)
        active = regions == ACTIVE
        # A region with nodes: its number. Any other: the highest bit, and its sign in the lowest
        regions[~active] |= np.uint32(1 << 31)
        regions[active] = np.arange(active.sum(), dtype=np.uint32)
        self._regions = device_array(UInt32, regions)
        masks = np.concatenate([structure.region_masks, structure.region_signs], axis=1)
        self._region_masks = device_array(UInt32, masks)
        self._first_blocks = device_array(UInt32, first_ranks(structure.region_masks))
        words = structure.block_signs.astype(np.uint32) << np.uint32(24) | first_ranks(structure.block_masks)
        frame_words = np.zeros(structure.blocks, np.uint32) if frames is None else frames
        blocks = np.stack([*structure.block_masks.T, words, frame_words], axis=1)
        self._blocks = device_array(UInt32, blocks)
        self.nodes = nodes
        self.bits = bits
        self._pointers = None if pointers is None else device_array(UInt32, pointers)
        self._entries = None if entries is None else device_array(UInt32, entries)
        self._affine = None if offset is None else (tuple(map(float, offset)), tuple(map(float, step)))
        self._scale = self._affine and [dr.opaque(types.Array3f, v) for v in self._affine]
        # Opaque, like those of the base class: numbers of regions along the axes, and the last cell
        self.region_sides = dr.opaque(types.Array3u, structure.regions.shape)
        self.last_cell = dr.opaque(types.Array3i, [n - 2 for n in structure.shape])

    def _grid(self, p):
        """Return the cell of points, as whole numbers of its lowest corner, and the place within it."""
        Int32 = self.types.Int32
        cell, place = [], []
        for x, a, last in zip(p, self.box[0], self.last_cell, strict=True):
            t = (x - a) * self.cells_per_unit
            i = dr.clip(Int32(dr.floor(dr.detach(t))), 0, last)
            cell.append(i)
            place.append(t - self.types.Float(i))
        return cell, place

    def _block(self, i, j, k, active):
        """Return the number of the block of node (i, j, k), whether it has nodes, and its sign if it has none."""
        UInt32 = self.types.UInt32
        _, ny, nz = self.region_sides
        word = dr.gather(UInt32, self._regions, (UInt32(i >> 4) * ny + UInt32(j >> 4)) * nz + UInt32(k >> 4), active)
        has = active & (word < 2**31)
        masks = dr.gather(dr.uint32_array_t(self.types.Array4f), self._region_masks, word, has)
        bit = UInt32((i >> 2 & 3) * 16 + (j >> 2 & 3) * 4 + (k >> 2 & 3))
        in_mask, rank = _bit_and_rank(masks[0], masks[1], bit)
        inside = dr.select(has, _bit_and_rank(masks[2], masks[3], bit)[0], (word & 1) == 1)
        has_nodes = has & in_mask
        number = dr.gather(UInt32, self._first_blocks, word, has_nodes) + rank
        return number, has_nodes, inside

    def _record(self, number, active):
        return dr.gather(dr.uint32_array_t(self.types.Array4f), self._blocks, number, active)

    def _in_block(self, record, i, j, k):
        """Return whether node (i, j, k) of a block is stored, its number, and whether it is inside if not stored."""
        UInt32 = self.types.UInt32
        x, y, z = UInt32(i & 3), UInt32(j & 3), UInt32(k & 3)
        stored, rank = _bit_and_rank(record[0], record[1], x * 16 + y * 4 + z)
        group = (x >> 1) * 4 + (y >> 1) * 2 + (z >> 1)
        return stored, (record[2] & 0xFFFFFF) + rank, (record[2] >> (24 + group) & 1) == 1

    def _node(self, number, record, i, j, k, active):
        """Return the distance, in spacings, and the gradient of a node."""
        if self.nodes is not None:
            distance, *gradient = dr.gather(self.types.Array4f, self.nodes.array, number, active)
            return distance, gradient
        Float = self.types.Float
        pointer = codes.pointer_at(self._pointers, number, self.bits, active)
        entry = codes.entries(dr.gather(self.types.UInt32, self._entries, pointer, active), *self._scale, Float)
        n, d, scale = codes.frames(record[3], Float)
        offset = [Float(v & 3) - MIDDLE for v in (i, j, k)]
        return codes.decode_nodes(entry, n, d, scale, offset)

    def _corners(self, cell, active):
        """Return, for each corner of a cell: ``(stored, number, record, position, inside)``.

        ``inside`` is the sign of a corner that is not stored.
        """
        i, j, k = cell
        first = self._block(i, j, k, active)
        first_record = self._record(first[0], first[1])
        corners = []
        for a, b, c in CORNERS:
            at = i + a, j + b, k + c
            (_, has, inside), record = first, first_record
            if a or b or c:
                # Mostly in the block of the first corner
                other = active & (((at[0] ^ i) | (at[1] ^ j) | (at[2] ^ k)) >> 2 != 0)
                number_, has_, inside_ = self._block(*at, other)
                record_ = self._record(number_, has_)
                has, inside = dr.select(other, has_, has), dr.select(other, inside_, inside)
                record = [dr.select(other, p, q) for p, q in zip(record_, record, strict=True)]
            stored, number, sign = self._in_block(record, *at)
            corners.append((has & stored, number, record, at, dr.select(has, sign, inside)))
        return corners

    def _blend(self, p, active, derivatives: bool):
        """Blend the corners of a cell: ``(value, gradient, smooth normal, complete, some, inside)``.

        The value is in spacings; the gradient is computed if ``derivatives``. ``complete``: all corners are stored;
        ``some``: at least one is; ``inside``: corners that are not stored lie inside.
        """
        Float = self.types.Float
        cell, place = self._grid(p)
        corners = self._corners(cell, active)
        # Where a corner is not stored, the signs of all are the same, and its sign is known exactly: signs of nodes may
        # have been lost in training or by rounding
        complete, inside = active, dr.mask_t(Float)(False)
        for stored, *_, sign in corners:
            complete, inside = complete & stored, inside | (sign & ~stored)
        value, weight_sum = Float(0), Float(0)
        slope, mean, weighted = [Float(0)] * 3, [Float(0)] * 3, []
        for (a, b, c), (stored, number, record, at, _) in zip(CORNERS, corners, strict=True):
            d, g = self._node(number, record, *at, active & stored)
            ends = [(t if e else 1 - t) for e, t in zip((a, b, c), place, strict=True)]
            offset = [t - e for e, t in zip((a, b, c), place, strict=True)]
            towards = g[0] * offset[0] + g[1] * offset[1] + g[2] * offset[2]
            # Where a corner is missing, the others are extrapolated in full
            part = dr.fma(dr.select(complete, 0.5, 1.0), towards, d)
            w = dr.select(stored & active, ends[0] * ends[1] * ends[2], 0)
            value, weight_sum = dr.fma(w, part, value), weight_sum + w
            mean = [dr.fma(w, x, s) for x, s in zip(g, mean, strict=True)]
            weighted.append((w, g))
            if derivatives:
                part = dr.select(stored & active, part, 0)
                for axis, e in enumerate((a, b, c)):
                    others = [ends[o] for o in range(3) if o != axis]
                    change = others[0] * others[1] * (1 if e else -1)
                    slope[axis] = dr.fma(change, part, slope[axis])
                    slope[axis] = dr.fma(w * dr.select(complete, 0.5, 1.0), g[axis], slope[axis])
        some = weight_sum > 0
        whole = dr.select(complete, 1, dr.rcp(dr.select(some, weight_sum, 1)))
        value, mean = value * whole, [s * whole for s in mean]
        if not derivatives:
            return value, slope, mean, complete, some, inside
        slope = [dr.select(complete, s, m) for s, m in zip(slope, mean, strict=True)]
        # In a thin wall, some nodes hold the normal of its other side: they count less the further they turn away
        smooth = [Float(0)] * 3
        for w, g in weighted:
            w = w * dr.maximum(g[0] * slope[0] + g[1] * slope[1] + g[2] * slope[2], 0)
            smooth = [dr.fma(w, x, s) for x, s in zip(g, smooth, strict=True)]
        return value, slope, smooth, complete, some, inside

    def blend(self, p):
        """Return what training needs at ``p``: ``(value in spacings, gradient, smooth normal, complete)``.

        Gradient and normal are three arrays each; ``complete``: all nodes of the cell are stored.
        """
        value, slope, smooth, complete, *_ = self._blend(p, self.inside(p), True)
        return value, slope, smooth, complete

    def value(self, p, active=True):
        return self._evaluate(p, active, False)[0]

    def gradient(self, p, active=True):
        value, slope, _ = self._evaluate(p, active, True)
        return value, slope

    def normal(self, p, active=True):
        return self._evaluate(p, active, True)[2]

    def normals(self, p, active=True):
        return self._evaluate(p, active, True)[1:]

    def _evaluate(self, p, active, derivatives: bool):
        """Return the truncated value, the gradient and the smooth normal, in the unit frame."""
        active = self.inside(p) & active
        value, slope, smooth, complete, some, inside = self._blend(p, active, derivatives)
        sign = dr.select(inside, -1.0, 1.0)
        # In a cell that no surface crosses the sign is that of its corners, whatever their extrapolation gives
        short = dr.select(some, dr.minimum(dr.maximum(sign * value, 1e-3), BAND), BAND)
        value = dr.select(complete, dr.minimum(dr.maximum(value, -BAND), BAND), sign * short) * self.cell

        def vector(v):
            return self.types.Array3f(*(dr.select(active & some, x, 0) for x in v))

        return dr.select(active, value, self.largest), vector(slope), vector(smooth)

    def frames(self) -> np.ndarray:
        """Return the words of the blocks' frames, ``(B,)``."""
        return np.array(self._blocks).reshape(-1, 4)[:, 3]

    def decoded(self) -> np.ndarray | None:
        """Return distances in spacings and gradients of coded nodes, ``(n, 4)``; ``None`` for decoded ones."""
        if self._entries is None:
            return None
        pointers = codes.pointers_of(np.array(self._pointers), self.bits, self.structure.nodes)
        entries = np.stack(codes.entries(np.array(self._entries), *self._affine), axis=1)
        return decoded_nodes(self.structure, self.frames(), entries, pointers)

    @property
    def nbytes(self) -> int:
        """Bytes in memory of everything that a read needs."""
        total = self.structure.nbytes
        if self.nodes is not None:
            return total + 16 * self.structure.nodes
        return total + 4 * (self.structure.blocks + dr.width(self._pointers) + dr.width(self._entries))


def coded_field(types, structure: Structure, slope: float, frames, pointers, bits: int, entries) -> SparseNodes:
    """Return a field whose nodes are ``pointers`` (words) into ``entries`` (K, 3), float32."""
    offset, step = codes.entry_scale(entries)
    return SparseNodes(
        types, structure, slope, frames=frames, pointers=pointers, bits=bits,
        entries=codes.entry_words(entries, offset, step), offset=offset, step=step,
    )  # fmt: skip


def _bit_and_rank(low, high, bit):
    """Return whether a bit of a 64-bit mask, given as two words, is set, and how many bits below it are."""
    upper = bit >= 32
    word = dr.select(upper, high, low)
    rank = dr.popcnt(word & ((type(low)(1) << (bit & 31)) - 1)) + dr.select(upper, dr.popcnt(low), 0)
    return (word >> (bit & 31) & 1) == 1, rank


def slope_bound(values: np.ndarray, gradients: np.ndarray, corners: np.ndarray, part: int = 2**17) -> float:
    """Return a bound Λ of |∇f| in all cells: values (n,) in spacings, gradients (n, 3), corners (K, 8), z fastest.

    The derivatives lie between their own Bernstein coefficients, which are twice the differences of those of f.
    """
    nodes, worst = np.concatenate([values[:, None], gradients], axis=1), 0.0
    for first in range(0, len(corners), part):
        total = bernstein(nodes[corners[first : first + part]]).reshape(-1, 3, 3, 3)
        square = 0.0
        for axis in range(3):
            square = square + np.abs(2 * np.diff(total, axis=1 + axis)).max(axis=(1, 2, 3)) ** 2
        worst = max(worst, float(np.sqrt(square.max(initial=0.0))))
    return max(1.0, worst)


def _bernstein() -> np.ndarray:
    """Return the matrix ``(32, 27)`` that :func:`bernstein` multiplies with."""
    ends, bump = np.array([[1, 0.5, 0], [0, 0.5, 1]]), np.array([[0, 0.5, 0], [0, -0.5, 0]])
    rows = []
    for corner in CORNERS:
        rows.append(np.einsum("x,y,z->xyz", *(ends[e] for e in corner)))
        for axis in range(3):
            # w·(t − e) is t(1 − t) for e = 0 and its negative for e = 1: coefficients 0, ± ½, 0
            curves = [(bump if other == axis else ends)[e] for other, e in enumerate(corner)]
            rows.append(0.5 * np.einsum("x,y,z->xyz", *curves))
    return np.array(rows).reshape(32, 27)


_BERNSTEIN = _bernstein()


def bernstein(nodes: np.ndarray) -> np.ndarray:
    """Return the Bernstein coefficients of cells, ``(K, 27)``, z fastest; values of f lie between them.

    In a cell f is a polynomial of degree 2 along each axis. ``nodes`` are value in spacings and gradient at the eight
    corners, ``(K, 8, 4)``.
    """
    return nodes.reshape(-1, 32) @ _BERNSTEIN


def middles(positions: np.ndarray) -> np.ndarray:
    """Return the offsets of nodes at positions (n, 3) from the middle of their block, in spacings."""
    return positions % BLOCK - MIDDLE


def decoded_nodes(
    structure: Structure, frames: np.ndarray, entries: np.ndarray, pointers: np.ndarray | None = None
) -> np.ndarray:
    """Decode nodes: distances in spacings and normals, (n, 4) float32, from the frames (B,) of their blocks.

    ``entries`` are those of the nodes (n, 3) or, with ``pointers`` (n,), those that the pointers name.
    """
    result, first = np.empty((structure.nodes, 4), np.float32), 0
    for part in range(0, structure.blocks, PART):
        block, bit = np.nonzero(mask_flags(structure.block_masks[part : part + PART]))
        rows = slice(first, first + len(block))
        n, d, scale = (
            [v[block] for v in value] if isinstance(value, tuple) else value[block]
            for value in codes.frames(frames[part : part + PART])
        )
        entry = entries[rows] if pointers is None else entries[pointers[rows]]
        distance, normal = codes.decode_nodes(entry.astype(np.float64).T, n, d, scale, middles(place_of(bit)).T)
        result[rows] = np.stack([distance, *normal], axis=1)
        first = rows.stop
    return result
