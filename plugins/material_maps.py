"""All maps of a material's file, read at one footprint: a part of ``neural_material``; no plugin."""

from __future__ import annotations  # Delayed parsing of type annotations

from collections.abc import Iterator

import mitsuba as mi

from mi_diffind.maps.layout import Layout, MapLayout
from mi_diffind.tasks.disney.decoder import Lobe
from mi_diffind.tasks.disney.model import PARAMETERS
from mi_diffind.tasks.shading.material import lobe_of
from mi_diffind.tasks.texture import TASK

from .filtered_texture import FilteredTexture
from .support.filtering import anisotropic, isotropic
from .support.image_files import SharedMaps, open_compressed

#: Role of a map → the parameter that it is of.
ROLES = {"albedo": "base_color", "normal": "normal", "roughness": "roughness", "metallic": "metallic"}

#: Other name of a map → the parameter that it is of.
NAMES = {**{name: name for name in PARAMETERS}, "subsurface": "flatness", "opacity": "opacity", "alpha": "opacity"}

#: Role or name of a map that a BSDF does not read → the reason.
UNREAD = {
    "ao": "the BRDF has no such parameter",
    "emission": "a BSDF emits no light: give the shape an area emitter with a neural_texture",
}
UNREAD["emissive"] = UNREAD["emission"]

#: Parameter → allowed numbers of channels; (1,) for all others.
CHANNELS = {"base_color": (1, 3), "normal": (3,)}


def material_maps(layout: Layout, ignored: tuple[str, ...] = ()) -> tuple[dict[str, MapLayout], dict[str, str]]:
    """Return the maps of a material by parameter, and for each of the others the reason why it is not read.

    Raises ``RuntimeError`` for maps that are no parameters, and for names of ``ignored`` that the file lacks.
    """
    for name in ignored:
        if name not in layout.names:
            raise RuntimeError(f'parameter "ignore": found "{name}", the file holds {", ".join(layout.names)}')
    maps, left_out = {}, {}
    for m in layout.maps:
        name = m.name.lower()
        parameter = ROLES.get(m.role) or NAMES.get(name)
        if m.name in ignored:
            left_out[m.name] = "is ignored"
        elif m.role in UNREAD or name in UNREAD:
            left_out[m.name] = UNREAD.get(m.role) or UNREAD[name]
        elif parameter is None:
            allowed = ", ".join(dict.fromkeys((*ROLES.values(), *NAMES)))
            raise RuntimeError(
                f'parameter "filename": the map "{m.name}" is no parameter of the material, allowed are {allowed}; or '
                f'name it in the parameter "ignore"'
            )
        elif parameter in maps:
            raise RuntimeError(
                f'parameter "filename": the maps "{maps[parameter].name}" and "{m.name}" are both the parameter '
                f'"{parameter}", name one of them in the parameter "ignore"'
            )
        elif m.channels not in CHANNELS.get(parameter, (1,)):
            allowed = " or ".join(map(str, CHANNELS.get(parameter, (1,))))
            raise RuntimeError(
                f'parameter "filename": the map "{m.name}" has {m.channels} channels, the parameter "{parameter}" '
                f"needs {allowed}"
            )
        else:
            maps[parameter] = m
    if not maps:
        raise RuntimeError(f'parameter "filename": no map is left to read, the file holds {", ".join(layout.names)}')
    return maps, left_out


def ignored(props: mi.Properties) -> tuple[str, ...]:
    """Return the property ``ignore``, names of maps between commas."""
    return tuple(name.strip() for name in str(props.get("ignore", "")).split(",") if name.strip())


class MaterialMaps(FilteredTexture):
    """Maps of a material: ``maps``, by parameter, and ``left_out``, the names of the others with reasons.

    It takes the properties of its BSDF, which shows itself as ``owner`` in warnings.
    """

    def __init__(self, props: mi.Properties):
        self._owner = props.id()
        super().__init__(props)
        self.set_id("")  # the scene's names of parameters are those of the BSDF

    def _open(self, props: mi.Properties) -> SharedMaps:
        shared, self._path = open_compressed(TASK, props)
        return shared

    def _choose(self, props):
        self.maps, self.left_out = material_maps(self.image.layout, ignored(props))
        return next(iter(self.maps.values())), False

    def _shown(self):
        return list(self.maps.values())

    def read(self, si: mi.SurfaceInteraction3f) -> dict[str, list[mi.Float]]:
        """Return the channels of each map at a hit, linear, by parameter."""
        return self._by_parameter(iter(self._values(si)))

    def lobe(self, si: mi.SurfaceInteraction3f) -> Lobe | None:
        """Return the shape of the specular lobe at a hit, from the extras of the file; ``None`` without extras.

        They are coarse: one place is read, whatever the filter.
        """
        if not self.image.has_extras:
            return None
        uv, level = self._uv(si), mi.Float(0)
        if self.filter.name != "off":
            ddx, ddy = self._footprint(si)
            taps = self.filter.taps
            level = isotropic(ddx, ddy) if self.filter.name == "trilinear" else anisotropic(ddx, ddy, taps)[0]
        return lobe_of(self.image.extra(*self._wrapped_at(uv, self.image.biased(level)), level))

    def _by_parameter(self, values: Iterator) -> dict[str, list]:
        return {parameter: [next(values) for _ in range(m.channels)] for parameter, m in self.maps.items()}

    # The methods of the base classes, of the channels of all maps, one after the other

    def _used(self, stored):
        return [v for m in self.maps.values() for v in self._converted(m, stored)]

    def _filtered(self, uv, level):
        stored = self.image.filtered(*self._wrapped_at(uv, self.image.biased(level)), level)
        values = []
        for m in self.maps.values():
            encoded = self._is_encoded(m)
            values += self._converted(m, stored) if encoded else [stored[i] for i in self.image.layout.needed(m.name)]
        return values

    def _used_of(self, values):
        remaining, used = iter(values), []
        for m in self.maps.values():
            if self._is_encoded(m):
                used += [next(remaining) for _ in range(m.channels)]
                continue
            stored = [None] * self.image.layout.stored
            for i in self.image.layout.needed(m.name):
                stored[i] = next(remaining)
            used += self._converted(m, stored)
        return used

    def is_spatially_varying(self):
        return any(not isinstance(where, tuple) for m in self.maps.values() for where in m.where)

    def is_constant(self, parameter: str) -> bool:
        """Return whether the map of a parameter is one colour or number."""
        return all(isinstance(where, tuple) for where in self.maps[parameter].where)

    def _title(self):
        return f'the material "{self._owner}" (neural_material, {self._path})'

    def report(self):
        description, layout = super().report(), self.image.layout
        needed = {i for m in self.maps.values() for i in layout.needed(m.name)}
        kept = {k: v for k, v in description["effects_left_out"].items() if k in ("footprint", "sensor", "to_uv")}
        return {
            **description,
            "map": ", ".join(m.name for m in self.maps.values()),
            "channels_read": sorted(needed),
            "channels_left_out": [i for i in range(layout.stored) if i not in needed],
            "extras": self.image.has_extras,
            "effects_left_out": {**kept, **self.left_out},
        }
