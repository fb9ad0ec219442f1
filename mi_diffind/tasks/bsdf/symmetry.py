"""Symmetries of a BSDF, measured before they are assumed."""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from .model import turned
from .pool import Samples, incident, outgoing
from .source import Truth

#: Relative difference up to which a symmetry is assumed.
TOLERANCE = 0.01

#: Azimuth of the axes of a source below which they count as those of the surface, radians.
TURN = math.radians(0.5)

#: Quantile above which contributions of measured rows count the same in the azimuth of the axes.
BRIGHT = 0.999

#: Difference of the azimuths from two halves of the samples beyond which neither counts, and samples that are used.
APART, TURNED = math.radians(4), 2**18


def axes_angle(samples: Samples, truth: Truth) -> float:
    """Return the azimuth of the axes of an anisotropic source, radians from −π/4 to π/4.

    They are the principal axes of the half vectors, weighted by the squares of contributions, most of which lie in the
    peak. Of a function, four turned values of each sample are used, so that what is isotropic cancels. The result is 0
    if it is below :data:`TURN`, or if halves of the samples disagree.
    """
    index = dr.arange(dr.uint32_array_t(type(samples.weight)), min(TURNED, dr.width(samples.weight)))
    samples, moments = samples.at(index), 0
    half = samples.wi + samples.wo
    half = half * dr.rsqrt(dr.maximum(dr.squared_norm(half), 1e-20))
    for k in range(4 if truth.function else 1):
        angle = k * math.pi / 4
        value = truth.value(turned(samples.wi, angle), turned(samples.wo, angle)) if k else samples.value
        light, h = samples.weight * dr.square(value[0] + value[1] + value[2]), turned(half, angle)
        if not truth.function:  # rows may be outliers
            light = dr.minimum(light, float(np.quantile(light.numpy(), BRIGHT)))
        columns = [light * (dr.square(h.x) - dr.square(h.y)), 2 * light * h.x * h.y]
        moments = moments + np.stack([dr.detach(c).numpy() for c in columns]).astype(np.float64)
    angles = [0.5 * math.atan2(*part.sum(axis=1)[::-1]) for part in (moments, moments[:, ::2], moments[:, 1::2])]
    apart = (angles[1] - angles[2] + math.pi / 2) % math.pi - math.pi / 2
    angle = angles[0] - round(angles[0] / (math.pi / 2)) * (math.pi / 2)
    return angle if abs(angle) > TURN and abs(apart) < APART else 0.0


def measured_symmetry(truth, types, size: int = 2**16, seed: int = 1) -> dict[str, float]:
    """Return the relative difference of f that each symmetry would hide.

    ``isotropy``: rotation about the normal; ``mirror``: reflection at the plane of incidence; ``reciprocity``: exchange
    of the directions. Each is a mean of absolute differences over the mean value, weighted by both cosines; that of
    reciprocity is halved, which no reciprocal model can be nearer than. At angles up to 85°; 0 for what the format
    implies.
    """
    rng = dr.rng(seed=dr.opaque(types.UInt64, seed))
    samples = outgoing(rng, types, incident(rng, types, size, isotropic=False), truth)
    wi, wo = samples.wi, samples.wo
    weight = dr.select(dr.minimum(wi.z, wo.z) > 0.087, samples.weight, 0)
    sin, cos = dr.sincos(2 * dr.pi * rng.random(types.Float, size))

    def rotated(w):
        return types.Array3f(dr.fma(cos, w.x, -sin * w.y), dr.fma(sin, w.x, cos * w.y), w.z)

    def mirrored(w):  # at the plane of wi and the normal
        r2 = dr.maximum(dr.square(wi.x) + dr.square(wi.y), 1e-12)
        along, across = (w.x * wi.x + w.y * wi.y) / r2, (w.y * wi.x - w.x * wi.y) / r2
        return types.Array3f(along * wi.x + across * wi.y, along * wi.y - across * wi.x, w.z)

    value = truth.value(wi, wo)
    others = {
        "isotropy": truth.value(rotated(wi), rotated(wo)),
        "mirror": truth.value(wi, mirrored(wo)),
        "reciprocity": [v * wo.z / wi.z for v in truth.value(wo, wi)],
    }
    total = sum(dr.sum(weight * wi.z * v) for v in value)
    result = {}
    for name, other in others.items():
        difference = sum(dr.sum(weight * wi.z * dr.abs(a - b)) for a, b in zip(value, other, strict=True))
        result[name] = float((difference / dr.maximum(total, 1e-20))[0])
    result["reciprocity"] /= 2
    if truth.isotropic:
        result["isotropy"] = 0.0
    return result
