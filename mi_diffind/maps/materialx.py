"""Materials of MaterialX files: image nodes behind the inputs of a surface shader."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..core.errors import reason
from ..core.files import irregular, shown
from .entries import IDENTITY, ImageFiles, MapEntry, SourceError, choose_material, to_transform, uv_matrix

#: Bytes and nested elements of the largest document, and nodes between an input and its image.
MOST_BYTES = 2**22
MOST_DEPTH = 64

#: Shader → map → its input and the input's default.
SHADERS = {
    "standard_surface": {
        "albedo": ("base_color", 0.8), "normal": ("normal", None), "roughness": ("specular_roughness", 0.2),
        "metallic": ("metalness", 0.0), "opacity": ("opacity", None),
    },
    "open_pbr_surface": {
        "albedo": ("base_color", 0.8), "normal": ("geometry_normal", None), "roughness": ("specular_roughness", 0.3),
        "metallic": ("base_metalness", 0.0), "opacity": ("geometry_opacity", None),
    },
    "gltf_pbr": {
        "albedo": ("base_color", 1.0), "normal": ("normal", None), "roughness": ("roughness", 1.0),
        "metallic": ("metallic", 1.0), "ao": ("occlusion", None), "opacity": ("alpha", None),
    },
    "UsdPreviewSurface": {
        "albedo": ("diffuseColor", 0.18), "normal": ("normal", None), "roughness": ("roughness", 0.5),
        "metallic": ("metallic", 0.0), "ao": ("occlusion", None), "opacity": ("opacity", None),
    },
}  # fmt: skip

#: Shader → input that multiplies its base colour.
WEIGHTS = {"standard_surface": "base", "open_pbr_surface": "base_weight"}

#: Nodes that read an image, and nodes that pass on the value of their input ``in``.
IMAGES = ("image", "tiledimage", "gltf_image", "gltf_colorimage", "gltf_normalmap", "UsdUVTexture")
PASSED = ("normalmap", "convert", "dot", "separate2", "separate3", "separate4", "extract", "multiply", "invert")

#: Last letter of an output → channel.
CHANNELS = dict(zip("xyzwrgba", "rgbargba", strict=True))

#: Color space of an image → that of the map.
SPACES = {"srgb_texture": "srgb", "lin_rec709": "linear", "lin_srgb": "linear", "raw": "linear", "": "linear"}


def read_materialx(path: Path, name: str, images: ImageFiles) -> tuple[list[MapEntry], list[str], bool]:
    """Return the maps of the material called ``name``, or of the only one, notes, and no second side.

    Notes say what is not used. Raises :class:`SourceError`, also without the package MaterialX.
    """
    try:
        import MaterialX as mx
    except ImportError:
        raise SourceError(f'{path}: reading it needs MaterialX: pip install "mi-diffind[materialx]"') from None
    _check(path)
    document, options = mx.createDocument(), mx.XmlReadOptions()
    options.readXIncludeFunction = None  # other files
    try:
        mx.readFromXmlFile(document, str(path), mx.FileSearchPath(), options)
        pairs = [(m.getName(), node) for m in document.getMaterialNodes() for node in mx.getShaderNodes(m)]
        shader = pairs[choose_material(path, [name for name, _ in pairs], name)][1]
        return *_entries(path, shader, images), False
    except SourceError:
        raise
    except Exception as e:  # classes of the package
        raise SourceError(f"{path}: is no valid MaterialX file ({reason(e)})") from None


def _check(path: Path) -> None:
    """Raise :class:`SourceError` for a file that is no XML, or too large or deep for the package's own reader."""
    from xml.etree import ElementTree

    if fault := irregular(path, MOST_BYTES):
        raise SourceError(f"{shown(path)}: {fault}")
    depth = 0
    try:
        for event, _ in ElementTree.iterparse(path, events=("start", "end")):
            depth += 1 if event == "start" else -1
            if depth > MOST_DEPTH:
                raise SourceError(f"{shown(path)}: has more than {MOST_DEPTH} elements in each other")
    except OSError as e:
        raise SourceError(f"{shown(path)}: {'no such file' if not path.exists() else reason(e)}") from None
    except ElementTree.ParseError as e:
        raise SourceError(f"{shown(path)}: is not valid XML ({reason(e)})") from None


def _entries(path: Path, shader, images: ImageFiles) -> tuple[list[MapEntry], list[str]]:
    """Return the maps behind the inputs of a shader, and notes."""
    inputs = SHADERS.get(shader.getCategory())
    if inputs is None:
        raise SourceError(f"{path}: has the shader {shader.getCategory()}, allowed are {', '.join(SHADERS)}")
    entries, notes = [], []
    weight = WEIGHTS.get(shader.getCategory(), "")
    weights = _numbers(shader.getInput(weight)) if weight and shader.getInput(weight) else ()
    for name, (port_name, default) in inputs.items():
        port = shader.getInput(port_name)
        if port is not None and port.getConnectedNode() is not None:
            entry, note = _trace(path, name, port, images)
            entries += [entry] if entry else []
            notes += [f"{port_name}: {note}"] if note else []
        elif default is not None or port is not None:
            values = _numbers(port) if port is not None else (default,)
            if values and name != "normal":
                entries.append(MapEntry(name, color_space="linear", factor=values, constant=True))
        if name == "albedo" and entries and weights not in ((), (1.0,)):
            entries[-1] = _times(entries[-1], weights)
    known = {port for port, _ in inputs.values()} | {weight}
    unused = [port.getName() for port in shader.getInputs() if port.getName() not in known]
    return entries, notes + ([f"{path.name}: inputs that are not used: {', '.join(unused)}"] if unused else [])


