"""Borders, smaller versions and principal components of images, which initial arrays are made of."""

from __future__ import annotations

import math

import numpy as np

#: Largest difference across a border that repeats, as a multiple of the differences between neighbours inside.
TILEABLE = 1.5


def borders(values: np.ndarray) -> tuple[str, str]:
    """Return the borders along v and u of an image of shape ``(height, width, channels)``.

    ``"repeat"`` where the first row (or column) continues the last one (:data:`TILEABLE`), else ``"clamp"``.
    """
    along = []
    if not values.size:
        return ("repeat", "repeat")
    for axis in (0, 1):
        inside = np.abs(np.diff(values, axis=axis)).mean() if values.shape[axis] > 1 else 0.0
        first, last = np.take(values, 0, axis), np.take(values, -1, axis)
        across = np.abs(first - last).mean()
        along.append("repeat" if across <= TILEABLE * inside + 1e-6 else "clamp")
    return tuple(along)


def downscale(values: np.ndarray, rows: int, columns: int, border: tuple[str, str]) -> np.ndarray:
    """Return ``values``, ``(height, width, k)``, filtered at the entries of a ``rows`` × ``columns`` array, float32.

    The filter is a tent as wide as the distance of two entries, or of two texels if that is more.
    """
    height, width, k = values.shape
    down, across = _tent(rows, height, border[0]), _tent(columns, width, border[1])
    filtered = (down @ values.reshape(height, width * k)).reshape(rows, width, k)
    return np.einsum("cw,rwk->rck", across, filtered, optimize=True)


def _tent(entries: int, texels: int, border: str) -> np.ndarray:
    """Return the weights of a tent filter, ``(entries, texels)``; rows sum to 1."""
    step = 1 / max(1, entries if border == "repeat" else entries - 1)
    centres, positions = (np.arange(texels) + 0.5) / texels, np.arange(entries) * step
    distance = np.abs(positions[:, None] - centres[None])
    if border == "repeat":
        distance = np.minimum(distance, 1 - distance)
    weights = np.maximum(1 - distance / max(step, 1 / texels), 0)
    empty = weights.sum(axis=1) == 0  # a clamped end, outside of the outermost texel centres
    weights[empty, np.argmin(distance[empty], axis=1)] = 1
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def smoothness(values: np.ndarray) -> float:
    """Return the smoothness of an image, ``(height, width, k)`` in [0, 1], in dB.

    It is the PSNR of the image in which each texel is the mean of its four neighbours. Noise has 20, a photograph 40.
    """
    if min(values.shape[:2]) < 3:
        return 120.0
    inner = values[1:-1, 1:-1]
    mean = values[:-2, 1:-1] + values[2:, 1:-1] + values[1:-1, :-2] + values[1:-1, 2:]
    return -10 * math.log10(max(float(np.mean((inner - mean / 4) ** 2, dtype=np.float64)), 1e-12))


def covariance(values: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the covariance, ``(k, k)``, of ``values``, ``(height, width, k)``, with the given ``mean``."""
    flat = values.reshape(-1, values.shape[-1]).astype(np.float64)
    return flat.T @ flat / len(flat) - np.outer(mean, mean)


def differences(values: np.ndarray) -> np.ndarray:
    """Return the covariance, ``(k, k)``, of the differences of neighbours in ``values``, ``(height, width, k)``."""
    k = values.shape[-1]
    flat = [np.diff(values, axis=axis).reshape(-1, k).astype(np.float64) for axis in (0, 1)]
    return sum(f.T @ f / max(len(f), 1) for f in flat)


def strongest(covariance: np.ndarray, count: int) -> np.ndarray:
    """Return the eigenvectors of the largest eigenvalues, ``(count, k)``; the largest component of each is positive."""
    _, directions = np.linalg.eigh(covariance)
    directions = directions.T[::-1][:count]
    largest = np.argmax(np.abs(directions), axis=1)
    return directions * np.sign(directions[np.arange(count), largest])[:, None]
