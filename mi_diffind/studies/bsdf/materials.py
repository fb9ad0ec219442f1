"""Materials of the study of learned BSDFs, as dictionaries of Mitsuba."""

from __future__ import annotations


def _rgb(*value):
    return {"type": "rgb", "value": list(value)}


def _plastic(alpha, *colour, **more):
    return {"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": _rgb(*colour), **more}


def _metal(material, alpha, distribution="ggx"):
    return {"type": "roughconductor", "material": material, "alpha": alpha, "distribution": distribution}


def _blend(weight, a, b):
    return {"type": "blendbsdf", "weight": weight, "a": a, "b": b}


#: Material → its plugin, and the size of the arrays.
MATERIALS = {
    "principled, coat + sheen": ({
        "type": "principled", "base_color": _rgb(0.7, 0.25, 0.1), "roughness": 0.35, "metallic": 0.2, "clearcoat": 1.0,
        "clearcoat_gloss": 0.8, "sheen": 0.6, "sheen_tint": 0.4,
    }, "2k"),
    "plastic, nonlinear": (_plastic(0.1, 0.1, 0.27, 0.36, nonlinear=True), "2k"),
    "plastic and Beckmann gold": (_blend(0.4, _plastic(0.2, 0.5, 0.1, 0.1), _metal("Au", 0.15, "beckmann")), "2k"),
    "blend of four": (
        _blend(
            0.5,
            _blend(0.5, {"type": "diffuse", "reflectance": _rgb(0.2, 0.5, 0.3)}, _plastic(0.05, 0.5, 0.5, 0.5)),
            _blend(0.5, _metal("Al", 0.3), {"type": "principled", "roughness": 0.6, "base_color": _rgb(0.6, 0.5, 0.1)}),
        ), "2k"),
    "GGX copper, α 0.01": (_metal("Cu", 0.01), "2k"),
    "Beckmann chrome, α 0.1": (_metal("Cr", 0.1, "beckmann"), "2k"),
    "Beckmann copper, α 0.01": (_metal("Cu", 0.01, "beckmann"), "2k"),
    "diffuse": ({"type": "diffuse", "reflectance": _rgb(0.2, 0.5, 0.9)}, "2k"),
    "anisotropic aluminium": (
        {"type": "roughconductor", "material": "Al", "alpha_u": 0.05, "alpha_v": 0.3, "distribution": "ggx"}, "8k",
    ),
}  # fmt: skip

#: Materials of a quick study.
QUICK = ("plastic, nonlinear",)
