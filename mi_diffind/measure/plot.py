"""Printable plots of measurements: panels of accuracy against time or bytes, with labels, Pareto front and caption.

Also training curves, and the parts of other plots: figures with a caption, logarithmic ticks, placement of labels.
"""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.files import replacing

#: Colour and marker of each representation, in order of appearance; markers differ for prints without colour.
STYLES = (
    ("#b2182b", "o"), ("#2166ac", "s"), ("#c47a00", "D"), ("#1b7837", "^"), ("#762a83", "v"), ("#4d4d4d", "P"),
    ("#12908e", "X"),
)  # fmt: skip

#: Distances from an anchor to the nearest edge of its label that are tried, in points (1/72 inch).
RADII = (6, 9, 12, 18, 26, 36, 48, 62, 80)

#: Distance in points from which on a thin line leads from an anchor to its label.
_LEADER = 12

#: Places of a label around its anchor, in sixteenths of a turn from the best angle.
_TURNS = (0, -1, 1, -2, 2, -3, 3, -4, 4, -5, 5, -6, 6, -7, 7, -8)


@dataclass(frozen=True)
class Point:
    """Point of a panel: time (median and quartiles) and accuracy of a candidate, and whether it is on the front."""

    name: str
    time: float
    q1: float
    q3: float
    accuracy: float
    representation: str
    on_front: bool


@dataclass(frozen=True)
class Line:
    """Vertical line of a panel: the time of the truth, or of a reference."""

    name: str
    time: float
    is_truth: bool


@dataclass(frozen=True)
class Panel:
    """Panel of a plot: accuracy against time or bytes."""

    title: str
    x_label: str
    points: Sequence[Point]
    lines: Sequence[Line]


@dataclass(frozen=True)
class Label:
    """Text near ``at`` (data coordinates), best at an ``angle`` from the right; ``radii`` are in points."""

    text: str
    at: tuple[float, float]
    colour: str
    weight: str = "normal"
    radii: Sequence[float] = RADII
    angle: float = 0.0


def figure(title: str, caption: str, width: float, height: float, above: float = 0.3, dpi: int = 200):
    """Return a Matplotlib figure with ``width`` × ``height`` inches for axes, a title above and a caption below.

    The title takes ``above`` inches. The layout is constrained until :func:`fix_layout`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    text = "\n".join(textwrap.wrap(caption, int(17.3 * width)))
    below = 0.16 * (text.count("\n") + 1) + 0.15
    framed = Figure(figsize=(width, height + above + below), dpi=dpi, layout="constrained")
    FigureCanvasAgg(framed)
    whole = framed.get_figheight()
    framed.get_layout_engine().set(rect=(0, below / whole, 1, 1 - (above + below) / whole), w_pad=0.08, h_pad=0.08)
    framed.text(0.5, 1 - 0.08 / whole, title, fontsize=12, fontweight="bold", ha="center", va="top")
    framed.text(0.012, 0.06 / whole, text, fontsize=7.5, va="bottom", ha="left", color="0.25")
    return framed


def fix_layout(figure) -> None:
    """Fix the layout, before labels are placed in it."""
    figure.draw_without_rendering()
    figure.set_layout_engine("none")


def save(figure, path: str | os.PathLike) -> None:
    """Write a figure to ``path`` (``.png``). Raises :class:`.OutputError`."""
    with replacing(path) as temporary:
        figure.savefig(temporary, format=Path(path).suffix[1:])


def log_ticks(axis, low: float, high: float, shown: Callable[[float], str]) -> None:
    """Set ticks of a logarithmic axis from ``low`` to ``high``, written by ``shown``, finer for shorter ranges."""
    decades = math.log10(high / low)
    fine: Sequence[float] = (1, *np.arange(1.2, 9.8, 0.4))
    for limit, ticks in ((0.6, (1, 1.5, 2, 3, 4, 5, 7)), (1.1, (1, 2, 5)), (2.5, (1, 3)), (4, (1,))):
        fine = ticks if decades > limit else fine
    axis.set_ticks([m * 10.0**e for e in range(-12, 12) for m in fine if low <= m * 10.0**e <= high])
    axis.set_major_formatter(lambda value, _: shown(value))
    axis.minorticks_off()


def image_panel(axes, image: np.ndarray, title: str = "", label: str = "") -> None:
    """Draw an image of displayed values in [0, 1], without ticks, with a title above and a label on the left."""
    axes.imshow(image.clip(0, 1), vmin=0, vmax=1, interpolation="nearest")
    axes.set_title(title, fontsize=8)
    axes.set_ylabel(label, fontsize=7.5)
    axes.set_xticks([])
    axes.set_yticks([])


def crop_to(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the smallest rectangle that holds a ``mask``, all of them if it is empty."""
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)) if len(rows) else (slice(None),) * 2


