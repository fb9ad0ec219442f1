"""Coded nodes of radiance fields: symbols, their bytes against the entropy, and the choice by rate and distortion."""

import numpy as np
import pytest

from mi_diffind.arrays.sparse_grid import cell_corners, complete_cells
from mi_diffind.tasks.radiance import coding, compression


@pytest.fixture
def shell():
    """Nodes of a shell, smooth levels below 16, and the index of a palette of 300 colours that varies slowly."""
    x, y, z = np.ogrid[:33, :30, :37]
    distance = np.sqrt((x - 16) ** 2 + (y - 15) ** 2 + (z - 18) ** 2)
    stored = cell_corners(np.abs(distance[:-1, :-1, :-1] - 12) < 2)
    place = np.argwhere(stored)
    levels = np.clip(np.rint(8 + 2 * (12 - distance[stored])), 0, 15).astype(int)
    index = (place[:, 0] // 4 * 37 + place[:, 1] // 5 * 11) % 300
    return stored, levels, index


def entropy(symbols, contexts) -> float:
    """Bits of symbols by their frequencies in each context."""
    _, joint = np.unique(symbols * 10_000 + contexts, return_counts=True)
    _, alone = np.unique(contexts, return_counts=True)
    return float(np.sum(alone * np.log2(alone)) - np.sum(joint * np.log2(joint)))


def test_symbols_take_the_bytes_of_their_entropy(rng):
    contexts = rng.integers(0, 3, 60_000)
    symbols = np.minimum(rng.geometric(np.array([0.9, 0.4, 0.05])[contexts]) - 1, 99)
    coder = coding.SymbolEncoder()
    for part in (slice(0, 7), slice(7, 60_000)):
        coder.code("x", 3, 100, contexts[part], symbols[part])
    coder.code("flags", 1, 2, np.zeros(3, int), [1, 0, 1])
    probabilities, data = coder.finish()
    assert 8 * len(data) < 1.02 * entropy(symbols, contexts) + 32 * 17
    decoder = coding.SymbolDecoder(probabilities, data)
    read = [decoder.code("x", 3, 100, contexts[part]) for part in (slice(0, 7), slice(7, 60_000))]
    np.testing.assert_array_equal(np.concatenate(read), symbols)
    np.testing.assert_array_equal(decoder.code("flags", 1, 2, np.zeros(3, int)), [1, 0, 1])


def test_passes(shell):
    """Each node is in one pass, and its context has been coded before; ``test_limits.py`` decodes them."""
    stored, *_ = shell
    passes = coding.passes_of(stored)
    order = np.empty(stored.sum(), int)
    for number, part in enumerate(passes):
        order[part.rows] = number
    assert sorted(np.concatenate([p.rows for p in passes])) == list(range(stored.sum()))
    assert all((order[p.near[p.near >= 0]] < number).all() for number, p in enumerate(passes))
    assert np.mean(np.concatenate([(p.near >= 0).any(axis=1) for p in passes])) > 0.85


def test_smooth_nodes_take_few_bytes(shell):
    stored, levels, index = shell
    plain = (entropy(levels, 0 * levels) + entropy(index, 0 * index)) / 8
    assert len(coding.encode(stored, levels, index, 16, 300)[1]) < 0.4 * plain
    mask = coding.SymbolEncoder()
    coding._cells(mask, tuple(n - 1 for n in stored.shape), complete_cells(stored))
    assert len(mask.finish()[1]) < 0.2 * stored.size / 8


def test_damaged_nodes_are_refused(shell):
    stored, levels, index = shell
    probabilities, data = coding.encode(stored, levels, index, 16, 300)
    cases = (
        (probabilities, data[:-100]), (probabilities, data[:3]), (probabilities[:40], data),
        (np.full_like(probabilities, 255), data), (probabilities, np.full_like(data, 255)),
    )  # fmt: skip
    for case in cases:
        with pytest.raises(ValueError, match="found"):
            coding.decode(*case, stored.shape, 16, 300)


def test_rate_and_distortion(shell, rng):
    """A higher rate takes fewer bytes and a larger error; nodes that matter keep theirs."""
    stored, levels, index = shell
    passes = coding.passes_of(stored)
    exact = np.clip(levels + rng.normal(0, 1, len(levels)), 0, 15)
    weight = np.where(rng.random(len(levels)) < 0.3, 1.0, 1e-3)
    colours = rng.normal(size=(300, 3))
    points = colours[index] + rng.normal(0, 0.3, (len(index), 3))
    sizes, errors = [], []
    for rate in (1e-5, 0.02):
        chosen = compression.choose_levels(passes, exact, weight, rate, 16)
        centres, named = compression.choose_index(passes, points, weight, colours, rate)
        sizes.append([len(coding.encode(stored, *pair, 16, 300)[1]) for pair in ((chosen, index), (levels, named))])
        errors.append([np.square(chosen - exact), np.square(points - centres[named]).sum(axis=1)])
    sizes = np.array(sizes)
    assert (sizes[1] < 0.85 * sizes[0]).all()
    for few, many in zip(*errors, strict=True):
        matters = weight == 1
        assert few[matters].mean() < many[matters].mean() < 0.5 * many[~matters].mean()
