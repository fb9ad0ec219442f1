"""``fit image``: checks of options, weights of maps, the choice of sizes by rule or by trainings, and the fit."""

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping
from types import ModuleType

from ...arrays.budget import Budget
from ...arrays.pages import most_entries
from ...arrays.tables import MAX_BYTES, Table
from ...core.errors import UsageError
from ...core.units import largest_fitting
from ...fitting.task import FitRequest, FitResult, Fitted
from ...maps import as_seen
from ...maps.model import complete, load_maps, rehearse_pictures, requested_border, requested_bytes
from ...maps.search import SHORT, check_psnr, search_by_psnr, search_lines
from ...maps.source import Source
from . import PAGED, STRUCTURES, CoarsePrimary, ImageSettings
from .arrays import CompressedImage, ImageBudget, cascaded_side, fit_bytes, search
from .training import build_problem, choose_structure, fit_image, pointer_dims, source_layout

#: Share of a limited time for such a search; the best candidate is trained in the rest.
SEARCHED = 2 / 3

#: Number of candidates that share a limited time.
CANDIDATES = 16

#: Sides of the cascaded array that a search tries, by its dimensions.
SIDES = {1: (64, 256), 2: (16, 32, 64), 3: (8, 16, 32), 4: (4, 8, 12, 16)}

#: Structures of the primary that a search tries.
TRIED = ("8 bits", "6 bits", "4 bits", "4 + 8 bits", "3 + 6 bits", "2 + 6 bits", *PAGED)

#: Least weights of maps that pictures show, and of others such as ambient occlusion, in dB.
SHOWN_DB = -1.0
OTHER_DB = -2.0

#: Least gain of weights in the pictures of initial arrays, in dB.
GAIN_DB = 0.5

