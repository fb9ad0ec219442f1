"""
Compare a captured lamp with its mesh: light and shadow on a floor and a wall, and the noise of both.

The lamp is a white knot under a constant sky, so that its radiance is that of the sky. The field is fitted to views of
it, then lights a floor and a wall in the dark; so does the mesh with an area light.

    python tests/benchmarks/bench_field_light.py --json docs/measured/bench_field_light.json
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from frame import ASSETS, VARIANT, parser, write

import mi_diffind

KNOT = str(ASSETS / "knot.ply")

RADIANCE = 0.8


def fitted(folder: Path, resolution: int, seconds: float) -> Path:
    """Capture the knot, fit a field to the views, and return its file."""
    white = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": 1.0}}
    mi_diffind.capture(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 32},
            "sky": {"type": "constant", "radiance": RADIANCE},
            "knot": {"type": "ply", "filename": KNOT, "bsdf": white},
        },
        folder / "views", views=40, test=4, resolution=128, spp=64,
    )  # fmt: skip
    path = folder / "lamp.npz"
    mi_diffind.fit("field", folder / "views", resolution=resolution, seconds=seconds).save(path)
    return path


def room(integrator: dict, **more) -> mi.Scene:
    """A floor and a wall in the dark, seen from above."""
    at, diffuse = mi.ScalarTransform4f, {"type": "diffuse", "reflectance": 0.7}
    floor = at().translate([0, -0.3, 0]).rotate([1, 0, 0], -90).scale(3)
    film = {"type": "hdrfilm", "width": 96, "height": 72, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    camera = at().look_at([0.5, 3, 6], [0.08, 0.3, 0], [0, 1, 0])
    return mi.load_dict({
        "type": "scene",
        "integrator": {"max_depth": 2, **integrator},
        "sensor": {"type": "perspective", "fov": 50, "to_world": camera, "film": film},
        "floor": {"type": "rectangle", "to_world": floor, "bsdf": diffuse},
        "wall": {"type": "rectangle", "to_world": at().translate([0, 0, -1.6]).scale(3), "bsdf": diffuse},
        **more,
    })  # fmt: skip


def images(scene: mi.Scene, spp: int, count: int) -> tuple[np.ndarray, float]:
    """Return images, ``(count, height, width)``, and the CPU seconds of all but the first."""
    rendered, start = [], 0.0
    for seed in range(count):
        rendered.append(np.array(mi.render(scene, spp=spp, seed=seed))[..., 1])
        start = start or time.process_time()
    return np.stack(rendered), time.process_time() - start


def main() -> None:
    command = parser(__doc__)
    command.add_argument("--resolution", type=int, default=80, help="nodes along a side of the field")
    command.add_argument("--seconds", type=float, default=60, help="duration of the training")
    arguments = command.parse_args()
    mi.set_variant(VARIANT)
    with tempfile.TemporaryDirectory() as folder:
        path = fitted(Path(folder), arguments.resolution, arguments.seconds)
        field = {"type": "neural_field", "filename": str(path), "lit": True}
        knot = {"type": "ply", "filename": KNOT, "emitter": {"type": "area", "radiance": RADIANCE}}
        lamp = {"type": "sphere", "center": [0.5, 4, 1], "radius": 0.2, "emitter": {"type": "area", "radiance": 30.0}}
        scenes = {"field": room(field), "mesh": room({"type": "path"}, knot=knot)}
        shadowed = {"field": room(field, lamp=lamp), "mesh": room({"type": "path"}, knot=knot, lamp=lamp)}
        light = {name: images(scene, 256, 4)[0].mean(0) for name, scene in scenes.items()}
        shadow = {name: images(scene, 256, 4)[0].mean(0) - light[name] for name, scene in shadowed.items()}
        surfaces = (light["field"] < 0.9 * RADIANCE) & (light["mesh"] < 0.9 * RADIANCE)
        results = {
            "light_ratio": float(light["field"][surfaces].mean() / light["mesh"][surfaces].mean()),
            "shadow_ratio": float(shadow["field"][surfaces].mean() / shadow["mesh"][surfaces].mean()),
        }
        scenes["field, BSDFs alone"] = room(field)
        between = scenes["field, BSDFs alone"].integrator().field_light
        between.radiances = dr.zeros(mi.Float, dr.width(between.radiances))
        for name, scene in scenes.items():
            rendered, seconds = images(scene, 16, 9)
            variance = float(rendered.var(0, ddof=1)[surfaces].mean())
            results[name] = {"variance": variance, "cpu_seconds": seconds, "variance_times_seconds": variance * seconds}
    for name, value in results.items():
        print(name, value)
    write(arguments.json, results)


if __name__ == "__main__":
    main()
