"""Classical filters of normal maps that shading-aware textures are compared with.

Each filter takes the maps of a material at every level of detail, uncompressed, and returns a reader, as in
:mod:`mi_diffind.tasks.shading.evaluation`: ``(u, v, level, wi, wo) → Array3f`` of shaded values.

- ``reader``, that of the same module: filtered parameters with normals brought to length 1, as a mip map does;
- :func:`toksvig`: roughness increased by the length of the mean normal (Toksvig, *Mipmapping Normal Maps*, 2005);
- :func:`lean`: first and second moments of slopes, filtered linearly, make an anisotropic lobe (Olano and Baker, *LEAN
  Mapping*, 2010), a GGX one in place of their Beckmann's (Dupuy et al., *Linear Efficient Antialiased Displacement and
  Reflectance Mapping*, 2013);
- :func:`bake`: each texel of each level has the roughness with which it looks most like the converged truth;
- :func:`biased`: any of these at other levels of detail, chosen on training pairs; its gain over filtered parameters
  is due to the filter's kernel, not to shading.

Toksvig's and LEAN's filters know the source's moments, not compressed ones. The variance of slopes of a GGX lobe is
infinite; in its place stands that of the Beckmann lobe of the same α, which is α²/2 along each axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import drjit as dr
import numpy as np

from ...arrays.indirection import aligned_copy
from ...arrays.lookup import clamp
from ...maps.layout import FROM_NORMAL, Layout, MapLayout
from ...maps.pyramid import Pyramid, halve, level_sizes
from ...maps.source import Source
from ...tasks.disney.decoder import Decoder, ggx_coefficients
from ...tasks.disney.model import ALPHA_MIN, PARAMETERS, Effects, Material, sanitize
from ...tasks.disney.training import Shaded, shade, uniform_hemisphere
from ...tasks.shading.evaluation import ShadedReader, reader, reference
from ...tasks.shading.material import DEFAULTS, SurfaceParameters, frame, maps_of, shaded, shadowing, surface_of

#: Least third component in the slope of a normal: a slope of 10.
STEEPEST = 0.1

#: Biases of the level of detail that :func:`choose_biases` tries.
BIASES = tuple(np.arange(-8, 5) / 8)

#: Shares of the way from a texel's filtered roughness (0) to 1 that :func:`bake` tries; a parabola through the errors
#: of three of them refines the best one.
TRIED = np.linspace(0, 1, 28)

#: Pairs of a view and a light that :func:`bake` averages over, and the seed of pairs and places; no other uses it.
PAIRS, SEED = 32, 20050711

#: Places of each level, each with its own view and light, that a bias is chosen for; number of levels with a bias.
PLACES, BIASED = 2**14, 7

#: Samples along each side of a texel at which moments are averaged.
INSIDE = 4

#: Lanes of one evaluation in :func:`bake`.
CHUNK = 2**22


def moment_pyramid(levels: Sequence[np.ndarray], types, border) -> Pyramid:
    """Return a pyramid of channels of any meaning, ``(height, width, k)`` for each level, interpolated linearly."""
    height, width, count = levels[0].shape
    maps = (MapLayout("moments", "other", "linear", 1, tuple(range(count))),)
    return Pyramid(Layout(width, height, maps, (0.5,) * count, ("moments",) * count), levels, types, border)


def unit_normals(source: Source) -> np.ndarray | None:
    """Return the source's normals, ``(height, width, 3)``, of length 1; ``None`` without a normal map."""
    m = next((m for m in source.maps if m.role == "normal"), None)
    if m is None:
        return None
    normal = (m.values if m.values.min() < 0 else 2 * m.values - 1).astype(np.float64)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(length > 1e-6, normal / np.maximum(length, 1e-6), [0.0, 0.0, 1.0])


def slopes(normals: np.ndarray) -> np.ndarray:
    """Return slopes ``(x/z, y/z)`` and their products ``(xx, yy, xy)/z²`` of unit normals, ``(…, 5)``."""
    b = normals[..., :2] / np.maximum(normals[..., 2:], STEEPEST)
    return np.concatenate([b, b**2, b[..., :1] * b[..., 1:]], axis=-1)


def roughness(source: Source) -> np.ndarray:
    """Return the source's roughness, ``(height, width, 1)``."""
    m = next((m for m in source.maps if m.role == "roughness"), None)
    if m is None:
        return np.full((source.height, source.width, 1), DEFAULTS["roughness"])
    return m.values.astype(np.float64)


