"""Importance sampling of a learned BSDF: a mixture of a cosine and two lobes of visible GGX normals."""

from __future__ import annotations

import itertools

import drjit as dr
import numpy as np

from .pool import density_ggx, incident, outgoing, sample_ggx

#: Directions of incidence for which weights are stored, and samples of each that determine them.
NODES, SAMPLES = 16, 4096

#: Roughness of the lobes that are tried.
CANDIDATES = tuple(float(a) for a in np.geomspace(0.002, 1.0, 14))

#: Iterations of the weights of a mixture.
ITERATIONS = 30

#: Least weight of the cosine: every direction can be drawn.
FLOOR = 0.02


def coordinate(cos):
    """Return the coordinate in [0, 1] of the cosine of an angle in tables of directions: dense near the horizon."""
    return dr.sqrt(dr.clip(cos, 0, 1))


def cosines(nodes: int) -> np.ndarray:
    """Return the cosines of the nodes of a table; the first is slightly above the horizon."""
    return np.maximum(np.linspace(0, 1, nodes) ** 2, 2e-3)


def fitted_mixture(truth, types, isotropic: bool, seed: int = 3) -> tuple[tuple[float, float], np.ndarray]:
    """Return the roughness of both lobes, and the weights of cosine and lobes, ``(NODES, 3)``.

    They minimise the mean square of the weights f cos θ / p of a sample, whose lower bound is the squared albedo.
    Each node's weights sum to 1.
    """
    densities, square = candidate_densities(truth, types, isotropic, CANDIDATES, SAMPLES, seed)
    best = None
    for pair in itertools.combinations(range(len(CANDIDATES)), 2):
        weights, cost = optimal_weights(densities[[0, 1 + pair[0], 1 + pair[1]]], square)
        total = float(np.mean(np.log(cost)))
        if best is None or total < best[0]:
            best = total, pair, weights
    _, pair, weights = best
    return tuple(CANDIDATES[k] for k in pair), weights


def candidate_densities(truth, types, isotropic: bool, alphas, size: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return densities of the cosine and of lobes of roughness ``alphas``, ``(1 + K, NODES, size)``, and f²/density.

    The squares, of ``size`` samples of a source at each of :data:`NODES` cosines, have a mean of 1 at each.
    """
    rng = dr.rng(seed=dr.opaque(types.UInt64, seed))
    node = dr.arange(types.UInt32, NODES * size) // size
    cos = dr.gather(types.Float, types.Float(cosines(NODES).astype(np.float32)), node)
    sin = dr.sqrt(1 - dr.square(cos))
    azimuth = incident(rng, types, NODES * size, isotropic)
    r = dr.rsqrt(dr.maximum(dr.square(azimuth.x) + dr.square(azimuth.y), 1e-12))
    wi = types.Array3f(sin * azimuth.x * r, sin * azimuth.y * r, cos)
    s = outgoing(rng, types, wi, truth)
    with dr.suspend_grad():
        value = truth.value(s.wi, s.wo)
        mean = (value[0] + value[1] + value[2]) / 3
        lobes = [density_ggx(s.wi, s.wo, types.Float(a), types.Float(a)) for a in alphas]
        columns = [s.weight, mean, s.wo.z * dr.inv_pi, *lobes]
        dr.eval(columns)
    weight, mean, *densities = (np.asarray(c.numpy(), np.float64).reshape(NODES, size) for c in columns)
    square = weight * mean**2
    square /= np.maximum(square.mean(axis=1, keepdims=True), 1e-30)
    return np.stack(densities), square


def optimal_weights(densities: np.ndarray, square: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of three densities, ``(NODES, 3)``, that minimise E[f²/p], and that mean."""
    weights = np.full((densities.shape[1], 3), 1 / 3)
    for _ in range(ITERATIONS):
        density = np.einsum("nk,kns->ns", weights, densities)
        gain = np.einsum("kns,ns->nk", densities, square / np.maximum(density, 1e-12) ** 2)
        weights = weights * np.sqrt(np.maximum(gain, 1e-30))
        weights /= weights.sum(axis=1, keepdims=True)
        weights[:, 0] = np.maximum(weights[:, 0], FLOOR)
        weights /= weights.sum(axis=1, keepdims=True)
    density = np.einsum("nk,kns->ns", weights, densities)
    return weights, (square / np.maximum(density, 1e-12)).mean(axis=1)


class Mixture:
    """Mixture of a cosine and two lobes of visible GGX normals.

    ``weights`` is an array of three channels that is read at :func:`coordinate` of cos θ_i; ``alphas`` are the
    roughnesses of both lobes.
    """

    def __init__(self, weights, alphas: tuple[float, float]):
        self.weights, self.alphas = weights, alphas

    def shares(self, wi, active=True) -> list:
        """Return the probabilities of cosine and lobes, which sum to 1."""
        values = [dr.maximum(v, 1e-3) for v in self.weights([coordinate(wi.z)], active)]
        inverse = dr.rcp(values[0] + values[1] + values[2])
        return [v * inverse for v in values]

    def sample(self, wi, w, u, v, active=True):
        """Return directions ``wo`` from three uniform numbers each; some lie below the surface."""
        cosine, first, _ = self.shares(wi, active)
        Float = type(w)
        alpha = dr.select(w < cosine + first, Float(self.alphas[0]), Float(self.alphas[1]))
        r, (sin, cos) = dr.sqrt(u), dr.sincos(2 * dr.pi * v)
        diffuse = type(wi)(r * cos, r * sin, dr.sqrt(dr.maximum(1 - u, 0)))
        return dr.select(w < cosine, diffuse, sample_ggx(wi, alpha, alpha, u, v))

    def density(self, wi, wo, active=True):
        """Return the density of :meth:`sample` per solid angle, for directions above the surface."""
        cosine, *lobes = self.shares(wi, active)
        Float, density = type(cosine), cosine * wo.z * dr.inv_pi
        for share, alpha in zip(lobes, self.alphas, strict=True):
            density = dr.fma(share, density_ggx(wi, wo, Float(alpha), Float(alpha)), density)
        return density


def second_moment(truth_value, mixture: Mixture, truth, types, cos: float, size: int = 2**16, seed: int = 11) -> float:
    """Return E[w²] / E[w]² of the weights w = f cos θ_o / p of samples at a cosine of ``wi``; f: the mean channel."""
    rng = dr.rng(seed=dr.opaque(types.UInt64, seed))
    wi = types.Array3f(dr.full(types.Float, (1 - cos**2) ** 0.5, size), 0, cos)
    s = outgoing(rng, types, wi, truth)
    with dr.suspend_grad():
        mean = sum(truth_value(s.wi, s.wo)) / 3
        density = mixture.density(s.wi, s.wo)
        square = dr.select(density > 0, s.weight * dr.square(mean) * dr.rcp(density), 0)
        first, second = dr.mean(s.weight * mean), dr.mean(square)
    return float((second / dr.square(first))[0])
