"""Rivals of distance fields in equal bytes: dense and sparse grids of 8 bits, and a hash grid with a network.

Everything is in the unit frame of :mod:`mi_diffind.tasks.sdf.field`. Grids hold exact distances in 256 equal steps
between ± ``band``; no step has its middle at zero, so no sign is lost. Bytes are those of all that a read needs: nodes
and index.
"""

from __future__ import annotations

import math
import zlib

import drjit as dr
import numpy as np

from ...arrays.budget import Budget
from ...arrays.lookup import clamp
from ...arrays.sparse_grid import SparseGrid
from ...core.units import largest_fitting
from ...fitting.loop import Problem
from ...maps.pyramid import decibel
from ...tasks.sdf import nodes
from ...tasks.sdf.distances import Distances, sample_box, sample_near
from ...tasks.sdf.encoding import sample
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.mesh import Mesh
from ...tasks.sdf.nodes import SparseNodes, middles
from .networks import LAYERS, WIDTH, Network, hash_grid

#: Largest distance, in cells, between the surface and a corner of a cell that the surface crosses.
NEAREST = 1.75

#: Spacing, of the longest side, that :func:`sparse_nodes` tries first, and its limits.
FIRST_SPACING = 1 / 64
FINEST_SPACING = 1 / 2048
COARSEST_SPACING = 1 / 12

#: Largest distance that a network learns.
BAND = 0.02

#: Padding of the mesh's box, of which the field of a network is defined.
PADDING = 0.01

#: Finest resolution of a hash grid of 1 MiB.
FINEST = 256


def quantise(values: np.ndarray, band: float) -> np.ndarray:
    """Return the steps that hold ``values``, uint8; :func:`dequantise` is the reverse."""
    return np.clip(np.floor(values * (128 / band)) + 128, 0, 255).astype(np.uint8)


def dequantise(codes: np.ndarray, band: float) -> np.ndarray:
    """Return the distances in the middles of steps, float32."""
    return (codes.astype(np.float32) - np.float32(127.5)) * np.float32(band / 128)


def slope_bound(values: np.ndarray, spacing: float) -> float:
    """Return a bound of the gradient of trilinear interpolation in grids ``(…, X, Y, Z)`` of distances, at least 1."""
    total = 0.0
    for axis in (-3, -2, -1):
        steps = np.abs(np.diff(values, axis=axis))
        for other in {-3, -2, -1} - {axis}:
            first, second = (np.take(steps, range(i, steps.shape[other] - 1 + i), other) for i in (0, 1))
            steps = np.maximum(first, second)
        total = total + (steps.astype(np.float64) / spacing) ** 2
    return max(1.0, float(np.sqrt(np.max(total))))


class ByteGrid(DistanceField):
    """Dense grid of ``codes``, uint8 ``(X, Y, Z)``, the first of which is at ``lower``, interpolated trilinearly."""

    def __init__(self, types, codes: np.ndarray, lower, spacing: float, band: float):
        self.cells = tuple(n - 1 for n in codes.shape)
        upper = [a + n * spacing for a, n in zip(lower, self.cells, strict=True)]
        super().__init__(types, lower, upper, spacing, band)
        self.nodes, self.nbytes = types.UInt8(np.ascontiguousarray(codes.ravel())), codes.size
        self.file_bytes = len(zlib.compress(codes.tobytes(), 9))
        # Slabs of 32 cells that share their ends, to save memory
        slabs = (codes[i : i + 33] for i in range(0, codes.shape[0] - 1, 32))
        self.slope = max(slope_bound(dequantise(slab, band), spacing) for slab in slabs)

    def value(self, p, active=True):
        return self.gradient(p, active)[0]  # Dr.Jit leaves out what only the slope needs

    def gradient(self, p, active=True):
        active, Float = self.inside(p) & active, self.types.Float
        first, (_, ny, nz), place = 0, (n + 1 for n in self.cells), []
        for x, a, n, side in zip(p, self.lower, self.cells, (1, ny, nz), strict=True):
            t = clamp((x - a) / self.spacing, 0.0, float(n))
            i = dr.minimum(self.types.UInt32(dr.detach(t)), n - 1)
            first = first * side + i
            place.append(t - Float(i))
        offsets = [(a * ny + b) * nz + c for a in (0, 1) for b in (0, 1) for c in (0, 1)]
        codes = [Float(dr.gather(self.types.UInt8, self.nodes, first + offset, active)) for offset in offsets]
        slope = []
        for axis in (2, 1, 0):  # interpolate along z, then y, then x
            pairs = list(zip(codes[::2], codes[1::2], strict=True))
            slope = [[dr.lerp(a, b, place[axis]) for a, b in zip(s[::2], s[1::2], strict=True)] for s in slope]
            slope.append([b - a for a, b in pairs])
            codes = [dr.lerp(a, b, place[axis]) for a, b in pairs]
        step = self.band / 128
        slope = self.types.Array3f(*(s[0] for s in reversed(slope))) * (step / self.spacing)
        value = dr.fma(codes[0], step, -127.5 * step)
        return dr.select(active, value, self.band), dr.select(active, slope, 0)


