"""Regular grids of a distance field's values, and the coarsest grid that interpolates the field well enough.

Grids have cubic cells, ``resolution`` of them along the longest side of the field's box.
"""

from __future__ import annotations

import math

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
    spacing = spacing_for(field, resolution)
    lower = np.array(field.lower)
    nodes = np.ceil((np.array(field.upper) - lower) / spacing - 1e-6).astype(int) + 1
    values = np.empty(tuple(nodes[::-1]), np.float32)
    crossed = crossed_blocks(field, lower, spacing, nodes)
    # Where no stored node is near, all nodes of a block have the same value
    same = node_values(field, lower, BLOCK * spacing, crossed.shape)
    for x in range(0, nodes[0], BLOCK):
        last = min(x + BLOCK, nodes[0])
        shape = (last - x, *nodes[1:])
        slab = _expand_blocks(same[x // BLOCK], shape)
        where = np.flatnonzero(_expand_blocks(crossed[x // BLOCK], shape))
        slab.reshape(-1)[where] = node_values(field, lower + spacing * np.array([x, 0, 0]), spacing, shape, where)
        values[:, :, x:last] = slab.transpose(2, 1, 0)
    return values, lower, lower + spacing * (nodes - 1)


def _expand_blocks(values: np.ndarray, shape) -> np.ndarray:
    """Repeat the values of blocks (Y, Z) at the nodes of one layer of blocks, of the ``shape`` (x, y, z)."""
    for axis in range(2):
        values = np.repeat(values, BLOCK, axis=axis)
    return np.broadcast_to(values[: shape[1], : shape[2]], shape).copy()


def crossed_blocks(field: DistanceField, lower, spacing: float, cells) -> np.ndarray:
    """Return which blocks of :data:`BLOCK` cells along each side the surface may pass through, bool (X, Y, Z).

    For a sparse field these are the blocks with stored nodes around, for any other field all blocks.
    """
    count = -(-np.asarray(cells) // BLOCK)
    structure = getattr(field, "structure", None)
    if structure is None:
        return np.ones(count, dtype=bool)
    # Summed-area table of the blocks of nodes: those in a box are counted by differences
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
    inside = 0
    for a, b, c in CORNERS:
        sign = (-1) ** (a + b + c + 1)
        inside = inside + sign * total[np.ix_(ranges[0][a], ranges[1][b], ranges[2][c])]
    return inside > 0


def node_values(field: DistanceField, lower, spacing: float, shape, where=None) -> np.ndarray:
    """Return values at the nodes ``lower + spacing · (i, j, k)`` of a grid of the ``shape`` (X, Y, Z), float32.

    With ``where``, numbers of nodes in that shape, the result is ``(N,)``, otherwise it has the shape.
    """
    t = field.types
    # Opaque: all grids of all fields use the same kernel
    first, step = dr.opaque(t.Array3f, list(map(float, lower))), dr.opaque(t.Float, spacing)
    inverse = dr.opaque(t.Float64, 1 / shape[2]), dr.opaque(t.Float64, 1 / shape[1])
    sides = dr.opaque(t.Array3u, [int(n) for n in shape])
    count, values = math.prod(shape) if where is None else len(where), [np.zeros(0, np.float32)]
    with dr.suspend_grad():
        for start in range(0, count, CHUNK):
            last = min(start + CHUNK, count)
            if where is None:
                n = dr.arange(t.UInt32, last - start) + dr.opaque(t.UInt32, start)
            else:
                n = device_array(t.UInt32, where[start:last])
            # In double precision, the product is never rounded up to the next whole number
            rows = t.UInt32((t.Float64(n) + 0.5) * inverse[0])
            layer = t.UInt32((t.Float64(rows) + 0.5) * inverse[1])
            index = layer, rows - layer * sides.y, n - rows * sides.z
            p = [dr.fma(t.Float(i), step, a) for i, a in zip(index, first, strict=True)]
            values.append(field.value(t.Array3f(*p)).numpy())
    return np.concatenate(values).reshape(shape if where is None else count)


#: Share of a node's value that remains where the correction would change its sign.
REMAINDER = 0.1


def sharpen(values: np.ndarray, band: float) -> None:
    """Correct a :func:`grid` in place so that its trilinear interpolation is nearer to the field; signs stay.

    ``band`` is the largest distance that the field returns; the correction is that of :func:`_sharpened`.
    """
    flat = values.reshape(-1)
    near = np.abs(values) < band
    for axis in range(3):
        np.moveaxis(near, axis, 0)[[0, -1]] = False
    where = np.flatnonzero(near)
    steps = (1, values.shape[2], values.shape[2] * values.shape[1])
    around = (flat[where + sign * step] for step in steps for sign in (1, -1))
    flat[where] = _sharpened(flat[where], around, band)


def _sharpened(values: np.ndarray, around, band: float) -> np.ndarray:
    """Correct values at nodes, given those of their six neighbours, for the error of interpolation.

    The interpolation of a quadratic function exceeds it where it is convex, on average over a cell by a twelfth of the
    second differences along the three axes. Values decrease by as much, unless that changes the sign or one of the
    seven values is truncated.
    """
    total, near = -6 * values, np.abs(values) < band
    for other in around:
        total += other
        near &= np.abs(other) < band
    moved = values - total / 12
    moved = np.where((moved < 0) == (values < 0), moved, REMAINDER * values)
    return np.where(near, moved, values)


#: Coarsest grid that is considered, and the factor by which the result may be finer than needed.
COARSEST, FINER = 8, 1.03

#: Sampling of surface points: points drawn at once, largest number of draws, Newton steps, and largest error in cells.
DRAWN, DRAWS, NEWTON, ON_SURFACE = 2**15, 64, 6, 1e-3

#: Parts along the longest side of a box; points are drawn in those that the surface may pass through.
PARTS = 16


def resolution_for(
    field: DistanceField, error: float, finest: int = MAX_RESOLUTION, seed: int = 0
) -> tuple[int, float]:
    """Return the coarsest sufficient grid's cells along the longest side, from 8 to ``finest``, and its mean error.

    A grid suffices if its trilinear interpolation differs from the field by at most ``error`` on average on the field's
    surface; the result is within 3% of the coarsest one. If ``finest`` does not suffice, it is returned with its larger
    error. ``error`` is meant to be the field's own (``mae_surface``). Grids are evaluated on the surface only.
    """
    points = surface_points(field, 2**12, seed)
    low, high = min(COARSEST, finest) - 1, finest
    best = trilinear_error(field, points, high)
    while best <= error and high > max(low + 1, FINER * low):
        # Errors go with the square of the cells, or fall less steeply: usually this is fine enough
        guess = round(high * math.sqrt(max(best, 1e-3 * error) / error)) if error > 0 else low
        if low >= COARSEST:
            guess = max(guess, round(math.sqrt(low * high)))
        elif guess * FINER > high:
            guess = math.floor(high / FINER)
        guess = min(max(guess, low + 1), high - 1)
        tried = trilinear_error(field, points, guess)
        if tried <= error:
            high, best = guess, tried
        else:
            low = guess
    return high, best


def trilinear_error(field: DistanceField, points: np.ndarray, resolution: int) -> float:
    """Return the mean difference between the field and the interpolation of a :func:`sharpen`-ed grid at ``points``.

    ``points`` are ``(N, 3)``; the error of none is 0.
    """
    if not len(points):
        return 0.0
    spacing = spacing_for(field, resolution)
    place = (points - np.array(field.lower)) / spacing
    cell = np.floor(place).astype(np.int64)
    weights = place - cell
    # Each node once; beyond the box, all have the same value
    side = resolution + 4
    numbers = (cell[:, None] + CORNERS + 1).clip(0, side - 1) @ np.array([side**2, side, 1])
    numbers, index = np.unique(numbers, return_inverse=True)
    nodes = np.stack(np.unravel_index(numbers, (side,) * 3), -1) - 1

    def values_at(nodes):
        return point_values(field, np.array(field.lower) + spacing * nodes)

    around = (values_at(nodes + sign * step) for step in np.eye(3, dtype=int) for sign in (1, -1))
    values = _sharpened(values_at(nodes), around, field.band)[index.reshape(len(points), 8)]
    blend = np.prod(np.where(CORNERS == 1, weights[:, None], 1 - weights[:, None]), axis=2)
    return float(np.mean(np.abs((blend * values).sum(axis=1) - point_values(field, points))))


def surface_points(field: DistanceField, count: int, seed: int = 0) -> np.ndarray:
    """Return about ``count`` points of the field's surface, ``(N, 3)``, nearly uniform over its area.

    Points near the surface are moved onto it by Newton's method along the gradient. Without a surface, N is 0.
    """
    rng = np.random.default_rng(seed)
    side = float(np.max(np.array(field.upper) - np.array(field.lower))) / PARTS
    blocks = np.ceil((np.array(field.upper) - np.array(field.lower)) / side - 1e-6).astype(int)
    parts = np.argwhere(crossed_blocks(field, np.array(field.lower), side / BLOCK, BLOCK * blocks))
    points, have = [np.zeros((0, 3))], 0
    for _ in range(DRAWS if len(parts) else 0):
        p = parts[rng.integers(len(parts), size=DRAWN)] + rng.random((DRAWN, 3))
        p = np.array(field.lower) + side * p
        p = p[np.abs(point_values(field, p)) < 0.9 * field.band][:count]
        for _ in range(NEWTON if len(p) else 0):
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
