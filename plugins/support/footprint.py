"""Footprint of a pixel at a surface hit: two full conjugate diameters of an ellipse in uv, ``ddx`` and ``ddy``.

Both are ``mi.Vector2f``. Their |det| (:func:`area`) is
|ddx(uv) × ddy(uv)| of Datta et al., *Efficient Graphics Representation with Differentiable Indirection*, SIGGRAPH Asia
2023, task 4.

A texture sees only the hit. If the integrator does not provide the footprint, a :class:`Cone` of the sensor does;
:func:`attach` passes it to all textures of a scene that have a method ``set_cone(cone)``.

The functions of this module neither evaluate nor differentiate: footprints are detached.
"""

from __future__ import annotations

import weakref
from dataclasses import dataclass, replace
from itertools import combinations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_diffind.core import compat

from .. import warn
from . import omissions

#: Limit of the components of a footprint in uv: larger than any texture, and its fourth power is finite.
LARGEST = 2.0**20

#: Sine of the angle between dp_du and dp_dv below which uv is degenerate.
PARALLEL = 1e-6

#: Supported sensors.
PROJECTIONS = ("perspective", "thinlens", "orthographic")

#: Largest deviation, in rad, of a direct ray from the line to the sensor; a normal map's frame is not exact.
STRAIGHT = 2e-2


