"""Radiance fields in a scene: where they are put, what rays see of them in the world, and as which light."""

from __future__ import annotations

from itertools import product
from types import ModuleType

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind import compat
from mi_diffind.tasks.radiance import counting
from mi_diffind.tasks.radiance import march as marching

from . import upsampling
from .distance_shapes import Placement

#: Luminance of linear sRGB, as Mitsuba has it.
LUMINANCE = (0.212671, 0.715160, 0.072169)


class PlacedField:
    """
    A radiance field (:class:`mi_diffind.tasks.radiance.field.VolumeField`) that ``to_world``, a similarity, puts into
    the world. It looks the same from everywhere, whatever its size: densities are per length of its own frame.
    """

    def __init__(self, field, to_world):
        self.field, self.placement = field, Placement.of(to_world, 1.0, (0, 0, 0))
        self.axes = mi.Frame3f(*(mi.Vector3f(column.tolist()) for column in self.placement.rotation.T))
        dr.make_opaque(self.axes)
        self.origin = dr.opaque(mi.Point3f, self.placement.origin.tolist())
        self.size = dr.opaque(mi.Float, self.placement.size)

    def held(self) -> list:
        """
        All arrays that rays read. An instance of a plugin that has them as an attribute of its own can be part of a
        frozen function (``dr.freeze``), which does not look into other objects.
        """
        return [self.axes, self.origin, self.size, *_arrays_of(self.field, set())]

    @property
    def exposed(self) -> dict:
        """Those of the field's arrays that can be optimised: name → tensor."""
        return {name: values for name, values in self.field.arrays.items() if dr.is_float_v(values)}

    def optimised(self) -> bool:
        """Is a derivative with respect to the field's arrays asked for?"""
        return any(compat.has_gradient(values) for values in self.exposed.values())

    def _local(self, ray, far, active) -> tuple:
        """What the functions of :mod:`.march` take, after the field."""
        o = mi.Point3f(self.axes.to_local(mi.Vector3f(ray.o - self.origin)) / self.size)
        return o, self.axes.to_local(ray.d), mi.Float(0), far / self.size, active

    def enters(self, ray, far, active=True) -> tuple:
        """The distance at which rays enter the field's box, and whether they do, before the distance ``far``."""
        with dr.suspend_grad():
            _, near, _, crossing = marching.box(self.field, *self._local(ray, far, active))
            return near * self.size, crossing

    def overlaps(self, other: PlacedField) -> bool:
        """Do the boxes of two fields have a volume in common? By the theorem of separating axes."""
        corners = [np.array(list(product(*zip(f.field.lower, f.field.upper, strict=True)))) for f in (self, other)]
        points = [f.placement.world(c) for f, c in zip((self, other), corners, strict=True)]
        axes = [self.placement.rotation.T, other.placement.rotation.T]
        crossed = np.cross(axes[0][:, None], axes[1][None]).reshape(-1, 3)
        for axis in (*axes[0], *axes[1], *crossed[np.linalg.norm(crossed, axis=1) > 1e-6]):
            a, b = (p @ axis for p in points)
            if min(a.max(), b.max()) - max(a.min(), b.min()) <= 1e-5 * (a.max() - a.min()):
                return False
        return True

    def march(self, ray, far, active=True) -> marching.Marched:
        """What rays see of the field before the distance ``far``; ``depth`` in units of the field's own frame."""
        return marching.march(self.field, *self._local(ray, far, active))

    def count(self, ray, far, active=True) -> counting.Counts:
        """What :meth:`march` reads."""
        return counting.count(self.field, *self._local(ray, far, active))

    def replay(self, ray, far, active, marched, d_colour, d_transmittance, d_depth) -> None:
        """See :func:`.march.replay`; ``depth`` is that of the world."""
        local = self._local(ray, far, active)
        marching.replay(self.field, *local, 0.5, marched, d_colour, d_transmittance, d_depth * self.size)

    def tangent(self, ray, far, active, marched) -> tuple:
        """See :func:`.march.tangent`; ``depth`` is that of the world."""
        colour, transmittance, depth = marching.tangent(self.field, *self._local(ray, far, active), 0.5, marched)
        return colour, transmittance, depth * self.size


def _arrays_of(value, known: set) -> list:
    """The Dr.Jit arrays in an object of ours and in what it refers to."""
    if id(value) in known:
        return []
    known.add(id(value))
    if isinstance(value, dr.ArrayBase):
        return [value] if dr.is_jit_v(value) else []
    if isinstance(value, dict):
        inside = value.values()
    elif isinstance(value, (list, tuple)):
        inside = value
    else:
        inside = (
            vars(value).values() if hasattr(value, "__dict__") and not isinstance(value, (type, ModuleType)) else ()
        )
    return [array for one in inside for array in _arrays_of(one, known)]


class Light:
    """
    Linear RGB radiance as light of the variant that is set: itself, its luminance, or a spectrum, which is that of
    Mitsuba's emitters, the upsampled colour of at most ½ times that of the illuminant D65.
    """

    def __init__(self):
        self.illuminant = mi.load_dict({"type": "d65"}, parallel=False) if mi.is_spectral else None

    def of(self, colour, wavelengths, active=True):
        """The light of RGB ``colour`` (three floats)."""
        if mi.is_monochromatic:
            return mi.Spectrum(sum(w * c for w, c in zip(LUMINANCE, colour, strict=True)))
        if not mi.is_spectral:
            return mi.Spectrum(*colour)
        scale = 2 * dr.maximum(dr.max(mi.Array3f(*colour)), 1e-20)
        at = dr.zeros(mi.SurfaceInteraction3f)
        at.wavelengths = wavelengths
        spectrum = upsampling.spectrum([c / scale for c in colour], wavelengths)
        return mi.Spectrum(spectrum * scale * self.illuminant.eval(at, active))

    def adjoint(self, colour, wavelengths, weight, active=True):
        """The derivative of ``dot(weight, of(colour))`` with respect to ``colour``: three floats."""
        if mi.is_monochromatic:
            return mi.Array3f(*(w * weight.x for w in LUMINANCE))
        if not mi.is_spectral:
            return mi.Array3f(*weight)
        with dr.resume_grad():
            free = mi.Array3f(dr.detach(colour))
            dr.enable_grad(free)
            dr.backward_from(dr.dot(weight, self.of(free, wavelengths, active)))
            return dr.select(active & _coloured(colour), dr.grad(free), 0)

    def tangent(self, colour, change, wavelengths, active=True):
        """How the light of ``colour`` changes with its ``change``."""
        if not mi.is_spectral:
            return self.of(change, wavelengths, active)
        with dr.resume_grad():
            free = mi.Array3f(dr.detach(colour))
            dr.enable_grad(free)
            dr.set_grad(free, mi.Array3f(change))
            return dr.select(active & _coloured(colour), dr.forward_to(self.of(free, wavelengths, active)), 0)


def _coloured(colour):
    """Black has no derivative, since the spectrum of a colour depends on its hue alone."""
    return dr.max(mi.Array3f(dr.detach(colour))) > 0
