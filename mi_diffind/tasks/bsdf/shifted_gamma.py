"""BRDF of the shifted gamma distribution (Bagher et al., *Accurate fitting of measured reflectances*, 2012), isotropic.

Of each channel, 11 numbers give

    π f = ρ_d + ρ_s F(θ_d) D(θ_h) G₁(θ_i) G₁(θ_o) / (cos θ_i cos θ_o),

with F = f₀ − f₁ cos θ_d + (1 − f₀)(1 − cos θ_d)⁵, D = κ exp(−x) / (π xᵖ cos⁴θ_h) of x = α + tan²θ_h/α, and
G₁ = 1 + λ(1 − exp(c max(θ − θ₀, 0)ᵏ)), limited to [0, 1].
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from ...arrays.lookup import clamp
from ...core.errors import UsageError, reason
from ...core.files import irregular
from ...core.units import memory
from .measured import LARGEST, Truth

#: Names of the numbers of a channel, as in files of fits.
NUMBERS = ("rhoD", "rhoS", "f0", "f1", "kap", "alpha", "p", "lambda", "c", "k", "theta0")


class ShiftedGammaTruth(Truth):
    """Fit ``name`` of a ``.json`` file ("": its only one): {name: {number: [r, g, b]}}. Raises :class:`UsageError`."""

    isotropic = True

    def __init__(self, path: Path, name: str, types):
        fits = read_fits(path)
        if not name and len(fits) > 1:
            shown = ", ".join([*list(fits)[:8], *["…"][: len(fits) - 8]])
            raise UsageError(f"{path}: has {len(fits)} fits: name one (material), they are {shown}")
        if name and name not in fits:
            raise UsageError(f'material: found "{name}", {path} has no such fit')
        self.name = name or next(iter(fits))
        numbers = fits[self.name]
        self.digest = hashlib.sha256(self.name.encode() + numbers.tobytes()).hexdigest()
        self.numbers = device_array(types.Float, numbers.ravel())

    def value(self, wi, wo):
        Float, UInt32 = type(wo.z), dr.uint32_array_t(type(wo.z))
        numbers = [dr.gather(Float, self.numbers, UInt32(k)) for k in range(3 * len(NUMBERS))]
        return [clamp(wo.z * v, 0, LARGEST) for v in shifted_gamma(numbers, wi, wo)]


def may_hold_fits(path: Path) -> bool:
    """Return whether a ``.json`` file is damaged, or one of its entries has a colour of a fit, as no other JSON."""
    if irregular(path, memory() // 4):  # a pipe would block
        return True
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return True
    entries = content.values() if isinstance(content, dict) else ()
    return any(isinstance(entry, dict) and not entry.keys().isdisjoint(NUMBERS[:2]) for entry in entries)


def read_fits(path: Path) -> dict[str, np.ndarray]:
    """Return the fits of a ``.json`` file, each ``(11, 3)`` in the order of :data:`NUMBERS`.

    Raises :class:`UsageError`.
    """
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as e:
        raise UsageError(f"{path}: cannot be read ({reason(e)})") from None
    try:
        fits = {str(name): np.array([fit[number] for number in NUMBERS], np.float32) for name, fit in content.items()}
        valid = bool(fits) and all(f.shape == (len(NUMBERS), 3) and np.isfinite(f).all() for f in fits.values())
    except (AttributeError, KeyError, TypeError, ValueError):
        valid = False
    if not valid:
        raise UsageError(
            f"{path}: holds no fits of the shifted gamma distribution: {{name: {{number: [r, g, b]}}}} with the finite "
            f"numbers {', '.join(NUMBERS)} is needed"
        )
    return fits


def shifted_gamma(numbers: list, wi, wo) -> list:
    """Return f without the cosine, three arrays; ``numbers``: three channels of each of :data:`NUMBERS` in turn."""
    half = wi + wo
    half = half * dr.rsqrt(dr.maximum(dr.squared_norm(half), 1e-20))
    cos_d, cos2 = clamp(dr.dot(wi, half), 0, 1), clamp(dr.square(half.z), 1e-12, 1)
    tan2 = (1 - cos2) * dr.rcp(cos2)
    angles = [dr.acos(clamp(w.z, -1, 1)) for w in (wi, wo)]
    inverse = dr.rcp(dr.maximum(wi.z * wo.z, 1e-9))
    result = []
    for channel in range(3):
        rho_d, rho_s, f0, f1, kappa, alpha, p, lambda_, c, k, theta0 = numbers[channel::3]
        fresnel = dr.fma(1 - f0, (1 - cos_d) ** 5, f0 - f1 * cos_d)
        x = alpha + tan2 * dr.rcp(alpha)
        d = kappa * dr.inv_pi * dr.exp(-x - p * dr.log(x)) * dr.rcp(dr.square(cos2))
        for angle in angles:
            shifted = dr.maximum(angle - theta0, 1e-9)
            d = d * clamp(1 + lambda_ * (1 - dr.exp(dr.minimum(c * dr.exp(k * dr.log(shifted)), 80))), 0, 1)
        result.append(dr.inv_pi * dr.fma(rho_s * fresnel, d * inverse, rho_d))
    return result
