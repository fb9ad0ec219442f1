"""What textures of images and materials have in common, however these are stored: no plugin, their base class."""

from __future__ import annotations  # Delayed parsing of type annotations

from concurrent.futures import ThreadPoolExecutor

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind import srgb
from mi_diffind.lookup import clamp

from .support import properties, tables, textures, upsampling
from .support.image_files import SharedMaps, is_data, map_of
from .support.textures import WRAP_MODES, Positions, luminance

#: Texels, at most, that are decoded for the mean, the maximum and the sampling of positions; larger images are reduced.
DECODED = 2**22


class MapTexture(mi.Texture):
    """
    One map of a :class:`~mi_diffind.maps.compressed.CompressedMaps` as a texture: colours and data, wrapping,
    transformation, spectra, sampling of positions. A class of its own says in :meth:`_open` where the maps come from,
    and may read them in another way in :meth:`_values`.

    Like every module of a plugin, this one is executed afresh for each variant, whose ``mi.Texture`` it is made of.
    """

    def __init__(self, props: mi.Properties):
        super().__init__(props)
        self.wrap_mode = properties.one_of(props, "wrap_mode", WRAP_MODES)
        props.get("accel", True)  # of no use here
        #: The file, as a description names it.
        self._path = ""
        self._shared = self._open(props)
        self.image = self._shared.image
        #: For functions that are frozen, which look for the arrays that they read in here.
        self.net = getattr(self.image, "net", None)
        self.map = map_of(self.image.layout, str(props.get("channels", "")))
        raw = props.get("raw", is_data(self.map))
        if not isinstance(raw, bool):
            raise RuntimeError(f'parameter "raw": found {raw}, allowed are true and false')
        self.raw = raw
        self.to_uv = textures.transformation(props)
        self._look_at_transformation()
        self._forget()

    def _open(self, props: mi.Properties) -> SharedMaps:
        """The maps that properties name; also what else only this kind of texture has. Raises ``RuntimeError``."""
        raise NotImplementedError

    # -- parameters -------------------------------------------------------------------------------------------------

    def traverse(self, cb: mi.TraversalCallback):
        tables.traverse(cb, self._shared.tables)
        cb.put("to_uv", self.to_uv, mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys: list[str] = ()):
        tables.check_shapes(self._shared.tables)
        self._look_at_transformation()
        self._forget()

    def _look_at_transformation(self) -> None:
        m = self.to_uv.matrix
        matrix = [[float(m[i, j]) for j in range(3)] for i in range(3)]
        identity = matrix == [[float(i == j) for j in range(3)] for i in range(3)]
        self._transform = None if identity else self._shared.transform(matrix)
        self._permutes = textures.permutes_corners(matrix)

    def _forget(self) -> None:
        """Of what was found out by decoding."""
        self._state, self._mean, self._max, self._positions = self._shared.state(), None, None, None

    def _remember(self) -> None:
        """What was found out is still true, or forgotten: another texture may have changed the arrays."""
        if not self._shared.unchanged(self._state):
            self._forget()

    # -- reading ----------------------------------------------------------------------------------------------------

    @property
    def _size(self) -> tuple[int, int]:
        """Width and height of the image."""
        return self.image.layout.width, self.image.layout.height

    def _uv(self, si) -> mi.Point2f:
        return si.uv if self._transform is None else self._transform @ si.uv

    def _wrapped(self, uv) -> list:
        """The coordinates u and v to read at."""
        return textures.wrapped(uv, self.wrap_mode, self._size, self._repeats())

    def _repeats(self) -> list[bool]:
        """Do the arrays repeat by themselves, along u and along v?"""
        return [border == "repeat" for border in reversed(self.image.border)]

    def _values(self, si) -> list[mi.Float]:
        """What a surface has: the channels of the map at a hit, as they are used."""
        return self._read(self._uv(si))

    def _read(self, uv) -> list[mi.Float]:
        """
        The channels of the map at ``uv``, as they are used. In lanes that are not active, too: no place is out of
        bounds, and what is masked differently is not recognised as the same read.
        """
        return self._used(self.image.stored(*self._wrapped(uv)))

    def _used(self, stored: list) -> list[mi.Float]:
        """The channels of the map, as they are used, from the stored ones of all maps."""
        values = self.image.maps(stored, [self.map.name])[self.map.name]
        values = [mi.Float(v) for v in values]
        if not self._is_encoded():
            return values
        bounded = self.map.low >= 0 and self.map.high <= 1 and self.map.knee == 0
        decode = srgb.to_linear_bounded if bounded else srgb.to_linear
        return [decode(v) for v in values]

    def _is_encoded(self) -> bool:
        """Are values in the file sRGB, and to be converted?"""
        return not self.raw and self.map.color_space == "srgb"

    def _is_upsampled(self) -> bool:
        """Is this a colour that stands for a spectrum?"""
        return mi.is_spectral and not self.raw and self.map.channels == 3

    def _refuse(self, method: str, wanted: str):
        raise RuntimeError(
            f'{method}: the map "{self.map.name}" was asked for {wanted}, but it is a colour that is converted to a '
            f"spectrum (raw = false)"
        )

    def eval(self, si, active=True):
        if mi.is_spectral and self.raw and self.map.channels == 3:
            raise RuntimeError(
                f'eval: the map "{self.map.name}" was asked for a spectrum, but conversion is switched off (raw = true)'
            )
        return textures.spectrum(self._values(si), si.wavelengths, self._is_upsampled())

    def eval_1(self, si, active=True):
        if self._is_upsampled():
            self._refuse("eval_1", "a number")
        return luminance(self._values(si))

    def eval_3(self, si, active=True):
        if self.map.channels != 3:
            raise RuntimeError(f'eval_3: the map "{self.map.name}" was asked for a colour, but it has 1 channel')
        if self._is_upsampled():
            self._refuse("eval_3", "a colour")
        return mi.Color3f(*self._values(si))

    def eval_1_grad(self, si, active=True):
        if self._is_upsampled():
            self._refuse("eval_1_grad", "a gradient")
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
        """A gradient as it is before ``to_uv``."""
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

    # -- what is known of the whole -----------------------------------------------------------------------------------

    def is_spatially_varying(self):
        return any(not isinstance(where, tuple) for where in self.map.where)

    def resolution(self):
        return mi.ScalarVector2i(*self._size)

    def _decoded_size(self) -> tuple[int, int]:
        """Width and height of what is decoded."""
        width, height = self._size
        while width * height > DECODED:
            width, height = (width + 1) // 2, (height + 1) // 2
        return width, height

    def mean(self):
        self._remember()
        if self._mean is None:
            with dr.suspend_grad():
                self._mean = self._compute_mean()
        return self._mean

    def _compute_mean(self):
        """Nothing here waits for a kernel: materials ask for it while they are constructed."""
        width, height = self._decoded_size() if self.is_spatially_varying() else (1, 1)
        index = dr.arange(mi.UInt32, width * height)
        uv = mi.Point2f((mi.Float(index % width) + 0.5) / width, (mi.Float(index // width) + 0.5) / height)
        values = self._read(uv)
        value = upsampling.mean(values) if self._is_upsampled() else luminance(values)
        return dr.mean(value)

    def max(self):
        self._remember()
        if self._max is None:
            self._max = float(self._decoded().max())
        return self._max

    def _decoded(self) -> np.ndarray:
        """
        The image as its values are used, float32, ``(height, width, channels)``. From another thread: this one may be
        recording a loop or a call, in which nothing can be evaluated.
        """

        def decode():
            with dr.suspend_grad():
                return self.image.decode([self.map.name], *self._decoded_size())[self.map.name]

        with ThreadPoolExecutor(1) as pool:
            values = pool.submit(decode).result()
        return srgb.to_linear(values) if self._is_encoded() else values

    # -- sampling of positions ----------------------------------------------------------------------------------------

    def _sampled(self) -> Positions:
        self._remember()
        if self._positions is None:
            self._positions = Positions.of(self._decoded(), self.wrap_mode)
        return self._positions

    def sample_position(self, sample, active=True):
        if not (self._permutes and self.is_spatially_varying()):
            return sample, mi.Float(1)
        uv, pdf = self._sampled().sample(sample, active)
        return (uv if self._transform is None else self._transform.inverse() @ uv), pdf

    def pdf_position(self, pos, active=True):
        if not (self._permutes and self.is_spatially_varying()):
            return mi.Float(1)
        return self._sampled().density(pos if self._transform is None else self._transform @ pos, active)

    # -- what it does -------------------------------------------------------------------------------------------------

    def report(self) -> dict:
        """
        What this instance does: ``preset``, ``map``; ``channels_read`` and ``channels_left_out``, numbers of the
        channels that the file stores; ``effects_in_use`` and ``effects_left_out`` (→ reason), the maps of the file
        among them; ``evaluated_once``, ``storage`` and ``table_bytes``.
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
        """What a report says of the arrays."""
        return tables.described(self._shared.preset, self._shared.arrays)

    def _description(self) -> list[str]:
        """Lines for a description."""
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
