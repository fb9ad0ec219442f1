"""
``quality="tables"``: a better factorisation than the paper's, in tables of one coordinate where one suffices.

=============== ========= ======== =============================== ===================================================
array           size      channels read at                         holds
=============== ========= ======== =============================== ===================================================
``encoder_…``   8         2        warped roughness; anisotropy    a coordinate in ``alpha``, and its rest
``alpha``       16 × 8    4        encoded roughness, anisotropy   ln α_x, ln α_y of GGX, and the rest of each
``masking``     32        1        c / (c + t)                     d / (c + t)
``cosine``      64        2        a cosine                        (1 − c)^2.5, Schlick's root; coat's G₁
``coat``        32        2        clearcoat gloss                 ln of the coefficients of GTR1's denominator
=============== ========= ======== =============================== ===================================================

Masking is tabulated for each direction, with the cosine already divided out: ``d = c + √(c² + t²)``, where ``c`` is the
direction's cosine and ``t = √(α_x² x² + α_y² y²)`` its tangent, stretched by the roughness. ``d`` is homogeneous, so
``d / (c + t)`` is a function of the ratio ``c / (c + t)`` alone: one axis instead of three (roughness, anisotropy,
cosine), between 1 and 2, and of the same relative accuracy at the horizon as anywhere else. That is what the paper's
layout lacks.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from ...lookup import clamp, quantize
from ...tables import Table
from . import decoder, model
from .arrays import Arrays
from .model import ALPHA_MIN, TINY, positive

#: Limits of ``ln α``: those of a roughness of 0, and of 1 with anisotropy 1.
LOG_ALPHA = (math.log(ALPHA_MIN), 1.2)


class FactoredArrays(Arrays):
    """Encoder and decoder as one trainable module."""

    QUALITY = "tables"

    SHAPES = {  # noqa: RUF012
        "encoder_roughness": (8, 2),
        "encoder_anisotropic": (8, 2),
        "alpha": (16, 8, 4),
        "masking": (32, 1),
        "cosine": (64, 2),
        "coat": (32, 2),
    }

    RANGES = {  # noqa: RUF012
        "encoder_roughness": (-0.1, 1.0),
        "encoder_anisotropic": (-0.1, 1.0),
        "alpha": (-7.5, 2.0),
        "masking": (0.5, 4.0),
        "cosine": (0.0, 2.0),
        "coat": (-16.0, 8.0),
    }

    #: Tables whose second half of channels is what rounding the first half to bytes has left, to be added to it: an
    #: exponential follows, and 8 bits for 8 units of a logarithm are errors of 1.6%.
    SPLIT = ("encoder_roughness", "encoder_anisotropic", "alpha")

    def log_alpha(self, latent, active=True) -> list:
        """``ln α_x`` and ``ln α_y`` of the encoded roughness and anisotropy. Depends on the material only."""
        x, y, rest_x, rest_y = self.alpha(latent, active)
        return [x + rest_x, y + rest_y]

    def to_table(self, storage: str = "float32", **about) -> Table:
        table = super().to_table("float32", **about)
        for name in self.SPLIT:
            values = table.arrays[name]
            half = values.shape[-1] // 2
            total = values[..., :half] + values[..., half:]
            codes, scale, offset = quantize(total, half)
            coarse = np.asarray(offset) + np.asarray(scale) * codes.astype(np.float64)
            table.arrays[name] = np.concatenate([coarse, total - coarse], axis=-1).astype(np.float32)
        return table.to(storage)

    # -- training ---------------------------------------------------------------------------------------------------

    @classmethod
    def targets(cls, m, wi, wo, uniform) -> dict[str, list]:
        """
        Tables of one coordinate are trained at uniform ones: those of random directions would hardly ever lie near the
        horizon, where errors matter as much.
        """
        ax, ay = model.roughness_to_alpha(m.roughness, m.anisotropic)
        u, v = uniform
        a2 = dr.square(model.coat_alpha(m.clearcoat_gloss))
        k = (a2 - 1) / (dr.pi * dr.log(a2))
        return {
            "alpha": [dr.log(ax), dr.log(ay)],
            "masking": [u + dr.sqrt(dr.square(u) + dr.square(1 - u))],
            "cosine": [dr.sqrt(model.schlick(v)), model.coat_masking(v)],
            "coat": [dr.log(1 / k), dr.log(a2 / k)],
        }

    def predict(self, m, wi, wo, uniform) -> dict[str, list]:
        u, v = uniform
        return {
            "alpha": self.log_alpha(self.encode(m)),
            "masking": self.masking([u]),
            "cosine": self.cosine([v]),
            "coat": self.coat([m.clearcoat_gloss]),
        }

    @classmethod
    def initial(cls, name: str) -> np.ndarray:
        u, v = (*cls.axes(name), None)[:2]
        if name.startswith("encoder"):
            entries = [u, np.zeros_like(u)]
        elif name == "alpha":
            u = np.maximum(decoder.unwarp_roughness(u), 0)
            aspect = np.sqrt(1 - 0.9 * v)
            entries = [np.log(np.maximum(a, ALPHA_MIN)) for a in (u**2 / aspect, u**2 * aspect)]
            entries += [np.zeros_like(u)] * 2
        elif name == "masking":
            entries = [u + np.sqrt(u**2 + (1 - u) ** 2)]
        elif name == "cosine":
            entries = [(1 - u) ** 2.5, 2 * u / (u + np.sqrt(0.0625 + 0.9375 * u**2))]
        else:
            a2 = (0.1 - 0.099 * u) ** 2
            k = (a2 - 1) / (np.pi * np.log(a2))
            entries = [np.log(1 / k), np.log(a2 / k)]
        return np.stack(entries, axis=-1)


class FactoredDecoder(decoder.Decoder):
    """
    Reads :class:`FactoredArrays` in place of the arithmetic of the factors named in ``read``: any of ``alpha``,
    ``masking``, ``cosine`` and ``coat`` (fewer than all for measuring what a table gains).
    """

    FACTORS = ("alpha", "masking", "cosine", "coat")

    groups = {  # noqa: RUF012
        **decoder.GROUPS,
        "read_ggx": ("roughness", "anisotropic"),
        "read_coat": ("clearcoat", "clearcoat_gloss"),
    }

    def __init__(self, arrays: FactoredArrays, read=FACTORS):
        self.arrays, self.read = arrays, tuple(read)

    def encode_roughness(self, roughness, active=True):
        return self.arrays.encode_roughness(roughness, active)

    def encode_anisotropic(self, anisotropic, active=True):
        return self.arrays.encode_anisotropic(anisotropic, active)

    def decode(self, latent, active=True):
        return decoder.alpha_to_roughness(*self._alpha(latent, active))

    def _alpha(self, latent, active=True):
        return [dr.exp(clamp(v, *LOG_ALPHA)) for v in self.arrays.log_alpha(latent, active)]

    def required(self, e):
        instead = {"ggx": "read_ggx" if "alpha" in self.read else "ggx", "coat": "read_coat"}
        if "coat" not in self.read:
            del instead["coat"]
        return tuple(instead.get(name, name) for name in super().required(e))

    def _read_ggx(self, p, e):
        ax, ay = self._alpha(self.arrays.encode(p))
        return decoder.ggx_coefficients(*((ax, ay) if e.anisotropic else (ax,)))

    def _read_coat(self, p, e):
        limits = self.arrays.RANGES["coat"]
        k0, k1 = (dr.exp(clamp(v, *limits)) for v in self.arrays.coat([p.clearcoat_gloss]))
        return {"a2": k1 / k0, "scale": model.COAT_STRENGTH * p.clearcoat / k0}

    def ggx(self, c):
        return c["read_ggx"] if "alpha" in self.read else super().ggx(c)

    def coat(self, c):
        return c["read_coat"] if "coat" in self.read else super().coat(c)

    def fresnel(self, cosine, active=True):
        if "cosine" not in self.read:
            return super().fresnel(cosine, active)
        return dr.square(self.arrays.cosine([cosine], active)[0])

    def masking(self, c, w, active=True):
        if "masking" not in self.read:
            return super().masking(c, w, active)
        total = w.z + dr.sqrt(decoder.stretched(self.ggx(c)["alpha2"], w) + TINY)
        return total * clamp(self.arrays.masking([w.z / total], active)[0], *self.arrays.RANGES["masking"])

    def coat_masking(self, cos_i, cos_o, active=True):
        if "cosine" not in self.read:
            return super().coat_masking(cos_i, cos_o, active)
        found = [positive(self.arrays.cosine([cosine], active)[1]) for cosine in (cos_i, cos_o)]
        return found[0] * found[1], 1
