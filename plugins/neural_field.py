from __future__ import annotations  # Delayed parsing of type annotations

from dataclasses import dataclass
from functools import cache

import drjit as dr
import mitsuba as mi

from mi_diffind import compat
from mi_diffind.tables import TableError
from mi_diffind.tasks.radiance.march import OPAQUE

from . import Counterpart, Plugin, warn
from .path_footprint import integrator as path_footprint
from .path_footprint import relative
from .support import properties
from .support import solids as sdf
from .support.differentials import Differentials
from .support.field_grids import to_grid
from .support.fields import Light, PlacedField

#: What the default inner integrator takes of the properties.
INNER = ("max_depth", "rr_depth", "hide_emitters", "jitter")

#: Channels that may be asked for.
AOVS = ("depth", "opacity")

#: How many fields there may be: each may be met at each place of a sequence.
MOST = 4

#: How many smooth surfaces a ray is followed across, by default.
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
   - From the place and size of the capture to the world: rotations, uniform scales and translations; reflections, too.
     (Default: none)
   - --

 * - (nested plugin)
   - |integrator|
   - For the surfaces: any that follows rays from a camera. (Default: :monosp:`path_footprint`, with the
     ``max_depth``, ``rr_depth``, ``hide_emitters`` and ``jitter`` given here)
   - --

 * - smooth_depth
   - |int|
   - How many smooth mirrors and panes a ray is followed across to meet the field, 0 to 64. (Default: 8)
   - --

 * - aovs
   - |string|
   - More channels of the film, separated by commas: ``opacity``, that of the field before the first surface;
     ``depth``, the distance to field and first surface, each times its share of what is seen. Where emitters are
     hidden, ``depth`` divided by alpha is the mean distance. (Default: none)
   - --

 * - storage
   - |string|
   - ``uint8``, as in the file; ``float32``, which can be optimised. (Default: ``uint8``)
   - --

 * - tables.*
   - |tensor|
   - The arrays of the field; with ``storage`` ``float32`` they can be optimised.
   - |exposed|, |differentiable|

A captured radiance field (Datta et al., *Efficient Graphics Representation with Differentiable Indirection*, SIGGRAPH
Asia 2023, task 7) among ordinary surfaces. Each camera ray is marched through the field up to the first surface; what
the field emits is added up from front to back, and the radiance of the inner integrator is added, times the
transmittance that is left. A ray that the field makes opaque (a transmittance below :math:`10^{-4}`) never sees a
surface, one that misses the field's box is the inner integrator's alone. On the film, alpha is one minus the
transmittance where there is nothing behind.

**Mirrors and glass.** Rays are followed across surfaces that are smooth throughout (:monosp:`conductor`,
:monosp:`dielectric`, :monosp:`thindielectric`, :monosp:`null`, no medium inside), and marched through the field between
them. Other surfaces, those with a smooth lobe and another one among them
(:monosp:`plastic`, :monosp:`mask`), are the inner integrator's, to which there is no field: it is not seen in
them and through them, casts no light and no shadow, and is not seen in rough mirrors. Paths of a limited ``max_depth``
may be longer by the smooth surfaces before. Participating media count as being behind the field. Footprints go with the
rays, over mirrors, too.

**Spectral variants** take radiance for that of an emitter of this colour: upsampled, times D65. ``mono`` takes the
luminance. Not for polarised variants.

**Several fields** are nested in one another, the integrator for surfaces in the last; ``smooth_depth`` and ``aovs`` are
those of the outermost. Up to four, the boxes of which may not overlap.

**Derivatives** with respect to the field's arrays replay the rays (Vicini et al., *Path Replay Backpropagation*,
SIGGRAPH 2021), of the radiance, of alpha and of the channels of ``aovs``. An inner integrator that replays paths, too
(:monosp:`path_footprint`, :monosp:`path_sdf`, :monosp:`prb`, …) adds those of materials, textures and emitters; any
other one is a constant, and so is the geometry.

