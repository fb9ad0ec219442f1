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

#: Levels of quality, named by what they promise: ``"fast"``: arithmetic wherever it is faster than a table on a CPU;
#: ``"tables"``: every factor from tables, in the best factorisation; ``"paper"``: the paper's layout.
QUALITIES = ("fast", "tables", "paper")

LAYOUTS = {"tables": FactoredArrays, "paper": PaperArrays}

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


def table_file(filename: str | os.PathLike, quality: str) -> Path | None:
    """
    The file that a decoder reads: ``filename``, or the one that ships for ``quality``; ``None`` if it reads none.
    """
    if str(filename):
        return Path(filename)
    return SHIPPED.get(quality or "fast")


def load_arrays(filename: str | os.PathLike, dtype, storage: str = "", quality: str = "") -> Arrays:
    """
    Tables allocated for the tensor type ``dtype`` in the given storage form, "" meaning the file's own; ``filename`` ""
    means the shipped ones of ``quality``.

    A file is read and checked once, and what is returned shares its memory (Dr.Jit arrays are never written in
    place), yet assigning to one copy does not change another. Raises :class:`TableError` or ``ValueError``.
    """
    if storage and storage not in STORAGES:
        raise ValueError(f'parameter "storage": found "{storage}", allowed are {", ".join(STORAGES)}')
    path = table_file(filename, quality)
    stamp = path.stat().st_mtime_ns if path.is_file() else 0
    original = _load(path, stamp, dtype, storage)
    if quality not in ("", original.QUALITY):
        raise TableError(f'{path}: holds tables of the quality "{original.QUALITY}", "{quality}" was asked for')
    arrays = {}
    for name in original.SHAPES:
        arrays[name] = getattr(original, name)._like()
        arrays[name].data = type(arrays[name].data)(arrays[name].data)
    return type(original)(arrays)


def load_decoder(filename: str | os.PathLike, dtype, storage: str = "", quality: str = "") -> Decoder:
    """
    A decoder of the given quality, or of that of the file, or the default, ``"fast"``. Raises :class:`TableError` or
    ``ValueError``.
    """
    if quality and quality not in QUALITIES:
        raise ValueError(f'parameter "quality": found "{quality}", allowed are {", ".join(QUALITIES)}')
    if table_file(filename, quality) is None or quality == "fast":
        given = "filename" if str(filename) else "storage" if storage else ""
        if given:
            raise ValueError(
                f'parameter "{given}": the quality "fast" reads no tables; give quality "tables" or "paper" with it'
            )
        return Decoder()
    return decoder_of(load_arrays(filename, dtype, storage, quality))


def decoder_of(arrays: Arrays | None) -> Decoder:
    """The decoder that reads ``arrays``; the analytic one for ``None``."""
    decoders = {type(None): Decoder, FactoredArrays: FactoredDecoder, PaperArrays: PaperDecoder}
    return Decoder() if arrays is None else decoders[type(arrays)](arrays)


@functools.lru_cache(maxsize=64)
def _load(path: Path, stamp: int, dtype, storage: str) -> Arrays:
    table, layout = load_disney_table(path)
    return layout.from_table(table, dtype, storage or table.storage)
