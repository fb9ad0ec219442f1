"""
Flicker: a camera that moves along its axis towards a plane, and what the same points of the plane look like meanwhile.

The frames are aligned by reprojection: a grid of points of the plane, all of which every frame shows, is projected into
each frame, where the image is read with bilinear interpolation. *Flicker* is the variance of a point's displayed values
over the frames, the mean over points and channels. The truth's is not zero, since a point shows more detail the nearer
the camera is; so the same is measured of the difference to the truth's frames.
"""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from .test_scenes import Reader, Stage, shown

#: How much nearer the camera is in the last frame than in the first.
NEARER = 2.0

#: Points of the plane along x and y.
GRID = 96


@dataclass(frozen=True)
class Zoom:
    """``frames`` of a ``film`` (width, height), of a stage and a texture (width, height)."""

    stage: Stage
    film: tuple[int, int]
    texture: tuple[int, int]
    frames: int

    def origins(self) -> np.ndarray:
        """Where the camera is, ``(frames, 3)``: each frame is nearer by the same factor."""
        start, target = (np.asarray(v, float) for v in (self.stage.origin, self.stage.target))
        distance = NEARER ** (-np.arange(self.frames) / max(self.frames - 1, 1))
        return target + distance[:, None] * (start - target)

    def render(self, reader: Reader, seed: int = 0) -> np.ndarray:
        """The frames as displayed, ``(frames, height, width, 3)``, each with random numbers of its own."""
        scene = reader.loaded(self.stage, self.film, self.texture)
        parameters, found = mi.traverse(scene), []
        for k, origin in enumerate(self.origins()):
            parameters["sensor.to_world"] = mi.Transform4f(self.stage.look(origin))
            parameters.update()
            reader.prepare(scene)
            found.append(shown(mi.render(scene, spp=reader.spp, seed=(seed << 12) + k)))
        parameters["sensor.to_world"] = mi.Transform4f(self.stage.look(self.stage.origin))
        parameters.update()
        reader.prepare(scene)
        return np.stack(found)

    def points(self) -> np.ndarray:
        """Points of the plane, ``(n, 3)``, that are well within the last frame, and so within all."""
        last = self.origins()[-1]
        x, y = np.meshgrid(*[np.linspace(0.06, 0.94, GRID)] * 2)
        axes = np.array(self.stage.look(last).matrix, float)[:3, :3].T  # rows: right to left, up, forward
        tangent = np.tan(np.radians(self.stage.fov) / 2)
        width, height = tangent, tangent * self.film[1] / self.film[0]
        way = np.stack([(1 - 2 * x) * width, (1 - 2 * y) * height, np.ones_like(x)], -1).reshape(-1, 3) @ axes
        return last + way * (-last[1] / way[:, 1:2])  # the plane is y = 0

    def places(self, frame: int) -> np.ndarray:
        """Where a frame shows the points: ``(n, 2)``, x and y in pixels, of whose centres the first is at 0.5."""
        origin = self.origins()[frame]
        axes = np.array(self.stage.look(origin).matrix, float)[:3, :3]
        local = (self.points() - origin) @ axes
        slope = local[:, :2] / local[:, 2:] / np.tan(np.radians(self.stage.fov) / 2)
        slope[:, 1] *= self.film[0] / self.film[1]
        return (1 - slope) / 2 * self.film

    def aligned(self, frames: np.ndarray) -> np.ndarray:
        """What the points look like, ``(frames, n, 3)``."""
        return np.stack([bilinear(image, self.places(k)) for k, image in enumerate(frames)])


def flicker(frames: np.ndarray) -> float:
    """The variance over aligned frames, the mean over points and channels."""
    return float(np.var(frames, axis=0, dtype=np.float64).mean())


def bilinear(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    position = places - 0.5
    lower = np.floor(position).astype(int)
    a, b = (position - lower).T[..., None]
    x0, x1 = (np.clip(lower[:, 0] + i, 0, width - 1) for i in (0, 1))
    y0, y1 = (np.clip(lower[:, 1] + i, 0, height - 1) for i in (0, 1))
    upper, under = (image[y, x0] * (1 - a) + image[y, x1] * a for y in (y0, y1))
    return upper * (1 - b) + under * b
