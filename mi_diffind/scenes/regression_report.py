"""Results of regression checks as sentences, pictures and files."""

from __future__ import annotations

import os
import tempfile
import textwrap
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..core.files import writable_folder
from ..measure import plot as figure_grid
from . import loading
from .block_test import CHECK_PASSES, Block, BlockTest, Level


@dataclass
class Regression:
    """Result of :func:`.regression.regress`: its ``figures``, and of a check ``image``, ``reference`` and ``test``.

    Images are linear ``(height, width, channels)``; an interrupted check and an update of a reference have none.
    """

    figures: dict
    image: np.ndarray | None = field(default=None, repr=False)
    reference: np.ndarray | None = field(default=None, repr=False)
    test: BlockTest | None = field(default=None, repr=False)

    @property
    def passed(self) -> bool | None:
        """Whether the check passed; ``None`` without a verdict."""
        return self.figures.get("passed")

    @property
    def images(self) -> dict[str, np.ndarray]:
        """The ``image``, the ``reference``, the ``error`` (absolute difference) and ``t`` of :func:`t_map`."""
        if self.test is None:
            return {}
        error = np.abs(self.image - self.reference)
        t = t_map(self.test.worst_level, self.image.shape)
        return {"image": self.image, "reference": self.reference, "error": error, "t": np.float32(t)}

    def __str__(self) -> str:
        return "\n".join(update_summary(self.figures) if "budget" in self.figures else summary([self.figures]))

    def _repr_png_(self) -> bytes | None:
        if self.test is None:
            return None
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "check.png"
            _write_figure(str(path), self)
            return path.read_bytes()


def t_map(level: Level, shape: tuple[int, ...]) -> np.ndarray:
    """Return t of each pixel and channel, ``shape``: the largest amount of the windows that cover the pixel."""
    parts, t = level.side // level.stride, level.t
    rows, columns = (n + parts - 1 for n in t.shape[:2])
    cells = np.zeros((rows, columns, t.shape[2]))
    for row in range(parts):
        for column in range(parts):
            covered = cells[row : row + t.shape[0], column : column + t.shape[1]]
            np.copyto(covered, t, where=np.abs(t) > np.abs(covered))
    pixels = cells.repeat(level.stride, axis=0).repeat(level.stride, axis=1)
    return pixels[: shape[0], : shape[1]]


def write_failure(folder: str | os.PathLike, result: Regression) -> dict[str, str]:
    """Write the images of a failed check into ``folder``, which is created if its parent exists, and return the paths.

    These are ``SCENE.VARIANT.image.exr``, ``….reference.exr``, ``….error.exr`` (absolute difference), ``….t.exr`` and a
    picture of all, ``….png``. Raises :class:`.OutputError`.
    """
    folder = writable_folder(folder, create=True)
    stem = f"{Path(result.figures['scene']).stem}.{result.figures['variant']}"
    images = result.images
    paths = {name: str(folder / f"{stem}.{name}.exr") for name in images}
    for name, content in images.items():
        loading.write_image(paths[name], content)
    paths["figure"] = str(folder / f"{stem}.png")
    _write_figure(paths["figure"], result)
    return paths


def verdict(figures: dict) -> str:
    """Return the outcome of a check in one word: ``passed``, ``FAILED`` or ``interrupted``."""
    return "interrupted" if figures["interrupted"] else "passed" if figures["passed"] else "FAILED"


def power(figures: dict) -> str:
    """Return the change that a check finds nine times of ten, as the end of a sentence."""
    width, height = (min(figures["tile"], figures[side]) for side in ("width", "height"))
    change = figures["visible_change"]
    amount = "no change" if change is None else f"{100 * change:.2g}%"
    return f"{amount} of brightness in a tile of {width} x {height} nine times of ten"


