"""Entries of a material: which image, which channels of it and which factor make up each map."""

import math
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.errors import DiffindError, raised_as
from ..core.files import OutsideError, path_by_name
from ..images.reader import Picture, PictureError, read_picture

#: Roles of maps.
ROLES = ("albedo", "normal", "roughness", "ao", "metallic", "other")

COLOR_SPACES = ("srgb", "linear")

#: Texture transform that changes nothing: the first two rows of its matrix.
IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)

#: Extensions of files that hold several materials, of which ``FILE#NAME`` names one.
SEVERAL = (".gltf", ".glb", ".mtlx")


class SourceError(DiffindError, ValueError):
    """A source cannot be used; the message is one sentence that names the file and the fault."""


@dataclass(frozen=True)
class Content:
    """Content of a map: its ``role`` (:data:`ROLES`).

    ``colours``: values are colours, sRGB in images of 8 and 16 bits; ``y_down``: normals of DirectX; ``parts``: names
    of the maps in red, green, blue and alpha, ``-`` for none, or the name of a map of another role.
    """

    role: str
    colours: bool = False
    y_down: bool = False
    parts: str = ""

    @property
    def packed(self) -> bool:
        """Whether channels are maps of their own."""
        return " " in self.parts


#: Content of images without a name, and of maps with an unknown one.
COLOURS = Content("albedo", colours=True)
UNKNOWN = Content("other")


@dataclass(frozen=True)
class MapEntry:
    """Origin of a map.

    - ``file``: path of its image, or name of an embedded one; "" for maps in memory. ``constant``: there is none, the
      values are the ``factor``, linear.
    - ``content``: content of the map, by default that of its name.
    - ``channels``: letters or indices of a manifest; ``None``: the colours. ``opaque``: any alpha is left out.
    - ``single``: the map has one channel, of three equal ones one is kept.
    - ``color_space``: ``None`` for the default.
    - ``inverted``: values are 1 minus those of the image.
    - ``factor``: factors of the channels, one or as many as there are, of colours in linear light; of a normal map the
      factor of x and y. No factors: ().
    - ``cutoff``: values below become 0, all others 1.
    - ``transform``: texture transform (:func:`to_transform`), from the surface's uv to those of the image.
    """

    name: str
    file: str = ""
    content: Content | None = None
    channels: str | list | None = None
    color_space: str | None = None
    inverted: bool = False
    factor: tuple[float, ...] = ()
    cutoff: float | None = None
    opaque: bool = False
    single: bool = False
    transform: tuple[float, ...] = IDENTITY

    constant: bool = False

    def to_json(self) -> str | dict:
        """Return the entry of a manifest in the folder of the image."""
        more = {"channels": self.channels, "invert": self.inverted or None, "factor": list(self.factor) or None}
        more = {key: value for key, value in more.items() if value is not None}
        file = Path(self.file).name
        return {"file": file, **more} if more else file


class ImageFiles:
    """Images of a source by path or name: each is read once. ``nbytes`` is the size of their files.

    ``outside``: files may lie outside of the folder of the file that names them.
    """

    def __init__(self, outside: bool = False):
        self.outside, self.nbytes = outside, 0
        self._pictures: dict[str, Picture] = {}

    def find(self, folder: Path, name: str, file: Path) -> str:
        """Return the path of the image ``name`` of a ``file``. Raises :class:`SourceError`."""
        with raised_as(SourceError, OutsideError):
            return str(path_by_name(folder, name, file, self.outside))

    def read(self, file: str) -> Picture:
        """Return an image. Raises :class:`SourceError`."""
        if file not in self._pictures:
            with raised_as(SourceError, PictureError):
                self._pictures[file] = read_picture(file)
                self.nbytes += os.stat(file).st_size
        return self._pictures[file]

    def decode(self, name: str, data: bytes) -> str:
        """Read an embedded image and return its ``name``. Raises :class:`SourceError`."""
        if name not in self._pictures:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "image"
                path.write_bytes(data)
                try:
                    self._pictures[name] = read_picture(path)
                except PictureError as e:
                    raise SourceError(str(e).replace(str(path), name)) from None
            self.nbytes += len(data)
        return name


def uv_matrix(scale=(1.0, 1.0), rotation: float = 0.0, offset=(0.0, 0.0)) -> np.ndarray:
    """Return the matrix of glTF's KHR_texture_transform, ``(3, 3)``; ``rotation`` is in radians.

    Texture coordinates are scaled, turned from the axis v towards u, and moved by ``offset``.
    """
    c, s = math.cos(rotation), math.sin(rotation)
    return np.array([[c * scale[0], s * scale[1], offset[0]], [-s * scale[0], c * scale[1], offset[1]], [0, 0, 1]])


def to_transform(matrix: np.ndarray) -> tuple[float, ...]:
    """Return a texture transform: the first two rows of a matrix, ``(3, 3)``, for v that points down."""
    return tuple(round(float(number), 12) + 0.0 for number in matrix[:2].ravel())


def describe_transform(transform: tuple[float, ...]) -> str:
    """Return a texture transform as text, "" for none."""
    rows = (" ".join(f"{number:.4g}" for number in transform[i : i + 3]) for i in (0, 3))
    return "" if transform == IDENTITY else f"uv transform [{', '.join(rows)}]"


def split_material(source: str | os.PathLike) -> tuple[Path, str]:
    """Return the file of a source, and the name of the material in ``FILE#NAME``, "" without one."""
    file, mark, name = os.fspath(source).partition("#")
    while mark and Path(file).suffix.lower() not in SEVERAL:
        more, mark, name = name.partition("#")
        file = f"{file}#{more}"
    return (Path(source), "") if not mark or os.path.lexists(source) else (Path(file), name)


def has_maps(source: str | os.PathLike) -> bool:
    """Return whether a source holds maps by name: a manifest, a folder, or a file of materials."""
    path = split_material(source)[0]
    return path.suffix.lower() in (".json", *SEVERAL) or os.path.isdir(path)


def choose_material(path: Path, names: list[str], name: str) -> int:
    """Return the index of the material called ``name``, or of the only one. Raises :class:`SourceError`."""
    if not names:
        raise SourceError(f"{path}: has no materials")
    listed = ", ".join(names[:20]) + (f" and {len(names) - 20:,} more" if len(names) > 20 else "")
    if not name and len(names) > 1:
        raise SourceError(f"{path}: has {len(names)} materials, name one as {path.name}#NAME: {listed}")
    if name and names.count(name) != 1:
        fault = f"{names.count(name)} materials" if name in names else "no material"
        raise SourceError(f'{path}: has {fault} called "{name}", the names are {listed}')
    return names.index(name) if name else 0


def equal(values: np.ndarray) -> bool:
    """Return whether ``values`` have three equal channels."""
    nan = values.dtype.kind == "f"
    return values.shape[2] == 3 and all(np.array_equal(values[:, :, 0], values[:, :, i], equal_nan=nan) for i in (1, 2))


def transparent(picture: Picture) -> bool:
    """Return whether a picture has an alpha that is not 1 everywhere."""
    alpha = picture.values[:, :, picture.colors :]
    one = np.iinfo(alpha.dtype).max if alpha.dtype.kind == "u" else 1
    return picture.has_alpha and bool((alpha != one).any())
