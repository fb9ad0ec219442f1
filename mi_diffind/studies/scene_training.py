"""Study ``tradeoff scene-training``: training inside a scene against training for shading over the hemisphere.

*Runs*: the file that the scene names (*start*); training for shading over the hemisphere (``fit texture``) from it, for
as many seconds as training inside the scene takes (*hemisphere*), and to its end (*hemisphere, longer*); training
inside the scene (``fit scene``) from the start (*scene*; also without samples beyond one a pixel), from the result of
the hemisphere, and from an untrained start.
*Another material* is a texture of the same maps turned by 90° and inverted; training inside the scene starts from it,
too, and from what hemisphere training makes of it.

*Errors*: renders of views and lights that neither training nor its validation draws (the same ranges, another seed)
against renders of exact plugins. The noise of both renders is not counted: the errors of two halves are multiplied.
"""

from __future__ import annotations

import argparse
import gc
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.tables import Table
from ..core.files import writable_folder
from ..fitting import task
from ..images import metrics
from ..images.srgb import for_display
from ..maps.pyramid import decibel
from ..maps.source import load_source
from ..measure import plot
from ..measure.report import figure_caption
from ..measure.store import fingerprint
from ..measure.study import Measure, Plan, Study
from ..measure.training import Contender
from ..scenes import loading
from ..scenes.training.options import SceneRecipe, ViewDistribution
from ..scenes.training.problem import estimate_exposure
from ..scenes.training.references import ReferenceRenders
from ..scenes.training.trained_scene import TrainedScene, find_source, texture_file
from ..tasks.texture.compressed import load

#: Names of the runs.
AFTER = "hemisphere, then scene"
OTHER = "another material"
MENDED = f"{OTHER}, then hemisphere"

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

#: Runs in the picture, and their titles.
SHOWN = {
    "start": "before the training", "hemisphere": "trained over the hemisphere", "scene": "trained inside the scene",
    AFTER: "over the hemisphere, then inside",
}  # fmt: skip

#: Seed of the views that errors are measured on; trainings have seed 0.
SEED = 1000

#: λ of the trainings inside a scene.
SHARE = SceneRecipe().share

#: Settings of the study. A training inside a scene has ``steps`` on ``views`` views; ``held_out`` others choose its
#: state, and ``tests`` others are measured. Renders are ``width`` pixels wide and 9/16 of this high, with paths of
#: ``depth``. ``reference_spp`` and ``spp``: samples a pixel of references, and of a measured render.
#: ``hemisphere_steps``: steps of a training over the hemisphere to its end; ``texture_steps``: those of the texture of
#: another material.
FULL = {
    "steps": 60, "views": 16, "held_out": 4, "tests": 8, "width": 64, "depth": 3, "reference_spp": 512, "spp": 128,
    "hemisphere_steps": 1500, "texture_steps": 200,
}  # fmt: skip

#: Settings of a quick study, of the runs in the picture: both trainings take a few steps, not the same seconds.
QUICK = {
    "steps": 2, "views": 2, "held_out": 1, "tests": 1, "width": 64, "depth": 2, "reference_spp": 128, "spp": 32,
    "hemisphere_steps": 20, "texture_steps": 0,
}  # fmt: skip


