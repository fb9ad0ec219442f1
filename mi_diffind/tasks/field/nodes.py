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

#: Cells along a side of a cell of the grid of distances.
COARSE = 2


class Nodes:
    """
    Nodes at ``lower + spacing · (i, j, k)``, ``(i, j, k)`` below ``shape``. With ``stored`` (bool, of this shape), those
    that are true are numbered from 1 on in lexicographic order, and 0 stands for none; without, all are, from 0 on.
    """

    def __init__(self, types, lower, spacing: float, shape, stored: np.ndarray | None = None):
        self.types = types
        self.lower, self.spacing = tuple(map(float, lower)), float(spacing)
        self.shape = tuple(int(n) for n in shape)
        self.stored = stored
        self.index = self.distances = None
        if stored is not None:
            numbers = np.zeros(self.shape, np.uint32)
            numbers[stored] = np.arange(1, np.count_nonzero(stored) + 1)
            # Of the nodes that are not stored, or whose neighbour is not, nothing is asked
            numbers[:, :, :-1][~stored[:, :, 1:]] = 0
            numbers[:, :, -1] = 0
            self.index = types.UInt32(numbers.reshape(-1))
            self.far = distances(cells_of(stored))
            self.distances = types.UInt32(packed(self.far))

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
        for x, a, n in zip(p, self.lower, self.shape, strict=True):
            u = dr.fma(x, 1 / self.spacing, -a / self.spacing)
            i = dr.clip(dr.floor(u), 0, n - 2)
            # A point that rounding has put out of the box, or NaN, stays within its cell
            fraction.append(dr.clip(u - i, 0, 1))
            cell.append(self.types.UInt32(i))
        return cell, fraction

    def cell(self, p):
        """The cell that holds ``p``: the place of its first corner in the grid, in lexicographic order."""
        (x, y, z), _ = self._place(p)
        return dr.fma(dr.fma(x, self.shape[1], y), self.shape[2], z)

    def corners(self, p, active=True) -> tuple[list, object]:
        """
        The eight (weight, number) of the cell that holds ``p``, and where that cell is looked at. Numbers of a cell that
        is not may be 0.
        """
        cell, fraction = self._place(p)
        active = self.types.Bool(active)
        _, height, depth = self.shape
        first = dr.fma(dr.fma(cell[0], height, cell[1]), depth, cell[2])
        found = []
        for x in (0, 1):
            for y in (0, 1):
                at = first + (x * height + y) * depth
                if self.index is not None:
                    # A word for both: of nodes that are neighbours along z, and stored, one number follows the other
                    at = dr.gather(self.types.UInt32, self.index, at, active)
                    active &= at != 0
                across = (fraction[0] if x else 1 - fraction[0]) * (fraction[1] if y else 1 - fraction[1])
                upper = across * fraction[2]
                found += [(across - upper, at), (upper, at + 1)]
        return found, active

    def skip(self, p, d, active=True):
        """A length from ``p`` along ``d`` without a cell that is looked at, or 0."""
        if self.distances is None:
            return self.types.Float(0)
        side = COARSE * self.spacing
        place, sides = [], self.far.shape
        for x, a, n in zip(p, self.lower, sides, strict=True):
            u = dr.clip(dr.floor(dr.fma(x, 1 / side, -a / side)), 0, n - 1)
            place.append(self.types.UInt32(u))
        at = dr.fma(dr.fma(place[0], sides[1], place[1]), sides[2], place[2])
        word = dr.gather(self.types.UInt32, self.distances, at >> 2, active)
        steps = (word >> ((at & 3) << 3)) & 255
        fastest = dr.maximum(dr.maximum(dr.abs(d.x), dr.abs(d.y)), dr.abs(d.z))
        # From anywhere in this cell, one less; a neighbour (1) is still worth not looking
        length = dr.maximum(self.types.Float(steps) - 1, 1e-6) * side / fastest
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
    looked at is; at most 255. uint8.
    """
    padded = np.pad(cells, [(0, -n % COARSE) for n in cells.shape])
    x, y, z = (n // COARSE for n in padded.shape)
    occupied = padded.reshape(x, COARSE, y, COARSE, z, COARSE).any(axis=(1, 3, 5))
    if not occupied.any():
        return np.full(occupied.shape, 255, np.uint8)
    return np.minimum(distance_transform_cdt(~occupied, "chessboard"), 255).astype(np.uint8)


def packed(values: np.ndarray) -> np.ndarray:
    """Bytes, four to a word of 32 bits, the lowest first."""
    flat = values.reshape(-1)
    return np.pad(flat, (0, -len(flat) % 4)).view("<u4")
