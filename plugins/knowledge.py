"""What can be said about a texture before anything is rendered: bounds of its values, whether it is being optimised."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mi_diffind.tasks.disney.effects import Known

#: Wavelengths at which constant spectra are looked at, in nm: visible light in steps of 10.
_WAVELENGTHS = [360.0 + 10 * i for i in range(48)]


class Watched:
    """
    A parameter of a BSDF, a texture or a number, and what is known about it. ``constant``: it is the same everywhere (a
    colour in spectral variants is not: it varies with the wavelengths).
    """

    def __init__(self, texture, colour: bool = False):
        self.texture, self.colour = texture, colour
        self.constant = not texture.is_spatially_varying() and not (colour and mi.is_spectral)
        self._parameters = mi.traverse(texture)
        self._arrays, self._found = None, Known()

    def _values(self) -> list:
        """The arrays that the texture consists of at present, children included."""
        values = (self._parameters[key] for key in self._parameters.keys())
        return [v for v in values if isinstance(v, dr.ArrayBase)]

    def optimised(self) -> bool:
        """Is a derivative with respect to it asked for? Also where derivatives are suspended at the moment."""
        return any(map(has_gradient, self._values()))

    def look(self) -> None:
        """Find out its bounds, if they are not known or it is not what it was."""
        values = self._values()
        if dr.flag(dr.JitFlag.FreezingScope) or any(map(has_gradient, values)):
            self._arrays, self._found = None, Known()  # values cannot be looked at, or need not
        elif self._arrays is None or [*map(_identity, self._arrays)] != [*map(_identity, values)]:
            # The copies keep the arrays alive, so that no other one gets their index
            self._arrays, self._found = [dr.detach(v) for v in values], bounds(self.texture, self.colour)

    def known(self) -> Known:
        """What was found when it was last looked at; anything is possible if it is being optimised."""
        return Known(optimised=True) if self.optimised() else self._found


class WatchedNumber(Watched):
    """A number that is a parameter of the BSDF itself (which is assigned to in place)."""

    def __init__(self, number):
        self.texture, self.colour, self.constant = number, False, True
        self._arrays, self._found = None, Known()

    def _values(self) -> list:
        return [self.texture]


class WatchedChannel(Watched):
    """A channel of a texture, about whose values nothing is known."""

    def look(self) -> None:
        pass


def has_gradient(value) -> bool:
    """Is a derivative with respect to this array asked for?"""
    if dr.is_tensor_v(value):
        return value.array.index_ad != 0
    if dr.depth_v(value) > 1:
        return any(has_gradient(v) for v in value)
    return dr.is_diff_v(value) and value.index_ad != 0


def _identity(value) -> tuple:
    """What tells an array from another one that took its place."""
    if dr.is_tensor_v(value):
        return _identity(value.array)
    if dr.depth_v(value) > 1:
        return tuple(i for v in value for i in _identity(v))
    return (value.index,) if dr.is_jit_v(value) else (value,)


def bounds(texture, colour: bool = False) -> Known:
    """
    Bounds of what ``texture`` (or a number) gives: of its ``eval`` if ``colour``, else of its ``eval_1``. Constants and
    bitmaps are known, whatever their filter; anything else may have any value in [0, 1].
    """
    if not isinstance(texture, mi.Object):
        return _of([texture])
    if not texture.is_spatially_varying():
        si = dr.zeros(mi.SurfaceInteraction3f)
        if not colour:
            return _of([texture.eval_1(si)])
        if mi.is_spectral:
            found = []
            for i in range(0, len(_WAVELENGTHS), 4):
                si.wavelengths = mi.UnpolarizedSpectrum(_WAVELENGTHS[i : i + 4])
                found += list(texture.eval(si))
            return _of(found)
        return _of(list(texture.eval(si)))
    data = mi.traverse(texture).get("data")
    if data is None or not dr.is_tensor_v(data) or data.ndim != 3:
        return Known()
    channels = data.shape[-1]
    if mi.is_spectral and channels > 1:
        return Known()  # coefficients of spectra
    scale = 1 / 255 if dr.type_v(data) == dr.VarType.UInt8 else 1
    flat = mi.Float(data.array) * scale
    index = dr.arange(mi.UInt32, dr.width(flat) // channels) * channels
    return _of([dr.gather(mi.Float, flat, index + k) for k in range(min(channels, 3))])


def _of(channels: list) -> Known:
    """From the values of each channel; unknown if there is a NaN among them."""
    arrays = [dr.detach(mi.Float(c)) for c in channels]
    arrays = [dr.select(dr.isnan(a), dr.inf, a) for a in arrays]
    spread = [dr.max(dr.abs(a - arrays[0])) for a in arrays[1:]]
    found = [*(dr.min(a) for a in arrays), *(dr.max(a) for a in arrays), *spread]
    found = dr.concat(found).numpy().tolist()
    n = len(arrays)
    if not all(math.isfinite(v) for v in found):
        return Known()
    return Known(min(found[:n]), max(found[n : 2 * n]), grey=max(found[2 * n :], default=0) == 0)
