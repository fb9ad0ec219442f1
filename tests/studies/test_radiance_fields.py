"""Rivals of radiance fields against trilinear interpolation by NumPy and finite differences."""

import zlib

import drjit as dr
import drjit.llvm.ad as T
import numpy as np
import pytest

from mi_diffind.arrays.sparse_grid import cell_corners, complete_cells
from mi_diffind.studies.baselines import radiance_fields as rivals
from mi_diffind.tasks.radiance import march
from mi_diffind.tasks.radiance.nodes import Nodes
from mi_diffind.tasks.radiance.volume_field import FAINT, NodeField

LOWER, SPACING, SHAPE = (-0.5, -0.3, 0.1), 0.05, (11, 9, 14)


@pytest.fixture
def grid(rng):
    stored = cell_corners(rng.random([n - 1 for n in SHAPE]) < 0.25)
    count = np.count_nonzero(stored)
    density, colour = 3 * rng.normal(size=count), 0.7 * rng.normal(size=(count, 12))
    nodes = Nodes(T, LOWER, SPACING, SHAPE, stored)
    return rivals.WeightedGrid(nodes, np.float32(density), np.float32(colour), rng.random(count))


FITS = {
    "sparse": rivals.plain,
    "6 bits": lambda g: rivals.plain(g, 64),
    "codebook": lambda g: rivals.codebook(g, 50),
}


def rays(rng, count, grid):
    points = rng.uniform(grid.nodes.lower, grid.nodes.upper, (count, 3)).astype(np.float32)
    d = rng.normal(size=(count, 3))
    d = (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)
    return points, d, *(T.Array3f(*(T.Float(np.ascontiguousarray(x)) for x in v.T)) for v in (points, d))


def interpolated(grid, numbers, points):
    """``numbers`` (n, C) of the stored nodes at ``points``, in double precision, and where all corners are stored."""
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
    """Density and twelve numbers of colour of each node, as a state means them."""
    kinds = [state[f"{k}_low"] + state[f"{k}_step"] * state[k].astype(np.float64) for k in ("density", "colour")]
    density, colour = kinds
    if "rows" in state:
        colour = colour[state["rows"]]
    return np.concatenate([density, colour], axis=1)


@pytest.mark.parametrize("name", FITS)
def test_bytes_are_read_as_they_are_meant(grid, name, rng):
    """Both forms, that which is trained and that of bytes, against NumPy."""
    made = FITS[name](grid)
    state = made.state()
    assert state["density"].dtype == state["colour"].dtype == np.uint8
    points, directions, p, d = rays(rng, 3000, grid)
    expected, inside = interpolated(grid, numbers_of(state), points)
    sigma = np.maximum(np.logaddexp(0, expected[:, 0]) - FAINT, 0) / SPACING * inside
    exponents = [
        expected[:, 1 + 4 * c] + np.sum(expected[:, 2 + 4 * c : 5 + 4 * c] * directions, axis=1) for c in range(3)
    ]
    for field in (made.field_of(made.net), made.field(T, state)):
        found, point_data = field.density_at(p)
        assert np.abs(found.numpy() - sigma).max() < 2e-3
        colour = np.array(field.radiance_at(point_data, p, d, found > 0))
        assert 0.1 < (sigma > 0).mean() < 0.9
        assert np.allclose(colour[:, sigma > 0], np.exp(exponents)[:, sigma > 0], rtol=2e-4)


def test_rounded_once(grid):
    """Rounding is within half a step of what it is of, and what is rounded stays."""
    made = rivals.plain(grid)
    found = numbers_of(made.state())
    assert np.abs(found[:, 0] - np.clip(grid.density, *rivals.RAW)).max() <= 0.51 * made.steps[0].step[0]
    inner = np.abs(found[:, 1:] - grid.colour) <= 0.51 * made.steps[1].step
    assert inner.mean() > 0.99  # all but the tails
    tensor = T.TensorXf(np.float32(found[:, 1:]))
    assert np.abs(made.steps[1].rounded(T, tensor).numpy() - found[:, 1:]).max() < 1e-6


