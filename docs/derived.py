"""Figures that a sentence derives from a study: ratios of times, samples at equal error, gains over filters."""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Any


def ratio(study: Any, case: str, query: str, name: str, other: str) -> float:
    """Return the time of a candidate over that of another: the median over rounds, else the ratio of the medians."""
    measured = study.content["cases"][case]
    medians = measured["ratios"].get(query, {})
    if f"{name} / {other}" in medians:
        return medians[f"{name} / {other}"]["median"]
    if f"{other} / {name}" in medians:
        return 1 / medians[f"{other} / {name}"]["median"]
    times = measured["queries"].get(query) or measured["passes"][query]
    return times[name]["time"] / times[other]["time"]


def time_over(study: Any, case: str, query: str, name: str, other: str) -> float:
    """Return the median time of a candidate over that of another, as in the tables of the pages."""
    times = study.content["cases"][case]["queries"][query]
    return times[name]["time"] / times[other]["time"]


def equal_samples(study: Any, stage: str, name: str, sampling: str = "") -> float:
    """Return how many samples a pixel a bitmap needs for the error of a filtered texture with one.

    ``sampling`` is ``""`` for independent samples, or ``"multijittered"``. Between sample counts, PSNR is linear in the
    logarithm of the count.
    """
    candidates = study.content["candidates"]
    key, suffix = f"psnr_{stage}_db", f", {sampling}" if sampling else ""
    curve = {1: candidates["bitmap, 1 spp"]["errors"][key]}
    for count in (2, 4, 8, 16, 32, 64, 128, 256):
        candidate = candidates.get(f"bitmap, {count} spp{suffix}")
        if candidate and key in candidate["errors"]:
            curve[count] = candidate["errors"][key]
    goal, counts = candidates[name]["errors"][key], sorted(curve)
    for low, high in itertools.pairwise(counts):
        if goal <= curve[high]:
            share = (goal - curve[low]) / (curve[high] - curve[low])
            return math.exp(math.log(low) + share * math.log(high / low))
    raise ValueError(f"{name}: no sample count of the study has this error")


def _runs(study: Any, material: str, which: str) -> list[dict]:
    """Return the records of a material: of a filter by its name, of the best one, or of all seeds of a training.

    ``which`` is the name of a filter, ``uncompressed`` or ``equal bytes`` for the best of either, ``trained`` for the
    weight λ = 0.9, or another weight as ``λ 0.5``; ``, no schedule`` after it names that way of a study with several.
    """
    from mi_diffind.studies.shading import curves

    curve = curves(study.content)[material]
    filters = {**curve.classical, **curve.compressed}
    if which in filters:
        return [filters[which]]
    if which in ("uncompressed", "equal bytes"):
        filters = curve.classical if which == "uncompressed" else curve.compressed
        return [max(filters.values(), key=lambda f: f["C"]["mean_db"])]
    way = "clip, no schedule" if which.endswith(", no schedule") else "clip, schedule"
    weight = which.removesuffix(", no schedule")
    return curve.runs[way, 0.9 if weight == "trained" else float(weight.removeprefix("λ "))]


def shading(study: Any, material: str, which: str, letter: str = "C") -> float:
    """Return the PSNR in dB of a material in the mean of levels and seeds, ``which`` as of :func:`_runs`."""
    return _mean(d[letter]["mean_db"] for d in _runs(study, material, which))


def shading_level(study: Any, material: str, which: str, level: int) -> float:
    """Return the PSNR in dB of a material at one level against the converged truth, in the mean of seeds."""
    return _mean(d["C"]["psnr_db"][level] for d in _runs(study, material, which))


def shading_spread(study: Any, material: str, which: str) -> float:
    """Return the range in dB of the mean PSNR of the seeds."""
    values = [d["C"]["mean_db"] for d in _runs(study, material, which)]
    return max(values) - min(values)


def flip(study: Any, material: str, which: str) -> float:
    """Return the mean FLIP of a material against the converged truth, ``which`` as of :func:`_runs`."""
    return _mean(_mean(d["C"]["flip"]) for d in _runs(study, material, which))


