"""
Numbers in the sentences of the pages, inserted from JSON in ``docs/measured``.

``claims.toml`` maps sentences to figures. Each entry names a page (the README, a page of ``docs``, or the file of a
plugin, whose docstring is a page of the manual), a part of a sentence with fields as of
``str.format``, and an expression for each field:

    [["README.md"]]
    text = "a grid of {grid:.1f} dB in {minutes:.0f} minutes"
    grid = "nerf_scenes.rows[0].psnr_white_db"
    minutes = "nerf_scenes.rows[0].minutes"

An expression begins with the name of a file in ``docs/measured`` and goes on by keys and indices. It may compute:
``a.x / a.y``, ``min(…)``, ``max(…)``, ``mean(…)``, ``one(rows, name="ours")`` for the only row of a list with these
values, and the functions of ``derived.py``. ``holds`` is an expression that must be true, for a sentence in words.
``commands.toml`` in ``docs/measured`` has the command that wrote each file.
"""

from __future__ import annotations

import ast
import inspect
import json
import re
import string
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import derived

if sys.version_info >= (3, 11):
    import tomllib
else:  # comes with pytest
    import tomli as tomllib

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
NUMBER = r"[-+−]?\d+(?:[.,]\d+)*%?"


class ClaimError(Exception):
    """Raised when a sentence, a file or a value of a claim is not there."""


class Node:
    """A dictionary or list of a JSON file, whose entries are attributes as well."""

    def __init__(self, content: dict | list, name: str):
        self.content, self._name = content, name

    def __getitem__(self, key: Any) -> Any:
        name = f"{self._name}[{key!r}]"
        try:
            return _node(self.content[key], name)
        except (KeyError, IndexError, TypeError):
            raise ClaimError(f"docs/measured has no {name}; allowed: {self._allowed()}") from None

    def __getattr__(self, key: str) -> Any:
        if key.startswith("__"):
            raise AttributeError(key)
        return self[key]

    def __iter__(self) -> Iterator:
        return iter([self[i] for i in range(len(self))] if isinstance(self.content, list) else self.content)

    def __len__(self) -> int:
        return len(self.content)

    def values(self) -> list:
        """Return the values of a dictionary."""
        return [self[key] for key in self]

    def _allowed(self) -> str:
        if isinstance(self.content, list):
            return f"0 to {len(self) - 1}"
        return ", ".join(map(repr, list(self.content)[:20]))


def _node(value: Any, name: str) -> Any:
    return Node(value, name) if isinstance(value, dict | list) else value


@cache
def measured(name: str) -> Node:
    """Return the JSON file ``docs/measured/NAME.json``."""
    path = DOCS / "measured" / f"{name}.json"
    if not path.is_file():
        raise ClaimError(f"{path.relative_to(ROOT)}: no such file; a claim names it")
    return Node(json.loads(path.read_text(encoding="utf-8")), name)


def one(rows: Iterable[Node], **values: Any) -> Node:
    """Return the only row of a list that has these values."""
    found = [row for row in rows if all(row[key] == value for key, value in values.items())]
    if len(found) != 1:
        raise ClaimError(f"{len(found)} rows have {values}; allowed: exactly one")
    return found[0]


def mean(values: Iterable[float]) -> float:
    """Return the mean of an iterable."""
    values = list(values)
    return sum(values) / len(values)


#: Functions of an expression, by name: these of Python, those above, and the public ones of ``derived.py``.
FUNCTIONS = {f.__name__: f for f in (min, max, mean, one, sum, len, round, abs, all, any, sorted)}
FUNCTIONS |= {name: f for name, f in inspect.getmembers(derived, inspect.isfunction) if name[0] != "_"}


def files(expression: str) -> set[str]:
    """Return the names of the files that an expression of ``claims.toml`` reads."""
    names = [node for node in ast.walk(ast.parse(expression, mode="eval")) if isinstance(node, ast.Name)]
    bound = {node.id for node in names if isinstance(node.ctx, ast.Store)}
    return {node.id for node in names} - bound - FUNCTIONS.keys()


def evaluate(expression: str) -> Any:
    """Return the value of an expression of ``claims.toml``."""
    names = {name: measured(name) for name in files(expression)}
    try:
        return eval(expression, {"__builtins__": {}, **FUNCTIONS, **names})
    except (ArithmeticError, LookupError, StopIteration, TypeError, ValueError) as error:
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

    def pattern(self) -> re.Pattern:
        """Return the regular expression of the sentence: any number in each field, any white space."""
        parts = []
        for literal, name, _, _ in string.Formatter().parse(self.text):
            parts.append(r"\s+".join(map(re.escape, re.split(r"\s+", literal))))
            if name is not None:
                parts.append(f"({NUMBER})")
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
    content = tomllib.loads((DOCS / "claims.toml").read_text(encoding="utf-8"))
    parts = []
    for page, entries in content.items():
        for entry in entries:
            values = {name: value for name, value in entry.items() if name not in ("text", "holds")}
            parts.append(Claim(page, entry["text"], values, entry.get("holds")))
    return tuple(parts)


def commands() -> dict[str, str]:
    """Return the command that wrote each file of ``docs/measured``, by the name of the file."""
    return tomllib.loads((DOCS / "measured" / "commands.toml").read_text(encoding="utf-8"))
