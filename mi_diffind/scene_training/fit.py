"""``fit scene SCENE.xml``: training of a texture by differentiating renders of a scene that shows it."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path

import mitsuba as mi

from .. import scenes
from ..fitting import FitResult
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

#: Share of a limited time in which the references are rendered.
REFERENCES = 0.4


def fit(request: FitRequest) -> Fitted:
    """Train a texture of a scene as requested on the command line, in the active variant."""
    options = request.options
    views, recipe = views_of(options, request.settings.seed), recipe_of(options, request.settings)
    parsed = scenes.ParsedScene(options["source"], dict(options["defines"] or ()))
    table, result = fit_scene(
        parsed, views, recipe, request, options["texture"], options["references"], preview_path(request)
    )
    figures = {
        "arrays": {name: list(a.shape) for name, a in table.arrays.items()},
        "bits": {name: a.bits for name, a in table.arrays.items()},
        "views": dataclasses.asdict(views),
    }
    lines = [f"{views.count} views, {recipe.spp} samples a pixel"]
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
) -> tuple[Table, FitResult]:
    """Train the arrays of a texture of a scene for the ``views``, and return the stored table and the run's record.

    ``file`` is the texture's file, needed if the scene reads several. ``request`` gives duration and checkpoint; its
    settings are those of the ``recipe``. ``references`` is a folder that keeps the reference images; ``preview`` a
    picture that is written at each measurement. Runs in the variant that is set.

    Raises :class:`~mi_diffind.scenes.SceneError`, :class:`~mi_diffind.errors.UsageError`,
    :class:`~mi_diffind.tables.TableError`, :class:`~mi_diffind.maps.source.SourceError`,
    :class:`~mi_diffind.fitting.FittingError` and :class:`~mi_diffind.files.OutputError`.
    """
    request = dataclasses.replace(request, settings=recipe.settings)
    file, given = texture_file(parsed, file)
    table = load(file)
    source_path = original_of(table, file, given)
    source = load_source(source_path, nonfinite="clean")
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

    result = request.train(problem, finish=lambda: stored(identity))
    settings = {**request.recorded(result), **identity, **request.paths(scene_path=parsed.path)}
    if rendered.samples < recipe.reference_spp:
        settings["reference_samples"] = rendered.samples
    trained_table, errors = stored(settings)
    trained_table.settings |= request.paths(source_path=source_path)
    trained_table.preset, trained_table.seed = request.preset, recipe.settings.seed
    errors["psnr_scene_db"] = result.measured["psnr_db"]
    trained_table.measured = {k: float(f"{v:.5g}") for k, v in errors.items()}
    return trained_table, result