def _mean(values: Any) -> float:
    values = list(values)
    return sum(values) / len(values)


def held_out(study: Any, run: str) -> float:
    """Return the PSNR in dB of held-out views and lights after a training inside a scene."""
    (scene,) = study.content["details"]["scenes"]
    return study.content["jobs"][f"{scene}, {run}"]["details"]["psnr_db"]


def rendered(study: Any, scene: str, name: str, spp: int = 1) -> float:
    """Return the PSNR in dB of a whole render."""
    return next(p for p in study.content["scenes"][scene]["points"] if (p["name"], p["spp"]) == (name, spp))["psnr_db"]


def shipped(task: str, preset: str) -> float:
    """Return the PSNR in dB that is stored in the file that ships for a preset of a task."""
    from mi_diffind.fitting.task import tasks

    task = tasks()[task]
    return task.load(task.file(preset=preset)).measured["psnr_db"]


def asset_bytes(name: str) -> int:
    """Return the bytes of a file in ``scenes/assets``."""
    return (Path(__file__).resolve().parents[1] / "scenes" / "assets" / name).stat().st_size


def trust_cells(study: Any) -> tuple[int, int]:
    """Return the numbers of cells of the table of properties that were measured, and of all."""
    results = [c["result"] for by in study.content["cells"].values() for row in by.values() for c in row.values()]
    return len(results) - results.count("not run"), len(results)


#: Task of ``bench_ratio`` → figure of its tables; the angles of ``sdf`` are errors.
RATIO_FIGURES = {
    "image": "psnr_db", "texture": "psnr_levels_db", "sdf": "normal_deg", "field": "psnr_foreground_db",
}  # fmt: skip


def ratio_rows(study: Any, task: str, budget: float, preset: str = "paper", part: str = "") -> list[dict]:
    """Return the trainings of a sweep of ρ, from the largest on; figures are means over seeds."""
    wanted = {"task": task, "budget": budget, "preset": preset, "part": part}
    rows = [row for row in study.content["rows"] if all(row[key] == value for key, value in wanted.items())]
    figure, by_ratio = RATIO_FIGURES[task], {}
    for row in rows:
        by_ratio.setdefault(row["ratio"], []).append(row)
    means = [{**same[0], figure: _mean(row[figure] for row in same)} for same in by_ratio.values()]
    return sorted(means, key=lambda row: -row["ratio"])


def ratio_noise(study: Any, task: str) -> float:
    """Return the largest difference between trainings of the same arrays by different seeds."""
    figure, values = RATIO_FIGURES[task], {}
    for row in study.content["rows"]:
        if row["task"] == task:
            values.setdefault((row["preset"], row["budget"], row["ratio"]), []).append(row[figure])
    return max(max(same) - min(same) for same in values.values())


def ratio_best(study: Any, task: str, budget: float, preset: str = "paper", part: str = "") -> dict:
    """Return the training of the best ρ of a sweep."""
    sign = 1 if task == "sdf" else -1
    return min(ratio_rows(study, task, budget, preset, part), key=lambda row: sign * row[RATIO_FIGURES[task]])


def ratio_loss(study: Any, task: str, budget: float, preset: str = "paper", part: str = "") -> float:
    """Return how far the default ρ lies behind the best: in dB, of an angle relative to the best."""
    rows, figure = ratio_rows(study, task, budget, preset, part), RATIO_FIGURES[task]
    (default,) = [row for row in rows if row["default"]]
    best = ratio_best(study, task, budget, preset, part)[figure]
    return default[figure] / best - 1 if task == "sdf" else best - default[figure]


def ratio_range(study: Any, task: str) -> float:
    """Return the largest difference, in dB, of a sweep of ρ."""
    figure, sweeps = RATIO_FIGURES[task], {}
    for row in study.content["rows"]:
        if row["task"] == task:
            sweeps.setdefault((row["preset"], row["budget"], row["part"]), []).append(row[figure])
    return max(max(sweep) - min(sweep) for sweep in sweeps.values())
