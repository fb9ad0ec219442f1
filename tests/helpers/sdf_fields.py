"""Signed distance fields that are formulas, for tests, and how a scene gets them as shapes."""

import drjit as dr
import numpy as np

from mi_diffind.arrays.lookup import clamp
from mi_diffind.core.compat import module_of
from mi_diffind.tasks.sdf.field import DistanceField
from mi_diffind.tasks.sdf.paper import edge_steps


class Ball(DistanceField):
    """A ball of the radius ``r`` (a number, or an array that may be optimised) around ``centre``."""

    def __init__(self, types, r=0.4, centre=(0, 0, 0), half=0.5):
        super().__init__(types, (-half,) * 3, (half,) * 3, 0.01, 1.0)
        # Opaque: balls of other sizes and places use the same kernels
        self.r, self.centre = dr.opaque(types.Float, r), dr.opaque(types.Array3f, centre)

    def value(self, p, active=True):
        return self.gradient(p, active)[0]

    def gradient(self, p, active=True):
        to = self.types.Array3f(*(x - c for x, c in zip(p, self.centre, strict=True)))
        length = dr.norm(to)
        inside = self.inside(p) & active
        unit = dr.select(length > 0, to / dr.select(length > 0, length, 1), 0)
        return dr.select(inside, length - self.r, self.band), dr.select(inside, unit, 0)


class Slab(DistanceField):
    """What lies within ``thickness`` / 2 of the plane z = 0, up to the sides of the box."""

    def __init__(self, types, thickness, normal=(0.0, 0.0, 1.0)):
        super().__init__(types, (-0.5,) * 3, (0.5,) * 3, 0.01, 1.0)
        self.axis = np.asarray(normal) / np.linalg.norm(normal)
        # Opaque: other slabs use the same kernels
        self.half, self.normals = dr.opaque(types.Float, thickness / 2), dr.opaque(types.Array3f, self.axis.tolist())

    def value(self, p, active=True):
        along = sum(x * n for x, n in zip(p, self.normals, strict=True))
        return dr.select(self.inside(p) & active, dr.abs(along) - self.half, self.band)

    def gradient(self, p, active=True):
        along = sum(x * n for x, n in zip(p, self.normals, strict=True))
        return self.value(p, active), self.normals * dr.sign(along)


class Steps(Ball):
    """A ball whose values jump over zero: ± 0.02 of the distance's sign beyond it, and only a third of the distance."""

    def gradient(self, p, active=True):
        value, slope = super().gradient(p, active)
        return dr.copysign(dr.abs(value) / 3 + 0.02, value), slope

    def safe_step(self, p, d, active=True):
        value = self.value(p, active)
        return value, dr.abs(value) - 0.02


class TrilinearField(DistanceField):
    """Trilinear interpolation of ``values``, a tensor (X, Y, Z) whose outermost entries lie on the sides of the box."""

    def __init__(self, values, lower, upper, band: float):
        self.values = values
        self.resolution = tuple(values.shape)
        size = [(b - a) / (n - 1) for a, b, n in zip(lower, upper, self.resolution, strict=True)]
        super().__init__(module_of(values), lower, upper, min(size), band)
        self.size = tuple(map(float, size))
        # In each cell, every component of the gradient lies between its four differences along the edges
        steps = [edge_steps(values.numpy(), axis).astype(np.float64) / h for axis, h in enumerate(self.size)]
        self.slope = max(1.0, float(np.sqrt(sum(s**2 for s in steps).max())))

    def _read(self, p, active):
        """For each axis the weight of the upper entry, and the eight entries around points."""
        UInt32, index, weights = self.types.UInt32, [], []
        for x, a, h, n in zip(p, self.lower, self.size, self.resolution, strict=True):
            t = clamp((x - a) / h, 0.0, n - 1.0)
            i = dr.minimum(UInt32(dr.detach(t)), n - 2)
            index.append(i)
            weights.append(t - self.types.Float(i))
        _, ny, nz = self.resolution
        first = (index[0] * ny + index[1]) * nz + index[2]

        def get(n):
            return dr.gather(self.types.Float, self.values.array, first + n, active)

        return weights, [[[get((a * ny + b) * nz + c) for c in (0, 1)] for b in (0, 1)] for a in (0, 1)]

    def value(self, p, active=True):
        active = self.inside(p) & active
        (u, s, w), v = self._read(p, active)
        rows = [dr.lerp(dr.lerp(v[a][0][0], v[a][0][1], w), dr.lerp(v[a][1][0], v[a][1][1], w), s) for a in (0, 1)]
        return dr.select(active, dr.lerp(rows[0], rows[1], u), self.band)

    def gradient(self, p, active=True):
        active = self.inside(p) & active
        (u, s, w), v = self._read(p, active)
        edge = [[dr.lerp(v[a][b][0], v[a][b][1], w) for b in (0, 1)] for a in (0, 1)]
        across = [[v[a][b][1] - v[a][b][0] for b in (0, 1)] for a in (0, 1)]
        lines = [dr.lerp(edge[a][0], edge[a][1], s) for a in (0, 1)]
        dx = lines[1] - lines[0]
        dy = dr.lerp(edge[0][1] - edge[0][0], edge[1][1] - edge[1][0], u)
        dz = dr.lerp(dr.lerp(across[0][0], across[0][1], s), dr.lerp(across[1][0], across[1][1], s), u)
        slope = self.types.Array3f(dx / self.size[0], dy / self.size[1], dz / self.size[2])
        return dr.select(active, dr.lerp(lines[0], lines[1], u), self.band), dr.select(active, slope, 0)


