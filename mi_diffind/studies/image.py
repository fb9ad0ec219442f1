"""Study ``tradeoff image``: quality of a compressed image or material against bytes, seconds of training and read time.

*Bytes*: at each compression ratio, indirection into cascaded arrays of 2, 3 and 4 dimensions by our preset and the
paper's is compared with a hash grid and network and with codecs (:mod:`.baselines.codecs`) at the largest size that is
not above; ASTC with one block size for all maps and with the best block size of each map. *Seconds*: trainings of
several lengths by both presets, each with its own schedule. *Time*: kernels read all maps of a material at random and
at coherent places, from ``neural_image`` and from ``bitmap`` with 8 bits and with floats.

Errors are those of the values in the source's files; FLIP and SSIM are means over maps, each shown as a picture.
Materials with normals or roughness are also compared as they are seen (:mod:`mi_diffind.maps.as_seen`).
"""

from __future__ import annotations

import argparse
import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.arguments import positive
from ..core.progress import Deadline
from ..core.runtime import array_module
from ..core.units import parse_compression
from ..fitting.loop import FitSettings, fit
from ..images import metrics
from ..maps import as_seen
from ..maps.pyramid import decibel
from ..maps.source import Source, load_source
from ..measure.study import FLOOR, Candidate, Case, Measure, Plan, Study
from ..measure.training import halve
from . import equal_memory
from .baselines import codecs, networks
from .equal_memory import Contender
from .texture import add_astc_option, source_details

#: Bitmaps whose reads are timed → whether they hold 8-bit values.
BITMAPS = {"bitmap, 8 bits": True, "bitmap, floats": False}

#: Training of the network; ``seconds`` end it.
NETWORK_SETTINGS = FitSettings(steps=10**6, batch=2**12, lr=1e-2, schedule="cosine", loss="mse", measure_every=200)

MEASURES = (
    Measure("PSNR", "psnr_db"),
    Measure("between texels", "psnr_between_db"),
    Measure("mean of maps", "psnr_mean_db"),
    Measure("FLIP", "flip", ".4f", False),
    Measure("SSIM", "ssim", ".3f"),
    Measure("as seen", "seen_db"),
)


#: Options that may be repeated → help, type, choices.
_REPEATED = {
    "--compression": ("compression ratio, such as 12x (default)", str, None),
    "--seconds": ("seconds of each training by our preset (default: 60; --quick: 2)", positive, None),
    "--paper-seconds": ("seconds of each by the paper's preset (default: the longest of --seconds)", positive, None),
    "--dims": ("dimensions of the cascaded array, 2, 3 or 4 (default: all)", int, (2, 3, 4)),
}


class ImageStudy(Study):
    """Quality of a compressed image or material against bytes, seconds of training and time of a read."""

    name = "image"
    title = "a compressed image or material, in bytes, training and reads"
    example = "material.json"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("source", metavar="IMAGE|MATERIAL.json")
        for option, (text, value_type, choices) in _REPEATED.items():
            parser.add_argument(option, action="append", default=[], type=value_type, choices=choices, metavar="N",
                                help=f"{text}; may be repeated")  # fmt: skip
        add_astc_option(parser)

    def check(self, arguments) -> None:
        """Check the options and load the source; raise as :func:`.load_source` does."""
        arguments.compressions = tuple(map(parse_compression, arguments.compression)) or (12.0,)
        arguments.loaded = load_source(arguments.source)

    def plan(self, arguments) -> Plan:
        quick = arguments.quick
        seconds = tuple(map(float, arguments.seconds)) or (2.0 if quick else 60.0,)
        settings = SimpleNamespace(
            compressions=arguments.compressions[:1] if quick else arguments.compressions,
            seconds=seconds,
            paper_seconds=tuple(map(float, arguments.paper_seconds)) or (max(seconds),),
            dims=tuple(arguments.dims) or (2, 3, 4),
            astc="fast" if quick else arguments.astc,
            astc_choice="fast" if quick else "medium",  # preset that selects block sizes
        )
        return plan(arguments.loaded, arguments.source, settings)


