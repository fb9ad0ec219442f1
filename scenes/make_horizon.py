"""Write horizon.xml: a floor of glazed tiles to the horizon, pillars that recede, a mirror ball and a ball of tiles.

The light is a sun and a sky of one colour, which is only found by scattering: of what is diffuse it has no noise, so
that one sample a pixel shows what becomes of the textures.
"""

from pathlib import Path

from scene_xml import Whole, element, head, lying, place, plugin, principled, ref, repeated, sun, transform, turn, write

ABOUT = """Tiles to the horizon, with textures that filter themselves. Written by make_horizon.py: change that file.

With one sample a pixel, and "bitmap" in place of "neural_texture", one sees what for."""

#: Half of the width of the floor, and of a repetition of the texture (4 × 4 tiles).
FLOOR, TILES = 400.0, 1.0

#: The file with the maps, and how it is filtered.
LEARNED = {"filename": "assets/tiles_filtered.npz", "storage": "$storage", "filter": "$filter"}

#: Where pillars stand.
PILLARS = [(side * 2.6, -2.2 - 3.6 * k) for k in range(7) for side in (-1, 1)]


def tiles(u: float, v: float, id: str, glossy: bool = False):
    """Return the material, its maps repeated the given number of times."""

    def of(channels: str, parameter: str):
        return plugin("texture", "neural_texture", repeated(u, v), name=parameter, channels=channels, **LEARNED)

    if glossy:
        glaze = principled(of("albedo", "base_color"), of("roughness", "roughness"))
    else:
        glaze = plugin("bsdf", "diffuse", of("albedo", "reflectance"))
    return plugin("bsdf", "normalmap", of("normal", "normalmap"), glaze, id=id)


def pillar(x: float, z: float):
    """Return a cylinder with a lid."""
    ends = [element("point", name=name, x=x, y=y, z=z) for name, y in (("p0", 0), ("p1", 2.8))]
    side = plugin("bsdf", "twosided", ref("pillar_tiles"))
    lid = plugin("bsdf", "diffuse", reflectance=(0.5, 0.47, 0.42))
    flat = transform(scale={"x": 0.4, "y": 0.4}, rotate=turn("x", -90), translate=place(x, 2.8, z))
    return [plugin("shape", "cylinder", *ends, side, radius=0.4), plugin("shape", "disk", flat, lid)]


def main() -> None:
    """Write the files."""
    tracer = plugin("integrator", "path_footprint", max_depth=Whole("$max_depth"))
    camera = (0, 1.5, 5.2), (0, 1.05, 0)
    content = head(960, 540, {"storage": "uint8", "filter": "anisotropic"}, 52.0, camera, tracer)
    sky = plugin("emitter", "constant", radiance=(0.36, 0.44, 0.56), sampling_weight=0.0)
    mirror = plugin("bsdf", "conductor", material="Ag")
    content += [
        "A sun, and a sky that is found by scattering alone",
        sun(0.62, -0.6, -0.75, (2.9, 2.6, 2.2)),
        sky,
        "The floor",
        tiles(FLOOR / TILES, FLOOR / TILES, "floor_tiles"),
        lying(FLOOR, FLOOR, ref("floor_tiles")),
        "Pillars",
        tiles(1.0, 1.0, "pillar_tiles"),
        *(shape for pillar_place in PILLARS for shape in pillar(*pillar_place)),
        "A mirror, in which the floor is seen again",
        plugin("shape", "sphere", element("point", name="center", x=-0.75, y=0.8, z=0.4), mirror, radius=0.8),
        "A ball of the same tiles, glossy",
        plugin("shape", "sphere", transform(rotate=turn("x", -90), translate=place(1.15, 0.6, 1.1)),
               tiles(2.0, 1.0, "ball_tiles", glossy=True), radius=0.6),
    ]  # fmt: skip
    write(Path(__file__).with_name("horizon.xml"), ABOUT, content)


if __name__ == "__main__":
    main()
