"""Study ``tradeoff image``: quality of a compressed image or material against bytes, seconds of training and read time.

*Bytes*: at each compression ratio, arrays trained by our preset and the paper's are compared with a hash grid and
network and with codecs (:mod:`.baselines.codecs`) at the largest size that is not above; ASTC with one block size for
all maps and with the best block size of each map. *Seconds*: trainings of several lengths, each with its own schedule.
*Time*: kernels read all maps of a material at random places, from ``neural_image`` and from ``bitmap`` with 8 bits.

Errors are those of the values in the source's files; FLIP is a mean over maps, each shown as a picture. Materials with
normals or roughness are also compared as they are seen (:mod:`mi_diffind.maps.as_seen`).
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
from PIL.Image import Resampling

from ..core.arguments import positive
from ..core.progress import Deadline
from ..core.runtime import array_module
from ..core.units import parse_compression
from ..fitting.loop import FitSettings, fit
from ..images import metrics
from ..maps import as_seen
from ..maps.pyramid import Pyramid, decibel
from ..maps.source import Source, load_source
from ..measure.study import FLOOR, Candidate, Case, Measure, Plan, Study
from ..measure.training import Contender, halve
from . import equal_memory
from .baselines import codecs, networks
from .texture import add_astc_option, source_details

#: The bitmaps that ratios of times refer to.
BITMAP = "bitmap, 8 bits"

#: Methods without random access.
STREAMS = ("JPEG", "WebP")

#: Training of the network; ``seconds`` end it.
NETWORK_SETTINGS = FitSettings(steps=10**6, batch=2**12, lr=1e-2, schedule="cosine", loss="mse", measure_every=200)

MEASURES = (
    Measure("PSNR, dB", "psnr_db"),
    Measure("between texels", "psnr_between_db"),
    Measure("FLIP", "flip", ".4f", False),
    Measure("as seen", "seen_db"),
)


class ImageStudy(Study):
    """Quality of a compressed image or material against bytes, seconds of training and time of a read."""

    name = "image"
    title = "a compressed image or material, in bytes, training and reads"
    example = "material.json"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("source", metavar="IMAGE|MATERIAL.json")
        parser.add_argument("--compression", action="append", default=[], metavar="N",
                            help="compression ratio (default: 12x); may be repeated")  # fmt: skip
        parser.add_argument("--seconds", action="append", default=[], type=positive, metavar="N",
                            help="seconds of each training by our preset (default: 60; --quick: 2); may be repeated; "
                            "other methods are trained for the longest")  # fmt: skip
        add_astc_option(parser)

    def check(self, arguments) -> None:
        """Check the options and load the source; raise as :func:`.load_source` does."""
        arguments.compressions = tuple(map(parse_compression, arguments.compression)) or (12.0,)
        arguments.loaded = load_source(arguments.source)

    def plan(self, arguments) -> Plan:
        quick = arguments.quick
        settings = SimpleNamespace(
            compressions=arguments.compressions[:1] if quick else arguments.compressions,
            seconds=sorted(map(float, arguments.seconds)) or [2.0 if quick else 60.0],
            astc="fast" if quick else arguments.astc,
        )
        return plan(arguments.loaded, arguments.source, settings)


STUDY = ImageStudy()


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class ImageContenders:
    """Contenders of a source, which was read from the file ``name``."""

    source: Source
    name: str

    def contender(self, name: str, method: str, budget: float, encode: Callable, read=None) -> Contender:
        """Return a contender; a budget of 0 stands for a method of one size.

        ``encode(job, progress)`` returns the decoded maps by name, bytes, seconds of training and details, or ``None``
        after Ctrl-C.
        """
        details = {"random_access": method not in STREAMS, "kind": method, "compression": budget or None}

        def fit(job: Contender, progress: bool) -> dict | None:
            result = encode(job, progress)
            if result is None:
                return None
            maps, nbytes, seconds, more = result
            more = {**more, **details, "ratio": self.source.nbytes / nbytes}
            return {"bytes": nbytes, "seconds": seconds, "errors": map_errors(self.source, maps), "details": more}

        label = method + " (no random access)" * (method in STREAMS)
        return Contender(name, method, budget, fit, read, label, has_file=read is not None, details=details)

    def trained(self, preset: str, method: str, compression: float, seconds: float) -> Contender:
        """Return the arrays that a preset trains for ``seconds``."""

        def train(job: Contender, progress: bool) -> tuple | None:
            arguments = {"source": self.name, "compression": compression, "seconds": seconds}
            trained = equal_memory.fit_preset(job, progress, "image", "image", preset, arguments)
            if trained is None:
                return None
            model, fitted = trained
            table, result = fitted.table, fitted.result
            details = {"file": str(job.file), "structure": table.settings["structure"], "steps": result.steps}
            return model.image.decode(), table.nbytes, result.seconds, details

        def read(job: Contender):
            return equal_memory.open_preset(job, "image").image

        return self.contender(f"{preset} {compression:g}x {seconds:g} s", method, compression, train, read)

    def network(self, compression: float, seconds: float) -> Contender:
        """Return a hash grid and network in half precision; raise ``ValueError`` if the bytes are too few."""
        name = f"hash grid + network {compression:g}x {seconds:g} s"
        pyramid = Pyramid.from_source(self.source, types=array_module())
        net = networks.texture_network(pyramid.layout, self.source.nbytes / compression, levels=1)

        def train(job: Contender, progress: bool) -> tuple | None:
            problem = networks.TextureNetworkProblem(net, pyramid, self.source.digest)
            title = f"train {name}" if progress else None
            result = fit(problem, NETWORK_SETTINGS, progress=progress, title=title, deadline=Deadline(seconds))
            if result.interrupted:
                return None
            halve(problem.net)
            maps = networks.NetworkMaps(problem.net, pyramid).decode()
            return maps, 2 * problem.net.parameters, result.seconds, {"steps": result.steps}

        return self.contender(name, "network", compression, train)

    def encoded(self, name: str, method: str, budget: float, encode: Callable[[], dict]) -> Contender:
        """Return maps encoded by a codec; ``encode()`` returns the encoded maps by name."""

        def fit(job: Contender, progress: bool) -> tuple:
            encoded = encode()
            how = ", ".join(f"{name} {e.codec}" for name, e in encoded.items())
            maps = {name: e.image for name, e in encoded.items()}
            return maps, sum(e.nbytes for e in encoded.values()), None, {"how": how}

        return self.contender(name, method, budget, fit)


def trained_contenders(contenders: ImageContenders, compressions: Sequence[float], seconds: Sequence[float]) -> list:
    """Return the trainings at all ratios; further lengths and methods are those of the first one."""
    first, *others = compressions
    jobs = [contenders.trained("ours", "indirection", first, length) for length in seconds]
    jobs.append(contenders.trained("paper", "indirection, paper's preset", first, seconds[-1]))
    with contextlib.suppress(ValueError):  # too few bytes for a network
        jobs.append(contenders.network(first, seconds[-1]))
    return jobs + [contenders.trained("ours", "indirection", compression, seconds[0]) for compression in others]


def coded_contenders(contenders: ImageContenders, compressions: Sequence[float], quality: str) -> list[Contender]:
    """Return a contender for each installed codec at each ratio; all maps together take at most the bytes of it."""
    source, jobs, cache = contenders.source, [], {}
    values = {m.name: _clipped(m.values) for m in source.maps}
    normals = [m.name for m in source.maps if m.role == "normal"]
    if any(v.shape[-1] > 4 for v in values.values()):
        return []

    def resolutions(image: np.ndarray) -> list[np.ndarray]:
        rounded = np.rint(255 * image) / np.float32(255)
        return [image, codecs.resized(rounded, *(-(-n // 2) for n in image.shape[:2]), Resampling.LANCZOS)]

    def astc(compression: float, uniform: bool) -> dict:
        maps = {name: resolutions(v) for name, v in values.items()}
        return codecs.astc_levels(maps, source.nbytes / compression, quality, normals, False, uniform, cache)[0]

    def by_map(codec: str, compression: float) -> dict:
        share = source.nbytes / compression / source.channels
        return {name: codecs.at_bytes(codec, v, int(share * v.shape[-1])) for name, v in values.items()}

    for codec, compression in itertools.product(codecs.available(), compressions):
        title, ratio = codecs.TITLES[codec], f"{compression:g}x"
        if codec == "astc":
            for text, uniform in (("one block size", True), ("each map its own", False))[: len(values)]:
                encode = partial(astc, compression, uniform)
                jobs.append(contenders.encoded(f"{title} {ratio}, {text}", title, compression, encode))
        elif codec != "bc7":
            jobs.append(contenders.encoded(f"{title} {ratio}", title, compression, partial(by_map, codec, compression)))
        elif compression == compressions[0]:  # of one size
            jobs.append(contenders.encoded(title, title, 0.0, partial(by_map, codec, compression)))
    return jobs


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(source: Source, name: str, settings: SimpleNamespace) -> Plan:
    """Return the plan for ``source``, read from the file ``name``, in the current variant."""
    contenders, compressions = ImageContenders(source, name), settings.compressions
    trained = trained_contenders(contenders, compressions, settings.seconds)
    jobs = [*trained, *coded_contenders(contenders, compressions, settings.astc)]
    candidates = [job.candidate(competes=job.details["random_access"], label=job.name) for job in jobs]
    candidates.append(Candidate(BITMAP, "Mitsuba", is_reference=True, bytes=source.nbytes))
    timed = {job.name: job for job in trained if job.has_file and job.budget == compressions[0]}
    note = (
        f"{name}, {source.width} × {source.height}, {len(source.maps)} map(s), {source.nbytes:,} bytes. PSNR of all "
        "channels together. JPEG and WebP have no random access."
    )
    return Plan(
        study="image",
        title=f"Compressed image: {Path(name).stem}",
        candidates=candidates,
        cases=[Case("random places", partial(reads, source, timed))],
        ratios=[(name, BITMAP) for name in timed],
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


def map_errors(source: Source, maps: dict[str, np.ndarray]) -> dict:
    """Return the errors of decoded maps, rounded to 8 bits.

    ``psnr_db`` is that of all channels together, ``psnr_between_db`` that of bilinear reads, one in each texel, without
    rounding; ``psnr_NAME_db`` is that of a map, and ``flip`` the mean of all maps. Errors as seen are those of
    :func:`.as_seen.compare`.
    """
    by_map, squares, between, flips = {}, [], [], []
    a, b = np.random.default_rng(2023).random((2, source.height, source.width, 1), dtype=np.float32)
    for m in source.maps:
        reference, image = _clipped(m.values), _clipped(np.round(np.clip(maps[m.name], 0, 1) * 255) / 255)
        squares.append(float(np.mean((reference - image) ** 2, dtype=np.float64)))
        by_map[f"psnr_{m.name}_db"] = decibel(squares[-1])
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
    return {"psnr_db": psnr, "psnr_between_db": psnr_between, "flip": float(np.mean(flips)), **by_map, **seen}


def reads(source: Source, jobs: dict[str, Contender], lanes: int) -> dict:
    """Return functions that read all maps at random places, from each trained file and from bitmaps.

    Bitmaps have 1 or 3 channels of a map.
    """
    rng, si = dr.rng(seed=dr.opaque(mi.UInt64, 3)), dr.zeros(mi.SurfaceInteraction3f, lanes)
    si.uv = mi.Point2f(rng.random(mi.Float, lanes), rng.random(mi.Float, lanes))
    dr.make_opaque(si.uv)

    def read(plugins: list[dict], channels: list[int]):
        methods = [{1: "eval_1", 3: "eval_3"}.get(n, "eval") for n in channels]
        textures = [mi.load_dict({**plugin, "raw": True}) for plugin in plugins]
        return lambda: [getattr(t, method)(si) for t, method in zip(textures, methods, strict=True)]

    values = [_clipped(m.values[..., : 3 if m.channels > 2 else 1]) for m in source.maps]
    bitmaps = [{"type": "bitmap", "bitmap": mi.Bitmap(np.rint(255 * v).astype(np.uint8))} for v in values]
    functions = {FLOOR: lambda: [si.uv.x, si.uv.y], BITMAP: read(bitmaps, [v.shape[-1] for v in values])}
    for name, job in jobs.items():
        plugins = [{"type": "neural_image", "filename": str(job.file), "channels": m.name} for m in source.maps]
        functions[name] = read(plugins, [m.channels for m in source.maps])
    return {"read": functions}
