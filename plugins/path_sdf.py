"""Path tracer for scenes with signed distance fields."""

from __future__ import annotations  # Delayed parsing of type annotations

from functools import cache

import drjit as dr
import mitsuba as mi

from mi_diffind.core import compat
from mi_diffind.core.compat import ray_flags

from . import Plugin, path_footprint
from .path_footprint import power_heuristic, relative
from .support import distance_shapes as sdf
from .support.manual import shared_parts

MANUAL = r"""
.. _integrator-path_sdf:

Path tracer for signed distance fields (:monosp:`path_sdf`)
-----------------------------------------------------------

.. pluginparameters::

 * - max_depth, rr_depth, hide_emitters, jitter
   - |int|, |int|, |bool|, |bool|
   - The same as for :monosp:`path_footprint`. (Default: -1, 5, false, true)
   - --

Path tracer for scenes in which a :monosp:`neural_sdf` is traced as it is stored. The estimator is that of
:monosp:`path`: any BSDF, all emitters, both sampled and weighted by the power heuristic. Ordinary shapes and any number
of fields mix: the nearest hit wins, and either kind of shape blocks, reflects and refracts light. A scene without a
field is rendered by :monosp:`path_footprint`, footprints included; in a scene with one, textures see no footprints.

**Rays** skip the empty regions of a sparse field by its masks. In a block they go to where its surface may begin, and
read only cells that the surface crosses. Fields of the other layouts are sphere-traced (Hart, *Sphere Tracing*, The
Visual Computer 1996): a step is the distance divided by a bound of the field's slope, at least :math:`10^{-4}` of the
longest side. A hit is where the sign differs from that at the start, so cameras may be within a solid; the place
between the last sign and the next is found by false position. Secondary rays start :math:`3 \cdot 10^{-4}` of the
longest side off the surface: walls thinner than that are not reliable. They start from the hit in the frame of the
field, with the digits that single precision rounds off in the world: a solid that is moved :math:`10^4` times its size
from the origin looks the same. Seen from :math:`10^3` times its size away, a solid's hits are precise to
:math:`10^{-4}` of the size, which is single precision.

**Glass** needs a large ``max_depth``. The normals of a field are a fraction of a degree off, as those of flat triangles
are: light that enters a round solid at grazing incidence is then totally reflected within it, often hundreds of times.
Of a glass ball under a white sky, some pixels are too dark with a ``max_depth`` of 16, as they are of a mesh of flat
triangles. With 1000, none is, and every path has the weight 1.

**Derivatives** are computed by path replay with respect to materials, textures, emitters, the ``to_world`` of fields
and, with ``storage`` ``float32``, their arrays: hits move along their rays by the implicit function theorem, and
normals, cosines and the solid angles between vertices follow. The derivatives are those of *interiors*: where the
outline of a solid, its shadow or its image in a mirror moves over a pixel, radiance jumps, and this part of the
derivative is missing. An optimisation from images therefore learns from shading, not from silhouettes; masks, or a loss
on the field itself, have to compensate. A warning says where all derivatives of a shape are zero. Ordinary shapes are
constants, and so are places seen in smooth mirrors and through smooth glass. Polarised variants and media are not
supported.

{executable}

.. tabs::
    .. code-tab:: xml
        :name: path_sdf

        <integrator type="path_sdf">
            <integer name="max_depth" value="8"/>
        </integrator>

    .. code-tab:: python

        'type': 'path_sdf',
        'max_depth': 8
"""


def solid_angle(origin, place, normal):
    """Return the solid angle of a unit of area at ``place``, seen from ``origin``."""
    to = place - origin
    squared = dr.squared_norm(to)
    return dr.abs(dr.dot(to, normal)) * dr.rcp(squared * dr.sqrt(squared))


