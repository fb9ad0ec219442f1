"""
Radiance fields that are no grids: planes and lines (the idea of TensoRF, Chen et al. 2022) and a hash grid with a
network (``drjit.nn``; of Instant-NGP, Müller et al. 2022). Both know from an :class:`Occupancy` where nothing is.
"""

from __future__ import annotations

import itertools
import math

import drjit as dr
import numpy as np
from drjit import nn

from ...tasks.radiance.field import VolumeField, colour_of, density_of
from ...tasks.radiance.nodes import COARSE, FARTHEST, Nodes, cells_of, corners_of, distances
from .node_codes import QuantisationSteps, deflated, mask_bytes
from .radiance_fits import HEADER, Grid, nodes_of, nodes_state

#: Raw density of a field that is not trained yet.
BEGIN = -4.0

#: Nodes of the grid that a field is made of along a side of a cell of its occupancy, divided by :data:`COARSE`.
WIDER = 2


def wide_cells(stored: np.ndarray | None, shape) -> np.ndarray:
    """The cells :data:`WIDER` times as wide as those of a grid, of nodes ``stored`` of this shape, that have some."""
    cells = cells_of(stored) if stored is not None else np.ones([n - 1 for n in shape], bool)
    padded = np.pad(cells, [(0, -n % WIDER) for n in cells.shape])
    x, y, z = (n // WIDER for n in padded.shape)
    return padded.reshape(x, WIDER, y, WIDER, z, WIDER).any(axis=(1, 3, 5))


class Occupancy:
    """Where something may be: cells of the coarse grid of distances of nodes :data:`WIDER` times as far apart."""

    def __init__(self, nodes: Nodes):
        stored = corners_of(wide_cells(nodes.stored, nodes.shape))
        self.nodes = Nodes(nodes.types, nodes.lower, WIDER * nodes.spacing, stored.shape, stored)
        self.nodes.index = None
        self.types, self.nbytes = nodes.types, self.nodes.nbytes

    def __call__(self, p, active=True):
        """Whether a cell is occupied."""
        side = COARSE * self.nodes.spacing
        at = self.types.UInt32(0)
        for x, a, n in zip(p, self.nodes.lower, self.nodes.far.shape, strict=True):
            u = dr.clip(dr.floor(dr.fma(x, 1 / side, -a / side)), 0, n - 1)
            at = dr.fma(at, n, self.types.UInt32(u))
        word = dr.gather(self.types.UInt32, self.nodes.distances, at >> 3, active)
        return active & (((word >> ((at & 7) << 2)) & FARTHEST) == 0)

    def skip(self, p, d, active=True):
        return self.nodes.skip(p, d, active)


def occupied_bytes(state: dict) -> int:
    """Bytes on disk of an occupancy of the nodes of a state."""
    cells = cells_of(corners_of(wide_cells(state.get("stored"), state["shape"])))
    return len(mask_bytes(distances(cells) == 0))


# -- planes and lines -------------------------------------------------------------------------------------------------

TABLES = ("density_planes", "colour_planes")

#: Axes of a plane, and of the line that goes with it.
PLANES = (((0, 1), 2), ((0, 2), 1), ((1, 2), 0))


class PlanesField(VolumeField):
    """
    Sums over three planes of products of ``R`` channels of a plane and a line: arrays ``density_planes`` and
    ``colour_planes``, the texels of the three planes and then of the three lines, ``(n, R)`` each, R a multiple of
    four, and ``matrix`` ``(3 R + 1, 12)``, which makes twelve numbers of the colours' products. With ``steps``, the
    first two hold words of four bytes.
    """

    def __init__(self, nodes: Nodes, shape, arrays: dict, ranks, occupancy: Occupancy, steps=None):
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, arrays)
        self.shape, self.ranks, self.occupancy, self.steps = tuple(shape), tuple(ranks), occupancy, steps
        self.starts = starts_of(self.shape)

    def _cell(self, p):
        found = []
        for x, a, b, n in zip(p, self.lower, self.upper, self.shape, strict=True):
            u = (x - a) * ((n - 1) / (b - a))
            i = dr.clip(dr.floor(u), 0, n - 2)
            found.append((self.types.UInt32(i), dr.clip(u - i, 0, 1)))
        return found

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
        """The products of all planes, four at a time."""
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

    def look(self, p, active=True):
        active = self.occupancy(p, active)
        raw = self.types.Float(BEGIN)
        for four in self._products(0, self._cell(p), active):
            raw += four[0] + four[1] + four[2] + four[3]
        return dr.select(active, density_of(raw, self.per_voxel), 0), []

    def colour(self, latent, p, d, active=True):
        matrix = self.arrays["matrix"].array

        def line(i: int):
            return [
                v for j in range(3) for v in dr.gather(self.types.Array4f, matrix, self.types.UInt32(3 * i + j), active)
            ]

        found, count = line(3 * self.ranks[1]), 0
        for four in self._products(1, self._cell(p), active):
            for value in four:
                found = [dr.fma(value, m, total) for m, total in zip(line(count), found, strict=True)]
                count += 1
        return colour_of(found, d)

    def skip(self, p, d, active=True):
        return self.occupancy.skip(p, d, active)


