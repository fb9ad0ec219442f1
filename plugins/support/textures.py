"""Parts of textures of images: colours, coordinates outside of [0, 1], sampling of positions."""

from __future__ import annotations

import functools
import itertools
import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.arrays.indirection import DifferentiableArray, fold
from mi_diffind.arrays.lookup import clamp
from mi_diffind.core import compat
from mi_diffind.maps.pyramid import around, bias_share

from . import footprint, properties
from .tables import shared

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
    return upsampled_spectrum(values, wavelengths) if upsampled else mi.UnpolarizedSpectrum(*values)


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


def after_transform(transform: tuple[float, ...], to_uv) -> list[list[float]]:
    """Return the rows of the matrix that applies the texture transform of a map, then ``to_uv``."""
    m, transform = to_uv.matrix, np.array([*transform, 0, 0, 1]).reshape(3, 3)
    return (np.array([[float(m[i, j]) for j in range(3)] for i in range(3)]) @ transform).tolist()


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
    def from_image(cls, image: np.ndarray, wrap_mode: str) -> PositionDistribution:
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
        border = "repeat" if self.repeats else "clamp"
        columns, rows = (around(clamp(x, 0.0, 1.0), n, border) for x, n in zip(uv, self.size, strict=True))
        total = 0
        for (i, a), (j, b) in itertools.product(columns, rows):
            total = total + a * b * self.distribution.pdf(mi.Point2u(i, j), active)
        return total * (self.size[0] * self.size[1])


@functools.cache
def spectral_model(dtype: type) -> tuple:
    """Return the table for ``mi.TensorXf``: side, positions along the brightness, coefficients padded to four."""
    side, positions, entries = compat.srgb_coefficients()
    table = DifferentiableArray.from_numpy(entries, dtype)  # pads and aligns them
    return side, mi.Float(positions.copy()), mi.Float(table.data.array)


def spectral_coefficients(rgb):
    """Return the coefficients of the model for linear sRGB colours, clamped to [0, 1] as in Mitsuba.

    They are meaningless for greys, whose spectra are constant.
    """
    side, positions, table = spectral_model(mi.TensorXf)
    r, g, b = (clamp(mi.Float(c), 0.0, 1.0) for c in rgb)
    # The largest component, the last one of equals, and the two that follow it in turn
    green, blue = (g >= r), (b >= dr.maximum(r, g))
    z = dr.select(blue, b, dr.select(green, g, r))
    x = dr.select(blue, r, dr.select(green, b, g))
    y = dr.select(blue, g, dr.select(green, r, b))
    plane = dr.select(blue, 2, dr.select(green, 1, mi.UInt32(0)))

    scale = (side - 1) / dr.maximum(z, 1e-9)
    z_ = dr.detach(z)
    k = dr.binary_search(1, side - 1, lambda i: dr.gather(mi.Float, positions, i) <= z_) - 1
    below, above = (dr.gather(mi.Float, positions, k + i) for i in (0, 1))
    axes = [(k, (z - below) / (above - below))]
    for v in (y * scale, x * scale):
        i = dr.minimum(mi.UInt32(v), side - 2)
        axes.append((i, v - mi.Float(i)))
    total = [0, 0, 0]
    for corner in itertools.product((0, 1), repeat=3):
        index, weight = plane, 1
        for (i, w), up in zip(axes, corner, strict=True):
            index = dr.fma(index, side, i + up)
            weight = weight * (w if up else 1 - w)
        entry = dr.gather(mi.Vector4f, table, index)
        total = [dr.fma(weight, entry[n], total[n]) for n in range(3)]
    return total


def upsampled_spectrum(rgb, wavelengths):
    """Return the reflectance at ``wavelengths`` (nm), for linear sRGB colours in [0, 1]."""
    r, g, b = (clamp(mi.Float(c), 0.0, 1.0) for c in rgb)
    grey = (r == g) & (g == b)
    return mi.UnpolarizedSpectrum(dr.select(grey, r, _reflectance(spectral_coefficients(rgb), wavelengths)))


def _reflectance(coefficients: list, wavelengths):
    """Return the sigmoid of a polynomial of the wavelength (nm)."""
    c0, c1, c2 = coefficients
    v = dr.fma(dr.fma(c0, wavelengths, c1), wavelengths, c2)
    return dr.fma(0.5 * v, dr.rsqrt(dr.fma(v, v, 1)), 0.5)


def upsampled_mean(rgb):
    """Return the mean of the spectrum over 16 wavelengths, as Mitsuba computes it."""
    wavelengths = np.linspace(mi.MI_CIE_MIN, mi.MI_CIE_MAX, 16).tolist()
    coefficients = spectral_coefficients(rgb)
    total = sum(_reflectance(coefficients, wavelength) for wavelength in wavelengths)
    r, g, b = (clamp(mi.Float(c), 0.0, 1.0) for c in rgb)
    return dr.select((r == g) & (g == b), r, total / len(wavelengths))


FILTERS = ("trilinear", "off", "anisotropic", "stochastic")

#: Name of a filter of ``bitmap`` → the equal one of :data:`FILTERS`.
TYPES = {"bilinear": "off", "trilinear": "trilinear", "anisotropic": "anisotropic"}

