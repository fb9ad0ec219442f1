"""Burley's model in float64 NumPy, written from the course notes and METHOD.md alone, term by term and without any of
the rearrangements of ``mi_diffind.tasks.disney.model``: the independent reference of the tests.
"""

import numpy as np
from bsdf_queries import random_directions

NAMES = (
    "metallic", "roughness", "anisotropic", "specular", "spec_tint", "sheen", "sheen_tint", "flatness", "clearcoat",
    "clearcoat_gloss",
)  # fmt: skip


def mix(a, b, t):
    return a * (1 - t) + b * t


def brdf(base_color, m, wi, wo):
    """BRDF without the cosine: ``base_color`` (n, 3), ``m`` dict of (n,), directions (n, 3) → (n, 3), float64."""
    base_color, wi, wo = (np.asarray(a, np.float64) for a in (base_color, wi, wo))
    m = {k: np.asarray(v, np.float64) for k, v in m.items()}
    n_v, n_l = wi[:, 2], wo[:, 2]
    h = wi + wo
    h = h / np.linalg.norm(h, axis=1, keepdims=True)
    l_h = np.sum(wo * h, axis=1)
    n_h = h[:, 2]

    luminance = base_color @ np.array([0.212671, 0.715160, 0.072169])
    tint = np.where(luminance[:, None] > 0, base_color / np.maximum(luminance, 1e-300)[:, None], 1.0)

    # Specular
    aspect = np.sqrt(1 - 0.9 * m["anisotropic"])
    ax = np.maximum(1e-3, m["roughness"] ** 2 / aspect)
    ay = np.maximum(1e-3, m["roughness"] ** 2 * aspect)
    d = 1 / (np.pi * ax * ay * ((h[:, 0] / ax) ** 2 + (h[:, 1] / ay) ** 2 + n_h**2) ** 2)

    def g1(w):
        tan2 = ((w[:, 0] * ax) ** 2 + (w[:, 1] * ay) ** 2) / w[:, 2] ** 2
        return 2 / (1 + np.sqrt(1 + tan2))

    fh = (1 - l_h) ** 5
    white = np.ones_like(base_color)
    dielectric = 0.08 * m["specular"][:, None] * mix(white, tint, m["spec_tint"][:, None])
    f0 = mix(dielectric, base_color, m["metallic"][:, None])
    fresnel = mix(f0, white, fh[:, None])
    specular = fresnel * (d * g1(wi) * g1(wo) / (4 * n_v * n_l))[:, None]

    # Diffuse, subsurface, sheen
    fl, fv = (1 - n_l) ** 5, (1 - n_v) ** 5
    fd90 = 0.5 + 2 * m["roughness"] * l_h**2
    fd = mix(1, fd90, fl) * mix(1, fd90, fv)
    fss90 = m["roughness"] * l_h**2
    fss = mix(1, fss90, fl) * mix(1, fss90, fv)
    ss = 1.25 * (fss * (1 / (n_l + n_v) - 0.5) + 0.5)
    sheen = (m["sheen"] * fh)[:, None] * mix(white, tint, m["sheen_tint"][:, None])
    diffuse = (base_color / np.pi * mix(fd, ss, m["flatness"])[:, None] + sheen) * (1 - m["metallic"])[:, None]

    # Clearcoat
    a2 = mix(0.1, 0.001, m["clearcoat_gloss"]) ** 2
    gtr1 = (a2 - 1) / (np.pi * np.log(a2) * (1 + (a2 - 1) * n_h**2))

    def coat_g1(c):
        return 2 / (1 + np.sqrt(1 + 0.0625 * (1 - c**2) / c**2))

    coat = 0.25 * m["clearcoat"] * gtr1 * coat_g1(n_l) * coat_g1(n_v) * (0.04 + 0.96 * fh)
    return diffuse + specular + coat[:, None]


def random_case(rng, n, low_cosine=0.0, rate=0.0):
    """Random materials and directions (uniform over the hemisphere, cosines ≥ low_cosine). Parameters are uniform, or
    metallic and roughness of an exponential-like distribution of a ``rate``.
    """
    color, m = rng.random((n, 3)), {k: rng.random(n) for k in NAMES}
    for name in ("metallic", "roughness") if rate else ():  # the inverse of its cumulative distribution
        m[name] = -np.log(1 - m[name] * (1 - np.exp(-rate))) / rate
    return color, m, *(random_directions(rng, n, low_cosine) for _ in range(2))
