"""Figure of the study of radiance fields: a test view by each candidate, errors against bytes and time."""

from __future__ import annotations

import numpy as np

from ...measure import plot
from ...measure.curves import against_time, curves, finish
from ...measure.formatting import figure_caption
from ...tasks.radiance.session import displayed
from ..equal_memory import candidates_by_budget
from .conclusions import FOREGROUND, WHITE, ratio_text, references

#: Difference of sRGB values at the dark end of the colour map.
WORST = 0.25

#: Method → colour, marker and line.
STYLES = {
    "dense": ("#4d4d4d", "s", ":"), "sparse": ("#2166ac", "o", "-"), "sparse6": ("#2166ac", "D", "--"),
    "components": ("#c47a00", "v", "--"), "codebook": ("#762a83", "^", "-"), "planes": ("#12908e", "P", ":"),
    "hash": ("#12908e", "*", ":"), "paper": ("#1b7837", "X", ":"), "ours": ("#b2182b", "o", "-"),
}  # fmt: skip


def views(context, result: dict):
    """Return the figure of a result.

    The top row shows the first test view and its renders by all fields at the first budget, the row below their
    differences. The bottom row shows errors of all budgets against bytes, and of the first against the time of a
    picture.
    """
    first = result["details"]["first"]
    jobs = [job for job in context.jobs.values() if job.budget == first and job.method in STYLES]
    columns = max(4, len(jobs) + 1)
    truth = context.session.held_out.image(0)
    crop, reference = plot.crop_to(truth[..., 3] > 0), displayed(truth)
    tall = 1.6 * reference[crop].shape[0] / reference[crop].shape[1]
    title = f"{result['title']}, {ratio_text(first)} above"
    figure = plot.figure(title, figure_caption(result), 1.6 * columns, 2 * tall + 4.6)
    grid = figure.add_gridspec(3, 2 * columns, height_ratios=[tall, tall, 3.8])
    for k, job in enumerate([None, *jobs]):
        axes = figure.add_subplot(grid[0, 2 * k : 2 * k + 2])
        axes.set_axis_off()
        if job is None:
            axes.imshow(reference[crop], interpolation="nearest")
            axes.set_title("test view", fontsize=8)
            continue
        picture = displayed(context.session.held_out_images.render(job.model, 0))
        axes.imshow(picture[crop], interpolation="nearest")
        c = result["candidates"][job.name]
        bold = {"fontweight": "bold"} if job.method == "ours" else {}
        axes.set_title(
            f"{c['label']}\n{c['errors'][WHITE]:.2f} / {c['errors'][FOREGROUND]:.2f} dB", fontsize=7.5, **bold
        )
        below = figure.add_subplot(grid[1, 2 * k : 2 * k + 2])
        below.set_axis_off()
        error = np.abs(picture - reference).mean(axis=-1)
        drawn = below.imshow(error[crop], vmin=0, vmax=WORST, cmap="inferno_r", interpolation="nearest")
    if jobs:
        cell = figure.add_subplot(grid[1, :2])
        cell.set_axis_off()
        bar = figure.colorbar(drawn, cax=cell.inset_axes([0.1, 0.5, 0.8, 0.08]), orientation="horizontal")
        bar.set_label("difference, sRGB", fontsize=7)
        bar.ax.tick_params(labelsize=6)
    _curves(figure.add_subplot(grid[2, :columns]), result)
    axes = figure.add_subplot(grid[2, columns:])
    timings = result["cases"].get("reads", {}).get("passes", {}).get("render", {})
    x_label = f"ms a picture of {result['details']['request']['film']}², {ratio_text(first)}"
    labels = against_time(axes, result, timings, STYLES, FOREGROUND, x_label, "PSNR of the foreground, dB")
    plot.fix_layout(figure)
    plot.place_labels(axes, labels, [label.at for label in labels])
    return figure


def _curves(axes, result: dict) -> None:
    """Plot the PSNR of the foreground against bytes: a line for each method, the grids as lines across."""
    candidates = [c for group in candidates_by_budget(result).values() for c in group.values()]
    curves(axes, candidates, STYLES, lambda c: (c["bytes"] / 1e6, c["errors"][FOREGROUND]), 5)
    for name, c in references(result).items():
        axes.axhline(c["errors"][FOREGROUND], color="0.55", linestyle=(0, (1, 1.5)))
        axes.text(0.99, c["errors"][FOREGROUND], name, transform=axes.get_yaxis_transform(), fontsize=7, ha="right",
                  va="bottom", color="0.4")  # fmt: skip
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    plot.log_ticks(axes.xaxis, low, high, plot.plain)
    axes.legend(fontsize=7, frameon=False, loc="lower right")
    x_label = "megabytes: ours and dense grids in memory, the others on disk, deflated"
    finish(axes, x_label, "PSNR of the foreground, dB")
