"""
The maps of a material as parameters of the Disney BRDF, and what light it sends where.

Values are π · BRDF · cosine of the light, linear: a white Lambertian surface that is lit along its normal has 1.
Directions are in the frame of the surface, ``wi`` towards the viewer, ``wo`` towards the light. A normal map perturbs
the frame as Mitsuba's ``normalmap`` does, with its shadowing function (Estevez et al., *A Microfacet-Based Shadowing
Function to Solve the Bump Terminator Problem*, Ray Tracing Gems 2019) and its flip of normals that face away.

Maps are known by their kind: albedo, normal, roughness, metallic. What a material does not have is as in the plugin
``disney``. Ambient occlusion is not shaded, no more than ``disney`` and ``principled`` do, nor are other maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ... import srgb
from ...bounds import ValueBounds
from ...compat import module_of
from ...errors import UsageError
from ...maps.compressed import FilteredMaps
from ...maps.layout import Layout, MapLayout
from ..disney import TASK as DISNEY
from ..disney.decoder import Decoder
from ..disney.effects import Effects, find_effects
from ..disney.model import PARAMETERS, Material, sanitize
from ..disney.training import shade
from .clip import clipped

#: Values of parameters that no map has, as in the plugin ``disney``.
DEFAULTS = {**dict.fromkeys(PARAMETERS, 0.0), "roughness": 0.5, "specular": 0.5}

#: Kinds of maps that shading reads, and how many channels each may have.
READ = {"albedo": (1, 3), "normal": (3,), "roughness": (1,), "metallic": (1,)}


@dataclass
class SurfaceParameters:
    """
    The material at a place: ``albedo``, a linear colour; ``normal``, of any length, in the frame of the surface;
    ``roughness`` and ``metallic``. What no map has is a number, and the normal ``None``.
    """

    albedo: Any
    normal: Any
    roughness: Any
    metallic: Any


def maps_of(layout: Layout) -> dict[str, MapLayout]:
    """The maps that shading reads, by their kind. Raises :class:`UsageError` if it cannot read them."""
    found = {}
    for m in layout.maps:
        if m.role not in READ:
            continue
        if m.role in found:
            raise UsageError(f'map "{m.name}": found a second {m.role} beside "{found[m.role].name}", one is allowed')
        if m.channels not in READ[m.role]:
            allowed = " or ".join(map(str, READ[m.role]))
            raise UsageError(f'map "{m.name}": found {m.channels} channels, allowed for {m.role} are {allowed}')
        found[m.role] = m
    if not found:
        raise UsageError(f"source: found no map that shading reads, these are {', '.join(READ)}")
    return found


def left_out(layout: Layout) -> dict[str, str]:
    """Map → why it is not shaded."""
    reason = "the BRDF has no such parameter, its loss is that of a texture"
    return {m.name: reason for m in layout.maps if m.role not in READ}


def effects_of(layout: Layout) -> tuple[Effects, dict[str, str]]:
    """The effects that a material makes use of, and the reasons for what is left out (:func:`.find_effects`)."""
    known = {name: ValueBounds(value, value) for name, value in DEFAULTS.items()}
    for kind, m in maps_of(layout).items():
        name = "base_color" if kind == "albedo" else kind
        if kind == "normal":
            continue
        constants = [w[1] for w in m.where if isinstance(w, tuple)]
        # What is stored twice is stored once: an albedo of one stored channel is grey
        grey = len({w for w in m.where}) == 1
        known[name] = ValueBounds(grey=grey)
        if len(constants) == m.channels:
            known[name] = ValueBounds(min(constants), max(constants), grey=grey)
    return find_effects(known)


def linear(values, m: MapLayout):
    """The channels of a map, linear: the sRGB transfer function backwards, where it is encoded so."""
    if m.color_space != "srgb":
        return values
    return [srgb.to_linear(v) for v in values]


def surface_of(maps: FilteredMaps, stored: list) -> SurfaceParameters:
    """The material at places of which ``stored`` are the stored channels."""
    found = maps_of(maps.layout)
    read = maps.maps(stored, [m.name for m in found.values()])
    channels = {kind: linear(read[m.name], m) for kind, m in found.items()}
    array = next((v for values in channels.values() for v in values if dr.is_jit_v(v)), None)
    types = None if array is None else module_of(array)

    def vector(values):
        return types.Array3f(values * 3 if len(values) == 1 else values)

    albedo = channels.get("albedo", [DEFAULT_ALBEDO])
    normal = channels.get("normal")
    if types is None:  # constant maps alone: the caller's arrays decide
        raise UsageError("source: all of its maps are constant, there is nothing to learn")
    if normal is not None:
        signed = found["normal"].low < 0
        normal = vector(normal) if signed else 2 * vector(normal) - 1
    one = {kind: channels[kind][0] if kind in channels else DEFAULTS[kind] for kind in ("roughness", "metallic")}
    return SurfaceParameters(vector(albedo), normal, **one)


#: The colour of a material without an albedo, as the plugin ``disney`` has it.
DEFAULT_ALBEDO = 0.5


def shaded(decoder: Decoder | None, surface: SurfaceParameters, wi, wo, effects: Effects, limit: float | None = None):
    """
    π · BRDF · cosine, a colour, from ``decoder`` (``None``: straight from the formulas). ``limit``: bound of the
    derivatives that flow back through the specular lobe, which has no other (:mod:`.clip`).
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
    # What is not visible is looked at from above, so that nothing it has can become NaN
    up = type(wi)(0, 0, 1)
    wi_local, wo_local = dr.select(visible, wi_local, up), dr.select(visible, wo_local, up)
    given = {"roughness": Float(surface.roughness), "metallic": Float(surface.metallic)}
    material = sanitize(Material(**{**{n: Float(v) for n, v in DEFAULTS.items()}, **given}))
    albedo = dr.maximum(surface.albedo, 0)
    if limit is None or "specular" not in effects.lobes:
        value = shade(decoder, material, albedo, wi_local, wo_local, effects)
    else:
        rest = tuple(lobe for lobe in effects.lobes if lobe != "specular")
        bounded = Material(**{name: clipped(getattr(material, name), limit) for name in PARAMETERS})
        inputs = [clipped(x, limit) for x in (albedo, wi_local, wo_local)]
        value = shade(decoder, bounded, *inputs, effects, ("specular",))
        if rest:
            value = value + shade(decoder, material, albedo, wi_local, wo_local, effects, rest)
    return dr.select(visible, dr.pi * shadow * value, 0)


