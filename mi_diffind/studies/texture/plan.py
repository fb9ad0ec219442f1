"""Plan of the texture study: filtered textures, bitmaps and ASTC, by errors of renders, levels, flicker and time.

A map of a material covers a surface in a light without noise (:mod:`.test_scenes`). The truth is ``bitmap`` at many
multijittered samples. The candidates are ``bitmap`` at 1 to 64 samples per pixel, independent or multijittered;
``mipmap``, the uncompressed pyramid; ``neural_texture`` at several sizes; all levels encoded with ASTC in the same
bytes, read by ``mipmap``; and a network in the bytes of the first size (:mod:`.networks`), filtered trilinearly.
Filtered textures take one sample per pixel, at a random position or *centred*. Trilinear filtering reads the texture
once, anisotropic filtering at most four times.

*Errors* are those of displayed values in pixels entirely on the surface; a scene counts those that are minified, or
magnified. *Levels*: the error of each level of detail at its texel centres, of all maps. *Flicker*:
:mod:`~mi_diffind.measure.flicker`. *Time*: kernels that read the map where a scene shows it, and whole renders.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays.tables import Table
from ...fitting import task
from ...maps.compressed import FilteredMaps, decibel
from ...maps.pyramid import Pyramid
from ...maps.source import Source
from ...measure.store import fingerprint
from ...measure.study import FLOOR, Candidate, Case, Job, Plan
from ...measure.training import ConvergenceTraining
from ...plugins.support.image_files import PYRAMIDS
from ...scenes.loading import footprint
from ..baselines import codecs
from ..baselines.hash_grids import halved
from ..equal_memory import Contender, PresetContender, StudyContext, load_arrays
from ..maps import source_details
from . import levels, networks, pictures, test_scenes
from .conclusions import BASE, conclusions, table
from .test_scenes import TextureReader, TextureScene
from .zoom import TextureZoom

#: Samples per pixel of bitmaps.
COUNTS = (1, 4, 16, 64)

#: Filter → parameters of the plugin.
FILTERS = {
    "trilinear": {"filter": "trilinear"},
    "anisotropic": {"filter": "anisotropic", "max_anisotropy": 4},
    "stochastic": {"filter": "stochastic"},
    "off": {"filter": "off"},
}

#: Names of methods in legends.
BITMAP, MULTIJITTERED, MIPMAP = "bitmap", "bitmap, multijittered", "mip maps, uncompressed"
OURS, PAPER, ASTC, NETWORK = "ours", "paper's preset", "ASTC with mip maps", "network"

#: Filters, each with whether samples are centred; and further ones that only our first texture is read with.
READS = tuple(itertools.product(("trilinear", "anisotropic"), (False, True)))
MORE_READS = (("stochastic", False), ("off", False))

#: Integrator whose samples are at the centres of pixels.
CENTRED = {"type": "path_footprint", "jitter": False}

#: Presets with the distributions of footprints that they are trained with beside their own (ours: by level; the
#: paper's: powers).
FOOTPRINTS = (("ours", "power"), ("ours", "exponential"), ("paper", "exponential"))

#: Multijittered samples per pixel of the zoom's truth; its noise is below 1% of any flicker that filtering leaves.
ZOOM_SPP = 64

#: Seed of the truth, far from those of candidates.
_TRUTH_SEED = 1 << 20


@dataclass(frozen=True)
class TextureStudySettings:
    """Settings of the texture study.

    ``map`` is the name of the rendered map; a texture is trained for ``seconds`` at each of ``compressions``. ``astc``
    and ``astc_choice`` are presets of the ASTC encoder as in the image study. ``film`` and ``zoom_film`` are sizes of
    images (width, height), ``frames`` is the length of the zoom, ``truth_spp`` a square number, ``seeds`` the number of
    renders that errors are averaged over. ``footprints`` adds trainings with other distributions of footprints.
    ``network_steps`` is the length of the first training of a network. ``only`` are the methods that are measured
    (default: all).
    """

    map: str
    compressions: tuple[float, ...] = (12.0,)
    seconds: float = 60.0
    astc: str = "exhaustive"
    astc_choice: str = "medium"
    film: tuple[int, int] = (480, 320)
    zoom_film: tuple[int, int] = (240, 160)
    frames: int = 60
    truth_spp: int = 256
    seeds: int = 4
    footprints: bool = False
    network_steps: int = networks.STEPS
    only: tuple[str, ...] = ()


def colour_map(source: Source, name: str = "") -> str:
    """Return the name of a map with three channels of 8 bits: ``name``, or the first albedo. Raises ``ValueError``."""
    fitting = [m for m in source.maps if m.channels == 3 and m.depth == 1 and m.role != "normal"]
    names = [m.name for m in sorted(fitting, key=lambda m: m.role != "albedo")]
    if name and name not in names:
        raise ValueError(f'--map: found "{name}", maps with colours of 8 bits are {", ".join(names) or "none"}')
    if not names:
        raise ValueError("source: none of its maps has colours of 8 bits, which the study renders")
    return name or names[0]


def tables_of(paths: Sequence[str], source: Source) -> list[Table]:
    """Return trained tables. Raises :class:`.TableError`, ``ValueError`` for another source."""
    tables = [task.tasks()["texture"].load(path) for path in paths]
    for trained in tables:
        if trained.settings.get("source") != source.digest:
            raise ValueError(f"--table: {trained.path} was not trained on this source")
    return tables


def plan(
    source: Source,
    name: str,
    settings: TextureStudySettings,
    tables: Sequence[Table] = (),
    reads: Sequence[tuple[str, bool]] = READS,
    more_reads: Sequence[tuple[str, bool]] = MORE_READS,
    scenes: dict[str, TextureScene] | None = None,
) -> Plan:
    """Return the plan for ``source``, read from the file ``name``, in the current variant.

    ``tables`` are trained already. ``reads`` and ``more_reads`` are the filters as in :data:`READS` and
    :data:`MORE_READS`, ``scenes`` the stills (default: :func:`.test_scenes.still_scenes`).
    """
    context = TextureStudyContext(source, name, settings, scenes or test_scenes.still_scenes())
    builder = TextureCandidates(context, reads, more_reads)
    builder.add_truths()
    builder.add_references()
    builder.add_textures(tables)
    builder.add_network()
    builder.select(settings.only)
    note = (
        f"{name}, {source.width} × {source.height}, {len(source.maps)} map(s), of which {settings.map} is rendered. "
        "PSNR of displayed values. Bytes are those of all maps, with mip maps but for bitmaps."
    )
    digests, candidates, readers = [fingerprint([t.path]) for t in tables], builder.candidates, builder.readers
    shown = {name: readers[name] for name in pictures.shown(candidates)}
    return Plan(
        study="texture",
        title=f"Filtered texture: {Path(name).stem}",
        candidates=candidates,
        cases=[_case(context, scene, candidates, readers) for scene in context.scenes.values()],
        queries=("read",),
        accuracy="psnr_plane_db",
        accuracy_label="PSNR of displayed values, dB",
        ratios=[(c.name, BASE) for c in candidates if c.name != BASE],
        details={
            **source_details(source, name),
            "request": asdict(settings),
            "tables": digests,
            "codecs": list(codecs.available()),
            "counted": {n: float(context.counted(s).mean()) for n, s in context.scenes.items()},
        },
        notes=[note, *codecs.install_notes(["astc"])],
        jobs=builder.jobs,
        jobs_fingerprint=f"{source.digest} {asdict(settings)} {digests}",
        pictures={name: functools.partial(draw, context, shown) for name, draw in pictures.FIGURES.items()},
        sampled=False,
        table=table,
        conclusions=conclusions,
    )


@dataclass
class TextureStudyContext(StudyContext):
    """The source, read from the file ``name``, the scenes of the stills, and their truths, which jobs render."""

    source: Source
    name: str
    settings: TextureStudySettings
    scenes: dict[str, TextureScene]
    truths: dict[str, TextureTruth] = field(default_factory=dict)

    @cached_property
    def zoom(self) -> TextureZoom:
        return TextureZoom(test_scenes.zoom_scene(), self.settings.zoom_film, self.size, self.settings.frames)

    @cached_property
    def pyramid(self) -> Pyramid:
        """The uncompressed levels, repeated as bitmaps are."""
        return Pyramid.of(self.source, types=self.types, border=("repeat", "repeat"))

    @cached_property
    def truth_levels(self) -> dict[str, list[np.ndarray]]:
        return levels.images(self.pyramid)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the texture."""
        return self.source.width, self.source.height

    def counted(self, scene: TextureScene) -> np.ndarray:
        return scene.counted(self.settings.film, self.size)

    def render(self, reader: TextureReader, scene: TextureScene, seed: int) -> np.ndarray:
        return reader.render(scene, self.settings.film, self.size, seed)

    def errors(self, reader: TextureReader) -> dict[str, float]:
        """Return the errors of a reader.

        ``psnr_SCENE_db`` and ``flip_SCENE`` are those of the means over seeds; ``flicker`` and ``flicker_error`` those
        of the zoom.
        """
        errors = {}
        for name, scene in self.scenes.items():
            counted, truth = self.counted(scene), self.truths[name].model
            each = [
                test_scenes.errors(truth, self.render(reader, scene, k), counted) for k in range(self.settings.seeds)
            ]
            errors[f"psnr_{name}_db"] = decibel(float(np.mean([e["mse"] for e in each])))
            errors[f"flip_{name}"] = float(np.mean([e["flip"] for e in each]))
        return {**errors, **self.zoom.errors(self.zoom.render(reader), self.truths["zoom"].model)}

    def bitmap(self, spp: int = 1, sampler: str = "independent") -> TextureReader:
        """Return Mitsuba's texture with 8 bits."""
        m = next(m for m in self.source.maps if m.name == self.settings.map)
        data = mi.Bitmap(np.ascontiguousarray(np.rint(m.values * 255).astype(np.uint8)))
        bitmap = {"type": "bitmap", "bitmap": data, "raw": m.color_space != "srgb"}
        return TextureReader(lambda repeats: {**bitmap, "to_uv": test_scenes.to_uv(repeats)}, spp, sampler)

    def filtered(self, plugin: dict, filter_name: str, centred: bool) -> TextureReader:
        """Return a texture that filters itself, at one sample per pixel."""
        texture = {**plugin, **FILTERS[filter_name], "channels": self.settings.map}
        return TextureReader(
            lambda repeats: {**texture, "to_uv": test_scenes.to_uv(repeats)},
            path=CENTRED if centred else None,
            prepare=footprint.attach,
        )

    def mipmap(self, pyramid: FilteredMaps, filter_name: str, centred: bool) -> TextureReader:
        """Return ``mipmap`` of a pyramid, or of other maps that are read as one."""
        name = f"study {id(pyramid)}"
        PYRAMIDS[name] = pyramid
        return self.filtered({"type": "mipmap", "pyramid": name}, filter_name, centred)


