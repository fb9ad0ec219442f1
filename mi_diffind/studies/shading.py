"""Study ``tradeoff shading``: textures trained for shading at several weights λ of the shading loss.

For each material, a texture is trained as task 4 trains it, and then continued for the same time by task 5 at several
weights λ of the shading loss; λ = 0 continues task 4 (the paper's figure 2). Two remedies against instability at a
large λ are on or off: clipped derivatives through the specular lobe, and a falling learning rate. All runs are repeated
for several seeds.

Classical filters of normals (:mod:`.baselines.normals`) are measured uncompressed; those that an ordinary texture can
hold, Toksvig's and baked roughness, also compressed as λ = 0 is, in as much time, and by ASTC in equal bytes. LEAN's
moments have no limits, which encoders of bytes need. Each is also read at other levels of detail, those with the
smallest error: the *kernel*.

*Errors* are those of :class:`~mi_diffind.tasks.shading.evaluation.ShadedEvaluation`: PSNR of shaded values and FLIP,
under views and lights of no training, against C, the converged truth, and P, the paper's reference. *Flicker*:
:class:`ShadedZoom`.

A run is in *trouble* if its loss became NaN or exploded and it was restarted (``restarts``), or given up (``diverged``:
its result is its start); if a measurement was not finite (``nan``); if the loss exceeded ten times its median
(``spike``); if its end is more than :data:`DRIFT` dB below its best state (``drift``); or if its end is below λ = 0 of
the same seed (``below``).
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.indirection import aligned_copy
from ..arrays.tables import Table, save_table
from ..core.arguments import fraction, positive
from ..core.progress import Deadline
from ..core.runtime import array_module
from ..fitting import task
from ..fitting.loop import FitResult
from ..fitting.task import FitSettings, FittingError
from ..images import srgb
from ..maps.pyramid import Pyramid, decibel
from ..maps.source import Source, SourceError, load_source
from ..measure import plot
from ..measure.renders import POINTS, MovingView
from ..measure.report import figure_caption
from ..measure.study import Candidate, Measure, Plan, Study
from ..measure.training import Contender
from ..tasks import shading as shading_task
from ..tasks import texture as texture_task
from ..tasks.disney.model import Effects
from ..tasks.shading import fit as shading_fit
from ..tasks.shading.evaluation import ShadedEvaluation, ShadedReader, reader, reference
from ..tasks.shading.material import frozen_decoder, material_effects
from ..tasks.shading.training import ShadingProblem, fit_shading, trainable_arrays
from ..tasks.texture import fit as textures
from ..tasks.texture.compressed import CompressedTexture
from ..tasks.texture.fit import find_size
from .baselines import codecs, normals
from .example_maps import MATERIALS, generated_source
from .material_renders import RenderSettings, run_renders
from .texture import level_images, level_pyramid, load_tables

#: Weights λ of the paper's figure 2.
LAMBDAS = (0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)

#: Compression ratio of all trainings.
COMPRESSION = 12.0

#: dB by which a run may end below its best state.
DRIFT = 0.2

#: Limit of clipped derivatives of the specular lobe, unless our preset has one.
CLIP = 0.1

#: Remedies → whether derivatives are clipped, and whether the learning rate falls.
REMEDIES = {
    "clip, schedule": (True, True),
    "no clip, schedule": (False, True),
    "clip, no schedule": (True, False),
    "no clip, no schedule": (False, False),
}

#: Choices of ``--remedies`` → remedies.
CHOICES = {"all": tuple(REMEDIES), "on": ("clip, schedule",), "clip": ("clip, schedule", "clip, no schedule")}


#: Options with a positive number → help.
_NUMBERS = {
    "--seeds": "number of seeds of each training (default: 3; --quick: 1)",
    "--steps": "steps of training for shading (default: 15 seconds; --quick: 1 second); needs --pretrain-steps",
    "--pretrain-steps": "steps of training as a texture before (default: 20 seconds; --quick: 1 second)",
    "--side": "texels on a side of generated materials (default: 512; --quick: 64)",
    "--frames": "frames of the zoom (default: 60; --quick: 4)",
}


class ShadingStudy(Study):
    """Quality of shaded images against the weight of the shading loss, with and without its remedies."""

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
                            "0, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1; --quick: 0, 0.9)")  # fmt: skip
        for option, text in _NUMBERS.items():
            parser.add_argument(option, type=positive, metavar="N", help=text)
        parser.add_argument("--preset", choices=("ours", "paper"), default="ours",
                            help="recipe of the trainings (default: ours); the paper's has no validation")  # fmt: skip
        parser.add_argument("--remedies", choices=tuple(CHOICES), default="all",
                            help="clipped derivatives and a falling rate: all four combinations, both on, or clipped "
                            "derivatives with either rate (default: all)")  # fmt: skip
        parser.add_argument("--extras", action="store_true",
                            help="also train arrays with extras beside them, as fit shading --extras auto")  # fmt: skip
        parser.add_argument("--renders", action="append", metavar="FILE.npz",
                            help="measure whole renders of one MATERIAL.json instead, with a file that was trained on "
                            "it; may be repeated")  # fmt: skip

    def check(self, arguments) -> None:
        """Check the options and load the materials; raise as :func:`.load_source` does."""
        if (arguments.steps is None) != (arguments.pretrain_steps is None):
            raise ValueError("--steps and --pretrain-steps: found one of them, both or none are allowed")
        if arguments.extras and arguments.preset == "paper":
            raise ValueError("--extras: the arrays of the preset paper have none")
        names = arguments.materials or (["hammered"] if arguments.quick else list(MATERIALS))
        arguments.loaded = load_materials(names, arguments.side or (64 if arguments.quick else 512))
        if arguments.renders:
            if len(arguments.loaded) != 1:
                raise ValueError(f"--renders: found {len(arguments.loaded)} materials, one is needed")
            arguments.tables = load_tables(arguments.renders, *arguments.loaded.values())

    def run(self, arguments):
        """Measure renders if ``--renders`` asks for them."""
        if not arguments.renders:
            return None
        film = {"film": (96, 64), "rounds": 1, "truth": 1, "step_film": (32, 32), "quick": True}
        ((name, source),) = arguments.loaded.items()
        settings = RenderSettings(**film if arguments.quick else {})
        return run_renders(name, source, arguments.tables, settings, arguments.out)

    def plan(self, arguments) -> Plan:
        quick, ways = arguments.quick, CHOICES[arguments.remedies]
        settings = SimpleNamespace(
            lambdas=sorted({0.0, *(arguments.lambdas or ((0.9,) if quick else LAMBDAS))}),
            ways=ways[:1] if quick else ways,
            seeds=arguments.seeds or (1 if quick else 3),
            length=float(arguments.steps or (1 if quick else 15)),
            pretraining=float(arguments.pretrain_steps or (1 if quick else 20)),
            unit="steps" if arguments.steps else "s",
            frames=arguments.frames or (4 if quick else 60),
            quick=quick,
            preset=arguments.preset,
            extras=arguments.extras,
        )
        return plan(arguments.loaded, settings)


STUDY = ShadingStudy()


def load_materials(names: Sequence[str], side: int) -> dict[str, Source]:
    """Return the sources of manifests and of generated materials, by name. Raises ``SourceError``, ``ValueError``."""
    sources = {}
    for text in names:
        name = text if text in MATERIALS else Path(text).stem
        if name in sources:
            raise ValueError(f'materials: found "{name}" twice')
        if text not in MATERIALS and not text.endswith(".json"):
            raise SourceError(f'materials: found "{text}", allowed are manifests (.json) and {", ".join(MATERIALS)}')
        sources[name] = generated_source(text, side) if text in MATERIALS else load_source(text)
    return sources


#: Texels along a pixel in the first frame of the zoom.
FAR = 12.0

#: Texels along a pixel in the last frame.
NEAR = 3.0

#: Field of view of the zoom, in degrees.
FOV = 50.0

#: Direction to the light of the zoom.
LIGHT = (0.45, 0.25, 0.86)


@dataclass(frozen=True)
class ShadedZoom(MovingView):
    """A shaded plane that a camera moves towards: ``frames`` of ``side`` × ``side`` pixels of a material.

    The camera looks straight down, so a pixel's footprint is a square, as levels of detail assume, and each pixel is
    seen from its own direction under one light. Images are those of a reader, without a renderer and its noise.
    """

    pyramid: Pyramid
    effects: Effects
    frames: int = 60
    side: int = 96

    @cached_property
    def spacings(self) -> np.ndarray:
        """Texels along a pixel, for each frame."""
        return FAR * (NEAR / FAR) ** (np.arange(self.frames) / max(self.frames - 1, 1))

    def lanes(self, frame: int) -> tuple:
        """Return ``(u, v, level, wi, wo)`` of the pixels of a frame, row by row."""
        types, layout = self.pyramid.types, self.pyramid.layout
        spacing = self.spacings[frame]
        offset = np.arange(self.side) + 0.5 - self.side / 2
        x, y = (a.ravel() for a in np.meshgrid(offset, offset))
        distance = 0.5 * self.side / np.tan(np.radians(FOV) / 2)
        view = np.stack([-x, -y, np.full_like(x, distance)])
        view /= np.linalg.norm(view, axis=0)
        u, v = 0.5 + x * spacing / layout.width, 0.5 + y * spacing / layout.height
        u, v = (types.Float(aligned_copy(a - np.floor(a), np.float32)) for a in (u, v))
        light = np.asarray(LIGHT) / np.linalg.norm(LIGHT)
        wo = types.Array3f(*(dr.opaque(types.Float, float(c), len(x)) for c in light))
        level = dr.opaque(types.Float, float(np.log2(spacing)), len(x))
        wi = types.Array3f(*(types.Float(aligned_copy(c, np.float32)) for c in view))
        lanes = (u, v, level, wi, wo)
        dr.eval(lanes)
        return lanes

    def render(self, read: ShadedReader) -> np.ndarray:
        """Return the frames as displayed, ``(frames, side, side, 3)``."""
        images = []
        for frame in range(self.frames):
            with dr.suspend_grad():
                value = read(*self.lanes(frame))
                dr.eval(value)
                image = np.stack([c.numpy() for c in value], axis=-1)
            images.append(srgb.for_display(image.reshape(self.side, self.side, 3)).astype(np.float32))
        return np.stack(images)

    @cached_property
    def truth(self) -> np.ndarray:
        """The converged frames, as displayed."""
        return self.render(lambda *lanes: reference("converged", self.pyramid, *lanes, self.effects))

    def places(self, frame: int) -> np.ndarray:
        extent = 0.47 * self.side * NEAR
        x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(-extent, extent, POINTS)] * 2))
        return np.stack([x, y], axis=-1) / self.spacings[frame] + self.side / 2


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class ShadingContenders:
    """Contenders of a material: their jobs by name, and the candidates, of which all seeds of a run are one.

    ``runs`` has the jobs of all seeds by remedies and λ; with λ = 0, remedies share them.
    """

    name: str
    source: Source
    settings: SimpleNamespace
    jobs: dict[str, Contender] = field(default_factory=dict)
    candidates: list[Candidate] = field(default_factory=list)
    runs: dict[tuple[str, float], list[Contender]] = field(default_factory=dict)

    def __post_init__(self):
        types, quick = array_module(mi.variant()), self.settings.quick
        self.preset = shading_task.PRESETS[self.settings.preset]
        self.recipe = texture_task.PRESETS[self.preset.texture]
        self.pyramid = Pyramid.from_source(self.source, textures.source_layout(self.source, self.recipe), types)
        self.effects = material_effects(self.pyramid.layout)[0]
        self.zoom = ShadedZoom(self.pyramid, self.effects, self.settings.frames, 32 if quick else 96)

    @cached_property
    def evaluation(self) -> ShadedEvaluation:
        return ShadedEvaluation(self.pyramid, self.effects, *((3, 2, 16) if self.settings.quick else (6, 16, 64)))

    # -- Registration

    def add(self, label: str, method: str, fit: Callable, read: Callable, has_file: bool = False) -> Contender:
        """Register the contender of a method with a label; its model is a reader of shaded values."""
        budget = 1 if method == "classical" else COMPRESSION
        job = Contender(f"{self.name}, {label}", method, budget, fit, read, label, has_file=has_file)
        self.jobs[job.name] = job
        return job

    def add_candidate(self, name: str, representation: str, jobs: Sequence[Contender], **details) -> None:
        """Register the candidate of jobs of all seeds; its bytes, seconds and flicker are those of the first seed."""

        def errors(samples: int) -> dict[str, float]:
            records, values = [job.record["details"] for job in jobs], {}
            for letter, key in itertools.product("CP", ("mean_db", "coarse_db", "flip")):
                measured = [d[letter][key] for d in records if d[letter][key]]
                if measured:  # the FLIP of small images is not measured
                    values[f"{letter.lower()}_{key}"] = float(np.mean(measured))
            return {**values, **self.zoom.errors(self.zoom.render(jobs[0].model), self.zoom.truth)}

        details |= {"material": self.name}
        self.candidates.append(Candidate(name, representation, job=jobs[0].name, errors=errors, details=details))

    def record(self, job: Contender, nbytes: int, **details) -> dict:
        """Measure the model of a job; return its record."""
        details = {"material": self.name, **self.evaluation.measure(job.model), "kind": job.method, **details}
        return {"bytes": nbytes, "details": {**details, "label": job.label}}

    def add_filter(self, label: str, method: str, build: Callable[[], tuple[ShadedReader, int]]) -> Contender:
        """Register a filter that nothing is trained for; ``build()`` returns its reader and its bytes."""
        once = cache(build)
        fit = lambda job, progress: self.record(job, once()[1])  # noqa: E731
        job = self.add(label, method, fit, lambda job: once()[0])
        self.add_candidate(job.name, label, [job], kind=label)
        return job

    def add_kernel(self, job: Contender, label: str = "") -> None:
        """Register a contender, of another ``label``, read at the levels of detail with the smallest error."""
        name, *storage = (label or job.label).split(", ")
        label = ", ".join([*([] if name == "filtered" else [name]), "kernel", *storage])

        def build() -> tuple[ShadedReader, int]:
            biases = normals.choose_biases(job.model, self.evaluation.another())
            return normals.biased(job.model, biases), job.record["bytes"]

        self.add_filter(label, "classical" if job.method == "classical" else "compressed", build)

    # -- Classical filters

    def add_classical(self) -> None:
        """Register classical filters, each also with its kernel: uncompressed, and for our preset in equal bytes."""
        settings, pyramid = self.settings, self.pyramid
        pairs = 4 if settings.quick else normals.PAIRS
        moments = 6 * sum(v[..., 0].size for v in pyramid.values)
        pyramids = {
            "filtered": lambda: pyramid,
            "Toksvig": cache(lambda: normals.with_roughness(pyramid, normals.toksvig_levels(pyramid))),
            "baked": cache(lambda: normals.with_roughness(pyramid, normals.bake(pyramid, self.effects, pairs))),
        }
        builds = {name: partial(self.uncompressed, make) for name, make in pyramids.items()}
        builds["LEAN"] = lambda: (normals.lean(pyramid, self.effects), pyramid.nbytes + moments)
        for name, build in builds.items():
            self.add_kernel(self.add_filter(name, "classical", build))
        for name, make in pyramids.items() if settings.preset == "ours" else ():
            if name != "filtered":  # that is λ = 0
                self.add_kernel(self.add_compressed(f"{name}, compressed", make))
            if "astc" in codecs.available():
                self.add_kernel(self.add_filter(f"{name}, ASTC", "compressed", partial(self.encoded, make)))

    def uncompressed(self, pyramid: Callable[[], Pyramid]) -> tuple[ShadedReader, int]:
        """Return the reader of a pyramid, and its bytes."""
        return reader(pyramid(), self.effects), pyramid().nbytes

    def encoded(self, pyramid: Callable[[], Pyramid]) -> tuple[ShadedReader, int]:
        """Return the reader of a pyramid that ASTC stores in the bytes of the trainings, and its bytes."""
        levels, nbytes = level_images(pyramid()), self.source.nbytes / COMPRESSION
        names = [m.name for m in pyramid().layout.maps if m.role == "normal"]
        coded, nbytes = codecs.astc_levels(levels, nbytes, "thorough", names)
        return reader(level_pyramid({name: e.levels for name, e in coded.items()}, pyramid()), self.effects), nbytes

    # -- Trainings

    def request(self, settings: FitSettings, length: float, seed: int, progress: bool) -> task.FitRequest:
        """Return the request for a training of a ``length``, with ``settings`` changed for it."""
        in_steps = self.settings.unit == "steps"  # then repeatable, and on one core
        settings, seconds = dataclasses.replace(settings, seed=seed, deterministic=in_steps), length
        if in_steps:
            every = max(1, int(length) // 10)
            settings, seconds = dataclasses.replace(settings, steps=int(length), measure_every=every), None
        options = {argument.name: argument.default for argument in task.tasks()["texture"].arguments}
        return task.FitRequest(self.settings.preset, settings, self.pyramid.types, progress=progress, options=options,
                               deadline=seconds and Deadline(seconds))  # fmt: skip

    def fit_texture(
        self, pyramid: Pyramid, length: float, seed: int, progress: bool, extras: bool = False
    ) -> tuple[Table, FitResult]:
        """Train a texture at our rate, with which it converges soonest, on a pyramid in place of the source's.

        With ``extras``, the arrays leave room for them.
        """
        request = self.request(texture_task.PRESETS["ours"], length, seed, progress)
        recipe = dataclasses.replace(self.recipe, **request.settings.common)
        nbytes = self.source.nbytes / COMPRESSION
        nbytes = shading_fit.bytes_beside_extras(nbytes, pyramid) if extras else nbytes
        size = find_size(self.source, pyramid, nbytes, recipe, request.options)
        problem = textures.build_problem(self.source, size, recipe, pyramid)
        result = request.train(problem, f"{self.name}: texture, seed {seed}")
        stored = CompressedTexture(pyramid.layout, textures.stored_form(problem.net))
        trained = textures.to_table(stored, {**request.recorded(), "source": self.source.digest, "steps": result.steps})
        trained.preset, trained.seed = self.settings.preset, seed
        return trained, result

    def add_trained(
        self, label: str, method: str, train: Callable[[bool], tuple], base: Contender | None = None
    ) -> Contender:
        """Register a texture that ``train(progress)`` trains: it returns the table, the training's record, and details.

        The table stays in the folder of models. ``base`` is the run of the same seed with λ = 0, for troubles of a run.
        """

        def fit(job: Contender, progress: bool) -> dict | None:
            table, result, more = train(progress)
            if result.interrupted:
                return None
            save_table(job.file, table)
            training = {"steps": result.steps, "kept_step": result.step, "restarts": result.restarts,
                        "history": result.history, "training_seconds": result.seconds}  # fmt: skip
            record = self.record(job, table.nbytes, **training, **more)
            if method in ("run", "extras"):
                record["details"]["trouble"] = troubles(record["details"], base and base.record["details"])
            return record

        def read(job: Contender) -> ShadedReader:
            texture = CompressedTexture.from_table(self.table(job), self.pyramid.types.TensorXf)
            return reader(texture, self.effects, frozen_decoder(self.pyramid.types))

        return self.add(label, method, fit, read, True)

    @staticmethod
    def table(job: Contender) -> Table:
        return task.tasks()["texture"].load(job.file)

    def add_start(self, seed: int, extras: bool = False) -> Contender:
        """Register a texture trained as task 4 trains it: the start of the runs of a seed."""
        length, label = self.settings.pretraining, f"texture{' beside extras' * extras}, seed {seed}"
        train = lambda progress: (*self.fit_texture(self.pyramid, length, seed, progress, extras), {"seed": seed})  # noqa: E731
        return self.add_trained(label, "start", train)

    def add_compressed(self, label: str, pyramid: Callable[[], Pyramid]) -> Contender:
        """Register a texture trained on a classical filter's pyramid, for the time of start and run together."""
        length = self.settings.pretraining + self.settings.length
        train = lambda progress: (*self.fit_texture(pyramid(), length, 0, progress), {})  # noqa: E731
        job = self.add_trained(label, "compressed", train)
        self.add_candidate(job.name, label, [job], kind=label)
        return job

    def add_run(
        self, start: Contender, way: str, share: float, seed: int, base: Contender | None, extras: bool = False
    ) -> Contender:
        """Register a training for shading with weight ``share``; ``base`` is the run of the same seed with λ = 0.

        λ = 0 is read at the level of the footprint; for other λ, the training chooses the level bias, and with
        ``extras`` whether there are any.
        """
        clip, schedule = REMEDIES[way]

        def train(progress: bool) -> tuple:
            preset = self.preset
            settings = dataclasses.replace(preset, schedule="cosine" if schedule else "constant")
            request = self.request(settings, self.settings.length, seed, progress)
            recipe = dataclasses.replace(
                preset, share=share, clip=(preset.clip or CLIP) if clip else None, extras=extras,
                level_bias=preset.level_bias if share else 0.0, **request.settings.common,
            )  # fmt: skip
            before = self.table(start)
            try:
                fit = fit_shading if preset.bounded else fit_to_the_end
                net = trainable_arrays(before, self.pyramid)
                table, result = fit(self.source, net, recipe, request, self.pyramid, self.evaluation)
            except FittingError:  # diverged repeatedly: the result is the start
                table, result = before, FitResult({}, 0, 0, 0.0, False, 0, [])
            details = {"share": share, "clip": clip, "schedule": schedule, "seed": seed, "way": way,
                       "level_bias": table.settings.get("level_bias", 0.0)}  # fmt: skip
            if extras:
                details["has_extras"] = table.settings.get("shading", {}).get("extras", False)
            return table, result, details

        label = f"extras, seed {seed}" if extras else f"lambda {share:g}, {way}, seed {seed}"
        return self.add_trained(label, "extras" if extras else "run", train, base)

    def add_runs(self) -> None:
        """Register the trainings of all seeds; without a shading loss, there is nothing to clip."""
        settings = self.settings
        for seed in range(settings.seeds):
            start, bases = self.add_start(seed), {}
            for share, way in itertools.product(settings.lambdas, settings.ways):
                schedule = REMEDIES[way][1]
                run = bases.get(schedule)
                if share or run is None:
                    run = self.add_run(start, way, share, seed, run)
                bases.setdefault(schedule, run)
                self.runs.setdefault((way, share), []).append(run)
            if not seed:
                self.add_kernel(self.runs[settings.ways[0], 0.0][0], "filtered, compressed")
            if settings.extras:
                way, start = settings.ways[0], self.add_start(seed, True)
                run = self.add_run(start, way, self.preset.share, seed, bases[REMEDIES[way][1]], True)
                self.add_candidate(run.name, run.label, [run], kind=run.label)
        for (way, share), runs in self.runs.items():
            if runs[0].label.startswith(f"lambda {share:g}, {way},"):
                name, details = f"{self.name}, lambda {share:g}, {way}", {"lambda": share, "way": way, "kind": "run"}
                self.add_candidate(name, "lambda", runs, **details)

    # -- Pictures

    def psnr(self, way: str, share: float, letter: str = "C") -> list[float]:
        """Return the mean PSNR of levels of each seed."""
        return [job.record["details"][letter]["mean_db"] for job in self.runs[way, share]]

    def shown(self, runs: bool = True) -> dict[str, Contender]:
        """Return the contenders in pictures: filtered parameters, the best filters against C, λ = 0 and the best λ."""
        shown = {"parameters filtered": self.jobs[f"{self.name}, filtered"]}
        for text, method in (("uncompressed", "classical"), ("equal bytes", "compressed")):
            jobs = [job for job in self.jobs.values() if job.method == method]
            best = max(jobs, key=lambda job: job.record["details"]["C"]["mean_db"])
            shown[f"{best.label.removesuffix(', compressed')}, {text}"] = best
        if runs:
            way, share = max(self.runs, key=lambda key: (key[1] > 0, np.mean(self.psnr(*key))))
            shown |= {f"λ {s:g}": self.runs[way, s][0] for s in (0.0, share)}
        return shown


