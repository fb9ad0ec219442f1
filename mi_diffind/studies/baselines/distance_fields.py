"""Rivals of distance fields in equal bytes: dense and sparse grids of 8 bits, and a hash grid with a network.

Everything is in the unit frame of :mod:`mi_diffind.tasks.sdf.field`. Grids hold exact distances in 256 equal steps
between ± ``band``; no step has its middle at zero, so no sign is lost. Bytes are those of all that a read needs: nodes
and index.
"""

import math

import drjit as dr
import numpy as np

from ...arrays.budget import Budget
from ...arrays.lookup import corners, read_floats
from ...fitting.loop import Problem
from ...tasks.sdf.distances import Distances
from ...tasks.sdf.encoding import SampledNodes, fit_frames, sample
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.fit import COARSEST_SPACING, FINEST_SPACING, FIRST_SPACING
from ...tasks.sdf.mesh import Mesh
from ...tasks.sdf.nodes import SparseNodes, pointer_at, pointer_words
from ...tasks.sdf.paper import PairProblem, edge_steps
from .networks import LAYERS, WIDTH, Network, hash_grid

#: Largest distance, in cells, between the surface and a corner of a cell that the surface crosses.
NEAREST = 1.75

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
        self.shape, self.nbytes = codes.shape, codes.size
        super().__init__(types, lower, lower + spacing * (np.array(codes.shape) - 1), spacing, band)
        self.nodes = types.UInt8(np.ascontiguousarray(codes.ravel()))
        self.slope = slope_bound(dequantise(codes, band), spacing)

    def distance(self, p, active):
        place = [(x - a) / (b - a) for x, a, b in zip(p, self.lower, self.upper, strict=True)]
        (code,) = read_floats(self.nodes, 1, 1, corners(place, self.shape, ("clamp",) * 3), active)
        return (code - 127.5) * (self.band / 128)


def dense_shape(mesh: Mesh, spacing: float) -> np.ndarray:
    """Return the nodes along the axes of a dense grid around a mesh, half a cell or more away from it."""
    return np.ceil((mesh.upper - mesh.lower) / spacing + 2).astype(int)


def dense_grid(types, distances: Distances, spacing: float) -> ByteGrid:
    """Return a dense grid of this spacing around the mesh."""
    mesh, band = distances.mesh, NEAREST * spacing
    shape = dense_shape(mesh, spacing)
    lower = (mesh.lower + mesh.upper - (shape - 1) * spacing) / 2
    places = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    values = distances.signed(lower + places * spacing, 3 * spacing)
    return ByteGrid(types, quantise(values.reshape(shape), band), lower, spacing, band)


def finest_dense_grid(types, distances: Distances, nbytes: int) -> ByteGrid:
    """Return the finest :func:`dense_grid` of ``nbytes``; raises :class:`.BudgetError` if none fits."""
    cells = Budget(nbytes).largest(lambda n: np.prod(dense_shape(distances.mesh, 1 / n)), range(4, 4096))
    return dense_grid(types, distances, 1 / cells)


class DistanceNodes(SparseNodes):
    """Distances of 8 bits at the ``sampled`` nodes, in 256 steps: our layout without normals and indirection."""

    def __init__(self, types, sampled: SampledNodes):
        structure = sampled.structure
        self.codes = quantise(sampled.distances, NEAREST)
        corners = np.moveaxis(dequantise(self.codes, NEAREST)[sampled.corners].reshape(-1, 2, 2, 2), 0, -1)
        super().__init__(types, structure, slope_bound(corners, 1.0), pointers=pointer_words(self.codes, 8), bits=8)
        self._frames = fit_frames(sampled)  # the rays' index bounds the distance of the surface from their planes

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

    return Budget(nbytes, 0.03).approach(
        lambda spacing: distance_nodes(types, distances, spacing), FIRST_SPACING, following
    )


# -- Hash grid and network ---------------------------------------------------------------------------------------------


def network(nbytes: int) -> Network:
    """Return the largest network with hash grid of ``nbytes``, not yet allocated; raises as :func:`.hash_grid`."""
    return Network(3, WIDTH, LAYERS, hash_grid(3, nbytes, FINEST * math.sqrt(nbytes / 2**20), 1))


class HashDistanceField(LimitedField):
    """Field of a trained ``net`` in the box of a ``frame``; no bound of its slope is known.

    The outputs of the network stand for distances as those of arrays do (:class:`.PairField`).
    """

    def __init__(self, net: Network, frame: DistanceField):
        finest = net.grid["base_resolution"] * net.grid["per_level_scale"] ** (net.grid["n_levels"] - 1)
        super().__init__(frame.types, frame.lower, frame.upper, 1 / finest, frame.band)
        self.net, self.nbytes = net, 2 * net.parameters

    def distance(self, p, active):
        place = [(x - a) / (b - a) for x, a, b in zip(p, self.lower, self.upper, strict=True)]
        return dr.fma(self.net(place)[0], 2 * self.band, -self.band)

    def safe_step(self, p, d, active=True):
        raise NotImplementedError("no bound of the slope of a network is known")


class HashProblem(Problem):
    """Training of the largest :func:`network` of ``nbytes`` on the ``samples`` of a training of arrays."""

    def __init__(self, samples: PairProblem, nbytes: int):
        self.samples, self.batch, self.identity = samples, samples.batch, samples.identity
        self.net = network(nbytes).alloc(samples.types.TensorXf, 3, dr.rng(seed=1))

    def predict(self, net, inputs) -> dict[str, list]:
        return {"d": net(inputs)}

    def measure(self, net) -> dict[str, float]:
        """Return the share of held-out points near the surface whose sign is wrong, in decibels."""
        held_out = self.samples.held_out
        with dr.suspend_grad():
            inside = HashDistanceField(net, self.samples.field).value(held_out.near).numpy() < 0
        return {"agree_db": -10 * math.log10(max(np.mean(inside != held_out.inside), 1e-6))}
