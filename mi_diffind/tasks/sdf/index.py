"""
What rays through a sparse grid go by: made of its masks, and of what its nodes hold, when it is first traced.

NumPy only; :class:`.marching.Marcher` has it in memory. Lengths are in spacings, as the structure's.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_cdt

from ...bits import mask_flags
from .codes import frames_numpy
from .nodes import CORNERS, bernstein
from .structure import ACTIVE, BLOCK, _places

#: A word of a block without crossed cells: this, the sign, and how far the next one that has some is, in blocks.
EMPTY, INSIDE = 1 << 31, 1 << 30

#: Slabs are within ± this of a block's plane, which cannot be farther off in it, in steps of 16 bits; and their margin.
SLAB, STEPS, MARGIN = 10.0, 65535, 1e-3

#: The middle of a block, from its first node.
MIDDLE = (BLOCK - 1) / 2


def cells_of(structure) -> tuple[np.ndarray, ...]:
    """
    For each block with nodes: whether each of its 64 cells is crossed, that is, all its corners are stored; whether the
    others are inside, ``(B, 64)``; and the blocks that their corners lie in, ``(B, 8)``, the block itself where there
    is none. And the signs of blocks without nodes, at their places in the grid.
    """
    at = structure.block_positions() // BLOCK
    number = np.full([n // BLOCK + 1 for n in structure.shape], -1)
    number[tuple(at.T)] = np.arange(len(at))
    beside = np.stack([number[tuple((at + n).T)] for n in CORNERS], axis=1)

    # The signs of blocks without nodes, beyond the grid outside
    empty = np.zeros(number.shape, bool)
    coarse = (structure.regions & 1).astype(bool)
    for x, y, z in np.ndindex(4, 4, 4):
        part = coarse.copy()
        part[structure.regions == ACTIVE] = mask_flags(structure.region_signs)[:, x * 16 + y * 4 + z]
        empty[x : x + 4 * coarse.shape[0] : 4, y : y + 4 * coarse.shape[1] : 4, z : z + 4 * coarse.shape[2] : 4][
            : coarse.shape[0], : coarse.shape[1], : coarse.shape[2]
        ] = part

    nodes = np.concatenate([mask_flags(structure.block_masks).reshape(-1, 4, 4, 4), np.zeros((1, 4, 4, 4), bool)])
    groups = (structure.block_signs[:, None] >> np.arange(8) & 1).astype(bool).reshape(-1, 2, 2, 2)
    signs = groups.repeat(2, 1).repeat(2, 2).repeat(2, 3)
    inside = np.zeros((len(at), 5, 5, 5), bool)
    numbers, node = np.full((len(at) + 1, 4, 4, 4), -1), np.full((len(at), 5, 5, 5), -1)
    numbers[nodes] = np.arange(nodes.sum())
    for which, n in enumerate(CORNERS):
        to = (slice(None), *(slice(4 * e, 4 + e) for e in n))
        of = (slice(None), *(slice(0, 1 if e else 4) for e in n))
        there = beside[:, which]
        node[to] = numbers[there][of]
        known = np.where(there[:, None, None, None] >= 0, signs[there], empty[tuple((at + n).T)][:, None, None, None])
        inside[to] = known[of]
    stored = node >= 0
    crossed, within = np.ones((len(at), 4, 4, 4), bool), np.zeros((len(at), 4, 4, 4), bool)
    for a, b, c in CORNERS:
        corner = (slice(None), slice(a, a + 4), slice(b, b + 4), slice(c, c + 4))
        crossed &= stored[corner]
        within |= ~stored[corner] & inside[corner]
    beside = np.where(beside < 0, np.arange(len(at))[:, None], beside)
    return crossed.reshape(-1, 64), within.reshape(-1, 64), beside, empty[:-1, :-1, :-1], node


def slabs_of(crossed, inside, node, nodes, frames) -> np.ndarray:
    """
    For each block, how far above its plane P (that of its frame) the solid begins and ends, words (B,) of twice 16
    bits: where P is less than the lower bound, a place in the block is inside, above the upper bound outside.

    In a crossed cell f − P, a polynomial of degree 2 along each axis, lies between its Bernstein coefficients; where f
    is 0, P lies between their negatives. The signs of all other cells are respected.
    """
    normals, distances, _ = frames_numpy(frames)
    lower, upper = np.full((2, len(frames)), np.inf)
    upper *= -1
    block, bit = np.nonzero(crossed)
    cell, corners, part = _places(bit), np.array(CORNERS), 2**17
    for first in range(0, len(block), part):
        b, at = block[first : first + part], cell[first : first + part, None] + corners
        told = nodes[node[b[:, None], at[..., 0], at[..., 1], at[..., 2]]].astype(np.float64)
        told[..., 0] -= distances[b, None] + np.einsum("mki,mi->mk", at - MIDDLE, normals[b])
        told[..., 1:] -= normals[b, None]
        coefficients = bernstein(told)
        np.minimum.at(lower, b, -coefficients.max(axis=1))
        np.maximum.at(upper, b, -coefficients.min(axis=1))
    block, bit = np.nonzero(~crossed)
    within = inside[block, bit]
    planes = distances[block] + np.einsum("mi,mi->m", _places(bit) - MIDDLE + 0.5, normals[block])
    half = np.abs(normals[block]).sum(axis=1) / 2
    np.maximum.at(upper, block[within], (planes + half)[within])
    np.minimum.at(lower, block[~within], (planes - half)[~within])
    scale = STEPS / (2 * SLAB)
    lower = np.floor((np.clip(lower - MARGIN, -SLAB, SLAB) + SLAB) * scale).astype(np.uint32)
    upper = np.ceil((np.clip(upper + MARGIN, -SLAB, SLAB) + SLAB) * scale).astype(np.uint32)
    return lower | upper << np.uint32(16)


def words_of(structure, crossed, inside, empty) -> tuple[np.ndarray, np.ndarray]:
    """
    For each region the number of its blocks' words, or what is said of empty ones (:data:`EMPTY`), uint32; for each
    block of those that are not empty, ``(R, 64)``, its number, or the same.
    """
    number, full = np.zeros(empty.shape, np.uint32), np.zeros(empty.shape, bool)
    at = tuple((structure.block_positions() // BLOCK).T)
    full[at] = crossed.any(axis=1)
    number[at] = np.arange(len(crossed))
    sign = empty.copy()
    sign[at] = inside[:, 0]  # where no cell is crossed, all have the same
    shape = structure.regions.shape

    def parts(v):
        return v.reshape(np.stack([shape, (4, 4, 4)], 1).ravel()).transpose(0, 2, 4, 1, 3, 5).reshape(-1, 64)

    blocks = parts(np.where(full, number, _free(full, sign)).astype(np.uint32))
    some = parts(full).any(axis=1)
    regions = _free(some.reshape(shape), parts(sign)[:, 0].reshape(shape)).ravel()
    regions[some] = np.arange(some.sum())
    return regions.astype(np.uint32), blocks[some]


def _free(full: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """What is said of empty parts of a grid, of which ``full`` ones are not."""
    far = distance_transform_cdt(~full, "chessboard") if full.any() else np.full(full.shape, max(full.shape))
    return np.int64(EMPTY) | np.where(sign, INSIDE, 0) | far
