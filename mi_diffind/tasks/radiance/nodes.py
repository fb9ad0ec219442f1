"""Nodes of a sparse grid, in a box or in all space: numbers, memory index, and empty distances.

A sparse grid stores the corners of all occupied cells. A cell is occupied if all its corners are stored, and empty
otherwise. Rays cross empty space by the distances of a coarser grid, whose cells span :data:`COARSE` cells along each
axis.

Surroundings of captured objects fill all space, in a grid of finite size that is coarser with the distance. The
contraction is that of mip-NeRF 360 (Barron et al. 2022) in the maximum norm, with a cube of half side R around the
objects: points of the cube stay, and a point p at r = ‖p‖ / R > 1 from the cube's centre moves to (2 − 1/r) p / r, into
a cube of twice the side. Nodes are equidistant there. Steps of rays grow as √(1 + (r / ρ)²) with the Euclidean distance
r, on both sides of the point next to the centre, and so do voxels: the density of a node is that of a step.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from ...arrays.lookup import mask_words
from ...arrays.sparse_grid import complete_cells, empty_distances, rank

#: Cells along a side of a cell of the coarser grid of distances.
COARSE = 2

#: Largest stored distance, in cells of the coarser grid: 4 bits.
FARTHEST = 15

#: Distance in half sides of the inner cube at which steps begin to grow (ρ).
GROWTH = 2.0

#: Distance in half sides of the inner cube at which rays end.
HORIZON = 32.0

#: Cells of a column, along z. Each of its 32 nodes has a bit; the last node is also the first of the next column.
COLUMN = 31


class Nodes:
    """Nodes at ``lower + spacing · (i, j, k)``, with ``(i, j, k)`` below ``shape``.

    ``stored``, bool of this shape, marks the nodes of the sparse grid. They are numbered from 1 in lexicographic order,
    and 0 stands for no node. The index that maps positions to numbers has a word for each node of the grid or, if
    ``packed``, bit masks and ranks in a tenth of that memory. ``stored`` may then be the flags as ``np.packbits``
    returns them, uint8, and the mask takes no memory.

    With ``inner``, the centre and the half side of a cube, nodes lie in space that is contracted around it.
    """

    def __init__(self, types, lower, spacing: float, shape, stored: np.ndarray, packed: bool = False, inner=None):
        self.types = types
        self.lower, self.spacing = tuple(map(float, lower)), float(spacing)
        self.shape = tuple(int(n) for n in shape)
        self._stored = stored
        self.contraction = None if inner is None else Contraction(types, inner)
        # Opaque: grids of another size use the same kernels
        self._inverse = dr.opaque(types.Float, 1 / self.spacing)
        self._offset = dr.opaque(types.Array3f, [-a / self.spacing for a in self.lower])
        self._last = dr.opaque(types.Array3f, [float(n - 2) for n in self.shape])
        self._sides = dr.opaque(types.Array3u, self.shape)
        parts = [coarser(complete_cells(part)) for part in layers(stored, self.shape, 1) if len(part) > 1]
        self.coarse_distances = empty_distances(np.concatenate(parts), FARTHEST)
        flat = self.coarse_distances.reshape(-1)
        pairs = np.pad(flat, (0, -len(flat) % 8)).reshape(-1, 2)  # eight distances to a word, the lowest bits first
        self.distances = device_array(types.UInt32, (pairs[:, 0] | (pairs[:, 1] << 4)).astype(np.uint8).view("<u4"))
        self._coarse = dr.opaque(types.Array3u, self.coarse_distances.shape)
        self.index = self.columns = self.filled = None
        if packed:
            filled, columns = column_words(stored, self.shape)
            self._columns = dr.opaque(types.UInt32, column_count(self.shape[2]))
            self.filled, self.columns = (device_array(types.UInt32, v) for v in (filled, columns))
        else:
            # The number of each node, 0 where the node or its next neighbour along z is not stored
            numbers = np.zeros(stored.shape, np.uint32)
            numbers[stored] = np.arange(1, np.count_nonzero(stored) + 1)
            numbers[..., :-1][~stored[..., 1:]] = 0
            numbers[..., -1] = 0
            self.index = device_array(types.UInt32, numbers)

    @property
    def stored(self) -> np.ndarray:
        """Mask of the stored nodes."""
        return unpack_mask(self._stored, self.shape) if self._stored.dtype == np.uint8 else self._stored

    @property
    def nbytes(self) -> int:
        """Bytes of the index and of the distances in memory."""
        words = [self.index, self.columns, self.filled, self.distances]
        return sum(4 * dr.width(w) for w in words if w is not None)

    @property
    def count(self) -> int:
        """Number of stored nodes."""
        return sum(int(np.count_nonzero(part)) for part in layers(self._stored, self.shape))

    @property
    def entries(self) -> int:
        """Entries of an array indexed by node numbers: one for no node, and one for each node."""
        return self.count + 1

    @property
    def upper(self) -> tuple[float, float, float]:
        """Position of the last node."""
        return tuple(a + self.spacing * (n - 1) for a, n in zip(self.lower, self.shape, strict=True))

    def like(self, spacing: float, shape, stored: np.ndarray, packed: bool = False) -> Nodes:
        """Return other nodes in the same space."""
        inner = None if self.contraction is None else self.contraction.inner
        return Nodes(self.types, self.lower, spacing, shape, stored, packed, inner)

    def positions(self) -> np.ndarray:
        """Return the integer coordinates of each stored node, ``(n, 3)``."""
        return np.argwhere(self.stored)

    def _place(self, p) -> tuple:
        """Return the first corner of the cell that holds ``p`` and the position within the cell, along each axis."""
        cell, fraction = [], []
        p = p if self.contraction is None else self.contraction.places(p)[0]
        for x, offset, last in zip(p, self._offset, self._last, strict=True):
            u = dr.fma(x, self._inverse, offset)
            i = dr.clip(dr.floor(u), 0, last)
            # A point that rounding has moved out of the box, or NaN, stays within its cell
            fraction.append(dr.clip(u - i, 0, 1))
            cell.append(self.types.UInt32(i))
        return cell, fraction

    def cell(self, p, active=True):
        """Return the number of the first corner of the cell that holds ``p``; 0 if the cell is empty."""
        (x, y, z), _ = self._place(p)
        at = dr.fma(dr.fma(x, self._sides.y, y), self._sides.z, z)
        return dr.gather(self.types.UInt32, self.index, at, active)

    def cells_where(self, chosen: np.ndarray) -> np.ndarray:
        """Return the cells ``(X − 1, Y − 1, Z − 1)`` whose first corners are ``chosen``, bool for each entry."""
        cells = np.zeros(self.shape, bool)
        cells[self.stored] = chosen[1:]
        return cells[:-1, :-1, :-1]

    def corners(self, p, active=True) -> tuple[list, object]:
        """Return eight pairs (weight, node number) of the cell that holds ``p``, and whether that cell is occupied.

        Numbers of an empty cell may be 0.
        """
        cell, fraction = self._place(p)
        active = self.types.Bool(active)
        weighted = []
        for x in (0, 1):
            for y in (0, 1):
                line = dr.fma(cell[0] + x, self._sides.y, cell[1] + y)
                if self.columns is not None:
                    at, active = self._ranked(line, cell[2], active)
                else:
                    # One word for two nodes: stored neighbours along z have consecutive numbers
                    at = dr.fma(line, self._sides.z, cell[2])
                    at = dr.gather(self.types.UInt32, self.index, at, active)
                    active &= at != 0
                across = (fraction[0] if x else 1 - fraction[0]) * (fraction[1] if y else 1 - fraction[1])
                upper = across * fraction[2]
                weighted += [(across - upper, at), (upper, at + 1)]
        return weighted, active

    def _ranked(self, line, z, active) -> tuple:
        """Return the number of node ``z`` of a line and, from the masks, whether it and the next one are stored."""
        Array2u = self.types.Array2u
        part = z // COLUMN
        bit = z - part * COLUMN
        column = dr.fma(line, self._columns, part)
        filled = dr.gather(Array2u, self.filled, column >> 5, active)
        here = column & 31
        active = active & (((filled[0] >> here) & 1) != 0)
        place = filled[1] + rank(filled[0], here)
        mask, number = dr.gather(Array2u, self.columns, place, active)
        active &= ((mask >> bit) & 3) == 3
        return number + rank(mask, bit), active

    def free_distance(self, p, d, active=True):
        """Return a length from ``p`` along ``d`` that crosses no occupied cell, or 0."""
        (x, y, z), _ = self._place(p)
        at = dr.fma(dr.fma(x // COARSE, self._coarse.y, y // COARSE), self._coarse.z, z // COARSE)
        word = dr.gather(self.types.UInt32, self.distances, at >> 3, active)
        steps = (word >> ((at & 7) << 2)) & FARTHEST
        fastest = dr.maximum(dr.maximum(dr.abs(d.x), dr.abs(d.y)), dr.abs(d.z))
        # One cell less, since ``p`` may be anywhere in its own; beside an occupied cell the length stays positive
        length = dr.maximum(self.types.Float(steps) - 1, 1e-6) * COARSE / (self._inverse * fastest)
        length = dr.select(active & (steps > 0), length, 0)
        if self.contraction is None:
            return length
        # Contracted points move at most (4r − 3) / r² as far in the maximum norm: below 4/3, and below 4 / r
        _, r = self.contraction.places(p)
        return length * dr.maximum(0.75, r / (4 + length * fastest / self.contraction.half))


class EqualSteps:
    """Distances along rays as multiples of steps: here, steps are of equal length."""

    @staticmethod
    def of_steps(s):
        """Return the distances of a ray at the places ``s`` among its steps."""
        return s

    @staticmethod
    def in_steps(t):
        """Return the places of distances among the steps, the inverse of :meth:`of_steps`."""
        return t

    @staticmethod
    def skipped(s, t, free):
        """Return the length in steps of ``free`` space behind the distance ``t``, which is at ``s``."""
        return free


class Contraction:
    """Contraction around a cube with the centre ``inner[:3]`` and the half side ``inner[3]``."""

    def __init__(self, types, inner):
        self.types, self.inner = types, tuple(map(float, inner))
        # Opaque: other cubes use the same kernels
        self.centre = dr.opaque(types.Array3f, list(self.inner[:3]))
        self.half = dr.opaque(types.Float, self.inner[3])
        self._inverse = dr.opaque(types.Float, 1 / self.inner[3])

    def box(self, size: float) -> tuple[tuple, tuple]:
        """Return the lower and the upper corner of a cube of ``size`` half sides."""
        centre, half = self.inner[:3], size * self.inner[3]
        return tuple(c - half for c in centre), tuple(c + half for c in centre)

    def places(self, p) -> tuple:
        """Return points in contracted space, and their distances r in the maximum norm, at least 1."""
        v = p - self.centre
        r = dr.maximum(dr.max(dr.abs(v)) * self._inverse, 1)
        return dr.fma(v, (2 - 1 / r) / r, self.centre), r

    def growth(self, p):
        """Return the ratio of steps at points to those at the centre."""
        return dr.sqrt(dr.fma(dr.squared_norm(p - self.centre), dr.square(self._inverse) / GROWTH**2, 1))

    def along(self, o, d) -> GrowingSteps:
        """Return the distances of steps on rays from ``o``."""
        return GrowingSteps(self.half, (o - self.centre) * self._inverse, d)


class GrowingSteps(EqualSteps):
    """Steps that grow with the distance, u = w sinh(s / ρ) from the point of the ray that is next to the centre.

    ``half`` is the half side of the inner cube, ``o`` the origin of a ray in units of it, from its centre.
    """

    def __init__(self, half, o, d):
        self.scale, self.half = GROWTH * half, half
        self.begin = dr.dot(o, d)
        beside = dr.maximum(dr.squared_norm(o) - dr.square(self.begin), 0)
        self.width = dr.sqrt(beside + GROWTH**2)
        self.before = dr.asinh(self.begin / self.width)

    def of_steps(self, s):
        """Return the distances of a ray at the places ``s`` of its steps."""
        return self.half * dr.fma(self.width, dr.sinh(s / self.scale + self.before), -self.begin)

    def in_steps(self, t):
        """Return the places of distances among the steps, the inverse of :meth:`of_steps`."""
        return self.scale * (dr.asinh((t / self.half + self.begin) / self.width) - self.before)

    def skipped(self, s, t, free):
        """Return the length in steps of ``free`` space behind the distance ``t``, which is at ``s``."""
        # Never less than 0, by rounding: rays go on
        return dr.maximum(self.in_steps(t + free) - s, 0)


def unpack_mask(flags: np.ndarray, shape) -> np.ndarray:
    """Return the mask of ``shape`` that ``np.packbits`` has packed, bool."""
    return np.unpackbits(flags, count=int(np.prod(shape))).view(bool).reshape(shape)


def layer_count(shape) -> int:
    """Return how many layers of a grid of ``shape`` are processed at a time, a multiple of :data:`COARSE`."""
    return COARSE * max(1, 2**20 // (COARSE * int(shape[1]) * int(shape[2])))  # nodes, which take several bytes each


def layers(stored: np.ndarray, shape, more: int = 0):
    """Yield parts of :func:`layer_count` layers along the first axis of a mask, or of its packed flags, one by one.

    Each part has ``more`` layers of the next part at its end, as far as there are any.
    """
    layer, count = int(shape[1]) * int(shape[2]), layer_count(shape)
    for first in range(0, shape[0], count):
        last = min(first + count + more, shape[0])
        if stored.dtype == np.uint8:
            begin, end = first * layer // 8, -(-last * layer // 8)
            flags = np.unpackbits(stored[begin:end])[first * layer - 8 * begin :][: (last - first) * layer]
            yield flags.view(bool).reshape(last - first, *shape[1:])
        else:
            yield stored[first:last]


def coarser(cells: np.ndarray) -> np.ndarray:
    """Return which cells of the coarser grid hold one of the ``cells``."""
    padded = np.pad(cells, [(0, -n % COARSE) for n in cells.shape])
    x, y, z = (n // COARSE for n in padded.shape)
    return padded.reshape(x, COARSE, y, COARSE, z, COARSE).any(axis=(1, 3, 5))


def column_words(stored: np.ndarray, shape=None) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of nodes as masks and ranks, of a mask or its packed flags: two uint32 arrays.

    The first, ``(w, 2)``, holds a bit for each column, set if the column has stored nodes, 32 to a word, and the number
    of set bits before. The second, ``(c, 2)``, holds the mask of each such column and the number of its first node.
    """
    shape = stored.shape if shape is None else shape
    count = column_count(shape[2])
    filled, columns, nodes = [], [], 1
    for part in layers(stored, shape):
        lines = part.shape[0] * part.shape[1]
        padded = np.pad(part, [(0, 0), (0, 0), (0, count * COLUMN + 1 - shape[2])])
        bits = np.stack([padded[:, :, c * COLUMN : c * COLUMN + 32] for c in range(count)], axis=2).reshape(-1, 32)
        counts = bits[:, :COLUMN].sum(axis=1)  # the last node is the next column's first
        counts.reshape(lines, count)[:, -1] += bits.reshape(lines, count, 32)[:, -1, -1]
        first = nodes + np.cumsum(counts) - counts
        nodes += int(counts.sum())
        some = bits.any(axis=1)
        filled.append(some)
        columns.append(np.stack([mask_words(bits[some])[:, 0], first[some].astype(np.uint32)], axis=1))
    filled = np.concatenate(filled)
    masks = np.pad(filled, (0, -len(filled) % 32)).reshape(-1, 32)
    before = np.cumsum(masks.sum(axis=1)) - masks.sum(axis=1)
    return np.stack([mask_words(masks)[:, 0], before.astype(np.uint32)], axis=1), np.concatenate(columns)


def column_count(nodes: int) -> int:
    """Return the number of columns along a line of ``nodes`` nodes."""
    return -(-(nodes - 1) // COLUMN)
