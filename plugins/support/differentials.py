"""Ray differentials along a path: the shift of a ray for a step of one sample's width in x and in y on the film.

After Igehy, *Tracing Ray Differentials*, SIGGRAPH 1999, with one formula for reflection and refraction; the rule for
rough bounces is our own (:meth:`Differentials.bounced`). All values are detached.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from . import footprint

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
    def of(cls, ray) -> Differentials:
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
        ddx, ddy = footprint.in_uv(self.ox, self.oy, ray.d, du, dv)
        frame = mi.Frame3f(ray.d)
        s, t = footprint.in_uv(self.width * frame.s, self.width * frame.t, ray.d, du, dv)
        both = footprint.joined(ddx, ddy, s, t)
        wide = self.width > 0
        return dr.select(wide, both[0], ddx), dr.select(wide, both[1], ddy)

    def bounced(self, ray, si, wo, eta, pdf, delta, scale, edges) -> Differentials:
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
        coefficients = footprint.in_uv(self.ox, self.oy, outward, *edges)
        for v, uv in zip((self.dx, self.dy), coefficients, strict=True):
            dn = dr.detach(si.dn_du) * uv.x + dr.detach(si.dn_dv) * uv.y
            dn = dn - normal * dr.dot(normal, dn)
            v = ratio * v - bend * dn - slope * (dr.dot(v, normal) + dr.dot(d, dn)) * normal
            turned.append(dr.select(dr.isfinite(dr.squared_norm(v)), v, 0))
        angle2 = dr.select(delta | ~(pdf > 0), 0, dr.minimum(dr.square(scale) / pdf, WIDEST**2))
        return replace(self, dx=turned[0], dy=turned[1], spread=dr.sqrt(dr.fma(self.spread, self.spread, angle2)))


def _away_from_zero(cosine):
    return dr.select(dr.abs(cosine) < GRAZING, dr.mulsign(mi.Float(GRAZING), cosine), cosine)
