"""Plugin ``neural_field``: an integrator that renders radiance fields among surfaces."""

from __future__ import annotations  # Delayed parsing of type annotations

from dataclasses import dataclass
from functools import cache

import drjit as dr
import mitsuba as mi

from mi_diffind.core import compat

from . import Counterpart, Plugin, warn
from .path_footprint import SURFACES, skip_emitters
from .path_footprint import integrator as path_footprint
from .support import omissions, properties, tables
from .support.footprint import Differentials
from .support.manual import shared_parts
from .support.placed_fields import FieldLight, PlacedField, VariantLight, join_overlapping, to_grid

#: Properties that the default integrator of surfaces takes.
INNER = ("max_depth", "rr_depth", "hide_emitters", "jitter")

#: Allowed names of further channels.
AOVS = ("depth", "opacity")

#: Largest number of nested fields; a kernel contains each field at each place of the order along a ray.
MOST = 4

#: Default number of smooth surfaces that a ray is followed across.
SMOOTH = 8

MANUAL = r"""
.. _integrator-neural_field:

Radiance field among surfaces (:monosp:`neural_field`)
------------------------------------------------------

.. pluginparameters::

 * - filename
   - |string|
   - A radiance field, as written by ``mi-diffind fit field``.
   - --

 * - to_world
   - |transform|
   - Transform from the frame of the capture to the world: rotations, uniform scales, translations and reflections.
     (Default: none)
   - |exposed|, |differentiable|, |discontinuous|

 * - surroundings
   - |bool|
   - Render the surroundings, too, if the field has them. False: the cube around its objects alone. (Default: true)
   - --

 * - (nested plugin)
   - |integrator|
   - Integrator of the surfaces: any that follows rays from a camera. (Default: :monosp:`path_footprint`, with the
     ``max_depth``, ``rr_depth``, ``hide_emitters`` and ``jitter`` given here)
   - --

 * - lit
   - |bool|
   - Let the field light and shadow the surfaces. The nested integrator is then :monosp:`path_footprint`. (Default:
     false)
   - --

 * - smooth_depth
   - |int|
   - Number of smooth mirrors and panes that a ray is followed across to meet the field, 0 to 64. (Default: 8)
   - --

 * - aovs
   - |string|
   - Further channels of the film, separated by commas. ``opacity`` is that of the field before the first surface.
     ``depth`` is the distance to field and first surface, each times its weight in the pixel. If emitters are hidden,
     ``depth`` divided by alpha is the mean distance. (Default: none)
   - --

 * - storage
   - |string|
   - ``uint8``: the form of the file. ``float32``: arrays that can be optimised. (Default: ``uint8``)
   - --

 * - tables.*
   - |tensor|
   - Arrays of the field, with ``storage`` ``float32``, and those of a grid with any: ``density``, ``colour`` and, with
     reflections, ``environment`` (paper: ``density_primary``, …). Bytes have no derivatives.
   - |exposed|, |differentiable|

A captured radiance field (Datta et al., *Efficient Graphics Representation with Differentiable Indirection*, SIGGRAPH
Asia 2023, task 7) among ordinary surfaces. Each camera ray is marched through the field up to the first surface; the
radiance of the inner integrator is added, times the remaining transmittance. A ray that becomes opaque in the field (a
transmittance below :math:`10^{-4}`) sees no surface. Where there is no surface behind the field, alpha on the film is
one minus the transmittance.

**Mirrors and glass.** Rays are followed across surfaces that are smooth throughout (:monosp:`conductor`,
:monosp:`dielectric`, :monosp:`thindielectric`, :monosp:`null`, no medium inside), with their footprints, and marched
through the field between them. All other surfaces, including those with a smooth lobe and another lobe
(:monosp:`plastic`, :monosp:`mask`), are rendered by the inner integrator. Paths of a limited ``max_depth`` may be
longer by the smooth surfaces before. Participating media count as being behind the field.

**Light and shadow.** With ``lit``, every segment of a path is marched through the field: surfaces are lit and shadowed
by the field, and it is visible in rough mirrors, in the coat of :monosp:`plastic` and through the holes of a
:monosp:`mask`. The estimator is unbiased for light that surfaces scatter any number of times. Directions towards the
field are sampled from cones around its bright parts; they and the samples of BSDFs are weighted by the power heuristic.
The field itself is not lit: it keeps the light of its capture. Participating media are not rendered, which a warning
says. Without ``lit``, the inner integrator does not see the field.

**Spectral variants** treat the radiance as that of an emitter of this colour: upsampled, times D65. ``mono`` variants
take the luminance. Polarised variants are not supported.

**Several fields**, up to four, are nested in one another, with the integrator of surfaces in the innermost; ``lit``,
``smooth_depth`` and ``aovs`` are those of the outermost. Where boxes overlap, densities and emissions add up. Rays take
steps of half the smallest voxel there, and ``to_world`` of such fields has no derivatives.

**Surroundings.** A field of ``fit field --background surroundings`` fills all space: a cube around its objects, and
what is beyond, coarser with the distance. Alpha is 1 where the surroundings are opaque. Such a field cannot be nested
with others, and its ``to_world`` has no derivatives, unless ``surroundings`` is false.

**Derivatives** with respect to the field's arrays and its ``to_world`` replay the rays (Vicini et al., *Path Replay
Backpropagation*, SIGGRAPH 2021). They cover the radiance, alpha and the channels of ``aovs``. If the inner integrator
replays paths, too (:monosp:`path_footprint`, :monosp:`path_sdf`, :monosp:`prb`, …), it adds the derivatives of
materials, textures and emitters; any other inner integrator is constant, and so is the geometry. With ``lit``, the
derivatives with respect to the field include its light and its shadow on surfaces; alpha behind holes is constant.

``to_world`` may change between renders. Its derivatives, with any ``storage``, include the sides of the box and the
surfaces that cut the field. Where occupied cells end before the density is zero, the field jumps, and the jump has no
derivative: derivatives of pixels with respect to ``to_world`` are then several percent off differences.

Inside another integrator, such as :monosp:`aov`, alpha is 0 or 1. If :monosp:`mi.render` is given an integrator
without a field for a scene with one, it warns once.

{executable}

.. tabs::
    .. code-tab:: xml
        :name: neural_field

        <integrator type="neural_field">
            <string name="filename" value="group.npz"/>
            <integrator type="path_footprint">
                <integer name="max_depth" value="8"/>
            </integrator>
        </integrator>

    .. code-tab:: python

        'type': 'neural_field',
        'filename': 'group.npz',
        'surfaces': {'type': 'path_footprint', 'max_depth': 8}
"""


