"""Shaded textures: images under views and lights that no training draws, the reference, and a preview.

**The reference** is appearance from afar: shaded first, filtered afterwards (supplemental 1.5). The footprint of a
level of detail L is a square of 2^L × 2^L texels, along the axes. The analytic model shades samples of the footprint,
and their mean is the reference. Three patterns of samples:

- ``"converged"``: 256 stratified samples of unfiltered maps;
- ``"prefiltered"``: the paper's 16, each read in the mip pyramid two levels finer than L, which averages normals before
  they are shaded: mostly a filter of parameters;
- ``"jittered"``: 16 random samples of unfiltered maps, one in each of 4 × 4 strata: noisy, yet right on average.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from ...arrays.indirection import aligned_copy
from ...core.files import replacing
from ...images import metrics, srgb
from ...maps.pyramid import FilteredMaps, Pyramid, bias_share, decibel
from ..disney.decoder import Decoder
from ..disney.model import Effects
from ..disney.training import uniform_hemisphere
from .surface import shaded, surface_of

#: Function ``(u, v, level, wi, wo[, share of a level bias that counts]) → Array3f`` of shaded values.
ShadedReader = Callable[..., Any]

#: References of the images: letter → sample pattern.
TRUTHS = {"C": "converged", "P": "prefiltered"}

#: Samples of the converged reference along the side of each texel of level 0.
PER_TEXEL = 4

#: Most samples of the converged reference along the side of a footprint: with 16 × 16 in all, the noise of the
#: reference is at 36 dB on level 5 of a glossy material.
LARGEST = 64

#: Seed of the views and lights; trainings use other generators.
SEED = 20231212


def reader(maps: FilteredMaps, effects: Effects, decoder: Decoder | None = None) -> ShadedReader:
    """Return a function that shades filtered parameters: by ``decoder``, or by the analytic model."""
    decoder = decoder or Decoder()

    def read(u, v, level, wi, wo, share=None):
        if maps.level_bias and share is not None:
            level = level - maps.level_bias * (1 - share)
        surface = surface_of(maps, maps.filtered(u, v, level), maps.extra(u, v, level))
        return shaded(decoder, surface, wi, wo, effects)

    return read


class ShadedEvaluation:
    """Images of a material with reference values, for several levels of detail and pairs of view and light.

    There are ``levels`` levels, from level 0 on, and ``pairs`` pairs; images are at most ``side`` texels wide and high.
    Each image shows another part of the material; its pixels are shifted by a part of a texel, as in a render.
    References are ``truths[letter][level]``, ``(pairs, rows, columns, 3)``, linear.
    """

    def __init__(self, pyramid: Pyramid, effects: Effects, levels: int = 6, pairs: int = 16, side: int = 64):
        self.pyramid, self.effects, self.types = pyramid, effects, pyramid.types
        self.levels = min(levels, pyramid.levels)
        rng = np.random.default_rng(SEED)
        numbers = rng.random((4, pairs))
        # Strata of the cosine, one view and one light in each
        order = [rng.permutation(pairs) for _ in range(2)]
        cosines = [(o + n) / pairs for o, n in zip(order, numbers[:2], strict=True)]
        self.directions = [(cosines[0][i], numbers[2][i], cosines[1][i], numbers[3][i]) for i in range(pairs)]
        sizes = [level.shape[:2] for level in pyramid.values[: self.levels]]
        self.sizes = [(min(rows, side), min(columns, side)) for rows, columns in sizes]
        # First pixel of the image of each level and pair, from the top and from the left
        spare = np.array(sizes) - np.array(self.sizes)
        shifts = rng.random((self.levels, pairs, 2))
        self.origins = np.floor(rng.random(shifts.shape) * (spare[:, None] + 1)).clip(0, spare[:, None]) + shifts
        self.truths = {k: [self._truth(pattern, i) for i in range(self.levels)] for k, pattern in TRUTHS.items()}

    def _lanes(self, level: int, pairs=None) -> tuple:
        """Return ``(u, v, level, wi, wo)`` of all pixels of the images of a level, and their shape."""
        types, pairs = self.types, range(len(self.directions)) if pairs is None else pairs
        (rows, columns), whole = self.sizes[level], self.pyramid.values[level].shape
        origins = self.origins[level][list(pairs)]
        shape = (len(pairs), rows, columns)
        v = (np.arange(rows)[None, :, None] + origins[:, 0, None, None]) / whole[0]
        u = (np.arange(columns)[None, None, :] + origins[:, 1, None, None]) / whole[1]
        u, v = (np.broadcast_to(x, shape).astype(np.float32).ravel() for x in (u, v))
        numbers = np.array([self.directions[p] for p in pairs], np.float32).repeat(rows * columns, axis=0)
        a, b, c, d = (types.Float(aligned_copy(n)) for n in numbers.T)
        wi, wo = uniform_hemisphere(types, a, b), uniform_hemisphere(types, c, d)
        level = dr.opaque(types.Float, level, len(u))
        lanes = (types.Float(aligned_copy(u)), types.Float(aligned_copy(v)), level, wi, wo)
        dr.eval(lanes)
        return lanes, shape

    def _truth(self, pattern: str, level: int) -> np.ndarray:
        lanes, shape = self._lanes(level)
        side = SAMPLES_PER_SIDE[pattern]
        if pattern == "converged":
            side = int(np.clip(PER_TEXEL << level, side, LARGEST))
        return _image(reference(pattern, self.pyramid, *lanes, self.effects, side=side), shape)

    def images(self, read: ShadedReader, level: int, pairs=None) -> np.ndarray:
        """Return shaded images of a level, ``(pairs, rows, columns, 3)``, linear; all pairs unless some are named."""
        lanes, shape = self._lanes(level, pairs)
        with dr.suspend_grad():
            return _image(read(*lanes), shape)

    def measure(self, read: ShadedReader, flip: bool = True) -> dict[str, dict]:
        """Return the errors against each truth, by its letter.

        ``psnr_db``: of values clipped to [0, 1], for each level; ``mean_db``: their mean; ``flip``, if requested:
        the mean FLIP of the images as displayed, for each level of 16 pixels or more.
        """
        errors = {letter: {"psnr_db": [], "flip": []} for letter in self.truths}
        for level in range(self.levels):
            shown = np.clip(self.images(read, level), 0, 1)
            for letter, truths in self.truths.items():
                truth, figures = np.clip(truths[level], 0, 1), errors[letter]
                figures["psnr_db"].append(decibel(float(np.mean((shown - truth) ** 2, dtype=np.float64))))
                if flip and min(truth.shape[1:3]) >= 16:
                    pairs = zip(truth, shown, strict=True)
                    figures["flip"].append(float(np.mean([metrics.flip(a, b) for a, b in pairs])))
        for figures in errors.values():
            figures["mean_db"] = float(np.mean(figures["psnr_db"]))
        return errors


def _image(value, shape) -> np.ndarray:
    dr.eval(value)  # all three at once: NumPy asks for one after the other, each a kernel
    return np.stack([c.numpy() for c in value], axis=-1).reshape(*shape, 3)


#: Number of samples along each side of the footprint, by pattern.
SAMPLES_PER_SIDE = {"converged": 16, "prefiltered": 4, "jittered": 4}

#: Level of the paper's samples relative to the footprint: so much finer, so that 4 × 4 samples cover it.
FINER = 2

#: Number of samples that are shaded at a time.
CHUNK = 2**22


def reference(
    pattern: str, pyramid: Pyramid, u, v, level, wi, wo, effects: Effects, rng=None, side: int = 0, stretch=None
):  # fmt: skip
    """Return the shaded value (:func:`.surface.shaded`) of footprints around (u, v), ``Array3f``, without derivatives.

    ``level`` is the level of detail, a real number; each footprint is seen along ``wi`` and lit along ``wo``. ``rng``
    jitters the samples (``"jittered"`` needs one; without, samples are the centres of strata). ``side``, a power of
    two, replaces the number of samples along a side. ``stretch``: see :func:`places_in_footprints`.
    """
    stretch = dr.full(type(u), 1, dr.width(u)) if stretch is None else stretch
    side, size = side or SAMPLES_PER_SIDE[pattern], dr.width(u)
    with dr.suspend_grad():
        if size * side * side <= CHUNK:
            return _averaged(pattern, pyramid, u, v, level, wi, wo, stretch, effects, rng, side)
        types, step = pyramid.types, max(1, CHUNK // (side * side))
        total = dr.zeros(types.Array3f, size)
        for start in range(0, size, step):
            index = dr.opaque(types.UInt32, start) + dr.arange(types.UInt32, min(step, size - start))
            parts = [dr.gather(type(x), x, index) for x in (u, v, level, wi, wo, stretch)]
            means = _averaged(pattern, pyramid, *parts, effects, rng, side)
            dr.scatter(total, means, index)
            dr.eval(total)
        return total


def places_in_footprints(pyramid: Pyramid, u, v, level, x, y, stretch=1) -> tuple:
    """Return the places (x, y), from 0 to 1 along the sides, of footprints of a level of detail around (u, v).

    ``stretch`` multiplies their width, and divides their height: their area, which defines the level, is the same.
    They are wrapped in a repeating texture, else clamped to the edge.
    """
    extent = dr.exp2(level)
    u = dr.fma((x - 0.5) * extent * stretch, 1 / pyramid.layout.width, u)
    v = dr.fma((y - 0.5) * extent / stretch, 1 / pyramid.layout.height, v)
    borders = zip((u, v), reversed(pyramid.border), strict=True)
    return tuple(x - dr.floor(x) if border == "repeat" else dr.clip(x, 0, 1) for x, border in borders)


def share_of_bias(stretch):
    """Return :func:`.bias_share` of footprints of :func:`places_in_footprints`."""
    squared = dr.square(stretch)
    return bias_share(2 * dr.rcp(squared + dr.rcp(squared)))


def _averaged(pattern, pyramid: Pyramid, u, v, level, wi, wo, stretch, effects: Effects, rng, side: int):
    types, samples = pyramid.types, side * side
    Float, UInt32, size = types.Float, types.UInt32, dr.width(u)
    lane = dr.arange(UInt32, size * samples)
    # Power of two: shifts and masks in place of divisions. Opaque, so that one kernel serves all numbers of samples
    shift = round(math.log2(side))
    shift, mask, count, width = (dr.opaque(UInt32, n) for n in (shift, side - 1, samples - 1, side))
    place, sample, width = lane >> (2 * shift), lane & count, Float(width)
    x, y = Float(sample & mask), Float(sample >> shift)
    x, y = (x + (0.5 if rng is None else rng.random(Float, size * samples)) for x in (x, y))
    u, v, level, wi, wo, stretch = (dr.gather(type(a), a, place) for a in (u, v, level, wi, wo, stretch))
    u, v = places_in_footprints(pyramid, u, v, level, x / width, y / width, stretch)
    finer = dr.maximum(level - FINER, 0)
    stored = pyramid.filtered(u, v, finer) if pattern == "prefiltered" else pyramid.stored(u, v)
    value = shaded(Decoder(), surface_of(pyramid, stored), wi, wo, effects)
    dr.eval(value)  # all three at once: a sum over blocks evaluates what it is given
    return types.Array3f([dr.block_sum(c, samples) / samples for c in value])


#: Levels of the preview.
LEVELS = (0, 2, 4)

#: Factor by which the preview amplifies differences.
AMPLIFIED = 4

#: Approximate mean linear value of the image that is chosen.
BRIGHTNESS = 0.3

#: Smallest number of pixels along the side of each image.
PANEL = 192

#: Height of a strip of titles, pixels.
TITLE = 16


def write_preview(path: Path, evaluation: ShadedEvaluation, read: ShadedReader) -> None:
    """Write a picture with a row for each of :data:`LEVELS`, with titles: truth, shaded image, amplified difference.

    View and light are those under which the material is neither dark nor glaring.
    """
    import mitsuba as mi

    truths = evaluation.truths["C"]
    pair = int(np.abs(np.clip(truths[0], 0, 1).mean(axis=(1, 2, 3)) - BRIGHTNESS).argmin())
    rows, side = [], max(PANEL, *(max(size) for size in evaluation.sizes))
    for level in (i for i in LEVELS if i < evaluation.levels):
        truth, got = truths[level][pair], evaluation.images(read, level, [pair])[0]
        row = [srgb.for_display(truth), srgb.for_display(got), np.clip(AMPLIFIED * np.abs(truth - got), 0, 1)]
        titles = (f"level {level}: reference", "shaded", f"{AMPLIFIED}x difference")
        rows.append(titled(np.concatenate([_enlarged(image, side) for image in row], axis=1), titles))
    picture = np.concatenate(rows)
    with replacing(path) as temporary:
        mi.Bitmap(np.ascontiguousarray(picture)).write(str(temporary))


def titled(picture: np.ndarray, titles: Sequence[str]) -> np.ndarray:
    """Return a picture ``(height, width, 3)`` of values from 0 to 1 with a strip of ``titles`` above, 8 bits.

    The titles stand above as many parts of equal width.
    """
    from PIL import Image, ImageDraw, ImageFont

    width = picture.shape[1]
    strip = Image.new("RGB", (width, TITLE), "white")
    font = ImageFont.load_default(size=11)
    for i, title in enumerate(titles):
        ImageDraw.Draw(strip).text((i * width // len(titles) + 2, 1), title, "black", font)
    return np.concatenate([np.asarray(strip), np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)])


def _enlarged(image: np.ndarray, side: int) -> np.ndarray:
    """Enlarge an image by a whole factor to at most ``side`` × ``side`` pixels; the rest of the square is white."""
    times = max(1, side // max(image.shape[:2]))
    image = image.repeat(times, axis=0).repeat(times, axis=1)
    square = np.ones((side, side, 3))
    square[: image.shape[0], : image.shape[1]] = image
    return square
