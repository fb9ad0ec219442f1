"""
What the study of shading compares, and how.

For each material, a texture is trained as task 4 has it, and gone on with from there for the same time each: by task 5,
at several weights λ of the shading loss, λ = 0 among them, which is more of task 4. Two remedies of what is unstable at
a large λ are on or off: derivatives that are clipped on their way through the specular lobe, and a learning rate that
falls. All of it for several seeds, those of λ = 0 too.

Beside them stand classical filters of normals (:mod:`..baselines.normals`), uncompressed, and those that an ordinary
texture can hold, compressed as λ = 0 is, with as much time: Toksvig's and baked roughness. The *kernel* control reads
at other levels of detail, those with which it errs least; λ = 0 is read so, too.

*Errors* are those of :class:`.ShadedEvaluation`: PSNR of shaded values and FLIP, under
views and lights of no training, against C, converged, and P, the paper's reference. *Flicker*: :mod:`.motion`.

A run is in *trouble* if its loss became NaN or exploded, so that it was restarted (``restarts``), or given up
(``diverged``: what counts then is where it started from); if a measurement was not finite (``nan``); if the loss was
above ten times its median (``spike``); if in the end it was worse than on the way (``drift``, more than :data:`DRIFT`
dB); or if it ends below λ = 0 of the same seed (``below``).
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

import mitsuba as mi
import numpy as np

from ... import task
from ...files import replacing
from ...fitting import FitResult
from ...maps.pyramid import Pyramid
from ...maps.source import Source, SourceError, load_source
from ...measure.store import file_name
from ...measure.study import Candidate, Job, Plan
from ...runtime import array_module
from ...settings import FitSettings, FittingError
from ...tables import Table, save_table
from ...tasks.shading import presets
from ...tasks.shading.evaluation import ShadedEvaluation, ShadedReader, reader
from ...tasks.shading.material import effects_of, frozen_decoder
from ...tasks.shading.training import fit_shading, start_of
from ...tasks.texture import presets as texture_presets
from ...tasks.texture import training as textures
from ...tasks.texture.compressed import CompressedTexture
from ...tasks.texture.fit import size_of
from ..baselines import normals
from . import pictures
from .conclusions import conclusions, table
from .materials import MADE, made
from .motion import Motion

#: The material that ships.
SHIPPED = "scenes/assets/tiles.json"

#: dB that a run may end below its best state.
DRIFT = 0.2

#: The specular lobe's derivatives are limited to this where they are, unless our preset says to what.
CLIP = 0.1


@dataclass(frozen=True)
class Way:
    """How it is trained: with clipped derivatives, with a rate that falls."""

    clip: bool
    schedule: bool

    @property
    def name(self) -> str:
        return f"{'clip' if self.clip else 'no clip'}, {'schedule' if self.schedule else 'no schedule'}"


#: Both remedies, one of them, none.
WAYS = (Way(True, True), Way(False, True), Way(True, False), Way(False, False))


@dataclass(frozen=True)
class Request:
    """
    What is asked for: ``lambdas``, 0 among them; ``ways``; ``seeds``, so many; the ``length`` of training for shading,
    and of ``pretraining``, training as a texture before it, in the ``unit`` ``"s"`` or ``"steps"``; ``compression``;
    ``frames`` of the zoom; ``quick``, a smoke run.
    """

    lambdas: tuple[float, ...]
    ways: tuple[Way, ...] = WAYS
    seeds: int = 3
    length: float = 15.0
    pretraining: float = 20.0
    compression: float = 12.0
    frames: int = 60
    quick: bool = False
    unit: str = "s"


def materials_of(given: Sequence[str], side: int, quick: bool = False) -> dict[str, Source]:
    """Name → source, of manifests and of materials that are made. Raises ``SourceError`` and ``ValueError``."""
    if not given:
        given = ["hammered"] if quick else [*([SHIPPED] if Path(SHIPPED).is_file() else []), *MADE]
    found = {}
    for text in given:
        name = text if text in MADE else Path(text).stem
        if name in found:
            raise ValueError(f'materials: found "{name}" twice')
        if text not in MADE and not text.endswith(".json"):
            raise SourceError(f'materials: found "{text}", allowed are manifests (.json) and {", ".join(MADE)}')
        found[name] = made(text, side) if text in MADE else load_source(text)
    return found


class _Images(ShadedEvaluation):
    """Images of a material; those by which trainings choose among their states are made once for all trainings."""

    _others: ShadedEvaluation | None = None

    def another(self) -> ShadedEvaluation:
        self._others = self._others or super().another()
        return self._others


# -- a material -------------------------------------------------------------------------------------------------------


@dataclass
class Setting:
    """A material, and what all of its candidates share; made when it is first asked for."""

    name: str
    source: Source
    request: Request
    #: What was made of it: name of a job → its reader.
    readers: dict[str, Callable[[], ShadedReader]] = field(default_factory=dict)

    @cached_property
    def types(self):
        return array_module(mi.variant())

    @cached_property
    def recipe(self):
        return texture_presets.PRESETS["ours"]

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
        levels, pairs, side = (3, 2, 16) if self.request.quick else (6, 16, 64)
        return _Images(self.pyramid, self.effects, levels, pairs, side)

    @cached_property
    def motion(self) -> Motion:
        return Motion(self.pyramid, self.effects, self.request.frames, 32 if self.request.quick else 96)

    def reader_of(self, table: Table) -> ShadedReader:
        """A compressed texture, shaded by the tables of the BRDF that it was trained through."""
        return reader(CompressedTexture.of(table, self.types.TensorXf), self.effects, self.decoder)

    def measured(self, read: ShadedReader) -> dict:
        """Errors of shaded images, for the details of a record."""
        return {"material": self.name, **self.evaluation.measure(read)}

    def training(self, settings: FitSettings, length: float, seed: int, progress: bool) -> task.FitRequest:
        """A request for a training of a ``length``, by ``settings`` as they are changed for it."""
        settings, seconds = dataclasses.replace(settings, seed=seed, deterministic=False), length
        if self.request.unit == "steps":
            every = max(1, int(length) // 10)
            settings, seconds = dataclasses.replace(settings, steps=int(length), measure_every=every), None
        return task.FitRequest("ours", settings, self.types, seconds=seconds, progress=progress, options=self.options)

    @cached_property
    def options(self) -> dict:
        """The options of task 4 that sizes are chosen by."""
        known = {argument.name: argument.default for argument in task.tasks()["texture"].arguments}
        return {**known, "compression": self.request.compression}

    def texture(self, pyramid: Pyramid, length: float, seed: int, progress: bool) -> tuple:
        """A training of task 4, on a pyramid in place of the source's: the table and the run's record."""
        request = self.training(self.recipe.settings, length, seed, progress)
        recipe = dataclasses.replace(self.recipe, settings=request.settings)
        nbytes = self.source.nbytes / self.request.compression
        size = size_of(self.source, pyramid, nbytes, recipe, self.options)
        problem = textures.problem_of(self.source, size, recipe, pyramid)
        result = request.train(problem, f"{self.name}: texture, seed {seed}")
        stored = CompressedTexture(pyramid.layout, textures.stored_form(problem.net))
        made = textures.to_table(stored, {**request.recorded(), "source": self.source.digest, "steps": result.steps})
        made.preset, made.seed = "ours", seed
        return made, result


# -- jobs -------------------------------------------------------------------------------------------------------------


@dataclass
class _Made(Job):
    """Something that is measured when it is made; ``record`` stays with it."""

    name: str
    setting: Setting
    record: dict | None = None

    def kept(self, nbytes: int, start: float, read: ShadedReader, **details) -> dict:
        """The record of what was made since ``start``."""
        found = {**self.setting.measured(read), **details}
        self.record = {"bytes": nbytes, "seconds": time.perf_counter() - start, "details": found}
        return self.record


@dataclass
class _Classical(_Made):
    """A classical filter, uncompressed: ``make`` its reader; it needs ``channels`` beyond the maps of a mip map."""

    label: str = ""
    make: Callable[[Path | None], ShadedReader] = lambda folder: None
    channels: int = 0

    def cached_record(self, folder, record):
        self.record = record
        if record is not None:
            self.setting.readers[self.name] = lambda: self.make(folder)
        return record

    def run(self, folder, progress):
        start = time.perf_counter()
        read = self.make(folder)
        self.setting.readers[self.name] = lambda: read
        nbytes = self.setting.pyramid.nbytes + self.channels * sum(v[..., 0].size for v in self.setting.pyramid.values)
        return self.kept(nbytes, start, read, label=self.label, kind="classical")


@dataclass
class _Trained(_Made):
    """A table, which stays in the folder of models."""

    table: Table | None = None

    def file(self, folder: Path) -> Path:
        return folder / f"{file_name(self.name)}.npz"

    def cached_record(self, folder, record):
        if record is None or folder is None or not self.file(folder).is_file():
            return None
        self.record, self.table = record, task.tasks()["texture"].load(self.file(folder))
        self.setting.readers[self.name] = lambda: self.setting.reader_of(self.table)
        return record

    def trained(self, folder, table: Table, result, start: float, **details) -> dict | None:
        """Keep what a training made, unless it was interrupted."""
        if result.interrupted:
            return None
        self.table = table
        if folder is not None:
            save_table(self.file(folder), table)
        read = self.setting.reader_of(table)
        self.setting.readers[self.name] = lambda: read
        known = {"steps": result.steps, "kept_step": result.step, "restarts": result.restarts,
                 "history": result.history, "training_seconds": result.seconds}  # fmt: skip
        return self.kept(table.nbytes, start, read, **known, **details)


@dataclass
class _Start(_Trained):
    """A texture that is trained as task 4 has it."""

    seed: int = 0

    def run(self, folder, progress):
        start, setting = time.perf_counter(), self.setting
        made, result = setting.texture(setting.pyramid, setting.request.pretraining, self.seed, progress)
        return self.trained(folder, made, result, start, kind="start", seed=self.seed)


@dataclass
class _Compressed(_Trained):
    """A texture of task 4 of another ``pyramid`` than the source's, with the time of both trainings."""

    label: str = ""
    pyramid: Callable[[Path | None], Pyramid] = lambda folder: None

    def run(self, folder, progress):
        start, setting, request = time.perf_counter(), self.setting, self.setting.request
        pyramid = self.pyramid(folder)
        made, result = setting.texture(pyramid, request.pretraining + request.length, 0, progress)
        return self.trained(folder, made, result, start, kind="compressed", label=self.label)


