"""Write rust.xml and the maps of its metal: a plate and balls of hammered metal with rust, seen from afar.

``-D metal=rust_plain.npz`` shows the same with the texture that is not trained for its shading. The maps are compressed
by ``mi-diffind fit texture``, see README.md.

``--picture`` renders rust.jpg instead, the picture of the page on shading, and ``--json FILE`` writes its errors.
"""

import argparse
import json
from pathlib import Path

import mitsuba as mi
import numpy as np
from labelled import labelled
from PIL import Image
from scene_xml import ball, element, head, lying, plugin, ref, repeated, write

import mi_diffind as md
from mi_diffind import metrics, scenes

ABOUT = """Hammered metal with rust, minified: what a texture that is trained for its shading is for. Written by
make_rust.py: change that file.

"-D metal=rust_plain.npz" takes the texture that is not. The sky is found by scattering alone: with "-D sky=0 -D
max_depth=2" the light has no noise, and all that differs from many samples of bitmaps is the texture.

"-D light" and "-D irradiance" are the sun's: pictures are sums of renders under one light each."""

FOLDER = Path(__file__).resolve().parent

#: Texels along each side of the maps; half of the width of the plate, and how often it repeats them.
SIDE, PLATE, REPEATS = 256, 5.0, 24.0


def write_maps() -> None:
    """Write rust_*.png and rust.json."""
    files = {}
    for name, values in md.example_maps("hammered", SIDE).items():
        files[name] = f"rust_{name}.png"
        mi.Bitmap(values).write(str(FOLDER / "assets" / files[name]))
    (FOLDER / "assets" / "rust.json").write_text(json.dumps({"maps": files}, indent=2) + "\n", encoding="utf-8")


def metal(repeats: float, id: str):
    """Return the material, its maps repeated the given number of times."""
    return plugin("bsdf", "neural_material", repeated(repeats), id=id, filename="assets/$metal",
                  storage="$storage", filter="$filter")  # fmt: skip


#: Settings of the picture, its first row and column that are shown, and the zoomed rows and columns.
PICTURE = {"sky": 0, "max_depth": 2, "width": 640, "height": 360}
CROP, ZOOM = (slice(60, 300), slice(250, 640)), (slice(130, 220), slice(510, 640))

#: Directions and irradiances of the lights of pictures: the sun of the scene, and two that fill its shadows.
LIGHTS = (
    {"light": "-0.55, -0.6, 0.35", "irradiance": "3.2, 3, 2.7"},
    {"light": "0.5, -0.45, -0.6", "irradiance": "0.8, 0.85, 0.95"},
    {"light": "-0.9, -0.8, -0.3", "irradiance": "0.8, 0.85, 0.95"},
)

#: Exposure of the picture, and the titles of its columns.
EXPOSURE = 1.1
TITLES = ("maps filtered, 1 sample", "trained for shading, 1 sample", "truth: bitmaps, 256 samples")


def picture(json_file: str | None) -> None:
    """Render rust.jpg, and write the errors of both textures against 256 samples of bitmaps."""
    mi.set_variant("llvm_ad_rgb")

    def rendered(file: str, spp: int, exact: bool, light: dict) -> np.ndarray:
        defines = {**PICTURE, **light, "spp": spp, "metal": file}  # the scene's samples scale the footprints
        path = FOLDER / "rust.xml"
        scene = scenes.loading.load(path, defines, exact=True) if exact else md.load_file(path, **defines)
        return scenes.loading.render(scene, passes=max(1, spp // 16))[0]

    def lit(*arguments) -> np.ndarray:
        return np.sum([rendered(*arguments, light) for light in LIGHTS], axis=0)

    files = ("rust_plain.npz", "rust_shaded.npz")
    images, truth = {file: lit(file, 1, False) for file in files}, lit(files[0], 256, True)
    figures = {"settings": {**PICTURE, "spp": 1, "truth_spp": 256}}
    for file, image in images.items():
        brightness = float(image.mean(dtype=np.float64) / truth.mean(dtype=np.float64))
        figures[file] = {"bytes": md.open(FOLDER / "assets" / file).table.nbytes, "brightness": brightness,
                         **metrics.compare(truth, image)}  # fmt: skip
    columns = [[image[CROP], image[ZOOM].repeat(3, axis=0).repeat(3, axis=1)] for image in (*images.values(), truth)]
    shown = np.concatenate([np.concatenate(column) for column in columns], axis=1)
    shown = mi.Bitmap(EXPOSURE * shown).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True)
    labelled(Image.fromarray(np.array(shown)), TITLES).save(FOLDER / "rust.jpg", quality=85)
    text = json.dumps(figures, indent=2) + "\n"
    print(text, end="")
    if json_file:
        Path(json_file).write_text(text, encoding="utf-8")


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--picture", action="store_true", help="render rust.jpg, and write nothing else")
    parser.add_argument("--json", metavar="FILE", help="file for the errors of the picture")
    arguments = parser.parse_args()
    if arguments.picture:
        return picture(arguments.json)
    mi.set_variant("scalar_rgb")
    write_maps()
    camera = (0, 4.2, 7.5), (0, 0.35, 0.2)
    defaults = {"metal": "rust_shaded.npz", "storage": "uint8", "filter": "anisotropic", "sky": 0.5, **LIGHTS[0]}
    content = head(960, 540, defaults, fov=36.0, camera=camera)
    sky = element("emitter", element("float", name="radiance", value="$sky"),
                  element("float", name="sampling_weight", value="0"), type="constant")  # fmt: skip
    light = element("emitter", element("rgb", name="irradiance", value="$irradiance"),
                    element("vector", name="direction", value="$light"), type="directional")  # fmt: skip
    places = ((-1.7, 0.4, 0.8, 3.0), (0.25, -0.6, 0.8, 8.0), (1.9, 0.9, 0.6, 16.0))
    balls = [ball(x, z, radius, metal(repeats, f"ball_{i}")) for i, (x, z, radius, repeats) in enumerate(places)]
    content += [
        "A sun, and a sky that is found by scattering alone", light, sky,
        "The plate", metal(REPEATS, "plate"), lying(PLATE, PLATE, ref("plate")),
        "Balls, on which the maps are repeated 3, 8 and 16 times", *balls,
    ]  # fmt: skip
    write(FOLDER / "rust.xml", ABOUT, content)


if __name__ == "__main__":
    main()
