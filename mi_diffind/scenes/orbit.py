"""Cameras that move through a scene, such as once around it: rendered frames, and a film or a film strip of them."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..core.files import replacing
from ..images import films
from ..plugins.support import footprint
from . import loading
from .poses import rotation

#: Largest number of frames in a row of a film strip.
COLUMNS = 6


def orbit(
    scene,
    frames: int,
    centre: Sequence[float] | None = None,
    up: Sequence[float] = (0.0, 1.0, 0.0),
    spp: int | None = None,
    seed: int = 0,
    on_frame: Callable[[], object] | None = None,
    stop: threading.Event | None = None,
) -> list[np.ndarray]:
    """Render a loaded scene ``frames`` times, while its first camera moves once around the scene.

    For each frame, the camera turns about the axis ``up`` through ``centre`` (default: the middle of all shapes that
    are no lights) by 360° divided by the number of frames. The first frame is the camera's own view, to which it
    returns at the end.

    Returns the linear images; once ``stop`` is set, the frames that are done. Raises
    :class:`.SceneError` if there is no camera that can be moved.
    """
    centre = middle(scene) if centre is None else np.array(centre, np.float64)
    turns = [rotation(up, 360 * i / frames, centre) for i in range(frames)]
    return along(scene, turns, spp, seed, on_frame=on_frame, stop=stop)


def along(
    scene,
    motions: Sequence[np.ndarray],
    spp: int | None = None,
    seed: int = 0,
    new_seeds: bool = False,
    on_frame: Callable[[], object] | None = None,
    stop: threading.Event | None = None,
) -> list[np.ndarray]:
    """Render a loaded scene once for each of ``motions`` of its first camera, which then returns to its place.

    A motion is a matrix ``(4, 4)`` in world space that moves the camera from its place in the scene. All frames have
    the random numbers of ``seed``; with ``new_seeds``, frame ``i`` has those of ``seed + i``.

    Returns the linear images; once ``stop`` is set, the frames that are done. Raises
    :class:`.SceneError` if there is no camera that can be moved.
    """
    if not scene.sensors():
        raise loading.SceneError("orbit: the scene has no sensor")
    sensor = scene.sensors()[0]
    parameters = mi.traverse(sensor)
    if "to_world" not in parameters:
        raise loading.SceneError(f"orbit: the sensor {sensor.class_name()} cannot be moved")
    transform, before = type(parameters["to_world"]), np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)

    def move(matrix: np.ndarray) -> None:
        parameters["to_world"] = transform(mi.ScalarTransform4f(matrix))
        parameters.update()
        footprint.attach(scene, 0, spp)

    images = []
    try:
        for i, motion in enumerate(motions):
            move(motion @ before)
            images.append(loading.render(scene, spp, seed + i * new_seeds)[0])
            if on_frame is not None:
                on_frame()
            if stop is not None and stop.is_set():
                break
    finally:
        move(before)
    return images


def middle(scene) -> np.ndarray:
    """Return the middle of the box of all shapes that are no lights, ``(3,)``; the origin without such shapes."""
    boxes = [s.bbox() for s in scene.shapes() if not s.is_emitter()]
    corners = np.array([[b.min, b.max] for b in boxes], np.float64).reshape(-1, 2, 3)
    if not len(corners) or not np.isfinite(corners).all():
        return np.zeros(3)
    return (corners[:, 0].min(axis=0) + corners[:, 1].max(axis=0)) / 2


def strip(frames: Sequence[np.ndarray], columns: int = COLUMNS) -> np.ndarray:
    """Return one image of all frames, at most ``columns`` in a row; missing cells are 0."""
    columns = min(columns, len(frames))
    rows = -(-len(frames) // columns)
    height, width, channels = frames[0].shape
    grid = np.zeros((rows, height, columns, width, channels), np.float32)
    for i, frame in enumerate(frames):
        grid[i // columns, :, i % columns] = frame
    return grid.reshape(rows * height, columns * width, channels)


def write(path: str | os.PathLike, frames: Sequence[np.ndarray], seconds: float = 4.0) -> None:
    """Write linear frames as a film of ``seconds`` (:data:`.films.FILMS`), or as one image (:func:`strip`).

    Alpha is kept in formats that support it; H.264 shows what is transparent in front of black.
    """
    path = Path(path)
    extension = path.suffix.lower()
    if extension not in (*films.FILMS, ".png"):
        loading.write_image(path, strip(frames))
        return
    if extension == ".png":
        from PIL import Image

        with replacing(path) as temporary:
            Image.fromarray(films.displayed(strip(frames))).save(temporary)
        return
    shown = films.over_black if extension == ".mp4" else films.displayed
    films.write(path, [shown(frame) for frame in frames], seconds)
