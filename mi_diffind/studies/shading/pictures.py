"""
Pictures of the study of shading: quality against λ, the paper's figure 2; quality by level; what is seen; the zoom.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ... import srgb
from ...measure import plot
from ...measure.formatting import machine_line, state
from ..texture.zoom import flicker
from .conclusions import Curves, curves
from .motion import GRID

#: Lines of classical filters: label → style.
CLASSICAL = {"filtered": ":", "kernel": (0, (1, 3)), "Toksvig": (0, (5, 1)), "LEAN": "--", "LEAN, kernel": (0, (6, 2)),
             "baked": "-."}  # fmt: skip

#: Level of detail of the strip, and texels of its crops.
LEVEL, CROP = 3, 48

#: Frames that are shown of the zoom.
FRAMES = 5


def of(settings: dict) -> dict[str, Callable[[dict], object]]:
    """The pictures of a plan, by kind."""
    return {kind: lambda result, draw=draw: draw(settings, result) for kind, draw in _KINDS.items()}


def figure_2(settings: dict, result: dict):
    """A row for each material: PSNR against C and P for each λ, all ways; bars from the worst to the best seed."""
    found = curves(result)
    sheet = plot.figure(result["title"], _caption(result), 12.0, 3.5 * len(found))
    for row, own in enumerate(found.values()):
        for column, letter in enumerate("CP"):
            axes = sheet.add_subplot(len(found), 2, 2 * row + column + 1)
            _shares(axes, own, letter)
            truth = {"C": "converged truth", "P": "the paper's reference"}[letter]
            axes.set_title(f"{own.name}, against {truth} ({letter})", fontsize=9)
            if row == column == 0:
                axes.legend(fontsize=6.5, ncols=2)
    return sheet


def _shares(axes, own: Curves, letter: str) -> None:
    shares = sorted({s for _, s in own.runs})
    place = {s: i for i, s in enumerate(shares)}
    for i, way in enumerate(own.ways):
        colour, marker = plot.STYLES[i % len(plot.STYLES)]
        x = np.array([place[s] for s in own.shares(way)]) + 0.05 * (i - 1.5)
        values = [own.values(way, s, letter) for s in own.shares(way)]
        y = np.array([np.mean(v) for v in values])
        bars = [[a - min(v), max(v) - a] for a, v in zip(y, values, strict=True)]
        axes.errorbar(x, y, np.array(bars).T, color=colour, marker=marker, markersize=4, linewidth=1.1, capsize=2,
                      label=way)  # fmt: skip
        for s, a, b in zip(own.shares(way), x, y, strict=True):
            lost = sum(bool(d.get("trouble")) for d in own.runs[way, s] if s > 0)
            if lost:
                axes.plot(a, b, marker="x", color="black", markersize=9, zorder=5)
                axes.annotate(f"{lost}", (a, b), xytext=(4, -9), textcoords="offset points", fontsize=6.5)
    for i, (label, style) in enumerate(CLASSICAL.items()):
        if label in own.classical:
            axes.axhline(own.classical[label][letter]["mean_db"], linestyle=style, linewidth=1.0, color=f"{0.12 * i}",
                         label=f"{label}, uncompressed")  # fmt: skip
    for label, d in own.compressed.items():
        axes.plot([0], [d[letter]["mean_db"]], marker="*", markersize=8, linestyle="", color="0.3", label=label)
    axes.set_xticks(range(len(shares)), [f"{s:g}" for s in shares])
    axes.set_xlabel("λ, weight of the shading loss (× : runs in trouble, and how many)", fontsize=8)
    _dressed(axes, "PSNR of shaded values, dB")


def levels(settings: dict, result: dict):
    """Quality by level of detail, of λ = 0, the best λ and classical filters."""
    found = curves(result)
    sheet = plot.figure(f"{result['title']}: levels of detail", _caption(result), 12.0, 3.3 * len(found))
    for row, own in enumerate(found.values()):
        for column, letter in enumerate("CP"):
            axes = sheet.add_subplot(len(found), 2, 2 * row + column + 1)
            for i, (label, style) in enumerate(CLASSICAL.items()):
                if label in own.classical:
                    axes.plot(own.classical[label][letter]["psnr_db"], linestyle=style, color=f"{0.12 * i}",
                              linewidth=1.0, label=f"{label}, uncompressed")  # fmt: skip
            for (colour, marker), (way, share) in zip(plot.STYLES, _shown(own), strict=False):
                axes.plot(own.levels(way, share, letter), color=colour, marker=marker, markersize=4, linewidth=1.3,
                          label=f"λ {share:g}")  # fmt: skip
            axes.set_title(f"{own.name}, against {letter}", fontsize=9)
            axes.set_xlabel("level of detail", fontsize=8)
            _dressed(axes, "PSNR of shaded values, dB")
            if row == column == 0:
                axes.legend(fontsize=6.5, ncols=2)
    return sheet


def strip(settings: dict, result: dict):
    """Crops of a minified level: filtered parameters, the best classical filter, λ = 0, the best λ, the truth."""
    found = curves(result)
    rows = [(own, settings[own.name]) for own in found.values() if own.best() is not None]
    sheet = plot.figure(f"{result['title']}: what is seen", _caption(result), 11.5, 2.45 * len(rows))
    for row, (own, setting) in enumerate(rows):
        evaluation = setting.evaluation
        level = min(LEVEL, evaluation.levels - 1)
        truths = evaluation.truths["C"][level].clip(0, 1)
        images = {text: evaluation.images(setting.readers[job](), level).clip(0, 1) for text, job in _columns(own)}
        first = next(iter(images.values()))
        pair = int(np.argmax(((first - truths) ** 2).mean(axis=(1, 2, 3))))  # where filtered parameters err most
        for column, (text, image) in enumerate({**images, "truth": truths}.items()):
            axes = sheet.add_subplot(len(rows), len(images) + 1, row * (len(images) + 1) + column + 1)
            side = min(CROP, *image.shape[1:3])
            axes.imshow(srgb.for_display(image[pair, :side, :side]), interpolation="nearest")
            mse = float(np.mean((image[pair] - truths[pair]) ** 2))
            axes.set_title(text if text == "truth" else f"{text}\n{-10 * np.log10(max(mse, 1e-12)):.1f} dB", fontsize=8)
            axes.set_xticks([])
            axes.set_yticks([])
            if column == 0:
                axes.set_ylabel(f"{own.name}, level {level}", fontsize=8)
    return sheet


def zoom(settings: dict, result: dict):
    """Frames of the zoom of the first material, and on the right one line of the plane in all frames."""
    own = next(own for own in curves(result).values() if own.best() is not None)
    setting = settings[own.name]
    motion = setting.motion
    strips = {text: motion.render(setting.readers[job]()) for text, job in _columns(own)} | {"truth": motion.truth}
    frames = np.unique(np.linspace(0, motion.frames - 1, FRAMES).round().astype(int))
    title = f"{result['title']}: {own.name}, a zoom of {motion.frames} frames"
    sheet = plot.figure(title, _caption(result), 11.0, 1.75 * len(strips))
    grid = sheet.add_gridspec(len(strips), len(frames) + 1)
    truth = motion.aligned(motion.truth).reshape(motion.frames, GRID, GRID, 3)
    line = int(np.argmax(truth[-1].var(axis=1).sum(axis=-1)))  # where there is most to see
    for i, (name, images) in enumerate(strips.items()):
        aligned = motion.aligned(images)
        panels = [images[k] for k in frames] + [aligned.reshape(motion.frames, GRID, GRID, 3)[:, line]]
        for k, image in enumerate(panels):
            axes = sheet.add_subplot(grid[i, k])
            axes.imshow(image.clip(0, 1), interpolation="nearest", aspect="auto" if k == len(frames) else "equal")
            axes.set_xticks([])
            axes.set_yticks([])
            if k == 0:
                axes.set_ylabel(f"{name}\nflicker {flicker(aligned):.1e}", fontsize=7)
            if i == 0:
                text = f"frame {frames[k] + 1}" if k < len(frames) else "a line, frames downwards"
                axes.set_title(text, fontsize=8)
    return sheet


def _shown(own: Curves) -> list[tuple[str, float]]:
    """λ = 0 and the best λ, with its way."""
    best = own.best()
    return [] if best is None else [(best[0], 0.0), best]


def _columns(own: Curves) -> list[tuple[str, str]]:
    """What strips show: a text, and the name of the job that has a reader of it."""
    found = [("parameters filtered", f"{own.name}, filtered")] if "filtered" in own.classical else []
    best = own.best_classical
    if best is not None:
        found.append((f"{best}, uncompressed", f"{own.name}, {best}"))
    for way, share in _shown(own):
        d = own.runs[way, share][0]
        found.append((f"λ {share:g}, compressed", f"{own.name}, lambda {share:g}, {d['way']}, seed {d['seed']}"))
    return found


_KINDS = {"png": figure_2, "levels": levels, "strip": strip, "zoom": zoom}


def _dressed(axes, y_label: str) -> None:
    axes.set_ylabel(y_label, fontsize=8)
    axes.tick_params(labelsize=7.5)
    axes.grid(color="0.92", linewidth=0.5)
    axes.set_axisbelow(True)


def _caption(result: dict) -> str:
    return f"{' '.join(result['notes'])} {machine_line(result)}{state(result)}"
