"""What the study of compressed images says: a table of all candidates, and verdicts against ASTC."""

from __future__ import annotations

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
    lines = [
        f"{d['source']}: {d['width']} x {d['height']}, {', '.join(f'{n} ({c})' for n, c in d['maps'].items())}, "
        f"{d['source_bytes']:,} bytes",
        *result["notes"][1:],
        "",
        f"{'':38}{'bytes':>11}{'ratio':>8}{'seconds':>9}{'PSNR':>7}{'between':>9}{'mean':>7}{'FLIP':>8}{'SSIM':>7}"
        "   PSNR by map",
    ]
    for name, c in sorted(
        made.items(), key=lambda m: (m[1]["details"]["compression"] or 0, -m[1]["errors"]["psnr_db"])
    ):
        e = c["errors"]
        ssim = f"{e['ssim']:.3f}" if e["ssim"] is not None else "-"
        each = [", ".join(f"{n} {e[f'psnr_{n}_db']:.1f}" for n in d["maps"])]
        each += [f"{e[f'angle_{n}_deg']:.2f}°" for n in d["maps"] if f"angle_{n}_deg" in e]
        seconds = c["training_seconds"] or c["details"]["encoding_seconds"]
        access = "" if c["details"]["random_access"] else "; no random access"
        lines.append(
            f"{name:38}{c['bytes']:>11,}{c['details']['ratio']:>7.2f}x{seconds:>9.1f}{e['psnr_db']:>7.2f}"
            f"{e['psnr_between_db']:>9.2f}{e['psnr_mean_db']:>7.2f}{e['flip']:>8.4f}{ssim:>7}   "
            f"{' '.join(each)}{access}"
        )
    return lines


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
