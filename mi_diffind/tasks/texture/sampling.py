"""
Footprints: what a number in [0, 1] that says how much of a texture a pixel covers means, and how training draws it.

The supplement's section "Sampling LODs" draws footprints x as powers of a uniform number, so that a fraction p of them
lie below t = 1 / N_base, N_base the side of the texture in texels (equations 3 to 6; p = 0.5: half of the samples on
level 0), and describes an exponential distribution that it rejects (equations 7 to 9).

What x measures it leaves open: it calls the footprint a magnitude of a cross product, which is an area, but the
threshold 1 / N_base is the *side* of a texel (its area is 1 / N_base²), and 0 and 1 are the most and the least detailed
level. :data:`AXES` are the three readings: ``"side"`` and ``"area"`` of the footprint in uv, and ``"level"``, the level
of detail as a share of all levels.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

#: What a footprint in [0, 1] may measure.
AXES = ("side", "area", "level")

#: Distributions that footprints are drawn from.
FOOTPRINTS = ("power", "exponential")

#: Fraction p of the samples below the threshold t.
FRACTION = 0.5


def threshold(base: int) -> float:
    """``t = 1 / N_base`` for the side of a texture in texels; half of [0, 1] for a side of 1."""
    return 1 / max(2, base)


def exponent(t: float, p: float = FRACTION) -> float:
    """Equation 6: the ``n = log_p(t)`` for which a fraction ``p`` of all ``u^n`` lies below ``t``."""
    _check(t, p)
    return math.log(t) / math.log(p)


def power(u, n: float):
    """Equation 3: a footprint ``x = u^n`` from a uniform number in [0, 1], NumPy's or Dr.Jit's."""
    return u**n


def power_fraction(x, n: float):
    """Equation 5: the fraction of samples ``u^n`` below ``x``, ``x^(1/n)`` (from equation 4, CDF(u) = u)."""
    return x ** (1 / n)


def exponential_rate(t: float, p: float = FRACTION) -> float:
    """Equation 9: the rate ``λ_e = −ln(1 − p) / t`` for which a fraction ``p`` of all samples lies below ``t``."""
    _check(t, p)
    return -math.log1p(-p) / t


def exponential(u, rate: float):
    """Equation 7: a footprint ``x = −ln(u) / λ_e`` from a uniform number in (0, 1]; beyond 1 it is 1."""
    if isinstance(u, (float, np.ndarray)):
        return np.minimum(-np.log(np.maximum(u, 1e-30)) / rate, 1)
    return dr.minimum(-dr.log(dr.maximum(u, 1e-30)) / rate, 1)


def exponential_fraction(x, rate: float):
    """Equation 8: the fraction of exponential samples below ``x``, ``1 − e^(−λ_e x)``."""
    return 1 - math.exp(-rate * x)


def footprints(u, kind: str, base: int):
    """Footprints in [0, 1] of a texture of side ``base`` from uniform numbers, by one of :data:`FOOTPRINTS`."""
    t = threshold(base)
    if kind not in FOOTPRINTS:
        raise ValueError(f'footprint samples: found "{kind}", allowed are {FOOTPRINTS}')
    return power(u, exponent(t)) if kind == "power" else exponential(u, exponential_rate(t))


def level_of(x, axis: str, levels: int):
    """The level of detail in [0, levels − 1] of a footprint in [0, 1]."""
    top = levels - 1
    if axis == "level":
        return x * top
    log2 = np.log2 if isinstance(x, (float, np.ndarray)) else dr.log2
    maximum = np.maximum if isinstance(x, (float, np.ndarray)) else dr.maximum
    return maximum(log2(maximum(x, 1e-30)) * (1.0 if axis == "side" else 0.5) + top, 0)


def footprint_of(level, axis: str, levels: int):
    """
    The footprint in [0, 1] of a level of detail: the inverse of :func:`level_of`. For sides and areas level 0 is the
    footprint of one texel; what is smaller is magnified, and level 0, too.
    """
    if axis == "level":
        return level * (1 / max(1, levels - 1))
    exp2 = np.exp2 if isinstance(level, (float, np.ndarray)) else dr.exp2
    return exp2((level - (levels - 1)) * (1.0 if axis == "side" else 2.0))


def footprint_histogram(kind: str, levels: int, count: int = 2**20, axis: str = "side", seed: int = 0) -> np.ndarray:
    """
    The share of the samples of a distribution (:data:`FOOTPRINTS`) on each of ``levels`` levels of detail, of a texture
    of side 2^(levels − 1), each counted on the level that is nearest.
    """
    u = 1 - np.random.default_rng(seed).random(count)
    level = level_of(footprints(u, kind, 2 ** (levels - 1)), axis, levels)
    nearest = np.clip(np.floor(level + 0.5).astype(int), 0, levels - 1)
    return np.bincount(nearest, minlength=levels) / count


def _check(t: float, p: float) -> None:
    for name, value in (("t", t), ("p", p)):
        if not 0 < value < 1:
            raise ValueError(f"{name}: found {value}, allowed are numbers between 0 and 1")
