"""``fit scene SCENE.xml``: training of a texture by differentiating renders of a scene that shows it."""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi

from .. import compat, scenes
from ..conversion import cache_folder
from ..deadline import profiled
from ..errors import UsageError
from ..files import writable_folder
from ..fitting import FitResult, cores
from ..maps.arguments import preview_path
from ..maps.source import load_source
from ..tables import Table
from ..task import FitRequest, Fitted
from ..tasks.texture.compressed import CompressedTexture, bias_of, load, to_table
from ..tasks.texture.training import problem_of, stored_form
from .problem import SceneProblem
from .recipe import SceneRecipe, recipe_of
from .reference_renders import ReferenceRenders
from .stored_texture import budget_of, original_of, texture_file, texture_problem
from .trained_scene import TrainedScene
from .views import ViewDistribution, views_of

#: Shares of a limited time: that of the references, and that of a measurement of renders.
REFERENCES, MEASURING = 0.25, 0.1

#: Duration of a step in renders of one sample a pixel, and of the compilation of its kernels in that of a render's: a
#: step renders three times, once with derivatives, whose kernel is four times as long.
STEP_RENDERS, STEP_KERNELS = 20, 8

#: Seconds that LLVM takes to compile one operation of a render's kernel.
OPERATION = 3e-4


def fit(request: FitRequest) -> Fitted:
    """Train a texture of a scene as requested on the command line, in the active variant."""
    options = request.options
    views, recipe = views_of(options, request.settings.seed), recipe_of(options, request.settings)
    parsed = scenes.ParsedScene(options["source"], dict(options["defines"] or ()))
    table, result = fit_scene(
        parsed, views, recipe, request, options["texture"], options["references"], preview_path(request),
        options["start"],
    )  # fmt: skip
    figures = {
        "arrays": {name: list(a.shape) for name, a in table.arrays.items()},
        "bits": {name: a.bits for name, a in table.arrays.items()},
        "views": dataclasses.asdict(views),
    }
    count = len(views.trained())
    lines = [
        f"{count} view{'s' if count != 1 else ''}, {recipe.spp} sample{'s' if recipe.spp != 1 else ''} a pixel",
        *filter(None, [table.settings.get("remark")]),
    ]
    if table.settings.get("kept_start"):
        lines.append("training inside the scene gained nothing: these are the arrays that it started from")
    if (samples := table.settings.get("reference_samples", recipe.reference_spp)) < recipe.reference_spp:
        lines.append(f"the time allowed references of {samples} samples a pixel in place of {recipe.reference_spp}")
    return Fitted(table, result, lines, figures)


