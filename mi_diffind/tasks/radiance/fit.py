"""``fit field``: from a folder of views to a grid, from a grid to a compressed field, trained and measured."""

import dataclasses
import functools
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import numpy as np

from ...arrays.tables import MAX_BYTES, Table, save_table
from ...core import units
from ...core.errors import UsageError, raised_as
from ...core.files import check_distinct
from ...core.progress import Deadline, interruptible
from ...fitting.loop import FitResult, FittingError, cores
from ...fitting.task import FitRequest, Fitted, Stage, significant
from . import COLOURS, PRESETS, RESOLUTIONS, compression, dense_bytes, files, paper, ratio_for, scale_steps
from . import grid as grids
from .grid import NodeGrid
from .session import MOST_WATCHED_LIMITED, SIDE, FieldSession, ImagesProblem

#: Stages of the grid from coarse to fine: share of the resolution, and share of the training steps. Between them, cells
#: that no ray sees are removed.
STAGES = ((0.25, 0.08), (0.5, 0.12), (0.75, 0.12), (1.0, 0.1), (1.0, 0.58))

#: Most numbers of the nodes of a grid while it is trained, which bounds memory and time: grids with more stay coarser,
#: unless the resolution is given. In the last stage, a third of them has been removed.
MOST_NUMBERS = 36_000_000

#: Steps of the training of pairs on the numbers of the grid, before the images.
VALUE_STEPS = 300

#: Share of the bytes of the supplement's arrays that the density gets.
DENSITY_SHARE = 0.35

#: Gain in decibels at which a trial chooses reflections.
WORTH = 0.15

#: Pixels of held-out views that are measured, and of training views in which visible cells are sought, for each second
#: of a limited time.
PIXELS = 40_000