def reasons(figures: dict) -> list[str]:
    """Return the reasons for which a check failed, as parts of a sentence."""
    parts = []
    if figures["not_finite"]:
        parts.append(f"{figures['not_finite']} pixel(s) are not finite")
    if figures["failing_blocks"]:
        worst = figures["worst"]
        parts.append(f"block of {Block(**worst)}, t = {worst['t']:.1f}, {worst['channel']}")
    if figures["stops"] > figures["stops_threshold"]:
        measured, threshold = figures["stops"], figures["stops_threshold"]
        parts.append(f"off by {measured:.3g} stops on average, noise by {threshold:.3g} at most")
    return parts


def summary(results: list[dict]) -> list[str]:
    """Return the results of checks as lines of text: one for each scene, and the picture of each failure."""
    names = [Path(r["scene"]).stem for r in results]
    width = max((len(n) for n in names), default=0)
    lines = []
    for name, r in zip(names, results, strict=True):
        line = f"{verdict(r):11} {name:{width}}  {r['variant']}, {r['width']} x {r['height']}, {r['spp']} spp"
        if not r["interrupted"]:
            line += f": would have seen {power(r)}" if r["passed"] else f": {'; '.join(reasons(r))}"
        lines.append(line)
        if r["files"]:
            lines.append(f"{'':11} {'':{width}}  see {r['files']['figure']}")
    return lines


def update_summary(figures: dict) -> list[str]:
    """Return the result of :func:`.regression.update_reference` as lines of text."""
    if figures["interrupted"]:
        return ["{partial}: {spp} samples a pixel are kept, the same command goes on".format(**figures)]
    asked = "" if figures["asked_spp"] == figures["budget"] else f" (asked for {figures['asked_spp']})"
    text = "{reference}: {width} x {height}, {spp} spp, {bytes:,} bytes; a check has {budget} spp" + asked
    return [f"{text.format(**figures)} and would see {power(figures)}"]


def _wrap(title: str, text: str) -> list[str]:
    return textwrap.wrap(f"{title:11} {text}", 58, subsequent_indent=" " * 12)


def _write_figure(path: str, result: Regression) -> None:
    """Write one picture: image, reference and figures above; error, t and failing blocks below."""
    figures, images, test = result.figures, result.images, result.test
    worst, level = test.worst, test.worst_level
    marked = np.repeat(np.clip(images["reference"], 0, 1).mean(axis=-1, keepdims=True) * 0.3, 3, axis=-1)
    failing = (np.abs(images["t"]) > level.threshold) | ~np.isfinite(images["image"])
    marked[failing.any(axis=-1)] = (1, 0.1, 0.6)
    largest = np.abs(images["t"]).argmax(axis=-1)[..., None]
    lines = [
        f"scene       {Path(figures['scene']).name}, {figures['width']} x {figures['height']}",
        f"variant     {figures['variant']}",
        f"samples     {figures['spp']} a pixel in {CHECK_PASSES} passes, seed {figures['seed']}",
        f"reference   {figures['reference_spp']} samples a pixel",
        "",
        f"{verdict(figures):11} {figures['failing_blocks']} of {figures['blocks']} blocks of all sizes fail",
        *_wrap("", "; ".join(reasons(figures))),
        *_wrap("power", f"finds {power(figures)}"),
    ]
    blocks = f"blocks of {level.side} x {level.side}"
    frame = (worst.x, worst.y, worst.width, worst.height)
    cells = [
        figure_grid.picture("image", images["image"]),
        figure_grid.picture("reference", images["reference"], frame),
        figure_grid.text(lines),
        figure_grid.error_map(np.nan_to_num(images["error"].mean(axis=-1))),
        figure_grid.colour_map(
            f"t of {blocks}, red: brighter (threshold {level.threshold:.1f})",
            np.take_along_axis(images["t"], largest, axis=-1)[..., 0],
            "both", cmap="RdBu_r", vmin=-2 * level.threshold, vmax=2 * level.threshold,
        ),
        figure_grid.picture(f"{blocks} that fail, over the reference; frame: the worst", marked, frame),
    ]  # fmt: skip
    figure_grid.write(path, cells, 3, images["image"].shape)
