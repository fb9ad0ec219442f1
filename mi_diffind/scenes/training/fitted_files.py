"""Result of a training of several files at once."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from dataclasses import dataclass, field
from pathlib import Path

from ...arrays.tables import Table, moved_paths, save_table
from ...core.errors import UsageError
from ...core.files import replacing, writable_folder
from ...core.units import labelled
from ...fitting.task import Fitted, Model, task_of, tasks


@dataclass(repr=False)
class FittedFiles(Fitted):
    """Result of a training of several files: ``tables`` by the name of the file; ``table`` is the first of them."""

    tables: dict[str, Table] = field(default_factory=dict)

    @property
    def models(self) -> dict[str, Model]:
        """Model of each file, ready to be evaluated, measured and decoded."""
        return {n: task_of(table).model(table, self.request.types.TensorXf) for n, table in self.tables.items()}

    @property
    def model(self) -> Model:
        """Raise :class:`UsageError`: there are several (:attr:`models`)."""
        raise UsageError(f"model: {len(self.tables)} files were trained, models has one for each")

    @property
    def report(self) -> dict:
        """All figures of the result; those of each file are in ``files``, by name."""
        common = {k: v for k, v in super().report.items() if k not in ("settings", "measured")}
        files = {
            name: {
                "bytes": table.nbytes, "settings": table.settings, "measured": table.measured,
                "arrays": {key: list(array.shape) for key, array in table.arrays.items()},
                "bits": {key: array.bits for key, array in table.arrays.items()},
            }
            for name, table in self.tables.items()
        }  # fmt: skip
        return {**common, "bytes": sum(table.nbytes for table in self.tables.values()), "files": files}

    def save(self, path: str | os.PathLike) -> Path:
        """Write all files into the folder ``path``, each under its name, and return the folder.

        The folder is created if its parent exists. Files are replaced once all of them are written. Raises
        :class:`.OutputError`.
        """
        folder = writable_folder(path, create=True)
        with contextlib.ExitStack() as stack:
            for name, table in self.tables.items():
                settings = table.settings
                if self.request is not None:
                    settings = moved_paths(settings, self.request.folder, folder.resolve())
                save_table(stack.enter_context(replacing(folder / name)), dataclasses.replace(table, settings=settings))
        return folder

    def summary(self, path: str | os.PathLike = "FOLDER") -> list[str]:
        """Return the result as lines of text: bytes and accuracy of each file, remarks, and how scenes name them."""
        lines = [f"{path}: {len(self.tables)} files; {self.result.outcome}"]
        for name, table in self.tables.items():
            lines.append(f"{Path(path) / name}: {table.nbytes:,} bytes as {table.storage}")
            lines += [f"  {line}" for line in labelled(table.measured)]
        lines += [f"  {line}" for line in self.lines]
        usage = [f"  {line}" for n, table in self.tables.items() for line in tasks()[table.task].usage(table, n)]
        return [*lines, *(["in a scene:"] if usage else []), *usage]
