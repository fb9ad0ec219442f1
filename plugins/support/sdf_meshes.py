"""Exact counterpart of a distance field: the mesh that it was made from."""

from __future__ import annotations

import atexit
import functools
import shutil
import tempfile
from pathlib import Path

import mitsuba as mi

from mi_diffind.errors import DiffindError
from mi_diffind.tables import TableError
from mi_diffind.task import stamp
from mi_diffind.tasks.sdf import TASK

from . import properties


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
    if not mesh.is_file():
        raise RuntimeError(f"{mesh}: no such file, {path.name} was made from it")
    props["filename"] = str(mesh) if mesh.suffix.lower() == ".ply" else _as_ply(mesh, stamp(mesh))


@functools.lru_cache
def _folder() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="mi_diffind_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@functools.lru_cache
def _as_ply(path: Path, stamp: tuple) -> str:
    """Return a PLY copy of a mesh file, kept until the process ends."""
    import trimesh

    from mi_diffind.tasks.sdf.mesh import load_mesh

    try:
        mesh = load_mesh(path)
    except DiffindError as e:
        raise RuntimeError(str(e)) from None
    written = _folder() / f"{path.stem}_{abs(hash((path, stamp))):x}.ply"
    trimesh.Trimesh(mesh.to_file_frame(mesh.vertices), mesh.faces, process=False).export(written)
    return str(written)
