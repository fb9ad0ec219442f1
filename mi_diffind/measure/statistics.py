"""Statistics of measurements: medians and quartiles, times and ratios without the floor."""

import math
from collections.abc import Iterable, Sequence

import numpy as np

#: A time that exceeds the floor by less than this part of the floor is hidden behind input and output: only a bound of
#: it is given, and no ratio to it.
HIDDEN = 0.2


def spread(values: Iterable[float]) -> dict[str, float]:
    """Return ``median``, ``q1`` and ``q3`` of the finite ``values``, NaN if there are none."""
    values = [v for v in values if math.isfinite(v)]
    q1, median, q3 = np.percentile(values, [25, 50, 75]) if values else [math.nan] * 3
    return {"median": float(median), "q1": float(q1), "q3": float(q3)}


def timing(values: Iterable[float], floor: float = 0.0) -> dict:
    """Return the time of rounds without the ``floor``, in the unit of ``values``.

    ``time``, ``q1``, ``q3`` are at least :data:`HIDDEN` of the floor; ``with_floor`` is the median with it, ``floor``
    and ``rounds`` are as given; ``hidden``: ``time`` is only an upper bound.
    """
    values = list(values)
    median, q1, q3 = spread(values).values()
    least = HIDDEN * floor
    times = {name: max(value - floor, least) for name, value in (("time", median), ("q1", q1), ("q3", q3))}
    return {**times, "with_floor": median, "floor": floor, "rounds": len(values), "hidden": median - floor < least}


def ratio(a: Sequence[float], b: Sequence[float], floor: float = 0.0) -> dict:
    """Return the ratio ``a / b`` of times, round by round, without the ``floor``.

    ``median``, ``q1``, ``q3`` are NaN if ``b`` is hidden behind the floor.
    """
    least = HIDDEN * floor
    hidden = spread(b)["median"] - floor < least
    rounds = [] if hidden else [(x, y) for x, y in zip(a, b, strict=True) if y > floor]
    return spread(max(x - floor, least) / (y - floor) for x, y in rounds)


def finite(value):
    """Return a tree with ``None`` for NaN and infinities, which JSON does not have, and with lists for tuples."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