#: Side of the sample of a material for which initial arrays are compared, in texels, and of its patches.
SAMPLE_SIDE = 512
SAMPLE_PATCH = 64


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that do not go together."""
    options = request.options
    several = options["ratio_search"] or options["psnr"]
    check_psnr(request, "cascaded")
    if request.checkpoint is not None and options["ratio_search"]:
        raise UsageError("--checkpoint: for one training, but --ratio-search makes several: leave one of them out")
    if options["ratio_search"] and (options["psnr"] or options["cascaded"]):
        raise UsageError("--ratio-search: chooses the sides of arrays of a given size: leave out --psnr and --cascaded")
    if request.preset == "paper" and options["without"]:
        raise UsageError("--without: the preset paper has none of our improvements: leave it out")
    if options["source"] is None:
        raise UsageError(
            "source: not given, an image, a folder of maps, a manifest, or a glTF or MaterialX file is needed"
        )
    recipe = request.settings
    if STRUCTURES.get(recipe.structure, (8, None))[1] and recipe.dims < 3:
        raise UsageError(f'--structure "{recipe.structure}" has two primary arrays, allowed are --dims 3 and 4')
    if recipe.structure in PAGED and not recipe.components:
        raise UsageError(f'--structure "{recipe.structure}" starts from components: leave out --without components')
    if options["ratio"] is not None:
        if recipe.components or STRUCTURES[recipe.structure][1]:
            raise UsageError("--ratio: for the preset paper with one primary array; ours takes --cascaded")
        if several or options["cascaded"]:
            raise UsageError("--ratio: chooses the sides of arrays: leave out --ratio-search, --psnr and --cascaded")


def fit(request: FitRequest) -> Fitted:
    """Choose sizes, train, and measure.

    Raises :class:`UsageError`, :class:`~mi_diffind.maps.source.SourceError` and
    :class:`.FittingError`.
    """
    source = load_maps(request)
    recipe = dataclasses.replace(request.settings, weights=_weights(request, source, request.settings))
    rehearse_pictures(request, source)
    fitted, requested = _train(request, source, recipe)
    return complete(
        request, source, fitted, CompressedImage.from_table(fitted.table, request.types.TensorXf), requested
    )


def _train(request: FitRequest, source: Source, recipe: ImageSettings) -> tuple[Fitted, float | None]:
    """Return the result of the training or search, and the requested bytes."""
    options = request.options
    border = requested_border(options)
    if not source_layout(source, recipe).stored:  # all channels are constant
        return Fitted(*fit_image(source, None, recipe, request, border), figures={"tried": []}), None
    if options["psnr"] is not None:

        def train(size: ImageBudget, steps: int, limited: FitRequest, title: str) -> tuple[Table, FitResult]:
            changed = dataclasses.replace(recipe, steps=steps, measure_every=min(recipe.measure_every, steps))
            return fit_image(source, size, changed, limited, border, title)

        goal = float(options["psnr"])
        table, result, tried = search_by_psnr(
            source, goal, request, recipe, lambda nbytes: default_size(source, nbytes, recipe), train
        )
        return Fitted(table, result, search_lines(tried), {"tried": tried}), None
    requested = requested_bytes(options, source)
    tried, lines = [], []
    if options["ratio_search"]:
        short = dataclasses.replace(request, checkpoint=None)
        size, recipe, tried, best = ratio_search(source, requested, recipe, short, request.preset != "paper", border)
        lines += [
            f"tried {t['columns']} x {t['rows']} x {t['dims']} of {t['structure']} → {t['cascaded']}: "
            f"{t['psnr_db']:.2f} dB at texels, {t['psnr_between_db']:.2f} between"
            for t in tried
        ]
        if best is not None and best[1].interrupted:
            return Fitted(*best, lines, {"tried": tried}), requested
    elif options["cascaded"]:
        size = sized(source, requested, recipe, options["cascaded"])
        if size.nbytes > MAX_BYTES:
            raise UsageError(
                f"--cascaded: found {options['cascaded']}, which is {size.nbytes:,} bytes in {size.dims} "
                f"dimensions, allowed are {MAX_BYTES:,}"
            )
    else:
        size = default_size(source, requested, recipe, options["ratio"])
    if size.paged and size.primaries[0][0] * size.primaries[0][1] > most_entries(2):
        raise UsageError(
            f'--structure "{recipe.structure}": {round(requested):,} bytes are too many, pages hold at most '
            f"{most_entries(2):,} entries: request fewer bytes or another structure"
        )
    return Fitted(*fit_image(source, size, recipe, request, border), lines, {"tried": tried}), requested


# ---------------------- Sizes ----------------------


def default_size(source: Source, nbytes: float, recipe: ImageSettings, ratio: float | None = None) -> ImageBudget:
    """Return the default budget of a recipe for ``nbytes`` bytes.

    The supplement's search, with ``ratio`` in place of its table if given; or, with ``components`` or two primaries, a
    cascaded array of :func:`.cascaded_side` and the largest primary that fits beside it.
    """
    stored, structure = max(1, source_layout(source, recipe).stored), choose_structure(source, recipe, nbytes)
    bits, coarse = STRUCTURES[structure]
    if recipe.components or coarse:
        return sized(source, nbytes, recipe, cascaded_side(nbytes, stored, pointer_dims(recipe, structure, stored)))
    size = (source.height, source.width)
    return search(source.nbytes, source.nbytes / nbytes, stored, *size, recipe.dims, bits, ratio)


def sized(source: Source, nbytes: float, recipe: ImageSettings, cascaded: int) -> ImageBudget:
    """Return the budget for ``nbytes`` bytes with a cascaded array of a given side."""
    stored, structure = max(1, source_layout(source, recipe).stored), choose_structure(source, recipe, nbytes)
    (bits, coarse), dims = STRUCTURES[structure], pointer_dims(recipe, structure, stored)
    size = fit_bytes(nbytes, stored, source.height, source.width, cascaded, dims, bits, coarse)
    return dataclasses.replace(size, paged=structure in PAGED)


def ratio_search(
    source: Source, nbytes: float, recipe: ImageSettings, request: FitRequest, free: bool = True, border=None
) -> tuple[ImageBudget, ImageSettings, list[dict], tuple[Table, FitResult] | None]:
    """Return the best of several budgets of ``nbytes`` bytes, each trained for :data:`SHORT` of the steps.

    The side of the cascaded array (and so the ratio ρ) is varied first; with ``free`` then the structure of the primary
    and the dimensions. The best mean of the qualities at texels and between them is kept after each. ``request`` and
    ``border`` are those of :func:`.fit_image`.

    The result is the budget, its recipe, a dictionary for each training (sizes, ``bytes``, ``psnr_db``), and table and
    record of the best one, ``interrupted`` if Ctrl-C ended the search; ``None`` if not even the smallest array fits.
    """
    steps, limit = max(20, round(recipe.steps * SHORT)), request.part(SEARCHED).deadline
    tried, best = {}, None

    def quality(key: tuple) -> float:
        return 0.5 * (tried[key]["psnr_db"] + tried[key]["psnr_between_db"])

    def leader() -> tuple | None:
        """Return structure, dims and side of the best training."""
        return max(tried, key=quality, default=None)

    start = default_size(source, nbytes, recipe)
    recipe = dataclasses.replace(recipe, structure=choose_structure(source, recipe, nbytes), dims=start.dims)
    for candidate, side in _candidates(recipe, start.cascaded, free, leader):
        size = sized(source, nbytes, candidate, side)
        key = candidate.structure, size.dims, side
        if key in tried or size.nbytes > nbytes * (1 + Budget(nbytes).tolerance):
            continue
        if tried and limit is not None and limit.left() < limit.seconds / CANDIDATES:
            continue
        share = 1.0 if limit is None else limit.seconds / CANDIDATES / limit.left()
        shortened = dataclasses.replace(candidate, dims=size.dims, steps=steps, measure_every=steps)
        title = f"try {size.columns}×{size.rows}×{size.dims} of {candidate.structure} → {size.cascaded}"
        limited = request if limit is None else dataclasses.replace(request, deadline=limit.part(share))
        table, result = fit_image(source, size, shortened, limited, border, title)
        tried[key] = {
            "dims": size.dims, "structure": candidate.structure, "cascaded": side, "rows": size.rows,
            "columns": size.columns, "ratio": size.ratio, "bytes": table.nbytes, "psnr_db": table.measured["psnr_db"],
            "psnr_between_db": table.measured["psnr_between_db"],
        }  # fmt: skip
        if leader() == key:
            best = table, result
        if result.interrupted:
            best[1].interrupted = True
            break
    if best is None:
        return start, recipe, [], None
    structure, dims, side = leader()
    recipe = dataclasses.replace(recipe, structure=structure, dims=dims)
    return sized(source, nbytes, recipe, side), recipe, list(tried.values()), best


def _candidates(recipe: ImageSettings, side: int, free: bool, leader: Callable) -> Iterator[tuple[ImageSettings, int]]:
    """Yield recipes with sides of the cascaded array to try; later ones depend on the ``leader`` of those before."""
    yield from ((recipe, s) for s in sorted(SIDES[recipe.dims], key=lambda s: abs(math.log(s / side))))
    if not free or leader() is None:
        return
    _, _, side = leader()
    for structure in (s for s in STRUCTURES if s in TRIED and s != recipe.structure):
        if recipe.dims > CoarsePrimary().dims or not STRUCTURES[structure][1]:
            yield dataclasses.replace(recipe, structure=structure), side
    structure, dims, side = leader()
    recipe = dataclasses.replace(recipe, structure=structure, dims=dims)
    yield from ((recipe, s) for s in SIDES[dims] if abs(math.log2(s / side)) <= 1)
    structure, dims, _ = leader()
    if STRUCTURES[structure][1] is None:
        recipe = dataclasses.replace(recipe, structure=structure)
        yield from ((dataclasses.replace(recipe, dims=d), SIDES[d][1]) for d in (2, 3, 4) if d != recipe.dims)
        recipe = dataclasses.replace(recipe, dims=leader()[1])
        yield from ((recipe, s) for s in SIDES[recipe.dims])


# ---------------------- Weights of maps ----------------------


def _weights(request: FitRequest, source: Source, recipe: ImageSettings) -> dict[str, float]:
    """Return the weights of maps that differ from 1. Raises :class:`UsageError` for a map that the source lacks."""
    given = request.options["weights"]
    if given == "equal":
        return {}
    if given == "auto":
        nbytes = source.nbytes / 12 if request.options["psnr"] else requested_bytes(request.options, source)
        return weights_as_seen(source, recipe, nbytes, request.types)
    for name in given:
        if name not in (names := [m.name for m in source.maps]):
            raise UsageError(f'--weights: found the map "{name}", allowed are {", ".join(names)}')
    return dict(given)


def weights_as_seen(source: Source, recipe: ImageSettings, nbytes: float, types: ModuleType) -> dict[str, float]:
    """Return weights of maps by what an error of each does to a shaded picture (:func:`balance_weights`).

    Returns {} (equal weights) if initial arrays of ``nbytes`` gain less than :data:`GAIN_DB` by them in pictures, if
    pictures do not show the ``source``, or if the recipe does not start from components.
    """
    if not (as_seen.shows(source) and recipe.components and source_layout(source, recipe).stored):
        return {}
    share = nbytes / source.nbytes
    maps = [dataclasses.replace(m, values=as_seen.patchwork(m.values, SAMPLE_SIDE, SAMPLE_PATCH)) for m in source.maps]
    sample = Source(tuple(maps), *maps[0].values.shape[:2], f"{source.digest} sample")
    channels = {name: len(indices) for name, indices in source_layout(sample, recipe).channels_by_map().items()}
    squares = as_seen.sensitivities(sample, types)
    weights = balance_weights({name: squares[name] for name in channels}, channels)

    def start_db(weights: dict) -> float:
        """Return the PSNR as seen from near of initial arrays."""
        weighted = dataclasses.replace(recipe, weights=weights)
        problem = build_problem(sample, default_size(sample, share * sample.nbytes, weighted), weighted, types)
        return as_seen.measure(sample, CompressedImage(problem.layout, problem.net), as_seen.NEAR)["seen_db"]

    before, after = start_db({}), start_db(weights)
    return weights if after >= before + GAIN_DB else {}


def balance_weights(squares: Mapping[str, float], channels: Mapping[str, int]) -> dict[str, float]:
    """Return weights whose squares are proportional to ``squares``, where they are not below the least weights.

    Their geometric mean over all ``channels`` of a map is 1: about so many decibels as its weight has does a map gain.
    """
    least = {name: SHOWN_DB if square > 0 else OTHER_DB for name, square in squares.items()}
    wanted = {name: 10 * math.log10(square) if square > 0 else -math.inf for name, square in squares.items()}
    if not any(squares.values()):
        return {}

    def decibels(shift: float) -> dict[str, float]:
        return {name: max(least[name], wanted[name] + shift) for name in squares}

    def too_small(shift: float) -> bool:
        return sum(channels[name] * db for name, db in decibels(shift).items()) < 0

    shift = largest_fitting(too_small, -200.0, 200.0, steps=60)
    return {name: float(f"{10 ** (db / 20):.3g}") for name, db in decibels(shift).items()}
