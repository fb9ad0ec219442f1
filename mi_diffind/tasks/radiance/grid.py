"""Sparse grid of plain numbers, trained from coarse to fine: the field that is compressed.

Training begins in the visual hull at a quarter of the nodes along each side, continues at half and three quarters of
them and ends with all of them. Only the last stage has several rays a pixel. Between these stages, cells that no ray
sees (:func:`weights`) are removed and the others are divided, as far as the limit of numbers allows.
"""

from __future__ import annotations

import dataclasses

import drjit as dr
import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, map_coordinates

from ...arrays.indirection import device_array, device_tensor
from ...arrays.sparse_grid import cell_corners, complete_cells
from . import RESOLUTIONS
from .march import march
from .nodes import Nodes
from .session import SIDE, FieldSession, ImagesProblem, ViewImages
from .views import CapturedViews, focus, hull, object_box, pixel_width
from .volume_field import ENTRIES, NodeField, NodeVolume, add_reflections

#: Raw density per unit of the trained parameter, so that one learning rate suits density and colour.
DENSITY_SCALE = 10.0

#: Initial raw density and logarithm of the radiance: nearly empty, and dark.
BEGIN_DENSITY, BEGIN_COLOUR = -4.0, -1.5

#: Weight of the total variation of raw densities, in a box and with surroundings.
SMOOTH, SMOOTH_SURROUNDINGS = 5e-5, 4e-3

#: Square that rounds the kink of the total variation at 0.
ROUND = 1e-2

#: Weight of the smoothness of direction coefficients.
SMOOTH_DIRECTIONS = 5e-5

#: Nodes of a training step whose variation counts.
VARIED = 2**13

#: Sums of the gradients of few entries: atomic ones, since copies of a whole table would cost more.
FEW = dr.ReduceMode.Direct

#: Raw density of empty space, for the normals before reflections are trained.
EMPTY = -6.0

#: Largest weight in a ray below which a cell is removed, in a box and with surroundings. Far things are seen through
#: many faint cells: 0.02 lost 4 dB.
VISIBLE, VISIBLE_SURROUNDINGS = 0.02, 2e-3

#: Least factor by which a grid is refined, unless it asks for less.
LEAST_FACTOR = 1.1


@dataclasses.dataclass
class NodeGrid:
    """Raw ``density`` ``(n,)`` and ``colour`` of the entries of sparse ``nodes``, as NumPy arrays.

    ``colour`` is ``(n, 12)``, or ``(n, 20)`` with an ``environment`` ``(e, 4)``, as in :class:`.NodeField`.
    """

    nodes: Nodes
    density: np.ndarray
    colour: np.ndarray
    environment: np.ndarray | None = None

    def field(self) -> NodeField:
        """Return the grid as a field."""
        return NodeField(self.nodes, **self.tensors())

    def tensors(self) -> dict:
        """Return the arrays of :meth:`field` by name."""
        arrays = {"density": self.density, "colour": self.colour, "environment": self.environment}
        tensor = self.nodes.types.TensorXf
        return {name: device_tensor(tensor, values) for name, values in arrays.items() if values is not None}

    def part(self, stored: np.ndarray) -> NodeGrid:
        """Return the grid with those of its nodes alone that a mask marks as ``stored``."""
        entries = np.concatenate([[True], stored[self.nodes.stored]])
        nodes = self.nodes.like(self.nodes.spacing, self.nodes.shape, stored)
        return NodeGrid(nodes, self.density[entries], self.colour[entries], self.environment)

    def with_reflections(self) -> NodeGrid:
        """Return a grid whose colours have reflections, to be trained; normals point from dense to empty space."""
        dense = np.full(self.nodes.shape, EMPTY, np.float32)
        dense[self.nodes.stored] = np.clip(self.density[1:], EMPTY, -EMPTY)
        slopes = np.stack(np.gradient(gaussian_filter(dense, 1.5)), axis=-1)[self.nodes.stored]  # in nodes
        normals = np.concatenate([[[0, 0, 1]], -slopes / (np.linalg.norm(slopes, axis=1, keepdims=True) + 1e-6)])
        environment = np.zeros((ENTRIES, 4), np.float32)
        return dataclasses.replace(self, colour=add_reflections(self.colour, normals), environment=environment)


