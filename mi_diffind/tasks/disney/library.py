"""The Disney tables at hand: those that ship with the package, and files of one's own, read once each."""

from __future__ import annotations

import functools
import os
from pathlib import Path

from ...lookup import STORAGES
from .arrays import DisneyArrays, load_disney_table

#: The tables that ship; ``mi_diffind/data/README.md`` holds the command that made them.
SHIPPED = Path(__file__).resolve().parents[2] / "data" / "disney.npz"


def load_arrays(filename: str | os.PathLike, dtype, storage: str = "") -> DisneyArrays:
    """
    Tables allocated for the tensor type ``dtype`` in the given storage form, "" meaning the file's own; ``filename`` ""
    means the shipped ones.

    A file is read and checked once, and what is returned shares its memory (Dr.Jit arrays are never written in
    place), yet assigning to one copy does not change another. Raises :class:`TableError` or ``ValueError``.
    """
    if storage and storage not in STORAGES:
        raise ValueError(f'parameter "storage": found "{storage}", allowed are {", ".join(STORAGES)}')
    path = Path(filename) if str(filename) else SHIPPED
    stamp = path.stat().st_mtime_ns if path.is_file() else 0
    original = _load(path, stamp, dtype, storage)
    arrays = {}
    for name in DisneyArrays.DRJIT_STRUCT:
        arrays[name] = getattr(original, name)._like()
        arrays[name].data = type(arrays[name].data)(arrays[name].data)
    return DisneyArrays(arrays)


@functools.lru_cache(maxsize=64)
def _load(path: Path, stamp: int, dtype, storage: str) -> DisneyArrays:
    table = load_disney_table(path)
    return DisneyArrays.from_table(table, dtype, storage or table.storage)
