"""
Draw the picture of ``cost.md``: error against the time of a render, for each task.

    python docs/make_cost.py [--output docs/cost.jpg]

All figures are those of the rows of ``cost.toml``, which come from JSON in ``docs/measured/``.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
import make_tables
from figures import EXACT

from mi_diffind.core.files import replacing

#: Role → label, colour, marker and size of its point. Shapes differ for prints without colour.
ROLES = {
    "ours": ("ours", "#b2182b", "o", 90),
    "theirs": ("taken instead", "#2166ac", "s", 80),
    "paper": ("the paper's recipe", "#c47a00", "D", 70),
}

#: Pixels of the picture's width; its text is as large as that of the page at this width.
WIDTH = 800

#: Inches of a panel, and panels a row.
PANEL, COLUMNS = (2.67, 2.3), 3


def points(row: dict) -> list[tuple[str, float, float]]:
    """Return ``(role, time, error)`` of the contenders of a row that have both."""
    if isinstance(row.error, str) or isinstance(row.render, str):
        return []
    return [p for p in zip(ROLES, row.render, row.error, strict=True) if None not in p][::-1]


def draw(axes, row: dict) -> None:
    """Draw the panel of a row; better errors are above, exact ones on a line at the top."""
    from matplotlib.ticker import FuncFormatter, NullLocator

    shown = points(row)
    finite = [error for *_, error in shown if error != EXACT]
    low, high = min(finite), max(finite)
    room = max(0.18 * (high - low), 0.02 * high)
    ends = (low - room, high + room)
    exact, better = len(finite) < len(shown), row.measure.endswith("dB")
    if exact:  # above the best finite error, whichever direction the axis has
        ends = (low - room, high + 3 * room) if better else (low - 3 * room, high + room)
    line = high + 2 * room if better else low - 2 * room
    for role, time, error in shown:
        _, colour, marker, size = ROLES[role]
        place = line if error == EXACT else error
        axes.scatter(time, place, s=size, c=colour, marker=marker, zorder=3, edgecolors="black", linewidths=0.6)
    if exact:
        axes.axhline(line, color="0.6", linewidth=0.8, linestyle=":", zorder=1)
        axes.annotate("exact", (1, line), xycoords=("axes fraction", "data"), xytext=(-3, 2),
                      textcoords="offset points", ha="right", va="bottom", fontsize=8, color="0.35")  # fmt: skip
    axes.set_ylim(ends if better else ends[::-1])
    times = [1, *(time for _, time, _ in shown)]
    first, last = min(times) / 1.35, max(times) * 1.35
    axes.set_xscale("log")
    axes.set_xlim(first, last)
    ticks = (0.03, 0.1, 0.3, 1, 3, 10, 30, 100) if last / first > 5 else (0.25, 0.5, 0.75, 1, 1.5, 2, 3, 4)
    axes.set_xticks([t for t in ticks if first < t < last])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.tick_params(labelsize=8.5)
    axes.set_xlabel(f"over {row.instead.split('(')[0].replace('`', '').strip()}", fontsize=8, color=ROLES["theirs"][1])
    axes.grid(color="0.92", zorder=0)
    axes.set_title(row.task.replace("`", ""), fontsize=10.5, fontweight="bold", pad=14)
    axes.text(0.5, 1.02, row.measure, transform=axes.transAxes, ha="center", va="bottom", fontsize=8,
              color="0.3")  # fmt: skip


def picture(rows: list[dict]):
    """Return the Matplotlib figure: a panel for the first row of each task with figures of at least two contenders."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = list({row.task: row for row in reversed(rows) if len(points(row)) > 1}.values())[::-1]
    lines = -(-len(drawn) // COLUMNS)
    figure = Figure((PANEL[0] * COLUMNS, PANEL[1] * lines + 0.75), layout="constrained")
    FigureCanvasAgg(figure)
    height = figure.get_figheight()
    figure.get_layout_engine().set(rect=(0, 0.33 / height, 1, 1 - 0.75 / height))
    grid = figure.subplots(lines, COLUMNS, squeeze=False)
    for axes in grid.flat[len(drawn) :]:
        axes.set_axis_off()
    for axes, row in zip(grid.flat, drawn, strict=False):
        draw(axes, row)
    marks = [
        figure.axes[0].scatter([], [], s=size, c=colour, marker=marker, label=label, edgecolors="black", linewidths=0.6)
        for label, colour, marker, size in ROLES.values()
    ]
    figure.legend(loc="upper center", ncols=4, handles=marks, fontsize=9, frameon=False, handletextpad=0.3)
    label = "time of a render, over that of what a user would take instead (better: up and left)"
    figure.text(0.5, 0.1 / height, label, ha="center", va="bottom", fontsize=9)
    return figure


def main() -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", default=str(Path(__file__).with_name("cost.jpg")))
    arguments = parser.parse_args()
    figure = picture(make_tables.cost_rows())
    with replacing(arguments.output) as temporary:
        figure.savefig(temporary, format="jpg", dpi=2 * WIDTH / figure.get_figwidth(), pil_kwargs={"quality": 88})


if __name__ == "__main__":
    main()