STUDY = ImageStudy()


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class ImageStudyContext:
    """The source, the file ``name`` that it was read from, and the settings."""

    source: Source
    name: str
    settings: SimpleNamespace

    def record(
        self, job: Contender, nbytes: int, seconds: float | None, maps: dict, between_db=None, **details
    ) -> dict:
        """Return the record of an encoding with its errors; ``maps`` are the decoded maps by name."""
        errors = errors_of(self.source, maps)
        errors["psnr_between_db"] = between(self.source, maps) if between_db is None else between_db
        seen = as_seen.compare(self.source, maps, array_module())
        errors |= {name: value for name, value in seen.items() if name.startswith("seen_")}
        details |= {"compression": job.budget or None, "ratio": self.source.nbytes / nbytes, "kind": job.method}
        details["random_access"] = job.details["random_access"]
        return {"bytes": nbytes, "seconds": seconds, "errors": errors, "details": details}

    def contender(self, name: str, method: str, budget: float, fit: Callable, read=None, random_access=True):
        """Return a contender; a budget of 0 stands for a method of one size."""
        label = method + ("" if random_access else " (no random access)")
        return Contender(name, method, budget, fit, read, label, has_file=read is not None,
                         details={"random_access": random_access})  # fmt: skip

    def trained(self, name: str, method: str, compression: float, seconds: float, **options) -> Contender:
        """Return an indirection, trained for ``seconds`` by the preset that begins its name, with further options."""

        def train(job: Contender, progress: bool) -> dict | None:
            arguments = {"source": self.name, "compression": compression, "seconds": seconds, **options}
            trained = equal_memory.fit_preset(job, progress, "image", "image", name.split()[0], arguments)
            if trained is None:
                return None
            model, fitted = trained
            table, result = fitted.table, fitted.result
            primary, *_, cascaded = (array.shape for array in table.arrays.values())
            curve = [(h["step"] * result.seconds / result.steps, h["psnr_db"]) for h in result.history]
            return self.record(
                job, table.nbytes, result.seconds, model.image.decode(), table.measured["psnr_between_db"],
                file=str(job.file), seconds_asked=seconds, steps=result.steps, structure=table.settings["structure"],
                course=curve, rows=primary[0], cascaded=cascaded[0], dims=len(cascaded) - 1,
                memory_bytes=model.memory_nbytes,
            )  # fmt: skip

        def read(job: Contender):
            return equal_memory.open_preset(job, "image").image

        return self.contender(f"{name} {compression:g}x {seconds:g} s", method, compression, train, read)

    def encoded(self, name: str, method: str, budget: float, encode: Callable, random_access: bool = True) -> Contender:
        """Return maps encoded by a codec; ``encode()`` returns the encoded maps by name, and their bytes."""

        def fit(job: Contender, progress: bool) -> dict:
            start = time.perf_counter()
            encoded, nbytes = encode()
            seconds = time.perf_counter() - start
            how = ", ".join(f"{name} {e.codec}" for name, e in encoded.items())
            maps = {name: e.image for name, e in encoded.items()}
            return self.record(job, nbytes, None, maps, how=how, encoding_seconds=seconds)

        return self.contender(name, method, budget, fit, random_access=random_access)

    def network(self, compression: float, seconds: float) -> Contender:
        """Return a hash grid and network in half precision, trained for ``seconds``."""
        name = f"hash grid + network {compression:g}x {seconds:g} s"

        def train(job: Contender, progress: bool) -> dict | None:
            net = networks.image_network(self.source, self.source.nbytes / compression)
            problem = networks.ImageNetworkProblem(net, array_module(mi.variant()), self.source)
            title = f"train {name}" if progress else None
            result = fit(problem, NETWORK_SETTINGS, progress=progress, title=title, deadline=Deadline(seconds))
            if result.interrupted:
                return None
            halve(problem.net)
            curve = [(h["step"] * result.seconds / result.steps, h["psnr_db"]) for h in result.history]
            nbytes, maps = 2 * problem.net.parameters, problem.decode(problem.net)
            return self.record(job, nbytes, result.seconds, maps, steps=result.steps, course=curve)

        return self.contender(name, "network", compression, train)


