"""
Figures of the pages: expressions over the JSON in ``docs/measured``, sentences that they are inserted in, and a list of
the numbers that no file backs:

    python docs/figures.py [--all] [--headlines] [PAGE …]

``claims.toml`` maps sentences to figures. Each entry names a page (the README, a page of ``docs``, or the file of a
plugin, whose docstring is a page of the manual), a part of a sentence with fields as of ``str.format``, and an
expression for each field:

    [["README.md"]]
    text = "a grid of {grid:.1f} dB in {minutes:.0f} minutes"
    grid = "nerf_scenes.rows[0].psnr_white_db"
    minutes = "nerf_scenes.rows[0].minutes"

An expression begins with the name of a file in ``docs/measured`` and goes on by keys and indices. It may compute:
``a.x / a.y``, ``min(…)``, ``max(…)``, ``mean(…)``, ``one(rows, name="ours")`` for the only row of a list with these
values, and the other functions of :data:`FUNCTIONS`. ``holds`` is an expression that must be true, for a sentence in
words. ``commands.toml`` in ``docs/measured`` has the command that wrote each file.

A number is *backed* if ``make_tables.py`` inserts it: in a table, or by a sentence of ``claims.toml``. It is a *trial*
between ``<!-- trials: … -->`` and ``<!-- /trials -->``, where the comment says what became of the script. It is a
*setting* if it says what was chosen and not what came out: bits, samples, views, steps, sides of images and arrays,
ratios such as 12x, and the phrases of ``settings.toml``. All others are listed.

Not numbers: code, addresses, versions, years, numbers of sections, tables, figures, equations, tasks and notebooks,
and digits that are a part of a name (``float32``, ``BC7``). ``--headlines`` lists those of the README's tables and
lists and of the first paragraph of each page alone; ``--all`` lists all classes.
"""

from __future__ import annotations

import argparse
import ast
import itertools
import json
import math
import re
import string
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from statistics import fmean as mean
from typing import Any

from mi_diffind.fitting.task import tasks

if sys.version_info >= (3, 11):
    import tomllib
else:  # comes with pytest
    import tomli as tomllib

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent


class ClaimError(Exception):
    """Raised when a sentence, a file or a value of a claim is not there."""


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


# -- functions of expressions ------------------------------------------------------------------------------------------


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


def equal_samples(study: Entries, stage: str, name: str, sampling: str = "") -> float:
    """Return how many samples a pixel a bitmap needs for the error of a filtered texture with one.

    ``sampling`` is ``""`` for independent samples, or ``"multijittered"``. Between sample counts, PSNR is linear in the
    logarithm of the count.
    """
    key, suffix = f"psnr_{stage}_db", f", {sampling}" if sampling else ""
    names = {1: "bitmap, 1 spp", **{2**i: f"bitmap, {2**i} spp{suffix}" for i in range(1, 9)}}
    errors = {count: study.candidates.get(bitmap, {}).get("errors", {}) for count, bitmap in names.items()}
    curve = {count: e[key] for count, e in errors.items() if key in e}
    goal = study.candidates[name].errors[key]
    for low, high in itertools.pairwise(curve):
        if goal <= curve[high]:
            share = (goal - curve[low]) / (curve[high] - curve[low])
            return math.exp(math.log(low) + share * math.log(high / low))
    raise ValueError(f"{name}: no sample count of the study has this error")


def time_at_equal_error(study: Entries, stage: str, name: str, sampling: str = "") -> tuple[float, bool]:
    """Return the time of a bitmap with the error of a candidate, relative to the candidate's, and a flag.

    The flag is true if the ratio is only a lower bound, because even the highest sample count has a larger error.
    Between sample counts, PSNR is linear in the logarithm of time. ``sampling`` is ``""`` or ``", multijittered"``.
    """
    key, times, base = f"psnr_{stage}_db", study.cases[stage].passes.render, "bitmap, 1 spp"
    bitmaps = [n for n in times if n == base or re.fullmatch(rf"bitmap, \d+ spp{sampling}", n)]
    curve = sorted((times[n].time, study.candidates[n].errors[key]) for n in bitmaps)
    goal, time = study.candidates[name].errors[key], times[name].time
    for (t0, low), (t1, high) in itertools.pairwise(curve):
        if goal <= high:
            share = (goal - low) / (high - low) if high != low else 0.0
            return math.exp(math.log(t0) + share * math.log(t1 / t0)) / time, False
    return curve[-1][0] / time, True


