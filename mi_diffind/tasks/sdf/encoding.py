"""From a mesh to a sparse grid: which nodes, their distances and normals, the frames of blocks, the cascaded array."""

from __future__ import annotations

import functools
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
WEIGHTS = np.array([DISTANCE_WEIGHT, 1, 1])

#: How far, in spacings, every node stays on its side at least.
LEAST = 0.01

#: How often nodes are moved, at most, to keep the surface within the stored cells.
REPAIRS = 12


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
    #: Cells that the surface passes through or close by, and the share of them in which no sign changes.
    cells: int
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
    structure = build(nodes, d < 0, shape + 1, lower, spacing, distances.inside, distances.unsigned)
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
        back[corners], len(cells), 1 - len(corners) / max(1, len(cells)),
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
    size = np.sqrt(mean(np.sum((rest * WEIGHTS) ** 2, axis=1)))
    return codes.frame_words(n, d, size)


def targets(s: Sampled, words: np.ndarray) -> np.ndarray:
    """What the entries of nodes ought to be, (n, 3), given the frames of blocks."""
    n, d, scale = (v[s.block] for v in codes.frames_numpy(words))
    return codes.residuals(s.distances, s.normals, middles(s.positions), n, d, scale)


def cluster(values: np.ndarray, count: int, seed: int = 0, rounds: int = 12, most: int = 2**16) -> np.ndarray:
    """``count`` entries (K, 3) for ``values`` (n, 3): Lloyd's algorithm on at most ``most`` of them."""
    rng = np.random.default_rng(seed)
    x = values * WEIGHTS
    if len(x) > most:
        x = x[rng.choice(len(x), most, replace=False)]
    entries = x[rng.choice(len(x), count, replace=len(x) < count)].copy()
    for _ in range(rounds):
        nearest = cKDTree(entries).query(x)[1]
        found = np.bincount(nearest, minlength=count)
        sums = np.stack([np.bincount(nearest, x[:, a], minlength=count) for a in range(3)], axis=1)
        spare = x[rng.choice(len(x), count)]
        entries = np.where(found[:, None] > 0, sums / np.maximum(found, 1)[:, None], spare)
    return entries / WEIGHTS