@dataclass
class TextureTruth(Contender):
    """Converged render of a scene or of the zoom; ``render(reader)`` returns it, ``budget`` is its sample count."""

    render: Callable[[TextureReader], np.ndarray] | None = None

    def run(self, folder: Path | None, progress: bool) -> dict:
        start = time.perf_counter()
        self.model = self.render(self.context.bitmap(self.budget, "multijitter"))
        self.save_arrays(truth=self.model)
        return {"seconds": time.perf_counter() - start}

    def load(self, path: Path) -> np.ndarray:
        return load_arrays(path)["truth"]


@dataclass
class TextureContender(Contender):
    """All levels of all maps, compressed by a method at a compression ratio (``budget``)."""

    def level_record(self, nbytes: int, seconds: float | None, maps: dict[str, list[np.ndarray]], **details) -> dict:
        """Return the record of compressed ``maps``, name → decoded levels, with the errors of levels."""
        context = self.context
        details |= {"compression": self.budget, "ratio": context.source.nbytes / nbytes, "kind": self.method}
        details["levels"] = levels.errors(context.truth_levels, maps)
        return {"bytes": nbytes, "seconds": seconds, "details": details}


@dataclass
class TrainedTexture(PresetContender, TextureContender):
    """A texture trained by a preset of ``fit texture``, or by other ``footprint_samples`` than the preset's."""

    task_name, model_part = "texture", "image"
    preset: str = ""
    footprint_samples: str | None = None

    def arguments(self) -> dict:
        return {
            "source": self.context.name, "compression": self.budget, "seconds": self.context.settings.seconds,
            "footprint_samples": self.footprint_samples, "border": "repeat",  # as the scenes repeat it
        }  # fmt: skip

    def fit_record(self, task_model, fitted, seconds: float) -> dict:
        return self.table_record(task_model, fitted.result.seconds)

    def table_record(self, task_model, seconds: float | None) -> dict:
        table, pyramid = task_model.table, self.context.pyramid
        maps = levels.decoded(task_model.image, pyramid.layout.names, pyramid.levels)
        return self.level_record(
            table.nbytes, seconds, maps, file=self.file.name, preset=table.preset, steps=table.settings.get("steps")
        )

    def reader(self, filter_name: str, centred: bool) -> TextureReader:
        return self.context.filtered({"type": "neural_texture", "filename": str(self.file)}, filter_name, centred)


