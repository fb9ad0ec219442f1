"""What the study of filtered textures says: tables of renders, levels and flicker, and what they come to."""

from __future__ import annotations

import itertools
import math

from ...measure.benchmark import PASS
from ...measure.formatting import grid

#: The bitmap that gains are over, and the one whose flicker is the measure.
BASE, STEADY = "bitmap, 1 spp", "bitmap, 4 spp"


def table(result: dict) -> list[str]:
    """All candidates: bytes, errors and flicker; then the errors of all levels."""
    d, made = result["details"], {n: c for n, c in result["candidates"].items() if c["errors"]}
    stages = list(d["counted"])
    cells = [["", "bytes", *(f"{what} {s}" for s in stages for what in ("PSNR", "FLIP")), "flicker", "beside truth"]]
    for name, c in made.items():
        e = c["errors"]
        numbers = [text for s in stages for text in (f"{e[f'psnr_{s}_db']:.2f}", f"{e[f'flip_{s}']:.4f}")]
        cells.append([name, f"{c['bytes']:,}", *numbers, f"{e['flicker']:.3e}", f"{e['flicker_error']:.3e}"])
    maps = ", ".join(f"{n} ({c})" for n, c in d["maps"].items())
    head = f"{d['source']}: {d['width']} x {d['height']}, {maps}, {d['source_bytes']:,} bytes"
    lines = [head, *result["notes"][1:], "", *grid(cells, "")]
    known = levels(result)
    if known:
        count = max(len(v["all"]) for v in known.values())
        cells = [["PSNR by level, all maps", "ratio", *(f"L{i}" for i in range(count))]]
        for name, found in known.items():
            ratio = next(r["details"]["ratio"] for n, r in result["jobs"].items() if n == name)
            cells.append([name, f"{ratio:.2f}x", *(f"{v:.1f}" for v in found["all"])])
        lines += ["", *grid(cells, "")]
    return lines


def levels(result: dict) -> dict[str, dict[str, list[float]]]:
    """PSNR of each level by name of what has them, and by map."""
    return {n: r["details"]["levels"] for n, r in result["jobs"].items() if "levels" in r.get("details", {})}


def speed(result: dict, case: str, name: str, against: str = "bitmap") -> tuple[float, bool] | None:
    """
    How many times as long a bitmap takes for the error of a candidate in a case, and whether it is at least that, since
    even the most samples err more. Between sample counts, error and time are interpolated as powers. ``against`` are
    samples: those of ``"bitmap"`` or of ``"bitmap, multijittered"``.
    """
    accuracy, times = result["cases"][case]["accuracy"], result["cases"][case]["passes"].get(PASS, {})
    curve = sorted(
        (times[n]["time"], c["errors"][accuracy])
        for n, c in result["candidates"].items()
        if n in times and accuracy in c["errors"] and (c["representation"] == against or n == BASE)
    )
    if name not in times or len(curve) < 2:
        return None
    wanted, taken = result["candidates"][name]["errors"][accuracy], times[name]["time"]
    for (t0, a0), (t1, a1) in itertools.pairwise(curve):
        if wanted <= a1 or (t1, a1) == curve[-1]:
            if wanted > a1:
                return t1 / taken, True
            share = (wanted - a0) / (a1 - a0) if a1 != a0 else 0.0
            return math.exp(math.log(t0) + share * math.log(t1 / t0)) / taken, False
    return None


def conclusions(result: dict) -> list[str]:
    """Gains over one sample of a bitmap, times, factors at equal error, flicker."""
    made = {n: c for n, c in result["candidates"].items() if c["errors"]}
    if BASE not in made:
        return []
    lines = []
    filtered = [n for n, c in made.items() if c["in_picture"] and not c["representation"].startswith("bitmap")]
    for case, measured in result["cases"].items():
        key, ratios = measured["accuracy"], measured["ratios"].get(PASS, {})
        for name in filtered:
            gain = made[name]["errors"][key] - made[BASE]["errors"][key]
            text = f"{case}, {name}: {gain:+.1f} dB over {BASE}"
            ratio = ratios.get(f"{name} / {BASE}")
            if ratio:
                text += f", {ratio['median']:.2f} of its time"
            found = [speed(result, case, name, against) for against in ("bitmap", "bitmap, multijittered")]
            if gain > 0 and all(found):
                factors = " and ".join(f"{'more than ' * more}{value:.1f}" for value, more in found)
                text += f"; at equal error a bitmap takes {factors} times as long (independent, multijittered)"
            lines.append(text)
    for name in filtered:
        parts = [made[name]["errors"][k] / made[STEADY]["errors"][k] for k in ("flicker", "flicker_error")]
        lines.append(f"flicker, {name}: {parts[0]:.2f} of {STEADY}, beside the truth {parts[1]:.2f}")
    return lines
