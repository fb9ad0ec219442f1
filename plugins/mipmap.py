"""Uncompressed image with levels of detail."""

from __future__ import annotations  # Delayed parsing of type annotations

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi

from mi_diffind.core import compat
from mi_diffind.images import srgb
from mi_diffind.maps.pyramid import TexelPyramid

from . import Plugin
from .support.image_files import SharedMaps, open_uncompressed
from .support.manual import shared_parts
from .support.map_textures import FilteredTexture


@shared_parts
class MipMap(FilteredTexture):
    r"""
    .. _texture-mipmap:

    Image with levels of detail (:monosp:`mipmap`)
    ----------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - An image, or a manifest (``.json``) that names the maps of a material. Exactly one of ``filename``, ``bitmap``
         and ``pyramid`` is needed.
       - --

     * - bitmap
       - :monosp:`mitsuba.Bitmap`
       - An image in memory, which knows whether it is sRGB-encoded.
       - --

     * - pyramid
       - |string|
       - The name of levels in memory, an entry of ``plugins.support.image_files.PYRAMIDS``.
       - --

     {channels}

     * - raw
       - |bool|
       - Leave values as they are: levels are averaged without conversion from sRGB, without spectral upsampling.
         (Default: false for colours; true for a manifest's maps of data)
       - --

     {wrap_mode}

     {to_uv}

     {filtering}

     * - data
       - |tensor|
       - The texels of the map that is shown, ``(height, width, channels)``: linear values of colours in sRGB, values as
         they are of everything else. Another height or width is allowed.
       - |exposed|, |differentiable|

    An uncompressed image that filters itself over the footprint of a pixel, from a mip pyramid as in graphics hardware:
    box-filtered levels, averaged in linear values where the image is sRGB. It is the reference for
    :monosp:`neural_texture`, and useful in scenes of Mitsuba 3.9, whose :monosp:`bitmap` has no levels of detail. **The
    bitmap of Mitsuba 3.10 has these filters itself** (``filter_type``), and is to be preferred there.

    Levels are kept in single precision: 37 bytes per texel of a colour image, 21 in the arrays that are read, with four
    channels to a texel, and 16 in those that they are packed from. With ``filter`` ``off`` the values are those of
    :monosp:`bitmap`, also between texels, except for spectra, which are upsampled from the filtered colour.

    **Optimisation.** A change of ``data`` gives this texture levels of its own, computed from ``data`` with each
    :monosp:`update()`; derivatives of all levels reach ``data``, so texels seen minified are optimised, too. Values are
    not limited to [0, 1]: limit them after each step of an optimiser, as for :monosp:`bitmap`. Levels of a normal map
    are mean directions. In spectral variants, ``data`` are linear colours, not coefficients of spectra. Other textures
    of the same file keep its texels.

    {footprint}

    Unlike :monosp:`neural_texture`, ``stochastic`` also chooses one of the two levels next to the wanted one.

    {gradient}

    {executable}

    {example texture mipmap: filename="wall.png", filter="anisotropic"}
    """

    def _open(self, props: mi.Properties) -> SharedMaps:
        maps, self._path = open_uncompressed(props, self.wrap_mode)
        #: The arrays of the levels, where frozen functions (``dr.freeze``) look for them.
        self.texels = maps.image.arrays
        self._data = None
        return maps

    def traverse(self, cb: mi.TraversalCallback):
        if self._data is None:
            tensor = self._finest()
            # Frozen functions (dr.freeze) do not read it and must not look for it. ``accepted``: its last allowed value
            self._data, self._entry = SimpleNamespace(tensor=tensor, accepted=dr.detach(tensor)), self.map
        cb.put("data", self._data.tensor, mi.ParamFlags.Differentiable)
        super().traverse(cb)

    def _finest(self) -> mi.TensorXf:
        """Return the texels of the map, converted; nothing is stored until a kernel or an update needs them."""
        with dr.suspend_grad():
            (width, height), channels, needed = self._size, self.map.channels, self._needed()
            index = dr.arange(mi.UInt32, width * height * channels)
            stored = self.image.interpolated_texels(index // channels) if needed else []
            values = self._decode_mean([stored[i] for i in needed])
            flat = values[0] + dr.zeros(mi.Float, width * height * channels)  # as many where a channel is constant
            for c in range(1, channels):
                flat = dr.select(index % channels == c, values[c], flat)
            return mi.TensorXf(flat, (height, width, channels))

    def parameters_changed(self, keys: list[str] = ()):
        if "data" in keys:
            data, channels = self._data.tensor, self.map.channels
            if data.ndim != 3 or data.shape[2] != channels or 0 in data.shape:
                shape = tuple(data.shape)
                compat.assign(data, self._data.accepted)
                raise RuntimeError(f'parameter "data": has the shape {shape}, expected (height, width, {channels})')
            self._data.accepted = dr.detach(data)
            self._shared = SharedMaps(TexelPyramid(self._entry, data, self.image.border), {})
            self.image, self.texels = self._shared.image, self._shared.image.arrays
            self.map = self.image.layout.maps[0]
        super().parameters_changed(keys)

    def _read(self, uv):
        return self._decode_mean(self._interpolated(uv, mi.Float(0), whole=True))

    def _filtered(self, uv, level):
        return self._interpolated(uv, level, whole=False)

    def _rounded(self, uv, level, sample):
        return self._interpolated(uv, dr.floor(self.image.clamped(level, mi.Float) + sample), whole=True)

    def _interpolated(self, uv, level, whole: bool) -> list:
        """Return the channels of the map at ``uv`` and a level, linear where the pyramid is, which can be averaged."""
        stored = self.image.interpolated(*self._wrapped_at(uv, level), level, whole=whole)
        return [stored[i] for i in self._needed()]

    def _decode_mean(self, values):
        stored = [None] * self.image.layout.stored
        for i, value in zip(self._needed(), values, strict=True):
            stored[i] = value
        if not (self._is_encoded() and self.image.is_linear(self.map.name)):
            return self._used(self.image.encoded(stored))
        return [
            mi.Float(stored[where]) if isinstance(where, int) else srgb.to_linear_bounded(mi.Float(where[1]))
            for where in self.map.where
        ]

    def layout_bounds(self, m=None):
        return None  # an update of ``data`` may replace the map

    def _storage(self):
        return {"preset": "", "storage": "float32", "table_bytes": self.image.memory_nbytes}


PLUGIN = Plugin("mipmap", "texture", MipMap)
