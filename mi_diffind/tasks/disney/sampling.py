"""Importance sampling of the Disney BRDF: choice of a lobe, directions and their density.

The density has to be normalised exactly even where tables are approximate, so it is always computed from the analytic
distributions: a cosine for diffuse and sheen, visible normals (Heitz 2018) for the specular lobe, GTR1 half vectors for
the clearcoat. Written with :func:`.model.masking_denominator`, the density of visible normals mapped to directions is
just ``D / (2 d(wi))``: no cosine is divided by.

Same frame and conventions as :mod:`.model`; ``c`` are coefficients of :class:`.decoder.Decoder` (``ggx``, ``coat`` and
``shares``), ``e`` the effects in use.
"""

import drjit as dr

from .decoder import coat_quadric, masking, quadric
from .model import COAT_F0, TINY, Effects, geometry, schlick

#: Least share of a lobe, however low its estimated energy: without it, only other lobes would sample its directions.
FLOOR = 0.02


def required(e: Effects) -> tuple[str, ...]:
    """Return the groups of coefficients that densities need when the effects ``e`` are in use."""
    return ("ggx", *(("coat",) if e.clearcoat else ()), *(("shares",) if len(e.lobes) > 1 else ()))


def lobe_probabilities(c: dict, e: Effects, cos_i, rates: dict) -> dict:
    """Return the probability of sampling each lobe, proportional to an estimate of its albedo for the direction ``wi``.

    ``rates`` maps lobes to factors on their shares; a lobe that it lacks is turned off. The specular lobe has a
    positive probability unless it is turned off.
    """
    lobes = [lobe for lobe in e.lobes if lobe in rates]
    if len(e.lobes) == 1:
        return {lobe: dr.select(rates[lobe] > 0, type(cos_i)(1), 0) for lobe in lobes}
    shares, s = c["shares"], schlick(cos_i)
    share = {}
    for lobe in lobes:
        if lobe == "diffuse":
            energy = shares["diffuse"]
            if e.sheen:
                energy = dr.fma(shares["sheen"], 0.05 + 0.4 * s, energy)
        elif lobe == "specular":
            energy = FLOOR + shares["f0"] + (1 - shares["f0"]) * s
        else:
            energy = shares["clearcoat"] * (FLOOR + (COAT_F0 + (1 - COAT_F0) * s) * (0.1 + 0.9 * dr.square(cos_i)))
        share[lobe] = rates[lobe] * dr.maximum(energy, 0)
    norm = dr.rcp(dr.maximum(sum(share.values()), TINY))
    return {lobe: share[lobe] * norm for lobe in lobes}


def density(c: dict, e: Effects, probabilities: dict, wi, wo):
    """Return the density of ``wo`` per solid angle when lobes are chosen with ``probabilities``."""
    g = geometry(wi, wo)
    pdf = 0
    if "diffuse" in probabilities:
        pdf = probabilities["diffuse"] * (wo.z * dr.inv_pi)
    if "specular" in probabilities:
        d = dr.square(g.h2 / (quadric(c["ggx"]["q"], g) + TINY))
        pdf = probabilities["specular"] * d / (2 * masking(c["ggx"]["alpha2"], wi)) + pdf
    if "clearcoat" in probabilities:
        coat = c["coat"]["norm"] * g.h.z / (2 * coat_quadric(c["coat"]["a2"], g))
        pdf = probabilities["clearcoat"] * coat + pdf
    return pdf


def sample_gtr1(a2, log_a2, sample):
    """Return a half vector with density ``GTR1(h) · h.z`` (Burley 2012, appendix B.2).

    ``a2`` and ``log_a2`` are α² and its logarithm, ``sample`` is uniform in [0, 1)².
    """
    # The published form gives cos², from which sin² = 1 − cos² would cancel next to the peak
    sin2 = dr.clip(a2 * (dr.exp(-sample.y * log_a2) - 1) / (1 - a2), 0, 1)
    sin, cos = dr.sqrt(sin2), dr.sqrt(1 - sin2)
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * sample.x)
    return cos_phi * sin, sin_phi * sin, cos
