"""Points sampled on and around a mesh, and the grid cells that its surface passes through.

A grid has a ``lower`` corner, cells with sides of length ``spacing``, and ``shape``, the number of cells along x, y and
z. Cell ``(i, j, k)`` begins at ``lower + spacing · (i, j, k)``. A ``seed`` is a number or a ``numpy.random.Generator``.
"""

from __future__ import annotations

import numpy as np

from ...arrays.sparse_grid import CORNERS
from .distances import Distances
from .mesh import Mesh

#: Largest number of grid nodes for which :func:`near_nodes` keeps a table with one entry per node.
LARGEST_TABLE = 2**26

#: Largest number of cells along an axis at the coarsest level of :func:`surface_cells`.
COARSEST = 16


def sample_surface(mesh: Mesh, count: int, seed) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` points uniform over the area, and the normals of their triangles: ``(count, 3)`` twice, float64.

    The area is divided into ``count`` equal parts with one point in each, so that small pieces get their share.
    """
    rng = np.random.default_rng(seed)
    total = np.cumsum(mesh.areas)
    places = (np.arange(count) + rng.random(count)) / count * total[-1]
    triangle = np.minimum(np.searchsorted(total, places, side="right"), len(total) - 1)
    # Folding the unit square over its diagonal keeps a point uniform over the triangle
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))
    a, b, c = np.moveaxis(mesh.corners[triangle], 1, 0)
    return a + u * (b - a) + v * (c - a), mesh.normals[triangle]


def sample_near(mesh: Mesh, count: int, width: float, seed) -> np.ndarray:
    """Return ``count`` surface points, (count, 3), displaced by a normal distribution of deviation ``width``."""
    rng = np.random.default_rng(seed)
    points, _ = sample_surface(mesh, count, rng)
    return points + rng.normal(scale=width, size=points.shape)


def sample_box(lower, upper, count: int, seed) -> np.ndarray:
    """Return ``count`` points uniform in the box between two corners, ``(count, 3)``."""
    return np.random.default_rng(seed).uniform(lower, upper, (count, 3))


def surface_cells(distances: Distances, lower, spacing: float, shape, reach: float = 0.0) -> np.ndarray:
    """Return the cells whose circumscribed sphere comes within ``reach`` of the surface, searching from coarse to fine.

    The result is ``(K, 3)``, int32, in lexicographic order. No cell that the surface passes through is missing; about a
    sixth of the cells are only passed by.
    """
    lower, shape = np.asarray(lower, dtype=np.float64), np.asarray(shape)
    side = 1
    while -(-int(shape.max()) // side) > COARSEST:
        side *= 2
    cells = np.stack(np.meshgrid(*[np.arange(-(-n // side)) for n in shape], indexing="ij"), axis=-1).reshape(-1, 3)
    while True:
        centres = lower + (cells + 0.5) * (side * spacing)
        near = distances.unsigned(centres) <= (np.sqrt(3) / 2 * side * spacing + reach) * (1 + 1e-6)
        cells = cells[near]
        if side == 1:
            break
        side //= 2
        cells = (2 * cells[:, None] + CORNERS).reshape(-1, 3)
        cells = cells[np.all(cells * side < shape, axis=1)]
    keys = np.sort(np.ravel_multi_index(cells.T, tuple(shape)))
    return np.stack(np.unravel_index(keys, tuple(shape)), axis=-1).astype(np.int32)


def near_nodes(cells: np.ndarray, largest_table: int = LARGEST_TABLE) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of cells, each once, and for each cell the positions of its eight corners among them.

    The nodes are ``(M, 3)``, int32, in lexicographic order; the positions are ``(K, 8)``, int32, z fastest.
    """
    cells = np.asarray(cells, dtype=np.int64)
    shape = tuple(cells.max(axis=0, initial=0) + 2)
    keys = np.ravel_multi_index(cells.T, shape)[:, None] + np.ravel_multi_index(CORNERS.T, shape)
    if np.prod(shape) <= largest_table:  # several times as fast as sorting
        used = np.zeros(np.prod(shape), dtype=bool)
        used[keys] = True
        node_keys = np.flatnonzero(used)
        inverse = np.cumsum(used, dtype=np.int32)[keys] - 1
    else:
        node_keys, inverse = np.unique(keys, return_inverse=True)
    nodes = np.stack(np.unravel_index(node_keys, shape), axis=-1).astype(np.int32)
    return nodes, inverse.reshape(-1, 8).astype(np.int32)


def node_distances(distances: Distances, lower, spacing: float, shape, limit: float) -> np.ndarray:
    """Return the signed distance at all nodes ``lower + spacing · (i, j, k)`` of a grid, truncated to ± ``limit``.

    The result is float32 of the ``shape`` (nodes along x, y and z). Distances are computed near the surface only; of
    the other nodes, neighbours share a sign, which is computed once.
    """
    from scipy.ndimage import label

    shape = tuple(int(n) for n in shape)
    lower = np.asarray(lower, dtype=np.float64)
    cells = surface_cells(distances, lower, spacing, np.array(shape) - 1, max(0.0, limit - 0.8 * spacing))
    nodes, _ = near_nodes(cells)
    near = np.zeros(shape, dtype=bool)
    near[tuple(nodes.T)] = True
    values = np.empty(shape, np.float32)
    if distances.solid.watertight:
        pieces, count = label(~near)
        first = np.zeros(count + 1, dtype=np.int64)
        flat = pieces.reshape(-1)
        first[flat[::-1]] = np.arange(len(flat))[::-1]
        places = np.stack(np.unravel_index(first, shape), axis=-1)
        signs = np.where(distances.inside(lower + spacing * places), -1, 1).astype(np.float32)
        values[...] = limit * signs[pieces]
    else:
        far = np.argwhere(~near)
        values[tuple(far.T)] = np.where(distances.inside(lower + spacing * far), -limit, limit)
    values[tuple(nodes.T)] = distances.signed(lower + spacing * nodes).clip(-limit, limit)
    return values
