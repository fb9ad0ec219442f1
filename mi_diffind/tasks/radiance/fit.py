"""``fit field``: from a folder of views to a grid, from a grid to a compressed field, trained and measured."""

from __future__ import annotations

import dataclasses
import functools
import os
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import numpy as np

from ...arrays.tables import MAX_BYTES, StoredArray, Table, save_table
from ...core import units
from ...core.errors import UsageError
from ...core.files import check_distinct
from ...core.progress import interruptible
from ...fitting.loop import FitResult, FittingError, cores
from ...fitting.task import FitRequest, Fitted
from . import compression, files, paper
from . import grid as grids
from .grid import NodeGrid
from .presets import (
    COLOURS,
    COMPRESSION,
    MOST_NUMBERS,
    PRESETS,
    REFLECTING,
    RESOLUTIONS,
    STAGES,
    dense_bytes,
    ratio_for,
)
from .rate_distortion import Importance, importance
from .session import SIDE, WATCHED, FieldSession
from .training import ImagesProblem
from .volume_field import VolumeField

#: Sizes among which ``--psnr`` searches: share of the resolution, bits of an index, and slope of rate and distortion.
LADDER = (
    (0.5, 9, 0.05), (0.7, 10, 0.05), (0.85, 10, 0.05), (1.0, 10, 0.1), (1.0, 11, 0.05), (1.0, 12, 0.02),
    (1.0, 12, compression.SLOPE), (1.0, 13, 0.002),
)  # fmt: skip

#: Shares of the resolution that ``--disk`` tries in turn.
SHARES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)

#: Training of pairs on the numbers of the grid, before the images: steps, samples of a step, and learning rate.
VALUE_STEPS, VALUE_BATCH, VALUE_RATE = 300, 2**15, 1e-2

#: Share of the bytes of the supplement's arrays that the density gets.
DENSITY_SHARE = 0.35

#: Bytes of memory for each node of the dense grid, empty or not, roughly.
VOXEL = 24

#: Shares of a limited time: that of the grid, and, of what is left then, those of the training on its numbers and of
#: the clusters of its colours.
GRID_TIME, VALUE_TIME, CLUSTER_TIME = 0.6, 0.2, 0.25

#: Least steps of the first stage of the grid if time is limited: a field that nobody sees has no second stage.
FIRST_STEPS = 100

#: Views that a trial of colours needs, and the gain in decibels at which reflections are chosen.
LEAST_VIEWS, WORTH = 16, 0.15

#: Most steps of each colour in a trial.
TRIAL = 600

#: Pixels of held-out views that are measured, and of training views in which visible cells are sought, for each second
#: of a limited time.
PIXELS = 40_000


