"""Figure of the scene study: error against render time, learned and exact, with bias and crossover."""

from __future__ import annotations

import math
import textwrap
from pathlib import Path

import numpy as np

from ...measure import plot
from ...measure.bias import seconds_of
from ...measure.formatting import duration, percent, rounded

#: Versions of the scene: with the exact counterparts of learned plugins, and as written; with colour and marker.
VERSION_STYLES = {"exact": plot.STYLES[1], "learned": plot.STYLES[0]}
VERSIONS = tuple(VERSION_STYLES)

#: Largest ratio of the crossover's sample count to that of the last point at which the crossover is still drawn.
REACH = 100

_GREY, _PURPLE, _DARK_PURPLE, _DASHES = "0.35", "#7a3b8f", "#5e2a70", (0, (4, 2.5))


def draw(result: dict, caption: str):
    """Return a Matplotlib figure of a result of :func:`.renders.measure` that has timed points.

    Both axes are logarithmic, points have quartiles. Dashed curves extrapolate the sum of noise and bias beyond the
    last point. The bias is a horizontal band, or a line if only its upper bound is known; the crossover is a vertical
    line unless it is beyond :data:`REACH`.
    """
    title = f"{Path(result['scene']).stem}: noise and bias at a given render time"
    figure = plot.figure(title, caption, 7.6, 4.9)
    axes = figure.add_subplot()
    axes.set_xlabel("seconds of a render (kernels)", fontsize=9)
    axes.set_ylabel("relative RMS error", fontsize=9)
    points = [p for p in result["points"] if p["timed"] and p["rmse"] > 0]
    curves = {name: [p for p in points if p["version"] == name] for name in VERSIONS}
    _limits(axes, result, curves)
    labels = _draw(axes, result, curves)
    _legend(axes, curves)
    plot.fix_layout(figure)
    plot.place_labels(axes, labels, [(p["seconds"], p["rmse"]) for curve in curves.values() for p in curve])
    return figure


def _floor(result: dict) -> float:
    """Return the bias, or its upper bound if no bias was measured."""
    bias = result["bias"]
    return bias["rmse"] if bias["measured"] else bias["rmse_below"]


def _crossover(result: dict) -> tuple[float, float] | None:
    """Return the sample count and time of the crossover, ``None`` if it is not drawn."""
    crossover = result["crossover"]
    near = crossover.get("seconds") is not None and crossover["spp"] <= REACH * result["counts"][-1]
    return (crossover["spp"], crossover["seconds"]) if near else None


