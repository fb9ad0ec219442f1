"""Checks of files to read, and writing of files such that no half-written file stays behind."""

import contextlib
import functools
import hashlib
import json
import os
import re
import secrets
import stat
import tempfile
from collections.abc import Mapping
from pathlib import Path

from .errors import DiffindError, UsageError, printable, reason, shortened

try:
    import fcntl
except ImportError:  # Windows, where temporary files of killed processes stay
    fcntl = None

#: Longest path in a sentence, in characters.
SHOWN = 120

#: Longest name of a file of usual file systems, in bytes.
LONGEST_NAME = 255

#: Word between a file's name and the random part in the name of its temporary file.
UNFINISHED = "unfinished"

#: Random hexadecimal digits in the name of a temporary file.
RANDOM = 8

#: Largest file of JSON or XML that is read, in bytes.
MOST_TEXT = 2**26

#: Test of a file's type → its name in a sentence.
_TYPES = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)

#: Environment variable that lets files name others outside of their folder: ``any``.
PATHS = "MI_DIFFIND_PATHS"


#: Environment variable with the folder of fits and models for scenes that are rendered and not written.
CACHE = "MI_DIFFIND_CACHE"


class OutsideError(DiffindError, ValueError):
    """A file names another one outside of its folder; the message is one sentence that names both."""


class OutputError(DiffindError, OSError):
    """An output file or folder cannot be written; the message is one sentence that names it."""


def shown(path: str | os.PathLike) -> str:
    """Return a path as a sentence names it: of a long one, the beginning and the end."""
    return shortened(os.fspath(path), SHOWN)


def irregular(path: str | os.PathLike, most: int | None = None) -> str:
    """Return why a file must not be opened, as the end of a sentence; "" if it is regular, a folder or missing.

    Pipes and devices block a reader or never end; a file of more than ``most`` bytes is refused, too.
    """
    try:
        status = os.stat(path)
    except (FileNotFoundError, ValueError):
        return ""
    except OSError as e:
        return f"cannot be read ({(e.strerror or str(e)).lower()})"
    name = next((name for test, name in _TYPES if test(status.st_mode)), "")
    if name:
        return f"is {name}, a regular file is needed"
    if stat.S_ISREG(status.st_mode) and most is not None and status.st_size > most:
        return f"has {status.st_size:,} bytes, at most {most:,} are read"
    return ""


def check_scene_file(path: str | os.PathLike) -> None:
    """Raise :class:`.UsageError` if there is no file ``path``, or if it cannot be a scene."""
    path = Path(path)
    fault = irregular(path, None if path.suffix.lower() == ".glb" else MOST_TEXT)
    if not fault and not path.is_file():
        fault = "is a folder, a scene file is needed" if path.is_dir() else "no such scene file"
    elif path.suffix.lower() == ".npz":
        fault = 'found a table file, a scene is needed: "mi-diffind inspect" prints the lines by which a scene reads it'
    if fault:
        raise UsageError(f"{shown(path)}: {fault}")


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
            raise OutputError(f'output folder "{shown(path)}" {fault}')
        with tempfile.TemporaryFile(dir=path):
            pass
    except OutputError:
        raise
    except OSError as e:
        raise OutputError(f'output folder "{shown(path)}" cannot be written: {e.strerror or e}') from None
    return path


def cache_folder() -> Path:
    """Return the folder of this user for fits and models of scenes, which is created.

    It is ``$MI_DIFFIND_CACHE``, or lies in ``~/.cache``. Raises :class:`.OutputError`.
    """
    folder = Path(os.environ.get(CACHE) or Path.home() / ".cache" / "mi_diffind")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        return writable_folder(folder, create=True)
    except OSError as e:
        fault = str(e) if isinstance(e, OutputError) else f'folder "{shown(folder)}" cannot be made: {e.strerror}'
        raise OutputError(f"{fault}; the environment variable {CACHE} names another folder") from None


def _target(path: Path) -> Path:
    """Return the file to write: that to which a symbolic link leads, which need not exist."""
    return Path(os.path.realpath(path)) if os.path.islink(path) else path


def writable_file(path: str | os.PathLike) -> Path:
    """Return the file ``path``, new or to be replaced; it may be a symbolic link to such a file.

    Raises :class:`OutputError` if its folder cannot be written, its name is too long, or something else than a regular
    file has the name, such as a folder or a device.
    """
    path = Path(path)
    writable_folder(_target(path).parent)
    if (length := len(os.fsencode(path.name))) > LONGEST_NAME:
        raise OutputError(
            f'output file "{shown(path)}" has a name of {length} bytes, at most {LONGEST_NAME} are allowed'
        )
    if path.is_dir():
        raise OutputError(f'output file "{shown(path)}" is a folder')
    if fault := irregular(path):
        raise OutputError(f'output file "{shown(path)}" {fault}')
    return path