def _runs(study: Entries, material: str, which: str) -> list[dict]:
    """Return the records of a material: of a filter by its name, of the best one, or of all seeds of a training.

    ``which`` is the name of a filter, ``uncompressed`` or ``equal bytes`` for the best of either, ``trained`` for the
    weight λ = 0.9, or another weight as ``λ 0.5``; ``, no schedule`` after it names that way of a study with several.
    """
    from mi_diffind.studies.shading import curves

    curve = curves(study)[material]
    filters = {**curve.classical, **curve.compressed}
    if which in filters:
        return [filters[which]]
    if which in ("uncompressed", "equal bytes"):
        filters = curve.classical if which == "uncompressed" else curve.compressed
        return [max(filters.values(), key=lambda f: f["C"]["mean_db"])]
    way = "clip, no schedule" if which.endswith(", no schedule") else "clip, schedule"
    weight = which.removesuffix(", no schedule")
    return curve.runs[way, 0.9 if weight == "trained" else float(weight.removeprefix("λ "))]


def shading(study: Entries, material: str, which: str, letter: str = "C") -> float:
    """Return the PSNR in dB of a material in the mean of levels and seeds, ``which`` as of :func:`_runs`."""
    return mean(d[letter]["mean_db"] for d in _runs(study, material, which))


def shading_level(study: Entries, material: str, which: str, level: int) -> float:
    """Return the PSNR in dB of a material at one level against the converged truth, in the mean of seeds."""
    return mean(d["C"]["psnr_db"][level] for d in _runs(study, material, which))


def shading_spread(study: Entries, material: str, which: str) -> float:
    """Return the range in dB of the mean PSNR of the seeds."""
    values = [d["C"]["mean_db"] for d in _runs(study, material, which)]
    return max(values) - min(values)


def flip(study: Entries, material: str, which: str) -> float:
    """Return the mean FLIP of a material against the converged truth, ``which`` as of :func:`_runs`."""
    return mean(mean(d["C"]["flip"]) for d in _runs(study, material, which))


def held_out(study: Entries, run: str) -> float:
    """Return the PSNR in dB of held-out views and lights after a training inside a scene."""
    (scene,) = study.details.scenes
    return study.jobs[f"{scene}, {run}"].details.psnr_db


def rendered(study: Entries, scene: str, name: str, spp: int = 1) -> float:
    """Return the PSNR in dB of a whole render."""
    return one(study.scenes[scene].points, name=name, spp=spp).psnr_db


def shipped(task: str, preset: str) -> float:
    """Return the PSNR in dB that is stored in the file that ships for a preset of a task."""
    task = tasks()[task]
    return task.load(task.file(preset=preset)).measured["psnr_db"]


def trust_cells(study: Entries) -> tuple[int, int]:
    """Return the numbers of cells of the table of properties that were measured, and of all."""
    results = [cell.result for by in study.cells.values() for row in by.values() for cell in row.values()]
    return len(results) - results.count("not run"), len(results)


#: Task of ``bench_ratio`` → figure of its tables; the angles of ``sdf`` are errors.
RATIO_FIGURES = {
    "image": "psnr_db", "texture": "psnr_levels_db", "sdf": "normal_deg", "field": "psnr_foreground_db",
}  # fmt: skip


def groups(rows: Iterable[dict], *keys: str) -> dict[tuple, list[dict]]:
    """Return rows by the values of some keys."""
    result = {}
    for row in rows:
        result.setdefault(tuple(row[key] for key in keys), []).append(row)
    return result


def ratio_rows(study: Entries, task: str, budget: float, preset: str = "paper", part: str = "") -> list[dict]:
    """Return the trainings of a sweep of ρ, from the largest on; figures are means over seeds."""
    sweep = groups(study.rows, "task", "budget", "preset", "part").get((task, budget, preset, part), [])
    figure = RATIO_FIGURES[task]
    means = [{**same[0], figure: mean(row[figure] for row in same)} for same in groups(sweep, "ratio").values()]
    return sorted(means, key=lambda row: -row["ratio"])


def ratio_best(study: Entries, task: str, budget: float, preset: str = "paper", part: str = "") -> dict:
    """Return the training of the best ρ of a sweep."""
    sign = 1 if task == "sdf" else -1
    return min(ratio_rows(study, task, budget, preset, part), key=lambda row: sign * row[RATIO_FIGURES[task]])


