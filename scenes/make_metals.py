"""Write metals.xml: rough conductors, a metal a row, from nearly smooth to fully rough."""

from pathlib import Path

from scene_xml import PRESET, element, environment, head, lying, number, plugin, repeated, softbox, write

METALS = (("gold", "Au"), ("copper", "Cu"), ("aluminium", "Al"))
ALPHAS = (0.001, 0.01, 0.05, 0.15, 0.4, 1.0)

ABOUT = f"""Rough conductors. Written by make_metals.py: change that file, not this one.

A row is a metal, a column a roughness: {", ".join(map(number, ALPHAS))}. The table's roughness is a bitmap."""

#: Of each learned material: what the scene's ``<default>`` values say.
LEARNED = {PRESET: f"${PRESET}", "storage": "$storage"}


def ball(row: int, column: int):
    """Return a sphere of the metal of its row and the roughness of its column."""
    name, material = METALS[row]
    metal = plugin("bsdf", "neural_ggx", id=f"{name}_{column}", **LEARNED, material=material, alpha=ALPHAS[column])
    centre = element("point", name="center", x=1.25 * (column - 2.5), y=0.5, z=1.35 * (row - 1))
    return plugin("shape", "sphere", centre, metal, radius=0.5)


def table():
    """Dark metal, whose roughness is a bitmap, twelve times in each direction."""
    roughness = plugin("texture", "bitmap", repeated(12), name="alpha", filename="assets/wood_roughness.png", raw=True)
    dark = {"material": "W", "specular_reflectance": (0.35, 0.37, 0.4)}
    return lying(30, 30, plugin("bsdf", "neural_ggx", roughness, id="table", **LEARNED, **dark))


def main() -> None:
    """Write the files."""
    camera = (0, 12, 15.5), (0, 0.25, 0.1)
    content = [
        *head(960, 500, {PRESET: "tables", "storage": "float32"}, fov=24.0, camera=camera),
        "A park in the afternoon",
        environment("forest.exr", scale=0.8, angle=160),
        "A softbox behind on the left",
        softbox((2.2, 1.4), (-5, 6, -5), (0, 0.5, 0), radiance=(14, 13, 12)),
        "Table: dark metal whose roughness is a bitmap",
        table(),
    ]
    for row, (name, _) in enumerate(METALS):
        content += [name.capitalize(), *(ball(row, column) for column in range(len(ALPHAS)))]
    write(Path(__file__).with_name("metals.xml"), ABOUT, content)


if __name__ == "__main__":
    main()
