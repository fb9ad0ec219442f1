"""Reading of ``.npz`` archives whose content nobody has checked, and the memory that the content of a file may take.

Sizes in the headers of a ZIP archive are claims, and one megabyte of deflate holds a gigabyte of zeros. Members are
therefore decompressed piece by piece, and readers of any format ask an :class:`Allowance` before they allocate anything
whose size a file decides. The content of a file may take :data:`FREE` bytes and :data:`FACTOR` times the size of the
file, and never more than the memory of the machine; the environment variable :data:`VARIABLE` raises the limit.

Counted are the bytes of arrays, decompressed and with the bits of each entry unpacked, and four bytes more for each
entry of a table; of JSON a bound of what Python's objects take (:func:`json_bytes`); of pictures the bytes that a
decoder returns; of fields the most memory that decoding and building take at once.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
from pathlib import Path

import numpy as np

from . import units
from .errors import DiffindError, UsageError, raised_as, reason

#: Methods of compression that are read. Members in bz2 or lzma, which NumPy never writes, grow faster than deflate.
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)

#: Most digits of a whole number of JSON: larger ones are no floats.
LONGEST_NUMBER = 308

#: Bytes that are decompressed at a time.
PIECE = 2**20


class ArchiveError(DiffindError, ValueError):
    """An archive is damaged, or holds more than arrays; the message is one sentence that names the file."""


class Archive:
    """Arrays of a ``.npz`` archive, read one after the other within the ``allowance`` of the file.

    A context manager. Raises ``OSError`` and ``zipfile.BadZipFile`` as ``zipfile`` does, and :class:`ArchiveError` for
    members that are no arrays, of the same name, or compressed otherwise than by :data:`METHODS`.
    """

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        self.allowance = Allowance(self.path)
        self._zip = zipfile.ZipFile(self.path)
        try:
            self.members = self._members()
        except BaseException:
            self._zip.close()
            raise

    def __enter__(self) -> Archive:
        return self

    def __exit__(self, *exception) -> None:
        self._zip.close()

    def _members(self) -> dict[str, zipfile.ZipInfo]:
        members = {}
        for info in self._zip.infolist():
            if not info.filename.endswith(".npy") or not info.filename.isprintable():
                raise ArchiveError(f"{self.path}: contains {info.filename!r:.80}, which is not an array")
            name = info.filename[:-4]
            if name in members:
                raise ArchiveError(f'{self.path}: contains the array "{name:.80}" twice')
            if info.compress_type not in METHODS:
                method = zipfile.compressor_names.get(info.compress_type, info.compress_type)
                raise ArchiveError(
                    f'{self.path}: the array "{name:.80}" is compressed by {method}, allowed are deflate and none'
                )
            members[name] = info
        return members

    def array(self, name: str, dtype: np.dtype | None = None, shape: tuple | None = None) -> np.ndarray:
        """Return an array, of a given type and shape unless these are ``None``; it cannot be written.

        Its header is checked before memory is allocated. Raises :class:`ArchiveError` and :class:`LimitError`.
        """
        where = f'{self.path}: array "{name:.80}"'
        with self._zip.open(self.members[name]) as stream:
            try:
                if np.lib.format.read_magic(stream) != (1, 0):
                    raise ValueError("of a version other than 1.0")  # whose headers have no bounded size
                stored_shape, fortran, stored_dtype = np.lib.format.read_array_header_1_0(stream)
            except ValueError as e:
                raise ArchiveError(f"{where} has a damaged header ({reason(e)})") from None
            if dtype is not None and stored_dtype != dtype:
                raise ArchiveError(f"{where} has the type {stored_dtype}, expected {dtype}")
            if stored_dtype.kind not in "biuf" or min(stored_shape, default=0) < 0:
                raise ArchiveError(f"{where} has the type {stored_dtype!s:.80}, allowed are numbers")
            if fortran or (shape is not None and stored_shape != shape):
                raise ArchiveError(f"{where} has the shape {stored_shape}, expected {shape or 'rows'}")
            nbytes = math.prod(stored_shape) * stored_dtype.itemsize
            claimed = self.members[name].file_size
            if nbytes > claimed:
                raise ArchiveError(f"{where} claims {nbytes:,} bytes but the file holds {claimed:,}")
            self.allowance.take(nbytes, f'the array "{name:.80}"')
            data = np.empty(nbytes, np.uint8)
            count = 0
            while piece := stream.read(min(PIECE, nbytes - count)) if count < nbytes else b"":
                data[count : count + len(piece)] = np.frombuffer(piece, np.uint8)
                count += len(piece)
            rest = stream.read(1)  # at the end, the checksum is compared
        if count < nbytes or rest:
            raise ArchiveError(f"{where} holds {'more' if rest else f'{count:,} bytes'}, expected {nbytes:,} bytes")
        data.flags.writeable = False
        return data.view(stored_dtype).reshape(stored_shape)

    def json(self, name: str):
        """Return the content of an array of UTF-8 bytes that hold JSON.

        Raises ``ValueError`` for text that is no JSON, and the errors of :meth:`array`.
        """
        array, content = self.array(name, np.dtype("u1")), f'the array "{name:.80}"'
        self.allowance.take(array.size, content)
        text = array.tobytes()
        self.allowance.take(json_bytes(text), content)
        try:
            return json.loads(text, parse_int=_whole)
        except RecursionError:
            raise ValueError("too many lists within lists") from None


def _whole(digits: str) -> int:
    """Return a whole number of JSON. Raises ``ValueError`` for one of more digits than a float may have."""
    if len(digits) > LONGEST_NUMBER:
        raise ValueError(f"a whole number of {len(digits)} digits, at most {LONGEST_NUMBER} are read")
    return int(digits)


#: Bytes of memory that the content of any file may take.
FREE = 64 * 2**20

#: Bytes of memory for each byte of the file beside :data:`FREE`.
FACTOR = 20

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
        with raised_as(UsageError, ValueError, at=f"environment variable {VARIABLE}"):
            limit = max(limit, units.parse_bytes(given))
    return min(limit, units.memory())


def json_bytes(text: bytes) -> int:
    """Return a bound of the bytes of memory that the content of JSON ``text`` takes, without parsing it."""
    characters = 2 if text.isascii() else 8  # the whole text, and the texts within; Python has 1 to 4 bytes a character
    return characters * len(text) + sum(count * text.count(mark) for mark, count in _JSON_BYTES.items())


class Allowance:
    """Memory that the content of the file ``path`` may take, and that part of it which is taken."""

    def __init__(self, path: str | os.PathLike):
        self.path, self.file_bytes = path, Path(path).stat().st_size
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
