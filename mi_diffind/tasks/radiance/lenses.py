"""Distortion of lenses: photographs become images of pinholes.

The model is OpenCV's, of which SIMPLE_RADIAL and RADIAL are parts (COLMAP, nerfstudio and instant-ngp name them so).
With u = (x − c_x) / f_x, v = (y − c_y) / f_y, r² = u² + v², and y downwards, a pinhole's point (u, v) is seen at

    u' = d u + 2 p₁ u v + p₂ (r² + 2 u²),  v' = d v + p₁ (r² + 2 v²) + 2 p₂ u v,
    d = (1 + k₁ r² + k₂ r⁴ + k₃ r⁶) / (1 + k₄ r² + k₅ r⁴ + k₆ r⁶).
"""

from __future__ import annotations

import functools

import numpy as np
from scipy.ndimage import map_coordinates

from .image_files import decoded, encoded

#: Coefficients of a distortion, in the order in which they are kept.
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

#: Radii at which a distortion is tried for the one from which on it turns back.
RADII = 1024


def distorted(u: np.ndarray, v: np.ndarray, coefficients) -> tuple[np.ndarray, np.ndarray]:
    """Return where a lens shows the points (``u``, ``v``) of a pinhole of the focal length 1."""
    *k, p1, p2 = coefficients
    r2 = u * u + v * v
    d = _factor(r2, k)
    return d * u + 2 * p1 * u * v + p2 * (r2 + 2 * u * u), d * v + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v


def _factor(r2: np.ndarray, k) -> np.ndarray:
    """Return the factor d of radii, given their squares and k₁ to k₆."""
    above, below = (1 + r2 * (a + r2 * (b + r2 * c)) for a, b, c in (k[:3], k[3:]))
    return above / below


@functools.lru_cache(maxsize=2)
def _sources(height: int, width: int, focal, centre, coefficients) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns ``(2, height, width)`` in a photograph for each pixel of a pinhole; whether they exist.

    There is none outside the photograph, nor beyond the radius at which the polynomials turn back.
    """
    u = (np.arange(width) + 0.5 - centre[0]) / focal[0]
    v = (np.arange(height) + 0.5 - centre[1])[:, None] / focal[1]
    x, y = distorted(u, v, coefficients)
    x, y = x * focal[0] + centre[0] - 0.5, y * focal[1] + centre[1] - 0.5
    r2 = u * u + v * v
    radii = np.linspace(0, np.sqrt(r2.max()), RADII)
    turning = np.flatnonzero(np.diff(radii * _factor(radii**2, coefficients[:6])) <= 0)
    limit = radii[turning[0]] if len(turning) else np.inf
    exists = (np.abs(x - (width - 1) / 2) <= width / 2) & (np.abs(y - (height - 1) / 2) <= height / 2)
    return np.stack([y, x]).astype(np.float32), exists & (r2 <= limit**2)


def undistorted(image: np.ndarray, mask: np.ndarray | None, focal, centre, coefficients) -> tuple:
    """Return a photograph as a pinhole of the same ``focal`` lengths and ``centre`` sees it, and its mask.

    ``image`` ``(height, width, 4)`` and the result are as :func:`.image_files.read_image` returns them; colours are
    interpolated linearly, as linear values multiplied by alpha. ``mask`` ``(height, width)``, bool, is true where a
    pixel counts (``None``: everywhere). The returned mask excludes pixels that the photograph does not show,
    which are 0.
    """
    places, exists = _sources(*image.shape[:2], tuple(focal), tuple(centre), tuple(coefficients))
    values = decoded(image) if image.dtype == np.uint8 else image
    planes = [map_coordinates(values[..., c], places, order=1, mode="nearest", prefilter=False) for c in range(4)]
    straightened = np.stack(planes, axis=-1) * exists[..., None]
    if mask is not None:
        exists = exists & map_coordinates(mask.astype(np.uint8), places, order=0, mode="nearest", prefilter=False) > 0
    return encoded(straightened) if image.dtype == np.uint8 else straightened, exists
