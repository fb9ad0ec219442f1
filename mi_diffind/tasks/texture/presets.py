"""How a texture is stored and trained: the recipe of the supplement, and ours."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ...settings import FitSettings


@dataclass(frozen=True)
class TextureRecipe:
    """
    How a texture is stored and trained.

    ``layered``: in our arrays, on the grids of levels of detail, which start from principal components; else in the
    paper's, which start from ramps. ``once``: channels that are equal or constant at every level are stored once.
    ``normals``: leave out the third component of normals where it follows from the others. ``jitter``: share of the
    steps whose samples lie between texels and levels, the others at texel centres of whole levels. ``rounded``: does
    training see entries as they will be stored? ``samples``: how levels of detail are drawn, ``"levels"`` (a share of
    one half on level 0, one quarter on level 1, …) or one of :data:`.sampling.FOOTPRINTS`. ``axis``: what the paper's
    footprints measure, one of :data:`.sampling.AXES`. ``settings``: the rest.
    """

    layered: bool = True
    once: bool = True
    normals: bool = True
    jitter: float = 0.5
    rounded: bool = True
    samples: str = "levels"
    axis: str = "side"
    settings: FitSettings = dataclasses.field(default_factory=FitSettings)


#: Steps of 262,144 samples of a training that is not told how long it may take.
STEPS = 1500

_OURS = FitSettings(steps=STEPS, batch=2**18, lr=3e-2, schedule="cosine", loss="mse", measure_every=STEPS // 10)
_PAPER = dataclasses.replace(_OURS, batch=2**20, steps=STEPS // 4, lr=1e-3, schedule="constant", loss="mae")

#: The first is the default.
PRESETS = {
    "ours": TextureRecipe(settings=_OURS),
    "paper": TextureRecipe(False, False, False, 1.0, False, "power", "side", _PAPER),
}
