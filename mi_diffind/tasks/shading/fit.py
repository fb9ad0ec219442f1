"""``fit shading``: training of a texture for its shaded appearance, as requested on the command line."""

from __future__ import annotations

import dataclasses
import math
import os

from ...arrays.tables import Table
from ...core.errors import UsageError
from ...core.units import labelled
from ...fitting.task import FitRequest, Fitted
from ...maps.arguments import preview_path, requested_border, requested_bytes
from ...maps.pyramid import Pyramid
from ...maps.source import load_source
from ..texture import PRESETS as TEXTURES
from ..texture import TASK as TEXTURE
from ..texture import fit as texture_fit
from ..texture import training as textures
from ..texture.compressed import bias_of
from ..texture.nets import neutral_extras
from . import PRESETS, ShadingRecipe, material, training
from .evaluation import ShadedEvaluation


def recipe_of(preset: str, settings, options) -> ShadingRecipe:
    """Return the recipe of a preset with the given options in place of its own."""
    recipe = PRESETS[preset]
    given = {"share": options["share"], "reference": options["reference"], "level_bias": options["level_bias"]}
    given = {k: v for k, v in given.items() if v is not None}
    if options["level_bias"] == "auto":
        given["level_bias"] = None
    if options["clip"] is not None:
        given["clip"] = None if options["clip"] == math.inf else options["clip"]
    extras = options["extras"] == "auto"
    return dataclasses.replace(recipe, settings=settings or recipe.settings, extras=extras, **given)


#: Number of pairs of view and light, and size, of the images that measure. Many, since a few pairs near the mirror
#: direction dominate the PSNR.
PAIRS, SIDE = 32, 32

