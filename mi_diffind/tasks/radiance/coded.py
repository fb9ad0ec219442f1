"""
The compressed field: pointers at the nodes of a sparse grid, into two arrays that all nodes share.

A node holds a coordinate in a *curve*, a short array of raw densities, and an index into an array of colours, of
twelve numbers each. Both arrays are learned. A pointer that is an index cannot be interpolated, so entries are read at
the eight corners of a cell and blended there.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from ...bits import as_words, pack_bits
from .field import VolumeField, blended, colour_of, density_of
from .nodes import Nodes


class CodedField(VolumeField):
    """
    ``share`` ``(n,)``: coordinates in [0, 1] in ``curve`` ``(K,)``, raw densities; ``codes`` (uint32, ``(n,)``):
    entries of ``palette`` ``(P, 12)``. The first of n stands for no node (:class:`.nodes.Nodes`).
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
        return dr.select(active, density_of(raw, self.per_voxel), 0), [w for w, _ in corners] + [s for _, s in corners]

    def colour(self, latent, p, d, active=True):
        entries = [dr.gather(self.types.UInt32, self.codes, slot, active) for slot in latent[8:]]
        return colour_of(blended(self.types, self.arrays["palette"].array, 3, latent[:8], entries, active), d)

    def skip(self, p, d, active=True):
        return self.nodes.skip(p, d, active)


class PackedField(VolumeField):
    """
    The same for rendering: a node is a code of ``share_bits`` + ``code_bits`` bits, one after the other in words of 32,
    the curve's entries are those that codes may name, ``(2^share_bits,)``, and the palette's numbers are bytes that
    stand for ``offset`` + ``scale`` · byte: ``palette`` is ``(P, 12)`` uint8, in memory with 16 bytes an entry.
    """

    def __init__(self, nodes, shares, share_bits, curve, codes, code_bits, palette, scale, offset, step=None):
        types = nodes.types
        super().__init__(types, nodes.lower, nodes.upper, nodes.spacing, {}, step)
        self.nodes, self.share_bits, self.code_bits = nodes, share_bits, code_bits
        self.words = types.UInt32(node_words(shares, share_bits, codes, code_bits))
        self.curve = types.Float(np.ascontiguousarray(curve, np.float32))
        entries = np.zeros((len(palette), 16), np.uint8)
        entries[:, :12] = palette
        self.palette = types.UInt32(entries.view("<u4").reshape(-1))
        self.scale, self.offset = [float(v) for v in scale], [float(v) for v in offset]

    @property
    def nbytes(self) -> int:
        """Bytes in memory, with the index of the nodes."""
        return 4 * sum(map(dr.width, (self.words, self.curve, self.palette))) + self.nodes.nbytes

    def look(self, p, active=True):
        corners, active = self.nodes.corners(p, active)
        Float, UInt32 = self.types.Float, self.types.UInt32
        width = self.share_bits + self.code_bits
        raw, codes = Float(0), []
        for weight, slot in corners:
            start = slot * width
            first, shift = start >> 5, start & 31
            word = dr.gather(UInt32, self.words, first, active) >> shift
            if 32 % width:  # a code may begin in one word and end in the next
                following = dr.gather(UInt32, self.words, first + 1, active)
                word |= (following << (31 - shift)) << 1
            raw = dr.fma(weight, dr.gather(Float, self.curve, word & (2**self.share_bits - 1), active), raw)
            codes.append((word >> self.share_bits) & (2**self.code_bits - 1))
        return dr.select(active, density_of(raw, self.per_voxel), 0), [w for w, _ in corners] + codes

    def colour(self, latent, p, d, active=True):
        types = self.types
        sums = [types.Float(0)] * 12
        for weight, code in zip(latent[:8], latent[8:], strict=True):
            words = dr.gather(types.Array4u, self.palette, code, active)
            for k in range(12):
                # The byte as the mantissa of a number in [1, 2): no conversion, and the weights sum to 1
                byte = (words[k // 4] << 15 - 8 * (k % 4)) if k % 4 < 2 else (words[k // 4] >> 8 * (k % 4) - 15)
                number = dr.reinterpret_array(types.Float, (byte & 0x7F8000) | 0x3F800000)
                sums[k] = dr.fma(weight, number, sums[k])
        numbers = [dr.fma(s - 1, 256 * a, b) for s, a, b in zip(sums, self.scale, self.offset, strict=True)]
        return colour_of(numbers, d)

    def skip(self, p, d, active=True):
        return self.nodes.skip(p, d, active)


def node_words(shares: np.ndarray, share_bits: int, codes: np.ndarray, code_bits: int) -> np.ndarray:
    """Words of 32 bits that hold a share and a code for each node, one after the other, and one word more."""
    joined = shares.astype(np.uint32) | (codes.astype(np.uint32) << share_bits)
    return as_words(pack_bits(joined, share_bits + code_bits), spare=1)
