"""Shading of a material: its maps as parameters of the Disney BRDF, and the reflected light.

Values are π · BRDF · cosine of the light, linear: a white Lambertian surface that is lit along its normal has 1.
Directions are in the frame of the surface, ``wi`` towards the viewer, ``wo`` towards the light. A normal map perturbs
the frame as Mitsuba's ``normalmap`` does, with its shadowing function (Estevez et al., *A Microfacet-Based Shadowing
Function to Solve the Bump Terminator Problem*, Ray Tracing Gems 2019) and its flip of normals that face away.

Maps are known by their role: albedo, normal, roughness, metallic. A missing parameter has the default of the plugin
``disney``. Ambient occlusion and other maps are not shaded, since ``disney`` and ``principled`` have no such parameter.
"""

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ...arrays.boxes import ValueBounds
from ...core.compat import backend_module
from ...core.errors import UsageError
from ...images import srgb
from ...maps.layout import Layout, MapLayout, different_transforms
from ...maps.pyramid import FilteredMaps
from ..disney import TASK as DISNEY
from ..disney.decoder import Decoder, Lobe
from ..disney.model import PARAMETERS, Effects, Material, find_effects, sanitize
from ..disney.training import shade
from .compressed import NEUTRAL

#: Values of parameters without a map, the defaults of the plugin ``disney``.
DEFAULTS = {**dict.fromkeys(PARAMETERS, 0.0), "roughness": 0.5, "specular": 0.5}

#: Roles of maps that shading reads, and their allowed numbers of channels.
READ = {"albedo": (1, 3), "normal": (3,), "roughness": (1,), "metallic": (1,)}


@dataclass
class SurfaceParameters:
    """Parameters of the material at a point.

    ``albedo``: a linear colour; ``normal``: of any length, in the frame of the surface, ``None`` without a map;
    ``roughness`` and ``metallic``: arrays, or numbers without a map; ``lobe``: shape of the specular lobe, ``None``
    without extras.
    """

    albedo: Any
    normal: Any
    roughness: Any
    metallic: Any
    lobe: Lobe | None = None


def maps_of(layout: Layout) -> dict[str, MapLayout]:
    """Return the maps that shading reads, by role. Raises :class:`UsageError` for maps that it cannot read."""
    by_role = {}
    for m in layout.maps:
        if m.role not in READ:
            continue
        if m.role in by_role:
            raise UsageError(f'map "{m.name}": found a second {m.role} beside "{by_role[m.role].name}", one is allowed')
        if m.channels not in READ[m.role]:
            allowed = " or ".join(map(str, READ[m.role]))
            raise UsageError(f'map "{m.name}": found {m.channels} channels, allowed for {m.role} are {allowed}')
        by_role[m.role] = m
    if not by_role:
        raise UsageError(f"source: found no map that shading reads, these are {', '.join(READ)}")
    if fault := different_transforms(by_role.values()):
        raise UsageError(f"source: {fault}")
    return by_role


def varies_shading(layout: Layout) -> bool:
    """Return whether footprints show another shading than the mean of their maps: normals or roughness vary."""
    return any(m.role in ("normal", "roughness") and m.varies for m in layout.maps)


def left_out(layout: Layout) -> dict[str, str]:
    """Return the names of maps that are not shaded, each with the reason."""
    reason = "the BRDF has no such parameter, its loss is that of a texture"
    return {m.name: reason for m in layout.maps if m.role not in READ}


def material_effects(layout: Layout) -> tuple[Effects, dict[str, str]]:
    """Return the effects of a material, and the reasons for effects that are left out (:func:`.find_effects`)."""
    bounds = {name: ValueBounds(value, value) for name, value in DEFAULTS.items()}
    for role, m in maps_of(layout).items():
        name = "base_color" if role == "albedo" else role
        if role == "normal":
            continue
        constants = [w[1] for w in m.where if isinstance(w, tuple)]
        ends = (min(constants), max(constants)) if len(constants) == m.channels else ()
        bounds[name] = ValueBounds(*ends, grey=len(set(m.where)) == 1)  # equal channels are stored once
    return find_effects(bounds)


#: Largest length of (c, s) of a lobe.
SHEAR = 0.95


def specular_lobe(extra: list) -> Lobe:
    """Return the shape of a specular lobe from extras, numbers in [0, 1] (:data:`.compressed.NEUTRAL`: a round one)."""
    c, s = (2 * (x - n) for x, n in zip(extra[:2], NEUTRAL, strict=False))
    scale = SHEAR * dr.rsqrt(dr.maximum(dr.square(c) + dr.square(s), SHEAR**2))
    return Lobe(c * scale, s * scale, extra[2])


def surface_of(maps: FilteredMaps, stored: list, extra: list | None = None) -> SurfaceParameters:
    """Return the material at points with the stored channels ``stored``, and extras, if there are any."""
    by_role = maps_of(maps.layout)
    read = maps.maps(stored, [m.name for m in by_role.values()])
    channels = {
        role: [srgb.to_linear(v, fused=False) for v in read[m.name]] if m.color_space == "srgb" else read[m.name]
        for role, m in by_role.items()
    }
    array = next((v for values in channels.values() for v in values if dr.is_jit_v(v)), None)
    types = None if array is None else backend_module(array)

    def vector(values):
        return types.Array3f(values * 3 if len(values) == 1 else values)

    albedo = channels.get("albedo", [DEFAULT_ALBEDO])
    normal = channels.get("normal")
    if types is None:  # constant maps alone: the caller's arrays decide
        raise UsageError("source: all of its maps are constant, there is nothing to learn")
    if normal is not None:
        signed = by_role["normal"].low < 0
        normal = vector(normal) if signed else 2 * vector(normal) - 1
    numbers = {n: channels[n][0] if n in channels else DEFAULTS[n] for n in ("roughness", "metallic")}
    return SurfaceParameters(vector(albedo), normal, **numbers, lobe=None if extra is None else specular_lobe(extra))