def ratio_loss(study: Entries, task: str, budget: float, preset: str = "paper", part: str = "") -> float:
    """Return how far the default ρ lies behind the best: in dB, of an angle relative to the best."""
    figure = RATIO_FIGURES[task]
    (default,) = [row for row in ratio_rows(study, task, budget, preset, part) if row["default"]]
    best = ratio_best(study, task, budget, preset, part)[figure]
    return default[figure] / best - 1 if task == "sdf" else best - default[figure]


def _largest_difference(study: Entries, task: str, *keys: str) -> float:
    rows = [row for row in study.rows if row.task == task]
    values = [[row[RATIO_FIGURES[task]] for row in same] for same in groups(rows, "preset", "budget", *keys).values()]
    return max(max(same) - min(same) for same in values)


def ratio_noise(study: Entries, task: str) -> float:
    """Return the largest difference between trainings of the same arrays by different seeds."""
    return _largest_difference(study, task, "ratio")


def ratio_range(study: Entries, task: str) -> float:
    """Return the largest difference, in dB, of a sweep of ρ."""
    return _largest_difference(study, task, "part")


#: Functions of an expression, by name.
FUNCTIONS = {
    f.__name__: f
    for f in (
        min, max, sum, len, round, abs, all, any, sorted, one, ratio, time_over, equal_samples, shading, shading_level,
        shading_spread, flip, held_out, rendered, shipped, trust_cells, ratio_rows, ratio_best, ratio_loss, ratio_noise,
        ratio_range,
    )
} | {"mean": mean}  # fmt: skip


# -- claims ------------------------------------------------------------------------------------------------------------


def files(expression: str) -> set[str]:
    """Return the names of the files that an expression reads."""
    names = [node for node in ast.walk(ast.parse(expression, mode="eval")) if isinstance(node, ast.Name)]
    bound = {node.id for node in names if isinstance(node.ctx, ast.Store)}
    return {node.id for node in names} - bound - FUNCTIONS.keys()


def evaluate(expression: str) -> Any:
    """Return the value of an expression."""
    names = {name: measured(name) for name in files(expression)}
    try:
        return eval(expression, {"__builtins__": {}, **FUNCTIONS, **names})
    except (ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError) as error:
        raise ClaimError(f"claims.toml: {expression}: {error}") from error


@dataclass
class Claim:
    """One part of a sentence of a page, with an expression for each field."""

    page: str
    text: str
    values: dict[str, str] = field(default_factory=dict)
    holds: str | None = None

    @property
    def path(self) -> Path:
        """The file of the page: the README, a page of ``docs``, or the source of a plugin with its docstring."""
        return ROOT / self.page if self.page == "README.md" or "/" in self.page else DOCS / self.page

    @property
    def files(self) -> list[str]:
        """The names of the files that the claim reads."""
        return sorted(set().union(*map(files, [*self.values.values(), *filter(None, [self.holds])])))

    def pattern(self) -> re.Pattern:
        """Return the regular expression of the sentence: any number in each field, any white space."""
        parts = []
        for literal, name, _, _ in string.Formatter().parse(self.text):
            parts.append(phrase_pattern(literal))
            if name is not None:
                parts.append(r"([-+−]?\d+(?:[.,]\d+)*%?)")
        return re.compile("".join(parts))

    def numbers(self) -> list[str]:
        """Return the numbers of the fields, as the page should have them."""
        values = {name: evaluate(expression) for name, expression in self.values.items()}
        fields = ((name, spec) for _, name, spec, _ in string.Formatter().parse(self.text) if name is not None)
        return [format(values[name], spec) for name, spec in fields]

    def matches(self, text: str) -> list[re.Match]:
        """Return where the page has the sentence, with whatever numbers."""
        return list(self.pattern().finditer(text))

    def written(self, text: str) -> str:
        """Return the page with the numbers of the JSON in this sentence."""
        numbers, matches = self.numbers(), self.matches(text)
        if not matches:
            raise ClaimError(f"{self.page}: no such sentence: “{self.text}”; claims.toml has it, mend either")
        if self.holds is not None and not evaluate(self.holds):
            raise ClaimError(f"{self.page}: “{self.text}” does not hold: {self.holds}")
        for match in reversed(matches):
            for group in reversed(range(len(numbers))):
                start, end = match.span(group + 1)
                text = text[:start] + numbers[group] + text[end:]
        return text


