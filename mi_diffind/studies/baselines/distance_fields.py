"""Rivals of distance fields in equal bytes: dense grids, sparse distances without indirection, a hash grid.

Everything is in the unit frame of :mod:`mi_diffind.tasks.sdf.field`. Distances are stored in ``2^bits`` equal steps
between ± ``band``; no step has its middle at zero, so no sign is lost. Bytes are those of all that a read needs: nodes
and index. Nodes are exact, or trained by linear least squares (:func:`least_squares`).
"""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import numpy as np

from ...arrays.lookup import clamp
from ...arrays.sparse_grid import CORNERS, SparseGrid
from ...core.files import replacing
from ...core.units import largest_fitting
from ...fitting.loop import Problem
from ...maps.pyramid import decibel
from ...tasks.sdf import nodes
from ...tasks.sdf.distances import Distances, sample_box, sample_near, surface_cells
from ...tasks.sdf.encoding import sample
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.mesh import Mesh
from ...tasks.sdf.nodes import SparseNodes, middles
from .networks import LAYERS, WIDTH, Network, hash_grid

#: Largest distance, in cells, between the surface and a corner of a cell that the surface crosses.
NEAREST = 1.75

#: Samples of a cell in the training of nodes, and of all cells together.
SAMPLES = 16
MOST_SAMPLES = 2**21

#: Weight of gradients, times the side of a cell, in the training of nodes.
GRADIENT_WEIGHT = 0.2

#: Distance from the surface, in cells, at which a sample weighs half.
FOCUS = 0.5

#: Weight of the distance that was sampled at a node.
KEEP = 0.03

#: Spacing, of the longest side, that :func:`fit_bytes` tries first, and its limits.
FIRST_SPACING = 1 / 64
FINEST_SPACING = 1 / 2048
COARSEST_SPACING = 1 / 12

#: Largest distance that a network learns.
BAND = 0.02

#: Padding of the mesh's box, of which the field of a network is defined.
PADDING = 0.01

#: Finest resolution of a hash grid of 1 MiB.
FINEST = 256


def quantise(values: np.ndarray, band: float, bits: int = 8) -> np.ndarray:
    """Return the steps that hold ``values``, uint8; :func:`dequantise` is the reverse."""
    half = 2 ** (bits - 1)
    return np.clip(np.floor(values * (half / band)) + half, 0, 2 * half - 1).astype(np.uint8)


def dequantise(codes: np.ndarray, band: float, bits: int = 8) -> np.ndarray:
    """Return the distances in the middles of steps, float32."""
    half = 2 ** (bits - 1)
    return (codes.astype(np.float32) + np.float32(0.5 - half)) * np.float32(band / half)


def places(shape) -> np.ndarray:
    """Return all whole-numbered places of a grid, ``(N, 3)``, in C order."""
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)


def slope_bound(values: np.ndarray, spacing: float) -> float:
    """Return a bound of the gradient of trilinear interpolation in grids ``(…, X, Y, Z)`` of distances, at least 1."""
    total = 0.0
    for axis in (-3, -2, -1):
        steps = np.abs(np.diff(values, axis=axis))
        for other in {-3, -2, -1} - {axis}:
            ends = [[slice(None)] * 3, [slice(None)] * 3]
            ends[0][other], ends[1][other] = slice(1, None), slice(None, -1)
            steps = np.maximum(*(steps[(..., *e)] for e in ends))
        total = total + (steps.astype(np.float64) / spacing) ** 2
    return max(1.0, float(np.sqrt(np.max(total))))


