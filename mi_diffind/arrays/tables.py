"""The table file: a ``.npz`` archive of one trained result (readable by ``numpy.load``, never pickled).

It contains one array for each table, ``float32``, ``float16`` or ``uint8`` entries of shape ``(N_1, …, N_d, c)``;
entries with fewer than 8 bits are packed one after the other (:func:`.lookup.pack_bits`). An array ``meta`` of UTF-8
bytes holds JSON with the format version, the task and its preset, for each array its shape, borders, storage form, and
(of bytes) affine map and bits, the training settings, the seed and the measurements. The same content gives the same
bytes.
"""

from __future__ import annotations

import io
import json
import math
import os
import zipfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..core.archives import Allowance, Archive, ArchiveError, LimitError
from ..core.errors import DiffindError, printable, raised_as, reason
from ..core.files import irregular, replacing, shown
from .indirection import DifferentiableArray, check_storage
from .lookup import BORDERS, STORAGES, gathers, pack_bits, pair_words, quantize, unpack_bits
from .pages import SIDE_BITS, PagedArray

#: Version of the format that is written. A file with another version is refused.
FORMAT_VERSION = 2

#: Largest file content that is written or accepted, in bytes. Small files may hold less: :mod:`.archives`.
MAX_BYTES = 2**30

#: Longest path of a file in the settings, in characters.
LONGEST_PATH = 4096

#: Entries of all channels that are dequantised at a time.
_ROWS = 2**16

#: Bytes of an entry in single precision, in which readers use it.
_SINGLE = 4

#: Storage form → type of the entries in a file.
_DTYPES = {"float32": np.dtype("<f4"), "float16": np.dtype("<f2"), "uint8": np.dtype("u1")}

#: End of the name of the array that holds the sizes of pages.
PAGES = "_pages"


class TableError(DiffindError, ValueError):
    """A table file cannot be used; the message is one sentence that names the file and the fault."""


@dataclass(frozen=True)
class StoredArray:
    """One array as a file holds it.

    ``entries`` have the shape ``(N_1, …, N_d, c)`` and the dtype of the ``storage`` form; ``border`` is one word an
    axis (default: ``"clamp"``). Bytes stand for ``offset + scale · byte``, one number a channel, and are stored with
    ``bits`` bits each, 1 to 8.
    """

    entries: np.ndarray
    border: tuple[str, ...] = ()
    scale: tuple[float, ...] = ()
    offset: tuple[float, ...] = ()
    bits: int = 8

    def __post_init__(self):
        if not self.border:
            object.__setattr__(self, "border", ("clamp",) * (self.entries.ndim - 1))

    @staticmethod
    def of(array: DifferentiableArray) -> StoredArray:
        """Return the stored form of an allocated array."""
        if array.storage == "uint8":
            return StoredArray(array.codes(), array.border, array.scale, array.offset, array.bits)
        return StoredArray(array.numpy().astype(_DTYPES[array.storage]), array.border)

    def allocate(self, dtype, storage: str = "", fold: bool = False) -> DifferentiableArray:
        """Return an array of the tensor type ``dtype`` with these entries, in a storage form ("": this one).

        ``fold``: float entries pass through the fold, so that an optimiser may leave the range.
        """
        form = self.to(storage or self.storage)
        return DifferentiableArray.from_numpy(form.entries, dtype, form.border, **form._held(fold))

    def _held(self, fold: bool) -> dict:
        """Return the arguments of :meth:`.DifferentiableArray.from_numpy` that say how the entries are held."""
        affine = (self.scale, self.offset) if self.storage == "uint8" else None
        fold = fold and self.storage == "float32"
        return {"storage": self.storage, "fold": fold, "quantization": affine, "bits": self.bits}

    def to(self, storage: str) -> StoredArray:
        """Return the array in another storage form; precision that bytes or halves have lost does not come back."""
        check_storage(storage)
        if storage == self.storage:
            return self
        values = self.values
        if storage != "uint8":
            return StoredArray(values.astype(_DTYPES[storage]), self.border)
        codes, scale, offset = quantize(values, values.shape[-1])
        return StoredArray(codes, self.border, tuple(scale.tolist()), tuple(offset.tolist()))

    @property
    def values(self) -> np.ndarray:
        """The entries as float32, dequantised if they are bytes."""
        if self.storage != "uint8":
            return self.entries.astype(np.float32)
        values, rows = np.empty(self.entries.shape, np.float32), self.entries.reshape(-1, self.entries.shape[-1])
        flat, offset, scale = values.reshape(rows.shape), np.asarray(self.offset), np.asarray(self.scale)
        for first in range(0, len(rows), _ROWS):  # double precision takes eight times the memory of the bytes
            part = slice(first, first + _ROWS)
            flat[part] = offset + scale * rows[part].astype(np.float64)
        return values

    @property
    def shape(self) -> tuple[int, ...]:
        """Entries along each axis, and channels."""
        return self.entries.shape

    @property
    def storage(self) -> str:
        """The storage form."""
        return next((s for s, dtype in _DTYPES.items() if self.entries.dtype == dtype), str(self.entries.dtype))

    @property
    def nbytes(self) -> int:
        """Bytes of the entries, as stored."""
        return math.ceil(self.entries.size * self.bits / 8) if self.bits < 8 else self.entries.nbytes

    @property
    def is_pointer(self) -> bool:
        """Whether all bytes stand for numbers in [0, 1]. Floats are folded when they are read."""
        steps = 2**self.bits - 1
        pairs = zip(self.scale, self.offset, strict=True)
        return all(o >= 0 and s >= 0 and o + steps * s <= 1 + 1e-6 for s, o in pairs)


