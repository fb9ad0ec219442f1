"""Comparison of a scene as written with the same scene after a swap of plugins: accuracy and render time.

Learned plugins are replaced by their exact counterparts, or all plugins that have another counterpart, such as
Mitsuba's ``principled``, by that.
"""

from __future__ import annotations

import os
import statistics
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from . import metrics, plugins, scenes
from .files import writable_folder
from .interrupt import interruptible
from .measure import figure_grid


@dataclass
class Comparison:
    """Both images (linear, ``(height, width, 3)``) and the measured figures (see :func:`compare`)."""

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
    """Render ``path`` as written and with counterparts, in turn, pass by pass, with the same random numbers.

    Every learned plugin is replaced by its exact counterpart. ``against`` may name another counterpart, such as
    ``"principled"``: then every plugin that has it is replaced, learned or not.

    Figures: ``against``; ``psnr_db``, ``flip``, ``mae`` of the image as written against the other one;
    ``brightness``, the ratio of their means; the median seconds of a pass of each; ``time_ratio``, written over the
    other: median, minimum and maximum over the ``pairs`` of passes, rendered one after the other. The first pair
    compiles the kernels and counts only if there is no other. ``replaced_plugins``: how many were replaced;
    ``learned_plugins``: how many of these are learned; ``table_bytes``: bytes of the distinct tables that the learned
    ones read. Quote the ratio rather than the quotient of the two medians: a slow phase of the machine slows both
    passes of a pair. Ctrl-C ends the comparison after the current pair of passes; ``spp`` and ``passes`` then state
    how many there were, and ``interrupted`` is true.

    Raises :class:`~mi_diffind.scenes.SceneError`, also if the scene names no plugin with such a counterpart.
    """
    names = plugins.with_counterpart(against)
    if not names:
        others = dict.fromkeys(c.name for plugin in plugins.declared().values() for c in plugin.others)
        raise scenes.SceneError(f'"{against}": no plugin has this counterpart; there are {", ".join(others)}')
    parsed = scenes.ParsedScene(path, defines)
    replaced = parsed.learned_plugins(against)
    if not replaced:
        what = "learned plugin" if against == "exact" else f'plugin that "{against}" can stand for'
        raise scenes.SceneError(f"{path}: names no {what} ({', '.join(names)}), so there is nothing to compare")
    learned = [entry for entry in replaced if entry["plugin"] in plugins.with_counterpart()]
    reference = parsed.load(exact=True, against=against)  # before the other scene, since a counterpart may refuse
    loaded = {"written": parsed.load(), against: reference}
    spp = spp or reference.sensors()[0].sampler().sample_count()
    passes = max(1, min(passes, spp))
    images, seconds, done = dict.fromkeys(loaded, 0), {name: [] for name in loaded}, 0
    with interruptible() as stop, scenes.progress_bar("render", 2 * passes, progress=progress) as bar:
        for i in range(passes):
            n = (i + 1) * spp // passes - done
            for name in loaded if i % 2 == 0 else reversed(loaded):
                image, pass_seconds = scenes.render(loaded[name], n, seed * passes + i)
                images[name] = images[name] + n * image.astype(np.float64)
                seconds[name] += pass_seconds
                bar.update(1)
            done += n
            if stop.is_set():
                break

    requested, spp, passes = spp, done, len(seconds[against])
    written, reference = ((image[..., :3] / spp).astype(np.float32) for image in images.values())
    if written.shape[-1] == 1:
        written, reference = np.repeat(written, 3, -1), np.repeat(reference, 3, -1)
    timed = slice(1, None) if passes > 1 else slice(None)
    ratios = [w / e for w, e in zip(seconds["written"][timed], seconds[against][timed], strict=True)]
    ratio = {"median": statistics.median(ratios), "min": min(ratios), "max": max(ratios), "pairs": len(ratios)}
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
        "time_ratio": ratio,
        "passes": passes,
        "interrupted": done < requested,
        "spp_requested": requested,
        "replaced_plugins": len(replaced),
        "learned_plugins": len(learned),
        "table_bytes": parsed.table_bytes(learned),
    }
    return Comparison(written, reference, figures)


def write(comparison: Comparison, folder: str | os.PathLike) -> dict[str, str]:
    """Write ``comparison.png`` and EXR images into ``folder``, which is created if its parent exists; return the paths.

    The EXR images are ``written.exr``, ``exact.exr`` (or by the name of the other counterpart) and ``error.exr``
    (absolute difference). Raises :class:`~mi_diffind.files.OutputError`.
    """
    folder = writable_folder(folder, create=True)
    error = np.abs(comparison.written - comparison.reference)
    images = {"written": comparison.written, comparison.figures["against"]: comparison.reference, "error": error}
    paths = {name: str(folder / f"{name}.exr") for name in images}
    for name, image in images.items():
        scenes.write_image(paths[name], image)
    paths["figure"] = str(folder / "comparison.png")
    _write_figure(comparison, error.mean(axis=-1), paths["figure"])
    return paths


def _write_figure(comparison: Comparison, error: np.ndarray, path: str) -> None:
    """Write one picture: the scene as written, the other image, a map of their difference, and the figures."""
    learned = " (learned tables)" if comparison.figures["learned_plugins"] else ""
    cells = [
        figure_grid.picture(f"as written{learned}", comparison.written),
        figure_grid.picture(comparison.figures["against"], comparison.reference),
        figure_grid.error_map(error),
        figure_grid.text(summary(comparison.figures)),
    ]
    figure_grid.write(path, cells, 2, error.shape)


def summary(f: dict) -> list[str]:
    """Return the figures as lines of text."""
    ratio = f["time_ratio"]
    pairs = f"median of {ratio['pairs']} pairs of passes in turn, {ratio['min']:.2f} to {ratio['max']:.2f}"
    if ratio["pairs"] == 1:
        pairs = "of one pair of passes" + (", compilation included" if f["passes"] == 1 else "")
    replaced = "1 plugin" if f["replaced_plugins"] == 1 else f"{f['replaced_plugins']} plugins"
    what = "learned" if f["against"] == "exact" else "replaced"
    spp = f"{f['spp']} of {f['spp_requested']} spp (interrupted)" if f["interrupted"] else f"{f['spp']} spp"
    seconds = f["seconds_per_pass"][f["against"]]
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
        f"time        {ratio['median']:.2f} times that of {f['against']} ({seconds:.3g} s a pass)",
        f"            {pairs}",
    ]