@dataclass(eq=False)  # a type in which frozen functions (``dr.freeze``) look for arrays
class Cone:
    """Geometry of a sensor's pixels in world space, as opaque arrays, so that another sensor needs no new kernel.

    - ``projection``: one of :data:`PROJECTIONS`;
    - ``origin``: the centre of projection, or of the lens; ``axis``: the unit vector of the viewing direction;
    - ``dx``, ``dy``: the shift of the visible place for a step of one pixel to the right, or down, at depth 1 along the
      axis (for an orthographic sensor, at any depth);
    - ``scale``: the width of a sample's footprint relative to a pixel's (:func:`sample_scale`);
    - ``reach``: the least √(cos³) of the angle between a pixel and the axis, 1 if orthographic;
    - ``lens``: the radius of the lens, 0 without one;
    - ``corner``: the visible place at the film's corner, relative to ``origin`` and at the depth of ``dx``; ``None``
      with a lens or more than one sample per pixel.
    """

    projection: str
    origin: mi.Point3f
    axis: mi.Vector3f
    dx: mi.Vector3f
    dy: mi.Vector3f
    scale: mi.Float
    reach: mi.Float
    lens: mi.Float
    corner: mi.Vector3f | None = None

    @classmethod
    def from_sensor(cls, sensor: mi.Sensor, spp: int | None = None) -> Cone:
        """Return the cone of a loaded sensor, at ``spp`` samples per pixel (default: that of its sampler).

        The projection is derived from the sensor's rays: all go through one point or one lens, or all are parallel, and
        pixels are parallelograms. Raises ``RuntimeError`` for other sensors (``distant``, ``irradiancemeter``,
        ``radiancemeter``, ``batch``, …).
        """
        film, to_world = sensor.film(), np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
        places = np.array([[0, 0], [1, 0], [0, 1], [1, 1], [0.5, 0.5], [0.5, 0.5]])
        lens = np.array([[0.5, 0.5]] * 5 + [[1, 0.5]])
        with dr.suspend_grad():
            ray, _ = sensor.sample_ray(
                sensor.shutter_open(), 0.5, mi.Point2f(places.T.tolist()), mi.Point2f(lens.T.tolist())
            )
            o, d = (np.array(v, np.float64).T * np.ones((len(places), 1)) for v in (ray.o, ray.d))
        origin, axis = to_world[:3, 3], to_world[:3, 2] / (np.linalg.norm(to_world[:3, 2]) or 1)
        cosine = d @ axis
        size = np.array(film.crop_size(), np.float64)

        projection, radius, apart = "", 0.0, np.abs(np.cross(o[:5] - origin, d[:5])).max()
        if np.abs(d - d[0]).max() < 1e-6:
            projection, seen, origin = "orthographic", o, o[4]
        elif (cosine > 0).all() and apart <= 1e-4 * (1 + np.abs(origin).max()):
            projection, seen = "perspective", d / np.maximum(cosine, 1e-9)[:, None]
            if sensor.needs_aperture_sample():
                projection = "thinlens"
                on_lens = o[5] - seen[5] * ((o[5] - origin) @ axis)  # rays start at the near clipping plane
                radius = float(np.linalg.norm(on_lens - origin))
        if projection:
            dx, dy = seen[1] - seen[0], seen[2] - seen[0]
            error = max(np.abs(seen[0] + dx + dy - seen[3]).max(), np.abs(seen[0] + (dx + dy) / 2 - seen[4]).max())
            span = max(np.abs(dx).max(), np.abs(dy).max())
        if not projection or span == 0 or error > 1e-2 * span:
            raise RuntimeError(
                f'the sensor "{sensor.id()}" ({sensor.class_name()}) has no pixels whose footprint is known, supported '
                f"are {', '.join(PROJECTIONS)}"
            )
        spp = sensor.sampler().sample_count() if spp is None else spp
        reach = 1.0 if projection == "orthographic" else float((cosine[:4] ** 1.5).min())
        cone = cls._opaque(projection, origin, axis, dx / size[0], dy / size[1], spp, reach, radius)
        if projection != "thinlens" and spp == 1:
            corner = seen[0] - (origin if projection == "orthographic" else 0)
            cone.corner = dr.opaque(mi.Vector3f, [float(x) for x in corner])
        return cone

    @classmethod
    def from_properties(cls, props: mi.Properties) -> Cone | None:
        """Return the cone of a perspective sensor that a texture's properties describe, or ``None``.

        They are ``sensor_to_world`` (a transformation without scale), ``fov`` (in degrees, along x), ``resolution``
        (number of square pixels along x) and ``spp`` (default 1), for plain Mitsuba, which does not call
        :func:`attach`. Raises ``RuntimeError``.
        """
        names = ("sensor_to_world", "fov", "resolution", "spp")
        given = [name for name in names if name in props]
        if not given:
            return None
        for name in names[:3]:
            if name not in given:
                raise RuntimeError(f'parameter "{name}": not given, it is needed beside "{given[0]}"')
        to_world = props["sensor_to_world"]
        matrix = np.array(getattr(to_world, "matrix", np.nan), np.float64)
        if matrix.shape != (4, 4) or not np.allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-3):
            raise RuntimeError(
                'parameter "sensor_to_world": found a scale, or no transformation, allowed are rotation and translation'
            )
        fov, resolution, spp = (_number(props, name, 1.0) for name in names[1:])
        for name, value, low, high in (("fov", fov, 0, 180), ("resolution", resolution, 0, 1e9), ("spp", spp, 0, 1e9)):
            if not low < value < high:  # NaN, too
                raise RuntimeError(f'parameter "{name}": found {value:g}, allowed is more than {low}, below {high:g}')
        half = np.tan(np.radians(fov) / 2)
        step, reach = 2 * half / resolution, (1 + 2 * half**2) ** -0.75
        right, down, axis, origin = (matrix[:3, i] for i in range(4))
        return cls._opaque("perspective", origin, axis, -step * right, -step * down, spp, reach, 0.0)

    @classmethod
    def _opaque(cls, projection, origin, axis, dx, dy, spp, reach, lens) -> Cone:
        vectors = (dr.opaque(mi.Vector3f, [float(x) for x in v]) for v in (axis, dx, dy))
        numbers = (dr.opaque(mi.Float, float(x)) for x in (sample_scale(spp), reach, lens))
        return cls(projection, dr.opaque(mi.Point3f, [float(x) for x in origin]), *vectors, *numbers)

    @property
    def spread(self) -> mi.Float:
        """Width of a pixel along x, at depth 1 (2·tan(fov/2)/pixels), or at any depth if orthographic."""
        return dr.norm(self.dx)


def sample_scale(spp: float) -> float:
    """Return the width of a sample's footprint relative to the pixel's: max(1/8, 1/√spp), as in pbrt-v4."""
    return float(max(1 / 8, 1 / np.sqrt(max(spp, 1))))


def _number(props: mi.Properties, name: str, default: float) -> float:
    try:
        return float(props.get(name, default))
    except (TypeError, ValueError):
        raise RuntimeError(f'parameter "{name}": found {props[name]}, a number is needed') from None


