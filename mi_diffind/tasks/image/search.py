"""
How large the arrays are: by rule, or by short trainings of several sizes (``--ratio-search``), or as small as a wanted
quality allows (``--psnr``).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from ... import sizing
from ...fitting import FitResult
from ...sizing import Size
from ...tables import Table
from .source import Source
from .training import Recipe, fit_image, layout_of, replaced

#: A candidate of a search is trained for this share of the steps.
SHORT = 1 / 8

#: Sides of the cascaded array to try, by its dimensions.
SIDES = {1: (64, 256), 2: (16, 32, 64), 3: (8, 16, 32), 4: (4, 8, 12, 16)}

#: Bits of an entry of the primary array to try.
BITS = (3, 4, 5, 6, 8)

#: A search by quality ends when the file is at most this much larger than one that is known to be too small.
NEAR = 1.06


@dataclass
class Found:
    """
    What a search has tried (one dictionary a training: sizes, ``bytes``, ``psnr_db``) and chosen; ``best`` is the table
    of the best short training and its record, for a search that was interrupted.
    """

    size: Size
    recipe: Recipe
    tried: list[dict]
    best: tuple[Table, FitResult] | None = None
    interrupted: bool = False


def default_size(source: Source, nbytes: float, recipe: Recipe) -> Size:
    """
    The size of a recipe for so many bytes: the supplement's search, or with ``components`` a cascaded array of
    :func:`.sizing.cascaded_side` and whatever primary fits beside it.
    """
    layout = layout_of(source, recipe)
    if recipe.components:
        side = sizing.cascaded_side(nbytes, max(1, layout.stored), recipe.dims)
        return sized(source, nbytes, recipe, side)
    compression = source.nbytes / nbytes
    return sizing.search(
        source.nbytes, compression, max(1, layout.stored), source.height, source.width, recipe.dims, recipe.bits
    )


def sized(source: Source, nbytes: float, recipe: Recipe, cascaded: int) -> Size:
    """The size for so many bytes, with a cascaded array of a given side."""
    stored = max(1, layout_of(source, recipe).stored)
    return sizing.fit_bytes(nbytes, stored, source.height, source.width, cascaded, recipe.dims, recipe.bits)


def _steps(recipe: Recipe, share: float) -> Recipe:
    steps = max(20, round(recipe.settings.steps * share))
    return replaced(recipe, steps=steps, quality_every=steps)


def ratio_search(source: Source, nbytes: float, recipe: Recipe, free: bool = True, **options) -> Found:
    """
    The best of several sizes of ``nbytes``, each trained for :data:`SHORT` of the steps: the side of the cascaded
    array, and so the ratio ρ; with ``free`` then bits of an entry, dimensions (with sides of their own). One is varied
    after the other, the best kept. ``options`` are those of :func:`.fit_image`.
    """
    tried, tables = [], []

    def attempt(recipe: Recipe, side: int) -> bool:
        """Train a candidate; was that interrupted?"""
        size = sized(source, nbytes, recipe, side)
        known = [t for t in tried if (t["dims"], t["bits"], t["cascaded"]) == (recipe.dims, recipe.bits, side)]
        if known or size.nbytes > nbytes * (1 + sizing.TOLERANCE):
            return False
        table, result = fit_image(source, size, _steps(recipe, SHORT), title=_title(size), **options)
        tried.append({
            "dims": size.dims, "bits": size.bits, "cascaded": side, "rows": size.rows, "columns": size.columns,
            "ratio": size.ratio, "bytes": size.nbytes, "psnr_db": table.quality["psnr_db"],
            "psnr_between_db": table.quality["psnr_between_db"],
        })  # fmt: skip
        if best() is tried[-1]:
            tables[:] = [(table, result)]
        return result.interrupted

    def best() -> dict:
        return max(tried, key=_merit)

    start, interrupted = default_size(source, nbytes, recipe), False
    for stage in _stages(recipe, start.cascaded, free, best):
        interrupted = any(attempt(candidate, side) for candidate, side in stage)
        if interrupted:
            break
    if not tried:
        return Found(start, recipe, tried)
    chosen = best()
    recipe = dataclasses.replace(recipe, bits=chosen["bits"], dims=chosen["dims"])
    return Found(sized(source, nbytes, recipe, chosen["cascaded"]), recipe, tried, tables[0], interrupted)


def _merit(tried: dict) -> float:
    """What is compared: the quality at texels and between them."""
    return 0.5 * (tried["psnr_db"] + tried["psnr_between_db"])


def _title(size: Size) -> str:
    return f"try {size.columns}×{size.rows}×{size.dims} of {size.bits} bits → {size.cascaded}"


def _stages(recipe: Recipe, side: int, free: bool, best: Callable) -> Iterator[list]:
    """Lists of (recipe, side) to try, each made when the results of those before are there."""
    yield [(recipe, s) for s in sorted(SIDES[recipe.dims], key=lambda s: abs(math.log(s / side)))]
    if not free:
        return
    found = best()
    yield [(dataclasses.replace(recipe, bits=b), found["cascaded"]) for b in BITS if abs(b - found["bits"]) == 1]
    found = best()
    if found["bits"] != recipe.bits:
        step = 1 if found["bits"] > recipe.bits else -1
        yield [(dataclasses.replace(recipe, bits=b), found["cascaded"]) for b in BITS if b == found["bits"] + step]
    found = best()
    other = [d for d in (2, 3, 4) if d != recipe.dims]
    yield [(dataclasses.replace(recipe, bits=found["bits"], dims=d), SIDES[d][1]) for d in other]
    found = best()
    if found["dims"] != recipe.dims:
        recipe = dataclasses.replace(recipe, bits=found["bits"], dims=found["dims"])
        yield [(recipe, s) for s in SIDES[found["dims"]]]


def psnr_search(
    source: Source, goal: float, recipe: Recipe, most: int = 8, log: Callable[[str], None] = print, **options
) -> tuple[Table | None, FitResult | None, list[dict]]:
    """
    The smallest file whose ``psnr_db`` is at least ``goal``: trainings of full length, sizes by the secant of quality
    over the logarithm of bytes, until one that is large enough is within :data:`NEAR` of one that is not, or ``most``
    were tried. Returns the table (``None``: not even the largest primary reaches it), the record of its training and
    what was tried. ``log`` is told of each.
    """
    tried, kept = [], None
    nbytes = source.nbytes / 12
    while len(tried) < most:
        size = default_size(source, nbytes, recipe)
        if any(t["bytes"] == size.nbytes for t in tried):
            break
        table, result = fit_image(source, size, recipe, title=f"try {size.nbytes:,} bytes", **options)
        psnr = table.quality["psnr_db"]
        tried.append({"bytes": size.nbytes, "psnr_db": psnr, "rows": size.rows, "cascaded": size.cascaded})
        log(f"{size.nbytes:,} bytes: {psnr:.2f} dB")
        if psnr >= goal and (kept is None or table.nbytes < kept[0].nbytes):
            kept = table, result
        if result.interrupted:
            break
        enough = min((t["bytes"] for t in tried if t["psnr_db"] >= goal), default=None)
        short = max((t["bytes"] for t in tried if t["psnr_db"] < goal), default=None)
        if enough and short and enough <= NEAR * short:
            break
        if short and size.full and not enough:
            break
        nbytes = _next(tried, goal, enough, short)
    return (*(kept or (None, None)), tried)


def _next(tried: list[dict], goal: float, enough: int | None, short: int | None) -> float:
    """Bytes to try next."""
    if enough and short:
        a, b = (next(t for t in tried if t["bytes"] == n) for n in (short, enough))
        share = (goal - a["psnr_db"]) / max(b["psnr_db"] - a["psnr_db"], 1e-6)
        share = min(max(share, 0.15), 0.85)
        return short * (enough / short) ** share
    last = tried[-1]
    octaves = (goal - last["psnr_db"]) / 2.5  # dB an octave of bytes, about
    octaves = math.copysign(min(max(abs(octaves) * 1.2, 0.25), 3), octaves)
    return last["bytes"] * 2**octaves
