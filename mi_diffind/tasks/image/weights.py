"""Weights of maps in a training: by hand, or by what an error of each map does to a shaded picture."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import ModuleType

from ...maps import as_seen
from ...maps.layout import Layout
from ...maps.source import Source

#: Least weight of a map that pictures show, and of others such as ambient occlusion, in dB.
SHOWN_DB, OTHER_DB = -1.0, -2.0


def measured(source: Source, layout: Layout, types: ModuleType) -> dict[str, float]:
    """Return the weight of each map that :func:`balanced` makes of its sensitivity; none if no picture shows them."""
    if not as_seen.shows(source):
        return {}
    channels = {name: len(indices) for name, indices in layout.channels_by_map().items()}
    squares = as_seen.sensitivities(source, types)
    return balanced({name: squares[name] for name in channels}, channels)


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
