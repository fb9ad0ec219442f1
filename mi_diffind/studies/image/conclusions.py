"""Conclusions of the image study: a table of all contenders, and verdicts against ASTC."""

from __future__ import annotations

from ...measure.formatting import grid
from ..maps import source_line

#: Measures of the verdicts: title, key of the error, format, whether higher is better.
MEASURES = (
    ("PSNR", "psnr_db", ".2f", True),
    ("between texels", "psnr_between_db", ".2f", True),
    ("mean of maps", "psnr_mean_db", ".2f", True),
    ("FLIP", "flip", ".4f", False),
    ("as seen", "seen_db", ".2f", True),
)


def table(result: dict) -> list[str]:
    """Return a table of all contenders: bytes, seconds and errors."""
    maps = result["details"]["maps"]
    measured = {name: c for name, c in result["candidates"].items() if "psnr_db" in c["errors"]}
    cells = [["", "bytes", "ratio", "seconds", "PSNR", "between", "mean", "FLIP", "SSIM", "seen",
              *(f"PSNR {n}" for n in maps)]]  # fmt: skip
    for name, c in sorted(
        measured.items(), key=lambda m: (m[1]["details"]["compression"] or 0, -m[1]["errors"]["psnr_db"])
    ):
        e, details = c["errors"], c["details"]
        angles = {n: f", {e[f'angle_{n}_deg']:.2f}°" if f"angle_{n}_deg" in e else "" for n in maps}
        cells.append([
            name + ("" if details["random_access"] else " (no random access)"), f"{c['bytes']:,}",
            f"{details['ratio']:.2f}x", f"{c['training_seconds'] or details['encoding_seconds']:.1f}",
            *(f"{e[key]:.2f}" for key in ("psnr_db", "psnr_between_db", "psnr_mean_db")), f"{e['flip']:.4f}",
            "-" if e["ssim"] is None else f"{e['ssim']:.3f}", f"{e['seen_db']:.2f}" if "seen_db" in e else "-",
            *(f"{e[f'psnr_{n}_db']:.1f}{angles[n]}" for n in maps),
        ])  # fmt: skip
    return [source_line(result["details"]), *result["notes"][1:], "", *grid(cells, "")]


def conclusions(result: dict) -> list[str]:
    """Return verdicts on our best contender against each ASTC contender at each compression ratio."""
    lines, by_ratio = [], {}
    for name, c in result["candidates"].items():
        if c["details"].get("compression") and c["in_picture"]:
            by_ratio.setdefault(c["details"]["compression"], {})[name] = c
    for compression, contenders in by_ratio.items():
        ours = [n for n, c in contenders.items() if c["details"]["kind"] == "indirection"]
        best = max(ours, key=lambda n: contenders[n]["errors"]["psnr_db"], default=None)
        for block in (n for n, c in contenders.items() if c["details"]["kind"] == "ASTC" and ours):
            a, b = contenders[best]["errors"], contenders[block]["errors"]
            texts = [
                f"{title} {a[k]:{form}} against {b[k]:{form}}: {'ours' if (a[k] > b[k]) == more else 'ASTC'}"
                for title, k, form, more in MEASURES
                if k in a and k in b
            ]
            lines.append(f"{compression:g}x, {best} and {block}: " + "; ".join(texts))
    return lines
