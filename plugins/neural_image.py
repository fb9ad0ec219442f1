from __future__ import annotations  # Delayed parsing of type annotations

import functools

import mitsuba as mi

from mi_diffind.tasks.image import TASK

from . import Counterpart, Plugin
from .map_texture import MapTexture
from .support import properties
from .support.image_files import SharedMaps, open_compressed, to_bitmap


class NeuralImage(MapTexture):
    r"""
    .. _texture-neural_image:

    Compressed image (:monosp:`neural_image`)
    -----------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A compressed image or material, as written by ``mi-diffind fit image``.
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

     * - storage
       - |string|
       - ``uint8``, which is the fastest to read, or ``float32``, which can be optimised. (Default: ``uint8``)
       - --

     * - source
       - |string|
       - The image or the manifest that the file was made from; only the exact counterpart reads it. (Default: what the
         file says)
       - --

     * - filter_type, accel
       - |string|, |bool|
       - Accepted for the sake of exchange with :monosp:`bitmap`: of filters only ``bilinear`` is allowed, ``accel`` has
         no effect. (Default: these)
       - --

     * - tables.primary, tables.coarse, tables.cascaded
       - |tensor|
       - The entries of the arrays, with ``storage`` ``float32``; of the second, coarser primary, if there is one.
       - |exposed|, |differentiable|

    An image that is stored as a pair of small arrays and read by *differentiable indirection* (Datta et al., *Efficient
    Graphics Representation with Differentiable Indirection*, SIGGRAPH Asia 2023, task 3): a primary array, read at uv,
    points into a cascaded one, whose entries are the channels of all maps of a material. The exact counterpart is
    :monosp:`bitmap` with the image that was compressed. Any BSDF and emitter can use it.

    **Several textures of one file are decoded once**, if their ``to_uv``, ``wrap_mode`` and ``storage`` are equal: they
    read the same arrays at the same place, which Dr.Jit recognises. The arrays of ``float32`` storage are parameters
    that such textures share, across scenes, too: what an optimiser does to one of them it does to all. A texture that
    is loaded after such a change starts from the file.

    **Between texels** values are interpolated as the image has them, sRGB-encoded where it is, and converted
    afterwards, which :monosp:`bitmap` does first; at texel centres this makes no difference. ``mirror`` and ``clamp``
    read nothing beyond the outermost texel centres. Where the image was found not to wrap around, ``repeat`` jumps at
    the seam, where :monosp:`bitmap` blends over the width of a texel.

    **Spectral variants** upsample the colour that was read to a spectrum by Jakob and Hanika's model, from the table of
    coefficients that :monosp:`bitmap` uses when it is loaded: the same spectra at texel centres (114 dB), and 52 dB
    between those of smooth colours, 48 × 64 texels, at 400 to 700 nm. As in :monosp:`bitmap`, colours are clamped to
    [0, 1] for that, also those of emitters, and a map of three channels answers for spectra only if it is not ``raw``,
    for numbers only if it is.

    The gradient that :monosp:`bumpmap` asks for is that of the image at its own resolution, from the four texels around
    the place, each decoded. Positions on an emitter are sampled by the decoded image, or uniformly if ``to_uv`` does
    not map the unit square to itself. This, ``mean`` and ``max`` reduce images of more than 2²² texels.

    .. tabs::
        .. code-tab:: xml
            :name: neural_image

            <texture type="neural_image">
                <string name="filename" value="wall.npz"/>
                <string name="channels" value="albedo"/>
            </texture>

        .. code-tab:: python

            'type': 'neural_image',
            'filename': 'wall.npz',
            'channels': 'albedo'
    """

    def _open(self, props: mi.Properties) -> SharedMaps:
        properties.one_of(props, "filter_type", ("bilinear",))
        found, self._path = open_compressed(TASK, props)
        return found

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
