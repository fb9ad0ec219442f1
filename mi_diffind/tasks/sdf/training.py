"""Training of task 6: nodes against the surface itself, dense arrays against distances around it."""

from __future__ import annotations

import drjit as dr
import numpy as np
from drjit import nn

from ...fitting import Problem
from ...indirection import rounded
from . import samples
from .distances import Distances
from .encoding import Coding
from .mesh import Mesh
from .nodes import SparseNodes
from .paper import PairField

#: Weights of the distance (in spacings), of the field's gradient and of the blended normals of nodes.
DISTANCE, GRADIENT, SMOOTH = 0.3, 0.05, 0.02

#: Distances below which errors count by their squares, in spacings.
ROUND = 0.01

#: When, in shares of the training, how many of the nodes have got their codes.
COMMITTED = ((0.6, 0.5), (0.8, 0.8))

#: Points at which a state is looked at on the way.
HELD_OUT = 2**16


class Surface:
    """Points of a mesh and their normals, uniform over the area, drawn where the training runs."""

    def __init__(self, mesh: Mesh, types):
        self.types, self.count = types, len(mesh.faces)

        def flat(v):
            return types.Float(np.ascontiguousarray(v.reshape(-1), np.float32))

        corners = mesh.corners
        self.sums = flat(np.cumsum(mesh.areas) / mesh.areas.sum())
        self.corner, self.first, self.second = (
            flat(corners[:, 0]),
            flat(corners[:, 1] - corners[:, 0]),
            flat(corners[:, 2] - corners[:, 0]),
        )
        self.normals = flat(mesh.normals)

    def draw(self, rng, size: int):
        """``(Array3f, Array3f)``: points, one in each of ``size`` equal parts of the area, and normals."""
        Float, Array3f = self.types.Float, self.types.Array3f
        place = (Float(dr.arange(self.types.UInt32, size)) + rng.random(Float, size)) / size
        which = dr.binary_search(0, self.count - 1, lambda i: dr.gather(Float, self.sums, i) < place)
        u, v = rng.random(Float, size), rng.random(Float, size)
        beyond = u + v > 1
        u, v = dr.select(beyond, 1 - u, u), dr.select(beyond, 1 - v, v)
        corner, first, second, normal = (
            dr.gather(Array3f, a, which) for a in (self.corner, self.first, self.second, self.normals)
        )
        return corner + u * first + v * second, normal


class NodeValues(nn.Module):
    """The nodes of a sparse grid as they are trained: ``values`` (n, 4), distances in spacings and normals."""

    DRJIT_STRUCT = {"values": dr.ArrayBase}  # noqa: RUF012

    def __init__(self, values=None):
        self.values = values

    def unit(self, types):
        """The same with normals of length 1."""
        d, x, y, z = dr.unravel(types.Array4f, self.values.array)
        inverse = dr.rsqrt(dr.maximum(x * x + y * y + z * z, 1e-12))
        return types.TensorXf(dr.ravel(types.Array4f(d, x * inverse, y * inverse, z * inverse)), self.values.shape)