def assign(values: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """The nearest entry of each value, (n,)."""
    return cKDTree(entries * WEIGHTS).query(values * WEIGHTS, workers=-1)[1].astype(np.uint32)


class Coding:
    """
    The codes of a grid's nodes, decided on little by little while the nodes are trained: the ``frames`` of blocks and
    the ``entries`` of the cascaded array once, then a ``pointer`` for more and more nodes (``done``). Those that are
    left make up for what rounding the others did.

    No node changes its side: the cells that are stored are those in which the signs of nodes change. Nor does the
    surface leave them: where a stored cell borders on one that is not, nodes are moved until its side holds.
    """

    def __init__(self, sampled: Sampled, bits: int, seed: int = 0):
        self.sampled, self.bits, self.seed = sampled, bits, seed
        count = sampled.structure.nodes
        self.frames = self.entries = None
        self.pointers, self.done = np.zeros(count, np.uint32), np.zeros(count, bool)
        self.side = np.where(sampled.distances < 0, -1.0, 1.0)
        #: How far on its side each node has to be, in spacings
        self.least = np.full(count, LEAST)

    def commit(self, values: np.ndarray, share: float) -> None:
        """Decide on the codes of nodes with the values (n, 4), until a ``share`` of all has one."""
        at = replace(self.sampled, distances=values[:, 0], normals=values[:, 1:])
        if self.frames is None:
            self.frames = fit_frames(at)
        wanted = targets(at, self.frames)
        if self.entries is None:
            self.entries = self._chosen(wanted)
        order = np.random.default_rng([self.seed, 1]).random(len(values))
        now = np.flatnonzero((order < share) & ~self.done)
        self.pointers[now] = assign(wanted[now], self.entries)
        self.done[now] = True
        self._keep_sides(wanted, now)
        if share >= 1:
            before = None
            for _ in range(REPAIRS):
                moved = self._hold_borders()
                if before is not None and np.array_equal(moved, before):  # as far as their blocks let them
                    break
                self._keep_sides(wanted, moved)
                before = moved

    def _chosen(self, wanted: np.ndarray) -> np.ndarray:
        """The entries for nodes that ought to have the ``wanted`` ones (n, 3): (K, 3), float32."""
        entries = cluster(wanted, max(1, min(2**self.bits, len(wanted))), self.seed)
        # As far as nodes have to go that no entry would keep on their side
        plane, scale = self._planes
        furthest = np.where(self.side < 0, entries[:, 0].min(), entries[:, 0].max())
        short = self.side * (plane + scale * furthest) < 2 * LEAST
        needed = (2 * LEAST * self.side - plane)[short] / scale[short]
        for extreme, reach in ((np.argmin, np.minimum), (np.argmax, np.maximum)):
            which = extreme(entries[:, 0])
            entries[which, 0] = reach.reduce(needed, initial=entries[which, 0])
        return rounded_entries(entries)

    @functools.cached_property
    def _planes(self) -> tuple[np.ndarray, np.ndarray]:
        """How far each node is from the plane of its block, in spacings, and the block's scale: (n,) twice."""
        n, d, scale = (v[self.sampled.block] for v in codes.frames_numpy(self.frames))
        return d + np.sum(n * middles(self.sampled.positions), axis=1), scale

    def _distances(self, nodes: np.ndarray, pointers: np.ndarray) -> np.ndarray:
        """Distances of ``nodes`` (m,), on their side positive, if they had the ``pointers`` (m, k). (m, k)."""
        plane, scale = (v[nodes, None] for v in self._planes)
        return self.side[nodes, None] * (plane + scale * self.entries[pointers, 0])

    def _keep_sides(self, wanted: np.ndarray, nodes: np.ndarray) -> None:
        """Give ``nodes`` that are not far enough on their side the nearest entry with which they are."""
        tree = None
        for part in np.array_split(nodes, max(1, len(nodes) // 2**18)):
            wrong = part[self._distances(part, self.pointers[part, None])[:, 0] < self.least[part]]
            for count in (32, 256, len(self.entries)):
                if not len(wrong):
                    break
                tree = tree or cKDTree(self.entries * WEIGHTS)
                count = min(count, len(self.entries))
                for some in np.array_split(wrong, max(1, len(wrong) * count // 2**24)):
                    near = tree.query(wanted[some] * WEIGHTS, k=count)[1].reshape(len(some), count)
                    far = self._distances(some, near)
                    good = far >= self.least[some, None]
                    # None at all: the one that is furthest on the right side
                    choice = np.where(good.any(axis=1), good.argmax(axis=1), far.argmax(axis=1))
                    self.pointers[some] = near[np.arange(len(some)), choice]
                wrong = wrong[self._distances(wrong, self.pointers[wrong, None])[:, 0] < self.least[wrong]]

    @functools.cached_property
    def _borders(self) -> tuple[np.ndarray, np.ndarray]:
        """
        The sides of stored cells behind which there is none: their cell's nodes, turned so that the side is where the
        first coordinate is 0 (m, 2, 2, 2), and the axis that they are turned from (m,).
        """
        corners, positions = self.sampled.corners.reshape(-1, 2, 2, 2), self.sampled.positions
        cell = positions[corners[:, 0, 0, 0]].astype(np.int64)
        shape = np.array(self.sampled.structure.shape) + 2
        key = np.ravel_multi_index((cell + 1).T, shape)
        order = np.sort(key)
        found, which = [], []
        for axis in range(3):
            for end in (0, 1):
                beside = cell + 1
                beside[:, axis] += 2 * end - 1
                other = np.ravel_multi_index(beside.T, shape)
                place = np.minimum(np.searchsorted(order, other), len(order) - 1)
                alone = np.flatnonzero(order[place] != other)
                turned = np.moveaxis(corners[alone], 1 + axis, 1)
                found.append(turned[:, ::-1] if end else turned)
                which.append(np.full(len(alone), axis))
        return np.concatenate(found), np.concatenate(which)

    def _hold_borders(self) -> np.ndarray:
        """Where the surface leaves the stored cells: demand more of these nodes. Which they are."""
        cells, which = self._borders
        values = self.values().astype(np.float64)
        u = np.linspace(0, 1, 9)
        lines = np.stack([1 - u, u])
        lowest = np.empty(len(cells))
        for part in np.array_split(np.arange(len(cells)), max(1, len(cells) // 2**14)):
            axis = which[part]
            face = cells[part][:, 0]  # (m, 2, 2)
            d, g = values[face, 0], values[face, 1:]
            others = np.array([[1, 2], [0, 2], [0, 1]])[axis]
            along = [np.take_along_axis(g, others[:, None, None, k : k + 1], axis=3)[..., 0] for k in (0, 1)]
            total = 0.0
            for a in (0, 1):
                for b in (0, 1):
                    offset = 0.5 * (
                        along[0][:, a, b, None, None] * (u - a)[:, None] + along[1][:, a, b, None, None] * (u - b)
                    )
                    total = total + lines[a][:, None] * lines[b] * (d[:, a, b, None, None] + offset)
            lowest[part] = (self.side[face[:, 0, 0], None, None] * total).min(axis=(1, 2))
        broken = lowest < 0.5 * LEAST
        nodes = cells[broken][:, 0].reshape(-1, 4)
        short = np.repeat(LEAST - lowest[broken], 4)
        values_of = self._distances(nodes.reshape(-1), self.pointers[nodes.reshape(-1), None])[:, 0]
        np.maximum.at(self.least, nodes.reshape(-1), values_of + short)
        return np.unique(nodes)

    def values(self) -> np.ndarray:
        """The nodes that the pointers stand for, (n, 4), float32."""
        return decoded_nodes(self.sampled.structure, self.frames, self.entries[self.pointers])

    def state(self) -> dict[str, np.ndarray]:
        """For a checkpoint; :meth:`restore` is the reverse."""
        if self.frames is None:
            return {}
        return {"frames": self.frames, "entries": self.entries, "pointers": self.pointers, "done": self.done}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        vars(self).pop("_planes", None)
        for name, value in state.items():
            setattr(self, name, value.copy())


def rounded_entries(entries: np.ndarray) -> np.ndarray:
    """Entries as words hold them, float32, so that rounding them again changes nothing."""
    entries = entries.astype(np.float32)
    offset, step = codes.entry_scale(entries)
    return codes.entries_numpy(codes.entry_words(entries, offset, step), offset, step).astype(np.float32)
