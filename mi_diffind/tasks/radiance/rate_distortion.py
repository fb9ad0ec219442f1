"""Rate and distortion of a compressed grid: what a change of a node costs the images, and what a symbol costs the file.

The cost of a change is the diagonal of the Gauss-Newton matrix: the sum of squared derivatives of the images' sRGB
values. It is estimated by derivatives of sums with random signs (Hutchinson). Levels and indices are chosen, pass by
pass, by this cost plus a rate times their bits in their context (:mod:`.node_codes`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import numpy as np
from scipy.spatial import cKDTree

from ...core.progress import Deadline
from ...images import srgb
from . import node_codes
from .grid import NodeGrid
from .march import differentiable
from .node_codes import Pass
from .session import FieldSession
from .volume_field import NodeField

#: Rays of an estimate for each pixel of the training views, rays at a time, and the least estimates.
RAYS_PER_PIXEL, RAYS, LEAST = 0.2, 2**16, 8

#: Nearest colours that are tried for a node, and the error allowed in finding them.
NEAREST, SLACK = 8, 0.3

#: Counts that a context has before it occurs, of levels shared by all contexts of a variance, and of symbols.
PRIOR, LEAST_COUNT = 20.0, 0.05

#: Rounds of choosing levels, and indices.
LEVEL_ROUNDS, INDEX_ROUNDS = 3, 2


@dataclass
class Importance:
    """What a change of the numbers of stored nodes costs: the mean squared error of the images per squared change.

    ``density`` ``(n,)`` is that of raw densities, ``colour`` ``(n,)`` that of colours in units in which ``metric``
    ``(columns,)`` is the weight of each column. ``loss`` is the mean squared error of the grid itself.
    """

    density: np.ndarray
    colour: np.ndarray
    metric: np.ndarray
    loss: float


def importance(grid: NodeGrid, session: FieldSession, seed: int, deadline: Deadline | None = None) -> Importance:
    """Return the importance of the nodes of a grid in the training views; at the deadline, from fewer rays."""
    types, images, views = session.types, session.images, session.views
    net = grid.tensors()
    environment = net.pop("environment", None)
    squares = [dr.zeros(types.Float, v.size) for v in (grid.density, grid.colour)]
    batches = max(LEAST, round(RAYS_PER_PIXEL * len(views) * views.mean_pixels / RAYS))
    loss, count = 0.0, 0
    for batch in range(batches):
        if deadline is not None and deadline.passed and count:
            break
        rng = dr.rng((seed << 32) + batch)
        view, x, y = images.random_pixels(rng, RAYS)
        rays = dr.width(view)
        offset, behind = rng.random(types.TensorXf, (rays,)).array, images.behind(rng, rays)
        arrays = {name: type(tensor)(tensor) for name, tensor in net.items()}
        dr.enable_grad(arrays)
        field = NodeField(grid.nodes, **arrays, environment=environment).for_training()
        seen = differentiable(field, *images.rays(view, x, y), 0, dr.inf, True, offset)
        truth, total, error = images.colours(view, x, y), types.Float(0), types.Float(0)
        for c in range(3):
            shown = srgb.from_linear(seen.colour[c] + seen.transmittance * behind[c], fused=False)
            reference = srgb.from_linear(dr.clip(truth[c] + (1 - truth[3]) * behind[c], 0, 1), fused=False)
            error += dr.square(dr.detach(shown) - reference)
            total += dr.select(rng.random(types.TensorXf, (rays,)).array < 0.5, shown, -shown)
        counted = images.counted(view, x, y)
        dr.backward(dr.select(counted, total, 0))
        squares = [dr.fma(g, g, s) for g, s in zip((dr.grad(a).array for a in arrays.values()), squares, strict=True)]
        error = dr.sum(dr.select(counted, error, 0))
        dr.eval(squares, error)
        loss, count = loss + float(error[0]), count + rays
    density, colour = (s.numpy().astype(np.float64) / (3 * count) for s in squares)
    colour = colour.reshape(grid.colour.shape)[1:]
    metric = np.maximum(colour.mean(axis=0), 1e-30)
    return Importance(density[1:], (colour / metric).mean(axis=1), metric, loss / (3 * count))


def costs(counts: np.ndarray) -> np.ndarray:
    """Return the bits of symbols by their counts ``(contexts, symbols)``."""
    counts = counts + LEAST_COUNT
    return -np.log2(counts / counts.sum(axis=1, keepdims=True))


def level_costs(levels: np.ndarray, context: np.ndarray, count: int) -> np.ndarray:
    """Return the bits of each level in each context of :meth:`.node_codes.Pass.level_context`.

    Rare contexts resemble others of the same variance: the level relative to the mean counts.
    """
    contexts = 7 * count + 1
    counts = np.bincount(context * count + levels, minlength=contexts * count).reshape(contexts, count).astype(float)
    mean, spread = np.arange(contexts) // 7, np.arange(contexts) % 7
    relative = np.full((7, 2 * count), LEAST_COUNT)
    known = context < 7 * count
    np.add.at(relative, (context[known] % 7, levels[known] - context[known] // 7 + count), 1.0)
    prior = relative[spread[:, None], np.arange(count) - np.minimum(mean, count - 1)[:, None] + count]
    return costs(counts + PRIOR * prior / prior.sum(axis=1, keepdims=True))


def chosen_levels(passes: list[Pass], exact: np.ndarray, weight: np.ndarray, rate: float, count: int) -> np.ndarray:
    """Return the levels of nodes, below ``count``, given ``exact`` ones.

    A squared difference counts ``weight`` ``(n,)`` and a bit of the file ``rate``.
    """
    levels = np.clip(np.rint(exact), 0, count - 1).astype(np.int64)
    every = np.arange(count)
    for turn in range(LEVEL_ROUNDS):
        tables = [level_costs(levels[p.rows], p.level_context(levels, count), count) for p in passes]
        for part, table in zip(passes, tables, strict=True):
            rows = part.rows
            difference = weight[rows, None] * np.square(exact[rows, None] - every)
            share = rate * (turn + 1) / LEVEL_ROUNDS
            levels[rows] = np.argmin(difference + share * table[part.level_context(levels, count)], axis=1)
    return levels


class IndexCosts:
    """Bits of the index of each node of passes, estimated from counts of a whole ``index``."""

    def __init__(self, passes: list[Pass], index: np.ndarray, colours: int):
        upper = ((colours - 1) >> node_codes.LOW_BITS) + 1
        self.names, fresh, context = [], [], []
        for part in passes:
            names, place = part.named(index)
            symbol = node_codes.naming(names, index[part.rows])
            width = node_codes.NAMED + 1
            counts = np.bincount(place * width + symbol, minlength=node_codes.NAMED_CONTEXTS * width)
            self.names.append(costs(counts.reshape(-1, width)))
            new = symbol == node_codes.NAMED
            fresh.append(index[part.rows][new])
            context.append(node_codes.fresh_context(names[new], colours))
        fresh, context = np.concatenate(fresh), np.concatenate(context)
        parts = node_codes.PARTS + 1
        high = np.bincount(context * upper + (fresh >> node_codes.LOW_BITS), minlength=parts * upper)
        low = np.bincount(fresh, minlength=upper << node_codes.LOW_BITS).reshape(upper, -1)
        #: Bits of an index that no neighbour has, by context and index.
        self.fresh = costs(high.reshape(parts, upper)).repeat(1 << node_codes.LOW_BITS, axis=1) + costs(low).reshape(-1)


def chosen_index(
    passes: list[Pass], points: np.ndarray, weight: np.ndarray, centres: np.ndarray, rate: float, index=None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ``centres`` ``(P, c)``, moved, and the index of a centre for each of the ``points`` ``(n, c)``.

    A squared difference counts ``weight`` ``(n,)`` and a bit of the file ``rate``. ``index`` is where the search begins
    (default: the nearest centres).
    """
    colours, near = len(centres), min(NEAREST, len(centres))
    for _ in range(INDEX_ROUNDS):
        nearest = cKDTree(centres).query(points, k=near, eps=SLACK)[1].reshape(len(points), near)
        index = nearest[:, 0].astype(np.int64) if index is None else index
        bits = IndexCosts(passes, index, colours)
        for part, named in zip(passes, bits.names, strict=True):
            names, context = part.named(index)
            fresh = node_codes.fresh_context(names, colours)
            tried = np.concatenate([names, nearest[part.rows]], axis=1)
            price = np.concatenate(
                [named[context, : node_codes.NAMED],
                 named[context, node_codes.NAMED, None] + bits.fresh[fresh[:, None], nearest[part.rows]]], axis=1,
            )  # fmt: skip
            best, pick = np.full(len(tried), np.inf), np.zeros(len(tried), np.int64)
            for column, bit in zip(tried.T, price.T, strict=True):
                away = np.square(points[part.rows] - centres[np.maximum(column, 0)]).sum(axis=1)
                cost = np.where(column >= 0, weight[part.rows] * away + rate * bit, np.inf)
                better = cost < best
                best[better], pick[better] = cost[better], column[better]
            index[part.rows] = pick
        centres = moved(points, weight, index, centres)
    return centres, index


def moved(points: np.ndarray, weight: np.ndarray, index: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """Return the weighted means of the points of each centre; those without points stay."""
    total = np.bincount(index, weight, len(centres))
    sums = np.stack([np.bincount(index, weight * column, len(centres)) for column in points.T], axis=1)
    return np.where(total[:, None] > 0, sums / np.maximum(total, 1e-300)[:, None], centres)