def _limits(axes, result: dict, curves: dict[str, list[dict]]) -> None:
    points = [p for curve in curves.values() for p in curve]
    times = [v for p in points for v in (p["seconds_q1"], p["seconds_q3"])]
    errors = [v for p in points for v in (p["rmse"], math.sqrt(max(p["mse_q1"], 0)), math.sqrt(p["mse_q3"])) if v > 0]
    crossover, floor = _crossover(result), _floor(result)
    if crossover:
        times.append(crossover[1])
    if crossover or floor >= min(errors) / 4:
        errors.append(floor)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(min(times) / 1.5, max(times) * (2.2 if crossover else 1.8))
    axes.set_ylim(min(errors) / (2.0 if min(errors) == floor else 2.4), max(errors) * 2.0)
    plot.log_ticks(axes.xaxis, *axes.get_xlim(), plot.plain)
    plot.log_ticks(axes.yaxis, *axes.get_ylim(), percent)
    axes.tick_params(labelsize=8)
    axes.grid(which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def _draw(axes, result: dict, curves: dict[str, list[dict]]) -> list[plot.Label]:
    """Draw everything but the labels; return these in the order in which they are placed."""
    labels = []
    low = axes.get_ylim()[0]
    bias, floor, crossover = result["bias"], _floor(result), _crossover(result)
    if floor > low:
        if bias["measured"]:
            spread = 2 * bias["rmse_standard_error"]
            axes.axhspan(max(floor - spread, low), floor + spread, color=_PURPLE, alpha=0.18, linewidth=0, zorder=1.5)
            name = f"bias of the approximation: {percent(floor)}"
        else:
            axes.axhspan(low, floor, color=_PURPLE, alpha=0.08, linewidth=0, zorder=1.5)
            name = f"bias of the approximation: none found, below {percent(floor)}"
        axes.axhline(floor, color=_PURPLE, linewidth=1.1, zorder=2)
        axes.annotate(f"{name}, {decibel(bias)}", (0, floor), (5, -3), xycoords=axes.get_yaxis_transform(), va="top",
                      textcoords="offset points", fontsize=8, color=_DARK_PURPLE)  # fmt: skip
    else:
        note = "▼ " + "\n    ".join(textwrap.wrap(f"{result['verdict']} {decibel(bias)}", 100))
        axes.annotate(note, (0.012, 0.02), xycoords="axes fraction", fontsize=8, color=_DARK_PURPLE, va="bottom",
                      linespacing=1.35)  # fmt: skip
    for name, curve in curves.items():
        if not curve:
            continue
        colour, marker = VERSION_STYLES[name]
        xs, ys = [p["seconds"] for p in curve], [p["rmse"] for p in curve]
        roots = [[math.sqrt(max(p[k], 1e-30)) for p in curve] for k in ("mse_q1", "mse_q3")]
        times = [[p[k] for p in curve] for k in ("seconds_q1", "seconds_q3")]
        bars = [
            np.maximum([np.subtract(v, low), np.subtract(high, v)], 0) for v, (low, high) in ((ys, roots), (xs, times))
        ]
        axes.errorbar(xs, ys, *bars, fmt=f"{marker}-", color=colour, linewidth=1.1, elinewidth=0.9, capsize=2,
                      markersize=5.5, markerfacecolor="white", markeredgewidth=1.3, zorder=3)  # fmt: skip
        axes.plot(*_continued(result, name, curve, axes.get_xlim()[1], crossover), color=colour, linewidth=0.9,
                  linestyle=_DASHES, alpha=0.75, zorder=2.5)  # fmt: skip
    for spp in result["counts"]:
        pair = [p for curve in curves.values() for p in curve if p["spp"] == spp]
        if pair:
            xs, ys = [p["seconds"] for p in pair], [p["rmse"] for p in pair]
            axes.plot(xs, ys, color="0.6", linewidth=0.6, zorder=2.4)
            anchor = max(xs), max(ys)
            labels.append(plot.Label(f"{spp} spp", anchor, "0.15", "bold", angle=math.pi / 4))  # curves fall
    if crossover:
        spp, seconds = crossover
        axes.axvline(seconds, color=_GREY, linewidth=1.0, linestyle=(0, (1, 1.5)), zorder=2)
        how = "extrapolated: " * result["crossover"]["extrapolated"]
        bottom = low * (axes.get_ylim()[1] / low) ** 0.06
        text = f"noise = bias\n{how}{rounded(spp)} spp, {duration(seconds)}"
        labels.append(plot.Label(text, (seconds, bottom), _GREY, angle=math.pi / 4))
    return labels


def _legend(axes, curves: dict[str, list[dict]]) -> None:
    from matplotlib.lines import Line2D

    handles = []
    for name, curve in curves.items():
        if curve:
            colour, marker = VERSION_STYLES[name]
            handles.append(Line2D([], [], color=colour, marker=marker, markersize=5.5, markerfacecolor="white",
                                  markeredgewidth=1.3, linewidth=1.1, label=name))  # fmt: skip
    handles.append(Line2D([], [], color=_GREY, linewidth=0.9, linestyle=_DASHES, label="extrapolated"))
    axes.legend(handles=handles, loc="upper right", fontsize=8, framealpha=1, edgecolor="0.8", handlelength=2.6)


def _continued(result: dict, name: str, curve: list[dict], end: float, crossover) -> tuple[list, list]:
    """Extrapolate noise (and, of the learned version, bias) from the last point on; return times and errors."""
    times = {p["spp"]: p["seconds"] for p in curve}
    last = curve[-1]
    noise = result["noise"][name]["mse_of_a_sample"]
    square = max(result["bias"]["mse"], 0.0) if name == "learned" and result["bias"]["measured"] else 0.0
    offset = last["mse"] - square - noise / last["spp"]  # makes the curve begin at the last point
    xs, ys = [], []
    for spp in last["spp"] * np.geomspace(1, 4 * REACH, 200):
        seconds = seconds_of(spp, times)
        if seconds <= end:
            xs.append(seconds)
            ys.append(math.sqrt(max(square + noise / spp + offset * last["spp"] / spp, 0)))
    return xs, ys


def decibel(bias: dict) -> str:
    """Return the PSNR of a bias, or its lower bound, as text."""
    if "psnr_db" in bias:
        return f"PSNR {bias['psnr_db']:.1f} dB"
    return "PSNR infinite" if bias["psnr_db_above"] is None else f"PSNR above {bias['psnr_db_above']:.1f} dB"
