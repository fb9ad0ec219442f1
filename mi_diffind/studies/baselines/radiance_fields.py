"""Rivals of radiance fields in equal bytes: sparse grids of 8 bits, plain or with a codebook.

The codebook is the idea of VQRF (Li et al. 2023).
"""

import zlib

import drjit as dr
import numpy as np
from scipy.spatial import cKDTree

from ...arrays.indirection import device_array, device_tensor
from ...arrays.tables import StoredArray
from ...core.units import largest_fitting
from ...tasks.radiance.compression import DENSEST, EMPTIEST, SMALLEST, Importance, clusters
from ...tasks.radiance.grid import DENSITY_SCALE, NodeGrid, refine
from ...tasks.radiance.nodes import Nodes
from ...tasks.radiance.volume_field import NodeField, NodeVolume, PackedPaletteField, PaletteArrays, colour_of

#: Coefficients of a colour by direction: four for red, green and blue each.
COEFFICIENTS = 12

#: Lowest stored raw density, and the step to the next one.
DENSITY_RANGE = (EMPTIEST, (DENSEST - EMPTIEST) / 255)

#: Share of the nodes at either end of the range of colours that is clipped.
TAIL = 1e-3


class ByteField(NodeVolume):
    """Field of packed nodes that reads bytes: ``density`` (n,) and ``colour`` (n, 12), uint8.

    ``low`` and ``step`` (12,) say what the steps of colours mean. ``nbytes`` are all bytes in memory.
    """

    def __init__(self, nodes: Nodes, density: np.ndarray, colour: np.ndarray, low: np.ndarray, step: np.ndarray):
        types = nodes.types
        super().__init__(nodes, {})
        self.low, self.step_of_colour = low.tolist(), step.tolist()
        # The first entry stands for no node
        self.density = types.UInt8(np.pad(density, (1, 0)))
        self.colour = device_array(types.UInt32, np.pad(colour, ((1, 0), (0, 0))).view("<u4"))
        self.nbytes = nodes.nbytes + dr.width(self.density) + 4 * dr.width(self.colour)

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
        state = {name: np.array(getattr(self.nodes, name)) for name in ("lower", "spacing", "stored")}
        state |= {"density": density, "low": self.low, "step": self.step}
        if self.index is None:
            return state | {"colour": colour[1:]}
        return state | {"colour": colour, "index": self.index[1:].astype(np.uint16)}

    @staticmethod
    def field(types, state: dict) -> NodeVolume:
        """Return the field that reads what :meth:`state` returned."""
        place = state["lower"], float(state["spacing"]), state["stored"].shape
        nodes = Nodes(types, *place, state["stored"], packed=True)
        density, colour, low, step = (state[name] for name in ("density", "colour", "low", "step"))
        if "index" not in state:
            return ByteField(nodes, density, colour, low, step)
        palette = StoredArray(colour, (), tuple(step.tolist()), tuple(low.tolist()))
        index = np.pad(state["index"], (1, 0))
        numbers = PaletteArrays(np.pad(density, (1, 0)), 8, DENSITY_RANGE, index, palette)
        return PackedPaletteField(nodes, numbers)


def compressed_bytes(state: dict[str, np.ndarray]) -> int:
    """Return the bytes of the arrays of a fit on disk: those of zlib, of masks after packing their bits."""
    arrays = (np.packbits(a) if a.dtype == bool else a for a in map(np.asarray, state.values()))
    return sum(len(zlib.compress(a.tobytes(), 9)) for a in arrays)
