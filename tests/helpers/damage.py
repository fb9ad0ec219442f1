"""Strategies of hypothesis for damaged copies of files: lies about sizes, counts, indices, ranges and types, and bytes.

A lie draws what it changes: lies of :data:`ARCHIVE_LIES` change the content of a table file or a checkpoint
(:class:`Archive`), :func:`lie_in_json` changes a value of JSON, :func:`mutants` damages the bytes of any file.
"""

from __future__ import annotations

import io
import json
import os
import re
import struct
import tempfile
import zipfile
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.configuration import set_hypothesis_home_dir
from hypothesis.extra.numpy import from_dtype

# Hypothesis keeps tables of constants beside the tests otherwise
set_hypothesis_home_dir(Path(tempfile.gettempdir()) / "hypothesis")

#: Number of mutants of a long run.
MUTANTS = int(os.environ.get("MI_DIFFIND_MUTANTS", "2000"))

#: Numbers, texts and containers that a reader may not expect in place of another value.
VALUES = st.one_of(
    st.sampled_from([
        None, True, False, 0, -1, 1, 2, 3, 7, 8, 9, 16, 255, 256, 4096, 65535, 2**31 - 1, 2**31, 2**32, 2**53 + 1,
        2**63, 2**64, 10**30, -(2**63), 10**400, 0.5, -0.5, 1e-30, 1e-320, 1e30, 1e300, -1e300, float("nan"),
        float("inf"), float("-inf"), "", "x", "clamp", "repeat", "uint8", "float32", "\x1b[31m", "a\nb", "x" * 5000,
        "/dev/zero", "../" * 40, "\ud800", "é" * 300, [], [0], [[]], [[0, 1], [2]], [1e300] * 3, [-1] * 3, [0] * 3,
        [1] * 40, {}, {"a": 1}, {"x" * 300: {}},
    ]),
    st.integers(-300, 300), st.integers(), st.floats(), st.floats(-2, 2),
)  # fmt: skip

#: Sides that a header may claim.
SIDES = st.one_of(st.sampled_from([0, -1, 1, 2, 3, 5, 17, 255, 2**16, 2**31, 2**40, 2**63]), st.integers(0, 40))

SHARES = st.floats(0, 1, exclude_max=True)


def hostile(examples: int):
    """Return a decorator: always the same examples, no limit of time, nothing is written."""
    return settings(
        max_examples=examples, derandomize=True, deadline=None, database=None, report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck), phases=(Phase.generate,),
    )  # fmt: skip


class Mutant(NamedTuple):
    """Content of a damaged file, and the arrays nothing was done to (``None``: nor to the description)."""

    data: bytes
    untouched: list[str] | None = None


def span(draw, length: int) -> tuple[int, int]:
    """Draw a part of ``length`` entries: one, some, or all up to the end."""
    first = int(draw(SHARES) * length)
    count = draw(st.one_of(st.just(1), st.integers(1, max(length, 1)), st.just(length)))
    return first, min(first + count, length)


# -- JSON --------------------------------------------------------------------------------------------------------------


def dump(content) -> bytes:
    """Return JSON content as a file; a text ``@@nested N@@`` becomes N lists in lists."""
    text = json.dumps(content, indent=1)
    return re.sub(r'"@@nested (\d+)@@"', lambda m: "[" * int(m[1]) + "]" * int(m[1]), text).encode()


def paths(content, before: tuple = ()) -> list[tuple]:
    """Return the paths of all values of JSON content."""
    result = [before] if before else []
    entries = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in entries:
        result += paths(value, (*before, key))
    return result


def lie_in_json(draw, content, among=lambda path: True) -> None:
    """Replace, leave out or scale a value of JSON content, or nest lists there."""
    if not (places := [path for path in paths(content) if among(path)]):
        return
    *above, key = draw(st.sampled_from(places))
    for step in above:
        content = content[step]
    value, lie = content[key], draw(st.sampled_from(("set", "set", "set", "delete", "scale", "nest")))
    if lie == "delete":
        del content[key]
    elif lie == "nest":
        content[key] = f"@@nested {draw(st.sampled_from((2, 500, 100000)))}@@"
    elif lie == "scale" and isinstance(value, int | float) and not isinstance(value, bool):
        changed = value * draw(st.sampled_from((-1, 0, 0.5, 2, 1000, 1e30))) + draw(st.sampled_from((-1, 0, 1, 0.5)))
        content[key] = int(changed) if isinstance(value, int) and abs(changed) < 1e18 else changed
    else:
        content[key] = draw(VALUES)


@st.composite
def json_mutants(draw, content) -> Mutant:
    """JSON content with one or two lies."""
    content = json.loads(json.dumps(content))
    for _ in range(draw(st.integers(1, 2))):
        lie_in_json(draw, content)
    return Mutant(dump(content))


# -- archives ----------------------------------------------------------------------------------------------------------


def npy(array: np.ndarray) -> bytes:
    """Return an array as a ``.npy`` file."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.asarray(array, order="C"), version=(1, 0), allow_pickle=False)
    return stream.getvalue()


def header(shape: list, dtype: str, fortran: bool = False) -> bytes:
    """Return the header of a ``.npy`` file, which may claim anything."""
    sides = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
    text = f"{{'descr': '{dtype}', 'fortran_order': {fortran}, 'shape': ({sides}), }}".ljust(118) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


class Archive:
    """Arrays of an ``.npz`` file, the JSON in its ``meta``, and how they are written.

    ``raw`` replaces members by bytes, ``methods`` are their compression.
    """

    def __init__(self, data: bytes):
        with np.load(io.BytesIO(data)) as stored:
            self.arrays = {name: stored[name] for name in stored.files}
        self.meta = json.loads(self.arrays.pop("meta").tobytes())
        self.raw, self.methods = {}, {}

    def members(self) -> dict[str, bytes]:
        """Return the content of the members by name."""
        arrays = {"meta": np.frombuffer(dump(self.meta), np.uint8), **self.arrays}
        return {name: npy(array) for name, array in arrays.items()} | self.raw

    def stored(self, name: str) -> tuple:
        """Return the content of an array's member, and its description."""
        described = self.meta.get("arrays")
        return self.members()[name], described.get(name) if isinstance(described, dict) else None

    def write(self) -> bytes:
        """Return the file."""
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:
            for name, content in self.members().items():
                info = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
                archive.writestr(info, content, self.methods.get(name, zipfile.ZIP_DEFLATED), 6)
        return stream.getvalue()


