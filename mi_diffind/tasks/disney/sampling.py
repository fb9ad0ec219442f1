"""
Importance sampling of the Disney BRDF: which lobe, and with which density.

The density has to be normalised exactly even where the tables are approximate, so it is always computed from the
analytic distributions: a cosine for diffuse and sheen, visible normals (Heitz 2018) for the specular lobe, GTR1 half
vectors for the clearcoat. Written with :func:`.model.masking_denominator`, the density of visible normals mapped to
directions is just ``D / (2 d(wi))``: no cosine is divided by.

Same frame and conventions as :mod:`.model`.
"""

from __future__ import annotations

import drjit as dr

from . import model
from .model import COAT_F0, LOBES, SPECULAR_SCALE, TINY, Material

#: Share that a lobe gets however little energy is estimated for it, so that no lobe is left to another's sampling.
FLOOR = 0.02


def lobe_probabilities(m: Material, luminance, cos_i, rates: dict[str, float]) -> dict:
    """
    The probability of sampling each lobe, proportional to an estimate of its albedo for the direction ``wi``.

    ``rates`` multiplies each lobe's share; 0 turns a lobe off. The specular lobe is never without a chance unless it
    is turned off; if all are, every probability is 0.
    """
    s = model.schlick(cos_i)
    f0 = luminance * m.metallic + (1 - m.metallic) * SPECULAR_SCALE * m.specular
    share = {
        "diffuse": (1 - m.metallic) * (luminance + m.sheen * (0.05 + 0.4 * s)),
        "specular": FLOOR + f0 + (1 - f0) * s,
        "clearcoat": m.clearcoat * (FLOOR + (COAT_F0 + (1 - COAT_F0) * s) * (0.1 + 0.9 * dr.square(cos_i))),
    }
    share = {name: rates[name] * dr.maximum(share[name], 0) for name in LOBES}
    norm = dr.rcp(dr.maximum(sum(share.values()), TINY))
    return {name: share[name] * norm for name in LOBES}


def density(m: Material, probabilities: dict, wi, wo):
    """Density of ``wo`` per solid angle when lobes are chosen with ``probabilities``."""
    g = model.geometry(wi, wo)
    ax, ay = model.roughness_to_alpha(m.roughness, m.anisotropic)
    specular = model.ggx(g, ax, ay) / (2 * model.masking_denominator(wi, ax, ay))
    coat = model.gtr1(g, model.coat_alpha(m.clearcoat_gloss)) * g.h.z / (2 * g.h2 + TINY)
    return (
        probabilities["diffuse"] * wo.z * dr.inv_pi
        + probabilities["specular"] * specular
        + probabilities["clearcoat"] * coat
    )


def sample_gtr1(gloss, sample):
    """A half vector with density ``GTR1(h) · h.z`` (Burley 2012, appendix B.2); ``sample`` uniform in [0, 1)²."""
    a2 = dr.square(model.coat_alpha(gloss))
    # The published form gives cos², from which sin² = 1 − cos² would cancel next to the peak
    sin2 = dr.clip(a2 * (dr.exp(-sample.y * dr.log(a2)) - 1) / (1 - a2), 0, 1)
    sin, cos = dr.sqrt(sin2), dr.sqrt(1 - sin2)
    sin_phi, cos_phi = dr.sincos(2 * dr.pi * sample.x)
    return cos_phi * sin, sin_phi * sin, cos
