"""Conclusions of the Disney study: operations beside the paper's, required ratios of times, and whether tables pay."""

from __future__ import annotations

import math

from ...measure.formatting import grid
from ...measure.operations import Operations

#: The paper's count of operations of one evaluation (supplement, 1.2.1).
PAPER = {
    "exact, the paper's": Operations(add=92, mul=150, div=17, sqrt=5, log=1),
    "tables, the paper's": Operations(add=11, mul=26, div=2, gathers=5),
}

#: Representation of networks.
NETWORK = "network"

#: Required ratios of the times of ``eval`` with a constant material, floor subtracted: lobes, pair, least ratio.
#: ``disney`` is much faster than ``principled``; the default of ``neural_disney`` is at most 5% (noise) slower.
BARS = (
    (("all lobes",), ("principled", "disney"), 2.5),
    (("all lobes", "diffuse + specular"), ("principled", "tables, uint8"), 1 / 1.05),
)

#: Operation counts in the order of the table: name → column title.
_OPERATIONS = {
    **{name: name for name in ("add", "mul", "div", "sqrt", "log", "flops")},
    "gathers": "reads",
    "bytes_gathered": "bytes",
    "instructions": "instr.",
}


def conclusions(result: dict) -> list[str]:
    """Return operations beside the paper's, whether the required ratios hold, and whether a table saves time."""
    lines = []
    for case, measured in result["cases"].items():
        details = measured["details"]
        if details["material"] != "constant":
            continue
        lines.append(f"operations of one eval, {case} (add, mul 1 flop; div 2; sqrt, log 4)")
        counts = {name: t["operations"] for name, t in measured["queries"]["eval"].items() if "float16" not in name}
        if details["lobes"] == "all lobes":
            unknown = dict.fromkeys(("bytes_gathered", "instructions"), "")
            counts = {name: o.asdict() | unknown for name, o in PAPER.items()} | counts
        cells = ([name, *(str(o[key]) for key in _OPERATIONS)] for name, o in counts.items())
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
    """Compare the fastest table with arithmetic, case by case."""
    lines = []
    accuracy = {
        name: c["errors"].get(result["accuracy"])
        for name, c in result["candidates"].items()
        if c.get("representation") != NETWORK  # a read of a network's weights is no read of a table
    }
    for case, measured in result["cases"].items():
        timings = measured["queries"]["eval"]
        reads = {name: t["operations"]["gathers"] for name, t in timings.items()}
        # Excludes tables that are read only once because the material is constant
        if "disney" not in reads:
            continue
        learned = [name for name, n in reads.items() if accuracy.get(name) is not None and n > reads["disney"]]
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
