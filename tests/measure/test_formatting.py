"""Numbers as text: times and ratios, tables."""

import math

from mi_diffind.measure.report import grid, time_cell
from mi_diffind.measure.statistics import ratio, timing


def test_grid():
    assert grid([["", "a", "bbb"], ["name", "1.5", ""], ["x", "20", "3"]]) == [
        "          a  bbb",
        "  name  1.5",
        "  x      20    3",
    ]


def test_times_below_the_floor_are_bounds():
    """Times and ratios are never negative: what takes less than the floor can tell is below a bound."""
    assert time_cell(timing([3.0, 3.0, 5.0], 1.0)) == "2.00 ±0.50" and time_cell(None) == ""
    hidden = timing([0.55, 0.6, 0.65], 1.0)
    assert hidden["hidden"] and hidden["time"] == hidden["q1"] == hidden["q3"] == 0.2 and hidden["with_floor"] == 0.6
    assert time_cell(hidden) == "below 0.20"
    assert not timing([0.0], 0.0)["hidden"]  # without a floor nothing is hidden
    assert ratio([3.0], [2.0], 1.0)["median"] == 2 and ratio([3.0], [2.0])["median"] == 1.5
    assert ratio([0.6], [2.0], 1.0) == {"median": 0.2, "q1": 0.2, "q3": 0.2}
    assert math.isnan(ratio([3.0], [1.1], 1.0)["median"])
