"""
``fit scene SCENE.xml``: the arrays of a texture trained by differentiating renders of a scene that shows it.

- :mod:`.scene_recipe`, :mod:`.scene_arguments`: what can be asked for;
- :mod:`.scene_rig`: camera and lights where a view has them; :mod:`.scene_references`: what exact plugins make of it;
- :mod:`.scene_texture`: the scene with the arrays as parameters; :mod:`.scene_problem`: the loss.
"""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import mitsuba as mi

from ..compat import module_of
from ..errors import UsageError
from ..fitting import FitResult
from ..maps.layout import Layout
from ..maps.pyramid import Pyramid
from ..maps.source import Source, load_source
from ..tables import PAGES, Table, TableError
from ..task import FitRequest
from ..tasks.texture.compressed import CompressedTexture, load, structure_of, to_table
from ..tasks.texture.memory_budget import FineArray, PaperBudget, TextureBudget
from ..tasks.texture.nets import PaperStructure
from ..tasks.texture.presets import PRESETS, TextureRecipe
from ..tasks.texture.training import TextureProblem, problem_of, stored_form
from .problem import SceneProblem
from .recipe import SceneRecipe, ViewDistribution
from .references import ReferenceRenders
from .texture import TrainedScene, texture_file


def fit_scene(
    path: str | os.PathLike,
    views: ViewDistribution,
    recipe: SceneRecipe,
    request: FitRequest,
    file: str | os.PathLike | None = None,
    references: str | os.PathLike | None = None,
    preview: str | os.PathLike | None = None,
    defines: dict[str, str] | None = None,
) -> tuple[Table, FitResult]:
    """
    Train the arrays of a texture of the scene ``path``, of ``file`` if it reads several, for what its ``views`` look
    like, and return them as they are stored, with their errors, and the run's record. ``request`` says for how long and
    with which checkpoint; its settings are those of the ``recipe``. ``references`` is a folder that keeps what exact
    plugins rendered; ``preview`` a picture that is written at each measurement. In the variant that is set.

    Raises :class:`~mi_diffind.scenes.SceneError`, :class:`~mi_diffind.errors.UsageError`,
    :class:`~mi_diffind.tables.TableError`, :class:`~mi_diffind.maps.source.SourceError`,
    :class:`~mi_diffind.fitting.FittingError` and :class:`~mi_diffind.files.OutputError`.
    """
    request = dataclasses.replace(request, settings=recipe.settings)
    file, given = texture_file(path, file, defines)
    table = load(file)
    source_path = original_of(table, file, given)
    source = load_source(source_path, nonfinite="clean")
    texture = texture_problem(table, source)
    if recipe.start == "untrained":
        texture = problem_of(source, size_of(table), texture.recipe, texture.pyramid)
        table = to_table(CompressedTexture(texture.pyramid.layout, stored_form(texture.net)), {})
    rendered = ReferenceRenders(
        path, views, recipe.reference_spp, references, defines, recipe.against,
        without=(file,), inputs=(source.digest,), progress=request.progress,
    )  # fmt: skip
    trained, measured = views.trained(), views.measured()
    images = rendered.images([*trained, *measured])
    scene = TrainedScene(path, file, views, recipe.spp, table, defines)
    problem = SceneProblem(
        texture, scene, [*zip(trained, images, strict=False)],
        [*zip(measured, images[len(trained) :], strict=True)], recipe, rendered.digest,
        None if preview is None else Path(preview),
    )  # fmt: skip
    problem.identity |= {"views": dataclasses.asdict(views)}
    result = request.train(problem)
    settings = {**request.recorded(), **{k: v for k, v in problem.identity.items() if k not in ("structure", "border")}}
    settings["scene_path"] = _relative(path, request)
    if request.seconds is not None:
        settings["steps"] = result.steps
    found = to_table(CompressedTexture(texture.pyramid.layout, stored_form(problem.net)), settings)
    found.settings["source_path"] = _relative(source_path, request)
    found.preset, found.seed = request.preset, recipe.settings.seed
    of_texture = CompressedTexture.of(found, mi.TensorXf).measure(source)
    shaded = {"psnr_scene_db": result.measured["psnr_db"]}
    found.measured = {k: float(f"{v:.5g}") for k, v in {**of_texture, **shaded}.items()}
    return found, result


def _relative(path: str | os.PathLike, request: FitRequest) -> str:
    return os.path.relpath(Path(path).resolve(), (request.output or Path("x")).resolve().parent)


def original_of(table: Table, file: Path, given: str = "") -> Path:
    """The image or manifest that a texture was made from, or the one ``given``. Raises :class:`TableError`."""
    recorded = str(table.settings.get("source_path", ""))
    if not given and not recorded:
        raise TableError(f'{file}: does not say what it was made from, which is what the parameter "source" is for')
    found = Path(given) if given else file.parent / recorded
    if not found.is_file():
        raise TableError(f"{found}: no such file, {file.name} was made from it")
    return found.resolve()


def texture_problem(table: Table, source: Source) -> TextureProblem:
    """The problem of a texture alone, by the recipe of its file, from the arrays that the file holds."""
    layout = Layout.from_json(table.settings["layout"])
    if not layout.stored:
        raise UsageError(f"{table.path}: is of one colour, there are no arrays to train")
    texture = CompressedTexture.of(table, mi.TensorXf, "float32")
    pyramid = Pyramid.of(source, layout, module_of(mi.TensorXf), texture.border)
    return TextureProblem(texture.net, pyramid, recipe_of(table), source.digest)


def recipe_of(table: Table) -> TextureRecipe:
    """How the arrays of a file are trained as a texture."""
    own = PRESETS["ours" if table.settings.get("layered", True) else "paper"]
    names = [f.name for f in dataclasses.fields(TextureRecipe) if f.name != "settings"]
    return dataclasses.replace(own, **{n: table.settings[n] for n in names if n in table.settings})


def size_of(table: Table) -> TextureBudget | PaperBudget:
    """The size of the arrays of a texture."""
    layout = Layout.from_json(table.settings["layout"])
    structure, _ = structure_of(table.settings, layout)
    shapes = {name: array.shape for name, array in table.arrays.items()}
    if isinstance(structure, PaperStructure):
        rows, columns, _ = shapes["primary0"]
        return PaperBudget(rows, columns, shapes["cascaded"][0], shapes["cascaded"][1], layout.stored)
    paged = [layer for layer in structure.layers if layer.paged]
    fine = tuple(FineArray(x.level, x.channels, x.bits) for x in structure.layers if not x.paged)
    dims, axes = shapes["coarse"][-1], len(shapes["cascaded"]) - 1
    names = [f"level{x.level}" for x in paged]
    nbytes = sum(table.arrays[name].nbytes + table.arrays[name + PAGES].nbytes for name in names)
    return TextureBudget(
        layout.height, layout.width, layout.stored, fine, structure.skip, dims, shapes["cascaded"][-2],
        structure.skip + 1 if axes > dims else 1, structure.bits, tuple(x.level for x in paged), nbytes,
        paged[0].bits if paged else 5,
    )  # fmt: skip
