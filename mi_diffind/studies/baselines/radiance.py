"""
What compressed radiance fields are compared with: grids of 8 bits, dense or sparse, plain, in principal components or
with a codebook (the idea of VQRF, Li et al. 2023), planes and lines (of TensoRF, Chen et al. 2022) and a hash grid with
a network (of Instant-NGP, Müller et al. 2022).

Each is a :class:`.VolumeField` of float tensors while it is trained, rounded as it will be stored, and becomes one
that reads bytes: :class:`ByteField` for all that lie on nodes.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from ...tasks.radiance.field import VolumeField, colour_of, density_of
from ...tasks.radiance.nodes import Nodes
from .node_codes import QuantisationSteps

#: Raw numbers of density that are told apart: below is nothing, above is opaque.
RAW = (-8.0, 12.0)


# -- fields on nodes --------------------------------------------------------------------------------------------------


class CoefficientField(VolumeField):
    """
    Trilinear on nodes, as :class:`~mi_diffind.tasks.radiance.field.GridField`, with colours that are rows of a table:
    arrays ``density`` ``(n,)``, ``colour`` ``(m, C)``, C a multiple of four, and, if there is one, ``matrix``
    ``(C + 1, 12)``, which makes twelve numbers of a row, the last line being added. ``rows`` (n,), UInt32, are the
    rows of the nodes (default: their own).
    """

    def __init__(self, nodes: Nodes, arrays: dict, rows=None):
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, arrays)
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


class ByteField(VolumeField):
    """
    What a :class:`CoefficientField` becomes: ``density`` (n,) and ``colour`` (m, C), uint8, with their :class:`.Steps`,
    ``matrix`` (C + 1, 12) or ``None``, ``rows`` (n,) or ``None``. Nodes come in lexicographic order, without one for
    none. ``nbytes``: all that is read, in memory.
    """

    def __init__(
        self, nodes: Nodes, density, colour, steps: tuple[QuantisationSteps, QuantisationSteps], matrix=None, rows=None
    ):
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, {})
        types = self.types
        self.nodes = (
            nodes if nodes.stored is None else Nodes(types, nodes.lower, nodes.spacing, nodes.shape, nodes.stored, True)
        )
        self.density_steps, self.colour_steps = steps
        first = int(nodes.stored is not None)  # 0 stands for no node
        self.density = types.UInt8(np.pad(density, (first, 0)))
        self.words = -(-colour.shape[1] // 4)
        table = colour if rows is not None else np.pad(colour, ((first, 0), (0, 0)))
        table = np.pad(table, ((0, 0), (0, 4 * self.words - colour.shape[1])))
        self.table = types.UInt32(np.ascontiguousarray(table).view("<u4").reshape(-1))
        self.channels = colour.shape[1]
        self.nbytes = self.nodes.nbytes + dr.width(self.density) + 4 * dr.width(self.table)
        self.row_words = None
        if rows is not None:
            numbers = np.pad(rows.astype("<u2"), (first, 0))
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
