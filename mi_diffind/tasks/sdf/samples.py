"""Where a mesh is looked at: on its surface, near it, and anywhere in its box. Everything is drawn from a seed."""

from __future__ import annotations

import numpy as np

from .mesh import Mesh


def surface(mesh: Mesh, count: int, seed) -> tuple[np.ndarray, np.ndarray]:
    """
    ``count`` points, uniform over the area, and the normals of their triangles: ``(count, 3)`` twice, float64. ``seed``
    is a number or a ``numpy.random.Generator``.

    The area is divided into ``count`` equal parts with a point in each, so that small pieces get their share.
    """
    rng = np.random.default_rng(seed)
    total = np.cumsum(mesh.areas)
    places = (np.arange(count) + rng.random(count)) / count * total[-1]
    which = np.minimum(np.searchsorted(total, places, side="right"), len(total) - 1)
    # Folding the unit square over its diagonal keeps a point uniform over the triangle
    u, v = rng.random((2, count, 1))
    u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))
    a, b, c = np.moveaxis(mesh.corners[which], 1, 0)
    return a + u * (b - a) + v * (c - a), mesh.normals[which]


def near(mesh: Mesh, count: int, width: float, seed) -> np.ndarray:
    """``count`` points of the surface, moved by a normal distribution of standard deviation ``width``: (count, 3)."""
    rng = np.random.default_rng(seed)
    points, _ = surface(mesh, count, rng)
    return points + rng.normal(scale=width, size=points.shape)


def far(lower, upper, count: int, seed) -> np.ndarray:
    """``count`` points uniform in the box between two corners, ``(count, 3)``."""
    return np.random.default_rng(seed).uniform(lower, upper, (count, 3))
