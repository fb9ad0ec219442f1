"""Report of a result: tables, pictures and lines of text, and the files of a study, which bear its name."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Callable, Iterable, Sequence

from ..core.files import replacing, writable_folder, write_json
from . import plot
from .statistics import finite, pareto
from .store import Store
from .study import PASS, Plan, Tradeoff, in_competition

#: Quantities beside time that accuracy may be drawn against: the label of the axis, and the title of the panel.
QUANTITIES = {"bytes": ("bytes", "bytes"), "training_seconds": ("seconds of training", "training")}


#: Methods of contenders that are ours.
OURS = ("ours", "indirection")


def write_files(
    name: str, folder: str | os.PathLike, result: dict, rows: list[dict], pictures: dict[str, Callable[[], object]]
) -> dict[str, str]:
    """Write ``tradeoff_NAME.csv`` (``rows``), ``.json`` (``result``) and pictures, and return the paths.

    ``pictures`` maps ``"png"`` (``tradeoff_NAME.png``) or another word (``tradeoff_NAME_WORD.png``) to a function that
    draws a Matplotlib figure. Partial results of a complete run are removed from ``folder``. Raises
    :class:`.OutputError`.
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
    if not result["interrupted"]:
        Store.remove(folder, name)
    return paths


def publish(result: dict, paths: dict[str, str], lines: list[str]) -> Tradeoff:
    """Return a result with lines of text and the ``paths`` of its files."""
    return Tradeoff({**finite(result), "files": paths}, lines, paths)


def write(result: dict, folder: str | os.PathLike, plan: Plan | None = None) -> dict[str, str]:
    """Write the files (:func:`write_files`) of a result of :func:`.benchmark.measure`, and return their paths.

    The pictures are the panels, training curves, and those of the ``plan`` if the run is complete.
    """
    pictures = {}
    trainings = {name: record for name, record in result["jobs"].items() if "runs" in record}
    drawn = panels(result)
    if drawn:
        of_cases = {case["accuracy"] for case in result["cases"].values()}
        label = result["measures"][0]["label"] if len(of_cases) < 2 else "PSNR, dB"
        pictures["png"] = lambda: plot.draw_panels(result["title"], drawn, label, figure_caption(result))
    if trainings:
        title = f"{result['title']}: training"
        pictures["training"] = lambda: plot.draw_training_curves(title, trainings, figure_caption(result))
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
    """Return the panels of a result: accuracy against the plan's quantities, then against time, one panel a case.

    Times are those of the first query, or of a pass. Candidates have labels and quartiles, references vertical lines.
    If the cases have different candidates, each has its own panel of bytes.
    """
    candidates, cases, drawn = result["candidates"], [], []
    for case, measured in result["cases"].items():
        if measured["in_picture"]:
            timings = next(iter(measured["passes" if measured["of_passes"] else "queries"].values()), {})
            cases.append((case, measured, timings))
    several = len({frozenset(timings) for _, _, timings in cases}) > 1
    for quantity in result["panels"]:
        if quantity != "bytes" or not several:
            drawn.append(_against(quantity, candidates.values(), result, QUANTITIES[quantity][1]))
    for case, measured, timings in cases:
        of_passes, accuracy = measured["of_passes"], measured["accuracy"]
        query = next(iter(measured["queries"]))
        points, lines = [], []
        for name, t in timings.items():
            c = candidates[name]
            if of_passes and not c["in_picture"]:
                continue
            if c["is_truth"] or c["is_reference"]:
                label = f"{c['label']}, below {t['time']:.2g} ns" if t["hidden"] else c["label"]
                lines.append((label, t["time"], c["is_truth"]))
            elif accuracy in c["errors"]:
                points.append(_point(c, accuracy, t["time"], t["q1"], t["q3"], bool(t["on_front"])))
        unit = f"{PASS}, ms" if of_passes else f"{query}, ns"
        drawn.append(plot.Panel(case, f"time of one {unit}", points, lines))
        if several and "bytes" in result["panels"]:
            drawn.append(_against("bytes", [candidates[name] for name in timings], result, case))
    return [panel for panel in drawn if len(panel.points) > 1 or panel.lines]


def _point(c: dict, accuracy: str, x: float, low: float, high: float, on_front: bool) -> plot.Point:
    return plot.Point(c["label"], x, low, high, c["errors"][accuracy], c["representation"], on_front)


def _against(quantity: str, candidates: Iterable[dict], result: dict, title: str) -> plot.Panel:
    """Return a panel of accuracy against ``quantity``; candidates equal in both, or of one job, are one point."""
    distinct: dict[tuple, dict] = {}
    key = result["measures"][0]["key"]
    for c in candidates:
        accuracy = c["errors"].get(key)
        if accuracy is not None and not (c["is_truth"] or c["is_reference"]) and c["in_picture"] and c[quantity]:
            distinct.setdefault((c[quantity], c["job"] or accuracy), c)
    values = [
        (math.log(c[quantity]), -c["errors"][key]) if in_competition(c) else (math.nan, math.nan)
        for c in distinct.values()
    ]
    points = [
        _point(c, key, *[c[quantity]] * 3, on_front)
        for c, on_front in zip(distinct.values(), pareto(values), strict=True)
    ]
    return plot.Panel(title, QUANTITIES[quantity][0], points, [])


