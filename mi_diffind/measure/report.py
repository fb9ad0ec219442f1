"""Report of a result: tables, pictures and lines of text, and the files of a study, which bear its name."""

import csv
import io
import os
from collections.abc import Callable, Sequence

from ..core.files import replacing, writable_folder, write_json
from . import plot
from .statistics import finite
from .study import PASS, Plan, Tradeoff

#: Methods of contenders that are ours.
OURS = ("ours", "indirection")


def write_files(
    name: str, folder: str | os.PathLike, result: dict, rows: list[dict], pictures: dict[str, Callable[[], object]]
) -> dict[str, str]:
    """Write ``tradeoff_NAME.csv`` (``rows``), ``.json`` (``result``) and pictures, and return the paths.

    ``pictures`` maps ``"png"`` (``tradeoff_NAME.png``) or another word (``tradeoff_NAME_WORD.png``) to a function that
    draws a Matplotlib figure. Raises :class:`.OutputError`.
    """
    folder = writable_folder(folder, create=True)
    start = str(folder / f"tradeoff_{name}")
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)), lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    with replacing(f"{start}.csv") as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")
    write_json(f"{start}.json", finite(result))
    paths = {"csv": f"{start}.csv", "json": f"{start}.json"}
    for word, draw in pictures.items():
        paths[word] = f"{start}.png" if word == "png" else f"{start}_{word}.png"
        plot.save(draw(), paths[word])
    return paths


def publish(result: dict, paths: dict[str, str], lines: list[str]) -> Tradeoff:
    """Return a result with lines of text and the ``paths`` of its files."""
    return Tradeoff({**finite(result), "files": paths}, lines, paths)


def write(result: dict, folder: str | os.PathLike, plan: Plan | None = None) -> dict[str, str]:
    """Write the files (:func:`write_files`) of a result of :func:`.benchmark.measure`, and return their paths.

    The pictures are the panels, and those of the ``plan`` if the run is complete.
    """
    pictures = {}
    drawn = panels(result)
    if drawn:
        of_cases = {case["accuracy"] for case in result["cases"].values()}
        label = result["measures"][0]["label"] if len(of_cases) < 2 else "PSNR, dB"
        pictures["png"] = lambda: plot.draw_panels(result["title"], drawn, label, figure_caption(result))
    if plan is not None and not result["interrupted"]:
        pictures |= {word: (lambda draw=draw: draw(result)) for word, draw in plan.pictures.items()}
    return write_files(result["task"], folder, result, rows(result), pictures)


def rows(result: dict) -> list[dict]:
    """Return the result as rows of a table: one for each case, query (or whole pass) and candidate.

    Candidates of no case have one row. The columns are those of times and operations in the result, one for each error
    and one for each number or text among the details of candidates.
    """
    table, rest = [], dict.fromkeys(result["candidates"])
    for case, measured in result["cases"].items():
        for query, timings in {**measured["queries"], **measured["passes"]}.items():
            for name, t in timings.items():
                rest.pop(name, None)
                times = {key: value for key, value in t.items() if key != "operations"} | t.get("operations", {})
                unit = "ms" if query in measured["passes"] else "ns"
                table.append({"case": case, "query": query, **_cells(result, name), "unit": unit, **times})
    return table + [{"case": "", "query": "", **_cells(result, name)} for name in rest]


def _cells(result: dict, name: str) -> dict:
    c = result["candidates"][name]
    cells = {k: c[k] for k in ("representation", "setting", "bytes", "training_seconds", "converged")}
    details = {k: v for k, v in c["details"].items() if isinstance(v, (int, float, str))}
    return {"candidate": name, **cells, **c["errors"], **details}


def panels(result: dict) -> list[plot.Panel]:
    """Return the panels of a result: accuracy against bytes if the plan says so, then against time, one panel a case.

    Times are those of a pass, or else of the first query. Candidates have labels and quartiles, references vertical
    lines. Candidates of equal bytes and accuracy, or of one job, are one point against bytes.
    """
    candidates, key, by_bytes, drawn = result["candidates"], result["measures"][0]["key"], {}, []
    for c in candidates.values() if result["panels"] else ():
        accuracy = c["errors"].get(key)
        if accuracy is not None and not (c["is_truth"] or c["is_reference"]) and c["in_picture"] and c["bytes"]:
            by_bytes.setdefault((c["bytes"], c["job"] or accuracy), _point(c, key, *[c["bytes"]] * 3))
    drawn.append(plot.Panel("bytes", "bytes", list(by_bytes.values()), []))
    for case, measured in result["cases"].items():
        if not measured["in_picture"]:
            continue
        query, timings = next(iter((measured["passes"] or measured["queries"]).items()))
        of_passes, accuracy = query == PASS, measured["accuracy"]
        points, lines = [], []
        for name, t in timings.items():
            c = candidates[name]
            if of_passes and not c["in_picture"]:
                continue
            if c["is_truth"] or c["is_reference"]:
                label = f"{c['label']}, below {t['time']:.2g} ns" if t["hidden"] else c["label"]
                lines.append((label, t["time"], c["is_truth"]))
            elif accuracy in c["errors"]:
                points.append(_point(c, accuracy, t["time"], t["q1"], t["q3"]))
        drawn.append(plot.Panel(case, f"time of one {query}, {'ms' if of_passes else 'ns'}", points, lines))
    return [panel for panel in drawn if len(panel.points) > 1 or panel.lines]


