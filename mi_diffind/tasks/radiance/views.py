"""Captured views: images of a scene with the poses of their cameras, read from a folder.

``mi-diffind capture``, Blender and nerfstudio write such folders. Two layouts are read: ``transforms_train.json``,
``transforms_test.json`` and ``transforms_val.json`` of NeRF's Blender data (Mildenhall et al. 2020), and the
``transforms.json`` of nerfstudio. Poses map camera to world; a camera looks along −z with y up. Transforms that
nerfstudio has already applied to the poses (``applied_transform``, ``applied_scale``) are not undone.

Pixels stay as their files have them (:mod:`.image_files`), 4 bytes each, or 8 bytes if there is an EXR among the files.
An image without alpha is opaque everywhere, so that its background becomes part of the field.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import reason
from ...indirection import aligned
from ...progress import progress_bar
from .image_files import ViewsError, decoded, half_floats, image_file, is_linear, read_image

SPLITS = ("train", "test", "val")

#: Tolerance of the columns of a rotation: lengths against 1, and dot products against 0.
RIGID = 1e-3

#: Interval of the test views in a list without splits, beginning with the first view (as in LLFF's data).
EVERY = 8

#: Camera models that are pinholes if their distortion is zero.
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")

DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


@dataclass(frozen=True, eq=False)
class CapturedViews:
    """Images of one ``split`` of a capture, with their cameras.

    ``pixels``, uint32, holds all images one after the other, row by row: ``(n, 1)`` with four bytes a pixel (sRGB and
    alpha), or ``(n, 2)`` with four numbers in half precision (linear, multiplied by alpha). The pixels of view i begin
    at ``offsets[i]``; ``sizes[i]`` holds its height and width. :meth:`image` decodes a view.

    ``poses`` ``(V, 4, 4)``, float64, map camera to world. ``focal`` and ``centre``, ``(V, 2)``, are in pixels, the
    centre from the upper left corner. ``names`` are those of the image files.

    ``has_alpha`` is false if an image without alpha counts as opaque. ``box`` ``(2, 3)`` holds the lower and the upper
    corner of the captured objects if the file has an ``aabb`` (as of instant-ngp), else it is ``None``.
    """

    pixels: np.ndarray
    offsets: np.ndarray
    sizes: np.ndarray
    poses: np.ndarray
    focal: np.ndarray
    centre: np.ndarray
    names: tuple[str, ...]
    path: Path
    has_alpha: bool
    box: np.ndarray | None = None
    split: str = "train"

    def __len__(self) -> int:
        return len(self.sizes)

    def chosen(self, numbers: np.ndarray) -> CapturedViews:
        """Return the views with these ``numbers`` alone; the pixels are shared."""
        return dataclasses.replace(
            self, offsets=self.offsets[numbers], sizes=self.sizes[numbers], poses=self.poses[numbers],
            focal=self.focal[numbers], centre=self.centre[numbers], names=tuple(self.names[i] for i in numbers),
        )  # fmt: skip

    def stored(self, view: int) -> np.ndarray:
        """Return the image of a view ``(height, width, 4)`` as it is kept: uint8 or float16, not a copy."""
        height, width = self.sizes[view]
        words = self.pixels[self.offsets[view] : self.offsets[view] + height * width]
        return words.view(np.uint8 if words.shape[1] == 1 else np.float16).reshape(height, width, 4)

    def image(self, view: int) -> np.ndarray:
        """Return the image of a view ``(height, width, 4)``, float32: linear, multiplied by alpha, and alpha."""
        return decoded(self.stored(view))

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of everything: images as float32, names, cameras and box."""
        same = (self.sizes == self.sizes[0]).all()
        shape = [len(self), *self.sizes[0].tolist(), 4] if same else self.sizes.tolist()
        digest = hashlib.sha256(json.dumps([self.split, shape, self.names, self.has_alpha]).encode())
        for view in range(len(self)):
            digest.update(self.image(view))
        for array in (self.poses, self.focal, self.centre, *([] if self.box is None else [self.box])):
            digest.update(np.ascontiguousarray(array))
        return digest.hexdigest()

    @property
    def mean_pixels(self) -> float:
        """Mean number of pixels of a view."""
        return float(self.sizes.prod(axis=1).mean())

    @property
    def origins(self) -> np.ndarray:
        """Positions of the cameras, ``(V, 3)``."""
        return self.poses[:, :3, 3]


def load_views(
    folder: str | os.PathLike, split: str = "train", most: int | None = None, progress: bool = False
) -> CapturedViews:
    """Read the views of a ``split``: "train", "test" or "val".

    The file is ``transforms_SPLIT.json``, or ``transforms.json`` with the lists ``train_filenames``,
    ``test_filenames`` and ``val_filenames``. If no file or list names the test views, every eighth view is one. Of more
    than ``most`` views, so many are read, evenly spread in the list. ``progress`` shows a bar on stderr.
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
    paths = [image_file(file, frame["file_path"]) for frame in frames]
    pixels, sizes, has_alpha = _read_all(file, paths, [numbers for _, numbers in cameras], progress)
    numbers = [(numbers, *size) for (_, numbers), size in zip(cameras, sizes, strict=True)]
    return CapturedViews(
        pixels=pixels,
        offsets=np.cumsum([0, *sizes.prod(axis=1)])[:-1],
        sizes=sizes,
        poses=np.stack([pose for pose, _ in cameras]),
        focal=np.array([_focal(n, width, height) for n, height, width in numbers]),
        centre=np.array([(n.get("cx", width / 2), n.get("cy", height / 2)) for n, height, width in numbers]),
        names=tuple(str(path.relative_to(folder) if path.is_relative_to(folder) else path) for path in paths),
        path=folder,
        has_alpha=has_alpha,
        box=_box(file, content),
        split=split,
    )


def _read_all(
    file: Path, paths: list[Path], cameras: list[dict], progress: bool
) -> tuple[np.ndarray, np.ndarray, bool]:
    """Return ``pixels`` and ``sizes`` of :class:`CapturedViews`, and whether all images have alpha."""
    words = 2 if any(map(is_linear, paths)) else 1
    pixels, count, sizes, all_alpha = np.empty((0, words), np.uint32), 0, [], True
    with progress_bar("views", len(paths), "images", progress) as bar:
        for i, (path, numbers) in enumerate(zip(paths, cameras, strict=True)):
            image, has_alpha = read_image(path)
            height, width = image.shape[:2]
            expected = numbers.get("w", width), numbers.get("h", height)
            if expected != (width, height):
                raise ViewsError(
                    f"{path}: has {width} × {height} pixels, {file} says {expected[0]:g} × {expected[1]:g}, to which "
                    f"its focal lengths refer"
                )
            end = count + height * width
            if end > len(pixels):  # the first time, or if a larger image follows: memory that nobody writes is free
                grown = aligned((count + (len(paths) - i) * height * width, words), np.uint32)
                grown[:count] = pixels[:count]
                pixels = grown
            stored = image if words == 1 else half_floats(image)
            pixels[count:end] = stored.reshape(-1).view(np.uint32).reshape(-1, words)
            count, all_alpha = end, all_alpha and has_alpha
            sizes.append((height, width))
            bar.update()
    return pixels[:count], np.array(sizes), all_alpha


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
