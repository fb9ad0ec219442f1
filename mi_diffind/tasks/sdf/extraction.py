"""Extraction of a distance field's surface as triangles, by marching cubes."""

from __future__ import annotations

import numpy as np

from .field import DistanceField
from .grids import BLOCK, crossed_blocks, node_values, spacing_for
from .mesh import component_labels, tetrahedron_volumes

#: Smallest magnitude of a node's value, in cells: no vertex falls on a node.
OFF_NODE = 1e-3


def extract(field: DistanceField, resolution: int, scale: float = 1.0, centre=(0.0, 0.0, 0.0)):
    """Return the closed surface as a ``trimesh.Trimesh``; it has no vertices if nothing is inside.

    Vertices are in units and place of the file: ``vertices · scale + centre``. ``resolution`` is the number of cells
    along the longest side; choose cells finer than the field's where the result is to be measured. Values are kept of
    32 layers of cells at a time, and computed near the nodes of a sparse field only. Raises
    :class:`.UsageError` for a resolution outside of 4 … 1024.
    """
    spacing = spacing_for(field, resolution)
    # One more cell on either side, all outside, closes what the box cuts
    lower = np.array(field.lower) - spacing
    cells = np.ceil((np.array(field.upper) - np.array(field.lower)) / spacing - 1e-6).astype(int) + 2
    crossed = crossed_blocks(field, lower, spacing, cells)

    def layers(first: int, last: int) -> np.ndarray:
        needed = np.zeros((last - first + 1, *(cells[1:] + 1)), dtype=bool)
        for y, z in np.argwhere(crossed[first // BLOCK]) * BLOCK:
            needed[:, y : y + BLOCK + 1, z : z + BLOCK + 1] = True
        values = np.full(needed.shape, field.band, np.float32)
        # Nodes beyond the box, on all sides, stay outside
        needed[:, [0, -1]] = needed[:, :, [0, -1]] = False
        needed[0] &= first > 0
        needed[-1] &= last < cells[0]
        where = np.flatnonzero(needed)
        start = lower + spacing * np.array([first, 0, 0])
        computed = node_values(field, start, spacing, needed.shape, where)
        values.reshape(-1)[where] = np.nan_to_num(computed, nan=field.band, posinf=field.band, neginf=-field.band)
        return values

    vertices, faces = march(layers, cells, OFF_NODE * spacing, crossed)
    return trimesh_of((lower + spacing * vertices) * scale + np.array(centre), faces)


def march(layers, cells, smallest: float, crossed=None) -> tuple[np.ndarray, np.ndarray]:
    """Run marching cubes over ``cells`` (x, y, z): vertices ``(V, 3)`` float64 in units of cells, faces ``(F, 3)``.

    Faces are counter-clockwise from outside. ``layers(first, last)`` returns the values at the nodes of x from
    ``first`` to ``last``, ``(last − first + 1, Y, Z)``, which are kept ``smallest`` away from zero. Only the
    ``crossed`` blocks (X, Y, Z) are processed, by default all.
    """
    from skimage.measure import marching_cubes

    vertices, faces, count = [], [], 0
    for x in range(0, cells[0], BLOCK):
        if crossed is not None and not crossed[x // BLOCK].any():
            continue
        values = layers(x, min(x + BLOCK, int(cells[0])))
        values = np.where(values < 0, np.minimum(values, -smallest), np.maximum(values, smallest)).astype(np.float32)
        for y in range(0, cells[1], BLOCK):
            for z in range(0, cells[2], BLOCK):
                if crossed is not None and not crossed[x // BLOCK, y // BLOCK, z // BLOCK]:
                    continue
                block = values[:, y : y + BLOCK + 1, z : z + BLOCK + 1]
                if min(block.shape) < 2 or (block.min() < 0) == (block.max() < 0):
                    continue
                v, f, _, _ = marching_cubes(block, 0.0, gradient_direction="descent")
                vertices.append(v.astype(np.float64) + np.array((x, y, z)))
                faces.append(f.astype(np.int64) + count)
                count += len(v)
    if not vertices:
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    return _joined(np.concatenate(vertices), np.concatenate(faces))


def _joined(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge the equal vertices of adjacent blocks.

    A vertex on a grid's edge is the same wherever it comes from. No vertex lies on a node, so the edge is identified by
    the middle of its two nodes; a vertex in the middle of a cell belongs to one block only.
    """
    whole = np.rint(vertices)
    on = np.abs(vertices - whole) < 1e-5
    middle = np.where(on, 2 * whole, 2 * np.floor(vertices) + 1).astype(np.int64)
    edge = on.sum(axis=1) == 2
    middle -= middle.min(axis=0)
    size = middle.max(axis=0) + 1
    keys = (middle[:, 0] * size[1] + middle[:, 1]) * size[2] + middle[:, 2]
    keys[~edge] = -1 - np.arange(np.count_nonzero(~edge))
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return vertices[first], inverse[faces]


def trimesh_of(vertices: np.ndarray, faces: np.ndarray):
    """Return unprocessed triangles as a ``trimesh.Trimesh``."""
    import trimesh

    return trimesh.Trimesh(vertices, faces, process=False, validate=False)


def components(mesh) -> np.ndarray:
    """Return the signed volumes of the pieces of a closed ``trimesh.Trimesh``, the largest magnitude first.

    Cavities have negative volumes.
    """
    if not len(mesh.faces):
        return np.zeros(0)
    faces = np.asarray(mesh.faces)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    labels = component_labels(faces, len(vertices))
    volumes = np.bincount(labels, tetrahedron_volumes(vertices - vertices.mean(axis=0), faces))
    return volumes[np.argsort(-np.abs(volumes))]
