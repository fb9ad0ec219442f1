"""Reference model: Burley, *Physically Based Shading at Disney*, 2012.

All functions work on Dr.Jit arrays of one width, in the local frame with the normal (0, 0, 1), for unit directions
``wi`` (towards the viewer) and ``wo`` (towards the light) with positive cosines ``wi.z`` and ``wo.z``. Values for other
directions have no meaning, but none is NaN. Values include the cosine ``wo.z``, as in Mitsuba.

The colour is affine in the albedo and in its tint, ``albedo / luminance(albedo)``: ``f = albedo · a + tint · x + y``.
(The paper writes ``tint · x + y`` with ``a · luminance`` inside ``x``; apart, the derivative with respect to a black
albedo is right.) So the model only ever produces three scalars for each lobe (:func:`compose`), made of a few factors
(:class:`Factors`), and tables need to replace nothing but the factors.

Two choices where descriptions of the model differ: the specular reflectance at normal incidence is
``0.08 · specular`` (Burley; the paper's own evaluation uses 0.1), and the clearcoat's masking term is *not* divided
by ``4 (n·l)(n·v)``, as in Mitsuba's ``principled``.

Parts that a material does not use are neither traced nor read nor sampled (:func:`find_effects`, from the bounds of its
parameters). No value changes: each part has a factor that is exactly 0 for every value that the parameter can take.
"""

from dataclasses import dataclass, fields
from typing import Any

import drjit as dr

from ...arrays.boxes import ValueBounds
from ...arrays.lookup import clamp

#: Smallest GGX roughness α, as in Mitsuba's ``principled``.
ALPHA_MIN = 1e-3

#: Reflectance at normal incidence for ``specular = 1``.
SPECULAR_SCALE = 0.08

#: The clearcoat's fixed values: strength, Schlick's reflectance at normal incidence, α of its masking term.
COAT_STRENGTH, COAT_F0, COAT_MASKING_ALPHA = 0.25, 0.04, 0.25

#: The lobes, in the order of a BSDF's components.
LOBES = ("diffuse", "specular", "clearcoat")

#: Added to squared lengths before dividing. It is smaller than the squared half vector of directions 1e-6 rad from
#: opposite, and its inverse square, which derivatives contain, is still a finite float.
TINY = 1e-18


@dataclass
class Material:
    """The ten artist parameters, in [0, 1] each (``specular`` may be higher, for high indices of refraction)."""

    metallic: Any
    roughness: Any
    anisotropic: Any
    specular: Any
    spec_tint: Any
    sheen: Any
    sheen_tint: Any
    flatness: Any
    clearcoat: Any
    clearcoat_gloss: Any


PARAMETERS = tuple(f.name for f in fields(Material))


@dataclass
class Factors:
    """Factors that depend on the directions, each a scalar array.

    With ``c = wo.z``, ``s = (1 − l·h)^5`` and ``m`` = metallic:
    ``specular``: D · G · c / (4 (n·l)(n·v)); ``metal_base``: m (1 − s); ``base``: (1 − m)(1 − s);
    ``sheen``: (1 − m) s c; ``grazing``: s; ``diffuse``: base diffuse · c; ``flat``: subsurface approximation · c;
    ``clearcoat``: GTR1 · G · F · c without its strength.
    """

    specular: Any
    metal_base: Any
    base: Any
    sheen: Any
    grazing: Any
    diffuse: Any
    flat: Any
    clearcoat: Any


@dataclass
class Geometry:
    """Unnormalised half vector ``h = wi + wo``, its squared length, and the cosine between it and ``wo``."""

    h: Any
    h2: Any
    cos_d: Any


def geometry(wi, wo) -> Geometry:
    """Return the geometry of two unit vectors.

    ``l·h = |wi + wo| / 2`` needs no normalisation, and is no 0/0 where the directions are opposite.
    """
    h = wi + wo
    h2 = dr.squared_norm(h)
    return Geometry(h, h2, dr.minimum(0.5 * dr.sqrt(h2 + TINY), 1))


def positive(x):
    """Return ``max(x, 0)``, and 0 for NaN."""
    return dr.select(x > 0, x, 0)


def schlick(cosine):
    """Return (1 − cos)^5, and 0 for a cosine that rounding has made larger than 1."""
    m = dr.maximum(1 - cosine, 0)
    m2 = m * m
    return m2 * m2 * m


def roughness_to_alpha(roughness, anisotropic):
    """Return ``(α_x, α_y)``, each at least :data:`ALPHA_MIN`.

    They are roughness² divided by and multiplied with the aspect √(1 − 0.9 anisotropic).
    """
    aspect = dr.sqrt(1 - 0.9 * anisotropic)
    alpha = dr.square(roughness)
    return dr.maximum(alpha / aspect, ALPHA_MIN), dr.maximum(alpha * aspect, ALPHA_MIN)


