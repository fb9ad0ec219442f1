"""Reader of pictures: PNG, JPEG, EXR, HDR, PFM, BMP and TGA. No variant of Mitsuba has to be set."""

from __future__ import annotations

import math
import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from ..core.archives import Allowance, LimitError
from ..core.errors import DiffindError, raised_as, reason
from ..core.files import irregular, shown
from ..core.threads import threads_for_files
from ..core.units import memory

#: Type of a channel → its bytes in a source.
DEPTHS = {"uint8": 1, "uint16": 2, "uint32": 4, "float16": 2, "float32": 4, "float64": 4}

#: Types whose full range means 0 to 1.
ENCODED = ("uint8", "uint16")

#: Largest number of channels.
MAX_CHANNELS = 16

#: Largest whole number that single precision holds exactly, with all smaller ones.
EXACT = 2**24

#: Modes of Pillow that are decoded to more or fewer bytes a pixel than they have letters.
_MODE_BYTES = {"P": 4, "YCbCr": 3, "I;16": 2, "I;16B": 2}

#: Pixel type of OpenEXR → bytes.
_EXR_BYTES = {0: 4, 1: 2, 2: 4}

#: Flag of OpenEXR files with several parts.
_EXR_PARTS = 0x1000

#: Bytes of the longest text header, and of the longest name or attribute of an OpenEXR header that is kept.
_HEADER = 2**16

_JPEG_MARKER = re.compile(rb"\xff+([\x01-\xcf\xd8-\xfe])")  # without the markers inside of compressed data


class PictureError(DiffindError, ValueError):
    """A picture cannot be read; the message is one sentence that names the file and the fault."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Content of a picture in its own type, ``(height, width, channels)``: ``colors`` channels, then any alpha.

    ``channels``: their names, ``("R", "G", "B")`` or ``("Y",)`` if ``named``, with ``"A"`` if ``has_alpha``; others are
    those of a multi-channel EXR. ``srgb``: the colours carry the sRGB transfer function.
    """

    values: np.ndarray
    channels: tuple[str, ...]
    srgb: bool = False
    named: bool = True

    @classmethod
    def from_bitmap(cls, bitmap) -> Picture:
        """Return the content of a ``mi.Bitmap``."""
        values, pixels = np.array(bitmap), bitmap.pixel_format()
        formats = type(pixels)
        values = values.reshape(*values.shape[:2], -1)
        named = pixels in (formats.Y, formats.YA, formats.RGB, formats.RGBA)
        return cls(values, tuple(field.name for field in bitmap.struct_()), bitmap.srgb_gamma(), named)

    @property
    def has_alpha(self) -> bool:
        return self.named and len(self.channels) in (2, 4)

    @property
    def colors(self) -> int:
        """Number of channels that are no alpha."""
        return len(self.channels) - self.has_alpha


def read_file(path: Path, most: int) -> bytes:
    """Return the content of a file of at most ``most`` bytes. Raises :class:`PictureError`, also for a pipe."""
    if fault := irregular(path, most):
        raise PictureError(f"{shown(path)}: {fault}")
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise PictureError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise PictureError(f"{path}: is a folder, an image or a manifest (.json) is expected") from None
    except (OSError, ValueError) as e:
        raise PictureError(f"{path}: cannot be read ({reason(e)})") from None


