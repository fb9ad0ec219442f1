"""Study ``tradeoff scene-training``: training inside a scene against training for shading over the hemisphere.

*Runs*: the file that the scene names (*start*); training inside the scene (``fit scene``) from it (*scene*); training
for shading over the hemisphere (``fit texture``) from it, for as many seconds (*hemisphere*); and training inside the
scene from the result of the hemisphere.

*Errors*: renders of views and lights that neither training nor its validation draws (the same ranges, another seed)
against renders of exact plugins, with the footprints of one and of four samples a pixel. The noise of both renders is
not counted (:func:`.product_error`). All trainings inside a scene have the exposure of the measurement.
"""

import argparse
import dataclasses
import gc
import re
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.tables import Table
from ..fitting import task
from ..images import metrics
from ..images.srgb import for_display
from ..maps.pyramid import decibel
from ..measure import plot
from ..measure.report import figure_caption
from ..measure.store import fingerprint
from ..measure.study import Measure, Plan, Study
from ..measure.training import Contender
from ..scenes import loading
from ..scenes.training.options import FOOTPRINTS, ViewDistribution
from ..scenes.training.problem import estimate_exposure, product_error
from ..scenes.training.references import ReferenceRenders
from ..scenes.training.rig import small_ranges
from ..scenes.training.trained_scene import TrainedScene, find_source, texture_file
from ..tasks.texture.compressed import load

#: Name of the run that trains twice.
AFTER = "hemisphere, then scene"

#: Ranges of camera and lights of the scenes that ship, by the name of the file. Others have small ranges of their own.
RANGES = {
    name: dict(zip(("azimuth", "elevation", "light_azimuth", "light_elevation"), ranges, strict=False))
    for name, *ranges in (
        ("training_balls", (-40, 40), (15, 50), (-90, 90), (20, 70)),
        ("training_floor", (-40, 40), (12, 45), (-90, 90)),
        ("training_corner", (-25, 25), (12, 35), (-35, 35), (30, 70)),
    )
}

#: Titles of the runs in the picture.
SHOWN = {
    "start": "before the training", "hemisphere": "trained over the hemisphere", "scene": "trained inside the scene",
    AFTER: "over the hemisphere, then inside",
}  # fmt: skip

#: Seed of the views that errors are measured on; trainings have seed 0.
SEED = 1000

#: Settings of the study. A training inside a scene has ``steps`` on ``views`` views; ``held_out`` others choose its
#: state, and ``tests`` others are measured. Renders are ``width`` pixels wide and 9/16 of this high, with paths of
#: ``depth``, where the scene has a <default> for that. ``reference_spp`` and ``spp``: samples a pixel of references,
#: and of a measured render. ``hemisphere_steps``: steps of a training over the hemisphere; 0: equal seconds.
FULL = {
    "steps": 200, "views": 16, "held_out": 16, "tests": 32, "width": 64, "depth": 3, "reference_spp": 512, "spp": 256,
    "hemisphere_steps": 0,
}  # fmt: skip

#: Settings of a quick study, without a second training.
QUICK = {
    "steps": 3, "views": 2, "held_out": 1, "tests": 2, "width": 64, "depth": 2, "reference_spp": 64, "spp": 64,
    "hemisphere_steps": 10,
}  # fmt: skip


class SceneTrainingStudy(Study):
    """Errors of renders of held-out views and lights, after trainings from the same start."""

    name = "scene-training"
    title = "textures trained inside a scene, and over the hemisphere for the same seconds"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("scenes", nargs="*", metavar="SCENE.xml",
                            help="scenes that read one compressed material, such as your own, which is seen from close "
                            "to its camera (default: scenes/training_*.xml; --quick: the first)")  # fmt: skip

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
        return Plan(
            study="scene-training",
            title="Training inside a scene",
            candidates=[run.candidate(label=run.name) for run in runs],
            cases=[],
            measures=(
                Measure("PSNR of held-out views and lights, footprints of 1 sample, dB", "psnr_db"),
                Measure("of 4 samples, dB", "psnr_4_spp_db"),
                Measure("FLIP", "flip", ".3f", False),
            ),
            details={"scenes": [c.name for c in contexts], "request": vars(settings)},
            notes=[f"{settings.steps} steps, {settings.views} views; errors: {settings.tests} other views and lights."],
            jobs=runs,
            jobs_fingerprint=fingerprint(file for c in contexts for file in (c.file, *c.parsed.files())),
            pictures={"png": lambda result: picture(contexts, runs, result)},
        )


STUDY = SceneTrainingStudy()


