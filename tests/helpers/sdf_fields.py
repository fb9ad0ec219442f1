"""Signed distance fields that are formulas, for tests, and how a scene gets them as shapes."""

import math

import drjit as dr
import numpy as np

from mi_diffind.core.compat import backend_module
from mi_diffind.tasks.sdf.field import DistanceField


class Ball(DistanceField):
    """A ball of the radius ``r`` (a number, or an array that may be optimised) around ``centre``.

    Its distance is told within ``band``; ``tilt`` turns the gradient about z, and smooth normals are not of length 1.
    """

    def __init__(self, types, r=0.4, centre=(0, 0, 0), half=0.5, band=1.0, tilt=0.0):
        super().__init__(types, (-half,) * 3, (half,) * 3, 0.01, band)
        # Opaque: balls of other sizes and places use the same kernels
        self.r, self.centre = dr.opaque(types.Float, r), dr.opaque(types.Array3f, centre)
        self.cosine, self.sine = math.cos(tilt), math.sin(tilt)

    def value(self, p, active=True):
        return self.gradient(p, active)[0]

    def gradient(self, p, active=True):
        to = self.types.Array3f(*(x - c for x, c in zip(p, self.centre, strict=True)))
        length = dr.norm(to)
        inside = self.inside(p) & active
        x, y, z = dr.select(length > 0, to / dr.select(length > 0, length, 1), 0)
        n = self.types.Array3f(self.cosine * x - self.sine * y, self.sine * x + self.cosine * y, z)
        distance = dr.clip(length - self.r, -self.band, self.band)
        return dr.select(inside, distance, self.band), dr.select(inside, n, 0)

    def normal(self, p, active=True):
        return 3 * self.types.Array3f(*(x - c for x, c in zip(p, self.centre, strict=True)))


class Slab(DistanceField):
    """Plate within ``thickness`` / 2 of the plane z = 0, up to the sides of the box."""

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
        array, self.resolution = values.numpy().astype(np.float64), values.shape
        size = [(b - a) / (n - 1) for a, b, n in zip(lower, upper, values.shape, strict=True)]
        super().__init__(backend_module(values), lower, upper, min(size), band)
        self.texture = self.types.Texture3f(type(values)(values.array, (*values.shape, 1)), use_accel=False)
        steps = [np.abs(np.diff(array, axis=axis)).max() / h for axis, h in enumerate(size)]
        self.slope = max(1.0, float(np.linalg.norm(steps)))

    def value(self, p, active=True):
        active = self.inside(p) & active
        sides = zip(p, self.lower, self.upper, self.resolution, strict=True)
        place = [((x - a) / (b - a) * (n - 1) + 0.5) / n for x, a, b, n in sides]
        return dr.select(active, self.texture.eval(self.types.Array3f(*reversed(place)), active)[0], self.band)

    def gradient(self, p, active=True):
        h, p = 0.01 * self.spacing, self.types.Array3f(p)
        steps = [self.types.Array3f(*v) for v in (h * np.eye(3)).tolist()]
        slope = [(self.value(p + v, active) - self.value(p - v, active)) / (2 * h) for v in steps]
        return self.value(p, active), self.types.Array3f(*slope)


def torus(p):
    """Distance to a torus of radii 0.34 and 0.12 that fills the unit frame, and its gradient, at points (n, 3)."""
    ring = np.linalg.norm(p[:, :2], axis=1)
    to = np.stack([ring - 0.38, p[:, 2]], axis=1)
    length = np.maximum(np.linalg.norm(to, axis=1), 1e-12)
    flat = p[:, :2] / np.maximum(ring, 1e-12)[:, None] * (to[:, :1] / length[:, None])
    return length - 0.12, np.concatenate([flat, to[:, 1:] / length[:, None]], axis=1)


def coded(sampled, count=None):
    """The codes of sampled nodes, not trained: ``count`` entries, by default as many as pointers can name."""
    from mi_diffind.tasks.sdf import encoding

    coding = encoding.NodeCoding(sampled)
    coding.frames = encoding.fit_frames(sampled)
    wanted = encoding.exact_entries(sampled, coding.frames)
    coding.entries = encoding.cluster(wanted, count or sampled.entries)
    coding.pointers = encoding.assign(wanted, coding.entries)
    return coding


def coded_table(coding):
    """The table of these codes."""
    from mi_diffind.arrays.tables import Table
    from mi_diffind.tasks.sdf import model

    arrays, settings = model.coded_arrays(coding)
    return Table("sdf", arrays, "sparse", settings)


def sparse_table(shape=torus, entries=256, scale=2.0, centre=(0.5, -1.0, 0.25)):
    """The table of a formula's sparse field, as ``fit sdf`` would write it; pointers have 8 bits."""
    from mi_diffind.arrays.sparse_grid import SparseGrid, cell_corners, complete_cells
    from mi_diffind.tasks.sdf import encoding

    spacing = 1 / 40
    lower = np.array([-0.5, -0.5, -0.5]) - 1.5 * spacing
    n = int(np.ceil((1 + 3 * spacing) / spacing)) + 1

    def sign(p):
        return shape(np.asarray(p))[0] < 0

    inside = sign(lower + spacing * np.argwhere(np.ones((n, n, n)))).reshape(n, n, n)
    used = np.argwhere(cell_corners(~complete_cells(inside) & ~complete_cells(~inside)))
    grid = SparseGrid.from_nodes(used, inside[tuple(used.T)], (n, n, n), lower, spacing, sign)
    positions, block = grid.node_positions()
    d, g = shape(np.array(grid.lower) + spacing * positions)
    corners = encoding.crossed_cells(grid, d < 0)
    sampled = encoding.SampledNodes(grid, positions, block, d / spacing, g, corners, len(corners), 0.0, 8)
    table = coded_table(coded(sampled, entries))
    table.settings |= {"scale": scale, "centre": list(centre)}
    return table


def register(mi, fields: dict, name: str = "test_solid") -> None:
    """A shape ``name`` whose ``field`` is the key of one in ``fields``; its box is as large as in the unit frame."""
    from mi_diffind.plugins.support import distance_shapes as shapes
    from mi_diffind.plugins.support.placement import Placement

    def make(props):
        placement = Placement(props.get("to_world"))
        return Held(props, fields[props["field"]], placement, props.get("smooth", False))

    class Held(shapes.distance_shape(mi.Mesh)):
        def attached(self):
            values = [v for v in vars(self.field).values() if isinstance(v, mi.Float)]
            return super().attached() + [v for v in values if dr.is_diff_v(v) and v.index_ad]

    mi.register_shape(name, make)
