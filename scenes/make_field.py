"""Write field.xml and field_lit.xml: a radiance field among meshes.

The field was captured from capture_group.xml and compressed (``mi-diffind capture``, ``mi-diffind fit field``). See
README.md.
"""

from pathlib import Path

from scene_xml import (
    Whole,
    element,
    environment,
    head,
    lying,
    mesh,
    place,
    plugin,
    principled,
    ref,
    repeated,
    transform,
    turn,
    write,
)  # fmt: skip

ABOUT = """A radiance field among meshes: Suzanne, a vase, a knot and a pear, captured in the same light, on a mirror
that shows them from below. A golden knot before them and a jar behind are meshes; a mirror shows their other side, and
a ball of glass is there to see them through. The field casts no shadow; that of field_lit.xml does. Written by
make_field.py: change that file.

"-D file=…" takes another field."""

ABOUT_LIT = """A radiance field that lights and shadows the surfaces around it: Suzanne, a vase, a knot and a pear on a
white table, before a brushed plate, beside a ball of plastic, in the light of their capture. Written by
make_field.py: change that file.

"-D lit=false" renders the field without its light and its shadow."""

#: Camera of both scenes.
CAMERA = (2.2, 2.4, 6.5), (0.02, 0.68, 0)

FOLDER = Path(__file__).resolve().parent


def write_lit() -> None:
    """Write field_lit.xml."""
    lit = element("boolean", name="lit", value="$lit")
    field = plugin("integrator", "neural_field", lit, filename="$file", max_depth=Whole("$max_depth"))
    content = head(960, 540, {"file": "assets/group.npz", "lit": "true"}, 41.0, CAMERA, field)
    plate = plugin("bsdf", "twosided", plugin("bsdf", "roughconductor", material="Al", alpha=0.1), id="plate")
    ball = plugin("bsdf", "plastic", diffuse_reflectance=(0.5, 0.03, 0.02))
    content += [
        "The light that the field was captured in",
        environment("forest.exr", 0.8, 40.0),
        "A table",
        lying(5, 5, plugin("bsdf", "diffuse", reflectance=(0.7, 0.7, 0.7)), y=-0.01),
        "A brushed plate behind the field, turned towards the camera, and a ball",
        plate,
        plugin("shape", "rectangle", transform(scale={"x": 1.1, "y": 1.0}, rotate=turn("y", 42),
               translate=place(-2.1, 1.0, -1.5)), ref("plate")),
        plugin("shape", "sphere", ball, transform(scale={"value": 0.36}, translate=place(-0.3, 0.35, 1.9))),
    ]  # fmt: skip
    write(FOLDER / "field_lit.xml", ABOUT_LIT, content)


def main() -> None:
    """Write the files."""
    write_lit()
    surfaces = plugin("integrator", "path", name="surfaces", max_depth=Whole("$max_depth"))
    field = plugin("integrator", "neural_field", surfaces, filename="$file")
    content = head(960, 540, {"file": "assets/group.npz"}, 41.0, CAMERA, field)
    mirror = plugin("bsdf", "twosided", plugin("bsdf", "conductor", material="Ag"), id="mirror")
    glass = plugin("bsdf", "dielectric", id="glass", int_ior=1.5)
    gold = plugin("bsdf", "roughconductor", material="Au", alpha=0.15)
    jar = principled(base_color=(0.6, 0.58, 0.52), roughness=0.35, specular=0.5)
    planks = plugin("texture", "bitmap", repeated(3), name="reflectance", filename="assets/wood_color.png")
    wood = plugin("bsdf", "diffuse", planks)
    content += [
        "The light that the field was captured in",
        environment("forest.exr", 0.8, 40.0),
        "Mirrors and glass", mirror, glass,
        "A table, and a mirror on it that the field stands on",
        lying(5, 5, wood, y=-0.03),
        plugin("shape", "disk", transform(scale={"value": 1.75}, rotate=turn("x", -90), translate=place(0, -0.01, 0.1)),
               ref("mirror")),
        "A mirror behind the field, turned towards the camera",
        plugin("shape", "rectangle", transform(scale={"x": 1.1, "y": 1.0}, rotate=turn("y", 42),
               translate=place(-2.1, 1.0, -1.5)), ref("mirror")),
        "Meshes: a knot before the field, a jar behind, a ball of glass",
        mesh("knot", gold, scale={"value": 0.5}, rotate=turn("y", 20), translate=place(0.35, 0, 1.85)),
        mesh("jar", jar, scale={"value": 1.2}, translate=place(-0.55, 0, -1.75)),
        plugin("shape", "sphere", transform(scale={"value": 0.36}, translate=place(-0.62, 0.37, 2.1)),
               ref("glass"), id="ball"),
    ]  # fmt: skip
    write(FOLDER / "field.xml", ABOUT, content)


if __name__ == "__main__":
    main()
