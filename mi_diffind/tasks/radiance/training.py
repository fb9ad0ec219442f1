"""
Training a field through images: rays of random patches of the views, before random greys.

A patch of 4 × 4 neighbouring pixels shares most of what its rays read; that is 2.5 times as fast as single pixels.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import numpy as np

from ... import srgb
from ...fitting import Problem
from .field import VolumeField
from .march import differentiable, march
from .views import Views

#: Pixels along a side of a patch.
PATCH = 4


class Images:
    """Views as Dr.Jit arrays, and the rays of their pixels."""

    def __init__(self, types, views: Views):
        self.types, self.views = types, views
        self.pixels = types.Float(np.ascontiguousarray(views.images, np.float32).reshape(-1))
        cameras = np.concatenate([views.poses[:, :3, :].reshape(-1, 12), views.focal, views.centre], axis=1)
        self.cameras = types.Float(np.ascontiguousarray(cameras, np.float32).reshape(-1))

    def rays(self, view, x, y) -> tuple:
        """Origins and unit directions of the rays through the middles of pixels (:meth:`.Views.rays`)."""
        c = [value for j in range(4) for value in dr.gather(self.types.Array4f, self.cameras, view * 4 + j)]
        fx, fy, cx, cy = c[12:]
        u = (self.types.Float(x) + 0.5 - cx) / fx
        v = (cy - self.types.Float(y) - 0.5) / fy
        d = self.types.Array3f(*(c[4 * i] * u + c[4 * i + 1] * v - c[4 * i + 2] for i in range(3)))
        return self.types.Array3f(c[3], c[7], c[11]), dr.normalize(d)

    def colours(self, view, x, y):
        """Linear red, green and blue, multiplied by alpha, and alpha."""
        height, width = self.views.height, self.views.width
        return dr.gather(self.types.Array4f, self.pixels, dr.fma(dr.fma(view, height, y), width, x))

    def drawn(self, rng, size: int) -> tuple:
        """The view, column and row of ``size`` pixels, in patches."""
        types, views = self.types, self.views
        patches = max(1, size // PATCH**2)

        def whole(limit: int):
            number = types.UInt32(types.Float(rng.random(types.TensorXf, (patches,)).array) * limit)
            return dr.minimum(number, limit - 1)

        lane = dr.arange(types.UInt32, patches * PATCH**2)
        patch, pixel = lane // PATCH**2, lane % PATCH**2
        view = whole(len(views))
        x, y = whole(max(1, views.width - PATCH + 1)), whole(max(1, views.height - PATCH + 1))
        view, x, y = (dr.gather(types.UInt32, value, patch) for value in (view, x, y))
        x, y = x + pixel % PATCH, y + pixel // PATCH
        return view, dr.minimum(x, views.width - 1), dr.minimum(y, views.height - 1)


class ImagesProblem(Problem):
    """
    Fields through the images that they are to show. ``net`` maps names to tensors (a dictionary or a module);
    ``field_of`` makes a :class:`.VolumeField` of it, differentiably. The loss is the mean squared difference of sRGB
    values, before random greys, which teaches the opacity, too. ``held`` are views to measure by.
    """

    def __init__(self, types, net, field_of: Callable[..., VolumeField], views: Views, held: Views | None = None):
        self.types, self.net, self.field_of = types, net, field_of
        self.images = Images(types, views)
        self.held = Images(types, held if held is not None else views)
        self.identity = {"source": views.digest}

    def loss(self, net, rng, size: int):
        types = self.types
        view, x, y = self.images.drawn(rng, size)
        count = dr.width(view)
        offset = rng.random(types.TensorXf, (count,)).array
        grey = rng.random(types.TensorXf, (count,)).array
        o, d = self.images.rays(view, x, y)
        truth = self.images.colours(view, x, y)
        seen = differentiable(self.field_of(net), o, d, 0, dr.inf, True, offset)
        total = types.Float(0)
        for c in range(3):
            wanted = srgb.from_linear(dr.clip(truth[c] + (1 - truth[3]) * grey, 0, 1), fused=False)
            found = seen.colour[c] + seen.transmittance * grey
            # Beyond white, all is white; the slope goes on, so that it comes back
            total += dr.square(srgb.from_linear(found, fused=False) - wanted)
        return total * (1 / (3 * count))

    def measure(self, net):
        return evaluate(self.field_of(net), self.held)


def rendered(field: VolumeField, images: Images, view: int):
    """What a view shows: ``(height, width, 4)``, linear colours multiplied by alpha, and alpha."""
    types, views = images.types, images.views
    # Tiles of neighbouring pixels share what they read
    side = PATCH
    rows, columns = -(-views.height // side), -(-views.width // side)
    lane = dr.arange(types.UInt32, rows * columns * side * side)
    tile, pixel = lane // (side * side), lane % (side * side)
    x, y = (tile % columns) * side + pixel % side, (tile // columns) * side + pixel // side
    o, d = images.rays(dr.opaque(types.UInt32, view), x, y)
    seen = march(field, o, d, 0, dr.inf)
    values = np.stack([*seen.colour.numpy(), 1 - seen.transmittance.numpy()], axis=-1)
    values = values.reshape(rows, columns, side, side, 4).swapaxes(1, 2).reshape(rows * side, columns * side, 4)
    return values[: views.height, : views.width]


def shown(image: np.ndarray, grey: float = 1.0) -> np.ndarray:
    """An image before a grey, white by default, as sRGB in [0, 1]."""
    return srgb.from_linear(np.clip(image[..., :3] + (1 - image[..., 3:]) * grey, 0, 1))


def evaluate(field: VolumeField, images: Images) -> dict[str, float]:
    """
    PSNR of sRGB values before white, means over the views: of all pixels (``psnr_white_db``), and of those in which
    there is something (``psnr_foreground_db``: alpha above 0), which is the first figure, since white flatters.
    """
    return scores([rendered(field, images, v) for v in range(len(images.views))], images.views)


def scores(pictures: list[np.ndarray], views: Views) -> dict[str, float]:
    """The figures of :func:`evaluate` of pictures that a field made of the views."""
    white, foreground = [], []
    for picture, truth in zip(pictures, views.images, strict=True):
        squared = np.square(shown(picture) - shown(truth))
        covered = truth[..., 3] > 0
        white.append(squared.mean())
        foreground.append(squared[covered].mean() if covered.any() else squared.mean())
    psnr = [float(np.mean(-10 * np.log10(np.maximum(errors, 1e-12)))) for errors in (foreground, white)]
    return {"psnr_foreground_db": psnr[0], "psnr_white_db": psnr[1]}
