"""
What the study of filtered textures compares, and how.

A map of a material is on a surface, in a light without noise (:mod:`.stages`). The truth is ``bitmap`` at many
multijittered samples. Beside it stand ``bitmap`` at 1 to 64 samples a pixel, independent or multijittered; ``mipmap``,
the uncompressed pyramid; ``neural_texture`` at several sizes; and what ASTC makes of all levels in the same bytes, read
as ``mipmap`` does. Those that filter take one sample a pixel: at a random place, or *centred*. Trilinear filtering
takes one tap of the texture, anisotropic filtering at most four.

*Errors* are those of displayed values in pixels that are seen entirely; a stage counts those that are minified, or
magnified. *Levels*: the error of each level of detail at its texel centres, of all maps. *Flicker*: :mod:`.zoom`.
*Time*: kernels that read the map where a stage shows it, and whole renders, all candidates in turn.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import task
from ...files import replacing
from ...maps.pyramid import Pyramid
from ...maps.source import Map, Source
from ...measure.store import file_name, fingerprint
from ...measure.study import FLOOR, Candidate, Case, Job, Plan
from ...plugins.support.image_files import PYRAMIDS
from ...runtime import array_module
from ...scenes import footprint
from ...tables import Table, save_table
from ..baselines import codecs
from . import levels, pictures, test_scenes
from .conclusions import conclusions, table
from .test_scenes import Reader, Stage, decibel
from .zoom import Zoom, flicker

#: Samples a pixel of bitmaps.
COUNTS = (1, 4, 16, 64)

#: How a texture is filtered: what is added to its description.
FILTERS = {
    "trilinear": {"filter": "trilinear"},
    "anisotropic": {"filter": "anisotropic", "max_anisotropy": 4},
    "stochastic": {"filter": "stochastic"},
    "off": {"filter": "off"},
}

#: What presets are called in legends; others are ours.
KINDS = {"paper": "paper's preset"}

#: Filters, and whether samples are centred; and those that only our first table has.
WAYS = tuple(itertools.product(("trilinear", "anisotropic"), (False, True)))
MORE = (("stochastic", False), ("off", False))

#: The integrator whose samples are at the centres of pixels.
CENTRED = {"type": "path_footprint", "jitter": False}

#: Presets, and distributions of footprints that they are trained with beside their own (ours: by level; the paper's:
#: powers).
SAMPLES = (("ours", "power"), ("ours", "exponential"), ("paper", "exponential"))

#: The candidate whose time others are compared with.
BASE = "bitmap, 1 spp"

#: Multijittered samples a pixel of the zoom's truth: what they add is below 1% of any flicker that filtering leaves.
ZOOM_SPP = 64

#: The seed of the truth, far from those of candidates.
_TRUTH = 1 << 20


@dataclass(frozen=True)
class Request:
    """
    What is asked for: the name of the ``map`` that is rendered, ``compressions`` to train for ``seconds`` each;
    ``astc`` and ``astc_choice``, presets of its encoder as in the study of images; ``film`` and ``zoom_film``, sizes of
    the images (width, height); ``frames`` of the zoom; ``truth_spp``, a square; ``seeds``, renders that errors are the
    mean of; with ``footprints``, both presets are also trained with the other distributions of footprints.
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


def colour_map(source: Source, name: str = "") -> str:
    """The name of a map with three channels of 8 bits: ``name``, or the first albedo. Raises ``ValueError``."""
    fitting = [m.name for m in source.maps if m.channels == 3 and m.depth == 1 and m.role != "normal"]
    fitting.sort(key=lambda n: next(m.role for m in source.maps if m.name == n) != "albedo")
    if name and name not in fitting:
        raise ValueError(f'--map: found "{name}", colours of 8 bits have {", ".join(fitting) or "no maps"}')
    if not fitting:
        raise ValueError("source: none of its maps has colours of 8 bits, which the study renders")
    return name or fitting[0]


