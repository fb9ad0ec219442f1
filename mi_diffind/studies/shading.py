"""Study ``tradeoff shading``: textures trained for their shading, beside plain ones and classical filters of normals.

For each material and seed, a texture is trained as ``fit texture`` trains it without shading (*plain*), and then for
its shading (*ours*), also with other weights λ of the shading loss (the paper's figure 2).

Classical filters (:mod:`.baselines.normals`) are measured uncompressed, and in the bytes of ours: compressed by our
arrays, and by ASTC. Each is also read at other levels of detail, those with the smallest error: the *kernel*. Held-out
footprints (:class:`~mi_diffind.tasks.texture.heldout.HeldOutFootprints`) choose them, as they choose ours.

*Errors* are those of other such footprints, which no choice sees: PSNR of exposed values, the mean of one read at the
centre and of 1, 4 and 16 samples a pixel, of all lights and stretches. Beside them, those of
:class:`~mi_diffind.tasks.texture.appearance.ShadedEvaluation`, one read at the centre of square footprints: PSNR and
FLIP against C, the converged truth, and P, the paper's reference. Last, whole renders (:mod:`.shaded_scenes`) of plain,
ours, and the best filter in equal bytes.
"""

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
from ..maps.pyramid import FilteredMaps, Pyramid
from ..maps.source import Source, SourceError, load_source
from ..measure import plot
from ..measure.report import figure_caption
from ..measure.study import Measure, Plan, Study
from ..measure.training import Contender
from ..tasks import texture as texture_task
from ..tasks.texture import training
from ..tasks.texture.appearance import TRUTHS, ShadedEvaluation, reader
from ..tasks.texture.compressed import CompressedTexture, to_table
from ..tasks.texture.fit import find_size
from ..tasks.texture.heldout import COUNT, SEED, HeldOutFootprints
from ..tasks.texture.surface import material_effects
from .baselines import codecs, normals
from .example_maps import MATERIALS, example_maps
from .materials import level_images, level_pyramid
from .shaded_scenes import LIGHTS, VIEWS, FloorScenes, RenderedFile, SceneQuality, brightness, psnr

#: Compression ratio of all trainings.
COMPRESSION = 12.0

#: Weight λ of the shading loss by default.
SHARE = texture_task.SHADING_PRESETS["ours"].share

#: Levels of detail whose errors are measured.
LEVELS = 6

#: Held-out footprints of a group of a quick study.
QUICK = 64


