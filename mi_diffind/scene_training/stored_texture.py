"""Stored texture of a scene: its file, its source, and its training problem."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import mitsuba as mi

from .. import scenes
from ..compat import module_of
from ..errors import UsageError
from ..maps.layout import Layout
from ..maps.pyramid import Pyramid
from ..maps.source import Source
from ..tables import PAGES, Table, TableError
from ..tasks.texture.compressed import CompressedTexture, structure_of
from ..tasks.texture.memory_budget import FineArray, PaperBudget, TextureBudget
from ..tasks.texture.nets import PaperStructure
from ..tasks.texture.presets import PRESETS, TextureRecipe
from ..tasks.texture.training import TextureProblem

#: Plugins whose arrays are trained.
PLUGINS = ("neural_texture", "neural_material")


def texture_file(parsed: scenes.ParsedScene, file: str | os.PathLike | None = None) -> tuple[Path, str]:
    """Return the file of the texture that is trained, and the ``source`` that the scene gives for it ("": none).

    The file is ``file``, or the only one that textures of the scene read. Raises
    :class:`~mi_diffind.errors.UsageError` and :class:`~mi_diffind.scenes.SceneError`.
    """
    folder, sources = parsed.path.resolve().parent, {}
    for entry in parsed.learned_plugins():
        if entry["plugin"] in PLUGINS and entry.get("filename"):
            source = entry.get("source", "")
            sources.setdefault((folder / entry["filename"]).resolve(), str(folder / source) if source else "")
    names, readers = ", ".join(f.name for f in sources) or "none", " or ".join(PLUGINS)
    if file is None:
        if len(sources) != 1:
            raise UsageError(
                f"{parsed.path}: names {len(sources)} files of {readers} ({names}): say which one is to be trained"
            )
        return next(iter(sources.items()))
    wanted = Path(file).resolve()
    if wanted not in sources:
        raise UsageError(f"{parsed.path}: no {readers} reads {file}, the files are {names}")
    return wanted, sources[wanted]


def original_of(table: Table, file: Path, given: str = "") -> Path:
    """Return the image or manifest of a texture, recorded or ``given``. Raises :class:`TableError`."""
    recorded = str(table.settings.get("source_path", ""))
    if not given and not recorded:
        raise TableError(f'{file}: does not record its source; the parameter "source" of the texture may name it')
    original = Path(given) if given else file.parent / recorded
    if not original.is_file():
        raise TableError(f"{original}: no such file, {file.name} was made from it")
    return original.resolve()


def texture_problem(table: Table, source: Source) -> TextureProblem:
    """Return the training problem of a texture alone, by the recipe and from the arrays of its file."""
    layout = Layout.from_json(table.settings["layout"])
    if not layout.stored:
        raise UsageError(f"{table.path}: holds a texture of one colour, without arrays to train")
    texture = CompressedTexture.of(table, mi.TensorXf, "float32")
    pyramid = Pyramid.of(source, layout, module_of(mi.TensorXf), texture.border)
    return TextureProblem(texture.net, pyramid, recipe_of(table), source.digest)


def recipe_of(table: Table) -> TextureRecipe:
    """Return the recipe by which the arrays of a file were trained as a texture."""
    preset = PRESETS["ours" if table.settings.get("layered", True) else "paper"]
    names = [f.name for f in dataclasses.fields(TextureRecipe) if f.name != "settings"]
    return dataclasses.replace(preset, **{n: table.settings[n] for n in names if n in table.settings})


def budget_of(table: Table) -> TextureBudget | PaperBudget:
    """Return the memory budget that the arrays of a texture were made for."""
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
