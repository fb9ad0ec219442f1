"""Flicker of a plane that a camera moves towards, and a figure of its frames.

The frames are aligned by reprojection: a grid of points of the plane, visible in every frame, is projected into each
frame, where the image is read with bilinear interpolation. *Flicker* is the variance of a point's displayed values over
the frames, averaged over points and channels. The truth's flicker is not zero, since a point shows more detail the
nearer the camera is; the flicker of the difference to the truth's frames is therefore measured, too.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from . import plot

#: Points of the plane along x and along y.
POINTS = 96

#: Frames in a row of a figure.
SHOWN_FRAMES = 5


class MovingView:
    """A number of ``frames`` that a moving camera renders of a plane; the base class of the zooms of studies."""

    frames: int

    def places(self, frame: int) -> np.ndarray:
        """Return the positions in a frame of the :data:`POINTS` × :data:`POINTS` points, row by row, ``(n, 2)``.

        Positions are x and y in pixels; the centre of the first pixel is at 0.5.
        """
        raise NotImplementedError

    def aligned(self, images: np.ndarray) -> np.ndarray:
        """Return the values of the points in each frame, ``(frames, n, channels)``."""
        return np.stack([bilinear(image, self.places(k)) for k, image in enumerate(images)])

    def errors(self, images: np.ndarray, truth: np.ndarray) -> dict[str, float]:
        """Return ``flicker`` of the frames, and ``flicker_error`` of their difference to the truth's frames."""
        points = self.aligned(images)
        return {"flicker": flicker(points), "flicker_error": flicker(points - self.aligned(truth))}

    def figure(self, title: str, caption: str, strips: Mapping[str, np.ndarray], truth: np.ndarray):
        """Return a figure with a row for each strip of frames and for the ``truth``.

        Each row shows some of the frames and, on the right, one line of the plane in all frames, time downwards.
        """
        shown = np.unique(np.linspace(0, self.frames - 1, SHOWN_FRAMES).round().astype(int))
        rows, columns = len(strips) + 1, len(shown) + 1
        figure = plot.figure(title, caption, 2.0 * columns, 1.6 * rows)
        cells = figure.add_gridspec(rows, columns)
        shape = (self.frames, POINTS, POINTS, truth.shape[-1])
        line = int(np.argmax(self.aligned(truth).reshape(shape)[-1].var(axis=1).sum(axis=-1)))  # with the most detail
        for i, (name, images) in enumerate({**strips, "truth": truth}.items()):
            points = self.aligned(images)
            for k, frame in enumerate(shown):
                label = f"{name}\nflicker {flicker(points):.1e}" if k == 0 else ""
                plot.image_panel(
                    figure.add_subplot(cells[i, k]), images[frame], "" if i else f"frame {frame + 1}", label
                )
            axes = figure.add_subplot(cells[i, columns - 1])
            plot.image_panel(axes, points.reshape(shape)[:, line], "" if i else "a line, frames downwards")
            axes.set_aspect("auto")
        return figure


def flicker(points: np.ndarray) -> float:
    """Return the variance over frames of aligned ``points``, ``(frames, n, channels)``, averaged over the rest."""
    return float(np.var(points, axis=0, dtype=np.float64).mean())


def bilinear(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the values of an image, ``(height, width, channels)``, at ``places`` in pixels, ``(n, 2)``; clamped."""
    height, width = image.shape[:2]
    position = places - 0.5
    lower = np.floor(position).astype(int)
    a, b = (position - lower).T[..., None]
    x0, x1 = (np.clip(lower[:, 0] + i, 0, width - 1) for i in (0, 1))
    y0, y1 = (np.clip(lower[:, 1] + i, 0, height - 1) for i in (0, 1))
    upper, under = (image[y, x0] * (1 - a) + image[y, x1] * a for y in (y0, y1))
    return upper * (1 - b) + under * b