def trained_contenders(context: ImageStudyContext) -> list[Contender]:
    """Return the trainings at all ratios; further lengths, presets and dimensions are those of the first one."""
    settings, (first, *others) = context.settings, context.settings.compressions
    shortest = min(settings.seconds)
    jobs = [context.trained("ours", "indirection", first, seconds) for seconds in sorted(settings.seconds)]
    for seconds in settings.paper_seconds:
        jobs.append(context.trained("paper", "indirection, paper's preset", first, seconds))
    with contextlib.suppress(ValueError):  # too few bytes for a network
        networks.image_network(context.source, context.source.nbytes / first)
        jobs.append(context.network(first, max(settings.seconds)))
    for dims in sorted({*settings.dims} - {4}):
        jobs.append(context.trained(f"ours 2D→{dims}D", "indirection", first, shortest, dims=dims))
    return jobs + [context.trained("ours", "indirection", compression, shortest) for compression in others]


def coded_contenders(context: ImageStudyContext) -> list[Contender]:
    """Return a contender for each installed codec at each ratio; all maps together take at most the bytes of it."""
    source, settings = context.source, context.settings
    values = {m.name: _clipped(m.values) for m in source.maps}
    normals = [m.name for m in source.maps if m.role == "normal"]
    installed, cache, jobs = codecs.available(), {}, []
    if any(v.shape[-1] > 4 for v in values.values()):
        return []
    for compression in settings.compressions:
        nbytes, ratio = source.nbytes / compression, f"{compression:g}x"

        def blocks(uniform: bool, nbytes=nbytes):
            return codecs.astc_material(
                values, nbytes, settings.astc, uniform, normals, (1, 2), settings.astc_choice, cache
            )

        def maps(codec: str, nbytes=nbytes):
            shares = {name: int(nbytes * v.shape[-1] / source.channels) for name, v in values.items()}
            parts = {name: codecs.at_bytes(codec, v, shares[name]) for name, v in values.items()}
            return parts, sum(p.nbytes for p in parts.values())

        if "astc" in installed:
            jobs.append(context.encoded(f"ASTC {ratio}, one block size", "ASTC", compression, lambda b=blocks: b(True)))
            if len(values) > 1:
                each = f"ASTC {ratio}, each map its own"
                jobs.append(context.encoded(each, "ASTC", compression, lambda b=blocks: b(False)))
        if "bc7" in installed and compression == settings.compressions[0]:
            jobs.append(context.encoded("BC7", "BC7", 0.0, lambda m=maps: m("bc7")))
        for codec, name in (("jpeg", "JPEG"), ("webp", "WebP"), ("bicubic", "bicubic")):
            if codec in installed:
                encode = lambda m=maps, c=codec: m(c)  # noqa: E731
                jobs.append(context.encoded(f"{name} {ratio}", name, compression, encode, codec == "bicubic"))
    return jobs


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(source: Source, name: str, settings: SimpleNamespace) -> Plan:
    """Return the plan for ``source``, read from the file ``name``, in the current variant."""
    context = ImageStudyContext(source, name, settings)
    trained = trained_contenders(context)
    jobs = [*trained, *coded_contenders(context)]
    candidates = [
        job.candidate(competes=job.details["random_access"], in_passes=False,
                      label=job.name)
        for job in jobs
    ]  # fmt: skip
    candidates += [
        Candidate(label, "Mitsuba", is_reference=True, bytes=source.nbytes * (1 if eight else 4), in_passes=False)
        for label, eight in BITMAPS.items()
    ]
    timed = {
        job.name: job for job in trained
        if job.has_file and job.budget == settings.compressions[0]
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
        details={**source_details(source, name), "request": vars(settings), "codecs": list(codecs.available())},
        notes=[note, *codecs.install_notes()],
        jobs=jobs,
        jobs_fingerprint=source.digest,
        panels=("bytes", "training_seconds"),
        measures=MEASURES,
    )


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


def _reads(source: Source, jobs: dict[str, Contender], place: str, lanes: int) -> dict:
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
