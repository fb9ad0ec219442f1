"""Strategies of hypothesis for recipes of :mod:`hostile_files`, from the structure of a valid file."""

from __future__ import annotations

import json
import os
import tempfile
from pathlib import Path

from hostile_files import SIDES, VALUES, Archive
from hypothesis import HealthCheck, Phase, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st
from hypothesis.configuration import set_hypothesis_home_dir

# Hypothesis keeps tables of constants beside the tests otherwise
set_hypothesis_home_dir(Path(tempfile.gettempdir()) / "hypothesis")

#: Number of mutants of a long run; of a default run, a hundredth.
MUTANTS = int(os.environ.get("MI_DIFFIND_MUTANTS", "2000"))


def hostile(examples: int, seed: int = 0):
    """Return a decorator: always the same examples, or others by ``seed``, no limit of time, nothing is written."""
    decorator = settings(
        max_examples=examples, derandomize=not seed, deadline=None, database=None,
        suppress_health_check=list(HealthCheck), phases=(Phase.generate, Phase.shrink),
    )  # fmt: skip
    return (lambda test: seeded(seed)(decorator(test))) if seed else decorator


def paths_of(content, before: tuple = ()) -> list[tuple]:
    """Return the paths of all values of JSON content."""
    paths = [before] if before else []
    entries = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in entries:
        paths += paths_of(value, (*before, key))
    return paths


def numbers() -> st.SearchStrategy:
    """Numbers of all sizes, and what is no number."""
    return st.one_of(
        st.sampled_from([0, -1, 1, 2**31, 2**32, 2**53, 2**63, 2**64, 2**70, -(2**40), 10**30]),
        st.integers(-300, 300), st.integers(), st.floats(), st.floats(-2, 2),
    )  # fmt: skip


def values() -> st.SearchStrategy:
    """Values of JSON."""
    return st.one_of(st.sampled_from(VALUES), numbers())


def json_recipes(content) -> st.SearchStrategy:
    """Recipes of one to three steps in JSON content."""
    paths = st.sampled_from(paths_of(content)).map(list)
    step = st.one_of(
        st.tuples(st.just("set_value"), paths, values()),
        st.tuples(st.just("delete_value"), paths),
        st.tuples(st.just("scale_value"), paths, st.sampled_from([-1, 0, 0.5, 2, 1000, 1e30]),
                  st.sampled_from([-1, 0, 1, 0.5])),
        st.tuples(st.just("nested"), paths, st.sampled_from([2, 500, 100000])),
    ).map(list)  # fmt: skip
    return st.lists(step, min_size=1, max_size=3)


