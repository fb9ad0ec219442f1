"""Plan of the study of training inside a scene: the runs of each scene, and their errors in it.

*Runs*: the file that the scene names (*start*); training for shading over the hemisphere (``fit shading``) from it, for
as many seconds as the largest λ at one sample a pixel takes inside the scene (*hemisphere*), and to its end
(*hemisphere, longer*); training inside the scene (``fit scene``) from the start (*scene*; also with other λ, other
samples a pixel, and without samples beyond these), from the result of the hemisphere, and from an untrained start.
*Another material* is a texture of the same maps turned by 90° and inverted; training inside the scene starts from it,
too, and from what hemisphere training makes of it.

*Errors*: renders of views and lights that neither training nor its validation draws (the same ranges, another seed)
against renders of exact plugins. The noise of both renders is not counted: the errors of two halves are multiplied.
"""

from __future__ import annotations

import dataclasses
import gc
import json
import math
import resource
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays.tables import Table
from ...core.files import writable_folder, write_json
from ...fitting import task
from ...images import metrics
from ...images.srgb import for_display
from ...maps.source import load_source
from ...measure import plot
from ...measure.formatting import figure_caption
from ...measure.study import Candidate, Plan
from ...scenes import loading
from ...scenes.training.options import SceneRecipe, View, ViewDistribution
from ...scenes.training.problem import exposure_of
from ...scenes.training.references import ReferenceRenders
from ...scenes.training.trained_scene import TrainedScene, original_of, texture_file
from ...tasks.texture.compressed import load
from ..equal_memory import Contender, StudyContext
from .conclusions import AFTER, FEW, LONGER, MENDED, OTHER, conclusions, table

#: Ranges of camera and lights of the scenes that ship, by the name of the file.
RANGES = {
    "training_balls": {
        "azimuth": (-40, 40), "elevation": (15, 50), "light_azimuth": (-90, 90), "light_elevation": (20, 70),
    },
    "training_floor": {"azimuth": (-40, 40), "elevation": (12, 45), "light_azimuth": (-90, 90)},
    "training_corner": {
        "azimuth": (-25, 25), "elevation": (12, 35), "light_azimuth": (-35, 35), "light_elevation": (30, 70),
    },
}  # fmt: skip

#: Runs in the picture.
SHOWN = ("start", "hemisphere", "scene", AFTER)

#: Seed of the views that errors are measured on; trainings have seed 0.
SEED = 1000


