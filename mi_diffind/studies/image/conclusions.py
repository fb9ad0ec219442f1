"""What the study of compressed images says: a table of all candidates, and verdicts against ASTC."""

from __future__ import annotations

from ...measure.formatting import grid

#: What verdicts are about: a name, the error, how it is written, whether more is better.
MEASURES = (
    ("PSNR", "psnr_db", ".2f", True),
    ("between texels", "psnr_between_db", ".2f", True),
    ("mean of maps", "psnr_mean_db", ".2f", True),
    ("FLIP", "flip", ".4f", False),
)


def table(result: dict) -> list[str]:
    """All candidates: bytes, seconds and errors."""
    d, made = result["details"], {n: c for n, c in result["candidates"].items() if "psnr_db" in c["errors"]}
    cells = [
        ["", "bytes", "ratio", "seconds", "PSNR", "between", "mean", "FLIP", "SSIM", *(f"PSNR {n}" for n in d["maps"])]
    ]
    for name, c in sorted(
        made.items(), key=lambda m: (m[1]["details"]["compression"] or 0, -m[1]["errors"]["psnr_db"])
    ):
        e, known = c["errors"], c["details"]
        angles = {n: f", {e[f'angle_{n}_deg']:.2f}°" if f"angle_{n}_deg" in e else "" for n in d["maps"]}
        cells.append([
            name + ("" if known["random_access"] else " (no random access)"), f"{c['bytes']:,}",
            f"{known['ratio']:.2f}x", f"{c['training_seconds'] or known['encoding_seconds']:.1f}",
            *(f"{e[key]:.2f}" for key in ("psnr_db", "psnr_between_db", "psnr_mean_db")), f"{e['flip']:.4f}",
            "-" if e["ssim"] is None else f"{e['ssim']:.3f}",
            *(f"{e[f'psnr_{n}_db']:.1f}{angles[n]}" for n in d["maps"]),
        ])  # fmt: skip
    maps = ", ".join(f"{n} ({c})" for n, c in d["maps"].items())
    head = f"{d['source']}: {d['width']} x {d['height']}, {maps}, {d['source_bytes']:,} bytes"
    return [head, *result["notes"][1:], "", *grid(cells, "")]


def conclusions(result: dict) -> list[str]:
    """Ours against the best ASTC at each ratio."""
    lines = []
    made = {n: c for n, c in result["candidates"].items() if c["details"].get("compression") and c["in_picture"]}
    for compression in dict.fromkeys(c["details"]["compression"] for c in made.values()):
        here = {n: c for n, c in made.items() if c["details"]["compression"] == compression}
        ours = [n for n, c in here.items() if c["details"]["kind"] == "indirection"]
        blocks = [n for n, c in here.items() if c["details"]["kind"] == "ASTC"]
        best = max(ours, key=lambda n: here[n]["errors"]["psnr_db"], default=None)
        for block in blocks if ours else ():
            a, b = here[best]["errors"], here[block]["errors"]
            texts = [
                f"{label} {a[k]:{form}} against {b[k]:{form}}: {'ours' if (a[k] > b[k]) == more else 'ASTC'}"
                for label, k, form, more in MEASURES
            ]
            lines.append(f"{compression:g}x, {best} and {block}: " + "; ".join(texts))
    return lines
