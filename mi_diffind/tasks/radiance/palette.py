"""The colours of a palette: clusters of those that the nodes of a grid have, by how much they show."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter
from scipy.spatial import cKDTree

#: How much a number of a direction counts, against one of the mean: x, y and z of directions are smaller than 1.
DIRECTION = 0.5

#: Nodes that clusters are found from, for each of them, and how often they are moved.
SAMPLES, ROUNDS = 60, 10


def importance(largest: np.ndarray, stored: np.ndarray, colour: np.ndarray) -> np.ndarray:
    """
    How much each stored node shows ``(n,)``: the ``largest`` weight in a ray of the cells around it (as
    :func:`.target.weights` has it), times how bright it is on a screen.
    """
    around = np.zeros(stored.shape, np.float32)
    around[:-1, :-1, :-1] = largest
    around = maximum_filter(around, size=2, origin=0)
    bright = np.exp(np.clip(colour[:, ::4].mean(axis=1), -6, 2) / 2.4)
    return np.maximum(around[stored], 1e-3) * bright


def clusters(colour: np.ndarray, weights: np.ndarray, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """
    ``count`` colours ``(count, 12)`` and, for each of ``colour`` ``(n, 12)``, which of them is nearest: Lloyd's
    algorithm, in which ``weights`` ``(n,)`` say how much a squared difference counts.
    """
    rng = np.random.default_rng(seed)
    metric = np.tile([1.0, DIRECTION, DIRECTION, DIRECTION], 3)
    points = colour * metric
    count = min(count, len(points))
    share = weights / weights.sum()
    chosen = rng.choice(len(points), count, replace=False, p=share)
    entries = points[chosen]
    drawn = rng.choice(len(points), min(len(points), SAMPLES * count), replace=False, p=share)
    for _ in range(ROUNDS):
        nearest = cKDTree(entries).query(points[drawn])[1]
        used = np.bincount(nearest, minlength=count)
        sums = np.stack([np.bincount(nearest, points[drawn, c], count) for c in range(12)], axis=1)
        # One that nobody is near to begins anew somewhere
        spare = points[rng.choice(drawn, count)]
        entries = np.where(used[:, None] > 0, sums / np.maximum(used, 1)[:, None], spare)
    return entries / metric, cKDTree(entries).query(points)[1].astype(np.uint32)
