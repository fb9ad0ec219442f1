"""Layout of the preset ``tables``: a better factorisation than the paper's, in tables of one coordinate.

=============== ========= ======== =============================== ===================================================
array           size      channels read at                         holds
=============== ========= ======== =============================== ===================================================
``encoder_…``   8         2        warped roughness; anisotropy    coordinates in the two that follow, with rests
``alpha``       64        2        encoded roughness               ln √(α_x α_y) of GGX, and its rest
``aspect``      32        2        encoded anisotropy              ln √(α_y / α_x), and its rest
``masking``     32        1        c / (c + t)                     d / (c + t)
``coat``        32        4        clearcoat gloss                 α and normalisation of GTR1, and their rests
=============== ========= ======== =============================== ===================================================

The *rest* is the error of rounding the first channel to bytes: the sum of both is as accurate as 16 bits, which values
need if their exponential or square is taken. The floor on α is applied after reading, since its kink would not fit into
a table; both logarithms then depend on one parameter each, and an isotropic material need not read the second.

Masking is tabulated for each direction, with the cosine already divided out: ``d = c + √(c² + t²)``, where ``c`` is the
direction's cosine and ``t = √(α_x² x² + α_y² y²)`` its tangent, stretched by the roughness. ``d`` is homogeneous, so
``d / (c + t)`` is a function of the ratio ``c / (c + t)`` alone: one axis instead of three (roughness, anisotropy,
cosine), between 1 and 2, and of the same relative accuracy at the horizon as anywhere else. The paper's layout is
inaccurate there.

Terms of one cosine, Schlick's (1 − c)^5 and the clearcoat's masking, are computed: four multiplications and a root take
less time than any read. With a table for them, the whole model was slower than Mitsuba's ``principled``.
"""

import drjit as dr
import numpy as np

from ...arrays.lookup import clamp, quantize
from ...arrays.tables import StoredArray, Table
from . import decoder, model
from .arrays import DisneyArrays
from .model import ALPHA_MIN, TINY

#: Smallest tabulated α: below the floor that is applied after reading, so that the kink is not in the table.
LOWEST_ALPHA = 0.2 * ALPHA_MIN


class FactoredArrays(DisneyArrays):
    """Encoder and decoder tables of the preset ``tables`` as one trainable module."""

    PRESET = "tables"

    SHAPES = {  # noqa: RUF012
        "encoder_roughness": (8, 2),
        "encoder_anisotropic": (8, 2),
        "alpha": (64, 2),
        "aspect": (32, 2),
        "masking": (32, 1),
        "coat": (32, 4),
    }

    RANGES = {  # noqa: RUF012
        "encoder_roughness": (-0.1, 1.0),
        "encoder_anisotropic": (-0.1, 1.0),
        "alpha": (-12.0, 2.0),
        "aspect": (-2.0, 0.5),
        "masking": (0.5, 4.0),
        "coat": (-0.05, 0.2),
    }

    #: Tables whose second half of channels is added to the first: it holds the error of rounding that to bytes. An
    #: exponential follows, and 8 bits for 8 units of a logarithm are errors of 1.6%.
    SPLIT = ("encoder_roughness", "encoder_anisotropic", "alpha", "aspect", "coat")

    def coat_values(self, gloss, active=True) -> list:
        """Return α of the clearcoat's GTR1 and its normalisation, which depend on the material only."""
        alpha, norm, rest_alpha, rest_norm = self.coat([gloss], active)
        return [alpha + rest_alpha, norm + rest_norm]

    def to_table(self) -> Table:
        table = super().to_table()
        for name in self.SPLIT:
            values = table.arrays[name].entries
            half = values.shape[-1] // 2
            total = values[..., :half] + values[..., half:]
            if name in ("encoder_anisotropic", "aspect"):
                total[0] = 0  # anisotropic 0 has to be isotropic to the last bit, since it may be left out
            codes, scale, offset = quantize(total, half)
            coarse = np.asarray(offset) + np.asarray(scale) * codes.astype(np.float64)
            entries = np.concatenate([coarse, total - coarse], axis=-1).astype(np.float32)
            table.arrays[name] = StoredArray(entries)
        return table

    @classmethod
    def targets(cls, m, wi, wo, uniform) -> dict[str, list]:
        """Return the exact values, see :meth:`.DisneyArrays.targets`.

        Tables of one coordinate are trained at uniform coordinates: those of random directions would hardly ever lie
        near the horizon, where errors matter as much.
        """
        u, _ = uniform
        alpha = model.coat_alpha(m.clearcoat_gloss)
        return {
            "alpha": [dr.log(dr.maximum(dr.square(m.roughness), LOWEST_ALPHA))],
            "aspect": [0.5 * dr.log(1 - 0.9 * m.anisotropic)],
            "masking": [u + dr.sqrt(dr.square(u) + dr.square(1 - u))],
            "coat": [alpha, (dr.square(alpha) - 1) / (2 * dr.pi * dr.log(alpha))],
        }

    def predict(self, m, wi, wo, uniform) -> dict[str, list]:
        u, _ = uniform
        roughness, anisotropic = self.encode(m)
        return {
            "alpha": [sum(self.alpha([roughness]))],
            "aspect": [sum(self.aspect([anisotropic]))],
            "masking": self.masking([u]),
            "coat": self.coat_values(m.clearcoat_gloss),
        }

    @classmethod
    def initial(cls, name: str) -> np.ndarray:
        (u,) = cls.axes(name)
        if name.startswith("encoder"):
            entries = [u, np.zeros_like(u)]
        elif name == "alpha":
            alpha = np.maximum(decoder.unwarp_roughness(u), 0) ** 2
            entries = [np.log(np.maximum(alpha, LOWEST_ALPHA)), np.zeros_like(u)]
        elif name == "aspect":
            entries = [0.5 * np.log(1 - 0.9 * u), np.zeros_like(u)]
        elif name == "masking":
            entries = [u + np.sqrt(u**2 + (1 - u) ** 2)]
        else:
            alpha = 0.1 - 0.099 * u
            entries = [alpha, (alpha**2 - 1) / (2 * np.pi * np.log(alpha)), np.zeros_like(u), np.zeros_like(u)]
        return np.stack(entries, axis=-1)


