"""Layout of the preset ``paper``: the paper's Table 1, with a small encoder before it.

The *encoder* is two 1D primary arrays, which map roughness (warped, see :func:`.decoder.warp_roughness`) and anisotropy
to coordinates; it depends on the material only. The *decoder* is five cascaded arrays, the same for every material:

============ ========= ======== ================================ ===================================================
array        size      channels read at                          holds
============ ========= ======== ================================ ===================================================
``ggx``      16 × 16   3        encoded roughness, anisotropy    ln q of the GGX denominator Σ q_k h_k²
``masking``  16 × 16   1        encoded roughness, √(n·l n·v)    √(d(l) d(v)), Smith's masking with 1/(4 n·l n·v)
``diffuse``  16 × 16   4        n·l, n·v                         F_L + F_V, F_L F_V, n·l/(n·l + n·v), coat masking
``fresnel``  16 × 16   4        l·h, metallic                    m(1−s), (1−m)(1−s), coat Fresnel, (1−m)s
``coat``     16        2        clearcoat gloss                  ln of the coefficients of GTR1's denominator
============ ========= ======== ================================ ===================================================

3,104 numbers in the decoder (12,416 bytes in single precision), 16 in the encoder. Each array holds a bounded quantity
in a form that cannot blow up: denominators are sums of positive terms, cosines are never divided by. Masking from a
product of cosines is nevertheless far off at the horizon; :mod:`.factored` does better, and this layout is for
comparison.
"""

import drjit as dr
import numpy as np

from ...arrays.lookup import clamp
from . import decoder, model
from .arrays import DisneyArrays
from .model import ALPHA_MIN, COAT_F0, TINY, Factors, compose, diffuse_factors, geometry, positive


