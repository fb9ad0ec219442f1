"""Write solids.xml: meshes and the signed distance fields fitted to them; see README.md.

``-D trace=grid -D integrator=path`` shows the same through Mitsuba's own grids.
"""

from pathlib import Path

import mitsuba as mi
from scene_xml import Whole, environment, head, lying, place, plugin, principled, ref, softbox, transform, turn, write

ABOUT = """Signed distance fields beside and in the place of meshes: Suzanne as a mesh (left) and as a field (right, the
same clay), a knot of gold that casts a shadow on the latter, a blue one, one of glass. Written by make_solids.py:
change that file.

"-D trace=grid -D integrator=path" decodes the fields to grids that any integrator traces."""

FOLDER = Path(__file__).resolve().parent


def solid(file: str, *children, **steps):
    """Return a signed distance field."""
    return plugin("shape", "neural_sdf", transform(**steps), *children, filename=f"assets/{file}.npz", trace="$trace")


def main() -> None:
    """Write the files."""
    mi.set_variant("scalar_rgb")
    tracer = plugin("integrator", "$integrator", max_depth=Whole("$max_depth"))
    camera = (0.3, 3.1, 8.2), (0.05, 0.85, 0)
    content = head(960, 540, {"trace": "arrays", "integrator": "path_sdf"}, 40.0, camera, tracer)
    clay = principled(id="clay", base_color=(0.62, 0.31, 0.2), roughness=0.6, specular=0.4)
    gold = plugin("bsdf", "roughconductor", id="gold", material="Au", alpha=0.12)
    glass = plugin("bsdf", "dielectric", id="glass", int_ior=1.5)
    blue = principled(id="blue", base_color=(0.08, 0.2, 0.5), roughness=0.25)
    floor = plugin("bsdf", "diffuse", reflectance=(0.55, 0.53, 0.5))
    content += [
        "A room by day, and a softbox from the right",
        environment("interior.exr", 0.35, 60.0),
        softbox((0.6, 0.6), (5.5, 6.0, 4.0), (0.6, 0.6, 0), (60.0, 54.0, 47.0)),
        "What things are made of", clay, gold, glass, blue,
        "The floor", lying(12, 12, floor),
        "Suzanne, a mesh and a field",
        plugin("shape", "ply", transform(rotate=turn("y", 14), translate=place(-1.7, 0, 0)), ref("clay"),
               filename="assets/suzanne.ply"),
        solid("suzanne", ref("clay"), rotate=turn("y", -8), translate=place(0.35, 0, -0.2)),
        "Knots: one that casts a shadow on the field, one on the floor, one of glass",
        solid("knot", ref("gold"), scale={"value": 0.36}, rotate=turn("x", 35), translate=place(1.4, 1.6, 0.85)),
        solid("knot", ref("blue"), scale={"value": 0.6}, rotate=turn("y", 60), translate=place(2.0, 0, -0.35)),
        solid("knot", ref("glass"), scale={"value": 0.5}, rotate=turn("x", 75), translate=place(-0.7, 0.45, 1.5)),
    ]  # fmt: skip
    write(FOLDER / "solids.xml", ABOUT, content)


if __name__ == "__main__":
    main()
