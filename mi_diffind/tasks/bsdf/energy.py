"""Albedo of a learned BSDF, or of a family, limited by that of its source without a loss of reciprocity."""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr
import numpy as np

from .directions import outgoing
from .model import SAMPLING_NODES, grid, interpolation, opaque_numbers, points, table_nodes

#: Albedo that a learned BSDF may have, relative to the source's; less than 1.001 at the nodes and between them.
ALLOWED = 1.0005

#: Albedo of a channel, relative to that of the brightest one, which is allowed in any case.
DARK = 1e-3

#: Entries of the scale.
NODES = 32

#: Angles at which albedos are computed, for each entry.
ANGLES = 4

#: Samples of an angle.
SAMPLES = 2**15

#: Corrections of the scale; each takes the square root of the excess, since both directions are scaled.
CORRECTIONS = 40

#: Of families: angles for each entry, and samples of an angle.
MEMBER_ANGLES = 2
MEMBER_SAMPLES = 1024

#: Members between nodes of the parameters at which the albedo is limited, for each node.
BETWEEN = 3

#: Corrections of all members of a family.
SWEEPS = 60


class KroneckerSequence:
    """Low-discrepancy numbers in the place of a random generator: each call returns one of four dimensions.

    With 2¹³ numbers, errors of albedos are a fifth of those of random numbers.
    """

    #: Root of x⁵ = x + 1, whose powers give the steps of four dimensions.
    ROOT = 1.1673039782614187

    def __init__(self, size: int):
        self.size, self.dimension = size, 0

    def random(self, Float: type, lanes: int):
        """Return the next dimension: numbers in [0, 1), the same for each run of ``size`` lanes."""
        self.dimension += 1
        step = int((self.ROOT**-self.dimension % 1) * 2**32)
        index = dr.arange(dr.uint32_array_t(Float), lanes) % self.size
        return Float((index * step + 2**31) >> 8) * 2.0**-24


def contributions(values: list, truth, types, cos: np.ndarray, azimuth: float = 0.0, size: int = SAMPLES):
    """Return the contributions of samples to the albedos of functions ``value(wi, wo)`` = f cos θ_o.

    ``cos``: cosines of ``wi``. Returns the cosines of ``wo``, ``(len(cos), size)``, and for each function an array
    ``(len(cos), size, 3)``, of the same samples, whose mean over the samples is the albedo.
    """
    count = len(cos)
    lane = dr.arange(types.UInt32, count * size) // size
    z = dr.gather(types.Float, types.Float(np.ascontiguousarray(cos, np.float32)), lane)
    sin = dr.sqrt(1 - dr.square(z))
    wi = types.Array3f(sin * float(np.cos(azimuth)), sin * float(np.sin(azimuth)), z)
    samples = outgoing(KroneckerSequence(size), types, wi, truth)
    result = []
    with dr.suspend_grad():
        for value in values:
            channels = [samples.weight * v for v in value(samples.wi, samples.wo)]
            dr.eval(channels)
            result.append(np.stack([c.numpy().reshape(count, size) for c in channels], axis=-1))
    return samples.wo.z.numpy().reshape(count, size), result


def albedos(values: list, truth, types, cos: np.ndarray, azimuth: float = 0.0, size: int = SAMPLES) -> np.ndarray:
    """Return the directional albedos of functions ``value(wi, wo)`` = f cos θ_o, from the same samples.

    ``cos``: cosines of ``wi``; the result has the shape ``(len(values), len(cos), 3)``.
    """
    _, parts = contributions(values, truth, types, cos, azimuth, size)
    return np.stack([part.mean(axis=1, dtype=np.float64) for part in parts])


