"""Check of a scene that was changed: small pictures before and after, whose difference is held against their noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import compat, scenes

#: Longest side of the pictures in pixels, side of a tile, independent passes of each scene, samples a pixel in a pass.
SIDE, TILE, PASSES, SAMPLES = 128, 8, 8, 4

#: Share of checks of equal scenes in which a tile seems to differ.
FALSE_ALARMS = 0.01

#: Share of the picture's mean brightness below which a tile counts as dark: its difference is relative to that.
DARK = 0.1


@dataclass(frozen=True)
class PictureCheck:
    """Difference of two pictures in tiles, all relative to the brightness of the tile before.

    ``differs``: a tile differs by more than noise explains; ``difference``: root mean square over the tiles without
    noise; ``noise``: its standard error; ``seen``: the difference that nine of ten checks would see in half of the
    tiles; ``worst``: ``x, y, width, height`` in pixels of the tile that differs most beyond noise, by ``worst_change``
    (−0.5: half as bright); ``width``, ``height``, ``spp`` of the pictures; ``not_finite``: pixels that are not finite,
    before and after.
    """

    differs: bool
    difference: float
    noise: float
    seen: float
    worst: tuple[int, int, int, int]
    worst_change: float
    width: int
    height: int
    spp: int
    not_finite: tuple[int, int]

    def __str__(self) -> str:
        picture = f"{self.width} x {self.height} pixels, {self.spp} spp"
        if self.not_finite[0] != self.not_finite[1]:
            return f"differs: {self.not_finite[1]} pixels are not finite, {self.not_finite[0]} were before ({picture})"
        if not self.differs:
            return (
                f"equal within noise ({picture}): tiles vary by {self.noise:.2g} of their brightness, "
                f"a difference of {self.seen:.2g} would have been seen in half of them"
            )
        x, y, width, height = self.worst
        brighter = "brighter" if self.worst_change > 0 else "darker"
        return (
            f"differs by {self.difference:.2g} of the brightness of a tile, noise is {self.noise:.2g} ({picture}); "
            f"most in the {width} x {height} pixels at ({x}, {y}): {abs(self.worst_change):.0%} {brighter}"
        )


def check_picture(before, after) -> PictureCheck:
    """Render two loaded scenes by the first sensor, small and with independent random numbers, and compare them.

    The means of a tile over the passes of each side are compared by Welch's t-test with Bonferroni's correction for the
    number of tiles; passes are independent, which neighbouring pixels of one pass are not.
    """
    from scipy.stats import t as student

    old, new = (_passes(scene, first) for scene, first in ((before, 0), (after, PASSES)))
    bad = [~np.isfinite(side).all(axis=0) for side in (old, new)]
    width, height = old.shape[2], old.shape[1]
    a, b = (_tiles(np.where(bad[0] | bad[1], 0, side)) for side in (old, new))
    brightness = a.mean(axis=0)
    brightness = np.maximum(brightness, max(DARK * brightness.mean(), 1e-30))
    change = (b.mean(axis=0) - a.mean(axis=0)) / brightness
    variance = (a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / PASSES / brightness**2
    error = np.sqrt(variance + 1e-14)  # rounding alone
    limit = student.isf(FALSE_ALARMS / 2 / change.size, 2 * PASSES - 2)
    row, column = np.unravel_index(int(np.argmax(np.abs(change) - limit * error)), change.shape)
    place = (column * TILE, row * TILE)
    return PictureCheck(
        differs=bool((np.abs(change) > limit * error).any()),
        difference=float(np.sqrt(max(0.0, np.mean(change**2 - variance)))),
        noise=float(np.sqrt(variance.mean())),
        seen=float(np.median(error) * (limit + student.isf(0.1, 2 * PASSES - 2))),
        worst=(*map(int, place), min(TILE, width - int(place[0])), min(TILE, height - int(place[1]))),
        worst_change=float(change[row, column]),
        width=width,
        height=height,
        spp=PASSES * SAMPLES,
        not_finite=(int(bad[0].sum()), int(bad[1].sum())),
    )


def _passes(scene, first: int) -> np.ndarray:
    """Return the brightness of each pass ``(passes, height, width)``; ``first`` is the seed of the first pass."""
    width, height = scenes.film_size(scene)
    shrink = min(1.0, SIDE / max(width, height))
    size = (max(1, round(shrink * n)) for n in (width, height))
    with compat.film_size(scene.sensors()[0], *size):
        images = [scenes.render_pass(scene, SAMPLES, first + i) for i in range(PASSES)]
    return np.stack([scenes.colour_channels(image).mean(axis=-1) for image in images])


def _tiles(images: np.ndarray) -> np.ndarray:
    """Return the means of the tiles of images ``(n, height, width)``; those at the edges may be smaller."""
    rows, columns = (np.arange(0, n, TILE) for n in images.shape[1:])
    sums = np.add.reduceat(np.add.reduceat(images, rows, axis=1), columns, axis=2)
    ones = np.add.reduceat(np.add.reduceat(np.ones(images.shape[1:]), rows, axis=0), columns, axis=1)
    return sums / ones