@dataclass
class StoredTexture(TrainedTexture):
    """A texture whose table was trained before the study."""

    table: Table | None = None

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        self.file = Path(self.table.path)
        return record

    def run(self, folder: Path | None, progress: bool) -> dict:
        return self.table_record(self.open(self.file), self.table.settings.get("seconds"))


@dataclass
class EncodedTexture(TextureContender):
    """All levels encoded with ASTC, in the bytes of another contender; ``cache`` is shared by all budgets."""

    equal_to: TrainedTexture | None = None
    cache: dict = field(default_factory=dict)

    def run(self, folder: Path | None, progress: bool) -> dict:
        start, context = time.perf_counter(), self.context
        nbytes = task.tasks()["texture"].load(self.equal_to.file).nbytes
        normals = [m.name for m in context.source.maps if m.role == "normal"]
        encoded, nbytes = codecs.astc_levels(
            context.truth_levels, nbytes, context.settings.astc, normals, context.settings.astc_choice, self.cache
        )
        self.model = {name: e.levels for name, e in encoded.items()}
        self.save_arrays(**{f"{name}_{i}": v for name, maps in self.model.items() for i, v in enumerate(maps)})
        names = ", ".join(f"{name} {e.codec}" for name, e in encoded.items())
        return self.level_record(nbytes, None, self.model, how=names, encoding_seconds=time.perf_counter() - start)

    def load(self, path: Path) -> dict[str, list[np.ndarray]]:
        pyramid, arrays = self.context.pyramid, load_arrays(path)
        return {n: [arrays[f"{n}_{i}"] for i in range(pyramid.levels)] for n in pyramid.layout.names}

    def reader(self, filter_name: str, centred: bool) -> TextureReader:
        context = self.context
        return context.mipmap(levels.pyramid_of(self.model, context.pyramid), filter_name, centred)


