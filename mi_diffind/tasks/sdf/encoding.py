"""From a mesh to a sparse grid: which nodes, their distances and normals, the frames of blocks, the cascaded array."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from . import codes
from .cells import near_nodes, surface_cells
from .distances import Distances
from .nodes import decoded_nodes, middles
from .structure import Structure, build

#: Weight of a distance (in spacings) against a normal in choosing entries.
DISTANCE_WEIGHT = 5.0


@dataclass
class Sampled:
    """
    The nodes of a sparse grid as they were sampled: their ``structure``, ``positions`` in it (n, 3), ``block`` (n,),
    ``distances`` in spacings (n,), ``normals`` (n, 3), and the ``corners`` of its cells (K, 8), z fastest.
    """

    structure: Structure
    positions: np.ndarray
    block: np.ndarray
    distances: np.ndarray
    normals: np.ndarray
    corners: np.ndarray
    #: Share of the cells that the surface may pass through without a change of sign: too thin for the grid
    missed: float


def sample(distances: Distances, spacing: float) -> Sampled:
    """The nodes of a grid of this ``spacing`` (of the longest side) around the mesh of ``distances``."""
    mesh = distances.mesh
    lower = mesh.lower - 1.5 * spacing
    shape = np.ceil((mesh.upper + 1.5 * spacing - lower) / spacing).astype(int)
    cells = surface_cells(distances, lower, spacing, shape)
    nodes, corners = near_nodes(cells)
    d, normals = distances.signed_normals(lower + spacing * nodes)
    crossed = (d < 0)[corners]
    keep = crossed.any(axis=1) & ~crossed.all(axis=1)
    used, corners = np.unique(corners[keep], return_inverse=True)
    corners = corners.reshape(-1, 8)
    nodes, d, normals = nodes[used], d[used], normals[used]
    structure = build(
        nodes, d < 0, shape + 1, lower, spacing, distances.inside, lambda p: distances.unsigned(p).astype(np.float64)
    )
    # In the order of the structure
    positions, block = structure.node_positions()

    def key(p):
        return np.ravel_multi_index(np.asarray(p, np.int64).T, structure.shape)

    order = np.argsort(key(nodes))
    place = order[np.searchsorted(key(nodes), key(positions), sorter=order)]
    back = np.empty_like(place)
    back[place] = np.arange(len(place))
    return Sampled(
        structure, positions, block, d[place].astype(np.float64) / spacing, normals[place].astype(np.float64),
        back[corners], 1 - len(corners) / max(1, len(cells)),
    )  # fmt: skip


def fit_frames(s: Sampled) -> np.ndarray:
    """The frames of blocks, words (B,): mean normal, best distance, root mean square of what remains."""
    if not s.structure.blocks:
        return np.zeros(0, np.uint32)
    count = np.bincount(s.block, minlength=s.structure.blocks)

    def mean(v):
        return np.bincount(s.block, v, minlength=s.structure.blocks) / count

    n = np.stack([mean(s.normals[:, a]) for a in range(3)], axis=1)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    n = np.where(length > 1e-3, n / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
    ones = np.ones(len(n))
    n = codes.frames_numpy(codes.frame_words(n, 0 * ones, ones))[0]
    offsets = middles(s.positions)
    words = codes.frame_words(n, mean(s.distances - np.sum(offsets * n[s.block], axis=1)), ones)
    n, d, _ = codes.frames_numpy(words)
    rest = codes.residuals(s.distances, s.normals, offsets, n[s.block], d[s.block], np.ones(len(offsets)))
    size = np.sqrt(mean(np.sum((rest * [DISTANCE_WEIGHT, 1, 1]) ** 2, axis=1)))
    return codes.frame_words(n, d, size)


def targets(s: Sampled, words: np.ndarray) -> np.ndarray:
    """What the entries of nodes ought to be, (n, 3), given the frames of blocks."""
    n, d, scale = (v[s.block] for v in codes.frames_numpy(words))
    return codes.residuals(s.distances, s.normals, middles(s.positions), n, d, scale)


def cluster(values: np.ndarray, count: int, seed: int = 0, rounds: int = 12, most: int = 2**16) -> np.ndarray:
    """``count`` entries (K, 3) for ``values`` (n, 3): Lloyd's algorithm on at most ``most`` of them."""
    rng = np.random.default_rng(seed)
    x = values * [DISTANCE_WEIGHT, 1, 1]
    if len(x) > most:
        x = x[rng.choice(len(x), most, replace=False)]
    entries = x[rng.choice(len(x), count, replace=len(x) < count)].copy()
    for _ in range(rounds):
        nearest = cKDTree(entries).query(x)[1]
        found = np.bincount(nearest, minlength=count)
        sums = np.stack([np.bincount(nearest, x[:, a], minlength=count) for a in range(3)], axis=1)
        spare = x[rng.choice(len(x), count)]
        entries = np.where(found[:, None] > 0, sums / np.maximum(found, 1)[:, None], spare)
    return entries / [DISTANCE_WEIGHT, 1, 1]


def assign(values: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """The nearest entry of each value, (n,)."""
    weights = [DISTANCE_WEIGHT, 1, 1]
    return cKDTree(entries * weights).query(values * weights, workers=-1)[1].astype(np.uint32)


class Coding:
    """
    The codes of a grid's nodes, decided on little by little while the nodes are trained: the ``frames`` of blocks and
    the ``entries`` of the cascaded array once, then a ``pointer`` for more and more nodes (``done``). Those that are
    left make up for what rounding the others did.
    """

    def __init__(self, sampled: Sampled, bits: int, seed: int = 0):
        self.sampled, self.bits, self.seed = sampled, bits, seed
        count = sampled.structure.nodes
        self.frames = self.entries = None
        self.pointers, self.done = np.zeros(count, np.uint32), np.zeros(count, bool)

    def commit(self, values: np.ndarray, share: float) -> None:
        """Decide on the codes of nodes with the values (n, 4), until a ``share`` of all has one."""
        at = replace(self.sampled, distances=values[:, 0], normals=values[:, 1:])
        if self.frames is None:
            self.frames = fit_frames(at)
            count = max(1, min(2**self.bits, len(values)))
            self.entries = rounded_entries(cluster(targets(at, self.frames), count, self.seed))
        order = np.random.default_rng([self.seed, 1]).random(len(values))
        now = (order < share) & ~self.done
        self.pointers[now] = assign(targets(at, self.frames)[now], self.entries)
        self.done |= now

    def values(self) -> np.ndarray:
        """The nodes that the pointers stand for, (n, 4), float32."""
        return decoded_nodes(self.sampled.structure, self.frames, self.entries[self.pointers])

    def state(self) -> dict[str, np.ndarray]:
        """For a checkpoint; :meth:`restore` is the reverse."""
        if self.frames is None:
            return {}
        return {"frames": self.frames, "entries": self.entries, "pointers": self.pointers, "done": self.done}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        for name, value in state.items():
            setattr(self, name, value.copy())


def rounded_entries(entries: np.ndarray) -> np.ndarray:
    """Entries as words hold them, float32, so that rounding them again changes nothing."""
    entries = entries.astype(np.float32)
    offset, step = codes.entry_scale(entries)
    top = 2 ** np.array(codes.ENTRY_BITS) - 1
    whole = np.clip(np.round((entries - offset) / step), 0, top)
    return (offset + whole * step).astype(np.float32)
