"""Compressed image or material."""

from __future__ import annotations  # Delayed parsing of type annotations

import functools

import mitsuba as mi

from mi_diffind.tasks.image import TASK

from . import Counterpart, Plugin
from .support import properties
from .support.image_files import SharedMaps, open_compressed, to_bitmap
from .support.manual import shared_parts
from .support.map_textures import MapTexture


@shared_parts
class NeuralImage(MapTexture):
    r"""
    .. _texture-neural_image:

    Compressed image (:monosp:`neural_image`)
    -----------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A compressed image or material, written by ``mi-diffind fit image``.
       - --

     {channels}

     {raw}

     {wrap_mode}

     {to_uv}

     {compressed}

     * - filter_type, accel
       - |string|, |bool|
       - Accepted so that the parameters of :monosp:`bitmap` can be kept: the only filter is ``bilinear``; ``accel``
         has no effect. (Default: these)
       - --

     * - tables.primary, tables.coarse, tables.cascaded
       - |tensor|
       - The entries of the primary array (or of its pages, one after the other), of the second, coarser primary if
         there is one, and of the cascaded array; exposed if ``storage`` is ``float32``.
       - |exposed|, |differentiable|

    An image that is stored as a pair of small arrays and read by *differentiable indirection* (Datta et al., *Efficient
    Graphics Representation with Differentiable Indirection*, SIGGRAPH Asia 2023, task 3): a primary array, read at uv,
    points into a cascaded array, whose entries are the channels of all maps of a material. Any BSDF and emitter can use
    the texture. Its exact counterpart is :monosp:`bitmap` with the original image.

    **Several textures of one file are decoded once** if their ``to_uv``, ``wrap_mode`` and ``storage`` are equal: they
    read the same arrays at the same place, and Dr.Jit merges equal reads. With ``storage`` ``float32`` such textures
    share their parameters, across scenes, too: an optimiser that changes one of them changes all. A texture that is
    loaded after such a change starts from the file.

    **Between texels**, values are interpolated in the encoding of the image (sRGB, if it is sRGB) and converted
    afterwards; :monosp:`bitmap` converts first. At texel centres the two agree. ``mirror`` and ``clamp`` read nothing
    beyond the outermost texel centres. If the fit found that the image does not wrap around, ``repeat`` jumps at the
    seam, where :monosp:`bitmap` blends over the width of a texel.

    **Spectral variants** upsample each colour to a spectrum by Jakob and Hanika's model, from the table of coefficients
    that :monosp:`bitmap` uses at load time. The spectra agree at texel centres, and closely between the texels
    of smooth colours. As in :monosp:`bitmap`, colours are clamped to [0, 1]
    before upsampling, also those of emitters; and a map of three channels gives spectra only without ``raw``, and
    numbers only with ``raw``.

    The gradient that :monosp:`bumpmap` reads is that of the image at its own resolution, from the four decoded texels
    around the place. Positions on an emitter are sampled in proportion to the decoded image, or uniformly if ``to_uv``
    does not map the unit square to itself. For this, for ``mean`` and for ``max``, images of more than 2²² texels are
    reduced.

    {executable}

    {example texture neural_image: filename="wall.npz", channels="albedo"}
    """

    def _open(self, props: mi.Properties) -> SharedMaps:
        properties.one_of(props, "filter_type", ("bilinear",))
        maps, self._path = open_compressed(TASK, props)
        return maps

    def _repeats(self):
        borders = [] if self.net is None else [reversed(array.border) for array in self.net.primary]
        return ["clamp" not in along for along in zip(*borders, strict=True)] or [True, True]


PLUGIN = Plugin(
    "neural_image",
    "texture",
    NeuralImage,
    task=TASK.name,
    exact=Counterpart(
        "bitmap", ("filename", "channels", "storage", "source"), convert=functools.partial(to_bitmap, TASK)
    ),
)
