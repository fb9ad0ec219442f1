"""
What learned signed distance fields are compared with: dense grids of 8 bits, and bricks of 8 bits near the surface.

Everything is in the unit frame of :mod:`mi_diffind.tasks.sdf.field`.

Distances are stored in ``2^bits`` equal steps between ± ``band``, none of which is at zero, so that no sign is lost.
What counts as bytes is all that a read needs: nodes and the index.
"""

from __future__ import annotations

import dataclasses
import io
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import numpy as np

from ...files import replacing
from ...lookup import clamp
from ...tasks.sdf import codes
from ...tasks.sdf.distances import Distances
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.mesh import Mesh
from ...tasks.sdf.nodes import SparseNodes, middles
from ...tasks.sdf.sampling import CORNERS, surface_cells
from ...tasks.sdf.structure import Structure

#: Components of a direction below this count as zero.
TINY = 1e-12

#: No corner of a cell that the surface crosses is further from it than this, in cells.
NEAREST = 1.75


def stored(values: np.ndarray, band: float, bits: int = 8) -> np.ndarray:
    """``values`` as whole numbers, uint8; :func:`restored` undoes it."""
    half = 2 ** (bits - 1)
    return np.clip(np.floor(values * (half / band)) + half, 0, 2 * half - 1).astype(np.uint8)


def restored(nodes: np.ndarray, band: float, bits: int = 8) -> np.ndarray:
    """The distances, float32, that whole numbers stand for: the middles of the steps."""
    half = 2 ** (bits - 1)
    return (nodes.astype(np.float32) + np.float32(0.5 - half)) * np.float32(band / half)


class _Cells(DistanceField):
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
        self.state = {"nodes": nodes, "lower": np.array(lower), "size": size, "band": band}
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


def dense(types, distances: Distances, size: float, train: Training | None = None, band: float = NEAREST) -> ByteGrid:
    """A dense grid of cells ``size`` wide with exact distances at its nodes, or with nodes that ``train``."""
    lower, upper = distances.mesh.lower, distances.mesh.upper
    cells = _dense_cells(distances.mesh, size)
    lower, shape = (lower + upper) / 2 - cells * size / 2, cells + 1
    values = distances.signed(lower + _places(shape) * size, 3 * size)
    if train is not None:
        values = trained(distances, lower, size, shape, np.arange(len(values)), values, train)
    return ByteGrid(types, stored(values.reshape(shape), band * size), lower, size, band * size)


