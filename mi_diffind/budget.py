"""
Noise or bias? A scene as written and with exact plugins, at several sample counts: error against render time.

A render with learned tables differs from the truth by the noise of its samples, which more time makes smaller, and by
the bias of the approximation, which no time makes smaller. This measures both, and where they are equal.

*The error* of an image ``a`` against the truth ``r`` is the relative mean squared error, over pixels and channels,

    mse = mean((a − r)² / (m² + 0.01)),        shown as its root, the relative RMS error,

where ``m`` is the brightness around the pixel, a mean over 5 × 5 pixels of an exact pass that serves nothing else. The
denominator depends on none of the images that are compared, and nothing is clipped, so that squares add up exactly:
E[mse] = bias² + noise², and for independent samples noise² = σ² / spp. (A denominator made of the truth itself would
be large just where the truth is too bright, and hide a part of the noise.) The PSNR of :mod:`.metrics` clips to [0, 1];
a clipped noisy image has another mean, so there is no such sum. It is given beside the rest; that of the bias is made
of the values up to 1 of the truth, where the clipped difference is the linear one. A dark pixel that one rare bright
path hits may outweigh all others: errors are those of several images with different seeds, given as median and
quartiles. The median of few samples therefore tends to be below the noise σ² / spp, which is a mean.

*The truth* is the mean of all exact passes at the highest sample count. These are independent, so their scatter is
its own noise, which is subtracted: E|a − r|² = bias² + noise² of ``a`` + noise² of ``r``. The passes are themselves
the images at that count, and each is measured against the mean of the others: no image is compared with its own seeds.

*The bias* is measured with common random numbers. Each exact pass has a learned twin with the same seed; most of the
noise is in both, and not in their difference ``d``. Of K independent differences, the mean of the scalar products
⟨dᵢ, dⱼ⟩ of all pairs i ≠ j is an unbiased estimate of bias²: the noise of two passes is uncorrelated. It may be
negative where there is no bias. Its standard error is the jackknife's (Efron and Stein 1981: on average not smaller
than the true one, and about 1.5 times as large where there is no bias). A bias counts as measured from two standard
errors on.

*The crossover* is the sample count at which the noise of the learned render, σ² / spp, equals bias²; σ² is the scatter
of its passes, and the law σ² / spp is that of independent samples (stratified ones do better). Beyond the counts that
were rendered, it is extrapolated, as is its time.

*Times* are those of the kernels of a whole render on Dr.Jit's own clock, and of everything (wall). Exact and learned
are rendered in turn. The kernel of a pass is the same for all sample counts; it is compiled before the first pass, and
should any other pass compile something, its times do not count. Ratios are medians of the ratios of pairs.

A long run can be interrupted at any time: what is done, images included, is kept in the output folder, and the same
command goes on from there, as long as settings, scene, tables, versions, machine and sources are the same.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from . import budget_plot, metrics, plugins, scenes
from .budget_plot import about, duration, percent
from .files import replacing, writable_folder, write_json
from .interrupt import interruptible
from .report import finite, machine_line
from .tradeoff import fingerprint, machine, spread

#: Added to the square of the brightness in the denominator of the error: linear values, 1 is white.
EPSILON = 0.01

#: The brightness is a mean over the pixels at most so far away in x and in y.
RADIUS = 2

#: A bias counts as measured if it is this many standard errors above zero, and else is below that many.
CONFIDENCE = 2.0

#: A relative error that the arithmetic of 32-bit floats makes in a render.
ROUNDING = 1e-6

#: The scene with its learned plugins, and with their exact counterparts.
VERSIONS = ("exact", "learned")

#: The name of the files that keep what has been measured, until the result is written: ``.json``; ``.0.npz`` with the
#: image that the brightness is made of, and ``.K.npz`` with both images of pass K = 1, 2, ….
PARTIAL = "tradeoff_scene.partial"

#: Samples of the whole image in one launch, to stay far below the 2³² that Mitsuba can do.
_LAUNCH = 1 << 26

#: The highest sample count of a quick run.
_QUICK = 4

#: Of fewer passes there is no standard error.
_LEAST_PASSES = 3


@dataclass(frozen=True)
class Settings:
    """
    How much is measured: the highest sample count ``spp`` (``None``: the scene's own, in a quick run at most 4), the
    ``step`` from one count to the next (a power of two), ``passes`` at the highest count, of which the truth is made
    (at least 3), and ``rounds`` of all lower counts.
    """

    spp: int | None = None
    step: int = 4
    passes: int = 8
    rounds: int = 5
    quick: bool = False

    def __post_init__(self):
        if self.spp is not None and self.spp < 1:
            raise ValueError(f"spp: found {self.spp}, at least 1 is needed")
        if self.step < 2 or self.step & (self.step - 1):
            raise ValueError(f"step: found {self.step}, a power of two is needed")
        if self.passes < _LEAST_PASSES:
            raise ValueError(f"passes: found {self.passes}, at least {_LEAST_PASSES} are needed")

    @classmethod
    def choose(cls, quick: bool = False, spp: int | None = None) -> Settings:
        """For a run of minutes, or a ``quick`` one. Raises ``ValueError`` if ``spp`` is given and below 1."""
        return cls(spp, 2, 8, 3, True) if quick else cls(spp)

    def counts(self, own: int) -> list[int]:
        """
        The sample counts of a scene whose ``own`` one is given, ascending: the highest, rounded down to a power of two
        (only with these are passes repeatable), and as many as there are below it, each by ``step``.
        """
        top = self.spp or (min(own, _QUICK) if self.quick else own)
        found = [1 << (top.bit_length() - 1)]
        while found[0] >= self.step:
            found.insert(0, found[0] // self.step)
        return found


@dataclass(frozen=True)
class Estimate:
    """
    What :func:`estimate` found: the ``square`` of the mean image (unbiased, so it may be negative), its
    ``standard_error``, and the ``noise`` of one image, likewise a mean square.
    """

    square: float
    standard_error: float
    noise: float

    @property
    def measured(self) -> bool:
        """Is the mean image different from zero?"""
        return self.square > CONFIDENCE * self.standard_error

    @property
    def bound(self) -> float:
        """What ``square`` is below, as far as can be told."""
        return max(self.square, 0.0) + CONFIDENCE * self.standard_error


def estimate(images: Sequence[np.ndarray], weights: np.ndarray | float = 1.0) -> Estimate:
    """
    The mean square of what independent ``images`` of the same distribution (K ≥ 3, of any one shape) have in common,
    and of what they do not: mean(weights · E[image]²) and mean(weights · Var[image]).

    With Gᵢⱼ = mean(weights · imageᵢ · imageⱼ), these are the mean of Gᵢⱼ over all i ≠ j and the mean of Gᵢᵢ less that;
    both are unbiased for any distribution of the noise. The standard error is the jackknife's, leaving out one image.
    Raises ``ValueError`` if there are fewer than three images.
    """
    k = len(images)
    if k < _LEAST_PASSES:
        raise ValueError(f"images: found {k}, at least {_LEAST_PASSES} are needed")
    gram = np.empty((k, k))
    for i in range(k):
        weighted = weights * images[i].astype(np.float64)
        for j in range(i + 1):
            gram[i, j] = gram[j, i] = np.mean(weighted * images[j])
    with_others = gram.sum(axis=1) - gram.diagonal()
    pairs = with_others.sum()
    square = pairs / (k * (k - 1))
    left_out = (pairs - 2 * with_others) / ((k - 1) * (k - 2))
    error = math.sqrt((k - 1) / k * np.sum((left_out - left_out.mean()) ** 2))
    return Estimate(float(square), error, float(gram.diagonal().mean() - square))


def weights_of(image: np.ndarray) -> np.ndarray:
    """
    The weights of the relative error, 1 / (m² + 0.01), like ``image`` ``(height, width, channels)``, linear; m is its
    mean over 5 × 5 pixels, or as many as there are of them at its edges.
    """
    sums, number = image.astype(np.float64), np.ones(image.shape)
    for axis in (0, 1):
        sums, number = (_along(v, axis) for v in (sums, number))
    return 1 / ((sums / number) ** 2 + EPSILON)


def _along(values: np.ndarray, axis: int) -> np.ndarray:
    """Sums over the neighbours along an axis."""
    width = [(RADIUS, RADIUS) if k == axis else (0, 0) for k in range(values.ndim)]
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, width), 2 * RADIUS + 1, axis)
    return windows.sum(axis=-1)


def error(image: np.ndarray, truth: np.ndarray, weights: np.ndarray, truth_noise: float) -> float:
    """
    mean(weights · (image − truth)²) − ``truth_noise``, of images of one shape: the relative MSE against what ``truth``
    would be without its noise, whose weighted mean square is ``truth_noise``.
    """
    return float(np.mean(weights * (image.astype(np.float64) - truth) ** 2)) - truth_noise


# -- measuring --------------------------------------------------------------------------------------------------------


class _Stopped(Exception):
    """The first Ctrl-C has been seen."""


class _Partial:
    """What has been measured, under a key, and the files that keep it if there is a folder."""

    def __init__(self, key: dict, folder: Path | None):
        self.key, self.folder = json.loads(json.dumps(key)), folder
        self.passes: list[dict] = []  # of each pass of the highest count: version → times
        self.rounds: dict[str, list[dict]] = {}  # count → of each round: version → errors and times
        self.images: dict[str, list[np.ndarray]] = {name: [] for name in VERSIONS}
        self.brightness: np.ndarray | None = None  # an exact image
        self.resumed = self.discarded = False
        if folder is not None and (folder / f"{PARTIAL}.json").is_file():
            self.discarded = True
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                self._read()

    def _read(self) -> None:
        found = json.loads((self.folder / f"{PARTIAL}.json").read_text(encoding="utf-8"))
        if found["key"] != self.key:
            return
        images = {name: [] for name in VERSIONS}
        with np.load(self.folder / f"{PARTIAL}.0.npz") as file:
            brightness = file["exact"]
        for k in range(len(found["passes"])):
            with np.load(self.folder / f"{PARTIAL}.{k + 1}.npz") as file:
                for name in VERSIONS:
                    images[name].append(file[name])
        self.passes, self.rounds, self.images, self.brightness = found["passes"], found["rounds"], images, brightness
        self.resumed, self.discarded = True, False

    def set_brightness(self, image: np.ndarray) -> None:
        self.brightness = image
        self._save_images(0, exact=image)
        self.save()

    def add_pass(self, images: dict[str, np.ndarray], times: dict[str, dict]) -> None:
        for name in VERSIONS:
            self.images[name].append(images[name])
        self.passes.append(times)
        self._save_images(len(self.passes), **images)
        self.save()

    def _save_images(self, k: int, **images: np.ndarray) -> None:
        if self.folder is not None:
            with replacing(self.folder / f"{PARTIAL}.{k}.npz") as temporary:
                np.savez(temporary, **images)

    def add(self, spp: int, found: dict[str, dict]) -> None:
        self.rounds.setdefault(str(spp), []).append(found)
        self.save()

    def save(self) -> None:
        if self.folder is not None:
            content = {"key": self.key, "passes": self.passes, "rounds": self.rounds}
            write_json(self.folder / f"{PARTIAL}.json", content)


def _remove_partial(folder: Path) -> None:
    (folder / f"{PARTIAL}.json").unlink(missing_ok=True)
    for path in folder.glob(f"{PARTIAL}.*.npz"):
        path.unlink(missing_ok=True)


def measure(
    scene_path: str | os.PathLike,
    settings: Settings,
    folder: str | os.PathLike | None = None,
    seed: int = 0,
    defines: dict[str, str] | None = None,
    progress: bool = True,
) -> dict:
    """
    Measure the errors and times of a scene file, learned and exact, or what is missing of them, if ``folder`` holds an
    interrupted run. What is measured stays there until :func:`write` has written the result. The same arguments give
    the same errors if the film's filter is a box. Values that are not finite count as 0.

    Returns the result, a tree of numbers and strings (JSON; ``None`` for what is not known). Errors are relative:
    ``mse`` as above, ``rmse`` its root. Seconds without ``_wall`` are those of the kernels.

    - ``scene``, ``variant``, ``width``, ``height``, ``seed``, ``defines``, ``learned_plugins``, ``settings``,
      ``machine``, ``date``, ``interrupted``, ``resumed``, ``counts`` (all sample counts asked for), ``not_finite``
      (how many values);
    - ``points``, a list: ``version``, ``spp``, ``mse`` (median; ``mse_q1``, ``mse_q3``), ``rmse``, ``psnr_db`` (as in
      ``compare``, not corrected for the noise of the truth), ``images``, ``seconds`` (likewise with quartiles),
      ``seconds_wall``, ``timed`` (how many times);
    - ``ratios``, a list: ``spp``, ``median``, ``q1``, ``q3`` of learned / exact, ``wall`` the median of wall times;
    - ``reference``: ``spp``, ``passes``, ``noise_rmse`` (subtracted from all errors);
    - ``noise``: for each version ``mse_of_a_sample``, σ²;
    - ``bias``: ``measured`` (can it be told from zero?), ``mse`` (may be negative), ``mse_standard_error``; ``rmse``
      and ``rmse_standard_error`` and ``rounding_only`` (no more than that of 32-bit floats), or else ``rmse_below``;
      ``psnr_db``, or else ``psnr_db_above``;
    - ``crossover``: ``spp`` with ``spp_low`` and ``spp_high`` (two standard errors), ``seconds``, ``seconds_wall``,
      ``extrapolated``; if no bias was measured, ``spp_above`` alone; and ``verdict``, a sentence.

    After Ctrl-C it is what there is up to then; ``points`` may be empty, and what is made of them ``None``. Raises
    :class:`~mi_diffind.scenes.SceneError`, also if the scene names no learned plugin, and
    :class:`~mi_diffind.files.OutputError` if the folder cannot be written.
    """
    defines = {k: str(v) for k, v in (defines or {}).items()}
    learned = scenes.learned_plugins(scene_path, defines)
    if not learned:
        names = ", ".join(plugins.with_counterpart())
        raise scenes.SceneError(f"{scene_path}: names no learned plugin ({names}), so there is nothing to compare")
    loaded = {name: scenes.load(scene_path, exact=name == "exact", defines=defines) for name in VERSIONS}
    sensor = loaded["learned"].sensors()[0]
    width, height = (int(v) for v in sensor.film().crop_size())
    counts = settings.counts(sensor.sampler().sample_count())
    folder = None if folder is None else writable_folder(folder, create=True)
    facts = {
        "scene": str(scene_path),
        "variant": mi.variant(),
        "width": width,
        "height": height,
        "seed": seed,
        "defines": defines,
        "learned_plugins": len(learned),
        "settings": asdict(settings),
        "counts": counts,
        "machine": machine(mi.variant()),
    }
    key = {**facts, "scene": Path(scene_path).name, "fingerprint": fingerprint(_files(scene_path, learned, defines))}
    partial = _Partial(key, folder)
    if progress and partial.resumed:
        print(f"going on from {folder / PARTIAL}.json", file=sys.stderr)
    if partial.discarded:
        if progress:
            print(
                f"{folder / PARTIAL}.json is of another scene or machine, other settings, versions or sources: "
                "starting anew",
                file=sys.stderr,
            )
        _remove_partial(folder)
    samples = len(VERSIONS) * (settings.passes * counts[-1] + settings.rounds * sum(counts[:-1])) + counts[-1]
    interrupted = False
    # A unit is a sample per pixel: what is left takes a time in proportion
    bar = tqdm(total=samples, desc="render", unit="spp", smoothing=0.05, disable=None if progress else True)
    with interruptible() as stop, bar:
        steps = _Steps(loaded, counts, settings, seed, partial, width * height, bar, stop)
        try:
            steps.passes()
            steps.rounds()
        except _Stopped:
            interrupted = True
    result = {
        **facts,
        "date": time.strftime("%Y-%m-%d"),
        "interrupted": interrupted,
        "resumed": partial.resumed,
        **_assemble(partial, counts),
    }
    result["verdict"] = _verdict(result)
    return finite(result)


class _Steps:
    """The steps of a run; each does what is missing, and raises :class:`_Stopped` where it may be left off."""

    def __init__(
        self,
        loaded: dict,
        counts: list[int],
        settings: Settings,
        seed: int,
        partial: _Partial,
        pixels: int,
        bar: tqdm,
        stop: threading.Event,
    ):
        self.loaded, self.counts, self.settings, self.seed = loaded, counts, settings, seed
        self.partial, self.bar, self.stop = partial, bar, stop
        self.launch = max(1, 1 << (max(_LAUNCH // pixels, 1).bit_length() - 1))  # samples of a pixel, a power of two
        self.launches = max(1, counts[-1] // self.launch)  # at most, of an image
        self.warm = False

    def passes(self) -> None:
        """
        The exact pass that the brightness is made of, and the pairs of passes of the highest count, learned and exact
        with the same seeds (even numbers).
        """
        top = self.counts[-1]
        if self.partial.brightness is None:
            self.partial.set_brightness(self._render("exact", top, 0)[0])
        self.bar.update(top + len(VERSIONS) * top * len(self.partial.passes))
        for k in range(len(self.partial.passes), self.settings.passes):
            images, times = self._pair(top, 2 * (k + 1) * self.launches, k % 2 == 1)
            self.partial.add_pass(images, times)

    def rounds(self) -> None:
        """Rounds of the lower counts, learned and exact with the same seeds (odd numbers)."""
        lower, done = self.counts[:-1], self.partial.rounds
        self.bar.update(len(VERSIONS) * sum(spp * len(done.get(str(spp), [])) for spp in lower))
        truth = np.mean(self.partial.images["exact"], axis=0, dtype=np.float64)
        weights = weights_of(self.partial.brightness)
        truth_noise = estimate(self.partial.images["exact"], weights).noise / self.settings.passes
        for k in range(self.settings.rounds):
            for spp in lower if k % 2 == 0 else reversed(lower):
                if len(done.get(str(spp), [])) > k:
                    continue
                number = k * len(lower) + lower.index(spp)
                images, found = self._pair(spp, 2 * number * self.launches + 1, (k + number) % 2 == 1)
                for name in VERSIONS:
                    found[name] |= _errors(images[name], truth, weights, truth_noise)
                self.partial.add(spp, found)

    def _pair(self, spp: int, number: int, learned_first: bool) -> tuple[dict, dict]:
        """Both images of ``spp`` samples, with seeds ``number``, ``number + 2``, …; and their times."""
        if not self.warm:
            for name in VERSIONS:
                self._render(name, self.counts[0], 0)
            self.warm = True
        images, found = {}, {}
        for name in reversed(VERSIONS) if learned_first else VERSIONS:
            if self.stop.is_set():
                raise _Stopped
            images[name], found[name] = self._render(name, spp, number)
            self.bar.update(spp)
        return images, found

    def _render(self, name: str, spp: int, number: int) -> tuple[np.ndarray, dict]:
        """An image, float32, and ``seconds``, ``seconds_wall`` (``None`` if something was compiled), ``not_finite``."""
        launch = min(spp, self.launch)
        image, kernels, wall, compiled = 0.0, 0.0, 0.0, False
        for i in range(spp // launch):
            part, *times = _timed(self.loaded[name], launch, (self.seed << 16) + number + 2 * i)
            image = image + part * (launch / spp)
            kernels, wall, compiled = kernels + times[0], wall + times[1], compiled or times[2]
        image = image[..., : 3 if image.shape[-1] >= 3 else 1].astype(np.float32)
        bad = ~np.isfinite(image)
        return np.where(bad, np.float32(0), image), {
            "seconds": None if compiled else kernels,
            "seconds_wall": None if compiled else wall,
            "not_finite": int(bad.sum()),
        }


def _timed(scene, spp: int, seed: int) -> tuple[np.ndarray, float, float, bool]:
    """One pass: image, seconds of its kernels, of everything, and whether any kernel was compiled."""
    with dr.suspend_grad(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.sync_thread()
        dr.kernel_history_clear()
        start = time.perf_counter()
        image = scenes.render_pass(scene, spp, seed)
        dr.sync_thread()
        wall = time.perf_counter() - start
        history = dr.kernel_history()
    compiled = any(not entry.get("cache_hit", True) or entry.get("cache_disk", False) for entry in history)
    return image, sum(entry["execution_time"] for entry in history) / 1e3, wall, compiled


def _errors(image: np.ndarray, truth: np.ndarray, weights: np.ndarray, truth_noise: float) -> dict[str, float]:
    return {"mse": error(image, truth, weights, truth_noise), "psnr_db": metrics.psnr(truth, image)}


def _files(scene_path, learned: list[dict], defines: dict[str, str]) -> set[str]:
    """All files on which a render depends: the scene, what it includes and names, its tables, and this package."""
    package = Path(__file__).resolve().parent
    found = {*package.rglob("*.py"), *Path(plugins.__file__).resolve().parent.rglob("*.py")}
    found |= {Path(file) for file, _ in scenes.tables_of(scene_path, learned)}
    found |= set(scenes.files_of(scene_path, defines))
    return {str(path.resolve()) for path in found}


# -- the result -------------------------------------------------------------------------------------------------------


def _assemble(partial: _Partial, counts: list[int]) -> dict:
    taken = {str(counts[-1]): [], **partial.rounds}
    found = {
        "not_finite": sum(t["not_finite"] for p in partial.passes for t in p.values())
        + sum(t["not_finite"] for rounds in partial.rounds.values() for r in rounds for t in r.values()),
        **dict.fromkeys(("reference", "noise", "bias", "crossover")),
        "points": [],
        "ratios": [],
    }
    k = len(partial.passes)
    if k < _LEAST_PASSES:
        return found
    exact, learned = (partial.images[name] for name in VERSIONS)
    truth = np.mean(exact, axis=0, dtype=np.float64)
    weights = weights_of(partial.brightness)
    of = {name: estimate(partial.images[name], weights) for name in VERSIONS}
    for i, times in enumerate(partial.passes):
        others = (k * truth - exact[i]) / (k - 1)
        left = of["exact"].noise / (k - 1)
        taken[str(counts[-1])].append(
            {name: times[name] | _errors(partial.images[name][i], others, weights, left) for name in VERSIONS}
        )
    for spp in counts:
        for name in VERSIONS:
            rounds = [r[name] for r in taken.get(str(spp), [])]
            if rounds:
                found["points"].append({"version": name, "spp": spp, **_point(rounds)})
        ratio = _ratio(taken.get(str(spp), []))
        if ratio:
            found["ratios"].append({"spp": spp, **ratio})
    differences = [l.astype(np.float64) - e for l, e in zip(learned, exact, strict=True)]
    bias, displayed = estimate(differences, weights), estimate(differences, truth <= 1)
    found["reference"] = {"spp": k * counts[-1], "passes": k, "noise_rmse": _root(of["exact"].noise / k)}
    found["noise"] = {name: {"mse_of_a_sample": max(of[name].noise, 0.0) * counts[-1]} for name in VERSIONS}
    found["bias"] = _bias(bias, displayed)
    found["crossover"] = _crossover(bias, found["noise"]["learned"]["mse_of_a_sample"], found["points"])
    return found


def _root(square: float) -> float:
    return math.sqrt(max(square, 0.0))


def _point(rounds: list[dict]) -> dict:
    mse = spread(r["mse"] for r in rounds)
    point = {"mse": mse["median"], "mse_q1": mse["q1"], "mse_q3": mse["q3"], "rmse": _root(mse["median"])}
    point |= {"psnr_db": float(np.median([r["psnr_db"] for r in rounds])), "images": len(rounds)}
    timed = [r for r in rounds if r["seconds"] is not None]
    for kind in ("seconds", "seconds_wall"):
        s = spread(r[kind] for r in timed)
        point |= {kind: s["median"], f"{kind}_q1": s["q1"], f"{kind}_q3": s["q3"]}
    return point | {"timed": len(timed)}


def _ratio(rounds: list[dict]) -> dict | None:
    timed = [r for r in rounds if all(r[name]["seconds"] is not None for name in VERSIONS)]
    if not timed:
        return None
    ratios = {kind: [r["learned"][kind] / r["exact"][kind] for r in timed] for kind in ("seconds", "seconds_wall")}
    return {**spread(ratios["seconds"]), "wall": spread(ratios["seconds_wall"])["median"]}


def _bias(relative: Estimate, displayed: Estimate) -> dict:
    found = {
        "measured": relative.measured,
        "mse": relative.square,
        "mse_standard_error": relative.standard_error,
    }
    if relative.measured:
        rmse = math.sqrt(relative.square)
        found |= {"rmse": rmse, "rmse_standard_error": relative.standard_error / (2 * rmse)}
        found["rounding_only"] = rmse < ROUNDING
    else:
        found["rmse_below"] = math.sqrt(relative.bound)
    if displayed.measured:
        found["psnr_db"] = -10 * math.log10(displayed.square)
    else:
        found["psnr_db_above"] = -10 * math.log10(displayed.bound) if displayed.bound else math.inf
    return found


def _crossover(bias: Estimate, noise_of_a_sample: float, points: list[dict]) -> dict:
    if not bias.measured:
        return {"spp_above": noise_of_a_sample / bias.bound if bias.bound else math.inf}
    spp, low = (noise_of_a_sample / square for square in (bias.square, bias.bound))
    found = {
        "spp": spp,
        "spp_low": low,
        "spp_high": noise_of_a_sample / (bias.square - CONFIDENCE * bias.standard_error),
        "extrapolated": spp > points[-1]["spp"],
    }
    for kind in ("seconds", "seconds_wall"):
        seconds = {p["spp"]: p[kind] for p in points if p["version"] == "learned" and p["timed"]}
        found[kind] = budget_plot.seconds_of(spp, seconds)
    return found


def _verdict(result: dict) -> str | None:
    """What it comes to, in a sentence."""
    bias, crossover, counts = result["bias"], result["crossover"], result["counts"]
    if bias is None:
        return None
    if not bias["measured"]:
        if not bias["rmse_below"]:
            return "Learned and exact renders do not differ at all."
        return (
            f"No bias was found; if there is one, it is below {percent(bias['rmse_below'])}, and noise dominates at "
            f"every budget up to {about(crossover['spp_above'])} spp at least."
        )
    size, spp = percent(bias["rmse"]), crossover["spp"]
    if bias["rounding_only"]:
        return f"Learned and exact renders differ by rounding only ({size}): noise dominates at every budget."
    if spp < counts[0]:
        return f"The approximation dominates at every budget: its bias, {size}, exceeds the noise of {counts[0]} spp."
    when = f"about {about(spp)} spp" + (f" ({duration(crossover['seconds'])})" if crossover["seconds"] else "")
    if spp <= counts[-1]:
        return f"Up to {when} noise dominates; beyond, the bias of the approximation, {size}, and time hardly helps."
    last = next((p for p in reversed(result["points"]) if p["version"] == "learned" and p["timed"]), None)
    budget = f"{counts[-1]} spp" + (f" ({duration(last['seconds'])})" if last else "")
    return (
        f"Noise dominates at every budget measured, up to {budget}; by extrapolation, it would equal the bias of the "
        f"approximation, {size}, at {when}."
    )


COLUMNS = (
    "scene",
    "version",
    "spp",
    "mse",
    "mse_q1",
    "mse_q3",
    "rmse",
    "psnr_db",
    "images",
    "seconds",
    "seconds_q1",
    "seconds_q3",
    "seconds_wall",
    "seconds_wall_q1",
    "seconds_wall_q3",
    "timed",
    "time_ratio",
    "time_ratio_q1",
    "time_ratio_q3",
    "time_ratio_wall",
)


def rows(result: dict) -> list[dict]:
    """
    The result as a table, with the columns :data:`COLUMNS`: one row for each version and sample count; time ratios
    (learned / exact) are in the rows of ``learned``.
    """
    ratios = {r["spp"]: r for r in result["ratios"]}
    found = []
    for point in result["points"]:
        row = {"scene": Path(result["scene"]).name, **point}
        if point["version"] == "learned" and point["spp"] in ratios:
            r = ratios[point["spp"]]
            row |= {"time_ratio": r["median"], "time_ratio_q1": r["q1"], "time_ratio_q3": r["q3"]}
            row["time_ratio_wall"] = r["wall"]
        found.append(row)
    return found


def write(result: dict, folder: str | os.PathLike) -> dict[str, str]:
    """
    Write ``tradeoff.csv`` (see :func:`rows`), ``tradeoff.json`` (``result``) and, if there is anything to draw,
    ``tradeoff.png`` into ``folder``, which is made if its parent exists; of a run that is complete, nothing else stays
    there. Returns the paths. Raises :class:`~mi_diffind.files.OutputError`.
    """
    folder = writable_folder(folder, create=True)
    paths = {kind: str(folder / f"tradeoff.{kind}") for kind in ("csv", "json", "png")}
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows(result))
    with replacing(paths["csv"]) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")
    write_json(paths["json"], result)
    if any(p["timed"] and p["rmse"] for p in result["points"]):
        budget_plot.write(paths["png"], result, caption(result))
    else:
        del paths["png"]
    if not result["interrupted"]:
        _remove_partial(folder)
    return paths


def caption(result: dict) -> str:
    """What the figures were measured on and how, as one paragraph."""
    reference = result["reference"]
    defines = "".join(f", {k}={v}" for k, v in result["defines"].items())
    quick = " A smoke run (--quick): times are not to be quoted." if result["settings"]["quick"] else ""
    state = " Interrupted: fewer images than asked for." if result["interrupted"] else ""
    bad = f" {result['not_finite']} values were not finite and counted as 0." if result["not_finite"] else ""
    return (
        f"{Path(result['scene']).name}{defines}, {result['width']} × {result['height']}, {_list(result['counts'])} "
        f"samples per pixel (spp). Relative RMS error against {reference['spp']} spp of the exact scene, whose own "
        f"noise, {percent(reference['noise_rmse'])}, is subtracted. Medians and quartiles of {_images(result)} of "
        f"different seeds; seconds of the kernels of a whole render. {machine_line(result)}{bad}{quick}{state}"
    )


def _list(counts: list[int]) -> str:
    return str(counts[0]) if len(counts) == 1 else f"{', '.join(map(str, counts[:-1]))} and {counts[-1]}"


def _images(result: dict) -> str:
    numbers = sorted({p["images"] for p in result["points"]})
    return f"{numbers[0]} images" if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]} images"


def summary(result: dict) -> list[str]:
    """The result as lines of text: errors and times by sample count, then the bias, the crossover and the verdict."""
    materials = "1 learned plugin" if result["learned_plugins"] == 1 else f"{result['learned_plugins']} learned plugins"
    lines = [
        f"scene       {Path(result['scene']).name}, {result['width']} x {result['height']}, {materials}",
        f"variant     {result['variant']}",
        "",
    ]
    if not result["points"]:
        return [*lines, "interrupted before there was anything to show; the same command goes on from there"]
    lines.append("relative RMS error and seconds of the kernels, medians ± half the interquartile range")
    head = ("spp", "exact: error", "seconds", "learned: error", "seconds", "learned / exact")
    widths = (8, 20, 18, 20, 18, 24)
    lines.append("".join(f"{text:>{w}}" for text, w in zip(head, widths, strict=True)))
    ratios = {r["spp"]: r for r in result["ratios"]}
    for spp in result["counts"]:
        cells = [f"{spp}"]
        for name in VERSIONS:
            point = next((p for p in result["points"] if (p["version"], p["spp"]) == (name, spp)), None)
            cells += ["", ""] if point is None else [_error_cell(point), _seconds_cell(point)]
        r = ratios.get(spp)
        cells.append(f"{r['median']:.2f} ({r['q1']:.2f} to {r['q3']:.2f})" if r else "")
        lines.append("".join(f"{text:>{w}}" for text, w in zip(cells, widths, strict=True)))
    reference, bias, crossover = result["reference"], result["bias"], result["crossover"]
    lines += ["", f"reference   {reference['spp']} spp, its own noise {percent(reference['noise_rmse'])} (subtracted)"]
    psnr = f"PSNR {bias['psnr_db']:.1f} dB" if "psnr_db" in bias else f"PSNR {_psnr(bias['psnr_db_above'])}"
    if bias["measured"]:
        lines.append(f"bias        {percent(bias['rmse'])} ± {percent(bias['rmse_standard_error'], 2)}, {psnr}")
        when = f"{about(crossover['spp_low'])} to {about(crossover['spp_high'])}"
        seconds = f", {duration(crossover['seconds'])}" if crossover["seconds"] is not None else ""
        how = ", extrapolated" if crossover["extrapolated"] else ""
        lines.append(f"crossover   {about(crossover['spp'])} spp ({when}){seconds}{how}")
    else:
        above = crossover["spp_above"]
        lines.append(f"bias        below {percent(bias['rmse_below'])}, {psnr}")
        lines.append("crossover   " + ("none" if above is None else f"above {about(above)} spp"))
    if result["not_finite"]:
        lines.append(f"not finite  {result['not_finite']} values, counted as 0")
    if result["interrupted"]:
        lines.append("interrupted: the same command goes on from there")
    return [*lines, "", result["verdict"]]


def _psnr(db: float | None) -> str:
    return "infinite" if db is None else f"above {db:.1f} dB"


def _error_cell(point: dict) -> str:
    half = (_root(point["mse_q3"]) - _root(point["mse_q1"])) / 2
    return f"{percent(point['rmse'])} ± {percent(half, 2)}"


def _seconds_cell(point: dict) -> str:
    if not point["timed"]:
        return "-"
    half = (point["seconds_q3"] - point["seconds_q1"]) / 2
    return f"{point['seconds']:.3g} ± {half:.2g}"