@dataclass  # which is what loops of Dr.Jit take for state
class FollowedRays:
    """State of the rays of a wavefront while they are followed.

    ``active`` rays continue; ``handed`` rays have ended where the inner integrator takes over. ``clear`` is the product
    of the transmittances up to the first surface that changed the ray, ``turned`` tells whether one did, and ``count``
    is the number of smooth surfaces. The radiance ``L`` and ``depth`` are sums so far; in the differential phases they
    are the parts still to come, and ``opacity`` is the total. ``δL`` is the derivative of ``L``, ``δclear`` that of
    ``clear`` divided by ``clear``, followed by those of the further channels. ``differentials`` are those of the rays,
    if textures need footprints.
    """

    ray: mi.Ray3f
    active: mi.Bool
    handed: mi.Bool
    β: mi.Spectrum
    clear: mi.Float
    turned: mi.Bool
    count: mi.UInt32
    L: mi.Spectrum
    opacity: mi.Float
    depth: mi.Float
    δL: mi.Spectrum
    δclear: mi.Float
    δopacity: mi.Float
    δdepth: mi.Float
    differentials: Differentials


def carries(ray) -> bool:
    """Return whether a ray carries differentials, for textures that need footprints."""
    return bool(getattr(ray, "has_differentials", False))


def is_smooth(bsdf):
    """Return whether all lobes of a BSDF are those of a mirror or a pane, everywhere."""
    flags = bsdf.flags()
    return mi.has_flag(flags, mi.BSDFFlags.Delta) & ~mi.has_flag(flags, mi.BSDFFlags.Smooth)


def has_smooth(scene: mi.Scene) -> bool:
    """Return whether the scene has a smooth surface that rays are followed across; an instance counts as one."""
    return any(
        compat.is_instance(shape)
        or (shape.bsdf() is not None and is_smooth(shape.bsdf()) and not shape.is_medium_transition())
        for shape in scene.shapes()
    )


