"""
Write the figures of the documentation, or check them.

    python docs/make_tables.py [--check] [--list]

All figures are those of JSON in ``docs/measured``; ``commands.toml`` there has the command that wrote each file. Pages
get them by expressions (``figures.py``) in three files:

- ``tables.toml``: tables, which stand between ``<!-- table NAME -->`` and ``<!-- end -->``. A table that shows some of
  its rows has all of them in ``docs/measured/NAME.csv``.
- ``claims.toml``: figures in sentences. Each entry names a page (the README, a page of ``docs``, as ``sdf.md`` or
  ``studies/sdf.md``, or the file of a plugin, whose docstring is a page of the manual), a part of a sentence with
  fields as of ``str.format``, and an expression for each field. ``holds`` is an expression that must be true, for a
  sentence in words:

      [["README.md"]]
      text = "a grid of {grid:.1f} dB in {minutes:.0f} minutes"
      grid = "nerf_scenes.rows[0].psnr_white_db"
      minutes = "nerf_scenes.rows[0].minutes"

``docs/measured/files.csv`` lists the command of each file, ``sentences.csv`` the files of each sentence. With
``--check`` nothing is written, and the exit code is 1 if a page or a CSV file would change. ``--list`` prints the
numbers of pages that no file backs: those that neither a table nor a sentence inserts and that are no settings. A
*setting* says what was chosen and not what came out: bits, samples, steps, sides, ratios such as 12x, and the phrases
of ``settings.toml``. Code, addresses, versions, years, numbers of sections and digits of a name (``float32``) are not
numbers.
"""

from __future__ import annotations

import csv
import io
import json
import re
import string
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from figures import (
    DOCS,
    ROOT,
    ClaimError,
    commands,
    evaluate,
    files,
    formatted,
    toml,
)

import mi_diffind


def page_paths() -> list[Path]:
    """Return the files of the pages that are written by hand, but the README: pages of ``docs``, and its studies."""
    return sorted([*DOCS.glob("*.md"), *DOCS.glob("studies/*.md")])


def page_name(path: Path) -> str:
    """Return the name of a page in ``claims.toml`` and ``settings.toml``: ``sdf.md``, ``studies/sdf.md``."""
    return path.relative_to(DOCS).as_posix() if DOCS in path.parents else path.name


# -- tables ------------------------------------------------------------------------------------------------------------


@dataclass
class Table:
    """Table of a page: its head, its rows, and those of the rows that the page shows."""

    head: list[str]
    rows: list[list[str]]
    shown: list[list[str]]

    def __str__(self) -> str:
        """Return the rows that the page shows, in Markdown."""
        lines = [self.head, ["---"] * len(self.head), *self.shown]
        return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines)

    def page_text(self, name: str, measured: str = "measured") -> str:
        """Return the rows that the page shows and, if these are not all, a link to ``measured/NAME.csv``."""
        link = f"\n\nAll {len(self.rows)} rows: [{name}.csv]({measured}/{name}.csv)"
        return f"{self}{link if len(self.shown) < len(self.rows) else ''}"

    def csv(self) -> str:
        """Return all rows as comma-separated values, without marks of Markdown and separators of thousands."""
        marks = re.compile(r"`|\*\*|(?<=\d),(?=\d{3})")
        stream = io.StringIO()
        lines = ([marks.sub("", cell) for cell in line] for line in (self.head, *self.rows))
        csv.writer(stream, lineterminator="\n").writerows(lines)
        return stream.getvalue()


def table(head: list, rows: list[list]) -> Table:
    """Return a table whose rows are all shown."""
    return Table(head, rows, rows)


def cells_of(text: str, known: dict, missing: str | None = None) -> list[str]:
    """Return the cells of a text with `` | `` between them; without a ``missing``, each needs its figures."""
    result = []
    for cell in text.replace("\n | ", " | ").split(" | "):
        try:
            result += evaluate(formatted(cell), **known).split(" | ")
        except ClaimError as error:
            if missing is None or not isinstance(error.__cause__, (AttributeError, KeyError)):
                raise
            result.append(missing)
    return result


def named(entry: dict, known: dict) -> dict:
    """Return the ``known`` names with those of the entry's ``let``, in their order."""
    for name, expression in entry.get("let", {}).items():
        known = {**known, name: evaluate(expression, **known)}
    return known


def declared(entry: dict, study: str = "") -> Table:
    """Return a table of ``tables.toml``."""
    known: dict[str, Any] = {"study": evaluate(study)} if study else {}
    content, rows = evaluate(entry["rows"], **known), []
    for item in content.items() if isinstance(content, Mapping) else content:
        own = {"name": item[0], "row": item[1]} if isinstance(content, Mapping) else {"row": item}
        rows.append(cells_of(entry["row"], named(entry, known | own), entry.get("missing")))
    test = entry.get("shown", "True")
    return Table(cells_of(entry["head"], known), rows, [r for r in rows if evaluate(test, rows=rows, cell=r)])


