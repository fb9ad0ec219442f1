"""Renders and reads that studies measure: textured scenes without noise, queries of BSDFs.

The material of a :class:`TextureScene` is ``diffuse`` under a ``directional`` light, which a path tracer samples
deterministically: samples of a pixel differ only in the position at which the texture is read. The irradiance is such
that a surface that faces the light displays the texture's values. The scale of the texture is given in texels per
pixel, so that a scene means the same for textures and images of any size.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.compat import ray_flags
from ..images import srgb
from .study import FLOOR


@dataclass(frozen=True)
class TextureScene:
    """A textured surface, a camera and a light.

    The uv of ``shape`` (without its material) covers ``extent`` units of length along u and v. The camera at ``origin``
    looks at ``target``, ``fov`` degrees wide; light comes from ``towards_light``. ``texels`` is the area of a pixel in
    texels at the ``anchor``, (x, y) in the image from (0, 0), the upper left, to (1, 1). Errors are those of pixels
    with at least one texel, or if ``magnified``, with less than one.
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
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)

    def scene(
        self, texture: dict, film: tuple[int, int], spp: int = 1, sampler: str = "independent", path: dict | None = None
    ) -> dict:
        """Return the scene for ``mi.load_dict``; ``film`` is (width, height), ``path`` the integrator."""
        towards = np.asarray(self.towards_light, float) / np.linalg.norm(self.towards_light)
        return {
            "type": "scene",
            "integrator": {**(path or {"type": "path"}), "max_depth": 2},
            "sensor": {
                "type": "perspective",
                "fov_axis": "x",
                "fov": self.fov,
                "near_clip": 1e-3,
                "to_world": mi.ScalarTransform4f().look_at(origin=self.origin, target=self.target, up=self.up),
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

    def repeats(self, film: tuple[int, int], texture: tuple[int, int]) -> tuple[float, float]:
        """Return how often a texture of (width, height) texels repeats along u and v: the scale of ``to_uv``."""
        area, _ = self.pixel_areas(film)
        row, column = (min(int(a * n), n - 1) for a, n in zip(self.anchor[::-1], area.shape, strict=True))
        per_unit = math.sqrt(self.texels / (area[row, column] * self.extent[0] * self.extent[1]))
        u, v = (per_unit * e / n for e, n in zip(self.extent, texture, strict=True))
        if self.shape["type"] == "sphere":  # no seam where u begins again
            u, v = max(1.0, float(round(u))), max(1.0, float(round(v)))
        return u, v

    def pixel_areas(self, film: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
        """Return each pixel's area in uv², ``(height, width)``, and whether its corners are on the surface."""
        width, height = film
        x, y = np.meshgrid(np.arange(width + 1) / width, np.arange(height + 1) / height)
        scene = mi.load_dict(self.scene({"type": "rgb", "value": 0.5}, film))
        place = mi.Point2f(*(mi.Float(np.float32(v.ravel())) for v in (x, y)))
        ray, _ = scene.sensors()[0].sample_ray_differential(0.0, 0.5, place, mi.Point2f(0.5, 0.5))
        si = scene.ray_intersect(ray, ray_flags(), coherent=True)
        uv, hit = np.array(si.uv, np.float64).T.reshape(height + 1, width + 1, 2), np.array(si.is_valid())
        hit = hit.reshape(height + 1, width + 1)
        inside = hit[:-1, :-1] & hit[1:, :-1] & hit[:-1, 1:] & hit[1:, 1:]
        a, b = uv[1:, 1:] - uv[:-1, :-1], uv[1:, :-1] - uv[:-1, 1:]  # the diagonals
        area = 0.5 * np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
        return np.where(inside, area, 0), inside

    def counted(self, film: tuple[int, int], texture: tuple[int, int]) -> np.ndarray:
        """Return the mask of the pixels whose errors count, ``(height, width)``."""
        area, inside = self.pixel_areas(film)
        repeats = self.repeats(film, texture)
        texels = area * repeats[0] * texture[0] * repeats[1] * texture[1]
        return inside & ((texels < 1) if self.magnified else (texels >= 1))


def _plane(half: float) -> dict:
    """Return a horizontal square, ``2 half`` wide."""
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale([half, half, 1])}


def still_scenes() -> dict[str, TextureScene]:
    """Return the scenes of stills by name; verdicts are about the first."""
    above, side = (0.0, 1.0, 0.0), (0.3, 0.6, 1.0)
    scenes = [
        TextureScene("plane", _plane(1000.0), (1.0, 1.0), (0.0, 1.0, 0.0), (0.35, 0.72, -1.0), 60.0, above, 0.5,
                     (0.5, 0.999)),
        TextureScene("magnified", _plane(1000.0), (1.0, 1.0), (0.0, 1.0, 0.0), (0.35, 0.0, -0.6), 40.0, above, 1 / 16,
                     magnified=True, up=(0.0, 0.0, -1.0)),
        TextureScene("sphere", {"type": "sphere"}, (2.0, 1.0), (0.0, 0.8, 3.0), (0.0, 0.0, 0.0), 42.0, side, 8.0),
    ]  # fmt: skip
    return {scene.name: scene for scene in scenes}


@dataclass
class TextureReader:
    """A texture plugin with the settings of its renders.

    ``texture(repeats)`` returns the plugin's dictionary for ``mi.load_dict``, given the number of repetitions. ``spp``,
    ``sampler`` and the integrator ``path`` are those of its renders. ``prepare(scene)`` is called with each loaded
    scene.
    """

    texture: Callable[[tuple[float, float]], dict]
    spp: int = 1
    sampler: str = "independent"
    path: dict | None = None
    prepare: Callable[[object], object] = lambda scene: None
    scenes: dict = field(default_factory=dict)

    def loaded(self, scene: TextureScene, film: tuple[int, int], texture: tuple[int, int]):
        """Return the Mitsuba scene, loaded once; the ``texture`` has (width, height) texels."""
        key = (scene.name, film)
        if key not in self.scenes:
            plugin = self.texture(scene.repeats(film, texture))
            self.scenes[key] = mi.load_dict(scene.scene(plugin, film, self.spp, self.sampler, self.path))
            self.prepare(self.scenes[key])
        return self.scenes[key]

    def render(self, scene: TextureScene, film: tuple[int, int], texture: tuple[int, int], seed: int = 0) -> np.ndarray:
        """Return a render as displayed, ``(height, width, 3)`` in [0, 1], float32."""
        return displayed(mi.render(self.loaded(scene, film, texture), spp=self.spp, seed=seed))


def to_uv(repeats: tuple[float, float]):
    """Return the transformation that repeats a texture along u and v."""
    return mi.ScalarTransform4f().scale([repeats[0], repeats[1], 1])


def displayed(image) -> np.ndarray:
    """Return a linear image as displayed, float32."""
    with dr.suspend_grad():
        return srgb.for_display(np.array(image, np.float32)[..., :3]).astype(np.float32)


def errors(truth: np.ndarray, image: np.ndarray, counted: np.ndarray) -> dict[str, float]:
    """Return ``mse`` and ``flip`` of an image as displayed, averaged over the ``counted`` pixels.

    FLIP depends on neighbouring pixels; outside of the mask it is given the truth.
    """
    import flip_evaluator

    difference = (image.astype(np.float64) - truth)[counted]
    filled = np.where(counted[..., None], image, truth)
    pair = [np.ascontiguousarray(i, np.float32) for i in (truth, filled)]
    values, _, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)
    return {"mse": float(np.mean(difference**2)), "flip": float(np.asarray(values)[..., 0][counted].mean())}


#: Methods of a BSDF that are timed.
QUERIES = ("eval", "sample", "pdf")

#: Texels along a side of textures: small enough for the cache, so that the lookup itself is timed.
TEXTURE_SIZE = 64


def directions(lanes: int, seed: int = 7):
    """Return random inputs of BSDFs, ``(si, wo, sample1, sample2)``, for so many ``lanes``, evaluated.

    ``si.wi`` and ``wo`` are uniform over the hemisphere, ``si.uv`` and the random numbers over [0, 1].
    """
    rng = dr.rng(seed=dr.opaque(mi.UInt64, seed))
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    random = [rng.random(mi.Float, lanes) for _ in range(9)]
    si.wi, wo = (mi.warp.square_to_uniform_hemisphere(mi.Point2f(random[k : k + 2])) for k in (0, 2))
    si.uv, sample1, sample2 = mi.Point2f(random[4:6]), random[6], mi.Point2f(random[7:])
    if mi.is_spectral:
        si.wavelengths = 400 + 300 * rng.random(type(si.wavelengths), (dr.size_v(si.wavelengths), lanes))
    dr.make_opaque(si.wi, si.uv, si.wavelengths, wo, sample1, sample2)
    return si, wo, sample1, sample2


def bsdf_queries(
    bsdfs: dict[str, object], inputs: tuple, textured: bool, queries: Sequence[str] = QUERIES
) -> dict[str, dict]:
    """Return query (one of ``eval``, ``sample``, ``pdf``, ``eval_pdf``) → name of a BSDF → function.

    ``inputs`` are those of :func:`directions`. The floor has the same inputs, ``uv`` among them if the materials are
    ``textured``.
    """
    si, wo, sample1, sample2 = inputs
    context = mi.BSDFContext()
    uv, wavelengths = [si.uv] if textured else [], [si.wavelengths] if mi.is_spectral else []
    floors = {
        "eval": [si.wi, wo, *uv, *wavelengths],
        "sample": [si.wi, sample1, sample2, *uv, *wavelengths],
        "pdf": [si.wi, wo, *uv],
    }
    floors["eval_pdf"] = floors["eval"]

    def sample(bsdf):
        bs, weight = bsdf.sample(context, si, sample1, sample2)
        return [bs.wo, bs.pdf, mi.Float(bs.sampled_component), weight]

    functions = {
        "eval": lambda b: b.eval(context, si, wo),
        "eval_pdf": lambda b: list(b.eval_pdf(context, si, wo)),
        "sample": sample,
        "pdf": lambda b: b.pdf(context, si, wo),
    }
    return {
        query: {FLOOR: lambda values=floors[query]: values}
        | {name: functools.partial(functions[query], bsdf) for name, bsdf in bsdfs.items()}
        for query in queries
    }


def noise_texture(values: Sequence[float], rng: np.random.Generator) -> dict:
    """Return a bitmap (for ``mi.load_dict``) whose channels vary around ``values`` by at most 0.1."""
    noise = rng.uniform(-0.1, 0.1, (TEXTURE_SIZE, TEXTURE_SIZE, len(values)))
    data = np.clip(np.asarray(values) + noise, 0.01, 0.99).astype(np.float32)
    return {"type": "bitmap", "data": mi.TensorXf(data), "raw": not mi.is_spectral or len(values) == 1}
