"""Sparse signed distance field: nodes near the surface that hold a distance and a normal, read by indirection.

Reading a cell whose eight nodes are stored blends their linear extrapolations (§ 1.6 of the supplement describes dense
arrays only; this layout is ours):

    f(x) = Σ wᵢ (dᵢ + ½ gᵢ · (x − xᵢ))

with trilinear weights w, which is exact for quadratic functions. Everywhere else only the sign is known.
"""

import math
from types import SimpleNamespace

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from ...arrays.lookup import mask_flags
from ...arrays.sparse_grid import BLOCK, CORNERS, GridIndex, SparseGrid, place_of_bit
from .field import DistanceField

#: Bits of each coordinate of a frame's normal.
NORMAL_BITS = 10

#: Bits of the distance of a block's middle in a frame.
DISTANCE_BITS = 8

#: Bits of a frame's scale.
SCALE_BITS = 4

#: Largest distance of a block's middle, in spacings.
REACH = 4.5

#: The scale is 2^(k/2 − SMALLEST), k from 0 to 15.
SMALLEST = 7

#: Bits of an entry of the cascaded array: distance, and both coordinates of the normal.
ENTRY_BITS = (10, 11, 11)

#: Radius slightly below that at which the projection reaches the direction opposite to N.
EDGE = 1.999

#: Bits of a pointer → pointers in a word of 32 bits.
POINTERS = {4: 8, 5: 6, 6: 5, 8: 4, 10: 3, 16: 2}

#: The functions of Dr.Jit that codes need, for NumPy arrays.
NUMPY = SimpleNamespace(
    abs=np.abs, minimum=np.minimum, maximum=np.maximum, sqrt=np.sqrt, copysign=np.copysign, select=np.where,
    fma=lambda a, b, c: a * b + c, rcp=lambda x: 1 / x, rsqrt=lambda x: 1 / np.sqrt(np.maximum(x, 1e-300)),
)  # fmt: skip


def _functions(array):
    """Return the functions for an array: those of Dr.Jit, or :data:`NUMPY`."""
    return dr if dr.is_array_v(array) else NUMPY


