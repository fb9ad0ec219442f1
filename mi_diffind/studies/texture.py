"""Study ``tradeoff texture``: error and time of renders with filtered, compressed textures against bitmaps.

The colours of a material cover a surface in a light without noise (:class:`~mi_diffind.measure.renders.TextureScene`).
The truth is ``bitmap`` at many multijittered samples. The candidates are ``bitmap`` at 1 to 64 samples per pixel,
independent or multijittered; ``mipmap``, the uncompressed pyramid; ``neural_texture`` at several sizes; all levels
encoded with ASTC in the same bytes, and those of a network in the bytes of the first size, both read by ``mipmap``.
Filtered textures take one sample per pixel: trilinear at a random position, or anisotropic, at most four reads, at the
pixel's centre.

*Errors* are those of displayed values in pixels entirely on the surface; a scene counts those that are minified, or
magnified. *Levels*: the error of each level of detail at its texel centres, of all maps. *Time*: that of renders.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np

from ..core.arguments import positive
from ..core.runtime import array_module
from ..core.units import parse_compression
from ..fitting.task import FitSettings
from ..maps.pyramid import FilteredMaps, Pyramid, decibel
from ..maps.source import Map, Source, load_source
from ..measure import plot, renders
from ..measure.renders import TextureReader, TextureScene
from ..measure.report import figure_caption
from ..measure.study import Candidate, Case, Measure, Plan, Study
from ..measure.training import Contender, NetworkContender
from ..plugins.support.image_files import PYRAMIDS
from ..scenes.loading import footprint
from . import equal_memory
from .baselines import codecs, networks

#: Names of methods in legends.
BITMAP = "bitmap"
MULTIJITTERED = "bitmap, multijittered"
MIPMAP = "mip maps, uncompressed"
OURS = "ours"
ASTC = "ASTC with mip maps"
NETWORK = "network"

#: The bitmap that ratios refer to.
BASE = "bitmap, 1 spp"

#: Sampler of bitmaps → name of the method, and samples per pixel.
SAMPLERS = {"independent": (BITMAP, (1, 4, 16, 64)), "multijitter": (MULTIJITTERED, (4, 16, 64))}

#: Filter of a candidate → parameters of the plugin, and options of its :func:`reader`.
FILTERS = {
    "trilinear": ({"filter": "trilinear"}, {}),
    "anisotropic, centred": (
        {"filter": "anisotropic", "max_anisotropy": 4}, {"path": {"type": "path_footprint", "jitter": False}}
    ),
}  # fmt: skip

#: Steps of the first and of the longest training of a network.
NETWORK_STEPS = (1000, 16000)

#: Seed of the truth, far from those of candidates.
TRUTH_SEED = 1 << 20


class TextureStudy(Study):
    """Error and time of renders with filtered, compressed textures against supersampled bitmaps."""

    name = "texture"
    title = "a texture that filters itself, in renders and levels of detail"
    example = "material.json"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default="scenes/assets/tiles.json", metavar="IMAGE|MATERIAL.json",
            help="8-bit maps, one of which has colours (default: scenes/assets/tiles.json)",
        )  # fmt: skip
        parser.add_argument(
            "--compression", action="append", default=[], metavar="N",
            help="compression ratio; may be repeated (default: 12x, 3x and 24x; --quick: 12x)",
        )  # fmt: skip
        parser.add_argument("--seconds", type=positive, metavar="N",
                            help="seconds of each training (default: 60; --quick: 2)")  # fmt: skip

    def check(self, arguments) -> None:
        """Check the options and load the source; raise as :func:`.load_source` does."""
        default = (12.0,) if arguments.quick else (12.0, 3.0, 24.0)
        arguments.compressions = tuple(map(parse_compression, arguments.compression)) or default
        arguments.loaded = load_source(arguments.source)
        colour_map(arguments.loaded)

    def plan(self, arguments) -> Plan:
        quick = arguments.quick
        settings = SimpleNamespace(
            compressions=arguments.compressions,
            seconds=float(arguments.seconds or (2 if quick else 60)),
            astc="fast" if quick else codecs.QUALITY,
            film=(96, 64) if quick else (300, 200),
            truth_spp=64 if quick else 256,  # square numbers
            seeds=1 if quick else 4,  # renders that errors are averaged over
            scenes=1 if quick else 3,  # number of stills
            network_steps=(10, 20) if quick else NETWORK_STEPS,
        )
        return plan(arguments.loaded, arguments.source, settings)


STUDY = TextureStudy()


def colour_map(source: Source) -> Map:
    """Return the first albedo, or another map with three channels of 8 bits. Raises ``ValueError`` without one."""
    fitting = [m for m in source.maps if m.channels == 3 and m.depth == 1 and m.role != "normal"]
    if not fitting:
        raise ValueError("source: none of its maps has colours of 8 bits, which the study renders")
    return min(fitting, key=lambda m: m.role != "albedo")


def source_details(source: Source, name: str) -> dict:
    """Return what a result's ``details`` record about a source, read from the file ``name``."""
    return {
        "source": name, "source_digest": source.digest, "source_bytes": source.nbytes, "width": source.width,
        "height": source.height, "maps": {m.name: m.channels for m in source.maps},
    }  # fmt: skip


