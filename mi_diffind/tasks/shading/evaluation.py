"""Evaluation of a shaded texture: images at levels of detail, under views and lights that no training draws."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from ...arrays.indirection import aligned_copy
from ...images import metrics
from ...maps.compressed import FilteredMaps, decibel
from ...maps.pyramid import Pyramid
from ..disney.decoder import Decoder
from ..disney.model import Effects
from ..disney.training import uniform_hemisphere
from .material import shaded, surface_of
from .reference import SAMPLES_PER_SIDE, reference

#: Function ``(u, v, level, wi, wo) → Array3f`` of shaded values.
ShadedReader = Callable[[Any, Any, Any, Any, Any], Any]

#: References of the images: letter → sample pattern.
TRUTHS = {"C": "converged", "P": "prefiltered"}

#: Samples of the converged reference along the side of each texel of level 0, and their largest number along the side
#: of a footprint: with 16 × 16 in all, the noise of the reference is at 36 dB on level 5 of a glossy material.
PER_TEXEL, LARGEST = 4, 64

#: Side of the images of :meth:`ShadedEvaluation.another`, and the largest number of their pixels on a level.
PART, CHOOSING = 4, 2**14

#: Seed of the views and lights; trainings use other generators.
SEED = 20231212


def reader(maps: FilteredMaps, effects: Effects, decoder: Decoder | None = None) -> ShadedReader:
    """Return a function that shades filtered parameters: by ``decoder``, or by the analytic model."""
    decoder = decoder or Decoder()

    def read(u, v, level, wi, wo):
        surface = surface_of(maps, maps.filtered(u, v, level), maps.extra(u, v, level))
        return shaded(decoder, surface, wi, wo, effects)

    return read


class ShadedEvaluation:
    """Images of a material with reference values, for several levels of detail and pairs of view and light.

    There are ``levels`` levels, from level 0 on, and ``pairs`` pairs; images are at most ``side`` texels wide and high.
    Each image shows another part of the material; its pixels are shifted by a part of a texel, as in a render.
    References are ``truths[letter][level]``, ``(pairs, rows, columns, 3)``, linear. Another ``stream`` gives other
    views, lights and parts.
    """

    def __init__(
        self, pyramid: Pyramid, effects: Effects, levels: int = 6, pairs: int = 16, side: int = 64, truths="CP",
        stream: int = 0,
    ):  # fmt: skip
        self.pyramid, self.effects, self.types = pyramid, effects, pyramid.types
        self._another: ShadedEvaluation | None = None
        self.levels, self.form = min(levels, pyramid.levels), (levels, pairs, side)
        rng = np.random.default_rng((SEED, stream))
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
        self.truths = {letter: [self._truth(TRUTHS[letter], i) for i in range(self.levels)] for letter in truths}

    def another(self) -> ShadedEvaluation:
        """Return small images under many other views and lights, with the converged truth alone.

        Their errors choose bias and state of a training. With few pairs, a single highlight would decide. They are
        rendered once.
        """
        if self._another is None:
            levels, pairs, side = self.form
            pairs = max(1, min(CHOOSING, pairs * side * side) // PART**2)
            self._another = ShadedEvaluation(self.pyramid, self.effects, levels, pairs, PART, "C", stream=1)
        return self._another

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

        ``psnr_db``: of values clipped to [0, 1], for each level; ``mean_db``: their mean; ``coarse_db``: their mean
        from level 2 on; ``flip``, if requested: the mean FLIP of the images as displayed, for each level of 16 pixels
        or more.
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
            figures["coarse_db"] = float(np.mean(figures["psnr_db"][2:])) if self.levels > 2 else math.nan
        return errors


def _image(value, shape) -> np.ndarray:
    dr.eval(value)  # all three at once: NumPy asks for one after the other, each a kernel
    return np.stack([c.numpy() for c in value], axis=-1).reshape(*shape, 3)