#: Properties of filtering textures that other textures lack.
PROPERTIES = ("filter", "filter_type", "max_anisotropy", "sensor_to_world", "fov", "resolution", "spp")

#: Largest number of taps along the major axis.
MOST_TAPS = 16

#: Levels by which the taps of an anisotropic filter are finer than the width of the footprint, since interpolation
#: spreads a texel over twice its width. Among the values tried on three textures, 0.5 is nearest to the mean over the
#: footprint: 1.4 to 3.6 dB better than 0.
FINER = 0.5

#: Limit of the size of a footprint in texels; beyond it, the coarsest level is one texel for any image.
LARGEST = 2.0**30


@dataclass(frozen=True)
class Filter:
    """One of :data:`FILTERS`, with the number of ``taps`` along the footprint's major axis: 1, unless anisotropic."""

    name: str = "trilinear"
    taps: int = 1

    @classmethod
    def from_properties(cls, props: mi.Properties) -> Filter:
        """Read ``filter``, or ``filter_type`` as in ``bitmap``, and ``max_anisotropy``. Raises ``RuntimeError``."""
        given = str(props.get("filter_type", ""))
        if given and given not in TYPES:
            raise RuntimeError(f'parameter "filter_type": found "{given}", allowed are {", ".join(TYPES)}')
        name = properties.one_of(props, "filter", FILTERS) if "filter" in props else ""
        if name and given and TYPES[given] != name:
            raise RuntimeError(
                f'parameter "filter_type": found "{given}", which contradicts the filter "{name}": give one of them'
            )
        name = name or TYPES.get(given, FILTERS[0])
        taps = props.get("max_anisotropy", 4)
        if isinstance(taps, bool) or not isinstance(taps, (int, float)) or taps not in range(1, MOST_TAPS + 1):
            raise RuntimeError(f'parameter "max_anisotropy": found {taps}, allowed are whole numbers 1 to {MOST_TAPS}')
        return cls(name, int(taps) if name in ("anisotropic", "stochastic") else 1)

    @property
    def reads(self) -> int:
        """Number of places that are read for one footprint."""
        return self.taps if self.name == "anisotropic" else 1


def shared_cone(props: mi.Properties) -> footprint.Cone | None:
    """Return :meth:`.Cone.from_properties`, the same object for equal properties (:func:`.shared`)."""
    cone = footprint.Cone.from_properties(props)
    if cone is None:
        return None
    matrix = tuple(np.array(props["sensor_to_world"].matrix).ravel().tolist())
    key = (mi.variant(), matrix, *(float(props.get(name, 1)) for name in ("fov", "resolution", "spp")))
    return shared(("cone", *key), lambda: cone)


def isotropic(ddx: mi.Vector2f, ddy: mi.Vector2f, bias: float = 0.0) -> mi.Float:
    """Return the level whose texels have the area of a footprint, which is given in texels of the image.

    A level ``bias`` that will be added is taken back in part where the footprint is elongated (:func:`.bias_share`): a
    finer level would alias along the major axis.
    """
    area = footprint.area(ddx, ddy)
    level = 0.5 * _log2(area)
    if not bias:
        return level
    mean = 0.5 * (dr.squared_norm(ddx) + dr.squared_norm(ddy))
    return level - bias * (1 - bias_share(area * dr.rcp(dr.maximum(mean, 1e-30))))


def anisotropic(ddx: mi.Vector2f, ddy: mi.Vector2f, taps: int) -> tuple[mi.Float, mi.Vector2f]:
    """Return the level of all ``taps`` along the major axis of a footprint in texels of the image, and that axis.

    A tap is as wide as the minor axis, or wider if the taps would not cover the major axis otherwise; its level is
    :data:`FINER` than this width. Graphics hardware reads fewer taps where these suffice; always reading all of them is
    nearer to the mean.
    """
    major, minor, direction = footprint.axes(ddx, ddy)
    width = dr.maximum(minor, major * (1 / taps))
    return _log2(width * 2**-FINER), direction * major


def _log2(x):
    """Return the binary logarithm of a length or an area in texels, 0 below 1."""
    return dr.log2(dr.clip(x, 1, LARGEST**2))


def hit_numbers(si: mi.SurfaceInteraction3f) -> tuple[mi.Float, mi.Float]:
    """Return two random numbers in [0, 1) for a hit: a hash of the bits of its position and uv.

    Every texture, and every pass over the same path, gets the same numbers.
    """
    state = mi.UInt32(0x9E3779B9)
    for x in (*si.uv, *si.p):
        state = state ^ dr.reinterpret_array(mi.UInt32, dr.detach(mi.Float(x)))
        state = state * mi.UInt32(0x85EBCA6B)
        state = state ^ (state >> 15)
    numbers = []
    for multiplier in (0xC2B2AE35, 0x27D4EB2F):
        bits = state * mi.UInt32(multiplier)
        bits = (bits ^ (bits >> 13)) * mi.UInt32(0x165667B1)
        bits = bits ^ (bits >> 16)
        numbers.append(dr.reinterpret_array(mi.Float, (bits >> 9) | 0x3F800000) - 1)
    return tuple(numbers)
