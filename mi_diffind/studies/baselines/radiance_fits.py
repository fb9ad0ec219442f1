"""Training of the baselines on nodes: from a grid, to parameters that are trained through images, to bytes.

A fit has a ``net``, tensors by name that an optimiser trains at one rate, and ``field_of``, which makes a field of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from ...arrays.indirection import device_array, device_tensor
from ...arrays.lookup import pack_bits
from ...tasks.radiance.grid import DENSITY_SCALE
from ...tasks.radiance.march import march, replay
from ...tasks.radiance.nodes import Nodes, cells_of, corners_of
from ...tasks.radiance.volume_field import NodeField
from .node_codes import QuantisationSteps, coded_bytes, deflated
from .radiance import RAW, ByteField, CoefficientField

#: Weight of a node that no ray sees, so that its colour is defined, too.
LEAST = 1e-6


@dataclass(frozen=True, eq=False)
class WeightedGrid:
    """Numbers on the nodes of a sparse or dense grid, with the weight of each node in the training views.

    ``density`` (n,) is raw, ``colour`` is (n, 12), and ``seen`` (n,) is the number of rays that end at each node; all
    are in lexicographic order of the ``nodes``.
    """

    nodes: Nodes
    density: np.ndarray
    colour: np.ndarray
    seen: np.ndarray

    @staticmethod
    def of(field: NodeField, seen: np.ndarray) -> WeightedGrid:
        """Return the numbers of a trained grid with the result of :func:`visibility`."""
        first = int(field.nodes.stored is not None)
        density, colour = (field.arrays[name].numpy() for name in ("density", "colour"))
        return WeightedGrid(field.nodes, density.reshape(-1)[first:], colour[first:], np.asarray(seen)[first:])

    def dense(self, values: np.ndarray, outside: float = 0.0) -> np.ndarray:
        """Return ``values`` (n, …) as a box ``(X, Y, Z, …)``."""
        box = np.full((*self.nodes.shape, *values.shape[1:]), outside, np.float32)
        box[self.stored] = values
        return box

    @property
    def stored(self) -> np.ndarray:
        """Mask of the stored nodes, bool ``(X, Y, Z)``."""
        return self.nodes.stored if self.nodes.stored is not None else np.ones(self.nodes.shape, bool)

    def kept(self, cells: np.ndarray) -> WeightedGrid:
        """Return the grid reduced to those of its cells that are in ``cells`` (bool)."""
        stored = corners_of(cells & self.cells())
        nodes = Nodes(self.nodes.types, self.nodes.lower, self.nodes.spacing, self.nodes.shape, stored)
        inside = stored[self.stored]
        return WeightedGrid(nodes, self.density[inside], self.colour[inside], self.seen[inside])

    def cells(self) -> np.ndarray:
        """Return the occupied cells, bool ``(X − 1, Y − 1, Z − 1)``."""
        return cells_of(self.stored)

    def coarser(self, scale: float) -> np.ndarray:
        """Return the mask of nodes ``scale`` times as far apart, whose cells cover the occupied cells of this grid."""
        shape = [int(np.ceil((n - 1) / scale - 1e-6)) + 1 for n in self.nodes.shape]
        old, last = np.argwhere(self.cells()), np.array(shape) - 2
        cells = np.zeros([n - 1 for n in shape], bool)
        for corner in np.ndindex(2, 2, 2):
            new = ((old + np.array(corner) * (1 - 1e-6)) / scale).astype(int)
            cells[tuple(np.minimum(new, last).T)] = True
        return corners_of(cells)

    def resampled(self, scale: float, sparse: bool = True) -> WeightedGrid:
        """Return the grid on nodes ``scale`` times as far apart: those of :meth:`coarser` if ``sparse``, otherwise all.

        Raw densities are interpolated; colours are means weighted by ``seen``. (Mean densities over cells would make
        walls transparent: 3 dB worse, and 1.6 dB after 200 steps of training.)
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
        coarse = Nodes(nodes.types, nodes.lower, scale * nodes.spacing, stored.shape, stored if sparse else None)
        return WeightedGrid(coarse, *(v.astype(np.float32) for v in (raw, colour, weight * scale**3)))


