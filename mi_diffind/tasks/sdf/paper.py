"""
The supplement's layout (§ 1.6): a dense 3D primary array whose three channels are the coordinate in a dense 3D cascaded
array of truncated distances. Both span the padded box of the mesh; their sides follow those of the box.
"""

from __future__ import annotations

import drjit as dr
import numpy as np
from scipy.spatial import cKDTree

from ...indirection import DifferentiableArray, Indirection, ramp
from ...units import largest_fitting
from .field import DistanceField, edge_steps

#: Of the spacing of the primary array: how far distances are told. At least :data:`LEAST_BAND` of the longest side.
BAND = 2.5
LEAST_BAND = 0.02

#: Cells of the cascaded array along an axis, beyond the first, that a bound of the slope looks at one by one.
NARROW = 3


class PairField(DistanceField):
    """
    ``net`` maps coordinates of the box, [0, 1]³, to distances in units of ``band``, as 2 c − 1 of what the cascaded
    array says.
    """

    def __init__(self, types, net: Indirection, lower, upper, band: float, slope: float):
        (primary,) = net.primary
        size = [(b - a) / (n - 1) for a, b, n in zip(lower, upper, primary.resolution, strict=True)]
        super().__init__(types, lower, upper, min(size), band)
        self.net, self.slope, self._bound = net, float(slope), None

    @property
    def bound(self):
        return self.slope if self._bound is None else self._bound

    def changed(self):
        self.slope = slope_of(self.net, self.lower, self.upper, self.band)
        # Not a literal of the kernels that rays run: another one would compile them anew
        self._bound = dr.opaque(self.types.Float, self.slope)

    def _coordinates(self, p):
        return [(x - a) / (b - a) for x, a, b in zip(p, self.lower, self.upper, strict=True)]

    def value(self, p, active=True):
        active = self.inside(p) & active
        found = dr.fma(self.net(self._coordinates(p), active)[0], 2 * self.band, -self.band)
        return dr.select(active, found, self.band)

    def gradient(self, p, active=True):
        # Central differences: the product of two slopes jumps from cell to cell
        h = 0.5 * self.spacing
        Array3f = self.types.Array3f
        steps = [Array3f(*(h if i == axis else 0.0 for i in range(3))) for axis in range(3)]
        p = Array3f(p)
        slope = [(self.value(p + s, active) - self.value(p - s, active)) / (2 * h) for s in steps]
        return self.value(p, active), Array3f(*slope)


def resolutions(nbytes: int, ratio: float, extent) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """
    Entries of the primary (3 bytes each) and the cascaded array (1 byte each) along the sides of a box of this
    ``extent``: as many as ``nbytes`` hold, in this ratio.
    """
    extent = np.asarray(extent, dtype=np.float64)

    def sides(n: float):
        primary = np.maximum(2, np.round(n * extent / extent.max()).astype(int))
        cascaded = np.maximum(2, np.round(n / ratio * extent / extent.max()).astype(int))
        return primary, cascaded

    def fits(n: float) -> bool:
        primary, cascaded = sides(n)
        return 3 * primary.prod() + cascaded.prod() <= nbytes

    n = max(4, int((nbytes / (3 + ratio**-3) / np.prod(extent / extent.max())) ** (1 / 3)) + 4)
    n = largest_fitting(fits, 4, n + 1)
    primary, cascaded = sides(n)
    return tuple(primary.tolist()), tuple(cascaded.tolist())


def initial(start: str, primary, cascaded, grid_distance, samples, distances, band: float) -> Indirection:
    """
    The arrays as they begin (:class:`.presets.Recipe`). ``grid_distance`` is a function that gives distances at the
    entries of an array of some resolution; ``samples`` in [0, 1]³ (n, 3) and their ``distances`` are those that the
    training draws from.
    """
    pointers = ramp(primary, 3, ("clamp",) * 3)
    if start == "distance":
        pointers[..., 0] = np.clip(grid_distance(primary) / band, -1, 1) / 2 + 0.5
        entries = ramp(cascaded, 1, ("clamp",) * 3)
    else:
        places = ramp(cascaded, 3, ("clamp",) * 3).reshape(-1, 3)
        nearest = cKDTree(samples).query(places, workers=-1)[1]
        entries = np.clip(distances[nearest] / band, -1, 1).reshape(*cascaded, 1) / 2 + 0.5
    # Both are folded: distances are bounded, and bytes hold nothing beyond
    return Indirection(
        DifferentiableArray(primary, 3, pointers, fold=True), DifferentiableArray(cascaded, 1, entries, fold=True)
    )


def slope_of(net: Indirection, lower, upper, band: float) -> float:
    """
    A bound Λ of the field's slope: for each cell of the primary array, how fast its pointers change, times the steepest
    that the cascaded array is anywhere where they may point.
    """
    pointers, values = net.primary[0].numpy().astype(np.float64), net.cascaded.numpy()[..., 0].astype(np.float64)
    size = [(b - a) / (n - 1) for a, b, n in zip(lower, upper, pointers.shape, strict=False)]
    last = np.array(values.shape) - 1
    # The cells that a cell's pointers reach: the first along each axis, and how many follow
    ends = np.stack([np.stack(_ends(pointers[..., c]), axis=-1) * last[c] for c in range(3)], axis=-2)
    reach = np.clip(np.floor(ends).astype(int), 0, last[:, None] - 1)
    first, more = reach[..., 0], reach[..., 1] - reach[..., 0]
    cells = np.stack([edge_steps(values, c) * last[c] for c in range(3)], axis=-1)
    # Where these are many, the steepest slope of all
    local = np.empty_like(first, dtype=np.float64)
    local[...] = cells.max(axis=(0, 1, 2))
    narrow = np.flatnonzero(np.all(more <= NARROW, axis=-1))
    first, more, found = first.reshape(-1, 3)[narrow], more.reshape(-1, 3)[narrow], np.zeros((len(narrow), 3))
    for offset in np.ndindex((NARROW + 1,) * 3):
        some = np.flatnonzero(np.all(more >= offset, axis=1))
        at = first[some] + offset
        found[some] = np.maximum(found[some], cells[tuple(at.T)])
    local.reshape(-1, 3)[narrow] = found
    square = 0.0
    for axis in range(3):
        along = sum(edge_steps(pointers[..., c], axis) / size[axis] * local[..., c] for c in range(3))
        square = square + along**2
    return max(1.0, float(2 * band * np.sqrt(square.max())))


def _ends(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest of the eight corners of every cell."""
    sides = slice(None, -1), slice(1, None)
    corners = [values[sides[a], sides[b], sides[c]] for a in (0, 1) for b in (0, 1) for c in (0, 1)]
    return np.minimum.reduce(corners), np.maximum.reduce(corners)
