"""Signed distance field as a shape, traced through its arrays or decoded to a grid."""

from __future__ import annotations  # Delayed parsing of type annotations

import math
import time

import mitsuba as mi
import numpy as np

from mi_diffind.core.errors import raised_as
from mi_diffind.core.files import stamp
from mi_diffind.tasks.sdf import TASK, grids, marching

from . import Counterpart, Plugin, Stock, reports_as, shown_as, warn
from .support import properties
from .support.distance_shapes import (
    CELL_BYTES,
    SEEN_BY,
    check_normals,
    closed_mesh_file,
    crop_grid,
    distance_shape,
    finest,
    native_grid,
    to_mesh,
)
from .support.manual import shared_parts
from .support.placement import Placement, similarity
from .support.properties import Kept, StockNode
from .support.tables import file_and_storage, shared

#: Cells along the longest side of the finest grid that is chosen automatically.
FINEST = 512

#: Bytes in Mitsuba of the largest such grid.
LARGEST = 3 * 2**30

#: Error, in cells of the field, assumed for a file without measurements; sparse fields have 0.002 to 0.007.
TYPICAL_ERROR = 0.005


def open_model(props: mi.Properties):
    """Return the model that the properties ``filename`` and ``storage`` name; all shapes of a file share bytes."""
    path, storage = file_and_storage(props, TASK.name)
    if storage == "float32":
        return TASK.open(mi.TensorXf, path, storage=storage)
    return shared((TASK.name, path, *stamp(path), mi.TensorXf), lambda: TASK.open(mi.TensorXf, path))


