"""Table of all distance fields of the study, and sentences about the best in equal bytes and about times."""

from __future__ import annotations

from ...measure.formatting import enumeration, grid
from ...measure.study import PASS
from ..equal_memory import candidates_by_budget, name_of_ours, ours_and_others, ratio_phrases

#: Measures of the sentences: label, error, format, and whether more is better.
MEASURES = (
    ("IoU", "iou", ".4f", True),
    ("IoU near", "iou_near", ".4f", True),
    ("normals", "normal_deg", ".2f", False),
    ("normals, 95%", "normal_p95_deg", ".1f", False),
    ("distances near", "mae_near", ".1e", False),
    ("Chamfer", "chamfer", ".1e", False),
)

#: Measures that decide who is ahead.
DECISIVE = ("iou", "iou_near", "normal_deg")
AHEAD = "ours is ahead of all others in IoU and in normals"


def size_text(nbytes: int) -> str:
    """Return a number of bytes as text: ``262144`` → ``"256 KiB"``."""
    return f"{nbytes / 2**20:g} MiB" if nbytes >= 2**20 else f"{nbytes / 2**10:g} KiB"


def table(result: dict) -> list[str]:
    """Return a text table of all candidates: bytes, seconds and errors."""
    cells = [["", "bytes", "file", "seconds", *(label for label, *_ in MEASURES), "smooth", "pieces"]]
    for candidates in candidates_by_budget(result).values():
        for name, c in candidates.items():
            e, d = c["errors"], c["details"]
            pieces = f"{e['components']} of {e['components_mesh']}" if "components" in e else "-"
            cells.append([
                name, f"{c['bytes']:,}", f"{d['file_bytes']:,}", f"{c['training_seconds']:.1f}",
                *(_error_text(e, key, form) for _, key, form, _ in MEASURES), f"{e['normal_smooth_deg']:.2f}", pieces,
            ])  # fmt: skip
    d = result["details"]
    return [f"{d['source']}: {d['triangles']:,} triangles", *result["notes"][1:], "", *grid(cells, "")]


def _error_text(errors: dict, key: str, form: str) -> str:
    value = errors.get(key)
    return "-" if value is None else f"{value:{form}}" + ("°" if key.endswith("_deg") else "")


def conclusions(result: dict) -> list[str]:
    """Return sentences: ours against the best other method at each budget; times against the mesh and others."""
    lines = []
    for size, ours, others in ours_and_others(result):
        texts, behind = [], []
        for label, key, form, more in MEASURES:
            values = [(e[key], name) for name, e in others.values() if e.get(key) is not None]
            if ours.get(key) is None or not values:
                continue
            best, name = (max if more else min)(values)
            ahead = ours[key] > best if more else ours[key] < best
            method = name.removesuffix(f" {size_text(size)}")
            texts.append(f"{label} {ours[key]:{form}} against {best:{form}} ({method})")
            behind += [label] if key in DECISIVE and not ahead else []
        verdict = f"not ahead in {enumeration(behind)}" if behind else AHEAD
        lines.append(f"{size_text(size)}: {verdict}. " + "; ".join(texts) + ".")
    return [*lines, *_times(result)]


def _times(result: dict) -> list[str]:
    """Return sentences about the times of rays, renders and reads."""
    lines = []
    ours = name_of_ours(result)
    rays = result["cases"].get("rays", {})
    for query, subject in (("ray", "A primary ray"), (PASS, "A render")):
        texts = ratio_phrases(rays.get("ratios", {}).get(query, {}), ours)
        if ours and texts:
            timings = rays["queries"][query] if query in rays["queries"] else rays["passes"][query]
            unit = "ns" if query == "ray" else "ms"
            lines.append(f"{subject} with {ours} takes {timings[ours]['time']:.3g} {unit}: {enumeration(texts)}.")
    reads = result["cases"].get("reads", {}).get("queries", {})
    if ours in reads.get("value", {}):
        value, normal = (reads[q] for q in ("value", "normal"))
        fastest = min(value, key=lambda n: value[n]["time"])
        lines.append(
            f"A distance read from {ours} takes {value[ours]['time']:.3g} ns, with its gradient "
            f"{normal[ours]['time']:.3g} ns; the fastest is {fastest}: {value[fastest]['time']:.3g} and "
            f"{normal[fastest]['time']:.3g} ns."
        )
    return lines
