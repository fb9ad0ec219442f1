"""What the study of radiance fields says: a table of all candidates, and verdicts in equal bytes."""

from __future__ import annotations

from ...measure.benchmark import PASS
from ...measure.formatting import duration, enumeration, grid
from ..equal_memory import candidates_by_budget, name_of_ours, ratio_phrases

#: The two figures that are always given together.
FOREGROUND, WHITE = "psnr_foreground_db", "psnr_white_db"

#: What others have published of fields with entropy-coded numbers, on other data (the eight scenes of NeRF's synthetic
#: ones, before white): dB and megabytes.
PUBLISHED = (("CNC", 33.2, 0.42), ("HAC++", 32.8, 0.79), ("BiRF", 31.5, 0.7))


def ratio_text(ratio: float) -> str:
    """``75.0`` → ``"75×"``."""
    return f"{ratio:g}×"


def references(result: dict) -> dict[str, dict]:
    """The grids that all are made of, and that is trained for as long."""
    return {name: c for name, c in result["candidates"].items() if c["is_reference"] and c["errors"]}


def table(result: dict) -> list[str]:
    """All candidates: bytes in memory and on disk, seconds, steps and errors."""
    cells = [["", "MB in memory", "MB on disk", "times smaller", "nodes", "seconds", "steps", "white", "foreground"]]
    made = [references(result), *candidates_by_budget(result).values()]
    for name, c in ((n, c) for found in made for n, c in found.items()):
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
        f"Published, entropy-coded, of other scenes (NeRF's synthetic ones, before white): {points}.", "",
        *grid(cells, ""),
    ]  # fmt: skip


def conclusions(result: dict) -> list[str]:
    """Ours against the grid, the sparse grid and the best of the others at each size; times against those."""
    lines = []
    longer = next((c["errors"] for name, c in references(result).items() if c["details"]["kind"] == "longer"), None)
    for ratio, made in candidates_by_budget(result).items():
        kinds = {c["details"]["kind"]: (name, c) for name, c in made.items()}
        if "ours" not in kinds or len(kinds) < 2:
            continue
        own = kinds.pop("ours")[1]["errors"]
        best = max(kinds.values(), key=lambda f: f[1]["errors"][FOREGROUND])
        verdict = "ahead of all others" if own[FOREGROUND] > best[1]["errors"][FOREGROUND] else "not ahead"
        texts = [f"best of the others: {_against(own, best[1]['errors'])} ({_kind(best[0], ratio)})"]
        if "sparse" in kinds:
            texts.append(f"sparse grid, 8 bits, after zlib: {_against(own, kinds['sparse'][1]['errors'])}")
        if longer is not None:
            texts.append(f"the grid, trained as long: {_against(own, longer)}")
        lines.append(
            f"{ratio_text(ratio)}: ours is {verdict}, {own[WHITE]:.2f} dB over white and {own[FOREGROUND]:.2f} dB of "
            f"the foreground, against {'; '.join(texts)}."
        )
    return [*lines, *_times(result)]


def _against(own: dict, other: dict) -> str:
    """The figures of another, and how much better ours is."""
    gains = [own[key] - other[key] for key in (WHITE, FOREGROUND)]
    return f"{other[WHITE]:.2f} / {other[FOREGROUND]:.2f} dB, {gains[0]:+.2f} / {gains[1]:+.2f}"


def _kind(name: str, ratio: float) -> str:
    return name.removesuffix(f" {ratio_text(ratio)}")


def _times(result: dict) -> list[str]:
    """Sentences about reads and renders, of the first size."""
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
