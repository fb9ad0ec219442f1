"""``fit sdf``: from a mesh and a number of bytes to arrays, trained, rounded and measured."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np

from ... import units
from ...errors import UsageError
from ...fitting import FitResult
from ...indirection import stored_form
from ...settings import FittingError
from ...tables import StoredArray, Table
from ...task import FitRequest, Fitted
from . import codes, encoding, files, nodes, paper, samples, training
from .distances import Distances
from .evaluation import Evaluation, lost_pieces
from .mesh import Mesh, load_mesh
from .presets import BYTES, PRESETS, ratio_for

#: Spacings from which sizes are found, and the finest and the coarsest one, of the longest side.
FIRST, FINEST, COARSEST = 1 / 64, 1 / 2048, 1 / 8

#: How much smaller than asked for a sparse field may be.
TOLERANCE = 0.02

#: Bytes that a cell that the surface passes through takes, at least: of masks and frames, and of pointers if each had a
#: word of its own.
BYTES_PER_CELL, WORDS_PER_CELL = 1, 6

#: Samples of the dense arrays, and the share that is uniform in the box.
SAMPLES, UNIFORM = 2**20, 0.2

#: Held-out points of the final measurement.
MEASURED = 2**18

#: Share of the surface's cells that may be too thin for the grid before it is said.
THIN = 0.3


def asked_bytes(options) -> int:
    """The bytes that are asked for. Raises :class:`UsageError`."""
    try:
        return BYTES if options["bytes"] is None else units.parse_bytes(options["bytes"])
    except ValueError as e:
        raise UsageError(f"--bytes: {e}") from None


def fit(request: FitRequest) -> Fitted:
    """
    Fit the mesh. Raises :class:`UsageError`, :class:`.mesh.MeshError`, :class:`.distances.DistancesError` and
    :class:`~mi_diffind.fitting.FittingError`.
    """
    mesh = load_mesh(request.options["source"])
    nbytes, recipe = asked_bytes(request.options), PRESETS[request.preset]
    start = time.perf_counter()
    with Distances(mesh) as distances:
        said = [*mesh.warnings, *distances.warnings]
        for warning in said:
            print(f"warning: {warning}", file=sys.stderr)
        make = fit_sparse if recipe.layout == "sparse" else fit_pair
        table, result, field, lines = make(mesh, distances, nbytes, recipe, request)
        prepared = time.perf_counter() - start - result.seconds
        found = Evaluation(mesh, distances, MEASURED).measure(field)
        lost = lost_pieces(field, distances)
    if lost:
        count = distances.surface.components
        lines.append(f"{lost} of {count} pieces of the mesh are too small for the field: more --bytes help")
    table.preset, table.seed = request.preset, request.settings.seed
    folder = (request.output or Path("x")).resolve().parent
    table.settings = {
        **request.recorded(),
        "source": mesh.digest,
        "mesh_path": os.path.relpath(Path(request.options["source"]).resolve(), folder),
        "scale": mesh.scale,
        "centre": list(mesh.centre),
        "warnings": said,
        **table.settings,
    }
    if request.seconds is not None:
        table.settings["steps"] = result.steps
    table.measured = {k: float(f"{v:.6g}") for k, v in found.items()}
    triangles = 12 * (len(mesh.vertices) + len(mesh.faces))
    lines.append(f"{prepared:.1f} s for distances and samples, {result.seconds:.1f} s of training")
    lines.append(f"the mesh itself has {len(mesh.faces):,} triangles, {triangles:,} bytes of positions and indices")
    figures = {"bytes_asked": nbytes, "mesh_bytes": triangles, "prepared_seconds": prepared, "warnings": said}
    figures["lost_pieces"] = lost
    return Fitted(table, result, lines, figures)


# -- sparse -----------------------------------------------------------------------------------------------------------


def sampled_for(distances: Distances, nbytes: int, bits: int) -> encoding.Sampled:
    """The finest grid whose field takes at most ``nbytes`` in memory. Raises :class:`UsageError` if none does."""
    spacing, found, tried = FIRST, None, {}
    for _ in range(6):
        sampled = encoding.sample(distances, spacing)
        tried[spacing] = size = coded_bytes(sampled, bits)
        fits = size <= nbytes
        if fits and (found is None or spacing < found.structure.spacing):
            found = sampled
        if fits and size >= (1 - TOLERANCE) * nbytes:
            break
        # Nodes, blocks and their words grow with the square. Where a solid is thinner than cells, so do those that its
        # surface passes through
        fixed = 4 * entries_for(sampled, bits)
        least = BYTES_PER_CELL + WORDS_PER_CELL / codes.POINTERS[bits]
        expected = max(size - fixed, least * sampled.cells)
        aim = spacing * np.sqrt(expected / max((1 - TOLERANCE / 2) * nbytes - fixed, 1))
        following = float(np.clip(aim, FINEST, COARSEST))
        if following in tried:
            break
        spacing = following
    if found is None:
        raise UsageError(
            f"--bytes: {nbytes:,} are fewer than the {min(tried.values()):,} that the coarsest grid of this mesh needs"
        )
    return found


def coded_bytes(sampled: encoding.Sampled, bits: int) -> int:
    """Bytes in memory of a sampled grid, once its nodes are pointers of ``bits`` bits."""
    structure = sampled.structure
    pointers = -(-structure.nodes // codes.POINTERS[bits])
    return structure.nbytes + 4 * (structure.blocks + pointers + entries_for(sampled, bits))


def entries_for(sampled: encoding.Sampled, bits: int) -> int:
    """Entries of the cascaded array: as many as pointers can name, and no more than there are nodes."""
    return max(1, min(2**bits, sampled.structure.nodes))


def fit_sparse(mesh: Mesh, distances: Distances, nbytes: int, recipe, request: FitRequest):
    bits = request.options["bits"]
    sampled = sampled_for(distances, nbytes, bits)
    structure = sampled.structure
    if structure.nodes == 0:
        raise FittingError(
            f"{mesh.path}: the solid is thinner than the cells of {nbytes:,} bytes, 1/{1 / structure.spacing:.0f} of "
            f"the longest side: ask for more --bytes"
        )
    field = nodes.SparseNodes(request.types, structure, 1.0)
    held_out = training.HeldOut(distances, request.types, structure.spacing)
    coding = encoding.Coding(sampled, bits, request.settings.seed)
    problem = training.NodeProblem(field, distances.surface, coding, held_out)
    result = request.train(problem)
    coding.commit(problem.net.unit(request.types).numpy().astype(np.float64), 1.0)
    words = codes.pointer_words(coding.pointers, bits)
    told = coding.values().astype(np.float64)
    slope = nodes.slope_bound(told[:, 0], told[:, 1:], sampled.corners)
    table = Table("sdf", files.sparse_arrays(structure, coding.frames, words, coding.entries))
    table.settings = {
        "layout": "sparse", "lower": list(structure.lower), "spacing": structure.spacing, "bits": bits,
        "nodes": structure.nodes, "slope": slope,
    }  # fmt: skip
    lines = []
    if sampled.missed > THIN:
        lines.append(
            f"{100 * sampled.missed:.0f}% of the cells that the surface comes through or near to show no change of "
            f"sign: parts may be thinner than a cell, 1/{1 / structure.spacing:.0f} of the longest side: more --bytes "
            f"help"
        )
    field = files.coded_field(request.types, structure, slope, coding.frames, words, bits, coding.entries)
    return table, result, field, lines


# -- the supplement's --------------------------------------------------------------------------------------------------


def fit_pair(mesh: Mesh, distances: Distances, nbytes: int, recipe, request: FitRequest):
    options = request.options
    ratio = options["ratio"] or ratio_for(nbytes)
    extent = mesh.upper - mesh.lower
    primary, cascaded = paper.resolutions(nbytes, ratio, extent)
    if 3 * int(np.prod(primary)) + int(np.prod(cascaded)) > nbytes:
        raise UsageError(f"--bytes: {nbytes:,} are fewer than the smallest arrays need")
    # The box ends a cell and a half outside of the mesh
    padding = 1.5 * extent.max() / (max(primary) - 4)
    lower, upper = mesh.lower - padding, mesh.upper + padding
    size = upper - lower
    spacing = float((size / (np.array(primary) - 1)).max())
    band = max(paper.LEAST_BAND, paper.BAND * spacing)
    uniform = int(UNIFORM * SAMPLES)
    seed = request.settings.seed
    points = np.concatenate([
        samples.near(distances.surface, SAMPLES - uniform, spacing / 2, [seed, 1]),
        samples.far(lower, upper, uniform, [seed, 2]),
    ])  # fmt: skip
    points = np.clip(points, lower, upper)
    d = distances.signed(points)
    unit = (points - lower) / size

    def at(resolution):
        places = np.stack(np.meshgrid(*[np.linspace(a, b, n) for a, b, n in zip(lower, upper, resolution, strict=True)],
                                      indexing="ij"), axis=-1)  # fmt: skip
        return distances.signed(places.reshape(-1, 3)).reshape(resolution)

    start = "constant" if options["constant"] else recipe.start
    if start == "constant":
        net = paper.initial("ramp", primary, cascaded, at, unit[:1], np.zeros(1), band)
    else:
        net = paper.initial(start, primary, cascaded, at, unit, d, band)
    net = net.alloc(request.types.TensorXf)
    field = paper.PairField(request.types, net, lower, upper, band, 1.0)
    held_out = training.HeldOut(distances, request.types, spacing / 2)
    problem = training.PairProblem(field, mesh, unit, d, held_out)
    result: FitResult = request.train(problem)
    kept = stored_form(problem.net)
    slope = paper.slope_of(kept, lower, upper, band)
    arrays = {"primary": StoredArray.of(kept.primary[0]), "cascaded": StoredArray.of(kept.cascaded)}
    table = Table("sdf", arrays)
    table.settings = {
        "layout": "pair", "lower": lower.tolist(), "upper": upper.tolist(), "band": band, "slope": slope,
        "ratio": primary[0] / cascaded[0], "start": start,
    }  # fmt: skip
    return table, result, paper.PairField(request.types, kept, lower, upper, band, slope), []
