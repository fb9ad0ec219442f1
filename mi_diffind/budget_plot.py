"""The picture of :mod:`mi_diffind.budget`: error against render time, learned and exact, with bias and crossover."""

from __future__ import annotations

import math
import os
import textwrap
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from .files import replacing
from .plot import STYLES

#: Colour and marker of each version.
VERSIONS = {"exact": STYLES[1], "learned": STYLES[0]}

#: The crossover is drawn if it takes at most so many times the samples of the last point; else a note says where it is.
REACH = 100

_GREY, _DASHES = "0.35", (0, (4, 2.5))


# -- numbers as text --------------------------------------------------------------------------------------------------


def percent(value: float, digits: int = 3) -> str:
    """``0.0123`` → ``"1.23%"``: so many digits; powers of ten where there would be many zeros."""
    value = 100 * value
    return f"{value:.{digits}g}%" if value == 0 or abs(value) >= 1e-4 else f"{value:.1e}%"


def about(number: float) -> str:
    """A count with two digits: ``"1.3"``, ``"12,000"``, ``"3.4 million"``; powers of ten from 10¹⁵ on."""
    if number >= 1e15:
        return f"{number:.1e}"
    for size, name in ((1e12, " trillion"), (1e9, " billion"), (1e6, " million")):
        if float(f"{number:.2g}") >= size:
            return f"{float(f'{number / size:.2g}'):g}{name}"
    rounded = float(f"{number:.2g}")
    return f"{rounded:,.0f}" if rounded >= 10 else f"{rounded:g}"


def duration(seconds: float) -> str:
    """Seconds with two digits, in the unit that suits them: ``"0.35 s"``, ``"7 min"``; at most 1,000 years."""
    year = 365.25 * 86400
    if seconds > 1000 * year:
        return "more than 1,000 years"
    units = ((year, year, "years"), (86400, 86400, "days"), (5400, 3600, "h"), (90, 60, "min"), (0.1, 1, "s"))
    size, name = next((unit[1:] for unit in units if seconds >= unit[0]), (1e-3, "ms"))
    return f"{about(seconds / size)} {name}"


def seconds_of(spp: float, seconds: dict[int, float]) -> float | None:
    """
    The time of a render of ``spp`` samples per pixel, any number, from those measured (count → seconds): linear between
    them, and beyond with the slope from the first to the last; ``None`` below the first, or if there are none.
    """
    if not seconds or spp < min(seconds):
        return None
    counts = sorted(seconds)
    first, last = counts[0], counts[-1]
    if spp <= last:
        return float(np.interp(spp, counts, [seconds[n] for n in counts]))
    slope = seconds[last] / last
    if seconds[last] > seconds[first]:
        slope = (seconds[last] - seconds[first]) / (last - first)
    return seconds[last] + slope * (spp - last)


# -- drawing ----------------------------------------------------------------------------------------------------------


def write(path: str | os.PathLike, result: dict, caption: str) -> None:
    """:func:`draw` and write ``path`` (``.png``). Raises :class:`~mi_diffind.files.OutputError`."""
    sheet = draw(result, caption)
    with replacing(path) as temporary:
        sheet.savefig(temporary, format=Path(path).suffix[1:])


