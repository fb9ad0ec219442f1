"""Study ``tradeoff image``: quality of a compressed image or material against bytes and the time of a read.

*Bytes*: at each compression ratio, arrays that ``fit image`` trains are compared with codecs (:mod:`.baselines.codecs`)
at the largest size that is not above, and at the first ratio with a hash grid and network; BC7 has one size. *Time*:
kernels read all maps of a material at random places, from ``neural_image`` and from ``bitmap`` with 8 bits.

Errors are those of the values in the source's files; FLIP is a mean over maps, each shown as a picture. Materials with
normals or roughness are also compared as they are seen (:mod:`mi_diffind.maps.as_seen`).
"""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
from PIL.Image import Resampling

from ..core.arguments import positive
from ..core.runtime import array_module
from ..core.units import parse_compression
from ..images import metrics
from ..maps import as_seen
from ..maps.pyramid import Pyramid, decibel
from ..maps.source import Source, load_source
from ..measure.study import FLOOR, Candidate, Case, Measure, Plan, Study
from ..measure.training import Contender
from . import equal_memory
from .baselines import codecs
from .texture import NETWORK_STEPS, network_contender, normal_maps, source_details

#: The bitmaps that ratios of times refer to.
BITMAP = "bitmap, 8 bits"

MEASURES = (
    Measure("PSNR, dB", "psnr_db"),
    Measure("between texels", "psnr_between_db"),
    Measure("FLIP", "flip", ".4f", False),
    Measure("as seen", "seen_db"),
)


class ImageStudy(Study):
    """Quality of a compressed image or material against bytes and time of a read."""

    name = "image"
    title = "a compressed image or material, in bytes and reads"
    example = "material.json"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("source", metavar="IMAGE|MATERIAL.json")
        parser.add_argument("--compression", action="append", default=[], metavar="N",
                            help="compression ratio (default: 12x); may be repeated")  # fmt: skip
        parser.add_argument("--seconds", type=positive, metavar="N",
                            help="seconds of each training by our preset (default: 60; --quick: 2)")  # fmt: skip

    def check(self, arguments) -> None:
        """Check the options and load the source; raise as :func:`.load_source` does."""
        arguments.compressions = tuple(map(parse_compression, arguments.compression)) or (12.0,)
        arguments.loaded = load_source(arguments.source)

    def plan(self, arguments) -> Plan:
        quick = arguments.quick
        settings = SimpleNamespace(
            compressions=arguments.compressions,
            seconds=float(arguments.seconds or (2 if quick else 60)),
            astc="fast" if quick else codecs.QUALITY,
            network_steps=(10, 20) if quick else NETWORK_STEPS,  # of the first and of the longest training
        )
        return plan(arguments.loaded, arguments.source, settings)


STUDY = ImageStudy()


# -- Contenders --------------------------------------------------------------------------------------------------------


def record(source: Source, nbytes: int, seconds: float | None, maps: dict, **details) -> dict:
    """Return the record of decoded ``maps``, name → resolutions, with the errors of the finest."""
    maps = {name: levels[0] for name, levels in maps.items()}
    details |= {"ratio": source.nbytes / nbytes}
    return {"bytes": nbytes, "seconds": seconds, "errors": map_errors(source, maps), "details": details}


def trained(source: Source, name: str, compression: float, seconds: float) -> Contender:
    """Return the contender that ``fit image`` trains for ``seconds`` on the source in the file ``name``."""

    def fit(job: Contender, progress: bool) -> dict | None:
        arguments = {"source": name, "compression": compression, "seconds": seconds}
        outcome = equal_memory.fit_preset(job, progress, "image", "image", "", arguments)
        if outcome is None:
            return None
        model, fitted = outcome
        table, result = fitted.table, fitted.result
        details = {"structure": table.settings["structure"], "steps": result.steps}
        maps = {name: [values] for name, values in model.image.decode().items()}
        return record(source, table.nbytes, result.seconds, maps, **details)

    read = partial(equal_memory.open_preset, task_name="image")
    return Contender(f"ours {compression:g}x", "ours", compression, fit, read)


