"""Study ``tradeoff sdf``: the distance field of a mesh by ours and by other methods in equal bytes.

*Dense grids* of 8 bits hold exact distances, or trained nodes. *Sparse distances* are our layout without normals and
without indirection: 6 or 8 bits, whichever is better, at each node of a cell that the surface crosses, exact or
trained. *Ours* is the default preset of ``fit sdf``, *indirection* and *paper* are the others
(:mod:`mi_diffind.tasks.sdf`). *Hash grid + network* is that of ``drjit.nn``, in half precision. Nodes of grids are
trained by least squares, the exact minimum; the network until twice as many steps gain little. The ablation compares
ours with other numbers of bits. Each method is as fine as the memory budget allows; the search for the spacing is part
of the seconds. All bytes count that a read needs, the index included.

Errors are those of :class:`~mi_diffind.tasks.sdf.evaluation.SurfaceEvaluation`; lengths are relative to the longest
side. Times: reads at random points within 0.01 of the surface; primary rays, beside Embree on the mesh and Mitsuba's
``sdfgrid``; a whole render.
"""

from __future__ import annotations

import argparse
import functools
import json
import math
import time
from dataclasses import dataclass, field
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
from ..measure.report import figure_caption
from ..measure.store import fingerprint, package_files
from ..measure.study import FLOOR, Candidate, Case, Measure, Plan, Study
from ..plugins.support.distance_shapes import crop_grid, distance_shape
from ..plugins.support.placement import Placement
from ..tasks.sdf import grids, marching
from ..tasks.sdf.distances import Distances
from ..tasks.sdf.evaluation import SurfaceEvaluation
from ..tasks.sdf.field import DistanceField
from ..tasks.sdf.mesh import Mesh, load_mesh
from . import equal_memory
from .baselines import distance_fields as rivals
from .equal_memory import Contender, NetworkContender

#: Default memory budgets, and the one at which all methods are trained and timed.
SIZES = ("256k", "512k", "1M", "2M", "4M")
FIRST = "1M"

#: Method → its label.
METHODS = {
    "dense": "dense grid", "dense-trained": "dense grid, trained", "distances": "sparse distances",
    "distances-trained": "sparse distances, trained", "ours": "ours", "indirection": "indirection", "paper": "paper",
    "hash": "hash grid + network",
}  # fmt: skip

#: Methods that are trained at the first budget only.
FIRST_ONLY = ("indirection", "paper", "hash")

#: Method → its label, for the ablation.
PARTS = {
    "ours": "ours", "bits6": "6 bits a pointer", "bits8": "8 bits a pointer", "bits16": "16 bits a pointer",
    "distances-trained": "sparse distances, trained", "paper": "paper", "paper-constant": "paper, from a constant",
}  # fmt: skip

#: Method → preset and arguments, of methods that ``fit sdf`` trains.
PRESETS = {
    "ours": ("", {}), "indirection": ("dense", {}), "paper": ("paper", {}),
    "paper-constant": ("paper", {"constant": True}), **{f"bits{n}": ("", {"bits": n}) for n in (6, 8, 16)},
}  # fmt: skip

#: Methods of which an image is rendered, those whose errors are shown, and those that ours is timed beside.
RENDERED = ("dense-trained", "distances-trained", "ours")
SHOWN = ("dense-trained", "distances", "distances-trained", "ours")
AGAINST = ("dense-trained", "distances-trained")

#: Bits of a sparse distance that are tried; those with the best normals are kept.
SPARSE_BITS = (6, 8)

#: How much finer than its cells a field is decoded to measure its surface.
FINER = 1.5

#: Points that the network is trained on, and its training.
POOL = 2**20
HASH_SETTINGS = {"seed": 1, "schedule": "cosine", "deterministic": False, "lr": 1e-2, "batch": 2**13, "loss": "mae"}

#: Candidate that renders and rays are compared with, beside ``sdfgrid``.
MESH = "mesh (Embree)"

