from __future__ import annotations  # Delayed parsing of type annotations

import functools

import mitsuba as mi

from mi_diffind.tasks.texture import TASK

from . import Counterpart, Plugin
from .filtered_texture import FilteredTexture
from .support.filtering import PROPERTIES as FILTERING
from .support.image_files import SharedMaps, open_compressed, to_bitmap, to_mipmap


class NeuralTexture(FilteredTexture):
    r"""
    .. _texture-neural_texture:

    Compressed texture with levels of detail (:monosp:`neural_texture`)
    -------------------------------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A compressed texture or material, as written by ``mi-diffind fit texture``.
       - --

     * - channels
       - |string|
       - Name of the map that is meant, such as ``albedo``, of 1 or 3 channels. (Default: the only map of the file, or
         its only albedo)
       - --

     * - raw
       - |bool|
       - Leave values as they are in the image, which is what data want: no conversion from sRGB, no spectral
         upsampling. (Default: false for colours; true for maps that hold data: ``normal``, ``roughness``, ``ao``,
         ``metallic``)
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

     * - storage
       - |string|
       - ``uint8``, which is the fastest to read, or ``float32``, which can be optimised. (Default: ``uint8``)
       - --

     * - source
       - |string|
       - The image or the manifest that the file was made from; only the exact counterparts read it. (Default: what the
         file says)
       - --

     * - filter_type, accel
       - |string|, |bool|
       - Accepted for the sake of exchange with :monosp:`bitmap`: ``bilinear`` is the filter ``off``, ``trilinear`` and
         ``anisotropic`` are themselves; ``accel`` has no effect. (Default: none)
       - --

     * - tables.NAME
       - |tensor|
       - The entries of each array, with ``storage`` ``float32``.
       - |exposed|, |differentiable|

    An image or a material that is stored, with all its levels of detail, as small arrays and read by *differentiable
    indirection* (Datta et al., *Efficient Graphics Representation with Differentiable Indirection*, SIGGRAPH Asia 2023,
    task 4): arrays that are read at uv and at the footprint point into another one, whose entries are the channels of
    all maps of a material. Compression and filtering are one chain of lookups. The exact counterpart is
    :monosp:`bitmap` with the image that was compressed, at as many samples as it takes; :monosp:`mipmap` is what it
    approximates at equal samples, and may be named as the counterpart, too. Any BSDF and emitter can use it.

    Everything that :monosp:`neural_image` says of files that are shared, of values between texels, of spectra and of
    positions on emitters holds here, too.

    **The footprint** is that of a sample, a pixel's but smaller by the root of their number, and comes from the first
    of these that knows it: Mitsuba, from version 3.10; an integrator that fills the partials of uv, such as
    :monosp:`path_footprint`; the sensor, where a ray comes straight from it, else a stated rule that is rather too
    sharp than too blurred. Where nobody knows, it is zero: without a sensor, a texture is not filtered. No derivative
    passes through it.

    ``anisotropic`` reads at ``max_anisotropy`` places, evenly over the major axis, always, and half a level finer than
    a place's share of the footprint is wide; that is 1.4 to 3.6 dB nearer to the mean over the footprint than a full
    level is. ``stochastic`` chooses one of the places by numbers made from the bits of the hit's position and uv: on
    average what ``anisotropic`` gives, with the noise of one sample, and the same at every read of a path. Samples that
    go through one point of a pixel get one choice.

    **Frozen functions** (``dr.freeze``) that render keep the entries that they were recorded with, here and in
    :monosp:`neural_image`: record them again after an optimiser has changed ``tables.NAME``.

    The gradient that :monosp:`bumpmap` asks for is, with ``off``, that of :monosp:`bitmap`; with any other filter, the
    difference over the width of a texel of the trilinear level (its footprint's area), also if it is anisotropic.

    .. tabs::
        .. code-tab:: xml
            :name: neural_texture

            <texture type="neural_texture">
                <string name="filename" value="wall.npz"/>
                <string name="channels" value="albedo"/>
            </texture>

        .. code-tab:: python

            'type': 'neural_texture',
            'filename': 'wall.npz',
            'channels': 'albedo'
    """

    def _open(self, props: mi.Properties) -> SharedMaps:
        found, self._path = open_compressed(TASK, props)
        return found


def _to_bitmap(props: mi.Properties) -> None:
    to_bitmap(TASK, props)
    for name in FILTERING:
        if name in props:
            del props[name]


PLUGIN = Plugin(
    "neural_texture",
    "texture",
    NeuralTexture,
    task=TASK.name,
    exact=Counterpart(
        "bitmap",
        ("filename", "channels", "storage", "source"),
        convert=_to_bitmap,
    ),
    others=(Counterpart("mipmap", ("storage", "source"), convert=functools.partial(to_mipmap, TASK)),),
)
