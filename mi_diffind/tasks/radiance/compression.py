"""Compression of a grid to density levels and a palette: choice by rate and distortion, training through the images.

Each node stores a density level, a step on a straight line of raw densities, and an index into a palette of colours
that all nodes share.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import drjit as dr
import numpy as np
from scipy.spatial import cKDTree

from ...arrays.indirection import device_array, device_tensor, fold
from ...core.progress import Deadline
from . import grid as grids
from . import node_codes
from .grid import NodeGrid
from .nodes import Nodes, cells_of, corners_of
from .rate_distortion import Importance, chosen_index, chosen_levels
from .session import FieldSession, ViewImages
from .training import ImagesProblem
from .volume_field import NodeField

#: Raw densities of the first and the last density level: empty, and opaque.
EMPTIEST, DENSEST = -7.0, 8.0

#: Bits of a density level, the number of the last level, and the raw density from one level to the next.
DENSITY_BITS = 4
LAST_LEVEL = 2**DENSITY_BITS - 1
LEVEL_STEP = (DENSEST - EMPTIEST) / LAST_LEVEL

#: Most bits of a palette index, those of sizes in memory, and the default.
MOST_BITS, INDEX_BITS, DEFAULT_BITS = 14, (6, 8, 10, 12, 14), 12

#: Weight of a bit for each node against the error of the grid's images: 0.007 is 0.7% of the error a bit. A bit of the
#: levels counts less, since errors of neighbouring densities add up.
SLOPE, LEVEL_SLOPE = 0.007, 0.1

#: Least and largest slope for a size of the file, trials between them, and nodes of a trial. Where a larger slope is
#: needed, a coarser grid is better.
SLOPES, TRIALS, TRIAL_NODES = (1e-3, 0.02), 6, 100_000

#: Side of the columns of nodes that stay together in a trial.
COLUMN = 24

#: Share of the bytes of a file that its palette may have, that of a file before its training, which adds to it, and
#: bytes of a file beside its nodes and its palette.
PALETTE_SHARE, BEFORE_TRAINING, OTHER_BYTES = 0.12, 0.92, 2500

#: Factor of the rate of levels, and how often it is applied, until a trained field has the bytes of its file; then the
#: last interval is halved so often.
STEEPER, MOST_STEEPER, HALVINGS = 1.5, 12, 3

#: Training steps between updates of the range of the palette's bytes.
RANGE_INTERVAL = 50

#: Resolution of the smallest grid, as a share of the full resolution.
SMALLEST = 0.2

#: Nodes per cluster that clusters are computed from, and rounds of Lloyd's algorithm.
SAMPLES, ROUNDS = 60, 8


@dataclass
class PaletteCoding:
    """Palette coding of a grid's ``nodes``.

    ``levels`` ``(n,)`` are densities in [0, 1] between :data:`EMPTIEST` and :data:`DENSEST`; ``index`` ``(n,)``
    (uint32) names a row of ``palette`` ``(P, columns)``. The first entry of both stands for no node. ``weight`` and
    ``rate`` are those of a squared step of a level and of a bit. ``file_bytes`` is the most that the file may have.
    ``environment`` is that of :class:`.NodeGrid`.
    """

    nodes: Nodes
    levels: np.ndarray
    index: np.ndarray
    palette: np.ndarray
    passes: list[node_codes.Pass]
    weight: np.ndarray
    rate: float
    file_bytes: float | None = None
    environment: np.ndarray | None = None

    def chosen(self, levels: np.ndarray) -> np.ndarray:
        """Return whole levels for levels ``(n,)`` in [0, 1], of fewer bits until the file is small enough."""
        exact = levels[1:].astype(np.float64) * LAST_LEVEL

        def at(rate: float) -> tuple[np.ndarray, bool]:
            whole = chosen_levels(self.passes, exact, self.weight, rate, LAST_LEVEL + 1)
            return whole, self.file_bytes is None or self.estimated_bytes(whole) <= self.file_bytes

        low = high = self.rate
        whole, fits = at(low)
        for _ in range(MOST_STEEPER):
            if fits:
                break
            low, high = high, STEEPER * high
            whole, fits = at(high)
        for _ in range(HALVINGS if low < high else 0):
            middle = np.sqrt(low * high)
            smaller, fits = at(middle)
            whole, low, high = (smaller, low, middle) if fits else (whole, middle, high)
        return np.concatenate([[0], whole])

    def estimated_bytes(self, levels: np.ndarray, share: float = 1.0) -> float:
        """Return about the bytes of a file with these whole levels of stored nodes, which are a ``share`` of all."""
        colours = len(self.palette)
        probabilities, data = node_codes.encoded(self.nodes.stored, levels, self.index[1:], LAST_LEVEL + 1, colours)
        shared = self.palette.size + (0 if self.environment is None else 3 * len(self.environment))
        return len(data) / share + len(zlib.compress(probabilities, 9)) + shared + OTHER_BYTES


def palette_coding(
    grid: NodeGrid,
    importance: Importance,
    index_bits: int,
    seed: int,
    slope: float = SLOPE,
    deadline: Deadline | None = None,
) -> PaletteCoding:
    """Return the initial coding of a grid of visible nodes, with fewer rounds of :func:`clusters` at the deadline.

    A bit for each node is worth the share ``slope`` of the error of the grid's images.
    """
    palette = sorted_clusters(grid, importance, 2**index_bits, seed, deadline)
    return coded_by(grid, importance, palette, slope * importance.loss / grid.nodes.count)


def sorted_clusters(
    grid: NodeGrid, importance: Importance, count: int, seed: int, deadline: Deadline | None = None
) -> np.ndarray:
    """Return ``count`` weighted clusters of the colours of a grid, in units of its metric, along a line."""
    palette = clusters(grid.colour[1:] * np.sqrt(importance.metric), importance.colour, count, seed, deadline)
    # Neighbours in the palette look alike: the part of the palette predicts that of the next node
    centred = palette - palette.mean(axis=0)
    return palette[np.argsort(centred @ np.linalg.eigh(centred.T @ centred)[1][:, -1], kind="stable")]


def coded_by(grid: NodeGrid, importance: Importance, palette: np.ndarray, rate: float) -> PaletteCoding:
    """Return the coding of a grid by a palette of :func:`sorted_clusters`; a bit of the file counts ``rate``."""
    metric = np.sqrt(importance.metric)
    points = grid.colour[1:] * metric
    passes = node_codes.passes_of(grid.nodes.stored)
    palette, index = chosen_index(passes, points, importance.colour, palette, rate)
    used, index = np.unique(index, return_inverse=True)
    levels = np.clip((grid.density - EMPTIEST) / (DENSEST - EMPTIEST), 0, 1).astype(np.float32)
    coding = PaletteCoding(
        grid.nodes,
        levels,
        np.concatenate([[0], index]).astype(np.uint32),
        (palette[used] / metric).astype(np.float32),
        passes,
        importance.density * LEVEL_STEP**2,
        LEVEL_SLOPE * rate,
        environment=grid.environment,
    )
    coding.levels = (coding.chosen(levels) / LAST_LEVEL).astype(np.float32)
    return coding


def coding_in(
    grid: NodeGrid, importance: Importance, nbytes: float, seed: int, deadline: Deadline | None = None
) -> PaletteCoding | None:
    """Return a coding of a grid whose file has at most ``nbytes`` once it is trained, or ``None`` if there is none.

    The number of colours follows from ``nbytes``, the slope from trials with a part of the nodes.
    """
    colours = int(np.clip(PALETTE_SHARE * nbytes / grid.colour.shape[1], 2 ** INDEX_BITS[0], 2**DEFAULT_BITS))
    palette = sorted_clusters(grid, importance, colours, seed, deadline)
    per_node = importance.loss / grid.nodes.count
    part, weights = trial_part(grid, importance)
    share = part.nodes.count / grid.nodes.count

    def size(slope: float) -> float:
        coding = coded_by(part, weights, palette, slope * per_node)
        return coding.estimated_bytes(np.rint(coding.levels[1:] * LAST_LEVEL).astype(int), share)

    low, high = np.log(SLOPES)
    if size(np.exp(high)) > BEFORE_TRAINING * nbytes:
        return None
    for _ in range(TRIALS):
        middle = (low + high) / 2
        fits = size(np.exp(middle)) <= BEFORE_TRAINING * nbytes
        low, high = (low, middle) if fits else (middle, high)
    coding = coded_by(grid, importance, palette, np.exp(high) * per_node)
    coding.file_bytes = nbytes
    return coding


def trial_part(grid: NodeGrid, importance: Importance) -> tuple[NodeGrid, Importance]:
    """Return random columns of a grid with about :data:`TRIAL_NODES` nodes, and their importance."""
    nodes = grid.nodes
    side = -(-max(nodes.shape) // COLUMN)
    x, y = (np.arange(n) // COLUMN for n in nodes.shape[:2])
    column = x[:, None] * side + y
    counts = np.bincount(column.ravel(), nodes.stored.sum(axis=2).ravel(), side * side)
    order = np.random.default_rng(0).permutation(np.flatnonzero(counts))
    last = np.searchsorted(np.cumsum(counts[order]), TRIAL_NODES)
    chosen = np.zeros(side * side, bool)
    chosen[order[: last + 1]] = True
    # Nodes of cells that other columns cut are left out: a file holds corners of whole cells
    stored = corners_of(cells_of(nodes.stored & chosen[column][..., None]))
    here = stored[nodes.stored]
    part = nodes.like(nodes.spacing, nodes.shape, stored)
    entries = np.concatenate([[True], here])
    weights = Importance(importance.density[here], importance.colour[here], importance.metric, importance.loss)
    return NodeGrid(part, grid.density[entries], grid.colour[entries], grid.environment), weights


def clusters(
    points: np.ndarray, weight: np.ndarray, count: int, seed: int, deadline: Deadline | None = None
) -> np.ndarray:
    """Return ``count`` centres of clusters of ``points`` ``(n, c)``, whose squared distances count ``weight`` ``(n,)``.

    They are found by Lloyd's algorithm on random points, in :data:`ROUNDS` rounds unless the deadline passes.
    """
    rng = np.random.default_rng(seed)
    count = min(count, len(points))
    # Likelier by the root of the weight: many points of little weight do not get centres of their own
    chance = np.sqrt(np.maximum(weight, 1e-6 * weight.max()))
    chance /= chance.sum()
    centres = points[rng.choice(len(points), count, replace=False, p=chance)]
    sample = rng.choice(len(points), min(len(points), SAMPLES * count), replace=False, p=chance)
    share = weight[sample] / chance[sample]
    for _ in range(ROUNDS):
        if deadline is not None and deadline.passed:
            break
        nearest = cKDTree(centres).query(points[sample])[1]
        total = np.bincount(nearest, share, count)
        sums = np.stack([np.bincount(nearest, share * column, count) for column in points[sample].T], axis=1)
        # A centre without points restarts at a random one
        spare = points[rng.choice(sample, count)]
        centres = np.where(total[:, None] > 0, sums / np.maximum(total, 1e-300)[:, None], spare)
    return centres


class PaletteProblem(ImagesProblem):
    """Training of a :class:`PaletteCoding` through the images of a session.

    Density levels and palette are rounded as they are stored, with straight-through gradients. Indices are constant. At
    the end, levels are chosen by rate and distortion again.
    """

    def __init__(self, coding: PaletteCoding, session: FieldSession):
        types = coding.nodes.types
        self.coding, self.index = coding, device_array(types.UInt32, coding.index)
        net = {"density": coding.levels, "palette": coding.palette}
        if coding.environment is not None:
            net["environment"] = coding.environment
        net = {name: device_tensor(types.TensorXf, values) for name, values in net.items()}
        super().__init__(session, net, self.field_of)
        self._set_ranges()

    def field_of(self, net) -> NodeField:
        """Return the field of the trained parameters, rounded as it is stored."""
        tensor = self.session.types.TensorXf
        level = fold(net["density"].array) * LAST_LEVEL
        level += dr.detach(dr.round(level) - level)
        shared = {name: self.rounded(net[name], *self.ranges[name]) for name in self.ranges}
        density = dr.fma(level, LEVEL_STEP, EMPTIEST)
        palette, environment = shared["palette"], shared.get("environment")
        return NodeField(self.coding.nodes, tensor(density), palette, self.index, environment)

    def rounded(self, table, scale, offset):
        """Return a table with the numbers that bytes stand for, and straight-through gradients."""
        types = self.session.types
        lane = dr.arange(types.UInt32, dr.width(table.array)) % table.shape[1]
        scale, offset = (dr.gather(types.Float, v, lane) for v in (scale, offset))
        exact = dr.detach(table.array)
        stored = dr.fma(dr.round((exact - offset) / scale), scale, offset)
        return type(table)(table.array + dr.detach(stored - exact), table.shape)

    def begin(self, step, share):
        # Until the next update, numbers beyond the range are rounded to steps outside of it
        if step % RANGE_INTERVAL == 0:
            self._set_ranges()
        return ""

    def _set_ranges(self) -> None:
        names, Float = [name for name in ("palette", "environment") if name in self.net], self.session.types.Float
        self.ranges = {n: [device_array(Float, v) for v in byte_range(self.net[n].numpy())] for n in names}

    def stored(self) -> dict[str, np.ndarray]:
        """Return what is stored: ``levels``, ``index``, ``palette`` (bytes), its ``scale`` and ``offset``.

        ``density_range`` holds the raw density of level 0 and the step from one level to the next, ``density_bits`` the
        bits of a level. ``environment`` (bytes, ``(e, 3)``) and its ``environment_range``, steps and offsets, are there
        if the colours have reflections.
        """
        palette, scale, offset = as_bytes(self.net["palette"].numpy())
        shared = {}
        if "environment" in self.net:
            environment, *ranges = as_bytes(self.net["environment"].numpy()[:, :3])
            shared = {"environment": environment, "environment_range": ranges}
        return {
            "levels": self.coding.chosen(fold(self.net["density"].array).numpy()).astype(np.uint8),
            "density_range": (EMPTIEST, LEVEL_STEP),
            "density_bits": DENSITY_BITS,
            "index": self.coding.index,
            "palette": palette,
            "scale": scale,
            "offset": offset,
            **shared,
        }


def byte_range(palette: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the quantisation step and the minimum of each column of a palette, as bytes store it."""
    low, high = palette.min(axis=0).astype(np.float64), palette.max(axis=0).astype(np.float64)
    return np.maximum((high - low) / 255, 1e-6), low