def masking_denominator(w, ax, ay):
    """Return ``d(w) = c + √(c² + α_x² x² + α_y² y²)`` with ``c = w.z``.

    Smith's masking is ``G₁ = 2c / d``, and ``G / (4 (n·l)(n·v)) = 1 / (d(wi) d(wo))`` is finite at the horizon, where
    ``d ≥ min(α_x, α_y)``.
    """
    return w.z + dr.sqrt(dr.square(w.z) + dr.square(ax * w.x) + dr.square(ay * w.y))


def ggx(g: Geometry, ax, ay):
    """Return anisotropic GTR2 (GGX) for a half vector that need not be normalised."""
    stretched = dr.square(g.h.x / ax) + dr.square(g.h.y / ay) + dr.square(g.h.z)
    return dr.square(g.h2 / (stretched + TINY)) / (dr.pi * ax * ay)


def coat_alpha(gloss):
    """Return α of the clearcoat: mix(0.1, 0.001, gloss)."""
    return 0.1 + (0.001 - 0.1) * gloss


def gtr1(g: Geometry, alpha):
    """Return GTR1, with the denominator written as ``sin² + α² cos²``.

    The published form ``1 + (α² − 1) cos²`` cancels near the peak, to zero or below it.
    """
    a2 = dr.square(alpha)
    denominator = dr.square(g.h.x) + dr.square(g.h.y) + a2 * dr.square(g.h.z)
    return (a2 - 1) / (dr.pi * dr.log(a2)) * g.h2 / (denominator + TINY)


def coat_masking(cosine):
    """Return Smith's G₁ for the clearcoat's fixed α."""
    a2 = COAT_MASKING_ALPHA**2
    return 2 * cosine / (cosine + dr.sqrt(a2 + (1 - a2) * dr.square(cosine)))


def diffuse_factors(roughness, cos_d2, fresnel_sum, fresnel_product, cos_ratio, cos_o):
    """Return Burley's base diffuse and the Hanrahan–Krueger-inspired subsurface approximation, times ``cos_o``.

    The other arguments are ``(l·h)²``, ``F_L + F_V``, ``F_L F_V`` and ``cos_o / (cos_i + cos_o)``.
    """
    f90 = 2 * roughness * cos_d2
    k = f90 - 0.5
    diffuse = dr.fma(k, fresnel_sum + k * fresnel_product, 1) * cos_o
    k = 0.5 * f90 - 1
    fss = dr.fma(k, fresnel_sum + k * fresnel_product, 1)
    flat = 1.25 * (fss * (cos_ratio - 0.5 * cos_o) + 0.5 * cos_o)
    return positive(diffuse), positive(flat)  # against rounding, and approximate arguments


def exact_factors(material: Material, wi, wo) -> Factors:
    """Return the factors by the published formulas."""
    g = geometry(wi, wo)
    ax, ay = roughness_to_alpha(material.roughness, material.anisotropic)
    s = schlick(g.cos_d)
    fl, fv = schlick(wo.z), schlick(wi.z)
    ratio = wo.z / (wi.z + wo.z + TINY)
    diffuse, flat = diffuse_factors(material.roughness, dr.square(g.cos_d), fl + fv, fl * fv, ratio, wo.z)
    specular = ggx(g, ax, ay) * wo.z / (masking_denominator(wi, ax, ay) * masking_denominator(wo, ax, ay))
    coat_fresnel = COAT_F0 + (1 - COAT_F0) * s
    return Factors(
        specular=specular,
        metal_base=material.metallic * (1 - s),
        base=(1 - material.metallic) * (1 - s),
        sheen=(1 - material.metallic) * s * wo.z,
        grazing=s,
        diffuse=diffuse,
        flat=flat,
        clearcoat=gtr1(g, coat_alpha(material.clearcoat_gloss))
        * coat_masking(wi.z) * coat_masking(wo.z) * coat_fresnel * wo.z,
    )  # fmt: skip


def compose(material: Material, f: Factors, lobes=LOBES) -> dict[str, tuple]:
    """Return the scalars ``(a, x, y)`` of ``f = albedo · a + tint · x + y`` for each lobe, ≥ 0 if the factors are."""
    m = material
    parts = {}
    if "diffuse" in lobes:
        sheen = m.sheen * f.sheen
        parts["diffuse"] = (
            (1 - m.metallic) * dr.inv_pi * (f.diffuse * (1 - m.flatness) + f.flat * m.flatness),
            sheen * m.sheen_tint,
            sheen * (1 - m.sheen_tint),
        )
    if "specular" in lobes:
        f0 = SPECULAR_SCALE * m.specular
        parts["specular"] = (
            f.specular * f.metal_base,
            f.specular * f0 * m.spec_tint * f.base,
            f.specular * (f0 * (1 - m.spec_tint) * f.base + f.grazing),
        )
    if "clearcoat" in lobes:
        parts["clearcoat"] = (0, 0, COAT_STRENGTH * m.clearcoat * f.clearcoat)
    return parts


