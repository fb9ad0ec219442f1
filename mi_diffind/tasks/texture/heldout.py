"""Held-out footprints of a material: single pixels under views and lights that decide what a training keeps.

Footprints are drawn for each level of detail. Each is read as a renderer with N samples a pixel reads it
(:data:`CASES`): the mean of reads at places within the pixel, a level finer for each factor of four in N; or once, at
its centre. Differences of two readers have a standard error, so that chance decides nothing.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from ...arrays.indirection import aligned_copy
from ...maps.pyramid import Pyramid
from ..disney.model import Effects
from ..disney.training import uniform_hemisphere
from .appearance import ShadedReader, places_in_footprints, reference

#: Samples a pixel, at places within it; 0 stands for one read at its centre.
CASES = (0, 1, 4, 16)

#: Footprints of each level.
COUNT = 2**12

#: Most levels, from level 0 on.
LEVELS = 8

#: Places of reads along each side of a pixel, by the samples a pixel: the mean over them is that of many samples.
PLACES = {1: 4, 4: 4, 16: 8}

#: Samples of the truth along each side of a footprint.
SIDE = 16

#: Share of the lights that are drawn about the mirror direction, with the α of microfacets.
MIRRORED = 0.5
ALPHAS = (0.05, 0.2, 0.5)

#: Share of the values of the truth that are white or brighter in the exposure of errors.
WHITE = 0.05

#: Largest binary logarithm of the stretch of a footprint.
STRETCH = 1.5

#: Seed of the footprints; trainings use other generators.
SEED = 20231213

#: Largest loss that may be due to chance, dB, and the number of standard errors that are.
LOSS = 0.1
ERRORS = 2.0

#: Largest loss of a single case on a single level, dB.
SINGLE = 1.0


def mirrored_pairs(types, numbers, share: float = MIRRORED) -> tuple:
    """Return views, lights and weights, 0 or 1, of five arrays of uniform ``numbers``.

    Views are uniform over the hemisphere. A ``share`` of the lights is drawn about the mirror direction, by GGX lobes
    of :data:`ALPHAS` about the surface's normal; others are uniform. Lights below the horizon have the weight 0.
    """
    a, b, c, d, e = numbers
    Array3f, wi, uniform = types.Array3f, uniform_hemisphere(types, a, b), uniform_hemisphere(types, c, d)
    lobe = e * (len(ALPHAS) / max(share, 1e-9))
    alpha = dr.select(lobe < 1, ALPHAS[0], dr.select(lobe < 2, ALPHAS[1], ALPHAS[2]))
    cos = dr.sqrt((1 - c) / (1 + (dr.square(alpha) - 1) * c))
    sin, (s, t) = dr.safe_sqrt(1 - cos * cos), dr.sincos(2 * dr.pi * d)
    h = Array3f(sin * t, sin * s, cos)
    wo = dr.select(e < share, 2 * dr.dot(wi, h) * h - wi, uniform)
    above = wo.z > 0
    return wi, dr.select(above, wo, Array3f(0, 0, 1)), dr.select(above, types.Float(1), 0)


class HeldOutFootprints:
    """Footprints of a ``pyramid`` with the converged truth, ``count``, even, for each of at most :data:`LEVELS` levels.

    ``exposure`` is the factor by which a share :data:`WHITE` of the truth is 1 or brighter under uniform lights: errors
    of dark materials count as they are seen. Footprints are stretched along u or v, as those at grazing angles are.
    """

    def __init__(self, pyramid: Pyramid, effects: Effects, count: int = COUNT):
        self.pyramid, self.types, self.count = pyramid, pyramid.types, count
        self.levels = min(LEVELS, pyramid.levels)
        rng, types = np.random.default_rng(SEED), self.types
        self.footprints = []
        for level in range(self.levels):
            numbers = rng.random((8, count), dtype=np.float32)
            # Lights of the first half are uniform, those of the second half are drawn about the mirror direction
            numbers[7] *= MIRRORED
            numbers[7, : count // 2] += MIRRORED
            u, v, stretch, *numbers = (types.Float(aligned_copy(x)) for x in numbers)
            wi, wo, weight = mirrored_pairs(types, numbers)
            stretch = dr.exp2((stretch - 0.5) * (2 * STRETCH))
            at = dr.opaque(types.Float, level, count)
            drawn = _Numbers(rng)
            truth = reference("jittered", pyramid, u, v, at, wi, wo, effects, drawn, SIDE, stretch)
            dr.eval(u, v, stretch, wi, wo, weight, truth)
            self.footprints.append((u, v, stretch, wi, wo, weight, truth))
        halves = [[x[: count // 2] for x in self._luminance(footprint)] for footprint in self.footprints]
        values, weights = (np.concatenate(x) for x in zip(*halves, strict=True))
        order = np.argsort(values)
        brighter = 1 - np.cumsum(weights[order]) / weights.sum()
        self.exposure = float(1 / max(values[order][np.searchsorted(-brighter, -WHITE)], 1e-3))

    @staticmethod
    def _luminance(footprint: tuple) -> tuple[np.ndarray, np.ndarray]:
        *_, weight, truth = footprint
        return (sum(truth) / 3).numpy(), weight.numpy()

    def errors(self, read: ShadedReader) -> np.ndarray:
        """Return the squared errors of exposed values up to 1, ``(levels, cases, count / 2)``.

        There are two cases for each of :data:`CASES`: uniform lights, and lights about the mirror direction.
        """
        errors = [[self._error(read, level, samples) for samples in CASES] for level in range(self.levels)]
        return np.reshape(errors, (self.levels, 2 * len(CASES), self.count // 2))

    def brightness(self, read: ShadedReader) -> np.ndarray:
        """Return the weighted mean of shaded values over that of the truth, ``(levels,)``, one read at the centre."""
        ratios = []
        for level, (*_, weight, truth) in enumerate(self.footprints):
            value = self._read(read, level, 0)
            ratios.append([np.mean((weight * sum(x)).numpy(), dtype=np.float64) for x in (value, truth)])
        return np.array([a / max(b, 1e-12) for a, b in ratios])

    def _error(self, read: ShadedReader, level: int, samples: int) -> np.ndarray:
        *_, weight, truth = self.footprints[level]
        value, exposure = self._read(read, level, samples), dr.opaque(self.types.Float, self.exposure)
        shown = [[dr.minimum(exposure * c, 1) for c in colour] for colour in (value, truth)]
        return (weight * sum(dr.square(a - b) for a, b in zip(*shown, strict=True)) / 3).numpy()

    def _read(self, read: ShadedReader, level: int, samples: int) -> Any:
        """Return the value of a pixel as a renderer with ``samples`` a pixel shows it on average."""
        types = self.types
        u, v, stretch, wi, wo, *_ = self.footprints[level]
        Float, UInt32 = types.Float, types.UInt32
        with dr.suspend_grad():
            if not samples:
                value = read(u, v, dr.opaque(Float, level, self.count), wi, wo)
                dr.eval(value)
                return value
            side = PLACES[samples]
            places = side**2
            lane = dr.arange(UInt32, self.count * places)
            pixel, place = lane // places, lane % places
            u, v, stretch, wi, wo = (dr.gather(type(x), x, pixel) for x in (u, v, stretch, wi, wo))
            inside = ((Float(n) + 0.5) / side for n in (place % side, place // side))
            u, v = places_in_footprints(self.pyramid, u, v, dr.opaque(Float, level), *inside, stretch)
            finer = max(0.0, level - 0.5 * float(np.log2(samples)))
            value = read(u, v, dr.opaque(Float, finer, len(lane)), wi, wo)
            dr.eval(value)
            return types.Array3f([dr.block_sum(c, places) / places for c in value])


class _Numbers:
    """Generator of arrays of uniform numbers, as the reference draws them, from NumPy's."""

    def __init__(self, rng: np.random.Generator):
        self.rng = rng

    def random(self, dtype, size: int):
        """Return ``size`` uniform numbers."""
        return dtype(aligned_copy(self.rng.random(size, dtype=np.float32)))


