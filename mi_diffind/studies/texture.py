"""Study ``tradeoff texture``: error and time of renders with filtered, compressed textures against bitmaps.

A map of a material covers a surface in a light without noise (:class:`~mi_diffind.measure.renders.TextureScene`). The
truth is ``bitmap`` at many multijittered samples. The candidates are ``bitmap`` at 1 to 64 samples per pixel,
independent or multijittered; ``mipmap``, the uncompressed pyramid; ``neural_texture`` at several sizes; all levels
encoded with ASTC in the same bytes, read by ``mipmap``; and a network in the bytes of the first size, filtered
trilinearly. Filtered textures take one sample per pixel, at a random position or *centred*. Trilinear filtering reads
the texture once, anisotropic filtering at most four times.

*Errors* are those of displayed values in pixels entirely on the surface; a scene counts those that are minified, or
magnified. *Levels*: the error of each level of detail at its texel centres, of all maps. *Flicker*:
:class:`~mi_diffind.measure.renders.MovingView`. *Time*: kernels that read the map where a scene shows it, and renders.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import itertools
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.tables import Table
from ..core.arguments import positive
from ..core.runtime import array_module
from ..core.units import parse_compression
from ..fitting import task
from ..fitting.settings import FitSettings
from ..maps.compressed import FilteredMaps, decibel
from ..maps.pyramid import Pyramid
from ..maps.source import Source, load_source
from ..measure import plot, renders
from ..measure.renders import TextureReader, TextureScene, TextureZoom
from ..measure.report import figure_caption, grid
from ..measure.store import fingerprint
from ..measure.study import FLOOR, PASS, Candidate, Case, Job, Measure, Plan, Study
from ..plugins.support.image_files import PYRAMIDS
from ..scenes.loading import footprint
from ..tasks.texture import nets, training
from . import equal_memory
from .baselines import codecs, networks
from .equal_memory import Contender, NetworkContender

#: Names of methods in legends, and of the bitmap that ratios refer to.
BITMAP = "bitmap"
MULTIJITTERED = "bitmap, multijittered"
MIPMAP = "mip maps, uncompressed"
OURS = "ours"
PAPER = "paper's preset"
ASTC = "ASTC with mip maps"
NETWORK = "network"
METHODS = (BITMAP, MULTIJITTERED, MIPMAP, OURS, PAPER, ASTC, NETWORK)
BASE = "bitmap, 1 spp"

#: Samples per pixel of bitmaps.
COUNTS = (1, 4, 16, 64)

#: Filter → parameters of the plugin.
FILTERS = {
    "trilinear": {"filter": "trilinear"},
    "anisotropic": {"filter": "anisotropic", "max_anisotropy": 4},
    "stochastic": {"filter": "stochastic"},
    "off": {"filter": "off"},
}

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
TRUTH_SEED = 1 << 20

#: Steps of the first training of a network, and of the longest as a multiple.
NETWORK_STEPS = 1000
NETWORK_LONGEST = 16

#: Presets of the ASTC encoder.
ASTC_PRESETS = ("fastest", "fast", "medium", "thorough", "verythorough", "exhaustive")


def add_astc_option(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--astc``, the preset of the encoder."""
    parser.add_argument(
        "--astc", choices=ASTC_PRESETS, default="exhaustive",
        help="preset of the ASTC encoder (default: exhaustive; faster ones are up to several dB worse)",
    )  # fmt: skip


