"""
Where the nodes of a sparse grid are: bit masks with ranks, from which the place of a node in a list follows.

Nodes lie at ``lower + spacing · (i, j, k)``. 4 × 4 × 4 of them make a *block*, 4 × 4 × 4 blocks a *region*. A dense
grid says which regions have nodes, a mask in each of these which blocks have, a mask in each of these which nodes are
stored: the corners of all cells in which the sign changes. Of all others only the sign is known:

- of a region without nodes, with a lower bound of the distance to the surface (for who steps from place to place; rays
  go by :mod:`.index`);
- of a block without nodes;
- of 2 × 2 × 2 nodes in a block with nodes: they are the corners of a cell, so that, if their signs differ, all of them
  are stored. One bit for eight nodes is therefore all that has to be kept.

What lies outside of the grid is outside of the solid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...bits import mask_flags, mask_words
from ...errors import DiffindError

#: Nodes along a side of a block and of a region.
BLOCK, REGION = 4, 16

#: Most nodes that a grid may have: their ranks have 24 bits.
MOST_NODES = 2**24

#: Most nodes along a side of the grid.
MOST_SIDE = 4096

#: A region's byte if it has nodes. Others: twice the lower bound of the distance, in spacings, at most 126, plus one if
#: inside.
ACTIVE = 255


class StructureError(DiffindError, ValueError):
    """Masks that do not go together, or too many of them; the message is one sentence."""


@dataclass(frozen=True)
class Structure:
    """
    Which nodes are stored. ``regions``: ``(X, Y, Z)`` bytes, :data:`ACTIVE` or what is known of an empty one.
    ``region_masks``, ``region_signs``: ``(R, 2)`` words of 32 bits, for each region with nodes the blocks that have
    some, and the signs (1: inside) of those that have none. ``block_masks``: ``(B, 2)`` words, the nodes that are
    stored in each block, ``block_signs``: ``(B,)`` bytes, the signs of its eight groups of 2 × 2 × 2 nodes. Regions and
    blocks in lexicographic order, blocks region by region; bits of a mask likewise, z fastest.
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
        """The position of the last node."""
        return tuple(a + self.spacing * (n - 1) for a, n in zip(self.lower, self.shape, strict=True))

    @property
    def first_blocks(self) -> np.ndarray:
        """For each region with nodes, its first block. ``(R,)`` uint32."""
        return _before(self.region_masks)

    @property
    def first_nodes(self) -> np.ndarray:
        """For each block, its first node. ``(B,)`` uint32."""
        return _before(self.block_masks)

    @property
    def nodes(self) -> int:
        """Nodes that are stored."""
        return int(_count(self.block_masks).sum())

    @property
    def blocks(self) -> int:
        """Blocks with nodes."""
        return len(self.block_masks)

    @property
    def nbytes(self) -> int:
        """Bytes of the masks, signs and ranks in memory: a region's and a block's ranks have 4 and 3 bytes."""
        return self.regions.size * 4 + len(self.region_masks) * 20 + self.blocks * 12

    def block_positions(self) -> np.ndarray:
        """The first node of each block, ``(B, 3)``."""
        regions = np.argwhere(self.regions == ACTIVE)
        inner = mask_flags(self.region_masks)
        region, bit = np.nonzero(inner)
        return regions[region] * REGION + _places(bit) * BLOCK

    def node_positions(self) -> tuple[np.ndarray, np.ndarray]:
        """Every stored node's position in the grid, ``(n, 3)``, and its block, ``(n,)``."""
        block, bit = np.nonzero(mask_flags(self.block_masks))
        return self.block_positions()[block] + _places(bit), block

    def check(self) -> None:
        """Raise :class:`StructureError` for masks that do not go together."""
        active = int((self.regions == ACTIVE).sum())
        if len(self.region_masks) != active or len(self.region_signs) != active:
            raise StructureError(f"{active} regions have nodes, masks are there for {len(self.region_masks)}")
        blocks = int(_count(self.region_masks).sum())
        if self.blocks != blocks or len(self.block_signs) != blocks:
            raise StructureError(f"{blocks} blocks have nodes, masks are there for {self.blocks}")
        if self.nodes > MOST_NODES or max(self.shape) > MOST_SIDE:
            raise StructureError(
                f"found {self.nodes:,} nodes in a grid of {self.shape}, allowed are {MOST_NODES:,} and {MOST_SIDE} "
                f"along a side"
            )


