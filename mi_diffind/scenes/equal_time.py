"""Error at equal time: a scene as written and its counterparts, each with the samples that fit in the same time.

*The law*: a pass of n samples a pixel has the error noise(n) + bias. The noise is that of a measured pass times its
samples over n, the time is in proportion to n, and the bias is that of the approximation, which no time reduces.
"""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import mitsuba as mi
import numpy as np

from ..core.files import writable_folder
from ..core.progress import interruptible, progress_bar
from ..images import metrics
from ..measure import plot
from ..measure.report import grid
from ..measure.statistics import finite, spread
from ..plugins.support import footprint
from . import comparison, loading

#: Samples of the reference, as a multiple of all samples of the exact scene.
REFERENCE = 8

#: Added to the squared radiance that a squared error is divided by, as usual for the relative error of renders.
EPSILON = 0.01

#: Standard errors that a bias exceeds to be stated.
SEEN = 3.0

#: Largest share by which the times of two contenders may differ and count as equal.
TOLERANCE = 0.1

#: Pairs of passes whose median ratio of times a correction uses.
PAIRS = 3

#: Corrections of the samples of a contender after its first measured pass.
CORRECTIONS = 3


@dataclass
class EqualTime:
    """Images of one pass of each contender, and of the reference (linear, ``(height, width, 3)``), with the figures."""

    images: dict[str, np.ndarray] = field(repr=False)
    reference: np.ndarray = field(repr=False)
    figures: dict

    def save(self, folder: str | os.PathLike) -> dict[str, str]:
        """Write ``equal_time.png`` into ``folder``, made if its parent exists, and return the paths."""
        path = writable_folder(folder, create=True) / "equal_time.png"
        pictures, error_maps = [], []
        for name, image in reversed(self.images.items()):  # the exact one is the last
            c, error = self.figures["contenders"][name], _weighted((image - self.reference) ** 2, self.reference)
            title = f"{name} ({', '.join(c['plugins'])}): {c['spp']} samples a pixel, {c['seconds']['median']:.2g} s"
            pictures.append(plot.picture(title, image))
            title = f"relative error; mean square {c['error']:.3g}, of it bias {_share(c)}"
            error_maps.append(plot.error_map(np.sqrt(error), title))
        pictures.append(plot.picture(f"reference: {self._reference()}", self.reference))
        plot.write(path, [*pictures, *error_maps, self._draw_law], len(pictures), self.reference.shape)
        return {"figure": str(path)}

    def _draw_law(self, figure, axes) -> None:
        """Draw the error of each contender against the seconds of a pass: the law, and the measured passes."""
        drawn = {name: c for name, c in self.figures["contenders"].items() if c["noise"] > 0 and c["seconds"]["median"]}
        if not drawn:
            return
        axes.set_axis_on()
        axes.set(xscale="log", yscale="log", xlabel="seconds of a pass", ylabel="relative mean squared error of a pass")
        axes.set_title("error against time; lines are noise / samples + bias")
        first = min(c["seconds"]["median"] / c["spp"] for c in drawn.values())
        equal = {name: c["crossover"]["seconds"] or 0.0 for name, c in drawn.items() if c["crossover"]}
        last = max([*(c["seconds"]["median"] for c in drawn.values()), *equal.values()])
        times = np.geomspace(first, 4 * last, 200)
        for (name, c), (colour, marker) in zip(drawn.items(), itertools.cycle(plot.STYLES)):
            seconds, bias = c["seconds"]["median"], c["bias"] or 0.0
            axes.plot(times, c["noise"] * seconds / times + bias, color=colour)
            style = {"color": colour, "marker": marker, "markersize": 8, "linestyle": ""}
            axes.plot(seconds, c["error"], label=f"{name}, {c['spp']} samples a pixel", **style)
            if equal.get(name, 0.0) > first:
                label = f"{name}: noise = bias at {_rounded(c['crossover']['spp'])} samples a pixel"
                axes.plot(equal[name], 2 * bias, label=label, markerfacecolor="white", **style)
        plot.log_ticks(axes.xaxis, *axes.get_xlim())
        plot.log_ticks(axes.yaxis, *axes.get_ylim())
        axes.grid(color="0.92")
        axes.legend()

    def _reference(self) -> str:
        f = self.figures
        plugins = ", ".join(f["contenders"][f["reference"]]["plugins"])
        return f"{f['reference']} ({plugins}), {f['reference_spp']} samples a pixel"

    def __str__(self) -> str:
        f, remarks = self.figures, []
        rows = [("", "samples", "seconds", "error", "of it noise", "of it bias", f"error / {f['reference']}")]
        for name, c in f["contenders"].items():
            median, q1, q3 = c["error_ratio"].values()
            numbers = (f"{value:.3g}" for value in (c["seconds"]["median"], c["error"], c["noise"]))
            ratio = "-" if median is None else f"{median:.2f} ({q1:.2f} to {q3:.2f})"
            rows.append((name, str(c["spp"]), *numbers, _share(c), ratio))
            time_ratio = c["seconds"]["median"] / f["contenders"][f["reference"]]["seconds"]["median"]
            if abs(time_ratio - 1) > TOLERANCE:
                remarks.append(f"{name}: its passes took {time_ratio:.2f} of the time of {f['reference']}")
            if c["crossover"]:
                remarks.append(f"{name}: {_crossover_text(c, f['reference'])}")
        head = [
            f"scene       {Path(f['scene']).name}, {f['width']} x {f['height']}, "
            f"{f['passes']} passes{', interrupted' * f['interrupted']}",
            f"variant     {f['variant']}",
            f"reference   {self._reference()}",
            "error       mean squared error of a pass, over the squared reference + 0.01 (relMSE)",
        ]
        return "\n".join([*head, "", *grid(rows), "", *remarks])

    def _repr_png_(self) -> bytes:
        with tempfile.TemporaryDirectory() as folder:
            return Path(self.save(folder)["figure"]).read_bytes()


