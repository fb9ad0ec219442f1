"""The Disney BRDF in two steps: coefficients of the material, then values for pairs of directions.

:class:`Decoder` is the model of :mod:`.model` rearranged for speed, with the same values up to rounding. Only the parts
in use (:class:`.model.Effects`) are computed. Coefficients come in groups (:data:`GROUPS`), each of which depends on
a few parameters: where these are constant, a caller evaluates the group once and not for each sample.

Learned forms replace some of its methods by reads (:class:`.factored.FactoredDecoder`) or all of it
(:class:`.paper.PaperDecoder`). Sampling and densities (:mod:`.sampling`) always use the analytic coefficients.
"""

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr

from . import model
from .model import COAT_F0, COAT_STRENGTH, SPECULAR_SCALE, TINY, Effects, diffuse_factors, geometry, schlick

#: Group of coefficients → the parameters from which it is computed.
GROUPS = {
    "ggx": ("roughness", "anisotropic"),
    "diffuse": ("base_color", "metallic"),
    "retro": ("roughness",),
    "flatness": ("flatness",),
    "sheen": ("base_color", "metallic", "sheen", "sheen_tint"),
    "f0": ("base_color", "metallic", "specular", "spec_tint"),
    "coat": ("clearcoat", "clearcoat_gloss"),
    "shares": ("base_color", "metallic", "specular", "sheen", "clearcoat"),
}


