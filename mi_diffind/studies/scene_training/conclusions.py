"""Table and conclusions of the study of training inside a scene, from the records of its runs."""

from __future__ import annotations

from ...measure.formatting import grid

#: Gain over hemisphere training, dB, from which training inside a scene is worth its time.
GAIN = 1.0

#: Names of the runs.
WAYS = ("start", "scene", "hemisphere", "hemisphere, then scene", "untrained, then scene")


def runs_of(result: dict) -> dict[str, list[dict]]:
    """Return the details of all finished runs by scene."""
    by_scene: dict[str, list[dict]] = {}
    for record in result["jobs"].values():
        details = record.get("details", {})
        if "way" in details:
            by_scene.setdefault(details["scene"], []).append(details)
    return by_scene


def table(result: dict) -> list[str]:
    """Return the lines of a table: a row for each run."""
    rows = [["scene", "run", "λ", "spp", "PSNR, dB", "FLIP", "seconds", "ms a step", "peak MiB"]]
    for scene, runs in runs_of(result).items():
        for d in runs:
            share = "" if d["lambda"] is None else f"{d['lambda']:g}"
            times = [f"{d[k]:.0f}" if k in d else "" for k in ("training_seconds", "step_ms")]
            rows.append([scene, d["way"], share, str(d["spp"]), f"{d['psnr_db']:.2f}", f"{d['flip']:.3f}", *times,
                         str(d["peak_mib"])])  # fmt: skip
    return grid(rows)


def conclusions(result: dict) -> list[str]:
    """Return a line for each scene: the gain over hemisphere training, and that of wrong starts."""
    lines, gains = [], []
    for scene, runs in runs_of(result).items():
        first = [d for d in runs if d["spp"] == runs[0]["spp"]]
        by_way = dict.fromkeys(WAYS)
        for d in sorted(first, key=lambda d: d["psnr_db"]):
            by_way[d["way"]] = d["psnr_db"]
        if by_way["hemisphere"] is None or by_way["scene"] is None:
            continue
        gains.append(max(by_way["scene"], by_way["hemisphere, then scene"] or 0) - by_way["hemisphere"])
        line = f"{scene}: inside the scene {by_way['scene'] - by_way['start']:+.2f} dB, hemisphere "
        line += f"{by_way['hemisphere'] - by_way['start']:+.2f} dB over the start"
        for way in ("hemisphere, then scene", "untrained, then scene"):
            if by_way[way] is not None:
                line += f"; {way} {by_way[way] - by_way['start']:+.2f} dB"
        lines.append(line)
    if gains:
        reached = sum(gain >= GAIN for gain in gains)
        lines.append(
            f"Training inside the scene, alone or after the hemisphere, gains {min(gains):+.2f} to {max(gains):+.2f} "
            f"dB over hemisphere training of the same seconds; {reached} of {len(gains)} scenes gain {GAIN:g} dB or "
            "more."
        )
    return lines