class ByteGrid(DistanceField):
    """Dense grid of ``nodes``, uint8 ``(X, Y, Z)``, the first of which is at ``lower``, interpolated trilinearly."""

    def __init__(self, types, nodes: np.ndarray, lower, spacing: float, band: float):
        self.cells = tuple(n - 1 for n in nodes.shape)
        upper = [a + n * spacing for a, n in zip(lower, self.cells, strict=True)]
        super().__init__(types, lower, upper, spacing, band)
        self.step = band / 128
        self.state = {"nodes": nodes, "lower": np.array(lower), "spacing": spacing, "band": band}
        self.nodes = types.UInt8(np.ascontiguousarray(nodes.ravel()))
        self.nbytes = nodes.size
        # Slabs of 32 cells that share their ends, to save memory
        slabs = (nodes[i : i + 33] for i in range(0, nodes.shape[0] - 1, 32))
        self.slope = max(slope_bound(dequantise(slab, band), spacing) for slab in slabs)

    def _corners(self, index, active):
        i, j, k = index
        _, ny, nz = (n + 1 for n in self.cells)
        first = (i * ny + j) * nz + k

        def read(offset: int):
            return self.types.Float(dr.gather(self.types.UInt8, self.nodes, first + offset, active))

        return [[[read((a * ny + b) * nz + c) for c in (0, 1)] for b in (0, 1)] for a in (0, 1)]

    def _cell(self, p):
        """Return for each axis the cell and the place in it, from 0 to 1."""
        axes = []
        for x, a, n in zip(p, self.lower, self.cells, strict=True):
            t = clamp((x - a) / self.spacing, 0.0, float(n))
            i = dr.minimum(self.types.UInt32(dr.detach(t)), n - 1)
            axes.append((i, t - self.types.Float(i)))
        return axes

    def _interpolated(self, corners, weights):
        c, (u, v, w) = corners, weights
        rows = [dr.lerp(dr.lerp(c[a][0][0], c[a][0][1], w), dr.lerp(c[a][1][0], c[a][1][1], w), v) for a in (0, 1)]
        return self._distance(dr.lerp(rows[0], rows[1], u))

    def _distance(self, code):
        return dr.fma(code, self.step, -127.5 * self.step)

    def value(self, p, active=True):
        active = self.inside(p) & active
        index, weights = zip(*self._cell(p), strict=True)
        return dr.select(active, self._interpolated(self._corners(index, active), weights), self.band)

    def gradient(self, p, active=True):
        active = self.inside(p) & active
        index, (u, v, w) = zip(*self._cell(p), strict=True)
        c = self._corners(index, active)
        edges = [[dr.lerp(c[a][b][0], c[a][b][1], w) for b in (0, 1)] for a in (0, 1)]
        across = [[c[a][b][1] - c[a][b][0] for b in (0, 1)] for a in (0, 1)]
        lines = [dr.lerp(edges[a][0], edges[a][1], v) for a in (0, 1)]
        slope = self.types.Array3f(
            lines[1] - lines[0],
            dr.lerp(edges[0][1] - edges[0][0], edges[1][1] - edges[1][0], u),
            dr.lerp(dr.lerp(across[0][0], across[0][1], v), dr.lerp(across[1][0], across[1][1], v), u),
        )
        value = self._distance(dr.lerp(lines[0], lines[1], u))
        return dr.select(active, value, self.band), dr.select(active, slope * (self.step / self.spacing), 0)


def dense(types, distances: Distances, spacing: float, train: bool = False) -> ByteGrid:
    """Return a dense grid with exact distances at its nodes, or with trained nodes (:func:`least_squares`)."""
    cells = _dense_cells(distances.mesh, spacing)
    lower, shape = (distances.mesh.lower + distances.mesh.upper) / 2 - cells * spacing / 2, cells + 1
    values = distances.signed(lower + places(shape) * spacing, 3 * spacing)
    if train:
        values = least_squares(distances, lower, spacing, shape, np.arange(len(values)), values)
    band = NEAREST * spacing
    return ByteGrid(types, quantise(values.reshape(shape), band), lower, spacing, band)


def dense_spacing(mesh: Mesh, nbytes: int) -> float:
    """Return the spacing of the finest :func:`dense` grid of ``nbytes``."""

    def fits(fineness: float) -> bool:
        return np.prod(_dense_cells(mesh, math.exp(-fineness)) + 1.0) <= nbytes

    return math.exp(-largest_fitting(fits, 0.0, math.log(1e4), steps=40))


def _dense_cells(mesh: Mesh, spacing: float) -> np.ndarray:
    return np.ceil((mesh.upper - mesh.lower) / spacing + 1).astype(int)


