"""How a texture is trained for its shading: the supplement's recipe, and ours."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from ...settings import FitSettings

#: What training may compare shaded values with (:data:`.reference.KINDS`).
REFERENCES = ("jittered", "prefiltered", "converged")


@dataclass(frozen=True)
class ShadingRecipe:
    """
    How a texture is trained for its shading, from arrays that were trained as a texture before.

    ``share``: λ, the share of the loss of shaded values. ``clip``: bound of the derivatives of the error of a sample
    that flow back through the specular lobe; ``None``: none. ``reference``: what shaded values are compared with.
    ``bounded``: are values beyond 1 compared by their logarithms? ``texture``: the recipe of task 4 whose arrays,
    samples and loss of the texture are used, and which trains them before, unless trained ones are given. ``settings``:
    the rest; its ``loss`` is that of shaded values.
    """

    share: float = 0.9
    clip: float | None = 1.0
    reference: str = "jittered"
    bounded: bool = True
    texture: str = "ours"
    settings: FitSettings = dataclasses.field(default_factory=FitSettings)


#: Steps of a training that is not told how long it may take.
STEPS = 600

_OURS = FitSettings(steps=STEPS, batch=2**16, lr=2e-3, schedule="cosine", loss="mse", measure_every=STEPS // 10)

#: The first is the default. The paper's λ is 0.1 or 0.25, by its scene.
PRESETS = {
    "ours": ShadingRecipe(settings=_OURS),
    "paper": ShadingRecipe(
        share=0.25, clip=0.1, reference="prefiltered", bounded=False, texture="paper",
        settings=dataclasses.replace(_OURS, lr=1e-3, schedule="constant", loss="mae"),
    ),
}  # fmt: skip
