"""Data of the pages that do not ship: ``mi-diffind fetch`` brings them from where their makers publish them.

Each file is pinned by its SHA-256, so that figures of the pages are those of the very files.
"""

from __future__ import annotations

import hashlib
import http.client
import os
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import DiffindError, UsageError, reason
from ..core.files import irregular, replacing, shown, writable_folder, write_json

#: Bytes that are read at a time, and seconds without an answer after which a download fails.
BLOCK, TIMEOUT = 2**16, 30.0

#: Schemes of addresses; Python refuses redirections to local files.
SCHEMES = ("https", "http")


class DownloadError(DiffindError):
    """A file cannot be fetched, or is not the one that is expected; the message is one sentence that names it."""


@dataclass(frozen=True)
class File:
    """File to fetch: the end of its address, its number of bytes and its SHA-256; its name is the last part."""

    address: str
    size: int
    sha256: str

    @property
    def name(self) -> str:
        """Name of the file in the folder."""
        return self.address.rpartition("/")[2]


@dataclass(frozen=True)
class Download:
    """Files of one name in a folder: what they are, the licence, and the address that those of the files end.

    Of a material, ``maps`` is the content of a manifest of its maps (:mod:`mi_diffind.maps.source`), ``NAME.json``.
    """

    what: str
    licence: str
    base: str
    files: tuple[File, ...]
    maps: dict | None = None

    @property
    def size(self) -> int:
        """Number of bytes of all files."""
        return sum(file.size for file in self.files)


_MATERIALX = (
    "https://raw.githubusercontent.com/AcademySoftwareFoundation/MaterialX/"
    "4177b2cbd48b579ca1e8f7d9901584d811c63b68/resources"
)
_CGAL = "https://raw.githubusercontent.com/CGAL/cgal/v5.5.1/Data/data/meshes"

#: Name → what :func:`fetch` brings.
DOWNLOADS = {
    "boombox": Download(
        "base colour, normals, and occlusion, roughness and metallic in one image, 2048²",
        "Apache-2.0, MaterialX",
        f"{_MATERIALX}/Materials/Examples/GltfPbr/boombox",
        (
            File(
                "BoomBox_baseColor.png",
                2_013_853,
                "d63655d14c6effbd685b8b7a23e3cc9f73bd0c33e85d2b3211dff42faaed6e07",
            ),
            File(
                "BoomBox_normal.png",
                1_671_504,
                "c3707fd9e0bb0e0b844a0d4eeaf49554b0c40b2512284227706ad38b033131d3",
            ),
            File(
                "BoomBox_occlusionRoughnessMetallic.png",
                3_181_970,
                "04feedd2189fc4f1f83d9c05fb0a7d7da0c27d80f7a31eacdd37d8682776f81b",
            ),
        ),
        {
            "albedo": "BoomBox_baseColor.png",
            "normal": "BoomBox_normal.png",
            "ao": {"file": "BoomBox_occlusionRoughnessMetallic.png", "channels": "r"},
            "roughness": {"file": "BoomBox_occlusionRoughnessMetallic.png", "channels": "g"},
            "metallic": {"file": "BoomBox_occlusionRoughnessMetallic.png", "channels": "b"},
        },
    ),
    "brick": Download(
        "base in grey, normals and roughness, 2048²",
        "Apache-2.0, MaterialX",
        f"{_MATERIALX}/Images",
        (
            File("brick_base_gray.jpg", 1_095_294, "4a228efc9f4a42a4c23d71ab3b880a3beb26f9f403208122b855de05e9022dee"),
            File("brick_normal.jpg", 3_690_871, "9f9be6b8eb54c50c0c875762e9493c8672f3a62b89bef4635ac3868debf7f55d"),
            File("brick_roughness.jpg", 849_467, "00cd23d5d58729039dc00e73169fafaf9bae32472d3ea415abc2c4dbe5246f81"),
        ),
        {"albedo": "brick_base_gray.jpg", "normal": "brick_normal.jpg", "roughness": "brick_roughness.jpg"},
    ),
    "armadillo": Download(
        "mesh of 52,000 triangles, watertight",
        "Stanford's terms: for research, not for commerce; as CGAL publishes it",
        _CGAL,
        (File("armadillo.off", 1_622_939, "6f7f3ca1abc506569466b72f2f59d49493a284e7376d7a7e23c08115ec8cec4e"),),
    ),
    "bunny": Download(
        "mesh of 75,408 triangles, watertight",
        "Stanford's terms: for research, not for commerce; as CGAL publishes it",
        _CGAL,
        (File("bunny00.off", 2_613_072, "ab651cb04955c161efaeb079035a1e5e1f0e0d1f816a2df67beaea68f393ff2b"),),
    ),
}


