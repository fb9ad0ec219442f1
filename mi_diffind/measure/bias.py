"""Noise and bias of renders with learned tables, and the sample count at which the two are equal.

Noise is that of the samples, which more time reduces; bias is that of the approximation, which no time reduces.

*The error* of an image ``a`` against the truth ``r`` is the relative mean squared error, over pixels and channels,

    mse = mean((a − r)² / (m² + 0.01)),        shown as its root, the relative RMS error,

where ``m`` is the brightness around the pixel, a mean over 5 × 5 pixels of an exact pass that is used for nothing
else. The denominator depends on none of the compared images, and nothing is clipped, so squares add up exactly:
E[mse] = bias² + noise², and for independent samples noise² = σ² / spp. A PSNR clips to [0, 1]; a clipped noisy image
has another mean, so it does not add up.

*The truth* is the mean of all exact passes at the highest sample count. Their scatter gives the noise of the truth,
which is subtracted. Each of these passes is measured against the mean of the others.

*The bias* is measured with common random numbers: each exact pass has a learned twin with the same seed, and most of
the noise is not in their difference ``d``. Of K independent differences, the mean of the scalar products ⟨dᵢ, dⱼ⟩ of
all pairs i ≠ j is an unbiased estimate of bias², which may be negative. Its standard error is the jackknife's (Efron
and Stein 1981: on average not smaller than the true one). A bias counts as measured from two standard errors on.

*The crossover* is the sample count at which the noise of the learned render, σ² / spp, equals bias². Beyond the counts
that were rendered, it is extrapolated, as is its time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

#: Added to the square of the brightness in the denominator of the error: linear values, 1 is white.
EPSILON = 0.01

#: Pixels along a side of the square that the brightness is a mean of.
SIDE = 5

#: Standard errors above zero from which a bias counts as measured; otherwise they bound it.
CONFIDENCE = 2.0

#: Fewest images that have a standard error.
LEAST = 3


@dataclass(frozen=True)
class Estimate:
    """Result of :func:`estimate`.

    ``square``: mean square of the mean image, unbiased, so it may be negative; its ``standard_error``; ``noise``: mean
    square of the noise of one image.
    """

    square: float
    standard_error: float
    noise: float

    @property
    def measured(self) -> bool:
        """Whether the mean image differs from zero."""
        return self.square > CONFIDENCE * self.standard_error

    @property
    def bound(self) -> float:
        """Upper bound of ``square``."""
        return max(self.square, 0.0) + CONFIDENCE * self.standard_error


def estimate(images: Sequence[np.ndarray], weights: np.ndarray | float = 1.0) -> Estimate:
    """Return estimates of mean(weights · E[image]²) and mean(weights · Var[image]).

    ``images`` are K ≥ 3 independent ones of the same distribution and shape. With
    Gᵢⱼ = mean(weights · imageᵢ · imageⱼ), the estimates are the mean of Gᵢⱼ over all i ≠ j, and the mean of Gᵢᵢ minus
    that; both are unbiased for any distribution of the noise. The standard error is the jackknife's, leaving out one
    image. Raises ``ValueError`` for fewer than three images.
    """
    k = len(images)
    if k < LEAST:
        raise ValueError(f"images: found {k}, at least {LEAST} are needed")
    gram = np.empty((k, k))
    for i in range(k):
        weighted = weights * images[i].astype(np.float64)
        for j in range(i + 1):
            gram[i, j] = gram[j, i] = np.mean(weighted * images[j])
    with_others = gram.sum(axis=1) - gram.diagonal()
    pairs = with_others.sum()
    square = pairs / (k * (k - 1))
    left_out = (pairs - 2 * with_others) / ((k - 1) * (k - 2))
    error = math.sqrt((k - 1) / k * np.sum((left_out - left_out.mean()) ** 2))
    return Estimate(float(square), error, float(gram.diagonal().mean() - square))


def relative_weights(image: np.ndarray) -> np.ndarray:
    """Return the weights of the relative error, 1 / (m² + 0.01), of a linear ``image`` ``(height, width, channels)``.

    m is the mean of the image over 5 × 5 pixels, at its edges over those that exist.
    """
    sums, number = (
        uniform_filter(v, (SIDE, SIDE, 0), mode="constant") for v in (image.astype(np.float64), np.ones(image.shape))
    )
    return 1 / ((sums / number) ** 2 + EPSILON)


def error(image: np.ndarray, truth: np.ndarray, weights: np.ndarray, truth_noise: float) -> float:
    """Return the relative MSE of an image against a noisy truth, mean(weights · (image − truth)²) − ``truth_noise``.

    ``truth_noise`` is the weighted mean square of the noise of ``truth``, which has the shape of ``image``.
    """
    return float(np.mean(weights * (image.astype(np.float64) - truth) ** 2)) - truth_noise


def describe(relative: Estimate, displayed: Estimate) -> dict:
    """Return the bias as numbers, from estimates with relative weights and with those of displayed values.

    ``measured`` (whether it differs from zero), ``mse`` (may be negative); ``rmse`` and ``rmse_standard_error``, or the
    bound ``rmse_below``; ``psnr_db``, or the bound ``psnr_db_above``.
    """
    bias = {"measured": relative.measured, "mse": relative.square}
    if relative.measured:
        rmse = math.sqrt(relative.square)
        bias |= {"rmse": rmse, "rmse_standard_error": relative.standard_error / (2 * rmse)}
    else:
        bias["rmse_below"] = math.sqrt(relative.bound)
    if displayed.measured:
        bias["psnr_db"] = -10 * math.log10(displayed.square)
    else:
        bias["psnr_db_above"] = -10 * math.log10(displayed.bound) if displayed.bound else math.inf
    return bias


def crossover(bias: Estimate, noise_of_a_sample: float, seconds: dict[int, float]) -> dict:
    """Return the sample count at which the noise of the learned render equals the bias.

    ``spp`` with ``spp_low`` and ``spp_high`` (two standard errors), and its ``seconds``, from those of measured counts;
    if no bias was measured, only ``spp_above``.
    """
    if not bias.measured:
        return {"spp_above": noise_of_a_sample / bias.bound if bias.bound else math.inf}
    margin = CONFIDENCE * bias.standard_error
    spp, low, high = (noise_of_a_sample / (bias.square + shift) for shift in (0, margin, -margin))
    return {"spp": spp, "spp_low": low, "spp_high": high, "seconds": seconds_at(spp, seconds)}


def seconds_at(spp: float, seconds: dict[int, float]) -> float | None:
    """Return the time of a render of ``spp`` samples per pixel, from measured times (count → seconds).

    Linear between them, and beyond with the slope from the first to the last; ``None`` below the first or without any.
    """
    if not seconds or spp < min(seconds):
        return None
    counts = sorted(seconds)
    first, last = counts[0], counts[-1]
    if spp <= last:
        return float(np.interp(spp, counts, [seconds[n] for n in counts]))
    slope = seconds[last] / last
    if seconds[last] > seconds[first]:
        slope = (seconds[last] - seconds[first]) / (last - first)
    return seconds[last] + slope * (spp - last)
