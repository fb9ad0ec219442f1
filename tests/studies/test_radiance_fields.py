"""Rivals of radiance fields against trilinear interpolation by NumPy and finite differences."""

import drjit as dr
import drjit.llvm.ad as T
import numpy as np
import pytest

from mi_diffind.arrays.sparse_grid import cell_corners, complete_cells
from mi_diffind.studies.baselines import radiance_fields as rivals
from mi_diffind.tasks.radiance import march
from mi_diffind.tasks.radiance.grid import NodeGrid
from mi_diffind.tasks.radiance.nodes import Nodes
from mi_diffind.tasks.radiance.volume_field import FAINT

LOWER, SPACING, SHAPE = (-0.5, -0.3, 0.1), 0.05, (11, 9, 14)

#: Bytes of a hash grid and its network.
BYTES = 20_000


@pytest.fixture
def grid(rng):
    """A sparse grid of random numbers."""
    stored = cell_corners(rng.random([n - 1 for n in SHAPE]) < 0.25)
    count = 1 + np.count_nonzero(stored)
    density, colour = 3 * rng.normal(size=count), 0.7 * rng.normal(size=(count, 12))
    return NodeGrid(Nodes(T, LOWER, SPACING, SHAPE, stored), np.float32(density), np.float32(colour))


@pytest.fixture
def seen(grid, rng):
    """Random weights of its entries."""
    return rng.random(grid.nodes.entries)


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
    found = 0
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, place - cell, 1 - (place - cell)), axis=1)
        found = found + weight[:, None] * dense[tuple((cell + corner).T)]
    return found, complete_cells(grid.nodes.stored)[tuple(cell.T)]


def numbers_of(state):
    """Return density and twelve numbers of colour of each node of a state."""
    density = -8 + 20 / 255 * state["density"].astype(np.float64)[:, None]
    colour = state["colour_low"] + state["colour_step"] * state["colour"].astype(np.float64)
    return np.concatenate([density, colour[state["rows"]] if "rows" in state else colour], axis=1)


@pytest.mark.parametrize("entries", [0, 50])
def test_bytes_are_read_as_numbers(grid, seen, entries, rng):
    """The field that is trained and that which reads bytes, against NumPy; all bytes are counted."""
    made = rivals.NodesFit(grid, seen, entries)
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
        assert np.allclose(colour[:, sigma > 0], np.exp(exponents)[:, sigma > 0], rtol=2e-4)
    numbers = grid.nodes.entries * (3 if entries else 13) + 12 * entries
    assert 0 <= stored.nbytes - stored.nodes.nbytes - numbers < 4
    assert rivals.compressed_bytes(state) < stored.nbytes


def test_numbers_are_rounded_once(grid, seen):
    """Rounding is within half a step, and rounded numbers stay."""
    made = rivals.NodesFit(grid, seen)
    found = numbers_of(made.state())
    assert np.abs(found[:, 0] - np.clip(grid.density[1:], -8, 12)).max() <= 0.51 * 20 / 255
    inner = np.abs(found[:, 1:] - grid.colour[1:]) <= 0.51 * made.steps.step
    assert inner.mean() > 0.99  # all but the tails
    tensor = T.TensorXf(np.float32(found[:, 1:]))
    assert np.abs(made.steps.rounded(T, tensor).numpy() - found[:, 1:]).max() < 1e-6


def test_codebook_has_the_nearest(grid, seen):
    made = rivals.NodesFit(grid, seen, 50)
    scale = rivals.display_scale(grid.colour[1:], seen[1:])
    centres, points = made.net["colour"].numpy() * scale, grid.colour[1:] * scale
    distances = np.linalg.norm(points[:, None] - centres[None], axis=2)
    best = distances[np.arange(len(points)), made.rows[1:]]
    assert np.allclose(best, distances.min(axis=1), rtol=1e-3)
    random = np.linalg.norm(points[:, None] - points[None, :50], axis=2).min(axis=1)
    assert np.average(best**2, weights=seen[1:]) < np.average(random**2, weights=seen[1:])


def test_coarser_grids_are_read_from_finer_ones():
    """Numbers that are linear in the place are met where nodes are inside; there is nothing outside."""
    cells = np.zeros((15, 15, 15), bool)
    cells[3:12, 3:12, 3:12] = True
    nodes = Nodes(T, LOWER, SPACING, (16, 16, 16), cell_corners(cells))

    def linear(place):
        colour = np.stack([place @ [k, 1, 2] for k in range(12)], axis=1)
        return 0.3 * place[:, 0] - 0.1 * place[:, 2], colour

    density, colour = linear(nodes.positions())
    grid = NodeGrid(nodes, np.pad(density, (1, 0)), np.pad(colour, ((1, 0), (0, 0))))
    found, _ = rivals.resample(grid, np.ones(nodes.entries), 1.4)
    assert found.nodes.spacing == pytest.approx(1.4 * SPACING) and found.nodes.shape == (12, 12, 12)
    place = 1.4 * found.nodes.positions()
    inside = ((place >= 3) & (place <= 12)).all(axis=1)
    assert inside.sum() == 6**3
    for values, expected in zip((found.density[1:], found.colour[1:]), linear(place), strict=True):
        assert np.abs(values - expected)[inside].max() < 1e-3
    assert found.density[1:][~inside].max() < 1.0 and not inside.all()
    for entries in (0, 50):
        nbytes = 0.5 * rivals.NodesFit.field(T, rivals.NodesFit(grid, np.ones(nodes.entries), entries).state()).nbytes
        coarse = rivals.resample(grid, np.ones(nodes.entries), rivals.choose_scale(grid, nbytes, entries))
        assert 0.5 * nbytes < rivals.NodesFit.field(T, rivals.NodesFit(*coarse, entries).state()).nbytes <= nbytes + 4


def test_all_outputs_of_a_network_are_trained(grid, seen, rng):
    """Derivatives of rays reach the density and all coefficients of the colours, as finite differences do."""
    made = rivals.HashVolumeFit(grid, seen, BYTES)
    assert 0.8 * BYTES < made.field(T, made.state()).nbytes <= BYTES
    made.net["weights"] = made.net["weights"] * 1.5  # some density
    _, _, o, d = rays(rng, 500)

    def total(net):
        march_field = made.field_of(net).for_training()
        colours = march.differentiable(march_field, o, d, T.Float(0), T.Float(dr.inf)).colour
        return sum(w * dr.sum(colour) for w, colour in zip((1, 2, 3), colours, strict=True))

    net = {name: T.TensorXf(value) for name, value in made.net.items()}
    dr.enable_grad(net)
    dr.backward(total(net))
    gradients, net = dr.grad(net), dr.detach(net)
    gradient = gradients["weights"].numpy().astype(np.float64)
    assert np.abs(gradients["entries"].numpy()).max() > 0
    bias = made.network.layers[-1].bias
    for row in range(13):
        place, sums = bias.offset + row * bias.stride, []
        for sign in (1, -1):
            weights = net["weights"].numpy().copy()
            weights[place] += sign * 1e-2
            sums.append(float(total({**net, "weights": T.TensorXf(weights)})[0]))
        assert gradient[place] == pytest.approx((sums[0] - sums[1]) / 2e-2, rel=0.03, abs=1e-3), row
    assert np.abs(gradient[bias.offset + bias.stride :: bias.stride][:3]).min() > 0.01
