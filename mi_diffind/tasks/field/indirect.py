"""
The compressed field: each node holds a pointer into an array of colours that all of them share.

A node has four numbers of few bits. One is a coordinate in a *curve*, a short array of raw densities; three are a
coordinate in the *cascaded* array, whose entries are the twelve numbers of a colour. Between nodes, coordinates are
interpolated, then the arrays are read: C[P[x]], as in the paper, but with a primary array that has entries only where
something is seen.
"""

from __future__ import annotations

import drjit as dr
import numpy as np
from scipy.spatial import cKDTree

from ... import lookup
from ...indirection import DifferentiableArray
from .field import RadianceField, colour_of, density_of
from .nodes import Nodes

#: Raw numbers of density at the ends of a curve as it begins.
EMPTIEST, DENSEST = -8.0, 16.0


class IndirectField(RadianceField):
    """
    ``primary`` has an entry of four channels for each entry of ``nodes`` (a 1D array), ``curve`` entries of one channel
    in 1D, ``cascaded`` of twelve in 3D; all of them :class:`~mi_diffind.indirection.DifferentiableArray`, unfolded.
    """

    def __init__(self, nodes: Nodes, primary, curve, cascaded, step: float | None = None):
        self.modules = {"primary": primary, "curve": curve, "cascaded": cascaded}
        arrays = {name: module.data for name, module in self.modules.items()}
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, arrays, step)
        self.nodes = nodes

    def with_arrays(self, arrays: dict):
        result = super().with_arrays(arrays)
        result.modules = {}
        for name, module in self.modules.items():
            result.modules[name] = module._like()
            result.modules[name].data = arrays.get(name)
        return result

    def _entry(self, slot, active) -> list:
        """The four numbers of a node."""
        primary = self.modules["primary"]
        if primary.storage == "uint8":
            return lookup.entry_packed(
                primary.data.array, primary.scale, primary.offset, primary.resolution, 4, slot, active, primary.bits
            )
        return list(dr.gather(self.types.Array4f, primary.data.array, slot, active))

    def look(self, p, active=True):
        corners, active = self.nodes.corners(p, active)
        packed = self.modules["primary"].storage == "uint8"
        count = 4 if packed else 1
        sums = [self.types.Float(0)] * count
        for weight, slot in corners:
            entry = self._entry(slot, active)
            sums = [dr.fma(weight, e, s) for e, s in zip(entry[:count], sums, strict=True)]
        (raw,) = self.modules["curve"]([sums[0]], active)
        # What was read is kept, unless it is differentiated: then nothing of it may leave the branch of colours
        latent = sums[1:] if packed else [w for w, _ in corners] + [s for _, s in corners]
        return dr.select(active, density_of(raw, self.voxel), 0), latent

    def colour(self, latent, p, d, active=True):
        place = latent
        if len(latent) == 16:
            place = [self.types.Float(0)] * 3
            for weight, slot in zip(latent[:8], latent[8:], strict=True):
                place = [dr.fma(weight, e, s) for e, s in zip(self._entry(slot, active)[1:], place, strict=True)]
        return colour_of(self.modules["cascaded"](place, active), d)

    def skip(self, p, d, active=True):
        return self.nodes.skip(p, d, active)


def components(colour: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """
    Coordinates in [0, 1]³ for twelve numbers ``(n, 12)``: their first three principal components, each spread so that
    its values are used alike. ``weights`` ``(n,)`` say how much a node counts.
    """
    weights = weights / weights.sum()
    centred = colour - weights @ colour
    spread = (centred * weights[:, None]).T @ centred
    _, axes = np.linalg.eigh(spread)
    found = centred @ axes[:, :-4:-1]
    for c in range(3):
        order = np.argsort(found[:, c], kind="stable")
        share = np.cumsum(weights[order])
        # Half by rank, half by value: places that few use are still told apart
        values = found[order, c]
        low, high = np.interp([0.002, 0.998], share, values)
        even = np.clip((values - low) / max(high - low, 1e-9), 0, 1)
        found[order, c] = 0.5 * (share - weights[order] / 2) + 0.5 * even
    return np.clip(found, 0, 1)


def averaged(places: np.ndarray, colour: np.ndarray, weights: np.ndarray, side: int) -> np.ndarray:
    """
    The cascaded array ``(side, side, side, 12)`` whose entries are the means of the colours that point near them;
    where none does, the nearest that has some.
    """
    sums, total = np.zeros((side**3, 12)), np.zeros(side**3)
    at = places * (side - 1)
    first = np.minimum(at.astype(int), side - 2)
    part = at - first
    for corner in np.ndindex(2, 2, 2):
        weight = weights * np.prod([part[:, c] if e else 1 - part[:, c] for c, e in enumerate(corner)], axis=0)
        index = np.ravel_multi_index((first + corner).T, (side,) * 3)
        total += np.bincount(index, weight, side**3)
        for c in range(12):
            sums[:, c] += np.bincount(index, weight * colour[:, c], side**3)
    known = total > 1e-6 * weights.mean()
    entries = np.zeros((side**3, 12))
    entries[known] = sums[known] / total[known, None]
    if not known.all():
        grid = np.stack(np.unravel_index(np.arange(side**3), (side,) * 3), axis=1)
        nearest = cKDTree(grid[known]).query(grid[~known])[1]
        entries[~known] = entries[known][nearest]
    return entries.reshape(side, side, side, 12)


def initial(grid, weights: np.ndarray, side: int, curve: int) -> tuple:
    """
    The arrays of a :class:`.target.Grid` as they begin: a primary array, a curve of ``curve`` entries and a cascaded
    array of ``side``³. ``weights`` ``(n,)`` say how much of an entry is seen.
    """
    places = components(grid.colour, weights)
    share = np.clip((grid.density - EMPTIEST) / (DENSEST - EMPTIEST), 0, 1)
    entries = np.concatenate([share[:, None], places], axis=1).astype(np.float32)
    primary = DifferentiableArray((len(entries),), 4, entries, fold=True)
    line = np.linspace(EMPTIEST, DENSEST, curve, dtype=np.float32)[:, None]
    return (
        primary,
        DifferentiableArray((curve,), 1, line),
        DifferentiableArray((side,) * 3, 12, averaged(places, grid.colour, weights, side).astype(np.float32)),
    )