def _share(contender: dict) -> str:
    bias = contender["bias"]
    return f"{bias:.3g}" if bias is not None else f"none above {contender['bias_resolution']:.1g}"


def _rounded(value: float) -> str:
    """Return a number of samples or seconds with two significant digits."""
    value = float(f"{value:.2g}")
    return f"{value:,.0f}" if value >= 10 else f"{value:g}"


def _crossover_text(contender: dict, reference: str) -> str:
    at = contender["crossover"]
    if at["spp"] is None:
        up_to = f": no crossover seen up to {_rounded(at['spp_above'])} samples a pixel" if at["spp_above"] else ""
        return f"no bias above {contender['bias_resolution']:.1g}{up_to}"
    equal, better = (
        "the first sample" if spp <= 1 else f"{_rounded(spp)} samples a pixel ({_rounded(seconds)} s)"
        for spp, seconds in ((at["spp"], at["seconds"]), (at["reference_better_spp"], at["reference_better_seconds"]))
    )
    verb = "exceeds" if at["spp"] <= 1 else "equals"
    return f"bias {verb} noise at {equal}; {reference} is better at equal time from {better} on"


def _weighted(squared: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return squared errors over the squared reference + :data:`EPSILON`, the mean of the channels."""
    return (squared / (reference**2 + EPSILON)).mean(axis=-1)


def attach_samples(scene, spp: int) -> int:
    """Return the largest number of samples a pixel up to ``spp`` that a scene's sampler allows, and filter for it."""
    sensor, level = scene.sensors()[0], mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)  # the sampler warns of each number that it rounds
    try:
        spp = next((n for n in range(max(1, spp), 0, -1) if loading.sampler_count(sensor, n) == n), 1)
    finally:
        mi.set_log_level(level)
    footprint.attach(scene, 0, spp)
    return spp


