"""Layout of the supplement (§ 1.7): two pairs of dense 3D arrays, one for density and one for twelve numbers of colour.

The primary arrays begin as ramps, the cascaded arrays as the grid resampled to their size. Cells that no ray sees are
empty, as in all fields here; the supplement keeps them.
"""

import math

import drjit as dr
import numpy as np
from drjit import nn
from scipy.ndimage import distance_transform_edt, map_coordinates

from ...arrays.budget import Budget, proportional_shape
from ...arrays.indirection import DifferentiableArray, Indirection, ramp, rounded
from ...fitting.loop import Problem
from .grid import NodeGrid
from .nodes import Nodes
from .session import FieldSession, ImagesProblem
from .volume_field import NodeVolume, blended, colour_of, density_of

#: Range of raw densities: empty space has the smallest, the largest is opaque.
EMPTIEST, DENSEST = -8.0, 16.0


class PairsField(NodeVolume):
    """Radiance field of two indirections, ``density`` and ``colour``.

    Both map coordinates of the box, [0, 1]³, to numbers in [0, 1] that stand for the range from ``low`` to ``high``,
    13 numbers each, density first. Cells of ``nodes`` that are not stored are empty.
    """

    NAMES = ("density_primary", "density_cascaded", "colour_primary", "colour_cascaded")

    def __init__(self, nodes: Nodes, density: Indirection, colour: Indirection, low, high):
        self.low, self.high = [float(v) for v in low], [float(v) for v in high]
        modules = density.primary[0], density.cascaded, colour.primary[0], colour.cascaded
        self.modules = dict(zip(self.NAMES, modules, strict=True))
        arrays = {name: module.data for name, module in self.modules.items()}
        super().__init__(nodes, arrays)

    @property
    def nbytes(self) -> int:
        """Bytes in memory, including the index of the nodes."""
        return sum(module.memory_nbytes for module in self.modules.values()) + self.nodes.nbytes

    def with_arrays(self, arrays):
        result = super().with_arrays(arrays)
        modules = self.modules.items()
        result.modules = {name: module._replace(data=arrays.get(name)) for name, module in modules}
        return result

    def _read(self, quantity: str, p, active) -> list:
        u = [dr.clip((x - a) / (b - a), 0, 1) for x, a, b in zip(p, *self.box, strict=True)]
        return self.modules[f"{quantity}_cascaded"](self.modules[f"{quantity}_primary"](u, active), active)

    def density_at(self, p, active=True):
        _, active = self.nodes.corners(p, active)
        (share,) = self._read("density", p, active)
        raw = dr.fma(share, self.high[0] - self.low[0], self.low[0])
        return dr.select(active, density_of(raw, self.per_voxel), 0), []

    def radiance_at(self, point_data, p, d, active=True):
        shares = self._read("colour", p, active)
        return colour_of([dr.fma(v, b - a, a) for v, a, b in zip(shares, self.low[1:], self.high[1:], strict=True)], d)