def array_name(draw, archive: Archive) -> str:
    """Draw the name of an array (a checkpoint has numbers, too)."""
    return draw(st.sampled_from([name for name, array in archive.arrays.items() if array.ndim]))


def entries(draw, archive: Archive) -> None:
    """Replace a part of an array by one number or by random bytes, or bring it into another order."""
    name = array_name(draw, archive)
    array = archive.arrays[name] = archive.arrays[name].copy()
    part, rng = array.reshape(-1)[slice(*span(draw, array.size))], np.random.default_rng(draw(st.integers(0, 2**16)))
    lie = draw(st.sampled_from(("number", "bytes", "order")))
    if lie == "order":
        rng.shuffle(part)
    else:
        noise = rng.integers(0, 256, part.nbytes, np.uint8).view(part.dtype)
        part[:] = draw(from_dtype(part.dtype)) if lie == "number" else noise


def size(draw, archive: Archive) -> None:
    """Give an axis of an array another number of entries, in the array and in its description."""
    name = array_name(draw, archive)
    array, entry = archive.arrays[name], archive.meta.get("arrays", {}).get(name, {})
    shape, bits = list(entry.get("shape", array.shape)), entry.get("bits", 8)
    shape[draw(st.integers(0, len(shape) - 1))] = draw(st.one_of(st.integers(0, 40), st.sampled_from([64, 127, 256])))
    if (count := int(np.prod(shape))) <= 1 << 24:
        archive.arrays[name] = np.resize(array, -(-count * bits // 8) if bits < 8 else shape)
        entry["shape"] = shape


def description(draw, archive: Archive) -> None:
    """Lie in the description of the arrays, or in the rest of it."""
    of_arrays = draw(st.booleans())
    lie_in_json(draw, archive.meta, lambda path: (path[0] == "arrays") == of_arrays)


def false_header(draw, archive: Archive) -> None:
    """Write another header before the entries of an array."""
    name = draw(st.sampled_from(["meta", *archive.arrays]))
    dtypes = ["<f4", "<f2", "|u1", "<f8", "<i8", "|O", "|S9", ">f4", "<c16", "<U2"]
    claimed = header(draw(st.lists(SIDES, max_size=6)), draw(st.sampled_from(dtypes)), draw(st.booleans()))
    archive.raw[name] = claimed + (archive.arrays[name].tobytes() if name in archive.arrays else b"{}")


#: In the order in which they are told: later ones do not rely on what earlier ones leave.
ARCHIVE_LIES = (entries, size, description, false_header)


@st.composite
def archive_mutants(draw, data: bytes) -> Mutant:
    """An archive with lies in its content."""
    archive, before = Archive(data), Archive(data)
    for lie in sorted(draw(st.lists(st.sampled_from(ARCHIVE_LIES), min_size=1, max_size=3)), key=ARCHIVE_LIES.index):
        lie(draw, archive)
    untouched = [name for name in before.arrays if before.stored(name) == archive.stored(name)]
    return Mutant(archive.write(), untouched)


# -- bytes and texts ---------------------------------------------------------------------------------------------------


def other_bytes(draw, data: bytes) -> bytes:
    """Replace one to six bytes."""
    changed = bytearray(data)
    for _ in range(draw(st.integers(1, 6)) if data else 0):
        changed[int(draw(SHARES) * len(data))] = draw(st.integers(0, 255))
    return bytes(changed)


def other_part(draw, data: bytes) -> bytes:
    """Leave out a part of the file, write it twice, or further bytes before it."""
    first, last = span(draw, len(data))
    part = data[first:last]
    new = draw(st.one_of(st.just(b""), st.just(2 * part), st.binary(min_size=1, max_size=12).map(lambda b: b + part)))
    return data[:first] + new + data[last:]


def other_word(draw, data: bytes) -> bytes:
    """Replace a word of a text."""
    tokens = ["nan", "inf", "-1", "0", "1e308", "999999999", "9" * 20, "x", "\x1b[31m", "f", "v", "end_header", "list",
              "float", "1/2/3", "-2147483648", "#", "1 2 3 4 5 6 7 8 9"]  # fmt: skip
    token = draw(st.one_of(st.sampled_from(tokens), st.integers().map(str), st.floats().map(str)))
    if not (words := list(re.finditer(rb"\S+", data))):
        return data
    word = words[draw(st.integers(0, 2000)) % len(words)]
    return data[: word.start()] + token.encode() + data[word.end() :]


@st.composite
def mutants(draw, data: bytes, lies=(other_bytes, other_part)) -> Mutant:
    """Any file with one or two lies."""
    for lie in draw(st.lists(st.sampled_from(lies), min_size=1, max_size=2)):
        data = lie(draw, data)
    return Mutant(data)


def png(width: int, height: int, rows: bytes, colour: int = 2, depth: int = 8) -> bytes:
    """Return a PNG file that claims a size and holds ``rows``."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
