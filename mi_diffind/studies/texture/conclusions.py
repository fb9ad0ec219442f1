"""Conclusions of the texture study: tables of renders, levels and flicker, gains and factors at equal error."""

from __future__ import annotations

import itertools
import math

from ...measure.formatting import grid
from ...measure.study import PASS
from ..maps import source_line

#: The bitmaps that gains in PSNR and ratios of flicker refer to.
BASE, STEADY = "bitmap, 1 spp", "bitmap, 4 spp"


def table(result: dict) -> list[str]:
    """Return a table of all candidates with bytes, errors and flicker, and one of the errors of all levels."""
    scenes = list(result["details"]["counted"])
    cells = [["", "bytes", *(f"{what} {s}" for s in scenes for what in ("PSNR", "FLIP")), "flicker", "beside truth"]]
    for name, c in _measured(result).items():
        e = c["errors"]
        numbers = [text for s in scenes for text in (f"{e[f'psnr_{s}_db']:.2f}", f"{e[f'flip_{s}']:.4f}")]
        cells.append([name, f"{c['bytes']:,}", *numbers, f"{e['flicker']:.3e}", f"{e['flicker_error']:.3e}"])
    lines = [source_line(result["details"]), *result["notes"][1:], "", *grid(cells, "")]
    by_name = levels(result)
    if by_name:
        count = max(len(psnr["all"]) for psnr in by_name.values())
        cells = [["PSNR by level, all maps", "ratio", *(f"L{i}" for i in range(count))]]
        for name, psnr in by_name.items():
            ratio = result["jobs"][name]["details"]["ratio"]
            cells.append([name, f"{ratio:.2f}x", *(f"{v:.1f}" for v in psnr["all"])])
        lines += ["", *grid(cells, "")]
    return lines


def _measured(result: dict) -> dict[str, dict]:
    return {name: c for name, c in result["candidates"].items() if c["errors"]}


def levels(result: dict) -> dict[str, dict[str, list[float]]]:
    """Return the PSNR of each level, by name of the job and by map."""
    return {n: r["details"]["levels"] for n, r in result["jobs"].items() if "levels" in r.get("details", {})}


def speed(result: dict, case: str, name: str, against: str = "bitmap") -> tuple[float, bool] | None:
    """Return the time of a bitmap with the error of a candidate, relative to the candidate's time, and a flag.

    The flag is true if the ratio is only a lower bound, because even the highest sample count has a larger error.
    Between sample counts, time is interpolated as a power of the error. ``against`` is the sampling of the bitmap,
    ``"bitmap"`` or ``"bitmap, multijittered"``.
    """
    accuracy, times = result["cases"][case]["accuracy"], result["cases"][case]["passes"].get(PASS, {})
    curve = sorted(
        (times[n]["time"], c["errors"][accuracy])
        for n, c in result["candidates"].items()
        if n in times and accuracy in c["errors"] and (c["representation"] == against or n == BASE)
    )
    if name not in times or len(curve) < 2:
        return None
    goal, time = result["candidates"][name]["errors"][accuracy], times[name]["time"]
    pair = next((pair for pair in itertools.pairwise(curve) if goal <= pair[1][1]), None)
    if pair is None:
        return curve[-1][0] / time, True
    (t0, a0), (t1, a1) = pair
    share = (goal - a0) / (a1 - a0) if a1 != a0 else 0.0
    return math.exp(math.log(t0) + share * math.log(t1 / t0)) / time, False


def conclusions(result: dict) -> list[str]:
    """Return lines about gains over one sample of a bitmap, times, factors at equal error, and flicker."""
    candidates = _measured(result)
    if BASE not in candidates:
        return []
    lines = []
    filtered = [n for n, c in candidates.items() if c["in_picture"] and not c["representation"].startswith("bitmap")]
    for case, measured in result["cases"].items():
        key, ratios = measured["accuracy"], measured["ratios"].get(PASS, {})
        for name in filtered:
            gain = candidates[name]["errors"][key] - candidates[BASE]["errors"][key]
            text = f"{case}, {name}: {gain:+.1f} dB over {BASE}"
            ratio = ratios.get(f"{name} / {BASE}")
            if ratio:
                text += f", {ratio['median']:.2f} of its time"
            speeds = [speed(result, case, name, against) for against in ("bitmap", "bitmap, multijittered")]
            if gain > 0 and all(speeds):
                factors = " and ".join(f"{'more than ' * more}{value:.1f}" for value, more in speeds)
                text += f"; at equal error a bitmap takes {factors} times as long (independent, multijittered)"
            lines.append(text)
    for name in filtered:
        parts = [candidates[name]["errors"][k] / candidates[STEADY]["errors"][k] for k in ("flicker", "flicker_error")]
        lines.append(f"flicker, {name}: {parts[0]:.2f} of {STEADY}, beside the truth {parts[1]:.2f}")
    return lines
