"""Triangle meshes in the unit frame: the bounding box is centred at the origin and its longest side is 1.

All distances, tolerances and points of this task are in that frame; negative is inside. Every format of trimesh,
Mitsuba's ``.serialized`` and its scenes are read. Repairs that "inside" depends on are listed in :attr:`Mesh.warnings`.
"""

import dataclasses
import functools
import hashlib
import logging
import os
import re
import struct
import warnings
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...core import compat
from ...core.errors import DiffindError, missing_package, reason
from ...core.files import irregular, shown
from ...core.runtime import use_variant
from ...core.units import memory

#: First number of a file and of each mesh in it.
MAGIC = 0x041C

#: Flag of a serialized mesh → numbers of each vertex that follow its position: normal, texture coordinates, colour.
ATTRIBUTES = {0x1: 3, 0x2: 2, 0x8: 3}

#: Flag of a serialized mesh: numbers have double precision.
DOUBLE = 0x2000


def read_serialized(path: str | os.PathLike, number: str = "") -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the meshes of a file, or one by its number: vertices ``(V, 3)``, float64, and faces ``(F, 3)``, int64.

    The format is described at Mitsuba's shape ``serialized``; versions 3 and 4 are read. Raises ``ValueError`` for
    other content, and ``OSError``.
    """
    data = Path(path).read_bytes()
    try:
        version = struct.unpack_from("<2H", data)[1]
        count = struct.unpack_from("<I", data, len(data) - 4)[0]
        width = 8 if version == 4 else 4
        starts = np.frombuffer(data, f"<u{width}", count, len(data) - 4 - width * count)
        meshes = [_serialized_mesh(data, int(start), version) for start in starts]
    except (struct.error, zlib.error, ValueError) as e:
        raise ValueError(f"is no file of serialized meshes, or cut short: {e}") from None
    if number and number not in map(str, range(count)):
        raise ValueError(f'holds no mesh "{number}", allowed are 0 to {count - 1}')
    return [meshes[int(number)]] if number else meshes


def _serialized_mesh(data: bytes, start: int, version: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh that begins at the byte ``start``. Raises ``ValueError`` and others for wrong bytes."""
    magic, each = struct.unpack_from("<2H", data, start)
    if magic != MAGIC or each not in (3, 4) or each != version:
        raise ValueError(f"found the numbers {magic:#x} and {each} at byte {start}, expected {MAGIC:#x} and 3 or 4")
    content = zlib.decompressobj().decompress(data[start + 4 :])
    flags = struct.unpack_from("<I", content)[0]
    place = 4 if version == 3 else content.index(b"\0", 4) + 1
    vertices, faces = struct.unpack_from("<2Q", content, place)
    place += 16
    positions = np.frombuffer(content, "<f8" if flags & DOUBLE else "<f4", 3 * vertices, place)
    numbers = 3 + sum(count for flag, count in ATTRIBUTES.items() if flags & flag)
    place += numbers * vertices * positions.itemsize
    indices = np.frombuffer(content, "<u8" if vertices > 0xFFFFFFFF else "<u4", 3 * faces, place)
    return positions.reshape(-1, 3).astype(np.float64), indices.reshape(-1, 3).astype(np.int64)


