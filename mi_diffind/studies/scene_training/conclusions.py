"""Table and conclusions of the study of training inside a scene, from the records of its runs."""

from __future__ import annotations

from ...measure.formatting import grid

#: Gain over hemisphere training, dB, from which training inside a scene is worth its time.
GAIN = 1.0

#: Names of the runs.
AFTER, LONGER = "hemisphere, then scene", "hemisphere, longer"
FEW, OTHER = "scene, few samples", "another material"
MENDED = f"{OTHER}, then hemisphere"
WAYS = (
    "start", "scene", "hemisphere", LONGER, AFTER, "untrained, then scene", FEW,
    OTHER, f"{OTHER}, then scene", MENDED, f"{MENDED}, then scene",
)  # fmt: skip


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


#: Pairs of runs whose difference is a conclusion, and its words.
COMPARED = {
    ("scene", "hemisphere"): "over hemisphere training, training inside the scene for the same seconds gains",
    (AFTER, "hemisphere"): "over hemisphere training, training inside the scene after it, with more seconds, gains",
    (AFTER, LONGER): "over hemisphere training to its end, training inside the scene after a shorter one gains",
}

#: Starts that are compared with the right one.
STARTS = {
    ("untrained, then scene", "scene"): "an untrained start",
    (f"{OTHER}, then scene", "scene"): "a start from another material",
    (f"{MENDED}, then scene", AFTER): "a start from another material, after hemisphere training,",
}


def conclusions(result: dict) -> list[str]:
    """Return a line for each scene, and lines about the gains over hemisphere training and about wrong starts."""
    lines, gains = [], {pair: [] for pair in [*COMPARED, *STARTS]}
    for scene, runs in runs_of(result).items():
        # The main weight is that of the first training
        share = next((d["lambda"] for d in runs if d["lambda"] is not None), None)
        main = [d for d in runs if d["spp"] == runs[0]["spp"] and d["lambda"] in (None, share)]
        errors = {d["way"]: d["psnr_db"] for d in main}
        over = [f"{way} {errors[way] - errors['start']:+.2f} dB" for way in WAYS[1:] if way in errors]
        lines += [f"{scene}, over the start: {'; '.join(over)}"] if over else []
        for (way, other), values in gains.items():
            if way in errors and other in errors:
                values.append(errors[way] - errors[other])
    for pair, text in COMPARED.items():
        if values := gains[pair]:
            lines.append(
                f"{text} {min(values):+.2f} to {max(values):+.2f} dB: "
                f"{sum(gain >= GAIN for gain in values)} of {len(values)} scenes gain {GAIN:g} dB or more"
            )
    for pair, text in STARTS.items():
        if values := gains[pair]:
            lines.append(f"{text} ends {min(values):+.2f} to {max(values):+.2f} dB from the right one")
    return lines
