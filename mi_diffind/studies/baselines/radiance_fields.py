"""Rivals of radiance fields in equal bytes: 8-bit grids, plain or with a codebook, and a hash grid.

A rival is a *fit* while it is trained through images: it has a ``net``, tensors by name that an optimiser trains at one
rate, and ``field_of``, which makes a field of it, rounded as it is stored. Its ``state`` are the arrays of a file, of
which ``field`` makes a field that reads bytes.

The codebook is the idea of VQRF (Li et al. 2023); the hash grid follows Instant-NGP (Müller et al. 2022) with the
modules of ``drjit.nn``. In files, numbers of up to 8 bits are predicted from neighbours and deflated: each channel has
the prediction that leaves the fewest bytes: none, the neighbour before along z, or the mean of those before
along x, y and z.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass

import drjit as dr
import numpy as np
from drjit import nn
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from ...arrays.budget import Budget
from ...arrays.indirection import device_array, device_tensor
from ...arrays.lookup import pack_bits
from ...arrays.sparse_grid import cell_corners, complete_cells
from ...tasks.radiance.grid import DENSITY_SCALE
from ...tasks.radiance.march import march, replay
from ...tasks.radiance.nodes import COARSE, FARTHEST, Nodes, coarser
from ...tasks.radiance.volume_field import NodeField, NodeVolume, VolumeField, colour_of, density_of

#: Strategies of zlib that are tried: repetitions and frequencies, mostly frequencies, or frequencies alone.
STRATEGIES = (zlib.Z_DEFAULT_STRATEGY, zlib.Z_FILTERED, zlib.Z_HUFFMAN_ONLY)

#: Predictions of a channel.
PREDICTIONS = ("none", "before", "mean")

#: Bytes of a file besides its arrays.
HEADER = 64

#: Range of stored raw densities: empty at the lower end, opaque at the upper.
RAW = (-8.0, 12.0)

#: Coefficients of a colour by direction: four for red, green and blue each.
COEFFICIENTS = 12

#: Weight of a node that no ray sees, so that its colour is defined, too.
LEAST = 1e-6

#: Points that centres of a codebook are computed from, and rounds of k-means.
KMEANS_POINTS = 2**16
KMEANS_ROUNDS = 10

#: Raw density of a network before training.
BEGIN = -4.0

#: Cells of the grid along a side of a wide cell; a cell of an occupancy spans :data:`.COARSE` wide cells.
WIDER = 2

#: Hash grid: levels, numbers a level, coarsest resolution; units of the hidden layer of the network.
LEVELS = 8
FEATURES = 2
COARSEST = 16
WIDTH = 32


@dataclass(frozen=True, eq=False)
class QuantisationSteps:
    """Uniform quantisation of the channels of an array ``(n, C)``.

    Value = ``low`` + ``step`` · code, with codes from 0 to ``levels`` − 1; ``low`` and ``step`` are float32 ``(C,)``,
    ``levels`` are at most 256.
    """

    low: np.ndarray
    step: np.ndarray
    levels: np.ndarray

    @staticmethod
    def over(
        values: np.ndarray, levels: int = 256, weights: np.ndarray | None = None, tail: float = 0.0
    ) -> QuantisationSteps:
        """Return ``levels`` steps over the range of ``values`` (n, C).

        The range is without the share ``tail`` of the ``weights`` (n,) at either end.
        """
        values = np.asarray(values, np.float64)
        weights = np.ones(len(values)) if weights is None else np.asarray(weights, np.float64)
        low, high = np.empty((2, values.shape[1]))
        for c, v in enumerate(values.T):
            order = np.argsort(v)
            share = np.cumsum(weights[order]) / weights.sum()
            ends = np.searchsorted(share, (tail, 1 - tail)).clip(0, len(v) - 1)
            low[c], high[c] = v[order[ends]]
        step = np.maximum(high - low, 1e-6) / (levels - 1)
        return QuantisationSteps(low.astype(np.float32), step.astype(np.float32), np.full(len(low), levels))

    @staticmethod
    def between(low: float, high: float) -> QuantisationSteps:
        """Return 256 steps of one channel, the same for all values, from ``low`` to ``high``."""
        return QuantisationSteps(np.float32([low]), np.float32([(high - low) / 255]), np.array([256]))

    def codes(self, values: np.ndarray) -> np.ndarray:
        """Return the codes of ``values``, uint8 ``(n, C)``."""
        nearest = np.rint((np.asarray(values, np.float64) - self.low) / self.step.astype(np.float64))
        return np.clip(nearest, 0, self.levels - 1).astype(np.uint8)

    def values(self, codes: np.ndarray) -> np.ndarray:
        """Return the values of ``codes``, float32 ``(n, C)``."""
        return (self.low + self.step * codes.astype(np.float32)).astype(np.float32)

    def rounded(self, types, tensor):
        """Return a tensor ``(n, C)`` rounded to its steps, with the gradients of the tensor (straight through)."""
        import drjit as dr

        low, inverse, step = [
            types.TensorXf(np.asarray(v, np.float32)[None]) for v in (self.low, 1 / self.step, self.step)
        ]
        exact = dr.detach(tensor)
        code = dr.round((exact - low) * inverse)
        most = types.TensorXf(np.asarray(self.levels - 1, np.float32)[None])
        return tensor + (dr.minimum(dr.maximum(code, 0), most) * step + low - exact)


def deflated(data: bytes) -> bytes:
    """Return ``data`` after zlib with the best of :data:`STRATEGIES`."""
    packed = []
    for strategy in STRATEGIES:
        packer = zlib.compressobj(9, zlib.DEFLATED, 15, 9, strategy)
        packed.append(packer.compress(data) + packer.flush())
    return min(packed, key=len)


def mask_bytes(stored: np.ndarray) -> bytes:
    """Return the mask of stored nodes, bool ``(X, Y, Z)``, as bits after zlib."""
    return deflated(np.packbits(stored).tobytes())


class Neighbours:
    """Numbers of the previous nodes along x, y and z of each stored node, in lexicographic order; −1: not stored."""

    def __init__(self, stored: np.ndarray):
        number = np.full(tuple(n + 1 for n in stored.shape), -1)
        number[1:, 1:, 1:][stored] = np.arange(np.count_nonzero(stored))
        place = np.argwhere(stored)
        self.before = np.stack([number[tuple((place + 1 - np.eye(3, dtype=int)[axis]).T)] for axis in range(3)])

    def predicted(self, codes: np.ndarray, prediction: str, nodes) -> np.ndarray:
        """Return the predicted codes of the ``nodes`` (numbers) from the codes of all nodes."""
        if prediction == "none":
            return np.zeros(len(nodes), np.int64)
        before = self.before[2:, nodes] if prediction == "before" else self.before[:, nodes]
        stored = before >= 0
        count = stored.sum(axis=0)
        total = np.where(stored, codes[before], 0).sum(axis=0)
        return np.where(count > 0, total // np.maximum(count, 1), 0)

    def packed(self, codes: np.ndarray) -> tuple[bytes, str]:
        """Return the codes of one channel ``(n,)`` as bytes, and the prediction."""
        codes, attempts = codes.astype(np.int64), []
        everything = np.arange(len(codes))
        for prediction in PREDICTIONS:
            rest = (codes - self.predicted(codes, prediction, everything)).astype(np.uint8).tobytes()
            attempts.append((len(zlib.compress(rest, 6)), prediction, rest))
        _, prediction, rest = min(attempts)
        return deflated(rest), prediction


def coded_bytes(stored: np.ndarray, channels: np.ndarray) -> int:
    """Return the bytes in a file of a mask ``(X, Y, Z)`` and of the ``channels`` (n, C), uint8, of its nodes."""
    neighbours = Neighbours(stored)
    return len(mask_bytes(stored)) + sum(len(neighbours.packed(c)[0]) + 1 for c in channels.T)


# -- Fields on nodes ----------------------------------------------------------------------------------------


class ByteField(NodeVolume):
    """Field of nodes that reads bytes.

    ``density`` (n,) and ``colour`` (m, 12) are uint8 with the ``steps`` of each; ``rows`` (n,) is the row of each node
    or ``None``. Nodes are in lexicographic order, without an entry for no node. ``nbytes`` are all bytes in memory.
    """

    def __init__(self, nodes: Nodes, density, colour, steps: tuple[QuantisationSteps, QuantisationSteps], rows=None):
        types = nodes.types
        super().__init__(Nodes(types, nodes.lower, nodes.spacing, nodes.shape, nodes.stored, packed=True), {})
        self.density_steps, self.colour_steps = steps
        self.density = types.UInt8(np.pad(density, (1, 0)))  # 0 stands for no node
        table = colour if rows is not None else np.pad(colour, ((1, 0), (0, 0)))
        self.table = device_array(types.UInt32, np.ascontiguousarray(table).view("<u4"))
        self.row_words = None
        if rows is not None:
            numbers = np.pad(rows.astype("<u2"), (1, 0))
            self.row_words = device_array(types.UInt32, np.pad(numbers, (0, len(numbers) % 2)).view("<u4"))
        words = [v for v in (self.table, self.row_words) if v is not None]
        self.nbytes = self.nodes.nbytes + dr.width(self.density) + 4 * sum(map(dr.width, words))

    def density_at(self, p, active=True):
        def level(number, seen):
            return self.types.Float(dr.gather(self.types.UInt8, self.density, number, seen))

        low, step = float(self.density_steps.low[0]), float(self.density_steps.step[0])
        return self.interpolated_density(level, p, active, low, step)

    def radiance_at(self, point_data, p, d, active=True):
        types, UInt32 = self.types, self.types.UInt32
        sums = [types.Float(0)] * COEFFICIENTS
        for weight, number in zip(point_data[:8], point_data[8:], strict=True):
            if self.row_words is not None:
                number = (dr.gather(UInt32, self.row_words, number >> 1, active) >> ((number & 1) << 4)) & 0xFFFF
            for j in range(COEFFICIENTS // 4):
                word = dr.gather(UInt32, self.table, dr.fma(number, COEFFICIENTS // 4, j), active)
                for k in range(4):
                    byte = types.Float(types.Int32((word >> (8 * k)) & 255))
                    sums[4 * j + k] = dr.fma(weight, byte, sums[4 * j + k])
        s = self.colour_steps
        return colour_of([dr.fma(v, float(a), float(b)) for v, a, b in zip(sums, s.step, s.low, strict=True)], d)


@dataclass(frozen=True, eq=False)
class WeightedGrid:
    """Numbers on the nodes of a sparse grid, with the weight of each node in the training views.

    ``density`` (n,) is raw, ``colour`` is (n, 12), and ``seen`` (n,) is the number of rays that end at each node; all
    are in lexicographic order of the ``nodes``.
    """

    nodes: Nodes
    density: np.ndarray
    colour: np.ndarray
    seen: np.ndarray

    @staticmethod
    def of(field: NodeField, seen: np.ndarray) -> WeightedGrid:
        """Return the numbers of a trained sparse grid with the result of :func:`visibility`."""
        density, colour = (field.arrays[name].numpy() for name in ("density", "colour"))
        return WeightedGrid(field.nodes, density.reshape(-1)[1:], colour[1:], np.asarray(seen)[1:])

    def dense(self, values: np.ndarray, outside: float = 0.0) -> np.ndarray:
        """Return ``values`` (n, …) as a box ``(X, Y, Z, …)``."""
        box = np.full((*self.nodes.shape, *values.shape[1:]), outside, np.float32)
        box[self.nodes.stored] = values
        return box

    def kept(self, cells: np.ndarray) -> WeightedGrid:
        """Return the grid reduced to those of its cells that are in ``cells`` (bool)."""
        stored = cell_corners(cells & self.cells())
        nodes = Nodes(self.nodes.types, self.nodes.lower, self.nodes.spacing, self.nodes.shape, stored)
        inside = stored[self.nodes.stored]
        return WeightedGrid(nodes, self.density[inside], self.colour[inside], self.seen[inside])

    def cells(self) -> np.ndarray:
        """Return the occupied cells, bool ``(X − 1, Y − 1, Z − 1)``."""
        return complete_cells(self.nodes.stored)

    def coarser(self, scale: float) -> np.ndarray:
        """Return the mask of nodes ``scale`` times as far apart, whose cells cover the occupied cells of this grid."""
        shape = [int(np.ceil((n - 1) / scale - 1e-6)) + 1 for n in self.nodes.shape]
        old, last = np.argwhere(self.cells()), np.array(shape) - 2
        cells = np.zeros([n - 1 for n in shape], bool)
        for corner in np.ndindex(2, 2, 2):
            new = ((old + np.array(corner) * (1 - 1e-6)) / scale).astype(int)
            cells[tuple(np.minimum(new, last).T)] = True
        return cell_corners(cells)

    def resampled(self, scale: float) -> WeightedGrid:
        """Return the grid on the nodes of :meth:`coarser`.

        Raw densities are interpolated; colours are means weighted by ``seen``. (Mean densities over cells would make
        walls transparent: 3 dB worse, and 1.6 dB after 200 steps of training.)
        """
        nodes, stored = self.nodes, self.coarser(scale)
        seen = self.dense(self.seen) + LEAST * self.dense(np.ones(len(self.seen), np.float32))
        values = [np.maximum(self.dense(self.density, RAW[0]), RAW[0]), seen]
        values += [v * seen for v in np.moveaxis(self.dense(self.colour), -1, 0)]
        at = np.argwhere(stored).T * scale
        raw, weight, *sums = (map_coordinates(v, at, order=1, mode="nearest", prefilter=False) for v in values)
        mean = np.average(self.colour, axis=0, weights=self.seen + LEAST)
        known = weight > 1e-9
        colour = np.where(known[:, None], np.stack(sums, axis=1) / np.maximum(weight, 1e-12)[:, None], mean)
        coarse = Nodes(nodes.types, nodes.lower, scale * nodes.spacing, stored.shape, stored)
        return WeightedGrid(coarse, *(v.astype(np.float32) for v in (raw, colour, weight * scale**3)))


def visibility(field: NodeField, images, every: int = 2) -> np.ndarray:
    """Return how many rays of the views end at each node of a field, ``(n,)``.

    This is the derivative of the images with respect to the colours of the nodes, all equal, by one ray for ``every``
    pixels along x and y.
    """
    types, views = field.types, images.views
    arrays = {"density": types.TensorXf(dr.detach(field.arrays["density"]))}
    arrays["colour"] = dr.zeros(types.TensorXf, field.arrays["colour"].shape)
    dr.enable_grad(arrays)
    white = field.with_arrays(arrays)
    for view, (height, width) in enumerate(views.sizes.tolist()):
        columns, rows = width // every, height // every
        lane = dr.arange(types.UInt32, columns * rows)
        o, d = images.rays(dr.opaque(types.UInt32, view), every * (lane % columns), every * (lane // columns))
        dr.eval(o, d)
        seen = march(white, o, d, 0, dr.inf)
        dr.eval(seen.colour, seen.transmittance, seen.depth)
        replay(white, o, d, 0, dr.inf, True, 0.5, seen, types.Array3f(1, 0, 0))
        dr.eval(dr.grad(arrays))
    return dr.grad(arrays["colour"]).numpy().reshape(-1, field.arrays["colour"].shape[-1])[:, 0] * every**2


class NodesFit:
    """Training of a grid of bytes: ``density`` (n, 1) and coefficients of ``colour``, each with its quantisation steps.

    There is a row of ``colour`` for each node, or ``rows`` (n,) names the row of each.
    """

    def __init__(self, nodes: Nodes, density, colour, steps: tuple[QuantisationSteps, QuantisationSteps], rows=None):
        self.nodes, self.rows, self.steps, types = nodes, rows, steps, nodes.types
        density = np.pad(density, (1, 0)).astype(np.float32)[:, None]
        self.net = {
            "density": device_tensor(types.TensorXf, density / DENSITY_SCALE),
            "colour": device_tensor(types.TensorXf, colour if rows is not None else np.pad(colour, ((1, 0), (0, 0)))),
        }
        self.numbers = None if rows is None else device_array(types.UInt32, np.pad(rows, (1, 0)))

    def field_of(self, net) -> NodeField:
        """Return the field of the trained parameters, rounded as they are stored."""
        density = self.steps[0].rounded(self.nodes.types, net["density"] * DENSITY_SCALE)
        return NodeField(self.nodes, density, self.steps[1].rounded(self.nodes.types, net["colour"]), self.numbers)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays of a file by name."""
        density, colour = (self.net[name].numpy() for name in ("density", "colour"))
        density, colour = density[1:] * DENSITY_SCALE, colour if self.rows is not None else colour[1:]
        state = {"density": self.steps[0].codes(density), "colour": self.steps[1].codes(colour)}
        state |= nodes_state(self.nodes)
        for name, steps in zip(("density", "colour"), self.steps, strict=True):
            state |= {f"{name}_low": steps.low, f"{name}_step": steps.step, f"{name}_levels": steps.levels}
        return state if self.rows is None else state | {"rows": self.rows.astype(np.uint16)}

    @staticmethod
    def field(types, state: dict) -> ByteField:
        """Return the field that reads what :meth:`state` returned."""
        names = ("low", "step", "levels")
        steps = tuple(QuantisationSteps(*(state[f"{array}_{n}"] for n in names)) for array in ("density", "colour"))
        return ByteField(read_nodes(types, state), state["density"][:, 0], state["colour"], steps, state.get("rows"))

    @staticmethod
    def file_bytes(state: dict) -> int:
        """Return the bytes on disk, after zlib."""
        rows, colour, density = state.get("rows"), state["colour"], state["density"]
        fixed = HEADER + sum(state[n].nbytes for n in state if n.endswith(("_low", "_step")))
        if rows is None:
            return fixed + coded_bytes(state["stored"], np.concatenate([density, colour], axis=1))
        bits = pack_bits(rows, max(1, (len(colour) - 1).bit_length()))
        packed = min(len(deflated(bits.tobytes())), len(deflated(rows.astype("<u2").tobytes())))
        return fixed + coded_bytes(state["stored"], density) + packed + len(deflated(colour.tobytes()))


