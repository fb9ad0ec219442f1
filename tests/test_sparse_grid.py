"""Sparse grids: masks and ranks, cells and their corners, empty distances, against brute force."""

import dataclasses

import numpy as np
import pytest

from mi_diffind.arrays import sparse_grid
from mi_diffind.arrays.sparse_grid import CORNERS, GridIndex, SparseGrid
from mi_diffind.core.runtime import array_module

SHAPE = (35, 20, 18)


@pytest.fixture
def ball():
    """The signs of the nodes of a grid, the nodes of cells in which they differ, and their grid."""
    place = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1)
    inside = ((place - [9, 10, 8.5]) ** 2).sum(-1) < 30
    windows = np.lib.stride_tricks.sliding_window_view(inside, (2, 2, 2)).reshape(*(n - 1 for n in SHAPE), 8)
    crossed = windows.any(-1) & ~windows.all(-1)
    nodes = np.random.default_rng(1).permutation(np.argwhere(sparse_grid.cell_corners(crossed)))

    def sign(points):
        return ((np.asarray(points) * 2 - [9, 10, 8.5]) ** 2).sum(-1) < 30

    return inside, crossed, SparseGrid.from_nodes(nodes, inside[tuple(nodes.T)], SHAPE, (0, 0, 0), 0.5, sign)


@pytest.mark.parametrize("most", [None, 1, 3, 15])
def test_empty_distances(rng, monkeypatch, most):
    monkeypatch.setattr(sparse_grid, "TILE", 8)
    full = rng.random((30, 9, 17)) < 0.003
    places = np.argwhere(np.ones(full.shape))
    distance = np.abs(places[:, None] - np.argwhere(full)).max(-1).min(-1).reshape(full.shape)
    limit = most or max(full.shape)
    assert full.any() and np.array_equal(sparse_grid.empty_distances(full, most), np.minimum(distance, limit))
    assert (sparse_grid.empty_distances(full & False, most) == limit).all()


def test_cells_of_a_grid(ball):
    _, crossed, grid = ball
    positions, block = grid.node_positions()
    assert len(positions) == grid.nodes == len(np.unique(positions, axis=0))
    assert np.array_equal(positions // 4 * 4, grid.block_positions()[block])
    corner = positions[grid.cells()]
    assert np.array_equal(corner - corner[:, :1], np.broadcast_to(CORNERS, corner.shape))
    stored = np.zeros(SHAPE, bool)
    stored[tuple(positions.T)] = True
    complete = sparse_grid.complete_cells(stored)
    assert (complete | ~crossed).all()
    assert np.array_equal(np.unique(corner[:, 0], axis=0), np.argwhere(complete))


def test_lookup_of_corners(ball):
    """Every cell: which of its corners are stored, their numbers, and the signs of the others."""
    inside, _, grid = ball
    types = array_module("llvm")
    cells = np.argwhere(np.ones([n - 1 for n in SHAPE]))
    number = np.full(SHAPE, -1)
    number[tuple(grid.node_positions()[0].T)] = np.arange(grid.nodes)
    index = GridIndex(types, grid)
    result = index.corners([types.Int32(v) for v in cells.T.astype(np.int32)], types.Bool(True))
    for corner, (stored, found, _, _, sign) in zip(CORNERS, result, strict=True):
        expected = number[tuple((cells + corner).T)]
        assert np.array_equal(stored.numpy(), expected >= 0)
        assert np.array_equal(found.numpy()[expected >= 0], expected[expected >= 0])
        assert np.array_equal(sign.numpy()[expected < 0], inside[tuple((cells + corner).T)][expected < 0])


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"block_masks": np.zeros((1, 2), np.uint32)}, "blocks have nodes, found masks for 1"),
        ({"region_masks": np.zeros((0, 2), np.uint32)}, "regions have nodes, found masks for 0"),
    ],
)
def test_masks_that_do_not_go_together(ball, changes, says):
    with pytest.raises(sparse_grid.SparseGridError, match=says):
        dataclasses.replace(ball[2], **changes).check()
