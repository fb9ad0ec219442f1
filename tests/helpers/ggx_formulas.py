"""The rough conductor of Walter et al. 2007 in float64 NumPy, and the same with its distribution read from a table by
SciPy: the independent reference of the tests of GGX, written from the paper and the table format alone.
"""

import math

import numpy as np
from scipy.ndimage import map_coordinates


def distribution(sin2, alpha):
    """Equation 33, per solid angle of normals; ``sin2`` below 1."""
    sin2, alpha = np.asarray(sin2, np.float64), np.asarray(alpha, np.float64)
    cos2 = 1 - sin2
    return alpha**2 / (np.pi * cos2**2 * (alpha**2 + sin2 / cos2) ** 2)


def smith(cosine, alpha):
    """Equation 34."""
    cosine = np.asarray(cosine, np.float64)
    return 2 / (1 + np.sqrt(1 + alpha**2 * (1 - cosine**2) / cosine**2))


def fresnel(cosine, eta, k):
    """Reflectance of unpolarised light at a metal of the index eta + ik, by complex arithmetic."""
    n = eta + 1j * k
    refracted = np.sqrt(1 - (1 - cosine**2) / n**2 + 0j)
    s = (cosine - n * refracted) / (cosine + n * refracted)
    p = (n * cosine - refracted) / (n * cosine + refracted)
    return (np.abs(s) ** 2 + np.abs(p) ** 2) / 2


def half_sin2(wi, wo):
    """sin² of the angle of the half vector; directions are (…, 3)."""
    h = np.asarray(wi, np.float64) + np.asarray(wo, np.float64)
    return (h[..., 0] ** 2 + h[..., 1] ** 2) / np.sum(h**2, axis=-1)


def conductor(wi, wo, alpha, eta=0.0, k=1.0, normals=distribution):
    """BRDF times the cosine of ``wo``, equation 20, both directions above the horizon."""
    wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
    h = wi + wo
    cosine = np.sum(wi * h, axis=-1) / np.linalg.norm(h, axis=-1)
    d = normals(half_sin2(wi, wo), alpha)
    masking = smith(wi[..., 2], alpha) * smith(wo[..., 2], alpha)
    return fresnel(cosine, eta, k) * d * masking / (4 * wi[..., 2])


def learned(table, inputs, output):
    """The distribution that a ``Table`` holds, a function of sin²θ and α, under an encoding of the given names: two
    bilinear reads, one at the result of the other.
    """
    arrays = {name: array.values.astype(np.float64) for name, array in table.arrays.items()}

    def read(entries, *x):
        position = [np.clip(v, 0, 1) * (n - 1) for v, n in zip(x, entries.shape[:-1], strict=True)]
        channels = range(entries.shape[-1])
        return [map_coordinates(entries[..., c], position, order=1, mode="nearest") for c in channels]

    def normals(sin2, alpha):
        sin2, alpha = np.broadcast_arrays(np.asarray(sin2, np.float64), np.asarray(alpha, np.float64))
        if inputs == "logarithmic":  # as if α were at least 0.001, at an angle stretched accordingly
            floor = 1e-3
            least = floor**2 / 4
            known = np.maximum(alpha, floor)
            end = np.minimum(8 * alpha**2, 1)  # of what is read: the rest falls like 1/q²
            tail = np.minimum((end + alpha**2 * (1 - end)) / (sin2 + alpha**2 * (1 - sin2)), 1) ** 2
            stretched = np.minimum(sin2, end) * (known / alpha) ** 2
            x = 1 - np.log(stretched * (1 - least) + least) / math.log(least), 1 - np.log(known) / math.log(floor)
        else:
            x, tail = (np.sqrt(1 - sin2), alpha), 1
        (y,) = read(arrays["cascaded"], *read(arrays["primary"], *x))
        return tail * (y**4 / (np.pi * alpha**2) if output == "root" else np.maximum(y, 0))

    return normals