@dataclass
class NetworkTexture(TextureContender):
    """Hash grid and network in half precision, trained to convergence (:mod:`.networks`)."""

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        return self._completed(self.training.cached_record(folder, None), record)

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        return self._completed(self.training.run(folder, progress), None)

    @cached_property
    def training(self) -> ConvergenceTraining:
        context, steps = self.context, self.context.settings.network_steps
        pyramid, source = context.pyramid, context.source

        def problem() -> networks.TextureNetworkProblem:
            net = networks.network(source, pyramid.layout, source.nbytes / self.budget)
            return networks.TextureNetworkProblem(net, pyramid, source.digest)

        return ConvergenceTraining(self.name, problem, networks.settings(steps), networks.LONGEST * steps, 5)

    def _completed(self, trained: dict | None, record: dict | None) -> dict | None:
        """Round the parameters, and return the record with the errors of levels unless ``record`` has them."""
        if trained is None:
            return None
        halved(self.training.net)
        pyramid = self.context.pyramid
        self.model = networks.NetworkMaps(self.training.net, pyramid.layout, pyramid.types, pyramid.border, True)
        if record is None:
            record = self.level_record(
                2 * trained["entries"], sum(run["seconds"] for run in trained["runs"]),
                levels.decoded(self.model, pyramid.layout.names, pyramid.levels),
                steps=trained["steps"], steps_first=self.training.settings.steps, steps_longest=self.training.longest,
                batch=self.training.settings.batch,
            )  # fmt: skip
        return {**trained, **record}

    def reader(self, filter_name: str, centred: bool) -> TextureReader:
        return self.context.mipmap(self.model, filter_name, centred)


