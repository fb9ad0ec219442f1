"""Damaged copies of files. A recipe of damage is data (JSON), so that a corpus can keep it.

A recipe is a list of steps, each ``[name, arguments…]``. Steps of an archive of arrays (:class:`Archive`) change its
content so that it stays an archive, then how it is written; steps of bytes change any file.
"""

from __future__ import annotations

import copy
import io
import json
import struct
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

SEEDS = Path(__file__).resolve().parents[1] / "trust" / "corpus" / "seeds"

#: Numbers, texts and containers that a reader may not expect in place of another value.
VALUES = (
    None, True, False, 0, -1, 1, 2, 3, 7, 8, 9, 16, 255, 256, 4096, 65535, 2**31 - 1, 2**31, 2**32, 2**53 + 1, 2**63,
    2**64, 10**30, -(2**63), 10**400, 0.5, -0.5, 1e-30, 1e-320, 1e30, 1e300, -1e300, float("nan"), float("inf"),
    float("-inf"), "", "x", "clamp", "repeat", "uint8", "float32", "\x1b[31m", "a\nb", "x" * 5000, "/dev/zero",
    "../" * 40, "\ud800", "é" * 300, [], [0], [[]], [[0, 1], [2]], [1e300] * 3, [-1] * 3, [0] * 3, [1] * 40, {},
    {"a": 1}, {"x" * 300: {}},
)  # fmt: skip

#: Shapes that an entry of a header or of a description may claim.
SIDES = (0, -1, 1, 2, 3, 5, 17, 255, 2**16, 2**31, 2**40, 2**63)


