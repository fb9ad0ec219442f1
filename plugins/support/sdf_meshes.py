"""Meshes of distance fields: the exact counterpart, and meshes of scenes that a field can stand for."""

from __future__ import annotations

import atexit
import functools
import hashlib
import shutil
import tempfile
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mi_diffind.arrays.tables import TableError
from mi_diffind.core import compat
from mi_diffind.core.errors import DiffindError
from mi_diffind.core.files import is_within, stamp
from mi_diffind.tasks.sdf import TASK
from mi_diffind.tasks.sdf.mesh import directed_edges, load_mesh, read_serialized, split_part

from . import properties
from .stock import Kept

#: Share of open edges up to which a mesh counts as closed: a fit closes holes, but not a surface without an inside.
OPEN = 0.01

#: Share of triangles that may face inwards: those of a distance field all face outwards.
INWARDS = 0.01

#: Mean angle between shading normals and triangles up to which a field stands for both, in degrees. A ball of polished
#: metal under the sun is 24% darker with triangles of 5.1°, and equal within 0.1% with those of 2.5° (4% in blocks).
SMOOTH_DEG = 3.0


def to_mesh(props: mi.Properties) -> None:
    """Replace the ``filename`` of a ``neural_sdf`` by that of its mesh, as a ``ply`` file."""
    path = Path(properties.filename(props))
    try:
        settings = TASK.load(path).settings
    except TableError as e:
        raise RuntimeError(str(e)) from None
    recorded = settings.get("mesh_path")
    if not recorded:
        raise RuntimeError(f"{path}: names no mesh that it was made from")
    mesh = (path.resolve().parent / recorded).resolve()
    file, _ = split_part(mesh)
    if not file.is_file():
        raise RuntimeError(f"{file}: no such file, {path.name} was made from it")
    if not is_within(path.resolve().parent, recorded) and _digest(mesh, stamp(file)) != settings.get("source"):
        raise RuntimeError(f"{file}: has changed since {path.name} was made from it")
    props["filename"] = str(mesh) if mesh.suffix.lower() == ".ply" else _as_ply(mesh, stamp(file))


def closed_mesh_of(path: Path, folder: Path, index: int = 0) -> Path:
    """Return the file of a mesh to fit: ``path``, or the PLY file of one shape of a ``.serialized`` in ``folder``.

    Raises :class:`~.stock.Kept` for a mesh that encloses no solid.
    """
    try:
        if path.suffix.lower() == ".serialized":
            vertices, faces = read_serialized(path)[index]
            path = folder / f"{path.stem}_{index}_{hashlib.sha256(vertices.tobytes()).hexdigest()[:12]}.ply"
            trimesh.Trimesh(vertices, faces, process=False).export(path)
        faces = load_mesh(path).faces
    except IndexError:
        raise Kept(f"has the shape_index {index}, which {path} lacks") from None
    except (ValueError, OSError) as e:
        raise Kept(f"is no solid: {e}") from None
    edges, signs = directed_edges(faces, int(faces.max()) + 1)
    balance = np.bincount(np.unique(edges, return_inverse=True)[1], signs)
    if np.count_nonzero(balance) > OPEN * len(balance):
        raise Kept(f"encloses no solid: {np.count_nonzero(balance):,} of {len(balance):,} edges are open")
    return path


def check_normals(props: mi.Properties, source: Path) -> float:
    """Return the mean angle between the shading normals of a mesh and those of its triangles, in degrees.

    ``props``: properties of the shape; ``source``: the file of its mesh. Raises :class:`~.stock.Kept` for a mesh whose
    normals, as Mitsuba renders them, a distance field does not have: the triangles have to face outwards, and the
    shading normals, of the file or smoothed by Mitsuba, have to be near those of the triangles.
    """
    mesh = load_mesh(source)
    linear = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix)[:3, :3]
    inwards = mesh.turned / len(mesh.faces)
    if (np.linalg.det(linear) < 0) != (props.get("flip_normals", False) is True):
        inwards = 1 - inwards
    if inwards > INWARDS:
        raise Kept(f"is wound inside out: {inwards:.0%} of its triangles face inwards, those of fields outwards")
    if props.get("face_normals", False) is True:
        return 0.0
    keys = [key for key in ("filename", "shape_index", "face_normals") if key in props]
    angle = _smoothness(mi.load_dict({"type": props.plugin_name(), **{key: props[key] for key in keys}}))
    if angle > SMOOTH_DEG:
        raise Kept(
            f"has shading normals {angle:.0f}° from those of its triangles, distance fields have the latter: "
            f"face_normals true renders it without"
        )
    return angle


def _smoothness(mesh: mi.Mesh) -> float:
    """Return the mean angle over a mesh's area between its shading normals and those of its triangles, in degrees."""
    vertices, faces = compat.triangles(mesh)
    a, b, c = np.moveaxis(vertices[faces].astype(np.float64), 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    index, angles = dr.arange(mi.UInt32, len(faces)), 0
    for place in ((1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3)):  # exact for quadratic functions on a triangle
        pi = dr.zeros(mi.PreliminaryIntersection3f, len(faces))
        pi.t, pi.prim_index, pi.prim_uv = 1, index, mi.Point2f(*place)
        si = mesh.compute_surface_interaction(dr.zeros(mi.Ray3f, len(faces)), pi)
        angles = angles + np.degrees(dr.safe_acos(dr.dot(si.n, si.sh_frame.n)).numpy()) / 3
    return float((angles * areas).sum() / areas.sum())


@functools.lru_cache
def _folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="mi_diffind_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@functools.lru_cache
def _digest(path: Path, stamp: tuple) -> str:
    """Return the digest of a mesh file."""
    try:
        return load_mesh(path).digest
    except DiffindError as e:
        raise RuntimeError(str(e)) from None


@functools.lru_cache
def _as_ply(path: Path, stamp: tuple) -> str:
    """Return a PLY copy of a mesh file, kept until the process ends."""
    try:
        mesh = load_mesh(path)
    except DiffindError as e:
        raise RuntimeError(str(e)) from None
    written = _folder() / f"{split_part(path)[0].stem}_{abs(hash((path, stamp))):x}.ply"
    trimesh.Trimesh(mesh.to_file_frame(mesh.vertices), mesh.faces, process=False).export(written)
    return str(written)
