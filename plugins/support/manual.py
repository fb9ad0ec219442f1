"""Parts of manual pages (the docstrings of plugins) that several plugins share."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from types import ModuleType

from mi_diffind.core import compat

#: Name of a placeholder → the text that stands for it: rows of the parameter table, and paragraphs.
PARTS = {
    "channels": """\
        * - channels
          - |string|
          - Name of the map to show, such as ``albedo``; it has 1 or 3 channels. A map with linear values beyond
            :math:`\\pm 10^9` is refused. (Default: the only map, or the only albedo)
          - --""",
    "raw": """\
        * - raw
          - |bool|
          - Leave values as they are in the image, as data need it: no conversion from sRGB, no spectral upsampling.
            (Default: false for colours; true for maps of data: ``normal``, ``roughness``, ``ao``, ``metallic``)
          - --""",
    "wrap_mode": """\
        * - wrap_mode
          - |string|
          - Behaviour outside of [0, 1], as for :monosp:`bitmap`: ``repeat``, ``mirror`` or ``clamp``.
            (Default: ``repeat``)
          - --""",
    "to_uv": """\
        * - to_uv
          - |transform|
          - Transformation of the texture coordinates, as for :monosp:`bitmap`, after the texture transform that the
            file may hold. (Default: none)
          - |exposed|""",
    "filtering": """\
        * - filter
          - |string|
          - ``trilinear``: read the level of detail whose texels have the area of the footprint; ``anisotropic``: read
            several places along the footprint's major axis, on a finer level; ``stochastic``: read one of these places,
            chosen at random; ``off``: read level 0, whatever the footprint. (Default: ``trilinear``)
          - --

        * - max_anisotropy
          - |int|
          - Places along the major axis for ``anisotropic`` and ``stochastic``, 1 to 16. (Default: 4)
          - --

        * - sensor_to_world, fov, resolution, spp
          - |transform|, |float|, |int|, |int|
          - The perspective sensor that sees the texture: its ``to_world``, its field of view along x, its number of
            pixels along x, and the samples of each (default: 1). Plain Mitsuba needs them; ``mi-diffind`` and
            ``mi_diffind.load_file`` take the sensor of the scene instead.
          - --

        * - filter_type, accel
          - |string|, |bool|
          - Accepted so that the parameters of :monosp:`bitmap` can be kept: ``bilinear`` is the filter ``off``,
            ``trilinear`` and ``anisotropic`` are the filters of these names; ``accel`` has no effect. (Default: none)
          - --""",
    "compressed": """\
        * - storage
          - |string|
          - ``uint8``, the fastest to read, or ``float32``, which can be optimised. (Default: ``uint8``)
          - --

        * - source
          - |string|
          - The image or the manifest that the file was made from; only the exact counterpart reads it. (Default: the
            path that the file records)
          - --""",
    "footprint": """\
        **The footprint** is that of one sample: that of a pixel, reduced by the square root of the number of samples.
        It comes from the first of these sources that has it: an integrator that
        fills the partial derivatives of uv, such as :monosp:`path_footprint`; the sensor, if the ray comes straight
        from it; otherwise an estimate that is rather too sharp than too blurred. Without any source, for instance
        without a sensor, the footprint is zero and the texture is not filtered: :monosp:`mi.render` warns once. No
        derivative passes through the
        footprint.

        ``anisotropic`` always reads ``max_anisotropy`` places, evenly spaced over the major axis, on a level half a
        step finer than the width of one place, which is nearer to the mean over the footprint than a full level.
        ``stochastic`` reads one of these places: unbiased with respect to ``anisotropic``, with the noise of one
        sample. The choice is a hash of the hit's position and uv, so all maps at a hit, and all samples through one
        point of a pixel, share it.""",
    "executable": """\
        The program ``mitsuba`` of Mitsuba 3.9 loads no plugins written in Python and ends with "Plugin not found". Use
        ``mi-diffind render SCENE.xml``, or ``import mi_diffind`` and :monosp:`mi.render` in Python.""",
    "gradient": """\
        With ``off``, the gradient that :monosp:`bumpmap` reads is that of :monosp:`bitmap`. Any other filter takes the
        difference over the width of one texel of the trilinear level.""",
}


def shared_parts(plugin: type) -> type:
    """Fill the placeholders of a plugin's docstring: a class decorator.

    ``{NAME}`` is one of :data:`PARTS`, ``{example TYPE PLUGIN: NAME=VALUE, …}`` the plugin in XML and in Python.
    """
    plugin.__doc__ = _filled(plugin.__doc__)
    return plugin


def manual_page(module: ModuleType) -> str:
    """Return the manual page of a plugin's module, without indentation: its ``MANUAL`` or the docstring of its class.

    Raises ``ValueError`` if it has none.
    """
    texts = [getattr(module, "MANUAL", "")]
    texts += [value.__doc__ or "" for value in vars(module).values() if isinstance(value, type)]
    name = module.__name__.rpartition(".")[2]
    for text in texts:
        if f"(:monosp:`{name}`)" in text and ".. pluginparameters::" in text:
            return _filled(inspect.cleandoc(text))
    raise ValueError(f"{module.__name__}: found no manual page, a docstring with a table of parameters is needed")


def _filled(text: str) -> str:
    def part(line: re.Match) -> str:
        text = _example(*line["example"].split(maxsplit=2)) if line["example"] else PARTS[line["name"]]
        return textwrap.indent(textwrap.dedent(text), line["indent"])

    return re.sub(r"^(?P<indent> *)\{(example (?P<example>.+)|(?P<name>\w+))\}$", part, text, flags=re.MULTILINE)


#: Type of an example's value → its tag in XML.
TAGS = {str: "string", float: "float", list: "rgb"}


def _example(object_type: str, name: str, arguments: str) -> str:
    """Return tabs with a plugin in XML and as a dictionary; ``arguments`` are those of a call in Python."""
    with compat.SYNTAX_TREES:
        name, call = name.rstrip(":"), ast.parse(f"example({arguments})", mode="eval").body
    xml, python = [f'<{object_type} type="{name}">'], [f"'type': '{name}'"]
    for keyword in call.keywords:
        value = ast.literal_eval(keyword.value)
        written = ", ".join(map(str, value)) if isinstance(value, list) else value
        xml.append(f'    <{TAGS[type(value)]} name="{keyword.arg}" value="{written}"/>')
        shown = f"{{\n    'type': 'rgb',\n    'value': {value}\n}}" if isinstance(value, list) else repr(value)
        python.append(f"'{keyword.arg}': {shown}")
    tabs = {f"xml\n    :name: {name}": [*xml, f"</{object_type}>"], "python": [",\n".join(python)]}
    blocks = [f".. code-tab:: {tab}\n\n" + textwrap.indent("\n".join(lines), "    ") for tab, lines in tabs.items()]
    return ".. tabs::\n" + textwrap.indent("\n\n".join(blocks), "    ")
