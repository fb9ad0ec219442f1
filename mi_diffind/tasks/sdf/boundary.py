"""Boundary of the solid that a mesh encloses: holes closed, and triangles inside overlapping pieces left out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from .mesh import Mesh, directed_edges

#: Distance from a triangle at which either side is tested: resolved by float32, and thinner than thin sheets.
STEP = 2e-6

#: Edge length above which a triangle is tested in parts, and the length down to which parts are halved while some of a
#: part bounds the solid and some does not.
COARSE, FINE = 1 / 32, 1 / 256

#: Barycentric coordinates at which a triangle is tested: the middle and near the corners.
PLACES = np.array([[1 / 3, 1 / 3, 1 / 3], [0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9]])


def close_holes(mesh: Mesh) -> Mesh:
    """Return the mesh with each hole closed by a fan of triangles around the middle of its edge.

    The result is watertight for any holes.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    count = len(mesh.vertices)
    keys, signs = directed_edges(mesh.faces, count)
    unique, edge = np.unique(keys, return_inverse=True)
    missing = np.rint(np.bincount(edge, signs, len(unique))).astype(int)
    ends = np.stack([unique // count, unique % count], axis=-1)
    # Each surplus direction of an edge, as often as it is in surplus
    ends[missing < 0] = ends[missing < 0][:, ::-1]
    ends = np.repeat(ends, np.abs(missing), axis=0)
    if not len(ends):
        return mesh
    graph = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(count, count))
    vertex_labels = connected_components(graph, directed=False)[1]
    hole = np.unique(vertex_labels[ends[:, 0]], return_inverse=True)[1]
    a, b = mesh.vertices[ends[:, 0]], mesh.vertices[ends[:, 1]]
    length = np.linalg.norm(b - a, axis=1)
    middles = np.stack([np.bincount(hole, length * x) for x in ((a + b) / 2).T], axis=-1)
    middles /= np.bincount(hole, length)[:, None]
    fans = np.stack([ends[:, 1], ends[:, 0], count + hole], axis=-1)
    vertices = np.concatenate([mesh.vertices, middles])
    a, b, c = np.moveaxis(vertices[fans], 1, 0)
    fans = fans[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-16]
    faces = np.concatenate([mesh.faces, fans]).astype(np.int32)
    return dataclasses.replace(mesh, vertices=vertices, faces=faces, watertight=True)


def outer_surface(mesh: Mesh, inside: Callable[[np.ndarray], np.ndarray]) -> Mesh:
    """Return the triangles of ``mesh``, or parts of them, that have the solid behind them only.

    ``inside`` maps points (N, 3) to bool (N,). The mesh itself is returned if all of its triangles qualify.
    """
    middle = mesh.corners.mean(axis=1)
    before, behind = (inside(middle + side * STEP * mesh.normals) for side in (1, -1))
    # Sheets without a thickness bound nothing, and need no tests in parts
    sheet = ~before & ~behind
    # Where pieces cross there are triangles that bound nothing, or large ones
    crossed = np.zeros(len(mesh.vertices), dtype=bool)
    crossed[mesh.faces[before == behind]] = True
    tested = crossed[mesh.faces].any(axis=1) | (_longest(mesh.corners)[0] > COARSE**2)
    owner = np.flatnonzero(tested & ~sheet)
    corners = mesh.corners[owner]
    parts, dropped = [(corners[:0], owner[:0])], sheet
    while len(owner):
        places = np.einsum("pc,ncx->npx", PLACES, corners).reshape(-1, 3)
        normals = np.repeat(mesh.normals[owner], len(PLACES), axis=0)
        bounding = _bounds(places, normals, inside, mesh.watertight).reshape(-1, len(PLACES))
        squared, edge = _longest(corners)
        mixed = bounding.any(axis=1) & ~bounding.all(axis=1)
        split = (squared > COARSE**2) | (mixed & (squared > FINE**2))
        keep = ~split & bounding[:, 0]
        parts.append((corners[keep], owner[keep]))
        dropped[owner[~split & ~bounding[:, 0]]] = True
        corners, owner = _halves(corners[split], edge[split]), np.repeat(owner[split], 2)
    if not dropped.any():
        return mesh
    corners, owner = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    added = corners[dropped[owner]].reshape(-1, 3)
    faces = np.concatenate([mesh.faces[~dropped], np.arange(len(added)).reshape(-1, 3) + len(mesh.vertices)])
    vertices = np.concatenate([mesh.vertices, added])
    return dataclasses.replace(mesh, vertices=vertices, faces=faces.astype(np.int32), watertight=False)


def _bounds(points: np.ndarray, normals: np.ndarray, inside, watertight: bool) -> np.ndarray:
    """Return whether points on triangles have the solid on exactly one side, behind them.

    The winding number of a watertight mesh is larger by one behind a triangle, so only the front is tested then.
    """
    before = inside(points + STEP * normals)
    return ~before if watertight else inside(points - STEP * normals) & ~before


def _longest(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the square of the longest edge and the number of the corner at which it begins, ``(N,)`` twice."""
    squared = np.sum((np.roll(corners, -1, axis=1) - corners) ** 2, axis=-1)
    return squared.max(axis=1), squared.argmax(axis=1)


def _halves(corners: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Split each triangle in two through its longest edge: ``(2 N, 3, 3)``."""
    n = np.arange(len(corners))
    a, b, c = (corners[n, (edge + i) % 3] for i in range(3))
    m = (a + b) / 2
    return np.stack([np.stack([a, m, c], axis=1), np.stack([m, b, c], axis=1)], axis=1).reshape(-1, 3, 3)
