"""Sources of a compression: one image, or the maps of a material.

A material is a folder of maps (:mod:`.names`), a material of a glTF (:mod:`.gltf`) or MaterialX file
(:mod:`.materialx`), or a manifest, which gives the name and the file of each map, relative to its folder::

    {"maps": {"albedo": "base.png",
              "normal": {"file": "n.png", "color_space": "linear"},
              "roughness": {"file": "gloss.png", "invert": true},
              "metallic": {"file": "orm.png", "channels": "b", "factor": 0.5},
              "ao": {"file": "orm.png", "channels": "r"}}}

or is the content of ``"maps"`` alone. ``channels`` are letters among ``r``, ``g``, ``b`` and ``a``, or a list of
indices (needed for a multi-channel EXR); ``invert`` takes 1 minus the values; ``factor`` multiplies them, colours in
linear light, of a normal map x and y. Images are read by ``mitsuba.Bitmap``: PNG, JPEG, EXR, HDR, PFM, BMP, TGA. No
variant of Mitsuba has to be set.

The name of a map, or if it is unknown that of its file, tells its role and color space (:mod:`.names`). What had to be
guessed is in the notes of a :class:`Source`.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..core.archives import Allowance, LimitError, json_bytes
from ..core.errors import reason
from ..core.files import MOST_TEXT, RecordedKeys, shown, unused_note
from ..images import srgb
from ..images.reader import DEPTHS, ENCODED, MAX_CHANNELS, Picture, PictureError, read_file
from .entries import (
    COLOR_SPACES,
    COLOURS,
    IDENTITY,
    UNKNOWN,
    Content,
    ImageFiles,
    MapEntry,
    SourceError,
    describe_transform,
    equal,
    split_material,
    transparent,
)  # fmt: skip
from .gltf import read_gltf
from .materialx import read_materialx
from .names import content_of, read_folder

NONFINITE = ("error", "clean")

#: Largest distance of a normal's length from 1.
_NORMAL_LENGTH = 0.15

#: Least share of normals among the texels of an image that looks like a normal map.
_LOOKS_NORMAL = 0.95

#: Least share of normals among the texels of an image that has the name of a normal map.
_NAMED_NORMAL = 0.5

#: Largest ratio of the texels of all maps of a model, in one size, to those of its largest image.
MOST_GROWTH = 16

#: Largest magnitude of a factor.
MOST_FACTOR = 1e6

#: Keys of a map in a manifest.
KEYS = ("file", "channels", "color_space", "invert", "factor")


@dataclass(frozen=True, eq=False)
class Map:
    """One map of a material.

    - ``values``: ``(height, width, channels)``, float32, in the encoding of ``file`` (bytes divided by 255, 16-bit
      numbers by 65535).
    - ``color_space``: ``"srgb"`` if they carry the sRGB transfer function, else ``"linear"``.
    - ``role``: one of :data:`.entries.ROLES`; ``depth``: bytes of a channel in the source: 1, 2 or 4, 0 for a constant
      without an image; ``transform``: its texture transform (:class:`.entries.MapEntry`).
    """

    name: str
    values: np.ndarray
    color_space: str
    role: str
    depth: int
    file: str = ""
    transform: tuple[float, ...] = IDENTITY

    @property
    def channels(self) -> int:
        return self.values.shape[2]


@dataclass(frozen=True, eq=False)
class Source:
    """The ``maps`` of an image or material, all of ``height`` × ``width`` texels, with at most 16 channels together.

    ``digest`` is a SHA-256 over their names, layout and values; ``cleaned`` counts the NaN and infinite values that
    were replaced. ``notes`` are sentences about what was guessed, changed or not used, for people; ``origins`` say of
    which file and channels each map is made, and how; ``file_nbytes`` are the bytes of these files (0: none).
    ``double_sided``: the material reflects on both sides.
    """

    maps: tuple[Map, ...]
    height: int
    width: int
    digest: str
    cleaned: int = 0
    notes: tuple[str, ...] = ()
    origins: tuple[dict[str, str], ...] = ()
    file_nbytes: int = 0
    double_sided: bool = False

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


def load_source(
    source, nonfinite: str = "error", named: bool = True, outside: bool = False, constant: bool = False
) -> Source:
    """Read an image or a material, or take the maps that ``source`` holds in memory.

    A material is a manifest (``.json``), a folder of maps, or a material of a glTF or MaterialX file (``.gltf``,
    ``.glb``, ``.mtlx``), ``FILE#NAME`` if there are several. In memory, ``source`` is a :class:`Source`, an image (an
    array ``(height, width, channels)`` or a ``mi.Bitmap``), or a dictionary of such images and of image files by the
    name of the map (:func:`from_arrays`). Images of a material may lie anywhere with ``outside``, for a file that the
    user has named, else in the folder of the file that names them. A material without images is refused, unless it may
    be ``constant``: its maps then have one texel.

    An image is a map called ``"image"`` and, if it has an alpha channel, a map ``"alpha"``. It is sRGB if it is grey or
    RGB of 8 or 16 bits, unless the name of its file is that of data, such as normals (``named``: names of images count,
    else they are colours). A map of a material is by default sRGB if its name is that of colours and it has 8 or 16
    bits and 1 or 3 channels. In a manifest, its alpha channel is left out if it is 1 everywhere, else ``channels`` is
    needed. A roughness, AO or metallic map with three equal channels keeps one. Normals of DirectX become those of
    OpenGL. Smaller maps get the size of the largest by linear interpolation, colours in linear light; those of a model
    may differ in the ratio of width and height.

    NaN and infinite values are an error. With ``nonfinite="clean"`` NaN becomes 0 and infinity the largest (negative:
    the smallest) finite value of the channel, 0 if there is none. Raises :class:`SourceError`.
    """
    if isinstance(source, Source):
        return source
    if isinstance(source, dict):
        return from_arrays(source, nonfinite=nonfinite)
    images, notes, content = ImageFiles(outside), [], COLOURS
    if not isinstance(source, (str, os.PathLike)):
        where = "the image"
        image, color_space = _in_memory(source, where)
        content = COLOURS if image.named else UNKNOWN
    else:
        where, name = split_material(source)
        readers = {".json": _read_manifest, ".gltf": read_gltf, ".glb": read_gltf, ".mtlx": read_materialx}
        if os.path.isdir(where):
            return _load(where, *read_folder(where, images), images, nonfinite)
        if where.suffix.lower() in readers:
            entries, notes, double_sided = readers[where.suffix.lower()](where, name, images)
            if not constant and all(entry.constant for entry in entries):
                raise SourceError(f"{shown(where)}: its material has no images that are read, there is nothing to fit")
            source = _load(where, entries, notes, images, nonfinite, where.suffix.lower() != ".json")
            return replace(source, double_sided=double_sided)
        image, color_space = images.read(str(where)), None
        values, content = image.values[:, :, : image.colors], COLOURS if image.named else UNKNOWN
        if named and image.named:
            content, notes = _content_of_image(where, values)
    values = _one_of_equal(image.values[:, :, : image.colors], content.role)
    maps = [_RawMap(values, MapEntry("image", str(where), content, color_space=color_space))]
    if image.has_alpha:
        maps.append(_RawMap(image.values[:, :, image.colors :], MapEntry("alpha", str(where), UNKNOWN)))
    return _assemble(maps, where, nonfinite, notes, images.nbytes)


def _load(
    path: Path, entries: list[MapEntry], notes: list[str], images: ImageFiles, nonfinite: str, any_ratio: bool = False
) -> Source:
    """Read the images of a material. Raises :class:`SourceError`."""
    if len(entries) > MAX_CHANNELS:  # of one channel or more, each an image in memory
        raise SourceError(f"{path}: has {len(entries):,} maps, at most {MAX_CHANNELS} channels in all are supported")
    maps = []
    for entry in entries:
        where, content = f'{path}: map "{entry.name}"', entry.content or content_of(entry.name)
        for described, numbers in (("factors", entry.factor), ("texture transform", entry.transform)):
            if not all(abs(number) <= MOST_FACTOR for number in numbers):  # NaN, too
                raise SourceError(f"{where} has the {described} {numbers}, allowed are numbers up to {MOST_FACTOR:,g}")
        if entry.constant:
            values = np.array(entry.factor, np.float32).reshape(1, 1, -1)
            maps.append(_RawMap(values, replace(entry, content=content, factor=())))
            continue
        picture = images.read(entry.file)
        if entry.channels is not None:
            values = _select(picture, entry.channels, where)
        else:
            values = picture.values[:, :, : picture.colors] if entry.opaque else _opaque(picture, where)
            content = content or content_of(Path(entry.file).stem)
        content = content or UNKNOWN
        if entry.channels is None or entry.single:
            values = _one_of_equal(values, "roughness" if entry.single else content.role)
        if len(entry.factor) not in (0, 1, 1 if content.role == "normal" else values.shape[2]):
            count = 1 if content.role == "normal" else values.shape[2]
            raise SourceError(f"{where} has {len(entry.factor)} factors, allowed are 1 or {count}")
        maps.append(_RawMap(values, replace(entry, content=content)))
    return _assemble(maps, path, nonfinite, notes, images.nbytes, any_ratio)


def _content_of_image(path: Path, values: np.ndarray) -> tuple[Content, list[str]]:
    """Return the content of a single image by the name of its file, and what has to be said about it.

    A name of data counts only where the values can be that: three equal channels, or unit normals.
    """
    content, share = content_of(path.stem) or COLOURS, _share_of_normals(values)
    if content.colours:
        looks = f'{path.name}: looks like a normal map, but is taken for colours: a manifest may call it "normal"'
        return COLOURS, [looks] if share > _LOOKS_NORMAL else []
    described = {"other": "data", "ao": "an AO map"}.get(content.role, f"a {content.role} map")
    fits = (
        share > _NAMED_NORMAL if content.role == "normal" else content.packed or values.shape[2] == 1 or equal(values)
    )
    if not fits:
        return COLOURS, [f"{path.name}: has the name of {described}, but the values of colours, which it is taken for"]
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
    maps, images = [], ImageFiles()
    for name, array in arrays.items():
        where = f'array "{name}"'
        _check_name("arrays", name)
        file = isinstance(array, (str, os.PathLike))
        image, stated = (images.read(str(array)), None) if file else _in_memory(array, where)
        values = _opaque(image, where)
        content = content_of(name)
        if name == "image" and values.shape[2] in (1, 3):
            content = COLOURS
        color_space = color_spaces.pop(name, stated)
        if color_space is not None and color_space not in COLOR_SPACES:
            raise SourceError(f'{where}: has the color space "{color_space}", allowed are {COLOR_SPACES}')
        content = content or UNKNOWN
        entry = MapEntry(name, content=content, color_space=color_space)
        maps.append(_RawMap(_one_of_equal(values, content.role), entry))
    if color_spaces:
        raise SourceError(f'arrays: a color space is given for "{next(iter(color_spaces))}", which is not among them')
    return _assemble(maps, "arrays", nonfinite)


def _read_manifest(path: Path, _: str, images: ImageFiles) -> tuple[list[MapEntry], list[str], bool]:
    """Return the maps of a manifest, notes on its content, and no second side. Raises :class:`SourceError`."""
    try:
        data = read_file(path, MOST_TEXT)
        Allowance(path).check(json_bytes(data), "a manifest")
        content = json.loads(data.decode("utf-8-sig"), object_pairs_hook=_unique)
    except (LimitError, PictureError) as e:
        raise SourceError(str(e)) from None
    except (ValueError, RecursionError) as e:
        raise SourceError(f"{path}: is not valid JSON ({reason(e)})") from None
    maps = content["maps"] if isinstance(content, dict) and "maps" in content else content
    if not isinstance(maps, dict) or not maps:
        raise SourceError(f"{path}: has no maps, expected an object that gives each map's name a file")
    entries = []
    for name, entry in maps.items():
        _check_name(path, name)
        where = f'{path}: map "{name}"'
        entry = {"file": entry} if isinstance(entry, str) else entry
        known = isinstance(entry, dict) and entry.keys() <= set(KEYS)
        if not known or not isinstance(entry.get("file"), str) or not entry["file"]:
            further = ", ".join(f'"{key}"' for key in KEYS[1:])
            allowed = f'a file name, or an object with "file" and perhaps {further}'
            raise SourceError(f"{where} is {entry!r:.80}, expected {allowed}")
        color_space, inverted = entry.get("color_space"), entry.get("invert", False)
        if color_space is not None and color_space not in COLOR_SPACES:
            raise SourceError(f"{where} has the color space {color_space!r:.40}, allowed are {COLOR_SPACES}")
        if not isinstance(inverted, bool):
            raise SourceError(f"{where} has invert {inverted!r:.40}, allowed are true and false")
        factor = entry.get("factor", [])
        factor = factor if isinstance(factor, list) else [factor]
        if not all(type(f) in (int, float) and abs(f) <= MOST_FACTOR for f in factor):
            raise SourceError(f"{where} has the factor {entry['factor']!r:.40}, allowed are finite numbers")
        channels = entry.get("channels")
        if channels is None and "channels" in entry:
            raise SourceError(f"{where} has the channels null, allowed are letters or a list of indices")
        file = images.find(path.parent, entry["file"], path)
        entries.append(MapEntry(name, file, None, channels, color_space, inverted, tuple(map(float, factor))))
    note = unused_note(path, content)
    return entries, [note] if note else [], False


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
    if transparent(picture):
        raise SourceError(
            f'{where} is from a file with transparency: "channels" is needed ("rgb", and "a" for a map of its own)'
        )
    return picture.values[:, :, : picture.colors]


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
    """Values of a map in the number type of its file, and its ``entry``, which has a content."""

    values: np.ndarray
    entry: MapEntry

    @property
    def content(self) -> Content:
        return self.entry.content


def _one_of_equal(values: np.ndarray, role: str) -> np.ndarray:
    """Return ``values``, or one of three equal channels where the role has one channel."""
    return values[:, :, :1] if role in ("roughness", "ao", "metallic") and equal(values) else values


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


def _assemble(
    raw: list[_RawMap], where, nonfinite: str, notes: list[str] = (), file_nbytes: int = 0, any_ratio: bool = False
) -> Source:
    """Return the source of some maps, with ``any_ratio`` of different ratios of width and height.

    Raises :class:`SourceError` if they do not go together.
    """
    if nonfinite not in NONFINITE:
        raise ValueError(f'nonfinite: found "{nonfinite}", allowed are {NONFINITE}')
    if not raw:
        raise SourceError(f"{where}: has no maps")
    largest = max(raw, key=lambda m: math.prod(m.values.shape[:2]) - m.entry.constant)
    height, width = largest.values.shape[:2]
    sides = [max(m.values.shape[i] for m in raw) for i in (0, 1)]
    any_ratio &= math.prod(sides) <= MOST_GROWTH * height * width
    if any_ratio:  # each covers the unit square of the texture coordinates
        height, width = sides
    for other in () if any_ratio else raw:
        rows, columns = other.values.shape[:2]
        if rows * width != columns * height and rows * columns > 1:
            both = [
                'map "{}" has {}×{} texels'.format(m.entry.name, *m.values.shape[1::-1])
                for m in raw
                if m is largest or m is other
            ]
            raise SourceError(f"{where}: {' and '.join(both)}, all maps need the same ratio of width and height")
    channels = sum(m.values.shape[2] for m in raw)
    if channels > MAX_CHANNELS:
        raise SourceError(f"{where}: has {channels} channels in all, at most {MAX_CHANNELS} are supported")

    maps, notes, origins, cleaned = [], list(notes), [], 0
    digest = hashlib.sha256()
    for m in raw:
        entry, role = m.entry, m.content.role
        if role == "normal" and m.values.shape[2] == 1:
            raise SourceError(
                f'{entry.file or where}: the normal map "{entry.name}" has 1 channel, 3 are needed (x, y, z), or x and '
                f"y alone"
            )
        number_type = m.values.dtype.name
        color_space = entry.color_space
        if color_space is None:
            srgb_encoded = m.content.colours and number_type in ENCODED and m.values.shape[2] in (1, 3)
            color_space = "srgb" if srgb_encoded else "linear"
        notes += _notes_on(m)
        a, b, _, c, d, _ = entry.transform
        if role == "normal" and not (b == c == 0 < min(a, d)):
            notes.append(f'map "{entry.name}": its texture transform turns the image, but not the normals')
        flipped = m.content.y_down and entry.name != "image"
        values = _inverted(m.values, [1] if flipped else range(m.values.shape[2]) if entry.inverted else [])
        with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinite and is reported below
            values = values.astype("<f4", order="C")
        if number_type in ENCODED:
            values /= np.iinfo(m.values.dtype).max
        else:
            cleaned += _check_finite(values, f'{entry.file or where}: map "{entry.name}"', nonfinite)
        values = _scaled(values, entry, color_space)
        if entry.constant:
            values = np.broadcast_to(values, (height, width, values.shape[2]))
        elif values.shape[:2] != (height, width):
            size = "{1} × {0}".format(*values.shape)
            notes.append(
                f'map "{entry.name}": {size} texels, interpolated to {width} × {height}, which the compression counts'
            )
            values = _resampled(values, (height, width), role, color_space)
        values = np.ascontiguousarray(values, "<f4")
        values.flags.writeable = False
        depth = 0 if entry.constant else DEPTHS[number_type]
        maps.append(Map(entry.name, values, color_space, role, depth, entry.file, entry.transform))
        layout = [entry.name, color_space, role, depth, *values.shape]
        digest.update(json.dumps(layout).encode() + b"\n")
        digest.update(values)
        origins.append(_origin(entry, color_space, flipped, values[0, 0]))
    return Source(
        tuple(maps), height, width, digest.hexdigest(), cleaned, tuple(notes), tuple(origins), file_nbytes
    )  # fmt: skip


def _inverted(values: np.ndarray, channels) -> np.ndarray:
    """Return ``values`` with 1 − x in some channels, −x if they are signed."""
    if not len(channels):
        return values
    one = np.iinfo(values.dtype).max if values.dtype.kind == "u" else 0 if (values < 0).any() else 1
    values = values.copy()
    values[..., channels] = one - values[..., channels]
    return values


def _scaled(values: np.ndarray, entry: MapEntry, color_space: str) -> np.ndarray:
    """Return ``values`` with the factor and the cutoff of an entry."""
    factor = np.array(entry.factor, np.float32)
    if factor.size and entry.content.role == "normal":
        signed = (values < 0).any()
        normals = (values if signed else 2 * values - 1) * np.append(np.repeat(factor, 2), np.ones(values.shape[2] - 2))
        values = _unit(normals) if signed else 0.5 + 0.5 * _unit(normals)
    elif factor.size:
        linear = (srgb.to_linear(values) if color_space == "srgb" else values) * factor
        values = srgb.from_linear(linear) if color_space == "srgb" else linear
    return values if entry.cutoff is None else (values >= entry.cutoff).astype(np.float32)


def _unit(normals: np.ndarray) -> np.ndarray:
    """Return normals of length 1; those of two channels or of length 0 stay."""
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    return normals if normals.shape[2] != 3 else normals / np.where(length > 1e-6, length, 1)


def _resampled(values: np.ndarray, size: tuple[int, int], role: str, color_space: str) -> np.ndarray:
    """Return a map of another size, as a bitmap that repeats is interpolated: linearly, colours in linear light."""
    from scipy.ndimage import zoom

    signed = (values < 0).any()
    if role == "normal":
        values = values if signed else 2 * values - 1
    values = srgb.to_linear(values) if color_space == "srgb" else values
    factors = (size[0] / values.shape[0], size[1] / values.shape[1], 1)
    values = zoom(values, factors, order=1, mode="grid-wrap", grid_mode=True)
    if role == "normal":
        values = _unit(values) if signed else 0.5 + 0.5 * _unit(values)
    return srgb.from_linear(values) if color_space == "srgb" else values


def _origin(entry: MapEntry, color_space: str, flipped: bool, first: np.ndarray) -> dict[str, str]:
    """Return a row of the table that says of what a map is made; ``first`` is its first texel."""
    channels = entry.channels if isinstance(entry.channels, list) else [entry.channels or "all"]
    factor = first if entry.constant else entry.factor
    changes = ("y inverted" if flipped else "", "inverted (1 − x)" if entry.inverted else "")
    cutoff = f"1 from {entry.cutoff:g} on" if entry.cutoff is not None else ""
    return {
        "map": entry.name,
        "file": "constant" if entry.constant else Path(entry.file).name,
        "channels": ", ".join(map(str, channels)),
        "color_space": color_space,
        "factor": ", ".join(f"{value:.4g}" for value in factor) or "1",
        "change": ", ".join(filter(None, (*changes, cutoff, describe_transform(entry.transform)))),
    }


def _notes_on(m: _RawMap) -> list[str]:
    """Return what has to be said about a map of a manifest or of a dictionary."""
    name, color_space = m.entry.name, m.entry.color_space
    if name == "image":
        return []
    if m.content.y_down:
        return [f'map "{name}": normals of DirectX, y is inverted to that of OpenGL, which Mitsuba expects']
    if m.content.packed and m.values.shape[2] > 1:
        return [f'map "{name}": holds several maps, which are kept as one: "channels" gives each a map of its own']
    if m.content.role == "other" and not m.content.colours and _share_of_normals(m.values) > _LOOKS_NORMAL:
        return [f'map "{name}": looks like a normal map, but is taken for other data: call it "normal"']
    if m.content is not UNKNOWN:
        return [] if content_of(name) else [f'map "{name}": has the role {m.content.role} by the name of its file']
    colours = color_space is None and m.values.dtype.name in ENCODED and m.values.shape[2] == 3
    if not colours or equal(m.values):
        return []
    return [f'map "{name}": an unknown name, taken for data, linear: give it "color_space": "srgb" if it is a colour']


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
