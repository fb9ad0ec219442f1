"""Keys of a JSON file that a reader does not use, for a note to the user.

A reader parses with ``json.loads(text, object_hook=RecordedKeys)``, takes what it needs, and then asks
:func:`unused_keys` or :func:`unused_note`::

    content = json.loads(text, object_hook=RecordedKeys)
    width = content["w"]
    note = unused_note(path, content)  # 'a.json: keys that are not used: h, frames.sharpness', or None
"""

from __future__ import annotations

from pathlib import Path

from .errors import printable

#: Names in a note, and characters of a name.
MOST_NAMES, LONGEST_NAME = 50, 40


class RecordedKeys(dict):
    """Dictionary that records the keys which are asked for, in the set ``read``.

    ``[]``, ``get``, ``pop`` and ``in`` record their key; ``items`` and ``values`` record all keys. Iteration, ``keys``,
    ``len``, copies and ``{**…}`` record none.
    """

    __slots__ = ("read",)

    def __init__(self, *content, **entries):
        super().__init__(*content, **entries)
        self.read: set | frozenset = frozenset()  # a set takes 216 bytes, and many objects may be in a file

    def _record(self, keys) -> None:
        if isinstance(self.read, frozenset):
            self.read = set()
        self.read.update(keys)

    def __getitem__(self, key):
        self._record((key,))
        return super().__getitem__(key)

    def __contains__(self, key) -> bool:
        self._record((key,))
        return super().__contains__(key)

    def get(self, key, default=None):
        self._record((key,))
        return super().get(key, default)

    def pop(self, key, *default):
        self._record((key,))
        return super().pop(key, *default)

    def items(self):
        self._record(self.keys())
        return super().items()

    def values(self):
        self._record(self.keys())
        return super().values()


def unused_keys(content) -> list[str]:
    """Return the keys that were not read, each once, in the order of the file.

    ``content`` is a :class:`RecordedKeys`, or lists and dictionaries that contain such. A key of an object inside
    another has the outer keys before it: ``frames.sharpness``. Objects that are not recorded count as read.
    """
    names: dict[str, None] = {}

    def visit(value, prefix: str) -> None:
        if isinstance(value, list):
            for entry in value:
                visit(entry, prefix)
        elif isinstance(value, dict):
            recorded = value.read if isinstance(value, RecordedKeys) else value.keys()
            for key, entry in dict.items(value):
                if key in recorded:
                    visit(entry, f"{prefix}{key}.")
                else:
                    names.setdefault(f"{prefix}{key}")

    visit(content, "")
    return list(names)


def unused_note(file: Path | str, content, also: tuple[str, ...] = ()) -> str | None:
    """Return a sentence with the keys of a ``file`` that were not read, see :func:`unused_keys`, or ``None``.

    ``also`` are further names, from places that are not JSON objects.
    """
    names = [*unused_keys(content), *also]
    if not names:
        return None
    listed = [printable(name if len(name) <= LONGEST_NAME else f"{name[:LONGEST_NAME]}…") for name in names]
    more = f" and {len(names) - MOST_NAMES:,} more" if len(names) > MOST_NAMES else ""
    return f"{Path(file).name}: keys that are not used: {', '.join(listed[:MOST_NAMES])}{more}"
