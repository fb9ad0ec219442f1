"""What a measured trade-off (:mod:`mi_diffind.tradeoff`) says: a table, pictures, lines of text."""

from __future__ import annotations

import csv
import io
import math
import os

from . import plot
from .files import replacing, writable_folder, write_json
from .tradeoff import HIDDEN, PARTIAL, PASS, pareto

#: Columns of the table, before those of the errors.
COLUMNS = (
    "task",
    "case",
    "query",
    "candidate",
    "representation",
    "setting",
    "unit",
    "time",
    "time_q1",
    "time_q3",
    "time_with_floor",
    "floor",
    "rounds",
    "reads",
    "bytes_gathered",
    "add",
    "mul",
    "div",
    "sqrt",
    "log",
    "flops",
    "instructions",
    "bytes",
    "training_seconds",
    "converged",
    "on_front",
    "note",
)


def rows(result: dict) -> list[dict]:
    """
    The result as a table: one row for each case, query (or whole pass) and candidate, with the columns
    :data:`COLUMNS` and one for each error. ``time`` is in ``unit``, floor subtracted; what does not apply is missing.
    """
    found = []
    for case, measured in result["cases"].items():
        for query, timings in {**measured["queries"], **measured["passes"]}.items():
            for name, t in timings.items():
                c, operations = result["candidates"][name], dict(t.get("operations", {}))
                whole = query in measured["passes"]
                row = {
                    "task": result["task"],
                    "case": case,
                    "query": query,
                    "candidate": name,
                    **{k: c[k] for k in ("representation", "setting", "bytes", "note")},
                    **{k: c[k] for k in ("training_seconds", "converged")},
                    "unit": "ms a pass" if whole else "ns",
                    "time": t["time"],
                    "time_q1": t["q1"],
                    "time_q3": t["q3"],
                    "time_with_floor": t["with_floor"],
                    "floor": None if whole else t["floor"],
                    "rounds": t["rounds"],
                    "on_front": t.get("on_front"),
                    **c["errors"],
                }
                if operations:
                    row |= {"reads": operations.pop("gathers"), **operations}
                found.append(row)
    return found


def write(result: dict, folder: str | os.PathLike) -> dict[str, str]:
    """
    Write ``tradeoff.csv`` (see :func:`rows`), ``tradeoff.json`` (``result``) and, if there is anything to draw,
    ``tradeoff.png`` and, if something was trained, ``training.png`` into ``folder``; of a run that is complete, nothing
    else stays there but trained models. Returns the paths. Raises :class:`~mi_diffind.files.OutputError`.
    """
    folder = writable_folder(folder, create=True)
    paths = {kind: str(folder / f"tradeoff.{kind}") for kind in ("csv", "json", "png")}
    table = rows(result)
    errors = sorted({name for c in result["candidates"].values() for name in c["errors"]})
    text = io.StringIO()
    writer = csv.DictWriter(text, [*COLUMNS, *errors], lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in table)
    with replacing(paths["csv"]) as temporary:
        temporary.write_text(text.getvalue(), encoding="utf-8")
    write_json(paths["json"], finite(result))
    if result["cases"]:
        figure(result, paths["png"])
    else:
        del paths["png"]
    if result["trainings"]:
        paths["training"] = str(folder / "training.png")
        plot.write_courses(paths["training"], f"{result['title']}: training", result["trainings"], machine_line(result))
    if not result["interrupted"]:
        (folder / PARTIAL.format(result["task"])).unlink(missing_ok=True)
    return paths


