"""Training of distance fields (``fit sdf``): from a mesh and a number of bytes to a table file."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import drjit as dr
import numpy as np
from drjit import nn

from ...arrays.indirection import device_array, device_tensor
from ...arrays.tables import MAX_BYTES, Table
from ...core import units
from ...core.errors import UsageError
from ...fitting.loop import Problem
from ...fitting.settings import FittingError
from ...fitting.task import FitRequest, Fitted
from . import encoding
from .distances import Distances
from .evaluation import HELD_OUT, HeldOut, SurfaceEvaluation, lost_pieces
from .mesh import Mesh, load_mesh
from .model import coded_arrays, field_of
from .nodes import POINTERS, SparseNodes
from .paper import SAMPLES, fit_pair

#: Default size in memory, in bytes.
BYTES = 2**20

#: Bytes of samples of the nodes during the training for each byte of the field, roughly.
SAMPLED = 64

#: First, finest and coarsest spacing in the search for a grid's size, relative to the longest side.
FIRST, FINEST, COARSEST = 1 / 64, 1 / 2048, 1 / 8

#: Share by which a sparse field may be smaller than requested.
TOLERANCE = 0.02

#: Least bytes for a cell that the surface passes through: of masks and frames, and of pointers with a word each.
BYTES_PER_CELL, WORDS_PER_CELL = 1, 6

#: Held-out points of the final measurement.
MEASURED = 2**18

#: Share of the surface's cells without a change of sign above which a warning is printed.
THIN = 0.3

#: Weights in the loss: the distance (in spacings), the field's gradient and the blended normals of nodes.
DISTANCE, GRADIENT, SMOOTH = 0.3, 0.05, 0.02

#: Distance, in spacings, below which errors are weighted by their squares.
ROUND = 0.01


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


class NodeValues(nn.Module):
    """Trainable nodes of a sparse grid: ``values`` (n, 4), distances in spacings and normals of any length."""

    DRJIT_STRUCT = {"values": dr.ArrayBase}  # noqa: RUF012

    def __init__(self, values=None):
        self.values = values

    def unit(self, types):
        """Return the nodes with normals of length 1."""
        d, x, y, z = dr.unravel(types.Array4f, self.values.array)
        inverse = dr.rsqrt(dr.maximum(x * x + y * y + z * z, 1e-12))
        return types.TensorXf(dr.ravel(types.Array4f(d, x * inverse, y * inverse, z * inverse)), self.values.shape)


class NodeProblem(Problem):
    """Training of a sparse grid's nodes against the surface itself.

    The field is to be zero on the surface, and its gradient and its smooth normal are to be the surface's normal.
    Distances elsewhere are not needed, since the nodes begin with theirs.
    """

    #: The last state is kept: rounding differs from state to state by more than the training still changes.
    tolerance = 1.0

    def __init__(self, field: SparseNodes, mesh: Mesh, sampled: encoding.SampledNodes, bits: int, held_out: HeldOut):
        self.field, self.types, self.held_out = field, field.types, held_out
        self.surface = SurfaceSampler(mesh, self.types)
        start = np.concatenate([sampled.distances[:, None], sampled.normals], axis=1)
        self.net = NodeValues(device_tensor(self.types.TensorXf, start))
        self.identity = {"source": mesh.digest, "nodes": len(start), "spacing": field.spacing, "bits": bits}

    def loss(self, net, rng, size: int):
        p, n = self.surface.draw(rng, size)
        self.field.nodes = net.unit(self.types)
        value, slope, smooth, complete = self.field.blend(p)
        Array3f = self.types.Array3f
        square = dr.square(value)
        error = DISTANCE * (dr.sqrt(square + ROUND**2) if self.settings.loss == "mae" else 10 * square)
        error += GRADIENT * dr.squared_norm(Array3f(*slope) - n) + SMOOTH * dr.squared_norm(Array3f(*smooth) - n)
        return dr.select(complete, error, 0) / size

    def measure(self, net):
        with dr.suspend_grad():
            self.field.nodes = dr.detach(net.unit(self.types))
            return self.held_out.measure(self.field)

    def values(self) -> np.ndarray:
        """Return the trained nodes, (n, 4) float64."""
        return self.net.unit(self.types).numpy().astype(np.float64)


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
    try:
        nbytes = BYTES if options["bytes"] is None else units.parse_bytes(options["bytes"])
    except ValueError as e:
        raise UsageError(f"--bytes: {e}") from None
    units.check_size("--bytes", nbytes, MAX_BYTES)
    units.check_memory("--bytes", nbytes, SAMPLED * nbytes)
    return nbytes


def fit(request: FitRequest, measured: int = MEASURED, samples: int = SAMPLES, held_out: int = HELD_OUT) -> Fitted:
    """Fit the mesh that the request names.

    ``measured`` and ``held_out`` are the numbers of points at which the result and states on the way are measured,
    ``samples`` the number of training samples of dense arrays. Raises :class:`UsageError`, :class:`.mesh.MeshError`,
    :class:`.distances.DistancesError` and :class:`.FittingError`.
    """
    mesh = load_mesh(request.options["source"])
    nbytes = requested_bytes(request.options)
    start = time.perf_counter()
    with Distances(mesh) as distances:
        warnings = [*mesh.warnings, *distances.warnings]
        for warning in warnings:
            print(f"warning: {warning}", file=sys.stderr)
        lines, evaluation = [], SurfaceEvaluation(mesh, distances, measured)

        def measure(field) -> tuple[dict[str, float], int]:
            return evaluation.measure(field), lost_pieces(field, distances)

        if request.preset == "sparse":
            sampled = search_grid(distances, nbytes, request.options["bits"])
            if sampled.missed > THIN:
                lines.append(
                    f"{100 * sampled.missed:.0f}% of the cells that the surface comes through or near to show no "
                    f"change of sign: parts may be thinner than a cell, 1/{1 / sampled.structure.spacing:.0f} of the "
                    f"longest side: more --bytes help"
                )
            table, result, field = fit_sparse(distances, sampled, request, held_out, measure)
        else:
            table, result, field = fit_pair(distances, nbytes, request, samples, held_out, measure)
        prepared = time.perf_counter() - start - result.seconds
        errors, lost = measure(field)
    if lost:
        count = distances.surface.components
        lines.append(f"{lost} of {count} pieces of the mesh are too small for the field: more --bytes help")
    table.preset, table.seed = request.preset, request.settings.seed
    table.settings = {
        **request.recorded(result),
        "source": mesh.digest,
        **request.paths(mesh_path=request.options["source"]),
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
    figures["lost_pieces"] = lost
    return Fitted(table, result, lines, figures)


def search_grid(distances: Distances, nbytes: int, bits: int) -> encoding.SampledNodes:
    """Return the finest sampled grid whose field takes at most ``nbytes`` in memory, with ``bits`` bits a pointer.

    Raises :class:`UsageError` if even the coarsest one is larger, and :class:`FittingError` if it has no nodes.
    """
    spacing, best, tried = FIRST, None, {}
    for _ in range(6):
        sampled = encoding.sample(distances, spacing)
        tried[spacing] = size = coded_bytes(sampled, bits)
        fits = size <= nbytes
        if fits and (best is None or spacing < best.structure.spacing):
            best = sampled
        if fits and size >= (1 - TOLERANCE) * nbytes:
            break
        # Nodes, blocks and their words grow with the square. Where a solid is thinner than cells, so do the cells that
        # its surface passes through
        fixed = 4 * entries_for(sampled, bits)
        least = BYTES_PER_CELL + WORDS_PER_CELL / POINTERS[bits]
        expected = max(size - fixed, least * sampled.cells)
        aim = spacing * np.sqrt(expected / max((1 - TOLERANCE / 2) * nbytes - fixed, 1))
        following = float(np.clip(aim, FINEST, COARSEST))
        if following in tried:
            break
        spacing = following
    if best is None:
        raise UsageError(f"--bytes: found {nbytes:,}, the coarsest grid of this mesh needs {min(tried.values()):,}")
    if best.structure.nodes == 0:
        raise FittingError(
            f"{distances.mesh.path}: the solid is thinner than the cells of {nbytes:,} bytes, "
            f"1/{1 / best.structure.spacing:.0f} of the longest side: ask for more --bytes"
        )
    return best


def coded_bytes(sampled: encoding.SampledNodes, bits: int) -> int:
    """Return the bytes in memory of a sampled grid whose nodes are pointers of ``bits`` bits."""
    structure = sampled.structure
    pointers = -(-structure.nodes // POINTERS[bits])
    return structure.nbytes + 4 * (structure.blocks + pointers + entries_for(sampled, bits))


def entries_for(sampled: encoding.SampledNodes, bits: int) -> int:
    """Return the size of the cascaded array: as many entries as pointers can name, and at most one per node."""
    return max(1, min(2**bits, sampled.structure.nodes))


def fit_sparse(
    distances: Distances,
    sampled: encoding.SampledNodes,
    request: FitRequest,
    held_out: int = HELD_OUT,
    measure: Callable[[SparseNodes], object] = lambda field: None,
):
    """Train and encode the nodes of a sampled grid: ``(table, training result, field)``.

    ``measure`` is the measurement that will follow, for which a limit of time leaves room.
    """
    bits, structure, types = request.options["bits"], sampled.structure, request.types
    held = HeldOut(distances, types, structure.spacing, count=held_out)
    problem = NodeProblem(SparseNodes(types, structure, 1.0), distances.surface, sampled, bits, held)

    def stored() -> tuple[Table, SparseNodes]:
        coding = encoding.NodeCoding(sampled, bits, request.settings.seed)
        coding.encode(problem.values())
        arrays, settings = coded_arrays(coding)
        table = Table("sdf", arrays, settings=settings)
        return table, field_of(table, {}, types)

    result = request.train(problem, finish=lambda: measure(stored()[1]))
    table, field = stored()
    return table, result, field
