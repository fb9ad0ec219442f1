"""Initial arrays of task 4.

The paper's arrays start from ramps and a constant for each role of a map. Ours start from the principal components of
the texture's levels, so at step 0 they are smaller pictures of fewer channels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...arrays.indirection import DifferentiableArray
from ...arrays.pages import PagedArray, page_entries, page_gain, page_positions, page_shift, page_sizes_of
from ...maps import components
from ...maps.compressed import taps
from ...maps.layout import Layout
from .memory_budget import PaperBudget, TextureBudget
from .nets import FineLayer, LayeredNet, LayeredStructure, PaperNet, PaperStructure

#: Share of the differences between two levels that lies within the range of an entry, by its bits.
WITHIN = {1: 0.7, 2: 0.97, 3: 0.99, 4: 0.998, 5: 0.998, 6: 0.998, 7: 0.998, 8: 0.998}

#: Least range of a difference, so that a flat component can still be trained.
SMALLEST = 0.02


def from_ramps(layout: Layout, size: PaperBudget, border: tuple[str, str], levels: int) -> PaperNet:
    """Return the supplement's initial arrays, not allocated."""
    primary0 = DifferentiableArray((size.rows, size.columns), 3, "ramp", fold=True, border=border)
    primary1 = DifferentiableArray((4 * size.lods,), 1, "ramp", fold=True)
    shape = (size.lods, *[size.cascaded] * 3)
    cascaded = DifferentiableArray(shape, layout.stored, "constant", layout.initial, fold=True)
    return PaperNet(primary0, primary1, cascaded, PaperStructure(levels))


@dataclass(frozen=True)
class PrincipalComponents:
    """Principal components of a texture, scaled to [0, 1] as pointers of its texels.

    ``mean``, ``(k,)``; ``directions``, ``(dims, k)``, those with the largest differences between neighbours first;
    ``low`` and ``high``, ``(dims,)``, the range of each component.
    """

    mean: np.ndarray
    directions: np.ndarray
    low: np.ndarray
    high: np.ndarray

    #: Room between the components' range and the ends of [0, 1], and the share of texels beyond it at either end.
    MARGIN, OUTSIDE = 0.02, 1e-3

    @staticmethod
    def of(values: np.ndarray, dims: int) -> PrincipalComponents:
        """Return the first ``dims`` components of level 0, ``(height, width, k)``, at most ``k``."""
        k = values.shape[-1]
        mean = values.reshape(-1, k).mean(axis=0, dtype=np.float64)
        covariance = components.covariance(values, mean)
        directions = components.strongest(covariance, min(dims, k))
        # Rotated within the same space so that the first axes have the most detail: fine arrays hold only these
        detail = directions @ components.differences(values) @ directions.T
        directions = components.strongest(detail, len(directions)) @ directions
        projected = (values.reshape(-1, k) - mean) @ directions.T
        low, high = np.quantile(projected, [PrincipalComponents.OUTSIDE, 1 - PrincipalComponents.OUTSIDE], axis=0)
        return PrincipalComponents(mean, directions, low, np.maximum(high, low + 1e-3))

    @property
    def dims(self) -> int:
        return len(self.directions)

    def pointers(self, values: np.ndarray) -> np.ndarray:
        """Return the pointers of texels, ``(height, width, dims)`` in [0, 1], float32."""
        unit = ((values - self.mean) @ self.directions.T - self.low) / (self.high - self.low)
        return np.clip(self.MARGIN + (1 - 2 * self.MARGIN) * unit, 0, 1).astype(np.float32)

    def back(self, side: int) -> np.ndarray:
        """Return the channels at the entries of a cascaded array, ``(side, …, k)``: linear in the pointer."""
        grid = (np.linspace(0, 1, side) - self.MARGIN) / (1 - 2 * self.MARGIN) if side > 1 else np.array([0.5])
        channels = self.mean
        for d in range(self.dims):
            shape = [-1 if axis == d else 1 for axis in range(self.dims)] + [1]
            along = np.reshape(self.low[d] + grid * (self.high[d] - self.low[d]), shape)
            channels = channels + along * self.directions[d]
        return np.clip(channels, 1e-3, 1 - 1e-3).astype(np.float32)


def enlarged(values: np.ndarray, rows: int, columns: int, border: Sequence[str]) -> np.ndarray:
    """Return a level, ``(height, width, k)``, read bilinearly at the texel centres of ``rows`` × ``columns``."""
    for axis, (n, along) in enumerate(zip((rows, columns), border, strict=True)):
        places = (np.arange(n) + 0.5) / n
        total = 0
        for index, weight in taps(places, values.shape[axis], along):
            shape = [-1 if a == axis else 1 for a in range(3)]
            total = total + np.take(values, index, axis) * weight.reshape(shape)
        values = total
    return values.astype(np.float32)


