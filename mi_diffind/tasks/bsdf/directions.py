"""Directions at which a BSDF is sampled for training and measurement, and the lit sphere that measures it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import numpy as np

from ...arrays import fast_math
from .model import half_vector, masking

#: Roughnesses of the GGX lobes from which directions are drawn.
ALPHAS = (0.003, 0.015, 0.06, 0.2, 0.6)

#: Share of the cosine-weighted directions.
COSINE = 0.3

#: Smallest cosine of a direction.
HORIZON = 1e-4


#: Pixels along a side of the picture of a sphere.
SIDE = 64

#: Samples of a pixel.
PIXEL_SAMPLES = 64

#: Direction, cosine of the opening, width of the edge, and radiance of windows and lamp.
LIGHTS = (
    ((1, 1, 1.2), 0.93, 0.01, (4, 3.6, 3.2)),
    ((-1.5, 0.3, 0.6), 0.96, 0.01, (3.5, 4, 5)),
    ((0.2, 0.9, 0.8), 0.9985, 0.0005, (60, 60, 60)),
)


def sample_ggx(wi, alpha_u, alpha_v, u, v):
    """Return ``wo``, the reflection of ``wi`` by a visible normal of GGX (Dupuy and Benyoub 2023)."""
    x, y, z = alpha_u * wi.x, alpha_v * wi.y, wi.z
    inverse = dr.rsqrt(dr.maximum(dr.square(x) + dr.square(y) + dr.square(z), 1e-20))
    x, y, z = x * inverse, y * inverse, z * inverse
    height = dr.fma(1 - v, 1 + z, -z)
    sin = dr.sqrt(dr.maximum(1 - dr.square(height), 0))
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * u)
    m = type(wi)(alpha_u * dr.fma(sin, cos_phi, x), alpha_v * dr.fma(sin, sin_phi, y), dr.maximum(height + z, 0))
    m = m * dr.rsqrt(dr.maximum(dr.squared_norm(m), 1e-20))
    return 2 * dr.dot(wi, m) * m - wi


def density_ggx(wi, wo, alpha_u, alpha_v, gamma=None):
    """Return the density of :func:`sample_ggx` per solid angle, D / (2 d(wi)).

    With ``gamma``, the density if its number v is first mapped by :func:`shorten_tail`.
    """
    half, visible = half_vector(wi, wo), masking(wi, dr.square(alpha_u), dr.square(alpha_v))
    square = dr.square(half.x * dr.rcp(alpha_u)) + dr.square(half.y * dr.rcp(alpha_v)) + dr.square(half.z)
    product = square * dr.rcp(dr.squared_norm(half)) * visible  # of the slope's factor and masking
    inverse = dr.rcp(product)
    density = dr.square(inverse) * visible * dr.rcp(2 * dr.pi * alpha_u * alpha_v)
    if gamma is None:
        return density
    ratio = dr.maximum(product * dr.rcp(dr.maximum(half.z, 1e-12)), 1)  # 1 / (1 - v) of the sample
    q = dr.fma(2 * dr.rcp(gamma), ratio - 1, 1)
    factor = 2 * (1 - dr.rcp(gamma)) * fast_math.exp2(-gamma * fast_math.log2(q)) * dr.square(ratio)
    return density * dr.select(ratio < 1e12, factor, 0)


def shorten_tail(v, gamma):
    """Return the number v for which a lobe of :func:`sample_ggx` has tails of the exponent ``gamma`` (2: ``v``).

    At normal incidence, slopes then have the distribution of the proxy's lobes. The map is t / (1 + t) with t = γ/2 ((1
    − v)^(−1/(γ − 1)) − 1), the squared slope over α².
    """
    power = fast_math.exp2(-fast_math.log2(dr.maximum(1 - v, 1e-7)) * dr.rcp(gamma - 1))
    t = 0.5 * gamma * (power - 1)
    return t * dr.rcp(1 + t)


def cosine_hemisphere(vector: type, u, v):
    """Return a direction of density cos θ / π, a ``vector``, from two uniform numbers."""
    r, (sin, cos) = dr.sqrt(u), dr.sincos(2 * dr.pi * v)
    return vector(r * cos, r * sin, dr.sqrt(dr.maximum(1 - u, 0)))


@dataclass
class Samples:
    """Directions ``wi`` and ``wo``, ``weight`` = 1/density of ``wo`` (0: none), and ``value`` = f cos θ_o (RGB).

    ``coordinates`` are those of the parameters of a family, arrays.
    """

    wi: object
    wo: object
    weight: object
    value: list | None = None
    coordinates: Sequence = ()

    def at(self, index) -> Samples:
        """Return the samples of some indices."""
        wi, wo = (type(w)(*(dr.gather(type(c), c, index) for c in w)) for w in (self.wi, self.wo))
        weight, *value = (dr.gather(type(c), c, index) for c in (self.weight, *(self.value or ())))
        return Samples(wi, wo, weight, value or None, [dr.gather(type(c), c, index) for c in self.coordinates])


def incident(rng, types, size: int, isotropic: bool):
    """Return directions ``wi``: half of them uniform in cos θ, half uniform over the hemisphere projected."""
    choice, u, v = (rng.random(types.Float, size) for _ in range(3))
    cos = dr.maximum(dr.select(choice < 0.5, u, dr.sqrt(u)), 1e-3)
    sin = dr.sqrt(1 - dr.square(cos))
    if isotropic:
        return types.Array3f(sin, 0, cos)
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * v)
    return types.Array3f(sin * cos_phi, sin * sin_phi, cos)


def outgoing(rng, types, wi, truth=None) -> Samples:
    """Return directions ``wo``: cosine-weighted, of GGX lobes of five roughnesses, and those that ``truth`` samples."""
    size = dr.width(wi)
    choice, u, v, w = (rng.random(types.Float, size) for _ in range(4))
    native = 0.2 if truth is not None and truth.samples else 0.0
    share = (1 - COSINE - native) / len(ALPHAS)
    wo = cosine_hemisphere(type(wi), u, v)
    for k, alpha in enumerate(ALPHAS):
        chosen = choice > COSINE + k * share
        wo = dr.select(chosen, sample_ggx(wi, types.Float(alpha), types.Float(alpha), u, v), wo)
    if native:
        wo = dr.select(choice > 1 - native, truth.sample(wi, w, u, v), wo)
    valid = (wo.z > HORIZON) & (dr.squared_norm(wo) < 2)
    wo = dr.select(valid, wo, types.Array3f(0, 0, 1))
    density = COSINE * wo.z * dr.inv_pi
    for alpha in ALPHAS:
        density += share * density_ggx(wi, wo, types.Float(alpha), types.Float(alpha))
    if native:
        density += native * truth.density(wi, wo)
    weight = dr.select(valid, dr.rcp(density), 0)
    dr.eval(wo, weight)
    return Samples(wi, wo, weight)


class SphereView:
    """Orthographic view of a sphere, lit by constant lights, in whose pixels a source was sampled.

    Images of other BSDFs reuse the samples, so that errors contain no noise of the lights; two halves of the samples
    are multiplied to leave out the rest.
    """

    def __init__(self, truth, types, seed: int = 7, side: int = SIDE, samples: int = PIXEL_SAMPLES):
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