def to_stored_arrays(name: str, array: DifferentiableArray) -> dict[str, StoredArray]:
    """Return the stored form of an allocated array by name.

    An array of pages gives two: its entries, and as ``NAME_pages`` the sizes of the pages, ``(A, …, d)``, with the
    borders.
    """
    if not isinstance(array, PagedArray):
        return {name: StoredArray.of(array)}
    ones, bits = (1.0,) * array.dims, SIDE_BITS[array.dims - 1]
    return {
        name: replace(StoredArray.of(array), border=("clamp",)),
        name + PAGES: StoredArray((array.sizes - 1).astype(np.uint8), array.border, ones, ones, bits),
    }


def move_paths(settings: dict, before: Path, after: Path) -> dict:
    """Return settings whose files (keys in ``_path``), relative to the folder ``before``, are relative to ``after``."""
    files = {key: value for key, value in settings.items() if key.endswith("_path")}
    return {**settings, **{key: os.path.relpath(before / value, after) for key, value in files.items()}}


def restored(table: Table, arrays: dict[str, DifferentiableArray], storage: str = "") -> Table:
    """Return a table whose ``arrays`` (by name, in single precision) were optimised, in a storage form.

    ``storage`` "" is the form of the table, with its bits. Other arrays, settings and the preset are kept; measurements
    are dropped, since they are no longer those of the arrays.
    """
    stored = dict(table.arrays)
    for name, array in arrays.items():
        before = table.arrays[name]
        form = storage or before.storage
        bits = before.bits if before.storage == "uint8" else 8
        if form == "uint8" and before.storage == "uint8" and before.is_pointer:
            stored |= to_stored_arrays(name, array.quantised(bits))
        elif form == "uint8":
            stored |= {name: StoredArray.of(array).to("uint8")}
        else:
            stored |= to_stored_arrays(name, array.to(form))
    return replace(table, arrays=stored, settings={**table.settings, "optimised": True}, measured={}, path=None)


def allocate_pages(
    entries: StoredArray, pages: StoredArray, dtype, shift=0.0, storage: str = "", fold: bool = False
) -> PagedArray:
    """Return the array of pages whose ``entries`` and sizes are stored (:func:`to_stored_arrays`).

    Other parameters are those of :meth:`.StoredArray.allocate`. Raises ``ValueError`` if the two arrays do not match.
    """
    form = entries.to(storage or entries.storage)
    sides = page_sides(pages)
    return PagedArray.from_numpy(form.entries, dtype, pages.border, sizes=sides, shift=shift, **form._held(fold))


def page_sides(pages: StoredArray) -> np.ndarray:
    """Return the sizes of pages. Raises ``ValueError`` for an array that holds none."""
    dims = pages.entries.ndim - 1
    ones = (1.0,) * dims
    if pages.shape[-1] != dims or pages.storage != "uint8" or (pages.scale, pages.offset) != (ones, ones):
        raise ValueError(f"an array of the shape {pages.shape} and type {pages.storage} holds no sizes of pages")
    return pages.entries.astype(np.int64) + 1


