"""Rig of a loaded scene: its camera and lights, moved to the places of a view."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..loading import SceneError
from ..poses import rotation
from .options import View, ViewDistribution

#: Sine of the angle between two directions below which they count as parallel.
PARALLEL = 1e-4

#: Bit of a parameter that cannot be set.
READ_ONLY = mi.ParamFlags.ReadOnly.value

#: Small ranges (:func:`small_ranges`), degrees to both sides of the scene's camera and lights.
AZIMUTH, ELEVATION, LIGHT_AZIMUTH = 15.0, 10.0, 20.0

#: Shares of the small ranges that are tried, until no surface is in the way.
SHARES = (1.0, 0.5, 0.25, 0.125)

#: Rows and columns of the rays that look for surfaces in the image.
RAYS = 32


class Rig:
    """First sensor and lights of a loaded scene, moved through scene parameters: nothing is loaded or compiled again.

    Raises :class:`.SceneError` if the scene has nothing that could be moved, or looked at.
    """

    def __init__(self, scene: mi.Scene, views: ViewDistribution):
        self.scene, self.views = scene, views
        if not scene.sensors():
            raise SceneError("the scene has no sensor, views need one")
        up = np.array(views.up or (0, 1, 0), np.float64)
        self.up = up / np.linalg.norm(up)
        self.sensor = _Movable(scene.sensors()[0], scene)
        if views.moves_camera and self.sensor.parameter != "to_world":
            raise SceneError(f"the sensor {scene.sensors()[0].class_name()} cannot be moved")
        nodes = [*scene.emitters(), *(shape for shape in scene.shapes() if shape.is_emitter())]
        lights = [_Movable(node, scene) for node in nodes] if views.moves_light else []
        self.lights = [light for light in lights if light.parameter]
        raised = [light for light in self.lights if not light.environment or light.sun is not None]
        if views.moves_light and not (self.lights if views.light_elevation is None else raised):
            names = ", ".join(sorted({e.class_name() for e in scene.emitters()})) or "none"
            what = "light_azimuth" if views.light_elevation is None else "light_elevation"
            raise SceneError(
                f"{what}: no light of the scene can be moved so ({names}); directional, point, spot and area lights "
                f"can, the sun of a sunsky by its sun_direction, and environments about the vertical"
            )
        self.target = np.zeros(3)
        if views.moves_camera or any(not light.at_infinity for light in self.lights):
            self.target = self._target()

    def _target(self) -> np.ndarray:
        """Return the target of the views: the given one, or the surface in the middle of the scene's image."""
        if self.views.target is not None:
            return np.array(self.views.target, np.float64)
        sensor = self.scene.sensors()[0]
        middle = mi.Point2f(0.5)
        hit = self.scene.ray_intersect(sensor.sample_ray(sensor.shutter_open(), 0.5, middle, middle)[0])
        if not hit.is_valid()[0]:
            raise SceneError("target: not given, and the middle of the scene's image shows no surface")
        return np.array(hit.p, np.float64).ravel()

    def place(self, view: View) -> None:
        """Move camera and lights to a view."""
        if self.views.moves_camera:
            self.sensor.move(self.camera(view))
        for light in self.lights:
            turn = self.turn(light, view)
            light.move(turn @ light.before, None if light.sun is None else self._sun(light, turn, view))

    def camera(self, view: View) -> np.ndarray:
        """Return the 4×4 matrix of the camera in a view."""
        before = self.sensor.before
        origin = before[:3, 3]
        if view.origin is not None:
            to = np.array(view.origin)
        else:
            to = self.target + self._rotate_offset(origin - self.target, view.azimuth, view.elevation, view.distance)
        # Roll, scale and the angle to the target of the scene's own camera are preserved
        return self._look_at(to) @ np.linalg.inv(self._look_at(origin)) @ before

    def turn(self, light: _Movable, view: View) -> np.ndarray:
        """Return the 4×4 matrix that moves a light from its place in the scene to that of a view."""
        centre = self.target
        if light.environment:
            return rotation(self.up, view.light_azimuth or 0.0, centre)
        towards = -light.before[:3, 2] if light.at_infinity else light.centre - centre
        turned = self._rotate_offset(towards, view.light_azimuth, view.light_elevation, None)
        turn = rotation(self.up, view.light_azimuth or 0.0)
        azimuthal = turn[:3, :3] @ towards
        axis = np.cross(azimuthal, turned)
        sine = np.linalg.norm(axis)
        if sine >= 1e-12 * np.linalg.norm(azimuthal) * np.linalg.norm(turned):
            turn = rotation(axis, np.degrees(np.arctan2(sine, azimuthal @ turned))) @ turn
        turn[:3, 3] = centre - turn[:3, :3] @ centre
        return turn

    def _sun(self, light: _Movable, turn: np.ndarray, view: View) -> np.ndarray:
        """Return the direction of the sun of a sky that was turned, in the sky's coordinates."""
        if view.light_elevation is None:
            return light.sun
        sky = light.before[:3, :3]
        towards = self._rotate_offset(sky @ light.sun, view.light_azimuth, view.light_elevation, None)
        return np.linalg.solve(turn[:3, :3] @ sky, towards)

    def _rotate_offset(self, offset: np.ndarray, azimuth, elevation, distance) -> np.ndarray:
        """Return an offset from the target after a turn about ``up``, at an elevation and a distance."""
        length = np.linalg.norm(offset)
        if length == 0:
            raise SceneError("target: found the place of the camera or of a light, another point is needed")
        height = offset @ self.up
        flat = offset - height * self.up
        if np.linalg.norm(flat) < PARALLEL * length:
            flat = np.eye(3)[np.argmin(np.abs(self.up))]
            flat = flat - (flat @ self.up) * self.up
        flat = rotation(self.up, azimuth or 0.0)[:3, :3] @ (flat / np.linalg.norm(flat))
        angle = np.arcsin(np.clip(height / length, -1, 1)) if elevation is None else np.radians(elevation)
        return (distance or length) * (np.cos(angle) * flat + np.sin(angle) * self.up)

    def _look_at(self, origin: np.ndarray) -> np.ndarray:
        """Return the ``look_at`` matrix from ``origin`` to the target."""
        axis = self.target - origin
        if np.linalg.norm(axis) == 0:
            raise SceneError("target: found the place of the camera, another point is needed")
        axis = axis / np.linalg.norm(axis)
        left = np.cross(self.up, axis)
        if np.linalg.norm(left) < PARALLEL:
            left = np.cross(np.eye(3)[np.argmin(np.abs(axis))], axis)
        left = left / np.linalg.norm(left)
        matrix = np.eye(4)
        matrix[:3] = np.stack([left, np.cross(axis, left), axis, origin], axis=1)
        return matrix


