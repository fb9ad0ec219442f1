"""Expressions over the JSON files in ``docs/measured``, by which ``make_tables.py`` inserts figures into pages.

An expression begins with the name of a file in ``docs/measured`` and goes on by keys and indices. It may compute:
``a.x / a.y``, ``min(…)``, ``one(rows, name="ours")`` for the only row of a list with these values, and the other
functions of :data:`FUNCTIONS`. ``commands.toml`` in ``docs/measured`` has the command that wrote each file.
"""

from __future__ import annotations

import ast
import itertools
import json
import math
import sys
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from statistics import fmean as mean
from statistics import median
from typing import Any

from mi_diffind.fitting.task import tasks

if sys.version_info >= (3, 11):
    import tomllib
else:  # comes with pytest
    import tomli as tomllib

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent


class ClaimError(Exception):
    """Raised when a sentence, a file or a figure is not there."""


class Entries(dict):
    """A dictionary of a JSON file, whose entries are attributes as well."""

    def __getattr__(self, key: str) -> Any:
        if key in self:
            return self[key]
        raise AttributeError(f"no entry {key!r}; allowed: {', '.join(map(repr, list(self)[:20]))}")


@cache
def measured(name: str) -> Entries:
    """Return the JSON file ``docs/measured/NAME.json``."""
    path = DOCS / "measured" / f"{name}.json"
    if not path.is_file():
        raise ClaimError(f"{path.relative_to(ROOT)}: no such file; a claim names it")
    return json.loads(path.read_text(encoding="utf-8"), object_hook=Entries)


@cache
def toml(name: str) -> dict:
    """Return a TOML file of ``docs``."""
    return tomllib.loads((DOCS / name).read_text(encoding="utf-8"))


def commands() -> dict[str, str]:
    """Return the command that wrote each file of ``docs/measured``, by the name of the file."""
    return toml("measured/commands.toml")


# -- times, samples and sizes ------------------------------------------------------------------------------------------


def one(rows: Iterable[Entries], **values: Any) -> Entries:
    """Return the only row of a list that has these values."""
    found = [row for row in rows if all(row[key] == value for key, value in values.items())]
    if len(found) != 1:
        raise ClaimError(f"{len(found)} rows have {values}; allowed: exactly one")
    return found[0]


def ratio(study: Entries, case: str, query: str, name: str, other: str) -> float:
    """Return the time of a candidate over that of another: the median over rounds, else the ratio of the medians."""
    medians = study.cases[case].ratios.get(query, {})
    if f"{name} / {other}" in medians:
        return medians[f"{name} / {other}"].median
    if f"{other} / {name}" in medians:
        return 1 / medians[f"{other} / {name}"].median
    times = study.cases[case].queries.get(query) or study.cases[case].passes[query]
    return times[name].time / times[other].time


def time_over(study: Entries, case: str, query: str, name: str, other: str) -> float:
    """Return the median time of a candidate over that of another, as in the tables of the pages."""
    times = study.cases[case].queries[query]
    return times[name].time / times[other].time


def reach(curve: Iterable[tuple[float, float]], goal: float) -> float | None:
    """Return where a curve of pairs (x, dB) reaches a goal, ``None`` if it does not; dB are linear in the logarithm."""
    for (x0, y0), (x1, y1) in itertools.pairwise(curve):
        if goal <= y1:
            share = (goal - y0) / (y1 - y0) if y1 != y0 else 0.0
            return math.exp(math.log(x0) + share * math.log(x1 / x0))
    return None


def equal_samples(study: Entries, stage: str, name: str, sampling: str = "") -> float:
    """Return how many samples a pixel a bitmap needs for the error of a filtered texture with one.

    ``sampling`` is ``""`` for independent samples, or ``"multijittered"``.
    """
    key, suffix = f"psnr_{stage}_db", f", {sampling}" if sampling else ""
    names = {1: "bitmap, 1 spp", **{2**i: f"bitmap, {2**i} spp{suffix}" for i in range(1, 9)}}
    errors = {count: study.candidates.get(bitmap, {}).get("errors", {}) for count, bitmap in names.items()}
    count = reach([(count, e[key]) for count, e in errors.items() if key in e], study.candidates[name].errors[key])
    if count is None:
        raise ValueError(f"{name}: no sample count of the study has this error")
    return count


def every(pattern: str) -> list[Entries]:
    """Return the files whose names match a pattern, in the order of their names."""
    return [measured(path.stem) for path in sorted((DOCS / "measured").glob(f"{pattern}.json"))]


def cells(values: Iterable) -> str:
    """Return values as neighbouring cells of a table."""
    return " | ".join(map(str, values))


def with_spread(values: list[float]) -> str:
    """Return a mean with half the range, if there are several values."""
    return f"{mean(values):.2f}" + (f" ± {(max(values) - min(values)) / 2:.2f}" if len(values) > 1 else "")


