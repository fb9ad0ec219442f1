"""Initial arrays of task 3: a primary array of 1 to 4 channels, read at uv, that points into a cascaded array.

- The supplement's: the primary is the uv ramp, repeated for each further channel; the cascaded array is constant for
  each role of a map.
- Ours: the primary holds the image's principal components, scaled down to its size; the cascaded array is the linear
  map back from components to channels. At step 0 this is a smaller picture of fewer channels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ...arrays.indirection import DifferentiableArray, Indirection, ramp
from ...arrays.pages import PagedArray, page_counts, page_entries, page_gain, page_positions, page_shift, page_sizes
from ...maps import components
from ...maps.layout import Layout
from .memory_budget import ImageBudget

#: Room between the components' range and the ends of [0, 1]; share of texels beyond the range at either end.
MARGIN, OUTSIDE = 0.02, 1e-3


def from_ramp(layout: Layout, size: ImageBudget, border: tuple[str, str]) -> Indirection:
    """Return the supplement's initial arrays, not allocated."""
    primaries = [
        DifferentiableArray((rows, columns), dims, "ramp", fold=True, border=border)
        for rows, columns, dims, _ in size.primaries
    ]
    cascaded = DifferentiableArray((size.cascaded,) * size.dims, layout.stored, "constant", layout.initial, fold=True)
    return joined(primaries, cascaded)


def joined(primaries: Sequence[DifferentiableArray], cascaded: DifferentiableArray) -> Indirection:
    """Return the indirection of primaries that are all read at (v, u)."""
    return Indirection(primaries, cascaded, [(0, 1)] * len(primaries))


def from_components(values: np.ndarray, size: ImageBudget, border: tuple[str, str], weights=1.0) -> Indirection:
    """Return initial arrays from the principal components of ``values``, ``(height, width, k)`` in [0, 1]; unallocated.

    ``weights``, a number for each channel, multiply differences: components and pages follow the heavier channels.

    Of two primaries, the first takes the components of the differences of neighbours, which need its resolution most;
    the second takes components of the rest. Channels beyond the image's ``k`` start as ramps along u or v.
    """
    k, values = values.shape[-1], values * np.asarray(weights, np.float32)
    mean = values.reshape(-1, k).mean(axis=0, dtype=np.float64)
    left, back = np.eye(k), mean  # projection onto remaining components; channels of the cascaded entries
    primaries, axis = [], 0
    for i, (rows, columns, dims, _) in enumerate(size.primaries):
        last = i + 1 == len(size.primaries)
        covariance = components.covariance(values, mean) if last else components.differences(values)
        used = max(0, min(dims, k - axis))
        # The small multiple of ``left`` keeps flat directions apart from those of an earlier array
        directions = components.strongest(left @ covariance @ left + 1e-9 * left, used)
        left = left - directions.T @ directions
        paged = size.paged and i == 0
        if paged:
            exact = ((values - mean) @ directions.T).astype(np.float32)
            sizes, shift = page_sizes(exact, border, page_budget(size, values.shape)), page_shift(values.shape[:2])
            projected = page_entries(exact, border, sizes)
        else:
            projected = (components.downscale(values, rows, columns, border) - mean) @ directions.T
        unit = np.zeros((*projected.shape[:-1], 0))
        if used:
            low, high = np.quantile(projected.reshape(-1, used), [OUTSIDE, 1 - OUTSIDE], axis=0)
            high = np.maximum(high, low + 1e-3)
            unit = MARGIN + (1 - 2 * MARGIN) * np.clip((projected - low) / (high - low), 0, 1)
            grid = (np.linspace(0, 1, size.cascaded) - MARGIN) / (1 - 2 * MARGIN)
        for j in range(used):
            along = np.reshape(
                low[j] + grid * (high[j] - low[j]), [-1 if d == axis + j else 1 for d in range(size.dims)]
            )
            back = back + along[..., None] * directions[j]
        if dims > used:
            further = range(dims - used)
            if paged:
                positions = page_positions(sizes, shift)[:, [j % 2 for j in further]]
            else:
                positions = ramp((rows, columns), len(further), border)
            unit = np.concatenate([unit, positions], axis=-1)
        unit = unit.astype(np.float32)
        if paged:
            primaries.append(PagedArray(sizes, dims, unit, shift, fold=True, border=border))
        else:
            primaries.append(DifferentiableArray((rows, columns), dims, unit, fold=True, border=border))
        axis += dims
    shape = (size.cascaded,) * size.dims
    back = np.clip(np.broadcast_to(back / weights, (*shape, k)), 1e-3, 1 - 1e-3)
    return joined(primaries, DifferentiableArray(shape, k, back.astype(np.float32), fold=True))


def gain_of_pages(values: np.ndarray, size: ImageBudget, border: tuple[str, str]) -> tuple[float, float]:
    """Return :func:`~mi_diffind.arrays.pages.page_gain` of the components of an image, for one primary."""
    k = values.shape[-1]
    mean = values.reshape(-1, k).mean(axis=0, dtype=np.float64)
    covariance = components.covariance(values, mean)
    directions = components.strongest(covariance, min(size.dims, k))
    rest = np.trace(covariance) - np.trace(directions @ covariance @ directions.T)
    exact = ((values - mean) @ directions.T).astype(np.float32)
    gain, psnr = page_gain(exact, border, page_budget(size, values.shape), max(float(rest), 0.0))
    return gain, psnr + 10 * math.log10(k)


def page_budget(size: ImageBudget, shape: Sequence[int]) -> float:
    """Return the entries of all pages of the first primary beside their index, for an image of ``shape``."""
    rows, columns, dims, bits = size.primaries[0]
    index = PagedArray(np.ones((*page_counts(shape[:2]), 2), int)).index_nbytes
    return rows * columns - 8 * index / (dims * bits)