def finite(value):
    """A tree of numbers without NaN and infinities, which JSON does not have."""
    if isinstance(value, dict):
        return {k: finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def caption(result: dict) -> str:
    """What the figures were measured on and how, as one paragraph."""
    s = result["settings"]
    state = " Interrupted: fewer rounds than asked for." if result["interrupted"] else ""
    quick = " A smoke run (--quick): times are not to be quoted." if s["quick"] else ""
    return (
        f"{machine_line(result)} Medians and quartiles of {s['rounds']} interleaved rounds of {s['lanes']:,} lanes on "
        f"all cores, input and output (the floor) subtracted; errors from {s['samples']:,} samples.{quick}{state}"
    )


def machine_line(result: dict) -> str:
    """Machine, versions and date of a result, as a sentence."""
    m = result["machine"]
    device = m["gpu"] if m["variant"].startswith("cuda") else f"{m['cpu']} ({m['instructions']}), {m['cores']} cores"
    llvm = f", LLVM {m['llvm']}" if m["llvm"] else ""
    return (
        f"{device}; {m['variant']}, Mitsuba {m['mitsuba']}, Dr.Jit {m['drjit']}{llvm}, mi_diffind {m['mi-diffind']}; "
        f"{result['date']}."
    )


def figure(result: dict, path: str | os.PathLike) -> None:
    """
    Accuracy against time of the first query, one panel a case: candidates labelled, quartiles as bars, the Pareto front
    drawn, references as vertical lines, machine and versions in the caption.
    """
    panels = []
    for case, measured in result["cases"].items():
        if not measured["in_picture"]:
            continue
        query, timings = next(iter(measured["queries"].items()))
        points, lines, sizes = [], [], []
        for name, t in timings.items():
            c = result["candidates"][name]
            shown = result["accuracy"] in c["errors"]
            if shown and not (c["is_truth"] or c["is_reference"]) and c["bytes"] > 0:
                sizes.append(c)
            if c["is_truth"] or c["is_reference"]:
                least = HIDDEN * t["floor"]
                label = c["label"] if t["time"] >= least else f"{c['label']}, below {least:.2g} ns"
                lines.append(plot.Line(label, max(t["time"], least), c["is_truth"]))
            elif shown and t["time"] > 0:
                points.append(
                    plot.Point(c["label"], t["time"], t["q1"], t["q3"], c["errors"][result["accuracy"]],
                               c["representation"], bool(t["on_front"]))
                )  # fmt: skip
        panels.append(plot.Panel(case, f"time of one {query}, ns", points, lines))
        if result["bytes_in_picture"]:
            panels.append(plot.Panel(case, "bytes", _by_bytes(sizes, result["accuracy"]), []))
    plot.write(path, result["title"], panels, result["accuracy_label"], caption(result))


def _by_bytes(candidates: list[dict], accuracy: str) -> list[plot.Point]:
    """Accuracy against bytes, of what differs in either only: two forms of one thing are one point."""
    points = {}
    for c in candidates:
        points.setdefault((c["bytes"], c["training"] or c["errors"][accuracy]), c)
    front = pareto([(math.log(c["bytes"]), -c["errors"][accuracy]) for c in points.values()])
    return [
        plot.Point(c["label"], *[c["bytes"]] * 3, c["errors"][accuracy], c["representation"], on_front)
        for c, on_front in zip(points.values(), front, strict=True)
    ]


def summary(result: dict) -> list[str]:
    """The result as lines of text: times, ratios, and the task's own conclusions."""
    width = max(map(len, result["candidates"]), default=0) + 2
    lines = []
    for case, measured in result["cases"].items():
        floors = ", ".join(f"{q} {next(iter(t.values()))['floor']:.2f}" for q, t in measured["queries"].items())
        queries = list(measured["queries"])
        lines += ["", f"{case}: ns each, floor subtracted ({floors}); ± half the interquartile range"]
        header = "".join(f"{q:>16}" for q in queries)
        header += f"{'flops':>8}{'reads':>7}" + (f"{'ms ' + PASS:>18}" if measured["passes"] else "")
        lines.append(f"  {'':{width}}{header}{'bytes':>12}{'accuracy':>11}")
        for name, c in result["candidates"].items():
            if name not in measured["queries"][queries[0]]:
                continue
            cells = "".join(f"{_cell(measured['queries'][q][name]):>16}" for q in queries)
            operations = measured["queries"][queries[0]][name]["operations"]
            cells += f"{operations['flops']:>8}{operations['gathers']:>7}"
            if measured["passes"]:
                t = measured["passes"][PASS].get(name)
                cells += f"{_cell(t, 1) if t else '':>18}"
            accuracy = c["errors"].get(result["accuracy"])
            shown = "exact" if c["is_truth"] else "-" if accuracy is None else f"{accuracy:.1f} dB"
            front = " *" if measured["queries"][queries[0]][name]["on_front"] else ""
            doubt = " not converged" if c["converged"] is False else ""
            lines.append(f"  {name:{width}}{cells}{c['bytes']:>12,}{shown:>11}{front}{doubt}")
    if lines:
        lines.append(
            f"  (* on the Pareto front of accuracy and {queries[0]}; flops and reads are those of {queries[0]})"
        )
    notes = [f"  {name}: {c['note']}" for name, c in result["candidates"].items() if c["note"]]
    lines += ["", *notes] if notes else []
    for case, measured in result["cases"].items():
        ratios = measured["ratios"]
        if any(ratios.values()):
            lines += ["", f"{case}: ratios, medians of the rounds, floor subtracted [with the floor]"]
            lines.append(f"  {'':{width + 8}}" + "".join(f"{query:>22}" for query in ratios))
        for pair in next(iter(ratios.values()), {}):
            cells = [_ratio_cell(found.get(pair), query in measured["queries"]) for query, found in ratios.items()]
            lines.append(f"  {pair:{width + 8}}" + "".join(f"{cell:>22}" for cell in cells))
    lines += ["", *result["conclusions"]] if result["conclusions"] else []
    return [*lines, "", caption(result)]


def _cell(t: dict, digits: int = 2) -> str:
    return f"{t['time']:.{digits}f} ±{(t['q3'] - t['q1']) / 2:.{digits}f}"


def _ratio_cell(ratio: dict | None, floor: bool) -> str:
    if ratio is None:
        return ""
    median = f"{ratio['median']:.2f}" if math.isfinite(ratio["median"]) else "-"
    return f"{median} [{ratio['with_floor']:.2f}]" if floor else median
