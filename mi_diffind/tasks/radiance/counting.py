"""What rays through a field ask of it: how much is skipped, how much is read (:mod:`.march`)."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import drjit as dr

from . import march as marching
from .field import VolumeField


@dataclass(frozen=True)
class Counts:
    """
    Of ``rays``, those that cross the field's box (``crossing``), and those of them that end opaque (``opaque``). Of the
    ``steps`` in the box: how many lie behind what is ``opaque`` (``hidden``), how many in what is known to be empty
    (``skipped``), at how many the density is read (``looks``), and at how many of these the radiance (``colours``).
    """

    rays: int
    crossing: int
    opaque: int
    steps: int
    hidden: int
    skipped: int
    looks: int
    colours: int

    def asdict(self) -> dict:
        return asdict(self)


class Counted(VolumeField):
    """A field that counts how often density and radiance are read; ``blind``: it does not know what is empty."""

    def __init__(self, field: VolumeField, blind: bool = False):
        super().__init__(field.types, field.lower, field.upper, field.voxel, field.arrays, field.step)
        self.field, self.blind = field, blind
        self.numbers = dr.zeros(field.types.UInt32, 2)

    def _count(self, which: int, active) -> None:
        UInt32 = self.types.UInt32
        dr.scatter_add(self.numbers, UInt32(1), UInt32(which), self.types.Bool(active))

    def look(self, p, active=True):
        self._count(0, active)
        return self.field.look(p, active)

    def colour(self, latent, p, d, active=True):
        self._count(1, active)
        return self.field.colour(latent, p, d, active)

    def skip(self, p, d, active=True):
        return self.types.Float(0) if self.blind else self.field.skip(p, d, active)


def count(field: VolumeField, o, d, near, far, active=True) -> Counts:
    """What :func:`.march.march` does for these rays, which takes two of it."""
    types = field.types
    with dr.suspend_grad():
        o, active = types.Array3f(o), types.Bool(active)
        rays = dr.max(dr.width(o, d, near, far, active))
        *_, length, crossing = marching.box(field, o, d, near, far, active)
        steps = dr.select(crossing, dr.ceil(length / field.step), 0)
        knowing, blind = Counted(field), Counted(field, blind=True)
        found = marching.march(knowing, o, d, near, far, crossing)
        opaque = crossing & (found.transmittance <= marching.OPAQUE)
        dr.eval(marching.march(blind, o, d, near, far, crossing).transmittance, opaque, steps)
        looks, colours = (int(n) for n in knowing.numbers.numpy())
        reached = int(blind.numbers[0])
        total = round(float(dr.sum(types.Float64(steps))[0]))
        return Counts(
            rays, int(dr.count(crossing)[0]), int(dr.count(opaque)[0]), total, max(0, total - reached),
            max(0, reached - looks), looks, colours,
        )  # fmt: skip
