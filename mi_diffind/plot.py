"""A picture of accuracy against time that can be printed: panels with labelled points, the Pareto front, a caption."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .files import replacing

#: Colour and marker of each representation, in the order in which they appear: told apart also without colour.
STYLES = (
    ("#b2182b", "o"),
    ("#2166ac", "s"),
    ("#c47a00", "D"),
    ("#1b7837", "^"),
    ("#762a83", "v"),
    ("#4d4d4d", "P"),
    ("#12908e", "X"),
)


@dataclass(frozen=True)
class Point:
    """A candidate: its time (median and quartiles), its accuracy, and whether it is on the Pareto front."""

    name: str
    time: float
    q1: float
    q3: float
    accuracy: float
    representation: str
    on_front: bool


@dataclass(frozen=True)
class Line:
    """Something without an error to show: the time of the truth itself, or of a reference."""

    name: str
    time: float
    is_truth: bool


@dataclass(frozen=True)
class Panel:
    title: str
    x_label: str
    points: Sequence[Point]
    lines: Sequence[Line]


def write(path: str | os.PathLike, title: str, panels: Sequence[Panel], y_label: str, caption: str) -> None:
    """:func:`draw` and write ``path`` (``.png``). Raises :class:`~mi_diffind.files.OutputError`."""
    sheet = draw(title, panels, y_label, caption)
    with replacing(path) as temporary:
        sheet.savefig(temporary, format=Path(path).suffix[1:])


def draw(title: str, panels: Sequence[Panel], y_label: str, caption: str):
    """
    A Matplotlib figure with up to two panels a row, and with time or bytes on a logarithmic axis (accuracies in dB are
    logarithms already). If there are several representations, a legend names them.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    width = 6.4 * columns
    text = "\n".join(textwrap.wrap(caption, int(18 * width)))
    below = 0.17 * (text.count("\n") + 1) + 0.15
    styles = {}
    for panel in panels:
        for point in panel.points:
            styles.setdefault(point.representation, STYLES[len(styles) % len(STYLES)])
    above = 0.55 if len(styles) > 1 else 0.3
    sheet = Figure(figsize=(width, 4.6 * rows + above + below), dpi=200, layout="constrained")
    canvas = FigureCanvasAgg(sheet)
    height = sheet.get_figheight()
    sheet.get_layout_engine().set(rect=(0, below / height, 1, 1 - (above + below) / height), w_pad=0.08, h_pad=0.08)
    sheet.text(0.5, 1 - 0.08 / height, title, fontsize=12, fontweight="bold", ha="center", va="top")
    sheet.text(0.012, 0.06 / height, text, fontsize=7.5, va="bottom", ha="left", color="0.25")
    if len(styles) > 1:
        from matplotlib.lines import Line2D

        shown = [
            Line2D([], [], color=colour, marker=marker, linestyle="none", markersize=6.5, label=name)
            for name, (colour, marker) in styles.items()
        ]
        legend = sheet.legend(handles=shown, loc="upper center", bbox_to_anchor=(0.5, 1 - 0.24 / height),
                              ncols=len(shown), fontsize=8.5, frameon=False)  # fmt: skip
        legend.set_in_layout(False)
    accuracies = [x.accuracy for p in panels for x in p.points]
    drawn = []
    for k, panel in enumerate(panels):
        axes = sheet.add_subplot(rows, columns, k + 1)
        drawn.append((axes, panel, _draw(axes, panel, styles, accuracies)))
        axes.set_title(panel.title, fontsize=10)
        axes.set_xlabel(panel.x_label, fontsize=9)
        axes.set_ylabel(y_label, fontsize=9)
    sheet.draw_without_rendering()  # fixes the layout, in which labels are placed
    sheet.set_layout_engine("none")
    for axes, panel, obstacles in drawn:
        _label(canvas.get_renderer(), axes, panel, styles, obstacles)
    return sheet


