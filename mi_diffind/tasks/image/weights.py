"""Weights of maps in a training by what an error of each map does to a shaded picture."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import ModuleType

from ...maps import as_seen
from ...maps.source import Source
from .compressed import CompressedImage
from .presets import ImageRecipe
from .search import default_size
from .training import layout_of, problem_of

#: Least weight of a map that pictures show, and of others such as ambient occlusion, in dB.
SHOWN_DB, OTHER_DB = -1.0, -2.0

#: Least gain of weights in the pictures of initial arrays, in dB.
GAIN_DB = 0.5

#: Side of the sample of a material for which initial arrays are compared, and of its patches, in texels.
SIDE, PATCH = 512, 64


def measured(source: Source, recipe: ImageRecipe, nbytes: float, types: ModuleType) -> dict[str, float]:
    """Return the weights that :func:`balanced` makes of sensitivities, if initial arrays of ``nbytes`` gain by them.

    Without a gain of :data:`GAIN_DB`, as seen, the result is empty: equal weights. So it is for a ``source`` that no
    picture shows, and for a recipe that does not start from components.
    """
    if not (as_seen.shows(source) and recipe.components and layout_of(source, recipe).stored):
        return {}
    nbytes, sample = nbytes / source.nbytes, _sample(source)
    channels = {name: len(indices) for name, indices in layout_of(sample, recipe).channels_by_map().items()}
    squares = as_seen.sensitivities(sample, types)
    weights = balanced({name: squares[name] for name in channels}, channels)
    before, after = (_start_db(sample, recipe, nbytes * sample.nbytes, types, w) for w in ({}, weights))
    return weights if after >= before + GAIN_DB else {}


def _sample(source: Source) -> Source:
    """Return the material of patches of a source."""
    maps = [dataclasses.replace(m, values=as_seen.patchwork(m.values, SIDE, PATCH)) for m in source.maps]
    height, width = maps[0].values.shape[:2]
    return Source(tuple(maps), height, width, f"{source.digest} sample")


def _start_db(source: Source, recipe: ImageRecipe, nbytes: float, types: ModuleType, weights: dict) -> float:
    """Return the PSNR as seen from near of initial arrays of ``nbytes`` bytes."""
    recipe = dataclasses.replace(recipe, weights=weights)
    problem = problem_of(source, default_size(source, nbytes, recipe), recipe, types)
    return as_seen.measure(source, CompressedImage(problem.layout, problem.net), as_seen.NEAR)["seen_db"]


def balanced(squares: Mapping[str, float], channels: Mapping[str, int]) -> dict[str, float]:
    """Return weights whose squares are proportional to ``squares``, where they are not below the least weights.

    Their geometric mean over all ``channels`` of a map is 1: about so many decibels as its weight has does a map gain.
    """
    least = {name: SHOWN_DB if square > 0 else OTHER_DB for name, square in squares.items()}
    wanted = {name: 10 * math.log10(square) if square > 0 else -math.inf for name, square in squares.items()}
    if not any(squares.values()):
        return {}

    def decibels(shift: float) -> dict[str, float]:
        return {name: max(least[name], wanted[name] + shift) for name in squares}

    low, high = -200.0, 200.0
    for _ in range(60):
        shift = 0.5 * (low + high)
        total = sum(channels[name] * db for name, db in decibels(shift).items())
        low, high = (shift, high) if total < 0 else (low, shift)
    return {name: float(f"{10 ** (db / 20):.3g}") for name, db in decibels(low).items()}
