"""Study ``tradeoff scene``: error against render time of a scene, as written and with exact plugins.

Monte Carlo noise decreases with render time, the bias of learned tables does not; the study measures both and the
sample count at which they are equal (:mod:`~mi_diffind.measure.bias`). *Times* are those of the kernels of a whole
render (:mod:`~mi_diffind.measure.clock`). Exact and learned versions are rendered in turn. The kernel of a pass is the
same for all sample counts and is compiled before the first pass; times of a pass that compiles anything are dropped.
"""

from __future__ import annotations

import argparse
import math
import os
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from .. import plugins
from ..core.arguments import natural, positive
from ..core.progress import interruptible
from ..images import metrics
from ..measure import plot, report
from ..measure.benchmark import Stopped
from ..measure.bias import LEAST, crossover, describe, error, estimate, relative_weights, seconds_at
from ..measure.clock import machine, timed
from ..measure.report import grid, percent
from ..measure.statistics import finite, flat_spread, spread
from ..measure.store import Store, fingerprint, sources
from ..measure.study import Study, Tradeoff
from ..scenes import loading

#: Versions of the scene: with the exact counterparts of learned plugins, and as written.
VERSIONS = ("exact", "learned")

#: Largest ratio of the crossover's sample count to that of the last point at which curves are still continued.
REACH = 100


#: Name in the store of the exact image whose brightness weights all errors; passes are named by their numbers.
BRIGHTNESS = "brightness"


#: Samples of the whole image in one launch, far below Mitsuba's limit of 2³².
LAUNCH_SAMPLES = 1 << 26


#: The highest sample count of a quick run.
_QUICK_SPP = 4


