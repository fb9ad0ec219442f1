"""Directions that BSDFs are asked for."""

from __future__ import annotations

import drjit as dr


def are_directions(wi, wo):
    """Return the lanes in which both vectors are about as long as directions, 1: not NaN, infinite, zero or tiny.

    Masked lanes hold such vectors. They have to be replaced before anything is computed: a derivative of 0, multiplied
    by an infinite one, is NaN.
    """
    return dr.abs(dr.squared_norm(wi) + dr.squared_norm(wo) - 2) < 0.5
