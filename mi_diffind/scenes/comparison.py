"""Comparison of a scene as written with the same scene after a swap of plugins: accuracy and render time.

Learned plugins are replaced by their exact counterparts, or all plugins that have another counterpart, such as
Mitsuba's ``principled``, by that.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import plugins
from ..core import compat
from ..core.errors import UsageError
from ..core.files import writable_folder
from ..core.progress import interruptible, progress_bar
from ..core.runtime import use_variant
from ..images import metrics
from ..measure import plot as figure_grid
from ..measure.statistics import spread
from ..plugins.support import footprint
from . import conversion, loading

#: Pairs of passes that a ratio of times needs.
PAIRS = 3

#: Largest ratio of the quartiles of the ratios of times: beyond, none is given.
WIDEST = 1.5

#: Side of the zoomed window over the side of the picture.
ZOOM = 1 / 8

#: Smallest width or height of the zoomed window in pixels.
SMALLEST = 8


@dataclass
class Comparison:
    """Both images (linear, ``(height, width, 3)``) and the measured figures (see :func:`compare`).

    ``further``: comparisons of the same image with further truths.
    """

    written: np.ndarray = field(repr=False)
    reference: np.ndarray = field(repr=False)
    figures: dict
    further: tuple[Comparison, ...] = ()

    @property
    def truth(self) -> str:
        """Name of the truth, the plugins that it is rendered with, and its samples: ``exact (disney), 32 spp``."""
        name, put_in = self.figures["against"], ", ".join(self.figures["counterparts"])
        return f"{name}{'' if put_in == name else f' ({put_in})'}, {self.figures['truth_spp']} spp"

    def save(self, folder: str | os.PathLike) -> dict[str, str]:
        """Write ``comparison.png`` and EXR images into ``folder``, made if its parent exists, and return the paths.

        The EXR images are ``written.exr``, ``exact.exr`` (or by the name of the other counterpart) and ``error.exr``
        (absolute difference; with several truths ``error_NAME.exr``). Raises :class:`.OutputError`.
        """
        folder = writable_folder(folder, create=True)
        images = {"written": self.written}
        for one in (self, *self.further):
            name = one.figures["against"]
            images[name] = one.reference
            images[f"error_{name}" if self.further else "error"] = np.abs(one.written - one.reference)
        paths = {name: str(folder / f"{name}.exr") for name in images}
        for name, image in images.items():
            loading.write_image(paths[name], image)
        paths["figure"] = str(folder / "comparison.png")
        self._write_figure(paths["figure"])
        return paths

    def _write_figure(self, path: str | os.PathLike) -> None:
        """Write one picture.

        Two rows for each truth show the truth, the scene as written and their difference: above as a whole, below its
        worst place. The last row has the figures.
        """
        learned = " (learned tables)" if self.figures["learned_plugins"] else ""
        written, cells = "learned plugins" if self.figures["conversions"] else f"as written{learned}", []
        for one in (self, *self.further):
            x, y, width, height = frame = tuple(one.figures["worst"][key] for key in ("x", "y", "width", "height"))
            inside, place = np.s_[y : y + height, x : x + width], f"{width} x {height} pixels from ({x}, {y})"
            zoomed = one.reference[inside], one.written[inside]
            cells += [
                figure_grid.picture(one.truth, one.reference, frame),
                figure_grid.picture(f"{written}, {one.figures['spp']} spp", one.written, frame),
                figure_grid.error_map(np.abs(one.written - one.reference).mean(axis=-1)),
                figure_grid.picture(f"{one.truth}, worst place: {place}", zoomed[0]),
                figure_grid.picture(f"{written}, worst place", zoomed[1]),
                figure_grid.error_map(_clipped_error(*zoomed), "worst place, difference clipped to [0, 1]"),
            ]
        cells += [figure_grid.text(lines) for lines in self._sections()]
        figure_grid.write(path, cells, 3, self.written.shape)

    def _sections(self) -> list[list[str]]:
        """Return the lines about the scene, and those about each truth."""
        f = self.figures
        replaced = "1 plugin" if f["replaced_plugins"] == 1 else f"{f['replaced_plugins']} plugins"
        what = "learned" if f["learned_plugins"] == f["replaced_plugins"] else "replaced"
        head = [
            f"scene       {Path(f['scene']).name}, {f['width']} x {f['height']}, {loading.samples_text(f)}",
            f"variant     {f['variant']}",
            f"{what:12}{replaced}, {f['table_bytes']:,} bytes of tables",
        ]
        return [head, *([f"against     {one.truth}", *_lines(one.figures)] for one in (self, *self.further))]

    def __str__(self) -> str:
        head, *blocks = self._sections()
        head += conversion.summary(self.figures["conversions"])
        return "\n".join([*head, *(line for lines in blocks for line in ("", *lines))])

    def _repr_png_(self) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "comparison.png"
            self._write_figure(path)
            return path.read_bytes()


class _Side:
    """Scene, its passes so far and their times: ``oversampling`` times the samples of the scene as written.

    ``name`` is that of the picture in a sentence.
    """

    def __init__(self, scene, oversampling: int = 1, name: str = "the picture"):
        self.scene, self.name, self.oversampling = scene, name, oversampling
        self.halves, self.samples = [0.0, 0.0], [0, 0]
        self.seconds: list[float] = []
        self.compiled: list[bool] = []

    def render(self, spp: int, seed: int, on_pass) -> None:
        """Render one pass of ``spp`` samples, and further ones of as many where the side is oversampled."""
        spp = loading.sample_counts(self.scene, spp)[0]
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            image, seconds = loading.render(self.scene, spp * self.oversampling, seed, self.oversampling, on_pass)
            self.compiled.append(compat.was_compiled(dr.kernel_history()))
        if count := metrics.nonfinite_pixels(image):
            raise loading.SceneError(f"{self.name}: {count:,} of {math.prod(image.shape[:2]):,} pixels are not finite")
        image = image[..., :3].astype(np.float64)
        half = len(self.seconds) % 2
        self.halves[half] = self.halves[half] + spp * np.repeat(image, 3 // image.shape[-1], -1)
        self.samples[half] += spp
        self.seconds.append(seconds[0])

    @property
    def image(self) -> np.ndarray:
        """Mean of all samples, float32."""
        return (sum(self.halves) / sum(self.samples)).astype(np.float32)


@dataclass
class ComparedScenes:
    """Scenes that are compared: the one as ``written``, and its ``truths`` by name, the exact one last.

    For each truth, ``put_in`` lists the plugins that replace others, and ``oversampling`` is the multiple of samples
    that it is rendered with. ``replaced`` and ``learned`` describe the plugins of the scene as written,
    ``conversions`` what became of Mitsuba's plugins.
    """

    parsed: loading.ParsedScene
    written: object
    truths: dict[str, object]
    put_in: dict[str, list[str]]
    oversampling: dict[str, int]
    replaced: list[dict]
    learned: list[dict]
    conversions: list[conversion.Conversion]


def load_compared(
    scene, against: str | None = None, learn: Sequence[str] = (), defines=None, progress: bool = True
) -> ComparedScenes:
    """Load a scene as written and with counterparts; arguments and errors as of :func:`compare`."""
    use_variant()
    loading.check_counterpart(against or "exact")
    parsed = loading.ParsedScene(scene, defines)
    if learn and parsed.description:
        raise UsageError("learn: given with a scene in memory, allowed are scene files")
    conversions = conversion.replace_stock(parsed, learn, progress=progress)
    replaced = parsed.learned_plugins(against or "exact")
    if not replaced and (against or not any(c.learned for c in conversions)):
        what = f'plugin that "{against}" can stand for' if against not in (None, "exact") else "learned plugin"
        names = ", ".join(plugins.with_counterpart(against or "exact"))
        kept = "".join(f"; kept is {c}" for c in conversions if not c.learned)
        raise loading.SceneError(f"{parsed.path}: names no {what} ({names}), so there is nothing to compare{kept}")
    learned = [entry for entry in replaced if entry["plugin"] in plugins.with_counterpart()]
    declared, truths, put_in, oversampling = plugins.declared(), {}, {}, {}
    for name, names in ({against: (against,)} if against else _default_truths(replaced, learn)).items():
        counterparts = [declared[entry["plugin"]].counterpart(names) for entry in replaced]
        plugins_put_in = [c.name for c in counterparts]
        if learn and not against and name == "exact":
            name, plugins_put_in = "stock", [c.stock for c in conversions if c.learned]
            truths[name] = loading.load(scene, defines)
        else:  # before the scene as written, since a counterpart may refuse
            truths[name] = parsed.load(exact=True, against=names)
        put_in[name] = list(dict.fromkeys(plugins_put_in))
        oversampling[name] = max((c.oversampling for c in counterparts), default=1)
    return ComparedScenes(parsed, parsed.load(), truths, put_in, oversampling, replaced, learned, conversions)


def compare(
    scene: str | os.PathLike | dict,
    spp: int | None = None,
    seed: int = 0,
    *,
    passes: int = 5,
    against: str | None = None,
    learn: Sequence[str] = (),
    defines: Mapping[str, object] | None = None,
    progress: bool = True,
) -> Comparison:
    """Render a scene as written and with counterparts, in turn, pass by pass, with the same random numbers.

    - ``scene``: a scene file or a dictionary as of ``mi.load_dict``; ``defines``: values of the file's ``<default>``.
    - ``spp``: samples a pixel (``None``: the scene's), split into ``passes``: at least two, unless there is one
      sample.
    - ``against``: counterpart that replaces every plugin that has it, learned or not, such as ``"principled"``.
      Without it, every learned plugin is replaced by its exact counterpart, and a scene with plugins that declare
      several truths (``neural_texture``: ``mipmap``, which filters as it does, and ``exact``, a ``bitmap`` of 8 times
      the samples) is compared with each of them (``further``).
    - ``learn``: groups of Mitsuba's plugins (:func:`.conversion.words`) that learned ones replace before the scene is
      rendered "as written"; the scene of the file is then the truth ``stock``, in place of ``exact``.

    Figures: ``against``; ``counterparts``, the plugins that were put in, and ``truth_spp``, their samples a pixel;
    ``psnr_db``, ``flip``, ``mae``; ``brightness``, the ratio of the means; ``noise_db`` and ``psnr_without_noise_db``
    (:func:`noise`); ``worst``, the window (:func:`worst_window`) of the largest ``mae`` of values clipped to [0, 1];
    the median ``seconds_per_pass`` of each; ``replaced_plugins``, of which ``learned_plugins`` are learned, and the
    ``table_bytes`` of these; ``conversions``, what became of Mitsuba's plugins (:class:`.conversion.Conversion`).
    ``time_ratio``, written over the other at equal samples: ``median``, ``q1``, ``q3``, ``min`` and ``max`` over the
    ``pairs`` of passes, rendered one after the other, in which neither side compiled a kernel. The median is ``None``
    if there are fewer than :data:`PAIRS` of them or ``q3`` exceeds :data:`WIDEST` times ``q1``. Quote this ratio
    rather than the quotient of the times: a slow phase of the machine slows both passes of a pair.

    Ctrl-C ends the comparison after the current pair; ``spp`` and ``passes`` then state how many there were, and
    ``interrupted`` is true. Raises :class:`.SceneError`, also if the scene names no plugin with such a counterpart.
    """
    compared = load_compared(scene, against, learn, defines, progress)
    parsed, put_in = compared.parsed, compared.put_in
    sides = {
        name: _Side(loaded, compared.oversampling[name], f"{parsed.path} with {', '.join(put_in[name])}")
        for name, loaded in compared.truths.items()
    }
    written = _Side(compared.written, name=f"{parsed.path}, as written")
    spp = spp or written.scene.sensors()[0].sampler().sample_count()
    footprint.check_samples(footprint.textures(written.scene), spp)
    loading.check_size(written.scene, spp)
    passes, done = max(1, min(max(passes, 2), spp)), 0
    turns = [written, *sides.values()]
    total = passes * sum(side.oversampling for side in turns)
    with interruptible() as stop, progress_bar("render", total, progress=progress) as bar:
        for i in range(passes):
            n = (i + 1) * spp // passes - done
            for side in turns if i % 2 == 0 else reversed(turns):
                side.render(n, seed * passes + i, bar.update)
            done += n
            if stop.is_set():
                break

    loading.warn_if_black(written.scene, parsed.path, [written.image, *(side.image for side in sides.values())])
    common = {
        "scene": str(parsed.path),
        "variant": mi.variant(),
        "spp": sum(written.samples),
        "seed": seed,
        "width": written.image.shape[1],
        "height": written.image.shape[0],
        "passes": len(written.seconds),
        "interrupted": done < spp,
        "spp_requested": spp,
        "replaced_plugins": len(compared.replaced),
        "learned_plugins": len(compared.learned),
        "table_bytes": parsed.table_bytes(compared.learned),
        "conversions": [vars(c) for c in compared.conversions],
    }
    first, *further = (
        Comparison(written.image, side.image, {
            **common,
            "against": name,
            "counterparts": put_in[name],
            "truth_spp": sum(side.samples) * side.oversampling,
            **_errors(written, side),
            **_times(written, side, name),
        })
        for name, side in sides.items()
    )  # fmt: skip
    first.further = tuple(further)
    return first


def _default_truths(learned: list[dict], learn: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return, by name, the counterparts that learned plugins are replaced by without a choice, ``exact`` last.

    With ``learn``, the scene of the file is in the place of the exact one.
    """
    names = dict.fromkeys(name for entry in learned for name in plugins.declared()[entry["plugin"]].truths)
    names |= dict.fromkeys(["exact"] if learn else [])
    return {name: tuple(dict.fromkeys((name, "exact"))) for name in sorted(names, key="exact".__eq__)}


def _errors(written: _Side, truth: _Side) -> dict:
    """Return the errors of an image, the part of them that is noise, and the worst place."""
    image, reference = written.image, truth.image
    error = _clipped_error(image, reference)
    x, y, width, height = worst_window(error)
    return {
        **metrics.compare(reference, image),
        **noise(written.halves, truth.halves, written.samples),
        "brightness": float(image.mean(dtype=np.float64) / max(reference.mean(dtype=np.float64), 1e-30)),
        "worst": {
            "x": x, "y": y, "width": width, "height": height,
            "mae": float(error[y : y + height, x : x + width].mean(dtype=np.float64)),
        },
    }  # fmt: skip


def _clipped_error(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the absolute difference of values clipped to [0, 1], the mean of the channels, ``(height, width)``."""
    return np.abs(np.clip(image, 0, 1) - np.clip(reference, 0, 1)).mean(axis=-1)


def noise(written: list, truth: list, samples: list[int]) -> dict[str, float | None]:
    """Return the part of an error that is noise, from two independent halves of the samples of each side.

    ``written`` and ``truth`` are the sums of the samples of each half, ``samples`` how many these are. Both sides are
    rendered with the same random numbers, so the noise that they share is in neither image's error: noise is here what
    remains of it in their *difference*. With the differences a and b of the halves, of m and n samples, the squared
    noise of the mean difference is estimated by (a − b)² m n / (m + n)² and its squared expectation by a b, both
    without bias. Where the PSNR clips the two means to [0, 1] and sees a part of their difference, that part of a and b
    counts. For halves of equal size, the two squares add up to the squared error.

    ``noise_db``: PSNR that two scenes of equal expectation would reach at so many samples, infinite without noise;
    ``psnr_without_noise_db``: PSNR of infinitely many samples, ``None`` if the difference of the images is below two
    standard errors of this estimate. Both are ``None`` if there is only one half.
    """
    if min(samples) == 0:
        return {"noise_db": None, "psnr_without_noise_db": None}
    m, n = samples
    mean, reference = (sum(side) / (m + n) for side in (written, truth))
    difference = mean - reference
    shown = np.clip(mean, 0, 1) - np.clip(reference, 0, 1)
    share = np.where(shown == difference, 1, shown / np.where(difference == 0, 1, difference))
    a, b = ((w - t) / k * share for w, t, k in zip(written, truth, samples, strict=True))
    squared = (a * b).mean(axis=-1)
    bias, error = squared.mean(), squared.std() / math.sqrt(squared.size)
    return {
        "noise_db": _decibels(np.mean((a - b) ** 2) * m * n / (m + n) ** 2),
        "psnr_without_noise_db": _decibels(bias) if bias > 2 * error or error == 0 else None,
    }


def _decibels(mse: float) -> float:
    return -10 * math.log10(mse) if mse > 0 else math.inf


def worst_window(error: np.ndarray) -> tuple[int, int, int, int]:
    """Return ``x, y, width, height`` of the window with the largest mean of ``error`` ``(height, width)``.

    Its sides are :data:`ZOOM` of the picture's, but at least :data:`SMALLEST` pixels where the picture has them.
    """
    height, width = (min(n, max(SMALLEST, round(n * ZOOM))) for n in error.shape)
    sums = np.pad(error, ((1, 0), (1, 0))).cumsum(0, dtype=np.float64).cumsum(1)
    means = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    y, x = np.unravel_index(int(means.argmax()), means.shape)
    return int(x), int(y), width, height


def _times(written: _Side, truth: _Side, name: str) -> dict:
    """Return times of passes; pairs in which a kernel was compiled are left out of all but the first ones."""
    sides = {"written": written, name: truth}
    quiet = [i for i, both in enumerate(zip(written.compiled, truth.compiled, strict=True)) if not any(both)]
    ratios = [written.seconds[i] / truth.seconds[i] for i in quiet]
    ratio = {**spread(ratios), "min": min(ratios, default=None), "max": max(ratios, default=None), "pairs": len(quiet)}
    if len(quiet) < PAIRS or ratio["q3"] > WIDEST * ratio["q1"]:
        ratio["median"] = None
    return {
        "seconds_per_pass": {key: spread(side.seconds[i] for i in quiet)["median"] for key, side in sides.items()},
        "seconds_first_pass": {key: side.seconds[0] for key, side in sides.items()},
        "time_ratio": {key: None if value != value else value for key, value in ratio.items()},
    }


def _lines(f: dict) -> list[str]:
    """Return the errors and times against one truth as lines of text."""
    return [
        f"PSNR        {f['psnr_db']:.2f} dB   (linear, clipped to [0, 1])",
        f"noise       {_noise_text(f)}",
        f"FLIP        {f['flip']:.4f}     (0 = equal to the eye)",
        f"MAE         {f['mae']:.5f}",
        f"brightness  {f['brightness']:.4f} of that of {f['against']}",
        *_time_lines(f),
    ]


def _noise_text(f: dict) -> str:
    if f["noise_db"] is None:
        return "not measured: it needs two samples a pixel"
    if math.isinf(f["noise_db"]):
        return "none: both halves of the samples differ alike"
    if f["psnr_without_noise_db"] is None:
        return f"{f['noise_db']:.2f} dB: all of the error, as far as the samples tell"
    return f"{f['noise_db']:.2f} dB of it, {f['psnr_without_noise_db']:.2f} dB without it"


def _time_lines(f: dict) -> list[str]:
    ratio, name = f["time_ratio"], f["against"]
    if ratio["pairs"] < PAIRS:
        pairs = "1 pair" if ratio["pairs"] == 1 else f"{ratio['pairs']} pairs"
        return [
            f"time        not measured: {pairs} of passes without compilation,",
            f"            {PAIRS} are needed (--passes)",
        ]
    quartiles = f"{ratio['q1']:.2f} to {ratio['q3']:.2f}"
    if ratio["median"] is None:
        return [
            f"time        not measurable here: quartiles {quartiles}",
            f"            of the ratios of {ratio['pairs']} pairs of passes",
        ]
    return [
        f"time        {ratio['median']:.2f} times that of {name} at {f['spp']} spp"
        f" ({f['seconds_per_pass'][name]:.3g} s a pass)",
        f"            median of {ratio['pairs']} pairs of passes, quartiles {quartiles}",
    ]
