"""Regular grids of a distance field's values, their surface as triangles, and the coarsest grid that is good enough.

Grids have cubic cells, ``resolution`` of them along the longest side of the field's box.
"""

import math
from bisect import bisect_left
from collections.abc import Callable
from functools import cache

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from ...arrays.sparse_grid import BLOCK as NODES
from ...arrays.sparse_grid import CORNERS
from ...core.errors import UsageError
from .field import DistanceField
from .mesh import component_labels, tetrahedron_volumes

#: Cells along each side of the blocks in which grids are computed if the surface passes through them.
BLOCK = 32

#: Points at which a field is evaluated at once.
CHUNK = 2**22

#: Finest grid that is decoded.
MAX_RESOLUTION = 1024


def spacing_for(field: DistanceField, resolution: int) -> float:
    """Return the side of a grid's cells. Raises :class:`.UsageError` for a bad resolution."""
    if isinstance(resolution, bool) or not isinstance(resolution, (int, np.integer)) or not (
        4 <= resolution <= MAX_RESOLUTION
    ):  # fmt: skip
        raise UsageError(f"resolution: found {resolution!r}, allowed are whole numbers from 4 to {MAX_RESOLUTION}")
    return float(np.max(np.array(field.upper) - np.array(field.lower))) / int(resolution)