def decode_grid(model, resolution: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict]:
    """Return a grid of a model's field for ``sdfgrid``, its corners in the unit frame, and its report.

    ``resolution`` is the number of cells along the longest side; 0 chooses the coarsest grid with an error below that
    of the arrays.
    """
    field, wanted = model.field, model.table.measured.get("mae_surface")
    measured = isinstance(wanted, (int, float)) and 0 < wanted < math.inf
    if not measured:
        wanted = TYPICAL_ERROR * field.spacing
    if resolution:
        error = grids.trilinear_error(field, grids.surface_points(field, 2**12), resolution)
    else:
        most = min(FINEST, finest(np.subtract(field.upper, field.lower), LARGEST))
        resolution, error = grids.resolution_for(field, wanted, most)
    values, lower, upper = grids.grid(field, resolution)
    values[1:-1, 1:-1, 1:-1] = grids.sharpen(values, field.band)
    values, lower, upper = crop_grid(values, lower, (upper[0] - lower[0]) / (values.shape[2] - 1))
    report = {
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
    return values, lower, upper, report


def sentence(report: dict) -> str:
    """Return the report of a grid as a sentence."""
    about = "" if report["arrays_error_measured"] else "about "
    return (
        f"decoded to a grid of {report['resolution']} cells along the longest side, "
        f"{report['memory_bytes'] / 1e6:,.0f} MB in Mitsuba, {report['seconds']:.1f} s; on average, its surface is "
        f"{report['error']:.2g} of that side off the arrays', which is {about}{report['arrays_error']:.2g} off the "
        f"mesh's"
    )


@shared_parts
class NeuralSDF(distance_shape(mi.Mesh)):
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
       - From the mesh file's place and size to the world: rotations, uniform scales, translations and reflections.
         (Default: none)
       - |exposed|, |differentiable|, |discontinuous|

     * - bsdf
       - |bsdf|
       - The material. (Default: diffuse)
       - --

     * - normals
       - |string|
       - Shading normals: ``analytic``, the gradient of the field; ``smooth``, the blended normals of nodes, which
         rounds edges. (Default: ``analytic``; with ``grid``, ``smooth``)
       - --

     * - trace
       - |string|
       - ``arrays``: rays are traced through the arrays themselves, by the integrator :monosp:`path_sdf` only. ``grid``:
         when the scene is loaded, distances are decoded to Mitsuba's :monosp:`sdfgrid`, which any integrator sees.
         (Default: ``arrays``; ``grid`` if ``mi-diffind`` or ``mi_diffind.load_file`` loads a scene with another
         integrator)
       - --

     * - resolution
       - |int|
       - With ``grid``: cells along the longest side of the field's box, 4 to 512. (Default: the coarsest grid with an
         error below that of the arrays, up to 512 cells and 3.2 GB)
       - --

     * - storage
       - |string|
       - ``uint8``, as in the file; ``float32``, which can be optimised. (Default: ``uint8``)
       - --

     * - tables.nodes, tables.primary, tables.cascaded
       - |tensor|
       - With ``storage`` ``float32``: for the sparse layout, distance (in spacings) and gradient of each node,
         ``(n, 4)``; for the others, their arrays.
       - |exposed|, |differentiable|

    Mesh stored as a signed distance field of a few hundred kilobytes (Datta et al., *Efficient Graphics Representation
    with Differentiable Indirection*, SIGGRAPH Asia 2023, supplement 1.6; the default layout is a sparse one of ours).
    The shape is a solid: rays hit its surface from either side, and dielectrics distinguish inside from outside. The
    exact counterpart is the mesh that the file was made from.

    **With** ``arrays``, nothing is decoded. In Mitsuba 3.9, the only shapes that can be written in Python are meshes.
    This shape is therefore a mesh without area, and only :monosp:`path_sdf` sees it. For other integrators, commands of
    ``mi-diffind`` and ``mi_diffind.load_file`` decode it to a grid, unless ``trace`` is given or ``storage`` is
    ``float32``: then commands refuse the scene, and ``mi_diffind.load_file`` warns. ``mi.load_file`` and
    ``mi.load_dict`` do not decode: other integrators render the scene without the shape, and :monosp:`mi.render` warns
    once. The integrator :monosp:`aov` is one of these, since its channels come from rays of its own. Several shapes of
    one file share its arrays. Texture coordinates are 0; emitters, media and :monosp:`shapegroup` are not supported.

    ``to_world`` may change between renders, with any ``storage``; the shape is then that of a new scene. Its
    derivatives are those of :monosp:`path_sdf`: shading, without the outlines that move. With ``analytic`` normals, a
    normal jumps from cell to cell of the field, and the jumps have no derivative: on glossy solids,
    derivatives of pixels are several times as far from differences as with ``smooth`` normals, which do not jump.

    **With** ``grid``, the resolution is chosen when the scene is loaded: grids are evaluated at 4096 places on the
    surface, and the coarsest one is taken whose mean distance to the arrays' surface is at most the arrays' mean
    distance to the mesh when they were fitted. Values beside the surface are corrected for the error of
    interpolation. Mitsuba takes 40 bytes for each cell of the box around the surface, crossed or not: hundreds of
    megabytes for a field of 256 KiB, gigabytes for one of 1 MiB; ``resolution`` requests a coarser grid.
    Where 512 cells or 3.2 GB do not suffice, a warning states the errors; ``mi-diffind inspect`` states
    them for any scene. Each shape has its own grid. A rotated grid is an instance; derivatives and parameters are those
    of :monosp:`sdfgrid`.

    {executable}

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
        props.get("resolution", 0)  # for a grid, if the scene's integrator needs one
        to_world = props.get("to_world", mi.ScalarTransform4f())
        super().__init__(props, self.model.field, Placement(to_world, self.model.scale, self.model.centre), smooth)

    def entries(self) -> dict:
        return self.model.entries()

    def trained(self) -> tuple:
        """Return the table of the file, and the entries that can be optimised, by name."""
        return self.model.table, self.model.entries()

    def report(self) -> dict:
        return {
            "preset": self.model.table.preset,
            "storage": self.model.storage,
            "table_bytes": self.model.nbytes,
            "trace": "arrays",
            "index_bytes": marching.index_bytes(self.model.field),
        }

    def to_string(self) -> str:
        path, size = self.model.table.path, self.placement.length
        return f'NeuralSDF[\n  filename = "{path}",\n  trace = arrays,\n  size = {size:g}\n]'


