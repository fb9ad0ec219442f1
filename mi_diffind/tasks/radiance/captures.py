"""Files of captures: lists of views, cameras, lenses, and image files.

Views are listed in the JSON of NeRF's Blender data (Mildenhall et al. 2020: ``transforms_train.json``,
``transforms_test.json``, ``transforms_val.json``), of nerfstudio and of instant-ngp (``transforms.json``), or in a
model of COLMAP. Poses map camera to world; a camera looks along −z with y up. Transforms that nerfstudio has already
applied to the poses (``applied_transform``, ``applied_scale``) are not undone. Unused keys are named in a note.

A camera is described by keys of its frame and of the whole file; those of the frame go first.

- Focal lengths along the axes x and y: ``fl_x`` in pixels, else the field of view, ``x_fov`` in degrees or
  ``camera_angle_x`` in radians; likewise for y, which has the focal length of x by default.
- ``cx``, ``cy``: the principal point in pixels from the upper left corner; ``w``, ``h``: the size of the image.
- Lenses: ``k1`` to ``k6``, ``p1``, ``p2``, or nerfstudio's list ``distortion_params``.
- Projections that are not those of a pinhole or of such a lens are refused by name.

The model of a lens is OpenCV's, of which SIMPLE_RADIAL and RADIAL are parts. With u = (x − c_x) / f_x,
v = (y − c_y) / f_y, r² = u² + v², and y downwards, a pinhole's point (u, v) is seen at

    u' = d u + 2 p₁ u v + p₂ (r² + 2 u²),  v' = d v + p₁ (r² + 2 v²) + 2 p₂ u v,
    d = (1 + k₁ r² + k₂ r⁴ + k₃ r⁶) / (1 + k₄ r² + k₅ r⁴ + k₆ r⁶).

PNG and JPEG hold sRGB, not multiplied by alpha; EXR holds linear values multiplied by alpha. An image without alpha is
opaque everywhere.
"""

import functools
import json
import math
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.ndimage import map_coordinates

from ...core.archives import Allowance, LimitError, json_bytes
from ...core.errors import DiffindError, missing_package, raised_as, reason
from ...core.files import MOST_TEXT, OutsideError, RecordedKeys, irregular, path_by_name, shown, unused_note
from ...core.units import memory
from ...images.reader import ENCODED, Picture, PictureError, read_picture
from ...images.srgb import from_linear, to_linear

#: Extensions tried in turn for an image name without one.
EXTENSIONS = (".png", ".jpg", ".jpeg", ".exr")

#: Extensions of one format.
JPEG = (".jpg", ".jpeg")

#: Bytes up to this one are black in a mask that was written as JPEG, whose black is not exact.
BLACK_OF_JPEG = 127

#: Byte of sRGB → linear value, and byte of alpha → share.
LINEAR, SHARE = to_linear(np.arange(256) / 255).astype(np.float32), np.arange(256, dtype=np.float32) / np.float32(255)


class ViewsError(DiffindError, ValueError):
    """Error for unusable images or poses; the message is one sentence that names the file and the fault."""


class MissingImageError(ViewsError):
    """Error for an image that a list of views names and that does not exist."""


