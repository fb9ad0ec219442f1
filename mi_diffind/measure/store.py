"""Folder of trained models, and fingerprints of the files that models and references depend on."""

import hashlib
import importlib.util
import os
import shutil
from collections.abc import Iterable
from pathlib import Path


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
    """Return a hash of the names and contents of files."""
    digest = hashlib.sha256()
    for path in sorted(map(str, paths)):
        digest.update(Path(path).name.encode() + b"\0" + Path(path).read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def sources() -> set[Path]:
    """Return the files that a measurement may depend on: modules, plugins (elsewhere in a checkout), tables."""
    plugins = importlib.util.find_spec("mi_diffind.plugins").submodule_search_locations
    modules = {path for folder in plugins for path in Path(folder).rglob("*.py")}
    package = Path(__file__).resolve().parents[1]
    return modules | set(package.rglob("*.py")) | set(package.glob("data/*.npz"))
