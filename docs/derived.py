"""Figures that a sentence derives from a study: ratios of times, samples at equal error, gains over filters."""

from __future__ import annotations

import itertools
import math
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


def shading(study: Any, material: str, which: str, letter: str = "C") -> float:
    """Return the PSNR in dB of a material: ``trained``, or by the best filter, ``uncompressed`` or ``equal bytes``."""
    from mi_diffind.studies.shading.conclusions import curves

    curve = curves(study.content)[material]
    if which in ("uncompressed", "equal bytes"):
        filters = curve.classical if which == "uncompressed" else curve.compressed
        return max(f[letter]["mean_db"] for f in filters.values())
    (way,) = curve.remedies
    runs = curve.runs[way, float(which.removeprefix("λ ")) if which.startswith("λ") else 0.9]
    return sum(d[letter]["mean_db"] for d in runs) / len(runs)


def flip(study: Any, material: str, which: str) -> float:
    """Return the mean FLIP of a material against the converged truth, as :func:`shading`."""
    from mi_diffind.studies.shading.conclusions import curves

    def average(record):
        values = record["C"]["flip"]
        return sum(values) / len(values)

    curve = curves(study.content)[material]
    if which in ("uncompressed", "equal bytes"):
        filters = curve.classical if which == "uncompressed" else curve.compressed
        return average(max(filters.values(), key=lambda f: f["C"]["mean_db"]))
    (way,) = curve.remedies
    runs = curve.runs[way, 0.9]
    return sum(map(average, runs)) / len(runs)


def shipped(task: str, preset: str) -> float:
    """Return the PSNR in dB that is stored in the file that ships for a preset of a task."""
    from mi_diffind.task import tasks

    task = tasks()[task]
    return task.load(task.file(preset=preset)).measured["psnr_db"]
