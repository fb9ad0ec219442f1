"""Layout of the supplement (§ 1.6): a dense 3D primary array of coordinates in a dense 3D cascaded array of distances.

The primary array has three channels, the cascaded array one, the truncated distance. Both span the padded box of the
mesh; their sides follow those of the box. The preset ``paper`` starts as the supplement says, ``dense`` from the
distance itself.
"""

import drjit as dr
import numpy as np
from scipy.spatial import cKDTree

from ...arrays.budget import Budget, BudgetError, proportional_shape
from ...arrays.indirection import DifferentiableArray, Indirection, device_array, ramp, rounded, stored_form
from ...arrays.tables import StoredArray, Table
from ...core.errors import UsageError, raised_as
from ...fitting.loop import Problem
from .distances import Distances, sample_box, sample_near
from .evaluation import HELD_OUT, HeldOut
from .field import DistanceField

#: Table 5 of the supplement: sides of the primary over sides of the cascaded array, by megabytes of both. Its text says
#: 1.5 to 2.5; the table's values are taken.
RATIOS = {6: 2.0, 12: 2.56, 16: 2.81, 24: 2.08, 48: 2.71, 96: 2.56}

#: Largest distance that is stored, in spacings of the primary array.
BAND = 2.5

#: Least value of that distance, relative to the longest side.
LEAST_BAND = 0.02

#: Number of cells of the cascaded array along an axis, beyond the first, up to which the bound of the slope is local.
NARROW = 3

#: Training samples.
SAMPLES = 2**20

#: Share of the training samples that is uniform in the box.
UNIFORM = 0.2

#: Starts of the arrays by preset; see :func:`initial`.
STARTS = {"dense": "distance", "paper": "ramp"}


class PairField(DistanceField):
    """Field of a dense primary and a dense cascaded array.

    ``net`` maps coordinates of the box, [0, 1]³, to c, which stands for the distance 2 c − 1 in units of ``band``.
    """

    def __init__(self, types, net: Indirection, lower, upper, band: float, slope: float):
        (primary,) = net.primary
        size = [(b - a) / (n - 1) for a, b, n in zip(lower, upper, primary.resolution, strict=True)]
        super().__init__(types, lower, upper, min(size), band)
        self.net, self.slope = net, float(slope)
        # Opaque, no literal: a new value must not compile the kernels of rays again
        self._bound = dr.opaque(types.Float, self.slope)

    @property
    def bound(self):
        return self._bound

    def update_bound(self):
        self.slope = slope_bound(self.net, self.lower, self.upper, self.band)
        self._bound = dr.opaque(self.types.Float, self.slope)

    def value(self, p, active=True):
        active = self.inside(p) & active
        coordinates = [(x - a) / (b - a) for x, a, b in zip(p, self.lower, self.upper, strict=True)]
        value = dr.fma(self.net(coordinates, active)[0], 2 * self.band, -self.band)
        return dr.select(active, value, self.band)

    def gradient(self, p, active=True):
        # Central differences: the product of two slopes jumps from cell to cell
        h = 0.5 * self.spacing
        Array3f = self.types.Array3f
        steps = [Array3f(*(h if i == axis else 0.0 for i in range(3))) for axis in range(3)]
        p = Array3f(p)
        slope = [(self.value(p + s, active) - self.value(p - s, active)) / (2 * h) for s in steps]
        return self.value(p, active), Array3f(*slope)


def ratio_for(nbytes: int) -> float:
    """Return the ratio of Table 5 for ``nbytes`` bytes: that of the nearest size."""
    return RATIOS[min(RATIOS, key=lambda size: abs(size * 1e6 - nbytes))]


