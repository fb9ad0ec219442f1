from __future__ import annotations  # Delayed parsing of type annotations

import math
import threading
import time
from pathlib import Path
from weakref import WeakValueDictionary

import mitsuba as mi
import numpy as np

from mi_diffind import compat
from mi_diffind.tables import TableError
from mi_diffind.task import stamp
from mi_diffind.tasks.sdf import TASK

from . import Counterpart, Plugin, reports_as, shown_as, warn
from .support import properties, tables
from .support.sdf_meshes import to_mesh
from .support.solids import CELL_BYTES, Placement, Solid, finest, fitted, native_grid

#: Whose arrays cannot be optimised are shared by all shapes of a file.
_shared: WeakValueDictionary = WeakValueDictionary()
_lock = threading.RLock()  # Mitsuba makes the shapes of a scene at once; who waits for a kernel may make another one

#: A grid that ``trace="grid"`` takes by itself has so many cells along the longest side and bytes in Mitsuba, at most.
FINEST, LARGEST = 512, 3 * 2**30

#: The error of arrays whose file does not tell, in cells of the field: sparse ones have 0.002 to 0.007.
TYPICAL_ERROR = 0.005


def open_model(props: mi.Properties):
    """The model that the properties ``filename`` and ``storage`` name. Raises ``RuntimeError``."""
    path, storage = properties.filename(props), properties.one_of(props, "storage", ("uint8", "float32"))
    if not path:
        raise RuntimeError('parameter "filename": not given, a file of "mi-diffind fit sdf" is needed')
    key = (path, stamp(Path(path)), mi.TensorXf)
    try:
        if storage == "float32":
            return TASK.open(mi.TensorXf, path, storage=storage)
        with _lock:
            model = _shared.get(key)
            return model if model is not None else _shared.setdefault(key, TASK.open(mi.TensorXf, path))
    except (TableError, ValueError) as e:
        raise RuntimeError(str(e)) from None


def decoded(model, resolution: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict]:
    """
    The grid of a model's field that ``sdfgrid`` takes, its corners in the unit frame, and what is to be said of it:
    with ``resolution`` cells along the longest side, or 0, as many as it takes for an error below that of the arrays.
    """
    from mi_diffind.tasks.sdf import decode

    field, wanted = model.field, model.table.measured.get("mae_surface")
    measured = isinstance(wanted, (int, float)) and 0 < wanted < math.inf
    if not measured:
        wanted = TYPICAL_ERROR * field.spacing
    if resolution:
        error = decode.trilinear_error(field, decode.surface_points(field, 2**12), resolution)
    else:
        most = min(FINEST, finest(np.subtract(field.upper, field.lower), LARGEST))
        resolution, error = decode.resolution_for(field, wanted, most)
    values, lower, upper = decode.grid(field, resolution)
    decode.interpolable(values, field.band)
    values, lower, upper = fitted(values, lower, (upper[0] - lower[0]) / (values.shape[2] - 1))
    said = {
        "preset": model.table.preset,
        "storage": model.storage,
        "table_bytes": model.nbytes,
        "trace": "grid",
        "resolution": resolution,
        "cells": [n - 1 for n in values.shape[::-1]],
        "grid_bytes": values.nbytes,
        "memory_bytes": CELL_BYTES * math.prod(n - 1 for n in values.shape),
        "error": float(error),
        "arrays_error": float(wanted),
        "arrays_error_measured": measured,
    }
    return values, lower, upper, said


def sentence(said: dict) -> str:
    """What is said of a grid, in short."""
    about = "" if said["arrays_error_measured"] else "about "
    return (
        f"decoded to a grid of {said['resolution']} cells along the longest side, {said['memory_bytes'] / 1e6:,.0f} MB "
        f"in Mitsuba, {said['seconds']:.1f} s; on average, its surface is {said['error']:.2g} of that side off the "
        f"arrays', which is {about}{said['arrays_error']:.2g} off the mesh's"
    )


