"""
Fields back to what other programs read: triangles by marching cubes, and grids of distances.

Grids are laid out on cubic cells, ``resolution`` of them along the longest side of the field's box.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from ...errors import UsageError
from .field import DistanceField
from .structure import BLOCK as NODES

#: Cells along each side of the blocks that marching cubes is run on, if the surface passes through them.
BLOCK = 32

#: Points that a field is asked at once.
CHUNK = 2**22

#: The finest grid that is decoded.
MAX_RESOLUTION = 1024

#: Points of a surface: places drawn at once, how often at most, Newton's steps, what is near enough, of a cell.
DRAWN, DRAWS, NEWTON, ON_SURFACE = 2**15, 64, 6, 1e-3

#: Parts along the longest side of a box, of which those that the surface may pass through are drawn from.
PARTS = 16

#: Of its value: what is left of a node's that is to change its sign.
NEARER = 0.1

#: Of a cell: values nearer to zero are moved so far away from it, so that no vertex falls on a node.
OFF_NODE = 1e-3


def extract(field: DistanceField, resolution: int, scale: float = 1.0, centre=(0.0, 0.0, 0.0)):
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


def grid(field: DistanceField, resolution: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    The field at the nodes of a grid, float32 ``(Z, Y, X)``, and the corners of the box that its outermost nodes lie on:
    the field's lower one, and an upper one that no cell is cut by. What lies there is outside.
    """
    spacing = _spacing(field, resolution)
    lower = np.array(field.lower)
    nodes = np.ceil((np.array(field.upper) - lower) / spacing - 1e-6).astype(int) + 1
    values = np.empty(tuple(nodes[::-1]), np.float32)
    crossed = crossed_blocks(field, lower, spacing, nodes)
    # Where no stored node is near, all of a block's nodes say the same
    same = node_values(field, lower, BLOCK * spacing, crossed.shape)
    for x in range(0, nodes[0], BLOCK):
        last = min(x + BLOCK, nodes[0])
        shape = (last - x, *nodes[1:])
        slab = _of_blocks(same[x // BLOCK], shape)
        where = np.flatnonzero(_of_blocks(crossed[x // BLOCK], shape))
        slab.reshape(-1)[where] = node_values(field, lower + spacing * np.array([x, 0, 0]), spacing, shape, where)
        values[:, :, x:last] = slab.transpose(2, 1, 0)
    return values, lower, lower + spacing * (nodes - 1)


def _of_blocks(values: np.ndarray, shape) -> np.ndarray:
    """What is known of blocks (Y, Z) at the nodes of a layer of them, of the ``shape`` (x, y, z)."""
    for axis in range(2):
        values = np.repeat(values, BLOCK, axis=axis)
    return np.broadcast_to(values[: shape[1], : shape[2]], shape).copy()


def interpolable(values: np.ndarray, band: float) -> None:
    """
    Change a :func:`grid` of a field that tells distances up to ``band``, in place, so that its trilinear interpolation
    is nearer to the field (:func:`_interpolable`). Signs stay.
    """
    flat = values.reshape(-1)
    told = np.abs(values) < band
    for axis in range(3):
        np.moveaxis(told, axis, 0)[[0, -1]] = False
    where = np.flatnonzero(told)
    steps = (1, values.shape[2], values.shape[2] * values.shape[1])
    around = (flat[where + sign * step] for step in steps for sign in (1, -1))
    flat[where] = _interpolable(flat[where], around, band)


def _interpolable(values: np.ndarray, around, band: float) -> np.ndarray:
    """
    Values at nodes, with those of their six neighbours, as interpolation wants them. It is larger than what it
    interpolates where that is convex, by a twelfth of the second differences along the three axes on average over a
    cell (of a quadratic function). So much less, but for the sign; unless one of the seven tells no distance.
    """
    total, told = -6 * values, np.abs(values) < band
    for other in around:
        total += other
        told &= np.abs(other) < band
    moved = values - total / 12
    moved = np.where((moved < 0) == (values < 0), moved, NEARER * values)
    return np.where(told, moved, values)


def crossed_blocks(field: DistanceField, lower, spacing: float, cells) -> np.ndarray:
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


def node_values(field: DistanceField, lower, spacing: float, shape, where=None) -> np.ndarray:
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


def _spacing(field: DistanceField, resolution: int) -> float:
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

#: The coarsest grid that is thought of, and by how much one may be finer than needed.
COARSEST, FINER = 8, 1.03


def resolution_for(
    field: DistanceField, error: float, finest: int = MAX_RESOLUTION, seed: int = 0
) -> tuple[int, float]:
    """
    The coarsest grid (cells along the longest side, from 8 to ``finest``) whose trilinear interpolation differs from
    the field by no more than ``error`` on average on the field's surface, within 3%, and by how much it does: by more
    than ``error`` if ``finest`` is too coarse. ``error`` is meant to be the field's own (``mae_surface``).

    Grids are tried at places of the surface only.
    """
    points = surface_points(field, 2**12, seed)
    low, high = min(COARSEST, finest) - 1, finest
    found = trilinear_error(field, points, high)
    while found <= error and high > max(low + 1, FINER * low):
        # Errors go with the square of the cells, or fall less steeply: this is fine enough, mostly
        guess = round(high * math.sqrt(max(found, 1e-3 * error) / error)) if error > 0 else low
        if low >= COARSEST:
            guess = max(guess, round(math.sqrt(low * high)))
        elif guess * FINER > high:
            guess = math.floor(high / FINER)
        guess = min(max(guess, low + 1), high - 1)
        tried = trilinear_error(field, points, guess)
        if tried <= error:
            high, found = guess, tried
        else:
            low = guess
    return high, found


def trilinear_error(field: DistanceField, points: np.ndarray, resolution: int) -> float:
    """
    The mean difference between the field and the trilinear interpolation of a grid that is :func:`interpolable`, at
    points ``(N, 3)``; 0 for none.
    """
    if not len(points):
        return 0.0
    place = (points - np.array(field.lower)) / _spacing(field, resolution)
    cell = np.floor(place).astype(np.int64)
    weights = place - cell
    corners = np.stack(np.meshgrid(*[(0, 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
    # Each node once; further out than a box, they are all the same
    side = resolution + 4
    numbers = (cell[:, None] + corners + 1).clip(0, side - 1) @ np.array([side**2, side, 1])
    numbers, which = np.unique(numbers, return_inverse=True)
    nodes = np.stack(np.unravel_index(numbers, (side,) * 3), -1) - 1

    def told(nodes):
        return _values(field, np.array(field.lower) + _spacing(field, resolution) * nodes)

    around = (told(nodes + sign * step) for step in np.eye(3, dtype=int) for sign in (1, -1))
    values = _interpolable(told(nodes), around, field.band)[which.reshape(len(points), 8)]
    blend = np.prod(np.where(corners == 1, weights[:, None], 1 - weights[:, None]), axis=2)
    return float(np.mean(np.abs((blend * values).sum(axis=1) - _values(field, points))))


def surface_points(field: DistanceField, count: int, seed: int = 0) -> np.ndarray:
    """
    About ``count`` points of the field's surface, ``(N, 3)``: nearly uniform over its area, as they are points near it
    that go where their gradient leads. None if there is no surface.
    """
    rng = np.random.default_rng(seed)
    side = float(np.max(np.array(field.upper) - np.array(field.lower))) / PARTS
    blocks = np.ceil((np.array(field.upper) - np.array(field.lower)) / side - 1e-6).astype(int)
    parts = np.argwhere(crossed_blocks(field, np.array(field.lower), side / BLOCK, BLOCK * blocks))
    found, have = [np.zeros((0, 3))], 0
    for _ in range(DRAWS if len(parts) else 0):
        p = parts[rng.integers(len(parts), size=DRAWN)] + rng.random((DRAWN, 3))
        p = np.array(field.lower) + side * p
        p = p[np.abs(_values(field, p)) < 0.9 * field.band][:count]
        for _ in range(NEWTON if len(p) else 0):
            with dr.suspend_grad():
                value, slope = (np.asarray(v.numpy(), np.float64) for v in field.gradient(_array(field, p)))
            p = p - np.where((slope**2).sum(0) > 0.01, value / np.maximum((slope**2).sum(0), 0.01) * slope, 0).T
        found.append(p[np.abs(_values(field, p)) < ON_SURFACE * field.spacing])
        have += len(found[-1])
        if have >= count:
            break
    return np.concatenate(found)[:count]


def _values(field: DistanceField, points: np.ndarray) -> np.ndarray:
    """The field's values at points ``(N, 3)``: ``(N,)`` float64."""
    if not len(points):
        return np.zeros(0)
    with dr.suspend_grad():
        return field.value(_array(field, points)).numpy().astype(np.float64)


def _array(field: DistanceField, points: np.ndarray):
    return field.types.Array3f(np.ascontiguousarray(points.T, dtype=np.float32))
