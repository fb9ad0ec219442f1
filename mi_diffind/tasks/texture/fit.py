"""``fit texture``: checks of options, the choice of a memory budget, and a training of one or two stages."""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np

from ...arrays.tables import MAX_BYTES, Table
from ...core.errors import UsageError, raised_as
from ...core.progress import interruptible
from ...core.units import figure_lines
from ...fitting.task import FitRequest, FitResult, Fitted
from ...maps.layout import Layout, gain_of_pages, smoothness
from ...maps.model import complete, load_maps, preview_path, rehearse_pictures, requested_border, requested_bytes
from ...maps.pyramid import Pyramid
from ...maps.search import check_psnr, search_by_psnr, search_lines
from ...maps.source import Source
from . import PRESETS, TASK, ShadingSettings, TextureSettings, arrays
from .appearance import ShadedEvaluation
from .arrays import PaperBudget, TextureBudget
from .compressed import CompressedTexture, neutral_extras, read_level_bias
from .shading import ShadingTraining, trainable_arrays
from .surface import left_out, maps_of, material_effects, varies_shading
from .training import TextureProblem, build_problem, channel_weights, fit_texture, source_layout

#: Least gain of pages, in dB before training, over one grid of equal bytes. (0.7 on bricks, where pages lose 0.4.)
GAIN_DB = 1.0

#: Number of pairs of view and light of the images that measure. Many, since a few pairs near the mirror direction
#: dominate the PSNR.
PAIRS = 32

#: Largest side of these images, in texels.
SIDE = 32

#: Share of the time of the first of two stages, if time is limited.
FIRST = 0.5

#: Largest share of the bytes that extras take; smaller arrays have none.
EXTRAS_SHARE = 1 / 16

#: Options that say how the arrays of the first stage are laid out.
SIZES = ("compression", "bytes", "bpp", "psnr", "structure", "skip", "cascaded", "ratio", "footprint_samples")

