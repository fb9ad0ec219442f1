"""
Noise or bias? What a render with learned tables differs by from the truth: the noise of its samples, which more time
makes smaller, and the bias of the approximation, which no time makes smaller; and where the two are equal.

*The error* of an image ``a`` against the truth ``r`` is the relative mean squared error, over pixels and channels,

    mse = mean((a − r)² / (m² + 0.01)),        shown as its root, the relative RMS error,

where ``m`` is the brightness around the pixel, a mean over 5 × 5 pixels of an exact pass that serves nothing else. The
denominator depends on none of the images that are compared, and nothing is clipped, so that squares add up exactly:
E[mse] = bias² + noise², and for independent samples noise² = σ² / spp. (A denominator made of the truth itself would
be large just where the truth is too bright, and hide a part of the noise.) The PSNR of :mod:`mi_diffind.metrics` clips
to [0, 1]; a clipped noisy image has another mean, so there is no such sum. It is given beside the rest; that of the
bias is made of the values up to 1 of the truth, where the clipped difference is the linear one. A dark pixel that one
rare bright path hits may outweigh all others: errors are those of several images with different seeds, given as median
and quartiles. The median of few samples therefore tends to be below the noise σ² / spp, which is a mean.

*The truth* is the mean of all exact passes at the highest sample count. These are independent, so their scatter is
its own noise, which is subtracted: E|a − r|² = bias² + noise² of ``a`` + noise² of ``r``. The passes are themselves
the images at that count, and each is measured against the mean of the others: no image is compared with its own seeds.

*The bias* is measured with common random numbers. Each exact pass has a learned twin with the same seed; most of the
noise is in both, and not in their difference ``d``. Of K independent differences, the mean of the scalar products
⟨dᵢ, dⱼ⟩ of all pairs i ≠ j is an unbiased estimate of bias²: the noise of two passes is uncorrelated. It may be
negative where there is no bias. Its standard error is the jackknife's (Efron and Stein 1981: on average not smaller
than the true one, and about 1.5 times as large where there is no bias). A bias counts as measured from two standard
errors on.

*The crossover* is the sample count at which the noise of the learned render, σ² / spp, equals bias²; σ² is the scatter
of its passes, and the law σ² / spp is that of independent samples (stratified ones do better). Beyond the counts that
were rendered, it is extrapolated, as is its time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: Added to the square of the brightness in the denominator of the error: linear values, 1 is white.
EPSILON = 0.01

#: The brightness is a mean over the pixels at most so far away in x and in y.
RADIUS = 2

#: A bias counts as measured if it is this many standard errors above zero, and else is below that many.
CONFIDENCE = 2.0

#: A relative error that the arithmetic of 32-bit floats makes in a render.
ROUNDING = 1e-6

#: Nobody takes more samples of a pixel: where only they would show a bias, that is all there is to say about it.
PRACTICAL = 1_000_000

#: Of fewer images there is no standard error.
LEAST = 3


@dataclass(frozen=True)
class Estimate:
    """
    What :func:`estimate` found: the ``square`` of the mean image (unbiased, so it may be negative), its
    ``standard_error``, and the ``noise`` of one image, likewise a mean square.
    """

    square: float
    standard_error: float
    noise: float

    @property
    def measured(self) -> bool:
        """Is the mean image different from zero?"""
        return self.square > CONFIDENCE * self.standard_error

    @property
    def bound(self) -> float:
        """What ``square`` is below, as far as can be told."""
        return max(self.square, 0.0) + CONFIDENCE * self.standard_error


def estimate(images: Sequence[np.ndarray], weights: np.ndarray | float = 1.0) -> Estimate:
    """
    The mean square of what independent ``images`` of the same distribution (K ≥ 3, of any one shape) have in common,
    and of what they do not: mean(weights · E[image]²) and mean(weights · Var[image]).

    With Gᵢⱼ = mean(weights · imageᵢ · imageⱼ), these are the mean of Gᵢⱼ over all i ≠ j and the mean of Gᵢᵢ less that;
    both are unbiased for any distribution of the noise. The standard error is the jackknife's, leaving out one image.
    Raises ``ValueError`` if there are fewer than three images.
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