def read_picture(path: str | os.PathLike) -> Picture:
    """Read a picture.

    Raises :class:`PictureError` if ``mitsuba.Bitmap`` cannot read it, it is cut short, or it takes more memory than a
    file of its size may (:mod:`~mi_diffind.core.archives`).
    """
    import mitsuba as mi

    path = Path(path)
    if fault := _fault(read_file(path, memory() // 4)):
        raise PictureError(f"{path}: is {fault}")
    with raised_as(PictureError, LimitError):
        _check_size(path)
    # A TGA file has no signature
    file_format = mi.Bitmap.FileFormat.TGA if path.suffix.lower() == ".tga" else mi.Bitmap.FileFormat.Auto
    try:
        with threads_for_files():
            picture = Picture.from_bitmap(mi.Bitmap(str(path), file_format))
    except (RuntimeError, MemoryError, ValueError) as e:
        raise PictureError(
            f"{path}: cannot be read as an image, it is damaged, cut short or of an unknown format ({reason(e)})"
        ) from None
    values = picture.values
    if values.size == 0 or values.dtype.name not in DEPTHS:
        raise PictureError(f"{path}: has the shape {values.shape} and type {values.dtype}, which is not supported")
    if values.dtype.name == "uint32" and values.max() > EXACT:
        raise PictureError(f"{path}: has whole numbers up to {values.max():,}, single precision is exact to {EXACT:,}")
    if values.shape[2] > MAX_CHANNELS:
        raise PictureError(f"{path}: has {values.shape[2]} channels, at most {MAX_CHANNELS} are supported")
    return picture


def _fault(data: bytes) -> str:
    """Return the fault of a file that Mitsuba's decoders accept: a missing end, colours of a palette; "" if none."""
    if data.startswith(b"\x89PNG\r\n\x1a\n") and b"IEND\xaeB`\x82" not in data:
        return "cut short, a PNG file ends with an IEND chunk"
    if data.startswith(b"\xff\xd8\xff") and not _jpeg_ends(data):
        return "cut short, a JPEG file ends with an end-of-image marker"
    if data.startswith(b"BM") and data[28:30] == b"\x08\x00":
        start = 14 + int.from_bytes(data[14:18], "little")
        entries = min(int.from_bytes(data[46:50], "little") or 256, 256)
        if any(set(data[start + 4 * i : start + 4 * i + 3]) != {i} for i in range(entries)):
            return "a BMP file with a palette, which is not supported"
    return ""


def _jpeg_ends(data: bytes) -> bool:
    """Return whether a JPEG file has its last marker."""
    position = 0
    while match := _JPEG_MARKER.search(data, position):
        position, marker = match.end(), match[1][0]
        if marker == 0xD9:
            return True
        if marker not in (0x01, 0xD8):  # these have no length
            position += int.from_bytes(data[position : position + 2], "big")
    return False


def _check_size(path: Path) -> None:
    """Raise :class:`.LimitError` for a picture that takes more memory than its file may.

    Files of other formats, and headers that are cut short, are left to their decoders. Raises ``OSError``.
    """
    if size := picture_size(path):
        width, height, pixel_bytes = size
        Allowance(path).check(width * height * pixel_bytes, f"a picture of {width:,} x {height:,} pixels")


def picture_size(path: Path) -> tuple[int, int, int] | None:
    """Return width and height in pixels and the bytes of a decoded pixel of all channels, from the header of a file.

    Pillow reads the headers of PNG and JPEG. Radiance HDR and PFM are unknown to it, and OpenEXR's own reader of
    headers ends the process on damaged ones. Returns ``None`` for other formats, and for headers that are cut short.
    """
    with open(path, "rb") as file:
        start = file.read(8)
        file.seek(0)
        try:
            if start.startswith(b"\x76\x2f\x31\x01"):
                return _exr(file)
            if start.startswith(b"#?"):
                return _radiance(file)
            if start[:2] in (b"PF", b"Pf", b"P6", b"P5"):
                return _portable(file)
            if start == b"\x89PNG\r\n\x1a\n" or start.startswith(b"\xff\xd8"):
                return _by_pillow(file, "PNG" if start[1:4] == b"PNG" else "JPEG")
            return _bmp(file) if start.startswith(b"BM") else _tga(file, path)
        except Exception:  # struct and Pillow have their own for damaged headers
            return None


def _by_pillow(file: BinaryIO, name: str) -> tuple[int, int, int]:
    from PIL import Image

    Image.preinit()
    picture = Image.OPEN[name][0](file, "")  # Image.open would refuse large pictures
    deep = "16" in str(picture.tile[0][3]) and "16" not in picture.mode
    return (*picture.size, _MODE_BYTES.get(picture.mode, len(picture.mode)) * (2 if deep else 1))


def _exr(file: BinaryIO) -> tuple[int, int, int]:
    """Return the size of all parts together: the width and height are those of the largest."""
    (version,) = struct.unpack("<I", file.read(8)[4:])
    sizes = []
    while True:
        attributes = {}
        while name := _text(file):
            _text(file)  # the type
            (length,) = struct.unpack("<i", file.read(4))
            if name in (b"channels", b"dataWindow"):
                attributes[name] = file.read(min(max(0, length), _HEADER))
                length -= len(attributes[name])
            file.seek(max(0, length), os.SEEK_CUR)
        if attributes:
            left, top, right, bottom = struct.unpack("<4i", attributes[b"dataWindow"])
            channels = re.findall(rb"[^\0]+\0(.)\0\0\0.{12}", attributes[b"channels"], re.DOTALL)
            bytes_of_pixel = sum(_EXR_BYTES.get(channel[0], 4) for channel in channels)
            sizes.append((right - left + 1, bottom - top + 1, bytes_of_pixel))
        if not attributes or not version & _EXR_PARTS:
            break
    width, height, _ = max(sizes, key=math.prod)
    return width, height, -(-sum(map(math.prod, sizes)) // max(1, width * height))


def _text(file: BinaryIO) -> bytes:
    """Return the bytes up to the next zero. Raises ``ValueError`` at the end of the file."""
    text = bytearray()
    while (byte := file.read(1)) != b"\0":
        if not byte or len(text) > _HEADER:
            raise ValueError("cut short")
        text += byte
    return bytes(text)


def _radiance(file: BinaryIO) -> tuple[int, int, int] | None:
    lines = re.search(rb"^[-+][YX] +(\d+) +[-+][YX] +(\d+)", file.read(_HEADER), re.MULTILINE)
    return None if lines is None else (int(lines[2]), int(lines[1]), 12)


def _portable(file: BinaryIO) -> tuple[int, int, int] | None:
    head = re.match(rb"P([Ff56])(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)", file.read(_HEADER))
    if head is None:
        return None
    pixel = {b"F": 12, b"f": 4, b"6": 6, b"5": 2}[head[1]]
    return (int(head[2]), int(head[3]), pixel)


def _bmp(file: BinaryIO) -> tuple[int, int, int]:
    width, height, _, bits = struct.unpack("<iiHH", file.read(30)[18:])
    return (abs(width), abs(height), max(3, -(-bits // 8)))


def _tga(file: BinaryIO, path: Path) -> tuple[int, int, int] | None:
    """Return the size in a TGA file, which only its extension or its last bytes show to be one."""
    width, height, bits = struct.unpack("<HHB", file.read(18)[12:17])
    file.seek(max(0, path.stat().st_size - 18))
    if path.suffix.lower() != ".tga" and not file.read(18).startswith(b"TRUEVISION-XFILE"):
        return None
    return (width, height, -(-bits // 8))
