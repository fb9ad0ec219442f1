"""Files of 3D Gaussians ("3D Gaussian Splatting", Kerbl et al. 2023): PLY and SOG.

PLY files are those of the reference implementation, text or binary. SOG (version 2, PlayCanvas: "Spatially Ordered
Gaussians") holds 8-bit images and a ``meta.json`` with their ranges and codebooks, in a folder or in a ZIP archive
``NAME.sog``.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import zipfile
from pathlib import Path, PurePosixPath

import numpy as np

from ..core.errors import DiffindError, reason
from ..core.files import RecordedKeys, irregular, shown, unused_note
from ..core.units import memory

#: Names of properties that every Gaussian of a PLY file has.
NAMES = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)

#: Numbers of further coefficients ``f_rest_*``: spherical harmonics of degree 0 to 3.
REST = (0, 9, 24, 45)

#: Largest coordinate and standard deviation.
FARTHEST = 1e18

#: Name of the file that describes a SOG folder or archive, and the most bytes that it may have.
META, META_BYTES = "meta.json", 1 << 20

#: End of a file's name → format of 3D Gaussians that is not read.
OTHER_FORMATS = {
    ".spz": "SPZ (Niantic)", ".splat": ".splat (antimatter15)", ".ksplat": ".ksplat (GaussianSplats3D)",
    ".lcc": "LCC (XGRIDS)", "lod-meta.json": "streamed SOG (PlayCanvas)",
}  # fmt: skip

#: Advice for files of these formats.
CONVERTER = 'PlayCanvas\' splat-transform converts it ("splat-transform {} OUTPUT.ply")'

#: Colours in a row of the palette of a SOG file.
PALETTE_WIDTH = 64

#: Most Gaussians of a SOG file, whose images are compressed.
MOST = 1 << 25

#: Image formats of SOG files.
FORMATS = ("WEBP", "PNG")


class SplatsError(DiffindError, ValueError):
    """Error for a file that holds no usable Gaussians; the message is one sentence that names the file."""


def is_splats(source) -> bool:
    """Return whether a source is the name of a file of Gaussians: ``*.ply``, ``*.sog`` or ``meta.json``.

    Names of :data:`OTHER_FORMATS` count, too: :func:`read_gaussians` says what to do with them.
    """
    if not isinstance(source, (str, os.PathLike)):
        return False
    path = Path(source)
    return path.suffix.lower() in (".ply", ".sog") or path.name.lower() == META or bool(_other_format(path))


def _other_format(path: Path) -> str:
    """Return the format of a file of Gaussians that is not read, by its name, else ""."""
    return next((name for end, name in OTHER_FORMATS.items() if path.name.lower().endswith(end)), "")


def read_gaussians(path: str | os.PathLike) -> tuple[dict[str, np.ndarray], str, tuple[str, ...]]:
    """Return the Gaussians of a file, the SHA-256 of its content, and notes on what is not used of it.

    The arrays are those of :class:`.splats.Splats`, float32. Raises :class:`SplatsError`.
    """
    path = Path(path)
    if other := _other_format(path):
        if not path.is_file():
            raise SplatsError(f"{shown(path)}: no such file")
        advice = CONVERTER.format(path.name)
        raise SplatsError(f"{path}: holds Gaussians in the format {other}, PLY or SOG is needed: {advice}")
    arrays, digest, note = (_ply if path.suffix.lower() == ".ply" else _sog)(path)
    if not len(arrays["centres"]):
        raise SplatsError(f"{path}: holds no Gaussians")
    lengths = np.linalg.norm(arrays["quaternions"], axis=1, keepdims=True)
    if not lengths.all():
        raise SplatsError(f"{path}: has {np.count_nonzero(lengths == 0):,} rotations of length 0")
    arrays["quaternions"] = arrays["quaternions"] / lengths
    with np.errstate(over="ignore"):
        arrays["scales"] = np.exp(arrays["scales"])
    if arrays["scales"].max() > FARTHEST or np.abs(arrays["centres"]).max() > FARTHEST:
        raise SplatsError(f"{path}: has places or scales above 1e18, are the scales logarithms?")
    return {name: array.astype(np.float32) for name, array in arrays.items()}, digest, (note,) if note else ()


def _ply(path: Path) -> tuple[dict[str, np.ndarray], str, str | None]:
    """Return the arrays of a PLY file, with logarithms of the scales and quaternions of any length, and a note."""
    from trimesh.exchange.ply import load_ply

    if fault := irregular(path, memory() // 4):
        raise SplatsError(f"{shown(path)}: {fault}")
    try:
        content = path.read_bytes()
        if re.search(rb"property\s+\w+\s+packed_position\s", content.partition(b"end_header")[0]):
            raise SplatsError(
                f"{path}: holds compressed Gaussians, an uncompressed PLY file or SOG is needed: "
                f"{CONVERTER.format(path.name)}"
            )
        elements = load_ply(io.BytesIO(content))["metadata"]["_ply_raw"]
        vertices = elements["vertex"]["data"]
        names = vertices.dtype.names if isinstance(vertices, np.ndarray) else tuple(vertices)
    except SplatsError:
        raise
    except OSError as e:
        raise SplatsError(f"{path}: cannot be read ({e.strerror or reason(e)})") from None
    except Exception as e:  # the reader has no errors of its own
        raise SplatsError(f"{path}: is not a PLY file with vertices, or is damaged ({reason(e)})") from None
    missing = [name for name in NAMES if name not in names]
    if missing:
        raise SplatsError(f"{path}: holds no 3D Gaussians, its vertices lack {', '.join(missing)}")
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in REST:
        raise SplatsError(f"{path}: has {rest} properties f_rest_*, allowed are {', '.join(map(str, REST))}")

    def columns(*chosen: str) -> np.ndarray:
        return np.stack([np.asarray(vertices[name], np.float64).reshape(-1) for name in chosen], axis=-1)

    further = tuple(f"f_rest_{i}" for i in range(rest))
    if missing := [name for name in further if name not in names]:
        raise SplatsError(f"{path}: has {rest} properties f_rest_*, but lacks {', '.join(missing)}")
    for name in (*NAMES, *further):
        values = columns(name)
        wrong = np.isnan(values) if name == "opacity" else ~np.isfinite(values)
        if wrong.any():
            raise SplatsError(f"{path}: has {np.count_nonzero(wrong):,} values of {name} that are NaN or infinite")
    colours = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    if rest:
        others = columns(*further).reshape(-1, 3, rest // 3)
        colours = np.concatenate([colours, others.swapaxes(1, 2)], axis=1)
    with np.errstate(over="ignore"):
        opacities = 1 / (1 + np.exp(-columns("opacity")[:, 0]))
    arrays = {
        "centres": columns("x", "y", "z"),
        "scales": columns("scale_0", "scale_1", "scale_2"),
        "quaternions": columns("rot_1", "rot_2", "rot_3", "rot_0"),
        "opacities": opacities,
        "colours": colours,
    }
    # Normals are 0 in the files of the reference implementation
    unused = [name for name in names if name not in (*NAMES, *further) and np.any(vertices[name])]
    note = unused_note(path, [], (*unused, *(name for name in elements if name != "vertex")))
    return arrays, hashlib.sha256(content).hexdigest(), note


def _sog(path: Path) -> tuple[dict[str, np.ndarray], str, str | None]:
    """Return the arrays of a SOG archive or of a folder's ``meta.json``, as :func:`_ply` does, and a note."""
    with _SogFiles(path) as files:
        meta = files.meta()
        count = files.number(meta, "count", MOST)
        if not count:
            raise SplatsError(f"{path}: holds no Gaussians")
        low, high = (files.image(meta, "means", which, count)[:, :3].astype(np.float64) for which in (0, 1))
        ranges = [files.numbers(meta, "means", name, 3) for name in ("mins", "maxs")]
        places = ranges[0] + (ranges[1] - ranges[0]) * (low + 256 * high) / 65535
        with np.errstate(over="ignore"):
            centres = np.sign(places) * np.expm1(np.abs(places))
        base = files.image(meta, "sh0", 0, count)
        arrays = {
            "centres": centres,
            "scales": files.numbers(meta, "scales", "codebook", 256)[files.image(meta, "scales", 0, count)[:, :3]],
            "quaternions": files.rotations(files.image(meta, "quats", 0, count)),
            "opacities": base[:, 3] / 255,
            "colours": files.numbers(meta, "sh0", "codebook", 256)[base[:, None, :3]],
        }
        if "shN" in meta:
            arrays["colours"] = np.concatenate([arrays["colours"], files.further(meta, count)], axis=1)
        return arrays, files.digest.hexdigest(), unused_note(path, meta)