def normal_maps(source: Source) -> list[str]:
    """Return the names of the normal maps of a source."""
    return [m.name for m in source.maps if m.role == "normal"]


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


def level_errors(truth: dict[str, list[np.ndarray]], maps: dict[str, list[np.ndarray]]) -> list[float]:
    """Return the PSNR of all channels together, in dB, of each level at its texel centres.

    Values are those of the source's files, in [0, 1].
    """
    mse = [
        [float(np.mean((a.astype(np.float64) - b) ** 2)) for a, b in zip(levels, maps[name], strict=True)]
        for name, levels in truth.items()
    ]
    mean = np.average(mse, axis=0, weights=[levels[0].shape[-1] for levels in truth.values()])
    return [decibel(float(e)) for e in mean]


# -- Contenders --------------------------------------------------------------------------------------------------------


@dataclass
class TextureContenders:
    """Contenders of a source, read from the file ``name``, in the scenes of the stills."""

    source: Source
    name: str
    settings: SimpleNamespace
    jobs: list[Contender] = field(default_factory=list)
    candidates: list[Candidate] = field(default_factory=list)
    readers: dict[str, Callable[[], TextureReader]] = field(default_factory=dict)

    @cached_property
    def scenes(self) -> dict[str, TextureScene]:
        return dict(itertools.islice(renders.still_scenes().items(), self.settings.scenes))

    @cached_property
    def pyramid(self) -> Pyramid:
        """The uncompressed levels, repeated as bitmaps are."""
        return Pyramid.from_source(self.source, types=array_module(mi.variant()), border=("repeat", "repeat"))

    @cached_property
    def truth_levels(self) -> dict[str, list[np.ndarray]]:
        return level_images(self.pyramid)

    @cached_property
    def truths(self) -> dict[str, np.ndarray]:
        """The converged pictures of the scenes."""
        bitmap = reader(self.bitmap(), self.settings.truth_spp, "multijitter")
        return {name: self.render(bitmap, scene, TRUTH_SEED) for name, scene in self.scenes.items()}

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the texture."""
        return self.source.width, self.source.height

    def render(self, read: TextureReader, scene: TextureScene, seed: int = 0) -> np.ndarray:
        return read.render(scene, self.settings.film, self.size, seed)

    def errors(self, read: TextureReader) -> dict[str, float]:
        """Return the errors of a reader, ``psnr_SCENE_db`` and ``flip_SCENE``: those of the means over seeds."""
        errors = {}
        for name, scene in self.scenes.items():
            counted, truth = scene.counted(self.settings.film, self.size), self.truths[name]
            each = [renders.errors(truth, self.render(read, scene, k), counted) for k in range(self.settings.seeds)]
            errors[f"psnr_{name}_db"] = decibel(float(np.mean([e["mse"] for e in each])))
            errors[f"flip_{name}"] = float(np.mean([e["flip"] for e in each]))
        return errors

    def add(self, name: str, method: str, texture: Callable[[], dict], render: dict, **fields) -> None:
        """Register a candidate; its texture is created once, after the jobs. ``render``: options of its reader."""
        once = self.readers[name] = functools.cache(lambda: reader(texture(), **render))
        self.candidates.append(Candidate(name, method, errors=lambda samples: self.errors(once()), **fields))

    def add_filtered(self, name: str, method: str, texture: Callable[[], dict], filters=tuple(FILTERS), **fields):
        """Register a candidate for each filter of a texture that filters itself, at one sample per pixel."""
        for setting in filters:
            options, render = FILTERS[setting]
            more = {**options, "channels": colour_map(self.source).name}
            plugin = lambda more=more: {**texture(), **more}  # noqa: E731
            self.add(f"{name}, {setting}", method, plugin, render, setting=setting, **fields)

    def add_job(self, job: Contender, texture: Callable[[], dict] | None = None, **fields) -> None:
        """Register a contender with a candidate for each filter, by default of the pyramid that is its model."""
        self.jobs.append(job)
        self.add_filtered(job.name, job.method, texture or (lambda: mipmap(job.model)), job=job.name, **fields)

    def bitmap(self) -> dict:
        """Return Mitsuba's texture with 8 bits."""
        m = colour_map(self.source)
        data = mi.Bitmap(np.ascontiguousarray(np.rint(m.values * 255).astype(np.uint8)))
        return {"type": "bitmap", "bitmap": data, "raw": m.color_space != "srgb"}

    # -- Jobs

    def record(self, nbytes: int, seconds: float | None, maps: dict, **details) -> dict:
        """Return the record of compressed ``maps``, name → decoded levels, with the errors of levels."""
        details |= {"ratio": self.source.nbytes / nbytes, "levels": {"all": level_errors(self.truth_levels, maps)}}
        return {"bytes": nbytes, "seconds": seconds, "details": details}

    def trained(self, compression: float) -> Contender:
        """Return the contender that ``fit texture`` trains."""

        def fit(job: Contender, progress: bool) -> dict | None:
            arguments = {"source": self.name, "compression": compression, "seconds": self.settings.seconds,
                         "border": "repeat"}  # fmt: skip
            outcome = equal_memory.fit_preset(job, progress, "texture", "image", "", arguments)
            if outcome is None:
                return None
            model, fitted = outcome
            seconds, steps = fitted.result.seconds, fitted.result.steps
            return self.record(model.table.nbytes, seconds, level_images(model.image), steps=steps)

        name = f"ours {compression:g}x"
        return Contender(name, OURS, compression, fit, lambda job: equal_memory.open_preset(job, "texture").image)

    def encoded(self, equal_to: Contender, cache: dict) -> Contender:
        """Return the contender of all levels in ASTC, in the bytes of another; ``cache`` is shared by all budgets."""

        def encode() -> tuple[dict[str, codecs.Encoded], int]:
            nbytes, normals = equal_to.record["bytes"], normal_maps(self.source)
            return codecs.astc_levels(self.truth_levels, nbytes, self.settings.astc, normals, cache=cache)

        def fit(job: Contender, progress: bool) -> dict:
            maps, nbytes = encode()
            how = ", ".join(f"{name} {e.codec}" for name, e in maps.items())
            return self.record(nbytes, None, {name: e.levels for name, e in maps.items()}, how=how)

        def read(job: Contender) -> Pyramid:
            return level_pyramid({name: e.levels for name, e in encode()[0].items()}, self.pyramid)

        name = equal_to.name.replace("ours", "ASTC")
        return Contender(name, ASTC, equal_to.budget, fit, read, has_file=False)


