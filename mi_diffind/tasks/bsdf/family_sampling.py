"""Importance sampling and energy of a family: the tables of :mod:`.mixture` and :mod:`.energy` over its parameters."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import drjit as dr
import numpy as np

from . import energy, mixture
from .family import SAMPLING_NODES, grid, interpolation, nodes_of, widths
from .family_truth import FamilyTruth, constants, points
from .measurement import cosine

#: Factors of the widths of the proxy's lobes that are tried for the lobes that sample.
FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0, 3.0)

#: Samples of an angle for a node's weights, and for its energy; angles between two entries of the scale of energy.
MIXTURE_SAMPLES, ENERGY_SAMPLES, ANGLES = 1024, 1024, 2

#: Members between nodes at which the energy is limited, for each node; corrections of all, and the last ones.
BETWEEN, SWEEPS, LAST = 3, 60, 20


def fitted_mixture(truth: FamilyTruth, member_at: Callable, types, isotropic: bool) -> tuple[tuple, np.ndarray]:
    """Return the factors of the widths of both lobes, and weights, ``(NODES, nodes of the parameters…, 3)``.

    ``member_at`` returns the member of the family at coordinates.
    """
    nodes = nodes_of(truth.parameters, SAMPLING_NODES)
    pairs = list(itertools.product(range(len(FACTORS)), repeat=2))
    costs, weights = np.zeros(len(pairs)), []
    for coordinates in grid(nodes):
        source, fitted = truth.at(coordinates), member_at(constants(types, coordinates))
        lobes = widths(fitted.proxy, fitted.scale)
        alphas = [dr.clip(types.Float(factor * w), 1e-3, 1) for w in lobes for factor in FACTORS]
        dr.eval(alphas)
        sampled = [mixture.SampledLobe(a, a) for a in alphas]
        densities, square = mixture.candidate_densities(source, types, isotropic, sampled, MIXTURE_SAMPLES, 3)
        tried = [
            mixture.optimal_weights(densities[[0, 1 + i, 1 + len(FACTORS) + j]], square) for i, j in pairs
        ]  # fmt: skip
        costs += [np.log(cost).mean() for _, cost in tried]
        weights.append([w for w, _ in tried])
    best = int(np.argmin(costs))
    table = np.stack([w[best] for w in weights], axis=1)
    return tuple(FACTORS[k] for k in pairs[best]), table.reshape(mixture.NODES, *nodes, 3)


def fitted_scale(truth: FamilyTruth, member_at: Callable, types, azimuths: tuple[float, ...]) -> np.ndarray:
    """Return the scale of energy, ``(energy.NODES, nodes of the parameters…, 1)``, of members without one.

    It limits the albedo of members at the nodes and between them. Where that of a member is too high, the nodes around
    it are lowered by the least change, of logarithms, that limits it; at the end all of them by the whole excess.
    """
    nodes = nodes_of(truth.parameters, SAMPLING_NODES)
    members = np.concatenate([grid(nodes), points(BETWEEN * math.prod(nodes), len(nodes), seed=21)])
    limits, corners = [], [interpolation(x, nodes) for x in members]
    for coordinates in members:
        value = cosine(member_at(constants(types, coordinates)))
        limits.append([energy_limit(value, truth.at(coordinates), types, azimuth) for azimuth in azimuths])
    scale = np.ones((math.prod(nodes), energy.NODES))
    for sweep in range(SWEEPS):
        is_low = True
        for limit, (index, weight) in zip(limits, corners, strict=True):
            factors = lowering(weight @ scale[index], limit)
            if factors is not None:
                is_low = False
                powers = weight / np.sum(weight**2) if sweep < SWEEPS - LAST else np.ones(len(weight))
                scale[index] *= factors ** powers[:, None]
        if is_low:
            break
    return scale.T.reshape(energy.NODES, *nodes, 1)


def energy_limit(value: Callable, source, types, azimuth: float) -> tuple[np.ndarray, np.ndarray]:
    """Return albedos of a function ``value(wi, wo)`` = f cos θ_o as a product, and those that are allowed.

    ``A``, ``(angles, energy.NODES, 3)``: the albedo at angle i under a scale s is s(θ_i) Σ_k A_ik s_k. Allowed are
    ``(angles, 3)``. Angles are those of the nodes, and :data:`ANGLES` - 1 between each two.
    """
    last = energy.NODES - 1
    fine = np.maximum(np.linspace(0, 1, last * ANGLES + 1) ** 2, 2e-3)
    cos, (exact, learned) = energy.contributions(
        [source.value, value], source, types, fine, azimuth, size=ENERGY_SAMPLES
    )
    position = np.sqrt(np.clip(cos, 0, 1)) * last
    lower = np.minimum(position.astype(int), last - 1)
    share, row = position - lower, np.arange(len(fine))[:, None] * energy.NODES
    products = np.empty((len(fine), energy.NODES, 3))
    for channel in range(3):
        x, total = learned[..., channel] / ENERGY_SAMPLES, len(fine) * energy.NODES
        low = np.bincount((row + lower).ravel(), ((1 - share) * x).ravel(), total)
        high = np.bincount((row + lower + 1).ravel(), (share * x).ravel(), total)
        products[..., channel] = (low + high).reshape(len(fine), energy.NODES)
    return products, energy.ALLOWED * exact.mean(axis=1, dtype=np.float64)


def lowering(column: np.ndarray, limits: list) -> np.ndarray | None:
    """Return the factors of a member's scale ``column``, ``(energy.NODES,)``, that limit its albedo, or ``None``."""
    at_angles = np.interp(np.linspace(0, 1, len(limits[0][1])), np.linspace(0, 1, energy.NODES), column)
    ratio = np.ones(len(at_angles))
    for products, allowed in limits:
        albedo = at_angles[:, None] * np.einsum("akc,k->ac", products, column)
        ratio = np.minimum(ratio, (allowed / np.maximum(albedo, 1e-9)).min(axis=1))
    if ratio.min() >= 1 - 1e-5:
        return None
    # Both directions are scaled: half of the excess (of its logarithm) is left to the other
    wide = np.concatenate([[1] * (ANGLES - 1), np.sqrt(ratio), [1] * (ANGLES - 1)])
    return np.array([wide[k * ANGLES : (k + 2) * ANGLES - 1].min() for k in range(energy.NODES)])