@cache
def tables() -> dict[str, Table]:
    """Return all tables by name."""
    result = {}
    for name, entry in toml("tables.toml").items():
        for ending, study in entry.get("study", {"": ""}).items():
            result[name + ending] = declared(entry, study)
    return result


# -- claims ------------------------------------------------------------------------------------------------------------


@dataclass
class Claim:
    """One part of a sentence of a page, with an expression for each field."""

    page: str
    text: str
    values: dict[str, str] = field(default_factory=dict)
    holds: str | None = None

    @property
    def path(self) -> Path:
        """The file of the page: a page of ``docs``, the README, or the source of a plugin with its docstring."""
        return (DOCS if (DOCS / self.page).is_file() else ROOT) / self.page

    @property
    def files(self) -> list[str]:
        """The names of the files that the claim reads."""
        return sorted(set().union(*map(files, [*self.values.values(), *filter(None, [self.holds])])))

    def pattern(self) -> re.Pattern:
        """Return the regular expression of the sentence: any number in each field, any white space."""
        parts = []
        for literal, name, _, _ in string.Formatter().parse(self.text):
            parts += [phrase_pattern(literal), r"([-+−]?\d+(?:[.,]\d+)*%?)" if name is not None else ""]
        return re.compile("".join(parts))

    def matches(self, text: str) -> list[re.Match]:
        """Return where the page has the sentence, with whatever numbers."""
        return list(self.pattern().finditer(text))

    def written(self, text: str) -> str:
        """Return the page with the numbers of the JSON in this sentence."""
        fields = [(name, spec) for _, name, spec, _ in string.Formatter().parse(self.text) if name is not None]
        numbers, matches = [format(evaluate(self.values[name]), spec) for name, spec in fields], self.matches(text)
        if not matches:
            raise ClaimError(f"{self.page}: no such sentence: “{self.text}”; claims.toml has it, correct either")
        if self.holds is not None and not evaluate(self.holds):
            raise ClaimError(f"{self.page}: “{self.text}” does not hold: {self.holds}")
        for match in reversed(matches):
            for (start, end), number in reversed([*zip(match.regs[1:], numbers, strict=True)]):
                text = text[:start] + number + text[end:]
        return text


@cache
def claims() -> tuple[Claim, ...]:
    """Return all claims of ``claims.toml``."""
    return tuple(
        Claim(page, entry["text"], {k: v for k, v in entry.items() if k not in ("text", "holds")}, entry.get("holds"))
        for page, entries in toml("claims.toml").items()
        for entry in entries
    )


def phrase_pattern(phrase: str) -> str:
    """Return the regular expression of a phrase, with any white space between its words."""
    return r"\s+".join(map(re.escape, re.split(r"\s+", phrase)))


# -- numbers that no file backs ----------------------------------------------------------------------------------------

NUMBER = re.compile(r"(?<![\w.])\d+(?:[.,]\d+)*(?:·10[⁻⁰-⁹]+|e-?\d+)?")

