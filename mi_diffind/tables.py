"""
The file that holds one trained thing: a ``.npz`` archive (readable by ``numpy.load``, never pickled).

It contains one array for each table, ``float32``, ``float16`` or ``uint8`` entries of shape ``(N_1, …, N_d, c)``, or,
of entries with fewer than 8 bits, their bits one after the other (:func:`.lookup.pack_bits`), and an array ``meta`` of
UTF-8 bytes: JSON with the format version, the task, the storage form, each array's shape, borders
and (for bytes) affine map, the training settings, the seed and the measured quality. The same content gives the same
bytes.
"""

from __future__ import annotations

import io
import json
import math
import os
import textwrap
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .files import replacing
from .lookup import BORDERS, STORAGES, pack_bits, unpack_bits

#: Version of the format that is written. A file with another version is refused.
FORMAT_VERSION = 1

#: Largest file content that is accepted, in bytes: a header that claims more is refused before anything is allocated.
MAX_BYTES = 2**30

_DTYPES = {"float32": np.dtype("<f4"), "float16": np.dtype("<f2"), "uint8": np.dtype("u1")}


class TableError(ValueError):
    """A table file cannot be used; the message is one sentence that names the file and the fault."""


@dataclass
class Table:
    """
    What a table file holds.

    ``arrays`` maps names to entries of shape ``(N_1, …, N_d, c)`` in the dtype of ``storage``; ``borders`` gives each
    array's borders, ``quantization`` its ``(scale, offset)`` (one number a channel) if ``storage`` is ``"uint8"``.
    ``bits`` says of which arrays of bytes fewer than 8 bits an entry are stored, 1 to 7.
    ``settings`` are those of the training, ``quality`` what was measured (units in the names, e.g. ``psnr_db``).
    """

    task: str
    arrays: dict[str, np.ndarray]
    storage: str = "float32"
    borders: dict[str, tuple[str, ...]] = field(default_factory=dict)
    quantization: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = field(default_factory=dict)
    settings: dict = field(default_factory=dict)
    seed: int = 0
    quality: dict[str, float] = field(default_factory=dict)
    bits: dict[str, int] = field(default_factory=dict)

    @property
    def nbytes(self) -> int:
        """Bytes of all entries."""
        return sum(map(self.nbytes_of, self.arrays))

    def nbytes_of(self, name: str) -> int:
        """Bytes of the entries of one array, as stored."""
        array = self.arrays[name]
        return math.ceil(array.size * self.bits[name] / 8) if name in self.bits else array.nbytes

    def to(self, storage: str) -> Table:
        """A copy in another storage form; from ``"uint8"`` or ``"float16"`` nothing that was lost comes back."""
        from .lookup import quantize

        if storage not in STORAGES:
            raise ValueError(f'storage: found "{storage}", allowed are {STORAGES}')
        if storage == self.storage:
            return self
        arrays, quantization = {}, {}
        for name in self.arrays:
            values = self.values(name)
            if storage == "uint8":
                codes, scale, offset = quantize(values, values.shape[-1])
                arrays[name], quantization[name] = codes, (tuple(scale.tolist()), tuple(offset.tolist()))
            else:
                arrays[name] = values.astype(_DTYPES[storage])
        return Table(
            self.task,
            arrays,
            storage,
            self.borders,
            quantization,
            self.settings,
            self.seed,
            dict(self.quality),
        )

    def values(self, name: str) -> np.ndarray:
        """The entries of one array as float32, dequantised if they are bytes."""
        array = self.arrays[name]
        if self.storage != "uint8":
            return array.astype(np.float32)
        scale, offset = self.quantization[name]
        return (np.asarray(offset) + np.asarray(scale) * array.astype(np.float64)).astype(np.float32)


