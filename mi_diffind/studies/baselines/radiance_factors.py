"""Baselines without nodes: planes and lines (TensoRF, Chen et al. 2022), and a hash grid with a network.

The latter follows Instant-NGP (Müller et al. 2022) with the modules of ``drjit.nn``. Both skip empty space by an
:class:`Occupancy`.
"""

from __future__ import annotations

import itertools
import math

import drjit as dr
import numpy as np
from drjit import nn

from ...arrays.indirection import device_array, device_tensor
from ...arrays.sparse_grid import cell_corners, complete_cells
from ...tasks.radiance.nodes import COARSE, FARTHEST, Nodes, chessboard_distances
from ...tasks.radiance.volume_field import VolumeField, colour_of, density_of
from .node_codes import QuantisationSteps, deflated, mask_bytes
from .radiance import transformed
from .radiance_fits import HEADER, WeightedGrid, nodes_of, nodes_state

#: Raw density before training.
BEGIN = -4.0

#: Cells of the grid along a side of a wide cell; a cell of an occupancy spans :data:`COARSE` wide cells.
WIDER = 2


def wide_cells(stored: np.ndarray | None, shape) -> np.ndarray:
    """Return the wide cells, bool, that hold occupied cells of a grid of this shape with ``stored`` nodes."""
    cells = complete_cells(stored) if stored is not None else np.ones([n - 1 for n in shape], bool)
    padded = np.pad(cells, [(0, -n % WIDER) for n in cells.shape])
    x, y, z = (n // WIDER for n in padded.shape)
    return padded.reshape(x, WIDER, y, WIDER, z, WIDER).any(axis=(1, 3, 5))


class Occupancy:
    """Occupied cells and empty distances of a grid whose nodes are :data:`WIDER` times as far apart."""

    def __init__(self, nodes: Nodes):
        stored = cell_corners(wide_cells(nodes.stored, nodes.shape))
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


class OccupancyField(VolumeField):
    """Field that is empty outside of an :class:`Occupancy`: the base class."""

    def __init__(self, nodes: Nodes, arrays: dict, occupancy: Occupancy):
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, arrays)
        self.occupancy = occupancy

    def free_distance(self, p, d, active=True):
        return self.occupancy.nodes.free_distance(p, d, active)


def occupied_bytes(state: dict) -> int:
    """Return the bytes on disk of the occupancy of the nodes of a state."""
    cells = complete_cells(cell_corners(wide_cells(state.get("stored"), state["shape"])))
    return len(mask_bytes(chessboard_distances(cells) == 0))


TABLES = ("density_planes", "colour_planes")

#: Axes of a plane, and of the line that goes with it.
PLANES = (((0, 1), 2), ((0, 2), 1), ((1, 2), 0))