def read_scene(path: Path, name: str = "") -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the meshes of a scene, or the one whose id is ``name``: vertices ``(V, 3)`` and faces ``(F, 3)``.

    The scene is loaded in the variant that is set. Raises ``ValueError`` for another name, and ``RuntimeError`` as
    Mitsuba does.
    """
    use_variant()
    import mitsuba as mi

    shapes = [shape for shape in mi.load_file(str(path), optimize=False).shapes() if shape.is_mesh()]
    chosen = [shape for shape in shapes if name in ("", shape.id())]
    if not chosen:
        names = ", ".join(f'"{shape.id()}"' for shape in shapes) or "none"
        raise ValueError(f'holds no mesh "{name}", found {names}')
    return [compat.triangles(shape) for shape in chosen]


#: Extent along an axis, relative to the longest side, below which a mesh is flat: float32 resolves no volume in it.
FLAT = 1e-6

#: Volume, relative to the cube of the longest side, below which a closed mesh encloses nothing.
NO_VOLUME = 1e-12

#: Twice the area, relative to the square of the longest edge, up to which a triangle counts as degenerate.
SLIVER = 1e-12

#: Largest number of components whose orientation is tested one by one.
MAX_ORIENTED = 200


#: Extension of files with several meshes → the function that reads them, or the part that is named.
PARTS = {".serialized": read_serialized, ".xml": read_scene}


class MeshError(DiffindError, ValueError):
    """A mesh cannot be used; the message is one sentence that names the file and the fault."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangle mesh: ``vertices`` (V, 3) float64 in the unit frame, and ``faces`` (F, 3) int32.

    Each position occurs once; faces are counter-clockwise from outside. ``watertight``: each edge is used as often in
    one direction as in the other, so the winding number is whole and changes on the surface only. A point of the file
    is ``vertices · scale + centre``. ``digest`` is a SHA-256 over vertices and faces; ``warnings`` has one sentence for
    each repair or doubt, and ``turned`` is the number of triangles that were wound the other way in the file.
    """

    vertices: np.ndarray
    faces: np.ndarray
    watertight: bool
    scale: float = 1.0
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)
    path: str = ""
    digest: str = ""
    warnings: list[str] = dataclasses.field(default_factory=list)
    turned: int = 0

    @property
    def lower(self) -> np.ndarray:
        """Lower corner of the bounding box, ``(3,)``."""
        return self.vertices.min(axis=0)

    @property
    def upper(self) -> np.ndarray:
        return self.vertices.max(axis=0)

    @functools.cached_property
    def corners(self) -> np.ndarray:
        """Vertices of each triangle, ``(F, 3, 3)``."""
        return self.vertices[self.faces]

    @functools.cached_property
    def _crosses(self) -> np.ndarray:
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a)

    @functools.cached_property
    def areas(self) -> np.ndarray:
        """Areas of the triangles, ``(F,)``."""
        return np.linalg.norm(self._crosses, axis=1) / 2

    @property
    def area(self) -> float:
        return float(self.areas.sum())

    @functools.cached_property
    def normals(self) -> np.ndarray:
        """Unit normals of the triangles, ``(F, 3)``."""
        return self._crosses / (2 * self.areas)[:, None]

    @functools.cached_property
    def labels(self) -> np.ndarray:
        """Component number of each triangle, ``(F,)``; triangles that share a vertex belong together."""
        return component_labels(self.faces, len(self.vertices))

    @property
    def components(self) -> int:
        """Number of connected pieces of the surface; overlapping pieces count separately."""
        return int(self.labels.max()) + 1

    @property
    def volume(self) -> float:
        """Volume of a watertight mesh; where pieces overlap, volume counts once per piece."""
        return float(tetrahedron_volumes(self.vertices, self.faces).sum())

    def to_file_frame(self, points: np.ndarray) -> np.ndarray:
        """Convert points ``(…, 3)`` of the unit frame to units and place of the file."""
        return points * self.scale + np.array(self.centre)


def load_mesh(mesh) -> Mesh:
    """Read a mesh file, or take a ``trimesh.Trimesh``, a ``trimesh.Scene``, a ``mi.Mesh`` or ``(vertices, faces)``.

    The meshes of a scene file are joined where its transforms place them. ``SCENE.xml#ID`` names one shape of a Mitsuba
    scene, ``FILE.serialized#N`` one mesh, counted from 0. Equal vertices are merged, degenerate triangles left out, and
    triangles wound against their neighbours or around their solid the wrong way are turned. Raises :class:`MeshError`.
    """
    if not isinstance(mesh, (str, os.PathLike)):
        return make_mesh(*_in_memory(mesh))
    path, part = split_part(mesh)
    if fault := irregular(path, memory() // 4):
        raise MeshError(f"{shown(path)}: {fault}")
    if not path.is_file():
        raise MeshError(f"{path}: {'is a folder' if path.is_dir() else 'there is no such file'}, expected a mesh")
    vertices, faces = _read(path, part)
    return make_mesh(vertices, faces, str(mesh))


def _in_memory(mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a mesh in memory. Raises :class:`MeshError` for an object that is none."""
    if hasattr(mesh, "vertex_positions_buffer") or hasattr(mesh, "from_fields"):  # mi.Mesh
        return compat.triangles(mesh)
    if hasattr(mesh, "to_geometry"):  # trimesh.Scene
        mesh = mesh.to_geometry()
    if hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        return np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if isinstance(mesh, (tuple, list)) and len(mesh) == 2:
        return np.asarray(mesh[0]), np.asarray(mesh[1])
    raise MeshError(f"mesh: found a {type(mesh).__name__}, expected a file, a trimesh.Trimesh or a mi.Mesh")