def build(positions: np.ndarray, inside: np.ndarray, shape, lower, spacing: float, sign, bound) -> Structure:
    """
    The structure of the nodes at ``positions`` (n, 3), whole numbers of a grid of ``shape`` nodes, that are ``inside``
    (n,) or not. ``sign`` and ``bound`` are functions of points (m, 3): whether they are inside, and a lower bound of
    the distance to the surface. Nodes are in any order; :meth:`Structure.node_positions` has that of the result.
    """
    regions_shape = tuple(-(-int(n) // REGION) for n in shape)

    def at(nodes):
        return np.asarray(lower) + spacing * nodes

    region_of = np.ravel_multi_index((positions // REGION).T, regions_shape)
    active, region_of = np.unique(region_of, return_inverse=True)
    corner = np.stack(np.unravel_index(active, regions_shape), axis=1)
    block_in_region = _bit(positions % REGION // BLOCK)
    blocks, block_of = np.unique(region_of * 64 + block_in_region, return_inverse=True)
    region_bits = np.zeros((len(active), 64), bool)
    region_bits[blocks // 64, blocks % 64] = True
    block_bits = np.zeros((len(blocks), 64), bool)
    node_bit = _bit(positions % BLOCK)
    block_bits[block_of, node_bit] = True

    # Of what is not stored, the first node is asked for its sign
    empty_region, empty_block = np.nonzero(~region_bits)
    region_signs = np.zeros((len(active), 64), bool)
    region_signs[empty_region, empty_block] = sign(at(corner[empty_region] * REGION + _places(empty_block) * BLOCK))

    first = corner[blocks // 64] * REGION + _places(blocks % 64) * BLOCK
    group_bits = block_bits[:, _GROUPS]  # (blocks, 8 groups, 8 nodes)
    partly = ~group_bits.all(axis=2)
    which_block, which_group = np.nonzero(partly)
    node_inside = np.zeros((len(blocks), 64), bool)
    node_inside[block_of, node_bit] = inside
    # A stored node of the group knows; otherwise its first node is asked for
    known = group_bits[which_block, which_group]
    values = node_inside[:, _GROUPS][which_block, which_group]
    some = known.any(axis=1)
    signs = np.zeros(len(which_block), bool)
    signs[some] = (values & known)[some].any(axis=1)
    asked = first[which_block[~some]] + _places(_GROUPS[which_group[~some], 0])
    signs[~some] = sign(at(asked))
    group_signs = np.zeros((len(blocks), 8), bool)
    group_signs[which_block, which_group] = signs

    regions = np.full(np.prod(regions_shape), ACTIVE, np.uint8)
    empty = np.setdiff1d(np.arange(regions.size), active)
    start = np.stack(np.unravel_index(empty, regions_shape), axis=1) * REGION
    # Of the cells between these nodes and the next: half a diagonal from the middle
    free = bound(at(start + REGION / 2)) / spacing - np.sqrt(3) * REGION / 2 - 1e-3
    regions[empty] = 2 * np.clip(np.floor(free), 0, 126).astype(np.uint8) + sign(at(start))
    return Structure(
        tuple(map(float, lower)),
        float(spacing),
        regions.reshape(regions_shape),
        mask_words(region_bits),
        mask_words(region_signs),
        mask_words(block_bits),
        np.packbits(group_signs, axis=1, bitorder="little")[:, 0],
    )


def _bit(place: np.ndarray) -> np.ndarray:
    """The bit of a mask for a place (n, 3) of 0 to 3."""
    return place[:, 0] * 16 + place[:, 1] * 4 + place[:, 2]


def _places(bit: np.ndarray) -> np.ndarray:
    """The reverse: (n, 3)."""
    return np.stack([bit // 16, bit // 4 % 4, bit % 4], axis=-1)


#: The bits of the nodes of each group of 2 × 2 × 2, (8, 8).
_GROUPS = np.array([
    [(2 * (g >> 2) + (n >> 2)) * 16 + (2 * (g >> 1 & 1) + (n >> 1 & 1)) * 4 + 2 * (g & 1) + (n & 1) for n in range(8)]
    for g in range(8)
])  # fmt: skip


def _count(words: np.ndarray) -> np.ndarray:
    return mask_flags(words).sum(axis=1)


def _before(words: np.ndarray) -> np.ndarray:
    counts = _count(words)
    return (np.cumsum(counts) - counts).astype(np.uint32)
