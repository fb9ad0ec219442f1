"""Rig of a loaded scene: its camera and lights, moved to the places of a view."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from ..poses import rotation
from ..scenes import SceneError
from .views import View, ViewDistribution

#: Sine of the angle between two directions below which they count as parallel.
PARALLEL = 1e-4


class Rig:
    """First sensor and lights of a loaded scene, moved through scene parameters: nothing is loaded or compiled again.

    Raises :class:`~mi_diffind.scenes.SceneError` if the scene has nothing that could be moved, or looked at.
    """

    def __init__(self, scene: mi.Scene, views: ViewDistribution):
        self.scene, self.views = scene, views
        if not scene.sensors():
            raise SceneError("the scene has no sensor, views need one")
        self.up = np.array(views.up, np.float64) / np.linalg.norm(views.up)
        self.sensor = _Movable(scene.sensors()[0])
        if views.moves_camera and not self.sensor.matrix:
            raise SceneError(f"the sensor {scene.sensors()[0].class_name()} cannot be moved")
        self.lights = [_Movable(e) for e in scene.emitters()] if views.moves_light else []
        self.lights = [light for light in self.lights if light.parameter]
        raised = [light for light in self.lights if not light.environment]
        if views.moves_light and not (self.lights if views.light_elevation is None else raised):
            names = ", ".join(sorted({e.class_name() for e in scene.emitters()})) or "none"
            what = "light_azimuth" if views.light_elevation is None else "light_elevation"
            raise SceneError(
                f"{what}: no light of the scene can be moved so ({names}); directional, point and spot lights can, and "
                f"environments about the vertical"
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
            self.sensor.move(self._camera(view))
        for light in self.lights:
            light.move(self._light(light, view))

    def _camera(self, view: View) -> np.ndarray:
        before = self.sensor.before
        origin = before[:3, 3]
        if view.origin is not None:
            to = np.array(view.origin)
        else:
            to = self.target + self._turned(origin - self.target, view.azimuth, view.elevation, view.distance)
        # Roll, scale and the angle to the target of the scene's own camera are preserved
        return self._looking(to) @ np.linalg.inv(self._looking(origin)) @ before

    def _light(self, light: _Movable, view: View) -> np.ndarray:
        before, centre = light.before, self.target
        if light.environment:
            return rotation(self.up, view.light_azimuth or 0.0, centre) @ before
        towards = -before[:3, 2] if light.at_infinity else before[:3, 3] - centre
        turned = self._turned(towards, view.light_azimuth, view.light_elevation, None)
        turn = _between(towards, turned, self.up, view.light_azimuth or 0.0)
        turn[:3, 3] = centre - turn[:3, :3] @ centre
        return turn @ before

    def _turned(self, offset: np.ndarray, azimuth, elevation, distance) -> np.ndarray:
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

    def _looking(self, origin: np.ndarray) -> np.ndarray:
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
    """A sensor or light; ``before``: its 4×4 matrix in the scene; ``parameter``: key of its place ("": fixed)."""

    def __init__(self, node):
        self.parameters = mi.traverse(node)
        self.parameter = next((k for k in ("to_world", "position") if k in self.parameters), "")
        self.matrix = self.parameter == "to_world"
        emitter = isinstance(node, mi.Emitter)
        self.environment = emitter and bool(node.is_environment())
        self.at_infinity = self.environment or (emitter and mi.has_flag(node.flags(), mi.EmitterFlags.Infinite))
        self.before = np.eye(4)
        if self.matrix:
            self.before = np.array(self.parameters[self.parameter].matrix, np.float64).reshape(4, 4)
        elif self.parameter:
            self.before[:3, 3] = np.array(self.parameters[self.parameter], np.float64).ravel()

    def move(self, matrix: np.ndarray) -> None:
        parameter_type = type(self.parameters[self.parameter])
        value = mi.ScalarTransform4f(matrix) if self.matrix else [float(x) for x in matrix[:3, 3]]
        self.parameters[self.parameter] = parameter_type(value)
        self.parameters.update()


def _between(before: np.ndarray, after: np.ndarray, up: np.ndarray, degrees: float) -> np.ndarray:
    """Return the rotation by ``degrees`` about ``up``, then the shortest one that aligns ``before`` with ``after``."""
    turn = rotation(up, degrees)
    a, b = turn[:3, :3] @ before, after
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis)
    if sine < 1e-12 * np.linalg.norm(a) * np.linalg.norm(b):
        return turn
    return rotation(axis, np.degrees(np.arctan2(sine, a @ b))) @ turn