@cache
def integrator() -> type:
    """Return the class of the plugin in the current variant."""

    @shared_parts
    class NeuralField(compat.replay_integrator()):
        __doc__ = MANUAL

        def __init__(self, props: mi.Properties, field=None):
            """Create the integrator; ``field``, a ``VolumeField``, replaces that of a file."""
            if mi.is_polarized:
                raise RuntimeError("neural_field: does not run in polarised variants")
            super().__init__(props)
            self.nested = self.surfaces = self._inner(props)
            self.smooth_depth = props.get("smooth_depth", SMOOTH)
            if not isinstance(self.smooth_depth, int) or not 0 <= self.smooth_depth <= 64:
                raise RuntimeError(
                    f'parameter "smooth_depth": found {self.smooth_depth}, allowed are whole numbers from 0 to 64'
                )
            self.aovs = self._channels(str(props.get("aovs", "")))
            self.model = None
            if field is None:
                self.model = open_model(props)
                field = self.model.field
            if not properties.flag(props, "surroundings", True) and field.unbounded:
                field = field.without_surroundings()
            self.placed = PlacedField(field, props.get("to_world", mi.ScalarTransform4f()))
            self._entries = tables.Entries(self.placed.exposed)
            self.light = VariantLight()
            self.fields = [self.placed]
            if isinstance(self.nested, NeuralField):
                self.fields += self.nested.fields
                self.surfaces = self.nested.surfaces
            if len(self.fields) > MOST:
                raise RuntimeError(f"found {len(self.fields)} nested fields, allowed are {MOST}")
            self.lit = properties.flag(props, "lit")
            self._group()
            self._warned = False
            omissions.watch(self)

        def _group(self) -> None:
            """Join fields whose boxes overlap, and show them to the integrator of surfaces if they light it.

            Fields that a nested integrator has shown to it are hidden.
            """
            if len(self.fields) > 1 and any(placed.field.unbounded for placed in self.fields):
                raise RuntimeError(
                    'parameter "surroundings": true for a field among nested ones, allowed is false, since '
                    "surroundings fill all space"
                )
            self.groups = join_overlapping(self.fields)
            self.field_light = FieldLight(self.groups, self.light, self.lit)
            if self.lit and type(self.surfaces) is not path_footprint():
                raise RuntimeError(
                    f'parameter "lit": the nested integrator {compat.integrator_name(self.surfaces)} does not see '
                    f"fields, allowed are path_footprint and none"
                )
            if isinstance(self.surfaces, path_footprint()):
                self.surfaces.between = self.field_light if self.lit else None
            self._hold()

        def _hold(self) -> None:
            """Keep all arrays that rays read as an attribute, for frozen functions."""
            self.held = [array for placed in dict.fromkeys([self.placed, *self.groups]) for array in placed.held()]
            if self.lit:
                self.held += [self.field_light.spheres, self.field_light.radiances]

        @staticmethod
        def _inner(props: mi.Properties):
            """Return the integrator of surfaces. Raises ``RuntimeError`` if the nested one is not suitable."""
            given = [child for _, child in props.objects() if isinstance(child, mi.Integrator)]
            parameters = [name for name in INNER if name in props]
            if not given:
                inner = mi.Properties("path_footprint")
                for name in parameters:
                    inner[name] = props[name]
                return path_footprint()(inner)
            if len(given) > 1:
                raise RuntimeError(f"found {len(given)} nested integrators, allowed is one, for the surfaces")
            if parameters:
                raise RuntimeError(f'parameter "{parameters[0]}": belongs to the nested integrator')
            inner, name = given[0], compat.integrator_name(given[0])
            if not isinstance(inner, mi.SamplingIntegrator):
                raise RuntimeError(f"the nested integrator {name}: does not follow rays from a camera, as path does")
            if inner.aov_names():
                raise RuntimeError(
                    f"the nested integrator {name}: has AOVs of its own, which are not passed on; nest "
                    f"neural_field in it instead"
                )
            return inner

        @staticmethod
        def _channels(text: str) -> list[str]:
            names = [name.strip() for name in text.split(",") if name.strip()]
            for name in names:
                if name not in AOVS or names.count(name) > 1:
                    raise RuntimeError(f'parameter "aovs": found "{text}", allowed are {", ".join(AOVS)}, each once')
            return names

        def traverse(self, cb: mi.TraversalCallback) -> None:
            for name, values in self.placed.exposed.items():
                cb.put(f"tables.{name}", values, mi.ParamFlags.Differentiable)
            flags = mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous
            cb.put("to_world", self.placed.transform, flags)
            cb.put("surfaces", self.nested, mi.ParamFlags.Differentiable)

        def trained(self) -> tuple:
            """Return the table of the file (``None`` without one), and the tensors that can be optimised, by name."""
            return (self.model.table if self.model else None), self.placed.exposed

        def parameters_changed(self, keys=()) -> None:
            self._entries.accept()
            if not keys or "to_world" in keys:
                self.placed.update()
            # Mitsuba gives the last part of a name
            if keys and all(key.rpartition(".")[2] in self.placed.exposed for key in keys):
                if self.lit:
                    self.field_light.update()
                self._hold()
            else:
                self._group()

        def aov_names(self) -> list[str]:
            return list(self.aovs)

        def report(self) -> dict:
            voxel = self.placed.field.voxel * self.placed.length
            report = {"voxel": voxel, "surfaces": compat.integrator_name(self.surfaces)}
            if (model := self.model) is None:
                return report
            return {"preset": model.table.preset, "storage": model.storage, "table_bytes": model.nbytes, **report}

        def to_string(self) -> str:
            path = self.model.table.path if self.model is not None else ""
            inner = str(self.surfaces).replace("\n", "\n  ")
            return (
                f'NeuralField[\n  filename = "{path}",\n  lit = {str(self.lit).lower()},\n'
                f"  smooth_depth = {self.smooth_depth},\n"
                f'  aovs = "{",".join(self.aovs)}",\n  surfaces = {inner}\n]'
            )

        def counts(self, scene, sensor=0) -> dict:
            """Return the counts (:func:`.march.count`) of camera rays, one for each pixel."""
            with dr.suspend_grad():
                _, _, ray, _ = self._begin(scene, sensor, 0, 1)
                pi = scene.ray_intersect_preliminary(ray, coherent=True, active=True)
                return self.placed.count(ray, dr.minimum(pi.t, ray.maxt))

        def sample_rays(self, scene, sensor, sampler):
            """Sample camera rays as the inner integrator does."""
            if compat.written_in_python(self.surfaces):
                return self.surfaces.sample_rays(scene, sensor, sampler)
            return super().sample_rays(scene, sensor, sampler)

        def _begin(self, scene, sensor, seed, spp) -> tuple:
            """Return the film, a sampler, camera rays, and the function that returns the image of what they see.

            Mitsuba's base classes write an alpha of 0 or 1, and multiply AOVs by the weight of a ray, which fails in
            the backward pass. Here, the weight applies to the light alone.
            """
            if not self._warned and (omitted := self._unseen(scene)):
                warn(f"neural_field: {omitted}")
            self._warned = True
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            sampler, spp = self.prepare(sensor, seed, spp, self.aov_names())
            ray, weight, place = self.sample_rays(scene, sensor, sampler)
            film = sensor.film()

            def developed(light, alpha, aovs):
                block = film.create_block()
                block.set_coalesce(block.coalesce() and spp >= 4)
                compat.splat(block, film, place, light * weight, alpha, aovs, ray.wavelengths)
                film.put_block(block)
                return film.develop()

            return film, sampler, ray, developed

        def _unseen(self, scene) -> str:
            """Return a sentence on where the field is not seen in a scene, or ``""``."""
            if not self.lit:
                flags = {shape.id(): shape.bsdf().flags() for shape in scene.shapes() if shape.bsdf() is not None}
                both = mi.BSDFFlags.Null, mi.BSDFFlags.Smooth
                holes = [name for name, some in flags.items() if all(mi.has_flag(some, flag) for flag in both)]
                return f'the field is not visible through the holes of "{holes[0]}", "lit" shows it' if holes else ""
            media = [shape.id() for shape in scene.shapes() if shape.is_medium_transition()]
            return f'with "lit", the participating medium of "{media[0]}" is not rendered' if media else ""

        def omitted(self, integrators: list, sensor) -> str:
            """Return a sentence if no integrator among these renders a radiance field; see :mod:`.omissions`."""
            if any(isinstance(integrator, NeuralField) for integrator in integrators):
                return ""
            name = compat.integrator_name(integrators[-1])
            return (
                f"the radiance field of the scene's integrator (neural_field) is left out: the integrator {name} does "
                f"not render it; nest {name} in a neural_field"
            )

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            if not develop:
                raise RuntimeError("neural_field: found develop=False, allowed is develop=True")
            omissions.check(scene, self, sensor)
            with dr.suspend_grad():
                _, sampler, ray, developed = self._begin(scene, sensor, seed, spp)
                return developed(*self.primal(scene, sampler, ray)[:3])

        def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
            with dr.suspend_grad():
                _, sampler, ray, developed = self._begin(scene, sensor, seed, spp)
                surfaces = self._surfaces_optimised(scene)
                *_, state = self.primal(scene, sampler.clone(), ray)
                for placed in self.groups:
                    placed.start_forward()
                return developed(*self.differentiate(dr.ADMode.Forward, scene, sampler, ray, state, surfaces))

        def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
            with dr.suspend_grad():
                film, sampler, ray, developed = self._begin(scene, sensor, seed, spp)
                surfaces = self._surfaces_optimised(scene)
                # The film is linear in light, alpha and channels, so that their values do not matter
                with dr.resume_grad():
                    count = dr.width(ray)
                    light, alpha = dr.full(mi.Spectrum, 1, count), dr.full(mi.Float, 1, count)
                    aovs = [dr.full(mi.Float, 1, count) for _ in self.aovs]
                    dr.enable_grad(light, alpha, aovs)
                    image = developed(light, alpha, aovs)
                    dr.set_grad(image, grad_in)
                    dr.enqueue(dr.ADMode.Backward, image)
                    dr.traverse(dr.ADMode.Backward)
                    adjoint = dr.grad(light), dr.grad(alpha), dict(zip(self.aovs, dr.grad(aovs), strict=True))
                film.clear()
                *_, state = self.primal(scene, sampler.clone(), ray)
                with dr.isolate_grad():  # derivatives come in parts to what a placement is attached to
                    self.differentiate(dr.ADMode.Backward, scene, sampler, ray, state, surfaces, adjoint)
                dr.eval()

        def _surfaces_optimised(self, scene) -> bool:
            """Return whether a derivative with respect to another parameter than the fields' arrays is requested.

            Raises ``RuntimeError`` for a derivative of a place that there is not.
            """
            if any(placed.moving() and placed not in self.groups for placed in self.fields):
                raise RuntimeError('parameter "to_world": has no derivatives for a field that overlaps another one')
            if any(placed.moving() and placed.field.unbounded for placed in self.fields):
                raise RuntimeError('parameter "to_world": has no derivatives for a field with surroundings')
            if self.lit and self.field_light.optimised():
                return True
            field_arrays = {compat.identity(values) for placed in self.fields for values in placed.exposed.values()}
            params = mi.traverse(scene)
            values = [params[key] for key in params.keys()]
            attached = [v for v in values if isinstance(v, dr.ArrayBase) and compat.has_gradient(v)]
            return any(compat.identity(v) not in field_arrays for v in attached)

        def sample(self, mode, scene, sampler, ray, δL=None, δaovs=None, state_in=None, active=True, **kwargs):
            """Sample as ``ADIntegrator.sample`` does, for an integrator around this one, in the primal mode only."""
            if mode != dr.ADMode.Primal:
                raise RuntimeError(
                    "neural_field: has no derivatives inside another integrator, make it the outermost one"
                )
            light, alpha, aovs, state = self.primal(scene, sampler, ray, active)
            return light, alpha > 0, aovs, state

        def primal(self, scene, sampler, ray, active=True) -> tuple:
            """Return light, alpha and further channels of camera rays, and the state for the differential phases.

            The state holds light, one minus alpha, depth, opacity and the state of the inner integrator.
            """
            path = self._start(ray, active)
            sampler, path = self._follow(None, scene, sampler, path, None, carries(ray))
            inner, valid, passed, state = self._surfaces(dr.ADMode.Primal, scene, sampler, ray, path)
            light = path.L + dr.select(path.handed, path.β * inner, 0)
            clear = dr.select(path.handed & valid, 0, path.clear * passed)
            aovs = {"depth": path.depth, "opacity": path.opacity}
            state = light, clear, path.depth, path.opacity, state
            return light, 1 - clear, [aovs[name] for name in self.aovs], state

        def differentiate(self, mode, scene, sampler, ray, state, surfaces, adjoint=None) -> tuple:
            """Run a differential phase.

            ``Forward`` returns the derivatives of light, alpha and channels. ``Backward`` propagates the derivatives
            with respect to these, ``adjoint`` (channels as a dictionary), to the parameters.
            """
            light, clear, depth, opacity, inner_state = state
            path = self._start(ray, True)
            path.L, path.depth, path.opacity = mi.Spectrum(light), mi.Float(depth), mi.Float(opacity)
            if mode == dr.ADMode.Backward:
                # All transmittances of a ray have the same derivative of alpha by their logarithm
                aovs = adjoint[2]
                path.δL = mi.Spectrum(adjoint[0])
                path.δclear = mi.Float(-adjoint[1] * clear)
                path.δopacity = mi.Float(aovs.get("opacity", 0))
                path.δdepth = mi.Float(aovs.get("depth", 0))
            sampler, path = self._follow(mode, scene, sampler, path, surfaces, carries(ray))
            change = path.δL
            if surfaces and compat.replays_paths(self.surfaces):
                δ = None
                if mode == dr.ADMode.Backward:
                    δ = dr.select(path.handed, path.δL * path.β, 0)
                inner, *_ = self._surfaces(mode, scene, sampler, ray, path, δ, inner_state)
                if mode == dr.ADMode.Forward:
                    change = change + dr.select(path.handed, path.β * inner, 0)
            aovs = {"depth": path.δdepth, "opacity": path.δopacity}
            return change, -clear * path.δclear, [aovs[name] for name in self.aovs]

        def _start(self, ray, active) -> FollowedRays:
            path = dr.zeros(FollowedRays)
            path.ray = mi.Ray3f(dr.detach(ray))
            path.active, path.handed, path.turned = mi.Bool(active), mi.Bool(False), mi.Bool(False)
            path.β, path.clear = mi.Spectrum(1), mi.Float(1)
            path.differentials = Differentials.from_ray(ray)
            return path

        def _surfaces(self, mode, scene, sampler, ray, path, δL=None, state=None) -> tuple:
            """Return what the inner integrator does for the rays that are handed to it.

            Returned are light, validity, the transmittance of fields beyond holes in the first surface, and the state.
            """
            onward = mi.RayDifferential3f(path.ray)
            onward.has_differentials = carries(ray)
            if onward.has_differentials:
                offsets = path.differentials
                onward.o_x, onward.o_y = onward.o + offsets.ox, onward.o + offsets.oy
                onward.d_x, onward.d_y = onward.d + offsets.dx, onward.d + offsets.dy
            if not compat.written_in_python(self.surfaces):
                light, valid, _ = self.surfaces.sample(scene, sampler, onward, None, path.handed)
                return light, valid, mi.Float(1), None
            light, valid, passed, state = self.surfaces.sample(
                mode=mode, scene=scene, sampler=sampler, ray=onward, depth=mi.UInt32(0), δL=δL, δaovs=None,
                state_in=state, active=mi.Bool(path.handed),
            )  # fmt: skip
            return light, valid, dr.select(path.handed, passed[0], 1) if passed else mi.Float(1), state

        def _follow(self, mode, scene, sampler, path, surfaces, carried: bool) -> tuple:
            """Follow rays up to the surfaces at which the inner integrator takes over.

            A ``mode`` of ``None`` is the primal phase. Without smooth surfaces, a single piece is enough.
            """
            geometry = self.surfaces.geometry(scene) if isinstance(self.surfaces, path_footprint()) else SURFACES
            if self.smooth_depth == 0 or not has_smooth(scene):
                return sampler, self._piece(mode, scene, sampler, path, geometry, surfaces, False, False)

            def body(sampler, path):
                return sampler, self._piece(mode, scene, sampler, path, geometry, surfaces, True, carried)

            label = "neural_field" if mode is None else f"neural_field ({mode.name})"
            return dr.while_loop(
                (sampler, path), lambda _, path: path.active, body, max_iterations=self.smooth_depth + 1, label=label
            )

        def _piece(self, mode, scene, sampler, path, geometry, surfaces, onward: bool, carried: bool) -> FollowedRays:
            """Follow a piece of each ray up to a surface and, if ``onward``, across it where it is smooth.

            ``carried``: the rays have differentials.
            """
            ray, active, first = path.ray, path.active, path.count == 0

            # ---------------------- Next surface ----------------------

            entered = self.field_light.enters(ray, ray.maxt, active)
            met = active
            if not onward and "depth" not in self.aovs:
                met = mi.Bool(False)
                for _, crossed in entered:
                    met |= crossed
            pi = scene.ray_intersect_preliminary(ray, coherent=True, active=met)
            if self.surfaces.hide_emitters:
                # The inner integrator hides emitters that a camera ray meets first
                skip_emitters(self, scene, ray, pi, met & ~path.turned)
            far = dr.minimum(geometry.nearest(ray, pi, met).t, ray.maxt)
            solid = ~pi.is_valid() & (far < ray.maxt)  # of path_sdf

            # ---------------------- Fields up to the surface ----------------------

            if mode is None:
                L, through, depth = self.field_light.cross(ray, far, active, entered)
                depth += through * dr.select(met & (pi.is_valid() | solid), far, 0)
                path.opacity = dr.select(first, 1 - through, path.opacity)
                path.L, path.depth = path.L + path.β * L, path.depth + dr.select(first, depth, 0)
            else:
                δdepth, clear = dr.select(first, path.δdepth, 0), dr.select(first, 1 - path.opacity, 0)
                change, (L, through, depth) = self.field_light.derive(
                    mode, ray, far, active, path.δL, path.β, path.L, entered, path.δclear - path.δopacity * clear,
                    δdepth, path.depth,
                )  # fmt: skip
                path.L, path.depth = path.L - path.β * L, path.depth - dr.select(first, depth, 0)
                path.δL, path.δclear = path.δL + change[0], path.δclear + change[1]
                path.δopacity -= clear * change[1]
                path.δdepth += dr.select(first, change[2], 0)
            path.β, path.clear = path.β * through, path.clear * through
            path.active, path.handed = mi.Bool(False), path.handed | (active & (through > 0))
            if not onward:
                return path

            # ---------------------- Across a smooth surface ----------------------

            arrived = active & (through > 0) & ~solid
            flags = compat.ray_flags(curvature=carried)
            si = pi.compute_surface_interaction(ray, ray_flags=flags, active=arrived)
            bsdf = si.bsdf(ray)
            active_next = arrived & si.is_valid() & (path.count < self.smooth_depth)
            active_next &= is_smooth(bsdf) & ~si.shape.is_medium_transition()
            shining = mi.Bool(active_next)
            if self.surfaces.hide_emitters:
                # The inner integrator would hide them in mirrors, too
                emitter = si.emitter(scene, arrived)
                ended = arrived & path.turned & ~active_next & (emitter != None)  # noqa: E711  (lane by lane)
                shining |= ended
                path.handed &= ~ended
            with dr.resume_grad(when=bool(mode is not None and surfaces)):
                Le = path.β * si.emitter(scene, shining).eval(si, shining)
                bs, bsdf_weight = bsdf.sample(
                    mi.BSDFContext(), si, sampler.next_1d(active_next), sampler.next_2d(active_next), active_next
                )
            Le_now = dr.select(shining, dr.detach(Le), 0)
            path.L = path.L + Le_now if mode is None else path.L - Le_now
            if mode is not None and surfaces:
                with dr.resume_grad():
                    Lo = dr.select(shining, Le, 0)
                    Lo += dr.select(active_next, path.L * dr.relative_grad(bsdf_weight), 0)
                    if mode == dr.ADMode.Backward:
                        dr.backward_from(path.δL * Lo, dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
                    else:
                        path.δL += dr.forward_to(Lo, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)

            # ---------------------- Next piece ----------------------

            bs = dr.detach(bs)
            turned = active_next & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            wo = si.to_world(bs.wo)
            path.ray = dr.select(active_next, si.spawn_ray(wo), ray)
            if carried:
                edges = compat.normal_edges(pi, si, ray, active_next)
                arriving = path.differentials.at(ray, si)
                leaving = arriving.bounce(ray, si, wo, bs.eta, bs.pdf, mi.Bool(True), mi.Float(1), edges)
                path.differentials = dr.select(active_next, leaving, path.differentials)
            path.β = dr.select(active_next, path.β * dr.detach(bsdf_weight), path.β)
            path.clear = dr.select(turned, 0, path.clear)
            path.turned |= turned
            path.handed &= ~active_next
            path.active = active_next & (dr.max(path.β) > 0)
            path.count = dr.select(active_next, path.count + 1, path.count)
            return path

    return NeuralField


def open_model(props: mi.Properties):
    """Return the model that the properties ``filename`` and ``storage`` name."""
    path, storage = tables.file_and_storage(props, "field")
    from mi_diffind.tasks.radiance import TASK

    return TASK.open(mi.TensorXf, path, storage=storage if storage == "float32" else "")


PLUGIN = Plugin(
    "neural_field",
    "integrator",
    lambda props: integrator()(props),
    task="field",
    exact=Counterpart("neural_field", convert=to_grid),
)
