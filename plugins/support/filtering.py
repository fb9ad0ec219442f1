"""
How a texture filters a footprint: at which level of detail it reads, and at how many places.

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

#: The words that ``bitmap`` has for some of them.
TYPES = {"bilinear": "off", "trilinear": "trilinear", "anisotropic": "anisotropic"}

#: The properties that say how a texture filters, which one that does not filter lacks.
PROPERTIES = ("filter", "filter_type", "max_anisotropy", "sensor_to_world", "fov", "resolution", "spp")

#: The largest number of taps along the major axis.
MOST_TAPS = 16

#: Levels by which the taps of an anisotropic filter are finer than the footprint is wide: a texel is interpolated over
#: twice its width. Nearest to the mean over the footprint, 1.4 to 3.6 dB better than 0 on the three textures it was
#: chosen on.
FINER = 0.5

#: Texels of a footprint beyond which every image is a single texel: nothing above is told apart.
LARGEST = 2.0**30


@dataclass(frozen=True)
class Filter:
    """One of :data:`FILTERS`, and the number of ``taps`` along the major axis of a footprint: 1, unless anisotropic."""

    name: str = "trilinear"
    taps: int = 1

    @classmethod
    def from_properties(cls, props: mi.Properties) -> Filter:
        """From ``filter``, or ``filter_type`` in the words of ``bitmap``, and ``max_anisotropy``."""
        given = str(props.get("filter_type", ""))
        if given and given not in TYPES:
            raise RuntimeError(f'parameter "filter_type": found "{given}", allowed are {", ".join(TYPES)}')
        name = properties.one_of(props, "filter", FILTERS) if "filter" in props else ""
        if name and given and TYPES[given] != name:
            raise RuntimeError(
                f'parameter "filter_type": found "{given}" beside the filter "{name}", which is another one: give one '
                f"of the two"
            )
        name = name or TYPES.get(given, FILTERS[0])
        taps = props.get("max_anisotropy", 4)
        if isinstance(taps, bool) or not isinstance(taps, (int, float)) or taps not in range(1, MOST_TAPS + 1):
            raise RuntimeError(f'parameter "max_anisotropy": found {taps}, allowed are whole numbers 1 to {MOST_TAPS}')
        return cls(name, int(taps) if name in ("anisotropic", "stochastic") else 1)

    @property
    def reads(self) -> int:
        """Places that are read for one footprint."""
        return self.taps if self.name == "anisotropic" else 1


def cone_of(props: mi.Properties) -> footprint.Cone | None:
    """
    :meth:`.Cone.from_properties`: one and the same for equal properties, so that the reads of several textures are
    recognised as one.
    """
    found = footprint.Cone.from_properties(props)
    if found is None:
        return None
    matrix = tuple(np.array(props["sensor_to_world"].matrix).ravel().tolist())
    key = (mi.variant(), matrix, *(float(props.get(name, 1)) for name in ("fov", "resolution", "spp")))
    with _lock:
        return _cones.setdefault(key, found)


_cones: weakref.WeakValueDictionary = weakref.WeakValueDictionary()
_lock = threading.RLock()  # a thread that waits for a kernel may go on with another constructor


def in_texels(ddx: mi.Vector2f, ddy: mi.Vector2f, size: tuple[int, int]) -> tuple[mi.Vector2f, mi.Vector2f]:
    """The footprint in texels of an image of ``size`` (width, height)."""
    scale = mi.Vector2f(*size)
    return ddx * scale, ddy * scale


def isotropic(ddx: mi.Vector2f, ddy: mi.Vector2f) -> mi.Float:
    """The level whose texels have the area of a footprint, which is in texels of the image."""
    return 0.5 * _log2(footprint.area(ddx, ddy))


def anisotropic(ddx: mi.Vector2f, ddy: mi.Vector2f, taps: int) -> tuple[mi.Float, mi.Vector2f]:
    """
    The level of each of ``taps`` along the major axis of a footprint, which is in texels of the image, and that axis:
    a tap stands for what is as wide as the minor axis, or as much wider as it takes to cover the major one, and is read
    :data:`FINER`. Graphics hardware reads fewer taps where these suffice; as many as there are is nearer to the mean.
    """
    major, minor, direction = footprint.axes(ddx, ddy)
    width = dr.maximum(minor, major * (1 / taps))
    return _log2(width * 2**-FINER), direction * major


def _log2(x):
    """Of a length or an area in texels: 0 of all below 1."""
    return dr.log2(dr.clip(x, 1, LARGEST**2))


def offsets(taps: int) -> list[float]:
    """Places of the taps along the major axis, relative to its middle."""
    return [(k + 0.5) / taps - 0.5 for k in range(taps)]


def random(si: mi.SurfaceInteraction3f) -> tuple[mi.Float, mi.Float]:
    """
    Two random numbers in [0, 1) for a hit, made from the bits of its place and of its texture coordinates: the same
    whenever it is asked for again, by another texture or by another pass over the same path.
    """
    state = mi.UInt32(0x9E3779B9)
    for x in (*si.uv, *si.p):
        state = state ^ dr.reinterpret_array(mi.UInt32, dr.detach(mi.Float(x)))
        state = state * mi.UInt32(0x85EBCA6B)
        state = state ^ (state >> 15)
    found = []
    for multiplier in (0xC2B2AE35, 0x27D4EB2F):
        bits = state * mi.UInt32(multiplier)
        bits = (bits ^ (bits >> 13)) * mi.UInt32(0x165667B1)
        bits = bits ^ (bits >> 16)
        found.append(dr.reinterpret_array(mi.Float, (bits >> 9) | 0x3F800000) - 1)
    return tuple(found)