@dataclass
class _Run(_Trained):
    """A training for shading, from a ``start``."""

    start: _Start | None = None
    way: Way = WAYS[0]
    share: float = 0.0
    seed: int = 0
    base: _Run | None = None

    def run(self, folder, progress):
        begin, setting = time.perf_counter(), self.setting
        own = presets.PRESETS["ours"]
        settings = dataclasses.replace(own.settings, schedule="cosine" if self.way.schedule else "constant")
        request = setting.training(settings, setting.request.length, self.seed, progress)
        clip = (own.clip or CLIP) if self.way.clip else None
        recipe = dataclasses.replace(own, share=self.share, clip=clip, settings=request.settings)
        net = start_of(self.start.table, setting.pyramid)
        try:
            made, result = fit_shading(setting.source, net, recipe, request, setting.pyramid, setting.evaluation)
        except FittingError:  # it diverged again and again: nothing was gained over where it started from
            made, result = self.start.table, FitResult({}, 0, 0, 0.0, False, 0, [])
        details = {"kind": "run", "share": self.share, "clip": self.way.clip, "schedule": self.way.schedule,
                   "seed": self.seed, "way": self.way.name}  # fmt: skip
        record = self.trained(folder, made, result, begin, **details)
        if record is not None:
            base = self.base.record["details"] if self.base is not None and self.base.record else None
            record["details"]["trouble"] = troubles(record["details"], base)
        return record


