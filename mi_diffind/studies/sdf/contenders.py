"""Contenders of the study of distance fields: grids, bricks, sparse distances, presets of ``fit sdf``, a hash grid.

Each method is as fine as the memory budget allows; the search for the spacing is part of the seconds. All bytes count
that a read needs, the index included. Lengths are in units of the mesh's longest side.
"""

from __future__ import annotations

import functools
import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ...fitting.loop import FitSettings
from ...measure.study import Candidate
from ...measure.training import ConvergenceTraining
from ...tasks.sdf.distances import Distances
from ...tasks.sdf.evaluation import SurfaceEvaluation
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.grids import extract
from ...tasks.sdf.mesh import Mesh
from .. import equal_memory
from ..baselines import bricks, byte_grids, hash_grids, volumes
from .conclusions import size_text

#: Method → its label. Methods in :data:`FIRST_ONLY` are trained at the first budget only.
METHODS = {
    "dense": "dense grid", "dense-trained": "dense grid, trained", "bricks8": "8³ bricks", "bricks4": "4³ bricks",
    "bricks4-shared": "4³ bricks, shared nodes", "distances": "sparse distances",
    "distances-trained": "sparse distances, trained", "ours": "ours", "indirection": "indirection", "paper": "paper",
    "hash": "hash grid + network",
}  # fmt: skip
FIRST_ONLY = ("indirection", "paper", "hash")

#: Method → its label, for the ablation: ours, and ours with parts left out or changed.
PARTS = {
    "ours": "ours", "bits6": "6 bits a pointer", "bits8": "8 bits a pointer", "bits16": "16 bits a pointer",
    "untrained": "not trained", "direct": "16 bits a node, no indirection",
    "direct-untrained": "16 bits a node, not trained", "distances-trained": "sparse distances, trained",
    "paper": "paper", "paper-constant": "paper, from a constant",
}  # fmt: skip

#: Method → group of methods, for pictures.
FAMILIES = {
    "dense": "dense grid", "dense-trained": "dense grid", "bricks8": "bricks", "bricks4": "bricks",
    "bricks4-shared": "bricks", "distances": "sparse distances", "distances-trained": "sparse distances",
    "ours": "ours", "indirection": "supplement's arrays", "paper": "supplement's arrays", "hash": "network",
    "paper-constant": "supplement's arrays",
    **dict.fromkeys(PARTS.keys() - METHODS.keys() - {"paper-constant"}, "parts"),
}  # fmt: skip

#: Method → preset and arguments, of methods that ``fit sdf`` trains.
PRESETS = {
    "ours": ("", {}), "indirection": ("dense", {}), "paper": ("paper", {}),
    "paper-constant": ("paper", {"constant": True}),
    **{f"bits{n}": ("", {"bits": n}) for n in (6, 8, 16)}, "untrained": ("", {}),
}  # fmt: skip

#: Methods of which an image is rendered.
RENDERED = ("dense-trained", "bricks4", "bricks4-shared", "distances-trained", "ours")

#: Bits of a sparse distance that are tried; those with the best normals are kept.
SPARSE_BITS = (6, 8)

#: How much finer than its cells a field is decoded to measure its surface.
FINER = 1.5

#: Points that the network is trained on, and its training.
POOL = 2**20
HASH_SETTINGS = FitSettings(seed=1, schedule="cosine", deterministic=False, lr=1e-2, batch=2**13, loss="mae")


