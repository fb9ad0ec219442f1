"""Report of the scene study: table, lines of text, verdict, files."""

from __future__ import annotations

import os
from pathlib import Path

from ...measure import report
from ...measure.bias import PRACTICAL, practical, root
from ...measure.formatting import duration, enumeration, grid, machine_line, percent, rounded, state
from . import picture

#: Columns of the table.
COLUMNS = (
    *("scene", "version", "spp", "mse", "mse_q1", "mse_q3", "rmse", "psnr_db", "images"),
    *("seconds", "seconds_q1", "seconds_q3", "seconds_wall", "seconds_wall_q1", "seconds_wall_q3", "timed"),
    *("time_ratio", "time_ratio_q1", "time_ratio_q3", "time_ratio_wall"),
)


def rows(result: dict) -> list[dict]:
    """Return one table row, with the columns :data:`COLUMNS`, for each version and sample count.

    Time ratios (learned / exact) are in the rows of ``learned``.
    """
    ratios = {r["spp"]: r for r in result["ratios"]}
    table = []
    for point in result["points"]:
        row = {"scene": Path(result["scene"]).name, **point}
        if point["version"] == "learned" and point["spp"] in ratios:
            r = ratios[point["spp"]]
            row |= {"time_ratio": r["median"], "time_ratio_q1": r["q1"], "time_ratio_q3": r["q3"]}
            row["time_ratio_wall"] = r["wall"]
        table.append(row)
    return table


def write(result: dict, folder: str | os.PathLike) -> dict[str, str]:
    """Write the files of a result, with a picture if there is a timed point; return their paths."""
    pictures = {}
    if any(p["timed"] and p["rmse"] for p in result["points"]):
        pictures["png"] = lambda: picture.draw(result, caption(result))
    return report.write_files("scene", folder, result, rows(result), COLUMNS, pictures)


def caption(result: dict) -> str:
    """Return one paragraph about what was measured, on which machine and how."""
    reference, counts = result["reference"], enumeration(result["counts"])
    defines = "".join(f", {k}={v}" for k, v in result["defines"].items())
    bad = f" {result['not_finite']} values were not finite and counted as 0." if result["not_finite"] else ""
    return (
        f"{Path(result['scene']).name}{defines}, {result['width']} × {result['height']}, {counts} "
        f"samples per pixel (spp). Relative RMS error against {reference['spp']} spp of the exact scene, whose own "
        f"noise, {percent(reference['noise_rmse'])}, is subtracted. Medians and quartiles of {_images(result)} of "
        f"different seeds; seconds of the kernels of a whole render. {machine_line(result)}{bad}{state(result)}"
    )


def _images(result: dict) -> str:
    numbers = sorted({p["images"] for p in result["points"]})
    return f"{numbers[0]} images" if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]} images"


def summary(result: dict) -> list[str]:
    """Return lines of text: errors and times by sample count, the bias, the crossover and the verdict."""
    materials = "1 learned plugin" if result["learned_plugins"] == 1 else f"{result['learned_plugins']} learned plugins"
    lines = [
        f"scene       {Path(result['scene']).name}, {result['width']} x {result['height']}, {materials}",
        f"variant     {result['variant']}",
        "",
    ]
    if not result["points"]:
        return [*lines, "interrupted before the first point; the same command continues the run"]
    lines.append("relative RMS error and seconds of the kernels, medians ± half the interquartile range")
    cells = [["spp", "exact: error", "seconds", "learned: error", "seconds", "learned / exact"]]
    ratios = {r["spp"]: f"{r['median']:.2f} ({r['q1']:.2f} to {r['q3']:.2f})" for r in result["ratios"]}
    points = {(p["version"], p["spp"]): p for p in result["points"]}
    for spp in result["counts"]:
        both = [points.get((name, spp)) for name in picture.VERSIONS]
        texts = [text for p in both for text in ((_error_cell(p), _seconds_cell(p)) if p else ("", ""))]
        cells.append([str(spp), *texts, ratios.get(spp, "")])
    lines += grid(cells)
    reference, bias, crossover = result["reference"], result["bias"], result["crossover"]
    lines += ["", f"reference   {reference['spp']} spp, its own noise {percent(reference['noise_rmse'])} (subtracted)"]
    if bias["measured"]:
        size = f"{percent(bias['rmse'])} ± {percent(bias['rmse_standard_error'], 2)}"
    else:
        size = f"below {percent(bias['rmse_below'])}"
    lines.append(f"bias        {size}, {picture.decibel(bias)}")
    if "spp" in crossover and practical(crossover):
        between = f"{rounded(crossover['spp_low'])} to {rounded(crossover['spp_high'])}"
        how = ", extrapolated" * crossover["extrapolated"]
        lines.append(f"crossover   {rounded(crossover['spp'])} spp ({between}){how}")
    if result["not_finite"]:
        lines.append(f"not finite  {result['not_finite']} values, counted as 0")
    if result["interrupted"]:
        lines.append("interrupted: the same command continues the run")
    return [*lines, "", result["verdict"]]


def _error_cell(point: dict) -> str:
    half = (root(point["mse_q3"]) - root(point["mse_q1"])) / 2
    return f"{percent(point['rmse'])} ± {percent(half, 2)}"


def _seconds_cell(point: dict) -> str:
    if not point["timed"]:
        return "-"
    half = (point["seconds_q3"] - point["seconds_q1"]) / 2
    return f"{point['seconds']:.3g} ± {half:.2g}"


def verdict(result: dict) -> str | None:
    """Return one sentence about noise and bias at the sample counts measured; ``None`` before a bias is known."""
    bias, crossover, counts = result["bias"], result["crossover"], result["counts"]
    if bias is None:
        return None
    if not bias["measured"]:
        if not bias["rmse_below"]:
            return "Learned and exact renders do not differ at all."
        limit = "at any practical number of samples"
        if practical(crossover):
            limit = f"up to {rounded(crossover['spp_above'])} spp at least"
        return (
            f"No bias was found; if there is one, it is below {percent(bias['rmse_below'])}, and noise dominates "
            f"{limit}."
        )
    size, spp = percent(bias["rmse"]), crossover["spp"]
    if bias["rounding_only"]:
        return f"Learned and exact renders differ by rounding only ({size}): noise dominates at any sample count."
    if not practical(crossover):
        return (
            f"Noise dominates: the bias of the approximation, {size}, is below what any practical number of samples "
            f"(up to {rounded(PRACTICAL)} a pixel) would show."
        )
    if spp < counts[0]:
        return f"The approximation dominates throughout: its bias, {size}, exceeds the noise of {counts[0]} spp."
    when = f"about {rounded(spp)} spp" + (f" ({duration(crossover['seconds'])})" if crossover["seconds"] else "")
    if spp <= counts[-1]:
        return f"Up to {when} noise dominates; beyond, the bias of the approximation, {size}, and time hardly helps."
    last = next((p for p in reversed(result["points"]) if p["version"] == "learned" and p["timed"]), None)
    most = f"{counts[-1]} spp" + (f" ({duration(last['seconds'])})" if last else "")
    return (
        f"Noise dominates at all that was measured, up to {most}; by extrapolation, it would equal the bias of the "
        f"approximation, {size}, at {when}."
    )