@dataclass(frozen=True)
class SceneTrainingSettings:
    """Settings of the study.

    ``lambdas``: weights of the loss of renders. ``counts``: samples a pixel of trainings. ``steps`` of a training
    inside a scene, on ``views`` views, of which ``held_out`` others choose the state; ``tests`` views are measured.
    Renders are ``width`` pixels wide and 9/16 of this high, with paths of ``depth``. ``reference_spp`` and ``spp``:
    samples a pixel of references, and of a measured render. ``hemisphere_steps``: steps of a training over the
    hemisphere to its end; ``texture_steps``: those of the texture of another material.
    """

    lambdas: tuple[float, ...] = (0.5, 0.9, 1.0)
    counts: tuple[int, ...] = (1, 4)
    steps: int = 400
    views: int = 16
    held_out: int = 4
    tests: int = 8
    width: int = 96
    depth: int = 3
    reference_spp: int = 512
    spp: int = 128
    hemisphere_steps: int = 1500
    texture_steps: int = 200

    @classmethod
    def quick(cls) -> SceneTrainingSettings:
        """Return the settings of a smoke run."""
        small = {"views": 2, "held_out": 1, "tests": 1, "width": 16, "depth": 2, "reference_spp": 8, "spp": 8}
        return cls((0.9,), (1,), steps=2, hemisphere_steps=2, texture_steps=2, **small)

    def changed(self, **values) -> SceneTrainingSettings:
        """Return a copy with other values."""
        return dataclasses.replace(self, **values)

    @property
    def defines(self) -> dict[str, int]:
        """Values of a scene's ``<default>`` parameters."""
        return {"width": self.width, "height": self.width * 9 // 16, "max_depth": self.depth}


def scenes_of(paths: Sequence[str], quick: bool) -> list[Path]:
    """Return the scene files, by default those that ship. Raises ``ValueError`` if one does not exist."""
    chosen = list(map(Path, paths or [f"scenes/{name}.xml" for name in [*RANGES][: 1 if quick else None]]))
    for path in chosen:
        if not path.is_file():
            raise ValueError(f"scenes: found {path}, which is no file; give SCENE.xml, or run in the repository")
    return chosen


class SceneTrainingContext(StudyContext):
    """A scene, its references, and the measurement of tables in it."""

    def __init__(self, path: Path, settings: SceneTrainingSettings):
        self.path, self.name, self.settings = path, path.stem.removeprefix("training_"), settings
        self.ranges = RANGES.get(path.stem, RANGES["training_balls"])
        self.parsed = loading.ParsedScene(path, settings.defines)
        self.file, given = texture_file(self.parsed)
        self.start = load(self.file)
        self.source = original_of(self.start, self.file, given)
        #: Folder that keeps references.
        self.references: Path | None = None

    @cached_property
    def tests(self) -> tuple[ViewDistribution, list[View], list[np.ndarray], float]:
        """The distribution of the measured views, the views, their references, and the exposure."""
        views = ViewDistribution(1, self.settings.tests, seed=SEED, **self.ranges)
        renders = ReferenceRenders(
            self.parsed, views, self.settings.reference_spp, self.references, without=(self.file,)
        )
        images = renders.images(views.measured())
        return views, views.measured(), images, exposure_of(images)

    def measure(self, table: Table, spp: int) -> dict[str, float]:
        """Return ``psnr_db`` and ``flip`` of a table in renders with footprints of ``spp`` samples a pixel."""
        distribution, views, references, exposure = self.tests
        scene = TrainedScene(self.parsed, {self.file: table}, distribution, spp)
        errors, flips = [], []
        with dr.suspend_grad():
            for i, (view, reference) in enumerate(zip(views, references, strict=True)):
                scene.place(view)
                seeds = (dr.opaque(mi.UInt32, 2 * i + half) for half in range(2))
                halves = [
                    exposure * np.nan_to_num(scene.render(s, s + 2**30, self.settings.spp // 2).numpy()) for s in seeds
                ]
                truth = np.clip(exposure * reference, 0, 1)
                a, b = (np.clip(half, 0, 1) - truth for half in halves)
                errors.append(float(np.mean(a * b, dtype=np.float64)))
                flips.append(metrics.flip(truth, np.clip(sum(halves) / 2, 0, 1)))
        gc.collect()
        return {"psnr_db": -10 * math.log10(max(np.mean(errors), 1e-12)), "flip": float(np.mean(flips))}


def picture(contexts: Sequence[SceneTrainingContext], runs: Sequence[TrainingInScene], result: dict):
    """Draw the first measured view of each scene: after each of the :data:`SHOWN` runs, and the truth."""
    first = {}
    for run in runs:
        first.setdefault((run.context.name, run.method), run)
    runs = [run for run in first.values() if run.method in SHOWN]
    columns = max(len([r for r in runs if r.context is c]) for c in contexts) + 1
    figure = plot.figure(result["title"], figure_caption(result), 2.3 * columns, 1.7 * len(contexts))
    for row, context in enumerate(contexts):
        distribution, views, references, exposure = context.tests
        images = {}
        for run in (r for r in runs if r.context is context):
            share = "" if run.share is None else f", λ {run.share:g}"
            scene = TrainedScene(context.parsed, {context.file: run.model}, distribution, int(run.budget))
            with dr.suspend_grad():
                scene.place(views[0])
                image = scene.render(0, 1, context.settings.spp).numpy()
            images[f"{run.method}{share}\n{run.record['details']['psnr_db']:.1f} dB"] = image
        for column, (text, image) in enumerate({**images, "truth": references[0]}.items()):
            axes = figure.add_subplot(len(contexts), columns, row * columns + column + 1)
            plot.image_panel(axes, for_display(exposure * image), text, "" if column else context.name)
    return figure


@dataclass
class TrainingInScene(Contender):
    """A file that is measured in a scene, after a training: ``method`` is the name of the way.

    ``budget``: samples a pixel. ``task``: that of the training, ``""`` for none. ``share``: λ of a training inside the
    scene. ``begin``: its start, ``file`` or ``untrained``. ``after``: the run whose result it starts from (``None``:
    the scene's file); ``as_long``: the run that gives its seconds (``None``: it has steps).

    The record is kept beside the file of the result, so that further runs of the same scene can follow.
    """

    task: str = ""
    share: float | None = None
    begin: str = "file"
    samples: int = SceneRecipe.samples
    after: TrainingInScene | None = None
    as_long: TrainingInScene | None = None
    record: dict | None = None

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        if folder is not None:
            self.context.references = writable_folder(folder / "references", create=True)
        record = super().cached_record(folder, record)
        if record is None and self.file is not None and self.file.is_file() and self._kept.is_file():
            record = json.loads(self._kept.read_text(encoding="utf-8"))
        self.record = record
        return record

    @property
    def _kept(self) -> Path:
        return self.file.with_suffix(".json")

    def load(self, path: Path) -> Table:
        return load(path)

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        context, start, processor = self.context, time.perf_counter(), time.process_time()
        figures = {}
        if not self.task:
            self.model = context.start
        else:
            fitted = self.fit(context, progress)
            if fitted.result.interrupted:
                return None
            self.model, result = fitted.table, fitted.result
            figures = {"steps": result.steps, "kept_step": result.step, "training_seconds": result.seconds,
                       "processor_seconds": time.process_time() - processor,
                       "step_ms": 1000 * result.seconds / max(1, result.steps), "history": result.history,
                       "level_bias": self.model.settings.get("level_bias", 0.0),
                       "kept_start": self.model.settings.get("kept_start", False),
                       "validation_db": result.measured.get("psnr_db")}  # fmt: skip
            if self.file is not None:
                fitted.save(self.file)
        if self.file is not None and not self.task:
            self.file.write_bytes(Path(context.file).read_bytes())
        seconds = time.perf_counter() - start
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        details = {"scene": context.name, "way": self.method, "lambda": self.share, "spp": int(self.budget),
                   "peak_mib": peak, **figures, **context.measure(self.model, int(self.budget))}  # fmt: skip
        self.record = {"bytes": self.model.nbytes, "seconds": seconds, "details": details}
        if self.file is not None:
            write_json(self._kept, self.record)
        return self.record

    def fit(self, context: SceneTrainingContext, progress: bool) -> task.Fitted:
        """Train, as a texture, over the hemisphere or inside the scene."""
        settings = context.settings
        common = {"progress": progress, "output": self.file, "variant": mi.variant(), "deterministic": False}
        if self.task == "texture":
            fitted = task.fit("texture", other_maps(context.source), bytes=context.start.nbytes,
                              steps=settings.texture_steps, **common)  # fmt: skip
            fitted.table.settings["source"] = context.start.settings["source"]
            return fitted
        start = context.file if self.after is None else self.after.file
        if self.task == "shading":
            limit = {"steps": settings.hemisphere_steps}
            if self.as_long is not None:
                limit = {"seconds": max(1.0, self.as_long.record["details"]["training_seconds"])}
            return task.fit("shading", context.source, start=start, **limit, **common)
        given = {} if self.after is None else {"start": start}
        ranges = {name: tuple(map(float, limits)) for name, limits in context.ranges.items()}
        return task.fit(
            "scene", context.path, defines=list(settings.defines.items()), steps=settings.steps,
            measure_every=max(1, settings.steps // 8), views=settings.views, held_out=settings.held_out,
            reference_spp=settings.reference_spp, references=context.references, spp=int(self.budget),
            begin=self.begin, share=self.share, samples=self.samples, **ranges, **given, **common,
        )  # fmt: skip


def other_maps(source: Path) -> dict[str, np.ndarray]:
    """Return the maps of another material: those of ``source`` turned by 90°, and inverted but for normals, bytes."""
    maps = {}
    for entry in load_source(source).maps:
        values = np.rot90(entry.values)
        maps[entry.name] = np.rint(255 * (values if entry.role == "normal" else 1 - values)).astype(np.uint8)
    return maps


def planned_runs(context: SceneTrainingContext, without: Sequence[str]) -> list[TrainingInScene]:
    """Return the runs of a scene in their order, ``without`` those of these names and those that start from them."""
    settings, default = context.settings, SceneRecipe().share
    share = default if default in settings.lambdas else settings.lambdas[-1]

    def run(method: str, task: str = "", spp: int = settings.counts[0], **fields) -> TrainingInScene:
        text = f", λ {fields['share']:g}" if "share" in fields else ""
        return TrainingInScene(method, spp, context, f"{context.name}, {method}{text}, {spp} spp", task=task, **fields)

    def inside(method: str, after: TrainingInScene | None = None, **fields) -> TrainingInScene:
        return run(method, "scene", **{"share": share, "after": after, **fields})

    scene, other = inside("scene"), run(OTHER, "texture")
    hemisphere = run("hemisphere", "shading", as_long=scene)
    mended = run(MENDED, "shading", after=other, as_long=scene)
    runs = [
        *(run("start", spp=spp) for spp in settings.counts), scene, hemisphere, run(LONGER, "shading"),
        inside(AFTER, hemisphere), inside("untrained, then scene", begin="untrained"), inside(FEW, samples=1),
        other, inside(f"{OTHER}, then scene", other), mended, inside(f"{MENDED}, then scene", mended),
        *(inside("scene", share=s) for s in settings.lambdas if s != share),
        *(inside("scene", spp=spp) for spp in settings.counts[1:]),
    ]  # fmt: skip

    def wanted(run: TrainingInScene) -> bool:
        return run.method not in without and all(wanted(r) for r in (run.after, run.as_long) if r is not None)

    return [run for run in runs if wanted(run)]


def plan(paths: Sequence[Path], settings: SceneTrainingSettings, without: Sequence[str] = ()) -> Plan:
    """Return the plan for scene files in the current variant, ``without`` the runs of these names."""
    contexts = [SceneTrainingContext(path, settings) for path in paths]
    runs = [run for context in contexts for run in planned_runs(context, without)]

    def candidate(run: TrainingInScene) -> Candidate:
        def errors(samples: int) -> dict[str, float]:
            return {key: run.record["details"][key] for key in ("psnr_db", "flip")}

        return Candidate(run.name, run.method, f"{run.budget} spp", job=run.name, errors=errors)

    request = json.loads(json.dumps(asdict(settings)))
    shared = {name: value for name, value in request.items() if name not in ("lambdas", "counts")}
    files = {c.name: c.parsed.description for c in contexts}
    return Plan(
        study="scene-training",
        title="Training inside a scene",
        candidates=[candidate(run) for run in runs],
        cases=[],
        queries=(),
        accuracy="psnr_db",
        accuracy_label="PSNR of held-out views and lights, dB",
        details={"scenes": [c.name for c in contexts], "request": request},
        notes=[
            f"{settings.steps} steps, {settings.views} views of {settings.width} × {settings.width * 9 // 16} pixels; "
            f"errors: {settings.tests} other views and lights against {settings.reference_spp} spp"
        ],
        jobs=runs,
        jobs_fingerprint=f"{files} {shared}",
        pictures={"png": lambda result: picture(contexts, runs, result)},
        sampled=False,
        table=table,
        conclusions=conclusions,
    )
