"""Pictures of the study of filtered textures: crops of the stills, and a strip of the zoom with its slice of time."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from ...measure import plot
from ...measure.formatting import machine_line, state
from .zoom import GRID, flicker

#: Frames of a strip.
FRAMES = 5


def shown(candidates: Iterable) -> list[str]:
    """The names of the candidates that pictures show: bitmaps, uncompressed, ours and ASTC at the first size."""
    names = [c.name for c in candidates]
    first = [next((n for n in names if n.startswith(s) and n.endswith("anisotropic, centred")), "")
             for s in ("mipmap", "ours", "ASTC")]  # fmt: skip
    return [n for n in ("bitmap, 1 spp", "bitmap, 64 spp", *first) if n in names]


def of(setting, readers: dict[str, Callable]) -> dict[str, Callable[[dict], object]]:
    """The pictures of a plan: ``crops``, ``zoom``, ``levels``."""
    return {kind: lambda result, draw=draw: draw(setting, readers, result) for kind, draw in _KINDS.items()}


def crops(setting, readers: dict, result: dict):
    """A part of each stage, enlarged, by each of the readers and as it truly is."""
    names = list(setting.stages)
    columns = [*readers, "truth"]
    height = setting.request.film[1]
    side = max(8, height * 2 // 5)
    title = f"{result['title']}: parts of the stills"
    found = plot.figure(title, _caption(result), 2.3 * len(columns), 2.5 * len(names))
    for i, (name, stage) in enumerate(setting.stages.items()):
        counted = setting.counted(stage)
        part = np.where(counted[..., None], setting.truths[name], np.nan)
        if not i:  # where the plane ends
            part[int(np.argmax(counted.any(axis=1))) + side :] = np.nan
        top, left = _busiest(part, side)
        for k, column in enumerate(columns):
            if column == "truth":
                image, title = setting.truths[name], f"truth\n{setting.request.truth_spp} spp, multijittered"
            else:
                image = setting.render(readers[column](), stage, 0)
                title = f"{column}\n{result['candidates'][column]['errors'][f'psnr_{name}_db']:.1f} dB"
            axes = found.add_subplot(len(names), len(columns), i * len(columns) + k + 1)
            axes.imshow(image[top : top + side, left : left + side], vmin=0, vmax=1, interpolation="nearest")
            axes.set_title(title, fontsize=8)
            axes.set_xticks([])
            axes.set_yticks([])
            if k == 0:
                axes.set_ylabel(name, fontsize=9)
    return found


def zoom(setting, readers: dict, result: dict):
    """Frames of the zoom by each of the readers, and on the right the same line of the plane in all frames."""
    motion = setting.zoom
    strips = {name: motion.render(reader()) for name, reader in readers.items()} | {"truth": setting.truths["zoom"]}
    frames = np.unique(np.linspace(0, motion.frames - 1, FRAMES).round().astype(int))
    rows, columns = len(strips), len(frames) + 1
    title = f"{result['title']}: a zoom of {motion.frames} frames"
    found = plot.figure(title, _caption(result), 2.2 * columns, 1.55 * rows)
    grid = found.add_gridspec(rows, columns)
    truth = motion.aligned(strips["truth"]).reshape(motion.frames, GRID, GRID, 3)
    row = int(np.argmax(truth[0].var(axis=1).sum(axis=-1)))  # where there is most to see
    for i, (name, strip) in enumerate(strips.items()):
        aligned = motion.aligned(strip)
        text = f"{name}\nflicker {flicker(aligned):.1e}".replace(", anisotropic", ",\nanisotropic")
        for k, frame in enumerate(frames):
            axes = found.add_subplot(grid[i, k])
            axes.imshow(strip[frame], vmin=0, vmax=1, interpolation="nearest")
            _bare(axes, text if k == 0 else "")
            if i == 0:
                axes.set_title(f"frame {frame + 1}", fontsize=8)
        axes = found.add_subplot(grid[i, columns - 1])
        slices = aligned.reshape(motion.frames, GRID, GRID, 3)[:, row]
        axes.imshow(slices.clip(0, 1), interpolation="nearest", aspect="auto")
        _bare(axes, "")
        if i == 0:
            axes.set_title("a line of the plane, frames downwards", fontsize=8)
    return found


def levels(setting, readers: dict, result: dict):
    """
    The quality of each level of all that was made; where distributions of footprints were compared, also the share of
    their samples on each level.
    """
    known = {n: r["details"] for n, r in result["jobs"].items() if "levels" in r.get("details", {})}
    compared = setting.request.footprints
    title = f"{result['title']}: levels of detail"
    found = plot.figure(title, _caption(result), 6.4 * (1 + compared), 4.6)
    if compared:
        axes = found.add_subplot(1, 2, 1)
        count = setting.pyramid.levels
        for i, (kind, shares) in enumerate(histograms(count).items()):
            axes.bar(np.arange(count) + 0.27 * (i - 1), 100 * shares, 0.25, label=kind, color=plot.STYLES[i][0])
        _levels(axes, "nearest level of detail", "% of the samples of a training")
    axes = found.add_subplot(1, 1 + compared, 1 + compared)
    for i, (name, details) in enumerate(known.items()):
        colour, marker = plot.STYLES[i % len(plot.STYLES)]
        line = {"ASTC with mip maps": ":", "ours": "-"}.get(details["kind"], "--")
        values = details["levels"]["all"]
        axes.plot(values, color=colour, marker=marker, markersize=4, linestyle=line, linewidth=1.1, label=name)
    _levels(axes, "level of detail", "PSNR of all maps at texel centres, dB")
    return found


def histograms(count: int) -> dict[str, np.ndarray]:
    """Distributions of footprints: the share of their samples that is nearest to each of ``count`` levels."""
    from ...tasks.texture import sampling, training

    own = {"by level (ours)": training.shares(count)}
    return own | {kind: sampling.footprint_histogram(kind, count) for kind in sampling.FOOTPRINTS}


def _levels(axes, x_label: str, y_label: str) -> None:
    axes.set_xlabel(x_label, fontsize=9)
    axes.set_ylabel(y_label, fontsize=9)
    axes.tick_params(labelsize=8)
    axes.grid(color="0.92", linewidth=0.5)
    axes.set_axisbelow(True)
    axes.legend(fontsize=7.5)


def _busiest(image: np.ndarray, side: int) -> tuple[int, int]:
    """Row and column of the square with the most variance, of those within the image (NaN: outside)."""
    best, place = -1.0, (0, 0)
    for top in range(0, image.shape[0] - side + 1, max(1, side // 8)):
        for left in range(0, image.shape[1] - side + 1, max(1, side // 8)):
            part = image[top : top + side, left : left + side]
            spread = float(np.nan_to_num(part.var(axis=(0, 1)).sum(), nan=-1))
            if spread > best:
                best, place = spread, (top, left)
    return place


_KINDS = {"crops": crops, "zoom": zoom, "levels": levels}


def _bare(axes, label: str) -> None:
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_ylabel(label, fontsize=7)


def _caption(result: dict) -> str:
    return f"{' '.join(result['notes'])} {machine_line(result)}{state(result)}"