class PaperArrays(DisneyArrays):
    """Encoder and decoder tables of the preset ``paper`` as one trainable module."""

    PRESET = "paper"

    SHAPES = {  # noqa: RUF012
        "encoder_roughness": (8, 1),
        "encoder_anisotropic": (8, 1),
        "ggx": (16, 16, 3),
        "masking": (16, 16, 1),
        "diffuse": (16, 16, 4),
        "fresnel": (16, 16, 4),
        "coat": (16, 2),
    }

    RANGES = {  # noqa: RUF012
        "encoder_roughness": (0.0, 1.0),
        "encoder_anisotropic": (0.0, 1.0),
        "ggx": (-12.0, 24.0),
        "masking": (0.5 * ALPHA_MIN, 8.0),
        "diffuse": (0.0, 2.0),
        "fresnel": (0.0, 1.0),
        "coat": (-16.0, 8.0),
    }

    def masking_root(self, encoded_roughness, cos_product, active=True):
        """Return ``√(d(wi) d(wo))``, the root of the specular term's denominator, from the roughness and (n·l)(n·v)."""
        return self.clamp_values("masking", self.masking([encoded_roughness, dr.sqrt(cos_product + TINY)], active))[0]

    def factors(self, material, wi, wo, encoded: dict, lobes, active=True) -> Factors:
        """Return the factors of :func:`.model.compose` for ``lobes``, from five reads; those of other lobes are 0.

        ``encoded`` holds the coefficients of the material: ``roughness`` (encoded), ``q`` of
        ``D = 1 / (q_x h_x² + q_y h_y² + q_z h_z²)²``, with a unit half vector, and, for the clearcoat, ``k`` of
        ``GTR1 = 1 / (k_0 sin² + k_1 cos²)``.
        """
        g = geometry(wi, wo)
        specular = diffuse = flat = clearcoat = 0
        if "specular" in lobes:
            qx, qy, qz = encoded["q"]
            root = self.masking_root(encoded["roughness"], clamp(wi.z * wo.z, 0.0, 1.0), active)
            quadric = qx * dr.square(g.h.x) + qy * dr.square(g.h.y) + qz * dr.square(g.h.z)
            specular = dr.square(g.h2 / (quadric * root + TINY)) * wo.z

        read = self.clamp_values("fresnel", self.fresnel([g.cos_d, material.metallic], active))
        metal_base, base, coat_fresnel, sheen = read
        if "diffuse" in lobes or "clearcoat" in lobes:
            read = self.clamp_values("diffuse", self.diffuse([wo.z, wi.z], active))
            fresnel_sum, fresnel_product, cos_ratio, coat_masking = read
        if "diffuse" in lobes:
            diffuse, flat = diffuse_factors(
                material.roughness, dr.square(g.cos_d), fresnel_sum, fresnel_product, cos_ratio, wo.z
            )
        if "clearcoat" in lobes:
            k0, k1 = encoded["k"]
            sine2 = dr.square(g.h.x) + dr.square(g.h.y)
            coat = g.h2 / (k0 * sine2 + k1 * dr.square(g.h.z) + TINY)
            clearcoat = positive(coat * coat_masking * coat_fresnel) * wo.z
        return Factors(
            specular=specular,
            metal_base=positive(metal_base),
            base=positive(base),
            sheen=positive(sheen) * wo.z,
            grazing=positive((coat_fresnel - COAT_F0) / (1 - COAT_F0)),
            diffuse=diffuse,
            flat=flat,
            clearcoat=clearcoat,
        )

    @classmethod
    def targets(cls, m, wi, wo, uniform) -> dict[str, list]:
        g = geometry(wi, wo)
        ax, ay = model.roughness_to_alpha(m.roughness, m.anisotropic)
        norm = dr.sqrt(dr.pi * ax * ay)
        root = dr.sqrt(model.masking_denominator(wi, ax, ay) * model.masking_denominator(wo, ax, ay))
        s, fl, fv = model.schlick(g.cos_d), model.schlick(wo.z), model.schlick(wi.z)
        a2 = dr.square(model.coat_alpha(m.clearcoat_gloss))
        k = (a2 - 1) / (dr.pi * dr.log(a2))
        return {
            "ggx": [dr.log(norm / dr.square(ax)), dr.log(norm / dr.square(ay)), dr.log(norm)],
            "masking": [dr.log(root)],
            "diffuse": [
                fl + fv,
                fl * fv,
                wo.z / (wi.z + wo.z + TINY),
                model.coat_masking(wi.z) * model.coat_masking(wo.z),
            ],
            "fresnel": [
                m.metallic * (1 - s),
                (1 - m.metallic) * (1 - s),
                COAT_F0 + (1 - COAT_F0) * s,
                (1 - m.metallic) * s,
            ],
            "coat": [dr.log(1 / k), dr.log(a2 / k)],
        }

    def predict(self, m, wi, wo, uniform) -> dict[str, list]:
        encoded = self.encode(m)
        root = self.masking_root(encoded[0], wi.z * wo.z)
        return {
            "ggx": self.ggx(encoded),
            "masking": [dr.log(root)],
            "diffuse": self.diffuse([wo.z, wi.z]),
            "fresnel": self.fresnel([geometry(wi, wo).cos_d, m.metallic]),
            "coat": self.coat([m.clearcoat_gloss]),
        }

    @classmethod
    def initial(cls, name: str) -> np.ndarray:
        u, v = (*cls.axes(name), None)[:2]
        if name.startswith("encoder"):
            return u[..., None]
        if name in ("ggx", "masking"):  # read at the encoded roughness, to begin with the warped one
            u = np.maximum(decoder.unwarp_roughness(u), 0)
        if name == "ggx":
            aspect = np.sqrt(1 - 0.9 * v)
            ax, ay = np.maximum(u**2 / aspect, ALPHA_MIN), np.maximum(u**2 * aspect, ALPHA_MIN)
            norm = np.sqrt(np.pi * ax * ay)
            entries = [np.log(norm / ax**2), np.log(norm / ay**2), np.log(norm)]
        elif name == "masking":
            alpha2 = np.maximum(u**2, ALPHA_MIN) ** 2
            entries = [v + np.sqrt(v**2 + alpha2 * (1 - v**2))]
        elif name == "diffuse":
            fl, fv = (1 - u) ** 5, (1 - v) ** 5
            ratio = np.divide(u, u + v, out=np.full_like(u, 0.5), where=u + v > 0)

            def g1(c):
                return 2 * c / (c + np.sqrt(0.0625 + 0.9375 * c**2))

            entries = [fl + fv, fl * fv, ratio, g1(u) * g1(v)]
        elif name == "fresnel":
            s = (1 - u) ** 5
            entries = [v * (1 - s), (1 - v) * (1 - s), COAT_F0 + (1 - COAT_F0) * s, (1 - v) * s]
        else:
            a2 = (0.1 - 0.099 * u) ** 2
            k = (a2 - 1) / (np.pi * np.log(a2))
            entries = [np.log(1 / k), np.log(a2 / k)]
        return np.stack(entries, axis=-1)


class PaperDecoder(decoder.Decoder):
    """Form of the model that reads :class:`PaperArrays`; coefficients of GGX and GTR1 are read once per material."""

    groups = {**decoder.GROUPS, "encoded": ("roughness", "anisotropic"), "encoded_coat": ("clearcoat_gloss",)}  # noqa: RUF012

    def __init__(self, arrays: PaperArrays):
        self.arrays = arrays

    def required(self, e):
        return ("encoded", "encoded_coat") if e.clearcoat else ("encoded",)

    def _encoded(self, p, e):
        coordinates = self.arrays.encode(p)
        logarithms = self.arrays.clamp_values("ggx", self.arrays.ggx(coordinates))
        return {"roughness": coordinates[0], "q": tuple(map(dr.exp, logarithms))}

    def _encoded_coat(self, p, e):
        return {"k": tuple(map(dr.exp, self.arrays.clamp_values("coat", self.arrays.coat([p.clearcoat_gloss]))))}

    def value(self, c, e, lobes, p, wi, wo, active=True):
        lobes = tuple(lobe for lobe in lobes if lobe in e.lobes)
        encoded = {**c["encoded"], **c.get("encoded_coat", {})}
        factors = self.arrays.factors(p, wi, wo, encoded, lobes, active)
        return model.colour(compose(p, factors, lobes).values(), p.albedo, p.luminance)