def fit_to_the_end(source, net, recipe, request, pyramid: Pyramid, evaluation: ShadedEvaluation) -> tuple:
    """Train as the paper does, without validation; return the table of the last state and the run's record."""
    problem = ShadingProblem(net, pyramid, recipe, source.digest, evaluation.another())
    problem.tolerance = math.inf
    result = request.train(problem, "shading")
    stored = CompressedTexture(pyramid.layout, textures.stored_form(problem.net))
    return textures.to_table(stored, {**request.recorded(), "source": source.digest}), result


def troubles(details: dict, base: dict | None) -> list[str]:
    """Return the troubles of a run, by their names above; ``base`` are the details of λ = 0 of the same seed."""
    history, psnr = details["history"], details["C"]["mean_db"]
    numbers = [v for h in history for k, v in h.items() if k != "step" and v is not None]
    losses = [h["loss"] for h in history if h["loss"] is not None and math.isfinite(h["loss"])]
    key = next((k for h in history[-1:] for k in h if k not in ("step", "loss")), None)
    values = [h[key] for h in history if math.isfinite(h[key])]
    applying = {
        "diverged": not history,
        "nan": not np.isfinite(np.asarray([*numbers, psnr], float)).all(),
        "restarts": details["restarts"],
        "spike": losses and max(losses) > 10 * float(np.median(losses)) + 1e-9,
        "drift": values and max(values) - history[-1][key] > DRIFT,
        "below": base is not None and psnr < base["C"]["mean_db"],
    }
    return [name for name, applies in applying.items() if applies]


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(sources: dict[str, Source], settings: SimpleNamespace) -> Plan:
    """Return the plan for the materials in the current variant."""
    contexts = {name: ShadingContenders(name, source, settings) for name, source in sources.items()}
    for context in contexts.values():
        context.add_classical()
        context.add_runs()
    sizes = ", ".join(f"{name} ({s.width} × {s.height})" for name, s in sources.items())
    details = {"sources": {name: s.digest for name, s in sources.items()}, "request": vars(settings)}
    return Plan(
        study="shading",
        title="Textures trained for their shading",
        candidates=[candidate for context in contexts.values() for candidate in context.candidates],
        cases=[],
        details=details,
        notes=[
            *codecs.install_notes(["astc"]),
            f"{sizes}; {COMPRESSION:g}x, {settings.pretraining:g} {settings.unit} of training as a texture, "
            f"then {settings.length:g} {settings.unit} for shading; C: converged truth, P: the paper's reference.",
        ],
        jobs=[job for context in contexts.values() for job in context.jobs.values()],
        jobs_fingerprint=str(details),
        pictures={
            "png": partial(draw_lambdas, contexts),
            "levels": partial(draw_levels, contexts),
            "strip": partial(draw_crops, contexts),
            "zoom": partial(draw_zoom, contexts),
        },
        measures=(
            Measure("C", "c_mean_db"),
            Measure("C coarse", "c_coarse_db"),
            Measure("P", "p_mean_db"),
            Measure("P coarse", "p_coarse_db"),
            Measure("FLIP", "c_flip", ".4f", False),
            Measure("flicker", "flicker_error", ".2e", False),
        ),
    )