def starts_of(shape) -> list[int]:
    """The first row of each plane and line, and the end."""
    sizes = [shape[a] * shape[b] for (a, b), _ in PLANES] + [shape[c] for _, c in PLANES]
    return [0, *np.cumsum(sizes).tolist()][:6]


def sides_of(nodes: Nodes, spacing: float) -> list[int]:
    """Texels along the axes of the box of ``nodes`` that are ``spacing`` apart."""
    return [max(2, math.ceil((b - a) / spacing) + 1) for a, b in zip(nodes.lower, nodes.upper, strict=True)]


def rows_of(shape) -> int:
    """Texels of all planes and lines."""
    return int(sum(shape[a] * shape[b] for (a, b), _ in PLANES) + sum(shape))


class PlanesFit:
    """Planes and lines of ``shape`` texels along the axes of a ``grid`` (:class:`.radiance_fits.Grid`)."""

    #: Of the numbers that are trained: a product of two of them is what counts.
    SCALE = 3.0

    def __init__(self, grid: Grid, ranks: tuple[int, int], spacing: float, seed: int = 1):
        nodes = self.nodes = grid.nodes
        self.types, self.ranks = nodes.types, tuple(ranks)
        self.occupancy = Occupancy(nodes)
        self.shape = sides_of(nodes, spacing)
        rows = rows_of(self.shape)
        rng = np.random.default_rng(seed)
        self.net = {}
        for name, rank in zip(TABLES, ranks, strict=True):
            begin = rng.normal(scale=0.1, size=(rows, rank))
            self.net[name] = self.types.TensorXf(begin.astype(np.float32))
        mean = np.average(grid.colour, axis=0, weights=grid.seen + 1e-9)
        mixed = rng.normal(scale=0.3 / math.sqrt(ranks[1]), size=(3 * ranks[1], 12))
        self.net["matrix"] = self.types.TensorXf(np.concatenate([mixed, mean[None]]).astype(np.float32))
        self.steps = None

    def _scaled(self, net, index: int):
        value = net[TABLES[index]]
        return value * self.SCALE if index == 0 else value

    def round(self) -> None:
        """From here on, numbers are rounded to 8 bits of their range."""
        self.steps = []
        for k in (0, 1):
            low, high = (float(f(self._scaled(self.net, k).numpy())) for f in (np.min, np.max))
            step = (high - low) / 255
            self.steps.append(QuantisationSteps(np.float32([low]), np.float32([step]), np.array([256])))

    def field_of(self, net) -> PlanesField:
        values = [self._scaled(net, k) for k in (0, 1)]
        if self.steps is not None:
            values = [s.rounded(self.types, v) for s, v in zip(self.steps, values, strict=True)]
        arrays = dict(zip(TABLES, values, strict=True), matrix=net["matrix"])
        return PlanesField(self.nodes, self.shape, arrays, self.ranks, self.occupancy)

    def state(self) -> dict[str, np.ndarray]:
        """All that a file has to hold, by name; after :meth:`round`."""
        found = {**nodes_state(self.nodes), "ranks": np.array(self.ranks), "sides": np.array(self.shape)}
        for k, name in enumerate(TABLES):
            found |= {name: self.steps[k].codes(self._scaled(self.net, k).numpy()), f"{name}_low": self.steps[k].low}
            found[f"{name}_step"] = self.steps[k].step
        return found | {"matrix": self.net["matrix"].numpy()}

    @staticmethod
    def field(types, state: dict) -> PlanesField:
        """The field that reads what :meth:`state` returned."""
        nodes = nodes_of(types, state)
        occupancy = Occupancy(nodes)
        matrix = types.TensorXf(np.ascontiguousarray(state["matrix"], np.float32))
        steps = [QuantisationSteps(state[f"{n}_low"], state[f"{n}_step"], np.array([256])) for n in TABLES]
        shape, ranks = map(tuple, (state["sides"].tolist(), state["ranks"].tolist()))
        found = PlanesField(nodes, shape, {"matrix": matrix}, ranks, occupancy, steps)
        found.words = [types.UInt32(np.ascontiguousarray(state[n]).view("<u4").reshape(-1)) for n in TABLES]
        found.nbytes = 4 * (sum(map(dr.width, found.words)) + dr.width(matrix)) + occupancy.nbytes
        return found

    @staticmethod
    def file_bytes(state: dict, predict: bool = True) -> int:
        """Bytes on disk, after zlib."""
        packed = sum(len(deflated(np.ascontiguousarray(state[n].T).tobytes())) for n in TABLES)
        return HEADER + packed + state["matrix"].nbytes + occupied_bytes(state)


