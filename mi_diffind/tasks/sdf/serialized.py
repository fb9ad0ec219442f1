"""Mitsuba's own mesh format, ``.serialized``: several meshes in one file, each compressed by zlib."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path

import numpy as np

#: First number of a file and of each mesh in it.
MAGIC = 0x041C

#: Flags of a mesh: optional arrays before the triangles, and their precision.
NORMALS, TEXTURE_COORDINATES, COLOURS, DOUBLE = 0x1, 0x2, 0x8, 0x2000


def read(path: str | os.PathLike, number: str = "") -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the meshes of a file, or one by its number: vertices ``(V, 3)``, float64, and faces ``(F, 3)``, int64.

    The format is described at Mitsuba's shape ``serialized``; versions 3 and 4 are read. Raises ``ValueError`` for
    other content, and ``OSError``.
    """
    data = Path(path).read_bytes()
    try:
        version = struct.unpack_from("<2H", data)[1]
        count = struct.unpack_from("<I", data, len(data) - 4)[0]
        width = 8 if version == 4 else 4
        starts = np.frombuffer(data, f"<u{width}", count, len(data) - 4 - width * count)
        meshes = [_mesh(data, int(start), version) for start in starts]
    except (struct.error, zlib.error, ValueError) as e:
        raise ValueError(f"is no file of serialized meshes, or cut short: {e}") from None
    if number and number not in map(str, range(count)):
        raise ValueError(f'holds no mesh "{number}", allowed are 0 to {count - 1}')
    return [meshes[int(number)]] if number else meshes


def _mesh(data: bytes, start: int, version: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh that begins at the byte ``start``. Raises ``ValueError`` and others for wrong bytes."""
    magic, each = struct.unpack_from("<2H", data, start)
    if magic != MAGIC or each not in (3, 4) or each != version:
        raise ValueError(f"found the numbers {magic:#x} and {each} at byte {start}, expected {MAGIC:#x} and 3 or 4")
    content = zlib.decompressobj().decompress(data[start + 4 :])
    flags = struct.unpack_from("<I", content)[0]
    place = 4 if version == 3 else content.index(b"\0", 4) + 1
    vertices, faces = struct.unpack_from("<2Q", content, place)
    place += 16
    positions = np.frombuffer(content, "<f8" if flags & DOUBLE else "<f4", 3 * vertices, place)
    numbers = 3 + 3 * bool(flags & NORMALS) + 2 * bool(flags & TEXTURE_COORDINATES) + 3 * bool(flags & COLOURS)
    place += numbers * vertices * positions.itemsize
    indices = np.frombuffer(content, "<u8" if vertices > 0xFFFFFFFF else "<u4", 3 * faces, place)
    return positions.reshape(-1, 3).astype(np.float64), indices.reshape(-1, 3).astype(np.int64)