class GridProblem(ImagesProblem):
    """Training of a :class:`NodeGrid` through images, with a little total variation of its densities (:data:`SMOOTH`).

    The variation makes neighbours agree that no image distinguishes, which is worth 0.3 dB in held-out views.
    """

    sparse = True
    beta_2 = 0.99

    def __init__(self, grid: NodeGrid, session: FieldSession, side: int = SIDE):
        self.side = side
        self.nodes, types = grid.nodes, grid.nodes.types
        net = dataclasses.replace(grid, density=grid.density / DENSITY_SCALE).tensors()
        self.count = dr.opaque(types.UInt32, grid.nodes.count)
        self.neighbours = device_array(types.UInt32, neighbours(grid.nodes))
        super().__init__(session, net, self.field_of)

    def field_of(self, net) -> NodeField:
        """Return the field of the trained parameters."""
        density = net["density"]
        density = type(density)(density.array * DENSITY_SCALE)
        return NodeField(self.nodes, density, net["colour"], environment=dict(net).get("environment"))

    def loss(self, net, rng, size: int):
        types = self.nodes.types
        density = net["density"].array
        node = types.UInt32(rng.random(types.TensorXf, (VARIED,)).array * types.Float(self.count))
        node = dr.minimum(node, self.count - 1)
        here = dr.gather(types.Float, density, node + 1, mode=FEW) * DENSITY_SCALE
        colours = self.directional(net, node + 1)
        smooth = SMOOTH if self.nodes.contraction is None else SMOOTH_SURROUNDINGS
        total = types.Float(0)
        for axis in range(3):
            other = dr.gather(types.UInt32, self.neighbours, node * 3 + axis)
            step = here - dr.gather(types.Float, density, other, mode=FEW) * DENSITY_SCALE
            variation = smooth * dr.sqrt(dr.square(step) + ROUND)
            for a, b in zip(colours, self.directional(net, other), strict=True):
                variation += SMOOTH_DIRECTIONS * dr.sqrt(dr.square(a - b) + 1e-3)
            total += dr.select(other != 0, variation, 0)
        return [super().loss(net, rng, size), total * (1 / VARIED)]

    def directional(self, net, number) -> list:
        """Return the slopes b of :func:`.volume_field.colour_of` at nodes."""
        colour = net["colour"].array
        packets = net["colour"].shape[1] // 4
        Array4f = self.nodes.types.Array4f
        fours = (dr.gather(Array4f, colour, dr.fma(number, packets, k), mode=FEW) for k in range(3))
        return [value for four in fours for value in list(four)[1:]]

    def grid(self) -> NodeGrid:
        """Return the grid with the trained numbers."""
        net = {name: tensor.numpy() for name, tensor in self.net.items()}
        net["density"] *= DENSITY_SCALE
        return NodeGrid(self.nodes, **net)


def neighbours(nodes: Nodes) -> np.ndarray:
    """Return the numbers of the next nodes along x, y and z of each stored node, ``(n, 3)``; 0 if not stored."""
    places = nodes.positions()
    numbers = np.zeros(np.array(nodes.shape) + 1, np.uint32)
    numbers[tuple(places.T)] = np.arange(1, len(places) + 1)
    return np.stack([numbers[tuple((places + axis).T)] for axis in np.eye(3, dtype=int)], axis=1)


def inner_cube(views: CapturedViews) -> tuple[np.ndarray, float]:
    """Return centre and half side of the cube that is not contracted.

    It is the cube around the ``aabb`` of the capture. Without one, it lies around the point that the cameras look at,
    and reaches half as far as the nearest of them.
    """
    if views.box is not None:
        lower, upper = np.asarray(views.box, np.float64)
        return (lower + upper) / 2, float((upper - lower).max() / 2)
    middle, reach = focus(views)
    return middle, 0.5 * reach


def resolution(views: CapturedViews) -> int:
    """Return the resolution at which a pixel, seen at the middle of the box, is 1.25 voxels wide.

    It is that of :func:`initial_grid`.
    """
    if views.surroundings:
        centre, half = inner_cube(views)
        nodes = 4 * half / pixel_width(views, centre)
    else:
        lower, upper = object_box(views)
        nodes = float(np.prod(upper - lower)) ** (1 / 3) / pixel_width(views, (lower + upper) / 2)
    return int(np.clip(round(nodes * 1.25), *RESOLUTIONS))


def initial_grid(types, views: CapturedViews, nodes: int) -> NodeGrid:
    """Return an empty grid of the visual hull, as fine as a cube of ``nodes``³ nodes with the volume of its box."""
    if views.surroundings:
        # Denser, which keeps haze away that shows each camera a picture of its own
        (centre, half), density, shape = inner_cube(views), -3.0, (nodes,) * 3
        place = centre - 2 * half, 4 * half / (nodes - 1), shape, np.ones(shape, bool)
        places = Nodes(types, *place, inner=(*centre, half))
    else:
        lower, upper = object_box(views)
        spacing, density = float((np.prod(upper - lower) / nodes**3) ** (1 / 3)), BEGIN_DENSITY
        shape = np.maximum(2, np.ceil((upper - lower) / spacing - 1e-6).astype(int) + 1)
        inside = hull(views, lower, spacing, shape) if views.has_alpha else np.ones(shape, bool)
        # Occupied: all cells that have a corner in the hull
        near = ~complete_cells(~inside)
        places = Nodes(types, lower, spacing, shape, cell_corners(near))
    colour = np.tile(np.float32([BEGIN_COLOUR, 0, 0, 0] * 3), (places.entries, 1))
    return NodeGrid(places, np.full(places.entries, density, np.float32), colour)