class ShadingStudy(Study):
    """Quality of shaded images and of renders, beside classical filters."""

    name = "shading"
    title = "textures trained for their shading, beside plain ones and classical filters of normals"
    example = "material.json"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "materials", nargs="*", default=[], metavar="MATERIAL.json|NAME",
            help="manifests of maps, or names of generated materials: hammered, weave, lacquer (default: these; "
            "--quick: hammered)",
        )  # fmt: skip
        parser.add_argument("--lambda", action="append", default=[], type=fraction, dest="lambdas", metavar="X",
                            help=f"further weight of the shading loss beside {SHARE:g}; may be repeated")  # fmt: skip
        parser.add_argument("--seeds", type=positive, default=1, metavar="N",
                            help="number of seeds of plain and ours (default: 1)")  # fmt: skip

    def check(self, arguments) -> None:
        """Load the materials; raise as :func:`.load_source` does."""
        names = arguments.materials or (["hammered"] if arguments.quick else list(MATERIALS))
        arguments.loaded = load_materials(names, 64 if arguments.quick else 256)

    def plan(self, arguments) -> Plan:
        quick = arguments.quick
        settings = SimpleNamespace(
            lambdas=sorted({SHARE, *arguments.lambdas}),
            seeds=arguments.seeds,
            steps={"steps": 20} if quick else {},
            quick=quick,
        )
        contexts = {name: ShadingContenders(name, source, settings) for name, source in arguments.loaded.items()}
        jobs = [job for context in contexts.values() for job in context.jobs.values()]
        sizes = ", ".join(f"{name} ({s.width} × {s.height})" for name, s in arguments.loaded.items())
        details = {"sources": {name: s.digest for name, s in arguments.loaded.items()}, "request": vars(settings)}
        return Plan(
            study="shading",
            title="Textures trained for their shading",
            candidates=[job.candidate(is_reference=job.method == "renders") for job in jobs],
            cases=[],
            details=details,
            notes=[
                *codecs.install_notes(["astc"]),
                f"{sizes}; equal bytes: {COMPRESSION:g}x; kernel: read at the levels of detail with the least error.",
            ],
            jobs=jobs,
            jobs_fingerprint=str(details),
            pictures={
                "png": partial(draw_levels, contexts),
                "strip": partial(draw_renders, contexts),
                **({"lambda": partial(draw_lambdas, contexts)} if len(settings.lambdas) > 1 else {}),
            },
            measures=(
                Measure("footprints", "footprints_db"),
                Measure("noisy", "with_noise_db"),
                *(Measure(f"L{level}", f"l{level}_db", ".1f") for level in range(LEVELS)),
                Measure("C", "c_mean_db"),
                Measure("FLIP", "c_flip", ".4f", False),
                Measure("over best", "over_best_db", "+.2f"),
                Measure("over best, noisy", "over_best_with_noise_db", "+.2f"),
                Measure("over LEAN", "over_lean_db", "+.2f"),
                Measure("over LEAN, noisy", "over_lean_with_noise_db", "+.2f"),
                Measure("renders", "renders_gain_db", "+.2f"),
                Measure("at worst", "renders_worst_db", "+.2f"),
                Measure("brightness", "brightness_error", ".3f", False),
            ),
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
    """Contenders of a material, by label; the model of each is :class:`.FilteredMaps`.

    Methods are ``classical`` (uncompressed filters), ``compressed`` (filters in the bytes of ours), ``plain`` (a
    texture), ``run`` (a texture trained for its shading) and ``renders`` (whole renders of ours, with a record of the
    gains alone). ``runs`` has the runs of all seeds by λ.
    """

    name: str
    source: Source
    settings: SimpleNamespace
    jobs: dict[str, Contender] = field(default_factory=dict)
    runs: dict[float, list[Contender]] = field(default_factory=dict)

    def __post_init__(self):
        layout = training.source_layout(self.source, texture_task.PRESETS["ours"])
        self.pyramid = Pyramid.from_source(self.source, layout, array_module(mi.variant()))
        self.effects = material_effects(layout)[0]
        for seed in range(self.settings.seeds):
            plain = self.add_fit("plain", "plain", seed, shading="off")
            for share in self.settings.lambdas:
                label, options = "ours", {}
                if share != SHARE:  # λ = 0 is read at the level of the footprint
                    label, options = f"lambda {share:g}", {"start": plain, "shading": "on", "share": share}
                    options |= {} if share else {"level_bias": 0.0}
                self.runs.setdefault(share, []).append(self.add_fit(label, "run", seed, **options))
        self.add_filters()
        for seed in range(self.settings.seeds):
            self.add_renders(seed)

    @cached_property
    def evaluation(self) -> ShadedEvaluation:
        return ShadedEvaluation(self.pyramid, self.effects, *((3, 2, 16) if self.settings.quick else (LEVELS,)))

    @cached_property
    def footprints(self) -> tuple[HeldOutFootprints, HeldOutFootprints]:
        """Held-out footprints that choose levels, those that choose ours; and others, of which errors are measured."""
        count = QUICK if self.settings.quick else COUNT
        return tuple(HeldOutFootprints(self.pyramid, self.effects, count, seed) for seed in (SEED, SEED + 1))

    @cached_property
    def scenes(self) -> FloorScenes:
        quality = SceneQuality((64, 36), 32, 8, 1) if self.settings.quick else SceneQuality()
        return FloorScenes(self.source, "repeat" if set(self.pyramid.border) == {"repeat"} else "mirror", quality)

    def add(self, label: str, method: str, fit: Callable, read: Callable, has_file: bool = False) -> Contender:
        """Register a contender."""
        job = Contender(f"{self.name}, {label}", method, 0, fit, read, label, has_file=has_file)
        self.jobs[label] = job
        return job

    def record(self, job: Contender, nbytes: int, **details) -> dict:
        """Measure the model of a job; return its record."""
        read = reader(job.model, self.effects)
        measured, by_level = self.evaluation.measure(read), self.footprints[1].psnr(read)[:LEVELS]
        noisy = self.footprints[1].psnr(read, noise=True)[:LEVELS]
        errors = {"footprints_db": float(by_level.mean()), "with_noise_db": float(noisy.mean())}
        errors |= {f"l{level}_db": float(value) for level, value in enumerate(by_level)}
        errors |= {f"{letter.lower()}_mean_db": figures["mean_db"] for letter, figures in measured.items()}
        if measured["C"]["flip"]:  # that of small images is not measured
            errors["c_flip"] = float(np.mean(measured["C"]["flip"]))
        details |= {"material": self.name, "kind": job.method, "label": job.label, **measured}
        return {"bytes": nbytes, "errors": errors, "details": details}

    # -- Trainings

    def add_trained(
        self, label: str, method: str, train: Callable[[Contender, bool], tuple[Table, FitResult]], **details
    ) -> Contender:
        """Register a texture that ``train(job, progress)`` trains; its table stays in the folder of models."""

        def fit(job: Contender, progress: bool) -> dict | None:
            table, result = train(job, progress)
            if result.interrupted:
                return None
            save_table(job.file, table)
            chosen = {name: table.settings.get(name) for name in ("level_bias", "kept_start")}
            return self.record(job, table.nbytes, seconds=result.seconds, **chosen, **details)

        def read(job: Contender) -> FilteredMaps:
            maps = CompressedTexture.from_table(texture_task.TASK.load(job.file), self.pyramid.types.TensorXf)
            return normals.ReadMaps(maps) if method == "compressed" else maps

        return self.add(label, method, fit, read, True)

    def add_fit(self, label: str, method: str, seed: int, **options) -> Contender:
        """Register the result of ``fit texture`` with the given options, and with defaults for all others."""

        def train(job: Contender, progress: bool) -> tuple[Table, FitResult]:
            given = {**options, "start": options["start"].file} if "start" in options else options
            size = {} if "start" in options else {"compression": COMPRESSION}
            fitted = task.fit("texture", self.source, seed=seed, variant=mi.variant(), progress=progress,
                              output=job.file, **self.settings.steps, **size, **given)  # fmt: skip
            return fitted.table, fitted.result

        details = {"share": options.get("share", SHARE), "way": "clip, schedule"} if method == "run" else {}
        return self.add_trained(f"{label}, seed {seed}", method, train, **details)

    # -- Classical filters

    def add_filters(self) -> None:
        """Register classical filters: uncompressed, and in the bytes of ours by our arrays and by ASTC."""
        pyramid = self.pyramid
        pairs = 4 if self.settings.quick else normals.PAIRS
        filters = {
            "plain": lambda: pyramid,
            "Toksvig": lambda: normals.with_roughness(pyramid, normals.toksvig_levels(pyramid)),
            "LEAN": lambda: normals.lean_pyramid(pyramid),
            "baked": lambda: normals.with_roughness(pyramid, normals.bake(pyramid, self.effects, pairs)),
        }
        for name, build in filters.items():
            build = cache(build)
            self.add_filter(name, "classical", lambda build=build: (build(), build().nbytes))
            stored = self.jobs["plain, seed 0"]
            if name != "plain":
                stored = self.add_trained(f"{name}, compressed", "compressed", partial(self.train_filter, build))
            self.add_kernel(f"{name}, kernel", self.jobs[name])
            self.add_kernel(f"{name}, kernel, compressed", stored)
            if "astc" in codecs.available():
                self.add_filter(f"{name}, ASTC", "compressed", partial(self.encoded, build))
                self.add_kernel(f"{name}, kernel, ASTC", self.jobs[f"{name}, ASTC"])

    def add_filter(self, label: str, method: str, build: Callable[[], tuple[FilteredMaps, int]]) -> None:
        """Register maps that nothing is trained for; ``build()`` returns them and their bytes."""
        once = cache(build)
        read = lambda job: normals.ReadMaps(once()[0])  # noqa: E731
        self.add(label, method, lambda job, progress: self.record(job, once()[1]), read)

    def add_kernel(self, label: str, job: Contender) -> None:
        """Register the maps of a job, read at the levels of detail with the smallest error."""

        def read(_) -> normals.ReadMaps:
            return normals.ReadMaps(job.model, normals.choose_biases(job.model, self.effects, self.footprints[0]))

        method = "compressed" if job.method == "plain" else job.method
        self.add(label, method, lambda kernel, progress: self.record(kernel, job.record["bytes"]), read)

    def train_filter(self, build: Callable[[], Pyramid], job: Contender, progress: bool) -> tuple[Table, FitResult]:
        """Train our arrays for the pyramid of a filter, as ``fit texture`` does for that of the source."""
        recipe = texture_task.TASK.change_settings(texture_task.PRESETS["ours"], self.settings.steps)
        request = task.FitRequest("ours", recipe, self.pyramid.types, progress=progress)
        options = dict.fromkeys(("structure", "skip", "cascaded"))  # chosen by content
        size = find_size(self.source, build(), self.source.nbytes / COMPRESSION, recipe, options)
        problem = training.build_problem(self.source, size, recipe, build())
        result = request.train(problem, f"train {job.name}")
        maps = CompressedTexture(build().layout, training.stored_form(problem.net))
        return to_table(maps, {**request.recorded(result), **problem.identity}), result

    def encoded(self, build: Callable[[], Pyramid]) -> tuple[Pyramid, int]:
        """Return the pyramid of a filter as ASTC stores it in the bytes of ours, and its bytes."""
        names = [m.name for m in build().layout.maps if m.role == "normal"]
        quality = "fast" if self.settings.quick else "thorough"
        coded, nbytes = codecs.astc_levels(level_images(build()), self.source.nbytes / COMPRESSION, quality, names)
        return level_pyramid({name: e.levels for name, e in coded.items()}, build()), nbytes

    def best(self, method: str, name: str = "", error: str = "footprints_db") -> Contender:
        """Return the contender of a method, of the filter ``name`` if it is given, with the smallest ``error``."""
        jobs = [job for job in self.jobs.values() if job.method == method and job.label.startswith(name)]
        return max(jobs, key=lambda job: job.record["errors"][error])

    # -- Renders

    def rendered(self, job: Contender) -> RenderedFile:
        """Return what is rendered of a texture, or of a filter in equal bytes."""
        if job.method in ("plain", "run"):
            return RenderedFile(job.file)
        name = job.label.split(",")[0]
        file = self.jobs["plain, seed 0" if name == "plain" else f"{name}, compressed"].file
        return RenderedFile(file, job.model)

    def add_renders(self, seed: int) -> None:
        """Register the renders of plain and ours, and for the first seed of the best filter in equal bytes."""

        def fit(job: Contender, progress: bool) -> dict:
            plain, ours = self.jobs[f"plain, seed {seed}"], self.runs[SHARE][seed]
            best, lean = self.best("compressed"), self.best("classical", "LEAN")
            shown = {"plain": plain, "ours": ours, **({} if seed else {"best": best})}
            renders = {name: self.scenes.measure(self.rendered(contender)) for name, contender in shown.items()}
            gains, ratios = {}, {"plain": [], "ours": []}
            for lights, by_spp in renders["ours"].items():
                for spp, figures in by_spp.items():
                    before = renders["plain"][lights][spp]
                    gains[f"{lights}_{spp}_gain_db"] = np.subtract(figures["psnr_db"], before["psnr_db"])
                    for name in ratios:
                        views = renders[name][lights][spp]["brightness"]
                        ratios[name] += [abs(ratio - 1) for view in views for ratio in view.values()]
            over = {}
            for suffix, error in (("db", "footprints_db"), ("with_noise_db", "with_noise_db")):
                rivals = {"best": self.best("compressed", error=error), "lean": self.best("classical", "LEAN", error)}
                for name, rival in rivals.items():
                    over[f"over_{name}_{suffix}"] = ours.record["errors"][error] - rival.record["errors"][error]
            errors = {
                **over,
                "renders_gain_db": float(np.mean([*gains.values()])),
                "renders_worst_db": float(np.min([*gains.values()])),
                "brightness_error": max(ratios["ours"]),
                "plain_brightness_error": max(ratios["plain"]),
                **{name: float(gain.mean()) for name, gain in gains.items()},
            }
            details = {"material": self.name, "kind": job.method, "label": job.label, "best": best.label}
            return {"errors": errors, "details": {**details, "lean": lean.label, "renders": renders}}

        self.add(f"renders, seed {seed}", "renders", fit, lambda job: None)


# -- Pictures ----------------------------------------------------------------------------------------------------------

#: Factor of the exposure in pictures, so that highlights are not white.
DISPLAYED = 0.7


def draw_levels(contexts: dict[str, ShadingContenders], result: dict):
    """Draw PSNR by level of detail of plain, ours, the best filter in equal bytes and uncompressed LEAN."""
    panels = {}
    for name, context in contexts.items():
        best, lean = context.best("compressed"), context.best("classical", "LEAN")
        levels = min(LEVELS, context.footprints[1].levels)
        shown = {
            "ours": context.runs[SHARE][0],
            "plain": context.jobs["plain, seed 0"],
            f"best filter in equal bytes: {best.label}": best,
            f"{lean.label}, uncompressed": lean,
        }
        values = {text: [job.record["errors"][f"l{i}_db"] for i in range(levels)] for text, job in shown.items()}
        panels[name] = [plot.Curve(text, range(len(by_level)), by_level) for text, by_level in values.items()]
    title = f"{result['title']}: quality of shaded images by level of detail"
    return plot.draw_curves(title, figure_caption(result), panels, "level of detail", "PSNR of shaded values, dB")


def draw_lambdas(contexts: dict[str, ShadingContenders], result: dict):
    """Draw PSNR over λ, with bars over seeds, against both references."""
    panels, ticks = {}, [f"{share:g}" for share in next(iter(contexts.values())).runs]
    for name, context in contexts.items():
        for letter, truth in TRUTHS.items():
            seeds = [[job.record["details"][letter]["mean_db"] for job in jobs] for jobs in context.runs.values()]
            ends = [[end(values) for values in seeds] for end in (np.mean, min, max)]
            panels[f"{name}, against the {truth} reference ({letter})"] = [plot.Curve("", range(len(seeds)), *ends)]
    title, label = f"{result['title']}: quality by λ", "PSNR of shaded values, dB"
    return plot.draw_curves(title, figure_caption(result), panels, "λ, weight of the shading loss", label, ticks=ticks)


def draw_renders(contexts: dict[str, ShadingContenders], result: dict):
    """Draw a render under the sun of plain, the best filter in equal bytes, ours and the truth, a far part enlarged."""
    rows = {}
    for name, context in contexts.items():
        lights, view, scenes = LIGHTS[0], VIEWS[0], context.scenes
        truth, exposure, masks = scenes.truth(lights, view)
        best, far = context.best("compressed"), masks["far"]
        shown = {
            "plain texture": context.jobs["plain, seed 0"],
            f"classical filter in equal bytes ({best.label})": best,
            "ours, trained for its shading": context.runs[SHARE][0],
        }
        renders = {text: scenes.images(context.rendered(job), lights, view, [1])[1] for text, job in shown.items()}
        window, rows[name] = far_window(renders["plain texture"].mean(axis=0) - truth.mean(axis=0), far), {}
        for text, halves in {**renders, "truth": truth}.items():
            light = brightness(truth[:, far], halves[:, far], exposure) - 1
            errors = f"{psnr(truth, halves, exposure):.1f} dB, light of the far floor {light:+.1%}"
            whole = srgb.for_display(DISPLAYED * exposure * halves.mean(axis=0))
            part = whole[window].repeat(3, axis=0).repeat(3, axis=1)[:, : whole.shape[1]]
            title = f"{text}\n{'' if halves is truth else errors}"
            rows[name][title] = np.concatenate([whole, np.ones_like(whole[:2]), part])
    title = "A sunlit floor from near to far, one sample a pixel; below, a part of the far floor, three times as large"
    return plot.draw_images(title, figure_caption(result), rows, 3.4)


def far_window(difference: np.ndarray, mask: np.ndarray) -> tuple[slice, slice]:
    """Return a third of the columns and a fifth of the rows at the top of a mask, where a difference is largest."""
    height, width = mask.shape
    first, columns = int(np.flatnonzero(mask.any(axis=1))[0]), -(-width // 3)
    rows = slice(first, first + height // 5)
    error = np.abs(difference[rows]).mean(axis=-1) * mask[rows]
    start = int(np.convolve(error.sum(axis=0), np.ones(columns), "valid").argmax())
    return rows, slice(start, start + columns)
