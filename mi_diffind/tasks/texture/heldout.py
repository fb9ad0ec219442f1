"""Held-out footprints of a material: single pixels under views and lights that decide what a training keeps.

Footprints are drawn for each level of detail. Each is read as a renderer with N samples a pixel reads it
(:data:`CASES`): the mean of reads at places within the pixel, a level finer for each factor of four in N; or once, at
its centre. Those of one kind of light and of one range of stretches are a case of their own: grain that runs along u
is lost where pixels are stretched along v alone. Differences of two readers have a standard error, so that chance
decides nothing.
"""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import drjit as dr
import numpy as np

from ...arrays.indirection import aligned_copy
from ...maps.pyramid import Pyramid
from ..disney.model import Effects
from ..disney.training import uniform_hemisphere
from .appearance import ShadedReader, places_in_footprints, reference, share_of_bias

#: Samples a pixel, at places within it; 0 stands for one read at its centre.
CASES = (0, 1, 4, 16)

#: Kinds of lights: uniform, about the mirror direction, and a uniform sky, which is the mean of so many lights.
LIGHTS, SKY = 3, 8

#: Step of the azimuth from one light of a sky to the next, in turns.
GOLDEN = 0.618034

#: Largest weight of the errors under skies.
MOST = 100.0

#: Equal ranges of the logarithm of the stretch; a range and a kind of light are a group of footprints.
RANGES = 3

#: Pairs of a footprint and a light of each group and level that are read once, and those that are read several times.
COUNT = 2**13
SEVERAL = 2**11

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

#: Largest binary logarithm of the stretch of a footprint: it is up to 16 times as long as wide.
STRETCH = 2.0

#: Share of the footprints whose views do not follow from their stretch, as on curved surfaces.
CURVED = 0.25

#: Seed of the footprints; trainings use other generators.
SEED = 20231213

#: Losses in dB that are none: of a mean over levels or cases, and of a single level, case and range of stretches.
LOSS = 0.1
SINGLE = 0.3


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


def stretched_views(types, stretch, a, b) -> tuple:
    """Return stretches and the first two numbers of :func:`mirrored_pairs` of uniform numbers ``stretch``, a and b.

    A flat surface stretches footprints by the view: a pixel is 1/cos θ times as long as wide, along the view. Views of
    a share :data:`CURVED` are uniform, those of other pixels lie within 45° of the axis that is stretched.
    """
    logarithm = (stretch - 0.5) * (2 * STRETCH)
    turns = 2 * b
    azimuth = 0.5 * dr.floor(turns) + dr.select(logarithm > 0, 0, 0.25) + 0.25 * (turns - dr.floor(turns) - 0.5)
    curved = a < CURVED
    cosine = dr.select(curved, a / CURVED, dr.exp2(-2 * dr.abs(logarithm)))
    return dr.exp2(logarithm), cosine, dr.select(curved, b, azimuth - dr.floor(azimuth))


def under_skies(types, sky, numbers: Sequence) -> list:
    """Return arrays of uniform ``numbers``, changed where ``sky`` is true, by blocks of :data:`SKY` lanes.

    Lanes of a block share all numbers but those of their lights, the last three of :func:`mirrored_pairs`: lights are
    stratified over the hemisphere.
    """
    lane = dr.arange(types.UInt32, dr.width(numbers))
    place = lane % SKY
    shared = [dr.gather(types.Float, x, dr.select(sky, lane - place, lane)) for x in numbers]
    for i, step in ((-3, 1 / SKY), (-2, GOLDEN)):
        moved = dr.select(sky, shared[i] + step * types.Float(place), shared[i])
        shared[i] = moved - dr.floor(moved)
    shared[-1] = dr.select(sky, 1, shared[-1])
    return shared


