"""Occupied space known before any training: the box of a capture and the visual hull of its silhouettes."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter

from .views import CapturedViews, ViewsError

#: Nodes along the longest side of the grid in which the box is searched.
SEARCH = 64

#: Share of the views that must have a node in sight, so that space out of sight does not count as occupied.
SIGHTED = 0.34

#: Voxels by which the box is larger than the visual hull.
MARGIN = 2


def box_of(views: CapturedViews) -> tuple[np.ndarray, np.ndarray]:
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

    A node belongs to it if a share :data:`SIGHTED` of the views have it in sight and none of these shows it empty: a
    pixel within a voxel of its projection has an alpha above 0, or does not count.
    """
    lower = np.asarray(lower, np.float64)
    axes = [a + spacing * np.arange(n) for a, n in zip(lower, shape, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    numbers, sights = np.arange(len(points)), np.zeros(len(points), np.int32)
    needed = max(1, int(SIGHTED * len(views)))
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
