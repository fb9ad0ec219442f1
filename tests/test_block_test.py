"""The test of blocks and stops: windows, t-tests against SciPy's, alarms of nothing, and the power it promises."""

import numpy as np
import pytest
from scipy import stats

from mi_diffind.scenes import block_test
from mi_diffind.scenes.block_test import BlockReference, block_means

HEIGHT, WIDTH = 46, 70  # no multiples of 4


def passes(rng, count, truth, noise):
    """Block means of passes whose pixels have independent normal noise."""
    pixels = block_means(truth)
    return pixels + noise / 4 * rng.standard_normal((count, *pixels.shape))


def reference(rng, truth, noise):
    """A reference, and the change that it promises to see."""
    blocks = passes(rng, 128, truth, noise)
    groups = blocks.reshape(16, 8, *blocks.shape[1:])
    known = BlockReference.from_groups(blocks[:16], groups.mean(axis=1), *truth.shape[:2])
    return known, known.visible_change(groups[2:])


@pytest.fixture
def truth():
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    return (0.6 + 0.3 * np.sin(rows / 9) * np.cos(columns / 13))[..., None] * [1, 0.8, 0.5]


@pytest.mark.parametrize("size", [(1, 1), (3, 3), (1, 100), (5, 4), (9, 9), (46, 70)])
def test_windows_are_means_of_the_picture(rng, size):
    """Each value of t is that of SciPy's test of the means of the pixels in its window; the largest is everything."""
    before, after = rng.random((16, *size, 3)), rng.random((8, *size, 3))
    blocks = [np.stack([block_means(image) for image in side]) for side in (before, after)]
    test = BlockReference(blocks[0], blocks[0].mean(axis=0), np.linspace(0, 9, 16), *size).test(blocks[1])
    for level in test.levels:
        shape = np.array(level.t.shape[:2])
        assert ((shape - 1) * level.stride + level.side >= size).all()  # nothing is left out
        for row, column in np.ndindex(*shape):
            y, x = row * level.stride, column * level.stride
            window = np.s_[:, y : y + level.side, x : x + level.side]
            expected = stats.ttest_ind(after[window].mean(axis=(1, 2)), before[window].mean(axis=(1, 2))).statistic
            assert np.allclose(level.t[row, column], expected, rtol=1e-6)
    assert (
        test.levels[-1].t.shape == (1, 1, 3) and [level.side for level in test.levels][:2] == [4, 8][: len(test.levels)]
    )
    chances = [level.t.size * 2 * stats.t.sf(level.threshold, 22) for level in test.levels]
    assert np.allclose(chances, 0.008 / len(test.levels), rtol=0.005)


def test_alarms_of_nothing(rng, truth):
    """One check in a hundred, if no more than the noise differs; 8.6 expected of 860, two of them by stops."""
    alarms, by_stops = 0, 0
    for _ in range(4):
        known, _ = reference(rng, truth, 0.3)
        for _ in range(215):
            test = known.test(passes(rng, 8, truth, 0.3))
            alarms, by_stops = alarms + (not test.passed), by_stops + (test.stops > test.stops_threshold)
    assert alarms <= 17 and by_stops <= 6


def test_rare_bright_samples_make_no_alarm(rng, truth):
    """A pixel in a thousand is a hundred times too bright, in the check as in the reference."""
    alarms = 0
    for _ in range(3):
        rendered = [np.where(rng.random(truth.shape[:2]) < 1e-3, 100, 1)[..., None] * truth for _ in range(128 + 320)]
        blocks = np.stack([block_means(image) for image in rendered])
        groups = blocks[:128].reshape(16, 8, *blocks.shape[1:]).mean(axis=1)
        known = BlockReference.from_groups(blocks[:16], groups, HEIGHT, WIDTH)
        alarms += sum(not known.test(blocks[i : i + 8]).passed for i in range(128, 448, 8))
    assert alarms <= 5


