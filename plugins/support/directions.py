"""Directions that BSDFs are asked for."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


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
