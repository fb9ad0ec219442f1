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
#: Places of the tile that are tried in each unchanged check.
TILES = 24

#: Value of t of blocks that are wholly black in the reference, and no longer.
_LARGEST = 1e9
#: Degrees of freedom of t.
_FREEDOM = CHECK_PASSES + REFERENCE_PASSES - 2


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
        for side, mean, difference, deviation, threshold in self._differences(check):
            t = np.nan_to_num(difference / deviation, nan=0.0, posinf=_LARGEST, neginf=-_LARGEST)
            level = Level(side, side if side == BLOCK else side // 2, t, difference / np.abs(mean), threshold)
            levels.append(level)
            i = np.unravel_index(np.abs(t).argmax(), t.shape)
            if abs(t[i]) / threshold > largest:
                largest, worst = abs(t[i]) / threshold, self._block(level, *(int(n) for n in i))
        # the same groups in a t-test of one more value; two processors differ by their rounding at most
        scatter = max(float(self.stops.std(ddof=1)), ROUNDING) * math.sqrt(1 + 1 / len(self.stops))
        quantile = -special.stdtrit(len(self.stops) - 1, STOPS_SIGNIFICANCE)
        mean = check.mean(axis=0)
        stops = mean_stops(np.where(np.isfinite(mean), mean, self.mean), self.mean, self.dark)
        return BlockTest(levels, worst, stops, float(self.stops.mean() + quantile * scatter), not_finite)

    def _differences(self, check: np.ndarray) -> Iterator[tuple[int, np.ndarray, np.ndarray, np.ndarray, float]]:
        """Yield the side of the windows, the reference, the difference, its deviation, and the threshold of t."""
        windows = list(_levels(np.concatenate([self.passes, check]), self.height, self.width))
        for side, means in windows:
            reference, others = means[:REFERENCE_PASSES], means[REFERENCE_PASSES:]
            mean, mean_of_check = reference.mean(axis=0), others.mean(axis=0)
            squares = ((reference - mean) ** 2).sum(axis=0) + ((others - mean_of_check) ** 2).sum(axis=0)
            floor = (ROUNDING * (np.abs(mean) + self.dark)) ** 2
            deviation = np.sqrt(np.maximum(squares / _FREEDOM, floor) * (1 / CHECK_PASSES + 1 / REFERENCE_PASSES))
            chance = -math.expm1(math.log1p(-BLOCK_SIGNIFICANCE / len(windows)) / mean.size)
            yield side, mean, mean_of_check - mean, deviation, float(-special.stdtrit(_FREEDOM, chance / 2))

    def _block(self, level: Level, row: int, column: int, channel: int) -> Block:
        x, y = column * level.stride, row * level.stride
        size = min(level.side, self.width - x), min(level.side, self.height - y)
        i = row, column, channel
        name = ("red", "green", "blue")[channel] if level.t.shape[2] == 3 else "brightness"
        change = float(level.change[i]) if np.isfinite(level.change[i]) else None
        return Block(x, y, *size, level.side, name, change, float(level.t[i]), level.threshold)

    def visible_change(self, checks: np.ndarray) -> float:
        """Return the relative change of brightness of a tile that :meth:`test` finds nine times of ten.

        The tile, of 16 × 16 pixels or as many as there are, lies at a random place that is not dark. ``checks``,
        ``(count, 8, rows, columns, channels)``, are unchanged. In each of them, a tile that is brighter adds the light
        of its part in a window to the difference of that window: so the smallest change is known that raises one t
        beyond its threshold. Returns infinity if too many tiles have none.
        """
        rng, smallest = np.random.default_rng(0), []
        places = np.maximum(np.array([self.height, self.width]) - TILE, 0) + 1
        for check in checks:
            noise = [(difference, deviation * t) for _, _, difference, deviation, t in self._differences(check)]
            for y, x in rng.integers(places, size=(TILES, 2)):
                tile = np.zeros((self.height, self.width, 1))
                tile[y : y + TILE, x : x + TILE] = 1
                part = block_means(tile)
                light = part * np.maximum(self.mean, 0)
                if light.mean() < part.mean() * self.dark:
                    continue
                levels = zip(_levels(light, self.height, self.width), noise, strict=True)
                smallest.append(min(((t - d)[v > 0] / v[v > 0]).min(initial=math.inf) for (_, v), (d, t) in levels))
        return float(np.quantile(smallest, POWER, method="higher")) if smallest else math.inf


def _mean_brightness(blocks: np.ndarray, height: int, width: int) -> float:
    return float((np.abs(blocks) * _pixels(height, width)).sum() / (height * width * blocks.shape[-1]))