def nodes_state(nodes: Nodes) -> dict[str, np.ndarray]:
    """Return the arrays from which :func:`read_nodes` makes the nodes again."""
    return {"lower": np.array(nodes.lower), "spacing": np.array(nodes.spacing), "shape": np.array(nodes.shape),
            "stored": nodes.stored}  # fmt: skip


def read_nodes(types, state: dict) -> Nodes:
    """Return the nodes of a state."""
    return Nodes(types, state["lower"], float(state["spacing"]), state["shape"], state["stored"])


#: Steps of raw densities.
DENSITY_STEPS = QuantisationSteps.between(*RAW)


def plain(grid: WeightedGrid, levels: int = 256) -> NodesFit:
    """Return the fit of thirteen numbers a node, those of colour in ``levels`` uniform steps."""
    steps = DENSITY_STEPS, QuantisationSteps.over(grid.colour, levels, grid.seen + LEAST, 1e-3)
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), grid.colour, steps)


def display(grid: WeightedGrid) -> np.ndarray:
    """Return the sensitivity of the displayed image to each coefficient of colour, (12,).

    It is the slope of sRGB times the radiance, as a root mean square over nodes weighted by ``seen``.
    """
    radiance = np.exp(np.clip(grid.colour[:, ::4], -12, 1.5))
    slope = np.where(radiance <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(radiance, 0.0031308) ** (1 / 2.4 - 1))
    squared = np.average((slope * radiance) ** 2, axis=0, weights=grid.seen + LEAST)
    return np.repeat(np.sqrt(squared), 4)


