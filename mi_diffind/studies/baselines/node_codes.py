"""
What the numbers of a sparse grid become in a file: whole numbers of up to 8 bits, predicted from their neighbours, then
zlib.

Of each channel, the prediction that leaves the least is taken: none, the neighbour before along z, or the mean of those
before along x, y and z, as far as they are stored. Masks of nodes are bits after zlib.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

#: What zlib is told to look for: repetitions and frequencies, mostly frequencies, or frequencies alone.
STRATEGIES = (zlib.Z_DEFAULT_STRATEGY, zlib.Z_FILTERED, zlib.Z_HUFFMAN_ONLY)

#: How a channel is predicted.
PREDICTIONS = ("none", "before", "mean")


@dataclass(frozen=True, eq=False)
class Steps:
    """
    Equal steps for the channels of an array ``(n, C)``: number = ``low`` + ``step`` · code, code from 0 to ``levels`` −
    1; float32 ``(C,)``, and at most 256 levels.
    """

    low: np.ndarray
    step: np.ndarray
    levels: np.ndarray

    @staticmethod
    def over(values: np.ndarray, levels: int = 256, weights: np.ndarray | None = None, tail: float = 0.0) -> Steps:
        """
        As many ``levels`` as asked for, over the range of ``values`` (n, C) without the share ``tail`` of the
        ``weights`` (n,) at either end.
        """
        values = np.asarray(values, np.float64)
        weights = np.ones(len(values)) if weights is None else np.asarray(weights, np.float64)
        low, high = np.empty((2, values.shape[1]))
        for c, v in enumerate(values.T):
            order = np.argsort(v)
            share = np.cumsum(weights[order]) / weights.sum()
            ends = np.searchsorted(share, (tail, 1 - tail)).clip(0, len(v) - 1)
            low[c], high[c] = v[order[ends]]
        step = np.maximum(high - low, 1e-6) / (levels - 1)
        return Steps(low.astype(np.float32), step.astype(np.float32), np.full(len(low), levels))

    @staticmethod
    def of_width(values: np.ndarray, width: np.ndarray, most: int = 256) -> Steps:
        """Steps of a given ``width`` (C,), wider where the range of ``values`` would need more than ``most``."""
        low, high = (np.asarray(f(values, axis=0), np.float64) for f in (np.min, np.max))
        step = np.maximum(width, np.maximum(high - low, 1e-6) / (most - 1))
        levels = np.ceil((high - low) / step).astype(int) + 1
        return Steps(low.astype(np.float32), step.astype(np.float32), np.minimum(levels, most))

    def codes(self, values: np.ndarray) -> np.ndarray:
        """uint8 ``(n, C)``."""
        found = np.rint((np.asarray(values, np.float64) - self.low) / self.step.astype(np.float64))
        return np.clip(found, 0, self.levels - 1).astype(np.uint8)

    def values(self, codes: np.ndarray) -> np.ndarray:
        """float32 ``(n, C)``."""
        return (self.low + self.step * codes.astype(np.float32)).astype(np.float32)

    def rounded(self, types, tensor):
        """A tensor ``(n, C)`` as it is stored, with the gradients of what it is made of (straight through)."""
        import drjit as dr

        own = [types.TensorXf(np.asarray(v, np.float32)[None]) for v in (self.low, 1 / self.step, self.step)]
        exact = dr.detach(tensor)
        code = dr.round((exact - own[0]) * own[1])
        most = types.TensorXf(np.asarray(self.levels - 1, np.float32)[None])
        return tensor + (dr.minimum(dr.maximum(code, 0), most) * own[2] + own[0] - exact)


def deflated(data: bytes) -> bytes:
    """``data`` after zlib, at its best."""
    found = []
    for strategy in STRATEGIES:
        packer = zlib.compressobj(9, zlib.DEFLATED, 15, 9, strategy)
        found.append(packer.compress(data) + packer.flush())
    return min(found, key=len)


def mask_bytes(stored: np.ndarray) -> bytes:
    """Which nodes are stored, bool ``(X, Y, Z)``."""
    return deflated(np.packbits(stored).tobytes())


class Neighbours:
    """For each stored node, in lexicographic order, the numbers of those before it along x, y and z; −1: not stored."""

    def __init__(self, stored: np.ndarray):
        number = np.full(tuple(n + 1 for n in stored.shape), -1)
        number[1:, 1:, 1:][stored] = np.arange(np.count_nonzero(stored))
        place = np.argwhere(stored)
        self.before = np.stack([number[tuple((place + 1 - np.eye(3, dtype=int)[axis]).T)] for axis in range(3)])
        # Whatever is before a node has a lower sum of places
        total = place.sum(axis=1)
        order = np.argsort(total, kind="stable")
        self.waves = np.split(order, np.flatnonzero(np.diff(total[order])) + 1)

    def _predicted(self, codes: np.ndarray, kind: str, nodes) -> np.ndarray:
        if kind == "none":
            return np.zeros(len(nodes), np.int64)
        before = self.before[2:, nodes] if kind == "before" else self.before[:, nodes]
        known = before >= 0
        count = known.sum(axis=0)
        total = np.where(known, codes[before], 0).sum(axis=0)
        return np.where(count > 0, total // np.maximum(count, 1), 0)

    def packed(self, codes: np.ndarray) -> tuple[bytes, str]:
        """The codes of one channel ``(n,)`` as bytes, and how they were predicted."""
        codes, found = codes.astype(np.int64), []
        everything = np.arange(len(codes))
        for kind in PREDICTIONS:
            rest = (codes - self._predicted(codes, kind, everything)).astype(np.uint8).tobytes()
            found.append((len(zlib.compress(rest, 6)), kind, rest))
        _, kind, rest = min(found)
        return deflated(rest), kind

    def unpacked(self, data: bytes, kind: str) -> np.ndarray:
        """The reverse: uint8 ``(n,)``."""
        rest = np.frombuffer(zlib.decompress(data), np.uint8).astype(np.int64)
        codes = np.zeros_like(rest)
        for wave in self.waves:
            codes[wave] = (rest[wave] + self._predicted(codes, kind, wave)) & 255
        return codes.astype(np.uint8)


def coded_bytes(stored: np.ndarray, channels: np.ndarray, predict: bool = True) -> int:
    """
    Bytes after zlib of a mask ``(X, Y, Z)`` and of the ``channels`` (n, C), uint8, of its nodes, channel by channel;
    without ``predict``, of the codes as they are.
    """
    if not predict:
        return len(mask_bytes(stored)) + sum(len(deflated(np.ascontiguousarray(c).tobytes())) for c in channels.T)
    neighbours = Neighbours(stored)
    return len(mask_bytes(stored)) + sum(len(neighbours.packed(c)[0]) + 1 for c in channels.T)
