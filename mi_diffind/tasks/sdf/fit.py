"""Training of distance fields (``fit sdf``): from a mesh and a number of bytes to a table file."""

import sys
import time

import drjit as dr
import numpy as np

from ...arrays.budget import Budget, BudgetError
from ...arrays.indirection import device_array, device_tensor
from ...arrays.tables import MAX_BYTES, Table
from ...core import units
from ...core.errors import UsageError, raised_as
from ...fitting.loop import Problem
from ...fitting.task import FitRequest, Fitted, FittingError
from . import TASK, encoding
from .distances import Distances
from .evaluation import HELD_OUT, HeldOut, SurfaceEvaluation, lost_pieces
from .mesh import Mesh, load_mesh
from .model import build_field, coded_arrays
from .nodes import POINTERS, SparseNodes
from .paper import SAMPLES, STARTS, PairProblem, ratio_for, resolutions

#: Default size in memory, in bytes.
BYTES = 2**20

#: Bytes of samples of the nodes during the training for each byte of the field, roughly.
SAMPLE_BYTES = 64

#: First spacing in the search for a grid's size, relative to the longest side.
FIRST_SPACING = 1 / 64

#: Smallest spacing in that search.
FINEST_SPACING = 1 / 2048

#: Largest spacing in that search.
COARSEST_SPACING = 1 / 8

#: Share by which a sparse field may be smaller than requested.
TOLERANCE = 0.02

#: Least bytes of masks and frames for a cell that the surface passes through.
BYTES_PER_CELL = 1

#: Least bytes of pointers for such a cell, times the pointers in a word.
WORDS_PER_CELL = 6

#: Held-out points of the final measurement.
MEASURED = 2**18

#: Share of the surface's cells without a change of sign above which a warning is printed.
MISSED_CELLS = 0.3

#: Weight of the distance, in spacings, in the loss.
DISTANCE_WEIGHT = 0.3

#: Weight of the field's gradient in the loss.
GRADIENT_WEIGHT = 0.05

#: Weight of the blended normals of nodes in the loss.
SMOOTH_WEIGHT = 0.02

#: Distance, in spacings, below which errors are weighted by their squares.
ROUNDED_DISTANCE = 0.01


class SurfaceSampler:
    """Points of a mesh and their normals, uniform over the area, drawn on the device of the training."""

    def __init__(self, mesh: Mesh, types):
        self.types, self.count = types, len(mesh.faces)

        def flat(v):
            return device_array(types.Float, v)

        corners = mesh.corners
        self.sums = flat(np.cumsum(mesh.areas) / mesh.areas.sum())
        edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        self.triangles = [flat(v) for v in (corners[:, 0], *edges, mesh.normals)]

    def draw(self, rng, size: int):
        """Return points, one in each of ``size`` equal parts of the area, and normals: ``(Array3f, Array3f)``."""
        Float, Array3f = self.types.Float, self.types.Array3f
        place = (Float(dr.arange(self.types.UInt32, size)) + rng.random(Float, size)) / size
        index = dr.binary_search(0, self.count - 1, lambda i: dr.gather(Float, self.sums, i) < place)
        u, v = rng.random(Float, size), rng.random(Float, size)
        beyond = u + v > 1
        u, v = dr.select(beyond, 1 - u, u), dr.select(beyond, 1 - v, v)
        corner, first, second, normal = (dr.gather(Array3f, a, index) for a in self.triangles)
        return corner + u * first + v * second, normal


class NodeProblem(Problem):
    """Training of a sparse grid's nodes against the surface itself.

    The nodes are ``values`` (n, 4): distances in spacings, and normals of any length.

    The field is to be zero on the surface, and its gradient and its smooth normal are to be the surface's normal.
    Distances elsewhere are not needed, since the nodes begin with theirs.
    """

    #: The last state is kept: rounding differs from state to state by more than the training still changes.
    tolerance = 1.0

    def __init__(self, sampled: encoding.SampledNodes, mesh: Mesh, types, held_out: HeldOut):
        self.sampled, self.types, self.held_out = sampled, types, held_out
        self.field, self.surface = SparseNodes(types, sampled.structure, 1.0), SurfaceSampler(mesh, types)
        start = np.concatenate([sampled.distances[:, None], sampled.normals], axis=1)
        self.net = {"values": device_tensor(types.TensorXf, start)}
        self.identity = {"source": mesh.digest, "nodes": len(start), "spacing": self.field.spacing}
        self.identity["bits"] = sampled.bits

    def nodes(self, net):
        """Return the nodes with normals of length 1."""
        values, Array4f = net["values"], self.types.Array4f
        d, x, y, z = dr.unravel(Array4f, values.array)
        inverse = dr.rsqrt(dr.maximum(x * x + y * y + z * z, 1e-12))
        return type(values)(dr.ravel(Array4f(d, x * inverse, y * inverse, z * inverse)), values.shape)

    def loss(self, net, rng, size: int):
        p, n = self.surface.draw(rng, size)
        self.field.nodes = self.nodes(net)
        value, slope, smooth, complete = self.field.blend(p)
        Array3f = self.types.Array3f
        square = dr.square(value)
        error = DISTANCE_WEIGHT * (
            dr.sqrt(square + ROUNDED_DISTANCE**2) if self.settings.loss == "mae" else 10 * square
        )
        error += GRADIENT_WEIGHT * dr.squared_norm(Array3f(*slope) - n) + SMOOTH_WEIGHT * dr.squared_norm(
            Array3f(*smooth) - n
        )
        return dr.select(complete, error, 0) / size

    def measure(self, net):
        with dr.suspend_grad():
            self.field.nodes = dr.detach(self.nodes(net))
            return self.held_out.measure(self.field)

    def table(self, seed: int) -> Table:
        """Return the coded nodes as a file holds them."""
        coding = encoding.NodeCoding(self.sampled, seed)
        coding.encode(self.nodes(self.net).numpy().astype(np.float64))
        arrays, settings = coded_arrays(coding)
        return Table("sdf", arrays, settings=settings)


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that exclude each other."""
    options, preset = request.options, request.preset
    if options["source"] is None:
        raise UsageError("source: not given, a mesh is needed")
    requested_bytes(options)
    if options["constant"] and preset != "paper":
        raise UsageError(f"--constant: found the preset {preset}, allowed is paper")
    if options["ratio"] is not None and preset == "sparse":
        raise UsageError(f"--ratio: found the preset {preset}, allowed are dense and paper")


def requested_bytes(options) -> int:
    """Return the size from the command's options. Raises :class:`UsageError`."""
    nbytes = options["bytes"] or BYTES
    units.check_size("--bytes", nbytes, MAX_BYTES)
    units.check_memory("--bytes", nbytes, SAMPLE_BYTES * nbytes)
    return nbytes