@dataclass
class _Shifted(_Made):
    """λ = 0 read at other levels of detail, those that suit the truth's kernel best: nothing is trained."""

    label: str = ""
    base: _Run | None = None
    kernel: Callable = lambda make: make

    def _read(self) -> ShadedReader:
        return self.kernel(lambda folder: self.setting.readers[self.base.name]())(None)

    def cached_record(self, folder, record):
        self.record = record
        if record is not None:
            self.setting.readers[self.name] = self._read
        return record

    def run(self, folder, progress):
        start, read = time.perf_counter(), self._read()
        self.setting.readers[self.name] = lambda: read
        return self.kept(self.base.table.nbytes, start, read, kind="compressed", label=self.label)


def troubles(details: dict, base: dict | None) -> list[str]:
    """What went wrong in a run, in words (see above); ``base`` is λ = 0 of the same seed."""
    history, found = details["history"], []
    if not history:
        found.append("diverged")
    numbers = [v for h in history for k, v in h.items() if k != "step" and v is not None]
    if not np.isfinite(np.asarray([*numbers, details["C"]["mean_db"]], float)).all():
        found.append("nan")
    if details["restarts"]:
        found.append("restarts")
    losses = [h["loss"] for h in history if h["loss"] is not None and math.isfinite(h["loss"])]
    if losses and max(losses) > 10 * float(np.median(losses)) + 1e-9:
        found.append("spike")
    if history:
        key = next(k for k in history[-1] if k not in ("step", "loss"))
        values = [h[key] for h in history if math.isfinite(h[key])]
        if values and max(values) - history[-1][key] > DRIFT:
            found.append("drift")
    if base is not None and details["C"]["mean_db"] < base["C"]["mean_db"]:
        found.append("below")
    return found


