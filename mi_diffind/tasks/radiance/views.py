"""
Images of a scene with the poses of their cameras: a folder as ``mi-diffind capture``, Blender or nerfstudio write it.

Two layouts are read: ``transforms_train.json``, ``transforms_test.json`` and ``transforms_val.json``, as of NeRF's
Blender data (Mildenhall et al. 2020), and nerfstudio's ``transforms.json``. Poses are taken as they stand: camera to
world, a camera that looks along −z with y up, in the world that the matrices are in. What nerfstudio has already
applied to them (``applied_transform``, ``applied_scale``) is not undone.

PNG and JPEG hold sRGB, not multiplied by alpha; EXR holds linear values multiplied by alpha. An image without alpha is
opaque everywhere: whatever its background shows is then part of the field.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...errors import DiffindError, reason
from ...srgb import to_linear

SPLITS = ("train", "test", "val")

#: Tried in turn where the name of an image is given without one.
EXTENSIONS = (".png", ".jpg", ".jpeg", ".exr")

#: How far the columns of a rotation may be from unit vectors at right angles.
RIGID = 1e-3

#: Every so many views of a list that says nothing about it are test views, the first among them (as of LLFF's data).
EVERY = 8

#: Camera models that are pinholes if their distortion is zero.
PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV")

DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


class ViewsError(DiffindError, ValueError):
    """Images or poses that cannot be used; the message is one sentence that names the file and the fault."""


@dataclass(frozen=True, eq=False)
class Views:
    """
    ``images`` ``(V, height, width, 4)``, float32: linear colours, multiplied by alpha, and alpha in [0, 1]; ``poses``
    ``(V, 4, 4)``, float64, camera to world; ``focal`` and ``centre`` ``(V, 2)`` in pixels, the latter from the upper
    left corner; ``names`` of the image files.

    ``has_alpha``: no image was taken as opaque for want of alpha. ``box`` is ``(2, 3)``, the lower and the upper
    corner of what the views show, if the file has an ``aabb`` (as of instant-ngp), else ``None``. ``digest`` is a
    SHA-256 over all of it.
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

    @property
    def height(self) -> int:
        return self.images.shape[1]

    @property
    def width(self) -> int:
        return self.images.shape[2]

    @property
    def origins(self) -> np.ndarray:
        """Where the cameras are, ``(V, 3)``."""
        return self.poses[:, :3, 3]

    def rays(self, view, x, y) -> tuple[np.ndarray, np.ndarray]:
        """
        Origins and unit directions ``(…, 3)``, float64, of the rays through the middles of the pixels in the columns
        ``x`` and rows ``y``, counted from 0 at the upper left (fractions are allowed), of the images ``view``.
        """
        view = np.asarray(view)
        fx, fy = np.moveaxis(self.focal[view], -1, 0)
        cx, cy = np.moveaxis(self.centre[view], -1, 0)
        u, v = (np.asarray(x) + 0.5 - cx) / fx, -(np.asarray(y) + 0.5 - cy) / fy
        local = np.stack(np.broadcast_arrays(u, v, -1.0), axis=-1)
        pose = self.poses[view]
        directions = np.einsum("...ij,...j->...i", pose[..., :3, :3], local)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return np.broadcast_to(pose[..., :3, 3], directions.shape), directions


def load_views(folder: str | os.PathLike, split: str = "train", reduce: int = 1) -> Views:
    """
    Read the views of a ``split``: "train", "test" or "val".

    From ``transforms_SPLIT.json``; from ``transforms.json`` those that its ``train_filenames``, ``test_filenames`` or
    ``val_filenames`` list. Where nothing says which are for testing, every eighth is, and the others are for training.
    With ``reduce``, pixels are averages of so many by so many. Raises :class:`ViewsError`; a training that has less
    than two views is refused, since one says nothing about depth.
    """
    folder = Path(folder)
    if split not in SPLITS:
        raise ValueError(f'split: found "{split}", allowed are {", ".join(SPLITS)}')
    file, content, frames = _frames(folder, split)
    if split == "train" and len(frames) < 2:
        raise ViewsError(f"{file}: has {len(frames)} view for training, at least 2 are needed: one shows no depth")
    if not frames:
        raise ViewsError(f'{file}: has no views for the split "{split}"')
    cameras = [_camera(file, content, frame) for frame in frames]
    names, images, has_alpha = [], None, True
    for i, (camera, frame) in enumerate(zip(cameras, frames, strict=True)):
        path = _image_file(file, frame["file_path"])
        image, alpha = _read(path)
        camera.check_size(path, image.shape[1], image.shape[0])
        image = _reduced(path, image, reduce)
        if images is None:
            images = np.empty((len(frames), *image.shape), np.float32)
        elif image.shape != images.shape[1:]:
            sizes = " and ".join(f"{a.shape[1]} × {a.shape[0]}" for a in (images[0], image))
            raise ViewsError(f"{path}: has another size than {names[0]} ({sizes} pixels), all need the same")
        images[i] = image
        names.append(str(path.relative_to(folder) if path.is_relative_to(folder) else path))
        has_alpha &= alpha
    height, width = (reduce * n for n in images.shape[1:3])
    focal = np.array([c.focal(width, height) for c in cameras]) / reduce
    centre = np.array([c.centre(width, height) for c in cameras]) / reduce
    poses, box = np.stack([c.pose for c in cameras]), _box(file, content)
    digest = hashlib.sha256(json.dumps([split, images.shape, names, has_alpha]).encode())
    for array in (images, poses, focal, centre, *([] if box is None else [box])):
        digest.update(np.ascontiguousarray(array))
    return Views(images, poses, focal, centre, tuple(names), folder, has_alpha, box, digest.hexdigest())


