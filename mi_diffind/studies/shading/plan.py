"""Plan of the shading study: textures trained for shading at several weights λ, and classical filters of normals.

For each material, a texture is trained as task 4 trains it, and then continued for the same time by task 5 at several
weights λ of the shading loss; λ = 0 continues task 4. Two remedies against instability at a large λ are on or off:
clipped derivatives through the specular lobe, and a falling learning rate. All runs are repeated for several seeds.

Classical filters of normals (:mod:`..baselines.normals`) are measured uncompressed; those that an ordinary texture can
hold, Toksvig's and baked roughness, also compressed as λ = 0 is, in as much time, and by ASTC in equal bytes. LEAN's
moments have no limits, which encoders of bytes need. The *kernel* control reads at other levels of detail, those with
the smallest error; compressed textures are read in this way, too.

*Errors* are those of :class:`~mi_diffind.tasks.shading.evaluation.ShadedEvaluation`: PSNR of shaded values and FLIP,
under views and lights of no training, against C, the converged truth, and P, the paper's reference. *Flicker*:
:mod:`.zoom`.

A run is in *trouble* if its loss became NaN or exploded and it was restarted (``restarts``), or given up (``diverged``:
its result is its start); if a measurement was not finite (``nan``); if the loss exceeded ten times its median
(``spike``); if its end is more than :data:`DRIFT` dB below its best state (``drift``); or if its end is below λ = 0 of
the same seed (``below``).
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ...arrays.tables import Table, save_table
from ...core.files import replacing
from ...core.progress import Deadline
from ...fitting import task
from ...fitting.loop import FitResult
from ...fitting.settings import FitSettings, FittingError
from ...maps.pyramid import Pyramid
from ...maps.source import Source, SourceError, load_source
from ...measure.store import file_name
from ...measure.study import Candidate, Plan
from ...tasks import shading
from ...tasks import texture as texture_presets
from ...tasks.shading import fit as shading_fit
from ...tasks.shading.evaluation import ShadedEvaluation, ShadedReader, reader
from ...tasks.shading.material import effects_of, frozen_decoder
from ...tasks.shading.training import ShadingProblem, fit_shading, start_of
from ...tasks.texture import training as textures
from ...tasks.texture.compressed import CompressedTexture
from ...tasks.texture.fit import size_of
from ..baselines import codecs, normals
from ..equal_memory import Contender, StudyContext, load_arrays
from ..texture import levels as texture_levels
from . import pictures
from .conclusions import conclusions, table
from .materials import MATERIALS, generated_source
from .zoom import ShadedZoom

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

    ``lambdas`` are the weights λ, 0 among them, ``ways`` the combinations of remedies, ``seeds`` the number of seeds,
    ``sweep_seeds`` that of weights other than 0 and the preset's. ``preset`` is the recipe: the paper's has neither
    validation nor level bias, and ends in its last state. ``extras``: also train, with the preset's λ, arrays
    that leave room for extras, for as many seeds as the other weights.
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
    sweep_seeds: int = 3
    preset: str = "ours"
    extras: bool = False

    @property
    def recipe(self) -> shading.ShadingRecipe:
        return shading.PRESETS[self.preset]


def materials_of(names: Sequence[str], side: int, quick: bool = False) -> dict[str, Source]:
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


@dataclass
class ShadingStudyContext(StudyContext):
    """A material, the data that its contenders share, and their jobs by name."""

    name: str
    source: Source
    settings: ShadingStudySettings
    jobs: dict[str, ShadingContender] = field(default_factory=dict)

    @cached_property
    def recipe(self):
        return texture_presets.PRESETS[self.settings.recipe.texture]

    @cached_property
    def pyramid(self) -> Pyramid:
        return Pyramid.of(self.source, textures.layout_of(self.source, self.recipe), self.types)

    @cached_property
    def effects(self):
        return effects_of(self.pyramid.layout)[0]

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

    def reader_of(self, table: Table) -> ShadedReader:
        """Return the reader of a compressed texture, shaded by the tables of the BRDF that it was trained through."""
        return reader(CompressedTexture.of(table, self.types.TensorXf), self.effects, self.decoder)

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
        return task.FitRequest(preset, settings, self.types, deadline=seconds and Deadline(seconds), progress=progress,
                               options=options)  # fmt: skip

    def fit_texture(
        self, pyramid: Pyramid, length: float, seed: int, progress: bool, extras: bool = False
    ) -> tuple[Table, FitResult]:
        """Train a texture at our rate, with which it converges soonest, on a pyramid in place of the source's.

        With ``extras``, the arrays leave room for them.
        """
        request = self.request(texture_presets.PRESETS["ours"].settings, length, seed, progress)
        recipe = dataclasses.replace(self.recipe, settings=request.settings)
        nbytes = self.source.nbytes / self.settings.compression
        nbytes = shading_fit.bytes_beside_extras(nbytes, pyramid) if extras else nbytes
        size = size_of(self.source, pyramid, nbytes, recipe, request.options)
        problem = textures.problem_of(self.source, size, recipe, pyramid)
        result = request.train(problem, f"{self.name}: texture, seed {seed}")
        stored = CompressedTexture(pyramid.layout, textures.stored_form(problem.net))
        trained = textures.to_table(stored, {**request.recorded(), "source": self.source.digest, "steps": result.steps})
        trained.preset, trained.seed = self.settings.preset, seed
        return trained, result


@dataclass
class ShadingContender(Contender):
    """A filter or a training of a material; its ``model`` is a reader of shaded values, its ``record`` has errors."""

    label: str = ""
    record: dict | None = None

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        self.record = super().cached_record(folder, record)
        return self.record

    def measure(self, nbytes: int, start: float, **details) -> dict:
        """Measure ``model``; return the record of a job that began at ``start``."""
        errors = self.context.evaluation.measure(self.model)
        details = {"material": self.context.name, **errors, "kind": self.method, **details}
        details |= {"label": self.label} if self.label else {}
        self.record = {"bytes": nbytes, "seconds": time.perf_counter() - start, "details": details}
        return self.record


@dataclass
class ClassicalFilter(ShadingContender):
    """An uncompressed filter: ``build(folder)`` returns its reader; it needs ``channels`` beside those of the maps."""

    has_file = False
    build: Callable[[Path | None], ShadedReader] = lambda folder: None
    channels: int = 0

    def load(self, path: Path | None) -> ShadedReader:
        return self.build(path.parent if path else None)

    def run(self, folder: Path | None, progress: bool) -> dict:
        start, pyramid = time.perf_counter(), self.context.pyramid
        return self.measure(pyramid.nbytes + self.channels * sum(v[..., 0].size for v in pyramid.values), start)


@dataclass
class EncodedFilter(ShadingContender):
    """A classical filter whose levels ASTC stores in the bytes of the trainings."""

    has_file = False
    pyramid: Callable[[Path | None], Pyramid] = lambda folder: None

    @cached_property
    def encoded(self) -> tuple[Pyramid, int]:
        """The decoded levels, and their bytes."""
        pyramid = self.pyramid(self.file.parent if self.file else None)
        names = [m.name for m in pyramid.layout.maps if m.role == "normal"]
        nbytes = int(self.context.source.nbytes / self.budget)
        levels, nbytes = codecs.astc_levels(texture_levels.images(pyramid), nbytes, "thorough", names)
        return texture_levels.pyramid_of({name: e.levels for name, e in levels.items()}, pyramid), nbytes

    def load(self, path: Path | None) -> ShadedReader:
        return normals.reader(self.encoded[0], self.context.effects)

    def run(self, folder: Path | None, progress: bool) -> dict:
        return self.measure(self.encoded[1], time.perf_counter())


@dataclass
class ShadingTraining(ShadingContender):
    """A trained texture; its table stays in the folder of models."""

    @cached_property
    def table(self) -> Table:
        return task.tasks()["texture"].load(self.file)

    def load(self, path: Path) -> ShadedReader:
        return self.context.reader_of(self.table)

    def measure_table(self, table: Table, result: FitResult, start: float, **details) -> dict | None:
        """Store and measure a trained table, unless the training was interrupted; return the record."""
        if result.interrupted:
            return None
        self.table = table
        if self.file is not None:
            save_table(self.file, table)
        self.model = self.context.reader_of(table)
        training = {"steps": result.steps, "kept_step": result.step, "restarts": result.restarts,
                    "history": result.history, "training_seconds": result.seconds}  # fmt: skip
        return self.measure(table.nbytes, start, **training, **details)


@dataclass
class TextureStart(ShadingTraining):
    """A texture trained as task 4 trains it: the start of the runs of a seed."""

    seed: int = 0
    extras: bool = False

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        start, context, length = time.perf_counter(), self.context, self.context.settings.pretraining
        trained, result = context.fit_texture(context.pyramid, length, self.seed, progress, self.extras)
        return self.measure_table(trained, result, start, seed=self.seed)


@dataclass
class CompressedFilter(ShadingTraining):
    """A texture of task 4 trained on the pyramid of a classical filter, for the time of start and run together."""

    pyramid: Callable[[Path | None], Pyramid] = lambda folder: None

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        start, settings = time.perf_counter(), self.context.settings
        length = settings.pretraining + settings.length
        trained, result = self.context.fit_texture(self.pyramid(folder), length, 0, progress)
        return self.measure_table(trained, result, start)


@dataclass
class ShadingRun(ShadingTraining):
    """A training for shading with weight ``share``; ``base`` is the run of the same seed with λ = 0.

    λ = 0 is read at the level of the footprint; for other λ, the training chooses the level bias, and with ``extras``
    whether there are any.
    """

    start: TextureStart | None = None
    remedies: Remedies = REMEDIES[0]
    share: float = 0.0
    seed: int = 0
    base: ShadingRun | None = None
    extras: bool = False

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        begin, context, preset = time.perf_counter(), self.context, self.context.settings.recipe
        schedule = "cosine" if self.remedies.schedule else "constant"
        settings = dataclasses.replace(preset.settings, schedule=schedule)
        request = context.request(settings, context.settings.length, self.seed, progress)
        clip = (preset.clip or CLIP) if self.remedies.clip else None
        bias = preset.level_bias if self.share else 0.0
        recipe = dataclasses.replace(preset, share=self.share, clip=clip, level_bias=bias, extras=self.extras,
                                     settings=request.settings)  # fmt: skip
        net = start_of(self.start.table, context.pyramid)
        try:
            fit = fit_shading if preset.bounded else fit_to_the_end
            trained, result = fit(context.source, net, recipe, request, context.pyramid, context.evaluation)
        except FittingError:  # diverged repeatedly: the result is the start
            trained, result = self.start.table, FitResult({}, 0, 0, 0.0, False, 0, [])
        details = {"share": self.share, "clip": self.remedies.clip, "schedule": self.remedies.schedule,
                   "seed": self.seed, "way": self.remedies.name,
                   "level_bias": trained.settings.get("level_bias", 0.0)}  # fmt: skip
        if self.extras:
            details["has_extras"] = trained.settings.get("shading", {}).get("extras", False)
        record = self.measure_table(trained, result, begin, **details)
        if record is not None:
            base = self.base.record["details"] if self.base is not None and self.base.record else None
            record["details"]["trouble"] = troubles(record["details"], base)
        return record


def fit_to_the_end(source, net, recipe, request, pyramid: Pyramid, evaluation: ShadedEvaluation) -> tuple:
    """Train as the paper does, without validation; return the table of the last state and the run's record."""
    problem = ShadingProblem(net, pyramid, recipe, source.digest, evaluation.another())
    problem.tolerance = math.inf
    result = request.train(problem, "shading")
    stored = CompressedTexture(pyramid.layout, textures.stored_form(problem.net))
    return textures.to_table(stored, {**request.recorded(), "source": source.digest}), result


