"""Scene files for people to read: elements that the scripts beside share, and how they are written.

Mitsuba's own writer (``mi.parser.write_file``, of a parsed dictionary) is made for converting scenes, and loses what
these files are for: it knows no ``<default>`` but the width of the film, writes no comments, turns a ``lookat`` into
another one whose target is a unit away, and writes 0.1 as 0.10000000000000001. So the tree is built with Python's
``xml.etree``.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from itertools import pairwise
from pathlib import Path

#: The parameter of learned plugins that names how their tables were trained, also as the scene's ``<default>``.
PRESET = "preset"


class Whole(str):
    """The name of a ``<default>`` (``$name``) that stands for a whole number; a plain text stands for a text."""


def number(value: float) -> str:
    """At most six digits, none that says nothing."""
    return f"{value:g}"


def element(tag: str, *children: ET.Element, **attributes) -> ET.Element:
    """Return ``<tag …>``; numbers become texts, several as ``x, y, z``."""
    texts = {}
    for key, value in attributes.items():
        several = isinstance(value, (tuple, list))
        texts[key] = value if isinstance(value, str) else ", ".join(map(number, value if several else (value,)))
    node = ET.Element(tag, texts)
    node.extend(children)
    return node


def plugin(tag: str, plugin_type: str, *children: ET.Element, id: str = "", name: str = "", **parameters) -> ET.Element:
    """Return ``<tag type="plugin_type">`` with its ``parameters``.

    Parameters are ``True`` and ``False``, whole numbers, numbers, texts, and colours (three numbers). ``name`` is the
    parameter of the parent.
    """
    labels = {key: value for key, value in (("id", id), ("name", name)) if value}
    return element(tag, *(parameter(k, v) for k, v in parameters.items()), *children, type=plugin_type, **labels)


def parameter(name: str, value) -> ET.Element:
    """Return the element of one parameter, by the type of its value."""
    if isinstance(value, bool):
        return element("boolean", name=name, value=str(value).lower())
    tags = ((Whole, "integer"), (str, "string"), (int, "integer"), (float, "float"), (tuple, "rgb"))
    return element(next(tag for value_type, tag in tags if isinstance(value, value_type)), name=name, value=value)


def transform(name: str = "to_world", **steps: dict) -> ET.Element:
    """Return ``<transform>`` of ``steps`` (``scale``, ``rotate``, ``translate``, ``lookat``: attributes)."""
    return element("transform", *(element(step, **attributes) for step, attributes in steps.items()), name=name)


def head(
    width: int, height: int, learned: dict[str, str], fov: float, camera: tuple, integrator: ET.Element | None = None
) -> list[ET.Element]:
    """Return the first elements of a scene: ``<default>`` values (and ``learned`` ones), integrator, camera, film.

    ``camera`` is its place and its target; the ``integrator`` is by default a path tracer.
    """
    defaults = {"spp": 64, "width": width, "height": height, "max_depth": 5, **learned}
    film = plugin(
        "film", "hdrfilm", plugin("rfilter", "box"), width=Whole("$width"), height=Whole("$height"),
        pixel_format="rgb", component_format="float32",
    )  # fmt: skip
    if integrator is None:
        integrator = plugin("integrator", "path", max_depth=Whole("$max_depth"))
    sampler = plugin("sampler", "independent", sample_count=Whole("$spp"))
    return [
        *(element("default", name=name, value=value) for name, value in defaults.items()),
        integrator,
        plugin("sensor", "perspective", transform(lookat=look(*camera)), sampler, film, fov_axis="x", fov=fov),
    ]


def look(origin: tuple, target: tuple = (0, 0, 0)) -> dict:
    """Return the attributes of a ``lookat`` with y up."""
    return {"origin": origin, "target": target, "up": (0, 1, 0)}


def place(x: float, y: float, z: float) -> dict:
    """Return the attributes of a translation."""
    return {"x": x, "y": y, "z": z}


def turn(axis: str, angle: float) -> dict:
    """Return the attributes of a rotation around an axis, in degrees."""
    return {axis: 1, "angle": angle}


def repeated(u: float, v: float | None = None) -> ET.Element:
    """Return the transform of a texture that is repeated so often along ``u`` and ``v`` (default: as along ``u``)."""
    return transform("to_uv", scale={"x": u, "y": u if v is None else v})


def ref(name: str) -> ET.Element:
    """Return a material by its name."""
    return element("ref", id=name)


def principled(*children: ET.Element, **parameters) -> ET.Element:
    """Return a principled BSDF."""
    return plugin("bsdf", "principled", *children, **parameters)


def mesh(file: str, material: ET.Element, id: str = "", **steps) -> ET.Element:
    """Return a mesh of the assets."""
    return plugin("shape", "ply", transform(**steps), material, id=id or file, filename=f"assets/{file}.ply")


def ball(x: float, z: float, radius: float, bsdf: ET.Element) -> ET.Element:
    """Return a ball on the floor, whose texture has its poles on top and below."""
    placed = transform(rotate=turn("x", -90), translate=place(x, radius, z))
    return plugin("shape", "sphere", placed, bsdf, radius=radius)


def sun(x: float, y: float, z: float, irradiance: tuple) -> ET.Element:
    """Return a directional light."""
    return plugin("emitter", "directional", element("vector", name="direction", x=x, y=y, z=z), irradiance=irradiance)


def environment(file: str, scale: float, angle: float) -> ET.Element:
    """Return a light probe, turned around y."""
    turned = transform(rotate=turn("y", angle))
    return plugin("emitter", "envmap", turned, filename=f"assets/{file}", scale=scale)


def softbox(size: tuple[float, float], origin: tuple, target: tuple, radiance: tuple) -> ET.Element:
    """Return a rectangle at ``origin``, turned to ``target``, that emits light and reflects none."""
    placed = transform(scale={"x": size[0], "y": size[1]}, lookat=look(origin, target))
    black = plugin("bsdf", "diffuse", reflectance=(0, 0, 0))
    return plugin("shape", "rectangle", placed, black, plugin("emitter", "area", radiance=radiance))


def lying(half_width: float, half_depth: float, *children: ET.Element, **translate) -> ET.Element:
    """Return a horizontal rectangle that faces up."""
    steps = {"scale": {"x": half_width, "y": half_depth}, "rotate": turn("x", -90)}
    if translate:
        steps["translate"] = translate
    return plugin("shape", "rectangle", transform(**steps), *children)


def write(path: Path, about: str, content: list) -> None:
    """Write a scene: ``about``, a comment for the reader, then ``content``, elements and comments (texts)."""
    scene = element("scene", version="3.0.0")
    first, *others = about.split("\n")
    indented = [first, *(f"         {line}" if line else "" for line in others)]
    scene.append(ET.Comment(" " + "\n".join(indented) + " "))
    scene.extend(ET.Comment(f" {item} ") if isinstance(item, str) else item for item in content)
    ET.indent(scene, "    ")
    for item, follower in pairwise(scene):
        if item.tag is not ET.Comment and not item.tag == follower.tag == "default":
            item.tail = "\n" + item.tail  # an empty line between what belongs together
    text = ET.tostring(scene, encoding="unicode")
    path.write_text(f'<?xml version="1.0" encoding="utf-8"?>\n{text}\n', encoding="utf-8", newline="\n")