# -- lists of views ---------------------------------------------------------------------------------------------------


def _frames(folder: Path, split: str) -> tuple[Path, dict, list[dict]]:
    """The file that lists the views of a split, its content, and these views."""
    if not folder.is_dir():
        raise ViewsError(f"{folder}: {'is not a folder' if folder.exists() else 'no such folder'}")
    own, train, single = (folder / f"transforms{s}.json" for s in (f"_{split}", "_train", ""))
    if own.is_file():
        content, frames = _parse(own)
        if split == "train" and not (folder / "transforms_test.json").is_file():
            frames = [f for i, f in enumerate(frames) if i % EVERY or len(frames) == 1]
        return own, content, frames
    if train.is_file():
        if split == "test":
            content, frames = _parse(train)
            return train, content, frames[::EVERY]
        raise ViewsError(f"{own}: no such file")
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
        raise ViewsError(f'{single}: has no list "{split}_filenames", and others ({", ".join(lists)})')
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


# -- cameras ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Camera:
    """A pinhole: ``pose`` ``(4, 4)``; ``get(name)`` is what the frame, or the file for all, says, ``None``: nothing."""

    where: str
    pose: np.ndarray
    numbers: dict[str, float]

    def check_size(self, path: Path, width: int, height: int) -> None:
        """Raise :class:`ViewsError` if the image is not of the size that the camera was described for."""
        said = self.numbers.get("w", width), self.numbers.get("h", height)
        if said != (width, height):
            raise ViewsError(
                f"{path}: has {width} × {height} pixels, {self.where} says {said[0]:g} × {said[1]:g}: "
                f"focal lengths are those of that size"
            )

    def focal(self, width: int, height: int) -> tuple[float, float]:
        """In pixels of an image of that size."""
        n = self.numbers
        fx = n["fl_x"] if "fl_x" in n else width / 2 / np.tan(n["camera_angle_x"] / 2)
        if "fl_y" in n:
            return fx, n["fl_y"]
        return fx, height / 2 / np.tan(n["camera_angle_y"] / 2) if "camera_angle_y" in n and "fl_x" not in n else fx

    def centre(self, width: int, height: int) -> tuple[float, float]:
        return self.numbers.get("cx", width / 2), self.numbers.get("cy", height / 2)


def _camera(file: Path, content: dict, frame: dict) -> _Camera:
    where = f'{file}: frame "{frame["file_path"]}"'
    said = {**{k: v for k, v in content.items() if k != "frames"}, **frame}
    model = said.get("camera_model", "PINHOLE")
    if model not in PINHOLES or said.get("is_fisheye"):
        model = model if model not in PINHOLES else "fisheye"
        raise ViewsError(
            f"{where} has the camera model {model!r:.40}, allowed are pinholes without distortion "
            f"({', '.join(PINHOLES)}): undistort the images first"
        )
    numbers = {}
    for name in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", *DISTORTION):
        value = said.get(name)
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
    for name in ("fl_x", "fl_y", "w", "h"):
        if name in numbers and numbers[name] <= 0:
            raise ViewsError(f'{where} has the "{name}" {numbers[name]:g}, expected a number > 0')
    for name in ("camera_angle_x", "camera_angle_y"):
        if name in numbers and not 0 < numbers[name] < np.pi:
            raise ViewsError(f'{where} has the "{name}" {numbers[name]:g}, expected radians between 0 and π')
    return _Camera(str(file), _pose(where, frame.get("transform_matrix")), numbers)


