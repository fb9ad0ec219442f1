"""Backgrounds of one colour, which stand for alpha in images that have none.

Pixels of the background's colour that are connected with the border of their image through such pixels become empty.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import binary_propagation

from .image_files import encoded

#: Name → bytes of sRGB.
NAMED = {"white": (255, 255, 255), "black": (0, 0, 0)}

#: Largest difference from the background in a byte of its pixels.
TOLERANCE = 4

#: Least share of the pixels at borders that have one colour if it is the background.
SHARE_OF_BORDER = 0.9


def _shown(image: np.ndarray) -> np.ndarray:
    """Return the bytes of sRGB of an image of bytes or halves, ``(…, 3)``."""
    return (image if image.dtype == np.uint8 else encoded(image.astype(np.float32)))[..., :3]


def _near(shown: np.ndarray, colour) -> np.ndarray:
    return np.abs(shown.astype(np.int16) - np.int16(colour)).max(axis=-1) <= TOLERANCE


def border_colour(views: range | list[int], image: Callable, counted: Callable) -> tuple[int, int, int] | None:
    """Return the colour that most pixels at the borders of some views have, bytes of sRGB, or ``None``.

    ``image(view)`` and ``counted(view)`` are those of :class:`.views.CapturedViews`, the image as it is stored.
    """
    pixels = []
    for view in views:
        shown, counts = image(view), counted(view)
        for side in ((0, slice(None)), (-1, slice(None)), (slice(None), 0), (slice(None), -1)):
            pixels.append(_shown(shown[side])[counts[side]])
    pixels = np.concatenate(pixels)
    if not len(pixels):
        return None
    colour = np.median(pixels, axis=0).astype(int)
    return tuple(colour.tolist()) if _near(pixels, colour).mean() >= SHARE_OF_BORDER else None


def clear(image: np.ndarray, counted: np.ndarray, colour) -> None:
    """Set the pixels of the background in a stored image to 0."""
    free = _near(_shown(image), colour) | ~counted
    border = np.ones_like(free)
    border[1:-1, 1:-1] = False
    image[binary_propagation(border & free, mask=free) & counted] = 0