class FactoredDecoder(decoder.Decoder):
    """Form of the model that reads :class:`FactoredArrays` in place of some arithmetic.

    ``read`` names the factors that are read: any of ``alpha``, ``masking`` and ``coat``. A study leaves some of them
    out, to measure the cost of one table.
    """

    FACTORS = ("alpha", "masking", "coat")

    groups = {  # noqa: RUF012
        **decoder.GROUPS,
        "read_ggx": ("roughness", "anisotropic"),
        "read_coat": ("clearcoat", "clearcoat_gloss"),
    }

    def __init__(self, arrays: FactoredArrays, read=FACTORS):
        self.arrays, self.read = arrays, tuple(read)

    def _alpha(self, encoded, anisotropic: bool) -> list:
        """Return α_x and α_y of the encoded roughness and anisotropy, or one α for an isotropic material.

        Logarithms that are read are limited to those of parameters between 0 and 1, with a margin.
        """
        mean = clamp(sum(self.arrays.alpha([encoded[0]])), -12.0, 0.1)
        if not anisotropic:
            return [dr.maximum(dr.exp(mean), ALPHA_MIN)]
        aspect = clamp(sum(self.arrays.aspect([encoded[1]])), -1.2, 0.0)
        return [dr.maximum(dr.exp(v), ALPHA_MIN) for v in (mean - aspect, mean + aspect)]

    def required(self, e):
        instead = {"ggx": "read_ggx" if "alpha" in self.read else "ggx", "coat": "read_coat"}
        if "coat" not in self.read:
            del instead["coat"]
        return tuple(instead.get(name, name) for name in super().required(e))

    def _read_ggx(self, p, e):
        if p.lobe is not None:
            return decoder.sheared_ggx(self._alpha(self.arrays.encode(p), False)[0], p.lobe)
        return decoder.ggx_coefficients(*self._alpha(self.arrays.encode(p), e.anisotropic))

    def _read_coat(self, p, e):
        alpha, norm = self.arrays.coat_values(p.clearcoat_gloss)
        return {
            "a2": dr.square(clamp(alpha, 1e-4, 0.2)),
            "scale": model.COAT_STRENGTH * p.clearcoat * clamp(norm, 0.0, 0.2),
        }

    def ggx(self, c):
        return c["read_ggx"] if "alpha" in self.read else super().ggx(c)

    def coat(self, c):
        return c["read_coat"] if "coat" in self.read else super().coat(c)

    def masking(self, c, w, active=True):
        if "masking" not in self.read:
            return super().masking(c, w, active)
        total = w.z + dr.sqrt(decoder.stretched(self.ggx(c)["alpha2"], w) + TINY)
        ratio = self.arrays.masking([w.z / total], active, inside=True)
        return total * self.arrays.clamp_values("masking", ratio)[0]
