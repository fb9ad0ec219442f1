"""The example scenes that are installed with the package: ``mi-diffind examples FOLDER`` copies them."""

from __future__ import annotations

import filecmp
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import UsageError
from ..core.files import irregular, replacing, shown, writable_folder

#: Files of the scenes, as patterns: scenes, what they read, and the page that says where each comes from. References of
#: regression tests, pictures and the scripts that write the scenes are left out.
PATTERNS = ("*.xml", "README.md", "assets/**/*")


def source() -> Path:
    """Return the folder of the scenes: beside the modules where they are installed, ``scenes`` in a checkout."""
    here = Path(__file__).resolve().parents[1]
    installed = here / "example_scenes"
    return installed if installed.is_dir() else here.parent / "scenes"


def files() -> list[Path]:
    """Return the files of the scenes, relative to :func:`source`, in alphabetical order."""
    folder = source()
    matching = {path for pattern in PATTERNS for path in folder.glob(pattern) if path.is_file()}
    return sorted(path.relative_to(folder) for path in matching)


@dataclass(frozen=True)
class Written:
    """Scenes that were copied to ``folder``: ``scenes`` are their names, ``count`` and ``size`` all files and bytes."""

    folder: Path
    scenes: tuple[str, ...]
    count: int
    size: int

    @property
    def figures(self) -> dict:
        """The same as a dictionary, for JSON."""
        return {
            "folder": str(self.folder),
            "scenes": [str(self.folder / name) for name in self.scenes],
            "files": self.count,
            "bytes": self.size,
        }

    def __str__(self) -> str:
        return f"{self.folder}: {len(self.scenes)} scenes, {self.count} files, {self.size:,} bytes"


def examples(folder: str | os.PathLike) -> Written:
    """Copy the example scenes and what they read to ``folder``, which is made if its parent exists.

    Files that are there and are equal stay. Raises :class:`UsageError` before anything is written if one differs, and
    :class:`.OutputError`.
    """
    origin, names = source(), files()
    if not names:
        raise UsageError(f"{shown(origin)}: found no example scenes; install the package again")
    target = writable_folder(folder, create=True)
    missing = []
    for name in names:
        place = target / name
        if not os.path.lexists(place):
            missing.append(name)
        elif irregular(place) or not place.is_file() or not filecmp.cmp(origin / name, place, shallow=False):
            raise UsageError(f"{shown(place)}: differs from the example scene of that name; choose another folder")
    for name in missing:
        place = target / name
        for parent in reversed(name.parents[:-1]):
            writable_folder(target / parent, create=True)
        with replacing(place) as temporary:
            shutil.copyfile(origin / name, temporary)
    scenes = tuple(str(name) for name in names if name.suffix == ".xml" and name.parent == Path())
    return Written(target, scenes, len(names), sum((origin / name).stat().st_size for name in names))
