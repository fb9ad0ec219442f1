"""Base class of sources of learned BSDFs."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr

from .model import turned


class Truth:
    """Base class of sources.

    ``name`` describes the source; ``digest`` changes when its content does; ``samples``: it samples directions itself;
    ``isotropic``: it is isotropic by its format (``None``: it has to be measured). ``function``: its values are known
    for all directions. ``remark``: line about how it was read, for people.
    """

    name: str
    digest: str
    samples, function, remark = False, True, ""
    isotropic: bool | None = None

    def value(self, wi, wo) -> list:
        """Return f cos θ_o in linear sRGB, three arrays, for unit directions above the surface."""
        raise NotImplementedError

    def remarks(self, samples) -> list[str]:
        """Return sentences about what a fit to the values of ``samples`` leaves out. Raises ``UsageError``."""
        return []

    def sample(self, wi, w, u, v):
        """Return directions ``wo`` from three uniform numbers each."""
        raise NotImplementedError

    def density(self, wi, wo):
        """Return the density of :meth:`sample` per solid angle."""
        raise NotImplementedError


class FunctionTruth(Truth):
    """Source whose values f cos θ_o are those of a function ``value(wi, wo)``."""

    def __init__(self, name: str, value: Callable):
        self.name, self.digest, self.value = name, "", value


class TurnedTruth(Truth):
    """Source that is turned about the normal by ``angle``, radians."""

    def __init__(self, truth: Truth, angle: float):
        self.truth, self.angle, self.name, self.digest = truth, angle, truth.name, truth.digest
        self.samples, self.remark = truth.samples, truth.remark

    def value(self, wi, wo) -> list:
        return self.truth.value(turned(wi, -self.angle), turned(wo, -self.angle))

    def sample(self, wi, w, u, v):
        return turned(self.truth.sample(turned(wi, -self.angle), w, u, v), self.angle)

    def density(self, wi, wo):
        return self.truth.density(turned(wi, -self.angle), turned(wo, -self.angle))


#: Diffuse source of albedo 1.
WHITE = FunctionTruth("white", lambda wi, wo: [wo.z * dr.inv_pi] * 3)
