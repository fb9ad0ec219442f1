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

from ...tasks.field.field import RadianceField, colour_of, density_of
from ...tasks.field.nodes import COARSE, Nodes, cells_of, corners_of
from .node_codes import Steps, deflated, mask_bytes

#: Raw density of a field that is not trained yet.
BEGIN = -4.0

#: Nodes of the grid that a field is made of along a side of a cell of its occupancy, divided by :data:`COARSE`.
WIDER = 2


class Occupancy:
    """Where something may be: cells of the coarse grid of distances of ``nodes``, each a byte."""

    def __init__(self, nodes: Nodes):
        """Of nodes :data:`WIDER` times as far apart as ``nodes``, whose cells are taken in."""
        shape = [-(-(n - 1) // WIDER) for n in nodes.shape]
        cells = cells_of(nodes.stored) if nodes.stored is not None else np.ones([n - 1 for n in nodes.shape], bool)
        padded = np.pad(cells, [(0, WIDER * m - n) for m, n in zip(shape, cells.shape, strict=True)])
        x, y, z = shape
        cells = padded.reshape(x, WIDER, y, WIDER, z, WIDER).any(axis=(1, 3, 5))
        self.nodes = Nodes(nodes.types, nodes.lower, WIDER * nodes.spacing, [n + 1 for n in shape], corners_of(cells))
        self.nodes.index = None
        self.occupied = self.nodes.far == 0
        self.types = nodes.types
        self.nbytes = 4 * dr.width(self.nodes.distances)

    def __call__(self, p, active=True):
        """Whether a cell is occupied."""
        side = COARSE * self.nodes.spacing
        at = self.types.UInt32(0)
        for x, a, n in zip(p, self.nodes.lower, self.occupied.shape, strict=True):
            u = dr.clip(dr.floor(dr.fma(x, 1 / side, -a / side)), 0, n - 1)
            at = dr.fma(at, n, self.types.UInt32(u))
        word = dr.gather(self.types.UInt32, self.nodes.distances, at >> 2, active)
        return active & (((word >> ((at & 3) << 3)) & 255) == 0)

    def skip(self, p, d, active=True):
        return self.nodes.skip(p, d, active)

    @property
    def file_bytes(self) -> int:
        return len(mask_bytes(self.occupied))


# -- planes and lines -------------------------------------------------------------------------------------------------

#: Axes of a plane, and of the line that goes with it.
PLANES = (((0, 1), 2), ((0, 2), 1), ((1, 2), 0))


class PlanesField(RadianceField):
    """
    Sums over three planes of products of ``R`` channels of a plane and a line: arrays ``density_planes`` and
    ``colour_planes``, the texels of the three planes and then of the three lines, ``(n, R)`` each, R a multiple of
    four, and ``matrix`` ``(3 R + 1, 12)``, which makes twelve numbers of the colours' products. With ``steps``, the
    first two hold words of four bytes.
    """

    def __init__(self, types, lower, upper, voxel, shape, arrays: dict, ranks, occupancy, steps=None, step=None):
        super().__init__(types, lower, upper, voxel, arrays, step)
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
        name, count = ("density_planes", "colour_planes")[which], self.ranks[which] // 4
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
            return [v for j in range(3) for v in dr.gather(self.types.Array4f, matrix, self.types.UInt32(3 * i + j), active)]

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


class PlanesFit:
    """Planes and lines of ``shape`` texels along the axes of a ``grid`` (:class:`.radiance_fits.Grid`)."""

    #: Of the numbers that are trained: a product of two of them is what counts.
    SCALE = 3.0

    def __init__(self, grid, ranks: tuple[int, int], spacing: float, seed: int = 1, step: float | None = None):
        nodes = self.nodes = grid.nodes
        self.types, self.ranks, self.step = nodes.types, ranks, step
        self.occupancy = Occupancy(nodes)
        self.shape = [max(2, math.ceil((b - a) / spacing) + 1) for a, b in zip(nodes.lower, nodes.upper, strict=True)]
        rows = int(sum(self.shape[a] * self.shape[b] for (a, b), _ in PLANES) + sum(self.shape))
        rng = np.random.default_rng(seed)
        self.net = {}
        for name, rank in zip(("density_planes", "colour_planes"), ranks, strict=True):
            begin = rng.normal(scale=0.1, size=(rows, rank))
            self.net[name] = self.types.TensorXf(begin.astype(np.float32))
        mean = np.average(grid.colour, axis=0, weights=grid.seen + 1e-9)
        mixed = rng.normal(scale=0.3 / math.sqrt(ranks[1]), size=(3 * ranks[1], 12))
        self.net["matrix"] = self.types.TensorXf(np.concatenate([mixed, mean[None]]).astype(np.float32))
        self.steps = None

    def _scaled(self, net, index: int):
        value = net[("density_planes", "colour_planes")[index]]
        return value * self.SCALE if index == 0 else value

    def rounding(self) -> None:
        """From here on, numbers are rounded to 8 bits of their range."""
        self.steps = []
        for k in (0, 1):
            low, high = (float(f(self._scaled(self.net, k).numpy())) for f in (np.min, np.max))
            step = (high - low) / 255
            self.steps.append(Steps(np.float32([low]), np.float32([step]), np.array([256])))

    def _field(self, arrays, steps=None) -> PlanesField:
        n = self.nodes
        return PlanesField(n.types, n.lower, n.upper, n.spacing, self.shape, arrays, self.ranks, self.occupancy, steps,
                           self.step)  # fmt: skip

    def field_of(self, net) -> PlanesField:
        values = [self._scaled(net, k) for k in (0, 1)]
        if self.steps is not None:
            values = [s.rounded(self.types, v) for s, v in zip(self.steps, values, strict=True)]
        return self._field({"density_planes": values[0], "colour_planes": values[1], "matrix": net["matrix"]})

    def codes(self) -> list[np.ndarray]:
        return [self.steps[k].codes(self._scaled(self.net, k).numpy()) for k in (0, 1)]

    def stored(self) -> PlanesField:
        found = self._field({"matrix": self.net["matrix"]}, self.steps)
        found.words = [self.types.UInt32(np.ascontiguousarray(c).view("<u4").reshape(-1)) for c in self.codes()]
        found.nbytes = 4 * (sum(map(dr.width, found.words)) + dr.width(self.net["matrix"])) + self.occupancy.nbytes
        return found

    def file_bytes(self, predict: bool = True) -> int:
        packed = sum(len(deflated(np.ascontiguousarray(c.T).tobytes())) for c in self.codes())
        return 64 + packed + 4 * dr.width(self.net["matrix"]) + self.occupancy.file_bytes


# -- hash grid and network --------------------------------------------------------------------------------------------

#: Levels of the hash grid, numbers a level, its coarsest resolution; units of the hidden layer.
LEVELS, FEATURES, COARSEST, WIDTH = 8, 2, 16, 32


class HashField(RadianceField):
    """
    A hash grid and a network of one hidden layer, which tells a raw density and twelve numbers of colour: arrays
    ``entries`` and ``weights``, flat.
    """

    def __init__(self, types, lower, upper, voxel, arrays: dict, encoding, network, occupancy, step=None):
        super().__init__(types, lower, upper, voxel, arrays, step)
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

    def __init__(self, grid, entries: int, finest: float, seed: int = 1, step: float | None = None):
        self.nodes, self.step = grid.nodes, step
        types = self.types = grid.nodes.types
        self.occupancy = Occupancy(grid.nodes)
        scale = (finest / COARSEST) ** (1 / (LEVELS - 1))
        self.encoding = nn.HashGridEncoding(
            types.Float, 3, n_levels=LEVELS, n_features_per_level=FEATURES, hashmap_size=entries // 16 * 16,
            base_resolution=COARSEST, per_level_scale=scale, align_corners=True, init_scale=1e-2,
            rng=dr.rng(seed=seed),
        )  # fmt: skip
        layers = nn.Sequential(nn.Linear(-1, WIDTH), nn.ReLU(), nn.Linear(WIDTH, 13))
        layers = layers.alloc(types.TensorXf, LEVELS * FEATURES, dr.rng(seed=seed + 1))
        mean = np.average(grid.colour, axis=0, weights=grid.seen + 1e-9)
        layers.layers[-1].bias = types.TensorXf(np.concatenate([[0.0], mean]).astype(np.float32))
        self.network = nn.pack(layers, layout="training")
        self.net = {
            "entries": types.TensorXf(dr.detach(self.encoding.params)),
            "weights": types.TensorXf(dr.detach(self.network["weights"])),
        }

    def field_of(self, net) -> HashField:
        n = self.nodes
        arrays = {"entries": net["entries"], "weights": net["weights"]}
        return HashField(n.types, n.lower, n.upper, n.spacing, arrays, self.encoding, self.network, self.occupancy, self.step)

    def halved(self) -> dict[str, np.ndarray]:
        """All numbers in half precision, in which they are stored."""
        return {name: value.numpy().astype(np.float16) for name, value in self.net.items()}

    def stored(self) -> HashField:
        half = {name: self.types.TensorXf(v.astype(np.float32)) for name, v in self.halved().items()}
        found = self.field_of(half)
        found.nbytes = sum(v.nbytes for v in self.halved().values()) + self.occupancy.nbytes
        return found

    def file_bytes(self, predict: bool = True) -> int:
        packed = sum(len(deflated(v.tobytes())) for v in self.halved().values())
        return 64 + packed + self.occupancy.file_bytes
