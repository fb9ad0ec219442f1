"""Spectra from colours at render time, by Jakob and Hanika's model with the coefficients that come with Mitsuba.

Jakob and Hanika, *A Low-Dimensional Function Space for Efficient Spectral Upsampling*, Computer Graphics Forum 38(2),
2019. Mitsuba's textures are converted when they are loaded; this module reads the same table, 3 × 64³ × 3 numbers,
while rendering, differentiably with respect to the colours.
"""

from __future__ import annotations

import threading

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.arrays.indirection import DifferentiableArray
from mi_diffind.arrays.lookup import clamp
from mi_diffind.core import compat

_models: dict = {}
_lock = threading.RLock()


def model():
    """Return the table for the variant's backend: side, positions along the brightness, coefficients padded to four."""
    key = mi.Float
    with _lock:
        if key not in _models:
            _models[key] = _load()
        return _models[key]


def _load():
    side, positions, entries = compat.srgb_coefficients()
    table = DifferentiableArray.from_numpy(entries, mi.TensorXf)  # pads and aligns them
    return side, mi.Float(positions.copy()), mi.Float(table.data.array)


def coefficients(rgb):
    """Return the coefficients of the model for linear sRGB colours, clamped to [0, 1] as in Mitsuba.

    They are meaningless for greys, whose spectra are constant.
    """
    side, positions, table = model()
    r, g, b = (clamp(mi.Float(c), 0.0, 1.0) for c in rgb)
    # The largest component, the last one of equals, and the two that follow it in turn
    green, blue = (g >= r), (b >= dr.maximum(r, g))
    z = dr.select(blue, b, dr.select(green, g, r))
    x = dr.select(blue, r, dr.select(green, b, g))
    y = dr.select(blue, g, dr.select(green, r, b))
    plane = dr.select(blue, 2, dr.select(green, 1, mi.UInt32(0)))

    scale = (side - 1) / dr.maximum(z, 1e-9)
    z_ = dr.detach(z)
    k = dr.binary_search(1, side - 1, lambda i: dr.gather(mi.Float, positions, i) <= z_) - 1
    below, above = (dr.gather(mi.Float, positions, k + i) for i in (0, 1))
    axes = [(k, (z - below) / (above - below))]
    for v in (y * scale, x * scale):
        i = dr.minimum(mi.UInt32(v), side - 2)
        axes.append((i, v - mi.Float(i)))
    total = [0, 0, 0]
    for a in (0, 1):
        for b_ in (0, 1):
            for c in (0, 1):
                index, weight = plane, 1
                for (i, w), up in zip(axes, (a, b_, c), strict=True):
                    index = dr.fma(index, side, i + up)
                    weight = weight * (w if up else 1 - w)
                entry = dr.gather(mi.Vector4f, table, index)
                total = [dr.fma(weight, entry[n], total[n]) for n in range(3)]
    return total


def spectrum(rgb, wavelengths):
    """Return the reflectance at ``wavelengths`` (nm), for linear sRGB colours in [0, 1]."""
    r, g, b = (clamp(mi.Float(c), 0.0, 1.0) for c in rgb)
    c0, c1, c2 = coefficients(rgb)
    v = dr.fma(dr.fma(c0, wavelengths, c1), wavelengths, c2)
    reflectance = dr.fma(0.5 * v, dr.rsqrt(dr.fma(v, v, 1)), 0.5)
    grey = (r == g) & (g == b)
    return mi.UnpolarizedSpectrum(dr.select(grey, r, reflectance))


def mean(rgb):
    """Return the mean of the spectrum over 16 wavelengths, as Mitsuba computes it."""
    wavelengths = np.linspace(mi.MI_CIE_MIN, mi.MI_CIE_MAX, 16)
    c0, c1, c2 = coefficients(rgb)
    total = 0
    for wavelength in wavelengths.tolist():
        v = dr.fma(dr.fma(c0, wavelength, c1), wavelength, c2)
        total = total + dr.fma(0.5 * v, dr.rsqrt(dr.fma(v, v, 1)), 0.5)
    r, g, b = (clamp(mi.Float(c), 0.0, 1.0) for c in rgb)
    return dr.select((r == g) & (g == b), r, total / len(wavelengths))
