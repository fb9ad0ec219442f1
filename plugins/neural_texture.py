"""Compressed texture or material with levels of detail."""

from __future__ import annotations  # Delayed parsing of type annotations

import functools

import mitsuba as mi

from mi_diffind.tasks.texture import TASK

from . import Counterpart, Plugin, Stock
from .support.image_files import SharedMaps, fit_images, open_compressed, remove, to_bitmap, to_mipmap
from .support.manual import shared_parts
from .support.map_textures import FilteredTexture
from .support.properties import StockNode
from .support.textures import PROPERTIES as FILTERING


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
    beside both, :monosp:`bitmap` with 8 times the samples. A file that was trained for its shading may be read at a
    finer level of detail than the footprint's; the file says by how much.

    The paragraphs of :monosp:`neural_image` on shared files, values between texels, spectra and positions on emitters
    hold for this texture, too.

    {footprint}

    {gradient}

    {executable}

    {example texture neural_texture: filename="wall.npz", channels="albedo"}
    """

    def _open(self, props: mi.Properties) -> SharedMaps:
        maps, self._path = open_compressed(TASK, props)
        return maps


def _to_bitmap(props: mi.Properties) -> None:
    to_bitmap(TASK, props)
    remove(props, *FILTERING)


def _from_bitmap(node: StockNode) -> str:
    """Replace the image of a ``bitmap`` by a compressed one."""
    props = node.props
    normal = any(parent.plugin_name() == "normalmap" for parent in node.parents)
    raw = props.get("raw", False) is True
    table, quality = fit_images(TASK, node, {"normal" if normal else "data" if raw else "albedo": node})
    props["filename"] = str(table.path)
    remove(props, "filter_type", "format", "accel")  # a bitmap's "bilinear" would switch filtering off
    return quality


PLUGIN = Plugin(
    "neural_texture",
    "texture",
    NeuralTexture,
    task=TASK.name,
    exact=Counterpart("bitmap", ("filename", "channels", "storage", "source"), convert=_to_bitmap, oversampling=8),
    others=(Counterpart("mipmap", ("storage", "source"), convert=functools.partial(to_mipmap, TASK)),),
    truths=("mipmap", "exact"),
    stock=Stock("bitmap", ("bitmap",), _from_bitmap, advised=True),
)
