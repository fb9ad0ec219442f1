"""Study ``tradeoff scene``: error against render time of a scene, as written and with exact plugins.

Monte Carlo noise decreases with render time, the bias of learned tables does not; the study measures both and the
sample count at which they are equal (:mod:`~mi_diffind.measure.bias`). *Times* are those of the kernels of a whole
render (:mod:`~mi_diffind.measure.clock`) and the wall-clock time. Exact and learned versions are rendered in turn. The
kernel of a pass is the same for all sample counts and is compiled before the first pass; times of a pass that compiles
anything are dropped. Ratios are medians of the ratios of pairs.
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
from ..measure.bias import LEAST, crossover, describe, error, estimate, root, seconds_of, weights_of
from ..measure.clock import machine, timed
from ..measure.report import duration, grid, percent, rounded
from ..measure.statistics import finite, flat_spread, spread
from ..measure.store import Store, fingerprint, sources
from ..measure.study import Study, Tradeoff
from ..scenes import loading

#: Versions of the scene: with the exact counterparts of learned plugins, and as written.
VERSIONS = ("exact", "learned")

#: Columns of the table.
COLUMNS = (
    *("scene", "version", "spp", "mse", "mse_q1", "mse_q3", "rmse", "psnr_db", "images"),
    *("seconds", "seconds_q1", "seconds_q3", "seconds_wall", "seconds_wall_q1", "seconds_wall_q3", "timed"),
    *("time_ratio", "time_ratio_q1", "time_ratio_q3", "time_ratio_wall"),
)

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
    launch_samples: int = LAUNCH_SAMPLES,
) -> dict:
    """Measure the errors and times of a scene file, learned and exact.

    If ``folder`` holds an interrupted run of the same key, only the missing part is measured; measurements stay there
    until :func:`write` has written the result. Equal arguments give equal errors if the film's filter is a box.
    Values that are not finite count as 0. ``launch_samples`` limits the samples of a launch.

    Returns the result, a tree of numbers and strings (JSON; ``None`` for unknown values). Errors are relative: ``mse``
    as in :mod:`~mi_diffind.measure.bias`, ``rmse`` its root. Seconds without ``_wall`` are those of the kernels.

    - ``scene``, ``variant``, ``width``, ``height``, ``seed``, ``defines``, ``learned_plugins``, ``settings``,
      ``machine``, ``date``, ``interrupted``, ``resumed``, ``counts`` (all sample counts), ``not_finite`` (number of
      values);
    - ``points``, a list: ``version``, ``spp``, ``mse`` (median; ``mse_q1``, ``mse_q3``), ``rmse``, ``psnr_db`` (as in
      ``compare``, not corrected for the noise of the truth), ``images``, ``seconds`` (likewise with quartiles),
      ``seconds_wall``, ``timed`` (number of timed renders);
    - ``ratios``, a list: ``spp``, ``median``, ``q1``, ``q3`` of learned / exact, ``wall`` the median of wall times;
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
    store = Store(folder, "scene", key, ("passes", "rounds"), progress)
    samples = len(VERSIONS) * (settings.passes * counts[-1] + settings.rounds * sum(counts[:-1])) + counts[-1]
    interrupted = False
    # A unit is a sample per pixel, so the remaining time is in proportion to the remaining units
    bar = tqdm(total=samples, desc="render", unit="spp", smoothing=0.05, disable=None if progress else True)
    with interruptible() as stop, bar:
        run = SceneRun(loaded, counts, settings, seed, store, width * height, bar, stop, launch_samples)
        try:
            run.passes()
            run.rounds()
        except Stopped:
            interrupted = True
    result = finite({
        **facts,
        "date": time.strftime("%Y-%m-%d"),
        "interrupted": interrupted,
        "resumed": store.resumed,
        **_assemble(store, counts),
    })  # fmt: skip
    return result | {"verdict": verdict(result)}


