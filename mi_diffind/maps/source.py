"""Sources of a compression: one image, or the maps of a material that a JSON manifest lists.

A manifest gives the name and the file of each map, relative to the manifest's folder::

    {"maps": {"albedo": "base.png",
              "normal": {"file": "n.png", "color_space": "linear"},
              "roughness": {"file": "orm.png", "channels": "g"},
              "ao": {"file": "orm.png", "channels": "r"}}}

or is the content of ``"maps"`` alone. ``channels`` are letters among ``r``, ``g``, ``b`` and ``a``, or a list of
indices (needed for a multi-channel EXR). Images are read by ``mitsuba.Bitmap``: PNG, JPEG, EXR, HDR, PFM, BMP, TGA. No
variant of Mitsuba has to be set.

The name of a map, or if it is unknown that of its file, tells its role and color space (:mod:`.names`). What had to be
guessed is in the notes of a :class:`Source`.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.archives import Allowance, LimitError, json_bytes
from ..core.errors import DiffindError, reason
from ..core.files import MOST_TEXT, OutsideError, RecordedKeys, path_by_name, unused_note
from ..images.reader import DEPTHS, ENCODED, MAX_CHANNELS, Picture, PictureError, read_file, read_picture

#: Roles of maps.
ROLES = ("albedo", "normal", "roughness", "ao", "metallic", "other")

#: Words before the others that name a further lobe: its colour is no albedo, its roughness not that of the material.
LOBES = {
    *("sheen", "specular", "spec", "coat", "clearcoat", "emission", "emissive", "subsurface", "transmission", "detail"),
    *("fuzz", "edge", "attenuation", "iridescence", "film", "volume"),
}

#: Words at the end that say nothing of the content, beside numbers and resolutions.
IGNORED = {"map", "texture", "tex", "jpg", "jpeg", "png", "exr", "tif", "tiff", "tga", "lod", "var", "udim"}

_WORD = re.compile(r"\d+[kK](?![a-zA-Z])|[dD]3[dD]|[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")


@dataclass(frozen=True)
class Content:
    """Content of a map: its ``role`` (:data:`ROLES`).

    ``colours``: values are colours, sRGB in images of 8 and 16 bits; ``packed``: channels are maps of their own;
    ``y_down``: normals of DirectX.
    """

    role: str
    colours: bool = False
    packed: bool = False
    y_down: bool = False


_NORMALS = ("normal", "normals", "normalmap", "nrm", "nor", "norm")

#: Content → names of maps. Normal maps may have an end that tells whether y points down, as in DirectX.
_NAMES = {
    Content("albedo", colours=True): "albedo basecolor basecolour base basemap diff diffuse diffusecolor diffusecolour "
    "color colour col maintex albedotransparency",
    Content("roughness"): "roughness rough specularroughness",
    Content("ao"): "ao occlusion ambientocclusion mixedao",
    Content("metallic"): "metallic metalness metal basemetalness",
    Content("other", colours=True): "emissive emission emit translucency speccolor specularcolor",
    Content("other"): "data alpha opacity mask height disp displacement bump cavity curvature thickness spec specular "
    "gloss glossiness smoothness anisotropy transmission parallax refl",
    Content("other", packed=True): "arm orm rma mra mro metallicroughness metalrough occlusionroughnessmetallic "
    "metallicsmoothness metallicgloss maskmap",
    **{
        Content("normal", y_down=down): " ".join(name + end for name in _NORMALS for end in ends)
        for down, ends in ((False, ("", "gl", "ogl", "opengl")), (True, ("dx", "directx", "d3d")))
    },
}
_CONTENTS = {name: content for content, names in _NAMES.items() for name in names.split()}

#: Most words of a name of :data:`_CONTENTS`.
_LONGEST = 3


def content_of(name: str) -> Content | None:
    """Return the content of a map by its name, or by the name of its file without an extension; ``None`` if unknown."""
    words = [word.lower() for word in _WORD.findall(name)]
    for ignored in (False, True):  # "maskmap" is a name, the "map" of "normal_map" is not
        while ignored and words and (words[-1] in IGNORED or words[-1][0].isdigit()):
            words.pop()
        for count in range(min(_LONGEST, len(words)), 0, -1):
            text = "".join(words[-count:])
            content = _CONTENTS.get(text) or _CONTENTS.get(text.removesuffix("texture").removesuffix("map"))
            if content is not None:
                further = LOBES.intersection(words[:-count])
                return Content("other", content.colours) if further else content
    return None


COLOR_SPACES = ("srgb", "linear")
NONFINITE = ("error", "clean")

#: Largest distance of a normal's length from 1.
_NORMAL_LENGTH = 0.15

#: Least share of normals among the texels of an image that looks like a normal map.
_LOOKS_NORMAL = 0.95

#: Least share of normals among the texels of an image that has the name of a normal map.
_NAMED_NORMAL = 0.5

#: Content of images without a name, and of maps with an unknown one.
_COLOURS = Content("albedo", colours=True)
_UNKNOWN = Content("other")


class SourceError(DiffindError, ValueError):
    """A source cannot be used; the message is one sentence that names the file and the fault."""


@dataclass(frozen=True, eq=False)
class Map:
    """One map of a material.

    - ``values``: ``(height, width, channels)``, float32, in the encoding of ``file`` (bytes divided by 255, 16-bit
      numbers by 65535).
    - ``color_space``: ``"srgb"`` if they carry the sRGB transfer function, else ``"linear"``.
    - ``role``: one of :data:`ROLES`; ``depth``: bytes of a channel in the source (1, 2 or 4).
    """

    name: str
    values: np.ndarray
    color_space: str
    role: str
    depth: int
    file: str = ""

    @property
    def channels(self) -> int:
        return self.values.shape[2]


@dataclass(frozen=True, eq=False)
class Source:
    """The ``maps`` of an image or material, all of ``height`` × ``width`` texels, with at most 16 channels together.

    ``digest`` is a SHA-256 over their names, layout and values; ``cleaned`` counts the NaN and infinite values that
    were replaced. ``notes`` are sentences about what was guessed, changed or not used, for people.
    """

    maps: tuple[Map, ...]
    height: int
    width: int
    digest: str
    cleaned: int = 0
    notes: tuple[str, ...] = ()

    @property
    def channels(self) -> int:
        """Channels of all maps together."""
        return sum(m.channels for m in self.maps)

    @property
    def texels(self) -> int:
        return self.height * self.width

    @property
    def nbytes(self) -> int:
        """Uncompressed bytes, each channel at its depth in the source."""
        return self.texels * sum(m.channels * m.depth for m in self.maps)


def load_source(source, nonfinite: str = "error", named: bool = True) -> Source:
    """Read an image or a manifest (``.json``), or take the maps that ``source`` holds in memory.

    In memory, ``source`` is a :class:`Source`, an image (an array ``(height, width, channels)`` or a ``mi.Bitmap``), or
    a dictionary of such images and of image files by the name of the map (:func:`from_arrays`).

    An image is a map called ``"image"`` and, if it has an alpha channel, a map ``"alpha"``. It is sRGB if it is grey or
    RGB of 8 or 16 bits, unless the name of its file is that of data, such as normals (``named``: names of images count,
    else they are colours). A map of a manifest is by default sRGB if its name is that of colours and it has 8 or 16
    bits and 1 or 3 channels. Its alpha channel is left out if it is 1 everywhere, else ``channels`` is needed. A
    roughness, AO or metallic map with three equal channels keeps one. Normals of DirectX in a manifest become those of
    OpenGL.

    NaN and infinite values are an error. With ``nonfinite="clean"`` NaN becomes 0 and infinity the largest (negative:
    the smallest) finite value of the channel, 0 if there is none. Raises :class:`SourceError`.
    """
    if isinstance(source, Source):
        return source
    if isinstance(source, dict):
        return from_arrays(source, nonfinite=nonfinite)
    color_space = None
    if not isinstance(source, (str, os.PathLike)):
        where = "the image"
        image, color_space = _in_memory(source, where)
    elif (path := Path(source)).suffix.lower() == ".json":
        return _load_manifest(path, nonfinite)
    else:
        image, where = _read(path), path
    values, content, notes = image.values[:, :, : image.colors], _COLOURS if image.named else _UNKNOWN, []
    if named and image.named and isinstance(where, Path):
        content, notes = _content_of_image(where, values)
    maps = [_RawMap("image", _one_of_equal(values, content.role), content, str(where), color_space)]
    if image.has_alpha:
        maps.append(_RawMap("alpha", image.values[:, :, image.colors :], _UNKNOWN, str(where)))
    return _assemble(maps, where, nonfinite, notes)


def _content_of_image(path: Path, values: np.ndarray) -> tuple[Content, list[str]]:
    """Return the content of a single image by the name of its file, and what has to be said about it.

    A name of data counts only where the values can be that: three equal channels, or unit normals.
    """
    content, share = content_of(path.stem) or _COLOURS, _share_of_normals(values)
    if content.colours:
        looks = f'{path.name}: looks like a normal map, but is taken for colours: a manifest may call it "normal"'
        return _COLOURS, [looks] if share > _LOOKS_NORMAL else []
    described = {"other": "data", "ao": "an AO map"}.get(content.role, f"a {content.role} map")
    fits = (
        share > _NAMED_NORMAL if content.role == "normal" else content.packed or values.shape[2] == 1 or _equal(values)
    )
    if not fits:
        return _COLOURS, [f"{path.name}: has the name of {described}, but the values of colours, which it is taken for"]
    down = "; y points down (DirectX), Mitsuba expects OpenGL" if content.y_down else ""
    return content, [f"{path.name}: taken for {described} by its name, linear{down}"]


def from_arrays(arrays: dict, color_spaces: dict[str, str] | None = None, nonfinite: str = "error") -> Source:
    """Return a source of maps by name: arrays ``(height, width)`` or ``(height, width, channels)``, or images.

    Arrays are of NumPy or Dr.Jit, of 8- or 16-bit unsigned integers or floats. An image is a ``mi.Bitmap`` or an image
    file, and must not be transparent. ``color_spaces`` (name → ``"srgb"`` or ``"linear"``) replaces the defaults, which
    are a manifest's, or those that a bitmap states; ``"image"`` of 1 or 3 channels counts as an albedo. ``nonfinite``
    is that of :func:`load_source`. Raises :class:`SourceError`.
    """
    color_spaces = dict(color_spaces or {})
    maps = []
    for name, array in arrays.items():
        where = f'array "{name}"'
        _check_name("arrays", name)
        file = isinstance(array, (str, os.PathLike))
        image, stated = (_read(Path(array)), None) if file else _in_memory(array, where)
        values = _opaque(image, where)
        content = content_of(name)
        if name == "image" and values.shape[2] in (1, 3):
            content = _COLOURS
        color_space = color_spaces.pop(name, stated)
        if color_space is not None and color_space not in COLOR_SPACES:
            raise SourceError(f'{where}: has the color space "{color_space}", allowed are {COLOR_SPACES}')
        content = content or _UNKNOWN
        maps.append(_RawMap(name, _one_of_equal(values, content.role), content, "", color_space))
    if color_spaces:
        raise SourceError(f'arrays: a color space is given for "{next(iter(color_spaces))}", which is not among them')
    return _assemble(maps, "arrays", nonfinite)


def _load_manifest(path: Path, nonfinite: str) -> Source:
    """Read a manifest and its images. Raises :class:`SourceError`."""
    try:
        data = read_file(path, MOST_TEXT)
        Allowance(path).check(json_bytes(data), "a manifest")
        content = json.loads(data.decode("utf-8-sig"), object_pairs_hook=_unique)
    except (LimitError, PictureError) as e:
        raise SourceError(str(e)) from None
    except (ValueError, RecursionError) as e:
        raise SourceError(f"{path}: is not valid JSON ({reason(e)})") from None
    entries = content["maps"] if isinstance(content, dict) and "maps" in content else content
    if not isinstance(entries, dict) or not entries:
        raise SourceError(f"{path}: has no maps, expected an object that gives each map's name a file")

    if len(entries) > MAX_CHANNELS:  # of one channel or more, each an image in memory
        raise SourceError(f"{path}: has {len(entries):,} maps, at most {MAX_CHANNELS} channels in all are supported")
    maps, images = [], {}
    for name, entry in entries.items():
        _check_name(path, name)
        where = f'{path}: map "{name}"'
        entry = {"file": entry} if isinstance(entry, str) else entry
        known = isinstance(entry, dict) and entry.keys() <= {"file", "channels", "color_space"}
        if not known or not isinstance(entry.get("file"), str) or not entry["file"]:
            allowed = 'a file name, or an object with "file" and perhaps "channels" and "color_space"'
            raise SourceError(f"{where} is {entry!r:.80}, expected {allowed}")
        color_space = entry.get("color_space")
        if color_space is not None and color_space not in COLOR_SPACES:
            raise SourceError(f"{where} has the color space {color_space!r:.40}, allowed are {COLOR_SPACES}")
        try:
            file = path_by_name(path.parent, entry["file"], path)
        except OutsideError as e:
            raise SourceError(str(e)) from None
        if file not in images:
            images[file] = _read(file)
        content_of_map = content_of(name)
        if "channels" in entry:
            values = _select(images[file], entry["channels"], where)
        else:
            values = _opaque(images[file], where)
            content_of_map = content_of_map or content_of(file.stem)
            values = _one_of_equal(values, content_of_map.role if content_of_map else "")
        maps.append(_RawMap(name, values, content_of_map or _UNKNOWN, str(file), color_space))
    note = unused_note(path, content)
    return _assemble(maps, path, nonfinite, [note] if note else [])


def _unique(pairs: list) -> dict:
    """Return an object of a JSON file. Raises ``ValueError`` if a key comes twice."""
    result = RecordedKeys(pairs)
    if len(result) < len(pairs):
        keys = [key for key, _ in pairs]
        raise ValueError(f'the key "{next(key for key in keys if keys.count(key) > 1)}" comes twice')
    return result


def _select(picture: Picture, channels, where: str) -> np.ndarray:
    """Return the values of ``channels`` of a manifest; grey is red, green and blue at once."""
    count = picture.values.shape[2]
    if isinstance(channels, str) and channels and picture.named:
        letters = {"r": 0, "g": 1 % picture.colors, "b": 2 % picture.colors}
        if picture.has_alpha:
            letters["a"] = picture.colors
        indices = [letters.get(letter) for letter in channels]
        allowed = f"letters among {''.join(letters)}"
    else:
        indices = channels if isinstance(channels, list) and channels else [None]
        indices = [i if type(i) is int and 0 <= i < count else None for i in indices]
        allowed = f"a list of indices from 0 to {count - 1}"
    if None in indices:
        raise SourceError(f"{where} has the channels {channels!r:.40}, allowed for its file are {allowed}")
    if len(set(channels)) < len(channels):
        raise SourceError(f"{where} has the channels {channels!r:.40}, one of them twice")
    return picture.values[:, :, indices]


def _opaque(picture: Picture, where: str) -> np.ndarray:
    """Return the colours. Raises :class:`SourceError` for transparency, which would be lost."""
    colors, alpha = picture.values[:, :, : picture.colors], picture.values[:, :, picture.colors :]
    one = np.iinfo(alpha.dtype).max if alpha.dtype.kind == "u" else 1
    if picture.has_alpha and (alpha != one).any():
        raise SourceError(
            f'{where} is from a file with transparency: "channels" is needed ("rgb", and "a" for a map of its own)'
        )
    return colors


def _read(path: Path) -> Picture:
    """Read an image file. Raises :class:`SourceError`."""
    try:
        return read_picture(path)
    except PictureError as e:
        raise SourceError(str(e)) from None


def _in_memory(array, where: str) -> tuple[Picture, str | None]:
    """Return an array or a ``mi.Bitmap`` as a picture, and its color space if it states one."""
    bitmap = hasattr(array, "pixel_format")
    values = array.numpy() if hasattr(array, "numpy") and not bitmap else np.array(array)
    if values.dtype.name not in DEPTHS or values.dtype.name == "uint32":
        raise SourceError(f"{where}: has the type {values.dtype}, allowed are uint8, uint16 and floats up to float64")
    if values.ndim not in (2, 3) or values.size == 0:
        raise SourceError(f"{where}: has the shape {values.shape}, expected (height, width, channels), none of them 0")
    if bitmap:
        # Bitmaps of 8 bits are sRGB unless somebody says otherwise: the map's name decides
        return Picture.from_bitmap(array), None if array.srgb_gamma() and values.dtype.name in ENCODED else "linear"
    values = values.reshape(*values.shape[:2], -1)
    return Picture(values, ("",) * values.shape[2], named=values.shape[2] in (1, 3)), None


@dataclass(frozen=True, eq=False)
class _RawMap:
    """A map in the number type of its file; without a color space it gets the default."""

    name: str
    values: np.ndarray
    content: Content
    file: str
    color_space: str | None = None


def _one_of_equal(values: np.ndarray, role: str) -> np.ndarray:
    """Return ``values``, or one of three equal channels where the role has one channel."""
    return values[:, :, :1] if role in ("roughness", "ao", "metallic") and _equal(values) else values


def _equal(values: np.ndarray) -> bool:
    """Return whether ``values`` have three equal channels."""
    nan = values.dtype.kind == "f"
    return values.shape[2] == 3 and all(np.array_equal(values[:, :, 0], values[:, :, i], equal_nan=nan) for i in (1, 2))


def _share_of_normals(values: np.ndarray) -> float:
    """Return the share of texels that are unit normals, pointing away from a surface."""
    if values.shape[2] != 3:
        return 0.0
    rows, columns = (slice(None, None, -(-n // 256)) for n in values.shape[:2])  # some texels suffice
    normals = values[rows, columns].astype(np.float32)
    if values.dtype.kind == "u":
        normals /= np.iinfo(values.dtype).max
    normals = normals if (normals < 0).any() else 2 * normals - 1  # signed, or stored as (n + 1)/2
    with np.errstate(over="ignore", invalid="ignore"):
        unit = np.abs(np.linalg.norm(normals, axis=2) - 1) < _NORMAL_LENGTH
    return float((unit & (normals[..., 2] > 0)).mean())


def _assemble(raw: list[_RawMap], where, nonfinite: str, notes: list[str] = ()) -> Source:
    """Return the source of some maps. Raises :class:`SourceError` if they do not go together."""
    if nonfinite not in NONFINITE:
        raise ValueError(f'nonfinite: found "{nonfinite}", allowed are {NONFINITE}')
    if not raw:
        raise SourceError(f"{where}: has no maps")
    first = raw[0]
    for other in raw[1:]:
        if other.values.shape[:2] != first.values.shape[:2]:
            sizes = ["{1}×{0}".format(*m.values.shape) for m in (first, other)]
            raise SourceError(
                f'{where}: map "{first.name}" has {sizes[0]} texels and map "{other.name}" {sizes[1]}, '
                f"all maps need the same size"
            )
    channels = sum(m.values.shape[2] for m in raw)
    if channels > MAX_CHANNELS:
        raise SourceError(f"{where}: has {channels} channels in all, at most {MAX_CHANNELS} are supported")

    maps, notes, cleaned = [], list(notes), 0
    digest = hashlib.sha256()
    for m in raw:
        role = m.content.role
        if role == "normal" and m.values.shape[2] == 1:
            raise SourceError(
                f'{m.file or where}: the normal map "{m.name}" has 1 channel, 3 are needed (x, y, z), or x and y alone'
            )
        number_type = m.values.dtype.name
        color_space = m.color_space
        if color_space is None:
            srgb = m.content.colours and number_type in ENCODED and m.values.shape[2] in (1, 3)
            color_space = "srgb" if srgb else "linear"
        notes += _notes_on(m)
        values = m.values
        if m.content.y_down and m.name != "image":
            # Normals of integers or floats, signed or stored as (n + 1)/2
            one = np.iinfo(values.dtype).max if values.dtype.kind == "u" else 0 if (values < 0).any() else 1
            values = values.copy()
            values[..., 1] = one - values[..., 1]
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite and is reported below
            values = values.astype("<f4", order="C")
        if number_type in ENCODED:
            values /= np.iinfo(m.values.dtype).max
        else:
            cleaned += _check_finite(values, f'{m.file or where}: map "{m.name}"', nonfinite)
        values.flags.writeable = False
        depth = DEPTHS[number_type]
        maps.append(Map(m.name, values, color_space, role, depth, m.file))
        layout = [m.name, color_space, role, depth, *values.shape]
        digest.update(json.dumps(layout).encode() + b"\n")
        digest.update(values)
    height, width = first.values.shape[:2]
    return Source(tuple(maps), height, width, digest.hexdigest(), cleaned, tuple(notes))


def _notes_on(m: _RawMap) -> list[str]:
    """Return what has to be said about a map of a manifest or of a dictionary."""
    if m.name == "image":
        return []
    if m.content.y_down:
        return [f'map "{m.name}": normals of DirectX, y is inverted to that of OpenGL, which Mitsuba expects']
    if m.content.packed and m.values.shape[2] > 1:
        return [f'map "{m.name}": holds several maps, which are kept as one: "channels" gives each a map of its own']
    if m.content.role == "other" and not m.content.colours and _share_of_normals(m.values) > _LOOKS_NORMAL:
        return [f'map "{m.name}": looks like a normal map, but is taken for other data: call it "normal"']
    if m.content is not _UNKNOWN:
        return [] if content_of(m.name) else [f'map "{m.name}": has the role {m.content.role} by the name of its file']
    colours = m.color_space is None and m.values.dtype.name in ENCODED and m.values.shape[2] == 3
    if not colours or _equal(m.values):
        return []
    return [f'map "{m.name}": an unknown name, taken for data, linear: give it "color_space": "srgb" if it is a colour']


def _check_finite(values: np.ndarray, where: str, nonfinite: str) -> int:
    """Replace NaN and infinite values in place, or raise :class:`SourceError`; returns their number."""
    bad = ~np.isfinite(values)
    count = int(bad.sum())
    if count and nonfinite == "error":
        y, x, channel = np.unravel_index(bad.argmax(), bad.shape)
        raise SourceError(
            f"{where} has {count:,} values that are NaN or infinite, the first at x = {x}, y = {y} (channel {channel})"
        )
    if count:
        for channel in np.flatnonzero(bad.any(axis=(0, 1))):
            plane = values[:, :, channel]
            finite = plane[~bad[:, :, channel]]
            low, high = (finite.min(), finite.max()) if finite.size else (0, 0)
            plane[...] = np.nan_to_num(plane, nan=0, posinf=high, neginf=low)
    return count


def _check_name(where, name) -> None:
    """Raise :class:`SourceError` for a name of a map that is no identifier."""
    if not isinstance(name, str) or not name.isidentifier():
        raise SourceError(f"{where}: a map is called {name!r:.40}, allowed are letters, digits and _ (no digit first)")
