"""Importance sampling of a learned BSDF, or of a family: a mixture of a cosine and two lobes of visible GGX normals."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import numpy as np

from .directions import cosine_hemisphere, density_ggx, incident, outgoing, sample_ggx, shorten_tail
from .model import SAMPLING_NODES, grid, opaque_numbers, rotate, table_nodes, widths

#: Directions of incidence for which weights are stored, evenly spaced in √cos θ_i: dense near the horizon.
NODES = 16

#: Samples of each of these directions that determine the weights; of a member of a family.
SAMPLES = 4096
MEMBER_SAMPLES = 1024

#: Roughnesses of the lobes that are tried.
ALPHAS = tuple(float(a) for a in np.geomspace(0.002, 1.0, 16))

#: Factors of the widths of the proxy's lobes that are tried for a family.
FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0, 3.0)

#: Samples of a direction, and iterations, that rank pairs of lobes.
RANKING = (256, 8)


@dataclass(frozen=True)
class SampledLobe:
    """Lobe of visible GGX normals of the roughnesses ``alpha_u`` and ``alpha_v``, numbers or arrays.

    ``gamma`` is the exponent of its tails: 2 for GGX, larger for shorter ones (:func:`.directions.shorten_tail`).
    """

    alpha_u: object
    alpha_v: object
    gamma: object = 2.0

    @property
    def is_ggx(self) -> bool:
        """Whether the tails are known to be those of GGX."""
        return isinstance(self.gamma, float) and self.gamma == 2

    def density(self, wi, wo):
        """Return the density of its samples per solid angle."""
        Float = type(wo.z)
        gamma = None if self.is_ggx else Float(self.gamma)
        return density_ggx(wi, wo, Float(self.alpha_u), Float(self.alpha_v), gamma)


def fit_mixture(truth, types, isotropic: bool, stretch: float = 1.0) -> tuple[tuple, np.ndarray]:
    """Return both lobes, and the weights of cosine and lobes, ``(NODES, 3)``.

    They minimise the mean square of the weights f cos θ / p of a sample, whose lower bound is the squared albedo.
    Each node's weights sum to 1. ``stretch`` is α_v/α_u of the lobes.
    """
    root = math.sqrt(stretch)
    lobes = [
        SampledLobe(*(float(np.clip(a, 1e-3, 1)) for a in (alpha / root, alpha * root)), gamma)
        for alpha in ALPHAS
        for gamma in (2.0, 5.0, 20.0)  # of the tails
    ]
    densities, square = candidate_densities(truth, types, isotropic, lobes, SAMPLES)
    some = slice(0, RANKING[0])
    ranked = []
    for i, j in itertools.combinations(range(len(lobes)), 2):
        _, cost = optimal_weights(densities[[0, 1 + i, 1 + j], :, some], square[:, some], RANKING[1])
        ranked.append((float(np.log(cost).mean()), i, j))
    best = None
    for _, i, j in sorted(ranked)[:6]:  # tried with all samples
        weights, cost = optimal_weights(densities[[0, 1 + i, 1 + j]].astype(np.float64), square)
        total = float(np.mean(np.log(cost)))
        if best is None or total < best[0]:
            best = total, (lobes[i], lobes[j]), weights
    return best[1:]


def fit_family_mixture(truth, member_at: Callable, types, isotropic: bool) -> tuple[tuple, np.ndarray]:
    """Return the factors of the widths of both lobes, and weights, ``(NODES, nodes of the parameters…, 3)``.

    ``member_at`` returns the member of the family at coordinates.
    """
    nodes = table_nodes(truth.parameters, SAMPLING_NODES)
    pairs = list(itertools.product(range(len(FACTORS)), repeat=2))
    costs, weights = np.zeros(len(pairs)), []
    for coordinates in grid(nodes):
        source, fitted = truth.at(coordinates), member_at(opaque_numbers(types, coordinates))
        lobes = widths(fitted.proxy, fitted.scale)
        alphas = [dr.clip(types.Float(factor * w), 1e-3, 1) for w in lobes for factor in FACTORS]
        dr.eval(alphas)
        lobes_tried = [SampledLobe(a, a) for a in alphas]
        densities, square = candidate_densities(source, types, isotropic, lobes_tried, MEMBER_SAMPLES)
        tried = [optimal_weights(densities[[0, 1 + i, 1 + len(FACTORS) + j]], square) for i, j in pairs]
        costs += [np.log(cost).mean() for _, cost in tried]
        weights.append([w for w, _ in tried])
    best = int(np.argmin(costs))
    table = np.stack([w[best] for w in weights], axis=1)
    return tuple(FACTORS[k] for k in pairs[best]), table.reshape(NODES, *nodes, 3)


def candidate_densities(truth, types, isotropic: bool, lobes: list, size: int) -> tuple:
    """Return densities of the cosine and of ``lobes``, ``(1 + K, NODES, size)``, and f²/density, ``(NODES, size)``.

    The squares, of ``size`` samples of a source at each of :data:`NODES` cosines, have a mean of 1 at each.
    """
    rng = dr.rng(seed=dr.opaque(types.UInt64, 3))
    node = dr.arange(types.UInt32, NODES * size) // size
    cosines = np.maximum(np.linspace(0, 1, NODES) ** 2, 2e-3)  # the first is slightly above the horizon
    cos = dr.gather(types.Float, types.Float(cosines.astype(np.float32)), node)
    sin = dr.sqrt(1 - dr.square(cos))
    azimuth = incident(rng, types, NODES * size, isotropic)
    r = dr.rsqrt(dr.maximum(dr.square(azimuth.x) + dr.square(azimuth.y), 1e-12))
    wi = types.Array3f(sin * azimuth.x * r, sin * azimuth.y * r, cos)
    s = outgoing(rng, types, wi, truth)
    with dr.suspend_grad():
        value = truth.value(s.wi, s.wo)
        mean = (value[0] + value[1] + value[2]) / 3
        columns = [s.weight, mean, s.wo.z * dr.inv_pi, *(lobe.density(s.wi, s.wo) for lobe in lobes)]
        dr.eval(columns)
    weight, mean, *densities = (c.numpy().reshape(NODES, size) for c in columns)
    square = weight * mean**2
    means = square.mean(axis=1, keepdims=True)
    return np.stack(densities), np.where(means > 0, square / np.where(means > 0, means, 1), 1)  # 1 if black


def optimal_weights(densities: np.ndarray, square: np.ndarray, iterations: int = 30) -> tuple:
    """Return the weights of three densities, ``(NODES, 3)``, that minimise E[f²/p], and that mean."""
    weights = np.full((densities.shape[1], 3), 1 / 3, densities.dtype)
    for _ in range(iterations):
        density = np.einsum("nk,kns->ns", weights, densities)
        gain = np.einsum("kns,ns->nk", densities, square / np.maximum(density, 1e-12) ** 2)
        weights = weights * np.sqrt(np.maximum(gain, 1e-30))
        weights /= weights.sum(axis=1, keepdims=True)
        weights[:, 0] = np.maximum(weights[:, 0], 0.02)  # every direction can be drawn
        weights /= weights.sum(axis=1, keepdims=True)
    density = np.einsum("nk,kns->ns", weights, densities)
    return weights, (square / np.maximum(density, 1e-12)).mean(axis=1)


class Mixture:
    """Mixture of a cosine and two lobes of visible GGX normals.

    ``weights`` is an array of three channels that is read at √cos θ_i.
    """

    def __init__(self, weights, lobes: tuple[SampledLobe, SampledLobe]):
        self.weights, self.lobes = weights, lobes

    def shares(self, wi, active=True) -> list:
        """Return the probabilities of cosine and lobes, which sum to 1."""
        values = [dr.maximum(v, 1e-3) for v in self.weights([dr.sqrt(dr.clip(wi.z, 0, 1))], active)]
        inverse = dr.rcp(values[0] + values[1] + values[2])
        return [v * inverse for v in values]

    def sample(self, wi, w, u, v, active=True):
        """Return directions ``wo`` from three uniform numbers each; some lie below the surface."""
        cosine, first, _ = self.shares(wi, active)
        is_first = w < cosine + first
        pairs = zip(*((lobe.alpha_u, lobe.alpha_v, lobe.gamma) for lobe in self.lobes), strict=True)
        alpha_u, alpha_v, gamma = (dr.select(is_first, type(w)(a), type(w)(b)) for a, b in pairs)
        diffuse = cosine_hemisphere(type(wi), u, v)
        if not all(lobe.is_ggx for lobe in self.lobes):
            v = shorten_tail(v, gamma)
        return dr.select(w < cosine, diffuse, sample_ggx(wi, alpha_u, alpha_v, u, v))

    def density(self, wi, wo, active=True):
        """Return the density of :meth:`sample` per solid angle, for directions above the surface."""
        cosine, *lobes = self.shares(wi, active)
        density = cosine * wo.z * dr.inv_pi
        for share, lobe in zip(lobes, self.lobes, strict=True):
            density = dr.fma(share, lobe.density(wi, wo), density)
        return density


class TurnedMixture:
    """Mixture, or source that samples itself, that is turned about the normal by ``angle``, radians."""

    def __init__(self, mixture, angle: float):
        self.mixture, self.angle = mixture, angle

    def sample(self, wi, w, u, v):
        """Return directions ``wo`` from three uniform numbers each; some lie below the surface."""
        return rotate(self.mixture.sample(rotate(wi, -self.angle), w, u, v), self.angle)

    def density(self, wi, wo):
        """Return the density of :meth:`sample` per solid angle, for directions above the surface."""
        return self.mixture.density(rotate(wi, -self.angle), rotate(wo, -self.angle))


def second_moment(truth, mixture: Mixture, types, cos: float, size: int = 2**16) -> float:
    """Return E[w²] / E[w]² of the weights w = f cos θ_o / p of samples at a cosine of ``wi``; f: the mean channel.

    It is 1 where f is black.
    """
    rng = dr.rng(seed=dr.opaque(types.UInt64, 11))
    wi = types.Array3f(dr.full(types.Float, (1 - cos**2) ** 0.5, size), 0, cos)
    s = outgoing(rng, types, wi, truth)
    with dr.suspend_grad():
        mean = sum(truth.value(s.wi, s.wo)) / 3
        density = mixture.density(s.wi, s.wo)
        square = dr.select(density > 0, s.weight * dr.square(mean) * dr.rcp(density), 0)
        first, second = dr.mean(s.weight * mean), dr.mean(square)
    return float((second / dr.square(first))[0]) if first[0] > 0 else 1.0
