"""Search for the smallest file of a quality: trainings are pretended."""

import math
from dataclasses import dataclass
from types import SimpleNamespace

import pytest

from mi_diffind.fitting.loop import FitResult
from mi_diffind.fitting.task import FitRequest, FitSettings, FittingError
from mi_diffind.maps.search import EXCESS_DB, NEAR, search_by_psnr, search_lines

SOURCE = SimpleNamespace(nbytes=2**20)
SETTINGS = FitSettings(steps=800)
REQUEST = FitRequest("ours", SETTINGS, None, options={"source": "x.png", "psnr": 40})

#: Loss of a short training, in dB.
SHORT_DB = 1.3


@dataclass
class Size:
    nbytes: int
    full: bool = False


def search(quality, goal, interrupt=None, size_of=lambda n: Size(round(n))):
    """Return the search by trainings of ``quality(octaves)`` dB, and their (bytes, steps); Ctrl-C comes in one."""
    calls = []

    def train(size, steps, request, title):
        calls.append((size.nbytes, steps))
        psnr = quality(math.log2(size.nbytes / 1000)) - (SHORT_DB if steps < SETTINGS.steps else 0)
        result = FitResult({}, 1, 1, 0.0, len(calls) == interrupt, 0)
        return SimpleNamespace(nbytes=size.nbytes, measured={"psnr_db": psnr}), result

    return search_by_psnr(SOURCE, goal, REQUEST, SETTINGS, size_of, train), calls


@pytest.mark.parametrize("slope, bend", [(2.5, 0), (0.9, 0), (6, 0), (3, 0.15)])
@pytest.mark.parametrize("goal", [20, 25.001, 31.5, 40])
def test_the_quality_is_met(slope, bend, goal):
    """Within 0.3 dB and by at most four trainings of full length, whatever an octave of bytes gains."""

    def quality(octaves):
        return 25 + slope * octaves - bend * octaves**2

    most = quality(math.log2(SOURCE.nbytes / 1000))
    if most < goal:
        with pytest.raises(FittingError, match=r"x\.png: .* dB were not reached; the best of . trainings had"):
            search(quality, goal)
        return
    (table, result, tried), calls = search(quality, goal)
    psnr = table.measured["psnr_db"]
    assert goal <= psnr <= goal + EXCESS_DB and psnr == quality(math.log2(table.nbytes / 1000))
    assert [(t["bytes"], t["steps"]) for t in tried] == calls and not result.interrupted
    assert sum(steps == 800 for _, steps in calls) <= 4 and {steps for _, steps in calls} == {100, 800}
    assert all(nbytes <= SOURCE.nbytes for nbytes, _ in calls)
    assert search_lines(tried)[-1] == f"tried {table.nbytes:,} bytes in 800 steps: {psnr:.2f} dB"


@pytest.mark.parametrize("goal", [24, 29.3, 33])
def test_a_quality_that_jumps(goal):
    """Steps of 1 dB between structures: the smallest sufficient size that was tried, near an insufficient one."""
    (table, _, tried), _ = search(lambda octaves: math.floor(25 + 2.5 * octaves), goal)
    full = [t for t in tried if t["steps"] == 800]
    reached, missed = (sorted(t["bytes"] for t in full if (t["psnr_db"] >= goal) == way) for way in (True, False))
    assert table.measured["psnr_db"] >= goal and table.nbytes == reached[0]
    assert table.measured["psnr_db"] <= goal + EXCESS_DB or reached[0] <= NEAR * missed[-1] or len(full) == 5


def test_the_search_ends():
    """At the largest and the smallest arrays, and after :data:`TRAININGS` trainings of full length."""
    with pytest.raises(FittingError, match=r"100 dB were not reached; the best of . trainings had .* give more"):
        search(lambda octaves: 25 + octaves, 100)
    _, calls = search(lambda octaves: 25 + octaves, 1, size_of=lambda n: Size(max(round(n), 5000)))
    assert calls[-1][0] == 5000 and len(calls) <= 5
    with pytest.raises(FittingError, match="in 7,000 bytes"):
        search(lambda octaves: 25 + octaves, 50, size_of=lambda n: Size(min(round(n), 7000), n >= 7000))
    with pytest.raises(FittingError, match="not reached"):
        search(lambda octaves: 20 + octaves % 1, 30)


def test_the_search_is_interrupted():
    """A file that reached the goal before is kept."""
    (table, result, tried), calls = search(lambda octaves: 50 + octaves, 40, interrupt=2)
    assert len(calls) == 2 and result.interrupted and table.nbytes == min(t["bytes"] for t in tried)
    with pytest.raises(KeyboardInterrupt):
        search(lambda octaves: 20 + octaves, 40, interrupt=1)