def draw(result: dict, caption: str):
    """
    A Matplotlib figure of a result of :func:`mi_diffind.budget.measure` that has timed points: both axes logarithmic,
    points with quartiles; dashed, what noise and bias add up to beyond the last; the bias as a horizontal band, or the
    line that it is below; the crossover as a vertical line, if it is not too far away.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width = 7.6
    text = "\n".join(textwrap.wrap(caption, int(17.3 * width)))
    below = 0.14 * (text.count("\n") + 1) + 0.15
    sheet = Figure(figsize=(width, 5.2 + below), dpi=200, layout="constrained")
    canvas = FigureCanvasAgg(sheet)
    height = sheet.get_figheight()
    sheet.get_layout_engine().set(rect=(0, below / height, 1, 1 - below / height), w_pad=0.08, h_pad=0.08)
    sheet.suptitle(f"{Path(result['scene']).stem}: noise and bias at a given render time", fontsize=12,
                   fontweight="bold")  # fmt: skip
    sheet.text(0.012, 0.06 / height, text, fontsize=7.5, va="bottom", ha="left", color="0.25")
    axes = sheet.add_subplot()
    axes.set_xlabel("seconds of a render (kernels)", fontsize=9)
    axes.set_ylabel("relative RMS error", fontsize=9)
    curves = {name: _curve(result, name) for name in VERSIONS}
    _limits(axes, result, curves)
    texts = _draw(axes, result, curves)
    _legend(axes, curves)
    sheet.draw_without_rendering()  # fixes the layout, in which labels are placed
    sheet.set_layout_engine("none")
    _place(canvas.get_renderer(), axes, curves, texts)
    return sheet


def _curve(result: dict, name: str) -> list[dict]:
    return [p for p in result["points"] if p["version"] == name and p["timed"] and p["rmse"] > 0]


def _floor(result: dict) -> float:
    """The bias, or what it is below; 0 if there is none."""
    bias = result["bias"]
    return bias["rmse"] if bias["measured"] else bias["rmse_below"]


def _crossover(result: dict) -> tuple[float, float] | None:
    """Sample count and time of a crossover that is drawn."""
    found = result["crossover"]
    near = found.get("seconds") is not None and found["spp"] <= REACH * result["counts"][-1]
    return (found["spp"], found["seconds"]) if near else None


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
    for axis, (low, high), shown in (
        (axes.xaxis, axes.get_xlim(), lambda v: f"{v:,.0f}" if v >= 1000 else f"{v:g}"),
        (axes.yaxis, axes.get_ylim(), percent),
    ):
        decades = math.log10(high / low)
        fine = (
            (1,) if decades > 4 else (1, 3) if decades > 2.5 else (1, 2, 5) if decades > 0.8 else (1, 1.5, 2, 3, 5, 7)
        )
        ticks = [m * 10.0**e for e in range(-12, 10) for m in fine]
        axis.set_ticks([t for t in ticks if low <= t <= high])
        axis.set_major_formatter(lambda value, _, shown=shown: shown(value))
        axis.set_minor_formatter(lambda value, _: "")
    axes.tick_params(labelsize=8)
    axes.grid(which="major", color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def _draw(axes, result: dict, curves: dict[str, list[dict]]) -> list[tuple]:
    """All but the labels; returns these: text, anchor (data), colour, weight, in the order in which they are placed."""
    texts = []
    low = axes.get_ylim()[0]
    bias, floor, crossover = result["bias"], _floor(result), _crossover(result)
    if floor > low:
        if bias["measured"]:
            spread = 2 * bias["rmse_standard_error"]
            axes.axhspan(max(floor - spread, low), floor + spread, color="#7a3b8f", alpha=0.18, linewidth=0, zorder=1.5)
            name = f"bias of the approximation: {percent(floor)}"
        else:
            axes.axhspan(low, floor, color="#7a3b8f", alpha=0.08, linewidth=0, zorder=1.5)
            name = f"bias of the approximation: none found, below {percent(floor)}"
        axes.axhline(floor, color="#7a3b8f", linewidth=1.1, zorder=2)
        axes.annotate(name + _decibel(bias), (0, floor), (5, -3), xycoords=axes.get_yaxis_transform(), va="top",
                      textcoords="offset points", fontsize=8, color="#5e2a70")  # fmt: skip
    else:
        axes.annotate(_far(result), (0.012, 0.02), xycoords="axes fraction", fontsize=8, color="#5e2a70", va="bottom",
                      linespacing=1.35)  # fmt: skip
    for name, curve in curves.items():
        if not curve:
            continue
        colour, marker = VERSIONS[name]
        xs, ys = [p["seconds"] for p in curve], [p["rmse"] for p in curve]
        roots = [[math.sqrt(max(p[k], 1e-30)) for p in curve] for k in ("mse_q1", "mse_q3")]
        bars = {
            "xerr": [np.subtract(xs, [p["seconds_q1"] for p in curve]),
                     np.subtract([p["seconds_q3"] for p in curve], xs)],
            "yerr": [np.subtract(ys, roots[0]), np.subtract(roots[1], ys)],
        }  # fmt: skip
        bars = {k: np.maximum(v, 0) for k, v in bars.items()}
        axes.errorbar(xs, ys, **bars, fmt=f"{marker}-", color=colour, linewidth=1.1, elinewidth=0.9, capsize=2,
                      markersize=5.5, markerfacecolor="white", markeredgewidth=1.3, zorder=3)  # fmt: skip
        axes.plot(*_continued(result, name, curve, axes.get_xlim()[1], crossover), color=colour, linewidth=0.9,
                  linestyle=_DASHES, alpha=0.75, zorder=2.5)  # fmt: skip
    for spp in result["counts"]:
        pair = [p for curve in curves.values() for p in curve if p["spp"] == spp]
        if pair:
            axes.plot([p["seconds"] for p in pair], [p["rmse"] for p in pair], color="0.6", linewidth=0.6, zorder=2.4)
            anchor = max(p["seconds"] for p in pair), max(p["rmse"] for p in pair)
            texts.append((f"{spp} spp", anchor, "0.15", "bold"))
    if crossover:
        spp, seconds = crossover
        axes.axvline(seconds, color=_GREY, linewidth=1.0, linestyle=(0, (1, 1.5)), zorder=2)
        how = "extrapolated: " if result["crossover"]["extrapolated"] else ""
        bottom = low * (axes.get_ylim()[1] / low) ** 0.06
        texts.append((f"noise = bias\n{how}{about(spp)} spp, {duration(seconds)}", (seconds, bottom), _GREY, "normal"))
    return texts


def _legend(axes, curves: dict[str, list[dict]]) -> None:
    from matplotlib.lines import Line2D

    handles = []
    for name, curve in curves.items():
        if curve:
            colour, marker = VERSIONS[name]
            handles.append(Line2D([], [], color=colour, marker=marker, markersize=5.5, markerfacecolor="white",
                                  markeredgewidth=1.3, linewidth=1.1, label=name))  # fmt: skip
    handles.append(Line2D([], [], color=_GREY, linewidth=0.9, linestyle=_DASHES, label="extrapolated"))
    axes.legend(handles=handles, loc="upper right", fontsize=8, framealpha=1, edgecolor="0.8", handlelength=2.6)


def _continued(result: dict, name: str, curve: list[dict], end: float, crossover) -> tuple[list, list]:
    """What noise (and bias, if learned) add up to from the last point on: times and errors."""
    times = {p["spp"]: p["seconds"] for p in curve}
    last = curve[-1]
    noise = result["noise"][name]["mse_of_a_sample"]
    square = max(result["bias"]["mse"], 0.0) if name == "learned" and result["bias"]["measured"] else 0.0
    law = last["mse"] - square - noise / last["spp"]  # begins where the last point is
    xs, ys = [], []
    for spp in last["spp"] * np.geomspace(1, 4 * REACH, 200):
        seconds = seconds_of(spp, times)
        if seconds <= end:
            xs.append(seconds)
            ys.append(math.sqrt(max(square + noise / spp + law * last["spp"] / spp, 0)))
    return xs, ys


def _decibel(bias: dict) -> str:
    if "psnr_db" in bias:
        return f" ({bias['psnr_db']:.1f} dB)"
    return f" (above {bias['psnr_db_above']:.1f} dB)" if bias["psnr_db_above"] is not None else ""


def _far(result: dict) -> str:
    """Where the bias is, if it is too far below the points to be drawn."""
    bias, crossover = result["bias"], result["crossover"]
    if not bias["measured"]:
        if not bias["rmse_below"]:
            return "▼ learned and exact renders do not differ at all"
        return (
            f"▼ bias of the approximation: none found, below {percent(bias['rmse_below'])}{_decibel(bias)};\n"
            f"    noise dominates up to {about(crossover['spp_above'])} spp at least"
        )
    if bias["rounding_only"]:
        return f"▼ learned and exact renders differ by rounding only: {percent(bias['rmse'])}{_decibel(bias)}"
    last = min(p["rmse"] for p in result["points"] if p["version"] == "learned")
    when = f", {duration(crossover['seconds'])}" if crossover["seconds"] is not None else ""
    below = f"{about(last / bias['rmse'])} times below the last point"
    return (
        f"▼ bias of the approximation: {percent(bias['rmse'])}{_decibel(bias)}, {below};"
        f"\n    the noise would equal it at {about(crossover['spp'])} spp{when} (extrapolated)"
    )


# -- labels -----------------------------------------------------------------------------------------------------------


def _place(renderer, axes, curves: dict[str, list[dict]], texts: Iterable[tuple]) -> None:
    """Place each label near its anchor, where it covers neither another nor a point, a line or the legend."""
    inside, scale = axes.get_window_extent(renderer).extents, renderer.dpi / 72
    # Boxes in pixels, as rows of left, bottom, right, top
    taken = [t.get_window_extent(renderer).extents for t in (*axes.texts, axes.get_legend())]
    for line in axes.lines:  # curves, bars and lines alike, as chains of small boxes
        pixels = line.get_transform().transform(np.column_stack([np.asarray(v, dtype=float) for v in line.get_data()]))
        for a, b in zip(pixels, [*pixels[1:], pixels[-1]], strict=True):
            if np.isfinite([*a, *b]).all():
                steps = np.linspace(0, 1, 1 + max(1, min(400, math.ceil(math.dist(a, b) / (3 * scale)))))
                taken += [np.tile(a + t * (b - a), 2) + scale * np.array([-1, -1, 1, 1]) for t in steps]
    for curve in curves.values():
        for p in curve:
            at = axes.transData.transform((p["seconds"], p["rmse"]))
            taken.append(np.tile(at, 2) + 4 * scale * np.array([-1, -1, 1, 1]))
    taken = np.array(taken)

    for text, anchor, colour, weight in texts:
        note = axes.annotate(text, anchor, xytext=(0, 0), textcoords="offset points", fontsize=8, color=colour,
                             ha="center", va="center", fontweight=weight, zorder=5)  # fmt: skip
        box = note.get_window_extent(renderer)
        size = np.array([box.width, box.height]) + 2 * scale
        start = axes.transData.transform(anchor)
        best = None
        for radius in (5, 8, 12, 18, 26, 36, 50):
            for k in range(24):  # to the upper right first: the curves fall
                turn = (k + 1) // 2
                angle = math.pi / 4 + 2 * math.pi * (turn * (-1) ** k) / 24
                offset = (radius * scale + size / 2) * [math.cos(angle), math.sin(angle)]
                at = np.concatenate([start + offset - size / 2, start + offset + size / 2])
                cost = 50 * (size.prod() - _overlap(at, inside[None])) + 30 * _overlap(at, taken)
                cost += (radius + 2 * turn) * scale
                if best is None or cost < best[0]:
                    best = (cost, offset, at)
        note.set_position(best[1] / scale)
        taken = np.vstack([taken, best[2]])


def _overlap(box: np.ndarray, boxes: np.ndarray) -> float:
    """The area that a box shares with each of others, in sum."""
    sides = np.minimum(box[2:], boxes[:, 2:]) - np.maximum(box[:2], boxes[:, :2])
    return float(np.maximum(sides, 0).prod(axis=1).sum())