def least_squares(
    distances: Distances, lower, spacing: float, shape, keys: np.ndarray, values: np.ndarray, keep: float = KEEP
) -> np.ndarray:
    """Return ``values`` with those nodes trained that belong to a cell which the surface crosses.

    ``keys`` are the places of the nodes in a grid of ``shape`` nodes (C order, ascending); only cells with all of their
    nodes count. Trilinear interpolation of the trained nodes is nearest to distances and normals at random points of
    the cells, by linear least squares: the exact minimum, without a rate, a schedule or a batch. ``keep`` is the weight
    of the given ``values``.
    """
    from scipy import sparse
    from scipy.sparse.linalg import cg

    rng = np.random.default_rng(1)
    cells = surface_cells(distances, lower, spacing, np.asarray(shape) - 1)
    corners = np.ravel_multi_index((cells[:, None] + CORNERS).reshape(-1, 3).T, shape)
    at = np.minimum(np.searchsorted(keys, corners), len(keys) - 1)
    whole = (keys[at] == corners).reshape(-1, 8).all(axis=1)
    cells, corners = cells[whole], at.reshape(-1, 8)[whole]
    each = int(np.clip(MOST_SAMPLES / max(1, len(cells)), 4, SAMPLES))
    blocks, right = np.empty((len(cells), 8, 8), np.float32), np.empty((len(cells), 8), np.float32)
    for part in np.array_split(np.arange(len(cells)), max(1, len(cells) * each // 2**18)):
        place = rng.random((len(part), each, 3))
        d, g = distances.signed_normals((lower + (cells[part][:, None] + place) * spacing).reshape(-1, 3))
        # Per sample a row for the distance, in cells, and three for the gradient
        ends = np.where(CORNERS == 1, place[..., None, :], 1 - place[..., None, :])
        signs = 2.0 * CORNERS - 1
        rows = [ends.prod(-1), *(ends[..., np.delete(np.arange(3), a)].prod(-1) * signs[:, a] for a in range(3))]
        truth = np.concatenate([d[:, None] / spacing, g], axis=1).reshape(len(part), each, 4)
        weight = 1 / (1 + (truth[..., :1] / FOCUS) ** 2) * np.array([1, *[GRADIENT_WEIGHT**2] * 3])
        rows = np.stack(rows, -2)
        weighted = rows * weight[..., None]
        blocks[part] = np.einsum("nsrc,nsrd->ncd", weighted, rows, optimize=True)
        right[part] = np.einsum("nsrc,nsr->nc", weighted, truth, optimize=True)
    used, at = np.unique(corners, return_inverse=True)
    at = at.reshape(-1, 8)
    start, keep = values[used].astype(np.float64) / spacing, keep * each
    entries = np.repeat(at, 8, axis=1).ravel(), np.tile(at, (1, 8)).ravel()
    matrix = sparse.coo_array((blocks.ravel(), entries), (len(used),) * 2).tocsr().astype(np.float64)
    matrix += sparse.diags_array(np.full(len(used), keep))
    target = np.bincount(at.ravel(), right.ravel(), len(used)) + keep * start
    solution, _ = cg(matrix, target, start, rtol=1e-4, maxiter=200)
    trained = values.copy()
    trained[used] = solution * spacing
    return trained


class DistanceNodes(SparseNodes):
    """Distances of ``bits`` each at the nodes of a sparse ``structure``: our layout without normals and indirection."""

    def __init__(self, types, structure: SparseGrid, numbers: np.ndarray, band: float, bits: int, slope: float):
        words = nodes.pointer_words(numbers, bits)
        super().__init__(types, structure, slope, pointers=words, bits=bits)
        self.state = {"numbers": numbers, "band": band, "bits": bits, "slope": slope, **structure_arrays(structure)}
        self.band_spacings, self.number_bytes = band / self.spacing, 4 * len(words)

    def _node(self, number, record, i, j, k, active):
        value = self.types.Float(nodes.pointer_at(self._pointers, number, self.bits, active))
        half = 2 ** (self.bits - 1)
        zero = self.types.Float(0)
        return (value + (0.5 - half)) * (self.band_spacings / half), (zero, zero, zero)

    def normal(self, p, active=True):
        return self.gradient(p, active)[1]

    def decoded(self) -> np.ndarray:
        distances = dequantise(self.state["numbers"], self.band_spacings, self.bits)
        return np.stack([distances, *[np.zeros_like(distances)] * 3], axis=1)

    def frames(self) -> np.ndarray:
        """Return for each block the plane nearest to its nodes' distances, which bounds the part that rays march."""
        positions, block = self.structure.node_positions()
        terms = np.concatenate([np.ones((len(positions), 1)), middles(positions)], axis=1)
        columns = np.concatenate([terms, self.decoded()[:, :1]], axis=1)
        sums = np.zeros((self.structure.blocks, 4, 5))
        np.add.at(sums, block, terms[:, :, None] * columns[:, None])
        planes = np.linalg.solve(sums[..., :4] + 1e-3 * np.eye(4), sums[..., 4:])[..., 0]
        length = np.linalg.norm(planes[:, 1:], axis=1, keepdims=True)
        normals = np.where(length > 0, planes[:, 1:] / np.maximum(length, 1e-9), [0.0, 0.0, 1.0])
        return nodes.frame_words(normals, planes[:, 0], np.ones(len(planes)))

    @property
    def nbytes(self) -> int:
        return self.structure.nbytes + self.number_bytes


def distance_nodes(types, distances: Distances, spacing: float, train: bool = False, bits: int = 6) -> DistanceNodes:
    """Return the corners of all cells that have corners of both signs, with exact distances or trained ones."""
    sampled = sample(distances, spacing)
    structure, band = sampled.structure, NEAREST * spacing
    keys = np.ravel_multi_index(sampled.positions.astype(np.int64).T, structure.shape)
    order = np.argsort(keys)
    values = sampled.distances * spacing
    if train:
        # Nodes keep their sides: the signs decide which nodes there are
        lower = np.asarray(structure.lower)
        trained = least_squares(distances, lower, spacing, structure.shape, keys[order], values[order])
        least = 0.5 * band / 2 ** (bits - 1)
        values[order] = np.where(values[order] < 0, np.minimum(trained, -least), np.maximum(trained, least))
    numbers = quantise(values, band, bits)
    corners = dequantise(numbers, band, bits)[sampled.corners].reshape(-1, 2, 2, 2)
    slope = max(slope_bound(part, spacing) for part in np.array_split(corners, max(1, corners.size // 2**21)))
    return DistanceNodes(types, structure, numbers, band, bits, slope)


def structure_arrays(structure: SparseGrid) -> dict:
    """Return the fields of a structure for the ``state`` of a field, each name with ``structure_`` before it."""
    return {f"structure_{f.name}": getattr(structure, f.name) for f in dataclasses.fields(structure)}


def save(path: Path | str | None, field: DistanceField) -> int:
    """Write a field's ``state``, the arguments of its class without ``types``, unless ``path`` is ``None``.

    :func:`load` reads the file. Returns its size; the arrays are compressed (zlib).
    """
    file = io.BytesIO()
    np.savez_compressed(file, class_name=type(field).__name__, **field.state)
    if path:
        with replacing(path) as temporary:
            temporary.write_bytes(file.getvalue())
    return len(file.getvalue())


def load(path: Path | str, types) -> DistanceField:
    """Return the field of a file that :func:`save` wrote."""
    with np.load(path, allow_pickle=False) as file:
        state = {name: file[name] if file[name].ndim else file[name].item() for name in file}
    field_class = {c.__name__: c for c in (ByteGrid, DistanceNodes)}[state.pop("class_name")]
    parts = {name: state.pop(name) for name in list(state) if name.startswith("structure_")}
    if parts:
        parts = {name.removeprefix("structure_"): v for name, v in parts.items()}
        state["structure"] = SparseGrid(**{**parts, "lower": tuple(parts["lower"].tolist())})
    return field_class(types, **state)


def fit_bytes(make: Callable[[float], DistanceField], nbytes: int) -> DistanceField:
    """Return the field ``make(spacing)`` with the finest spacing that fits into ``nbytes``.

    The field is within 1.5% of ``nbytes`` if few attempts reach that, else within 3% if possible. Raises ``ValueError``
    if no spacing fits.
    """
    spacing, power, before, best = FIRST_SPACING, 2.0, None, None
    for attempt in range(8):
        field = make(spacing)
        if field.nbytes <= nbytes and (best is None or field.nbytes > best.nbytes):
            best = field
        if best is not None and best.nbytes >= (0.985 if attempt < 3 else 0.97) * nbytes:
            break
        if before is not None and field.nbytes != before[1]:
            power = math.log(field.nbytes / before[1]) / math.log(before[0] / spacing)
        before = spacing, field.nbytes
        # A quarter of the bytes shows how they grow, and takes a quarter of the time
        aim = 0.25 if attempt == 0 and field.nbytes < nbytes / 8 else 0.993
        spacing *= (field.nbytes / (aim * nbytes)) ** (1 / np.clip(power, 1.5, 3.0))
        spacing = float(np.clip(spacing, FINEST_SPACING, COARSEST_SPACING))
        if spacing == before[0]:
            break
    if best is None:
        raise ValueError(f"{nbytes:,} bytes are too few: {field.nbytes:,} are the least that was found")
    return best


# -- Hash grid and network ---------------------------------------------------------------------------------------------


def network(nbytes: int) -> Network:
    """Return the largest network with hash grid of ``nbytes``, not yet allocated; raises as :func:`.hash_grid`."""
    return Network(3, WIDTH, LAYERS, hash_grid(3, nbytes, FINEST * math.sqrt(nbytes / 2**20), 1))


class HashDistanceField(DistanceField):
    """Field of a trained ``net`` with distances divided by :data:`BAND`; no bound of its slope is known."""

    def __init__(self, types, net: Network, mesh: Mesh):
        finest = net.grid["base_resolution"] * net.grid["per_level_scale"] ** (net.grid["n_levels"] - 1)
        super().__init__(types, mesh.lower - PADDING, mesh.upper + PADDING, 1 / finest, BAND)
        self.net = net
        self.nbytes = 2 * net.parameters

    def value(self, p, active=True):
        active = self.inside(p) & active
        value = self.net([(x - a) for x, a in zip(p, self.lower, strict=True)])[0]
        return dr.select(active, dr.clip(value * BAND, -BAND, BAND), BAND)

    def gradient(self, p, active=True):
        active = self.inside(p) & active
        with dr.resume_grad():
            q = self.types.Array3f(dr.detach(p))
            dr.enable_grad(q)
            value = self.net([(x - a) for x, a in zip(q, self.lower, strict=True)])[0] * BAND
            dr.backward(value)
            slope = dr.detach(dr.grad(q))
        value = dr.clip(dr.detach(value), -BAND, BAND)
        return dr.select(active, value, BAND), dr.select(active, slope, 0)

    def safe_step(self, p, d, active=True):
        raise NotImplementedError("no bound of the slope of a network is known")


class HashProblem(Problem):
    """Training of a :class:`Network` on a ``pool`` of points with distances, measured on another (:func:`pool`)."""

    def __init__(self, net: Network, types, mesh: Mesh, pool: tuple, held: tuple):
        self.net, self.types = net.alloc(types.TensorXf, 3, dr.rng(seed=1)), types
        self.field = HashDistanceField(types, self.net, mesh)
        self.pool, self.held = self._arrays(*pool), self._arrays(*held)
        self.count = len(pool[1])
        self.identity = {"mesh": mesh.digest, "count": self.count, "seed": 1}

    def _arrays(self, points: np.ndarray, distances: np.ndarray):
        points = [self.types.Float(np.ascontiguousarray(x)) for x in points.T]
        return [*points, self.types.Float(np.clip(distances / BAND, -1, 1))]

    def batch(self, rng, size: int):
        index = dr.minimum(self.types.UInt32(rng.random(self.types.Float, size) * self.count), self.count - 1)
        *p, d = (dr.gather(self.types.Float, v, index) for v in self.pool)
        return p, {"d": [d]}

    def predict(self, net, inputs) -> dict[str, list]:
        return {"d": net([x - a for x, a in zip(inputs, self.field.lower, strict=True)])}

    def measure(self, net) -> dict[str, float]:
        *p, d = self.held
        error = dr.clip(self.predict(net, p)["d"][0], -1, 1) - d
        return {"psnr_db": decibel(float(dr.mean(dr.square(error))[0]))}


def pool(distances: Distances, lower, upper, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` points in a box and their distances, ``(count, 3)`` and ``(count,)``.

    Three quarters are near the surface (normal distributions of 0.002 and 0.01), the others uniform.
    """
    rng = np.random.default_rng(seed)
    near = [sample_near(distances.mesh, 3 * count // 8, width, rng) for width in (0.002, 0.01)]
    rest = sample_box(lower, upper, count - sum(map(len, near)), rng)
    points = np.clip(np.concatenate([*near, rest]), lower, upper)[rng.permutation(count)].astype(np.float32)
    return points, distances.signed(points, 2 * BAND)
