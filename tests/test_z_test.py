"""The z-test of a render against a noisy reference: p-values, thresholds, and changes that it catches."""

import numpy as np
import pytest

from mi_diffind.z_test import z_test


def noise(rng, variance, spp):
    """What ``spp`` samples of zero mean average to, if they are normally distributed."""
    return rng.standard_normal(variance.shape) * np.sqrt(variance / spp)


def test_p_values_are_those_of_scipy(rng):
    from scipy.stats import norm

    reference, variance = rng.random((9, 7, 3)), 10 ** rng.uniform(-6, 0, (9, 7, 3))
    deviation = np.sqrt(np.maximum(variance, 1e-4) * (1 / 40 + 1 / 160))
    image = reference + deviation * rng.normal(0, 2, reference.shape)
    test = z_test(image, reference, variance, 40, 160)
    expected = 2 * norm.sf(np.abs(image - reference) / deviation)
    assert np.allclose(test.p_values, expected, rtol=1e-5, atol=0)
    assert test.alpha == pytest.approx(1 - 0.99 ** (1 / 63), rel=1e-9)
    failing = (expected <= test.alpha).any(axis=-1)
    assert 0 < failing.sum() < 63 and np.array_equal(test.failing, failing)
    assert test.fraction == pytest.approx(1 - failing.mean())
    exact = z_test(image, reference, variance, 40)  # a reference free of noise
    deviation = np.sqrt(np.maximum(variance, 1e-4) / 40)
    assert np.allclose(exact.p_values, 2 * norm.sf(np.abs(image - reference) / deviation), rtol=1e-5)


def test_p_values_are_uniform_if_nothing_changed(rng):
    """Both the image and the reference are noisy, the reference as much as the image."""
    from scipy.stats import kstest

    variance = 10 ** rng.uniform(-3, 1, (60, 80, 3))
    truth = rng.random(variance.shape)
    image, reference = truth + noise(rng, variance, 16), truth + noise(rng, variance, 16)
    assert kstest(z_test(image, reference, variance, 16, 16).p_values.ravel(), "uniform").pvalue > 0.01
    assert kstest(z_test(image, reference, variance, 16).p_values.ravel(), "uniform").pvalue < 1e-9


def test_one_image_in_a_hundred_has_a_failing_pixel(rng):
    """What Šidák's correction promises, for one channel."""
    variance = np.ones((10, 12, 1))
    failing = [z_test(noise(rng, variance, 4), 0 * variance, variance, 4).failing.any() for _ in range(3000)]
    assert 15 <= sum(failing) <= 48  # 30 expected, three standard deviations


def test_a_quarter_of_a_percent_may_fail():
    """Two pixels of 800 may, three may not; a pixel fails with any of its channels, and if one is not finite."""
    reference, variance = np.full((20, 40, 3), 0.5), np.full((20, 40, 3), 0.04)
    for wrong in (1.0, np.nan, np.inf, -np.inf):
        image = reference.copy()
        image[3, 4:6, 1] = wrong
        test = z_test(image, reference, variance, 64, 1024)
        assert test.passed and test.failing.sum() == 2 and test.failing[3, 4]
        image[19, 39, 2] = wrong
        test = z_test(image, reference, variance, 64, 1024)
        assert not test.passed and test.failing.sum() == 3
    with pytest.raises(ValueError, match="shapes differ"):
        z_test(reference, reference[:1], variance, 64)


def test_changes_above_the_noise_are_caught(rng):
    """A hundredth of the pixels, changed by eight standard deviations of the mean; not if changed by one."""
    variance = np.full((60, 80, 3), 0.25)
    for deviations, passes in ((1, True), (8, False)):
        image = noise(rng, variance, 100)
        image[:6, :8] += deviations * 0.5 / 10
        assert z_test(image, 0 * variance, variance, 100, 1600).passed == passes


def test_small_variances_are_raised_to_the_floor():
    """Without noise, differences of 0.01 / sqrt(spp) times the quantile (here 4.4) pass."""
    zero = np.zeros((30, 40, 3))
    assert z_test(zero + 4.2 * 0.01 / 10, zero, zero, 100).passed
    assert not z_test(zero + 4.6 * 0.01 / 10, zero, zero, 100).passed
