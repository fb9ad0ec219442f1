"""
Where the numbers of a field lie: the nodes of a grid, all of them, or those of some of its cells.

Of a sparse grid, the corners of all cells that matter are stored. A cell is looked at if all its corners are stored,
and is nothing otherwise. Rays cross what is nothing by the distances of a coarser grid, of cells of
:data:`COARSE` × :data:`COARSE` × :data:`COARSE`.
"""

from __future__ import annotations

import drjit as dr
import numpy as np
from scipy.ndimage import distance_transform_cdt

from ...bits import mask_words

#: Cells along a side of a cell of the grid of distances.
COARSE = 2

#: The largest distance that is told, in cells of that grid: 4 bits.
FARTHEST = 15

#: Cells along z of a column: its 32 nodes have a bit each, the last one also in the next column.
COLUMN = 31


class Nodes:
    """
    Nodes at ``lower + spacing · (i, j, k)``, ``(i, j, k)`` below ``shape``. With ``stored`` (bool, of this shape),
    those that are true are numbered from 1 on in lexicographic order, and 0 stands for none; without, all are, from 0.

    Numbers are found in an index with a word for each node of the grid or, if ``packed``, by bit masks and ranks, which
    take a tenth of that memory.
    """

    def __init__(self, types, lower, spacing: float, shape, stored: np.ndarray | None = None, packed: bool = False):
        self.types = types
        self.lower, self.spacing = tuple(map(float, lower)), float(spacing)
        self.shape = tuple(int(n) for n in shape)
        self.stored = stored
        # Not part of kernels, so that those of one grid serve another
        self._inverse = dr.opaque(types.Float, 1 / self.spacing)
        self._offset = dr.opaque(types.Array3f, [-a / self.spacing for a in self.lower])
        self._last = dr.opaque(types.Array3f, [float(n - 2) for n in self.shape])
        self._sides = dr.opaque(types.Array3u, self.shape)
        self.index = self.columns = self.filled = self.distances = None
        if stored is not None:
            self.far = distances(cells_of(stored))
            self.distances = types.UInt32(nibbles(self.far))
            self._coarse = dr.opaque(types.Array3u, self.far.shape)
            if packed:
                filled, columns = column_words(stored)
                self._columns = dr.opaque(types.UInt32, columns_of(self.shape[2]))
                self.filled, self.columns = types.UInt32(filled.reshape(-1)), types.UInt32(columns.reshape(-1))
            else:
                self.index = types.UInt32(numbered(stored).reshape(-1))

    @property
    def nbytes(self) -> int:
        """Bytes of the index and of the distances, in memory."""
        words = [self.index, self.columns, self.filled, self.distances]
        return sum(4 * dr.width(w) for w in words if w is not None)

    @property
    def count(self) -> int:
        """Nodes that are stored."""
        return int(np.count_nonzero(self.stored)) if self.stored is not None else int(np.prod(self.shape))

    @property
    def entries(self) -> int:
        """Entries of an array with a number for each node, and for none."""
        return self.count + (self.stored is not None)

    @property
    def upper(self) -> tuple[float, float, float]:
        """The position of the last node."""
        return tuple(a + self.spacing * (n - 1) for a, n in zip(self.lower, self.shape, strict=True))

    def positions(self) -> np.ndarray:
        """The place of each stored node in the grid, ``(n, 3)``."""
        stored = self.stored if self.stored is not None else np.ones(self.shape, bool)
        return np.argwhere(stored)

    def _place(self, p) -> tuple:
        """The first corner of the cell that holds ``p``, along each axis, and the place in that cell."""
        cell, fraction = [], []
        for x, offset, last in zip(p, self._offset, self._last, strict=True):
            u = dr.fma(x, self._inverse, offset)
            i = dr.clip(dr.floor(u), 0, last)
            # A point that rounding has put out of the box, or NaN, stays within its cell
            fraction.append(dr.clip(u - i, 0, 1))
            cell.append(self.types.UInt32(i))
        return cell, fraction

    def cell(self, p):
        """The cell that holds ``p``: the place of its first corner in the grid, in lexicographic order."""
        (x, y, z), _ = self._place(p)
        return dr.fma(dr.fma(x, self._sides.y, y), self._sides.z, z)

    def corners(self, p, active=True) -> tuple[list, object]:
        """
        The eight (weight, number) of the cell that holds ``p``, and where that cell is looked at. Numbers of a cell
        that is not may be 0.
        """
        cell, fraction = self._place(p)
        active = self.types.Bool(active)
        found = []
        for x in (0, 1):
            for y in (0, 1):
                line = dr.fma(cell[0] + x, self._sides.y, cell[1] + y)
                if self.columns is not None:
                    at, active = self._ranked(line, cell[2], active)
                else:
                    at = dr.fma(line, self._sides.z, cell[2])
                if self.index is not None:
                    # A word for both: of nodes that are neighbours along z, and stored, one number follows the other
                    at = dr.gather(self.types.UInt32, self.index, at, active)
                    active &= at != 0
                across = (fraction[0] if x else 1 - fraction[0]) * (fraction[1] if y else 1 - fraction[1])
                upper = across * fraction[2]
                found += [(across - upper, at), (upper, at + 1)]
        return found, active

    def _ranked(self, line, z, active) -> tuple:
        """The number of the node ``z`` of a line, and whether it and the next one are stored, by masks."""
        Array2u, UInt32 = self.types.Array2u, self.types.UInt32
        part = z // COLUMN
        bit = z - part * COLUMN
        column = dr.fma(line, self._columns, part)
        filled = dr.gather(Array2u, self.filled, column >> 5, active)
        here = column & 31
        active = active & (((filled[0] >> here) & 1) != 0)
        rank = filled[1] + dr.popcnt(filled[0] & ((UInt32(1) << here) - 1))
        found = dr.gather(Array2u, self.columns, rank, active)
        active &= ((found[0] >> bit) & 3) == 3
        return found[1] + dr.popcnt(found[0] & ((UInt32(1) << bit) - 1)), active

    def skip(self, p, d, active=True):
        """A length from ``p`` along ``d`` without a cell that is looked at, or 0."""
        if self.distances is None:
            return self.types.Float(0)
        (x, y, z), _ = self._place(p)
        at = dr.fma(dr.fma(x // COARSE, self._coarse.y, y // COARSE), self._coarse.z, z // COARSE)
        word = dr.gather(self.types.UInt32, self.distances, at >> 3, active)
        steps = (word >> ((at & 7) << 2)) & FARTHEST
        fastest = dr.maximum(dr.maximum(dr.abs(d.x), dr.abs(d.y)), dr.abs(d.z))
        # From anywhere in this cell, one less; a neighbour (1) is still worth not looking
        length = dr.maximum(self.types.Float(steps) - 1, 1e-6) * COARSE / (self._inverse * fastest)
        return dr.select(active & (steps > 0), length, 0)


def cells_of(stored: np.ndarray) -> np.ndarray:
    """The cells of which all corners are stored, ``(X − 1, Y − 1, Z − 1)``."""
    found = np.ones(tuple(n - 1 for n in stored.shape), bool)
    for corner in np.ndindex(2, 2, 2):
        found &= stored[tuple(slice(c, n - 1 + c) for c, n in zip(corner, stored.shape, strict=True))]
    return found


def corners_of(cells: np.ndarray) -> np.ndarray:
    """The nodes that are corners of one of these cells, of one more along each axis."""
    found = np.zeros(tuple(n + 1 for n in cells.shape), bool)
    for corner in np.ndindex(2, 2, 2):
        found[tuple(slice(c, n + c) for c, n in zip(corner, cells.shape, strict=True))] |= cells
    return found


def distances(cells: np.ndarray) -> np.ndarray:
    """
    For each cell of the coarser grid, how many of its cells away, in the maximum norm, the nearest with a cell that is
    looked at is; at most :data:`FARTHEST`. uint8.
    """
    padded = np.pad(cells, [(0, -n % COARSE) for n in cells.shape])
    x, y, z = (n // COARSE for n in padded.shape)
    occupied = padded.reshape(x, COARSE, y, COARSE, z, COARSE).any(axis=(1, 3, 5))
    if not occupied.any():
        return np.full(occupied.shape, FARTHEST, np.uint8)
    return np.minimum(distance_transform_cdt(~occupied, "chessboard"), FARTHEST).astype(np.uint8)


def nibbles(values: np.ndarray) -> np.ndarray:
    """Numbers of 4 bits, eight to a word of 32, the lowest first."""
    flat = values.reshape(-1)
    pairs = np.pad(flat, (0, -len(flat) % 8)).reshape(-1, 2)
    return (pairs[:, 0] | (pairs[:, 1] << 4)).astype(np.uint8).view("<u4")


def numbered(stored: np.ndarray) -> np.ndarray:
    """The number of each node that is stored, as its neighbour along z is, 0 of the others. uint32."""
    numbers = np.zeros(stored.shape, np.uint32)
    numbers[stored] = np.arange(1, np.count_nonzero(stored) + 1)
    numbers[:, :, :-1][~stored[:, :, 1:]] = 0
    numbers[:, :, -1] = 0
    return numbers


def column_words(stored: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    The same as masks and ranks: ``(w, 2)``, a bit for each column that has nodes, 32 to a word, and how many came
    before; ``(c, 2)``, for each of these the bits of its nodes, and the number of the first. uint32.
    """
    x, y, z = stored.shape
    count = columns_of(z)
    padded = np.pad(stored, [(0, 0), (0, 0), (0, count * COLUMN + 1 - z)])
    bits = np.stack([padded[:, :, c * COLUMN : c * COLUMN + 32] for c in range(count)], axis=2).reshape(-1, 32)
    own = bits[:, :COLUMN].sum(axis=1)  # the last node is the next column's first
    own.reshape(x * y, count)[:, -1] += bits.reshape(x * y, count, 32)[:, -1, -1]
    first = 1 + np.cumsum(own) - own
    filled = bits.any(axis=1)
    columns = np.stack([mask_words(bits[filled])[:, 0], first[filled].astype(np.uint32)], axis=1)
    masks = np.pad(filled, (0, -len(filled) % 32)).reshape(-1, 32)
    before = np.cumsum(masks.sum(axis=1)) - masks.sum(axis=1)
    return np.stack([mask_words(masks)[:, 0], before.astype(np.uint32)], axis=1), columns


def columns_of(nodes: int) -> int:
    """Columns along a line of so many nodes."""
    return -(-(nodes - 1) // COLUMN)
