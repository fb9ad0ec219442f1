"""Plan of the image study: contenders in equal bytes, with their errors, seconds of training and time of a read.

*Bytes*: at each compression ratio, indirection into cascaded arrays of 2, 3 and 4 dimensions by our preset and the
paper's is compared with a hash grid and network (:mod:`..baselines.image_networks`) and with codecs
(:mod:`..baselines.codecs`) at the largest size that is not above; ASTC with one block size for all maps and with the
best block size of each map. *Seconds*: trainings of several lengths by both presets,
each with its own schedule. *Time*: kernels read all maps of a material at random and at coherent places, from
``neural_image`` and from ``bitmap`` with 8 bits and with floats.

Errors are those of the values in the source's files; FLIP and SSIM are means over maps, each shown as a picture.
Materials with normals or roughness are also compared as they are seen (:mod:`mi_diffind.maps.as_seen`).
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.progress import Deadline
from ...core.runtime import array_module
from ...fitting.loop import FitSettings, fit
from ...images import metrics
from ...maps import as_seen
from ...maps.compressed import decibel
from ...maps.source import Source
from ...measure.study import FLOOR, Candidate, Case, Plan
from ...tasks.image import IMPROVEMENTS
from ..baselines import codecs, image_networks
from ..baselines.hash_grids import halved
from ..equal_memory import Contender, PresetContender, StudyContext
from ..maps import source_details
from .conclusions import conclusions, table

#: Bitmaps whose reads are timed → whether they hold 8-bit values.
BITMAPS = {"bitmap, 8 bits": True, "bitmap, floats": False}


@dataclass(frozen=True)
class ImageStudySettings:
    """Settings of the image study.

    ``compressions`` are the compression ratios, ``seconds`` and ``paper_seconds`` the lengths of trainings by our and
    by the paper's preset, ``dims`` the dimensions of the cascaded array (4: all trainings, others: the shortest).
    ``ablation`` adds our preset with each improvement switched off. ``astc`` is the preset of the ASTC encoder,
    ``astc_choice`` the one that selects block sizes.
    """

    compressions: tuple[float, ...] = (12.0,)
    seconds: tuple[float, ...] = (60.0,)
    paper_seconds: tuple[float, ...] = (60.0,)
    dims: tuple[int, ...] = (2, 3, 4)
    ablation: bool = False
    astc: str = "exhaustive"
    astc_choice: str = "medium"


@dataclass
class ImageStudyContext(StudyContext):
    """The source, the file ``name`` that it was read from, and the settings."""

    source: Source
    name: str
    settings: ImageStudySettings


def plan(source: Source, name: str, settings: ImageStudySettings) -> Plan:
    """Return the plan for ``source``, read from the file ``name``, in the current variant."""
    context = ImageStudyContext(source, name, settings)
    jobs = [*_trainings(context), *_codecs(context)]
    candidates = [job.candidate() for job in jobs]
    candidates += [
        Candidate(label, "Mitsuba", is_reference=True, bytes=source.nbytes * (1 if eight else 4), in_passes=False)
        for label, eight in BITMAPS.items()
    ]
    timed = {
        job.name: job for job in jobs
        if isinstance(job, TrainedImage) and job.budget == settings.compressions[0] and job.candidate().in_picture
    }  # fmt: skip
    cases = [
        Case(
            f"{place} places",
            lambda lanes, p=place: _reads(source, timed, p, lanes),
            candidates=(*timed, *BITMAPS),
            in_picture=place == "random",
        )
        for place in ("random", "coherent")
    ]
    note = (
        f"{name}, {source.width} × {source.height}, {len(source.maps)} map(s), {source.nbytes:,} bytes. PSNR of all "
        "channels together. JPEG and WebP have no random access."
    )
    return Plan(
        study="image",
        title=f"Compressed image: {Path(name).stem}",
        candidates=candidates,
        cases=cases,
        queries=("read",),
        accuracy="psnr_db",
        accuracy_label="PSNR, dB",
        ratios=[(c.name, "bitmap, 8 bits") for c in candidates if c.name != "bitmap, 8 bits"],
        details={**source_details(source, name), "request": asdict(settings), "codecs": list(codecs.available())},
        notes=[note, *codecs.install_notes()],
        jobs=jobs,
        jobs_fingerprint=source.digest,
        panels=("bytes", "training_seconds"),
        table=table,
        conclusions=conclusions,
    )


@dataclass
class ImageContender(Contender):
    """The maps of the source encoded by a method at a compression ratio (``budget``; 0: the method has one size)."""

    random_access: bool = True

    def candidate(self) -> Candidate:
        label = self.method + ("" if self.random_access else " (no random access)")
        return Candidate(
            self.name, label, job=self.name, competes=self.random_access, in_passes=False,
            in_picture=" without " not in self.name,
        )  # fmt: skip

    def record(
        self, nbytes: int, seconds: float | None, maps: dict[str, np.ndarray], between_db=None, **details
    ) -> dict:
        """Return the record of an encoding with its errors; ``maps`` are the decoded maps by name."""
        source = self.context.source
        errors = errors_of(source, maps)
        errors["psnr_between_db"] = between(source, maps) if between_db is None else between_db
        seen = as_seen.compare(source, maps, array_module())
        errors |= {name: value for name, value in seen.items() if name.startswith("seen_")}
        details |= {"compression": self.budget or None, "ratio": source.nbytes / nbytes}
        details |= {"random_access": self.random_access, "kind": self.method}
        return {"bytes": nbytes, "seconds": seconds, "errors": errors, "details": details}


@dataclass
class TrainedImage(PresetContender, ImageContender):
    """Indirection, trained for ``seconds`` by a preset of ``fit image`` with further ``options``."""

    task_name, model_part = "image", "image"
    preset: str = ""
    seconds: float = 0.0
    options: dict | None = None

    def arguments(self) -> dict:
        context = self.context
        return {"source": context.name, "compression": self.budget, "seconds": self.seconds, **(self.options or {})}

    def fit_record(self, task_model, fitted, seconds: float) -> dict:
        table, result, image = fitted.table, fitted.result, task_model.image
        primary, *_, cascaded = (array.shape for array in table.arrays.values())
        curve = [(h["step"] * result.seconds / result.steps, h["psnr_db"]) for h in result.history]
        return self.record(
            table.nbytes, result.seconds, image.decode(), table.measured["psnr_between_db"], file=str(self.file),
            seconds_asked=self.seconds, steps=result.steps, structure=table.settings["structure"], course=curve,
            rows=primary[0], cascaded=cascaded[0], dims=len(cascaded) - 1, memory_bytes=task_model.memory_nbytes,
        )  # fmt: skip


@dataclass
class EncodedImage(ImageContender):
    """Maps encoded by a codec; ``encode()`` returns the encoded maps by name, and their bytes."""

    has_file = False
    encode: Callable[[], tuple[dict[str, codecs.Encoded], int]] | None = None

    def run(self, folder: Path | None, progress: bool) -> dict:
        start = time.perf_counter()
        encoded, nbytes = self.encode()
        seconds = time.perf_counter() - start
        names = ", ".join(f"{name} {e.codec}" for name, e in encoded.items())
        maps = {name: e.image for name, e in encoded.items()}
        return self.record(nbytes, None, maps, how=names, encoding_seconds=seconds)


#: Training of the network; ``seconds`` end it.
NETWORK_SETTINGS = FitSettings(steps=10**6, batch=2**12, lr=1e-2, schedule="cosine", loss="mse", measure_every=200)


@dataclass
class NetworkImage(ImageContender):
    """Hash grid and network in half precision, trained for ``seconds``."""

    has_file = False
    seconds: float = 0.0

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        source = self.context.source
        net = image_networks.network(source, source.nbytes / self.budget)
        problem = image_networks.ImageNetworkProblem(net, self.context.types, source)
        title = f"train {self.name}" if progress else None
        result = fit(problem, NETWORK_SETTINGS, progress=progress, title=title, deadline=Deadline(self.seconds))
        if result.interrupted:
            return None
        halved(problem.net)
        curve = [(h["step"] * result.seconds / result.steps, h["psnr_db"]) for h in result.history]
        maps = problem.decode(problem.net)
        return self.record(2 * problem.net.parameters, result.seconds, maps, steps=result.steps, course=curve)


def _trainings(context: ImageStudyContext) -> list[ImageContender]:
    jobs: list[ImageContender] = []
    settings = context.settings
    shortest = min(settings.seconds)

    def train(name: str, compression: float, seconds: float, method: str = "indirection", **options) -> None:
        jobs.append(
            TrainedImage(method, compression, context, f"{name} {compression:g}x {seconds:g} s",
                         preset=name.split()[0], seconds=seconds, options=options)
        )  # fmt: skip

    first, *others = settings.compressions
    for seconds in sorted(settings.seconds):
        train("ours", first, seconds)
    for seconds in settings.paper_seconds:
        train("paper", first, seconds, "indirection, paper's preset")
    with contextlib.suppress(ValueError):  # too few bytes for a network
        image_networks.network(context.source, context.source.nbytes / first)
        longest = max(settings.seconds)
        name = f"hash grid + network {first:g}x {longest:g} s"
        jobs.append(NetworkImage("network", first, context, name, seconds=longest))
    for dims in sorted({*settings.dims} - {4}):
        train(f"ours 2D→{dims}D", first, shortest, dims=dims)
    for name in IMPROVEMENTS if settings.ablation else ():
        train(f"ours without {name}", first, shortest, without=[name])
    for compression in others:
        train("ours", compression, shortest)
    return jobs


def _codecs(context: ImageStudyContext) -> list[EncodedImage]:
    """Return a contender for each installed codec at each ratio; all maps together take at most the bytes of it."""
    source, settings = context.source, context.settings
    values = {m.name: _clipped(m.values) for m in source.maps}
    normals = [m.name for m in source.maps if m.role == "normal"]
    installed, cache, jobs = codecs.available(), {}, []
    if any(v.shape[-1] > 4 for v in values.values()):
        return []
    for compression in settings.compressions:
        nbytes = source.nbytes / compression

        def blocks(uniform: bool, nbytes=nbytes):
            return codecs.astc_material(
                values, nbytes, settings.astc, uniform, normals, (1, 2), settings.astc_choice, cache
            )

        def maps(codec: str, nbytes=nbytes):
            shares = {name: int(nbytes * v.shape[-1] / source.channels) for name, v in values.items()}
            parts = {name: codecs.at_bytes(codec, v, shares[name]) for name, v in values.items()}
            return parts, sum(p.nbytes for p in parts.values())

        def add(name: str, method: str, encode, random_access=True, compression=compression):
            jobs.append(EncodedImage(method, compression, context, name, random_access=random_access, encode=encode))

        ratio = f"{compression:g}x"
        if "astc" in installed:
            add(f"ASTC {ratio}, one block size", "ASTC", lambda b=blocks: b(True))
            if len(values) > 1:
                add(f"ASTC {ratio}, each map its own", "ASTC", lambda b=blocks: b(False))
        if "bc7" in installed and compression == settings.compressions[0]:
            add("BC7", "BC7", lambda m=maps: m("bc7"), compression=0.0)
        for codec, name in (("jpeg", "JPEG"), ("webp", "WebP"), ("bicubic", "bicubic")):
            if codec in installed:
                add(f"{name} {ratio}", name, lambda m=maps, c=codec: m(c), codec == "bicubic")
    return jobs


def _clipped(values: np.ndarray) -> np.ndarray:
    """Return values in the range that codecs of 8 bits can hold."""
    return np.clip(values, 0, 1).astype(np.float32)


def errors_of(source: Source, maps: dict[str, np.ndarray]) -> dict:
    """Return the errors of decoded maps, rounded to 8 bits.

    ``psnr_db`` is that of all channels together; ``psnr_mean_db``, ``flip`` and ``ssim`` are means over maps. Each map
    has ``psnr_NAME_db``, ``flip_NAME``, ``ssim_NAME``, and normal maps ``angle_NAME_deg``, the mean angle.
    """
    errors, squares, weights = {}, [], []
    for m in source.maps:
        reference, image = _clipped(m.values), _clipped(np.round(np.clip(maps[m.name], 0, 1) * 255) / 255)
        squares.append(float(np.mean((reference - image) ** 2, dtype=np.float64)))
        weights.append(m.channels)
        errors[f"psnr_{m.name}_db"] = decibel(squares[-1])
        errors[f"flip_{m.name}"] = metrics.flip_shown(_picture(reference), _picture(image))
        errors[f"ssim_{m.name}"] = metrics.ssim(reference, image)
        if m.role == "normal" and m.channels == 3:
            errors[f"angle_{m.name}_deg"] = metrics.angle(reference, image)

    def mean(measure: str) -> float | None:
        values = [v for k, v in errors.items() if k.startswith(f"{measure}_")]
        return float(np.mean(values)) if None not in values else None

    joint = decibel(float(np.average(squares, weights=weights)))
    return {"psnr_db": joint, "psnr_mean_db": mean("psnr"), "flip": mean("flip"), "ssim": mean("ssim"), **errors}


def between(source: Source, maps: dict[str, np.ndarray]) -> float:
    """Return the PSNR, in dB, of all channels between texels: bilinear reads of maps and source, one in each texel."""
    total, random = 0.0, np.random.default_rng(2023)
    a, b = random.random((2, source.height, source.width, 1), dtype=np.float32)
    for m in source.maps:
        e = _clipped(maps[m.name]) - _clipped(m.values)
        e = (1 - a) * e + a * np.roll(e, -1, axis=0)  # the interpolation of the difference
        e = (1 - b) * e + b * np.roll(e, -1, axis=1)
        total += float(np.mean(e**2, dtype=np.float64)) * m.channels / source.channels
    return decibel(total)


def _picture(values: np.ndarray) -> np.ndarray:
    """Return three channels to show a map as a picture."""
    return values[..., :3] if values.shape[-1] >= 3 else np.repeat(values[..., :1], 3, axis=-1)


def _reads(source: Source, jobs: dict[str, TrainedImage], place: str, lanes: int) -> dict:
    """Return functions that read all maps, at places of a kind, from each trained file and from bitmaps."""
    rng, index = dr.rng(seed=dr.opaque(mi.UInt64, 3)), dr.arange(mi.UInt32, lanes)
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    if place == "random":
        si.uv = mi.Point2f(rng.random(mi.Float, lanes), rng.random(mi.Float, lanes))
    else:  # a square of neighbouring texels
        side = 2 ** (round(math.log2(lanes)) // 2)
        si.uv = mi.Point2f(mi.Float(index % side) / source.width, mi.Float(index // side) / source.height)
    dr.make_opaque(si.uv)

    def read(textures: list):
        return lambda: [_evaluated(texture, si, channels) for texture, channels in textures]

    functions = {FLOOR: lambda: [si.uv.x, si.uv.y]}
    functions |= {name: read(_bitmaps(source, eight)) for name, eight in BITMAPS.items()}
    for name, job in jobs.items():
        plugin = {"type": "neural_image", "filename": str(job.file), "raw": True}
        functions[name] = read([(mi.load_dict({**plugin, "channels": m.name}), m.channels) for m in source.maps])
    return {"read": functions}


def _bitmaps(source: Source, eight: bool) -> list:
    """Return ``(texture, channels)`` for each map: Mitsuba's bitmap of 1 or 3 of its channels."""
    textures = []
    for m in source.maps:
        values = _clipped(m.values[..., :3] if m.channels >= 3 else m.values[..., :1])
        data = np.ascontiguousarray(np.rint(values * 255).astype(np.uint8) if eight else values)
        bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True}
        textures.append((mi.load_dict(bitmap), values.shape[-1]))
    return textures


def _evaluated(texture, si, channels: int):
    if channels == 1:
        return texture.eval_1(si)
    return texture.eval_3(si) if channels == 3 else texture.eval(si)