class Decoder:
    """Analytic form of the model.

    In all methods, ``p`` is an object with the sanitised parameters (:func:`.model.sanitize`), ``albedo`` (a colour)
    and ``luminance`` as attributes; ``c`` maps groups to coefficients; ``e`` are the effects in use; ``g`` is the
    geometry of a pair of directions (:func:`.model.geometry`).
    """

    #: Group → parameters; a learned form may have more groups.
    groups = GROUPS

    #: The tables, of a learned form.
    arrays = None

    def required(self, e: Effects) -> tuple[str, ...]:
        """Return the groups that values need when the effects ``e`` are in use."""
        needed = {
            "ggx": True,
            "diffuse": e.diffuse or e.subsurface,
            "retro": e.diffuse or e.subsurface,
            "flatness": e.diffuse and e.subsurface,
            "sheen": e.sheen,
            "f0": e.metal or e.dielectric,
            "coat": e.clearcoat,
        }
        return tuple(name for name, applies in needed.items() if applies)

    def coefficients(self, group: str, p: Any, e: Effects) -> dict:
        """Return the coefficients of one group."""
        return getattr(self, f"_{group}")(p, e)

    def _ggx(self, p, e: Effects) -> dict:
        """Return the coefficients of the specular lobe (:func:`ggx_coefficients`)."""
        if p.lobe is not None:
            return sheared_ggx(dr.maximum(dr.square(p.roughness), model.ALPHA_MIN), p.lobe)
        if not e.anisotropic:
            return ggx_coefficients(dr.maximum(dr.square(p.roughness), model.ALPHA_MIN))
        return ggx_coefficients(*model.roughness_to_alpha(p.roughness, p.anisotropic))

    def _diffuse(self, p, e: Effects) -> dict:
        albedo = p.albedo * dr.inv_pi
        return {"albedo": albedo * (1 - p.metallic) if e.metal else albedo}

    def _retro(self, p, e: Effects) -> dict:
        return {"roughness": p.roughness}

    def _flatness(self, p, e: Effects) -> dict:
        return {"flatness": p.flatness}

    def _sheen(self, p, e: Effects) -> dict:
        strength = p.sheen * (1 - p.metallic) if e.metal else p.sheen
        return {"colour": strength * _mix_tint(p, p.sheen_tint) if e.sheen_tint else strength}

    def _f0(self, p, e: Effects) -> dict:
        f0 = 0
        if e.dielectric:
            f0 = SPECULAR_SCALE * p.specular
            f0 = f0 * (1 - p.metallic) if e.metal else f0
            f0 = f0 * _mix_tint(p, p.spec_tint) if e.spec_tint else f0
        if e.metal:
            f0 = p.albedo * p.metallic + f0
        return {"f0": f0}

    def _coat(self, p, e: Effects) -> dict:
        """Return the coefficients of the clearcoat: ``GTR1 = scale |h|² / (sin² + α² cos²)``.

        ``scale`` contains the lobe's strength; ``log`` is for sampling.
        """
        a2 = dr.square(model.coat_alpha(p.clearcoat_gloss))
        log = dr.log(a2)
        norm = (a2 - 1) / (dr.pi * log)
        return {"a2": a2, "log": log, "norm": norm, "scale": COAT_STRENGTH * p.clearcoat * norm}

    def _shares(self, p, e: Effects) -> dict:
        """Return the estimated energy of each lobe, for :func:`.sampling.lobe_probabilities`."""
        shares = {}
        dielectric = (1 - p.metallic) if e.metal else 1
        if "diffuse" in e.lobes:
            shares["diffuse"] = dielectric * p.luminance
            if e.sheen:
                shares["sheen"] = dielectric * p.sheen
        f0 = 0
        if e.dielectric:
            f0 = dielectric * (SPECULAR_SCALE * p.specular)
        if e.metal:
            f0 = p.luminance * p.metallic + f0
        shares["f0"] = f0
        if e.clearcoat:
            shares["clearcoat"] = p.clearcoat
        return shares

    def value(self, c: dict, e: Effects, lobes, p, wi, wo, active=True):
        """Return BRDF · ``wo.z`` of the lobes named in ``lobes``: a colour, or a number if all of them are colourless.

        Only forms that read tables at parameters use ``p``.
        """
        g = geometry(wi, wo)
        total = 0
        if e.sheen or "specular" in lobes or "clearcoat" in lobes:
            s = schlick(g.cos_d)
        if "diffuse" in lobes:
            if e.diffuse or e.subsurface:
                total = c["diffuse"]["albedo"] * self.diffuse(c, e, g, wi, wo)
            if e.sheen:
                total = c["sheen"]["colour"] * (s * wo.z) + total
        if "specular" in lobes:
            colour = dr.fma(c["f0"]["f0"], 1 - s, s) if "f0" in c else s
            colour = colour * self.ggx(c).get("weight", 1)
            total = colour * self.specular(c, g, wi, wo, active) + total
        if "clearcoat" in lobes and e.clearcoat:
            total = self.clearcoat(c, g, s, wi, wo) + total
        return total

    def diffuse(self, c, e: Effects, g, wi, wo):
        """Return base diffuse and subsurface approximation, mixed by flatness, times ``π wo.z``."""
        fl, fv = schlick(wo.z), schlick(wi.z)
        # (l·h)² = |h|²/4 without a root; the ratio is only needed for subsurface scattering
        ratio = wo.z / (wi.z + wo.z + TINY) if e.subsurface else 0
        base, flat = diffuse_factors(c["retro"]["roughness"], 0.25 * g.h2, fl + fv, fl * fv, ratio, wo.z)
        if not e.subsurface:
            return base
        return dr.lerp(base, flat, c["flatness"]["flatness"]) if e.diffuse else flat

    def specular(self, c, g, wi, wo, active):
        """Return ``D G wo.z / (4 (n·l)(n·v))``."""
        return (
            dr.square(g.h2 / (quadric(self.ggx(c)["q"], g) + TINY))
            * wo.z
            / (self.masking(c, wi, active) * self.masking(c, wo, active))
        )

    def clearcoat(self, c, g, s, wi, wo):
        """Return the clearcoat lobe with its strength, times ``wo.z``."""
        # Smith's masking for both directions, each 2c / (c + √(α² + (1 − α²) c²))
        a2 = model.COAT_MASKING_ALPHA**2
        roots = [c + dr.sqrt(dr.fma(1 - a2, dr.square(c), a2)) for c in (wi.z, wo.z)]
        masked, denominator = 4 * wi.z * wo.z, roots[0] * roots[1]
        fresnel = dr.fma(1 - COAT_F0, s, COAT_F0)
        coat = self.coat(c)
        return coat["scale"] * g.h2 * fresnel * wo.z * masked / (coat_quadric(coat["a2"], g) * denominator)

    def ggx(self, c):
        """Return the specular lobe's coefficients (:func:`ggx_coefficients`)."""
        return c["ggx"]

    def coat(self, c):
        """Return ``a2`` and ``scale`` of the clearcoat's GTR1."""
        return c["coat"]

    def masking(self, c, w, active=True):
        """Return :func:`.model.masking_denominator` of one direction."""
        return masking(self.ggx(c)["alpha2"], w)


