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
from ...arrays.indirection import device_array
from ...arrays.lookup import clamp
from ...core.units import largest_fitting
from ...fitting.loop import Problem
from ...maps.pyramid import decibel
from ...tasks.sdf.distances import Distances, sample_box, sample_near
from ...tasks.sdf.encoding import SampledNodes, fit_frames, sample
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.mesh import Mesh
from ...tasks.sdf.nodes import SparseNodes, pointer_at, pointer_words
from ...tasks.sdf.paper import edge_steps
from .networks import LAYERS, WIDTH, Network, hash_grid

#: Largest distance, in cells, between the surface and a corner of a cell that the surface crosses.
NEAREST = 1.75

#: Spacing, of the longest side, that :func:`finest_distance_nodes` tries first, and its limits.
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
    """Return a bound of the gradient of trilinear interpolation in grids ``(X, Y, Z, …)`` of distances, at least 1."""
    square = sum((edge_steps(values, axis).astype(np.float64) / spacing) ** 2 for axis in range(3))
    return max(1.0, float(np.sqrt(np.max(square))))


class LimitedField(DistanceField):
    """Base class of fields that limit a ``distance`` to ± ``band``; the gradient is the derivative of the distance."""

    def distance(self, p, active):
        """Return the distance at points of the box."""
        raise NotImplementedError

    def value(self, p, active=True):
        active = self.inside(p) & active
        return dr.select(active, dr.clip(self.distance(p, active), -self.band, self.band), self.band)

    def gradient(self, p, active=True):
        active = self.inside(p) & active
        with dr.resume_grad():
            q = self.types.Array3f(dr.detach(p))
            dr.enable_grad(q)
            distance = self.distance(q, active)
            dr.backward(distance)
            slope = dr.detach(dr.grad(q))
        value = dr.clip(dr.detach(distance), -self.band, self.band)
        return dr.select(active, value, self.band), dr.select(active, slope, 0)


class ByteGrid(LimitedField):
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

    def distance(self, p, active):
        Float, first, (_, ny, nz), place = self.types.Float, 0, (n + 1 for n in self.cells), []
        for x, a, n, side in zip(p, self.lower, self.cells, (1, ny, nz), strict=True):
            t = clamp((x - a) / self.spacing, 0.0, float(n))
            i = dr.minimum(self.types.UInt32(dr.detach(t)), n - 1)
            first = first * side + i
            place.append(t - Float(i))
        offsets = [(a * ny + b) * nz + c for a in (0, 1) for b in (0, 1) for c in (0, 1)]
        codes = [Float(dr.gather(self.types.UInt8, self.nodes, first + offset, active)) for offset in offsets]
        for t in reversed(place):  # interpolate along z, then y, then x
            codes = [dr.lerp(a, b, t) for a, b in zip(codes[::2], codes[1::2], strict=True)]
        step = self.band / 128
        return dr.fma(codes[0], step, -127.5 * step)


def dense_grid(types, distances: Distances, spacing: float) -> ByteGrid:
    """Return a dense grid of this spacing around the mesh."""
    mesh = distances.mesh
    cells = _dense_cells(mesh, spacing)
    lower, band = (mesh.lower + mesh.upper) / 2 - cells * spacing / 2, NEAREST * spacing
    places = np.stack(np.meshgrid(*map(np.arange, cells + 1), indexing="ij"), -1).reshape(-1, 3)
    values = distances.signed(lower + places * spacing, 3 * spacing)
    return ByteGrid(types, quantise(values.reshape(cells + 1), band), lower, spacing, band)


def finest_dense_grid(types, distances: Distances, nbytes: int) -> ByteGrid:
    """Return the finest :func:`dense_grid` of ``nbytes``."""

    def fits(fineness: float) -> bool:
        return np.prod(_dense_cells(distances.mesh, math.exp(-fineness)) + 1.0) <= nbytes

    return dense_grid(types, distances, math.exp(-largest_fitting(fits, 0.0, math.log(1e4), steps=40)))


def _dense_cells(mesh: Mesh, spacing: float) -> np.ndarray:
    return np.ceil((mesh.upper - mesh.lower) / spacing + 1).astype(int)


