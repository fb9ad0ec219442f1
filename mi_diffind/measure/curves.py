"""Plots of equal-memory comparisons: an error against bytes, a line for each method, and against time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from . import plot

#: Method → colour, marker and line; markers are white where the line is dotted.
Styles = Mapping[str, tuple[str, str, str]]


def curves(axes, candidates: Iterable[dict], styles: Styles, place: Callable[[dict], tuple], size: float = 4) -> None:
    """Draw a line through the candidates of each method at ``place(candidate)``; ours is thicker."""
    candidates = list(candidates)
    for method, (colour, marker, line) in styles.items():
        trained = [c for c in candidates if c["details"]["kind"] == method]
        if trained:
            axes.plot(*zip(*sorted(map(place, trained)), strict=True), color=colour, marker=marker, markersize=size,
                      linestyle=line, label=trained[0]["label"], linewidth=2.0 if method == "ours" else 1.0,
                      markerfacecolor="white" if line == ":" else colour)  # fmt: skip


def against_time(
    axes, result: dict, timings: Mapping, styles: Styles, error: str, x_label: str, y_label: str
) -> list[plot.Label]:
    """Draw an ``error`` of candidates against their times; references are vertical lines.

    Returns the labels of points, for :func:`.plot.place_labels`.
    """
    labels = []
    for name, t in timings.items():
        c = result["candidates"][name]
        if c["is_reference"]:
            axes.axvline(t["time"], color="0.55", linestyle=(0, (1, 1.5)))
            axes.text(t["time"], 0.98, c["label"], transform=axes.get_xaxis_transform(), fontsize=7, rotation=90,
                      va="top", ha="right", color="0.4")  # fmt: skip
            continue
        colour, marker, line = styles[c["details"]["kind"]]
        at = (t["time"], c["errors"][error])
        axes.plot(*at, color=colour, marker=marker, markersize=5, linestyle="none",
                  markerfacecolor="white" if line == ":" else colour)  # fmt: skip
        labels.append(plot.Label(c["label"], at, colour, "bold" if c["label"] == "ours" else "normal"))
    if timings:
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        axes.set_xlim(low / 1.5, high * 1.5)
        plot.log_ticks(axes.xaxis, low / 1.5, high * 1.5, plot.plain)
    finish(axes, x_label, y_label)
    return labels


def finish(axes, x_label: str, y_label: str) -> None:
    """Label both axes and add a light grid."""
    axes.set_xlabel(x_label, fontsize=8)
    axes.set_ylabel(y_label, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.minorticks_off()
    axes.grid(color="0.92", linewidth=0.5)
    axes.set_axisbelow(True)