def _point(c: dict, accuracy: str, x: float, low: float, high: float) -> plot.Point:
    return plot.Point(c["label"], x, low, high, c["errors"][accuracy], c["representation"], c["competes"])


def summary(result: dict) -> list[str]:
    """Return the result as lines of text: errors of candidates, verdicts in equal bytes, times and operations."""
    lines = [*_error_table(result), *verdicts(result)]
    for case, measured in result["cases"].items():
        timings = {f"{query}, ns": t for query, t in measured["queries"].items()}
        timings |= {f"{query}, ms": t for query, t in measured["passes"].items()}
        first = next(iter(measured["queries"].values()), {})
        counted = {"flops": "flops", "reads": "gathers"} if first else {}
        cells = [["", *timings, *counted]]
        for name in dict.fromkeys(name for by_name in timings.values() for name in by_name):
            operations = first.get(name, {}).get("operations", {})
            counts = (str(operations.get(key, "")) for key in counted.values())
            cells.append([name, *(time_cell(by_name.get(name)) for by_name in timings.values()), *counts])
        lines += ["", f"{case}: floor subtracted; ± half the interquartile range", *grid(cells)]
    s = result["settings"]
    how = f"{s['rounds']} interleaved rounds of {s['lanes']:,} lanes; errors from {s['samples']:,} samples where drawn"
    return [*lines, "", f"Medians of {how}.", figure_caption(result)]


def _error_table(result: dict) -> list[str]:
    """Return bytes, seconds of training and the plan's measures of all candidates as lines of text."""
    measures, cells = result["measures"], []
    for name, c in result["candidates"].items():
        errors = [c["errors"].get(m["key"]) for m in measures]
        if any(e is not None for e in errors):
            texts = ["-" if e is None else f"{e:{m['form']}}" for e, m in zip(errors, measures, strict=True)]
            seconds = "-" if c["training_seconds"] is None else f"{c['training_seconds']:.1f}"
            cells.append([name, f"{c['bytes']:,}", seconds, *texts, "not converged" * (c["converged"] is False)])
    return grid([["", "bytes", "seconds", *(m["label"] for m in measures), ""], *cells], "") if cells else []


def verdicts(result: dict) -> list[str]:
    """Return a table: by budget and measure the best of the method "ours" and the best of the others."""
    budgets: dict[float, dict[str, dict]] = {}
    for name, candidate in result["candidates"].items():
        if candidate["details"].get("asked") and candidate["errors"]:
            budgets.setdefault(candidate["details"]["asked"], {})[name] = candidate
    cells = [["in equal bytes", *(m["label"] for m in result["measures"])]]
    for _, candidates in sorted(budgets.items()):
        ours = [name for name, c in candidates.items() if c["details"]["kind"] in OURS]
        others = [name for name in candidates if name not in ours]
        for names in (ours, others) if ours and others else ():
            texts = []
            for m in result["measures"]:
                errors = {n: e for n in names if (e := candidates[n]["errors"].get(m["key"])) is not None}
                best = (max if m["more"] else min)(errors, key=errors.get, default=None)
                texts.append("-" if best is None else f"{errors[best]:{m['form']}} ({best})")
            cells.append(["ours" if names is ours else "best of the others", *texts])
    return ["", *grid(cells, "")] if len(cells) > 1 else []


def time_cell(t: dict | None) -> str:
    """Return a time (:func:`.statistics.timing`) ± half its interquartile range, or the bound of a hidden time."""
    if t is None:
        return ""
    return f"below {t['time']:.2f}" if t["hidden"] else f"{t['time']:.2f} ±{(t['q3'] - t['q1']) / 2:.2f}"


def grid(rows: Sequence[Sequence[str]], indent: str = "  ") -> list[str]:
    """Return rows of cells as aligned lines: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ([f"{cell:>{w + 2}}" for cell, w in zip(row[1:], widths[1:], strict=True)] for row in rows)
    return [f"{indent}{row[0]:{widths[0]}}{''.join(line)}".rstrip() for row, line in zip(rows, lines, strict=True)]


def figure_caption(result: dict) -> str:
    """Return the sentences below a figure: the notes of a result, and whether the run is quick or interrupted."""
    quick = "A smoke run (--quick): times are not to be quoted." * result["settings"]["quick"]
    interrupted = "Interrupted: the same command trains the rest and measures again." * result["interrupted"]
    return " ".join(filter(None, (*result["notes"], quick, interrupted)))
