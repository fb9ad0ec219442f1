"""Classical filters of normal maps that shading-aware textures are compared with.

Each filter is a pyramid of maps, which a texture can store in any form, and which :func:`.evaluation.reader` shades as
it shades filtered parameters.

- :func:`toksvig_levels`: roughness increased by the length of the mean normal (Toksvig, *Mipmapping Normal Maps*,
  2005);
- :func:`lean_pyramid`: first and second moments of slopes, filtered linearly, make an anisotropic lobe (Olano and
  Baker, *LEAN Mapping*, 2010), a GGX one in place of their Beckmann's (Dupuy et al., *Linear Efficient Antialiased
  Displacement and Reflectance Mapping*, 2013);
- :func:`bake`: each texel of each level has the roughness with which it looks most like the converged truth;
- :class:`ReadMaps`: any of these at other levels of detail; its gain is due to the filter's kernel, not to shading.

The variance of slopes of a GGX lobe is infinite; in its place stands that of the Beckmann lobe of the same α, which is
α²/2 along each axis.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace

import drjit as dr
import numpy as np

from ...arrays.indirection import aligned_copy
from ...arrays.lookup import clamp
from ...images import srgb
from ...maps.layout import FROM_NORMAL, Layout, MapLayout
from ...maps.pyramid import FilteredMaps, Pyramid, halve
from ...tasks.disney.model import ALPHA_MIN, Effects
from ...tasks.disney.training import uniform_hemisphere
from ...tasks.texture.appearance import reader, reference
from ...tasks.texture.compressed import NEUTRAL
from ...tasks.texture.heldout import HeldOutFootprints
from ...tasks.texture.surface import DEFAULT_ALBEDO, DEFAULTS, READ, maps_of, shaded, surface_of

#: Least third component in the slope of a normal: a slope of 10.
STEEPEST = 0.1

#: Name of the map of LEAN's lobes: (c, s) of :class:`~mi_diffind.tasks.disney.decoder.Lobe`, in the form of extras.
LOBE = "lobe"

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


def lean_pyramid(pyramid: Pyramid) -> Pyramid:
    """Return the pyramid of LEAN's lobes: normals of the mean slope, roughness, and the map :data:`LOBE` of the shape.

    All other lobes are those of filtered parameters, times the length of the mean normal: a cosine is linear in the
    normal, and so is its mean (worth 0.8 dB on bricks and cloth). The albedo holds that factor, but not for metal.
    """
    albedo, metallic = (maps_of(pyramid.layout).get(role) for role in ("albedo", "metallic"))
    levels = {"albedo": [], "normal": [], "roughness": [], LOBE: []}
    for level, moments in enumerate(surface_moments(pyramid)):
        bx, by, xx, yy, xy, alpha2, *mean = np.moveaxis(moments, -1, 0)
        n = np.stack([bx, by, np.ones_like(bx)], axis=-1)
        n /= np.linalg.norm(n, axis=-1, keepdims=True)
        roughness, shape = lobe((np.maximum(xx - bx * bx, 0), np.maximum(yy - by * by, 0), xy - bx * by), alpha2, n)
        linear = np.full((*bx.shape, 1), DEFAULT_ALBEDO)
        if albedo is not None:
            linear = pyramid.decode([albedo.name], level=level)[albedo.name]
            linear = srgb.to_linear(linear) if albedo.color_space == "srgb" else linear
        metal = 0.0 if metallic is None else pyramid.decode([metallic.name], level=level)[metallic.name]
        length = np.linalg.norm(mean, axis=0)[..., None]
        levels["albedo"].append(srgb.from_linear(linear * (length + metal * (1 - length))))
        levels["normal"].append(0.5 + 0.5 * n)
        levels["roughness"].append(roughness[..., None])
        levels[LOBE].append(NEUTRAL[:2] + 0.5 * shape)
    return with_maps(pyramid, levels)


def lobe(covariance, alpha2, n) -> tuple[np.ndarray, np.ndarray]:
    """Return roughness, ``(…)``, and shape (c, s), ``(…, 2)``, of lobes about normals ``n``, ``(…, 3)``.

    ``covariance`` is that of the slopes in the surface's tangent plane, ``(xx, yy, xy)``, ``alpha2`` the α² of facets
    on them. In the frame of a tilted normal n, slopes are, to first order, n_z times their projections onto the frame's
    tangents. GGX's matrix A (:class:`~mi_diffind.tasks.disney.decoder.Lobe`) is α² plus twice their covariance.
    """
    xx, yy, xy = covariance
    x, y, z = np.moveaxis(n, -1, 0)
    s = np.stack([1 - x * x, -x * y, -x * z]) / np.sqrt(np.maximum(1 - x * x, 1e-12))
    t = np.stack([y * s[2] - z * s[1], z * s[0] - x * s[2], x * s[1] - y * s[0]])

    def projected(a, b):
        return z * z * (xx * a[0] * b[0] + yy * a[1] * b[1] + xy * (a[0] * b[1] + a[1] * b[0]))

    p, q, r = projected(s, s) + 0.5 * alpha2, projected(t, t) + 0.5 * alpha2, projected(s, t)
    return (p + q) ** 0.25, np.stack([p - q, 2 * r], axis=-1) / (p + q)[..., None]


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


def with_maps(pyramid: Pyramid, maps: Mapping[str, Sequence[np.ndarray]]) -> Pyramid:
    """Return a pyramid with other ``maps``: role → levels, ``(height, width, channels)`` in [0, 1].

    They have stored channels of their own. A role that shading does not read is the name of a further map. Colours are
    sRGB-encoded; z of normals follows from x and y. The pyramid is meant to be compressed in place of the source's.
    """
    layout, old = pyramid.layout, maps_of(pyramid.layout)
    kept = [m for m in layout.maps if m not in [old.get(role) for role in maps]]
    channels = sorted({w for m in kept for w in m.where if isinstance(w, int)})
    entries = [replace(m, where=tuple(channels.index(w) if w in channels else w for w in m.where)) for m in kept]
    initial, groups = [layout.initial[c] for c in channels], [layout.groups[c] for c in channels]
    values = [level[..., channels] for level in pyramid.values]
    for role, levels in maps.items():
        name, first = old[role].name if role in old else role, len(groups)
        count = 2 if role == "normal" else levels[0].shape[-1]
        where = (*range(first, first + count), *[FROM_NORMAL] * (role == "normal"))
        space = "srgb" if role == "albedo" else "linear"
        entries.append(MapLayout(name, role if role in READ else "other", space, 1, where))
        initial, groups = [*initial, *[0.5] * count], [*groups, *[name] * count]
        values = [
            np.concatenate([a, b[..., :count].clip(0, 1).astype(np.float32)], axis=-1)
            for a, b in zip(values, levels, strict=True)
        ]
    changed = Layout(layout.width, layout.height, tuple(entries), tuple(initial), tuple(groups))
    return Pyramid(changed, values, pyramid.types, pyramid.border)


def with_roughness(pyramid: Pyramid, levels: Sequence[np.ndarray]) -> Pyramid:
    """Return a pyramid with another roughness, ``(height, width)`` for each level (:func:`with_maps`)."""
    return with_maps(pyramid, {"roughness": [level[..., None] for level in levels]})


class ReadMaps(FilteredMaps):
    """Maps of a filter as they are meant to be read.

    ``biases`` are added to the level of detail, one for each whole level, interpolated between. A map :data:`LOBE` is
    the shape of the specular lobe, in the form of extras.
    """

    def __init__(self, maps: FilteredMaps, biases: Sequence[float] = (0.0,)):
        self.inner, self.biases = maps, biases
        self.layout, self.types, self.border, self.levels = maps.layout, maps.types, maps.border, maps.levels
        self.has_extras = LOBE in self.layout.names

    def stored(self, u, v, active=True) -> list:
        return self.inner.stored(u, v, active)

    def biased(self, level):
        Float = type(level)
        table = Float(aligned_copy(np.append(self.biases, self.biases[-1]), np.float32))
        position = clamp(level, 0.0, float(len(self.biases) - 1))
        lower = dr.uint32_array_t(Float)(position)
        a, b = dr.gather(Float, table, lower), dr.gather(Float, table, lower + 1)
        return dr.maximum(level + dr.lerp(a, b, position - Float(lower)), 0)

    def filtered(self, u, v, level, active=True) -> list:
        return self.inner.filtered(u, v, self.biased(level), active)

    def extra(self, u, v, level, active=True) -> list | None:
        if not self.has_extras:
            return None
        return [*self.maps(self.filtered(u, v, level, active), [LOBE])[LOBE], type(u)(1)]


def choose_biases(maps: FilteredMaps, effects: Effects, footprints: HeldOutFootprints) -> list[float]:
    """Return, for each level, the one of :data:`BIASES` with which ``maps`` are nearest to the truth of footprints."""
    psnr = [footprints.psnr(reader(ReadMaps(maps, [bias]), effects)) for bias in BIASES]
    return [BIASES[i] for i in np.argmax(psnr, axis=0)]
