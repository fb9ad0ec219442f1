"""``fit texture``: checks of options, the choice of a memory budget, and a training."""

from __future__ import annotations

import dataclasses

from ...arrays.tables import MAX_BYTES
from ...core.errors import UsageError
from ...fitting.task import FitRequest, Fitted
from ...maps import as_seen, components
from ...maps.arguments import requested_border, requested_bytes, size_figures
from ...maps.pyramid import Pyramid
from ...maps.source import Source, load_source
from . import arrays, memory_budget, training
from .compressed import CompressedTexture
from .presets import PRESETS, TextureRecipe

#: Least smoothness of a smooth texture, in dB (:func:`~mi_diffind.maps.components.smoothness`).
SMOOTH_DB = 30.0


def recipe_of(preset: str, settings, options) -> TextureRecipe:
    """Return the recipe of a preset, changed by the options."""
    recipe = dataclasses.replace(PRESETS[preset], settings=settings or PRESETS[preset].settings)
    return dataclasses.replace(recipe, samples=options["footprint_samples"] or recipe.samples)


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that do not go together."""
    options = request.options
    if options["source"] is None:
        raise UsageError("source: not given, an image or a manifest of the maps of a material is needed")
    if request.preset == "paper":
        for name in ("structure", "skip", "cascaded"):
            if options[name] is not None:
                raise UsageError(f"--{name}: not for the preset paper, whose arrays follow from the paper's tables")
        if options["footprint_samples"] == "levels":
            raise UsageError("--footprint-samples: found levels, allowed for the preset paper are power, exponential")
    elif options["ratio"] is not None:
        raise UsageError(f"--ratio: found the preset {request.preset}, allowed is paper")
    if options["structure"] == "pages" and options["skip"] is not None:
        first = memory_budget.PAGES_SKIP
        raise UsageError(f"--skip: not for the structure pages, whose coarse array starts at level {first}")
    if options["structure"] not in (None, "auto", "pages") and options["skip"] is None:
        fine = memory_budget.parse_structure(options["structure"])
        options["skip"] = fine[-1].level + 1


def fit(request: FitRequest) -> Fitted:
    """Choose sizes, train, and measure.

    Raises :class:`UsageError`, :class:`~mi_diffind.maps.source.SourceError` and
    :class:`.FittingError`.
    """
    options = request.options
    source = load_source(options["source"], nonfinite=options["nonfinite"])
    recipe = recipe_of(request.preset, request.settings, options)
    pyramid = Pyramid.of(source, training.layout_of(source, recipe), request.types, requested_border(options))
    requested, size = requested_bytes(options, source), None
    if pyramid.layout.stored:
        size = size_of(source, pyramid, requested, recipe, options)
    if request.deadline is not None and as_seen.shows(source):
        request.deadline.rehearse(lambda: as_seen.reference(source, request.types))
    table, result = training.fit_texture(source, size, recipe, request, pyramid, options["level_bias"])
    seen = as_seen.measure(source, CompressedTexture.of(table, request.types.TensorXf))
    table.measured |= {name: float(f"{value:.5g}") for name, value in seen.items()}
    table.settings |= request.paths(source_path=options["source"])
    figures, line = size_figures(source, table, requested)
    lines = [line, *source.notes]
    if size is not None and abs(size.nbytes / requested - 1) > memory_budget.TOLERANCE:
        lines.append(f"{requested:,} bytes were requested, but {size.nbytes:,} are the nearest that the arrays allow")
    return Fitted(table, result, lines, figures)


def size_of(source: Source, pyramid: Pyramid, nbytes: float, recipe: TextureRecipe, options):
    """Return the memory budget of the arrays for ``nbytes`` bytes. Raises :class:`UsageError`."""
    size = _size_of(source, pyramid, nbytes, recipe, options)
    if size.nbytes > MAX_BYTES:
        raise UsageError(f"size: found {size.nbytes:,} bytes of arrays, allowed are {MAX_BYTES:,}")
    return size


def _size_of(source: Source, pyramid: Pyramid, nbytes: float, recipe: TextureRecipe, options):
    layout = pyramid.layout
    if not recipe.layered:
        height, width, ratio = layout.height, layout.width, options["ratio"]
        return memory_budget.paper_size(nbytes, source.nbytes, layout.stored, height, width, ratio)
    fine, skip, structure = None, options["skip"], options["structure"] or "auto"
    if structure in ("auto", "pages") and skip is None:
        size = memory_budget.paged(layout.height, layout.width, layout.stored, nbytes, options["cascaded"])
        if structure == "pages" and size is None:
            raise UsageError("--structure: found pages, for which the texture or its bytes are too small or too large")
        if structure == "pages":
            return size
        if size and arrays.gain_of_pages(pyramid.values, size, pyramid.border) >= training.GAIN_DB:
            return size
    if structure not in ("auto", "pages"):
        fine = memory_budget.parse_structure(structure)
        lowest = fine[-1].level + 1
        if skip < lowest:
            raise UsageError(f"--skip: found {skip}, the structure has a fine array on level {lowest - 1}")
    if skip is not None and not 0 <= skip < pyramid.levels:
        raise UsageError(f"--skip: found {skip}, the texture has levels 0 to {pyramid.levels - 1}")
    try:
        smooth = components.smoothness(pyramid.values[0]) >= SMOOTH_DB
        return memory_budget.choose(
            layout.height, layout.width, layout.stored, nbytes, skip, fine, options["cascaded"], smooth
        )
    except ValueError as e:
        raise UsageError(f"--structure: {e}") from None
