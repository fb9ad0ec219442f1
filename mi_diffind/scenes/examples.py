"""Example scenes that are installed with the package, and data of the pages that do not ship.

``mi-diffind examples FOLDER`` copies the scenes; ``mi-diffind fetch NAME`` brings data from where their makers publish
them. Each fetched file is pinned by its SHA-256, so that figures of the pages are those of the very files.
"""

import filecmp
import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import UsageError, reason
from ..core.files import irregular, replacing, shown, writable_folder, write_json

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
    """Files in a ``folder``: ``figures`` are those of the commands' ``--json``, ``text`` is printed."""

    folder: Path
    figures: dict
    text: str

    def __str__(self) -> str:
        return self.text


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
    scenes = [str(target / name) for name in names if name.suffix == ".xml" and name.parent == Path()]
    size = sum((origin / name).stat().st_size for name in names)
    figures = {"folder": str(target), "scenes": scenes, "files": len(names), "bytes": size}
    return Written(target, figures, f"{target}: {len(scenes)} scenes, {len(names)} files, {size:,} bytes")


# -- data of the pages ------------------------------------------------------------------------------------------------

#: Seconds without an answer after which a download fails.
TIMEOUT = 30.0

#: Schemes of addresses.
SCHEMES = ("https", "http")


@dataclass(frozen=True)
class Download:
    """Files to fetch: what they are, their licence, the address of their folder, and the bytes and SHA-256 of each.

    Of a material, ``maps`` is the content of a manifest of its maps (:mod:`mi_diffind.maps.source`), ``NAME.json``.
    """

    what: str
    licence: str
    base: str
    files: Mapping[str, tuple[int, str]]
    maps: dict | None = None

    @property
    def size(self) -> int:
        """Number of bytes of all files."""
        return sum(size for size, _ in self.files.values())


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
        {
            "BoomBox_baseColor.png": (2_013_853, "d63655d14c6effbd685b8b7a23e3cc9f73bd0c33e85d2b3211dff42faaed6e07"),
            "BoomBox_normal.png": (1_671_504, "c3707fd9e0bb0e0b844a0d4eeaf49554b0c40b2512284227706ad38b033131d3"),
            "BoomBox_occlusionRoughnessMetallic.png": (
                3_181_970,
                "04feedd2189fc4f1f83d9c05fb0a7d7da0c27d80f7a31eacdd37d8682776f81b",
            ),
        },
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
        {
            "brick_base_gray.jpg": (1_095_294, "4a228efc9f4a42a4c23d71ab3b880a3beb26f9f403208122b855de05e9022dee"),
            "brick_normal.jpg": (3_690_871, "9f9be6b8eb54c50c0c875762e9493c8672f3a62b89bef4635ac3868debf7f55d"),
            "brick_roughness.jpg": (849_467, "00cd23d5d58729039dc00e73169fafaf9bae32472d3ea415abc2c4dbe5246f81"),
        },
        {"albedo": "brick_base_gray.jpg", "normal": "brick_normal.jpg", "roughness": "brick_roughness.jpg"},
    ),
    "armadillo": Download(
        "mesh of 52,000 triangles, watertight",
        "Stanford's terms: for research, not for commerce; as CGAL publishes it",
        _CGAL,
        {"armadillo.off": (1_622_939, "6f7f3ca1abc506569466b72f2f59d49493a284e7376d7a7e23c08115ec8cec4e")},
    ),
    "bunny": Download(
        "mesh of 75,408 triangles, watertight",
        "Stanford's terms: for research, not for commerce; as CGAL publishes it",
        _CGAL,
        {"bunny00.off": (2_613_072, "ab651cb04955c161efaeb079035a1e5e1f0e0d1f816a2df67beaea68f393ff2b")},
    ),
}


def fetch(
    names: str | Iterable[str],
    folder: str | os.PathLike = "data",
    base: str | None = None,
    progress: Callable[[str], None] | None = None,
) -> Written:
    """Fetch the files of ``names``, of :data:`DOWNLOADS`, into ``folder/NAME``, and return what is there.

    A material gets a manifest, ``NAME.json``. Files that are there and have the right SHA-256 stay. ``base``: another
    address, of a mirror, that ends in a folder of the files of each name. ``progress`` is called with a line for each
    file to fetch. Raises :class:`UsageError` and :class:`.OutputError`; no unfinished file stays.
    """
    names = tuple(dict.fromkeys([names] if isinstance(names, str) else names))
    if unknown := next((name for name in names if name not in DOWNLOADS), None):
        raise UsageError(f'data "{unknown}": is not known, allowed are {", ".join(DOWNLOADS)}')
    if base is not None and base.partition(":")[0] not in SCHEMES:
        raise UsageError(f'address "{base}": found no http, an address like "https://host/folder" is needed')
    target, paths, loaded = writable_folder(folder, create=True), [], 0
    for name in names:
        each, place = DOWNLOADS[name], writable_folder(target / name, create=True)
        beginning = each.base if base is None else f"{base.rstrip('/')}/{name}"
        for file, (size, sha256) in each.files.items():
            paths.append(path := place / file)
            if os.path.lexists(path):
                fault = irregular(path) or ("is a folder" if path.is_dir() else "")
                if fault or hashlib.sha256(path.read_bytes()).hexdigest() != sha256:
                    fault = fault or "is another file of that name"
                    raise UsageError(f"{shown(path)}: {fault}; move it away and try again")
                continue
            address = f"{beginning}/{file}"
            if progress is not None:
                progress(f"{address} ({size:,} bytes)")
            with replacing(path) as temporary:
                _load(address, sha256, temporary)
            loaded += 1
        if each.maps is not None:
            paths.append(place / f"{name}.json")
            if not os.path.lexists(paths[-1]):
                write_json(paths[-1], {"maps": each.maps})
    listed = [str(path) for path in paths]
    text = f"{target}: {len(listed)} files, {loaded} fetched, SHA-256 as expected"
    figures = {"folder": str(target), "names": names, "files": listed, "loaded": loaded}
    return Written(target, figures, "\n".join([text, *listed]))


def _load(address: str, sha256: str, path: Path) -> None:
    """Write the file at an address to ``path``. Raises :class:`UsageError`."""
    import pooch

    try:
        pooch.HTTPDownloader(timeout=TIMEOUT)(address, str(path), None)
    except (OSError, ValueError) as e:  # of requests
        raise UsageError(f"{shown(address)}: cannot be fetched: {reason(e)}") from None
    if (digest := pooch.file_hash(str(path))) != sha256:
        raise UsageError(f"{shown(address)}: found the SHA-256 {digest[:16]}…, {sha256[:16]}… is expected")
