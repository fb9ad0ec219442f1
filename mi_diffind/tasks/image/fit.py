"""``fit image``: from what was asked for to sizes, searches and trainings."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

from ...errors import UsageError
from ...maps.arguments import asked_bytes
from ...maps.source import Source, load_source
from ...pages import most_entries
from ...settings import FittingError
from ...tables import MAX_BYTES
from ...task import FitRequest, Fitted
from . import memory_budget, search, training
from .presets import PAGED, PRESETS, STRUCTURES, ImageRecipe, without


def recipe_of(preset: str, settings, options) -> ImageRecipe:
    """The recipe of a preset with what the options change. Raises :class:`UsageError`."""
    recipe = without(PRESETS[preset], options["without"])
    given = {k: options[k] for k in ("structure", "dims") if options[k] is not None}
    recipe = dataclasses.replace(recipe, settings=settings or recipe.settings, **given)
    if STRUCTURES.get(recipe.structure, (8, None))[1] and recipe.dims < 3:
        raise UsageError(f'--structure "{recipe.structure}" has two primary arrays and needs --dims 3 or 4')
    if recipe.structure in PAGED and not recipe.components:
        raise UsageError(f'--structure "{recipe.structure}" starts from components: leave out what switches them off')
    return recipe


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that do not go together."""
    options = request.options
    several = options["ratio_search"] or options["psnr"]
    if request.checkpoint is not None and several:
        raise UsageError(
            "--checkpoint keeps one training, --ratio-search and --psnr make several: give only one of them"
        )
    if options["ratio_search"] and (options["psnr"] or options["cascaded"]):
        raise UsageError("--ratio-search finds the sides of arrays of a given size: leave out --psnr and --cascaded")
    if options["psnr"] and options["cascaded"]:
        raise UsageError("--psnr chooses the sides of the arrays: leave out --cascaded")
    if request.preset == "paper" and options["without"]:
        raise UsageError("--without switches off what the paper's recipe does not have: leave it out")
    if options["source"] is None:
        raise UsageError("source: not given, an image or a manifest of the maps of a material is needed")
    recipe_of(request.preset, request.settings, options)


def fit(request: FitRequest) -> Fitted:
    """
    Choose sizes, train, and measure. Raises :class:`UsageError`, :class:`~mi_diffind.maps.source.SourceError` and
    :class:`~mi_diffind.fitting.FittingError`.
    """
    options = request.options
    source = load_source(options["source"], nonfinite=options["nonfinite"])
    recipe = recipe_of(request.preset, request.settings, options)
    fitted, asked = _train(request, source, recipe)
    table, folder = fitted.table, (request.output or Path("x")).resolve().parent
    table.settings["source_path"] = os.path.relpath(Path(options["source"]).resolve(), folder)
    achieved = source.nbytes / table.nbytes if table.nbytes else None
    wanted = f" ({source.nbytes / asked:.2f}x asked for)" if asked else ""
    fitted.lines.append((f"{achieved:.2f}x" if achieved else "of one colour") + wanted)
    fitted.figures = {
        "source_bytes": source.nbytes,
        "compression": achieved,
        "compression_asked": source.nbytes / asked if asked else None,
        "arrays": {name: list(a.shape) for name, a in table.arrays.items()},
        "bits": {name: a.bits for name, a in table.arrays.items()},
        **fitted.figures,
    }
    return fitted


def _train(request: FitRequest, source: Source, recipe: ImageRecipe) -> tuple[Fitted, float | None]:
    """What was trained, and the bytes that were asked for."""
    options = request.options
    border = None if options["border"] == "auto" else (options["border"],) * 2
    if not training.layout_of(source, recipe).stored:  # of one colour: nothing to choose
        return Fitted(*training.fit_image(source, None, recipe, request, border), figures={"tried": []}), None
    if options["psnr"] is not None:
        return _for_psnr(request, source, recipe, border), None
    asked = asked_bytes(options, source)
    tried, lines = [], []
    if options["ratio_search"]:
        short = dataclasses.replace(request, checkpoint=None)
        found = search.ratio_search(source, asked, recipe, short, request.preset != "paper", border)
        tried, recipe, size = found.tried, found.recipe, found.size
        lines += [
            f"tried {t['columns']} x {t['rows']} x {t['dims']} of {t['structure']} → {t['cascaded']}: "
            f"{t['psnr_db']:.2f} dB at texels, {t['psnr_between_db']:.2f} between"
            for t in tried
        ]
        if found.interrupted:
            return Fitted(*found.best, lines, {"tried": tried}), asked
    elif options["cascaded"]:
        size = search.sized(source, asked, recipe, options["cascaded"])
        if size.nbytes > MAX_BYTES:
            raise UsageError(
                f"--cascaded: found {options['cascaded']}, which makes {size.nbytes:,} bytes of {size.dims} "
                f"dimensions, allowed are {MAX_BYTES:,}"
            )
    else:
        size = search.default_size(source, asked, recipe)
    if size.paged and size.primaries[0][0] * size.primaries[0][1] > most_entries(2):
        raise UsageError(
            f'--structure "{recipe.structure}": {round(asked):,} bytes are more than {most_entries(2):,} entries, '
            f"which is what pages can hold: ask for fewer or take another one"
        )
    table, result = training.fit_image(source, size, recipe, request, border)
    _, sentence = memory_budget.explain(size, source.nbytes, asked)
    if sentence is None and size.paged and table.nbytes < (1 - memory_budget.TOLERANCE) * asked:
        sentence = (
            f"{round(asked):,} bytes were asked for, but at {table.nbytes:,} bytes the pages are as fine as the image"
        )
    return Fitted(table, result, [*lines, *([sentence] if sentence else [])], {"tried": tried}), asked


def _for_psnr(request: FitRequest, source: Source, recipe: ImageRecipe, border) -> Fitted:
    goal = float(request.options["psnr"])
    table, result, tried = search.psnr_search(source, goal, recipe, request, border)
    if table is None:
        best = max(tried, key=lambda t: t["psnr_db"])
        raise FittingError(
            f"{request.options['source']}: {goal:g} dB were not reached; the best of {len(tried)} sizes had "
            f"{best['psnr_db']:.2f} dB in {best['bytes']:,} bytes: give more --steps or a lower --psnr"
        )
    return Fitted(table, result, figures={"tried": tried})