#: Colour of a material without an albedo, the default of the plugin ``disney``.
DEFAULT_ALBEDO = 0.5


def shaded(decoder: Decoder | None, surface: SurfaceParameters, wi, wo, effects: Effects, limit: float | None = None):
    """Return π · BRDF · cosine, a colour, from ``decoder`` (``None``: from the formulas).

    ``limit``: bound of the derivatives that flow back through the specular lobe (:func:`clipped`).
    """
    Float = type(wi.x)
    wi_local, wo_local, shadow = wi, wo, 1
    visible = (wi.z > 0) & (wo.z > 0)
    if surface.normal is not None:
        s, t, n = frame(surface.normal, wi)
        wi_local = type(wi)(dr.dot(wi, s), dr.dot(wi, t), dr.dot(wi, n))
        wo_local = type(wo)(dr.dot(wo, s), dr.dot(wo, t), dr.dot(wo, n))
        shadow = shadowing(n, wo)
        visible &= (wi_local.z > 0) & (wo_local.z > 0)
    # Invisible points are evaluated from above, so that no value can become NaN
    up = type(wi)(0, 0, 1)
    wi_local, wo_local = dr.select(visible, wi_local, up), dr.select(visible, wo_local, up)
    given = {"roughness": Float(surface.roughness), "metallic": Float(surface.metallic)}
    material = sanitize(Material(**{**{n: Float(v) for n, v in DEFAULTS.items()}, **given}))
    albedo, lobe = dr.maximum(surface.albedo, 0), surface.lobe
    if limit is None or "specular" not in effects.lobes:
        value = shade(decoder, material, albedo, wi_local, wo_local, effects, lobe=lobe)
    else:
        rest = tuple(lobe for lobe in effects.lobes if lobe != "specular")
        bounded = Material(**{name: clipped(getattr(material, name), limit) for name in PARAMETERS})
        inputs = [clipped(x, limit) for x in (albedo, wi_local, wo_local)]
        lobe = None if lobe is None else Lobe(*(clipped(x, limit) for x in (lobe.c, lobe.s, lobe.weight)))
        value = shade(decoder, bounded, *inputs, effects, ("specular",), lobe)
        if rest:
            value = value + shade(decoder, material, albedo, wi_local, wo_local, effects, rest)
    return dr.select(visible, dr.pi * shadow * value, 0)


def frame(normal, wi) -> tuple:
    """Return tangent, bitangent and normal of a perturbed frame, as Mitsuba's ``normalmap`` does for the tangent x.

    A normal that faces away from the viewer is mirrored at the surface's normal.
    """
    length = dr.squared_norm(normal)
    n = dr.select(length > 1e-12, normal * dr.rsqrt(dr.maximum(length, 1e-12)), type(normal)(0, 0, 1))
    away = wi.z * dr.dot(wi, n) <= 0
    n = type(n)(dr.select(away, -n.x, n.x), dr.select(away, -n.y, n.y), n.z)
    s = type(n)(1 - n.x * n.x, -n.x * n.y, -n.x * n.z)
    s = s * dr.rsqrt(dr.maximum(dr.squared_norm(s), 1e-12))
    return s, dr.cross(n, s), n


def shadowing(n, wo):
    """Return the shadowing function of a perturbed normal for a direction above the surface.

    It is 2 c / (c + √(c² + α² sin²)), with α² = min(⅛ tan², 1) of the normal.
    """
    cos2, c = dr.square(n.z), wo.z
    alpha2 = dr.minimum(0.125 * dr.maximum(1 - cos2, 0) / dr.maximum(cos2, 1e-6), 1)
    root = dr.sqrt(dr.square(c) + alpha2 * dr.maximum(1 - dr.square(c), 0) + 1e-12)
    return 2 * c / (c + root)


def frozen_decoder(types, preset: str = "", storage: str = "uint8") -> Decoder:
    """Return the decoder of the plugin ``neural_disney``; training does not change its tables."""
    return DISNEY.open(types.TensorXf, preset=preset, storage=storage).decoder


class _Clipped(dr.CustomOp):
    """Identity with a limited derivative; a derivative of NaN becomes 0."""

    def eval(self, value, limit):
        self.limit = limit
        self.add_input(value)
        return dr.detach(value)

    def forward(self):
        self.set_grad_out(self._limited(self.grad_in("value")))

    def backward(self):
        self.set_grad_in("value", self._limited(self.grad_out()))

    def _limited(self, gradient):
        limited = dr.clip(gradient, -self.limit, self.limit)
        return dr.select(dr.isnan(gradient), 0, limited)

    def name(self):
        return "clipped"


def clipped(value, limit: float):
    """Return ``value``, a float or vector of Dr.Jit, unchanged, with its incoming derivatives limited to ±``limit``.

    The remedy for the unbounded derivatives of highlights (supplemental 1.5). NaN becomes 0. Numbers, and values
    without gradients, are returned as they are.
    """
    if not dr.is_jit_v(value) or not dr.grad_enabled(value):
        return value
    return dr.custom(_Clipped, value, limit)
