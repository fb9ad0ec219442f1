"""
The Disney BRDF as tables: the layout of the paper's Table 1, with a small encoder before it.

The *encoder* is two 1D primary arrays, which map roughness (warped, see :func:`warp_roughness`) and anisotropy to
coordinates; it depends on the material only. The *decoder* is five cascaded arrays, the same for every material:

============ ========= ======== ================================ ===================================================
array        size      channels read at                          holds
============ ========= ======== ================================ ===================================================
``ggx``      16 × 16   3        encoded roughness, anisotropy    ln q of the GGX denominator Σ q_k h_k²
``masking``  16 × 16   1        encoded roughness, √(n·l n·v)    √(d(l) d(v)), Smith's masking with 1/(4 n·l n·v)
``diffuse``  16 × 16   4        n·l, n·v                         F_L + F_V, F_L F_V, n·l/(n·l + n·v), coat masking
``fresnel``  16 × 16   4        l·h, metallic                    m(1−s), (1−m)(1−s), coat Fresnel, (1−m)s
``coat``     16        2        clearcoat gloss                  ln of the coefficients of GTR1's denominator
============ ========= ======== ================================ ===================================================

3,104 numbers in the decoder (12,416 bytes in single precision), 16 in the encoder. Each array holds a bounded
quantity in a form that cannot blow up: denominators are sums of positive terms, cosines are never divided by.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np
from drjit import nn

from ...indirection import DifferentiableArray
from ...lookup import clamp
from ...tables import Table, TableError, load_table
from .model import ALPHA_MIN, COAT_F0, TINY, Factors, Material, diffuse_factors, geometry, positive

#: Sizes: name → (shape with channels last).
SHAPES = {
    "encoder_roughness": (8, 1),
    "encoder_anisotropic": (8, 1),
    "ggx": (16, 16, 3),
    "masking": (16, 16, 1),
    "diffuse": (16, 16, 4),
    "fresnel": (16, 16, 4),
    "coat": (16, 2),
}

#: Values that entries may have; outside of them the BRDF could become negative or infinite.
RANGES = {
    "encoder_roughness": (0.0, 1.0),
    "encoder_anisotropic": (0.0, 1.0),
    "ggx": (-12.0, 24.0),
    "masking": (0.5 * ALPHA_MIN, 8.0),
    "diffuse": (0.0, 2.0),
    "fresnel": (0.0, 1.0),
    "coat": (-16.0, 8.0),
}

TASK = "disney"


class DisneyArrays(nn.Module):
    """
    Encoder and decoder as one trainable module, with the parameters ``encoder_roughness.data`` … ``coat.data``.

    ``DisneyArrays().alloc(TensorXf)`` starts from ramps and coarse samples of the analytic factors;
    :meth:`from_table` takes trained ones.
    """

    DRJIT_STRUCT = {name: DifferentiableArray for name in SHAPES}  # noqa: RUF012

    def __init__(self, arrays: dict[str, DifferentiableArray] | None = None):
        arrays = arrays or {}
        for name in SHAPES:
            setattr(self, name, arrays.get(name))

    def _alloc(self, dtype, size=-1, rng=None):
        arrays = {}
        for name, shape in SHAPES.items():
            is_encoder = name.startswith("encoder")
            init = "ramp" if is_encoder else initial_entries(name)
            arrays[name] = DifferentiableArray(shape[:-1], shape[-1], init, fold=is_encoder)._alloc(dtype)[0]
        return DisneyArrays(arrays), 2

    @classmethod
    def from_table(cls, table: Table, dtype, storage: str = "float32") -> DisneyArrays:
        """Allocate from a :class:`Table` that :func:`load_disney_table` has checked, in the given storage form."""
        return cls(
            {name: DifferentiableArray.from_numpy(table.values(name), dtype, storage=storage) for name in SHAPES}
        )

    def to_table(self, storage: str = "float32", **about) -> Table:
        """The entries, limited to their ranges, as a :class:`Table`; ``about`` are its further fields."""
        arrays = {name: np.clip(getattr(self, name).numpy(), *RANGES[name]).astype(np.float32) for name in SHAPES}
        return Table(TASK, arrays, "float32", **about).to(storage)

    @property
    def nbytes(self) -> int:
        """Bytes of all entries in their storage form."""
        return sum(getattr(self, name).nbytes for name in SHAPES)

    @property
    def memory_nbytes(self) -> int:
        """Bytes in memory, with padding and repeated entries."""
        return sum(getattr(self, name).memory_nbytes for name in SHAPES)

    def encode(self, material: Material, active=True):
        """The latent coordinates of (roughness, anisotropic). Depends on the material only."""
        return (
            self.encoder_roughness([warp_roughness(material.roughness)], active)[0],
            self.encoder_anisotropic([material.anisotropic], active)[0],
        )

    def ggx_coefficients(self, latent, active=True) -> list:
        """``q`` with ``D = 1 / (q_x h_x² + q_y h_y² + q_z h_z²)²`` for a unit half vector. Material only."""
        return [dr.exp(clamp(v, *RANGES["ggx"])) for v in self.ggx(latent, active)]

    def coat_coefficients(self, gloss, active=True) -> list:
        """``k`` with ``GTR1 = 1 / (k_0 sin² + k_1 cos²)``. Material only."""
        return [dr.exp(clamp(v, *RANGES["coat"])) for v in self.coat([gloss], active)]

    def masking_root(self, latent_roughness, cos_product, active=True):
        """``√(d(wi) d(wo))`` from the encoded roughness and ``(n·l)(n·v)``; the specular term divides by its square."""
        return clamp(self.masking([latent_roughness, dr.sqrt(cos_product + TINY)], active)[0], *RANGES["masking"])

    def factors(self, material: Material, wi, wo, active=True) -> Factors:
        """The factors of :func:`.model.compose`, from five reads (and the encoder's two)."""
        g = geometry(wi, wo)
        latent = self.encode(material, active)
        qx, qy, qz = self.ggx_coefficients(latent, active)
        root = self.masking_root(latent[0], clamp(wi.z * wo.z, 0.0, 1.0), active)
        quadric = qx * dr.square(g.h.x) + qy * dr.square(g.h.y) + qz * dr.square(g.h.z)
        specular = dr.square(g.h2 / (quadric * root + TINY)) * wo.z

        fresnel_sum, fresnel_product, cos_ratio, coat_masking = self.diffuse([wo.z, wi.z], active)
        diffuse, flat = diffuse_factors(material.roughness, g.cos_d, fresnel_sum, fresnel_product, cos_ratio, wo.z)
        metal_base, base, coat_fresnel, sheen = self.fresnel([g.cos_d, material.metallic], active)

        k0, k1 = self.coat_coefficients(material.clearcoat_gloss, active)
        sine2 = dr.square(g.h.x) + dr.square(g.h.y)
        coat = g.h2 / (k0 * sine2 + k1 * dr.square(g.h.z) + TINY)
        return Factors(
            specular=specular,
            metal_base=positive(metal_base),
            base=positive(base),
            sheen=positive(sheen) * wo.z,
            grazing=positive((coat_fresnel - COAT_F0) / (1 - COAT_F0)),
            diffuse=diffuse,
            flat=flat,
            clearcoat=positive(coat * coat_masking * coat_fresnel) * wo.z,
        )


def warp_roughness(roughness):
    """
    The coordinate of a roughness in the encoder: ``√(r + c)``, brought to [0, 1].

    GGX coefficients span decades where roughness is low; the eight entries of the encoder lie closer together there
    (0, 0.04, 0.12, 0.23, …). With ``c = 0.01`` the slope at roughness 0 stays finite.
    """
    c = 0.01
    return (dr.sqrt(roughness + c) - math.sqrt(c)) / (math.sqrt(1 + c) - math.sqrt(c))


def load_disney_table(path) -> Table:
    """Read a table file of this task and check sizes and ranges. Raises :class:`TableError`."""
    table = load_table(path, task=TASK, shapes=SHAPES)
    for name, (low, high) in RANGES.items():
        values = table.values(name)
        slack = 1e-3 * (high - low)  # rounding of the storage form
        if values.min() < low - slack or values.max() > high + slack:
            raise TableError(
                f'{path}: entries of "{name}" lie in [{values.min():.4g}, {values.max():.4g}], '
                f"allowed is [{low:g}, {high:g}]"
            )
    return table


def initial_entries(name: str) -> np.ndarray:
    """Coarse samples of the analytic factors at the entries' own positions: the approximate solution to start from."""
    shape = SHAPES[name]
    axes = [np.linspace(0, 1, n) for n in shape[:-1]]
    u, v = (*np.meshgrid(*axes, indexing="ij"), None)[:2]
    if name in ("ggx", "masking"):  # read at the encoded roughness, to begin with the warped one
        u = (u * (math.sqrt(1.01) - 0.1) + 0.1) ** 2 - 0.01
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
    elif name == "coat":
        a2 = (0.1 - 0.099 * u) ** 2
        k = (a2 - 1) / (np.pi * np.log(a2))
        entries = [np.log(1 / k), np.log(a2 / k)]
    return np.clip(np.stack(entries, axis=-1), *RANGES[name]).astype(np.float32)
