"""Printable plots of measurements: panels of accuracy against time or bytes, curves, and grids of pictures.

All figures have a title, a constrained layout and a caption.
"""

import math
import os
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..core.files import replacing
from ..images import srgb

#: Colour and marker of each representation, in order of appearance; markers differ for prints without colour.
STYLES = (
    ("#b2182b", "o"), ("#2166ac", "s"), ("#c47a00", "D"), ("#1b7837", "^"), ("#762a83", "v"), ("#4d4d4d", "P"),
    ("#12908e", "X"), ("#8c564b", "*"),
)  # fmt: skip

#: Times or bytes that differ by a smaller factor count as equal on the Pareto front.
SAME = 1.05

#: Distances from an anchor to the nearest edge of its label that are tried, in points (1/72 inch).
LABEL_DISTANCES = (6, 9, 12, 18, 26, 36, 48, 62, 80)

#: Distance in points from which on a thin line leads from an anchor to its label.
LEADER_DISTANCE = 12

#: Places of a label around its anchor that are tried at each distance.
LABEL_DIRECTIONS = 16


@dataclass(frozen=True)
class Point:
    """Point of a panel: time or bytes ``x`` (median and quartiles) and accuracy of a candidate.

    ``competes``: the point may be on the Pareto front.
    """

    name: str
    x: float
    low: float
    high: float
    accuracy: float
    representation: str
    competes: bool = True


@dataclass(frozen=True)
class Panel:
    """Panel of a plot: accuracy against time or bytes.

    ``lines`` are vertical: the name, the time, and whether it is that of the truth or of a reference.
    """

    title: str
    x_label: str
    points: Sequence[Point]
    lines: Sequence[tuple[str, float, bool]]

    def front(self) -> list[Point]:
        """Return the points of the Pareto front, from left to right; ``x`` within :data:`SAME` counts as equal."""
        competing = [p for p in self.points if p.competes]

        def beats(a: Point, b: Point) -> bool:
            better = SAME * a.x < b.x or a.accuracy > b.accuracy
            return better and a.x <= SAME * b.x and a.accuracy >= b.accuracy

        return sorted((p for p in competing if not any(beats(q, p) for q in competing)), key=lambda p: p.x)


@dataclass(frozen=True)
class Curve:
    """Curve of a plot: values ``y`` at ``x``, with ends of error bars or ``None``.

    ``style``: keywords of Matplotlib's ``errorbar``.
    """

    label: str
    x: Sequence[float]
    y: Sequence[float]
    low: Sequence[float] | None = None
    high: Sequence[float] | None = None
    style: Mapping = field(default_factory=dict)


def figure(title: str, caption: str, width: float, height: float, above: float = 0.3):
    """Return a Matplotlib figure with ``width`` × ``height`` inches for axes, a title above and a caption below.

    The title takes ``above`` inches. The layout is constrained.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width = max(width, 0.105 * len(title))  # few small pictures may be narrower than their title
    text = "\n".join(textwrap.wrap(caption, int(17.3 * width)))
    below = 0.16 * (text.count("\n") + 1) + 0.15
    framed = Figure(figsize=(width, height + above + below), dpi=200, layout="constrained")
    FigureCanvasAgg(framed)
    whole = framed.get_figheight()
    framed.get_layout_engine().set(rect=(0, below / whole, 1, 1 - (above + below) / whole), w_pad=0.08, h_pad=0.08)
    framed.text(0.5, 1 - 0.08 / whole, title, fontsize=12, fontweight="bold", ha="center", va="top")
    framed.text(0.012, 0.06 / whole, text, fontsize=7.5, va="bottom", ha="left", color="0.25")
    return framed


def save(figure, path: str | os.PathLike) -> None:
    """Write a figure to ``path`` (``.png``). Raises :class:`.OutputError`."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format=Path(path).suffix[1:])


