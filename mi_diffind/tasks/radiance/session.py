"""Training of radiance fields through images: captured views as Dr.Jit arrays, the rays of their pixels, and figures.

A pixel is the mean over its square, as a camera records it: the mean of :data:`RAYS` rays, in training and in
measurements. One ray through its centre cannot be that mean at silhouettes, where 29% of the error was. Training pixels
are those of random patches, which share most of what their rays read, in front of random greys. Most patches lie where
the views show something.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import ModuleType

import drjit as dr
import numpy as np
from scipy.ndimage import binary_dilation

from ...arrays.indirection import device_array
from ...fitting.loop import Problem
from ...images import metrics, srgb
from .captures import LINEAR
from .march import Marched, differentiable, march
from .views import CapturedViews, ViewsError, focus, load_views
from .volume_field import VolumeField

#: Rays along a side of a pixel, each through the middle of a part of it.
SIDE = 2

#: Rays of a pixel.
RAYS = SIDE**2

#: Pixels along a side of a patch, whose rays are computed together.
PATCH = 2

#: Pixels along a side of a tile.
TILE = 8

#: Share of patches that are drawn from all tiles, with something in them or not.
ANYWHERE = 0.05

#: Share of the patches in tiles that are drawn by the errors of tiles.
BY_ERRORS = 0.75

#: Share of the mean error that is added to the error of each tile.
LEAST_ERROR = 0.25

#: Pixels of a tile whose error is measured: columns and rows.
SAMPLED = np.array([(2 * i + j % 2, 2 * j + i % 2) for j in range(TILE // 2) for i in range(TILE // 2)]).T

#: Linear grey before which errors of tiles are measured.
GREY = 0.2

#: Most held-out views of measurements during a training, without and with a limit of time.
MOST_WATCHED, MOST_WATCHED_LIMITED = 20, 8


class ViewImages:
    """Captured ``views`` as Dr.Jit arrays, and the rays of their pixels."""

    def __init__(self, types, views: CapturedViews):
        self.types, self.views = types, views
        cameras = np.concatenate([views.poses[:, :3, :].reshape(-1, 12), views.focal, views.centre], axis=1)
        self.cameras = device_array(types.Float, cameras)
        self.places = device_array(types.UInt32, np.column_stack([views.offsets, views.sizes, views.sizes[:, 0]]))

    @functools.cached_property
    def pixels(self):
        """Pixels as :class:`.CapturedViews` keeps them: four bytes in a UInt32, or four numbers of type Float16.

        They share the memory of the views on the CPU.
        """
        pixels = self.views.pixels
        if pixels.shape[1] == 1:
            return self.types.UInt32(pixels.reshape(-1))
        return self.types.Float16(pixels.view(np.float16).reshape(-1))

    @functools.cached_property
    def linear(self):
        """Linear value of each byte of sRGB."""
        return device_array(self.types.Float, LINEAR)

    @property
    def near(self) -> float:
        """Distance from the camera at which training rays begin.

        Close to a camera, nothing but its own view would say what is there.
        """
        # Nearer, nothing but its own view would say what is there
        return 0.4 * focus(self.views)[1] if self.views.surroundings else 0.0

    def _place(self, view):
        """Return the number of the first pixel of a view, its height and its width."""
        return list(dr.gather(self.types.Array4u, self.places, view))[:3]

    def _index(self, view, x, y):
        """Return the numbers of pixels among those of all views."""
        offset, _, width = self._place(view)
        return offset + dr.fma(y, width, x)

    @functools.cached_property
    def tiles(self):
        """View, first column and first row of the tiles in which, or beside which, something is seen: Array3u."""
        places = []
        for view in range(len(self.views)):
            seen = (self.views.stored(view)[..., 3] > 0) & self.views.counted(view)
            seen = np.pad(seen, [(0, -n % TILE) for n in seen.shape])
            rows, columns = (n // TILE for n in seen.shape)
            filled = seen.reshape(rows, TILE, columns, TILE).any(axis=(1, 3))
            y, x = np.nonzero(binary_dilation(filled, np.ones((3, 3), bool)))
            places.append(np.stack([np.full(len(x), view), TILE * x, TILE * y]))
        return self.types.Array3u(*(device_array(self.types.UInt32, row) for row in np.concatenate(places, axis=1)))

    def pixel_rays(self, view, x, y, side: int = SIDE) -> tuple:
        """Return origins and unit directions of the ``side``² rays of pixels, those of a pixel next to each other."""
        Float, UInt32 = self.types.Float, self.types.UInt32
        count = max(dr.width(view), dr.width(x), dr.width(y))
        rays = side**2
        lane = dr.arange(UInt32, count * rays)
        pixel, ray = lane // rays, lane % rays
        view, x, y = (dr.gather(UInt32, value, pixel) if dr.width(value) > 1 else value for value in (view, x, y))
        within = ((Float(place) + 0.5) / side for place in (ray % side, ray // side))
        return self.rays(view, x, y, tuple(within))

    def rays(self, view, x, y, within=(0.5, 0.5)) -> tuple:
        """Return origins and unit directions of the rays through pixels, at the positions ``within`` them."""
        c = [value for j in range(4) for value in dr.gather(self.types.Array4f, self.cameras, view * 4 + j)]
        fx, fy, cx, cy = c[12:]
        u = (self.types.Float(x) + within[0] - cx) / fx
        v = (cy - self.types.Float(y) - within[1]) / fy
        d = self.types.Array3f(*(c[4 * i] * u + c[4 * i + 1] * v - c[4 * i + 2] for i in range(3)))
        return self.types.Array3f(c[3], c[7], c[11]), dr.normalize(d)

    def colours(self, view, x, y):
        """Return linear red, green and blue, multiplied by alpha, and alpha."""
        types, index = self.types, self._index(view, x, y)
        if self.views.pixels.shape[1] == 2:
            return types.Array4f(dr.gather(types.Array4f16, self.pixels, index))
        word = dr.gather(types.UInt32, self.pixels, index)
        alpha = types.Float(word >> 24) / 255
        colour = [dr.gather(types.Float, self.linear, (word >> shift) & 255) * alpha for shift in (0, 8, 16)]
        return types.Array4f(*colour, alpha)

    @functools.cached_property
    def mask(self):
        """Mask of :class:`.CapturedViews`, or ``None`` if all pixels count."""
        return None if self.views.mask is None else self.types.Bool(self.views.mask)

    def counted(self, view, x, y):
        """Return whether pixels count."""
        if self.mask is None:
            return self.types.Bool(True)
        return dr.gather(self.types.Bool, self.mask, self._index(view, x, y))

    def behind(self, rng, count: int) -> list:
        """Return linear red, green and blue behind ``count`` rays: a random grey, or the background of the views."""
        types = self.types
        grey = rng.random(types.TensorXf, (count,)).array
        if self.views.background is None:
            return [grey] * 3
        return [types.Float(float(LINEAR[byte])) for byte in self.views.background]

    def cumulative_errors(self, field: VolumeField):
        """Return the chances of all :attr:`tiles` by the errors of a field, summed up to each: a Float from 0 to 1.

        The chance of a tile is proportional to the root of the mean squared difference of sRGB values before grey, at
        one ray through each of 16 pixels. ``None`` if there are no errors.
        """
        types, views = self.types, self.views
        tile_views, tile_columns, tile_rows = (n.numpy() for n in self.tiles)
        errors = np.zeros(len(tile_views))
        for view in range(len(views)):
            chosen = np.nonzero(tile_views == view)[0]
            if len(chosen) == 0:
                continue
            height, width = views.sizes[view].tolist()
            column, row = tile_columns[chosen, None] + SAMPLED[0], tile_rows[chosen, None] + SAMPLED[1]
            inside = (column < width) & (row < height)
            column, row = np.minimum(column, width - 1), np.minimum(row, height - 1)
            place = dr.opaque(types.UInt32, view), *(device_array(types.UInt32, n) for n in (column, row))
            seen = march(field, *self.rays(*place), self.near, dr.inf)
            truth, total = self.colours(*place), types.Float(0)
            for c in range(3):
                shown, reference = (
                    srgb.from_linear(colour + clear * GREY, fused=False)
                    for colour, clear in ((seen.colour[c], seen.transmittance), (truth[c], 1 - truth[3]))
                )
                total += dr.square(shown - reference)
            total = dr.select(self.counted(*place), total, 0).numpy().reshape(inside.shape)
            errors[chosen] = (total * inside).sum(axis=1) / np.maximum(1, inside.sum(axis=1))
        if not errors.any():
            return None
        chances = np.cumsum(np.sqrt(errors + errors.mean() * LEAST_ERROR))
        return device_array(types.Float, chances / chances[-1])

    def random_pixels(self, rng, size: int, side: int = PATCH, cumulative=None) -> tuple:
        """Return view, column and row of ``size`` random pixels, in patches of ``side``².

        The share :data:`ANYWHERE` of the patches is drawn from all pixels of a view, and each view is as likely as the
        others; the rest is drawn from the tiles in which something is seen. With ``cumulative`` chances
        (:meth:`cumulative_errors`), the share :data:`BY_ERRORS` of these is drawn by them.
        """
        types, views = self.types, self.views
        patches = max(1, size // side**2)

        def number():
            return types.Float(rng.random(types.TensorXf, (patches,)).array)

        def whole(limit):
            return dr.minimum(types.UInt32(number() * types.Float(limit)), limit - 1)

        view = whole(types.UInt32(len(views)))
        height, width = self._place(view)[1:]
        x, y = (whole(dr.maximum(limit, side) - (side - 1)) for limit in (width, height))
        if tiles := dr.width(self.tiles):
            chosen, of_tile = whole(dr.opaque(types.UInt32, tiles)), number() >= ANYWHERE
            if cumulative is not None:
                sought = number()
                by_error = dr.binary_search(0, tiles - 1, lambda i: dr.gather(types.Float, cumulative, i) < sought)
                chosen = dr.select(number() < BY_ERRORS, by_error, chosen)
            place = [dr.gather(types.UInt32, values, chosen) for values in self.tiles]
            place[1:] = (value + whole(types.UInt32(TILE)) for value in place[1:])
            view, x, y = (dr.select(of_tile, a, b) for a, b in zip(place, (view, x, y), strict=True))
            height, width = self._place(view)[1:]
        lane = dr.arange(types.UInt32, patches * side**2)
        patch, pixel = lane // side**2, lane % side**2
        view, x, y, width, height = (dr.gather(types.UInt32, value, patch) for value in (view, x, y, width, height))
        x, y = x + pixel % side, y + pixel // side
        return view, dr.minimum(x, width - 1), dr.minimum(y, height - 1)

    def render(self, field: VolumeField, view: int) -> np.ndarray:
        """Return the picture of a view, ``(height, width, 4)``: linear colours multiplied by alpha, and alpha."""
        types, side = self.types, PATCH
        height, width = self.views.sizes[view].tolist()
        rows, columns = -(-height // side), -(-width // side)
        # Neighbouring pixels, which read the same nodes, lie in tiles
        lane = dr.arange(types.UInt32, rows * columns * side * side)
        tile, pixel = lane // (side * side), lane % (side * side)
        x, y = (tile % columns) * side + pixel % side, (tile // columns) * side + pixel // side
        o, d = self.pixel_rays(dr.opaque(types.UInt32, view), x, y)
        seen = march(field, o, d, 0, dr.inf)
        values = np.stack([*seen.colour.numpy(), 1 - seen.transmittance.numpy()], axis=-1)
        values = values.reshape(rows, columns, side, side, RAYS, 4).mean(axis=4).swapaxes(1, 2)
        return values.reshape(rows * side, columns * side, 4)[:height, :width]

    def evaluate(self, field: VolumeField, ssim: bool = False) -> dict[str, float]:
        """Return the PSNR of sRGB values before white in decibels, as means over the views.

        Views with a background of their own are compared in front of that. ``psnr_white_db`` is that of all pixels that
        count. ``psnr_foreground_db``, of those with an alpha above 0, is the first figure, since white flatters. With
        ``ssim``, ``ssim_white`` is the structural similarity, unless the views are smaller than its window.
        """
        return scores((self.render(field, v) for v in range(len(self.views))), self.views, ssim)


@dataclass
class FieldSession:
    """Views of one capture: those that fields are trained by, and the ``held_out`` ones that they are measured by."""

    types: ModuleType
    views: CapturedViews
    held_out: CapturedViews
    #: False if the capture has no test views, so that ``held_out`` are the training views.
    has_test_views: bool = True
    #: Most pixels of the views in which the visible cells of a field are sought (``None``: all).
    pixels: float | None = None

    @staticmethod
    def load(types: ModuleType, folder, pixels: float | None = None, **reading) -> FieldSession:
        """Read the capture in a folder, of the held-out views so many that they have at most ``pixels``.

        ``reading`` are further arguments of :func:`.views.load_views`. Raises :class:`.views.ViewsError`.
        """
        views = load_views(folder, "train", **reading)
        most = None if pixels is None else max(2, round(pixels / views.mean_pixels))
        reading["background"] = views.background or "scene"
        held_out, has_test_views = load_held_out(folder, most, **reading)
        # Of these, one is looked at at a time
        return FieldSession(types, views, held_out.compressed(), has_test_views, pixels)

    @property
    def notes(self) -> list[str]:
        """Notes on the training views and the held-out ones, each once."""
        return list(dict.fromkeys((*self.views.notes, *self.held_out.notes)))

    @functools.cached_property
    def images(self) -> ViewImages:
        """Training views as Dr.Jit arrays."""
        return ViewImages(self.types, self.views)

    @functools.cached_property
    def seeing_images(self) -> ViewImages:
        """Training views in which visible cells are sought, evenly spread in the list."""
        views = self.views
        most = len(views) if self.pixels is None else max(8, round(self.pixels / views.mean_pixels))
        return self.images if most >= len(views) else ViewImages(self.types, views.spread(most))

    @functools.cached_property
    def held_out_images(self) -> ViewImages:
        """Held-out views as Dr.Jit arrays."""
        return ViewImages(self.types, self.held_out)

    @functools.cached_property
    def watched_images(self) -> ViewImages:
        """Held-out views for measurements during a training, evenly spread in the list; fewer if time is limited."""
        count, most = len(self.held_out), MOST_WATCHED
        if self.pixels is not None:
            most = max(1, min(MOST_WATCHED_LIMITED, round(0.2 * count)))
        return self.held_out_images if count <= most else ViewImages(self.types, self.held_out.spread(most))


def load_held_out(folder, most: int | None = None, **reading) -> tuple[CapturedViews, bool]:
    """Return ``most`` test views of a capture and True or, if there are none, of its training views and False.

    A note of the training views says why there are none. ``reading`` are further arguments of
    :func:`.views.load_views`.
    """
    try:
        return load_views(folder, "test", most, **reading), True
    except ViewsError as e:
        try:
            views = load_views(folder, "train", most, **reading)
            return dataclasses.replace(views, notes=(*views.notes, f"no test views: {e}")), False
        except ViewsError:
            raise e from None


def displayed(image: np.ndarray, background=(255, 255, 255)) -> np.ndarray:
    """Return an image ``(…, 4)`` in front of a background, by default white, as sRGB ``(…, 3)`` in [0, 1]."""
    return srgb.for_display(image[..., :3] + (1 - image[..., 3:]) * LINEAR[list(background)])


def scores(pictures: Iterable[np.ndarray], views: CapturedViews, ssim: bool = False) -> dict[str, float]:
    """Return the figures of :meth:`ViewImages.evaluate` for pictures ``(height, width, 4)`` of the views."""
    white, foreground, similarities, behind = [], [], [], views.background or (255, 255, 255)
    for view, picture in zip(range(len(views)), pictures, strict=True):
        truth, counted = views.image(view), views.counted(view)
        if not counted.any():
            continue
        shown, expected = displayed(picture, behind), displayed(truth, behind)
        squared = np.square(shown - expected)[counted]
        covered = truth[counted][:, 3] > 0
        white.append(squared.mean())
        foreground.append(squared[covered].mean() if covered.any() else squared.mean())
        if ssim:
            similarities.append(metrics.ssim_published(expected, shown, counted))
    figures = {
        f"psnr_{name}_db": float(np.mean(-10 * np.log10(np.maximum(errors, 1e-12))))
        for name, errors in (("foreground", foreground), ("white", white))
    }
    similar = [s for s in similarities if s is not None]
    return figures | ({"ssim_white": float(np.mean(similar))} if similar else {})


class ImagesProblem(Problem):
    """Training of a field through the images of a session.

    ``net`` maps names to tensors (a dictionary or a module); ``field_of`` makes a :class:`.VolumeField` of them,
    differentiably. The loss is the mean squared difference of sRGB values in front of random greys, which trains the
    opacity, too, or in front of the background of views that have one.

    A pixel is the mean of ``side``² rays; a step has as many rays whatever that is.
    """

    side = SIDE

    #: Chances of tiles by the errors of the field at the beginning (:meth:`ViewImages.cumulative_errors`), if rays are
    #: drawn by them.
    cumulative = None

    def __init__(self, session: FieldSession, net, field_of: Callable[..., VolumeField]):
        self.session, self.net, self.field_of = session, net, field_of
        self.identity = {"source": session.views.digest}

    def loss(self, net, rng, size: int):
        types, images = self.session.types, self.session.images
        rays = self.side**2
        view, x, y = images.random_pixels(rng, size // rays, PATCH * SIDE // self.side, self.cumulative)
        count = dr.width(view)
        o, d = images.pixel_rays(view, x, y, self.side)
        offset = rng.random(types.TensorXf, (dr.width(o),)).array
        behind = images.behind(rng, count)
        truth = images.colours(view, x, y)
        seen = differentiable(self.field_of(net).for_training(), o, d, images.near, dr.inf, True, offset)
        dr.schedule(seen.colour, seen.transmittance)  # at once: each sum evaluates what it adds up
        *colour, transmittance = (dr.block_sum(v, rays) / rays for v in (*seen.colour, seen.transmittance))
        pairs = before(Marched(colour, transmittance), truth, behind)
        total = sum((dr.square(shown - reference) for shown, reference in pairs), types.Float(0))
        return dr.select(images.counted(view, x, y), total, 0) * (1 / (3 * count))

    def measure(self, net):
        return self.session.watched_images.evaluate(self.field_of(net))


def before(seen: Marched, truth, background: list) -> list[tuple]:
    """Return pairs of a seen and a true sRGB value in front of a ``background``, for red, green and blue.

    ``truth`` holds linear colours multiplied by alpha, and alpha. Seen values are not clamped at white: their
    derivatives lead back into the range.
    """
    pairs = []
    for c, behind in enumerate(background):
        reference = srgb.from_linear(dr.clip(truth[c] + (1 - truth[3]) * behind, 0, 1), fused=False)
        pairs.append((srgb.from_linear(seen.colour[c] + seen.transmittance * behind, fused=False), reference))
    return pairs