def tables_of(paths: Sequence[str], source: Source) -> list[Table]:
    """Tables that were trained already. Raises :class:`~mi_diffind.tables.TableError` and ``ValueError``."""
    found = [task.tasks()["texture"].load(path) for path in paths]
    for trained in found:
        if trained.settings.get("source") != source.digest:
            raise ValueError(f"--table: {trained.path} was not trained on this source")
    return found


def plan(source: Source, name: str, request: Request, tables: Sequence[Table] = ()) -> Plan:
    """What is measured of ``source``, of the file ``name``, in the variant that is set."""
    setting = Setting(source, name, request)
    jobs, found = _candidates(setting, tables)
    candidates = [c for c, _ in found]
    readers = {c.name: reader for c, reader in found}
    for c, _ in found:
        c.errors = lambda samples, n=c.name: setting.errors(readers[n]())
    cases = [_case(setting, stage, candidates, readers) for stage in setting.stages.values()]
    missing = [] if "astc" in codecs.available() else ["ASTC"]
    notes = [
        f"{name}, {source.width} × {source.height}, {len(source.maps)} map(s), of which {request.map} is rendered. "
        "PSNR of displayed values. Bytes are those of all maps, with mip maps but for bitmaps."
    ]
    if missing:
        notes.append(f'Left out, not being installed: {", ".join(missing)}; pip install "mi-diffind[compare]"')
    digests = [fingerprint([t.path]) for t in tables]
    request_details = asdict(request)
    return Plan(
        study="texture",
        title=f"Filtered texture: {Path(name).stem}",
        variant=mi.variant(),
        candidates=candidates,
        cases=cases,
        queries=("read",),
        accuracy="psnr_plane_db",
        accuracy_label="PSNR of displayed values, dB",
        ratios=[(c.name, BASE) for c in candidates if c.name != BASE],
        details={
            "source": name, "source_digest": source.digest, "source_bytes": source.nbytes, "width": source.width,
            "height": source.height, "maps": {m.name: m.channels for m in source.maps}, "request": request_details,
            "tables": digests, "codecs": list(codecs.available()),
            "counted": {n: float(setting.counted(s).mean()) for n, s in setting.stages.items()},
        },
        notes=notes,
        jobs=jobs,
        jobs_fingerprint=f"{source.digest} {request_details} {digests}",
        pictures=pictures.of(setting, {n: readers[n] for n in pictures.shown(candidates)}),
        sampled=False,
        table=table,
        conclusions=conclusions,
    )  # fmt: skip


# -- what is fixed ----------------------------------------------------------------------------------------------------


@dataclass
class Setting:
    """The source, the stages and their truths, which are made by jobs."""

    source: Source
    name: str
    request: Request
    truths: dict[str, np.ndarray] = field(default_factory=dict)

    @cached_property
    def stages(self) -> dict[str, Stage]:
        return test_scenes.stages()

    @cached_property
    def zoom(self) -> Zoom:
        return Zoom(test_scenes.zoom_stage(), self.request.zoom_film, self.size, self.request.frames)

    @cached_property
    def pyramid(self) -> Pyramid:
        """Uncompressed; it is repeated as bitmaps are."""
        return Pyramid.of(self.source, types=array_module(mi.variant()), border=("repeat", "repeat"))

    @cached_property
    def truth_levels(self) -> dict[str, list[np.ndarray]]:
        return levels.images(self.pyramid)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the texture."""
        return self.source.width, self.source.height

    def counted(self, stage: Stage) -> np.ndarray:
        return stage.counted(self.request.film, self.size)

    def render(self, reader: Reader, stage: Stage, seed: int) -> np.ndarray:
        return reader.render(stage, self.request.film, self.size, seed)

    def errors(self, reader: Reader) -> dict[str, float]:
        """
        Of each stage ``psnr_STAGE_db`` and ``flip_STAGE``, of the means over seeds; of the zoom ``flicker``, and
        ``flicker_error``, that of the difference to the truth.
        """
        found = {}
        for name, stage in self.stages.items():
            counted, truth = self.counted(stage), self.truths[name]
            each = [
                test_scenes.errors(truth, self.render(reader, stage, k), counted) for k in range(self.request.seeds)
            ]
            found[f"psnr_{name}_db"] = decibel(float(np.mean([e["mse"] for e in each])))
            found[f"flip_{name}"] = float(np.mean([e["flip"] for e in each]))
        frames, truth = (self.zoom.aligned(f) for f in (self.zoom.render(reader), self.truths["zoom"]))
        found["flicker"], found["flicker_error"] = flicker(frames), flicker(frames - truth)
        return found

    # -- readers ------------------------------------------------------------------------------------------------------

    def bitmap(self, spp: int = 1, sampler: str = "independent") -> Reader:
        """Mitsuba's texture, with bytes."""
        m: Map = next(m for m in self.source.maps if m.name == self.request.map)
        data = mi.Bitmap(np.ascontiguousarray(np.rint(m.values * 255).astype(np.uint8)))
        bitmap = {"type": "bitmap", "bitmap": data, "raw": m.color_space != "srgb"}
        return Reader(lambda repeats: {**bitmap, "to_uv": test_scenes.to_uv(repeats)}, spp, sampler)

    def filtered(self, texture: dict, centred: bool) -> Reader:
        """A texture that filters itself, at one sample a pixel."""
        texture = {**texture, "channels": self.request.map}
        return Reader(
            lambda repeats: {**texture, "to_uv": test_scenes.to_uv(repeats)},
            path=CENTRED if centred else None,
            prepare=footprint.attach,
        )

    def uncompressed(self, pyramid: Pyramid, how: str, centred: bool) -> Reader:
        """``mipmap`` of a pyramid."""
        name = f"study {id(pyramid)}"
        PYRAMIDS[name] = pyramid
        return self.filtered({"type": "mipmap", "pyramid": name, **FILTERS[how]}, centred)