# -- Pictures ----------------------------------------------------------------------------------------------------------

#: Level of detail of the crops.
CROP_LEVEL = 3

#: Largest side of the crops, in texels.
CROP_SIDE = 48


def draw_lambdas(contexts: dict[str, ShadingContenders], result: dict):
    """Draw PSNR over λ for all remedies, with bars over seeds and troubles, beside the best classical filters."""
    settings = next(iter(contexts.values())).settings
    shares = settings.lambdas

    def draw(context: ShadingContenders, letter: str) -> list[plot.Curve]:
        drawn = []
        for way in settings.ways:
            values = [context.psnr(way, share, letter) for share in shares]
            jobs = [job for share in shares if share for job in context.runs[way, share]]
            met = [name for job in jobs for name in job.record["details"]["trouble"]]
            text = ", ".join(f"{name} {met.count(name)}" for name in dict.fromkeys(met)) or "no trouble"
            ends = [[end(v) for v in values] for end in (np.mean, min, max)]
            drawn.append(plot.Curve(f"{way} ({text})", range(len(shares)), *ends))
        return drawn + _filter_curves(context, lambda d: ((0, len(shares) - 1), [d[letter]["mean_db"]] * 2))

    return _draw_both(contexts, result, "", draw, "λ, weight of the shading loss", [f"{s:g}" for s in shares])