def sides(nbytes: float, ratio: float, channels: int, extent) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the shapes of a primary and a cascaded array that together fill ``nbytes``, in the ratio ``ratio``.

    An entry of the primary array has 3 bytes, one of the cascaded array ``channels``. The sides are proportional to
    the ``extent`` of the box.
    """
    shape = np.asarray(extent, np.float64) / np.max(extent)

    def arrays(n: float) -> list[tuple]:
        sides = ((n, 3), (n / ratio, channels))
        return [((*proportional_shape(side, extent), count), 8) for side, count in sides]

    most = 4 + (nbytes / (3 + channels * ratio**-3) / np.prod(shape)) ** (1 / 3)
    steps = range(max(0, math.ceil(2 * (most - 3))), -1, -1)
    n = Budget(nbytes).largest(arrays, [most - step / 2 for step in steps], strict=False)
    return tuple(shape[:3] for shape, _ in arrays(n))


def dense(grid: NodeGrid) -> np.ndarray:
    """Return the 13 numbers of every node, ``(X, Y, Z, 13)``; a node that is not stored has those of the nearest."""
    values = np.concatenate([np.clip(grid.density, EMPTIEST, DENSEST)[:, None], grid.colour], axis=1)[1:]
    result = np.zeros((*grid.nodes.shape, 13), np.float32)
    stored = grid.nodes.stored
    result[stored] = values
    nearest = distance_transform_edt(~stored, return_distances=False, return_indices=True)
    result = result[tuple(nearest)]
    result[~stored, 0] = EMPTIEST
    return result


def initial(values: np.ndarray, shapes: dict, types) -> tuple[Indirection, Indirection, np.ndarray, np.ndarray]:
    """Return the two initial pairs for the ``values`` of :func:`dense`, and the lower and upper ends of their range."""
    flat = values.reshape(-1, 13)
    low, high = np.quantile(flat, 0.0005, axis=0), np.quantile(flat, 0.9995, axis=0)
    low[0], high[0] = EMPTIEST, DENSEST
    high = np.maximum(high, low + 1e-3)

    def pair(quantity: str, part: slice):
        primary, cascaded = shapes[quantity]
        at = [np.linspace(0, n - 1, m) for n, m in zip(values.shape, cascaded, strict=False)]
        at = np.stack(np.meshgrid(*at, indexing="ij"))
        channels = [map_coordinates(values[..., c], at, order=1) for c in range(13)[part]]
        entries = np.clip((np.stack(channels, axis=-1) - low[part]) / (high - low)[part], 0, 1)
        net = Indirection(
            DifferentiableArray(primary, 3, ramp(primary, 3, ("clamp",) * 3), fold=True),
            DifferentiableArray(cascaded, entries.shape[-1], entries.astype(np.float32), fold=True),
        )
        return net.alloc(types.TensorXf)

    return pair("density", slice(0, 1)), pair("colour", slice(1, 13)), low, high


class PairsNet(nn.Module):
    """Both pairs as one trainable module."""

    DRJIT_STRUCT = {"density": object, "colour": object}  # noqa: RUF012

    def __init__(self, density=None, colour=None):
        self.density, self.colour = density, colour


class PairsProblem(ImagesProblem):
    """Training of the pairs through the images of a session."""

    def __init__(self, net: PairsNet, nodes: Nodes, low, high, session: FieldSession):
        self.nodes, self.low, self.high = nodes, low, high
        super().__init__(session, net, self.field_of)

    def field_of(self, net) -> PairsField:
        """Return the field of the trained arrays, rounded as they are stored."""
        return PairsField(self.nodes, rounded(net.density), rounded(net.colour), self.low, self.high)

    def field(self) -> PairsField:
        """Return the field of the trained arrays."""
        return PairsField(self.nodes, self.net.density, self.net.colour, self.low, self.high)


class ValuesProblem(Problem):
    """Training of the pairs by the mean absolute error of the grid's numbers, at random points of occupied cells."""

    def __init__(self, net: PairsNet, field: PairsField, grid: NodeGrid):
        self.net, self.grid, self.box = net, grid.field(), field
        self.positions = grid.nodes.types.Float(grid.nodes.positions().astype(np.float32).reshape(-1))
        self.types, self.count = grid.nodes.types, grid.nodes.count

    def loss(self, net, rng, size: int):
        types, nodes, box = self.types, self.grid.nodes, self.box
        node = dr.minimum(types.UInt32(rng.random(types.TensorXf, (size,)).array * self.count), self.count - 1)
        first = dr.gather(types.Array3f, self.positions, node)
        offset = rng.random(types.TensorXf, (3 * size,)).array
        lane = dr.arange(types.UInt32, size)
        inside = [dr.gather(types.Float, offset, lane + c * size) for c in range(3)]
        p = types.Array3f(
            *(dr.fma(f + i, nodes.spacing, a) for f, i, a in zip(first, inside, nodes.lower, strict=True))
        )
        corners, active = nodes.corners(p)
        weights, numbers = zip(*corners, strict=True)
        raw = sum(w * dr.gather(types.Float, self.grid.arrays["density"].array, n, active) for w, n in corners)
        truth = [raw, *blended(types, self.grid.arrays["colour"].array, 3, weights, numbers, active)]
        u = [dr.clip((x - a) / (b - a), 0, 1) for x, a, b in zip(p, box.lower, box.upper, strict=True)]
        density, colour = rounded(net.density), rounded(net.colour)
        predicted = [*density(u), *colour(u)]
        total = types.Float(0)
        for f, t, a, b in zip(predicted, truth, box.low, box.high, strict=True):
            total += dr.select(active, dr.abs(f - (dr.clip(t, a, b) - a) / (b - a)), 0)
        return total * (1 / (13 * size))

    def measure(self, net):
        return {"step": 0.0}
