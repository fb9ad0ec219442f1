"""Compressed texture or material with levels of detail."""

from __future__ import annotations  # Delayed parsing of type annotations

import functools

import mitsuba as mi

from mi_diffind.tasks.texture import TASK

from . import Counterpart, Plugin
from .filtered_texture import FilteredTexture
from .support.filtering import PROPERTIES as FILTERING
from .support.image_files import SharedMaps, open_compressed, to_bitmap, to_mipmap
from .support.manual import shared_parts


@shared_parts
class NeuralTexture(FilteredTexture):
    r"""
    .. _texture-neural_texture:

    Compressed texture with levels of detail (:monosp:`neural_texture`)
    -------------------------------------------------------------------

    .. pluginparameters::

     * - filename
       - |string|
       - A compressed texture or material, written by ``mi-diffind fit texture``.
       - --

     {channels}

     {raw}

     {wrap_mode}

     {to_uv}

     {filtering}

     {compressed}

     * - tables.NAME
       - |tensor|
       - The entries of each array; exposed if ``storage`` is ``float32``.
       - |exposed|, |differentiable|

    An image or a material that is stored, with all its levels of detail, in small arrays and read by *differentiable
    indirection* (Datta et al., *Efficient Graphics Representation with Differentiable Indirection*, SIGGRAPH Asia 2023,
    task 4). Arrays that are read at uv and at the footprint point into another array, whose entries are the channels of
    all maps of a material: one chain of lookups decompresses and filters. Any BSDF and emitter can use the texture. Its
    exact counterpart is :monosp:`bitmap` with the original image, which needs many samples to filter. At equal samples
    the texture approximates :monosp:`mipmap`, which is its second counterpart. ``mi-diffind compare`` shows a scene
    beside both, :monosp:`bitmap` with 8 times the samples.

    The paragraphs of :monosp:`neural_image` on shared files, values between texels, spectra and positions on emitters
    hold for this texture, too.

    {footprint}

    **Frozen functions** (``dr.freeze``) that render keep the entries of their recording, here and in
    :monosp:`neural_image`: record them again after an optimiser has changed ``tables.NAME``.

    {gradient}

    {executable}

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
        maps, self._path = open_compressed(TASK, props)
        return maps


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
    exact=Counterpart("bitmap", ("filename", "channels", "storage", "source"), convert=_to_bitmap, oversampling=8),
    others=(Counterpart("mipmap", ("storage", "source"), convert=functools.partial(to_mipmap, TASK)),),
    truths=("mipmap", "exact"),
)
