"""Path tracer that carries ray differentials, for textures that filter themselves."""

from __future__ import annotations  # Delayed parsing of type annotations

from functools import cache

import drjit as dr
import mitsuba as mi

from mi_diffind.core import compat

from . import Plugin
from .support import footprint, omissions
from .support.differentials import Differentials
from .support.manual import shared_parts

#: ``max_depth`` where there is no limit.
INFINITE = 0xFFFFFFFF

MANUAL = r"""
.. _integrator-path_footprint:

Path tracer with footprints (:monosp:`path_footprint`)
------------------------------------------------------

.. pluginparameters::

 * - max_depth
   - |int|
   - Maximum path depth: 1 shows emitters only, 2 adds direct light, and so on; -1 is unlimited. (Default: -1)
   - --

 * - rr_depth
   - |int|
   - Depth from which Russian roulette may end a path. (Default: 5)
   - --

 * - hide_emitters
   - |bool|
   - Hide directly visible emitters. (Default: false)
   - --

 * - jitter
   - |bool|
   - Spread samples over the pixel. If false, all samples go through its centre, which suits one sample per pixel with
     textures that filter themselves. (Default: true)
   - --

A path tracer with the estimator of :monosp:`path`: emitters and BSDFs are sampled, and both are weighted by the power
heuristic. Along each path it carries *ray differentials* (Igehy, *Tracing Ray Differentials*, SIGGRAPH 1999). They
tell textures that filter themselves the size of the pixel at each hit, in the fields ``si.duv_dx`` and ``si.duv_dy``:
two conjugate diameters of its footprint in uv. Mirrors and smooth boundaries, plane and curved, bend the differentials
as they bend the ray, with both curvatures of the surface. For :math:`n` samples per pixel, differentials are scaled by
:math:`\max(1/8, 1/\sqrt n)`, as in pbrt-v4.

**Rough bounces** add a cone around the ray. Its angle is the scale above, divided by the square root of the density of
the sampled direction, and at most 0.5 rad: the square root of the solid angle of one sample's share of the lobe. The
cone's width grows linearly with distance, and later smooth surfaces do not change its angle. The second moments of the
cone's disc and of the differentials' parallelogram are added. The differentials are reflected by the mirror whose
normal lies half-way between the two directions.

**Differentials are carried only if a texture of the scene uses footprints**, that is, has a method ``set_cone(cone)``,
which is not called here. Shapes that do not provide the derivatives of their normals, such as :monosp:`sdfgrid`, count
as flat, and so do the details of normal and bump maps.

**Derivatives** with respect to materials, textures and emitters are computed by path replay (Vicini et al., *Path
Replay Backpropagation*, SIGGRAPH 2021). This includes smooth mirrors, except for parameters that decide which direction
is sampled. Footprints and geometry are constants: for derivatives of shapes, use :monosp:`prb_projective`. Polarised
variants are not supported.

{executable}

.. tabs::
    .. code-tab:: xml
        :name: path_footprint

        <integrator type="path_footprint">
            <integer name="max_depth" value="8"/>
        </integrator>

    .. code-tab:: python

        'type': 'path_footprint',
        'max_depth': 8
"""


class Centred:
    """Sampler whose first pair of numbers, the place in a pixel, is the centre; all others are unchanged."""

    def __init__(self, sampler: mi.Sampler):
        self._sampler, self._first = sampler, True

    def next_2d(self, active=True):
        sample = self._sampler.next_2d(active)
        first, self._first = self._first, False
        return mi.Point2f(0.5) if first else sample

    def __getattr__(self, name: str):
        return getattr(self._sampler, name)


def power_heuristic(a, b):
    """Return the weight of a sample of density ``a``, where another technique has the density ``b``."""
    return dr.select(a > 0, dr.rcp(1 + dr.square(b / a)), 0)


def relative(value):
    """Return 1 with the derivative of the logarithm of ``value``; 0 where ``value`` is 0."""
    detached = dr.detach(value)
    nonzero = detached != 0
    return dr.select(nonzero, value / dr.select(nonzero, detached, 1), 0)