def summary(result: dict) -> list[str]:
    """Return the result as lines of text: errors of candidates, verdicts in equal bytes, times, ratios, the machine."""
    lines = [*_error_table(result), *verdicts(result)]
    for case, measured in result["cases"].items():
        queries, passes = measured["queries"], measured["passes"].get(PASS, {})
        floors = ", ".join(f"{q} {next(iter(t.values()))['floor']:.2f}" for q, t in queries.items())
        lines += ["", f"{case}: ns each, floor subtracted ({floors}); ± half the interquartile range"]
        query = next(iter(queries))
        cells = [["", *queries, "flops", "reads", *([f"ms {PASS}"] if passes else []), "bytes", "accuracy", ""]]
        front = passes if measured["of_passes"] else queries[query]
        for name in dict.fromkeys((*queries[query], *passes)):
            c, operations = result["candidates"][name], queries[query].get(name, {}).get("operations", {})
            accuracy = c["errors"].get(measured["accuracy"])
            shown = "exact" if c["is_truth"] else "-" if accuracy is None else f"{accuracy:.1f} dB"
            cells.append([
                name, *(time_cell(timings.get(name)) for timings in queries.values()),
                *(str(operations.get(key, "")) for key in ("flops", "gathers")),
                *([time_cell(passes.get(name), 1)] if passes else []), f"{c['bytes']:,}", shown,
                f"{'*' * bool(front.get(name, {}).get('on_front')):1}{' not converged' * (c['converged'] is False)}",
            ])  # fmt: skip
        lines += grid(cells)
    if result["cases"]:
        lines.append(f"  (* on the Pareto front of accuracy and time; flops and reads are those of {query})")
    for case, measured in result["cases"].items():
        ratios = measured["ratios"]
        pairs = dict.fromkeys(pair for by_pair in ratios.values() for pair in by_pair)
        if pairs:
            lines += ["", f"{case}: ratios, medians of the rounds, floor subtracted [with the floor]"]
            cells = [[ratio_cell(r.get(pair), q in measured["queries"]) for q, r in ratios.items()] for pair in pairs]
            lines += grid([["", *ratios], *([pair, *row] for pair, row in zip(pairs, cells, strict=True))])
    s = result["settings"]
    how = f"{s['rounds']} interleaved rounds of {s['lanes']:,} lanes; errors from {s['samples']:,} samples where drawn"
    return [*lines, "", f"{machine_line(result)} Medians of {how}.", figure_caption(result)]


def _error_table(result: dict) -> list[str]:
    """Return the plan's measures of all candidates as lines of text."""
    measures = result["measures"]
    cells = [["", "bytes", "seconds", *(m["label"] for m in measures)]]
    for name, c in result["candidates"].items():
        errors = [c["errors"].get(m["key"]) for m in measures]
        if any(e is not None for e in errors):
            texts = ["-" if e is None else f"{e:{m['form']}}" for e, m in zip(errors, measures, strict=True)]
            seconds = "-" if c["training_seconds"] is None else f"{c['training_seconds']:.1f}"
            cells.append([name, f"{c['bytes']:,}", seconds, *texts])
    return grid(cells, "") if len(cells) > 1 else []


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


def time_cell(t: dict | None, digits: int = 2) -> str:
    """Return a time (:func:`.statistics.timing`) ± half its interquartile range, or the bound of a hidden time."""
    if t is None:
        return ""
    if t["hidden"]:
        return f"below {t['time']:.{digits}f}"
    return f"{t['time']:.{digits}f} ±{(t['q3'] - t['q1']) / 2:.{digits}f}"


def ratio_cell(r: dict | None, floor: bool = True) -> str:
    """Return a ratio of times (:func:`.statistics.ratio`); with ``floor`` in brackets the ratio with the floor."""
    if r is None:
        return ""
    median = f"{'below ' * r['hidden']}{r['median']:.2f}" if math.isfinite(r["median"]) else "-"
    return f"{median} [{r['with_floor']:.2f}]" if floor else median


def grid(rows: Sequence[Sequence[str]], indent: str = "  ") -> list[str]:
    """Return rows of cells as aligned lines: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ([f"{cell:>{w + 2}}" for cell, w in zip(row[1:], widths[1:], strict=True)] for row in rows)
    return [f"{indent}{row[0]:{widths[0]}}{''.join(line)}".rstrip() for row, line in zip(rows, lines, strict=True)]


def machine_line(result: dict) -> str:
    """Return the machine (:func:`.clock.machine`) and the date of a result as a sentence."""
    m = result["machine"]
    device = m["gpu"] if m["variant"].startswith("cuda") else f"{m['cpu']} ({m['instructions']}), {m['cores']} cores"
    llvm = f", LLVM {m['llvm']}" if m["llvm"] else ""
    return (
        f"{device}; {m['variant']}, Mitsuba {m['mitsuba']}, Dr.Jit {m['drjit']}{llvm}, mi_diffind {m['mi-diffind']}; "
        f"{result['date']}."
    )


def figure_caption(result: dict) -> str:
    """Return the sentences below a figure: the notes of a result, and whether the run is quick or interrupted."""
    quick = "A smoke run (--quick): times are not to be quoted." * result["settings"]["quick"]
    interrupted = "Interrupted: the same command continues the run." * result["interrupted"]
    return " ".join(filter(None, (*result["notes"], quick, interrupted)))