def codebook(grid: WeightedGrid, count: int) -> NodesFit:
    """Return the fit with a codebook of ``count`` colours, found by k-means with the weights ``seen``."""
    scale = display(grid)
    centres, rows = k_means((grid.colour * scale).astype(np.float32), grid.seen + LEAST, count)
    colour = centres / scale
    steps = DENSITY_STEPS, QuantisationSteps.over(colour)
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), colour, steps, rows)


def k_means(points: np.ndarray, weights: np.ndarray, count: int):
    """Return centres ``(count, D)`` of weighted ``points`` (n, D), and the index of the nearest of each (n,)."""
    rng = np.random.default_rng(1)
    count = min(count, len(points))
    share = weights / weights.sum()
    centres = points[rng.choice(len(points), count, replace=False, p=0.5 * share + 0.5 / len(points))]
    chosen = rng.choice(len(points), min(KMEANS_POINTS, len(points)), replace=False)
    sample, mass = points[chosen], weights[chosen]
    for _ in range(KMEANS_ROUNDS):
        nearest = cKDTree(centres).query(sample)[1]
        total = np.bincount(nearest, mass, count)
        sums = np.stack([np.bincount(nearest, mass * v, count) for v in sample.T], axis=1)
        centres = np.where(total[:, None] > 0, sums / np.maximum(total, 1e-30)[:, None], centres).astype(np.float32)
        idle = np.flatnonzero(total == 0)
        if len(idle):  # they move to the largest errors
            missing = np.sum((sample - centres[nearest]) ** 2, axis=1) * mass
            worst = np.argsort(missing)[::-1][: len(idle)]
            centres[idle[: len(worst)]] = sample[worst]
    return centres, cKDTree(centres).query(points)[1]