def orthonormal(n):
    """Return two vectors that complete unit vectors ``n`` to a right-handed frame (Duff et al., JCGT 2017)."""
    x, y, z = n
    sign = _functions(z).select(z >= 0, 1.0, -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return (1 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)


def to_octahedral(normals: np.ndarray) -> np.ndarray:
    """Return unit vectors (n, 3) as whole numbers (n, 2) of :data:`NORMAL_BITS` bits."""
    n = normals / np.maximum(np.abs(normals).sum(axis=1, keepdims=True), 1e-30)
    folded = (1 - np.abs(n[:, 1::-1])) * np.where(n[:, :2] >= 0, 1, -1)
    xy = np.where(n[:, 2:] < 0, folded, n[:, :2])
    top = 2**NORMAL_BITS - 1
    return np.clip(np.round((xy + 1) / 2 * top), 0, top).astype(np.uint32)


def frame_words(normals: np.ndarray, distances: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Pack frames into words (B,): normals (B, 3), distances in spacings (B,), scales (B,), which are rounded up."""
    x, y = to_octahedral(normals).T
    top = 2**DISTANCE_BITS - 1
    d = np.clip(np.round((distances / REACH + 1) / 2 * top), 0, top).astype(np.uint32)
    k = np.ceil(2 * (np.log2(np.maximum(scales, 1e-9)) + SMALLEST) - 0.5)
    k = np.clip(k, 0, 2**SCALE_BITS - 1).astype(np.uint32)
    return x | y << np.uint32(10) | d << np.uint32(20) | k << np.uint32(28)


def unpack_frames(words, Float=np.float64):
    """Unpack the frames of blocks: the normal (three arrays), the middle's distance in spacings, and the scale.

    ``words`` are ``UInt32`` and ``Float`` the type of the result, of Dr.Jit; or a NumPy array of words.
    """
    f, top = _functions(words), 2**NORMAL_BITS - 1
    x = f.fma(Float(words & top), 2 / top, -1)
    y = f.fma(Float(words >> 10 & top), 2 / top, -1)
    z = 1 - f.abs(x) - f.abs(y)
    t = f.maximum(-z, 0)
    x, y = x - f.copysign(t, x), y - f.copysign(t, y)
    inverse = f.rsqrt(f.fma(x, x, f.fma(y, y, z * z)))
    d = f.fma(Float(words >> 20 & 255), 2 * REACH / 255, -REACH)
    k = words >> 28
    if f is NUMPY:
        power = np.exp2((k >> 1) - float(SMALLEST))
    else:
        power = dr.reinterpret_array(Float, ((k >> 1) + (127 - SMALLEST)) << 23)
    return (x * inverse, y * inverse, z * inverse), d, f.select((k & 1) == 1, power * math.sqrt(2), power)


def residuals(distances, normals, offsets, n, d, scales) -> np.ndarray:
    """Return the exact entries ``(m, 3)`` of nodes: the inverse of :func:`decode_nodes`.

    Nodes have ``distances`` (m,) in spacings, ``normals`` (m, 3) and ``offsets`` from the middle of their block (m, 3);
    their frames are ``n`` (three arrays), ``d`` (m,) and ``scales`` (m,).
    """
    t, b = (np.stack(v, axis=1) for v in orthonormal(n))
    n = np.stack(n, axis=1)
    c = np.sum(normals * n, axis=1)
    stretch = np.sqrt(2 / np.maximum(1 + c, 1e-6))
    a, b = np.sum(normals * t, axis=1) * stretch, np.sum(normals * b, axis=1) * stretch
    e = distances - d - np.sum(offsets * n, axis=1)
    return np.stack([e, a, b], axis=1) / scales[:, None]


def decode_nodes(entry, n, d, scale, offset):
    """Return the distance (in spacings) and the normal (three arrays) of nodes.

    ``entry`` is ``(e, a, b)``; ``n`` (three arrays), ``d`` and ``scale`` are the frame; ``offset`` (three arrays) is
    the node's position relative to the block's middle.
    """
    functions = _functions(n[0])
    e, a, b = (v * scale for v in entry)
    square = a * a + b * b
    # Entries beyond the edge count as on it. Few divisions and roots: rays spend their time here
    inside, inverse = functions.minimum(square, EDGE**2), -functions.rcp(1 + functions.abs(n[2]))
    f = functions.sqrt(1 - inside / 4) * functions.select(square > EDGE**2, EDGE * functions.rsqrt(square), 1)
    # T and B are those of :func:`orthonormal`, their products with N shared
    x, y, z = n
    sign = functions.select(z >= 0, 1.0, -1.0)
    c, p, q = 1 - inside / 2, f * a, sign * f * b
    m = sign * (x * p + y * q)
    along = c + sign * inverse * m
    return d + x * offset[0] + y * offset[1] + z * offset[2] + e, (x * along + p, y * along + q, c * z - m)


def entry_scale(entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return offset and step of each channel, (3,) twice, with which entries (K, 3) round to :data:`ENTRY_BITS`."""
    low, high = entries.min(axis=0), entries.max(axis=0)
    steps = np.maximum(high - low, 1e-6) / (2.0 ** np.array(ENTRY_BITS) - 1)
    return low.astype(np.float32), steps.astype(np.float32)


def entry_words(entries: np.ndarray, offset, step) -> np.ndarray:
    """Pack entries (K, 3) into words (K,)."""
    top = 2 ** np.array(ENTRY_BITS) - 1
    e, a, b = np.clip(np.round((entries - offset) / step), 0, top).astype(np.uint32).T
    return e | a << np.uint32(10) | b << np.uint32(21)


def unpack_entries(words, offset, step, Float=np.float64):
    """Unpack the entries of words: three arrays; types as in :func:`unpack_frames`."""
    parts = words & 1023, words >> 10 & 2047, words >> 21
    fma = _functions(words).fma
    return [fma(Float(p), s, o) for p, s, o in zip(parts, step, offset, strict=True)]


def pointer_words(pointers: np.ndarray, bits: int) -> np.ndarray:
    """Pack pointers (n,) into words (⌈n / k⌉,), k to a word, the first one in the lowest bits."""
    each = POINTERS[bits]
    padded = np.zeros(-(-len(pointers) // each) * each, np.uint32)
    padded[: len(pointers)] = pointers
    shifts = (np.arange(each) * bits).astype(np.uint32)
    return np.bitwise_or.reduce(padded.reshape(-1, each) << shifts, axis=1)


def unpack_pointers(words: np.ndarray, bits: int, count: int) -> np.ndarray:
    """Unpack ``count`` pointers from words."""
    each = POINTERS[bits]
    shifts = (np.arange(each) * bits).astype(np.uint32)
    return (words[:, None] >> shifts & np.uint32(2**bits - 1)).reshape(-1)[:count]


def pointer_at(source, index, bits: int, active):
    """Gather the pointers at positions ``index`` from words (Dr.Jit arrays)."""
    each = POINTERS[bits]
    word = index // each
    return dr.gather(type(index), source, word, active) >> ((index - word * each) * bits) & (2**bits - 1)


#: Largest distance that a field returns, in spacings.
BAND = 2.0

#: Blocks whose nodes are decoded at a time.
PART = 2**10

#: Middle of a block, relative to its first node.
MIDDLE = (BLOCK - 1) / 2


class SparseNodes(DistanceField):
    """Field of the nodes of a ``structure``, in one of two forms.

    Decoded nodes can be trained: ``nodes`` is a tensor (n, 4) of distances in spacings and gradients. Coded nodes are
    ``pointers`` (words, with ``bits`` bits each) into ``entries`` (K, 3), float32, which are kept as words, relative to
    the ``frames`` of their blocks (words).
    """

    marched = True

    def __init__(
        self, types, structure: SparseGrid, slope: float, *, nodes=None, frames=None, pointers=None, bits=0,
        entries=None,
    ):  # fmt: skip
        h = structure.spacing
        super().__init__(types, structure.lower, structure.upper, h, BAND * h)
        self.structure, self.slope = structure, float(slope)
        self.index = GridIndex(types, structure, frames)
        self.nodes, self.bits, self._entries = nodes, bits, None
        self._pointers = None if pointers is None else device_array(types.UInt32, pointers)
        if entries is not None:
            offset, step = entry_scale(entries)
            self._entries = device_array(types.UInt32, entry_words(entries, offset, step))
            self._affine = tuple(map(float, offset)), tuple(map(float, step))
            self._scale = [dr.opaque(types.Array3f, v) for v in self._affine]

    def _grid(self, p):
        """Return the cell of points, as whole numbers of its lowest corner, and the place within it."""
        Int32 = self.types.Int32
        cell, place = [], []
        for x, a, last in zip(p, self.box[0], self.index.last_cell, strict=True):
            t = (x - a) * self.cells_per_unit
            i = dr.clip(Int32(dr.floor(dr.detach(t))), 0, last)
            cell.append(i)
            place.append(t - self.types.Float(i))
        return cell, place

    def _node(self, number, record, i, j, k, active):
        """Return the distance, in spacings, and the gradient of a node."""
        if self.nodes is not None:
            distance, *gradient = dr.gather(self.types.Array4f, self.nodes.array, number, active)
            return distance, gradient
        Float = self.types.Float
        pointer = pointer_at(self._pointers, number, self.bits, active)
        entry = unpack_entries(dr.gather(self.types.UInt32, self._entries, pointer, active), *self._scale, Float)
        n, d, scale = unpack_frames(record[3], Float)
        offset = [Float(v & 3) - MIDDLE for v in (i, j, k)]
        return decode_nodes(entry, n, d, scale, offset)

    def _blend(self, p, active, derivatives: bool):
        """Blend the corners of a cell: ``(value, gradient, smooth normal, complete, some, inside)``.

        The value is in spacings; the gradient is computed if ``derivatives``. ``complete``: all corners are stored;
        ``some``: at least one is; ``inside``: corners that are not stored lie inside.
        """
        Float = self.types.Float
        cell, place = self._grid(p)
        corners = self.index.corners(cell, active)
        # Where a corner is not stored, the signs of all are the same, and its sign is known exactly: signs of nodes may
        # have been lost in training or by rounding
        complete, inside = active, dr.mask_t(Float)(False)
        for stored, *_, sign in corners:
            complete, inside = complete & stored, inside | (sign & ~stored)
        value, weight_sum = Float(0), Float(0)
        slope, mean, weighted = [Float(0)] * 3, [Float(0)] * 3, []
        for (a, b, c), (stored, number, record, at, _) in zip(CORNERS.tolist(), corners, strict=True):
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
        return self.index.block_words

    def decoded(self) -> np.ndarray | None:
        """Return distances in spacings and gradients of coded nodes, ``(n, 4)``; ``None`` for decoded ones."""
        if self._entries is None:
            return None
        pointers = unpack_pointers(np.array(self._pointers), self.bits, self.structure.nodes)
        entries = np.stack(unpack_entries(np.array(self._entries), *self._affine), axis=1)
        return decode_to_array(self.structure, self.frames(), entries, pointers)

    @property
    def nbytes(self) -> int:
        """Bytes in memory of everything that a read needs."""
        total = self.structure.nbytes
        if self.nodes is not None:
            return total + 16 * self.structure.nodes
        return total + 4 * (self.structure.blocks + dr.width(self._pointers) + dr.width(self._entries))


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


def decode_to_array(
    structure: SparseGrid, frames: np.ndarray, entries: np.ndarray, pointers: np.ndarray | None = None
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
            for value in unpack_frames(frames[part : part + PART])
        )
        entry = entries[rows] if pointers is None else entries[pointers[rows]]
        distance, normal = decode_nodes(entry.astype(np.float64).T, n, d, scale, middles(place_of_bit(bit)).T)
        result[rows] = np.stack([distance, *normal], axis=1)
        first = rows.stop
    return result