class TextureStudy(Study):
    """Error and time of renders with filtered, compressed textures against supersampled bitmaps."""

    name = "texture"
    title = "a texture that filters itself, in renders, levels and flicker"
    example = "material.json"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default="scenes/assets/tiles.json", metavar="IMAGE|MATERIAL.json",
            help="8-bit maps, one of which has colours (default: scenes/assets/tiles.json)",
        )  # fmt: skip
        parser.add_argument("--map", default="", metavar="NAME", help="the map that is rendered (default: the albedo)")
        parser.add_argument(
            "--compression", action="append", default=[], metavar="N",
            help="compression ratio; may be repeated (default: 12x, 3x, 6x and 24x; --quick: 12x); only the first is "
            "measured with all filters",
        )  # fmt: skip
        parser.add_argument(
            "--table", action="append", default=[], metavar="FILE.npz",
            help="use a trained table of the source (trained with --border repeat, as in the renders) in place of a "
            "training; may be repeated; nothing is trained unless --compression is given, too",
        )  # fmt: skip
        parser.add_argument("--seconds", type=positive, metavar="N",
                            help="seconds of each training (default: 60; --quick: 2)")  # fmt: skip
        add_astc_option(parser)
        parser.add_argument("--footprints", action="store_true",
                            help="also train with each distribution of footprints and draw both")  # fmt: skip
        parser.add_argument("--only", action="append", default=[], choices=METHODS, metavar="METHOD",
                            help=f"measure only one method ({'; '.join(METHODS)}); may be repeated")  # fmt: skip
        parser.add_argument("--frames", type=positive, metavar="N", help="frames of the zoom (default: 60; --quick: 6)")
        parser.add_argument("--width", type=positive, metavar="N",
                            help="width of the stills; the height is 2/3 (default: 480; --quick: 96)")  # fmt: skip

    def check(self, arguments) -> None:
        """Check the options and load the source and tables; raise as :func:`.load_source` does."""
        default = () if arguments.table else (12.0,) if arguments.quick else (12.0, 3.0, 6.0, 24.0)
        arguments.compressions = tuple(map(parse_compression, arguments.compression)) or default
        arguments.loaded = load_source(arguments.source)
        arguments.map = colour_map(arguments.loaded, arguments.map)
        arguments.tables = load_tables(arguments.table, arguments.loaded)

    def plan(self, arguments) -> Plan:
        quick = arguments.quick
        width = arguments.width or (96 if quick else 480)
        settings = SimpleNamespace(
            map=arguments.map,
            compressions=arguments.compressions,
            seconds=float(arguments.seconds or (2 if quick else 60)),
            astc="fast" if quick else arguments.astc,
            astc_choice="fast" if quick else "medium",  # preset that selects block sizes
            film=(width, max(2, width * 2 // 3)),
            zoom_film=(max(2, width // 2), max(2, width // 3)),
            frames=arguments.frames or (6 if quick else 60),
            truth_spp=64 if quick else 256,  # square numbers
            seeds=1 if quick else 4,  # renders that errors are averaged over
            footprints=arguments.footprints,
            network_steps=30 if quick else NETWORK_STEPS,  # of the first training
            only=tuple(arguments.only),
        )
        return plan(arguments.loaded, arguments.source, settings, arguments.tables)


STUDY = TextureStudy()


def colour_map(source: Source, name: str = "") -> str:
    """Return the name of a map with three channels of 8 bits: ``name``, or the first albedo. Raises ``ValueError``."""
    fitting = [m for m in source.maps if m.channels == 3 and m.depth == 1 and m.role != "normal"]
    names = [m.name for m in sorted(fitting, key=lambda m: m.role != "albedo")]
    if name and name not in names:
        raise ValueError(f'--map: found "{name}", maps with colours of 8 bits are {", ".join(names) or "none"}')
    if not names:
        raise ValueError("source: none of its maps has colours of 8 bits, which the study renders")
    return name or names[0]


def load_tables(paths: Sequence[str], source: Source) -> list[Table]:
    """Return trained tables. Raises :class:`.TableError`, ``ValueError`` for another source."""
    tables = [task.tasks()["texture"].load(path) for path in paths]
    for trained in tables:
        if trained.settings.get("source") != source.digest:
            raise ValueError(f"--table: {trained.path} was not trained on this source")
    return tables


def source_details(source: Source, name: str) -> dict:
    """Return what a result's ``details`` record about a source, read from the file ``name``."""
    return {
        "source": name, "source_digest": source.digest, "source_bytes": source.nbytes, "width": source.width,
        "height": source.height, "maps": {m.name: m.channels for m in source.maps},
    }  # fmt: skip


# -- Levels of detail as images ----------------------------------------------------------------------------------------


def level_images(pyramid: Pyramid) -> dict[str, list[np.ndarray]]:
    """Return all levels of each map, ``(height, width, channels)``, clipped to the [0, 1] of 8-bit codecs."""
    layout, levels = pyramid.layout, {name: [] for name in pyramid.layout.names}
    for values in pyramid.values:
        stored = [values[..., c] for c in range(layout.stored)]
        for name in layout.names:
            channels = [np.broadcast_to(np.float32(c), values.shape[:2]) for c in layout.decode(name, stored)]
            levels[name].append(np.clip(np.stack(channels, -1), 0, 1))
    return levels


def level_pyramid(maps: dict[str, list[np.ndarray]], like: Pyramid) -> Pyramid:
    """Return the pyramid of decoded levels, with the layout and border of ``like``."""
    levels = [np.zeros_like(values) for values in like.values]
    for m in like.layout.maps:
        for c, channel in enumerate(m.where):
            if isinstance(channel, int):
                for values, decoded_level in zip(levels, maps[m.name], strict=True):
                    values[..., channel] = m.encode(decoded_level[..., c])
    return Pyramid(like.layout, levels, like.types, like.border)


def level_errors(truth: dict[str, list[np.ndarray]], maps: dict[str, list[np.ndarray]]) -> dict[str, list[float]]:
    """Return the PSNR, in dB, of each level at its texel centres: of ``all`` channels together and of each map.

    Values are those of the source's files, clipped to [0, 1].
    """
    result: dict[str, list[float]] = {"all": []}
    for i in range(len(next(iter(truth.values())))):
        squares, channels = 0.0, 0
        for name, levels in truth.items():
            mse = float(np.mean((levels[i].astype(np.float64) - np.clip(maps[name][i], 0, 1)) ** 2))
            result.setdefault(name, []).append(decibel(mse))
            squares += mse * levels[i].shape[-1]
            channels += levels[i].shape[-1]
        result["all"].append(decibel(squares / channels))
    return result


def decode_levels(image: FilteredMaps, names, levels: int) -> dict[str, list[np.ndarray]]:
    """Return all levels of maps that can be read at a level of detail, at texel centres."""
    maps = [image.decode(names, level=level) for level in range(levels)]
    return {name: [values[name] for values in maps] for name in names}


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class TextureStudyContext:
    """The source, read from the file ``name``, the scenes of the stills, and their truths, which jobs render."""

    source: Source
    name: str
    settings: SimpleNamespace
    scenes: dict[str, TextureScene]
    truths: dict[str, Contender] = field(default_factory=dict)

    @cached_property
    def zoom(self) -> TextureZoom:
        return TextureZoom(renders.zoom_scene(), self.settings.zoom_film, self.size, self.settings.frames)

    @cached_property
    def pyramid(self) -> Pyramid:
        """The uncompressed levels, repeated as bitmaps are."""
        return Pyramid.of(self.source, types=array_module(mi.variant()), border=("repeat", "repeat"))

    @cached_property
    def truth_levels(self) -> dict[str, list[np.ndarray]]:
        return level_images(self.pyramid)

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
            each = [renders.errors(truth, self.render(reader, scene, k), counted) for k in range(self.settings.seeds)]
            errors[f"psnr_{name}_db"] = decibel(float(np.mean([e["mse"] for e in each])))
            errors[f"flip_{name}"] = float(np.mean([e["flip"] for e in each]))
        return {**errors, **self.zoom.errors(self.zoom.render(reader), self.truths["zoom"].model)}

    def bitmap(self, spp: int = 1, sampler: str = "independent") -> TextureReader:
        """Return Mitsuba's texture with 8 bits."""
        m = next(m for m in self.source.maps if m.name == self.settings.map)
        data = mi.Bitmap(np.ascontiguousarray(np.rint(m.values * 255).astype(np.uint8)))
        bitmap = {"type": "bitmap", "bitmap": data, "raw": m.color_space != "srgb"}
        return TextureReader(lambda repeats: {**bitmap, "to_uv": renders.to_uv(repeats)}, spp, sampler)

    def filtered(self, plugin: dict, filter_name: str, centred: bool) -> TextureReader:
        """Return a texture that filters itself, at one sample per pixel."""
        texture = {**plugin, **FILTERS[filter_name], "channels": self.settings.map}
        return TextureReader(
            lambda repeats: {**texture, "to_uv": renders.to_uv(repeats)},
            path=CENTRED if centred else None,
            prepare=footprint.attach,
        )

    def mipmap(self, maps: Callable[[], FilteredMaps], filter_name: str, centred: bool) -> TextureReader:
        """Return ``mipmap`` of a pyramid, or of other maps that are read as one."""
        pyramid = maps()
        name = f"study {id(pyramid)}"
        PYRAMIDS[name] = pyramid
        return self.filtered({"type": "mipmap", "pyramid": name}, filter_name, centred)

    def record(self, method: str, budget: float, nbytes: int, seconds: float | None, maps: dict, **details) -> dict:
        """Return the record of compressed ``maps``, name → decoded levels, with the errors of levels."""
        details |= {"compression": budget, "ratio": self.source.nbytes / nbytes, "kind": method}
        details["levels"] = level_errors(self.truth_levels, maps)
        return {"bytes": nbytes, "seconds": seconds, "details": details}

    def truth(self, name: str, spp: int, render: Callable[[TextureReader], np.ndarray]) -> Contender:
        """Return the job that renders the converged picture of a scene, or of the zoom."""

        def fit(job: Contender, progress: bool) -> dict:
            job.model = render(self.bitmap(spp, "multijitter"))
            job.save_arrays(truth=job.model)
            return {}

        return Contender(f"truth, {name}", "truth", spp, fit, lambda job: equal_memory.load_arrays(job.file)["truth"])

    def texture(self, name: str, method: str, budget: float, preset: str = "", table: Table | None = None,
                footprint_samples: str | None = None) -> Contender:  # fmt: skip
        """Return the contender of a texture that a preset of ``fit texture`` trains, or that is in a ``table``.

        Its model has the attribute ``image``.
        """

        def record(job: Contender, seconds: float | None) -> dict:
            trained = job.model.table
            maps = decode_levels(job.model.image, self.pyramid.layout.names, self.pyramid.levels)
            return self.record(method, budget, trained.nbytes, seconds, maps, file=Path(trained.path or job.file).name,
                               preset=trained.preset, steps=trained.settings.get("steps"))  # fmt: skip

        def fit(job: Contender, progress: bool) -> dict | None:
            if table is not None:
                return record(job, table.settings.get("seconds"))
            arguments = {
                "source": self.name, "compression": budget, "seconds": self.settings.seconds,
                "footprint_samples": footprint_samples, "border": "repeat",  # as the scenes repeat it
            }  # fmt: skip
            trained = equal_memory.fit_preset(job, progress, "texture", "image", preset, arguments)
            if trained is None:
                return None
            job.model, fitted = trained
            return record(job, fitted.result.seconds)

        def read(job: Contender):
            return task.tasks()["texture"].open(mi.TensorXf, str(job.file if table is None else table.path))

        return Contender(name, method, budget, fit, read, has_file=table is None)

    def encoded(self, name: str, equal_to: Contender, cache: dict) -> Contender:
        """Return the contender of all levels in ASTC, in the bytes of another; ``cache`` is shared by all budgets."""

        def fit(job: Contender, progress: bool) -> dict:
            start, settings = time.perf_counter(), self.settings
            normals = [m.name for m in self.source.maps if m.role == "normal"]
            encoded, nbytes = codecs.astc_levels(
                self.truth_levels, equal_to.model.table.nbytes, settings.astc, normals, settings.astc_choice, cache
            )
            maps = {name: e.levels for name, e in encoded.items()}
            job.save_arrays(**{f"{name}_{i}": v for name, levels in maps.items() for i, v in enumerate(levels)})
            job.model = level_pyramid(maps, self.pyramid)
            how = ", ".join(f"{name} {e.codec}" for name, e in encoded.items())
            return self.record(ASTC, job.budget, nbytes, None, maps, how=how,
                               encoding_seconds=time.perf_counter() - start)  # fmt: skip

        def read(job: Contender) -> Pyramid:
            arrays, names = equal_memory.load_arrays(job.file), self.pyramid.layout.names
            maps = {n: [arrays[f"{n}_{i}"] for i in range(self.pyramid.levels)] for n in names}
            return level_pyramid(maps, self.pyramid)

        return Contender(name, ASTC, equal_to.budget, fit, read, details={"equal_to": equal_to.name})

    def network(self, budget: float) -> NetworkContender:
        """Return the contender of a hash grid and network in half precision, trained to convergence.

        Raises ``ValueError`` if the bytes are too few.
        """
        pyramid, source, steps = self.pyramid, self.source, self.settings.network_steps
        nbytes = source.nbytes / budget
        networks.texture_network(source, pyramid.layout, nbytes)

        def problem() -> networks.TextureNetworkProblem:
            net = networks.texture_network(source, pyramid.layout, nbytes)
            return networks.TextureNetworkProblem(net, pyramid, source.digest)

        def build(net) -> networks.NetworkMaps:
            return networks.NetworkMaps(net, pyramid.layout, pyramid.types, pyramid.border, True)

        def finish(net, record: dict) -> dict:
            return self.record(
                NETWORK, budget, 2 * record["entries"], sum(run["seconds"] for run in record["runs"]),
                decode_levels(build(net), pyramid.layout.names, pyramid.levels), steps=record["steps"],
                steps_first=steps, steps_longest=NETWORK_LONGEST * steps, batch=settings.batch,
            )  # fmt: skip

        settings = FitSettings(steps=steps, batch=2**14, lr=1e-2, schedule="cosine", loss="mse", seed=1)
        return NetworkContender(f"network {budget:g}x", NETWORK, budget, NETWORK, "", build, problem, settings,
                                NETWORK_LONGEST * steps, 5, True, finish)  # fmt: skip


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

    def add_references(self) -> None:
        """Register the jobs that render the truths, bitmaps and the uncompressed pyramid."""
        context, nbytes = self.context, self.context.source.nbytes
        for name, scene in context.scenes.items():
            render = functools.partial(context.render, scene=scene, seed=TRUTH_SEED)
            context.truths[name] = context.truth(name, context.settings.truth_spp, render)
        render = lambda reader: context.zoom.render(reader, TRUTH_SEED >> 12)  # noqa: E731
        context.truths["zoom"] = context.truth("zoom", ZOOM_SPP, render)
        self.jobs += context.truths.values()
        for sampler, method in (("independent", BITMAP), ("multijitter", MULTIJITTERED)):
            for spp in COUNTS if sampler == "independent" else COUNTS[1:]:
                name = f"bitmap, {spp} spp{method.removeprefix(BITMAP)}"
                self.add(name, method, functools.partial(context.bitmap, spp, sampler), bytes=nbytes,
                         setting=f"{spp} spp", queries=None if spp == 1 else ())  # fmt: skip
        mipmap = functools.partial(context.mipmap, lambda: context.pyramid)
        self.add_filtered("mipmap", MIPMAP, mipmap, self.reads, bytes=context.pyramid.nbytes)

    def add_textures(self, tables: Sequence[Table]) -> None:
        """Register trained textures, those of ``tables`` first, and ASTC in the bytes of each of ours."""
        context, settings = self.context, self.context.settings
        textures: list[Contender] = []
        for stored in tables:
            ratio = context.source.nbytes / stored.nbytes
            method = PAPER if stored.preset == "paper" else OURS
            textures.append(context.texture(f"{stored.preset} {ratio:.3g}x", method, ratio, table=stored))
        for compression in settings.compressions:
            textures.append(context.texture(f"ours {compression:g}x", OURS, compression))
            if compression == settings.compressions[0]:
                textures.append(context.texture(f"paper {compression:g}x", PAPER, compression, "paper"))
        cache: dict = {}
        for i, job in enumerate(textures):
            self.jobs.append(job)
            fields = {"job": job.name, "training_seconds": None, "in_picture": i == 0 or job.method == OURS}

            def reader(filter_name: str, centred: bool, job=job) -> TextureReader:
                plugin = {"type": "neural_texture", "filename": str(job.model.table.path)}
                return context.filtered(plugin, filter_name, centred)

            if job.method != OURS:
                self.add_filtered(job.name, job.method, reader, self.reads[:1], **fields)
                continue
            more = self.more_reads if i == 0 else ()
            self.add_filtered(job.name, job.method, reader, (*self.reads, *more), **fields)
            if "astc" in codecs.available():
                encoded = context.encoded(job.name.replace("ours", "ASTC"), job, cache)
                self.jobs.append(encoded)
                fields |= {"job": encoded.name, "in_picture": i == 0}
                mipmap = functools.partial(context.mipmap, lambda job=encoded: job.model)
                self.add_filtered(encoded.name, ASTC, mipmap, self.reads[::3], **fields)
        for preset, samples in FOOTPRINTS if settings.footprints and settings.compressions else ():
            compression = settings.compressions[0]
            name = f"{preset} {compression:g}x, {samples} footprints"
            preset = "paper" if preset == "paper" else ""
            self.jobs.append(context.texture(name, "footprints", compression, preset, footprint_samples=samples))

    def add_network(self) -> None:
        """Register a network in the bytes of our texture at the first ratio, unless they are too few for one."""
        for compression in self.context.settings.compressions[:1]:
            with contextlib.suppress(ValueError):
                job = self.context.network(compression)
                self.jobs.append(job)
                mipmap = functools.partial(self.context.mipmap, lambda job=job: job.model)
                self.add_filtered(job.name, NETWORK, mipmap, self.reads[:1], job=job.name, training_seconds=None)

    def select(self, only: Sequence[str]) -> None:
        """Keep the candidates of the methods ``only``, unless there are none, and the jobs that these need."""
        if not only:
            return
        self.candidates = [c for c in self.candidates if c.representation in only]
        needed = {c.job for c in self.candidates}
        needed |= {j.details.get("equal_to") for j in self.jobs if j.name in needed}
        self.jobs = [job for job in self.jobs if job.method == "truth" or job.name in needed]


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(
    source: Source,
    name: str,
    settings: SimpleNamespace,
    tables: Sequence[Table] = (),
    reads: Sequence[tuple[str, bool]] = READS,
    more_reads: Sequence[tuple[str, bool]] = MORE_READS,
    scenes: dict[str, TextureScene] | None = None,
) -> Plan:
    """Return the plan for ``source``, read from the file ``name``, in the current variant.

    ``tables`` are trained already. ``reads`` and ``more_reads`` are the filters as in :data:`READS` and
    :data:`MORE_READS`, ``scenes`` the stills (default: :func:`.still_scenes`).
    """
    context = TextureStudyContext(source, name, settings, scenes or renders.still_scenes())
    builder = TextureCandidates(context, reads, more_reads)
    builder.add_references()
    builder.add_textures(tables)
    builder.add_network()
    builder.select(settings.only)
    note = (
        f"{name}, {source.width} × {source.height}, {len(source.maps)} map(s), of which {settings.map} is rendered. "
        "PSNR of displayed values. Bytes are those of all maps, with mip maps but for bitmaps."
    )
    digests, candidates, readers = [fingerprint([t.path]) for t in tables], builder.candidates, builder.readers
    shown = {name: readers[name] for name in shown_candidates(candidates)}
    measures = [(Measure(f"PSNR {s}", f"psnr_{s}_db"), Measure(f"FLIP {s}", f"flip_{s}", ".4f", False))
                for s in context.scenes]  # fmt: skip
    flicker = (Measure("flicker", "flicker", ".3e", False), Measure("beside truth", "flicker_error", ".3e", False))
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
            "request": vars(settings),
            "tables": digests,
            "codecs": list(codecs.available()),
            "counted": {n: float(context.counted(s).mean()) for n, s in context.scenes.items()},
        },
        notes=[note, *codecs.install_notes(["astc"])],
        jobs=builder.jobs,
        jobs_fingerprint=f"{source.digest} {vars(settings)} {digests}",
        pictures={
            "crops": functools.partial(draw_crops, context, shown),
            "zoom": functools.partial(draw_zoom, context, shown),
            "levels": functools.partial(draw_levels, context),
        },
        sampled=False,
        measures=(*itertools.chain(*measures), *flicker),
        conclusions=conclusions,
    )


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
        cone = footprint.Cone.from_sensor(loaded.sensors()[0])
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


# -- Conclusions and pictures ------------------------------------------------------------------------------------------


def levels(result: dict) -> dict[str, dict[str, list[float]]]:
    """Return the PSNR of each level, by name of the job and by map."""
    return {n: r["details"]["levels"] for n, r in result["jobs"].items() if "levels" in r.get("details", {})}


def speed(result: dict, case: str, name: str, against: str = BITMAP) -> tuple[float, bool] | None:
    """Return the time of a bitmap with the error of a candidate, relative to the candidate's time, and a flag.

    The flag is true if the ratio is only a lower bound, because even the highest sample count has a larger error.
    Between sample counts, time is interpolated as a power of the error. ``against`` is the sampling of the bitmap,
    :data:`BITMAP` or :data:`MULTIJITTERED`.
    """
    accuracy, times = result["cases"][case]["accuracy"], result["cases"][case]["passes"].get(PASS, {})
    curve = sorted(
        (times[n]["time"], c["errors"][accuracy])
        for n, c in result["candidates"].items()
        if n in times and accuracy in c["errors"] and (c["representation"] == against or n == BASE)
    )
    if name not in times or len(curve) < 2:
        return None
    goal, time = result["candidates"][name]["errors"][accuracy], times[name]["time"]
    pair = next((pair for pair in itertools.pairwise(curve) if goal <= pair[1][1]), None)
    if pair is None:
        return curve[-1][0] / time, True
    (t0, a0), (t1, a1) = pair
    share = (goal - a0) / (a1 - a0) if a1 != a0 else 0.0
    return math.exp(math.log(t0) + share * math.log(t1 / t0)) / time, False


def conclusions(result: dict) -> list[str]:
    """Return a table of errors of levels, and the times of bitmaps with the error of each filtered texture."""
    by_name = levels(result)
    count = max((len(psnr["all"]) for psnr in by_name.values()), default=0)
    cells = [["PSNR by level, all maps", *(f"L{i}" for i in range(count))]]
    cells += [[name, *(f"{v:.1f}" for v in psnr["all"])] for name, psnr in by_name.items()]
    lines = grid(cells, "")
    for case in result["cases"]:
        for name, c in result["candidates"].items():
            speeds = [speed(result, case, name, against) for against in (BITMAP, MULTIJITTERED)]
            if c["in_picture"] and not c["representation"].startswith(BITMAP) and all(speeds):
                factors = " and ".join(f"{'more than ' * more}{value:.1f}" for value, more in speeds)
                lines.append(f"{case}, {name}: time of a bitmap at equal error {factors} (independent, multijittered)")
    return lines


def shown_candidates(candidates: Sequence[Candidate]) -> list[str]:
    """Return the names of the candidates in pictures: bitmaps, uncompressed, ours and ASTC at the first budget."""
    names = [c.name for c in candidates]
    first = [next((n for n in names if n.startswith(s) and n.endswith("anisotropic, centred")), "")
             for s in ("mipmap", "ours", "ASTC")]  # fmt: skip
    return [n for n in ("bitmap, 1 spp", "bitmap, 64 spp", *first) if n in names]


def draw_crops(context: TextureStudyContext, readers: dict, result: dict):
    """Draw an enlarged part of each still, by each of the readers and of the truth."""
    side, rows = max(8, context.settings.film[1] * 2 // 5), {}
    for name, scene in context.scenes.items():
        counted, truth = context.counted(scene), context.truths[name].model
        part = np.where(counted[..., None], truth, np.nan)
        if not rows:  # near the end of the plane
            part[int(np.argmax(counted.any(axis=1))) + side :] = np.nan
        top, left = busiest_square(part, side)
        images = {
            f"{reader}\n{result['candidates'][reader]['errors'][f'psnr_{name}_db']:.1f} dB":
            context.render(readers[reader](), scene, 0) for reader in readers
        }  # fmt: skip
        images[f"truth\n{context.settings.truth_spp} spp, multijittered"] = truth
        rows[name] = {text: image[top : top + side, left : left + side] for text, image in images.items()}
    return plot.draw_images(f"{result['title']}: parts of the stills", figure_caption(result), rows)


def draw_zoom(context: TextureStudyContext, readers: dict, result: dict):
    """Draw frames of the zoom, by each of the readers and of the truth."""
    strips = {name: context.zoom.render(reader()) for name, reader in readers.items()}
    rows = context.zoom.rows({**strips, "truth": context.truths["zoom"].model})
    title = f"{result['title']}: a zoom of {context.zoom.frames} frames"
    return plot.draw_images(title, figure_caption(result), rows, 2.0)


def draw_levels(context: TextureStudyContext, result: dict):
    """Draw the PSNR of each level of all compressed textures.

    If distributions of footprints are compared, another panel shows the share of samples on each level.
    """
    count, panels = context.pyramid.levels, {}
    if context.settings.footprints:
        shares = {"by level (ours)": training.shares(count)}
        shares |= {name: nets.footprint_histogram(name, count) for name in nets.FOOTPRINTS}
        panels["% of the samples of a training"] = [
            plot.Curve(name, range(count), 100 * np.asarray(share)) for name, share in shares.items()
        ]
    panels["PSNR of all maps at texel centres, dB"] = [
        plot.Curve(name, range(count), psnr["all"]) for name, psnr in levels(result).items()
    ]
    return plot.draw_curves(f"{result['title']}: levels of detail", figure_caption(result), panels, "level", "")


def busiest_square(image: np.ndarray, side: int) -> tuple[int, int]:
    """Return row and column of the square with the largest variance, of those without NaN."""
    step = max(1, side // 8)
    places = [
        (t, l) for t in range(0, image.shape[0] - side + 1, step) for l in range(0, image.shape[1] - side + 1, step)
    ]
    parts = (image[top : top + side, left : left + side] for top, left in places)
    variances = [np.nan_to_num(part.var(axis=(0, 1)).sum(), nan=-1) for part in parts]
    return places[int(np.argmax(variances))] if places else (0, 0)