def size_text(nbytes: float) -> str:
    """Return a number of bytes with three digits."""
    for unit, scale in (("MB", 1e6), ("kB", 1e3)):
        if nbytes >= scale:
            return f"{nbytes / scale:.3g} {unit}"
    return f"{nbytes:.0f} B" if nbytes else "none"


def binary_size(nbytes: int) -> str:
    """Return a budget as text: ``262144`` → ``"256 KiB"``."""
    return f"{nbytes / 2**20:g} MiB" if nbytes >= 2**20 else f"{nbytes / 2**10:g} KiB"


def asset_bytes(pattern: str) -> int:
    """Return the bytes of files of ``scenes/assets``."""
    return sum(path.stat().st_size for path in (ROOT / "scenes" / "assets").glob(pattern))


# -- rows of studies ---------------------------------------------------------------------------------------------------


def equal_quality(study: Entries) -> list[Entries]:
    """Return a member of each family at the quality of ``16→8``: costs over its costs, in parentheses the paper's.

    Costs are flops, bytes read, bytes stored and time; ``gain_db`` is the difference in PSNR.
    """
    paper = {"network": (113.7, 256, 4), "single table": (0.33, 0.5, 512), "network + table": (28.4, 64, 0.5)}
    times, candidates, rows = study.cases["inputs as in the paper"].queries.read, study.candidates, []
    goal = candidates["16→8"].errors.psnr_db
    for family in (*paper, "hash grid + network"):
        members = [
            n for n in times
            if candidates[n].representation == family and candidates[n].setting not in ("float16", "uint8", "tensors")
            and "raw" not in n
        ]  # fmt: skip
        good = [n for n in members if candidates[n].errors.psnr_db >= goal - 0.25]
        name = min(good or members, key=lambda n: candidates[n].bytes if good else -candidates[n].errors.psnr_db)
        mine, reference = ((times[n].operations.flops, times[n].operations.bytes_gathered, candidates[n].bytes,
                            times[n].time) for n in (name, "16→8"))  # fmt: skip
        notes = [f" ({value:g})" for value in paper.get(family, ())]
        ratios = [f"{a / b:.3g}" for a, b in zip(mine, reference, strict=True)]
        ratios = ["".join(pair) for pair in itertools.zip_longest(ratios, notes, fillvalue="")]
        gain = candidates[name].errors.psnr_db - goal
        rows.append(Entries(family=family, name=name, ratios=ratios, gain_db=gain))
    return rows


def groups(rows: Iterable[dict], *keys: str) -> dict[tuple, list[dict]]:
    """Return rows by the values of some keys."""
    result = {}
    for row in rows:
        result.setdefault(tuple(row[key] for key in keys), []).append(row)
    return result


def by_label(study: Entries) -> dict[str, dict]:
    """Return the errors of each contender of a study by its label and its budget, from the least budget on."""
    trained = [c for c in study.candidates.values() if c.details.get("asked") and c.errors]
    errors = {}
    for c in sorted(trained, key=lambda c: c.details.asked):
        errors.setdefault(c.label, {})[c.details.asked] = c.errors
    return errors


def budgets(study: Entries) -> list[float]:
    """Return the memory budgets of a study, ascending."""
    return sorted(set().union(*by_label(study).values()))


def surface_errors(row: dict, size: float) -> str:
    """Return the errors of a distance field of a budget as text: IoU, IoU near the surface, normals."""
    return "{iou:.4f} / {iou_near:.4f} / {normal_deg:.2f}°".format_map(row[size]) if size in row else ""


def trust_cell(results: list[Entries]) -> str:
    """Return the worst figure of a property over the variants that were measured."""
    failed, held = ([c for c in results if c.result == word] for word in ("fails", "holds"))
    figures = [c.figure for c in failed or held if c.figure is not None]
    text = f"{max(figures):.3g}" if figures else "error" if failed else ""
    if failed:
        return f"**fails: {text}** ({len(failed)} of {len(failed) + len(held)})"
    if held:
        return f"{text} ({len(held)})"
    return "–" if any(c.result == "does not apply" for c in results) else "not run"


# -- training for shaded values ----------------------------------------------------------------------------------------


def shaded_materials(*studies: Entries) -> dict[str, dict[str, list[Entries]]]:
    """Return the records of each material by their kind; studies without renders are left out."""
    records = [
        [Entries(job.details, errors=job.get("errors")) for job in study.jobs.values() if "material" in job.details]
        for study in studies
    ]
    details = [d for study in records if any(d.kind == "renders" for d in study) for d in study]
    materials = groups(details, "material").items()
    return {material: {kind: d for (kind,), d in groups(rows, "kind").items()} for (material,), rows in materials}


#: PSNR in dB beyond which the error of a render is not told from its noise.
CONVERGED = 60.0


