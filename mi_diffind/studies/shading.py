"""Study ``tradeoff shading``: textures trained for their shading at several weights λ of the shading loss.

For each material and seed, a texture is trained as task 4 trains it, and then by task 5 at several weights λ of the
shading loss; λ = 0 continues task 4 (the paper's figure 2).

Classical filters of normals (:mod:`.baselines.normals`) are measured uncompressed; those that an ordinary texture can
hold, Toksvig's roughness too, also by ASTC in equal bytes. LEAN's moments have no limits, which encoders of bytes need.
Each is also read at other levels of detail, those with the smallest error: the *kernel*.

*Errors* are those of :class:`~mi_diffind.tasks.texture.appearance.ShadedEvaluation`: PSNR of shaded values and FLIP,
under views and lights of no training, against C, the converged truth, and P, the paper's reference.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np

from ..arrays.tables import Table, save_table
from ..core.arguments import fraction, positive
from ..core.runtime import array_module
from ..fitting import task
from ..fitting.loop import FitResult
from ..images import srgb
from ..maps.pyramid import Pyramid, decibel
from ..maps.source import Source, SourceError, load_source
from ..measure import plot
from ..measure.report import figure_caption
from ..measure.study import Measure, Plan, Study
from ..measure.training import Contender
from ..tasks import texture as texture_task
from ..tasks.texture.appearance import TRUTHS, ShadedEvaluation, ShadedReader, reader
from ..tasks.texture.compressed import CompressedTexture
from ..tasks.texture.shading import fit_shading, trainable_arrays
from ..tasks.texture.surface import frozen_decoder, material_effects
from ..tasks.texture.training import source_layout
from .baselines import codecs, normals
from .example_maps import MATERIALS, example_maps
from .materials import level_images, level_pyramid

#: Weights λ of the shading loss; 0 is always among them.
LAMBDAS = (0.1, 0.5, 0.9, 1.0)

#: Compression ratio of all trainings.
COMPRESSION = 12.0

#: Name of the trainings in records: derivatives through the specular lobe are clipped, the learning rate falls.
WAY = "clip, schedule"


class ShadingStudy(Study):
    """Quality of shaded images against the weight of the shading loss, beside classical filters."""

    name = "shading"
    title = "textures trained for their shading, by the weight of that, and classical filters of normals"
    example = "material.json"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "materials", nargs="*", default=[], metavar="MATERIAL.json|NAME",
            help="manifests of maps, or names of generated materials: hammered, weave, lacquer (default: these; "
            "--quick: hammered)",
        )  # fmt: skip
        parser.add_argument("--lambda", action="append", type=fraction, dest="lambdas", metavar="X",
                            help="weight of the shading loss; may be repeated; 0 is always among them (default: "
                            "0, 0.1, 0.5, 0.9, 1; --quick: 0, 0.9)")  # fmt: skip
        parser.add_argument("--seeds", type=positive, default=1, metavar="N",
                            help="number of seeds of each training (default: 1)")  # fmt: skip
        parser.add_argument("--steps", type=positive, metavar="N",
                            help="steps of training for shading (default: 600; --quick: 20)")  # fmt: skip

    def check(self, arguments) -> None:
        """Load the materials; raise as :func:`.load_source` does."""
        names = arguments.materials or (["hammered"] if arguments.quick else list(MATERIALS))
        arguments.loaded = load_materials(names, 64 if arguments.quick else 256)

    def plan(self, arguments) -> Plan:
        quick = arguments.quick
        settings = SimpleNamespace(
            lambdas=sorted({0.0, *(arguments.lambdas or ((0.9,) if quick else LAMBDAS))}),
            seeds=arguments.seeds,
            steps=arguments.steps or (20 if quick else 600),
            texture_steps=20 if quick else 300,
            quick=quick,
        )
        contexts = {name: ShadingContenders(name, source, settings) for name, source in arguments.loaded.items()}
        jobs = [job for context in contexts.values() for job in context.jobs.values()]
        sizes = ", ".join(f"{name} ({s.width} × {s.height})" for name, s in arguments.loaded.items())
        details = {"sources": {name: s.digest for name, s in arguments.loaded.items()}, "request": vars(settings)}
        return Plan(
            study="shading",
            title="Textures trained for their shading",
            candidates=[job.candidate() for job in jobs],
            cases=[],
            details=details,
            notes=[
                *codecs.install_notes(["astc"]),
                f"{sizes}; {COMPRESSION:g}x, {settings.texture_steps} steps of training as a texture, "
                f"then {settings.steps} steps for shading; C: converged truth, P: the paper's reference; kernel: read "
                "at the levels of detail with the smallest error.",
            ],
            jobs=jobs,
            jobs_fingerprint=str(details),
            pictures={
                "png": partial(draw_lambdas, contexts),
                "levels": partial(draw_levels, contexts),
                "strip": partial(draw_crops, contexts),
            },
            measures=(Measure("C", "c_mean_db"), Measure("P", "p_mean_db"), Measure("FLIP", "c_flip", ".4f", False)),
        )


STUDY = ShadingStudy()


def load_materials(names: Sequence[str], side: int) -> dict[str, Source]:
    """Return the sources of manifests and of generated materials, by name. Raises ``SourceError``, ``ValueError``."""
    sources = {}
    for text in names:
        name = Path(text).stem
        if name in sources:
            raise ValueError(f'materials: found "{name}" twice')
        if text not in MATERIALS and not text.endswith(".json"):
            raise SourceError(f'materials: found "{text}", allowed are manifests (.json) and {", ".join(MATERIALS)}')
        sources[name] = load_source(example_maps(text, side) if text in MATERIALS else text)
    return sources


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class ShadingContenders:
    """Contenders of a material, by label; the model of each is a reader of shaded values.

    Methods are ``classical`` (uncompressed filters), ``compressed`` (filters in the bytes of the trainings), ``start``
    (a texture trained as task 4 trains it) and ``run`` (its training for shading). ``runs`` has the runs of all seeds
    by λ.
    """

    name: str
    source: Source
    settings: SimpleNamespace
    jobs: dict[str, Contender] = field(default_factory=dict)
    runs: dict[float, list[Contender]] = field(default_factory=dict)

    def __post_init__(self):
        layout = source_layout(self.source, texture_task.PRESETS["ours"])
        self.pyramid = Pyramid.from_source(self.source, layout, array_module(mi.variant()))
        self.effects = material_effects(layout)[0]
        self.add_filters()
        for seed in range(self.settings.seeds):
            start = self.add_start(seed)
            for share in self.settings.lambdas:
                self.runs.setdefault(share, []).append(self.add_run(start, share, seed))
        self.add_kernels()

    @cached_property
    def evaluation(self) -> ShadedEvaluation:
        return ShadedEvaluation(self.pyramid, self.effects, *((3, 2, 16) if self.settings.quick else ()))

    def add(self, label: str, method: str, fit: Callable, read: Callable, has_file: bool = False) -> Contender:
        """Register a contender."""
        job = Contender(f"{self.name}, {label}", method, 0, fit, read, label, has_file=has_file)
        self.jobs[label] = job
        return job

    def record(self, job: Contender, nbytes: int, **details) -> dict:
        """Measure the model of a job; return its record."""
        measured = self.evaluation.measure(job.model)
        errors = {f"{letter.lower()}_mean_db": figures["mean_db"] for letter, figures in measured.items()}
        if measured["C"]["flip"]:  # that of small images is not measured
            errors["c_flip"] = float(np.mean(measured["C"]["flip"]))
        details |= {"material": self.name, "kind": job.method, "label": job.label, **measured}
        return {"bytes": nbytes, "errors": errors, "details": details}

    # -- Classical filters

    def add_filter(self, label: str, method: str, build: Callable[[], tuple[ShadedReader, int]]) -> None:
        """Register a filter that nothing is trained for; ``build()`` returns its reader and its bytes."""
        once = cache(build)
        self.add(label, method, lambda job, progress: self.record(job, once()[1]), lambda job: once()[0])

    def add_filters(self) -> None:
        """Register classical filters: uncompressed, and by ASTC in the bytes of the trainings."""
        pyramid, effects = self.pyramid, self.effects
        moments = 6 * sum(v[..., 0].size for v in pyramid.values)
        pairs = 4 if self.settings.quick else normals.PAIRS
        pyramids = {
            "filtered": lambda: pyramid,
            "Toksvig": cache(lambda: normals.with_roughness(pyramid, normals.toksvig_levels(pyramid))),
            "baked": cache(lambda: normals.with_roughness(pyramid, normals.bake(pyramid, effects, pairs))),
        }
        self.add_filter("LEAN", "classical", lambda: (normals.lean(pyramid, effects), pyramid.nbytes + moments))
        for name, make in pyramids.items():
            self.add_filter(name, "classical", lambda make=make: (reader(make(), effects), make().nbytes))
            if "astc" in codecs.available():
                self.add_filter(f"{name}, ASTC", "compressed", partial(self.encoded, make))

    def encoded(self, pyramid: Callable[[], Pyramid]) -> tuple[ShadedReader, int]:
        """Return the reader of a pyramid that ASTC stores in the bytes of the trainings, and its bytes."""
        names = [m.name for m in pyramid().layout.maps if m.role == "normal"]
        coded, nbytes = codecs.astc_levels(level_images(pyramid()), self.source.nbytes / COMPRESSION, "thorough", names)
        return reader(level_pyramid({name: e.levels for name, e in coded.items()}, pyramid()), self.effects), nbytes

    def add_kernels(self) -> None:
        """Register each filter, and λ = 0 as that of parameters, at the levels of detail with the smallest error."""

        def build(job: Contender) -> tuple[ShadedReader, int]:
            biases = normals.choose_biases(job.model, self.evaluation.another())
            return normals.biased(job.model, biases), job.record["bytes"]

        jobs = {job.label: job for job in self.jobs.values() if job.method in ("classical", "compressed")}
        jobs["filtered, compressed"] = self.runs[0.0][0]
        for label, job in jobs.items():
            name, *storage = label.split(", ")
            label = ", ".join([*([] if name == "filtered" else [name]), "kernel", *storage])
            self.add_filter(label, "classical" if job.method == "classical" else "compressed", partial(build, job))

    # -- Trainings

    def add_trained(
        self, label: str, method: str, train: Callable[[Contender, bool], tuple[Table, FitResult]], **details
    ) -> Contender:
        """Register a texture that ``train(job, progress)`` trains; its table stays in the folder of models."""
        types = self.pyramid.types

        def fit(job: Contender, progress: bool) -> dict | None:
            table, result = train(job, progress)
            if result.interrupted:
                return None
            save_table(job.file, table)
            return self.record(job, table.nbytes, level_bias=table.settings.get("level_bias", 0.0), **details)

        def read(job: Contender) -> ShadedReader:
            texture = CompressedTexture.from_table(texture_task.TASK.load(job.file), types.TensorXf)
            return reader(texture, self.effects, frozen_decoder(types))

        return self.add(label, method, fit, read, True)

    def add_start(self, seed: int) -> Contender:
        """Register a texture that task 4 trains."""

        def train(job: Contender, progress: bool) -> tuple[Table, FitResult]:
            fitted = task.fit("texture", self.source, compression=COMPRESSION, shading="off",
                              steps=self.settings.texture_steps, seed=seed,
                              variant=mi.variant(), progress=progress, output=job.file)  # fmt: skip
            return fitted.table, fitted.result

        return self.add_trained(f"texture, seed {seed}", "start", train)

    def add_run(self, start: Contender, share: float, seed: int) -> Contender:
        """Register a training for shading with weight ``share``.

        λ = 0 is read at the level of the footprint; for other λ, the training chooses the level bias.
        """

        def train(job: Contender, progress: bool) -> tuple[Table, FitResult]:
            given = {"steps": self.settings.steps, "seed": seed, "share": share, "level_bias": None if share else 0.0}
            recipe = texture_task.TASK.change_settings(texture_task.SHADING_PRESETS["ours"], given)
            request = task.FitRequest("ours", recipe, self.pyramid.types, progress=progress)
            arrays = trainable_arrays(texture_task.TASK.load(start.file), self.pyramid)
            return fit_shading(self.source, arrays, recipe, request, self.pyramid, self.evaluation)

        return self.add_trained(f"lambda {share:g}, {WAY}, seed {seed}", "run", train, share=share, way=WAY)

    # -- Results

    def shown_filters(self) -> dict[str, Contender]:
        """Return the filters in pictures: filtered parameters, the best uncompressed, and the best in equal bytes."""
        shown = {"parameters filtered": self.jobs["filtered"]}
        for text, method in (("uncompressed", "classical"), ("equal bytes", "compressed")):
            jobs = [job for job in self.jobs.values() if job.method == method]
            best = max(jobs, key=lambda job: job.record["errors"]["c_mean_db"])
            shown[f"{best.label.removesuffix(', compressed')}, {text}"] = best
        return shown

    def shown_runs(self) -> dict[str, Contender]:
        """Return the trainings in pictures, of the first seed: with the smallest and with the largest λ."""
        return {f"trained, λ {share:g}": self.runs[share][0] for share in (min(self.runs), max(self.runs))}


# -- Pictures ----------------------------------------------------------------------------------------------------------

#: Level of detail of the crops.
CROP_LEVEL = 3

#: Largest side of the crops, in texels.
CROP_SIDE = 48


def draw_lambdas(contexts: dict[str, ShadingContenders], result: dict):
    """Draw PSNR over λ, with bars over seeds, beside the best classical filters."""
    settings = next(iter(contexts.values())).settings

    def trained(context: ShadingContenders, letter: str) -> list[plot.Curve]:
        seeds = [[job.record["details"][letter]["mean_db"] for job in jobs] for jobs in context.runs.values()]
        ends = [[end(values) for values in seeds] for end in (np.mean, min, max)]
        return [plot.Curve("trained", range(len(seeds)), *ends)]

    ticks = [f"{share:g}" for share in settings.lambdas]
    filtered = lambda figures: [figures["mean_db"]] * len(ticks)  # noqa: E731
    return _draw(contexts, result, "λ, weight of the shading loss", ticks, trained, filtered)


def draw_levels(contexts: dict[str, ShadingContenders], result: dict):
    """Draw PSNR by level of detail of λ = 0, the largest λ and the best classical filters."""

    def trained(context: ShadingContenders, letter: str) -> list[plot.Curve]:
        shown = {text: job.record["details"][letter]["psnr_db"] for text, job in context.shown_runs().items()}
        return [plot.Curve(text, range(len(psnr)), psnr) for text, psnr in shown.items()]

    ticks = [str(level) for level in range(max(context.evaluation.levels for context in contexts.values()))]
    return _draw(contexts, result, "level of detail", ticks, trained, lambda figures: figures["psnr_db"])


def _draw(contexts: dict, result: dict, x_label: str, ticks: Sequence[str], trained: Callable, filtered: Callable):
    """Return a figure with a row for each material and a column for each truth.

    ``trained(context, letter)`` returns the curves of trainings, ``filtered(figures)`` the values of a filter.
    """
    panels = {}
    for name, context in contexts.items():
        for letter, truth in TRUTHS.items():
            curves = panels[f"{name}, against the {truth} reference ({letter})"] = trained(context, letter)
            for (text, job), line in zip(context.shown_filters().items(), (":", "--", "-."), strict=True):
                values, style = filtered(job.record["details"][letter]), {"color": "0.3", "marker": ""}
                curves.append(plot.Curve(text, range(len(values)), values, style={**style, "linestyle": line}))
    title, label = f"{result['title']}: quality by {x_label.split(',')[0]}", "PSNR of shaded values, dB"
    return plot.draw_curves(title, figure_caption(result), panels, x_label, label, ticks=ticks)


def draw_crops(contexts: dict[str, ShadingContenders], result: dict):
    """Draw crops of a minified level, by each of the contenders shown and of the truth."""
    rows = {}
    for name, context in contexts.items():
        evaluation = context.evaluation
        level = min(CROP_LEVEL, evaluation.levels - 1)
        truths = evaluation.truths["C"][level].clip(0, 1)
        shown = {**context.shown_filters(), **context.shown_runs()}
        images = {text: evaluation.images(job.model, level).clip(0, 1) for text, job in shown.items()}
        first = images["parameters filtered"]
        pair = int(np.argmax(((first - truths) ** 2).mean(axis=(1, 2, 3))))  # with the largest error of the filter
        texts = {
            f"{t}\nPSNR {decibel(float(np.mean((i[pair] - truths[pair]) ** 2))):.1f} dB": i for t, i in images.items()
        }
        crops = {t: srgb.for_display(i[pair, :CROP_SIDE, :CROP_SIDE]) for t, i in {**texts, "truth": truths}.items()}
        rows[f"{name}, level {level}"] = crops
    return plot.draw_images(f"{result['title']}: crops of shaded images", figure_caption(result), rows)
