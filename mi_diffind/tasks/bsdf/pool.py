"""Directions at which a BSDF is sampled for training and measurement, with their density."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr

from .model import half_vector, masking

#: Roughness of the GGX lobes of the pool, and the share of its cosine-weighted directions.
ALPHAS, COSINE = (0.003, 0.015, 0.06, 0.2, 0.6), 0.3

#: Share of the directions that the BSDF samples itself, if it can.
NATIVE = 0.2

#: Least 1 − v at which the density of a lobe with an exponent is not 0.
SMALLEST_REST = 1e-12

#: Smallest cosine of a direction of the pool.
HORIZON = 1e-4


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

    With ``gamma``, the density if its number v is first mapped by :func:`shortened`.
    """
    half = half_vector(wi, wo)
    inverse, visible = dr.rcp(dr.squared_norm(half)), masking(wi, dr.square(alpha_u), dr.square(alpha_v))
    slope = inverse * (dr.square(half.x / alpha_u) + dr.square(half.y / alpha_v) + dr.square(half.z))
    density = dr.rcp(2 * dr.pi * alpha_u * alpha_v * dr.square(slope) * visible)
    if gamma is None:
        return density
    rest = dr.minimum(half.z * dr.rcp(slope * visible), 1)  # 1 - v of the sample
    q = dr.fma(2 * dr.rcp(gamma), dr.rcp(rest) - 1, 1)
    factor = 2 * (1 - dr.rcp(gamma)) * dr.exp2(-gamma * dr.log2(q)) * dr.rcp(dr.square(rest))
    return density * dr.select(rest > SMALLEST_REST, factor, 0)


def shortened(v, gamma):
    """Return the number v for which a lobe of :func:`sample_ggx` has tails of the exponent ``gamma`` (2: ``v``).

    At normal incidence, slopes then have the distribution of the proxy's lobes. The map is t / (1 + t) with t = γ/2 ((1
    − v)^(−1/(γ − 1)) − 1), the squared slope over α².
    """
    t = 0.5 * gamma * (dr.exp2(-dr.log2(dr.maximum(1 - v, 1e-7)) * dr.rcp(gamma - 1)) - 1)
    return t * dr.rcp(1 + t)


def cosine_hemisphere(types, u, v):
    """Return a direction of density cos θ / π."""
    r, (sin, cos) = dr.sqrt(u), dr.sincos(2 * dr.pi * v)
    return types.Array3f(r * cos, r * sin, dr.sqrt(dr.maximum(1 - u, 0)))


@dataclass
class Samples:
    """Directions ``wi`` and ``wo``, ``weight`` = 1/density of ``wo`` (0: none), and ``value`` = f cos θ_o (RGB)."""

    wi: object
    wo: object
    weight: object
    value: list | None = None

    def at(self, index) -> Samples:
        """Return the samples of some indices."""
        wi, wo = (type(w)(*(dr.gather(type(c), c, index) for c in w)) for w in (self.wi, self.wo))
        weight, *value = (dr.gather(type(c), c, index) for c in (self.weight, *(self.value or ())))
        return Samples(wi, wo, weight, value or None)


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
    native = NATIVE if truth is not None and truth.samples else 0.0
    share = (1 - COSINE - native) / len(ALPHAS)
    wo = cosine_hemisphere(types, u, v)
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