# -- jobs -------------------------------------------------------------------------------------------------------------


@dataclass
class _Truth(Job):
    """What a stage, or the zoom, really looks like; stays in the folder of models."""

    name: str
    setting: Setting
    key: str
    spp: int
    render: Callable[[Reader], np.ndarray]

    def _file(self, folder: Path) -> Path:
        return folder / f"{file_name(self.name)}.npz"

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        if not record or folder is None or not self._file(folder).is_file():
            return None
        with np.load(self._file(folder), allow_pickle=False) as found:
            self.setting.truths[self.key] = found["truth"]
        return record

    def run(self, folder: Path | None, progress: bool) -> dict:
        start = time.perf_counter()
        truth = self.render(self.setting.bitmap(self.spp, "multijitter"))
        self.setting.truths[self.key] = truth
        if folder is not None:
            with replacing(self._file(folder)) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, truth=truth)
        return {"seconds": time.perf_counter() - start}


@dataclass
class _Made(Job):
    """Something of its own in bytes; ``compression`` was asked for, ``kind`` is what it is called in legends."""

    name: str
    kind: str
    compression: float
    setting: Setting

    def record(self, nbytes: int, seconds: float | None, maps: dict[str, list[np.ndarray]], **details) -> dict:
        known = {"compression": self.compression, "ratio": self.setting.source.nbytes / nbytes, "kind": self.kind}
        found = levels.errors(self.setting.truth_levels, maps)
        return {"bytes": nbytes, "seconds": seconds, "details": {**known, **details, "levels": found}}


@dataclass
class _Table(_Made):
    """A table that was trained already, or ``seconds`` of a training, whose file stays in the folder of models."""

    preset: str = ""
    seconds: float = 0.0
    table: Table | None = None
    file: str = ""
    samples: str | None = None

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        self.file = str(self.table.path) if self.table else str(folder / f"{file_name(self.name)}.npz")
        return record if record and Path(self.file).is_file() else None

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        taken = None
        if self.table is None:
            fitted = task.fit(
                "texture", self.preset, mi.variant(), seconds=self.seconds, progress=progress,
                source=self.setting.name, compression=self.compression, deterministic=False, output=self.file,
                footprint_samples=self.samples, border="repeat",  # as the stages repeat it
            )  # fmt: skip
            if fitted.result.interrupted:
                return None
            save_table(self.file, fitted.table)
            taken = fitted.result.seconds
        texture, types = task.tasks()["texture"], array_module(mi.variant())
        found = texture.load(self.file)
        image = texture.model(found, types.TensorXf).image
        maps = levels.decoded(image, self.setting.pyramid.layout.names, self.setting.pyramid.levels)
        taken = found.settings.get("seconds") if taken is None else taken
        return self.record(found.nbytes, taken, maps, file=Path(self.file).name, preset=found.preset,
                           steps=found.settings.get("steps"))  # fmt: skip

    def reader(self, how: str, centred: bool) -> Reader:
        return self.setting.filtered({"type": "neural_texture", "filename": self.file, **FILTERS[how]}, centred)