def test_the_power_is_as_promised(rng, truth):
    """Tiles at random places, brighter by the change that is found nine times of ten; half of the change is not."""
    found = {1.0: 0, 0.5: 0}
    for _ in range(4):
        known, change = reference(rng, truth, 0.3)
        for factor in found:
            for _ in range(75):
                y, x = rng.integers(HEIGHT - 15), rng.integers(WIDTH - 15)
                changed = truth.copy()
                changed[y : y + 16, x : x + 16] *= 1 + factor * change
                found[factor] += not known.test(passes(rng, 8, changed, 0.3)).passed
    assert 0.86 <= found[1.0] / 300 <= 0.94 and found[0.5] / 300 < 0.5


def test_the_worst_block_is_named(rng, truth):
    known, _ = reference(rng, truth, 0.1)
    changed = truth.copy()
    changed[16:32, 24:40, 1] *= 0.9
    worst = known.test(passes(rng, 8, changed, 0.1)).worst
    assert (worst.x, worst.y, worst.width, worst.height, worst.side) == (24, 16, 16, 16, 16)
    assert worst.channel == "green" and worst.change == pytest.approx(-0.1, abs=0.02) and worst.t < -worst.threshold
    changed = truth[..., :1].copy()
    changed[40:, 64:] *= 1.5  # windows that the edges crop: 6 × 6 pixels
    worst = reference(rng, truth[..., :1], 0.1)[0].test(passes(rng, 8, changed, 0.1)).worst
    assert (worst.x + worst.width, worst.y + worst.height) == (WIDTH, HEIGHT) and worst.width < worst.side
    assert worst.channel == "brightness" and worst.t > worst.threshold


def test_changes_that_cancel_out_are_seen_in_stops(rng, truth):
    """More and less light in turn, pixel block by pixel block: no block of its own, the picture as a whole."""
    known, _ = reference(rng, truth, 0.3)
    pattern = np.where(np.add.outer(np.arange(HEIGHT) // 4, np.arange(WIDTH) // 4) % 2, 1.1, 0.9)[..., None]
    tests = [known.test(passes(rng, 8, truth * pattern, 0.3)) for _ in range(20)]
    assert all(test.stops > test.stops_threshold for test in tests)
    assert sum(test.failing_blocks > 0 for test in tests) < 15


def test_pictures_without_noise(truth):
    """Rounding passes, a change of a thousandth does not; black is compared with black only."""
    rows, columns = block_means(truth).shape[:2]
    known, change = reference(np.random.default_rng(0), truth, 0)
    assert known.test(np.stack([block_means(truth * (1 + 5e-5))] * 8)).passed
    assert not known.test(np.stack([block_means(truth * 1.001)] * 8)).passed
    assert 1e-4 < change < 1e-3
    black = BlockReference(np.zeros((16, rows, columns, 3)), np.zeros((rows, columns, 3)), np.zeros(16), HEIGHT, WIDTH)
    check = np.zeros((8, rows, columns, 3))
    assert black.test(check).passed and black.visible_change(check[None]) == np.inf
    check[:, 3, 2] = 1e-3
    test = black.test(check)
    assert not test.passed and test.worst.change is None


def test_values_that_are_not_finite_fail_alone(rng, truth):
    """They are counted, and spoil no other window; negative values, as Mitchell's filter has, are values."""
    known, _ = reference(rng, truth, 0.3)
    check = passes(rng, 8, truth, 0.3)
    check[2, 5, 6, 0] = np.nan
    test = known.test(check, not_finite=1)
    assert not test.passed and test.failing_blocks == 0 and np.isfinite(test.stops) and np.isfinite(test.worst.t)
    check[:, 8, 9] = 50
    assert known.test(check, not_finite=1).failing_blocks > 0
    assert block_test.mean_stops(np.array([-1.0, 1.0]), np.array([0.0, 3.0]), 1.0) == pytest.approx(0.5)
