"""
How large the arrays are: by rule, or by short trainings of several sizes (``--ratio-search``), or as small as a wanted
quality allows (``--psnr``).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from ...fitting import FitResult
from ...maps.source import Source
from ...tables import Table
from ...task import FitRequest
from . import memory_budget
from .memory_budget import CoarsePrimary, ImageBudget
from .presets import PAGED, STRUCTURES, ImageRecipe, replaced
from .training import dims_of, fit_image, layout_of, structure_of

#: A candidate of a search is trained for this share of the steps.
SHORT = 1 / 8

#: Sides of the cascaded array to try, by its dimensions.
SIDES = {1: (64, 256), 2: (16, 32, 64), 3: (8, 16, 32), 4: (4, 8, 12, 16)}

#: Structures of the primary to try.
TRIED = ("8 bits", "6 bits", "4 bits", "4 + 8 bits", "3 + 6 bits", "2 + 6 bits", *PAGED)

#: A search by quality ends when the file is at most this much larger than one that is known to be too small.
NEAR = 1.06


@dataclass
class RatioSearch:
    """
    What a search has tried (one dictionary a training: sizes, ``bytes``, ``psnr_db``) and chosen; ``best`` is the table
    of the best short training and its record, for a search that was interrupted.
    """

    size: ImageBudget
    recipe: ImageRecipe
    tried: list[dict]
    best: tuple[Table, FitResult] | None = None
    interrupted: bool = False


def default_size(source: Source, nbytes: float, recipe: ImageRecipe) -> ImageBudget:
    """
    The size of a recipe for so many bytes: the supplement's search, or with ``components`` a cascaded array of
    :func:`.memory_budget.cascaded_side` and whatever primary fits beside it.
    """
    stored, structure = max(1, layout_of(source, recipe).stored), structure_of(source, recipe, nbytes)
    bits, coarse = STRUCTURES[structure]
    if recipe.components or coarse:
        dims = dims_of(recipe, structure, stored)
        return sized(source, nbytes, recipe, memory_budget.cascaded_side(nbytes, stored, dims))
    compression = source.nbytes / nbytes
    return memory_budget.search(source.nbytes, compression, stored, source.height, source.width, recipe.dims, bits)


def sized(source: Source, nbytes: float, recipe: ImageRecipe, cascaded: int) -> ImageBudget:
    """
    The size for so many bytes, with a cascaded array of a given side. A single primary of pages may have fewer
    channels than the recipe says (:func:`.dims_of`).
    """
    stored, structure = max(1, layout_of(source, recipe).stored), structure_of(source, recipe, nbytes)
    (bits, coarse), paged = STRUCTURES[structure], structure in PAGED
    dims = dims_of(recipe, structure, stored)
    size = memory_budget.fit_bytes(nbytes, stored, source.height, source.width, cascaded, dims, bits, coarse)
    return dataclasses.replace(size, paged=paged)


def _steps(recipe: ImageRecipe, share: float) -> ImageRecipe:
    steps = max(20, round(recipe.settings.steps * share))
    return replaced(recipe, steps=steps, measure_every=steps)


def ratio_search(
    source: Source, nbytes: float, recipe: ImageRecipe, request: FitRequest, free: bool = True, border=None
) -> RatioSearch:
    """
    The best of several sizes of ``nbytes``, each trained for :data:`SHORT` of the steps: the side of the cascaded
    array, and so the ratio ρ; with ``free`` then the structure of the primary and dimensions (with sides of their
    own). One is varied after the other, the best kept. ``request`` and ``border`` are those of :func:`.fit_image`.
    """
    tried, tables = [], []

    def attempt(recipe: ImageRecipe, side: int) -> bool:
        """Train a candidate; was that interrupted?"""
        size = sized(source, nbytes, recipe, side)
        structure, recipe = structure_of(source, recipe, nbytes), dataclasses.replace(recipe, dims=size.dims)
        known = [t for t in tried if (t["dims"], t["structure"], t["cascaded"]) == (recipe.dims, structure, side)]
        if known or size.nbytes > nbytes * (1 + memory_budget.TOLERANCE):
            return False
        table, result = fit_image(source, size, _steps(recipe, SHORT), request, border, _title(size, structure))
        tried.append({
            "dims": size.dims, "structure": structure, "cascaded": side, "rows": size.rows, "columns": size.columns,
            "ratio": size.ratio, "bytes": size.nbytes, "psnr_db": table.measured["psnr_db"],
            "psnr_between_db": table.measured["psnr_between_db"],
        })  # fmt: skip
        if best() is tried[-1]:
            tables[:] = [(table, result)]
        return result.interrupted

    def best() -> dict | None:
        return max(tried, key=_merit, default=None)

    start, interrupted = default_size(source, nbytes, recipe), False
    structure, recipe = structure_of(source, recipe, nbytes), dataclasses.replace(recipe, dims=start.dims)
    for stage in _stages(recipe, structure, start.cascaded, free, best):
        interrupted = any(attempt(candidate, side) for candidate, side in stage)
        if interrupted:
            break
    if not tried:
        return RatioSearch(start, recipe, tried)
    tables[0][1].interrupted = interrupted
    chosen = best()
    recipe = dataclasses.replace(recipe, structure=chosen["structure"], dims=chosen["dims"])
    return RatioSearch(sized(source, nbytes, recipe, chosen["cascaded"]), recipe, tried, tables[0], interrupted)


def _merit(tried: dict) -> float:
    """What is compared: the quality at texels and between them."""
    return 0.5 * (tried["psnr_db"] + tried["psnr_between_db"])


def _title(size: ImageBudget, structure: str) -> str:
    return f"try {size.columns}×{size.rows}×{size.dims} of {structure} → {size.cascaded}"


def _stages(recipe: ImageRecipe, structure: str, side: int, free: bool, best: Callable) -> Iterator[list]:
    """Lists of (recipe, side) to try, each made when the results of those before are there."""
    yield [(recipe, s) for s in sorted(SIDES[recipe.dims], key=lambda s: abs(math.log(s / side)))]
    if not free or best() is None:  # not even the smallest cascaded array fits
        return
    found = best()
    several = recipe.dims > CoarsePrimary().dims
    tried = [s for s, (_, coarse) in STRUCTURES.items() if s in TRIED and s != structure and (several or not coarse)]
    yield [(dataclasses.replace(recipe, structure=s), found["cascaded"]) for s in tried]
    found = best()
    recipe = dataclasses.replace(recipe, structure=found["structure"], dims=found["dims"])
    yield [(recipe, s) for s in SIDES[recipe.dims] if abs(math.log2(s / found["cascaded"])) <= 1]
    if STRUCTURES[found["structure"]][1] is None:
        other = [d for d in (2, 3, 4) if d != recipe.dims]
        yield [(dataclasses.replace(recipe, dims=d), SIDES[d][1]) for d in other]
        found = best()
        recipe = dataclasses.replace(recipe, dims=found["dims"])
        yield [(recipe, s) for s in SIDES[found["dims"]]]


def psnr_search(
    source: Source,
    goal: float,
    recipe: ImageRecipe,
    request: FitRequest,
    border=None,
    most: int = 8,
    log: Callable[[str], None] = print,
) -> tuple[Table | None, FitResult | None, list[dict]]:
    """
    The smallest file whose ``psnr_db`` is at least ``goal``: trainings of full length, sizes by the secant of quality
    over the logarithm of bytes, until one that is large enough is within :data:`NEAR` of one that is not, or ``most``
    were tried. Returns the table (``None``: not even the largest primary reaches it), the record of its training and
    what was tried. ``log`` is told of each. After Ctrl-C, the record says ``interrupted``; ``KeyboardInterrupt`` is
    raised if nothing reached ``goal`` before.
    """
    tried, kept = [], None
    nbytes = middle = source.nbytes / 12
    while len(tried) < most:
        sizes = [default_size(source, n, recipe) for n in (nbytes, middle)]
        size = next((s for s in sizes if all(t["bytes"] != s.nbytes for t in tried)), None)
        if size is None:
            break
        table, result = fit_image(source, size, recipe, request, border, f"try {size.nbytes:,} bytes")
        psnr = table.measured["psnr_db"]
        tried.append({"bytes": size.nbytes, "psnr_db": psnr, "rows": size.rows, "cascaded": size.cascaded})
        log(f"{size.nbytes:,} bytes: {psnr:.2f} dB")
        if psnr >= goal and (kept is None or table.nbytes < kept[0].nbytes):
            kept = table, result
        if result.interrupted and kept is None:
            raise KeyboardInterrupt
        if result.interrupted:
            kept[1].interrupted = True
            break
        enough = min((t["bytes"] for t in tried if t["psnr_db"] >= goal), default=None)
        short = max((t["bytes"] for t in tried if t["psnr_db"] < goal), default=None)
        if enough and short and enough <= NEAR * short:
            break
        if short and size.full and not enough:
            break
        nbytes = middle = _next(tried, goal, enough, short)
        if (
            enough and short
        ):  # where sizes come in steps, the one before may be all that fits into the bytes of the secant
            middle = math.sqrt(enough * short)
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