# -- Hash grid and network ----------------------------------------------------------------------------------------


def wide_cells(stored: np.ndarray) -> np.ndarray:
    """Return the wide cells, bool, that hold occupied cells of a grid with ``stored`` nodes."""
    cells = complete_cells(stored)
    padded = np.pad(cells, [(0, -n % WIDER) for n in cells.shape])
    x, y, z = (n // WIDER for n in padded.shape)
    return padded.reshape(x, WIDER, y, WIDER, z, WIDER).any(axis=(1, 3, 5))


class Occupancy:
    """Occupied cells and empty distances of a grid whose nodes are :data:`WIDER` times as far apart."""

    def __init__(self, nodes: Nodes):
        stored = cell_corners(wide_cells(nodes.stored))
        self.nodes = Nodes(nodes.types, nodes.lower, WIDER * nodes.spacing, stored.shape, stored)
        self.nodes.index = None
        self.types, self.nbytes = nodes.types, self.nodes.nbytes

    def __call__(self, p, active=True):
        """Return whether the cell that holds ``p`` is occupied."""
        side = COARSE * self.nodes.spacing
        at = self.types.UInt32(0)
        for x, a, n in zip(p, self.nodes.lower, self.nodes.coarse_distances.shape, strict=True):
            u = dr.clip(dr.floor(dr.fma(x, 1 / side, -a / side)), 0, n - 1)
            at = dr.fma(at, n, self.types.UInt32(u))
        word = dr.gather(self.types.UInt32, self.nodes.distances, at >> 3, active)
        return active & (((word >> ((at & 7) << 2)) & FARTHEST) == 0)


def occupied_bytes(state: dict) -> int:
    """Return the bytes on disk of the occupancy of the nodes of a state."""
    cells = complete_cells(cell_corners(wide_cells(state["stored"])))
    return len(mask_bytes(coarser(cells)))


class HashVolumeField(VolumeField):
    """Field of a hash grid and a network of one hidden layer, which returns a raw density and twelve coefficients.

    The arrays ``entries`` and ``weights`` are flat. The field is empty outside of the ``occupancy``.
    """

    def __init__(self, nodes: Nodes, arrays: dict, encoding, network, occupancy: Occupancy):
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, arrays)
        self.encoding, self.network, self.occupancy = encoding, network, occupancy

    def free_distance(self, p, d, active=True):
        return self.occupancy.nodes.free_distance(p, d, active)

    #: The marching of rays differentiates colours by what :meth:`radiance_at` computes, not by ``point_data``.
    reads_again = False

    def for_training(self):
        field = super().for_training()
        field.reads_again = True
        return field

    def density_at(self, p, active=True):
        active = self.occupancy(p, active)
        raw, *numbers = self._outputs(p, active)
        return dr.select(active, density_of(raw + BEGIN, self.per_voxel), 0), [] if self.reads_again else numbers

    def _outputs(self, p, active):
        """Return the outputs of the network: a raw density and twelve coefficients."""
        longest = max(b - a for a, b in zip(self.lower, self.upper, strict=True))
        self.encoding.data = self.arrays["entries"].array
        for layer in self.network.layers:
            if isinstance(layer, nn.Linear):
                layer.weights.buffer = layer.bias.buffer = self.arrays["weights"].array
        features = self.encoding([(x - a) * (1 / longest) for x, a in zip(p, self.lower, strict=True)], active)
        return list(self.network(nn.CoopVec(*features)))

    def radiance_at(self, point_data, p, d, active=True):
        return colour_of(self._outputs(p, active)[1:] if self.reads_again else point_data, d)


