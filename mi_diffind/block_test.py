"""Test of a render against a reference that is noisy, too: t-tests of blocks of all sizes, and a mean of stops.

Both sides consist of independent *passes* of equal samples, kept as means of blocks of 4 × 4 pixels. A change of a few
per cent hides in the noise of each pixel, but not in the mean of a block that is as large as the change.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import special

#: Side of the smallest blocks, in pixels.
BLOCK = 4
#: Passes of a check, and passes of a reference whose scatter is kept. Bright paths that are rare make alarms of nothing
#: where the two numbers differ much: 128 to 8 gave 6 to 81% of them.
CHECK_PASSES, REFERENCE_PASSES = 8, 16
#: Groups of as many passes as a check that a reference is rendered from; each is held against the others.
GROUPS = 16
#: Chance that an unchanged scene fails the test of blocks, and that of stops.
BLOCK_SIGNIFICANCE, STOPS_SIGNIFICANCE = 0.008, 0.002
#: Darkest brightness that counts, as part of the mean of the picture.
DARK = 0.05
#: Relative deviation that two processors may have where there is no noise.
ROUNDING = 1e-4
#: Side of the tile of :meth:`BlockReference.visible_change`, in pixels, and the chance that its change is found.
TILE, POWER = 16, 0.9

#: Value of t of blocks that are wholly black in the reference, and no longer.
_LARGEST = 1e9
_FREEDOM = CHECK_PASSES + REFERENCE_PASSES - 2
#: Standard deviation of a difference of means, in units of that of a pass.
_SCATTER = math.sqrt(1 / CHECK_PASSES + 1 / REFERENCE_PASSES)


def block_means(image: np.ndarray) -> np.ndarray:
    """Return the means of blocks of 4 × 4 pixels, ``(rows, columns, channels)``; those at the edges may be smaller."""
    height, width = image.shape[:2]
    rows, columns = np.arange(0, height, BLOCK), np.arange(0, width, BLOCK)
    sums = np.add.reduceat(np.add.reduceat(image, rows, axis=0, dtype=np.float64), columns, axis=1)
    return sums / _pixels(height, width)


def _pixels(height: int, width: int) -> np.ndarray:
    """Return the number of pixels of each block, ``(rows, columns, 1)``."""
    sides = (np.minimum(BLOCK, n - np.arange(0, n, BLOCK)) for n in (height, width))
    return np.multiply.outer(*sides)[..., None]


def _levels(blocks: np.ndarray, height: int, width: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the side of windows, in pixels, and their means ``(…, rows, columns, channels)``, up to the whole picture.

    The smallest windows are the ``blocks``. Each further level has twice the side, and its windows overlap by half: a
    change that lies across the edges of one window lies within another.
    """
    yield (side := BLOCK), blocks
    pixels = _pixels(height, width)
    sums, whole = blocks * pixels, max(pixels.shape) == 1
    while not whole:
        window_pixels = _neighbours(pixels)
        yield (side := 2 * side), _neighbours(sums) / window_pixels
        whole = max(window_pixels.shape) == 1
        for axis in (-3, -2):
            sums, pixels = (np.add.reduceat(a, np.arange(0, a.shape[axis], 2), axis=axis) for a in (sums, pixels))


def _neighbours(values: np.ndarray) -> np.ndarray:
    """Return the sums of 2 × 2 neighbours, or along one axis if the other has length 1."""
    if values.shape[-3] > 1:
        values = values[..., :-1, :, :] + values[..., 1:, :, :]
    if values.shape[-2] > 1:
        values = values[..., :, :-1, :] + values[..., :, 1:, :]
    return values


def mean_stops(image: np.ndarray, other: np.ndarray, dark: float) -> float:
    """Return the mean difference of two images in stops (factors of 2), with ``dark`` added to both.

    Reconstruction filters such as Mitchell's have negative values, which count as black. Nothing is compared with a
    picture that is wholly black, of which ``dark`` is 0.
    """
    if dark <= 0:
        return 0.0
    bright = (np.log2(np.maximum(v, 0) + dark) for v in (image, other))
    return float(np.abs(np.subtract(*bright)).mean())