def fit_scene(
    parsed: scenes.ParsedScene,
    views: ViewDistribution,
    recipe: SceneRecipe,
    request: FitRequest,
    file: str | os.PathLike | None = None,
    references: str | os.PathLike | None = None,
    preview: Path | None = None,
    start: str | os.PathLike | None = None,
) -> tuple[Table, FitResult]:
    """Train the arrays of a texture of a scene for the ``views``, and return the stored table and the run's record.

    ``file`` is the texture's file, needed if the scene reads several. ``request`` gives duration and checkpoint; its
    settings are those of the ``recipe``. ``references`` is a folder that keeps the reference images; ``preview`` a
    picture that is written at each measurement; ``start`` a file whose arrays and level bias the training starts from,
    in place of the texture's. If no state renders the held-out views better than the start, the table holds the start
    (setting ``kept_start``). Runs in the variant that is set.

    Raises :class:`~mi_diffind.scenes.SceneError`, :class:`~mi_diffind.errors.UsageError`,
    :class:`~mi_diffind.tables.TableError`, :class:`~mi_diffind.maps.source.SourceError`,
    :class:`~mi_diffind.fitting.FittingError` and :class:`~mi_diffind.files.OutputError`.
    """
    request = dataclasses.replace(request, settings=recipe.settings)
    file, given = texture_file(parsed, file)
    table = load(file)
    source_path = original_of(table, file, given)
    source = load_source(source_path, nonfinite="clean")
    if start is not None:
        table = started(start, table)
    texture = texture_problem(table, source)
    bias = bias_of(table.settings)
    if recipe.start == "untrained":
        texture = problem_of(source, budget_of(table), texture.recipe, texture.pyramid)
        table = to_table(CompressedTexture(texture.pyramid.layout, stored_form(texture.net), bias), {})
    rendered = ReferenceRenders(
        parsed, views, recipe.reference_spp, references, recipe.against,
        without=(file,), inputs=(source.digest,), progress=request.progress,
        deadline=request.part(REFERENCES).deadline,
    )  # fmt: skip
    trained, measured = views.trained(), views.measured()
    images = rendered.images([*trained, *measured])
    scene = TrainedScene(parsed, file, views, recipe.spp, table)
    problem = SceneProblem(
        texture, scene, [*zip(trained, images, strict=False)],
        [*zip(measured, images[len(trained) :], strict=True)], recipe, rendered.digest, preview,
    )  # fmt: skip
    problem.identity |= {"views": dataclasses.asdict(views)}
    identity = {k: v for k, v in problem.identity.items() if k not in ("structure", "border")}

    def stored(settings: Mapping) -> tuple[Table, dict[str, float]]:
        trained_table = to_table(CompressedTexture(texture.pyramid.layout, stored_form(problem.net), bias), settings)
        return trained_table, CompressedTexture.of(trained_table, mi.TensorXf).measure(source)

    remark, before = "", None
    if request.deadline is not None:
        compiled = compiled_file(f"{rendered.digest} {recipe.spp}")
        remark, before = limit(problem, request, compiled is not None and compiled.is_file())
    elif recipe.start == "file":
        before = problem.measure(problem.net)
    arrays = {name: array.data for name, array in problem.net.arrays.items()}
    result = request.train(problem, finish=lambda: stored(identity))
    kept = recipe.start == "file" and before["psnr_db"] > result.measured["psnr_db"]
    if kept:
        for name, data in arrays.items():
            problem.net.arrays[name].data = data
        result.measured, result.step = before, 0
    if request.deadline is not None and compiled is not None and problem.recipe.share > 0:
        compiled.touch()
    file = None if parsed.description else parsed.path
    settings = {**request.recorded(result), **identity, **request.paths(scene_path=file)}
    settings |= {"kept_start": True} if kept else {}
    if remark:
        settings["remark"], result.unfinished = remark, True
    if rendered.samples < recipe.reference_spp:
        settings["reference_samples"] = rendered.samples
    trained_table, errors = stored(settings)
    trained_table.settings |= request.paths(source_path=source_path)
    trained_table.preset, trained_table.seed = request.preset, recipe.settings.seed
    errors["psnr_scene_db"] = result.measured["psnr_db"]
    trained_table.measured = {k: float(f"{v:.5g}") for k, v in errors.items()}
    return trained_table, result


def started(start: str | os.PathLike, table: Table) -> Table:
    """Return the table of a file to start from. Raises :class:`UsageError` if its maps are not those of ``table``."""
    other = load(start)
    if any(other.settings.get(key) != table.settings.get(key) for key in ("layout", "source")):
        raise UsageError(f"--start: {start} holds other maps, or is of another source, than {table.path}")
    return other


def compiled_file(key: str) -> Path | None:
    """Return the file that is there once a training has compiled the kernels of a scene; ``None`` if it cannot be."""
    try:
        folder = writable_folder(cache_folder() / "compiled", create=True)
    except OSError:
        return None
    return folder / hashlib.sha256(key.encode()).hexdigest()[:16]


def limit(problem: SceneProblem, request: FitRequest, compiled: bool) -> tuple[str, dict[str, float]]:
    """Fit a problem into a limited time.

    Returns a sentence if only the texture alone can be trained, else "", and the figures before the training.

    A measurement of one render a view is rehearsed. Measurements then have so many samples as fit, and where a step
    would take longer than what is left, renders have no share in the loss. Its kernels are expected to be compiled
    unless an earlier training of the scene has ``compiled`` them.
    """
    deadline, spp, most = request.deadline, problem.scene.spp, problem.samples
    problem.samples = spp
    with cores(request.settings.deterministic):
        figures, seconds, history = profiled(lambda: problem.measure(problem.net))
    compiling = compat.compile_seconds(history)
    if not compiled:
        compiling = max(compiling, OPERATION * max((entry.get("operation_count", 0) for entry in history), default=0))
    render = seconds / (2 * len(problem.measured) * spp)
    problem.samples = max(spp, min(most, int(MEASURING * deadline.seconds * spp / seconds)))
    deadline.reserve += seconds * problem.samples / spp
    step = STEP_RENDERS * spp * render + STEP_KERNELS * compiling
    if problem.recipe.share == 0 or step < deadline.left():
        return "", figures
    problem.recipe = dataclasses.replace(problem.recipe, share=0.0)
    problem.identity["shading"]["share"] = 0.0
    kernels = f", {STEP_KERNELS * compiling:.0f} s of it to compile its kernels" if compiling > 1 else ""
    enough = deadline.seconds + 2 * step
    sentence = (
        f"no step through renders: one takes about {step:.0f} s{kernels}; the texture was trained alone; give "
        f"--seconds {enough:.0f} or more, or a smaller film"
    )
    return sentence, figures
