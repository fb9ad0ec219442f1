"""Study ``tradeoff shading``: textures trained for shading at several weights λ of the shading loss.

For each material, a texture is trained as task 4 trains it, and then continued for the same time by task 5 at several
weights λ of the shading loss; λ = 0 continues task 4 (the paper's figure 2). Two remedies against instability at a
large λ are on or off: clipped derivatives through the specular lobe, and a falling learning rate. All runs are repeated
for several seeds.

Classical filters of normals (:mod:`.baselines.normals`) are measured uncompressed; those that an ordinary texture can
hold, Toksvig's and baked roughness, also compressed as λ = 0 is, in as much time, and by ASTC in equal bytes. LEAN's
moments have no limits, which encoders of bytes need. The *kernel* control reads at other levels of detail, those with
the smallest error; compressed textures are read in this way, too.

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
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache, cached_property
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.indirection import aligned_copy
from ..arrays.tables import Table, save_table
from ..core.arguments import fraction, positive
from ..core.progress import Deadline
from ..core.runtime import array_module
from ..core.units import parse_compression
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
from .equal_memory import Contender
from .example_maps import MATERIALS, generated_source
from .material_renders import RenderSettings, run_renders
from .texture import level_images, level_pyramid, load_tables

#: Weights λ of the paper's figure 2.
LAMBDAS = (0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)

#: The material that ships.
SHIPPED = "scenes/assets/tiles.json"

#: dB by which a run may end below its best state.
DRIFT = 0.2

#: Limit of clipped derivatives of the specular lobe, unless our preset has one.
CLIP = 0.1


@dataclass(frozen=True)
class Remedies:
    """Remedies against instability: ``clip``, clipped derivatives; ``schedule``, a falling learning rate."""

    clip: bool
    schedule: bool

    @property
    def name(self) -> str:
        return f"{'clip' if self.clip else 'no clip'}, {'schedule' if self.schedule else 'no schedule'}"


#: Both remedies, one of them, none.
REMEDIES = (Remedies(True, True), Remedies(False, True), Remedies(True, False), Remedies(False, False))


@dataclass(frozen=True)
class ShadingStudySettings:
    """Settings of the shading study.

    ``lambdas`` are the weights λ, 0 among them, ``ways`` the combinations of remedies, ``seeds`` the number of seeds.
    ``preset`` is the recipe: the paper's has neither validation nor level bias, and ends in its last state. ``extras``:
    also train, with the preset's λ, arrays that leave room for extras.
    ``length`` is that of the training for shading, ``pretraining`` that of the training as a texture before it, in the
    ``unit`` ``"s"`` or ``"steps"``. ``frames`` is the length of the zoom; ``quick`` makes it a smoke run.
    """

    lambdas: tuple[float, ...]
    ways: tuple[Remedies, ...] = REMEDIES
    seeds: int = 3
    length: float = 15.0
    pretraining: float = 20.0
    compression: float = 12.0
    frames: int = 60
    quick: bool = False
    unit: str = "s"
    preset: str = "ours"
    extras: bool = False

    @property
    def recipe(self) -> shading_task.ShadingSettings:
        return shading_task.PRESETS[self.preset]


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
            help="manifests of maps, or names of generated materials: hammered, weave, lacquer "
            "(default: scenes/assets/tiles.json, if the file exists, and these; --quick: hammered)",
        )  # fmt: skip
        parser.add_argument("--lambda", action="append", type=fraction, dest="lambdas", metavar="X",
                            help="weight of the shading loss; may be repeated; 0 is always among them (default: "
                            "0, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1; --quick: 0, 0.9)")  # fmt: skip
        for option, text in _NUMBERS.items():
            parser.add_argument(option, type=positive, metavar="N", help=text)
        parser.add_argument("--compression", default="12x", metavar="N",
                            help="compression ratio of all trainings (default: 12x)")  # fmt: skip
        parser.add_argument("--preset", choices=("ours", "paper"), default="ours",
                            help="recipe of the trainings (default: ours); the paper's has no validation")  # fmt: skip
        parser.add_argument("--remedies", choices=("all", "both", "on", "clip"), default="all",
                            help="clipped derivatives and a falling rate: all four combinations, both or none, both "
                            "only, or clipped derivatives with either rate (default: all)")  # fmt: skip

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
        arguments.ratio = parse_compression(arguments.compression)
        arguments.loaded = load_materials(arguments.materials, arguments.side or (64 if arguments.quick else 512),
                                          arguments.quick)  # fmt: skip
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
        quick = arguments.quick
        steps = {"all": slice(None), "both": slice(None, None, 3), "on": slice(1), "clip": slice(None, None, 2)}
        ways = REMEDIES[steps[arguments.remedies]]
        settings = ShadingStudySettings(
            tuple(sorted({0.0, *(arguments.lambdas or ((0.9,) if quick else LAMBDAS))})),
            ways[:: len(ways) - 1] if quick and len(ways) > 1 else ways,
            arguments.seeds or (1 if quick else 3),
            float(arguments.steps or (1 if quick else 15)),
            float(arguments.pretrain_steps or (1 if quick else 20)),
            arguments.ratio,
            arguments.frames or (4 if quick else 60),
            quick,
            "steps" if arguments.steps else "s",
            arguments.preset,
            arguments.extras,
        )
        return plan(arguments.loaded, settings)


STUDY = ShadingStudy()


def load_materials(names: Sequence[str], side: int, quick: bool = False) -> dict[str, Source]:
    """Return the sources of manifests and of generated materials, by name; a default list if ``names`` is empty.

    Raises ``SourceError`` and ``ValueError``.
    """
    if not names:
        names = ["hammered"] if quick else [*([SHIPPED] if Path(SHIPPED).is_file() else []), *MATERIALS]
    sources = {}
    for text in names:
        name = text if text in MATERIALS else Path(text).stem
        if name in sources:
            raise ValueError(f'materials: found "{name}" twice')
        if text not in MATERIALS and not text.endswith(".json"):
            raise SourceError(f'materials: found "{text}", allowed are manifests (.json) and {", ".join(MATERIALS)}')
        sources[name] = generated_source(text, side) if text in MATERIALS else load_source(text)
    return sources


#: Texels along a pixel in the first and in the last frame.
FAR = 12.0
NEAR = 3.0


#: Field of view of the zoom in degrees, and the direction to its light.
FOV = 50.0
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
class ShadingStudyContext:
    """A material, the data that its contenders share, and their jobs by name."""

    name: str
    source: Source
    settings: ShadingStudySettings
    jobs: dict[str, Contender] = field(default_factory=dict)

    @cached_property
    def types(self):
        return array_module(mi.variant())

    @cached_property
    def recipe(self):
        return texture_task.PRESETS[self.settings.recipe.texture]

    @cached_property
    def pyramid(self) -> Pyramid:
        return Pyramid.from_source(self.source, textures.source_layout(self.source, self.recipe), self.types)

    @cached_property
    def effects(self) -> Effects:
        return material_effects(self.pyramid.layout)[0]

    @cached_property
    def decoder(self):
        return frozen_decoder(self.types)

    @cached_property
    def evaluation(self) -> ShadedEvaluation:
        levels, pairs, side = (3, 2, 16) if self.settings.quick else (6, 16, 64)
        return ShadedEvaluation(self.pyramid, self.effects, levels, pairs, side)

    @cached_property
    def zoom(self) -> ShadedZoom:
        return ShadedZoom(self.pyramid, self.effects, self.settings.frames, 32 if self.settings.quick else 96)

    def measure(self, job: Contender, nbytes: int, **details) -> dict:
        """Measure the model of a job; return its record."""
        details = {"material": self.name, **self.evaluation.measure(job.model), "kind": job.method, **details}
        details |= {"label": job.label} if job.label else {}
        return {"bytes": nbytes, "details": details}

    def contender(self, method: str, label: str, fit: Callable, read: Callable, **fields) -> Contender:
        """Return a contender of this material with a label, whose model is a reader of shaded values."""
        budget = 1 if method == "classical" else self.settings.compression
        return Contender(f"{self.name}, {label}", method, budget, fit, read, label, **fields)

    def classical(self, label: str, build: Callable[[Contender], ShadedReader], channels: int = 0) -> Contender:
        """Return an uncompressed filter, which needs ``channels`` beside those of the maps."""

        def fit(job: Contender, progress: bool) -> dict:
            texels = sum(v[..., 0].size for v in self.pyramid.values)
            return self.measure(job, self.pyramid.nbytes + channels * texels)

        return self.contender("classical", label, fit, build, has_file=False)

    def encoded(self, label: str, pyramid: Callable[[], Pyramid]) -> Contender:
        """Return a filter whose levels ASTC stores in the bytes of the trainings."""

        @cache
        def levels() -> tuple[Pyramid, int]:
            filtered = pyramid()
            names = [m.name for m in filtered.layout.maps if m.role == "normal"]
            nbytes = int(self.source.nbytes / self.settings.compression)
            coded, nbytes = codecs.astc_levels(level_images(filtered), nbytes, "thorough", names)
            return level_pyramid({name: e.levels for name, e in coded.items()}, filtered), nbytes

        return self.contender(
            "compressed", label, lambda job, progress: self.measure(job, levels()[1]),
            lambda job: normals.reader(levels()[0], self.effects), has_file=False,
        )  # fmt: skip

    def biased(self, label: str, base: Contender) -> Contender:
        """Return a compressed texture read at the levels of detail that suit the truth's kernel; nothing is trained."""
        return self.contender(
            "compressed", label, lambda job, progress: self.measure(job, base.record["bytes"]),
            lambda job: self.best_levels(base.model), has_file=False,
        )  # fmt: skip

    def best_levels(self, read: ShadedReader) -> ShadedReader:
        """Return a reader at the levels of detail with the smallest error."""
        places = 2**10 if self.settings.quick else normals.PLACES
        return normals.biased(read, normals.choose_biases(read, self.pyramid, self.effects, places))

    def request(self, settings: FitSettings, length: float, seed: int, progress: bool) -> task.FitRequest:
        """Return the request for a training of a ``length``, with ``settings`` changed for it."""
        in_steps = self.settings.unit == "steps"  # then repeatable, and on one core
        settings, seconds = dataclasses.replace(settings, seed=seed, deterministic=in_steps), length
        if in_steps:
            every = max(1, int(length) // 10)
            settings, seconds = dataclasses.replace(settings, steps=int(length), measure_every=every), None
        options = {argument.name: argument.default for argument in task.tasks()["texture"].arguments}
        options["compression"] = self.settings.compression
        preset = self.settings.preset
        return task.FitRequest(preset, settings, self.types, deadline=seconds and Deadline(seconds),
                               progress=progress, options=options)  # fmt: skip

    def fit_texture(
        self, pyramid: Pyramid, length: float, seed: int, progress: bool, extras: bool = False
    ) -> tuple[Table, FitResult]:
        """Train a texture at our rate, with which it converges soonest, on a pyramid in place of the source's.

        With ``extras``, the arrays leave room for them.
        """
        request = self.request(texture_task.PRESETS["ours"], length, seed, progress)
        recipe = dataclasses.replace(self.recipe, **request.settings.common)
        nbytes = self.source.nbytes / self.settings.compression
        nbytes = shading_fit.bytes_beside_extras(nbytes, pyramid) if extras else nbytes
        size = find_size(self.source, pyramid, nbytes, recipe, request.options)
        problem = textures.build_problem(self.source, size, recipe, pyramid)
        result = request.train(problem, f"{self.name}: texture, seed {seed}")
        stored = CompressedTexture(pyramid.layout, textures.stored_form(problem.net))
        trained = textures.to_table(stored, {**request.recorded(), "source": self.source.digest, "steps": result.steps})
        trained.preset, trained.seed = self.settings.preset, seed
        return trained, result

    def trained(
        self, method: str, label: str, train: Callable[[bool], tuple[Table, FitResult, dict]],
        finish: Callable[[dict], None] = lambda record: None,
    ) -> Contender:  # fmt: skip
        """Return the contender of a texture that ``train(progress)`` trains; its table stays in the folder of models.

        ``train`` returns the table, the record of the training, and further details; ``finish`` completes the record.
        The model has the attribute ``table``.
        """

        def fit(job: Contender, progress: bool) -> dict | None:
            table, result, details = train(progress)
            if result.interrupted:
                return None
            if job.file is not None:
                save_table(job.file, table)
            job.model = TrainedReader(table, self)
            training = {"steps": result.steps, "kept_step": result.step, "restarts": result.restarts,
                        "history": result.history, "training_seconds": result.seconds}  # fmt: skip
            record = self.measure(job, table.nbytes, **training, **details)
            finish(record)
            return record

        def read(job: Contender) -> TrainedReader:
            return TrainedReader(task.tasks()["texture"].load(job.file), self)

        job = self.contender(method, label, fit, read)
        job.label = "" if method in ("start", "run") else label
        return job

    def start(self, seed: int, extras: bool = False) -> Contender:
        """Return a texture trained as task 4 trains it: the start of the runs of a seed."""

        def train(progress: bool) -> tuple:
            length = self.settings.pretraining
            return *self.fit_texture(self.pyramid, length, seed, progress, extras), {"seed": seed}

        return self.trained(
            "start", f"texture beside extras, seed {seed}" if extras else f"texture, seed {seed}", train
        )

    def compressed(self, label: str, pyramid: Callable[[], Pyramid]) -> Contender:
        """Return a texture trained on the pyramid of a classical filter, for the time of start and run together."""

        def train(progress: bool) -> tuple:
            length = self.settings.pretraining + self.settings.length
            return *self.fit_texture(pyramid(), length, 0, progress), {}

        return self.trained("compressed", label, train)

    def run(
        self, start: Contender, way: Remedies, share: float, seed: int, base: Contender | None, extras: bool = False
    ) -> Contender:
        """Return a training for shading with weight ``share``; ``base`` is the run of the same seed with λ = 0.

        λ = 0 is read at the level of the footprint; for other λ, the training chooses the level bias, and with
        ``extras`` whether there are any.
        """

        def train(progress: bool) -> tuple:
            preset = self.settings.recipe
            schedule = "cosine" if way.schedule else "constant"
            settings = dataclasses.replace(preset, schedule=schedule)
            request = self.request(settings, self.settings.length, seed, progress)
            recipe = dataclasses.replace(
                preset, share=share, clip=(preset.clip or CLIP) if way.clip else None, extras=extras,
                level_bias=preset.level_bias if share else 0.0, **request.settings.common,
            )  # fmt: skip
            net = trainable_arrays(start.model.table, self.pyramid)
            try:
                fit = fit_shading if preset.bounded else fit_to_the_end
                table, result = fit(self.source, net, recipe, request, self.pyramid, self.evaluation)
            except FittingError:  # diverged repeatedly: the result is the start
                table, result = start.model.table, FitResult({}, 0, 0, 0.0, False, 0, [])
            details = {"share": share, "clip": way.clip, "schedule": way.schedule, "seed": seed, "way": way.name,
                       "level_bias": table.settings.get("level_bias", 0.0)}  # fmt: skip
            if extras:
                details["has_extras"] = table.settings.get("shading", {}).get("extras", False)
            return table, result, details

        def finish(record: dict) -> None:
            before = base.record["details"] if base is not None and base.record else None
            record["details"]["trouble"] = troubles(record["details"], before)

        name = f"extras, seed {seed}" if extras else f"lambda {share:g}, {way.name}, seed {seed}"
        job = self.trained("extras" if extras else "run", name, train, finish)
        job.details = {"share": share, "way": way, "base": base, "start": start}
        return job


class TrainedReader:
    """Reader of shaded values of a compressed texture, shaded by the tables of the BRDF that it was trained through."""

    def __init__(self, table: Table, context: ShadingStudyContext):
        self.table = table
        self.read = reader(
            CompressedTexture.from_table(table, context.types.TensorXf), context.effects, context.decoder
        )

    def __call__(self, *lanes):
        return self.read(*lanes)


def fit_to_the_end(source, net, recipe, request, pyramid: Pyramid, evaluation: ShadedEvaluation) -> tuple:
    """Train as the paper does, without validation; return the table of the last state and the run's record."""
    problem = ShadingProblem(net, pyramid, recipe, source.digest, evaluation.another())
    problem.tolerance = math.inf
    result = request.train(problem, "shading")
    stored = CompressedTexture(pyramid.layout, textures.stored_form(problem.net))
    return textures.to_table(stored, {**request.recorded(), "source": source.digest}), result


def troubles(details: dict, base: dict | None) -> list[str]:
    """Return the troubles of a run, by their names above; ``base`` are the details of λ = 0 of the same seed."""
    history, names = details["history"], []
    if not history:
        names.append("diverged")
    numbers = [v for h in history for k, v in h.items() if k != "step" and v is not None]
    if not np.isfinite(np.asarray([*numbers, details["C"]["mean_db"]], float)).all():
        names.append("nan")
    if details["restarts"]:
        names.append("restarts")
    losses = [h["loss"] for h in history if h["loss"] is not None and math.isfinite(h["loss"])]
    if losses and max(losses) > 10 * float(np.median(losses)) + 1e-9:
        names.append("spike")
    if history:
        key = next(k for k in history[-1] if k not in ("step", "loss"))
        values = [h[key] for h in history if math.isfinite(h[key])]
        if values and max(values) - history[-1][key] > DRIFT:
            names.append("drift")
    if base is not None and details["C"]["mean_db"] < base["C"]["mean_db"]:
        names.append("below")
    return names


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(sources: dict[str, Source], settings: ShadingStudySettings) -> Plan:
    """Return the plan for the materials in the current variant."""
    contexts = {name: ShadingStudyContext(name, source, settings) for name, source in sources.items()}
    candidates: list[Candidate] = []
    for context in contexts.values():
        context.jobs = {job.name: job for job in shading_jobs(context)}
        candidates += shading_candidates(context)
    sizes = ", ".join(f"{name} ({s.width} × {s.height})" for name, s in sources.items())
    request = json.loads(json.dumps(asdict(settings)))
    digests = {name: s.digest for name, s in sources.items()}
    measures = [Measure(f"{letter}{' coarse' * coarse}", f"{letter.lower()}_{'coarse' if coarse else 'mean'}_db")
                for letter in "CP" for coarse in (False, True)]  # fmt: skip
    return Plan(
        study="shading",
        title="Textures trained for their shading",
        candidates=candidates,
        cases=[],
        queries=(),
        accuracy="c_mean_db",
        accuracy_label="PSNR of shaded values against converged truth, mean of levels, dB",
        details={
            "sources": digests,
            "request": request,
            "evaluation": "3 levels, 2 pairs" if settings.quick else "6 levels, 16 pairs of a view and a light",
        },
        notes=[
            *codecs.install_notes(["astc"]),
            f"{sizes}; {settings.compression:g}x, {settings.pretraining:g} {settings.unit} of training as a texture, "
            f"then {settings.length:g} {settings.unit} for shading; C: converged truth, P: the paper's reference.",
        ],
        jobs=[job for context in contexts.values() for job in context.jobs.values()],
        jobs_fingerprint=f"{digests} {request}",
        pictures={
            "png": draw_lambdas,
            "levels": draw_levels,
            "strip": lambda result: draw_crops(contexts, result),
            "zoom": lambda result: draw_zoom(contexts, result),
        },
        sampled=False,
        measures=(
            *measures,
            Measure("FLIP", "c_flip", ".4f", False),
            Measure("flicker", "flicker_error", ".2e", False),
        ),
        conclusions=conclusions,
    )


def shading_jobs(context: ShadingStudyContext) -> list[Contender]:
    """Return the jobs of a material in their order: cheap ones first, then all λ of each seed."""
    source, settings, pyramid, effects = context.source, context.settings, context.pyramid, context.effects

    @cache
    def bake() -> list[np.ndarray]:
        return normals.bake(pyramid, effects, 4 if settings.quick else normals.PAIRS)

    filters = {
        "filtered": lambda: normals.reader(pyramid, effects),
        "Toksvig": lambda: normals.toksvig(source, pyramid, effects),
        "LEAN": lambda: normals.lean(source, pyramid, effects),
        "baked": lambda: normals.roughness_reader(pyramid, effects, bake()),
    }
    best = context.best_levels
    classical = {
        "filtered": filters["filtered"], "kernel": lambda: best(filters["filtered"]()), "Toksvig": filters["Toksvig"],
        "LEAN": filters["LEAN"], "LEAN, kernel": lambda: best(normals.lean(source, pyramid, effects, True)),
        "baked": filters["baked"], "baked, kernel": lambda: best(filters["baked"]()),
    }  # fmt: skip
    roughness = {
        "Toksvig": lambda: normals.with_roughness(pyramid, normals.toksvig_levels(source, pyramid)),
        "baked": lambda: normals.with_roughness(pyramid, bake()),
    }
    if settings.preset == "paper":  # its figure has no further filters
        classical, roughness = {"filtered": classical["filtered"]}, {}
    elif settings.quick:
        del classical["baked, kernel"], roughness["baked"]
    jobs = [
        context.classical(label, lambda job, build=build: build(), 6 if label.startswith("LEAN") else 0)
        for label, build in classical.items()
    ]
    for label, levels in roughness.items():
        jobs.append(context.compressed(f"{label}, compressed", levels))
        if label == "baked":
            jobs.append(context.biased("baked, kernel, compressed", jobs[-1]))
    with_astc = roughness and "astc" in codecs.available() and not settings.quick
    for label, levels in {"filtered": lambda: pyramid, **roughness}.items() if with_astc else ():
        jobs.append(context.encoded(f"{label}, ASTC", levels))
        if label != "Toksvig":
            jobs.append(context.biased(f"{label}, kernel, ASTC".removeprefix("filtered, "), jobs[-1]))
    for seed in range(settings.seeds):
        start, bases = context.start(seed), {}
        jobs.append(start)
        for share in settings.lambdas:
            for way in settings.ways:
                if share == 0 and way.schedule in bases:
                    continue  # without a shading loss, there is nothing to clip
                run = context.run(start, way, share, seed, bases.get(way.schedule))
                jobs.append(run)
                if share == 0:
                    if not bases and seed == 0:
                        jobs.append(context.biased("kernel, compressed", run))
                    bases[way.schedule] = run
        if settings.extras:
            way, start = settings.ways[0], context.start(seed, True)
            run = context.run(start, way, settings.recipe.share, seed, bases[way.schedule], True)
            jobs += [start, run]
    return jobs


def shading_candidates(context: ShadingStudyContext) -> list[Candidate]:
    """Return the candidates of a material; runs of all seeds are one."""
    candidates, groups = [], {}
    for job in context.jobs.values():
        if job.label:
            candidates.append(_candidate(context, job.name, [job], job.label, {"kind": job.label}))
        elif job.method == "run":
            groups.setdefault((job.details["share"], job.details["way"]), []).append(job)
    for (share, way), runs in groups.items():
        details = {"lambda": share, "way": way.name, "kind": "run"}
        name = f"{context.name}, lambda {share:g}, {way.name}"
        candidates.append(_candidate(context, name, runs, "lambda", details))
    return candidates


def _candidate(context: ShadingStudyContext, name: str, jobs: list, representation: str, details: dict) -> Candidate:
    """Return the candidate of the runs of all seeds; its bytes, seconds and flicker are those of the first seed."""

    def errors(samples: int) -> dict[str, float]:
        records, values = [job.record["details"] for job in jobs], {}
        for letter in "CP":
            for key in ("mean_db", "coarse_db"):
                psnr = [d[letter][key] for d in records]
                name = f"{letter.lower()}_{key}"
                values |= {name: float(np.mean(psnr)), f"{name}_low": min(psnr), f"{name}_high": max(psnr)}
            flips = [np.mean(d[letter]["flip"]) for d in records if d[letter]["flip"]]
            if flips:
                values[f"{letter.lower()}_flip"] = float(np.mean(flips))
            for i in range(len(records[0][letter]["psnr_db"])):
                values[f"{letter.lower()}_l{i}_db"] = float(np.mean([d[letter]["psnr_db"][i] for d in records]))
        return {**values, **context.zoom.errors(context.zoom.render(jobs[0].model), context.zoom.truth)}

    return Candidate(
        name, representation, job=jobs[0].name, errors=errors, details={**details, "material": context.name}
    )


# -- Conclusions and pictures ------------------------------------------------------------------------------------------

#: Line style of each classical filter.
CLASSICAL = {"filtered": ":", "kernel": (0, (1, 3)), "Toksvig": (0, (5, 1)), "LEAN": "--", "LEAN, kernel": (0, (6, 2)),
             "baked": "-."}  # fmt: skip

#: Level of detail of the crops, and their largest side in texels.
CROP_LEVEL = 3
CROP_SIDE = 48


@dataclass
class MaterialCurves:
    """Records of a material: ``classical``, ``compressed``, ``extras`` (by label), ``runs`` (by remedies and λ).

    ``runs`` has the details of all seeds; those of λ = 0 stand under all remedies that they are the base of.
    """

    name: str
    classical: dict[str, dict] = field(default_factory=dict)
    compressed: dict[str, dict] = field(default_factory=dict)
    extras: dict[str, dict] = field(default_factory=dict)
    runs: dict[tuple[str, float], list[dict]] = field(default_factory=dict)

    @property
    def remedies(self) -> list[str]:
        return list(dict.fromkeys(remedy for remedy, share in self.runs if share > 0))

    def shares(self, remedy: str) -> list[float]:
        return sorted(share for r, share in self.runs if r == remedy)

    def values(self, remedy: str, share: float, letter: str = "C", key: str = "mean_db") -> list[float]:
        """Return ``mean_db``, ``coarse_db`` or ``flip`` of each seed."""
        errors = [d[letter] for d in self.runs.get((remedy, share), [])]
        return [float(np.mean(e["flip"])) if key == "flip" else e[key] for e in errors if e.get(key)]

    def mean(self, *key) -> float:
        values = self.values(*key)
        return float(np.mean(values)) if values else float("nan")

    def levels(self, remedy: str, share: float, letter: str = "C") -> np.ndarray:
        """Return the PSNR of each level, averaged over seeds."""
        return np.mean([d[letter]["psnr_db"] for d in self.runs[remedy, share]], axis=0)

    def best(self) -> tuple[str, float] | None:
        """Return the remedies and λ > 0 with the best mean against C, of those with a run of λ = 0, or ``None``."""
        keys = [(remedy, s) for remedy, s in self.runs if s > 0 and (remedy, 0.0) in self.runs]
        return max(keys, key=lambda key: self.mean(*key), default=None)

    @property
    def best_classical(self) -> str | None:
        """The best classical filter against C, uncompressed."""
        filters = [label for label in self.classical if label != "filtered"]
        return max(filters, key=lambda label: self.classical[label]["C"]["mean_db"], default=None)


def curves(result: dict) -> dict[str, MaterialCurves]:
    """Return the records of all materials with any measurement, by name."""
    materials: dict[str, MaterialCurves] = {}
    for record in result["jobs"].values():
        d = record.get("details", {})
        if "material" not in d:
            continue
        material = materials.setdefault(d["material"], MaterialCurves(d["material"]))
        if d["kind"] in ("classical", "compressed", "extras"):
            getattr(material, d["kind"])[d["label"]] = d
        elif d["kind"] == "run":
            material.runs.setdefault((d["way"], d["share"]), []).append(d)
    for material in materials.values():
        bases = {d["schedule"]: remedy for (remedy, share), ds in material.runs.items() if share == 0 for d in ds}
        for remedy in material.remedies:
            schedule = next(ds[0]["schedule"] for (r, s), ds in material.runs.items() if r == remedy and s > 0)
            if schedule in bases:
                material.runs[remedy, 0.0] = material.runs[bases[schedule], 0.0]
    return materials


def trouble(runs: list[dict]) -> str:
    """Return the names of troubles, each with the number of runs."""
    names = [name for d in runs for name in d.get("trouble", [])]
    return ", ".join(f"{name} {names.count(name)}" for name in dict.fromkeys(names))


def conclusions(result: dict) -> list[str]:
    """Return a line for each material and combination of remedies: gains of each λ over λ = 0, and troubles."""
    lines = []
    for material in curves(result).values():
        for way in material.remedies:
            shares = [share for share in material.shares(way) if share > 0]
            runs = [d for share in shares for d in material.runs[way, share]]
            for letter in "CP":
                base = material.mean(way, 0.0, letter)
                gains = ", ".join(f"{material.mean(way, s, letter) - base:+.2f} dB at {s:g}" for s in shares)
                lines.append(f"{material.name}, {way}: over lambda = 0, against {letter}, {gains}")
            lines.append(f"{material.name}, {way}: of {len(runs)} runs, trouble: {trouble(runs) or 'none'}")
    return lines


def _classical_curves(material: MaterialCurves, x: Callable[[dict], tuple[Sequence, Sequence]]) -> list[plot.Curve]:
    """Return the curves of classical filters; ``x(details)`` returns both coordinates."""
    labels = [label for label in CLASSICAL if label in material.classical]
    return [
        plot.Curve(f"{label}, uncompressed", *x(material.classical[label]),
                   style={"linestyle": CLASSICAL[label], "color": f"{0.12 * i}", "marker": ""})
        for i, label in enumerate(labels)
    ]  # fmt: skip


def _draw_both(result: dict, title: str, draw: Callable, x_label: str, ticks: Sequence[str] = ()):
    """Return a figure with a row for each material and a column for each truth."""
    panels = {
        f"{material.name}, against {truth} ({letter})": draw(material, letter)
        for material in curves(result).values()
        for letter, truth in (("C", "converged truth"), ("P", "the paper's reference"))
    }
    caption, label = figure_caption(result), "PSNR of shaded values, dB"
    return plot.draw_curves(result["title"] + title, caption, panels, x_label, label, ticks=ticks)


def draw_lambdas(result: dict):
    """Draw PSNR over λ for all remedies, with bars over seeds, beside classical filters."""
    shares = sorted({s for material in curves(result).values() for _, s in material.runs})

    def draw(material: MaterialCurves, letter: str) -> list[plot.Curve]:
        drawn = []
        for way in material.remedies:
            values = {shares.index(s): material.values(way, s, letter) for s in material.shares(way)}
            troubled = trouble([d for s in material.shares(way) if s for d in material.runs[way, s]])
            ends = [[end(v) for v in values.values()] for end in (np.mean, min, max)]
            drawn.append(plot.Curve(f"{way} ({troubled or 'no trouble'})", list(values), *ends))
        last = len(shares) - 1
        drawn += _classical_curves(material, lambda d: ((0, last), [d[letter]["mean_db"]] * 2))
        for label, d in material.compressed.items():
            style = {"marker": "*", "markersize": 8, "linestyle": "", "color": "0.3"}
            drawn.append(plot.Curve(label, [0], [d[letter]["mean_db"]], style=style))
        return drawn

    return _draw_both(result, "", draw, "λ, weight of the shading loss", [f"{s:g}" for s in shares])


def draw_levels(result: dict):
    """Draw PSNR by level of detail of λ = 0, the best λ and classical filters."""

    def draw(material: MaterialCurves, letter: str) -> list[plot.Curve]:
        def by_level(psnr) -> tuple:
            return range(len(psnr)), psnr

        trained = [plot.Curve(f"λ {share:g}", *by_level(material.levels(way, share, letter)))
                   for way, share in _shown(material)]  # fmt: skip
        return trained + _classical_curves(material, lambda d: by_level(d[letter]["psnr_db"]))

    return _draw_both(result, ": levels of detail", draw, "level of detail")


def _shown(material: MaterialCurves) -> list[tuple[str, float]]:
    """Return λ = 0 and the best λ, each with its remedies."""
    best = material.best()
    return [] if best is None else [(best[0], 0.0), best]


def _readers(material: MaterialCurves, context: ShadingStudyContext) -> dict[str, ShadedReader]:
    """Return the readers in crops and zooms: filtered parameters, the best classical filter, λ = 0, the best λ."""
    best = material.best_classical
    jobs = {"parameters filtered": "filtered"} if "filtered" in material.classical else {}
    jobs |= {f"{best}, uncompressed": best} if best is not None else {}
    for way, share in _shown(material):
        d = material.runs[way, share][0]
        jobs[f"λ {share:g}, compressed"] = f"lambda {share:g}, {d['way']}, seed {d['seed']}"
    return {text: context.jobs[f"{material.name}, {job}"].model for text, job in jobs.items()}


def draw_crops(contexts: dict[str, ShadingStudyContext], result: dict):
    """Draw crops of a minified level: filtered parameters, the best classical filter, λ = 0, the best λ, the truth."""
    rows = {}
    for material in curves(result).values():
        evaluation = contexts[material.name].evaluation
        level = min(CROP_LEVEL, evaluation.levels - 1)
        truths = evaluation.truths["C"][level].clip(0, 1)
        readers = _readers(material, contexts[material.name])
        images = {text: evaluation.images(read, level).clip(0, 1) for text, read in readers.items()}
        first = next(iter(images.values()))
        pair = int(np.argmax(((first - truths) ** 2).mean(axis=(1, 2, 3))))  # with the largest error of the filter
        side = min(CROP_SIDE, *truths.shape[1:3])
        texts = {f"{t}\n{decibel(float(np.mean((i[pair] - truths[pair]) ** 2))):.1f} dB": i for t, i in images.items()}
        crops = {text: srgb.for_display(i[pair, :side, :side]) for text, i in {**texts, "truth": truths}.items()}
        rows[f"{material.name}, level {level}"] = crops
    return plot.draw_images(f"{result['title']}: crops", figure_caption(result), rows)


def draw_zoom(contexts: dict[str, ShadingStudyContext], result: dict):
    """Draw frames of the zoom of the first material."""
    material = next(iter(curves(result).values()))
    context = contexts[material.name]
    strips = {text: context.zoom.render(read) for text, read in _readers(material, context).items()}
    title = f"{result['title']}: {material.name}, a zoom of {context.zoom.frames} frames"
    rows = context.zoom.rows({**strips, "truth": context.zoom.truth})
    return plot.draw_images(title, figure_caption(result), rows, 2.0)