def footprint(si: mi.SurfaceInteraction3f, cone: Cone | None = None) -> tuple[mi.Vector2f, mi.Vector2f]:
    """Return the footprint at a hit: ``ddx, ddy`` in the surface's uv, before any ``to_uv``. It is always finite.

    In each lane, the first of these sources counts that is neither zero nor infinite nor NaN: the partial derivatives
    ``si.duv_dx`` and ``si.duv_dy``, if an integrator filled them; the ``cone`` (:func:`seen_by`). Without any, infinite
    values of the last source are limited to :data:`LARGEST`, and NaN or no source at all is 0, the sharpest footprint.
    """
    ddx, ddy = (mi.Vector2f(0), mi.Vector2f(0)) if cone is None else seen_by(cone, si)
    x, y = dr.detach(si.duv_dx), dr.detach(si.duv_dy)
    size = _size(x, y)
    valid = (size > 0) & (size < dr.inf)  # NaN: false
    valid |= _size(ddx, ddy) == 0
    return dr.select(valid, _finite(x), ddx), dr.select(valid, _finite(y), ddy)


def seen_by(cone: Cone, si: mi.SurfaceInteraction3f) -> tuple[mi.Vector2f, mi.Vector2f]:
    """Return the footprint of a sensor's sample, from the position of the hit alone.

    A direct hit: the steps of a pixel are projected along the line of sight onto the plane of dp_du and dp_dv. With the
    distance t, the cosine z between the line and the sensor's axis, and the angle θ between the line and the normal,
    the area is exactly (spread · t)² z³ / (|dp_du × dp_dv| cos θ).

    An indirect hit, where ``si.wi`` does not point to the sensor, gets a lower estimate: the larger of two footprints,
    both as wide as the pixel at the film's corner. The first comes along ``si.wi`` over the distance ``si.t``, the last
    segment of the path; the second comes over the distance of the sensor onto a surface that faces it, which is
    pbrt-v4's ``Camera::Approximate_dp_dxy`` but never oblique. Paths over flat mirrors are longer than either, and
    curved mirrors and rough bounces widen the footprint; only after concave mirrors and lenses may the true footprint
    be smaller. If dp_du and dp_dv are parallel or zero, the footprint is zero.
    """
    du, dv = dr.detach(si.dp_du), dr.detach(si.dp_dv)
    unit = dr.normalize(dr.cross(du, dv))
    direct, to, distance, depth = _line_of_sight(cone, si)
    last, incident = dr.detach(si.t), dr.detach(si.sh_frame).to_world(dr.detach(si.wi))
    oblique = dr.abs(dr.dot(incident, unit))
    by_last = dr.square(last) > dr.square(distance) * oblique
    if cone.projection == "orthographic":  # a pixel is as wide at any distance
        by_last, last = mi.Bool(True), distance
    along = dr.select(direct, to, dr.select(by_last, incident, unit))
    frame = mi.Frame3f(along)
    facing = dr.select(by_last, last, distance) * cone.reach * cone.scale * cone.spread
    x = dr.select(direct, depth * cone.scale * cone.dx, facing * frame.s)
    y = dr.select(direct, depth * cone.scale * cone.dy, facing * frame.t)
    return in_uv(x, y, along, du, dv)


def _line_of_sight(cone: Cone, si) -> tuple:
    """Return whether a sensor sees a hit directly, the direction to the hit, and its distance and depth.

    With an orthographic sensor, distance and depth are 1.
    """
    if cone.projection == "orthographic":
        to, distance, depth, tolerance = cone.axis, mi.Float(1), mi.Float(1), mi.Float(STRAIGHT)
    else:
        to = dr.detach(si.p) - cone.origin
        distance, depth = dr.norm(to), dr.dot(to, cone.axis)
        to = to * dr.rcp(distance)
        tolerance = STRAIGHT + cone.lens * dr.rcp(distance)
    # A two-sided material may have flipped si.wi, so that the sign of z has no meaning
    local, wi = dr.detach(si.sh_frame).to_local(to), dr.detach(si.wi)
    away = mi.Vector3f(local.x + wi.x, local.y + wi.y, dr.abs(local.z) - dr.abs(wi.z))
    return (dr.squared_norm(away) < dr.square(tolerance)) & (depth > 0), to, distance, depth


def to_centre(cone: Cone | None, si: mi.SurfaceInteraction3f, ddx, ddy) -> mi.Vector2f:
    """Return the offset in uv from a hit to the place seen at the centre of its pixel.

    It removes the jitter of a sample that is the only one of its pixel. It is zero for indirect hits, for several
    samples per pixel, and for sensors with a lens.
    """
    if cone is None or cone.corner is None:
        return mi.Vector2f(0)
    direct, _, _, depth = _line_of_sight(cone, si)
    place = (dr.detach(si.p) - cone.origin) * dr.rcp(depth) - cone.corner
    steps = (dr.dot(place, v) * dr.rcp(dr.squared_norm(v)) for v in (cone.dx, cone.dy))
    x, y = (0.5 - (v - dr.floor(v)) for v in steps)
    return dr.select(direct, ddx * x + ddy * y, 0)


