"""``fit scene SCENE.xml``: training of textures by differentiating renders of a scene that shows them."""

import contextlib
import dataclasses
import gc
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ...arrays.tables import Table, move_paths, save_table
from ...core import compat
from ...core.errors import UsageError
from ...core.files import replacing, writable_folder
from ...core.progress import profiled
from ...core.units import figure_lines
from ...fitting.loop import FitResult, cores
from ...fitting.task import FitRequest, Fitted, Model, find_task, table_path, tasks
from ...maps.model import preview_path
from ...tasks.texture.training import TextureProblem
from .. import loading
from .options import FOOTPRINTS, SceneRecipe, ViewDistribution, recipe_from, views_from
from .problem import FINER, SceneProblem
from .references import ReferenceRenders
from .rig import small_ranges
from .trained_scene import JointProblem, SceneTexture, TrainedScene, load_textures

#: Samples of a trained view's reference for each of a held-out view's, whose noise the measurement does not count.
FEWER = 4

#: Smallest number of samples of a held-out view's reference, if a trained view's has not fewer.
LEAST = 128

#: Largest number of held-out views if time is limited: their references and measurements have more samples.
HELD_OUT_WHEN_TIMED = 8

#: Share of a limited time for the references.
REFERENCES = 0.25

#: Share of a limited time for a measurement of renders.
MEASURING = 0.1

#: Duration of a training step, in renders of one sample a pixel.
STEP_RENDERS = 20

#: Duration of the compilation of a step, in that of a render: a step renders three times, once with derivatives, whose
#: kernel is four times as long.
STEP_KERNELS = 8

#: Seconds that LLVM takes to compile one operation of a render's kernel.
OPERATION = 3e-4


def fit(request: FitRequest) -> Fitted:
    """Train textures of a scene as requested on the command line, in the active variant.

    The result of several is a :class:`FittedFiles`.
    """
    options = request.options
    views, recipe = views_from(options, request.settings.seed), recipe_from(options, request.settings)
    parsed = loading.ParsedScene(options["source"], dict(options["defines"] or ()))
    tables, result = fit_scene(
        parsed, views, recipe, request, as_list(options["texture"]), options["references"], preview_path(request),
        as_list(options["start"]),
    )  # fmt: skip
    table = next(iter(tables.values()))
    views = ViewDistribution(**table.settings["views"])
    lines = [*score_lines(views, recipe, result), *filter(None, [table.settings.get("remark")])]
    if table.settings.get("kept_start"):
        lines.append("training inside the scene gained nothing: these are the arrays that it started from")
    if (samples := table.settings.get("reference_samples", recipe.reference_spp)) < recipe.reference_spp:
        lines.append(
            f"the time allowed references of {samples} samples a pixel in place of {recipe.reference_spp}: figures in "
            "the scene are rough"
        )
    if len(tables) > 1:
        return FittedFiles(table, result, lines, {"views": dataclasses.asdict(views)}, tables=tables)
    return Fitted(table, result, lines, {**array_figures(table), "views": dataclasses.asdict(views)})


def score_lines(views: ViewDistribution, recipe: SceneRecipe, result: FitResult) -> list[str]:
    """Return the lines that say where training took place, and which views its figure was measured on."""
    if not views.moves:
        return ["the scene's own view", "training score: trained and measured on the same view"]
    count, others = len(views.trained()), len(views.measured())
    drawn = {name: getattr(views, name) for name in ("azimuth", "elevation", "distance", "light_azimuth",
                                                      "light_elevation")}  # fmt: skip
    ranges = [f"{name.replace('_', '-')} {span[0]:.3g}:{span[1]:.3g}" for name, span in drawn.items() if span]
    ranges += ["origins in a box"] if views.origins else []
    before = f"{result.history[0]['psnr_db']:.2f} → " if result.history and result.history[0]["step"] == 0 else ""
    footprints = " and ".join(str(factor * recipe.spp) for factor in FOOTPRINTS)
    return [
        f"{count} view{'s' if count != 1 else ''}: {', '.join(ranges)}",
        f"{others} held-out view{'s' if others != 1 else ''}: {before}{result.measured['psnr_db']:.2f} dB, "
        f"mean of footprints of {footprints} samples a pixel",
    ]


def array_figures(table: Table) -> dict[str, dict]:
    """Return the shapes and the bits of all arrays by their names, as reports contain them."""
    arrays = table.arrays.items()
    return {"arrays": {name: list(a.shape) for name, a in arrays}, "bits": {name: a.bits for name, a in arrays}}


def as_list(files) -> list:
    """Return the files of an option that may be repeated; from Python, also a single one."""
    return [files] if isinstance(files, (str, os.PathLike)) else list(files or ())


