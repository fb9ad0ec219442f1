"""Lists of views in JSON: those of NeRF's Blender data, of nerfstudio and of instant-ngp.

Two layouts are read: ``transforms_train.json``, ``transforms_test.json`` and ``transforms_val.json`` of NeRF's Blender
data (Mildenhall et al. 2020), and the ``transforms.json`` of nerfstudio and instant-ngp. Cameras are those of
:mod:`.camera_keys`. Poses map camera to world; a camera looks along −z with y up. Transforms that nerfstudio has
already applied to the poses (``applied_transform``, ``applied_scale``) are not undone. Keys that are not used are named
in a note.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from ...core.archives import Allowance, LimitError, json_bytes
from ...core.errors import reason
from ...core.files import MOST_TEXT, RecordedKeys, irregular, shown, unused_note
from .camera_keys import camera_numbers
from .image_files import ViewsError

SPLITS = ("train", "test", "val")

#: Tolerance of the columns of a rotation: lengths against 1, and dot products against 0.
RIGID = 1e-3

#: Interval of the test views in a list without splits, beginning with the first view (as in LLFF's data).
EVERY = 8


@dataclass(frozen=True)
class Frame:
    """One view in a list: the name of its image, pose ``(4, 4)``, camera to world, and the ``numbers`` of its camera.

    The numbers are those of :func:`.camera_keys.camera_numbers`. ``mask`` names a mask.
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


def listed_frames(folder: Path, split: str) -> FrameList:
    """Return the views of a ``split`` that the JSON files in a folder list. Raises :class:`ViewsError`."""
    file, content, frames = _frames(folder, split)
    content["frames"] = frames  # those of other splits are not read
    cameras, box = [_camera(file, content, frame) for frame in frames], _box(file, content)
    settings = {name: content[name] for name in ("applied_transform", "applied_scale") if name in content}
    note = unused_note(file, content)
    return FrameList(file, file.parent, cameras, box, settings=settings, notes=(note,) if note else ())


def _frames(folder: Path, split: str) -> tuple[Path, dict, list[dict]]:
    """Return the file that lists the views of a split, its content, and the entries of these views.

    Views for a validation are the test views of a capture without others.
    """
    if fault := irregular(folder):
        raise ViewsError(f"{shown(folder)}: {fault}")
    if not folder.is_dir():
        raise ViewsError(f"{folder}: {'is not a folder' if folder.exists() else 'no such folder'}")
    files = {s: folder / f"transforms_{s}.json" for s in SPLITS}
    test = "val" if files["val"].is_file() and not files["test"].is_file() else "test"
    listed_split, single = files[test if split == "test" else split], folder / "transforms.json"
    if listed_split.is_file():
        content, frames = _parse(listed_split)
        if split == "train" and not files[test].is_file():
            frames = [f for i, f in enumerate(frames) if i % EVERY or len(frames) == 1]
        return listed_split, content, frames
    if files["train"].is_file():
        if split == "test":
            content, frames = _parse(files["train"])
            return files["train"], content, frames[::EVERY]
        raise ViewsError(f"{listed_split}: no such file")
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
        wanted = [f for i, f in enumerate(frames) if (i % EVERY == 0) == (split == "test")]
        return single, content, frames if len(frames) == 1 else wanted
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


def _box(file: Path, content: dict) -> np.ndarray | None:
    if "aabb" not in content:
        return None
    try:
        box = np.array(content["aabb"], np.float64)
    except (TypeError, ValueError, OverflowError):
        box = np.zeros(0)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise ViewsError(
            f'{file}: has the "aabb" {content["aabb"]!r:.60}, expected two corners, the lower one first: '
            f"[[x, y, z], [x, y, z]]"
        )
    return box


def _camera(file: Path, content: dict, frame: dict) -> Frame:
    where = f'{file}: frame "{frame["file_path"]}"'
    numbers, pose = camera_numbers(where, frame, content), _pose(where, _matrix(where, frame))
    if content.get("from_mitsuba", "normal_mts_args" in content):  # cameras look along z, with x to the left
        pose = pose @ np.diag([-1.0, 1.0, -1.0, 1.0])
    return Frame(frame["file_path"], pose, numbers, frame.get("mask_path") or None)


def _matrix(where: str, frame: dict):
    """Return the matrix of a frame: that of the time at which the shutter opens, too, if the camera stands still."""
    if frame.get("transform_matrix") is not None:
        return frame["transform_matrix"]
    begin, end = (frame.get(f"transform_matrix_{time}") for time in ("start", "end"))
    if end is not None and end != begin:
        raise ViewsError(
            f'{where} moves while the shutter is open, from the "transform_matrix_start" to another '
            f'"transform_matrix_end": a "transform_matrix" is needed'
        )
    return begin


def _pose(where: str, matrix) -> np.ndarray:
    """Return a ``transform_matrix`` as a rigid motion, ``(4, 4)``."""
    if matrix is None:
        raise ViewsError(f'{where} has no "transform_matrix"')
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError, OverflowError):
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
    if np.abs((rotation / lengths).T @ (rotation / lengths) - np.eye(3)).max() > RIGID:
        raise ViewsError(f"{where} has a transform_matrix that shears, a rotation is needed")
    if np.linalg.det(rotation) < 0:
        raise ViewsError(f"{where} has a transform_matrix that mirrors, a rotation is needed")
    return pose
