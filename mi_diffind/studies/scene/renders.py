"""
A scene as written and with exact plugins, rendered at several sample counts: errors (:mod:`~mi_diffind.measure.bias`)
and times.

*Times* are those of the kernels of a whole render (:mod:`~mi_diffind.measure.clock`), and of everything (wall). Exact
and learned are rendered in turn. The kernel of a pass is the same for all sample counts; it is compiled before the
first pass, and should any other pass compile something, its times do not count. Ratios are medians of the ratios of
pairs.
"""

from __future__ import annotations

import os
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from tqdm import tqdm

from ... import metrics, plugins, scenes
from ...interrupt import interruptible
from ...measure.benchmark import Stopped
from ...measure.bias import LEAST, crossover, describe, error, estimate, root, weights_of
from ...measure.clock import machine, timed
from ...measure.statistics import finite, flat_spread, spread
from ...measure.store import Store, fingerprint, sources
from .verdict import verdict

#: The scene with its learned plugins, and with their exact counterparts.
VERSIONS = ("exact", "learned")

#: The name in the store of the exact image that the brightness is made of; passes have numbers.
BRIGHTNESS = "brightness"

#: Samples of the whole image in one launch, to stay far below the 2³² that Mitsuba can do.
_LAUNCH = 1 << 26

#: The highest sample count of a quick run.
_QUICK = 4


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

    @classmethod
    def choose(cls, quick: bool = False, spp: int | None = None) -> Settings:
        """For a run of minutes, or a ``quick`` one."""
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
    interrupted run. What is measured stays there until :func:`.report.write` has written the result. The same arguments
    give the same errors if the film's filter is a box. Values that are not finite count as 0.

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
    - ``bias``: :func:`~mi_diffind.measure.bias.describe`; ``crossover``: :func:`~mi_diffind.measure.bias.crossover`.

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
    files = {file for file, _ in scenes.tables_of(scene_path, learned)} | set(scenes.files_of(scene_path, defines))
    key = {**facts, "scene": Path(scene_path).name, "sources": fingerprint([*sources(), *files])}
    store = Store(folder, "scene", key, ("passes", "rounds"), progress)
    samples = len(VERSIONS) * (settings.passes * counts[-1] + settings.rounds * sum(counts[:-1])) + counts[-1]
    interrupted = False
    # A unit is a sample per pixel: what is left takes a time in proportion
    bar = tqdm(total=samples, desc="render", unit="spp", smoothing=0.05, disable=None if progress else True)
    with interruptible() as stop, bar:
        steps = _Steps(loaded, counts, settings, seed, store, width * height, bar, stop)
        try:
            steps.passes()
            steps.rounds()
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
class _Steps:
    """The steps of a run; each does what is missing, and raises :class:`Stopped` where it may be left off."""

    loaded: dict
    counts: list[int]
    settings: Settings
    seed: int
    store: Store
    pixels: int
    bar: tqdm
    stop: threading.Event
    warm: bool = False

    def passes(self) -> None:
        """
        The exact pass that the brightness is made of, and the pairs of passes of the highest count, learned and exact
        with the same seeds.
        """
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
        """Rounds of the lower counts, learned and exact with the same seeds, which are not those of the passes."""
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
                images, found = self._pair(spp, 1 + self.settings.passes + number, (k + number) % 2 == 1)
                for name in VERSIONS:
                    found[name] |= _errors(images[name], truth, weights, truth_noise)
                done.setdefault(str(spp), []).append(found)
                self.store.save()

    def _pair(self, spp: int, number: int, learned_first: bool) -> tuple[dict, dict]:
        """Both images of ``spp`` samples, of one ``number``, which stands for their seeds; and their times."""
        if not self.warm:
            for name in VERSIONS:
                self._render(name, self.counts[0], 0)
            self.warm = True
        images, found = {}, {}
        for name in reversed(VERSIONS) if learned_first else VERSIONS:
            if self.stop.is_set():
                raise Stopped
            images[name], found[name] = self._render(name, spp, number)
            self.bar.update(spp)
        return images, found

    def _render(self, name: str, spp: int, number: int) -> tuple[np.ndarray, dict]:
        """An image, float32, and ``seconds``, ``seconds_wall`` (``None`` if something was compiled), ``not_finite``."""
        launches = 1 << ((spp * self.pixels - 1) // _LAUNCH).bit_length()
        found = timed(lambda: scenes.render(self.loaded[name], spp, (self.seed << 8) + number, launches)[0])
        image = found.value[..., : 3 if found.value.shape[-1] >= 3 else 1]
        bad = ~np.isfinite(image)
        return np.where(bad, np.float32(0), image), {
            "seconds": None if found.compiled else found.seconds,
            "seconds_wall": None if found.compiled else found.seconds_wall,
            "not_finite": int(bad.sum()),
        }


def _images(store: Store) -> dict[str, list[np.ndarray]]:
    """The images of the passes, by version."""
    return {name: [store.arrays[k][name] for k in store.data["passes"]] for name in VERSIONS}


def _errors(image: np.ndarray, truth: np.ndarray, weights: np.ndarray, truth_noise: float) -> dict[str, float]:
    return {"mse": error(image, truth, weights, truth_noise), "psnr_db": metrics.psnr(truth, image)}


# -- the result -------------------------------------------------------------------------------------------------------


def _assemble(store: Store, counts: list[int]) -> dict:
    passes, rounds = list(store.data["passes"].values()), store.data["rounds"]
    taken = {str(counts[-1]): [], **rounds}
    every = [*passes, *(r for found in rounds.values() for r in found)]
    found = {
        "not_finite": sum(t["not_finite"] for versions in every for t in versions.values()),
        **dict.fromkeys(("reference", "noise", "bias", "crossover")),
        "points": [],
        "ratios": [],
    }
    k = len(passes)
    if k < LEAST:
        return found
    images = _images(store)
    exact, learned = images.values()
    truth = np.mean(exact, axis=0, dtype=np.float64)
    weights = weights_of(store.arrays[BRIGHTNESS]["exact"])
    of = {name: estimate(images[name], weights) for name in VERSIONS}
    for i, times in enumerate(passes):
        others = (k * truth - exact[i]) / (k - 1)
        left = of["exact"].noise / (k - 1)
        taken[str(counts[-1])].append(
            {name: times[name] | _errors(images[name][i], others, weights, left) for name in VERSIONS}
        )
    for spp in counts:
        for name in VERSIONS:
            of_version = [r[name] for r in taken.get(str(spp), [])]
            if of_version:
                found["points"].append({"version": name, "spp": spp, **_point(of_version)})
        ratio = _ratio(taken.get(str(spp), []))
        if ratio:
            found["ratios"].append({"spp": spp, **ratio})
    differences = [l.astype(np.float64) - e for l, e in zip(learned, exact, strict=True)]
    bias, displayed = estimate(differences, weights), estimate(differences, truth <= 1)
    found["reference"] = {"spp": k * counts[-1], "passes": k, "noise_rmse": root(of["exact"].noise / k)}
    found["noise"] = {name: {"mse_of_a_sample": max(of[name].noise, 0.0) * counts[-1]} for name in VERSIONS}
    found["bias"] = describe(bias, displayed)
    found["crossover"] = crossover(bias, found["noise"]["learned"]["mse_of_a_sample"], found["points"])
    return found


def _point(rounds: list[dict]) -> dict:
    timed = [r for r in rounds if r["seconds"] is not None]
    mse = flat_spread("mse", (r["mse"] for r in rounds))
    return {
        **mse,
        "rmse": root(mse["mse"]),
        "psnr_db": float(np.median([r["psnr_db"] for r in rounds])),
        "images": len(rounds),
        **flat_spread("seconds", (r["seconds"] for r in timed)),
        **flat_spread("seconds_wall", (r["seconds_wall"] for r in timed)),
        "timed": len(timed),
    }


def _ratio(rounds: list[dict]) -> dict | None:
    timed = [r for r in rounds if all(r[name]["seconds"] is not None for name in VERSIONS)]
    if not timed:
        return None
    ratios = {kind: [r["learned"][kind] / r["exact"][kind] for r in timed] for kind in ("seconds", "seconds_wall")}
    return {**spread(ratios["seconds"]), "wall": spread(ratios["seconds_wall"])["median"]}