class SceneTrainingStudy(Study):
    """Errors of renders of held-out views and lights, after trainings from the same start."""

    name = "scene-training"
    title = "textures trained inside a scene, and over the hemisphere for the same seconds"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("scenes", nargs="*", metavar="SCENE.xml",
                            help="scenes that read one compressed material, seen as training_balls is "
                            "unless it ships (default: scenes/training_*.xml; --quick: the first)")  # fmt: skip

    def check(self, arguments) -> None:
        """Check that the scenes exist."""
        shipped = [f"scenes/{name}.xml" for name in RANGES][: 1 if arguments.quick else None]
        arguments.paths = list(map(Path, arguments.scenes or shipped))
        for path in arguments.paths:
            if not path.is_file():
                raise ValueError(f"scenes: found {path}, which is no file; give SCENE.xml, or run in the repository")

    def plan(self, arguments) -> Plan:
        settings = SimpleNamespace(**(QUICK if arguments.quick else FULL))
        contexts = [SceneTrainingContext(path, settings) for path in arguments.paths]
        runs = [run for context in contexts for run in planned_runs(context)]
        size = f"{settings.width} × {settings.width * 9 // 16}"
        return Plan(
            study="scene-training",
            title="Training inside a scene",
            candidates=[run.candidate(label=run.name) for run in runs],
            cases=[],
            measures=(
                Measure("PSNR of held-out views and lights, dB", "psnr_db"),
                Measure("FLIP", "flip", ".3f", False),
            ),
            details={"scenes": [c.name for c in contexts], "request": vars(settings)},
            notes=[
                f"{settings.steps} steps, {settings.views} views of {size} pixels; "
                f"errors: {settings.tests} other views and lights against {settings.reference_spp} spp."
            ],
            jobs=runs,
            jobs_fingerprint=fingerprint(file for c in contexts for file in (c.file, *c.parsed.files())),
            pictures={"png": lambda result: picture(contexts, runs, result)},
        )


STUDY = SceneTrainingStudy()