def archive_recipes(archive: Archive) -> st.SearchStrategy:
    """Recipes of lies in the description, the entries, the headers and the archive."""
    names, every = st.sampled_from(sorted(archive.arrays)), st.sampled_from(["meta", *sorted(archive.arrays)])
    sides = st.one_of(st.sampled_from(SIDES), st.integers(0, 40))
    small = st.one_of(st.integers(0, 40), st.sampled_from([64, 127, 256]))
    seeds = st.integers(0, 2**16)
    other = st.sampled_from(["x", "", "meta", "a" * 300, "../x", "a/b", "\x1b[31m", "a\nb", "level9", "cascaded"])
    dtypes = st.sampled_from(["<f4", "<f2", "|u1", "<f8", "<i8", "|O", "|S9", ">f4", "<c16", "<U2"])
    entries = st.one_of(
        st.sampled_from([0, 1, 255, 254, 127, 3, 1e30, -1e30, 6e4, float("nan"), float("inf"), 1e-40, -1]),
        st.integers(0, 255), st.floats(-10, 10),
    )  # fmt: skip
    described = paths_of(archive.meta)
    array_paths = st.sampled_from([p for p in described if p[0] == "arrays"] or described).map(list)
    setting_paths = st.sampled_from([p for p in described if p[0] != "arrays"] or described).map(list)
    paths = st.one_of(array_paths, setting_paths)
    content = st.one_of(
        st.tuples(st.just("set_value"), paths, values()),
        st.tuples(st.just("set_value"), setting_paths, values()),
        st.tuples(st.just("delete_value"), paths),
        st.tuples(st.just("scale_value"), paths, st.sampled_from([-1, 0, 0.5, 2, 1000, 1e30]),
                  st.sampled_from([-1, 0, 1, 0.5])),
        st.tuples(st.just("set_entries"), names, st.sampled_from(["all", "one", "row", "third"]), entries, seeds),
        st.tuples(st.just("random_entries"), names, seeds),
        st.tuples(st.just("resize"), names, st.integers(0, 4), small),
        st.tuples(st.just("false_header"), every, st.lists(sides, max_size=6), dtypes, st.booleans()),
        st.tuples(st.just("convert"), names, st.sampled_from(["float32", "float16", "uint8"])),
        st.tuples(st.just("exchange"), names, names),
        st.tuples(st.just("drop"), names, st.booleans()),
        st.tuples(st.just("rename"), names, other),
        st.tuples(st.just("add"), other, st.lists(st.integers(1, 4), min_size=1, max_size=5), st.booleans()),
        st.tuples(st.just("nested"), paths, st.sampled_from([2, 500, 100000])),
        st.tuples(st.just("duplicate"), every),
        st.tuples(st.just("method"), every, st.sampled_from([0, 8, 12, 14])),
        st.tuples(st.just("text"), st.sampled_from(["", "{", "[]", "null", "1", '{"format_version": 2}', "\ud800"])),
    ).map(list)  # fmt: skip
    # Fields of a member's header: flags, method, CRC, sizes, lengths of the name and of what follows
    fields = st.one_of(
        st.tuples(st.just("local"), st.integers(0, 9), st.sampled_from([4, 6, 8, 14, 18, 22, 26, 28])),
        st.tuples(st.just("central"), st.integers(0, 9), st.sampled_from([4, 8, 10, 16, 20, 24, 28, 30, 32, 38, 42])),
        st.tuples(st.just("end"), st.just(0), st.sampled_from([4, 8, 10, 12, 16, 20])),
    )
    record = st.builds(
        lambda where, size, value: ["set_record", *where, size, value],
        fields, st.sampled_from([1, 2, 4]), st.one_of(st.sampled_from([0, 1, 8, 12, 14, 99, 2**31, 2**32 - 1]), seeds),
    )  # fmt: skip
    return st.one_of(
        st.lists(content, min_size=1, max_size=3),
        st.lists(content, min_size=1, max_size=2),
        st.lists(record, min_size=1, max_size=2),
        st.tuples(content, record).map(list),
    )


def byte_recipes() -> st.SearchStrategy:
    """Recipes of changed, missing, repeated and additional bytes."""
    share = st.floats(0, 1, exclude_max=True)
    edits = st.lists(st.tuples(share, st.integers(0, 255)).map(list), min_size=1, max_size=6)
    step = st.one_of(
        st.tuples(st.just("set_bytes"), edits),
        st.tuples(st.just("cut"), share, share),
        st.tuples(st.just("cut"), share, st.just(1.0)),
        st.tuples(st.just("repeat"), share, share),
        st.tuples(st.just("insert"), share, st.binary(min_size=1, max_size=12).map(bytes.hex)),
    ).map(list)
    return st.lists(step, min_size=1, max_size=2)


def text_recipes() -> st.SearchStrategy:
    """Recipes of words of a text that are replaced, and of changed bytes."""
    token = st.one_of(
        st.sampled_from(["nan", "inf", "-1", "0", "1e308", "999999999", "99999999999999999999", "x", "\x1b[31m", "f",
                         "v", "end_header", "list", "float", "1/2/3", "-2147483648", "#", "1 2 3 4 5 6 7 8 9"]),
        numbers().map(str),
    )  # fmt: skip
    word = st.tuples(st.just("replace_text"), st.integers(0, 2000), token).map(list)
    return st.one_of(st.lists(word, min_size=1, max_size=3), byte_recipes())


def as_json(recipe: list) -> str:
    """Return a recipe as a line of JSON."""
    return json.dumps(recipe, ensure_ascii=True)