def npy(array: np.ndarray) -> bytes:
    """Return an array as a ``.npy`` file."""
    stream = io.BytesIO()
    np.lib.format.write_array(stream, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
    return stream.getvalue()


def header(shape: list, dtype: str, fortran: bool = False) -> bytes:
    """Return the header of a ``.npy`` file, which may claim anything."""
    sides = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
    text = f"{{'descr': '{dtype}', 'fortran_order': {fortran}, 'shape': ({sides}), }}"
    text = text.ljust(118) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@dataclass
class Archive:
    """Arrays of an ``.npz`` file, the JSON in its ``meta``, and how they are written."""

    arrays: dict[str, np.ndarray]
    meta: object
    raw: dict[str, bytes] = field(default_factory=dict)
    order: list[str] = field(default_factory=list)
    methods: dict[str, int] = field(default_factory=dict)
    touched: set[str] = field(default_factory=set)

    @staticmethod
    def read(path) -> Archive:
        """Read a file."""
        with np.load(path) as data:
            arrays = {name: data[name] for name in data.files}
        meta = json.loads(arrays.pop("meta").tobytes())
        return Archive(arrays, meta)

    def described(self, name: str) -> dict:
        """Return the description of an array, {} if it has none."""
        entries = self.meta.get("arrays", {}) if isinstance(self.meta, dict) else {}
        entry = entries.get(name, {}) if isinstance(entries, dict) else {}
        return entry if isinstance(entry, dict) else {}

    def members(self) -> list[tuple[str, bytes]]:
        """Return names and content of the members."""
        try:
            meta = self.meta if isinstance(self.meta, bytes) else json.dumps(self.meta, indent=1).encode()
        except ValueError:  # lone surrogates
            meta = b"{}"
        content = {"meta": npy(np.frombuffer(meta, np.uint8)), **{n: npy(a) for n, a in self.arrays.items()}}
        content |= self.raw
        return [(f"{name}.npy", content[name]) for name in [*content, *self.order] if name in content]

    def write(self) -> bytes:
        """Return the file."""
        import warnings

        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # members of one name
            for name, data in self.members():
                info = zipfile.ZipInfo(name.encode("utf-8", "replace").decode(), (1980, 1, 1, 0, 0, 0))
                archive.writestr(info, data, self.methods.get(name.removesuffix(".npy"), zipfile.ZIP_DEFLATED), 6)
        return stream.getvalue()


# -- steps of archives -------------------------------------------------------------------------------------------------


def place(root, path: list):
    """Return the container that a path of keys leads to, and the last key; ``None`` if there is none."""
    for key in path[:-1]:
        try:
            root = root[key]
        except (KeyError, IndexError, TypeError):
            return None, None
    return (root, path[-1]) if isinstance(root, (dict, list)) else (None, None)


def _touch(archive: Archive, path: list) -> None:
    if path[:1] == ["arrays"]:
        archive.touched |= {path[1]} if len(path) > 1 else set(archive.arrays)


def set_value(archive: Archive, path: list, value) -> None:
    """Put a value in the description."""
    container, key = place(archive.meta, path)
    if container is not None and (isinstance(container, dict) or (isinstance(key, int) and key < len(container))):
        container[key] = value
        _touch(archive, path)


def delete_value(archive: Archive, path: list) -> None:
    """Take a value out of the description."""
    container, key = place(archive.meta, path)
    in_list = isinstance(container, list) and isinstance(key, int) and key < len(container)
    if in_list or (isinstance(container, dict) and key in container):
        del container[key]
        _touch(archive, path)


def scale_value(archive: Archive, path: list, factor: float, addend: float) -> None:
    """Multiply a number of the description, and add to it."""
    container, key = place(archive.meta, path)
    try:
        value = container[key]
    except (KeyError, IndexError, TypeError):
        return
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        changed = value * factor + addend
        container[key] = int(changed) if isinstance(value, int) and abs(changed) < 1e18 else changed
        _touch(archive, path)


def set_entries(archive: Archive, name: str, where: str, value: float, seed: int) -> None:
    """Replace all entries of an array (``all``), one of them (``one``), a row or a third (``third``)."""
    array = np.array(archive.arrays[name])
    if not array.size:
        return
    rng = np.random.default_rng(seed)
    chosen = np.zeros(array.shape, bool)
    if where == "all":
        chosen[...] = True
    elif where == "row":
        chosen[rng.integers(len(array))] = True
    elif where == "one":
        chosen.reshape(-1)[rng.integers(array.size)] = True
    else:
        chosen = rng.random(array.shape) < 1 / 3
    with np.errstate(all="ignore"):
        if array.dtype.kind in "ui":
            value = 0 if value != value else min(max(value, 0), np.iinfo(array.dtype).max)
        array[chosen] = value
    archive.arrays[name] = array
    archive.touched.add(name)


def random_entries(archive: Archive, name: str, seed: int) -> None:
    """Replace all entries of an array by random bytes, or by random numbers of all magnitudes."""
    rng, array = np.random.default_rng(seed), archive.arrays[name]
    if array.dtype.kind == "f":
        values = rng.normal(0, 1, array.shape) * 10.0 ** rng.uniform(-8, 8, array.shape)
        with np.errstate(all="ignore"):
            archive.arrays[name] = np.nan_to_num(values.astype(array.dtype))
    else:
        limit = 2 ** archive.described(name).get("bits", 8) if array.ndim > 1 else 256
        limit = limit if isinstance(limit, int) and 1 < limit <= 256 else 256
        archive.arrays[name] = rng.integers(0, limit, array.shape).astype(array.dtype)
    archive.touched.add(name)


def resize(archive: Archive, name: str, axis: int, side: int) -> None:
    """Give an axis of an array another number of entries, in the array and in its description."""
    array, described = archive.arrays[name], archive.described(name)
    shape = list(described.get("shape", array.shape))
    if not all(isinstance(n, int) and 0 <= n < 2**20 for n in shape) or not shape:
        return
    axis %= len(shape)
    shape[axis] = max(0, side)
    bits = described.get("bits", 8)
    count = int(np.prod(shape, dtype=np.float64))
    if count * array.itemsize > 1 << 26 or not array.size:
        return
    if isinstance(bits, int) and 0 < bits < 8:
        archive.arrays[name] = np.resize(array, -(-count * bits // 8))
    elif list(array.shape) == list(described.get("shape", array.shape)):
        index = [np.arange(n) % max(1, m) for n, m in zip(shape, array.shape, strict=True)]
        archive.arrays[name] = array[np.ix_(*index)]
    if described:
        described["shape"] = shape
    archive.touched.add(name)


def false_header(archive: Archive, name: str, shape: list, dtype: str, fortran: bool) -> None:
    """Write another header before the entries of an array."""
    data = archive.arrays[name].tobytes() if name in archive.arrays else b"{}"
    archive.raw[name] = header(shape, dtype, fortran) + data
    archive.touched.add(name)


def convert(archive: Archive, name: str, dtype: str) -> None:
    """Write the entries of an array as another type, and describe them so."""
    with np.errstate(all="ignore"):
        archive.arrays[name] = archive.arrays[name].astype(dtype)
    described = archive.described(name)
    described["storage"] = dtype
    if dtype == "uint8" and described:
        channels = archive.arrays[name].shape[-1]
        described |= {"scale": [1 / 255] * channels, "offset": [0.0] * channels, "bits": 8}
    archive.touched.add(name)


def exchange(archive: Archive, first: str, second: str) -> None:
    """Exchange the entries of two arrays, with their descriptions."""
    arrays, described = archive.arrays, archive.meta.get("arrays") if isinstance(archive.meta, dict) else None
    if first in arrays and second in arrays:
        arrays[first], arrays[second] = arrays[second], arrays[first]
        if isinstance(described, dict) and first in described and second in described:
            described[first], described[second] = described[second], described[first]
        archive.touched |= {first, second}


def drop(archive: Archive, name: str, described: bool) -> None:
    """Leave an array out; ``described``: its description, too."""
    archive.arrays.pop(name, None)
    if described and isinstance(archive.meta, dict) and isinstance(archive.meta.get("arrays"), dict):
        archive.meta["arrays"].pop(name, None)
    archive.touched.add(name)


def rename(archive: Archive, name: str, other: str) -> None:
    """Give an array another name, in the archive and in the description."""
    if name in archive.arrays:
        archive.arrays = {other if n == name else n: a for n, a in archive.arrays.items()}
        entries = archive.meta.get("arrays") if isinstance(archive.meta, dict) else None
        if isinstance(entries, dict) and name in entries:
            archive.meta["arrays"] = {other if n == name else n: e for n, e in entries.items()}
        archive.touched |= {name, other}


def add(archive: Archive, name: str, shape: list, described: bool) -> None:
    """Add an array of zeros."""
    archive.arrays[name] = np.zeros(shape, np.float32)
    if described and isinstance(archive.meta, dict) and isinstance(archive.meta.get("arrays"), dict):
        border = ["clamp"] * (len(shape) - 1)
        archive.meta["arrays"][name] = {"shape": shape, "border": border, "storage": "float32"}
    archive.touched.add(name)


def duplicate(archive: Archive, name: str) -> None:
    """Write a member twice."""
    if name == "meta" or name in archive.arrays:
        archive.order.append(name)


def method(archive: Archive, name: str, number: int) -> None:
    """Compress a member by another method: 0 stored, 8 deflate, 12 bzip2, 14 LZMA."""
    archive.methods[name] = number


def text(archive: Archive, content: str) -> None:
    """Replace the description by a text."""
    archive.meta = content.encode("utf-8", "replace")
    archive.touched |= set(archive.arrays)


def nested(archive: Archive, path: list, depth: int) -> None:
    """Put lists in lists in the description."""
    marker = "@@nested@@"
    set_value(archive, path, marker)
    try:
        whole = json.dumps(archive.meta)
    except (TypeError, ValueError):
        return
    archive.meta = whole.replace(f'"{marker}"', "[" * depth + "]" * depth).encode()


STEPS = {
    f.__name__: f
    for f in (
        set_value, delete_value, scale_value, set_entries, random_entries, resize, false_header, convert, exchange,
        drop, rename, add, duplicate, method, text, nested,
    )
}  # fmt: skip


# -- steps of bytes ----------------------------------------------------------------------------------------------------


def set_bytes(data: bytes, edits: list) -> bytes:
    """Replace bytes: pairs of a share of the file's length and a value."""
    changed = bytearray(data)
    for share, value in edits if data else ():
        changed[min(len(data) - 1, int(share * len(data)))] = value
    return bytes(changed)


def cut(data: bytes, first: float, last: float) -> bytes:
    """Take a part out of the file, between two shares of its length."""
    first, last = sorted((int(first * len(data)), int(last * len(data))))
    return data[:first] + data[last:]


def repeat(data: bytes, first: float, last: float) -> bytes:
    """Write a part of the file twice."""
    first, last = sorted((int(first * len(data)), int(last * len(data))))
    return data[:last] + data[first:]


def insert(data: bytes, at: float, hexadecimal: str) -> bytes:
    """Write bytes into the file."""
    at = int(at * len(data))
    return data[:at] + bytes.fromhex(hexadecimal) + data[at:]


def set_record(data: bytes, signature: str, number: int, offset: int, size: int, value: int) -> bytes:
    """Change a number in the ``number``-th record of a zip archive, such as a declared size.

    ``signature`` is ``local`` (a member's header), ``central`` (its entry in the directory) or ``end``.
    """
    mark = {"local": b"PK\x03\x04", "central": b"PK\x01\x02", "end": b"PK\x05\x06"}[signature]
    places = [i for i in range(len(data) - 3) if data[i : i + 4] == mark]
    if not places:
        return data
    start = places[number % len(places)] + offset
    return data[:start] + (value % 256**size).to_bytes(size, "little") + data[start + size :]


def replace_text(data: bytes, number: int, token: str) -> bytes:
    """Replace a word of a text."""
    import re

    words = list(re.finditer(rb"\S+", data))
    if not words:
        return data
    word = words[number % len(words)]
    return data[: word.start()] + token.encode("utf-8", "replace") + data[word.end() :]


BYTE_STEPS = {f.__name__: f for f in (set_bytes, cut, repeat, insert, set_record, replace_text)}


# -- JSON --------------------------------------------------------------------------------------------------------------


def json_steps(content, recipe: list) -> object:
    """Return JSON content after steps of a description, whose paths begin at its root."""
    archive = Archive({}, copy.deepcopy(content))
    for name, *arguments in map(copy.deepcopy, recipe):  # steps may write into a value that they share
        STEPS[name](archive, *arguments)
    return archive.meta


def damaged(data: bytes, recipe: list) -> tuple[bytes, list[str] | None]:
    """Return a damaged copy of an archive, and the arrays that nothing was done to.

    ``None`` in place of them: nothing was done to the description, either.
    """
    structured = [copy.deepcopy(step) for step in recipe if step[0] in STEPS]
    untouched = None
    if structured:
        archive = Archive.read(io.BytesIO(data))
        names = set(archive.arrays)
        for name, *arguments in structured:
            of_entries = name in ("set_entries", "random_entries", "resize", "convert")
            if of_entries and not np.ndim(archive.arrays.get(arguments[0], 0)):  # numbers of a checkpoint have none
                continue
            STEPS[name](archive, *arguments)
        data = archive.write()
        if any(step[0] not in ("duplicate", "method") for step in structured):
            untouched = sorted(names - archive.touched)
    for name, *arguments in recipe:
        if name in BYTE_STEPS:
            data = BYTE_STEPS[name](data, *arguments)
    return data, untouched


def damaged_bytes(data: bytes, recipe: list) -> bytes:
    """Return a damaged copy of any file."""
    for name, *arguments in recipe:
        data = BYTE_STEPS[name](data, *arguments)
    return data


def png(width: int, height: int, rows: bytes, colour: int = 2, depth: int = 8) -> bytes:
    """Return a PNG file that claims a size and holds ``rows``."""

    def chunk(name: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(name + content))
        return struct.pack(">I", len(content)) + name + content + check

    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")
