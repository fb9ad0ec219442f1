"""Signed distance fields that are formulas, for tests, and how a scene gets them as shapes."""

import sys

import drjit as dr
import numpy as np

from mi_diffind.tasks.sdf.field import Field


class Ball(Field):
    """A ball of the radius ``r`` (a number, or an array that may be optimised) around ``centre``."""

    def __init__(self, types, r=0.4, centre=(0, 0, 0), half=0.5):
        super().__init__(types, (-half,) * 3, (half,) * 3, 0.01, 1.0)
        self.r, self.centre = types.Float(r), centre

    def value(self, p, active=True):
        return self.gradient(p, active)[0]

    def gradient(self, p, active=True):
        to = self.types.Array3f(*(x - c for x, c in zip(p, self.centre, strict=True)))
        length = dr.norm(to)
        inside = self.inside(p) & active
        unit = dr.select(length > 0, to / dr.select(length > 0, length, 1), 0)
        return dr.select(inside, length - self.r, self.band), dr.select(inside, unit, 0)


class Slab(Field):
    """What lies within ``thickness`` / 2 of the plane z = 0, up to the sides of the box."""

    def __init__(self, types, thickness, normal=(0.0, 0.0, 1.0)):
        super().__init__(types, (-0.5,) * 3, (0.5,) * 3, 0.01, 1.0)
        self.thickness, self.axis = thickness, np.asarray(normal) / np.linalg.norm(normal)

    def value(self, p, active=True):
        along = sum(x * float(n) for x, n in zip(p, self.axis, strict=True))
        return dr.select(self.inside(p) & active, dr.abs(along) - self.thickness / 2, self.band)

    def gradient(self, p, active=True):
        along = sum(x * float(n) for x, n in zip(p, self.axis, strict=True))
        return self.value(p, active), self.types.Array3f(*map(float, self.axis)) * dr.sign(along)


class Steps(Ball):
    """A ball whose values jump over zero: ± 0.02 of the distance's sign beyond it, and only a third of the distance."""

    def gradient(self, p, active=True):
        value, slope = super().gradient(p, active)
        return dr.copysign(dr.abs(value) / 3 + 0.02, value), slope

    def look(self, p, d, active=True):
        value = self.value(p, active)
        return value, dr.abs(value) - 0.02


def register(mi, fields: dict, name: str = "test_solid") -> None:
    """A shape ``name`` whose ``field`` is the key of one in ``fields``; its box is as large as in the unit frame."""
    solids = sys.modules["mi_diffind.plugins.support.solids"]

    def make(props):
        placement = solids.Placement.of(props.get("to_world", mi.ScalarTransform4f()), 1.0, (0, 0, 0))
        return Held(props, fields[props["field"]], placement, props.get("smooth", False))

    class Held(solids.Solid):
        def optimised(self):
            return any(dr.is_diff_v(v) and v.index_ad for v in vars(self.field).values() if isinstance(v, mi.Float))

    mi.register_shape(name, make)
