from __future__ import annotations  # Delayed parsing of type annotations

import drjit as dr
import mitsuba as mi

from mi_diffind import srgb

from . import Plugin
from .filtered_texture import FilteredTexture
from .support.image_files import SharedMaps, open_uncompressed


class MipMap(FilteredTexture):
    r"""
    .. _texture-mipmap:

    Image with levels of detail (:monosp:`mipmap`)
    ----------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - An image, or a manifest (``.json``) that names the maps of a material. One of this, ``bitmap`` and ``pyramid``
         is needed.
       - --

     * - bitmap
       - :monosp:`mitsuba.Bitmap`
       - An image in memory. Whether it is sRGB-encoded, it says itself.
       - --

     * - pyramid
       - |string|
       - The name of levels in memory, an entry of ``plugins.support.image_files.PYRAMIDS``.
       - --

     * - channels
       - |string|
       - Name of the map that is meant, of 1 or 3 channels. (Default: the only map, or the only albedo; of an image,
         its colours)
       - --

     * - raw
       - |bool|
       - Leave values as they are: nothing is taken for sRGB when levels are averaged, and there is no spectral
         upsampling. (Default: false for colours; true for a manifest's maps of data)
       - --

     * - wrap_mode
       - |string|
       - Outside of [0, 1] as for :monosp:`bitmap`: ``repeat``, ``mirror`` or ``clamp``. (Default: ``repeat``)
       - --

     * - to_uv
       - |transform|
       - Transformation of the texture coordinates, as for :monosp:`bitmap`. (Default: none)
       - |exposed|

     * - filter
       - |string|
       - ``trilinear``: at the level of detail whose texels have the area of the footprint; ``anisotropic``: at several
         places along the footprint's major axis, of a finer level; ``stochastic``: at one of these, chosen at random;
         ``off``: level 0, the footprint is not looked at. (Default: ``trilinear``)
       - --

     * - max_anisotropy
       - |int|
       - Places along the major axis for ``anisotropic`` and ``stochastic``, 1 to 16. (Default: 4)
       - --

     * - sensor_to_world, fov, resolution, spp
       - |transform|, |float|, |int|, |int|
       - The perspective sensor that sees the texture: its ``to_world``, its field of view along x, its pixels along x,
         and the samples of each (default: 1). For plain Mitsuba: ``mi-diffind`` and ``mi_diffind.load_file`` look for
         the scene's sensor themselves, and what they find replaces these.
       - --

     * - filter_type, accel
       - |string|, |bool|
       - Accepted for the sake of exchange with :monosp:`bitmap`: ``bilinear`` is the filter ``off``, ``trilinear`` and
         ``anisotropic`` are themselves; ``accel`` has no effect. (Default: none)
       - --

    An uncompressed image that filters itself over the footprint of a pixel, from a mip pyramid as graphics hardware
    has it: box-filtered levels, of linear values where the image is sRGB. It is what :monosp:`neural_texture` is
    compared with, and for scenes of Mitsuba 3.9, whose :monosp:`bitmap` has no levels of detail. **The next Mitsuba's
    bitmap has these filters itself** (``filter_type``), and is to be preferred there.

    Levels are kept in single precision, four channels to a texel: 21 bytes a texel of the image for one colour.
    ``filter`` ``off`` is :monosp:`bitmap`, between texels, too, but for spectra, which are upsampled from the colour
    that was filtered.

    **The footprint** is that of a sample, a pixel's but smaller by the root of their number, and comes from the first
    of these that knows it: Mitsuba, from version 3.10; an integrator that fills the partials of uv, such as
    :monosp:`path_footprint`; the sensor, where a ray comes straight from it, else a stated rule that is rather too
    sharp than too blurred. Where nobody knows, it is zero: without a sensor, a texture is not filtered. No derivative
    passes through it.

    ``anisotropic`` reads at ``max_anisotropy`` places, evenly over the major axis, always, and half a level finer than
    a place's share of the footprint is wide; that is 1.4 to 3 dB nearer to the mean over the footprint than a full
    level is. ``stochastic`` chooses one of the places and one of two levels, by numbers made from the bits of the hit's
    position and uv: on average what ``anisotropic`` gives, with the noise of one sample, and the same at every read of
    a path. Samples that go through one point of a pixel get one choice.

    The gradient that :monosp:`bumpmap` asks for is, with ``off``, that of :monosp:`bitmap`; with any other filter, the
    difference over the width of a texel of the trilinear level (its footprint's area), also if it is anisotropic.

    .. tabs::
        .. code-tab:: xml
            :name: mipmap

            <texture type="mipmap">
                <string name="filename" value="wall.png"/>
                <string name="filter" value="anisotropic"/>
            </texture>

        .. code-tab:: python

            'type': 'mipmap',
            'filename': 'wall.png',
            'filter': 'anisotropic'
    """

    def _open(self, props: mi.Properties) -> SharedMaps:
        found, self._path = open_uncompressed(props, self.wrap_mode)
        #: For functions that are frozen, which look for the arrays that they read in here.
        self.texels = found.image.arrays
        return found

    def _read(self, uv):
        return self._used_of(self._interpolated(uv, mi.Float(0), whole=True))

    def _filtered(self, uv, level):
        return self._interpolated(uv, level, whole=False)

    def _rounded(self, uv, level, sample):
        return self._interpolated(uv, dr.floor(self.image.clamped(level, mi.Float) + sample), whole=True)

    def _interpolated(self, uv, level, whole: bool) -> list:
        """What can be averaged: linear values where there are any."""
        found = self.image.interpolated(*self._wrapped_at(uv, level), level, whole=whole)
        return [found[i] for i in self._needed()]

    def _used_of(self, values):
        stored = [None] * self.image.layout.stored
        for i, value in zip(self._needed(), values, strict=True):
            stored[i] = value
        if not (self._is_encoded() and self.image.is_linear(self.map.name)):
            return self._used(self.image.encoded(stored))
        return [
            mi.Float(stored[where]) if isinstance(where, int) else srgb.to_linear_bounded(mi.Float(where[1]))
            for where in self.map.where
        ]

    def _storage(self):
        return {"preset": "", "storage": "float32", "table_bytes": self.image.memory_nbytes}


PLUGIN = Plugin("mipmap", "texture", MipMap)