MEASURES = (
    Measure("IoU", "iou", ".4f"),
    Measure("IoU near", "iou_near", ".4f"),
    Measure("normals, °", "normal_deg", ".2f", False),
    Measure("normals, 95%, °", "normal_p95_deg", ".1f", False),
    Measure("distances near", "mae_near", ".1e", False),
    Measure("Chamfer", "chamfer", ".1e", False),
)


def size_text(nbytes: int) -> str:
    """Return a number of bytes as text: ``262144`` → ``"256 KiB"``."""
    return f"{nbytes / 2**20:g} MiB" if nbytes >= 2**20 else f"{nbytes / 2**10:g} KiB"


#: Settings of a run: held-out points; steps of trainings by presets (0: the preset's own), and of the shortest and the
#: longest of the network; width and height of pictures; cells of ``sdfgrid`` along the longest side, and of the finest
#: decoding whose Chamfer distance is measured; samples of a render.
FULL = {"points": 2**20, "steps": 0, "hash_steps": (500, 4000), "film": (480, 320), "grid": 256, "decoded": 768,
        "spp": 4}  # fmt: skip
QUICK = {"points": 2**14, "steps": 20, "hash_steps": (40, 80), "film": (48, 32), "grid": 32, "decoded": 96,
         "spp": 1}  # fmt: skip


class SdfStudy(Study):
    """Distance fields in equal bytes: errors against the mesh, and times of reads, rays and renders."""

    name = "sdf"
    title = "the distance field of a mesh, in equal bytes, reads, rays and renders"
    example = "mesh.ply"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default="scenes/assets/suzanne.ply", metavar="MESH",
            help="a mesh file that trimesh reads (default: scenes/assets/suzanne.ply)",
        )  # fmt: skip
        parser.add_argument(
            "--bytes", action="append", default=[], metavar="N",
            help=f"memory budget; may be repeated (default: {', '.join(SIZES)}; --quick: 64k); at the first one "
            "(default: 1M) all methods are trained, and reads, rays and renders are timed",
        )  # fmt: skip
        equal_memory.add_without_option(parser)
        parser.add_argument(
            "--ablation", action="store_true",
            help=f"compare ours with parts of it changed, in place of other methods (default: at {FIRST} alone)",
        )  # fmt: skip
        parser.add_argument(
            "--errors-of", metavar="FILE",
            help="JSON file (--json) of an earlier run; its errors are taken over, except at the budget that is timed",
        )  # fmt: skip

    def check(self, arguments) -> None:
        """Check the arguments and read the mesh; raises :class:`~mi_diffind.tasks.sdf.mesh.MeshError`."""
        every = (FIRST,) if arguments.ablation else (FIRST, *(s for s in SIZES if s != FIRST))
        default = ("64k",) if arguments.quick else every
        arguments.sizes = tuple(dict.fromkeys(map(parse_bytes, arguments.bytes or default)))
        equal_memory.check_without(arguments.without, PARTS if arguments.ablation else METHODS)
        arguments.loaded = load_mesh(arguments.source)
        arguments.before = earlier(arguments) if arguments.errors_of else {}

    def plan(self, arguments) -> Plan:
        settings = SimpleNamespace(
            sizes=arguments.sizes, without=tuple(arguments.without), ablation=arguments.ablation,
            **(QUICK if arguments.quick else FULL),
        )  # fmt: skip
        return plan(arguments.loaded, arguments.source, settings, arguments.before)


STUDY = SdfStudy()


