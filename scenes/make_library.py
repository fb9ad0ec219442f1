"""Write library.xml, a wall of materials beside what is learned of them, and what it needs in assets/library.

These are the sources (MATERIALS as .xml; with ``--data FOLDER`` networks.npz and fits.json, parts of the data of
Neural-BRDF and of dj_brdf) and labels.png, with the figures of the learned files. The latter are fitted by
``mi-diffind fit bsdf scenes/assets/library -o scenes/assets/library``.
"""

import argparse
import json
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from matplotlib import get_data_path
from PIL import Image, ImageDraw, ImageFont
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


#: Name → BSDF.
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

#: Name of a file → names of networks, in the file and in nbrdf_weights.npz.
NETWORKS = {
    "alum_bronze": "merl/alum-bronze",
    "satin_purple": "rgl/satin_purple_rgb",
    "golden_yellow": "rgl/vch_golden_yellow_rgb",
    "glossy_paper": "nielsen/glossyredpaper",
}

#: Fits of the shifted gamma distribution in merl_sgd.json.
FITS = ("blue-metallic-paint", "green-acrylic", "pink-jasper", "gold-paint")

#: Rows of the wall: heading → learned files.
ROWS = {
    "plugins": ("lacquer", "gilded", "aluminium", "pearl"),
    "networks": tuple(f"networks_{name}" for name in NETWORKS),
    "fits": tuple(f"fits_{name}" for name in FITS),
}

COLUMNS, RADIUS, SPACING = 4, 0.45, 1.42

#: Albedo of the wall, and pixels of a label for each unit of length.
WALL, PIXELS = 0.35, 220

SCENES = Path(__file__).resolve().parent
LIBRARY = SCENES / "assets" / "library"

ABOUT = f"""A library: of each pair of balls, the left one has the material, the right one what was learned of it in two
kilobytes. Below: name, bytes, and PSNR of a lit sphere. Written by make_library.py: change that file, not this one.

Rows: plugins of Mitsuba, {", ".join(ROWS["plugins"])}; networks of Neural-BRDF, {", ".join(NETWORKS)};
fits of measured materials by the shifted gamma distribution, {", ".join(FITS)}."""


def pair(column: int, row: int, name: str):
    """Yield the ball of a material, and that of its file."""
    file = {"filename": f"assets/library/{name}.npz"}
    if name in MATERIALS:
        source = ET.Element("bsdf", {**MATERIALS[name].attrib, "id": name})
        source.extend(MATERIALS[name])
    else:
        source = plugin("bsdf", "neural_bsdf", id=name, evaluate="source", **file)
    learned = plugin("bsdf", "neural_bsdf", id=f"{name}_learned", **file)
    for side, bsdf in ((-0.5, source), (0.5, learned)):
        centre = element("point", name="center", x=2.3 * (column - 1.5) + side, y=height(row), z=0.5)
        yield plugin("shape", "sphere", centre, bsdf, radius=RADIUS)


def height(row: int) -> float:
    """Return the height of the centres of a row's balls."""
    return SPACING * (1 - row) + 0.13


def label_strip(row: int):
    """Return the rectangle below a row of balls that shows its part of the labels."""
    share = 1 / len(ROWS)
    shown = transform("to_uv", scale={"x": 1, "y": -share}, translate={"y": (row + 1) * share})
    texture = plugin("texture", "bitmap", shown, name="reflectance", filename="assets/library/labels.png")
    place = transform(scale={"x": 4.6, "y": 0.14}, translate={"y": height(row) - 0.65, "z": 0.002})
    return plugin("shape", "rectangle", place, plugin("bsdf", "diffuse", texture))


def write_labels() -> None:
    """Write labels.png: name, bytes and PSNR of the learned files, row by row, dark on the wall's albedo."""
    import mi_diffind

    width, line = round(9.2 * PIXELS), round(0.14 * PIXELS)
    font = ImageFont.truetype(str(Path(get_data_path(), "fonts/ttf/DejaVuSans.ttf")), 28)
    wall = 1.055 * WALL ** (1 / 2.4) - 0.055  # sRGB
    image = Image.new("L", (width, 2 * line * len(ROWS)), round(255 * wall))
    draw = ImageDraw.Draw(image)
    for row, names in enumerate(ROWS.values()):
        for column, name in enumerate(names):
            table = mi_diffind.open(LIBRARY / f"{name}.npz").table
            title = name.removeprefix("networks_").removeprefix("fits_").replace("_", " ").replace("-", " ")
            lines = title, f"{table.nbytes:,} bytes, {table.measured['psnr_db']:.1f} dB"
            for k, text in enumerate(lines):
                place = (width / 2 + 2.3 * (column - 1.5) * PIXELS, (2 * row + k + 0.5) * line)
                draw.text(place, text, font=font, fill=8, anchor="mm")
    image.save(LIBRARY / "labels.png", optimize=True)


def write_data(folder: Path) -> None:
    """Write networks.npz and fits.json, from nbrdf_weights.npz and merl_sgd.json in ``folder``."""
    with np.load(folder / "nbrdf_weights.npz") as weights:
        np.savez(LIBRARY / "networks.npz", **{name: weights[key] for name, key in NETWORKS.items()})
    fits = json.loads((folder / "merl_sgd.json").read_text("utf-8"))
    (LIBRARY / "fits.json").write_text(json.dumps({name: fits[name] for name in FITS}, indent=1) + "\n", "utf-8")


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="with nbrdf_weights.npz and merl_sgd.json")
    data = parser.parse_args().data
    LIBRARY.mkdir(exist_ok=True, parents=True)
    if data:
        write_data(data)
    for name, material in MATERIALS.items():
        source = ET.Element("bsdf", {"version": "3.0.0", **material.attrib})
        source.extend(material)
        ET.indent(source, "    ")
        path = LIBRARY / f"{name}.xml"
        path.write_text(ET.tostring(source, encoding="unicode") + "\n", encoding="utf-8", newline="\n")
    if all((LIBRARY / f"{name}.npz").exists() for names in ROWS.values() for name in names):
        write_labels()
    wall = plugin("bsdf", "diffuse", reflectance=(WALL, WALL, WALL))
    content = [
        *head(1000, 460, {}, fov=22.0, camera=((0, 1.5, 24), (0, -0.05, 0))),
        "A hotel room by day",
        environment("interior.exr", scale=0.8, angle=200),
        "A softbox above on the left",
        softbox((1.6, 1.6), (-5, 5, 8), (0, 0, 0), radiance=(14, 13, 12)),
        "The wall",
        plugin("shape", "rectangle", transform(scale={"x": 20, "y": 20}), wall),
    ]
    for row, (heading, names) in enumerate(ROWS.items()):
        content += [heading.capitalize(), label_strip(row)]
        for column, name in enumerate(names):
            content += pair(column, row, name)
    write(SCENES / "library.xml", ABOUT, content)


if __name__ == "__main__":
    main()