def same_file(a: str | os.PathLike, b: str | os.PathLike) -> bool:
    """Return whether two paths, by any spelling or link, name one file, which need not exist."""
    if os.path.realpath(a) == os.path.realpath(b):
        return True
    try:
        return os.path.samefile(a, b)
    except (OSError, ValueError):
        return False


def check_distinct(outputs: Mapping[str, object], sources: Mapping[str, object]) -> None:
    """Refuse a file to write that is another file to write or a file to read, whose content would be lost.

    Both map the name of an argument to a path or a list of paths; ``None``, "" and objects in memory are left out.
    Raises :class:`.UsageError`.
    """
    written, read = _paths(outputs), _paths(sources)
    for i, (name, path) in enumerate(written):
        for other, second in (*written[:i], *read):
            if same_file(path, second):
                raise UsageError(f'{name}: found "{shown(path)}", the same file as {other}, allowed is another one')


def _paths(named: Mapping[str, object]) -> list[tuple[str, str | os.PathLike]]:
    pairs = []
    for name, value in named.items():
        for path in value if isinstance(value, list) else [value]:
            if isinstance(path, (str, os.PathLike)) and (path := os.fspath(path)):
                # FILE#PART names a part of a file
                pairs.append((name, path if os.path.exists(path) else path.rpartition("#")[0] or path))
    return [(name, path) for name, path in pairs if not os.path.isdir(path)]


@contextlib.contextmanager
def replacing(path: str | os.PathLike):
    """Yield the path of a temporary file beside ``path``; rename it to ``path`` on success, remove it on failure.

    Of a symbolic link, the file to which it leads is replaced. The temporary file has the same extension. Those of
    earlier processes that were killed are removed. Raises :class:`OutputError` if the folder or the file cannot be
    written, as on a full disk.
    """
    path = writable_file(path)
    target = _target(path)
    beside = target.with_name(path.name)
    temporary = handle = None
    try:
        _remove_abandoned(beside)
        handle, temporary = _create_locked(beside)
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, target)
    except BaseException as e:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        if isinstance(e, OutputError) or not (isinstance(e, OSError) or type(e) is RuntimeError):
            raise
        # Mitsuba raises RuntimeError, of several lines
        why = getattr(e, "strerror", None) or reason(e, **{path.name: str(temporary)})
        raise OutputError(f'output file "{shown(path)}" cannot be written: {why}') from e
    finally:
        if handle is not None:
            os.close(handle)


def _temporary_name(path: Path, random: str) -> str:
    """Return the name of a temporary file of ``path``; it is not longer than file systems allow."""
    name = f".{path.stem}.{UNFINISHED}-{random}{path.suffix}"
    if len(os.fsencode(name)) <= LONGEST_NAME:
        return name
    digest = hashlib.sha256(os.fsencode(path.name)).hexdigest()[:32]
    suffix = path.suffix if len(os.fsencode(path.suffix)) <= 32 else ""
    return f".{digest}.{UNFINISHED}-{random}{suffix}"


