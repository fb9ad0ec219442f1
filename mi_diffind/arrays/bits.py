"""Packing numbers of a few bits, and flags, into bytes and 32-bit words: the first one in the lowest bits."""

from __future__ import annotations

import numpy as np

#: Numbers that are packed or unpacked at a time, a multiple of 8.
PART = 2**16


def pack_bits(numbers: np.ndarray, bits: int) -> np.ndarray:
    """Pack the lowest ``bits`` bits of each unsigned number, in the order of the flat array: flat ``uint8``."""
    numbers = np.ascontiguousarray(numbers).reshape(-1, 1)
    packed = np.empty(-(-len(numbers) * bits // 8), np.uint8)
    for first in range(0, len(numbers), PART):  # flags take 8 or 32 bytes a number
        part = numbers[first : first + PART]
        if part.dtype != np.uint8:
            part = part.astype("<u4").view(np.uint8)
        flags = np.packbits(np.unpackbits(part, axis=1, bitorder="little")[:, :bits], bitorder="little")
        packed[first * bits // 8 : first * bits // 8 + len(flags)] = flags
    return packed


def unpack_bits(packed: np.ndarray, count: int, bits: int) -> np.ndarray:
    """Return the first ``count`` numbers of up to 8 bits that :func:`pack_bits` packed: flat ``uint8``."""
    numbers = np.empty(count, np.uint8)
    for first in range(0, count, PART):  # flags take 8 bytes a number
        part = numbers[first : first + PART]
        begin = first * bits // 8
        flags = np.unpackbits(packed[begin : begin + PART * bits // 8], count=len(part) * bits, bitorder="little")
        flags = np.pad(flags.reshape(-1, bits), ((0, 0), (0, 8 - bits)))
        part[:] = np.packbits(flags, axis=1, bitorder="little").reshape(-1)
    return numbers


def as_words(packed: np.ndarray, spare: int = 0) -> np.ndarray:
    """Return bytes as 32-bit words, filled up with zeros, and ``spare`` words of zeros after them."""
    return np.pad(packed, (0, -len(packed) % 4 + 4 * spare)).view("<u4")


def mask_words(flags: np.ndarray) -> np.ndarray:
    """Return each row of ``flags``, shape ``(…, 32 k)``, as ``k`` words: ``uint32`` of shape ``(…, k)``."""
    return np.packbits(flags, axis=-1, bitorder="little").view("<u4")


def mask_flags(masks: np.ndarray) -> np.ndarray:
    """Return the flags of rows of words, the inverse of :func:`mask_words`: ``bool`` of shape ``(…, 32 k)``."""
    return np.unpackbits(np.ascontiguousarray(masks, "<u4").view(np.uint8), axis=-1, bitorder="little").astype(bool)