class _EqualSide:
    """Scene whose passes have ``spp`` samples a pixel."""

    def __init__(self, scene, plugins: list[str], spp: int):
        self.scene, self.plugins, self.spp = scene, plugins, attach_samples(scene, spp)
        self.images: list[np.ndarray] = []
        self.seconds: list[float] = []

    def render(self, seed: int) -> tuple[np.ndarray, float]:
        """Return an image of one pass, and its seconds."""
        start = time.perf_counter()
        image = loading.colour_channels(loading.render_pass(self.scene, self.spp, seed))
        seconds = time.perf_counter() - start
        metrics.check_finite(image)
        return np.repeat(image, 3 // image.shape[-1], -1), seconds

    def fill(self, exact: _EqualSide) -> None:
        """Choose the samples whose pass takes as long as one of ``exact``, as far as the sampler allows."""
        for _ in range(CORRECTIONS):
            pairs = [(self.render(i)[1], exact.render(i)[1]) for i in range(PAIRS + 1)][1:]  # the first ones compile
            before = self.spp
            self.spp = attach_samples(self.scene, round(before / np.median([a / b for a, b in pairs])))
            if self.spp == before:
                break


def errors(passes: Sequence[np.ndarray], references: Sequence[np.ndarray]) -> dict:
    """Return the error of one of several ``passes`` of an image, and the parts of it that are noise and bias.

    ``passes`` are images ``(height, width, channels)`` of independent samples, ``references`` two independent halves of
    the reference. All are relative mean squared errors without the noise of the reference: ``error`` = ``noise``, the
    variance of a pass, + ``bias``, the squared error of infinitely many samples, ``None`` if that is below
    :data:`SEEN` of its standard errors (``bias_resolution``). ``errors`` are those of each pass. All estimates are
    without bias, so ``error`` may differ from the sum by rounding, and those of small errors may be negative.
    """
    reference = sum(references) / len(references)
    reference_noise = (references[0] - references[1]) ** 2 / 4  # variance of the mean of the halves
    each = [float(_weighted((image - reference) ** 2 - reference_noise, reference).mean()) for image in passes]
    mean, variance = np.mean(passes, axis=0), np.var(passes, axis=0, ddof=1)
    squared = _weighted((mean - reference) ** 2 - variance / len(passes) - reference_noise, reference)
    bias, resolution = float(squared.mean()), SEEN * float(squared.std()) / squared.size**0.5
    return {
        "error": float(np.mean(each)),
        "noise": float(_weighted(variance, reference).mean()),
        "bias": bias if bias > resolution else None,
        "bias_resolution": resolution,
        "errors": each,
    }


def crossover(contender: Mapping, exact: Mapping) -> dict:
    """Return the samples a pixel, and the seconds of a pass, from which the bias of a contender decides its error.

    ``contender`` and ``exact`` have ``spp``, the median ``seconds`` of a pass, and the parts of its error
    (:func:`errors`); the law is that of the module. ``spp`` and ``seconds``: noise and bias are equal.
    ``reference_better_spp`` (of the contender) and ``reference_better_seconds``: from here the exact scene has the
    smaller error at equal time, 0 if always. Without a bias they are ``None``, and the noise exceeds what was not seen
    up to ``spp_above`` samples.
    """
    noise, bias, resolution = (contender[key] for key in ("noise", "bias", "bias_resolution"))
    spp, seconds = contender["spp"], contender["seconds"]["median"]
    if bias is None:
        unknown = dict.fromkeys(("spp", "seconds", "reference_better_spp", "reference_better_seconds"))
        return {**unknown, "spp_above": spp * noise / resolution if resolution > 0 else None}
    equal = noise / bias  # in passes of the contender
    better = max(0.0, exact["noise"] * exact["seconds"]["median"] / seconds - noise) / bias
    return {
        "spp": spp * equal,
        "seconds": seconds * equal,
        "reference_better_spp": spp * better,
        "reference_better_seconds": seconds * better,
        "spp_above": None,
    }


def compare_at_equal_time(
    scene: str | os.PathLike | dict,
    spp: int | None = None,
    seed: int = 0,
    *,
    passes: int = 5,
    against: str | None = None,
    learn: Sequence[str] = (),
    defines: Mapping[str, object] | None = None,
    progress: bool = True,
) -> EqualTime:
    """Render a scene as written and its counterparts in the same time, and measure their errors.

    - ``scene``, ``defines``, ``against``, ``learn``: as of :func:`.comparison.compare`; the last truth is the exact
      scene.
    - ``spp``: samples a pixel of a pass of the exact scene (``None``: the scene's). Every other contender takes the
      most samples that its sampler allows in the time of such a pass, measured first.
    - ``passes``: passes of each contender, rendered in turn, at least two.

    The reference is the exact scene at :data:`REFERENCE` times all its samples. Figures: ``contenders``, by name, have
    ``spp``, ``seconds`` (median and quartiles of a pass), ``error``, ``noise`` and ``bias`` (:func:`errors`),
    ``error_ratio`` (median and quartiles of the ratios of a pass's error to that of the exact scene, ``None`` if that
    has no error), and ``crossover`` (:func:`crossover`, ``None`` of the exact scene). Raises :class:`.SceneError`, as
    :func:`.comparison.compare` does.
    """
    loaded, passes = comparison.load_compared(scene, against, learn, defines, progress), max(2, passes)
    spp = spp or loaded.written.sensors()[0].sampler().sample_count()
    loading.check_size(loaded.written, spp)
    names = list(dict.fromkeys(entry["plugin"] for entry in loaded.replaced))
    contenders = {"as written": _EqualSide(loaded.written, names, spp)}
    contenders |= {name: _EqualSide(truth, loaded.put_in[name], spp) for name, truth in loaded.truths.items()}
    reference_name = list(loaded.truths)[-1]
    exact = contenders[reference_name]
    others = [contender for contender in contenders.values() if contender is not exact]
    with progress_bar("samples", len(others), "contender", progress) as bar:
        for contender in others:
            contender.fill(exact)
            bar.update()
    halves, count = [0.0, 0.0], REFERENCE * passes
    with interruptible() as stop, progress_bar("render", count + passes * len(contenders), progress=progress) as bar:
        for i in range(count):
            halves[i % 2] = halves[i % 2] + exact.render((seed << 16) + (1 << 15) + i)[0]
            bar.update()
            if stop.is_set() and i > 0:
                count = i + 1
                break
        for i in range(passes):
            for contender in contenders.values() if i % 2 == 0 else reversed(contenders.values()):
                image, seconds = contender.render((seed << 16) + i)
                contender.images.append(image)
                contender.seconds.append(seconds)
                bar.update()
            if stop.is_set() and i > 0:
                break
    halves = [halves[0] / ((count + 1) // 2), halves[1] / (count // 2)]
    reference = (halves[0] + halves[1]) / 2
    measured = {
        name: {"plugins": c.plugins, "spp": c.spp, "seconds": spread(c.seconds), **errors(c.images, halves)}
        for name, c in contenders.items()
    }
    base = measured[reference_name]
    for c in measured.values():
        c["error_ratio"] = spread(e / b for e, b in zip(c["errors"], base["errors"], strict=True) if b > 0)
        c["crossover"] = None if c is base else crossover(c, base)
    figures = {
        "scene": str(loaded.parsed.path),
        "variant": mi.variant(),
        "width": reference.shape[1],
        "height": reference.shape[0],
        "seed": seed,
        "passes": len(exact.images),
        "interrupted": stop.is_set(),
        "reference": reference_name,
        "reference_spp": count * exact.spp,
        "contenders": measured,
    }
    images = {name: c.images[0].astype(np.float32) for name, c in contenders.items()}
    return EqualTime(images, reference.astype(np.float32), finite(figures))