@dataclass(frozen=True)
class SceneStudySettings:
    """Settings of the scene study: sample counts and numbers of passes.

    ``spp`` is the highest sample count (``None``: the scene's own, in a quick run at most 4), ``step`` the factor, a
    power of two, from one count to the next. ``passes`` is the number of renders at the highest count, which the truth
    is the mean of (at least 3); ``rounds`` is the number of renders at all lower counts.
    """

    spp: int | None = None
    step: int = 4
    passes: int = 8
    rounds: int = 5
    quick: bool = False

    @classmethod
    def choose(cls, quick: bool = False, spp: int | None = None) -> SceneStudySettings:
        """Return settings of a run of minutes, or of a ``quick`` one."""
        return cls(spp, 2, 8, 3, True) if quick else cls(spp)

    def counts(self, scene_spp: int) -> list[int]:
        """Return the sample counts, ascending, for a scene whose own count is ``scene_spp``.

        The highest is rounded down to a power of two (only with these are passes repeatable); the lower ones follow by
        division by ``step``.
        """
        top = self.spp or (min(scene_spp, _QUICK_SPP) if self.quick else scene_spp)
        counts = [1 << (top.bit_length() - 1)]
        while counts[0] >= self.step:
            counts.insert(0, counts[0] // self.step)
        return counts


class SceneStudy(Study):
    """The error of a scene's image against render time, with learned and with exact plugins."""

    name = "scene"
    title = "a scene, learned and exact, at several sample counts"
    example = "scene.xml --spp 64"
    of_scene = True

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--spp", type=positive, help="most samples per pixel (default: the scene's; --quick: at most 4)"
        )
        parser.add_argument("--seed", type=natural, default=0, help="seed of the random numbers (default: 0)")

    def run(self, arguments) -> Tradeoff:
        settings = SceneStudySettings.choose(arguments.quick, arguments.spp)
        result = measure(arguments.scene, settings, arguments.out, arguments.seed, arguments.defines)
        return report.publish(result, write(result, arguments.out), summary(result))


STUDY = SceneStudy()


def measure(
    scene_path: str | os.PathLike,
    settings: SceneStudySettings,
    folder: str | os.PathLike | None = None,
    seed: int = 0,
    defines: dict[str, str] | None = None,
    progress: bool = True,
) -> dict:
    """Measure the errors and times of a scene file, learned and exact.

    If ``folder`` holds an interrupted run of the same key, only the missing part is measured; measurements stay there
    until :func:`write` has written the result. Equal arguments give equal errors if the film's filter is a box.
    Values that are not finite count as 0.

    Returns the result, a tree of numbers and strings (JSON; ``None`` for unknown values). Errors are relative: ``mse``
    as in :mod:`~mi_diffind.measure.bias`, ``rmse`` its root. Seconds are those of the kernels of a whole render.

    - ``scene``, ``variant``, ``width``, ``height``, ``seed``, ``defines``, ``learned_plugins``, ``settings``,
      ``machine``, ``date``, ``interrupted``, ``resumed``, ``counts`` (all sample counts), ``not_finite`` (number of
      values);
    - ``points``, a list: ``version``, ``spp``, ``mse`` (median; ``mse_q1``, ``mse_q3``), ``rmse``, ``psnr_db`` (as in
      ``compare``, not corrected for the noise of the truth), ``images``, ``seconds`` (likewise with quartiles),
      ``timed`` (number of timed renders);
    - ``ratios``, a list: ``spp``, ``median``, ``q1``, ``q3`` of the times learned / exact;
    - ``reference``: ``spp``, ``passes``, ``noise_rmse`` (subtracted from all errors);
    - ``noise``: for each version ``mse_of_a_sample``, σ²;
    - ``bias``: :func:`~mi_diffind.measure.bias.describe`; ``crossover``: :func:`~mi_diffind.measure.bias.crossover`.

    After Ctrl-C the result covers the renders up to then: ``points`` may be empty, and values derived from them
    ``None``. Raises :class:`.SceneError`, also if the scene names no learned plugin, and
    :class:`.OutputError` if the folder cannot be written.
    """
    parsed = loading.ParsedScene(scene_path, defines)
    learned = parsed.learned_plugins()
    if not learned:
        names = ", ".join(plugins.with_counterpart())
        raise loading.SceneError(f"{scene_path}: names no learned plugin ({names}), so there is nothing to compare")
    loaded = {name: parsed.load(exact=name == "exact") for name in VERSIONS}
    sensor = loaded["learned"].sensors()[0]
    width, height = (int(v) for v in sensor.film().crop_size())
    counts = settings.counts(sensor.sampler().sample_count())
    facts = {
        "scene": str(scene_path),
        "variant": mi.variant(),
        "width": width,
        "height": height,
        "seed": seed,
        "defines": parsed.defines,
        "learned_plugins": len(learned),
        "settings": asdict(settings),
        "counts": counts,
        "machine": machine(mi.variant()),
    }
    files = {file for file, _ in parsed.tables(learned)} | set(parsed.files())
    key = {**facts, "scene": Path(scene_path).name, "sources": fingerprint([*sources(), *files])}
    store, interrupted = Store(folder, "scene", key, ("pairs",), progress), False
    with interruptible() as stop:
        run = SceneRun(loaded, counts, settings, seed, store, width * height, stop)
        try:
            run.renders(progress)
        except Stopped:
            interrupted = True
    return finite({
        **facts,
        "date": time.strftime("%Y-%m-%d"),
        "interrupted": interrupted,
        "resumed": store.resumed,
        **_assemble(store, counts),
    })  # fmt: skip


@dataclass
class SceneRun:
    """Renders of a run: pairs of an exact and a learned image with the same seed."""

    loaded: dict
    counts: list[int]
    settings: SceneStudySettings
    seed: int
    store: Store
    pixels: int
    stop: threading.Event
    is_compiled: bool = False

    def schedule(self) -> list[tuple[int, int, int, bool]]:
        """Return sample count, index, number of the seed, and whether the learned image comes first, of all pairs."""
        *lower, top = self.counts
        pairs = [(top, k, 1 + k, k % 2 == 1) for k in range(self.settings.passes)]
        for k in range(self.settings.rounds):
            for spp in lower if k % 2 == 0 else reversed(lower):
                number = k * len(lower) + lower.index(spp)
                pairs.append((spp, k, 1 + self.settings.passes + number, (k + number) % 2 == 1))
        return pairs

    def renders(self, progress: bool) -> None:
        """Render the exact pass for the brightness and the missing pairs. Raises :class:`Stopped` after Ctrl-C."""
        store, done, top = self.store, self.store.data["pairs"], self.counts[-1]
        if BRIGHTNESS not in store.arrays:
            store.keep(BRIGHTNESS, exact=self._render("exact", top, 0)[0])
            store.save()
        todo, truth = [pair for pair in self.schedule() if f"{pair[0]}/{pair[1]}" not in done], None
        # A unit is a sample per pixel, so the remaining time is in proportion to the remaining units
        units = sum(len(VERSIONS) * spp for spp, *_ in todo)
        with tqdm(total=units, desc="render", unit="spp", smoothing=0.05, disable=None if progress else True) as bar:
            for spp, k, number, learned_first in todo:
                images, records = self._pair(spp, number, learned_first, bar)
                if spp == top:
                    store.keep(str(k), **images)
                else:
                    truth = truth or SceneTruth.from_store(store)
                    records = {name: records[name] | truth.errors(images[name]) for name in VERSIONS}
                done[f"{spp}/{k}"] = records
                store.save()

    def _pair(self, spp: int, number: int, learned_first: bool, bar: tqdm) -> tuple[dict, dict]:
        """Return both images of ``spp`` samples and their times; ``number`` selects their common seed."""
        if not self.is_compiled:
            for name in VERSIONS:
                self._render(name, self.counts[0], 0)
            self.is_compiled = True
        images, records = {}, {}
        for name in reversed(VERSIONS) if learned_first else VERSIONS:
            if self.stop.is_set():
                raise Stopped
            images[name], records[name] = self._render(name, spp, number)
            bar.update(spp)
        return images, records

    def _render(self, name: str, spp: int, number: int) -> tuple[np.ndarray, dict]:
        """Return an image, float32, with its ``seconds`` (``None`` if it compiled) and ``not_finite`` values."""
        launches = 1 << ((spp * self.pixels - 1) // LAUNCH_SAMPLES).bit_length()
        render = timed(lambda: loading.render(self.loaded[name], spp, (self.seed << 8) + number, launches)[0])
        image = loading.colour_channels(render.value)
        bad = ~np.isfinite(image)
        seconds = None if render.compiled else render.seconds
        return np.where(bad, np.float32(0), image), {"seconds": seconds, "not_finite": int(bad.sum())}


@dataclass(frozen=True)
class SceneTruth:
    """Mean of ``passes`` exact images, with the weights of errors and the mean square of the noise of one image."""

    image: np.ndarray
    passes: int
    weights: np.ndarray
    noise: float

    @classmethod
    def from_store(cls, store: Store) -> SceneTruth:
        """Return the truth of the passes in a store."""
        exact = _images(store)["exact"]
        weights = relative_weights(store.arrays[BRIGHTNESS]["exact"])
        return cls(np.mean(exact, axis=0, dtype=np.float64), len(exact), weights, estimate(exact, weights).noise)

    def errors(self, image: np.ndarray, left_out: np.ndarray | None = None) -> dict[str, float]:
        """Return ``mse`` and ``psnr_db`` of an image; against the mean without ``left_out``, one of the passes."""
        truth, passes = self.image, self.passes
        if left_out is not None:
            truth, passes = (passes * truth - left_out) / (passes - 1), passes - 1
        mse = error(image, truth, self.weights, self.noise / passes)
        return {"mse": mse, "psnr_db": metrics.psnr(truth, image)}


def _images(store: Store) -> dict[str, list[np.ndarray]]:
    """Return the images of the passes at the highest count, by version."""
    passes = [arrays for name, arrays in store.arrays.items() if name != BRIGHTNESS]
    return {name: [arrays[name] for arrays in passes] for name in VERSIONS}


def _assemble(store: Store, counts: list[int]) -> dict:
    done, images, top = store.data["pairs"], _images(store), counts[-1]
    not_finite = sum(record["not_finite"] for pair in done.values() for record in pair.values())
    result = {
        "not_finite": not_finite,
        "notes": [f"{not_finite} values were not finite and counted as 0."] if not_finite else [],
        **dict.fromkeys(("reference", "noise", "bias", "crossover")),
        "points": [],
        "ratios": [],
    }
    if len(images["exact"]) < LEAST:
        return result
    truth, times = SceneTruth.from_store(store), {name: {} for name in VERSIONS}
    for spp in counts:
        pairs = [dict(pair) for key, pair in done.items() if key.startswith(f"{spp}/")]
        for k, pair in enumerate(pairs if spp == top else ()):
            for name in VERSIONS:
                pair[name] = pair[name] | truth.errors(images[name][k], images["exact"][k])
        for name in VERSIONS if pairs else ():
            point = {"version": name, "spp": spp, **_point([pair[name] for pair in pairs])}
            result["points"].append(point)
            if point["timed"]:
                times[name][spp] = point["seconds"]
        seconds = [[pair[name]["seconds"] for name in VERSIONS] for pair in pairs]
        ratios = [learned / exact for exact, learned in seconds if exact is not None and learned is not None]
        if ratios:
            result["ratios"].append({"spp": spp, **spread(ratios)})
    differences = [l.astype(np.float64) - e for l, e in zip(images["learned"], images["exact"], strict=True)]
    bias, displayed = estimate(differences, truth.weights), estimate(differences, truth.image <= 1)
    noise = {name: max(estimate(images[name], truth.weights).noise, 0.0) * top for name in VERSIONS}
    result["reference"] = {
        "spp": truth.passes * top, "passes": truth.passes, "noise_rmse": _root(truth.noise / truth.passes)
    }  # fmt: skip
    result["noise"] = {name: {"mse_of_a_sample": noise[name]} for name in VERSIONS}
    result["bias"] = describe(bias, displayed)
    result["crossover"] = crossover(bias, noise["learned"], times["learned"])
    return result


def _point(records: list[dict]) -> dict:
    mse, seconds = [r["mse"] for r in records], [r["seconds"] for r in records if r["seconds"] is not None]
    return {
        **flat_spread("mse", mse),
        "rmse": _root(float(np.median(mse))),
        "psnr_db": float(np.median([r["psnr_db"] for r in records])),
        "images": len(records),
        **flat_spread("seconds", seconds),
        "timed": len(seconds),
    }


def _root(square: float) -> float:
    """Return the root of an estimate of a square, 0 if the estimate is negative."""
    return math.sqrt(max(square, 0.0))


def write(result: dict, folder: str | os.PathLike) -> dict[str, str]:
    """Write the files of a result, with a picture if there is a timed point; return their paths.

    The table has a row for each version and sample count; ``time_ratio`` is learned / exact.
    """
    ratios = {r["spp"]: r["median"] for r in result["ratios"]}
    rows = [{"scene": Path(result["scene"]).name, **p, "time_ratio": ratios.get(p["spp"])} for p in result["points"]]
    pictures = {"png": lambda: draw(result)} if any(p["timed"] and p["rmse"] for p in result["points"]) else {}
    return report.write_files("scene", folder, result, rows, pictures)


def summary(result: dict) -> list[str]:
    """Return lines of text: errors and times by sample count, the bias and the crossover."""
    lines = [
        f"scene       {Path(result['scene']).name}, {result['width']} x {result['height']}, learned plugins: "
        f"{result['learned_plugins']}",
        f"variant     {result['variant']}",
        "",
    ]
    if not result["points"]:
        return [*lines, report.figure_caption(result)]
    lines.append("relative RMS error and seconds of the kernels, medians; learned / exact with quartiles")
    cells = [["spp", "exact: error", "seconds", "learned: error", "seconds", "learned / exact"]]
    ratios = {r["spp"]: f"{r['median']:.2f} ({r['q1']:.2f} to {r['q3']:.2f})" for r in result["ratios"]}
    points = {(p["version"], p["spp"]): p for p in result["points"]}
    for spp in result["counts"]:
        both = [points.get((name, spp)) for name in VERSIONS]
        texts = [t for p in both for t in ((percent(p["rmse"]), f"{p['seconds'] or 0:.3g}") if p else ("", ""))]
        cells.append([str(spp), *texts, ratios.get(spp, "")])
    reference, at = result["reference"], result["crossover"]
    lines += [*grid(cells), "", f"reference   {reference['spp']} spp, noise {percent(reference['noise_rmse'])}"]
    lines.append(f"bias        {bias_text(result['bias'])}")
    if "spp" in at:
        time_text = "" if at["seconds"] is None else f", {at['seconds']:.3g} s"
        lines.append(f"noise equals the bias at {at['spp']:,.0f} spp{time_text}")
    elif at["spp_above"] is not None:
        lines.append(f"noise dominates up to {at['spp_above']:,.0f} spp at least")
    return [*lines, report.figure_caption(result)]


def bias_text(bias: dict) -> str:
    """Return the relative bias and its PSNR, or their bounds, as text."""
    rmse = percent(bias["rmse"]) if bias["measured"] else f"below {percent(bias['rmse_below'])}"
    psnr = bias.get("psnr_db") or bias["psnr_db_above"]
    return f"{rmse}, PSNR {'above ' * ('psnr_db' not in bias)}{'infinite' if psnr is None else f'{psnr:.1f} dB'}"


def draw(result: dict):
    """Draw the error of both versions against render time, and the bias or its upper bound as a line.

    Both axes are logarithmic, points have quartiles. Dashed curves are the sum of noise and bias, σ² / spp + bias².
    """
    bias, curves, (width, height) = result["bias"], [], (result["width"], result["height"])
    floor, ends = bias["rmse"] if bias["measured"] else bias["rmse_below"], []
    for (colour, marker), name in zip(plot.STYLES, reversed(VERSIONS), strict=False):
        points = [p for p in result["points"] if p["version"] == name and p["timed"] and p["rmse"] > 0]
        if not points:
            continue
        x, y = ([p[key] for p in points] for key in ("seconds", "rmse"))
        low, high = ([_root(p[key]) for p in points] for key in ("mse_q1", "mse_q3"))
        label = f"{name}, {', '.join(str(p['spp']) for p in points)} spp"
        curves.append(plot.Curve(label, x, y, low, high, {"color": colour, "marker": marker, "linestyle": ""}))
        times, noise = {p["spp"]: p["seconds"] for p in points}, result["noise"][name]["mse_of_a_sample"]
        square = max(bias["mse"], 0.0) if name == "learned" and bias["measured"] else 0.0
        most = min(max(2 * (result["crossover"].get("spp") or 0), 4 * max(times)), REACH * max(times))
        spps = np.geomspace(min(times), most, 100)
        at = [seconds_at(n, times) for n in spps]
        style = {"color": colour, "marker": "", "linestyle": (0, (4, 2.5)), "alpha": 0.75}
        label = f"{name}, noise σ² / spp{' + bias²' * (square > 0)}"
        curves.append(plot.Curve(label, at, np.sqrt(square + noise / spps), style=style))
        ends += [at[0], at[-1]]
    label = f"bias of the approximation{'' if bias['measured'] else ', upper bound'}: {bias_text(bias)}"
    curves.append(plot.Curve(label, [min(ends), max(ends)], [floor] * 2, style={"color": "#7a3b8f", "marker": ""}))
    title = f"{Path(result['scene']).stem}, {width} × {height}: noise and bias at a given render time"
    caption = report.figure_caption(result)
    return plot.draw_curves(title, caption, {"": curves}, "seconds of a render (kernels)", "relative RMS error", "xy",
                            height=4.9)  # fmt: skip
