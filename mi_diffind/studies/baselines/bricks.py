"""Bricks of 8-bit signed distances near the surface, with an index of groups, as OpenVDB's trees hold them."""

from __future__ import annotations

import itertools
import math

import drjit as dr
import numpy as np

from ...arrays.lookup import mask_words
from ...arrays.sparse_grid import CORNERS
from ...tasks.sdf.distances import Distances
from ...tasks.sdf.sampling import surface_cells
from .byte_grids import NEAREST, ByteCells, dequantised, places, quantised, slope_bound

#: Components of a direction below this count as zero.
TINY = 1e-12

#: Bricks along a side of a group; the entries of the index for groups without bricks that are inside or outside.
GROUP, INSIDE, OUTSIDE = 4, 0xFFFE, 0xFFFF


class Bricks(ByteCells):
    """Bricks of ``side``³ cells; only those that the surface crosses are stored.

    ``nodes``: uint8 ``(K, n, n, n)``, the bricks in C order of their places. With ``n = side + 1`` each brick has an
    *apron*, all that its cells need, so that a read asks the index once. With ``n = side`` a cell at the end of a brick
    reads the bricks beyond, as in OpenVDB's trees. ``present`` and ``negative``, bool ``(X, Y, Z)``: the stored bricks,
    and those of the others that are inside.

    The index in memory: 4³ bricks are a group. A group has an entry of 16 bits, its number, or that it has no bricks
    and lies inside or outside. A numbered group has two bits a brick, and the number of bricks before each 32.
    """

    def __init__(self, types, nodes, present, negative, lower, spacing: float, band: float, side: int, slope: float):
        self.state = {
            "nodes": nodes, "present": present, "negative": negative, "lower": np.array(lower), "spacing": spacing,
            "band": band, "side": side, "slope": slope,
        }  # fmt: skip
        self.side, self.apron = side, nodes.shape[1] == side + 1
        # Without an apron, the last nodes of the last bricks have nothing beyond
        cells = [side * n - (not self.apron) for n in present.shape]
        super().__init__(types, lower, cells, spacing, band)
        padding = [(0, -n % GROUP) for n in present.shape]
        order = np.full(present.shape, -1)
        order[present] = np.arange(len(nodes))
        present, negative, order = (
            _grouped(np.pad(v, padding, constant_values=c))
            for v, c in ((present, False), (negative & ~present, False), (order, -1))
        )
        self.grid = present.shape[:3]
        present, inside, order = (v.reshape(-1, GROUP**3) for v in (present, negative, order))
        # Groups of one side only have no number
        numbered = present.any(axis=1) | (inside.any(axis=1) & ~inside.all(axis=1))
        if numbered.sum() >= INSIDE:
            raise ValueError(f"found {numbered.sum():,} groups of bricks, fewer than {INSIDE:,} are allowed")
        roots = np.where(inside[:, 0], INSIDE, OUTSIDE)
        roots[numbered] = np.arange(numbered.sum())
        words = [mask_words(v[numbered]).ravel() for v in (present, inside)]
        count = np.array([int(w).bit_count() for w in words[0]], np.uint32)
        ranks = np.cumsum(count, dtype=np.uint32) - count
        roots = np.pad(roots, (0, len(roots) % 2)).astype("<u2").view("<u4")
        self.roots, self.present, self.negative, self.ranks = map(types.UInt32, (roots, *words, ranks))
        self.nodes = types.UInt8(np.ascontiguousarray(nodes[order[present]].ravel()))
        self.count, self.index_bytes = len(nodes), 4 * (len(roots) + 3 * len(ranks))
        self.nbytes, self.slope = nodes.size + self.index_bytes, slope

    def _find(self, bricks, active):
        """Look up the bricks at places (three arrays) in the index.

        Returns whether a brick is stored, its number, whether it is inside if it is not stored, and whether its group
        has a number.
        """
        UInt32 = self.types.UInt32
        groups = [b // GROUP for b in bricks]
        x, y, z = (b - g * GROUP for b, g in zip(bricks, groups, strict=True))
        bit = (x * GROUP + y) * GROUP + z
        x, y, z = groups
        at = (x * self.grid[1] + y) * self.grid[2] + z
        group = (dr.gather(UInt32, self.roots, at >> 1, active) >> ((at & 1) << 4)) & 0xFFFF
        mixed = active & (group < INSIDE)
        word, bit = 2 * group + (bit >> 5), UInt32(1) << (bit & 31)
        present = dr.gather(UInt32, self.present, word, mixed)
        stored = (present & bit) != 0
        number = dr.gather(UInt32, self.ranks, word, mixed & stored) + dr.popcnt(present & (bit - 1))
        negative = (dr.gather(UInt32, self.negative, word, mixed & ~stored) & bit) != 0
        return stored, number, dr.select(mixed, negative, group == INSIDE), mixed

    def _read(self, brick, place, active):
        """Return the node at a place (three arrays) in a brick of :meth:`_find`, or the largest step of its sign."""
        stored, number, negative, _ = brick
        x, y, z = place
        n, active = self.side + self.apron, stored & active
        value = dr.gather(self.types.UInt8, self.nodes, ((number * n + x) * n + y) * n + z, active)
        return dr.select(stored, self.types.Float(value), dr.select(negative, 0.0, 255.0))

    def _corners(self, index, active):
        return self._stored_corners(index, active)[0]

    def _stored_corners(self, index, active):
        """Return the corners of a cell, and whether all of them are stored."""
        bricks = [i // self.side for i in index]
        local = [i - b * self.side for i, b in zip(index, bricks, strict=True)]
        if self.apron:
            brick = self._find(bricks, active)
            x, y, z = local
            corners = [[[self._read(brick, (x + a, y + b, z + c), active) for c in (0, 1)] for b in (0, 1)]
                       for a in (0, 1)]  # fmt: skip
            return corners, brick[0]
        # The brick and the place in it of the lower and of the upper node along each axis
        ends = []
        for b, i in zip(bricks, local, strict=True):
            over = i == self.side - 1
            ends.append(((b, i), (b + dr.select(over, self.types.UInt32(1), 0), dr.select(over, 0, i + 1))))
        corners, stored = [], self.types.Bool(True)
        for x, y, z in itertools.product(*ends):
            brick = self._find((x[0], y[0], z[0]), active)
            corners.append(self._read(brick, (x[1], y[1], z[1]), active))
            stored &= brick[0]
        return [[corners[4 * a + 2 * b : 4 * a + 2 * b + 2] for b in (0, 1)] for a in (0, 1)], stored

    def _exit(self, p, d, index, side):
        """Return the length of rays from ``p`` to a hair beyond the box ``index`` of a grid of boxes, ``side`` wide."""
        nearest = self.types.Float(math.inf)
        for x, v, i, a in zip(p, d, index, self.lower, strict=True):
            wall = dr.fma(self.types.Float(i) + dr.select(v > 0, 1, 0), side, a)
            t = (wall - x) / dr.select(dr.abs(v) > TINY, v, TINY)
            nearest = dr.minimum(nearest, dr.select(dr.abs(v) > TINY, t, math.inf))
        nearest = dr.select(dr.isfinite(nearest), nearest, 0)
        return dr.maximum(nearest, 0) + 1e-3 * self.spacing

    def safe_step(self, p, d, active=True):
        active = self.inside(p) & active
        index, weights = zip(*self._cell(p), strict=True)
        corners, stored = self._stored_corners(index, active)
        value = dr.select(active, self._interpolated(corners, weights), self.band)
        bricks = [i // self.side for i in index]
        base, _, _, mixed = self._find(bricks, active)
        side = dr.select(mixed, self.side * self.spacing, GROUP * self.side * self.spacing)
        leave = self._exit(p, d, [dr.select(mixed, b, b // GROUP) for b in bricks], side)
        # The bound of the slope holds where all corners are stored, so not beyond this brick
        step = dr.select(stored, dr.minimum(dr.abs(value) / self.slope, leave), leave)
        if not self.apron:
            step = dr.select(base & ~stored, self._exit(p, d, index, self.spacing), step)
        return value, step


def _grouped(values: np.ndarray) -> np.ndarray:
    """Return groups and places in them, ``(X / 4, Y / 4, Z / 4, 4, 4, 4)``, of an array ``(X, Y, Z)``."""
    x, y, z = (n // GROUP for n in values.shape)
    return values.reshape(x, GROUP, y, GROUP, z, GROUP).transpose(0, 2, 4, 1, 3, 5)


def bricks(types, distances: Distances, spacing: float, side: int, apron: bool = True) -> Bricks:
    """Return the bricks of ``side``³ cells that have a cell with corners of both signs, with exact distances.

    Without an ``apron``, all bricks are stored that have a corner of such a cell.
    """
    lower, upper = distances.mesh.lower, distances.mesh.upper
    grid = np.ceil((upper - lower) / (side * spacing) + (1 if apron else 3) / side).astype(int)
    lower = (lower + upper) / 2 - (grid * side - (not apron)) * spacing / 2
    n, shape, band = side + 1, grid * side + 1, NEAREST * spacing
    near_bricks = surface_cells(distances, lower, side * spacing, grid, 0 if apron else 2 * spacing)
    nodes = (near_bricks[:, None] * side + places((n,) * 3)).reshape(-1, 3)
    keys, back = np.unique(np.ravel_multi_index(nodes.T, shape), return_inverse=True)
    values = distances.signed(lower + np.stack(np.unravel_index(keys, shape), -1) * spacing, 3 * spacing)
    values = values[back].reshape(-1, n, n, n)
    present = np.zeros(grid, bool)
    for part in np.array_split(np.arange(len(near_bricks)), max(1, values.size // 2**22)):
        windows = np.lib.stride_tricks.sliding_window_view(values[part] < 0, (2, 2, 2), axis=(1, 2, 3))
        crossed = windows.any(axis=(4, 5, 6)) & ~windows.all(axis=(4, 5, 6))
        for corner in CORNERS[:1] if apron else CORNERS:
            ends = crossed[(slice(None), *(slice(side - 1, None) if c else slice(None) for c in corner))]
            present[tuple((near_bricks[part][ends.any(axis=(1, 2, 3))] + corner).T)] = True
    near = np.zeros(grid, bool)
    near[tuple(near_bricks.T)] = True
    negative = _inside(distances, lower, side * spacing, ~near)
    # A brick near the surface that is not stored has one sign, that of any of its nodes
    negative[tuple(near_bricks.T)] = values[:, 0, 0, 0] < 0
    codes = quantised(values[present[tuple(near_bricks.T)]], band)
    parts = np.array_split(codes, max(1, codes.size // 2**21))
    slope = max((slope_bound(dequantised(part, band), spacing) for part in parts), default=1.0)
    codes = codes if apron else codes[:, :side, :side, :side]
    return Bricks(types, codes, present, negative, lower, spacing, band, side, slope)


def _inside(distances: Distances, lower, side: float, empty: np.ndarray) -> np.ndarray:
    """Return the ``empty`` bricks of a grid that are inside; one point is asked for in each connected piece."""
    from scipy import ndimage

    pieces, count = ndimage.label(empty)
    _, first = np.unique(pieces.ravel(), return_index=True)
    first = first[pieces.ravel()[first] > 0]
    centres = lower + (np.stack(np.unravel_index(first, empty.shape), -1) + 0.5) * side
    inside = np.zeros(count + 1, bool)
    inside[pieces.ravel()[first]] = distances.inside(centres)
    return inside[pieces]