class _Movable:
    """Sensor, light or shape that emits, moved by its ``to_world``, its ``position`` or the vertices of a mesh.

    ``parameter``: the key of that ("": fixed); ``before``: the 4×4 matrix in the scene, the identity for a mesh;
    ``centre``: its place, of a shape the centre of its bounds; ``sun``: direction of the sun in the coordinates of a
    sky, ``None`` if there is none or its date gives it.
    """

    def __init__(self, node, scene: mi.Scene):
        self.parameters = mi.traverse(node)
        keys = ("to_world", "position", "vertex_positions")
        self.parameter = next((key for key in keys if key in self.parameters), "")
        emitter = isinstance(node, mi.Emitter)
        self.environment = emitter and bool(node.is_environment())
        self.at_infinity = self.environment or (emitter and mi.has_flag(node.flags(), mi.EmitterFlags.Infinite))
        self.before, self.vertices, self.sun = np.eye(4), {}, None
        if self.parameter == "to_world":
            self.before = np.array(self.parameters["to_world"].matrix, np.float64).reshape(4, 4)
        elif self.parameter == "position":
            self.before[:3, 3] = np.array(self.parameters["position"], np.float64).ravel()
        elif self.parameter:
            keys = [key for key in ("vertex_positions", "vertex_normals") if key in self.parameters]
            self.vertices = {key: np.array(self.parameters[key]).reshape(-1, 3) for key in keys}
        self.scene = scene if isinstance(node, mi.Shape) else None
        self.centre = np.array(node.bbox().center(), np.float64).ravel() if self.scene else self.before[:3, 3]
        if "sun_direction" in self.parameters and not self.parameters.flags("sun_direction") & READ_ONLY:
            self.sun = np.array(self.parameters["sun_direction"], np.float64).ravel()

    def move(self, matrix: np.ndarray, sun: np.ndarray | None = None) -> None:
        """Move to a 4×4 matrix; ``sun``: the new direction of the sun, in the coordinates of the sky."""
        if self.parameter == "to_world":
            transform = type(self.parameters["to_world"])(mi.ScalarTransform4f(matrix))
            dr.make_opaque(transform)  # no part of a kernel depends on it
            self.parameters["to_world"] = transform
        elif self.parameter == "position":
            self.parameters["position"] = type(self.parameters["position"])(matrix[:3, 3].tolist())
        for key, values in self.vertices.items():
            shift = matrix[:3, 3] if key == "vertex_positions" else 0
            self.parameters[key] = (values @ matrix[:3, :3].T + shift).ravel().astype(np.float32)
        if sun is not None:
            self.parameters["sun_direction"] = dr.opaque(mi.Vector3f, sun.tolist())
        self.parameters.update()
        if self.scene:
            self.scene.parameters_changed()  # rays are to find the shape at its place


