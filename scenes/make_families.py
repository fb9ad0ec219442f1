"""Fit two families of BSDFs, and render families.jpg: sources (left), families with textured parameters (right).

The upper row is ``principled`` with maps of roughness and metallic. The lower row is ``roughplastic`` with stripes of
four roughnesses; Mitsuba cannot texture that parameter, so the source is a blend of four plastics.
"""

import argparse
import math
from pathlib import Path

import mitsuba as mi
import numpy as np
from labelled import labelled
from PIL import Image

import mi_diffind

mi.set_variant("llvm_ad_rgb")
SCENES = Path(__file__).resolve().parent

PRINCIPLED = {"type": "principled", "base_color": {"type": "rgb", "value": [0.7, 0.25, 0.1]}}
PLASTIC = {
    "type": "roughplastic",
    "nonlinear": True,
    "diffuse_reflectance": {"type": "rgb", "value": [0.1, 0.27, 0.36]},
}

#: Titles of the columns of the picture.
TITLES = ("sources: principled, roughplastic", "neural_bsdf, parameters from textures")

#: Roughness of the stripes.
ALPHAS = (0.02, 0.08, 0.25, 0.7)


def texture(values: np.ndarray) -> dict:
    """Return a texture of numbers, ``(height, width)``, without interpolation."""
    return {
        "type": "bitmap", "bitmap": mi.Bitmap(values[..., None].astype(np.float32)), "raw": True,
        "filter_type": "nearest",
    }  # fmt: skip


def materials(folder: Path) -> list[tuple[dict, dict]]:
    """Return learned BSDF and source of each row; files that ``folder`` lacks are fitted."""
    y, x = np.mgrid[:512, :512] / 512
    maps = {
        "roughness": texture(0.05 + 0.95 * (0.5 + 0.5 * np.sin(8 * np.pi * x))),
        "metallic": texture((np.sin(12 * np.pi * y) > 0).astype(float)),
    }
    stripe = (np.floor(8 * x) % 4).astype(int)
    alpha = {"alpha": texture(np.array(ALPHAS)[stripe])}
    blend = {**PLASTIC, "alpha": ALPHAS[0]}
    for k, value in enumerate(ALPHAS[1:], 1):
        blend = {"type": "blendbsdf", "weight": texture((stripe == k).astype(float)), "a": blend,
                 "b": {**PLASTIC, "alpha": value}}  # fmt: skip
    rows = []
    for name, source, over, textures, exact in (
        ("principled", {**PRINCIPLED, "roughness": 0.3, "metallic": 0.5}, {"roughness": (0.05, 1), "metallic": (0, 1)},
         maps, {**PRINCIPLED, **maps}),
        ("plastic", PLASTIC, {"alpha": (0.02, 0.8)}, alpha, blend),
    ):  # fmt: skip
        path = folder / f"{name}_family.npz"
        if not path.exists():
            mi_diffind.fit("bsdf", source, over=over).save(path)
        rows.append(({"type": "neural_bsdf", "filename": str(path), **textures}, exact))
    return rows


def scene(bsdf: dict) -> mi.Scene:
    """Return a ball on a plate, both of a BSDF, under two softboxes."""
    t = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 480, "height": 270, "rfilter": {"type": "box"}}
    camera = t.look_at(origin=[0, 2.6, 5], target=[0, 0.2, 0], up=[0, 1, 0])
    plate = t.translate([0, -0.6, 0]).rotate([1, 0, 0], -90).scale(4)
    lamps = {}
    for name, origin, size, radiance in (("key", [2, 4, -3], 0.8, 12.0), ("fill", [-3, 2.5, 2], 0.5, 10.0)):
        to_world = t.look_at(origin=origin, target=[0, 0, 0], up=[0, 1, 0]).scale(size)
        lamps[name] = {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area", "radiance": radiance}}
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 4},
        "sensor": {"type": "perspective", "fov": 40, "to_world": camera, "film": film},
        "ball": {"type": "sphere", "center": [0, 0.3, 0], "radius": 0.9, "bsdf": bsdf},
        "plate": {"type": "rectangle", "to_world": plate, "bsdf": bsdf},
        "sky": {"type": "constant", "radiance": 0.4},
        **lamps,
    })  # fmt: skip


def render(bsdf: dict, samples: int) -> np.ndarray:
    """Return two independent images, ``(2, height, width, 3)``."""
    loaded = scene(bsdf)
    return np.stack([np.array(mi.render(loaded, spp=samples // 2, seed=seed)) for seed in (1, 2)])


def main() -> None:
    """Fit, render, print the PSNR without noise, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=Path(), help="folder of the fitted files (default: this one)")
    parser.add_argument("--spp", type=int, default=1024, help="samples a pixel (default: 1024)")
    arguments = parser.parse_args()
    rows = []
    for learned, source in materials(arguments.folder):
        pair = [render(bsdf, arguments.spp) for bsdf in (source, learned)]
        a, b = (np.clip(pair[0][k], 0, 1) - np.clip(pair[1][k], 0, 1) for k in (0, 1))
        error, noise = float(np.mean(a * b)), 2 * float(np.std(a * b)) / math.sqrt(a.size)
        at_least = "at least " if error < noise else ""
        print(f"{Path(learned['filename']).name}: {at_least}{-10 * math.log10(max(error, noise)):.1f} dB")
        rows.append(np.concatenate([p.mean(axis=0) for p in pair], axis=1))
    shown = mi.util.convert_to_bitmap(np.concatenate(rows).astype(np.float32))
    labelled(Image.fromarray(np.array(shown)), TITLES).save(SCENES / "families.jpg", quality=90)


if __name__ == "__main__":
    main()
