"""What the study of distance fields says: a table of all candidates, and verdicts in equal bytes."""

from __future__ import annotations

from ...measure.benchmark import PASS
from ...measure.formatting import enumeration, grid
from ..equal_memory import candidates_by_budget, name_of_ours, ratio_phrases

#: What verdicts are about: its name, the error, how it is written, whether more is better.
MEASURES = (
    ("IoU", "iou", ".4f", True),
    ("IoU near", "iou_near", ".4f", True),
    ("normals", "normal_deg", ".2f", False),
    ("normals, 95%", "normal_p95_deg", ".1f", False),
    ("distances near", "mae_near", ".1e", False),
    ("Chamfer", "chamfer", ".1e", False),
)

#: Those that decide.
DECISIVE = ("iou", "iou_near", "normal_deg")


def size_text(nbytes: int) -> str:
    """``262144`` → ``"256 KiB"``."""
    return f"{nbytes / 2**20:g} MiB" if nbytes >= 2**20 else f"{nbytes / 2**10:g} KiB"


def table(result: dict) -> list[str]:
    """All candidates: bytes, seconds and errors."""
    cells = [["", "bytes", "file", "seconds", *(label for label, *_ in MEASURES), "smooth", "pieces"]]
    for made in candidates_by_budget(result).values():
        for name, c in made.items():
            e, d = c["errors"], c["details"]
            pieces = f"{e['components']} of {e['components_mesh']}" if "components" in e else "-"
            cells.append([
                name, f"{c['bytes']:,}", f"{d['file_bytes']:,}", f"{c['training_seconds']:.1f}",
                *(_written(e, key, form) for _, key, form, _ in MEASURES), f"{e['normal_smooth_deg']:.2f}", pieces,
            ])  # fmt: skip
    d = result["details"]
    return [f"{d['source']}: {d['triangles']:,} triangles", *result["notes"][1:], "", *grid(cells, "")]


def _written(errors: dict, key: str, form: str) -> str:
    value = errors.get(key)
    return "-" if value is None else f"{value:{form}}" + ("°" if key.endswith("_deg") else "")


def conclusions(result: dict) -> list[str]:
    """Ours against the best of the others at each size; times against the mesh's and the best of the others."""
    lines = []
    for size, made in candidates_by_budget(result).items():
        kinds = {c["details"]["kind"]: (name, c["errors"]) for name, c in made.items()}
        if "ours" not in kinds or len(kinds) < 2:
            continue
        own, others = kinds.pop("ours")[1], kinds.values()
        texts, lost = [], []
        for label, key, form, more in MEASURES:
            known = [(e[key], name) for name, e in others if e.get(key) is not None]
            if own.get(key) is None or not known:
                continue
            best, name = (max if more else min)(known)
            better = own[key] > best if more else own[key] < best
            texts.append(f"{label} {own[key]:{form}} against {best:{form}} ({_kind(name, size)})")
            lost += [label] if key in DECISIVE and not better else []
        verdict = (
            "ours is ahead of all others in IoU and in normals" if not lost else f"not ahead in {enumeration(lost)}"
        )
        lines.append(f"{size_text(size)}: {verdict}. " + "; ".join(texts) + ".")
    return [*lines, *_times(result)]


def _kind(name: str, size: int) -> str:
    return name.removesuffix(f" {size_text(size)}")


def _times(result: dict) -> list[str]:
    """Sentences about rays, reads and renders."""
    lines = []
    ours = name_of_ours(result)
    rays = result["cases"].get("rays", {})
    for query, what in (("ray", "A primary ray"), (PASS, "A render")):
        pairs = rays.get("ratios", {}).get(query, {})
        texts = ratio_phrases(pairs, ours)
        if ours and texts:
            timings = rays["queries"][query] if query in rays["queries"] else rays["passes"][query]
            unit = "ns" if query == "ray" else "ms"
            lines.append(f"{what} with {ours} takes {timings[ours]['time']:.3g} {unit}: {enumeration(texts)}.")
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
