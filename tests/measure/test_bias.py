"""Noise against bias: the estimators, times between and beyond those that were measured."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from mi_diffind.measure import bias as measure
from mi_diffind.measure.bias import estimate, seconds_at


def noisy(rng, mean, sigma, number, heavy=False):
    """Independent images with a mean and a standard deviation; ``heavy``: rare bright pixels."""
    for _ in range(number):
        noise = rng.standard_normal(mean.shape)
        if heavy:  # variance 1, kurtosis in the hundreds
            noise = np.where(rng.random(mean.shape) < 0.005, 1, 0) / math.sqrt(0.005 * 0.995) - math.sqrt(0.005 / 0.995)
        yield mean + sigma * noise


@pytest.mark.parametrize("heavy", [False, True])
@pytest.mark.parametrize("size", [0.02, 0.2])
def test_known_bias_is_recovered(rng, size, heavy):
    bias = size * rng.standard_normal((48, 48, 3))
    weights = rng.uniform(0.5, 2, bias.shape)
    truth = np.mean(weights * bias**2)
    found = [estimate(list(noisy(rng, bias, 0.1, 8, heavy)), weights) for _ in range(40)]
    deviations = np.array([(e.square - truth) / e.standard_error for e in found])
    assert np.abs(deviations).max() < 5 and (np.abs(deviations) < 2).mean() > 0.85
    assert abs(deviations.mean()) < 3 / math.sqrt(40)  # unbiased
    assert all(e.measured for e in found) and all(e.square < e.bound for e in found)
    noise = np.mean([e.noise for e in found])
    assert noise == pytest.approx(0.01 * weights.mean(), rel=0.02)


@pytest.mark.parametrize("heavy", [False, True])
def test_no_bias_is_below_what_was_measured(rng, heavy):
    found = [estimate(list(noisy(rng, np.zeros((24, 24, 3)), 0.1, 8, heavy))) for _ in range(60)]
    squares = [e.square for e in found]
    assert min(squares) < 0 < max(squares)
    assert np.mean([e.measured for e in found]) < 0.05
    assert all(0 < e.bound < 0.01 / 8 for e in found)  # well below the noise of the mean image
    relative = measure.describe(replace(found[0], square=-1e-5, standard_error=1e-5), found[0])
    assert not relative["measured"] and relative["rmse_below"] == pytest.approx(math.sqrt(2e-5))
    assert "rmse" not in relative and relative["mse"] == -1e-5


def test_estimates_of_given_images(rng):
    """Against sums over all pairs, and by leaving out one image after the other."""
    images = rng.standard_normal((5, 4, 3, 2)) + 0.5

    def pairs(found):
        return np.mean([np.mean(a * b) for a, b in itertools.permutations(found, 2)])

    e = estimate(list(images))
    left_out = [pairs(np.delete(images, k, axis=0)) for k in range(5)]
    assert e.square == pytest.approx(pairs(images))
    assert e.standard_error == pytest.approx(math.sqrt(4 / 5 * np.sum((left_out - np.mean(left_out)) ** 2)))
    assert e.noise == pytest.approx(images.var(axis=0, ddof=1).mean())
    same = estimate([images[0]] * 3)
    assert same.square == pytest.approx(np.mean(images[0] ** 2)) and same.standard_error == pytest.approx(0, abs=1e-12)
    with pytest.raises(ValueError, match="found 2, at least 3"):
        estimate(list(images[:2]))


def test_noise_of_the_truth_is_subtracted(rng):
    truth = rng.uniform(0, 1, (64, 64, 3))
    weights = measure.relative_weights(truth)
    passes = list(noisy(rng, truth, 0.2, 8))
    noise = estimate(passes, weights).noise / 8
    images = noisy(rng, truth + 0.03, 0.1, 10)
    errors = [measure.error(image, np.mean(passes, axis=0), weights, noise) for image in images]
    assert np.mean(errors) == pytest.approx(np.mean(weights) * (0.03**2 + 0.1**2), rel=0.02)
    assert noise > 0.3 * np.mean(errors)  # it matters


def test_weights(rng):
    image = rng.uniform(0, 2, (7, 4, 3)).astype(np.float32)
    weights = measure.relative_weights(image)
    brightness = [
        image[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3].astype(np.float64).mean(axis=(0, 1))
        for y in range(7)
        for x in range(4)
    ]
    assert weights == pytest.approx(1 / (np.reshape(brightness, image.shape) ** 2 + 0.01))
    assert measure.relative_weights(np.zeros((1, 2, 1))) == pytest.approx(100)


def test_times_between_and_beyond():
    assert seconds_at(10, {1: 1.0, 4: 2.5, 16: 8.5}) == pytest.approx(5.5)
    assert seconds_at(32, {1: 1.0, 4: 2.5, 16: 8.5}) == pytest.approx(16.5)
    assert seconds_at(8, {4: 2.0}) == pytest.approx(4.0)
    assert seconds_at(8, {2: 3.0, 4: 2.0}) == pytest.approx(4.0)  # disturbed: more samples cannot take less time
    assert seconds_at(0.5, {1: 1.0}) is None and seconds_at(1, {}) is None
