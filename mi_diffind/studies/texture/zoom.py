"""Zoom of the texture study: a camera that moves along its axis towards a plane, rendered frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ...measure.flicker import POINTS, MovingView
from .test_scenes import TextureReader, TextureScene, displayed

#: Ratio of the camera's distances to the plane in the first and in the last frame.
NEARER = 2.0


@dataclass(frozen=True)
class TextureZoom(MovingView):
    """A zoom into a scene: ``frames`` of a ``film`` (width, height), with a ``texture`` of (width, height) texels."""

    scene: TextureScene
    film: tuple[int, int]
    texture: tuple[int, int]
    frames: int

    def origins(self) -> np.ndarray:
        """Return the camera's positions, ``(frames, 3)``; its distance decreases by the same factor each frame."""
        start, target = (np.asarray(v, float) for v in (self.scene.origin, self.scene.target))
        distance = NEARER ** (-np.arange(self.frames) / max(self.frames - 1, 1))
        return target + distance[:, None] * (start - target)

    def render(self, reader: TextureReader, seed: int = 0) -> np.ndarray:
        """Return the frames as displayed, ``(frames, height, width, 3)``, each with its own random numbers."""
        loaded = reader.loaded(self.scene, self.film, self.texture)
        parameters, images = mi.traverse(loaded), []

        def move(origin) -> None:
            parameters["sensor.to_world"] = mi.Transform4f(self.scene.camera_at(origin))
            parameters.update()
            reader.prepare(loaded)

        for k, origin in enumerate(self.origins()):
            move(origin)
            images.append(displayed(mi.render(loaded, spp=reader.spp, seed=(seed << 12) + k)))
        move(self.scene.origin)
        return np.stack(images)

    def points(self) -> np.ndarray:
        """Return points of the plane, ``(n, 3)``, well within the last frame, and so within all."""
        last = self.origins()[-1]
        x, y = np.meshgrid(*[np.linspace(0.06, 0.94, POINTS)] * 2)
        axes = np.array(self.scene.camera_at(last).matrix, float)[:3, :3].T  # rows: right to left, up, forward
        tangent = np.tan(np.radians(self.scene.fov) / 2)
        width, height = tangent, tangent * self.film[1] / self.film[0]
        rays = np.stack([(1 - 2 * x) * width, (1 - 2 * y) * height, np.ones_like(x)], -1).reshape(-1, 3) @ axes
        return last + rays * (-last[1] / rays[:, 1:2])  # the plane is y = 0

    def places(self, frame: int) -> np.ndarray:
        origin = self.origins()[frame]
        axes = np.array(self.scene.camera_at(origin).matrix, float)[:3, :3]
        local = (self.points() - origin) @ axes
        slope = local[:, :2] / local[:, 2:] / np.tan(np.radians(self.scene.fov) / 2)
        slope[:, 1] *= self.film[0] / self.film[1]
        return (1 - slope) / 2 * self.film
