"""Filters of textures: the level of detail and the places of the reads for a footprint.

A footprint has two columns, ``ddx`` and ``ddy``, full conjugate diameters of an ellipse in the coordinates of the
texture (:mod:`.footprint`). A level of detail is a number ≥ 0; level l has texels 2^l times those of the image.
"""

from __future__ import annotations

import threading
import weakref
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from . import footprint, properties

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


def cone_of(props: mi.Properties) -> footprint.Cone | None:
    """Return :meth:`.Cone.from_properties`, the same object for equal properties.

    Dr.Jit merges the reads of several textures only if they share their variables.
    """
    cone = footprint.Cone.from_properties(props)
    if cone is None:
        return None
    matrix = tuple(np.array(props["sensor_to_world"].matrix).ravel().tolist())
    key = (mi.variant(), matrix, *(float(props.get(name, 1)) for name in ("fov", "resolution", "spp")))
    with _lock:
        return _cones.setdefault(key, cone)


_cones: weakref.WeakValueDictionary = weakref.WeakValueDictionary()
_lock = threading.RLock()  # a thread that waits for a kernel may go on with another constructor


def in_texels(ddx: mi.Vector2f, ddy: mi.Vector2f, size: tuple[int, int]) -> tuple[mi.Vector2f, mi.Vector2f]:
    """Return the footprint in texels of an image of ``size`` (width, height)."""
    scale = mi.Vector2f(*size)
    return ddx * scale, ddy * scale


def isotropic(ddx: mi.Vector2f, ddy: mi.Vector2f) -> mi.Float:
    """Return the level whose texels have the area of a footprint, which is given in texels of the image."""
    return 0.5 * _log2(footprint.area(ddx, ddy))


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


def offsets(taps: int) -> list[float]:
    """Return the places of the taps along the major axis, relative to its middle."""
    return [(k + 0.5) / taps - 0.5 for k in range(taps)]


def random(si: mi.SurfaceInteraction3f) -> tuple[mi.Float, mi.Float]:
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
