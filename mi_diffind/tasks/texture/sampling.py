"""Footprints: pixel sizes in units of the texture, and the distributions that the paper's training draws them from.

The supplement's section "Sampling LODs" draws footprints x as powers of a uniform number, so that a fraction p = 0.5 of
them lies below t = 1 / N_base, where N_base is the side of the texture in texels (equations 3 to 6). It also describes
an exponential distribution and rejects it (equations 7 to 9).

The supplement contradicts itself about the unit of x: it calls the footprint the magnitude of a cross product, which is
an area, but the threshold 1 / N_base is the *side* of a texel (the area is 1 / N_base²). Here x is a side. Footprints 0
and 1 belong to the most and the least detailed level.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

#: Distributions that footprints are drawn from.
FOOTPRINTS = ("power", "exponential")

#: Fraction p of the samples below the threshold t.
FRACTION = 0.5


def threshold(base: int) -> float:
    """Return ``t = 1 / N_base`` for the side of a texture in texels; half of [0, 1] for a side of 1."""
    return 1 / max(2, base)


def exponent(t: float) -> float:
    """Return ``n = log_p(t)``, for which a fraction p of all ``u^n`` lies below ``t`` (equation 6)."""
    return math.log(t) / math.log(FRACTION)


def exponential_rate(t: float) -> float:
    """Return ``λ_e = −ln(1 − p) / t``, for which a fraction p of all samples lies below ``t`` (equation 9)."""
    return -math.log1p(-FRACTION) / t


def footprints(u, distribution: str, base: int):
    """Draw footprints in [0, 1] for a texture of side ``base`` from uniform numbers ``u`` in (0, 1].

    ``distribution`` is ``"power"``, ``x = u^n`` (equation 3), or ``"exponential"``, ``x = −ln(u) / λ_e`` (equation 7),
    at most 1. Raises ``ValueError`` for another name.
    """
    t = threshold(base)
    if distribution == "power":
        return u ** exponent(t)
    if distribution == "exponential":
        return dr.minimum(-dr.log(dr.maximum(u, 1e-30)) / exponential_rate(t), 1)
    raise ValueError(f'footprint samples: found "{distribution}", allowed are {", ".join(FOOTPRINTS)}')


def share_below(x: np.ndarray, distribution: str, base: int) -> np.ndarray:
    """Return the fraction of footprints below ``x`` in [0, 1): ``x^(1/n)`` or ``1 − e^(−λ_e x)`` (equations 5, 8)."""
    t = threshold(base)
    return x ** (1 / exponent(t)) if distribution == "power" else 1 - np.exp(-exponential_rate(t) * x)


def footprint_histogram(distribution: str, levels: int) -> np.ndarray:
    """Return the share of footprints that is nearest to each of ``levels`` levels of detail.

    The texture has the side 2^(levels − 1). Shape ``(levels,)``; the shares sum to 1.
    """
    between = 2.0 ** (np.arange(levels - 1) + 0.5 - (levels - 1))
    below = share_below(between, distribution, 2 ** (levels - 1))
    return np.diff(np.concatenate([[0.0], below, [1.0]]))


def level_of(x, levels: int):
    """Return the level of detail in [0, levels − 1] of a footprint in [0, 1]."""
    return dr.maximum(dr.log2(dr.maximum(x, 1e-30)) + (levels - 1), 0)


def footprint_of(level, levels: int):
    """Return the footprint in [0, 1] of a level of detail: the inverse of :func:`level_of`.

    Level 0 has the footprint of one texel; smaller footprints are magnified and read level 0, too.
    """
    return dr.exp2(level - (levels - 1))
