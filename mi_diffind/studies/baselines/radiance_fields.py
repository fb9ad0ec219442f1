"""Rivals of radiance fields in equal bytes: sparse grids of 8 bits, plain or with a codebook, and a hash grid.

A rival is a *fit* while it is trained through images: it has a ``net``, tensors by name that an optimiser trains at one
rate, and ``field_of``, which makes a field of it, rounded as it is stored. Its ``state`` are the arrays of a file, of
which ``field`` makes a field that reads bytes.

The codebook is the idea of VQRF (Li et al. 2023); the hash grid follows Instant-NGP (Müller et al. 2022) with the
modules of ``drjit.nn``.
"""

from __future__ import annotations

import zlib

import drjit as dr
import numpy as np
from drjit import nn
from scipy.spatial import cKDTree

from ...arrays.indirection import device_array, device_tensor
from ...arrays.sparse_grid import cell_corners, complete_cells
from ...arrays.tables import StoredArray
from ...core.units import largest_fitting
from ...tasks.radiance.compression import DENSEST, EMPTIEST, SMALLEST, Importance, clusters
from ...tasks.radiance.grid import DENSITY_SCALE, NodeGrid, refine
from ...tasks.radiance.nodes import COARSE, Nodes, coarser
from ...tasks.radiance.volume_field import (  # fmt: skip
    NodeField,
    NodeVolume,
    PackedPaletteField,
    PaletteArrays,
    VolumeField,
    colour_of,
    density_of,
)
from .networks import LAYERS, WIDTH, Network, hash_grid

#: Coefficients of a colour by direction: four for red, green and blue each.
COEFFICIENTS = 12

#: Lowest stored raw density, and the step to the next one.
DENSITY_RANGE = (EMPTIEST, (DENSEST - EMPTIEST) / 255)

#: Share of the nodes at either end of the range of colours that is clipped.
TAIL = 1e-3

#: Raw density of a network before training.
BEGIN = -4.0


def compressed_bytes(state: dict[str, np.ndarray]) -> int:
    """Return the bytes of the arrays of a fit on disk: those of zlib, of masks after packing their bits."""
    arrays = (np.packbits(a) if a.dtype == bool else a for a in map(np.asarray, state.values()))
    return sum(len(zlib.compress(a.tobytes(), 9)) for a in arrays)


# -- Grids of bytes ----------------------------------------------------------------------------------------------------