def encoded(source: Source, codec: str, compression: float, quality: str, cache: dict) -> Contender:
    """Return the contender of a codec: all maps together take at most the bytes of a ratio.

    ``quality`` is the preset of ASTC; its ``cache`` is shared by all ratios.
    """
    title, images = codecs.TITLES[codec], {m.name: _clipped(m.values) for m in source.maps}
    nbytes, label = source.nbytes / compression, title + " (no random access)" * (codec in ("jpeg", "webp"))

    def resolutions(image: np.ndarray) -> list[np.ndarray]:
        rounded = np.rint(255 * image) / np.float32(255)
        return [image, codecs.resized(rounded, *(-(-n // 2) for n in image.shape[:2]), Resampling.LANCZOS)]

    def encode() -> dict:
        if codec == "astc":
            maps = {name: resolutions(image) for name, image in images.items()}
            return codecs.astc_levels(maps, nbytes, quality, normal_maps(source), False, cache)[0]
        if codec == "bc7":
            return {name: codecs.bc7(image) for name, image in images.items()}
        share = nbytes / source.channels
        return {n: codecs.image_file(codec, image, int(share * image.shape[-1])) for n, image in images.items()}

    def fit(job: Contender, progress: bool) -> dict:
        result = encode()
        how = ", ".join(f"{name} {e.codec}" for name, e in result.items())
        maps = {name: e.levels for name, e in result.items()}
        return record(source, sum(e.nbytes for e in result.values()), None, maps, how=how)

    name, budget = (title, 0.0) if codec == "bc7" else (f"{title} {compression:g}x", compression)
    return Contender(name, title, budget, fit, lambda job: None, label, has_file=False)


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(source: Source, name: str, settings: SimpleNamespace) -> Plan:
    """Return the plan for ``source``, read from the file ``name``, in the current variant."""
    compressions, cache = settings.compressions, {}
    ours = [trained(source, name, compression, settings.seconds) for compression in compressions]
    rivals = []
    with contextlib.suppress(ValueError):  # too few bytes for a network
        pyramid, finish = Pyramid.from_source(source, types=array_module()), partial(record, source)
        rivals.append(network_contender(source, pyramid, 1, compressions[0], settings.network_steps, finish))
    if all(m.channels <= 4 for m in source.maps):
        for codec in codecs.available():
            ratios = compressions[:1] if codec == "bc7" else compressions
            rivals += [encoded(source, codec, compression, settings.astc, cache) for compression in ratios]
    jobs = [*ours, *rivals]
    candidates = [job.candidate(competes="no random" not in job.label, label=job.name) for job in jobs]
    candidates.append(Candidate(BITMAP, "Mitsuba", is_reference=True, bytes=source.nbytes))
    note = (
        f"{name}, {source.width} × {source.height}, {len(source.maps)} map(s), {source.nbytes:,} bytes. PSNR of all "
        "channels together. JPEG and WebP have no random access."
    )
    return Plan(
        study="image",
        title=f"Compressed image {Path(name).stem}: error against bytes and time of a read",
        candidates=candidates,
        cases=[Case("reads of all maps at random places", partial(reads, source, ours[0]))],
        ratios=[(ours[0].name, BITMAP)],
        details={**source_details(source, name), "request": vars(settings), "codecs": list(codecs.available())},
        notes=[note, *codecs.install_notes()],
        jobs=jobs,
        jobs_fingerprint=source.digest,
        panels=("bytes",),
        measures=MEASURES,
    )


def _clipped(values: np.ndarray) -> np.ndarray:
    """Return values in the range that codecs of 8 bits can hold."""
    return np.clip(values, 0, 1).astype(np.float32)


def map_errors(source: Source, maps: dict[str, np.ndarray]) -> dict:
    """Return the errors of decoded maps, rounded to 8 bits.

    ``psnr_db`` is that of all channels together, ``psnr_between_db`` that of bilinear reads, one in each texel, without
    rounding, and ``flip`` the mean of all maps. Errors as seen are those of :func:`.as_seen.compare`.
    """
    squares, between, flips = [], [], []
    a, b = np.random.default_rng(2023).random((2, source.height, source.width, 1), dtype=np.float32)
    for m in source.maps:
        reference, image = _clipped(m.values), _clipped(np.round(np.clip(maps[m.name], 0, 1) * 255) / 255)
        squares.append(float(np.mean((reference - image) ** 2, dtype=np.float64)))
        shown = [0, 1, 2] if m.channels > 2 else [0, 0, 0]
        flips.append(metrics.flip_shown(reference[..., shown], image[..., shown]))
        e = _clipped(maps[m.name]) - reference
        e = (1 - a) * e + a * np.roll(e, -1, axis=0)  # the interpolation of the difference
        e = (1 - b) * e + b * np.roll(e, -1, axis=1)
        between.append(float(np.mean(e**2, dtype=np.float64)))
    weights = [m.channels for m in source.maps]
    psnr, psnr_between = (decibel(float(np.average(each, weights=weights))) for each in (squares, between))
    seen = as_seen.compare(source, maps, array_module())
    seen = {name: value for name, value in seen.items() if name.startswith("seen_")}
    return {"psnr_db": psnr, "psnr_between_db": psnr_between, "flip": float(np.mean(flips)), **seen}


def reads(source: Source, job: Contender, lanes: int) -> dict:
    """Return functions that read all maps at random places, from a trained file and from bitmaps.

    Bitmaps have 1 or 3 channels of a map.
    """
    rng, si = dr.rng(seed=dr.opaque(mi.UInt64, 3)), dr.zeros(mi.SurfaceInteraction3f, lanes)
    si.uv = mi.Point2f(rng.random(mi.Float, lanes), rng.random(mi.Float, lanes))
    dr.make_opaque(si.uv)

    def read(plugin: Callable[[object], dict], channels: list[int]) -> Callable[[], list]:
        textures = [mi.load_dict({**plugin(m), "raw": True}) for m in source.maps]
        methods = [
            getattr(t, {1: "eval_1", 3: "eval_3"}.get(n, "eval")) for n, t in zip(channels, textures, strict=True)
        ]
        return lambda: [method(si) for method in methods]

    def bitmap(m) -> dict:
        values = _clipped(m.values[..., : 3 if m.channels > 2 else 1])
        return {"type": "bitmap", "bitmap": mi.Bitmap(np.rint(255 * values).astype(np.uint8))}

    ours = read(lambda m: {"type": "neural_image", "filename": str(job.file), "channels": m.name},
                [m.channels for m in source.maps])  # fmt: skip
    few = [3 if m.channels > 2 else 1 for m in source.maps]
    return {"read": {FLOOR: lambda: [si.uv.x, si.uv.y], BITMAP: read(bitmap, few), job.name: ours}}
