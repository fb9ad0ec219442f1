"""Compression of a grid to density levels and a palette of colours, by rate and distortion.

Each node stores a density level, a step on a straight line of raw densities, and an index into a palette of colours
that all nodes share. Levels and indices are chosen, pass by pass, by what a change costs the images plus a rate times
the bits of a symbol in its context (:mod:`.coding`). The cost of a change is the diagonal of the Gauss-Newton matrix:
the sum of squared derivatives of the images' sRGB values, estimated by derivatives of sums with random signs
(Hutchinson). The palette and the levels are then trained through the images.
"""

import zlib
from dataclasses import dataclass

import drjit as dr
import numpy as np
from scipy.spatial import cKDTree

from ...arrays.indirection import device_array, device_tensor, fold
from ...arrays.sparse_grid import cell_corners, complete_cells
from ...arrays.tables import StoredArray
from ...core.progress import Deadline
from ...core.units import largest_fitting
from . import grid as grids
from .coding import LOW_BITS, NAMED, NAMED_CONTEXTS, PARTS, Pass, encode, fresh_context, naming, passes_of
from .grid import NodeGrid
from .march import differentiable
from .nodes import Nodes
from .session import FieldSession, ImagesProblem, ViewImages, before
from .volume_field import NodeField, PaletteArrays

#: Rays of an estimate of importance that are followed at a time.
RAYS = 2**16

#: Count that a symbol has before it occurs.
LEAST_COUNT = 0.05

#: Rounds of choosing levels.
LEVEL_ROUNDS = 3

#: Raw densities of the first and the last density level: empty, and opaque.
EMPTIEST, DENSEST = -7.0, 8.0

#: Bits of a density level, the number of the last level, and the raw density from one level to the next.
DENSITY_BITS = 4
LAST_LEVEL = 2**DENSITY_BITS - 1
LEVEL_STEP = (DENSEST - EMPTIEST) / LAST_LEVEL

#: Most bits of a palette index, those of sizes in memory, and the default.
MOST_BITS, INDEX_BITS, DEFAULT_BITS = 14, (6, 8, 10, 12, 14), 12

#: Weight of a bit for each node against the error of the grid's images: 0.007 is 0.7% of the error a bit.
SLOPE = 0.007

#: Least and largest slope for a size of the file. Where a larger slope is needed, a coarser grid is better.
SLOPES = (1e-3, 0.02)

#: Nodes of the trial of a slope for a size of the file.
TRIAL_NODES = 100_000

#: Side of the columns of nodes that stay together in a trial.
COLUMN = 24

#: Bytes of a file beside its nodes and its palette.
OTHER_BYTES = 2500

#: Resolution of the smallest grid, as a share of the full resolution.
SMALLEST = 0.2

#: Rounds of Lloyd's algorithm.
ROUNDS = 8


@dataclass
class Importance:
    """Cost of a change of the numbers of stored nodes: the mean squared error of the images per squared change.

    ``density`` ``(n,)`` is that of raw densities, ``colour`` ``(n,)`` that of colours in units in which ``metric``
    ``(columns,)`` is the weight of each column. ``loss`` is the mean squared error of the grid itself.
    """

    density: np.ndarray
    colour: np.ndarray
    metric: np.ndarray
    loss: float