class SceneTrainingContext:
    """A scene, its references, and the measurement of tables in it."""

    def __init__(self, path: Path, settings: SimpleNamespace):
        self.path, self.name, self.settings = path, path.stem.removeprefix("training_"), settings
        self.ranges = RANGES.get(path.stem, RANGES["training_balls"])
        self.defines = {"width": settings.width, "height": settings.width * 9 // 16, "max_depth": settings.depth}
        self.parsed = loading.ParsedScene(path, self.defines)
        self.file, given = texture_file(self.parsed)
        self.start = load(self.file)
        self.source = find_source(self.start, self.file, given)

    @staticmethod
    def references(folder: Path) -> Path:
        """Return the folder that keeps references, in the folder of models."""
        return writable_folder(folder / "references", create=True)

    def measure(self, table: Table, folder: Path) -> dict[str, float]:
        """Return ``psnr_db`` and ``flip`` of a table in renders with footprints of one sample a pixel."""
        distribution, views, references, exposure = measured_views(self, folder)
        scene = TrainedScene(self.parsed, {self.file: table}, distribution, 1)
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
        return {"psnr_db": decibel(float(np.mean(errors))), "flip": float(np.mean(flips))}


@cache
def measured_views(context: SceneTrainingContext, folder: Path) -> tuple:
    """Return the distribution of the measured views, the views, their references and the exposure.

    ``folder`` keeps references.
    """
    distribution = ViewDistribution(1, context.settings.tests, seed=SEED, **context.ranges)
    spp, views = context.settings.reference_spp, distribution.measured()
    images = ReferenceRenders(context.parsed, distribution, spp, folder, without=(context.file,)).images(views)
    return distribution, views, images, estimate_exposure(images)


def picture(contexts: Sequence[SceneTrainingContext], runs: Sequence[Contender], result: dict):
    """Draw the first measured view of each scene: after each of the :data:`SHOWN` runs, and the truth."""
    rows = {}
    for context in contexts:
        images = {}
        for run in runs:
            if run.details["context"] == context.name and run.method in SHOWN:
                distribution, views, references, exposure = measured_views(context, context.references(run.folder))
                scene = TrainedScene(context.parsed, {context.file: run.model}, distribution, 1)
                with dr.suspend_grad():
                    scene.place(views[0])
                    image = scene.render(0, 1, context.settings.spp).numpy()
                images[f"{SHOWN[run.method]}\nPSNR {run.record['errors']['psnr_db']:.1f} dB"] = image
        images[f"exact plugins\n{context.settings.reference_spp} samples a pixel"] = references[0]
        rows[context.name] = {title: for_display(exposure * image) for title, image in images.items()}
    title = "Renders from a view that no training has seen, with the PSNR of all such views"
    return plot.draw_images(title, figure_caption(result), rows)


def training_run(
    context: SceneTrainingContext,
    method: str,
    task_name: str = "",
    after: Contender | None = None,
    limit: Callable[[], dict] = dict,
    **options,
) -> Contender:
    """Return the run ``method``: a file that is measured in a scene after a training of the task, ``""`` for none.

    ``after``: the run it starts from (``None``: the file). ``limit()`` returns the steps or seconds of a training over
    the hemisphere; ``options`` are further ones of ``fit scene``.
    """
    settings = context.settings

    def train(job: Contender, progress: bool) -> task.Fitted:
        common = {"progress": progress, "output": job.file, "variant": mi.variant(), "deterministic": False}
        if task_name == "texture":
            fitted = task.fit("texture", other_maps(context.source), bytes=context.start.nbytes, shading="off",
                              steps=settings.texture_steps, **common)  # fmt: skip
            fitted.table.settings["source"] = context.start.settings["source"]
            return fitted
        if task_name == "shading":
            start = context.file if after is None else after.file
            given = {"start": start, "shading": "on", "extras": "off"}
            return task.fit("texture", context.source, **given, **limit(), **common)
        given = {} if after is None else {"start": after.file}
        ranges = {name: tuple(map(float, limits)) for name, limits in context.ranges.items()}
        return task.fit(
            "scene", context.path, defines=list(context.defines.items()), steps=settings.steps,
            measure_every=max(1, settings.steps // 8), views=settings.views, held_out=settings.held_out,
            reference_spp=settings.reference_spp, references=context.references(job.folder), spp=1, share=SHARE,
            **ranges, **given, **options, **common,
        )  # fmt: skip

    def fit(job: Contender, progress: bool) -> dict | None:
        figures = {}
        if not task_name:
            job.model = context.start
            job.file.write_bytes(Path(context.file).read_bytes())
        else:
            fitted = train(job, progress)
            if fitted.result.interrupted:
                return None
            job.model = fitted.table
            fitted.save(job.file)
            figures = {"steps": fitted.result.steps, "training_seconds": fitted.result.seconds,
                       "level_bias": job.model.settings.get("level_bias", 0.0)}  # fmt: skip
        errors = context.measure(job.model, context.references(job.folder))
        details = {
            "scene": context.name,
            "way": method,
            "lambda": SHARE if task_name == "scene" else None,
            "spp": 1,
            **figures,
            **errors,
        }
        return {"bytes": job.model.nbytes, "errors": errors, "details": details}

    name = f"{context.name}, {method}{f', λ {SHARE:g}' * (task_name == 'scene')}, 1 spp"
    return Contender(name, method, 1, fit, lambda job: load(job.file), method, details={"context": context.name})


def other_maps(source: Path) -> dict[str, np.ndarray]:
    """Return the maps of another material: those of ``source`` turned by 90°, and inverted but for normals, bytes."""
    maps = {}
    for entry in load_source(source).maps:
        values = np.rot90(entry.values)
        maps[entry.name] = np.rint(255 * (values if entry.role == "normal" else 1 - values)).astype(np.uint8)
    return maps


def planned_runs(context: SceneTrainingContext) -> list[Contender]:
    """Return the runs of a scene in their order."""
    settings, run = context.settings, partial(training_run, context)
    inside = partial(run, task_name="scene")
    end = {"limit": lambda: {"steps": settings.hemisphere_steps}}
    start, scene = run("start"), inside("scene")
    if not settings.texture_steps:
        return [start, scene, run("hemisphere", "shading", **end)]
    equal = {"limit": lambda: {"seconds": max(1.0, scene.record["details"]["training_seconds"])}}
    other = run(OTHER, "texture")
    hemisphere, mended = run("hemisphere", "shading", **equal), run(MENDED, "shading", after=other, **equal)
    return [
        start, scene, hemisphere, run("hemisphere, longer", "shading", **end),
        inside(AFTER, after=hemisphere), inside("untrained, then scene", begin="untrained"),
        inside("scene, few samples", samples=1),
        other, inside(f"{OTHER}, then scene", after=other), mended, inside(f"{MENDED}, then scene", after=mended),
    ]  # fmt: skip
