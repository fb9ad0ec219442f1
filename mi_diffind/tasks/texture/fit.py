"""``fit texture``: from what was asked for to sizes and a training."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from ...errors import UsageError
from ...maps import components
from ...maps.arguments import asked_bytes
from ...maps.pyramid import Pyramid
from ...maps.source import Source, load_source
from ...tables import MAX_BYTES
from ...task import FitRequest, Fitted
from . import arrays, memory_budget, training
from .presets import PRESETS, TextureRecipe

#: dB of :func:`~mi_diffind.maps.components.smoothness` from which on a texture is smooth.
SMOOTH_DB = 30.0


def recipe_of(preset: str, settings, options) -> TextureRecipe:
    """The recipe of a preset with what the options change."""
    recipe = dataclasses.replace(PRESETS[preset], settings=settings or PRESETS[preset].settings)
    given = {"samples": options["footprint_samples"], "axis": options["axis"]}
    return dataclasses.replace(recipe, **{k: v for k, v in given.items() if v is not None})


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that do not go together."""
    options = request.options
    if options["source"] is None:
        raise UsageError("source: not given, an image or a manifest of the maps of a material is needed")
    if request.preset == "paper":
        for name in ("structure", "skip", "cascaded"):
            if options[name] is not None:
                raise UsageError(f"--{name} is for our arrays, those of the preset paper follow from its tables")
        if options["footprint_samples"] == "levels":
            raise UsageError("--footprint-samples: the preset paper draws footprints, power or exponential")
    elif options["axis"] is not None:
        raise UsageError("--axis is for the preset paper: our arrays are read at levels of detail, not at footprints")
    if options["structure"] == "pages" and options["skip"] is not None:
        first = memory_budget.PAGES_SKIP
        raise UsageError(f"--skip: not for the structure pages, which starts from level {first}")
    if options["structure"] not in (None, "auto", "pages") and options["skip"] is None:
        fine = memory_budget.parse_structure(options["structure"])
        options["skip"] = fine[-1].level + 1


def fit(request: FitRequest) -> Fitted:
    """
    Choose sizes, train, and measure. Raises :class:`UsageError`, :class:`~mi_diffind.maps.source.SourceError` and
    :class:`~mi_diffind.fitting.FittingError`.
    """
    options = request.options
    source = load_source(options["source"], nonfinite=options["nonfinite"])
    recipe = recipe_of(request.preset, request.settings, options)
    border = None if options["border"] == "auto" else (options["border"],) * 2
    pyramid = Pyramid.of(source, training.layout_of(source, recipe), request.types, border)
    asked, size = asked_bytes(options, source), None
    if pyramid.layout.stored:
        size = size_of(source, pyramid, asked, recipe, options)
        if size.nbytes > MAX_BYTES:
            raise UsageError(f"the arrays would take {size.nbytes:,} bytes, allowed are {MAX_BYTES:,}")
    table, result = training.fit_texture(source, size, recipe, request, pyramid)
    folder = (request.output or Path("x")).resolve().parent
    table.settings["source_path"] = os.path.relpath(Path(options["source"]).resolve(), folder)
    achieved = source.nbytes / table.nbytes if table.nbytes else None
    lines = [f"{achieved:.2f}x ({source.nbytes / asked:.2f}x asked for)" if achieved else "of one colour"]
    if size is not None and abs(size.nbytes / asked - 1) > memory_budget.TOLERANCE:
        lines.append(f"{asked:,} bytes were asked for, but {size.nbytes:,} are the nearest that its arrays allow")
    figures = {
        "source_bytes": source.nbytes,
        "compression": achieved,
        "compression_asked": source.nbytes / asked,
        "arrays": {name: list(a.shape) for name, a in table.arrays.items()},
        "bits": {name: a.bits for name, a in table.arrays.items()},
    }
    return Fitted(table, result, lines, figures)


def size_of(source: Source, pyramid: Pyramid, nbytes: float, recipe: TextureRecipe, options):
    """The size of the arrays for so many bytes. Raises :class:`UsageError`."""
    layout = pyramid.layout
    if not recipe.layered:
        return memory_budget.paper_size(nbytes, source.nbytes, layout.stored, layout.height, layout.width)
    fine, skip, levels = None, options["skip"], pyramid.levels
    if options["structure"] in (None, "auto", "pages") and skip is None:
        size = memory_budget.paged(layout.height, layout.width, layout.stored, nbytes, options["cascaded"])
        if options["structure"] == "pages" and size is None:
            raise UsageError('--structure "pages": the texture or its bytes are too small, or too large, for pages')
        if size is not None and (
            options["structure"] == "pages"
            or arrays.gain_of_pages(pyramid.values, size, pyramid.border) >= training.GAIN_DB
        ):
            return size
    if options["structure"] not in (None, "auto", "pages"):
        fine = memory_budget.parse_structure(options["structure"])
        lowest = fine[-1].level + 1
        if skip < lowest:
            raise UsageError(f"--skip: found {skip}, the structure has a fine array on level {lowest - 1}")
    if skip is not None and not 0 <= skip < levels:
        raise UsageError(f"--skip: found {skip}, the texture has levels 0 to {levels - 1}")
    try:
        smooth = components.smoothness(pyramid.values[0]) >= SMOOTH_DB
        return memory_budget.choose(
            layout.height, layout.width, layout.stored, nbytes, skip, fine, options["cascaded"], smooth
        )
    except ValueError as e:
        raise UsageError(f"--structure: {e}") from None
