"""
Ray differentials: how the ray of a sample moves with a step of the sample's width in x and in y on the film, along a
whole path. After Igehy, *Tracing Ray Differentials*, SIGGRAPH 1999, with one formula for reflection and refraction;
what rough bounces do to them is a rule of ours (:meth:`Differentials.bounced`). Everything is detached.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from . import footprint

#: What a rough bounce adds, at most, to the angle of a sample's cone, rad. A diffuse lobe would be 1.8 wide, and what
#: is seen through it so blurred that colour would bleed from where no light comes.
WIDEST = 0.5

#: Cosines that something is divided by are at least so far from 0.
GRAZING = 1e-4


@dataclass  # which is what loops of Dr.Jit take for state
class Differentials:
    """
    Of the rays of a wavefront: what a step in x and y adds to their origins ``ox``, ``oy``, and to their directions
    ``dx``, ``dy``, all ``mi.Vector3f``; and a cone around them, of ``width`` at the origin, that grows by ``spread``
    per unit of length: what rough bounces did.
    """

    ox: mi.Vector3f
    oy: mi.Vector3f
    dx: mi.Vector3f
    dy: mi.Vector3f
    width: mi.Float
    spread: mi.Float

    @classmethod
    def of(cls, ray) -> Differentials:
        """Of rays of a sensor (``mi.RayDifferential3f``, scaled as the samples are); zero of any others."""
        if not (hasattr(ray, "d_x") and ray.has_differentials):
            return cls(*(mi.Vector3f(0) for _ in range(4)), mi.Float(0), mi.Float(0))
        ray = dr.detach(ray)
        differences = (ray.o_x - ray.o, ray.o_y - ray.o, ray.d_x - ray.d, ray.d_y - ray.d)
        return cls(*(mi.Vector3f(v) for v in differences), mi.Float(0), mi.Float(0))

    def at(self, ray, si) -> Differentials:
        """
        At a hit: what the steps add to the place on the tangent plane is now in ``ox``, ``oy``, and ``width`` is that
        of the cone there, across the ray.
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
        """
        At a hit (:meth:`at`): ``ddx, ddy`` in uv (:func:`.footprint.footprint`). The steps' parallelogram and the
        cone's disc add up as their second moments do.
        """
        du, dv = dr.detach(si.dp_du), dr.detach(si.dp_dv)
        ddx, ddy = footprint.in_uv(self.ox, self.oy, ray.d, du, dv)
        frame = mi.Frame3f(ray.d)
        s, t = footprint.in_uv(self.width * frame.s, self.width * frame.t, ray.d, du, dv)
        both = footprint.joined(ddx, ddy, s, t)
        wide = self.width > 0
        return dr.select(wide, both[0], ddx), dr.select(wide, both[1], ddy)

    def bounced(self, ray, si, wo, eta, pdf, delta, scale, edges) -> Differentials:
        """
        From a hit (:meth:`at`) on, in the direction ``wo`` (world), which was sampled with the density ``pdf`` (per
        solid angle) or is the only one (``delta``); ``eta``, the relative index of refraction of what lies there.

        The bounce is taken as one at a mirror, or a smooth boundary, whose normal leads from the one direction to the
        other: a shading normal, a mapped one, or that of a microfacet. It curves as the surface does: ``dn_du`` and
        ``dn_dv`` belong to the ``edges`` (:func:`mi_diffind.compat.normal_edges`). If not ``delta``, the cone's
        ``spread`` s grows to √(s² + a²) with a² = scale² / pdf, the solid angle of a share of the lobe, limited to
        :data:`WIDEST`; ``scale`` as that of the samples.
        """
        d, wo, outward = dr.detach(ray.d), dr.detach(wo), mi.Vector3f(dr.detach(si.sh_frame.n))
        ratio = dr.select(eta > 0, dr.rcp(eta), 1)
        # ratio · d − wo is parallel to the normal; zero where the ray just goes on, and any normal will do
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
