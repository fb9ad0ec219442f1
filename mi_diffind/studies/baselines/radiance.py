"""Baseline fields on nodes: 8-bit grids, dense or sparse, plain, in principal components or with a codebook.

The codebook is the idea of VQRF (Li et al. 2023). A baseline is a :class:`CoefficientField` of float tensors while it
is trained, rounded as it is stored, and then a :class:`ByteField`, which reads bytes.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from ...arrays.indirection import device_array
from ...tasks.radiance.nodes import Nodes
from ...tasks.radiance.volume_field import NodeField, NodeVolume, colour_of
from .node_codes import QuantisationSteps

#: Range of stored raw densities: empty at the lower end, opaque at the upper.
RAW = (-8.0, 12.0)


class CoefficientField(NodeField):
    """:class:`~mi_diffind.tasks.radiance.volume_field.NodeField` whose colours may pass through a matrix.

    The array ``colour`` is ``(m, C)``, C a multiple of four. ``matrix``, ``(C + 1, 12)``, maps a row of it to twelve
    coefficients of colour and then adds its last line; it is one of the ``arrays``, if there is one.
    """

    def __init__(self, nodes: Nodes, density, colour, palette_index=None, matrix=None):
        super().__init__(nodes, density, colour, palette_index)
        if matrix is not None:
            self.arrays["matrix"] = matrix

    def coefficients(self, point_data, active):
        blended = super().coefficients(point_data, active)
        if "matrix" not in self.arrays:
            return blended
        return transformed(self.types, self.arrays["matrix"].array, blended, active)


def transformed(types, matrix, values: list, active=True) -> list:
    """Return twelve numbers: ``values``, C or fewer, times a flat ``matrix`` (C + 1, 12) whose last line is added."""
    last = dr.width(matrix) // 12 - 1

    def line(i: int) -> list:
        index = types.UInt32(3 * i)
        return [v for j in range(3) for v in dr.gather(types.Array4f, matrix, index + j, active)]

    total = line(last)
    for i, value in enumerate(values):
        total = [dr.fma(value, m, t) for m, t in zip(line(i), total, strict=True)]
    return total


class ByteField(NodeVolume):
    """Stored form of a :class:`CoefficientField`, which reads bytes.

    ``density`` (n,) and ``colour`` (m, C) are uint8 with the ``steps`` of each; ``matrix`` is (C + 1, 12) or ``None``,
    ``rows`` (n,) the row of each node or ``None``. Nodes are in lexicographic order, without an entry for no node.
    ``nbytes`` are all bytes in memory.
    """

    def __init__(
        self, nodes: Nodes, density, colour, steps: tuple[QuantisationSteps, QuantisationSteps], matrix=None, rows=None
    ):
        types = nodes.types
        if nodes.stored is not None:
            nodes = Nodes(types, nodes.lower, nodes.spacing, nodes.shape, nodes.stored, packed=True)
        super().__init__(nodes, {})
        self.density_steps, self.colour_steps = steps
        first = int(nodes.stored is not None)  # 0 stands for no node
        self.density = types.UInt8(np.pad(density, (first, 0)))
        self.channels = colour.shape[1]
        self.words = -(-self.channels // 4)
        table = colour if rows is not None else np.pad(colour, ((first, 0), (0, 0)))
        table = np.pad(table, ((0, 0), (0, 4 * self.words - self.channels)))
        self.table = device_array(types.UInt32, np.ascontiguousarray(table).view("<u4"))
        self.row_words = self.matrix = None
        if rows is not None:
            numbers = np.pad(rows.astype("<u2"), (first, 0))
            self.row_words = device_array(types.UInt32, np.pad(numbers, (0, len(numbers) % 2)).view("<u4"))
        if matrix is not None:
            scaled = np.asarray(matrix, np.float64).copy()
            scaled[-1] += self.colour_steps.low @ scaled[:-1]
            scaled[:-1] *= self.colour_steps.step[:, None]
            self.matrix = types.Float(scaled.astype(np.float32).reshape(-1))
        words = [v for v in (self.table, self.row_words, self.matrix) if v is not None]
        self.nbytes = self.nodes.nbytes + dr.width(self.density) + 4 * sum(map(dr.width, words))

    def density_at(self, p, active=True):
        def level(number, seen):
            return self.types.Float(dr.gather(self.types.UInt8, self.density, number, seen))

        low, step = float(self.density_steps.low[0]), float(self.density_steps.step[0])
        return self.interpolated_density(level, p, active, low, step)

    def radiance_at(self, point_data, p, d, active=True):
        types, UInt32 = self.types, self.types.UInt32
        sums = [types.Float(0)] * self.channels
        for weight, number in zip(point_data[:8], point_data[8:], strict=True):
            if self.row_words is not None:
                number = (dr.gather(UInt32, self.row_words, number >> 1, active) >> ((number & 1) << 4)) & 0xFFFF
            for j in range(self.words):
                word = dr.gather(UInt32, self.table, dr.fma(number, self.words, j), active)
                for k in range(min(4, self.channels - 4 * j)):
                    byte = types.Float(types.Int32((word >> (8 * k)) & 255))
                    sums[4 * j + k] = dr.fma(weight, byte, sums[4 * j + k])
        if self.matrix is not None:
            return colour_of(transformed(types, self.matrix, sums), d)
        s = self.colour_steps
        return colour_of([dr.fma(v, float(a), float(b)) for v, a, b in zip(sums, s.step, s.low, strict=True)], d)
