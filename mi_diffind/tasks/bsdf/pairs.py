"""Pairs of measured rows that a symmetry maps to each other, and the error that no model with the symmetry avoids."""

from __future__ import annotations

import copy
from types import SimpleNamespace

import numpy as np

#: Distance of two rows below which they have the same directions.
EXACT = 1e-4

#: Smallest number of rows with pairs from which a share is known.
LEAST_ROWS = 200


def along_x(truth) -> np.ndarray:
    """Return ``wo`` of rows after a rotation about the normal that brings ``wi`` to the azimuth 0."""
    x, y = truth.wi[:, 0], truth.wi[:, 1]
    r = np.hypot(x, y)
    cos, sin, wo = np.where(r > 1e-9, x / np.maximum(r, 1e-9), 1), y / np.maximum(r, 1e-9), truth.wo
    return np.stack([cos * wo[:, 0] + sin * wo[:, 1], cos * wo[:, 1] - sin * wo[:, 0], wo[:, 2]], axis=1)


def places(truth, isotropic: bool) -> np.ndarray:
    """Return points whose distances are those of rows, ``(n, 4)`` of isotropic and ``(n, 6)`` of other materials."""
    if not isotropic:
        return np.concatenate([truth.wi, truth.wo], axis=1)
    return np.concatenate([np.arccos(np.clip(truth.wi[:, 2:], -1, 1)), along_x(truth)], axis=1)


def exchange(truth):
    """Return the rows with their directions exchanged."""
    exchanged = copy.copy(truth)
    exchanged.wi, exchanged.wo = truth.wo, truth.wi
    return exchanged


class Orbits:
    """Rows in groups, to whose rows a model with the symmetries gives one value.

    The symmetries are the exchange of directions, with ``isotropic`` rotation about the normal, and with both that and
    ``mirror`` reflection at the plane of incidence. ``rows`` are those with another row in their group, and those that
    are their own images (mirror directions); ``group`` is the number of their group, ``image`` the row with exchanged
    directions, and ``share`` a factor by which rows that are their own images count as they do among all rows.
    ``paired`` counts rows with another row in their group, and ``exchanged`` those with a row of exchanged directions.
    """

    def __init__(self, truth, isotropic: bool, mirror: bool):
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components
        from scipy.spatial import cKDTree

        points, images = places(truth, isotropic), places(exchange(truth), isotropic)
        if isotropic and mirror:
            points[:, 2], images[:, 2] = np.abs(points[:, 2]), np.abs(images[:, 2])
        symmetric = np.linalg.norm(points - images, axis=1) < EXACT
        image = cKDTree(points).query(images, distance_upper_bound=EXACT)[1]
        image[symmetric] = np.flatnonzero(symmetric)
        with_image, count = np.flatnonzero(image < len(points)), len(points)
        # Rows with the same directions: each is linked to the first of them
        _, first, same = np.unique(np.round(points / EXACT), axis=0, return_index=True, return_inverse=True)
        links = np.concatenate([with_image, np.arange(count)]), np.concatenate([image[with_image], first[same.ravel()]])
        group = connected_components(coo_array((np.ones(len(links[0])), links), (count, count)))[1]
        has_pair = (np.bincount(group)[group] > 1) & ~symmetric
        self.rows = np.flatnonzero(has_pair | symmetric)
        self.group, self.image = group[self.rows], np.where(image < count, image, np.arange(count))[self.rows]
        self.paired, self.exchanged = int(has_pair.sum()), int((~symmetric)[with_image].sum())
        self.share = np.where(symmetric[self.rows], self.paired / max((~symmetric).sum(), 1), 1.0)

    def least_error(self, f: np.ndarray, weight: np.ndarray, least: float = -np.inf) -> float:
        """Return the smallest sum of ``weight · |f̂ − f|`` over :attr:`rows`, f̂ ≥ ``least`` one value in each group.

        ``f`` is ``(rows, channels)``. The smallest sum has f̂ at the weighted median of each group and channel.
        """
        total = 0.0
        for channel in f.T:
            order = np.lexsort((channel, self.group))
            value, w = channel[order], weight[order]
            starts = np.flatnonzero(np.diff(self.group[order], prepend=-1))
            counts, sums = np.diff(np.append(starts, len(value))), np.cumsum(w)
            half = sums[starts] - w[starts] + np.add.reduceat(w, starts) / 2
            reached = np.where(sums >= np.repeat(half, counts), np.arange(len(value)), len(value) - 1)
            median = np.maximum(value[np.minimum.reduceat(reached, starts)], least)
            total += float((w * np.abs(value - np.repeat(median, counts))).sum())
        return total


def irreciprocal_share(truth, isotropic: bool, mirror: bool) -> float | None:
    """Return the share of the light that no reciprocal model can reproduce; ``None`` if too few rows have images.

    It is the smallest sum of ``|f̂ − f|`` over the sum of ``|f|``, weighted by both solid angles and cosines, of all
    rows whose directions exchanged are those of another row. With ``mirror``, images at the plane of incidence count.
    """
    orbits = Orbits(truth, isotropic, mirror)
    if orbits.exchanged < LEAST_ROWS:
        return None
    rows, image = orbits.rows, orbits.image
    wi, wo = truth.wi[rows], truth.wo[rows]
    if truth.solid_angle is None:
        weight = cells(np.arccos(np.stack([wi[:, 2], wo[:, 2]], axis=1)))
        weight *= np.prod(np.hypot(*np.stack([wi, wo])[:, :, :2].T), axis=1)
        azimuths = [np.arctan2(w[:, 1], w[:, 0]) for w in ([along_x(truth)[rows]] if isotropic else [wi, wo])]
        weight *= cells(np.abs(np.stack(azimuths, axis=1)))
    else:
        weight = truth.solid_angle[rows] * truth.solid_angle[image]
    weight *= orbits.share * (truth.weight[rows] + truth.weight[image]) * wi[:, 2] * wo[:, 2]
    f = truth.f[rows]
    return orbits.least_error(f, weight) / max(float((weight[:, None] * np.abs(f)).sum()), 1e-20)


def error_floor(samples: list, isotropic: bool, mirror: bool) -> float | None:
    """Return the smallest ``relative_error`` (:func:`.evaluation.measure_samples`) of a model with the symmetries.

    All rows of ``samples`` (:class:`.directions.Samples`) count, in their weights. Nothing is subtracted for noise, by
    which rows with the same directions, or with images of them, differ, too. ``None``: too few rows have others.
    """
    columns = [np.stack([c.numpy() for c in (*s.wi, *s.wo, s.weight, *s.value)], axis=1) for s in samples]
    table = np.concatenate(columns, dtype=np.float64)
    table = table[table[:, 6] > 0]
    rows = SimpleNamespace(wi=table[:, :3], wo=table[:, 3:6])
    orbits = Orbits(rows, isotropic, mirror)
    if orbits.paired < LEAST_ROWS:
        return None
    wo_z, weight, value = table[orbits.rows, 5], table[orbits.rows, 6] * orbits.share, table[orbits.rows, 7:]
    total = max(float((weight[:, None] * value).sum()), 1e-20)
    return orbits.least_error(value / wo_z[:, None], weight * wo_z, least=0.0) / total


def cells(angles: np.ndarray) -> np.ndarray:
    """Return products of the widths for which angles ``(n, k)`` stand on the axis that their ``k`` columns share."""
    values, index = np.unique(np.round(angles, 5), return_inverse=True)
    widths = np.gradient(values) if len(values) > 1 else np.ones(1)
    return widths[index.reshape(angles.shape)].prod(axis=1)
