"""
A material before and after ``fit shading``, as it is seen: a floor and a ball under the sky of the errors as seen, from
near (128 texels along the floor), at the source's size (512) and from far (2048), with ``neural_material`` and the
footprint of one sample a pixel. The truth is ``normalmap`` and ``disney`` with bitmaps at 1024 samples. Each picture is
rendered twice with independent random numbers: the mean product of both differences has no noise of the renders.

    python tests/benchmarks/bench_shading_distances.py [NAME …] [--textures FOLDER] [--out FOLDER] [--json FILE]

Materials: ``wood`` (shipped, with normals of 2° from its colour), ``tiles`` (shipped), and, with ``--textures``, the
folder of MaterialX's textures, ``boombox`` and ``brick``, at 512². They are trained at 12x, 600
steps as a texture, then with the defaults of ``fit shading``. Files in ``--out`` are not trained again.
"""

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
from frame import ASSETS, VARIANT, parser, write
from PIL import Image

import mi_diffind as md
from mi_diffind.maps import as_seen
from mi_diffind.maps.pyramid import decibel

#: Copies of the material along the floor, by distance.
DISTANCES = {"near": 0.25, "middle": 1.0, "far": 4.0}

#: Samples of both renders of the truth, and of those of a material, each with the footprint of one.
TRUTH_SPP, SPP = 1024, 256

#: Side of the materials from a folder, texels.
SIDE = 512


def wood(_) -> dict[str, Image.Image]:
    color = Image.open(ASSETS / "wood_color.png")
    grey = np.asarray(color.convert("L"), float) / 255
    slopes = [0.8 * (np.roll(grey, -1, axis) - np.roll(grey, 1, axis)) for axis in (1, 0)]
    normal = np.stack([-slopes[0], slopes[1], np.ones_like(grey)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = Image.fromarray(np.rint(127.5 * normal + 127.5).astype(np.uint8))
    return {"albedo": color, "roughness": Image.open(ASSETS / "wood_roughness.png"), "normal": normal}


def tiles(_) -> dict[str, Image.Image]:
    return {name: Image.open(ASSETS / f"tiles_{name}.png") for name in ("albedo", "normal", "roughness")}


def boombox(folder: Path) -> dict[str, Image.Image]:
    base, normal, packed = (
        Image.open(folder / "boombox" / f"BoomBox_{name}.png").resize((SIDE, SIDE), Image.Resampling.BOX)
        for name in ("baseColor", "normal", "occlusionRoughnessMetallic")
    )
    return {"albedo": base, "normal": normal, "roughness": packed.getchannel(1), "metallic": packed.getchannel(2)}


def brick(folder: Path) -> dict[str, Image.Image]:
    names = {"albedo": "base_gray", "normal": "normal", "roughness": "roughness"}
    images = {key: Image.open(folder / "brick" / f"brick_{name}.jpg") for key, name in names.items()}
    return {key: image.resize((SIDE, SIDE), Image.Resampling.BOX) for key, image in images.items()}


MATERIALS = {"wood": wood, "tiles": tiles, "boombox": boombox, "brick": brick}


def trained(name: str, textures: Path | None, out: Path) -> dict[str, Path]:
    """The maps in ``out``, and the files of both trainings."""
    images = MATERIALS[name](textures)
    manifest = out / f"{name}.json"
    for key, image in images.items():
        image.save(out / f"{name}_{key}.png")
    manifest.write_text(json.dumps({"maps": {key: f"{name}_{key}.png" for key in images}}))
    files = {"before": out / f"{name}_before.npz", "after": out / f"{name}_after.npz"}
    if not files["before"].exists():
        md.fit("texture", str(manifest), output=str(files["before"]), compression=12, steps=600)
    if not files["after"].exists():
        md.fit("shading", str(manifest), output=str(files["after"]), start=str(files["before"]))
    return files


def scene(bsdf: dict, spp: int) -> dict:
    """The floor and the ball."""
    transform = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": as_seen.SIZE[0], "height": as_seen.SIZE[1], "rfilter": {"type": "box"}}
    sampler = {"type": "multijitter" if spp > 1 else "independent", "sample_count": spp}
    return {
        "type": "scene", "integrator": {"type": "path", "max_depth": 2},
        "sensor": {"type": "perspective", "fov": 35, "film": film, "sampler": sampler,
                   "to_world": transform().look_at([0, -2.6, 2.2], [0, 0, 0.2], [0, 0, 1])},
        "light": {"type": "envmap", "bitmap": mi.Bitmap(as_seen.sky()), "to_world": transform().rotate([1, 0, 0], 90)},
        "floor": {"type": "rectangle", "bsdf": {**bsdf, "id": "material"}},
        "ball": {"type": "sphere", "center": [0, 0, 0.5], "radius": 0.5, "bsdf": {"type": "ref", "id": "material"}},
    }  # fmt: skip


def truth(name: str, out: Path, copies: float) -> dict:
    maps, to_uv = json.loads((out / f"{name}.json").read_text())["maps"], mi.ScalarTransform4f().scale(copies)

    def bitmap(key):
        return {"type": "bitmap", "filename": str(out / maps[key]), "raw": key != "albedo", "to_uv": to_uv}

    parameters = {"base_color": bitmap("albedo"), "roughness": bitmap("roughness")}
    if "metallic" in maps:
        parameters["metallic"] = bitmap("metallic")
    return {"type": "normalmap", "normalmap": bitmap("normal"), "nested": {"type": "disney", **parameters}}


def pictures(description: dict, spp: int) -> np.ndarray:
    loaded = md.load_dict(description)
    return np.stack([mi.render(loaded, spp=spp, seed=seed).numpy() for seed in range(2)])


def main() -> None:
    command = parser(__doc__)
    command.add_argument("names", nargs="*", metavar="NAME", default=["wood", "tiles"])
    command.add_argument("--textures", type=Path, metavar="FOLDER")
    command.add_argument("--out", type=Path, default=Path("out"), metavar="FOLDER")
    options = command.parse_args()
    mi.set_variant(VARIANT)
    options.out.mkdir(parents=True, exist_ok=True)
    found = {}
    for name in options.names:
        files = trained(name, options.textures, options.out)
        settings = md.open(str(files["after"])).table.settings
        found[name] = {"level_bias": settings["level_bias"], "fixed": settings["shading"]["fixed"], "seen": {}}
        for distance, copies in DISTANCES.items():
            reference = pictures(scene(truth(name, options.out, copies), TRUTH_SPP), TRUTH_SPP)
            figures = found[name]["seen"][distance] = {}
            for state, file in files.items():
                material = {"type": "neural_material", "filename": str(file)}
                material["to_uv"] = mi.ScalarTransform4f().scale(copies)
                shown = pictures(scene(material, 1), SPP)
                figures[state] = {
                    "psnr_db": round(decibel(as_seen.squared_error(reference, shown)), 2),
                    "brightness": round(float(shown.mean() / reference.mean()), 4),
                }
            print(name, distance, json.dumps(figures), flush=True)
    write(options.json, found)


if __name__ == "__main__":
    main()