def make_mesh(vertices: np.ndarray, faces: np.ndarray, name: str = "mesh") -> Mesh:
    """Build a mesh from ``vertices`` (V, 3) in any units and place, and ``faces`` (F, 3), as :func:`load_mesh` does."""
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(f"{name}: has vertices {vertices.shape} and faces {faces.shape}, expected (V, 3) and (F, 3)")
    if len(faces) == 0:
        raise MeshError(f"{name}: has no triangles, expected a surface that encloses a solid")
    _check_indices(name, faces, len(vertices))
    vertices, faces = _merge_vertices(vertices, faces)
    if not np.all(np.isfinite(vertices)):
        raise MeshError(f"{name}: has vertices that are NaN or infinite, allowed are finite ones")

    lower, upper = vertices.min(axis=0), vertices.max(axis=0)
    with np.errstate(over="ignore"):
        extent = upper - lower
    scale = float(extent.max())
    if not np.isfinite(scale) or scale <= 0 or scale < 1e-12 * np.abs(vertices).max():
        raise MeshError(f"{name}: has the extent {scale:g}, too small for, or too large for, its numbers")
    if extent.min() <= FLAT * scale:
        axis = "xyz"[int(extent.argmin())]
        raise MeshError(f"{name}: is flat, its extent along {axis} is {extent.min() / scale:g} of its longest side")
    centre = lower + 0.5 * extent
    vertices = (vertices - centre) / scale

    repairs = []
    vertices, faces, watertight, turned = _repair(vertices, faces, name, repairs)
    vertices, faces = np.ascontiguousarray(vertices), np.ascontiguousarray(faces, dtype=np.int32)
    digest = hashlib.sha256(vertices.tobytes() + faces.tobytes()).hexdigest()
    mesh = Mesh(vertices, faces, watertight, scale, tuple(float(c) for c in centre), name, digest, repairs, turned)
    if mesh.watertight and abs(mesh.volume) < NO_VOLUME:
        raise MeshError(f"{name}: encloses no volume, expected the surface of a solid")
    return mesh


def _check_indices(name, faces: np.ndarray, count: int) -> None:
    """Raise :class:`MeshError` for a triangle that names a vertex which does not exist."""
    lowest, highest = int(faces.min()), int(faces.max())
    if lowest < 0 or highest >= count:
        wrong = lowest if lowest < 0 else highest
        raise MeshError(f"{name}: a triangle names vertex {wrong}, there are vertices 0 to {count - 1}")


def split_part(path: str | os.PathLike) -> tuple[Path, str]:
    """Return the file and the part of ``FILE#PART``; the part is "" without one, or if there is a file of that name."""
    path = Path(path)
    name, _, part = path.name.rpartition("#")
    if os.path.isfile(path) or Path(name).suffix.lower() not in PARTS:
        return path, ""
    return path.with_name(name), part


