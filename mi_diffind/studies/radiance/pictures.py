"""The picture of the study of radiance fields: a test view of all in equal bytes, errors against bytes and time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...measure import plot
from ...measure.curves import against_time, curves, finish
from ...measure.formatting import machine_line, state
from ...tasks.radiance.training import rendered, shown
from ..equal_memory import candidates_by_budget
from .conclusions import FOREGROUND, WHITE, ratio_text, references

#: The difference of sRGB values that is as dark as it gets.
WORST = 0.25

#: Kind → colour, marker and line.
STYLES = {
    "dense": ("#4d4d4d", "s", ":"), "sparse": ("#2166ac", "o", "-"), "sparse6": ("#2166ac", "D", "--"),
    "components": ("#c47a00", "v", "--"), "codebook": ("#762a83", "^", "-"), "planes": ("#12908e", "P", ":"),
    "hash": ("#12908e", "*", ":"), "paper": ("#1b7837", "X", ":"), "ours": ("#b2182b", "o", "-"),
}  # fmt: skip


def of(setting) -> dict[str, Callable[[dict], object]]:
    """The pictures of a plan: ``views``."""
    return {"views": lambda result: views(setting, result)}


def views(setting, result: dict):
    """
    Above, the first test view as it is and of all fields of the first size, with differences below each; at the bottom
    errors of all sizes against bytes, and of the first against the time of a picture.
    """
    first = result["details"]["first"]
    shown_jobs = [job for job in setting.jobs.values() if job.budget == first and job.method in STYLES]
    columns = max(4, len(shown_jobs) + 1)
    caption = f"{' '.join(result['notes'])} {machine_line(result)}{state(result)}"
    truth = setting.held.images[0]
    covered = truth[..., 3] > 0
    rows, cols = np.flatnonzero(covered.any(axis=1)), np.flatnonzero(covered.any(axis=0))
    crop = (slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)) if len(rows) else (slice(None),) * 2
    wanted = shown(truth)
    tall = 1.6 * wanted[crop].shape[0] / wanted[crop].shape[1]
    found = plot.figure(f"{result['title']}, {ratio_text(first)} above", caption, 1.6 * columns, 2 * tall + 4.6)
    grid = found.add_gridspec(3, 2 * columns, height_ratios=[tall, tall, 3.8])
    for k, job in enumerate([None, *shown_jobs]):
        axes = found.add_subplot(grid[0, 2 * k : 2 * k + 2])
        axes.set_axis_off()
        if job is None:
            axes.imshow(wanted[crop], interpolation="nearest")
            axes.set_title("test view", fontsize=8)
            continue
        picture = shown(rendered(job.model, setting.tests, 0))
        axes.imshow(picture[crop], interpolation="nearest")
        c = result["candidates"][job.name]
        bold = {"fontweight": "bold"} if job.method == "ours" else {}
        axes.set_title(
            f"{c['label']}\n{c['errors'][WHITE]:.2f} / {c['errors'][FOREGROUND]:.2f} dB", fontsize=7.5, **bold
        )
        below = found.add_subplot(grid[1, 2 * k : 2 * k + 2])
        below.set_axis_off()
        error = np.abs(picture - wanted).mean(axis=-1)
        drawn = below.imshow(error[crop], vmin=0, vmax=WORST, cmap="inferno_r", interpolation="nearest")
    if shown_jobs:
        cell = found.add_subplot(grid[1, :2])
        cell.set_axis_off()
        bar = found.colorbar(drawn, cax=cell.inset_axes([0.1, 0.5, 0.8, 0.08]), orientation="horizontal")
        bar.set_label("difference, sRGB", fontsize=7)
        bar.ax.tick_params(labelsize=6)
    _curves(found.add_subplot(grid[2, :columns]), result)
    axes = found.add_subplot(grid[2, columns:])
    labels = _against_time(axes, result)
    plot.fix_layout(found)
    plot.place_labels(axes, labels, [label.at for label in labels])
    return found


def _curves(axes, result: dict) -> None:
    """PSNR of the foreground against bytes, a line for each kind; the grids as lines across."""
    made = [c for found in candidates_by_budget(result).values() for c in found.values()]
    curves(axes, made, STYLES, lambda c: (c["bytes"] / 1e6, c["errors"][FOREGROUND]), 5)
    for name, c in references(result).items():
        axes.axhline(c["errors"][FOREGROUND], color="0.55", linestyle=(0, (1, 1.5)))
        axes.text(0.99, c["errors"][FOREGROUND], name, transform=axes.get_yaxis_transform(), fontsize=7, ha="right",
                  va="bottom", color="0.4")  # fmt: skip
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    plot.log_ticks(axes.xaxis, low, high, plot.plain)
    axes.set_xlabel("megabytes: ours and dense grids in memory, the others on disk, deflated", fontsize=8)
    axes.legend(fontsize=7, frameon=False, loc="lower right")
    finish(axes, "PSNR of the foreground, dB")


def _against_time(axes, result: dict) -> list[plot.Label]:
    """PSNR of the foreground against the time of a picture, of the first size."""
    timings = result["cases"].get("reads", {}).get("passes", {}).get("render", {})
    side = result["details"]["request"]["film"]
    axis = f"ms a picture of {side}², {ratio_text(result['details']['first'])}"
    labels = against_time(axes, result, timings, STYLES, FOREGROUND, axis)
    finish(axes, "PSNR of the foreground, dB")
    return labels
