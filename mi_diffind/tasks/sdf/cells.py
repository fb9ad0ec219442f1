"""
Which cells of a grid a surface passes through, found from coarse to fine.

A grid has a ``lower`` corner, cells of the side ``spacing`` and ``shape`` of them along x, y and z; cell ``(i, j, k)``
lies at ``lower + spacing · (i, j, k)``.
"""

from __future__ import annotations

import numpy as np

from .distances import Distances

#: The corners of a cell, z fastest, ``(8, 3)``.
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)

#: Nodes of a grid up to which a number is kept for each of them.
MAPPED = 2**26

#: Cells along an axis at the coarsest level, at most.
COARSEST = 16


def surface_cells(distances: Distances, lower, spacing: float, shape, reach: float = 0.0) -> np.ndarray:
    """
    The cells whose circumscribed sphere the surface touches, or comes as near to as ``reach``: whole numbers
    ``(K, 3)``, int32, in lexicographic order. No cell that the surface passes through is missing; about a sixth of
    those that are named are only passed by.
    """
    lower, shape = np.asarray(lower, dtype=np.float64), np.asarray(shape)
    side = 1
    while -(-int(shape.max()) // side) > COARSEST:
        side *= 2
    cells = np.stack(np.meshgrid(*[np.arange(-(-n // side)) for n in shape], indexing="ij"), axis=-1).reshape(-1, 3)
    while True:
        centres = lower + (cells + 0.5) * (side * spacing)
        found = distances.unsigned(centres) <= (np.sqrt(3) / 2 * side * spacing + reach) * (1 + 1e-6)
        cells = cells[found]
        if side == 1:
            break
        side //= 2
        cells = (2 * cells[:, None] + CORNERS).reshape(-1, 3)
        cells = cells[np.all(cells * side < shape, axis=1)]
    keys = np.sort(np.ravel_multi_index(cells.T, tuple(shape)))
    return np.stack(np.unravel_index(keys, tuple(shape)), axis=-1).astype(np.int32)


def near_nodes(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    The corners of cells, each once: nodes ``(M, 3)``, int32, in lexicographic order, and for each cell the positions of
    its eight corners among them, ``(K, 8)``, int32, z fastest.
    """
    cells = np.asarray(cells, dtype=np.int64)
    shape = tuple(cells.max(axis=0, initial=0) + 2)
    keys = np.ravel_multi_index(cells.T, shape)[:, None] + np.ravel_multi_index(CORNERS.T, shape)
    if np.prod(shape) <= MAPPED:  # several times as fast as sorting
        number = np.zeros(np.prod(shape), dtype=bool)
        number[keys] = True
        found = np.flatnonzero(number)
        number = np.cumsum(number, dtype=np.int32)
        inverse = number[keys] - 1
    else:
        found, inverse = np.unique(keys, return_inverse=True)
    nodes = np.stack(np.unravel_index(found, shape), axis=-1).astype(np.int32)
    return nodes, inverse.reshape(-1, 8).astype(np.int32)


def node_distances(distances: Distances, lower, spacing: float, shape, limit: float) -> np.ndarray:
    """
    The signed distance, truncated to ± ``limit``, at all nodes ``lower + spacing · (i, j, k)`` of a grid: float32 of
    the ``shape`` (nodes along x, y and z). Only nodes near the surface are asked for one by one; neighbours among the
    others share a sign, of which one is asked for.
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
