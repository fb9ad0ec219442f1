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
SAMPLES = 8192

#: Corrections of the scale; each takes the square root of the excess, since both directions are scaled.
CORRECTIONS = 40

#: Of families: angles for each entry, and samples of an angle.
MEMBER_ANGLES = 2
MEMBER_SAMPLES = 1024

#: Members between nodes of the parameters at which the albedo is limited, for each node.
BETWEEN = 3

#: Corrections of all members of a family.
SWEEPS = 60


def contributions(
    values: list, truth, types, cos: np.ndarray, azimuth: float = 0.0, seed: int = 5, size: int = SAMPLES
):
    """Return the contributions of samples to the albedos of functions ``value(wi, wo)`` = f cos θ_o.

    ``cos``: cosines of ``wi``. Returns the cosines of ``wo``, ``(len(cos), size)``, and for each function an array
    ``(len(cos), size, 3)``, of the same samples, whose mean over the samples is the albedo.
    """
    count = len(cos)
    lane = dr.arange(types.UInt32, count * size) // size
    z = dr.gather(types.Float, types.Float(np.ascontiguousarray(cos, np.float32)), lane)
    sin = dr.sqrt(1 - dr.square(z))
    wi = types.Array3f(sin * float(np.cos(azimuth)), sin * float(np.sin(azimuth)), z)
    samples = outgoing(dr.rng(seed=dr.opaque(types.UInt64, seed)), types, wi, truth)
    result = []
    with dr.suspend_grad():
        for value in values:
            channels = [samples.weight * v for v in value(samples.wi, samples.wo)]
            dr.eval(channels)
            result.append(np.stack([c.numpy().reshape(count, size) for c in channels], axis=-1))
    return samples.wo.z.numpy().reshape(count, size), result


def albedos(
    values: list, truth, types, cos: np.ndarray, azimuth: float = 0.0, seed: int = 5, size: int = SAMPLES
) -> np.ndarray:
    """Return the directional albedos of functions ``value(wi, wo)`` = f cos θ_o, from the same samples.

    ``cos``: cosines of ``wi``; the result has the shape ``(len(values), len(cos), 3)``.
    """
    _, parts = contributions(values, truth, types, cos, azimuth, seed, size)
    return np.stack([part.mean(axis=1, dtype=np.float64) for part in parts])


def fit_scale(value, truth, types, azimuths: tuple[float, ...] = (0.0,)) -> np.ndarray:
    """Return s(θ) ≤ 1 at :data:`NODES` cosines, so that s(θ_i) s(θ_o) f has at most the source's albedo + 0.1%.

    ``value`` is f cos θ_o of the learned BSDF. s starts at 1; where the albedo is too high in a channel, the nodes next
    to the angle are lowered, until no angle is left. A black channel may reach :data:`DARK` of the brightest one: no
    factor lowers it without the others.
    """
    fine = np.maximum(np.linspace(0, 1, (NODES - 1) * ANGLES + 1) ** 2, 2e-3)
    position, nodes = np.sqrt(fine), np.linspace(0, 1, NODES)
    parts = []
    for azimuth in azimuths:
        cos, (source, learned) = contributions([truth.value, value], truth, types, fine, azimuth)
        albedo = source.mean(axis=1, dtype=np.float64)
        allowed = np.maximum(ALLOWED * albedo, DARK * albedo.max(axis=1, keepdims=True))
        parts.append((np.sqrt(np.clip(cos, 0, 1)), allowed, learned))
    scale = np.ones(NODES)
    for k in range(CORRECTIONS):
        ratio = np.ones(len(fine))
        for outgoing_position, allowed, learned in parts:
            factors = np.interp(outgoing_position, nodes, scale)[..., None]
            albedo = np.interp(position, nodes, scale)[:, None] * (factors * learned).mean(axis=1)
            ratio = np.minimum(ratio, (allowed / np.maximum(albedo, 1e-9)).min(axis=1))
        if ratio.min() >= 1 - 1e-5:
            break
        lowered = np.sqrt(ratio) if k < CORRECTIONS // 2 else ratio
        for node in range(NODES):
            near = slice(max(0, (node - 1) * ANGLES + 1), (node + 1) * ANGLES)
            scale[node] *= lowered[near].min()
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


def energy_limit(value: Callable, source, types, azimuth: float) -> tuple[np.ndarray, np.ndarray]:
    """Return albedos of a function ``value(wi, wo)`` = f cos θ_o as a product, and those that are allowed.

    ``A``, ``(angles, NODES, 3)``: the albedo at angle i under a scale s is s(θ_i) Σ_k A_ik s_k. Allowed are
    ``(angles, 3)``. Angles are those of the nodes, and :data:`MEMBER_ANGLES` - 1 between each two.
    """
    last = NODES - 1
    fine = np.maximum(np.linspace(0, 1, last * MEMBER_ANGLES + 1) ** 2, 2e-3)
    cos, (exact, learned) = contributions([source.value, value], source, types, fine, azimuth, size=MEMBER_SAMPLES)
    position = np.sqrt(np.clip(cos, 0, 1)) * last
    lower = np.minimum(position.astype(int), last - 1)
    share, row = position - lower, np.arange(len(fine))[:, None] * NODES
    products = np.empty((len(fine), NODES, 3))
    for channel in range(3):
        x, total = learned[..., channel] / MEMBER_SAMPLES, len(fine) * NODES
        low = np.bincount((row + lower).ravel(), ((1 - share) * x).ravel(), total)
        high = np.bincount((row + lower + 1).ravel(), (share * x).ravel(), total)
        products[..., channel] = (low + high).reshape(len(fine), NODES)
    return products, ALLOWED * exact.mean(axis=1, dtype=np.float64)


def lowering(column: np.ndarray, limits: list) -> np.ndarray | None:
    """Return the factors of a member's scale ``column``, ``(NODES,)``, that limit its albedo, or ``None``."""
    at_angles = np.interp(np.linspace(0, 1, len(limits[0][1])), np.linspace(0, 1, NODES), column)
    ratio = np.ones(len(at_angles))
    for products, allowed in limits:
        albedo = at_angles[:, None] * np.einsum("akc,k->ac", products, column)
        ratio = np.minimum(ratio, (allowed / np.maximum(albedo, 1e-9)).min(axis=1))
    if ratio.min() >= 1 - 1e-5:
        return None
    # Both directions are scaled: half of the excess (of its logarithm) is left to the other
    wide = np.concatenate([[1] * (MEMBER_ANGLES - 1), np.sqrt(ratio), [1] * (MEMBER_ANGLES - 1)])
    return np.array([wide[k * MEMBER_ANGLES : (k + 2) * MEMBER_ANGLES - 1].min() for k in range(NODES)])
