"""
Fields back to what other programs read: triangles by marching cubes, and grids of distances.

Grids are laid out on cubic cells, ``resolution`` of them along the longest side of the field's box.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from ...errors import UsageError
from .field import Field
from .structure import BLOCK as NODES

#: Cells along each side of the blocks that marching cubes is run on, if the surface passes through them.
BLOCK = 32

#: Points that a field is asked at once.
CHUNK = 2**22

#: The finest grid that is decoded.
MAX_RESOLUTION = 1024

#: Of a cell: values nearer to zero are moved so far away from it, so that no vertex falls on a node.
OFF_NODE = 1e-3


def extract(field: Field, resolution: int, scale: float = 1.0, centre=(0.0, 0.0, 0.0)):
    """
    The surface as a ``trimesh.Trimesh``, closed, in units and place of the file: ``vertices · scale + centre``. Without
    vertices if there is nothing inside.

    Values are only kept of 32 layers of cells at a time, and of a sparse field only found near its nodes. Decode finer
    than the field's own cells where the result is to be measured. Raises :class:`~mi_diffind.errors.UsageError` for a
    resolution out of 4 … 1024.
    """
    spacing = _spacing(field, resolution)
    # One more cell on either side, where all is outside, so that what the box cuts is closed
    lower = np.array(field.lower) - spacing
    cells = np.ceil((np.array(field.upper) - np.array(field.lower)) / spacing - 1e-6).astype(int) + 2

    crossed = crossed_blocks(field, lower, spacing, cells)

    def layers(first: int, last: int) -> np.ndarray:
        needed = np.zeros((last - first + 1, *(cells[1:] + 1)), dtype=bool)
        for y, z in np.argwhere(crossed[first // BLOCK]) * BLOCK:
            needed[:, y : y + BLOCK + 1, z : z + BLOCK + 1] = True
        outside = np.full(needed.shape, field.band, np.float32)
        # What lies beyond the box, on all sides, stays outside
        needed[:, [0, -1]] = needed[:, :, [0, -1]] = False
        needed[0] &= first > 0
        needed[-1] &= last < cells[0]
        where = np.flatnonzero(needed)
        start = lower + spacing * np.array([first, 0, 0])
        found = node_values(field, start, spacing, needed.shape, where)
        outside.reshape(-1)[where] = np.nan_to_num(found, nan=field.band, posinf=field.band, neginf=-field.band)
        return outside

    vertices, faces = march(layers, cells, OFF_NODE * spacing, crossed)
    return surface_of((lower + spacing * vertices) * scale + np.array(centre), faces)


def grid(field: Field, resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    The field at the nodes of a grid, float32 ``(Z, Y, X)``, and the corners of the box that its outermost nodes lie on:
    the field's lower one, and an upper one that no cell is cut by. What lies there is outside.
    """
    spacing = _spacing(field, resolution)
    lower = np.array(field.lower)
    cells = np.ceil((np.array(field.upper) - lower) / spacing - 1e-6).astype(int)
    values = np.empty(tuple(cells[::-1] + 1), np.float32)
    step = max(1, CHUNK // int(np.prod(cells[1:] + 1)))
    for first in range(0, cells[0] + 1, step):
        last = min(first + step, cells[0] + 1)
        start = lower + spacing * np.array([first, 0, 0])
        found = node_values(field, start, spacing, (last - first, *(cells[1:] + 1)))
        values[:, :, first:last] = found.transpose(2, 1, 0)
    return values, lower, lower + spacing * cells


def crossed_blocks(field: Field, lower, spacing: float, cells) -> np.ndarray:
    """
    Which blocks of :data:`BLOCK` cells along each side the surface may pass through, bool (X, Y, Z): of a sparse field,
    those with stored nodes around; of any other, all.
    """
    count = -(-np.asarray(cells) // BLOCK)
    structure = getattr(field, "structure", None)
    if structure is None:
        return np.ones(count, dtype=bool)
    # How many blocks of nodes there are below each place, so that those in a box are counted by differences
    places = structure.block_positions() // NODES
    shape = np.array(structure.shape) // NODES
    total = np.zeros(shape + 1, dtype=np.int32)
    total[tuple(places.T + 1)] = 1
    for axis in range(3):
        total = np.cumsum(total, axis=axis, dtype=np.int32)
    ranges = []
    for axis, n in enumerate(count):
        first = lower[axis] + spacing * BLOCK * np.arange(n) - structure.lower[axis]
        side = NODES * structure.spacing
        low = np.floor((first - structure.spacing) / side).astype(int)
        high = np.floor((first + BLOCK * spacing + structure.spacing) / side).astype(int) + 1
        ranges.append((low.clip(0, shape[axis]), high.clip(0, shape[axis])))
    (a, b), (c, d), (e, f) = ranges
    inside = 0
    for x, i in ((b, 1), (a, -1)):
        for y, j in ((d, 1), (c, -1)):
            for z, k in ((f, 1), (e, -1)):
                inside = inside + i * j * k * total[np.ix_(x, y, z)]
    return inside > 0


def node_values(field: Field, lower, spacing: float, shape, where=None) -> np.ndarray:
    """
    Values at the nodes ``lower + spacing · (i, j, k)`` of a grid of the ``shape`` (X, Y, Z): float32 of that shape, or
    at the nodes with the numbers ``where``, (N,).
    """
    t = field.types
    count, found = math.prod(shape) if where is None else len(where), [np.zeros(0, np.float32)]
    with dr.suspend_grad():
        for start in range(0, count, CHUNK):
            last = min(start + CHUNK, count)
            n = dr.arange(t.UInt32, start, last) if where is None else t.UInt32(where[start:last].astype(np.uint32))
            k, n = n % shape[2], n // shape[2]
            index = (n // shape[1], n % shape[1], k)
            p = [dr.fma(t.Float(i), spacing, float(a)) for i, a in zip(index, lower, strict=True)]
            found.append(field.value(t.Array3f(*p)).numpy())
    return np.concatenate(found).reshape(shape if where is None else count)


def march(layers, cells, smallest: float, crossed=None) -> tuple[np.ndarray, np.ndarray]:
    """
    Marching cubes over ``cells`` (along x, y and z): vertices ``(V, 3)`` float64 in units of cells, faces ``(F, 3)``,
    counter-clockwise from outside. ``layers(first, last)`` gives the values at the nodes of x from ``first`` to
    ``last``, ``(last − first + 1, Y, Z)``; they are kept ``smallest`` away from zero. Only the ``crossed``
    blocks (X, Y, Z) are looked at, by default all.
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
    """
    Blocks as one: a vertex on a grid's edge is the same wherever it comes from. No vertex lies on a node, so the edge
    is known by the middle of the two nodes; vertices in the middle of a cell belong to one block only.
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


def _spacing(field: Field, resolution: int) -> float:
    if isinstance(resolution, bool) or not isinstance(resolution, (int, np.integer)) or not (
        4 <= resolution <= MAX_RESOLUTION
    ):  # fmt: skip
        raise UsageError(f"resolution: found {resolution!r}, allowed are whole numbers from 4 to {MAX_RESOLUTION}")
    return float(np.max(np.array(field.upper) - np.array(field.lower))) / int(resolution)


def surface_of(vertices: np.ndarray, faces: np.ndarray):
    """Triangles as a ``trimesh.Trimesh``, as they are."""
    import trimesh

    return trimesh.Trimesh(vertices, faces, process=False, validate=False)


# -- components -------------------------------------------------------------------------------------------------------


def components(mesh) -> np.ndarray:
    """
    The volumes of the pieces of a closed ``trimesh.Trimesh``, signed, the largest magnitude first; negative for
    cavities.
    """
    from .mesh import _labels, _volumes

    if not len(mesh.faces):
        return np.zeros(0)
    faces = np.asarray(mesh.faces)
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    labels = _labels(faces, len(vertices))
    volumes = np.bincount(labels, _volumes(vertices - vertices.mean(axis=0), faces))
    return volumes[np.argsort(-np.abs(volumes))]


# -- how fine ---------------------------------------------------------------------------------------------------------


def resolution_for(field: Field, error: float, seed: int = 0, finest: int = 512, count: int = 2**15) -> int:
    """
    The coarsest grid (cells along the longest side, at most ``finest``) whose trilinear interpolation differs from the
    field by less than ``error`` on average near the surface; ``error`` is meant to be the field's own (``mae_near``).
    """
    points = _near_surface(field, count, seed)
    n = 32
    while n < finest:
        if trilinear_error(field, points, n) < error:
            return n
        n = min(finest, 8 * round(n * 1.2 / 8 + 0.5))
    return finest


def trilinear_error(field: Field, points: np.ndarray, resolution: int) -> float:
    """The mean difference between the field and its trilinear interpolation on a grid, at points ``(N, 3)``."""
    spacing = _spacing(field, resolution)
    lower = np.array(field.lower)
    with dr.suspend_grad():
        t = field.types
        p = t.Array3f(np.ascontiguousarray(points.T, dtype=np.float32))
        q = [(x - float(a)) / spacing for x, a in zip(p, lower, strict=True)]
        i = [dr.floor(x) for x in q]
        w = [x - j for x, j in zip(q, i, strict=True)]
        total = t.Float(0)
        for corner in range(8):
            bits = [corner >> axis & 1 for axis in range(3)]
            at = t.Array3f(*[(j + b) * spacing + float(a) for j, b, a in zip(i, bits, lower, strict=True)])
            weight = math.prod((x if b else 1 - x for x, b in zip(w, bits, strict=True)), start=t.Float(1))
            total += weight * field.value(at)
        return float(np.mean(np.abs((total - field.value(p)).numpy()), dtype=np.float64))


def _near_surface(field: Field, count: int, seed: int) -> np.ndarray:
    """Points near the field's surface, within a cell of it."""
    rng = np.random.default_rng(seed)
    surface = np.asarray(extract(field, 128).vertices)
    if not len(surface):
        return rng.uniform(field.lower, field.upper, (count, 3))
    points = surface[rng.integers(len(surface), size=count)]
    points = points + rng.uniform(-field.spacing, field.spacing, points.shape)
    return np.clip(points, field.lower, field.upper)
