"""Materials of glTF 2.0 files: the images and factors of the metallic-roughness model, without geometry."""

from __future__ import annotations

import base64
import binascii
import json
import os
import struct
from collections import Counter
from dataclasses import replace
from pathlib import Path
from urllib.parse import unquote_to_bytes

from ..core.archives import Allowance, LimitError, json_bytes
from ..core.errors import reason
from ..core.files import RecordedKeys, shown, unused_note
from ..core.units import memory
from ..images.reader import PictureError, read_file
from .entries import ImageFiles, MapEntry, SourceError, choose_material, to_transform, transparent, uv_matrix

#: Extension that transforms texture coordinates.
TRANSFORM = "KHR_texture_transform"

#: Types of images that are read.
READ = ("image/png", "image/jpeg", "")

#: Code of an image that is repeated beyond its border, the default.
REPEAT = 10497

#: Name of a texture of a material → the maps that it holds, with their channels (``None``: the colours).
TEXTURES = {
    "baseColorTexture": {"albedo": None},
    "normalTexture": {"normal": None},
    "metallicRoughnessTexture": {"roughness": "g", "metallic": "b"},
    "occlusionTexture": {"ao": "r"},
}


def read_gltf(path: Path, name: str, images: ImageFiles) -> tuple[list[MapEntry], list[str], bool]:
    """Return the maps of the material called ``name``, or of the only one, notes on what is not used, and its sides.

    It has two sides if it is ``doubleSided``. Factors multiply the images; the one of a missing image is a constant
    map. With ``alphaMode`` BLEND or MASK there is a map of opacity. Raises :class:`SourceError`.
    """
    try:
        content, binary = read_content(path)
        material = content.get("materials", [])[choose_material(path, material_names(content), name)]
        double_sided = material.get("doubleSided") is True
        return *_Reader(path, content, binary, images).entries(material), double_sided
    except (SourceError, LimitError, PictureError) as e:
        raise SourceError(str(e)) from None
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, struct.error) as e:
        raise SourceError(f"{shown(path)}: is no valid glTF file ({type(e).__name__}: {reason(e)})") from None


def material_names(content: dict) -> list[str]:
    """Return the names of all materials; those without a name, or with that of another one, get their number."""
    names = [str(material.get("name") or "") for material in content.get("materials", [])]
    count = Counter(names)
    return [name if name and count[name] == 1 else f"{name or 'material'}{i}" for i, name in enumerate(names)]