def test_codebook_has_the_nearest(grid):
    made = rivals.codebook(grid, 50)
    centres = made.net["colour"].numpy() * rivals.display(grid)
    points = grid.colour * rivals.display(grid)
    distances = np.linalg.norm(points[:, None] - centres[None], axis=2)
    best = distances[np.arange(len(points)), made.rows]
    assert np.allclose(best, distances.min(axis=1), rtol=1e-4)
    random = np.linalg.norm(points[:, None] - points[None, :50], axis=2).min(axis=1)
    assert np.average(best**2, weights=grid.seen) < np.average(random**2, weights=grid.seen)


def unpacked(neighbours, stored, data, prediction):
    """The codes of a channel from its bytes, decoded in the order of sums of places: previous nodes have lower ones."""
    rest, total = np.frombuffer(zlib.decompress(data), np.uint8).astype(np.int64), np.argwhere(stored).sum(axis=1)
    codes = np.zeros_like(rest)
    for wave in (np.flatnonzero(total == n) for n in np.unique(total)):
        codes[wave] = (rest[wave] + neighbours.predicted(codes, prediction, wave)) & 255
    return codes.astype(np.uint8)


@pytest.mark.parametrize("kind", rivals.PREDICTIONS)
def test_codes_come_back(kind, rng):
    """What zlib has of a channel, by each prediction, is undone; smooth ones are smaller predicted."""
    stored = rng.random((20, 15, 18)) < 0.9
    neighbours = rivals.Neighbours(stored)
    place = np.argwhere(stored)
    smooth = np.uint8(place @ [5, 3, 4] + rng.integers(2, size=len(place)))
    noise = rng.integers(256, size=len(place)).astype(np.uint8)
    for codes in (smooth, noise):
        rest = np.uint8(codes - neighbours.predicted(codes.astype(np.int64), kind, np.arange(len(codes))) & 255)
        assert np.array_equal(unpacked(neighbours, stored, rivals.deflated(rest.tobytes()), kind), codes)
    data, chosen = neighbours.packed(smooth)
    assert chosen == "mean" and len(data) < 0.8 * len(rivals.deflated(smooth.tobytes()))
    assert len(neighbours.packed(noise)[0]) > 0.95 * len(noise)


def test_file_bytes_are_of_all_that_is_stored(grid):
    sizes = {name: make(grid) for name, make in FITS.items()}
    sizes = {name: made.file_bytes(made.state()) for name, made in sizes.items()}
    count = grid.nodes.count
    assert 10 * count < sizes["sparse"] < 14 * count + 500  # noise does not deflate
    assert sizes["6 bits"] < 0.9 * sizes["sparse"] and sizes["codebook"] < 0.4 * sizes["sparse"]


def test_coarser_grids_are_read_from_finer_ones():
    """Numbers that are linear in the place are met where nodes are inside; there is nothing outside."""
    cells = np.zeros((15, 15, 15), bool)
    cells[3:12, 3:12, 3:12] = True
    nodes = Nodes(T, LOWER, SPACING, (16, 16, 16), cell_corners(cells))
    place = nodes.positions()
    colour = np.stack([place @ [k, 1, 2] for k in range(12)], axis=1)
    grid = rivals.WeightedGrid(nodes, 0.3 * place[:, 0] - 0.1 * place[:, 2], colour, np.ones(len(place)))
    found = grid.resampled(1.4)
    assert found.nodes.spacing == pytest.approx(1.4 * SPACING) and found.nodes.shape == (12, 12, 12)
    place = 1.4 * found.nodes.positions()
    inside = ((place >= 3) & (place <= 12)).all(axis=1)
    assert inside.sum() == 6**3
    assert np.abs(found.density - 0.3 * place[:, 0] + 0.1 * place[:, 2])[inside].max() < 1e-4
    assert np.abs(found.colour - np.stack([place @ [k, 1, 2] for k in range(12)], axis=1))[inside].max() < 1e-3
    assert found.density[~inside].max() < 1.0 and not inside.all()