def save_table(path: str | os.PathLike, table: Table) -> None:
    """Write ``table`` to ``path`` through a temporary file. Raises :class:`TableError` if it is inconsistent."""
    dtype = _DTYPES.get(table.storage)
    if dtype is None:
        raise TableError(f'{path}: storage "{table.storage}" is unknown, allowed are {STORAGES}')
    described = {}
    for name, array in table.arrays.items():
        if name == "meta" or not name.isprintable():
            raise TableError(f"{path}: an array cannot be called {name!r}")
        if array.dtype != dtype:
            raise TableError(
                f'{path}: array "{name}" has the type {array.dtype}, storage "{table.storage}" needs {dtype}'
            )
        if dtype.kind == "f" and not np.isfinite(array).all():
            raise TableError(f'{path}: array "{name}" contains NaN or infinity')
        border = tuple(table.borders.get(name, ("clamp",) * (array.ndim - 1)))
        _check_shape(path, name, array.shape, border)
        described[name] = {"shape": list(array.shape), "border": list(border)}
        if table.storage == "uint8":
            scale, offset = table.quantization.get(name, ((), ()))
            _check_affine(path, name, array.shape, scale, offset)
            described[name] |= {"scale": list(scale), "offset": list(offset)}
        if name in table.bits:
            described[name]["bits"] = _check_bits(path, name, table.bits[name], table.storage)
            if array.max() >> table.bits[name]:
                raise TableError(f'{path}: array "{name}" has entries of more than {table.bits[name]} bits')
    meta = {
        "format_version": FORMAT_VERSION,
        "task": table.task,
        "storage": table.storage,
        "arrays": described,
        "settings": table.settings,
        "seed": table.seed,
        "quality": table.quality,
    }
    try:
        text = np.frombuffer(json.dumps(meta, indent=1, allow_nan=False).encode(), dtype=np.uint8)
    except (ValueError, TypeError) as e:
        raise TableError(f"{path}: its settings, seed or quality cannot be written ({_reason(e)})") from None
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in {"meta": text, **table.arrays}.items():
            buffer = io.BytesIO()
            if name in table.bits:
                array = pack_bits(array, table.bits[name])
            np.lib.format.write_array(buffer, np.ascontiguousarray(array), version=(1, 0), allow_pickle=False)
            # A fixed date: numpy.savez stamps the current one, and equal content would give unequal files.
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)), buffer.getvalue())


