"""Memory that the content of a file may take: one rule for all readers.

A small file may claim a large content, and compression makes the claim true: one megabyte of deflate holds a gigabyte
of zeros. Readers therefore ask an :class:`Allowance` before they allocate anything whose size a file decides. The
content of a file may take :data:`FREE` bytes and :data:`FACTOR` times the size of the file, and never more than the
memory of the machine. The environment variable :data:`VARIABLE` raises the limit, as in ``MI_DIFFIND_MEMORY=4G``.

What a reader counts:

- arrays of an archive (:mod:`.archives`): their bytes, decompressed and with the bits of each entry unpacked;
- JSON: an upper bound of what Python's objects take (:func:`json_bytes`);
- entries of a table file: four bytes more each, since readers use them in single precision;
- pictures: the bytes of their pixels in the depth of the file, 1 to 4 bytes a channel, that is, what a decoder returns.
  Maps in single precision take up to four times as much, and all images of a capture together at most the memory of the
  machine;
- regions, blocks and nodes of a distance field, and nodes of a radiance field: the most memory that decoding them and
  building the field take at once, measured, a number of bytes for each.
"""

from __future__ import annotations

import os
from pathlib import Path

from . import units
from .errors import DiffindError, UsageError

#: Bytes that the content of any file may take, and bytes for each byte of the file beside these.
FREE, FACTOR = 64 * 2**20, 20

#: Environment variable with another limit, in bytes, such as ``4G``; limits below those of the rule change nothing.
VARIABLE = "MI_DIFFIND_MEMORY"

#: Characters of JSON → most bytes in memory for what each begins or separates: an object, a list, an entry, half of a
#: text, a value of an object.
_JSON_BYTES = {b"{": 240, b"[": 96, b",": 48, b'"': 40, b":": 100}


class LimitError(DiffindError, ValueError):
    """The content of a file would take more memory than it may; the message is one sentence that names the file."""


def allowed(file_bytes: int) -> int:
    """Return the bytes of memory that the content of a file of ``file_bytes`` may take.

    Raises :class:`.UsageError` if :data:`VARIABLE` is no number of bytes.
    """
    limit, given = FREE + FACTOR * file_bytes, os.environ.get(VARIABLE, "")
    if given:
        try:
            limit = max(limit, units.parse_bytes(given))
        except ValueError as e:
            raise UsageError(f"environment variable {VARIABLE}: {e}") from None
    return min(limit, units.memory())


def json_bytes(text: bytes) -> int:
    """Return a bound of the bytes of memory that the content of JSON ``text`` takes, without parsing it."""
    characters = 2 if text.isascii() else 8  # the whole text, and the texts within; Python has 1 to 4 bytes a character
    return characters * len(text) + sum(count * text.count(mark) for mark, count in _JSON_BYTES.items())


class Allowance:
    """Memory that the content of one file may take, and that part of it which is taken.

    ``path`` is the name of the file for messages, ``file_bytes`` its size (default: that of the file ``path``).
    """

    def __init__(self, path: str | os.PathLike, file_bytes: int | None = None):
        self.path = path
        self.file_bytes = Path(path).stat().st_size if file_bytes is None else file_bytes
        self.limit, self.taken = allowed(self.file_bytes), 0

    def check(self, nbytes: int, content: str) -> None:
        """Raise :class:`LimitError` if ``nbytes`` of memory for a ``content`` exceed what is left."""
        total = self.taken + nbytes
        if total <= self.limit:
            return
        if total > units.memory():
            advice = f"this machine has {units.memory():,}"
        else:
            gigabytes = 2 ** (-(-total // 2**30) - 1).bit_length()
            advice = f"the environment variable {VARIABLE}={gigabytes}G allows more"
        raise LimitError(
            f"{self.path}: {content} would take {total:,} bytes of memory, a file of {self.file_bytes:,} bytes may "
            f"take {self.limit:,}: {advice}"
        )

    def take(self, nbytes: int, content: str) -> None:
        """Take ``nbytes`` of memory for a ``content``. Raises :class:`LimitError` if they exceed what is left."""
        self.check(nbytes, content)
        self.taken += nbytes
