"""Accuracy of a distance field against held-out points of the mesh.

All lengths are relative to the mesh's longest side.
"""

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from .distances import Distances, sample_box, sample_near, sample_surface, surface_cells
from .field import DistanceField
from .grids import point_array, point_values
from .mesh import Mesh

#: Distance from the surface within which points count as near.
BAND = 0.01

#: Distance by which the box of uniform points exceeds the mesh's bounding box.
PADDING = 0.05

#: Points at which gradients are evaluated at once.
CHUNK = 2**20

#: Points at which a state is measured during training.
HELD_OUT = 2**16


class HeldOut:
    """Held-out points for a measurement during training: ``count`` near the surface, and ``count`` on it."""

    def __init__(self, distances: Distances, types, width: float, count: int = HELD_OUT):
        mesh = distances.surface
        near = sample_near(mesh, count, width, seed=3).astype(np.float32)
        self.inside = distances.inside(near)
        points, self.normals = sample_surface(mesh, count, seed=4)
        self.near, self.points = (
            types.Array3f(*(device_array(types.Float, column) for column in v.T)) for v in (near, points)
        )

    def measure(self, field) -> dict[str, float]:
        """Return ``agree``, the share of points near the surface whose sign is right, and ``normal_deg``.

        ``normal_deg`` is the mean angle between the gradient and the mesh's normal on the surface, in degrees.
        """
        inside = field.value(self.near).numpy() < 0
        slope = field.gradient(self.points)[1].numpy().T
        length = np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
        cosine = np.clip(np.sum(slope * self.normals, axis=1) / length, -1, 1)
        return {
            "agree": float(np.mean(inside == self.inside)),
            "normal_deg": float(np.degrees(np.arccos(cosine)).mean()),
        }