def fit_scale(value, truth, types, azimuths: tuple[float, ...] = (0.0,)) -> np.ndarray:
    """Return s(θ) ≤ 1 at :data:`NODES` cosines, so that s(θ_i) s(θ_o) f has at most the source's albedo + 0.1%.

    ``value`` is f cos θ_o of the learned BSDF. s starts at 1; where the albedo is too high in a channel, the nodes next
    to the angle are lowered, until no angle is left.
    """
    limits = [energy_limit(value, truth, types, azimuth, ANGLES, SAMPLES) for azimuth in azimuths]
    scale = np.ones(NODES)
    for k in range(CORRECTIONS):
        factors = lowering(scale, limits, half=k < CORRECTIONS // 2)
        if factors is None:
            break
        scale *= factors
    return scale


def fit_family_scale(truth, member_at: Callable, types, azimuths: tuple[float, ...]) -> np.ndarray:
    """Return the scale s of a family, ``(NODES, nodes of the parameters…, 1)``, for members without one.

    It limits the albedo of members at the nodes and between them. Where that of a member is too high, the nodes around
    it are lowered by the least change, of logarithms, that limits it; at the end all of them by the whole excess.
    """
    nodes = table_nodes(truth.parameters, SAMPLING_NODES)
    members = np.concatenate([grid(nodes), points(BETWEEN * math.prod(nodes), len(nodes), seed=21)])
    limits, corners = [], [interpolation(x, nodes) for x in members]
    for coordinates in members:
        value = member_at(opaque_numbers(types, coordinates)).cosine_value
        limits.append([energy_limit(value, truth.at(coordinates), types, azimuth) for azimuth in azimuths])
    scale = np.ones((math.prod(nodes), NODES))
    for sweep in range(SWEEPS):
        is_low = True
        for limit, (index, weight) in zip(limits, corners, strict=True):
            factors = lowering(weight @ scale[index], limit)
            if factors is not None:
                is_low = False
                powers = weight / np.sum(weight**2) if sweep < SWEEPS - 20 else np.ones(len(weight))
                scale[index] *= factors ** powers[:, None]
        if is_low:
            break
    return scale.T.reshape(NODES, *nodes, 1)


def energy_limit(
    value: Callable, source, types, azimuth: float, angles: int = MEMBER_ANGLES, size: int = MEMBER_SAMPLES
) -> tuple[np.ndarray, np.ndarray]:
    """Return albedos of a function ``value(wi, wo)`` = f cos θ_o as a product, and those that are allowed.

    ``A``, ``(angles, NODES, 3)``: the albedo at angle i under a scale s is s(θ_i) Σ_k A_ik s_k. Allowed are
    ``(angles, 3)``: the source's, at most 1. A black channel may reach :data:`DARK` of the brightest one: no factor
    lowers it without the others. Angles are those of the nodes, and ``angles`` - 1 between each two.
    """
    last = NODES - 1
    fine = np.maximum(np.linspace(0, 1, last * angles + 1) ** 2, 2e-3)
    cos, (exact, learned) = contributions([source.value, value], source, types, fine, azimuth, size)
    position = np.sqrt(np.clip(cos, 0, 1)) * last
    lower = np.minimum(position.astype(int), last - 1)
    share, row = position - lower, np.arange(len(fine))[:, None] * NODES
    products = np.empty((len(fine), NODES, 3))
    for channel in range(3):
        x, total = learned[..., channel] / size, len(fine) * NODES
        low = np.bincount((row + lower).ravel(), ((1 - share) * x).ravel(), total)
        high = np.bincount((row + lower + 1).ravel(), (share * x).ravel(), total)
        products[..., channel] = (low + high).reshape(len(fine), NODES)
    albedo = np.minimum(exact.mean(axis=1, dtype=np.float64), 1)
    return products, np.maximum(ALLOWED * albedo, DARK * albedo.max(axis=1, keepdims=True))


def lowering(column: np.ndarray, limits: list, half: bool = True) -> np.ndarray | None:
    """Return the factors of a scale ``column``, ``(NODES,)``, that limit the albedo, or ``None``.

    ``half``: of an excess (of its logarithm), half is left to the scale of the other direction.
    """
    count = len(limits[0][1])
    angles = (count - 1) // (NODES - 1)
    at_angles = np.interp(np.linspace(0, 1, count), np.linspace(0, 1, NODES), column)
    ratio = np.ones(count)
    for products, allowed in limits:
        albedo = at_angles[:, None] * np.einsum("akc,k->ac", products, column)
        ratio = np.minimum(ratio, (allowed / np.maximum(albedo, 1e-9)).min(axis=1))
    if ratio.min() >= 1 - 1e-5:
        return None
    beside = [1] * (angles - 1)
    wide = np.concatenate([beside, np.sqrt(ratio) if half else ratio, beside])
    return np.array([wide[k * angles : (k + 2) * angles - 1].min() for k in range(NODES)])