class NodeProblem(Problem):
    """
    The field is to be zero on the surface and its gradient the surface's normal, both where it is read and as nodes
    blend it. Distances are not needed: the nodes begin with theirs.

    On the way, nodes get their codes, half of them and then more (:class:`.encoding.Coding`): from then on they are
    what their pointers say.
    """

    #: The last state is the one to keep: earlier ones are better only because less of them is rounded.
    tolerance = 1.0

    def __init__(self, field: SparseNodes, mesh: Mesh, coding: Coding, held_out):
        self.field, self.types, self.coding, self.held_out = field, field.types, coding, held_out
        self.surface = Surface(mesh, self.types)
        at = coding.sampled
        start = np.concatenate([at.distances[:, None], at.normals], axis=1)
        self.net = NodeValues(self.types.TensorXf(np.ascontiguousarray(start, np.float32)))
        self.identity = {"source": mesh.digest, "nodes": len(start), "spacing": field.spacing, "bits": coding.bits}
        self.stage, self._fixed = 0, None

    def begin(self, step: int, share: float) -> str:
        while self.stage < len(COMMITTED) and share >= COMMITTED[self.stage][0]:
            values = dr.detach(self.nodes(self.net)).numpy().astype(np.float64)
            self.coding.commit(values, COMMITTED[self.stage][1])
            self._fix()
            self.stage += 1
        return f"stage {self.stage}"

    def _fix(self) -> None:
        done = np.repeat(self.coding.done[:, None], 4, axis=1).astype(np.float32)
        self._fixed = self.types.TensorXf(done), self.types.TensorXf(self.coding.values())

    def kept(self) -> dict[str, np.ndarray]:
        return {"stage": np.int64(self.stage), **self.coding.state()}

    def restore(self, kept: dict[str, np.ndarray]) -> None:
        self.stage = int(kept.pop("stage", 0))
        self.coding.restore(kept)
        self._fixed = None
        if self.stage:
            self._fix()

    def nodes(self, net):
        """The nodes as they are read: those without codes as they are trained."""
        values = net.unit(self.types)
        if self._fixed is None:
            return values
        done, fixed = self._fixed
        return dr.fma(done, fixed - values, values)

    def loss(self, net, rng, size: int):
        p, n = self.surface.draw(rng, size)
        self.field.nodes = self.nodes(net)
        value, slope, smooth, complete = self.field.blend(p)
        Array3f = self.types.Array3f
        square = dr.square(value)
        error = DISTANCE * (dr.sqrt(square + ROUND**2) if self.settings.loss == "mae" else 10 * square)
        error += GRADIENT * dr.squared_norm(Array3f(*slope) - n) + SMOOTH * dr.squared_norm(Array3f(*smooth) - n)
        return dr.select(complete, error, 0) / size

    def measure(self, net):
        with dr.suspend_grad():
            self.field.nodes = dr.detach(self.nodes(net))
            return self.held_out.measure(self.field)


class PairProblem(Problem):
    """The supplement's: truncated distances, mostly near the surface, in units of the band."""

    def __init__(self, field: PairField, mesh: Mesh, points: np.ndarray, distances: np.ndarray, held_out):
        self.field, self.types, self.net = field, field.types, field.net

        def flat(v):
            return self.types.Float(np.ascontiguousarray(v, np.float32))

        self.points = [flat(v) for v in points.T]
        self.targets = flat(np.clip(distances / field.band, -1, 1) / 2 + 0.5)
        self.identity = {"source": mesh.digest, "resolution": list(self.net.primary[0].resolution)}
        self.held_out = held_out

    def batch(self, rng, size: int):
        Float, UInt32 = self.types.Float, self.types.UInt32
        count = dr.width(self.targets)
        which = dr.minimum(UInt32(rng.random(Float, size) * count), count - 1)
        return [dr.gather(Float, v, which) for v in self.points], {"d": [dr.gather(Float, self.targets, which)]}

    def predict(self, net, inputs):
        return {"d": rounded(net)(inputs)}

    def measure(self, net):
        with dr.suspend_grad():
            self.field.net = rounded(net)
            found = self.held_out.measure(self.field)
            self.field.net = net
            return found


class HeldOut:
    """Points near the surface, their signs, and points on it with normals: for a look at a state during training."""

    def __init__(self, distances: Distances, types, width: float, seed: int = 3):
        self.types, mesh = types, distances.surface
        near = samples.near(mesh, HELD_OUT, width, seed).astype(np.float32)
        self.inside = distances.inside(near)
        points, self.normals = samples.surface(mesh, HELD_OUT, seed + 1)
        self.near, self.points = (types.Array3f(*np.ascontiguousarray(v.T, np.float32)) for v in (near, points))

    def measure(self, field) -> dict[str, float]:
        """``agree``: share of points within about a spacing of the surface whose side is right; ``normal_deg``."""
        found = field.value(self.near).numpy() < 0
        slope = field.gradient(self.points)[1].numpy().T
        length = np.maximum(np.linalg.norm(slope, axis=1), 1e-12)
        cosine = np.clip(np.sum(slope * self.normals, axis=1) / length, -1, 1)
        return {
            "agree": float(np.mean(found == self.inside)),
            "normal_deg": float(np.degrees(np.arccos(cosine)).mean()),
        }