def plain(value: float) -> str:
    """Return the text of a number at a tick."""
    return f"{value:,.0f}" if value >= 1000 else f"{value:g}"


def draw_panels(title: str, panels: Sequence[Panel], y_label: str, caption: str):
    """Return a Matplotlib figure with up to two panels a row; time or bytes are on a logarithmic axis.

    If there are several representations, a legend names them.
    """
    from matplotlib.lines import Line2D

    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    styles: dict[str, tuple[str, str]] = {}
    for point in (x for panel in panels for x in panel.points):
        styles.setdefault(point.representation, STYLES[len(styles) % len(STYLES)])
    plot = figure(title, caption, 6.4 * columns, 4.6 * rows, 0.55 if len(styles) > 1 else 0.3)
    if len(styles) > 1:
        shown = [
            Line2D([], [], color=colour, marker=marker, linestyle="none", markersize=6.5, label=name)
            for name, (colour, marker) in styles.items()
        ]
        legend = plot.legend(handles=shown, loc="upper center", fontsize=8.5, frameon=False, ncols=len(shown),
                              bbox_to_anchor=(0.5, 1 - 0.24 / plot.get_figheight()))  # fmt: skip
        legend.set_in_layout(False)
    accuracies = [x.accuracy for p in panels for x in p.points]
    for k, panel in enumerate(panels):
        axes = plot.add_subplot(rows, columns, k + 1)
        _draw(axes, panel, styles, accuracies)
        axes.set_title(panel.title, fontsize=10)
        axes.set_xlabel(panel.x_label, fontsize=9)
        axes.set_ylabel(y_label, fontsize=9)
    fix_layout(plot)
    for axes, panel in zip(plot.axes, panels, strict=True):
        _label(axes, panel, styles)
    return plot


