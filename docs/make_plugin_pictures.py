"""Pictures of the plugins' manual pages: one render each, ``docs/pictures/NAME.jpg``.

    python docs/make_plugin_pictures.py [NAME…]

Each takes seconds. Seeds are fixed.
"""

from __future__ import annotations

import argparse
import io
import sys
from pathlib import Path

import mitsuba as mi
import numpy as np
from PIL import Image

import mi_diffind as md
from mi_diffind.core.files import replacing

ROOT = Path(__file__).resolve().parents[1]
ASSETS = ROOT / "scenes" / "assets"
FOLDER = ROOT / "docs" / "pictures"

#: Width and height in pixels, and the largest size of a file in bytes.
WIDTH, HEIGHT, LARGEST = 384, 240, 25_000

#: Plugin → what its picture shows.
CAPTIONS = {
    "disney": "Lacquer (``clearcoat``), cloth (``sheen``) and brushed metal (``anisotropic``).",
    "mipmap": "One sample a pixel: ``bitmap`` on the left, ``mipmap`` with ``filter`` ``anisotropic`` on the right.",
    "neural_bsdf": "Three materials (a blend of plastic and gold, bronze, pearl), each from a file of four kilobytes.",
    "neural_disney": "The materials of the picture of ``disney``, from 384 bytes of tables.",
    "neural_field": "A captured field of 0.6 MB on a mirror, behind a golden mesh.",
    "neural_ggx": "Gold, copper and aluminium of ``alpha`` 0.05, 0.2 and 0.4.",
    "neural_image": "Albedo, normal and roughness of glazed tiles from one file of 98 kB.",
    "neural_material": "Hammered metal with rust from one file of 40 kB, trained for its shading.",
    "neural_sdf": "Suzanne as a field of 256 kB, and knots as fields of 128 kB.",
    "neural_texture": "One sample a pixel: ``bitmap`` on the left, ``neural_texture`` with ``filter`` ``anisotropic`` "
    "on the right, a twelfth of the bytes.",
    "path_footprint": "Filtered tiles in mirror balls, one sample a pixel: ``path`` on the left, "
    "``path_footprint`` on the right.",
    "path_sdf": "Fields of glass and gold, beside a ball and before a mirror: they refract, reflect and cast shadows.",
}


def asset(name: str) -> str:
    """Return the path of a file of the scenes."""
    return str(ASSETS / name)


def rgb(*value: float) -> dict:
    """Return a colour."""
    return {"type": "rgb", "value": list(value)}


def placed(scale: float = 1, angle: float = 0, at=(0, 0, 0)):
    """Return a transform: a scale, a turn about the vertical in degrees, a place."""
    return mi.ScalarTransform4f().translate(at).rotate([0, 1, 0], angle).scale(scale)


def scene(integrator: dict, shapes: dict, light: str = "interior", origin=(0, 1.7, 5.2), target=(0, 0.55, 0), fov=38):
    """Return a scene of some shapes on a grey floor, in a room (``interior``), a park (``forest``) or under a sun."""
    lights = {
        "softbox": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().look_at([4.5, 6, 4], [0, 0.5, 0], [0, 1, 0]),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0, 0, 0)},
            "emitter": {"type": "area", "radiance": rgb(16, 14.5, 12.5)},
        },
        "sky": {"type": "envmap", "filename": asset(f"{light}.exr"), "scale": 0.5 if light == "interior" else 0.8,
                "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 60)},
    }  # fmt: skip
    if light == "sun":  # without noise: all error is that of the textures
        lights = {
            "sun": {"type": "directional", "direction": [0.62, -0.6, -0.75], "irradiance": rgb(2.9, 2.6, 2.2)},
            "sky": {"type": "constant", "radiance": rgb(0.36, 0.44, 0.56), "sampling_weight": 0.0},
        }
    floor = {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(12),
        "bsdf": {"type": "diffuse", "reflectance": rgb(0.42, 0.41, 0.4)},
    }
    return {
        "type": "scene",
        "integrator": integrator,
        "sensor": {
            "type": "perspective",
            "fov": fov,
            "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}},
        },
        **lights,
        **{"floor": floor, **shapes},
    }


def balls(*materials: dict) -> dict:
    """Return three balls side by side."""
    return {
        f"ball_{i}": {"type": "sphere", "radius": 0.62, "center": [1.36 * (i - 1), 0.62, 0.1 * abs(i - 1)], "bsdf": m}
        for i, m in enumerate(materials)
    }