@dataclass(frozen=True)
class Level:
    """Windows of one size: the ``side`` and the ``stride`` in pixels, and the values of the t-tests.

    ``t`` and the relative ``change`` are ``(rows, columns, channels)``; values of t beyond ``threshold`` fail.
    """

    side: int
    stride: int
    t: np.ndarray
    change: np.ndarray
    threshold: float

    @property
    def failing(self) -> np.ndarray:
        """Windows that fail in a channel, booleans ``(rows, columns)``."""
        return (np.abs(self.t) > self.threshold).any(axis=-1)


@dataclass(frozen=True)
class Block:
    """Window of a picture, in pixels, and the t-test of one of its channels.

    ``x, y``: the upper left corner; ``side``: that of the windows of its level, which the edges of the picture crop;
    ``channel``: ``red``, ``green``, ``blue`` or ``brightness``; ``change``: relative to the reference, ``None`` where
    that is black.
    """

    x: int
    y: int
    width: int
    height: int
    side: int
    channel: str
    change: float | None
    t: float
    threshold: float


@dataclass(frozen=True)
class BlockTest:
    """Result of :meth:`BlockReference.test`.

    ``worst`` is the window whose t exceeds its threshold most; ``stops`` the mean difference in stops, which fails
    beyond ``stops_threshold``; ``not_finite`` the number of pixels that are not finite, which fail.
    """

    levels: list[Level]
    worst: Block
    stops: float
    stops_threshold: float
    not_finite: int

    @property
    def worst_level(self) -> Level:
        """The level of the worst window."""
        return next(level for level in self.levels if level.side == self.worst.side)

    @property
    def failing_blocks(self) -> int:
        """Number of windows that fail, of all sizes."""
        return sum(int(level.failing.sum()) for level in self.levels)

    @property
    def passed(self) -> bool:
        """Whether nothing fails."""
        return not (self.failing_blocks or self.stops > self.stops_threshold or self.not_finite)