def log_ticks(axis, low: float, high: float) -> None:
    """Set ticks of a logarithmic axis from ``low`` to ``high``, finer for shorter ranges."""
    decades = math.log10(high / low)
    fine: Sequence[float] = (1, *np.arange(1.2, 9.8, 0.4))
    for limit, ticks in ((0.6, (1, 1.5, 2, 3, 4, 5, 7)), (1.1, (1, 2, 5)), (2.5, (1, 3)), (4, (1,))):
        fine = ticks if decades > limit else fine
    axis.set_ticks([m * 10.0**e for e in range(-12, 12) for m in fine if low <= m * 10.0**e <= high])
    axis.set_major_formatter(lambda value, _: f"{value:,.0f}" if value >= 1000 else f"{value:g}")
    axis.minorticks_off()


def finish(axes, x_label: str, y_label: str) -> None:
    """Label both axes and add a light grid."""
    axes.set_xlabel(x_label, fontsize=8)
    axes.set_ylabel(y_label, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(which="major", color="0.92", linewidth=0.5)
    axes.set_axisbelow(True)


def crop_to(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the smallest rectangle that holds a ``mask``, all of them if it is empty."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)) if len(rows) else (slice(None),) * 2


# -- Accuracy against time or bytes ------------------------------------------------------------------------------------


def draw_panels(title: str, panels: Sequence[Panel], y_label: str, caption: str):
    """Return a Matplotlib figure with up to two panels a row; time or bytes are on a logarithmic axis.

    If there are several representations, a legend names them. Points of the Pareto front are filled.
    """
    from matplotlib.lines import Line2D

    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    names = dict.fromkeys(point.representation for panel in panels for point in panel.points)
    styles = {name: STYLES[i % len(STYLES)] for i, name in enumerate(names)}
    lines = -(-len(styles) // (4 * columns))  # of the legend
    plot = figure(title, caption, 6.4 * columns, 4.6 * rows, 0.33 + 0.22 * lines if len(styles) > 1 else 0.3)
    if len(styles) > 1:
        shown = [
            Line2D([], [], color=colour, marker=marker, linestyle="none", markersize=6.5, label=name)
            for name, (colour, marker) in styles.items()
        ]
        place = {"loc": "upper center", "bbox_to_anchor": (0.5, 1 - 0.24 / plot.get_figheight())}
        place["ncols"] = -(-len(shown) // lines)
        plot.legend(handles=shown, fontsize=8.5, frameon=False, **place).set_in_layout(False)
    accuracies = [x.accuracy for p in panels for x in p.points] or [0, 100]
    margin = max(0.08 * (max(accuracies) - min(accuracies)), 2)
    for k, panel in enumerate(panels):
        axes = plot.add_subplot(rows, columns, k + 1)
        axes.set_ylim(min(accuracies) - 1.2 * margin, max(accuracies) + 2.2 * margin)
        _draw_panel(axes, panel, styles)
        finish(axes, panel.x_label, y_label)
    plot.draw_without_rendering()
    plot.set_layout_engine("none")  # labels are placed in the final layout
    for axes, panel in zip(plot.axes, panels, strict=True):
        top = axes.transData.inverted().transform((axes.bbox.x0, axes.bbox.y1 - 9 * axes.figure.dpi / 72))[1]
        labels = [
            (f"{name}{' (exact)' * is_truth}", (x, top), {"color": "0.1" if is_truth else "0.4"})
            for name, x, is_truth in panel.lines
        ]
        front = panel.front()
        for p in sorted(panel.points, key=lambda p: (p not in front, -p.accuracy, p.x)):
            style = {"color": styles[p.representation][0], "fontweight": "bold" if p in front else "normal"}
            labels.append((p.name, (p.x, p.accuracy), style))
        place_labels(axes, labels, [(p.x, p.accuracy) for p in panel.points])
    return plot


def _draw_panel(axes, panel: Panel, styles: dict) -> None:
    """Draw a panel without its labels."""
    axes.set_title(panel.title, fontsize=10)
    axes.set_xscale("log")
    xs = [*(p.x for p in panel.points), *(x for _, x, _ in panel.lines)]
    room = (max(xs) / min(xs)) ** 0.12 * 1.25  # for labels beside points
    low, high = min(xs) / room, max(xs) * room
    axes.set_xlim(low, high)
    log_ticks(axes.xaxis, low, high)
    front = panel.front()
    if front:
        xs = [front[0].x, *(p.x for p in front), high]
        ys = [axes.get_ylim()[0], *(p.accuracy for p in front), front[-1].accuracy]
        axes.step(xs, ys, where="post", color="0.35", linewidth=1.0, zorder=2)
        axes.fill_between(xs, ys, ys[0], step="post", color="0.5", alpha=0.05, linewidth=0, zorder=1)
        axes.annotate("Pareto front", (1, front[-1].accuracy), (-4, -3), xycoords=axes.get_yaxis_transform(),
                      textcoords="offset points", fontsize=7, color="0.35", ha="right", va="top")  # fmt: skip
    for _, x, is_truth in panel.lines:
        dashes = {"color": "0.1", "linestyle": (0, (5, 2))} if is_truth else {"color": "0.55", "linestyle": ":"}
        axes.axvline(x, linewidth=1.0, zorder=2, **dashes)
    for p in panel.points:
        colour, marker = styles[p.representation]
        error = [[max(p.x - max(p.low, 1e-6), 0)], [max(p.high - p.x, 0)]]
        axes.errorbar(p.x, p.accuracy, xerr=error, fmt=marker, color=colour, elinewidth=0.9, markersize=6.5,
                      markerfacecolor=colour if p in front else "white", markeredgewidth=1.3, capsize=2,
                      zorder=3)  # fmt: skip


def place_labels(
    axes, labels: Sequence[tuple[str, tuple[float, float], dict]], points: Sequence[tuple[float, float]]
) -> None:
    """Write each label near its anchor where it covers no other text and no point, in the given order.

    ``labels`` are texts, anchors and styles; anchors and ``points`` are in data coordinates. A thin line leads from an
    anchor to a label that is away. The layout must be final. Each label takes the best of a fixed set of places:
    packages that move labels by forces stop after a time, so their pictures would depend on the speed of the machine.
    """
    renderer, scale = axes.figure.canvas.get_renderer(), axes.figure.dpi / 72
    inside, pixels = axes.get_window_extent(renderer).extents[None], axes.transData.transform
    turn = 2 * math.pi * np.arange(LABEL_DIRECTIONS) / LABEL_DIRECTIONS
    distance, turn = (v.ravel() for v in np.meshgrid(LABEL_DISTANCES, turn, indexing="ij"))
    # Boxes in pixels, as rows of left, bottom, right, top
    taken = [text.get_window_extent(renderer).extents for text in axes.texts]
    taken += [np.tile(pixels(p), 2) + 5 * scale * np.array([-1, -1, 1, 1]) for p in points]
    for text, anchor, style in labels:
        note = axes.annotate(text, anchor, xytext=(0, 0), textcoords="offset points", fontsize=8, ha="center",
                             va="center", zorder=5, bbox={"boxstyle": "square,pad=0.1", "fc": "w", "ec": "none",
                                                          "alpha": 0.8}, **style)  # fmt: skip
        extent = note.get_window_extent(renderer)
        size = np.array([extent.width + 3 * scale, extent.height + 1.5 * scale])
        offset = (distance[:, None] * scale + size / 2) * np.column_stack([np.cos(turn), np.sin(turn)])
        centre = pixels(anchor) + offset
        boxes = np.hstack([centre - size / 2, centre + size / 2])
        outside = size.prod() - _overlap(boxes, inside)
        cost = 50 * outside + 30 * _overlap(boxes, np.reshape(taken, (-1, 4))) + distance * scale
        best = np.argmin(cost)
        note.set_position(offset[best] / scale)
        if distance[best] > LEADER_DISTANCE:
            end = np.clip(pixels(anchor), boxes[best, :2], boxes[best, 2:])
            ends = axes.transData.inverted().transform([pixels(anchor), end])
            axes.plot(*ends.T, color=style["color"], linewidth=0.5, zorder=2.5)
        taken.append(boxes[best])


def _overlap(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return for each box the sum of the areas that it shares with the others."""
    sides = np.minimum(boxes[:, None, 2:], others[:, 2:]) - np.maximum(boxes[:, None, :2], others[:, :2])
    return np.maximum(sides, 0).prod(axis=-1).sum(axis=1)


# -- Curves ------------------------------------------------------------------------------------------------------------


def draw_curves(
    title: str, caption: str, panels: Mapping[str, Sequence[Curve]], x_label: str, y_label: str,
    ticks: Sequence[str] = (),
):  # fmt: skip
    """Return a Matplotlib figure with a panel of curves for each title, with a legend where labels change.

    There are up to two panels a row. ``ticks`` are labels at 0, 1, 2, …
    """
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    plot, explained = figure(title, caption, 6.0 * columns, 3.6 * rows), []
    for k, (name, curves) in enumerate(panels.items()):
        axes = plot.add_subplot(rows, columns, k + 1)
        for i, curve in enumerate(curves):
            colour, marker = STYLES[i % len(STYLES)]
            bars = None if curve.low is None else np.abs(np.subtract((curve.low, curve.high), curve.y))
            style = {"color": colour, "marker": marker, "markersize": 4, "linewidth": 1.1, "capsize": 2, **curve.style}
            axes.errorbar(curve.x, curve.y, bars, label=curve.label, **style)
        axes.set_title(name, fontsize=9)
        if ticks:
            axes.set_xticks(range(len(ticks)), ticks)
        finish(axes, x_label, y_label)
        labels = [curve.label for curve in curves]
        if len(labels) > 1 and labels != explained:
            axes.legend(fontsize=6.5, ncols=2)
            explained = labels
    return plot


# -- Pictures ----------------------------------------------------------------------------------------------------------


def draw_images(
    title: str, caption: str, rows: Mapping[str, Mapping[str, np.ndarray]], width: float = 2.3, unit: str = ""
):
    """Return a Matplotlib figure with a row of images for each label, each image with its title.

    Images are of displayed values in [0, 1], ``(height, width, 3)``, or errors in a ``unit``, ``(height, width)``,
    which share the range of colours of their row.
    """
    columns, first = max(map(len, rows.values())), next(iter(next(iter(rows.values())).values()))
    plot = figure(title, caption, width * columns, len(rows) * (width * first.shape[0] / first.shape[1] + 0.4))
    for i, (label, images) in enumerate(rows.items()):
        drawn, maps = [], [image for image in images.values() if image.ndim == 2]
        worst = max((float(np.nanquantile(image, 0.98)) for image in maps), default=1.0)
        for k, (name, image) in enumerate(images.items()):
            axes = plot.add_subplot(len(rows), columns, i * columns + k + 1)
            colours = {"vmin": 0, "vmax": worst, "cmap": "inferno_r"} if image.ndim == 2 else {}
            shown = axes.imshow(image if colours else image.clip(0, 1), interpolation="nearest", **colours)
            axes.set_title(name, fontsize=8)
            axes.set_ylabel("" if k else label, fontsize=7.5)
            axes.set(xticks=[], yticks=[])
            drawn += [axes] if colours else []
        if drawn:
            bar = plot.colorbar(shown, cax=drawn[-1].inset_axes([1.04, 0.1, 0.05, 0.8]), extend="max")
            bar.set_label(unit, fontsize=7.5)
            bar.ax.tick_params(labelsize=6.5)
    return plot


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
    save(figure, path)
