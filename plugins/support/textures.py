"""Parts of textures of images: colours, coordinates outside of [0, 1], sampling of positions."""

from __future__ import annotations

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.arrays.indirection import fold
from mi_diffind.arrays.lookup import clamp

from . import upsampling

WRAP_MODES = ("repeat", "mirror", "clamp")

#: Largest entry of a transformation of texture coordinates; products of two of them fit single precision.
STRETCH = 1e18

#: Density of black positions, relative to the mean.
FLOOR = 0.01


def luminance(values: list):
    """Return the luminance of one channel or three, linear."""
    return values[0] if len(values) == 1 else mi.luminance(mi.Color3f(*values))


def spectrum(values: list, wavelengths, upsampled: bool):
    """Return the result of a texture's ``eval`` for one linear channel or three; ``upsampled``: as a spectrum."""
    if len(values) == 1 or mi.is_monochromatic:
        return mi.UnpolarizedSpectrum(luminance(values))
    return upsampling.spectrum(values, wavelengths) if upsampled else mi.UnpolarizedSpectrum(*values)


def wrapped(uv, wrap_mode: str, size: tuple[int, int], repeats: list[bool]) -> list:
    """Return the coordinates u and v at which an image of ``size`` (width, height) is read.

    ``repeats`` tells for each coordinate whether the arrays repeat by themselves. With ``mirror`` and ``clamp``, no
    coordinate lies beyond the outermost texel centres.
    """
    if wrap_mode == "repeat":
        return [x if repeat else x - dr.floor(x) for x, repeat in zip((uv.x, uv.y), repeats, strict=True)]
    folded = (fold(x) if wrap_mode == "mirror" else x for x in (uv.x, uv.y))
    return [clamp(x, 0.5 / n, 1 - 0.5 / n) for x, n in zip(folded, size, strict=True)]


def transformation(props: mi.Properties):
    """Return the property ``to_uv``, the identity by default."""
    if "to_uv" not in props:
        return mi.ScalarAffineTransform3f()
    given = props["to_uv"]
    if not hasattr(given, "extract"):
        raise RuntimeError(f'parameter "to_uv": found {given}, a transformation is needed')
    m = given.extract().matrix
    matrix = [[float(m[i, j]) for j in range(3)] for i in range(3)]
    largest = max((abs(v) for row in matrix for v in row), key=lambda v: v if v == v else math.inf)
    if not largest <= STRETCH:  # NaN, too
        raise RuntimeError(f'parameter "to_uv": found an entry of {largest:g}, allowed are up to {STRETCH:g}')
    return mi.ScalarAffineTransform3f(matrix)


def permutes_corners(matrix: list) -> bool:
    """Return whether an affine map takes the unit square to itself: flips, a transposition, quarter turns."""
    m = np.array(matrix)
    corners = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    images = (corners @ m.T)[:, :2]
    distance = np.abs(images[:, None] - corners[None, :, :2]).max(axis=-1)
    return bool((distance.min(axis=0) < 1e-4).all())


@dataclass  # a type in which frozen functions (``dr.freeze``) look for arrays
class PositionDistribution:
    """Distribution of positions in the unit square, by the texels of an image of ``size`` (width, height)."""

    distribution: object
    size: tuple[int, int]
    repeats: bool

    @classmethod
    def of(cls, image: np.ndarray, wrap_mode: str) -> PositionDistribution:
        """Return the distribution proportional to the luminance of an image, ``(height, width, channels)``.

        It is interpolated as a texture of that ``wrap_mode`` is.
        """
        weights = image[..., 0] if image.shape[-1] == 1 else image @ np.float32([0.212671, 0.715160, 0.072169])
        weights = np.maximum(weights, 0)
        mean = weights.mean(dtype=np.float64)
        weights = (weights + FLOOR * mean if mean > 0 else np.ones_like(weights)).astype(np.float32)
        distribution = mi.DiscreteDistribution2D(np.ascontiguousarray(weights))
        return cls(distribution, weights.shape[::-1], wrap_mode == "repeat")

    def sample(self, sample, active):
        """Return a position and its density; samples are clamped to [0, 1), NaN to 0."""
        sample = mi.Point2f(*(clamp(x, 0.0, 1 - 2**-24) for x in sample))
        texel, _, sample = self.distribution.sample(sample, active)
        uv = (mi.Point2f(texel) + 0.5 + mi.warp.square_to_tent(sample)) / mi.Point2f(*self.size)
        if self.repeats:
            uv -= dr.floor(uv)
        else:
            uv = dr.abs(uv)
            uv = dr.select(uv > 1, 2 - uv, uv)
        return uv, self.density(uv, active)

    def density(self, uv, active):
        """Return the density at ``uv``: the bilinear interpolation of the texels' probabilities per area."""
        corners = []
        for x, n in zip((uv.x, uv.y), self.size, strict=True):
            position = dr.fma(clamp(x, 0.0, 1.0), n, -0.5)
            lower = dr.floor(position)
            i, w = mi.Int32(lower), position - lower
            if self.repeats:
                both = dr.select(i < 0, n - 1, i), dr.select(i + 1 >= n, 0, i + 1)
            else:
                both = dr.maximum(i, 0), dr.minimum(i + 1, n - 1)
            corners.append(list(zip(both, (1 - w, w), strict=True)))
        total = 0
        for i, a in corners[0]:
            for j, b in corners[1]:
                total = total + a * b * self.distribution.pdf(mi.Point2u(mi.UInt32(i), mi.UInt32(j)), active)
        return total * (self.size[0] * self.size[1])
