"""Rivals of radiance fields in equal bytes: sparse grids of 8 bits, plain or with a codebook, and a hash grid.

A rival is a *fit* while it is trained through images: it has a ``net``, tensors by name that an optimiser trains at one
rate, and ``field_of``, which makes a field of it, rounded as it is stored. Its ``state`` are the arrays of a file, of
which ``field`` makes a field that reads bytes.

The codebook is the idea of VQRF (Li et al. 2023); the hash grid follows Instant-NGP (Müller et al. 2022) with the
modules of ``drjit.nn``.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import drjit as dr
import numpy as np
from drjit import nn
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from ...arrays.indirection import device_array, device_tensor
from ...arrays.lookup import as_words, pack_bits
from ...arrays.sparse_grid import cell_corners, complete_cells
from ...core.units import largest_fitting
from ...tasks.radiance.grid import DENSITY_SCALE, NodeGrid
from ...tasks.radiance.nodes import COARSE, Nodes, coarser
from ...tasks.radiance.volume_field import NodeField, NodeVolume, VolumeField, colour_of, density_of
from .networks import LAYERS, WIDTH, hash_grid

#: Range of stored raw densities: empty at the lower end, opaque at the upper.
RAW = (-8.0, 12.0)

#: Coefficients of a colour by direction: four for red, green and blue each.
COEFFICIENTS = 12

#: Weight of a node that no ray sees, so that its colour is defined, too.
LEAST = 1e-6

#: Share of the weights at either end of the range of colours that is clipped.
TAIL = 1e-3

#: Points that centres of a codebook are computed from, and rounds of k-means.
KMEANS_POINTS = 2**16
KMEANS_ROUNDS = 10

#: Raw density of a network before training.
BEGIN = -4.0

#: Largest ratio of node distances of a coarser grid.
COARSEST_RATIO = 6.0


def compressed_bytes(state: dict[str, np.ndarray]) -> int:
    """Return the bytes of the arrays of a fit on disk: those of zlib, of masks after packing their bits."""
    arrays = (np.packbits(a) if a.dtype == bool else a for a in map(np.asarray, state.values()))
    return sum(len(zlib.compress(a.tobytes(), 9)) for a in arrays)


@dataclass(frozen=True, eq=False)
class QuantisationSteps:
    """Uniform quantisation of the channels of an array ``(n, C)`` in 256 steps.

    Value = ``low`` + ``step`` · code; ``low`` and ``step`` are float32 ``(C,)``.
    """

    low: np.ndarray
    step: np.ndarray

    @staticmethod
    def over(values: np.ndarray, weights: np.ndarray, tail: float) -> QuantisationSteps:
        """Return steps over the range of ``values`` (n, C) without the share ``tail`` of ``weights`` at either end."""
        ends = []
        for v in values.T:
            order = np.argsort(v)
            share = np.cumsum(weights[order]) / weights.sum()
            ends.append(v[order[np.searchsorted(share, (tail, 1 - tail)).clip(0, len(v) - 1)]])
        low, high = np.array(ends, np.float64).T
        return QuantisationSteps(low.astype(np.float32), (np.maximum(high - low, 1e-6) / 255).astype(np.float32))

    def codes(self, values: np.ndarray) -> np.ndarray:
        """Return the codes of ``values``, uint8 ``(n, C)``."""
        return np.clip(np.rint((values - self.low) / self.step), 0, 255).astype(np.uint8)

    def rounded(self, types, tensor):
        """Return a tensor ``(n, C)`` rounded to its steps, with the gradients of the tensor (straight through)."""
        low, step = (types.TensorXf(np.asarray(v, np.float32)[None]) for v in (self.low, self.step))
        exact = dr.detach(tensor)
        code = dr.clip(dr.round((exact - low) / step), 0, 255)
        return tensor + (code * step + low - exact)


#: Steps of raw densities.
DENSITY_STEPS = QuantisationSteps(np.float32([RAW[0]]), np.float32([(RAW[1] - RAW[0]) / 255]))


# -- Grids of bytes ----------------------------------------------------------------------------------------------------


class ByteField(NodeVolume):
    """Field of nodes that reads bytes.

    ``density`` (n,) and ``colour`` (m, 12) are uint8; ``rows`` (n,) is the row of each node or ``None``. Nodes are in
    lexicographic order, without an entry for no node. ``nbytes`` are all bytes in memory.
    """

    def __init__(self, nodes: Nodes, density, colour, colour_steps: QuantisationSteps, rows=None):
        types = nodes.types
        super().__init__(nodes.like(nodes.spacing, nodes.shape, nodes.stored, packed=True), {})
        self.colour_steps = colour_steps
        self.density = types.UInt8(np.pad(density, (1, 0)))  # 0 stands for no node
        table = colour if rows is not None else np.pad(colour, ((1, 0), (0, 0)))
        self.table = device_array(types.UInt32, np.ascontiguousarray(table).view("<u4"))
        self.nbytes = self.nodes.nbytes + dr.width(self.density) + 4 * dr.width(self.table)
        self.rows = None
        if rows is not None:  # two rows of 16 bits a word
            self.rows = device_array(types.UInt32, as_words(pack_bits(np.pad(rows, (1, 0)), 16)))
            self.nbytes += 4 * dr.width(self.rows)

    def density_at(self, p, active=True):
        def level(number, seen):
            return self.types.Float(dr.gather(self.types.UInt8, self.density, number, seen))

        return self.interpolated_density(level, p, active, float(DENSITY_STEPS.low[0]), float(DENSITY_STEPS.step[0]))

    def radiance_at(self, point_data, p, d, active=True):
        types, UInt32 = self.types, self.types.UInt32
        sums = [types.Float(0)] * COEFFICIENTS
        for weight, number in zip(point_data[:8], point_data[8:], strict=True):
            if self.rows is not None:
                number = (dr.gather(UInt32, self.rows, number >> 1, active) >> ((number & 1) << 4)) & 0xFFFF
            for j in range(COEFFICIENTS // 4):
                word = dr.gather(UInt32, self.table, dr.fma(number, COEFFICIENTS // 4, j), active)
                for k in range(4):
                    byte = types.Float(types.Int32((word >> (8 * k)) & 255))
                    sums[4 * j + k] = dr.fma(weight, byte, sums[4 * j + k])
        s = self.colour_steps
        return colour_of([dr.fma(v, float(a), float(b)) for v, a, b in zip(sums, s.step, s.low, strict=True)], d)


def coarser_nodes(grid: NodeGrid, scale: float) -> Nodes:
    """Return nodes ``scale`` times as far apart, whose cells cover the occupied cells of a grid."""
    nodes = grid.nodes
    shape = [int(np.ceil((n - 1) / scale - 1e-6)) + 1 for n in nodes.shape]
    old, last = np.argwhere(complete_cells(nodes.stored)), np.array(shape) - 2
    cells = np.zeros([n - 1 for n in shape], bool)
    for corner in np.ndindex(2, 2, 2):
        new = ((old + np.array(corner) * (1 - 1e-6)) / scale).astype(int)
        cells[tuple(np.minimum(new, last).T)] = True
    return nodes.like(scale * nodes.spacing, shape, cell_corners(cells), packed=True)


def resample(grid: NodeGrid, seen: np.ndarray, scale: float) -> tuple[NodeGrid, np.ndarray]:
    """Return a grid and the weights ``seen`` (n,) of its entries on the nodes of :func:`coarser_nodes`.

    Raw densities are interpolated; colours are means weighted by ``seen``. (Mean densities over cells would make walls
    transparent.)
    """
    nodes = coarser_nodes(grid, scale)
    nodes = nodes.like(nodes.spacing, nodes.shape, nodes.stored)

    def dense(values: np.ndarray, outside: float = 0.0) -> np.ndarray:
        box = np.full(grid.nodes.shape, outside, np.float32)
        box[grid.nodes.stored] = values[1:]
        return box

    weight = seen + LEAST
    values = [
        np.maximum(dense(grid.density, RAW[0]), RAW[0]),
        dense(weight),
        *(dense(c * weight) for c in grid.colour.T),
    ]
    at = nodes.positions().T * scale
    raw, weight, *sums = (map_coordinates(v, at, order=1, mode="nearest", prefilter=False) for v in values)
    mean = np.average(grid.colour[1:], axis=0, weights=seen[1:] + LEAST)
    colour = np.where(weight[:, None] > 1e-9, np.stack(sums, axis=1) / np.maximum(weight, 1e-12)[:, None], mean)
    density, colour, weight = np.pad(raw, (1, 0)), np.pad(colour, ((1, 0), (0, 0))), np.pad(weight, (1, 0))
    return NodeGrid(nodes, density.astype(np.float32), colour.astype(np.float32)), weight


def choose_scale(grid: NodeGrid, nbytes: float, entries: int = 0) -> float:
    """Return the smallest ratio of node distances, at least 1, with which a grid of bytes takes ``nbytes`` in memory.

    ``entries`` are those of a codebook, without which each node has its colour.
    """

    def fits(fineness: float) -> bool:
        nodes = coarser_nodes(grid, 1 / fineness)
        return nodes.nbytes + nodes.entries * (3 if entries else 13) + 12 * entries <= nbytes

    return 1.0 if fits(1.0) else 1 / largest_fitting(fits, 1 / COARSEST_RATIO, 1.0, steps=10)


class NodesFit:
    """Training of a ``grid`` of bytes, each node with a colour of its own or, with ``entries``, a row of a codebook.

    ``seen`` (n,) are the weights of the entries of the grid in the training views.
    """

    def __init__(self, grid: NodeGrid, seen: np.ndarray, entries: int = 0):
        self.nodes, self.rows, types = grid.nodes, None, grid.nodes.types
        colour, weights = grid.colour, seen + LEAST
        if entries:
            scale = display_scale(colour[1:], weights[1:])
            centres, rows = k_means((colour[1:] * scale).astype(np.float32), weights[1:], entries)
            colour, self.rows = centres / scale, np.pad(rows, (1, 0)).astype(np.uint16)
            self.steps = QuantisationSteps.over(colour, np.ones(len(colour)), 0.0)
        else:
            self.steps = QuantisationSteps.over(colour[1:], weights[1:], TAIL)
        density = np.clip(grid.density, *RAW)[:, None].astype(np.float32)
        self.net = {
            "density": device_tensor(types.TensorXf, density / DENSITY_SCALE),
            "colour": device_tensor(types.TensorXf, np.float32(colour)),
        }
        self.numbers = None if self.rows is None else device_array(types.UInt32, self.rows.astype(np.uint32))

    def field_of(self, net) -> NodeField:
        """Return the field of the trained parameters, rounded as they are stored."""
        types = self.nodes.types
        density = DENSITY_STEPS.rounded(types, net["density"] * DENSITY_SCALE)
        return NodeField(self.nodes, density, self.steps.rounded(types, net["colour"]), self.numbers)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays of a file by name."""
        density, colour = (self.net[name].numpy() for name in ("density", "colour"))
        state = {"density": DENSITY_STEPS.codes(density[1:] * DENSITY_SCALE)[:, 0], **nodes_state(self.nodes)}
        state |= {"colour_low": self.steps.low, "colour_step": self.steps.step}
        if self.rows is None:
            return state | {"colour": self.steps.codes(colour[1:])}
        return state | {"colour": self.steps.codes(colour), "rows": self.rows[1:]}

    @staticmethod
    def field(types, state: dict) -> ByteField:
        """Return the field that reads what :meth:`state` returned."""
        steps = QuantisationSteps(state["colour_low"], state["colour_step"])
        return ByteField(read_nodes(types, state), state["density"], state["colour"], steps, state.get("rows"))


