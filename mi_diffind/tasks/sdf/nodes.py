"""
The sparse signed distance field: nodes near the surface that hold a distance and a normal, by indirection.

Reading a cell whose eight nodes are stored blends what each of them says of the place (§ 1.6 of the supplement knows
dense arrays only; this is ours):

    f(x) = Σ wᵢ (dᵢ + ½ gᵢ · (x − xᵢ))

with trilinear weights w, which is exact for quadratic functions. Everywhere else the sign is known.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from . import codes
from .field import DistanceField
from .structure import ACTIVE, BLOCK, Structure

#: Spacings up to which values are told.
BAND = 2.0

CORNERS = [(a, b, c) for a in (0, 1) for b in (0, 1) for c in (0, 1)]


class SparseNodes(DistanceField):
    """
    The field of a ``structure``, whose nodes are either decoded, ``nodes``, a tensor of shape (n, 4) of distances in
    spacings and gradients, which can be trained; or held as ``pointers`` (words, with ``bits`` bits each) into
    ``entries`` (words), relative to the ``frames`` of their blocks (words), as :mod:`.codes` says.
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
        # Regions with nodes by their number, others by the highest bit, then twice the bound plus the sign
        regions[~active] |= np.uint32(1 << 31)
        regions[active] = np.arange(active.sum(), dtype=np.uint32)
        self._regions = UInt32(regions)
        masks = np.concatenate([structure.region_masks, structure.region_signs], axis=1)
        self._region_masks = UInt32(masks.reshape(-1).astype(np.uint32))
        self._first_blocks = UInt32(structure.first_blocks)
        words = structure.block_signs.astype(np.uint32) << np.uint32(24) | structure.first_nodes
        frame_words = np.zeros(structure.blocks, np.uint32) if frames is None else frames
        blocks = np.stack([*structure.block_masks.T, words, frame_words], axis=1)
        self._blocks = UInt32(np.ascontiguousarray(blocks.reshape(-1).astype(np.uint32)))
        self.nodes = nodes
        self.bits = bits
        self._pointers = None if pointers is None else UInt32(pointers)
        self._entries = None if entries is None else UInt32(entries)
        self._affine = None if offset is None else (tuple(map(float, offset)), tuple(map(float, step)))

    # -- where nodes are ----------------------------------------------------------------------------------------------

    def _grid(self, p):
        """The cell of points, whole numbers of its lowest corner, and the place in it."""
        Int32 = self.types.Int32
        cell, place = [], []
        for x, a, n in zip(p, self.structure.lower, self.structure.shape, strict=True):
            t = (x - a) / self.spacing
            i = dr.clip(Int32(dr.floor(dr.detach(t))), 0, n - 2)
            cell.append(i)
            place.append(t - self.types.Float(i))
        return cell, place

    def _block(self, i, j, k, active):
        """Of the block that holds node (i, j, k): its number, whether it has nodes, and whether it is inside if not."""
        UInt32 = self.types.UInt32
        _, ny, nz = self.structure.regions.shape
        word = dr.gather(UInt32, self._regions, UInt32(((i >> 4) * ny + (j >> 4)) * nz + (k >> 4)), active)
        has = active & (word < 2**31)
        masks = dr.gather(dr.uint32_array_t(self.types.Array4f), self._region_masks, word, has)
        bit = UInt32((i >> 2 & 3) * 16 + (j >> 2 & 3) * 4 + (k >> 2 & 3))
        in_mask, rank = _bit_and_rank(masks[0], masks[1], bit)
        inside = dr.select(has, _bit(masks[2], masks[3], bit), (word & 1) == 1)
        has_nodes = has & in_mask
        number = dr.gather(UInt32, self._first_blocks, word, has_nodes) + rank
        return number, has_nodes, inside

    def _record(self, number, active):
        return dr.gather(dr.uint32_array_t(self.types.Array4f), self._blocks, number, active)

    def _in_block(self, record, i, j, k):
        """Whether node (i, j, k) of the block with this record is stored, its number, and if not, whether inside."""
        UInt32 = self.types.UInt32
        x, y, z = UInt32(i & 3), UInt32(j & 3), UInt32(k & 3)
        stored, rank = _bit_and_rank(record[0], record[1], x * 16 + y * 4 + z)
        group = (x >> 1) * 4 + (y >> 1) * 2 + (z >> 1)
        return stored, (record[2] & 0xFFFFFF) + rank, (record[2] >> (24 + group) & 1) == 1

    # -- what they say ------------------------------------------------------------------------------------------------

    def _node(self, number, record, i, j, k, active):
        """The distance, in spacings, and the gradient of a node."""
        if self.nodes is not None:
            return _split(dr.gather(self.types.Array4f, self.nodes.array, number, active))
        pointer = codes.pointer_at(self._pointers, number, self.bits, active)
        entry = codes.entries_of(
            dr.gather(self.types.UInt32, self._entries, pointer, active), *self._affine, self.types
        )
        n, d, scale = codes.frames(record[3], self.types)
        middle = (BLOCK - 1) / 2
        offset = [self.types.Float(v & 3) - middle for v in (i, j, k)]
        return codes.decoded(entry, n, d, scale, offset)

    def _corners(self, cell, active):
        """For each corner of a cell: whether it is stored and inside, and a function that reads it."""
        i, j, k = cell
        first = self._block(i, j, k, active)
        record = self._record(first[0], first[1])
        found = []
        for a, b, c in CORNERS:
            at = i + a, j + b, k + c
            number, has, inside, own = first[0], first[1], first[2], record
            if a or b or c:
                # In the block of the first corner, mostly
                other = active & (((at[0] ^ i) | (at[1] ^ j) | (at[2] ^ k)) >> 2 != 0)
                number_, has_, inside_ = self._block(*at, other)
                own_ = self._record(number_, has_)
                has, inside = dr.select(other, has_, has), dr.select(other, inside_, inside)
                own = [dr.select(other, p, q) for p, q in zip(own_, record, strict=True)]
            stored, number, sign = self._in_block(own, *at)
            found.append((has & stored, number, own, at, dr.select(has, sign, inside)))
        return found

    def _blend(self, p, active, derivatives: bool):
        """
        The value in spacings, its gradient (if ``derivatives``), the smooth normal, whether all corners are stored,
        whether one is, and whether those that are not lie inside.
        """
        Float = self.types.Float
        cell, place = self._grid(p)
        corners = self._corners(cell, active)
        # Where a corner is not stored, the signs of all are the same, and its own is known exactly: those of nodes may
        # have been lost in training or by rounding
        complete, inside = active, dr.mask_t(Float)(False)
        for stored, *_, sign in corners:
            complete, inside = complete & stored, inside | (sign & ~stored)
        value, weight_sum = Float(0), Float(0)
        slope, mean, told = [Float(0)] * 3, [Float(0)] * 3, []
        for (a, b, c), (stored, number, record, at, _) in zip(CORNERS, corners, strict=True):
            d, g = self._node(number, record, *at, active & stored)
            ends = [(t if e else 1 - t) for e, t in zip((a, b, c), place, strict=True)]
            offset = [t - e for e, t in zip((a, b, c), place, strict=True)]
            towards = g[0] * offset[0] + g[1] * offset[1] + g[2] * offset[2]
            # Where a corner is missing, the others are extended to the whole
            part = dr.fma(dr.select(complete, 0.5, 1.0), towards, d)
            w = dr.select(stored & active, ends[0] * ends[1] * ends[2], 0)
            value, weight_sum = dr.fma(w, part, value), weight_sum + w
            mean = [dr.fma(w, x, s) for x, s in zip(g, mean, strict=True)]
            told.append((w, g))
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
        # In a thin wall, nodes tell the normal of its other side: less the further they turn away, at last nothing
        smooth = [Float(0)] * 3
        for w, g in told:
            w = w * dr.maximum(g[0] * slope[0] + g[1] * slope[1] + g[2] * slope[2], 0)
            smooth = [dr.fma(w, x, s) for x, s in zip(g, smooth, strict=True)]
        return value, slope, smooth, complete, some, inside

    def blend(self, p):
        """
        For training: the value in spacings, its gradient, the smooth normal (three each), and whether this is a cell
        whose nodes are all stored.
        """
        value, slope, smooth, complete, *_ = self._blend(p, self.inside(p), True)
        return value, slope, smooth, complete

    def value(self, p, active=True):
        return self._told(p, active, False)[0]

    def gradient(self, p, active=True):
        value, slope, _ = self._told(p, active, True)
        return value, slope

    def normal(self, p, active=True):
        return self._told(p, active, True)[2]

    def normals(self, p, active=True):
        return self._told(p, active, True)[1:]

    def _told(self, p, active, derivatives: bool):
        active = self.inside(p) & active
        value, slope, smooth, complete, some, inside = self._blend(p, active, derivatives)
        sign = dr.select(inside, -1.0, 1.0)
        # The sign of a cell that no surface crosses is that of its corners, whatever their extension says
        short = dr.select(some, dr.minimum(dr.maximum(sign * value, 1e-3), BAND), BAND)
        value = dr.select(complete, dr.minimum(dr.maximum(value, -BAND), BAND), sign * short) * self.spacing

        def vector(v):
            return self.types.Array3f(*(dr.select(active & some, x, 0) for x in v))

        return dr.select(active, value, self.band), vector(slope), vector(smooth)

    # -- what is stored ------------------------------------------------------------------------------------------------

    def frames(self) -> np.ndarray:
        """The words of the blocks' frames, ``(B,)``."""
        return np.array(self._blocks).reshape(-1, 4)[:, 3]

    def decoded(self) -> np.ndarray | None:
        """What nodes hold: distances in spacings and gradients, ``(n, 4)``; none if they may be trained."""
        if self._entries is None:
            return None
        pointers = codes.pointers_of(np.array(self._pointers), self.bits, self.structure.nodes)
        entries = codes.entries_numpy(np.array(self._entries), *self._affine)
        return decoded_nodes(self.structure, self.frames(), entries[pointers])

    @property
    def nbytes(self) -> int:
        """Bytes of everything that a read needs, as it is held."""
        total = self.structure.nbytes
        if self.nodes is not None:
            return total + 16 * self.structure.nodes
        return total + 4 * (self.structure.blocks + dr.width(self._pointers) + dr.width(self._entries))


