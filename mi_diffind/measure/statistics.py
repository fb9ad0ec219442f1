"""Numbers made of measurements: medians and quartiles, times without what input and output cost, the Pareto front."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np

#: What takes less than this part of the floor beyond it is hidden behind input and output: all that is said of it is
#: that it takes less, and no ratio to it is made.
HIDDEN = 0.2


def spread(values: Iterable[float]) -> dict[str, float]:
    """Median and quartiles of the finite ones among ``values``: ``median``, ``q1``, ``q3``, NaN if there are none."""
    values = [v for v in values if math.isfinite(v)]
    q1, median, q3 = np.percentile(values, [25, 50, 75]) if values else [math.nan] * 3
    return {"median": float(median), "q1": float(q1), "q3": float(q3)}


def named(name: str, values: Iterable[float]) -> dict[str, float]:
    """:func:`spread`, flat: the median as ``NAME``, the quartiles as ``NAME_q1`` and ``NAME_q3``."""
    median, q1, q3 = spread(values).values()
    return {name: median, f"{name}_q1": q1, f"{name}_q3": q3}


def timing(values: Iterable[float], floor: float = 0.0) -> dict:
    """
    The time that rounds took, in their unit: ``time``, ``q1``, ``q3`` without the ``floor`` and not less than
    :data:`HIDDEN` of it; ``with_floor``; ``floor``; ``rounds``; and ``hidden``: ``time`` is only what it is below.
    """
    values = list(values)
    s, least = spread(values), HIDDEN * floor
    time, q1, q3 = (max(s[key] - floor, least) for key in ("median", "q1", "q3"))
    hidden = floor > 0 and s["median"] - floor < least
    return {"time": time, "q1": q1, "q3": q3, "with_floor": s["median"], "floor": floor, "rounds": len(values),
            "hidden": hidden}  # fmt: skip


def ratio(a: Sequence[float], b: Sequence[float], floor: float = 0.0) -> dict:
    """
    How many times the time of ``b`` is that of ``a``, round by round, without the ``floor``: ``median``, ``q1``, ``q3``
    (NaN if ``b`` is hidden behind the floor); ``with_floor``, the median with it; ``hidden``: ``a`` is hidden, so that
    the median is only what the ratio is below.
    """
    both = list(zip(a, b, strict=True))
    least = HIDDEN * floor
    if floor > 0 and spread(b)["median"] - floor < least:
        found = spread([])
    else:
        found = spread(max(x - floor, least) / (y - floor) if y > floor else math.nan for x, y in both)
    with_floor = spread(x / y if y > 0 else math.nan for x, y in both)["median"]
    return {**found, "with_floor": with_floor, "hidden": floor > 0 and spread(a)["median"] - floor < least}


def pareto(points: Sequence[Sequence[float]], slack: Sequence[float] | float = 0.0) -> list[bool]:
    """
    Which ``points`` are on the Pareto front, all coordinates being better when smaller: those that no other point
    beats in one coordinate without being beaten in another. Coordinates that differ by no more than ``slack`` (for
    each, or for all) are equal, and equal points share their fate; a point with a NaN is not on the front.
    """
    p = np.asarray(points, dtype=np.float64)
    if p.size == 0:
        return [False] * len(p)
    slack = np.asarray(slack)
    front = []
    for point in p:
        beaten = (p <= point + slack).all(axis=1) & (p < point - slack).any(axis=1)
        front.append(not np.isnan(point).any() and not beaten.any())
    return front


def finite(value):
    """A tree of numbers without NaN and infinities, which JSON does not have, and with lists for tuples."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
