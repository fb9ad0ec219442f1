"""Several pictures on one sheet: images, maps with a colour bar and lines of text, in a grid."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence

import numpy as np

from .. import srgb
from . import plot

#: What draws one cell: a function of a Matplotlib figure and of the axes of the cell.
Cell = Callable[[object, object], None]


def picture(title: str, image: np.ndarray) -> Cell:
    """A linear image, ``(height, width, 3)`` or ``(height, width, 1)``, as displayed."""

    def draw(sheet, axes):
        axes.imshow(srgb.for_display(np.repeat(image, 3, -1) if image.shape[-1] == 1 else image))
        axes.set_title(title)

    return draw


def colour_map(title: str, values: np.ndarray, extend: str = "neither", **options) -> Cell:
    """Values, ``(height, width)``, with a colour bar; ``options`` are those of Matplotlib's ``imshow``."""

    def draw(sheet, axes):
        shown = axes.imshow(values, **options)
        axes.set_title(title)
        sheet.colorbar(shown, ax=axes, extend=extend, shrink=0.9)

    return draw


def error_map(error: np.ndarray) -> Cell:
    """Draw an absolute difference ``(height, width)``, the mean of the channels, up to its 99.5% quantile."""
    top = max(float(np.quantile(error, 0.995)), 1e-6)
    title = "absolute difference, mean of the channels (linear)"
    return colour_map(title, error, "max", cmap="magma", vmin=0, vmax=top)


def text(lines: Sequence[str]) -> Cell:
    """Lines of text."""

    def draw(sheet, axes):
        axes.text(0.02, 0.95, "\n".join(lines), va="top", family="monospace", fontsize=12, transform=axes.transAxes)

    return draw


def write(path: str | os.PathLike, cells: Sequence[Cell], columns: int, shape: Sequence[int]) -> None:
    """
    Draw ``cells`` row by row, seven inches wide each, ``shape`` (height, width, …) being that of the pictures, and
    write ``path`` (``.png``). Raises :class:`~mi_diffind.files.OutputError`.
    """
    from matplotlib.figure import Figure

    rows = -(-len(cells) // columns)
    size = (7 * columns, rows * (7 * shape[0] / shape[1] + 0.35))
    sheet = Figure(figsize=size, dpi=110, layout="constrained")
    grid = list(sheet.subplots(rows, columns, squeeze=False).flat)
    for axes in grid:
        axes.set_axis_off()
    for cell, axes in zip(cells, grid, strict=False):
        cell(sheet, axes)
    plot.save(sheet, path)