def in_uv(x, y, along, du, dv) -> tuple[mi.Vector2f, mi.Vector2f]:
    """Project the vectors ``x`` and ``y`` along a direction onto the plane of ``du`` and ``dv``, and return them in uv.

    Components are limited to ± :data:`LARGEST`; they are zero where du and dv are parallel or zero, or a value is NaN.
    """
    normal = dr.cross(du, dv)
    defined = dr.squared_norm(normal) > PARALLEL**2 * dr.squared_norm(du) * dr.squared_norm(dv)  # NaN, underflow: false
    # x + λ·along = u·du + v·dv, by Cramer's rule
    volume = dr.dot(normal, along)
    inverse = dr.rcp(dr.select(dr.abs(volume) < 1e-30, 1e-30, volume))
    to_u, to_v = dr.cross(dv, along), dr.cross(along, du)
    projected = (mi.Vector2f(dr.dot(v, to_u), dr.dot(v, to_v)) * inverse for v in (x, y))
    return tuple(dr.select(defined, _finite(v), 0) for v in projected)


def _size(ddx, ddy):
    """Return the largest absolute component of both, infinite or NaN if one is."""
    return dr.maximum(dr.maximum(dr.abs(ddx.x), dr.abs(ddx.y)), dr.maximum(dr.abs(ddy.x), dr.abs(ddy.y)))


def _finite(v: mi.Vector2f) -> mi.Vector2f:
    """Clamp a vector to ± :data:`LARGEST`, NaN to 0."""
    return dr.select(dr.isnan(v), 0, dr.clip(v, -LARGEST, LARGEST))


def transform(ddx: mi.Vector2f, ddy: mi.Vector2f, matrix) -> tuple[mi.Vector2f, mi.Vector2f]:
    """Apply ``to_uv`` to a footprint in uv; ``matrix``, 3 × 3, is a list of its rows."""
    (a, b), (c, d) = (tuple(row)[:2] for row in tuple(matrix)[:2])
    return tuple(mi.Vector2f(dr.fma(a, v.x, b * v.y), dr.fma(c, v.x, d * v.y)) for v in (ddx, ddy))


def area(ddx: mi.Vector2f, ddy: mi.Vector2f) -> mi.Float:
    """Return |det| in uv², the area of the parallelogram (4/π of the ellipse); its root is a square pixel's side."""
    ddx, ddy = _finite(ddx), _finite(ddy)
    return dr.abs(ddx.x * ddy.y - ddx.y * ddy.x)


def axes(ddx: mi.Vector2f, ddy: mi.Vector2f) -> tuple[mi.Float, mi.Float, mi.Vector2f]:
    """Return the full lengths ≥ 0 in uv of the ellipse's major and minor axis, and the unit vector of the major axis.

    For a circle, the vector is (1, 0). All are finite; major · minor is :func:`area`.
    """
    ddx, ddy = _finite(ddx), _finite(ddy)
    major, direction = _major(*_moments(ddx, ddy))
    return major, dr.select(major > 0, dr.minimum(area(ddx, ddy) / major, major), 0), direction


def add_moments(ddx: mi.Vector2f, ddy: mi.Vector2f, s: mi.Vector2f, t: mi.Vector2f) -> tuple[mi.Vector2f, mi.Vector2f]:
    """Return the axes, major first, of two footprints blurred by each other: the second moments are added."""
    ddx, ddy, s, t = (_finite(v) for v in (ddx, ddy, s, t))
    p, q, r = (a + b for a, b in zip(_moments(ddx, ddy), _moments(s, t), strict=True))
    major, direction = _major(p, q, r)
    # The determinant by Cauchy and Binet, without cancellation
    det2 = sum(dr.square(a.x * b.y - a.y * b.x) for a, b in combinations((ddx, ddy, s, t), 2))
    minor = dr.select(major > 0, dr.minimum(dr.sqrt(det2) / major, major), 0)
    return major * direction, minor * mi.Vector2f(-direction.y, direction.x)


def _moments(ddx, ddy) -> tuple:
    """Return the sums over both diameters of the second moments uu, uv and vv."""
    uu, vv = dr.fma(ddx.x, ddx.x, dr.square(ddy.x)), dr.fma(ddx.y, ddx.y, dr.square(ddy.y))
    return uu, dr.fma(ddx.x, ddx.y, ddy.x * ddy.y), vv


