"""Write training_balls.xml, training_floor.xml and training_corner.xml: what ``tradeoff scene-training`` measures.

Each scene shows one compressed material (``neural_material``), minified, under lights that a training may turn.
"""

from pathlib import Path

from scene_xml import ball, element, environment, head, lying, plugin, repeated, sun, transform, write

ABOUT = """{}, for measurements of training inside a scene ("mi-diffind tradeoff scene-training"). Written by
make_training.py: change that file. "-D material=FILE.npz" takes another file."""

FOLDER = Path(__file__).resolve().parent


def material(repeats: float, **parameters):
    """Return the material, its maps repeated the given number of times."""
    return plugin("bsdf", "neural_material", repeated(repeats), filename="assets/$material", storage="uint8",
                  filter="anisotropic", **parameters)  # fmt: skip


def save(name: str, what: str, file: str, fov: float, camera: tuple, content: list) -> None:
    """Write one scene; ``camera`` is its place and its target."""
    start = head(96, 54, {"material": file}, fov, camera)
    write(FOLDER / f"training_{name}.xml", ABOUT.format(what), [*start, *content])


def main() -> None:
    """Write the files."""
    sky = plugin("emitter", "constant", radiance=(0.5, 0.5, 0.5), sampling_weight=0.0)
    places = ((-1.7, 0.4, 0.8, 3.0), (0.25, -0.6, 0.8, 8.0), (1.9, 0.9, 0.6, 16.0))
    balls = [ball(x, z, radius, material(repeats)) for x, z, radius, repeats in places]
    plate = [lying(5, 5, material(24.0)), *balls]
    save("balls", "The plate and balls of rust.xml in one plugin a material", "rust_plain.npz", 36.0,
         ((0, 4.2, 7.5), (0, 0.35, 0.2)), [sun(-0.55, -0.6, 0.35, (3.2, 3.008, 2.72)), sky, *plate])  # fmt: skip

    white = plugin("bsdf", "diffuse", reflectance=(0.7, 0.68, 0.64))
    floor = [environment("interior.exr", 0.9, 20), lying(6, 6, material(10.0, ignore="ao")),
             ball(-0.9, -0.4, 0.9, white), ball(1.3, 0.5, 0.6, material(3.0, ignore="ao"))]  # fmt: skip
    save("floor", "A floor and a ball of glazed tiles under an environment", "tiles_filtered.npz", 42.0,
         ((0, 2.6, 6.2), (0, 0.3, 0)), floor)  # fmt: skip

    walls = [lying(3, 3, material(8.0))]
    for steps in (
        {"translate": {"x": 0, "y": 0, "z": -3}},
        {"rotate": {"y": 1, "angle": 90}, "translate": {"x": -3, "y": 0, "z": 0}},
    ):
        placed = transform(scale={"x": 3, "y": 3}, **steps)
        walls.append(plugin("shape", "rectangle", placed, material(8.0)))
    lamp = plugin(
        "emitter", "point", element("point", name="position", x=0.6, y=2.4, z=0.9), intensity=(14.0, 13.0, 12.0)
    )
    save("corner", "Two walls and a floor of rough metal that light each other", "rust_plain.npz", 48.0,
         ((4.6, 2.6, 4.6), (-1.4, 0.6, -1.4)), [lamp, sky, *walls])  # fmt: skip


if __name__ == "__main__":
    main()