class TextureCandidates:
    """Builder of the plan: jobs, candidates, and a function for each candidate that returns its reader."""

    def __init__(self, context: TextureStudyContext, reads: Sequence, more_reads: Sequence):
        self.context, self.reads, self.more_reads = context, reads, more_reads
        self.jobs: list[Job] = []
        self.candidates: list[Candidate] = []
        self.readers: dict[str, Callable[[], TextureReader]] = {}

    def add(self, name: str, method: str, reader: Callable[[], TextureReader], **fields) -> None:
        """Register a candidate; its reader is created once, after the jobs."""
        once = self.readers[name] = functools.cache(reader)
        errors = lambda samples: self.context.errors(once())  # noqa: E731
        self.candidates.append(Candidate(name, method, errors=errors, **fields))

    def add_filtered(
        self, name: str, method: str, reader: Callable, reads: Sequence, in_picture=True, **fields
    ) -> None:
        """Register a candidate for each of ``reads``, pairs of a filter and whether samples are centred."""
        for filter_name, centred in reads:
            self.add(
                f"{name}, {filter_name}{', centred' * centred}", method,
                functools.partial(reader, filter_name, centred), setting=filter_name,
                queries=() if centred else None, in_picture=in_picture and filter_name not in ("off", "stochastic"),
                **fields,
            )  # fmt: skip

    def add_truths(self) -> None:
        """Register the jobs that render the truths of the stills and of the zoom."""
        context = self.context
        spp = {**dict.fromkeys(context.scenes, context.settings.truth_spp), "zoom": ZOOM_SPP}
        for name, samples in spp.items():
            render = functools.partial(context.render, scene=context.scenes.get(name), seed=_TRUTH_SEED)
            if name == "zoom":
                render = lambda reader: context.zoom.render(reader, _TRUTH_SEED >> 12)  # noqa: E731
            context.truths[name] = TextureTruth("truth", samples, context, f"truth, {name}", render=render)
        self.jobs += context.truths.values()

    def add_references(self) -> None:
        """Register bitmaps and the uncompressed pyramid."""
        context, nbytes = self.context, self.context.source.nbytes
        for sampler, method in (("independent", BITMAP), ("multijitter", MULTIJITTERED)):
            for spp in COUNTS if sampler == "independent" else COUNTS[1:]:
                name = f"bitmap, {spp} spp{method.removeprefix(BITMAP)}"
                self.add(name, method, functools.partial(context.bitmap, spp, sampler), bytes=nbytes,
                         setting=f"{spp} spp", queries=None if spp == 1 else ())  # fmt: skip
        self.add_filtered("mipmap", MIPMAP, functools.partial(context.mipmap, context.pyramid),
                          self.reads, bytes=context.pyramid.nbytes)  # fmt: skip

    def add_textures(self, tables: Sequence[Table]) -> None:
        """Register trained textures, those of ``tables`` first, and ASTC in the bytes of each of ours."""
        context, settings = self.context, self.context.settings
        textures: list[TrainedTexture] = []
        for stored in tables:
            ratio = context.source.nbytes / stored.nbytes
            method = PAPER if stored.preset == "paper" else OURS
            textures.append(StoredTexture(method, ratio, context, f"{stored.preset} {ratio:.3g}x", table=stored))
        for compression in settings.compressions:
            textures.append(TrainedTexture(OURS, compression, context, f"ours {compression:g}x"))
            if compression == settings.compressions[0]:
                name = f"paper {compression:g}x"
                textures.append(TrainedTexture(PAPER, compression, context, name, preset="paper"))
        cache: dict = {}
        for i, job in enumerate(textures):
            self.jobs.append(job)
            fields = {"job": job.name, "training_seconds": None, "in_picture": i == 0 or job.method == OURS}
            if job.method != OURS:
                self.add_filtered(job.name, job.method, job.reader, self.reads[:1], **fields)
                continue
            self.add_filtered(
                job.name, job.method, job.reader, (*self.reads, *(self.more_reads if i == 0 else ())), **fields
            )
            if "astc" in codecs.available():
                name = job.name.replace("ours", "ASTC")
                encoded = EncodedTexture(ASTC, job.budget, context, name, equal_to=job, cache=cache)
                self.jobs.append(encoded)
                fields |= {"job": name, "in_picture": i == 0}
                self.add_filtered(name, encoded.method, encoded.reader, self.reads[::3], **fields)
        for preset, samples in FOOTPRINTS if settings.footprints and settings.compressions else ():
            compression = settings.compressions[0]
            self.jobs.append(
                TrainedTexture("footprints", compression, context, f"{preset} {compression:g}x, {samples} footprints",
                               preset="paper" if preset == "paper" else "", footprint_samples=samples)
            )  # fmt: skip

    def add_network(self) -> None:
        """Register a network in the bytes of our texture at the first ratio, unless they are too few for one."""
        context = self.context
        for compression in context.settings.compressions[:1]:
            with contextlib.suppress(ValueError):
                networks.network(context.source, context.pyramid.layout, context.source.nbytes / compression)
                job = NetworkTexture(NETWORK, compression, context, f"network {compression:g}x")
                self.jobs.append(job)
                fields = {"job": job.name, "training_seconds": None}
                self.add_filtered(job.name, job.method, job.reader, self.reads[:1], **fields)

    def select(self, only: Sequence[str]) -> None:
        """Keep the candidates of the methods ``only``, unless there are none, and the jobs that these need."""
        if not only:
            return
        self.candidates = [c for c in self.candidates if c.representation in only]
        needed = {c.job for c in self.candidates}
        needed |= {j.equal_to.name for j in self.jobs if isinstance(j, EncodedTexture) and j.name in needed}
        self.jobs = [job for job in self.jobs if isinstance(job, TextureTruth) or job.name in needed]


