"""Meshes made in code, some of them broken on purpose, and distances to them found without libigl."""

import numpy as np
import trimesh


def box(size=(1, 1, 1), centre=(0, 0, 0)):
    """Vertices and faces of a box."""
    cube = trimesh.creation.box(size)
    return np.array(cube.vertices) + centre, np.array(cube.faces)


def sphere(rings=16, radius=1.0, centre=(0, 0, 0)):
    """Vertices and faces of a sphere of ``rings`` × 2·``rings`` cells; all vertices lie on it."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    outline = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    outline[[0, -1], 0] = 0
    ball = trimesh.creation.revolve(outline, sections=2 * rings)
    return np.array(ball.vertices) + centre, np.array(ball.faces)


def together(*meshes):
    """Join several meshes."""
    return trimesh.util.append_faces(*zip(*meshes, strict=True))


def turned(mesh):
    """Turn a mesh inside out."""
    return mesh[0], mesh[1][:, ::-1]


def without(mesh, dropped):
    """A mesh without the faces that have these numbers, or for which this mask says so."""
    return mesh[0], np.delete(mesh[1], dropped, axis=0)


def write(path, mesh):
    """Write a mesh in the format of the file's extension."""
    trimesh.Trimesh(*mesh, process=False).export(path)
    return path


def box_distance(points, size, centre=(0, 0, 0)):
    """The exact signed distance to a box."""
    q = np.abs(points - np.array(centre)) - np.array(size) / 2
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def brute_distance(points, corners):
    """|d| of points (N, 3) to triangles (F, 3, 3), one after the other."""
    places = (trimesh.triangles.closest_point(np.broadcast_to(t, (len(points), 3, 3)), points) for t in corners)
    return np.min([np.linalg.norm(points - place, axis=1) for place in places], axis=0)


def brute_winding(points, corners):
    """Winding numbers by the solid angles of triangles."""
    total = np.zeros(len(points))
    for triangle in corners:
        a, b, c = triangle[:, None] - points
        x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
        above = np.einsum("ij,ij->i", a, np.cross(b, c))
        below = x * y * z + (a * b).sum(1) * z + (b * c).sum(1) * x + (c * a).sum(1) * y
        total += np.arctan2(above, below) / (2 * np.pi)
    return total
