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

import functools
import itertools
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import ClassVar

import mitsuba as mi
import numpy as np

from ..maps.pyramid import Pyramid, decibel
from ..maps.source import Map, Source
from ..measure import plot, renders
from ..measure.renders import TextureReader, TextureScene
from ..measure.report import figure_caption
from ..measure.study import Candidate, Case, Measure, Plan
from ..measure.training import Contender
from ..plugins.support.image_files import PYRAMIDS
from ..scenes.loading import footprint
from .baselines import codecs
from .materials import Levels, MaterialContenders, MaterialStudy, level_errors

#: Settings of bitmaps, by the sampler: parameters of the plugin, and options of its :func:`reader`.
INDEPENDENT = {f"{n} spp": ({}, {"spp": n}) for n in (1, 4, 16, 64)}
MULTIJITTERED = {f"{n} spp, multijittered": ({}, {"spp": n, "sampler": "multijitter"}) for n in (4, 16, 64)}

#: Settings of textures that filter themselves, at one sample per pixel.
TRILINEAR = {"trilinear": ({"filter": "trilinear"}, {})}
FILTERED = TRILINEAR | {
    "anisotropic, centred": (
        {"filter": "anisotropic", "max_anisotropy": 4}, {"path": {"type": "path_footprint", "jitter": False}}
    ),
}  # fmt: skip


class TextureStudy(MaterialStudy):
    """Error and time of renders with filtered, compressed textures against supersampled bitmaps."""

    name = "texture"
    title = "a texture that filters itself, in renders and levels of detail"
    ratios = (12.0, 3.0, 24.0)

    def check(self, arguments) -> None:
        super().check(arguments)
        colour_map(arguments.loaded)

    def plan(self, arguments) -> Plan:
        quick, settings = arguments.quick, self.settings(arguments)
        settings.film = (96, 64) if quick else (300, 200)
        settings.truth_spp = 64 if quick else 256  # square numbers
        settings.seeds = 1 if quick else 4  # renders that errors are averaged over
        settings.scenes = 1 if quick else 3  # number of stills
        context = TextureContenders(arguments.loaded, arguments.source, settings)
        measures = [(Measure(f"PSNR ({s}), dB", f"psnr_{s}_db"), Measure(f"FLIP {s}", f"flip_{s}", ".4f", False))
                    for s in context.scenes]  # fmt: skip
        note = (
            f"{context.note} Rendered: {colour_map(context.source).name}. PSNR of displayed values. spp: samples a "
            "pixel; filtered textures take one. Bytes are those of all maps, with mip maps but for bitmaps; mipmap "
            "holds floats."
        )
        counted = {n: float(s.counted(settings.film, context.size).mean()) for n, s in context.scenes.items()}
        return Plan(
            study=self.name,
            title=f"Filtered texture {Path(context.name).stem} beside bitmaps",
            candidates=context.candidates,
            cases=[context.case(scene) for scene in context.scenes.values()],
            details={**context.details, "counted": counted},
            notes=[note, *codecs.install_notes(["astc"])],
            jobs=context.jobs,
            jobs_fingerprint=f"{context.source.digest} {vars(settings)}",
            pictures={"crops": partial(draw_crops, context), "levels": draw_levels},
            measures=tuple(itertools.chain(*measures)),
        )


STUDY = TextureStudy()


def colour_map(source: Source) -> Map:
    """Return the first albedo, or another map with three channels of 8 bits. Raises ``ValueError`` without one."""
    fitting = [m for m in source.maps if m.channels == 3 and m.depth == 1 and m.role != "normal"]
    if not fitting:
        raise ValueError("source: none of its maps has colours of 8 bits, which the study renders")
    return min(fitting, key=lambda m: m.role != "albedo")


# -- Contenders --------------------------------------------------------------------------------------------------------


