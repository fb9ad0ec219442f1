"""
What a study has measured so far, kept in the output folder until its result is written: a run can be interrupted at any
time, and the same command goes on from there, as long as the key is the same.

The files are ``tradeoff_NAME.partial.json``, and ``tradeoff_NAME.partial.ARRAYS.npz`` for each group of arrays.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..files import replacing, writable_folder, write_json
from .statistics import finite


class Store:
    """
    What has been measured of the study ``name`` under a ``key`` (a tree for JSON): ``data``, section → whatever JSON
    can hold, and ``arrays``, name → group of NumPy arrays by name. ``folder`` is made if its parent exists; ``None``
    keeps nothing.

    What is found in the folder is taken over if its key is the same (``resumed``), and else removed; a line on stderr
    says so, ``progress`` permitting: what of the key differs, or that a file is damaged. Raises
    :class:`~mi_diffind.files.OutputError` if the folder cannot be written.
    """

    def __init__(
        self, folder: str | os.PathLike | None, name: str, key: dict, sections: Iterable[str], progress: bool = True
    ):
        self.folder = None if folder is None else writable_folder(folder, create=True)
        self.key, self.name = json.loads(json.dumps(finite(key))), name
        self.data: dict[str, dict] = {section: {} for section in sections}
        self.arrays: dict[str, dict[str, np.ndarray]] = {}
        self.resumed, self._saved = False, time.monotonic()
        if self.folder is None or not self.path.is_file():
            return
        try:
            problem = self._read()
        except Exception:  # whatever a damaged file may raise
            problem = "is damaged"
        if problem:
            self.remove(self.folder, name)
        else:
            self.resumed = True
        if progress:
            line = f"{self.path} {problem}: starting anew" if problem else f"going on from {self.path}"
            print(line, file=sys.stderr)

    @property
    def path(self) -> Path:
        """The file of ``data``."""
        return self.folder / f"tradeoff_{self.name}.partial.json"

    def _read(self) -> str:
        """Take over what the files hold; what speaks against it, if anything does."""
        found = json.loads(self.path.read_text(encoding="utf-8"))
        other = [k for k in {**self.key, **found["key"]} if self.key.get(k) != found["key"].get(k)]
        if other:
            return f"is of a run with other {', '.join(other)}"
        if set(found["data"]) != set(self.data) or not all(type(v) is type({}) for v in found["data"].values()):
            raise ValueError("not what was written")
        arrays = {}
        for name in found["arrays"]:
            with np.load(self._array_path(name), allow_pickle=False) as file:
                arrays[name] = {key: file[key] for key in file}
        self.data, self.arrays = found["data"], arrays
        return ""

    def _array_path(self, name: str) -> Path:
        return self.path.with_suffix(f".{name}.npz")

    def keep(self, name: str, **arrays: np.ndarray) -> None:
        """Add a group of arrays; it counts from the next :meth:`save` on."""
        self.arrays[name] = arrays
        if self.folder is not None:
            with replacing(self._array_path(name)) as temporary:
                np.savez(temporary, **arrays)

    def save(self, every: float = 0.0) -> None:
        """Write ``data``, unless that was done less than ``every`` seconds ago."""
        if self.folder is not None and time.monotonic() - self._saved >= every:
            write_json(self.path, {"key": self.key, "data": self.data, "arrays": list(self.arrays)})
            self._saved = time.monotonic()

    @staticmethod
    def remove(folder: str | os.PathLike, name: str) -> None:
        """Remove what is kept of the study ``name``: its result is written, or it is of no use."""
        for path in (*Path(folder).glob(f"tradeoff_{name}.partial.json"),
                     *Path(folder).glob(f"tradeoff_{name}.partial.*.npz")):  # fmt: skip
            path.unlink(missing_ok=True)


def models_folder(parent: str | os.PathLike, name: str, key: str) -> Path:
    """The folder in ``parent`` that keeps trained models, emptied if they were made under another ``key``."""
    folder = Path(parent) / f"tradeoff_{name}_models"
    mark = folder / "key.txt"
    if folder.is_dir() and mark.is_file() and mark.read_text(encoding="utf-8") != key:
        shutil.rmtree(folder)
    folder.mkdir(exist_ok=True)
    mark.write_text(key, encoding="utf-8")
    return folder


def file_name(name: str) -> str:
    """``name`` without what file names should not have."""
    return "".join(c if c.isalnum() else "_" for c in name)


def fingerprint(paths: Iterable[str | os.PathLike]) -> str:
    """A hash of the contents of files, which tells whether a measurement can be gone on with."""
    digest = hashlib.sha256()
    for path in sorted(map(str, paths)):
        digest.update(Path(path).name.encode() + b"\0" + Path(path).read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def sources() -> set[Path]:
    """All that a measurement may depend on of this package: modules, plugins (elsewhere in a checkout), tables."""
    from .. import plugins

    package = Path(__file__).resolve().parents[1]
    found = {*package.rglob("*.py"), *Path(plugins.__file__).resolve().parent.rglob("*.py")}
    return found | set((package / "data").glob("*.npz"))
