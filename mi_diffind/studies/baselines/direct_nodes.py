"""Sparse signed distance fields without indirection: a distance and a normal in the 16 bits of each node.

Nodes are trained and blended as those of our layout.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from ...arrays.sparse_grid import SparseGrid
from ...tasks.sdf import encoding, nodes
from ...tasks.sdf.nodes import SparseNodes, slope_bound
from .byte_grids import NEAREST
from .volumes import structure_arrays

#: Steps of a distance between ± :data:`.byte_grids.NEAREST`, and of each of the normal's octahedral coordinates: the
#: combination of 16 bits with the best normals.
LEVELS, SIDE = 128, 22


def to_octahedral(normals: np.ndarray) -> np.ndarray:
    """Return the octahedral coordinates (n, 2), integers below :data:`SIDE`, nearest to ``normals`` (n, 3)."""
    n = normals / np.maximum(np.abs(normals).sum(axis=1, keepdims=True), 1e-30)
    folded = (1 - np.abs(n[:, 1::-1])) * np.where(n[:, :2] >= 0, 1, -1)
    top = SIDE - 1
    below = np.floor((np.where(n[:, 2:] < 0, folded, n[:, :2]) + 1) / 2 * top)
    candidates = np.clip(below[:, None] + [[0, 0], [0, 1], [1, 0], [1, 1]], 0, top).astype(np.uint32)
    near = np.einsum("nkc,nc->nk", octahedral(candidates), normals)
    return np.take_along_axis(candidates, near.argmax(axis=1)[:, None, None], axis=1)[:, 0]


def octahedral(numbers: np.ndarray) -> np.ndarray:
    """Return the unit vectors (…, 3) of integer octahedral coordinates (…, 2)."""
    x, y = np.moveaxis(numbers * (2 / (SIDE - 1)) - 1, -1, 0)
    z = 1 - np.abs(x) - np.abs(y)
    t = np.maximum(-z, 0)
    vectors = np.stack([x - np.copysign(t, x), y - np.copysign(t, y), z], axis=-1)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _distances(numbers: np.ndarray) -> np.ndarray:
    """Return the distances of stored numbers, in spacings."""
    return (numbers % LEVELS + 0.5 * (1 - LEVELS)) * (2 * NEAREST / LEVELS)


def _normals(numbers: np.ndarray) -> np.ndarray:
    """Return the octahedral coordinates (n, 2) of stored numbers."""
    return np.stack([numbers // LEVELS % SIDE, numbers // (LEVELS * SIDE)], axis=-1).astype(np.uint32)


class DirectNodes(SparseNodes):
    """Field of a sparse ``structure`` whose nodes are ``numbers`` (n,), uint16, in its order."""

    def __init__(self, types, structure: SparseGrid, numbers: np.ndarray, slope: float):
        words = nodes.pointer_words(numbers, 16)
        super().__init__(types, structure, slope, pointers=words, bits=16)
        self.state = {"numbers": numbers, "slope": slope, **structure_arrays(structure)}
        self.number_bytes = 4 * len(words)

    def _node(self, number, record, i, j, k, active):
        Float, number = self.types.Float, nodes.pointer_at(self._pointers, number, 16, active)
        normal = number // LEVELS
        distance = (Float(number - normal * LEVELS) + 0.5 * (1 - LEVELS)) * (2 * NEAREST / LEVELS)
        y = normal // SIDE
        x, y = (dr.fma(Float(v), 2 / (SIDE - 1), -1) for v in (normal - y * SIDE, y))
        z = 1 - dr.abs(x) - dr.abs(y)
        t = dr.maximum(-z, 0)
        x, y = x - dr.copysign(t, x), y - dr.copysign(t, y)
        inverse = dr.rsqrt(dr.fma(x, x, dr.fma(y, y, z * z)))
        return distance, (x * inverse, y * inverse, z * inverse)

    @property
    def nbytes(self) -> int:
        return self.structure.nbytes + self.number_bytes


class DirectCoding(encoding.NodeCoding):
    """Codes of nodes without frames and cascaded array: ``pointers`` hold a distance and a normal each.

    As in the base class, no node changes its side, and the surface stays within the stored cells.
    """

    def __init__(self, sampled: encoding.SampledNodes, seed: int = 0):
        super().__init__(sampled, 16, seed)

    @property
    def nbytes(self) -> int:
        """Bytes of the field."""
        structure = self.sampled.structure
        return structure.nbytes + 4 * -(-structure.nodes // 2)

    def encode(self, values: np.ndarray) -> None:
        nodes = np.arange(len(values))
        self._write(nodes, values[:, 0], to_octahedral(values[:, 1:]))
        self._keep_sides(values, nodes)
        for _ in range(encoding.REPAIRS):
            self._keep_sides(values, self._hold_borders(self._lowest_values(None, None)))

    def _write(self, nodes: np.ndarray, distances: np.ndarray, normals: np.ndarray) -> None:
        d = np.floor(distances * (LEVELS / 2 / NEAREST)) + LEVELS // 2
        inside = self.side[nodes] < 0
        d = np.clip(d, np.where(inside, 0, LEVELS // 2), np.where(inside, LEVELS // 2 - 1, LEVELS - 1))
        self.pointers[nodes] = d.astype(np.uint32) + LEVELS * (normals[:, 0] + SIDE * normals[:, 1])

    def _distances(self, nodes: np.ndarray, pointers: np.ndarray) -> np.ndarray:
        return self.side[nodes, None] * _distances(pointers)

    def _keep_sides(self, wanted: np.ndarray, nodes: np.ndarray) -> None:
        wrong = nodes[self._distances(nodes, self.pointers[nodes, None])[:, 0] < self.least[nodes]]
        # Half a step more, so that quantisation does not round the distance down below the least one
        least = self.least[wrong] + NEAREST / LEVELS
        self._write(wrong, self.side[wrong] * least, _normals(self.pointers[wrong]))

    def values(self) -> np.ndarray:
        normals = octahedral(_normals(self.pointers))
        return np.concatenate([_distances(self.pointers)[:, None], normals], axis=1).astype(np.float32)

    def field(self, types) -> DirectNodes:
        """Return the field of the chosen codes."""
        values = self.values().astype(np.float64)
        slope = slope_bound(values[:, 0], values[:, 1:], self.sampled.corners)
        return DirectNodes(types, self.sampled.structure, self.pointers.astype(np.uint16), slope)
