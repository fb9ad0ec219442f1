"""``fit image``: checks of options, the choice of a memory budget, searches and trainings."""

from __future__ import annotations

import dataclasses

from ...arrays.pages import most_entries
from ...arrays.tables import MAX_BYTES
from ...core.errors import UsageError
from ...fitting.settings import FittingError
from ...fitting.task import FitRequest, Fitted
from ...maps import as_seen
from ...maps.arguments import requested_border, requested_bytes, size_figures
from ...maps.source import Source, load_source
from . import memory_budget, search, training, weights
from .compressed import CompressedImage
from .presets import PAGED, PRESETS, STRUCTURES, ImageRecipe, parse_weights, without


def recipe_of(preset: str, settings, options) -> ImageRecipe:
    """Return the recipe of a preset, changed by the options. Raises :class:`UsageError`."""
    recipe = without(PRESETS[preset], options["without"])
    given = {k: options[k] for k in ("structure", "dims") if options[k] is not None}
    recipe = dataclasses.replace(recipe, settings=settings or recipe.settings, **given)
    if STRUCTURES.get(recipe.structure, (8, None))[1] and recipe.dims < 3:
        raise UsageError(f'--structure "{recipe.structure}" has two primary arrays, allowed are --dims 3 and 4')
    if recipe.structure in PAGED and not recipe.components:
        raise UsageError(f'--structure "{recipe.structure}" starts from components: leave out --without components')
    return recipe


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that do not go together."""
    options = request.options
    several = options["ratio_search"] or options["psnr"]
    if request.checkpoint is not None and several:
        raise UsageError(
            "--checkpoint: for one training, but --ratio-search and --psnr make several: give only one of them"
        )
    if options["ratio_search"] and (options["psnr"] or options["cascaded"]):
        raise UsageError("--ratio-search: chooses the sides of arrays of a given size: leave out --psnr and --cascaded")
    if options["psnr"] and options["cascaded"]:
        raise UsageError("--psnr: chooses the sides of the arrays: leave out --cascaded")
    if request.preset == "paper" and options["without"]:
        raise UsageError("--without: the preset paper has none of our improvements: leave it out")
    if options["source"] is None:
        raise UsageError("source: not given, an image or a manifest of the maps of a material is needed")
    recipe = recipe_of(request.preset, request.settings, options)
    if options["ratio"] is not None:
        if recipe.components or STRUCTURES[recipe.structure][1]:
            raise UsageError("--ratio: for the preset paper with one primary array; ours takes --cascaded")
        if options["ratio_search"] or options["psnr"] or options["cascaded"]:
            raise UsageError("--ratio: chooses the sides of arrays: leave out --ratio-search, --psnr and --cascaded")


def fit(request: FitRequest) -> Fitted:
    """Choose sizes, train, and measure.

    Raises :class:`UsageError`, :class:`~mi_diffind.maps.source.SourceError` and
    :class:`.FittingError`.
    """
    options = request.options
    source = load_source(options["source"], nonfinite=options["nonfinite"])
    recipe = recipe_of(request.preset, request.settings, options)
    recipe = dataclasses.replace(recipe, weights=_weights(request, source, recipe))
    if request.deadline is not None and as_seen.shows(source):
        request.deadline.rehearse(lambda: as_seen.reference(source, request.types))
    fitted, requested = _train(request, source, recipe)
    seen = as_seen.measure(source, CompressedImage.of(fitted.table, request.types.TensorXf))
    fitted.table.measured |= {name: float(f"{value:.5g}") for name, value in seen.items()}
    fitted.table.settings |= request.paths(source_path=options["source"])
    figures, line = size_figures(source, fitted.table, requested)
    fitted.lines += [line, *source.notes]
    fitted.figures = {**figures, **fitted.figures}
    return fitted


def _weights(request: FitRequest, source: Source, recipe: ImageRecipe) -> dict[str, float]:
    """Return the weights of maps that differ from 1. Raises :class:`UsageError` for a map that the source lacks."""
    given = request.options["weights"]
    given = parse_weights(given) if isinstance(given, str) else dict(given)
    if given == "equal":
        return {}
    if given == "auto":
        nbytes = source.nbytes / 12 if request.options["psnr"] else requested_bytes(request.options, source)
        return weights.measured(source, recipe, nbytes, request.types)
    for name in given:
        if name not in (names := [m.name for m in source.maps]):
            raise UsageError(f'--weights: found the map "{name}", allowed are {", ".join(names)}')
    return given


def _train(request: FitRequest, source: Source, recipe: ImageRecipe) -> tuple[Fitted, float | None]:
    """Return the result of the training or search, and the requested bytes."""
    options = request.options
    border = requested_border(options)
    if not training.layout_of(source, recipe).stored:  # all channels are constant
        return Fitted(*training.fit_image(source, None, recipe, request, border), figures={"tried": []}), None
    if options["psnr"] is not None:
        return _for_psnr(request, source, recipe, border), None
    requested = requested_bytes(options, source)
    tried, lines = [], []
    if options["ratio_search"]:
        short = dataclasses.replace(request, checkpoint=None)
        ratio = search.ratio_search(source, requested, recipe, short, request.preset != "paper", border)
        tried, recipe, size = ratio.tried, ratio.recipe, ratio.size
        lines += [
            f"tried {t['columns']} x {t['rows']} x {t['dims']} of {t['structure']} → {t['cascaded']}: "
            f"{t['psnr_db']:.2f} dB at texels, {t['psnr_between_db']:.2f} between"
            for t in tried
        ]
        if ratio.interrupted:
            return Fitted(*ratio.best, lines, {"tried": tried}), requested
    elif options["cascaded"]:
        size = search.sized(source, requested, recipe, options["cascaded"])
        if size.nbytes > MAX_BYTES:
            raise UsageError(
                f"--cascaded: found {options['cascaded']}, which is {size.nbytes:,} bytes in {size.dims} "
                f"dimensions, allowed are {MAX_BYTES:,}"
            )
    else:
        size = search.default_size(source, requested, recipe, options["ratio"])
    if size.paged and size.primaries[0][0] * size.primaries[0][1] > most_entries(2):
        raise UsageError(
            f'--structure "{recipe.structure}": {round(requested):,} bytes are too many, pages hold at most '
            f"{most_entries(2):,} entries: request fewer bytes or another structure"
        )
    table, result = training.fit_image(source, size, recipe, request, border)
    sentence = memory_budget.explain(size, source.nbytes, requested)
    if sentence is None and size.paged and table.nbytes < (1 - memory_budget.TOLERANCE) * requested:
        sentence = f"{round(requested):,} bytes were requested, at {table.nbytes:,} the pages are as fine as the image"
    return Fitted(table, result, [*lines, *([sentence] if sentence else [])], {"tried": tried}), requested


def _for_psnr(request: FitRequest, source: Source, recipe: ImageRecipe, border) -> Fitted:
    """Return the smallest file of a wanted quality. Raises :class:`FittingError`."""
    goal = float(request.options["psnr"])
    table, result, tried = search.psnr_search(source, goal, recipe, request, border)
    if table is None:
        best = max(tried, key=lambda t: t["psnr_db"])
        raise FittingError(
            f"{request.options['source']}: {goal:g} dB were not reached; the best of {len(tried)} sizes had "
            f"{best['psnr_db']:.2f} dB in {best['bytes']:,} bytes: give more --steps or a lower --psnr"
        )
    return Fitted(table, result, figures={"tried": tried})