class NeuralSDF(Solid):
    r"""
    .. _shape-neural_sdf:

    Signed distance field (:monosp:`neural_sdf`)
    --------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A signed distance field, as written by ``mi-diffind fit sdf``.
       - --

     * - to_world
       - |transform|
       - From the mesh's own place and size to the world: rotations, uniform scales and translations; reflections,
         too. (Default: none)
       - --

     * - bsdf
       - |bsdf|
       - The material. (Default: diffuse)
       - --

     * - normals
       - |string|
       - Shading normals: ``analytic``, the gradient of the field, which is what the surface is; ``smooth``, the stored
         normals blended, which rounds edges. (Default: ``analytic``; of ``grid``, ``smooth``)
       - --

     * - trace
       - |string|
       - ``arrays``: rays are traced through the arrays themselves, by the integrator :monosp:`path_sdf`. ``grid``: the
         distances are decoded to Mitsuba's :monosp:`sdfgrid` when the scene is loaded, which any integrator sees.
         (Default: ``arrays``; in a scene that ``mi-diffind`` or ``mi_diffind.load_file`` loads, ``grid`` if its
         integrator is another one)
       - --

     * - resolution
       - |int|
       - Of ``grid``: cells along the longest side of the field's box, 4 to 512. (Default: as few as it takes for an
         error below that of the arrays, as far as 512 cells and 3.2 GB allow)
       - --

     * - storage
       - |string|
       - ``uint8``, as in the file; ``float32``, which can be optimised. (Default: ``uint8``)
       - --

     * - tables.nodes, tables.primary, tables.cascaded
       - |tensor|
       - With ``storage`` ``float32``: of the sparse layout, distance (in spacings) and gradient of each node,
         ``(n, 4)``; of the others their arrays.
       - |exposed|, |differentiable|

    A mesh stored as a signed distance field in a few hundred kilobytes (Datta et al., *Efficient Graphics
    Representation with Differentiable Indirection*, SIGGRAPH Asia 2023, supplement 1.6; the default layout is a sparse
    one of ours). What it holds is a solid: a ray meets its surface from either side, and dielectrics know inside from
    outside. The exact counterpart is the mesh that the file was made from.

    **With** ``arrays``, nothing is decoded. Mitsuba 3.9 knows of no shapes written in Python but meshes, so this one is
    a mesh without area: other integrators than :monosp:`path_sdf` do not see it. The commands of ``mi-diffind`` and
    ``mi_diffind.load_file`` decode it for them unless ``trace`` is given or ``storage`` is ``float32``: then, commands
    refuse the scene, and ``mi_diffind.load_file`` warns. ``mi.load_file`` and ``mi.load_dict`` cannot: the shape is
    missing in what other integrators render. Several shapes of one file share its arrays. There are no texture
    coordinates (they are 0), no emitters and no media, and it cannot be in a :monosp:`shapegroup`.

    **With** ``grid``, the resolution is found when the scene is loaded: grids are tried at 4096 places on the surface,
    and the coarsest one is taken that is off the arrays' surface by no more than that was off the mesh when it was
    fitted, both on average. Values beside the surface are changed a little, which takes a fifth to a third off the
    error: what lies between nodes would be too large where the field is convex. Mitsuba takes 40 bytes for each cell of
    the box around the surface, crossed or not: for a field of 256 kB 400 MB, for one of 1 MB more than 2.5 GB and
    up to 20 seconds; ``resolution`` says how coarse it is to be instead. Where 512 cells or 3.2 GB do not suffice, a
    warning says what the errors are; ``mi-diffind inspect`` says it of any scene. Each shape has a grid of its own. A
    rotation makes of it an instance; the derivatives and parameters are those of :monosp:`sdfgrid`.

    .. tabs::
        .. code-tab:: xml
            :name: neural_sdf

            <shape type="neural_sdf">
                <string name="filename" value="suzanne.npz"/>
                <bsdf type="dielectric"/>
            </shape>

        .. code-tab:: python

            'type': 'neural_sdf',
            'filename': 'suzanne.npz',
            'bsdf': {'type': 'dielectric'}
    """

    def __init__(self, props: mi.Properties):
        self.model = open_model(props)
        smooth = properties.one_of(props, "normals", ("analytic", "smooth")) == "smooth"
        properties.one_of(props, "trace", ("arrays", "grid"))
        if "trace" in props and "resolution" in props:
            raise RuntimeError('parameter "resolution": has no effect with trace="arrays"')
        props.get("resolution", 0)  # of a grid, if other integrators are to see one
        to_world = props.get("to_world", mi.ScalarTransform4f())
        super().__init__(props, self.model.field, Placement.of(to_world, self.model.scale, self.model.centre), smooth)

    def entries(self) -> dict:
        """Names of what can be optimised → tensors."""
        field = self.model.field
        if getattr(field, "nodes", None) is not None:
            return {"nodes": field.nodes}
        return {name: array.data for name, array in tables.exposed(self.model.arrays).items()}

    def optimised(self) -> bool:
        return any(compat.has_gradient(values) for values in self.entries().values())

    def traverse(self, cb: mi.TraversalCallback) -> None:
        super().traverse(cb)
        if self.ready:
            for name, values in self.entries().items():
                cb.put(f"tables.{name}", values, mi.ParamFlags.Differentiable)

    def parameters_changed(self, keys=()) -> None:
        if not self.ready:
            super().parameters_changed(keys)
            return
        nodes = getattr(self.model.field, "nodes", None)
        if nodes is not None and tuple(nodes.shape) != (self.model.field.structure.nodes, 4):
            raise RuntimeError(
                f'parameter "tables.nodes": has the shape {tuple(nodes.shape)}, expected '
                f"{(self.model.field.structure.nodes, 4)}"
            )
        tables.check_shapes(tables.exposed(self.model.arrays))
        if not keys or any(key.startswith("tables.") for key in keys):
            self.model.field.changed()

    def report(self) -> dict:
        return {
            "preset": self.model.table.preset,
            "storage": self.model.storage,
            "table_bytes": self.model.nbytes,
            "trace": "arrays",
            "index_bytes": self.index_bytes,
        }

    def to_string(self) -> str:
        path, size = self.model.table.path, self.placement.size
        return f'NeuralSDF[\n  filename = "{path}",\n  trace = arrays,\n  size = {size:g}\n]'


