"""Strategies of hypothesis for damaged copies of files: lies about sizes, counts, indices, ranges and types, and bytes.

A lie draws what it changes: lies of :data:`ARCHIVE_LIES` change the content of a table file or a checkpoint
(:class:`Archive`), :func:`lie_in_json` changes a value of JSON, those of :data:`BYTE_LIES` change any file.
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
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, Phase, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st
from hypothesis.configuration import set_hypothesis_home_dir

# Hypothesis keeps tables of constants beside the tests otherwise
set_hypothesis_home_dir(Path(tempfile.gettempdir()) / "hypothesis")

#: Number of mutants of a long run; of a default run, a hundredth.
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

SEEDS, SHARES = st.integers(0, 2**16), st.floats(0, 1, exclude_max=True)


def hostile(examples: int, seed: int = 0):
    """Return a decorator: always the same examples, or others by ``seed``, no limit of time, nothing is written."""
    decorator = settings(
        max_examples=examples, derandomize=not seed, deadline=None, database=None,
        suppress_health_check=list(HealthCheck), phases=(Phase.generate, Phase.shrink),
    )  # fmt: skip
    return (lambda test: seeded(seed)(decorator(test))) if seed else decorator


@dataclass
class Mutant:
    """Content of a damaged file, the arrays that nothing was done to (``None``: nor to the rest), and the lies."""

    data: bytes
    untouched: list[str] | None = None
    lies: list = field(default_factory=list)


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


def lie_in_json(draw, content, among=lambda path: True) -> tuple:
    """Replace, leave out or scale a value of JSON content, or nest lists there; return its path, () for none."""
    if not (places := [path for path in paths(content) if among(path)]):
        return ()
    *above, key = path = draw(st.sampled_from(places))
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
    return path


@st.composite
def json_mutants(draw, content) -> Mutant:
    """JSON content with one or two lies."""
    content = json.loads(json.dumps(content))
    lies = [lie_in_json(draw, content) for _ in range(draw(st.sampled_from((1, 1, 2))))]
    return Mutant(dump(content), lies=lies)


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

    ``raw`` replaces members by bytes, ``methods`` are their compression, and ``touched`` are the arrays that something
    was done to.
    """

    def __init__(self, data: bytes):
        with np.load(io.BytesIO(data)) as stored:
            self.arrays = {name: stored[name] for name in stored.files}
        self.meta = json.loads(self.arrays.pop("meta").tobytes())
        self.raw, self.methods, self.touched = {}, {}, set()

    def described(self) -> dict:
        """Return the descriptions of the arrays by name, {} if they have none that could be changed."""
        entries = self.meta.get("arrays") if isinstance(self.meta, dict) else None
        return entries if isinstance(entries, dict) and all(isinstance(e, dict) for e in entries.values()) else {}

    def members(self) -> dict[str, bytes]:
        """Return the content of the members by name."""
        meta = self.meta if isinstance(self.meta, bytes) else dump(self.meta)
        content = {"meta": npy(np.frombuffer(meta, np.uint8)), **{n: npy(a) for n, a in self.arrays.items()}}
        return content | self.raw

    def write(self) -> bytes:
        """Return the file."""
        stream, content = io.BytesIO(), self.members()
        with zipfile.ZipFile(stream, "w") as archive:
            for name in content:
                info = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
                archive.writestr(info, content[name], self.methods.get(name, zipfile.ZIP_DEFLATED), 6)
        return stream.getvalue()


def described_arrays(draw, archive: Archive) -> None:
    """Lie in the description of an array."""
    path = lie_in_json(draw, archive.meta, lambda path: path[0] == "arrays")
    archive.touched |= {path[1]} if len(path) > 1 else set(archive.arrays)


def described_settings(draw, archive: Archive) -> None:
    """Lie in the rest of the description."""
    lie_in_json(draw, archive.meta, lambda path: path[0] != "arrays")


