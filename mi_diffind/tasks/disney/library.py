"""The Disney tables at hand: those that ship with the package, and files of one's own, read once each."""

from __future__ import annotations

import functools
import os
from pathlib import Path

from ...lookup import STORAGES
from ...tables import Table, TableError, load_table
from .arrays import TASK, Arrays
from .decoder import Decoder
from .factored import FactoredArrays, FactoredDecoder
from .paper import PaperArrays, PaperDecoder

LAYOUTS = {"tables": FactoredArrays, "paper": PaperArrays}

#: The presets: ``"tables"``, the best factorisation, and the default; ``"paper"``, the paper's layout.
PRESETS = tuple(LAYOUTS)

_FOLDER = Path(__file__).resolve().parents[2] / "data"

#: The tables that ship; ``mi_diffind/data/README.md`` holds the commands that made them.
SHIPPED = {quality: _FOLDER / f"disney_{quality}.npz" for quality in LAYOUTS}


def load_disney_table(path: str | os.PathLike) -> tuple[Table, type[Arrays]]:
    """Read a table file of this task, find its layout, check sizes and ranges. Raises :class:`TableError`."""
    table = load_table(path, task=TASK)
    # Which layout is meant is said by the names of its arrays; what is wrong with it, by comparing with that one
    layout = max(LAYOUTS.values(), key=lambda layout: len(set(layout.SHAPES) & set(table.arrays)))
    table = load_table(path, task=TASK, shapes=layout.SHAPES)
    for name, (low, high) in layout.RANGES.items():
        values = table.values(name)
        slack = 1e-3 * (high - low)  # rounding of the storage form
        if values.min() < low - slack or values.max() > high + slack:
            raise TableError(
                f'{path}: entries of "{name}" lie in [{values.min():.4g}, {values.max():.4g}], '
                f"allowed is [{low:g}, {high:g}]"
            )
    return table, layout


def table_file(filename: str | os.PathLike, preset: str = "") -> Path:
    """The file that is read: ``filename``, or the one that ships for ``preset`` ("": the default)."""
    return Path(filename) if str(filename) else SHIPPED[preset or PRESETS[0]]


def load_arrays(filename: str | os.PathLike, dtype, storage: str = "", preset: str = "") -> Arrays:
    """
    Tables allocated for the tensor type ``dtype`` in the given storage form, "" meaning the file's own; ``filename`` ""
    means the shipped ones of ``preset``.

    A file is read and checked once, and what is returned shares its memory (Dr.Jit arrays are never written in
    place), yet assigning to one copy does not change another. Raises :class:`TableError` or ``ValueError``.
    """
    for name, found, allowed in (("storage", storage, STORAGES), ("preset", preset, PRESETS)):
        if found and found not in allowed:
            raise ValueError(f'parameter "{name}": found "{found}", allowed are {", ".join(allowed)}')
    path = table_file(filename, preset)
    stamp = path.stat().st_mtime_ns if path.is_file() else 0
    original = _load(path, stamp, dtype, storage)
    if preset not in ("", original.QUALITY):
        raise TableError(f'{path}: holds tables of the preset "{original.QUALITY}", "{preset}" was asked for')
    arrays = {}
    for name in original.SHAPES:
        arrays[name] = getattr(original, name)._like()
        arrays[name].data = type(arrays[name].data)(arrays[name].data)
    return type(original)(arrays)


def load_decoder(filename: str | os.PathLike, dtype, storage: str = "", preset: str = "") -> Decoder:
    """The decoder that reads what :func:`load_arrays` returns, and raises as that does."""
    return decoder_of(load_arrays(filename, dtype, storage, preset))


def decoder_of(arrays: Arrays) -> Decoder:
    """The decoder that reads ``arrays``."""
    return {FactoredArrays: FactoredDecoder, PaperArrays: PaperDecoder}[type(arrays)](arrays)


@functools.lru_cache(maxsize=64)
def _load(path: Path, stamp: int, dtype, storage: str) -> Arrays:
    table, layout = load_disney_table(path)
    return layout.from_table(table, dtype, storage or table.storage)