def factory(props: mi.Properties):
    """The shape, or Mitsuba's own if it is to trace a grid."""
    if properties.one_of(props, "trace", ("arrays", "grid")) == "arrays":
        return NeuralSDF(props)
    if properties.one_of(props, "storage", ("uint8", "float32")) == "float32":
        raise RuntimeError('parameter "storage": found "float32", trace="grid" has no arrays that can be optimised')
    start, model = time.perf_counter(), open_model(props)
    resolution = props.get("resolution", 0)
    if not isinstance(resolution, int) or ("resolution" in props and not 4 <= resolution <= 512):
        raise RuntimeError(f'parameter "resolution": found {resolution}, allowed are whole numbers from 4 to 512')
    to_world = props.get("to_world", mi.ScalarTransform4f())
    Placement.of(to_world, model.scale, model.centre)  # refuses what is none
    normals = properties.one_of(props, "normals", ("smooth", "analytic"))
    try:
        values, lower, upper, said = decoded(model, resolution)
    except RuntimeError as e:
        raise RuntimeError(f"{model.table.path}: {e}") from None
    to_unit = mi.ScalarTransform4f().translate(list(model.centre)).scale(model.scale)
    to_world = mi.ScalarTransform4f(np.array(to_world.matrix))
    made, kept = native_grid(props, values, lower, upper, to_world @ to_unit, normals)
    said["seconds"] = round(time.perf_counter() - start, 2)
    said["decoded"] = sentence(said)
    if not resolution and said["error"] > said["arrays_error"]:
        finer = f'finer than {FINEST} cells or {LARGEST / 1e9:.1f} GB a grid is only if "resolution" says so'
        warn(f"{model.table.path}: {said['decoded']}; {finer}")
    if kept is not made:
        shown_as(made, kept)
    reports_as(kept, lambda: said)
    return made


PLUGIN = Plugin(
    "neural_sdf",
    "shape",
    factory,
    task=TASK.name,
    seen_by=Solid.seen_by,
    otherwise=("trace", "grid"),
    exact=Counterpart("ply", ("normals", "trace", "resolution", "storage"), convert=to_mesh),
)