class ByteField(NodeVolume):
    """Field of sparse nodes that reads bytes: ``density`` (n,) and ``colour`` (n, 12), uint8.

    ``low`` and ``step`` (12,) say what the steps of colours mean. ``nbytes`` are all bytes in memory.
    """

    def __init__(self, nodes: Nodes, density: np.ndarray, colour: np.ndarray, low: np.ndarray, step: np.ndarray):
        types = nodes.types
        super().__init__(nodes.like(nodes.spacing, nodes.shape, nodes.stored, packed=True), {})
        self.low, self.step_of_colour = low.tolist(), step.tolist()
        # The first entry stands for no node
        self.density = types.UInt8(np.pad(density, (1, 0)))
        self.colour = device_array(types.UInt32, np.pad(colour, ((1, 0), (0, 0))).view("<u4"))
        self.nbytes = self.nodes.nbytes + dr.width(self.density) + 4 * dr.width(self.colour)

    def density_at(self, p, active=True):
        def level(number, seen):
            return self.types.Float(dr.gather(self.types.UInt8, self.density, number, seen))

        return self.interpolated_density(level, p, active, *DENSITY_RANGE)

    def radiance_at(self, point_data, p, d, active=True):
        types = self.types
        sums = [types.Float(0)] * COEFFICIENTS
        for weight, number in zip(point_data[:8], point_data[8:], strict=True):
            for j in range(COEFFICIENTS // 4):
                word = dr.gather(types.UInt32, self.colour, dr.fma(number, COEFFICIENTS // 4, j), active)
                for k in range(4):
                    byte = types.Float(types.Int32((word >> (8 * k)) & 255))
                    sums[4 * j + k] = dr.fma(weight, byte, sums[4 * j + k])
        return colour_of([dr.fma(v, a, b) for v, a, b in zip(sums, self.step_of_colour, self.low, strict=True)], d)


def memory_bytes(grid: NodeGrid, entries: int = 0) -> int:
    """Return the bytes in memory of a grid of bytes, with ``entries`` those of a codebook of so many colours."""
    nodes = grid.nodes
    index = nodes.like(nodes.spacing, nodes.shape, nodes.stored, packed=True).nbytes
    bits = 8 + (max(1, (entries - 1).bit_length()) if entries else 8 * COEFFICIENTS)
    return index + nodes.entries * bits // 8 + 8 + 16 * entries


def fitting_grid(grid: NodeGrid, cells: np.ndarray, nbytes: float, entries: int = 0) -> NodeGrid:
    """Return the part of a grid in ``cells``, bool, at the highest resolution that fits in ``nbytes``."""
    whole = refine(grid, cells)
    if memory_bytes(whole, entries) <= nbytes:
        return whole

    def fits(share: float) -> bool:
        return memory_bytes(refine(grid, cells, share), entries) <= nbytes

    return refine(grid, cells, largest_fitting(fits, SMALLEST, 1.0, steps=7))


def steps(values, low, step, functions):
    """Return the steps from 0 to 255 that are nearest to ``values``; ``functions`` are NumPy's or Dr.Jit's."""
    return functions.clip(functions.round((values - low) / step), 0, 255)


class NodesFit:
    """Training of a ``grid`` of bytes, each node with a colour of its own or, with ``entries``, a row of a codebook."""

    def __init__(self, grid: NodeGrid, importance: Importance, entries: int = 0):
        self.nodes, self.index, types = grid.nodes, None, grid.nodes.types
        colour = grid.colour
        if entries:
            scale = np.sqrt(importance.metric)
            centres = clusters(colour[1:] * scale, importance.colour, entries, 1)
            rows = cKDTree(centres).query(colour[1:] * scale)[1]
            colour, self.index = centres / scale, np.pad(rows, (1, 0)).astype(np.uint32)
        low, high = np.quantile(colour, (0, 1) if entries else (TAIL, 1 - TAIL), axis=0)
        self.low, self.step = low.astype(np.float32), (np.maximum(high - low, 1e-6) / 255).astype(np.float32)
        self.net = {
            "density": device_tensor(types.TensorXf, np.float32(grid.density)[:, None] / DENSITY_SCALE),
            "colour": device_tensor(types.TensorXf, np.float32(colour)),
        }
        self.rows = None if self.index is None else device_array(types.UInt32, self.index)

    def field_of(self, net) -> NodeField:
        """Return the field of the trained parameters, rounded as they are stored, with straight-through gradients."""

        def rounded(tensor, *scale):
            low, step = (self.nodes.types.TensorXf(np.atleast_2d(np.float32(v))) for v in scale)
            exact = dr.detach(tensor)
            return tensor + (steps(exact, low, step, dr) * step + low - exact)

        density = rounded(net["density"] * DENSITY_SCALE, *DENSITY_RANGE)
        return NodeField(self.nodes, density, rounded(net["colour"], self.low, self.step), self.rows)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays of a file by name."""
        density = steps(self.net["density"].numpy()[1:, 0] * DENSITY_SCALE, *DENSITY_RANGE, np).astype(np.uint8)
        colour = steps(self.net["colour"].numpy(), self.low, self.step, np).astype(np.uint8)
        state = {**nodes_state(self.nodes), "density": density, "low": self.low, "step": self.step}
        if self.index is None:
            return state | {"colour": colour[1:]}
        return state | {"colour": colour, "index": self.index[1:].astype(np.uint16)}

    @staticmethod
    def field(types, state: dict) -> NodeVolume:
        """Return the field that reads what :meth:`state` returned."""
        nodes = read_nodes(types, state)
        density, colour, low, step = (state[name] for name in ("density", "colour", "low", "step"))
        if "index" not in state:
            return ByteField(nodes, density, colour, low, step)
        palette = StoredArray(colour, (), tuple(step.tolist()), tuple(low.tolist()))
        index = np.pad(state["index"], (1, 0))
        numbers = PaletteArrays(np.pad(density, (1, 0)), 8, DENSITY_RANGE, index, palette)
        return PackedPaletteField(nodes.like(nodes.spacing, nodes.shape, nodes.stored, packed=True), numbers)


def nodes_state(nodes: Nodes) -> dict[str, np.ndarray]:
    """Return the arrays from which :func:`read_nodes` makes the nodes again."""
    return {"lower": np.array(nodes.lower), "spacing": np.array(nodes.spacing), "stored": nodes.stored}


def read_nodes(types, state: dict) -> Nodes:
    """Return the nodes of a state."""
    return Nodes(types, state["lower"], float(state["spacing"]), state["stored"].shape, state["stored"])


# -- Hash grid and network ---------------------------------------------------------------------------------------------


def occupancy(nodes: Nodes) -> Nodes:
    """Return nodes twice as far apart around the occupied cells, of which only the empty distances are kept."""
    stored = cell_corners(coarser(complete_cells(nodes.stored)))
    result = nodes.like(COARSE * nodes.spacing, stored.shape, stored)
    result.index = None
    return result


class HashVolumeField(VolumeField):
    """Field of a hash grid and a network, which returns a raw density and twelve coefficients.

    The ``arrays`` are ``entries`` and ``weights``, which take the place of those of ``net``. The field is empty outside
    of the occupied cells.
    """

    #: The marching of rays differentiates colours by what :meth:`radiance_at` computes, not by ``point_data``.
    reads_again = False

    def __init__(self, nodes: Nodes, arrays: dict, net: Network):
        super().__init__(nodes.types, nodes.lower, nodes.upper, nodes.spacing, arrays)
        self.net, self.occupancy = net, occupancy(nodes)

    def free_distance(self, p, d, active=True):
        return self.occupancy.free_distance(p, d, active)

    def for_training(self):
        field = super().for_training()
        field.reads_again = True
        return field

    def density_at(self, p, active=True):
        active = active & (self.occupancy.free_distance(p, self.types.Array3f(1, 0, 0), active) == 0)
        raw, *numbers = self._outputs(p, active)
        return dr.select(active, density_of(raw + BEGIN, self.per_voxel), 0), [] if self.reads_again else numbers

    def radiance_at(self, point_data, p, d, active=True):
        return colour_of(self._outputs(p, active)[1:] if self.reads_again else point_data, d)

    def _outputs(self, p, active):
        """Return the outputs of the network: a raw density and twelve coefficients."""
        longest = max(b - a for a, b in zip(self.lower, self.upper, strict=True))
        self.net.entries = self.arrays["entries"]
        for layer in self.net.mlp.layers:
            if isinstance(layer, nn.Linear):
                layer.weights.buffer = layer.bias.buffer = self.arrays["weights"].array
        return self.net([(x - a) * (1 / longest) for x, a in zip(p, self.lower, strict=True)], active)


class HashVolumeFit:
    """Training of the largest hash grid and network of ``nbytes``, with cells as fine as those of a ``grid``."""

    def __init__(self, grid: NodeGrid, importance: Importance, nbytes: float):
        self.nodes, self.nbytes, types = grid.nodes, nbytes, grid.nodes.types
        self.network = volume_network(self.nodes, nbytes)
        weights = types.TensorXf(dr.detach(self.network.mlp["weights"])).numpy()
        # The last layer begins with an empty field of the mean colour
        bias = self.network.mlp.layers[-1].bias
        mean = np.average(grid.colour[1:], axis=0, weights=importance.colour + 1e-9 * importance.colour.max())
        weights[bias.offset : bias.offset + 13 * bias.stride : bias.stride] = [0.0, *mean]
        self.net = {"entries": types.TensorXf(dr.detach(self.network.entries)), "weights": types.TensorXf(weights)}

    def field_of(self, net) -> HashVolumeField:
        """Return the field of the trained parameters."""
        return HashVolumeField(self.nodes, {name: net[name] for name in ("entries", "weights")}, self.network)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays of a file by name; numbers are in half precision."""
        half = {name: self.net[name].numpy().astype(np.float16) for name in ("entries", "weights")}
        return {**nodes_state(self.nodes), "nbytes": np.array(self.nbytes), **half}

    @staticmethod
    def field(types, state: dict) -> HashVolumeField:
        """Return the field of what :meth:`state` returned, which computes in single precision."""
        nodes = read_nodes(types, state)
        arrays = {name: device_tensor(types.TensorXf, state[name]) for name in ("entries", "weights")}
        field = HashVolumeField(nodes, arrays, volume_network(nodes, float(state["nbytes"])))
        field.nbytes = state["entries"].nbytes + state["weights"].nbytes + field.occupancy.nbytes
        return field


def volume_network(nodes: Nodes, nbytes: float) -> Network:
    """Return the untrained hash grid and network, in cooperative vectors; raises as :func:`.hash_grid`."""
    options = hash_grid(3, nbytes - occupancy(nodes).nbytes, max(nodes.shape), 13) | {"init_scale": 1e-2}
    network = Network(3, WIDTH, LAYERS, options, outputs=13)
    return network.alloc(nodes.types.TensorXf, rng=dr.rng(seed=1)).cooperative("training")
