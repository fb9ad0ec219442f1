"""Small scene that shows what a table file holds: the plugin of its task on a plane, a ball or alone."""

from __future__ import annotations

import os
from pathlib import Path

import mitsuba as mi
import numpy as np

from ...arrays.tables import load_table
from ...core.errors import UsageError
from ...core.runtime import array_module
from ...fitting.task import task_of
from ..loading import scene_errors

#: Maps that a texture shows, the first that the file has; else its first map.
SHOWN = ("base_color", "albedo", "image")

#: Size of the picture, pixels.
WIDTH, HEIGHT = 320, 180

#: Directions from the middle of what is shown to the camera, and to the lamp.
CAMERA, LAMP = (0.5, 0.35, 1.0), (-0.6, 1.0, 0.7)


def table_scene(file: str | os.PathLike) -> dict:
    """Return a scene, as a dictionary for ``mi.load_dict``, in which the plugin of a file's task reads the file.

    A texture lies on a square, a BSDF on a ball; a shape and a radiance field stand alone. The light is a white
    surrounding and, but for textures and fields, a lamp. Raises :class:`.TableError`, and
    :class:`.UsageError` for a task whose tables no plugin reads.
    """
    path = Path(file).resolve()
    task = task_of(load_table(file))
    table = task.load(file)
    if task.plugin is None:
        raise UsageError(f'{file}: holds tables for the task "{task.name}", which no plugin shows')
    object_type, name = task.plugin
    plugin = {"type": name, "filename": str(path)}
    layout = table.settings.get("layout")
    maps = [entry["name"] for entry in layout["maps"]] if isinstance(layout, dict) else []
    if len(maps) > 1:
        plugin["channels"] = next((shown for shown in SHOWN if shown in maps), maps[0])
    if object_type == "texture":
        square = {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": plugin}}
        return _scene(
            {"square": square}, [-1, -1, 0], [1, 1, 0], way=(0, 0, 1), lamp=False, integrator="path_footprint"
        )
    if object_type == "bsdf":
        return _scene({"ball": {"type": "sphere", "bsdf": plugin}}, [-1, -1, -1], [1, 1, 1], integrator="path")
    if object_type == "shape":
        with scene_errors(path):
            box = mi.load_dict(plugin).bbox()
        solid = {**plugin, "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.6}}}
        return _scene({"solid": solid}, box.min, box.max, integrator="path_sdf")
    lower, upper = task.model(table, array_module().TensorXf).describe()[0].get("box", ([-1] * 3, [1] * 3))
    return _scene({}, lower, upper, lamp=False, light=False) | {"integrator": plugin}


def _scene(shapes: dict, lower, upper, way=CAMERA, lamp: bool = True, light: bool = True, integrator: str = "") -> dict:
    """Return a scene of ``shapes`` in the box from ``lower`` to ``upper``, seen along ``way``, with light."""
    lower, upper = (np.array([float(x) for x in corner]) for corner in (lower, upper))
    middle, radius = (lower + upper) / 2, max(float(np.linalg.norm(upper - lower)) / 2, 1e-6)
    transform = mi.ScalarTransform4f
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "pixel_format": "rgb", "rfilter": {"type": "box"}}
    towards = np.array(way, float) / np.linalg.norm(way)
    sensor = {
        "type": "perspective",
        "fov": 40,
        "fov_axis": "y",
        "to_world": transform().look_at((middle + 2.3 * radius * towards).tolist(), middle.tolist(), [0, 1, 0]),
        "film": film,
        "sampler": {"type": "independent", "sample_count": 64},
    }
    scene = {"type": "scene", "sensor": sensor, **shapes}
    if integrator:
        scene["integrator"] = {"type": integrator, "max_depth": 4}
    if light:
        scene["light"] = {"type": "constant", "radiance": {"type": "rgb", "value": 0.4 if lamp else 1.0}}
    if lamp:
        place = middle + 4 * radius * np.array(LAMP)
        scene["lamp"] = {
            "type": "rectangle",
            "to_world": transform().look_at(place.tolist(), middle.tolist(), [0, 1, 0.1]).scale(radius),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 12.0}},
        }
    return scene
