"""Store of partial results in the output folder: the same command continues an interrupted run.

Partial results stay until the result is written, in ``tradeoff_NAME.partial.json``. A run is continued only if its
key is unchanged.
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
import os
import shutil
import sys
import time
from collections.abc import Iterable
from pathlib import Path

from ..core.files import writable_folder, write_json
from .statistics import finite


class Store:
    """Partial results of the study ``name`` under a ``key`` (a tree for JSON).

    ``data``: section → tree for JSON. ``folder`` is made if its parent exists; ``None`` writes nothing.

    Partial results in the folder are read if their key is the same (``resumed``), else removed. With ``progress``, a
    line on stderr tells which, and which parts of the key differ or that a file is damaged. Raises
    :class:`.OutputError` if the folder cannot be written.
    """

    def __init__(
        self, folder: str | os.PathLike | None, name: str, key: dict, sections: Iterable[str], progress: bool = True
    ):
        self.folder = None if folder is None else writable_folder(folder, create=True)
        self.key, self.name = json.loads(json.dumps(finite(key))), name
        self.data: dict[str, dict] = {section: {} for section in sections}
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
            line = f"{self.path} {problem}: starting anew" if problem else f"continuing from {self.path}"
            print(line, file=sys.stderr)

    @property
    def path(self) -> Path:
        """File of ``data``."""
        return self.folder / f"tradeoff_{self.name}.partial.json"

    def _read(self) -> str:
        """Read the file; return why it cannot be used, "" if it can."""
        stored = json.loads(self.path.read_text(encoding="utf-8"))
        other = [k for k in {**self.key, **stored["key"]} if self.key.get(k) != stored["key"].get(k)]
        if other:
            return f"is of a run with other {', '.join(other)}"
        if set(stored["data"]) != set(self.data) or not all(type(v) is dict for v in stored["data"].values()):
            raise ValueError("the sections are not those of this study")
        self.data = stored["data"]
        return ""

    def save(self, every: float = 0.0) -> None:
        """Write ``data``, unless it was written less than ``every`` seconds ago."""
        if self.folder is not None and time.monotonic() - self._saved >= every:
            write_json(self.path, {"key": self.key, "data": self.data})
            self._saved = time.monotonic()

    @staticmethod
    def remove(folder: str | os.PathLike, name: str) -> None:
        """Remove the partial results of the study ``name``."""
        (Path(folder) / f"tradeoff_{name}.partial.json").unlink(missing_ok=True)


def models_folder(parent: str | os.PathLike, name: str, key: str) -> Path:
    """Return the folder in ``parent`` for trained models, emptied if its models have another ``key``."""
    folder = Path(parent) / f"tradeoff_{name}_models"
    mark = folder / "key.txt"
    if folder.is_dir() and mark.is_file() and mark.read_text(encoding="utf-8") != key:
        shutil.rmtree(folder)
    folder.mkdir(exist_ok=True)
    mark.write_text(key, encoding="utf-8")
    return folder


def file_name(name: str) -> str:
    """Return ``name`` with an underscore for each character that is no letter and no digit."""
    return "".join(c if c.isalnum() else "_" for c in name)


def fingerprint(paths: Iterable[str | os.PathLike]) -> str:
    """Return a hash of the names and contents of files; an unchanged one lets a run be continued."""
    digest = hashlib.sha256()
    for path in sorted(map(str, paths)):
        digest.update(Path(path).name.encode() + b"\0" + Path(path).read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def package_files(*patterns: str) -> set[Path]:
    """Return the files of this package that match ``patterns``, as ``"tasks/ggx/*.py"``, relative to its folder."""
    package = Path(__file__).resolve().parents[1]
    return {path for pattern in patterns for path in package.glob(pattern)}


def sources() -> set[Path]:
    """Return the files that a measurement may depend on: modules, plugins (elsewhere in a checkout), tables."""
    plugins = importlib.util.find_spec("mi_diffind.plugins").submodule_search_locations
    modules = {path for folder in plugins for path in Path(folder).rglob("*.py")}
    return modules | package_files("**/*.py", "data/*.npz")