def shaded_renders(*studies: Entries, name: str = "ours") -> list[Entries]:
    """Return a row for each material and each light of renders; ``best`` is another ``name``, of one seed.

    ``before`` and ``after``: PSNR in dB of plain and ours by samples a pixel, the mean of views and seeds; ``gain`` and
    ``worst``, of all views and samples; ``brightness``: of plain and ours, the largest deviation of a patch.
    """
    rows = []
    for material, kinds in shaded_materials(*studies).items():
        for lights in kinds["renders"][0].renders.ours:
            records = [d.renders for d in kinds["renders"] if name in d.renders]
            shown = [[renders[label][lights] for renders in records] for label in ("plain", name)]
            psnr = [
                {spp: [min(x, CONVERGED) for seed in seeds for x in seed[spp].psnr_db] for spp in seeds[0]}
                for seeds in shown
            ]
            gains = [b - a for spp in psnr[0] for a, b in zip(*(values[spp] for values in psnr), strict=True)]
            patches = [
                [x - 1 for seed in seeds for figures in seed.values() for view in figures.brightness
                 for x in view.values()]
                for seeds in shown
            ]  # fmt: skip
            before, after = ({spp: mean(values) for spp, values in by_spp.items()} for by_spp in psnr)
            plain, ours = (max(values, key=abs) for values in patches)
            rows.append(Entries(material=material, lights=lights, before=before, after=after, gain=mean(gains),
                                worst=min(gains), brightness=Entries(plain=plain, ours=ours)))  # fmt: skip
    return rows


def shaded_contenders(*studies: Entries) -> list[Entries]:
    """Return for each material plain, ours, the best filter in equal bytes and the best LEAN without compression.

    ``converged`` and ``single`` are PSNR in dB of held-out footprints, of many places in a pixel and of single renders:
    the mean of seeds, or the best filter of each.
    """
    rows = []
    for material, kinds in shaded_materials(*studies).items():
        contenders = {
            "plain": kinds["plain"],
            "ours": [d for d in kinds["run"] if d.label.startswith("ours")],
            "best filter, equal bytes": kinds["compressed"],
            "LEAN, uncompressed": [d for d in kinds["classical"] if d.label.startswith("LEAN")],
        }
        for label, records in contenders.items():
            pick = mean if label in ("plain", "ours") else max
            converged, single = (pick(d.errors[error] for d in records) for error in ("footprints_db", "with_noise_db"))
            rows.append(Entries(material=material, label=label, converged=converged, single=single))
    return rows


def over_filters(label: str, error: str, *studies: Entries) -> list[float]:
    """Return the gain of ours in dB over a contender of :func:`shaded_contenders`, by material."""
    gains = []
    for rows in groups(shaded_contenders(*studies), "material").values():
        ours, other = (one(row for row in rows if row.label == name) for name in ("ours", label))
        gains.append(ours[error] - other[error])
    return gains


def shipped(task: str, preset: str) -> float:
    """Return the PSNR in dB that is stored in the file that ships for a preset of a task."""
    task = tasks()[task]
    return task.load(task.file(preset=preset)).measured["psnr_db"]


def trust_cells(study: Entries) -> tuple[int, int]:
    """Return the numbers of cells of the table of properties that were measured, and of all."""
    results = [cell.result for by in study.cells.values() for row in by.values() for cell in row.values()]
    return len(results) - results.count("not run"), len(results)


#: Rows of the pages' tables of renders with filtered textures.
RENDERS = (
    "bitmap, 1 spp", "bitmap, 4 spp, multijittered", "bitmap, 16 spp, multijittered", "mipmap, trilinear",
    "ours 12x, trilinear", "ours 12x, anisotropic, centred", "ASTC 12x, anisotropic, centred",
)  # fmt: skip

#: Functions and constants of an expression, by name.
FUNCTIONS = {
    f.__name__: f
    for f in (
        min, max, sum, len, round, abs, all, any, sorted, next, iter, zip, map, list, dict, range, tuple, float,
        Entries, measured, every, one, groups, ratio, time_over, equal_samples, cells, with_spread,
        size_text, binary_size, asset_bytes, equal_quality, budgets, by_label,
        surface_errors, trust_cell, shaded_renders, shaded_contenders, over_filters, shipped,
        trust_cells,
    )
} | {"mean": mean, "median": median, "RENDERS": RENDERS}  # fmt: skip


# -- evaluation --------------------------------------------------------------------------------------------------------


def formatted(text: str) -> str:
    """Return a text with expressions in braces as the expression of an f-string."""
    return f'f"""{text} """[:-1]'


def files(expression: str) -> set[str]:
    """Return the names of the files that an expression reads."""
    names = [node for node in ast.walk(ast.parse(expression, mode="eval")) if isinstance(node, ast.Name)]
    bound = {node.id for node in names if isinstance(node.ctx, ast.Store)}
    return {node.id for node in names} - bound - FUNCTIONS.keys()


@cache
def _compiled(expression: str):
    return compile(expression, expression, "eval"), files(expression)


def evaluate(expression: str, **known: Any) -> Any:
    """Return the value of an expression, in which the names ``known`` are defined, too."""
    code, names = _compiled(expression)
    read = {name: measured(name) for name in names - known.keys()}
    try:
        return eval(code, {"__builtins__": {}, **FUNCTIONS, **read, **known})
    except (ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError) as error:
        raise ClaimError(f"{expression}: {error}") from error
