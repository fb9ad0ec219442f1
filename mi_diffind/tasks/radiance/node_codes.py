"""Coded form of sparse nodes in a file: occupied cells, density levels and palette indices (:mod:`.ans`).

Nodes are coded in passes, from every fourth along each axis to all of them, so that most lie between coded ones, which
are the context of their symbols.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from . import ans
from .nodes import cells_of, corners_of

#: Parities of the coordinates of nodes, and of cells of twice the size, in the order in which they are coded.
PARITIES = ((0, 0, 0), (1, 1, 1), (0, 1, 1), (1, 0, 1), (1, 1, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1))

#: Steps between nodes, from the second pass on: a node has coded neighbours at this distance.
STRIDES = (2, 1)

#: Neighbours that are the context of a node, and different indices among them that can be named.
NEAR, NAMED = 8, 6

#: Weights of neighbours by their squared distance.
WEIGHTS = (0, 36, 9, 4)

#: Classes of the variance of the levels around a node, four times as large.
VARIANCES = (1, 3, 9, 25, 64, 196)

#: Bits of the lower part of an index, and the parts of the palette that are contexts of the upper part.
LOW_BITS, PARTS = 6, 16

#: Halvings of the grid of cells; the coarsest one begins.
HALVINGS = 4

#: Most stored nodes of a file: a few bytes may claim any number.
MOST_STORED = 2**25

_AROUND = np.array([o for o in np.ndindex(3, 3, 3) if o != (1, 1, 1)]) - 1
_AROUND = _AROUND[np.argsort(np.square(_AROUND).sum(axis=1), kind="stable")]


@dataclass
class Pass:
    """Nodes of a pass: their numbers ``rows`` from 0 on, in a ``group`` that shares probabilities.

    ``near`` ``(m, k)`` are the numbers of coded neighbours, −1 where there is none, the nearest first, with ``weight``.
    """

    rows: np.ndarray
    near: np.ndarray
    weight: np.ndarray
    group: str

    def level_context(self, levels: np.ndarray, count: int) -> np.ndarray:
        """Return the context of the level of each node, below ``7 * count + 1``, given those of coded nodes."""
        here, known = levels.astype(np.int64)[self.near], self.near >= 0
        weight = known * self.weight
        total = weight.sum(axis=1)
        whole = np.maximum(total, 1)
        mean = (2 * (weight * here).sum(axis=1) + whole) // (2 * whole)
        variance = 4 * (weight * np.square(here - mean[:, None])).sum(axis=1) // whole
        spread = np.searchsorted(VARIANCES, variance, side="right")
        return np.where(total > 0, 7 * np.clip(mean, 0, count - 1) + spread, 7 * count)

    def named(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return different indices of coded neighbours, ``(m, NAMED)``, −1 where there are fewer, and a context."""
        here = np.where(self.near >= 0, index.astype(np.int64)[self.near], -1)
        here = np.pad(here, ((0, 0), (0, NEAR - here.shape[1])), constant_values=-1)
        names, count = np.full((len(here), NAMED), -1), np.zeros(len(here), int)
        first = np.where(here[:, 0] >= 0, here[:, 0], here.max(axis=1, initial=-1))
        votes = ((here == first[:, None]) & (here >= 0)).sum(axis=1)
        for column in here.T:
            new = (column >= 0) & (count < NAMED) & (names != column[:, None]).all(axis=1)
            names[np.flatnonzero(new), count[new]] = column[new]
            count += new
        return names, count * (NEAR + 1) + votes


#: Contexts of :meth:`Pass.named`.
NAMED_CONTEXTS = (NAMED + 1) * (NEAR + 1)