def draw_levels(contexts: dict[str, ShadingContenders], result: dict):
    """Draw PSNR by level of detail of λ = 0, the best λ and the best classical filters."""

    def draw(context: ShadingContenders, letter: str) -> list[plot.Curve]:
        def by_level(d: dict) -> tuple:
            return range(len(d[letter]["psnr_db"])), d[letter]["psnr_db"]

        runs = {text: job for text, job in context.shown().items() if job.method == "run"}
        trained = [plot.Curve(text, *by_level(job.record["details"])) for text, job in runs.items()]
        return trained + _filter_curves(context, by_level)

    levels = range(max(context.evaluation.levels for context in contexts.values()))
    return _draw_both(contexts, result, ": levels of detail", draw, "level of detail", list(map(str, levels)))


def _filter_curves(context: ShadingContenders, x: Callable[[dict], tuple[Sequence, Sequence]]) -> list[plot.Curve]:
    """Return the curves of classical filters; ``x(details)`` returns both coordinates."""
    return [
        plot.Curve(text, *x(job.record["details"]), style={"linestyle": line, "color": "0.3", "marker": ""})
        for (text, job), line in zip(context.shown(False).items(), (":", "--", "-."), strict=True)
    ]


def _draw_both(contexts: dict, result: dict, title: str, draw: Callable, x_label: str, ticks: Sequence[str] = ()):
    """Return a figure with a row for each material and a column for each truth."""
    panels = {
        f"{name}, against {truth} ({letter})": draw(context, letter)
        for name, context in contexts.items()
        for letter, truth in (("C", "converged truth"), ("P", "the paper's reference"))
    }
    caption, label = figure_caption(result), "PSNR of shaded values, dB"
    return plot.draw_curves(result["title"] + title, caption, panels, x_label, label, ticks=ticks)


