"""Memory budgets: searches against trying every size, and against closed forms."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from mi_diffind.arrays.budget import Budget, BudgetError, array_bytes, proportional_shape


def arrays(side):
    """Return two arrays of a family, as pairs of shape and bits."""
    return [((side, 2 * side, 3), 5), ((side // 8 + 1,) * 2 + (4,), 8)]


def nbytes(side):
    return math.ceil(side * 2 * side * 3 * 5 / 8) + (side // 8 + 1) ** 2 * 4


def test_bytes_of_arrays():
    assert array_bytes([((3, 5, 2), 8)]) == 30
    assert array_bytes([((3,), 1), ((9,), 1), ((np.int64(2), 3), 16)]) == 1 + 2 + 12
    assert [array_bytes(arrays(n)) for n in range(40)] == [nbytes(n) for n in range(40)]


@pytest.mark.parametrize("budget", [1, 7.5, 60, 61, 1000, 54321, 10**7])
def test_largest_fits_and_the_next_does_not(budget):
    sizes = range(1, 500)
    fitting = [n for n in sizes if nbytes(n) <= budget]
    for family in (arrays, nbytes, lambda n: SimpleNamespace(nbytes=nbytes(n))):
        if fitting:
            assert Budget(budget).largest(family, sizes) == fitting[-1]
        else:
            with pytest.raises(BudgetError, match=f"the smallest arrays need {nbytes(1)}"):
                Budget(budget).largest(family, sizes)
        assert Budget(budget).largest(family, sizes, strict=False) == max(fitting, default=1)


def test_largest_tries_few_sizes():
    tried = []
    assert Budget(10**12).largest(lambda n: tried.append(n) or n * n, range(2**40)) == 10**6
    assert len(tried) <= 41


@pytest.mark.parametrize("budget", [30, 444, 12345, 10**9])
def test_nearest_is_that_of_all(budget):
    sizes, source = range(1, 300), 10**6
    expected = min(sizes, key=lambda n: abs(source / budget - source / nbytes(n)))
    assert Budget(budget).nearest(arrays, sizes, source) == expected


def test_tolerance():
    budget = Budget(1000)
    assert budget.is_met(951) and budget.is_met(1049) and not budget.is_met(949) and not budget.is_met(1051)
    assert Budget(1000, 0.01).is_met(995) and not Budget(1000, 0.01).is_met(985)


def test_approach_follows_bytes():
    """A grid whose bytes grow with a power that the search does not know."""
    made = []

    def make(spacing):
        made.append(spacing)
        return SimpleNamespace(nbytes=int(7 * spacing**-2.3))

    def following(spacing, grid):
        return spacing * (grid.nbytes / 0.97e6) ** 0.5

    result = Budget(10**6).approach(make, 0.5, following)
    assert 0.95e6 <= result.nbytes <= 1e6 and len(made) <= 8
    assert Budget(10**6).approach(make, 0.5, lambda spacing, grid: spacing).nbytes == make(0.5).nbytes  # comes again
    with pytest.raises(BudgetError, match="the smallest of 1 tried needs"):
        Budget(3).approach(make, 0.5, lambda spacing, grid: spacing)


@pytest.mark.parametrize("extent", [(1, 1, 1), (3, 2, 1), (0.1, 5, 2.5)])
def test_shape_in_proportion(extent):
    shape = proportional_shape(40, extent)
    assert max(shape) == 40 and min(shape) >= 2
    assert np.allclose(shape, np.maximum(2, 40 * np.array(extent) / max(extent)), atol=0.5)
