"""Presets of radiance fields: ours, the arrays of the supplement, and the grid that both begin with."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import log, prod

from ...settings import FitSettings

#: Voxels per pixel of the views at the distance of the box, and the range of the resolution that follows from them:
#: nodes along each side of a cube with the volume of the box.
VOXELS_PER_PIXEL, RESOLUTIONS = 1.0, (32, 320)

#: Stages of the grid from coarse to fine: share of the resolution, and share of the training steps. Between them, cells
#: that no ray sees are removed.
STAGES = ((0.25, 0.08), (0.5, 0.12), (1.0, 0.15), (1.0, 0.65))

#: Default steps of the grid and of the compressed field, for views of few pixels.
GRID_STEPS, STEPS = 2300, 1000

#: Rays for each pixel of the training views, by the default steps of a training, and the most steps that they give.
RAYS_PER_PIXEL, MOST_STEPS = {GRID_STEPS: 6.0, STEPS: 1.5}, 12_000

#: Ratio ρ of the sides of primary and cascaded array by compression (Table 6 of the supplement).
RATIOS = {
    "density": {5: 3.57, 10: 3.8, 25: 2.69, 50: 1.97, 75: 2.82, 100: 2.51},
    "colour": {5: 5.05, 10: 3.42, 25: 4.14, 50: 4.53, 75: 3.58, 100: 5.74},
}

#: Default compression of the preset ``paper``.
COMPRESSION = 50.0

#: Backgrounds of images without alpha that a user may choose (:mod:`.background`).
BACKGROUNDS = ("white", "black", "scene")

#: Bytes of a node of the uncompressed grid: a density and twelve numbers of colour in float32.
NODE_BYTES = 52


def dense_bytes(shape) -> int:
    """Return the bytes of an uncompressed grid of this ``shape``, to which compressions refer."""
    return NODE_BYTES * prod(map(int, shape))


@dataclass(frozen=True)
class RadianceRecipe:
    """Layout of the arrays and settings of the training.

    The layout is ``"sparse"`` (:mod:`.compression`), ``"pairs"`` (:mod:`.paper`) or ``"grid"`` (:mod:`.grid`).
    """

    layout: str
    settings: FitSettings = field(default_factory=FitSettings)


#: Preset name → recipe; the first is the default.
PRESETS = {
    "sparse": RadianceRecipe("sparse", FitSettings(steps=STEPS, batch=8192, lr=5e-3, loss="mse", check_every=50)),
    "paper": RadianceRecipe("pairs", FitSettings(steps=STEPS, batch=8192, lr=5e-3, loss="mse", check_every=50)),
    "grid": RadianceRecipe("grid", FitSettings(steps=GRID_STEPS, batch=8192, lr=2.5e-2, loss="mse", check_every=50)),
}


def scaled_steps(settings: FitSettings, pixels: float) -> FitSettings:
    """Return settings whose default steps, if they are kept, grow with the ``pixels`` of all training views."""
    rays = RAYS_PER_PIXEL.get(settings.steps)
    if rays is None:
        return settings
    return replace(settings, steps=max(settings.steps, min(MOST_STEPS, round(rays * pixels / settings.batch))))


def ratio_for(quantity: str, compression: float) -> float:
    """Return the ratio ρ of "density" or "colour" in Table 6 for the nearest compression, by logarithm."""
    table = RATIOS[quantity]
    return table[min(table, key=lambda c: abs(log(c / compression)))]
