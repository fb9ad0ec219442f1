"""
What shading-aware textures are compared with: classical ways to keep a surface's look where its normals are averaged.

Each takes the maps of a material at every level of detail, uncompressed, and gives a reader, as
:mod:`mi_diffind.tasks.shading.evaluation` has them: ``(u, v, level, wi, wo) → Array3f`` of shaded values.

- :func:`filtered`: filtered parameters, normals brought to length 1: what a mip map does;
- :func:`toksvig`: the length of the mean normal makes it rougher (Toksvig, *Mipmapping Normal Maps*, 2005);
- :func:`lean`: first and second moments of slopes, filtered linearly, make an anisotropic lobe (Olano and Baker, *LEAN
  Mapping*, 2010), a GGX one in place of their Beckmann's (Dupuy et al., *Linear Efficient Antialiased Displacement and
  Reflectance Mapping*, 2013);
- :func:`baked`: each texel of each level has the roughness with which it looks most like the converged truth;
- :func:`biased`: any of these at other levels of detail, chosen on training pairs: what filtered parameters gain by it
  is a matter of the filter's kernel, not of shading.

Toksvig's and LEAN's know the source's moments, not compressed ones. A GGX lobe has no variance of slopes; what is said
of one is that of the Beckmann lobe of the same α, which is α²/2 along each axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import drjit as dr
import numpy as np

from ...indirection import aligned
from ...lookup import clamp
from ...maps.layout import FROM_NORMAL, Layout, MapLayout
from ...maps.pyramid import Pyramid, around, halved, level_sizes
from ...maps.source import Source
from ...tasks.disney.decoder import Decoder, ggx_coefficients
from ...tasks.disney.effects import Effects
from ...tasks.disney.model import ALPHA_MIN, PARAMETERS, Material, sanitize
from ...tasks.disney.training import Shaded, shade, uniform_hemisphere
from ...tasks.shading.evaluation import ShadedReader, reader
from ...tasks.shading.material import DEFAULTS, SurfaceParameters, frame, maps_of, shaded, shadowing, surface_of
from ...tasks.shading.reference import reference

#: The least third component that a normal's slope is made of: a slope of 10.
STEEPEST = 0.1

#: Biases of the level of detail that are tried.
BIASES = tuple(np.arange(-8, 5) / 8)

#: Values of roughness that are tried for each texel, between its own (0) and 1; a parabola through three errors makes
#: the best one more precise.
TRIED = np.linspace(0, 1, 28)

#: Views and lights that roughness and biases are chosen for, and the seed that they are drawn from, no other's.
PAIRS, SEED = 32, 20050711

#: Places of each level, each under a view and a light of its own, that a bias is chosen for, and levels that have one.
PLACES, BIASED = 2**14, 7

#: Places along each side of a texel where its moments are averaged.
INSIDE = 4

#: Lanes that are looked at in one go.
CHUNK = 2**22


class Moments:
    """
    Channels of any meaning at every level of detail, ``values``, ``(height, width, k)`` each: what is read between
    texels and levels is interpolated linearly.
    """

    def __init__(self, values: Sequence[np.ndarray], types, border):
        self.types, self.border, self.levels = types, tuple(border), len(values)
        self.height, self.width, self.channels = values[0].shape
        self._groups = -(-self.channels // 4)
        flat = np.concatenate([level.reshape(-1, self.channels) for level in values])
        padded = aligned((len(flat), 4 * self._groups), np.float32)
        padded[:, : self.channels], padded[:, self.channels :] = flat, 0
        starts = np.cumsum([0] + [level.shape[0] * level.shape[1] for level in values[:-1]]).astype(np.uint32)
        self._texels, self._starts = types.TensorXf(padded).array, types.UInt32(starts)

    def read(self, u, v, level) -> list:
        """The channels at (u, v) and a level of detail."""
        level = clamp(level, 0.0, float(self.levels - 1))
        lower = dr.floor(level)
        below = self._bilinear(u, v, lower)
        above = self._bilinear(u, v, dr.minimum(lower + 1, self.levels - 1))
        return [dr.fma(level - lower, b - a, a) for a, b in zip(below, above, strict=True)]

    def _bilinear(self, u, v, level) -> list:
        UInt32, Array4f = self.types.UInt32, self.types.Array4f
        level = UInt32(level)
        rows, columns = (dr.maximum(UInt32(n) >> level, 1) for n in (self.height, self.width))
        start = dr.gather(UInt32, self._starts, level)
        total = [0.0] * self.channels
        across = around(u, columns, self.border[1])
        for row, a in around(v, rows, self.border[0]):
            for column, b in across:
                index = (start + row * columns + column) * self._groups
                found = [c for group in range(self._groups) for c in dr.gather(Array4f, self._texels, index + group)]
                total = [dr.fma(a * b, f, t) for f, t in zip(found[: self.channels], total, strict=True)]
        return total


# -- the source -------------------------------------------------------------------------------------------------------


def unit_normals(source: Source) -> np.ndarray | None:
    """The source's normals, ``(height, width, 3)``, each of length 1; ``None`` without a normal map."""
    m = next((m for m in source.maps if m.role == "normal"), None)
    if m is None:
        return None
    normal = (m.values if m.values.min() < 0 else 2 * m.values - 1).astype(np.float64)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(length > 1e-6, normal / np.maximum(length, 1e-6), [0.0, 0.0, 1.0])