def factory(props: mi.Properties):
    """Create the shape, or Mitsuba's ``sdfgrid`` with ``trace="grid"``."""
    if properties.one_of(props, "trace", ("arrays", "grid")) == "arrays":
        return NeuralSDF(props)
    if properties.one_of(props, "storage", ("uint8", "float32")) == "float32":
        raise RuntimeError('parameter "storage": found "float32", trace="grid" has no arrays that can be optimised')
    start, model = time.perf_counter(), open_model(props)
    resolution = props.get("resolution", 0)
    if not isinstance(resolution, int) or ("resolution" in props and not 4 <= resolution <= 512):
        raise RuntimeError(f'parameter "resolution": found {resolution}, allowed are whole numbers from 4 to 512')
    to_world = props.get("to_world", mi.ScalarTransform4f())
    similarity(to_world)  # raises for an invalid transform
    normals = properties.one_of(props, "normals", ("smooth", "analytic"))
    with raised_as(RuntimeError, RuntimeError, at=model.table.path):
        values, lower, upper, report = decode_grid(model, resolution)
    to_unit = mi.ScalarTransform4f().translate(list(model.centre)).scale(model.scale)
    to_world = mi.ScalarTransform4f(np.array(to_world.matrix))
    shape, kept = native_grid(props, values, lower, upper, to_world @ to_unit, normals)
    report["seconds"] = round(time.perf_counter() - start, 2)
    report["decoded"] = sentence(report)
    if not resolution and report["error"] > report["arrays_error"]:
        finer = f'set "resolution" for a grid of more than {FINEST} cells or {LARGEST / 1e9:.1f} GB'
        warn(f"{model.table.path}: {report['decoded']}; {finer}")
    if kept is not shape:
        shown_as(shape, kept)
    reports_as(kept, lambda: report)
    return shape


#: Bytes of the field that a scene's mesh gets without a file of its own.
BYTES = 2**18


#: Least intersection over union of that fit with the solid.
LEAST_IOU = 0.98

#: Largest mean error of the normals of that fit, in degrees.
LARGEST_ANGLE = 8.0


def _from_mesh(node: StockNode) -> str:
    """Replace a mesh of a file by its distance field."""
    props = node.props
    if any(parent.plugin_name() == "shapegroup" for parent in node.parents):
        raise Kept("is in a shapegroup, which distance fields do not support")
    if node.nested_types(mi.ObjectType.Emitter):
        raise Kept("emits light, distance fields emit none")
    if "interior" in props or "exterior" in props:
        raise Kept("borders on a medium, distance fields hold none")
    materials = [name for name in node.nested_types(mi.ObjectType.BSDF) if name == "neural_material"]
    if textures := materials + node.nested_types(mi.ObjectType.Texture):
        raise Kept(f"has a material with textures ({', '.join(textures)}), distance fields have no texture coordinates")
    node.allow("filename", "shape_index", "face_normals", "flip_normals", "flip_tex_coords", "to_world", "bsdf")
    with raised_as(Kept, RuntimeError, at="cannot be placed"):
        similarity(props.get("to_world", mi.ScalarTransform4f()))
    source = closed_mesh_file(node.file(), node.folder, props.get("shape_index", 0))
    smooth = check_normals(props, source)
    table = node.fit(TASK.name, source, bytes=BYTES)
    quality = f"IoU {table.measured['iou']:.4f}, normals off by {table.measured['normal_deg']:.1f}°"
    if table.measured["iou"] < LEAST_IOU or table.measured["normal_deg"] > LARGEST_ANGLE:
        limits = f"{LEAST_IOU:g} and {LARGEST_ANGLE:g}° are needed"
        raise Kept(f"{node.file().name} would have {quality}, {limits}: fit it by hand, with more bytes")
    props["filename"] = str(table.path)
    properties.remove(props, "shape_index", "face_normals", "flip_normals", "flip_tex_coords")
    lost = f", those of smooth shading, {smooth:.1f}° from the triangles, are lost" if smooth >= 0.05 else ""
    return f"{table.path.name}, {quality}{lost}"


PLUGIN = Plugin(
    "neural_sdf",
    "shape",
    factory,
    task=TASK.name,
    seen_by=SEEN_BY,
    otherwise=("trace", "grid"),
    stock=Stock("mesh", ("ply", "obj", "serialized"), _from_mesh),
    exact=Counterpart("ply", ("normals", "trace", "resolution", "storage"), convert=to_mesh),
)
