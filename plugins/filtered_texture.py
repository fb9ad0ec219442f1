"""Base class of the textures that filter themselves over the footprint of a pixel; no plugin."""

from __future__ import annotations  # Delayed parsing of type annotations

import drjit as dr
import mitsuba as mi

from mi_diffind.arrays.lookup import clamp
from mi_diffind.core import compat

from .map_texture import MapTexture
from .support import footprint, omissions
from .support.filtering import Filter, anisotropic, cone_of, in_texels, isotropic, offsets, random
from .support.footprint import Cone
from .support.textures import luminance


class FilteredTexture(MapTexture):
    """Texture of one map of a :class:`~mi_diffind.maps.compressed.FilteredMaps`, read at the footprint's level.

    No gradient passes through the footprint at a hit (:func:`.footprint.footprint`). ``cone`` describes the sensor that
    sees the texture (:class:`.footprint.Cone`; ``None``: unknown). A sample that is the only one of its pixel is read
    at the pixel's centre (:func:`.footprint.to_centre`). Several places are averaged in linear colours; maps of data
    are averaged as stored.
    """

    def __init__(self, props: mi.Properties):
        self.filter = Filter.from_properties(props)
        self._cone_of_parameters = cone_of(props)
        self.cone = self._cone_of_parameters
        super().__init__(props)
        if self.filter.name != "off":
            omissions.watch(self)

    def set_cone(self, cone: Cone | None) -> None:
        """Set the sensor that sees the texture; ``None``: the one that the parameters describe, if any."""
        self.cone = cone or self._cone_of_parameters
        self._update_key()

    def _settings(self):
        cone = None if self.cone is None else (self.cone.projection, self.cone.corner is None)
        return *super()._settings(), self.filter, cone

    def omitted(self, integrators: list, sensor) -> str:
        """Return a sentence if no footprints reach the texture, or those of another sensor; see :mod:`.omissions`.

        Whether an integrator gives footprints is known of a few only, and of all others to :func:`.omissions.reading`.
        """
        names = [compat.integrator_name(integrator) for integrator in integrators]
        attached, name = footprint.attached_sensor(self)
        if not self.is_spatially_varying() or any(hasattr(i, "gives_footprints") for i in integrators):
            return ""
        if self.cone is None:
            return self.unfiltered() if set(names) & set(compat.CARRYING) else ""
        if sensor is None or attached in (0, id(sensor)):
            return ""
        return (
            f'{self._title()} is filtered for the sensor "{name}", found "{sensor.id()}": call '
            f"mi_diffind.attach(scene, sensor) before a render of another sensor"
        )

    def unfiltered(self) -> str:
        """Return a warning that the texture is not filtered."""
        return (
            f"{self._title()} is not filtered: it does not know the sensor, and the integrator gives no footprints; "
            f"load the scene with mi_diffind.load_file or load_dict, call mi_diffind.attach(scene), or render with the "
            f"integrator path_footprint"
        )

    def _title(self) -> str:
        described = ", ".join(filter(None, (omissions.plugin_of(self), str(self._path or ""))))
        return f'the texture "{self.id()}" ({described})'

    def _values(self, si):
        if self.filter.name == "off" or not self.is_spatially_varying():
            return super()._values(si)
        uv, (ddx, ddy) = self._uv(si), self._footprint(si)
        uv = uv + dr.detach(footprint.to_centre(self.cone, si, ddx, ddy)) / mi.Vector2f(*self._size)
        if self.filter.name == "trilinear":
            return self._used_of(self._filtered(uv, isotropic(ddx, ddy)))
        level, axis = anisotropic(ddx, ddy, self.filter.taps)
        axis = axis / mi.Vector2f(*self._size)
        if self.filter.name == "anisotropic":
            taps = [self._filtered(dr.fma(axis, x, uv), level) for x in offsets(self.filter.taps)]
            scale = 1 / len(taps)
            return self._used_of([sum(channel[1:], channel[0]) * scale for channel in zip(*taps, strict=True)])
        choice, rounding = random(si)
        taps = self.filter.taps
        if taps > 1:
            uv = dr.fma(axis, (dr.floor(choice * taps) + 0.5) * (1 / taps) - 0.5, uv)
        return self._used_of(self._rounded(uv, level, rounding))

    def _footprint(self, si) -> tuple:
        """Return the footprint in texels of the image, with ``to_uv`` applied."""
        if self.cone is None:
            omissions.reading(self, si)
        with dr.suspend_grad():
            ddx, ddy = footprint.footprint(si, self.cone)
            if self._transform is not None:
                m = self._transform.matrix
                ddx, ddy = footprint.transformed(ddx, ddy, [[m[i, j] for j in range(2)] for i in range(2)])
            return in_texels(ddx, ddy, self._size)

    def _filtered(self, uv, level) -> list:
        """Return the values of one place at a level of detail, in a form that can be averaged (:meth:`_used_of`)."""
        stored = self.image.filtered(*self._wrapped_at(uv, self.image.biased(level)), level)
        return self._used(stored) if self._is_encoded() else [stored[i] for i in self._needed()]

    def _rounded(self, uv, level, sample) -> list:
        """Return :meth:`_filtered`; a derived class may round the level at random by ``sample`` in [0, 1)."""
        return self._filtered(uv, level)

    def _used_of(self, values: list) -> list[mi.Float]:
        """Return the channels of the map, converted from averaged values of :meth:`_filtered`."""
        if self._is_encoded():
            return values
        stored = [None] * self.image.layout.stored
        for i, value in zip(self._needed(), values, strict=True):
            stored[i] = value
        return self._used(stored)

    def _needed(self) -> tuple[int, ...]:
        return self.image.layout.needed(self.map.name)

    def _wrapped_at(self, uv, level) -> list:
        """Return the coordinates of a read on a level; ``mirror`` and ``clamp`` keep within its outermost texels."""
        coordinates, repeats = self._wrapped(uv), self._repeats()
        if self.wrap_mode == "repeat" or not any(repeats):
            return coordinates
        half = [dr.minimum(0.5 * dr.exp2(dr.ceil(level)) / n, 0.5) for n in self._size]
        limits = zip(coordinates, half, repeats, strict=True)
        return [clamp(x, h, 1 - h) if repeat else x for x, h, repeat in limits]

    def eval_1_grad(self, si, active=True):
        if self.filter.name == "off":
            return super().eval_1_grad(si, active)
        if self._is_upsampled():
            self._refuse("eval_1_grad", "a gradient")
        uv = self._uv(si)
        level = isotropic(*self._footprint(si))
        side = dr.exp2(self.image.clamped(self.image.biased(level), mi.Float))
        gradient = []
        for axis, n in enumerate(self._size):
            width = dr.minimum(side * (1 / n), 1)
            step = mi.Vector2f(*(0.5 * width if i == axis else 0 for i in range(2)))
            ahead, behind = (luminance(self._used_of(self._filtered(p, level))) for p in (uv + step, uv - step))
            gradient.append((ahead - behind) / width)
        return self._before(*gradient)

    def filtered(self) -> bool:
        """Return whether footprints are read; if no texture says so, Mitsuba 3.10 computes none."""
        return self.filter.name != "off" and self.is_spatially_varying()

    def report(self) -> dict:
        """Return the description of :meth:`.MapTexture.report` and three more keys.

        ``filter``; ``taps``, the number of places read for one footprint; ``footprint``, the names of the footprint's
        sources in their order, none if nothing is filtered.
        """
        description = super().report()
        left_out = description["effects_left_out"]
        sources = []
        if self.filter.name == "off" or not self.is_spatially_varying():
            left_out["footprint"] = "the filter is off" if self.filter.name == "off" else "the map is constant"
        else:
            sources = [*(["interaction"] if compat.has_footprints() else []), "uv partials"]
            if self.cone is not None:
                sources.append("sensor" if self.cone is not self._cone_of_parameters else "parameters")
            else:
                left_out["sensor"] = "is not known: level 0 is read if the integrator gives no uv partials"
        return {**description, "filter": self.filter.name, "taps": self.filter.reads, "footprint": sources}

    def _description(self):
        name = self.filter.name
        taps = f", at most {self.filter.taps} taps" if name in ("anisotropic", "stochastic") else ""
        seen = "" if name == "off" else f", {'no' if self.cone is None else 'a ' + self.cone.projection} sensor"
        return [*super()._description(), f"filter = {name}{taps}{seen}"]
