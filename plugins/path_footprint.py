"""Path tracer that carries ray differentials, for textures that filter themselves."""

from __future__ import annotations  # Delayed parsing of type annotations

from functools import cache

import drjit as dr
import mitsuba as mi

from mi_diffind.core import compat

from . import Plugin
from .support import footprint, omissions, properties
from .support.footprint import Differentials
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


class Surfaces:
    """Shapes that Mitsuba intersects, as paths meet them; ``path_sdf`` adds its own (:class:`.distance_shapes.Solids`).

    A ``hit`` is the result of :meth:`nearest`. The derivatives of these shapes are those of constants.
    """

    #: Shapes that Mitsuba does not see.
    shapes = ()

    def optimised(self) -> bool:
        """Return whether derivatives with respect to :attr:`shapes` are enabled."""
        return False

    def nearest(self, ray, pi, active, rest=0, before=None):
        """Return the first hit of a ray, given that of Mitsuba's shapes and the hit of the vertex ``before``.

        ``rest`` is the second result of :meth:`spawn`.
        """
        return pi

    def interaction(self, ray, hit, flags, active, moving=False):
        """Return the surface interaction at a hit, attached to its shape and to the vertex before if ``moving``."""
        return hit.compute_surface_interaction(ray, ray_flags=flags, active=active)

    def occluded(self, hit, si, ds, active):
        """Return whether one of :attr:`shapes` lies between a vertex and the sample of an emitter."""
        return mi.Bool(False)

    def spawn(self, hit, si, d) -> tuple:
        """Return the ray from a vertex in the direction ``d``, and what single precision rounds off its origin."""
        return si.spawn_ray(d), 0

    def attach_emitter(self, si, ds):
        """Attach the sample of an emitter to a vertex that moves; return a factor of 1 with the derivative."""
        return mi.Float(1)

    def attach_direction(self, si, bs, ray, hit, active) -> tuple:
        """Return the sampled direction, attached to a vertex that moves, and a factor of 1 with the derivative."""
        return bs.wo, mi.Float(1)


SURFACES = Surfaces()


def skip_emitters(integrator, scene, ray, pi, active) -> None:
    """Replace hits ``pi`` of emitters with an area by the hits behind them."""
    hidden = active & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711  (lane by lane)
    at = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, hidden)
    behind = integrator.skip_area_emitters(scene, at.spawn_ray(ray.d), True, hidden)
    behind.t += at.t
    pi[hidden] = behind


