"""Plan of the study of distance fields: methods in equal memory, their errors, and times of reads and rays.

*Dense grids* of 8 bits hold exact distances, or trained nodes. *Bricks* of 4³ and 8³ cells with 8 bits lie where the
surface passes; each has its own borders, or they share nodes as OpenVDB's leaves do. *Sparse distances* are our layout
without normals and without indirection: 6 or 8 bits, whichever is better, at each node of a cell that the surface
crosses, exact or trained. *Ours* is the default preset of ``fit sdf``, *indirection* and *paper* are the others
(:mod:`mi_diffind.tasks.sdf`). *Hash grid + network* is that of ``drjit.nn``, in half precision. Nodes of grids are
trained by least squares, the exact minimum; the network until twice as many steps gain little.

The ablation compares ours with parts of it left out or changed (:mod:`.parts`).

Errors are those of :class:`~mi_diffind.tasks.sdf.evaluation.SurfaceEvaluation`; lengths are relative to the
longest side.
Times: reads at random points within 0.01 of the surface; primary rays, beside Embree on the mesh and Mitsuba's
``sdfgrid``; a whole render.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.runtime import array_module
from ...measure.store import fingerprint
from ...measure.study import FLOOR, Candidate, Case, Plan
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.mesh import Mesh
from .. import equal_memory
from . import parts, pictures
from .conclusions import conclusions, table
from .contenders import (
    FIRST_ONLY,
    METHODS,
    PARTS,
    PRESETS,
    RENDERED,
    DistanceContender,
    DistancePresetContender,
    DistanceStudyContext,
    DistanceStudySettings,
    HashGridContender,
    VolumeContender,
)
from .view import MeshView, scene_distance, traced_distance

#: Methods that the times of ours are divided by.
AGAINST = ("dense-trained", "bricks4", "distances-trained", "direct")

#: Modules of the task that only trace and decode fields: models of an earlier run stay valid if they change.
TRACING_MODULES = ("marching", "tracing", "grids", "extraction")

#: Candidates that renders and rays are compared with.
MESH, GRID = "mesh (Embree)", "sdfgrid"

Contenders = dict[str, DistanceContender]


def contender(method: str, nbytes: int, context: DistanceStudyContext) -> DistanceContender:
    """Return the contender of a method in ``nbytes``."""
    trained = DistancePresetContender if method in PRESETS else VolumeContender
    return {"hash": HashGridContender, **parts.CONTENDERS}.get(method, trained)(method, nbytes, context)


def plan(mesh: Mesh, name: str, settings: DistanceStudySettings, before: dict[str, dict] | None = None) -> Plan:
    """Return the plan for a ``mesh``, of the file ``name``, in the variant that is set.

    ``before``: records of an earlier run, which are taken over at all budgets but the first.
    """
    context = DistanceStudyContext(mesh, name, settings, array_module(mi.variant()), {} if before is None else before)
    methods, first = PARTS if settings.ablation else METHODS, settings.sizes[0]
    pairs = equal_memory.combinations(methods, settings.sizes, FIRST_ONLY, settings.without)
    jobs = {job.name: job for job in (contender(method, nbytes, context) for method, nbytes in pairs)}
    first_jobs = {name: job for name, job in jobs.items() if job.budget == first}
    ours = next((n for n, job in first_jobs.items() if job.method == "ours"), "")
    candidates = [job.candidate() for job in jobs.values()]
    cases = [
        Case("reads", lambda lanes: _reads(context, first_jobs, lanes), candidates=tuple(first_jobs),
             query_names=("value", "normal")),
    ]  # fmt: skip
    compared, drawn = [n for n, job in first_jobs.items() if job.method in AGAINST], {}
    if not settings.ablation:
        grid = f"{GRID} {settings.grid}³"
        reference = {"is_reference": True, "in_passes": True}
        candidates.append(Candidate(MESH, "mesh", bytes=12 * (len(mesh.vertices) + len(mesh.faces)), **reference))
        candidates.append(Candidate(grid, "sdfgrid", bytes=4 * settings.grid**3, **reference))
        traced = {name: job for name, job in first_jobs.items() if job.method != "hash"}
        view = functools.cache(lambda: MeshView(mesh, settings.film))
        scenes = functools.cache(lambda lit: _reference_scenes(context, view(), traced, grid, lit))
        cases.append(
            Case("rays", lambda lanes: _rays(context, view(), traced, scenes(False), lanes),
                 lambda: _renders(context, view(), traced, scenes(True)), candidates=(*traced, MESH, grid),
                 query_names=("ray",))
        )  # fmt: skip
        compared += [MESH, grid]
        drawn = {"shapes": lambda result: pictures.shapes(context, first_jobs, view(), result)}
    warnings = [w.removeprefix(f"{mesh.path}: ") for w in (*mesh.warnings, *context.distances.warnings)]
    models_fingerprint = f"{fingerprint(_model_sources())}{mesh.digest[:16]}"
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
            "source": name, "source_digest": mesh.digest, "triangles": len(mesh.faces), "request": asdict(settings),
            "first": first, "film": list(settings.film),
        },
        notes=[
            f"{Path(name).name}, {len(mesh.faces):,} triangles. IoU near: within 0.01 of the longest side. Bytes are "
            "those of all that a read needs.",
            *(f"{w[:1].upper()}{w[1:]}." for w in warnings),
        ],
        jobs=list(jobs.values()),
        jobs_fingerprint=f"{models_fingerprint}-{settings.steps}-{settings.hash_steps[-1]}-{settings.points}",
        pictures=drawn,
        table=table,
        conclusions=conclusions,
    )  # fmt: skip


def _model_sources() -> list[Path]:
    """Return the files that trained models depend on."""
    package = Path(__file__).resolve().parents[2]
    studies = package / "studies"
    return [
        *(path for path in (package / "tasks" / "sdf").glob("*.py") if path.stem not in TRACING_MODULES),
        *(package / f"{name}.py" for name in ("fitting/loop", "arrays/indirection")),
        *(studies / "sdf" / f"{name}.py" for name in ("contenders", "parts")),
        *(studies / "baselines" / f"{name}.py"
          for name in ("byte_grids", "bricks", "volumes", "direct_nodes", "hash_grids", "networks")),
    ]  # fmt: skip


def _reads(context: DistanceStudyContext, jobs: Contenders, lanes: int) -> dict:
    """Return queries of values and gradients at random points near the surface."""
    points = np.ascontiguousarray(np.resize(context.evaluation.near, (lanes, 3)).T)
    p = context.types.Array3f(*(context.types.Float(np.ascontiguousarray(v)) for v in points))
    dr.make_opaque(p)
    value, normal = {FLOOR: lambda: list(p)}, {FLOOR: lambda: list(p)}
    for name, job in jobs.items():
        value[name] = lambda f=job.model: [f.value(p)]
        normal[name] = lambda f=job.model: [f.gradient(p)[1]]
    return {"value": value, "normal": normal}


def _rays(context: DistanceStudyContext, view: MeshView, jobs: Contenders, scenes: dict, lanes: int) -> dict:
    """Return queries of the distance at which rays of a camera meet each field, the mesh and the grid."""
    o, d = view.rays(context.types, lanes)
    queries: dict[str, Callable] = {FLOOR: lambda: [*o, *d]}
    queries |= {name: (lambda f=job.model: [traced_distance(f, o, d)]) for name, job in jobs.items()}
    queries |= {name: (lambda s=scene: [scene_distance(s, o, d)]) for name, scene in scenes.items()}
    return {"ray": queries}


def _renders(context: DistanceStudyContext, view: MeshView, jobs: Contenders, scenes: dict) -> dict:
    """Return passes of whole renders."""
    rendered = {name: job for name, job in jobs.items() if job.method in RENDERED}
    scenes = {name: view.field_scene(job.model, True) for name, job in rendered.items()} | scenes
    spp = context.settings.spp
    return {name: lambda k, s=scene: mi.render(s, spp=spp, seed=k) for name, scene in scenes.items()}


def _reference_scenes(
    context: DistanceStudyContext, view: MeshView, jobs: Contenders, grid: str, lit: bool
) -> dict[str, mi.Scene]:
    """Return scenes of the mesh and of ``sdfgrid``, decoded from ours if possible."""
    decoded: DistanceField = min(jobs.values(), key=lambda job: job.method != "ours").model
    return {MESH: view.mesh_scene(lit), grid: view.grid_scene(decoded, context.settings.grid, lit)}
