"""Classical filters of normal maps that shading-aware textures are compared with.

Each takes the maps of a material at every level of detail, uncompressed. A reader is a function
``(u, v, level, wi, wo) → Array3f`` of shaded values, as in :mod:`mi_diffind.tasks.texture.appearance`, whose ``reader``
shades a pyramid of filtered parameters, with normals brought to length 1.

- :func:`toksvig_levels`: roughness increased by the length of the mean normal (Toksvig, *Mipmapping Normal Maps*,
  2005);
- :func:`lean`: first and second moments of slopes, filtered linearly, make an anisotropic lobe (Olano and Baker, *LEAN
  Mapping*, 2010), a GGX one in place of their Beckmann's (Dupuy et al., *Linear Efficient Antialiased Displacement and
  Reflectance Mapping*, 2013);
- :func:`bake`: each texel of each level has the roughness with which it looks most like the converged truth;
- :func:`biased`: any of these at other levels of detail; its gain is due to the filter's kernel, not to shading.

A roughness by level becomes part of a pyramid by :func:`with_roughness`. The variance of slopes of a GGX lobe is
infinite; in its place stands that of the Beckmann lobe of the same α, which is α²/2 along each axis.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import drjit as dr
import numpy as np

from ...arrays.indirection import aligned_copy
from ...arrays.lookup import clamp
from ...maps.layout import Layout, MapLayout
from ...maps.pyramid import Pyramid, halve
from ...tasks.disney.decoder import Decoder, Lobe
from ...tasks.disney.model import ALPHA_MIN, Effects
from ...tasks.disney.training import uniform_hemisphere
from ...tasks.texture.appearance import ShadedEvaluation, ShadedReader, reference
from ...tasks.texture.surface import DEFAULTS, frame, maps_of, shaded, surface_of

#: Least third component in the slope of a normal: a slope of 10.
STEEPEST = 0.1

#: Biases of the level of detail that :func:`choose_biases` tries.
BIASES = tuple(float(bias) for bias in np.arange(-8, 5) / 8)

#: Shares of the way from a texel's filtered roughness (0) to 1 that :func:`bake` tries; a parabola through the errors
#: of three of them refines the best one.
TRIED = np.linspace(0, 1, 28)

#: Pairs of a view and a light that :func:`bake` averages over.
PAIRS = 32

#: Seed of pairs; trainings and evaluations use others.
SEED = 20050711

#: Places along each side of a texel at which moments are averaged.
INSIDE = 4

#: Lanes of one evaluation in :func:`bake`.
CHUNK = 2**22


def surface_moments(pyramid: Pyramid) -> list[np.ndarray]:
    """Return the moments of the unfiltered surface, ``(height, width, 9)`` for each level.

    They are the means of slopes (x/z, y/z), of their products (xx, yy, xy)/z², of α², and of the unit normal, over the
    texels of level 0 that a texel covers, each read with interpolation at :data:`INSIDE` × :data:`INSIDE` places.
    """
    types, (rows, columns, _) = pyramid.types, pyramid.values[0].shape
    Float, index, total = types.Float, dr.arange(types.UInt32, rows * columns), 0.0
    x, y = Float(index % columns), Float(index // columns)
    places = [dr.opaque(Float, (i + 0.5) / INSIDE) for i in range(INSIDE)]
    for dx, dy in itertools.product(places, places):
        surface = surface_of(pyramid, pyramid.stored((x + dx) / columns, (y + dy) / rows))
        n = types.Array3f(0, 0, 1) if surface.normal is None else surface.normal
        n = dr.select(dr.squared_norm(n) > 1e-12, dr.normalize(n), types.Array3f(0, 0, 1))
        bx, by = (c / dr.maximum(n.z, STEEPEST) for c in (n.x, n.y))
        alpha = dr.maximum(dr.square(Float(surface.roughness)), ALPHA_MIN)
        moments = [bx, by, bx * bx, by * by, bx * by, dr.square(alpha), *n]
        moments = [m + dr.zeros(Float, rows * columns) for m in moments]  # constants, too, have a value for each texel
        dr.eval(moments)
        total = total + np.stack([m.numpy().astype(np.float64) for m in moments], axis=-1)
    levels = [(total / INSIDE**2).reshape(rows, columns, -1)]
    for _ in pyramid.values[1:]:
        levels.append(halve(levels[-1]))
    return levels


def toksvig_alpha2(alpha2, length):
    """Return α² of a GGX lobe whose normals have a mean of ``length`` (0, 1].

    Toksvig scales the exponent s of a Blinn–Phong lobe: s' = s r / (r + s (1 − r)). The exponent of a lobe with
    roughness α is s = 2/α² − 2 (Walter et al. 2007), so α'² = 2/(s' + 2).
    """
    exponent = 2 / alpha2 - 2
    scaled = exponent * length / (length + exponent * (1 - length))
    return 2 / (scaled + 2)


def toksvig_levels(pyramid: Pyramid) -> list[np.ndarray]:
    """Return the roughness of each level, ``(height, width)``, with :func:`toksvig_alpha2` of the mean normals."""
    lengths = [np.clip(np.linalg.norm(m[..., 6:], axis=-1), 1e-3, 1) for m in surface_moments(pyramid)]
    alpha2s = [np.maximum(r.astype(np.float64) ** 2, ALPHA_MIN) ** 2 for r in roughness_levels(pyramid)]
    return [toksvig_alpha2(a, r) ** 0.25 for a, r in zip(alpha2s, lengths, strict=True)]


def lean(pyramid: Pyramid, effects: Effects) -> ShadedReader:
    """Return the reader of an anisotropic lobe around the normal of the mean slope (:func:`lobe`).

    All other lobes are those of filtered parameters, times the length of the mean normal: a cosine is linear in the
    normal, and so is its mean (worth 0.8 dB on bricks and cloth).
    """
    levels = surface_moments(pyramid)
    height, width, count = levels[0].shape
    maps = (MapLayout("moments", "other", "linear", 1, tuple(range(count))),)
    layout = Layout(width, height, maps, (0.5,) * count, ("moments",) * count)
    moments = Pyramid(layout, levels, pyramid.types, pyramid.border)
    specular = replace(effects, diffuse=False, subsurface=False, sheen=False, clearcoat=False)

    def read(u, v, level, wi, wo):
        surface = surface_of(pyramid, pyramid.filtered(u, v, level))
        bx, by, xx, yy, xy, a2, *mean = moments.filtered(u, v, level)
        covariance = (dr.maximum(xx - bx * bx, 0), dr.maximum(yy - by * by, 0), xy - bx * by)
        normal = pyramid.types.Array3f(bx, by, 1)
        roughness, shape = lobe(covariance, a2, *frame(normal, wi))
        highlight = replace(surface, normal=normal, roughness=roughness, lobe=shape)
        value = shaded(Decoder(), highlight, wi, wo, specular)
        if effects.lobes == specular.lobes:
            return value
        rest = replace(surface, lobe=Lobe(*[type(u)(0)] * 3))  # without a specular lobe
        return value + dr.norm(pyramid.types.Array3f(mean)) * shaded(Decoder(), rest, wi, wo, effects)

    return read


def lobe(covariance, alpha2, s, t, n) -> tuple:
    """Return roughness and shape of a lobe about a normal ``n`` with tangents ``s``, ``t``.

    ``covariance`` is that of the slopes in the surface's tangent plane, ``(xx, yy, xy)``, ``alpha2`` the α² of facets
    on them. In the frame of a tilted normal n, slopes are, to first order, n_z times their projections onto the frame's
    tangents. GGX's matrix A (:class:`~mi_diffind.tasks.disney.decoder.Lobe`) is α² plus twice their covariance.
    """
    xx, yy, xy = covariance

    def projected(a, b):
        return dr.square(n.z) * (xx * a.x * b.x + yy * a.y * b.y + xy * (a.x * b.y + a.y * b.x))

    p, q, r = projected(s, s) + 0.5 * alpha2, projected(t, t) + 0.5 * alpha2, projected(s, t)
    scale = dr.rcp(p + q)
    return dr.sqrt(dr.sqrt(p + q)), Lobe((p - q) * scale, 2 * r * scale, type(p)(1))


def directions(types, count: int = PAIRS, seed: int = SEED) -> list[tuple]:
    """Return pairs of a view and a light, uniform over the hemisphere, each with stratified cosines."""
    rng = np.random.default_rng(seed)
    numbers = rng.random((4, count))
    for row in (0, 2):
        numbers[row] = (rng.permutation(count) + numbers[row]) / count
    columns = [[dr.opaque(types.Float, float(x)) for x in column] for column in numbers.T]
    return [(uniform_hemisphere(types, a, b), uniform_hemisphere(types, c, d)) for a, b, c, d in columns]


def bake(pyramid: Pyramid, effects: Effects, pairs: int = PAIRS) -> list[np.ndarray]:
    """Return the roughness, ``(height, width)`` for each level, that minimises the error against the converged truth.

    The error is that of filtered parameters at a texel's centre: the squared error of values clipped to [0, 1], over
    ``pairs`` of a view and a light. The roughness is never below the filtered one (where light is lost, least squares
    would have no highlight at all), and equal to it on level 0.
    """
    types, filtered_levels = pyramid.types, roughness_levels(pyramid)
    baked_levels = [np.array(filtered_levels[0])]
    Float, UInt32 = types.Float, types.UInt32
    view_lights, tried = directions(types, pairs), len(TRIED)
    shares = Float(aligned_copy(TRIED, np.float32))
    for level, texels in enumerate(pyramid.values[1:], 1):
        rows, columns, _ = texels.shape
        side = _side(level)
        step = max(1, CHUNK // max(side * side, tried))
        errors = []
        for start in range(0, rows * columns, step):
            count = min(step, rows * columns - start)
            index = dr.arange(UInt32, count) + dr.opaque(UInt32, start)
            n, m = dr.opaque(UInt32, columns), dr.opaque(UInt32, rows)
            place = (Float(index % n) + 0.5) / Float(n), (Float(index // n) + 0.5) / Float(m)
            place = (*place, dr.opaque(Float, level, count))
            lane, n = dr.arange(UInt32, count * tried), dr.opaque(UInt32, tried)
            texel, trial = lane // n, lane % n
            surface = surface_of(pyramid, pyramid.filtered(*(dr.gather(Float, x, texel) for x in place)))
            roughness = dr.lerp(Float(surface.roughness), 1, dr.gather(Float, shares, trial))
            surface = replace(surface, roughness=roughness)
            dr.eval(surface.albedo, surface.normal, surface.roughness, surface.metallic)
            total = dr.zeros(Float, count * tried)
            for wi, wo in view_lights:
                truth = reference("converged", pyramid, *place, *_wide(count, wi, wo), effects, side=side)
                truth = dr.gather(types.Array3f, dr.clip(truth, 0, 1), texel)
                value = dr.clip(shaded(None, surface, *_wide(count * tried, wi, wo), effects), 0, 1)
                total += dr.squared_norm(value - truth)
                dr.eval(total)
            errors.append(total.numpy().reshape(count, tried))
        share = _refined_minimum(np.concatenate(errors)).reshape(rows, columns)
        base = filtered_levels[level]
        baked_levels.append((base + share * (1 - base)).astype(np.float32))
    return baked_levels


def _side(level: int) -> int:
    """Return the samples along the side of a footprint: at least two for each texel.

    With one, all samples might lie at centres of texels, or all at corners, where normals vary less.
    """
    return min(max(8, 2 << level), 128)


def _wide(count: int, *directions) -> list:
    """Return directions repeated for ``count`` lanes."""
    return [dr.gather(type(w), w, dr.zeros(dr.uint32_array_t(type(w.x)), count)) for w in directions]


def _refined_minimum(errors: np.ndarray) -> np.ndarray:
    """Return the minimum of a parabola around the best of :data:`TRIED` (equidistant), for each row of errors."""
    best = errors.argmin(axis=1)
    middle, lane = np.clip(best, 1, len(TRIED) - 2), np.arange(len(errors))
    before, at, after = (errors[lane, middle + i].astype(np.float64) for i in (-1, 0, 1))
    bend = before - 2 * at + after
    shift = np.where((bend > 1e-12) & (best == middle), 0.5 * (before - after) / np.maximum(bend, 1e-12), best - middle)
    return TRIED[middle] + shift * (TRIED[1] - TRIED[0])


def roughness_levels(pyramid: Pyramid) -> list[np.ndarray]:
    """Return the roughness of each level of a pyramid, ``(height, width)``."""
    m = maps_of(pyramid.layout).get("roughness")
    if m is None:
        return [np.full(values.shape[:2], DEFAULTS["roughness"], np.float32) for values in pyramid.values]
    return [pyramid.decode([m.name], level=level)[m.name][..., 0] for level in range(pyramid.levels)]


def with_roughness(pyramid: Pyramid, levels: Sequence[np.ndarray]) -> Pyramid:
    """Return a pyramid with another roughness, ``(height, width)`` for each level, in a stored channel of its own.

    The pyramid is meant to be compressed in place of the source's.
    """
    layout = pyramid.layout
    old = maps_of(layout).get("roughness")
    where = layout.stored
    if old is not None and isinstance(old.where[0], int) and sum(old.where[0] in m.where for m in layout.maps) == 1:
        where = old.where[0]
    name = old.name if old is not None else "roughness"
    new = MapLayout(name, "roughness", "linear", 1, (where,))
    maps = tuple(new if m is old else m for m in layout.maps) + ((new,) if old is None else ())
    initial, groups = layout.initial, layout.groups
    if where == layout.stored:
        initial, groups = (*initial, 0.5), (*groups, name)
    values = []
    for level, roughness in zip(pyramid.values, levels, strict=True):
        value = np.clip(roughness, 0, 1)[..., None].astype(np.float32)
        values.append(np.concatenate([level[..., :where], value, level[..., where + 1 :]], axis=-1))
    changed = Layout(layout.width, layout.height, maps, initial, groups)
    return Pyramid(changed, values, pyramid.types, pyramid.border)


def biased(read: ShadedReader, biases: Sequence[float]) -> ShadedReader:
    """Return ``read`` with ``biases`` added to the level of detail, one for each whole level, interpolated between."""

    def at(u, v, level, wi, wo):
        Float = type(u)
        table = Float(aligned_copy(np.append(biases, biases[-1]), np.float32))
        position = clamp(level, 0.0, float(len(biases) - 1))
        lower = dr.uint32_array_t(Float)(position)
        a, b = dr.gather(Float, table, lower), dr.gather(Float, table, lower + 1)
        return read(u, v, dr.maximum(level + dr.lerp(a, b, position - Float(lower)), 0), wi, wo)

    return at


def choose_biases(read: ShadedReader, evaluation: ShadedEvaluation) -> list[float]:
    """Return, for each level, the one of :data:`BIASES` with which ``read`` is nearest to the converged truth."""
    psnr = [evaluation.measure(biased(read, [bias]), False)["C"]["psnr_db"] for bias in BIASES]
    return [BIASES[i] for i in np.argmax(psnr, axis=0)]
