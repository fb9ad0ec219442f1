"""Reference appearance of a material from afar: shaded first, filtered afterwards (supplemental 1.5).

The footprint of a level of detail L is a square of 2^L × 2^L texels, along the axes. The analytic model shades samples
of the footprint, and their mean is the reference. Three patterns of samples:

- ``"converged"``: 256 stratified samples of unfiltered maps;
- ``"prefiltered"``: the paper's 16, each read in the mip pyramid two levels finer than L, which averages normals before
  they are shaded: mostly a filter of parameters;
- ``"jittered"``: 16 random samples of unfiltered maps, one in each of 4 × 4 strata: noisy, yet right on average.
"""

from __future__ import annotations

import math

import drjit as dr

from ...maps.pyramid import Pyramid
from ..disney.decoder import Decoder
from ..disney.model import Effects
from .material import shaded, surface_of

#: Number of samples along each side of the footprint, by pattern.
SAMPLES_PER_SIDE = {"converged": 16, "prefiltered": 4, "jittered": 4}

#: Level of the paper's samples relative to the footprint: so much finer, so that 4 × 4 samples cover it.
FINER = 2

#: Number of samples that are shaded at a time.
CHUNK = 2**22


def reference(pattern: str, pyramid: Pyramid, u, v, level, wi, wo, effects: Effects, rng=None, side: int = 0):
    """Return the shaded value (:func:`.material.shaded`) of footprints around (u, v), ``Array3f``, without derivatives.

    ``level`` is the level of detail, a real number; each footprint is seen along ``wi`` and lit along ``wo``. ``rng``
    jitters the samples (``"jittered"`` needs one; without, samples are the centres of strata); ``side`` replaces the
    number of samples along a side.
    """
    if pattern not in SAMPLES_PER_SIDE:
        raise ValueError(f'reference: found "{pattern}", allowed are {", ".join(SAMPLES_PER_SIDE)}')
    if pattern == "jittered" and rng is None:
        raise ValueError('reference: "jittered" needs random numbers')
    side, size = side or SAMPLES_PER_SIDE[pattern], dr.width(u)
    with dr.suspend_grad():
        if size * side * side <= CHUNK:
            return _averaged(pattern, pyramid, u, v, level, wi, wo, effects, rng, side)
        types, step = pyramid.types, max(1, CHUNK // (side * side))
        total = dr.zeros(types.Array3f, size)
        for start in range(0, size, step):
            index = dr.opaque(types.UInt32, start) + dr.arange(types.UInt32, min(step, size - start))
            parts = [dr.gather(type(x), x, index) for x in (u, v, level, wi, wo)]
            means = _averaged(pattern, pyramid, *parts, effects, rng, side)
            dr.scatter(total, means, index)
            dr.eval(total)
        return total


def _averaged(pattern, pyramid: Pyramid, u, v, level, wi, wo, effects: Effects, rng, side: int):
    types, layout, samples = pyramid.types, pyramid.layout, side * side
    Float, UInt32, size = types.Float, types.UInt32, dr.width(u)
    lane = dr.arange(UInt32, size * samples)
    # Power of two: shifts and masks in place of divisions. Opaque, so that one kernel serves all numbers of samples
    shift = round(math.log2(side))
    if side != 1 << shift:
        raise ValueError(f"samples along a side: found {side}, allowed are powers of two")
    shift, mask, count, width = (dr.opaque(UInt32, n) for n in (shift, side - 1, samples - 1, side))
    place, sample, width = lane >> (2 * shift), lane & count, Float(width)
    x, y = Float(sample & mask), Float(sample >> shift)
    x, y = (x + (0.5 if rng is None else rng.random(Float, size * samples)) for x in (x, y))
    u, v, level, wi, wo = (dr.gather(type(a), a, place) for a in (u, v, level, wi, wo))
    extent = dr.exp2(level)
    u = dr.fma((x / width - 0.5) * extent, 1 / layout.width, u)
    v = dr.fma((y / width - 0.5) * extent, 1 / layout.height, v)
    u, v = (_inside(x, border) for x, border in zip((u, v), reversed(pyramid.border), strict=True))
    finer = dr.maximum(level - FINER, 0)
    stored = pyramid.filtered(u, v, finer) if pattern == "prefiltered" else pyramid.stored(u, v)
    value = shaded(Decoder(), surface_of(pyramid, stored), wi, wo, effects)
    dr.eval(value)  # all three at once: a sum over blocks evaluates what it is given
    return types.Array3f([dr.block_sum(c, samples) / samples for c in value])


def _inside(x, border: str):
    """Return a coordinate in [0, 1]: wrapped in a repeating texture, else clamped to the edge."""
    return x - dr.floor(x) if border == "repeat" else dr.clip(x, 0, 1)