def compared(base: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the gains of ``errors`` over ``base`` and their standard errors, in dB, ``(levels, cases)``."""
    means = [np.maximum(e.mean(axis=-1, dtype=np.float64), 1e-12) for e in (base, errors)]
    relative = base / means[0][..., None] - errors / means[1][..., None]
    scale = 10 / np.log(10)
    return scale * np.log(means[0] / means[1]), scale * relative.std(axis=-1) / np.sqrt(base.shape[-1])


def loss_or_gain(base: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """Return the gain over ``base`` in dB, and the mean of all levels and cases.

    The gain is that mean, unless the mean of a level or of a case loses, or one case on one level loses more than
    :data:`SINGLE`: then it is the largest such loss, negative. A loss of a mean within :data:`ERRORS` standard errors,
    up to :data:`LOSS`, is none.
    """
    gains, doubts = compared(base, errors)
    losses = [float(gains.min()) + SINGLE]
    for axis in (0, 1):
        doubt = ERRORS * np.sqrt(np.mean(doubts**2, axis=axis) / gains.shape[axis])
        losses.append(float((gains.mean(axis=axis) + np.minimum(doubt + 1e-4, LOSS)).min()))
    mean = float(gains.mean())
    return (mean if min(losses) >= 0 else min(losses)), mean
