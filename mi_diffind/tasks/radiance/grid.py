"""
The field that is compressed: a sparse grid of plain numbers, from coarse to fine.

Training begins in the visual hull at a quarter of the nodes along each side, goes on at half of them and ends with
all: each time, cells that no ray sees are left out (:func:`weights`), and the others are divided.
"""

from __future__ import annotations

import dataclasses

import drjit as dr
import numpy as np
from scipy.ndimage import binary_dilation, map_coordinates

from .field import GridField, VolumeField
from .hull import box_of, hull
from .march import visibility
from .nodes import Nodes, cells_of, corners_of
from .training import Images, ImagesProblem
from .views import Views

#: Of a raw number of density, per unit of what is trained: so that one rate suits density and colour.
DENSITY_SCALE = 10.0

#: What training begins with: nearly empty, and dark.
BEGIN_DENSITY, BEGIN_COLOUR = -4.0, -1.5

#: The weight of the total variation of raw densities, the square below which a step counts less, and nodes a step.
SMOOTH, ROUND, VARIED = 2e-4, 1e-2, 2**15

#: The largest weight in a ray below which a cell is left out.
VISIBLE = 0.02


@dataclasses.dataclass
class Grid:
    """``density`` ``(n,)``, raw numbers, and ``colour`` ``(n, 12)`` of the ``nodes``' entries, arrays of NumPy."""

    nodes: Nodes
    density: np.ndarray
    colour: np.ndarray

    def field(self) -> GridField:
        tensor = self.nodes.types.TensorXf
        return GridField(self.nodes, tensor(np.float32(self.density)), tensor(np.float32(self.colour)))


class GridProblem(ImagesProblem):
    """
    The training of a :class:`Grid` through images, with a little total variation of its densities (:data:`SMOOTH`):
    neighbours that no image tells apart agree. That is worth half a decibel in views that were not trained by.
    """

    def __init__(self, grid: Grid, views: Views, held: Views | None = None):
        self.nodes, types = grid.nodes, grid.nodes.types
        tensor = types.TensorXf
        net = {"density": tensor(np.float32(grid.density / DENSITY_SCALE)), "colour": tensor(np.float32(grid.colour))}
        self.count = dr.opaque(types.UInt32, grid.nodes.count)
        self.neighbours = types.UInt32(neighbours(grid.nodes).reshape(-1))
        super().__init__(types, net, self.field_of, views, held)

    def field_of(self, net) -> GridField:
        """The field of what is trained."""
        density = net["density"]
        return GridField(self.nodes, type(density)(density.array * DENSITY_SCALE), net["colour"])

    def loss(self, net, rng, size: int):
        types = self.types
        density = net["density"].array
        node = types.UInt32(rng.random(types.TensorXf, (VARIED,)).array * types.Float(self.count))
        node = dr.minimum(node, self.count - 1)
        here, variation = dr.gather(types.Float, density, node + 1) * DENSITY_SCALE, types.Float(0)
        for axis in range(3):
            other = dr.gather(types.UInt32, self.neighbours, node * 3 + axis)
            step = here - dr.gather(types.Float, density, other) * DENSITY_SCALE
            variation += dr.select(other != 0, dr.sqrt(dr.square(step) + ROUND), 0)
        return [super().loss(net, rng, size), variation * (SMOOTH / VARIED)]

    def trained(self) -> Grid:
        """The grid with what was trained."""
        return Grid(self.nodes, self.net["density"].numpy() * DENSITY_SCALE, self.net["colour"].numpy())


def neighbours(nodes: Nodes) -> np.ndarray:
    """The numbers of the next nodes along x, y and z of each stored one, 0 of those that are not: ``(n, 3)``."""
    places = nodes.positions()
    numbers = np.zeros(np.array(nodes.shape) + 1, np.uint32)
    numbers[tuple(places.T)] = np.arange(1, len(places) + 1)
    return np.stack([numbers[tuple((places + axis).T)] for axis in np.eye(3, dtype=int)], axis=1)


def begin(types, views: Views, nodes: int, box=None) -> Grid:
    """An empty grid of the views' hull: as fine as a cube of ``nodes``³ of the box's volume."""
    lower, upper = box if box is not None else box_of(views)
    spacing = float((np.prod(upper - lower) / nodes**3) ** (1 / 3))
    shape = np.maximum(2, np.ceil((upper - lower) / spacing - 1e-6).astype(int) + 1)
    inside = hull(views, lower, spacing, shape) if views.has_alpha else np.ones(shape, bool)
    # All cells that have a corner in the hull
    near = np.zeros(tuple(shape - 1), bool)
    for corner in np.ndindex(2, 2, 2):
        near |= inside[tuple(slice(c, n - 1 + c) for c, n in zip(corner, shape, strict=True))]
    grid = Nodes(types, lower, spacing, shape, corners_of(near))
    colour = np.tile(np.float32([BEGIN_COLOUR, 0, 0, 0] * 3), (grid.entries, 1))
    return Grid(grid, np.full(grid.entries, BEGIN_DENSITY, np.float32), colour)


def weights(field: VolumeField, images: Images) -> np.ndarray:
    """
    The largest weight, transmittance times opacity, that each cell has in a ray of the views:
    ``(X − 1, Y − 1, Z − 1)``.
    """
    nodes, types, views = field.nodes, field.types, images.views
    largest = dr.zeros(types.Float, int(np.prod(nodes.shape)))
    lane = dr.arange(types.UInt32, views.height * views.width)
    for view in range(len(views)):
        o, d = images.rays(dr.opaque(types.UInt32, view), lane % views.width, lane // views.width)
        visibility(field, o, d, 0, dr.inf, True, largest)
        dr.eval(largest)
    return largest.numpy().reshape(nodes.shape)[:-1, :-1, :-1]


def visible(grid: Grid, images: Images) -> np.ndarray:
    """The cells that some ray of the views sees, ``(X − 1, Y − 1, Z − 1)`` bool."""
    return weights(grid.field(), images) >= VISIBLE


def divided(grid: Grid, cells: np.ndarray, factor: float, wide: int = 1) -> Grid:
    """
    The grid at ``factor`` times as many nodes along each side, of these ``cells`` (:func:`visible`) and ``wide`` more,
    of the coarser ones, around them.
    """
    nodes = grid.nodes
    if wide:
        cells = binary_dilation(cells, np.ones((3, 3, 3), bool), wide)
    cells = cells & cells_of(nodes.stored)
    spacing = nodes.spacing / factor
    shape = np.maximum(2, np.ceil((np.asarray(nodes.shape) - 1) * factor - 1e-6).astype(int) + 1)
    # A finer cell is kept if its middle lies in one that is
    middle = [
        np.minimum(((np.arange(n - 1) + 0.5) / factor).astype(int), m - 2)
        for n, m in zip(shape, nodes.shape, strict=True)
    ]
    fine = Nodes(nodes.types, nodes.lower, spacing, shape, corners_of(cells[np.ix_(*middle)]))
    at = fine.positions().T / factor

    def sampled(values, begin: float):
        dense = np.full(nodes.shape, begin, np.float32)
        dense[nodes.stored] = values[1:]
        found = map_coordinates(dense, at, order=1, mode="nearest", prefilter=False)
        return np.concatenate([[begin], found]).astype(np.float32)

    colour = [sampled(grid.colour[:, c], 0 if c % 4 else BEGIN_COLOUR) for c in range(12)]
    return Grid(fine, sampled(grid.density, BEGIN_DENSITY), np.stack(colour, axis=1))