def fit(request: FitRequest, measured: int = MEASURED, samples: int = SAMPLES, held_out: int = HELD_OUT) -> Fitted:
    """Fit the mesh that the request names.

    ``measured`` and ``held_out`` are the numbers of points at which the result and states on the way are measured,
    ``samples`` the number of training samples of dense arrays. Raises :class:`UsageError`, :class:`.mesh.MeshError`,
    :class:`.distances.DistancesError` and :class:`.FittingError`.
    """
    options, seed = request.options, request.settings.seed
    mesh, nbytes = load_mesh(options["source"]), requested_bytes(options)
    start, lines = time.perf_counter(), []
    with Distances(mesh) as distances:
        warnings = [*mesh.warnings, *distances.warnings]
        for warning in warnings:
            print(f"warning: {warning}", file=sys.stderr)
        evaluation = SurfaceEvaluation(mesh, distances, measured)
        if request.preset == "sparse":
            sampled = search_grid(distances, nbytes, options["bits"])
            spacing = sampled.structure.spacing
            if sampled.missed > MISSED_CELLS:
                lines.append(
                    f"{100 * sampled.missed:.0f}% of the cells that the surface comes through or near to show no "
                    f"change of sign: parts may be thinner than a cell, 1/{1 / spacing:.0f} of the longest side: more "
                    f"--bytes help"
                )
            held = HeldOut(distances, request.types, spacing, count=held_out)
            problem = NodeProblem(sampled, distances.surface, request.types, held)
        else:
            start_from = "constant" if options["constant"] else STARTS[request.preset]
            shapes = resolutions(nbytes, options["ratio"] or ratio_for(nbytes), mesh.upper - mesh.lower)
            problem = PairProblem(distances, shapes, start_from, request.types, seed, samples, held_out)

        def measure() -> tuple[Table, dict[str, float], int]:
            table = problem.table(seed)
            field = build_field(table, TASK.allocate(table, request.types.TensorXf), request.types)
            return table, evaluation.measure(field), lost_pieces(field, distances)

        result = request.train(problem, finish=measure)
        prepared = time.perf_counter() - start - result.seconds
        table, errors, lost = measure()
    if lost:
        count = distances.surface.components
        lines.append(f"{lost} of {count} pieces of the mesh are too small for the field: more --bytes help")
    table.preset, table.seed = request.preset, seed
    table.settings = {
        **request.recorded(result),
        "source": mesh.digest,
        **request.paths(mesh_path=options["source"]),
        "scale": mesh.scale,
        "centre": list(mesh.centre),
        "warnings": warnings,
        **table.settings,
    }
    table.measured = {k: float(f"{v:.6g}") for k, v in errors.items()}
    triangles = 12 * (len(mesh.vertices) + len(mesh.faces))
    lines.append(f"{prepared:.1f} s for distances and samples, {result.seconds:.1f} s of training")
    lines.append(f"the mesh itself has {len(mesh.faces):,} triangles, {triangles:,} bytes of positions and indices")
    figures = {"bytes_asked": nbytes, "mesh_bytes": triangles, "prepared_seconds": prepared, "warnings": warnings}
    return Fitted(table, result, lines, {**figures, "lost_pieces": lost})


def search_grid(distances: Distances, nbytes: int, bits: int) -> encoding.SampledNodes:
    """Return the finest sampled grid whose field takes at most ``nbytes`` in memory, with ``bits`` bits a pointer.

    Raises :class:`UsageError` if even the coarsest one is larger, and :class:`FittingError` if it has no nodes.
    """
    budget = Budget(nbytes, TOLERANCE)

    def following(spacing: float, sampled: encoding.SampledNodes) -> float:
        # Nodes, blocks and their words grow with the square. Where a solid is thinner than cells, so do the cells that
        # its surface passes through
        fixed = 4 * sampled.entries
        least = BYTES_PER_CELL + WORDS_PER_CELL / POINTERS[bits]
        expected = max(sampled.nbytes - fixed, least * sampled.cells)
        aim = spacing * np.sqrt(expected / max((1 - TOLERANCE / 2) * nbytes - fixed, 1))
        return float(np.clip(aim, FINEST_SPACING, COARSEST_SPACING))

    with raised_as(UsageError, BudgetError, at="--bytes"):
        best = budget.approach(
            lambda spacing: encoding.sample(distances, spacing, bits), FIRST_SPACING, following, attempts=6
        )
    if best.structure.nodes == 0:
        raise FittingError(
            f"{distances.mesh.path}: the solid is thinner than the cells of {nbytes:,} bytes, "
            f"1/{1 / best.structure.spacing:.0f} of the longest side: ask for more --bytes"
        )
    return best
