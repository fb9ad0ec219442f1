"""Symmetries of a BSDF, measured before they are assumed."""

from __future__ import annotations

import drjit as dr

from .pool import incident, outgoing

#: Relative difference up to which a symmetry is assumed.
TOLERANCE = 0.01


def measured_symmetry(truth, types, size: int = 2**16, seed: int = 1) -> dict[str, float]:
    """Return the relative difference of f that each symmetry would hide.

    ``isotropy``: rotation about the normal; ``mirror``: reflection at the plane of incidence; ``reciprocity``: exchange
    of the directions. Each is a mean of absolute differences over the mean value, weighted by both cosines. At angles
    up to 85°; 0 for what the format implies.
    """
    rng = dr.rng(seed=dr.opaque(types.UInt64, seed))
    samples = outgoing(rng, types, incident(rng, types, size, isotropic=False), truth)
    wi, wo = samples.wi, samples.wo
    weight = dr.select(dr.minimum(wi.z, wo.z) > 0.087, samples.weight, 0)
    sin, cos = dr.sincos(2 * dr.pi * rng.random(types.Float, size))

    def turned(w):
        return types.Array3f(dr.fma(cos, w.x, -sin * w.y), dr.fma(sin, w.x, cos * w.y), w.z)

    def mirrored(w):  # at the plane of wi and the normal
        r2 = dr.maximum(dr.square(wi.x) + dr.square(wi.y), 1e-12)
        along, across = (w.x * wi.x + w.y * wi.y) / r2, (w.y * wi.x - w.x * wi.y) / r2
        return types.Array3f(along * wi.x + across * wi.y, along * wi.y - across * wi.x, w.z)

    value = truth.value(wi, wo)
    others = {
        "isotropy": truth.value(turned(wi), turned(wo)),
        "mirror": truth.value(wi, mirrored(wo)),
        "reciprocity": [v * wo.z / wi.z for v in truth.value(wo, wi)],
    }
    total = sum(dr.sum(weight * wi.z * v) for v in value)
    result = {}
    for name, other in others.items():
        difference = sum(dr.sum(weight * wi.z * dr.abs(a - b)) for a, b in zip(value, other, strict=True))
        result[name] = float((difference / dr.maximum(total, 1e-20))[0])
    if truth.isotropic:
        result["isotropy"] = 0.0
    return result
