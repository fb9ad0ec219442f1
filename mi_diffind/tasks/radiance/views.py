"""Captured views: images of a scene with the poses of their cameras, read from a folder.

``mi-diffind capture``, Blender and nerfstudio write such folders. Two layouts are read: ``transforms_train.json``,
``transforms_test.json`` and ``transforms_val.json`` of NeRF's Blender data (Mildenhall et al. 2020), and the
``transforms.json`` of nerfstudio. Poses map camera to world; a camera looks along −z with y up. Transforms that
nerfstudio has already applied to the poses (``applied_transform``, ``applied_scale``) are not undone.

PNG and JPEG hold sRGB, not multiplied by alpha; EXR holds linear values multiplied by alpha. An image without alpha is
opaque everywhere, so that its background becomes part of the field.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import DiffindError, reason
from ...srgb import to_linear

SPLITS = ("train", "test", "val")

#: Extensions tried in turn for an image name without one.
EXTENSIONS = (".png", ".jpg", ".jpeg", ".exr")

#: Tolerance of the columns of a rotation: lengths against 1, and dot products against 0.
RIGID = 1e-3

#: Interval of the test views in a list without splits, beginning with the first view (as in LLFF's data).
EVERY = 8

#: Camera models that are pinholes if their distortion is zero.
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")

DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


class ViewsError(DiffindError, ValueError):
    """Error for unusable images or poses; the message is one sentence that names the file and the fault."""


@dataclass(frozen=True, eq=False)
class CapturedViews:
    """Images of one split of a capture, with their cameras.

    ``images`` ``(V, height, width, 4)``, float32, holds linear colours multiplied by alpha, and alpha in [0, 1].
    ``poses`` ``(V, 4, 4)``, float64, map camera to world. ``focal`` and ``centre``, ``(V, 2)``, are in pixels, the
    centre from the upper left corner. ``names`` are those of the image files.

    ``has_alpha`` is false if an image without alpha counts as opaque. ``box`` ``(2, 3)`` holds the lower and the upper
    corner of the captured objects if the file has an ``aabb`` (as of instant-ngp), else it is ``None``. ``digest`` is a
    SHA-256 of everything.
    """

    images: np.ndarray
    poses: np.ndarray
    focal: np.ndarray
    centre: np.ndarray
    names: tuple[str, ...]
    path: Path
    has_alpha: bool
    box: np.ndarray | None = None
    digest: str = ""

    def __len__(self) -> int:
        return len(self.images)

    def chosen(self, numbers: np.ndarray) -> CapturedViews:
        """Return the views with these ``numbers`` alone."""
        return dataclasses.replace(
            self, images=self.images[numbers], poses=self.poses[numbers], focal=self.focal[numbers],
            centre=self.centre[numbers], names=tuple(self.names[i] for i in numbers),
        )  # fmt: skip

    @property
    def height(self) -> int:
        return self.images.shape[1]

    @property
    def width(self) -> int:
        return self.images.shape[2]

    @property
    def origins(self) -> np.ndarray:
        """Positions of the cameras, ``(V, 3)``."""
        return self.poses[:, :3, 3]


def load_views(folder: str | os.PathLike, split: str = "train", most: int | None = None) -> CapturedViews:
    """Read the views of a ``split``: "train", "test" or "val".

    The file is ``transforms_SPLIT.json``, or ``transforms.json`` with the lists ``train_filenames``,
    ``test_filenames`` and ``val_filenames``. If no file or list names the test views, every eighth view is one. Of more
    than ``most`` views, so many are read, evenly spread in the list.
    Raises :class:`ViewsError`, also for fewer than two training views, since one view does not show depth.
    """
    folder = Path(folder)
    if split not in SPLITS:
        raise ValueError(f'split: found "{split}", allowed are {", ".join(SPLITS)}')
    file, content, frames = _frames(folder, split)
    if split == "train" and len(frames) < 2:
        raise ViewsError(f"{file}: has {len(frames)} view for training, at least 2 are needed: one shows no depth")
    if not frames:
        raise ViewsError(f'{file}: has no views for the split "{split}"')
    if most is not None and most < len(frames):
        frames = [frames[i * len(frames) // most] for i in range(most)]
    cameras = [_camera(file, content, frame) for frame in frames]
    names, images, has_alpha = [], None, True
    for i, ((_, numbers), frame) in enumerate(zip(cameras, frames, strict=True)):
        path = _image_file(file, frame["file_path"])
        image, alpha = _read(path)
        height, width = image.shape[:2]
        expected = numbers.get("w", width), numbers.get("h", height)
        if expected != (width, height):
            raise ViewsError(
                f"{path}: has {width} × {height} pixels, {file} says {expected[0]:g} × {expected[1]:g}, to which its "
                f"focal lengths refer"
            )
        if images is None:
            images = np.empty((len(frames), *image.shape), np.float32)
        elif image.shape != images.shape[1:]:
            sizes = " and ".join(f"{a.shape[1]} × {a.shape[0]}" for a in (images[0], image))
            raise ViewsError(f"{path}: has another size than {names[0]} ({sizes} pixels), all need the same")
        images[i] = image
        names.append(str(path.relative_to(folder) if path.is_relative_to(folder) else path))
        has_alpha &= alpha
    focal = np.array([_focal(numbers, width, height) for _, numbers in cameras])
    centre = np.array([(numbers.get("cx", width / 2), numbers.get("cy", height / 2)) for _, numbers in cameras])
    poses, box = np.stack([pose for pose, _ in cameras]), _box(file, content)
    digest = hashlib.sha256(json.dumps([split, images.shape, names, has_alpha]).encode())
    for array in (images, poses, focal, centre, *([] if box is None else [box])):
        digest.update(np.ascontiguousarray(array))
    return CapturedViews(images, poses, focal, centre, tuple(names), folder, has_alpha, box, digest.hexdigest())


def _frames(folder: Path, split: str) -> tuple[Path, dict, list[dict]]:
    """Return the file that lists the views of a split, its content, and the entries of these views."""
    if not folder.is_dir():
        raise ViewsError(f"{folder}: {'is not a folder' if folder.exists() else 'no such folder'}")
    listed_split, train, single = (folder / f"transforms{s}.json" for s in (f"_{split}", "_train", ""))
    if listed_split.is_file():
        content, frames = _parse(listed_split)
        if split == "train" and not (folder / "transforms_test.json").is_file():
            frames = [f for i, f in enumerate(frames) if i % EVERY or len(frames) == 1]
        return listed_split, content, frames
    if train.is_file():
        if split == "test":
            content, frames = _parse(train)
            return train, content, frames[::EVERY]
        raise ViewsError(f"{listed_split}: no such file")
    if not single.is_file():
        raise ViewsError(f"{folder}: holds no views: neither transforms_train.json nor transforms.json is there")
    content, frames = _parse(single)
    lists = {s: content[f"{s}_filenames"] for s in SPLITS if f"{s}_filenames" in content}
    if not lists:
        if split == "val":
            raise ViewsError(f'{single}: has no list "val_filenames"')
        wanted = [f for i, f in enumerate(frames) if (i % EVERY == 0) == (split == "test")]
        return single, content, frames if len(frames) == 1 else wanted
    if split not in lists:
        raise ViewsError(f'{single}: has no list "{split}_filenames", only those of {", ".join(lists)}')
    listed = {frame["file_path"]: frame for frame in frames}
    if not isinstance(lists[split], list):
        raise ViewsError(f'{single}: "{split}_filenames" is {lists[split]!r:.40}, expected a list')
    for name in lists[split]:
        if name not in listed:
            raise ViewsError(f'{single}: "{split}_filenames" names {name!r:.60}, which is not among the frames')
    return single, content, [listed[name] for name in lists[split]]


def _parse(file: Path) -> tuple[dict, list[dict]]:
    try:
        content = json.loads(file.read_text(encoding="utf-8-sig"))
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
        if "mask_path" in frame:
            raise ViewsError(f'{file}: frame {i} has a "mask_path", masks are not supported: make them alpha')
    return content, frames


def _box(file: Path, content: dict) -> np.ndarray | None:
    if "aabb" not in content:
        return None
    try:
        box = np.array(content["aabb"], np.float64)
    except (TypeError, ValueError):
        box = np.zeros(0)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise ViewsError(
            f'{file}: has the "aabb" {content["aabb"]!r:.60}, expected two corners, the lower one first: '
            f"[[x, y, z], [x, y, z]]"
        )
    return box


def _focal(numbers: dict[str, float], width: int, height: int) -> tuple[float, float]:
    """Return the focal lengths along x and y in pixels of an image of this size."""
    fx = numbers["fl_x"] if "fl_x" in numbers else width / 2 / np.tan(numbers["camera_angle_x"] / 2)
    if "fl_y" in numbers or "fl_x" in numbers or "camera_angle_y" not in numbers:
        return fx, numbers.get("fl_y", fx)
    return fx, height / 2 / np.tan(numbers["camera_angle_y"] / 2)


def _camera(file: Path, content: dict, frame: dict) -> tuple[np.ndarray, dict[str, float]]:
    """Return the pose of a frame, ``(4, 4)``, camera to world, and the numbers of its pinhole that the file gives."""
    where = f'{file}: frame "{frame["file_path"]}"'
    entries = {**{k: v for k, v in content.items() if k != "frames"}, **frame}
    model = entries.get("camera_model", "PINHOLE")
    if model not in PINHOLES or entries.get("is_fisheye"):
        model = model if model not in PINHOLES else "fisheye"
        raise ViewsError(
            f"{where} has the camera model {model!r:.40}, allowed are pinholes without distortion "
            f"({', '.join(PINHOLES)}): undistort the images first"
        )
    numbers = {}
    for name in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", *DISTORTION):
        value = entries.get(name)
        if value is None:
            continue
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
            raise ViewsError(f'{where} has the "{name}" {value!r:.40}, expected a number')
        numbers[name] = float(value)
    for name in DISTORTION:
        if numbers.get(name, 0.0) != 0.0:
            raise ViewsError(f'{where} has a distortion ("{name}" is {numbers[name]:g}): undistort the images first')
    if not {"fl_x", "camera_angle_x"} & set(numbers):
        raise ViewsError(f'{where} has no focal length: neither "camera_angle_x" nor "fl_x" is given')
    for names, limit, allowed in (
        (("fl_x", "fl_y", "w", "h"), np.inf, "a number > 0"),
        (("camera_angle_x", "camera_angle_y"), np.pi, "radians between 0 and π"),
    ):
        for name in names:
            if name in numbers and not 0 < numbers[name] < limit:
                raise ViewsError(f'{where} has the "{name}" {numbers[name]:g}, expected {allowed}')
    return _pose(where, frame.get("transform_matrix")), numbers


def _pose(where: str, matrix) -> np.ndarray:
    """Return a ``transform_matrix`` as a rigid motion, ``(4, 4)``."""
    if matrix is None:
        raise ViewsError(f'{where} has no "transform_matrix"')
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        raise ViewsError(f"{where} has a transform_matrix that is not a matrix of numbers") from None
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
    if np.abs(rotation.T @ rotation - np.eye(3)).max() > RIGID:
        raise ViewsError(f"{where} has a transform_matrix that shears, a rotation is needed")
    if np.linalg.det(rotation) < 0:
        raise ViewsError(f"{where} has a transform_matrix that mirrors, a rotation is needed")
    return pose


def _image_file(file: Path, name: str) -> Path:
    """Return the path of the image ``name`` in a list of views."""
    path = file.parent / name
    for candidate in (path, *(path.with_name(path.name + e) for e in EXTENSIONS)):
        if candidate.is_file():
            return candidate
    more = "" if path.suffix.lower() in EXTENSIONS else f", nor with {', '.join(EXTENSIONS)}"
    raise ViewsError(f"{path}: no such image{more}, {file.name} names it")


def _read(path: Path) -> tuple[np.ndarray, bool]:
    """Return an image ``(height, width, 4)``, linear and multiplied by alpha, and whether the file has alpha."""
    encoded = path.suffix.lower() != ".exr"
    try:
        values = _read_bytes(path) if encoded else _read_exr(path)
    except (ViewsError, ImportError):
        raise
    except Exception as e:  # each decoder raises errors of its own for a damaged file
        raise ViewsError(
            f"{path}: cannot be read as an image, it is damaged or of an unknown format ({reason(e)})"
        ) from None
    has_alpha = values.shape[2] in (2, 4)
    colour, alpha = (values[..., :-1], values[..., -1:]) if has_alpha else (values, None)
    if encoded:
        colour = _LINEAR[colour]
        alpha = None if alpha is None else alpha / np.float32(255)
    elif not np.isfinite(values).all():
        raise ViewsError(f"{path}: has {np.count_nonzero(~np.isfinite(values)):,} values that are NaN or infinite")
    image = np.ones((*values.shape[:2], 4), np.float32)
    image[..., :3] = colour
    if has_alpha:
        image[..., 3:] = np.clip(alpha, 0, 1)
        if encoded:
            image[..., :3] *= image[..., 3:]
    return image, has_alpha


#: Byte → linear value.
_LINEAR = to_linear(np.arange(256) / 255).astype(np.float32)


def _read_bytes(path: Path) -> np.ndarray:
    """Return an image of 8 bits, ``(height, width, 1 to 4)``, uint8."""
    from PIL import Image

    with Image.open(path) as image:
        if image.mode not in ("RGB", "RGBA", "L", "LA"):
            if image.mode in ("CMYK", "YCbCr", "LAB", "HSV", "1", "F", "I") or image.mode.startswith("I;"):
                raise ViewsError(f"{path}: has pixels of the mode {image.mode}, allowed are 8 bits of grey or RGB")
            image = image.convert("RGBA" if image.has_transparency_data else "RGB")
        elif image.mode in ("RGB", "L") and image.has_transparency_data:
            image = image.convert("RGBA")
        values = np.array(image)
    return values.reshape(*values.shape[:2], -1)


def _read_exr(path: Path) -> np.ndarray:
    """Return an EXR image, ``(height, width, 1 to 4)``, float32: R, G, B or Y, and A."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        planes = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    colours = next((c for c in (("R", "G", "B"), ("Y",)) if set(c) <= set(planes)), None)
    if colours is None:
        raise ViewsError(f"{path}: has the channels {', '.join(sorted(planes))}, expected R, G, B or Y, and A")
    return np.stack([planes[name] for name in (*colours, *(("A",) if "A" in planes else ()))], axis=-1)
