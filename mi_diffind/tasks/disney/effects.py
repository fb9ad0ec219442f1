"""Parts of the Disney BRDF that a material uses, derived from the bounds of its parameters before rendering.

Parts that are not in use are neither traced nor read nor sampled. This changes no value: each part has a factor that is
exactly 0 for every value that the parameter can take.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

from ...arrays.boxes import ValueBounds
from .model import PARAMETERS


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
        """Lobes (components of the BSDF) in use, in the order of :data:`.model.LOBES`."""
        diffuse = ("diffuse",) if self.diffuse or self.subsurface or self.sheen else ()
        return (*diffuse, "specular", *(("clearcoat",) if self.clearcoat else ()))

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parts in use."""
        return tuple(f.name for f in fields(self) if getattr(self, f.name))


def find_effects(bounds: dict[str, ValueBounds]) -> tuple[Effects, dict[str, str]]:
    """Return the effects in use, and for each of the others the reason, in words, why it is not in use.

    ``bounds`` maps ``base_color`` and the names of :data:`.model.PARAMETERS` to their bounds; a missing parameter may
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