class SurfaceEvaluation:
    """Held-out points of ``mesh`` and errors of fields at them.

    ``count`` points uniform in its box, padded by 0.05; ``count`` uniform among those within :data:`BAND` of the
    surface; ``count``/4 on the surface, uniform over its area.
    """

    def __init__(self, mesh: Mesh, distances: Distances, count: int = 2**20, seed: int = 1):
        self.mesh, self.distances, self.count = mesh, distances, count
        rng = np.random.default_rng([seed, 7])
        self.uniform = sample_box(mesh.lower - PADDING, mesh.upper + PADDING, count, rng).astype(np.float32)
        signed = distances.signed(self.uniform, BAND)
        self.uniform_inside, self.uniform_near = signed < 0, np.abs(signed) < BAND
        self.near, self.near_distance = self._near(rng)
        self.surface, self.normals = sample_surface(distances.surface, max(1, count // 4), rng)

    def _near(self, rng) -> tuple[np.ndarray, np.ndarray]:
        """Draw uniform points of the band in the cells that reach into it; return them with their signed distances."""
        lower = self.mesh.lower - 2 * BAND
        shape = np.ceil((self.mesh.upper + 2 * BAND - lower) / BAND).astype(int)
        cells = surface_cells(self.distances, lower, BAND, shape, reach=BAND)
        points, distance, have, tried = [], [], 0, 0
        while have < self.count:
            share = have / tried if have else 0.5
            wanted = int(1.05 * (self.count - have) / max(share, 0.1)) + 64
            drawn = lower + BAND * (cells[rng.integers(len(cells), size=wanted)] + rng.random((wanted, 3)))
            drawn = drawn.astype(np.float32)
            d = self.distances.unsigned(drawn)
            points.append(drawn[d < BAND])
            distance.append(d[d < BAND])
            have, tried = have + len(points[-1]), tried + wanted
        self.band_volume = have / tried * len(cells) * BAND**3
        points, distance = np.concatenate(points)[: self.count], np.concatenate(distance)[: self.count]
        sign = np.where(self.distances.inside(points), -1, 1)
        return points, (sign * distance).astype(np.float32)

    def measure(self, field: DistanceField) -> dict[str, float]:
        """Return the errors of a field.

        - ``iou``: intersection over union of the solids. Points of the band count near the surface, uniform ones
          elsewhere, so that thin solids are measured as well as thick ones;
        - ``iou_near``: the same of the parts within the band;
        - ``mae_near``: mean absolute error of the distance there, both truncated to ± the band, which includes
          distances that the field truncates;
        - ``mae_surface``: mean absolute value of the field on the surface;
        - ``normal_deg`` and ``normal_p95_deg``: mean and 95th percentile of the angle between the field's gradient and
          the mesh's normal on the surface, in degrees; ``normal_smooth_deg``: the mean for the smooth normals.
        """
        near = point_values(field, self.near).astype(np.float32)
        surface = point_values(field, self.surface).astype(np.float32)
        analytic = _angles(field, self.surface, self.normals, lambda p: field.gradient(p)[1])
        smooth = _angles(field, self.surface, self.normals, field.normal)
        # Points of the band and others have weights by volume
        box, far = np.prod(self.mesh.upper - self.mesh.lower + 2 * PADDING), ~self.uniform_near
        near_overlap = _overlap(near < 0, self.near_distance < 0)
        far_overlap = _overlap((point_values(field, self.uniform) < 0)[far], self.uniform_inside[far])
        return {
            "iou": _ratio(*(float(box) / self.count * far_overlap + self.band_volume / self.count * near_overlap)),
            "iou_near": _ratio(*near_overlap),
            "mae_near": float(np.mean(np.abs(np.clip(near, -BAND, BAND) - self.near_distance), dtype=np.float64)),
            "mae_surface": float(np.mean(np.abs(surface), dtype=np.float64)),
            "normal_deg": float(analytic.mean(dtype=np.float64)),
            "normal_p95_deg": float(np.quantile(analytic, 0.95)),
            "normal_smooth_deg": float(smooth.mean(dtype=np.float64)),
        }


def lost_pieces(field: DistanceField, distances: Distances) -> int:
    """Return how many pieces of the mesh's surface are missing in the field.

    A piece is missing if the field's surface is further than one of its cells from all of 32 points on it.
    """
    surface, rng = distances.surface, np.random.default_rng(2)
    order = np.argsort(surface.labels, kind="stable")
    first = np.searchsorted(surface.labels[order], np.arange(surface.components + 1))
    span = np.diff(first)[:, None]
    triangles = order[first[:-1, None] + np.minimum(rng.random((len(span), 32)) * span, span - 1).astype(np.int64)]
    weights = rng.dirichlet((1, 1, 1), triangles.shape)
    points = np.einsum("...c,...cx->...x", weights, surface.corners[triangles])
    near = np.abs(point_values(field, points.reshape(-1, 3))) < min(field.spacing, 0.99 * field.band)
    return int(np.sum(~near.reshape(triangles.shape).any(axis=1)))


def _overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return how many points lie in both of two sets, and in at least one."""
    return np.array([np.count_nonzero(a & b), np.count_nonzero(a | b)])


def _ratio(both: float, one: float) -> float:
    return float(both / one) if one else 1.0


def _angles(field: DistanceField, points: np.ndarray, normals: np.ndarray, direction) -> np.ndarray:
    """Return the angles in degrees between ``normals`` and ``direction(points)``; 90 where it has no length."""
    angles = []
    with dr.suspend_grad():
        for i in range(0, len(points), CHUNK):
            g = direction(point_array(field, points[i : i + CHUNK])).numpy().astype(np.float64).T
            length = np.linalg.norm(g, axis=1)
            valid = np.isfinite(length) & (length > 0)
            g = np.where(valid[:, None], g, 0) / np.where(valid, length, 1)[:, None]
            n = normals[i : i + CHUNK]
            angles.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(g, n), axis=1), np.sum(g * n, axis=1))))
            angles[-1][~valid] = 90.0
    return np.concatenate(angles)
