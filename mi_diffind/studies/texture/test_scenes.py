"""
What the study of filtered textures looks at: a surface and a camera each, in a light that has no noise of its own.

The material is a ``diffuse`` one under a ``directional`` light, which a path tracer finds without chance: what differs
from one sample of a pixel to the next is the place alone at which the texture is read. The irradiance is such that a
surface that faces the light shows the texture's values.

How large the texture is on the surface is given in texels a pixel, so that a stage means the same for textures and
images of any size.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import srgb


@dataclass(frozen=True)
class Stage:
    """
    A situation. ``shape`` without its material, whose uv covers ``extent`` units of length along u and v; the camera at
    ``origin`` looks at ``target``, ``fov`` degrees wide; light comes from ``towards_light``.

    ``texels`` is the area of a pixel in texels at the ``anchor``, (x, y) in the image from (0, 0), the upper left, to
    (1, 1). Errors are those of pixels with at least, or if ``magnified`` less than, one texel.
    """

    name: str
    shape: dict
    extent: tuple[float, float]
    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    fov: float
    towards_light: tuple[float, float, float]
    texels: float
    anchor: tuple[float, float] = (0.5, 0.5)
    magnified: bool = False

    def scene(
        self, texture: dict, film: tuple[int, int], spp: int = 1, sampler: str = "independent", path: dict | None = None
    ) -> dict:
        """
        The scene, for ``mi.load_dict``: ``texture`` on the surface, ``film`` its width and height, ``path`` the
        integrator, if it is not Mitsuba's own.
        """
        towards = np.asarray(self.towards_light, float) / np.linalg.norm(self.towards_light)
        return {
            "type": "scene",
            "integrator": {**(path or {"type": "path"}), "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov_axis": "x",
                "fov": self.fov,
                "near_clip": 1e-3,
                "to_world": self.look(self.origin),
                "sampler": {"type": sampler, "sample_count": spp},
                "film": {
                    "type": "hdrfilm", "width": film[0], "height": film[1], "pixel_format": "rgb",
                    "component_format": "float32", "rfilter": {"type": "box"},
                },
            },
            "light": {"type": "directional", "direction": (-towards).tolist(),
                      "irradiance": {"type": "rgb", "value": math.pi}},
            "surface": {**self.shape, "bsdf": {"type": "diffuse", "reflectance": texture}},
        }  # fmt: skip

    def look(self, origin) -> mi.ScalarTransform4f:
        """The camera's ``to_world`` at another place, looking the same way."""
        way = np.asarray(self.target, float) - np.asarray(self.origin, float)
        origin = np.asarray(origin, float)
        return mi.ScalarTransform4f().look_at(
            origin=origin.tolist(), target=(origin + way).tolist(), up=[0, 1, 0] if abs(way[1]) < 0.999 else [0, 0, -1]
        )

    def repeats(self, film: tuple[int, int], texture: tuple[int, int]) -> tuple[float, float]:
        """How often a texture of so many texels (width, height) is repeated along u and v: the scale of ``to_uv``."""
        area, _ = self.seen(film)
        row, column = (min(int(a * n), n - 1) for a, n in zip(self.anchor[::-1], area.shape, strict=True))
        per_unit = math.sqrt(self.texels / (area[row, column] * self.extent[0] * self.extent[1]))
        found = [per_unit * e / n for e, n in zip(self.extent, texture, strict=True)]
        if self.shape["type"] == "sphere":  # no seam where u begins anew
            found = [max(1.0, float(round(v))) for v in found]
        return found[0], found[1]

    def seen(self, film: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Of each pixel, ``(height, width)``: its area in uv², and whether all of its corners are on the surface."""
        width, height = film
        x, y = np.meshgrid(np.arange(width + 1) / width, np.arange(height + 1) / height)
        uv, hit = self.trace(film, x.ravel(), y.ravel())
        uv, hit = uv.reshape(height + 1, width + 1, 2), hit.reshape(height + 1, width + 1)
        inside = hit[:-1, :-1] & hit[1:, :-1] & hit[:-1, 1:] & hit[1:, 1:]
        a, b = uv[1:, 1:] - uv[:-1, :-1], uv[1:, :-1] - uv[:-1, 1:]  # the diagonals
        area = 0.5 * np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
        return np.where(inside, area, 0), inside

    def trace(self, film: tuple[int, int], x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The surface's uv, ``(n, 2)``, at places of the image in [0, 1], and whether it is there."""
        scene = mi.load_dict(self.scene({"type": "rgb", "value": 0.5}, film))
        si = self.hits(scene, x, y)
        return np.array(si.uv, np.float64).T, np.array(si.is_valid())

    @staticmethod
    def hits(scene, x: np.ndarray, y: np.ndarray):
        """What a loaded scene shows at places of the image in [0, 1]: a surface interaction, with all of its fields."""
        sensor = scene.sensors()[0]
        place = mi.Point2f(mi.Float(np.asarray(x, np.float32)), mi.Float(np.asarray(y, np.float32)))
        ray, _ = sensor.sample_ray_differential(0.0, 0.5, place, mi.Point2f(0.5, 0.5))
        si = scene.ray_intersect(ray, mi.RayFlags.All, coherent=True)
        dr.eval(si)  # while the scene is there
        return si

    def counted(self, film: tuple[int, int], texture: tuple[int, int]) -> np.ndarray:
        """The pixels whose errors count, ``(height, width)``."""
        area, inside = self.seen(film)
        repeats = self.repeats(film, texture)
        texels = area * repeats[0] * texture[0] * repeats[1] * texture[1]
        return inside & ((texels < 1) if self.magnified else (texels >= 1))


def _plane(half: float) -> dict:
    """A square on its back, ``2 half`` wide."""
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale([half, half, 1]),
    }


