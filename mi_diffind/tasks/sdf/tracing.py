"""
Where rays meet the surface of a field (:class:`.field.Field`), in the unit frame.

A ray enters the field's box and goes as far as the field says that the sign cannot change, at least :data:`EPSILON`,
until the sign is another one than it was at the start (John C. Hart, *Sphere Tracing*, The Visual Computer 1996). It
starts outside of the solid or inside of it: what is found is the first surface, from either side. Between the last
place with the sign of the start and the first one with the other, the root is bracketed by false position, by bisection
if that does not get on.

Nothing here is differentiated: a hit is attached to the field's entries by the implicit function (:func:`attached`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ...rays import box_interval
from . import marching

#: The shortest step, in units of the longest side: a solid that a ray crosses in less may be missed.
EPSILON = 1e-4

#: How far along the ray a hit may be off, at most, and the value at which a place counts as on the surface.
TOLERANCE, ZERO = 1e-5, 1e-6

#: How many of the field's cells a ray may go beyond what the field vouches for, where the surface is expected.
RELAXATION = 1.0

#: Steps by false position before bisection takes over.
FALSE_POSITIONS = 5


@dataclass
class Hit:
    """
    What a ray met: ``found``; the distance ``t`` along the ray, infinite if nothing was found; the place ``p``, which
    is more precise than ``o + t·d`` where the ray comes from afar; ``leaving``, whether it came from within the solid.
    """

    found: Any
    t: Any
    p: Any
    leaving: Any


def enter(field, o, d, maxt, active=True):
    """
    Where a ray is in the field's box: ``(near, far, active)``, the distances at which it enters (0 if it starts there)
    and leaves it. Components of ``d`` may be zero. Not active: it misses the box, or something is NaN.
    """
    Float = field.types.Float
    active = field.types.Bool(active)
    near, far, active = box_interval(o, d, field.lower, field.upper, Float(0), Float(maxt), active)
    active &= near <= far  # false for NaN
    return near, far, active


def intersect(field, o, d, maxt, active=True, exact: bool = True) -> Hit:
    """
    The first place where rays ``o + t·d``, 0 ≤ t ≤ ``maxt``, ``d`` of length 1, change from outside to inside of the
    solid or the other way. If not ``exact``, only ``found`` and ``leaving`` mean anything, which is faster.

    A ray that starts in the box starts where the field says; one that does not is outside of the solid.
    """
    Float, Point = field.types.Float, field.types.Array3f
    with dr.suspend_grad():
        o, d, maxt = Point(dr.detach(o)), Point(dr.detach(d)), Float(dr.detach(maxt))
        near, far, active = enter(field, o, d, maxt, active)
        # From here on, numbers are small. Rounding must not leave a ray outside, where the field says nothing
        start = Point(dr.clip(dr.fma(d, near, o), Point(*field.lower), Point(*field.upper)))
        length = far - near
        if field.marched:
            found, t, leaving = march(field, start, d, length, near == 0, active)
        else:
            found, t, leaving = spheres(field, start, d, length, near == 0, active, exact)
        # What is solid up to the side of the box ends there
        cut = active & (far < maxt) & leaving & ~found
        t = dr.select(cut, length, t)
        found |= cut
        return Hit(found, dr.select(found, near + t, dr.inf), dr.fma(d, t, start), leaving)


def march(field, start, d, length, fresh, active):
    """As :func:`spheres`, of a sparse grid: from cell to cell (:mod:`.marching`)."""
    marcher = marching.of(field)
    o = [(x - a) / field.spacing for x, a in zip(start, field.lower, strict=True)]
    found, t, leaving = marching.march(marcher, o, d, length / field.spacing, fresh, active)
    return found, t * field.spacing, leaving


@dr.syntax
def spheres(field, start, d, length, fresh, active, exact: bool = True, epsilon: float = EPSILON):
    """
    The first change of sign along rays from ``start``, a place in the box, up to ``length``: ``(found, t, leaving)``.
    Rays that are ``fresh`` start with the sign that they find, others outside.
    """
    types = field.types
    Float, Bool = types.Float, types.Bool
    with dr.suspend_grad():
        active, found = Bool(active), Bool(False)
        leaving = Bool(fresh) & (field.value(start, active) < 0)

        reach = RELAXATION * field.spacing
        t, safe = Float(0), Float(0)
        low, high = Float(0), Float(dr.inf)  # the last place known to be as at the start, the first one that is not
        low_value, high_value = Float(0), Float(0)
        turns = types.UInt32(0)
        while dr.hint(active, label="sphere tracing"):
            value, step = field.look(dr.fma(d, t, start), d, active)
            other = (value < 0) != leaving
            size = dr.abs(value)
            # Too far ahead: between what both places vouch for, the sign may have changed twice
            back = ~other & ~found & (t - dr.minimum(step, size / field.bound) > safe)
            found |= other
            # Where the value will be zero if it goes on as it did
            ahead = dr.select(back | found, 0, size * (t - low) / (dr.abs(low_value) - size))
            ahead = dr.select(ahead > 0, dr.minimum(dr.fma(ahead, 1.05, 0.1 * epsilon), reach), 0)
            high = dr.select(other, t, high)
            high_value = dr.select(other, value, high_value)
            low = dr.select(other | back, low, t)
            low_value = dr.select(other | back, low_value, value)
            safe = dr.select(back | other, safe, t + dr.maximum(step, epsilon))
            if dr.hint(exact, mode="scalar"):
                width = high - low
                done = found & ((width < TOLERANCE) | ((size < ZERO) & (turns > 0)))
                share = dr.clip(low_value / (low_value - high_value), 0.03, 0.97)
                share = dr.select(turns < FALSE_POSITIONS, share, 0.5)
                turns = dr.select(found, turns + 1, 0)
                following = dr.select(
                    found, dr.fma(width, share, low), dr.select(back, safe, dr.maximum(safe, t + ahead))
                )
                t = dr.select(done, t, following)
                active &= ~done & (found | (t <= length))
            else:
                t = dr.select(back, safe, dr.maximum(safe, t + ahead))
                active &= ~found & (t <= length)
        return found, t, leaving


def trace(field, o, d, maxt, active=True) -> tuple:
    """The distances at which rays first meet the surface from either side, infinite if not, and whether they do."""
    hit = intersect(field, o, d, maxt, active)
    return hit.t, hit.found


def occluded(field, o, d, maxt, active=True):
    """Whether rays meet the surface before ``maxt``."""
    return intersect(field, o, d, maxt, active, exact=False).found


def index_of(field) -> int:
    """Bytes of what tracing makes of a field, once."""
    return marching.of(field).nbytes if field.marched else 0