class SceneTrainingContext:
    """A scene, its references, and the measurement of tables in it."""

    def __init__(self, path: Path, settings: SimpleNamespace):
        self.path, self.name, self.settings = path, path.stem.removeprefix("training_"), settings
        sizes = {"width": settings.width, "height": settings.width * 9 // 16, "max_depth": settings.depth}
        defaults = re.findall(r'<default\s+name="(\w+)"', path.read_text(encoding="utf-8"))
        self.defines = {name: value for name, value in sizes.items() if name in defaults}
        self.parsed = loading.ParsedScene(path, self.defines)
        self.file, given = texture_file(self.parsed)
        self.start = load(self.file)
        self.source = find_source(self.start, self.file, given)
        self.views = ViewDistribution(settings.views, settings.tests, seed=SEED, **RANGES.get(path.stem, {}))
        if not self.views.moves:
            self.views = small_ranges(self.parsed.load(parallel=False), self.views)

    @cached_property
    def references(self) -> list[np.ndarray]:
        """Both halves of the references of the measured views."""
        spp = self.settings.reference_spp
        renders = ReferenceRenders(self.parsed, self.views, spp, without=(self.file,))
        return renders.halves([(view, spp) for view in self.views.measured()])

    @cached_property
    def exposure(self) -> float:
        """Factor of all radiance that maps white to 1, in measurements and in trainings inside the scene."""
        return estimate_exposure([halves.mean(axis=0) for halves in self.references])

    def training_options(self) -> dict:
        """Return the options of ``fit scene``: the ranges and the exposure of the measurement."""
        settings, ranges = self.settings, dataclasses.asdict(self.views)
        ranges = {k: v for k, v in ranges.items() if v is not None and k not in ("count", "held_out", "seed")}
        return {
            **ranges, "views": settings.views, "held_out": settings.held_out, "steps": settings.steps,
            "measure_every": max(1, settings.steps // 8), "reference_spp": settings.reference_spp,
            "defines": list(self.defines.items()), "exposure": self.exposure,
        }  # fmt: skip

    def measure(self, table: Table) -> dict[str, float]:
        """Return the errors of a table, and the number of the ``view`` with the median one."""
        scene = TrainedScene(self.parsed, {self.file: table}, self.views)
        errors, flips = {spp: [] for spp in FOOTPRINTS}, []
        for i, reference in enumerate(self.references):
            truth = self.exposure * reference
            for spp in FOOTPRINTS:
                halves = self.render(scene, i, spp)
                errors[spp].append(product_error(halves, truth))
                if spp == FOOTPRINTS[0]:
                    flips.append(metrics.flip(*(np.clip(np.mean(image, axis=0), 0, 1) for image in (truth, halves))))
        gc.collect()
        one, four = errors.values()
        figures = {
            "psnr_db": decibel(float(np.mean(one))),
            "psnr_4_spp_db": decibel(float(np.mean(four))),
            "flip": float(np.mean(flips)),
        }
        return {**figures, "view": int(np.argsort(one)[len(one) // 2])}

    def render(self, scene: TrainedScene, number: int, spp: int) -> list[np.ndarray]:
        """Return both halves of a render of a measured view with the footprints of ``spp`` samples a pixel."""
        with dr.suspend_grad():
            scene.place(self.views.measured()[number], spp)
            seeds = (dr.opaque(mi.UInt32, 2 * number + half) for half in range(2))
            halves = [scene.render(seed, seed + 2**30, self.settings.spp // 2).numpy() for seed in seeds]
        return [self.exposure * np.nan_to_num(half) for half in halves]


def picture(contexts: Sequence[SceneTrainingContext], runs: Sequence[Contender], result: dict):
    """Draw the measured view of each scene that has the median error at the start: after each run, and the truth."""
    rows = {}
    for context in contexts:
        images, trained = {}, [run for run in runs if run.details["context"] == context.name]
        number = trained[0].record["details"]["view"]
        for run in trained:
            scene = TrainedScene(context.parsed, {context.file: run.model}, context.views)
            title = f"{SHOWN[run.method]}\nPSNR {run.record['errors']['psnr_db']:.1f} dB"
            images[title] = np.mean(context.render(scene, number, FOOTPRINTS[0]), axis=0)
        images["exact plugins"] = context.exposure * context.references[number].mean(axis=0)
        rows[context.name] = {title: for_display(image) for title, image in images.items()}
    title = "Renders from views that no training has seen, with the PSNR of all such views"
    return plot.draw_images(title, figure_caption(result), rows)


def training_run(context: SceneTrainingContext, method: str, train: Callable[..., task.Fitted] | None) -> Contender:
    """Return the run ``method``: the file of ``train(…)``, by default the scene's own, is measured in the scene."""

    def fit(job: Contender, progress: bool) -> dict | None:
        details = {"scene": context.name, "way": method, "lambda": None, "spp": 1}
        if train is None:
            job.model = context.start
            job.file.write_bytes(Path(context.file).read_bytes())
        else:
            fitted = train(progress=progress, output=job.file, variant=mi.variant(), deterministic=False)
            result, settings = fitted.result, fitted.table.settings
            if result.interrupted:
                return None
            job.model = fitted.table
            fitted.save(job.file)
            details |= {"steps": result.steps, "training_seconds": result.seconds, "printed": result.measured}
            details |= {"level_bias": settings.get("level_bias", 0.0), "kept_start": "kept_start" in settings}
        errors = context.measure(job.model)
        details |= errors
        return {"bytes": job.model.nbytes, "errors": {k: errors[k] for k in errors if k != "view"}, "details": details}

    name = f"{context.name}, {method}"
    return Contender(name, method, 1, fit, lambda job: load(job.file), method, details={"context": context.name})


def planned_runs(context: SceneTrainingContext) -> list[Contender]:
    """Return the runs of a scene in their order; a training over the hemisphere has the seconds of that inside."""

    def inside(start=context.file, **options):
        return task.fit("scene", context.path, start=start, **context.training_options(), **options)

    def over_hemisphere(**options):
        steps = context.settings.hemisphere_steps
        limit = {"steps": steps} if steps else {"seconds": max(1.0, scene.record["details"]["training_seconds"])}
        return task.fit("texture", context.source, start=context.file, shading="on", **limit, **options)

    start, scene = training_run(context, "start", None), training_run(context, "scene", inside)
    hemisphere = training_run(context, "hemisphere", over_hemisphere)
    after = training_run(context, AFTER, lambda **options: inside(hemisphere.file, **options))
    return [start, scene, hemisphere] + ([] if context.settings.hemisphere_steps else [after])