def importance(grid: NodeGrid, session: FieldSession, seed: int, deadline: Deadline | None = None) -> Importance:
    """Return the importance of the nodes of a grid in the training views; at the deadline, from fewer rays."""
    types, images, views = session.types, session.images, session.views
    net = grid.tensors()
    environment = net.pop("environment", None)
    squares = [dr.zeros(types.Float, v.size) for v in (grid.density, grid.colour)]
    # Rays for each pixel of the training views
    batches = max(8, round(0.2 * len(views) * views.mean_pixels / RAYS))
    loss, count = 0.0, 0
    for batch in range(batches):
        if deadline is not None and deadline.passed and count:
            break
        rng = dr.rng((seed << 32) + batch)
        view, x, y = images.random_pixels(rng, RAYS)
        rays = dr.width(view)
        offset, behind = rng.random(types.TensorXf, (rays,)).array, images.behind(rng, rays)
        arrays = {name: type(tensor)(tensor) for name, tensor in net.items()}
        dr.enable_grad(arrays)
        field = NodeField(grid.nodes, **arrays, environment=environment).for_training()
        seen = differentiable(field, *images.rays(view, x, y), 0, dr.inf, True, offset)
        total, error = types.Float(0), types.Float(0)
        for shown, reference in before(seen, images.colours(view, x, y), behind):
            error += dr.square(dr.detach(shown) - reference)
            total += dr.select(rng.random(types.TensorXf, (rays,)).array < 0.5, shown, -shown)
        counted = images.counted(view, x, y)
        dr.backward(dr.select(counted, total, 0))
        squares = [dr.fma(g, g, s) for g, s in zip((dr.grad(a).array for a in arrays.values()), squares, strict=True)]
        error = dr.sum(dr.select(counted, error, 0))
        dr.eval(squares, error)
        loss, count = loss + float(error[0]), count + rays
    density, colour = (s.numpy().astype(np.float64) / (3 * count) for s in squares)
    colour = colour.reshape(grid.colour.shape)[1:]
    metric = np.maximum(colour.mean(axis=0), 1e-30)
    return Importance(density[1:], (colour / metric).mean(axis=1), metric, loss / (3 * count))


def costs(counts: np.ndarray) -> np.ndarray:
    """Return the bits of symbols by their counts ``(contexts, symbols)``."""
    counts = counts + LEAST_COUNT
    return -np.log2(counts / counts.sum(axis=1, keepdims=True))


