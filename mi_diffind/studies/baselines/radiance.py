"""
What compressed radiance fields are compared with: grids of 8 bits, dense or sparse, plain, in principal components or
with a codebook (the idea of VQRF, Li et al. 2023), planes and lines (of TensoRF, Chen et al. 2022) and a hash grid with
a network (of Instant-NGP, Müller et al. 2022).

Each is a :class:`.RadianceField` of float tensors while it is trained, rounded as it will be stored, and becomes one
that reads bytes: :class:`ByteField` for all that lie on nodes.
"""

from __future__ import annotations

import copy

import drjit as dr
import numpy as np
from drjit import nn

from ...tasks.field.field import RadianceField, colour_of, density_of
from ...tasks.field.nodes import Nodes
from .node_codes import Steps

#: Raw numbers of density that are told apart: below is nothing, above is opaque.
RAW = (-8.0, 12.0)

#: The density of what is nowhere stored, as a raw number.
EMPTY = -30.0


# -- where nodes are --------------------------------------------------------------------------------------------------

#: Nodes along a side of a block.
BLOCK = 4


class BlockNodes(Nodes):
    """
    The same nodes by masks and ranks: 16 bits (32, of more than 65,534 blocks) for each block of 4 × 4 × 4 nodes, 64
    bits and a rank for each that has any. ``nbytes`` counts these and the distances that rays cross empty space by.
    """

    def __init__(self, nodes: Nodes):
        super().__init__(nodes.types, nodes.lower, nodes.spacing, nodes.shape, nodes.stored)
        if self.stored is None:
            self.nbytes = 0
            return
        self.index = None
        padded = np.pad(self.stored, [(0, -n % BLOCK) for n in self.shape])
        self.blocks = tuple(n // BLOCK for n in padded.shape)
        x, y, z = self.blocks
        bits = padded.reshape(x, BLOCK, y, BLOCK, z, BLOCK).transpose(0, 2, 4, 1, 3, 5).reshape(-1, BLOCK**3)
        kept = bits.any(axis=1)
        roots = np.zeros(len(bits), np.uint32)
        roots[kept] = np.arange(1, kept.sum() + 1)
        self.narrow = kept.sum() < 2**16 - 1
        words = np.packbits(bits[kept], axis=1, bitorder="little").view("<u4")
        counts = bits[kept].sum(axis=1)
        # Nodes are numbered block by block here: the place of each in the order of the arrays
        self.order = np.concatenate([[0], 1 + np.argsort(self._by_block())])
        records = np.concatenate([words, (np.cumsum(counts) - counts + 1)[:, None]], axis=1).astype(np.uint32)
        if self.narrow:
            roots = np.pad(roots.astype("<u2"), (0, len(roots) % 2)).view("<u4")
        self.roots, self.records = self.types.UInt32(roots), self.types.UInt32(records.reshape(-1))
        self.nbytes = 4 * (dr.width(self.roots) + dr.width(self.records) + dr.width(self.distances))

    def _by_block(self) -> np.ndarray:
        """For each node in lexicographic order, a number that grows block by block and within blocks."""
        place = np.argwhere(self.stored)
        block = np.ravel_multi_index((place // BLOCK).T, self.blocks)
        return block * BLOCK**3 + np.ravel_multi_index((place % BLOCK).T, (BLOCK,) * 3)

    def corners(self, p, active=True):
        if self.stored is None:
            return super().corners(p, active)
        UInt32, (_, height, depth) = self.types.UInt32, self.blocks
        cell, fraction = [], []
        for x, a, n in zip(p, self.lower, self.shape, strict=True):
            u = dr.fma(x, 1 / self.spacing, -a / self.spacing)
            i = dr.clip(dr.floor(u), 0, n - 2)
            fraction.append(dr.clip(u - i, 0, 1))
            cell.append(UInt32(i))
        active = self.types.Bool(active)
        weights, numbers = [], []
        for corner in np.ndindex(2, 2, 2):
            x, y, z = (i + e for i, e in zip(cell, corner, strict=True))
            block = dr.fma(dr.fma(x >> 2, height, y >> 2), depth, z >> 2)
            bit = ((x & 3) << 4) | ((y & 3) << 2) | (z & 3)
            root = dr.gather(UInt32, self.roots, block >> 1 if self.narrow else block, active)
            if self.narrow:
                root = (root >> ((block & 1) << 4)) & 0xFFFF
            # A corner that is missing ends the cell
            active &= root != 0
            record = 3 * root - 3
            low, high, first = (dr.gather(UInt32, self.records, record + k, active) for k in range(3))
            upper = bit >= 32
            word, below = dr.select(upper, high, low), UInt32(1) << (bit & 31)
            active &= (word & below) != 0
            number = first + dr.popcnt(word & (below - 1)) + dr.select(upper, dr.popcnt(low), 0)
            f = [v if e else 1 - v for v, e in zip(fraction, corner, strict=True)]
            weights.append(f[0] * f[1] * f[2])
            numbers.append(number)
        return list(zip(weights, numbers, strict=True)), active


# -- fields on nodes --------------------------------------------------------------------------------------------------


class CoefficientField(RadianceField):
    """
    Trilinear on nodes, as :class:`~mi_diffind.tasks.field.field.GridField`, with colours that are rows of a table:
    arrays ``density`` ``(n,)``, ``colour`` ``(m, C)``, C a multiple of four, and, if there is one, ``matrix``
    ``(C + 1, 12)``, which makes twelve numbers of a row, the last line being added. ``rows`` (n,), UInt32, are the
    rows of the nodes (default: their own).
    """

    def __init__(self, nodes: Nodes, arrays: dict, rows=None, step: float | None = None):
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, arrays, step)
        self.nodes, self.rows = nodes, rows

    def look(self, p, active=True):
        corners, active = self.nodes.corners(p, active)
        raw, density = self.types.Float(0), self.arrays["density"].array
        for weight, number in corners:
            raw = dr.fma(weight, dr.gather(self.types.Float, density, number, active), raw)
        latent = [w for w, _ in corners] + [n for _, n in corners]
        return dr.select(active, density_of(raw, self.per_voxel), 0), latent

    def colour(self, latent, p, d, active=True):
        table, types = self.arrays["colour"], self.types
        packets = table.shape[1] // 4
        sums = [types.Float(0)] * (4 * packets)
        for weight, number in zip(latent[:8], latent[8:], strict=True):
            if self.rows is not None:
                number = dr.gather(types.UInt32, self.rows, number, active)
            for j in range(packets):
                four = dr.gather(types.Array4f, table.array, dr.fma(number, packets, j), active)
                for k in range(4):
                    sums[4 * j + k] = dr.fma(weight, four[k], sums[4 * j + k])
        return colour_of(self._twelve(sums, active), d)

    def _twelve(self, sums: list, active) -> list:
        if "matrix" not in self.arrays:
            return sums
        matrix, count = self.arrays["matrix"].array, self.arrays["matrix"].shape[0] - 1
        lines = []
        for line in (*range(count), count):
            lines.append([v for j in range(3) for v in dr.gather(self.types.Array4f, matrix, 3 * line + j, active)])
        found = lines[-1]
        for value, line in zip(sums, lines, strict=False):
            found = [dr.fma(value, m, total) for m, total in zip(line, found, strict=True)]
        return found

    def skip(self, p, d, active=True):
        return self.nodes.skip(p, d, active)


class ByteField(RadianceField):
    """
    What a :class:`CoefficientField` becomes: ``density`` (n,) and ``colour`` (m, C), uint8, with their :class:`.Steps`,
    ``matrix`` (C + 1, 12) or ``None``, ``rows`` (n,) or ``None``. Nodes come in lexicographic order, without one for
    none. ``nbytes``: all that is read, in memory.
    """

    def __init__(self, nodes: Nodes, density, colour, steps: tuple[Steps, Steps], matrix=None, rows=None, step=None):
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, {}, step)
        types = self.types
        self.nodes, self.density_steps, self.colour_steps = BlockNodes(nodes), *steps
        self.state = {"density": density, "colour": colour, "matrix": matrix, "rows": rows}
        order = np.arange(len(density)) if nodes.stored is None else self.nodes.order[1:] - 1
        first = int(nodes.stored is not None)  # blocks count from one on, since 0 stands for none
        self.density = types.UInt8(np.pad(density[order], (first, 0)))
        self.words = -(-colour.shape[1] // 4)
        table = colour if rows is not None else np.pad(colour[order], ((first, 0), (0, 0)))
        table = np.pad(table, ((0, 0), (0, 4 * self.words - colour.shape[1])))
        self.table = types.UInt32(np.ascontiguousarray(table).view("<u4").reshape(-1))
        self.channels = colour.shape[1]
        self.nbytes = self.nodes.nbytes + dr.width(self.density) + 4 * dr.width(self.table)
        self.row_words = None
        if rows is not None:
            numbers = np.pad(rows[order].astype("<u2"), (first, 0))
            self.row_words = types.UInt32(np.pad(numbers, (0, len(numbers) % 2)).view("<u4"))
            self.nbytes += 4 * dr.width(self.row_words)
        self.matrix = None
        if matrix is not None:
            scaled = np.asarray(matrix, np.float64).copy()
            scaled[-1] += self.colour_steps.low @ scaled[:-1]
            scaled[:-1] *= self.colour_steps.step[:, None]
            self.matrix = types.Float(scaled.astype(np.float32).reshape(-1))
            self.nbytes += 4 * dr.width(self.matrix)

    def look(self, p, active=True):
        corners, active = self.nodes.corners(p, active)
        raw = self.types.Float(0)
        for weight, number in corners:
            raw = dr.fma(weight, self.types.Float(dr.gather(self.types.UInt8, self.density, number, active)), raw)
        s = self.density_steps
        raw = dr.fma(raw, float(s.step[0]), float(s.low[0]))
        latent = [w for w, _ in corners] + [n for _, n in corners]
        return dr.select(active, density_of(raw, self.per_voxel), 0), latent

    def colour(self, latent, p, d, active=True):
        types, UInt32 = self.types, self.types.UInt32
        sums = [types.Float(0)] * self.channels
        for weight, number in zip(latent[:8], latent[8:], strict=True):
            if self.row_words is not None:
                number = (dr.gather(UInt32, self.row_words, number >> 1, active) >> ((number & 1) << 4)) & 0xFFFF
            for j in range(self.words):
                word = dr.gather(UInt32, self.table, dr.fma(number, self.words, j), active)
                for k in range(min(4, self.channels - 4 * j)):
                    byte = types.Float(types.Int32((word >> (8 * k)) & 255))
                    sums[4 * j + k] = dr.fma(weight, byte, sums[4 * j + k])
        if self.matrix is None:
            s = self.colour_steps
            found = [dr.fma(v, float(a), float(b)) for v, a, b in zip(sums, s.step, s.low, strict=True)]
        else:
            line = [[dr.gather(types.Float, self.matrix, UInt32(12 * i + k), active) for k in range(12)]
                    for i in range(self.channels + 1)]  # fmt: skip
            found = line[-1]
            for v, row in zip(sums, line, strict=False):
                found = [dr.fma(v, m, total) for m, total in zip(row, found, strict=True)]
        return colour_of(found, d)

    def skip(self, p, d, active=True):
        return self.nodes.skip(p, d, active)