Mitsuba's own base classes write an alpha of 0 or 1 and fail with AOVs in the backward pass, because they multiply AOVs,
which are numbers, by the ray's weight, which is a spectrum. This integrator has passes of its own. Within another
integrator, such as :monosp:`aov`, alpha is 0 or 1.

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
class Followed:
    """
    Rays of a wavefront on their way: ``ray``, whether it goes on (``active``) or has ended where the inner integrator
    takes over (``handed``), its ``throughput``, the product of the transmittances as long as nothing but them changed
    it (``clear``), whether it has been ``turned`` by a surface, of how many smooth ones there were (``count``).
    ``light`` and ``depth``: what was seen so far; in the differential phases, what is still to come, and ``opacity`` is
    the whole there. ``change``: the derivative of ``light``;
    ``change_clear``: that of ``clear``, over ``clear``; and those of the further channels. ``differentials``: those of
    the rays, where textures ask for footprints.
    """

    ray: mi.Ray3f
    active: mi.Bool
    handed: mi.Bool
    throughput: mi.Spectrum
    clear: mi.Float
    turned: mi.Bool
    count: mi.UInt32
    light: mi.Spectrum
    opacity: mi.Float
    depth: mi.Float
    change: mi.Spectrum
    change_clear: mi.Float
    change_opacity: mi.Float
    change_depth: mi.Float
    differentials: Differentials


def carries(ray) -> bool:
    """Does it carry differentials, for textures that ask for footprints?"""
    return bool(getattr(ray, "has_differentials", False))


def is_smooth(bsdf):
    """Is it a mirror or a pane, and nothing else, wherever it is?"""
    flags = bsdf.flags()
    return mi.has_flag(flags, mi.BSDFFlags.Delta) & ~mi.has_flag(flags, mi.BSDFFlags.Smooth)


def has_smooth(scene: mi.Scene) -> bool:
    """Is there a surface in the scene across which rays are followed? One that is instanced counts in any case."""
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        if compat.is_instance(shape):
            return True
        if bsdf is not None and is_smooth(bsdf) and not shape.is_medium_transition():
            return True
    return False


def in_order(fields: list, entered: list) -> list:
    """
    The fields, in the order in which rays enter them, with the rays that enter one at this place: ``entered`` holds the
    distance to each, and whether it is crossed.
    """
    if len(fields) == 1:
        return [(fields[0], entered[0][1])]
    ranks = []
    for i, (near, _) in enumerate(entered):
        rank = mi.UInt32(0)
        for j, (other, crossed) in enumerate(entered):
            if j != i:
                rank += dr.select(crossed & ((other < near) | ((other == near) & (j < i))), mi.UInt32(1), 0)
        ranks.append(rank)
    found = []
    for place in range(len(fields)):
        found += [(field, entered[i][1] & (ranks[i] == place)) for i, field in enumerate(fields)]
    return found


def named(integrator) -> str:
    """The name of an integrator's class, in Python or C++."""
    return type(integrator).__name__ if compat.written_in_python(integrator) else integrator.class_name()


def with_holes(scene: mi.Scene) -> list[str]:
    """Names of shapes whose material is a surface in part and nothing in part, as a ``mask`` makes it."""
    found = []
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        if bsdf is not None:
            flags = bsdf.flags()
            if mi.has_flag(flags, mi.BSDFFlags.Null) and mi.has_flag(flags, mi.BSDFFlags.Smooth):
                found.append(shape.id())
    return found