@cache
def claims() -> tuple[Claim, ...]:
    """Return all claims of ``claims.toml``."""
    return tuple(
        Claim(page, entry["text"], {k: v for k, v in entry.items() if k not in ("text", "holds")}, entry.get("holds"))
        for page, entries in toml("claims.toml").items()
        for entry in entries
    )


# -- numbers that no file backs ----------------------------------------------------------------------------------------

NUMBER = re.compile(r"(?<![\w.])\d+(?:[.,]\d+)*(?:·10[⁻⁰-⁹]+|e-?\d+)?")

#: Parts of a page in which no number is a claim.
CODE = (
    r"^ *```.*?^ *```", r"(?<!`)`(?!`)[^`]+`", r"(?<=\])\([^)\n]*\)", r"https?://\S+", r"<[a-z/][^>\n]*>",
)  # fmt: skip
#: Versions, years, parts of papers, names.
NAMES = (
    r"(?:Mitsuba|Python|LLVM|PyTorch|Dr\.Jit|[Vv]ersions?|CUDA|OpenEXR|EPYC|CC|BSD|Zen|NeRF|mip-NeRF|MaterialX)"
    r" \(?\d[\w.]*(?:(?: to |, | and | or )\d[\d.]*)*",
    r"\b(?:19[89]\d|20[0-3][1-9]|20[1-3]\d)(?:-\d\d-\d\d)?\b(?! (?:steps|samples|rays|texels|pixels|spp|views))",
    r"(?:[Ss]upplement(?:al)?|[Ss]ections?|[Tt]ables?|[Ff]igures?|[Ee]quations?|[Ee]q\.|[Tt]asks?|[Nn]otebooks?|"
    r"[Ll]evels?|paper) \(?\d[\d.]*(?:(?:, | and | to )\d[\d.]*)*",
    r"^\s*\d+\. ", r"BSD-\d", r"#\d+", r"\b3\.(?:9|10)(?:\.\d+)?\b(?! (?:times|dB|ms|ns|s|MB|kB|GB)|%)",
    r"\[\^?\d+\]", r"[1234]D\b|x86-64|AVX-512",
    r"\[10\.\d+/[^\]]+\]|^\| 1\.\d(?:\.\d)?\b|§\s*[\d.]+", r"[Rr]ec\. \d+", r"[Ee]xit codes?:?.*$",
)  # fmt: skip
#: Nouns of which a page says how many were chosen.
CHOSEN = (
    r"bits?|bytes? (?:a|of each)|bytes?/|samples?|spp|views?|steps?|rays?|pixels?|texels?|entries|entry|nodes?|cells?|"
    r"levels?|layers?|units|weights|channels?|dimensions?|numbers?|colours?|seeds?|textures|maps|materials|frames|rounds|"
    r"workers?|processes|cores?|threads?|passes|patches|directions|queries|points|rows|columns|images|pictures|photographs|"
    r"things|spheres|lines|angles|tiles|reads|test|training|held-out|random|independent|multijittered|scattered|"
    r"stratified|corners|octaves|lobes|fields|meshes|axes|parameters|sides?|bricks|blocks|pages?|primaries|cascaded|"
    r"competitors|optional|days?|scripts?|plugins?|files?|commands?|runs?|scenes?|variants?|properties|primary|hidden"
)
SETTINGS = (
    r"\d[\d.,]*(?:²|³|⁴)",
    r"\d[\d.,]*(?: ?[×x] ?\d[\d.,]*)+",
    r"\d[\d.,]*(?:(?:, | and | or | to |; )\d[\d.,]*)*[- ](?:" + CHOSEN + r")\b",
    r"\b\d+x\b",
    r"(?<!\w)(?:λ|α|ρ|gloss|roughness|depth|L|σ|γ|r|spp)(?: =| of)? ?\d[\d.]*(?:(?:, | and | to )\d[\d.]*)*",
    r"\[-?\d+, -?\d+[\])]", r"[<>≤≥=] ?\d[\d.]*", r"(?:defaults? is|by default,?) \d[\d.]*",
    r"10[⁰-⁹⁻]+|2[⁰-⁹⁻]+|\d²", r"\b(?:1|2|4|256|512) [MK]iB", r"\b(?:128|256) kB",
)  # fmt: skip


@dataclass
class Found:
    """One number of a page: its line, its class, the text around it, and whether a headline has it."""

    page: str
    line: int
    number: str
    kind: str
    headline: bool
    context: str


