"""
How good a field is: against held-out points of the mesh itself, made once. All lengths are of the mesh's longest side.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from . import samples
from .cells import surface_cells
from .distances import Distances
from .field import Field
from .mesh import Mesh

#: Half the width of what counts as near the surface.
BAND = 0.01

#: How far the box in which points are drawn reaches beyond the mesh's own.
PADDING = 0.05

#: Points that a field is asked at once.
CHUNK = 2**20


class Evaluation:
    """
    Held-out points of ``mesh``: ``count`` uniform ones in its box, padded by 0.05; ``count`` uniform ones among those
    nearer than 0.01 to the surface; ``count``/4 on the surface, uniform over its area where it bounds the solid.
    """

    def __init__(self, mesh: Mesh, distances: Distances, count: int = 2**20, seed: int = 1):
        self.mesh, self.distances, self.count = mesh, distances, count
        rng = np.random.default_rng([seed, 7])
        self.seed = seed
        self.uniform = samples.far(mesh.lower - PADDING, mesh.upper + PADDING, count, rng).astype(np.float32)
        self.uniform_inside = distances.inside(self.uniform)
        self.near, self.near_distance = self._near(rng)
        self.surface, self.normals = bounding(distances, *samples.surface(mesh, max(1, count // 4), rng))

    def _near(self, rng) -> tuple[np.ndarray, np.ndarray]:
        """Uniform points of the band, and their signed distances: from the cells that reach into it."""
        lower = self.mesh.lower - 2 * BAND
        shape = np.ceil((self.mesh.upper + 2 * BAND - lower) / BAND).astype(int)
        cells = surface_cells(self.distances, lower, BAND, shape, reach=BAND)
        points, distance, have = [], [], 0
        while have < self.count:
            share = have / sum(map(len, points)) if points else 0.5
            wanted = int(1.05 * (self.count - have) / max(share, 0.1)) + 64
            found = lower + BAND * (cells[rng.integers(len(cells), size=wanted)] + rng.random((wanted, 3)))
            found = found.astype(np.float32)
            d = self.distances.unsigned(found)
            points.append(found[d < BAND])
            distance.append(d[d < BAND])
            have += len(points[-1])
        points, distance = np.concatenate(points)[: self.count], np.concatenate(distance)[: self.count]
        sign = np.where(self.distances.inside(points), -1, 1)
        return points, (sign * distance).astype(np.float32)

    def measure(self, field: Field) -> dict[str, float]:
        """
        ``iou``: intersection over union of the solids; ``iou_near``: of their parts within 0.01 of the surface;
        ``mae_near``: mean absolute error of the distance there, both truncated to ± 0.01; ``normal_deg`` and
        ``normal_p95_deg``: mean and 95th percentile of the angle between the field's gradient and the mesh's normal
        on the surface, in degrees; ``normal_smooth_deg``: the mean for the field's smooth normals.
        """
        inside = _values(field, self.uniform) < 0
        near = _values(field, self.near)
        analytic = _angles(field, self.surface, self.normals, lambda p: field.gradient(p)[1])
        smooth = _angles(field, self.surface, self.normals, field.normal)
        return {
            "iou": _iou(inside, self.uniform_inside),
            "iou_near": _iou(near < 0, self.near_distance < 0),
            "mae_near": float(np.mean(np.abs(np.clip(near, -BAND, BAND) - self.near_distance), dtype=np.float64)),
            "normal_deg": float(analytic.mean(dtype=np.float64)),
            "normal_p95_deg": float(np.quantile(analytic, 0.95)),
            "normal_smooth_deg": float(smooth.mean(dtype=np.float64)),
        }


def bounding(distances: Distances, points: np.ndarray, normals: np.ndarray, step: float = 1e-5):
    """Of points on the surface and their normals, those with the solid on one side only: where pieces overlap, not."""
    outer, inner = distances.inside(points + step * normals), distances.inside(points - step * normals)
    kept = outer != inner
    return points[kept], normals[kept]


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    union = np.count_nonzero(a | b)
    return float(np.count_nonzero(a & b) / union) if union else 1.0


def _points(field: Field, points: np.ndarray):
    points = np.ascontiguousarray(points.T, dtype=np.float32)
    return field.types.Array3f(points)


def _values(field: Field, points: np.ndarray) -> np.ndarray:
    """The field's values at points ``(N, 3)``: ``(N,)`` float32."""
    parts = [points[i : i + CHUNK] for i in range(0, len(points), CHUNK)]
    with dr.suspend_grad():
        return np.concatenate([field.value(_points(field, part)).numpy() for part in parts])


def _angles(field: Field, points: np.ndarray, normals: np.ndarray, direction) -> np.ndarray:
    """Angles to the ``normals``, in degrees, of what ``direction`` says at points. 90 where it says nothing."""
    found = []
    with dr.suspend_grad():
        for i in range(0, len(points), CHUNK):
            g = direction(_points(field, points[i : i + CHUNK])).numpy().astype(np.float64).T
            length = np.linalg.norm(g, axis=1)
            known = np.isfinite(length) & (length > 0)
            g = np.where(known[:, None], g, 0) / np.where(known, length, 1)[:, None]
            n = normals[i : i + CHUNK]
            found.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(g, n), axis=1), np.sum(g * n, axis=1))))
            found[-1][~known] = 90.0
    return np.concatenate(found)