@dataclass(frozen=True)
class Fetched:
    """Files of ``names`` in ``folder``; ``loaded`` of them were fetched, the others were there."""

    folder: Path
    names: tuple[str, ...]
    files: tuple[Path, ...]
    loaded: int

    @property
    def figures(self) -> dict:
        """The same as a dictionary, for JSON."""
        return {
            "folder": str(self.folder),
            "names": list(self.names),
            "files": [str(path) for path in self.files],
            "loaded": self.loaded,
        }

    def __str__(self) -> str:
        lines = [f"{self.folder}: {len(self.files)} files, {self.loaded} fetched, SHA-256 as expected"]
        return "\n".join([*lines, *(str(path) for path in self.files)])


def fetch(
    names: str | Iterable[str],
    folder: str | os.PathLike = "data",
    base: str | None = None,
    progress: Callable[[str], None] | None = None,
) -> Fetched:
    """Fetch the files of ``names``, of :data:`DOWNLOADS`, into ``folder/NAME``, and return what is there.

    A material gets a manifest, ``NAME.json``. Files that are there and have the right SHA-256 stay. ``base``: another
    address, of a mirror, that ends in a folder of the files of each name. ``progress`` is called with a line for each
    file to fetch. Raises :class:`UsageError`, :class:`DownloadError` and :class:`.OutputError`; no
    unfinished file stays.
    """
    names = tuple(dict.fromkeys([names] if isinstance(names, str) else names))
    if unknown := next((name for name in names if name not in DOWNLOADS), None):
        raise UsageError(f'data "{unknown}": is not known, allowed are {", ".join(DOWNLOADS)}')
    if base is not None and base.partition(":")[0] not in SCHEMES:
        raise UsageError(f'address "{base}": found no http, an address like "https://host/folder" is needed')
    target, paths, loaded = writable_folder(folder, create=True), [], 0
    for name in names:
        place = writable_folder(target / name, create=True)
        for file in DOWNLOADS[name].files:
            path = place / file.name
            paths.append(path)
            if os.path.lexists(path):
                _check_present(path, file)
                continue
            beginning = DOWNLOADS[name].base if base is None else f"{base.rstrip('/')}/{name}"
            address = f"{beginning}/{file.address}"
            if progress is not None:
                progress(f"{address} ({file.size:,} bytes)")
            with replacing(path) as temporary:
                _load(address, file, temporary)
            loaded += 1
        if DOWNLOADS[name].maps is not None:
            paths.append(place / f"{name}.json")
            if not os.path.lexists(paths[-1]):
                write_json(paths[-1], {"maps": DOWNLOADS[name].maps})
    return Fetched(target, names, tuple(paths), loaded)


def _check_present(path: Path, file: File) -> None:
    """Raise :class:`UsageError` if an existing file is not the one that is expected."""
    fault = irregular(path) or ("is a folder" if path.is_dir() else "")
    if fault or path.stat().st_size != file.size or hashlib.sha256(path.read_bytes()).hexdigest() != file.sha256:
        raise UsageError(f"{shown(path)}: {fault or 'is another file of that name'}; move it away and try again")


def _load(address: str, file: File, path: Path) -> None:
    """Write the file at an address to ``path``, no more than its bytes. Raises :class:`DownloadError`."""
    digest, size = hashlib.sha256(), 0
    try:
        with urllib.request.urlopen(address, timeout=TIMEOUT) as source, path.open("wb") as output:
            while block := source.read(BLOCK):
                size += len(block)
                if size > file.size:
                    break
                digest.update(block)
                output.write(block)
    except urllib.error.HTTPError as e:
        raise DownloadError(f"{shown(address)}: cannot be fetched: HTTP {e.code} {e.reason}") from None
    except urllib.error.URLError as e:
        raise DownloadError(f"{shown(address)}: cannot be fetched: {reason(_cause(e))}") from None
    except (http.client.HTTPException, TimeoutError, ConnectionError, ValueError) as e:
        raise DownloadError(f"{shown(address)}: cannot be fetched: {reason(e)}") from None
    if size != file.size:
        count = f"more than {file.size:,}" if size > file.size else f"{size:,}"
        raise DownloadError(f"{shown(address)}: found {count} bytes, {file.size:,} are expected")
    if digest.hexdigest() != file.sha256:
        raise DownloadError(
            f"{shown(address)}: found the SHA-256 {digest.hexdigest()[:16]}…, {file.sha256[:16]}… is expected"
        )


def _cause(error: urllib.error.URLError) -> BaseException:
    return error.reason if isinstance(error.reason, BaseException) else error
