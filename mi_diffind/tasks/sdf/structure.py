"""Masks of a sparse grid: which nodes are stored, from which the place of a node in a list follows by ranks.

Nodes lie at ``lower + spacing · (i, j, k)``. A *block* is 4 × 4 × 4 nodes, a *region* 4 × 4 × 4 blocks. A dense grid
says which regions have nodes, a mask in each of these which blocks have some, and a mask in each of these which nodes
are stored: the corners of all cells in which the sign changes. Only the sign of other nodes is kept: one bit for

- a region without nodes;
- a block without nodes;
- 2 × 2 × 2 nodes in a block with nodes: they are the corners of a cell, so if their signs differ, all are stored.

Everything outside of the grid is outside of the solid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...arrays.lookup import mask_flags, mask_words
from ...core.errors import DiffindError

#: Nodes along a side of a block and of a region.
BLOCK, REGION = 4, 16

#: Largest number of nodes in a grid: their ranks have 24 bits.
MOST_NODES = 2**24

#: Largest number of nodes along a side of the grid.
MOST_SIDE = 4096

#: Byte of a region with nodes. The lowest bit of any other byte says whether the region is inside.
ACTIVE = 255


class StructureError(DiffindError, ValueError):
    """Masks are inconsistent or too large; the message is one sentence."""


@dataclass(frozen=True)
class Structure:
    """Masks of the stored nodes and signs of the others.

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
        regions = np.argwhere(self.regions == ACTIVE)
        region, bit = np.nonzero(mask_flags(self.region_masks))
        return regions[region] * REGION + place_of(bit) * BLOCK

    def node_positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Return every stored node's position in the grid, ``(n, 3)``, and its block, ``(n,)``."""
        block, bit = np.nonzero(mask_flags(self.block_masks))
        return self.block_positions()[block] + place_of(bit), block

    def check(self) -> None:
        """Raise :class:`StructureError` if the masks are inconsistent or too large."""
        active = int((self.regions == ACTIVE).sum())
        if len(self.region_masks) != active or len(self.region_signs) != active:
            raise StructureError(f"{active} regions have nodes, found masks for {len(self.region_masks)}")
        blocks = int(mask_flags(self.region_masks).sum())
        if self.blocks != blocks or len(self.block_signs) != blocks:
            raise StructureError(f"{blocks} blocks have nodes, found masks for {self.blocks}")
        if self.nodes > MOST_NODES or max(self.shape) > MOST_SIDE:
            raise StructureError(
                f"found {self.nodes:,} nodes in a grid of {self.shape}, allowed are {MOST_NODES:,} and {MOST_SIDE} "
                f"along a side"
            )


def build(positions: np.ndarray, inside: np.ndarray, shape, lower, spacing: float, sign) -> Structure:
    """Build the structure of nodes at ``positions`` (n, 3), whole numbers, that are ``inside`` (n,) or not.

    The grid has ``shape`` nodes. ``sign`` is a function of points (m, 3) that returns whether they are inside. Nodes
    are in any order; :meth:`Structure.node_positions` has the order of the result.
    """
    regions_shape = tuple(-(-int(n) // REGION) for n in shape)

    def sign_at(nodes):
        return sign(np.asarray(lower) + spacing * nodes)

    region_of = np.ravel_multi_index((positions // REGION).T, regions_shape)
    active, region_of = np.unique(region_of, return_inverse=True)
    corner = np.stack(np.unravel_index(active, regions_shape), axis=1)
    blocks, block_of = np.unique(region_of * 64 + _bit_of(positions % REGION // BLOCK), return_inverse=True)
    region_bits = np.zeros((len(active), 64), bool)
    region_bits[blocks // 64, blocks % 64] = True
    block_bits = np.zeros((len(blocks), 64), bool)
    node_bit = _bit_of(positions % BLOCK)
    block_bits[block_of, node_bit] = True

    # The sign of an empty part is that of its first node
    empty_region, empty_block = np.nonzero(~region_bits)
    region_signs = np.zeros((len(active), 64), bool)
    region_signs[empty_region, empty_block] = sign_at(corner[empty_region] * REGION + place_of(empty_block) * BLOCK)

    first = corner[blocks // 64] * REGION + place_of(blocks % 64) * BLOCK
    group_bits = block_bits[:, _GROUPS]  # (blocks, 8 groups, 8 nodes)
    block, group = np.nonzero(~group_bits.all(axis=2))
    node_inside = np.zeros((len(blocks), 64), bool)
    node_inside[block_of, node_bit] = inside
    # The sign of a group is that of a stored node, or else of its first node
    stored = group_bits[block, group]
    values = node_inside[:, _GROUPS][block, group]
    some = stored.any(axis=1)
    signs = np.zeros(len(block), bool)
    signs[some] = (values & stored)[some].any(axis=1)
    signs[~some] = sign_at(first[block[~some]] + place_of(_GROUPS[group[~some], 0]))
    group_signs = np.zeros((len(blocks), 8), bool)
    group_signs[block, group] = signs

    regions = np.full(np.prod(regions_shape), ACTIVE, np.uint8)
    empty = np.setdiff1d(np.arange(regions.size), active)
    regions[empty] = sign_at(np.stack(np.unravel_index(empty, regions_shape), axis=1) * REGION)
    return Structure(
        tuple(map(float, lower)),
        float(spacing),
        regions.reshape(regions_shape),
        mask_words(region_bits),
        mask_words(region_signs),
        mask_words(block_bits),
        np.packbits(group_signs, axis=1, bitorder="little")[:, 0],
    )


def _bit_of(place: np.ndarray) -> np.ndarray:
    """Return the bit of a mask for a place (n, 3) of coordinates 0 to 3."""
    return place[:, 0] * 16 + place[:, 1] * 4 + place[:, 2]


def place_of(bit: np.ndarray) -> np.ndarray:
    """Return the place (n, 3), coordinates 0 to 3, of a bit of a mask."""
    return np.stack([bit // 16, bit // 4 % 4, bit % 4], axis=-1)


#: Bits of the nodes of each group of 2 × 2 × 2, (8, 8).
_GROUPS = np.array([
    [(2 * (g >> 2) + (n >> 2)) * 16 + (2 * (g >> 1 & 1) + (n >> 1 & 1)) * 4 + 2 * (g & 1) + (n & 1) for n in range(8)]
    for g in range(8)
])  # fmt: skip


def first_ranks(words: np.ndarray) -> np.ndarray:
    """Return the number of bits set in all masks before each one, ``(n,)`` uint32."""
    counts = mask_flags(words).sum(axis=1)
    return (np.cumsum(counts) - counts).astype(np.uint32)
