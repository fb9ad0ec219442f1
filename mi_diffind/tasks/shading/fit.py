"""``fit shading``: training of a texture for its shaded appearance, as requested on the command line."""

from __future__ import annotations

import dataclasses
import math
import os

from ...arrays.tables import Table
from ...core.errors import UsageError
from ...core.units import figure_lines
from ...fitting.task import FitRequest, Fitted
from ...maps.model import preview_path, requested_border, requested_bytes, size_figures
from ...maps.pyramid import Pyramid
from ...maps.source import load_source
from ..texture import PRESETS as TEXTURES
from ..texture import TASK as TEXTURE
from ..texture import ShadingSettings
from ..texture import fit as texture_fit
from ..texture import shading as training
from ..texture import surface as material
from ..texture import training as textures
from ..texture.appearance import ShadedEvaluation
from ..texture.compressed import neutral_extras, read_level_bias

#: Number of pairs of view and light of the images that measure. Many, since a few pairs near the mirror direction
#: dominate the PSNR.
PAIRS = 32

#: Largest side of these images, in texels.
SIDE = 32

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
    if options["extras"] == "auto" and request.settings.texture == "paper":
        raise UsageError(f"--extras: found auto, the arrays of the preset {request.preset} have none, allowed is off")


def fit(request: FitRequest) -> Fitted:
    """Train as a texture, unless a trained one is given, then for shading, and measure the result.

    If time is limited, the first training takes :data:`PRETRAINING` of what is left. Raises :class:`UsageError`,
    :class:`~mi_diffind.maps.source.SourceError`, :class:`.TableError` and
    :class:`.FittingError`.
    """
    options = request.options
    source = load_source(options["source"], nonfinite=options["nonfinite"])
    recipe = request.settings
    layout = textures.source_layout(source, TEXTURES[recipe.texture])
    pyramid = Pyramid.from_source(source, layout, request.types, requested_border(options))
    effects, reasons = material.material_effects(layout)
    if not layout.stored:
        raise UsageError(f"{options['source']}: all of its maps are constant, there is nothing to learn")
    start = None if options["start"] is None else load_start(options["start"], source, request)
    size = find_size(source, pyramid, recipe, options) if start is None else None
    # Before any training, which gets a share of the time that is left
    evaluation = ShadedEvaluation(pyramid, effects, pairs=PAIRS, side=SIDE)
    evaluation.another()
    first = result = None
    if start is None:
        start, first = pretrain(source, pyramid, size, recipe, request)
    if first is not None and first.interrupted:
        table, result = start, first
    else:
        # Without a checkpoint, the training as a texture was interrupted
        resume = request.resume and os.path.exists(request.checkpoint or "")
        try:
            net = training.trainable_arrays(start, pyramid)
        except ValueError as e:
            raise UsageError(str(e)) from None
        table, result = training.fit_shading(
            source, net, recipe, dataclasses.replace(request, resume=resume), pyramid, evaluation,
            preview_path(request), read_level_bias(start.settings),
        )  # fmt: skip
    settings = table.settings
    settings |= request.paths(source_path=options["source"])
    before, not_shaded = settings.get("before", {}), material.left_out(layout)
    figures, sizes = size_figures(source, table, None)
    del figures["compression_asked"]
    figures_before = ", ".join(" ".join(x.split()) for x in figure_lines(before))
    remarks = [
        (before, f"before the training for the shading: {figures_before}"),
        (first and first.unfinished and not first.interrupted, f"the training as a texture: {first and first.outcome}"),
        *((True, line) for line in (*sizes, *source.notes, f"effects that are shaded: {', '.join(effects.names)}")),
        (settings.get("level_bias"), f"read {-settings.get('level_bias', 0):g} levels finer than the footprint"),
        (settings.get("shading", {}).get("fixed") and not settings.get("kept_start"),
         "fine levels keep the values of the texture: any training of theirs made some level worse"),
        (settings.get("kept_start"),
         "training for the shading gained nothing: these are the arrays that it started from"),
        (reasons, "left out: " + ", ".join(f"{effect} ({reason})" for effect, reason in reasons.items())),
        *((True, f"not shaded: {name} ({reason})") for name, reason in not_shaded.items()),
    ]  # fmt: skip
    figures |= {
        "before": before,
        "effects_in_use": list(effects.names),
        "effects_left_out": reasons,
        "maps_not_shaded": not_shaded,
    }
    return Fitted(table, result, [line for applies, line in remarks if applies], figures)


def load_start(path, source, request: FitRequest) -> Table:
    """Return the texture to start from. Raises :class:`UsageError` for a texture of another source."""
    table = TEXTURE.load(path)
    if table.settings.get("source", source.digest) != source.digest:
        raise UsageError(f"{path}: was made from another source than {request.options['source']}")
    return table


def find_size(source, pyramid: Pyramid, recipe: ShadingSettings, options):
    """Return the memory budget of the arrays, beside extras if the recipe has them. Raises :class:`UsageError`."""
    options = {argument.name: argument.default for argument in TEXTURE.arguments} | dict(options)
    nbytes = requested_bytes(options, source)
    nbytes = bytes_beside_extras(nbytes, pyramid) if recipe.extras else nbytes
    return texture_fit.find_size(source, pyramid, nbytes, TEXTURES[recipe.texture], options)


def bytes_beside_extras(nbytes: float, pyramid: Pyramid) -> float:
    """Return the part of ``nbytes`` that extras leave for the maps. Raises :class:`UsageError` if there is none."""
    extras = neutral_extras(pyramid.layout.height, pyramid.layout.width, pyramid.border)
    needed = math.prod(extras.resolution) * extras.channels
    if needed >= nbytes:
        raise UsageError(f"--extras: found {int(nbytes):,} bytes for all arrays, extras alone need {needed:,}")
    return nbytes - needed


def pretrain(source, pyramid: Pyramid, size, recipe: ShadingSettings, request: FitRequest) -> tuple:
    """Train as a texture alone, with a separate checkpoint; return the table and the run's record."""
    texture = dataclasses.replace(TEXTURES[recipe.texture], seed=recipe.seed, deterministic=recipe.deterministic)
    checkpoint = None if request.checkpoint is None else f"{request.checkpoint}.texture"
    first = dataclasses.replace(
        request.part(PRETRAINING), preset=recipe.texture, checkpoint=checkpoint,
        resume=request.resume and os.path.exists(checkpoint or ""),
    )  # fmt: skip
    return textures.fit_texture(source, size, texture, first, pyramid)
