"""Meshes made in code, some of them broken on purpose, and distances to them found without libigl."""

import numpy as np
import trimesh

CUBE = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
CUBE_FACES = np.array([
    [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
    [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
])  # fmt: skip


def box(size=(1, 1, 1), centre=(0, 0, 0)):
    """Vertices and faces of a box."""
    return (CUBE - 0.5) * np.array(size) + np.array(centre), CUBE_FACES.copy()


def sphere(rings=16, radius=1.0, centre=(0, 0, 0)):
    """Vertices and faces of a sphere of ``rings`` × 2·``rings`` cells; all vertices lie on it."""
    columns = 2 * rings
    theta = np.pi * np.arange(1, rings) / rings
    phi = 2 * np.pi * np.arange(columns) / columns
    t, f = np.meshgrid(theta, phi, indexing="ij")
    ring = np.stack([np.sin(t) * np.cos(f), np.sin(t) * np.sin(f), np.cos(t)], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([[[0, 0, 1]], ring, [[0, 0, -1]]])
    last, faces = len(vertices) - 1, []
    for j in range(columns):
        k = (j + 1) % columns
        faces.append([0, 1 + j, 1 + k])
        faces.append([last, last - columns + k, last - columns + j])
        for i in range(rings - 2):
            a, b = 1 + i * columns, 1 + (i + 1) * columns
            faces += [[a + j, b + j, b + k], [a + j, b + k, a + k]]
    return vertices * radius + np.array(centre), np.array(faces)


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
