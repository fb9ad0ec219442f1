"""What the study of the Disney BRDF concludes: operations beside the paper's, speed, whether a table pays."""

from __future__ import annotations

import math

from ...measure.formatting import grid
from ...measure.operations import Operations

#: The paper's count of operations of one evaluation (supplement, 1.2.1).
PAPER = {
    "exact, the paper's": Operations(add=92, mul=150, div=17, sqrt=5, log=1),
    "tables, the paper's": Operations(add=11, mul=26, div=2, gathers=5),
}

#: What has to hold of ``eval`` with a constant material, floor subtracted: the cases, a ratio of times, what it is at
#: least. `disney` computes; the default of `neural_disney` is not slower than `principled`, by 5% of noise.
BARS = (
    (("all lobes",), ("principled", "disney"), 2.5),
    (("all lobes", "diffuse + specular"), ("principled", "tables, uint8"), 1 / 1.05),
)

#: Counts as printed: name → title.
_OPERATIONS = {
    **{name: name for name in ("add", "mul", "div", "sqrt", "log", "flops")},
    "gathers": "reads",
    "bytes_gathered": "bytes",
    "instructions": "instr.",
}


def conclusions(result: dict) -> list[str]:
    """Operations beside the paper's, whether the bars hold, and whether a table earns its place."""
    lines = []
    for case, measured in result["cases"].items():
        details = measured["details"]
        if details["material"] != "constant":
            continue
        lines.append(f"operations of one eval, {case} (add, mul 1 flop; div 2; sqrt, log 4)")
        found = {name: t["operations"] for name, t in measured["queries"]["eval"].items() if "float16" not in name}
        if details["lobes"] == "all lobes":
            unknown = dict.fromkeys(("bytes_gathered", "instructions"), "")
            found = {name: o.asdict() | unknown for name, o in PAPER.items()} | found
        cells = ([name, *(str(o[key]) for key in _OPERATIONS)] for name, o in found.items())
        lines += [*grid([["", *_OPERATIONS.values()], *cells]), ""]
    return [*lines, *_bars(result), *_verdict(result)]


def _bars(result: dict) -> list[str]:
    lines = []
    for lobes, pair, least in BARS:
        for name in lobes:
            r = result["cases"].get(f"constant, {name}", {}).get("ratios", {}).get("eval", {}).get(" / ".join(pair))
            if r is not None and math.isfinite(r["median"]):
                verdict = "holds" if r["median"] >= least else "does NOT hold"
                lines.append(
                    f"bar, {name}: {' / '.join(pair)} ≥ {least:.3g}: {r['median']:.2f} ({r['with_floor']:.2f} with the "
                    f"floor), {verdict}"
                )
    return lines


def _verdict(result: dict) -> list[str]:
    """Does any table give something that arithmetic does not give for less?"""
    lines = []
    accuracy = {name: c["errors"].get(result["accuracy"]) for name, c in result["candidates"].items()}
    for case, measured in result["cases"].items():
        timings = measured["queries"]["eval"]
        reads = {name: t["operations"]["gathers"] for name, t in timings.items()}
        # A table that is read once for a constant material is not read here
        learned = [name for name, a in accuracy.items() if a is not None and reads[name] > reads["disney"]]
        if not learned or timings["disney"]["time"] <= 0:
            continue
        best = min(learned, key=lambda name: timings[name]["time"])
        ratio = timings[best]["time"] / timings["disney"]["time"]
        if timings[best]["q1"] > timings["disney"]["q3"]:
            verdict = "arithmetic wins, at any accuracy"
        elif timings[best]["q3"] < timings["disney"]["q1"]:
            verdict = "a table saves time"
        else:
            verdict = "no difference beyond the noise between arithmetic and the fastest table"
        lines.append(
            f"{case}: {verdict}; of the forms that read a table, the fastest, {best}, takes {ratio:.2f} times the time "
            f"of disney, at {accuracy[best]:.0f} dB"
        )
    return lines