class DistanceNodes(SparseNodes):
    """Distances of 8 bits at the ``sampled`` nodes, in 256 steps: our layout without normals and indirection."""

    def __init__(self, types, sampled: SampledNodes):
        structure = sampled.structure
        self.codes = quantise(sampled.distances, NEAREST)
        corners = np.moveaxis(dequantise(self.codes, NEAREST)[sampled.corners].reshape(-1, 2, 2, 2), 0, -1)
        super().__init__(types, structure, slope_bound(corners, 1.0), pointers=pointer_words(self.codes, 8), bits=8)
        self._frames = fit_frames(sampled)  # the rays' index bounds the distance of the surface from their planes
        masks = (structure.regions, structure.region_masks, structure.region_signs, structure.block_masks,
                 structure.block_signs)  # fmt: skip
        self.file_bytes = sum(len(zlib.compress(array.tobytes(), 9)) for array in (self.codes, *masks))

    @property
    def nbytes(self) -> int:
        return self.structure.nbytes + 4 * dr.width(self._pointers)

    def _node(self, number, record, i, j, k, active):
        code = self.types.Float(pointer_at(self._pointers, number, 8, active))
        zero = self.types.Float(0)
        return (code - 127.5) * (NEAREST / 128), (zero, zero, zero)

    def normal(self, p, active=True):
        return self.gradient(p, active)[1]

    def decoded(self) -> np.ndarray:
        return np.pad(dequantise(self.codes, NEAREST)[:, None], ((0, 0), (0, 3)))

    def frames(self) -> np.ndarray:
        return self._frames


def distance_nodes(types, distances: Distances, spacing: float) -> DistanceNodes:
    """Return the corners of all cells that have corners of both signs, with their exact distances."""
    return DistanceNodes(types, sample(distances, spacing))


def finest_distance_nodes(types, distances: Distances, nbytes: int) -> DistanceNodes:
    """Return the finest :func:`distance_nodes` of ``nbytes``; raises :class:`.BudgetError` if none fits."""

    def following(spacing: float, field: DistanceNodes) -> float:
        return float(np.clip(spacing * math.sqrt(field.nbytes / (0.985 * nbytes)), FINEST_SPACING, COARSEST_SPACING))

    budget = Budget(nbytes, 0.03)
    return budget.approach(lambda spacing: distance_nodes(types, distances, spacing), FIRST_SPACING, following)


# -- Hash grid and network ---------------------------------------------------------------------------------------------


def network(nbytes: int) -> Network:
    """Return the largest network with hash grid of ``nbytes``, not yet allocated; raises as :func:`.hash_grid`."""
    return Network(3, WIDTH, LAYERS, hash_grid(3, nbytes, FINEST * math.sqrt(nbytes / 2**20), 1))


class HashDistanceField(LimitedField):
    """Field of a trained ``net`` with distances divided by :data:`BAND`; no bound of its slope is known."""

    def __init__(self, types, net: Network, mesh: Mesh):
        finest = net.grid["base_resolution"] * net.grid["per_level_scale"] ** (net.grid["n_levels"] - 1)
        super().__init__(types, mesh.lower - PADDING, mesh.upper + PADDING, 1 / finest, BAND)
        self.net, self.nbytes = net, 2 * net.parameters

    def distance(self, p, active):
        return self.outputs(self.net, p)[0] * BAND

    def outputs(self, net: Network, p) -> list:
        """Return the output of a network at points, in a list."""
        return net([x - a for x, a in zip(p, self.lower, strict=True)])

    def safe_step(self, p, d, active=True):
        raise NotImplementedError("no bound of the slope of a network is known")


class HashProblem(Problem):
    """Training of a :class:`Network` on a ``pool`` of points with distances, measured on another (:func:`pool`)."""

    def __init__(self, net: Network, types, mesh: Mesh, pool: tuple, held: tuple):
        self.net, self.types = net.alloc(types.TensorXf, 3, dr.rng(seed=1)), types
        self.field = HashDistanceField(types, self.net, mesh)
        self.pool, self.held = (
            [device_array(types.Float, v) for v in (*points.T, np.clip(distances / BAND, -1, 1))]
            for points, distances in (pool, held)
        )
        self.identity = {"mesh": mesh.digest, "count": len(pool[1]), "seed": 1}

    def batch(self, rng, size: int):
        count = dr.width(self.pool)
        index = dr.minimum(self.types.UInt32(rng.random(self.types.Float, size) * count), count - 1)
        *p, d = (dr.gather(self.types.Float, v, index) for v in self.pool)
        return p, {"d": [d]}

    def predict(self, net, inputs) -> dict[str, list]:
        return {"d": self.field.outputs(net, inputs)}

    def measure(self, net) -> dict[str, float]:
        *p, d = self.held
        error = dr.clip(self.field.outputs(net, p)[0], -1, 1) - d
        return {"psnr_db": decibel(float(dr.mean(dr.square(error))[0]))}


def pool(distances: Distances, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` points in the padded box of the mesh and their distances, ``(count, 3)`` and ``(count,)``.

    Three quarters are near the surface (normal distributions of 0.002 and 0.01), the others uniform.
    """
    rng, mesh = np.random.default_rng(seed), distances.mesh
    lower, upper = mesh.lower - PADDING, mesh.upper + PADDING
    near = [sample_near(mesh, 3 * count // 8, width, rng) for width in (0.002, 0.01)]
    rest = sample_box(lower, upper, count - sum(map(len, near)), rng)
    points = np.clip(np.concatenate([*near, rest]), lower, upper)[rng.permutation(count)].astype(np.float32)
    return points, distances.signed(points, 2 * BAND)
