"""What pictures of kinds (:mod:`.kinds`) show below: an error against bytes, a line for each kind, and against time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from . import plot

#: Kind → colour, marker and line; markers are white where the line is dotted.
Styles = Mapping[str, tuple[str, str, str]]


def curves(axes, made: Iterable[dict], styles: Styles, place: Callable[[dict], tuple], size: float = 4) -> None:
    """The candidates ``made`` of each kind at ``place(candidate)``, in order; ours thicker."""
    made = list(made)
    for kind, (colour, marker, line) in styles.items():
        own = [c for c in made if c["details"]["kind"] == kind]
        if own:
            axes.plot(*zip(*sorted(map(place, own)), strict=True), color=colour, marker=marker, markersize=size,
                      linestyle=line, label=own[0]["label"], linewidth=2.0 if kind == "ours" else 1.0,
                      markerfacecolor="white" if line == ":" else colour)  # fmt: skip


def against_time(axes, result: dict, timings: Mapping, styles: Styles, error: str, axis: str) -> list[plot.Label]:
    """
    The ``error`` of candidates against their times, whose ``axis`` is labelled so; references as lines. Returns labels,
    to be placed.
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
    axes.set_xlabel(axis, fontsize=8)
    return labels


def finish(axes, label: str) -> None:
    """The vertical axis is labelled so; a light grid."""
    axes.set_ylabel(label, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.minorticks_off()
    axes.grid(color="0.92", linewidth=0.5)
    axes.set_axisbelow(True)