def draw_crops(contexts: dict[str, ShadingContenders], result: dict):
    """Draw crops of a minified level, by each of the contenders shown and of the truth."""
    rows = {}
    for name, context in contexts.items():
        evaluation = context.evaluation
        level = min(CROP_LEVEL, evaluation.levels - 1)
        truths = evaluation.truths["C"][level].clip(0, 1)
        images = {text: evaluation.images(job.model, level).clip(0, 1) for text, job in context.shown().items()}
        first = images["parameters filtered"]
        pair = int(np.argmax(((first - truths) ** 2).mean(axis=(1, 2, 3))))  # with the largest error of the filter
        texts = {f"{t}\n{decibel(float(np.mean((i[pair] - truths[pair]) ** 2))):.1f} dB": i for t, i in images.items()}
        crops = {t: srgb.for_display(i[pair, :CROP_SIDE, :CROP_SIDE]) for t, i in {**texts, "truth": truths}.items()}
        rows[f"{name}, level {level}"] = crops
    return plot.draw_images(f"{result['title']}: crops", figure_caption(result), rows)


def draw_zoom(contexts: dict[str, ShadingContenders], result: dict):
    """Draw frames of the zoom of the first material."""
    name, context = next(iter(contexts.items()))
    zoom = context.zoom
    strips = {text: zoom.render(job.model) for text, job in context.shown().items()}
    title = f"{result['title']}: {name}, a zoom of {zoom.frames} frames"
    return plot.draw_images(title, figure_caption(result), zoom.rows({**strips, "truth": zoom.truth}), 2.0)