def _case(context: TextureStudyContext, scene: TextureScene, candidates: list[Candidate], readers: dict) -> Case:
    """Return the case of a scene: reads of the map where the scene shows it, and whole renders."""
    film = context.settings.film
    repeats = scene.repeats(film, context.size)

    def reads(lanes: int) -> dict:
        loaded = readers[BASE]().loaded(scene, film, context.size)
        width = max(1, round((1.5 * lanes) ** 0.5))
        index = np.arange(lanes)
        si = scene.hits(loaded, (index % width + 0.5) / width, (index // width + 0.5) / -(-lanes // width))
        dr.make_opaque(si.uv, si.p, si.dp_du, si.dp_dv, si.wi, si.sh_frame, si.duv_dx, si.duv_dy)
        cone = footprint.Cone.of(loaded.sensors()[0])
        functions = {FLOOR: lambda: [si.uv.x, si.uv.y]}
        for candidate in candidates:
            if candidate.queries is None:
                texture = mi.load_dict(readers[candidate.name]().texture(repeats))
                if hasattr(texture, "set_cone"):
                    texture.set_cone(cone)
                functions[candidate.name] = lambda t=texture: t.eval(si)
        return {"read": functions}

    def passes() -> dict:
        functions = {}
        for candidate in candidates:
            reader = readers[candidate.name]()
            loaded = reader.loaded(scene, film, context.size)
            functions[candidate.name] = lambda k, s=loaded, spp=reader.spp: mi.render(s, spp=spp, seed=k)
        return functions

    return Case(
        scene.name, reads, passes, accuracy=f"psnr_{scene.name}_db", of_passes=True, in_picture=not scene.magnified,
        details={"repeats": repeats, "magnified": scene.magnified},
    )  # fmt: skip