def grid(field: DistanceField, resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the field at the nodes of a grid, float32 ``(Z, Y, X)``, and the corners of the grid's box.

    The box begins at the field's lower corner and ends where no cell is cut. Its sides are outside.
    """
    spacing, lower = spacing_for(field, resolution), np.array(field.lower)
    nodes = np.ceil((np.array(field.upper) - lower) / spacing - 1e-6).astype(int) + 1
    values = np.empty(tuple(nodes[::-1]), np.float32)
    _, layers = grid_layers(field, lower, spacing, nodes)
    for x in range(0, nodes[0], BLOCK):
        values[:, :, x : x + BLOCK] = layers(x, min(x + BLOCK, nodes[0])).transpose(2, 1, 0)
    return values, lower, lower + spacing * (nodes - 1)


def grid_layers(field: DistanceField, lower, spacing: float, nodes) -> tuple[np.ndarray, Callable]:
    """Return the :func:`crossed_blocks` of a grid of ``nodes`` (x, y, z), and a function that computes its layers.

    The function takes the first x, a multiple of :data:`BLOCK`, and the end of a range of nodes, and returns their
    values, float32 ``(end − x, Y, Z)``. Where no stored node is near, all nodes of a block have the same value.
    """
    crossed = crossed_blocks(field, lower, spacing, nodes)
    same = node_values(field, lower, BLOCK * spacing, crossed.shape)

    def expand(blocks: np.ndarray, first: int, end: int) -> np.ndarray:
        layers = blocks[np.arange(first, end) // BLOCK].repeat(BLOCK, axis=1).repeat(BLOCK, axis=2)
        return np.ascontiguousarray(layers[:, : nodes[1], : nodes[2]])

    def layers(first: int, end: int) -> np.ndarray:
        values = expand(same, first, end)
        where = np.flatnonzero(expand(crossed, first, end))
        start = lower + spacing * np.array([first, 0, 0])
        values.reshape(-1)[where] = node_values(field, start, spacing, values.shape, where)
        return values

    return crossed, layers


def crossed_blocks(field: DistanceField, lower, spacing: float, nodes) -> np.ndarray:
    """Return which blocks of :data:`BLOCK` nodes along each side the surface may pass through, bool (X, Y, Z).

    For a sparse field these are the blocks with stored nodes around, for any other field all blocks.
    """
    count = -(-np.asarray(nodes) // BLOCK)
    structure = getattr(field, "structure", None)
    if structure is None:
        return np.ones(count, dtype=bool)
    # Range of the blocks of this grid around each block of stored nodes, with a cell as margin
    first = np.array(structure.lower) + structure.spacing * structure.block_positions() - lower
    ends = [first - structure.spacing, first + (NODES + 1) * structure.spacing]
    low, high = (np.floor(end / (BLOCK * spacing)).astype(int) for end in ends)
    crossed = np.zeros(count, dtype=bool)
    for step in np.ndindex(*((high - low).max(axis=0, initial=-1) + 1)):
        at = np.minimum(low + step, high)
        crossed[tuple(at[((at >= 0) & (at < count)).all(axis=1)].T)] = True
    return crossed


def node_values(field: DistanceField, lower, spacing: float, shape, where=None) -> np.ndarray:
    """Return values at the nodes ``lower + spacing · (i, j, k)`` of a grid of the ``shape`` (X, Y, Z), float32.

    With ``where``, numbers of nodes in that shape, the result is ``(N,)``, otherwise it has the shape.
    """
    t = field.types
    # Opaque: all grids of all fields use the same kernel
    first, step = dr.opaque(t.Array3f, list(map(float, lower))), dr.opaque(t.Float, spacing)
    sides = dr.opaque(t.Array3u, [int(n) for n in shape])
    count, values = math.prod(shape) if where is None else len(where), [np.zeros(0, np.float32)]
    with dr.suspend_grad():
        for start in range(0, count, CHUNK):
            last = min(start + CHUNK, count)
            if where is None:
                n = dr.arange(t.UInt32, last - start) + dr.opaque(t.UInt32, start)
            else:
                n = device_array(t.UInt32, where[start:last])
            rows = n // sides.z
            index = rows // sides.y, rows % sides.y, n % sides.z
            p = [dr.fma(t.Float(i), step, a) for i, a in zip(index, first, strict=True)]
            values.append(field.value(t.Array3f(*p)).numpy())
    return np.concatenate(values).reshape(shape if where is None else count)


#: Share of a node's value that remains where the correction would change its sign.
REMAINDER = 0.1


def sharpen(values: np.ndarray, band: float) -> np.ndarray:
    """Return the inner nodes of grids ``(…, Z, Y, X)`` such that trilinear interpolation is nearer to the field.

    The interpolation of a quadratic function exceeds it where it is convex, on average over a cell by a twelfth of the
    second differences along the three axes. Values decrease by as much, unless that changes the sign, or one of the
    seven values is truncated to ± ``band``.
    """
    inner = values[..., 1:-1, 1:-1, 1:-1]
    total, near = -6 * inner, np.abs(inner) < band
    for axis in (-1, -2, -3):
        for end in (slice(2, None), slice(None, -2)):
            beside = values[(..., *(end if axis == i else slice(1, -1) for i in (-3, -2, -1)))]
            total += beside
            near &= np.abs(beside) < band
    moved = inner - total / 12
    moved = np.where((moved < 0) == (inner < 0), moved, REMAINDER * inner)
    return np.where(near, moved, inner)


#: Cells along the longest side of the coarsest grid that is considered.
COARSEST = 8

#: Surface points that are drawn at once.
POINTS_PER_DRAW = 2**15

#: Largest number of draws of surface points.
MOST_DRAWS = 64

#: Newton steps that move a point onto the surface.
NEWTON_STEPS = 6

#: Largest distance of a surface point from the surface, in cells.
ON_SURFACE = 1e-3

#: Parts along the longest side of a box; points are drawn in those that the surface may pass through.
PARTS = 16


def resolution_for(field: DistanceField, error: float, finest: int = MAX_RESOLUTION) -> tuple[int, float]:
    """Return the coarsest sufficient grid's cells along the longest side, from 8 to ``finest``, and its mean error.

    A grid suffices if its trilinear interpolation differs from the field by at most ``error`` on average on the field's
    surface. If ``finest`` does not suffice, it is returned with its larger error. ``error`` is meant to be the field's
    own (``mae_surface``). Grids are evaluated on the surface only.
    """
    points = surface_points(field, 2**12)
    grid_error = cache(lambda resolution: trilinear_error(field, points, resolution))
    resolutions = range(min(COARSEST, finest), finest)
    index = bisect_left(resolutions, True, key=lambda resolution: grid_error(resolution) <= error)
    resolution = resolutions[index] if index < len(resolutions) else finest
    return resolution, grid_error(resolution)


def trilinear_error(field: DistanceField, points: np.ndarray, resolution: int) -> float:
    """Return the mean difference between the field and the interpolation of a :func:`sharpen`-ed grid at ``points``.

    ``points`` are ``(N, 3)``; the error of none is 0.
    """
    if not len(points):
        return 0.0
    spacing, lower = spacing_for(field, resolution), np.array(field.lower)
    place = (points - lower) / spacing
    cell = np.floor(place).astype(np.int64)
    weights = place - cell
    # The nodes of a cell and their neighbours: 4 × 4 × 4
    around = cell[:, None] + np.argwhere(np.ones((4, 4, 4))) - 1
    values = point_values(field, lower + spacing * around.reshape(-1, 3)).reshape(-1, 4, 4, 4)
    values = sharpen(values, field.band).reshape(-1, 8)
    blend = np.prod(np.where(CORNERS == 1, weights[:, None], 1 - weights[:, None]), axis=2)
    return float(np.mean(np.abs((blend * values).sum(axis=1) - point_values(field, points))))


def surface_points(field: DistanceField, count: int) -> np.ndarray:
    """Return about ``count`` points of the field's surface, ``(N, 3)``, nearly uniform over its area.

    Points near the surface are moved onto it by Newton's method along the gradient. Without a surface, N is 0.
    """
    rng = np.random.default_rng(0)
    side = float(np.max(np.array(field.upper) - np.array(field.lower))) / PARTS
    blocks = np.ceil((np.array(field.upper) - np.array(field.lower)) / side - 1e-6).astype(int)
    parts = np.argwhere(crossed_blocks(field, np.array(field.lower), side / BLOCK, BLOCK * blocks))
    points, have = [np.zeros((0, 3))], 0
    for _ in range(MOST_DRAWS if len(parts) else 0):
        p = parts[rng.integers(len(parts), size=POINTS_PER_DRAW)] + rng.random((POINTS_PER_DRAW, 3))
        p = np.array(field.lower) + side * p
        p = p[np.abs(point_values(field, p)) < 0.9 * field.band][:count]
        for _ in range(NEWTON_STEPS if len(p) else 0):
            with dr.suspend_grad():
                value, slope = (np.asarray(v.numpy(), np.float64) for v in field.gradient(point_array(field, p)))
            p = p - np.where((slope**2).sum(0) > 0.01, value / np.maximum((slope**2).sum(0), 0.01) * slope, 0).T
        points.append(p[np.abs(point_values(field, p)) < ON_SURFACE * field.spacing])
        have += len(points[-1])
        if have >= count:
            break
    return np.concatenate(points)[:count]


def point_values(field: DistanceField, points: np.ndarray) -> np.ndarray:
    """Return the field's values at points ``(N, 3)``: ``(N,)`` float64."""
    parts = [points[i : i + CHUNK] for i in range(0, len(points), CHUNK)]
    with dr.suspend_grad():
        values = [field.value(point_array(field, part)).numpy() for part in parts]
    return np.concatenate([np.zeros(0), *values])


def point_array(field: DistanceField, points: np.ndarray):
    """Return points ``(N, 3)`` as an ``Array3f`` of the field's types."""
    return field.types.Array3f(*(device_array(field.types.Float, column) for column in points.T))


#: Smallest magnitude of a node's value, in cells: no vertex falls on a node.
OFF_NODE = 1e-3


def extract(field: DistanceField, resolution: int, scale: float = 1.0, centre=(0.0, 0.0, 0.0)):
    """Return the closed surface as a ``trimesh.Trimesh``; it has no vertices if nothing is inside.

    Vertices are in units and place of the file: ``vertices · scale + centre``. ``resolution`` is the number of cells
    along the longest side; choose cells finer than the field's where the result is to be measured. Values are kept of
    32 layers of cells at a time, and computed near the nodes of a sparse field only. Raises
    :class:`.UsageError` for a resolution outside of 4 … 1024.
    """
    import trimesh
    from skimage.measure import marching_cubes

    spacing = spacing_for(field, resolution)
    # One more cell on either side, all outside, closes what the box cuts
    lower = np.array(field.lower) - spacing
    cells = np.ceil((np.array(field.upper) - np.array(field.lower)) / spacing - 1e-6).astype(int) + 2
    crossed, layers = grid_layers(field, lower, spacing, cells + 1)
    vertices, faces, count, least = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], 0, OFF_NODE * spacing
    for x in range(0, cells[0], BLOCK):
        if not crossed[x // BLOCK].any():
            continue
        values = np.nan_to_num(layers(x, min(x + BLOCK, int(cells[0])) + 1), nan=field.band)
        values = np.where(values < 0, np.minimum(values, -least), np.maximum(values, least)).astype(np.float32)
        for y, z in BLOCK * np.argwhere(crossed[x // BLOCK]):
            block = values[:, y : y + BLOCK + 1, z : z + BLOCK + 1]
            if min(block.shape) < 2 or (block.min() < 0) == (block.max() < 0):
                continue
            v, f, _, _ = marching_cubes(block, 0.0, gradient_direction="descent")
            vertices.append(v.astype(np.float64) + np.array((x, y, z)))
            faces.append(f.astype(np.int64) + count)
            count += len(v)
    vertices, faces = _merge_vertices(np.concatenate(vertices), np.concatenate(faces))
    vertices = (lower + spacing * vertices) * scale + np.array(centre)
    return trimesh.Trimesh(vertices, faces, process=False, validate=False)


def _merge_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge the equal vertices of adjacent blocks.

    A vertex on a grid's edge is the same wherever it comes from. No vertex lies on a node, so the edge is identified by
    the middle of its two nodes; a vertex in the middle of a cell belongs to one block only.
    """
    whole = np.rint(vertices)
    on = np.abs(vertices - whole) < 1e-5
    middle = np.where(on, 2 * whole, 2 * np.floor(vertices) + 1).astype(np.int64)
    edge = on.sum(axis=1) == 2
    size = middle.max(axis=0, initial=0) + 1
    keys = (middle[:, 0] * size[1] + middle[:, 1]) * size[2] + middle[:, 2]
    keys[~edge] = -1 - np.arange(np.count_nonzero(~edge))
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return vertices[first], inverse[faces]


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
