"""Check of a scene that was changed: small pictures before and after, whose difference is held against their noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import compat, scenes

#: Longest side of the pictures in pixels, independent passes of each scene, and samples a pixel in a pass.
SIDE, PASSES, SAMPLES = 128, 16, 4

#: Side of the smallest tiles in pixels. Each next size is four times larger, up to the whole picture.
TILE = 8

#: Share of checks of equal scenes in which a tile of any size seems to differ.
FALSE_ALARMS = 0.01

#: Relative difference of a tile that does not count: 8 bits do not show it.
LEAST = 1e-3

#: Brightness of a tile, relative to the picture's, below which its difference is relative to this.
DARK = 0.1


@dataclass(frozen=True)
class PictureCheck:
    """Difference of two pictures in tiles of all sizes, relative to the brightness of the tile before.

    ``differs``: a tile differs by more than noise explains; ``difference``: root mean square over the smallest tiles,
    without noise; ``noise``: their standard error; ``seen``: differences that nine of ten checks see, in the smallest
    tiles (half of them) and of the whole picture; ``worst``: ``x, y, width, height`` in pixels of the tile that differs
    most beyond noise, and ``worst_change`` by how much (−0.5: half as bright); ``width``, ``height``, ``spp`` of the
    pictures; ``not_finite``: pixels that are not finite, before and after.
    """

    differs: bool
    difference: float
    noise: float
    seen: tuple[float, float]
    worst: tuple[int, int, int, int]
    worst_change: float
    width: int
    height: int
    spp: int
    not_finite: tuple[int, int]

    def __str__(self) -> str:
        picture = f"{self.width} x {self.height} pixels, {self.spp} spp"
        if self.not_finite[0] != self.not_finite[1]:
            before, after = self.not_finite
            return f"differs: values are not finite in {after} pixels, were not in {before} before ({picture})"
        if not self.differs:
            return (
                f"equal within noise ({picture}), which would have shown a difference of {self.seen[0]:.1%} "
                f"in a tile of {TILE} x {TILE}, of {self.seen[1]:.1%} in the whole"
            )
        x, y, width, height = self.worst
        brighter = "brighter" if self.worst_change > 0 else "darker"
        return (
            f"differs by {self.difference:.1%} in a tile of {TILE} x {TILE} beside {self.noise:.1%} of noise "
            f"({picture}); most in the {width} x {height} pixels at ({x}, {y}): {abs(self.worst_change):.1%} {brighter}"
        )


def check_picture(before, after) -> PictureCheck:
    """Render two loaded scenes by the first sensor, small and with independent random numbers, and compare them."""
    return compare_passes(_passes(before, 0), _passes(after, PASSES))


def compare_passes(old: np.ndarray, new: np.ndarray) -> PictureCheck:
    """Compare independent passes of two pictures, ``(PASSES, height, width)`` each.

    The means of tiles over the passes of each side are compared by Welch's t-test, with Bonferroni's correction for the
    number of tiles: passes are independent, which neighbouring pixels of one pass are not.
    """
    from scipy.stats import t as student

    bad = [~np.isfinite(side).all(axis=0) for side in (old, new)]
    old, new = (np.where(bad[0] | bad[1], 0, side) for side in (old, new))
    height, width = bad[0].shape
    darkest, freedom, sizes = max(DARK * old.mean(), 1e-30), 2 * PASSES - 2, [TILE]
    while sizes[-1] < max(width, height):
        sizes.append(4 * sizes[-1])
    tests = [(size, *_changes(_tiles(old, size), _tiles(new, size), darkest)) for size in sizes]
    limit = student.isf(FALSE_ALARMS / 2 / sum(change.size for _, change, _ in tests), freedom)
    margins = [(np.abs(change) - np.maximum(limit * error, LEAST), size, change) for size, change, error in tests]
    margin, size, change = max(margins, key=lambda one: one[0].max())
    row, column = np.unravel_index(int(margin.argmax()), margin.shape)
    x, y = int(column) * size, int(row) * size
    (_, first, error), (_, _, whole) = tests[0], tests[-1]
    return PictureCheck(
        differs=bool(margin.max() > 0),
        difference=float(np.sqrt(max(0.0, np.mean(first**2 - error**2)))),
        noise=float(np.sqrt(np.mean(error**2))),
        seen=tuple(max(LEAST, float(np.median(e) * (limit + student.isf(0.1, freedom)))) for e in (error, whole)),
        worst=(x, y, min(size, width - x), min(size, height - y)),
        worst_change=float(change[row, column]),
        width=width,
        height=height,
        spp=PASSES * SAMPLES,
        not_finite=(int(bad[0].sum()), int(bad[1].sum())),
    )


def _changes(old: np.ndarray, new: np.ndarray, darkest: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the relative change of each tile and its standard error, from tiles ``(passes, rows, columns)``."""
    brightness = np.maximum(old.mean(axis=0), darkest)
    variance = (old.var(axis=0, ddof=1) + new.var(axis=0, ddof=1)) / PASSES
    return (new.mean(axis=0) - old.mean(axis=0)) / brightness, np.sqrt(variance) / brightness


def _passes(scene, first: int) -> np.ndarray:
    """Return the brightness of each pass, ``(passes, height, width)``; ``first`` is the seed of the first one."""
    width, height = scenes.film_size(scene)
    shrink = min(1.0, SIDE / max(width, height))
    size = (max(1, round(shrink * n)) for n in (width, height))
    with compat.film_size(scene.sensors()[0], *size):
        images = [scenes.render_pass(scene, SAMPLES, first + i) for i in range(PASSES)]
    return np.stack([scenes.colour_channels(image).mean(axis=-1) for image in images])


def _tiles(images: np.ndarray, size: int) -> np.ndarray:
    """Return the means of square tiles of images ``(n, height, width)``; those at the edges may be smaller."""
    rows, columns = (np.arange(0, n, size) for n in images.shape[1:])
    sums = np.add.reduceat(np.add.reduceat(images, rows, axis=1), columns, axis=2)
    texels = np.add.reduceat(np.add.reduceat(np.ones(images.shape[1:]), rows, axis=0), columns, axis=1)
    return sums / texels