def _create_locked(path: Path) -> tuple[int, Path]:
    """Create a temporary file of ``path``: its handle, whose lock shows that this process lives, and its path."""
    while True:
        temporary = path.with_name(_temporary_name(path, secrets.token_hex(RANDOM // 2)))
        try:
            handle = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o600)
        except FileExistsError:
            continue
        # Another process may have taken it for abandoned before the lock
        if _lock(handle) and os.fstat(handle).st_nlink:
            return handle, temporary
        os.close(handle)


def _lock(handle: int) -> bool:
    """Lock an open file, if the file system has locks; return whether no other process holds its lock."""
    try:
        if fcntl is not None:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as e:
        return not isinstance(e, BlockingIOError)
    return True


def _remove_abandoned(path: Path) -> None:
    """Remove temporary files of ``path`` whose processes have ended: the system has released their locks."""
    if fcntl is None:
        return
    before, after = (re.escape(part) for part in _temporary_name(path, "\0" * RANDOM).split("\0" * RANDOM))
    pattern = re.compile(f"{before}[0-9a-f]{{{RANDOM}}}{after}")
    for name in filter(pattern.fullmatch, os.listdir(path.parent)):
        with contextlib.suppress(OSError):  # removed in the meantime, of another user, or without locks
            handle = os.open(path.with_name(name), os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                os.unlink(path.with_name(name))
            finally:
                os.close(handle)


def write_json(path: str | os.PathLike, content) -> None:
    """Write ``content`` as indented JSON, in one piece."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def stamp(path: str | os.PathLike) -> tuple:
    """Return numbers that change when a file does: its time and size."""
    try:
        status = os.stat(path)
    except OSError:
        return ()
    return status.st_mtime_ns, status.st_size


def read_once(read, path: str | os.PathLike, *form):
    """Return ``read(path, *form)``, and the same object again while the file does not change.

    The last :data:`REMEMBERED` results are kept. ``form`` are hashable values that say how the file is read.
    """
    return _read(read, Path(path), stamp(path), form)


#: Results of :func:`read_once` that are kept.
REMEMBERED = 64


@functools.lru_cache(maxsize=REMEMBERED)
def _read(read, path: Path, stamp: tuple, form: tuple):
    return read(path, *form)


def is_within(folder: str | os.PathLike, name: str | os.PathLike) -> bool:
    """Return whether the path ``name``, from a folder, stays in the folder."""
    return Path(os.path.abspath(os.path.join(folder, name))).is_relative_to(os.path.abspath(folder))


def path_within(folder: str | os.PathLike, name: str, file: str | os.PathLike) -> Path:
    """Return the path of the file ``name`` in a folder, as the content of a ``file`` names it.

    Raises :class:`OutsideError` for a path that leads out of the folder, unless :data:`PATHS` allows any. Symbolic
    links are not resolved: whoever unpacks a folder has put them there.
    """
    if os.environ.get(PATHS) != "any" and not is_within(folder, name):
        raise OutsideError(
            f"{file}: names {name!r:.80}, which lies outside of its folder: the environment variable {PATHS}=any "
            f"allows it"
        )
    return Path(folder) / name


def path_by_name(folder: str | os.PathLike, name: str, file: str | os.PathLike, outside: bool = False) -> Path:
    """Return :func:`path_within` of a ``name`` that may have been written on another system.

    Where there is no such file, backslashes are slashes, and a name that differs in upper and lower case alone is taken
    if it is the only one. ``outside``: any path is allowed, for a ``file`` that the user has named. Raises
    :class:`OutsideError`.
    """
    for spelling in (name, name.replace("\\", "/")):
        path = Path(folder) / spelling if outside else path_within(folder, spelling, file)
        if os.path.lexists(path):
            return path
    if os.path.isabs(spelling):
        return path
    present = Path(folder)
    for part in Path(spelling).parts:
        if not os.path.lexists(present / part):
            with contextlib.suppress(OSError):
                alike = [entry for entry in os.listdir(present) if entry.casefold() == part.casefold()]
                part = alike[0] if len(alike) == 1 else part
        present = present / part
    return present if os.path.lexists(present) else path


def relative_path(file: str | os.PathLike, folder: str | os.PathLike) -> str:
    """Return the path of a file from a folder, or an absolute one if the two share no more than the root."""
    file, folder = os.path.abspath(file), os.path.abspath(folder)
    shared = os.path.commonpath([file, folder])
    return file if shared == os.path.dirname(shared) else os.path.relpath(file, folder)


#: Names in a note.
MOST_NAMES = 50

#: Characters of a name in a note.
LONGEST_KEY = 40


class RecordedKeys(dict):
    """Dictionary that records the keys which are asked for, in the set ``read``.

    ``[]``, ``get`` and ``in`` record their key, ``items`` records all keys. Iteration, ``keys``, ``len``, copies and
    ``{**…}`` record none.
    """

    read = frozenset()

    def _record(self, *keys) -> None:
        self.read = self.read | set(keys)

    def __getitem__(self, key):
        self._record(key)
        return super().__getitem__(key)

    def __contains__(self, key) -> bool:
        self._record(key)
        return super().__contains__(key)

    def get(self, key, default=None):
        self._record(key)
        return super().get(key, default)

    def items(self):
        self._record(*self)
        return super().items()


def unused_keys(content) -> list[str]:
    """Return the keys that were not read, each once, in the order of the file.

    ``content`` is a :class:`RecordedKeys`, or lists and dictionaries that contain such. A key of an object inside
    another has the outer keys before it: ``frames.sharpness``. Objects that are not recorded count as read.
    """
    names: dict[str, None] = {}

    def visit(value, prefix: str) -> None:
        if isinstance(value, list):
            for entry in value:
                visit(entry, prefix)
        elif isinstance(value, dict):
            recorded = value.read if isinstance(value, RecordedKeys) else value.keys()
            for key, entry in dict.items(value):
                if key in recorded:
                    visit(entry, f"{prefix}{key}.")
                else:
                    names.setdefault(f"{prefix}{key}")

    visit(content, "")
    return list(names)


def unused_note(file: Path | str, content, also: tuple[str, ...] = ()) -> str | None:
    """Return a sentence with the keys of a ``file`` that were not read, see :func:`unused_keys`, or ``None``.

    ``also`` are further names, from places that are not JSON objects.
    """
    names = [*unused_keys(content), *also]
    if not names:
        return None
    listed = [printable(name if len(name) <= LONGEST_KEY else f"{name[:LONGEST_KEY]}…") for name in names]
    more = f" and {len(names) - MOST_NAMES:,} more" if len(names) > MOST_NAMES else ""
    return f"{Path(file).name}: keys that are not used: {', '.join(listed[:MOST_NAMES])}{more}"