#: Parts of a page that have no numbers: tables, code, addresses, comments, versions, years, parts of papers, names.
NO_NUMBERS = (
    r"<!-- table \w+ -->\n.*?<!-- end -->", r"^ *```.*?^ *```", r"(?<!`)`(?!`)[^`]+`", r"(?<=\])\([^)\n]*\)",
    r"https?://\S+", r"<[a-z/][^>\n]*>", r"<!--.*?-->",
    r"(?:Mitsuba|Python|LLVM|PyTorch|Dr\.Jit|[Vv]ersions?|CUDA|OpenEXR|EPYC|CC|BSD|Zen|NeRF|mip-NeRF|MaterialX)"
    r" \(?\d[\w.]*(?:(?: to |, | and | or )\d[\d.]*)*",
    r"\b(?:19[89]\d|20[0-3][1-9]|20[1-3]\d)(?:-\d\d-\d\d)?\b(?! (?:steps|samples|rays|texels|pixels|spp|views))",
    r"(?:[Ss]upplement(?:al)?|[Ss]ections?|[Tt]ables?|[Ff]igures?|[Ee]quations?|[Ee]q\.|[Tt]asks?|[Nn]otebooks?|"
    r"[Ll]evels?|paper) \(?\d[\d.]*(?:(?:, | and | to )\d[\d.]*)*",
    r"^\s*\d+\. ", r"BSD-\d", r"#\d+", r"\b3\.(?:9|10)(?:\.\d+)?\b(?! (?:times|dB|ms|ns|s|MB|kB|GB)|%)",
    r"\[\^?\d+\]", r"[1234]D\b|x86-64|AVX-512",
    r"\[10\.\d+/[^\]]+\]|^\| 1\.\d(?:\.\d)?\b|§\s*[\d.]+", r"[Rr]ec\. \d+", r"[Ee]xit codes?:?[^\n]*$",
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


def unbacked(page: str, text: str) -> list[str]:
    """Return the numbers of a page that no file backs and that are no settings, as ``PAGE:LINE: NUMBER  …TEXT…``."""
    bare = text
    for pattern in NO_NUMBERS:
        bare = re.sub(pattern, lambda m: re.sub(r"[^\n]", " ", m[0]), bare, flags=re.M | re.S)
    spans = [m.span() for pattern in SETTINGS for m in re.finditer(pattern, bare.replace("\n", " "))]
    phrases = toml("settings.toml").get(page, ())
    spans += [m.span() for phrase in phrases for m in re.finditer(phrase_pattern(phrase), text)]
    spans += [span for c in claims() if page_name(c.path) == page for m in c.matches(text) for span in m.regs[1:]]
    return [
        f"{page}:{text.count(chr(10), 0, m.start()) + 1}: {m[0]}  …"
        + re.sub(r"\s+", " ", text[max(0, m.start() - 45) : m.end() + 35])
        for m in NUMBER.finditer(bare)
        if not any(a <= m.start() < b for a, b in spans)
    ]


def pages() -> dict[str, str]:
    """Return the text of the README, of each page that is written by hand, and of each notebook, by its name."""
    texts = {page_name(p): p.read_text(encoding="utf-8") for p in (ROOT / "README.md", *page_paths())}
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        texts[path.name] = "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    return texts


# -- pages -------------------------------------------------------------------------------------------------------------


def machine(name: str) -> str:
    """Return the processor, its cores and the version of this package that a file of figures records."""
    m = evaluate(name).get("machine", {})
    if "cpu" not in m:
        return "–"
    processor = m.get("instructions", "").partition(",")[0]
    return f"{m.cpu} {processor}".rstrip() + f", cores: {m.cores}, {m['mi-diffind']}"


#: Files that :func:`lists` writes.
LISTS = (DOCS / "measured" / "files.csv", DOCS / "measured" / "sentences.csv")


def lists(pages: dict[Path, str]) -> dict[Path, str]:
    """Return CSV files with the command of each JSON file, and with the files of each sentence with figures."""
    written_by = [[name, command, machine(name)] for name, command in sorted(commands().items())]
    sentences = [
        [claim.page, re.sub(r"\s+", " ", claim.matches(pages[claim.path])[0][0]), " ".join(claim.files)]
        for claim in claims()
    ]
    return {
        LISTS[0]: table(["file", "command", "machine, version"], written_by).csv(),
        LISTS[1]: table(["page", "sentence", "files"], sentences).csv(),
    }


def written() -> tuple[dict[Path, str], list[str]]:
    """Return all pages and CSV files with the figures of the JSON, and a sentence for each that cannot be written."""
    pages, csv_files, troubles = {}, {}, []

    def block(match: re.Match) -> str:
        begin, name, end = match.groups()
        content = tables()[name]
        if len(content.shown) < len(content.rows):
            csv_files[DOCS / "measured" / f"{name}.csv"] = content.csv()
        return f"{begin}{content.page_text(name, measured)}\n{end}"

    for path in page_paths():
        measured = "../measured" if path.parent != DOCS else "measured"
        text = path.read_text(encoding="utf-8")
        pages[path] = re.sub(r"(<!-- table (\w+) -->\n)(?:(?:\|.*|All \d.*)?\n)*(<!-- end -->)", block, text)
    for claim in claims():
        try:
            pages.setdefault(claim.path, claim.path.read_text(encoding="utf-8"))
            pages[claim.path] = claim.written(pages[claim.path])
        except FileNotFoundError:
            troubles.append(f"claims.toml: no page {claim.page!r}; allowed: README.md, pages of docs, paths of files")
        except ClaimError as error:
            troubles.append(str(error))
    if not troubles:
        csv_files |= lists(pages)
    for path in sorted(set((DOCS / "measured").glob("*.csv")) - csv_files.keys() - {*LISTS}):
        troubles.append(f"measured/{path.name}: no page has a shortened table of this name; remove the file")
    return pages | csv_files, troubles


def main(arguments: list[str]) -> int:
    """Write the pages that differ, with ``--check`` name them, or list numbers; return the exit code."""
    if "--list" in arguments:
        print("\n".join(line for page, text in pages().items() for line in unbacked(page, text)))
        return 0
    check = "--check" in arguments
    contents, troubles = written()
    differing = [p for p, text in contents.items() if not p.is_file() or p.read_text(encoding="utf-8") != text]
    for trouble in troubles:
        print(trouble, file=sys.stderr)
    for path in differing:
        print(f"{page_name(path)}: {'would change' if check else 'written'} ({mi_diffind.__version__})")
        if not check:
            path.write_text(contents[path], encoding="utf-8")
    return int(bool(troubles) or (check and bool(differing)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
