"""Sizes of pictures, from the headers of their files, before anything is decoded.

The formats are those that ``mitsuba.Bitmap`` reads. Pillow reads the headers of PNG and JPEG. Radiance HDR and PFM are
unknown to it, and OpenEXR's own reader of headers ends the process on damaged ones.
"""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from ..core.archives import Allowance

#: Modes of Pillow that are decoded to more or fewer bytes a pixel than they have letters.
_MODE_BYTES = {"P": 4, "YCbCr": 3, "I;16": 2, "I;16B": 2}

#: Pixel type of OpenEXR → bytes.
_EXR_BYTES = {0: 4, 1: 2, 2: 4}

#: Flag of OpenEXR files with several parts.
_EXR_PARTS = 0x1000

#: Bytes of the longest text header, and of the longest name or attribute of an OpenEXR header that is kept.
_HEADER = 2**16


@dataclass(frozen=True)
class PictureSize:
    """Size of a picture: ``width`` and ``height`` in pixels, and the bytes of a decoded pixel of all channels."""

    width: int
    height: int
    pixel_bytes: int

    @property
    def nbytes(self) -> int:
        """Bytes of all pixels."""
        return self.width * self.height * self.pixel_bytes


def check_picture(path: str | os.PathLike) -> None:
    """Raise :class:`.LimitError` for a picture that takes more memory than its file may.

    Files of other formats, and headers that are cut short, are left to their decoders. Raises ``OSError``.
    """
    path = Path(path)
    size = picture_size(path)
    if size is not None:
        Allowance(path).check(size.nbytes, f"a picture of {size.width:,} x {size.height:,} pixels")


def picture_size(path: Path) -> PictureSize | None:
    """Return the size of a picture; ``None`` for other formats, and for headers that are cut short."""
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


def _by_pillow(file: BinaryIO, name: str) -> PictureSize:
    from PIL import Image

    Image.preinit()
    picture = Image.OPEN[name][0](file, "")  # Image.open would refuse large pictures
    deep = "16" in str(picture.tile[0][3]) and "16" not in picture.mode
    return PictureSize(*picture.size, _MODE_BYTES.get(picture.mode, len(picture.mode)) * (2 if deep else 1))


def _exr(file: BinaryIO) -> PictureSize:
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
            sizes.append(PictureSize(right - left + 1, bottom - top + 1, bytes_of_pixel))
        if not attributes or not version & _EXR_PARTS:
            break
    largest = max(sizes, key=lambda size: size.nbytes)
    total = sum(size.nbytes for size in sizes)
    return PictureSize(largest.width, largest.height, -(-total // max(1, largest.width * largest.height)))


def _text(file: BinaryIO) -> bytes:
    """Return the bytes up to the next zero. Raises ``ValueError`` at the end of the file."""
    text = bytearray()
    while (byte := file.read(1)) != b"\0":
        if not byte or len(text) > _HEADER:
            raise ValueError("cut short")
        text += byte
    return bytes(text)


def _radiance(file: BinaryIO) -> PictureSize | None:
    lines = re.search(rb"^[-+][YX] +(\d+) +[-+][YX] +(\d+)", file.read(_HEADER), re.MULTILINE)
    return None if lines is None else PictureSize(int(lines[2]), int(lines[1]), 12)


def _portable(file: BinaryIO) -> PictureSize | None:
    head = re.match(rb"P([Ff56])(?:\s|#[^\n]*\n)+(\d+)(?:\s|#[^\n]*\n)+(\d+)", file.read(_HEADER))
    if head is None:
        return None
    pixel = {b"F": 12, b"f": 4, b"6": 6, b"5": 2}[head[1]]
    return PictureSize(int(head[2]), int(head[3]), pixel)


def _bmp(file: BinaryIO) -> PictureSize:
    width, height, _, bits = struct.unpack("<iiHH", file.read(30)[18:])
    return PictureSize(abs(width), abs(height), max(3, -(-bits // 8)))


def _tga(file: BinaryIO, path: Path) -> PictureSize | None:
    """Return the size in a TGA file, which only its extension or its last bytes show to be one."""
    width, height, bits = struct.unpack("<HHB", file.read(18)[12:17])
    file.seek(max(0, path.stat().st_size - 18))
    if path.suffix.lower() != ".tga" and not file.read(18).startswith(b"TRUEVISION-XFILE"):
        return None
    return PictureSize(width, height, -(-bits // 8))
