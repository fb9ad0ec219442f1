"""Entropy coding of sparse nodes in a file: occupied cells, density levels and palette indices.

Symbols are coded by asymmetric numeral systems (Duda 2013) with probabilities that depend on a context. Many states
(lanes) are interleaved, so that NumPy codes a row of symbols at once. All arithmetic is of integers, so the same bytes
mean the same symbols everywhere. Nodes are coded in passes, from every fourth along each axis to all of them, so that
most lie between coded ones, which are the context of their symbols.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...arrays.sparse_grid import complete_cells
from .nodes import coarser

#: Bits of a probability.
PRECISION = 12

#: Steps of a stored probability in an octave.
OCTAVE = 8

#: Most lanes.
MOST_LANES = 1024

#: Symbols for each lane, roughly: a lane costs four bytes.
LANE_SYMBOLS = 4000

#: Least value of a state after a step; below, 16 more bits are read.
LOWEST = 1 << 16


def frequencies(codes: np.ndarray) -> np.ndarray:
    """Return whole numbers ``(contexts, symbols)`` that sum to ``2**PRECISION`` in each context, from bytes.

    Raises ``ValueError`` if that is not possible.
    """
    values = np.rint(2.0 ** (20 + (np.arange(256) - 255) / OCTAVE)).astype(np.int64)
    values[0] = 0
    raw = values[codes]
    raw[:, 0] += raw.sum(axis=1) == 0  # a context that does not occur
    shares = np.maximum((raw << PRECISION) // raw.sum(axis=1, keepdims=True), raw > 0)
    largest = shares.argmax(axis=1)
    rows = np.arange(len(shares))
    shares[rows, largest] += (1 << PRECISION) - shares.sum(axis=1)
    if (shares[rows, largest] < 1).any():
        raise ValueError("found probabilities that do not sum to 1")
    return shares


class SymbolEncoder:
    """Encoder of symbols in named groups, each with an alphabet and probabilities of its own."""

    def __init__(self):
        self.alphabets, self.calls = {}, []

    def code(self, group: str, contexts: int, symbols: int, context: np.ndarray, given: np.ndarray) -> np.ndarray:
        """Add each ``given`` symbol (below ``symbols``) in its ``context`` (below ``contexts``)."""
        symbol = np.asarray(given, np.int64)
        self.alphabets[group] = (contexts, symbols)
        self.calls.append((group, np.asarray(context, np.int64), symbol))
        return symbol

    def finish(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bytes of all probabilities, and those of the symbols."""
        tables, parts = {}, []
        for name, (contexts, symbols) in self.alphabets.items():
            joined = [c * symbols + s for group, c, s in self.calls if group == name]
            counts = np.bincount(np.concatenate(joined), minlength=contexts * symbols).reshape(contexts, symbols)
            # Logarithms relative to the largest count of a context, as bytes
            relative = np.maximum(counts, 1) / np.maximum(counts.max(axis=1, keepdims=True), 1)
            codes = np.maximum(255 + np.rint(OCTAVE * np.log2(relative)).astype(int), 1)
            codes = np.where(counts > 0, codes, 0).astype(np.uint8)
            share = frequencies(codes)
            tables[name] = codes, share, np.cumsum(share, axis=1) - share
        for group, context, symbol in self.calls:
            _, share, start = tables[group]
            parts.append(np.stack([share[context, symbol], start[context, symbol]]))
        count = sum(part.shape[1] for part in parts)
        lanes = int(np.clip(count // LANE_SYMBOLS, 1, MOST_LANES))
        state, words = np.full(lanes, LOWEST, np.int64), []
        for part in reversed(parts):
            for first in reversed(range(0, part.shape[1], lanes)):
                share, start = part[:, first : first + lanes]
                here = state[: len(share)]
                full = here >= share << (32 - PRECISION)
                words.append((here[full] & 0xFFFF).astype("<u2"))
                here = np.where(full, here >> 16, here)
                state[: len(share)] = (here // share << PRECISION) + here % share + start
        probabilities = np.concatenate([codes.reshape(-1) for codes, _, _ in tables.values()])
        head = np.concatenate([[lanes], state]).astype("<u4").view(np.uint8)
        return probabilities, np.concatenate([head, np.concatenate(words[::-1]).view(np.uint8)])


class SymbolDecoder:
    """Decoder of what an :class:`SymbolEncoder` returned; groups, contexts and their order have to be the same.

    Its methods raise ``ValueError`` if the bytes are too few.
    """

    def __init__(self, probabilities: np.ndarray, data: np.ndarray):
        lanes = int(data[:4].view("<u4")[0]) if len(data) >= 4 else 0
        if not 1 <= lanes <= MOST_LANES or len(data) < 4 * (lanes + 1) or len(data) % 2:
            raise ValueError("found a damaged head of the coded nodes")
        self.state = data[4 : 4 * (lanes + 1)].view("<u4").astype(np.int64)
        self.words = data[4 * (lanes + 1) :].view("<u2").astype(np.int64)
        self.place, self.probabilities, self.tables = 0, probabilities, {}
        # A lane decodes one symbol after the other: few lanes for many symbols would take hours
        self.left = np.inf if lanes == MOST_LANES else LANE_SYMBOLS * (lanes + 1)

    def code(self, group: str, contexts: int, symbols: int, context: np.ndarray, given=None) -> np.ndarray:
        """Return the symbol in each ``context``, for the same arguments as :meth:`SymbolEncoder.code` but ``given``."""
        if group not in self.tables:
            codes, self.probabilities = np.split(self.probabilities, [contexts * symbols])
            if len(codes) < contexts * symbols:
                raise ValueError("found too few probabilities")
            share = frequencies(codes.reshape(contexts, symbols))
            total = np.cumsum(share, axis=1)
            lookup = np.repeat(np.tile(np.arange(symbols, dtype=np.uint8), contexts), share.reshape(-1))
            self.tables[group] = share, total - share, lookup
        share, start, lookup = self.tables[group]
        context = np.asarray(context, np.int64)
        self.left -= len(context)
        if self.left < 0:
            raise ValueError("found more symbols than its lanes hold")
        result = np.empty(len(context), np.int64)
        lanes, mask = len(self.state), (1 << PRECISION) - 1
        for first in range(0, len(context), lanes):
            at = context[first : first + lanes]
            here = self.state[: len(at)]
            slot = here & mask
            symbol = lookup[(at << PRECISION) + slot]
            here = share[at, symbol] * (here >> PRECISION) + slot - start[at, symbol]
            low = np.flatnonzero(here < LOWEST)
            words = self.words[self.place : self.place + len(low)]
            if len(words) < len(low):
                raise ValueError("found too few bytes")
            here[low] = here[low] << 16 | words
            self.place += len(low)
            self.state[: len(at)] = here
            result[first : first + len(at)] = symbol
        return result


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

#: Nodes whose contexts are computed at a time.
PART = 2**15

#: Number of bits that are set in each 16-bit word.
_COUNTS = np.unpackbits(np.arange(2**16, dtype="<u2").view(np.uint8)).reshape(-1, 16).sum(axis=1, dtype=np.uint8)


class TooManyNodes(ValueError):
    """Coded bytes hold more than the most nodes that are accepted; ``count`` is a lower bound of their number."""

    def __init__(self, count: int, most: int):
        super().__init__(f"found {count:,} nodes or more, at most {most:,} are accepted")
        self.count = count


_AROUND = np.array([o for o in np.ndindex(3, 3, 3) if o != (1, 1, 1)]) - 1
_AROUND = _AROUND[np.argsort(np.square(_AROUND).sum(axis=1), kind="stable")]


#: Contexts of :meth:`Pass.named`.
NAMED_CONTEXTS = (NAMED + 1) * (NEAR + 1)


class _Rows:
    """Rows of stored nodes by their place in the grid, from one bit for each place and a rank for each 16 places.

    ``keys`` are the places in ascending order.
    """

    def __init__(self, keys: np.ndarray, size: int):
        words = keys >> 4
        first = np.flatnonzero(np.diff(words, prepend=-1))
        self._words = np.zeros(-(-size // 16), np.uint16)
        if len(keys):
            self._words[words[first]] = np.bitwise_or.reduceat(np.uint16(1) << (keys & 15).astype(np.uint16), first)
        self._ranks = np.cumsum(_COUNTS[self._words], dtype=np.int32)
        self._keys = keys

    def __call__(self, keys: np.ndarray) -> np.ndarray:
        """Return the row of each place, −1 where no node is stored."""
        at, bit = keys >> 4, (keys & 15).astype(np.uint16)
        above = self._words[at] >> bit
        return np.where(above & 1, self._ranks[at] - _COUNTS[above], np.int32(-1))

    def around(self, rows: np.ndarray, offsets: list[int]) -> np.ndarray:
        """Return the rows of the places at ``offsets`` from those of some ``rows``, (m, k) int32."""
        at = self._keys[rows]
        near = np.empty((len(rows), max(1, len(offsets))), np.int32)
        near[:, len(offsets) :] = -1
        for column, offset in enumerate(offsets):
            near[:, column] = self(at + np.int32(offset))
        return near


@dataclass
class Pass:
    """Nodes of a pass: their numbers ``rows`` from 0 on, in a ``group`` that shares probabilities.

    The coded neighbours of a node lie at ``offsets``, with ``weight``, the nearest first. ``near`` ``(m, k)`` are their
    numbers, −1 where there is none; ``None``: they are computed when they are needed.
    """

    rows: np.ndarray
    rows_at: _Rows
    offsets: list[int]
    weight: np.ndarray
    group: str
    near: np.ndarray | None = None

    def blocks(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield parts of the nodes, and the numbers of their coded neighbours."""
        for first in range(0, len(self.rows), PART):
            part = slice(first, first + PART)
            near = self.rows_at.around(self.rows[part], self.offsets) if self.near is None else self.near[part]
            yield part, near

    def level_context(self, levels: np.ndarray, count: int) -> np.ndarray:
        """Return the context of the level of each node, below ``7 * count + 1``, given those of coded nodes."""
        context = np.empty(len(self.rows), np.int64)
        for part, near in self.blocks():
            here, known = levels[near].astype(np.int64), near >= 0
            weight = known * self.weight
            total = weight.sum(axis=1)
            whole = np.maximum(total, 1)
            mean = (2 * (weight * here).sum(axis=1) + whole) // (2 * whole)
            variance = 4 * (weight * np.square(here - mean[:, None])).sum(axis=1) // whole
            spread = np.searchsorted(VARIANCES, variance, side="right")
            context[part] = np.where(total > 0, 7 * np.clip(mean, 0, count - 1) + spread, 7 * count)
        return context

    def named(self, index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return different indices of coded neighbours, ``(m, NAMED)``, −1 where there are fewer, and a context."""
        all_names, context = np.full((len(self.rows), NAMED), -1, np.int32), np.empty(len(self.rows), np.int64)
        for part, near in self.blocks():
            here = np.where(near >= 0, index[near].astype(np.int64), -1)
            names, count = all_names[part], np.zeros(len(here), int)
            first = np.where(here[:, 0] >= 0, here[:, 0], here.max(axis=1))
            votes = ((here == first[:, None]) & (here >= 0)).sum(axis=1)
            for column in here.T:
                new = (column >= 0) & (count < NAMED) & (names != column[:, None]).all(axis=1)
                names[np.flatnonzero(new), count[new]] = column[new]
                count += new
            context[part] = count * (NEAR + 1) + votes
        return all_names, context


def passes_of(stored: np.ndarray) -> list[Pass]:
    """Return the passes of a mask of stored nodes; a node is in one of them."""
    return passes_at(np.flatnonzero(stored).astype(np.int32), stored.shape)


def passes_at(places: np.ndarray, shape: tuple, keep: bool = True) -> list[Pass]:
    """Return the passes of the nodes at ``places`` (n,) int32, flat and in ascending order, in a grid of ``shape``.

    With ``keep``, their neighbours stay in memory, 32 bytes a node.
    """
    room = STRIDES[0]
    sides = np.array(shape) + 2 * room
    steps = np.array([sides[1] * sides[2], sides[2], 1])
    flat, bits = np.empty(len(places), np.int32), {stride: np.empty(len(places), np.uint8) for stride in STRIDES}
    for first in range(0, len(places), PART):
        part = slice(first, first + PART)
        place = _coordinates(places[part], shape)
        flat[part] = (place + room) @ steps
        for stride in STRIDES:
            # Bits of the coordinates, one above the stride, and all bits below it
            on = ((place & (stride - 1)) == 0).all(axis=1)
            bits[stride][part] = np.where(on, (place // stride & 1) @ np.array([4, 2, 1]), 8)
    rows_at = _Rows(flat, int(np.prod(sides)))
    rank_of = {parity: rank for rank, parity in enumerate(PARITIES)}
    result = []

    def add(rows: np.ndarray, around: list, stride: int, group: str) -> None:
        rows, offsets = rows.astype(np.int32), [stride * int(o @ steps) for o in around]
        weight = np.array([WEIGHTS[int(o @ o)] for o in around] or [1], np.int64)
        result.append(Pass(rows, rows_at, offsets, weight, group, rows_at.around(rows, offsets) if keep else None))

    add(np.flatnonzero(bits[STRIDES[0]] == 0), [], 1, "first")
    for stride in STRIDES:
        for rank, parity in enumerate(PARITIES[1:], 1):
            coded = [o for o in _AROUND if rank_of[tuple((np.array(parity) + o) & 1)] < rank]
            rows = np.flatnonzero(bits[stride] == _parity_bit(parity))
            add(rows, coded[:NEAR], stride, "coarse" if stride > 1 else str(sum(parity)))
    return result


def encode(stored: np.ndarray, levels: np.ndarray, index: np.ndarray, level_count: int, colours: int) -> tuple:
    """Return the bytes of the probabilities and of the nodes that are ``stored``.

    ``levels`` and ``index`` ``(n,)`` are those of the stored nodes, below ``level_count`` and ``colours``. Each stored
    node is a corner of an occupied cell.
    """
    coder = SymbolEncoder()
    _cells(coder, tuple(n - 1 for n in stored.shape), complete_cells(stored))
    _numbers(coder, passes_of(stored), level_count, colours, levels, index)
    return coder.finish()


def decode(probabilities, data, shape, level_count: int, colours: int, most: int = MOST_STORED) -> tuple:
    """Return the places of stored nodes, flat and in ascending order, their levels and their indices.

    Memory grows with the nodes, and takes half a byte for each place of the grid. Raises ``ValueError`` for damaged
    bytes, :class:`TooManyNodes` for more than ``most`` nodes.
    """
    coder = SymbolDecoder(probabilities, data)
    places = _corners(_cells(coder, tuple(n - 1 for n in shape), most=most), shape, most)
    return places, *_numbers(coder, passes_at(places, shape, keep=False), level_count, colours)


def _corners(cells: np.ndarray, shape: tuple, most: int) -> np.ndarray:
    """Return the places of the corners of ``cells``, in a grid of ``shape`` nodes, flat and in ascending order.

    Cells are given by the places of their first corners.
    """
    places = cells
    for step in (1, shape[2], shape[1] * shape[2]):
        places = np.concatenate([places, places + np.int32(step)])
        places.sort()
        places = places[np.concatenate([[True], places[1:] != places[:-1]])[: len(places)]]
        if len(places) > most:
            raise TooManyNodes(len(places), most)
    return places


def _cells(coder, shape: tuple, cells: np.ndarray | None = None, most: int = MOST_STORED) -> np.ndarray:
    """Code a mask of cells from coarse to fine: the halves of occupied cells, given the cells around them.

    Returns the places of the first corners of the occupied cells, int32, in ascending order. Raises
    :class:`TooManyNodes` for more than ``most`` cells.
    """
    sides, masks = [shape], [cells]
    for _ in range(HALVINGS):
        sides.append(tuple(-(-n // 2) for n in sides[-1]))
        masks.append(None if cells is None else coarser(masks[-1]))
    nothing = np.zeros(int(np.prod(sides[-1])), np.int64)
    given = None if cells is None else masks[-1].reshape(-1)
    occupied = coder.code("blocks", 1, 2, nothing, given).astype(bool)
    parents = _coordinates(np.flatnonzero(occupied), sides[-1])
    for level in reversed(range(HALVINGS)):
        inside, room = np.array(sides[level]), np.array(sides[level + 1]) + 2
        steps = np.array([room[1] * room[2], room[2], 1])
        # A byte for each larger cell, with a border of empty ones, and a bit for each of its halves: first all, if the
        # larger cell is occupied, then those that are
        halves, flat = np.zeros(int(np.prod(room)), np.uint8), (parents + 1) @ steps
        halves[flat] = 255
        for rank, parity in enumerate(PARITIES):
            within = (2 * parents + np.int32(parity) < inside).all(axis=1)
            halves[flat[~within]] &= np.uint8(255 ^ 1 << _parity_bit(parity))
            at = flat[within]
            beside, near = np.zeros(len(at), np.uint8), np.zeros(len(at), np.uint8)
            for o in _AROUND:
                place = np.array(parity) + o
                value = halves[at + int((place >> 1) @ steps)] >> np.uint8(_parity_bit(place & 1)) & np.uint8(1)
                if o @ o == 1:
                    beside += value
                else:
                    near += value
            context = (rank * 7 + beside.astype(np.int64)) * 7 + np.minimum(near // 3, 6)
            place = tuple((2 * parents[within] + parity).T)
            given = None if cells is None else masks[level][place]
            symbol = coder.code(f"cells {min(level, 2)}", 8 * 49, 2, context, given)
            halves[at[symbol == 0]] &= np.uint8(255 ^ 1 << _parity_bit(parity))
        if (count := int(_COUNTS[halves[flat]].sum())) > most:
            raise TooManyNodes(count, most)
        grid = tuple(n + 1 for n in shape) if level == 0 else sides[level]
        places = []
        for parity in PARITIES:
            owner = np.flatnonzero(halves[flat] & 1 << _parity_bit(parity))
            corner = (2 * parents[owner] + np.int32(parity)).T
            places.append(np.ravel_multi_index(corner, grid).astype(np.int32))
        places = np.concatenate(places)
        places.sort()
        if level:
            parents = _coordinates(places, grid)
    return places


def _coordinates(places: np.ndarray, shape: tuple) -> np.ndarray:
    """Return flat places of a grid as coordinates, (n, 3) int32."""
    return np.stack([x.astype(np.int32) for x in np.unravel_index(places, shape)], axis=1)


def _parity_bit(parity) -> int:
    """Return the bit of a half by its place in the larger cell, three numbers 0 or 1."""
    x, y, z = parity
    return int(4 * x + 2 * y + z)


def _numbers(coder, passes: list[Pass], level_count: int, colours: int, levels=None, index=None) -> tuple:
    """Code the levels and the indices of nodes, each given those of its coded neighbours; without them, decode them."""
    count = sum(len(part.rows) for part in passes)
    coded_levels, coded_index = np.zeros(count, np.uint8), np.zeros(count, np.uint16)
    for part in passes:
        context, given = part.level_context(coded_levels, level_count), None if levels is None else levels[part.rows]
        symbol = coder.code(f"levels {part.group}", 7 * level_count + 1, level_count, context, given)
        coded_levels[part.rows] = symbol
    upper = ((colours - 1) >> LOW_BITS) + 1
    for part in passes:
        names, context = part.named(coded_index)
        given = None if index is None else naming(names, index, part.rows)
        symbol = coder.code(f"names {part.group}", NAMED_CONTEXTS, NAMED + 1, context, given)
        value = names[np.arange(len(names)), np.minimum(symbol, NAMED - 1)]
        new = np.flatnonzero(symbol == NAMED)
        fresh = fresh_context(names[new], colours)
        given = (None, None) if index is None else divmod(index[part.rows[new]], 1 << LOW_BITS)
        high = coder.code("upper", PARTS + 1, upper, fresh, given[0])
        low = coder.code("lower", upper, 1 << LOW_BITS, high, given[1])
        value[new] = high << LOW_BITS | low
        # Before the next pass, whose contexts follow from it
        if value.min(initial=0) < 0 or value.max(initial=0) >= colours:
            raise ValueError("found an index beyond the palette")
        coded_index[part.rows] = value
    return coded_levels, coded_index


def naming(names: np.ndarray, index: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the place of each ``index`` of some ``rows`` among the ``names`` of its neighbours, or :data:`NAMED`."""
    equal = names == index[rows, None]
    return np.where(equal.any(axis=1), equal.argmax(axis=1), NAMED)


def fresh_context(names: np.ndarray, colours: int) -> np.ndarray:
    """Return the context of an index that no neighbour has: the part of the palette where the first neighbour's is."""
    return np.where(names[:, 0] >= 0, names[:, 0] * PARTS // colours, PARTS)