def slopes(normals: np.ndarray) -> np.ndarray:
    """Slopes ``(x/z, y/z)`` and their products ``(xx, yy, xy)/z²`` of unit normals, ``(…, 5)``."""
    b = normals[..., :2] / np.maximum(normals[..., 2:], STEEPEST)
    return np.concatenate([b, b**2, b[..., :1] * b[..., 1:]], axis=-1)


def roughness(source: Source) -> np.ndarray:
    """The source's roughness, ``(height, width, 1)``."""
    m = next((m for m in source.maps if m.role == "roughness"), None)
    if m is None:
        return np.full((source.height, source.width, 1), DEFAULTS["roughness"])
    return m.values.astype(np.float64)


def slope_moments(normals: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """:func:`slopes` and α²."""
    return np.concatenate([slopes(normals), np.maximum(roughness**2, ALPHA_MIN) ** 2], axis=-1)


def interpolated(
    function: Callable, normals: np.ndarray, roughness: np.ndarray, border, two: bool = False
) -> np.ndarray:
    """
    Means over texels of a ``function`` of normals and roughness, ``(height, width, k)``, which are interpolated between
    the texels' centres: at :data:`INSIDE` places along each side of a texel. ``two``: the third component of normals is
    not interpolated, but follows from the others.
    """
    total, places = 0.0, (np.arange(INSIDE) + 0.5) / INSIDE - 0.5
    for dy in places:
        for dx in places:
            n, r = (_shifted(_shifted(base, dy, 0, border), dx, 1, border) for base in (normals, roughness))
            if two:
                n = np.concatenate(
                    [n[..., :2], np.sqrt(np.maximum(1 - (n[..., :2] ** 2).sum(-1, keepdims=True), 0))], -1
                )
            n = n / np.maximum(np.linalg.norm(n, axis=-1, keepdims=True), 1e-6)
            total = total + function(n, r)
    return total / INSIDE**2


def _shifted(base: np.ndarray, by: float, axis: int, way: str) -> np.ndarray:
    """What is interpolated ``by`` texels further along an axis, less than one."""
    edges = [(0, 0)] * base.ndim
    edges[axis] = (1, 0) if by < 0 else (0, 1)
    padded = np.pad(base, edges, "wrap" if way[axis] == "repeat" else "edge")
    n = base.shape[axis]
    first, second = (np.take(padded, np.arange(n) + i, axis) for i in (0, 1))
    share = by + 1 if by < 0 else by
    return (1 - share) * first + share * second


def means(base: np.ndarray) -> list[np.ndarray]:
    """All levels of a level 0, ``(height, width, k)``: each texel is the mean of what it covers."""
    found = [base]
    for _ in level_sizes(*base.shape[:2])[1:]:
        found.append(halved(found[-1]))
    return found


# -- classical --------------------------------------------------------------------------------------------------------


def filtered(pyramid: Pyramid, effects: Effects) -> ShadedReader:
    """Filtered parameters."""
    return reader(pyramid, effects)


def toksvig_alpha2(alpha2, length):
    """
    α² of a GGX lobe whose normals have a mean of ``length`` (0, 1].

    Toksvig scales the exponent s of a Blinn–Phong lobe: s' = s r / (r + s (1 − r)). That of the lobe of an α is
    s = 2/α² − 2 (Walter et al. 2007), so α'² = 2/(s' + 2).
    """
    exponent = 2 / alpha2 - 2
    scaled = exponent * length / (length + exponent * (1 - length))
    return 2 / (scaled + 2)


def toksvig(source: Source, pyramid: Pyramid, effects: Effects, smooth: bool = False) -> ShadedReader:
    """
    Roughness from the length of the mean normal (:func:`toksvig_alpha2`), which is read unnormalised. ``smooth``: the
    mean is over what is :func:`interpolated` between texels, as the truth has it.
    """
    if unit_normals(source) is None:
        return filtered(pyramid, effects)
    moments = _moments(lambda n, r: n, source, pyramid, smooth)

    def read(u, v, level, wi, wo):
        surface = surface_of(pyramid, pyramid.filtered(u, v, level))
        mean = pyramid.types.Array3f(moments.read(u, v, level))
        length = clamp(dr.norm(mean), 1e-3, 1.0)
        found = toksvig_alpha2(_alpha2(surface.roughness, type(u)), length)
        return shaded(None, replace(surface, roughness=dr.sqrt(dr.sqrt(found))), wi, wo, effects)

    return read


def _alpha2(roughness, Float):
    return dr.square(dr.maximum(dr.square(Float(roughness)), ALPHA_MIN))


def _moments(function: Callable, source: Source, pyramid: Pyramid, smooth: bool) -> Moments:
    """The moments that a ``function`` makes of normals and roughness."""
    given, two = (unit_normals(source), roughness(source)), FROM_NORMAL in maps_of(pyramid.layout)["normal"].where
    base = interpolated(function, *given, pyramid.border, two) if smooth else function(*given)
    return Moments(means(base), pyramid.types, pyramid.border)


def lean(source: Source, pyramid: Pyramid, effects: Effects, smooth: bool = False) -> ShadedReader:
    """
    An anisotropic lobe around the normal of the mean slope. The covariance of slopes is that in the surface's tangent
    plane; about a tilted normal n slopes are, to first order, n_z times what the tangents of its frame see of them. To
    it is added the mean of α²/2, and the eigenvectors of the sum are the axes of the lobe, twice the eigenvalues its
    α². All else is that of filtered parameters, times the length of the mean normal: a cosine is linear in the normal,
    and so is its mean (worth 0.8 dB on bricks and cloth). ``smooth``: as in :func:`toksvig`.
    """
    if unit_normals(source) is None:
        return filtered(pyramid, effects)
    moments = _moments(lambda n, r: np.concatenate([slope_moments(n, r), n], axis=-1), source, pyramid, smooth)
    rest = tuple(lobe for lobe in effects.lobes if lobe != "specular")
    Array3f = pyramid.types.Array3f

    def read(u, v, level, wi, wo):
        surface = surface_of(pyramid, pyramid.filtered(u, v, level))
        material, albedo = _parameters(surface, type(u))
        bx, by, xx, yy, xy, a2, *mean = moments.read(u, v, level)
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
    """
    ``α_x, α_y`` and their axes: of slopes whose ``covariance`` in the surface is ``(xx, yy, xy)``, and of facets of
    ``alpha2`` on them, about a normal ``n`` with tangents ``s``, ``t``.
    """
    xx, yy, xy = covariance

    def seen(a, b):
        return dr.square(n.z) * (xx * a.x * b.x + yy * a.y * b.y + xy * (a.x * b.y + a.y * b.x))

    p, q, r = seen(s, s) + 0.5 * alpha2, seen(t, t) + 0.5 * alpha2, seen(s, t)
    mean, half = 0.5 * (p + q), 0.5 * (p - q)
    root = dr.sqrt(half * half + r * r + 1e-20)
    angle = 0.5 * dr.atan2(r, half)
    sin, cos = dr.sincos(angle)
    ax, ay = (dr.sqrt(dr.maximum(2 * e, ALPHA_MIN**2)) for e in (mean + root, mean - root))
    return ax, ay, cos * s + sin * t, cos * t - sin * s


def specular(material: Material, albedo, ax, ay, wi, wo, effects: Effects):
    """The specular lobe times the cosine, of a material with other α, along the axes of the frame."""
    p, decoder = Shaded.of(material, albedo), Decoder()
    c = {"ggx": ggx_coefficients(ax, ay)}
    if "f0" in decoder.required(effects):
        c["f0"] = decoder.coefficients("f0", p, effects)
    return type(wi)(decoder.value(c, replace(effects, sheen=False), ("specular",), p, wi, wo))


def _parameters(surface: SurfaceParameters, Float) -> tuple:
    given = {"roughness": surface.roughness, "metallic": surface.metallic}
    material = Material(**{name: Float(given.get(name, DEFAULTS[name])) for name in PARAMETERS})
    return sanitize(material), dr.maximum(surface.albedo, 0)


def _in_frame(axes, wi, wo, value: Callable):
    """A value in a perturbed frame, with what shading by it takes (:func:`.material.shaded`)."""
    i, o = (type(w)(*(dr.dot(w, axis) for axis in axes)) for w in (wi, wo))
    visible = (wi.z > 0) & (wo.z > 0) & (i.z > 0) & (o.z > 0)
    up = type(wi)(0, 0, 1)
    i, o = dr.select(visible, i, up), dr.select(visible, o, up)
    return dr.select(visible, shadowing(axes[2], wo) * value(i, o), 0)


# -- roughness that was fitted ----------------------------------------------------------------------------------------


def roughness_reader(pyramid: Pyramid, effects: Effects, levels: Sequence[np.ndarray]) -> ShadedReader:
    """Filtered parameters, but for roughness, of which all levels are given, ``(height, width)`` each."""
    moments = Moments([level[..., None] for level in levels], pyramid.types, pyramid.border)

    def read(u, v, level, wi, wo):
        surface = surface_of(pyramid, pyramid.filtered(u, v, level))
        return shaded(None, replace(surface, roughness=moments.read(u, v, level)[0]), wi, wo, effects)

    return read


def baked(pyramid: Pyramid, effects: Effects, levels: Sequence[np.ndarray] | None = None) -> ShadedReader:
    """Filtered parameters with roughness as :func:`bake` has it, made now unless its ``levels`` are given."""
    return roughness_reader(pyramid, effects, bake(pyramid, effects) if levels is None else levels)


def directions(types, count: int = PAIRS, seed: int = SEED) -> list[tuple]:
    """Pairs of a view and a light, uniform over the hemisphere, the cosines of each one stratified."""
    rng = np.random.default_rng(seed)
    numbers = rng.random((4, count))
    for row in (0, 2):
        numbers[row] = (rng.permutation(count) + numbers[row]) / count
    made = [[dr.opaque(types.Float, float(x)) for x in column] for column in numbers.T]
    return [(uniform_hemisphere(types, a, b), uniform_hemisphere(types, c, d)) for a, b, c, d in made]


def bake(pyramid: Pyramid, effects: Effects, pairs: int = PAIRS) -> list[np.ndarray]:
    """
    The roughness, ``(height, width)`` for each level, with which filtered parameters at a texel's centre look most like
    the converged truth: the least squares of values clipped to [0, 1], over ``pairs`` of a view and a light. It is
    never below what is filtered (where light is lost, least squares would have no highlight at all), and the same on
    level 0.
    """
    types, found = pyramid.types, [np.array(roughness_of(pyramid)[0])]
    Float, UInt32 = types.Float, types.UInt32
    made, tried = directions(types, pairs), len(TRIED)
    values = Float(TRIED.astype(np.float32))
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
            place, own = _outer(UInt32, count, tried)
            parts = [dr.gather(Float, x, place) for x in (u, v, detail)]
            surface = surface_of(pyramid, pyramid.filtered(*parts))
            filtered = Float(surface.roughness)
            surface = replace(surface, roughness=dr.lerp(filtered, 1, dr.gather(Float, values, own)))
            dr.eval(surface.albedo, surface.normal, surface.roughness, surface.metallic)
            total = dr.zeros(Float, count * tried)
            for wi, wo in made:
                wanted = reference("converged", pyramid, u, v, detail, *_wide(count, wi, wo), effects, side=side)
                wanted = dr.gather(types.Array3f, dr.clip(wanted, 0, 1), place)
                got = dr.clip(shaded(None, surface, *_wide(count * tried, wi, wo), effects), 0, 1)
                total += dr.squared_norm(got - wanted)
                dr.eval(total)
            errors.append(total.numpy().reshape(count, tried))
        own = roughness_of(pyramid)[level]
        share = _least(np.concatenate(errors)).reshape(rows, columns)
        found.append((own + share * (1 - own)).astype(np.float32))
    return found


def _side(level: int) -> int:
    """
    Samples along the side of a footprint, two for each texel or more: with one, they might all be at centres of texels,
    or all at corners, where normals vary less.
    """
    return min(max(8, 2 << level), 128)


def _outer(UInt32, count: int, tried: int) -> tuple:
    """Of ``count × tried`` lanes, which of the first and which of the second each is."""
    lane = dr.arange(UInt32, count * tried)
    n = dr.opaque(UInt32, tried)
    place = lane // n
    return place, lane - place * n


def _wide(count: int, *directions) -> list:
    """Directions, one for each of ``count`` lanes."""
    return [dr.gather(type(w), w, dr.zeros(dr.uint32_array_t(type(w.x)), count)) for w in directions]


def _least(errors: np.ndarray) -> np.ndarray:
    """The value among :data:`TRIED`, which are equidistant, with the least error of each row, made more precise."""
    best = errors.argmin(axis=1)
    middle, lane = np.clip(best, 1, len(TRIED) - 2), np.arange(len(errors))
    before, at, after = (errors[lane, middle + i].astype(np.float64) for i in (-1, 0, 1))
    bend = before - 2 * at + after
    shift = np.where((bend > 1e-12) & (best == middle), 0.5 * (before - after) / np.maximum(bend, 1e-12), best - middle)
    return TRIED[middle] + shift * (TRIED[1] - TRIED[0])


def toksvig_levels(source: Source, pyramid: Pyramid) -> list[np.ndarray]:
    """The roughness of :func:`toksvig` at the texels of each level, ``(height, width)``."""
    normals, own = unit_normals(source), roughness_of(pyramid)
    if normals is None:
        return own
    lengths = [np.clip(np.linalg.norm(n, axis=-1), 1e-3, 1) for n in means(normals)]
    alpha2s = [np.maximum(r.astype(np.float64) ** 2, ALPHA_MIN) ** 2 for r in own]
    return [toksvig_alpha2(a, r) ** 0.25 for a, r in zip(alpha2s, lengths, strict=True)]


def roughness_of(pyramid: Pyramid) -> list[np.ndarray]:
    """The roughness of each level of a pyramid, ``(height, width)``."""
    m, found = maps_of(pyramid.layout).get("roughness"), []
    for values in pyramid.values:
        value = DEFAULTS["roughness"]
        if m is not None:
            (value,) = pyramid.layout.decode(m.name, np.moveaxis(values, -1, 0))
        found.append(np.broadcast_to(np.asarray(value, np.float32), values.shape[:2]))
    return found


def with_roughness(pyramid: Pyramid, levels: Sequence[np.ndarray]) -> Pyramid:
    """
    A pyramid with another roughness, all levels of which are given, in a stored channel of its own: what is compressed
    in place of the source's.
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


# -- the kernel -------------------------------------------------------------------------------------------------------


def biased(read: ShadedReader, biases: Sequence[float]) -> ShadedReader:
    """
    What ``read`` shows of another level of detail: ``biases`` (:func:`choose_biases`), one for each whole level, are
    added, and interpolated between them.
    """

    def at(u, v, level, wi, wo):
        Float = type(u)
        table = Float(np.append(biases, biases[-1]).astype(np.float32))
        own = clamp(level, 0.0, float(len(biases) - 1))
        lower = dr.uint32_array_t(Float)(own)
        a, b = dr.gather(Float, table, lower), dr.gather(Float, table, lower + 1)
        return read(u, v, dr.maximum(level + dr.lerp(a, b, own - Float(lower)), 0), wi, wo)

    return at


def choose_biases(read: ShadedReader, pyramid: Pyramid, effects: Effects, places: int = PLACES) -> list[float]:
    """
    Of each level, the one of :data:`BIASES` with which ``read`` errs least against the converged truth, at random
    ``places``, views and lights. Few of these see a highlight, so that the same ones are used for all levels.
    """
    types, found = pyramid.types, []
    rng = np.random.default_rng(SEED)
    numbers = [types.Float(x) for x in rng.random((6, places), dtype=np.float32)]
    u, v = numbers[:2]
    ways = [uniform_hemisphere(types, numbers[i], numbers[i + 1]) for i in (2, 4)]
    dr.eval(ways)
    for level in range(min(BIASED, pyramid.levels)):
        detail = dr.opaque(types.Float, level, places)
        truth = dr.clip(reference("converged", pyramid, u, v, detail, *ways, effects, side=_side(level)), 0, 1)
        errors = []
        for bias in BIASES:
            got = read(u, v, dr.opaque(types.Float, max(level + bias, 0), places), *ways)
            errors.append(float(dr.mean(dr.squared_norm(dr.clip(got, 0, 1) - truth))[0]))
        found.append(float(BIASES[int(np.argmin(errors))]))
    return found
