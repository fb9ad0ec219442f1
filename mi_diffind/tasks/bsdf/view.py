"""Sphere under a sky, two windows and a lamp: the picture by which a learned BSDF is compared with its source."""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from .pool import outgoing

#: Pixels along a side of the picture, and samples of a pixel.
SIDE, SAMPLES = 64, 64

#: Direction, cosine of the opening, width of the edge, and radiance of windows and lamp.
LIGHTS = (
    ((1, 1, 1.2), 0.93, 0.01, (4, 3.6, 3.2)),
    ((-1.5, 0.3, 0.6), 0.96, 0.01, (3.5, 4, 5)),
    ((0.2, 0.9, 0.8), 0.9985, 0.0005, (60, 60, 60)),
)


class SphereView:
    """Orthographic view of a sphere, lit by constant lights, in whose pixels a source was sampled.

    Images of other BSDFs reuse the samples, so that errors contain no noise of the lights; two halves of the samples
    are multiplied to leave out the rest.
    """

    def __init__(self, truth, types, seed: int = 7, side: int = SIDE, samples: int = SAMPLES):
        self.types, self.side, self.count = types, side, samples
        rng = dr.rng(seed=dr.opaque(types.UInt64, seed))
        lane = dr.arange(types.UInt32, side * side * samples)
        pixel = lane // samples
        x = (types.Float(pixel % side) + 0.5) * (2 / side) - 1
        y = 1 - (types.Float(pixel // side) + 0.5) * (2 / side)
        r2 = dr.square(x) + dr.square(y)
        self.hit = (r2 < 0.99).numpy().reshape(side, side, samples)[..., 0]
        n = types.Array3f(x, y, dr.sqrt(dr.maximum(1 - r2, 0.01)))
        n = n * dr.rsqrt(dr.squared_norm(n))
        # The tangent runs along the sphere's parallels, as that of Mitsuba's spheres about y
        s = types.Array3f(n.z, 0, -n.x)
        s = s * dr.rsqrt(dr.maximum(dr.squared_norm(s), 1e-12))
        t = types.Array3f(n.y * s.z - n.z * s.y, n.z * s.x - n.x * s.z, n.x * s.y - n.y * s.x)
        self.samples = outgoing(rng, types, types.Array3f(s.z, t.z, n.z), truth)
        wo = self.samples.wo
        world = types.Array3f(*(dr.fma(wo.x, s[i], dr.fma(wo.y, t[i], wo.z * n[i])) for i in range(3)))
        weight = dr.select(r2 < 0.99, self.samples.weight / samples, 0)
        self.light = [weight * channel for channel in radiance(world)]
        dr.eval(self.samples.wi, self.light)
        self.halves = self._halves(truth.value(self.samples.wi, wo))

    def _halves(self, value: list) -> np.ndarray:
        """Return two images of independent samples, ``(2, side, side, 3)``."""
        products = [dr.detach(v * light) for v, light in zip(value, self.light, strict=True)]
        dr.eval(products)
        images = np.stack([p.numpy() for p in products], axis=-1).reshape(self.side, self.side, self.count, 3)
        half = self.count // 2
        return 2 * np.stack([images[:, :, :half].sum(axis=2), images[:, :, half:].sum(axis=2)])

    def images(self, value) -> np.ndarray:
        """Return two images of a function ``value(wi, wo)`` = f cos θ_o."""
        with dr.suspend_grad():
            return self._halves(value(self.samples.wi, self.samples.wo))

    def psnr(self, value) -> float:
        """Return the PSNR in dB of images with values clipped to [0, 1], without noise, of the pixels of the sphere."""
        images = self.images(value)
        a, b = (np.clip(images[i], 0, 1) - np.clip(self.halves[i], 0, 1) for i in range(2))
        error = float(np.mean((a * b)[self.hit], dtype=np.float64))
        return -10 * math.log10(max(error, 1e-12))


def radiance(d) -> list:
    """Return the light from directions ``d``, RGB: a gradient, two windows and a lamp."""
    sky = dr.lerp(0.15, 0.5, dr.fma(d.y, 0.5, 0.5))
    result = [0.9 * sky, sky, 1.1 * sky]
    for towards, cosine, edge, colour in LIGHTS:
        unit = np.array(towards, np.float64) / np.linalg.norm(towards)
        x = sum(float(unit[i]) * d[i] for i in range(3))
        window = dr.clip((x - cosine) / edge, 0, 1)
        result = [r + c * window for r, c in zip(result, colour, strict=True)]
    return result