def _bit(low, high, bit):
    """Whether a bit of a 64-bit mask, two words, is set."""
    word = dr.select(bit < 32, low, high)
    return (word >> (bit & 31) & 1) == 1


def _bit_and_rank(low, high, bit):
    """The same, and how many bits below are."""
    upper = bit >= 32
    word = dr.select(upper, high, low)
    rank = dr.popcnt(word & ((type(low)(1) << (bit & 31)) - 1)) + dr.select(upper, dr.popcnt(low), 0)
    return (word >> (bit & 31) & 1) == 1, rank


def _split(v):
    return v[0], (v[1], v[2], v[3])


def slope_bound(values: np.ndarray, gradients: np.ndarray, corners: np.ndarray, part: int = 2**17) -> float:
    """
    A bound Λ of |∇f| in all cells: values (n,) in spacings, gradients (n, 3), corners (K, 8), z fastest.

    The derivatives lie between their own Bernstein coefficients, twice the differences of those of f.
    """
    told, worst = np.concatenate([values[:, None], gradients], axis=1), 0.0
    for first in range(0, len(corners), part):
        total = bernstein(told[corners[first : first + part]]).reshape(-1, 3, 3, 3)
        square = 0.0
        for axis in range(3):
            square = square + np.abs(2 * np.diff(total, axis=1 + axis)).max(axis=(1, 2, 3)) ** 2
        worst = max(worst, float(np.sqrt(square.max(initial=0.0))))
    return max(1.0, worst)


def _bernstein() -> np.ndarray:
    """What :func:`bernstein` multiplies with, ``(32, 27)``."""
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


def bernstein(told: np.ndarray) -> np.ndarray:
    """
    In a cell f is a polynomial of degree 2 along each axis: its Bernstein coefficients, ``(K, 27)``, z fastest, of what
    the eight corners say, value in spacings and gradient, ``(K, 8, 4)``. Its values lie between them.
    """
    return told.reshape(-1, 32) @ _BERNSTEIN


def middles(positions: np.ndarray) -> np.ndarray:
    """Offsets of nodes at positions (n, 3) from the middle of their block, in spacings."""
    return positions % BLOCK - (BLOCK - 1) / 2


def decoded_nodes(structure: Structure, frames: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """The nodes (n, 4), float32, distances in spacings and normals, of frames (B,) and the nodes' entries (n, 3)."""
    positions, block = structure.node_positions()
    n, d, scale = (v[block] for v in codes.frames_numpy(frames))
    distance, normal = codes.decoded(
        tuple(entries.astype(np.float64).T), tuple(n.T), d, scale, tuple(middles(positions).T)
    )
    return np.stack([distance, *normal], axis=1).astype(np.float32)
