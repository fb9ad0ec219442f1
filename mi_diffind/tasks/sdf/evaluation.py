"""
How good a field is: against held-out points of the mesh itself, made once. All lengths are of the mesh's longest side.
"""

from __future__ import annotations

import functools
import math

import drjit as dr
import numpy as np

from . import samples
from .cells import node_distances, surface_cells
from .decode import OFF_NODE, components, march, surface_of
from .distances import Distances
from .field import DistanceField
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
    nearer than 0.01 to the surface; ``count``/4 on the surface, uniform over its area.
    """

    def __init__(self, mesh: Mesh, distances: Distances, count: int = 2**20, seed: int = 1):
        self.mesh, self.distances, self.count = mesh, distances, count
        rng = np.random.default_rng([seed, 7])
        self.seed = seed
        self.uniform = samples.far(mesh.lower - PADDING, mesh.upper + PADDING, count, rng).astype(np.float32)
        self.uniform_inside = distances.inside(self.uniform)
        self.near, self.near_distance = self._near(rng)
        self.surface, self.normals = samples.surface(distances.surface, max(1, count // 4), rng)

    def _near(self, rng) -> tuple[np.ndarray, np.ndarray]:
        """Uniform points of the band, and their signed distances: from the cells that reach into it."""
        lower = self.mesh.lower - 2 * BAND
        shape = np.ceil((self.mesh.upper + 2 * BAND - lower) / BAND).astype(int)
        cells = surface_cells(self.distances, lower, BAND, shape, reach=BAND)
        points, distance, have, tried = [], [], 0, 0
        while have < self.count:
            share = have / tried if have else 0.5
            wanted = int(1.05 * (self.count - have) / max(share, 0.1)) + 64
            found = lower + BAND * (cells[rng.integers(len(cells), size=wanted)] + rng.random((wanted, 3)))
            found = found.astype(np.float32)
            d = self.distances.unsigned(found)
            points.append(found[d < BAND])
            distance.append(d[d < BAND])
            have, tried = have + len(points[-1]), tried + wanted
        self.band_volume = have / tried * len(cells) * BAND**3
        self.uniform_near = self._in_band(self.uniform, lower, shape, cells)
        points, distance = np.concatenate(points)[: self.count], np.concatenate(distance)[: self.count]
        sign = np.where(self.distances.inside(points), -1, 1)
        return points, (sign * distance).astype(np.float32)

    def _in_band(self, points: np.ndarray, lower, shape, cells) -> np.ndarray:
        """Which points lie in the band: those in none of its cells need not be asked for."""
        named = np.zeros(shape, dtype=bool)
        named[tuple(cells.T)] = True
        cell = np.floor((points - lower) / BAND).astype(int)
        found = np.all((cell >= 0) & (cell < shape), axis=1)
        found[found] = named[tuple(cell[found].T)]
        found[found] = self.distances.unsigned(points[found]) < BAND
        return found

    def measure(self, field: DistanceField) -> dict[str, float]:
        """
        ``iou``: intersection over union of the solids, near the surface from the points of the band, elsewhere from the
        uniform ones, so that thin solids are measured as well as thick ones; ``iou_near``: of their parts within 0.01
        of the surface; ``mae_near``: mean absolute error of the distance there, both truncated to ± 0.01, which counts
        what a field does not tell so far away; ``mae_surface``: mean absolute value of the field on the surface;
        ``normal_deg`` and ``normal_p95_deg``: mean and 95th percentile of the angle between the field's gradient and
        the mesh's normal on the surface, in degrees; ``normal_smooth_deg``: the mean for the field's smooth normals.
        """
        near = _values(field, self.near)
        surface = _values(field, self.surface)
        analytic = _angles(field, self.surface, self.normals, lambda p: field.gradient(p)[1])
        smooth = _angles(field, self.surface, self.normals, field.normal)
        return {
            "iou": self._iou(_values(field, self.uniform) < 0, near < 0),
            "iou_near": _ratio(*_overlap(near < 0, self.near_distance < 0)),
            "mae_near": float(np.mean(np.abs(np.clip(near, -BAND, BAND) - self.near_distance), dtype=np.float64)),
            "mae_surface": float(np.mean(np.abs(surface), dtype=np.float64)),
            "normal_deg": float(analytic.mean(dtype=np.float64)),
            "normal_p95_deg": float(np.quantile(analytic, 0.95)),
            "normal_smooth_deg": float(smooth.mean(dtype=np.float64)),
        }

    def _iou(self, uniform: np.ndarray, near: np.ndarray) -> float:
        """Of what the field says is inside, of uniform points and of those of the band."""
        side = self.mesh.upper - self.mesh.lower + 2 * PADDING
        far = ~self.uniform_near
        total = float(np.prod(side)) / self.count * _overlap(uniform[far], self.uniform_inside[far])
        return _ratio(*(total + self.band_volume / self.count * _overlap(near, self.near_distance < 0)))

    def chamfer(self, decoded, count: int = 2**18) -> dict[str, float]:
        """
        Of a decoded ``trimesh.Trimesh`` (units and place of the file): ``chamfer``, the mean distance from points
        uniform on one surface to the other one, averaged over both directions, infinite if one is empty; and
        ``components``, the pieces of the decoded surface, with ``components_mesh``, those of the mesh's solid.

        Decode on a grid finer than the field's own cells, lest the grid's error be measured.
        """
        pieces = {"components": len(components(decoded)), "components_mesh": self.components}
        if not len(decoded.faces):
            return {"chamfer": math.inf, **pieces}
        vertices = (np.asarray(decoded.vertices) - np.array(self.mesh.centre)) / self.mesh.scale
        found = Mesh(vertices, np.asarray(decoded.faces), True, path="the decoded mesh")
        rng = np.random.default_rng([self.seed, 8])
        ours, _ = samples.surface(found, count, rng)
        theirs, _ = samples.surface(self.distances.surface, count, rng)
        there = self.distances.unsigned(ours).mean()
        with Distances(found) as distances:
            back = distances.to_triangles(theirs).mean()
        return {"chamfer": float(there + back) / 2, **pieces}

    @functools.cached_property
    def components(self) -> int:
        """
        Pieces of the surface of the mesh's solid: of the mesh itself, or if its pieces overlap or it is open, of the
        exact distance's surface on a grid of 256 cells.
        """
        solid = self.distances.surface
        return solid.components if solid is self.mesh else len(components(self.truth(256)))

    def truth(self, resolution: int):
        """The solid's surface by marching cubes of exact distances, in units and place of the file."""
        spacing = 1 / resolution
        lower = self.mesh.lower - 1.5 * spacing
        cells = np.ceil((self.mesh.upper - lower) / spacing + 1.5).astype(int)
        values = node_distances(self.distances, lower, spacing, cells + 1, 2 * spacing)
        vertices, faces = march(lambda a, b: values[a : b + 1], cells, OFF_NODE * spacing)
        return surface_of(self.mesh.to_file_frame(lower + spacing * vertices), faces)


