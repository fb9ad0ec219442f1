"""Path tracer for scenes with signed distance fields."""

from __future__ import annotations  # Delayed parsing of type annotations

from functools import cache

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


@cache
def integrator() -> type:
    """Return the integrator's class in the current variant."""

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
            sdf.solids_in(scene).check_derivatives(grad_in)

        def geometry(self, scene):
            solids = sdf.solids_in(scene)
            return solids if solids.shapes else super().geometry(scene)

    return PathSDF


PLUGIN = Plugin("path_sdf", "integrator", lambda props: integrator()(props))