def network_contender(
    source: Source, pyramid: Pyramid, levels: int, compression: float, steps: tuple[int, int], record: Callable
) -> NetworkContender:
    """Return the contender of a hash grid and network in half precision, trained to convergence.

    The network has ``levels`` levels of detail of the ``pyramid``; the contender's model is that of its decoded levels.
    ``steps`` are those of the first and of the longest training. ``record(nbytes, seconds, maps, **details)`` returns
    the record of decoded levels by map. Raises ``ValueError`` if the bytes are too few.
    """
    net = networks.texture_network(pyramid.layout, source.nbytes / compression, levels)
    settings = FitSettings(steps=steps[0], batch=2**14, lr=1e-2, schedule="cosine", loss="mse", seed=1)

    def decode(trained) -> dict[str, list[np.ndarray]]:
        return level_images(networks.NetworkMaps(trained, pyramid))

    def finish(trained, trainings: dict) -> dict:
        seconds, details = sum(run["seconds"] for run in trainings["runs"]), {"steps_longest": steps[1]}
        return record(2 * trainings["entries"], seconds, decode(trained), steps=trainings["steps"], **details)

    return NetworkContender(
        f"network {compression:g}x", NETWORK, compression, NETWORK, "",
        lambda trained: level_pyramid(decode(trained), pyramid),
        lambda: networks.TextureNetworkProblem(net, pyramid, source.digest), settings, steps[1], 5, True, finish,
    )  # fmt: skip


def reader(texture: dict, spp: int = 1, sampler: str = "independent", path: dict | None = None) -> TextureReader:
    """Return the reader of a texture that is repeated in scenes."""
    plugin = lambda repeats: {**texture, "to_uv": renders.to_uv(repeats)}  # noqa: E731
    return TextureReader(plugin, spp, sampler, path, footprint.attach)


def mipmap(pyramid: Pyramid) -> dict:
    """Return the plugin of a pyramid."""
    name = f"study {id(pyramid)}"
    PYRAMIDS[name] = pyramid
    return {"type": "mipmap", "pyramid": name}


# -- The plan ----------------------------------------------------------------------------------------------------------


