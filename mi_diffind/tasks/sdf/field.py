"""Interface of signed distance fields: values, gradients, and safe steps for sphere tracing.

Points are in the *unit frame*: the mesh's bounding box is centred at the origin and its longest side is 1. Distances
are negative inside.
"""

from types import ModuleType

import drjit as dr
import numpy as np


class DistanceField:
    """Base class of truncated signed distance fields.

    ``lower`` and ``upper`` are the corners of the field's box; everything beyond it is outside. ``slope`` is a bound
    Λ ≥ |∇f| wherever the field is continuous, ``spacing`` the side of its finest cells, ``band`` the largest distance
    that it returns. ``types`` is the module of Dr.Jit types to compute with. Kernels read these numbers from the opaque
    arrays ``box``, ``cell`` (the spacing), ``cells_per_unit`` and ``largest`` (the band).
    """

    slope: float = 1.0
    #: Whether rays march from cell to cell (:mod:`.marching`); otherwise they are sphere-traced by :meth:`safe_step`.
    marched = False

    def __init__(self, types: ModuleType, lower, upper, spacing: float, band: float):
        self.types = types
        self.lower, self.upper = tuple(map(float, lower)), tuple(map(float, upper))
        self.spacing, self.band = float(spacing), float(band)
        # Opaque: fields of other meshes and sizes use the same kernels
        self.box = tuple(dr.opaque(types.Array3f, corner) for corner in (self.lower, self.upper))
        self.cell, self.cells_per_unit = (
            dr.opaque(types.Float, float(v)) for v in (self.spacing, np.float32(1) / np.float32(spacing))
        )
        self.largest = dr.opaque(types.Float, self.band)

    @property
    def bound(self):
        """The ``slope`` as kernels read it: a number, or an opaque array if it may change."""
        return self.slope

    def update_bound(self):
        """Update the bound of the slope after entries were changed from outside, for example by an optimiser."""

    def inside(self, p):
        """Return whether points lie in the box; false for NaN."""
        x, y, z = p
        (a, b, c), (d, e, f) = self.box
        return (x >= a) & (x <= d) & (y >= b) & (y <= e) & (z >= c) & (z <= f)

    def value(self, p, active=True):
        """Return the signed distance at points ``p`` (``Array3f``, or three ``Float``), truncated to ± ``band``.

        The sign is right everywhere, the magnitude near the surface. Outside of the box the value is ``band``.
        """
        raise NotImplementedError

    def gradient(self, p, active=True):
        """Return the value at ``p`` and its gradient in the cell that is read, ``(Float, Array3f)``."""
        raise NotImplementedError

    def normal(self, p, active=True):
        """Return the smooth normal at ``p``, of any length; by default the gradient."""
        return self.gradient(p, active)[1]

    def normals(self, p, active=True):
        """Return the gradient at ``p`` and the smooth normal, both of any length: ``(Array3f, Array3f)``."""
        return self.gradient(p, active)[1], self.normal(p, active)

    def safe_step(self, p, d, active=True):
        """Return the value at ``p`` and a step along which the sign cannot change: ``(Float, Float)``.

        The direction ``d`` has length 1; the step is finite and ≥ 0. Only the sign of the value counts.
        """
        value = self.value(p, active)
        return value, dr.abs(value) / self.bound
