"""Writing of files such that no half-written file stays behind."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from pathlib import Path

from .errors import DiffindError, reason

#: Environment variable that lets files name others outside of their folder: ``any``.
PATHS = "MI_DIFFIND_PATHS"


class OutsideError(DiffindError, ValueError):
    """A file names another one outside of its folder; the message is one sentence that names both."""


class OutputError(DiffindError, OSError):
    """An output file or folder cannot be written; the message is one sentence that names it."""


def writable_folder(path: str | os.PathLike, create: bool = False) -> Path:
    """Return the folder ``path``, made if ``create`` is set and its parent exists.

    Raises :class:`OutputError` if it does not exist or cannot be written. It is called before long work starts, so that
    a typing error costs seconds and not the result.
    """
    path = Path(path)
    try:
        if create and path.parent.is_dir() and not path.exists():
            path.mkdir()
        if not path.is_dir():
            fault = "is not a folder" if path.exists() else "does not exist"
            raise OutputError(f'output folder "{path}" {fault}')
        with tempfile.TemporaryFile(dir=path):
            pass
    except OutputError:
        raise
    except OSError as e:
        raise OutputError(f'output folder "{path}" cannot be written: {e.strerror or e}') from None
    return path


def writable_file(path: str | os.PathLike) -> Path:
    """Return the file ``path``, new or to be replaced. Raises :class:`OutputError` if its folder cannot be written."""
    path = Path(path)
    writable_folder(path.parent)
    if path.is_dir():
        raise OutputError(f'output file "{path}" is a folder')
    return path


@contextlib.contextmanager
def replacing(path: str | os.PathLike):
    """Yield the path of a temporary file beside ``path``; rename it to ``path`` on success, remove it on failure.

    The temporary file has the same extension. Raises :class:`OutputError` if the folder or the file cannot be written,
    as on a full disk.
    """
    path = writable_file(path)
    name = None
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
        os.close(handle)
        yield Path(name)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)
        os.replace(name, path)
    except BaseException as e:
        if name is not None:
            with contextlib.suppress(OSError):
                os.unlink(name)
        if isinstance(e, OutputError) or not (isinstance(e, OSError) or type(e) is RuntimeError):
            raise
        # Mitsuba raises RuntimeError, of several lines
        why = getattr(e, "strerror", None) or reason(e, **{path.name: str(name)})
        raise OutputError(f'output file "{path}" cannot be written: {why}') from e


def write_json(path: str | os.PathLike, content) -> None:
    """Write ``content`` as indented JSON, in one piece."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def path_within(folder: str | os.PathLike, name: str, file: str | os.PathLike) -> Path:
    """Return the path of the file ``name`` in a folder, as the content of a ``file`` names it.

    Raises :class:`OutsideError` for a path that leads out of the folder, unless :data:`PATHS` allows any. Symbolic
    links are not resolved: whoever unpacks a folder has put them there.
    """
    path, inside = os.path.abspath(os.path.join(folder, name)), os.path.abspath(folder)
    if os.environ.get(PATHS) != "any" and os.path.commonpath([path, inside]) != inside:
        raise OutsideError(
            f"{file}: names {name!r:.80}, which lies outside of its folder: the environment variable {PATHS}=any "
            f"allows it"
        )
    return Path(folder) / name


def relative_path(file: str | os.PathLike, folder: str | os.PathLike) -> str:
    """Return the path of a file from a folder, or an absolute one if the two share no more than the root."""
    file, folder = os.path.abspath(file), os.path.abspath(folder)
    shared = os.path.commonpath([file, folder])
    return file if shared == os.path.dirname(shared) else os.path.relpath(file, folder)
