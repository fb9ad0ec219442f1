"""From a grid to a palette: what is kept, how it begins, how it is trained through the images, how it is stored."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np

from ...indirection import fold
from . import grid as grids
from .coded import CodedField, PackedField
from .grid import Grid
from .nodes import Nodes
from .palette import clusters, importance
from .training import Images, ImagesProblem
from .views import Views

#: Raw numbers of density at the ends of a curve as it begins: nothing, and opaque.
EMPTIEST, DENSEST = -7.0, 12.0

#: Bits of a node's coordinate in the curve, and entries of the curve while it is trained.
SHARE_BITS, CURVE = 6, 16

#: Of the numbers of the curve and of the palette, per unit of what is trained.
CURVE_SCALE = 20.0

#: Bits of an index that may be asked for, and the default.
CODE_BITS, DEFAULT_BITS = (6, 8, 10, 12, 14), 12

#: Steps after which the range of the palette's bytes is looked at again.
RANGED = 50

#: The smallest grid, of its full resolution.
SMALLEST = 0.2


@dataclass
class Coding:
    """A grid's ``nodes``, their ``shares`` in [0, 1] and ``codes``, ``(n,)``, and the ``palette`` ``(P, 12)``."""

    nodes: Nodes
    shares: np.ndarray
    codes: np.ndarray
    palette: np.ndarray
    code_bits: int


def coded(grid: Grid, images: Images, code_bits: int, seed: int) -> Coding:
    """The coding of a grid of visible nodes, as it begins."""
    largest = grids.weights(grid.field(), images)
    weights = importance(largest, grid.nodes.stored, grid.colour[1:])
    palette, codes = clusters(grid.colour[1:], weights, 2**code_bits, seed)
    # Neighbours in the palette look alike, so that the upper bits of an index vary little: they deflate
    centred = palette - palette.mean(axis=0)
    first = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    order = np.argsort(centred @ first, kind="stable")
    rank = np.empty(len(order), np.uint32)
    rank[order] = np.arange(len(order))
    shares = np.clip((grid.density - EMPTIEST) / (DENSEST - EMPTIEST), 0, 1).astype(np.float32)
    return Coding(grid.nodes, shares, np.concatenate([[0], rank[codes]]).astype(np.uint32), palette[order], code_bits)


class PaletteProblem(ImagesProblem):
    """
    The training of a :class:`Coding` through the images: coordinates in the curve, rounded as they will be stored; the
    curve; the palette, of bytes. Indices stay as they are.
    """

    def __init__(self, coding: Coding, views: Views, held: Views | None = None):
        self.coding, types = coding, coding.nodes.types
        self.codes = types.UInt32(coding.codes)
        line = np.linspace(EMPTIEST, DENSEST, CURVE, dtype=np.float32) / CURVE_SCALE
        tensor = types.TensorXf
        net = {"share": tensor(coding.shares), "curve": tensor(line), "palette": tensor(np.float32(coding.palette))}
        super().__init__(types, net, self.field_of, views, held)
        self._set_range()

    def field_of(self, net) -> CodedField:
        steps = 2**SHARE_BITS - 1
        share = fold(net["share"].array)
        exact = dr.detach(share)
        share += dr.detach(dr.round(exact * steps) / steps - exact)
        palette = net["palette"]
        lane = dr.arange(self.types.UInt32, len(self.coding.palette) * 12) % 12
        a, b = (dr.gather(self.types.Float, v, lane) for v in self.range)
        exact = dr.detach(palette.array)
        entries = palette.array + dr.detach(dr.fma(dr.round((exact - b) / a), a, b) - exact)
        tensor = self.types.TensorXf
        curve = tensor(net["curve"].array * CURVE_SCALE)
        return CodedField(self.coding.nodes, tensor(share), curve, self.codes, tensor(entries, palette.shape))

    def begin(self, step, share):
        # Numbers that leave the range of the bytes are rounded to steps beyond it until then
        if step % RANGED == 0:
            self._set_range()
        return ""

    def _set_range(self) -> None:
        self.range = [self.types.Float(np.float32(v)) for v in byte_range(self.net["palette"].numpy())]

    def stored(self) -> dict[str, np.ndarray]:
        """What is stored: ``shares``, ``curve``, ``codes``, ``palette`` (bytes), its ``scale`` and ``offset``."""
        steps, net = 2**SHARE_BITS - 1, self.net
        shares = fold(net["share"].array).numpy()
        line = net["curve"].numpy().astype(np.float64) * CURVE_SCALE
        curve = np.interp(np.linspace(0, 1, steps + 1), np.linspace(0, 1, len(line)), line)
        palette = net["palette"].numpy()
        scale, offset = byte_range(palette)
        return {
            "shares": np.rint(shares.astype(np.float64) * steps).astype(np.uint8),
            "curve": curve.astype(np.float32),
            "codes": self.coding.codes,
            "palette": np.clip(np.rint((palette - offset) / scale), 0, 255).astype(np.uint8),
            "scale": scale,
            "offset": offset,
        }


def byte_range(palette: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The step and the least of each of twelve numbers, as bytes hold them."""
    low, high = palette.min(axis=0).astype(np.float64), palette.max(axis=0).astype(np.float64)
    return np.maximum((high - low) / 255, 1e-6), low


def packed_bytes(grid: Grid, code_bits: int) -> int:
    """Bytes in memory of the packed field of such a grid."""
    nodes = grid.nodes
    index = Nodes(nodes.types, nodes.lower, nodes.spacing, nodes.shape, nodes.stored, packed=True).nbytes
    words = nodes.entries * (SHARE_BITS + code_bits) // 8 + 8
    return index + words + 4 * 2**SHARE_BITS + 16 * min(2**code_bits, nodes.count)


def sized(grid: Grid, images: Images, nbytes: int | None) -> tuple[Grid, int]:
    """
    The visible part of a grid, as fine as fits in ``nbytes`` (``None``: as it is), and the bits of its indices: the
    most that fit at the full resolution, 10 at a lower one. Raises ``ValueError`` if nothing fits.
    """
    cells = grids.visible(grid, images)
    whole = grids.divided(grid, cells, 1, 0)
    if nbytes is None:
        return whole, DEFAULT_BITS
    for bits in sorted(CODE_BITS, reverse=True):
        if bits >= 8 and packed_bytes(whole, bits) <= nbytes:
            return whole, bits
    low, high, found = SMALLEST, 1.0, None
    for _ in range(7):
        middle = (low + high) / 2
        smaller = grids.divided(grid, cells, middle, 0)
        bits = 10 if packed_bytes(smaller, 10) <= nbytes else 8
        if packed_bytes(smaller, bits) <= nbytes:
            low, found = middle, (smaller, bits)
        else:
            high = middle
    if found is None:
        smallest = packed_bytes(grids.divided(grid, cells, SMALLEST, 0), 6)
        raise ValueError(f"{nbytes:,} bytes are fewer than the smallest field needs, about {smallest:,}")
    return found


def packed_field(nodes: Nodes, stored: dict, code_bits: int) -> PackedField:
    """The field of what :meth:`PaletteProblem.stored` returned; ``nodes`` with a packed index."""
    return PackedField(
        nodes, stored["shares"], SHARE_BITS, stored["curve"], stored["codes"], code_bits, stored["palette"],
        stored["scale"], stored["offset"],
    )  # fmt: skip