def read_content(path: Path) -> tuple[dict, bytes]:
    """Return the JSON of a file and the binary chunk of a ``.glb`` file. Raises :class:`SourceError`."""
    data, binary = read_file(path, memory() // 4), b""
    if data[:4] == b"glTF":
        if len(data) < 20:
            raise SourceError(f"{shown(path)}: is cut short, it has {len(data)} bytes")
        _, version, _, length, chunk = struct.unpack("<5I", data[:20])
        if version != 2 or chunk != 0x4E4F534A:
            raise SourceError(f"{shown(path)}: is of version {version} of glTF, allowed is 2, with JSON first")
        data, binary = data[20 : 20 + length], data[28 + length :]
    Allowance(path).check(json_bytes(data), "a glTF file")
    try:
        content = json.loads(data.decode("utf-8-sig"), object_pairs_hook=RecordedKeys)
    except (ValueError, RecursionError) as e:
        raise SourceError(f"{shown(path)}: is not valid JSON ({reason(e)})") from None
    if "asset" not in content:
        raise SourceError(f'{shown(path)}: is no glTF file, it has no "asset"')
    return content, binary


class _Reader:
    """Reader of one material of a file."""

    def __init__(self, path: Path, content: dict, binary: bytes, images: ImageFiles):
        self.path, self.content, self.binary, self.images = path, content, binary, images
        self.notes: list[str] = []

    def entries(self, material: dict) -> tuple[list[MapEntry], list[str]]:
        """Return the maps of a material, and notes."""
        pbr = material.get("pbrMetallicRoughness", RecordedKeys())
        files, transforms, left_out = {}, {}, set()
        for texture, maps in TEXTURES.items():
            info = material.get(texture) or pbr.get(texture)
            if info is not None:
                transforms |= dict.fromkeys(maps, self._transform(texture, info))
                file = self._image(texture, info)
                files |= dict.fromkeys(maps, file) if file else {}
                left_out |= set() if file else set(maps)
        *color, alpha = (float(value) for value in pbr.get("baseColorFactor", [1] * 4))
        scale = (material.get("normalTexture") or {}).get("scale", 1)
        factors = {
            "albedo": color, "normal": [float(scale)], "roughness": [float(pbr.get("roughnessFactor", 1))],
            "metallic": [float(pbr.get("metallicFactor", 1))],
        }  # fmt: skip
        entries = []
        for maps in TEXTURES.values():
            for name, channels in maps.items():
                factor = tuple(factors.get(name, [1.0]))
                if name in files:
                    space, factor = "srgb" if name == "albedo" else "linear", () if set(factor) == {1.0} else factor
                    entry = MapEntry(name, files[name], None, channels, space, factor=factor, opaque=True)
                    entries.append(replace(entry, transform=transforms[name]))
                elif name not in left_out and name not in ("normal", "ao"):
                    entries.append(MapEntry(name, color_space="linear", factor=factor, constant=True))
        for entry in self._opacity(material, files.get("albedo"), alpha):
            entries.append(entry if entry.constant else replace(entry, transform=transforms["albedo"]))
        strength = (material.get("occlusionTexture") or {}).get("strength", 1)
        self.notes += [f"occlusionTexture: its strength {strength:g} is not used"] if strength != 1 else []
        self.notes += [f"{name} is not used" for name in material.pop("extensions", {})]
        note = unused_note(self.path, material)
        return entries, self.notes + ([note] if note else [])

    def _opacity(self, material: dict, file: str | None, alpha: float) -> list[MapEntry]:
        """Return the map of opacity, if the material has one."""
        mode, cutoff = material.get("alphaMode", "OPAQUE"), material.get("alphaCutoff", 0.5)
        has_alpha = file is not None and self.images.read(file).has_alpha
        if mode == "OPAQUE":
            if has_alpha and transparent(self.images.read(file)):
                self.notes.append("baseColorTexture: its alpha is not used, alphaMode is OPAQUE")
            return []
        cutoff = float(cutoff) if mode == "MASK" else None
        if has_alpha:
            factor = () if alpha == 1 else (alpha,)
            return [MapEntry("opacity", file, None, "a", "linear", factor=factor, cutoff=cutoff)]
        alpha = alpha if cutoff is None else float(alpha >= cutoff)
        return [MapEntry("opacity", color_space="linear", factor=(alpha,), constant=True)] if alpha < 1 else []

    def _transform(self, texture: str, info: dict) -> tuple[float, ...]:
        """Return the texture transform of a texture, and add notes on its extensions and its texture coordinates."""
        extensions = info.pop("extensions", {})
        change = extensions.get(TRANSFORM, {})
        self.notes += [f"{texture}: {name} is not used" for name in extensions if name != TRANSFORM]
        if uv_set := change.get("texCoord", info.get("texCoord", 0)):
            self.notes.append(f"{texture}: its texture coordinates, set {uv_set}, are not used")
        scale, offset = change.get("scale", (1, 1)), change.get("offset", (0, 0))
        return to_transform(uv_matrix(scale, change.get("rotation", 0), offset))

    def _image(self, texture: str, info: dict) -> str:
        """Return the path or name of the image of a texture, "" if its format is not read."""
        source = self.content["textures"][info["index"]]
        sampler = self.content["samplers"][source["sampler"]] if "sampler" in source else {}
        if {sampler.get(f"wrap{axis}", REPEAT) for axis in "ST"} != {REPEAT}:
            self.notes.append(f"{texture}: how its image goes on beyond the border is not used")
        if "source" not in source:
            self.notes.append(f"{texture}: not used, images of {', '.join(source.get('extensions', ()))} are not read")
            return ""
        index = source["source"]
        image = self.content["images"][index]
        uri, mime = image.get("uri", ""), image.get("mimeType", "")
        if uri.startswith("data:"):
            mime, _, data = uri[5:].partition(",")
            mime, encoding = mime.split(";")[0], mime.endswith(";base64")
        if mime not in READ or Path(uri[:1000]).suffix.lower() in (".ktx2", ".webp", ".dds"):
            self.notes.append(f"{texture}: not used, images {mime or Path(uri).suffix} are not read")
            return ""
        name = f"{self.path}: image {index}"
        if uri.startswith("data:"):
            return self.images.decode(name, self._decoded(data, encoding))
        return self._file(uri) if uri else self.images.decode(name, self._view(image["bufferView"]))

    def _file(self, uri: str) -> str:
        """Return the path of a file."""
        if "://" in uri:
            raise SourceError(f"{shown(self.path)}: names {uri!r:.80}, allowed are files and data")
        decoded = unquote_to_bytes(uri).decode(errors="replace")
        path = self.images.find(self.path.parent, decoded, self.path)
        return path if os.path.exists(path) else self.images.find(self.path.parent, uri, self.path)

    def _decoded(self, data: str, encoded: bool) -> bytes:
        """Return the data of a URI."""
        try:
            return base64.b64decode(unquote_to_bytes(data)) if encoded else unquote_to_bytes(data)
        except binascii.Error as e:
            raise SourceError(f"{shown(self.path)}: has damaged embedded data ({reason(e)})") from None

    def _view(self, index: int) -> bytes:
        """Return the bytes of a buffer view."""
        view = self.content["bufferViews"][index]
        buffer = self.content["buffers"][view["buffer"]]
        uri = buffer.get("uri", "")
        if not uri:
            data = self.binary
        elif uri.startswith("data:"):
            data = self._decoded(uri.partition(",")[2], True)
        else:
            data = read_file(Path(self._file(uri)), memory() // 4)
        start = view.get("byteOffset", 0)
        if not 0 <= start <= start + view["byteLength"] <= len(data):
            raise SourceError(f"{shown(self.path)}: is cut short, buffer view {index} ends behind its buffer")
        return data[start : start + view["byteLength"]]
