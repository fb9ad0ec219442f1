"""Statistics of rendered images: mean and variance of passes, and a z-test of an image against a noisy reference.

Both follow Mitsuba's ``src/render/tests/test_renders.py``: a render within a fixed sample budget is compared, pixel by
pixel, with a reference and its variance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

#: Chance that an unchanged scene has a pixel below the threshold, if all pixels were independent.
SIGNIFICANCE = 0.01
#: Smallest variance that a sample is assumed to have (linear radiance, squared).
VARIANCE_FLOOR = 1e-4
#: Part of the pixels that has to pass.
REQUIRED = 0.9975


@dataclass(frozen=True)
class ZTest:
    """Result of :func:`z_test`: ``p_values`` ``(height, width, channels)`` and their threshold ``alpha``.

    ``failing``, booleans ``(height, width)``: pixels with a channel at or below the threshold; ``fraction``: part of
    the pixels that pass; ``passed``: whether that is enough.
    """

    p_values: np.ndarray
    alpha: float
    failing: np.ndarray
    fraction: float
    passed: bool


def z_test(
    image: np.ndarray, reference: np.ndarray, variance: np.ndarray, spp: int, reference_spp: float = math.inf
) -> ZTest:
    """Test whether ``image`` (``spp`` samples a pixel) shows the same scene as ``reference`` (``reference_spp``).

    All three arrays are ``(height, width, channels)``, linear; ``variance`` is that of one sample. For each value,

        z = |image − reference| / sqrt(max(variance, 1e-4) · (1/spp + 1/reference_spp)),    p = erfc(z / √2),

    and a pixel passes if p > α = 1 − (1 − 0.01)^(1/pixels) in each channel (Šidák's correction of a significance of
    1%). 99.75% of the pixels have to pass: where bright paths are rare, the means of few samples have longer tails than
    a normal distribution. Values that are not finite fail.

    Mitsuba's ``test_renders.py`` differs in two points: it counts passing channels instead of pixels, and takes the
    reference to be free of noise. Raises ``ValueError`` for arrays of different shapes.
    """
    if not image.shape == reference.shape == variance.shape:
        raise ValueError(f"shapes differ: image {image.shape}, reference {reference.shape}, variance {variance.shape}")
    with np.errstate(invalid="ignore", over="ignore"):
        deviation = np.sqrt(np.maximum(variance.astype(np.float64), VARIANCE_FLOOR) * (1 / spp + 1 / reference_spp))
        z = np.abs(image.astype(np.float64) - reference) / deviation
    p_values = np.array([math.erfc(v) if v == v else 0.0 for v in (z / math.sqrt(2)).flat]).reshape(image.shape)
    alpha = pixel_threshold(p_values[..., 0].size)
    failing = (p_values <= alpha).any(axis=-1)
    fraction = 1 - int(failing.sum()) / failing.size
    return ZTest(p_values, alpha, failing, fraction, fraction >= REQUIRED)


def pixel_threshold(pixels: int) -> float:
    """Return Šidák's threshold of the p-value of one of so many pixels."""
    return -math.expm1(math.log1p(-SIGNIFICANCE) / pixels)


@dataclass
class PassMoments:
    """Running mean and variance of the passes of a render.

    ``mean`` of all ``samples`` of a pixel, ``(height, width, channels)``, float64; ``squares``, the sum over the
    ``passes`` of their samples times their squared deviation from the mean.
    """

    mean: np.ndarray | float = 0.0
    squares: np.ndarray | float = 0.0
    samples: int = 0
    passes: int = 0

    def add(self, image: np.ndarray, samples: int) -> None:
        """Add one pass, of so many samples a pixel."""
        self.samples, self.passes = self.samples + samples, self.passes + 1
        deviation = image - self.mean  # West's recurrence: no difference of large numbers
        self.mean = self.mean + deviation / (self.samples / samples)
        self.squares = self.squares + samples * (deviation * (image - self.mean))

    @property
    def variance(self) -> np.ndarray:
        """Variance of one sample, estimated from the scatter of the passes."""
        return self.squares / max(self.passes - 1, 1)