#: Ends of the names of files of 3D Gaussians.
SPLATS = (".ply", ".sog", ".spz", ".splat", ".ksplat", ".lcc")


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that do not go together."""
    options = request.options
    if options["source"] is None:
        raise UsageError("source: not given, a folder of views is needed")
    if Path(options["source"]).suffix.lower() in SPLATS:
        path = Path(options["source"])
        raise UsageError(
            f"source: {path} is a file of 3D Gaussians, a folder of views is needed: "
            f"mi-diffind capture {path.name} -o {path.stem}_views --views 80 --resolution 200"
        )
    sized = [name for name in ("bytes", "compression", "psnr", "disk") if options.get(name) is not None]
    if request.preset == "grid" and sized:
        raise UsageError(f"--{sized[0]} is an option of the presets sparse and paper, found the preset grid")
    for name in ("density_ratio", "colour_ratio"):
        if request.preset != "paper" and options.get(name) is not None:
            raise UsageError(f"--{name.replace('_', '-')}: found the preset {request.preset}, allowed is paper")
    if request.preset == "paper":
        for name in ("psnr", "disk", "exposures"):
            if options.get(name):
                raise UsageError(f"--{name} is an option of the preset sparse, found the preset paper")
        if options.get("background") == "surroundings":
            raise UsageError("--background: found surroundings with the preset paper, whose box is not contracted")
        if options.get("colours") == "reflections":
            raise UsageError(
                "--colours: found reflections with the preset paper, whose numbers are those of directions"
            )
    if options.get("colours") == "reflections" and options.get("background") == "surroundings":
        raise UsageError("--colours: found reflections with --background surroundings, allowed is directions")
    sizes = (("bytes", units.parse_bytes), ("disk", units.parse_bytes), ("compression", units.parse_compression))
    for name, parse in sizes:
        if options.get(name) is not None:
            try:
                value = parse(options[name])
            except ValueError as e:
                raise UsageError(f"--{name}: {e}") from None
            if name != "compression":
                units.check_size(f"--{name}", value, MAX_BYTES)
    nodes = options["resolution"] or RESOLUTIONS[0]
    units.check_memory("--resolution", nodes, VOXEL * nodes**3)
    if request.checkpoint is not None:
        parts = ["grid.npz", *(f"stage{n}" for n in range(len(STAGES))), *(f"size{n}" for n in range(len(LADDER)))]
        kept = [f"{os.fspath(request.checkpoint)}.{part}" for part in parts]
        check_distinct({"-o": request.output, "--grid": options["grid"]}, {"a file beside --checkpoint": kept})


def fit(request: FitRequest) -> Fitted:
    """Fit a field to the views in a folder.

    Raises :class:`UsageError`, :class:`.views.ViewsError`, :class:`.TableError` and
    :class:`.FittingError`.
    """
    pixels = None if request.deadline is None else PIXELS * request.deadline.seconds
    options = request.options
    reading = {name: options.get(name) for name in ("background", "downscale", "exposures")}
    session = FieldSession.load(request.types, options["source"], pixels, progress=request.progress, **reading)
    pixels = len(session.views) * session.views.mean_pixels
    settings = PRESETS[request.preset].scaled(request.settings, pixels)
    return FieldFit(dataclasses.replace(request, settings=settings), session).run()


@dataclasses.dataclass
class FieldFit:
    """One run of ``fit field``: the request, the session of its capture, and the steps from views to a table."""

    request: FitRequest
    session: FieldSession

    def run(self) -> Fitted:
        """Train the grid, compress it as the preset says, and measure the result in the held-out views."""
        request, session, options = self.request, self.session, self.request.options
        warnings = []
        if not session.has_test_views:
            warnings.append("there are no test views: the measured error is that of the training views")
        if not session.views.has_alpha and not session.views.surroundings:
            warnings.append("the images have no alpha: their background becomes part of the field")
        for line in (*session.notes, *(f"warning: {warning}" for warning in warnings)):
            print(line, file=sys.stderr)
        start = time.perf_counter()
        grid, grid_result = self.grid()
        grid_seconds = time.perf_counter() - start
        layout = PRESETS[request.preset].layout
        if layout == "grid":
            table, result = self.grid_table(grid), grid_result
            field = files.field_of(table, request.types)
        else:
            stopped = grid_result is not None and grid_result.interrupted
            table, result, field = (self.sparse if layout == "sparse" else self.pairs)(grid, stopped)
        measured = session.held_out_images.evaluate(field, ssim=True)
        table.preset, table.seed = request.preset, request.settings.seed
        table.settings = {
            **request.recorded(result),
            "source": session.views.digest,
            **session.views.settings,
            **({"downscale": options["downscale"]} if options.get("downscale") else {}),
            **self.exposures(),
            **request.paths(capture_path=options["source"], grid_path=options["grid"] or None),
            "warnings": warnings,
            **table.settings,
        }
        table.measured = rounded_figures(measured)
        dense = dense_bytes(grid.nodes.shape)
        seconds = time.perf_counter() - start - grid_seconds
        lines = [f"{grid_seconds:.1f} s for the grid, {seconds:.1f} s for the rest"]
        if layout != "grid" and grid_result is not None and grid_result.unfinished:
            steps = f"{grid_result.steps} step{'s' if grid_result.steps != 1 else ''}"
            lines.append(f"the grid was trained for {steps}: unfinished")
        if request.deadline is not None:
            lines.append(f"measured in {len(session.held_out)} held-out views")
        size = getattr(field, "nbytes", None)
        if size:
            lines.append(f"{size:,} bytes in memory, {dense / size:.0f} times less than the dense grid of float32")
        figures = {"grid_seconds": grid_seconds, "dense_bytes": dense, "memory_bytes": size, "warnings": warnings}
        figures["notes"] = session.notes
        return Fitted(table, result, lines, figures)

    @property
    def colours(self) -> str:
        """Colours of :data:`.presets.COLOURS`, or "auto": those that show left-out views best (:meth:`reflecting`)."""
        views, chosen = self.session.views, self.request.options.get("colours")
        simple = self.request.preset == "paper" or views.surroundings or self.session.exposures is not None
        return chosen or ("directions" if simple or len(views) < LEAST_VIEWS else "auto")

    def reflecting(self, grid: NodeGrid, trial: FitRequest) -> tuple[NodeGrid, FitResult | None]:
        """Return a grid with the colours that the options ask for or, by default, those that show more.

        By default, both colours are trained as the request ``trial`` says, by seven eighths of the views. Reflections
        are chosen if the other views gain :data:`WORTH` decibels. The result of the training of the returned grid is
        returned, too.
        """
        if self.colours == "reflections":
            return grid.reflecting(), None
        views, seen = self.session.views, np.arange(len(self.session.views)) % 8 != 4
        left_out = np.nonzero(~seen)[0]
        left_out = left_out[np.arange(min(WATCHED, len(left_out))) * len(left_out) // min(WATCHED, len(left_out))]
        session = dataclasses.replace(
            self.session, views=views.chosen(np.nonzero(seen)[0]), held_out=views.chosen(left_out)
        )
        settings = dataclasses.replace(trial.settings, measure_every=trial.settings.steps)
        trained, reached = [], []
        for number, start in enumerate((grid, grid.reflecting())):
            problem = grids.GridProblem(start, session, 1)
            request = dataclasses.replace(trial.part(1 / (2 - number)), settings=settings, checkpoint=None)
            request = dataclasses.replace(request, resume=False)
            result = request.train(problem, f"trial of colours: {COLOURS[1 - number]}")
            trained.append((problem.trained(), result))
            reached.append(session.held_out_images.evaluate(trained[-1][0].field())["psnr_foreground_db"])
            if result.interrupted:
                return trained[0]
        better = reached[1] >= reached[0] + WORTH
        print(
            f"colours: {COLOURS[1 - better]} (left-out views have {reached[1]:.2f} dB of the foreground with "
            f"reflections, {reached[0]:.2f} without)",
            file=sys.stderr,
        )
        return trained[better]

    def exposures(self) -> dict[str, list[float]]:
        """Return the setting that records the exposures of the training views in stops, if they were trained."""
        stops = self.session.exposures
        return {} if stops is None else {"exposures": [round(float(s), 4) for s in stops]}

    def take_exposures(self, table: Table) -> None:
        """Begin with the exposures that a table records."""
        if self.session.exposures is not None and "exposures" in table.settings:
            self.session.exposures = np.float32(table.settings["exposures"])

    def grid(self) -> tuple[NodeGrid, FitResult | None]:
        """Return the grid: that of ``--grid`` if the file exists, else a trained one, which is written there."""
        request, views, path = self.request, self.session.views, self.request.options["grid"]
        if path and Path(path).exists() and request.preset != "grid":
            table = files.load(path)
            if table.settings["layout"] != "grid":
                raise UsageError(f'--grid: {path} has the layout "{table.settings["layout"]}", a grid is needed')
            if table.settings.get("source") != views.digest:
                raise UsageError(f"--grid: {path} was fitted to other views than those in {views.path}")
            if request.preset == "paper" and "environment" in table.arrays:
                raise UsageError(
                    f"--grid: {path} has colours with reflections, the preset paper needs those of directions: "
                    f"fit a grid with --colours directions"
                )
            self.take_exposures(table)
            return files.grid_of(table, request.types), None
        grid, result = self.trained_grid()
        if path and not result.interrupted:  # the next run would take an interrupted grid for a finished one
            table = self.grid_table(grid)
            table.preset, table.settings = "grid", {**table.settings, "source": views.digest, **self.exposures()}
            stored = files.field_of(table, request.types)  # without invisible cells, in half precision
            table.measured = rounded_figures(self.session.held_out_images.evaluate(stored, ssim=True))
            save_table(path, table)
            grid = files.grid_of(files.load(path), request.types)
        return grid, result

    def trained_grid(self) -> tuple[NodeGrid, FitResult]:
        """Train a grid in stages.

        With a checkpoint, each stage has one of its own beside it, and the grid of the last finished stage is kept in
        ``CHECKPOINT.grid.npz``.
        """
        request, views = self.request, self.session.views
        settings = request.settings if request.preset == "grid" else PRESETS["grid"].settings
        settings = dataclasses.replace(
            settings, seed=request.settings.seed, deterministic=request.settings.deterministic
        )
        if request.preset != "grid":
            settings = PRESETS["grid"].scaled(settings, len(views) * views.mean_pixels)
        nodes = request.options["resolution"] or grids.resolution_of(views)
        stages_file = Path(f"{request.checkpoint}.grid.npz") if request.checkpoint else None
        limited = request.part(GRID_TIME if request.preset != "grid" else 1.0)
        grid, finished, result, reached = None, 0, None, STAGES[0][0]
        numbers = np.inf if request.options["resolution"] else MOST_NUMBERS
        if stages_file is not None and request.resume and stages_file.exists():
            table = files.load(stages_file)
            if table.settings.get("source") != views.digest or table.settings.get("nodes") != nodes:
                raise FittingError(f'the checkpoint "{stages_file}" has other views or another resolution')
            if table.settings.get("asked_for_colours") != self.colours:
                raise FittingError(f'the checkpoint "{stages_file}" was made with another option --colours')
            grid, finished = files.grid_of(table, request.types), table.settings["stages"]
            reached = table.settings["share"]
            self.take_exposures(table)
            if finished == len(STAGES):
                return grid, FitResult(table.measured, 0, 0, 0.0, False, 0)
        for number, (share, part) in enumerate(STAGES):
            if number < finished:
                continue
            dr.flush_malloc_cache()  # of the stage before
            with interruptible() as stop:
                if grid is None:
                    grid = grids.begin(request.types, self.session.seeing_images.views, max(8, round(nodes * share)))
                else:
                    visible = grids.visible(grid, self.session.seeing_images)
                    # At full resolution, no further cells are needed, but memory and time would be
                    visible = grids.widened(visible) if share < 1 else visible
                    last = number + 1 == len(STAGES)
                    factor = 1.0 if last else grids.largest_factor(grid, visible, share / reached, numbers)
                    grid, reached = grids.divided(grid, visible, factor), reached * factor
            if number + 2 == len(STAGES) and reached < 0.99:
                print(
                    f"resolution: {round(nodes * reached)}³, since {nodes}³, as fine as the pixels, is more than "
                    f"{MOST_NUMBERS:,} numbers; --resolution decides",
                    file=sys.stderr,
                )
            if stop.is_set() and result is not None:
                return grid, dataclasses.replace(result, interrupted=True)
            if grid.nodes.count == 0:
                raise FittingError(f"{views.path}: the views are empty, or the training made the field empty")
            last = number == len(STAGES) - 1
            steps = max(1, round(settings.steps * part))
            stage = dataclasses.replace(
                settings, steps=steps, schedule="cosine" if last else "constant", measure_every=max(1, steps // 2)
            )
            limited_stage = limited.part(part / sum(later for _, later in STAGES[number:]))
            rest = steps
            if share == REFLECTING and self.colours != "directions":
                tried = dataclasses.replace(stage, steps=min(steps, TRIAL))
                grid, chosen = self.reflecting(grid, dataclasses.replace(limited_stage, settings=tried))
                if chosen is not None:
                    result = chosen
                    over = chosen.interrupted or chosen.asked_to_stop or limited.deadline is not None
                    rest = 0 if over else steps - chosen.steps
            if rest:
                problem, grid = grids.GridProblem(grid, self.session, SIDE if last else 1), None
                if number:
                    problem.draw_by_errors()
                checkpoint = f"{request.checkpoint}.stage{number}" if request.checkpoint else None
                stage_request = dataclasses.replace(
                    limited_stage,
                    settings=dataclasses.replace(stage, steps=rest),
                    checkpoint=checkpoint,
                    resume=request.resume and checkpoint is not None and os.path.exists(checkpoint),
                )
                finish = functools.partial(self.finish_grid, problem) if last and request.preset == "grid" else None
                result = stage_request.train(
                    problem, f"grid, {round(nodes * reached)}³", finish, self.times, 1 if number else FIRST_STEPS
                )
                grid = problem.trained()
                problem.keep_exposures()
                del problem, finish
            if result.interrupted or (result.asked_to_stop and not last):
                return grid, dataclasses.replace(result, interrupted=True)
            if stages_file is not None:
                table = files.grid_table(grid, np.float32)
                state = {"nodes": nodes, "stages": number + 1, "share": reached, "asked_for_colours": self.colours}
                table.settings |= {"source": views.digest, **state, **self.exposures()}
                table.measured = result.measured
                save_table(stages_file, table)
        return grid, result

    def finish_grid(self, problem: grids.GridProblem) -> dict[str, float]:
        """Measure the table of a grid, as at the end of the preset ``grid``."""
        return self.session.watched_images.evaluate(
            files.field_of(self.grid_table(problem.trained()), self.request.types)
        )

    @property
    def times(self) -> float:
        """Ratio of all held-out views and those of measurements during a training."""
        return len(self.session.held_out) / len(self.session.watched_images.views)

    def visible(self, grid: NodeGrid) -> NodeGrid:
        """Return the part of a grid that the training views see."""
        return grids.divided(grid, grids.visible(grid, self.session.seeing_images))

    def grid_table(self, grid: NodeGrid) -> Table:
        """Return the table of the visible part of a grid."""
        return files.grid_table(self.visible(grid))

    def wanted_bytes(self, grid: NodeGrid) -> int | None:
        """Return the bytes in memory that the options ask for, or ``None``."""
        options = self.request.options
        if options["bytes"] is not None:
            return units.parse_bytes(options["bytes"])
        if options["compression"] is not None:
            return round(dense_bytes(grid.nodes.shape) / units.parse_compression(options["compression"]))
        return None

    def train(self, problem: ImagesProblem, stopped: bool, finish: Callable[[], object], suffix: str = "") -> FitResult:
        """Train a problem through the images, with the checkpoint of the request and a ``suffix``; then ``finish``.

        If the training of the grid was ``stopped``, the problem is only measured, so that its state is kept; a resumed
        run then continues with the grid.
        """
        request = self.request
        if stopped:
            return FitResult(problem.measure(problem.net), 0, 0, 0.0, True, 0)
        if request.checkpoint is not None:
            path, resume = f"{request.checkpoint}{suffix}", request.resume
            if resume and not os.path.exists(path):
                # The interrupted part may have been the grid, or a smaller size
                before = [f"{request.checkpoint}.{name}" for name in ("stage0", "grid.npz")]
                resume = not suffix and not any(map(os.path.exists, before))
            request = dataclasses.replace(request, checkpoint=path, resume=resume)
        return request.train(problem, "through the images", finish, self.times)

    def sparse(self, grid: NodeGrid, stopped: bool) -> tuple[Table, FitResult, VolumeField]:
        """Compress a grid to density levels and a palette, in the bytes or to the PSNR that the options ask for."""
        options = self.request.options
        if options["psnr"] is not None:
            return self.smallest(grid, float(options["psnr"]), stopped)
        if options.get("disk") is not None:
            return self.in_file(grid, units.parse_bytes(options["disk"]), stopped)
        try:
            smaller, bits = compression.sized(grid, self.session.seeing_images, self.wanted_bytes(grid))
        except ValueError as e:
            given = "bytes" if options["bytes"] is not None else "compression"
            raise UsageError(f"--{given}: {e}") from None
        return self.compressed(smaller, bits, stopped)

    def compressed(self, grid: NodeGrid, bits: int, stopped: bool, suffix: str = "", slope: float = compression.SLOPE):
        """Train a palette of at most ``2**bits`` colours on a grid; return the table, the result and the field."""
        limit = self.request.part(CLUSTER_TIME).deadline
        weights = self.importance(grid)
        coding = compression.palette_coding(grid, weights, bits, self.request.settings.seed, slope, limit)
        return self.coded(coding, stopped, suffix)

    def importance(self, grid: NodeGrid) -> Importance:
        """Return the importance of the nodes of a grid."""
        settings = self.request.settings
        with cores(settings.deterministic):
            return importance(grid, self.session, settings.seed, self.request.part(CLUSTER_TIME).deadline)

    def coded(self, coding: compression.PaletteCoding, stopped: bool, suffix: str = ""):
        """Train a coding; return the table, the result and the field."""
        problem = compression.PaletteProblem(coding, self.session)

        def stored() -> tuple[Table, VolumeField]:
            table = files.palette_table(coding.nodes, problem.stored())
            return table, files.field_of(table, self.request.types)

        result = self.train(problem, stopped, lambda: self.session.watched_images.evaluate(stored()[1]), suffix)
        problem.keep_exposures()
        table, field = stored()
        return table, result, field

    def in_file(self, grid: NodeGrid, nbytes: int, stopped: bool):
        """Compress a grid to a file of at most ``nbytes``, at the highest resolution that allows it."""
        if nbytes < 2 * compression.OTHER_BYTES:
            raise UsageError(f"--disk: {nbytes:,} bytes are fewer than a file needs")
        cells = grids.visible(grid, self.session.seeing_images)
        for share in SHARES:
            smaller = grids.divided(grid, cells, share)
            limit = self.request.part(CLUSTER_TIME).deadline
            coding = compression.coding_in(smaller, self.importance(smaller), nbytes, self.request.settings.seed, limit)
            if coding is not None:
                return self.coded(coding, stopped)
        raise UsageError(f"--disk: {nbytes:,} bytes are fewer than the smallest file of this capture needs")

    def smallest(self, grid: NodeGrid, psnr: float, stopped: bool):
        """Return the first size of :data:`LADDER` that reaches a PSNR in decibels over white, else the largest tried.

        It is found by bisection. With a limit of time, a size that would take longer than what is left is not tried.
        """
        cells = grids.visible(grid, self.session.seeing_images)
        limit, duration = self.request.deadline, 0.0
        low, high, best, largest = 0, len(LADDER), None, None
        while low < high:
            if limit is not None and limit.left() < duration:
                print(f"warning: the time did not allow the last {high - low} of {len(LADDER)} sizes", file=sys.stderr)
                break
            start = time.perf_counter()
            number = (low + high) // 2
            share, bits, slope = LADDER[number]
            smaller = grids.divided(grid, cells, share)
            trainings = (high - low).bit_length()
            size = dataclasses.replace(self, request=self.request.part(1 / trainings))
            fitted = size.compressed(smaller, bits, stopped, f".size{number}", slope)
            reached = self.session.held_out_images.evaluate(fitted[2])["psnr_white_db"]
            duration = time.perf_counter() - start
            on_disk = sum(len(zlib.compress(array.entries, 9)) for array in fitted[0].arrays.values())
            print(f"{on_disk:,} bytes on disk: {reached:.2f} dB over white", file=sys.stderr)
            if fitted[1].interrupted:
                return fitted
            if reached >= psnr:
                best, high = fitted, number
            else:
                low, largest = number + 1, (fitted, reached)
        if best is None:
            fitted, reached = largest
            print(f"warning: {psnr:g} dB were not reached, the largest size has {reached:.2f} dB", file=sys.stderr)
        return best or fitted

    def pairs(self, grid: NodeGrid, stopped: bool) -> tuple[Table, FitResult, VolumeField]:
        """Compress a grid to the pairs of dense arrays of the supplement."""
        nbytes = self.wanted_bytes(grid) or dense_bytes(grid.nodes.shape) / COMPRESSION
        visible = self.visible(grid)
        problem = self.pairs_problem(visible, nbytes, 0 if stopped else VALUE_STEPS)

        def stored() -> tuple[Table, VolumeField]:
            arrays = {}
            for name in ("density", "colour"):
                pair = getattr(problem.net, name)
                arrays[f"{name}_primary"] = StoredArray.of(pair.primary[0].quantised(8))
                arrays[f"{name}_cascaded"] = StoredArray.of(pair.cascaded.quantised(8))
            table = files.pairs_table(visible.nodes, arrays, problem.low, problem.high)
            return table, files.field_of(table, self.request.types)

        result = self.train(problem, stopped, lambda: self.session.watched_images.evaluate(stored()[1]))
        table, field = stored()
        return table, result, field

    def pairs_problem(self, grid: NodeGrid, nbytes: float, steps: int) -> paper.PairsProblem:
        """Return the arrays of the supplement in ``nbytes``, trained on the numbers of the grid for ``steps``."""
        request, types = self.request, self.request.types
        ratio = dense_bytes(grid.nodes.shape) / nbytes
        extent = np.array(grid.nodes.upper) - np.array(grid.nodes.lower)
        shapes = {}
        for name, channels, share in (("density", 1, DENSITY_SHARE), ("colour", 12, 1 - DENSITY_SHARE)):
            given = request.options.get(f"{name}_ratio") or ratio_for(name, ratio)
            shapes[name] = paper.sides(share * nbytes, given, channels, extent)
        density, colour, low, high = paper.initial(paper.dense(grid), shapes, types)
        net = paper.PairsNet(density, colour)
        field = paper.PairsField(grid.nodes, density, colour, low, high)
        if steps:
            settings = dataclasses.replace(
                request.settings, steps=steps, batch=VALUE_BATCH, lr=VALUE_RATE, measure_every=steps
            )
            values = paper.ValuesProblem(net, field, grid)
            limited = dataclasses.replace(request.part(VALUE_TIME), settings=settings, checkpoint=None, resume=False)
            limited.train(values, "the numbers of the grid")
        return paper.PairsProblem(net, grid.nodes, low, high, self.session)


def rounded_figures(measured: dict[str, float]) -> dict[str, float]:
    """Return measured figures with five digits, as a table keeps them."""
    return {name: float(f"{value:.5g}") for name, value in measured.items()}