def torus(p):
    """Distance to a torus of radii 0.34 and 0.12 that fills the unit frame, and its gradient, at points (n, 3)."""
    ring = np.linalg.norm(p[:, :2], axis=1)
    to = np.stack([ring - 0.38, p[:, 2]], axis=1)
    length = np.maximum(np.linalg.norm(to, axis=1), 1e-12)
    flat = p[:, :2] / np.maximum(ring, 1e-12)[:, None] * (to[:, :1] / length[:, None])
    return length - 0.12, np.concatenate([flat, to[:, 1:] / length[:, None]], axis=1)


def sparse_table(shape=torus, spacing=1 / 40, entries=256, scale=2.0, centre=(0.5, -1.0, 0.25)):
    """The table of a formula's sparse field, as ``fit sdf`` would write it; pointers have 8 bits."""
    from mi_diffind.arrays.sparse_grid import SparseGrid, cell_corners
    from mi_diffind.arrays.tables import Table
    from mi_diffind.tasks.sdf import encoding, model, nodes

    lower = np.array([-0.5, -0.5, -0.5]) - 1.5 * spacing
    n = int(np.ceil((1 + 3 * spacing) / spacing)) + 1
    index = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = (shape(lower + spacing * index)[0] < 0).reshape(n, n, n)
    corner = np.lib.stride_tricks.sliding_window_view(inside, (2, 2, 2)).reshape(n - 1, n - 1, n - 1, 8)
    used = np.argwhere(cell_corners(corner.any(-1) & ~corner.all(-1)))

    def sign(p):
        return shape(np.asarray(p))[0] < 0

    grid = SparseGrid.from_nodes(used, sign(lower + spacing * used), (n, n, n), lower, spacing, sign)
    positions, block = grid.node_positions()
    d, g = shape(np.array(grid.lower) + spacing * positions)
    corners = encoding.crossed_cells(grid, d < 0)
    sampled = encoding.SampledNodes(grid, positions, block, d / spacing, g, corners, len(corners), 0.0)
    frames = encoding.fit_frames(sampled)
    wanted = encoding.exact_entries(sampled, frames)
    bits, entries = 8, encoding.cluster(wanted, entries)
    pointers = encoding.assign(wanted, entries)
    table = Table("sdf", model.sparse_arrays(grid, frames, nodes.pointer_words(pointers, bits), entries))
    table.preset = "sparse"
    slope = nodes.slope_bound(d / spacing, g, corners)
    table.settings = {"layout": "sparse", "lower": list(grid.lower), "spacing": spacing, "bits": bits,
                      "nodes": grid.nodes, "slope": slope, "scale": scale, "centre": list(centre)}  # fmt: skip
    return table


def dense_table(shape=torus, half=(0.6, 0.6, 0.25), resolution=(48, 48, 20), scale=2.0, centre=(0.5, -1.0, 0.25)):
    """The table of a formula's field in two dense arrays, as ``fit sdf --preset dense`` starts."""
    from mi_diffind.arrays.tables import StoredArray, Table
    from mi_diffind.core.runtime import array_module
    from mi_diffind.tasks.sdf import paper

    upper, band = np.array(half), 0.1

    def distance(sides):
        axes = [np.linspace(-x, x, n) for x, n in zip(upper, sides, strict=True)]
        return shape(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3))[0].reshape(sides)

    net = paper.initial("distance", resolution, (4, 4, 4), distance, None, None, band)
    net = paper.stored_form(net.alloc(array_module("llvm").TensorXf))
    arrays = {"primary": StoredArray.of(net.primary[0]), "cascaded": StoredArray.of(net.cascaded)}
    settings = {"layout": "pair", "lower": (-upper).tolist(), "upper": upper.tolist(), "band": band, "scale": scale}
    settings |= {"slope": paper.slope_bound(net, -upper, upper, band), "centre": list(centre)}
    return Table("sdf", arrays, "dense", settings)


def register(mi, fields: dict, name: str = "test_solid") -> None:
    """A shape ``name`` whose ``field`` is the key of one in ``fields``; its box is as large as in the unit frame."""
    from mi_diffind.plugins.support import distance_shapes as shapes
    from mi_diffind.plugins.support.placement import Placement

    def make(props):
        placement = Placement.of(props.get("to_world", mi.ScalarTransform4f()), 1.0, (0, 0, 0))
        return Held(props, fields[props["field"]], placement, props.get("smooth", False))

    class Held(shapes.distance_shape(mi.Mesh)):
        def attached(self):
            values = [v for v in vars(self.field).values() if isinstance(v, mi.Float)]
            return super().attached() + [v for v in values if dr.is_diff_v(v) and v.index_ad]

    mi.register_shape(name, make)
