"""Write metals.xml: rough conductors, a metal a row, from nearly smooth to fully rough."""

from pathlib import Path

METALS = (("gold", "Au"), ("copper", "Cu"), ("aluminium", "Al"))
ALPHAS = (0.001, 0.01, 0.05, 0.15, 0.4, 1.0)

HEAD = """\
<?xml version="1.0" encoding="utf-8"?>
<!-- Rough conductors. Written by make_metals.py: change that file, not this one.

     A row is a metal, a column a roughness: {alphas}. The table's roughness is a bitmap. -->
<scene version="3.0.0">
    <default name="spp" value="64"/>
    <default name="width" value="960"/>
    <default name="height" value="500"/>
    <default name="max_depth" value="5"/>
    <default name="preset" value="tables"/>
    <default name="storage" value="float32"/>

    <integrator type="path">
        <integer name="max_depth" value="$max_depth"/>
    </integrator>

    <sensor type="perspective">
        <string name="fov_axis" value="x"/>
        <float name="fov" value="24"/>
        <transform name="to_world">
            <lookat origin="0, 12, 15.5" target="0, 0.25, 0.1" up="0, 1, 0"/>
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

    <!-- A park in the afternoon -->
    <emitter type="envmap">
        <string name="filename" value="assets/forest.exr"/>
        <float name="scale" value="0.8"/>
        <transform name="to_world">
            <rotate y="1" angle="160"/>
        </transform>
    </emitter>

    <!-- A softbox behind on the left -->
    <shape type="rectangle">
        <transform name="to_world">
            <scale x="2.2" y="1.4"/>
            <lookat origin="-5, 6, -5" target="0, 0.5, 0" up="0, 1, 0"/>
        </transform>
        <bsdf type="diffuse">
            <rgb name="reflectance" value="0, 0, 0"/>
        </bsdf>
        <emitter type="area">
            <rgb name="radiance" value="14, 13, 12"/>
        </emitter>
    </shape>

    <!-- Table: dark metal whose roughness is a bitmap -->
    <shape type="rectangle">
        <transform name="to_world">
            <scale x="30" y="30"/>
            <rotate x="1" angle="-90"/>
        </transform>
        <bsdf type="neural_ggx" id="table">
            <string name="preset" value="$preset"/>
            <string name="storage" value="$storage"/>
            <string name="material" value="W"/>
            <rgb name="specular_reflectance" value="0.35, 0.37, 0.4"/>
            <texture name="alpha" type="bitmap">
                <string name="filename" value="assets/wood_roughness.png"/>
                <boolean name="raw" value="true"/>
                <transform name="to_uv">
                    <scale x="12" y="12"/>
                </transform>
            </texture>
        </bsdf>
    </shape>
"""

BALL = """
    <shape type="sphere">
        <point name="center" x="{x:g}" y="0.5" z="{z:g}"/>
        <float name="radius" value="0.5"/>
        <bsdf type="neural_ggx" id="{name}_{column}">
            <string name="preset" value="$preset"/>
            <string name="storage" value="$storage"/>
            <string name="material" value="{material}"/>
            <float name="alpha" value="{alpha:g}"/>
        </bsdf>
    </shape>
"""


def main() -> None:
    text = HEAD.format(alphas=", ".join(f"{alpha:g}" for alpha in ALPHAS))
    for row, (name, material) in enumerate(METALS):
        for column, alpha in enumerate(ALPHAS):
            place = {"x": 1.25 * (column - 2.5), "z": 1.35 * (row - 1)}
            text += BALL.format(name=name, column=column, material=material, alpha=alpha, **place)
    (Path(__file__).parent / "metals.xml").write_text(text + "</scene>\n", encoding="utf-8")


if __name__ == "__main__":
    main()