def mean_of_skies(sky, value):
    """Return values, where ``sky`` is true their means over blocks of :data:`SKY` lanes."""
    UInt32 = dr.uint32_array_t(type(value))
    means = dr.block_reduce(dr.ReduceOp.Add, value, SKY) / SKY
    return dr.select(sky, dr.gather(type(value), means, dr.arange(UInt32, dr.width(value)) // SKY), value)


class HeldOutFootprints:
    """Footprints of a ``pyramid`` with the converged truth, ``count`` of each group for at most :data:`LEVELS` levels.

    ``exposures`` are the factors by which a share :data:`WHITE` of the truth is 1 or brighter: under single, uniform
    lights, lights about the mirror direction, and skies. So errors of dark materials and in highlights count as they
    are seen. Footprints are stretched along u or v, as those at grazing angles are.
    """

    def __init__(self, pyramid: Pyramid, effects: Effects, count: int = COUNT, seed: int = SEED):
        self.pyramid, self.types, self.count = pyramid, pyramid.types, count
        self.levels = min(LEVELS, pyramid.levels)
        rng, types = np.random.default_rng(seed), self.types
        numbers_of_numpy = SimpleNamespace(
            random=lambda dtype, size: dtype(aligned_copy(rng.random(size, dtype=np.float32)))
        )
        self.footprints = []
        for level in range(self.levels):
            # Pairs of a group are neighbours; groups of uniform lights come first, those of a sky last
            numbers = rng.random((9, LIGHTS, RANGES, count), dtype=np.float32)
            numbers[3] = (numbers[3] + np.arange(RANGES)[:, None]) / RANGES
            numbers[8] *= MIRRORED
            numbers[8, ::2] += 1 - MIRRORED
            numbers = [types.Float(aligned_copy(x.ravel())) for x in numbers]
            sky = dr.arange(types.UInt32, dr.width(numbers)) >= (LIGHTS - 1) * RANGES * count
            u, v, at, stretch, a, b, *lights = under_skies(types, sky, numbers)
            stretch, *views = stretched_views(types, stretch, a, b)
            wi, wo, weight = mirrored_pairs(types, [*views, *lights])
            at = at + level
            truth = reference("jittered", pyramid, u, v, at, wi, wo, effects, numbers_of_numpy, SIDE, stretch)
            dr.eval(u, v, at, stretch, wi, wo, weight, truth)
            self.footprints.append((u, v, at, stretch, wi, wo, weight, truth))
        lit = [(w * sum(truth) / 3).numpy().reshape(LIGHTS, -1, SKY) for *_, w, truth in self.footprints]
        lit = [
            np.concatenate([x[i].mean(axis=-1) if i == LIGHTS - 1 else x[i].ravel() for x in lit])
            for i in range(LIGHTS)
        ]
        self.exposures = [float(1 / max(np.quantile(x[x > 0], 1 - WHITE), 1e-3)) if (x > 0).any() else 1.0 for x in lit]

    def errors(self, read: ShadedReader, noise: bool = False) -> list[list[np.ndarray]]:
        """Return the squared errors of exposed values up to 1, ``(levels, groups, pixels)``.

        For each of :data:`CASES`, there is an array for groups of single lights (uniform, then about the mirror
        direction), and one for those of a sky. Values are means over many places within a pixel; with ``noise``, the
        errors are those of a single render, whose samples lie at a few random places.
        """
        errors = []
        for samples in CASES:
            levels = zip(*(self._error(read, level, samples, noise) for level in range(self.levels)), strict=True)
            errors.append([np.stack(x) for x in levels])
        return errors

    def psnr(self, read: ShadedReader, noise: bool = False) -> np.ndarray:
        """Return the PSNR of levels in dB, ``(levels,)``, the mean over cases and groups (:meth:`errors`)."""
        means = [np.hstack([x.mean(axis=-1, dtype=np.float64) for x in case]) for case in self.errors(read, noise)]
        return -10 * np.log10(np.maximum(np.hstack(means), 1e-12)).mean(axis=1)

    def _error(
        self, read: ShadedReader, level: int, samples: int, noise: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the squared errors of a level, ``(groups, pixels)``, of single lights and of skies."""
        footprints, count = self.footprints[level], self.count
        if samples:
            count = min(count, SEVERAL)
            lane = dr.arange(self.types.UInt32, LIGHTS * RANGES * count)
            lane += lane // count * (self.count - count)
            footprints = [dr.gather(type(x), x, lane) for x in footprints]
        *_, weight, truth = footprints
        reads = self._reads(read, footprints, samples)
        places = dr.width(reads) // dr.width(weight)
        value = self.types.Array3f([dr.block_sum(c, places) / places for c in reads]) if samples else reads
        values, truths = (np.array(weight * x).reshape(3, LIGHTS * RANGES, count) for x in (value, truth))
        if noise and samples:
            singles = weight.numpy()[:, None] * np.array(reads).reshape(3, -1, places)
            singles = singles.reshape(3, LIGHTS * RANGES, count, places)
        exposures, result = np.repeat(self.exposures, RANGES)[:, None], []
        for group, lights in ((slice(-RANGES), 1), (slice(-RANGES, None), SKY)):
            means = (x[:, group].reshape(3, -1, count // lights, lights).mean(axis=-1) for x in (values, truths))
            a, b = (np.minimum(exposures[group] * x, 1) for x in means)
            squared = np.square(a - b)
            if noise and samples:
                single = singles[:, group].reshape(*squared.shape, lights, places).mean(axis=3)
                squared += np.minimum(exposures[group][..., None] * single, 1).var(axis=-1) / samples
            result.append(squared.mean(axis=0))
        return tuple(result)

    def _reads(self, read: ShadedReader, footprints: Sequence, samples: int) -> Any:
        """Return the values that a renderer with ``samples`` a pixel reads at places of pixels, one after the other."""
        types = self.types
        u, v, at, stretch, wi, wo, *_ = footprints
        Float, UInt32 = types.Float, types.UInt32
        with dr.suspend_grad():
            if not samples:
                value = read(u, v, at, wi, wo, share_of_bias(stretch))
                dr.eval(value)
                return value
            side = PLACES[samples]
            places = side**2
            lane = dr.arange(UInt32, dr.width(u) * places)
            pixel, place = lane // places, lane % places
            u, v, at, stretch, wi, wo = (dr.gather(type(x), x, pixel) for x in (u, v, at, stretch, wi, wo))
            inside = ((Float(n) + 0.5) / side for n in (place % side, place // side))
            u, v = places_in_footprints(self.pyramid, u, v, at, *inside, stretch)
            finer = dr.maximum(at - dr.opaque(Float, 0.5 * float(np.log2(samples))), 0)
            value = read(u, v, finer, wi, wo, share_of_bias(stretch))
            dr.eval(value)
            return value


def compared(base: list[list[np.ndarray]], errors: list[list[np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Return the gains of ``errors`` over ``base`` and their standard errors, in dB, ``(levels, cases, groups)``."""
    scale = 10 / np.log(10)

    def group(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        means = [np.maximum(e.mean(axis=-1, dtype=np.float64), 1e-12) for e in (before, after)]
        relative = before / means[0][..., None] - after / means[1][..., None]
        return scale * np.log(means[0] / means[1]), scale * relative.std(axis=-1) / np.sqrt(before.shape[-1])

    cases = [zip(*map(group, *pair), strict=True) for pair in zip(base, errors, strict=True)]
    return tuple(np.stack(x, axis=1) for x in zip(*(map(np.hstack, case) for case in cases), strict=True))


def sky_weight(base: list[list[np.ndarray]]) -> float:
    """Return the weight by which errors under skies count as much as those under single lights."""
    single, of_sky = (np.mean([errors[i].mean() for errors in base]) for i in range(2))
    return float(np.clip(single / max(of_sky, 1e-12), 1, MOST))


def relative_weights(base: list[list[np.ndarray]], shares: Sequence[float], fall: float) -> np.ndarray:
    """Return weights of errors, ``(2, levels, kinds of lights)``, read at the centre and with four samples a pixel.

    They are inverse to the errors ``base``, so that a step lowers all errors by as many decibels. The mean error of
    pairs is unchanged whose kinds of lights have the ``shares``, and whose density falls by ``fall`` from one level to
    the next.
    """
    errors = []
    for single, of_sky in (base[CASES.index(n)] for n in (0, 4)):
        means = [x.mean(axis=-1, dtype=np.float64) for x in (single, of_sky)]
        errors.append(np.hstack(means).reshape(-1, LIGHTS, RANGES).mean(axis=-1))
    errors = np.maximum(errors, 1e-7)  # 70 dB: smaller errors count no more
    density = fall ** np.arange(errors.shape[1])[:, None] * shares
    return (errors * density).sum() / (2 * density.sum()) / errors


def loss_or_gain(base: list[list[np.ndarray]], after: list[list[np.ndarray]]) -> tuple[float, float]:
    """Return the gain of errors ``after`` over ``base`` in dB, and the mean of all levels, cases and groups.

    The gain is that mean, unless the mean of a level, of a case and group, or of a level, case and range of stretches
    loses: then it is the largest such loss, negative. Up to :data:`LOSS`, or a standard error, is no loss; up to
    :data:`SINGLE`, or two standard errors, if that of a level, case and range.
    """
    gains, doubts = (x.reshape(len(x), len(CASES), LIGHTS, RANGES) for x in compared(base, after))
    losses = []
    for axes, least, errors in (((1, 2, 3), LOSS, 1), (0, LOSS, 1), (2, SINGLE, 2)):
        means = gains.mean(axis=axes)
        doubt = np.sqrt(np.mean(doubts**2, axis=axes) * means.size / gains.size)
        losses.append(float((means + np.maximum(errors * doubt, least)).min()))
    mean = float(gains.mean())
    return (mean if min(losses) >= 0 else min(losses)), mean