def _trace(path: Path, name: str, port, images: ImageFiles) -> tuple[MapEntry | None, str]:
    """Return the map behind an input, ``None`` if it is none of one image, and a note."""
    channel, changes = None, MapEntry(name, opaque=True)
    for _ in range(MOST_DEPTH):
        node, output = port.getConnectedNode(), port.getConnectedOutput()
        if node is None:
            return None, "not used, its value is no image"
        text, category = output.getOutputString() if output else port.getOutputString(), node.getCategory()
        if text and text not in ("out", "rgb", "outcolor") and channel is None:
            channel = CHANNELS.get(text[-1])
        if category in IMAGES:
            break
        if category not in PASSED:
            return None, f'not used, its value comes from the node "{category}"'
        if category == "extract":
            channel = "rgba"[int(node.getInput("index").getValueString())] if node.getInput("index") else "r"
        if category == "invert":
            changes = replace(changes, inverted=not changes.inverted)
        port = node.getInput("in")
        factor = node.getInput({"multiply": "in2", "normalmap": "scale"}.get(category, ""))
        if category == "multiply":
            first = node.getInput("in1")
            port, factor = (first, factor) if first.getConnectedNode() else (factor, first)
        if factor is not None:
            if factor.getConnectedNode() is not None or changes.inverted:
                return None, f'not used, its value comes from the node "{category}", which is no factor of an image'
            changes = _times(changes, _numbers(factor))
    else:
        return None, "not used, too many nodes lie before its image"
    file = node.getInput("file")
    space = SPACES.get(file.getActiveColorSpace())
    if space is None:
        raise SourceError(f"{path}: {name} has the color space {file.getActiveColorSpace()}, allowed are {[*SPACES]}")
    known = {"gltf_normalmap": "scale"}.get(category, "factor")
    if (factor := node.getInput(known)) is not None:
        changes = _times(changes, _numbers(factor))
    try:
        transform, read = _transform(node)
    except (IndexError, ValueError):
        transform, read = IDENTITY, []
    unused = [p.getName() for p in node.getInputs() if p.getName() not in ("file", known, *read)]
    note = f"{category}: inputs that are not used: {', '.join(unused)}" if unused else ""
    single = name in ("roughness", "metallic", "ao", "opacity")
    if channel and not single:
        return None, f"not used, it is the channel {channel} of an image"
    if single and node.getType() == "float":
        channel = channel or "r"
    return replace(
        changes, file=images.find(path.parent, file.getResolvedValueString(), path), channels=channel,
        color_space=space if name == "albedo" else "linear", single=single, transform=transform,
    ), note  # fmt: skip


def _transform(image) -> tuple[tuple[float, ...], list[str]]:
    """Return the texture transform of a node that reads an image, and the names of the inputs that it follows from.

    Raises ``IndexError`` and ``ValueError`` for inputs without a value.
    """

    def values(node, name: str, *default: float) -> np.ndarray:
        port = node.getInput(name)
        return np.array(default if port is None else _numbers(port.getInterfaceInput() or port))

    def before(node):
        port = node.getInput("texcoord")
        return port.getConnectedNode() if port is not None else None

    matrix, read, node = np.eye(3), [], before(image)
    if image.getCategory() == "tiledimage":
        matrix = uv_matrix(values(image, "uvtiling", 1, 1), offset=-values(image, "uvoffset", 0, 0))
        read = ["uvtiling", "uvoffset"]
    if node is not None and node.getCategory() == "place2d":
        pivot, rotation = values(node, "pivot", 0, 0), math.radians(values(node, "rotate", 0)[0])
        with np.errstate(all="ignore"):  # infinite numbers are refused with the others
            steps = [uv_matrix(offset=-values(node, "offset", 0, 0)), uv_matrix(rotation=rotation)]
            steps.append(uv_matrix(1 / values(node, "scale", 1, 1)))
            first, second, third = steps[::-1] if values(node, "operationorder", 0)[0] else steps
            matrix = matrix @ uv_matrix(offset=pivot) @ first @ second @ third @ uv_matrix(offset=-pivot)
        node = before(node)
    if node is None or (node.getCategory() == "texcoord" and not values(node, "index", 0)[0]):
        read.append("texcoord")
    flip = uv_matrix((1, -1), offset=(0, 1))  # v points up in MaterialX
    return to_transform(flip @ matrix @ flip), read


def _times(entry: MapEntry, values: tuple[float, ...]) -> MapEntry:
    """Return an entry with further factors."""
    count = max(len(entry.factor), len(values))
    pairs = ((v * count if len(v) == 1 else v) for v in (entry.factor or (1.0,), values))
    factor = tuple(a * b for a, b in zip(*pairs, strict=True))
    return replace(entry, factor=() if set(factor) == {1.0} and not entry.constant else factor)


def _numbers(port) -> tuple[float, ...]:
    """Return the value of an input: one number or several, () without a value. Raises ``ValueError``."""
    return tuple(float(number) for number in port.getValueString().split(",") if number.strip())
