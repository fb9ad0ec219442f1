"""
Competitors of compressed radiance fields as they are made: from the grid that all are made of, to parameters that are
trained through images, to bytes.

A :class:`Fit` has a ``net``, tensors by name that an optimiser trains at one rate, and makes fields of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from scipy.ndimage import map_coordinates

from ...tasks.field.field import GridField
from ...tasks.field.march import march, replay
from ...tasks.field.nodes import Nodes, cells_of, corners_of
from .node_codes import Steps, coded_bytes
from .radiance import EMPTY, RAW, ByteField, CoefficientField

#: Colours of nodes that nothing is seen of have this weight, so that they are known, too.
LEAST = 1e-6


@dataclass(frozen=True, eq=False)
class Grid:
    """
    Numbers on the nodes of a sparse or dense grid: ``density`` (n,) raw, ``colour`` (n, 12) and ``seen`` (n,), how much
    of all rays of the training views ends at each, in lexicographic order of the ``nodes``.
    """

    nodes: Nodes
    density: np.ndarray
    colour: np.ndarray
    seen: np.ndarray

    @staticmethod
    def of(field: GridField, seen: np.ndarray) -> Grid:
        """The numbers of a trained grid, and what :func:`visibility` found."""
        first = int(field.nodes.stored is not None)
        density, colour = (field.arrays[name].numpy() for name in ("density", "colour"))
        return Grid(field.nodes, density.reshape(-1)[first:], colour[first:], np.asarray(seen)[first:])

    def dense(self, values: np.ndarray, outside: float = 0.0) -> np.ndarray:
        """``values`` (n, …) in a box ``(X, Y, Z, …)``."""
        found = np.full((*self.nodes.shape, *values.shape[1:]), outside, np.float32)
        stored = self.nodes.stored if self.nodes.stored is not None else np.ones(self.nodes.shape, bool)
        found[stored] = values
        return found

    def kept(self, cells: np.ndarray) -> Grid:
        """What is left on the corners of ``cells`` (bool), those of this grid among them."""
        stored = corners_of(cells & self.cells())
        nodes = Nodes(self.nodes.types, self.nodes.lower, self.nodes.spacing, self.nodes.shape, stored)
        own = self.nodes.stored if self.nodes.stored is not None else np.ones(self.nodes.shape, bool)
        inside = stored[own]
        return Grid(nodes, self.density[inside], self.colour[inside], self.seen[inside])

    def cells(self) -> np.ndarray:
        stored = self.nodes.stored
        return cells_of(stored) if stored is not None else np.ones([n - 1 for n in self.nodes.shape], bool)

    def pruned(self, least: float) -> Grid:
        """Without the cells of which no corner is :attr:`seen` as much as ``least`` rays."""
        seen = self.dense(self.seen) > least
        cells = np.zeros([n - 1 for n in self.nodes.shape], bool)
        for corner in np.ndindex(2, 2, 2):
            cells |= seen[tuple(slice(c, n - 1 + c) for c, n in zip(corner, seen.shape, strict=True))]
        return self.kept(cells)

    def resampled(self, spacing: float, sparse: bool = True) -> Grid:
        """
        On nodes that are ``spacing`` apart: means of density and, weighted by what is seen, of colour; on all of them,
        or on the corners of the cells in which this grid has some.
        """
        nodes = self.nodes
        scale = spacing / nodes.spacing
        if sparse and abs(scale - 1) < 1e-6:
            return self
        shape = [int(np.ceil((n - 1) / scale - 1e-6)) + 1 for n in nodes.shape]
        density = np.logaddexp(0, self.dense(self.density, EMPTY)) / nodes.spacing
        seen = self.dense(self.seen) + LEAST * self.dense(np.ones(len(self.seen), np.float32))
        weighted = self.dense(self.colour) * seen[..., None]
        # Means over as many places of the new cell around a node as the old grid needs
        count = max(2, int(np.ceil(scale)) + 1)
        offsets = (np.arange(count) + 0.5) / count - 0.5
        totals = np.zeros((14, *shape))
        for offset in np.ndindex(count, count, count):
            axes = [(np.arange(n) + offsets[o]) * scale for n, o in zip(shape, offset, strict=True)]
            place = np.stack(np.meshgrid(*axes, indexing="ij"))
            for k, values in enumerate((density, seen, *np.moveaxis(weighted, -1, 0))):
                totals[k] += map_coordinates(values, place, order=1, mode="constant", cval=0.0, prefilter=False)
        totals /= count**3
        raw = totals[0] * spacing
        raw = np.where(raw > 1e-6, np.maximum(raw, 1e-6) + np.log(-np.expm1(-np.maximum(raw, 1e-6))), RAW[0])
        colour = np.moveaxis(totals[2:] / np.maximum(totals[1], 1e-12), 0, -1)
        types, stored = nodes.types, None
        if sparse:
            old = np.argwhere(self.cells())
            cells = np.zeros([n - 1 for n in shape], bool)
            for corner in np.ndindex(2, 2, 2):  # every new cell that an old one reaches into
                cells[
                    tuple(
                        np.minimum(((old + np.array(corner) * (1 - 1e-6)) / scale).astype(int), np.array(shape) - 2).T
                    )
                ] = True
            stored = corners_of(cells)
        found = Nodes(types, nodes.lower, spacing, shape, stored)
        chosen = stored if stored is not None else np.ones(shape, bool)
        colour = filled(colour, totals[1] > 1e-9)
        return Grid(found, raw[chosen].astype(np.float32), colour[chosen].astype(np.float32),
                    (totals[1] * scale**3)[chosen].astype(np.float32))  # fmt: skip


def filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """``values`` (X, Y, Z, C), of which those not ``known`` are replaced by the nearest that are."""
    from scipy.ndimage import distance_transform_edt

    if known.all() or not known.any():
        return values
    nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return values[tuple(nearest)]


def visibility(field: GridField, images, every: int = 2) -> np.ndarray:
    """
    How many rays of the views end at each node of ``field`` (n,), one ray for every so many pixels along x and y: by
    the derivative of what is seen with respect to colours that are all the same.
    """
    types, views = field.types, images.views
    arrays = {"density": types.TensorXf(dr.detach(field.arrays["density"]))}
    arrays["colour"] = dr.zeros(types.TensorXf, field.arrays["colour"].shape)
    dr.enable_grad(arrays)
    white = field.with_arrays(arrays)
    columns, rows = views.width // every, views.height // every
    lane = dr.arange(types.UInt32, columns * rows)
    for view in range(len(views)):
        o, d = images.rays(dr.opaque(types.UInt32, view), every * (lane % columns), every * (lane // columns))
        dr.eval(o, d)
        seen = march(white, o, d, 0, dr.inf)
        dr.eval(seen.colour, seen.transmittance, seen.depth)
        replay(white, o, d, 0, dr.inf, True, 0.5, seen, types.Array3f(1, 0, 0))
        dr.eval(dr.grad(arrays))
    return dr.grad(arrays["colour"]).numpy().reshape(-1, field.arrays["colour"].shape[-1])[:, 0] * every**2


# -- on nodes ---------------------------------------------------------------------------------------------------------


class NodesFit:
    """
    A grid of bytes: density and, of each node or of each of ``rows``, coefficients of colour, with :class:`.Steps` of
    their own; ``matrix`` makes twelve numbers of them, if there is one.
    """

    #: What a parameter is multiplied by: densities change faster than colours.
    DENSITY = 20.0

    def __init__(self, nodes: Nodes, density, colour, steps: tuple[Steps, Steps], matrix=None, rows=None, step=None):
        self.nodes, self.steps, self.rows, self.step = nodes, steps, rows, step
        types = self.types = nodes.types
        self.first = int(nodes.stored is not None)
        own = 0 if rows is not None else self.first
        colour = np.pad(colour, ((own, 0), (0, -colour.shape[1] % 4)))
        self.net = {
            "density": types.TensorXf(np.pad(density, (self.first, 0)).astype(np.float32)[:, None] / self.DENSITY),
            "colour": types.TensorXf(colour.astype(np.float32)),
        }
        self.channels = len(steps[1].low)
        if colour.shape[1] > self.channels:
            pad = (0, colour.shape[1] - self.channels)
            self.padded = Steps(np.pad(steps[1].low, pad), np.pad(steps[1].step, pad, constant_values=1),
                                np.pad(steps[1].levels, pad, constant_values=1))  # fmt: skip
        else:
            self.padded = steps[1]
        if matrix is not None:
            grown = np.concatenate([matrix[:-1], np.zeros((colour.shape[1] - self.channels, 12)), matrix[-1:]])
            self.net["matrix"] = types.TensorXf(grown.astype(np.float32))
        self.row_numbers = None
        if rows is not None:
            self.row_numbers = types.UInt32(np.pad(rows, (self.first, 0)).astype(np.uint32))

    def field_of(self, net) -> CoefficientField:
        types = self.types
        arrays = {"density": self.steps[0].rounded(types, net["density"] * self.DENSITY),
                  "colour": self.padded.rounded(types, net["colour"])}  # fmt: skip
        if "matrix" in self.net:
            arrays["matrix"] = net["matrix"]
        return CoefficientField(self.nodes, arrays, self.row_numbers, self.step)

    def codes(self) -> tuple[np.ndarray, np.ndarray]:
        density = self.steps[0].codes(self.net["density"].numpy() * self.DENSITY)[self.first :]
        colour = self.net["colour"].numpy()[0 if self.rows is not None else self.first :, : self.channels]
        return density, self.steps[1].codes(colour)

    def matrix(self) -> np.ndarray | None:
        if "matrix" not in self.net:
            return None
        found = self.net["matrix"].numpy()
        return np.concatenate([found[: self.channels], found[-1:]])

    def stored(self) -> ByteField:
        density, colour = self.codes()
        return ByteField(self.nodes, density[:, 0], colour, self.steps, self.matrix(), self.rows, self.step)

    def file_bytes(self, predict: bool = True) -> int:
        """Bytes on disk, after zlib."""
        density, colour = self.codes()
        stored = self.nodes.stored if self.nodes.stored is not None else np.ones(self.nodes.shape, bool)
        matrix = self.matrix()
        fixed = 64 + sum(s.nbytes for s in self.steps) + (0 if matrix is None else 4 * matrix.size)
        if self.rows is None:
            return fixed + coded_bytes(stored, np.concatenate([density, colour], axis=1), predict)
        from .node_codes import deflated

        packed = min(len(deflated(_bits(self.rows, len(colour)))), len(deflated(self.rows.astype("<u2").tobytes())))
        return fixed + coded_bytes(stored, density, predict) + packed + len(deflated(colour.tobytes()))


def _bits(numbers: np.ndarray, count: int) -> bytes:
    """Numbers below ``count`` in as many bits as they need."""
    width = max(1, int(count - 1).bit_length())
    return np.packbits((numbers[:, None] >> np.arange(width)) & 1, bitorder="little").tobytes()


def plain(grid: Grid, levels: int = 256, step: float | None = None) -> NodesFit:
    """Thirteen bytes a node."""
    steps = (Steps(np.float32([RAW[0]]), np.float32([(RAW[1] - RAW[0]) / 255]), np.array([256])),
             Steps.over(grid.colour, levels, grid.seen + LEAST, 1e-3))  # fmt: skip
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), grid.colour, steps, step=step)


def display(colour: np.ndarray) -> np.ndarray:
    """
    Twelve numbers of colour as what they change on a screen, to first order: each of the four of a channel times the
    slope of sRGB there, (n, 12).
    """
    radiance = np.exp(np.clip(colour[:, ::4], -12, 1.5))
    slope = np.where(radiance <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(radiance, 0.0031308) ** (1 / 2.4 - 1))
    return np.repeat(slope * radiance, 4, axis=1)


def components(
    grid: Grid, count: int, width: float, levels: int = 256, density_levels: int = 256, step=None
) -> NodesFit:
    """
    So many principal components of the colours, in equal steps of ``width``, of what they change on a screen; the
    spread of what is seen counts.
    """
    seen = grid.seen.astype(np.float64) + LEAST
    scale = np.sqrt(np.average(display(grid.colour) ** 2, axis=0, weights=seen))
    mean = np.average(grid.colour, axis=0, weights=seen)
    centred = (grid.colour - mean) * scale
    low, high = np.quantile(centred, (0.001, 0.999), axis=0)
    centred = np.clip(centred, low, high)
    values, vectors = np.linalg.eigh(np.cov(centred.T, aweights=seen))
    vectors = vectors[:, np.argsort(values)[::-1][:count]]
    found = centred @ vectors
    matrix = np.concatenate([vectors.T / scale, mean[None]])
    steps = (Steps(np.float32([RAW[0]]), np.float32([(RAW[1] - RAW[0]) / (density_levels - 1)]), np.array([density_levels])),
             Steps.of_width(found, np.full(count, width), levels))  # fmt: skip
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), found, steps, matrix, step=step)


def codebook(grid: Grid, count: int, seed: int = 1, rounds: int = 12, step=None) -> NodesFit:
    """Colours from a list of ``count``, found by k-means of what is seen."""
    seen = grid.seen.astype(np.float64) + LEAST
    # The slope of each node's own would move centres: the spread on a screen as a whole
    scale = np.sqrt(np.average(display(grid.colour) ** 2, axis=0, weights=seen))
    points = (grid.colour * scale).astype(np.float32)
    centres, rows = k_means(points, seen, count, seed, rounds)
    colour = centres / scale
    steps = (Steps(np.float32([RAW[0]]), np.float32([(RAW[1] - RAW[0]) / 255]), np.array([256])),
             Steps.over(colour, 256))  # fmt: skip
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), colour, steps, None, rows, step)


def k_means(points: np.ndarray, weights: np.ndarray, count: int, seed: int, rounds: int, most: int = 2**16):
    """Centres ``(count, D)`` of weighted ``points`` (n, D), from ``most`` of them, and the nearest to each (n,)."""
    rng = np.random.default_rng(seed)
    count = min(count, len(points))
    share = weights / weights.sum()
    chosen = rng.choice(len(points), min(most, len(points)), replace=False, p=None)
    centres = points[rng.choice(len(points), count, replace=False, p=0.5 * share + 0.5 / len(points))].copy()
    sample, mass = points[chosen], weights[chosen]
    for _ in range(rounds):
        own = nearest(sample, centres)
        total = np.bincount(own, mass, count)
        for k in range(points.shape[1]):
            centres[:, k] = np.where(
                total > 0, np.bincount(own, mass * sample[:, k], count) / np.maximum(total, 1e-30), centres[:, k]
            )
        empty = np.flatnonzero(np.bincount(own, minlength=count) == 0)
        if len(empty):
            far = np.sum((sample - centres[own]) ** 2, axis=1) * mass
            centres[empty] = sample[np.argsort(far)[::-1][: len(empty)]]
    return centres, nearest(points, centres)


def nearest(points: np.ndarray, centres: np.ndarray, part: int = 4096) -> np.ndarray:
    """The number of the nearest of ``centres`` to each of ``points``."""
    half = 0.5 * np.sum(centres**2, axis=1)
    return np.concatenate(
        [np.argmax(p @ centres.T - half, axis=1) for p in np.split(points, range(part, len(points), part))]
    )
