"""Content of maps by their names, as Poly Haven, ambientCG, Quixel, Substance, Unity and glTF write them.

The last words of a name decide, after a resolution, a file format and the like: ``Wood051_1K-JPG_Color``,
``brick_nor_gl_2k``, ``T_Wall_BaseColor``. What stands before them is the material's name.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

#: Roles of maps.
ROLES = ("albedo", "normal", "roughness", "ao", "metallic", "other")

#: Role → names. Those of ``"other"`` are colours (sRGB) or data (linear), some of which pack several maps.
ALBEDO = (
    *("albedo", "basecolor", "basecolour", "base", "basemap", "diff", "diffuse", "diffusecolor", "diffusecolour"),
    *("color", "colour", "col", "maintex", "albedotransparency"),
)
NORMAL = ("normal", "normals", "normalmap", "nrm", "nor", "norm")
ROUGHNESS = ("roughness", "rough", "specularroughness")
AO = ("ao", "occlusion", "ambientocclusion", "mixedao")
METALLIC = ("metallic", "metalness", "metal", "basemetalness")
COLOURS = ("emissive", "emission", "emit", "translucency", "speccolor", "specularcolor")
DATA = (
    *("data", "alpha", "opacity", "mask", "height", "disp", "displacement", "bump", "cavity", "curvature", "thickness"),
    *("spec", "specular", "gloss", "glossiness", "smoothness", "anisotropy", "transmission", "parallax", "refl"),
)
PACKED = (
    *("arm", "orm", "rma", "mra", "mro", "metallicroughness", "metalrough", "occlusionroughnessmetallic"),
    *("metallicsmoothness", "metallicgloss", "maskmap"),
)

#: Ends of the names of normal maps → whether y points down in the image's green channel, as DirectX has it.
NORMAL_FORMS = {
    "": False, "gl": False, "ogl": False, "opengl": False,
    "dx": True, "directx": True, "d3d": True,
}  # fmt: skip

#: Words before the others that name a further lobe: its colour is no albedo, its roughness not that of the material.
LOBES = {
    *("sheen", "specular", "spec", "coat", "clearcoat", "emission", "emissive", "subsurface", "transmission", "detail"),
    *("fuzz", "edge", "attenuation", "iridescence", "film", "volume"),
}

#: Words at the end that say nothing of the content, beside numbers and resolutions.
IGNORED = {"map", "texture", "tex", "jpg", "jpeg", "png", "exr", "tif", "tiff", "tga", "lod", "var", "udim"}

_WORD = re.compile(r"\d+[kK](?![a-zA-Z])|[dD]3[dD]|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclass(frozen=True)
class Content:
    """Content of a map: its ``role`` (:data:`ROLES`).

    ``colours``: values are colours, sRGB in images of 8 and 16 bits; ``packed``: channels are maps of their own;
    ``y_down``: normals of DirectX.
    """

    role: str
    colours: bool = False
    packed: bool = False
    y_down: bool = False


_CONTENTS = {
    **dict.fromkeys(ALBEDO, Content("albedo", colours=True)),
    **{name + form: Content("normal", y_down=down) for name in NORMAL for form, down in NORMAL_FORMS.items()},
    **dict.fromkeys(ROUGHNESS, Content("roughness")),
    **dict.fromkeys(AO, Content("ao")),
    **dict.fromkeys(METALLIC, Content("metallic")),
    **dict.fromkeys(COLOURS, Content("other", colours=True)),
    **dict.fromkeys(DATA, Content("other")),
    **dict.fromkeys(PACKED, Content("other", packed=True)),
}

#: Most words of a name of :data:`_CONTENTS`.
_LONGEST = 3


def content_of(name: str) -> Content | None:
    """Return the content of a map by its name, or by the name of its file without an extension; ``None`` if unknown."""
    words = [word.lower() for word in _WORD.findall(name)]
    for ignored in (False, True):  # "maskmap" is a name, the "map" of "normal_map" is not
        while ignored and words and (words[-1] in IGNORED or words[-1][0].isdigit()):
            words.pop()
        for count in range(min(_LONGEST, len(words)), 0, -1):
            text = "".join(words[-count:])
            content = _CONTENTS.get(text) or _CONTENTS.get(text.removesuffix("texture").removesuffix("map"))
            if content is not None:
                further = LOBES.intersection(words[:-count])
                return Content("other", content.colours) if further else content
    return None
