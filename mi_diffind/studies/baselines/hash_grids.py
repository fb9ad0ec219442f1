"""Signed distance fields of a hash grid and a network (``drjit.nn``).

Source: Müller et al., *Instant Neural Graphics Primitives with a Multiresolution Hash Encoding*, 2022.
"""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from ...core.units import largest_fitting
from ...fitting.loop import Problem
from ...tasks.sdf.distances import Distances, sample_box, sample_near
from ...tasks.sdf.field import DistanceField
from ...tasks.sdf.mesh import Mesh
from .networks import Network

#: Largest distance that is learned.
BAND = 0.02

#: Padding of the mesh's box, of which the field is defined.
PADDING = 0.01

#: Width and hidden layers of the network, levels of the grid, its coarsest resolution, and the finest one in 1 MiB.
WIDTH, LAYERS, LEVELS, COARSEST, FINEST = 32, 2, 8, 8, 256


def network(nbytes: int) -> Network:
    """Return the largest network with hash grid of ``nbytes``, 2 bytes a parameter, not yet allocated."""
    finest = max(2 * COARSEST, FINEST * math.sqrt(nbytes / 2**20))
    scale = (finest / COARSEST) ** (1 / (LEVELS - 1))
    features = 2
    weights = features * LEVELS * WIDTH + (LAYERS - 1) * WIDTH**2 + WIDTH + LAYERS * WIDTH + 1
    resolutions = [math.ceil(COARSEST * scale**level) for level in range(LEVELS)]
    sizes = [int(2**power) // 16 * 16 for power in np.arange(8, 24, 0.05)]

    def fits(index: int) -> bool:
        entries = sum(min(sizes[index], (n + 1) ** 3) for n in resolutions)
        return 2 * (features * entries + weights) <= nbytes

    largest = largest_fitting(fits, -1, len(sizes))
    if largest < 0:
        raise ValueError(f"{nbytes:,} bytes are too few for a hash grid of {LEVELS} levels")
    grid = {"n_levels": LEVELS, "n_features_per_level": features, "hashmap_size": sizes[largest],
            "base_resolution": COARSEST, "per_level_scale": scale,
            "align_corners": True, "init_scale": 1e-4}  # fmt: skip
    return Network(3, WIDTH, LAYERS, grid)


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


def halved(net: Network) -> None:
    """Round all parameters to half precision, in which they are stored."""
    for key in net:
        value = net[key].numpy().astype(np.float16).astype(np.float32)
        net[key] = type(net[key])(value)


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
        return {"psnr_db": -10 * math.log10(max(float(dr.mean(dr.square(error))[0]), 1e-12))}


def pool(distances: Distances, lower, upper, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` points in a box and their distances, ``(count, 3)`` and ``(count,)``.

    Three quarters are near the surface (normal distributions of 0.002 and 0.01), the others uniform.
    """
    rng = np.random.default_rng(seed)
    near = [sample_near(distances.mesh, 3 * count // 8, width, rng) for width in (0.002, 0.01)]
    rest = sample_box(lower, upper, count - sum(map(len, near)), rng)
    points = np.clip(np.concatenate([*near, rest]), lower, upper)[rng.permutation(count)].astype(np.float32)
    return points, distances.signed(points, 2 * BAND)