@cache
def integrator() -> type:
    """Return the class for the variant that is set; its base class exists only after Mitsuba loaded this file."""

    @shared_parts
    class PathFootprint(compat.replay_integrator()):
        __doc__ = MANUAL

        #: Rays carry differentials, from which textures get footprints (:mod:`.filtered_texture`).
        gives_footprints = True

        #: Radiance fields between the surfaces (:class:`.field_light.FieldLight`), or ``None``.
        between = None

        def __init__(self, props: mi.Properties):
            for name, low in (("max_depth", -1), ("rr_depth", 1)):
                if name in props and (props.type(name) != mi.Properties.Type.Integer or props[name] < low):
                    raise RuntimeError(
                        f'parameter "{name}": found {props[name]}, allowed are whole numbers from {low} on'
                    )
            if mi.is_polarized:
                raise RuntimeError("path_footprint: does not run in polarised variants, where volpath does")
            super().__init__(props)
            if "max_depth" not in props:
                self.max_depth = INFINITE
            self.jitter = props.get("jitter", True)
            if not isinstance(self.jitter, bool):
                raise RuntimeError(f'parameter "jitter": found {self.jitter}, allowed are true and false')

        def to_string(self) -> str:
            depth = -1 if self.max_depth == INFINITE else self.max_depth
            return (
                f"PathFootprint[\n  max_depth = {depth},\n  rr_depth = {self.rr_depth},\n"
                f"  jitter = {str(self.jitter).lower()}\n]"
            )

        def render(self, scene, sensor=0, *args, **kwargs):
            """Render as Mitsuba does, with a warning of what would be left out of the image."""
            omissions.check(scene, self, sensor)
            return super().render(scene, sensor, *args, **kwargs)

        def sample_rays(self, scene, sensor, sampler):
            """Sample rays as Mitsuba does, but with differentials of samples in place of pixels."""
            ray, weight, place = super().sample_rays(scene, sensor, sampler if self.jitter else Centred(sampler))
            self.narrow(scene, sensor, sampler, ray)
            return ray, weight, place

        def narrow(self, scene, sensor, sampler, ray) -> None:
            """Change the differentials of camera rays from those of pixels to those of samples."""
            ray.has_differentials = len(footprint.textures(scene)) > 0
            if not ray.has_differentials:
                return
            scale = dr.opaque(mi.Float, footprint.scale_of(sampler.sample_count()))
            axis = sensor.world_transform() @ mi.Vector3f(0, 0, 1)
            # Rays start at the near clipping plane, and Mitsuba lets their neighbours start at the same point of it
            start = sensor.near_clip() / dr.dot(ray.d, dr.normalize(axis)) if hasattr(sensor, "near_clip") else 0
            for x in "xy":
                turn = (getattr(ray, f"d_{x}") - ray.d) * scale
                setattr(ray, f"o_{x}", ray.o + (getattr(ray, f"o_{x}") - ray.o) * scale + start * turn)
                setattr(ray, f"d_{x}", ray.d + turn)

        @compat.syntax
        def sample(self, mode, scene, sampler, ray, δL=None, state_in=None, active=True, **kwargs):
            """Trace paths; see ``ADIntegrator.sample``.

            In the differential phases, ``L`` is the radiance that is still to come at the current vertex; it starts as
            the radiance of the whole path (``state_in``).
            """
            primal, between = mode == dr.ADMode.Primal, self.between
            moving = not primal and between is not None and between.optimised()
            unattached = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad  # a field may be all that is optimised
            carried = bool(getattr(ray, "has_differentials", False))
            environment = scene.environment() is not None and not self.hide_emitters
            flags = compat.ray_flags(curvature=carried)
            context = mi.BSDFContext()
            scale = dr.opaque(mi.Float, footprint.scale_of(sampler.sample_count()))

            differentials = Differentials.of(ray)
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
            clear = mi.Float(1)  # transmittance of fields before the first surface that changes a ray

            pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
            if dr.hint(self.hide_emitters, mode="scalar"):
                hidden = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711  (lane by lane)
                at = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, hidden)
                pi[hidden] = self.skip_area_emitters(scene, at.spawn_ray(ray.d), True, hidden)

            while dr.hint(active, max_iterations=self.max_depth, label=f"path_footprint ({mode.name})"):
                si = pi.compute_surface_interaction(ray, ray_flags=flags, active=active)
                if dr.hint(carried, mode="scalar"):
                    differentials = differentials.at(ray, si)
                    si.duv_dx, si.duv_dy = differentials.footprint(ray, si)
                bsdf = si.bsdf(ray)

                # Emission, weighted against having sampled the emitter at the vertex before
                shown = active
                if dr.hint(self.hide_emitters, mode="scalar"):
                    # Fields are visible where the environment is not
                    shown &= (valid if between is not None else depth > 0) | si.is_valid()
                ds = mi.DirectionSample3f(scene, si, before)
                weight = power_heuristic(density, scene.pdf_emitter_direction(before, ds, shown & ~delta))
                with dr.resume_grad(when=not primal):
                    emitted = throughput * weight * ds.emitter.eval(si, shown)

                # Light from an emitter, and the next direction
                going = active & si.is_valid() & (depth + 1 < self.max_depth)
                smooth = going & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                lit = mi.Bool(smooth)
                ds, emitter_weight = scene.sample_emitter_direction(si, sampler.next_2d(), True, lit)
                lit &= ds.pdf != 0
                wo = si.to_local(ds.d)
                shadow, beam = mi.Float(1), mi.Ray3f(ray)
                if dr.hint(between is not None, mode="scalar"):
                    beam = si.spawn_ray_to(ds.p)
                    shadow = between.transmittance(beam, beam.maxt, lit)
                with dr.resume_grad(when=not primal):
                    if dr.hint(not primal, mode="scalar"):
                        value = scene.eval_emitter_direction(si, ds, lit) * dr.select(lit, dr.rcp(ds.pdf), 0)
                        emitter_weight = dr.replace_grad(emitter_weight, value)
                    # Together with the next direction: the textures of a material are read once
                    bsdf_value, bsdf_pdf, bs, bsdf_weight = bsdf.eval_pdf_sample(
                        context, si, wo, sampler.next_1d(), sampler.next_2d(), going
                    )
                    weight = dr.select(ds.delta, 1, power_heuristic(ds.pdf, dr.detach(bsdf_pdf)))
                    direct = dr.select(lit, throughput * weight * shadow * bsdf_value * emitter_weight, 0)
                if dr.hint(moving, mode="scalar"):
                    δL += between.derive(mode, beam, beam.maxt, lit, δL, mi.Spectrum(0), dr.detach(direct))
                if dr.hint(between is not None, mode="scalar"):
                    # Light from a field
                    toward, chance = between.sample(si.p, sampler.next_1d(), sampler.next_2d(), smooth)
                    smooth &= chance > 0
                    with dr.resume_grad(when=not primal):
                        bsdf_value, bsdf_pdf = bsdf.eval_pdf(context, si, si.to_local(toward), smooth)
                    smooth &= dr.max(dr.detach(bsdf_value)) > 0
                    beam = si.spawn_ray(toward)
                    far = scene.ray_intersect_preliminary(beam, coherent=False, active=smooth).t
                    shine, _ = between.cross(beam, far, smooth)
                    weight = power_heuristic(chance, dr.detach(bsdf_pdf)) * dr.rcp(chance)
                    weight = dr.select(smooth, throughput * weight, 0)
                    with dr.resume_grad(when=not primal):
                        direct += dr.select(smooth, weight * bsdf_value * shine, 0)
                    if dr.hint(moving, mode="scalar"):
                        weight = weight * dr.detach(bsdf_value)
                        δL += between.derive(mode, beam, far, smooth, δL, weight, weight * shine)
                bs = dr.detach(bs)
                delta_next = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
                L = L + emitted + direct if primal else L - dr.detach(emitted + direct)

                if dr.hint(not primal, mode="scalar"):
                    with dr.resume_grad():
                        # A smooth mirror cannot be evaluated: there, the weight itself is differentiated
                        rough = bsdf.eval(context, si, bs.wo, going & ~delta_next)
                        reflected = L * dr.select(delta_next, relative(bsdf_weight), relative(rough))
                        contribution = emitted + direct + dr.select(going, reflected, 0)
                        if dr.hint(mode == dr.ADMode.Backward, mode="scalar"):
                            dr.backward_from(δL * contribution, unattached)
                        else:
                            δL += dr.forward_to(contribution, flags=unattached)

                out = si.to_world(bs.wo)
                if dr.hint(carried, mode="scalar"):
                    edges = compat.normal_edges(pi, si, ray, going)
                    differentials = differentials.bounced(ray, si, out, bs.eta, bs.pdf, delta_next, scale, edges)
                valid |= active & si.is_valid() & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
                ray = si.spawn_ray(out)
                before = dr.detach(si)
                throughput *= dr.detach(bsdf_weight)
                eta *= bs.eta
                density = bs.pdf
                delta = delta_next

                # Russian roulette, without the factor η² of radiance at boundaries
                largest = dr.max(throughput)
                survival = dr.minimum(largest * dr.square(eta), 0.95)
                roulette = depth >= self.rr_depth
                survives = sampler.next_1d() < survival
                throughput[roulette] *= dr.rcp(survival)
                active = going & (largest != 0) & (~roulette | survives)
                depth[going] += 1
                pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)

                if dr.hint(between is not None, mode="scalar"):
                    # Fields up to the next surface, weighted against having sampled this direction towards them
                    shine, passed = between.cross(ray, pi.t, active)
                    weight = power_heuristic(density, between.density(before.p, ray.d, active & ~delta))
                    weight = dr.select(active, throughput * weight, 0)
                    if dr.hint(moving, mode="scalar"):
                        δL += between.derive(mode, ray, pi.t, active, δL, weight, L)
                    shine = dr.select(active, weight * shine, 0)
                    L = L + shine if primal else L - shine
                    clear = dr.select(active & ~valid, clear * passed, clear)
                    throughput *= dr.select(active, passed, 1)
                    active &= passed > 0

            visible = L if between is not None else dr.select(valid, L, 0)
            result = visible if primal else δL
            return result, valid, [clear] if between is not None else [], L

    return PathFootprint


PLUGIN = Plugin("path_footprint", "integrator", lambda props: integrator()(props))
