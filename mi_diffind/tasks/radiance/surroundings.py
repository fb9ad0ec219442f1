"""Surroundings of captured objects: all space in a grid of finite size, coarser with the distance.

The contraction of mip-NeRF 360 (Barron et al. 2022) in the maximum norm, with a cube of half side R around the objects:
points of the cube stay, and a point p at r = ‖p‖ / R > 1 from the cube's centre moves to (2 − 1/r) p / r, into a cube
of twice the side. Nodes are equidistant there. Steps of rays grow as √(1 + (r / ρ)²) with the Euclidean distance r, on
both sides of the point next to the centre, and so do voxels: the density of a node is that of a step.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from .nodes import Nodes
from .views import CapturedViews, focus, pixel_width
from .volume_field import EqualSteps

#: Half side of the inner cube as a share of the distance from the point that the cameras look at to the nearest one.
INNER = 0.5

#: Initial raw density, and weight of the total variation of raw densities. A denser begin and more variation keep haze
#: away, by which a grid shows each camera a picture of its own: 5 dB in a trial at 64³.
BEGIN_DENSITY, SMOOTH = -3.0, 4e-3

#: Largest weight in a ray below which a cell is removed. Far things are seen through many faint cells: 0.02 lost 4 dB.
VISIBLE = 2e-3

#: Distance in half sides at which steps begin to grow (ρ), and that at which rays end.
GROWTH, HORIZON = 2.0, 32.0


class Contraction:
    """Contraction around a cube with the centre ``inner[:3]`` and the half side ``inner[3]``."""

    horizon = HORIZON

    def __init__(self, types, inner):
        self.types, self.inner = types, tuple(map(float, inner))
        # Opaque: other cubes use the same kernels
        self.centre = dr.opaque(types.Array3f, list(self.inner[:3]))
        self.half = dr.opaque(types.Float, self.inner[3])
        self._inverse = dr.opaque(types.Float, 1 / self.inner[3])

    def box(self, size: float) -> tuple[tuple, tuple]:
        """Return the lower and the upper corner of a cube of ``size`` half sides."""
        centre, half = self.inner[:3], size * self.inner[3]
        return tuple(c - half for c in centre), tuple(c + half for c in centre)

    def places(self, p) -> tuple:
        """Return points in contracted space, and their distances r in the maximum norm, at least 1."""
        v = p - self.centre
        r = dr.maximum(dr.max(dr.abs(v)) * self._inverse, 1)
        return dr.fma(v, (2 - 1 / r) / r, self.centre), r

    def growth(self, p):
        """Return the ratio of steps at points to those at the centre."""
        return dr.sqrt(dr.fma(dr.squared_norm(p - self.centre), dr.square(self._inverse) / GROWTH**2, 1))

    def along(self, o, d) -> GrowingSteps:
        """Return the distances of steps on rays from ``o``."""
        return GrowingSteps(self.half, (o - self.centre) * self._inverse, d)


class GrowingSteps(EqualSteps):
    """Steps that grow with the distance, u = w sinh(s / ρ) from the point of the ray that is next to the centre.

    ``half`` is the half side of the inner cube, ``o`` the origin of a ray in units of it, from its centre.
    """

    def __init__(self, half, o, d):
        self.scale, self.half = GROWTH * half, half
        self.begin = dr.dot(o, d)
        beside = dr.maximum(dr.squared_norm(o) - dr.square(self.begin), 0)
        self.width = dr.sqrt(beside + GROWTH**2)
        self.before = dr.asinh(self.begin / self.width)

    def of_steps(self, s):
        """Return the distances of a ray at the places ``s`` of its steps."""
        return self.half * dr.fma(self.width, dr.sinh(s / self.scale + self.before), -self.begin)

    def in_steps(self, t):
        """Return the places of distances among the steps, the inverse of :meth:`of_steps`."""
        return self.scale * (dr.asinh((t / self.half + self.begin) / self.width) - self.before)

    def skipped(self, s, t, free):
        """Return the length in steps of ``free`` space behind the distance ``t``, which is at ``s``."""
        # Never less than 0, by rounding: rays go on
        return dr.maximum(self.in_steps(t + free) - s, 0)


class ContractedNodes(Nodes):
    """:class:`.nodes.Nodes` in contracted space; ``inner`` holds the centre and the half side of the inner cube."""

    def __init__(self, types, lower, spacing: float, shape, stored=None, packed: bool = False, *, inner):
        super().__init__(types, lower, spacing, shape, stored, packed)
        self.contraction = Contraction(types, inner)

    def like(self, spacing: float, shape, stored=None, packed: bool = False) -> Nodes:
        return ContractedNodes(
            self.types, self.lower, spacing, shape, stored, packed, inner=self.contraction.inner
        )  # fmt: skip

    def _place(self, p) -> tuple:
        return super()._place(self.contraction.places(p)[0])

    def free_distance(self, p, d, active=True):
        # Contracted points move at most (4r − 3) / r² as far in the maximum norm: below 4/3, and below 4 / r
        contracted = super().free_distance(p, d, active)
        fastest = dr.maximum(dr.maximum(dr.abs(d.x), dr.abs(d.y)), dr.abs(d.z))
        _, r = self.contraction.places(p)
        wide = contracted * fastest / self.contraction.half
        return contracted * dr.maximum(0.75, r / (4 + wide))


def inner_cube(views: CapturedViews) -> tuple[np.ndarray, float]:
    """Return centre and half side of the cube that is not contracted.

    It is the cube around the ``aabb`` of the capture. Without one, it lies around the point that the cameras look at.
    """
    if views.box is not None:
        lower, upper = np.asarray(views.box, np.float64)
        return (lower + upper) / 2, float((upper - lower).max() / 2)
    middle, reach = focus(views)
    return middle, INNER * reach


def whole_space(types, views: CapturedViews, nodes: int) -> ContractedNodes:
    """Return ``nodes``³ nodes for all space, all of them stored."""
    centre, half = inner_cube(views)
    inner = (*centre, half)
    return ContractedNodes(
        types, centre - 2 * half, 4 * half / (nodes - 1), (nodes,) * 3, np.ones((nodes,) * 3, bool), inner=inner
    )


def resolution_of(views: CapturedViews) -> float:
    """Return the nodes along a side at which a voxel of the inner cube is as wide as a pixel is at its middle."""
    centre, half = inner_cube(views)
    return 4 * half / pixel_width(views, centre)