def array_of(draw, archive: Archive) -> tuple[str, np.ndarray]:
    """Draw an array with entries (a checkpoint has numbers, too) that is about to be touched."""
    name = draw(st.sampled_from([n for n, a in archive.arrays.items() if a.ndim and a.size]))
    archive.touched.add(name)
    return name, archive.arrays[name]


def entries(draw, archive: Archive) -> None:
    """Replace all entries of an array, a row, one or a third of them by one number or by random ones."""
    name, array = array_of(draw, archive)
    rng, limits = np.random.default_rng(draw(SEEDS)), np.iinfo(array.dtype) if array.dtype.kind in "ui" else None
    numbers = [0, 1, 255, 254, 127, 3, 1e30, -1e30, 6e4, float("nan"), float("inf"), 1e-40, -1]
    number = draw(st.one_of(st.none(), st.sampled_from(numbers), st.integers(0, 255), st.floats(-10, 10)))
    if number is not None:
        values = np.full(array.shape, 0 if limits and number != number else number, float)
    elif limits:
        bits = archive.described().get(name, {}).get("bits", 8)
        values = rng.integers(0, 2 ** (bits if bits in range(1, 9) else 8), array.shape)
    else:
        values = rng.normal(0, 1, array.shape) * 10.0 ** rng.uniform(-8, 8, array.shape)
    values = np.clip(values, limits.min, limits.max) if limits else values
    row, one = (np.arange(n) == rng.integers(n) for n in (len(array), array.size))
    where = draw(st.sampled_from(("all", "one", "row", "third")))
    chosen = {"all": True, "one": one.reshape(array.shape), "third": rng.random(array.shape) < 1 / 3,
              "row": row.reshape(-1, *[1] * (array.ndim - 1))}[where]  # fmt: skip
    with np.errstate(all="ignore"):
        archive.arrays[name] = np.where(chosen, values.astype(array.dtype), array)