def visibility(field: NodeField, images, every: int = 2) -> np.ndarray:
    """Return how many rays of the views end at each node of a field, ``(n,)``.

    This is the derivative of the images with respect to the colours of the nodes, all equal, by one ray for ``every``
    pixels along x and y.
    """
    types, views = field.types, images.views
    arrays = {"density": types.TensorXf(dr.detach(field.arrays["density"]))}
    arrays["colour"] = dr.zeros(types.TensorXf, field.arrays["colour"].shape)
    dr.enable_grad(arrays)
    white = field.with_arrays(arrays)
    for view, (height, width) in enumerate(views.sizes.tolist()):
        columns, rows = width // every, height // every
        lane = dr.arange(types.UInt32, columns * rows)
        o, d = images.rays(dr.opaque(types.UInt32, view), every * (lane % columns), every * (lane // columns))
        dr.eval(o, d)
        seen = march(white, o, d, 0, dr.inf)
        dr.eval(seen.colour, seen.transmittance, seen.depth)
        replay(white, o, d, 0, dr.inf, True, 0.5, seen, types.Array3f(1, 0, 0))
        dr.eval(dr.grad(arrays))
    return dr.grad(arrays["colour"]).numpy().reshape(-1, field.arrays["colour"].shape[-1])[:, 0] * every**2


class NodesFit:
    """Training of a grid of bytes: ``density`` (n, 1) and coefficients of ``colour``, each with its quantisation steps.

    There is a row of ``colour`` for each node, or ``rows`` (n,) names the row of each. ``matrix`` maps a row to twelve
    coefficients, if there is one.
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
            "density": device_tensor(
                types.TensorXf, np.pad(density, (self.first, 0)).astype(np.float32)[:, None] / DENSITY_SCALE
            ),
            "colour": device_tensor(types.TensorXf, colour),
        }
        if matrix is not None:
            grown = np.insert(matrix, [self.channels] * spare, 0.0, axis=0)
            self.net["matrix"] = device_tensor(types.TensorXf, grown)
        self.numbers = None
        if rows is not None:
            self.numbers = device_array(types.UInt32, np.pad(rows, (self.first, 0)))

    def field_of(self, net) -> CoefficientField:
        """Return the field of the trained parameters, rounded as they are stored."""
        density = self.steps[0].rounded(self.types, net["density"] * DENSITY_SCALE)
        colour = self.rounding.rounded(self.types, net["colour"])
        matrix = net["matrix"] if "matrix" in self.net else None
        return CoefficientField(self.nodes, density, colour, self.numbers, matrix)

    def grid(self, seen: np.ndarray | None = None) -> WeightedGrid:
        """Return the current numbers of a fit without ``rows`` and ``matrix``."""
        density = self.net["density"].numpy()[self.first :, 0] * DENSITY_SCALE
        colour = self.net["colour"].numpy()[self.first :, : self.channels]
        return WeightedGrid(self.nodes, density, colour, np.ones(len(density)) if seen is None else seen)

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays of a file by name."""
        density = self.steps[0].codes(self.net["density"].numpy() * DENSITY_SCALE)[self.first :]
        colour = self.net["colour"].numpy()[0 if self.rows is not None else self.first :, : self.channels]
        state = {"density": density, "colour": self.steps[1].codes(colour), **nodes_state(self.nodes)}
        for name, steps in zip(("density", "colour"), self.steps, strict=True):
            state |= {f"{name}_low": steps.low, f"{name}_step": steps.step, f"{name}_levels": steps.levels}
        if "matrix" in self.net:
            matrix = self.net["matrix"].numpy()
            state["matrix"] = np.concatenate([matrix[: self.channels], matrix[-1:]])
        if self.rows is not None:
            state["rows"] = self.rows.astype(np.uint16)
        return state

    @staticmethod
    def field(types, state: dict) -> ByteField:
        """Return the field that reads what :meth:`state` returned."""
        names = ("low", "step", "levels")
        steps = tuple(QuantisationSteps(*(state[f"{array}_{n}"] for n in names)) for array in ("density", "colour"))
        return ByteField(nodes_of(types, state), state["density"][:, 0], state["colour"], steps, state.get("matrix"),
                         state.get("rows"))  # fmt: skip

    @staticmethod
    def file_bytes(state: dict, predict: bool = True) -> int:
        """Return the bytes on disk, after zlib."""
        rows, colour, density = state.get("rows"), state["colour"], state["density"]
        stored = state.get("stored", np.ones(state["shape"], bool))
        fixed = HEADER + sum(state[n].nbytes for n in state if n.endswith(("_low", "_step")) or n == "matrix")
        if rows is None:
            return fixed + coded_bytes(stored, np.concatenate([density, colour], axis=1), predict)
        bits = pack_bits(rows, max(1, (len(colour) - 1).bit_length()))
        packed = min(len(deflated(bits.tobytes())), len(deflated(rows.astype("<u2").tobytes())))
        return fixed + coded_bytes(stored, density, predict) + packed + len(deflated(colour.tobytes()))


#: Bytes of a file besides its arrays.
HEADER = 64


def nodes_state(nodes: Nodes) -> dict[str, np.ndarray]:
    """Return the arrays from which :func:`nodes_of` makes the nodes again."""
    state = {"lower": np.array(nodes.lower), "spacing": np.array(nodes.spacing), "shape": np.array(nodes.shape)}
    return state if nodes.stored is None else state | {"stored": nodes.stored}


def nodes_of(types, state: dict) -> Nodes:
    """Return the nodes of a state."""
    return Nodes(types, state["lower"], float(state["spacing"]), state["shape"], state.get("stored"))


#: Steps of raw densities.
DENSITY_STEPS = QuantisationSteps.between(*RAW)


def plain(grid: WeightedGrid, levels: int = 256) -> NodesFit:
    """Return the fit of thirteen numbers a node, those of colour in ``levels`` uniform steps."""
    steps = DENSITY_STEPS, QuantisationSteps.over(grid.colour, levels, grid.seen + LEAST, 1e-3)
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), grid.colour, steps)