def phrase_pattern(phrase: str) -> str:
    """Return the regular expression of a phrase, with any white space between its words."""
    return r"\s+".join(map(re.escape, re.split(r"\s+", phrase)))


def _blank(text: str, pattern: str, flags: int = re.M) -> str:
    """Return the text with spaces in place of what a pattern matches, line breaks kept."""
    return re.sub(pattern, lambda m: re.sub(r"[^\n]", " ", m[0]), text, flags=flags)


def _spans(text: str, pattern: str, flags: int = re.M) -> list[tuple[int, int]]:
    return [m.span() for m in re.finditer(pattern, text, flags)]


def headlines(page: str, text: str) -> list[tuple[int, int]]:
    """Return where a page makes its headlines: tables and lists of the README, the first paragraph of others."""
    if page == "README.md":
        return _spans(text, r"^(?:\||- |  \S).*$")
    first = page.endswith(".md") and re.search(r"^(?![#!\[<\s`|]).+(?:\n(?!\n).+)*", text, re.M)
    return [first.span()] if first else []


def numbers(page: str, text: str) -> list[Found]:
    """Return all numbers of a page, with their classes."""
    inside = lambda place, spans: any(a <= place < b for a, b in spans)  # noqa: E731
    lines = [0, *(m.end() for m in re.finditer("\n", text))]
    spans = {
        "backed": [
            *_spans(text, r"<!-- table \w+ -->\n.*?<!-- end -->", re.S),
            *(span for c in claims() if c.path.name == page for m in c.matches(text) for span in m.regs[1:]),
        ],
        "trial": _spans(text, r"<!-- trials: .*?<!-- /trials -->", re.S),
    }  # fmt: skip
    top = headlines(page, text)
    chosen = [span for phrase in toml("settings.toml").get(page, ()) for span in _spans(text, phrase_pattern(phrase))]
    bare = text
    for pattern in CODE:
        bare = _blank(bare, pattern, re.M | re.S)
    bare = _blank(bare, r"<!--.*?-->", re.S)
    for pattern in NAMES:
        bare = _blank(bare, pattern)
    flat = bare.replace("\n", " ")
    chosen += [span for pattern in SETTINGS for span in _spans(flat, pattern)]
    result = []
    for match in NUMBER.finditer(bare):
        start, end = match.span()
        kind = next((k for k, places in spans.items() if inside(start, places)), None)
        kind = kind or ("setting" if inside(start, chosen) else "unbacked")
        line = sum(start >= begin for begin in lines)
        context = re.sub(r"\s+", " ", text[max(0, start - 45) : end + 35])
        result.append(Found(page, line, match[0], kind, inside(start, top), context))
    return result


def pages() -> dict[str, str]:
    """Return the text of the README, of each page that is written by hand, and of each notebook, by its name."""
    paths = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    texts = {p.name: p.read_text(encoding="utf-8") for p in paths if p.name not in ("tasks.md", "figures.md")}
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        texts[path.name] = "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    return texts


def counts() -> dict[str, Counter]:
    """Return how many numbers of each class a page has."""
    return {page: Counter(n.kind for n in numbers(page, text)) for page, text in pages().items()}


def main(arguments: list[str]) -> int:
    """Print the numbers and their counts; return the exit code."""
    parser = argparse.ArgumentParser(description="List the numbers of pages that no file backs.")
    parser.add_argument("pages", nargs="*", metavar="PAGE", help="names of pages (default: all)")
    parser.add_argument("--all", action="store_true", help="list backed numbers, trials and settings, too")
    parser.add_argument("--headlines", action="store_true", help="list those of headlines alone")
    chosen = parser.parse_args(arguments)
    for page in sorted(set(chosen.pages) - set(pages())):
        print(f"figures.py: no page {page!r}; allowed: {', '.join(pages())}", file=sys.stderr)
        return 2
    for page, text in pages().items():
        if chosen.pages and page not in chosen.pages:
            continue
        for n in numbers(page, text):
            if (chosen.all or n.kind == "unbacked") and (n.headline or not chosen.headlines):
                mark = f"{n.kind} headline" if n.headline else n.kind
                print(f"{Path(n.page).name}:{n.line}: {n.number}  ({mark})  …{n.context}…")
    print(f"\n{'page':32} {'backed':>8} {'trials':>8} {'settings':>8} {'unbacked':>8}")
    for page, count in counts().items():
        print(f"{page:32} " + " ".join(f"{count[k]:8}" for k in ("backed", "trial", "setting", "unbacked")))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
