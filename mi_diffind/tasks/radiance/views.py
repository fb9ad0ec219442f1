"""Captured views: images of a scene with the poses of their cameras, and the space that the objects may occupy.

Lists of views and image files are read by :mod:`.captures`. Pixels stay as their files have them, 4 bytes each, or 8
bytes if there is an EXR among the files; photographs with a distortion become images of pinholes. An image without
alpha is opaque everywhere, so that its background becomes part of the field, unless it has one colour: then pixels of
this colour that are connected with the border of their image become empty.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import os
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_propagation, maximum_filter

from ...arrays.indirection import aligned
from ...core import units
from ...core.errors import printable, shortened
from ...core.progress import progress_bar
from .captures import (
    DISTORTION,
    SPLITS,
    Frame,
    FrameList,
    MissingImageError,
    ViewsError,
    byte_pixels,
    focal_lengths,
    image_file,
    is_linear,
    linear_pixels,
    list_frames,
    read_image,
    read_mask,
    reduce_image,
    undistort,
)

#: Largest number in half precision.
LARGEST = 65504.0

#: Longest side in pixels of images that are not reduced.
LONGEST = 1600


@dataclass(eq=False)
class CapturedViews:
    """Images of one ``split`` of a capture, with their cameras.

    ``pixels``, uint32, holds all images one after the other, row by row: ``(n, 1)`` with four bytes a pixel (sRGB and
    alpha), or ``(n, 2)`` with four numbers in half precision (linear, multiplied by alpha). The pixels of view i begin
    at ``offsets[i]``; ``sizes[i]`` holds its height and width. :meth:`image` decodes a view.

    ``poses`` ``(V, 4, 4)``, float64, map camera to world. ``focal`` and ``centre``, ``(V, 2)``, are in pixels, the
    centre from the upper left corner. ``names`` are those of the image files.

    ``has_alpha`` is false if an image without alpha counts as opaque, or if the alpha of all images is 1 everywhere.
    ``box`` ``(2, 3)`` holds the lower and the upper corner of the captured objects if the file has an ``aabb``, or
    those of most points of a model of COLMAP whose images have no alpha; else it is ``None``.

    ``mask``, bool ``(n,)``, is false for pixels that do not count: those that a mask excludes, and those that an
    undistorted photograph does not show. ``None``: all count. ``notes`` are sentences for the user; ``settings`` are
    recorded in the file of a fitted field.

    ``background`` holds bytes of sRGB if images without alpha show one colour around the objects,
    and its pixels have alpha 0 then. ``None``: images with alpha, or surroundings that are captured.
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
    mask: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    background: tuple[int, int, int] | None = None
    settings: dict = dataclasses.field(default_factory=dict)
    #: Whether fields have surroundings (:class:`.nodes.Contraction`) instead of a box around everything.
    surroundings: bool = False
    #: Images of :meth:`compressed` views, by zlib; ``pixels`` is empty then.
    packed: tuple[bytes, ...] | None = None

    def __len__(self) -> int:
        return len(self.sizes)

    def chosen(self, numbers: np.ndarray) -> CapturedViews:
        """Return the views with these ``numbers`` alone; the pixels are shared."""
        return dataclasses.replace(
            self, offsets=self.offsets[numbers], sizes=self.sizes[numbers], poses=self.poses[numbers],
            focal=self.focal[numbers], centre=self.centre[numbers], names=tuple(self.names[i] for i in numbers),
            packed=None if self.packed is None else tuple(self.packed[i] for i in numbers),
        )  # fmt: skip

    def spread(self, count: int) -> CapturedViews:
        """Return ``count`` of the views, evenly spread in the list."""
        return self.chosen(np.arange(count) * len(self) // count)

    def compressed(self) -> CapturedViews:
        """Return the same views with compressed images, which are decoded one at a time."""
        packed = tuple(zlib.compress(self.stored(view), 1) for view in range(len(self)))  # the fastest level
        return dataclasses.replace(self, pixels=self.pixels[:0].copy(), packed=packed)

    def stored(self, view: int) -> np.ndarray:
        """Return the image of a view ``(height, width, 4)``: uint8 or float16, not a copy unless it is compressed."""
        height, width = self.sizes[view]
        entry = np.uint8 if self.pixels.shape[1] == 1 else np.float16
        if self.packed is not None:
            return np.frombuffer(zlib.decompress(self.packed[view]), entry).reshape(height, width, 4)
        words = self.pixels[self.offsets[view] : self.offsets[view] + height * width]
        return words.view(entry).reshape(height, width, 4)

    def image(self, view: int) -> np.ndarray:
        """Return the image of a view ``(height, width, 4)``, float32: linear, multiplied by alpha, and alpha."""
        return linear_pixels(self.stored(view))

    def counted(self, view: int) -> np.ndarray:
        """Return which pixels of a view count, bool ``(height, width)``."""
        height, width = self.sizes[view]
        if self.mask is None:
            return np.ones((height, width), bool)
        return self.mask[self.offsets[view] : self.offsets[view] + height * width].reshape(height, width)

    @functools.cached_property
    def digest(self) -> str:
        """SHA-256 of everything: images as float32, names, cameras, box, mask and background."""
        same = (self.sizes == self.sizes[0]).all()
        shape = [len(self), *self.sizes[0].tolist(), 4] if same else self.sizes.tolist()
        digest = hashlib.sha256(json.dumps([self.split, shape, self.names, self.has_alpha]).encode())
        for view in range(len(self)):
            digest.update(self.image(view))
        background = None if self.background is None else np.uint8(self.background)
        if self.surroundings:
            digest.update(b"surroundings")
        for array in (self.poses, self.focal, self.centre, self.box, self.mask, background):
            digest.update(b"" if array is None else np.ascontiguousarray(array))
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
    folder: str | os.PathLike,
    split: str = "train",
    most: int | None = None,
    progress: bool = False,
    background: str | tuple[int, int, int] | None = None,
    downscale: int | None = None,
) -> CapturedViews:
    """Read the views of a ``split``: "train", "test" or "val".

    The file is ``transforms_SPLIT.json``, or ``transforms.json`` with the lists ``train_filenames``, ``test_filenames``
    and ``val_filenames``, or, without these, a model of COLMAP. If no file or list names the test views, they are those
    for a validation or, without such, every eighth view. Views whose images do not exist are left out, with a note. Of
    more than ``most`` views, so many are read, evenly spread in the list. ``progress`` shows a bar on stderr.

    ``background`` is that of images without alpha: "white", "black", bytes of sRGB, or "scene" or "surroundings" if
    what is around the objects is part of the capture. ``None``: the colour of their borders if it is one, else "scene".

    ``downscale`` is a whole factor by which the sides of images are reduced. ``None``: the least one at which no side
    is longer than :data:`LONGEST` pixels.
    Raises :class:`ViewsError`, also for fewer than two training views, since one view does not show depth.
    """
    folder = Path(folder)
    if split not in SPLITS:
        raise ValueError(f'split: found "{split}", allowed are {", ".join(SPLITS)}')
    listed = list_frames(folder, split)
    frames, paths, missing = _with_images(listed, split)
    if most is not None and most < len(frames):
        chosen = [i * len(frames) // most for i in range(most)]
        frames, paths = ([entries[i] for i in chosen] for entries in (frames, paths))
    images = _Images(listed, len(paths), 2 if any(map(is_linear, paths)) else 1, downscale)
    with progress_bar("views", len(paths), "images", progress) as bar:
        for path, frame in zip(paths, frames, strict=True):
            images.add(path, frame)
            bar.update()
    opaque = images.opaque if images.transparent else list(range(len(paths)))
    mask = images.mask()
    if mask is not None and not mask.any():
        raise ViewsError(
            f"{listed.file}: no pixel counts: masks or lens distortions exclude all of {len(paths)} images"
        )
    views = CapturedViews(
        pixels=images.pixels[: images.count],
        offsets=np.cumsum([0, *(height * width for height, width in images.sizes)])[:-1],
        sizes=np.array(images.sizes),
        poses=np.stack([frame.pose for frame in frames]),
        focal=np.array(images.focal),
        centre=np.array(images.centre),
        names=tuple(str(path.relative_to(folder) if path.is_relative_to(folder) else path) for path in paths),
        path=folder,
        has_alpha=not opaque,
        split=split,
        mask=mask,
        notes=(*listed.notes, *missing, *images.all_notes()),
        settings=listed.settings,
    )
    _set_background(views, opaque, background)
    # Points of a model lie in the surroundings, too
    views.box = _box(listed, views.has_alpha or views.surroundings)
    return views


def _set_background(views: CapturedViews, opaque: list[int], background) -> None:
    """Let the ``opaque`` images of views be in front of a background."""
    if not opaque or background in ("scene", "surroundings"):
        views.surroundings = bool(opaque) and background == "surroundings"
        if not opaque and background not in (None, "scene"):
            views.notes += ("all images have alpha: the background is not used",)
        return
    chosen = NAMED[background] if isinstance(background, str) else background
    colour = chosen or border_colour(views, opaque)
    if colour is None:
        return
    for view in opaque:
        clear(views.stored(view), views.counted(view), colour)
    if not chosen:
        text = ", ".join(map(str, colour))
        views.notes += (f"images without alpha: the colour of their borders (sRGB {text}) is taken for the background",)
    views.has_alpha, views.background = True, tuple(colour)
    views.settings = views.settings | {"background": list(colour)}


def _with_images(listed: FrameList, split: str) -> tuple[list[Frame], list[Path], list[str]]:
    """Return the views whose images exist, the paths of these images, and notes on the others."""
    file, least = listed.file, 2 if split == "train" else 1  # one view shows no depth
    if not listed.frames:
        raise ViewsError(f'{file}: has no views for the split "{split}"')
    frames, paths, missing = [], [], []
    for frame in listed.frames:
        try:
            paths.append(image_file(listed.root, frame.image, file))
            frames.append(frame)
        except MissingImageError as e:
            missing.append((printable(frame.image), e))
    count = f'{len(missing):,} of {len(listed.frames):,} images of the split "{split}" do not exist'
    if len(frames) < least:
        fault = f"{missing[0][1]}; {count}" if missing else f"{file}: has {len(frames)} view for training"
        raise ViewsError(f"{fault}, at least {least} {'is' if least == 1 else 'are'} needed")
    if not missing:
        return frames, paths, []
    return frames, paths, [f"{listed.name}: {count} and are left out, such as {shortened(missing[0][0], 60)}"]


def _box(listed: FrameList, has_alpha: bool) -> np.ndarray | None:
    """Return the box of a list of views or, if no alpha shows where the objects are, that of most of its points."""
    if listed.box is not None or has_alpha or listed.points is None or not len(listed.points):
        return listed.box
    lower, upper = np.percentile(listed.points, (1, 99), axis=0)
    margin = 0.05 * (upper - lower).max()
    return np.stack([lower - margin, upper + margin])


class _Images:
    """Images of a capture while they are read: arrays and lists of :class:`CapturedViews`."""

    def __init__(self, listed: FrameList, views: int, words: int, downscale: int | None):
        self.listed, self.views, self.downscale = listed, views, downscale
        self.pixels, self.count = np.empty((0, words), np.uint32), 0
        self.sizes, self.focal, self.centre, self.masks = [], [], [], []
        self.transparent, self.opaque, self.undistorted, self.reduced = False, [], 0, set()
        self.alpha_masks, self.notes, self.off_middle = 0, {}, ""  # notes in their order, each once

    def add(self, path: Path, frame: Frame) -> None:
        """Read an image and its mask, reduce and undistort them."""
        numbers, listed, (image, has_alpha) = frame.numbers, self.listed, read_image(path)
        height, width = image.shape[:2]
        expected = numbers.get("w", width), numbers.get("h", height)
        if expected != (width, height):
            raise ViewsError(
                f"{path}: has {width} × {height} pixels, {listed.file} says {expected[0]:g} × {expected[1]:g}, to "
                f"which its focal lengths refer"
            )
        focal, notes = focal_lengths(numbers, width, height)
        self.notes |= {f"{listed.name}: {note}": None for note in notes}
        centre = numbers.get("cx", width / 2), numbers.get("cy", height / 2)
        # As a share of the side
        if any(abs(x / side - 0.5) > 0.25 for x, side in zip(centre, (width, height), strict=True)):
            self.off_middle = self.off_middle or (
                f"the principal point ({centre[0]:g}, {centre[1]:g}) of {path.name} is far from the middle of its "
                f"{width} × {height} pixels"
            )
        mask, excluded = None, path.with_name(f"dynamic_mask_{path.stem}.png")
        if frame.mask is not None:
            mask, in_alpha = read_mask(image_file(listed.root, frame.mask, listed.file), image, path)
            self.alpha_masks += in_alpha
        elif excluded.is_file():  # of instant-ngp, white where a pixel does not count
            mask = ~read_mask(excluded, image, path)[0]
        factor = self.downscale or -(-max(height, width) // LONGEST)
        if factor > min(height, width):
            raise ViewsError(f"{path}: has {width} × {height} pixels, which cannot be reduced by the factor {factor}")
        if factor > 1:
            image, mask = reduce_image(image, mask, factor)
            self.reduced.add(factor)
            focal, centre = ((x / factor, y / factor) for x, y in (focal, centre))
        lens = tuple(numbers.get(name, 0.0) for name in DISTORTION)
        if any(lens):
            image, mask = undistort(image, mask, focal, centre, lens)
            self.undistorted += 1
        if not has_alpha:
            self.opaque.append(len(self.sizes))
        elif not self.transparent:
            self.transparent = bool(image[..., 3].min() < (255 if image.dtype == np.uint8 else 1))
        self.sizes.append(image.shape[:2])
        self.focal.append(focal)
        self.centre.append(centre)
        self.masks.append(None if mask is None or mask.all() else mask)
        self._store(image)

    def all_notes(self) -> list[str]:
        """Return sentences on the images that were read."""
        notes = list(self.notes)
        if self.alpha_masks:
            notes.append(f"the masks of {self.alpha_masks} images are those of their alpha")
        if self.reduced:
            factors = " or ".join(map(str, sorted(self.reduced)))
            notes.append(f"images are reduced by the factor {factors} along each side: option --downscale")
        if self.off_middle:
            notes.append(f'{self.listed.name}: "cx" and "cy" in pixels are expected, {self.off_middle}')
        if self.undistorted:
            count = "all" if self.undistorted == len(self.sizes) else f"{self.undistorted} of {len(self.sizes)}"
            notes.append(f"{count} images have a lens distortion and were undistorted")
        return notes

    def _store(self, image: np.ndarray) -> None:
        words, size = self.pixels.shape[1], image.shape[0] * image.shape[1]
        end = self.count + size
        if end > len(self.pixels):  # the first time, or if a larger image follows: memory that nobody writes is free
            needed = 4 * words * (self.count + (self.views - len(self.sizes) + 1) * size)
            if needed > units.memory():
                raise ViewsError(
                    f"{self.views:,} images of {size:,} pixels take {needed:,} bytes of memory, this machine has "
                    f"{units.memory():,}: a larger --downscale makes them smaller"
                )
            grown = aligned((self.count + (self.views - len(self.sizes) + 1) * size, words), np.uint32)
            grown[: self.count] = self.pixels[: self.count]
            self.pixels = grown
        stored = image if words == 1 else np.clip(linear_pixels(image), -LARGEST, LARGEST).astype(np.float16)
        self.pixels[self.count : end] = stored.reshape(-1).view(np.uint32).reshape(-1, words)
        self.count = end

    def mask(self) -> np.ndarray | None:
        """Return the masks of all images one after the other, or ``None`` if all pixels count."""
        if all(mask is None for mask in self.masks):
            return None
        masks = zip(self.masks, self.sizes, strict=True)
        return np.concatenate([np.ones(h * w, bool) if mask is None else mask.ravel() for mask, (h, w) in masks])


#: Name → bytes of sRGB.
NAMED = {"white": (255, 255, 255), "black": (0, 0, 0)}


def _shown(image: np.ndarray) -> np.ndarray:
    """Return the bytes of sRGB of an image of bytes or halves, ``(…, 3)``."""
    return (image if image.dtype == np.uint8 else byte_pixels(image.astype(np.float32)))[..., :3]


def _near(shown: np.ndarray, colour) -> np.ndarray:
    return np.abs(shown.astype(np.int16) - np.int16(colour)).max(axis=-1) <= 4  # bytes of sRGB


def border_colour(views: CapturedViews, chosen: list[int]) -> tuple[int, int, int] | None:
    """Return the colour that most pixels at the borders of some views have, bytes of sRGB, or ``None``."""
    sides = np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1]
    images = ((views.stored(v), views.counted(v)) for v in chosen)
    pixels = np.concatenate([_shown(shown[side])[counts[side]] for shown, counts in images for side in sides])
    if not len(pixels):
        return None
    colour = np.median(pixels, axis=0).astype(int)
    return tuple(colour.tolist()) if _near(pixels, colour).mean() >= 0.9 else None


def clear(image: np.ndarray, counted: np.ndarray, colour) -> None:
    """Set the pixels of the background in a stored image to 0."""
    free = _near(_shown(image), colour) | ~counted
    border = np.ones_like(free)
    border[1:-1, 1:-1] = False
    image[binary_propagation(border & free, mask=free) & counted] = 0


#: Nodes along the longest side of the grid in which the box is searched.
SEARCH = 64

#: Voxels by which the box is larger than the visual hull.
MARGIN = 2


def object_box(views: CapturedViews) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner of the box of the captured objects.

    The box is the ``aabb`` of the capture, cut to the visual hull if the images have alpha. Without an ``aabb``, the
    search covers a cube around the point that the cameras look at, up to the nearest camera. Raises
    :class:`.ViewsError` if the visual hull is empty.
    """
    if views.box is not None:
        lower, upper = np.asarray(views.box, np.float64)
    else:
        middle, reach = focus(views)
        lower, upper = middle - reach, middle + reach
    if not views.has_alpha:
        return lower, upper
    for _ in range(2):  # the second time, in a finer grid
        spacing = float((upper - lower).max()) / (SEARCH - 1)
        shape = np.ceil((upper - lower) / spacing).astype(int) + 1
        inside = hull(views, lower, spacing, shape)
        if not inside.any():
            raise ViewsError(f"{views.path}: the views show nothing: no point has an alpha above 0 in all of them")
        occupied = np.argwhere(inside)
        first, last = occupied.min(axis=0) - MARGIN, occupied.max(axis=0) + MARGIN
        lower, upper = np.maximum(lower, lower + first * spacing), np.minimum(upper, lower + last * spacing)
    return lower, upper


def pixel_width(views: CapturedViews, point) -> float:
    """Return the width of a pixel at the distance of a point: the median over the views."""
    distances = np.linalg.norm(views.origins - np.asarray(point), axis=1)
    return float(np.median(distances / views.focal.mean(axis=1)))


def focus(views: CapturedViews) -> tuple[np.ndarray, float]:
    """Return the point nearest to the optical axes of all cameras and its distance to the nearest camera."""
    axes = -views.poses[:, :3, 2]
    # Σ (I − a aᵀ) (x − o) = 0; a little weight on the cameras' mean if all look the same way
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    ahead = views.origins + axes * np.linalg.norm(views.origins - views.origins.mean(axis=0), axis=1).max()
    matrix = across.sum(axis=0) + 1e-3 * len(axes) * np.eye(3)
    point = np.linalg.solve(
        matrix, np.einsum("nij,nj->i", across, views.origins) + 1e-3 * len(axes) * ahead.mean(axis=0)
    )
    reach = np.linalg.norm(views.origins - point, axis=1).min()
    return point, float(max(reach, 1e-3))


def hull(views: CapturedViews, lower, spacing: float, shape) -> np.ndarray:
    """Return the nodes ``lower + spacing · (i, j, k)`` of the visual hull: bool of this ``shape``.

    A node belongs to it if a third of the views have it in sight and none of these shows it empty: a pixel within a
    voxel of its projection has an alpha above 0, or does not count.
    """
    lower = np.asarray(lower, np.float64)
    axes = [a + spacing * np.arange(n) for a, n in zip(lower, shape, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    numbers, sights = np.arange(len(points)), np.zeros(len(points), np.int32)
    needed = max(1, int(0.34 * len(views)))  # views that must have a node in sight: space out of sight is not occupied
    for v in range(len(views)):
        local = (points - views.origins[v]) @ views.poses[v, :3, :3]
        ahead = -local[:, 2]
        front = ahead > 1e-6
        scale = views.focal[v] / np.where(front, ahead, 1)[:, None]
        x = views.centre[v, 0] + scale[:, 0] * local[:, 0] - 0.5
        y = views.centre[v, 1] - scale[:, 1] * local[:, 1] - 0.5
        # The filter is as wide as a voxel appears. Nodes so near that it would cover the image are left to other views
        near = 0.5 * np.median(ahead[front]) if front.any() else np.inf
        front &= ahead >= near
        reach = int(np.ceil(0.87 * spacing * views.focal[v].max() / near))
        covered = maximum_filter((views.stored(v)[..., 3] > 0) | ~views.counted(v), size=2 * reach + 1)
        height, width = covered.shape
        i, j = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
        sighted = front & (i >= 0) & (i < width) & (j >= 0) & (j < height)
        sights += sighted
        kept = sights + (len(views) - 1 - v) >= needed
        kept[sighted] &= covered[j[sighted], i[sighted]]
        points, numbers, sights = points[kept], numbers[kept], sights[kept]
    inside = np.zeros(tuple(shape), bool)
    inside.reshape(-1)[numbers] = True
    return inside
