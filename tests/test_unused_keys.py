"""Keys that a reader does not use: which accesses count as a use, and the sentence."""

import json

import pytest

from mi_diffind.core.files import MOST_NAMES, RecordedKeys, unused_keys, unused_note

TEXT = '{"a": 1, "b": {"c": 2, "d": 3}, "e": [{"f": 4, "g": 5}, {"f": 6, "g": 7, "h": {"i": 8}}], "j": null}'


def content():
    return json.loads(TEXT, object_hook=RecordedKeys)


def test_keys_of_all_levels():
    assert unused_keys(content()) == ["a", "b", "e", "j"]
    read = content()
    assert read["a"] == 1 and read["b"].get("d") == 3 and read["e"][1]["h"].pop("i") == 8
    assert unused_keys(read) == ["b.c", "e.f", "e.g", "j"]
    assert read["e"][0]["f"] == 4 and "g" in read["e"][0]  # those of the second remain
    assert unused_keys(read) == ["b.c", "e.f", "e.g", "j"]
    for entry in read["e"]:
        assert dict(entry.items())
    assert unused_keys(read) == ["b.c", "j"]


@pytest.mark.parametrize("copy", [lambda d: {**d}, dict, list, len, sorted, lambda d: d == {}])
def test_copies_read_nothing(copy):
    read = content()
    copy(read)
    assert unused_keys(read) == ["a", "b", "e", "j"]


def test_the_sentence():
    read = content()
    assert list(read.values()) and all(read["b"].values())
    note = unused_note("folder/x.json", read, also=("k",))
    assert note == "x.json: keys that are not used: e.f, e.g, e.h, k"
    assert unused_note("x.json", RecordedKeys()) is None
    many = RecordedKeys({f"\x1b{i}": 0 for i in range(MOST_NAMES + 2)} | {"l" * 1000: 0})
    note = unused_note("x.json", many)
    assert note.endswith(" and 3 more") and "\x1b" not in note and "\\x1b0, \\x1b1, " in note
