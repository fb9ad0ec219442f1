"""Presets of radiance fields: ours, the arrays of the supplement, and the grid that both begin with."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import log, prod

from ...fitting.settings import FitSettings

#: Voxels per pixel of the views at the distance of the box, and the range of the resolution that follows from them:
#: nodes along each side of a cube with the volume of the box.
VOXELS_PER_PIXEL, RESOLUTIONS = 1.25, (32, 352)

#: Stages of the grid from coarse to fine: share of the resolution, and share of the training steps. Between them, cells
#: that no ray sees are removed.
STAGES = ((0.25, 0.08), (0.5, 0.12), (0.75, 0.12), (1.0, 0.1), (1.0, 0.58))

#: Most numbers of the nodes of a grid while it is trained, which bounds memory and time: grids with more stay coarser,
#: unless the resolution is given. In the last stage, a third of them has been removed.
MOST_NUMBERS = 36_000_000

#: Most steps that follow from the pixels of the views.
MOST_STEPS = 11_000

#: Ratio ρ of the sides of primary and cascaded array by compression (Table 6 of the supplement).
RATIOS = {
    "density": {5: 3.57, 10: 3.8, 25: 2.69, 50: 1.97, 75: 2.82, 100: 2.51},
    "colour": {5: 5.05, 10: 3.42, 25: 4.14, 50: 4.53, 75: 3.58, 100: 5.74},
}

#: Default compression of the preset ``paper``.
COMPRESSION = 50.0

#: Colours of a field that a user may choose: with reflections (:mod:`.reflection`), or twelve numbers of directions.
COLOURS = ("reflections", "directions")

#: Share of the resolution from which on reflections are trained; before, normals are not known.
REFLECTING = 0.5

#: Backgrounds of images without alpha that a user may choose (:mod:`.background`).
BACKGROUNDS = ("white", "black", "scene", "surroundings")

#: Bytes of a node of the uncompressed grid: a density and twelve numbers of colour in float32.
NODE_BYTES = 52


def dense_bytes(shape) -> int:
    """Return the bytes of an uncompressed grid of this ``shape``, to which compressions refer."""
    return NODE_BYTES * prod(map(int, shape))


@dataclass(frozen=True)
class RadianceRecipe:
    """Layout of the arrays and settings of the training.

    The layout is ``"sparse"`` (:mod:`.compression`), ``"pairs"`` (:mod:`.paper`) or ``"grid"`` (:mod:`.grid`). By
    default, a training draws ``rays_per_pixel`` rays for each pixel of the training views, but not fewer than the steps
    of the settings do.
    """

    layout: str
    settings: FitSettings = field(default_factory=FitSettings)
    rays_per_pixel: float = 0.0

    def scaled(self, settings: FitSettings, pixels: float) -> FitSettings:
        """Return ``settings`` with steps for the ``pixels`` of all training views, if they have the default steps."""
        if settings.steps != self.settings.steps:
            return settings
        steps = min(MOST_STEPS, round(self.rays_per_pixel * pixels / settings.batch))
        return replace(settings, steps=max(settings.steps, steps))


#: Preset name → recipe; the first is the default.
PRESETS = {
    "sparse": RadianceRecipe("sparse", FitSettings(steps=1000, batch=16384, lr=5e-3, loss="mse", check_every=50), 2.0),
    "paper": RadianceRecipe("pairs", FitSettings(steps=1000, batch=16384, lr=5e-3, loss="mse", check_every=50), 2.0),
    "grid": RadianceRecipe("grid", FitSettings(steps=2000, batch=16384, lr=4e-2, loss="mse", check_every=50), 20.0),
}


def ratio_for(quantity: str, compression: float) -> float:
    """Return the ratio ρ of "density" or "colour" in Table 6 for the nearest compression, by logarithm."""
    table = RATIOS[quantity]
    return table[min(table, key=lambda c: abs(log(c / compression)))]
