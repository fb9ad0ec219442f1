"""Study ``tradeoff sdf``: the distance field of a mesh by ours and by other methods in equal bytes.

*Dense* and *sparse grids* hold exact distances in 8 bits, sparse ones at each node of a cell that the surface crosses.
*Ours* and *paper* are presets of ``fit sdf`` (:mod:`mi_diffind.tasks.sdf`). *Hash grid + network* is that of
``drjit.nn``, in half precision, trained until twice as many steps gain little. Each method is as fine as the memory
budget allows; the search for the spacing is part of the seconds. All bytes count that a read needs. Rays of sparse
fields need an index in addition, which has a column of its own.

Errors are those of :class:`~mi_diffind.tasks.sdf.evaluation.SurfaceEvaluation`; lengths are relative to the longest
side. Times: reads at random points within 0.01 of the surface; primary rays, beside Embree on the mesh and Mitsuba's
``sdfgrid``.
"""

from __future__ import annotations

import argparse
import functools
import math
import time
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core import compat
from ..core.runtime import array_module
from ..core.units import parse_bytes
from ..fitting.loop import FitSettings
from ..measure import plot
from ..measure.study import FLOOR, Candidate, Case, Measure, Plan, Study
from ..measure.training import Contender, NetworkContender
from ..plugins.support.distance_shapes import crop_grid
from ..tasks.sdf import grids, marching
from ..tasks.sdf.distances import Distances
from ..tasks.sdf.evaluation import SurfaceEvaluation
from ..tasks.sdf.field import DistanceField
from ..tasks.sdf.mesh import Mesh, load_mesh
from ..tasks.sdf.paper import PairProblem
from . import equal_memory
from .baselines import distance_fields as rivals

#: Default memory budgets; all methods are trained and timed at the first one.
SIZES = ("1M", "256k", "512k", "2M", "4M")

#: Method → its label.
METHODS = {
    "dense": "dense grid", "distances": "sparse grid", "ours": "ours", "paper": "paper", "hash": "hash grid + network",
}  # fmt: skip

#: Methods that are trained at the first budget only.
FIRST_ONLY = ("paper", "hash")

#: Method → preset of ``fit sdf``; the default is "".
PRESETS = {"ours": "", "paper": "paper"}

#: Methods whose errors are shown; ours is compared with the first two.
SHOWN = ("dense", "distances", "ours")

#: Training of the network.
HASH_SETTINGS = {"seed": 1, "schedule": "cosine", "deterministic": False, "lr": 1e-2, "batch": 2**13, "loss": "mae"}

#: Candidate that rays are compared with, beside ``sdfgrid``.
MESH = "mesh (Embree)"

MEASURES = (
    Measure("near the surface, −10 log₁₀(1 − IoU), dB", "iou_near_db", ".1f"),
    Measure("IoU", "iou", ".4f"),
    Measure("IoU near", "iou_near", ".4f"),
    Measure("normals, °", "normal_deg", ".2f", False),
    Measure("normals, 95%, °", "normal_p95_deg", ".1f", False),
    Measure("distances near", "mae_near", ".1e", False),
    Measure("index of rays, bytes", "index_bytes", ",", False),
)

#: Settings of a run: held-out points; points that the network is trained on, and measured at; steps of trainings by
#: presets (0: the preset's own), and of the shortest and the longest of the network; pixels along a side of pictures;
#: cells of ``sdfgrid`` along the longest side.
FULL = {"points": 2**20, "samples": (2**20, 2**16), "steps": 0, "hash_steps": (500, 4000), "side": 400, "grid": 256}
QUICK = {"points": 2**14, "samples": (2**14, 2**10), "steps": 20, "hash_steps": (40, 80), "side": 160, "grid": 32}


def size_text(nbytes: int) -> str:
    """Return a number of bytes as text: ``262144`` → ``"256 KiB"``."""
    return f"{nbytes / 2**20:g} MiB" if nbytes >= 2**20 else f"{nbytes / 2**10:g} KiB"