def fit_scene(
    parsed: loading.ParsedScene,
    views: ViewDistribution,
    recipe: SceneRecipe,
    request: FitRequest,
    files: Sequence[str | os.PathLike] = (),
    references: str | os.PathLike | None = None,
    preview: Path | None = None,
    starts: Sequence[str | os.PathLike] = (),
) -> tuple[dict[str, Table], FitResult]:
    """Train the arrays of textures of a scene for the ``views``.

    Returns the stored tables, by the names of their files, and the run's record. ``files`` are those of the textures,
    by default all that the scene reads and that hold arrays. They are trained together, through the same renders.
    ``request`` gives duration and checkpoint; its settings are those of the ``recipe``. ``references`` is a folder that
    keeps the reference images; ``preview`` a picture that is written at each measurement; ``starts`` files whose arrays
    and level bias the training starts from, in place of the textures'. Several ``views`` without any range get small
    ones (:func:`.rig.small_ranges`). If no state renders the held-out views better than the start
    (:meth:`.SceneProblem.gains`), the tables hold the start (setting ``kept_start``). Runs in the variant that is set.

    Raises :class:`.SceneError`, :class:`.UsageError`, :class:`.TableError`,
    :class:`~mi_diffind.maps.source.SourceError`, :class:`.FittingError` and :class:`.OutputError`.
    """
    request = dataclasses.replace(request, settings=recipe.settings)
    textures = load_textures(parsed, files, starts, recipe.start == "file")
    check_output(request.output, [texture.file for texture in textures])
    if views.count > 1 and not views.moves:
        views = small_ranges(parsed.load(parallel=False), views)
        gc.collect()  # the loaded scene: Dr.Jit compiles the materials of all loaded scenes into every kernel
    if request.deadline is not None:
        views = dataclasses.replace(views, held_out=min(views.held_out, HELD_OUT_WHEN_TIMED))
    rendered = ReferenceRenders(
        parsed, views, recipe.reference_spp, references, recipe.against,
        without=[texture.file for texture in textures], inputs=[texture.source.digest for texture in textures],
        progress=request.progress, deadline=request.part(REFERENCES).deadline,
        workers=request.options.get("workers"), scheduler=request.options.get("scheduler", ""),
    )  # fmt: skip
    trained, measured = views.trained(), views.measured()
    most = recipe.reference_spp
    fewer = min(most, max(LEAST, most // FEWER)) if views.moves else most
    halves = rendered.halves([*((view, most) for view in trained), *((view, fewer) for view in measured)])
    scene = TrainedScene(parsed, {texture.file: texture.table for texture in textures}, views)
    problem = SceneProblem(
        joint_problem({texture.file.name: texture.problem for texture in textures}), scene,
        [*zip(trained, halves, strict=False)], [*zip(measured, halves[len(trained) :], strict=True)],
        recipe, rendered.digest, preview,
    )  # fmt: skip
    problem.common |= {"views": dataclasses.asdict(views)}
    problem.identity |= problem.common

    def to_table(texture: SceneTexture, recorded: Mapping, more: Mapping) -> tuple[Table, dict[str, float]]:
        table = texture.to_table({**recorded, **texture.identity, **problem.common, **more})
        return table, texture.measure(table)

    remark, before = "", {}
    if request.deadline is not None:
        remark = limit(problem, request)
    factor = FINER if request.deadline is None else 1
    if recipe.start == "file":  # after the limit, which changes the samples of a measurement
        before = problem.measure_finely(factor)
    arrays = {name: array.data for name, array in problem.net.arrays.items()}
    result = request.train(problem, finish=lambda: [to_table(texture, {}, {}) for texture in textures])
    if factor > 1:
        result.measured = problem.measure_finely(factor)
    if before:
        result.history.insert(0, {"step": 0, "loss": None, **before})
    kept = bool(before) and not problem.gains(before, result.measured)
    if kept:
        for name, data in arrays.items():
            problem.net.arrays[name].data = data
        result.measured, result.step = before, 0
    result.unfinished = result.unfinished or bool(remark)
    more = request.paths(scene_path=None if parsed.description else parsed.path)
    more |= {"kept_start": True} if kept else {}
    more |= {"remark": remark} if remark else {}
    more |= {"reference_samples": rendered.samples} if rendered.samples < recipe.reference_spp else {}
    more |= {"trained_with": [t.file.name for t in textures]} if len(textures) > 1 else {}
    tables = {}
    for texture in textures:
        table, errors = to_table(texture, request.recorded(result), more)
        table.settings |= request.paths(source_path=texture.source_path)
        table.preset, table.seed = request.preset, recipe.settings.seed
        errors |= {f"psnr_scene_{spp}_spp_db": result.measured[f"psnr_{spp}_spp_db"] for spp in problem.footprints}
        table.measured = {k: float(f"{v:.5g}") for k, v in errors.items()}
        tables[texture.file.name] = table
    return tables, result


def joint_problem(problems: Mapping[str, TextureProblem]) -> TextureProblem | JointProblem:
    """Return the problem of all textures, by name: that of a single one as it is."""
    return JointProblem(problems) if len(problems) > 1 else next(iter(problems.values()))


def check_output(output: Path | None, files: Sequence[Path]) -> None:
    """Raise :class:`UsageError` unless the ``output`` suits the number of trained ``files``: one is a file."""
    if output is None:
        return
    if len(files) == 1:
        table_path(output)
        return
    names = ", ".join(file.name for file in files)
    if output.suffix.lower() == ".npz":
        raise UsageError(
            f'output "{output}": found a file, but {len(files)} textures are trained ({names}): give a '
            f"folder, as in -o trained/, or choose one by --texture"
        )
    if any(output.resolve() == file.parent for file in files):
        raise UsageError(f'output "{output}": found the folder of the trained textures ({names}): give another one')


def limit(problem: SceneProblem, request: FitRequest) -> str:
    """Fit a problem into a limited time, and return a sentence if only the texture alone can be trained, else "".

    A measurement of one render a view is rehearsed. Measurements then have so many samples as fit, and where a step
    would take longer than what is left, renders have no share in the loss. Its kernels are expected to be compiled
    unless the kernel of the measurement comes from Dr.Jit's cache, as after an earlier training of the scene.
    """
    deadline, spp, most = request.deadline, problem.recipe.spp, problem.samples
    problem.samples = spp
    with cores(request.settings.deterministic):
        _, seconds, history = profiled(lambda: problem.measure(problem.net))
    compiling = compat.compile_seconds(history)
    if not all(entry.get("cache_hit", True) for entry in history):
        compiling = max(compiling, OPERATION * max((entry.get("operation_count", 0) for entry in history), default=0))
    render = seconds / (2 * len(FOOTPRINTS) * len(problem.measured) * spp)
    problem.samples = max(spp, min(most, int(MEASURING * deadline.seconds * spp / seconds)))
    deadline.reserve += seconds * problem.samples / spp
    step = STEP_RENDERS * spp * render + STEP_KERNELS * compiling
    if problem.recipe.share == 0 or step < deadline.left():
        return ""
    problem.recipe = dataclasses.replace(problem.recipe, share=0.0)
    problem.identity["shading"]["share"] = 0.0
    kernels = f", {STEP_KERNELS * compiling:.0f} s of it to compile its kernels" if compiling > 1 else ""
    enough = deadline.seconds + 2 * step
    return (
        f"no step through renders: one takes about {step:.0f} s{kernels}; the texture was trained alone; give "
        f"--seconds {enough:.0f} or more, or a smaller film"
    )


@dataclass(repr=False)
class FittedFiles(Fitted):
    """Result of a training of several files: ``tables`` by the name of the file; ``table`` is the first of them."""

    tables: dict[str, Table] = field(default_factory=dict)

    @property
    def models(self) -> dict[str, Model]:
        """Model of each file, ready to be evaluated, measured and decoded."""
        return {n: find_task(table).model(table, self.request.types.TensorXf) for n, table in self.tables.items()}

    @property
    def model(self) -> Model:
        """Raise :class:`UsageError`: there are several (:attr:`models`)."""
        raise UsageError(f"model: {len(self.tables)} files were trained, models has one for each")

    @property
    def report(self) -> dict:
        """All figures of the result; those of each file are in ``files``, by name."""
        common = {k: v for k, v in super().report.items() if k not in ("settings", "measured")}
        files = {
            name: {
                "bytes": table.nbytes, "settings": table.settings, "measured": table.measured, **array_figures(table)
            }
            for name, table in self.tables.items()
        }  # fmt: skip
        return {**common, "bytes": sum(table.nbytes for table in self.tables.values()), "files": files}

    def save(self, path: str | os.PathLike) -> Path:
        """Write all files into the folder ``path``, each under its name, and return the folder.

        The folder is created if its parent exists. Files are replaced once all of them are written. Raises
        :class:`.OutputError`.
        """
        folder = writable_folder(path, create=True)
        with contextlib.ExitStack() as stack:
            for name, table in self.tables.items():
                settings = table.settings
                if self.request is not None:
                    settings = move_paths(settings, self.request.folder, folder.resolve())
                save_table(stack.enter_context(replacing(folder / name)), dataclasses.replace(table, settings=settings))
        return folder

    def summary(self, path: str | os.PathLike = "FOLDER") -> list[str]:
        """Return the result as lines of text: bytes and accuracy of each file, remarks, and how scenes name them."""
        lines = [f"{path}: {len(self.tables)} files; {self.result.outcome}"]
        for name, table in self.tables.items():
            lines.append(f"{Path(path) / name}: {table.nbytes:,} bytes as {table.storage}")
            lines += [f"  {line}" for line in figure_lines(table.measured)]
        lines += [f"  {line}" for line in self.lines]
        usage = [f"  {line}" for n, table in self.tables.items() for line in tasks()[table.task].usage(table, n)]
        return [*lines, *(["in a scene:"] if usage else []), *usage]
