"""
What a signed distance field offers, whatever it is stored as: values, gradients, and, if it is
sphere-traced, how far a ray may go.

Everything is in the *unit frame*: the bounding box of the mesh is centred at the origin and its longest side is 1.
Distances are negative inside.
"""

from __future__ import annotations

from types import ModuleType

import drjit as dr
import numpy as np

from ...lookup import clamp


class DistanceField:
    """
    A truncated signed distance field: the base class. ``lower`` and ``upper`` are the corners of its box, outside of
    which there is nothing; ``slope`` is a bound Λ ≥ |∇f| wherever the field is continuous, ``spacing`` the side of its
    finest cells, ``band`` the largest distance that it tells.
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    slope: float = 1.0
    spacing: float
    band: float
    #: Whether rays go from cell to cell, by masks (:mod:`.marching`). If not, they are sphere-traced (:meth:`look`).
    marched = False

    def __init__(self, types: ModuleType, lower, upper, spacing: float, band: float):
        self.types = types
        self.lower, self.upper = tuple(map(float, lower)), tuple(map(float, upper))
        self.spacing, self.band = float(spacing), float(band)

    @property
    def bound(self):
        """The ``slope`` as rays take it: a number, or an array of one if it may change."""
        return self.slope

    def changed(self):
        """To be called when entries were changed from outside, by an optimiser say: the bound of the slope follows."""

    def inside(self, p):
        """Whether points lie in the box. False for NaN."""
        x, y, z = p
        (a, b, c), (d, e, f) = self.lower, self.upper
        return (x >= a) & (x <= d) & (y >= b) & (y <= e) & (z >= c) & (z <= f)

    def value(self, p, active=True):
        """
        The signed distance at points ``p`` (``Array3f``, or three ``Float``), truncated to ± ``band``; its sign is
        right everywhere, its magnitude near the surface. ``band`` outside of the box.
        """
        raise NotImplementedError

    def gradient(self, p, active=True):
        """The value at ``p`` and its gradient, that of the cell that is read: ``(Float, Array3f)``."""
        raise NotImplementedError

    def normal(self, p, active=True):
        """The direction of the smooth normal at ``p``, of any length; by default, the gradient."""
        return self.gradient(p, active)[1]

    def normals(self, p, active=True):
        """The gradient at ``p`` and the smooth normal, both of any length: ``(Array3f, Array3f)``."""
        return self.gradient(p, active)[1], self.normal(p, active)

    def look(self, p, d, active=True):
        """
        For sphere tracing: the value at ``p`` and how far a ray from there in the direction ``d`` (of length 1) goes
        without the sign changing, ``(Float, Float)``, the second one finite and ≥ 0. Of the value, the sign counts.
        """
        value = self.value(p, active)
        return value, dr.abs(value) / self.bound


class DenseField(DistanceField):
    """
    Trilinear interpolation of a grid of ``values``, a tensor of shape ``(X, Y, Z)`` whose first and last entries lie on
    the sides of the box.
    """

    def __init__(self, values, lower, upper, band: float):
        from ...compat import module_of

        self.values = values
        self.resolution = tuple(values.shape)
        size = [(b - a) / (n - 1) for a, b, n in zip(lower, upper, self.resolution, strict=True)]
        super().__init__(module_of(values), lower, upper, min(size), band)
        self.size = tuple(map(float, size))
        self.slope = max(1.0, trilinear_slope(values.numpy(), self.size))

    def _cell(self, p):
        """For each axis: the lower entry and the weight of the next one."""
        UInt32, found = self.types.UInt32, []
        for x, a, h, n in zip(p, self.lower, self.size, self.resolution, strict=True):
            t = clamp((x - a) / h, 0.0, n - 1.0)
            i = dr.minimum(UInt32(dr.detach(t)), n - 2)
            found.append((i, t - self.types.Float(i)))
        return found

    def _corners(self, cell, active):
        (i, _), (j, _), (k, _) = cell
        _, ny, nz = self.resolution
        first = (i * ny + j) * nz + k

        def get(n):
            return dr.gather(self.types.Float, self.values.array, first + n, active)

        return [[[get((a * ny + b) * nz + c) for c in (0, 1)] for b in (0, 1)] for a in (0, 1)]

    def value(self, p, active=True):
        active = self.inside(p) & active
        cell = self._cell(p)
        v = self._corners(cell, active)
        u, s, w = (weight for _, weight in cell)
        rows = [dr.lerp(dr.lerp(v[a][0][0], v[a][0][1], w), dr.lerp(v[a][1][0], v[a][1][1], w), s) for a in (0, 1)]
        return dr.select(active, dr.lerp(rows[0], rows[1], u), self.band)

    def gradient(self, p, active=True):
        active = self.inside(p) & active
        cell = self._cell(p)
        v = self._corners(cell, active)
        u, s, w = (weight for _, weight in cell)
        edge = [[dr.lerp(v[a][b][0], v[a][b][1], w) for b in (0, 1)] for a in (0, 1)]
        across = [[v[a][b][1] - v[a][b][0] for b in (0, 1)] for a in (0, 1)]
        lines = [dr.lerp(edge[a][0], edge[a][1], s) for a in (0, 1)]
        dx = lines[1] - lines[0]
        dy = dr.lerp(edge[0][1] - edge[0][0], edge[1][1] - edge[1][0], u)
        dz = dr.lerp(dr.lerp(across[0][0], across[0][1], s), dr.lerp(across[1][0], across[1][1], s), u)
        slope = self.types.Array3f(dx / self.size[0], dy / self.size[1], dz / self.size[2])
        return dr.select(active, dr.lerp(lines[0], lines[1], u), self.band), dr.select(active, slope, 0)


def edge_steps(values: np.ndarray, axis: int) -> np.ndarray:
    """The largest of the four differences along ``axis`` in every cell of a grid of ``values`` (X, Y, Z)."""
    steps = np.abs(np.diff(values, axis=axis))
    for other in {0, 1, 2} - {axis}:
        ahead, behind = [slice(None)] * 3, [slice(None)] * 3
        ahead[other], behind[other] = slice(1, None), slice(None, -1)
        steps = np.maximum(steps[tuple(ahead)], steps[tuple(behind)])
    return steps


def trilinear_slope(values: np.ndarray, size) -> float:
    """
    A bound of the gradient's length of the trilinear interpolation of ``values`` (X, Y, Z) in cells of the sides
    ``size``: in each cell, every component lies between its four differences along the edges.
    """
    steps = [edge_steps(values, axis) / h for axis, h in enumerate(size)]
    return float(np.sqrt(sum(s.astype(np.float64) ** 2 for s in steps).max()))