def dense_grid(types, distances: Distances, spacing: float) -> ByteGrid:
    """Return a dense grid of this spacing around the mesh."""
    mesh = distances.mesh
    cells = _dense_cells(mesh, spacing)
    lower, band = (mesh.lower + mesh.upper) / 2 - cells * spacing / 2, NEAREST * spacing
    places = np.stack(np.meshgrid(*map(np.arange, cells + 1), indexing="ij"), -1).reshape(-1, 3)
    values = distances.signed(lower + places * spacing, 3 * spacing)
    return ByteGrid(types, quantise(values.reshape(cells + 1), band), lower, spacing, band)


def dense_spacing(mesh: Mesh, nbytes: int) -> float:
    """Return the spacing of the finest :func:`dense_grid` of ``nbytes``."""

    def fits(fineness: float) -> bool:
        return np.prod(_dense_cells(mesh, math.exp(-fineness)) + 1.0) <= nbytes

    return math.exp(-largest_fitting(fits, 0.0, math.log(1e4), steps=40))


def _dense_cells(mesh: Mesh, spacing: float) -> np.ndarray:
    return np.ceil((mesh.upper - mesh.lower) / spacing + 1).astype(int)


class DistanceNodes(SparseNodes):
    """Distances of 8 bits at the nodes of a sparse ``structure``: our layout without normals and indirection."""

    def __init__(self, types, structure: SparseGrid, codes: np.ndarray, band: float, slope: float):
        words = nodes.pointer_words(codes, 8)
        super().__init__(types, structure, slope, pointers=words, bits=8)
        self.codes, self.band_spacings = codes, band / self.spacing
        masks = (structure.regions, structure.region_masks, structure.region_signs, structure.block_masks,
                 structure.block_signs)  # fmt: skip
        self.file_bytes = sum(len(zlib.compress(array.tobytes(), 9)) for array in (codes, *masks))

    @property
    def nbytes(self) -> int:
        return self.structure.nbytes + 4 * dr.width(self._pointers)

    def _node(self, number, record, i, j, k, active):
        code = self.types.Float(nodes.pointer_at(self._pointers, number, 8, active))
        zero = self.types.Float(0)
        return (code - 127.5) * (self.band_spacings / 128), (zero, zero, zero)

    def normal(self, p, active=True):
        return self.gradient(p, active)[1]

    def decoded(self) -> np.ndarray:
        distances = dequantise(self.codes, self.band_spacings)
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


def distance_nodes(types, distances: Distances, spacing: float) -> DistanceNodes:
    """Return the corners of all cells that have corners of both signs, with their exact distances."""
    sampled, band = sample(distances, spacing), NEAREST * spacing
    codes = quantise(sampled.distances * spacing, band)
    corners = dequantise(codes, band)[sampled.corners].reshape(-1, 2, 2, 2)
    slope = max(slope_bound(part, spacing) for part in np.array_split(corners, max(1, corners.size // 2**21)))
    return DistanceNodes(types, sampled.structure, codes, band, slope)


def sparse_nodes(types, distances: Distances, nbytes: int) -> DistanceNodes:
    """Return the finest :func:`distance_nodes` of ``nbytes``; raises :class:`.BudgetError` if none fits."""

    def following(spacing: float, field: DistanceNodes) -> float:
        return float(np.clip(spacing * math.sqrt(field.nbytes / (0.985 * nbytes)), FINEST_SPACING, COARSEST_SPACING))

    budget = Budget(nbytes, 0.03)
    return budget.approach(lambda spacing: distance_nodes(types, distances, spacing), FIRST_SPACING, following)


# -- Hash grid and network ---------------------------------------------------------------------------------------------


def network(nbytes: int) -> Network:
    """Return the largest network with hash grid of ``nbytes``, not yet allocated; raises as :func:`.hash_grid`."""
    return Network(3, WIDTH, LAYERS, hash_grid(3, nbytes, FINEST * math.sqrt(nbytes / 2**20), 1))


class HashDistanceField(DistanceField):
    """Field of a trained ``net`` with distances divided by :data:`BAND`; no bound of its slope is known."""

    def __init__(self, types, net: Network, mesh: Mesh):
        finest = net.grid["base_resolution"] * net.grid["per_level_scale"] ** (net.grid["n_levels"] - 1)
        super().__init__(types, mesh.lower - PADDING, mesh.upper + PADDING, 1 / finest, BAND)
        self.net, self.nbytes = net, 2 * net.parameters
        self.file_bytes = self.nbytes

    def value(self, p, active=True):
        active = self.inside(p) & active
        value = self.net([x - a for x, a in zip(p, self.lower, strict=True)])[0] * BAND
        return dr.select(active, dr.clip(value, -BAND, BAND), BAND)

    def gradient(self, p, active=True):
        active = self.inside(p) & active
        with dr.resume_grad():
            q = self.types.Array3f(dr.detach(p))
            dr.enable_grad(q)
            value = self.net([x - a for x, a in zip(q, self.lower, strict=True)])[0] * BAND
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
