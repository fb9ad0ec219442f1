"""Choice of a memory budget: by rule, by short trainings (``--ratio-search``), or by a wanted quality (``--psnr``)."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from ...arrays.tables import Table
from ...fitting.loop import FitResult
from ...fitting.task import FitRequest
from ...maps.source import Source
from . import memory_budget
from .memory_budget import CoarsePrimary, ImageBudget
from .presets import PAGED, STRUCTURES, ImageRecipe, replaced
from .training import dims_of, fit_image, layout_of, structure_of

#: Share of the steps that a candidate of a search is trained for.
SHORT = 1 / 8

#: Share of a limited time for such a search, and the number of candidates that share it; the best is trained longer.
SEARCHED, CANDIDATES = 2 / 3, 16

#: Most trainings of a search by quality whose time is limited.
LIMITED = 4

#: Sides of the cascaded array that a search tries, by its dimensions.
SIDES = {1: (64, 256), 2: (16, 32, 64), 3: (8, 16, 32), 4: (4, 8, 12, 16)}

#: Structures of the primary that a search tries.
TRIED = ("8 bits", "6 bits", "4 bits", "4 + 8 bits", "3 + 6 bits", "2 + 6 bits", *PAGED)

#: Largest ratio of the smallest sufficient and the largest insufficient file at which a search by quality ends.
NEAR = 1.06


@dataclass
class RatioSearch:
    """Result of :func:`ratio_search`.

    ``tried`` has one dictionary a training (sizes, ``bytes``, ``psnr_db``). ``best`` is the table and the record of the
    best short training, which an interrupted search returns.
    """

    size: ImageBudget
    recipe: ImageRecipe
    tried: list[dict]
    best: tuple[Table, FitResult] | None = None
    interrupted: bool = False


def default_size(source: Source, nbytes: float, recipe: ImageRecipe, ratio: float | None = None) -> ImageBudget:
    """Return the default budget of a recipe for ``nbytes`` bytes.

    The supplement's search, with ``ratio`` in place of its table if given; or, with ``components`` or two primaries, a
    cascaded array of :func:`.memory_budget.cascaded_side` and the largest primary that fits beside it.
    """
    stored, structure = max(1, layout_of(source, recipe).stored), structure_of(source, recipe, nbytes)
    bits, coarse = STRUCTURES[structure]
    if recipe.components or coarse:
        dims = dims_of(recipe, structure, stored)
        return sized(source, nbytes, recipe, memory_budget.cascaded_side(nbytes, stored, dims))
    compression = source.nbytes / nbytes
    height, width = source.height, source.width
    return memory_budget.search(source.nbytes, compression, stored, height, width, recipe.dims, bits, ratio)


def sized(source: Source, nbytes: float, recipe: ImageRecipe, cascaded: int) -> ImageBudget:
    """Return the budget for ``nbytes`` bytes with a cascaded array of a given side; its dims are :func:`.dims_of`."""
    stored, structure = max(1, layout_of(source, recipe).stored), structure_of(source, recipe, nbytes)
    (bits, coarse), paged = STRUCTURES[structure], structure in PAGED
    dims = dims_of(recipe, structure, stored)
    size = memory_budget.fit_bytes(nbytes, stored, source.height, source.width, cascaded, dims, bits, coarse)
    return dataclasses.replace(size, paged=paged)


def ratio_search(
    source: Source, nbytes: float, recipe: ImageRecipe, request: FitRequest, free: bool = True, border=None
) -> RatioSearch:
    """Return the best of several budgets of ``nbytes`` bytes, each trained for :data:`SHORT` of the steps.

    The side of the cascaded array (and so the ratio ρ) is varied first; with ``free`` then the structure of the primary
    and the dimensions. The best so far is kept after each. ``request`` and ``border`` are those of :func:`.fit_image`.
    """
    steps = max(20, round(recipe.settings.steps * SHORT))
    tried, tables, limit = [], [], request.part(SEARCHED).deadline

    def attempt(recipe: ImageRecipe, side: int) -> bool:
        """Train a candidate, unless it is known or too large; returns whether the training was interrupted."""
        size = sized(source, nbytes, recipe, side)
        structure, recipe = structure_of(source, recipe, nbytes), dataclasses.replace(recipe, dims=size.dims)
        known = any((t["dims"], t["structure"], t["cascaded"]) == (recipe.dims, structure, side) for t in tried)
        if tried and limit is not None and limit.left() < limit.seconds / CANDIDATES:
            return False
        if known or size.nbytes > nbytes * (1 + memory_budget.TOLERANCE):
            return False
        title = f"try {size.columns}×{size.rows}×{size.dims} of {structure} → {size.cascaded}"
        shortened = replaced(recipe, steps=steps, measure_every=steps)
        candidate = request
        if limit is not None:
            candidate = dataclasses.replace(request, deadline=limit.part(limit.seconds / CANDIDATES / limit.left()))
        table, result = fit_image(source, size, shortened, candidate, border, title)
        tried.append({
            "dims": size.dims, "structure": structure, "cascaded": side, "rows": size.rows, "columns": size.columns,
            "ratio": size.ratio, "bytes": table.nbytes, "psnr_db": table.measured["psnr_db"],
            "psnr_between_db": table.measured["psnr_between_db"],
        })  # fmt: skip
        if best() is tried[-1]:
            tables[:] = [(table, result)]
        return result.interrupted

    def best() -> dict | None:
        """Return the training with the best mean of the quality at texels and between them."""
        return max(tried, key=lambda t: 0.5 * (t["psnr_db"] + t["psnr_between_db"]), default=None)

    start, interrupted = default_size(source, nbytes, recipe), False
    structure, recipe = structure_of(source, recipe, nbytes), dataclasses.replace(recipe, dims=start.dims)
    for candidates in _candidates(recipe, structure, start.cascaded, free, best):
        interrupted = any(attempt(candidate, side) for candidate, side in candidates)
        if interrupted:
            break
    if not tried:
        return RatioSearch(start, recipe, tried)
    tables[0][1].interrupted = interrupted
    chosen = best()
    recipe = dataclasses.replace(recipe, structure=chosen["structure"], dims=chosen["dims"])
    return RatioSearch(sized(source, nbytes, recipe, chosen["cascaded"]), recipe, tried, tables[0], interrupted)


def _candidates(recipe: ImageRecipe, structure: str, side: int, free: bool, best: Callable) -> Iterator[list]:
    """Yield lists of (recipe, side) to try; each depends on the results of the lists before."""
    yield [(recipe, s) for s in sorted(SIDES[recipe.dims], key=lambda s: abs(math.log(s / side)))]
    leader = best()
    if not free or leader is None:  # not even the smallest cascaded array fits
        return
    several = recipe.dims > CoarsePrimary().dims
    tried = [s for s, (_, coarse) in STRUCTURES.items() if s in TRIED and s != structure and (several or not coarse)]
    yield [(dataclasses.replace(recipe, structure=s), leader["cascaded"]) for s in tried]
    leader = best()
    recipe = dataclasses.replace(recipe, structure=leader["structure"], dims=leader["dims"])
    yield [(recipe, s) for s in SIDES[recipe.dims] if abs(math.log2(s / leader["cascaded"])) <= 1]
    if STRUCTURES[leader["structure"]][1] is None:
        other = [d for d in (2, 3, 4) if d != recipe.dims]
        yield [(dataclasses.replace(recipe, dims=d), SIDES[d][1]) for d in other]
        recipe = dataclasses.replace(recipe, dims=best()["dims"])
        yield [(recipe, s) for s in SIDES[recipe.dims]]


def psnr_search(
    source: Source,
    goal: float,
    recipe: ImageRecipe,
    request: FitRequest,
    border=None,
    most: int = 8,
    log: Callable[[str], None] = print,
) -> tuple[Table | None, FitResult | None, list[dict]]:
    """Search the smallest file whose ``psnr_db`` is at least ``goal``, by trainings of full length.

    Sizes follow the secant of quality over the logarithm of bytes. The search ends when a sufficient size is within
    :data:`NEAR` of an insufficient one, or after ``most`` trainings. Returns the table (``None`` if not even the
    largest primary reaches the goal), the record of its training, and the list of trainings. ``log`` gets a line for
    each. After Ctrl-C the record is marked ``interrupted``; ``KeyboardInterrupt`` is raised if no training had reached
    the goal.
    """
    tried, kept = [], None
    most = most if request.deadline is None else min(most, LIMITED)
    nbytes = middle = source.nbytes / 12
    while len(tried) < most:
        sizes = [default_size(source, n, recipe) for n in (nbytes, middle)]
        size = next((s for s in sizes if all(t["bytes"] != s.nbytes for t in tried)), None)
        if size is None:
            break
        limited = request.part(1 / (most - len(tried)))
        table, result = fit_image(source, size, recipe, limited, border, f"try {size.nbytes:,} bytes")
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
        if enough and short:  # sizes come in steps: the secant may lead to one that was tried
            middle = math.sqrt(enough * short)
    return (*(kept or (None, None)), tried)


def _next(tried: list[dict], goal: float, enough: int | None, short: int | None) -> float:
    """Return the bytes to try next."""
    if enough and short:
        a, b = (next(t for t in tried if t["bytes"] == n) for n in (short, enough))
        share = (goal - a["psnr_db"]) / max(b["psnr_db"] - a["psnr_db"], 1e-6)
        share = min(max(share, 0.15), 0.85)
        return short * (enough / short) ** share
    last = tried[-1]
    octaves = (goal - last["psnr_db"]) / 2.5  # about 2.5 dB for twice the bytes
    octaves = math.copysign(min(max(abs(octaves) * 1.2, 0.25), 3), octaves)
    return last["bytes"] * 2**octaves
