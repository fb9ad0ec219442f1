"""How a radiance field is trained and stored: ours, the supplement's arrays, and the grid that both begin with."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ...settings import FitSettings

#: Nodes of the grid: those of a cube of so many along each side, in the box of what is seen.
RESOLUTION = 128

#: The grid, from coarse to fine: nodes along each side as a share of the last one's, and shares of the steps.
STAGES = ((0.25, 0.13), (0.5, 0.22), (1.0, 0.65))

#: Table 6 of the supplement: sides of the primary over sides of the cascaded array, by compression.
RATIOS = {
    "density": {5: 3.57, 10: 3.8, 25: 2.69, 50: 1.97, 75: 2.82, 100: 2.51},
    "colour": {5: 5.05, 10: 3.42, 25: 4.14, 50: 4.53, 75: 3.58, 100: 5.74},
}

#: Compression of ``paper`` unless asked otherwise.
COMPRESSION = 50.0

#: Bytes of a node of the uncompressed grid: a density and twelve numbers of colour, float32.
NODE_BYTES = 52


def dense_bytes(shape) -> int:
    """Bytes of an uncompressed grid of so many nodes along each axis, to which compressions refer."""
    return NODE_BYTES * math.prod(map(int, shape))


@dataclass(frozen=True)
class Recipe:
    """``layout``: ``"sparse"`` (:mod:`.coded`), ``"pairs"`` (the supplement's: :mod:`.pairs`) or ``"grid"``."""

    layout: str
    settings: FitSettings = field(default_factory=FitSettings)


#: The first is the default.
PRESETS = {
    "sparse": Recipe("sparse", FitSettings(steps=1000, batch=8192, lr=5e-3, loss="mse", check_every=50)),
    "paper": Recipe("pairs", FitSettings(steps=1000, batch=8192, lr=5e-3, loss="mse", check_every=50)),
    "grid": Recipe("grid", FitSettings(steps=2300, batch=8192, lr=2.5e-2, loss="mse", check_every=50)),
}


def ratio_for(kind: str, compression: float) -> float:
    """The ratio of Table 6 for a compression: that of the nearest one, in logarithms."""
    from math import log

    table = RATIOS[kind]
    return table[min(table, key=lambda c: abs(log(c / compression)))]
