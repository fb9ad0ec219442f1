"""Encoding of a mesh as a sparse grid: sampled nodes, frames of blocks, cascaded array and pointers."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from ...arrays.sparse_grid import SparseGrid
from .distances import Distances, near_nodes, surface_cells
from .nodes import (  # fmt: skip
    POINTERS,
    decode_to_array,
    entry_scale,
    entry_words,
    frame_words,
    middles,
    residuals,
    slope_bound,
    unpack_entries,
    unpack_frames,
)

#: Weights of an entry's coordinates when entries are chosen: a distance (in spacings) counts 5 times a normal.
WEIGHTS = np.array([5.0, 1, 1])

#: Smallest distance of a node from zero, in spacings.
LEAST = 0.01


@dataclass
class SampledNodes:
    """Nodes of a sparse grid with their exact distances and normals.

    ``positions`` in the ``structure`` (n, 3), ``block`` (n,), ``distances`` in spacings (n,), ``normals`` (n, 3), and
    the ``corners`` of the grid's cells (K, 8), z fastest.
    """

    structure: SparseGrid
    positions: np.ndarray
    block: np.ndarray
    distances: np.ndarray
    normals: np.ndarray
    corners: np.ndarray
    #: Number of cells that the surface passes through or close by, and the share of them in which no sign changes.
    cells: int
    missed: float
    #: Bits of the pointers that will code the nodes.
    bits: int = 10

    @property
    def entries(self) -> int:
        """Entries of the cascaded array: as many as pointers can name, and at most one for each node."""
        return max(1, min(2**self.bits, self.structure.nodes))

    @property
    def nbytes(self) -> int:
        """Bytes in memory of the coded nodes: the grid, frames, pointers and entries."""
        pointers = -(-self.structure.nodes // POINTERS[self.bits])
        return self.structure.nbytes + 4 * (self.structure.blocks + pointers + self.entries)


def sample(distances: Distances, spacing: float, bits: int = 10) -> SampledNodes:
    """Sample the nodes of a grid of this ``spacing`` (of the longest side) around the mesh of ``distances``."""
    mesh = distances.mesh
    lower = mesh.lower - 1.5 * spacing
    shape = np.ceil((mesh.upper + 1.5 * spacing - lower) / spacing).astype(int)
    cells = surface_cells(distances, lower, spacing, shape)
    nodes, corners = near_nodes(cells)
    d, normals = distances.signed_normals(lower + spacing * nodes)
    crossed = (d < 0)[corners]
    keep = crossed.any(axis=1) & ~crossed.all(axis=1)
    used = np.unique(corners[keep])
    nodes, d, normals = nodes[used], d[used], normals[used]
    structure = SparseGrid.from_nodes(nodes, d < 0, shape + 1, lower, spacing, distances.inside)
    # In the order of the grid
    positions, block = structure.node_positions()
    order = np.ravel_multi_index(nodes.T, structure.shape)  # ascending
    place = np.searchsorted(order, np.ravel_multi_index(positions.T, structure.shape))
    missed = 1 - np.count_nonzero(keep) / max(1, len(cells))
    return SampledNodes(
        structure, positions, block, d[place].astype(np.float64) / spacing, normals[place].astype(np.float64),
        crossed_cells(structure, d[place] < 0), len(cells), missed, bits,
    )  # fmt: skip


def crossed_cells(structure: SparseGrid, inside: np.ndarray) -> np.ndarray:
    """Return the corners ``(K, 8)`` of the cells in which the signs of stored nodes differ, given ``inside`` (n,)."""
    corners = structure.cells()
    crossed = inside[corners]
    return corners[crossed.any(axis=1) & ~crossed.all(axis=1)]


def encode_again(structure: SparseGrid, before: np.ndarray, values: np.ndarray, bits: int, seed: int = 0) -> NodeCoding:
    """Encode the nodes of a field again, with new ``values`` (n, 4): distances in spacings and unit normals.

    ``before`` are the decoded nodes of the file (n, 4), whose signs state the side of each node.
    """
    positions, block = structure.node_positions()
    side = np.where(before[:, 0] < 0, -1.0, 1.0)
    corners = crossed_cells(structure, side < 0)
    distances = side * np.maximum(np.abs(before[:, 0]), LEAST)
    sampled = SampledNodes(structure, positions, block, distances, before[:, 1:], corners, len(corners), 0.0, bits)
    coding = NodeCoding(sampled, seed)
    coding.encode(values)
    return coding


def node_frames(words: np.ndarray, block: np.ndarray):
    """Return the frames of nodes in the blocks ``block`` (n,): normal (three arrays), distance and scale."""
    n, d, scale = unpack_frames(words)
    return [v[block] for v in n], d[block], scale[block]


def fit_frames(s: SampledNodes) -> np.ndarray:
    """Fit the frames of blocks, words (B,): mean normal, best distance, root mean square of the residuals."""
    if not s.structure.blocks:
        return np.zeros(0, np.uint32)
    count = np.bincount(s.block, minlength=s.structure.blocks)

    def mean(v):
        return np.bincount(s.block, v, minlength=s.structure.blocks) / count

    n = np.stack([mean(s.normals[:, a]) for a in range(3)], axis=1)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    n = np.where(length > 1e-3, n / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
    ones = np.ones(len(n))
    n = np.stack(unpack_frames(frame_words(n, 0 * ones, ones))[0], axis=1)
    offsets = middles(s.positions)
    words = frame_words(n, mean(s.distances - np.sum(offsets * n[s.block], axis=1)), ones)
    normals, d, _ = node_frames(words, s.block)
    rest = residuals(s.distances, s.normals, offsets, normals, d, np.ones(len(offsets)))
    size = np.sqrt(mean(np.sum((rest * WEIGHTS) ** 2, axis=1)))
    return frame_words(n, unpack_frames(words)[1], size)


def exact_entries(s: SampledNodes, words: np.ndarray) -> np.ndarray:
    """Return the entries (n, 3) that would reproduce nodes exactly, given the frames of blocks."""
    return residuals(s.distances, s.normals, middles(s.positions), *node_frames(words, s.block))


def cluster(values: np.ndarray, count: int, seed: int = 0, rounds: int = 12, most: int = 2**16) -> np.ndarray:
    """Return ``count`` entries (K, 3) for ``values`` (n, 3) by Lloyd's algorithm on at most ``most`` of them."""
    rng = np.random.default_rng(seed)
    x = values * WEIGHTS
    if len(x) > most:
        x = x[rng.choice(len(x), most, replace=False)]
    entries = x[rng.choice(len(x), count, replace=len(x) < count)].copy()
    for _ in range(rounds):
        nearest = cKDTree(entries).query(x)[1]
        sizes = np.bincount(nearest, minlength=count)
        sums = np.stack([np.bincount(nearest, x[:, a], minlength=count) for a in range(3)], axis=1)
        spare = x[rng.choice(len(x), count)]
        entries = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], spare)
    return entries / WEIGHTS