def nodes_state(nodes: Nodes) -> dict[str, np.ndarray]:
    """Return the arrays from which :func:`read_nodes` makes the nodes again."""
    return {"lower": np.array(nodes.lower), "spacing": np.array(nodes.spacing), "stored": nodes.stored}


def read_nodes(types, state: dict) -> Nodes:
    """Return the nodes of a state."""
    return Nodes(types, state["lower"], float(state["spacing"]), state["stored"].shape, state["stored"])


def display_scale(colour: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the sensitivity of the displayed image to each coefficient of colour, (12,).

    It is the slope of sRGB times the radiance, as a root mean square over nodes.
    """
    radiance = np.exp(np.clip(colour[:, ::4], -12, 1.5))
    slope = np.where(radiance <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(radiance, 0.0031308) ** (1 / 2.4 - 1))
    return np.repeat(np.sqrt(np.average((slope * radiance) ** 2, axis=0, weights=weights)), 4)


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
    return centres, cKDTree(centres).query(points)[1]


# -- Hash grid and network ---------------------------------------------------------------------------------------------


def occupancy(nodes: Nodes) -> Nodes:
    """Return nodes twice as far apart around the occupied cells, of which only the empty distances are kept."""
    stored = cell_corners(coarser(complete_cells(nodes.stored)))
    result = nodes.like(COARSE * nodes.spacing, stored.shape, stored)
    result.index = None
    return result


class HashVolumeField(VolumeField):
    """Field of a hash grid and a network, which returns a raw density and twelve coefficients.

    The arrays ``entries`` and ``weights`` are flat. The field is empty outside of the occupied cells.
    """

    def __init__(self, nodes: Nodes, arrays: dict, encoding, network):
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, arrays)
        self.encoding, self.network, self.occupancy = encoding, network, occupancy(nodes)

    def free_distance(self, p, d, active=True):
        return self.occupancy.free_distance(p, d, active)

    #: The marching of rays differentiates colours by what :meth:`radiance_at` computes, not by ``point_data``.
    reads_again = False

    def for_training(self):
        field = super().for_training()
        field.reads_again = True
        return field

    def density_at(self, p, active=True):
        active = active & (self.occupancy.free_distance(p, self.types.Array3f(1, 0, 0), active) == 0)
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
    """Training of the largest hash grid and network of ``nbytes``, with cells as fine as those of a ``grid``."""

    def __init__(self, grid: NodeGrid, seen: np.ndarray, nbytes: float, seed: int = 1):
        self.nodes, self.nbytes, types = grid.nodes, nbytes, grid.nodes.types
        self.encoding, self.network = modules(self.nodes, nbytes, seed)
        weights = types.TensorXf(dr.detach(self.network["weights"])).numpy()
        # The last layer begins with an empty field of the mean colour
        bias = self.network.layers[-1].bias
        mean = np.average(grid.colour[1:], axis=0, weights=seen[1:] + LEAST)
        weights[bias.offset : bias.offset + 13 * bias.stride : bias.stride] = [0.0, *mean]
        self.net = {"entries": types.TensorXf(dr.detach(self.encoding.params)), "weights": types.TensorXf(weights)}

    def field_of(self, net) -> HashVolumeField:
        """Return the field of the trained parameters."""
        arrays = {"entries": net["entries"], "weights": net["weights"]}
        return HashVolumeField(self.nodes, arrays, self.encoding, self.network)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays of a file by name; numbers are in half precision."""
        half = {name: self.net[name].numpy().astype(np.float16) for name in ("entries", "weights")}
        return {**nodes_state(self.nodes), "nbytes": np.array(self.nbytes), **half}

    @staticmethod
    def field(types, state: dict) -> HashVolumeField:
        """Return the field of what :meth:`state` returned, which computes in single precision."""
        nodes = read_nodes(types, state)
        arrays = {name: device_tensor(types.TensorXf, state[name]) for name in ("entries", "weights")}
        field = HashVolumeField(nodes, arrays, *modules(nodes, float(state["nbytes"]), 1))
        field.nbytes = state["entries"].nbytes + state["weights"].nbytes + field.occupancy.nbytes
        return field


def modules(nodes: Nodes, nbytes: float, seed: int) -> tuple:
    """Return the untrained hash grid and network; raises as :func:`.hash_grid`."""
    types = nodes.types
    options = hash_grid(3, nbytes - occupancy(nodes).nbytes, max(nodes.shape), 13) | {"init_scale": 1e-2}
    encoding = nn.HashGridEncoding(types.Float, 3, rng=dr.rng(seed=seed), **options)
    hidden = [part for _ in range(LAYERS) for part in (nn.Linear(-1, WIDTH), nn.ReLU())]
    features = options["n_levels"] * options["n_features_per_level"]
    layers = nn.Sequential(*hidden, nn.Linear(WIDTH, 13)).alloc(types.TensorXf, features, dr.rng(seed=seed + 1))
    return encoding, nn.pack(layers, layout="training")