@dataclass
class SceneRun:
    """Renders of a run: each method renders the missing images and raises :class:`Stopped` after Ctrl-C."""

    loaded: dict
    counts: list[int]
    settings: SceneStudySettings
    seed: int
    store: Store
    pixels: int
    bar: tqdm
    stop: threading.Event
    launch_samples: int
    is_compiled: bool = False

    def passes(self) -> None:
        """Render the exact pass for the brightness, and pairs of the highest count with equal seeds."""
        top = self.counts[-1]
        store, done = self.store, self.store.data["passes"]
        if BRIGHTNESS not in store.arrays:
            store.keep(BRIGHTNESS, exact=self._render("exact", top, 0)[0])
            store.save()
        self.bar.update(top + len(VERSIONS) * top * len(done))
        for k in range(len(done), self.settings.passes):
            images, times = self._pair(top, 1 + k, k % 2 == 1)
            store.keep(str(k), **images)
            done[str(k)] = times
            store.save()

    def rounds(self) -> None:
        """Render pairs of the lower counts, learned and exact, with seeds that no pass has."""
        lower, done = self.counts[:-1], self.store.data["rounds"]
        self.bar.update(len(VERSIONS) * sum(spp * len(done.get(str(spp), [])) for spp in lower))
        exact = _images(self.store)["exact"]
        truth = np.mean(exact, axis=0, dtype=np.float64)
        weights = weights_of(self.store.arrays[BRIGHTNESS]["exact"])
        truth_noise = estimate(exact, weights).noise / self.settings.passes
        for k in range(self.settings.rounds):
            for spp in lower if k % 2 == 0 else reversed(lower):
                if len(done.get(str(spp), [])) > k:
                    continue
                number = k * len(lower) + lower.index(spp)
                images, records = self._pair(spp, 1 + self.settings.passes + number, (k + number) % 2 == 1)
                for name in VERSIONS:
                    records[name] |= _errors(images[name], truth, weights, truth_noise)
                done.setdefault(str(spp), []).append(records)
                self.store.save()

    def _pair(self, spp: int, number: int, learned_first: bool) -> tuple[dict, dict]:
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
            self.bar.update(spp)
        return images, records

    def _render(self, name: str, spp: int, number: int) -> tuple[np.ndarray, dict]:
        """Return an image, float32, with ``seconds``, ``seconds_wall`` (``None`` if it compiled) and ``not_finite``."""
        launches = 1 << ((spp * self.pixels - 1) // self.launch_samples).bit_length()
        render = timed(lambda: loading.render(self.loaded[name], spp, (self.seed << 8) + number, launches)[0])
        image = render.value[..., : 3 if render.value.shape[-1] >= 3 else 1]
        bad = ~np.isfinite(image)
        return np.where(bad, np.float32(0), image), {
            "seconds": None if render.compiled else render.seconds,
            "seconds_wall": None if render.compiled else render.seconds_wall,
            "not_finite": int(bad.sum()),
        }


def _images(store: Store) -> dict[str, list[np.ndarray]]:
    """Return the images of the passes, by version."""
    return {name: [store.arrays[k][name] for k in store.data["passes"]] for name in VERSIONS}


def _errors(image: np.ndarray, truth: np.ndarray, weights: np.ndarray, truth_noise: float) -> dict[str, float]:
    return {"mse": error(image, truth, weights, truth_noise), "psnr_db": metrics.psnr(truth, image)}


def _assemble(store: Store, counts: list[int]) -> dict:
    passes, rounds = list(store.data["passes"].values()), store.data["rounds"]
    records = {str(counts[-1]): [], **rounds}
    every = [*passes, *(pair for pairs in rounds.values() for pair in pairs)]
    result = {
        "not_finite": sum(t["not_finite"] for pair in every for t in pair.values()),
        **dict.fromkeys(("reference", "noise", "bias", "crossover")),
        "points": [],
        "ratios": [],
    }
    k = len(passes)
    if k < LEAST:
        return result
    images = _images(store)
    exact, learned = (images[name] for name in ("exact", "learned"))
    truth = np.mean(exact, axis=0, dtype=np.float64)
    weights = weights_of(store.arrays[BRIGHTNESS]["exact"])
    scatter = {name: estimate(images[name], weights) for name in VERSIONS}
    for i, times in enumerate(passes):
        mean_of_others, noise_of_mean = (k * truth - exact[i]) / (k - 1), scatter["exact"].noise / (k - 1)
        records[str(counts[-1])].append(
            {n: times[n] | _errors(images[n][i], mean_of_others, weights, noise_of_mean) for n in VERSIONS}
        )
    for spp in counts:
        pairs = records.get(str(spp), [])
        result["points"] += [{"version": n, "spp": spp, **_point([r[n] for r in pairs])} for n in VERSIONS if pairs]
        ratio = _ratio(pairs)
        if ratio:
            result["ratios"].append({"spp": spp, **ratio})
    differences = [l.astype(np.float64) - e for l, e in zip(learned, exact, strict=True)]
    bias, displayed = estimate(differences, weights), estimate(differences, truth <= 1)
    result["reference"] = {"spp": k * counts[-1], "passes": k, "noise_rmse": root(scatter["exact"].noise / k)}
    result["noise"] = {name: {"mse_of_a_sample": max(scatter[name].noise, 0.0) * counts[-1]} for name in VERSIONS}
    result["bias"] = describe(bias, displayed)
    result["crossover"] = crossover(bias, result["noise"]["learned"]["mse_of_a_sample"], result["points"])
    return result


def _point(records: list[dict]) -> dict:
    timed_records = [r for r in records if r["seconds"] is not None]
    mse = flat_spread("mse", (r["mse"] for r in records))
    return {
        **mse,
        "rmse": root(mse["mse"]),
        "psnr_db": float(np.median([r["psnr_db"] for r in records])),
        "images": len(records),
        **flat_spread("seconds", (r["seconds"] for r in timed_records)),
        **flat_spread("seconds_wall", (r["seconds_wall"] for r in timed_records)),
        "timed": len(timed_records),
    }


def _ratio(pairs: list[dict]) -> dict | None:
    timed_pairs = [r for r in pairs if all(r[name]["seconds"] is not None for name in VERSIONS)]
    if not timed_pairs:
        return None
    ratios = {key: [r["learned"][key] / r["exact"][key] for r in timed_pairs] for key in ("seconds", "seconds_wall")}
    return {**spread(ratios["seconds"]), "wall": spread(ratios["seconds_wall"])["median"]}


def rows(result: dict) -> list[dict]:
    """Return one table row, with the columns :data:`COLUMNS`, for each version and sample count.

    Time ratios (learned / exact) are in the rows of ``learned``.
    """
    ratios = {r["spp"]: r for r in result["ratios"]}
    table = []
    for point in result["points"]:
        row = {"scene": Path(result["scene"]).name, **point}
        if point["version"] == "learned" and point["spp"] in ratios:
            r = ratios[point["spp"]]
            row |= {"time_ratio": r["median"], "time_ratio_q1": r["q1"], "time_ratio_q3": r["q3"]}
            row["time_ratio_wall"] = r["wall"]
        table.append(row)
    return table


def write(result: dict, folder: str | os.PathLike) -> dict[str, str]:
    """Write the files of a result, with a picture if there is a timed point; return their paths."""
    pictures = {}
    if any(p["timed"] and p["rmse"] for p in result["points"]):
        pictures["png"] = lambda: draw(result)
    return report.write_files("scene", folder, result, rows(result), COLUMNS, pictures)


def caption(result: dict) -> str:
    """Return one paragraph about what was measured, on which machine and how."""
    reference, counts = result["reference"], ", ".join(map(str, result["counts"]))
    defines = "".join(f", {k}={v}" for k, v in result["defines"].items())
    bad = f" {result['not_finite']} values were not finite and counted as 0." if result["not_finite"] else ""
    return (
        f"{Path(result['scene']).name}{defines}, {result['width']} × {result['height']}, {counts} "
        f"samples per pixel (spp). Relative RMS error against {reference['spp']} spp of the exact scene, whose own "
        f"noise, {percent(reference['noise_rmse'])}, is subtracted. Medians and quartiles of images of "
        f"different seeds; seconds of the kernels of a whole render.{bad}"
    )


def summary(result: dict) -> list[str]:
    """Return lines of text: errors and times by sample count, the bias, the crossover and the verdict."""
    lines = [
        f"scene       {Path(result['scene']).name}, {result['width']} x {result['height']}, learned plugins: "
        f"{result['learned_plugins']}",
        f"variant     {result['variant']}",
        "",
    ]
    if not result["points"]:
        return [*lines, "interrupted before the first point; the same command continues the run"]
    lines.append("relative RMS error and seconds of the kernels, medians; learned / exact with quartiles")
    cells = [["spp", "exact: error", "seconds", "learned: error", "seconds", "learned / exact"]]
    ratios = {r["spp"]: f"{r['median']:.2f} ({r['q1']:.2f} to {r['q3']:.2f})" for r in result["ratios"]}
    points = {(p["version"], p["spp"]): p for p in result["points"]}
    for spp in result["counts"]:
        both = [points.get((name, spp)) for name in VERSIONS]
        texts = [t for p in both for t in ((percent(p["rmse"]), f"{p['seconds'] or 0:.3g}") if p else ("", ""))]
        cells.append([str(spp), *texts, ratios.get(spp, "")])
    lines += grid(cells)
    reference, bias = result["reference"], result["bias"]
    lines += ["", f"reference   {reference['spp']} spp, its own noise {percent(reference['noise_rmse'])} (subtracted)"]
    size = "not measured"
    if bias["measured"]:
        size = f"{percent(bias['rmse'])} ± {percent(bias['rmse_standard_error'], 2)}"
    lines.append(f"bias        {size}, {decibel(bias)}")
    if result["not_finite"]:
        lines.append(f"not finite  {result['not_finite']} values, counted as 0")
    if result["interrupted"]:
        lines.append("interrupted: the same command continues the run")
    return [*lines, "", result["verdict"]]


def decibel(bias: dict) -> str:
    """Return the PSNR of a bias, or its lower bound, as text."""
    if "psnr_db" in bias:
        return f"PSNR {bias['psnr_db']:.1f} dB"
    return "PSNR infinite" if bias["psnr_db_above"] is None else f"PSNR above {bias['psnr_db_above']:.1f} dB"


def verdict(result: dict) -> str | None:
    """Return one sentence about the sample count at which noise equals the bias; ``None`` before a bias is known."""
    bias, at = result["bias"], result["crossover"]
    if bias is None:
        return None
    if not bias["measured"]:
        count = at["spp_above"]
        limit = "at any number of samples" if count is None else f"up to {rounded(count)} spp at least"
        return f"No bias was found; it is below {percent(bias['rmse_below'])}, and noise dominates {limit}."
    seconds = f", {duration(at['seconds'])}" if at["seconds"] else ""
    how = ", extrapolated" * at["extrapolated"]
    return f"The noise equals the bias, {percent(bias['rmse'])}, at {rounded(at['spp'])} spp{seconds}{how}."


def draw(result: dict):
    """Draw the error of both versions against render time, and the bias or its upper bound as a line.

    Both axes are logarithmic, points have quartiles. Dashed curves continue the sum of noise and bias beyond the last
    point.
    """
    title = f"{Path(result['scene']).stem}: noise and bias at a given render time"
    figure = plot.figure(title, caption(result), 7.6, 4.9)
    axes = figure.add_subplot()
    bias = result["bias"]
    floor = bias["rmse"] if bias["measured"] else bias["rmse_below"]
    for (colour, marker), name in zip(plot.STYLES, reversed(VERSIONS), strict=False):
        curve = [p for p in result["points"] if p["version"] == name and p["timed"] and p["rmse"] > 0]
        xs, ys = [p["seconds"] for p in curve], [p["rmse"] for p in curve]
        ends = np.array([(p["rmse"] - root(p["mse_q1"]), root(p["mse_q3"]) - p["rmse"]) for p in curve]).T
        axes.errorbar(
            xs, ys, np.maximum(ends, 0), color=colour, marker=marker, markerfacecolor="white", capsize=2, label=name
        )
        for p in curve if name == "learned" else ():
            axes.annotate(f"{p['spp']} spp", (p["seconds"], p["rmse"]), (4, 4), textcoords="offset points", fontsize=7)
        if curve:
            axes.plot(*_continued(result, name, curve), color=colour, linestyle=(0, (4, 2.5)), alpha=0.75)
    shown = "bias of the approximation" if bias["measured"] else "bias of the approximation, upper bound"
    if floor:
        axes.axhline(floor, color="#7a3b8f", label=f"{shown}: {percent(floor)}, {decibel(bias)}")
    axes.set(xscale="log", yscale="log")
    plot.log_ticks(axes.xaxis, *axes.get_xlim())
    plot.log_ticks(axes.yaxis, *axes.get_ylim(), percent)
    plot.finish(axes, "seconds of a render (kernels)", "relative RMS error")
    axes.legend(fontsize=8)
    return figure


def _continued(result: dict, name: str, curve: list[dict]) -> tuple[list, list]:
    """Extrapolate noise (and, of the learned version, bias) from the last point on; return times and errors."""
    times, last = {p["spp"]: p["seconds"] for p in curve}, curve[-1]
    noise = result["noise"][name]["mse_of_a_sample"]
    square = max(result["bias"]["mse"], 0.0) if name == "learned" and result["bias"]["measured"] else 0.0
    offset = last["mse"] - square - noise / last["spp"]  # makes the curve begin at the last point
    most = min(max(result["crossover"].get("spp") or 0, 4 * last["spp"]), REACH * last["spp"])
    counts = np.geomspace(last["spp"], most, 100)
    errors = [math.sqrt(max(square + noise / n + offset * last["spp"] / n, 1e-30)) for n in counts]
    return [seconds_of(n, times) for n in counts], errors