def lost_pieces(field: DistanceField, distances: Distances, count: int = 32, seed: int = 2) -> int:
    """
    How many pieces of the mesh's surface the field does not know of: at none of ``count`` places on it is the field's
    surface nearer than one of its cells.
    """
    surface = distances.surface
    labels = surface.labels
    rng = np.random.default_rng(seed)
    order = np.argsort(labels, kind="stable")
    first = np.searchsorted(labels[order], np.arange(surface.components + 1))
    span = np.diff(first)[:, None]
    which = order[first[:-1, None] + np.minimum(rng.random((len(span), count)) * span, span - 1).astype(np.int64)]
    weights = rng.dirichlet((1, 1, 1), which.shape)
    points = np.einsum("...c,...cx->...x", weights, surface.corners[which])
    near = np.abs(_values(field, points.reshape(-1, 3))) < min(field.spacing, 0.99 * field.band)
    return int(np.sum(~near.reshape(which.shape).any(axis=1)))


def _overlap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """How many points lie in both and in one of two sets."""
    return np.array([np.count_nonzero(a & b), np.count_nonzero(a | b)])


def _ratio(both: float, one: float) -> float:
    return float(both / one) if one else 1.0


def _points(field: DistanceField, points: np.ndarray):
    points = np.ascontiguousarray(points.T, dtype=np.float32)
    return field.types.Array3f(points)


def _values(field: DistanceField, points: np.ndarray) -> np.ndarray:
    """The field's values at points ``(N, 3)``: ``(N,)`` float32."""
    parts = [points[i : i + CHUNK] for i in range(0, len(points), CHUNK)]
    with dr.suspend_grad():
        return np.concatenate([field.value(_points(field, part)).numpy() for part in parts])


def _angles(field: DistanceField, points: np.ndarray, normals: np.ndarray, direction) -> np.ndarray:
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
