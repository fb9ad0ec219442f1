"""Sparse grids: masks of the stored nodes, ranks that number them, corners of cells, and distances of empty cells.

Node ``(i, j, k)`` of a grid lies at ``lower + spacing · (i, j, k)``; cell ``(i, j, k)`` has it as its lowest corner. A
mask has one bit for each place, and the *rank* of a place, the number of bits set before it, is its number in a list.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import numpy as np
from scipy.ndimage import distance_transform_cdt

from ..core.errors import DiffindError
from .indirection import device_array
from .lookup import mask_flags, mask_words

#: Corners of a cell, z fastest, ``(8, 3)``.
CORNERS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), axis=-1).reshape(8, 3)

#: Nodes along a side of a block of a :class:`SparseGrid`.
BLOCK = 4

#: Nodes along a side of a region: 4 blocks.
REGION = 16

#: Largest number of nodes in a :class:`SparseGrid`: their ranks have 24 bits.
MOST_NODES = 2**24

#: Largest number of nodes along a side of a :class:`SparseGrid`.
MOST_SIDE = 4096

#: Byte of a region with nodes. The lowest bit of any other byte says whether the region is inside.
ACTIVE = 255

#: Cells along a side of the parts of a grid whose distances are computed at a time, if distances are limited.
TILE = 64


class SparseGridError(DiffindError, ValueError):
    """Masks are inconsistent or too large; the message is one sentence."""


def mask_ranks(masks: np.ndarray) -> np.ndarray:
    """Return the number of bits set in all ``masks`` (n, words) before each one, ``(n,)`` uint32."""
    counts = mask_flags(masks).sum(axis=1)
    return (np.cumsum(counts) - counts).astype(np.uint32)


def rank(mask, bit):
    """Return how many bits of a 32-bit ``mask`` below ``bit`` are set (Dr.Jit)."""
    return dr.popcnt(mask & ((type(mask)(1) << bit) - 1))


def bit_and_rank(low, high, bit):
    """Return whether a bit of a 64-bit mask, given as two words, is set, and how many bits below it are (Dr.Jit)."""
    upper, place = bit >= 32, bit & 31
    word = dr.select(upper, high, low)
    return (word >> place & 1) == 1, rank(word, place) + dr.select(upper, dr.popcnt(low), 0)


def bit_of_place(place: np.ndarray) -> np.ndarray:
    """Return the bit of a 64-bit mask for places ``(…, 3)`` with coordinates 0 to 3."""
    return place @ np.array([16, 4, 1])


def place_of_bit(bit: np.ndarray) -> np.ndarray:
    """Return the places ``(…, 3)``, coordinates 0 to 3, of bits of a 64-bit mask."""
    return np.stack([bit // 16, bit // 4 % 4, bit % 4], axis=-1)


def complete_cells(stored: np.ndarray) -> np.ndarray:
    """Return the cells, bool ``(X − 1, Y − 1, Z − 1)``, whose corners are all among the ``stored`` nodes."""
    cells = np.ones(tuple(n - 1 for n in stored.shape), bool)
    for corner in CORNERS:
        cells &= stored[tuple(slice(c, n - 1 + c) for c, n in zip(corner, stored.shape, strict=True))]
    return cells


def cell_corners(cells: np.ndarray) -> np.ndarray:
    """Return the nodes, bool ``(X + 1, Y + 1, Z + 1)``, that are corners of one of the ``cells``."""
    nodes = np.zeros(tuple(n + 1 for n in cells.shape), bool)
    for corner in CORNERS:
        nodes[tuple(slice(c, n + c) for c, n in zip(corner, cells.shape, strict=True))] |= cells
    return nodes


def empty_distances(full: np.ndarray, most: int | None = None) -> np.ndarray:
    """Return the distance of each cell to the nearest ``full`` one, in cells, in the chessboard norm.

    Distances are at most ``most``, by default the longest side, which is also the distance where no cell is full.
    """
    tile, most = (max(full.shape),) * 2 if most is None else (TILE, most)
    result = np.full(full.shape, most, np.min_scalar_type(most))
    for place in np.ndindex(*(-(-n // tile) for n in full.shape)):
        begin = [max(0, tile * i - most) for i in place]
        part = full[tuple(slice(b, tile * (i + 1) + most) for b, i in zip(begin, place, strict=True))]
        if part.any():
            inner = tuple(slice(tile * i - b, tile * (i + 1) - b) for b, i in zip(begin, place, strict=True))
            distance = distance_transform_cdt(~part, "chessboard")[inner]
            result[tuple(slice(tile * i, tile * (i + 1)) for i in place)] = np.minimum(distance, most)
    return result


@dataclass(frozen=True)
class SparseGrid:
    """Masks of the stored nodes of a grid, and the signs of all others.

    A *block* is 4 × 4 × 4 nodes, a *region* 4 × 4 × 4 blocks. Of a node that is not stored only the sign is kept, one
    bit for a region without nodes, for a block without nodes, and for 2 × 2 × 2 nodes in a block with nodes: these are
    the corners of a cell, so if their signs differ, all are stored. Everything beyond the grid is outside.

    - ``regions`` (X, Y, Z) bytes: :data:`ACTIVE`, or the sign (1: inside) of a region without nodes;
    - ``region_masks``, ``region_signs`` (R, 2) words of 32 bits: for each region with nodes, its blocks with nodes, and
      the signs of its other blocks;
    - ``block_masks`` (B, 2) words: the stored nodes of each block; ``block_signs`` (B,) bytes: the signs of its eight
      groups of 2 × 2 × 2 nodes.

    Regions and blocks are in lexicographic order, blocks region by region; bits of a mask likewise, z fastest.
    """

    lower: tuple[float, float, float]
    spacing: float
    regions: np.ndarray
    region_masks: np.ndarray
    region_signs: np.ndarray
    block_masks: np.ndarray
    block_signs: np.ndarray

    @classmethod
    def from_nodes(
        cls, positions: np.ndarray, inside: np.ndarray, shape, lower, spacing: float, sign: Callable
    ) -> SparseGrid:
        """Return the grid of nodes at ``positions`` (n, 3), whole numbers below ``shape``, in any order.

        ``inside`` (n,): the signs of the nodes; ``sign``: a function of points (m, 3) that returns whether they are
        inside. :meth:`node_positions` has the order of the result.
        """
        sides = tuple(-(-int(n) // REGION) for n in shape)

        def sign_at(nodes):
            return sign(np.asarray(lower) + spacing * nodes)

        active, region = np.unique(np.ravel_multi_index((positions // REGION).T, sides), return_inverse=True)
        corner = REGION * np.stack(np.unravel_index(active, sides), axis=1)
        blocks, block = np.unique(region * 64 + bit_of_place(positions % REGION // BLOCK), return_inverse=True)
        region_bits = np.zeros((len(active), 64), bool)
        region_bits[blocks // 64, blocks % 64] = True
        node_bits, node_inside = np.zeros((2, len(blocks), 64), bool)
        node_bits[block, bit_of_place(positions % BLOCK)] = True
        node_inside[block, bit_of_place(positions % BLOCK)] = inside

        # The sign of an empty part is that of its first node
        region_signs = np.zeros((len(active), 64), bool)
        empty, bit = np.nonzero(~region_bits)
        region_signs[empty, bit] = sign_at(corner[empty] + BLOCK * place_of_bit(bit))
        regions = np.full(np.prod(sides), ACTIVE, np.uint8)
        empty = np.setdiff1d(np.arange(regions.size), active)
        regions[empty] = sign_at(REGION * np.stack(np.unravel_index(empty, sides), axis=1))

        # The sign of a group is that of a stored node, or else of its first node
        first = corner[blocks // 64] + BLOCK * place_of_bit(blocks % 64)
        stored = node_bits[:, _GROUPS]  # (blocks, 8 groups, 8 nodes)
        group_signs = (node_inside[:, _GROUPS] & ~stored.all(axis=2, keepdims=True)).any(axis=2)
        block, group = np.nonzero(~stored.any(axis=2))
        group_signs[block, group] = sign_at(first[block] + place_of_bit(_GROUPS[group, 0]))
        return cls(
            tuple(map(float, lower)),
            float(spacing),
            regions.reshape(sides),
            mask_words(region_bits),
            mask_words(region_signs),
            mask_words(node_bits),
            np.packbits(group_signs, axis=1, bitorder="little")[:, 0],
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes along x, y and z that the regions could hold."""
        return tuple(REGION * n for n in self.regions.shape)

    @property
    def upper(self) -> tuple[float, float, float]:
        """Position of the last node."""
        return tuple(a + self.spacing * (n - 1) for a, n in zip(self.lower, self.shape, strict=True))

    @property
    def nodes(self) -> int:
        """Number of stored nodes."""
        return int(mask_flags(self.block_masks).sum())

    @property
    def blocks(self) -> int:
        """Number of blocks with nodes."""
        return len(self.block_masks)

    @property
    def nbytes(self) -> int:
        """Bytes of masks, signs and ranks in memory; ranks of a region and a block take 4 and 3 bytes."""
        return self.regions.size * 4 + len(self.region_masks) * 20 + self.blocks * 12

    def block_positions(self) -> np.ndarray:
        """Return the first node of each block, ``(B, 3)``."""
        region, bit = np.nonzero(mask_flags(self.region_masks))
        return np.argwhere(self.regions == ACTIVE)[region] * REGION + place_of_bit(bit) * BLOCK

    def empty_block_signs(self) -> np.ndarray:
        """Return the signs of blocks without nodes at their places in the grid of blocks, bool (4 X, 4 Y, 4 Z)."""
        signs = np.repeat((self.regions & 1).astype(bool)[..., None], 64, axis=-1)
        signs[self.regions == ACTIVE] = mask_flags(self.region_signs)
        signs = signs.reshape(*self.regions.shape, 4, 4, 4).transpose(0, 3, 1, 4, 2, 5)
        return signs.reshape([4 * n for n in self.regions.shape])

    def node_positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the position of every stored node in the grid, ``(n, 3)``, and its block, ``(n,)``."""
        block, bit = np.nonzero(mask_flags(self.block_masks))
        return self.block_positions()[block] + place_of_bit(bit), block

    def cells(self) -> np.ndarray:
        """Return the cells whose corners are all stored: the numbers of these nodes, ``(K, 8)``, z fastest."""
        positions, _ = self.node_positions()
        shape = np.array(self.shape) + 1
        keys = np.ravel_multi_index(positions.T, shape)
        corners = keys[:, None] + np.ravel_multi_index(CORNERS.T, shape)
        order = np.argsort(keys)
        numbers = order[np.minimum(np.searchsorted(keys, corners, sorter=order), len(keys) - 1)]
        return numbers[(keys[numbers] == corners).all(axis=1)]

    def check(self) -> None:
        """Raise :class:`SparseGridError` if the masks are inconsistent or too large."""
        active = int((self.regions == ACTIVE).sum())
        if len(self.region_masks) != active or len(self.region_signs) != active:
            raise SparseGridError(f"{active} regions have nodes, found masks for {len(self.region_masks)}")
        blocks = int(mask_flags(self.region_masks).sum())
        if self.blocks != blocks or len(self.block_signs) != blocks:
            raise SparseGridError(f"{blocks} blocks have nodes, found masks for {self.blocks}")
        if self.nodes > MOST_NODES or max(self.shape) > MOST_SIDE:
            raise SparseGridError(
                f"found {self.nodes:,} nodes in a grid of {self.shape}, allowed are {MOST_NODES:,} and {MOST_SIDE} "
                f"along a side"
            )


#: Bits of the nodes of each group of 2 × 2 × 2 in a block, (8, 8).
_GROUPS = bit_of_place(2 * CORNERS[:, None] + CORNERS)


class GridIndex:
    """A :class:`SparseGrid` in memory, read by kernels of Dr.Jit.

    ``block_words`` (B,) uint32: one more word for each block, the last one of its :meth:`record`.
    """

    def __init__(self, types, grid: SparseGrid, block_words: np.ndarray | None = None):
        self.types, self._words = types, dr.uint32_array_t(types.Array4f)
        regions = grid.regions.reshape(-1).astype(np.uint32)
        active = regions == ACTIVE
        # A region with nodes: its number. Any other: the highest bit, and its sign in the lowest
        regions[~active] |= np.uint32(1 << 31)
        regions[active] = np.arange(active.sum(), dtype=np.uint32)
        words = grid.block_signs.astype(np.uint32) << np.uint32(24) | mask_ranks(grid.block_masks)
        block_words = np.zeros(grid.blocks, np.uint32) if block_words is None else block_words
        masks = np.concatenate([grid.region_masks, grid.region_signs], axis=1)
        blocks = np.stack([*grid.block_masks.T, words, block_words], axis=1)
        self._regions, self._masks, self._first_blocks, self._blocks = (
            device_array(types.UInt32, v) for v in (regions, masks, mask_ranks(grid.region_masks), blocks)
        )
        # Opaque: grids of other sizes use the same kernels
        self.region_sides = dr.opaque(types.Array3u, grid.regions.shape)
        self.last_cell = dr.opaque(types.Array3i, [n - 2 for n in grid.shape])

    @property
    def block_words(self) -> np.ndarray:
        """The additional words of the blocks, ``(B,)``."""
        return np.array(self._blocks).reshape(-1, 4)[:, 3]

    def region(self, i, j, k):
        """Return the number of the region of node (i, j, k) in the dense grid of regions."""
        UInt32, (_, ny, nz) = self.types.UInt32, self.region_sides
        return (UInt32(i >> 4) * ny + UInt32(j >> 4)) * nz + UInt32(k >> 4)

    def block(self, i, j, k, active):
        """Return the number of the block of node (i, j, k), whether it has nodes, and its sign if it has none."""
        UInt32 = self.types.UInt32
        word = dr.gather(UInt32, self._regions, self.region(i, j, k), active)
        has = active & (word < 2**31)
        masks = dr.gather(self._words, self._masks, word, has)
        bit = UInt32((i >> 2 & 3) * 16 + (j >> 2 & 3) * 4 + (k >> 2 & 3))
        in_mask, place = bit_and_rank(masks[0], masks[1], bit)
        inside = dr.select(has, bit_and_rank(masks[2], masks[3], bit)[0], (word & 1) == 1)
        has_nodes = has & in_mask
        return dr.gather(UInt32, self._first_blocks, word, has_nodes) + place, has_nodes, inside

    def record(self, number, active):
        """Return the four words of a block: its mask, its signs with the rank of its first node, and its own word."""
        return dr.gather(self._words, self._blocks, number, active)

    def node(self, record, i, j, k):
        """Return whether node (i, j, k) of a block is stored, its number, and whether it is inside if not stored."""
        UInt32 = self.types.UInt32
        x, y, z = UInt32(i & 3), UInt32(j & 3), UInt32(k & 3)
        stored, place = bit_and_rank(record[0], record[1], x * 16 + y * 4 + z)
        group = (x >> 1) * 4 + (y >> 1) * 2 + (z >> 1)
        return stored, (record[2] & 0xFFFFFF) + place, (record[2] >> (24 + group) & 1) == 1

    def corners(self, cell, active):
        """Return, for each corner of a cell, z fastest: ``(stored, number, record, position, inside)``.

        ``inside`` is the sign of a corner that is not stored.
        """
        i, j, k = cell
        first = self.block(i, j, k, active)
        first_record = self.record(first[0], first[1])
        corners = []
        for a, b, c in CORNERS.tolist():
            at = i + a, j + b, k + c
            (_, has, inside), record = first, first_record
            if a or b or c:
                # Mostly in the block of the first corner
                other = active & (((at[0] ^ i) | (at[1] ^ j) | (at[2] ^ k)) >> 2 != 0)
                number_, has_, inside_ = self.block(*at, other)
                record_ = self.record(number_, has_)
                has, inside = dr.select(other, has_, has), dr.select(other, inside_, inside)
                record = [dr.select(other, p, q) for p, q in zip(record_, record, strict=True)]
            stored, number, sign = self.node(record, *at)
            corners.append((has & stored, number, record, at, dr.select(has, sign, inside)))
        return corners
