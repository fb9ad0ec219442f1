"""
What a material looks like from afar: appearance that is filtered, not parameters (supplemental 1.5).

The footprint of a level of detail L is a square of 2^L × 2^L texels, along the axes. It is shaded at places of it by
the analytic model, and what comes out is averaged. Three kinds of references differ in the places:

- ``"converged"``: 256 in a stratified pattern, where the maps are read without filtering;
- ``"prefiltered"``: the paper's 16, each read in the mip pyramid two levels finer than L, which averages normals before
  they are shaded: mostly a filter of parameters;
- ``"jittered"``: 16 random ones, one in each of 4 × 4 strata, read without filtering: noisy, yet right on average.
"""

from __future__ import annotations

import math

import drjit as dr

from ...maps.pyramid import Pyramid
from ..disney.decoder import Decoder
from ..disney.effects import Effects
from .material import shaded, surface_of

#: Kind → samples along each side of the footprint.
KINDS = {"converged": 16, "prefiltered": 4, "jittered": 4}

#: Levels finer than the footprint that each sample of the paper's is read at: 4 × 4 samples cover it.
FINER = 2

#: Samples that are shaded at a time.
CHUNK = 2**22


def reference(kind: str, pyramid: Pyramid, u, v, level, wi, wo, effects: Effects, rng=None, side: int = 0):
    """
    The shaded value (:func:`.material.shaded`) of the footprints of level of detail ``level``, a real number, around
    (u, v), each seen along ``wi`` and lit along ``wo``: an ``Array3f`` without derivatives. ``rng`` jitters
    (``"jittered"`` needs one, others take the centres of strata without); ``side`` replaces the number of samples along
    a side.
    """
    if kind not in KINDS:
        raise ValueError(f'reference: found "{kind}", allowed are {", ".join(KINDS)}')
    if kind == "jittered" and rng is None:
        raise ValueError('reference: "jittered" needs random numbers')
    side, size = side or KINDS[kind], dr.width(u)
    with dr.suspend_grad():
        if size * side * side <= CHUNK:
            return _averaged(kind, pyramid, u, v, level, wi, wo, effects, rng, side)
        types, step = pyramid.types, max(1, CHUNK // (side * side))
        total = dr.zeros(types.Array3f, size)
        for start in range(0, size, step):
            index = dr.opaque(types.UInt32, start) + dr.arange(types.UInt32, min(step, size - start))
            parts = [dr.gather(type(x), x, index) for x in (u, v, level, wi, wo)]
            found = _averaged(kind, pyramid, *parts, effects, rng, side)
            dr.scatter(total, found, index)
            dr.eval(total)
        return total


def _averaged(kind, pyramid: Pyramid, u, v, level, wi, wo, effects: Effects, rng, side: int):
    types, layout, samples = pyramid.types, pyramid.layout, side * side
    Float, UInt32, size = types.Float, types.UInt32, dr.width(u)
    lane = dr.arange(UInt32, size * samples)
    # Power of two: shifts and masks in place of divisions
    shift, mask = round(math.log2(side)), side - 1
    if side != 1 << shift:
        raise ValueError(f"samples along a side: found {side}, allowed are powers of two")
    place, own = lane >> (2 * shift), lane & (samples - 1)
    x, y = Float(own & mask), Float(own >> shift)
    x, y = (x + (0.5 if rng is None else rng.random(Float, size * samples)) for x in (x, y))
    u, v, level, wi, wo = (dr.gather(type(a), a, place) for a in (u, v, level, wi, wo))
    extent = dr.exp2(level)
    u = dr.fma((x / side - 0.5) * extent, 1 / layout.width, u)
    v = dr.fma((y / side - 0.5) * extent, 1 / layout.height, v)
    u, v = (_inside(x, border) for x, border in zip((u, v), reversed(pyramid.border), strict=True))
    finer = dr.maximum(level - FINER, 0)
    stored = pyramid.filtered(u, v, finer) if kind == "prefiltered" else pyramid.stored(u, v)
    value = shaded(Decoder(), surface_of(pyramid, stored), wi, wo, effects)
    dr.eval(value)  # all three at once: a sum over blocks evaluates what it is given
    return types.Array3f([dr.block_sum(c, samples) / samples for c in value])


def _inside(x, border: str):
    """A coordinate in [0, 1]: footprints reach over the edge of a texture that ends there, where nothing is new."""
    return x - dr.floor(x) if border == "repeat" else dr.clip(x, 0, 1)
