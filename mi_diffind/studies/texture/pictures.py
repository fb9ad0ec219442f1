"""Figures of the texture study: crops of the stills, frames of the zoom, errors of levels."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from ...measure import plot
from ...measure.curves import finish
from ...measure.formatting import figure_caption


def shown(candidates: Iterable) -> list[str]:
    """Return the names of the candidates in figures: bitmaps, uncompressed, ours and ASTC at the first budget."""
    names = [c.name for c in candidates]
    first = [next((n for n in names if n.startswith(s) and n.endswith("anisotropic, centred")), "")
             for s in ("mipmap", "ours", "ASTC")]  # fmt: skip
    return [n for n in ("bitmap, 1 spp", "bitmap, 64 spp", *first) if n in names]


def crops(context, readers: dict, result: dict):
    """Draw an enlarged part of each still, by each of the readers and of the truth."""
    columns, height = [*readers, "truth"], context.settings.film[1]
    side = max(8, height * 2 // 5)
    title = f"{result['title']}: parts of the stills"
    rows = len(context.scenes)
    figure = plot.figure(title, figure_caption(result), 2.3 * len(columns), 2.5 * rows)
    for i, (name, scene) in enumerate(context.scenes.items()):
        counted, truth = context.counted(scene), context.truths[name].model
        part = np.where(counted[..., None], truth, np.nan)
        if not i:  # near the end of the plane
            part[int(np.argmax(counted.any(axis=1))) + side :] = np.nan
        top, left = _busiest(part, side)
        for k, column in enumerate(columns):
            if column == "truth":
                image, title = truth, f"truth\n{context.settings.truth_spp} spp, multijittered"
            else:
                image = context.render(readers[column](), scene, 0)
                title = f"{column}\n{result['candidates'][column]['errors'][f'psnr_{name}_db']:.1f} dB"
            axes = figure.add_subplot(rows, len(columns), i * len(columns) + k + 1)
            plot.image_panel(axes, image[top : top + side, left : left + side], title, "" if k else name)
    return figure


def zoom(context, readers: dict, result: dict):
    """Draw frames of the zoom, by each of the readers and of the truth."""
    strips = {
        name.replace(", anisotropic", ",\nanisotropic"): context.zoom.render(reader())
        for name, reader in readers.items()
    }
    title = f"{result['title']}: a zoom of {context.zoom.frames} frames"
    return context.zoom.figure(title, figure_caption(result), strips, context.truths["zoom"].model)


def levels(context, readers: dict, result: dict):
    """Draw the PSNR of each level of all compressed textures.

    If distributions of footprints are compared, a second panel shows the share of samples on each level.
    """
    compared, count = context.settings.footprints, context.pyramid.levels
    figure = plot.figure(f"{result['title']}: levels of detail", figure_caption(result), 6.4 * (1 + compared), 4.6)
    if compared:
        axes = figure.add_subplot(1, 2, 1)
        for i, (name, shares) in enumerate(histograms(count).items()):
            axes.bar(np.arange(count) + 0.27 * (i - 1), 100 * shares, 0.25, label=name, color=plot.STYLES[i][0])
        axes.legend(fontsize=7.5)
        finish(axes, "nearest level of detail", "% of the samples of a training")
    axes = figure.add_subplot(1, 1 + compared, 1 + compared)
    jobs = {n: r["details"] for n, r in result["jobs"].items() if "levels" in r.get("details", {})}
    for i, (name, details) in enumerate(jobs.items()):
        colour, marker = plot.STYLES[i % len(plot.STYLES)]
        line = {"ASTC with mip maps": ":", "ours": "-"}.get(details["kind"], "--")
        axes.plot(details["levels"]["all"], color=colour, marker=marker, markersize=4, linestyle=line, linewidth=1.1,
                  label=name)  # fmt: skip
    axes.legend(fontsize=7.5)
    finish(axes, "level of detail", "PSNR of all maps at texel centres, dB")
    return figure


def histograms(count: int) -> dict[str, np.ndarray]:
    """Return, for each distribution of footprints, the share of samples nearest to each of ``count`` levels."""
    from ...tasks.texture import nets, training

    ours = {"by level (ours)": training.shares(count)}
    return ours | {name: nets.footprint_histogram(name, count) for name in nets.FOOTPRINTS}


def _busiest(image: np.ndarray, side: int) -> tuple[int, int]:
    """Return row and column of the square with the largest variance, of those without NaN."""
    step = max(1, side // 8)
    places = [
        (t, l) for t in range(0, image.shape[0] - side + 1, step) for l in range(0, image.shape[1] - side + 1, step)
    ]
    parts = (image[top : top + side, left : left + side] for top, left in places)
    variances = [np.nan_to_num(part.var(axis=(0, 1)).sum(), nan=-1) for part in parts]
    return places[int(np.argmax(variances))] if places else (0, 0)


#: Name → figure of a plan: a function of the context, of readers by name, and of the result.
FIGURES = {"crops": crops, "zoom": zoom, "levels": levels}