def small_ranges(scene: mi.Scene, views: ViewDistribution) -> ViewDistribution:
    """Return a distribution of as many views with small ranges around the camera and the lights of a loaded scene.

    The camera turns by ± :data:`AZIMUTH` and rises and sinks by :data:`ELEVATION`, at most to half of its own height
    above the horizon; lights turn by ± :data:`LIGHT_AZIMUTH`. A target that is not given is the point on the camera's
    axis at the median depth of the visible surfaces, and the vertical the axis that is closest to the camera's. Ranges
    are halved until the straight ways of camera and lights to all views cross no surface, so that they stay inside a
    room and outside of objects. A camera or lights that cannot be moved stay. If both stay, the views are returned.
    """
    if not scene.sensors():
        return views
    target = views.target or _middle(scene)
    if target is None:
        return views
    around = dataclasses.replace(views, target=target, up=views.up or _vertical(scene))
    ranges = {}
    for draw in (_camera_ranges, _light_ranges):
        for share in SHARES:
            drawn = draw(scene, around, share)
            if drawn is None:
                break
            part, ways, passable = drawn
            if not _is_blocked(scene, ways, passable):
                ranges |= part
                break
    return dataclasses.replace(around, **ranges) if ranges else views


def _camera_ranges(scene: mi.Scene, views: ViewDistribution, share: float) -> tuple | None:
    """Return a share of the camera's small ranges, and its ways to all views; ``None``: it cannot be moved."""
    azimuth = share * AZIMUTH
    try:
        rig = Rig(scene, dataclasses.replace(views, azimuth=(-azimuth, azimuth)))
    except SceneError:
        return None
    origin = rig.sensor.before[:3, 3]
    offset = origin - rig.target
    height = float(np.degrees(np.arcsin(np.clip(offset @ rig.up / np.linalg.norm(offset), -1, 1))))
    low, high = height - share * ELEVATION, height + share * ELEVATION
    low = max(low, height / 2 if height > 0 else -89.0)
    ranges = {"azimuth": (-azimuth, azimuth), "elevation": (min(low, 89.0), min(high, 89.0))}
    drawn = dataclasses.replace(views, **ranges)
    return ranges, [(origin, rig.camera(view)[:3, 3]) for view in (*drawn.trained(), *drawn.measured())], False


def _light_ranges(scene: mi.Scene, views: ViewDistribution, share: float) -> tuple | None:
    """Return a share of the lights' small range, and the ways of lights at finite distances to all views."""
    ranges = {"light_azimuth": (-share * LIGHT_AZIMUTH, share * LIGHT_AZIMUTH)}
    drawn = dataclasses.replace(views, **ranges)
    try:
        rig = Rig(scene, drawn)
    except SceneError:
        return None
    views = [*drawn.trained(), *drawn.measured()]
    lights = [light for light in rig.lights if not light.at_infinity]
    ways = [(x.centre, (rig.turn(x, view) @ [*x.centre, 1])[:3]) for x in lights for view in views]
    return ranges, ways, True


def _is_blocked(scene: mi.Scene, ways: Sequence[tuple[np.ndarray, np.ndarray]], lights_pass: bool) -> bool:
    """Return whether a surface crosses a straight way; lights may pass surfaces that shine, which are their own."""
    if not ways:
        return False
    starts, ends = (np.array(points, np.float32).T for points in zip(*ways, strict=True))
    start, end = mi.Point3f(starts), mi.Point3f(ends)
    ray = mi.Ray3f(start, dr.normalize(end - start))
    ray.maxt = dr.norm(end - start)
    hit = scene.ray_intersect(ray)
    blocked = hit.is_valid()
    if lights_pass:
        blocked &= ~hit.shape.is_emitter()
    return bool(dr.any(blocked))


def _middle(scene: mi.Scene) -> tuple[float, float, float] | None:
    """Return the point on the camera's axis at the median depth of visible surfaces; ``None``: nothing is visible."""
    sensor = scene.sensors()[0]
    matrix = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
    places = (np.stack(np.meshgrid(*2 * [np.arange(RAYS)])).reshape(2, -1) + 0.5) / RAYS
    rays, _ = sensor.sample_ray(sensor.shutter_open(), 0.5, mi.Point2f(places.astype(np.float32)), mi.Point2f(0.5))
    hit = scene.ray_intersect(rays)
    points = np.array(hit.p, np.float64).T[np.array(hit.is_valid())]
    axis = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
    if not len(points):
        return None
    return tuple((matrix[:3, 3] + np.median((points - matrix[:3, 3]) @ axis) * axis).tolist())


def _vertical(scene: mi.Scene) -> tuple[float, float, float]:
    """Return the axis closest to the camera's vertical, of those that are at right angles to its horizontal."""
    matrix = np.array(scene.sensors()[0].world_transform().matrix, np.float64).reshape(4, 4)
    left, up = (matrix[:3, i] / np.linalg.norm(matrix[:3, i]) for i in (0, 1))
    candidates = [i for i in (1, 2, 0) if abs(left[i]) < 0.1] or [1]
    return tuple(np.eye(3)[max(candidates, key=lambda i: round(up[i], 3))].tolist())