def resolutions(nbytes: int, ratio: float, extent) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the largest resolutions of primary and cascaded array in this ``ratio`` that fit ``nbytes`` bytes.

    Entries take 3 bytes in the primary and 1 byte in the cascaded array; sides follow the ``extent`` of the box. Raises
    :class:`.UsageError` if even the smallest arrays are larger.
    """

    def shapes(n: int) -> tuple:
        return proportional_shape(n, extent), proportional_shape(n / ratio, extent)

    with raised_as(UsageError, BudgetError, at="--bytes"):
        sides = range(4, max(5, nbytes))
        return shapes(Budget(nbytes).largest(lambda n: [((*shapes(n)[0], 3), 8), (shapes(n)[1], 8)], sides))


def initial(start: str, primary, cascaded, grid_distance, samples, distances, band: float) -> Indirection:
    """Return the arrays at the start of the training.

    ``start`` is ``"ramp"`` or ``"constant"``: pointers are a ramp, the cascaded array has the distance of the nearest
    of the ``samples`` in [0, 1]³ (n, 3), whose distances are ``distances`` (n,); or ``"distance"``: the first pointer
    is the truncated distance, which the function ``grid_distance`` returns at the entries of an array of some
    resolution.
    """
    pointers = ramp(primary, 3, ("clamp",) * 3)
    if start == "distance":
        pointers[..., 0] = np.clip(grid_distance(primary) / band, -1, 1) / 2 + 0.5
        entries = ramp(cascaded, 1, ("clamp",) * 3)
    else:
        places = ramp(cascaded, 3, ("clamp",) * 3).reshape(-1, 3)
        nearest = cKDTree(samples).query(places, workers=-1)[1]
        entries = np.clip(distances[nearest] / band, -1, 1).reshape(*cascaded, 1) / 2 + 0.5
    # Both are folded: distances are bounded
    return Indirection(
        DifferentiableArray(primary, 3, pointers, fold=True), DifferentiableArray(cascaded, 1, entries, fold=True)
    )


def slope_bound(net: Indirection, lower, upper, band: float) -> float:
    """Return a bound Λ of the field's slope.

    For each cell of the primary array: how fast its pointers change, times the steepest slope of the cascaded array
    among the cells that they may reach.
    """
    pointers, values = net.primary[0].numpy().astype(np.float64), net.cascaded.numpy()[..., 0].astype(np.float64)
    size = [(b - a) / (n - 1) for a, b, n in zip(lower, upper, pointers.shape, strict=False)]
    last = np.array(values.shape) - 1
    # Cells of the cascaded array that pointers reach: the first along each axis, and how many follow
    corners = np.lib.stride_tricks.sliding_window_view(pointers, (2, 2, 2), axis=(0, 1, 2))
    ends = np.stack([end(corners, axis=(-3, -2, -1)) for end in (np.min, np.max)], axis=-1) * last[:, None]
    reach = np.clip(np.floor(ends).astype(int), 0, last[:, None] - 1)
    first, more = reach[..., 0], reach[..., 1] - reach[..., 0]
    cells = np.stack([edge_steps(values, c) * last[c] for c in range(3)], axis=-1)
    # Where they are many, the steepest slope of all cells
    local = np.empty_like(first, dtype=np.float64)
    local[...] = cells.max(axis=(0, 1, 2))
    narrow = np.flatnonzero(np.all(more <= NARROW, axis=-1))
    first, more, steepest = first.reshape(-1, 3)[narrow], more.reshape(-1, 3)[narrow], np.zeros((len(narrow), 3))
    for offset in np.ndindex((NARROW + 1,) * 3):
        some = np.flatnonzero(np.all(more >= offset, axis=1))
        at = first[some] + offset
        steepest[some] = np.maximum(steepest[some], cells[tuple(at.T)])
    local.reshape(-1, 3)[narrow] = steepest
    square = 0.0
    for axis in range(3):
        along = sum(edge_steps(pointers[..., c], axis) / size[axis] * local[..., c] for c in range(3))
        square = square + along**2
    return max(1.0, float(2 * band * np.sqrt(square.max())))


def edge_steps(values: np.ndarray, axis: int) -> np.ndarray:
    """Return the largest of the four differences along ``axis`` in every cell of a grid of ``values`` (X, Y, Z)."""
    steps, others = np.abs(np.diff(values, axis=axis)), tuple({0, 1, 2} - {axis})
    return np.lib.stride_tricks.sliding_window_view(steps, (2, 2), axis=others).max(axis=(-2, -1))


class PairProblem(Problem):
    """Training of the supplement: truncated distances, mostly near the surface, in units of the band.

    ``shapes`` are the :func:`resolutions` of both arrays and ``start`` is that of :func:`initial`; ``samples`` and
    ``held_out`` are the numbers of training samples and of points measured on the way.
    """

    def __init__(
        self, distances: Distances, shapes, start: str, types, seed: int = 0, samples: int = SAMPLES,
        held_out: int = HELD_OUT,
    ):  # fmt: skip
        mesh, (primary, cascaded) = distances.mesh, shapes
        extent = mesh.upper - mesh.lower
        # The box ends a cell and a half outside of the mesh
        padding = 1.5 * extent.max() / (max(primary) - 4)
        lower, upper = mesh.lower - padding, mesh.upper + padding
        size = upper - lower
        spacing = float((size / (np.array(primary) - 1)).max())
        band = max(LEAST_BAND, BAND * spacing)
        uniform = int(UNIFORM * samples)
        points = np.concatenate([
            sample_near(distances.surface, samples - uniform, spacing / 2, [seed, 1]),
            sample_box(lower, upper, uniform, [seed, 2]),
        ]).clip(lower, upper)  # fmt: skip
        d = distances.signed(points)
        unit = (points - lower) / size

        def grid_distance(resolution):
            axes = [np.linspace(a, b, n) for a, b, n in zip(lower, upper, resolution, strict=True)]
            nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
            return distances.signed(nodes.reshape(-1, 3)).reshape(resolution)

        # With a constant start, one sample on the surface is the nearest to all entries
        known = (unit[:1], np.zeros(1)) if start == "constant" else (unit, d)
        self.net = initial(start, primary, cascaded, grid_distance, *known, band).alloc(types.TensorXf)
        self.field, self.types = PairField(types, self.net, lower, upper, band, 1.0), types
        self.points = [device_array(types.Float, v) for v in unit.T]
        self.targets = device_array(types.Float, np.clip(d / band, -1, 1) / 2 + 0.5)
        self.held_out = HeldOut(distances, types, spacing / 2, count=held_out)
        self.identity = {"source": mesh.digest, "resolution": list(primary)}
        self.start, self.ratio = start, primary[0] / cascaded[0]

    def batch(self, rng, size: int):
        Float, UInt32 = self.types.Float, self.types.UInt32
        count = dr.width(self.targets)
        index = dr.minimum(UInt32(rng.random(Float, size) * count), count - 1)
        return [dr.gather(Float, v, index) for v in self.points], {"d": [dr.gather(Float, self.targets, index)]}

    def predict(self, net, inputs):
        return {"d": rounded(net)(inputs)}

    def measure(self, net):
        with dr.suspend_grad():
            self.field.net = rounded(net)
            errors = self.held_out.measure(self.field)
            self.field.net = net
            return errors

    def table(self, seed: int) -> Table:
        """Return the arrays as a file holds them."""
        stored, field = stored_form(self.net), self.field
        settings = {
            "layout": "pair", "lower": list(field.lower), "upper": list(field.upper), "band": field.band,
            "slope": slope_bound(stored, field.lower, field.upper, field.band), "ratio": self.ratio,
            "start": self.start,
        }  # fmt: skip
        arrays = {"primary": StoredArray.of(stored.primary[0]), "cascaded": StoredArray.of(stored.cascaded)}
        return Table("sdf", arrays, settings=settings)
