"""Queries to libigl, carried out in a process of their own, since some meshes make libigl abort its process.

Importing this imports neither Dr.Jit nor Mitsuba.
"""

from __future__ import annotations

import numpy as np

#: Accuracies of the fast winding number, and the distance from 1/2 below which values are computed once more with the
#: next accuracy, in the end exactly, which takes ten times as long. The largest errors observed are 0.23 and 0.013.
ACCURACIES = ((1.0, 0.3), (2.0, 0.05))

#: The same for a watertight mesh, whose winding numbers are whole, so that fewer are in doubt.
WATERTIGHT_ACCURACIES = ((1.0, 0.15), (2.0, 0.05))

#: Meshes of this process by name.
_meshes: dict[str, MeshQueries] = {}


def answer(request: tuple) -> tuple[np.ndarray, ...]:
    """Answer ``(question, name, argument)``.

    The question ``"mesh"`` registers vertices, faces and whether they are watertight under a name; any other one is a
    method of :class:`MeshQueries`, and the argument is points.
    """
    question, name, argument = request
    if question == "mesh":
        _meshes[name] = MeshQueries(*argument)
        return ()
    return getattr(_meshes[name], question)(argument)


class MeshQueries:
    """Queries about one mesh; its search trees are built on first use."""

    def __init__(self, vertices, faces, watertight: bool):
        import igl

        self.igl, self.vertices, self.faces = igl, vertices, faces
        self.accuracies = WATERTIGHT_ACCURACIES if watertight else ACCURACIES
        self.tree = self.hierarchy = None

    def nearest(self, points):
        if self.tree is None:
            self.tree = self.igl.AABB()
            self.tree.init(self.vertices, self.faces)
        order = spatial_order(points)
        squared, faces, places = self.tree.squared_distance(
            self.vertices, self.faces, np.ascontiguousarray(points[order])
        )[:3]
        distance, face, closest = np.empty(len(points)), np.empty(len(points), np.int32), np.empty_like(points)
        distance[order], face[order], closest[order] = np.sqrt(np.maximum(squared, 0)), faces, places
        return distance, face, closest

    def distance(self, points):
        return self.nearest(points)[:1]

    def winding(self, points):
        return (self._windings(points, ACCURACIES[-1:]),)

    def inside(self, points):
        return (self._windings(points, self.accuracies) >= 0.5,)

    def _windings(self, points, accuracies):
        if self.hierarchy is None:
            self.hierarchy = self.igl.FastWindingNumberBVH()
            self.hierarchy.init(self.vertices, self.faces)
        order = spatial_order(points)
        winding = np.empty(len(points))
        for accuracy, doubt in accuracies:
            winding[order] = self.hierarchy.winding_number(np.ascontiguousarray(points[order]), accuracy)
            order = order[np.abs(winding[order] - 0.5) < doubt]
        if len(order):
            exact = self.igl.winding_number(self.vertices, self.faces, np.ascontiguousarray(points[order]))
            winding[order] = np.reshape(exact, -1)
        return winding


def spatial_order(points):
    """Return Morton's order of points: neighbours follow each other, and trees are searched twice as fast."""
    lower, upper = points.min(axis=0), points.max(axis=0)
    cells = ((points - lower) / max(float((upper - lower).max()), 1e-30) * 1023).astype(np.uint64)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cells = (cells | (cells << np.uint64(shift))) & np.uint64(mask)
    return np.argsort(cells[:, 0] | (cells[:, 1] << np.uint64(1)) | (cells[:, 2] << np.uint64(2)), kind="stable")