def weights_of(image: np.ndarray) -> np.ndarray:
    """
    The weights of the relative error, 1 / (m² + 0.01), like ``image`` ``(height, width, channels)``, linear; m is its
    mean over 5 × 5 pixels, or as many as there are of them at its edges.
    """
    sums, number = image.astype(np.float64), np.ones(image.shape)
    for axis in (0, 1):
        sums, number = (_along(v, axis) for v in (sums, number))
    return 1 / ((sums / number) ** 2 + EPSILON)


def _along(values: np.ndarray, axis: int) -> np.ndarray:
    """Sums over the neighbours along an axis."""
    width = [(RADIUS, RADIUS) if k == axis else (0, 0) for k in range(values.ndim)]
    windows = np.lib.stride_tricks.sliding_window_view(np.pad(values, width), 2 * RADIUS + 1, axis)
    return windows.sum(axis=-1)


def error(image: np.ndarray, truth: np.ndarray, weights: np.ndarray, truth_noise: float) -> float:
    """
    mean(weights · (image − truth)²) − ``truth_noise``, of images of one shape: the relative MSE against what ``truth``
    would be without its noise, whose weighted mean square is ``truth_noise``.
    """
    return float(np.mean(weights * (image.astype(np.float64) - truth) ** 2)) - truth_noise


# -- what it comes to -------------------------------------------------------------------------------------------------


def root(square: float) -> float:
    """The root of an estimate of a square, 0 if that is negative."""
    return math.sqrt(max(square, 0.0))


def describe(relative: Estimate, displayed: Estimate) -> dict:
    """
    The bias as numbers, from estimates with the weights of the relative error and with those of what a display shows:
    ``measured`` (can it be told from zero?), ``mse`` (may be negative), ``mse_standard_error``; ``rmse`` and
    ``rmse_standard_error`` and ``rounding_only`` (no more than that of 32-bit floats), or else ``rmse_below``;
    ``psnr_db``, or else ``psnr_db_above``.
    """
    found = {
        "measured": relative.measured,
        "mse": relative.square,
        "mse_standard_error": relative.standard_error,
    }
    if relative.measured:
        rmse = math.sqrt(relative.square)
        found |= {"rmse": rmse, "rmse_standard_error": relative.standard_error / (2 * rmse)}
        found["rounding_only"] = rmse < ROUNDING
    else:
        found["rmse_below"] = math.sqrt(relative.bound)
    if displayed.measured:
        found["psnr_db"] = -10 * math.log10(displayed.square)
    else:
        found["psnr_db_above"] = -10 * math.log10(displayed.bound) if displayed.bound else math.inf
    return found


def crossover(bias: Estimate, noise_of_a_sample: float, points: list[dict]) -> dict:
    """
    Where the noise of the learned render equals the bias: ``spp`` with ``spp_low`` and ``spp_high`` (two standard
    errors), ``seconds``, ``seconds_wall``, ``extrapolated``; if no bias was measured, ``spp_above`` alone. ``points``:
    ``version``, ``spp``, ``timed``, ``seconds``, ``seconds_wall``, by ascending ``spp``.
    """
    if not bias.measured:
        return {"spp_above": noise_of_a_sample / bias.bound if bias.bound else math.inf}
    spp, low = (noise_of_a_sample / square for square in (bias.square, bias.bound))
    found = {
        "spp": spp,
        "spp_low": low,
        "spp_high": noise_of_a_sample / (bias.square - CONFIDENCE * bias.standard_error),
        "extrapolated": spp > points[-1]["spp"],
    }
    for kind in ("seconds", "seconds_wall"):
        seconds = {p["spp"]: p[kind] for p in points if p["version"] == "learned" and p["timed"]}
        found[kind] = seconds_of(spp, seconds)
    return found


def practical(found: dict) -> bool:
    """Is a :func:`crossover` at a number of samples that anybody takes (:data:`PRACTICAL`)?"""
    return (found.get("spp", found.get("spp_above")) or math.inf) <= PRACTICAL


def seconds_of(spp: float, seconds: dict[int, float]) -> float | None:
    """
    The time of a render of ``spp`` samples per pixel, any number, from those measured (count → seconds): linear between
    them, and beyond with the slope from the first to the last; ``None`` below the first, or if there are none.
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