def display(grid: WeightedGrid) -> np.ndarray:
    """Return the sensitivity of the displayed image to each coefficient of colour, (12,).

    It is the slope of sRGB times the radiance, as a root mean square over nodes weighted by ``seen``.
    """
    radiance = np.exp(np.clip(grid.colour[:, ::4], -12, 1.5))
    slope = np.where(radiance <= 0.0031308, 12.92, 1.055 / 2.4 * np.maximum(radiance, 0.0031308) ** (1 / 2.4 - 1))
    squared = np.average((slope * radiance) ** 2, axis=0, weights=grid.seen + LEAST)
    return np.repeat(np.sqrt(squared), 4)


def components(grid: WeightedGrid, width: float, count: int = 12) -> NodesFit:
    """Return the fit of ``count`` principal components of colour, in steps that change the display by ``width``."""
    seen, scale = grid.seen.astype(np.float64) + LEAST, display(grid)
    mean = np.average(grid.colour, axis=0, weights=seen)
    centred = (grid.colour - mean) * scale
    centred = np.clip(centred, *np.quantile(centred, (0.001, 0.999), axis=0))
    values, vectors = np.linalg.eigh(np.cov(centred.T, aweights=seen))
    vectors = vectors[:, np.argsort(values)[::-1][:count]]
    values = centred @ vectors
    steps = DENSITY_STEPS, QuantisationSteps.of_width(values, np.full(count, width))
    matrix = np.concatenate([vectors.T / scale, mean[None]])
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), values, steps, matrix)


def codebook(grid: WeightedGrid, count: int) -> NodesFit:
    """Return the fit with a codebook of ``count`` colours, found by k-means with the weights ``seen``."""
    scale = display(grid)
    centres, rows = k_means((grid.colour * scale).astype(np.float32), grid.seen + LEAST, count)
    colour = centres / scale
    steps = DENSITY_STEPS, QuantisationSteps.over(colour)
    return NodesFit(grid.nodes, np.clip(grid.density, *RAW), colour, steps, None, rows)


#: Points that centres are computed from, and rounds of k-means.
SAMPLE, ROUNDS = 2**16, 10


def k_means(points: np.ndarray, weights: np.ndarray, count: int):
    """Return centres ``(count, D)`` of weighted ``points`` (n, D), and the index of the nearest of each (n,)."""
    rng = np.random.default_rng(1)
    count = min(count, len(points))
    share = weights / weights.sum()
    centres = points[rng.choice(len(points), count, replace=False, p=0.5 * share + 0.5 / len(points))]
    chosen = rng.choice(len(points), min(SAMPLE, len(points)), replace=False)
    sample, mass = points[chosen], weights[chosen]
    for _ in range(ROUNDS):
        nearest = cKDTree(centres).query(sample)[1]
        total = np.bincount(nearest, mass, count)
        sums = np.stack([np.bincount(nearest, mass * v, count) for v in sample.T], axis=1)
        centres = np.where(total[:, None] > 0, sums / np.maximum(total, 1e-30)[:, None], centres).astype(np.float32)
        idle = np.flatnonzero(total == 0)
        if len(idle):  # they move to the largest errors
            missing = np.sum((sample - centres[nearest]) ** 2, axis=1) * mass
            worst = np.argsort(missing)[::-1][: len(idle)]
            centres[idle[: len(worst)]] = sample[worst]
    return centres, cKDTree(centres).query(points)[1]
