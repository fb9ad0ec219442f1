"""Figures of the shading study: PSNR against λ (the paper's figure 2), PSNR by level, crops, frames of the zoom."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ...images import srgb
from ...maps.compressed import decibel
from ...measure import plot
from ...measure.curves import finish
from ...measure.formatting import figure_caption
from .conclusions import MaterialCurves, curves

#: Line style of each classical filter.
CLASSICAL = {"filtered": ":", "kernel": (0, (1, 3)), "Toksvig": (0, (5, 1)), "LEAN": "--", "LEAN, kernel": (0, (6, 2)),
             "baked": "-."}  # fmt: skip

#: Level of detail of the crops, and their largest side in texels.
LEVEL, CROP = 3, 48


_LAMBDA_LABEL = "λ, weight of the shading loss (× : runs in trouble, and their number)"


def pictures_of(contexts: dict) -> dict[str, Callable[[dict], object]]:
    """Return the figures of a plan by name, functions of the result."""
    return {
        "png": lambda result: _grid(result, "", 3.5, _draw_lambdas, _LAMBDA_LABEL),
        "levels": lambda result: _grid(result, ": levels of detail", 3.3, _draw_levels, "level of detail"),
        "strip": lambda result: crops(contexts, result),
        "zoom": lambda result: zoom(contexts, result),
    }


def _grid(result: dict, title: str, height: float, draw: Callable, x_label: str):
    """Return a figure with a row for each material and a column for each truth."""
    materials = curves(result)
    figure = plot.figure(result["title"] + title, figure_caption(result), 12.0, height * len(materials))
    for row, material in enumerate(materials.values()):
        for column, (letter, truth) in enumerate((("C", "converged truth"), ("P", "the paper's reference"))):
            axes = figure.add_subplot(len(materials), 2, 2 * row + column + 1)
            draw(axes, material, letter)
            axes.set_title(f"{material.name}, against {truth} ({letter})", fontsize=9)
            finish(axes, x_label, "PSNR of shaded values, dB")
            if row == column == 0:
                axes.legend(fontsize=6.5, ncols=2)
    return figure


def _draw_lambdas(axes, material: MaterialCurves, letter: str) -> None:
    """Draw PSNR over λ for all remedies, with bars over seeds."""
    shares = sorted({s for _, s in material.runs})
    position = {s: i for i, s in enumerate(shares)}
    for i, remedy in enumerate(material.remedies):
        colour, marker = plot.STYLES[i % len(plot.STYLES)]
        x = np.array([position[s] for s in material.shares(remedy)]) + 0.05 * (i - 1.5)
        values = [material.values(remedy, s, letter) for s in material.shares(remedy)]
        y = np.array([np.mean(v) for v in values])
        bars = [[a - min(v), max(v) - a] for a, v in zip(y, values, strict=True)]
        axes.errorbar(x, y, np.array(bars).T, color=colour, marker=marker, markersize=4, linewidth=1.1, capsize=2,
                      label=remedy)  # fmt: skip
        for s, a, b in zip(material.shares(remedy), x, y, strict=True):
            lost = sum(bool(d.get("trouble")) for d in material.runs[remedy, s] if s > 0)
            if lost:
                axes.plot(a, b, marker="x", color="black", markersize=9, zorder=5)
                axes.annotate(f"{lost}", (a, b), xytext=(4, -9), textcoords="offset points", fontsize=6.5)
    for i, (label, style) in enumerate(CLASSICAL.items()):
        if label in material.classical:
            axes.axhline(material.classical[label][letter]["mean_db"], linestyle=style, linewidth=1.0,
                         color=f"{0.12 * i}", label=f"{label}, uncompressed")  # fmt: skip
    for label, d in material.compressed.items():
        axes.plot([0], [d[letter]["mean_db"]], marker="*", markersize=8, linestyle="", color="0.3", label=label)
    axes.set_xticks(range(len(shares)), [f"{s:g}" for s in shares])


def _draw_levels(axes, material: MaterialCurves, letter: str) -> None:
    """Draw PSNR by level of detail of λ = 0, the best λ and classical filters."""
    for i, (label, style) in enumerate(CLASSICAL.items()):
        if label in material.classical:
            axes.plot(material.classical[label][letter]["psnr_db"], linestyle=style, color=f"{0.12 * i}", linewidth=1.0,
                      label=f"{label}, uncompressed")  # fmt: skip
    for (colour, marker), (remedy, share) in zip(plot.STYLES, _shown(material), strict=False):
        axes.plot(material.levels(remedy, share, letter), color=colour, marker=marker, markersize=4, linewidth=1.3,
                  label=f"λ {share:g}")  # fmt: skip


def crops(contexts: dict, result: dict):
    """Draw crops of a minified level: filtered parameters, the best classical filter, λ = 0, the best λ, the truth."""
    rows = [(m, contexts[m.name]) for m in curves(result).values() if m.best() is not None]
    figure = plot.figure(f"{result['title']}: crops", figure_caption(result), 11.5, 2.45 * len(rows))
    for row, (material, context) in enumerate(rows):
        evaluation = context.evaluation
        level = min(LEVEL, evaluation.levels - 1)
        truths = evaluation.truths["C"][level].clip(0, 1)
        images = {
            text: evaluation.images(context.jobs[job].model, level).clip(0, 1) for text, job in _columns(material)
        }
        first = next(iter(images.values()))
        pair = int(np.argmax(((first - truths) ** 2).mean(axis=(1, 2, 3))))  # with the largest error of the filter
        for column, (text, image) in enumerate({**images, "truth": truths}.items()):
            side = min(CROP, *image.shape[1:3])
            if text != "truth":
                text += f"\n{decibel(float(np.mean((image[pair] - truths[pair]) ** 2))):.1f} dB"
            axes = figure.add_subplot(len(rows), len(images) + 1, row * (len(images) + 1) + column + 1)
            label = "" if column else f"{material.name}, level {level}"
            plot.image_panel(axes, srgb.for_display(image[pair, :side, :side]), text, label)
    return figure


def zoom(contexts: dict, result: dict):
    """Draw frames of the zoom of the first material."""
    material = next(m for m in curves(result).values() if m.best() is not None)
    context = contexts[material.name]
    strips = {text: context.zoom.render(context.jobs[job].model) for text, job in _columns(material)}
    title = f"{result['title']}: {material.name}, a zoom of {context.zoom.frames} frames"
    return context.zoom.figure(title, figure_caption(result), strips, context.zoom.truth)


def _shown(material: MaterialCurves) -> list[tuple[str, float]]:
    """Return λ = 0 and the best λ, each with its remedies."""
    best = material.best()
    return [] if best is None else [(best[0], 0.0), best]


def _columns(material: MaterialCurves) -> list[tuple[str, str]]:
    """Return the columns of crops and rows of zooms: a text, and the name of the job that has a reader."""
    columns = [("parameters filtered", f"{material.name}, filtered")] if "filtered" in material.classical else []
    best = material.best_classical
    if best is not None:
        columns.append((f"{best}, uncompressed", f"{material.name}, {best}"))
    for remedy, share in _shown(material):
        d = material.runs[remedy, share][0]
        columns.append((f"λ {share:g}, compressed", f"{material.name}, lambda {share:g}, {d['way']}, seed {d['seed']}"))
    return columns