def _read(path: Path, part: str = "") -> tuple[np.ndarray, np.ndarray]:
    """Read vertices and faces of all triangles of a file."""
    import trimesh

    level = logging.getLogger("trimesh").level
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            if path.suffix.lower() in PARTS:
                meshes = (trimesh.Trimesh(*arrays, process=False) for arrays in PARTS[path.suffix.lower()](path, part))
                loaded = trimesh.Scene(list(meshes))
            else:
                loaded = trimesh.load(path, process=False)
    except MemoryError:
        raise
    except ImportError as e:
        quoted = re.search(r"pip install ([\w\[\]-]+)|No module named '(\w+)", str(e))
        module = e.name or (quoted and (quoted[1] or quoted[2])) or "trimesh[easy]"
        if module == "charset_normalizer":  # what trimesh would guess the encoding with
            raise MeshError(f"{path}: cannot be read as a mesh, its text is not UTF-8") from None
        raise MeshError(f"{path}: {path.suffix} files need {missing_package(module)}") from None
    except Exception as e:  # readers of a dozen formats raise whatever they like
        fault = f"{type(e).__name__}: {reason(e)}"
        raise MeshError(f"{path}: cannot be read as a mesh, it is damaged or of an unknown format ({fault})") from None
    finally:
        logging.getLogger("trimesh").setLevel(level)
    if isinstance(loaded, trimesh.Scene):
        nodes = [loaded.graph[node] for node in loaded.graph.nodes_geometry]
        placed = [(loaded.geometry[name], matrix) for matrix, name in nodes]
    else:
        placed = [(loaded, np.eye(4))]
    vertices, faces, first = [], [], 0
    for geometry, matrix in placed:
        if not isinstance(geometry, trimesh.Trimesh) or not len(geometry.faces):
            continue
        triangles, mirrored = np.asarray(geometry.faces), np.linalg.det(matrix[:3, :3]) < 0
        points = np.asarray(geometry.vertices, dtype=np.float64)
        _check_indices(path, triangles, len(points))
        vertices.append(points if np.array_equal(matrix, np.eye(4)) else points @ matrix[:3, :3].T + matrix[:3, 3])
        faces.append((triangles[:, ::-1] if mirrored else triangles) + first)
        first += len(points)
    if not faces:
        raise MeshError(f"{path}: has no triangles, expected a surface that encloses a solid")
    return np.concatenate(vertices), np.concatenate(faces)


def _repair(vertices: np.ndarray, faces: np.ndarray, name: str, repairs: list[str]):
    """Drop degenerate triangles and turn wrongly wound ones; sentences are added to ``repairs``."""
    twice = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    faces = faces[~twice]
    if not len(faces):
        raise MeshError(f"{name}: has no triangle that has an area, expected the surface of a solid")

    against = _inconsistent(faces)
    if against.any():
        faces[against] = faces[against, ::-1]
        repairs.append(f"{name}: {against.sum():,} triangles wound against their neighbours were turned")
    turned = _inside_out(vertices, faces)
    if turned.any():
        faces[turned] = faces[turned, ::-1]
        share = "all triangles were" if turned.all() else f"{turned.sum():,} triangles of closed pieces were"
        repairs.append(f"{name}: {share} wound inside out and were turned")

    # Slivers connect their neighbours, but have no part in distances or in winding numbers
    open_edges = int(np.count_nonzero(edge_balance(faces, len(vertices))[1]))
    if open_edges:
        repairs.append(f"{name}: is not closed, {open_edges:,} edges have more triangles on one side than on the other")
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    longest = np.max([np.sum((b - a) ** 2, axis=1), np.sum((c - b) ** 2, axis=1), np.sum((a - c) ** 2, axis=1)], axis=0)
    flat = np.linalg.norm(np.cross(b - a, c - a), axis=1) <= SLIVER * longest
    if flat.all():
        raise MeshError(f"{name}: has no triangle that has an area, expected the surface of a solid")
    dropped = int(twice.sum() + flat.sum())
    if dropped:
        repairs.append(f"{name}: {dropped:,} triangles without an area were left out")
    used, faces = np.unique(faces[~flat], return_inverse=True)
    return vertices[used], faces.reshape(-1, 3), not open_edges, int(np.count_nonzero(against != turned))