def size(draw, archive: Archive) -> None:
    """Give an axis of an array another number of entries, in the array and in its description."""
    name, array = array_of(draw, archive)
    entry = archive.described().get(name, {})
    shape, bits = entry.get("shape", list(array.shape)), entry.get("bits", 8)
    if not isinstance(shape, list) or not shape or not all(n in range(2**20) for n in shape):
        return
    shape = list(shape)
    shape[draw(st.integers(0, len(shape) - 1))] = draw(st.one_of(st.integers(0, 40), st.sampled_from([64, 127, 256])))
    count = int(np.prod(shape, dtype=float))
    if count * array.itemsize <= 1 << 26:
        archive.arrays[name] = np.resize(array, -(-count * bits // 8) if bits in range(1, 8) else shape)
        if entry:
            entry["shape"] = shape


def false_header(draw, archive: Archive) -> None:
    """Write another header before the entries of an array."""
    name = draw(st.sampled_from(["meta", *archive.arrays]))
    dtypes = ["<f4", "<f2", "|u1", "<f8", "<i8", "|O", "|S9", ">f4", "<c16", "<U2"]
    claimed = header(draw(st.lists(SIDES, max_size=6)), draw(st.sampled_from(dtypes)), draw(st.booleans()))
    archive.raw[name] = claimed + (archive.arrays[name].tobytes() if name in archive.arrays else b"{}")
    archive.touched.add(name)


ARCHIVE_LIES = (described_arrays, described_settings, entries, size, false_header)


def record(draw, data: bytes) -> bytes:
    """Change a number in a record of a zip archive: flags, method, check sum, sizes, or lengths of what follows."""
    mark, offsets = draw(st.sampled_from((
        (b"PK\x03\x04", (4, 6, 8, 14, 18, 22, 26, 28)),  # header of a member
        (b"PK\x01\x02", (4, 8, 10, 16, 20, 24, 28, 30, 32, 38, 42)),  # its entry in the directory
        (b"PK\x05\x06", (4, 8, 10, 12, 16, 20)),  # end of the directory
    )))  # fmt: skip
    if not (places := [m.start() for m in re.finditer(re.escape(mark), data)]):
        return data
    start = draw(st.sampled_from(places[:10])) + draw(st.sampled_from(offsets))
    width = draw(st.sampled_from([1, 2, 4]))
    value = draw(st.one_of(st.sampled_from([0, 1, 8, 12, 14, 99, 2**31, 2**32 - 1]), SEEDS))
    return data[:start] + (value % 256**width).to_bytes(width, "little") + data[start + width :]


@st.composite
def archive_mutants(draw, data: bytes) -> Mutant:
    """An archive with lies in its content, in its records, or in both."""
    number = draw(st.sampled_from((0, 1, 1, 2, 3)))
    archive, lies = Archive(data), draw(st.lists(st.sampled_from(ARCHIVE_LIES), min_size=number, max_size=number))
    names, untouched = sorted(archive.arrays), None
    for lie in lies:
        if isinstance(archive.meta, dict) and archive.arrays:
            lie(draw, archive)
            untouched = [name for name in names if name not in archive.touched]
    data = archive.write() if lies else data
    records = draw(st.integers(0 if lies else 1, 1 if lies else 2))
    for _ in range(records):
        data = record(draw, data)
    return Mutant(data, untouched, [lie.__name__ for lie in lies] + ["record"] * records)


# -- bytes and texts ---------------------------------------------------------------------------------------------------


def span(draw, data: bytes) -> tuple[int, int]:
    """Draw a part of a file, often up to its end."""
    first, last = sorted((draw(SHARES), draw(st.one_of(SHARES, st.just(1.0)))))
    return int(first * len(data)), int(last * len(data))


def other_bytes(draw, data: bytes) -> bytes:
    """Replace one to six bytes."""
    changed = bytearray(data)
    for _ in range(draw(st.integers(1, 6)) if data else 0):
        changed[int(draw(SHARES) * len(data))] = draw(st.integers(0, 255))
    return bytes(changed)


def cut(draw, data: bytes) -> bytes:
    """Take a part out of the file."""
    first, last = span(draw, data)
    return data[:first] + data[last:]


def repeated(draw, data: bytes) -> bytes:
    """Write a part of the file twice."""
    first, last = span(draw, data)
    return data[:last] + data[first:]


def inserted(draw, data: bytes) -> bytes:
    """Write further bytes into the file."""
    at = int(draw(SHARES) * len(data))
    return data[:at] + draw(st.binary(min_size=1, max_size=12)) + data[at:]


def other_word(draw, data: bytes) -> bytes:
    """Replace a word of a text."""
    tokens = ["nan", "inf", "-1", "0", "1e308", "999999999", "9" * 20, "x", "\x1b[31m", "f", "v", "end_header", "list",
              "float", "1/2/3", "-2147483648", "#", "1 2 3 4 5 6 7 8 9"]  # fmt: skip
    token = draw(st.one_of(st.sampled_from(tokens), st.integers().map(str), st.floats().map(str)))
    if not (words := list(re.finditer(rb"\S+", data))):
        return data
    word = words[draw(st.integers(0, 2000)) % len(words)]
    return data[: word.start()] + token.encode() + data[word.end() :]


BYTE_LIES = (other_bytes, cut, repeated, inserted)


@st.composite
def mutants(draw, data: bytes, lies=BYTE_LIES) -> Mutant:
    """Any file with one or two lies."""
    chosen = draw(st.lists(st.sampled_from(lies), min_size=1, max_size=2))
    for lie in chosen:
        data = lie(draw, data)
    return Mutant(data, lies=[lie.__name__ for lie in chosen])


def png(width: int, height: int, rows: bytes, colour: int = 2, depth: int = 8) -> bytes:
    """Return a PNG file that claims a size and holds ``rows``."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
