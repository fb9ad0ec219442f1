"""A scene from a camera that goes once around it: frames, and how they are kept, as a film strip or as a film."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path

import mitsuba as mi
import numpy as np

from . import scenes, srgb
from .files import replacing
from .plugins.support import footprint

#: Extensions of files that move.
FILMS = (".webp", ".gif")

#: Frames in a row of a film strip, at most.
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
    """
    Render a loaded scene ``frames`` times, its first camera turned about the axis ``up`` through ``centre`` by 360°
    divided by their number each time; the first is what the camera sees as it stands, where it is again in the end.
    By default, the axis goes through the middle of all that is no light.

    Returns the linear images; once ``stop`` is set, those that are done. Raises
    :class:`~mi_diffind.scenes.SceneError` if there is no camera that can be moved.
    """
    if not scene.sensors():
        raise scenes.SceneError("orbit: the scene has no sensor")
    sensor = scene.sensors()[0]
    parameters = mi.traverse(sensor)
    if "to_world" not in parameters:
        raise scenes.SceneError(f"orbit: the sensor {sensor.class_name()} cannot be moved")
    centre = middle(scene) if centre is None else np.array(centre, np.float64)
    kind, before = type(parameters["to_world"]), np.array(parameters["to_world"].matrix, np.float64).reshape(4, 4)

    def move(matrix: np.ndarray) -> None:
        parameters["to_world"] = kind(mi.ScalarTransform4f(matrix))
        parameters.update()
        footprint.attach(scene, 0, spp)

    found = []
    try:
        for i in range(frames):
            move(turned(centre, up, 360 * i / frames) @ before)
            found.append(scenes.render(scene, spp, seed)[0])
            if on_frame is not None:
                on_frame()
            if stop is not None and stop.is_set():
                break
    finally:
        move(before)
    return found


def middle(scene) -> np.ndarray:
    """The middle of the box of all shapes that are no lights, ``(3,)``; the origin if there is none."""
    boxes = [s.bbox() for s in scene.shapes() if not s.is_emitter()]
    corners = np.array([[b.min, b.max] for b in boxes], np.float64).reshape(-1, 2, 3)
    if not len(corners) or not np.isfinite(corners).all():
        return np.zeros(3)
    return (corners[:, 0].min(axis=0) + corners[:, 1].max(axis=0)) / 2


def turned(centre, axis, degrees: float) -> np.ndarray:
    """A rotation about an axis through a point, ``(4, 4)`` (Rodrigues)."""
    unit = np.array(axis, np.float64) / np.linalg.norm(axis)
    k, angle = np.cross(np.eye(3), unit), np.radians(degrees)
    found = np.eye(4)
    found[:3, :3] += np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    found[:3, 3] = centre - found[:3, :3] @ centre
    return found


def strip(frames: Sequence[np.ndarray], columns: int = COLUMNS) -> np.ndarray:
    """One image of all frames, at most ``columns`` in a row, nothing (0) where there is none."""
    columns = min(columns, len(frames))
    rows = -(-len(frames) // columns)
    height, width, channels = frames[0].shape
    found = np.zeros((rows, height, columns, width, channels), np.float32)
    for i, frame in enumerate(frames):
        found[i // columns, :, i % columns] = frame
    return found.reshape(rows * height, columns * width, channels)


def write(path: str | os.PathLike, frames: Sequence[np.ndarray], seconds: float = 4.0) -> None:
    """
    Write linear frames as a film that runs for ``seconds`` again and again (``.webp``, ``.gif``), or as one image
    (:func:`strip`). Alpha is kept where the file has it.
    """
    path = Path(path)
    if path.suffix.lower() not in (*FILMS, ".png"):
        scenes.write_image(path, strip(frames))
        return
    from PIL import Image

    if path.suffix.lower() == ".png":
        with replacing(path) as temporary:
            Image.fromarray(displayed(strip(frames))).save(temporary)
        return

    shown = [Image.fromarray(displayed(frame)) for frame in frames]
    options = {"save_all": True, "append_images": shown[1:], "duration": round(1000 * seconds / len(shown)), "loop": 0}
    if path.suffix.lower() == ".webp":
        options |= {"quality": 85, "method": 4}
    else:
        options |= {"disposal": 2}
    with replacing(path) as temporary:
        shown[0].save(temporary, **options)


def displayed(image: np.ndarray) -> np.ndarray:
    """Bytes ``(height, width, 3)`` of an image; of one of 2 or 4 channels, which are multiplied by alpha, 4."""
    channels = image.shape[2]
    has_alpha = channels in (2, 4)
    colours, alpha = (image[..., :-1], image[..., -1:]) if has_alpha else (image, np.ones_like(image[..., :1]))
    if colours.shape[2] == 1:
        colours = colours.repeat(3, axis=2)
    shown = srgb.for_display(colours[..., :3] / np.maximum(alpha, 1e-6))
    if has_alpha:
        shown = np.concatenate([shown, np.clip(alpha, 0, 1)], axis=-1)
    return np.round(255 * shown).astype(np.uint8)
