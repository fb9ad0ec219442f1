"""What can be said about a texture before anything is rendered: bounds of its values, whether it is being optimised."""

from __future__ import annotations

import math
import threading

import drjit as dr
import mitsuba as mi

from mi_diffind import compat
from mi_diffind.bounds import ValueBounds

_waiting = threading.local()


def when_outermost(work) -> None:
    """
    Do ``work``, which may wait for a kernel, now; or, if this thread is waiting in other such work already, after that.

    Mitsuba loads scenes in several threads, and one that waits for a kernel takes up the next task, which may construct
    the next material: without this, constructors would nest without bounds.
    """
    queue = getattr(_waiting, "queue", None)
    if queue is not None:
        queue.append(work)
        return
    _waiting.queue = [work]
    try:
        while _waiting.queue:
            # What was computed for other materials in the meantime came before, as far as Dr.Jit is concerned
            compat.new_scope(mi.Float)
            _waiting.queue.pop(0)()
    finally:
        _waiting.queue = None


class TrackedParameter:
    """
    A parameter of a BSDF, a texture or a number, and what is known about it. ``constant``: it is the same everywhere (a
    colour in spectral variants is not: it varies with the wavelengths). ``is_eta``: it stands for the reflectance that
    belongs to it.
    """

    def __init__(self, texture, colour: bool = False, is_eta: bool = False):
        self.texture, self.colour, self.is_eta = texture, colour, is_eta
        if isinstance(texture, dr.ArrayBase):  # a parameter of the BSDF itself, assigned to in place
            self.constant, self._parameters = True, None
        else:
            self.constant = compat.is_constant_texture(texture) and not (colour and mi.is_spectral)
            self._parameters = mi.traverse(texture)
        self._arrays, self._found = None, ValueBounds()

    def _values(self) -> list:
        """The arrays that the texture consists of at present, children included."""
        if self._parameters is None:
            return [self.texture]
        values = (self._parameters[key] for key in self._parameters.keys())
        return [v for v in values if isinstance(v, dr.ArrayBase)]

    def optimised(self) -> bool:
        """Is a derivative with respect to it asked for? Also where derivatives are suspended at the moment."""
        return any(map(compat.has_gradient, self._values()))

    def changed(self) -> bool:
        """Is it not what it was when it was last looked at? A texture may be updated without anybody being told."""
        if self._arrays is None:
            return True
        return [*map(compat.identity, self._arrays)] != [*map(compat.identity, self._values())]

    def look(self) -> None:
        """Find out its bounds, if they are not known or it is not what it was."""
        if dr.flag(dr.JitFlag.FreezingScope) or self.optimised():
            self._arrays, self._found = None, ValueBounds()  # values cannot be looked at, or need not
        elif self.changed():
            # The copies keep the arrays alive, so that no other one gets their index
            self._arrays, self._found = [dr.detach(v) for v in self._values()], self._bounds()

    def _bounds(self) -> ValueBounds:
        found = bounds(self.texture, self.colour)
        if self.is_eta:  # 1 reflects nothing
            return ValueBounds(0, 0) if found.is_always(1) else ValueBounds(0, math.inf)
        return found

    def known(self) -> ValueBounds:
        """What was found when it was last looked at; anything is possible if it has changed, or is being optimised."""
        if self.optimised():
            return ValueBounds(optimised=True)
        return ValueBounds() if self.changed() else self._found


def bounds(texture, colour: bool = False) -> ValueBounds:
    """
    Bounds of what ``texture`` (or a number) gives: of its ``eval`` if ``colour``, else of its ``eval_1``. Constants and
    bitmaps are known, whatever their filter; anything else may have any value.
    """
    if isinstance(texture, dr.ArrayBase):
        return _of([texture])
    constant = compat.is_constant_texture(texture)
    if constant and mi.is_spectral and colour:
        # Smooth, and coefficients of a sigmoid: neither black nor without hue, unless it is uniform
        return _of([mi.traverse(texture)["value"]]) if compat.is_uniform_spectrum(texture) else ValueBounds()
    if constant:
        si = dr.zeros(mi.SurfaceInteraction3f)
        return _of(list(texture.eval(si)) if colour else [texture.eval_1(si)])
    if not compat.is_bitmap(texture):
        return ValueBounds()
    data = mi.traverse(texture)["data"]
    channels = data.shape[-1]
    if mi.is_spectral and channels > 1:
        return ValueBounds()  # coefficients of spectra
    scale = 1 / 255 if dr.type_v(data) == dr.VarType.UInt8 else 1
    flat = mi.Float(data.array) * scale
    index = dr.arange(mi.UInt32, dr.width(flat) // channels) * channels
    return _of([dr.gather(mi.Float, flat, index + k) for k in range(min(channels, 3))])


def _of(channels: list) -> ValueBounds:
    """From the values of each channel; unknown if there is a NaN among them."""
    arrays = [dr.detach(mi.Float(c)) for c in channels]
    arrays = [dr.select(dr.isnan(a), dr.inf, a) for a in arrays]
    spread = [dr.max(dr.abs(a - arrays[0])) for a in arrays[1:]]
    found = [*(dr.min(a) for a in arrays), *(dr.max(a) for a in arrays), *spread]
    found = dr.concat(found).numpy().tolist()
    n = len(arrays)
    if not all(math.isfinite(v) for v in found):
        return ValueBounds()
    return ValueBounds(min(found[:n]), max(found[n : 2 * n]), grey=max(found[2 * n :], default=0) == 0)