def test_derivatives_of_networks(grid, rng):
    """Of densities and colours with respect to each array, against finite differences."""
    made, step = rivals.HashVolumeFit(grid, 2**9, 16.0), 1e-4
    _, _, p, d = rays(rng, 2000, grid)

    def values(net):
        field = made.field_of(net)
        sigma, point_data = field.density_at(p)
        return sigma / 50 + sum(field.radiance_at(point_data, p, d, sigma > 0))

    net = {name: T.TensorXf(value) for name, value in made.net.items()}
    dr.enable_grad(net)
    dr.backward(values(net))
    gradients, net = dr.grad(net), dr.detach(net)
    for name in net:
        change = T.TensorXf(rng.exponential(size=net[name].shape).astype(np.float32))
        moved = [values({**net, name: net[name] + s * step * change}).numpy().astype(np.float64) for s in (1, -1)]
        found = np.sum(gradients[name].numpy().astype(np.float64) * change.numpy())
        assert found == pytest.approx(np.sum(moved[0] - moved[1]) / (2 * step), rel=0.01), name


def test_all_outputs_of_a_network_are_trained(grid, rng):
    """Derivatives of rays reach the density and all coefficients of the colours, as finite differences do."""
    made = rivals.HashVolumeFit(grid, 2**9, 16.0)
    made.net["weights"] = made.net["weights"] * 1.5  # some density
    _, _, o, d = rays(rng, 500, grid)

    def total(net):
        seen = march.differentiable(made.field_of(net).for_training(), o, d, T.Float(0), T.Float(dr.inf))
        return sum(w * dr.sum(colour) for w, colour in zip((1, 2, 3), seen.colour, strict=True))

    net = {name: T.TensorXf(value) for name, value in made.net.items()}
    dr.enable_grad(net)
    dr.backward(total(net))
    gradient, net = dr.grad(net)["weights"].numpy().astype(np.float64), dr.detach(net)
    bias = made.network.layers[-1].bias
    for row in range(13):
        place, sums = bias.offset + row * bias.stride, []
        for sign in (1, -1):
            weights = net["weights"].numpy().copy()
            weights[place] += sign * 1e-2
            sums.append(float(total({**net, "weights": T.TensorXf(weights)})[0]))
        assert gradient[place] == pytest.approx((sums[0] - sums[1]) / 2e-2, rel=0.03, abs=1e-3), row
    assert np.abs(gradient[bias.offset + bias.stride :: bias.stride][:3]).min() > 0.01


def test_what_is_seen_is_where_rays_end(grid):
    """The shares of a ray that ends in one cell are those of its corners; a wall hides what is behind it."""
    nodes = Nodes(T, (0, 0, 0), 1.0, (4, 4, 4), np.ones((4, 4, 4), bool))
    density = np.full((4, 4, 4), -30.0)
    density[:, :, 2:] = 60.0
    arrays = [T.TensorXf(np.float32(np.append(0, density.ravel()))), T.TensorXf(np.zeros((65, 12), np.float32))]

    class ParallelRays:
        def __init__(self):
            self.views = type("Views", (), {"sizes": np.array([[4, 4]])})()

        def rays(self, view, x, y):
            o = T.Array3f(0.5 + 0.5 * T.Float(x), 0.5 + 0.5 * T.Float(y), 9.0)
            return o, T.Array3f(T.Float(0), T.Float(0), T.Float(-1))

    seen = rivals.visibility(NodeField(nodes, *arrays), ParallelRays(), 1)[1:].reshape(4, 4, 4)
    assert seen.sum() == pytest.approx(16, rel=1e-3)
    assert seen[:, :, 3].sum() > 15.9 * 0.5 and seen[:, :, :2].sum() < 1e-3
