"""Search for the smallest file of a wanted quality, by a few short trainings and one or more of full length."""

import math
from collections.abc import Callable

from ..arrays.tables import Table
from ..core.errors import UsageError
from ..fitting.loop import FitResult
from ..fitting.task import FitRequest, FitSettings, FittingError
from .source import Source

#: Share of the steps of a short training.
SHORT = 1 / 8

#: Most short trainings, most of full length, and most of full length if time is limited.
SHORT_TRAININGS = 4
TRAININGS = 5
LIMITED_TRAININGS = 2

#: Largest excess of a quality that ends the search, in dB.
EXCESS_DB = 0.3

#: Largest ratio of the smallest sufficient and the largest insufficient file at which the search ends.
NEAR = 1.06

#: Gain by twice the bytes: first guess, least and largest, in dB.
OCTAVE_DB = 2.5
OCTAVE_LIMITS_DB = (1.0, 8.0)

#: First guess of the gain of a training of full length over a short one, in dB.
GAIN_DB = 0.5

#: Most octaves of bytes from one training to the next.
MOST_OCTAVES = 3


def check_psnr(request: FitRequest, *excluded: str) -> None:
    """Raise :class:`UsageError` if ``--psnr`` meets ``--checkpoint``, or an option of those ``excluded``, by name."""
    options = request.options
    if options["psnr"] is None:
        return
    if request.checkpoint is not None:
        raise UsageError("--checkpoint: for one training, but --psnr makes several: leave one of them out")
    if given := [f"--{name}" for name in excluded if options[name] is not None]:
        raise UsageError(f"--psnr: chooses the arrays: leave out {', '.join(given)}")


def search_by_psnr(
    source: Source,
    goal: float,
    request: FitRequest,
    settings: FitSettings,
    size_of: Callable[[float], object],
    train: Callable[[object, int, FitRequest, str], tuple[Table, FitResult]],
) -> tuple[Table, FitResult, list[dict]]:
    """Search the smallest file whose ``psnr_db`` is at least ``goal``.

    - ``size_of(nbytes)``: arrays of a number of bytes, with ``nbytes``, and ``full`` if there are no larger ones.
    - ``train(size, steps, request, title)``: the table, with ``measured["psnr_db"]``, and the record of a training.

    Sizes follow the secant of quality over the logarithm of bytes. Short trainings find where the quality is near;
    trainings of full length, of ``settings.steps`` steps, end within :data:`EXCESS_DB` of the goal, or where a
    sufficient size is within :data:`NEAR` of an insufficient one, or after :data:`TRAININGS`. No size
    is larger than the source.

    Returns the table, the record of its training, and all trainings (``bytes``, ``steps``, ``psnr_db``). After Ctrl-C
    the record is marked ``interrupted``. Raises :class:`FittingError`, or after Ctrl-C ``KeyboardInterrupt``, if no
    training has reached the goal.
    """
    tried, best, interrupted = [], None, False
    most = TRAININGS if request.deadline is None else LIMITED_TRAININGS
    lengths = [max(1, round(SHORT * settings.steps))] * SHORT_TRAININGS + [settings.steps] * most
    nbytes = middle = source.nbytes / 12
    gain, rest = GAIN_DB, [*lengths]
    while rest and not interrupted:
        steps = rest[0]
        wanted = goal - gain if steps < settings.steps else goal
        sizes = [size_of(min(n, source.nbytes)) for n in (nbytes, middle)]
        known = [t["bytes"] for t in tried if t["steps"] == steps]
        size = next((s for s in sizes if s.nbytes not in known), None)
        if size is None:
            if steps == settings.steps:
                break
            rest = rest[rest.count(steps) :]
            continue
        limited = request.part(steps / sum(rest))
        table, result = train(size, steps, limited, f"try {size.nbytes:,} bytes, {steps} steps")
        rest = rest[1:]
        psnr, interrupted = table.measured["psnr_db"], result.interrupted
        tried.append({"bytes": size.nbytes, "steps": steps, "psnr_db": psnr})
        if psnr >= goal and (best is None or table.nbytes < best[0].nbytes):
            best = table, result
        points = [(t["bytes"], t["psnr_db"]) for t in tried if t["steps"] == steps]
        below = max((p for p in points if p[1] < wanted), default=None)
        above = min((p for p in points if p[1] >= wanted), default=None)
        largest = getattr(size, "full", False) or size.nbytes >= 0.99 * source.nbytes
        ended = bool(below and above and above[0] <= NEAR * below[0]) or (psnr < wanted and largest)
        if steps == settings.steps:
            if ended or goal <= psnr <= goal + EXCESS_DB:
                break
        elif ended or abs(psnr - wanted) <= 2 * EXCESS_DB or rest[0] != steps:
            rest = rest[rest.count(steps) :]
        nbytes, middle = _next_bytes((size.nbytes, psnr), below, above, wanted, _octave_db(tried))
    if interrupted and best is None:
        raise KeyboardInterrupt
    if best is None:
        nearest = max(tried, key=lambda t: t["psnr_db"])
        raise FittingError(
            f"{request.options['source']}: {goal:g} dB were not reached; the best of {len(tried)} trainings had "
            f"{nearest['psnr_db']:.2f} dB in {nearest['bytes']:,} bytes: give more --steps or a lower --psnr"
        )
    best[1].interrupted = interrupted
    return *best, tried


def search_lines(tried: list[dict]) -> list[str]:
    """Return the trainings of :func:`search_by_psnr` as lines of text."""
    return [f"tried {t['bytes']:,} bytes in {t['steps']} steps: {t['psnr_db']:.2f} dB" for t in tried]


def _octave_db(tried: list[dict]) -> float:
    """Return the gain by twice the bytes, of the two latest trainings of equal steps and different sizes."""
    last = tried[-1]
    for t in reversed(tried[:-1]):
        if t["steps"] == last["steps"] and t["bytes"] != last["bytes"]:
            slope = (last["psnr_db"] - t["psnr_db"]) / math.log2(last["bytes"] / t["bytes"])
            return min(max(slope, OCTAVE_LIMITS_DB[0]), OCTAVE_LIMITS_DB[1])
    return OCTAVE_DB


def _next_bytes(point: tuple, below: tuple | None, above: tuple | None, wanted: float, octave_db: float) -> tuple:
    """Return the bytes of the next training, and those to take if they lead to a size that was tried."""
    if below and above and below[0] < above[0]:
        share = (wanted + EXCESS_DB / 2 - below[1]) / max(above[1] - below[1], 1e-6)
        nbytes = below[0] * (above[0] / below[0]) ** min(max(share, 0.1), 0.9)
        return nbytes, math.sqrt(below[0] * above[0])
    octaves = (wanted + EXCESS_DB / 2 - point[1]) / octave_db
    nbytes = point[0] * 2 ** min(max(octaves, -MOST_OCTAVES), MOST_OCTAVES)
    return nbytes, nbytes
