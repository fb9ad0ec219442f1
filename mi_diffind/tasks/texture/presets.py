"""Recipes of textures: the supplement's and ours."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ...fitting.settings import FitSettings


@dataclass(frozen=True)
class TextureRecipe:
    """Storage and training of a texture.

    - ``layered``: our arrays, on the grids of levels of detail, which start from principal components; else the
      paper's arrays, which start from ramps.
    - ``once``: store channels only once that are equal or constant at every level.
    - ``normals``: leave out the third component of normals where it follows from the others.
    - ``jitter``: share of the steps whose samples lie between texels and levels; the others lie at texel centres of
      whole levels.
    - ``rounded``: train with entries rounded as they will be stored.
    - ``samples``: distribution of levels of detail, ``"levels"`` (one half on level 0, one quarter on level 1, …) or
      one of :data:`.sampling.FOOTPRINTS`.
    - ``settings``: steps, batch, rate and loss.
    """

    layered: bool = True
    once: bool = True
    normals: bool = True
    jitter: float = 0.5
    rounded: bool = True
    samples: str = "levels"
    settings: FitSettings = dataclasses.field(default_factory=FitSettings)


#: Steps of 262,144 samples of a training without a time limit.
STEPS = 1500

_OURS = FitSettings(steps=STEPS, batch=2**18, lr=3e-2, schedule="cosine", loss="mse", measure_every=STEPS // 10)
_PAPER = dataclasses.replace(_OURS, batch=2**20, steps=STEPS // 4, lr=1e-3, schedule="constant", loss="mae")

#: Recipes by name; the first is the default.
PRESETS = {
    "ours": TextureRecipe(settings=_OURS),
    "paper": TextureRecipe(False, False, False, 1.0, False, "power", _PAPER),
}