@dataclass(frozen=True)
class DistanceStudySettings:
    """Arguments of the study.

    ``sizes``: memory budgets in bytes, the first of which is timed; ``without``: methods that are left out;
    ``ablation``: parts of ours in place of other methods, and no rays; ``points``: held-out points; ``steps`` of
    trainings by presets (0: the preset's own); ``hash_steps`` of the network's shortest and longest training; ``film``:
    width and height of pictures; ``grid``: cells of ``sdfgrid`` along the longest side; ``decoded``: the finest
    decoding of which the Chamfer distance is measured, in cells; ``spp`` of the render.
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
class DistanceStudyContext:
    """State that all contenders share: the ``mesh`` of the file ``name``, its distances and held-out points.

    ``before`` maps names of contenders to records of an earlier run, which count at all budgets but the first.
    """

    mesh: Mesh
    name: str
    settings: DistanceStudySettings
    types: object
    before: dict[str, dict] = field(default_factory=dict)
    _sparse: dict[int, tuple[volumes.DistanceNodes, float]] = field(default_factory=dict)

    @functools.cached_property
    def distances(self) -> Distances:
        return Distances(self.mesh)

    @functools.cached_property
    def evaluation(self) -> SurfaceEvaluation:
        return SurfaceEvaluation(self.mesh, self.distances, self.settings.points)

    @functools.cached_property
    def pools(self):
        """Points with distances, those that a network is trained on and those that it is measured at."""
        lower, upper = (self.mesh.lower - hash_grids.PADDING, self.mesh.upper + hash_grids.PADDING)
        counts = (POOL, 2**16) if self.settings.points >= 2**18 else (2**14, 2**10)
        return [hash_grids.pool(self.distances, lower, upper, n, seed) for seed, n in enumerate(counts, 1)]

    def sparse_distances(self, nbytes: int) -> tuple[volumes.DistanceNodes, float]:
        """Return exact sparse distances in ``nbytes``, of the bits with the best normals, and the seconds they took."""
        if nbytes not in self._sparse:
            start = time.perf_counter()
            make = functools.partial(volumes.distance_nodes, self.types, self.distances)
            fields = [volumes.fit_bytes(functools.partial(make, bits=bits), nbytes) for bits in SPARSE_BITS]
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
            surface = extract(model, resolution, self.mesh.scale, self.mesh.centre)
            errors |= self.evaluation.chamfer(surface, max(2**10, self.settings.points // 4))
        return errors


class DistanceContender(equal_memory.Contender):
    """A distance field of one method in at most ``budget`` bytes."""

    labels, families, budget_text = METHODS | PARTS, FAMILIES, staticmethod(size_text)

    def candidate(self) -> Candidate:
        return super().candidate(in_passes=self.method in RENDERED)

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        before = self.context.before.get(self.name)
        cached = super().cached_record(folder, record or before)
        return cached if self.budget == self.context.settings.sizes[0] else cached or before

    def record(self, model: DistanceField, nbytes: int, seconds: float, file_bytes: int, **details) -> dict:
        """Keep the ``model`` and return its record, errors included."""
        self.model = model
        if nbytes > self.budget:
            raise AssertionError(f"{self.name}: takes {nbytes:,} bytes")
        details |= {"file_bytes": file_bytes, "spacing": model.spacing, "slope": model.slope}
        details |= {"bits": model.bits} if isinstance(model, volumes.DistanceNodes) else {}
        return {"bytes": nbytes, "seconds": seconds, "errors": self.context.errors(model), "details": details}


class VolumeContender(DistanceContender):
    """A dense grid, bricks or sparse distances, exact or trained by least squares."""

    def build(self) -> tuple[DistanceField, float]:
        """Return the field, and how many seconds it took."""
        start, seconds = time.perf_counter(), 0.0
        context, train, nbytes = self.context, self.method.endswith("-trained"), self.budget
        types, distances, name = context.types, context.distances, self.method.removesuffix("-trained")
        if name == "dense":
            model = byte_grids.dense(types, distances, byte_grids.dense_spacing(context.mesh, nbytes), train)
        elif name == "distances":
            model, seconds = context.sparse_distances(nbytes)
            start = time.perf_counter()
            if train:
                model = volumes.distance_nodes(types, distances, model.spacing, train, model.bits)
        else:
            side, apron = int(name.removeprefix("bricks")[0]), not name.endswith("-shared")
            model = volumes.fit_bytes(lambda h: bricks.bricks(types, distances, h, side, apron), nbytes)
        return model, seconds + time.perf_counter() - start

    def run(self, folder: Path | None, progress: bool) -> dict:
        model, seconds = self.build()
        return self.record(model, model.nbytes, seconds, volumes.save(self.file, model))

    def load(self, path: Path) -> DistanceField:
        return volumes.load(path, self.context.types)


class DistancePresetContender(equal_memory.PresetContender, DistanceContender):
    """A preset of ``fit sdf``."""

    task_name = "sdf"

    @property
    def preset(self) -> str:
        return PRESETS[self.method][0]

    def arguments(self) -> dict:
        context = self.context
        steps = {"steps": context.settings.steps} if context.settings.steps else {}
        return {"source": context.name, "bytes": str(self.budget), **steps, **PRESETS[self.method][1]}

    def fit_record(self, task_model, fitted, seconds: float) -> dict:
        seconds = fitted.result.seconds
        return self.record(
            task_model.field, task_model.nbytes, fitted.figures["prepared_seconds"] + seconds,
            self.file.stat().st_size, steps=fitted.result.steps, trained_seconds=seconds,
        )  # fmt: skip


class HashGridContender(DistanceContender):
    """A hash grid with a network in half precision, trained to convergence."""

    @functools.cached_property
    def training(self) -> ConvergenceTraining:
        context, (steps, longest) = self.context, self.context.settings.hash_steps

        def problem():
            net = hash_grids.network(self.budget)
            return hash_grids.HashProblem(net, context.types, context.mesh, *context.pools)

        settings = FitSettings(**{**asdict(HASH_SETTINGS), "steps": steps})
        return ConvergenceTraining(f"{self.name} training", problem, settings, longest, 8)

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        super().cached_record(folder, record)
        record = record or self.context.before.get(self.name)
        return record if record and self.training.cached_record(folder, record) else None

    def load(self, path: Path) -> DistanceField:
        hash_grids.halved(self.training.net)
        return hash_grids.HashDistanceField(self.context.types, self.training.net, self.context.mesh)

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        training_record = self.training.run(folder, progress)
        if training_record is None:
            return None
        model = self.load(None)
        record = self.record(
            model, model.nbytes, training_record["seconds"], model.nbytes, steps=training_record["steps"]
        )
        return {**training_record, **record, "name": self.name}
