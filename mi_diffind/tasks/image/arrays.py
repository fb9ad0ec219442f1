"""
The arrays of task 3, untrained: a primary array of 1 to 4 channels, read at uv, that points into a cascaded one.

Two ways to start. The supplement's: the primary is the uv ramp, repeated for each further channel, the cascaded array
constant for each kind of map. Or from the data: the image's principal components, scaled down to the primary's
size, are its entries, and the cascaded array is the linear map back from components to channels. At step 0 this is a
smaller picture of fewer channels, and what is left to learn is what a smaller linear picture cannot show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ...indirection import DifferentiableArray, Indirection, ramp
from .layout import Layout
from .sizing import Size

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


def from_ramp(layout: Layout, size: Size, border: tuple[str, str]) -> Indirection:
    """The supplement's initial values; not allocated."""
    primaries = [
        DifferentiableArray((rows, columns), dims, "ramp", fold=True, border=border)
        for rows, columns, dims, _ in size.primaries
    ]
    cascaded = DifferentiableArray((size.cascaded,) * size.dims, layout.stored, "constant", layout.initial, fold=True)
    return joined(primaries, cascaded)


def joined(primaries: Sequence[DifferentiableArray], cascaded: DifferentiableArray) -> Indirection:
    """The indirection of primaries that are all read at (v, u)."""
    return Indirection(primaries, cascaded, [(0, 1)] * len(primaries))


def smoothness(values: np.ndarray) -> float:
    """
    How smooth an image, ``(height, width, k)`` in [0, 1], is: the PSNR, in dB, of the mean of the four neighbours of a
    texel in place of the texel. Noise has 20, a photograph 40.
    """
    if min(values.shape[:2]) < 3:
        return 120.0
    inner = values[1:-1, 1:-1]
    mean = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:]
    return -10 * math.log10(max(float(np.mean((inner - mean / 4) ** 2, dtype=np.float64)), 1e-12))


def from_components(values: np.ndarray, size: Size, border: tuple[str, str]) -> Indirection:
    """
    Initial values from the principal components of ``values``, ``(height, width, k)`` in [0, 1]; not allocated. Of two
    primaries, the first takes the components of the differences of neighbours, which need its resolution most, the
    second those of what is left. What channels a primary has beyond the image's ``k`` become a ramp along u or v, as in
    the supplement.
    """
    k = values.shape[-1]
    mean = values.reshape(-1, k).mean(axis=0, dtype=np.float64)
    left, back = np.eye(k), mean  # what is not in a component yet, what the cascaded array says at its entries
    primaries, axis = [], 0
    for i, (rows, columns, dims, _) in enumerate(size.primaries):
        covariance = _differences(values) if i + 1 < len(size.primaries) else _covariance(values, mean)
        used = max(0, min(dims, k - axis))
        # Of what does not vary, any direction is as good, but none that an earlier array has already
        directions = _strongest(left @ covariance @ left + 1e-9 * left, used)
        left = left - directions.T @ directions
        found = (downscale(values, rows, columns, border) - mean) @ directions.T
        unit = np.zeros((rows, columns, 0))
        if used:
            low, high = np.quantile(found.reshape(-1, used), [OUTSIDE, 1 - OUTSIDE], axis=0)
            high = np.maximum(high, low + 1e-3)
            unit = MARGIN + (1 - 2 * MARGIN) * np.clip((found - low) / (high - low), 0, 1)
            grid = (np.linspace(0, 1, size.cascaded) - MARGIN) / (1 - 2 * MARGIN)
        for j in range(used):
            along = np.reshape(
                low[j] + grid * (high[j] - low[j]), [-1 if d == axis + j else 1 for d in range(size.dims)]
            )
            back = back + along[..., None] * directions[j]
        if dims > used:
            unit = np.concatenate([unit, ramp((rows, columns), dims - used, border)], axis=-1)
        primaries.append(DifferentiableArray((rows, columns), dims, unit.astype(np.float32), fold=True, border=border))
        axis += dims
    shape = (size.cascaded,) * size.dims
    back = np.clip(np.broadcast_to(back, (*shape, k)), 1e-3, 1 - 1e-3)
    return joined(primaries, DifferentiableArray(shape, k, back.astype(np.float32), fold=True))


def _covariance(values: np.ndarray, mean: np.ndarray) -> np.ndarray:
    flat = values.reshape(-1, values.shape[-1]).astype(np.float64)
    return flat.T @ flat / len(flat) - np.outer(mean, mean)


def _differences(values: np.ndarray) -> np.ndarray:
    """Covariance of the differences of neighbours."""
    k = values.shape[-1]
    flat = [np.diff(values, axis=axis).reshape(-1, k).astype(np.float64) for axis in (0, 1)]
    return sum(f.T @ f / max(len(f), 1) for f in flat)


def _strongest(covariance: np.ndarray, count: int) -> np.ndarray:
    """The eigenvectors of the largest eigenvalues, ``(count, k)``; their largest component is positive."""
    _, directions = np.linalg.eigh(covariance)
    directions = directions.T[::-1][:count]
    largest = np.argmax(np.abs(directions), axis=1)
    return directions * np.sign(directions[np.arange(count), largest])[:, None]