def materials(*bsdfs: dict, path: str = "path") -> np.ndarray:
    """Return a render of three balls."""
    return render(scene({"type": path, "max_depth": 6}, balls(*bsdfs), fov=46), 160)


def render(description: dict, spp: int) -> np.ndarray:
    """Return a render of a scene."""
    return md.render(md.load_dict(description), spp=spp, seed=7).image[..., :3]


def halves(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return a picture of the left half of one render and the right half of another, with a line between them."""
    picture, middle = right.copy(), WIDTH // 2
    picture[:, :middle] = left[:, :middle]
    picture[:, middle - 1 : middle + 1] = 1
    return picture


def disney(name: str) -> np.ndarray:
    """Return three materials of the Disney BRDF by the plugin ``name``."""
    lacquer = {"base_color": rgb(0.7, 0.05, 0.03), "roughness": 0.5, "clearcoat": 1.0, "clearcoat_gloss": 0.9}
    cloth = {"base_color": rgb(0.12, 0.2, 0.55), "roughness": 0.9, "sheen": 1.0, "sheen_tint": 0.3, "flatness": 0.6}
    metal = {"base_color": rgb(0.93, 0.75, 0.45), "metallic": 1.0, "roughness": 0.38, "anisotropic": 0.9}
    return materials(*({"type": name, **values} for values in (lacquer, cloth, metal)))


def tiled_plane(texture: dict, balls_too: bool = False, path: str = "path_footprint") -> np.ndarray:
    """Return a plane of tiles to the horizon with one sample a pixel."""
    texture = {**texture, "to_uv": mi.ScalarTransform4f().scale(400)}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(400),
             "bsdf": {"type": "diffuse", "reflectance": texture}}  # fmt: skip
    mirror = {"type": "conductor", "material": "Ag"}
    integrator = {"type": path, "max_depth": 8}
    shapes = {"floor": floor}
    if balls_too:
        shapes |= {
            f"ball_{i}": {"type": "sphere", "radius": 0.8, "center": [1.1 * i, 0.8, 0], "bsdf": mirror} for i in (-1, 1)
        }
    elif path == "path_footprint":
        integrator["jitter"] = texture["type"] == "bitmap"
    return render(scene(integrator, shapes, "sun", (0, 1.5, 5.2), (0, 0.9, 0), 48), 1)


def tiles(kind: str, file: str, channels: str = "albedo", **more) -> dict:
    """Return a texture of the tiles."""
    named = {} if kind == "bitmap" else {"channels": channels}
    return {"type": kind, "filename": asset(file), **named, **more}


def picture(name: str) -> np.ndarray:
    """Return the picture of a plugin, linear, ``(HEIGHT, WIDTH, 3)``."""
    lying = mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    bitmap = tiles("bitmap", "tiles_albedo.png")
    filtered = tiles("neural_texture", "tiles_filtered.npz", filter="anisotropic")
    gold = {"type": "roughconductor", "material": "Au", "alpha": 0.12}
    glass = {"type": "dielectric", "int_ior": 1.5}
    clay = {"type": "principled", "base_color": rgb(0.62, 0.34, 0.22), "roughness": 0.5}
    blue = {"type": "principled", "base_color": rgb(0.08, 0.2, 0.5), "roughness": 0.25}
    suzanne = {"type": "neural_sdf", "filename": asset("suzanne.npz")}
    knot = {"type": "neural_sdf", "filename": asset("knot.npz")}
    if name in ("disney", "neural_disney"):
        return disney(name)
    if name == "neural_bsdf":
        return materials(
            *({"type": name, "filename": asset(f"library/{m}.npz")} for m in ("gilded", "bronze", "pearl"))
        )
    if name == "neural_ggx":
        metals = (("Au", 0.05), ("Cu", 0.2), ("Al", 0.4))
        return materials(*({"type": name, "material": metal, "alpha": alpha} for metal, alpha in metals))
    if name == "neural_image":

        def tile(repeats):
            read = {"filename": asset("tiles.npz"), "to_uv": mi.ScalarTransform4f().scale([repeats, repeats, 1])}
            maps = {n: {"type": name, "channels": n, **read} for n in ("albedo", "roughness", "normal")}
            inner = {"type": "principled", "base_color": maps["albedo"], "roughness": maps["roughness"]}
            return {"type": "normalmap", "normalmap": maps["normal"], "bsdf": inner}

        floor = {"type": "rectangle", "to_world": lying.scale(6), "bsdf": tile(5)}
        upright = mi.ScalarTransform4f().translate([0, 0.8, 0]) @ lying
        ball = {"type": "sphere", "to_world": upright.scale(0.8), "bsdf": tile(2)}
        return render(scene({"type": "path", "max_depth": 5}, {"floor": floor, "ball": ball}), 128)
    if name == "neural_material":

        def metal(repeats):
            scale = mi.ScalarTransform4f().scale([repeats, repeats, 1])
            return {"type": name, "filename": asset("rust_shaded.npz"), "to_uv": scale}

        shapes = {
            f"ball_{i}": {"type": "sphere", "bsdf": metal(repeats),
                          "to_world": placed(0.62, 0, (1.36 * (i - 1), 0.62, 0)).rotate([1, 0, 0], -90)}
            for i, repeats in enumerate((2, 4, 8))
        }  # fmt: skip
        return render(scene({"type": "path_footprint", "max_depth": 5}, shapes, fov=46), 128)
    if name in ("neural_texture", "mipmap"):
        learned = filtered if name == "neural_texture" else tiles(name, "tiles_albedo.png", filter="anisotropic")
        learned = {k: v for k, v in learned.items() if name == "neural_texture" or k != "channels"}
        return halves(tiled_plane(bitmap), tiled_plane(learned))
    if name == "path_footprint":
        return halves(tiled_plane(filtered, True, "path"), tiled_plane(filtered, True, name))
    if name == "neural_sdf":
        shapes = {
            "suzanne": {**suzanne, "to_world": placed(1, -8), "bsdf": clay},
            "gold": {**knot, "to_world": placed(0.55, 30, (1.5, 0, 0.1)), "bsdf": gold},
            "blue": {**knot, "to_world": placed(0.55, -40, (-1.5, 0, 0.1)), "bsdf": blue},
        }
        return render(scene({"type": "path_sdf", "max_depth": 5}, shapes, fov=46), 96)
    if name == "path_sdf":
        shapes = {
            "glass": {**suzanne, "to_world": placed(1, -8, (-0.75, 0, 0.3)), "bsdf": glass},
            "gold": {**knot, "to_world": placed(0.7, 30, (1.0, 0, 0)), "bsdf": gold},
            "mirror": {"type": "rectangle", "to_world": placed(1, 0, (0, 0.9, -1.4)).scale([2.4, 1, 1]),
                       "bsdf": {"type": "conductor", "material": "Ag"}},
            "ball": {"type": "sphere", "radius": 0.3, "center": [0.1, 0.3, 1.0], "bsdf": clay},
        }  # fmt: skip
        return render(scene({"type": name, "max_depth": 12}, shapes), 64)
    if name == "neural_field":
        shapes = {
            "mirror": {"type": "disk", "to_world": lying.translate([0, 0, 0.01]).scale(1.7),
                       "bsdf": {"type": "conductor", "material": "Ag"}},
            "knot": {"type": "ply", "filename": asset("knot.ply"), "to_world": placed(0.45, 30, (0.9, 0, 1.5)),
                     "bsdf": gold},
        }  # fmt: skip
        integrator = {"type": name, "filename": asset("group.npz"), "surfaces": {"type": "path", "max_depth": 5}}
        return render(scene(integrator, shapes, "forest", (2.0, 2.6, 5.8), (0.1, 0.55, 0), 42), 96)
    raise SystemExit(f'"{name}" has no picture; allowed are {", ".join(CAPTIONS)}')


def jpeg(image: np.ndarray) -> bytes:
    """Return an image as JPEG of at most :data:`LARGEST` bytes."""
    shown = Image.fromarray(np.uint8(np.round(255 * np.asarray(md.srgb.for_display(image)))))
    for quality in range(92, 20, -4):
        shown.save(buffer := io.BytesIO(), "jpeg", quality=quality, optimize=True)
        if buffer.tell() <= LARGEST:
            break
    return buffer.getvalue()


def main() -> None:
    """Write the pictures of the plugins that are named, or of all."""
    parser = argparse.ArgumentParser(description="Render the pictures of the plugins' manual pages.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"plugins (default: all): {', '.join(CAPTIONS)}")
    names = parser.parse_args().names or list(CAPTIONS)
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    FOLDER.mkdir(exist_ok=True)
    for name in names:
        data = jpeg(picture(name))
        with replacing(FOLDER / f"{name}.jpg") as temporary:
            Path(temporary).write_bytes(data)
        print(f"{name}.jpg: {len(data):,} bytes", file=sys.stderr)


if __name__ == "__main__":
    main()
