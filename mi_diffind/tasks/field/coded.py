"""
The compressed field: pointers at the nodes of a sparse grid, into two arrays that all nodes share.

A node holds a coordinate in a *curve*, a short array of raw densities, and an index into an array of colours, of
twelve numbers each. Both arrays are learned. A pointer that is an index cannot be interpolated, so entries are read at
the eight corners of a cell and blended there.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from .field import RadianceField, blended, colour_of, density_of
from .nodes import Nodes


class CodedField(RadianceField):
    """
    ``share`` ``(n,)``: coordinates in [0, 1] in ``curve`` ``(K,)``, raw densities; ``codes`` (uint32, ``(n,)``): entries
    of ``palette`` ``(P, 12)``. The first of n stands for no node (:class:`.nodes.Nodes`).
    """

    def __init__(self, nodes: Nodes, share, curve, codes, palette, step: float | None = None):
        arrays = {"share": share, "curve": curve, "palette": palette}
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, arrays, step)
        self.nodes, self.codes = nodes, codes

    def look(self, p, active=True):
        corners, active = self.nodes.corners(p, active)
        Float, UInt32 = self.types.Float, self.types.UInt32
        share, curve = self.arrays["share"].array, self.arrays["curve"].array
        last = dr.width(curve) - 1
        raw = Float(0)
        for weight, slot in corners:
            at = dr.gather(Float, share, slot, active) * last
            first = dr.minimum(UInt32(dr.detach(at)), last - 1)
            low, high = dr.gather(Float, curve, first, active), dr.gather(Float, curve, first + 1, active)
            raw = dr.fma(weight, dr.lerp(low, high, at - Float(first)), raw)
        return dr.select(active, density_of(raw, self.voxel), 0), [w for w, _ in corners] + [s for _, s in corners]

    def colour(self, latent, p, d, active=True):
        entries = [dr.gather(self.types.UInt32, self.codes, slot, active) for slot in latent[8:]]
        return colour_of(blended(self.types, self.arrays["palette"].array, 3, latent[:8], entries, active), d)

    def skip(self, p, d, active=True):
        return self.nodes.skip(p, d, active)