def frame(normal, wi) -> tuple:
    """
    Tangent, bitangent and normal of a perturbed frame, as Mitsuba's ``normalmap`` makes it of a surface whose tangent
    is x: a normal that faces away from the viewer is mirrored at the surface's.
    """
    length = dr.squared_norm(normal)
    n = dr.select(length > 1e-12, normal * dr.rsqrt(dr.maximum(length, 1e-12)), type(normal)(0, 0, 1))
    away = wi.z * dr.dot(wi, n) <= 0
    n = type(n)(dr.select(away, -n.x, n.x), dr.select(away, -n.y, n.y), n.z)
    s = type(n)(1 - n.x * n.x, -n.x * n.y, -n.x * n.z)
    s = s * dr.rsqrt(dr.maximum(dr.squared_norm(s), 1e-12))
    return s, dr.cross(n, s), n


def shadowing(n, wo):
    """
    The shadowing function of a perturbed normal for a direction above the surface, 2 c / (c + √(c² + α² sin²)), with
    α² = min(⅛ tan², 1) of the normal.
    """
    cos2, c = dr.square(n.z), wo.z
    alpha2 = dr.minimum(0.125 * dr.maximum(1 - cos2, 0) / dr.maximum(cos2, 1e-6), 1)
    root = dr.sqrt(dr.square(c) + alpha2 * dr.maximum(1 - dr.square(c), 0) + 1e-12)
    return 2 * c / (c + root)


def frozen_decoder(types, preset: str = "", storage: str = "uint8") -> Decoder:
    """The tables of the plugin ``neural_disney``, which nothing here changes."""
    return DISNEY.open(types.TensorXf, preset=preset, storage=storage).decoder
