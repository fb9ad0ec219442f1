"""Base classes of the textures of images and materials: read at uv, and filtered over the footprint of a pixel."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.arrays.boxes import ValueBounds
from mi_diffind.arrays.lookup import clamp
from mi_diffind.core import compat
from mi_diffind.images import srgb
from mi_diffind.maps.layout import MapLayout

from . import footprint, omissions, properties, textures
from .footprint import Cone
from .image_files import SharedMaps, choose_map, is_data
from .tables import frozen_key
from .textures import (
    WRAP_MODES,
    Filter,
    PositionDistribution,
    anisotropic,
    hit_numbers,
    isotropic,
    luminance,
    shared_cone,
)

#: Most texels that are decoded for the mean, the maximum and the sampling of positions; larger images are reduced.
DECODED = 2**22

#: Largest magnitude of the values of a map in a scene, about the radiance of the sun in candelas per square metre: four
#: bounces on such a surface fit single precision.
BRIGHTEST = 1e9


class MapTexture(mi.Texture):
    """Texture of one map of a :class:`~mi_diffind.maps.pyramid.CompressedMaps`.

    The class implements colours and data, wrapping, transformation, spectra and the sampling of positions. A derived
    class opens the maps in :meth:`_open`, and may override the read in :meth:`_values`. Like the modules of plugins,
    this one is executed afresh for each variant, since ``mi.Texture`` differs.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.wrap_mode = properties.one_of(props, "wrap_mode", WRAP_MODES)
        props.get("accel", True)  # has no effect
        #: Path of the file, for :meth:`to_string`.
        self._path = ""
        self._shared = self._open(props)
        self.image = self._shared.image
        #: The arrays, where frozen functions (``dr.freeze``) look for them.
        self.net = getattr(self.image, "net", None)
        self.map, self.raw = self._choose(props)
        for m in self._shown():
            self._check_values(m, next(name for name in ("filename", "bitmap", "pyramid") if name in props))
        self.to_uv = textures.transformation(props)
        self._update_transformation()
        self._clear_cache()

    def _open(self, props: mi.Properties) -> SharedMaps:
        """Open the maps that the properties name, and read further properties of the class. Raises ``RuntimeError``."""
        raise NotImplementedError

    def _choose(self, props: mi.Properties) -> tuple[MapLayout, bool]:
        """Return the map to show, and whether its values stay as they are. Raises ``RuntimeError``."""
        chosen = choose_map(self.image.layout, str(props.get("channels", "")))
        return chosen, properties.flag(props, "raw", is_data(chosen))

    def _shown(self) -> list[MapLayout]:
        """Return the maps that are read."""
        return [self.map]

    def _check_values(self, m: MapLayout, name: str) -> None:
        """Refuse a map of the property ``name`` with values beyond :data:`BRIGHTEST`. Raises ``RuntimeError``."""
        ends = [w[1] for w in m.where if isinstance(w, tuple)]
        if len(ends) < m.channels:
            ends += [m.low, m.high]
        values = np.array(ends, np.float64)
        with np.errstate(over="ignore"):
            values = self._linear(values, m)
        furthest = values[np.argmax(np.abs(values))]
        if not abs(furthest) <= BRIGHTEST:
            where = f"{self._path}: " if self._path else ""
            raise RuntimeError(
                f'parameter "{name}": {where}found values up to {furthest:.3g} in the map "{m.name}", allowed in a '
                f"scene are {-BRIGHTEST:g} to {BRIGHTEST:g}"
            )

    def traverse(self, cb: mi.TraversalCallback):
        # Arrays of a file are parameters of the first texture that reads them: set twice, the last value would count
        others = (node for node in compat.visited_objects(cb) if node is not self)
        if all(getattr(node, "_shared", None) is not self._shared for node in others):
            self._shared.tables.traverse(cb)
        cb.put("to_uv", self.to_uv, mi.ParamFlags.NonDifferentiable)

    def trained(self) -> tuple:
        """Return the table of the file (``None`` without one), and the arrays that can be optimised, by name."""
        return self._shared.tables.table, self._shared.tables.exposed

    def parameters_changed(self, keys: list[str] = ()):
        self._shared.tables.accept()
        self._update_transformation()
        emits = "positions" in self._cached
        self._clear_cache()
        if emits:  # now, since a frozen function could not compute it
            self._sampled()

    def _update_transformation(self) -> None:
        matrix = textures.after_transform(self.map.transform, self.to_uv)
        identity = matrix == np.eye(3).tolist()
        self._transform = None if identity else self._shared.transform(matrix)
        self._permutes = textures.permutes_corners(matrix)
        self._update_key()

    def _update_key(self) -> None:
        """Tell frozen functions what decides how the texture is read, besides its arrays."""
        self.key = frozen_key(*self._settings())

    def _settings(self) -> tuple:
        """Return the settings of :func:`.frozen_key`."""
        identity = self._transform is None
        return self._size, self.map, self.raw, self.wrap_mode, identity, self._permutes, self._shared.tables.shapes()

    def _clear_cache(self) -> None:
        """Discard the mean, the maximum and the distribution of positions."""
        self._state, self._cached = self._shared.state(), {}

    def _once(self, name: str, compute: Callable):
        """Return ``compute()``, or its earlier result unless the arrays changed, possibly through another texture."""
        if not self._shared.unchanged(self._state):
            self._clear_cache()
        if name not in self._cached:
            self._cached[name] = compute()
        return self._cached[name]

    @property
    def _size(self) -> tuple[int, int]:
        """Width and height of the image."""
        return self.image.layout.width, self.image.layout.height

    def _uv(self, si) -> mi.Point2f:
        return si.uv if self._transform is None else self._transform @ si.uv

    def _wrapped(self, uv) -> list:
        """Return the coordinates u and v to read at."""
        return textures.wrapped(uv, self.wrap_mode, self._size, self._repeats())

    def _repeats(self) -> list[bool]:
        """Return whether the arrays repeat by themselves, along u and along v."""
        return [border == "repeat" for border in reversed(self.image.border)]

    def _values(self, si) -> list[mi.Float]:
        """Return the channels of the map at a hit, converted."""
        return self._read(self._uv(si))

    def _read(self, uv) -> list[mi.Float]:
        """Return the channels of the map at ``uv``, converted, in inactive lanes, too.

        No place is out of bounds, and Dr.Jit merges equal reads only if their masks are equal.
        """
        return self._used(self.image.stored(*self._wrapped(uv)))

    def _used(self, stored: list) -> list[mi.Float]:
        """Return the channels of the maps that are read, one map after the other, converted from stored channels."""
        return [value for m in self._shown() for value in self._converted(m, stored)]

    def _converted(self, m: MapLayout, stored: list) -> list[mi.Float]:
        """Return the channels of the map ``m``, converted from the stored channels of all maps."""
        values = [mi.Float(v) for v in self.image.maps(stored, [m.name])[m.name]]
        if not self._is_encoded(m):
            return values
        bounded = m.low >= 0 and m.high <= 1 and m.knee == 0
        bounded &= all(0 <= w[1] <= 1 for w in m.where if isinstance(w, tuple))
        decode = srgb.to_linear_bounded if bounded else srgb.to_linear
        return [decode(v) for v in values]

    def _is_encoded(self, m: MapLayout | None = None) -> bool:
        """Return whether stored values of a map (default: the one that is shown) are sRGB and have to be converted."""
        return not self.raw and (m or self.map).color_space == "srgb"

    def layout_bounds(self, m: MapLayout | None = None) -> ValueBounds | None:
        """Return the bounds of a map's values (default: the one that is shown) that hold for any entries of the arrays.

        Constant channels are part of the file's layout, as is the equality of channels that are stored once.
        """
        m = m or self.map
        grey = len(set(m.where)) == 1
        constants = np.array([w[1] for w in m.where if isinstance(w, tuple)])
        if len(constants) < m.channels:
            return ValueBounds(grey=grey)
        constants = self._linear(constants, m)
        return ValueBounds(float(constants.min()), float(constants.max()), grey=grey)

    def _is_upsampled(self) -> bool:
        """Return whether the values are colours that are upsampled to spectra."""
        return mi.is_spectral and not self.raw and self.map.channels == 3

    def _check_asked(self, method: str, wanted: str) -> None:
        """Refuse what the map is not. Raises ``RuntimeError``."""
        if method == "eval":
            faulty = mi.is_spectral and self.raw and self.map.channels == 3
            fault = "conversion is switched off (raw = true)"
        elif method == "eval_3" and self.map.channels != 3:
            faulty, fault = True, "it has 1 channel"
        else:
            faulty, fault = self._is_upsampled(), "it is a colour that is converted to a spectrum (raw = false)"
        if faulty:
            raise RuntimeError(f'{method}: the map "{self.map.name}" was asked for {wanted}, but {fault}')

    def eval(self, si, active=True):
        self._check_asked("eval", "a spectrum")
        return textures.spectrum(self._values(si), si.wavelengths, self._is_upsampled())

    def eval_1(self, si, active=True):
        self._check_asked("eval_1", "a number")
        return luminance(self._values(si))

    def eval_3(self, si, active=True):
        self._check_asked("eval_3", "a colour")
        return mi.Color3f(*self._values(si))

    def eval_1_grad(self, si, active=True):
        self._check_asked("eval_1_grad", "a gradient")
        uv, (width, height) = self._uv(si), self._size
        x, y = dr.fma(uv.x, width, -0.5), dr.fma(uv.y, height, -0.5)
        i, j = dr.floor(x), dr.floor(y)
        a, b = clamp(x - i, 0.0, 1.0), clamp(y - j, 0.0, 1.0)

        def texel(right, down):
            return luminance(self._read(mi.Point2f((i + right + 0.5) / width, (j + down + 0.5) / height)))

        f00, f10, f01, f11 = texel(0, 0), texel(1, 0), texel(0, 1), texel(1, 1)
        du = width * dr.lerp(f10 - f00, f11 - f01, b)
        dv = height * dr.lerp(f01 - f00, f11 - f10, a)
        return self._before(du, dv)

    def _before(self, du, dv) -> mi.Vector2f:
        """Return a gradient with respect to uv before ``to_uv``."""
        if self._transform is not None:
            m = self._transform.matrix
            du, dv = m[0, 0] * du + m[1, 0] * dv, m[0, 1] * du + m[1, 1] * dv
        return mi.Vector2f(du, dv)

    def sample_spectrum(self, si, sample, active=True):
        if not mi.is_spectral:
            return dr.zeros(type(si.wavelengths)), self.eval(si, active)
        extent = mi.MI_CIE_MAX - mi.MI_CIE_MIN
        si = mi.SurfaceInteraction3f(si)
        si.wavelengths = mi.MI_CIE_MIN + extent * sample
        return si.wavelengths, self.eval(si, active) * extent

    def is_spatially_varying(self):
        return any(m.varies for m in self._shown())

    def resolution(self):
        return mi.ScalarVector2i(*self._size)

    def _decoded_size(self) -> tuple[int, int]:
        """Return width and height of the decoded image."""
        width, height = self._size
        while width * height > DECODED:
            width, height = (width + 1) // 2, (height + 1) // 2
        return width, height

    def mean(self):
        return self._once("mean", self._compute_mean)

    def _compute_mean(self):
        """Compute the mean without waiting for a kernel, since constructors of materials need it."""
        width, height = self._decoded_size() if self.is_spatially_varying() else (1, 1)
        with dr.suspend_grad():
            index = dr.arange(mi.UInt32, width * height)
            uv = mi.Point2f((mi.Float(index % width) + 0.5) / width, (mi.Float(index // width) + 0.5) / height)
            values = self._read(uv)
            return dr.mean(textures.upsampled_mean(values) if self._is_upsampled() else luminance(values))

    def max(self):
        return self._once("max", self._compute_max)

    def _compute_max(self) -> float:
        largest = self._elsewhere(lambda: self.image.largest(self.map.name))
        return float(self._decoded().max() if largest is None else self._linear(np.array(largest)))

    def _decoded(self) -> np.ndarray:
        """Return the converted image, float32, ``(height, width, channels)``."""
        name = self.map.name
        return self._linear(self._elsewhere(lambda: self.image.decode([name], *self._decoded_size())[name]))

    def _linear(self, values: np.ndarray, m: MapLayout | None = None) -> np.ndarray:
        """Return values of a map (default: the one that is shown) as they are read: converted, if they are encoded."""
        return srgb.to_linear(values) if self._is_encoded(m) else values

    @staticmethod
    def _elsewhere(compute: Callable):
        """Return ``compute()`` of another thread: this one may be recording a loop, where nothing can be evaluated."""

        def computed():
            with dr.suspend_grad():
                return compute()

        with ThreadPoolExecutor(1) as pool:
            return pool.submit(computed).result()

    def _sampled(self) -> PositionDistribution:
        return self._once("positions", self._compute_positions)

    def _compute_positions(self) -> PositionDistribution:
        if dr.flag(dr.JitFlag.FreezingScope):
            raise RuntimeError(
                f'the texture "{self.id()}": a frozen function (dr.freeze) cannot compute the distribution of its '
                f"light, render the scene once before"
            )
        return PositionDistribution.from_image(self._decoded(), self.wrap_mode)

    def sample_position(self, sample, active=True):
        if not (self._permutes and self.is_spatially_varying()):
            return sample, mi.Float(1)
        uv, pdf = self._sampled().sample(sample, active)
        return (uv if self._transform is None else self._transform.inverse() @ uv), pdf

    def pdf_position(self, pos, active=True):
        if not (self._permutes and self.is_spatially_varying()):
            return mi.Float(1)
        return self._sampled().density(pos if self._transform is None else self._transform @ pos, active)

    def report(self) -> dict:
        """Return a description of this instance, for ``mi-diffind inspect``.

        Keys: ``preset``, ``map``; ``channels_read`` and ``channels_left_out``, numbers of stored channels;
        ``effects_in_use`` and ``effects_left_out`` (→ reason), which include the maps of the file; ``evaluated_once``,
        ``storage`` and ``table_bytes``.
        """
        left_out = {name: "is another map of the file" for name in self.image.layout.names if name != self.map.name}
        if not self._is_encoded():
            left_out["srgb"] = "raw is true" if self.raw else "the map is linear"
        if not self._is_upsampled():
            left_out["upsampling"] = "raw is true" if self.raw else "a number or a colour is asked for"
        if self._transform is None:
            left_out["to_uv"] = "is the identity"
        layout = self.image.layout
        read = list(layout.needed(self.map.name))
        return {
            **self._storage(),
            "map": self.map.name,
            "channels_read": read,
            "channels_left_out": [i for i in range(layout.stored) if i not in read],
            "effects_in_use": [n for n in (self.map.name, "srgb", "upsampling", "to_uv") if n not in left_out],
            "effects_left_out": left_out,
            "evaluated_once": [],
        }

    def _storage(self) -> dict:
        """Return the part of :meth:`report` on the arrays."""
        return self._shared.tables.report()

    def _description(self) -> list[str]:
        """Return the lines of :meth:`to_string`."""
        layout = self.image.layout
        lines = [
            f'filename = "{self._path}"',
            f"map = {self.map.name} of {', '.join(layout.names)}",
            f"resolution = {layout.width} x {layout.height}",
            f"channels = {self.map.channels}, {self.map.color_space}, raw = {str(self.raw).lower()}",
            f"wrap_mode = {self.wrap_mode}",
        ]
        stored = self._storage()
        if stored["storage"]:
            lines.append(f"arrays = {stored['table_bytes']} bytes as {stored['storage']}")
        return lines

    def to_string(self):
        return f"{type(self).__name__}[\n  " + ",\n  ".join(self._description()) + "\n]"


class FilteredTexture(MapTexture):
    """Texture of one map of a :class:`~mi_diffind.maps.pyramid.FilteredMaps`, read at the footprint's level.

    No gradient passes through the footprint at a hit (:func:`.footprint.footprint`). ``cone`` describes the sensor that
    sees the texture (:class:`.footprint.Cone`; ``None``: unknown). A sample that is the only one of its pixel is read
    at the pixel's centre (:func:`.footprint.to_centre`). Several places are averaged in linear colours; maps of data
    are averaged as stored.
    """

    def __init__(self, props: mi.Properties):
        self.filter = Filter.from_properties(props)
        self._cone_of_parameters = shared_cone(props)
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
        """Return a sentence if no footprints reach the texture, or those of another sensor; see :mod:`.omissions`."""
        attached, name = footprint.attached_sensor(self)
        reads = any(compat.integrator_name(i) != compat.UNTEXTURED for i in integrators)
        filters = any(getattr(i, "gives_footprints", False) for i in integrators)
        if filters or not reads or not self.is_spatially_varying():
            return ""
        if self.cone is None:
            return (
                f"{self._title()} is not filtered: it does not know the sensor, and the integrator gives no "
                f"footprints; load the scene with mi_diffind.load_file or load_dict, call mi_diffind.attach(scene), or "
                f"render with the integrator path_footprint"
            )
        if sensor is None or attached in (0, id(sensor)):
            return ""
        return (
            f'{self._title()} is filtered for the sensor "{name}", found "{sensor.id()}": call '
            f"mi_diffind.attach(scene, sensor) before a render of another sensor"
        )

    def _title(self) -> str:
        described = ", ".join(filter(None, (omissions.plugin_of(self), str(self._path or ""))))
        return f'the texture "{self.id()}" ({described})'

    def _values(self, si):
        if not self.filtered():
            return super()._values(si)
        uv, (ddx, ddy) = self._uv(si), self._footprint(si)
        uv = uv + dr.detach(footprint.to_centre(self.cone, si, ddx, ddy)) / mi.Vector2f(*self._size)
        if self.filter.name == "trilinear":
            return self._decode_mean(self._filtered(uv, isotropic(ddx, ddy, self.image.level_bias)))
        taps = self.filter.taps
        level, axis = anisotropic(ddx, ddy, taps)
        axis = axis / mi.Vector2f(*self._size)
        if self.filter.name == "anisotropic":
            values = [self._filtered(dr.fma(axis, (k + 0.5) / taps - 0.5, uv), level) for k in range(taps)]
            scale = 1 / taps
            return self._decode_mean([sum(channel[1:], channel[0]) * scale for channel in zip(*values, strict=True)])
        choice, rounding = hit_numbers(si)
        if taps > 1:
            uv = dr.fma(axis, (dr.floor(choice * taps) + 0.5) * (1 / taps) - 0.5, uv)
        return self._decode_mean(self._rounded(uv, level, rounding))

    def _footprint(self, si) -> tuple:
        """Return the footprint in texels of the image, with ``to_uv`` applied."""
        with dr.suspend_grad():
            ddx, ddy = footprint.footprint(si, self.cone)
            if self._transform is not None:
                m = self._transform.matrix
                ddx, ddy = footprint.transform(ddx, ddy, [[m[i, j] for j in range(2)] for i in range(2)])
            size = mi.Vector2f(*self._size)
            return ddx * size, ddy * size

    def _filtered(self, uv, level) -> list:
        """Return the values of one place at a level of detail, in a form that can be averaged (:meth:`_decode_mean`).

        They are linear colours of maps in sRGB, and stored channels of all other maps.
        """
        stored, values = self.image.filtered(*self._wrapped_at(uv, self.image.biased(level)), level), []
        for m in self._shown():
            values += self._converted(m, stored) if self._is_encoded(m) else [stored[i] for i in self._needed(m)]
        return values

    def _rounded(self, uv, level, sample) -> list:
        """Return :meth:`_filtered`; a derived class may round the level at random by ``sample`` in [0, 1)."""
        return self._filtered(uv, level)

    def _decode_mean(self, values: list) -> list[mi.Float]:
        """Return the channels of the maps that are read, converted from averaged values of :meth:`_filtered`."""
        remaining, used = iter(values), []
        for m in self._shown():
            if self._is_encoded(m):
                used += [next(remaining) for _ in range(m.channels)]
                continue
            stored = [None] * self.image.layout.stored
            for i in self._needed(m):
                stored[i] = next(remaining)
            used += self._converted(m, stored)
        return used

    def _needed(self, m: MapLayout | None = None) -> tuple[int, ...]:
        return self.image.layout.needed((m or self.map).name)

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
        self._check_asked("eval_1_grad", "a gradient")
        uv = self._uv(si)
        level = isotropic(*self._footprint(si), self.image.level_bias)
        side = dr.exp2(self.image.clamped(self.image.biased(level), mi.Float))
        gradient = []
        for axis, n in enumerate(self._size):
            width = dr.minimum(side * (1 / n), 1)
            step = mi.Vector2f(*(0.5 * width if i == axis else 0 for i in range(2)))
            ahead, behind = (luminance(self._decode_mean(self._filtered(p, level))) for p in (uv + step, uv - step))
            gradient.append((ahead - behind) / width)
        return self._before(*gradient)

    def filtered(self) -> bool:
        """Return whether footprints are read."""
        return self.filter.name != "off" and self.is_spatially_varying()

    def report(self) -> dict:
        """Return the description of :meth:`.MapTexture.report` and three more keys.

        ``filter``; ``taps``, the number of places read for one footprint; ``footprint``, the names of the footprint's
        sources in their order, none if nothing is filtered.
        """
        description = super().report()
        left_out = description["effects_left_out"]
        sources = []
        if not self.filtered():
            left_out["footprint"] = "the filter is off" if self.filter.name == "off" else "the map is constant"
        else:
            sources = ["uv partials"]
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
