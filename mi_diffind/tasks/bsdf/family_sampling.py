"""Importance sampling and energy of a family: the tables of :mod:`.mixture` and :mod:`.energy` over its parameters."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import drjit as dr
import numpy as np

from ...indirection import device_array
from . import energy, mixture
from .family import SAMPLING_NODES, FamilyMember, grid, nodes_of, widths
from .family_truth import FamilyTruth, constants, points
from .measurement import cosine

#: Factors of the widths of the proxy's lobes that are tried for the lobes that sample.
FACTORS = (0.5, 0.7, 1.0, 1.4, 2.0, 3.0)

#: Samples of an angle for a node's weights, and for its energy; angles between two entries of the scale of energy.
MIXTURE_SAMPLES, ENERGY_SAMPLES, ANGLES = 1024, 2048, 2

#: Members between nodes at which the energy is limited, for each node.
BETWEEN = 3


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

    It is that of :func:`.energy.fitted_scale` at each node; members between nodes then lower the nodes around them.
    """
    nodes = nodes_of(truth.parameters, SAMPLING_NODES)
    scale = np.ones((energy.NODES, *nodes))

    def fitted(coordinates) -> np.ndarray:
        source, bsdf = truth.at(coordinates), member_at(constants(types, coordinates))
        column = device_array(types.Float, interpolated(scale, coordinates))

        def factor(x, active=True):
            position = x[0] * (energy.NODES - 1)
            lower = dr.minimum(dr.uint32_array_t(position)(position), energy.NODES - 2)
            low, high = (dr.gather(types.Float, column, lower + k) for k in (0, 1))
            return [dr.lerp(low, high, position - lower)]

        bsdf = FamilyMember(bsdf.form, bsdf.residual, bsdf.proxy, factor, bsdf.scale)

        return energy.fitted_scale(cosine(bsdf), source, types, azimuths, ANGLES, ENERGY_SAMPLES)

    for index, coordinates in zip(np.ndindex(nodes), grid(nodes), strict=True):
        scale[(slice(None), *index)] *= fitted(coordinates)
    for coordinates in points(BETWEEN * math.prod(nodes), len(nodes), seed=21):
        lowered = fitted(coordinates)
        positions = coordinates * (np.array(nodes) - 1)
        cell = [np.unique([math.floor(x), math.ceil(x)]) for x in positions]
        scale[(slice(None), *np.ix_(*cell))] *= lowered.reshape(-1, *([1] * len(nodes)))
    return scale[..., None]


def interpolated(table: np.ndarray, coordinates) -> np.ndarray:
    """Return the column of a table over the cosine and the parameters at coordinates, ``(energy.NODES,)``."""
    for x in reversed(list(coordinates)):
        position = float(x) * (table.shape[-1] - 1)
        lower = min(int(position), table.shape[-1] - 2)
        table = table[..., lower] + (position - lower) * (table[..., lower + 1] - table[..., lower])
    return table