# -- the plan ---------------------------------------------------------------------------------------------------------


def plan(sources: dict[str, Source], request: Request) -> Plan:
    """What is measured of the materials, in the variant that is set."""
    jobs: list[Job] = []
    candidates: list[Candidate] = []
    settings = {name: Setting(name, source, request) for name, source in sources.items()}
    for setting in settings.values():
        own = _jobs(setting)
        jobs += own
        candidates += _candidates(setting, own)
    sizes = ", ".join(f"{s.name} ({s.source.width} × {s.source.height})" for s in settings.values())
    asked = json.loads(json.dumps(asdict(request)))
    digests = {name: s.digest for name, s in sources.items()}
    return Plan(
        study="shading",
        title="Textures trained for their shading",
        variant=mi.variant(),
        candidates=candidates,
        cases=[],
        queries=(),
        accuracy="c_mean_db",
        accuracy_label="PSNR of shaded values against converged truth, mean of levels, dB",
        details={"sources": digests, "request": asked, "evaluation": _seen(request)},
        notes=[
            f"{sizes}; {request.compression:g}x, {request.pretraining:g} {request.unit} of training as a texture, then "
            f"{request.length:g} {request.unit} for shading; C: converged truth, P: the paper's reference."
        ],
        jobs=jobs,
        jobs_fingerprint=f"{digests} {asked}",
        pictures=pictures.of(settings),
        sampled=False,
        table=table,
        conclusions=conclusions,
    )


def _seen(request: Request) -> str:
    return "3 levels, 2 pairs" if request.quick else "6 levels, 16 pairs of a view and a light"


