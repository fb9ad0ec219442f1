"""
What the study of distance fields compares, all in the same bytes of memory: everything that a read needs counts, the
index, too.

*Dense grids* of 8 bits hold exact distances, or nodes that were trained. *Bricks* of 4³ and 8³ cells with 8 bits lie
where the surface passes; either each has its own borders, or they share nodes as OpenVDB's leaves do. *Sparse
distances* are what is left of ours without normals and without indirection: 6 or 8 bits, whichever is better, at each
node of a cell that the surface crosses, exact or trained. *Ours* is the default preset, *indirection* and *paper* are
the others (:mod:`mi_diffind.tasks.sdf`). *Hash grid + network* is that of ``drjit.nn``, in half precision. Nodes of
grids are trained by least squares, so that there is nothing left to gain; the network until twice as many steps gain
little. Each kind is as fine as the bytes allow; to find that out is part of the seconds.

Or else, what the *parts* of ours are worth, each left out or changed in turn: :mod:`.parts`.

Errors are those of :class:`~mi_diffind.tasks.sdf.evaluation.Evaluation`; all lengths are in units of the longest side.
Times: reads at random points within 0.01 of the surface; primary rays, beside Embree on the mesh itself and Mitsuba's
``sdfgrid``; a whole render.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...fitting import FitSettings
from ...measure.store import fingerprint
from ...measure.study import FLOOR, Candidate, Case, Plan
from ...measure.training import ConvergenceTraining
from ...runtime import array_module
from ...tasks.sdf import decode
from ...tasks.sdf.distances import Distances
from ...tasks.sdf.evaluation import Evaluation
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.mesh import Mesh
from .. import equal_memory
from ..baselines import hash_grids, volumes
from . import pictures
from . import view as views
from .conclusions import conclusions, size_text, table

#: Kind → its label. Those of :data:`ONCE` are made of the first size only.
KINDS = {
    "dense": "dense grid",
    "dense-trained": "dense grid, trained",
    "bricks8": "8³ bricks",
    "bricks4": "4³ bricks",
    "bricks4-shared": "4³ bricks, shared nodes",
    "distances": "sparse distances",
    "distances-trained": "sparse distances, trained",
    "ours": "ours",
    "indirection": "indirection",
    "paper": "paper",
    "hash": "hash grid + network",
}
ONCE = ("indirection", "paper", "hash")

#: The same of ours and its parts.
PARTS = {
    "ours": "ours",
    "bits6": "6 bits a pointer",
    "bits8": "8 bits a pointer",
    "bits16": "16 bits a pointer",
    "at-once": "pointers all at the end",
    "untrained": "not trained",
    "direct": "16 bits a node, no indirection",
    "direct-untrained": "16 bits a node, not trained",
    "distances-trained": "sparse distances, trained",
    "paper": "paper",
    "paper-constant": "paper, from a constant",
}
LABELS = KINDS | PARTS

#: Kind → what it is a kind of, for pictures.
FAMILIES = {
    "dense": "dense grid", "dense-trained": "dense grid", "bricks8": "bricks", "bricks4": "bricks",
    "bricks4-shared": "bricks", "distances": "sparse distances", "distances-trained": "sparse distances",
    "ours": "ours", "indirection": "supplement's arrays", "paper": "supplement's arrays", "hash": "network",
    "paper-constant": "supplement's arrays", **dict.fromkeys(PARTS.keys() - KINDS.keys() - {"paper-constant"}, "parts"),
}  # fmt: skip

#: Kinds that the times of ours are divided by.
AGAINST = ("dense-trained", "bricks4", "distances-trained", "direct")

#: Kind → preset and arguments, of those that ``fit sdf`` makes.
PRESETS = {
    "ours": ("", {}), "indirection": ("dense", {}), "paper": ("paper", {}),
    "paper-constant": ("paper", {"constant": True}),
    **{f"bits{n}": ("", {"bits": n}) for n in (6, 8, 16)}, "at-once": ("", {}), "untrained": ("", {}),
}  # fmt: skip

#: Modules of the task that fields, once made, do not depend on.
RAYS = ("index", "marching", "tracing", "decode")

#: What renders and rays are compared with.
MESH, GRID = "mesh (Embree)", "sdfgrid"

#: Bits of a sparse distance that are tried; those with the best normals are kept.
SPARSE_BITS = (6, 8)

#: Kinds of which an image is rendered.
RENDERED = ("dense-trained", "bricks4", "bricks4-shared", "distances-trained", "ours")

#: How much finer than its cells a field is decoded to measure its surface.
FINER = 1.5

#: How much of the mesh is sampled to train the network, and how it is trained.
POOL = 2**20
HASH_SETTINGS = FitSettings(seed=1, schedule="cosine", deterministic=False, lr=1e-2, batch=2**13, loss="mae")


@dataclass(frozen=True)
class Request:
    """
    ``sizes`` in bytes, the first of which is shown most; kinds left out (``without``); ``ablation``: parts of ours in
    place of other kinds, no rays; held-out ``points``; ``steps`` of trainings by presets (0: the preset's own);
    ``hash_steps`` of the network's first and longest training; ``film``, width and height of pictures; ``grid``, cells
    of ``sdfgrid`` along the longest side; ``decoded``, the most of the surface that the Chamfer distance is measured
    of; ``spp`` of the render.
    """

    sizes: tuple[int, ...]
    without: tuple[str, ...] = ()
    ablation: bool = False
    points: int = 2**20
    steps: int = 0
    hash_steps: tuple[int, int] = (500, 4000)
    film: tuple[int, int] = (480, 320)
    grid: int = 256
    decoded: int = 768
    spp: int = 4


@dataclass
class Setting:
    """
    What all candidates share: the ``mesh``, of the file ``name``, its distances, held-out points and the view.
    ``before`` has records of an earlier run, name → record, which count for what is not timed.
    """

    mesh: Mesh
    name: str
    request: Request
    types: object
    before: dict[str, dict] = field(default_factory=dict)
    jobs: dict[str, DistanceContender] = field(default_factory=dict)
    _sparse: dict[int, tuple[volumes.DistanceNodes, float]] = field(default_factory=dict)

    @functools.cached_property
    def distances(self) -> Distances:
        return Distances(self.mesh)

    @functools.cached_property
    def evaluation(self) -> Evaluation:
        return Evaluation(self.mesh, self.distances, self.request.points)

    @functools.cached_property
    def pools(self):
        """The points that a network is trained on, and those that it is measured at."""
        lower, upper = (self.mesh.lower - hash_grids.PADDING, self.mesh.upper + hash_grids.PADDING)
        counts = (POOL, 2**16) if self.request.points >= 2**18 else (2**14, 2**10)
        return [hash_grids.pool(self.distances, lower, upper, n, seed) for seed, n in enumerate(counts, 1)]

    def sparse_distances(self, nbytes: int) -> tuple[volumes.DistanceNodes, float]:
        """Exact distances in so many bytes, with the number of bits whose normals are best; and the seconds it took."""
        if nbytes not in self._sparse:
            start = time.perf_counter()
            found = [
                volumes.fitted(lambda h, b=bits: volumes.distance_nodes(self.types, self.distances, h, bits=b), nbytes)
                for bits in SPARSE_BITS
            ]
            seconds = time.perf_counter() - start
            self._sparse[nbytes] = min(found, key=lambda f: self.evaluation.measure(f)["normal_deg"]), seconds
        return self._sparse[nbytes]

    def errors(self, found: DistanceField) -> dict[str, float]:
        """All errors of a field, with ``iou_db`` and ``iou_near_db``, the shares that are wrong in decibels."""
        errors = self.evaluation.measure(found)
        errors |= {f"{name}_db": -10 * math.log10(max(1 - errors[name], 1e-6)) for name in ("iou", "iou_near")}
        finer = math.ceil(FINER / found.spacing)
        if finer <= self.request.decoded:
            surface = decode.extract(found, max(finer, self.request.decoded // 3), self.mesh.scale, self.mesh.centre)
            errors |= self.evaluation.chamfer(surface, max(2**10, self.request.points // 4))
        return errors


def plan(mesh: Mesh, name: str, request: Request, before: dict[str, dict] | None = None) -> Plan:
    """
    What is measured of ``mesh``, of the file ``name``, in the variant that is set. ``before``: the records of an
    earlier run, which are taken over but for the first size.
    """
    setting = Setting(mesh, name, request, array_module(mi.variant()), before or {})
    first, jobs = request.sizes[0], setting.jobs
    for kind, size in equal_memory.combinations(
        PARTS if request.ablation else KINDS, request.sizes, ONCE, request.without
    ):
        made = DistanceContender.of(kind, size, setting)
        jobs[made.name] = made
    shown = [name for name, job in jobs.items() if job.budget == first]
    ours = next((n for n in shown if jobs[n].method == "ours"), "")
    candidates = [job.candidate() for job in jobs.values()]
    cases = [
        Case("reads", lambda lanes: _reads(setting, shown, lanes), candidates=tuple(shown),
             query_names=("value", "normal")),
    ]  # fmt: skip
    compared, drawn = [n for n in shown if jobs[n].method in AGAINST], {}
    if not request.ablation:
        grid = f"{GRID} {request.grid}³"
        reference = {"is_reference": True, "in_passes": True}
        candidates.append(Candidate(MESH, "mesh", bytes=12 * (len(mesh.vertices) + len(mesh.faces)), **reference))
        candidates.append(Candidate(grid, "sdfgrid", bytes=4 * request.grid**3, **reference))
        traced = [name for name in shown if jobs[name].method != "hash"]
        stage_of = functools.cache(lambda: views.Stage(mesh, request.film))
        cases.append(
            Case("rays", lambda lanes: _rays(setting, stage_of(), traced, grid, lanes),
                 lambda: _renders(setting, stage_of(), traced, grid), candidates=(*traced, MESH, grid),
                 query_names=("ray",))
        )  # fmt: skip
        compared += [MESH, grid]
        drawn = pictures.of(setting, stage_of)
    package = Path(__file__).resolve().parents[2]
    made_by = [p for p in (package / "tasks" / "sdf").glob("*.py") if p.stem not in RAYS]
    made_by += [package / "fitting.py", package / "indirection.py", package / "studies" / "sdf" / "parts.py"]
    baselines = ("volumes", "direct_nodes", "hash_grids", "networks")
    made_by += [package / "studies" / "baselines" / f"{n}.py" for n in baselines]
    return Plan(
        study="sdf",
        title=f"Signed distance field: {Path(name).stem}" + ", parts of ours" * request.ablation,
        variant=mi.variant(),
        candidates=candidates,
        cases=cases,
        queries=("value",),
        accuracy="iou_near_db",
        accuracy_label="near the surface, −10 log₁₀(1 − IoU), dB",
        ratios=[(ours, n) for n in compared] if ours else [],
        details={
            "source": name, "source_digest": mesh.digest, "triangles": len(mesh.faces), "request": asdict(request),
            "first": first, "film": list(request.film),
        },
        notes=[
            f"{Path(name).name}, {len(mesh.faces):,} triangles. IoU near: within 0.01 of the longest side. Bytes are "
            "those of all that a read needs.",
            *(_sentence(said, mesh) for said in (*mesh.warnings, *setting.distances.warnings)),
        ],
        jobs=list(jobs.values()),
        jobs_fingerprint=f"{fingerprint(made_by)}{mesh.digest[:16]}-{request.steps}-{request.hash_steps[-1]}-{request.points}",
        pictures=drawn,
        table=table,
        conclusions=conclusions,
    )  # fmt: skip


def _sentence(said: str, mesh: Mesh) -> str:
    """A warning about ``mesh`` without its path."""
    said = said.removeprefix(f"{mesh.path}: ")
    return f"{said[:1].upper()}{said[1:]}."


# -- jobs -------------------------------------------------------------------------------------------------------------


class DistanceContender(equal_memory.Contender):
    """A field of a kind in at most so many bytes."""

    labels, families, budget_text = LABELS, FAMILIES, staticmethod(size_text)

    @staticmethod
    def of(kind: str, nbytes: int, setting: Setting) -> DistanceContender:
        from . import parts

        own = Fitted if kind in PRESETS else Hashed if kind == "hash" else Sampled
        return parts.MADE.get(kind, own)(kind, nbytes, setting)

    def candidate(self) -> Candidate:
        return super().candidate(in_passes=self.method in RENDERED)

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        before = self.context.before.get(self.name)
        found = super().cached_record(folder, record or before)
        return found if self.budget == self.context.request.sizes[0] else found or before

    def record(self, found: DistanceField, nbytes: int, seconds: float, file_bytes: int, **details) -> dict:
        self.model = found
        if nbytes > self.budget:
            raise AssertionError(f"{self.name}: takes {nbytes:,} bytes")
        details |= {"file_bytes": file_bytes, "spacing": found.spacing, "slope": found.slope}
        details |= {"bits": found.bits} if isinstance(found, volumes.DistanceNodes) else {}
        return {"bytes": nbytes, "seconds": seconds, "errors": self.context.errors(found), "details": details}


class Sampled(DistanceContender):
    """A grid, bricks or sparse distances."""

    def make(self) -> tuple[DistanceField, float]:
        """The field, and how many seconds it took."""
        start, before = time.perf_counter(), 0.0
        setting, train = self.context, volumes.Training() if self.method.endswith("-trained") else None
        types, distances, mesh, nbytes = setting.types, setting.distances, setting.mesh, self.budget
        name = self.method.removesuffix("-trained")
        if name == "dense":
            found = volumes.dense(types, distances, volumes.dense_size(mesh, nbytes), train)
        elif name == "distances":
            found, before = setting.sparse_distances(nbytes)
            start = time.perf_counter()
            if train is not None:
                found = volumes.distance_nodes(types, distances, found.spacing, train, bits=found.bits)
        else:
            side, apron = int(name.removeprefix("bricks")[0]), not name.endswith("-shared")
            found = volumes.fitted(lambda h: volumes.bricks(types, distances, h, side, apron), nbytes)
        return found, before + time.perf_counter() - start

    def run(self, folder: Path | None, progress: bool) -> dict:
        found, seconds = self.make()
        if self.file:
            volumes.save(self.file, found)
        return self.record(found, found.nbytes, seconds, volumes.file_bytes(found))

    def load(self, path: Path) -> DistanceField:
        return volumes.load(path, self.context.types)


class Fitted(equal_memory.PresetContender, DistanceContender):
    """By a preset of ``fit sdf``."""

    task_name = "sdf"

    @property
    def preset(self) -> str:
        return PRESETS[self.method][0]

    def arguments(self) -> dict:
        setting = self.context
        given = {"steps": setting.request.steps} if setting.request.steps else {}
        return {"source": setting.name, "bytes": str(self.budget), **given, **PRESETS[self.method][1]}

    def fit_record(self, task_model, fitted, seconds: float) -> dict:
        trained = fitted.result.seconds
        return self.record(
            task_model.field, task_model.nbytes, fitted.figures["prepared_seconds"] + trained, self.file.stat().st_size,
            steps=fitted.result.steps, trained_seconds=trained,
        )  # fmt: skip


class Hashed(DistanceContender):
    """A hash grid with a network, trained to convergence."""

    @functools.cached_property
    def training(self) -> ConvergenceTraining:
        setting, (steps, longest) = self.context, self.context.request.hash_steps

        def problem():
            net = hash_grids.network(self.budget)
            return hash_grids.HashProblem(net, setting.types, setting.mesh, *setting.pools)

        settings = FitSettings(**{**asdict(HASH_SETTINGS), "steps": steps})
        return ConvergenceTraining(f"{self.name} training", problem, settings, longest, 8)

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        super().cached_record(folder, record)
        record = record or self.context.before.get(self.name)
        return record if record and self.training.cached_record(folder, record) else None

    def load(self, path: Path) -> DistanceField:
        hash_grids.halved(self.training.net)
        return hash_grids.HashField(self.context.types, self.training.net, self.context.mesh)

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        record = self.training.run(folder, progress)
        if record is None:
            return None
        found = self.load(None)
        own = self.record(found, found.nbytes, record["seconds"], found.nbytes, steps=record["steps"])
        return {**record, **own, "name": self.name}


# -- time -------------------------------------------------------------------------------------------------------------


def _reads(setting: Setting, names: list[str], lanes: int) -> dict:
    """Values and gradients at random points near the surface."""
    points = setting.evaluation.near
    points = np.ascontiguousarray(np.resize(points, (lanes, 3)).T)
    p = setting.types.Array3f(*(setting.types.Float(np.ascontiguousarray(v)) for v in points))
    dr.make_opaque(p)
    value, normal = {FLOOR: lambda: list(p)}, {FLOOR: lambda: list(p)}
    for name in names:
        own = setting.jobs[name].model
        value[name] = lambda f=own: [f.value(p)]
        normal[name] = lambda f=own: [f.gradient(p)[1]]
    return {"value": value, "normal": normal}


def _rays(setting: Setting, view: views.Stage, names: list[str], grid: str, lanes: int) -> dict:
    """The distance at which the rays of a camera meet each of the fields, and the mesh."""
    o, d = view.rays(setting.types, lanes)
    found: dict[str, Callable] = {FLOOR: lambda: [*o, *d]}
    for name in names:
        found[name] = lambda f=setting.jobs[name].model: [views.traced(f, o, d)]
    for name, scene in ((MESH, view.mesh_scene()), (grid, view.grid_scene(_grid_field(setting), setting.request.grid))):
        found[name] = lambda s=scene: [views.met(s, o, d)]
    return {"ray": found}


def _renders(setting: Setting, view: views.Stage, names: list[str], grid: str) -> dict:
    jobs = setting.jobs
    scenes = {name: view.field_scene(jobs[name].model, True) for name in names if jobs[name].method in RENDERED}
    scenes[MESH] = view.mesh_scene(True)
    scenes[grid] = view.grid_scene(_grid_field(setting), setting.request.grid, True)
    spp = setting.request.spp
    return {name: lambda k, s=scene: mi.render(s, spp=spp, seed=k) for name, scene in scenes.items()}


def _grid_field(setting: Setting) -> DistanceField:
    """What ``sdfgrid`` is decoded from: ours of the first size, or else another one."""
    shown = (job for job in setting.jobs.values() if job.method != "hash" and job.budget == setting.request.sizes[0])
    return min(shown, key=lambda job: job.method != "ours").model