#: Share of the time in which the arrays are trained as a texture, if time is limited.
PRETRAINING = 0.4


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that exclude each other."""
    options = request.options
    if options["source"] is None:
        raise UsageError("source: not given, a manifest of the maps of a material is needed")
    if str(options["source"]).lower().endswith(".xml"):
        raise UsageError(f"source: found the scene {options['source']}; fit scene trains a texture inside a scene")
    if options["start"] is not None and any(options[name] for name in ("compression", "bytes", "bpp")):
        raise UsageError("--start: the arrays have their size, leave out --compression, --bytes and --bpp")
    if options["extras"] == "auto" and PRESETS[request.preset].texture == "paper":
        raise UsageError(f"--extras: found auto, the arrays of the preset {request.preset} have none, allowed is off")


def fit(request: FitRequest) -> Fitted:
    """Train as a texture, unless a trained one is given, then for shading, and measure the result.

    If time is limited, the first training takes :data:`PRETRAINING` of what is left. Raises :class:`UsageError`,
    :class:`~mi_diffind.maps.source.SourceError`, :class:`.TableError` and
    :class:`.FittingError`.
    """
    options = request.options
    source = load_source(options["source"], nonfinite=options["nonfinite"])
    recipe = recipe_of(request.preset, request.settings, options)
    texture = TEXTURES[recipe.texture]
    pyramid = Pyramid.of(source, textures.layout_of(source, texture), request.types, requested_border(options))
    effects, reasons = material.effects_of(pyramid.layout)
    if not pyramid.layout.stored:
        raise UsageError(f"{options['source']}: all of its maps are constant, there is nothing to learn")
    start, result, size = None, None, None
    if options["start"] is not None:
        start = started(options["start"], source, request)
    else:
        size = size_of(source, pyramid, recipe, options)
    # Before any training, which gets a share of the time that is left
    evaluation = ShadedEvaluation(pyramid, effects, pairs=PAIRS, side=SIDE)
    evaluation.another()
    if start is None:
        start, result = pretrained(source, pyramid, size, recipe, request)
    first = result
    if result is None or not result.interrupted:
        # Without a checkpoint, the training as a texture was interrupted
        resume = request.resume and os.path.exists(request.checkpoint or "")
        shading_request = dataclasses.replace(request, resume=resume)
        preview = preview_path(request)
        try:
            net = training.start_of(start, pyramid)
        except ValueError as e:
            raise UsageError(str(e)) from None
        bias = bias_of(start.settings)
        table, result = training.fit_shading(source, net, recipe, shading_request, pyramid, evaluation, preview, bias)
    else:
        table = start
    table.settings |= request.paths(source_path=options["source"])
    before, lines = table.settings.get("before", {}), []
    if before:
        lines.append(
            "before the training for the shading: " + ", ".join(map(" ".join, map(str.split, labelled(before))))
        )
    if first is not None and first.unfinished and not first.interrupted:
        lines.append(f"the training as a texture: {first.outcome}")
    lines += [
        f"{source.nbytes / table.nbytes:.2f}x",
        *source.notes,
        f"effects that are shaded: {', '.join(effects.names)}",
    ]
    if table.settings.get("level_bias"):
        lines.append(f"read {-table.settings['level_bias']:g} levels finer than the footprint")
    if table.settings.get("shading", {}).get("fixed") and not table.settings.get("kept_start"):
        lines.append("fine levels keep the values of the texture: any training of theirs made some level worse")
    if table.settings.get("kept_start"):
        lines.append("training for the shading gained nothing: these are the arrays that it started from")
    if reasons:
        lines.append("left out: " + ", ".join(f"{effect} ({reason})" for effect, reason in reasons.items()))
    not_shaded = material.left_out(pyramid.layout)
    lines += [f"not shaded: {name} ({reason})" for name, reason in not_shaded.items()]
    figures = {
        "before": before,
        "source_bytes": source.nbytes,
        "compression": source.nbytes / table.nbytes,
        "effects_in_use": list(effects.names),
        "effects_left_out": reasons,
        "maps_not_shaded": not_shaded,
        "arrays": {name: list(a.shape) for name, a in table.arrays.items()},
        "bits": {name: a.bits for name, a in table.arrays.items()},
    }
    return Fitted(table, result, lines, figures)


def started(path, source, request: FitRequest) -> Table:
    """Return the texture to start from. Raises :class:`UsageError` for a texture of another source."""
    table = TEXTURE.load(path)
    if table.settings.get("source", source.digest) != source.digest:
        raise UsageError(f"{path}: was made from another source than {request.options['source']}")
    return table


def size_of(source, pyramid: Pyramid, recipe: ShadingRecipe, options):
    """Return the memory budget of the arrays. Raises :class:`UsageError`."""
    options = {argument.name: argument.default for argument in TEXTURE.arguments} | dict(options)
    nbytes = requested_bytes(options, source)
    nbytes = bytes_beside_extras(nbytes, pyramid) if recipe.extras else nbytes
    return texture_fit.size_of(source, pyramid, nbytes, TEXTURES[recipe.texture], options)


def bytes_beside_extras(nbytes: float, pyramid: Pyramid) -> float:
    """Return the part of ``nbytes`` that extras leave for the maps. Raises :class:`UsageError` if there is none."""
    extras = neutral_extras(pyramid.layout.height, pyramid.layout.width, pyramid.border)
    needed = math.prod(extras.resolution) * extras.channels
    if needed >= nbytes:
        raise UsageError(f"--extras: found {int(nbytes):,} bytes for all arrays, extras alone need {needed:,}")
    return nbytes - needed


def pretrained(source, pyramid: Pyramid, size, recipe: ShadingRecipe, request: FitRequest) -> tuple:
    """Train as a texture alone, with a separate checkpoint; return the table and the run's record."""
    texture = TEXTURES[recipe.texture]
    settings = dataclasses.replace(
        texture.settings, seed=recipe.settings.seed, deterministic=recipe.settings.deterministic
    )
    texture = dataclasses.replace(texture, settings=settings)
    checkpoint = None if request.checkpoint is None else f"{request.checkpoint}.texture"
    first = dataclasses.replace(
        request.part(PRETRAINING), preset=recipe.texture, checkpoint=checkpoint,
        resume=request.resume and os.path.exists(checkpoint or ""),
    )  # fmt: skip
    return textures.fit_texture(source, size, texture, first, pyramid)
