"""Intersection of rays with an axis-aligned box (the slab method of Kay and Kajiya 1986)."""

from dataclasses import dataclass

import drjit as dr

#: Magnitude below which a component of a direction counts as zero: its reciprocal fits single precision.
PARALLEL = 1e-30


def is_direction(d):
    """Return whether a Dr.Jit vector has a length between ½ and 2; false for NaN.

    Along any other vector, the steps of a ray may be too short to end.
    """
    squared = dr.squared_norm(d)
    return (squared > 0.25) & (squared < 4)


def box_interval(o, d, lower, upper, near, far, active) -> tuple:
    """Cut the parts ``near`` ≤ t ≤ ``far`` of rays ``o + t·d`` down to those in the box: ``(near, far, active)``.

    ``o``, ``d`` are Dr.Jit points and vectors; ``lower``, ``upper`` the corners, three numbers each; ``near``, ``far``
    and ``active`` Dr.Jit arrays. A component of ``d`` may be zero, also along a face of the box: such a ray is active
    if it lies between the two planes. The caller drops empty parts (``near`` > ``far``) and NaN by a comparison.
    """
    for x, v, low, high in zip(o, d, lower, upper, strict=True):
        parallel = dr.abs(v) < PARALLEL  # 0 · inf along a face would be NaN
        inverse = dr.rcp(dr.select(parallel, 1, v))
        first, second = (low - x) * inverse, (high - x) * inverse
        active &= ~parallel | ((x >= low) & (x <= high))
        near = dr.select(parallel, near, dr.maximum(near, dr.minimum(first, second)))
        far = dr.select(parallel, far, dr.minimum(far, dr.maximum(first, second)))
    return near, far, active


@dataclass(frozen=True)
class ValueBounds:
    """Bounds of a parameter: its values lie in ``[low, high]``.

    ``optimised``: a derivative with respect to it is tracked, and it may take any value. ``grey``: its channels are
    equal, if it is a colour.
    """

    low: float = 0.0
    high: float = 1.0
    optimised: bool = False
    grey: bool = False

    def is_always(self, value: float) -> bool:
        """Return whether the parameter is this constant and stays so."""
        return self.low == self.high == value and not self.optimised