def as_bytes(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the bytes of numbers ``(n, c)``, and the step and the minimum of each column (:func:`byte_range`)."""
    scale, offset = byte_range(values)
    return np.clip(np.rint((values - offset) / scale), 0, 255).astype(np.uint8), scale, offset


def packed_bytes(grid: NodeGrid, index_bits: int) -> int:
    """Return the bytes in memory of the packed field of a grid."""
    nodes = grid.nodes
    index = nodes.like(nodes.spacing, nodes.shape, nodes.stored, packed=True).nbytes
    index += 0 if grid.environment is None else 4 * len(grid.environment)
    return (
        index
        + nodes.entries * (DENSITY_BITS + index_bits) // 8
        + 8
        + 16 * -(-grid.colour.shape[1] // 16) * min(2**index_bits, nodes.count)
    )


def sized(grid: NodeGrid, images: ViewImages, nbytes: int | None) -> tuple[NodeGrid, int]:
    """Return the visible part of a grid at the highest resolution that fits in ``nbytes``, and its bits of an index.

    At the full resolution, an index has as many bits as fit; at a lower one, 10, or 8 if these do not fit. With
    ``None``, the resolution and the bits are the default. Raises ``ValueError`` if no grid fits.
    """
    cells = grids.visible(grid, images)
    whole = grids.divided(grid, cells)
    if nbytes is None:
        return whole, DEFAULT_BITS
    for bits in sorted(INDEX_BITS, reverse=True):
        if bits >= 8 and packed_bytes(whole, bits) <= nbytes:
            return whole, bits
    low, high, largest = SMALLEST, 1.0, None
    for _ in range(7):
        middle = (low + high) / 2
        smaller = grids.divided(grid, cells, middle)
        bits = 10 if packed_bytes(smaller, 10) <= nbytes else 8
        if packed_bytes(smaller, bits) <= nbytes:
            low, largest = middle, (smaller, bits)
        else:
            high = middle
    if largest is None:
        smallest = packed_bytes(grids.divided(grid, cells, SMALLEST), 6)
        raise ValueError(f"{nbytes:,} bytes are fewer than the smallest field needs, about {smallest:,}")
    return largest
