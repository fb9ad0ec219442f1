"""Study ``tradeoff texture``: error and time of renders with filtered, compressed textures against bitmaps.

The colours of a material cover a surface in a light without noise (:class:`~mi_diffind.measure.renders.TextureScene`).
The truth is ``bitmap`` at many multijittered samples. The candidates are ``bitmap`` at 1 to 64 samples per pixel,
independent or multijittered; ``mipmap``, the uncompressed pyramid; ``neural_texture`` at several sizes; all levels
encoded with ASTC in the same bytes, and those of a network in the bytes of the first size, both read by ``mipmap``.
Filtered textures take one sample per pixel: trilinear at a random position, or anisotropic, at most four reads, at the
pixel's centre.

*Errors* are those of displayed values in pixels entirely on the surface; a scene counts those that are minified, or
magnified. *Levels*: the error of each level of detail at its texel centres, of all maps. *Flicker*:
:class:`~mi_diffind.measure.renders.MovingView`. *Time*: kernels that read the map where a scene shows it, and renders.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
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
from ..fitting.task import FitSettings
from ..maps.pyramid import FilteredMaps, Pyramid, decibel
from ..maps.source import Map, Source, load_source
from ..measure import plot, renders
from ..measure.renders import TextureReader, TextureScene, TextureZoom
from ..measure.report import figure_caption
from ..measure.store import fingerprint
from ..measure.study import FLOOR, Candidate, Case, Job, Measure, Plan, Study
from ..measure.training import Contender, NetworkContender, load_arrays
from ..plugins.support.image_files import PYRAMIDS
from ..scenes.loading import footprint
from ..tasks.texture import compressed, fit
from . import equal_memory
from .baselines import codecs, networks

#: Names of methods in legends.
BITMAP = "bitmap"
MULTIJITTERED = "bitmap, multijittered"
MIPMAP = "mip maps, uncompressed"
OURS = "ours"
PAPER = "paper's preset"
ASTC = "ASTC with mip maps"
NETWORK = "network"
METHODS = (BITMAP, MULTIJITTERED, MIPMAP, OURS, PAPER, ASTC, NETWORK)

#: The bitmap that ratios refer to.
BASE = "bitmap, 1 spp"

#: Samples per pixel of bitmaps.
COUNTS = (1, 4, 16, 64)

#: Filter of a candidate → parameters of the plugin, and whether samples are at the centres of pixels.
FILTERS = {
    "trilinear": ({"filter": "trilinear"}, False),
    "anisotropic, centred": ({"filter": "anisotropic", "max_anisotropy": 4}, True),
}

#: Presets with the distributions of footprints that they are trained with beside their own (ours: by level; the
#: paper's: powers).
FOOTPRINTS = (("ours", "power"), ("ours", "exponential"), ("paper", "exponential"))

#: Multijittered samples per pixel of the zoom's truth; its noise is below 1% of any flicker that filtering leaves.
ZOOM_SPP = 64

#: Seed of the truth, far from those of candidates.
TRUTH_SEED = 1 << 20

#: Steps of the first and of the longest training of a network.
NETWORK_STEPS = (1000, 16000)


def add_astc_option(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--astc``, the preset of the encoder."""
    parser.add_argument(
        "--astc", choices=("fast", "medium", "thorough", "exhaustive"), default="exhaustive",
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
        parser.add_argument(
            "--compression", action="append", default=[], metavar="N",
            help="compression ratio; may be repeated (default: 12x, 3x, 6x and 24x; --quick: 12x)",
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
        colour_map(arguments.loaded)
        arguments.tables = load_tables(arguments.table, arguments.loaded)

    def plan(self, arguments) -> Plan:
        quick = arguments.quick
        width = arguments.width or (96 if quick else 480)
        settings = SimpleNamespace(
            compressions=arguments.compressions,
            seconds=float(arguments.seconds or (2 if quick else 60)),
            astc="fast" if quick else arguments.astc,
            film=(width, max(2, width * 2 // 3)),
            zoom_film=(max(2, width // 2), max(2, width // 3)),
            frames=arguments.frames or (6 if quick else 60),
            truth_spp=64 if quick else 256,  # square numbers
            seeds=1 if quick else 4,  # renders that errors are averaged over
            scenes=1 if quick else 3,  # number of stills
            footprints=arguments.footprints,
            network_steps=(10, 20) if quick else NETWORK_STEPS,  # of the first and of the longest training
            only=tuple(arguments.only),
        )
        return plan(arguments.loaded, arguments.source, settings, arguments.tables)


STUDY = TextureStudy()


def colour_map(source: Source) -> Map:
    """Return the first albedo, or another map with three channels of 8 bits. Raises ``ValueError`` without one."""
    fitting = [m for m in source.maps if m.channels == 3 and m.depth == 1 and m.role != "normal"]
    if not fitting:
        raise ValueError("source: none of its maps has colours of 8 bits, which the study renders")
    return min(fitting, key=lambda m: m.role != "albedo")


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


def level_images(maps: FilteredMaps) -> dict[str, list[np.ndarray]]:
    """Return all levels of each map, ``(height, width, channels)``, clipped to the [0, 1] of 8-bit codecs."""
    levels = [maps.decode(level=level) for level in range(maps.levels)]
    return {name: [np.clip(decoded[name], 0, 1) for decoded in levels] for name in maps.layout.names}


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

    Values are those of the source's files, in [0, 1].
    """
    mse = {
        name: [float(np.mean((a.astype(np.float64) - b) ** 2)) for a, b in zip(levels, maps[name], strict=True)]
        for name, levels in truth.items()
    }
    weights = [levels[0].shape[-1] for levels in truth.values()]
    mse["all"] = np.average(list(mse.values()), axis=0, weights=weights)
    return {name: [decibel(float(e)) for e in errors] for name, errors in mse.items()}


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class TextureContenders:
    """Contenders of a source, read from the file ``name``, in the scenes of the stills."""

    source: Source
    name: str
    settings: SimpleNamespace
    jobs: list[Job] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)
    readers: dict[str, Callable[[], TextureReader]] = field(default_factory=dict)

    @cached_property
    def scenes(self) -> dict[str, TextureScene]:
        return dict(itertools.islice(renders.still_scenes().items(), self.settings.scenes))

    @cached_property
    def zoom(self) -> TextureZoom:
        return TextureZoom(renders.zoom_scene(), self.settings.zoom_film, self.size, self.settings.frames)

    @cached_property
    def pyramid(self) -> Pyramid:
        """The uncompressed levels, repeated as bitmaps are."""
        return Pyramid.from_source(self.source, types=array_module(mi.variant()), border=("repeat", "repeat"))

    @cached_property
    def truth_levels(self) -> dict[str, list[np.ndarray]]:
        return level_images(self.pyramid)

    @cached_property
    def truths(self) -> dict[str, np.ndarray]:
        """The converged pictures of the scenes, and of the zoom."""
        bitmap, zoom = self.bitmap(self.settings.truth_spp, "multijitter"), self.bitmap(ZOOM_SPP, "multijitter")
        truths = {name: self.render(bitmap, scene, TRUTH_SEED) for name, scene in self.scenes.items()}
        return {**truths, "zoom": self.zoom.render(zoom, TRUTH_SEED >> 12)}

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the texture."""
        return self.source.width, self.source.height

    def counted(self, scene: TextureScene) -> np.ndarray:
        return scene.counted(self.settings.film, self.size)

    def render(self, reader: TextureReader, scene: TextureScene, seed: int = 0) -> np.ndarray:
        return reader.render(scene, self.settings.film, self.size, seed)

    def errors(self, reader: TextureReader) -> dict[str, float]:
        """Return the errors of a reader.

        ``psnr_SCENE_db`` and ``flip_SCENE`` are those of the means over seeds; ``flicker`` and ``flicker_error`` those
        of the zoom.
        """
        errors = {}
        for name, scene in self.scenes.items():
            counted, truth = self.counted(scene), self.truths[name]
            each = [renders.errors(truth, self.render(reader, scene, k), counted) for k in range(self.settings.seeds)]
            errors[f"psnr_{name}_db"] = decibel(float(np.mean([e["mse"] for e in each])))
            errors[f"flip_{name}"] = float(np.mean([e["flip"] for e in each]))
        return {**errors, **self.zoom.errors(self.zoom.render(reader), self.truths["zoom"])}

    # -- Candidates

    def add(self, name: str, method: str, reader: Callable[[], TextureReader], **fields) -> None:
        """Register a candidate; its reader is created once, after the jobs."""
        once = self.readers[name] = functools.cache(reader)
        errors = lambda samples: self.errors(once())  # noqa: E731
        self.candidates.append(Candidate(name, method, errors=errors, **fields))

    def add_filtered(self, name: str, method: str, plugin: Callable[[], dict], filters=tuple(FILTERS), **fields):
        """Register a candidate for each filter of a plugin that filters itself, at one sample per pixel."""

        def reader(filter_name: str) -> TextureReader:
            options, centred = FILTERS[filter_name]
            texture = {**plugin(), **options, "channels": colour_map(self.source).name}
            return TextureReader(
                lambda repeats: {**texture, "to_uv": renders.to_uv(repeats)},
                path={"type": "path_footprint", "jitter": False} if centred else None,
                prepare=footprint.attach,
            )

        for filter_name in filters:
            self.add(f"{name}, {filter_name}", method, partial(reader, filter_name), setting=filter_name, **fields)

    def add_bitmaps(self) -> None:
        """Register Mitsuba's texture with 8 bits at several sample counts."""
        for sampler, method in (("independent", BITMAP), ("multijitter", MULTIJITTERED)):
            for spp in COUNTS if sampler == "independent" else COUNTS[1:]:
                name = f"bitmap, {spp} spp{method.removeprefix(BITMAP)}"
                self.add(name, method, partial(self.bitmap, spp, sampler), bytes=self.source.nbytes,
                         setting=f"{spp} spp")  # fmt: skip

    def add_textures(self, tables: Sequence[Table]) -> None:
        """Register trained textures, those of ``tables`` first, and ASTC in the bytes of each of ours."""
        settings, cache, textures = self.settings, {}, []
        for stored in tables:
            ratio = self.source.nbytes / stored.nbytes
            method = PAPER if stored.preset == "paper" else OURS
            textures.append(self.texture(f"{stored.preset} {ratio:.3g}x", method, ratio, table=stored))
        for compression in settings.compressions:
            textures.append(self.texture(f"ours {compression:g}x", OURS, compression))
            if compression == settings.compressions[0]:
                textures.append(self.texture(f"paper {compression:g}x", PAPER, compression, "paper"))
        for i, job in enumerate(textures):
            self.jobs.append(job)
            fields = {"job": job.name, "in_picture": i == 0 or job.method == OURS}
            plugin = lambda job=job: {"type": "neural_texture", "filename": str(job.model.table.path)}  # noqa: E731
            if job.method != OURS:
                self.add_filtered(job.name, job.method, plugin, ("trilinear",), **fields)
                continue
            self.add_filtered(job.name, OURS, plugin, **fields)
            if "astc" in codecs.available():
                encoded = self.encoded(job.name.replace("ours", "ASTC"), job, cache)
                self.jobs.append(encoded)
                plugin = partial(mipmap, lambda job=encoded: job.model)
                self.add_filtered(encoded.name, ASTC, plugin, **{**fields, "job": encoded.name, "in_picture": i == 0})
        for preset, samples in FOOTPRINTS if settings.footprints and settings.compressions else ():
            name = f"{preset} {settings.compressions[0]:g}x, {samples} footprints"
            self.jobs.append(self.texture(name, "footprints", settings.compressions[0], preset, samples=samples))

    def add_network(self) -> None:
        """Register a network in the bytes of our texture at the first ratio, unless they are too few for one."""
        for compression in self.settings.compressions[:1]:
            with contextlib.suppress(ValueError):
                job = self.network(compression)
                self.jobs.append(job)
                plugin = partial(mipmap, lambda job=job: job.model)
                self.add_filtered(job.name, NETWORK, plugin, ("trilinear",), job=job.name)

    # -- Jobs

    def bitmap(self, spp: int = 1, sampler: str = "independent") -> TextureReader:
        """Return the reader of Mitsuba's texture with 8 bits."""
        m = colour_map(self.source)
        data = mi.Bitmap(np.ascontiguousarray(np.rint(m.values * 255).astype(np.uint8)))
        bitmap = {"type": "bitmap", "bitmap": data, "raw": m.color_space != "srgb"}
        return TextureReader(lambda repeats: {**bitmap, "to_uv": renders.to_uv(repeats)}, spp, sampler)

    def record(self, method: str, budget: float, nbytes: int, seconds: float | None, maps: dict, **details) -> dict:
        """Return the record of compressed ``maps``, name → decoded levels, with the errors of levels."""
        details |= {"compression": budget, "ratio": self.source.nbytes / nbytes, "kind": method}
        details["levels"] = level_errors(self.truth_levels, maps)
        return {"bytes": nbytes, "seconds": seconds, "details": details}

    def texture(self, name: str, method: str, budget: float, preset: str = "", table: Table | None = None,
                samples: str | None = None) -> Contender:  # fmt: skip
        """Return the contender of a texture that a preset of ``fit texture`` trains, or that is in a ``table``.

        ``samples`` is a distribution of footprints. Its model has the attribute ``image``.
        """

        def fit(job: Contender, progress: bool) -> dict | None:
            seconds = None if table is None else table.settings.get("seconds")
            if table is None:
                arguments = {
                    "source": self.name, "compression": budget, "seconds": self.settings.seconds,
                    "footprint_samples": samples, "border": "repeat",  # as the scenes repeat it
                }  # fmt: skip
                trained = equal_memory.fit_preset(job, progress, "texture", "image", preset, arguments)
                if trained is None:
                    return None
                job.model, fitted = trained
                seconds = fitted.result.seconds
            stored, maps = job.model.table, level_images(job.model.image)
            return self.record(method, budget, stored.nbytes, seconds, maps, file=Path(stored.path or job.file).name,
                               preset=stored.preset, steps=stored.settings.get("steps"))  # fmt: skip

        def read(job: Contender):
            return task.tasks()["texture"].open(mi.TensorXf, str(job.file if table is None else table.path))

        return Contender(name, method, budget, fit, read, has_file=table is None)

    def encoded(self, name: str, equal_to: Contender, cache: dict) -> Contender:
        """Return the contender of all levels in ASTC, in the bytes of another; ``cache`` is shared by all budgets."""

        def fit(job: Contender, progress: bool) -> dict:
            normals = [m.name for m in self.source.maps if m.role == "normal"]
            nbytes = equal_to.model.table.nbytes
            encoded, nbytes = codecs.astc_levels(self.truth_levels, nbytes, self.settings.astc, normals, cache=cache)
            maps = {name: e.levels for name, e in encoded.items()}
            job.model = level_pyramid(maps, self.pyramid)
            job.save_arrays(**{f"level_{i}": values for i, values in enumerate(job.model.values)})
            how = ", ".join(f"{name} {e.codec}" for name, e in encoded.items())
            return self.record(ASTC, job.budget, nbytes, None, maps, how=how)

        def read(job: Contender) -> Pyramid:
            arrays, like = load_arrays(job.file), self.pyramid
            return Pyramid(like.layout, [arrays[f"level_{i}"] for i in range(like.levels)], like.types, like.border)

        return Contender(name, ASTC, equal_to.budget, fit, read, details={"equal_to": equal_to.name})

    def network(self, budget: float) -> NetworkContender:
        """Return the contender of a hash grid and network in half precision, trained to convergence.

        Its model is the pyramid of its levels, decoded. Raises ``ValueError`` if the bytes are too few.
        """
        pyramid, (first, longest) = self.pyramid, self.settings.network_steps
        net = networks.texture_network(pyramid.layout, self.source.nbytes / budget, pyramid.levels)

        def levels(trained) -> dict[str, list[np.ndarray]]:
            return level_images(networks.NetworkMaps(trained, pyramid))

        def finish(trained, record: dict) -> dict:
            return self.record(
                NETWORK, budget, 2 * record["entries"], sum(run["seconds"] for run in record["runs"]), levels(trained),
                steps=record["steps"], steps_first=first, steps_longest=longest, batch=settings.batch,
            )  # fmt: skip

        settings = FitSettings(steps=first, batch=2**14, lr=1e-2, schedule="cosine", loss="mse", seed=1)
        return NetworkContender(
            f"network {budget:g}x", NETWORK, budget, NETWORK, "", lambda net: level_pyramid(levels(net), pyramid),
            lambda: networks.TextureNetworkProblem(net, pyramid, self.source.digest), settings, longest, 5, True,
            finish,
        )  # fmt: skip


def mipmap(model: Callable[[], Pyramid]) -> dict:
    """Return the plugin of a pyramid."""
    pyramid = model()
    name = f"study {id(pyramid)}"
    PYRAMIDS[name] = pyramid
    return {"type": "mipmap", "pyramid": name}


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(source: Source, name: str, settings: SimpleNamespace, tables: Sequence[Table] = ()) -> Plan:
    """Return the plan for ``source``, read from the file ``name``, in the current variant; ``tables`` are trained."""
    context = TextureContenders(source, name, settings)
    context.add_bitmaps()
    context.add_filtered("mipmap", MIPMAP, partial(mipmap, lambda: context.pyramid), bytes=context.pyramid.nbytes)
    context.add_textures(tables)
    context.add_network()
    candidates, jobs = context.candidates, context.jobs
    if settings.only:
        candidates = [c for c in candidates if c.representation in settings.only]
        needed = {c.job for c in candidates}
        needed |= {job.details.get("equal_to") for job in jobs if job.name in needed}
        jobs = [job for job in jobs if job.name in needed]
    note = (
        f"{name}, {source.width} × {source.height}, {len(source.maps)} map(s), of which {colour_map(source).name} is "
        "rendered. PSNR of displayed values. Bytes are those of all maps, with mip maps but for bitmaps."
    )
    digests = [fingerprint([t.path]) for t in tables]
    measures = [(Measure(f"PSNR {s}", f"psnr_{s}_db"), Measure(f"FLIP {s}", f"flip_{s}", ".4f", False))
                for s in context.scenes]  # fmt: skip
    flicker = (Measure("flicker", "flicker", ".3e", False), Measure("beside truth", "flicker_error", ".3e", False))
    return Plan(
        study="texture",
        title=f"Filtered texture: {Path(name).stem}",
        candidates=candidates,
        cases=[_case(context, scene, candidates) for scene in context.scenes.values()],
        ratios=[(c.name, BASE) for c in candidates if c.name != BASE],
        details={
            **source_details(source, name),
            "request": vars(settings),
            "tables": digests,
            "codecs": list(codecs.available()),
            "counted": {n: float(context.counted(s).mean()) for n, s in context.scenes.items()},
        },
        notes=[note, *codecs.install_notes(["astc"])],
        jobs=jobs,
        jobs_fingerprint=f"{source.digest} {vars(settings)} {digests}",
        pictures={
            "crops": partial(draw_crops, context),
            "zoom": partial(draw_zoom, context),
            "levels": partial(draw_levels, context),
        },
        measures=(*itertools.chain(*measures), *flicker),
    )


def _case(context: TextureContenders, scene: TextureScene, candidates: list[Candidate]) -> Case:
    """Return the case of a scene: reads of the map where the scene shows it, and whole renders."""
    film, readers = context.settings.film, context.readers
    repeats = scene.repeats(film, context.size)

    def reads(lanes: int) -> dict:
        loaded = readers[BASE]().loaded(scene, film, context.size)
        width = max(1, round((1.5 * lanes) ** 0.5))
        index = np.arange(lanes)
        si = scene.hits(loaded, (index % width + 0.5) / width, (index // width + 0.5) / -(-lanes // width))
        dr.make_opaque(si.uv, si.p, si.dp_du, si.dp_dv, si.wi, si.sh_frame, si.duv_dx, si.duv_dy)
        cone = footprint.Cone.from_sensor(loaded.sensors()[0])
        functions = {FLOOR: lambda: [si.uv.x, si.uv.y]}
        for c in candidates:
            if c.name == BASE or c.setting in FILTERS:
                texture = mi.load_dict(readers[c.name]().texture(repeats))
                if hasattr(texture, "set_cone"):
                    texture.set_cone(cone)
                functions[c.name] = lambda t=texture: t.eval(si)
        return {"read": functions}

    def passes() -> dict:
        functions = {}
        for c in candidates:
            reader = readers[c.name]()
            loaded = reader.loaded(scene, film, context.size)
            functions[c.name] = lambda k, s=loaded, spp=reader.spp: mi.render(s, spp=spp, seed=k)
        return functions

    return Case(
        scene.name, reads, passes, accuracy=f"psnr_{scene.name}_db", in_picture=not scene.magnified,
        details={"repeats": repeats, "magnified": scene.magnified},
    )  # fmt: skip


# -- Pictures ----------------------------------------------------------------------------------------------------------


def shown_readers(context: TextureContenders, result: dict) -> dict[str, TextureReader]:
    """Return the readers in pictures: bitmaps, uncompressed mip maps, and ours and ASTC at the first budget."""
    names = list(result["candidates"])
    centred = [next((n for n in names if n.startswith(s) and n.endswith("centred")), "")
               for s in ("mipmap", "ours", "ASTC")]  # fmt: skip
    return {n: context.readers[n]() for n in (BASE, "bitmap, 64 spp", *centred) if n in names}


def draw_crops(context: TextureContenders, result: dict):
    """Draw an enlarged part of each still, that with the largest error of the first reader, by each and the truth."""
    from scipy.ndimage import uniform_filter

    side, rows, readers = max(8, context.settings.film[1] * 2 // 5), {}, shown_readers(context, result)
    for name, scene in context.scenes.items():
        truth = context.truths[name]
        images = {
            f"{reader}\n{result['candidates'][reader]['errors'][f'psnr_{name}_db']:.1f} dB":
            context.render(read, scene) for reader, read in readers.items()
        }  # fmt: skip
        images[f"truth\n{context.settings.truth_spp} spp, multijittered"] = truth
        error = ((next(iter(images.values())) - truth) ** 2).sum(axis=-1) * context.counted(scene)
        total = uniform_filter(error, side, mode="constant")
        middle = np.unravel_index(np.argmax(total), total.shape)
        top, left = (int(np.clip(m - side // 2, 0, max(n - side, 0))) for m, n in zip(middle, total.shape, strict=True))
        rows[name] = {text: image[top : top + side, left : left + side] for text, image in images.items()}
    return plot.draw_images(f"{result['title']}: parts of the stills", figure_caption(result), rows)


def draw_zoom(context: TextureContenders, result: dict):
    """Draw frames of the zoom, by each of the readers and of the truth."""
    strips = {name: context.zoom.render(reader) for name, reader in shown_readers(context, result).items()}
    rows = context.zoom.rows({**strips, "truth": context.truths["zoom"]})
    title = f"{result['title']}: a zoom of {context.zoom.frames} frames"
    return plot.draw_images(title, figure_caption(result), rows, 2.0)


def draw_levels(context: TextureContenders, result: dict):
    """Draw the PSNR of each level of all compressed textures.

    If distributions of footprints are compared, another panel shows the share of samples on each level.
    """
    count, panels = context.pyramid.levels, {}
    if context.settings.footprints:
        shares = {"by level (ours)": fit.shares(count)}
        shares |= {name: compressed.footprint_histogram(name, count) for name in compressed.FOOTPRINTS}
        panels["% of the samples of a training"] = [
            plot.Curve(name, range(count), 100 * np.asarray(share)) for name, share in shares.items()
        ]
    panels["PSNR of all maps at texel centres, dB"] = [
        plot.Curve(name, range(count), record["details"]["levels"]["all"])
        for name, record in result["jobs"].items() if "levels" in record.get("details", {})
    ]  # fmt: skip
    return plot.draw_curves(f"{result['title']}: levels of detail", figure_caption(result), panels, "level", "")