@dataclass
class _Blocks(_Made):
    """ASTC of all levels, in the bytes of a table."""

    like: _Table | None = None
    cache: dict = field(default_factory=dict)
    decoded: dict | None = None

    def _file(self, folder: Path) -> Path:
        return folder / f"{file_name(self.name)}.npz"

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        if not record or folder is None or not self._file(folder).is_file():
            return None
        with np.load(self._file(folder), allow_pickle=False) as found:
            names, count = self.setting.pyramid.layout.names, self.setting.pyramid.levels
            self.decoded = {name: [found[f"{name}_{i}"] for i in range(count)] for name in names}
        return record

    def run(self, folder: Path | None, progress: bool) -> dict:
        start, request, source = time.perf_counter(), self.setting.request, self.setting.source
        nbytes = task.tasks()["texture"].load(self.like.file).nbytes
        normals = [m.name for m in source.maps if m.role == "normal"]
        found, nbytes = codecs.astc_levels(
            self.setting.truth_levels, nbytes, request.astc, normals, request.astc_choice, self.cache
        )
        self.decoded = {name: e.levels for name, e in found.items()}
        if folder is not None:
            arrays = {f"{name}_{i}": v for name, vs in self.decoded.items() for i, v in enumerate(vs)}
            with replacing(self._file(folder)) as temporary, open(temporary, "wb") as stream:
                np.savez(stream, **arrays)
        how = ", ".join(f"{name} {e.codec}" for name, e in found.items())
        return self.record(nbytes, None, self.decoded, how=how, encoding_seconds=time.perf_counter() - start)

    def reader(self, how: str, centred: bool) -> Reader:
        return self.setting.uncompressed(levels.pyramid_of(self.decoded, self.setting.pyramid), how, centred)


# -- candidates -------------------------------------------------------------------------------------------------------


