"""Ray intersection with the surface of a distance field (:class:`.field.DistanceField`), in the unit frame.

A ray enters the field's box and advances as long as its sign equals that at the start. The first change of sign, from
outside or from inside of the solid, is the hit. Sparse fields are marched from cell to cell (:mod:`.marching`); others
are sphere-traced (John C. Hart, *Sphere Tracing*, The Visual Computer 1996) with steps of at least :data:`EPSILON`, and
the root between the last place before the change and the first one after it is bracketed by false position, then by
bisection.

Nothing here is differentiated: a hit is attached to the field's entries by the implicit function theorem in the plugin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from ...arrays.boxes import box_interval, is_direction
from ...core import compat
from . import marching

#: Shortest step, relative to the longest side; a ray may miss a solid that it crosses in less.
EPSILON = 1e-4

#: Largest error of a hit along the ray, and the value at which a place counts as on the surface.
TOLERANCE, ZERO = 1e-5, 1e-6

#: Distance, in cells, by which a ray may exceed the safe step where the surface is expected.
RELAXATION = 1.0

#: Steps by false position before bisection takes over.
FALSE_POSITIONS = 5


@dataclass
class Hit:
    """Intersection of rays with a surface.

    ``hit``: whether the surface was hit; ``t``: the distance along the ray, infinite without a hit; ``p``: the place,
    more precise than ``o + t·d`` for a ray from afar; ``leaving``: whether the ray came from within the solid.
    """

    hit: Any
    t: Any
    p: Any
    leaving: Any


def enter(field, o, d, maxt, active=True):
    """Return the distances at which rays enter and leave the field's box: ``(near, far, active)``.

    A ray that starts in the box enters at 0. Components of ``d`` may be zero. A ray is not active if it misses the
    box, if it has no direction (:func:`.rays.is_direction`), or if anything is NaN.
    """
    Float = field.types.Float
    active = field.types.Bool(active) & is_direction(d)
    near, far, active = box_interval(o, d, *field.box, Float(0), Float(maxt), active)
    active &= (near <= far) & (far < dr.inf)  # false for NaN
    return near, far, active


def intersect(field, o, d, maxt, active=True, exact: bool = True) -> Hit:
    """Intersect rays ``o + t·d``, 0 ≤ t ≤ ``maxt``, ``d`` of length 1, with the surface, from either side.

    A ray that starts in the box starts with the field's sign, any other one outside of the solid. A direction shorter
    than ½ or longer than 2 hits nothing. If not ``exact``, only ``hit`` and ``leaving`` are valid, which is faster.
    """
    Float, Point = field.types.Float, field.types.Array3f
    with dr.suspend_grad():
        o, d, maxt = Point(dr.detach(o)), Point(dr.detach(d)), Float(dr.detach(maxt))
        near, far, active = enter(field, o, d, maxt, active)
        # From here on, numbers are small. Rounding must not leave a ray outside of the box
        start = Point(dr.clip(dr.fma(d, near, o), *field.box))
        # The difference of two large distances may be longer than the box: steps beyond it might never end
        _, length, _ = box_interval(start, d, *field.box, Float(0), far - near, active)
        if field.marched:
            scale = field.cells_per_unit
            origin = [(x - a) * scale for x, a in zip(start, field.box[0], strict=True)]
            hit, t, leaving = marching.march(marching.marcher_of(field), origin, d, length * scale, near == 0, active)
            t = t * field.cell
        else:
            hit, t, leaving = sphere_trace(field, start, d, length, near == 0, active, exact)
        # A solid that reaches the side of the box ends there
        cut = active & (far < maxt) & leaving & ~hit
        t = dr.select(cut, length, t)
        hit |= cut
        return Hit(hit, dr.select(hit, near + t, dr.inf), dr.fma(d, t, start), leaving)


@compat.syntax
def sphere_trace(field, start, d, length, fresh, active, exact: bool = True):
    """Find the first change of sign along rays from ``start``, a place in the box, up to ``length``.

    Returns ``(hit, t, leaving)``. A ``fresh`` ray starts with the sign at ``start``, any other one outside.
    """
    types = field.types
    Float, Bool = types.Float, types.Bool
    with dr.suspend_grad():
        active, hit = Bool(active), Bool(False)
        leaving = Bool(fresh) & (field.value(start, active) < 0)

        reach = RELAXATION * field.cell
        t, safe = Float(0), Float(0)
        low, high = Float(0), Float(dr.inf)  # the last place with the sign at the start, the first one with the other
        low_value, high_value = Float(0), Float(0)
        turns = types.UInt32(0)
        while dr.hint(active, label="sphere tracing"):
            value, step = field.safe_step(dr.fma(d, t, start), d, active)
            other = (value < 0) != leaving
            size = dr.abs(value)
            # Too far ahead: between the safe steps of both places, the sign may have changed twice
            back = ~other & ~hit & (t - dr.minimum(step, size / field.bound) > safe)
            hit |= other
            # Linear extrapolation to the zero
            ahead = dr.select(back | hit, 0, size * (t - low) / (dr.abs(low_value) - size))
            ahead = dr.select(ahead > 0, dr.minimum(dr.fma(ahead, 1.05, 0.1 * EPSILON), reach), 0)
            high = dr.select(other, t, high)
            high_value = dr.select(other, value, high_value)
            low = dr.select(other | back, low, t)
            low_value = dr.select(other | back, low_value, value)
            safe = dr.select(back | other, safe, t + dr.maximum(step, EPSILON))
            if dr.hint(exact, mode="scalar"):
                width = high - low
                done = hit & ((width < TOLERANCE) | ((size < ZERO) & (turns > 0)))
                share = dr.clip(low_value / (low_value - high_value), 0.03, 0.97)
                share = dr.select(turns < FALSE_POSITIONS, share, 0.5)
                turns = dr.select(hit, turns + 1, 0)
                following = dr.select(
                    hit, dr.fma(width, share, low), dr.select(back, safe, dr.maximum(safe, t + ahead))
                )
                t = dr.select(done, t, following)
                active &= ~done & (hit | (t <= length))
            else:
                t = dr.select(back, safe, dr.maximum(safe, t + ahead))
                active &= ~hit & (t <= length)
        return hit, t, leaving


def trace(field, o, d, maxt, active=True) -> tuple:
    """Return the distances at which rays hit the surface, infinite without a hit, and whether they do."""
    result = intersect(field, o, d, maxt, active)
    return result.t, result.hit


def occluded(field, o, d, maxt, active=True):
    """Return whether rays hit the surface before ``maxt``."""
    return intersect(field, o, d, maxt, active, exact=False).hit


def index_bytes(field) -> int:
    """Return the bytes of the field's ray-marching index; 0 if it is sphere-traced."""
    return marching.marcher_of(field).nbytes if field.marched else 0
