"""Numbers, times, tables and sentences as text."""

from __future__ import annotations

import math
from collections.abc import Sequence


def percent(value: float, digits: int = 3) -> str:
    """Return a share as text, ``0.0123`` → ``"1.23%"``; very small shares are written with a power of ten."""
    value = 100 * value
    return f"{value:.{digits}g}%" if value == 0 or abs(value) >= 1e-4 else f"{value:.1e}%"


def rounded(number: float) -> str:
    """Return a count with two digits: ``"1.3"``, ``"12,000"``, ``"3.4 million"``; from 10¹⁵ on a power of ten."""
    if number >= 1e15:
        return f"{number:.1e}"
    for size, name in ((1e12, " trillion"), (1e9, " billion"), (1e6, " million")):
        if float(f"{number:.2g}") >= size:
            return f"{float(f'{number / size:.2g}'):g}{name}"
    number = float(f"{number:.2g}")
    return f"{number:,.0f}" if number >= 10 else f"{number:g}"


def duration(seconds: float) -> str:
    """Return seconds with two digits in a readable unit: ``"0.35 s"``, ``"1.7 min"``, ``"3.2 years"``."""
    year = 365.25 * 86400
    units = ((year, year, "years"), (86400, 86400, "days"), (5400, 3600, "h"), (90, 60, "min"), (0.1, 1, "s"))
    size, name = next((unit[1:] for unit in units if seconds >= unit[0]), (1e-3, "ms"))
    return f"{rounded(seconds / size)} {name}"


def enumeration(values: Sequence[object], last: str = "and") -> str:
    """Return an enumeration: ``[1, 4, 16]`` → ``"1, 4 and 16"``."""
    *before, end = map(str, values)
    return f"{', '.join(before)} {last} {end}" if before else end


def time_cell(t: dict | None, digits: int = 2) -> str:
    """Return a time (:func:`.statistics.timing`) ± half its interquartile range, or the bound of a hidden time."""
    if t is None:
        return ""
    if t["hidden"]:
        return f"below {t['time']:.{digits}f}"
    return f"{t['time']:.{digits}f} ±{(t['q3'] - t['q1']) / 2:.{digits}f}"


def ratio_cell(r: dict | None, floor: bool = True) -> str:
    """Return a ratio of times (:func:`.statistics.ratio`); with ``floor`` in brackets the ratio with the floor."""
    if r is None:
        return ""
    median = f"{'below ' * r['hidden']}{r['median']:.2f}" if math.isfinite(r["median"]) else "-"
    return f"{median} [{r['with_floor']:.2f}]" if floor else median


def grid(rows: Sequence[Sequence[str]], indent: str = "  ") -> list[str]:
    """Return rows of cells as aligned lines: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ([f"{cell:>{w + 2}}" for cell, w in zip(row[1:], widths[1:], strict=True)] for row in rows)
    return [f"{indent}{row[0]:{widths[0]}}{''.join(line)}".rstrip() for row, line in zip(rows, lines, strict=True)]


def machine_line(result: dict) -> str:
    """Return the machine (:func:`.clock.machine`) and the date of a result as a sentence."""
    m = result["machine"]
    device = m["gpu"] if m["variant"].startswith("cuda") else f"{m['cpu']} ({m['instructions']}), {m['cores']} cores"
    llvm = f", LLVM {m['llvm']}" if m["llvm"] else ""
    return (
        f"{device}; {m['variant']}, Mitsuba {m['mitsuba']}, Dr.Jit {m['drjit']}{llvm}, mi_diffind {m['mi-diffind']}; "
        f"{result['date']}."
    )


def state(result: dict) -> str:
    """Return the caption's sentences about a quick or interrupted run, "" for a complete one."""
    quick = " A smoke run (--quick): times are not to be quoted." if result["settings"]["quick"] else ""
    return quick + (" Interrupted: less was measured than asked for." if result["interrupted"] else "")


def figure_caption(result: dict) -> str:
    """Return the caption of a figure: the notes of a result, its machine, and its :func:`state`."""
    return f"{' '.join(result['notes'])} {machine_line(result)}{state(result)}"
