"""Meshes of distance fields: the exact counterpart, and meshes of scenes that a field can stand for."""

from __future__ import annotations

import atexit
import functools
import hashlib
import shutil
import tempfile
from pathlib import Path

import mitsuba as mi
import numpy as np
import trimesh

from mi_diffind.errors import DiffindError
from mi_diffind.files import is_within
from mi_diffind.tables import TableError
from mi_diffind.task import stamp
from mi_diffind.tasks.sdf import TASK, serialized
from mi_diffind.tasks.sdf.mesh import directed_edges, load_mesh, split_part

from . import properties
from .stock import Kept

#: Share of open edges up to which a mesh counts as closed: a fit closes holes, but not a surface without an inside.
OPEN = 0.01


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
            vertices, faces = serialized.read(path)[index]
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
