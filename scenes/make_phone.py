"""Render views of a table in a courtyard as a phone takes them, for radiance fields with surroundings.

    python scenes/make_phone.py out/phone
    mi-diffind fit field out/phone --background surroundings --exposures -o out/phone.npz

Images have no alpha. Training views have noise of pixels, an exposure of their own (up to ±0.3 stops, whose mean is 0),
and poses that are wrong by about a third of a pixel. Test views have none of these. ``capture.json`` holds the
exposures in stops.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from PIL import Image

from mi_diffind import srgb

ASSETS = Path(__file__).resolve().parent / "assets"

#: Horizontal angle of view in degrees.
FOV = 58.0

#: Cameras of captures look along −z with x to the right, those of Mitsuba along z with x to the left.
OPTICAL = np.diag([-1.0, 1.0, -1.0, 1.0])

#: Largest exposure in stops, and standard deviations: of directions in pixels, and of positions in units of the scene.
STOPS, TURN, MOVE = 0.3, 0.3, 0.002

#: Variance of a linear pixel value v: ``SHOT`` · v + ``READ``².
SHOT, READ = 1.5e-4, 3e-3


def bitmap(file: str, scale: float = 1.0) -> dict:
    """Return a diffuse material with a texture, which is repeated."""
    to_uv = mi.ScalarTransform4f().scale([scale, scale, 1])
    return {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "filename": str(ASSETS / file), "to_uv": to_uv}},
    }


def paint(*rgb: float) -> dict:
    """Return a diffuse material of one colour."""
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(rgb)}}}


def courtyard() -> dict:
    """Return the scene without its cameras: things on a table, walls, pillars, far trees, and a park as the sky."""
    at = mi.ScalarTransform4f
    lying = at().rotate([1, 0, 0], -90)

    def mesh(file: str, material: dict, scale: float, x: float, z: float, angle: float = 0) -> dict:
        place = at().translate([x, 0, z]).rotate([0, 1, 0], angle).scale(scale)
        return {"type": "ply", "filename": str(ASSETS / f"{file}.ply"), "to_world": place, "bsdf": material}

    def wall(x: float, z: float, width: float, height: float, angle: float, material: dict) -> dict:
        place = at().translate([x, height / 2 - 0.9, z]).rotate([0, 1, 0], angle).scale([width / 2, height / 2, 1])
        return {"type": "rectangle", "to_world": place, "bsdf": material}

    def ball(x: float, y: float, z: float, radius: float, *rgb: float) -> dict:
        return {"type": "sphere", "center": [x, y, z], "radius": radius, "bsdf": paint(*rgb)}

    def pillar(x: float, z: float, top: float, radius: float, material: dict) -> dict:
        return {"type": "cylinder", "p0": [x, -0.9, z], "p1": [x, top, z], "radius": radius, "bsdf": material}

    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 5},
        "sky": {
            "type": "envmap", "filename": str(ASSETS / "forest.exr"), "scale": 0.8,
            "to_world": at().rotate([0, 1, 0], 40),
        },
        "suzanne": mesh("suzanne", paint(0.62, 0.31, 0.2), 0.42, -0.28, -0.1, 12),
        "vase": mesh("vase", bitmap("vase_color.png"), 0.5, 0.36, -0.3, 40),
        "knot": mesh("knot", paint(0.07, 0.2, 0.5), 0.3, -0.1, 0.5, 60),
        "pear": mesh("pear", paint(0.42, 0.5, 0.12), 0.45, 0.45, 0.3),
        "table": {"type": "disk", "to_world": lying.scale(1.0), "bsdf": bitmap("wood_color.png")},
        "leg": pillar(0, 0, -0.01, 0.08, paint(0.2, 0.2, 0.2)),
        "floor": {
            "type": "rectangle", "to_world": at().translate([0, -0.9, 0]) @ lying.scale(40),
            "bsdf": bitmap("tiles_albedo.png", 16),
        },
        "back": wall(0, -4.5, 9, 3.2, 0, bitmap("rust_albedo.png", 3)),
        "left": wall(-4.5, 0.5, 7, 2.6, 90, bitmap("wood_color.png", 2)),
        "house": {
            "type": "cube", "to_world": at().translate([9, 1.6, 5]).rotate([0, 1, 0], 25).scale([2.5, 2.5, 3]),
            "bsdf": bitmap("tiles_albedo.png", 2),
        },
    }  # fmt: skip
    for i, (x, z) in enumerate([(3.2, -2.5), (3.4, 2.6), (-2.4, 3.8), (0.8, 4.6)]):
        scene[f"pillar{i}"] = pillar(x, z, 1.9, 0.18, paint(0.55, 0.5 - 0.08 * i, 0.2 + 0.12 * i))
    for i in range(9):
        angle, far = 0.4 + 0.32 * i, 11 + 3.0 * (i % 4)
        x, z = far * np.cos(angle), far * np.sin(angle)
        scene[f"trunk{i}"] = pillar(x, z, 1.4, 0.25, paint(0.16, 0.1, 0.06))
        scene[f"tree{i}"] = ball(x, 2.4, z, 1.5, 0.12 + 0.03 * (i % 3), 0.28, 0.07)
    return scene


def cameras(count: int, turn: float, rng) -> np.ndarray:
    """Return poses around the table, at two heights: camera to world, ``(count, 4, 4)``."""
    result = []
    for i in range(count):
        angle = 2 * np.pi * (i + turn) / count + rng.normal(0, 0.05)
        radius, height = rng.uniform(2.0, 2.6), (0.75, 1.55)[i % 2] + rng.normal(0, 0.1)
        origin = np.array([radius * np.cos(angle), height, radius * np.sin(angle)])
        to = np.array([0, 0.25, 0]) + rng.normal(0, 0.08, 3)
        result.append(np.array(mi.ScalarTransform4f().look_at(origin, to, [0, 1, 0]).matrix) @ OPTICAL)
    return np.stack(result)


def photographed(scene: mi.Scene, camera: np.ndarray, side: int, spp: int, seed: int) -> np.ndarray:
    """Return the linear image ``(side, side, 3)`` from a pose."""
    sensor = mi.load_dict({
        "type": "perspective", "fov": FOV, "to_world": mi.ScalarTransform4f(camera @ OPTICAL),
        "film": {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"}, "pixel_format": "rgb"},
        "sampler": {"type": "multijitter", "sample_count": spp},
    })  # fmt: skip
    return mi.render(scene, sensor=sensor, spp=spp, seed=seed).numpy()


def shaken(camera: np.ndarray, side: int, rng) -> np.ndarray:
    """Return a pose that differs from another one as that of a phone does."""
    pixel = 2 * np.tan(np.radians(FOV / 2)) / side
    x, y, z = rng.normal(0, TURN * pixel, 3)
    turn = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    moved = camera.copy()
    moved[:3, :3] = np.linalg.qr(camera[:3, :3] @ (np.eye(3) + turn))[0]
    moved[:3, :3] *= np.sign(np.sum(moved[:3, :3] * camera[:3, :3], axis=0))
    moved[:3, 3] += rng.normal(0, MOVE, 3)
    return moved


def main() -> None:
    """Write the folder that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", metavar="FOLDER")
    parser.add_argument("--views", type=int, default=40, help="number of training views (default: 40)")
    parser.add_argument("--test", type=int, default=12, help="number of test views (default: 12)")
    parser.add_argument("--resolution", type=int, default=200, help="pixels along a side (default: 200)")
    parser.add_argument("--spp", type=int, default=256, help="samples a pixel (default: 256)")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    folder, side, rng = Path(arguments.output), arguments.resolution, np.random.default_rng(25)
    scene = mi.load_dict(courtyard())
    stops = rng.uniform(-STOPS, STOPS, arguments.views)
    stops -= stops.mean()
    for split, count, turn in (("train", arguments.views, 0.0), ("test", arguments.test, 0.5)):
        frames = []
        (folder / split).mkdir(parents=True, exist_ok=True)
        for i, camera in enumerate(cameras(count, turn, rng)):
            phone = split == "train"
            image = photographed(scene, shaken(camera, side, rng) if phone else camera, side, arguments.spp, i)
            if phone:
                image = image * 2 ** stops[i]
                image = image + rng.normal(size=image.shape) * np.sqrt(SHOT * image + READ**2)
            Image.fromarray(np.uint8(255 * srgb.for_display(image) + 0.5)).save(folder / split / f"{i:03}.png")
            frames.append({"file_path": f"./{split}/{i:03}", "transform_matrix": camera.tolist()})
            dr.flush_malloc_cache()
        content = {"camera_angle_x": np.radians(FOV), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(content, indent=1))
    (folder / "capture.json").write_text(json.dumps({"stops": stops.tolist()}))


if __name__ == "__main__":
    main()
