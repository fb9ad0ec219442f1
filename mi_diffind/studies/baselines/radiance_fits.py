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
from scipy.spatial import cKDTree

from ...bits import pack_bits
from ...tasks.radiance.field import GridField
from ...tasks.radiance.grid import DENSITY_SCALE
from ...tasks.radiance.march import march, replay
from ...tasks.radiance.nodes import Nodes, cells_of, corners_of
from .node_codes import QuantisationSteps, coded_bytes, deflated
from .radiance import RAW, ByteField, CoefficientField

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

    def coarser(self, scale: float) -> np.ndarray:
        """Nodes, bool, ``scale`` times as far apart: the corners of cells that those of this grid reach into."""
        shape = [int(np.ceil((n - 1) / scale - 1e-6)) + 1 for n in self.nodes.shape]
        old, last = np.argwhere(self.cells()), np.array(shape) - 2
        cells = np.zeros([n - 1 for n in shape], bool)
        for corner in np.ndindex(2, 2, 2):
            new = ((old + np.array(corner) * (1 - 1e-6)) / scale).astype(int)
            cells[tuple(np.minimum(new, last).T)] = True
        return corners_of(cells)

    def resampled(self, scale: float, sparse: bool = True) -> Grid:
        """
        On nodes that are ``scale`` times as far apart: raw densities as they are interpolated there, and colours,
        weighted by what is seen. With ``sparse`` the nodes of :meth:`coarser`, otherwise all. (Means of densities over
        cells instead leave walls that are transparent: 3 dB worse, and 1.6 dB after 200 steps of training.)
        """
        nodes, stored = self.nodes, self.coarser(scale)
        chosen = stored if sparse else np.ones_like(stored)
        seen = self.dense(self.seen) + LEAST * self.dense(np.ones(len(self.seen), np.float32))
        values = [np.maximum(self.dense(self.density, RAW[0]), RAW[0]), seen]
        values += [v * seen for v in np.moveaxis(self.dense(self.colour), -1, 0)]
        at = np.argwhere(chosen).T * scale
        raw, weight, *sums = (map_coordinates(v, at, order=1, mode="nearest", prefilter=False) for v in values)
        mean = np.average(self.colour, axis=0, weights=self.seen + LEAST)
        known = weight > 1e-9
        colour = np.where(known[:, None], np.stack(sums, axis=1) / np.maximum(weight, 1e-12)[:, None], mean)
        found = Nodes(nodes.types, nodes.lower, scale * nodes.spacing, stored.shape, stored if sparse else None)
        return Grid(found, *(v.astype(np.float32) for v in (raw, colour, weight * scale**3)))


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
    A grid of bytes: density and, of each node or of each of ``rows``, coefficients of colour, each with its
    :class:`.QuantisationSteps`; ``matrix`` makes twelve numbers of them, if there is one.
    """

    def __init__(
        self, nodes: Nodes, density, colour, steps: tuple[QuantisationSteps, QuantisationSteps], matrix=None, rows=None
    ):
        self.nodes, self.rows, self.steps = nodes, rows, steps
        types = self.types = nodes.types
        self.first = int(nodes.stored is not None)
        self.channels = colour.shape[1]
        # Colours are read four numbers at a time
        spare = -self.channels % 4
        colour = np.pad(colour, ((0 if rows is not None else self.first, 0), (0, spare)))
        ones = {"constant_values": 1}
        padded = [np.pad(steps[1].low, (0, spare)), np.pad(steps[1].step, (0, spare), **ones)]
        self.rounding = QuantisationSteps(*padded, np.pad(steps[1].levels, (0, spare), **ones))
        self.net = {
            "density": types.TensorXf(np.pad(density, (self.first, 0)).astype(np.float32)[:, None] / DENSITY_SCALE),
            "colour": types.TensorXf(colour.astype(np.float32)),
        }
        if matrix is not None:
            grown = np.insert(matrix, [self.channels] * spare, 0.0, axis=0)
            self.net["matrix"] = types.TensorXf(grown.astype(np.float32))
        self.numbers = None
        if rows is not None:
            self.numbers = types.UInt32(np.pad(rows, (self.first, 0)).astype(np.uint32))

    def field_of(self, net) -> CoefficientField:
        """The field of what is trained, rounded as it will be stored."""
        arrays = {
            "density": self.steps[0].rounded(self.types, net["density"] * DENSITY_SCALE),
            "colour": self.rounding.rounded(self.types, net["colour"]),
        }
        if "matrix" in self.net:
            arrays["matrix"] = net["matrix"]
        return CoefficientField(self.nodes, arrays, self.numbers)

    def grid(self, seen: np.ndarray | None = None) -> Grid:
        """The numbers as they are now, of a fit that has neither ``rows`` nor a ``matrix``."""
        density = self.net["density"].numpy()[self.first :, 0] * DENSITY_SCALE
        colour = self.net["colour"].numpy()[self.first :, : self.channels]
        return Grid(self.nodes, density, colour, np.ones(len(density)) if seen is None else seen)

    def state(self) -> dict[str, np.ndarray]:
        """All that a file has to hold, by name."""
        density = self.steps[0].codes(self.net["density"].numpy() * DENSITY_SCALE)[self.first :]
        colour = self.net["colour"].numpy()[0 if self.rows is not None else self.first :, : self.channels]
        found = {"density": density, "colour": self.steps[1].codes(colour), **nodes_state(self.nodes)}
        for name, steps in zip(("density", "colour"), self.steps, strict=True):
            found |= {f"{name}_low": steps.low, f"{name}_step": steps.step, f"{name}_levels": steps.levels}
        if "matrix" in self.net:
            matrix = self.net["matrix"].numpy()
            found["matrix"] = np.concatenate([matrix[: self.channels], matrix[-1:]])
        if self.rows is not None:
            found["rows"] = self.rows.astype(np.uint16)
        return found

    @staticmethod
    def field(types, state: dict) -> ByteField:
        """The field that reads what :meth:`state` returned."""
        names = ("low", "step", "levels")
        steps = tuple(QuantisationSteps(*(state[f"{kind}_{n}"] for n in names)) for kind in ("density", "colour"))
        return ByteField(nodes_of(types, state), state["density"][:, 0], state["colour"], steps, state.get("matrix"),
                         state.get("rows"))  # fmt: skip

    @staticmethod
    def file_bytes(state: dict, predict: bool = True) -> int:
        """Bytes on disk, after zlib."""
        rows, colour, density = state.get("rows"), state["colour"], state["density"]
        stored = state.get("stored", np.ones(state["shape"], bool))
        fixed = HEADER + sum(state[n].nbytes for n in state if n.endswith(("_low", "_step")) or n == "matrix")
        if rows is None:
            return fixed + coded_bytes(stored, np.concatenate([density, colour], axis=1), predict)
        packed = min(len(deflated(bits_of(rows, len(colour)))), len(deflated(rows.astype("<u2").tobytes())))
        return fixed + coded_bytes(stored, density, predict) + packed + len(deflated(colour.tobytes()))


#: Bytes of a file beside its arrays.
HEADER = 64


def nodes_state(nodes: Nodes) -> dict[str, np.ndarray]:
    """What :func:`nodes_of` makes nodes of."""
    found = {"lower": np.array(nodes.lower), "spacing": np.array(nodes.spacing), "shape": np.array(nodes.shape)}
    return found if nodes.stored is None else found | {"stored": nodes.stored}


def nodes_of(types, state: dict) -> Nodes:
    return Nodes(types, state["lower"], float(state["spacing"]), state["shape"], state.get("stored"))


def bits_of(numbers: np.ndarray, count: int) -> bytes:
    """Numbers below ``count`` in as many bits as they need."""
    return pack_bits(numbers, max(1, int(count - 1).bit_length())).tobytes()


def density_steps(levels: int = 256) -> QuantisationSteps:
    return QuantisationSteps(np.float32([RAW[0]]), np.float32([(RAW[1] - RAW[0]) / (levels - 1)]), np.array([levels]))


def plain(grid: Grid, levels: int = 256) -> NodesFit:
    """Thirteen numbers a node, those of colour in so many equal steps."""
    steps = density_steps(), QuantisationSteps.over(grid.colour, levels, grid.seen + LEAST, 1e-3)
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), grid.colour, steps)


def display(grid: Grid) -> np.ndarray:
    """
    How much each of twelve numbers of colour changes what is shown on a screen, to first order, as the root mean square
    of what is seen, (12,): the slope of sRGB times the radiance.
    """
    radiance = np.exp(np.clip(grid.colour[:, ::4], -12, 1.5))
    slope = np.where(radiance <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(radiance, 0.0031308) ** (1 / 2.4 - 1))
    squared = np.average((slope * radiance) ** 2, axis=0, weights=grid.seen + LEAST)
    return np.repeat(np.sqrt(squared), 4)


def components(grid: Grid, width: float, count: int = 12) -> NodesFit:
    """So many principal components of what is seen of the colours, in equal steps that change a screen by ``width``."""
    seen, scale = grid.seen.astype(np.float64) + LEAST, display(grid)
    mean = np.average(grid.colour, axis=0, weights=seen)
    centred = (grid.colour - mean) * scale
    centred = np.clip(centred, *np.quantile(centred, (0.001, 0.999), axis=0))
    values, vectors = np.linalg.eigh(np.cov(centred.T, aweights=seen))
    vectors = vectors[:, np.argsort(values)[::-1][:count]]
    found = centred @ vectors
    steps = density_steps(), QuantisationSteps.of_width(found, np.full(count, width))
    matrix = np.concatenate([vectors.T / scale, mean[None]])
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), found, steps, matrix)


def codebook(grid: Grid, count: int, seed: int = 1, rounds: int = 10) -> NodesFit:
    """Colours from a list of ``count``, found by k-means of what is seen."""
    scale = display(grid)
    centres, rows = k_means((grid.colour * scale).astype(np.float32), grid.seen + LEAST, count, seed, rounds)
    colour = centres / scale
    steps = density_steps(), QuantisationSteps.over(colour)
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), colour, steps, None, rows)


#: Points that centres are moved by, at most.
SAMPLE = 2**16


def k_means(points: np.ndarray, weights: np.ndarray, count: int, seed: int, rounds: int):
    """Centres ``(count, D)`` of weighted ``points`` (n, D), and the number of the nearest for each (n,)."""
    rng = np.random.default_rng(seed)
    count = min(count, len(points))
    share = weights / weights.sum()
    centres = points[rng.choice(len(points), count, replace=False, p=0.5 * share + 0.5 / len(points))]
    chosen = rng.choice(len(points), min(SAMPLE, len(points)), replace=False)
    sample, mass = points[chosen], weights[chosen]
    for _ in range(rounds):
        own = cKDTree(centres).query(sample)[1]
        total = np.bincount(own, mass, count)
        sums = np.stack([np.bincount(own, mass * v, count) for v in sample.T], axis=1)
        centres = np.where(total[:, None] > 0, sums / np.maximum(total, 1e-30)[:, None], centres).astype(np.float32)
        idle = np.flatnonzero(total == 0)
        if len(idle):  # to where most is missing
            missing = np.sum((sample - centres[own]) ** 2, axis=1) * mass
            worst = np.argsort(missing)[::-1][: len(idle)]
            centres[idle[: len(worst)]] = sample[worst]
    return centres, cKDTree(centres).query(points)[1]