def read_gathers(table: Table, name: str) -> int:
    """Return the number of gather instructions of a read of an array of a table (of the sizes of pages: one)."""
    array = table.arrays[name]
    if name.endswith(PAGES) and name.removesuffix(PAGES) in table.arrays:
        return 1
    pages = table.arrays.get(name + PAGES)
    if pages is not None:
        channels, as_bytes = array.shape[-1], array.storage == "uint8"
        pair = pair_words(channels, array.bits) if as_bytes else 2 * gathers((), channels, array.storage)
        return pair * 2 ** (pages.entries.ndim - 2)
    return gathers(array.shape[:-1], array.shape[-1], array.storage, array.bits)


@dataclass
class Table:
    """Content of a table file.

    Named ``arrays``, the ``task`` and the ``preset`` that they belong to, the ``settings`` of the training and its
    ``seed``, and the ``measured`` figures (units in the names, e.g. ``psnr_db``). ``path`` is the file that it was read
    from, if any.
    """

    task: str
    arrays: dict[str, StoredArray]
    preset: str = ""
    settings: dict = field(default_factory=dict)
    seed: int = 0
    measured: dict[str, float] = field(default_factory=dict)
    path: Path | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of all entries, as stored."""
        return sum(array.nbytes for array in self.arrays.values())

    @property
    def storage(self) -> str:
        """Storage form of all arrays; several are joined with a "/", "" stands for no arrays."""
        return "/".join(dict.fromkeys(array.storage for array in self.arrays.values()))

    def to(self, storage: str) -> Table:
        """Return a copy with all arrays in another storage form."""
        return replace(self, arrays={name: array.to(storage) for name, array in self.arrays.items()})


def save_table(path: str | os.PathLike, table: Table) -> None:
    """Write ``table`` to ``path`` through a temporary file. Raises :class:`TableError` if it is inconsistent."""
    described = {}
    for name, array in table.arrays.items():
        if name == "meta" or not name.isprintable():
            raise TableError(f"{path}: an array cannot be called {name!r}")
        if array.storage not in STORAGES:
            raise TableError(f'{path}: array "{name}" has the type {array.storage}, allowed are {STORAGES}')
        _check(path, name, array)
        described[name] = {"shape": list(array.shape), "border": list(array.border), "storage": array.storage}
        if array.storage == "uint8":
            described[name] |= {"scale": list(array.scale), "offset": list(array.offset), "bits": array.bits}
    meta = {
        "format_version": FORMAT_VERSION, "task": table.task, "preset": table.preset, "arrays": described,
        "settings": table.settings, "seed": table.seed, "measured": table.measured,
    }  # fmt: skip
    try:
        text = np.frombuffer(json.dumps(meta, indent=1, allow_nan=False).encode(), dtype=np.uint8)
    except (ValueError, TypeError) as e:
        raise TableError(f"{path}: its settings, seed or measurements cannot be written ({reason(e)})") from None
    entries = {n: pack_bits(a.entries, a.bits) if a.bits < 8 else a.entries for n, a in table.arrays.items()}
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in {"meta": text, **entries}.items():
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
            # A fixed date: numpy.savez stamps the current one, and equal content would give unequal files.
            info = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            archive.writestr(info, buffer.getvalue(), zipfile.ZIP_DEFLATED, 9)


def load_table(path: str | os.PathLike, task: str | None = None, shapes: dict[str, tuple] | None = None) -> Table:
    """Read and check a table file.

    ``task`` and ``shapes`` (array name → shape, ``None`` in place of a free dimension) say what is expected. Raises
    :class:`TableError` with one sentence on anything else: a file that is missing, truncated or no archive, an
    unknown version, a missing, additional, misshapen or mistyped array, NaN or infinity, sizes beyond
    :data:`MAX_BYTES` or beyond what a file of this size may hold (:mod:`.archives`).
    """
    path = Path(path)
    if fault := irregular(path, 2 * MAX_BYTES):
        raise TableError(f"{shown(path)}: {fault}")
    try:
        with Archive(path) as archive:
            return _read(archive, path, task, shapes)
    except FileNotFoundError:
        raise TableError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise TableError(f"{path}: is a folder, a table file (.npz) is expected") from None
    except zipfile.BadZipFile as e:
        raise TableError(f"{path}: not a table file (.npz), or a truncated one ({reason(e)})") from None
    except TableError:
        raise
    except (ArchiveError, LimitError) as e:
        raise TableError(str(e)) from None
    except Exception as e:  # zipfile, zlib and numpy each have their own for a damaged file
        raise TableError(f"{path}: cannot be read ({reason(e)})") from None


def load_layout(path: str | os.PathLike, task: str, layouts: dict[str, dict[str, tuple]]) -> Table:
    """Read and check a table file whose setting ``layout`` names one of several sets of arrays.

    ``layouts`` maps a layout to its arrays: name → number of dimensions, and channels, or a tuple of those that are
    allowed. Raises :class:`TableError`.
    """
    table = load_table(path, task)
    layout = table.settings.get("layout")
    if not isinstance(layout, str) or layout not in layouts:
        raise TableError(f"{path}: has the layout {layout!r}, allowed are {', '.join(layouts)}")
    for name, (dims, channels) in layouts[layout].items():
        array, allowed = table.arrays.get(name), channels if isinstance(channels, tuple) else (channels,)
        if array is None or len(array.shape) != dims + 1 or array.shape[-1] not in allowed:
            fault = "is missing" if array is None else f"has the shape {array.shape}"
            raise TableError(
                f'{path}: the array "{name}" {fault}, expected {dims} dimension(s) and '
                f"{' or '.join(map(str, allowed))} channel(s)"
            )
    return table


def check_numbers(table: Table, name: str, count: int, positive: bool = False, whole: bool = False) -> None:
    """Raise :class:`TableError` unless a setting is ``count`` finite numbers (a list, if more than one)."""
    value = table.settings.get(name)
    values = [value] if count == 1 else value
    types = (int,) if whole else (int, float)
    valid = isinstance(values, list) and len(values) == count
    if not valid or not all(isinstance(v, types) and math.isfinite(v) and (v > 0 or not positive) for v in values):
        number = f"{'positive' if positive else 'finite'} {'whole ' if whole else ''}number"
        allowed = f"a {number}" if count == 1 else f"{count} {number}s"
        raise TableError(f'{table.path}: its setting "{name}" is {value!r}, expected {allowed}')


def check_allowance(table: Table, nbytes: int, content: str) -> None:
    """Raise :class:`TableError` if a file's arrays and ``nbytes`` for its ``content`` are more than it may take.

    The rule is that of :mod:`.archives`. Tables in memory have no limit.
    """
    if table.path is None:
        return
    stored = sum(array.entries.nbytes for array in table.arrays.values())
    with raised_as(TableError, LimitError):
        Allowance(table.path).check(stored + nbytes, content)


def byte_array(values: np.ndarray, scale: float = 1.0, offset: float = 0.0) -> StoredArray:
    """Return bytes ``(…, c)`` that stand for ``offset`` + ``scale`` · byte as an array of a file."""
    channels = values.shape[-1]
    return StoredArray(np.ascontiguousarray(values, np.uint8), (), (scale,) * channels, (offset,) * channels)


def _read(archive: Archive, path: Path, task, shapes) -> Table:
    members = set(archive.members)
    total = sum(info.file_size for info in archive.members.values())
    if total > MAX_BYTES:
        raise TableError(f"{path}: claims {total:,} bytes of content, at most {MAX_BYTES:,} are accepted")
    if "meta" not in members:
        raise TableError(f'{path}: has no "meta" array, it was not written by this package')
    members.remove("meta")
    table, described = _description(archive, path)
    if task is not None and table.task != task:
        raise TableError(f'{path}: holds tables for the task "{table.task}", expected "{task}"')
    expected = set(shapes) if shapes is not None else set(described)
    for name in sorted(expected - members):
        raise TableError(f'{path}: the array "{name}" is missing')
    for name in sorted(members - expected) + sorted(set(described) ^ members):
        raise TableError(f'{path}: has an unexpected array "{name}"')
    for name, entry in described.items():
        table.arrays[name] = _array(archive, path, name, entry, None if shapes is None else shapes[name])
    return table


def _description(archive: Archive, path: Path) -> tuple[Table, dict]:
    """Return the table of an archive without its arrays, and their descriptions."""
    try:
        meta = archive.json("meta")
        if "lr_scale" in meta:
            raise TableError(
                f"{path}: is the checkpoint of a training, the table file is what it writes at its end (-o)"
            )
        version, task = meta["format_version"], meta["task"]
        if version != FORMAT_VERSION:
            raise TableError(
                f"{path}: has the format version {version}, this package reads version {FORMAT_VERSION}: make it again "
                f"with mi-diffind fit {task if isinstance(task, str) else 'TASK'}"
            )
        preset, settings, seed, measured = (meta[key] for key in ("preset", "settings", "seed", "measured"))
        if not isinstance(settings, dict) or not isinstance(measured, dict):
            raise TypeError("the settings and the measurements have to be objects")
        if any(type(value) not in (int, float) for value in measured.values()):
            raise TypeError("the measurements have to be numbers")
        for key, value in settings.items():
            if key.endswith("_path") and not (isinstance(value, str) and 0 < len(value) <= LONGEST_PATH):
                raise TypeError(f'the setting "{key:.40}" has to be the path of a file')
        return Table(str(task), {}, str(preset), settings, seed, measured, path), dict(meta["arrays"].items())
    except (ArchiveError, LimitError, TableError):
        raise
    except (ValueError, TypeError, KeyError, AttributeError) as e:
        raise TableError(f'{path}: its "meta" array is damaged ({type(e).__name__}: {e})') from None


def _array(archive: Archive, path: Path, name: str, entry: dict, expected: tuple | None) -> StoredArray:
    """Return an array of an archive by its description; its shape is the ``expected`` one, if that is given."""
    scale, offset, bits = (), (), 8
    try:
        shape, border, storage = tuple(int(n) for n in entry["shape"]), tuple(entry["border"]), entry["storage"]
        if storage == "uint8":
            scale, offset = (tuple(float(v) for v in entry[k]) for k in ("scale", "offset"))
            bits = entry["bits"]
    except (ValueError, TypeError, KeyError, OverflowError) as e:
        raise TableError(f'{path}: the description of array "{name}" is damaged ({type(e).__name__}: {e})') from None
    if storage not in STORAGES:
        raise TableError(f'{path}: array "{name}" has the storage form "{storage}", allowed are {STORAGES}')
    wanted = shape if expected is None else expected
    if len(shape) != len(wanted) or any(w is not None and s != w for s, w in zip(shape, wanted, strict=True)):
        raise TableError(f'{path}: array "{name}" has the shape {shape}, expected {tuple(wanted)}')
    _check_form(path, name, shape, border, bits)
    count = math.prod(shape)
    entries = archive.array(name, _DTYPES[storage], shape if bits == 8 else (math.ceil(count * bits / 8),))
    archive.allowance.take(count * (_SINGLE + (bits < 8)), f'the array "{printable(name):.80}", {count:,} entries,')
    entries = entries if bits == 8 else unpack_bits(entries, count, bits).reshape(shape)
    array = StoredArray(entries, border, scale, offset, bits)
    _check(path, name, array)
    return array


def check_ranges(table: Table, ranges: dict[str, tuple[float, float]]) -> None:
    """Raise :class:`TableError` if entries lie outside of (low, high) by more than what storing as bytes rounds."""
    for name, (low, high) in ranges.items():
        values, slack = table.arrays[name].values, 1e-3 * (high - low)
        if values.min() < low - slack or values.max() > high + slack:
            raise TableError(
                f'{table.path}: entries of "{name}" lie in [{values.min():.4g}, {values.max():.4g}], '
                f"allowed is [{low:g}, {high:g}]"
            )


def _check(path, name: str, array: StoredArray) -> None:
    """Raise :class:`TableError` unless the array is one that a file may hold."""
    _check_form(path, name, array.shape, array.border, array.bits)
    fault = ""
    if array.storage != "uint8":
        if array.bits != 8 or array.scale or array.offset:
            fault = f"is stored as {array.storage}, only bytes have bits and a scale"
        elif not np.isfinite(array.entries).all():
            fault = "contains NaN or infinity"
    elif not all(len(v) == array.shape[-1] and all(map(math.isfinite, v)) for v in (array.scale, array.offset)):
        fault = "needs a finite scale and offset for each channel"
    elif array.bits < 8 and array.entries.max() >> array.bits:
        fault = f"has entries of more than {array.bits} bits"
    if fault:
        raise TableError(f'{path}: array "{name}" {fault}')


def _check_form(path, name: str, shape: tuple, border: tuple, bits) -> None:
    fault = ""
    if not 2 <= len(shape) <= 5 or min(shape) < 1:
        fault = f"the shape {shape}, expected 1 to 4 dimensions and channels"
    elif len(border) != len(shape) - 1 or any(b not in BORDERS for b in border):
        fault = f"the borders {border}, allowed are {BORDERS} for each axis"
    elif type(bits) is not int or not 1 <= bits <= 8:
        fault = f"{bits} bits an entry, allowed are 1 to 8"
    if fault:
        raise TableError(f'{path}: array "{name}" has {fault}')
