"""
A scene as written beside the same scene with every learned plugin replaced by its exact counterpart: what the
approximation costs in accuracy, and what it takes or saves in time. Or, with another counterpart, such as Mitsuba's
``principled``: how one model differs from another.
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
from .measure import figure_grid


@dataclass
class Comparison:
    """Both images (linear, ``(height, width, 3)``) and what was measured (see :func:`compare`)."""

    written: np.ndarray
    reference: np.ndarray
    figures: dict


def compare(
    path: str | os.PathLike,
    spp: int | None = None,
    seed: int = 0,
    passes: int = 5,
    progress: bool = True,
    defines: dict[str, str] | None = None,
    against: str = "exact",
) -> Comparison:
    """
    Render ``path`` as written and exact, in turn, pass by pass, with the same random numbers. ``against`` may name
    another counterpart, such as ``"principled"``, that every plugin which has it is replaced by, learned or not.

    Figures: ``against``; ``psnr_db``, ``flip``, ``mae`` of the image as written against the other one, and
    ``brightness``, the ratio of their means; the median seconds of a pass of each; ``time_ratio``, written over the
    other: median, minimum and maximum over the ``pairs`` of passes, rendered one after the other, but the first pair,
    which compiles (it counts if there is no other); ``replaced_plugins``, how many; how many of them are
    ``learned_plugins``, and the ``table_bytes`` of each distinct table these read. What slows the machine down slows
    both passes of a pair: the ratio is the number to quote, and not that of the two medians. Ctrl-C ends it after the
    current pair of passes; ``spp`` and ``passes`` then say how many there were, and ``interrupted`` is true.

    Raises :class:`~mi_diffind.scenes.SceneError`, also if the scene names no plugin with such a counterpart.
    """
    names = plugins.with_counterpart(against)
    if not names:
        others = dict.fromkeys(c.name for plugin in plugins.declared().values() for c in plugin.others)
        raise scenes.SceneError(f'"{against}": no plugin has this counterpart; there are {", ".join(others)}')
    replaced = scenes.learned_plugins(path, defines, against)
    if not replaced:
        what = "learned plugin" if against == "exact" else f'plugin that "{against}" can stand for'
        raise scenes.SceneError(f"{path}: names no {what} ({', '.join(names)}), so there is nothing to compare")
    learned = [entry for entry in replaced if entry["plugin"] in plugins.with_counterpart()]
    reference = scenes.load(path, exact=True, defines=defines, against=against)  # may refuse, and is so asked first
    loaded = {"written": scenes.load(path, defines=defines), against: reference}
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

    requested, spp, passes = spp, done, len(seconds[against])
    written, reference = ((images[name][..., :3] / spp).astype(np.float32) for name in loaded)
    if written.shape[-1] == 1:
        written, reference = np.repeat(written, 3, -1), np.repeat(reference, 3, -1)
    timed = slice(1, None) if passes > 1 else slice(None)
    ratios = [w / e for w, e in zip(seconds["written"][timed], seconds[against][timed], strict=True)]
    figures = {
        "scene": str(path),
        "variant": mi.variant(),
        "spp": spp,
        "seed": seed,
        "width": written.shape[1],
        "height": written.shape[0],
        "against": against,
        **metrics.compare(reference, written),
        "brightness": float(written.mean(dtype=np.float64) / max(reference.mean(dtype=np.float64), 1e-30)),
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
        "replaced_plugins": len(replaced),
        "learned_plugins": len(learned),
        "table_bytes": scenes.table_bytes(path, learned),
    }
    return Comparison(written, reference, figures)


def write(comparison: Comparison, folder: str | os.PathLike) -> dict[str, str]:
    """
    Write ``comparison.png`` and the EXRs ``written.exr``, ``exact.exr`` (or by the name of the other counterpart) and
    ``error.exr`` (absolute difference) into ``folder``, which is made if its parent exists. Returns the paths. Raises
    :class:`OutputError`.
    """
    folder = writable_folder(folder, create=True)
    images = {
        "written": comparison.written,
        comparison.figures["against"]: comparison.reference,
        "error": np.abs(comparison.written - comparison.reference),
    }
    paths = {}
    for name, image in images.items():
        paths[name] = str(folder / f"{name}.exr")
        scenes.write_image(paths[name], image)
    paths["figure"] = str(folder / "comparison.png")
    figure(comparison, paths["figure"])
    return paths


def figure(comparison: Comparison, path: str | os.PathLike) -> None:
    """One picture to judge at a glance: as written, the other, error map with a colour bar, numbers."""
    error, against = np.abs(comparison.written - comparison.reference).mean(axis=-1), comparison.figures["against"]
    top = max(float(np.quantile(error, 0.995)), 1e-6)
    title = "absolute difference, mean of the channels (linear)"
    learned = " (learned tables)" if comparison.figures["learned_plugins"] else ""
    cells = [
        figure_grid.picture(f"as written{learned}", comparison.written),
        figure_grid.picture(against, comparison.reference),
        figure_grid.colour_map(title, error, "max", cmap="magma", vmin=0, vmax=top),
        figure_grid.text(summary(comparison.figures)),
    ]
    figure_grid.write(path, cells, 2, error.shape)


def summary(f: dict) -> list[str]:
    """The figures as lines of text."""
    ratio = f["time_ratio"]
    pairs = f"median of {ratio['pairs']} pairs of passes in turn, {ratio['min']:.2f} to {ratio['max']:.2f}"
    if ratio["pairs"] == 1:
        pairs = "of one pair of passes" + (", compilation included" if f["passes"] == 1 else "")
    replaced = "1 plugin" if f["replaced_plugins"] == 1 else f"{f['replaced_plugins']} plugins"
    what = "learned" if f["against"] == "exact" else "replaced"
    spp = f"{f['spp']} of {f['spp_requested']} spp (interrupted)" if f["interrupted"] else f"{f['spp']} spp"
    return [
        f"scene       {Path(f['scene']).name}, {f['width']} x {f['height']}, {spp}",
        f"variant     {f['variant']}",
        f"{what:12}{replaced}, {f['table_bytes']:,} bytes of tables",
        "",
        f"PSNR        {f['psnr_db']:.2f} dB   (linear, clipped to [0, 1])",
        f"FLIP        {f['flip']:.4f}     (0 = equal to the eye)",
        f"MAE         {f['mae']:.5f}",
        f"brightness  {f['brightness']:.4f} of that of {f['against']}",
        "",
        f"time        {ratio['median']:.2f} times that of {f['against']} "
        f"({f['seconds_per_pass'][f['against']]:.3g} s a pass)",
        f"            {pairs}",
    ]
