"""
List the numbers of the README, the pages and the notebooks that no file backs.

    python docs/list_numbers.py [--all] [--headlines] [PAGE …]

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
import json
import re
import sys
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from claims import ROOT, claims, tomllib

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


@cache
def settings() -> dict[str, list[str]]:
    """Return the phrases of ``settings.toml`` by page."""
    return tomllib.loads((ROOT / "docs" / "settings.toml").read_text(encoding="utf-8"))


def phrase_pattern(phrase: str) -> str:
    """Return the regular expression of a phrase, with any white space between its words."""
    return r"\s+".join(map(re.escape, phrase.split()))


def _blank(text: str, pattern: str, flags: int = re.M) -> str:
    """Return the text with spaces in place of what a pattern matches, line breaks kept."""
    return re.sub(pattern, lambda m: re.sub(r"[^\n]", " ", m[0]), text, flags=flags)


def _spans(text: str, pattern: str, flags: int = re.M) -> list[tuple[int, int]]:
    return [m.span() for m in re.finditer(pattern, text, flags)]


def headlines(page: str, text: str) -> list[tuple[int, int]]:
    """Return where a page makes its headlines: tables and lists of the README, the first paragraph of others."""
    if page == "README.md":
        return _spans(text, r"^(?:\||- |  \S).*$")
    if not page.endswith(".md"):
        return []
    first = re.search(r"^(?![#!\[<\s`|]).+(?:\n(?!\n).+)*", text, re.M)
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
    chosen = [span for phrase in settings().get(page, ()) for span in _spans(text, phrase_pattern(phrase))]
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
        print(f"list_numbers.py: no page {page!r}; allowed: {', '.join(pages())}", file=sys.stderr)
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