@cache
def integrator() -> type:
    """Return the class for the variant that is set; its base class exists only after Mitsuba loaded this file."""

    @shared_parts
    class PathFootprint(compat.replay_integrator()):
        __doc__ = MANUAL

        #: Rays carry differentials, from which textures get footprints (:mod:`.map_textures`).
        gives_footprints = True

        #: Radiance fields between the surfaces (:class:`.placed_fields.FieldLight`), or ``None``.
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
            self.jitter = properties.flag(props, "jitter", True)

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
            scale = dr.opaque(mi.Float, footprint.sample_scale(sampler.sample_count()))
            axis = sensor.world_transform() @ mi.Vector3f(0, 0, 1)
            # Rays start at the near clipping plane, and Mitsuba lets their neighbours start at the same point of it
            start = sensor.near_clip() / dr.dot(ray.d, dr.normalize(axis)) if hasattr(sensor, "near_clip") else 0
            for x in "xy":
                turn = (getattr(ray, f"d_{x}") - ray.d) * scale
                setattr(ray, f"o_{x}", ray.o + (getattr(ray, f"o_{x}") - ray.o) * scale + start * turn)
                setattr(ray, f"d_{x}", ray.d + turn)

        def geometry(self, scene):
            """Return the shapes of a scene that paths meet: :class:`Surfaces`, or an object with its methods."""
            return SURFACES

        @compat.syntax
        def sample(self, mode, scene, sampler, ray, δL=None, state_in=None, active=True, **kwargs):
            """Trace paths; see ``ADIntegrator.sample``.

            In the differential phases, ``L`` is the radiance that is still to come at the current vertex; it starts as
            the radiance of the whole path (``state_in``).
            """
            primal, geometry, fields = mode == dr.ADMode.Primal, self.geometry(scene), self.between
            solids_move = not primal and geometry.optimised()
            fields_move = not primal and fields is not None and fields.optimised()
            unattached = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad  # a field may be all that is optimised
            carried = bool(getattr(ray, "has_differentials", False)) and not geometry.shapes
            flags = compat.ray_flags(curvature=carried)
            scale = dr.opaque(mi.Float, footprint.sample_scale(sampler.sample_count()))
            bsdf_ctx, mis_weight = mi.BSDFContext(), mi.ad.integrators.common.mis_weight

            differentials = Differentials.from_ray(ray)
            ray = mi.Ray3f(dr.detach(ray))
            active = mi.Bool(active)
            valid_ray = mi.Bool(scene.environment() is not None and not self.hide_emitters)
            depth = mi.UInt32(0)
            L = mi.Spectrum(0 if primal else state_in)
            δL = mi.Spectrum(0 if δL is None else δL)
            β = mi.Spectrum(1)
            η = mi.Float(1)
            prev_si = dr.zeros(mi.SurfaceInteraction3f)
            prev_bsdf_pdf = mi.Float(1)
            prev_bsdf_delta = mi.Bool(True)
            clear = mi.Float(1)  # transmittance of fields before the first surface that changes a ray

            # ---------------------- Hide area emitters ----------------------

            pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
            if dr.hint(self.hide_emitters, mode="scalar"):
                skip_emitters(self, scene, ray, pi, active)
            hit = geometry.nearest(ray, pi, active)

            while dr.hint(active, max_iterations=self.max_depth, label=f"{type(self).__name__} ({mode.name})"):
                with dr.resume_grad(when=solids_move):
                    moving_si = geometry.interaction(ray, hit, flags, active, solids_move)
                if dr.hint(carried, mode="scalar"):
                    differentials = differentials.at(ray, moving_si)
                    moving_si.duv_dx, moving_si.duv_dy = differentials.footprint(ray, moving_si)
                si = dr.detach(moving_si)
                bsdf = si.bsdf(ray)

                # ---------------------- Direct emission ----------------------

                # Weighted against having sampled the emitter at the previous vertex
                shown = active
                if dr.hint(self.hide_emitters, mode="scalar"):
                    # Fields are visible where the environment is not
                    shown &= (valid_ray if fields is not None else depth > 0) | si.is_valid()
                ds = mi.DirectionSample3f(scene, si, prev_si)
                em_pdf = scene.pdf_emitter_direction(prev_si, ds, shown & ~prev_bsdf_delta)
                with dr.resume_grad(when=not primal):
                    Le = β * mis_weight(prev_bsdf_pdf, em_pdf) * ds.emitter.eval(si, shown)

                # ------------- Emitter sampling, and the next direction -------------

                active_next = active & si.is_valid() & (depth + 1 < self.max_depth)
                active_field = active_next & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
                active_em = mi.Bool(active_field)
                ds, em_weight = scene.sample_emitter_direction(si, sampler.next_2d(), True, active_em)
                active_em &= ds.pdf != 0
                active_em &= ~geometry.occluded(hit, si, ds, active_em)
                through, ray_em = mi.Float(1), mi.Ray3f(ray)
                if dr.hint(fields is not None, mode="scalar"):
                    ray_em = si.spawn_ray_to(ds.p)
                    _, through, _ = fields.cross(ray_em, ray_em.maxt, active_em)
                with dr.resume_grad(when=not primal):
                    J = mi.Float(1)
                    if dr.hint(solids_move, mode="scalar"):
                        J = geometry.attach_emitter(moving_si, ds)
                    if dr.hint(not primal, mode="scalar"):
                        em_value = scene.eval_emitter_direction(moving_si, ds, active_em)
                        em_weight = dr.replace_grad(em_weight, em_value * dr.select(active_em, dr.rcp(ds.pdf), 0)) * J
                    # Together with the next direction: the textures of a material are read once
                    bsdf_value, bsdf_pdf, bs, bsdf_weight = bsdf.eval_pdf_sample(
                        bsdf_ctx, moving_si, moving_si.to_local(ds.d), sampler.next_1d(), sampler.next_2d(),
                        active_next,
                    )  # fmt: skip
                    mis = dr.select(ds.delta, 1, mis_weight(ds.pdf, dr.detach(bsdf_pdf)))
                    Lr_dir = dr.select(active_em, β * mis * through * bsdf_value * em_weight, 0)
                bs = dr.detach(bs)
                bsdf_delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)

                # ---------------------- Light from a field ----------------------

                if dr.hint(fields_move, mode="scalar"):
                    total = dr.detach(Lr_dir)
                    change, _ = fields.derive(mode, ray_em, ray_em.maxt, active_em, δL, mi.Spectrum(0), total)
                    δL += change[0]
                if dr.hint(fields is not None, mode="scalar"):
                    d, field_pdf = fields.sample(si.p, sampler.next_1d(), sampler.next_2d(), active_field)
                    active_field &= field_pdf > 0
                    with dr.resume_grad(when=not primal):
                        bsdf_value, bsdf_pdf = bsdf.eval_pdf(bsdf_ctx, si, si.to_local(d), active_field)
                    active_field &= dr.max(dr.detach(bsdf_value)) > 0
                    ray_em = si.spawn_ray(d)
                    far = scene.ray_intersect_preliminary(ray_em, coherent=False, active=active_field).t
                    Le_field, _, _ = fields.cross(ray_em, far, active_field)
                    weight = mis_weight(field_pdf, dr.detach(bsdf_pdf)) * dr.rcp(field_pdf)
                    weight = dr.select(active_field, β * weight, 0)
                    with dr.resume_grad(when=not primal):
                        Lr_dir += dr.select(active_field, weight * bsdf_value * Le_field, 0)
                    if dr.hint(fields_move, mode="scalar"):
                        weight = weight * dr.detach(bsdf_value)
                        change, _ = fields.derive(mode, ray_em, far, active_field, δL, weight, weight * Le_field)
                        δL += change[0]
                L = L + Le + Lr_dir if primal else L - dr.detach(Le + Lr_dir)

                # ---------------------- Next vertex ----------------------

                wo = si.to_world(bs.wo)
                if dr.hint(carried, mode="scalar"):
                    edges = compat.normal_edges(hit, si, ray, active_next)
                    differentials = differentials.bounce(ray, si, wo, bs.eta, bs.pdf, bsdf_delta, scale, edges)
                valid_ray |= active & si.is_valid() & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
                ray, rest = geometry.spawn(hit, si, wo)
                β *= dr.detach(bsdf_weight)
                η *= bs.eta

                # Russian roulette, without the factor η² of radiance at boundaries
                β_max = dr.max(β)
                rr_prob = dr.minimum(β_max * dr.square(η), 0.95)
                rr_active = depth >= self.rr_depth
                rr_continue = sampler.next_1d() < rr_prob
                β[rr_active] *= dr.rcp(rr_prob)
                active = active_next & (β_max != 0) & (~rr_active | rr_continue)
                depth[active_next] += 1
                pi = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
                hit = geometry.nearest(ray, pi, active, rest, hit)

                # ---------------------- Differential phases ----------------------

                if dr.hint(not primal, mode="scalar"):
                    wo, J = bs.wo, mi.Float(1)
                    if dr.hint(solids_move, mode="scalar"):
                        wo, J = geometry.attach_direction(moving_si, bs, ray, hit, active)
                    with dr.resume_grad():
                        # A smooth mirror cannot be evaluated: its weight is differentiated instead
                        rough = bsdf.eval(bsdf_ctx, moving_si, wo, active_next & ~bsdf_delta)
                        factor = dr.select(bsdf_delta, dr.relative_grad(bsdf_weight), dr.relative_grad(rough) * J)
                        Lo = Le + Lr_dir + dr.select(active_next, L * factor, 0)
                        if dr.hint(mode == dr.ADMode.Backward, mode="scalar"):
                            dr.backward_from(δL * Lo, unattached)
                        else:
                            δL += dr.forward_to(Lo, flags=unattached)

                # ---------------------- Fields up to the next vertex ----------------------

                prev_si, prev_bsdf_pdf, prev_bsdf_delta = si, bs.pdf, bsdf_delta
                if dr.hint(fields is not None, mode="scalar"):
                    # Weighted against having sampled this direction towards them
                    Le_field, through, _ = fields.cross(ray, hit.t, active)
                    field_pdf = fields.density(prev_si.p, ray.d, active & ~prev_bsdf_delta)
                    weight = dr.select(active, β * mis_weight(prev_bsdf_pdf, field_pdf), 0)
                    if dr.hint(fields_move, mode="scalar"):
                        δL += fields.derive(mode, ray, hit.t, active, δL, weight, L)[0][0]
                    Le_field = dr.select(active, weight * Le_field, 0)
                    L = L + Le_field if primal else L - Le_field
                    clear = dr.select(active & ~valid_ray, clear * through, clear)
                    β *= dr.select(active, through, 1)
                    active &= through > 0

            visible = L if fields is not None else dr.select(valid_ray, L, 0)
            return visible if primal else δL, valid_ray, [] if fields is None else [clear], L

    return PathFootprint


PLUGIN = Plugin("path_footprint", "integrator", lambda props: integrator()(props))