def passes_of(stored: np.ndarray) -> list[Pass]:
    """Return the passes of a mask of stored nodes; a node is in one of them."""
    place = np.argwhere(stored).astype(np.int32)
    room = STRIDES[0]
    sides = np.array(stored.shape) + 2 * room
    numbers = np.full(sides, -1, np.int32)
    numbers[tuple((place + room).T)] = np.arange(len(place))
    numbers = numbers.reshape(-1)
    steps = np.array([sides[1] * sides[2], sides[2], 1])
    flat = (place + room) @ steps
    kind_of = {parity: rank for rank, parity in enumerate(PARITIES)}
    finest = ((place % (2 * STRIDES[0])) == 0).all(axis=1)
    result = [_pass(np.flatnonzero(finest), np.zeros((0, 3), int), 1, flat, steps, numbers, "first")]
    for stride in STRIDES:
        on = ((place % stride) == 0).all(axis=1)
        for rank, parity in enumerate(PARITIES[1:], 1):
            rows = np.flatnonzero(on & ((place // stride & 1) == parity).all(axis=1))
            coded = [o for o in _AROUND if kind_of[tuple((np.array(parity) + o) & 1)] < rank]
            group = "coarse" if stride > 1 else str(sum(parity))
            result.append(_pass(rows, np.array(coded[:NEAR]), stride, flat, steps, numbers, group))
    return result


def _pass(rows, around, stride, flat, steps, numbers, group) -> Pass:
    near = np.stack([numbers[flat[rows] + stride * int(o @ steps)] for o in around], axis=1) if len(around) else None
    weight = np.array([WEIGHTS[int(o @ o)] for o in around], np.int64)
    if near is None:
        near = np.full((len(rows), 1), -1, np.int32)
        weight = np.ones(1, np.int64)
    return Pass(rows, near, weight, group)


def encoded(stored: np.ndarray, levels: np.ndarray, index: np.ndarray, level_count: int, colours: int) -> tuple:
    """Return the bytes of the probabilities and of the nodes that are ``stored``.

    ``levels`` and ``index`` ``(n,)`` are those of the stored nodes, below ``level_count`` and ``colours``. Each stored
    node is a corner of an occupied cell.
    """
    coder = ans.SymbolEncoder()
    _cells(coder, tuple(n - 1 for n in stored.shape), cells_of(stored))
    _numbers(coder, stored, level_count, colours, levels, index)
    return coder.finish()


def decoded(probabilities, data, shape, level_count: int, colours: int) -> tuple:
    """Return the mask of stored nodes, their levels and their indices. Raises ``ValueError`` for damaged bytes."""
    coder = ans.SymbolDecoder(probabilities, data)
    stored = corners_of(_cells(coder, tuple(n - 1 for n in shape)))
    if (count := np.count_nonzero(stored)) > MOST_STORED:
        raise ValueError(f"found {count:,} nodes, at most {MOST_STORED:,} are accepted")
    return stored, *_numbers(coder, stored, level_count, colours)


def _cells(coder, shape: tuple, cells: np.ndarray | None = None) -> np.ndarray:
    """Code a mask of cells from coarse to fine: the halves of occupied cells, given the cells around them."""
    sides = [shape]
    for _ in range(HALVINGS):
        sides.append(tuple(-(-n // 2) for n in sides[-1]))
    masks = [cells] * (HALVINGS + 1)
    if cells is not None:
        for level in range(1, HALVINGS + 1):
            before = np.pad(masks[level - 1], [(0, n % 2) for n in sides[level - 1]])
            x, y, z = (n // 2 for n in before.shape)
            masks[level] = before.reshape(x, 2, y, 2, z, 2).any(axis=(1, 3, 5))
    count = int(np.prod(sides[-1]))
    known = None if cells is None else masks[-1].reshape(-1)
    mask = np.asarray(coder.code("blocks", 1, 2, np.zeros(count, int), known)).reshape(sides[-1]).astype(bool)
    for level in reversed(range(HALVINGS)):
        inside = np.array(sides[level])
        parents = np.argwhere(mask)
        around = np.zeros(2 * np.array(mask.shape) + 2, np.uint8)
        around[1:-1, 1:-1, 1:-1] = mask.repeat(2, axis=0).repeat(2, axis=1).repeat(2, axis=2)
        steps = np.array([around.shape[1] * around.shape[2], around.shape[2], 1])
        flat = around.reshape(-1)
        for rank, parity in enumerate(PARITIES):
            place = 2 * parents + parity
            outside = (place >= inside).any(axis=1)
            at = (place + 1) @ steps
            flat[at[outside]] = 0
            place, at = place[~outside], at[~outside]
            beside, near = np.zeros(len(at), np.uint8), np.zeros(len(at), np.uint8)
            for o in _AROUND:
                value = flat[at + int(o @ steps)]
                if o @ o == 1:
                    beside += value
                else:
                    near += value
            context = (rank * 7 + beside.astype(int)) * 7 + np.minimum(near // 3, 6)
            known = None if cells is None else masks[level][tuple(place.T)]
            flat[at] = coder.code(f"cells {min(level, 2)}", 8 * 49, 2, context, known)
        mask = around[1:-1, 1:-1, 1:-1][tuple(slice(n) for n in sides[level])].astype(bool)
    return mask


def _numbers(coder, stored, level_count: int, colours: int, levels=None, index=None) -> tuple:
    """Code the levels and the indices of nodes, each given those of its coded neighbours."""
    passes, count = passes_of(stored), int(np.count_nonzero(stored))
    coded_levels, coded_index = np.zeros(count, np.int64), np.zeros(count, np.int64)
    for part in passes:
        context = part.level_context(coded_levels, level_count)
        known = None if levels is None else levels[part.rows]
        contexts = 7 * level_count + 1
        coded_levels[part.rows] = coder.code(f"levels {part.group}", contexts, level_count, context, known)
    upper = ((colours - 1) >> LOW_BITS) + 1
    for part in passes:
        names, context = part.named(coded_index)
        known = None if index is None else index[part.rows].astype(np.int64)
        symbol = None if index is None else naming(names, known)
        symbol = coder.code(f"names {part.group}", NAMED_CONTEXTS, NAMED + 1, context, symbol)
        value = names[np.arange(len(names)), np.minimum(symbol, NAMED - 1)]
        new = np.flatnonzero(symbol == NAMED)
        given = None if index is None else known[new]
        high = coder.code("upper", PARTS + 1, upper, fresh_context(names[new], colours), _part(given, LOW_BITS))
        low = coder.code("lower", upper, 1 << LOW_BITS, high, None if given is None else given & ((1 << LOW_BITS) - 1))
        value[new] = high << LOW_BITS | low
        coded_index[part.rows] = value
    if coded_index.min(initial=0) < 0 or coded_index.max(initial=0) >= colours:
        raise ValueError("found an index beyond the palette")
    return coded_levels, coded_index


def _part(values, shift: int):
    return None if values is None else values >> shift


def naming(names: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Return the place of each index among the ``names`` of its neighbours, or :data:`NAMED`."""
    equal = names == index[:, None]
    return np.where(equal.any(axis=1), equal.argmax(axis=1), NAMED)


def fresh_context(names: np.ndarray, colours: int) -> np.ndarray:
    """Return the context of an index that no neighbour has: the part of the palette where the first neighbour's is."""
    return np.where(names[:, 0] >= 0, names[:, 0] * PARTS // colours, PARTS)
