"""
The arrays of task 3, untrained: a primary array of 1 to 4 channels, read at uv, that points into a cascaded one.

Two ways to start. The supplement's: the primary is the uv ramp, repeated for each further channel, the cascaded array
constant for each kind of map. Or from the data: the image's principal components, scaled down to the primary's
size, are its entries, and the cascaded array is the linear map back from components to channels. At step 0 this is a
smaller picture of fewer channels, and what is left to learn is what a smaller linear picture cannot show.
"""

from __future__ import annotations

import numpy as np

from ...indirection import DifferentiableArray, Indirection
from ...sizing import Size
from .layout import Layout

#: Room between the components' range and the ends of [0, 1], and the share of texels beyond the range at either end.
MARGIN, OUTSIDE = 0.02, 1e-3

#: A border wraps around if it is crossed by differences at most this many times those between neighbours inside.
TILEABLE = 1.5


def borders(values: np.ndarray) -> tuple[str, str]:
    """
    The borders along v and u that suit an image of shape ``(height, width, channels)``: ``"repeat"`` where its first
    row follows its last as a row follows the next.
    """
    found = []
    for axis in (0, 1):
        inside = np.abs(np.diff(values, axis=axis)).mean() if values.shape[axis] > 1 else 0.0
        first, last = np.take(values, 0, axis), np.take(values, -1, axis)
        across = np.abs(first - last).mean()
        found.append("repeat" if across <= TILEABLE * inside + 1e-6 else "clamp")
    return tuple(found)


def downscale(values: np.ndarray, rows: int, columns: int, border: tuple[str, str]) -> np.ndarray:
    """
    ``values``, ``(height, width, k)``, at the positions of the entries of an array of ``rows`` × ``columns``, under a
    tent as wide as the distance between two of them, or between two texels if that is more. float32.
    """
    height, width, k = values.shape
    down, across = _tent(rows, height, border[0]), _tent(columns, width, border[1])
    found = (down @ values.reshape(height, width * k)).reshape(rows, width, k)
    return np.einsum("cw,rwk->rck", across, found, optimize=True)


def _tent(entries: int, texels: int, border: str) -> np.ndarray:
    """Weights, ``(entries, texels)``, rows sum to 1."""
    step = 1 / max(1, entries if border == "repeat" else entries - 1)
    centres, positions = (np.arange(texels) + 0.5) / texels, np.arange(entries) * step
    distance = np.abs(positions[:, None] - centres[None])
    if border == "repeat":
        distance = np.minimum(distance, 1 - distance)
    weights = np.maximum(1 - distance / max(step, 1 / texels), 0)
    empty = weights.sum(axis=1) == 0  # a clamped end, outside of the outermost texel centres
    weights[empty, np.argmin(distance[empty], axis=1)] = 1
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def principal_components(values: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean, ``(k,)``, and the first ``count`` principal directions, ``(count, k)``, of ``(height, width, k)``."""
    k = values.shape[-1]
    flat = values.reshape(-1, k).astype(np.float64)
    mean = flat.mean(axis=0)
    covariance = flat.T @ flat / len(flat) - np.outer(mean, mean)
    _, directions = np.linalg.eigh(covariance)
    directions = directions.T[::-1][:count]
    strongest = np.argmax(np.abs(directions), axis=1)
    directions *= np.sign(directions[np.arange(len(directions)), strongest])[:, None]
    return mean, directions


def from_ramp(layout: Layout, size: Size, border: tuple[str, str]) -> Indirection:
    """The supplement's initial values; not allocated."""
    return Indirection(
        DifferentiableArray((size.rows, size.columns), size.dims, "ramp", fold=True, border=border),
        DifferentiableArray((size.cascaded,) * size.dims, layout.stored, "constant", layout.initial, fold=True),
    )


def from_components(values: np.ndarray, size: Size, border: tuple[str, str]) -> Indirection:
    """
    Initial values from the principal components of ``values``, ``(height, width, k)`` in [0, 1]; not allocated. What
    channels a primary has beyond the image's ``k`` become a ramp along u or v, as in the supplement.
    """
    k = values.shape[-1]
    used = min(k, size.dims)
    mean, directions = principal_components(values, used)
    small = downscale(values, size.rows, size.columns, border)
    found = (small - mean) @ directions.T
    low, high = np.quantile(found.reshape(-1, used), [OUTSIDE, 1 - OUTSIDE], axis=0)
    high = np.maximum(high, low + 1e-3)
    unit = MARGIN + (1 - 2 * MARGIN) * np.clip((found - low) / (high - low), 0, 1)
    if size.dims > used:
        from ...indirection import ramp

        unit = np.concatenate([unit, ramp((size.rows, size.columns), size.dims - used, border)], axis=-1)
    grid = np.linspace(0, 1, size.cascaded)
    corners = np.stack(np.meshgrid(*[grid] * size.dims, indexing="ij"), axis=-1)[..., :used]
    back = low + (corners - MARGIN) / (1 - 2 * MARGIN) * (high - low)
    cascaded = np.clip(back @ directions + mean, 1e-3, 1 - 1e-3)
    return Indirection(
        DifferentiableArray((size.rows, size.columns), size.dims, unit.astype(np.float32), fold=True, border=border),
        DifferentiableArray((size.cascaded,) * size.dims, k, cascaded.astype(np.float32), fold=True),
    )