def load_table(path: str | os.PathLike, task: str | None = None, shapes: dict[str, tuple] | None = None) -> Table:
    """
    Read and check a table file.

    ``task`` and ``shapes`` (array name → shape, ``None`` in place of a free dimension) say what is expected. Raises
    :class:`TableError` with one sentence on anything else: a file that is missing, truncated or no archive, an
    unknown version, a missing, additional, misshapen or mistyped array, NaN or infinity, sizes beyond
    :data:`MAX_BYTES`.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            return _read(archive, path, task, shapes)
    except FileNotFoundError:
        raise TableError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise TableError(f"{path}: is a folder, a table file (.npz) is expected") from None
    except zipfile.BadZipFile as e:
        raise TableError(f"{path}: not a table file (.npz), or a truncated one ({_reason(e)})") from None
    except TableError:
        raise
    except Exception as e:  # zipfile, zlib, lzma and numpy each have their own for a damaged file
        raise TableError(f"{path}: cannot be read ({_reason(e)})") from None


def _reason(e: Exception) -> str:
    """What ``e`` says, on one line and no longer than one."""
    return textwrap.shorten(str(e), 100, placeholder="…") or type(e).__name__


def _read(archive: zipfile.ZipFile, path: Path, task, shapes) -> Table:
    members = {}
    total = 0
    for info in archive.infolist():
        if not info.filename.endswith(".npy") or not info.filename.isprintable():
            raise TableError(f"{path}: contains {info.filename!r}, which is not an array")
        if info.filename[:-4] in members:
            raise TableError(f'{path}: contains the array "{info.filename[:-4]}" twice')
        members[info.filename[:-4]] = info
        total += info.file_size
    if total > MAX_BYTES:
        raise TableError(f"{path}: claims {total:,} bytes of content, at most {MAX_BYTES:,} are accepted")
    if "meta" not in members:
        raise TableError(f'{path}: has no "meta" array, it was not written by this package')

    raw = _array(archive, members.pop("meta"), path, "meta", np.dtype("u1"), None)
    try:
        meta = json.loads(raw.tobytes())
        if "lr_scale" in meta:
            raise TableError(
                f"{path}: is the checkpoint of a training, the table file is what it writes at its end (-o)"
            )
        version, stored_task, storage = meta["format_version"], meta["task"], meta["storage"]
        described = {name: entry for name, entry in meta["arrays"].items()}
        settings, seed, quality = meta["settings"], meta["seed"], meta["quality"]
        if not isinstance(settings, dict) or not isinstance(quality, dict):
            raise TypeError("the settings and the quality have to be objects")
    except (ValueError, TypeError, KeyError, AttributeError) as e:
        raise TableError(f'{path}: its "meta" array is damaged ({type(e).__name__}: {e})') from None
    if version != FORMAT_VERSION:
        raise TableError(f"{path}: has the format version {version}, this package reads version {FORMAT_VERSION}")
    if storage not in STORAGES:
        raise TableError(f'{path}: has the storage form "{storage}", allowed are {STORAGES}')
    if task is not None and stored_task != task:
        raise TableError(f'{path}: holds tables for the task "{stored_task}", expected "{task}"')

    expected = set(shapes) if shapes is not None else set(described)
    for name in sorted(expected - set(members)):
        raise TableError(f'{path}: the array "{name}" is missing')
    for name in sorted(set(members) - expected) + sorted(set(described) ^ set(members)):
        raise TableError(f'{path}: has an unexpected array "{name}"')

    table = Table(str(stored_task), {}, storage, settings=settings, seed=seed, quality=quality)
    for name in described:
        entry = described[name]
        try:
            shape = tuple(int(n) for n in entry["shape"])
            border = tuple(entry["border"])
            affine = [tuple(float(v) for v in entry[k]) for k in ("scale", "offset")] if storage == "uint8" else None
        except (ValueError, TypeError, KeyError, OverflowError) as e:
            raise TableError(
                f'{path}: the description of array "{name}" is damaged ({type(e).__name__}: {e})'
            ) from None
        bits = entry.get("bits")
        if bits is not None:
            table.bits[name] = _check_bits(path, name, bits, storage)
        wanted = shapes[name] if shapes is not None else shape
        if len(shape) != len(wanted) or any(w is not None and s != w for s, w in zip(shape, wanted, strict=True)):
            raise TableError(f'{path}: array "{name}" has the shape {shape}, expected {tuple(wanted)}')
        _check_shape(path, name, shape, border)
        stored = shape if bits is None else (math.ceil(math.prod(shape) * bits / 8),)
        array = _array(archive, members[name], path, name, _DTYPES[storage], stored)
        if bits is not None:
            array = unpack_bits(array, math.prod(shape), bits).reshape(shape)
        if affine is not None:
            _check_affine(path, name, shape, *affine)
            table.quantization[name] = (affine[0], affine[1])
        elif not np.isfinite(array).all():
            raise TableError(f'{path}: array "{name}" contains NaN or infinity')
        table.arrays[name] = array
        table.borders[name] = border
    return table


def _check_shape(path, name: str, shape: tuple, border: tuple) -> None:
    if not 2 <= len(shape) <= 5 or min(shape) < 1:
        raise TableError(f'{path}: array "{name}" has the shape {shape}, expected 1 to 4 dimensions and channels')
    if len(border) != len(shape) - 1 or any(b not in BORDERS for b in border):
        raise TableError(f'{path}: array "{name}" has the borders {border}, allowed are {BORDERS} for each axis')


def _check_bits(path, name: str, bits, storage: str) -> int:
    if storage != "uint8" or type(bits) is not int or not 1 <= bits <= 7:
        raise TableError(f'{path}: array "{name}" has {bits} bits an entry, allowed are 1 to 7, and of bytes only')
    return bits


def _check_affine(path, name: str, shape: tuple, scale: tuple, offset: tuple) -> None:
    if any(len(v) != shape[-1] or not all(map(math.isfinite, v)) for v in (scale, offset)):
        raise TableError(f'{path}: array "{name}" needs a finite scale and offset for each channel')


def _array(archive, info, path, name: str, dtype: np.dtype, shape: tuple | None) -> np.ndarray:
    """One member of the archive; its header is checked against the claimed size before anything is allocated."""
    with archive.open(info) as stream:
        try:
            version = np.lib.format.read_magic(stream)
            reader = {
                (1, 0): np.lib.format.read_array_header_1_0,
                (2, 0): np.lib.format.read_array_header_2_0,
            }[version]
            found_shape, fortran, found_dtype = reader(stream)
        except (ValueError, KeyError) as e:
            raise TableError(f'{path}: array "{name}" has a damaged header ({_reason(e)})') from None
        if found_dtype != dtype:
            raise TableError(f'{path}: array "{name}" has the type {found_dtype}, expected {dtype}')
        if fortran or (shape is not None and found_shape != shape):
            raise TableError(f'{path}: array "{name}" has the shape {found_shape}, expected {shape}')
        nbytes = math.prod(found_shape) * dtype.itemsize
        if nbytes > info.file_size:
            raise TableError(f'{path}: array "{name}" claims {nbytes:,} bytes but the file holds {info.file_size:,}')
        data = stream.read()  # checks the CRC
    if len(data) != nbytes:
        raise TableError(f'{path}: array "{name}" holds {len(data):,} bytes, expected {nbytes:,}')
    return np.frombuffer(data, dtype).reshape(found_shape)
