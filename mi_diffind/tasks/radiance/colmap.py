"""Models of COLMAP: cameras, images and points, as text or binary, read by pycolmap."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...core.errors import missing_package, reason
from .image_files import EXTENSIONS, ViewsError
from .transforms import EVERY, Frame, FrameList

#: Folders that may hold a model, the first one first.
FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")

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

#: Least images that see a point.
TRACK = 3


def model_folder(folder: Path) -> Path | None:
    """Return the folder of the COLMAP model of a capture, or ``None``."""
    for path in (folder / name for name in FOLDERS):
        if any((path / f"cameras.{suffix}").is_file() for suffix in ("bin", "txt")):
            return path
    return None


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
    for i, image in enumerate(images):
        if len(images) > 1 and (i % EVERY == 0) != (split == "test"):
            continue
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
    points = [p.xyz for p in reconstruction.points3D.values() if p.track.length() >= TRACK]
    return FrameList(model, folder, frames, points=np.array(points).reshape(-1, 3), notes=_notes(folder, model, images))


def _notes(folder: Path, model: Path, images: list) -> tuple[str, ...]:
    """Return notes on further models and on masks that are not used."""
    notes, masks = [], (path for path in (folder / MASKS).rglob("*.*") if path.suffix.lower() in EXTENSIONS)
    others = [path.parent for path in model.parent.glob("*/cameras.*") if path.parent != model and model.name == "0"]
    if others:
        notes.append(
            f"{', '.join(sorted({p.name for p in others}))}: further models beside {model}, which are not used"
        )
    names = {path.relative_to(folder / MASKS).as_posix() for path in masks} - {f"{image.name}.png" for image in images}
    unused = [name for name in names if not (folder / IMAGES / name.removesuffix(".png")).is_file()]
    if unused:
        notes.append(
            f"{folder / MASKS}: {len(unused):,} files are masks of no image, such as {min(unused)}: the mask of a.jpg "
            f"is a.jpg.png"
        )
    return tuple(notes)