def _dense_cells(mesh: Mesh, size: float) -> np.ndarray:
    return np.ceil((mesh.upper - mesh.lower) / size + 1).astype(int)


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

    def __init__(
        self, types, nodes, present, negative, lower, size: float, band: float, side: int, slope: float, bits: int = 8
    ):
        self.state = {
            "nodes": nodes, "present": present, "negative": negative, "lower": np.array(lower), "size": size,
            "band": band, "side": side, "slope": slope, "bits": bits,
        }  # fmt: skip
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
        """
        For the brick at a place (three arrays): whether it is stored, its number, whether it is inside if not, and
        whether its group has any.
        """
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
        return stored, number, dr.select(mixed, negative, group == _INSIDE), mixed

    def _read(self, found, place, active):
        """The node at a place (three arrays) in the brick that was found, or the largest number of its sign."""
        stored, number, negative, _ = found
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

    def _exit(self, p, d, index, size):
        """
        How far it is from ``p`` in the direction ``d`` to the side of the cell with the whole-numbered position
        ``index`` (three arrays) in a grid of cells of the side ``size``; a hair beyond it.
        """
        nearest = self.types.Float(math.inf)
        for x, v, i, a in zip(p, d, index, self.lower, strict=True):
            side = dr.fma(self.types.Float(i) + dr.select(v > 0, 1, 0), size, a)
            t = (side - x) / dr.select(dr.abs(v) > TINY, v, TINY)
            nearest = dr.minimum(nearest, dr.select(dr.abs(v) > TINY, t, math.inf))
        nearest = dr.select(dr.isfinite(nearest), nearest, 0)
        return dr.maximum(nearest, 0) + 1e-3 * self.spacing

    def safe_step(self, p, d, active=True):
        active = self.inside(p) & active
        cell = self._cell(p)
        index = [i for i, _ in cell]
        c, stored = self._stored_corners(index, active)
        u, v, w = (weight for _, weight in cell)
        rows = [dr.lerp(dr.lerp(c[a][0][0], c[a][0][1], w), dr.lerp(c[a][1][0], c[a][1][1], w), v) for a in (0, 1)]
        value = dr.select(active, self._distance(dr.lerp(rows[0], rows[1], u)), self.band)
        bricks = [i // self.side for i in index]
        base, _, _, mixed = self._find(bricks, active)
        wide = dr.select(mixed, self.side * self.size, _GROUP * self.side * self.size)
        leave = self._exit(p, d, [dr.select(mixed, b, b // _GROUP) for b in bricks], wide)
        # The bound of the slope holds where all corners are stored, so not beyond this brick
        step = dr.select(stored, dr.minimum(dr.abs(value) / self.slope, leave), leave)
        if not self.apron:
            step = dr.select(base & ~stored, self._exit(p, d, index, self.size), step)
        return value, step


#: Sides of cells, of the longest side: where the search for a size begins, and its limits.
FIRST, FINEST, COARSEST = 1 / 64, 1 / 2048, 1 / 12

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


def bricks(
    types,
    distances: Distances,
    size: float,
    side: int,
    apron: bool = True,
    train: Training | None = None,
    band: float = NEAREST,
    bits: int = 8,
) -> Bricks:
    """
    The bricks of ``side``³ cells, ``size`` wide, that have a cell with corners of both signs (without an ``apron``, all
    that have a corner of such a cell). ``band`` is in cells. Nodes hold exact distances, or they ``train``.
    """
    lower, upper = distances.mesh.lower, distances.mesh.upper
    grid = np.ceil((upper - lower) / (side * size) + (1 if apron else 3) / side).astype(int)
    lower = (lower + upper) / 2 - (grid * side - (not apron)) * size / 2
    n, shape = side + 1, grid * side + 1
    places = surface_cells(distances, lower, side * size, grid, 0 if apron else 2 * size)
    nodes = (places[:, None] * side + _places((n,) * 3)).reshape(-1, 3)
    keys, back = np.unique(np.ravel_multi_index(nodes.T, shape), return_inverse=True)
    values = distances.signed(lower + np.stack(np.unravel_index(keys, shape), -1) * size, 3 * size)
    if train is not None:
        values = trained(distances, lower, size, shape, keys, values, train)
    values = values[back].reshape(-1, n, n, n)
    present = np.zeros(grid, bool)
    for part in np.array_split(np.arange(len(places)), max(1, values.size // 2**22)):
        windows = np.lib.stride_tricks.sliding_window_view(values[part] < 0, (2, 2, 2), axis=(1, 2, 3))
        crossed = windows.any(axis=(4, 5, 6)) & ~windows.all(axis=(4, 5, 6))
        for corner in CORNERS[:1] if apron else CORNERS:
            ends = crossed[(slice(None), *(slice(side - 1, None) if c else slice(None) for c in corner))]
            present[tuple((places[part][ends.any(axis=(1, 2, 3))] + corner).T)] = True
    near = np.zeros(grid, bool)
    near[tuple(places.T)] = True
    if (present & ~near).any():
        raise AssertionError("a brick would be read that is not near the surface")
    negative = _sides(distances, lower, side * size, ~near)
    negative[tuple(places.T)] = values[:, 0, 0, 0] < 0  # what is not stored has one sign, which its nodes know
    numbers = stored(values[present[tuple(places.T)]], band * size, bits)
    slope = max((_slope(restored(b, band * size, bits), size) for b in _parts(numbers)), default=1.0)
    numbers = numbers if apron else numbers[:, :side, :side, :side]
    return Bricks(types, numbers, present, negative, lower, size, band * size, side, slope, bits)


def _sides(distances: Distances, lower, side: float, empty: np.ndarray) -> np.ndarray:
    """Of a grid of bricks, which of those are inside that the surface does not pass: one question each piece."""
    from scipy import ndimage

    pieces, count = ndimage.label(empty)
    _, first = np.unique(pieces.ravel(), return_index=True)
    first = first[pieces.ravel()[first] > 0]
    centres = lower + (np.stack(np.unravel_index(first, empty.shape), -1) + 0.5) * side
    inside = np.zeros(count + 1, bool)
    inside[pieces.ravel()[first]] = distances.inside(centres)
    return inside[pieces]


def _places(shape) -> np.ndarray:
    """All places of a grid, ``(N, 3)``, in C order."""
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)


def _parts(values: np.ndarray, most: int = 2**21):
    """Parts along the first axis of so many numbers."""
    yield from np.array_split(values, max(1, values.size // most))


# -- training ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Training:
    """
    Nodes by linear least squares: ``samples`` a cell, of distances and, with the weight ``normals``, of their gradients
    times the size of a cell; those at the distance of ``focus`` cells weigh half; ``keep`` is the weight of the
    distance that was sampled at a node. ``most`` limits the samples of all cells. It is the exact minimum: there is no
    rate, no schedule, and no batch.
    """

    samples: int = 16
    most: int = 2**21
    normals: float = 0.2
    focus: float = 0.5
    keep: float = 0.03
    seed: int = 1


def trained(distances: Distances, lower, size: float, shape, keys, values, how: Training) -> np.ndarray:
    """
    The ``values`` of the nodes ``keys`` (places in a grid of ``shape`` nodes, C order, ascending) with those changed
    that belong to a cell which the surface passes and which has all of its nodes, such that trilinear interpolation
    comes nearest to the truth there.
    """
    from scipy import sparse
    from scipy.sparse.linalg import cg

    rng = np.random.default_rng(how.seed)
    cells = surface_cells(distances, lower, size, np.asarray(shape) - 1)
    corners = np.ravel_multi_index((cells[:, None] + CORNERS).reshape(-1, 3).T, shape)
    at = np.minimum(np.searchsorted(keys, corners), len(keys) - 1)
    whole = (keys[at] == corners).reshape(-1, 8).all(axis=1)
    cells, corners = cells[whole], at.reshape(-1, 8)[whole]
    each = int(np.clip(how.most / max(1, len(cells)), 4, how.samples))
    blocks, right = np.empty((len(cells), 8, 8), np.float32), np.empty((len(cells), 8), np.float32)
    for part in np.array_split(np.arange(len(cells)), max(1, len(cells) * each // 2**18)):
        place = rng.random((len(part), each, 3))
        d, g = distances.signed_normals((lower + (cells[part][:, None] + place) * size).reshape(-1, 3))
        # Per sample a row for the distance, in cells, and three for the gradient
        ends = np.where(CORNERS == 1, place[..., None, :], 1 - place[..., None, :])
        signs = 2.0 * CORNERS - 1
        rows = [ends.prod(-1), *(ends[..., np.delete(np.arange(3), a)].prod(-1) * signs[:, a] for a in range(3))]
        known = np.concatenate([d[:, None] / size, g], axis=1).reshape(len(part), each, 4)
        weight = 1 / (1 + (known[..., :1] / how.focus) ** 2) * np.array([1, *[how.normals**2] * 3])
        rows = np.stack(rows, -2)
        weighted = rows * weight[..., None]
        blocks[part] = np.einsum("nsrc,nsrd->ncd", weighted, rows, optimize=True)
        right[part] = np.einsum("nsrc,nsr->nc", weighted, known, optimize=True)
    used, at = np.unique(corners, return_inverse=True)
    at = at.reshape(-1, 8)
    start, keep = values[used].astype(np.float64) / size, how.keep * each
    places = np.repeat(at, 8, axis=1).ravel(), np.tile(at, (1, 8)).ravel()
    matrix = sparse.coo_array((blocks.ravel(), places), (len(used),) * 2).tocsr().astype(np.float64)
    matrix += sparse.diags_array(np.full(len(used), keep))
    wanted = np.bincount(at.ravel(), right.ravel(), len(used)) + keep * start
    found, _ = cg(matrix, wanted, start, rtol=1e-4, maxiter=200)
    result = values.copy()
    result[used] = found * size
    return result


# -- nodes ------------------------------------------------------------------------------------------------------------


class DistanceNodes(SparseNodes):
    """
    Distances alone at the nodes of a sparse ``structure``, ``bits`` each, in the order of its nodes: what is left of
    ours without normals and without indirection.
    """

    def __init__(self, types, structure: Structure, numbers: np.ndarray, band: float, bits: int, slope: float):
        super().__init__(types, structure, slope, pointers=codes.pointer_words(numbers, bits), bits=bits)
        self.state = {"numbers": numbers, "band": band, "bits": bits, "slope": slope}
        self.state |= {f"structure_{f.name}": getattr(structure, f.name) for f in dataclasses.fields(structure)}
        self.told, self.kept = band / self.spacing, 4 * len(codes.pointer_words(numbers, bits))

    def _node(self, number, record, i, j, k, active):
        value = self.types.Float(codes.pointer_at(self._pointers, number, self.bits, active))
        half = 2 ** (self.bits - 1)
        zero = self.types.Float(0)
        return (value + (0.5 - half)) * (self.told / half), (zero, zero, zero)

    def normal(self, p, active=True):
        return self.gradient(p, active)[1]

    def decoded(self) -> np.ndarray:
        distances = restored(self.state["numbers"], self.told, self.bits)
        return np.stack([distances, *[np.zeros_like(distances)] * 3], axis=1)

    def frames(self) -> np.ndarray:
        """Of each block the plane that is nearest to the distances of its nodes: rays know where it may end."""
        positions, block = self.structure.node_positions()
        ones = np.ones((len(positions), 1))
        terms = np.concatenate([ones, middles(positions)], axis=1)
        told = np.concatenate([terms, self.decoded()[:, :1]], axis=1)
        sums = np.zeros((self.structure.blocks, 4, 5))
        np.add.at(sums, block, terms[:, :, None] * told[:, None])
        found = np.linalg.solve(sums[..., :4] + 1e-3 * np.eye(4), sums[..., 4:])[..., 0]
        length = np.linalg.norm(found[:, 1:], axis=1, keepdims=True)
        normals = np.where(length > 0, found[:, 1:] / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
        return codes.frame_words(normals, found[:, 0], np.ones(len(found)))

    @property
    def nbytes(self) -> int:
        return self.structure.nbytes + self.kept


def distance_nodes(
    types, distances: Distances, size: float, train: Training | None = None, band: float = NEAREST, bits: int = 6
) -> DistanceNodes:
    """The corners of all cells, ``size`` wide, with corners of both signs: exact distances, or nodes that ``train``."""
    from ...tasks.sdf.encoding import sample

    found = sample(distances, size)
    structure = found.structure
    keys = np.ravel_multi_index(found.positions.astype(np.int64).T, structure.shape)
    order = np.argsort(keys)
    values = found.distances * size
    if train is not None:
        # All cells that the surface passes have a part; signs stay, since they say which nodes there are
        lower = np.asarray(structure.lower)
        new = trained(distances, lower, size, structure.shape, keys[order], values[order], train)
        least = 0.5 * band * size / 2 ** (bits - 1)
        new = np.where(values[order] < 0, np.minimum(new, -least), np.maximum(new, least))
        values[order] = new
    numbers = stored(values, band * size, bits)
    corners = restored(numbers, band * size, bits)[found.corners].reshape(-1, 2, 2, 2)
    slope = max(_slope(part, size) for part in _parts(corners))
    return DistanceNodes(types, structure, numbers, band * size, bits, slope)


# -- files ------------------------------------------------------------------------------------------------------------


def save(path: Path | str, field: DistanceField) -> None:
    """Write a field with a ``state``, the arguments of its class beside ``types``, which :func:`load` reads."""
    with replacing(path) as temporary:
        temporary.write_bytes(_packed(field))


def load(path: Path | str, types, *more: type[DistanceField]) -> DistanceField:
    """What :func:`save` wrote, of one of these classes or of ``more``, for the module ``types``."""
    with np.load(path, allow_pickle=False) as file:
        state = {name: file[name] if file[name].ndim else file[name].item() for name in file}
    kind = {c.__name__: c for c in (ByteGrid, Bricks, DistanceNodes, *more)}[state.pop("kind")]
    parts = {name: state.pop(name) for name in list(state) if name.startswith("structure_")}
    if parts:
        parts = {name.removeprefix("structure_"): v for name, v in parts.items()}
        state["structure"] = Structure(**{**parts, "lower": tuple(parts["lower"].tolist())})
    return kind(types, **state)


def file_bytes(field: DistanceField) -> int:
    """How large the file is, whose arrays are compressed (zlib)."""
    return len(_packed(field))


def _packed(field) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, kind=type(field).__name__, **field.state)
    return file.getvalue()


# -- sizes ------------------------------------------------------------------------------------------------------------


def fitted(make: Callable[[float], DistanceField], nbytes: int) -> DistanceField:
    """
    The field ``make(size)`` with the finest cells that fits into ``nbytes``, within 1.5% if that is soon found.
    Raises ``ValueError`` if nothing fits.
    """
    size, power, before, best = FIRST, 2.0, None, None
    for attempt in range(8):
        found = make(size)
        if found.nbytes <= nbytes and (best is None or found.nbytes > best.nbytes):
            best = found
        if best is not None and best.nbytes >= (0.985 if attempt < 3 else 0.97) * nbytes:
            break
        if before is not None and found.nbytes != before[1]:
            power = math.log(found.nbytes / before[1]) / math.log(before[0] / size)
        before = size, found.nbytes
        # How bytes grow shows at a quarter of them already, which takes a quarter of the time
        aim = 0.25 if attempt == 0 and found.nbytes < nbytes / 8 else 0.993
        size *= (found.nbytes / (aim * nbytes)) ** (1 / np.clip(power, 1.5, 3.0))
        size = float(np.clip(size, FINEST, COARSEST))
        if size == before[0]:
            break
    if best is None:
        raise ValueError(f"{nbytes:,} bytes are too few: {found.nbytes:,} are the least that was found")
    return best


def dense_size(mesh: Mesh, nbytes: int) -> float:
    """The side of the cells of the finest :func:`dense` grid of ``nbytes``."""
    low, high = 1e-4, 1.0
    for _ in range(40):
        size = math.sqrt(low * high)
        fits = np.prod(_dense_cells(mesh, size) + 1.0) <= nbytes
        low, high = (low, size) if fits else (size, high)
    return high
