"""``fit field``: from a folder of views to a grid, from a grid to a compressed field, trained and measured."""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from pathlib import Path

import numpy as np

from ... import units
from ...errors import UsageError
from ...fitting import FitResult, FittingError
from ...fitting import fit as train
from ...interrupt import interruptible
from ...tables import StoredArray, Table, save_table
from ...task import FitRequest, Fitted
from . import compression, files, paper
from . import grid as grids
from .grid import Grid
from .presets import COMPRESSION, PRESETS, RESOLUTION, STAGES, dense_bytes, ratio_for
from .training import Images, ImagesProblem, evaluate
from .views import Views, ViewsError, load_views

#: Sizes that ``--psnr`` tries: shares of the resolution, and bits of an index.
LADDER = ((0.5, 8), (0.7, 10), (1.0, 8), (1.0, 10), (1.0, 12), (1.0, 14))

#: Steps in which pairs are fitted to the grid's numbers before the images, samples of each, and their rate.
VALUE_STEPS, VALUE_BATCH, VALUE_RATE = 300, 2**15, 1e-2

#: Dense arrays of the supplement begin with the file's share of this.
DENSITY_SHARE = 0.35


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that do not go together."""
    options = request.options
    if options["source"] is None:
        raise UsageError("source: not given, a folder of views is needed")
    sized = [name for name in ("bytes", "compression", "psnr") if options[name] is not None]
    if request.preset == "grid" and sized:
        raise UsageError(f"--{sized[0]} is of the presets sparse and paper, found grid")
    if request.preset == "paper" and options["psnr"] is not None:
        raise UsageError("--psnr is of the preset sparse, found paper")
    for name, parse in (("bytes", units.parse_bytes), ("compression", units.parse_compression)):
        if options[name] is not None:
            try:
                parse(options[name])
            except ValueError as e:
                raise UsageError(f"--{name}: {e}") from None


def held_views(folder) -> tuple[Views, bool]:
    """The test views of a capture, and whether it has any: else the views that it was trained by."""
    try:
        return load_views(folder, "test"), True
    except ViewsError as e:
        try:
            return load_views(folder, "train"), False
        except ViewsError:
            raise e from None


def fit(request: FitRequest) -> Fitted:
    """
    Fit the capture. Raises :class:`UsageError`, :class:`.views.ViewsError`, :class:`~mi_diffind.tables.TableError` and
    :class:`~mi_diffind.fitting.FittingError`.
    """
    source, options = request.options["source"], request.options
    views = load_views(source, "train")
    held, tested = held_views(source)
    said = []
    if not tested:
        said.append("there are no test views: what is measured is how well the views of the training are met")
    if not views.has_alpha:
        said.append("the images have no alpha: what is behind counts as part of the field, in the box of the capture")
    for warning in said:
        print(f"warning: {warning}", file=sys.stderr)
    start = time.perf_counter()
    recipe = PRESETS[request.preset]
    grid, grid_result, grid_seconds = _grid(request, views, held)
    if recipe.layout == "grid":
        table, result, field = _finished_grid(grid, grid_result, views)
    else:
        make = _sparse if recipe.layout == "sparse" else _pairs
        stopped = grid_result is not None and grid_result.interrupted
        table, result, field = make(request, grid, views, held, stopped)
    found = evaluate(field, Images(request.types, held))
    table.preset, table.seed = request.preset, request.settings.seed
    folder = (request.output or Path("x")).resolve().parent
    table.settings = {
        **request.recorded(),
        "source": views.digest,
        "capture_path": os.path.relpath(Path(source).resolve(), folder),
        **({"grid_path": os.path.relpath(Path(options["grid"]).resolve(), folder)} if options["grid"] else {}),
        "warnings": said,
        **table.settings,
    }
    table.measured = {k: float(f"{v:.5g}") for k, v in found.items()}
    dense = dense_bytes(grid.nodes.shape)
    lines = [f"{grid_seconds:.1f} s for the grid, {time.perf_counter() - start - grid_seconds:.1f} s from it on"]
    size = getattr(field, "nbytes", None)
    if size:
        lines.append(f"{size:,} bytes in memory, {dense / size:.0f} times less than the dense grid of float32")
    figures = {"grid_seconds": grid_seconds, "dense_bytes": dense, "memory_bytes": size, "warnings": said}
    return Fitted(table, result, lines, figures)


# -- the grid ---------------------------------------------------------------------------------------------------------


def _grid(request: FitRequest, views: Views, held: Views) -> tuple[Grid, FitResult | None, float]:
    """The grid: that of ``--grid`` if the file exists, else a trained one, which is written there."""
    path, start = request.options["grid"], time.perf_counter()
    if path and Path(path).exists() and request.preset != "grid":
        table = files.load(path)
        if table.settings["layout"] != "grid":
            raise UsageError(f'--grid: {path} has the layout "{table.settings["layout"]}", a grid is needed')
        if table.settings.get("source") != views.digest:
            raise UsageError(f"--grid: {path} was fitted to other views than those in {views.path}")
        return grid_of(table, request.types), None, time.perf_counter() - start
    grid, result = trained_grid(request, views, held)
    if path and not result.interrupted:  # or the next training would take it for a finished one
        table = files.grid_table(*_stored_grid(grid, views))
        table.preset, table.settings["source"] = "grid", views.digest
        table.measured = {k: float(f"{v:.5g}") for k, v in result.measured.items()}
        save_table(path, table)
        grid = grid_of(files.load(path), request.types)
    return grid, result, time.perf_counter() - start


def grid_of(table: Table, types) -> Grid:
    """The grid in a table."""
    settings = table.settings
    nodes = grids.Nodes(types, settings["lower"], settings["spacing"], settings["shape"], files.stored_of(table))
    return Grid(nodes, table.arrays["density"].values[:, 0], table.arrays["colour"].values)


def trained_grid(request: FitRequest, views: Views, held: Views) -> tuple[Grid, FitResult]:
    """
    A grid from nothing, in stages. With a checkpoint, each stage has one beside it, and what the stages before have
    found is kept in ``CHECKPOINT.grid.npz``.
    """
    settings = PRESETS["grid"].settings
    if request.preset == "grid":
        settings = request.settings
    settings = dataclasses.replace(settings, seed=request.settings.seed, deterministic=request.settings.deterministic)
    nodes = request.options["resolution"] or RESOLUTION
    kept = Path(f"{request.checkpoint}.grid.npz") if request.checkpoint else None
    grid, done, result = None, 0, None
    if kept is not None and request.resume and kept.exists():
        table = files.load(kept)
        if table.settings.get("source") != views.digest or table.settings.get("nodes") != nodes:
            raise FittingError(f'the checkpoint "{kept}" is of other views or another resolution')
        grid, done = grid_of(table, request.types), table.settings["stages"]
        if done == len(STAGES):
            return grid, FitResult(table.measured, 0, 0, 0.0, False, 0)
    images = Images(request.types, views)
    for number, (share, part) in enumerate(STAGES):
        if number < done:
            continue
        with interruptible() as stop:
            if grid is None:
                grid = grids.begin(request.types, views, max(8, round(nodes * share)))
            else:
                grid = grids.divided(grid, grids.visible(grid, images), share / STAGES[number - 1][0])
        if stop.is_set() and result is not None:
            return grid, dataclasses.replace(result, interrupted=True)
        if grid.nodes.count == 0:
            raise FittingError(f"{views.path}: there is nothing in the views, or the training has lost it")
        last = number == len(STAGES) - 1
        steps = max(1, round(settings.steps * part))
        stage = dataclasses.replace(
            settings, steps=steps, schedule="cosine" if last else "constant", measure_every=max(1, steps // 2)
        )
        problem = grids.GridProblem(grid, views, held)
        checkpoint = f"{request.checkpoint}.stage{number}" if request.checkpoint else None
        result = train(
            problem, stage, checkpoint, request.resume and checkpoint is not None and os.path.exists(checkpoint),
            request.progress, title=f"grid, {round(nodes * share)}³",
            seconds=None if request.seconds is None or request.preset != "grid" else request.seconds * part,
        )  # fmt: skip
        grid = problem.trained()
        if result.interrupted or (result.asked_to_stop and not last):
            return grid, dataclasses.replace(result, interrupted=True)
        if kept is not None:
            table = files.grid_table(grid.nodes, grid.density, grid.colour, np.float32)
            table.settings |= {"source": views.digest, "nodes": nodes, "stages": number + 1}
            table.measured = result.measured
            save_table(kept, table)
    return grid, result


def _stored_grid(grid: Grid, views: Views) -> tuple:
    """Nodes, densities and colours of the visible part."""
    seen = grids.divided(grid, grids.visible(grid, Images(grid.nodes.types, views)), 1, 0)
    return seen.nodes, seen.density, seen.colour


def _finished_grid(grid: Grid, result: FitResult, views: Views):
    table = files.grid_table(*_stored_grid(grid, views))
    return table, result, files.field_of(table, grid.nodes.types)


# -- what is made of it -----------------------------------------------------------------------------------------------


def wanted_bytes(options, grid: Grid) -> int | None:
    """The bytes in memory that are asked for, ``None`` if nothing is."""
    if options["bytes"] is not None:
        return units.parse_bytes(options["bytes"])
    if options["compression"] is not None:
        return round(dense_bytes(grid.nodes.shape) / units.parse_compression(options["compression"]))
    return None


def _train(request: FitRequest, problem: ImagesProblem, stopped: bool) -> FitResult:
    """
    The training; if that of the grid was ``stopped``, none, so that what there is is kept, and one that is resumed goes
    on with the grid.
    """
    if stopped:
        return FitResult(problem.measure(problem.net), 0, 0, 0.0, True, 0)
    checkpoint = request.checkpoint
    if request.resume and checkpoint is not None and not os.path.exists(checkpoint):
        # What was stopped may have been the grid
        begun = any(os.path.exists(f"{checkpoint}.{name}") for name in ("stage0", "grid.npz"))
        request = dataclasses.replace(request, resume=not begun)
    return request.train(problem, title="through the images")


def _sparse(request: FitRequest, grid: Grid, views: Views, held: Views, stopped: bool):
    images = Images(request.types, views)
    if request.options["psnr"] is not None:
        return _reaching(request, grid, images, views, held, stopped)
    try:
        smaller, bits = compression.sized(grid, images, wanted_bytes(request.options, grid))
    except ValueError as e:
        given = "bytes" if request.options["bytes"] is not None else "compression"
        raise UsageError(f"--{given}: {e}") from None
    return _coded(request, smaller, bits, images, views, held, stopped)


def _coded(request: FitRequest, grid: Grid, bits: int, images: Images, views: Views, held: Views, stopped: bool):
    problem = compression.PaletteProblem(compression.coded(grid, images, bits, request.settings.seed), views, held)
    result = _train(request, problem, stopped)
    table = files.palette_table(grid.nodes, problem.stored(), bits)
    return table, result, files.field_of(table, request.types)


def _reaching(request: FitRequest, grid: Grid, images: Images, views: Views, held: Views, stopped: bool):
    """The first size of the ladder that reaches the PSNR that is asked for, or the last one."""
    wanted, found = float(request.options["psnr"]), None
    cells = grids.visible(grid, images)
    for number, (share, bits) in enumerate(LADDER):
        smaller = grids.divided(grid, cells, share, 0)
        if request.checkpoint is not None:
            path = f"{request.checkpoint}.size{number}"
            one = dataclasses.replace(request, checkpoint=path, resume=request.resume and os.path.exists(path))
        else:
            one = request
        found = _coded(one, smaller, bits, images, views, held, stopped)
        reached = evaluate(found[2], Images(request.types, held))["psnr_white_db"]
        print(f"{found[2].nbytes:,} bytes: {reached:.2f} dB over white", file=sys.stderr)
        if reached >= wanted or found[1].interrupted:
            return found
    print(f"warning: no size reaches {wanted:g} dB, the largest has {reached:.2f} dB", file=sys.stderr)
    return found


def _pairs(request: FitRequest, grid: Grid, views: Views, held: Views, stopped: bool):
    seen = grids.divided(grid, grids.visible(grid, Images(request.types, views)), 1, 0)
    nbytes = wanted_bytes(request.options, grid) or dense_bytes(grid.nodes.shape) / COMPRESSION
    problem = pairs_problem(seen, nbytes, views, held, request, 0 if stopped else VALUE_STEPS)
    result = _train(request, problem, stopped)
    net = problem.net
    arrays = {}
    for kind in ("density", "colour"):
        pair = getattr(net, kind)
        arrays[f"{kind}_primary"] = StoredArray.of(pair.primary[0].quantised(8))
        arrays[f"{kind}_cascaded"] = StoredArray.of(pair.cascaded.quantised(8))
    table = files.pairs_table(seen.nodes, arrays, problem.low, problem.high)
    return table, result, files.field_of(table, request.types)


def pairs_problem(
    grid: Grid, nbytes: float, views: Views, held: Views, request: FitRequest, steps: int
) -> paper.PairsProblem:
    """The supplement's arrays of so many bytes, fitted to the grid's numbers in so many steps."""
    types = request.types
    ratio = dense_bytes(grid.nodes.shape) / nbytes
    extent = np.array(grid.nodes.upper) - np.array(grid.nodes.lower)
    shapes = {}
    for kind, channels, share in (("density", 1, DENSITY_SHARE), ("colour", 12, 1 - DENSITY_SHARE)):
        shapes[kind] = paper.sides(share * nbytes, ratio_for(kind, ratio), channels, extent)
    density, colour, low, high = paper.initial(paper.dense(grid), shapes, types)
    net = paper.PairsNet(density, colour)
    field = paper.PairsField(grid.nodes, density, colour, low, high)
    values = paper.ValuesProblem(net, field, grid)
    if steps:
        settings = dataclasses.replace(
            request.settings, steps=steps, batch=VALUE_BATCH, lr=VALUE_RATE, measure_every=steps
        )
        train(values, settings, progress=request.progress, title="the grid's numbers")
    return paper.PairsProblem(net, grid.nodes, low, high, views, held)