@dataclass
class BiasedRun(ShadingContender):
    """A compressed texture read at the levels of detail that suit the truth's kernel best; nothing is trained."""

    has_file = False
    base: ShadingContender | None = None
    biased: Callable = lambda build: build

    def load(self, path: Path | None) -> ShadedReader:
        return self.biased(lambda folder: self.base.model)(None)

    def run(self, folder: Path | None, progress: bool) -> dict:
        return self.measure(self.base.record["bytes"], time.perf_counter())


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


def plan(sources: dict[str, Source], settings: ShadingStudySettings) -> Plan:
    """Return the plan for the materials in the current variant."""
    contexts = {name: ShadingStudyContext(name, source, settings) for name, source in sources.items()}
    candidates: list[Candidate] = []
    for context in contexts.values():
        context.jobs = {job.name: job for job in _jobs(context)}
        candidates += _candidates(context)
    sizes = ", ".join(f"{name} ({s.width} × {s.height})" for name, s in sources.items())
    request = json.loads(json.dumps(asdict(settings)))
    digests = {name: s.digest for name, s in sources.items()}
    evaluation = "3 levels, 2 pairs" if settings.quick else "6 levels, 16 pairs of a view and a light"
    return Plan(
        study="shading",
        title="Textures trained for their shading",
        candidates=candidates,
        cases=[],
        queries=(),
        accuracy="c_mean_db",
        accuracy_label="PSNR of shaded values against converged truth, mean of levels, dB",
        details={"sources": digests, "request": request, "evaluation": evaluation},
        notes=[
            *codecs.install_notes(["astc"]),
            f"{sizes}; {settings.compression:g}x, {settings.pretraining:g} {settings.unit} of training as a texture, "
            f"then {settings.length:g} {settings.unit} for shading; C: converged truth, P: the paper's reference.",
        ],
        jobs=[job for context in contexts.values() for job in context.jobs.values()],
        jobs_fingerprint=f"{digests} {request}",
        pictures=pictures.pictures_of(contexts),
        sampled=False,
        table=table,
        conclusions=conclusions,
    )


