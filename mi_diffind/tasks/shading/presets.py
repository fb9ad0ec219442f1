"""Recipes of a training for shaded appearance: the supplement's, and ours."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ...fitting.settings import FitSettings

#: Sample patterns of the reference (:data:`.reference.SAMPLES_PER_SIDE`).
REFERENCES = ("jittered", "prefiltered", "converged")


@dataclass(frozen=True)
class ShadingRecipe:
    """Recipe of a training for shaded appearance, which starts from a trained texture.

    ``share``: λ, the share of the loss of shaded values. ``clip``: bound of the derivatives of a sample's error through
    the specular lobe (``None``: unlimited). ``reference``: sample pattern of the reference. ``bounded``: whether values
    above 1 are compared in log space. ``level_bias``: levels by which a footprint's level of detail is read finer
    (negative), stored in the file (``None``: chosen by images). ``extras``: whether the shape and weight of the
    specular lobe are tried as coarse extras, which ``neural_material`` alone reads. ``fixed``: whether the
    entries that fine levels read keep their values. ``beta_2``: Adam's decay of squared gradients; highlights are rare,
    and with 0.999 single ones tilt normals of glossy, flat pages by degrees. ``texture``: recipe of task 4, which
    trains the start unless one is given, and defines the samples and the loss of the texture. ``settings``: the rest;
    its ``loss`` is that of shaded values.
    """

    share: float = 0.9
    clip: float | None = 1.0
    reference: str = "jittered"
    bounded: bool = True
    level_bias: float | None = None
    extras: bool = False
    fixed: bool = False
    beta_2: float = 0.99
    texture: str = "ours"
    settings: FitSettings = dataclasses.field(default_factory=FitSettings)


#: Steps of a training without a time limit.
STEPS = 1500

_OURS = FitSettings(steps=STEPS, batch=2**16, lr=5e-3, schedule="cosine", loss="mse", measure_every=STEPS // 10)

#: The first is the default. The paper's λ is 0.1 or 0.25, by its scene.
PRESETS = {
    "ours": ShadingRecipe(settings=_OURS),
    "paper": ShadingRecipe(
        share=0.25, clip=0.1, reference="prefiltered", bounded=False, level_bias=0.0, beta_2=0.999, texture="paper",
        settings=dataclasses.replace(_OURS, lr=1e-3, schedule="constant", loss="mae"),
    ),
}  # fmt: skip