@dataclass(frozen=True)
class BlockReference:
    """A reference as the test needs it.

    ``passes``, ``(16, rows, columns, channels)``: block means of single passes; ``mean``, ``(rows, columns,
    channels)``: of all 128 passes; ``stops``, ``(16,)``: mean difference in stops of each group of 8 passes from the
    mean of all others; ``height`` and ``width`` in pixels.
    """

    passes: np.ndarray
    mean: np.ndarray
    stops: np.ndarray
    height: int
    width: int

    @classmethod
    def from_groups(cls, passes: np.ndarray, groups: np.ndarray, height: int, width: int) -> BlockReference:
        """Return the reference of 16 single ``passes`` and of the means of 16 ``groups`` of passes."""
        mean = groups.mean(axis=0)
        dark = DARK * _mean_brightness(mean, height, width)
        others = (len(groups) * mean - groups) / (len(groups) - 1)
        stops = np.array([mean_stops(*pair, dark) for pair in zip(groups, others, strict=True)])
        return cls(passes, mean, stops, height, width)

    @property
    def dark(self) -> float:
        """Darkest brightness that counts, linear."""
        return DARK * _mean_brightness(self.mean, self.height, self.width)

    @np.errstate(divide="ignore", invalid="ignore")
    def test(self, check: np.ndarray, not_finite: int = 0) -> BlockTest:
        """Test whether a check, block means ``(8, rows, columns, channels)``, shows the scene of the reference.

        *Blocks.* With R passes of the reference, C of the check, and SS the sum of squared deviations from the mean,

            t = (mean_C − mean_R) / √(max(s², floor) (1/R + 1/C)),    s² = (SS_R + SS_C) / (R + C − 2),

        for windows of 4 × 4, 8 × 8, … pixels up to the whole picture, each channel on its own. The variance is that of
        both sides: a rare bright path of the check raises it, too. The floor, of the square of 1e-4 of the brightness,
        lets processors round differently. Each level has an equal part of the significance of 0.8%, and each value of a
        level the part 1 − (1 − α)^(1/values) of it, by Student's t distribution of R + C − 2 degrees of freedom.

        *Stops.* The mean over blocks of |log₂((C + e) / (R + e))|, e = 5% of the mean brightness, is compared with
        those of the groups of the reference by a t-test with a significance of 0.2%: it finds changes that are spread
        over the picture and cancel out. Values that are not finite take part in no test.
        """
        levels, worst, largest = [], None, -1.0
        both = np.concatenate([self.passes, check])
        windows = list(_levels(both, self.height, self.width))
        for side, means in windows:
            reference, check_means = means[:REFERENCE_PASSES], means[REFERENCE_PASSES:]
            mean = reference.mean(axis=0)
            difference = check_means.mean(axis=0) - mean
            squares = ((reference - mean) ** 2).sum(axis=0) + ((check_means - difference - mean) ** 2).sum(axis=0)
            t = difference / self._deviation(squares / _FREEDOM, mean)
            t = np.nan_to_num(t, nan=0.0, posinf=_LARGEST, neginf=-_LARGEST)
            stride, change = side if side == BLOCK else side // 2, difference / np.abs(mean)
            level = Level(side, stride, t, change, _threshold(t.size, len(windows)))
            levels.append(level)
            i = np.unravel_index(np.abs(t).argmax(), t.shape)
            if abs(t[i]) / level.threshold > largest:
                largest, worst = abs(t[i]) / level.threshold, self._block(level, *(int(n) for n in i))
        # the same groups in a t-test of one more value; two processors differ by their rounding at most
        scatter = max(float(self.stops.std(ddof=1)), ROUNDING) * math.sqrt(1 + 1 / len(self.stops))
        quantile = -special.stdtrit(len(self.stops) - 1, STOPS_SIGNIFICANCE)
        mean = check.mean(axis=0)
        stops = mean_stops(np.where(np.isfinite(mean), mean, self.mean), self.mean, self.dark)
        return BlockTest(levels, worst, stops, float(self.stops.mean() + quantile * scatter), not_finite)

    def _deviation(self, variance: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Return the standard deviation of the difference of check and reference, of the variance of a pass."""
        return np.sqrt(np.maximum(variance, (ROUNDING * (np.abs(mean) + self.dark)) ** 2)) * _SCATTER

    def _block(self, level: Level, row: int, column: int, channel: int) -> Block:
        x, y = column * level.stride, row * level.stride
        size = min(level.side, self.width - x), min(level.side, self.height - y)
        i = row, column, channel
        name = ("red", "green", "blue")[channel] if level.t.shape[2] == 3 else "brightness"
        change = float(level.change[i]) if np.isfinite(level.change[i]) else None
        return Block(x, y, *size, level.side, name, change, float(level.t[i]), level.threshold)

    def visible_change(self) -> float:
        """Return the relative change of brightness of a tile that :meth:`test` finds nine times of ten.

        The tile, of 16 × 16 pixels or the whole of a smaller picture, lies anywhere in the picture but where the
        reference is dark: the chance is the mean over its places. It is that of the window that covers most of the tile
        and of its channel with the least noise, by a normal approximation of the noncentral t distribution. Returns
        infinity where not even a tile of a hundred times the brightness is found so often.
        """
        windows = list(_levels(self.passes, self.height, self.width))
        level = min(TILE // BLOCK // 2, len(windows) - 1)
        means = windows[level][1]
        mean = means.mean(axis=0)
        t = _threshold(mean.size, len(windows))
        signal = np.abs(mean) / np.maximum(self._deviation(means.var(axis=0, ddof=1), mean), 1e-30)
        signal = signal.max(axis=-1)[mean.max(axis=-1) >= self.dark]
        for windows_of_axis in mean.shape[:2]:  # the nearest of overlapping windows is at most a quarter away
            overlap = 1 - (np.arange(8) + 0.5) / 32 if windows_of_axis > 1 else np.ones(1)
            signal = np.multiply.outer(signal, overlap)
        quantile, deviation = t * (1 - 1 / (4 * _FREEDOM)), math.sqrt(1 + t**2 / (2 * _FREEDOM))
        low, high = 1e-6, 100.0
        while high / low > 1.001:
            middle = math.sqrt(low * high)
            if signal.size and special.ndtr((middle * signal - quantile) / deviation).mean() >= POWER:
                high = middle
            else:
                low = middle
        return high if high < 100 else math.inf


def _threshold(values: int, levels: int) -> float:
    """Return the value of t beyond which one of so many ``values`` of a level fails."""
    chance = -math.expm1(math.log1p(-BLOCK_SIGNIFICANCE / levels) / values)
    return float(-special.stdtrit(_FREEDOM, chance / 2))


def _mean_brightness(blocks: np.ndarray, height: int, width: int) -> float:
    return float((blocks * _pixels(height, width)).sum() / (height * width * blocks.shape[-1]))
