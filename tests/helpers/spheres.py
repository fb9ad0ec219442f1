"""A scene of spheres, one for each material, and how to find parameters in it."""

import math


def sphere_scene(mi, bsdfs, integrator="path", size=16, columns=None, light=0.5, depth=3, **extra):
    """Spheres in a square grid, one for each BSDF (or a single one), under an even sky and a lamp."""
    bsdfs = bsdfs if isinstance(bsdfs, list) else [bsdfs]
    columns = columns or math.ceil(math.sqrt(len(bsdfs)))
    spheres = {
        f"shape{i}": {
            "type": "sphere",
            "radius": 0.9 / columns,
            "center": [(2 * (i % columns) + 1) / columns - 1, 1 - (2 * (i // columns) + 1) / columns, 0],
            "bsdf": bsdf,
        }
        for i, bsdf in enumerate(bsdfs)
    }
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": integrator, **({"max_depth": depth} if integrator != "direct" else {})},
        "sensor": {
            "type": "perspective",
            "fov": math.degrees(2 * math.atan(1 / 20)),
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 20], [0, 0, 0], [0, 1, 0]),
            "film": {
                "type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            },
        },
        "light": {"type": "constant", "radiance": light},
        "lamp": {"type": "point", "position": [2.0, 3.0, 4.0], "intensity": 20.0},
        **spheres,
        **extra,
    })  # fmt: skip


def key_of(params, end):
    return next(k for k in params.keys() if k.endswith(end))
