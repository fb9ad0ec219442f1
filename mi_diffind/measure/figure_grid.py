"""Grid of pictures in one figure: images, maps with a colour bar and lines of text."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

import numpy as np

from ..images import srgb
from . import plot

#: Function that draws one cell, of a Matplotlib figure and of the cell's axes.
Cell = Callable[[object, object], None]


def picture(title: str, image: np.ndarray, frame: tuple[int, int, int, int] | None = None) -> Cell:
    """Return a cell with a linear image, ``(height, width, 3)`` or ``(height, width, 1)``, as displayed.

    ``frame``: ``x, y, width, height`` of a window to mark, in pixels.
    """

    def draw(figure, axes):
        if frame is not None:
            x, y, width, height = frame
            left, right, top, bottom = x - 0.5, x + width - 0.5, y - 0.5, y + height - 0.5
            axes.plot([left, right, right, left, left], [top, top, bottom, bottom, top], color="yellow", linewidth=1.5)
        axes.imshow(srgb.for_display(np.repeat(image, 3, -1) if image.shape[-1] == 1 else image))
        axes.set_title(title)

    return draw


def colour_map(title: str, values: np.ndarray, extend: str = "neither", **options) -> Cell:
    """Return a cell with values, ``(height, width)``, and a colour bar; ``options`` are those of ``imshow``."""

    def draw(figure, axes):
        shown = axes.imshow(values, **options)
        axes.set_title(title)
        figure.colorbar(shown, ax=axes, extend=extend, shrink=0.9)

    return draw


def error_map(error: np.ndarray, title: str = "absolute difference, mean of the channels (linear)") -> Cell:
    """Draw an absolute difference ``(height, width)``, the mean of the channels, up to its 99.5% quantile."""
    top = max(float(np.quantile(error, 0.995)), 1e-6)
    return colour_map(title, error, "max", cmap="magma", vmin=0, vmax=top)


def text(lines: Sequence[str]) -> Cell:
    """Return a cell with lines of text."""

    def draw(figure, axes):
        options = {"va": "top", "family": "monospace", "fontsize": 12, "transform": axes.transAxes}
        axes.text(0.02, 0.95, "\n".join(lines), **options).set_in_layout(False)  # long lines move no picture

    return draw


def write(path: str | os.PathLike, cells: Sequence[Cell], columns: int, shape: Sequence[int]) -> None:
    """Draw ``cells`` row by row, each seven inches wide, and write ``path`` (``.png``).

    ``shape`` is that of the pictures, (height, width, …). Raises :class:`.OutputError`.
    """
    from matplotlib.figure import Figure

    rows = -(-len(cells) // columns)
    size = (7 * columns, rows * (7 * shape[0] / shape[1] + 0.35))
    figure = Figure(figsize=size, dpi=110, layout="constrained")
    grid = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axes in grid:
        axes.set_axis_off()
    for cell, axes in zip(cells, grid, strict=False):
        cell(figure, axes)
    plot.save(figure, path)