def _draw(axes, panel: Panel, styles: dict, accuracies: list) -> None:
    """Draw a panel without its labels."""
    axes.set_xscale("log")
    times = [x.time for x in (*panel.points, *panel.lines)] or [1.0]
    room = (max(times) / min(times)) ** 0.12 * 1.25  # for labels beside points
    low, high = min(times) / room, max(times) * room
    axes.set_xlim(low, high)
    bottom, top = (min(accuracies), max(accuracies)) if accuracies else (0, 100)
    margin = max(0.08 * (top - bottom), 2)
    axes.set_ylim(bottom - 1.2 * margin, top + 2.2 * margin)
    log_ticks(axes.xaxis, low, high, plain)
    axes.tick_params(labelsize=8)
    axes.grid(which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    front = sorted((p for p in panel.points if p.on_front), key=lambda p: p.time)
    if front:
        xs, ys = [front[0].time], [axes.get_ylim()[0]]
        for p, following in zip(front, [*front[1:], None], strict=False):
            xs += [p.time, axes.get_xlim()[1] if following is None else following.time]
            ys += [p.accuracy, p.accuracy]
        axes.plot(xs, ys, color="0.35", linewidth=1.0, zorder=2)
        axes.annotate("Pareto front", (1, front[-1].accuracy), (-4, -3), xycoords=axes.get_yaxis_transform(),
                      textcoords="offset points", fontsize=7, color="0.35", ha="right", va="top")  # fmt: skip
        axes.fill_between(xs, ys, axes.get_ylim()[0], color="0.5", alpha=0.05, linewidth=0, zorder=1)
    for line in panel.lines:
        axes.axvline(line.time, color="0.1" if line.is_truth else "0.55", linewidth=1.0,
                     linestyle=(0, (5, 2)) if line.is_truth else (0, (1, 1.5)), zorder=2)  # fmt: skip
    for p in panel.points:
        colour, marker = styles[p.representation]
        error = [[max(p.time - max(p.q1, 1e-6), 0)], [max(p.q3 - p.time, 0)]]
        axes.errorbar(p.time, p.accuracy, xerr=error, fmt=marker, color=colour, ecolor=colour, elinewidth=0.9,
                      markersize=6.5, markerfacecolor=colour if p.on_front else "white", markeredgewidth=1.3,
                      capsize=2, zorder=3)  # fmt: skip


def _label(axes, panel: Panel, styles: dict) -> None:
    """Label lines at the top, then points, those on the front first."""
    labels = []
    at_top = (axes.bbox.x0, axes.bbox.y1 - 9 * axes.figure.dpi / 72)
    height = axes.transData.inverted().transform(at_top)[1]
    for line in panel.lines:
        colour = "0.1" if line.is_truth else "0.4"
        if line.is_truth:
            axes.plot([line.time], [1.0], marker="*", color=colour, markersize=9, clip_on=False, zorder=4,
                      transform=axes.get_xaxis_transform())  # fmt: skip
        text = f"{line.name} (exact)" if line.is_truth else line.name
        labels.append(Label(text, (line.time, height), colour, radii=(4, 8, 12, 20, 30, 40, 52)))
    for p in sorted(panel.points, key=lambda p: (not p.on_front, -p.accuracy, p.time)):
        weight = "bold" if p.on_front else "normal"
        labels.append(Label(p.name, (p.time, p.accuracy), styles[p.representation][0], weight))
    spans = [((max(p.q1, 1e-6), p.accuracy), (p.q3, p.accuracy)) for p in panel.points]
    place_labels(axes, labels, [(p.time, p.accuracy) for p in panel.points], spans)


def place_labels(
    axes,
    labels: Iterable[Label],
    points: Sequence[tuple[float, float]],
    spans: Sequence[tuple[tuple[float, float], tuple[float, float]]] = (),
) -> None:
    """Write each label near its anchor where it covers no other text, in the given order.

    Labels also avoid ``points`` and ``spans`` (pairs of ends), both in data coordinates, and if possible the lines of
    ``axes``. A thin line leads from an anchor to a label that is away. The layout must be fixed (:func:`fix_layout`).
    Each label takes the best of a fixed set of places: packages that move labels by forces stop after a time, so their
    pictures would depend on the speed of the machine.
    """
    renderer, scale = axes.figure.canvas.get_renderer(), axes.figure.dpi / 72
    inside = axes.get_window_extent(renderer).extents[None]
    pixels = axes.transData.transform
    # Boxes in pixels, as rows of left, bottom, right, top
    texts = [*axes.texts, *([axes.get_legend()] if axes.get_legend() else [])]
    hard = [text.get_window_extent(renderer).extents for text in texts]
    hard += [np.tile(pixels(p), 2) + 5 * scale * _OUT for p in points]
    hard += [np.concatenate([pixels(a), pixels(b)]) + 2 * _OUT for a, b in spans]
    soft = _boxes([box for line in axes.lines for box in _chain(line, scale)])
    hard, placed = _boxes(hard), _boxes([])
    for label in labels:
        note = axes.annotate(label.text, label.at, xytext=(0, 0), textcoords="offset points", fontsize=8, ha="center",
                             va="center", color=label.colour, fontweight=label.weight, zorder=5,
                             bbox={"boxstyle": "square,pad=0.1", "fc": "w", "ec": "none", "alpha": 0.8})  # fmt: skip
        extent = note.get_window_extent(renderer)
        size = np.array([extent.width + 3 * scale, extent.height + 1.5 * scale])
        start = pixels(label.at)
        others = np.reshape([pixels(p) for p in points if tuple(p) != tuple(label.at)], (-1, 2))
        radius, turn = (v.ravel() for v in np.meshgrid(label.radii, _TURNS, indexing="ij"))
        angle = label.angle + 2 * math.pi * turn / len(_TURNS)
        offset = (radius[:, None] * scale + size / 2) * np.column_stack([np.cos(angle), np.sin(angle)])
        box = np.hstack([start + offset - size / 2, start + offset + size / 2])
        cost = 50 * (size.prod() - _overlap(box, inside)) + (radius + np.abs(turn) / 4) * scale
        cost += 30 * (_overlap(box, hard) + _overlap(box, placed)) + 20 * _overlap(box, soft)
        # A label is nearest to its own point, and nothing crosses the line that leads to it
        end = np.clip(start, box[:, :2], box[:, 2:])
        to_others = others - np.clip(others, box[:, None, :2], box[:, None, 2:])
        nearer = np.hypot(*(start - end).T)[:, None] + 4 * scale - np.hypot(*np.moveaxis(to_others, -1, 0))
        cost += 30 * np.maximum(nearer, 0).sum(axis=1) / scale
        way = (start + np.linspace(0, 1, 21)[:, None, None] * (end - start))[:, :, None]
        across = ((way >= placed[:, :2]) & (way <= placed[:, 2:])).all(axis=-1).any(axis=0).sum(axis=1)
        touched = (np.hypot(*np.moveaxis(way - others, -1, 0)) < 6 * scale).any(axis=0).sum(axis=1)
        best = np.argmin(cost + 300 * (radius > _LEADER) * (across + touched))
        radius, offset, box, end = radius[best], offset[best], box[best], end[best]
        note.set_position(offset / scale)
        if radius > _LEADER:
            ends = axes.transData.inverted().transform([start, end])
            axes.plot(*ends.T, color=label.colour, linewidth=0.5, zorder=2.5)
        placed = np.vstack([placed, box])


_OUT = np.array([-1, -1, 1, 1])


def _boxes(rows: list) -> np.ndarray:
    return np.reshape(np.array(rows, dtype=float), (-1, 4))


def _chain(line, scale: float):
    """Yield small boxes along a line."""
    pixels = line.get_transform().transform(np.column_stack([np.asarray(v, dtype=float) for v in line.get_data()]))
    for a, b in zip(pixels, [*pixels[1:], pixels[-1]], strict=True):
        if np.isfinite([*a, *b]).all():
            for t in np.linspace(0, 1, 1 + max(1, min(400, math.ceil(math.dist(a, b) / (3 * scale))))):
                yield np.tile(a + t * (b - a), 2) + scale * _OUT


def _overlap(boxes: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return for each box the sum of the areas that it shares with the others."""
    sides = np.minimum(boxes[:, None, 2:], others[:, 2:]) - np.maximum(boxes[:, None, :2], others[:, :2])
    return np.maximum(sides, 0).prod(axis=-1).sum(axis=1)


def draw_training_curves(title: str, records: dict[str, dict], caption: str):
    """Draw PSNR over steps of trainings (records of :class:`.training.ConvergenceTraining`).

    Each training has a panel, each of its runs a line, from the shortest (light) to the longest (dark). A training
    that has not converged is marked in red.
    """
    columns = min(5, len(records))
    rows = -(-len(records) // columns)
    about = "PSNR in dB over training steps; each line is a separate run, twice as long as the previous one."
    plot = figure(title, f"{about} {caption}", 2.6 * columns, 1.9 * rows, 0.4, 160)
    for k, (name, record) in enumerate(records.items()):
        axes = plot.add_subplot(rows, columns, k + 1)
        runs = record["runs"]
        for i, run in enumerate(runs):
            shade = str(0.75 * (1 - (i + 1) / len(runs)))
            axes.plot(run["curve_steps"], run["curve_psnr_db"], color=shade, linewidth=1.1)
        gain = "" if record["gain_db"] is None else f", last doubling {record['gain_db']:+.1f} dB"
        state = "converged" if record["converged"] else "NOT converged"
        axes.set_title(f"{name}: {record['psnr_db']:.1f} dB\n{state}{gain}", fontsize=7.5,
                       color="0.1" if record["converged"] else "#b2182b")  # fmt: skip
        axes.set_xscale("log")
        log_ticks(axes.xaxis, *(end(step for run in runs for step in run["curve_steps"]) for end in (min, max)), plain)
        top = max(v for run in runs for v in run["curve_psnr_db"])
        axes.set_ylim(top - 20, top + 2)
        axes.tick_params(labelsize=6.5)
        axes.grid(color="0.92", linewidth=0.5)
    return plot
