"""Helpers of BSDFs: bounds of parameters, known before anything is rendered, and directions in masked lanes."""

from __future__ import annotations

import math
import threading

import drjit as dr
import mitsuba as mi

from mi_diffind.arrays.boxes import ValueBounds
from mi_diffind.core import compat

_waiting = threading.local()


def when_outermost(work) -> None:
    """Do ``work``, which may wait for a kernel, now, or after the work that this thread is already waiting in.

    Mitsuba loads scenes in several threads, and a thread that waits for a kernel takes up the next task, which may
    construct the next material: without this queue, constructors would nest without bounds.
    """
    queue = getattr(_waiting, "queue", None)
    if queue is not None:
        queue.append(work)
        return
    _waiting.queue = [work]
    try:
        while _waiting.queue:
            # For Dr.Jit, computations for other materials in the meantime came before
            compat.new_scope(mi.Float)
            _waiting.queue.pop(0)()
    finally:
        _waiting.queue = None


class TrackedParameter:
    """Parameter of a BSDF, a texture or a number, with bounds of its values.

    ``constant``: the value is the same everywhere (a colour in spectral variants is not, since it varies with the
    wavelengths). ``is_eta``: bounds are those of the reflectance of this index of refraction. ``known``: bounds that
    hold for any entries of the texture's arrays, by default those of its file if it has one.
    """

    def __init__(self, texture, colour: bool = False, is_eta: bool = False, known: ValueBounds | None = None):
        self.texture, self.colour, self.is_eta = texture, colour, is_eta
        if known is None and not is_eta and hasattr(texture, "layout_bounds"):
            known = texture.layout_bounds()
        varies = colour and mi.is_spectral
        self._known, self._parameters = known is not None, None
        self._arrays, self._bounds = [] if self._known else None, known or ValueBounds()
        if isinstance(texture, dr.ArrayBase):  # a parameter of the BSDF itself, assigned to in place
            self.constant = True
        elif self._known:
            self.constant = not texture.is_spatially_varying() and not varies
        else:
            self.constant = compat.is_constant_texture(texture) and not varies
            self._parameters = mi.traverse(texture)

    def _values(self) -> list:
        """Return the arrays that decide the bounds at present, those of nested textures included."""
        if self._known:
            return []
        if self._parameters is None:
            return [self.texture]
        values = (self._parameters[key] for key in self._parameters.keys())
        return [v for v in values if isinstance(v, dr.ArrayBase)]

    def optimised(self) -> bool:
        """Return whether gradients of the parameter are enabled, also while derivatives are suspended."""
        return any(map(compat.has_gradient, self._values()))

    def changed(self) -> bool:
        """Return whether the arrays changed since :meth:`update`: a texture may change without a notification."""
        if self._arrays is None:
            return True
        return [*map(compat.identity, self._arrays)] != [*map(compat.identity, self._values())]

    def is_fixed(self) -> bool:
        """Return whether the parameter is constant, and neither changed nor optimised."""
        return self.constant and not self.optimised() and not self.changed()

    def update(self) -> None:
        """Determine the bounds, unless the arrays are unchanged."""
        if self._known:
            return
        if dr.flag(dr.JitFlag.FreezingScope) or self.optimised():
            self._arrays, self._bounds = None, ValueBounds()  # values cannot be evaluated, or need not be
        elif self.changed():
            # The copies keep the arrays alive, so that no other one gets their index
            self._arrays, bounds = [dr.detach(v) for v in self._values()], value_bounds(self.texture, self.colour)
            if self.is_eta:  # an index of 1 reflects nothing
                bounds = ValueBounds(0, 0) if bounds.is_always(1) else ValueBounds(0, math.inf)
            self._bounds = bounds

    def bounds(self) -> ValueBounds:
        """Return the bounds of the last :meth:`update`; unknown if the arrays changed or are being optimised."""
        if self.optimised():
            return ValueBounds(optimised=True)
        return ValueBounds() if self.changed() else self._bounds


def value_bounds(texture, colour: bool = False) -> ValueBounds:
    """Return bounds of the values of ``texture`` (or a number): of its ``eval`` if ``colour``, else of its ``eval_1``.

    Bounds of constants and bitmaps are known, for any filter; those of any other texture are unknown.
    """
    if isinstance(texture, dr.ArrayBase):
        return _bounds([texture])
    constant = compat.is_constant_texture(texture)
    if constant and mi.is_spectral and colour:
        # Smooth, and coefficients of a sigmoid: neither black nor without hue, unless it is uniform
        return _bounds([mi.traverse(texture)["value"]]) if compat.is_uniform_spectrum(texture) else ValueBounds()
    if constant:
        si = dr.zeros(mi.SurfaceInteraction3f)
        return _bounds(list(texture.eval(si)) if colour else [texture.eval_1(si)])
    if not compat.is_bitmap(texture):
        return ValueBounds()
    data = mi.traverse(texture)["data"]
    channels = data.shape[-1]
    if mi.is_spectral and channels > 1:
        return ValueBounds()  # coefficients of spectra
    scale = 1 / 255 if dr.type_v(data) == dr.VarType.UInt8 else 1
    flat = mi.Float(data.array) * scale
    index = dr.arange(mi.UInt32, dr.width(flat) // channels) * channels
    return _bounds([dr.gather(mi.Float, flat, index + k) for k in range(min(channels, 3))])


def _bounds(channels: list) -> ValueBounds:
    """Return the bounds of the values of all channels; unknown if one is NaN."""
    arrays = [dr.detach(mi.Float(c)) for c in channels]
    arrays = [dr.select(dr.isnan(a), dr.inf, a) for a in arrays]
    spread = [dr.max(dr.abs(a - arrays[0])) for a in arrays[1:]]
    extrema = [*(dr.min(a) for a in arrays), *(dr.max(a) for a in arrays), *spread]
    extrema = dr.concat(extrema).numpy().tolist()
    n = len(arrays)
    if not all(math.isfinite(v) for v in extrema):
        return ValueBounds()
    return ValueBounds(min(extrema[:n]), max(extrema[n : 2 * n]), grey=max(extrema[2 * n :], default=0) == 0)


def are_directions(wi, wo):
    """Return the lanes in which both vectors are about as long as directions, 1: not NaN, infinite, zero or tiny.

    Masked lanes hold such vectors. They have to be replaced before anything is computed: a derivative of 0, multiplied
    by an infinite one, is NaN.
    """
    return dr.abs(dr.squared_norm(wi) + dr.squared_norm(wo) - 2) < 0.5


def glossy_directions(ctx, wi, wo, active):
    """Return both directions, safe to compute with in every lane, and the mask of lanes whose result counts.

    The latter are on the front side, of a BSDF whose only component is glossy.
    """
    active = active & (wi.z > 0) & (wo.z > 0) & are_directions(wi, wo)
    if not ctx.is_enabled(mi.BSDFFlags.GlossyReflection, 0):
        active = mi.Bool(False)
    up = mi.Vector3f(0, 0, 1)
    return dr.select(active, wi, up), dr.select(active, wo, up), active
