"""Sizes as users write them (bytes, compression ratios, bits per texel), and figures as people read them."""

import math
import os
import re
from collections.abc import Callable, Mapping

from .errors import UsageError

_NUMBER = r"(\d+\.?\d*|\.\d+)(e[+-]?\d+)?"
#: End of the name of a figure → its unit and the digits after the point.
_FIGURE_UNITS = {"_db": (" dB", 2), "_deg": ("°", 2)}
#: Word in the name of a figure → text.
_WORDS = {
    "psnr": "PSNR", "ssim": "SSIM", "mae": "MAE", "brdf": "BRDF", "iou": "IoU", "flip": "FLIP",
    "between": "between texels", "worst": "worst level", "seen": "as seen,", "shaded": "PSNR shaded,",
    "converged": "converged truth",
    "prefiltered": "prefiltered truth",
}  # fmt: skip
#: Most samples per pixel of a picture: up to there, each pass of 16 has random numbers of its own.
MOST_SAMPLES = 2**20

_UNITS = {"": 1, "k": 1024, "m": 1024**2, "g": 1024**3}


def parse_compression(text: str | float) -> float:
    """Return a compression ratio, written as ``12x`` or ``12``. Raises ``ValueError``."""
    return _positive(text, r"\s*[x×]?", "a compression ratio", "12x or 7.5")[0]


def parse_bpp(text: str | float) -> float:
    """Return a number of bits per texel of all channels together, such as ``2``. Raises ``ValueError``."""
    return _positive(text, "", "a number of bits per texel", "2 or 0.5")[0]


def parse_bytes(text: str | float) -> int:
    """Return a number of bytes, written as ``262144``, ``256k`` or ``1.5M``.

    k = 1024, M = 1024², G = 1024³, in either case, with or without ``B`` or ``iB``. Raises ``ValueError``.
    """
    number, match = _positive(text, r"\s*(?P<unit>[kmg]?)(i?b)?", "a number of bytes", "262144, 256k or 1.5M")
    value = number * _UNITS[match["unit"].lower()]
    if not 1 <= value < 2**63:
        raise ValueError(f"{text!r} is {value:.3g} bytes, allowed are 1 to 2⁶³")
    return round(value)


def memory() -> int:
    """Return the bytes of memory of this machine; 64 GiB where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return 2**36


def check_memory(name: str, value: float | str, nbytes: float) -> None:
    """Refuse a ``value`` of an option, a number or a text, that takes about ``nbytes`` bytes of memory.

    Raises :class:`.UsageError` if the machine has less.
    """
    if nbytes > memory():
        needed, there = (f"{n / 2**30:,.0f} GiB" for n in (nbytes, memory()))
        value = value if isinstance(value, str) else f"{value:,}"
        raise UsageError(f"{name}: found {value}, which takes about {needed} of memory, this machine has {there}")


def check_samples(spp: int) -> None:
    """Refuse a number of samples per pixel beyond :data:`MOST_SAMPLES`. Raises UsageError."""
    if not 1 <= spp <= MOST_SAMPLES:
        raise UsageError(f"spp: found {spp:,} samples per pixel, allowed are 1 to {MOST_SAMPLES:,}")


def check_size(name: str, value: float, most: float) -> None:
    """Refuse a number of bytes above ``most``, as of a table file. Raises :class:`.UsageError`."""
    if value > most:
        raise UsageError(f"{name}: found {value:,} bytes, a table file holds at most {most:,}")


def _positive(text, ending: str, quantity: str, example: str) -> tuple[float, re.Match]:
    """Return the number before an ``ending`` (a regular expression), and the match. Raises ``ValueError``."""
    match = re.fullmatch(rf"(?P<number>{_NUMBER}){ending}", str(text).strip(), re.IGNORECASE | re.ASCII)
    value = float(match["number"]) if match else math.nan
    if not (value > 0 and math.isfinite(value)):
        raise ValueError(f"{text!r} is not {quantity}, allowed are finite numbers > 0 such as {example}")
    return value, match


def largest_fitting(fits: Callable[[float], bool], low: float, high: float, steps: int | None = None) -> float:
    """Return the largest number from ``low`` to below ``high`` that ``fits``, by bisection; ``low`` if none does.

    ``fits`` holds up to some number and not beyond, such as "this side takes at most so many bytes". Both ends are
    whole numbers, and so is the result; with ``steps``, they are real numbers and are halved that often.
    """
    while high - low > 1 if steps is None else steps > 0:
        middle = (low + high) // 2 if steps is None else (low + high) / 2
        low, high = (middle, high) if fits(middle) else (low, middle)
        steps = steps and steps - 1
    return low


def figure_lines(figures: Mapping[str, float]) -> list[str]:
    """Return figures as lines of a table for people: ``psnr_albedo_db``, 42.4 → ``PSNR albedo  42.40 dB``.

    Figures of levels of detail (``psnr_l0_db``, ``psnr_l1_db``, …) share a line.
    """
    rows: dict[tuple[str, str], list[str]] = {}
    for name, value in figures.items():
        end = next((end for end in _FIGURE_UNITS if name.endswith(end)), "")
        unit, digits = _FIGURE_UNITS.get(end, ("", None))
        words = ["of levels" if re.fullmatch(r"l\d+", word) else word for word in name.removesuffix(end).split("_")]
        label = " ".join(_WORDS.get(word, word) for word in words).rstrip(",")
        if name.startswith("psnr_map_"):  # a map that is called as another figure
            label = "PSNR map " + name.removeprefix("psnr_map_").removesuffix(end)
        label = re.sub(r"(\d[\d.]*) (\d[\d.]*)$", r"\1 to \2", label)  # a range
        rows.setdefault((label, unit), []).append(f"{value:.4g}" if digits is None else f"{value:.{digits}f}")
    width = max((len(label) for label, _ in rows), default=0)
    return [f"{label:{width}}  {', '.join(values)}{unit}" for (label, unit), values in rows.items()]