# -- hash grid and network --------------------------------------------------------------------------------------------

#: Levels of the hash grid, numbers a level, its coarsest resolution; units of the hidden layer.
LEVELS, FEATURES, COARSEST, WIDTH = 8, 2, 16, 32


class HashField(VolumeField):
    """
    A hash grid and a network of one hidden layer, which tells a raw density and twelve numbers of colour: arrays
    ``entries`` and ``weights``, flat.
    """

    def __init__(self, nodes: Nodes, arrays: dict, encoding, network, occupancy: Occupancy):
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, arrays)
        self.encoding, self.network, self.occupancy = encoding, network, occupancy

    def look(self, p, active=True):
        active = self.occupancy(p, active)
        longest = max(b - a for a, b in zip(self.lower, self.upper, strict=True))
        self.encoding.data = self.arrays["entries"].array
        for layer in self.network.layers:
            if isinstance(layer, nn.Linear):
                layer.weights.buffer = layer.bias.buffer = self.arrays["weights"].array
        features = self.encoding([(x - a) * (1 / longest) for x, a in zip(p, self.lower, strict=True)], active)
        raw, *numbers = self.network(nn.CoopVec(*features))
        return dr.select(active, density_of(raw + BEGIN, self.per_voxel), 0), numbers

    def colour(self, latent, p, d, active=True):
        return colour_of(latent, d)

    def skip(self, p, d, active=True):
        return self.occupancy.skip(p, d, active)


class HashFit:
    """A hash grid of at most ``entries`` a level, as fine as ``finest`` cells along the longest side."""

    def __init__(self, grid: Grid, entries: int, finest: float, seed: int = 1):
        self.nodes, self.sizes = grid.nodes, (entries, finest)
        types = self.types = grid.nodes.types
        self.occupancy = Occupancy(grid.nodes)
        self.encoding, self.network = modules(types, entries, finest, seed)
        weights = types.TensorXf(dr.detach(self.network["weights"]))
        # What the last layer begins with: nothing, of the mean colour
        bias = self.network.layers[-1].bias
        mean = np.average(grid.colour, axis=0, weights=grid.seen + 1e-9)
        begin = weights.numpy().copy()
        begin[bias.offset : bias.offset + 13 * bias.stride : bias.stride] = [0.0, *mean]
        self.net = {"entries": types.TensorXf(dr.detach(self.encoding.params)), "weights": types.TensorXf(begin)}

    def field_of(self, net) -> HashField:
        arrays = {"entries": net["entries"], "weights": net["weights"]}
        return HashField(self.nodes, arrays, self.encoding, self.network, self.occupancy)

    def state(self) -> dict[str, np.ndarray]:
        """All that a file has to hold, by name: numbers in half precision."""
        half = {name: self.net[name].numpy().astype(np.float16) for name in ("entries", "weights")}
        return {**nodes_state(self.nodes), "sizes": np.array(self.sizes), **half}

    @staticmethod
    def field(types, state: dict) -> HashField:
        """The field of what :meth:`state` returned, which computes in single precision."""
        nodes = nodes_of(types, state)
        arrays = {name: types.TensorXf(state[name].astype(np.float32)) for name in ("entries", "weights")}
        encoding, network = modules(types, int(state["sizes"][0]), float(state["sizes"][1]), 1)
        found = HashField(nodes, arrays, encoding, network, Occupancy(nodes))
        found.nbytes = state["entries"].nbytes + state["weights"].nbytes + found.occupancy.nbytes
        return found

    @staticmethod
    def file_bytes(state: dict, predict: bool = True) -> int:
        """Bytes on disk, after zlib."""
        return HEADER + sum(len(deflated(state[n].tobytes())) for n in ("entries", "weights")) + occupied_bytes(state)


def modules(types, entries: int, finest: float, seed: int) -> tuple:
    """The hash grid and the network, untrained."""
    scale = (finest / COARSEST) ** (1 / (LEVELS - 1))
    encoding = nn.HashGridEncoding(
        types.Float, 3, n_levels=LEVELS, n_features_per_level=FEATURES, hashmap_size=entries // 16 * 16,
        base_resolution=COARSEST, per_level_scale=scale, align_corners=True, init_scale=1e-2, rng=dr.rng(seed=seed),
    )  # fmt: skip
    layers = nn.Sequential(nn.Linear(-1, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 13))
    layers = layers.alloc(types.TensorXf, LEVELS * FEATURES, dr.rng(seed=seed + 1))
    return encoding, nn.pack(layers, layout="training")


def parameters(entries: int, finest: float) -> int:
    """Numbers of a hash grid and its network, about."""
    scale = (finest / COARSEST) ** (1 / (LEVELS - 1))
    levels = sum(min(entries, (math.ceil(COARSEST * scale**k) + 1) ** 3) for k in range(LEVELS))
    return FEATURES * levels + WIDTH * (LEVELS * FEATURES + 1) + 13 * (WIDTH + 1)
