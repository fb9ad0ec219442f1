"""Write library.xml, a wall of materials beside what is learned of them, and assets/library/*.xml, their sources.

The learned files are fitted to the sources by ``mi-diffind fit bsdf scenes/assets/library -o scenes/assets/library``.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

from scene_xml import element, environment, head, plugin, principled, softbox, transform, write


def plastic(alpha: float, colour: tuple, **parameters):
    """Return a rough plastic."""
    return plugin("bsdf", "roughplastic", alpha=alpha, diffuse_reflectance=colour, **parameters)


def metal(material: str, alpha: float, distribution: str = "ggx"):
    """Return a rough conductor."""
    return plugin("bsdf", "roughconductor", material=material, alpha=alpha, distribution=distribution)


def blend(weight: float, first: ET.Element, second: ET.Element):
    """Return a blend; ``weight`` is that of the ``second`` BSDF."""
    return plugin("bsdf", "blendbsdf", first, second, weight=weight)


#: Name → BSDF, row by row.
MATERIALS = {
    "lacquer": principled(base_color=(0.7, 0.2, 0.08), roughness=0.35, metallic=0.2, clearcoat=1.0),
    "plastic": plastic(0.1, (0.1, 0.27, 0.36), nonlinear=True),
    "gilded": blend(0.6, plastic(0.2, (0.5, 0.1, 0.1)), metal("Au", 0.15, "beckmann")),
    "patchwork": blend(
        0.5,
        blend(0.5, plugin("bsdf", "diffuse", reflectance=(0.2, 0.5, 0.3)), plastic(0.05, (0.5, 0.5, 0.5))),
        blend(0.5, metal("Al", 0.3), principled(roughness=0.6, base_color=(0.6, 0.5, 0.1))),
    ),
    "copper": metal("Cu", 0.03),
    "chrome": metal("Cr", 0.1, "beckmann"),
    "rubber": plastic(0.4, (0.03, 0.03, 0.035)),
    "aluminium": plugin("bsdf", "roughconductor", material="Al", alpha_u=0.08, alpha_v=0.3, distribution="ggx"),
    "ceramic": principled(base_color=(0.75, 0.72, 0.65), roughness=0.6, clearcoat=1.0, clearcoat_gloss=0.95),
    "pearl": blend(0.35, principled(base_color=(0.8, 0.74, 0.76), roughness=0.45), metal("Ag", 0.2)),
    "bronze": principled(base_color=(0.55, 0.36, 0.16), roughness=0.4, metallic=1.0),
    "verdigris": blend(0.45, plugin("bsdf", "diffuse", reflectance=(0.15, 0.45, 0.38)), metal("Cu", 0.25)),
}  # fmt: skip

COLUMNS, RADIUS = 4, 0.45

ABOUT = f"""A library: of each pair of balls, the left one has the material, the right one what was learned of it in two
kilobytes. Written by make_library.py: change that file, not this one.

Rows: {"; ".join(", ".join(list(MATERIALS)[k : k + COLUMNS]) for k in range(0, len(MATERIALS), COLUMNS))}."""


def pair(index: int, name: str, material: ET.Element):
    """Yield the ball of a material, and that of its file."""
    column, row = index % COLUMNS, index // COLUMNS
    learned = plugin("bsdf", "neural_bsdf", id=f"{name}_learned", filename=f"assets/library/{name}.npz")
    named = ET.Element("bsdf", {**material.attrib, "id": name})
    named.extend(material)
    for side, bsdf in ((-0.5, named), (0.5, learned)):
        centre = element("point", name="center", x=2.3 * (column - 1.5) + side, y=1.15 * (1 - row), z=0.5)
        yield plugin("shape", "sphere", centre, bsdf, radius=RADIUS)


def main() -> None:
    """Write the files."""
    scenes = Path(__file__).resolve().parent
    for name, material in MATERIALS.items():
        source = ET.Element("bsdf", {"version": "3.0.0", **material.attrib})
        source.extend(material)
        ET.indent(source, "    ")
        path = scenes / "assets" / "library" / f"{name}.xml"
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_text(ET.tostring(source, encoding="unicode") + "\n", encoding="utf-8", newline="\n")
    wall = plugin("bsdf", "diffuse", reflectance=(0.35, 0.35, 0.35))
    content = [
        *head(1000, 400, {}, fov=22.0, camera=((0, 1.5, 24), (0, -0.05, 0))),
        "A hotel room by day",
        environment("interior.exr", scale=0.8, angle=200),
        "A softbox above on the left",
        softbox((1.6, 1.6), (-5, 5, 8), (0, 0, 0), radiance=(14, 13, 12)),
        "The wall",
        plugin("shape", "rectangle", transform(scale={"x": 20, "y": 20}), wall),
    ]
    for index, (name, material) in enumerate(MATERIALS.items()):
        content += [name.capitalize(), *pair(index, name, material)]
    write(scenes / "library.xml", ABOUT, content)


if __name__ == "__main__":
    main()