@cache
def integrator() -> type:
    """The class, in the variant that is set."""

    class NeuralField(compat.replay_integrator()):
        __doc__ = MANUAL

        def __init__(self, props: mi.Properties, field=None):
            """``field``, a ``VolumeField``, takes the place of a file's."""
            if mi.is_polarized:
                raise RuntimeError("neural_field: does not run in polarised variants")
            super().__init__(props)
            self.nested = self.surfaces = self._inner(props)
            self.smooth_depth = props.get("smooth_depth", SMOOTH)
            if not isinstance(self.smooth_depth, int) or not 0 <= self.smooth_depth <= 64:
                raise RuntimeError(
                    f'parameter "smooth_depth": found {self.smooth_depth}, allowed are whole numbers from 0 to 64'
                )
            self.aovs = self._asked(str(props.get("aovs", "")))
            self.model = None
            if field is None:
                self.model = open_model(props)
                field = self.model.field
            self.placed = PlacedField(field, props.get("to_world", mi.ScalarTransform4f()))
            self.light = Light()
            self.held = self.placed.held()
            self.fields = [self.placed]
            if isinstance(self.nested, NeuralField):
                self.fields += self.nested.fields
                self.surfaces = self.nested.surfaces
            if len(self.fields) > MOST:
                raise RuntimeError(f"found {len(self.fields)} nested fields, allowed are {MOST}")
            for other in self.fields[1:]:
                if self.placed.overlaps(other):
                    raise RuntimeError("the boxes of two fields overlap, where their order along a ray is not known")
            self._warned = False
            self._shapes = {name: tuple(values.shape) for name, values in self.placed.exposed.items()}

        @staticmethod
        def _inner(props: mi.Properties):
            """The integrator of surfaces. Raises ``RuntimeError`` if it cannot be one."""
            given = [child for _, child in props.objects() if isinstance(child, mi.Integrator)]
            own = [name for name in INNER if name in props]
            if not given:
                inner = mi.Properties("path_footprint")
                for name in own:
                    inner[name] = props[name]
                return path_footprint()(inner)
            if len(given) > 1:
                raise RuntimeError(f"found {len(given)} nested integrators, allowed is one, for the surfaces")
            if own:
                raise RuntimeError(f'parameter "{own[0]}": belongs to the nested integrator')
            found = given[0]
            if not isinstance(found, mi.SamplingIntegrator):
                raise RuntimeError(
                    f"the nested integrator {named(found)}: does not follow rays from a camera, as path does"
                )
            if found.aov_names():
                raise RuntimeError(
                    f"the nested integrator {named(found)}: has AOVs of its own, which are not passed on; put "
                    f"neural_field into it"
                )
            return found

        @staticmethod
        def _asked(text: str) -> list[str]:
            names = [name.strip() for name in text.split(",") if name.strip()]
            for name in names:
                if name not in AOVS or names.count(name) > 1:
                    raise RuntimeError(f'parameter "aovs": found "{text}", allowed are {", ".join(AOVS)}, each once')
            return names

        # -- as an object of Mitsuba ------------------------------------------------------------------------------

        def traverse(self, cb: mi.TraversalCallback) -> None:
            for name, values in self.placed.exposed.items():
                cb.put(f"tables.{name}", values, mi.ParamFlags.Differentiable)
            cb.put("surfaces", self.nested, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys=()) -> None:
            for name, values in self.placed.exposed.items():
                found, expected = tuple(values.shape), self._shapes[name]
                if found != expected:
                    raise RuntimeError(f'parameter "tables.{name}": has the shape {found}, expected {expected}')

        def aov_names(self) -> list[str]:
            return list(self.aovs)

        def report(self) -> dict:
            field = self.placed.field
            said = {"voxel": field.voxel * self.placed.placement.size, "surfaces": named(self.surfaces)}
            if self.model is None:
                return said
            return {
                "preset": self.model.table.preset,
                "storage": self.model.storage,
                "table_bytes": self.model.nbytes,
                **said,
            }

        def to_string(self) -> str:
            path = self.model.table.path if self.model is not None else ""
            inner = str(self.surfaces).replace("\n", "\n  ")
            return (
                f'NeuralField[\n  filename = "{path}",\n  smooth_depth = {self.smooth_depth},\n'
                f'  aovs = "{",".join(self.aovs)}",\n  surfaces = {inner}\n]'
            )

        def counts(self, scene, sensor=0) -> dict:
            """What the camera's rays, one through each pixel, read of the field (:class:`.counting.Counts`)."""
            with dr.suspend_grad():
                _, _, _, ray, _, _ = self._begin(scene, sensor, 0, 1)
                pi = scene.ray_intersect_preliminary(ray, coherent=True, active=True)
                return self.placed.count(ray, dr.minimum(pi.t, ray.maxt)).asdict()

        # -- the film ---------------------------------------------------------------------------------------------

        def sample_rays(self, scene, sensor, sampler):
            """As the inner integrator does."""
            if compat.written_in_python(self.surfaces):
                return self.surfaces.sample_rays(scene, sensor, sampler)
            return super().sample_rays(scene, sensor, sampler)

        def _begin(self, scene, sensor, seed, spp) -> tuple:
            if not self._warned:
                self._warned = True
                holes = with_holes(scene)
                if holes:
                    warn(f'neural_field: no field is seen through the holes of "{holes[0]}"')
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            sampler, spp = self.prepare(sensor, seed, spp, self.aov_names())
            ray, weight, place = self.sample_rays(scene, sensor, sampler)
            return sensor.film(), sampler, spp, ray, weight, place

        @staticmethod
        def _developed(film, spp, place, light, alpha, aovs, wavelengths):
            """The image of these samples. AOVs are no light: the weight of a ray has nothing to do with them."""
            block = film.create_block()
            block.set_coalesce(block.coalesce() and spp >= 4)
            compat.splat(block, film, place, light, alpha, aovs, wavelengths)
            film.put_block(block)
            return film.develop()

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            if not develop:
                raise RuntimeError("neural_field: renders with develop=True only")
            with dr.suspend_grad():
                film, sampler, spp, ray, weight, place = self._begin(scene, sensor, seed, spp)
                light, alpha, aovs, _ = self.primal(scene, sampler, ray)
                return self._developed(film, spp, place, light * weight, alpha, aovs, ray.wavelengths)

        def render_forward(self, scene, params, sensor=0, seed=0, spp=0):
            with dr.suspend_grad():
                film, sampler, spp, ray, weight, place = self._begin(scene, sensor, seed, spp)
                surfaces = self._surfaces_optimised(scene)
                _, _, _, state = self.primal(scene, sampler.clone(), ray)
                light, alpha, aovs = self.replayed(dr.ADMode.Forward, scene, sampler, ray, state, surfaces)
                return self._developed(film, spp, place, light * weight, alpha, aovs, ray.wavelengths)

        def render_backward(self, scene, params, grad_in, sensor=0, seed=0, spp=0):
            with dr.suspend_grad():
                film, sampler, spp, ray, weight, place = self._begin(scene, sensor, seed, spp)
                surfaces = self._surfaces_optimised(scene)
                # What reaches the film is linear in these, so that their values do not matter
                with dr.resume_grad():
                    count = dr.width(ray)
                    light, alpha = dr.full(mi.Spectrum, 1, count), dr.full(mi.Float, 1, count)
                    aovs = [dr.full(mi.Float, 1, count) for _ in self.aovs]
                    dr.enable_grad(light, alpha, aovs)
                    image = self._developed(film, spp, place, light * weight, alpha, aovs, ray.wavelengths)
                    dr.set_grad(image, grad_in)
                    dr.enqueue(dr.ADMode.Backward, image)
                    dr.traverse(dr.ADMode.Backward)
                    adjoint = dr.grad(light), dr.grad(alpha), dict(zip(self.aovs, dr.grad(aovs), strict=True))
                film.clear()
                _, _, _, state = self.primal(scene, sampler.clone(), ray)
                self.replayed(dr.ADMode.Backward, scene, sampler, ray, state, surfaces, adjoint)
                dr.eval()

        def _surfaces_optimised(self, scene) -> bool:
            """Is a derivative with respect to anything but the field asked for?"""
            own = {compat.identity(values) for placed in self.fields for values in placed.exposed.values()}
            params = mi.traverse(scene)
            values = [params[key] for key in params.keys()]
            attached = [v for v in values if isinstance(v, dr.ArrayBase) and compat.has_gradient(v)]
            return any(compat.identity(v) not in own for v in attached)

        def sample(self, mode, scene, sampler, ray, δL=None, δaovs=None, state_in=None, active=True, **kwargs):
            """See ``ADIntegrator.sample``; for integrators that this one is nested in, which derive nothing."""
            if mode != dr.ADMode.Primal:
                raise RuntimeError("neural_field: has passes of its own for derivatives, and cannot be nested for them")
            light, alpha, aovs, state = self.primal(scene, sampler, ray, active)
            return light, alpha > 0, aovs, state

        # -- rays -------------------------------------------------------------------------------------------------

        def primal(self, scene, sampler, ray, active=True) -> tuple:
            """
            Light, alpha and the further channels of camera rays, and what the differential phases need to know: the
            light, one minus alpha, depth and opacity, and the state of the inner integrator.
            """
            path = self._start(ray, active)
            sampler, path = self._follow(None, scene, sampler, path, None, carries(ray))
            inner, valid, state = self._surfaces(dr.ADMode.Primal, scene, sampler, ray, path)
            light = path.light + dr.select(path.handed, path.throughput * inner, 0)
            clear = dr.select(path.handed & valid, 0, path.clear)
            aovs = {"depth": path.depth, "opacity": path.opacity}
            state = light, clear, path.depth, path.opacity, state
            return light, 1 - clear, [aovs[name] for name in self.aovs], state

        def replayed(self, mode, scene, sampler, ray, state, surfaces, adjoint=None) -> tuple:
            """
            For ``Forward``, the derivatives of light, alpha and channels; for ``Backward``, those with respect to these
            are given (``adjoint``, the channels as a dictionary), and carried on to the parameters.
            """
            light, clear, depth, opacity, inner_state = state
            path = self._start(ray, True)
            path.light, path.depth, path.opacity = mi.Spectrum(light), mi.Float(depth), mi.Float(opacity)
            more = dr.zeros(mi.Float), dr.zeros(mi.Float)
            if mode == dr.ADMode.Backward:
                # Of alpha, that of the logarithm of a transmittance is the same at all of them
                aovs = adjoint[2]
                path.change = mi.Spectrum(adjoint[0])
                path.change_clear = mi.Float(-adjoint[1] * clear)
                path.change_opacity = mi.Float(aovs.get("opacity", more[0]))
                path.change_depth = mi.Float(aovs.get("depth", more[1]))
            sampler, path = self._follow(mode, scene, sampler, path, surfaces, carries(ray))
            change = path.change
            if surfaces and compat.replays_paths(self.surfaces):
                δ = None
                if mode == dr.ADMode.Backward:
                    δ = dr.select(path.handed, path.change * path.throughput, 0)
                inner, _, _ = self._surfaces(mode, scene, sampler, ray, path, δ, inner_state)
                if mode == dr.ADMode.Forward:
                    change = change + dr.select(path.handed, path.throughput * inner, 0)
            aovs = {"depth": path.change_depth, "opacity": path.change_opacity}
            return change, -clear * path.change_clear, [aovs[name] for name in self.aovs]

        def _start(self, ray, active) -> Followed:
            path = dr.zeros(Followed)
            path.ray = mi.Ray3f(dr.detach(ray))
            path.active, path.handed, path.turned = mi.Bool(active), mi.Bool(False), mi.Bool(False)
            path.throughput, path.clear = mi.Spectrum(1), mi.Float(1)
            path.differentials = Differentials.of(ray)
            return path

        def _surfaces(self, mode, scene, sampler, ray, path, δL=None, state=None) -> tuple:
            """What the inner integrator says of the rays that are handed to it: light, whether it is valid, state."""
            onward = mi.RayDifferential3f(path.ray)
            onward.has_differentials = carries(ray)
            if onward.has_differentials:
                found = path.differentials
                onward.o_x, onward.o_y = onward.o + found.ox, onward.o + found.oy
                onward.d_x, onward.d_y = onward.d + found.dx, onward.d + found.dy
            if not compat.written_in_python(self.surfaces):
                light, valid, _ = self.surfaces.sample(scene, sampler, onward, None, path.handed)
                return light, valid, None
            light, valid, _, state = self.surfaces.sample(
                mode=mode, scene=scene, sampler=sampler, ray=onward, depth=mi.UInt32(0), δL=δL, δaovs=None,
                state_in=state, active=mi.Bool(path.handed),
            )  # fmt: skip
            return light, valid, state

        def _follow(self, mode, scene, sampler, path, surfaces, carried: bool) -> tuple:
            """
            Rays up to where the inner integrator takes over: the primal phase if there is no ``mode``. One piece is
            enough where nothing is smooth.
            """
            solids = sdf.solids_of(scene) if hasattr(self.surfaces, "sample_solids") else []
            if self.smooth_depth == 0 or not has_smooth(scene):
                return sampler, self._piece(mode, scene, sampler, path, solids, surfaces, False, False)

            def body(sampler, path):
                return sampler, self._piece(mode, scene, sampler, path, solids, surfaces, True, carried)

            label = "neural_field" if mode is None else f"neural_field ({mode.name})"
            return dr.while_loop(
                (sampler, path), lambda _, path: path.active, body, max_iterations=self.smooth_depth + 1, label=label
            )

        def _piece(self, mode, scene, sampler, path, solids, surfaces, onward: bool, carried: bool) -> Followed:
            """
            A piece of each ray, up to a surface; if ``onward``, beyond it where that is smooth. ``carried``: with
            differentials.
            """
            ray, active = path.ray, path.active
            first = path.count == 0
            entered = [placed.enters(ray, ray.maxt, active) for placed in self.fields]
            met = active
            if not onward and "depth" not in self.aovs:
                met = mi.Bool(False)
                for _, crossed in entered:
                    met |= crossed
            pi, far, solid = self._meet(scene, solids, ray, met, path.turned)
            through = mi.Float(1)
            for placed, crossed in in_order(self.fields, entered):
                through = self._see(mode, path, placed, ray, far, crossed, first, through)
            if mode is None:
                distance = dr.select(met & (pi.is_valid() | solid), far, 0)
                path.opacity = dr.select(first, 1 - through, path.opacity)
                path.depth += dr.select(first, through * distance, 0)
            path.active, path.handed = mi.Bool(False), path.handed | (active & (through > 0))
            if not onward:
                return path
            light, passed = path.light, path.throughput

            # Across a smooth surface
            arrived = active & (through > 0) & ~solid
            flags = mi.RayFlags.All | mi.RayFlags.dNSdUV if carried else mi.RayFlags.All
            si = pi.compute_surface_interaction(ray, ray_flags=flags, active=arrived)
            bsdf = si.bsdf(ray)
            going = arrived & si.is_valid() & (path.count < self.smooth_depth)
            going &= is_smooth(bsdf) & ~si.shape.is_medium_transition()
            shining = mi.Bool(going)
            if self.surfaces.hide_emitters:
                # The inner integrator would hide them in mirrors, too
                emitter = si.emitter(scene, arrived)
                ended = arrived & path.turned & ~going & (emitter != None)  # noqa: E711  (lane by lane)
                shining |= ended
                path.handed &= ~ended
            with dr.resume_grad(when=bool(mode is not None and surfaces)):
                emitted = passed * si.emitter(scene, shining).eval(si, shining)
                bs, weight = bsdf.sample(
                    mi.BSDFContext(), si, sampler.next_1d(going), sampler.next_2d(going), going
                )  # fmt: skip
            beyond = dr.detach(weight)
            emitted_now = dr.select(shining, dr.detach(emitted), 0)
            path.light = light + emitted_now if mode is None else light - emitted_now
            if mode is not None and surfaces:
                with dr.resume_grad():
                    both = dr.select(shining, emitted, 0) + dr.select(going, path.light * relative(weight), 0)
                    if mode == dr.ADMode.Backward:
                        dr.backward_from(path.change * both, dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
                    else:
                        path.change += dr.forward_to(both, flags=dr.ADFlag.Default | dr.ADFlag.AllowNoGrad)
            bs = dr.detach(bs)
            turned = going & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            out = si.to_world(bs.wo)
            path.ray = dr.select(going, si.spawn_ray(out), ray)
            if carried:
                edges = compat.normal_edges(pi, si, ray, going)
                found = path.differentials.at(ray, si)
                found = found.bounced(ray, si, out, bs.eta, bs.pdf, mi.Bool(True), mi.Float(1), edges)
                path.differentials = dr.select(going, found, path.differentials)
            path.throughput = dr.select(going, passed * beyond, passed)
            path.clear = dr.select(turned, 0, path.clear)
            path.turned |= turned
            path.handed &= ~going
            path.active = going & (dr.max(path.throughput) > 0)
            path.count = dr.select(going, path.count + 1, path.count)
            return path

        def _meet(self, scene, solids, ray, active, turned) -> tuple:
            """What rays meet first, its distance (``maxt`` if nothing), and whether that is a solid of ``path_sdf``."""
            pi = scene.ray_intersect_preliminary(ray, coherent=True, active=active)
            if self.surfaces.hide_emitters:
                # As the inner integrator does with what it sees first
                hidden = active & ~turned & pi.is_valid() & (pi.shape.emitter() != None)  # noqa: E711  (lane by lane)
                at = pi.compute_surface_interaction(ray, mi.RayFlags.Minimal, hidden)
                after = self.skip_area_emitters(scene, at.spawn_ray(ray.d), True, hidden)
                after.t += at.t
                pi[hidden] = after
            far = dr.minimum(pi.t, ray.maxt)
            if not solids:
                return pi, far, mi.Bool(False)
            met = sdf.meet(solids, ray.o, ray.d, far, active)
            pi.t = dr.select(met.which > 0, dr.inf, pi.t)
            return pi, met.t, met.which > 0

        def _see(self, mode, path, placed, ray, far, crossed, first, before):
            """
            What a field adds to a piece, of which ``before`` is transmitted up to there; returns what is, beyond it.
            """
            marched = placed.march(ray, far, crossed)
            through = dr.select(marched.transmittance > OPAQUE, marched.transmittance, 0)
            light = dr.select(crossed, path.throughput * self.light.of(marched.colour, ray.wavelengths, crossed), 0)
            depth = dr.select(first, before * marched.depth * placed.size, 0)
            if mode is None:
                path.light, path.depth = path.light + light, path.depth + depth
            else:
                path.light, path.depth = path.light - light, path.depth - depth
                if placed.optimised():
                    self._derive(mode, path, placed, ray, far, crossed, first, before, marched, through)
            path.throughput, path.clear = path.throughput * through, path.clear * through
            return before * through

        def _derive(self, mode, path, placed, ray, far, crossed, first, before, marched, through) -> None:
            """The derivatives of what a field adds to a piece, with what is still to come behind it in ``path``."""
            inverse = dr.select(through > 0, dr.rcp(through), 0)
            # Of the logarithm of a transmittance: all that is transmitted
            behind, clear = dr.select(first, path.depth, 0), dr.select(first, 1 - path.opacity, 0)
            if mode == dr.ADMode.Backward:
                d_colour = self.light.adjoint(marched.colour, ray.wavelengths, path.change * path.throughput, crossed)
                d_through = dr.sum(path.change * path.light) + path.change_clear
                d_through += path.change_depth * behind - path.change_opacity * clear
                d_depth = dr.select(first, path.change_depth * before, 0)
                placed.replay(ray, far, crossed, marched, d_colour, d_through * inverse, d_depth)
                return
            colour, transmittance, depth = placed.tangent(ray, far, crossed, marched)
            seen = self.light.tangent(marched.colour, colour, ray.wavelengths, crossed)
            share = transmittance * inverse
            path.change += dr.select(crossed, path.throughput * seen + path.light * share, 0)
            path.change_clear += share
            path.change_opacity -= clear * share
            path.change_depth += dr.select(first, before * depth, 0) + behind * share

    return NeuralField


def open_model(props: mi.Properties):
    """The model that the properties ``filename`` and ``storage`` name. Raises ``RuntimeError``."""
    path, storage = properties.filename(props), properties.one_of(props, "storage", ("uint8", "float32"))
    if not path:
        raise RuntimeError('parameter "filename": not given, a file of "mi-diffind fit field" is needed')
    from mi_diffind.tasks.radiance import TASK

    try:
        return TASK.open(mi.TensorXf, path, storage=storage if storage == "float32" else "")
    except (TableError, ValueError) as e:
        raise RuntimeError(str(e)) from None


PLUGIN = Plugin(
    "neural_field",
    "integrator",
    lambda props: integrator()(props),
    task="field",
    exact=Counterpart("neural_field", convert=to_grid),
)
