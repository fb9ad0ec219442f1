"""Compression of sparse grids in files: numbers of up to 8 bits, predicted from neighbours, then zlib.

Each channel has the prediction that leaves the fewest bytes: none, the previous neighbour along z, or the mean of the
previous neighbours along x, y and z that are stored. Masks of nodes are bits after zlib.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np

#: Strategies of zlib that are tried: repetitions and frequencies, mostly frequencies, or frequencies alone.
STRATEGIES = (zlib.Z_DEFAULT_STRATEGY, zlib.Z_FILTERED, zlib.Z_HUFFMAN_ONLY)

#: Predictions of a channel.
PREDICTIONS = ("none", "before", "mean")


@dataclass(frozen=True, eq=False)
class QuantisationSteps:
    """Uniform quantisation of the channels of an array ``(n, C)``.

    Value = ``low`` + ``step`` · code, with codes from 0 to ``levels`` − 1; ``low`` and ``step`` are float32 ``(C,)``,
    ``levels`` are at most 256.
    """

    low: np.ndarray
    step: np.ndarray
    levels: np.ndarray

    @staticmethod
    def over(
        values: np.ndarray, levels: int = 256, weights: np.ndarray | None = None, tail: float = 0.0
    ) -> QuantisationSteps:
        """Return ``levels`` steps over the range of ``values`` (n, C).

        The range is without the share ``tail`` of the ``weights`` (n,) at either end.
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
        return QuantisationSteps(low.astype(np.float32), step.astype(np.float32), np.full(len(low), levels))

    @staticmethod
    def between(low: float, high: float) -> QuantisationSteps:
        """Return 256 steps of one channel, the same for all values, from ``low`` to ``high``."""
        return QuantisationSteps(np.float32([low]), np.float32([(high - low) / 255]), np.array([256]))

    @staticmethod
    def of_width(values: np.ndarray, width: np.ndarray, most: int = 256) -> QuantisationSteps:
        """Return steps of a given ``width`` (C,), wider where ``values`` would need more than ``most`` steps."""
        low, high = (np.asarray(f(values, axis=0), np.float64) for f in (np.min, np.max))
        step = np.maximum(width, np.maximum(high - low, 1e-6) / (most - 1))
        levels = np.ceil((high - low) / step).astype(int) + 1
        return QuantisationSteps(low.astype(np.float32), step.astype(np.float32), np.minimum(levels, most))

    def codes(self, values: np.ndarray) -> np.ndarray:
        """Return the codes of ``values``, uint8 ``(n, C)``."""
        nearest = np.rint((np.asarray(values, np.float64) - self.low) / self.step.astype(np.float64))
        return np.clip(nearest, 0, self.levels - 1).astype(np.uint8)

    def values(self, codes: np.ndarray) -> np.ndarray:
        """Return the values of ``codes``, float32 ``(n, C)``."""
        return (self.low + self.step * codes.astype(np.float32)).astype(np.float32)

    def rounded(self, types, tensor):
        """Return a tensor ``(n, C)`` rounded to its steps, with the gradients of the tensor (straight through)."""
        import drjit as dr

        low, inverse, step = [
            types.TensorXf(np.asarray(v, np.float32)[None]) for v in (self.low, 1 / self.step, self.step)
        ]
        exact = dr.detach(tensor)
        code = dr.round((exact - low) * inverse)
        most = types.TensorXf(np.asarray(self.levels - 1, np.float32)[None])
        return tensor + (dr.minimum(dr.maximum(code, 0), most) * step + low - exact)


def deflated(data: bytes) -> bytes:
    """Return ``data`` after zlib with the best of :data:`STRATEGIES`."""
    packed = []
    for strategy in STRATEGIES:
        packer = zlib.compressobj(9, zlib.DEFLATED, 15, 9, strategy)
        packed.append(packer.compress(data) + packer.flush())
    return min(packed, key=len)


def mask_bytes(stored: np.ndarray) -> bytes:
    """Return the mask of stored nodes, bool ``(X, Y, Z)``, as bits after zlib."""
    return deflated(np.packbits(stored).tobytes())


class Neighbours:
    """Numbers of the previous nodes along x, y and z of each stored node, in lexicographic order; −1: not stored."""

    def __init__(self, stored: np.ndarray):
        number = np.full(tuple(n + 1 for n in stored.shape), -1)
        number[1:, 1:, 1:][stored] = np.arange(np.count_nonzero(stored))
        place = np.argwhere(stored)
        self.before = np.stack([number[tuple((place + 1 - np.eye(3, dtype=int)[axis]).T)] for axis in range(3)])

    def predicted(self, codes: np.ndarray, prediction: str, nodes) -> np.ndarray:
        """Return the predicted codes of the ``nodes`` (numbers) from the codes of all nodes."""
        if prediction == "none":
            return np.zeros(len(nodes), np.int64)
        before = self.before[2:, nodes] if prediction == "before" else self.before[:, nodes]
        stored = before >= 0
        count = stored.sum(axis=0)
        total = np.where(stored, codes[before], 0).sum(axis=0)
        return np.where(count > 0, total // np.maximum(count, 1), 0)

    def packed(self, codes: np.ndarray) -> tuple[bytes, str]:
        """Return the codes of one channel ``(n,)`` as bytes, and the prediction."""
        codes, attempts = codes.astype(np.int64), []
        everything = np.arange(len(codes))
        for prediction in PREDICTIONS:
            rest = (codes - self.predicted(codes, prediction, everything)).astype(np.uint8).tobytes()
            attempts.append((len(zlib.compress(rest, 6)), prediction, rest))
        _, prediction, rest = min(attempts)
        return deflated(rest), prediction


def coded_bytes(stored: np.ndarray, channels: np.ndarray, predict: bool = True) -> int:
    """Return the bytes after zlib of a mask ``(X, Y, Z)`` and of the ``channels`` (n, C), uint8, of its nodes.

    Channels are compressed one by one; without ``predict``, the codes are not predicted.
    """
    if not predict:
        return len(mask_bytes(stored)) + sum(len(deflated(np.ascontiguousarray(c).tobytes())) for c in channels.T)
    neighbours = Neighbours(stored)
    return len(mask_bytes(stored)) + sum(len(neighbours.packed(c)[0]) + 1 for c in channels.T)
