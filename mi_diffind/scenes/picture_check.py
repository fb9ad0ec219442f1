"""Check of a scene that was changed: small pictures before and after, whose difference is held against their noise."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..core import compat
from . import loading
from .block_test import BLOCK, POWER, TILE, Block, BlockReference, block_means

#: Longest side of the pictures in pixels, independent passes of each scene, and samples a pixel in a pass.
SIDE, PASSES, SAMPLES = 128, 16, 4
#: Relative difference of a block that does not count: 8 bits do not show it.
LEAST = 1e-3
#: Exchanges of passes between the pictures, from which the power is known: those of equal scenes may be exchanged.
EXCHANGES = 32


@dataclass(frozen=True)
class PictureCheck:
    """Difference of two pictures in blocks of all sizes, of brightness relative to that before.

    ``differs``: the ``worst`` block differs by more than noise explains; ``difference``: root mean square over blocks
    of 4 × 4, without noise; ``noise``: their standard error; ``seen``: changes that nine of ten checks see, of a tile
    of 16 × 16 and of the whole picture, ``None`` if too dark; ``width``, ``height``, ``spp`` of the pictures;
    ``not_finite``: pixels that are not finite, before and after.
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
    """Render two loaded scenes by the first sensor, small and with independent random numbers, and compare them."""
    return compare_passes(_passes(before, 0), _passes(after, PASSES))


def compare_passes(old: np.ndarray, new: np.ndarray) -> PictureCheck:
    """Compare independent passes of the brightness of two pictures, ``(PASSES, height, width)`` each."""
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
        spp=PASSES * SAMPLES,
        not_finite=(int(bad[0].sum()), int(bad[1].sum())),
    )


def _passes(scene, first: int) -> np.ndarray:
    """Return the brightness of each pass, ``(passes, height, width)``; ``first`` is the seed of the first one."""
    width, height = loading.film_size(scene)
    shrink = min(1.0, SIDE / max(width, height))
    size = (max(1, round(shrink * n)) for n in (width, height))
    with compat.film_size(scene.sensors()[0], *size):
        images = [loading.render_pass(scene, SAMPLES, first + i) for i in range(PASSES)]
    return np.stack([loading.colour_channels(image).mean(axis=-1) for image in images])