def slope_moments(normals: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Return :func:`slopes` and α², ``(…, 6)``."""
    return np.concatenate([slopes(normals), np.maximum(roughness**2, ALPHA_MIN) ** 2], axis=-1)


def interpolated(
    function: Callable, normals: np.ndarray, roughness: np.ndarray, border, two: bool = False
) -> np.ndarray:
    """Return means over each texel of a ``function`` of normals and roughness, ``(height, width, k)``.

    Normals and roughness are interpolated bilinearly at :data:`INSIDE` positions along each side of a texel. With
    ``two``, the third component of normals is not interpolated but computed from the other two.
    """
    total, places = 0.0, (np.arange(INSIDE) + 0.5) / INSIDE - 0.5
    for dy in places:
        for dx in places:
            n, r = (_shifted(_shifted(base, dy, 0, border), dx, 1, border) for base in (normals, roughness))
            if two:
                z = np.sqrt(np.maximum(1 - (n[..., :2] ** 2).sum(-1, keepdims=True), 0))
                n = np.concatenate([n[..., :2], z], -1)
            n = n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-6)
            total = total + function(n, r)
    return total / INSIDE**2


def _shifted(base: np.ndarray, by: float, axis: int, border: Sequence[str]) -> np.ndarray:
    """Return values interpolated ``by`` (less than one) texels further along an axis."""
    edges = [(0, 0)] * base.ndim
    edges[axis] = (1, 0) if by < 0 else (0, 1)
    padded = np.pad(base, edges, "wrap" if border[axis] == "repeat" else "edge")
    n = base.shape[axis]
    first, second = (np.take(padded, np.arange(n) + i, axis) for i in (0, 1))
    share = by + 1 if by < 0 else by
    return (1 - share) * first + share * second


def means(base: np.ndarray) -> list[np.ndarray]:
    """Return all levels of a level 0, ``(height, width, k)``: each texel is the mean of the texels that it covers."""
    levels = [base]
    for _ in level_sizes(*base.shape[:2])[1:]:
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


def toksvig(source: Source, pyramid: Pyramid, effects: Effects) -> ShadedReader:
    """Return the reader whose roughness is :func:`toksvig_alpha2` of the length of the mean normal."""
    if unit_normals(source) is None:
        return reader(pyramid, effects)
    moments = _moments(lambda n, r: n, source, pyramid, False)

    def read(u, v, level, wi, wo):
        surface = surface_of(pyramid, pyramid.filtered(u, v, level))
        mean = pyramid.types.Array3f(moments.filtered(u, v, level))
        length = clamp(dr.norm(mean), 1e-3, 1.0)
        alpha = dr.maximum(dr.square(type(u)(surface.roughness)), ALPHA_MIN)
        alpha2 = toksvig_alpha2(dr.square(alpha), length)
        return shaded(None, replace(surface, roughness=dr.sqrt(dr.sqrt(alpha2))), wi, wo, effects)

    return read


def _moments(function: Callable, source: Source, pyramid: Pyramid, smooth: bool) -> Pyramid:
    """Return all levels of a ``function`` of normals and roughness."""
    maps, two = (unit_normals(source), roughness(source)), FROM_NORMAL in maps_of(pyramid.layout)["normal"].where
    base = interpolated(function, *maps, pyramid.border, two) if smooth else function(*maps)
    return moment_pyramid(means(base), pyramid.types, pyramid.border)


def lean(source: Source, pyramid: Pyramid, effects: Effects, smooth: bool = False) -> ShadedReader:
    """Return the reader of an anisotropic lobe around the normal of the mean slope.

    The covariance of slopes is measured in the surface's tangent plane; in the frame of a tilted normal n, slopes are,
    to first order, n_z times their projections onto the frame's tangents. The mean of α²/2 is added to the covariance;
    the eigenvectors of the sum are the axes of the lobe, twice the eigenvalues its α². All other lobes are those of
    filtered parameters, times the length of the mean normal: a cosine is linear in the normal, and so is its mean
    (worth 0.8 dB on bricks and cloth). With ``smooth``, moments are those of interpolated normals
    (:func:`interpolated`), as in the truth.
    """
    if unit_normals(source) is None:
        return reader(pyramid, effects)
    moments = _moments(lambda n, r: np.concatenate([slope_moments(n, r), n], axis=-1), source, pyramid, smooth)
    rest = tuple(lobe for lobe in effects.lobes if lobe != "specular")
    Array3f = pyramid.types.Array3f

    def read(u, v, level, wi, wo):
        surface = surface_of(pyramid, pyramid.filtered(u, v, level))
        material, albedo = _parameters(surface, type(u))
        bx, by, xx, yy, xy, a2, *mean = moments.filtered(u, v, level)
        covariance = (dr.maximum(xx - bx * bx, 0), dr.maximum(yy - by * by, 0), xy - bx * by)
        s, t, n = frame(Array3f(bx, by, 1), wi)
        ax, ay, s, t = lobe(covariance, a2, s, t, n)
        value = _in_frame((s, t, n), wi, wo, lambda i, o: specular(material, albedo, ax, ay, i, o, effects))
        if rest:
            axes, length = frame(surface.normal, wi), dr.norm(Array3f(mean))
            value += length * _in_frame(axes, wi, wo, lambda i, o: shade(None, material, albedo, i, o, effects, rest))
        return dr.pi * value

    return read


def lobe(covariance, alpha2, s, t, n) -> tuple:
    """Return ``α_x, α_y`` and the two axes of a lobe about a normal ``n`` with tangents ``s``, ``t``.

    ``covariance`` is that of the slopes in the surface, ``(xx, yy, xy)``, ``alpha2`` the α² of facets on them.
    """
    xx, yy, xy = covariance

    def projected(a, b):
        return dr.square(n.z) * (xx * a.x * b.x + yy * a.y * b.y + xy * (a.x * b.y + a.y * b.x))

    p, q, r = projected(s, s) + 0.5 * alpha2, projected(t, t) + 0.5 * alpha2, projected(s, t)
    mean, half = 0.5 * (p + q), 0.5 * (p - q)
    root = dr.sqrt(half * half + r * r + 1e-20)
    angle = 0.5 * dr.atan2(r, half)
    sin, cos = dr.sincos(angle)
    ax, ay = (dr.sqrt(dr.maximum(2 * e, ALPHA_MIN**2)) for e in (mean + root, mean - root))
    return ax, ay, cos * s + sin * t, cos * t - sin * s


def specular(material: Material, albedo, ax, ay, wi, wo, effects: Effects):
    """Return the specular lobe times the cosine, with ``ax``, ``ay`` along the frame's axes as α."""
    p, decoder = Shaded.of(material, albedo), Decoder()
    c = {"ggx": ggx_coefficients(ax, ay)}
    if "f0" in decoder.required(effects):
        c["f0"] = decoder.coefficients("f0", p, effects)
    return type(wi)(decoder.value(c, replace(effects, sheen=False), ("specular",), p, wi, wo))


def _parameters(surface: SurfaceParameters, Float) -> tuple:
    values = {**DEFAULTS, "roughness": surface.roughness, "metallic": surface.metallic}
    material = Material(**{name: Float(values[name]) for name in PARAMETERS})
    return sanitize(material), dr.maximum(surface.albedo, 0)


def _in_frame(axes, wi, wo, value: Callable):
    """Return a value in a perturbed frame, masked and shadowed as in :func:`.material.shaded`."""
    i, o = (type(w)(*(dr.dot(w, axis) for axis in axes)) for w in (wi, wo))
    visible = (wi.z > 0) & (wo.z > 0) & (i.z > 0) & (o.z > 0)
    up = type(wi)(0, 0, 1)
    i, o = dr.select(visible, i, up), dr.select(visible, o, up)
    return dr.select(visible, shadowing(axes[2], wo) * value(i, o), 0)


def roughness_reader(pyramid: Pyramid, effects: Effects, levels: Sequence[np.ndarray]) -> ShadedReader:
    """Return the reader of filtered parameters with another roughness, ``(height, width)`` for each level."""
    baked = moment_pyramid([level[..., None] for level in levels], pyramid.types, pyramid.border)

    def read(u, v, level, wi, wo):
        surface = surface_of(pyramid, pyramid.filtered(u, v, level))
        return shaded(None, replace(surface, roughness=baked.filtered(u, v, level)[0]), wi, wo, effects)

    return read


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
    types, filtered_levels = pyramid.types, roughness_of(pyramid)
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
            lane = dr.arange(UInt32, count)
            index = lane + dr.opaque(UInt32, start)
            n, m = dr.opaque(UInt32, columns), dr.opaque(UInt32, rows)
            u, v = (Float(index % n) + 0.5) / Float(n), (Float(index // n) + 0.5) / Float(m)
            detail = dr.opaque(Float, level, count)
            pair, n = dr.arange(UInt32, count * tried), dr.opaque(UInt32, tried)
            texel, trial = pair // n, pair - pair // n * n
            surface = surface_of(pyramid, pyramid.filtered(*(dr.gather(Float, x, texel) for x in (u, v, detail))))
            roughness = dr.lerp(Float(surface.roughness), 1, dr.gather(Float, shares, trial))
            surface = replace(surface, roughness=roughness)
            dr.eval(surface.albedo, surface.normal, surface.roughness, surface.metallic)
            total = dr.zeros(Float, count * tried)
            for wi, wo in view_lights:
                truth = reference("converged", pyramid, u, v, detail, *_wide(count, wi, wo), effects, side=side)
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


def toksvig_levels(source: Source, pyramid: Pyramid) -> list[np.ndarray]:
    """Return the roughness of :func:`toksvig` at the texels of each level, ``(height, width)``."""
    normals, filtered_levels = unit_normals(source), roughness_of(pyramid)
    if normals is None:
        return filtered_levels
    lengths = [np.clip(np.linalg.norm(n, axis=-1), 1e-3, 1) for n in means(normals)]
    alpha2s = [np.maximum(r.astype(np.float64) ** 2, ALPHA_MIN) ** 2 for r in filtered_levels]
    return [toksvig_alpha2(a, r) ** 0.25 for a, r in zip(alpha2s, lengths, strict=True)]


def lean_levels(source: Source, pyramid: Pyramid) -> list[np.ndarray]:
    """Return the roughness of the isotropic lobe with the mean variance of :func:`lean`'s, ``(height, width)``."""
    normals, levels = unit_normals(source), []
    if normals is None:
        return roughness_of(pyramid)
    for bx, by, xx, yy, _, a2 in (np.moveaxis(m, -1, 0) for m in means(slope_moments(normals, roughness(source)))):
        variance = np.maximum(xx - bx**2, 0) + np.maximum(yy - by**2, 0)
        levels.append(np.clip(a2 + variance / (1 + bx**2 + by**2), 0, 1) ** 0.25)
    return levels


def roughness_of(pyramid: Pyramid) -> list[np.ndarray]:
    """Return the roughness of each level of a pyramid, ``(height, width)``."""
    m, levels = maps_of(pyramid.layout).get("roughness"), []
    for values in pyramid.values:
        value = DEFAULTS["roughness"]
        if m is not None:
            (value,) = pyramid.layout.decode(m.name, np.moveaxis(values, -1, 0))
        levels.append(np.broadcast_to(np.asarray(value, np.float32), values.shape[:2]))
    return levels


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


def choose_biases(read: ShadedReader, pyramid: Pyramid, effects: Effects, places: int = PLACES) -> list[float]:
    """Return, for each level, the entry of :data:`BIASES` whose ``read`` is nearest to the converged truth.

    The error is measured at random ``places``, views and lights. Few of them see a highlight, so the same ones are used
    for all levels.
    """
    types, chosen = pyramid.types, []
    rng = np.random.default_rng(SEED)
    numbers = [types.Float(aligned_copy(x)) for x in rng.random((6, places), dtype=np.float32)]
    u, v = numbers[:2]
    view_light = [uniform_hemisphere(types, numbers[i], numbers[i + 1]) for i in (2, 4)]
    dr.eval(view_light)
    for level in range(min(BIASED, pyramid.levels)):
        detail = dr.opaque(types.Float, level, places)
        truth = dr.clip(reference("converged", pyramid, u, v, detail, *view_light, effects, side=_side(level)), 0, 1)
        dr.eval(truth)
        errors = []
        for bias in BIASES:
            value = read(u, v, dr.opaque(types.Float, max(level + bias, 0), places), *view_light)
            errors.append(float(dr.mean(dr.squared_norm(dr.clip(value, 0, 1) - truth))[0]))
        chosen.append(float(BIASES[int(np.argmin(errors))]))
    return chosen
