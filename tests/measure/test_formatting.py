"""Numbers as text: shares, counts, durations, times, ratios, enumerations."""

import math

from mi_diffind.measure.report import duration, enumeration, grid, percent, ratio_cell, rounded, time_cell
from mi_diffind.measure.statistics import ratio, timing


def test_numbers():
    assert [percent(v) for v in (0, 0.5, 0.012345, 3e-6, 2.7e-8)] == ["0%", "50%", "1.23%", "0.0003%", "2.7e-06%"]
    numbers = (0, 1.26, 12.4, 126, 999_999, 1.26e7, 3.4e9, 2e13, 2.1e15)
    shown = ["0", "1.3", "12", "130", "1 million", "13 million", "3.4 billion", "20 trillion", "2.1e+15"]
    assert [rounded(v) for v in numbers] == shown
    times = (0.012, 0.35, 1.3, 80, 100, 4000, 8000, 1e5, 1e8)
    shown = ["12 ms", "0.35 s", "1.3 s", "80 s", "1.7 min", "67 min", "2.2 h", "1.2 days", "3.2 years"]
    assert [duration(v) for v in times] == shown
    assert [enumeration(v) for v in ([1], [1, 4], [1, 4, 16])] == ["1", "1 and 4", "1, 4 and 16"]


def test_grid():
    assert grid([["", "a", "bbb"], ["name", "1.5", ""], ["x", "20", "3"]]) == [
        "          a  bbb",
        "  name  1.5",
        "  x      20    3",
    ]


def test_what_the_floor_hides_is_said_in_words():
    """Times and ratios are never negative: what takes less than the floor can tell is below a bound."""
    assert time_cell(timing([3.0, 3.0, 5.0], 1.0)) == "2.00 ±0.50" and time_cell(None) == ""
    hidden = timing([0.55, 0.6, 0.65], 1.0)
    assert hidden["hidden"] and hidden["time"] == hidden["q1"] == hidden["q3"] == 0.2 and hidden["with_floor"] == 0.6
    assert time_cell(hidden) == "below 0.20"
    assert not timing([0.0], 0.0)["hidden"]  # without a floor nothing is hidden
    assert ratio_cell(ratio([3.0], [2.0], 1.0)) == "2.00 [1.50]" and ratio_cell(ratio([3.0], [2.0]), False) == "1.50"
    assert ratio_cell(ratio([0.6], [2.0], 1.0)) == "below 0.20 [0.30]"
    nothing = ratio([3.0], [1.1], 1.0)
    assert math.isnan(nothing["median"]) and ratio_cell(nothing) == "- [2.73]" and ratio_cell(None) == ""