def ggx_coefficients(ax, ay=None) -> dict:
    """Return the coefficients of GGX: α, its square for masking, and ``q`` with ``D = (|h|² / Σ q_k h_k²)²``.

    The sum has positive terms only: nothing cancels at the peak, and nothing overflows at roughness 0. Without ``ay``,
    the distribution is isotropic, and ``q`` has two coefficients.
    """
    if ay is None:
        root = math.sqrt(math.pi)
        return {"alpha": (ax, ax), "alpha2": (dr.square(ax),), "q": (root / ax, root * ax)}
    norm = dr.sqrt(dr.pi * ax * ay)
    ax2, ay2 = dr.square(ax), dr.square(ay)
    return {"alpha": (ax, ay), "alpha2": (ax2, ay2), "q": (norm / ax2, norm / ay2, norm)}


@dataclass
class Lobe:
    """Shape and ``weight`` of a specular lobe whose axes are not those of the frame.

    In place of α² stands the symmetric matrix ``A = α² [[1 + c, s], [s, 1 − c]]`` with ``c² + s² < 1``. The ``weight``,
    from 0 to 1, multiplies the lobe's values.
    """

    c: Any
    s: Any
    weight: Any


def sheared_ggx(alpha, lobe: Lobe) -> dict:
    """Return the coefficients of GGX with the matrix ``A`` of a lobe, and its ``weight``.

    ``alpha`` is the lower triangular ``L`` with ``A = L Lᵀ``, as ``(L_xx, L_yx, L_yy)``. ``alpha2`` and ``q`` are as in
    :func:`ggx_coefficients` and have the factor of ``x y`` at their end; ``q`` is that of ``A⁻¹``.
    """
    a2, c, s = dr.square(alpha), lobe.c, lobe.s
    root = dr.sqrt(1 - dr.square(c) - dr.square(s))
    norm = dr.sqrt(dr.pi * root) * alpha
    inverse = norm / (a2 * dr.square(root))
    corner = dr.sqrt(1 + c)
    return {
        "alpha": (alpha * corner, alpha * s / corner, alpha * root / corner),
        "alpha2": (a2 * (1 + c), a2 * (1 - c), 2 * a2 * s),
        "q": (inverse * (1 - c), inverse * (1 + c), norm, -2 * inverse * s),
        "weight": lobe.weight,
    }


def quadric(q, g):
    """Return ``Σ q_k h_k²``, with two coefficients for the isotropic form; a fourth one is that of ``h_x h_y``."""
    if len(q) == 2:
        return dr.fma(q[0], dr.square(g.h.x) + dr.square(g.h.y), q[1] * dr.square(g.h.z))
    total = dr.fma(q[0], dr.square(g.h.x), dr.fma(q[1], dr.square(g.h.y), q[2] * dr.square(g.h.z)))
    return total if len(q) == 3 else dr.fma(q[3], g.h.x * g.h.y, total)


def stretched(alpha2, w):
    """Return ``wᵀ A w`` of a direction's x and y: from one α², one for each axis, or those and the factor of x y."""
    if len(alpha2) == 1:
        return alpha2[0] * (dr.square(w.x) + dr.square(w.y))
    total = dr.fma(alpha2[0], dr.square(w.x), alpha2[1] * dr.square(w.y))
    return total if len(alpha2) == 2 else dr.maximum(dr.fma(alpha2[2], w.x * w.y, total), 0)


def masking(alpha2, w):
    """Return :func:`.model.masking_denominator` from one α² or one for each axis."""
    return w.z + dr.sqrt(dr.fma(w.z, w.z, stretched(alpha2, w)))


def coat_quadric(a2, g):
    """Return ``sin² + α² cos²`` of the half vector, times its squared length."""
    return dr.fma(a2, dr.square(g.h.z), dr.square(g.h.x) + dr.square(g.h.y)) + TINY


def warp_roughness(roughness):
    """Return the coordinate of a roughness in the encoder: ``√(r + c)``, mapped to [0, 1].

    GGX coefficients span decades where roughness is low; the eight entries of the encoder lie closer together there
    (0, 0.04, 0.12, 0.23, …). With ``c = 0.01`` the slope at roughness 0 stays finite.
    """
    return (dr.sqrt(roughness + _WARP) - math.sqrt(_WARP)) / (math.sqrt(1 + _WARP) - math.sqrt(_WARP))


def unwarp_roughness(u):
    """Invert :func:`warp_roughness`; rounding may leave the result slightly below 0."""
    root = u * (math.sqrt(1 + _WARP) - math.sqrt(_WARP)) + math.sqrt(_WARP)
    return root * root - _WARP


_WARP = 0.01


def _mix_tint(p, amount):
    return dr.fma(amount, model.tint(p.albedo, p.luminance) - 1, 1)