def weights(field: NodeVolume, images: ViewImages) -> np.ndarray:
    """Return the largest weight (transmittance × opacity) of each cell in a ray: that of its first corner's entry."""
    nodes, types, views = field.nodes, field.types, images.views
    largest = dr.zeros(types.Float, nodes.entries)
    # One ray for each voxel, where that is wider than a pixel; voxels of surroundings are narrower from afar
    middle = (np.array(nodes.lower) + nodes.upper) / 2
    every = max(1, int(nodes.spacing / pixel_width(views, middle))) if nodes.contraction is None else 1
    for view, (height, width) in enumerate((views.sizes // every).tolist()):
        lane, width = dr.arange(types.UInt32, height * width), dr.opaque(types.UInt32, width)
        column, row = (n * dr.opaque(types.UInt32, every) for n in (lane % width, lane // width))
        place = dr.opaque(types.UInt32, view), column, row
        march(field, *images.rays(*place), images.near, dr.inf, images.counted(*place), visibility=largest)
        dr.eval(largest)
    return largest.numpy()


def visible(grid: NodeGrid, images: ViewImages) -> np.ndarray:
    """Return the cells that some ray of the views sees, bool ``(X − 1, Y − 1, Z − 1)``.

    In a field that is nearly empty, since its training has just begun, they are those that are seen best.
    """
    largest = weights(grid.field(), images)
    least = VISIBLE if grid.nodes.contraction is None else VISIBLE_SURROUNDINGS
    return grid.nodes.cells_where((largest > 0) & (largest >= min(least, 0.5 * float(largest.max()))))


def dilate(cells: np.ndarray) -> np.ndarray:
    """Return ``cells`` and those beside them."""
    return binary_dilation(cells, np.ones((3, 3, 3), bool))


def refine(grid: NodeGrid, cells: np.ndarray, factor: float = 1.0) -> NodeGrid:
    """Return the grid reduced to ``cells`` (:func:`visible`), at ``factor`` times as many nodes along each side."""
    nodes = grid.nodes
    cells = cells & complete_cells(nodes.stored)
    if factor == 1:
        return grid.part(cell_corners(cells))
    spacing = nodes.spacing / factor
    shape = np.maximum(2, np.ceil((np.asarray(nodes.shape) - 1) * factor - 1e-6).astype(int) + 1)
    # A finer cell is kept if its middle lies in one that is
    middle = [
        np.minimum(((np.arange(n - 1) + 0.5) / factor).astype(int), m - 2)
        for n, m in zip(shape, nodes.shape, strict=True)
    ]
    fine = nodes.like(spacing, shape, cell_corners(cells[np.ix_(*middle)]))
    at = fine.positions().T / factor

    def resampled(column: np.ndarray, empty: float) -> np.ndarray:
        dense = np.full(nodes.shape, empty, np.float32)
        dense[nodes.stored] = column[1:]
        return np.append(np.float32(empty), map_coordinates(dense, at, order=1, mode="nearest", prefilter=False))

    colours = [resampled(v, BEGIN_COLOUR if c in (0, 4, 8) else 0) for c, v in enumerate(grid.colour.T)]
    density = resampled(grid.density, BEGIN_DENSITY)
    return NodeGrid(fine, density, np.stack(colours, axis=1), grid.environment)


def largest_factor(grid: NodeGrid, cells: np.ndarray, factor: float, numbers: float) -> float:
    """Return the largest factor up to ``factor`` at which :func:`refine` has at most so many ``numbers``.

    A factor near 1 is 1.
    """
    cells = cells & complete_cells(grid.nodes.stored)
    inside = np.count_nonzero(cells)
    beside = np.count_nonzero(cell_corners(cells)) - inside  # nodes at the border grow as a surface does
    tried = np.linspace(factor, 1, 65)
    counts = (inside * tried**3 + beside * tried**2) * (1 + grid.colour.shape[1])
    fits = tried[counts <= numbers]
    return float(fits[0]) if len(fits) and fits[0] >= min(factor, LEAST_FACTOR) else 1.0