class HashVolumeFit:
    """Training of a hash grid of at most ``entries`` a level, with ``finest`` cells along the longest side."""

    def __init__(self, grid: WeightedGrid, entries: int, finest: float, seed: int = 1):
        self.nodes, self.sizes = grid.nodes, (entries, finest)
        types = self.types = grid.nodes.types
        self.occupancy = Occupancy(grid.nodes)
        self.encoding, self.network = modules(types, entries, finest, seed)
        weights = types.TensorXf(dr.detach(self.network["weights"]))
        # The last layer begins with an empty field of the mean colour
        bias = self.network.layers[-1].bias
        mean = np.average(grid.colour, axis=0, weights=grid.seen + 1e-9)
        begin = weights.numpy().copy()
        begin[bias.offset : bias.offset + 13 * bias.stride : bias.stride] = [0.0, *mean]
        self.net = {"entries": types.TensorXf(dr.detach(self.encoding.params)), "weights": types.TensorXf(begin)}

    def field_of(self, net) -> HashVolumeField:
        """Return the field of the trained parameters."""
        arrays = {"entries": net["entries"], "weights": net["weights"]}
        return HashVolumeField(self.nodes, arrays, self.encoding, self.network, self.occupancy)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays of a file by name; numbers are in half precision."""
        half = {name: self.net[name].numpy().astype(np.float16) for name in ("entries", "weights")}
        return {**nodes_state(self.nodes), "sizes": np.array(self.sizes), **half}

    @staticmethod
    def field(types, state: dict) -> HashVolumeField:
        """Return the field of what :meth:`state` returned, which computes in single precision."""
        nodes = read_nodes(types, state)
        arrays = {name: device_tensor(types.TensorXf, state[name]) for name in ("entries", "weights")}
        encoding, network = modules(types, int(state["sizes"][0]), float(state["sizes"][1]), 1)
        field = HashVolumeField(nodes, arrays, encoding, network, Occupancy(nodes))
        field.nbytes = state["entries"].nbytes + state["weights"].nbytes + field.occupancy.nbytes
        return field

    @staticmethod
    def file_bytes(state: dict) -> int:
        """Return the bytes on disk, after zlib."""
        return HEADER + sum(len(deflated(state[n].tobytes())) for n in ("entries", "weights")) + occupied_bytes(state)


def modules(types, entries: int, finest: float, seed: int) -> tuple:
    """Return the untrained hash grid and network."""
    scale = (finest / COARSEST) ** (1 / (LEVELS - 1))
    encoding = nn.HashGridEncoding(
        types.Float, 3, n_levels=LEVELS, n_features_per_level=FEATURES, hashmap_size=entries // 16 * 16,
        base_resolution=COARSEST, per_level_scale=scale, align_corners=True, init_scale=1e-2, rng=dr.rng(seed=seed),
    )  # fmt: skip
    layers = nn.Sequential(nn.Linear(-1, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 13))
    layers = layers.alloc(types.TensorXf, LEVELS * FEATURES, dr.rng(seed=seed + 1))
    return encoding, nn.pack(layers, layout="training")


def _parameters(entries: int, finest: float) -> int:
    """Return the approximate number of parameters of a hash grid and its network."""
    scale = (finest / COARSEST) ** (1 / (LEVELS - 1))
    levels = sum(min(entries, (math.ceil(COARSEST * scale**k) + 1) ** 3) for k in range(LEVELS))
    return FEATURES * levels + WIDTH * (LEVELS * FEATURES + 1) + 13 * (WIDTH + 1)


def hash_entries(nbytes: float, finest: float) -> int:
    """Return the most entries a level with which a hash grid and its network take ``nbytes``, 2 bytes a parameter."""
    sizes = [int(2**power) // 16 * 16 for power in np.arange(8, 24, 0.1)]
    return Budget(nbytes).largest(lambda size: 2 * _parameters(size, finest), sizes, strict=False)
