"""Entropy coding of symbols whose probabilities depend on a context: asymmetric numeral systems (Duda 2013).

Many states (lanes) are interleaved, so that NumPy codes a row of symbols at once. All arithmetic is of integers, so the
same bytes mean the same symbols everywhere.
"""

from __future__ import annotations

import numpy as np

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


def probability_codes(counts: np.ndarray) -> np.ndarray:
    """Return the logarithms of ``counts`` ``(contexts, symbols)`` relative to the largest of a context, as bytes."""
    largest = np.maximum(counts.max(axis=1, keepdims=True), 1)
    codes = 255 + np.rint(OCTAVE * np.log2(np.maximum(counts, 1) / largest)).astype(int)
    return np.where(counts > 0, np.maximum(codes, 1), 0).astype(np.uint8)


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

    def code(self, group: str, contexts: int, symbols: int, context: np.ndarray, symbol: np.ndarray) -> np.ndarray:
        """Add each ``symbol`` (below ``symbols``) in its ``context`` (below ``contexts``); return the symbols."""
        self.alphabets[group] = (contexts, symbols)
        self.calls.append((group, np.asarray(context, np.int64), np.asarray(symbol, np.int64)))
        return symbol

    def finish(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bytes of all probabilities, and those of the symbols."""
        tables, parts = {}, []
        for name, (contexts, symbols) in self.alphabets.items():
            joined = [c * symbols + s for group, c, s in self.calls if group == name]
            counts = np.bincount(np.concatenate(joined), minlength=contexts * symbols).reshape(contexts, symbols)
            codes = probability_codes(counts)
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
        """Return the symbol in each ``context``, for the same arguments as :meth:`SymbolEncoder.code`."""
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
