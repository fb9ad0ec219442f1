"""
What a mesh encloses: holes of open ones closed, and triangles that bound nothing, since pieces overlap, left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from .mesh import Mesh, _edges

#: How far from a triangle it is looked at what lies on either side: float32 can tell it, and thin sheets are thicker.
STEP = 2e-6

#: Triangles whose longest edge is larger are looked at in parts, and parts are halved down to the second length where
#: some of it bounds the solid and some does not.
COARSE, FINE = 1 / 32, 1 / 256

#: Places at which a triangle is looked at (barycentric): the middle and near the corners.
PLACES = np.array([[1 / 3, 1 / 3, 1 / 3], [0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9]])


def closed(mesh: Mesh) -> Mesh:
    """
    The mesh with each hole closed by a fan of triangles around the middle of its edge. Whatever the holes look like,
    the result is watertight.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(mesh.vertices)
    keys, signs = _edges(mesh.faces, count)
    unique, which = np.unique(keys, return_inverse=True)
    missing = np.rint(np.bincount(which, signs, len(unique))).astype(int)
    ends = np.stack([unique // count, unique % count], axis=-1)
    # The way that is run through too often, as often as it is
    ends[missing < 0] = ends[missing < 0][:, ::-1]
    ends = np.repeat(ends, np.abs(missing), axis=0)
    if not len(ends):
        return mesh
    graph = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(count, count))
    of_vertices = connected_components(graph, directed=False)[1]
    hole = np.unique(of_vertices[ends[:, 0]], return_inverse=True)[1]
    a, b = mesh.vertices[ends[:, 0]], mesh.vertices[ends[:, 1]]
    length = np.linalg.norm(b - a, axis=1)
    middles = np.stack([np.bincount(hole, length * x) for x in ((a + b) / 2).T], axis=-1)
    middles /= np.bincount(hole, length)[:, None]
    fans = np.stack([ends[:, 1], ends[:, 0], count + hole], axis=-1)
    vertices = np.concatenate([mesh.vertices, middles])
    a, b, c = np.moveaxis(vertices[fans], 1, 0)
    fans = fans[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-16]
    faces = np.concatenate([mesh.faces, fans]).astype(np.int32)
    return Mesh(vertices, faces, True, mesh.scale, mesh.centre, mesh.path, mesh.digest, mesh.warnings)


def bounding(mesh: Mesh, inside: Callable[[np.ndarray], np.ndarray]) -> Mesh:
    """
    The triangles of ``mesh``, or parts of them, that have ``inside`` behind them only. The mesh itself if all do.
    """
    middle = mesh.corners.mean(axis=1)
    before, behind = (inside(middle + side * STEP * mesh.normals) for side in (1, -1))
    # Sheets without a thickness bound nothing, and need not be looked at in parts
    sheet = ~before & ~behind
    # Where pieces cross there are triangles that bound nothing, or large ones
    crossed = np.zeros(len(mesh.vertices), dtype=bool)
    crossed[mesh.faces[before == behind]] = True
    looked = crossed[mesh.faces].any(axis=1) | (_longest(mesh.corners)[0] > COARSE**2)
    owner = np.flatnonzero(looked & ~sheet)
    corners = mesh.corners[owner]
    kept, dropped = [(corners[:0], owner[:0])], sheet
    while len(owner):
        places = np.einsum("pc,ncx->npx", PLACES, corners).reshape(-1, 3)
        normals = np.repeat(mesh.normals[owner], len(PLACES), axis=0)
        found = _bounds(places, normals, inside, mesh.watertight).reshape(-1, len(PLACES))
        squared, edge = _longest(corners)
        mixed = found.any(axis=1) & ~found.all(axis=1)
        split = (squared > COARSE**2) | (mixed & (squared > FINE**2))
        done = ~split
        keep = done & found[:, 0]
        kept.append((corners[keep], owner[keep]))
        dropped[owner[done & ~found[:, 0]]] = True
        corners, owner = _halves(corners[split], edge[split]), np.repeat(owner[split], 2)
    if not dropped.any():
        return mesh
    corners, owner = (np.concatenate(parts) for parts in zip(*kept, strict=True))
    parts = corners[dropped[owner]].reshape(-1, 3)
    faces = np.concatenate([mesh.faces[~dropped], np.arange(len(parts)).reshape(-1, 3) + len(mesh.vertices)])
    vertices = np.concatenate([mesh.vertices, parts])
    return dataclasses.replace(mesh, vertices=vertices, faces=faces.astype(np.int32), watertight=False)


def _bounds(points: np.ndarray, normals: np.ndarray, inside, watertight: bool) -> np.ndarray:
    """
    Whether there is inside on one side of a triangle only, at points on it. The winding number of a watertight mesh is
    larger by one behind a triangle, so it suffices to look in front of it.
    """
    before = inside(points + STEP * normals)
    return ~before if watertight else inside(points - STEP * normals) & ~before


def _longest(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The square of the longest edge, and which one it is: from that corner to the next, ``(N,)`` twice."""
    squared = np.sum((np.roll(corners, -1, axis=1) - corners) ** 2, axis=-1)
    return squared.max(axis=1), squared.argmax(axis=1)


def _halves(corners: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Each triangle in two, through its longest edge: ``(2 N, 3, 3)``."""
    n = np.arange(len(corners))
    a, b, c = (corners[n, (edge + i) % 3] for i in range(3))
    m = (a + b) / 2
    return np.stack([np.stack([a, m, c], axis=1), np.stack([m, b, c], axis=1)], axis=1).reshape(-1, 3, 3)