def _major(p, q, r) -> tuple:
    """Return length and unit vector of the major axis of the ellipse with these moments; (1, 0) for a circle."""
    half = 0.5 * (p - r)
    root = dr.sqrt(dr.fma(half, half, q * q))
    wide = half >= 0
    x, y = dr.select(wide, half + root, q), dr.select(wide, q, root - half)
    length2 = dr.fma(x, x, y * y)
    elongated = length2 > 0
    inverse = dr.rsqrt(dr.select(elongated, length2, 1))
    direction = mi.Vector2f(dr.select(elongated, x * inverse, 1), dr.select(elongated, y * inverse, 0))
    return dr.sqrt(0.5 * (p + r) + root), direction


def textures(scene: mi.Scene) -> list:
    """Return the textures of a loaded scene that have a method ``set_cone(cone)``, each once."""
    return [node for node in compat.scene_objects(scene) if hasattr(node, "set_cone")]


def attach(scene: mi.Scene, sensor: int | mi.Sensor = 0, spp: int | None = None) -> int:
    """Set the cone of all textures of a loaded scene that use one (:func:`textures`), and return their number.

    ``spp`` is the number of samples per pixel (default: that of the sampler). Call again after a change of the sensor
    or of the samples. Without a supported sensor (:meth:`Cone.from_sensor`) the cone is ``None``, with a warning if
    there is an unsupported one.
    """
    filtering = textures(scene)
    if not filtering:
        return 0
    cone = None
    try:
        if isinstance(sensor, int):
            sensor = scene.sensors()[sensor] if scene.sensors() else None
        if sensor is not None:
            cone = Cone.from_sensor(sensor, spp)
    except RuntimeError as e:
        mi.Log(mi.LogLevel.Warn, f"textures are not filtered: {e}")
        omissions.settle(filtering)
    for texture in filtering:
        texture.set_cone(cone)
        _attached[texture] = (0, "") if cone is None else (id(sensor), sensor.id())
    omissions.recheck()
    if cone is not None:
        check_samples(filtering, sensor.sampler().sample_count() if spp is None else spp)
    return len(filtering)


def check_samples(textures, spp: int) -> None:
    """Warn, once a file and number, of textures that ``fit scene`` trained for other samples per pixel than ``spp``."""
    for texture in textures:
        table = texture.trained()[0] if hasattr(texture, "trained") else None
        settings = {} if table is None or table.settings.get("kept_start") else table.settings.get("shading", {})
        trained = settings.get("spp", spp) if isinstance(settings, dict) else spp
        most = settings["footprints"][-1] if "footprints" in settings else trained
        if not trained <= spp <= most and (key := (table.path, trained, spp)) not in _warned:
            _warned.add(key)
            warn(f"{table.path}: was trained for spp={trained}, found spp={spp}: fit scene --spp {spp} trains for that")


#: Files with the samples that they were trained and rendered with, warned of by :func:`check_samples`.
_warned: set[tuple] = set()


def attached_sensor(texture) -> tuple[int, str]:
    """Return the ``id`` in Python, and that in the scene, of the sensor that a texture got from :func:`attach`.

    They are 0 and "" if it got none.
    """
    return _attached.get(texture, (0, ""))


#: Texture → :func:`attached_sensor`.
_attached: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()


#: Largest angle that a rough bounce adds to a sample's cone, in rad. The full angle of a diffuse lobe would be 1.8, and
#: would blur textures so much that colour bleeds from places that send no light.
WIDEST = 0.5

#: Smallest absolute value of cosines in denominators.
GRAZING = 1e-4