def _pose(where: str, matrix) -> np.ndarray:
    """A rigid motion, ``(4, 4)``."""
    if matrix is None:
        raise ViewsError(f'{where} has no "transform_matrix"')
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        raise ViewsError(f"{where} has a transform_matrix that is no matrix of numbers") from None
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4):
        raise ViewsError(f"{where} has a transform_matrix of the shape {pose.shape}, expected (4, 4)")
    if not np.isfinite(pose).all():
        raise ViewsError(f"{where} has a transform_matrix with NaN or infinite numbers")
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > RIGID:
        raise ViewsError(f"{where} has a transform_matrix whose last row is not 0, 0, 0, 1")
    turn = pose[:3, :3]
    lengths = np.linalg.norm(turn, axis=0)
    if np.abs(lengths - 1).max() > RIGID:
        text = ", ".join(f"{x:.4g}" for x in lengths)
        raise ViewsError(f"{where} has a transform_matrix that scales (columns of length {text}), a rotation is needed")
    if np.abs(turn.T @ turn - np.eye(3)).max() > RIGID:
        raise ViewsError(f"{where} has a transform_matrix that shears, its columns have to be at right angles")
    if np.linalg.det(turn) < 0:
        raise ViewsError(f"{where} has a transform_matrix that mirrors, a rotation is needed")
    return pose


# -- images -----------------------------------------------------------------------------------------------------------


def _image_file(file: Path, name: str) -> Path:
    path = file.parent / name
    tried = [path, *(path.with_name(path.name + e) for e in EXTENSIONS)]
    found = next((p for p in tried if p.is_file()), None)
    if found is None:
        more = "" if path.suffix.lower() in EXTENSIONS else f", nor with {', '.join(EXTENSIONS)}"
        raise ViewsError(f"{path}: no such image{more}, {file.name} names it")
    return found


def _read(path: Path) -> tuple[np.ndarray, bool]:
    """An image ``(height, width, 4)``, linear, multiplied by alpha; and if it has alpha."""
    values, encoded = (_read_exr(path), False) if path.suffix.lower() == ".exr" else (_read_bytes(path), True)
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
    """``(height, width, 1 to 4)``, uint8."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            if image.mode not in ("RGB", "RGBA", "L", "LA"):
                if image.mode in ("CMYK", "YCbCr", "LAB", "HSV", "1", "F", "I") or image.mode.startswith("I;"):
                    raise ViewsError(f"{path}: has pixels of the kind {image.mode}, allowed are 8 bits of grey or RGB")
                image = image.convert("RGBA" if image.has_transparency_data else "RGB")
            elif image.mode in ("RGB", "L") and image.has_transparency_data:
                image = image.convert("RGBA")
            values = np.array(image)
    except ViewsError:
        raise
    except Exception as e:  # the decoders have many kinds of their own for a damaged file
        raise ViewsError(
            f"{path}: cannot be read as an image, it is damaged or of an unknown kind ({reason(e)})"
        ) from None
    return values.reshape(*values.shape[:2], -1)


def _read_exr(path: Path) -> np.ndarray:
    """``(height, width, 1 to 4)``, float32: R, G, B or Y, and A."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = {name: np.array(channel.pixels, np.float32) for name, channel in file.channels().items()}
    except Exception as e:  # OpenEXR has many kinds of its own for a damaged file
        raise ViewsError(
            f"{path}: cannot be read as an image, it is damaged or of an unknown kind ({reason(e)})"
        ) from None
    colours = next((c for c in (("R", "G", "B"), ("Y",)) if set(c) <= set(planes)), None)
    if colours is None:
        raise ViewsError(f"{path}: has the channels {', '.join(sorted(planes))}, expected R, G, B or Y, and A")
    return np.stack([planes[name] for name in (*colours, *(("A",) if "A" in planes else ()))], axis=-1)


def _reduced(path: Path, image: np.ndarray, reduce: int) -> np.ndarray:
    """Averages of ``reduce`` × ``reduce`` pixels."""
    if reduce == 1:
        return image
    height, width = image.shape[:2]
    if reduce < 1 or height % reduce or width % reduce:
        raise ViewsError(f"{path}: has {width} × {height} pixels, which cannot be taken {reduce} by {reduce}")
    return image.reshape(height // reduce, reduce, width // reduce, reduce, -1).mean(axis=(1, 3))
