"""Rivals of radiance fields against trilinear interpolation by SciPy."""

import drjit.llvm.ad as T
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from mi_diffind.arrays.sparse_grid import cell_corners, complete_cells
from mi_diffind.studies.baselines import radiance_fields as rivals
from mi_diffind.tasks.radiance.compression import Importance
from mi_diffind.tasks.radiance.grid import NodeGrid
from mi_diffind.tasks.radiance.nodes import Nodes
from mi_diffind.tasks.radiance.volume_field import FAINT

LOWER, SPACING, SHAPE = (-0.5, -0.3, 0.1), 0.05, (11, 9, 14)


@pytest.fixture
def grid(rng):
    """A sparse grid of random numbers."""
    stored = cell_corners(rng.random([n - 1 for n in SHAPE]) < 0.25)
    count = 1 + np.count_nonzero(stored)
    density, colour = 3 * rng.normal(size=count), 0.7 * rng.normal(size=(count, 12))
    return NodeGrid(Nodes(T, LOWER, SPACING, SHAPE, stored), np.float32(density), np.float32(colour))


@pytest.fixture
def importance(grid, rng):
    """Random weights of its nodes."""
    return Importance(rng.random(grid.nodes.count), rng.random(grid.nodes.count), rng.uniform(0.5, 1, 12), 1.0)


def rays(rng, count):
    upper = np.array(LOWER) + SPACING * (np.array(SHAPE) - 1)
    points = rng.uniform(LOWER, upper, (count, 3)).astype(np.float32)
    d = rng.normal(size=(count, 3))
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return points, d, *(T.Array3f(*(T.Float(np.ascontiguousarray(x)) for x in v.T)) for v in (points, d))


def interpolated(grid, numbers, points):
    """Return ``numbers`` (n, C) of the stored nodes at ``points``, and where all corners are stored."""
    dense = np.zeros((*SHAPE, numbers.shape[1]))
    dense[grid.nodes.stored] = numbers
    place = (points.astype(np.float64) - LOWER) / SPACING
    cell = np.minimum(np.floor(place).astype(int), np.array(SHAPE) - 2)
    channels = [map_coordinates(channel, place.T, order=1, mode="nearest") for channel in np.moveaxis(dense, -1, 0)]
    return np.stack(channels, axis=-1), complete_cells(grid.nodes.stored)[tuple(cell.T)]


def numbers_of(state):
    """Return density and twelve numbers of colour of each node of a state."""
    density = -7 + 15 / 255 * state["density"].astype(np.float64)[:, None]
    colour = state["low"] + state["step"] * state["colour"].astype(np.float64)
    return np.concatenate([density, colour[state["index"]] if "index" in state else colour], axis=1)


@pytest.mark.parametrize("entries", [0, 64])
def test_bytes_are_read_as_numbers(grid, importance, entries, rng):
    """The field that is trained and that which reads bytes, against NumPy; all bytes are counted."""
    made = rivals.NodesFit(grid, importance, entries)
    state = made.state()
    assert state["density"].dtype == state["colour"].dtype == np.uint8
    points, directions, p, d = rays(rng, 3000)
    expected, inside = interpolated(grid, numbers_of(state), points)
    sigma = np.maximum(np.logaddexp(0, expected[:, 0]) - FAINT, 0) / SPACING * inside
    exponents = [
        expected[:, 1 + 4 * c] + np.sum(expected[:, 2 + 4 * c : 5 + 4 * c] * directions, axis=1) for c in range(3)
    ]
    stored = made.field(T, state)
    for field in (made.field_of(made.net), stored):
        found, point_data = field.density_at(p)
        assert np.abs(found.numpy() - sigma).max() < 2e-3
        colour = np.array(field.radiance_at(point_data, p, d, found > 0))
        assert 0.1 < (sigma > 0).mean() < 0.9
        assert np.allclose(colour[:, sigma > 0], np.exp(exponents)[:, sigma > 0], rtol=2e-3)
    assert rivals.compressed_bytes(state) < stored.nbytes <= rivals.memory_bytes(grid, entries) < stored.nbytes + 16


def test_a_codebook_has_the_nearest_colours(grid, importance):
    made, scale = rivals.NodesFit(grid, importance, 50), np.sqrt(importance.metric)
    centres, points = made.net["colour"].numpy() * scale, grid.colour[1:] * scale
    distances = np.linalg.norm(points[:, None] - centres[None], axis=2)
    best = distances[np.arange(len(points)), made.index[1:]]
    assert np.allclose(best, distances.min(axis=1), rtol=1e-3)
    random = np.linalg.norm(points[:, None] - points[None, :50], axis=2).min(axis=1)
    assert np.average(best**2, weights=importance.colour) < np.average(random**2, weights=importance.colour)


def test_grids_are_as_fine_as_the_bytes_allow(grid):
    cells = complete_cells(grid.nodes.stored)
    for entries in (0, 64):
        whole = rivals.memory_bytes(grid, entries)
        assert rivals.fitting_grid(grid, cells, whole, entries).nodes.shape == SHAPE
        part = rivals.fitting_grid(grid, cells, 0.7 * whole, entries)
        assert part.nodes.spacing > SPACING and 0.4 * whole < rivals.memory_bytes(part, entries) <= 0.7 * whole