def _jobs(setting: Setting) -> list[Job]:
    """Of one material, in the order in which they are done: cheap ones first, then λ from seed to seed."""
    name, request = setting.name, setting.request
    pyramid, found = (lambda: setting.pyramid), []

    def classical(label: str, make: Callable[[Path | None], ShadedReader], channels: int = 0) -> None:
        found.append(_Classical(f"{name}, {label}", setting, label=label, make=make, channels=channels))

    def bake(folder: Path | None) -> list[np.ndarray]:
        """The fitted roughness, kept in the folder."""
        if folder is None:
            return normals.bake(pyramid(), setting.effects, _pairs(request))
        file = folder / f"{file_name(name)}_roughness.npz"
        if not file.is_file():
            levels = bake(None)
            with replacing(file) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, *levels)
        with np.load(file, allow_pickle=False) as data:
            return [data[f"arr_{i}"] for i in range(len(data.files))]

    def shifted(make: Callable[[Path | None], ShadedReader]) -> Callable[[Path | None], ShadedReader]:
        """The same with the kernel that suits the truth best."""

        def biased(folder: Path | None) -> ShadedReader:
            read = make(folder)
            places = 2**10 if request.quick else normals.PLACES
            return normals.biased(read, normals.choose_biases(read, pyramid(), setting.effects, places))

        return biased

    def filtered(folder: Path | None) -> ShadedReader:
        return normals.filtered(pyramid(), setting.effects)

    def baked(folder: Path | None) -> ShadedReader:
        return normals.baked(pyramid(), setting.effects, bake(folder))

    def lean(folder: Path | None, smooth: bool = False) -> ShadedReader:
        return normals.lean(source, pyramid(), setting.effects, smooth)

    def rough(levels: Callable[[Path | None], list[np.ndarray]]) -> Callable[[Path | None], Pyramid]:
        return lambda folder: normals.with_roughness(pyramid(), levels(folder))

    source = setting.source
    classical("filtered", filtered)
    classical("kernel", shifted(filtered))
    classical("Toksvig", lambda folder: normals.toksvig(source, pyramid(), setting.effects))
    classical("LEAN", lean, 6)
    classical("LEAN, kernel", shifted(lambda folder: lean(folder, True)), 6)
    classical("baked", baked)
    if not request.quick:
        classical("baked, kernel", shifted(baked))
    made = {"Toksvig, compressed": rough(lambda folder: normals.toksvig_levels(source, pyramid()))}
    if not request.quick:
        made["baked, compressed"] = rough(bake)
    for label, make in made.items():
        found.append(_Compressed(f"{name}, {label}", setting, label=label, pyramid=make))
    for seed in range(request.seeds):
        start = _Start(f"{name}, texture, seed {seed}", setting, seed=seed)
        found.append(start)
        bases = {}
        for share in request.lambdas:
            for way in request.ways:
                if share == 0 and way.schedule in bases:
                    continue  # there is nothing to clip
                run = _Run(f"{name}, lambda {share:g}, {way.name}, seed {seed}", setting, start=start, way=way,
                           share=share, seed=seed, base=bases.get(way.schedule))  # fmt: skip
                found.append(run)
                if share == 0:
                    if not bases and seed == 0:
                        found.append(_Shifted(f"{name}, kernel, compressed", setting, label="kernel, compressed",
                                              base=run, kernel=shifted))  # fmt: skip
                    bases[way.schedule] = run
    return found


def _pairs(request: Request) -> int:
    return 4 if request.quick else normals.PAIRS


def _candidates(setting: Setting, jobs: list[Job]) -> list[Candidate]:
    found = []
    for job in jobs:
        if isinstance(job, (_Classical, _Compressed, _Shifted)):
            found.append(_candidate(setting, job.name, [job], job.label, {"kind": job.label}))
    groups: dict[tuple, list[_Run]] = {}
    for job in jobs:
        if isinstance(job, _Run):
            groups.setdefault((job.share, job.way), []).append(job)
    for (share, way), runs in groups.items():
        details = {"lambda": share, "way": way.name, "kind": "run"}
        found.append(_candidate(setting, f"{setting.name}, lambda {share:g}, {way.name}", runs, "lambda", details))
    return found


def _candidate(setting: Setting, name: str, jobs: list, representation: str, details: dict) -> Candidate:
    def errors(samples: int) -> dict[str, float]:
        made = [j.record["details"] for j in jobs]
        found = {}
        for letter in "CP":
            for what in ("mean_db", "coarse_db"):
                values = [d[letter][what] for d in made]
                key = f"{letter.lower()}_{what}"
                found |= {key: float(np.mean(values)), f"{key}_low": min(values), f"{key}_high": max(values)}
            flips = [np.mean(d[letter]["flip"]) for d in made if d[letter]["flip"]]
            if flips:
                found[f"{letter.lower()}_flip"] = float(np.mean(flips))
            for i in range(len(made[0][letter]["psnr_db"])):
                found[f"{letter.lower()}_l{i}_db"] = float(np.mean([d[letter]["psnr_db"][i] for d in made]))
        return {**found, **setting.motion.errors(setting.readers[jobs[0].name]())}

    # Bytes and seconds are those of the first seed's
    return Candidate(
        name, representation, job=jobs[0].name, errors=errors, details={**details, "material": setting.name}
    )