#: Ends of the names of files of 3D Gaussians.
SPLATS = (".ply", ".sog", ".spz", ".splat", ".ksplat", ".lcc")


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that do not go together."""
    options, preset = request.options, request.preset
    if options["source"] is None:
        raise UsageError("source: not given, a folder of views is needed")
    path = Path(options["source"])
    if path.suffix.lower() in SPLATS:
        raise UsageError(
            f"source: {path} is a file of 3D Gaussians, a folder of views is needed: "
            f"mi-diffind capture {path.name} -o {path.stem}_views --views 80 --resolution 200"
        )
    sized = next((name for name in ("bytes", "compression", "disk") if options.get(name) is not None), "")
    reflections, surroundings = options.get("colours") == "reflections", options.get("background") == "surroundings"
    is_paper, given = preset == "paper", f"the preset {preset}"
    for wrong, message in (
        (preset == "grid" and sized, f"--{sized} is an option of the presets sparse and paper, found {given}"),
        (not is_paper and options.get("density_ratio"), f"--density-ratio: found {given}, allowed is paper"),
        (not is_paper and options.get("colour_ratio"), f"--colour-ratio: found {given}, allowed is paper"),
        (is_paper and options.get("disk"), f"--disk is an option of the preset sparse, found {given}"),
        (is_paper and surroundings, f"--background: found surroundings with {given}, whose box has an end"),
        (is_paper and reflections, f"--colours: found reflections with {given}, allowed is directions"),
        (surroundings and reflections, "--colours: found reflections with --background surroundings, allowed is "
         "directions"),
    ):  # fmt: skip
        if wrong:
            raise UsageError(message)
    for name in ("bytes", "disk"):
        if options.get(name) is not None:
            units.check_size(f"--{name}", options[name], MAX_BYTES)
    nodes = options["resolution"] or RESOLUTIONS[0]
    units.check_memory("--resolution", nodes, 24 * nodes**3)  # bytes for each node of the dense grid, roughly
    if request.checkpoint is not None:
        parts = ("grid.npz", *(f"stage{n}" for n in range(len(STAGES))))
        beside = [f"{os.fspath(request.checkpoint)}.{part}" for part in parts]
        check_distinct({"-o": request.output, "--grid": options["grid"]}, {"a file beside --checkpoint": beside})


def fit(request: FitRequest) -> Fitted:
    """Fit a field to the views in a folder.

    Raises :class:`UsageError`, :class:`.views.ViewsError`, :class:`.TableError` and
    :class:`.FittingError`.
    """
    pixels = None if request.deadline is None else PIXELS * request.deadline.seconds
    reading = {name: request.options.get(name) for name in ("background", "downscale")}
    session = FieldSession.load(request.types, request.options["source"], pixels, progress=request.progress, **reading)
    settings = scale_steps(request.preset, request.settings, session.views)
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
        if request.preset == "grid":
            table, result = self.grid_table(grid), grid_result
        else:
            stopped = grid_result is not None and grid_result.interrupted
            table, result = (self.sparse if request.preset == "sparse" else self.pairs)(grid, stopped)
        field = files.field_of(table, request.types)
        measured = session.held_out_images.evaluate(field, ssim=True)
        table.preset, table.seed = request.preset, request.settings.seed
        table.settings = {
            **request.recorded(result),
            "source": session.views.digest,
            **session.views.settings,
            **({"downscale": options["downscale"]} if options.get("downscale") else {}),
            **request.paths(capture_path=options["source"], grid_path=options["grid"] or None),
            "warnings": warnings,
            **table.settings,
        }
        table.measured = significant(measured)
        dense = dense_bytes(grid.nodes.shape)
        seconds = time.perf_counter() - start - grid_seconds
        lines = [f"{grid_seconds:.1f} s for the grid, {seconds:.1f} s for the rest"]
        if request.preset != "grid" and grid_result is not None and grid_result.unfinished:
            steps = f"{grid_result.steps} step{'s' if grid_result.steps != 1 else ''}"
            lines.append(f"the grid was trained for {steps}: unfinished")
        if request.deadline is not None:
            lines.append(f"measured in {len(session.held_out)} held-out views")
        if size := getattr(field, "nbytes", None):
            lines.append(f"{size:,} bytes in memory, {dense / size:.0f} times less than the dense grid of float32")
        figures = {"grid_seconds": grid_seconds, "dense_bytes": dense, "memory_bytes": size, "warnings": warnings}
        return Fitted(table, result, lines, {**figures, "notes": session.notes})

    # -- the grid ------------------------------------------------------------------------------------------------------

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
            return files.grid_of(table, request.types), None
        grid, result = self.trained_grid()
        if path and not result.interrupted:  # the next run would take an interrupted grid for a finished one
            table = self.grid_table(grid)
            table.preset, table.settings = "grid", {**table.settings, "source": views.digest}
            visible = files.field_of(table, request.types)  # in half precision
            table.measured = significant(self.session.held_out_images.evaluate(visible, ssim=True))
            save_table(path, table)
            grid = files.grid_of(files.load(path), request.types)
        return grid, result

    def trained_grid(self) -> tuple[NodeGrid, FitResult]:
        """Train a grid in stages.

        With a checkpoint, each stage has one of its own beside it, and the grid of the last finished stage is kept in
        ``CHECKPOINT.grid.npz``.
        """
        request, views, settings = self.request, self.session.views, self.request.settings
        if request.preset != "grid":
            same = {name: getattr(settings, name) for name in ("seed", "deterministic")}
            settings = scale_steps("grid", dataclasses.replace(PRESETS["grid"], **same), views)
            request = request.part(0.6)  # of the time
        nodes = request.options["resolution"] or grids.resolution(views)
        grid, finished, reached, result = self.kept_grid(nodes)
        for number, (share, part) in enumerate(STAGES[finished:], finished):
            last = number + 1 == len(STAGES)
            dr.flush_malloc_cache()  # of the stage before
            with interruptible() as stop:
                grid, reached = self.refined(grid, nodes, share, reached, last)
            if stop.is_set() and result is not None:
                return grid, dataclasses.replace(result, interrupted=True)
            if grid.nodes.count == 0:
                raise FittingError(f"{views.path}: the views are empty, or the training made the field empty")
            steps = max(1, round(settings.steps * part))
            schedule, every = "cosine" if last else "constant", max(1, steps // 2)
            stage = dataclasses.replace(settings, steps=steps, schedule=schedule, measure_every=every)
            limited = request.part(part / sum(later for _, later in STAGES[number:]))
            if share == 0.5 and self.colours != "directions":
                tried = dataclasses.replace(stage, steps=min(steps, 600))  # steps of each colour
                grid, chosen = self.with_colours(grid, dataclasses.replace(limited, settings=tried))
                if chosen is not None:
                    result = chosen
                    over = chosen.interrupted or chosen.asked_to_stop or request.deadline is not None
                    steps = 0 if over else steps - chosen.steps
            if steps:
                problem, grid = grids.GridProblem(grid, self.session, SIDE if last else 1), None
                if number:
                    problem.cumulative = self.session.images.cumulative_errors(problem.field_of(problem.net))
                finish = functools.partial(self.measured, lambda p=problem: self.grid_table(p.grid()))
                finish = finish if last and request.preset == "grid" else None
                stage, title = dataclasses.replace(stage, steps=steps), f"grid, {round(nodes * reached)}³"
                least = 1 if number else 100  # a field that nobody sees has no second stage
                stages = [Stage(f"stage{number}", problem, 1.0, stage, title, finish, self.times, least)]
                (result,) = limited.run(stages)
                grid = problem.grid()
                del problem, finish, stages
            if result.interrupted or (result.asked_to_stop and not last):
                return grid, dataclasses.replace(result, interrupted=True)
            if request.checkpoint is not None:
                table = files.grid_table(grid, np.float32)
                state = {"nodes": nodes, "stages": number + 1, "share": reached, "asked_for_colours": self.colours}
                table.settings, table.measured = {**table.settings, "source": views.digest, **state}, result.measured
                save_table(f"{request.checkpoint}.grid.npz", table)
        return grid, result

    def kept_grid(self, nodes: int) -> tuple[NodeGrid | None, int, float, FitResult | None]:
        """Return the grid that a checkpoint keeps, its finished stages, its share of the resolution, and its result.

        The result is there if all stages are finished. Without a checkpoint, there is no grid.
        """
        request, path = self.request, Path(f"{self.request.checkpoint}.grid.npz")
        if request.checkpoint is None or not request.resume or not path.exists():
            return None, 0, STAGES[0][0], None
        table = files.load(path)
        if table.settings.get("source") != self.session.views.digest or table.settings.get("nodes") != nodes:
            raise FittingError(f'the checkpoint "{path}" has other views or another resolution')
        if table.settings.get("asked_for_colours") != self.colours:
            raise FittingError(f'the checkpoint "{path}" was made with another option --colours')
        finished = table.settings["stages"]
        result = FitResult(table.measured, 0, 0, 0.0, False, 0) if finished == len(STAGES) else None
        return files.grid_of(table, request.types), finished, table.settings["share"], result

    def refined(self, grid: NodeGrid | None, nodes: int, share: float, reached: float, last: bool) -> tuple:
        """Return the grid of a stage of a ``share`` of the resolution, and the share that it has.

        ``grid`` is that of the stage before, with the share ``reached``; ``None`` at the first stage.
        """
        images, asked = self.session.seeing_images, self.request.options["resolution"]
        if grid is None:
            return grids.initial_grid(self.request.types, images.views, max(8, round(nodes * share))), reached
        visible, factor = grids.visible(grid, images), 1.0
        if share < 1:  # at full resolution, no further cells are needed, but memory and time would be
            visible = grids.dilate(visible)
        if not last:
            factor = grids.largest_factor(grid, visible, share / reached, np.inf if asked else MOST_NUMBERS)
        reached *= factor
        if share == 1 and not last and reached < 0.99:
            print(
                f"resolution: {round(nodes * reached)}³, since {nodes}³, as fine as the pixels, is more than "
                f"{MOST_NUMBERS:,} numbers; --resolution decides",
                file=sys.stderr,
            )
        return grids.refine(grid, visible, factor), reached

    @property
    def colours(self) -> str:
        """Colours of :data:`.COLOURS`, or "auto": those that show left-out views best (:meth:`with_colours`)."""
        views, chosen = self.session.views, self.request.options.get("colours")
        simple = self.request.preset == "paper" or views.surroundings or len(views) < 16  # views that a trial needs
        return chosen or ("directions" if simple else "auto")

    def with_colours(self, grid: NodeGrid, trial: FitRequest) -> tuple[NodeGrid, FitResult | None]:
        """Return a grid with the colours that the options ask for or, by default, those that show more.

        By default, both colours are trained as the request ``trial`` says, by seven eighths of the views. Reflections
        are chosen if the other views gain :data:`WORTH` decibels. The result of the training of the returned grid is
        returned, too.
        """
        if self.colours == "reflections":
            return grid.with_reflections(), None
        views, seen = self.session.views, np.arange(len(self.session.views)) % 8 != 4
        left_out = views.chosen(np.flatnonzero(~seen))
        left_out = left_out.spread(min(MOST_WATCHED_LIMITED, len(left_out)))
        session = dataclasses.replace(self.session, views=views.chosen(np.flatnonzero(seen)), held_out=left_out)
        settings = dataclasses.replace(trial.settings, measure_every=trial.settings.steps)
        trained, reached = [], []
        for number, start in enumerate((grid, grid.with_reflections())):
            problem, title = grids.GridProblem(start, session, 1), f"trial of colours: {COLOURS[1 - number]}"
            (result,) = trial.run([Stage("", problem, 1 / (2 - number), settings, title, resumable=False)])
            trained.append((problem.grid(), result))
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

    def measured(self, table: Callable[[], Table]) -> dict[str, float]:
        """Measure the field of a table in the watched views."""
        return self.session.watched_images.evaluate(files.field_of(table(), self.request.types))

    @property
    def times(self) -> float:
        """Ratio of all held-out views and those of measurements during a training."""
        return len(self.session.held_out) / len(self.session.watched_images.views)

    def visible(self, grid: NodeGrid) -> NodeGrid:
        """Return the part of a grid that the training views see."""
        return grids.refine(grid, grids.visible(grid, self.session.seeing_images))

    def grid_table(self, grid: NodeGrid) -> Table:
        """Return the table of the visible part of a grid."""
        return files.grid_table(self.visible(grid))

    # -- compression ---------------------------------------------------------------------------------------------------

    def wanted_bytes(self, grid: NodeGrid) -> int | None:
        """Return the bytes in memory that the options ask for, or ``None``."""
        nbytes, ratio = (self.request.options.get(name) for name in ("bytes", "compression"))
        return nbytes or (ratio and round(dense_bytes(grid.nodes.shape) / ratio))

    def train(self, problem: ImagesProblem, table: Callable[[], Table], stopped: bool) -> tuple[Table, FitResult]:
        """Train a problem through the images; return its ``table`` and the result.

        If the training of the grid was ``stopped``, the problem is only measured, so that its state is kept; a resumed
        run then continues with the grid.
        """
        request = self.request
        if stopped:
            return table(), FitResult(problem.measure(problem.net), 0, 0, 0.0, True, 0)
        if request.checkpoint and request.resume and not os.path.exists(request.checkpoint):
            # The interrupted part may have been the grid
            before = [f"{request.checkpoint}.{name}" for name in ("stage0", "grid.npz")]
            request = dataclasses.replace(request, resume=not any(map(os.path.exists, before)))
        finish = functools.partial(self.measured, table)
        stage = Stage("", problem, title="through the images", finish=finish, times=self.times)
        (result,) = request.run([stage])
        return table(), result

    def sparse(self, grid: NodeGrid, stopped: bool) -> tuple[Table, FitResult]:
        """Compress a grid to density levels and a palette, in the bytes that the options ask for."""
        disk, seed = self.request.options.get("disk"), self.request.settings.seed
        if disk is not None:
            coding = self.coding_in_file(grid, disk)
        else:
            given = "bytes" if self.request.options["bytes"] is not None else "compression"
            with raised_as(UsageError, ValueError, at=f"--{given}"):
                grid, bits = compression.in_memory(grid, self.session.seeing_images, self.wanted_bytes(grid))
            importance, limit = self.importance(grid)
            palette = compression.sorted_clusters(grid, importance, limit, 2**bits, seed)
            rate = compression.SLOPE * importance.loss / grid.nodes.count
            coding = compression.choose_coding(grid, importance, palette, rate)
        problem = compression.PaletteProblem(coding, self.session)
        return self.train(problem, lambda: files.palette_table(coding.nodes, problem.numbers()), stopped)

    def importance(self, grid: NodeGrid) -> tuple[compression.Importance, Deadline | None]:
        """Return the importance of the nodes of a grid, and the deadline of its clusters, if time is limited."""
        settings, limit = self.request.settings, self.request.part(0.25).deadline
        with cores(settings.deterministic):
            return compression.importance(grid, self.session, settings.seed, limit), limit

    def coding_in_file(self, grid: NodeGrid, nbytes: int) -> compression.PaletteCoding:
        """Return the coding of a grid in a file of at most ``nbytes``, at the highest resolution that allows it."""
        if nbytes < 2 * compression.OTHER_BYTES:
            raise UsageError(f"--disk: {nbytes:,} bytes are fewer than a file needs")
        cells, seed = grids.visible(grid, self.session.seeing_images), self.request.settings.seed
        for share in (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2):  # of the resolution
            smaller = grids.refine(grid, cells, share)
            coding = compression.coding_in(smaller, *self.importance(smaller), nbytes, seed)
            if coding is not None:
                return coding
        raise UsageError(f"--disk: {nbytes:,} bytes are fewer than the smallest file of this capture needs")

    def pairs(self, grid: NodeGrid, stopped: bool) -> tuple[Table, FitResult]:
        """Compress a grid to the pairs of dense arrays of the supplement."""
        nbytes = self.wanted_bytes(grid) or dense_bytes(grid.nodes.shape) / 50  # as the help says
        grid = self.visible(grid)
        problem = self.pairs_problem(grid, nbytes, 0 if stopped else VALUE_STEPS)
        return self.train(problem, lambda: files.pairs_table(problem.field()), stopped)

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
        if steps:
            values = paper.ValuesProblem(net, paper.PairsField(grid.nodes, density, colour, low, high), grid)
            settings = {"steps": steps, "batch": 2**15, "lr": 1e-2, "measure_every": steps}
            settings = dataclasses.replace(request.settings, **settings)
            request.run([Stage("", values, 0.2, settings, "the numbers of the grid", resumable=False)])
        return paper.PairsProblem(net, grid.nodes, low, high, self.session)
