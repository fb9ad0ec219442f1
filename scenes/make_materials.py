"""Writes ``materials.xml``: a chart of spheres, one row for each of the ten parameters of the Disney BRDF.

    python scenes/make_materials.py

A row starts from a material on which its parameter can be seen, and sweeps that parameter from 0 to 1 in
``COLUMNS`` steps. Rows come in two blocks of five, each with its name painted on the backdrop
(``assets/labels.png``, made by ``make_assets.py`` from ``LABELS`` below).
"""

from pathlib import Path

COLUMNS = 6
PITCH_X, PITCH_Z = 1.13, 2.75  # distance between sphere centres; a sphere has radius 0.5
BLOCK_GAP = 0.5  # extra distance between the two blocks of rows
STRETCH = 1.7  # of the letters on the floor, against foreshortening
FLOOR = 0.302  # albedo of the floor, and of the label texture between the letters

DEFAULTS = {
    "roughness": 0.5,
    "anisotropic": 0.0,
    "metallic": 0.0,
    "specular": 0.5,
    "spec_tint": 0.0,
    "sheen": 0.0,
    "sheen_tint": 0.0,
    "flatness": 0.0,
    "clearcoat": 0.0,
    "clearcoat_gloss": 0.0,
}

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

HEADER = """\
<?xml version="1.0" encoding="utf-8"?>
<!-- The ten parameters of the Disney BRDF. Written by make_materials.py: change that file, not this one.

     A row sweeps one parameter from 0 (left) to 1 (right). Material NAME_I is column I of row NAME. -->
<scene version="3.0.0">
    <default name="spp" value="64"/>
    <default name="width" value="960"/>
    <default name="height" value="552"/>
    <default name="max_depth" value="5"/>
    <default name="preset" value="tables"/>
    <default name="storage" value="uint8"/>
    <default name="effects" value="used"/>

    <integrator type="path">
        <integer name="max_depth" value="$max_depth"/>
    </integrator>

    <sensor type="perspective">
        <string name="fov_axis" value="x"/>
        <float name="fov" value="2.9"/>
        <transform name="to_world">
            <lookat origin="0, 150, 250" target="0, 0.25, 0.15" up="0, 1, 0"/>
        </transform>
        <sampler type="independent">
            <integer name="sample_count" value="$spp"/>
        </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$width"/>
            <integer name="height" value="$height"/>
            <string name="pixel_format" value="rgb"/>
            <string name="component_format" value="float32"/>
            <rfilter type="box"/>
        </film>
    </sensor>

    <!-- A hotel room by day, its window in front of the chart -->
    <emitter type="envmap">
        <string name="filename" value="assets/interior.exr"/>
        <float name="scale" value="0.9"/>
        <transform name="to_world">
            <rotate y="1" angle="20"/>
        </transform>
    </emitter>

    <!-- A wide softbox behind the chart, on the left: rims, sheen, long highlights -->
    <shape type="rectangle">
        <transform name="to_world">
            <scale x="10" y="4.2"/>
            <lookat origin="-7, 5.5, -21" target="0, 0, 0" up="0, 1, 0"/>
        </transform>
        <bsdf type="diffuse">
            <rgb name="reflectance" value="0, 0, 0"/>
        </bsdf>
        <emitter type="area">
            <rgb name="radiance" value="13, 12.6, 12"/>
        </emitter>
    </shape>

    <shape type="rectangle">
        <transform name="to_world">
            <scale x="80" y="80"/>
            <rotate x="1" angle="-90"/>
        </transform>
        <bsdf type="diffuse" id="floor">
            <rgb name="reflectance" value="FLOOR"/>
        </bsdf>
    </shape>
"""

LABEL = """
    <shape type="rectangle">
        <transform name="to_world">
            <scale x="{half_width:g}" y="{half_height:g}"/>
            <rotate x="1" angle="-90"/>
            <translate x="{x:.3f}" y="0.002" z="{z:.3f}"/>
        </transform>
        <bsdf type="diffuse">
            <texture name="reflectance" type="bitmap">
                <string name="filename" value="assets/labels.png"/>
                <boolean name="raw" value="true"/>
                <transform name="to_uv">
                    <scale y="-{v_scale:g}"/>
                    <translate y="{v_offset:g}"/>
                </transform>
            </texture>
        </bsdf>
    </shape>
"""

SPHERE = """
    <shape type="sphere">
        <transform name="to_world">
            <scale value="0.5"/>
            <rotate x="1" angle="-90"/>
            <translate x="{x:.3f}" y="0.5" z="{z:.3f}"/>
        </transform>
        <bsdf type="neural_disney" id="{name}_{column}">
            <string name="preset" value="$preset"/>
            <string name="storage" value="$storage"/>
            <string name="effects" value="$effects"/>
            <rgb name="base_color" value="{color}"/>
{parameters}
        </bsdf>
    </shape>
"""


def place(row: int, column: int) -> tuple[float, float]:
    """Centre (x, z) of a sphere on the floor; row 0 is the far left one, row 5 the far right one."""
    block, line = divmod(row, len(ROWS) // 2)
    side = 2 * block - 1
    x = side * (BLOCK_GAP + COLUMNS * PITCH_X) / 2 + (column - (COLUMNS - 1) / 2) * PITCH_X
    z = (line - (len(ROWS) // 2 - 1) / 2) * PITCH_Z
    return x, z


def sphere(row: int, column: int) -> str:
    """XML of one sphere and its material."""
    name, color, changes = ROWS[row]
    values = {**DEFAULTS, **changes, name: column / (COLUMNS - 1)}
    x, z = place(row, column)
    return SPHERE.format(
        name=name,
        column=column,
        color=", ".join(f"{c:g}" for c in color),
        parameters="\n".join(f'            <float name="{k}" value="{v:g}"/>' for k, v in values.items()),
        x=x,
        z=z,
    )


def label(row: int) -> str:
    """XML of the name of a row, painted on the floor in front of the row's first spheres."""
    half_width, rows = 1.9, len(ROWS)
    half_height = STRETCH * half_width / rows
    x, z = place(row, 0)
    # the atlas holds one name in each tenth of its height, the first on top, where v = 0; hence the flip
    return LABEL.format(
        half_width=half_width,
        half_height=half_height,
        x=x - 0.5 + half_width,
        z=z + 0.62,
        v_scale=1 / rows,
        v_offset=(row + 1) / rows,
    )


def document() -> str:
    """The whole scene."""
    parts = [HEADER.replace("FLOOR", f"{FLOOR:g}")]
    for row in range(len(ROWS)):
        parts.append(f"\n    <!-- {ROWS[row][0]} -->")
        parts.append(label(row))
        parts += [sphere(row, column) for column in range(COLUMNS)]
    return "".join(parts) + "</scene>\n"


if __name__ == "__main__":
    Path(__file__).with_name("materials.xml").write_text(document(), encoding="utf-8", newline="\n")