def from_components(values: Sequence[np.ndarray], size: TextureBudget, border: tuple[str, str]) -> LayeredNet:
    """Return initial arrays from the levels ``values`` of a texture, each ``(height, width, k)`` in [0, 1].

    Each fine array holds the difference between the pointers of its level and the sum of the coarser arrays.
    """
    basis = PrincipalComponents.of(values[0], size.dims)
    # A texture has at most as many components as channels: further coordinates start as ramps along u or v
    pointers = [
        np.concatenate([basis.pointers(level), _ramps(*level.shape[:2], size.dims - basis.dims)], axis=-1)
        for level in values
    ]
    reached, level = pointers[size.skip], size.skip
    layers, fine = _pages(pointers, basis, size, border)
    for i in reversed(range(len(size.fine))):
        spec = size.fine[i]
        rows, columns = values[spec.level].shape[:2]
        while level > spec.level:
            level -= 1
            reached = enlarged(reached, *values[level].shape[:2], border)
        until = (size.fine[i + 1].level if i + 1 < len(size.fine) else size.skip) - 1
        if size.base and i + 1 == len(size.fine):
            reached = np.clip(pointers[level], 1e-3, 1 - 1e-3)
            layers.insert(0, FineLayer(level, until, spec.bits, (1.0,) * spec.channels))
            fine.insert(0, DifferentiableArray((rows, columns), size.dims, reached, fold=True, border=border))
            continue
        rest = (pointers[level] - reached)[..., : spec.channels]
        within = np.quantile(np.abs(rest).reshape(-1, spec.channels), WITHIN[spec.bits], axis=0)
        scale = np.maximum(2 * within, SMALLEST)
        layer = FineLayer(level, until, spec.bits, tuple(float(f"{s:.6g}") for s in scale))
        entries = np.clip(rest / np.array(layer.scale) + layer.zero, 0, 1).astype(np.float32)
        layers.insert(0, layer)
        fine.insert(0, DifferentiableArray((rows, columns), spec.channels, entries, fold=True, border=border))
        reached = reached.copy()
        reached[..., : spec.channels] += ((entries - layer.zero) * layer.scale).astype(np.float32)
    coarse = np.concatenate([p.reshape(-1, size.dims) for p in pointers[size.skip :]])
    coarse = DifferentiableArray((len(coarse),), size.dims, np.clip(coarse, 1e-3, 1 - 1e-3), fold=True)
    shape = (size.knots,) * (size.knots > 1) + (size.cascaded,) * size.dims
    back = basis.back(size.cascaded)
    back = back.reshape(*back.shape[:-1], *[1] * (size.dims - basis.dims), back.shape[-1])
    cascaded = np.broadcast_to(back, (*shape, size.channels)).astype(np.float32)
    cascaded = DifferentiableArray(shape, size.channels, cascaded, fold=True)
    structure = LayeredStructure(size.height, size.width, tuple(layers), size.skip, size.bits, size.base)
    return LayeredNet(fine, coarse, cascaded, structure, border)


def _pages(pointers: list, basis: PrincipalComponents, size: TextureBudget, border) -> tuple[list, list]:
    """Return the layers of pages and their arrays."""
    if not size.pages:
        return [], []
    used = basis.dims
    weighted = [(pointers[level][..., :used] * (basis.high - basis.low)).astype(np.float32) for level in size.pages]
    layers, fine = [], []
    ends = [*size.pages[1:], size.skip]
    sides = page_sizes_of(weighted, border, size.page_entries)
    for level, end, sizes in zip(size.pages, ends, sides, strict=True):
        values = pointers[level]
        shift = page_shift(values.shape[:2])
        entries = np.clip(page_entries(values[..., :used].astype(np.float32), border, sizes), 0, 1)
        further = page_positions(sizes, shift)[:, [j % 2 for j in range(size.dims - used)]]
        entries = np.concatenate([entries, further], axis=-1).astype(np.float32)
        layers.append(FineLayer(level, end - 1, size.page_bits, (1.0,) * size.dims, True))
        fine.append(PagedArray(sizes, size.dims, entries, shift, fold=True, border=border))
    return layers, fine


def gain_of_pages(values: Sequence[np.ndarray], size: TextureBudget, border: tuple[str, str]) -> float:
    """Return the gain of pages over one grid of equal bytes at level 0, in dB (:func:`.page_gain`)."""
    basis = PrincipalComponents.of(values[0], size.dims)
    flat = values[0].reshape(-1, values[0].shape[-1]) - basis.mean
    exact = flat @ basis.directions.T
    rest = float(np.mean(flat**2, axis=0).sum() - np.mean(exact**2, axis=0).sum())
    exact = exact.reshape(*values[0].shape[:2], -1).astype(np.float32)
    return page_gain(exact, border, size.page_entries, max(rest, 0.0))[0]


def _ramps(rows: int, columns: int, count: int) -> np.ndarray:
    """Return the positions of texel centres, ``(rows, columns, count)``: along u and v in turn."""
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    return np.concatenate([np.zeros((rows, columns, 0)), *[(u, v)[i % 2][..., None] for i in range(count)]], axis=-1)