def plan(source: Source, name: str, settings: SimpleNamespace) -> Plan:
    """Return the plan for ``source``, read from the file ``name``, in the current variant."""
    context, cache = TextureContenders(source, name, settings), {}
    for sampler, (method, counts) in SAMPLERS.items():
        for spp in counts:
            title = f"bitmap, {spp} spp{method.removeprefix(BITMAP)}"
            render = {"spp": spp, "sampler": sampler}
            context.add(title, method, context.bitmap, render, bytes=source.nbytes, setting=f"{spp} spp")
    context.add_filtered("mipmap", MIPMAP, lambda: mipmap(context.pyramid), bytes=4 * context.pyramid.nbytes)
    for i, compression in enumerate(settings.compressions):
        ours = context.trained(compression)
        context.add_job(ours, lambda job=ours: {"type": "neural_texture", "filename": str(job.file)})
        if "astc" in codecs.available():
            context.add_job(context.encoded(ours, cache), in_picture=i == 0)
    with contextlib.suppress(ValueError):  # too few bytes for a network
        levels, compression = context.pyramid.levels, settings.compressions[0]
        trained = (source, context.pyramid, levels, compression, settings.network_steps, context.record)
        context.add_job(network_contender(*trained), filters=("trilinear",), in_picture=False)
    measures = [(Measure(f"PSNR ({s}), dB", f"psnr_{s}_db"), Measure(f"FLIP {s}", f"flip_{s}", ".4f", False))
                for s in context.scenes]  # fmt: skip
    note = (
        f"{name}, {source.width} × {source.height}, {len(source.maps)} map(s), of which {colour_map(source).name} is "
        "rendered. PSNR of displayed values. spp: samples a pixel; filtered textures take one. Bytes are those of all "
        "maps, with mip maps but for bitmaps; uncompressed mip maps are held as floats."
    )
    return Plan(
        study="texture",
        title=f"Filtered texture {Path(name).stem} beside bitmaps",
        candidates=context.candidates,
        cases=[_case(context, scene) for scene in context.scenes.values()],
        ratios=[(c.name, BASE) for c in context.candidates if c.name != BASE],
        details={
            **source_details(source, name),
            "request": vars(settings),
            "codecs": list(codecs.available()),
            "counted": {n: float(s.counted(settings.film, context.size).mean()) for n, s in context.scenes.items()},
        },
        notes=[note, *codecs.install_notes(["astc"])],
        jobs=context.jobs,
        jobs_fingerprint=f"{source.digest} {vars(settings)}",
        pictures={"crops": partial(draw_crops, context), "levels": draw_levels},
        measures=tuple(itertools.chain(*measures)),
    )


def _case(context: TextureContenders, scene: TextureScene) -> Case:
    """Return the case of a scene: whole renders. ``bench_texture.py`` times reads."""

    def passes() -> dict:
        functions = {}
        for name, once in context.readers.items():
            loaded, spp = once().loaded(scene, context.settings.film, context.size), once().spp
            functions[name] = lambda k, s=loaded, spp=spp: mi.render(s, spp=spp, seed=k)
        return functions

    accuracy, in_picture = f"psnr_{scene.name}_db", not scene.magnified
    return Case(scene.name, lambda lanes: {}, passes, accuracy=accuracy, in_picture=in_picture)


# -- Pictures ----------------------------------------------------------------------------------------------------------


def draw_crops(context: TextureContenders, result: dict):
    """Draw an enlarged part of each still, that with the largest error of the first candidate, and the truth.

    Candidates are bitmaps, and the first with anisotropic filtering of each method.
    """
    from scipy.ndimage import uniform_filter

    side, rows, shown = max(8, context.settings.film[1] * 2 // 5), {}, {"": BASE, "64": "bitmap, 64 spp"}
    for name, c in result["candidates"].items():
        if c["setting"] == "anisotropic, centred":
            shown.setdefault(c["representation"], name)
    for name, scene in context.scenes.items():
        truth, counted = context.truths[name], scene.counted(context.settings.film, context.size)
        images = {
            f"{n}\n{result['candidates'][n]['errors'][f'psnr_{name}_db']:.1f} dB":
            context.render(context.readers[n](), scene) for n in shown.values()
        }  # fmt: skip
        images[f"truth\n{context.settings.truth_spp} spp, multijittered"] = truth
        error = ((next(iter(images.values())) - truth) ** 2).sum(axis=-1) * counted
        total = uniform_filter(error, side, mode="constant")
        middle = np.unravel_index(np.argmax(total), total.shape)
        top, left = (int(np.clip(m - side // 2, 0, max(n - side, 0))) for m, n in zip(middle, total.shape, strict=True))
        rows[name] = {text: image[top : top + side, left : left + side] for text, image in images.items()}
    return plot.draw_images(f"{result['title']}: parts of the stills", figure_caption(result), rows)


def draw_levels(result: dict):
    """Draw the PSNR of each level of all compressed textures."""
    levels = {n: job["details"]["levels"]["all"] for n, job in result["jobs"].items()}
    curves = [plot.Curve(name, range(len(psnr)), psnr) for name, psnr in levels.items()]
    title, label = f"{result['title']}: error of each level", "level of detail (0: finest)"
    return plot.draw_curves(title, figure_caption(result), {"All maps, at texel centres": curves}, label, "PSNR, dB")
