"""
What the study of compressed images compares: bytes, seconds and reads of each, and its errors.

Three measurements. *Bytes*: at each compression ratio, indirection into cascaded arrays of 2, 3 and 4 dimensions by our
preset and the paper's, and codecs (:mod:`..baselines.codecs`) at the largest size that is not above; ASTC with one
block size for all maps and with the best that can be had by giving each map its own. *Seconds*: both presets, trainings
of several lengths, each with a schedule of its own. *Time*: kernels that read all maps of a material at random and at
coherent places, :class:`bitmap` with 8 bits and with floats beside ``neural_image``.

Errors are those of values as they are in the source's files; FLIP and SSIM are means over maps, each shown as a
picture.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import metrics, task
from ...maps.source import Source
from ...measure.store import file_name
from ...measure.study import FLOOR, Candidate, Case, Job, Plan
from ...runtime import array_module
from ...tables import save_table
from ...tasks.image import search, training
from ...tasks.image.compressed import CompressedImage
from ...tasks.image.presets import IMPROVEMENTS, PRESETS, ImageRecipe, replaced, without
from ..baselines import codecs
from .conclusions import conclusions, table

#: The bitmaps that reads are compared with.
BITMAPS = {"bitmap, 8 bits": True, "bitmap, floats": False}


@dataclass(frozen=True)
class Request:
    """
    ``compressions`` asked for, ``seconds`` of the trainings, ``paper_seconds`` of those by the paper's preset, ``dims``
    of the cascaded arrays that are compared (4: all trainings, others: the shortest); ``ablation``: also train our
    preset with each of its improvements switched off; ``astc``: the preset of its encoder, ``astc_choice``: that by
    which block sizes are chosen (presets differ by dB, and not by the same for each block size).
    """

    compressions: tuple[float, ...] = (12.0,)
    seconds: tuple[float, ...] = (60.0,)
    paper_seconds: tuple[float, ...] = (60.0,)
    dims: tuple[int, ...] = (2, 3, 4)
    ablation: bool = False
    astc: str = "exhaustive"
    astc_choice: str = "medium"


def plan(source: Source, name: str, request: Request) -> Plan:
    """What is measured of ``source``, of the file ``name``, in the variant that is set."""
    jobs = [*_trainings(source, request), *_codecs(source, request)]
    candidates = [job.candidate() for job in jobs]
    candidates += [
        Candidate(label, "Mitsuba", is_reference=True, bytes=source.nbytes * (1 if eight else 4), in_passes=False)
        for label, eight in BITMAPS.items()
    ]

    read = [j for j in jobs if isinstance(j, _Training) and j.compression == request.compressions[0]]
    read = {job.name: job for job in read if job.candidate().in_picture}
    cases = [
        Case(
            f"{place} places",
            lambda lanes, p=place: _reads(source, read, p, lanes),
            candidates=(*read, *BITMAPS),
            in_picture=place == "random",
        )
        for place in ("random", "coherent")
    ]
    missing = [*codecs.missing(), *(["SSIM"] if importlib.util.find_spec("skimage") is None else [])]
    notes = [
        f"{name}, {source.width} × {source.height}, {len(source.maps)} map(s), {source.nbytes:,} bytes. PSNR of all "
        "channels together. JPEG and WebP have no random access."
    ]
    if missing:
        notes.append(f'Left out, not being installed: {", ".join(missing)}; pip install "mi-diffind[compare]"')
    return Plan(
        study="image",
        title=f"Compressed image: {Path(name).stem}",
        variant=mi.variant(),
        candidates=candidates,
        cases=cases,
        queries=("read",),
        accuracy="psnr_db",
        accuracy_label="PSNR, dB",
        ratios=[(c.name, "bitmap, 8 bits") for c in candidates if c.name != "bitmap, 8 bits"],
        details={
            "source": name, "source_digest": source.digest, "source_bytes": source.nbytes, "width": source.width,
            "height": source.height, "maps": {m.name: m.channels for m in source.maps}, "request": asdict(request),
            "codecs": list(codecs.available()),
        },
        notes=notes,
        jobs=jobs,
        jobs_fingerprint=source.digest,
        panels=("bytes", "training_seconds"),
        table=table,
        conclusions=conclusions,
    )  # fmt: skip


# -- candidates -------------------------------------------------------------------------------------------------------


@dataclass
class _Made(Job):
    """A candidate of its own, of a ``representation`` and at the ``compression`` asked for (0: whatever comes out)."""

    name: str
    representation: str
    compression: float
    source: Source
    random_access: bool = True

    def candidate(self) -> Candidate:
        label = self.representation + ("" if self.random_access else " (no random access)")
        return Candidate(
            self.name, label, job=self.name, competes=self.random_access, in_passes=False,
            in_picture=" without " not in self.name,
        )  # fmt: skip

    def record(
        self, nbytes: int, seconds: float | None, maps: dict[str, np.ndarray], between_db=None, **details
    ) -> dict:
        errors = errors_of(self.source, maps)
        errors["psnr_between_db"] = between(self.source, maps) if between_db is None else between_db
        details |= {"compression": self.compression or None, "ratio": self.source.nbytes / nbytes}
        details |= {"random_access": self.random_access, "kind": self.representation}
        return {"bytes": nbytes, "seconds": seconds, "errors": errors, "details": details}


@dataclass
class _Training(_Made):
    """A training of so many seconds on all cores; its file stays in the folder of models."""

    recipe: ImageRecipe | None = None
    preset: str = ""
    seconds: float = 0.0
    file: str = ""

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        self.file = str(folder / f"{file_name(self.name)}.npz") if folder else ""
        return record if record and Path(self.file).is_file() else None

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        source, own = self.source, replaced(self.recipe, deterministic=False)
        types = array_module(mi.variant())
        asked = task.FitRequest(self.preset, own.settings, types, seconds=self.seconds, progress=progress)
        size = search.default_size(source, source.nbytes / self.compression, own)
        table, result = training.fit_image(source, size, own, asked, title=self.name)
        if result.interrupted:
            return None
        if self.file:
            save_table(self.file, table)
        image = CompressedImage.of(table, types.TensorXf)
        course = [(h["step"] * result.seconds / result.steps, h["psnr_db"]) for h in result.history]
        return self.record(
            table.nbytes, result.seconds, image.decode(), table.measured["psnr_between_db"], file=self.file,
            seconds_asked=self.seconds, steps=result.steps, structure=table.settings["structure"],
            dims=size.dims, rows=size.rows, cascaded=size.cascaded, course=course,
            memory_bytes=sum(a.memory_nbytes for a in (*image.net.primary, image.net.cascaded)),
        )  # fmt: skip


@dataclass
class _Codec(_Made):
    """What a codec makes: ``encode()`` returns the encoded maps by name, and their bytes."""

    encode: Callable[[], tuple[dict[str, codecs.Encoded], int]] | None = None

    def run(self, folder: Path | None, progress: bool) -> dict:
        start = time.perf_counter()
        encoded, nbytes = self.encode()
        seconds = time.perf_counter() - start
        how = ", ".join(f"{name} {e.codec}" for name, e in encoded.items())
        maps = {name: e.image for name, e in encoded.items()}
        return self.record(nbytes, None, maps, how=how, encoding_seconds=seconds)


def _trainings(source: Source, request: Request) -> list[_Training]:
    jobs = []
    shortest, ours, paper = min(request.seconds), PRESETS["ours"], PRESETS["paper"]
    for compression in request.compressions:

        def train(name: str, recipe, seconds: float, kind="indirection", compression=compression):
            full, preset = f"{name} {compression:g}x {seconds:g} s", name.split()[0]
            jobs.append(_Training(full, kind, compression, source, recipe=recipe, preset=preset, seconds=seconds))

        first = compression == request.compressions[0]
        for seconds in sorted(request.seconds) if first else [shortest]:
            train("ours", ours, seconds)
        if not first:
            continue
        for seconds in request.paper_seconds:
            train("paper", paper, seconds, "indirection, paper's preset")
        for dims in sorted({*request.dims} - {4}):
            train(f"ours 2D→{dims}D", dataclasses.replace(ours, dims=dims), shortest)
        for name in IMPROVEMENTS if request.ablation else ():
            train(f"ours without {name}", without(ours, [name]), shortest)
    return jobs


def _codecs(source: Source, request: Request) -> list[_Codec]:
    """What of the codecs is installed; all maps together take at most the bytes that are asked for."""
    values = {m.name: _shown(m.values) for m in source.maps}
    normals = [m.name for m in source.maps if m.role == "normal"]
    found, cache, jobs = codecs.available(), {}, []
    if any(v.shape[-1] > 4 for v in values.values()):
        return []
    for compression in request.compressions:
        nbytes = source.nbytes / compression

        def blocks(uniform: bool, nbytes=nbytes):
            return codecs.astc_material(
                values, nbytes, request.astc, uniform, normals, (1, 2), request.astc_choice, cache
            )

        def maps(codec: str, nbytes=nbytes):
            shares = {name: int(nbytes * v.shape[-1] / source.channels) for name, v in values.items()}
            parts = {name: codecs.at_bytes(codec, v, shares[name]) for name, v in values.items()}
            return parts, sum(p.nbytes for p in parts.values())

        def add(name: str, kind: str, encode, access=True, asked=compression):
            jobs.append(_Codec(name, kind, asked, source, access, encode=encode))

        mark = f"{compression:g}x"
        if "astc" in found:
            add(f"ASTC {mark}, one block size", "ASTC", lambda b=blocks: b(True))
            if len(values) > 1:
                add(f"ASTC {mark}, each map its own", "ASTC", lambda b=blocks: b(False))
        if "bc7" in found and compression == request.compressions[0]:
            add("BC7", "BC7", lambda m=maps: m("bc7"), asked=0.0)
        for codec, name, access in (("jpeg", "JPEG", False), ("webp", "WebP", False), ("bicubic", "bicubic", True)):
            if codec in found:
                add(f"{name} {mark}", name, lambda m=maps, c=codec: m(c), access)
    return jobs


def _shown(values: np.ndarray) -> np.ndarray:
    """What codecs of 8 bits can hold."""
    return np.clip(values, 0, 1).astype(np.float32)


def errors_of(source: Source, maps: dict[str, np.ndarray]) -> dict:
    """
    ``psnr_db`` of all channels together, ``psnr_mean_db`` over maps, ``flip`` and ``ssim``, means over maps, and of
    each map ``psnr_NAME_db``, ``flip_NAME``, ``ssim_NAME``, of normal maps ``angle_NAME_deg``, the mean angle.
    """
    found, errors, weights = {}, [], []
    for m in source.maps:
        reference, image = _shown(m.values), _shown(np.round(np.clip(maps[m.name], 0, 1) * 255) / 255)
        errors.append(float(np.mean((reference - image) ** 2, dtype=np.float64)))
        weights.append(m.channels)
        found[f"psnr_{m.name}_db"] = -10 * math.log10(max(errors[-1], 1e-12))
        found[f"flip_{m.name}"] = metrics.flip_shown(_picture(reference), _picture(image))
        found[f"ssim_{m.name}"] = metrics.ssim(reference, image)
        if m.role == "normal" and m.channels == 3:
            found[f"angle_{m.name}_deg"] = metrics.angle(reference, image)

    def mean(measure: str) -> float | None:
        values = [v for k, v in found.items() if k.startswith(f"{measure}_")]
        return float(np.mean(values)) if None not in values else None

    joint = float(np.average(errors, weights=weights))
    return {"psnr_db": -10 * math.log10(max(joint, 1e-12)), "psnr_mean_db": mean("psnr"), "flip": mean("flip"),
            "ssim": mean("ssim"), **found}  # fmt: skip


def between(source: Source, maps: dict[str, np.ndarray]) -> float:
    """PSNR, in dB, of all channels between texels, one place in each: bilinear interpolation of ``maps`` and source."""
    total, random = 0.0, np.random.default_rng(2023)
    a, b = random.random((2, source.height, source.width, 1), dtype=np.float32)
    for m in source.maps:
        e = _shown(maps[m.name]) - _shown(m.values)
        e = (1 - a) * e + a * np.roll(e, -1, axis=0)  # the interpolation of the difference
        e = (1 - b) * e + b * np.roll(e, -1, axis=1)
        total += float(np.mean(e**2, dtype=np.float64)) * m.channels / source.channels
    return -10 * math.log10(max(total, 1e-12))


def _picture(values: np.ndarray) -> np.ndarray:
    """Three channels to look at."""
    if values.shape[-1] >= 3:
        return values[..., :3]
    return np.repeat(values[..., :1], 3, axis=-1)


# -- time of a read ---------------------------------------------------------------------------------------------------


def _reads(source: Source, jobs: dict[str, _Training], place: str, lanes: int) -> dict:
    """All maps at a place, by each training's file and by bitmaps."""
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

    found = {FLOOR: lambda: [si.uv.x, si.uv.y]}
    found |= {name: read(_bitmaps(source, eight)) for name, eight in BITMAPS.items()}
    for name, job in jobs.items():
        plugin = {"type": "neural_image", "filename": job.file, "raw": True}
        found[name] = read([(mi.load_dict({**plugin, "channels": m.name}), m.channels) for m in source.maps])
    return {"read": found}


def _bitmaps(source: Source, eight: bool) -> list:
    """Mitsuba's textures of the maps, of those with 1 or 3 channels, or parts of them."""
    found = []
    for m in source.maps:
        values = _shown(m.values[..., :3] if m.channels >= 3 else m.values[..., :1])
        data = np.ascontiguousarray(np.rint(values * 255).astype(np.uint8) if eight else values)
        bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": True}
        found.append((mi.load_dict(bitmap), values.shape[-1]))
    return found


def _evaluated(texture, si, channels: int):
    if channels == 1:
        return texture.eval_1(si)
    return texture.eval_3(si) if channels == 3 else texture.eval(si)