def earlier(arguments) -> dict[str, dict]:
    """Return the records of the earlier run by name. Raises ``ValueError`` if its file does not fit the arguments."""
    path, mesh = arguments.errors_of, arguments.loaded
    try:
        result = json.loads(Path(path).read_text(encoding="utf-8"))
        digest, quick, records = result["details"]["source_digest"], result["settings"]["quick"], dict(result["jobs"])
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise ValueError(f"--errors-of: {path} is not a file that --json wrote of this study: {e!r}") from None
    if digest != mesh.digest:
        raise ValueError(f"--errors-of: {path} is of another mesh than {mesh.path}")
    if quick != arguments.quick:
        with_quick, expected = ("with", "without") if quick else ("without", "with")
        raise ValueError(f"--errors-of: {path} is of a run {with_quick} --quick, give one {expected} it")
    return records


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class DistanceStudyContext:
    """State that all contenders share: the ``mesh`` of the file ``name``, its distances and held-out points."""

    mesh: Mesh
    name: str
    settings: SimpleNamespace
    types: object
    _sparse: dict[int, tuple[rivals.DistanceNodes, float]] = field(default_factory=dict)

    @functools.cached_property
    def distances(self) -> Distances:
        return Distances(self.mesh)

    @functools.cached_property
    def evaluation(self) -> SurfaceEvaluation:
        return SurfaceEvaluation(self.mesh, self.distances, self.settings.points)

    @functools.cached_property
    def pools(self):
        """Points with distances, those that a network is trained on and those that it is measured at."""
        lower, upper = (self.mesh.lower - rivals.PADDING, self.mesh.upper + rivals.PADDING)
        counts = (POOL, 2**16) if self.settings.points >= 2**18 else (2**14, 2**10)
        return [rivals.pool(self.distances, lower, upper, n, seed) for seed, n in enumerate(counts, 1)]

    def sparse_distances(self, nbytes: int) -> tuple[rivals.DistanceNodes, float]:
        """Return exact sparse distances in ``nbytes``, of the bits with the best normals, and the seconds they took."""
        if nbytes not in self._sparse:
            start = time.perf_counter()
            make = functools.partial(rivals.distance_nodes, self.types, self.distances)
            fields = [rivals.fit_bytes(functools.partial(make, bits=bits), nbytes) for bits in SPARSE_BITS]
            seconds = time.perf_counter() - start
            self._sparse[nbytes] = min(fields, key=lambda f: self.evaluation.measure(f)["normal_deg"]), seconds
        return self._sparse[nbytes]

    def errors(self, model: DistanceField) -> dict[str, float]:
        """Return all errors of a field; ``iou_db`` and ``iou_near_db`` are the wrong shares in decibels."""
        errors = self.evaluation.measure(model)
        errors |= {f"{name}_db": -10 * math.log10(max(1 - errors[name], 1e-6)) for name in ("iou", "iou_near")}
        resolution = math.ceil(FINER / model.spacing)
        if resolution <= self.settings.decoded:
            resolution = max(resolution, self.settings.decoded // 3)
            surface = grids.extract(model, resolution, self.mesh.scale, self.mesh.centre)
            errors |= self.evaluation.chamfer(surface, max(2**10, self.settings.points // 4))
        return errors

    def record(self, model: DistanceField, nbytes: int, file_bytes: int, **entries) -> dict:
        """Return the record of a field, errors included; ``entries`` are details, and ``seconds`` if given."""
        details = {"file_bytes": file_bytes, "spacing": model.spacing, "slope": model.slope}
        details |= {"bits": model.bits} if isinstance(model, rivals.DistanceNodes) else {}
        record = {"seconds": entries.pop("seconds")} if "seconds" in entries else {}
        return {"bytes": nbytes, **record, "errors": self.errors(model), "details": details | entries}


def contender(method: str, nbytes: int, context: DistanceStudyContext) -> Contender:
    """Return the contender of a method in ``nbytes``."""
    label, size = (METHODS | PARTS)[method], size_text(nbytes)
    name, types = f"{label} {size}", context.types

    def fit_preset(job: Contender, progress: bool) -> dict | None:
        preset, options = PRESETS[method]
        steps = {"steps": context.settings.steps} if context.settings.steps else {}
        arguments = {"source": context.name, "bytes": str(nbytes), **steps, **options}
        trained = equal_memory.fit_preset(job, progress, "sdf", "field", preset, arguments)
        if trained is None:
            return None
        model, fitted = trained
        seconds = fitted.result.seconds
        return context.record(
            model.field, model.nbytes, job.file.stat().st_size, seconds=fitted.figures["prepared_seconds"] + seconds,
            steps=fitted.result.steps, trained_seconds=seconds,
        )  # fmt: skip

    def fit_nodes(job: Contender, progress: bool) -> dict:
        start, seconds, train = time.perf_counter(), 0.0, method.endswith("-trained")
        if method.startswith("dense"):
            spacing = rivals.dense_spacing(context.mesh, nbytes)
            job.model = rivals.dense(types, context.distances, spacing, train)
        else:
            job.model, seconds = context.sparse_distances(nbytes)
            start = time.perf_counter()
            if train:
                job.model = rivals.distance_nodes(types, context.distances, job.model.spacing, train, job.model.bits)
        seconds += time.perf_counter() - start
        return context.record(job.model, job.model.nbytes, rivals.save(job.file, job.model), seconds=seconds)

    if method in PRESETS:
        return Contender(name, method, nbytes, fit_preset, lambda job: equal_memory.open_preset(job, "sdf").field,
                         label, setting=size)  # fmt: skip
    return Contender(name, method, nbytes, fit_nodes, lambda job: rivals.load(job.file, types), label, setting=size)


def hash_contender(nbytes: int, context: DistanceStudyContext) -> NetworkContender:
    """Return the contender of a hash grid with a network in ``nbytes``."""
    label, size, (steps, longest) = METHODS["hash"], size_text(nbytes), context.settings.hash_steps

    def problem():
        return rivals.HashProblem(rivals.network(nbytes), context.types, context.mesh, *context.pools)

    def build(net) -> DistanceField:
        return rivals.HashDistanceField(context.types, net, context.mesh)

    def finish(net, record: dict) -> dict:
        return context.record(build(net), build(net).nbytes, build(net).nbytes, steps=record["steps"])

    settings = FitSettings(**HASH_SETTINGS, steps=steps)
    return NetworkContender(f"{label} {size}", "hash", nbytes, label, size, build, problem, settings, longest, 8, True,
                            finish)  # fmt: skip


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(mesh: Mesh, name: str, settings: SimpleNamespace, before: dict[str, dict] | None = None) -> Plan:
    """Return the plan for a ``mesh``, of the file ``name``, in the variant that is set.

    ``before``: records of an earlier run, which are taken over at all budgets but the first.
    """
    context = DistanceStudyContext(mesh, name, settings, array_module(mi.variant()))
    methods, first = PARTS if settings.ablation else METHODS, settings.sizes[0]
    jobs = {}
    for method, nbytes in equal_memory.combinations(methods, settings.sizes, FIRST_ONLY, settings.without):
        job = hash_contender(nbytes, context) if method == "hash" else contender(method, nbytes, context)
        job.timed, job.earlier = nbytes == first, (before or {}).get(job.name)
        jobs[job.name] = job
    first_jobs = {name: job for name, job in jobs.items() if job.budget == first}
    ours = next((n for n, job in first_jobs.items() if job.method == "ours"), "")
    candidates = [job.candidate(in_passes=job.method in RENDERED) for job in jobs.values()]
    cases = [
        Case("reads", lambda lanes: _reads(context, first_jobs, lanes), candidates=tuple(first_jobs),
             query_names=("value", "normal")),
    ]  # fmt: skip
    compared, drawn = [n for n, job in first_jobs.items() if job.method in AGAINST], {}
    if not settings.ablation:
        grid = f"sdfgrid {settings.grid}³"
        nbytes = 12 * (len(mesh.vertices) + len(mesh.faces))
        candidates.append(Candidate(MESH, "mesh", bytes=nbytes, is_reference=True))
        candidates.append(Candidate(grid, "sdfgrid", bytes=4 * settings.grid**3, is_reference=True))
        traced = {name: job for name, job in first_jobs.items() if job.method != "hash"}
        view = functools.cache(lambda: MeshView(mesh, settings.film))

        @functools.cache
        def references(lit: bool) -> dict[str, mi.Scene]:
            decoded = min(traced.values(), key=lambda job: job.method != "ours").model
            return {MESH: view().mesh_scene(lit), grid: view().grid_scene(decoded, settings.grid, lit)}

        def renders() -> dict:
            scenes = {n: view().field_scene(job.model, True) for n, job in traced.items() if job.method in RENDERED}
            scenes |= references(True)
            return {name: lambda k, s=s: mi.render(s, spp=settings.spp, seed=k) for name, s in scenes.items()}

        cases.append(
            Case("rays", lambda lanes: _rays(context, view(), traced, references(False), lanes), renders,
                 candidates=(*traced, MESH, grid), query_names=("ray",))
        )  # fmt: skip
        compared += [MESH, grid]
        drawn = {"shapes": lambda result: shapes(context, first_jobs, view(), result)}
    warnings = [w.removeprefix(f"{mesh.path}: ") for w in (*mesh.warnings, *context.distances.warnings)]
    code = package_files("tasks/sdf/*.py", "fitting/loop.py", "arrays/indirection.py", "studies/sdf.py",
                         "studies/baselines/distance_fields.py", "studies/baselines/networks.py")  # fmt: skip
    return Plan(
        study="sdf",
        title=f"Signed distance field: {Path(name).stem}" + ", parts of ours" * settings.ablation,
        candidates=candidates,
        cases=cases,
        queries=("value",),
        accuracy="iou_near_db",
        accuracy_label="near the surface, −10 log₁₀(1 − IoU), dB",
        ratios=[(ours, n) for n in compared] if ours else [],
        details={
            "source": name, "source_digest": mesh.digest, "triangles": len(mesh.faces), "request": vars(settings),
            "first": first, "film": list(settings.film),
        },
        notes=[
            f"{Path(name).name}, {len(mesh.faces):,} triangles. IoU near: within 0.01 of the longest side. Bytes are "
            "those of all that a read needs.",
            *(f"{w[:1].upper()}{w[1:]}." for w in warnings),
        ],
        jobs=list(jobs.values()),
        jobs_fingerprint=f"{fingerprint(code)}{mesh.digest[:16]}-{settings.steps}-{settings.hash_steps[-1]}-"
        f"{settings.points}",
        panels=("bytes",),
        pictures=drawn,
        measures=MEASURES,
    )  # fmt: skip


def _reads(context: DistanceStudyContext, jobs: dict[str, Contender], lanes: int) -> dict:
    """Return queries of values and gradients at random points near the surface."""
    points = np.ascontiguousarray(np.resize(context.evaluation.near, (lanes, 3)).T)
    p = context.types.Array3f(*(context.types.Float(np.ascontiguousarray(v)) for v in points))
    dr.make_opaque(p)
    value, normal = {FLOOR: lambda: list(p)}, {FLOOR: lambda: list(p)}
    for name, job in jobs.items():
        value[name] = lambda f=job.model: [f.value(p)]
        normal[name] = lambda f=job.model: [f.gradient(p)[1]]
    return {"value": value, "normal": normal}


def _rays(context: DistanceStudyContext, view: MeshView, jobs: dict[str, Contender], scenes: dict, lanes: int) -> dict:
    """Return queries of the distance at which rays of a camera meet each field, the mesh and the grid."""
    o, d = view.rays(context.types, lanes)
    queries = {FLOOR: lambda: [*o, *d]}
    queries |= {name: (lambda f=job.model: [traced_distance(f, o, d)]) for name, job in jobs.items()}
    queries |= {name: (lambda s=scene: [scene_distance(s, o, d)]) for name, scene in scenes.items()}
    return {"ray": queries}


# -- Views -------------------------------------------------------------------------------------------------------------


#: Direction of the camera from the origin, its distance, and its field of view in degrees, of the longer side.
DIRECTION = (0.45, 0.3, 1.0)
DISTANCE = 2.6
FOV = 32.0


#: Rays end there.
FAR = 1e3


MATERIAL = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.55, 0.5, 0.45]}}