def _jobs(context: ShadingStudyContext) -> list[ShadingContender]:
    """Return the jobs of a material in their order: cheap ones first, then all λ of each seed."""
    name, source, settings = context.name, context.source, context.settings
    jobs: list[ShadingContender] = []

    def bake(folder: Path | None) -> list[np.ndarray]:
        """Return the fitted roughness, kept in the folder."""
        if folder is None:
            return normals.bake(context.pyramid, context.effects, 4 if settings.quick else normals.PAIRS)
        file = folder / f"{file_name(name)}_roughness.npz"
        if not file.is_file():
            levels = bake(None)
            with replacing(file) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, *levels)
        return list(load_arrays(file).values())

    def biased(build: Callable[[Path | None], ShadedReader]) -> Callable[[Path | None], ShadedReader]:
        """Return the filter read at the levels of detail with the smallest error."""

        def build_biased(folder: Path | None) -> ShadedReader:
            read, places = build(folder), 2**10 if settings.quick else normals.PLACES
            return normals.biased(read, normals.choose_biases(read, context.pyramid, context.effects, places))

        return build_biased

    def filtered(folder: Path | None) -> ShadedReader:
        return normals.reader(context.pyramid, context.effects)

    def baked(folder: Path | None) -> ShadedReader:
        return normals.roughness_reader(context.pyramid, context.effects, bake(folder))

    classical = [
        ("filtered", filtered, 0), ("kernel", biased(filtered), 0),
        ("Toksvig", lambda folder: normals.toksvig(source, context.pyramid, context.effects), 0),
        ("LEAN", lambda folder: normals.lean(source, context.pyramid, context.effects), 6),
        ("LEAN, kernel", biased(lambda folder: normals.lean(source, context.pyramid, context.effects, True)), 6),
        ("baked", baked, 0), *([] if settings.quick else [("baked, kernel", biased(baked), 0)]),
    ]  # fmt: skip
    roughness = {"Toksvig, compressed": lambda folder: normals.toksvig_levels(source, context.pyramid)}
    if settings.preset == "paper":  # its figure has no further filters
        classical, roughness = classical[:1], {}
    elif not settings.quick:
        roughness["baked, compressed"] = bake
    for label, build, channels in classical:
        jobs.append(
            ClassicalFilter("classical", 1, context, f"{name}, {label}", label=label, build=build, channels=channels)
        )
    pyramids = {"filtered, compressed": lambda folder: context.pyramid} if roughness else {}
    for label, levels in roughness.items():
        pyramid = lambda folder, levels=levels: normals.with_roughness(context.pyramid, levels(folder))  # noqa: E731
        pyramids[label] = pyramid
        jobs.append(
            CompressedFilter("compressed", settings.compression, context, f"{name}, {label}", label=label,
                             pyramid=pyramid)
        )  # fmt: skip
    if "baked, compressed" in roughness:
        label = "baked, kernel, compressed"
        jobs.append(BiasedRun("compressed", settings.compression, context, f"{name}, {label}", label=label,
                              base=jobs[-1], biased=biased))  # fmt: skip
    for label, pyramid in pyramids.items() if "astc" in codecs.available() and not settings.quick else ():
        label = label.replace("compressed", "ASTC")
        jobs.append(EncodedFilter("compressed", settings.compression, context, f"{name}, {label}", label=label,
                                  pyramid=pyramid))  # fmt: skip
        if not label.startswith("Toksvig"):
            label = label.replace("ASTC", "kernel, ASTC").removeprefix("filtered, ")
            jobs.append(BiasedRun("compressed", settings.compression, context, f"{name}, {label}", label=label,
                                  base=jobs[-1], biased=biased))  # fmt: skip
    for seed in range(settings.seeds):
        start = TextureStart("start", settings.compression, context, f"{name}, texture, seed {seed}", seed=seed)
        jobs.append(start)
        bases: dict[bool, ShadingRun] = {}
        for share in settings.lambdas:
            if share not in (0.0, settings.recipe.share) and seed >= settings.sweep_seeds:
                continue
            for way in settings.ways:
                if share == 0 and way.schedule in bases:
                    continue  # without a shading loss, there is nothing to clip
                run = ShadingRun(
                    "run", settings.compression, context, f"{name}, lambda {share:g}, {way.name}, seed {seed}",
                    start=start, remedies=way, share=share, seed=seed, base=bases.get(way.schedule),
                )  # fmt: skip
                jobs.append(run)
                if share == 0:
                    if not bases and seed == 0:
                        label = "kernel, compressed"
                        jobs.append(
                            BiasedRun("compressed", settings.compression, context, f"{name}, {label}", label=label,
                                      base=run, biased=biased)
                        )  # fmt: skip
                    bases[way.schedule] = run
        if settings.extras and seed < settings.sweep_seeds:
            way, share, label = settings.ways[0], settings.recipe.share, f"extras, seed {seed}"
            start = TextureStart("start", settings.compression, context, f"{name}, texture beside {label}", seed=seed,
                                 extras=True)  # fmt: skip
            run = ShadingRun("extras", settings.compression, context, f"{name}, {label}", label=label, start=start,
                             remedies=way, share=share, seed=seed, base=bases[way.schedule], extras=True)  # fmt: skip
            jobs += [start, run]
    return jobs


def _candidates(context: ShadingStudyContext) -> list[Candidate]:
    candidates, groups = [], {}
    for job in context.jobs.values():
        if job.label:
            candidates.append(_candidate(context, job.name, [job], job.label, {"kind": job.label}))
        elif isinstance(job, ShadingRun):
            groups.setdefault((job.share, job.remedies), []).append(job)
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
