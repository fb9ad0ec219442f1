"""Packing numbers of a few bits, and flags, into bytes and 32-bit words: the first one in the lowest bits."""

from __future__ import annotations

import numpy as np


def pack_bits(numbers: np.ndarray, bits: int) -> np.ndarray:
    """Pack the lowest ``bits`` bits of each unsigned number, in the order of the flat array: flat ``uint8``."""
    numbers = np.ascontiguousarray(numbers).reshape(-1, 1)
    if numbers.dtype != np.uint8:
        numbers = numbers.astype("<u4").view(np.uint8)
    return np.packbits(np.unpackbits(numbers, axis=1, bitorder="little")[:, :bits], bitorder="little")


def unpack_bits(packed: np.ndarray, count: int, bits: int) -> np.ndarray:
    """Return the first ``count`` numbers of up to 8 bits that :func:`pack_bits` packed: flat ``uint8``."""
    flags = np.unpackbits(packed, count=count * bits, bitorder="little").reshape(count, bits)
    return np.packbits(np.pad(flags, ((0, 0), (0, 8 - bits))), axis=1, bitorder="little").reshape(count)


def as_words(packed: np.ndarray, spare: int = 0) -> np.ndarray:
    """Return bytes as 32-bit words, filled up with zeros, and ``spare`` words of zeros after them."""
    return np.pad(packed, (0, -len(packed) % 4 + 4 * spare)).view("<u4")


def mask_words(flags: np.ndarray) -> np.ndarray:
    """Return each row of ``flags``, shape ``(…, 32 k)``, as ``k`` words: ``uint32`` of shape ``(…, k)``."""
    return np.packbits(flags, axis=-1, bitorder="little").view("<u4")


def mask_flags(masks: np.ndarray) -> np.ndarray:
    """Return the flags of rows of words, the inverse of :func:`mask_words`: ``bool`` of shape ``(…, 32 k)``."""
    return np.unpackbits(np.ascontiguousarray(masks, "<u4").view(np.uint8), axis=-1, bitorder="little").astype(bool)
