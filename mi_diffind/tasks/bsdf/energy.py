"""Albedo of a learned BSDF, limited by that of its source without a loss of reciprocity."""

from __future__ import annotations

import drjit as dr
import numpy as np

from .pool import outgoing

#: Albedo that a learned BSDF may have, relative to the source's; less than 1.001 at the nodes and between them.
ALLOWED = 1.0005

#: Albedo of a channel, relative to that of the brightest one, which is allowed in any case.
DARK = 1e-3

#: Entries of the scale, angles at which albedos are computed for each, and samples of an angle.
NODES, ANGLES, SAMPLES = 32, 4, 8192


#: Corrections of the scale; each takes the square root of the excess, since both directions are scaled.
CORRECTIONS = 40


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


def fitted_scale(value, truth, types, azimuths: tuple[float, ...] = (0.0,)) -> np.ndarray:
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