@dataclass  # a type that loops of Dr.Jit accept as state
class Differentials:
    """Differentials of the rays of a wavefront.

    A step in x or y adds ``ox`` or ``oy`` to the origin and ``dx`` or ``dy`` to the direction, all ``mi.Vector3f``.
    Rough bounces add a cone around the ray, which is ``width`` wide at the origin and grows by ``spread`` per unit of
    length.
    """

    ox: mi.Vector3f
    oy: mi.Vector3f
    dx: mi.Vector3f
    dy: mi.Vector3f
    width: mi.Float
    spread: mi.Float

    @classmethod
    def from_ray(cls, ray) -> Differentials:
        """Return those of a sensor's rays (``mi.RayDifferential3f``, scaled for samples); zero for other rays."""
        if not (hasattr(ray, "d_x") and ray.has_differentials):
            return cls(*(mi.Vector3f(0) for _ in range(4)), mi.Float(0), mi.Float(0))
        ray = dr.detach(ray)
        differences = (ray.o_x - ray.o, ray.o_y - ray.o, ray.d_x - ray.d, ray.d_y - ray.d)
        return cls(*(mi.Vector3f(v) for v in differences), mi.Float(0), mi.Float(0))

    def at(self, ray, si) -> Differentials:
        """Return the differentials at a hit.

        ``ox`` and ``oy`` are the shifts of the place on the tangent plane, ``width`` is the width of the cone there,
        perpendicular to the ray.
        """
        n, d, t = mi.Vector3f(dr.detach(si.n)), dr.detach(ray.d), dr.select(si.is_valid(), dr.detach(si.t), 0)
        cosine = _away_from_zero(dr.dot(n, d))

        def moved(o, v):
            o = o + t * v
            return o - d * (dr.dot(n, o) / cosine)

        return replace(
            self, ox=moved(self.ox, self.dx), oy=moved(self.oy, self.dy), width=dr.fma(self.spread, t, self.width)
        )

    def footprint(self, ray, si) -> tuple[mi.Vector2f, mi.Vector2f]:
        """Return the footprint ``ddx, ddy`` in uv at a hit (:meth:`at`).

        The second moments of the steps' parallelogram and of the cone's disc are added.
        """
        du, dv = dr.detach(si.dp_du), dr.detach(si.dp_dv)
        ddx, ddy = in_uv(self.ox, self.oy, ray.d, du, dv)
        frame = mi.Frame3f(ray.d)
        s, t = in_uv(self.width * frame.s, self.width * frame.t, ray.d, du, dv)
        both = add_moments(ddx, ddy, s, t)
        wide = self.width > 0
        return dr.select(wide, both[0], ddx), dr.select(wide, both[1], ddy)

    def bounce(self, ray, si, wo, eta, pdf, delta, scale, edges) -> Differentials:
        """Return the differentials after a bounce at a hit (:meth:`at`) into the direction ``wo`` (world space).

        ``pdf`` is the density of the direction per solid angle, unless it is the only one (``delta``); ``eta`` is the
        relative index of refraction in that direction; ``scale`` is the scale of a sample's footprint.

        The bounce is treated as that of a mirror, or of a smooth boundary, with the normal that maps one direction to
        the other: a shading normal, a mapped normal or the normal of a microfacet. Its curvature is that of the
        surface: ``dn_du`` and ``dn_dv`` belong to the ``edges`` (:func:`mi_diffind.core.compat.normal_edges`). Without
        ``delta``, the ``spread`` s of the cone grows to √(s² + a²) with a² = scale² / pdf, the solid angle of one
        sample's share of the lobe; a is at most :data:`WIDEST`.
        """
        d, wo, outward = dr.detach(ray.d), dr.detach(wo), mi.Vector3f(dr.detach(si.sh_frame.n))
        ratio = dr.select(eta > 0, dr.rcp(eta), 1)
        # ratio · d − wo is parallel to the normal; it is zero for an undeflected ray, where any normal is valid
        normal = ratio * d - wo
        length2 = dr.squared_norm(normal)
        normal = dr.select(length2 > 1e-8, normal * dr.rsqrt(length2), outward)
        normal = dr.mulsign(normal, dr.dot(normal, outward))
        before, after = dr.dot(d, normal), dr.dot(wo, normal)
        bend = ratio * before - after
        slope = ratio - ratio * ratio * before / _away_from_zero(after)

        turned = []
        coefficients = in_uv(self.ox, self.oy, outward, *edges)
        for v, uv in zip((self.dx, self.dy), coefficients, strict=True):
            dn = dr.detach(si.dn_du) * uv.x + dr.detach(si.dn_dv) * uv.y
            dn = dn - normal * dr.dot(normal, dn)
            v = ratio * v - bend * dn - slope * (dr.dot(v, normal) + dr.dot(d, dn)) * normal
            turned.append(dr.select(dr.isfinite(dr.squared_norm(v)), v, 0))
        angle2 = dr.select(delta | ~(pdf > 0), 0, dr.minimum(dr.square(scale) / pdf, WIDEST**2))
        return replace(self, dx=turned[0], dy=turned[1], spread=dr.sqrt(dr.fma(self.spread, self.spread, angle2)))


def _away_from_zero(cosine):
    return dr.select(dr.abs(cosine) < GRAZING, dr.mulsign(mi.Float(GRAZING), cosine), cosine)