class PlanesField(OccupancyField):
    """Field of sums over three planes of products of ``R`` channels of a plane and a line.

    The arrays ``density_planes`` and ``colour_planes`` hold the texels of the three planes and then of the three lines,
    ``(n, R)`` each, R a multiple of four. ``matrix`` ``(3 R + 1, 12)`` maps the products of the colours to twelve
    coefficients. With ``steps``, ``words`` hold the texels instead, four bytes each.
    """

    def __init__(self, nodes: Nodes, shape, arrays: dict, ranks, occupancy: Occupancy, steps=None):
        super().__init__(nodes, arrays, occupancy)
        self.shape, self.ranks, self.steps = tuple(shape), tuple(ranks), steps
        # The first row of each plane and line
        sizes = [shape[a] * shape[b] for (a, b), _ in PLANES] + [shape[c] for _, c in PLANES]
        self.starts = [0, *np.cumsum(sizes).tolist()][:6]

    def _cell(self, p):
        cell = []
        for x, a, b, n in zip(p, self.lower, self.upper, self.shape, strict=True):
            u = (x - a) * ((n - 1) / (b - a))
            i = dr.clip(dr.floor(u), 0, n - 2)
            cell.append((self.types.UInt32(i), dr.clip(u - i, 0, 1)))
        return cell

    def _four(self, which: int, row, packet: int, active):
        name, count = TABLES[which], self.ranks[which] // 4
        at = dr.fma(row, count, packet)
        if self.steps is None:
            return list(dr.gather(self.types.Array4f, self.arrays[name].array, at, active))
        word = dr.gather(self.types.UInt32, self.words[which], at, active)
        s = self.steps[which]
        bytes_ = (self.types.Float(self.types.Int32((word >> (8 * k)) & 255)) for k in range(4))
        return [dr.fma(v, float(s.step[0]), float(s.low[0])) for v in bytes_]

    def _products(self, which: int, cell, active):
        """Yield the products of all planes, four at a time."""
        for (plane, line), start, along in zip(PLANES, self.starts[:3], self.starts[3:], strict=True):
            (i, u), (j, v), (k, w) = cell[plane[0]], cell[plane[1]], cell[line]
            width = self.shape[plane[1]]
            for packet in range(self.ranks[which] // 4):
                flat = [self.types.Float(0)] * 4
                for a, b in itertools.product((0, 1), repeat=2):
                    weight = (u if a else 1 - u) * (v if b else 1 - v)
                    four = self._four(which, dr.fma(i + a, width, j + b) + start, packet, active)
                    flat = [dr.fma(weight, x, total) for x, total in zip(four, flat, strict=True)]
                ends = [self._four(which, k + (along + e), packet, active) for e in (0, 1)]
                yield [x * dr.fma(w, b - a, a) for x, a, b in zip(flat, *ends, strict=True)]

    def density_at(self, p, active=True):
        active = self.occupancy(p, active)
        raw = self.types.Float(BEGIN)
        for four in self._products(0, self._cell(p), active):
            raw += four[0] + four[1] + four[2] + four[3]
        return dr.select(active, density_of(raw, self.per_voxel), 0), []

    def radiance_at(self, point_data, p, d, active=True):
        products = itertools.chain.from_iterable(self._products(1, self._cell(p), active))
        return colour_of(transformed(self.types, self.arrays["matrix"].array, products, active), d)


def sides_of(nodes: Nodes, spacing: float) -> list[int]:
    """Return the texels along the axes of the box of ``nodes`` at a ``spacing``."""
    return [max(2, math.ceil((b - a) / spacing) + 1) for a, b in zip(nodes.lower, nodes.upper, strict=True)]


def rows_of(shape) -> int:
    """Return the number of texels of all planes and lines."""
    return int(sum(shape[a] * shape[b] for (a, b), _ in PLANES) + sum(shape))


class PlanesFit:
    """Training of planes and lines in the box of a ``grid``, with texels at a ``spacing``."""

    #: Density numbers per unit of the trained parameter, since densities are products of two of them.
    SCALE = 3.0

    def __init__(self, grid: WeightedGrid, ranks: tuple[int, int], spacing: float, seed: int = 1):
        nodes = self.nodes = grid.nodes
        self.types, self.ranks = nodes.types, tuple(ranks)
        self.occupancy = Occupancy(nodes)
        self.shape = sides_of(nodes, spacing)
        rows = rows_of(self.shape)
        rng = np.random.default_rng(seed)
        self.net = {}
        for name, rank in zip(TABLES, ranks, strict=True):
            begin = rng.normal(scale=0.1, size=(rows, rank))
            self.net[name] = device_tensor(self.types.TensorXf, begin)
        mean = np.average(grid.colour, axis=0, weights=grid.seen + 1e-9)
        mixed = rng.normal(scale=0.3 / math.sqrt(ranks[1]), size=(3 * ranks[1], 12))
        self.net["matrix"] = device_tensor(self.types.TensorXf, np.concatenate([mixed, mean[None]]))
        self.steps = None

    def _scaled(self, net, index: int):
        value = net[TABLES[index]]
        return value * self.SCALE if index == 0 else value

    def round(self) -> None:
        """Round numbers to 8 bits of their current range from now on."""
        self.steps = []
        for k in (0, 1):
            values = self._scaled(self.net, k).numpy()
            self.steps.append(QuantisationSteps.between(float(values.min()), float(values.max())))

    def field_of(self, net) -> PlanesField:
        """Return the field of the trained parameters, after :meth:`round` rounded as they are stored."""
        values = [self._scaled(net, k) for k in (0, 1)]
        if self.steps is not None:
            values = [s.rounded(self.types, v) for s, v in zip(self.steps, values, strict=True)]
        arrays = dict(zip(TABLES, values, strict=True), matrix=net["matrix"])
        return PlanesField(self.nodes, self.shape, arrays, self.ranks, self.occupancy)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays of a file by name, after :meth:`round`."""
        state = {**nodes_state(self.nodes), "ranks": np.array(self.ranks), "sides": np.array(self.shape)}
        for k, name in enumerate(TABLES):
            state |= {name: self.steps[k].codes(self._scaled(self.net, k).numpy()), f"{name}_low": self.steps[k].low}
            state[f"{name}_step"] = self.steps[k].step
        return state | {"matrix": self.net["matrix"].numpy()}

    @staticmethod
    def field(types, state: dict) -> PlanesField:
        """Return the field that reads what :meth:`state` returned."""
        nodes = nodes_of(types, state)
        occupancy = Occupancy(nodes)
        matrix = device_tensor(types.TensorXf, state["matrix"])
        steps = [QuantisationSteps(state[f"{n}_low"], state[f"{n}_step"], np.array([256])) for n in TABLES]
        shape, ranks = map(tuple, (state["sides"].tolist(), state["ranks"].tolist()))
        field = PlanesField(nodes, shape, {"matrix": matrix}, ranks, occupancy, steps)
        field.words = [device_array(types.UInt32, np.ascontiguousarray(state[n]).view("<u4")) for n in TABLES]
        field.nbytes = 4 * (sum(map(dr.width, field.words)) + dr.width(matrix)) + occupancy.nbytes
        return field

    @staticmethod
    def file_bytes(state: dict, predict: bool = True) -> int:
        """Return the bytes on disk, after zlib."""
        packed = sum(len(deflated(np.ascontiguousarray(state[n].T).tobytes())) for n in TABLES)
        return HEADER + packed + state["matrix"].nbytes + occupied_bytes(state)


#: Hash grid: levels, numbers a level, and coarsest resolution; units of the hidden layer of the network.
LEVELS, FEATURES, COARSEST, WIDTH = 8, 2, 16, 32


class HashVolumeField(OccupancyField):
    """Field of a hash grid and a network of one hidden layer, which returns a raw density and twelve coefficients.

    The arrays ``entries`` and ``weights`` are flat.
    """

    def __init__(self, nodes: Nodes, arrays: dict, encoding, network, occupancy: Occupancy):
        super().__init__(nodes, arrays, occupancy)
        self.encoding, self.network = encoding, network

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
        nodes = nodes_of(types, state)
        arrays = {name: device_tensor(types.TensorXf, state[name]) for name in ("entries", "weights")}
        encoding, network = modules(types, int(state["sizes"][0]), float(state["sizes"][1]), 1)
        field = HashVolumeField(nodes, arrays, encoding, network, Occupancy(nodes))
        field.nbytes = state["entries"].nbytes + state["weights"].nbytes + field.occupancy.nbytes
        return field

    @staticmethod
    def file_bytes(state: dict, predict: bool = True) -> int:
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


def parameters(entries: int, finest: float) -> int:
    """Return the approximate number of parameters of a hash grid and its network."""
    scale = (finest / COARSEST) ** (1 / (LEVELS - 1))
    levels = sum(min(entries, (math.ceil(COARSEST * scale**k) + 1) ** 3) for k in range(LEVELS))
    return FEATURES * levels + WIDTH * (LEVELS * FEATURES + 1) + 13 * (WIDTH + 1)
