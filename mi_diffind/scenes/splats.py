"""3D Gaussians of "3D Gaussian Splatting" (Kerbl et al. 2023), and views of them for a field.

PLY files are those of the reference implementation, text or binary. SOG (version 2, PlayCanvas: "Spatially Ordered
Gaussians") holds 8-bit images and a ``meta.json`` with their ranges and codebooks, in a folder or in a ZIP archive
``NAME.sog``.

Mitsuba traces the Gaussians: the shape ``ellipsoidsmesh`` orders them along a ray, and the integrator
``volprim_rf_basic`` gives the transmittance and the colour of each. Two things are added to that integrator. It has an
alpha of 1 everywhere, here rays keep their transmittance. And its rays go on 1e-4 behind each hit, whatever the scene's
size, which skips Gaussians of a small scene; here all scenes are traced at one size.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import itertools
import json
import os
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core import compat
from ..core.errors import DiffindError, reason
from ..core.files import RecordedKeys, irregular, shown, unused_note
from ..core.units import check_memory, memory
from ..images.srgb import to_linear

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

    The arrays are those of :class:`Splats`, float32. Raises :class:`SplatsError`.
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


#: Opacity below which a Gaussian is left out: it changes no 8-bit value.
FAINT = 1 / 255

#: Contribution to a ray at which a Gaussian ends, for boxes.
EDGE = 0.05

#: Shares of opacity below and above the box of most Gaussians along an axis, and the part of that box's sides by which
#: it is widened. Gaussians outside count as strays.
STRAY, WIDER = 0.01, 0.25

#: Half diagonal of the box of all Gaussians while they are traced, and the step behind a hit.
SIZE, STEP = 100.0, 1e-4

#: Transmittance at which a ray ends, and counts as stopped.
OPAQUE = 0.01

#: Samples of one pass, and bytes of memory for a Gaussian, roughly: a shell of 20 triangles.
PASS, GAUSSIAN = 1 << 21, 4096

#: Default number of samples a pixel.
SPP = 4


@dataclass(frozen=True, eq=False)
class Splats:
    """Gaussians of a file, as arrays of float32.

    ``centres`` ``(N, 3)``; ``scales`` ``(N, 3)``, standard deviations along the axes that the ``quaternions``
    ``(N, 4)`` (x, y, z, w, of length 1) turn; ``opacities`` ``(N,)`` in [0, 1]; ``colours`` ``(N, K, 3)``, coefficients
    of spherical harmonics, whose sum plus 0.5 is the colour as displayed (sRGB). ``digest`` is the SHA-256 of the
    file, ``notes`` are sentences on what is not used of it.
    """

    path: Path
    centres: np.ndarray
    scales: np.ndarray
    quaternions: np.ndarray
    opacities: np.ndarray
    colours: np.ndarray
    digest: str
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.centres)

    @staticmethod
    def read(path: str | os.PathLike) -> Splats:
        """Read a PLY file or SOG (:mod:`.splat_files`). Raises :class:`SplatsError`."""
        arrays, digest, notes = read_gaussians(path)
        return Splats(Path(path), digest=digest, notes=notes, **arrays)

    def chosen(self, which: np.ndarray) -> Splats:
        """Return some of the Gaussians, by a mask ``(N,)`` or numbers."""
        names = ("centres", "scales", "quaternions", "opacities", "colours")
        return dataclasses.replace(self, **{name: getattr(self, name)[which] for name in names})

    def cropped(self, box=None) -> Splats:
        """Return the visible Gaussians whose centres lie in a ``box``: lower corner, upper corner.

        The default box holds 98% of the opacity along each axis, and a quarter more on both sides. Raises
        :class:`SplatsError` if none is left.
        """
        visible = self.chosen(self.opacities >= FAINT)
        if not len(visible):
            raise SplatsError(f"{self.path}: has {len(self):,} Gaussians, none with an opacity of 1/255 or more")
        box = visible.most() if box is None else np.array(box, np.float64).reshape(2, 3)
        inside = ((visible.centres >= box[0]) & (visible.centres <= box[1])).all(axis=1)
        if not inside.any():
            text = " to ".join("(" + ", ".join(f"{x:.4g}" for x in corner) + ")" for corner in visible.most())
            raise SplatsError(f"box: holds none of the {len(self):,} Gaussians of {self.path}, most lie in {text}")
        return visible.chosen(inside)

    def most(self) -> np.ndarray:
        """Return the box ``(2, 3)`` outside of which Gaussians count as strays."""
        box = np.empty((2, 3))
        for axis, values in enumerate(self.centres.T.astype(np.float64)):
            order = np.argsort(values)
            weight = np.cumsum(self.opacities[order], dtype=np.float64)
            ends = np.searchsorted(weight, weight[-1] * np.array([STRAY, 1 - STRAY]))
            box[:, axis] = values[order[np.minimum(ends, len(values) - 1)]]
        return box + np.array([[-WIDER], [WIDER]]) * (box[1] - box[0])

    def extents(self) -> np.ndarray:
        """Return half the sides ``(N, 3)`` of the box around each Gaussian, where it adds more than 5% to a ray."""
        x, y, z, w = self.quaternions.T.astype(np.float64)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        reach = np.sqrt(2 * np.log(np.maximum(self.opacities / EDGE, 1), dtype=np.float64))
        return reach[:, None] * np.sqrt(np.einsum("ijn,nj->ni", np.square(rows), np.square(self.scales)))

    def box(self) -> np.ndarray:
        """Return the corners ``(2, 3)`` of the box around all Gaussians."""
        extents = self.extents()
        return np.stack([(self.centres - extents).min(axis=0), (self.centres + extents).max(axis=0)])


class SplatSubject:
    """Gaussians of a file as the subject of a capture, cropped to a ``box`` (default: :meth:`Splats.cropped`).

    Raises :class:`SplatsError`, also in a variant without RGB, and :class:`.UsageError` if the
    Gaussians need more memory than there is.
    """

    def __init__(self, path: str | os.PathLike, box=None):
        self.path = Path(path)
        if not mi.is_rgb:
            raise SplatsError(f"{path}: the variant {mi.variant()} shows no Gaussians, one with rgb is needed")
        splats = Splats.read(path)
        self.splats, self.total, self.notes = splats.cropped(box), len(splats), splats.notes
        check_memory(f"{path}: Gaussians", len(self.splats), GAUSSIAN * len(self.splats))

    def record(self) -> dict:
        """Return what the images depend on beside the settings."""
        return {"scene": self.path.name, "defines": {}, "digest": self.splats.digest}

    def bounds(self) -> np.ndarray:
        """Return the corners ``(2, 3)`` of the Gaussians' box."""
        return self.splats.box()

    def reach(self, centre: np.ndarray) -> float:
        """Return the radius of a sphere around a point that holds the Gaussians' box."""
        corners = np.array(list(itertools.product(*self.bounds().T)))
        return float(np.linalg.norm(corners - centre, axis=1).max())

    def camera(self, settings) -> SplatCamera:
        """Return the camera of a capture with these settings."""
        return SplatCamera(self.splats, settings)


