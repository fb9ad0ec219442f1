"""Signed distances of 8 bits in equal cells: dense grids; interpolation and training shared with bricks.

Everything is in the unit frame of :mod:`mi_diffind.tasks.sdf.field`. Distances are stored in ``2^bits`` equal steps
between ± ``band``; no step has its middle at zero, so no sign is lost. Bytes are those of all that a read needs: nodes
and index.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from ...arrays.lookup import clamp
from ...arrays.sparse_grid import CORNERS
from ...core.units import largest_fitting
from ...tasks.sdf.distances import Distances
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.mesh import Mesh
from ...tasks.sdf.sampling import surface_cells

#: Largest distance, in cells, between the surface and a corner of a cell that the surface crosses.
NEAREST = 1.75

#: Training of nodes: samples a cell and in all, weight of gradients (times the side of a cell), distance from the
#: surface (in cells) at which a sample weighs half, and weight of the distance that was sampled at a node.
SAMPLES, MOST_SAMPLES, GRADIENT_WEIGHT, FOCUS, KEEP = 16, 2**21, 0.2, 0.5, 0.03


def quantised(values: np.ndarray, band: float, bits: int = 8) -> np.ndarray:
    """Return the steps that hold ``values``, uint8; :func:`dequantised` is the reverse."""
    half = 2 ** (bits - 1)
    return np.clip(np.floor(values * (half / band)) + half, 0, 2 * half - 1).astype(np.uint8)


def dequantised(codes: np.ndarray, band: float, bits: int = 8) -> np.ndarray:
    """Return the distances in the middles of steps, float32."""
    half = 2 ** (bits - 1)
    return (codes.astype(np.float32) + np.float32(0.5 - half)) * np.float32(band / half)


def places(shape) -> np.ndarray:
    """Return all whole-numbered places of a grid, ``(N, 3)``, in C order."""
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)


def slope_bound(values: np.ndarray, spacing: float) -> float:
    """Return a bound of the gradient of trilinear interpolation in grids ``(…, X, Y, Z)`` of distances, at least 1."""
    total = 0.0
    for axis in (-3, -2, -1):
        steps = np.abs(np.diff(values, axis=axis))
        for other in {-3, -2, -1} - {axis}:
            ends = [[slice(None)] * 3, [slice(None)] * 3]
            ends[0][other], ends[1][other] = slice(1, None), slice(None, -1)
            steps = np.maximum(*(steps[(..., *e)] for e in ends))
        total = total + (steps.astype(np.float64) / spacing) ** 2
    return max(1.0, float(np.sqrt(np.max(total))))


class ByteCells(DistanceField):
    """Base class: trilinear interpolation of 8-bit distances in equal cells.

    ``cells`` is their number along each axis, the first of which is at ``lower``.
    """

    def __init__(self, types, lower, cells, spacing: float, band: float):
        self.cells = tuple(map(int, cells))
        upper = [a + n * spacing for a, n in zip(lower, self.cells, strict=True)]
        super().__init__(types, lower, upper, spacing, band)
        self.step = band / 128

    def _cell(self, p):
        """Return for each axis the cell and the place in it, from 0 to 1."""
        axes = []
        for x, a, n in zip(p, self.lower, self.cells, strict=True):
            t = clamp((x - a) / self.spacing, 0.0, float(n))
            i = dr.minimum(self.types.UInt32(dr.detach(t)), n - 1)
            axes.append((i, t - self.types.Float(i)))
        return axes

    def _corners(self, index, active):
        """Return the steps at the corners of a cell, ``[x][y][z]``, as ``Float``."""
        raise NotImplementedError

    def _distance(self, code):
        return dr.fma(code, self.step, -127.5 * self.step)

    def _interpolated(self, corners, weights):
        c, (u, v, w) = corners, weights
        rows = [dr.lerp(dr.lerp(c[a][0][0], c[a][0][1], w), dr.lerp(c[a][1][0], c[a][1][1], w), v) for a in (0, 1)]
        return self._distance(dr.lerp(rows[0], rows[1], u))

    def value(self, p, active=True):
        active = self.inside(p) & active
        index, weights = zip(*self._cell(p), strict=True)
        return dr.select(active, self._interpolated(self._corners(index, active), weights), self.band)

    def gradient(self, p, active=True):
        active = self.inside(p) & active
        index, (u, v, w) = zip(*self._cell(p), strict=True)
        c = self._corners(index, active)
        edges = [[dr.lerp(c[a][b][0], c[a][b][1], w) for b in (0, 1)] for a in (0, 1)]
        across = [[c[a][b][1] - c[a][b][0] for b in (0, 1)] for a in (0, 1)]
        lines = [dr.lerp(edges[a][0], edges[a][1], v) for a in (0, 1)]
        slope = self.types.Array3f(
            lines[1] - lines[0],
            dr.lerp(edges[0][1] - edges[0][0], edges[1][1] - edges[1][0], u),
            dr.lerp(dr.lerp(across[0][0], across[0][1], v), dr.lerp(across[1][0], across[1][1], v), u),
        )
        value = self._distance(dr.lerp(lines[0], lines[1], u))
        return dr.select(active, value, self.band), dr.select(active, slope * (self.step / self.spacing), 0)


class ByteGrid(ByteCells):
    """Dense grid of ``nodes``, uint8 ``(X, Y, Z)``, the first of which is at ``lower``."""

    def __init__(self, types, nodes: np.ndarray, lower, spacing: float, band: float):
        super().__init__(types, lower, [n - 1 for n in nodes.shape], spacing, band)
        self.state = {"nodes": nodes, "lower": np.array(lower), "spacing": spacing, "band": band}
        self.nodes = types.UInt8(np.ascontiguousarray(nodes.ravel()))
        self.nbytes = nodes.size
        # Slabs of 32 cells that share their ends, to save memory
        slabs = (nodes[i : i + 33] for i in range(0, nodes.shape[0] - 1, 32))
        self.slope = max(slope_bound(dequantised(slab, band), spacing) for slab in slabs)

    def _corners(self, index, active):
        i, j, k = index
        _, ny, nz = (n + 1 for n in self.cells)
        first = (i * ny + j) * nz + k

        def read(offset: int):
            return self.types.Float(dr.gather(self.types.UInt8, self.nodes, first + offset, active))

        return [[[read((a * ny + b) * nz + c) for c in (0, 1)] for b in (0, 1)] for a in (0, 1)]


def dense(types, distances: Distances, spacing: float, train: bool = False) -> ByteGrid:
    """Return a dense grid with exact distances at its nodes, or with trained nodes (:func:`least_squares`)."""
    cells = _dense_cells(distances.mesh, spacing)
    lower, shape = (distances.mesh.lower + distances.mesh.upper) / 2 - cells * spacing / 2, cells + 1
    values = distances.signed(lower + places(shape) * spacing, 3 * spacing)
    if train:
        values = least_squares(distances, lower, spacing, shape, np.arange(len(values)), values)
    band = NEAREST * spacing
    return ByteGrid(types, quantised(values.reshape(shape), band), lower, spacing, band)


def dense_spacing(mesh: Mesh, nbytes: int) -> float:
    """Return the spacing of the finest :func:`dense` grid of ``nbytes``."""

    def fits(fineness: float) -> bool:
        return np.prod(_dense_cells(mesh, math.exp(-fineness)) + 1.0) <= nbytes

    return math.exp(-largest_fitting(fits, 0.0, math.log(1e4), steps=40))


def _dense_cells(mesh: Mesh, spacing: float) -> np.ndarray:
    return np.ceil((mesh.upper - mesh.lower) / spacing + 1).astype(int)


def least_squares(
    distances: Distances, lower, spacing: float, shape, keys: np.ndarray, values: np.ndarray, keep: float = KEEP
) -> np.ndarray:
    """Return ``values`` with those nodes trained that belong to a cell which the surface crosses.

    ``keys`` are the places of the nodes in a grid of ``shape`` nodes (C order, ascending); only cells with all of their
    nodes count. Trilinear interpolation of the trained nodes is nearest to distances and normals at random points of
    the cells, by linear least squares: the exact minimum, without a rate, a schedule or a batch. ``keep`` is the weight
    of the given ``values``.
    """
    from scipy import sparse
    from scipy.sparse.linalg import cg

    rng = np.random.default_rng(1)
    cells = surface_cells(distances, lower, spacing, np.asarray(shape) - 1)
    corners = np.ravel_multi_index((cells[:, None] + CORNERS).reshape(-1, 3).T, shape)
    at = np.minimum(np.searchsorted(keys, corners), len(keys) - 1)
    whole = (keys[at] == corners).reshape(-1, 8).all(axis=1)
    cells, corners = cells[whole], at.reshape(-1, 8)[whole]
    each = int(np.clip(MOST_SAMPLES / max(1, len(cells)), 4, SAMPLES))
    blocks, right = np.empty((len(cells), 8, 8), np.float32), np.empty((len(cells), 8), np.float32)
    for part in np.array_split(np.arange(len(cells)), max(1, len(cells) * each // 2**18)):
        place = rng.random((len(part), each, 3))
        d, g = distances.signed_normals((lower + (cells[part][:, None] + place) * spacing).reshape(-1, 3))
        # Per sample a row for the distance, in cells, and three for the gradient
        ends = np.where(CORNERS == 1, place[..., None, :], 1 - place[..., None, :])
        signs = 2.0 * CORNERS - 1
        rows = [ends.prod(-1), *(ends[..., np.delete(np.arange(3), a)].prod(-1) * signs[:, a] for a in range(3))]
        truth = np.concatenate([d[:, None] / spacing, g], axis=1).reshape(len(part), each, 4)
        weight = 1 / (1 + (truth[..., :1] / FOCUS) ** 2) * np.array([1, *[GRADIENT_WEIGHT**2] * 3])
        rows = np.stack(rows, -2)
        weighted = rows * weight[..., None]
        blocks[part] = np.einsum("nsrc,nsrd->ncd", weighted, rows, optimize=True)
        right[part] = np.einsum("nsrc,nsr->nc", weighted, truth, optimize=True)
    used, at = np.unique(corners, return_inverse=True)
    at = at.reshape(-1, 8)
    start, keep = values[used].astype(np.float64) / spacing, keep * each
    entries = np.repeat(at, 8, axis=1).ravel(), np.tile(at, (1, 8)).ravel()
    matrix = sparse.coo_array((blocks.ravel(), entries), (len(used),) * 2).tocsr().astype(np.float64)
    matrix += sparse.diags_array(np.full(len(used), keep))
    target = np.bincount(at.ravel(), right.ravel(), len(used)) + keep * start
    solution, _ = cg(matrix, target, start, rtol=1e-4, maxiter=200)
    trained = values.copy()
    trained[used] = solution * spacing
    return trained
