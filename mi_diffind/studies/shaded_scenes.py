"""Renders of a material from near to far: a floor and a ball, under a sun and a weak sky, and in surroundings.

Each file is rendered with the footprints of 1, 4 or 16 samples a pixel, but with many samples: its errors are bias, not
noise. *The truth* is ``normalmap`` around ``disney`` with bitmaps of the source. The noise that is left is not counted:
the errors of two independent halves are multiplied. PSNR is that of values clipped to [0, 1], exposed such that 5% of
the truth's pixels are brighter; brightness is that of values up to 16, so that no single mirror of the sun decides it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from ..images import srgb
from ..maps.pyramid import decibel
from ..maps.source import Source
from ..measure.renders import to_uv
from ..plugins.support import footprint
from ..scenes import examples, loading
from ..scenes.training.problem import estimate_exposure
from ..tasks.texture.surface import READ
from .baselines.normals import LOBE, ReadMaps


class FloorView(NamedTuple):
    """Direction of the camera from the ball, and of the light relative to it, in degrees."""

    azimuth: float
    elevation: float
    light_azimuth: float
    light_elevation: float


#: Views, which no training sees. The light comes from beyond the ball, so that its highlights are seen.
VIEWS = (FloorView(20, 10, 165, 24), FloorView(-35, 14, 200, 33), FloorView(80, 20, 150, 45))

#: Samples a pixel whose footprints are rendered.
SAMPLES = (1, 4, 16)

#: Lights of a scene.
LIGHTS = ("sun", "surroundings")

#: Half of the floor's width, radius of the ball on it, distance of the camera from the ball.
HALF, RADIUS, DISTANCE = 11.0, 0.5, 3.0

#: Texels of the material along a unit of length, for each pixel of the film's width: levels of detail from 0 to 5.
DENSITY = 0.5

#: Distances from the camera that part the floor into :data:`PARTS`.
EDGES = (3.5, 6.5)

#: Parts of a picture whose brightness is measured.
PARTS = ("whole", "near", "middle", "far")

#: Limit of exposed values whose mean is a brightness. Where roughness is 0, a pixel that mirrors the sun has 10,000.
BRIGHTEST = 16.0

#: Most samples of one pass.
PASS = 2**22


class SceneQuality(NamedTuple):
    """Width and height of the film, samples a pixel of the truth and of other renders, and number of views."""

    film: tuple[int, int] = (320, 180)
    truth_spp: int = 512
    spp: int = 128
    views: int = 3


#: Function of how often maps repeat along u and v that returns a material for ``mi.load_dict``.
MaterialDict = Callable[[tuple[float, float]], dict]


def exact_material(source: Source, wrap_mode: str) -> MaterialDict:
    """Return the truth: bitmaps of the maps of a source that shading reads."""
    maps = {m.role: m for m in source.maps if m.role in READ}

    def material(repeats: tuple[float, float]) -> dict:
        def bitmap(role: str) -> dict:
            values = srgb.to_linear(maps[role].values) if maps[role].color_space == "srgb" else maps[role].values
            return {"type": "bitmap", "data": mi.TensorXf(np.ascontiguousarray(values, np.float32)), "raw": True,
                    "wrap_mode": wrap_mode, "to_uv": to_uv(repeats)}  # fmt: skip

        names = {"albedo": "base_color", "roughness": "roughness", "metallic": "metallic"}
        bsdf = {"type": "disney", **{name: bitmap(role) for role, name in names.items() if role in maps}}
        return {"type": "normalmap", "normalmap": bitmap("normal"), "bsdf": bsdf} if "normal" in maps else bsdf

    return material


@dataclass(frozen=True)
class RenderedFile:
    """A file of ``fit texture``, and the maps that are read in its place (``None``: those of the file).

    The maps have the layout of the file.
    """

    file: Path
    maps: ReadMaps | None = None

    def material(self, source: Source, wrap_mode: str) -> MaterialDict:
        """Return the file as a material; maps of a ``source`` that shading does not read are left out."""
        unread = [m.name for m in source.maps if m.role not in READ]
        shaped = self.maps is not None and self.maps.has_extras
        ignored = ",".join([*unread, *[LOBE] * shaped])
        given = {"anisotropic": 0.01} if shaped else {}  # of a lobe that the extras replace
        return lambda repeats: {"type": "neural_material", "filename": str(self.file), "ignore": ignored, **given,
                                "wrap_mode": wrap_mode, "to_uv": to_uv(repeats)}  # fmt: skip


def scene_dict(material: MaterialDict, source: Source, lights: str, view: FloorView, film: tuple[int, int]) -> dict:
    """Return the scene for ``mi.load_dict``."""
    transform, density = mi.ScalarTransform4f, DENSITY * film[0]

    def repeats(across: float, along: float) -> tuple[float, float]:
        return across * density / source.width, along * density / source.height

    def towards(azimuth: float, elevation: float) -> np.ndarray:
        a, e = math.radians(azimuth), math.radians(elevation)
        return np.array([math.sin(a) * math.cos(e), math.sin(e), math.cos(a) * math.cos(e)])

    origin = [0, RADIUS, 0] + DISTANCE * towards(view.azimuth, view.elevation)
    azimuth = view.azimuth + view.light_azimuth
    emitters = {
        "sun": {
            "sun": {"type": "directional", "direction": (-towards(azimuth, view.light_elevation)).tolist(),
                    "irradiance": {"type": "rgb", "value": 3.0}},
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.15}},
        },
        "surroundings": {
            "sky": {"type": "envmap", "filename": str(examples.source() / "assets" / "interior.exr"),
                    "to_world": transform().rotate([0, 1, 0], azimuth)},
        },
    }  # fmt: skip
    turned = transform().rotate([1, 0, 0], -90)
    ball = (max(1.0, round(n)) for n in repeats(2 * math.pi * RADIUS, math.pi * RADIUS))  # no seam
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {
            "type": "perspective", "fov": 55, "near_clip": 0.01, "sampler": {"type": "multijitter"},
            "to_world": transform().look_at(origin=origin.tolist(), target=[0, 0.5 * RADIUS, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": film[0], "height": film[1], "pixel_format": "rgb",
                     "component_format": "float32", "rfilter": {"type": "box"}},
        },
        **emitters[lights],
        "floor": {"type": "rectangle", "to_world": turned.scale([HALF, HALF, 1]),
                  "bsdf": material(repeats(2 * HALF, 2 * HALF))},
        "ball": {"type": "sphere", "to_world": transform().translate([0, RADIUS, 0]) @ turned.scale(RADIUS),
                 "bsdf": material(tuple(ball))},
    }  # fmt: skip


def parts(scene, film: tuple[int, int]) -> dict[str, np.ndarray]:
    """Return the masks ``(height, width)`` of :data:`PARTS`: all that is no sky, and the floor by its distance."""
    width, height = film
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    place = mi.Point2f(*(mi.Float(v.ravel().astype(np.float32)) for v in (x, y)))
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    hit, distance = np.array(si.is_valid()).reshape(height, width), np.array(si.t).reshape(height, width)
    floor = hit & (np.array(si.p.y).reshape(height, width) < 1e-3)
    return {"whole": hit, **{part: floor & (np.digitize(distance, EDGES) == i) for i, part in enumerate(PARTS[1:])}}


def halves(scene, spp: int) -> np.ndarray:
    """Return two independent renders with half of the samples each, ``(2, height, width, 3)``."""
    width, height = scene.sensors()[0].film().size()
    most = max(1, min(spp // 2, PASS // (width * height)))
    each = 4 ** int(math.log(most, 4) + 1e-9)  # the sampler rounds up to squares
    passes = max(1, spp // 2 // each)
    with dr.suspend_grad():
        images = [np.array(mi.render(scene, spp=each, seed=seed), np.float64) for seed in range(2 * passes)]
    return np.stack([np.mean(images[half::2], axis=0) for half in range(2)])


@dataclass
class FloorScenes:
    """Renders of the maps of a ``source``; ``wrap_mode`` is that of its textures."""

    source: Source
    wrap_mode: str
    quality: SceneQuality

    def __post_init__(self):
        self.truths = {}  # by lights and view: halves, exposure, masks

    def truth(self, lights: str, view: FloorView) -> tuple[np.ndarray, float, dict[str, np.ndarray]]:
        """Return both halves of the truth, the exposure, and the masks of :func:`parts`; rendered once."""
        if (lights, view) not in self.truths:
            film, material = self.quality.film, exact_material(self.source, self.wrap_mode)
            scene = loading.load_dict(scene_dict(material, self.source, lights, view, film))
            images = halves(scene, self.quality.truth_spp)
            self.truths[lights, view] = images, estimate_exposure([images.mean(axis=0)]), parts(scene, film)
        return self.truths[lights, view]

    def images(self, rendered: RenderedFile, lights: str, view: FloorView, samples=SAMPLES) -> dict[int, np.ndarray]:
        """Return :func:`halves` of a file, by the samples a pixel whose footprints it is read with."""
        material = rendered.material(self.source, self.wrap_mode)
        scene = loading.load_dict(scene_dict(material, self.source, lights, view, self.quality.film))
        for texture in footprint.textures(scene) if rendered.maps is not None else ():
            texture.image = rendered.maps
        images = {}
        for spp in samples:
            footprint.attach(scene, 0, spp)
            images[spp] = halves(scene, self.quality.spp)
        return images

    def measure(self, rendered: RenderedFile) -> dict[str, dict[str, dict]]:
        """Return the errors by lights and samples a pixel, one number a view.

        ``psnr_db``, and ``brightness``: part → ratio of the brightness to that of the truth.
        """
        figures = {lights: {str(n): {"psnr_db": [], "brightness": []} for n in SAMPLES} for lights in LIGHTS}
        for lights in LIGHTS:
            for view in VIEWS[: self.quality.views]:
                truth, exposure, masks = self.truth(lights, view)
                for spp, images in self.images(rendered, lights, view).items():
                    figures[lights][str(spp)]["psnr_db"].append(psnr(truth, images, exposure))
                    ratios = {part: brightness(truth[:, m], images[:, m], exposure) for part, m in masks.items()}
                    figures[lights][str(spp)]["brightness"].append(ratios)
        return figures


def psnr(truth: np.ndarray, images: np.ndarray, exposure: float) -> float:
    """Return the PSNR in dB of exposed and clipped values, without the noise of both pairs of halves."""
    a, b = np.clip(exposure * images, 0, 1) - np.clip(exposure * truth, 0, 1)
    return decibel(float(np.mean(a * b)))


def brightness(truth: np.ndarray, images: np.ndarray, exposure: float) -> float:
    """Return the ratio of the means of exposed values, each at most :data:`BRIGHTEST`."""
    light, expected = (np.minimum(exposure * values, BRIGHTEST).mean() for values in (images, truth))
    return float(light / expected)