class SdfStudy(Study):
    """Distance fields in equal bytes: errors against the mesh, and times of reads and rays."""

    name = "sdf"
    title = "the distance field of a mesh, in equal bytes, reads and rays"
    example = "mesh.ply"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default="scenes/assets/suzanne.ply", metavar="MESH",
            help="a mesh file that trimesh reads (default: scenes/assets/suzanne.ply)",
        )  # fmt: skip
        parser.add_argument(
            "--bytes", action="append", default=[], metavar="N",
            help=f"memory budget; may be repeated (default: {', '.join(SIZES)}; --quick: 64k); at the first one "
            "all methods are trained, and reads and rays are timed",
        )  # fmt: skip

    def check(self, arguments) -> None:
        """Check the arguments and read the mesh; raises :class:`~mi_diffind.tasks.sdf.mesh.MeshError`."""
        default = ("64k",) if arguments.quick else SIZES
        arguments.sizes = tuple(dict.fromkeys(map(parse_bytes, arguments.bytes or default)))
        arguments.loaded = load_mesh(arguments.source)

    def plan(self, arguments) -> Plan:
        settings = SimpleNamespace(sizes=arguments.sizes, **(QUICK if arguments.quick else FULL))
        return plan(arguments.loaded, arguments.source, settings)


STUDY = SdfStudy()


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class DistanceStudyContext:
    """State that all contenders share: the ``mesh`` of the file ``name``, its distances and held-out points."""

    mesh: Mesh
    name: str
    settings: SimpleNamespace
    types: object

    @functools.cached_property
    def distances(self) -> Distances:
        return Distances(self.mesh)

    @functools.cached_property
    def evaluation(self) -> SurfaceEvaluation:
        return SurfaceEvaluation(self.mesh, self.distances, self.settings.points)

    @functools.cached_property
    def samples(self) -> PairProblem:
        """Points that a network is trained on and measured at, and the frame of its field."""
        # As far from the surface as those of arrays with half as many entries along each side as the finest grid
        shapes = ((rivals.FINEST // 2,) * 3, (2,) * 3)
        return PairProblem(self.distances, shapes, "constant", self.types, 1, *self.settings.samples)

    def record(self, model: DistanceField, nbytes: int, **details) -> dict:
        """Return the record of a field with its errors; ``iou_near_db`` is the wrong share near the surface, in dB."""
        errors = self.evaluation.measure(model)
        errors["iou_near_db"] = -10 * math.log10(max(1 - errors["iou_near"], 1e-6))
        errors["index_bytes"] = marching.index_bytes(model)
        return {"bytes": nbytes, "errors": errors, "details": {"spacing": model.spacing, **details}}


def preset_contender(context: DistanceStudyContext, fields: dict) -> Contender:
    """Return the contender that a preset of ``fit sdf`` trains."""

    def fit(job: Contender, progress: bool) -> dict | None:
        steps = {"steps": context.settings.steps} if context.settings.steps else {}
        arguments = {"source": context.name, "bytes": str(job.budget), **steps}
        trained = equal_memory.fit_preset(job, progress, "sdf", "field", PRESETS[job.method], arguments)
        if trained is None:
            return None
        model, fitted = trained
        result = fitted.result
        details = {"steps": result.steps, "trained_seconds": result.seconds}
        record = context.record(model.field, model.nbytes, **details)
        return {**record, "seconds": fitted.figures["prepared_seconds"] + result.seconds}

    return Contender(fit=fit, read=lambda job: equal_memory.open_preset(job, "sdf").field, **fields)


def grid_contender(context: DistanceStudyContext, fields: dict) -> Contender:
    """Return the contender of a grid of exact distances, which is computed anew when it is read."""
    make = rivals.dense_grid if fields["method"] == "dense" else rivals.distance_nodes
    finest = rivals.finest_dense_grid if fields["method"] == "dense" else rivals.finest_distance_nodes

    def fit(job: Contender, progress: bool) -> dict:
        start = time.perf_counter()
        job.model = finest(context.types, context.distances, job.budget)
        seconds = time.perf_counter() - start
        return {**context.record(job.model, job.model.nbytes), "seconds": seconds}

    def read(job: Contender) -> DistanceField:
        return make(context.types, context.distances, job.record["details"]["spacing"])

    return Contender(fit=fit, read=read, has_file=False, **fields)


def hash_contender(context: DistanceStudyContext, fields: dict) -> NetworkContender:
    """Return the contender of a hash grid with a network."""
    (steps, longest), budget = context.settings.hash_steps, fields["budget"]

    def build(net) -> DistanceField:
        return rivals.HashDistanceField(net, context.samples.field)

    def finish(net, record: dict) -> dict:
        model = build(net)
        return context.record(model, model.nbytes, steps=record["steps"])

    settings, problem = FitSettings(**HASH_SETTINGS, steps=steps), lambda: rivals.HashProblem(context.samples, budget)
    return NetworkContender(*fields.values(), build, problem, settings, longest, 8, True, finish)


def contender(method: str, nbytes: int, context: DistanceStudyContext) -> Contender | NetworkContender:
    """Return the contender of a method in ``nbytes``."""
    label, size = METHODS[method], size_text(nbytes)
    make = hash_contender if method == "hash" else preset_contender if method in PRESETS else grid_contender
    fields = {"name": f"{label} {size}", "method": method, "budget": nbytes, "label": label, "setting": size}
    return make(context, fields)


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(mesh: Mesh, name: str, settings: SimpleNamespace) -> Plan:
    """Return the plan for a ``mesh``, of the file ``name``, in the variant that is set."""
    context = DistanceStudyContext(mesh, name, settings, array_module(mi.variant()))
    jobs = [contender(*chosen, context) for chosen in equal_memory.combinations(METHODS, settings.sizes, FIRST_ONLY)]
    timed = {job.method: job for job in jobs if job.budget == settings.sizes[0]}
    grid = f"sdfgrid {settings.grid}³"

    def reads(lanes: int) -> dict:
        p = grids.point_array(timed["ours"].model, np.resize(context.evaluation.near, (lanes, 3)))
        dr.make_opaque(p)
        value, normal = {FLOOR: lambda: list(p)}, {FLOOR: lambda: list(p)}
        for job in timed.values():
            value[job.name] = lambda f=job.model: [f.value(p)]
            normal[job.name] = lambda f=job.model: [f.gradient(p)[1]]
        return {"value": value, "normal": normal}

    def rays(lanes: int) -> dict:
        o, d = camera_rays(lanes)
        queries = {FLOOR: lambda: [*o, *d]}
        for method, job in timed.items():
            if method != "hash":  # no bound of its slope is known
                queries[job.name] = lambda f=job.model: [marching.trace(f, o, d, dr.inf)[0]]
        scenes = {MESH: mesh_scene(mesh), grid: grid_scene(timed["ours"].model, settings.grid)}
        for name, scene in scenes.items():  # which have to live until the results are evaluated
            queries[name] = lambda s=scene: [s.ray_intersect_preliminary(mi.Ray3f(o, d), coherent=True).t]
        return {"ray": queries}

    nbytes = {MESH: 12 * (len(mesh.vertices) + len(mesh.faces)), grid: 4 * settings.grid**3}
    compared = [timed[method].name for method in SHOWN[:2]]
    return Plan(
        study="sdf",
        title=f"Distance fields of {Path(name).stem} in equal bytes: accuracy against time and bytes",
        candidates=[
            *(job.candidate() for job in jobs),
            *(Candidate(n, n.split()[0], bytes=size, is_reference=True) for n, size in nbytes.items()),
        ],
        cases=[Case("reads", reads), Case("rays", rays)],
        ratios=[(timed["ours"].name, other) for other in (*compared, *nbytes)],
        details={
            "source": name, "source_digest": mesh.digest, "triangles": len(mesh.faces), "request": vars(settings),
        },
        notes=[
            f"{Path(name).name}, {len(mesh.faces):,} triangles. IoU near: within 0.01 of the longest side. Bytes are "
            "those of all that a read needs; rays of sparse fields need an index in addition."
        ],
        jobs=jobs,
        panels=("bytes",),
        pictures={"shapes": lambda result: draw_normals(context, [timed[m] for m in SHOWN], result)},
        measures=MEASURES,
    )  # fmt: skip


# -- Views -------------------------------------------------------------------------------------------------------------

#: Direction of the camera from the origin, its distance, and its field of view in degrees.
DIRECTION = (0.45, 0.3, 1.0)
DISTANCE = 2.6
FOV = 32.0


def camera_rays(count: int):
    """Return origins and directions of ``count`` rays of a camera, which sees all of a mesh in a square film.

    Rays go through the centres of pixels, row by row from the top; they are evaluated.
    """
    side = math.isqrt(count - 1) + 1
    origin = (DISTANCE * np.array(DIRECTION) / np.linalg.norm(DIRECTION)).tolist()
    sensor = mi.load_dict({
        "type": "perspective", "fov": FOV, "to_world": mi.ScalarTransform4f().look_at(origin, [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": side, "height": side},
    })  # fmt: skip
    i = dr.arange(mi.UInt32, count)
    place = mi.Point2f((i % side + 0.5) / side, (i // side + 0.5) / side)
    ray, _ = sensor.sample_ray(0, 0, place, mi.Point2f(0.5))
    dr.make_opaque(ray.o, ray.d)
    return ray.o, ray.d


def mesh_scene(mesh: Mesh) -> mi.Scene:
    """Return a scene of a mesh in the unit frame."""
    shape = mi.Mesh("mesh", len(mesh.vertices), len(mesh.faces), mi.Properties("mesh"))
    buffers = mi.traverse(shape)
    compat.set_triangles(buffers, mesh.vertices, mesh.faces)
    buffers.update()
    return mi.load_dict({"type": "scene", "shape": shape})


def grid_scene(field: DistanceField, resolution: int) -> mi.Scene:
    """Return a scene of Mitsuba's ``sdfgrid``, decoded with ``resolution`` cells along the longest side."""
    values, lower, upper = grids.grid(field, resolution)
    values, lower, upper = crop_grid(values, lower, (upper[0] - lower[0]) / (values.shape[2] - 1))
    to_world = mi.ScalarTransform4f().translate(lower.tolist()).scale((upper - lower).tolist())
    grid = mi.TensorXf(np.ascontiguousarray(values[..., None], np.float32))
    return mi.load_dict({"type": "scene", "shape": {"type": "sdfgrid", "grid": grid, "to_world": to_world}})


def draw_normals(context: DistanceStudyContext, jobs: list[Contender], result: dict):
    """Draw the errors of normals of contenders on the shape, where rays meet mesh and fields."""
    shape = (context.settings.side,) * 2
    (o, d), scene = camera_rays(math.prod(shape)), mesh_scene(context.mesh)
    si = scene.ray_intersect(mi.Ray3f(o, d))
    hit = si.is_valid().numpy().reshape(shape)
    grey = dr.select(si.is_valid(), 0.25 + 0.65 * dr.clip(-dr.dot(si.n, d), 0, 1), 1)
    row = {"mesh": np.repeat(grey.numpy().reshape(*shape, 1), 3, axis=2)}
    for job in jobs:
        with dr.suspend_grad():
            t, met = marching.trace(job.model, o, d, dr.inf)
            slope = job.model.gradient(dr.fma(d, dr.select(met, t, 0), o))[1]
            angle = dr.rad2deg(dr.safe_acos(dr.dot(dr.normalize(slope), si.n)))
            angle = dr.select(met == si.is_valid(), dr.select(met, angle, dr.nan), 90)
        error = result["candidates"][job.name]["errors"]["normal_deg"]
        row[f"{job.name}\nmean error {error:.2f}°"] = angle.numpy().reshape(shape)
    row = {name: image[plot.crop_to(hit)] for name, image in row.items()}
    title = f"{Path(context.name).stem}: angle between the normals of a field and of the mesh"
    return plot.draw_images(title, " ".join(result["notes"]), {"": row}, 2.6, "error of the normal, degrees")