def write_courses(path: str | os.PathLike, title: str, trainings: dict[str, dict], caption: str) -> None:
    """
    The courses of trainings (records of :class:`~mi_diffind.convergence.Training`): PSNR over steps, one panel each,
    every run a line, from the shortest (light) to the longest (dark); what has not converged is marked.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(5, len(trainings))
    rows = -(-len(trainings) // columns)
    width = 2.6 * columns
    about = "PSNR in dB over training steps; each line is a run of its own, twice as long as that before."
    text = "\n".join(textwrap.wrap(f"{about} {caption}", int(19 * width)))
    below = 0.17 * (text.count("\n") + 1) + 0.15
    sheet = Figure(figsize=(width, 1.9 * rows + 0.4 + below), dpi=160, layout="constrained")
    FigureCanvasAgg(sheet)
    height = sheet.get_figheight()
    sheet.get_layout_engine().set(rect=(0, below / height, 1, 1 - below / height))
    sheet.suptitle(title, fontsize=12, fontweight="bold")
    sheet.text(0.012, 0.06 / height, text, fontsize=7.5, va="bottom", ha="left", color="0.25")
    for k, (name, record) in enumerate(trainings.items()):
        axes = sheet.add_subplot(rows, columns, k + 1)
        runs = record["runs"]
        for i, run in enumerate(runs):
            shade = str(0.75 * (1 - (i + 1) / len(runs)))
            axes.plot(run["curve_steps"], run["curve_psnr_db"], color=shade, linewidth=1.1)
        gain = "" if record["gain_db"] is None else f", last doubling {record['gain_db']:+.1f} dB"
        state = "converged" if record["converged"] else "NOT converged"
        axes.set_title(f"{name}: {record['psnr_db']:.1f} dB\n{state}{gain}", fontsize=7.5,
                       color="0.1" if record["converged"] else "#b2182b")  # fmt: skip
        axes.set_xscale("log")
        top = max(v for run in runs for v in run["curve_psnr_db"])
        axes.set_ylim(top - 20, top + 2)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_minor_formatter(lambda value, _: "")
        axes.tick_params(labelsize=6.5)
        axes.grid(color="0.92", linewidth=0.5)
    with replacing(path) as temporary:
        sheet.savefig(temporary, format=Path(path).suffix[1:])


def _draw(axes, panel: Panel, styles: dict, accuracies: list):
    """All but the labels; returns the points on the front by time."""
    axes.set_xscale("log")
    times = [x.time for x in (*panel.points, *panel.lines)] or [1.0]
    room = (max(times) / min(times)) ** 0.12 * 1.25  # for labels beside points
    low, high = min(times) / room, max(times) * room
    axes.set_xlim(low, high)
    bottom, top = (min(accuracies), max(accuracies)) if accuracies else (0, 100)
    margin = max(0.08 * (top - bottom), 2)
    axes.set_ylim(bottom - 1.2 * margin, top + 2.2 * margin)
    decades = math.log10(high / low)
    fine = (1, *np.arange(1.2, 9.8, 0.4))
    for limit, ticks in ((0.6, (1, 1.5, 2, 3, 4, 5, 7)), (1.1, (1, 2, 5)), (3, (1,))):
        fine = ticks if decades > limit else fine
    ticks = [m * 10.0**e for e in range(-4, 7) for m in fine]
    axes.set_xticks([t for t in ticks if low <= t <= high])
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}" if value >= 1000 else f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda value, _: "")
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
    return front


def _label(renderer, axes, panel: Panel, styles: dict, front) -> None:
    """Place each label where it covers neither another one nor a point nor a line; a thin line leads to it."""
    from matplotlib.transforms import Bbox

    inside = axes.get_window_extent(renderer)
    scale = renderer.dpi / 72

    def pixel(x, y):
        return axes.transData.transform((x, y))

    taken, markers = [], {}
    for p in panel.points:
        x, y = pixel(p.time, p.accuracy)
        markers[p.time, p.accuracy] = (x, y)
        left, right = pixel(max(p.q1, 1e-6), p.accuracy)[0], pixel(p.q3, p.accuracy)[0]
        r = 5 * scale
        taken += [Bbox([[x - r, y - r], [x + r, y + r]]), Bbox([[left, y - 2], [right, y + 2]])]
    soft = []  # lines: better not covered
    for line in panel.lines:
        x = pixel(line.time, axes.get_ylim()[0])[0]
        soft.append(Bbox([[x - 1, inside.y0], [x + 1, inside.y1]]))
    for p, following in zip(front, [*front[1:], None], strict=False):
        x, y = pixel(p.time, p.accuracy)
        end = inside.x1 if following is None else pixel(following.time, p.accuracy)[0]
        soft.append(Bbox([[x, y - 1], [end, y + 1]]))
    if front:
        x, y = pixel(front[0].time, front[0].accuracy)
        soft.append(Bbox([[x - 1, inside.y0], [x + 1, y]]))
        y = pixel(front[-1].time, front[-1].accuracy)[1]  # the words "Pareto front"
        taken.append(Bbox([[inside.x1 - 54 * scale, y - 13 * scale], [inside.x1, y]]))

    def overlap(a: Bbox, b: Bbox) -> float:
        return max(0.0, min(a.x1, b.x1) - max(a.x0, b.x0)) * max(0.0, min(a.y1, b.y1) - max(a.y0, b.y0))

    def place(text: str, anchor, colour, radii, weight="normal"):
        note = axes.annotate(text, anchor, xytext=(0, 0), textcoords="offset points", fontsize=8, color=colour,
                             ha="center", va="center", fontweight=weight, zorder=5,
                             bbox={"boxstyle": "square,pad=0.1", "fc": "w", "ec": "none", "alpha": 0.8})  # fmt: skip
        box = note.get_window_extent(renderer)
        w, h = box.width + 3 * scale, box.height + 1.5 * scale
        ax, ay = axes.transData.transform(anchor)
        best = None
        for radius in radii:
            for k in range(16):
                angle = 2 * math.pi * ((k + 1) // 2 * (-1) ** k) / 16
                # From the anchor to the nearest edge of the label it is `radius`
                dx = (radius * scale + w / 2) * math.cos(angle)
                dy = (radius * scale + h / 2) * math.sin(angle)
                at = Bbox([[ax + dx - w / 2, ay + dy - h / 2], [ax + dx + w / 2, ay + dy + h / 2]])
                outside = w * h - overlap(at, inside)
                cost = 50 * outside + 30 * sum(overlap(at, t) for t in taken) + 20 * sum(overlap(at, s) for s in soft)
                # Whose label it is has to be plain: no other point nearer, nothing across the line that leads to it
                ex, ey = _edge(ax, ay, at)
                own = math.hypot(ex - ax, ey - ay)
                others = [v for key, v in markers.items() if key != anchor]
                nearer = [max(own + 4 * scale - math.dist(_edge(*v, at), v), 0) for v in others]
                cost += 30 * sum(nearer) / scale + radius * scale
                if radius > 12:
                    line = [(ax + (ex - ax) * i / 20, ay + (ey - ay) * i / 20) for i in range(21)]
                    cost += 300 * sum(any(t.contains(*v) for v in line) for t in labels)
                    cost += 300 * sum(any(math.dist(o, v) < 6 * scale for v in line) for o in others)
                if best is None or cost < best[0]:
                    best = (cost, dx, dy, at, radius)
        _, dx, dy, at, radius = best
        note.set_position((dx / scale, dy / scale))
        if radius > 12:  # away from its point: a line leads there
            ends = [axes.transData.inverted().transform(v) for v in ((ax, ay), _edge(ax, ay, at))]
            axes.plot(*zip(*ends, strict=True), color=colour, linewidth=0.5, zorder=2.5)
        taken.append(at)
        labels.append(at)

    labels: list = []
    for line in panel.lines:
        y = axes.transData.inverted().transform((0, inside.y1 - 9 * scale))[1]
        colour = "0.1" if line.is_truth else "0.4"
        if line.is_truth:
            axes.plot([line.time], [1.0], marker="*", color=colour, markersize=9, clip_on=False, zorder=4,
                      transform=axes.get_xaxis_transform())  # fmt: skip
        text = f"{line.name} (exact)" if line.is_truth else line.name
        place(text, (line.time, y), colour, (4, 8, 12, 20, 30))
    crowded = sorted(panel.points, key=lambda p: (not p.on_front, -p.accuracy, p.time))
    for p in crowded:
        place(p.name, (p.time, p.accuracy), styles[p.representation][0], (6, 9, 12, 18, 26, 36, 48, 62, 80),
              "bold" if p.on_front else "normal")  # fmt: skip


def _edge(x: float, y: float, box) -> tuple[float, float]:
    """The point of a box nearest to (x, y)."""
    return min(max(x, box.x0), box.x1), min(max(y, box.y0), box.y1)
