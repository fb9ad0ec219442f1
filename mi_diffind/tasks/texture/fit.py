"""``fit texture``: checks of options, the choice of a memory budget, and a training."""

from __future__ import annotations

from ...arrays.tables import MAX_BYTES
from ...core.errors import UsageError
from ...fitting.task import FitRequest, Fitted
from ...maps.layout import gain_of_pages, smoothness
from ...maps.model import complete, rehearse_pictures, requested_border, requested_bytes
from ...maps.pyramid import Pyramid
from ...maps.source import Source, load_source
from . import TextureSettings, arrays, parse_structure
from .arrays import TextureBudget
from .compressed import CompressedTexture
from .training import fit_texture, source_layout

#: Least gain of pages, in dB before training, over one grid of equal bytes. (0.7 on bricks, where pages lose 0.4.)
GAIN_DB = 1.0

#: Least smoothness of a smooth texture, in dB (:func:`~mi_diffind.maps.layout.smoothness`).
SMOOTH_DB = 30.0


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
        first = arrays.PAGES_SKIP
        raise UsageError(f"--skip: not for the structure pages, whose coarse array starts at level {first}")


def fit(request: FitRequest) -> Fitted:
    """Choose sizes, train, and measure.

    Raises :class:`UsageError`, :class:`~mi_diffind.maps.source.SourceError` and
    :class:`.FittingError`.
    """
    options = request.options
    source = load_source(options["source"], nonfinite=options["nonfinite"])
    recipe = request.settings
    pyramid = Pyramid.from_source(source, source_layout(source, recipe), request.types, requested_border(options))
    requested, size = requested_bytes(options, source), None
    if pyramid.layout.stored:
        size = find_size(source, pyramid, requested, recipe, options)
    rehearse_pictures(request, source)
    fitted = Fitted(*fit_texture(source, size, recipe, request, pyramid, options["level_bias"]))
    return complete(
        request, source, fitted, CompressedTexture.from_table(fitted.table, request.types.TensorXf), requested
    )


def find_size(source: Source, pyramid: Pyramid, nbytes: float, recipe: TextureSettings, options):
    """Return the memory budget of the arrays for ``nbytes`` bytes. Raises :class:`UsageError`."""
    if recipe.layered:
        size = _layered_size(pyramid, nbytes, options["structure"] or "auto", options["skip"], options["cascaded"])
    else:
        shape = pyramid.values[0].shape
        size = arrays.paper_size(nbytes, source.nbytes, shape[2], *shape[:2], options["ratio"])
    if size.nbytes > MAX_BYTES:
        raise UsageError(f"size: found {size.nbytes:,} bytes of arrays, allowed are {MAX_BYTES:,}")
    return size


def _page_gain(pyramid: Pyramid, size: TextureBudget) -> float:
    """Return the gain of pages over one grid of equal bytes at level 0, in dB."""
    return gain_of_pages(pyramid.values[0], size.dims, size.page_entries, pyramid.border)[0]


def _layered_size(pyramid: Pyramid, nbytes: float, structure: str, skip: int | None, cascaded: int | None):
    """Return the budget of pages or fine arrays: those of a ``structure``, or the best for the texture."""
    shape, fine = pyramid.values[0].shape, parse_structure(structure) or None
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
        if size is not None and (structure == "pages" or _page_gain(pyramid, size) >= GAIN_DB):
            return size
    try:
        smooth = smoothness(pyramid.values[0]) >= SMOOTH_DB
        return arrays.choose(*shape, nbytes, skip, fine, cascaded, smooth)
    except ValueError as e:
        raise UsageError(f"--structure: {e}") from None
