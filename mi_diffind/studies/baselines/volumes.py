"""
What learned signed distance fields are compared with: dense grids of 8 bits, and bricks of 8 bits near the surface.

Everything is in the unit frame of :mod:`mi_diffind.tasks.sdf.field`. A truth, ``distances``, has a function
``signed(points)`` of NumPy arrays, ``(N, 3)`` → ``(N,)``, and a box is that of the mesh: ``(lower, upper)``.

Distances are stored in ``2^bits`` equal steps between ± ``band``, none of which is at zero, so that no sign is lost.
What counts as bytes is all that a read needs: nodes and the index.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import drjit as dr
import numpy as np

from ...lookup import clamp
from ...tasks.sdf.field import Field

#: The eight corners of a cell, x first.
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(8, 3)


def stored(values: np.ndarray, band: float, bits: int = 8) -> np.ndarray:
    """``values`` as whole numbers, uint8; :func:`restored` undoes it."""
    half = 2 ** (bits - 1)
    return np.clip(np.floor(values * (half / band)) + half, 0, 2 * half - 1).astype(np.uint8)


def restored(nodes: np.ndarray, band: float, bits: int = 8) -> np.ndarray:
    """The distances, float32, that whole numbers stand for: the middles of the steps."""
    half = 2 ** (bits - 1)
    return (nodes.astype(np.float32) + np.float32(0.5 - half)) * np.float32(band / half)


class _Cells(Field):
    """Trilinear interpolation in equal cells, wherever their corners are stored."""

    def __init__(self, types, lower, cells, size: float, band: float, bits: int):
        self.cells, self.size, self.bits = tuple(map(int, cells)), float(size), bits
        upper = [a + n * size for a, n in zip(lower, self.cells, strict=True)]
        super().__init__(types, lower, upper, size, band)
        self.step = band / 2 ** (bits - 1)

    def _cell(self, p):
        """For each axis: the cell and the place in it, from 0 to 1."""
        found = []
        for x, a, n in zip(p, self.lower, self.cells, strict=True):
            t = clamp((x - a) / self.size, 0.0, float(n))
            i = dr.minimum(self.types.UInt32(dr.detach(t)), n - 1)
            found.append((i, t - self.types.Float(i)))
        return found

    def _corners(self, index, active):
        """The whole numbers at the corners of a cell, ``[x][y][z]``, as ``Float``."""
        raise NotImplementedError

    def _distance(self, number):
        return dr.fma(number, self.step, (0.5 - 2 ** (self.bits - 1)) * self.step)

    def value(self, p, active=True):
        active = self.inside(p) & active
        (i, u), (j, v), (k, w) = self._cell(p)
        c = self._corners((i, j, k), active)
        rows = [dr.lerp(dr.lerp(c[a][0][0], c[a][0][1], w), dr.lerp(c[a][1][0], c[a][1][1], w), v) for a in (0, 1)]
        return dr.select(active, self._distance(dr.lerp(rows[0], rows[1], u)), self.band)

    def gradient(self, p, active=True):
        active = self.inside(p) & active
        (i, u), (j, v), (k, w) = self._cell(p)
        c = self._corners((i, j, k), active)
        edges = [[dr.lerp(c[a][b][0], c[a][b][1], w) for b in (0, 1)] for a in (0, 1)]
        across = [[c[a][b][1] - c[a][b][0] for b in (0, 1)] for a in (0, 1)]
        lines = [dr.lerp(edges[a][0], edges[a][1], v) for a in (0, 1)]
        found = self.types.Array3f(
            lines[1] - lines[0],
            dr.lerp(edges[0][1] - edges[0][0], edges[1][1] - edges[1][0], u),
            dr.lerp(dr.lerp(across[0][0], across[0][1], v), dr.lerp(across[1][0], across[1][1], v), u),
        )
        value = self._distance(dr.lerp(lines[0], lines[1], u))
        return dr.select(active, value, self.band), dr.select(active, found * (self.step / self.size), 0)


def _slope(values: np.ndarray, size: float) -> float:
    """A bound of the gradient in the cells of grids ``(…, X, Y, Z)`` of distances, ``size`` apart."""
    total = 0.0
    for axis in (-3, -2, -1):
        steps = np.abs(np.diff(values, axis=axis))
        for other in {-3, -2, -1} - {axis}:
            ends = [[slice(None)] * 3, [slice(None)] * 3]
            ends[0][other], ends[1][other] = slice(1, None), slice(None, -1)
            steps = np.maximum(*(steps[(..., *e)] for e in ends))
        total = total + (steps.astype(np.float64) / size) ** 2
    return max(1.0, float(np.sqrt(np.max(total))))


# -- dense grids ------------------------------------------------------------------------------------------------------


class ByteGrid(_Cells):
    """A dense grid of ``nodes``, uint8 ``(X, Y, Z)``, the first of which is at ``lower``, ``size`` apart."""

    def __init__(self, types, nodes: np.ndarray, lower, size: float, band: float):
        super().__init__(types, lower, [n - 1 for n in nodes.shape], size, band, 8)
        self.nodes = types.UInt8(np.ascontiguousarray(nodes.ravel()))
        self.nbytes = nodes.size
        self.slope = max(_slope(restored(part, band), size) for part in _slabs(nodes))

    def _corners(self, index, active):
        i, j, k = index
        _, ny, nz = (n + 1 for n in self.cells)
        first = (i * ny + j) * nz + k

        def read(offset: int):
            return self.types.Float(dr.gather(self.types.UInt8, self.nodes, first + offset, active))

        return [[[read((a * ny + b) * nz + c) for c in (0, 1)] for b in (0, 1)] for a in (0, 1)]


def _slabs(nodes: np.ndarray, thick: int = 32):
    """Parts along the first axis that share their ends, so that little memory is needed at a time."""
    for i in range(0, nodes.shape[0] - 1, thick):
        yield nodes[i : i + thick + 1]


# -- bricks -----------------------------------------------------------------------------------------------------------


class Bricks(_Cells):
    """
    Bricks of ``side``³ cells, of which only those are stored that the surface crosses.

    ``nodes``: uint8 ``(K, n, n, n)``, the bricks in C order of their places; with ``n = side + 1`` each
    brick has all that its cells need, so that a read is one of the index; with ``n = side`` a cell at its end reads the
    bricks beyond, as in OpenVDB's trees. ``present`` and ``negative``, bool ``(X, Y, Z)``: which bricks are stored; of
    the others, which are inside.

    The index in memory: 4³ bricks are a group. 16 bits a group tell that nothing is in it and on which side it is, or
    its number; a group has two bits a brick, and the number of bricks before each 32. Nodes of less than 8 ``bits``
    lie without gaps, and are read by two bytes.
    """

    def __init__(self, types, nodes, present, negative, lower, size: float, band: float, side: int, slope: float, bits=8):
        self.side, self.apron = side, nodes.shape[1] == side + 1
        # Without an apron, the last nodes of the last bricks have nothing beyond
        cells = [side * n - (not self.apron) for n in present.shape]
        super().__init__(types, lower, cells, size, band, bits)
        padding = [(0, -n % _GROUP) for n in present.shape]
        order = np.full(present.shape, -1)
        order[present] = np.arange(len(nodes))
        present, negative, order = (
            _grouped(np.pad(v, padding, constant_values=c))
            for v, c in ((present, False), (negative & ~present, False), (order, -1))
        )
        self.grid = present.shape[:3]
        flat, inside, order = (v.reshape(-1, _GROUP**3) for v in (present, negative, order))
        # Groups of one side only are not kept
        kept = flat.any(axis=1) | (inside.any(axis=1) & ~inside.all(axis=1))
        if kept.sum() >= _INSIDE:
            raise ValueError(f"found {kept.sum():,} groups of bricks, fewer than {_INSIDE:,} are allowed")
        roots = np.where(inside[:, 0], _INSIDE, _OUTSIDE)
        roots[kept] = np.arange(kept.sum())
        words = [_words(v[kept]) for v in (flat, inside)]
        count = np.array([int(w).bit_count() for w in words[0]], np.uint32)
        ranks = np.cumsum(count, dtype=np.uint32) - count
        roots = np.pad(roots, (0, len(roots) % 2)).astype("<u2").view("<u4")
        self.roots, self.present, self.negative, self.ranks = map(types.UInt32, (roots, *words, ranks))
        nodes = nodes[order[flat]].ravel()
        self.count, self.index_bytes = int(present.sum()), 4 * (len(roots) + 3 * len(ranks))
        if bits < 8:
            nodes = np.unpackbits(nodes[:, None], axis=1, bitorder="little", count=bits)
            nodes = np.append(np.packbits(nodes.ravel(), bitorder="little"), np.uint8(0))
        self.nodes = types.UInt8(np.ascontiguousarray(nodes))
        self.nbytes, self.slope = nodes.size + self.index_bytes, slope

    def _find(self, bricks, active):
        """For the brick at a place (three arrays): whether it is stored, its number, whether it is inside if not."""
        UInt32 = self.types.UInt32
        groups = [b // _GROUP for b in bricks]
        x, y, z = (b - g * _GROUP for b, g in zip(bricks, groups, strict=True))
        bit = (x * _GROUP + y) * _GROUP + z
        x, y, z = groups
        at = (x * self.grid[1] + y) * self.grid[2] + z
        group = (dr.gather(UInt32, self.roots, at >> 1, active) >> ((at & 1) << 4)) & 0xFFFF
        mixed = active & (group < _INSIDE)
        word, bit = 2 * group + (bit >> 5), UInt32(1) << (bit & 31)
        present = dr.gather(UInt32, self.present, word, mixed)
        stored = (present & bit) != 0
        number = dr.gather(UInt32, self.ranks, word, mixed & stored) + dr.popcnt(present & (bit - 1))
        negative = (dr.gather(UInt32, self.negative, word, mixed & ~stored) & bit) != 0
        return stored, number, dr.select(mixed, negative, group == _INSIDE)

    def _read(self, found, place, active):
        """The node at a place (three arrays) in the brick that was found, or the largest number of its sign."""
        stored, number, negative = found
        x, y, z = place
        n, active = self.side + self.apron, stored & active
        at = ((number * n + x) * n + y) * n + z
        if self.bits < 8:
            at = at * self.bits
            low, high = (
                self.types.UInt32(dr.gather(self.types.UInt8, self.nodes, (at >> 3) + k, active)) for k in (0, 1)
            )
            value = ((low | (high << 8)) >> (at & 7)) & (2**self.bits - 1)
        else:
            value = dr.gather(self.types.UInt8, self.nodes, at, active)
        return dr.select(stored, self.types.Float(value), dr.select(negative, 0.0, 2.0**self.bits - 1))

    def _corners(self, index, active):
        return self._stored_corners(index, active)[0]

    def _stored_corners(self, index, active):
        """The corners, and whether all of them are stored."""
        bricks = [i // self.side for i in index]
        local = [i - b * self.side for i, b in zip(index, bricks, strict=True)]
        if self.apron:
            found = self._find(bricks, active)
            x, y, z = local
            corners = [[[self._read(found, (x + a, y + b, z + c), active) for c in (0, 1)] for b in (0, 1)]
                       for a in (0, 1)]  # fmt: skip
            return corners, found[0]
        # The brick and the place in it of the lower and of the upper node along each axis
        ends = []
        for b, i in zip(bricks, local, strict=True):
            over = i == self.side - 1
            ends.append(((b, i), (b + dr.select(over, self.types.UInt32(1), 0), dr.select(over, 0, i + 1))))
        corners, stored = [], self.types.Bool(True)
        for x, y, z in itertools.product(*ends):
            found = self._find((x[0], y[0], z[0]), active)
            corners.append(self._read(found, (x[1], y[1], z[1]), active))
            stored &= found[0]
        return [[corners[4 * a + 2 * b : 4 * a + 2 * b + 2] for b in (0, 1)] for a in (0, 1)], stored

    def look(self, p, d, active=True):
        active = self.inside(p) & active
        cell = self._cell(p)
        index = [i for i, _ in cell]
        c, stored = self._stored_corners(index, active)
        u, v, w = (weight for _, weight in cell)
        rows = [dr.lerp(dr.lerp(c[a][0][0], c[a][0][1], w), dr.lerp(c[a][1][0], c[a][1][1], w), v) for a in (0, 1)]
        value = dr.select(active, self._distance(dr.lerp(rows[0], rows[1], u)), self.band)
        bricks = [i // self.side for i in index]
        leave = self.cell_exit(p, d, bricks, self.side * self.size)
        # The bound of the slope holds where all corners are stored, so not beyond this brick
        step = dr.select(stored, dr.minimum(dr.abs(value) / self.slope, leave), leave)
        if not self.apron:
            base = self._find(bricks, active)[0]
            step = dr.select(base & ~stored, self.cell_exit(p, d, index, self.size), step)
        return value, step


#: Bricks of a side of a group; what stands for the number of a group that is inside or outside as a whole.
_GROUP, _INSIDE, _OUTSIDE = 4, 0xFFFE, 0xFFFF


def _grouped(values: np.ndarray) -> np.ndarray:
    """``(X, Y, Z)`` → groups and places in them, ``(X / 4, Y / 4, Z / 4, 4, 4, 4)``."""
    x, y, z = (n // _GROUP for n in values.shape)
    return values.reshape(x, _GROUP, y, _GROUP, z, _GROUP).transpose(0, 2, 4, 1, 3, 5)


def _words(flags: np.ndarray) -> np.ndarray:
    """Flags as words of 32 bits, the first flag in the lowest bit."""
    packed = np.packbits(flags.ravel(), bitorder="little")
    return np.pad(packed, (0, -len(packed) % 4)).view("<u4").astype(np.uint32)


def bricks_near(signed: Callable, lower, shape, side: float, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """
    Of a grid of ``shape`` bricks, ``side`` long: the places ``(K, 3)`` of those that the surface may pass, or that it
    may come nearer to than ``margin``, and which of all bricks have a centre inside (bool, ``shape``).
    """
    lower, coarse = np.asarray(lower, np.float64), 8
    number = [-(-n // coarse) for n in shape]
    found, negative = _places(number), np.zeros([n * coarse for n in number], bool)
    while True:
        length = side * coarse
        d = signed(lower + (found + 0.5) * length)
        parts = (found[:, None] * coarse + _places((coarse,) * 3)).reshape(-1, 3)
        negative[tuple(parts.T)] = np.repeat(d < 0, coarse**3)
        found = found[np.abs(d) <= length * math.sqrt(3) / 2 + margin]
        if coarse == 1:
            break
        coarse //= 2
        found = (2 * found[:, None] + CORNERS).reshape(-1, 3)
    found = found[(found < shape).all(axis=1)]
    return found[np.ravel_multi_index(found.T, shape).argsort()], negative[tuple(map(slice, shape))]


def _places(shape) -> np.ndarray:
    """All places of a grid, ``(N, 3)``, in C order."""
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)


def sampled_bricks(
    types, distances, box, size: float, side: int, apron: bool = True, band: float = 0.0, bits: int = 8
) -> Bricks:
    """
    Exact distances at the nodes of all bricks that have a cell with corners of both signs (without an ``apron``, of all
    that have a corner of such a cell). ``band`` is in cells; 0: all that a brick can have at its corners.
    """
    lower, upper = (np.asarray(v, np.float64) for v in box)
    grid = np.ceil((upper - lower) / (side * size) + (1 if apron else 3) / side).astype(int)
    lower = (lower + upper) / 2 - (grid * side - (not apron)) * size / 2
    n, shape = side + 1, grid * side + 1
    places, negative = bricks_near(distances.signed, lower, grid, side * size, 0 if apron else 2 * size)
    nodes = (places[:, None] * side + _places((n,) * 3)).reshape(-1, 3)
    unique, back = np.unique(np.ravel_multi_index(nodes.T, shape), return_inverse=True)
    values = distances.signed(lower + np.stack(np.unravel_index(unique, shape), -1) * size)
    bricks = values[back].reshape(-1, n, n, n)
    negative[tuple(places.T)] = bricks[:, 0, 0, 0] < 0  # what is not stored has one sign, which its nodes know
    band = (band or side * math.sqrt(3)) * size
    present = np.zeros(grid, bool)
    for part in np.array_split(np.arange(len(places)), max(1, bricks.size // 2**22)):
        windows = np.lib.stride_tricks.sliding_window_view(bricks[part] < 0, (2, 2, 2), axis=(1, 2, 3))
        crossed = windows.any(axis=(4, 5, 6)) & ~windows.all(axis=(4, 5, 6))
        for corner in CORNERS[:1] if apron else CORNERS:
            ends = crossed[(slice(None), *(slice(side - 1, None) if c else slice(None) for c in corner))]
            present[tuple((places[part][ends.any(axis=(1, 2, 3))] + corner).T)] = True
    kept = bricks[present[tuple(places.T)]]
    if len(kept) != present.sum():
        raise AssertionError("a brick is read that the surface does not pass")
    numbers = stored(kept, band, bits)
    slope = max((_slope(restored(b, band, bits), size) for b in _parts(numbers)), default=1.0)
    return Bricks(types, numbers if apron else numbers[:, :side, :side, :side], present, negative, lower, size, band,
                  side, slope, bits)  # fmt: skip


def _parts(values: np.ndarray, most: int = 2**21):
    """Parts along the first axis of so many numbers."""
    yield from np.array_split(values, max(1, values.size // most))


def at_bytes(make: Callable[[float], Field], nbytes: int, size: float, power: float = 2.0, builds: int = 6) -> Field:
    """
    The field ``make(size)`` with the finest cells that fits into ``nbytes``, within 1%: ``size`` is where the search
    starts, bytes go about with ``size`` to the power of -``power``. Raises ``ValueError`` if nothing fits.
    """
    best, wanted = None, 0.995
    for _ in range(builds):
        found = make(size)
        if found.nbytes <= nbytes and (best is None or found.nbytes > best.nbytes):
            best = found
        if best is not None and best.nbytes >= 0.99 * nbytes:
            break
        size *= (found.nbytes / (wanted * nbytes)) ** (1 / power)
    if best is None:
        raise ValueError(f"{nbytes:,} bytes are too few: {found.nbytes:,} are the least that was found")
    return best
