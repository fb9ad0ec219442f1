"""Test of a render against another that is noisy, too: t-tests of blocks of all sizes, and a mean of stops.

Both sides consist of independent *passes* of equal samples, kept as means of blocks of 4 × 4 pixels. A change of a few
per cent hides in the noise of each pixel, but not in the mean of a block that is as large as the change.
:func:`check_picture` holds small pictures of a scene before and after a change against each other.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from ..core import compat
from . import loading

#: Side of the smallest blocks, in pixels.
BLOCK = 4

#: Passes of a check.
CHECK_PASSES = 8

#: Passes of a reference whose scatter is kept. Bright paths that are rare make alarms of nothing where this and the
#: passes of a check differ much: 128 to 8 gave 6 to 81% of them.
REFERENCE_PASSES = 16

#: Groups of as many passes as a check that a reference is rendered from; each is held against the others.
GROUPS = 16

#: Chance that an unchanged scene fails the test of blocks.
BLOCK_SIGNIFICANCE = 0.008

#: Chance that an unchanged scene fails the test of stops.
STOPS_SIGNIFICANCE = 0.002

#: Darkest brightness that counts, as part of the mean of the picture.
DARK = 0.05

#: Relative deviation that two processors may have where there is no noise.
ROUNDING = 1e-4

#: Side of the tile of :meth:`BlockReference.visible_change`, in pixels.
TILE = 16

#: Chance that the change of :meth:`BlockReference.visible_change` is found.
POWER = 0.9

#: Places of the tile that are tried in each unchanged check.
TILES = 24

#: Longest side of the pictures of :func:`check_picture`, in pixels.
PICTURE_SIDE = 128

#: Independent passes of each picture of :func:`check_picture`.
PICTURE_PASSES = 16

#: Samples a pixel in a pass of :func:`check_picture`.
PICTURE_SAMPLES = 4

#: Relative difference of a block of :func:`check_picture` that does not count: 8 bits do not show it.
LEAST = 1e-3

#: Exchanges of passes between the pictures, from which the power is known: those of equal scenes may be exchanged.
EXCHANGES = 32

#: Value of t of blocks that are wholly black in the reference, and no longer.
_LARGEST = 1e9


def block_means(image: np.ndarray) -> np.ndarray:
    """Return the means of blocks of 4 × 4 pixels, ``(…, rows, columns, channels)``; at the edges, of fewer."""
    height, width = image.shape[-3:-1]
    rows, columns = np.arange(0, height, BLOCK), np.arange(0, width, BLOCK)
    sums = np.add.reduceat(np.add.reduceat(image, rows, axis=-3, dtype=np.float64), columns, axis=-2)
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
    """Windows of one size: the ``side`` and the ``stride`` in pixels, and their t-tests.

    ``mean`` (of the reference), the ``difference`` from it, the standard ``deviation`` of that, and ``t`` are ``(rows,
    columns, channels)``; values of t beyond ``threshold`` fail, and are 0 where something is not finite.
    """

    side: int
    stride: int
    mean: np.ndarray
    difference: np.ndarray
    deviation: np.ndarray
    t: np.ndarray
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

    def __str__(self) -> str:
        place = f"{self.width} x {self.height} pixels at ({self.x}, {self.y})"
        if self.change is None:
            return f"{place}: no longer black"
        return f"{place}: {float(f'{100 * abs(self.change):.2g}'):g}% {'darker' if self.t < 0 else 'brighter'}"


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
    """A reference as the test needs it; that of a regression check has 16 groups of 8 passes.

    ``passes``, ``(count, rows, columns, channels)``: block means of single passes; ``mean``, ``(rows, columns,
    channels)``: of all passes; ``stops``, ``(groups,)``: mean difference in stops of each group of passes from the mean
    of all others; ``height`` and ``width`` in pixels; ``least``: relative difference that does not count.
    """

    passes: np.ndarray
    mean: np.ndarray
    stops: np.ndarray
    height: int
    width: int
    least: float = 0.0

    @classmethod
    def from_groups(cls, passes: np.ndarray, groups: np.ndarray, height: int, width: int) -> BlockReference:
        """Return the reference of single ``passes`` and of the means of ``groups`` of passes."""
        mean = groups.mean(axis=0)
        reference = cls(passes, mean, np.empty(0), height, width)
        others = (len(groups) * mean - groups) / (len(groups) - 1)
        stops = [mean_stops(*pair, reference.dark) for pair in zip(groups, others, strict=True)]
        return replace(reference, stops=np.array(stops))

    @property
    def dark(self) -> float:
        """Darkest brightness that counts, linear."""
        total = (np.abs(self.mean) * _pixels(self.height, self.width)).sum()
        return DARK * float(total / (self.height * self.width * self.mean.shape[-1]))

    def test(self, check: np.ndarray, not_finite: int = 0) -> BlockTest:
        """Test whether a check, block means ``(8, rows, columns, channels)``, shows the scene of the reference.

        *Blocks*: :meth:`compare`. *Stops*: the mean over blocks of |log₂((C + e) / (R + e))|, e = 5% of the mean
        brightness, is compared with those of the groups of the reference by a t-test with a significance of 0.2%: it
        finds changes that are spread over the picture and cancel out. Values that are not finite take part in no test.
        """
        levels = self.compare(check)
        # the same groups in a t-test of one more value; two processors differ by their rounding at most
        scatter = max(float(self.stops.std(ddof=1)), ROUNDING) * math.sqrt(1 + 1 / len(self.stops))
        quantile = -special.stdtrit(len(self.stops) - 1, STOPS_SIGNIFICANCE)
        mean = check.mean(axis=0)
        stops = mean_stops(np.where(np.isfinite(mean), mean, self.mean), self.mean, self.dark)
        threshold = float(self.stops.mean() + quantile * scatter)
        return BlockTest(levels, self.worst_block(levels), stops, threshold, not_finite)

    @np.errstate(divide="ignore", invalid="ignore")
    def compare(self, check: np.ndarray) -> list[Level]:
        """Return the t-tests of a check, block means ``(count, rows, columns, channels)``.

        With R passes of the reference, C of the check, and SS the sum of squared deviations from the mean,

            t = (mean_C − mean_R) / √(max(s², floor) (1/R + 1/C)),    s² = (SS_R + SS_C) / (R + C − 2),

        for windows of 4 × 4, 8 × 8, … pixels up to the whole picture, each channel on its own. The variance is that of
        both sides: a rare bright path of the check raises it, too. The floor, of the square of 1e-4 of the brightness,
        lets processors round differently. Each level has an equal part of the significance of 0.8%, and each value of a
        level the part 1 − (1 − α)^(1/values) of it, by Student's t distribution of R + C − 2 degrees of freedom.
        """
        count, freedom = len(self.passes), len(self.passes) + len(check) - 2
        windows, levels = list(_levels(np.concatenate([self.passes, check]), self.height, self.width)), []
        for side, passes in windows:
            mean, mean_of_check = passes[:count].mean(axis=0), passes[count:].mean(axis=0)
            difference, brightness = mean_of_check - mean, np.abs(mean) + self.dark
            squares = ((passes[:count] - mean) ** 2).sum(axis=0) + ((passes[count:] - mean_of_check) ** 2).sum(axis=0)
            chance = -math.expm1(math.log1p(-BLOCK_SIGNIFICANCE / len(windows)) / mean.size)
            threshold = float(-special.stdtrit(freedom, chance / 2))
            variance = np.maximum(squares / freedom, (ROUNDING * brightness) ** 2) * (1 / len(check) + 1 / count)
            deviation = np.maximum(np.sqrt(variance), self.least * brightness / threshold)
            t = np.nan_to_num(difference / deviation, nan=0.0, posinf=_LARGEST, neginf=-_LARGEST)
            levels.append(Level(side, max(BLOCK, side // 2), mean, difference, deviation, t, threshold))
        return levels

    @np.errstate(divide="ignore", invalid="ignore")
    def worst_block(self, levels: list[Level]) -> Block:
        """Return the window of :meth:`compare` whose t exceeds its threshold most."""
        level = max(levels, key=lambda level: np.abs(level.t).max() / level.threshold)
        i = row, column, channel = np.unravel_index(np.abs(level.t).argmax(), level.t.shape)
        x, y = int(column) * level.stride, int(row) * level.stride
        height, width = min(level.side, self.height - y), min(level.side, self.width - x)
        name = ("red", "green", "blue")[channel] if level.t.shape[2] == 3 else "brightness"
        change = float(level.difference[i] / np.abs(level.mean[i]))
        change = change if math.isfinite(change) else None
        return Block(x, y, width, height, level.side, name, change, float(level.t[i]), level.threshold)

    def visible_change(self, checks: np.ndarray, side: int = TILE) -> float:
        """Return the relative change of brightness of a tile that :meth:`compare` finds nine times of ten.

        The tile, of ``side`` pixels or as many as there are, lies at a random place that is not dark. ``checks``,
        ``(count, passes, rows, columns, channels)``, are unchanged. In each of them, a tile that is brighter adds the
        light of its part in a window to the difference of that window: so the smallest change is known that raises one
        t beyond its threshold. Returns infinity if too many tiles have none.
        """
        rng, smallest = np.random.default_rng(0), []
        size = self.height, self.width
        places = np.maximum(np.array(size) - side, 0) + 1
        for check in checks:
            tiles = np.zeros((TILES, *size, 1), bool)
            for tile, (y, x) in zip(tiles, rng.integers(places, size=(TILES, 2)), strict=True):
                tile[y : y + side, x : x + side] = True
            parts = block_means(tiles)
            light = parts * np.maximum(self.mean, 0)
            light = light[light.mean(axis=(1, 2, 3)) >= self.dark * parts.mean(axis=(1, 2, 3))]
            change = np.full(len(light), math.inf)
            for (_, gain), level in zip(_levels(light, *size), self.compare(check), strict=True):
                missing = level.threshold * level.deviation - level.difference
                needed = np.divide(missing, gain, out=np.full_like(gain, math.inf), where=gain > 0)
                change = np.minimum(change, needed.min(axis=(1, 2, 3)))
            smallest.extend(change)
        return float(np.quantile(smallest, POWER, method="higher")) if smallest else math.inf


# -- pictures before and after ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PictureCheck:
    """Difference of two pictures in blocks of all sizes, of brightness relative to that before.

    ``differs``: the ``worst`` block differs by more than noise explains; ``difference``: root mean square over blocks
    of 4 × 4, without noise; ``noise``: their standard error; ``seen``: changes that nine of ten checks see, of a tile
    of 16 × 16 and of the whole picture, ``None`` if too dark; ``width``, ``height``, ``spp`` of the pictures;
    ``not_finite``: pixels that are not finite, before and after; ``seconds``: median time of a pass of each.
    """

    differs: bool
    difference: float
    noise: float
    seen: list[float] | None
    worst: Block
    width: int
    height: int
    spp: int
    not_finite: tuple[int, int]
    seconds: tuple[float, float] | None = None

    def __str__(self) -> str:
        picture = f"{self.width} x {self.height} pixels, {self.spp} spp"
        if self.not_finite[0] != self.not_finite[1]:
            before, after = self.not_finite
            return f"differs: values are not finite in {after} pixels, were not in {before} before ({picture})"
        if self.differs:
            return (
                f"differs by {self.difference:.1%} in a block of {BLOCK} x {BLOCK} beside {self.noise:.1%} of noise "
                f"({picture}); most in the {self.worst}"
            )
        if self.seen is None:
            return f"equal within noise ({picture}), too dark to say which difference would have shown"
        return (
            f"equal within noise ({picture}), which would have shown a difference of {self.seen[0]:.1%} in a tile of "
            f"{min(TILE, self.width)} x {min(TILE, self.height)}, of {self.seen[1]:.1%} in the whole"
        )


def check_picture(before, after) -> PictureCheck:
    """Render two loaded scenes by the first sensor, small and with independent random numbers, and compare them.

    Their passes take turns, so that a slow phase of the machine slows both.
    """
    passes, seconds = ([], []), ([], [])
    for index in range(PICTURE_PASSES):
        for side, scene in enumerate((before, after)):
            start = time.perf_counter()
            passes[side].append(_small_pass(scene, side * PICTURE_PASSES + index))
            seconds[side].append(time.perf_counter() - start)
    medians = tuple(float(np.median(times[1:])) for times in seconds)  # the first pass compiles
    return replace(compare_passes(*map(np.stack, passes)), seconds=medians)


def compare_passes(old: np.ndarray, new: np.ndarray) -> PictureCheck:
    """Compare independent passes of the brightness of two pictures, ``(PICTURE_PASSES, height, width)`` each."""
    bad = [~np.isfinite(side).all(axis=0) for side in (old, new)]
    height, width = bad[0].shape
    old, new = (block_means(np.where(bad[0] | bad[1], 0, side)[..., None]) for side in (old, new))
    passes, rng = np.concatenate([old, new]), np.random.default_rng(0)
    reference = replace(BlockReference.from_groups(old, passes, height, width), least=LEAST)
    levels = reference.compare(new)
    worst, brightness = reference.worst_block(levels), np.maximum(np.abs(levels[0].mean) + reference.dark, 1e-30)
    change, error = levels[0].difference / brightness, levels[0].deviation / brightness
    exchanges = (np.split(rng.permutation(passes), 2) for _ in range(EXCHANGES))
    pairs = [(replace(reference, passes=one), other[None]) for one, other in exchanges]
    changes = [[one.visible_change(other, side) for side in (TILE, max(height, width))] for one, other in pairs]
    seen = np.quantile(changes, POWER, axis=0, method="higher").tolist()
    return PictureCheck(
        differs=abs(worst.t) > worst.threshold,
        difference=float(np.sqrt(max(0.0, np.mean(change**2 - error**2)))),
        noise=float(np.sqrt(np.mean(error**2))),
        seen=seen if math.isfinite(max(seen)) else None,
        worst=worst,
        width=width,
        height=height,
        spp=PICTURE_PASSES * PICTURE_SAMPLES,
        not_finite=(int(bad[0].sum()), int(bad[1].sum())),
    )


def _small_pass(scene, seed: int) -> np.ndarray:
    """Return the brightness of a pass, ``(height, width)``."""
    width, height = loading.film_size(scene)
    shrink = min(1.0, PICTURE_SIDE / max(width, height))
    size = (max(1, round(shrink * n)) for n in (width, height))
    with compat.film_size(scene.sensors()[0], *size):
        return loading.colour_channels(loading.render_pass(scene, PICTURE_SAMPLES, seed)).mean(axis=-1)
