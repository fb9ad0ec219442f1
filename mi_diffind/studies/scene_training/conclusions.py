"""Table and conclusions of the study of training inside a scene, from the records of its runs."""

from __future__ import annotations

from ...measure.formatting import grid

#: Gain over hemisphere training, dB, from which training inside a scene is worth its time.
GAIN = 1.0

#: Names of the runs.
AFTER = "hemisphere, then scene"
WAYS = ("start", "scene", "hemisphere", AFTER, "untrained, then scene")


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
    """Return a line for each scene, and two about the gains over hemisphere training."""
    lines, alone, after = [], [], []
    for scene, runs in runs_of(result).items():
        by_way = {}
        for d in sorted((d for d in runs if d["spp"] == runs[0]["spp"]), key=lambda d: d["psnr_db"]):
            by_way[d["way"]] = d["psnr_db"]
        gains = [f"{way} {by_way[way] - by_way['start']:+.2f} dB" for way in WAYS[1:] if way in by_way]
        lines += [f"{scene}, over the start: {'; '.join(gains)}"] if gains else []
        if "hemisphere" in by_way:
            alone += [by_way["scene"] - by_way["hemisphere"]] if "scene" in by_way else []
            after += [by_way[AFTER] - by_way["hemisphere"]] if AFTER in by_way else []
    texts = {"inside the scene for the same seconds": alone, "after the hemisphere, with more seconds": after}
    for text, gains in texts.items():
        if gains:
            lines.append(
                f"over hemisphere training, training {text} gains {min(gains):+.2f} to {max(gains):+.2f} dB: "
                f"{sum(gain >= GAIN for gain in gains)} of {len(gains)} scenes gain {GAIN:g} dB or more"
            )
    return lines
