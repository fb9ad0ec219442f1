"""Writes ``materials.xml``: a chart of spheres, one row for each of the ten parameters of the Disney BRDF.

    python scenes/make_materials.py

A row starts from a material on which its parameter can be seen, and sweeps that parameter from 0 to 1 in
``COLUMNS`` steps. Rows come in two blocks of five, each with its name painted on the backdrop
(``assets/labels.png``, made by ``make_assets.py`` from ``LABELS`` below).
"""

from pathlib import Path

from scene_xml import PRESET, element, environment, head, lying, plugin, softbox, transform, turn, write

COLUMNS = 6
PITCH_X, PITCH_Z = 1.13, 2.75  # distance between sphere centres; a sphere has radius 0.5
BLOCK_GAP = 0.5  # extra distance between the two blocks of rows
STRETCH = 1.7  # of the letters on the floor, against foreshortening
FLOOR = 0.302  # albedo of the floor, and of the label texture between the letters

DEFAULTS = {
    "roughness": 0.5, "anisotropic": 0.0, "metallic": 0.0, "specular": 0.5, "spec_tint": 0.0, "sheen": 0.0,
    "sheen_tint": 0.0, "flatness": 0.0, "clearcoat": 0.0, "clearcoat_gloss": 0.0,
}  # fmt: skip

# parameter that is swept, linear sRGB base colour, parameters that differ from DEFAULTS
ROWS = [
    ("metallic", (0.90, 0.50, 0.16), {"roughness": 0.22}),
    ("roughness", (0.86, 0.47, 0.38), {"metallic": 1.0}),
    ("anisotropic", (0.80, 0.79, 0.76), {"metallic": 1.0, "roughness": 0.42}),
    ("specular", (0.42, 0.022, 0.035), {"roughness": 0.16}),
    ("spec_tint", (0.010, 0.045, 0.18), {"roughness": 0.26, "specular": 1.0}),
    ("sheen", (0.002, 0.006, 0.022), {"roughness": 0.95, "specular": 0.1, "sheen_tint": 0.5}),
    ("sheen_tint", (0.024, 0.0024, 0.013), {"roughness": 0.95, "specular": 0.1, "sheen": 1.0}),
    ("flatness", (0.72, 0.40, 0.29), {"roughness": 0.90, "specular": 0.2}),
    ("clearcoat", (0.008, 0.085, 0.06), {"roughness": 0.62, "specular": 0.3, "clearcoat_gloss": 0.95}),
    ("clearcoat_gloss", (0.05, 0.015, 0.11), {"roughness": 0.75, "specular": 0.2, "clearcoat": 1.0}),
]

LABELS = [row[0] for row in ROWS]

ABOUT = """The ten parameters of the Disney BRDF. Written by make_materials.py: change that file, not this one.

A row sweeps one parameter from 0 (left) to 1 (right). Material NAME_I is column I of row NAME."""


def place(row: int, column: int) -> tuple[float, float]:
    """Centre (x, z) of a sphere on the floor; row 0 is the far left one, row 5 the far right one."""
    block, line = divmod(row, len(ROWS) // 2)
    side = 2 * block - 1
    x = side * (BLOCK_GAP + COLUMNS * PITCH_X) / 2 + (column - (COLUMNS - 1) / 2) * PITCH_X
    z = (line - (len(ROWS) // 2 - 1) / 2) * PITCH_Z
    return x, z


def sphere(row: int, column: int):
    """One sphere and its material."""
    name, color, changes = ROWS[row]
    x, z = place(row, column)
    placed = transform(
        scale={"value": 0.5}, rotate=turn("x", -90), translate={"x": round(x, 3), "y": 0.5, "z": round(z, 3)}
    )
    learned = {PRESET: f"${PRESET}", "storage": "$storage", "effects": "$effects"}
    values = {**DEFAULTS, **changes, name: column / (COLUMNS - 1)}
    material = plugin("bsdf", "neural_disney", id=f"{name}_{column}", **learned, base_color=color, **values)
    return plugin("shape", "sphere", placed, material)


def label(row: int):
    """Return the name of a row, painted on the floor in front of the row's first spheres."""
    half_width, rows = 1.9, len(ROWS)
    x, z = place(row, 0)
    # the atlas holds one name in each tenth of its height, the first on top, where v = 0; hence the flip
    atlas = plugin(
        "texture",
        "bitmap",
        transform("to_uv", scale={"y": -1 / rows}, translate={"y": (row + 1) / rows}),
        name="reflectance",
        filename="assets/labels.png",
        raw=True,
    )
    where = {"x": round(x - 0.5 + half_width, 3), "y": 0.002, "z": round(z + 0.62, 3)}
    return lying(half_width, STRETCH * half_width / rows, plugin("bsdf", "diffuse", atlas), **where)


def main() -> None:
    """Write the files."""
    camera = (0, 150, 250), (0, 0.25, 0.15)
    floor = element("rgb", name="reflectance", value=FLOOR)
    content = [
        *head(960, 552, {PRESET: "tables", "storage": "uint8", "effects": "used"}, fov=2.9, camera=camera),
        "A hotel room by day, its window in front of the chart",
        environment("interior.exr", scale=0.9, angle=20),
        "A wide softbox behind the chart, on the left: rims, sheen, long highlights",
        softbox((10, 4.2), (-7, 5.5, -21), (0, 0, 0), radiance=(13, 12.6, 12)),
        lying(80, 80, plugin("bsdf", "diffuse", floor, id="floor")),
    ]
    for row, (name, *_) in enumerate(ROWS):
        content += [name, label(row), *(sphere(row, column) for column in range(COLUMNS))]
    write(Path(__file__).with_name("materials.xml"), ABOUT, content)


if __name__ == "__main__":
    main()