class MeshView:
    """A camera that sees all of ``mesh``, with a ``film`` of (width, height) pixels."""

    def __init__(self, mesh: Mesh, film: tuple[int, int]):
        self.mesh, self.film = mesh, film
        away = np.array(DIRECTION) / np.linalg.norm(DIRECTION)
        self.origin = DISTANCE * away
        right = np.cross((0.0, 1.0, 0.0), away)
        right /= np.linalg.norm(right)
        self.right, self.up, self.forward = right, np.cross(away, right), -away

    def rays(self, types, count: int | None = None):
        """Return origins and directions of the rays through all pixels' centres, row by row from the top, evaluated.

        With ``count``, so many rays of a film of the same shape.
        """
        width, height = self.film
        if count is not None:
            width = max(1, round(math.sqrt(count * width / height)))
            height = -(-count // width)
        index = np.arange(count or width * height)
        scale = 2 * math.tan(math.radians(FOV) / 2) / max(self.film)
        x = ((index % width + 0.5) / width - 0.5) * self.film[0] * scale
        y = (0.5 - (index // width + 0.5) / height) * self.film[1] * scale
        d = self.forward + x[:, None] * self.right + y[:, None] * self.up
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        rays = [
            types.Array3f(*(types.Float(np.ascontiguousarray(c, np.float32)) for c in v.T))
            for v in (np.broadcast_to(self.origin, d.shape), d)
        ]
        dr.make_opaque(rays)
        return rays

    def mesh_scene(self, lit: bool = False):
        """Return a scene of the mesh, alone or ``lit`` on a floor."""
        counts = len(self.mesh.vertices), len(self.mesh.faces)
        shape = mi.Mesh(*compat.mesh_arguments(_material(), *counts))
        buffers = mi.traverse(shape)
        compat.set_triangles(buffers, self.mesh.vertices, self.mesh.faces)
        buffers.update()
        return self._scene(shape, "path", lit)

    def grid_scene(self, field: DistanceField, resolution: int, lit: bool = False):
        """Return a scene of Mitsuba's ``sdfgrid``, decoded with ``resolution`` cells along the longest side."""
        values, lower, upper = grids.grid(field, resolution)
        values, lower, upper = crop_grid(values, lower, (upper[0] - lower[0]) / (values.shape[2] - 1))
        to_world = mi.ScalarTransform4f().translate(lower.tolist()).scale((upper - lower).tolist())
        grid = mi.TensorXf(np.ascontiguousarray(values[..., None], np.float32))
        shape = mi.load_dict({"type": "sdfgrid", "grid": grid, "to_world": to_world, "normals": "smooth",
                              "bsdf": MATERIAL})  # fmt: skip
        return self._scene(shape, "path", lit)

    def field_scene(self, field: DistanceField, lit: bool = False):
        """Return a scene of the field, traced by ``path_sdf``."""
        placement = Placement()
        shape = distance_shape(mi.Mesh)(_material(), field, placement, True)
        return self._scene(shape, "path_sdf", lit)

    def _scene(self, shape, integrator: str, lit: bool):
        scene = {"type": "scene", "shape": shape}
        if lit:
            low = float(self.mesh.lower[1])
            turn = mi.ScalarTransform4f().translate([0, low, 0]).rotate([1, 0, 0], -90).scale(4.0)
            lamp = mi.ScalarTransform4f().look_at([1.5, 2.5, 1.0], [0, 0, 0], [0, 1, 0]).scale(0.6)
            target, up = (self.origin + self.forward).tolist(), self.up.tolist()
            camera = mi.ScalarTransform4f().look_at(self.origin.tolist(), target, up)
            scene |= {
                "integrator": {"type": integrator, "max_depth": 4},
                "floor": {"type": "rectangle", "to_world": turn, "bsdf": {"type": "diffuse"}},
                "sky": {"type": "constant", "radiance": 0.4},
                "lamp": {"type": "rectangle", "to_world": lamp,
                         "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 8.0}}},
                "sensor": {"type": "perspective", "fov": FOV, "fov_axis": "larger", "to_world": camera,
                           "sampler": {"type": "independent"},
                           "film": {"type": "hdrfilm", "width": self.film[0], "height": self.film[1],
                                    "rfilter": {"type": "box"}}},
            }  # fmt: skip
        return mi.load_dict(scene)


def _material() -> mi.Properties:
    props = mi.Properties("neural_sdf")
    props["bsdf"] = mi.load_dict(MATERIAL)
    return props


def traced_distance(field: DistanceField, o, d):
    """Return the length of rays until they meet a field, infinite if they miss it."""
    return marching.trace(field, o, d, FAR)[0]


def scene_distance(scene, o, d):
    """Return the length of rays until they meet a scene, which has to live until the result is evaluated."""
    return scene.ray_intersect_preliminary(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)), coherent=True).t


def shapes(context: DistanceStudyContext, jobs: dict[str, Contender], view: MeshView, result: dict):
    """Draw the errors of normals of the contenders of the first budget on the shape, where rays meet the fields."""
    truth, hit = _mesh_normals(view)
    crop, row = plot.crop_to(hit), {"mesh": _shaded(truth, hit)}
    methods = {job.method: job for job in jobs.values()}
    for job in (methods[m] for m in SHOWN if m in methods):
        error = result["candidates"][job.name]["errors"]["normal_deg"]
        row[f"{job.name}\n{error:.2f}°"] = _angles(context.types, view, job.model, truth, hit)
    row = {name: image[crop] for name, image in row.items()}
    return plot.draw_images(result["title"], figure_caption(result), {"": row}, 2.6, "error of the normal, degrees")


def _mesh_normals(view: MeshView) -> tuple[np.ndarray, np.ndarray]:
    """Return the normals of the mesh's triangles at all pixels ``(height, width, 3)``, and the mask of hits."""
    o, d = view.rays(mi)
    scene, (width, height) = view.mesh_scene(), view.film
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(o), mi.Vector3f(d)))
    hit = si.is_valid().numpy().reshape(height, width)
    return np.array(si.n).T.reshape(height, width, 3), hit


def _angles(types, view: MeshView, field, truth: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Return angles in degrees between normals; NaN where both are missed, 90 where one of them is."""
    o, d = view.rays(types)
    with dr.suspend_grad():
        t = traced_distance(field, o, d)
        field_hit = dr.isfinite(t)
        p = types.Array3f(dr.fma(d, dr.select(field_hit, t, 0), o))
        g = np.array(field.gradient(p)[1]).T.astype(np.float64)
    field_hit = field_hit.numpy()
    g /= np.maximum(np.linalg.norm(g, axis=1, keepdims=True), 1e-12)
    angles = np.degrees(np.arccos(np.clip(np.sum(g * truth.reshape(-1, 3), axis=1), -1, 1)))
    angles[field_hit != hit.ravel()] = 90
    angles[~field_hit & ~hit.ravel()] = np.nan
    return angles.reshape(hit.shape)


def _shaded(normals: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Return a picture of the mesh, lit from the upper left."""
    light = np.array([-0.4, 0.7, 0.6]) / np.linalg.norm([-0.4, 0.7, 0.6])
    grey = 0.25 + 0.65 * np.clip(normals @ light, 0, 1)
    return np.where(hit[..., None], grey[..., None] * np.array([1.0, 0.96, 0.9]), 1.0)
