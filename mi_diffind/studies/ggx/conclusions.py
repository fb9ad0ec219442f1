"""Conclusions of the GGX study: equal bytes, 8-bit reads, and equal quality beside the paper's ratios."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...arrays.lookup import STORAGES
from ...measure.formatting import grid

#: Sides of the primary and the cascaded array of the equal-quality reference: the paper's sizes.
PRIMARY, CASCADED = 16, 8

#: Entries of the reference's arrays together.
ENTRIES = 2 * PRIMARY**2 + CASCADED**2

#: Names of the cases, one for each parametrisation of the inputs.
PLAIN, LOGARITHMIC = "inputs as in the paper", "logarithmic inputs"

#: The paper's ratios to its own indirection at equal quality: flops, bytes read by a query, bytes stored.
PAPER = {"network": (113.7, 256, 4), "single table": (0.33, 0.5, 512), "network + table": (28.4, 64, 0.5)}
PAPER_FLOPS, PAPER_BYTES_READ, PAPER_BYTES = 36, 16, 1024

#: PSNR, in dB, by which a candidate may be worse and still count as of equal quality.
EQUAL_DB = 0.25


def conclusions(result: dict, reference: str) -> list[str]:
    """Return lines about equal bytes, 8-bit reads, and equal quality with the candidate ``reference``."""
    return [*_equal_bytes(result), *_eight_bit_reads(result), "", *_equal_quality(result, reference)]


def _psnr(result: dict, name: str) -> float | None:
    return result["candidates"].get(name, {}).get("errors", {}).get("psnr_db")


def _equal_bytes(result: dict) -> list[str]:
    """Compare indirection with a single table of as many entries."""
    lines, side = [], math.isqrt(ENTRIES)
    for title, suffix in (("plain inputs", ""), ("plain inputs, raw output", " raw"), ("logarithmic inputs", ", log")):
        names = [name + suffix for name in (f"{PRIMARY}→{CASCADED}", f"{side}²")]
        ours, table = (_psnr(result, name) for name in names)
        if ours is None or table is None:
            continue
        verdict = f"{'indirection' if ours > table else 'the single table'} wins by {abs(ours - table):.1f} dB"
        if not all(result["candidates"][name]["converged"] for name in names):
            verdict = "not both have converged: no statement is made"
        lines.append(f"equal bytes, {title}: indirection {ours:.1f} dB, single table {table:.1f} dB: {verdict}")
    return lines


def _eight_bit_reads(result: dict) -> list[str]:
    lines = []
    for case, suffix in ((PLAIN, ""), (LOGARITHMIC, ", log")):
        pair = f"{PRIMARY}→{CASCADED} u8{suffix} / {PRIMARY}→{CASCADED}{suffix}"
        ratio = result["cases"].get(case, {}).get("ratios", {}).get("read", {}).get(pair)
        if ratio is not None:
            lines.append(
                f"8-bit reads, {case}: {ratio['median']:.2f} of the time of float32 ones ({ratio['with_floor']:.2f} "
                "with input and output)"
            )
    return lines


@dataclass(frozen=True)
class EqualQuality:
    """The smallest member of a family as good as a reference, else its best member.

    ``ratios`` are flops, bytes read, bytes stored and time, relative to the reference; ``paper`` has the paper's first
    three.
    """

    family: str
    name: str
    psnr_db: float
    ratios: tuple[float, float, float, float]
    paper: tuple[float, float, float] | None
    converged: bool
    reaches: bool


def equal_quality(result: dict, reference: str) -> list[EqualQuality]:
    """Return a member of each family beside the candidate ``reference``, for the inputs of the paper."""
    timings, candidates = result["cases"][PLAIN]["queries"]["read"], result["candidates"]
    goal, operations = _psnr(result, reference), timings[reference]["operations"]
    rows = []
    for family, paper in {**PAPER, "hash grid + network": None}.items():
        members = [
            name for name in timings
            if candidates[name]["representation"] == family and candidates[name]["setting"] not in STORAGES[1:]
            and "raw" not in name and candidates[name]["setting"] != "tensors"
        ]  # fmt: skip
        if not members:
            continue
        good = [name for name in members if _psnr(result, name) >= goal - EQUAL_DB]
        name = min(good or members, key=lambda n: candidates[n]["bytes"] if good else -_psnr(result, n))
        timing = timings[name]
        ratios = (
            timing["operations"]["flops"] / operations["flops"],
            timing["operations"]["bytes_gathered"] / operations["bytes_gathered"],
            candidates[name]["bytes"] / candidates[reference]["bytes"], timing["time"] / timings[reference]["time"],
        )  # fmt: skip
        converged = bool(candidates[name]["converged"])
        rows.append(EqualQuality(family, name, _psnr(result, name), ratios, paper, converged, bool(good)))
    return rows


def _equal_quality(result: dict, reference: str) -> list[str]:
    """List, for each family, the smallest member as good as the reference and its cost relative to the reference."""
    measured, goal = result["cases"].get(PLAIN), _psnr(result, reference)
    if measured is None or goal is None:
        return []
    timings, candidates = measured["queries"]["read"], result["candidates"]
    operations, time = timings[reference]["operations"], timings[reference]["time"]
    nbytes, flops, bytes_read = candidates[reference]["bytes"], operations["flops"], operations["bytes_gathered"]
    head = (
        f"equal quality with indirection {reference} ({goal:.1f} dB; {flops} flops, {bytes_read} bytes read, "
        f"{nbytes:,} bytes, {time:.2f} ns), plain inputs; the paper's own: {PAPER_FLOPS} flops, {PAPER_BYTES_READ} "
        f"bytes read, {PAPER_BYTES:,} bytes"
    )
    if not candidates[reference]["converged"]:
        return [head, f"  {reference} has not converged: no statement is made"]
    cells, notes = [["", "", "dB", "flops", "bytes read", "bytes", "time"]], ["   the paper's: flops, read, bytes"]
    for row in equal_quality(result, reference):
        cells.append([row.family, row.name, f"{row.psnr_db:.1f}", *(f"{r:.2f}x" for r in row.ratios)])
        note = "   " + ", ".join(f"{r:g}x" for r in row.paper) if row.paper else ""
        if not row.converged:
            note += "; has not converged: no statement about equal quality"
        elif not row.reaches:
            note += "; the best of its family, which does NOT reach it"
        notes.append(note)
    return [head, *(line + note for line, note in zip(grid(cells), notes, strict=True))]