class SplatCamera:
    """Camera that sees Gaussians, ``settings`` (:class:`.capture_settings.CaptureSettings`) as for a scene."""

    def __init__(self, splats: Splats, settings):
        self.settings = settings
        box = splats.box()
        self.centre, self.scale = box.mean(axis=0), SIZE / max(np.linalg.norm(box[1] - box[0]) / 2, 1e-30)
        centres = (splats.centres - self.centre) * self.scale
        data = np.concatenate([centres, splats.scales * self.scale, splats.quaternions], axis=1)
        arrays = {
            "data": data, "opacities": splats.opacities[:, None], "sh_coeffs": splats.colours.reshape(len(splats), -1),
        }  # fmt: skip
        tensors = {name: mi.TensorXf(np.ascontiguousarray(array, np.float32)) for name, array in arrays.items()}
        self.scene = mi.load_dict({"type": "scene", "splats": {"type": "ellipsoidsmesh", **tensors}})
        self.integrator = mi.load_dict({"type": "volprim_rf_basic", "srgb_primitives": False})

    def render(self, pose: np.ndarray, seed: int) -> np.ndarray:
        """Render a view, ``(height, width, 4)``, float32: linear colours, multiplied by alpha, and alpha."""
        side, spp = self.settings.resolution, self.settings.spp
        rng = np.random.default_rng(seed)
        shift, total = rng.random((2, side * side)), np.zeros((side * side, 4))
        y, x = np.divmod(np.arange(side * side), side)
        slope = 2 * np.tan(np.radians(self.settings.fov) / 2) / side
        at_once = max(1, PASS // side**2)
        for first in range(0, spp, at_once):
            # Points of the sequence R2 (Roberts 2018), moved by a random offset in each pixel
            numbers = np.arange(first, min(spp, first + at_once))[:, None]
            u, v = ((numbers * step + s) % 1 for step, s in zip((0.7548776662, 0.5698402910), shift, strict=True))
            d = np.stack([(x + u - side / 2) * slope, (side / 2 - y - v) * slope, -np.ones_like(u)], axis=-1)
            d = (d / np.linalg.norm(d, axis=-1, keepdims=True)).reshape(-1, 3) @ pose[:3, :3].T
            total += self.trace((pose[:3, 3] - self.centre) * self.scale, d).reshape(len(numbers), -1, 4).sum(axis=0)
        image = (total / spp).reshape(side, side, 4)
        alpha = image[..., 3:]
        straight = np.clip(image[..., :3] / np.maximum(alpha, 1e-6), 0, 1)
        return np.concatenate([to_linear(straight) * alpha, alpha], axis=-1).astype(np.float32)

    def trace(self, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return sRGB multiplied by alpha, and alpha, ``(N, 4)``, along rays from one point, at the traced size."""
        ahead = np.maximum(0, -(directions @ origin) - 2 * SIZE)  # far origins are not exact enough
        points = origin + ahead[:, None] * directions
        p, d = (np.ascontiguousarray(v.T, np.float32) for v in (points, directions))
        colour, transmittance = composite(self.scene, self.integrator, mi.Point3f(p), mi.Vector3f(d))
        return np.concatenate([colour.numpy().T, 1 - transmittance.numpy()[:, None]], axis=1)


@compat.syntax
def composite(scene, integrator, p, d):
    """Return the colour (sRGB) of the Gaussians along rays, and the transmittance behind them.

    Where the transmittance falls below :data:`OPAQUE`, the ray ends, and the colour is divided by the opacity.
    """
    ray, p = mi.Ray3f(p, d), mi.Point3f(p)
    colour, transmittance, active = mi.Color3f(0), mi.Float(1), mi.Bool(True)
    while active:
        si = scene.ray_intersect(mi.Ray3f(p, d), mi.RayFlags.Minimal, False, active)
        active &= si.is_valid()
        passed = integrator.eval_transmission(si, ray, active)
        emitted = integrator.eval_sh_emission(si, ray, active)
        colour[active] = colour + transmittance * (1 - passed) * emitted
        transmittance[active] = transmittance * passed
        p[active] = p + (si.t + STEP) * d
        active &= transmittance > OPAQUE
    stopped = transmittance <= OPAQUE
    return colour * dr.select(stopped, dr.rcp(1 - transmittance), 1), dr.select(stopped, 0, transmittance)
