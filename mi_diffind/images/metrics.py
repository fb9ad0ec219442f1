"""Errors of images: thin layers over NumPy and NVIDIA's FLIP. Images are linear, shape ``(height, width, 3)``."""

import math

import numpy as np

from ..core.errors import UsageError
from .srgb import for_display

#: Side of the window of :func:`ssim_published`, pixels.
WINDOW = 11


def nonfinite_pixels(image: np.ndarray) -> int:
    """Return the number of pixels with a channel that is NaN or infinite."""
    return int((~np.isfinite(image)).any(axis=-1).sum())


def check_finite(*images: np.ndarray) -> None:
    """Raise :class:`.UsageError` if pixels of an image are NaN or infinite."""
    for image in images:
        if count := nonfinite_pixels(image):
            pixels = image.size // image.shape[-1]
            raise UsageError(f"{count:,} of {pixels:,} pixels are not finite, so that the image has no error")


def psnr(reference: np.ndarray, image: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio in dB of linear values clipped to [0, 1]; infinite for equal images.

    Raises :class:`.UsageError`, as :func:`mae` and :func:`flip` do.
    """
    check_finite(reference, image)
    mse = float(np.mean((np.clip(reference, 0, 1) - np.clip(image, 0, 1)) ** 2, dtype=np.float64))
    return math.inf if mse == 0 else -10 * math.log10(mse)


def mae(reference: np.ndarray, image: np.ndarray) -> float:
    """Return the mean absolute error of linear values, not clipped."""
    check_finite(reference, image)
    return float(np.mean(np.abs(reference - image), dtype=np.float64))


def flip(reference: np.ndarray, image: np.ndarray) -> float:
    """Return the mean LDR-FLIP (Andersson et al. 2020; 0: equal to the eye) of linear images as a screen displays them.

    They are encoded by :func:`.srgb.for_display`; the viewing distance is the default one, 67 pixels per degree.
    """
    check_finite(reference, image)
    return flip_shown(for_display(reference), for_display(image))


def flip_shown(reference: np.ndarray, image: np.ndarray) -> float:
    """Return :func:`flip` of images that are encoded for a screen already, in [0, 1]."""
    import flip_evaluator

    pair = [np.ascontiguousarray(i, dtype=np.float32) for i in (reference, image)]
    _, mean, _ = flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)
    return float(mean)


def ssim(reference: np.ndarray, image: np.ndarray) -> float | None:
    """Return the structural similarity (Wang et al. 2004) of values in [0, 1], the mean over channels.

    ``None`` if scikit-image is not installed or the image is smaller than the window of 7 texels.
    """
    try:
        from skimage.metrics import structural_similarity
    except ImportError:
        return None
    if min(reference.shape[:2]) < 7:
        return None
    return float(structural_similarity(reference, image, data_range=1.0, channel_axis=-1))


def ssim_published(reference: np.ndarray, image: np.ndarray, counted: np.ndarray | None = None) -> float | None:
    """Return the structural similarity of values in [0, 1] as tables of radiance fields state it.

    The window is a Gaussian of 11 × 11 pixels, σ = 1.5, with population covariances (Wang et al. 2004); the mean is
    that of all channels of the pixels whose window lies inside, or of those among them that are ``counted``
    ``(height, width)``. ``None`` if there are no such pixels.
    """
    from skimage.metrics import structural_similarity

    inside = (slice(WINDOW // 2, -(WINDOW // 2)),) * 2
    if min(reference.shape[:2]) < WINDOW or (counted is not None and not counted[inside].any()):
        return None
    _, similarity = structural_similarity(
        reference, image, data_range=1.0, channel_axis=-1, gaussian_weights=True, sigma=1.5,
        use_sample_covariance=False, full=True,
    )  # fmt: skip
    similarity = similarity[inside]
    return float(np.mean(similarity if counted is None else similarity[counted[inside]], dtype=np.float64))


def angle(reference: np.ndarray, image: np.ndarray) -> float:
    """Return the mean angle in degrees between normals stored as (n + 1)/2, each brought to length 1."""
    a, b = (2 * v[..., :3].astype(np.float64) - 1 for v in (reference, image))
    a, b = (v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-6) for v in (a, b))
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))).mean())


def compare(reference: np.ndarray, image: np.ndarray) -> dict[str, float]:
    """Return ``psnr_db``, ``flip`` and ``mae`` of two images."""
    return {"psnr_db": psnr(reference, image), "flip": flip(reference, image), "mae": mae(reference, image)}
