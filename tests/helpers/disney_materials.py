"""Materials of the Disney BRDF, and how to evaluate the plugins with them."""

import disney_formulas
import drjit as dr
import numpy as np
from arrays import aligned

PRESETS = ("tables", "paper")

#: The exact plugin, and the learned one in each preset, with entries that can be optimised.
FORMS = {
    "disney": {"type": "disney"},
    **{p: {"type": "neural_disney", "preset": p, "storage": "float32"} for p in PRESETS},
}

SCALARS = disney_formulas.NAMES

#: Everything on, nothing at a limit or at a texel of the tables, where their slope changes.
RICH = {
    "base_color": (0.7, 0.4, 0.2), "roughness": 0.43, "anisotropic": 0.5, "metallic": 0.3, "specular": 0.6,
    "spec_tint": 0.4, "sheen": 0.5, "sheen_tint": 0.6, "flatness": 0.3, "clearcoat": 0.7, "clearcoat_gloss": 0.63,
}  # fmt: skip

#: What is not said is as in the plugins' defaults.
PLAIN = {**dict.fromkeys(SCALARS, 0.0), "base_color": (0.5, 0.5, 0.5), "roughness": 0.5, "specular": 0.5}

BLACK = {"base_color": (0.0, 0.0, 0.0), "specular": 0.0}

MATERIALS = {
    "rich": RICH,
    "plain": {},
    "diffuse": {"roughness": 1.0, "specular": 0.0},
    "flat": {"flatness": 1.0, "roughness": 0.8, "base_color": (0.9, 0.1, 0.1)},
    "sheen_only": {**BLACK, "sheen": 1.0, "roughness": 1.0},
    "tinted_sheen": {"base_color": (0.3, 0.1, 0.6), "sheen": 1.0, "sheen_tint": 1.0},
    "coat_only": {**BLACK, "roughness": 1.0, "clearcoat": 1.0, "clearcoat_gloss": 0.3},
    "glossy_coat": {**BLACK, "roughness": 1.0, "clearcoat": 1.0, "clearcoat_gloss": 1.0},
    "metal": {"metallic": 1.0, "roughness": 0.3},
    "half_metal": {"metallic": 0.5, "base_color": (0.9, 0.6, 0.2), "roughness": 0.25, "clearcoat": 0.5},
    "smooth_metal": {"metallic": 1.0, "roughness": 0.2},
    "mirror": {"metallic": 1.0, "roughness": 0.05},
    "smoothest": {"metallic": 1.0, "roughness": 0.0},
    "smooth_plastic": {"roughness": 0.05, "base_color": (0.2, 0.2, 0.7), "spec_tint": 1.0},
    "anisotropic": {"metallic": 1.0, "roughness": 0.5, "anisotropic": 1.0},
    "brushed_mirror": {"metallic": 1.0, "roughness": 0.05, "anisotropic": 1.0},
    "rough_metal": {"metallic": 1.0, "roughness": 1.0},
    "everything": {**dict.fromkeys(SCALARS, 1.0), "metallic": 0.5, "roughness": 0.3, "base_color": (1.0, 1.0, 1.0)},
}


def plugin(mi, form, material, **more):
    """A BSDF, or its description, of constants; what the material does not say is left to the defaults."""
    described = dict(material)
    if isinstance(described.get("base_color"), tuple):
        described["base_color"] = {"type": "rgb", "value": list(described["base_color"])}
    return {**(FORMS[form] if isinstance(form, str) else form), **described, **more}


def bitmap(mi, values, **more):
    """A texture of ``values``, (height, width[, channels]), read as they are."""
    values = np.asarray(values, np.float32)
    data = mi.TensorXf(aligned(values.reshape(*values.shape[:2], -1)))
    return {"type": "bitmap", "data": data, "raw": True, "filter_type": "nearest", "format": "variant", **more}


def textured(mi, form, materials, **more):
    """One BSDF with a texel for each material, read at ``uv`` by :func:`interactions`: nothing about it is constant."""
    full = [{**PLAIN, **m} for m in materials]
    # Mitsuba wants two rows of texels
    textures = {name: bitmap(mi, [[m[name] for m in full]] * 2) for name in ("base_color", *SCALARS)}
    return mi.load_dict(plugin(mi, form, textures, **more))


def interactions(mi, wi, material=None, count=1):
    """Interactions that see ``wi``, at the texels of :func:`textured` with the numbers ``material`` (of ``count``)."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(wi))
    si.wi = wi
    if material is not None:
        si.uv = mi.Point2f(mi.Float(aligned((np.asarray(material) + 0.5) / count)), 0.5)
    if mi.is_spectral:
        si.wavelengths = mi.UnpolarizedSpectrum(450, 520, 580, 650)
    return si


def random_directions(rng, n, low=0.0, high=1.0):
    """(n, 3), uniform over the part of the hemisphere with cosines in [low, high]."""
    z = low + (high - low) * rng.random(n)
    phi, r = 2 * np.pi * rng.random(n), np.sqrt(1 - z * z)
    return np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1).astype(np.float32)


def vectors(mi, w):
    return mi.Vector3f(aligned(w.T))


def uniform(mi, rng, n):
    u = [mi.Float(aligned(rng.random(n))) for _ in range(3)]
    return u[0], mi.Point2f(u[1], u[2])


def contexts(mi):
    """Name → a context, and the components that it turns on."""
    found = {"all": (mi.BSDFContext(), (0, 1, 2))}
    for component in range(3):
        ctx = mi.BSDFContext()
        ctx.component = component
        found[f"component {component}"] = ctx, (component,)
    for flag, components in (("DiffuseReflection", (0,)), ("GlossyReflection", (1, 2)), ("DeltaReflection", ())):
        ctx = mi.BSDFContext()
        ctx.type_mask = getattr(mi.BSDFFlags, flag)
        found[flag] = ctx, components
    return found


def close(a, b, rtol=1e-5, scale=1e-5):
    """Equal up to rounding, relative to the value and to the largest value in its row."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    return np.abs(a - b) <= rtol * np.maximum(np.abs(a), np.abs(b)) + rtol * scale * np.abs(b).max(initial=1e-3)


def with_cosines(rng, cosines):
    """Directions with given cosines, (n, 3) in float32, as exactly unit vectors as that allows."""
    phi = 2 * np.pi * rng.random(len(cosines))
    r = np.sqrt(1 - np.square(cosines))
    return np.stack([r * np.cos(phi), r * np.sin(phi), cosines], axis=1).astype(np.float32)