def _candidates(setting: Setting, tables: Sequence[Table]) -> tuple[list[Job], list]:
    """The jobs, and all candidates, each with what makes its reader, once the jobs are done."""
    source, request = setting.source, setting.request
    jobs: list[Job] = [
        _Truth(
            f"truth, {name}",
            setting,
            name,
            request.truth_spp,
            lambda reader, s=stage: setting.render(reader, s, _TRUTH),
        )
        for name, stage in setting.stages.items()
    ]

    def frames(reader: Reader) -> np.ndarray:
        return setting.zoom.render(reader, _TRUTH >> 12)

    jobs.append(_Truth("truth, zoom", setting, "zoom", ZOOM_SPP, frames))
    found = []

    def add(name: str, kind: str, reader: Callable[[], Reader], **more) -> None:
        made: list[Reader] = []

        def once() -> Reader:
            if not made:
                made.append(reader())
            return made[0]

        found.append((Candidate(name, kind, **more), once))

    for spp in COUNTS:
        add(f"bitmap, {spp} spp", "bitmap", lambda n=spp: setting.bitmap(n), bytes=source.nbytes, setting=f"{spp} spp",
            queries=None if spp == 1 else ())  # fmt: skip
    for spp in COUNTS[1:]:
        add(f"bitmap, {spp} spp, multijittered", "bitmap, multijittered",
            lambda n=spp: setting.bitmap(n, "multijitter"), bytes=source.nbytes, setting=f"{spp} spp",
            queries=())  # fmt: skip

    def both(name: str, kind: str, reader: Callable[[str, bool], Reader], ways=WAYS, **more) -> None:
        for how, centred in ways:
            add(f"{name}, {how}{', centred' * centred}", kind, lambda h=how, c=centred: reader(h, c), setting=how,
                queries=() if centred else None, **more)  # fmt: skip

    pyramid_bytes = setting.pyramid.nbytes
    both("mipmap", "mip maps, uncompressed", lambda h, c: setting.uncompressed(setting.pyramid, h, c),
         bytes=pyramid_bytes)  # fmt: skip

    trained = [
        _Table(f"{t.preset} {ratio:.3g}x", KINDS.get(t.preset, "ours"), ratio, setting, table=t)
        for t, ratio in ((t, source.nbytes / t.nbytes) for t in tables)
    ]
    for compression in request.compressions:
        trained.append(_Table(f"ours {compression:g}x", "ours", compression, setting, seconds=request.seconds))
        if compression == request.compressions[0]:
            paper = f"paper {compression:g}x"
            trained.append(_Table(paper, KINDS["paper"], compression, setting, "paper", request.seconds))
    cache: dict = {}
    for i, job in enumerate(trained):
        jobs.append(job)
        known = {"job": job.name, "training_seconds": None, "in_picture": i == 0 or job.kind == "ours"}
        if job.kind != "ours":
            both(job.name, job.kind, job.reader, WAYS[:1], **known)
            continue
        both(job.name, job.kind, job.reader, (*WAYS, *(MORE if i == 0 else ())), **known)
        if "astc" in codecs.available():
            name = job.name.replace("ours", "ASTC")
            blocks = _Blocks(name, "ASTC with mip maps", job.compression, setting, like=job, cache=cache)
            jobs.append(blocks)
            both(blocks.name, blocks.kind, blocks.reader, WAYS[::3], job=blocks.name, training_seconds=None,
                 in_picture=i == 0)  # fmt: skip
    if request.footprints and request.compressions:
        compression = request.compressions[0]
        for preset, samples in SAMPLES:
            name = f"{preset} {compression:g}x, {samples} footprints"
            preset = "paper" if preset == "paper" else ""
            jobs.append(_Table(name, "footprints", compression, setting, preset, request.seconds, samples=samples))
    for candidate, _ in found:
        candidate.in_picture &= not candidate.name.endswith((", off", ", stochastic"))
    return jobs, found


# -- time -------------------------------------------------------------------------------------------------------------


def _case(setting: Setting, stage: Stage, candidates: list[Candidate], readers: dict) -> Case:
    """Reads of the map where the stage shows it, and whole renders."""

    def reads(lanes: int) -> dict:
        scene = readers[BASE]().loaded(stage, setting.request.film, setting.size)
        width = max(1, round((1.5 * lanes) ** 0.5))
        index = np.arange(lanes)
        si = stage.hits(scene, (index % width + 0.5) / width, (index // width + 0.5) / -(-lanes // width))
        dr.make_opaque(si.uv, si.p, si.dp_du, si.dp_dv, si.wi, si.sh_frame, si.duv_dx, si.duv_dy)
        cone = footprint.Cone.of(scene.sensors()[0])
        found = {FLOOR: lambda: [si.uv.x, si.uv.y]}
        repeats = stage.repeats(setting.request.film, setting.size)
        for candidate in candidates:
            if candidate.queries is None:
                texture = mi.load_dict(readers[candidate.name]().texture(repeats))
                if hasattr(texture, "set_cone"):
                    texture.set_cone(cone)
                found[candidate.name] = lambda t=texture: t.eval(si)
        return {"read": found}

    def passes() -> dict:
        found = {}
        for candidate in candidates:
            reader = readers[candidate.name]()
            scene = reader.loaded(stage, setting.request.film, setting.size)
            found[candidate.name] = lambda k, s=scene, spp=reader.spp: mi.render(s, spp=spp, seed=k)
        return found

    return Case(
        stage.name, reads, passes, accuracy=f"psnr_{stage.name}_db", of_passes=True, in_picture=not stage.magnified,
        details={"repeats": stage.repeats(setting.request.film, setting.size), "magnified": stage.magnified},
    )  # fmt: skip