class _SogFiles:
    """Images and the description of a SOG archive or folder; each access checks what it reads."""

    def __init__(self, path: Path):
        self.path, self.archive, self.digest = path, None, hashlib.sha256()

    def __enter__(self) -> _SogFiles:
        if self.path.suffix.lower() == ".sog":
            if fault := irregular(self.path, memory() // 4):
                raise SplatsError(f"{shown(self.path)}: {fault}")
            try:
                self.archive = zipfile.ZipFile(self.path)
            except OSError as e:
                raise SplatsError(f"{self.path}: cannot be read ({e.strerror or reason(e)})") from None
            except Exception as e:  # zipfile has several
                raise SplatsError(f"{self.path}: is not a ZIP archive, or is damaged ({reason(e)})") from None
        return self

    def __exit__(self, *_) -> None:
        if self.archive is not None:
            self.archive.close()

    def content(self, name: str, most: int) -> bytes:
        """Return the bytes of a file, at most so many."""
        try:
            if self.archive is not None:
                with self.archive.open(name) as file:
                    content = file.read(most + 1)
            else:
                with (self.path.parent / name).open("rb") as file:
                    content = file.read(most + 1)
        except KeyError:
            raise SplatsError(f"{self.path}: holds no file {name}") from None
        except Exception as e:  # zipfile has several
            if self.archive is None and isinstance(e, OSError):
                raise SplatsError(f"{self.path}: {name} cannot be read ({e.strerror or reason(e)})") from None
            raise SplatsError(f"{self.path}: {name} is damaged ({reason(e)})") from None
        if len(content) > most:
            raise SplatsError(f"{self.path}: {name} has more than {most:,} bytes")
        self.digest.update(content)
        return content

    def meta(self) -> dict:
        """Return the description."""
        content = self.content(META if self.archive is not None else self.path.name, META_BYTES)
        try:
            meta = json.loads(content, object_hook=RecordedKeys)
        except ValueError as e:
            raise SplatsError(f"{self.path}: {META} is no JSON ({reason(e)})") from None
        if not isinstance(meta, dict) or meta.get("version") != 2:
            version = meta.get("version", "none") if isinstance(meta, dict) else "none"
            raise SplatsError(f"{self.path}: has the SOG version {version!s:.20}, only 2 is read")
        return meta

    def part(self, meta: dict, name: str) -> dict:
        """Return the description of a property."""
        part = meta.get(name)
        if not isinstance(part, dict):
            raise SplatsError(f'{self.path}: {META} has no object "{name}"')
        return part

    def number(self, part: dict, name: str, most: int) -> int:
        """Return a whole number from 0 to ``most``."""
        value = part.get(name)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= most:
            raise SplatsError(f'{self.path}: "{name}" in {META} is {value!s:.20}, allowed is 0 to {most:,}')
        return value

    def numbers(self, meta: dict, name: str, key: str, count: int) -> np.ndarray:
        """Return ``count`` finite numbers of a property."""
        try:
            values = np.array(self.part(meta, name).get(key), np.float64)
        except (TypeError, ValueError):
            values = np.zeros(0)
        if values.shape != (count,) or not np.isfinite(values).all():
            raise SplatsError(f'{self.path}: "{key}" of "{name}" in {META} is no list of {count} finite numbers')
        return values

    def image(self, meta: dict, name: str, which: int, count: int) -> np.ndarray:
        """Return the bytes ``(count, 4)`` of an image of a property, the first pixels row by row."""
        pixels = self.picture(meta, name, which, count).reshape(-1, 4)
        if len(pixels) < count:
            raise SplatsError(
                f'{self.path}: image {which} of "{name}" has {len(pixels):,} pixels for {count:,} Gaussians'
            )
        return pixels[:count]

    def picture(self, meta: dict, name: str, which: int, count: int) -> np.ndarray:
        """Return an image of a property, ``(height, width, 4)``, uint8, of at most 4 · ``count`` + 65,536 pixels."""
        from PIL import Image

        files = self.part(meta, name).get("files")
        file = files[which] if isinstance(files, list) and len(files) > which else None
        if not isinstance(file, str) or PurePosixPath(file).name != file or not file.isprintable():
            raise SplatsError(f'{self.path}: "{name}" in {META} names no file {which} beside it')
        most = 4 * count + (1 << 16)
        content = self.content(file, 8 * most)
        try:
            with Image.open(io.BytesIO(content), formats=FORMATS) as image:
                if image.width * image.height > most:
                    raise SplatsError(
                        f"{self.path}: {file} has {image.width} x {image.height} pixels for {count:,} items"
                    )
                return np.array(image.convert("RGBA"))
        except SplatsError:
            raise
        except Exception as e:  # of the decoders, each has its own
            raise SplatsError(f"{self.path}: {file} is no image, or is damaged ({reason(e)})") from None

    def rotations(self, pixels: np.ndarray) -> np.ndarray:
        """Return quaternions (x, y, z, w): alpha − 252 names the largest of (w, x, y, z), which is left out."""
        largest = pixels[:, 3].astype(int) - 252
        if (largest < 0).any():
            raise SplatsError(
                f"{self.path}: has {np.count_nonzero(largest < 0):,} rotations without a largest component"
            )
        others = (2 * pixels[:, :3].astype(np.float64) / 255 - 1) / np.sqrt(2)
        scalar_first = np.empty((len(pixels), 4))
        for component in range(4):
            rows = largest == component
            scalar_first[np.ix_(rows, [c for c in range(4) if c != component])] = others[rows]
            scalar_first[rows, component] = np.sqrt(np.maximum(0, 1 - np.square(others[rows]).sum(axis=1)))
        return scalar_first[:, [1, 2, 3, 0]]

    def further(self, meta: dict, count: int) -> np.ndarray:
        """Return the coefficients of degree 1 and more, ``(count, K, 3)``, from their palette."""
        part = self.part(meta, "shN")
        colours, bands = self.number(part, "count", 1 << 16), self.number(part, "bands", 3)
        if not colours or not bands:
            raise SplatsError(f'{self.path}: "shN" in {META} has {colours} colours of degree {bands}')
        coefficients = (bands + 1) ** 2 - 1
        pixels = self.picture(meta, "shN", 0, PALETTE_WIDTH * coefficients * -(-colours // PALETTE_WIDTH))
        if pixels.shape[1] != PALETTE_WIDTH * coefficients or pixels.shape[0] * PALETTE_WIDTH < colours:
            raise SplatsError(
                f'{self.path}: the palette of "shN" has {pixels.shape[1]} x {pixels.shape[0]} pixels, {colours:,} '
                f"colours of degree {bands} need {PALETTE_WIDTH * coefficients} x {-(-colours // PALETTE_WIDTH)}"
            )
        palette = pixels.reshape(-1, coefficients, 4)[:colours, :, :3]
        labels = self.image(meta, "shN", 1, count).astype(int)
        index = labels[:, 0] + 256 * labels[:, 1]
        if index.max() >= colours:
            raise SplatsError(f"{self.path}: has the label {index.max():,}, the palette has {colours:,} colours")
        return self.numbers(meta, "shN", "codebook", 256)[palette[index]]
