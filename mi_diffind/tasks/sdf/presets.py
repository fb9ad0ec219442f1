"""How a signed distance field is stored and trained: ours, and the supplement's arrays in two ways."""

from __future__ import annotations

from dataclasses import dataclass, field

from ...settings import FitSettings

#: Table 5 of the supplement: sides of the primary over sides of the cascaded array, by megabytes of both.
RATIOS = {6: 2.0, 12: 2.56, 16: 2.81, 24: 2.08, 48: 2.71, 96: 2.56}

#: Bytes of the arrays unless asked otherwise.
BYTES = 2**20


@dataclass(frozen=True)
class Recipe:
    """
    ``layout``: ``"sparse"`` (nodes near the surface, whose pointers are indices: :mod:`.nodes`) or ``"pair"`` (the
    supplement's two dense arrays: :mod:`.pair`). Of a pair, ``start`` is how they begin: ``"ramp"``, with the cascaded
    array from the nearest training samples; or ``"distance"``, with the truncated distance in the first channel of the
    primary array.
    """

    layout: str = "sparse"
    start: str = "ramp"
    settings: FitSettings = field(default_factory=FitSettings)


#: The first is the default.
PRESETS = {
    "sparse": Recipe(
        settings=FitSettings(
            steps=250, batch=2**18, lr=2e-2, schedule="cosine", loss="mae", measure_every=50, deterministic=True
        )
    ),
    "dense": Recipe("pair", "distance", FitSettings(steps=300, batch=2**17, lr=1e-2, schedule="cosine", loss="mae")),
    "paper": Recipe("pair", "ramp", FitSettings(steps=300, batch=2**17, lr=1e-2, schedule="cosine", loss="mae")),
}


def ratio_for(nbytes: int) -> float:
    """The ratio of Table 5 for so many bytes: that of the nearest size."""
    return RATIOS[min(RATIOS, key=lambda size: abs(size * 1e6 - nbytes))]
