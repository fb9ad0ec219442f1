"""Report of the study of radiance fields: a table of all candidates, and verdicts in equal bytes."""

from __future__ import annotations

from ...measure.formatting import duration, enumeration, grid
from ...measure.study import PASS
from ..equal_memory import candidates_by_budget, name_of_ours, ours_and_others, ratio_phrases

#: The two figures that are always given together.
FOREGROUND, WHITE = "psnr_foreground_db", "psnr_white_db"

#: Published results of entropy-coded fields on other data (the eight synthetic scenes of NeRF, before white): name, dB
#: and megabytes.
PUBLISHED = (("CNC", 33.2, 0.42), ("HAC++", 32.8, 0.79), ("BiRF", 31.5, 0.7))


def ratio_text(ratio: float) -> str:
    """Return a compression as text, such as ``"75×"``."""
    return f"{ratio:g}×"


def references(result: dict) -> dict[str, dict]:
    """Return the reference candidates by name: the initial grid, and the grid that is trained on."""
    return {name: c for name, c in result["candidates"].items() if c["is_reference"] and c["errors"]}


def table(result: dict) -> list[str]:
    """Return the table of all candidates: bytes in memory and on disk, seconds, steps and errors."""
    cells = [["", "MB in memory", "MB on disk", "times smaller", "nodes", "seconds", "steps", "white", "foreground"]]
    groups = [references(result), *candidates_by_budget(result).values()]
    for name, c in ((n, c) for group in groups for n, c in group.items()):
        e, d = c["errors"], c["details"]
        cells.append([
            name, f"{d['memory_bytes'] / 1e6:.2f}", f"{d['file_bytes'] / 1e6:.2f}",
            f"{d['dense_bytes'] / c['bytes']:.0f}", f"{d['nodes']:,}" if "nodes" in d else "-",
            f"{c['training_seconds']:.0f}", f"{d.get('steps', 0):,}", f"{e[WHITE]:.2f}", f"{e[FOREGROUND]:.2f}",
        ])  # fmt: skip
    d = result["details"]
    train, test = d["views"]
    points = "; ".join(f"{name} {db:g} dB in {size:g} MB" for name, db, size in PUBLISHED)
    return [
        f"{d['source']}: {train} views, {test} to test, of {d['pixels'][0]} × {d['pixels'][1]} pixels",
        f"Published for entropy-coded fields of other scenes (synthetic NeRF scenes, before white): {points}.", "",
        *grid(cells, ""),
    ]  # fmt: skip


def conclusions(result: dict) -> list[str]:
    """Return verdicts of ours against the grid, the sparse grid and the best other candidate, and about times."""
    lines = []
    longer = next((c["errors"] for name, c in references(result).items() if c["details"]["kind"] == "longer"), None)
    for ratio, ours, methods in ours_and_others(result):
        name, best = max(methods.values(), key=lambda method: method[1][FOREGROUND])
        verdict = "ahead of all others" if ours[FOREGROUND] > best[FOREGROUND] else "not ahead"
        label = name.removesuffix(f" {ratio_text(ratio)}")
        texts = [f"best of the others: {_against(ours, best)} ({label})"]
        if "sparse" in methods:
            texts.append(f"sparse grid, 8 bits, after zlib: {_against(ours, methods['sparse'][1])}")
        if longer is not None:
            texts.append(f"the grid, trained as long: {_against(ours, longer)}")
        lines.append(
            f"{ratio_text(ratio)}: ours is {verdict}, {ours[WHITE]:.2f} dB over white and {ours[FOREGROUND]:.2f} dB of "
            f"the foreground, against {'; '.join(texts)}."
        )
    return [*lines, *_times(result)]


def _against(ours: dict, other: dict) -> str:
    """Return the figures of another candidate, and the gains of ours."""
    gains = [ours[key] - other[key] for key in (WHITE, FOREGROUND)]
    return f"{other[WHITE]:.2f} / {other[FOREGROUND]:.2f} dB, {gains[0]:+.2f} / {gains[1]:+.2f}"


def _times(result: dict) -> list[str]:
    """Return sentences about reads and renders at the first budget."""
    lines, reads = [], result["cases"].get("reads", {})
    ours = name_of_ours(result)
    side = result["details"]["request"]["film"]
    timings = reads.get("queries", {}).get("both", {})
    if ours in timings:
        others = {n: t for n, t in timings.items() if n != ours and not result["candidates"][n]["is_reference"]}
        fastest = min(others, key=lambda n: others[n]["time"], default="")
        text = f"; the fastest of the others is {fastest}: {others[fastest]['time']:.3g} ns" if fastest else ""
        lines.append(f"A sample of {ours}, density and colour, takes {timings[ours]['time']:.3g} ns{text}.")
    passes = reads.get("passes", {}).get(PASS, {})
    if ours in passes:
        texts = ratio_phrases(reads["ratios"].get(PASS, {}), ours)
        text = f": {enumeration(texts)}" if texts else ""
        lines.append(f"A picture of {side}² with {ours} takes {duration(passes[ours]['time'] / 1e3)}{text}.")
    return lines