def colour(lobes, albedo, luminance):
    """Return ``albedo · a + tint · x + y``, summed over ``lobes``, an iterable of triples ``(a, x, y)``."""
    total = [0, 0, 0]
    for lobe in lobes:
        total = [a + b for a, b in zip(total, lobe, strict=True)]
    a, x, y = total
    return albedo * a + tint(albedo, luminance) * x + y


def tint(albedo, luminance):
    """Return ``albedo / luminance``, which tends to 1 for black; its slope stays below 10⁵."""
    return (albedo + 1e-5) / (luminance + 1e-5)


def specular_from_eta(eta):
    """Return ``specular`` of a relative index of refraction: reflectance ((η − 1)/(η + 1))² in units of 0.08."""
    return dr.square((eta - 1) / (eta + 1)) / SPECULAR_SCALE


def sanitize(material: Material) -> Material:
    """Clamp every parameter to [0, 1], NaN to 0, since textures and optimisers overshoot."""
    return Material(**{name: clamp(getattr(material, name), 0.0, 1.0) for name in PARAMETERS})


@dataclass(frozen=True)
class Effects:
    """Parts of the model in use.

    ``diffuse``: Burley's base diffuse; ``subsurface``: its Hanrahan–Krueger-like alternative; ``sheen``, and
    ``sheen_tint``, its tint; ``metal``: reflection coloured by the albedo; ``dielectric``: colourless reflection at
    normal incidence, and ``spec_tint``, its tint; ``anisotropic``: a stretched highlight; ``clearcoat``.

    The specular lobe's reflection towards grazing angles (Schlick's ``(1 − l·h)^5``) is always in use.
    """

    diffuse: bool = True
    subsurface: bool = True
    sheen: bool = True
    sheen_tint: bool = True
    metal: bool = True
    dielectric: bool = True
    spec_tint: bool = True
    anisotropic: bool = True
    clearcoat: bool = True

    @property
    def lobes(self) -> tuple[str, ...]:
        """Lobes (components of the BSDF) in use, in the order of :data:`LOBES`."""
        diffuse = ("diffuse",) if self.diffuse or self.subsurface or self.sheen else ()
        return (*diffuse, "specular", *(("clearcoat",) if self.clearcoat else ()))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts in use."""
        return tuple(f.name for f in fields(self) if getattr(self, f.name))


def find_effects(bounds: dict[str, ValueBounds]) -> tuple[Effects, dict[str, str]]:
    """Return the effects in use, and for each of the others the reason, in words, why it is not in use.

    ``bounds`` maps ``base_color`` and the names of :data:`PARAMETERS` to their bounds; a missing parameter may
    have any value. Parameters that are being optimised keep their effect, and its derivative, whatever their value.
    """
    k = {name: bounds.get(name, ValueBounds()) for name in ("base_color", *PARAMETERS)}
    reasons: dict[str, str] = {}

    def unless(effect: str, *causes: tuple[bool, str]) -> None:
        for applies, reason in causes:
            if applies:
                reasons.setdefault(effect, reason)

    all_metal = (k["metallic"].is_always(1), "metallic is 1")
    black = (k["base_color"].is_always(0), "base_color is black")
    grey = (k["base_color"].grey and not k["base_color"].optimised, "base_color has no hue")

    def zero(name: str) -> tuple[bool, str]:
        return k[name].is_always(0), f"{name} is 0"

    unless("diffuse", all_metal, black, (k["flatness"].is_always(1), "flatness is 1"))
    unless("subsurface", zero("flatness"), all_metal, black)
    unless("sheen", zero("sheen"), all_metal)
    unless("metal", zero("metallic"))
    unless("dielectric", zero("specular"), all_metal)
    unless("anisotropic", zero("anisotropic"))
    unless("clearcoat", zero("clearcoat"))
    unless("sheen_tint", zero("sheen_tint"), ("sheen" in reasons, "no sheen to tint"), grey)
    unless("spec_tint", zero("spec_tint"), ("dielectric" in reasons, "no dielectric reflection to tint"), grey)
    return Effects(**{f.name: f.name not in reasons for f in fields(Effects)}), reasons