@cache
def integrator() -> type:
    """Return the integrator's class in the current variant."""

    @shared_parts
    class PathSDF(path_footprint.integrator()):
        __doc__ = MANUAL

        def to_string(self) -> str:
            return super().to_string().replace("PathFootprint", "PathSDF", 1)

        def sample(self, mode, scene, *args, **kwargs):
            """See ``ADIntegrator.sample``. A scene without distance shapes is rendered by ``path_footprint``."""
            shapes = sdf.distance_shapes_in(scene)
            if not shapes:
                return super().sample(mode, scene, *args, **kwargs)
            return self.sample_shapes(mode, scene, shapes, *args, **kwargs)

        def render_backward(self, scene, params, grad_in, *args, **kwargs):
            """See ``ADIntegrator.render_backward``. Warns of a shape without derivatives."""
            super().render_backward(scene, params, grad_in, *args, **kwargs)
            sdf.check_derivatives(sdf.distance_shapes_in(scene), grad_in)

        def intersect(self, scene, shapes, ray, coherent, active, rest):
            """Return the nearest hit, of an ordinary shape or of a distance shape; the other one is not valid."""
            pi = scene.ray_intersect_preliminary(ray, coherent=coherent, active=active)
            return self.nearer(shapes, ray, pi, active, rest)

        def nearer(self, shapes, ray, pi, active, rest=0):
            hit = sdf.intersect(shapes, ray.o, ray.d, dr.minimum(pi.t, ray.maxt), active, rest)
            pi.t = dr.select(hit.number > 0, dr.inf, pi.t)
            return pi, hit

        def interaction(self, shapes, ray, pi, hit, active):
            """Return the surface interaction at the hit; ordinary shapes are not differentiated."""
            with dr.suspend_grad():
                si = pi.compute_surface_interaction(ray, ray_flags=ray_flags(), active=active)
            return sdf.interaction(shapes, hit, ray, si, active)

        @compat.syntax
        def sample_shapes(self, mode, scene, shapes, sampler, ray, δL=None, state_in=None, active=True, **kwargs):
            """Implement ``sample`` for a scene with distance shapes; see ``path_footprint``."""
            primal = mode == dr.ADMode.Primal
            moving = not primal and any(shape.optimised() for shape in shapes)
            environment = scene.environment() is not None and not self.hide_emitters
            context = mi.BSDFContext()

            ray = mi.Ray3f(dr.detach(ray))
            active = mi.Bool(active)
            valid = mi.Bool(environment)
            depth = mi.UInt32(0)
            L = mi.Spectrum(0 if primal else state_in)
            δL = mi.Spectrum(0 if δL is None else δL)
            throughput = mi.Spectrum(1)
            eta = mi.Float(1)
            before = dr.zeros(mi.SurfaceInteraction3f)
            density = mi.Float(1)
            delta = mi.Bool(True)

            pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
            if dr.hint(self.hide_emitters, mode="scalar"):
                hidden = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711  (lane by lane)
                at = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, hidden)
                after = self.skip_area_emitters(scene, at.spawn_ray(ray.d), True, hidden)
                after.t += at.t
                pi[hidden] = after
            pi, hit = self.nearer(shapes, ray, pi, active)
            before_ray, before_hit = mi.Ray3f(ray), dr.zeros(sdf.ShapeHit)  # of the vertex before

            while dr.hint(active, max_iterations=self.max_depth, label=f"path_sdf ({mode.name})"):
                with dr.resume_grad(when=moving):
                    si = self.interaction(shapes, ray, pi, hit, active)
                    if dr.hint(moving, mode="scalar"):
                        # Seen from the vertex before, which also moves
                        aside = sdf.shift(shapes, before_hit, before_ray.d, active & si.is_valid())
                        turn = aside - ray.d * dr.dot(aside, ray.d)
                        si.wi += dr.detach(si.sh_frame).to_local(turn) * dr.rcp(dr.select(si.is_valid(), si.t, 1))
                fixed = dr.detach(si)
                bsdf = si.bsdf(ray)

                # Emission, weighted against having sampled the emitter at the vertex before
                shown = active
                if dr.hint(self.hide_emitters, mode="scalar"):
                    shown &= (depth > 0) | si.is_valid()
                ds = mi.DirectionSample3f(scene, fixed, before)
                weight = power_heuristic(density, scene.pdf_emitter_direction(before, ds, shown & ~delta))
                with dr.resume_grad(when=not primal):
                    emitted = throughput * weight * ds.emitter.eval(fixed, shown)

                # Light from an emitter, and the next direction
                going = active & si.is_valid() & (depth + 1 < self.max_depth)
                lit = going & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                ds, emitter_weight = scene.sample_emitter_direction(fixed, sampler.next_2d(), True, lit)
                lit &= ds.pdf != 0
                lit &= ~sdf.occluded_from(shapes, hit, fixed, ds, lit)
                with dr.resume_grad(when=not primal):
                    factor = mi.Float(1)
                    if dr.hint(moving, mode="scalar"):
                        # Points of emitters stay fixed, and so do directions to infinite ones
                        flags = ds.emitter.flags()
                        finite = ~mi.has_flag(flags, mi.EmitterFlags.Infinite)
                        away = dr.norm(ds.p - si.p)
                        toward = dr.select(finite, (ds.p - si.p) / away, ds.d)
                        ds.d = dr.replace_grad(ds.d, toward)
                        ds.dist = dr.replace_grad(ds.dist, dr.select(finite, away, ds.dist))
                        if mi.has_flag(flags, mi.EmitterFlags.Surface):
                            factor = relative(solid_angle(si.p, ds.p, ds.n))
                    if dr.hint(not primal, mode="scalar"):
                        value = scene.eval_emitter_direction(si, ds, lit) * dr.select(lit, dr.rcp(ds.pdf), 0)
                        emitter_weight = dr.replace_grad(emitter_weight, value) * factor
                    # Together with the next direction: the textures of a material are read once
                    bsdf_value, bsdf_pdf, bs, bsdf_weight = bsdf.eval_pdf_sample(
                        context, si, si.to_local(ds.d), sampler.next_1d(), sampler.next_2d(), going
                    )
                    weight = dr.select(ds.delta, 1, power_heuristic(ds.pdf, dr.detach(bsdf_pdf)))
                    direct = dr.select(lit, throughput * weight * bsdf_value * emitter_weight, 0)
                bs = dr.detach(bs)
                delta_next = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
                L = L + emitted + direct if primal else L - dr.detach(emitted + direct)
                out = fixed.to_world(bs.wo)
                following = fixed.spawn_ray(out)
                following.o, rest = sdf.spawn(shapes, hit, fixed, out)
                valid |= active & si.is_valid() & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)

                # Russian roulette: undo the change of radiance by η² at a boundary
                passed = throughput * dr.detach(bsdf_weight)
                eta *= bs.eta
                largest = dr.max(passed)
                survival = dr.minimum(largest * dr.square(eta), 0.95)
                roulette = depth >= self.rr_depth
                survives = sampler.next_1d() < survival
                passed[roulette] *= dr.rcp(survival)
                further = going & (largest != 0) & (~roulette | survives)
                pi_next, hit_next = self.intersect(scene, shapes, following, False, further, rest)

                if dr.hint(not primal, mode="scalar"):
                    factor, wo = mi.Float(1), bs.wo
                    if dr.hint(moving, mode="scalar"):
                        # The next vertex stays fixed, or the direction if there is none
                        target = self.interaction(shapes, following, pi_next, hit_next, further)
                        bound = further & target.is_valid()
                        with dr.resume_grad():
                            toward = dr.select(bound, dr.normalize(target.p - si.p), out)
                            wo = dr.replace_grad(bs.wo, si.to_local(toward))
                            factor = dr.select(bound, relative(solid_angle(si.p, target.p, target.n)), 1)
                    with dr.resume_grad():
                        # A smooth mirror cannot be evaluated: its weight is differentiated instead
                        smooth = bsdf.eval(context, si, wo, going & ~delta_next)
                        reflected = L * dr.select(delta_next, relative(bsdf_weight), relative(smooth) * factor)
                        contribution = emitted + direct + dr.select(going, reflected, 0)
                        if dr.hint(mode == dr.ADMode.Backward, mode="scalar"):
                            dr.backward_from(δL * contribution)
                        else:
                            δL += dr.forward_to(contribution)

                before = fixed
                throughput = passed
                density = bs.pdf
                delta = delta_next
                depth[going] += 1
                before_ray, before_hit = ray, hit
                ray, pi, hit, active = following, pi_next, hit_next, further

            shown = dr.select(valid, L, 0) if primal else δL
            return shown, valid, [], L

    return PathSDF


PLUGIN = Plugin("path_sdf", "integrator", lambda props: integrator()(props))