def stages() -> dict[str, Stage]:
    """The stages of stills by name; the first is the one that verdicts are about."""
    above, side = (0.0, 1.0, 0.0), (0.3, 0.6, 1.0)
    found = [
        Stage("plane", _plane(1000.0), (1.0, 1.0), (0.0, 1.0, 0.0), (0.35, 0.72, -1.0), 60.0, above, 0.5, (0.5, 0.999)),
        Stage("magnified", _plane(1000.0), (1.0, 1.0), (0.0, 1.0, 0.0), (0.35, 0.0, -0.6), 40.0, above, 1 / 16,
              magnified=True),
        Stage("sphere", {"type": "sphere"}, (2.0, 1.0), (0.0, 0.8, 3.0), (0.0, 0.0, 0.0), 42.0, side, 8.0),
    ]  # fmt: skip
    return {stage.name: stage for stage in found}


def zoom_stage() -> Stage:
    """The stage of the moving camera: a plane at a slant, its first frame; 100 texels a pixel in the middle."""
    return Stage("zoom", _plane(1000.0), (1.0, 1.0), (0.0, 2.0, 2.0), (0.0, 0.0, 0.0), 40.0, (0.0, 1.0, 0.0), 100.0)


# -- what is seen -----------------------------------------------------------------------------------------------------


@dataclass
class Reader:
    """
    A way to read the texture: ``texture(repeats)`` is its dictionary for ``mi.load_dict``, given how often it is
    repeated; ``spp``, ``sampler`` and the integrator ``path`` are those of its renders. ``prepare(scene)`` is called
    with each scene that was loaded, and whenever its camera has moved.
    """

    texture: Callable[[tuple[float, float]], dict]
    spp: int = 1
    sampler: str = "independent"
    path: dict | None = None
    prepare: Callable[[object], object] = lambda scene: None
    scenes: dict = field(default_factory=dict)

    def loaded(self, stage: Stage, film: tuple[int, int], texture: tuple[int, int]):
        """The scene of a stage, loaded once."""
        key = (stage.name, film)
        if key not in self.scenes:
            scale = stage.repeats(film, texture)
            description = stage.scene(self.texture(scale), film, self.spp, self.sampler, self.path)
            self.scenes[key] = mi.load_dict(description)
            self.prepare(self.scenes[key])
        return self.scenes[key]

    def render(self, stage: Stage, film: tuple[int, int], texture: tuple[int, int], seed: int = 0) -> np.ndarray:
        """A render as displayed, ``(height, width, 3)`` in [0, 1], float32."""
        scene = self.loaded(stage, film, texture)
        return shown(mi.render(scene, spp=self.spp, seed=seed))


def to_uv(repeats: tuple[float, float]):
    """The transformation that repeats a texture so often."""
    return mi.ScalarTransform4f().scale([repeats[0], repeats[1], 1])


def shown(image) -> np.ndarray:
    """A linear image as displayed, float32."""
    with dr.suspend_grad():
        return srgb.for_display(np.array(image, np.float32)[..., :3]).astype(np.float32)


def errors(truth: np.ndarray, image: np.ndarray, counted: np.ndarray) -> dict[str, float]:
    """
    ``mse`` and ``flip`` of an image as displayed: the mean over the pixels that are ``counted``; elsewhere FLIP, which
    looks at neighbours, is given the truth.
    """
    import flip_evaluator

    difference = (image.astype(np.float64) - truth)[counted]
    filled = np.where(counted[..., None], image, truth)
    pair = [np.ascontiguousarray(i, np.float32) for i in (truth, filled)]
    found, _, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)
    return {"mse": float(np.mean(difference**2)), "flip": float(np.asarray(found)[..., 0][counted].mean())}


def decibel(mse: float) -> float:
    """PSNR for a peak of 1, at most 120 dB."""
    return -10 * math.log10(max(mse, 1e-12))
