"""Image errors: thin layers over NumPy and NVIDIA's FLIP. Images are linear, shape ``(height, width, 3)``."""

from __future__ import annotations

import math

import numpy as np


def srgb(image: np.ndarray) -> np.ndarray:
    """Linear values, clipped to [0, 1], with the sRGB transfer function (IEC 61966-2-1) for display."""
    c = np.clip(np.nan_to_num(image), 0, 1)
    return np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.power(np.maximum(c, 0.0031308), 1 / 2.4) - 0.055)


def psnr(reference: np.ndarray, image: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of linear values clipped to [0, 1]; infinite for equal images."""
    mse = float(np.mean((np.clip(reference, 0, 1) - np.clip(image, 0, 1)) ** 2, dtype=np.float64))
    return math.inf if mse == 0 else -10 * math.log10(mse)


def mae(reference: np.ndarray, image: np.ndarray) -> float:
    """Mean absolute error of linear values, not clipped."""
    return float(np.mean(np.abs(reference - image), dtype=np.float64))


def flip(reference: np.ndarray, image: np.ndarray) -> float:
    """
    Mean LDR-FLIP (Andersson et al. 2020), 0 = equal to the eye, of the images as displayed (:func:`srgb`) at the
    default viewing distance of 67 pixels per degree.
    """
    import flip_evaluator

    pair = [np.ascontiguousarray(srgb(i), dtype=np.float32) for i in (reference, image)]
    _, mean, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)
    return float(mean)


def compare(reference: np.ndarray, image: np.ndarray) -> dict[str, float]:
    """All of the above in one dictionary: ``psnr_db``, ``flip``, ``mae``."""
    return {
        "psnr_db": psnr(reference, image),
        "flip": flip(reference, image),
        "mae": mae(reference, image),
    }
