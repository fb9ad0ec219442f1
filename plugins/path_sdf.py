"""Path tracer for scenes with signed distance fields."""

from __future__ import annotations  # Delayed parsing of type annotations

from dataclasses import dataclass
from functools import cache

import drjit as dr
import mitsuba as mi

from mi_diffind.core.compat import ray_flags

from . import Plugin, path_footprint
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


@dataclass  # a type that loops of Dr.Jit accept as state
class SolidHit:
    """Hit of Mitsuba's shapes ``pi`` or of a distance shape ``solid``; one of them is not valid.

    ``d`` is the direction of the ray; ``previous`` and ``previous_d`` are ``solid`` and ``d`` of the vertex before.
    """

    pi: mi.PreliminaryIntersection3f
    solid: sdf.ShapeHit
    d: mi.Vector3f
    previous: sdf.ShapeHit
    previous_d: mi.Vector3f


@cache
def integrator() -> type:
    """Return the integrator's class in the current variant."""
    jacobian = mi.ad.integrators.common.solid_angle_to_area_jacobian

    @shared_parts
    class PathSDF(path_footprint.integrator()):
        __doc__ = MANUAL

        #: Rays are traced through distance shapes (:mod:`.distance_shapes`).
        traces_solids = True

        #: Rays carry no differentials, since a distance field has none.
        gives_footprints = False

        def to_string(self) -> str:
            return super().to_string().replace("PathFootprint", "PathSDF", 1)

        def render_backward(self, scene, params, grad_in, *args, **kwargs):
            """See ``ADIntegrator.render_backward``. Warns of a shape without derivatives."""
            super().render_backward(scene, params, grad_in, *args, **kwargs)
            sdf.check_derivatives(self.solids(scene), grad_in)

        def solids(self, scene):
            return sdf.distance_shapes_in(scene)

        def nearest(self, solids, ray, pi, active, rest=0, before=None):
            if not solids:
                return pi
            solid = sdf.intersect(solids, ray.o, ray.d, dr.minimum(pi.t, ray.maxt), active, rest)
            pi.t = dr.select(solid.number > 0, dr.inf, pi.t)
            previous = (dr.zeros(sdf.ShapeHit), mi.Vector3f(ray.d)) if before is None else (before.solid, before.d)
            return SolidHit(pi, solid, mi.Vector3f(ray.d), *previous)

        def interaction(self, solids, ray, hit, flags, active, moving=False):
            if not solids:
                return super().interaction(solids, ray, hit, flags, active)
            with dr.suspend_grad():  # ordinary shapes are constants
                si = hit.pi.compute_surface_interaction(ray, ray_flags=flags, active=active)
            si = sdf.interaction(solids, hit.solid, ray, si, active)
            if moving:
                # Seen from the vertex before, which also moves
                aside = sdf.shift(solids, hit.previous, hit.previous_d, active & si.is_valid())
                turn = aside - ray.d * dr.dot(aside, ray.d)
                si.wi += dr.detach(si.sh_frame).to_local(turn) * dr.rcp(dr.select(si.is_valid(), si.t, 1))
            return si

        def occluded(self, solids, hit, si, ds, active):
            return sdf.occluded_from(solids, hit.solid, si, ds, active) if solids else mi.Bool(False)

        def spawn(self, solids, hit, si, d):
            ray, rest = super().spawn(solids, hit, si, d)
            if solids:
                ray.o, rest = sdf.spawn(solids, hit.solid, si, d)
            return ray, rest

        def attach_emitter(self, si, ds):
            # Points of emitters stay fixed, and so do directions to infinite ones
            flags = ds.emitter.flags()
            finite = ~mi.has_flag(flags, mi.EmitterFlags.Infinite)
            distance = dr.norm(ds.p - si.p)
            ds.d = dr.replace_grad(ds.d, dr.select(finite, (ds.p - si.p) / distance, ds.d))
            ds.dist = dr.replace_grad(ds.dist, dr.select(finite, distance, ds.dist))
            surface = mi.has_flag(flags, mi.EmitterFlags.Surface)
            return dr.select(surface, dr.relative_grad(jacobian(si.p, ds.p, ds.n)), 1)

        def attach_direction(self, solids, si, bs, ray, hit, active):
            # The next vertex stays fixed, or the direction if there is none
            target = self.interaction(solids, ray, hit, ray_flags(), active)
            active = active & target.is_valid()
            with dr.resume_grad():
                d = dr.select(active, dr.normalize(target.p - si.p), ray.d)
                wo = dr.replace_grad(bs.wo, si.to_local(d))
                return wo, dr.select(active, dr.relative_grad(jacobian(si.p, target.p, target.n)), 1)

    return PathSDF


PLUGIN = Plugin("path_sdf", "integrator", lambda props: integrator()(props))