def assign(values: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """Return the nearest entry of each value, (n,)."""
    return cKDTree(entries * WEIGHTS).query(values * WEIGHTS, workers=-1)[1].astype(np.uint32)


class NodeCoding:
    """Codes of a grid's nodes: ``frames`` of blocks, ``entries`` of the cascaded array, ``pointers`` of nodes.

    No node changes its side, since the stored cells are those in which the signs of nodes change.
    """

    def __init__(self, sampled: SampledNodes, seed: int = 0):
        self.sampled, self.seed = sampled, seed
        self.frames = self.entries = None
        self.pointers = np.zeros(sampled.structure.nodes, np.uint32)
        self.side = np.where(sampled.distances < 0, -1.0, 1.0)

    def encode(self, values: np.ndarray) -> None:
        """Choose the codes of nodes with the ``values`` (n, 4), distances in spacings and normals."""
        nodes = replace(self.sampled, distances=values[:, 0], normals=values[:, 1:])
        self.frames = fit_frames(nodes)
        wanted = exact_entries(nodes, self.frames)
        self.entries = self._choose_entries(wanted)
        self.pointers = assign(wanted, self.entries)
        self._keep_sides(wanted)

    def _choose_entries(self, wanted: np.ndarray) -> np.ndarray:
        """Return the cascaded array (K, 3), float32, for nodes with the exact entries ``wanted`` (n, 3)."""
        entries = cluster(wanted, self.sampled.entries, self.seed)
        # The extreme entries reach far enough for nodes that no other entry would keep on their side
        plane, scale = self._planes
        furthest = np.where(self.side < 0, entries[:, 0].min(), entries[:, 0].max())
        short = self.side * (plane + scale * furthest) < 2 * LEAST
        needed = (2 * LEAST * self.side - plane)[short] / scale[short]
        for extreme, reach in ((np.argmin, np.minimum), (np.argmax, np.maximum)):
            index = extreme(entries[:, 0])
            entries[index, 0] = reach.reduce(needed, initial=entries[index, 0])
        # As words hold them, so that rounding them again changes nothing
        entries = entries.astype(np.float32)
        offset, step = entry_scale(entries)
        rounded = unpack_entries(entry_words(entries, offset, step), offset, step)
        return np.stack(rounded, axis=1).astype(np.float32)

    @functools.cached_property
    def _planes(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance of each node from the plane of its block, in spacings, and the block's scale: (n,) twice."""
        n, d, scale = node_frames(self.frames, self.sampled.block)
        return d + np.sum(np.stack(n, axis=1) * middles(self.sampled.positions), axis=1), scale

    def _distances(self, nodes: np.ndarray, pointers: np.ndarray) -> np.ndarray:
        """Return the distances of ``nodes`` (m,) for ``pointers`` (m, k), positive on the node's side: (m, k)."""
        plane, scale = (v[nodes, None] for v in self._planes)
        return self.side[nodes, None] * (plane + scale * self.entries[pointers, 0])

    def _keep_sides(self, wanted: np.ndarray) -> None:
        """Give nodes that are not far enough on their side the nearest entry with which they are."""
        tree = None
        for part in np.array_split(np.arange(len(wanted)), max(1, len(wanted) // 2**18)):
            wrong = part[self._distances(part, self.pointers[part, None])[:, 0] < LEAST]
            for count in (32, 256, len(self.entries)):
                if not len(wrong):
                    break
                tree = tree or cKDTree(self.entries * WEIGHTS)
                count = min(count, len(self.entries))
                for some in np.array_split(wrong, max(1, len(wrong) * count // 2**24)):
                    near = tree.query(wanted[some] * WEIGHTS, k=count)[1].reshape(len(some), count)
                    far = self._distances(some, near)
                    good = far >= LEAST
                    # If none is far enough, the furthest one on the right side
                    choice = np.where(good.any(axis=1), good.argmax(axis=1), far.argmax(axis=1))
                    self.pointers[some] = near[np.arange(len(some)), choice]
                wrong = wrong[self._distances(wrong, self.pointers[wrong, None])[:, 0] < LEAST]

    @property
    def slope(self) -> float:
        """Bound of the slope of the coded field."""
        values = self.values().astype(np.float64)
        return slope_bound(values[:, 0], values[:, 1:], self.sampled.corners)

    def values(self) -> np.ndarray:
        """Return the coded nodes, decoded, (n, 4) float32."""
        return decode_to_array(self.sampled.structure, self.frames, self.entries[self.pointers])