def image_file(root: Path, name: str, file: Path) -> Path:
    r"""Return the path of an image in the folder ``root``, which the ``file`` with a list of views names.

    The name may lack its extension, have ``\`` between folders, and differ from the file's in upper and lower case, or
    by ``.jpg`` and ``.jpeg``. Raises :class:`MissingImageError`, and :class:`ViewsError` for a path out of the folder.
    """
    names = [name, *(name + extension for extension in EXTENSIONS)]
    if Path(name).suffix.lower() in JPEG:
        names += [str(Path(name).with_suffix(suffix)) for suffix in JPEG]
    for spelling in names:
        with raised_as(ViewsError, OutsideError):
            path = path_by_name(root, spelling, file)
        if fault := irregular(path, memory() // 4):
            raise ViewsError(f"{shown(path)}: {fault}, {file.name} names it")
        if path.is_file():
            return path
    more = "" if Path(name).suffix.lower() in EXTENSIONS else f", nor with {', '.join(EXTENSIONS)}"
    raise MissingImageError(f"{shown(Path(root) / name)}: no such image{more}, {file.name} names it")


def is_linear(path: Path) -> bool:
    """Return whether an image file holds linear values."""
    return path.suffix.lower() == ".exr"


def read_image(path: Path) -> tuple[np.ndarray, bool]:
    """Return an image ``(height, width, 4)`` as the file has it, and whether the file has alpha.

    That is uint8, or float32 for EXR. Raises :class:`ViewsError`.
    """
    picture, encoded = _read(path), not is_linear(path)
    values = picture.values
    if encoded:
        if values.dtype.name not in ENCODED or not picture.named:
            raise ViewsError(
                f"{path}: holds {values.shape[2]} channels of {values.dtype}, allowed are bytes of grey or RGB"
            )
        values, has_alpha = _as_bytes(values), picture.has_alpha
    else:
        places = {name: i for i, name in enumerate(picture.channels)}
        colours = next((c for c in (("R", "G", "B"), ("Y",)) if set(c) <= set(places)), None)
        if colours is None or values.dtype.name in ENCODED:
            raise ViewsError(f"{path}: has the channels {', '.join(sorted(places))}, expected R, G, B or Y, and A")
        has_alpha = "A" in places
        values = values[..., [places[name] for name in (*colours, *(("A",) if has_alpha else ()))]].astype(np.float32)
        if not np.isfinite(values).all():
            raise ViewsError(f"{path}: has {np.count_nonzero(~np.isfinite(values)):,} values that are NaN or infinite")
    image = np.full((*values.shape[:2], 4), 255 if encoded else 1, values.dtype)
    image[..., :3] = values[..., :-1] if has_alpha else values
    if has_alpha:
        image[..., 3] = values[..., -1] if encoded else np.clip(values[..., -1], 0, 1)
    return image, has_alpha


def _read(path: Path) -> Picture:
    with raised_as(ViewsError, PictureError):
        return read_picture(path)


def _as_bytes(values: np.ndarray) -> np.ndarray:
    """Return numbers of 8 or 16 bits as bytes."""
    return values if values.dtype == np.uint8 else (values >> 8).astype(np.uint8)


def linear_pixels(image: np.ndarray) -> np.ndarray:
    """Return an image ``(…, 4)`` of bytes or halves as float32: linear colours multiplied by alpha, and alpha."""
    if image.dtype != np.uint8:
        return image.astype(np.float32)
    values = np.empty(image.shape, np.float32)
    values[..., 3] = alpha = SHARE[image[..., 3]]
    for channel in range(3):  # three times as fast as all at once
        np.multiply(LINEAR[image[..., channel]], alpha, out=values[..., channel])
    return values


def byte_pixels(image: np.ndarray) -> np.ndarray:
    """Return an image ``(…, 4)`` of linear colours multiplied by alpha, and alpha, as bytes of sRGB and alpha."""
    alpha = image[..., 3:]
    straight = image[..., :3] / np.where(alpha > 0, alpha, 1)
    shown = from_linear(np.clip(straight, 0, 1))
    return np.rint(255 * np.concatenate([shown, np.clip(alpha, 0, 1)], axis=-1)).astype(np.uint8)


def like(image: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return linear ``values`` multiplied by alpha as bytes if an ``image`` has bytes, else as they are."""
    return byte_pixels(values) if image.dtype == np.uint8 else values


def reduce_image(image: np.ndarray, mask: np.ndarray | None, factor: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Return an image of :func:`read_image` and its mask at a resolution that is lower by a whole ``factor``.

    Linear colours multiplied by alpha are averaged. A pixel counts if all that it covers count. Rows and columns at the
    right and the bottom that fill no pixel are left out.
    """
    height, width = (side // factor for side in image.shape[:2])
    rows = []
    for row in range(height):  # one after the other, since a photograph in single precision is large
        values = linear_pixels(image[row * factor : (row + 1) * factor, : width * factor])
        rows.append(values.reshape(factor, width, factor, 4).mean(axis=(0, 2)))
    if mask is not None:
        blocks = mask[: height * factor, : width * factor].reshape(height, factor, width, factor)
        mask = blocks.all(axis=(1, 3))
    return like(image, np.stack(rows)), mask


def read_mask(path: Path, image: np.ndarray, image_path: Path) -> tuple[np.ndarray, bool]:
    """Return the mask of an image, bool ``(height, width)``, true where a pixel counts, and whether alpha holds it.

    Alpha holds the mask if the file has an alpha that is not 1 everywhere, else the luminance does. A pixel counts
    where it is not 0 or, in a JPEG, above :data:`BLACK_OF_JPEG`. Raises :class:`ViewsError`, also if the sizes differ.
    """
    picture = _read(path)
    values, alpha = picture.values[..., : picture.colors], picture.values[..., picture.colors :]
    if values.dtype.name not in ENCODED or not picture.named:
        raise ViewsError(f"{path}: cannot be read as a mask, it holds {values.shape[2]} channels of {values.dtype}")
    if in_alpha := picture.has_alpha and bool(alpha.min() < np.iinfo(alpha.dtype).max):
        mask = alpha[..., 0] > 0
    else:
        luminance = values[..., 0]
        if values.shape[2] == 3:  # Rec. 601, in 16 bits after the point
            luminance = (_as_bytes(values).astype(np.uint32) @ np.uint32([19595, 38470, 7471]) + 2**15) >> 16
        with open(path, "rb") as file:
            is_jpeg = file.read(2) == b"\xff\xd8"
        mask = luminance > (BLACK_OF_JPEG if is_jpeg else 0)
    if mask.shape != image.shape[:2]:
        sizes = " × ".join(map(str, mask.shape[::-1])), " × ".join(map(str, image.shape[1::-1]))
        raise ViewsError(f"{path}: has {sizes[0]} pixels, its image {image_path.name} has {sizes[1]}")
    return mask, in_alpha


#: Coefficients of a distortion, in the order in which they are kept.
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


def distort(u: np.ndarray, v: np.ndarray, coefficients) -> tuple[np.ndarray, np.ndarray]:
    """Return where a lens shows the points (``u``, ``v``) of a pinhole of the focal length 1."""
    *k, p1, p2 = coefficients
    r2 = u * u + v * v
    d = _factor(r2, k)
    return d * u + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), d * v + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v


def _factor(r2: np.ndarray, k) -> np.ndarray:
    """Return the factor d of radii, given their squares and k₁ to k₆."""
    above, below = (1 + r2 * (a + r2 * (b + r2 * c)) for a, b, c in (k[:3], k[3:]))
    return above / below


@functools.lru_cache(maxsize=2)
def _sources(height: int, width: int, focal, centre, coefficients) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns ``(2, height, width)`` in a photograph for each pixel of a pinhole; whether they exist.

    There is none outside the photograph, nor beyond the radius at which the polynomials turn back.
    """
    u = (np.arange(width) + 0.5 - centre[0]) / focal[0]
    v = (np.arange(height) + 0.5 - centre[1])[:, None] / focal[1]
    x, y = distort(u, v, coefficients)
    x, y = x * focal[0] + centre[0] - 0.5, y * focal[1] + centre[1] - 0.5
    r2 = u * u + v * v
    radii = np.linspace(0, np.sqrt(r2.max()), 1024)  # radii at which the distortion is tried
    turning = np.flatnonzero(np.diff(radii * _factor(radii**2, coefficients[:6])) <= 0)
    limit = radii[turning[0]] if len(turning) else np.inf
    exists = (np.abs(x - (width - 1) / 2) <= width / 2) & (np.abs(y - (height - 1) / 2) <= height / 2)
    return np.stack([y, x]).astype(np.float32), exists & (r2 <= limit**2)


def undistort(image: np.ndarray, mask: np.ndarray | None, focal, centre, coefficients) -> tuple:
    """Return a photograph as a pinhole of the same ``focal`` lengths and ``centre`` sees it, and its mask.

    ``image`` ``(height, width, 4)`` and the result are as :func:`read_image` returns them; colours are interpolated
    linearly, as linear values multiplied by alpha. ``mask`` ``(height, width)``, bool, is true where a pixel counts
    (``None``: everywhere). The returned mask excludes pixels that the photograph does not show, which are 0.
    """
    places, exists = _sources(*image.shape[:2], tuple(focal), tuple(centre), tuple(coefficients))
    values = linear_pixels(image)
    planes = [map_coordinates(values[..., c], places, order=1, mode="nearest", prefilter=False) for c in range(4)]
    straightened = np.stack(planes, axis=-1) * exists[..., None]
    if mask is not None:
        exists = exists & map_coordinates(mask.astype(np.uint8), places, order=0, mode="nearest", prefilter=False) > 0
    return like(image, straightened), exists


#: Axes of an image, and the keys of the focal length or of the field of view along each.
FOCAL = {axis: (f"fl_{axis}", f"{axis}_fov", f"camera_angle_{axis}") for axis in "xy"}

#: Entries of nerfstudio's ``distortion_params``.
DISTORTION_PARAMS = ("k1", "k2", "k3", "k4", "p1", "p2")

#: Camera models that are read; a distortion may be 0.
CAMERA_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")

#: Keys of instant-ngp that name other projections.
PROJECTIONS = {
    "is_fisheye": "fisheye", "latlong": "latlong", "equirectangular": "equirectangular", "orthographic": "orthographic",
    "ftheta_p0": "f-theta",
}  # fmt: skip

#: Focal lengths, sizes and places in pixels and the coefficients of lenses are smaller.
LONGEST = 1e9

#: Fields of view in radians are larger: those of telescopes.
SMALLEST_ANGLE = 1e-6


def camera_numbers(where: str, frame: dict, file: dict) -> dict[str, float]:
    """Return the numbers of the camera of a ``frame`` by their names, those that the ``file`` gives for all included.

    Fields of view in degrees become ``camera_angle_x`` and ``camera_angle_y``, lists of distortion parameters become
    their names. ``where`` begins the sentence of a :class:`ViewsError`.
    """
    levels = frame, file
    model = _check_model(where, levels)
    numbers = {}
    for name in ("w", "h", "cx", "cy"):
        numbers[name] = next((v for level in levels if (v := _number(where, level, name)) is not None), None)
    for names in FOCAL.values():
        level = next((level for level in levels if any(level.get(name) is not None for name in names)), file)
        pixels, degrees, radians = (_number(where, level, name) for name in names)
        if degrees is not None:
            if not 0 < degrees < 180:
                raise ViewsError(f'{where} has the "{names[1]}" {degrees:g}, expected degrees between 0 and 180')
            radians = math.radians(degrees)
        numbers |= {names[0]: pixels, names[2]: radians}
    if numbers["fl_x"] is None and numbers["camera_angle_x"] is None:
        raise ViewsError(f'{where} has no focal length: neither "camera_angle_x" nor "fl_x" is given')
    numbers = {name: value for name, value in numbers.items() if value is not None} | _lens(where, levels, model)
    for names, least, limit, allowed in (
        (("fl_x", "fl_y", "w", "h"), 0, LONGEST, f"a number > 0 and < {LONGEST:g}"),
        (("camera_angle_x", "camera_angle_y"), SMALLEST_ANGLE, np.pi, f"radians between {SMALLEST_ANGLE:g} and π"),
        (("cx", "cy", *DISTORTION), -LONGEST, LONGEST, f"a number between -{LONGEST:g} and {LONGEST:g}"),
    ):
        for name in names:
            if name in numbers and not least < numbers[name] < limit:
                raise ViewsError(f'{where} has the "{name}" {numbers[name]:g}, expected {allowed}')
    return numbers


def focal_lengths(numbers: dict[str, float], width: int, height: int) -> tuple[tuple[float, float], list[str]]:
    """Return the focal lengths along x and y in pixels of an image of this size, and notes on what contradicts them."""
    focal, notes = {}, []
    for (axis, (pixels, _, angle)), side in zip(FOCAL.items(), (width, height), strict=True):
        by_angle = side / 2 / np.tan(numbers[angle] / 2) if angle in numbers else focal.get("x")
        focal[axis] = numbers.get(pixels, by_angle)
        if angle in numbers and abs(by_angle / focal[axis] - 1) > 5e-3:  # the focal lengths differ by half a percent
            notes.append(
                f'the field of view {numbers[angle]:.4g} ("{angle}") would be a focal length of {by_angle:.4g} pixels, '
                f'the "{pixels}" {focal[axis]:.4g} is used'
            )
    return (focal["x"], focal["y"]), notes


def _check_model(where: str, levels: tuple[dict, dict]) -> str:
    """Return the camera model, or raise :class:`ViewsError` if it is not read."""
    model = next((level["camera_model"] for level in levels if level.get("camera_model") is not None), "PINHOLE")
    name = model.upper() if isinstance(model, str) else model
    given = (PROJECTIONS[key] for key in PROJECTIONS for level in levels if level.get(key) not in (None, False))
    other = next(given, "")
    if name not in CAMERA_MODELS or other:
        raise ViewsError(
            f"{where} has the camera model {other if name in CAMERA_MODELS else model!r:.40}, allowed are "
            f"{', '.join(CAMERA_MODELS)}: undistort the images first"
        )
    return name


def _lens(where: str, levels: tuple[dict, dict], model: str) -> dict[str, float]:
    """Return the coefficients of the distortion by their names."""
    lens: dict[str, float] = {}
    for level in levels:
        entries = level.get("distortion_params") if set(DISTORTION_PARAMS) - lens.keys() else None
        if entries is None:
            given = {name: _number(where, level, name) for name in DISTORTION if name not in lens}
        elif isinstance(entries, list) and len(entries) == len(DISTORTION_PARAMS):
            given = dict(zip(DISTORTION_PARAMS, entries, strict=True))
            given = {name: _number(where, given, name) for name in given}
        else:
            raise ViewsError(
                f'{where} has the "distortion_params" {entries!r:.60}, expected the list '
                f"[{', '.join(DISTORTION_PARAMS)}] of nerfstudio"
            )
        lens = {name: value for name, value in given.items() if value is not None} | lens
    if lens.get("k4") and not (lens.get("k5") or lens.get("k6") or model == "FULL_OPENCV"):
        raise ViewsError(
            f"{where} has the distortion k4 = {lens['k4']:g}, which nerfstudio multiplies by r⁸ and OpenCV divides by: "
            f'undistort the images first, or name the "camera_model" FULL_OPENCV'
        )
    return lens


def _number(where: str, entries: dict, name: str) -> float | None:
    value = entries.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < float("inf"):
        raise ViewsError(f'{where} has the "{name}" {value!r:.40}, expected a number')
    try:
        return float(value)
    except OverflowError:  # a whole number of more than 308 digits
        raise ViewsError(f'{where} has a "{name}" above 1e308, expected a number') from None


SPLITS = ("train", "test", "val")

#: Tolerance of the columns of a rotation: lengths against 1, and dot products against 0.
RIGID = 1e-3


@dataclass(frozen=True)
class Frame:
    """One view in a list: the name of its image, pose ``(4, 4)``, camera to world, and the ``numbers`` of its camera.

    The numbers are those of :func:`camera_numbers`. ``mask`` names a mask.
    """

    image: str
    pose: np.ndarray
    numbers: dict[str, float]
    mask: str | None = None


@dataclass(frozen=True)
class FrameList:
    """Views of a split: the ``file`` that lists them, the folder of their images, and what else the file says.

    ``box`` ``(2, 3)`` holds two corners; ``points`` ``(n, 3)`` lie on surfaces. ``settings`` are those that a fitted
    field records, ``notes`` sentences for the user.
    """

    file: Path
    root: Path
    frames: list[Frame]
    box: np.ndarray | None = None
    points: np.ndarray | None = None
    settings: dict = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Name of the file in its folder."""
        return self.file.relative_to(self.root).as_posix()


def list_frames(folder: Path, split: str) -> FrameList:
    """Return the views of a ``split`` that JSON files in a folder or, without such, a model of COLMAP list.

    Raises :class:`ViewsError`.
    """
    if not any(folder.glob("transforms*.json")):
        for name in ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse"):
            if any((folder / name / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt")):
                return colmap_frames(folder, folder / name, split)
    file, content, frames = _frames(folder, split)
    content["frames"] = frames  # those of other splits are not read
    cameras, box = [_camera(file, content, frame) for frame in frames], _box(file, content)
    settings = {name: content[name] for name in ("applied_transform", "applied_scale") if name in content}
    note = unused_note(file, content)
    return FrameList(file, file.parent, cameras, box, settings=settings, notes=(note,) if note else ())


def _part(entries: list, split: str) -> list:
    """Return the entries of a split of a list without splits: every eighth one is a test view."""
    # Every eighth view, as in LLFF's data
    return entries if len(entries) == 1 else [e for i, e in enumerate(entries) if (i % 8 == 0) == (split == "test")]


def _frames(folder: Path, split: str) -> tuple[Path, dict, list[dict]]:
    """Return the file that lists the views of a split, its content, and the entries of these views.

    Views for a validation are the test views of a capture without others.
    """
    if fault := irregular(folder):
        raise ViewsError(f"{shown(folder)}: {fault}")
    if not folder.is_dir():
        raise ViewsError(f"{folder}: {'is not a folder' if folder.exists() else 'no such folder'}")
    files, single = {s: folder / f"transforms_{s}.json" for s in SPLITS}, folder / "transforms.json"
    test = "val" if files["val"].is_file() and not files["test"].is_file() else "test"
    file = files[test if split == "test" else split]
    if file.is_file() or files["train"].is_file():
        whole = split != "val" and not files[test].is_file()  # the list of all views
        file = files["train"] if whole else file
        if not file.is_file():
            raise ViewsError(f"{file}: no such file")
        content, frames = _parse(file)
        return file, content, _part(frames, split) if whole else frames
    if not single.is_file():
        raise ViewsError(
            f"{folder}: holds no views: neither transforms_train.json nor transforms.json, nor a COLMAP model in "
            f"sparse/0"
        )
    content, frames = _parse(single)
    lists = {s: content[f"{s}_filenames"] for s in SPLITS if f"{s}_filenames" in content}
    if not lists:
        if split == "val":
            raise ViewsError(f'{single}: has no list "val_filenames"')
        return single, content, _part(frames, split)
    if split == "test" and "test" not in lists and "val" in lists:
        split = "val"
    if split not in lists:
        raise ViewsError(f'{single}: has no list "{split}_filenames", only those of {", ".join(lists)}')
    if not isinstance(lists[split], list):
        raise ViewsError(f'{single}: "{split}_filenames" is {lists[split]!r:.40}, expected a list')
    listed = {_plain(frame["file_path"]): frame for frame in frames}
    for name in lists[split]:
        if not isinstance(name, str) or _plain(name) not in listed:
            raise ViewsError(f'{single}: "{split}_filenames" names {name!r:.60}, which is not among the frames')
    return single, content, [listed[_plain(name)] for name in lists[split]]


def _plain(name: str) -> str:
    r"""Return the name of an image without ``./`` and ``\``, which two lists may use differently."""
    return str(PurePosixPath(name.replace("\\", "/")))


def _parse(file: Path) -> tuple[dict, list[dict]]:
    if fault := irregular(file, MOST_TEXT):
        raise ViewsError(f"{shown(file)}: {fault}")
    try:
        data = file.read_bytes()
        Allowance(file).check(json_bytes(data), "a list of views")
        content = json.loads(data.decode("utf-8-sig"), object_hook=RecordedKeys)
    except LimitError as e:
        raise ViewsError(str(e)) from None
    except (ValueError, RecursionError) as e:
        raise ViewsError(f"{file}: is not valid JSON ({reason(e)})") from None
    except OSError as e:
        raise ViewsError(f"{file}: cannot be read ({reason(e)})") from None
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames:
        raise ViewsError(f'{file}: has no "frames", expected a list of views')
    for i, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str) or not frame["file_path"]:
            raise ViewsError(f'{file}: frame {i} has no "file_path", expected the name of an image')
        if not isinstance(frame.get("mask_path", ""), str):
            raise ViewsError(f'{file}: frame {i} has a "mask_path" that is no name of a file')
    return content, frames


def _numbers(value) -> np.ndarray | None:
    try:
        return np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        return None


def _box(file: Path, content: dict) -> np.ndarray | None:
    if "aabb" not in content:
        return None
    box = _numbers(content["aabb"])
    if box is None or box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise ViewsError(
            f'{file}: has the "aabb" {content["aabb"]!r:.60}, expected two corners, the lower one first: '
            f"[[x, y, z], [x, y, z]]"
        )
    return box


def _camera(file: Path, content: dict, frame: dict) -> Frame:
    where = f'{file}: frame "{frame["file_path"]}"'
    numbers, pose = camera_numbers(where, frame, content), _pose(where, frame)
    if content.get("from_mitsuba", "normal_mts_args" in content):  # cameras look along z, with x to the left
        pose = pose @ np.diag([-1.0, 1.0, -1.0, 1.0])
    return Frame(frame["file_path"], pose, numbers, frame.get("mask_path") or None)


def _pose(where: str, frame: dict) -> np.ndarray:
    """Return the matrix of a frame as a rigid motion, ``(4, 4)``."""
    matrix = frame.get("transform_matrix")
    if matrix is None:
        raise ViewsError(f'{where} has no "transform_matrix"')
    pose = _numbers(matrix)
    if pose is None:
        raise ViewsError(f"{where} has a transform_matrix that is not a matrix of numbers")
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4):
        raise ViewsError(f"{where} has a transform_matrix of the shape {pose.shape}, expected (4, 4)")
    if not np.isfinite(pose).all():
        raise ViewsError(f"{where} has a transform_matrix with NaN or infinite numbers")
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > RIGID:
        raise ViewsError(f"{where} has a transform_matrix whose last row is not 0, 0, 0, 1")
    rotation = pose[:3, :3]
    lengths = np.linalg.norm(rotation, axis=0)
    if np.abs(lengths - 1).max() > RIGID:
        text = ", ".join(f"{x:.4g}" for x in lengths)
        raise ViewsError(f"{where} has a transform_matrix that scales (columns of length {text}), a rotation is needed")
    if np.abs((rotation / lengths).T @ (rotation / lengths) - np.eye(3)).max() > RIGID:
        raise ViewsError(f"{where} has a transform_matrix that shears, a rotation is needed")
    if np.linalg.det(rotation) < 0:
        raise ViewsError(f"{where} has a transform_matrix that mirrors, a rotation is needed")
    return pose


#: Folders of images and masks; the mask of ``a.jpg`` is ``a.jpg.png``, as COLMAP has it.
IMAGES, MASKS = "images", "masks"

#: Camera model → names of its parameters.
PARAMETERS = {
    "SIMPLE_PINHOLE": "fl_x cx cy",
    "PINHOLE": "fl_x fl_y cx cy",
    "SIMPLE_RADIAL": "fl_x cx cy k1",
    "RADIAL": "fl_x cx cy k1 k2",
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}


def colmap_frames(folder: Path, model: Path, split: str) -> FrameList:
    """Return the views of a ``split`` of the COLMAP ``model`` of the capture in a folder.

    Every eighth image is a test view, in the order of names. Coordinates are those of the model. Raises
    :class:`ViewsError`.
    """
    try:
        import pycolmap
    except ImportError:
        raise ViewsError(f"{model}: is a COLMAP model, which needs {missing_package('pycolmap')}") from None
    try:
        reconstruction = pycolmap.Reconstruction(str(model))
    except Exception as e:
        raise ViewsError(f"{model}: cannot be read as a COLMAP model ({reason(e)})") from None
    if split == "val":
        raise ViewsError(f'{model}: has no views for the split "val"')
    images = sorted((reconstruction.images[i] for i in reconstruction.reg_image_ids()), key=lambda image: image.name)
    frames = []
    for image in _part(images, split):
        camera, mask = reconstruction.cameras[image.camera_id], folder / MASKS / f"{image.name}.png"
        if camera.model.name not in PARAMETERS:
            raise ViewsError(
                f'{model}: image "{image.name}" has the camera model {camera.model.name}, allowed are '
                f"{', '.join(PARAMETERS)}: undistort the images first"
            )
        numbers = dict(zip(PARAMETERS[camera.model.name].split(), map(float, camera.params), strict=True))
        numbers |= {"w": float(camera.width), "h": float(camera.height)}
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix()
        pose[:3, 1:3] *= -1  # COLMAP's cameras look along z, with y downwards
        mask_name = str(mask.relative_to(folder)) if mask.is_file() else None
        frames.append(Frame(f"{IMAGES}/{image.name}", pose, numbers, mask_name))
    points = [p.xyz for p in reconstruction.points3D.values() if p.track.length() >= 3]  # images that see it
    return FrameList(model, folder, frames, points=np.array(points).reshape(-1, 3))
