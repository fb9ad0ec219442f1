"""Preview of a training: shaded images at some levels beside their truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ...core.files import replacing
from ...images import srgb
from .evaluation import ShadedEvaluation, ShadedReader

#: Levels of the preview, and the factor by which differences are amplified.
LEVELS, AMPLIFIED = (0, 2, 4), 4

#: Approximate mean linear value of the image that is chosen.
BRIGHTNESS = 0.3

#: Smallest number of pixels along the side of each image.
PANEL = 192

#: Height of a strip of titles, pixels.
TITLE = 16


def write_preview(path: Path, evaluation: ShadedEvaluation, read: ShadedReader) -> None:
    """Write a picture with a row for each of :data:`LEVELS`, with titles: truth, shaded image, amplified difference.

    View and light are those under which the material is neither dark nor glaring.
    """
    import mitsuba as mi

    truths = evaluation.truths[next(iter(evaluation.truths))]
    pair = int(np.abs(np.clip(truths[0], 0, 1).mean(axis=(1, 2, 3)) - BRIGHTNESS).argmin())
    rows, side = [], max(PANEL, *(max(size) for size in evaluation.sizes))
    for level in (i for i in LEVELS if i < evaluation.levels):
        truth, got = truths[level][pair], evaluation.images(read, level, [pair])[0]
        row = [srgb.for_display(truth), srgb.for_display(got), np.clip(AMPLIFIED * np.abs(truth - got), 0, 1)]
        titles = (f"level {level}: reference", "shaded", f"{AMPLIFIED}x difference")
        rows.append(titled(np.concatenate([_enlarged(image, side) for image in row], axis=1), titles))
    picture = np.concatenate(rows)
    with replacing(path) as temporary:
        mi.Bitmap(np.ascontiguousarray(picture)).write(str(temporary))


def titled(picture: np.ndarray, titles: Sequence[str]) -> np.ndarray:
    """Return a picture ``(height, width, 3)`` of values from 0 to 1 with a strip of ``titles`` above, 8 bits.

    The titles stand above as many parts of equal width.
    """
    from PIL import Image, ImageDraw, ImageFont

    width = picture.shape[1]
    strip = Image.new("RGB", (width, TITLE), "white")
    font = ImageFont.load_default(size=11)
    for i, title in enumerate(titles):
        ImageDraw.Draw(strip).text((i * width // len(titles) + 2, 1), title, "black", font)
    return np.concatenate([np.asarray(strip), np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)])


def _enlarged(image: np.ndarray, side: int) -> np.ndarray:
    """Enlarge an image by a whole factor to at most ``side`` × ``side`` pixels; the rest of the square is white."""
    times = max(1, side // max(image.shape[:2]))
    image = image.repeat(times, axis=0).repeat(times, axis=1)
    square = np.ones((side, side, 3))
    square[: image.shape[0], : image.shape[1]] = image
    return square