#: Options of the last stage alone.
LAST = {"start": "--start", "share": "--lambda", "preview": "--preview"}


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that do not go together."""
    options = request.options
    if options["source"] is None:
        raise UsageError(
            "source: not given, an image, a folder of maps, a manifest, or a glTF or MaterialX file is needed"
        )
    if str(options["source"]).lower().endswith(".xml"):
        raise UsageError(f"source: found the scene {options['source']}; fit scene trains a texture inside a scene")
    if options["shading"] == "off":
        check_last(options, "--shading is off")
    check_psnr(request, "structure", "skip", "cascaded", "ratio")
    if options["psnr"] is not None and options["shading"] == "on":
        raise UsageError("--psnr: asks for the values of the maps, which --shading on gives up for those of shading")
    if not request.settings.steps and (options["psnr"] is not None or options["shading"] == "on"):
        raise UsageError("--steps: found 0, but --psnr and --shading on need a training")
    if not request.settings.steps and request.checkpoint is not None:
        raise UsageError("--checkpoint: nothing is trained with --steps 0: leave one of them out")
    if options["start"] is not None and any(options[name] is not None for name in SIZES):
        given = ", ".join(f"--{name.replace('_', '-')}" for name in SIZES if options[name] is not None)
        raise UsageError(f"--start: the arrays have their size, leave out {given}")
    if request.preset == "paper":
        for name in ("structure", "skip", "cascaded"):
            if options[name] is not None:
                raise UsageError(f"--{name}: not for the preset paper, whose arrays follow from the paper's tables")
        if options["footprint_samples"] == "levels":
            raise UsageError("--footprint-samples: found levels, allowed for the preset paper are power, exponential")
    elif options["ratio"] is not None:
        raise UsageError(f"--ratio: found the preset {request.preset}, allowed is paper")
    if options["structure"] == "pages" and options["skip"] is not None:
        first = arrays.PAGES_SKIP
        raise UsageError(f"--skip: not for the structure pages, whose coarse array starts at level {first}")


def check_last(options: Mapping, reason: str) -> None:
    """Raise :class:`UsageError` if ``options`` hold one of the last stage, which is left out for a ``reason``."""
    for name, flag in LAST.items():
        if options[name] is not None:
            raise UsageError(f"{flag}: found {options[name]}, but nothing is trained for its shading: {reason}")


def fit(request: FitRequest) -> Fitted:
    """Choose sizes, train in one or two stages, and measure.

    Raises :class:`UsageError`, :class:`~mi_diffind.maps.source.SourceError`, :class:`.TableError` and
    :class:`.FittingError`.
    """
    options, recipe = request.options, request.settings
    source = load_maps(request)
    pyramid = Pyramid.from_source(source, source_layout(source, recipe), request.types, requested_border(options))
    reason, spare = "" if options["shading"] == "on" else reason_without_shading(pyramid.layout, request), 0
    if reason:
        check_last(options, reason)
        rehearse_pictures(request, source)
        fitted, requested = fit_maps_alone(request, source, pyramid)
        fitted.lines += [f"not trained for its shading: {reason}"] * (options["shading"] == "auto")
    else:
        fitted, requested, spare = fit_stages(request, source, pyramid)
    texture = CompressedTexture.from_table(fitted.table, request.types.TensorXf)
    return complete(request, source, fitted, texture, requested, spare)


def fit_maps_alone(request: FitRequest, source: Source, pyramid: Pyramid) -> tuple[Fitted, float | None]:
    """Train for the values of the maps alone; return the result, and the bytes that were requested, if any."""
    options, recipe, bias = request.options, request.settings, level_bias(request.options)

    def sized(nbytes: float) -> TextureBudget | PaperBudget:
        return find_size(source, pyramid, nbytes, recipe, options)

    def train(size, steps: int, limited: FitRequest, title: str) -> tuple[Table, FitResult]:
        changed = dataclasses.replace(recipe, steps=steps, measure_every=min(recipe.measure_every, steps))
        return fit_texture(source, size, changed, limited, pyramid, bias, title)

    requested = None if options["psnr"] is not None else requested_bytes(options, source)
    if pyramid.layout.stored and requested is None:
        table, result, tried = search_by_psnr(source, float(options["psnr"]), request, recipe, sized, train)
        return Fitted(table, result, search_lines(tried), {"tried": tried}), None
    size = sized(requested) if pyramid.layout.stored else None
    return Fitted(*fit_texture(source, size, recipe, request, pyramid, bias)), requested


def level_bias(options: Mapping) -> float:
    """Return the level bias that is asked for, 0 if the last stage chooses one."""
    return 0.0 if options["level_bias"] == "auto" else options["level_bias"]


def reason_without_shading(layout: Layout, request: FitRequest) -> str:
    """Return why ``--shading off`` or ``auto`` leaves out the training for shading, "" if it does not."""
    if request.options["shading"] == "off":
        return "--shading is off"
    if not request.settings.steps:
        return "--steps is 0"
    if request.options["psnr"] is not None:
        return "--psnr asks for the values of the maps"
    if request.preset == "paper":
        return "the preset paper does so with --shading on"
    if not varies_shading(layout):
        return "no map of normals or roughness, or a constant one"
    if len(layout.maps) == 1:
        return "one map alone is no material"
    try:
        maps_of(layout)
    except UsageError as e:
        return str(e)
    return ""


def fit_stages(request: FitRequest, source: Source, pyramid: Pyramid) -> tuple[Fitted, float | None, int]:
    """Train for the values of the maps, unless arrays are given, then for their shading.

    Returns the result, the bytes that its arrays were to have (``None``: those of the arrays that are given), and how
    many of them extras would have taken that it lacks. If time is limited, the first stage takes :data:`FIRST` of it. A
    stage that Ctrl-C ends is the last one. Errors are those of :func:`fit`.
    """
    options, layout = request.options, pyramid.layout
    recipe, effects = TASK.shading_settings(request.preset, request.settings, options), material_effects(layout)[0]
    if not layout.stored:
        raise UsageError(f"{options['source']}: all of its maps are constant, there is nothing to learn")
    start = None if options["start"] is None else load_start(options["start"], source, request)
    requested = None if start is not None else requested_bytes(options, source)
    recipe, room = room_for_extras(recipe, pyramid, start.nbytes if start is not None else requested)
    size = None if start is not None else find_size(source, pyramid, requested - room, request.settings, options)
    # Before any training, which gets a share of the time that is left
    rehearse_pictures(request, source)
    evaluation = ShadedEvaluation(pyramid, effects, pairs=PAIRS, side=SIDE)
    lines, table, result = [], start, None
    if start is None:
        part = request.part(FIRST)
        with interruptible() as stop:
            table, result = fit_texture(source, size, request.settings, part, pyramid, level_bias(options), "maps")
        if stop.is_set() or result.interrupted:
            lines = ["not trained for its shading: interrupted"]
            return Fitted(table, dataclasses.replace(result, interrupted=True), lines), requested, room
        lines += [f"the training for its maps: {result.outcome}"] * result.unfinished
    with raised_as(UsageError, ValueError):
        net = trainable_arrays(table, pyramid)
    nbytes = table.nbytes

    def build(weights: Mapping[str, float]) -> TextureProblem:
        scale = arrays.channel_scale(channel_weights(layout, weights), layout.stored)
        size = find_size(source, pyramid, nbytes, request.settings, options, scale)
        return build_problem(source, size, request.settings, pyramid, weights)

    if request.checkpoint is not None:  # those of the last stage are in CHECKPOINT.shading.…
        request = dataclasses.replace(request, checkpoint=f"{request.checkpoint}.shading")
    table, result = ShadingTraining(
        source, net, recipe, request, pyramid, evaluation, preview_path(request),
        read_level_bias(table.settings), build if request.settings.layered else None,
    ).fit()  # fmt: skip
    fitted = Fitted(table, result, *shading_report(table, layout))
    fitted.lines[:0] = lines
    return fitted, requested, room * ("extras" not in table.arrays)


def load_start(path, source: Source, request: FitRequest) -> Table:
    """Return the texture to start from. Raises :class:`UsageError` for a texture of another source or preset."""
    table = TASK.load(path)
    if table.settings.get("source", source.digest) != source.digest:
        raise UsageError(f"{path}: was made from another source than {request.options['source']}")
    layered = "coarse" in table.arrays
    if layered != request.settings.layered:
        preset = next(name for name, recipe in PRESETS.items() if recipe.layered == layered)
        raise UsageError(f"--start: found arrays of the preset {preset}, {request.preset} is needed")
    return table


def room_for_extras(recipe: ShadingSettings, pyramid: Pyramid, nbytes: float) -> tuple[ShadingSettings, int]:
    """Return the recipe, and the bytes of extras: none if they take more than :data:`EXTRAS_SHARE` of ``nbytes``."""
    extras = neutral_extras(pyramid.layout.height, pyramid.layout.width, pyramid.border)
    needed = math.prod(extras.resolution) * extras.channels
    if not recipe.extras or needed > EXTRAS_SHARE * nbytes:
        return dataclasses.replace(recipe, extras=False), 0
    return recipe, needed


def shading_report(table: Table, layout: Layout) -> tuple[list[str], dict]:
    """Return what a table says of its training for shading: lines of text, and figures for ``--json``."""
    settings, (effects, reasons), not_shaded = table.settings, material_effects(layout), left_out(layout)
    before, kept = settings.get("before", {}), settings.get("kept_start")
    figures_before = ", ".join(" ".join(x.split()) for x in figure_lines(before))
    gains = ", ".join(f"{name} {gain:+.2f} dB" for name, gain in settings.get("states", {}).items())
    remarks = [
        (before, f"before the training for the shading: {figures_before}"),
        (True, f"effects that are shaded: {', '.join(effects.names)}"),
        (settings.get("level_bias"), f"read {-settings.get('level_bias', 0):g} levels finer than a round footprint"),
        (settings.get("states"), f"gain of held-out footprints: {gains}; kept: {settings.get('state')}"),
        (kept, "training for the shading gained nothing: these are the arrays that it started from"),
        (reasons, "left out: " + ", ".join(f"{effect} ({reason})" for effect, reason in reasons.items())),
        *((True, f"not shaded: {name} ({reason})") for name, reason in not_shaded.items()),
    ]  # fmt: skip
    figures = {
        "before": before,
        "effects_in_use": list(effects.names),
        "effects_left_out": reasons,
        "maps_not_shaded": not_shaded,
    }
    return [line for applies, line in remarks if applies], figures


def find_size(source: Source, pyramid: Pyramid, nbytes: float, recipe: TextureSettings, options, scale=1.0):
    """Return the memory budget of the arrays for ``nbytes`` bytes. Raises :class:`UsageError`.

    ``scale`` are factors of the channels, ``(channels,)``, by which their errors count.
    """
    if recipe.layered:
        size = _layered_size(pyramid, nbytes, options["structure"], options["skip"], options["cascaded"], scale)
    else:
        shape = pyramid.values[0].shape
        size = arrays.paper_size(nbytes, source.nbytes, shape[2], *shape[:2], options["ratio"])
    if size.nbytes > MAX_BYTES:
        raise UsageError(f"size: found {size.nbytes:,} bytes of arrays, allowed are {MAX_BYTES:,}")
    return size


def _layered_size(pyramid: Pyramid, nbytes: float, structure, skip: int | None, cascaded: int | None, scale=1.0):
    """Return the budget of pages or fine arrays: those of a ``structure``, or the best for the texture."""
    shape, fine = pyramid.values[0].shape, structure if isinstance(structure, tuple) else None
    if fine is not None:
        skip = fine[-1].level + 1 if skip is None else skip
        if skip <= fine[-1].level:
            raise UsageError(f"--skip: found {skip}, the structure has a fine array on level {fine[-1].level}")
    if skip is not None and not 0 <= skip < pyramid.levels:
        raise UsageError(f"--skip: found {skip}, the texture has levels 0 to {pyramid.levels - 1}")
    if skip is None:
        size = arrays.paged(*shape, nbytes, cascaded)
        if size is None and structure == "pages":
            raise UsageError("--structure: found pages, for which the texture or its bytes are too small or too large")
        finest = (pyramid.values[0] * scale).astype(np.float32)
        if size is not None and (
            structure == "pages" or gain_of_pages(finest, size.dims, size.page_entries, pyramid.border)[0] >= GAIN_DB
        ):
            return size
    with raised_as(UsageError, ValueError, at="--structure"):
        return arrays.choose(*shape, nbytes, skip, fine, cascaded, arrays.ladder(smoothness(pyramid.values[0])))
