"""Saving of tables that were optimised inside of a scene."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

from .. import plugins
from ..arrays.tables import Table, moved_paths, save_table
from ..core import compat
from ..core.errors import UsageError
from ..fitting.task import STORAGES, table_path, task_of


@dataclass(frozen=True)
class Saved:
    """Saved table file: its ``path``, ``nbytes`` and ``storage`` form.

    ``rms`` is the root mean square error of each array that was optimised, against its values in single precision.
    """

    path: Path
    nbytes: int
    storage: str
    rms: dict[str, float]

    def __str__(self) -> str:
        errors = ", ".join(f"{name} {value:.2g}" for name, value in self.rms.items())
        return f"{self.path}: {self.nbytes:,} bytes as {self.storage}; RMS error against float32: {errors}"


def save(source, path: str | os.PathLike, storage: str = "", file: str | os.PathLike = "") -> Saved:
    """Write tables that were optimised through renders into a table file.

    - ``source``: a plugin (``neural_texture``, ``neural_material``, ``neural_image``, ``neural_disney``,
      ``neural_ggx``, ``neural_sdf``, ``neural_field``), a scene, or ``mi.traverse(…)`` of one of them. The plugin has
      the storage form ``"float32"``.
    - ``path``: table file (``.npz``) to write.
    - ``storage``: storage form of the entries (``"uint8"``, ``"float16"``, ``"float32"``); "": that of the file that
      the plugin read, with its bits per entry.
    - ``file``: if a scene optimises the tables of several files, the name of the one to save.

    The new file keeps the settings of the old one, without its measurements. Raises
    :class:`.UsageError` and :class:`.OutputError`.
    """
    path = table_path(path)
    if storage and storage not in STORAGES:
        raise UsageError(f'storage: found "{storage}", allowed are {", ".join(STORAGES)}')
    table, entries = _trained(source, str(file))
    try:
        stored = task_of(table).stored(table, entries, storage)
    except ValueError as e:
        raise UsageError(f"{path}: {e}") from None
    stored.settings = moved_paths(stored.settings, Path(table.path or "x").resolve().parent, path.resolve().parent)
    save_table(path, stored)
    return Saved(path, stored.nbytes, stored.storage, _errors(stored, entries))


def _trained(source, file: str) -> tuple[Table, dict]:
    """Return the one table of an object whose entries can be optimised, and these entries."""
    if isinstance(source, mi.SceneParameters):
        nodes = compat.nodes_of(source)
    else:
        nodes = [source] if hasattr(source, "trained") else compat.objects_of(source)
    trained = {}
    for node in nodes:
        if hasattr(node, "trained") and plugins.origin(node) is not None:
            table, entries = node.trained()
            if table is not None and entries:
                trained.setdefault(tuple(id(v) for v in entries.values()), (table, entries))
    if file:
        trained = {key: value for key, value in trained.items() if Path(value[0].path).name == Path(file).name}
    if not trained:
        raise UsageError(
            'save: found no tables that can be optimised; give the plugin storage="float32"'
            + (f", or another name than {file}" if file else "")
        )
    if len(trained) > 1:
        names = ", ".join(str(table.path) for table, _ in trained.values())
        raise UsageError(f"save: found the tables of several files ({names}): name one of them by file")
    return next(iter(trained.values()))


def _errors(stored: Table, entries: dict) -> dict[str, float]:
    """Return the root mean square errors of stored entries."""
    read = task_of(stored).model(stored, mi.TensorXf, "float32").entries()
    pairs = {name: (array.numpy().reshape(-1), read[name].numpy().reshape(-1)) for name, array in entries.items()}
    return {name: float(np.sqrt(np.mean(np.square(a - b, dtype=np.float64)))) for name, (a, b) in pairs.items()}