def level_costs(levels: np.ndarray, context: np.ndarray, count: int) -> np.ndarray:
    """Return the bits of each level in each context of :meth:`.coding.Pass.level_context`.

    Rare contexts resemble others of the same variance: the level relative to the mean counts.
    """
    contexts = 7 * count + 1
    counts = np.bincount(context * count + levels, minlength=contexts * count).reshape(contexts, count).astype(float)
    mean, spread = np.arange(contexts) // 7, np.arange(contexts) % 7
    relative = np.full((7, 2 * count), LEAST_COUNT)
    known = context < 7 * count
    np.add.at(relative, (context[known] % 7, levels[known] - context[known] // 7 + count), 1.0)
    prior = relative[spread[:, None], np.arange(count) - np.minimum(mean, count - 1)[:, None] + count]
    # Counts that a context has before it occurs, shared by all contexts of a variance
    return costs(counts + 20.0 * prior / prior.sum(axis=1, keepdims=True))


def choose_levels(passes: list[Pass], exact: np.ndarray, weight: np.ndarray, rate: float, count: int) -> np.ndarray:
    """Return the levels of nodes, below ``count``, given ``exact`` ones.

    A squared difference counts ``weight`` ``(n,)`` and a bit of the file ``rate``.
    """
    levels = np.clip(np.rint(exact), 0, count - 1).astype(np.int64)
    every = np.arange(count)
    for turn in range(LEVEL_ROUNDS):
        tables = [level_costs(levels[p.rows], p.level_context(levels, count), count) for p in passes]
        for part, table in zip(passes, tables, strict=True):
            rows = part.rows
            difference = weight[rows, None] * np.square(exact[rows, None] - every)
            share = rate * (turn + 1) / LEVEL_ROUNDS
            levels[rows] = np.argmin(difference + share * table[part.level_context(levels, count)], axis=1)
    return levels


def index_costs(passes: list[Pass], index: np.ndarray, colours: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Return the bits of symbols that name an index of a neighbour, for each pass by context and symbol.

    The second array holds the bits of an index that no neighbour has, by context and index. Both are estimated from the
    counts of a whole ``index``.
    """
    upper = ((colours - 1) >> LOW_BITS) + 1
    named, fresh, context = [], [], []
    for part in passes:
        names, place = part.named(index)
        symbol = naming(names, index, part.rows)
        counts = np.bincount(place * (NAMED + 1) + symbol, minlength=NAMED_CONTEXTS * (NAMED + 1))
        named.append(costs(counts.reshape(-1, NAMED + 1)))
        new = symbol == NAMED
        fresh.append(index[part.rows][new])
        context.append(fresh_context(names[new], colours))
    fresh, context = np.concatenate(fresh), np.concatenate(context)
    high = np.bincount(context * upper + (fresh >> LOW_BITS), minlength=(PARTS + 1) * upper)
    low = np.bincount(fresh, minlength=upper << LOW_BITS).reshape(upper, -1)
    return named, costs(high.reshape(PARTS + 1, upper)).repeat(1 << LOW_BITS, axis=1) + costs(low).reshape(-1)


def choose_index(
    passes: list[Pass], points: np.ndarray, weight: np.ndarray, centres: np.ndarray, rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ``centres`` ``(P, c)``, moved, and the index of a centre for each of the ``points`` ``(n, c)``.

    A squared difference counts ``weight`` ``(n,)`` and a bit of the file ``rate``. The search begins with the nearest
    centres.
    """
    colours, near, index = len(centres), min(8, len(centres)), None  # nearest colours that are tried
    for _ in range(2):
        nearest = cKDTree(centres).query(points, k=near, eps=0.3)[1].reshape(len(points), near)
        index = nearest[:, 0].astype(np.int64) if index is None else index
        bits, fresh_bits = index_costs(passes, index, colours)
        for part, named in zip(passes, bits, strict=True):
            names, context = part.named(index)
            fresh = fresh_bits[fresh_context(names, colours)[:, None], nearest[part.rows]]
            tried = np.concatenate([names, nearest[part.rows]], axis=1)
            price = np.concatenate([named[context, :NAMED], named[context, NAMED, None] + fresh], axis=1)
            best, pick = np.full(len(tried), np.inf), np.zeros(len(tried), np.int64)
            for column, bit in zip(tried.T, price.T, strict=True):
                away = np.square(points[part.rows] - centres[np.maximum(column, 0)]).sum(axis=1)
                cost = np.where(column >= 0, weight[part.rows] * away + rate * bit, np.inf)
                better = cost < best
                best[better], pick[better] = cost[better], column[better]
            index[part.rows] = pick
        centres = weighted_means(points, weight, index, centres)
    return centres, index


def weighted_means(points: np.ndarray, weight: np.ndarray, index: np.ndarray, empty: np.ndarray) -> np.ndarray:
    """Return the weighted mean of the points of each cluster, or its row of ``empty`` where a cluster has none."""
    total = np.bincount(index, weight, len(empty))
    sums = np.stack([np.bincount(index, weight * column, len(empty)) for column in points.T], axis=1)
    return np.where(total[:, None] > 0, sums / np.maximum(total, 1e-300)[:, None], empty)


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
    passes: list[Pass]
    weight: np.ndarray
    rate: float
    environment: np.ndarray | None = None
    file_bytes: float | None = None

    def whole_levels(self, levels: np.ndarray) -> np.ndarray:
        """Return whole levels for levels ``(n,)`` in [0, 1], of fewer bits until the file is small enough."""
        exact = levels[1:].astype(np.float64) * LAST_LEVEL

        def at(rate: float) -> tuple[np.ndarray, bool]:
            whole = choose_levels(self.passes, exact, self.weight, rate, LAST_LEVEL + 1)
            return whole, self.file_bytes is None or self.estimated_bytes(whole) <= self.file_bytes

        low = high = self.rate
        whole, fits = at(low)
        for _ in range(12):  # a bracket of rates, whose last interval is halved
            if fits:
                break
            low, high = high, 1.5 * high
            whole, fits = at(high)
        for _ in range(3 if low < high else 0):
            middle = np.sqrt(low * high)
            smaller, fits = at(middle)
            whole, low, high = (smaller, low, middle) if fits else (whole, middle, high)
        return np.concatenate([[0], whole])

    def estimated_bytes(self, levels: np.ndarray, share: float = 1.0) -> float:
        """Return about the bytes of a file with these whole levels of stored nodes, which are a ``share`` of all."""
        probabilities, data = encode(self.nodes.stored, levels, self.index[1:], LAST_LEVEL + 1, len(self.palette))
        shared = self.palette.size + (0 if self.environment is None else 3 * len(self.environment))
        return len(data) / share + len(zlib.compress(probabilities, 9)) + shared + OTHER_BYTES


def sorted_clusters(
    grid: NodeGrid, importance: Importance, deadline: Deadline | None, count: int, seed: int
) -> np.ndarray:
    """Return ``count`` weighted clusters of the colours of a grid, in units of its metric, along a line."""
    palette = clusters(grid.colour[1:] * np.sqrt(importance.metric), importance.colour, count, seed, deadline)
    # Neighbours in the palette look alike: the part of the palette predicts that of the next node
    centred = palette - palette.mean(axis=0)
    return palette[np.argsort(centred @ np.linalg.eigh(centred.T @ centred)[1][:, -1], kind="stable")]


def choose_coding(grid: NodeGrid, importance: Importance, palette: np.ndarray, rate: float) -> PaletteCoding:
    """Return the coding of a grid by a palette of :func:`sorted_clusters`; a bit of the file counts ``rate``."""
    metric = np.sqrt(importance.metric)
    passes = passes_of(grid.nodes.stored)
    palette, index = choose_index(passes, grid.colour[1:] * metric, importance.colour, palette, rate)
    used, index = np.unique(index, return_inverse=True)
    levels = np.clip((grid.density - EMPTIEST) / (DENSEST - EMPTIEST), 0, 1).astype(np.float32)
    coding = PaletteCoding(
        grid.nodes,
        levels,
        np.concatenate([[0], index]).astype(np.uint32),
        (palette[used] / metric).astype(np.float32),
        passes,
        importance.density * LEVEL_STEP**2,
        0.1 * rate,  # errors of neighbouring densities add up
        grid.environment,
    )
    coding.levels = (coding.whole_levels(levels) / LAST_LEVEL).astype(np.float32)
    return coding


def coding_in(
    grid: NodeGrid, importance: Importance, deadline: Deadline | None, nbytes: float, seed: int
) -> PaletteCoding | None:
    """Return a coding of a grid whose file has at most ``nbytes`` once it is trained, or ``None`` if there is none.

    The number of colours follows from ``nbytes``, the slope from trials with a part of the nodes.
    """
    # Of the bytes, the palette may have an eighth
    colours = int(np.clip(0.12 * nbytes / grid.colour.shape[1], 2 ** INDEX_BITS[0], 2**DEFAULT_BITS))
    palette = sorted_clusters(grid, importance, deadline, colours, seed)
    per_node = importance.loss / grid.nodes.count
    part, weights = trial_part(grid, importance)
    share = part.nodes.count / grid.nodes.count

    def fits(slope: float) -> bool:
        coding = choose_coding(part, weights, palette, slope * per_node)
        levels = np.rint(coding.levels[1:] * LAST_LEVEL).astype(int)
        return coding.estimated_bytes(levels, share) <= 0.92 * nbytes  # the training adds to it

    low, high = np.log(SLOPES)
    if not fits(np.exp(high)):
        return None
    slope = np.exp(-largest_fitting(lambda flatness: fits(np.exp(-flatness)), -high, -low, steps=6))
    coding = choose_coding(grid, importance, palette, slope * per_node)
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
    stored = cell_corners(complete_cells(nodes.stored & chosen[column][..., None]))
    here = stored[nodes.stored]
    weights = Importance(importance.density[here], importance.colour[here], importance.metric, importance.loss)
    return grid.part(stored), weights


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
    sample = rng.choice(len(points), min(len(points), 60 * count), replace=False, p=chance)  # points for each cluster
    share = weight[sample] / chance[sample]
    for _ in range(ROUNDS):
        if deadline is not None and deadline.passed:
            break
        nearest = cKDTree(centres).query(points[sample])[1]
        # A centre without points restarts at a random one
        centres = weighted_means(points[sample], share, nearest, points[rng.choice(sample, count)])
    return centres


class PaletteProblem(ImagesProblem):
    """Training of a :class:`PaletteCoding` through the images of a session.

    Density levels and palette are rounded as they are stored, with straight-through gradients. Indices are constant. At
    the end, levels are chosen by rate and distortion again.
    """

    def __init__(self, coding: PaletteCoding, session: FieldSession):
        types = coding.nodes.types
        self.coding, self.index = coding, device_array(types.UInt32, coding.index)
        net = {"density": coding.levels, "palette": coding.palette, "environment": coding.environment}
        net = {name: device_tensor(types.TensorXf, values) for name, values in net.items() if values is not None}
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
        if step % 50 == 0:  # of training
            self._set_ranges()
        return ""

    def _set_ranges(self) -> None:
        names, Float = [name for name in ("palette", "environment") if name in self.net], self.session.types.Float
        self.ranges = {n: [device_array(Float, v) for v in byte_range(self.net[n].numpy())] for n in names}

    def numbers(self) -> PaletteArrays:
        """Return the trained numbers as a file stores them."""
        environment = to_bytes(self.net["environment"].numpy()[:, :3]) if "environment" in self.net else None
        levels = self.coding.whole_levels(fold(self.net["density"].array).numpy()).astype(np.uint8)
        palette = to_bytes(self.net["palette"].numpy())
        return PaletteArrays(levels, DENSITY_BITS, (EMPTIEST, LEVEL_STEP), self.coding.index, palette, environment)


def byte_range(palette: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the quantisation step and the minimum of each column of a palette, as bytes store it."""
    low, high = palette.min(axis=0).astype(np.float64), palette.max(axis=0).astype(np.float64)
    return np.maximum((high - low) / 255, 1e-6), low


def to_bytes(values: np.ndarray) -> StoredArray:
    """Return numbers ``(n, c)`` as bytes between the minimum and the maximum of each column (:func:`byte_range`)."""
    scale, offset = byte_range(values)
    codes = np.clip(np.rint((values - offset) / scale), 0, 255).astype(np.uint8)
    return StoredArray(codes, (), tuple(scale.tolist()), tuple(offset.tolist()))


def packed_bytes(grid: NodeGrid, index_bits: int) -> int:
    """Return the bytes in memory of the packed field of a grid."""
    nodes = grid.nodes
    index = nodes.like(nodes.spacing, nodes.shape, nodes.stored, packed=True).nbytes
    environment = 0 if grid.environment is None else 4 * len(grid.environment)
    entries = nodes.entries * (DENSITY_BITS + index_bits) // 8 + 8
    palette = 16 * -(-grid.colour.shape[1] // 16) * min(2**index_bits, nodes.count)
    return index + environment + entries + palette


def in_memory(grid: NodeGrid, images: ViewImages, nbytes: int | None) -> tuple[NodeGrid, int]:
    """Return the visible part of a grid at the highest resolution that fits in ``nbytes``, and its bits of an index.

    At the full resolution, an index has as many bits as fit; at a lower one, 10, or 8 if these do not fit. With
    ``None``, the resolution and the bits are the default. Raises ``ValueError`` if no grid fits.
    """
    cells = grids.visible(grid, images)
    whole = grids.refine(grid, cells)
    if nbytes is None:
        return whole, DEFAULT_BITS
    for bits in sorted(INDEX_BITS, reverse=True):
        if bits >= 8 and packed_bytes(whole, bits) <= nbytes:
            return whole, bits

    def smaller(share: float) -> tuple[NodeGrid, int]:
        part = grids.refine(grid, cells, share)
        return part, 10 if packed_bytes(part, 10) <= nbytes else 8

    share = largest_fitting(lambda share: packed_bytes(*smaller(share)) <= nbytes, SMALLEST, 1.0, steps=7)
    if share == SMALLEST:
        smallest = packed_bytes(smaller(SMALLEST)[0], 6)
        raise ValueError(f"{nbytes:,} bytes are fewer than the smallest field needs, about {smallest:,}")
    return smaller(share)