def _merge_vertices(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge equal vertices and drop unused ones: vertices in lexicographic order, and faces that index them."""
    used = np.unique(faces)
    order = used[np.lexsort(vertices[used].T[::-1])]
    ordered = vertices[order]
    first = np.concatenate([[True], np.any(ordered[1:] != ordered[:-1], axis=1)])
    number = np.empty(len(vertices), np.int64)
    number[order] = np.cumsum(first) - 1
    return ordered[first], number[faces]


def edge_balance(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return each edge's two ends ``(E, 2)``, ascending, and how often its direction is in surplus ``(E,)``.

    The third array holds the edges of each triangle, ``(F, 3)``. ``count`` is the number of vertices.
    """
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    keys, edge = np.unique(ends.min(axis=1) * count + ends.max(axis=1), return_inverse=True)
    surplus = np.bincount(edge, np.where(ends[:, 0] < ends[:, 1], 1, -1), len(keys)).astype(int)
    return np.stack([keys // count, keys % count], axis=-1), surplus, edge.reshape(-1, 3)


def component_labels(faces: np.ndarray, count: int) -> np.ndarray:
    """Return the component number of each triangle, ``(F,)``, given the ``count`` of vertices."""
    from trimesh.graph import connected_component_labels

    labels = connected_component_labels(faces[:, [0, 1, 1, 2]].reshape(-1, 2), count)
    return np.unique(labels[faces[:, 0]], return_inverse=True)[1]


def tetrahedron_volumes(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return the signed volume of the tetrahedron of each triangle and the origin, ``(F,)``."""
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.einsum("ij,ij->i", a, np.cross(b, c)) / 6


def _inconsistent(faces: np.ndarray) -> np.ndarray:
    """Return which triangles have to be turned for neighbours to agree, ``(F,)`` bool: less than half of each piece."""
    import igl

    oriented, piece = igl.bfs_orient(faces)
    turned = (oriented != faces).any(axis=1)
    return turned ^ (2 * np.bincount(piece, turned) > np.bincount(piece))[piece]


def _inside_out(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return which triangles belong to closed pieces that are wound inside out, ``(F,)`` bool.

    These are pieces of negative volume that are no cavity of another piece. If a mesh with open pieces has a negative
    volume as a whole, they are all triangles.
    """
    labels = component_labels(faces, len(vertices))
    _, surplus, edges = edge_balance(faces, len(vertices))
    unbalanced = np.bincount(labels, (surplus != 0)[edges].sum(axis=1))
    volumes = np.bincount(labels, tetrahedron_volumes(vertices, faces))
    if unbalanced.any() and volumes.sum() < 0:
        return np.ones(len(faces), dtype=bool)
    turned = np.zeros(len(faces), dtype=bool)
    suspects = np.flatnonzero((volumes < 0) & (unbalanced == 0))
    for label in suspects[np.argsort(volumes[suspects])[:MAX_ORIENTED]]:
        piece = labels == label
        place = vertices[faces[piece][0]].mean(axis=0)
        # Magnitudes, since the orientation of the other pieces is not known either
        winding = _windings(vertices, faces[~piece], labels[~piece], place)
        if np.sum(np.abs(winding) > 0.5) % 2 == 0:
            turned |= piece
    return turned


def _windings(vertices: np.ndarray, faces: np.ndarray, labels: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return each component's winding number around a place, by the solid angles of Van Oosterom and Strackee."""
    if not len(faces):
        return np.zeros(1)
    a, b, c = np.moveaxis(vertices[faces] - place, 1, 0)
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    above = np.einsum("ij,ij->i", a, np.cross(b, c))
    below = la * lb * lc
    for x, y, l in ((a, b, lc), (b, c, la), (c, a, lb)):
        below = below + np.einsum("ij,ij->i", x, y) * l
    return np.bincount(labels, np.arctan2(above, below) / (2 * np.pi))


#: Distance from a triangle at which either side is tested: resolved by float32, and thinner than thin sheets.
STEP = 2e-6

#: Edge length above which a triangle is tested in parts.
COARSE = 1 / 32

#: Edge length down to which parts are halved while some of a part bounds the solid and some does not.
FINE = 1 / 256

#: Barycentric coordinates at which a triangle is tested: the middle and near the corners.
PLACES = np.array([[1 / 3, 1 / 3, 1 / 3], [0.9, 0.05, 0.05], [0.05, 0.9, 0.05], [0.05, 0.05, 0.9]])


def close_holes(mesh: Mesh) -> Mesh:
    """Return the mesh with each hole, of any shape, closed by a fan of triangles around the middle of its edge."""
    from trimesh.graph import connected_component_labels

    count = len(mesh.vertices)
    ends, surplus, _ = edge_balance(mesh.faces, count)
    ends[surplus < 0] = ends[surplus < 0][:, ::-1]
    ends = np.repeat(ends, np.abs(surplus), axis=0)
    if not len(ends):
        return mesh
    hole = np.unique(connected_component_labels(ends, count)[ends[:, 0]], return_inverse=True)[1]
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