class TextureContenders(MaterialContenders):
    """Contenders of a material whose colours are rendered, in the scenes of the stills."""

    task = "texture"
    options: ClassVar[dict] = {"shading": "off"}  # what is measured are maps
    border = "repeat"

    def __post_init__(self):
        super().__post_init__()
        self.jobs: list[Contender] = []
        self.candidates: list[Candidate] = []
        self.readers: dict[str, Callable[[], TextureReader]] = {}
        self.size = self.source.width, self.source.height
        self.scenes = dict(itertools.islice(renders.still_scenes().items(), self.settings.scenes))
        for name, settings in (("bitmap", INDEPENDENT), ("bitmap, multijittered", MULTIJITTERED)):
            self.add("bitmap", name, self.bitmap, settings, bytes=self.source.nbytes)
        uncompressed = 4 * self.pyramid.nbytes
        self.add("mipmap", "mip maps, uncompressed", lambda: self.mipmap(self.pyramid), FILTERED, bytes=uncompressed)
        for i, compression in enumerate(self.settings.compressions):
            ours = self.trained(compression)
            plugin = {"type": "neural_texture", "channels": colour_map(self.source).name}
            self.add_job(ours, lambda plugin=plugin, job=ours: {**plugin, "filename": str(job.file)})
            if "astc" in self.codecs:
                encode = lambda job=ours: self.astc(self.levels, job.record["bytes"], True)  # noqa: E731
                name = f"ASTC {compression:g}x"
                self.add_job(self.encoded(name, "ASTC with mip maps", compression, encode), in_picture=i == 0)
        for network in self.network_contenders(self.pyramid.levels):
            self.add_job(network, settings=TRILINEAR, in_picture=False)

    def add(self, name: str, method: str, texture: Callable[[], dict], settings: dict, **fields) -> None:
        """Register a candidate for each setting of a ``texture``, whose plugin is created after the jobs."""
        for setting, (options, render) in settings.items():
            once = functools.cache(lambda options=options, render=render: reader({**texture(), **options}, **render))
            self.readers[f"{name}, {setting}"] = once
            errors = lambda samples, once=once: self.errors(once())  # noqa: E731
            self.candidates.append(Candidate(f"{name}, {setting}", method, setting, errors=errors, **fields))

    def add_job(self, job: Contender, texture: Callable[[], dict] | None = None, settings=FILTERED, **fields) -> None:
        """Register a contender and its candidates, by default of the pyramid that is its model."""
        self.jobs.append(job)
        self.add(job.name, job.method, texture or (lambda: self.mipmap(job.model)), settings, job=job.name, **fields)

    def bitmap(self) -> dict:
        """Return Mitsuba's texture with 8 bits."""
        m = colour_map(self.source)
        data = mi.Bitmap(np.ascontiguousarray(np.rint(m.values * 255).astype(np.uint8)))
        return {"type": "bitmap", "bitmap": data, "raw": m.color_space != "srgb"}

    def mipmap(self, pyramid: Pyramid) -> dict:
        """Return the plugin of a pyramid."""
        name = f"study {id(pyramid)}"
        PYRAMIDS[name] = pyramid
        return {"type": "mipmap", "pyramid": name, "channels": colour_map(self.source).name}

    # -- Measurements

    @cached_property
    def truths(self) -> dict[str, np.ndarray]:
        """The converged pictures of the scenes, with a seed far from those of candidates."""
        bitmap = reader(self.bitmap(), self.settings.truth_spp, "multijitter")
        return {name: self.render(bitmap, scene, 1 << 20) for name, scene in self.scenes.items()}

    def record(self, nbytes: int, seconds: float | None, levels: Levels, **details) -> dict:
        truths = {"all": self.levels} | {name: {name: images} for name, images in self.levels.items()}
        psnr = {name: level_errors(truth, levels) for name, truth in truths.items()}
        details |= {"ratio": self.source.nbytes / nbytes, "levels": psnr}
        return {"bytes": nbytes, "seconds": seconds, "details": details}

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

    def case(self, scene: TextureScene) -> Case:
        """Return the case of a scene: whole renders. ``bench_texture.py`` times reads."""

        def passes() -> dict:
            functions = {}
            for name, once in self.readers.items():
                loaded, spp = once().loaded(scene, self.settings.film, self.size), once().spp
                functions[name] = lambda k, s=loaded, spp=spp: mi.render(s, spp=spp, seed=k)
            return functions

        shown = {"accuracy": f"psnr_{scene.name}_db", "in_picture": not scene.magnified}
        return Case(scene.name, lambda lanes: {}, passes, **shown)


def reader(texture: dict, spp: int = 1, sampler: str = "independent", path: dict | None = None) -> TextureReader:
    """Return the reader of a texture that is repeated in scenes."""
    plugin = lambda repeats: {**texture, "to_uv": renders.to_uv(repeats)}  # noqa: E731
    return TextureReader(plugin, spp, sampler, path, footprint.attach)


# -- Pictures ----------------------------------------------------------------------------------------------------------


def draw_crops(context: TextureContenders, result: dict):
    """Draw an enlarged part of each still, that with the largest error of the first candidate, and the truth.

    Candidates are bitmaps, and the first with anisotropic filtering of each method.
    """
    from scipy.ndimage import uniform_filter

    candidates, rows = result["candidates"], {}
    shown = {c["representation"]: n for n, c in reversed(candidates.items()) if c["setting"] == "anisotropic, centred"}
    names = ["bitmap, 1 spp", "bitmap, 64 spp", *(n for n in candidates if n in shown.values())]
    half = max(4, context.settings.film[1] // 5)
    for scene in context.scenes.values():
        truth, counted = context.truths[scene.name], scene.counted(context.settings.film, context.size)
        images = [context.render(context.readers[name](), scene) for name in names]
        error = uniform_filter(((images[0] - truth) ** 2).sum(axis=-1) * counted, 2 * half, mode="constant")
        inside = error[half : 1 - half, half : 1 - half]  # centres of parts that lie in the picture
        top, left = np.unravel_index(np.argmax(inside), inside.shape)
        titles = [f"{name}\n{candidates[name]['errors'][f'psnr_{scene.name}_db']:.1f} dB" for name in names]
        titles.append(f"truth\n{context.settings.truth_spp} spp, multijittered")
        parts = [image[top : top + 2 * half, left : left + 2 * half] for image in (*images, truth)]
        rows[scene.name] = dict(zip(titles, parts, strict=True))
    return plot.draw_images(f"{result['title']}: parts of the stills", figure_caption(result), rows)


def draw_levels(result: dict):
    """Draw the PSNR of each level of all compressed textures."""
    levels = {n: job["details"]["levels"]["all"] for n, job in result["jobs"].items()}
    curves = [plot.Curve(name, range(len(psnr)), psnr) for name, psnr in levels.items()]
    title, label = f"{result['title']}: error of each level", "level of detail (0: finest)"
    return plot.draw_curves(title, figure_caption(result), {"All maps, at texel centres": curves}, label, "PSNR, dB")
