"""
A scene as written beside the same scene with every learned plugin replaced by its exact counterpart: what the
approximation costs in accuracy, and what it takes or saves in time.
"""

from __future__ import annotations

import os
import statistics
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from . import metrics, plugins, scenes
from .files import writable_folder
from .interrupt import interruptible
from .measure import sheet


@dataclass
class Comparison:
    """Both images (linear, ``(height, width, 3)``) and what was measured (see :func:`compare`)."""

    written: np.ndarray
    exact: np.ndarray
    figures: dict


def compare(
    path: str | os.PathLike,
    spp: int | None = None,
    seed: int = 0,
    passes: int = 5,
    progress: bool = True,
    defines: dict[str, str] | None = None,
) -> Comparison:
    """
    Render ``path`` as written and exact, in turn, pass by pass, with the same random numbers.

    Figures: ``psnr_db``, ``flip``, ``mae`` of the image as written against the exact one; the median seconds of a pass
    of each; ``time_ratio``, written over exact: median, minimum and maximum over the ``pairs`` of passes, rendered one
    after the other, but the first pair, which compiles (it counts if there is no other); ``learned_plugins`` and the
    ``table_bytes`` of each distinct table they read. What slows the machine down slows both passes of a pair: the ratio
    is the number to quote, and not that of the two medians. Ctrl-C ends it after the current pair of passes; ``spp``
    and ``passes`` then say how many there were, and ``interrupted`` is true.

    Raises :class:`~mi_diffind.scenes.SceneError`, also if the scene names no learned plugin.
    """
    learned = scenes.learned_plugins(path, defines=defines)
    if not learned:
        names = ", ".join(plugins.EXACT_COUNTERPARTS)
        raise scenes.SceneError(f"{path}: names no learned plugin ({names}), so there is nothing to compare")
    loaded = {"written": scenes.load(path, defines=defines), "exact": scenes.load(path, exact=True, defines=defines)}
    spp = spp or loaded["written"].sensors()[0].sampler().sample_count()
    passes = max(1, min(passes, spp))
    images, seconds, done = {}, {name: [] for name in loaded}, 0
    bar = tqdm(total=2 * passes, desc="render", unit="pass", disable=None if progress else True)
    with interruptible() as stop, bar:
        for i in range(passes):
            n = (i + 1) * spp // passes - done
            for name in loaded if i % 2 == 0 else reversed(loaded):
                image, took = scenes.render(loaded[name], n, seed * passes + i)
                images[name] = images.get(name, 0) + n * image.astype(np.float64)
                seconds[name] += took
                bar.update(1)
            done += n
            if stop.is_set():
                break

    requested, spp, passes = spp, done, len(seconds["exact"])
    written, exact = ((images[name][..., :3] / spp).astype(np.float32) for name in ("written", "exact"))
    if written.shape[-1] == 1:
        written, exact = np.repeat(written, 3, -1), np.repeat(exact, 3, -1)
    timed = slice(1, None) if passes > 1 else slice(None)
    ratios = [w / e for w, e in zip(seconds["written"][timed], seconds["exact"][timed], strict=True)]
    figures = {
        "scene": str(path),
        "variant": mi.variant(),
        "spp": spp,
        "seed": seed,
        "width": written.shape[1],
        "height": written.shape[0],
        **metrics.compare(exact, written),
        "seconds_per_pass": {name: statistics.median(seconds[name][timed]) for name in loaded},
        "seconds_first_pass": {name: seconds[name][0] for name in loaded},
        "time_ratio": {
            "median": statistics.median(ratios),
            "min": min(ratios),
            "max": max(ratios),
            "pairs": len(ratios),
        },
        "passes": passes,
        "interrupted": done < requested,
        "spp_requested": requested,
        "learned_plugins": len(learned),
        "table_bytes": scenes.table_bytes(path, learned),
    }
    return Comparison(written, exact, figures)


def write(comparison: Comparison, folder: str | os.PathLike) -> dict[str, str]:
    """
    Write ``comparison.png`` and the EXRs ``written.exr``, ``exact.exr``, ``error.exr`` (absolute difference) into
    ``folder``, which is made if its parent exists. Returns the paths. Raises :class:`OutputError`.
    """
    folder = writable_folder(folder, create=True)
    images = {
        "written": comparison.written,
        "exact": comparison.exact,
        "error": np.abs(comparison.written - comparison.exact),
    }
    paths = {}
    for name, image in images.items():
        paths[name] = str(folder / f"{name}.exr")
        scenes.write_image(paths[name], image)
    paths["figure"] = str(folder / "comparison.png")
    figure(comparison, paths["figure"])
    return paths


def figure(comparison: Comparison, path: str | os.PathLike) -> None:
    """One picture to judge at a glance: as written, exact, error map with a colour bar, numbers."""
    error = np.abs(comparison.written - comparison.exact).mean(axis=-1)
    top = max(float(np.quantile(error, 0.995)), 1e-6)
    title = "absolute difference, mean of the channels (linear)"
    cells = [
        sheet.picture("as written (learned tables)", comparison.written),
        sheet.picture("exact", comparison.exact),
        sheet.colour_map(title, error, "max", cmap="magma", vmin=0, vmax=top),
        sheet.text(summary(comparison.figures)),
    ]
    sheet.write(path, cells, 2, error.shape)


def summary(f: dict) -> list[str]:
    """The figures as lines of text."""
    ratio = f["time_ratio"]
    pairs = f"median of {ratio['pairs']} pairs of passes in turn, {ratio['min']:.2f} to {ratio['max']:.2f}"
    if ratio["pairs"] == 1:
        pairs = "of one pair of passes" + (", compilation included" if f["passes"] == 1 else "")
    learned = "1 plugin" if f["learned_plugins"] == 1 else f"{f['learned_plugins']} plugins"
    spp = f"{f['spp']} of {f['spp_requested']} spp (interrupted)" if f["interrupted"] else f"{f['spp']} spp"
    return [
        f"scene       {Path(f['scene']).name}, {f['width']} x {f['height']}, {spp}",
        f"variant     {f['variant']}",
        f"learned     {learned}, {f['table_bytes']:,} bytes of tables",
        "",
        f"PSNR        {f['psnr_db']:.2f} dB   (linear, clipped to [0, 1])",
        f"FLIP        {f['flip']:.4f}     (0 = equal to the eye)",
        f"MAE         {f['mae']:.5f}",
        "",
        f"time        {ratio['median']:.2f} times that of exact ({f['seconds_per_pass']['exact']:.3g} s a pass)",
        f"            {pairs}",
    ]
