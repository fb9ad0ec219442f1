"""Materials of the Disney BRDF, and how to evaluate the plugins with them."""

import disney_formulas
from bsdf_queries import bitmap

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
    "sheen_only": {**BLACK, "sheen": 1.0, "roughness": 1.0},
    "coat_only": {**BLACK, "roughness": 1.0, "clearcoat": 1.0, "clearcoat_gloss": 0.3},
    "glossy_coat": {**BLACK, "roughness": 1.0, "clearcoat": 1.0, "clearcoat_gloss": 1.0},
    "half_metal": {"metallic": 0.5, "base_color": (0.9, 0.6, 0.2), "roughness": 0.25, "clearcoat": 0.5},
    "smoothest": {"metallic": 1.0, "roughness": 0.0},
    "brushed_mirror": {"metallic": 1.0, "roughness": 0.05, "anisotropic": 1.0},
    "everything": {**dict.fromkeys(SCALARS, 1.0), "metallic": 0.5, "roughness": 0.3, "base_color": (1.0, 1.0, 1.0)},
}


def plugin(mi, form, material, **more):
    """A BSDF, or its description, of constants; what the material does not say is left to the defaults."""
    described = dict(material)
    if isinstance(described.get("base_color"), tuple):
        described["base_color"] = {"type": "rgb", "value": list(described["base_color"])}
    return {**(FORMS[form] if isinstance(form, str) else form), **described, **more}


def textured(mi, form, materials, **more):
    """One BSDF with a texel for each material, at the ``uv`` of :func:`.interactions`: nothing is constant."""
    full = [{**PLAIN, **m} for m in materials]
    # Mitsuba wants two rows of texels
    textures = {name: bitmap(mi, [[m[name] for m in full]] * 2) for name in ("base_color", *SCALARS)}
    return mi.load_dict(plugin(mi, form, textures, **more))


def smallest_alpha(material):
    """Roughness of the narrowest lobe of a material."""
    m = {**PLAIN, **material}
    coat = 0.1 - 0.099 * m["clearcoat_gloss"] if m["clearcoat"] > 0 else 1.0
    return min(max(m["roughness"] ** 2, 1e-3), coat)
