"""Ray marching: emission and absorption from front to back, the derivatives of both, and counts of the reads.

A ray is divided into steps of a fixed length from the point where it enters the box; the last step is cut where the ray
leaves. In surroundings, steps grow (:class:`.nodes.GrowingSteps`). Distances count from the point of
entry, since a step might be too short to change a distance from afar. Each step has one density and one radiance, so a
homogeneous medium is Beer–Lambert exactly. Steps that are certainly empty are skipped, which changes nothing. No
radiance is read where the density is zero. The ray ends when it is opaque (:data:`OPAQUE`).

Derivatives replay the ray (Vicini et al., *Path Replay Backpropagation*, SIGGRAPH 2021): with the light R that is seen
from a step on and the transmittance T behind the step, ∂L/∂σ = δ (T c − R). There is no division.
"""

import drjit as dr

from ...arrays.boxes import box_interval, is_direction
from ...core import compat
from .volume_field import VolumeField

#: Transmittance at which a ray ends.
OPAQUE = 1e-4

#: Flags of derivatives: not all arrays have to be differentiated.
ANY = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad

#: Flags as :data:`ANY`, but the derivatives of intermediate results remain.
KEPT = dr.ADFlag.ClearEdges | dr.ADFlag.AllowNoGrad


class Marched:
    """Result of a marched ray: ``colour`` (premultiplied), ``transmittance`` and ``depth``.

    ``depth`` is Σ w t over the steps; divided by the opacity, it is the mean distance.
    """

    def __init__(self, colour=None, transmittance=None, depth=None):
        self.colour, self.transmittance, self.depth = colour, transmittance, depth


def box(field, o, d, near, far, active):
    """Return the part of each ray in the field's box: origin, distance, length, and whether it exists.

    A ray with NaN, or without a direction (:func:`.boxes.is_direction`), has no part in the box.
    """
    types = field.types
    near, far = types.Float(near), types.Float(far)
    near, far, active = box_interval(o, d, *field.box, near, far, types.Bool(active))
    # Comparisons with NaN are false
    active &= (near < far) & dr.isfinite(near) & dr.isfinite(far) & is_direction(dr.detach(d))
    # The difference of two large distances may be longer than the box, whose diagonal a direction of ½ makes 2 long
    lower, upper = field.box
    longest = 2 * dr.norm(types.Array3f(upper) - types.Array3f(lower))
    entry = types.Array3f(dr.fma(d, near, o))
    # From too far away, single precision loses the box
    active &= dr.norm(dr.detach(entry) - types.Array3f(lower)) < longest
    return entry, near, dr.minimum(far - near, longest), active


@compat.syntax
def march(field, o, d, near, far, active=True, offset=0.5, visibility=None) -> Marched:
    """March the rays ``o + t d`` through a field, for t from ``near`` to ``far``.

    ``d`` has unit length; ``offset`` in [0, 1) is the position within a step at which the field is read.

    With ``visibility``, a float array with the entries of ``field.nodes``, no colours are read, and its entries are
    raised to the largest weight of each cell in a ray: its transmittance times the opacity of a step. That of a cell is
    the one of its first corner.
    """
    types = field.types
    with dr.suspend_grad():
        o, near, far, active = box(field, o, d, near, far, active)
        t, step = types.Float(0), dr.opaque(types.Float, field.step)
        steps = field.along(o, d)
        far = steps.in_steps(far)
        seen, depth, through = types.Array3f(0), types.Float(0), types.Float(1)
        offset = types.Float(offset)
        while active:
            t, here = _next(field, o, d, t, far, step, offset, active, steps)
            end = dr.minimum(t + step, far)
            at = steps.of_steps(dr.fma(offset, end - t, t))
            p = dr.fma(d, at, o)
            density, point_data = field.density_at(p, here)
            passed = through * dr.exp(-density * (steps.of_steps(end) - steps.of_steps(t)))
            weight = dr.select(here, through - passed, 0)
            if dr.hint(visibility is not None, mode="scalar"):
                dr.scatter_reduce(dr.ReduceOp.Max, visibility, weight, field.nodes.cell(p, here), here)
            else:
                shown = here & (weight > field.least_weight)
                colour = types.Array3f(0)
                if shown:
                    colour = types.Array3f(*field.radiance_at(point_data, p, d, shown))
                seen += dr.select(shown, weight * colour, 0)
            depth += weight * (near + at)
            through = dr.select(here, passed, through)
            t += step
            active &= here & (t < far) & (through > OPAQUE)
    return Marched(seen, through, depth)


@compat.syntax
def _next(field, o, d, t, far, step, offset, active, steps):
    """Return the start of the next step, from ``t`` on, that may not be empty, and whether there is one."""
    types = field.types
    t = types.Float(t)
    searching = types.Bool(active)
    occupied = types.Bool(False)
    while searching:
        at = dr.fma(offset, dr.minimum(t + step, far) - t, t)
        distance = steps.of_steps(at)
        free = field.free_distance(dr.fma(d, distance, o), d, searching)
        empty = free > 0
        occupied |= searching & ~empty
        free = steps.skipped(at, distance, free)
        t = dr.select(searching & empty, dr.fma(dr.floor(free / step) + 1, step, t), t)
        searching &= empty & (t < far)
    return t, occupied


def replay(
    field, o, d, near, far, active, offset, marched: Marched, d_colour, d_transmittance=0, d_depth=0, moving=False
) -> None:
    """Add to the gradients of ``field.arrays``, given those with respect to colour, transmittance and depth.

    ``marched`` is what :func:`march` returned for these arguments. ``moving``: gradients also reach what the rays
    ``o``, ``d``, ``near`` and ``far`` are attached to.
    """
    _follow(field, o, d, near, far, active, offset, marched, (d_colour, d_transmittance, d_depth), moving)


def tangent(field, o, d, near, far, active, offset, marched: Marched, moving=False) -> tuple:
    """Return the derivatives of colour, transmittance and depth along the tangents set for ``field.arrays``.

    ``moving``: also along those of what the rays ``o``, ``d``, ``near`` and ``far`` are attached to.
    """
    return _follow(field, o, d, near, far, active, offset, marched, None, moving)


@compat.syntax
def _follow(field, o, d, near, far, active, offset, marched, adjoint, moving):
    types = field.types
    with dr.suspend_grad():
        attached = o, d, near, far
        o, d = types.Array3f(dr.detach(o)), types.Array3f(dr.detach(d))
        o, near, far, active = box(field, o, d, near, far, active)
        crossing = types.Bool(active)
        t, step = types.Float(0), dr.opaque(types.Float, field.step)
        steps = field.along(o, d)
        far = steps.in_steps(far)
        through = types.Float(1)
        offset = types.Float(offset)
        total = dr.detach(marched.transmittance)
        rest, rest_depth = types.Array3f(dr.detach(marched.colour)), types.Float(dr.detach(marched.depth))
        d_colour, d_through, d_depth = types.Array3f(0), types.Float(0), types.Float(0)
        if dr.hint(adjoint is not None, mode="scalar"):
            d_colour, d_through, d_depth = types.Array3f(adjoint[0]), types.Float(adjoint[1]), types.Float(adjoint[2])
        # Tangents (forward) or gradients (backward) of the place of entry, direction, length, and distance of entry
        d_entry, d_way, d_length, d_near = types.Array3f(0), types.Array3f(0), types.Float(0), types.Float(0)
        if dr.hint(moving and adjoint is None, mode="scalar"):
            with dr.resume_grad():
                rays = _attached(field, *attached, crossing)
                d_entry, d_way, d_length, d_near = dr.forward_to(*rays, flags=KEPT)
        while active:
            t, here = _next(field, o, d, t, far, step, offset, active, steps)
            end = dr.minimum(t + step, far)
            length = steps.of_steps(end) - steps.of_steps(t)
            at = steps.of_steps(dr.fma(offset, end - t, t))
            p = dr.fma(d, at, o)
            place, way = p, d
            # The last step ends where the ray does
            last = dr.select(t + step > far, types.Float(1), 0)
            with dr.resume_grad():
                if dr.hint(moving, mode="scalar"):
                    place, way = types.Array3f(dr.detach(p)), types.Array3f(dr.detach(d))
                    dr.enable_grad(place, way)
                    if dr.hint(adjoint is None, mode="scalar"):
                        dr.set_grad(place, d_entry + at * d_way + d * (last * offset * d_length))
                        dr.set_grad(way, d_way)
                density, point_data = field.density_at(place, here)
            passed = through * dr.exp(-dr.detach(density) * length)
            weight = dr.select(here, through - passed, 0)
            shown = here & (weight > field.least_weight)
            colour, radiance, change = types.Array3f(0), types.Array3f(0), types.Array4f(0)
            if dr.hint(moving, mode="scalar"):
                # Not in a branch: derivatives of the place leave it
                with dr.resume_grad():
                    radiance = types.Array3f(*field.radiance_at(point_data, place, way, shown))
                    if dr.hint(adjoint is None, mode="scalar"):
                        change = types.Array4f(dr.select(here, density, 0), *radiance)
                        change = dr.forward_to(change, flags=ANY)
                colour = dr.detach(radiance)
            elif shown:
                # Nothing that is differentiated leaves this branch
                with dr.resume_grad():
                    radiance = types.Array3f(*field.radiance_at(point_data, p, d, shown))
                    if dr.hint(adjoint is not None, mode="scalar"):
                        dr.backward_from(dr.dot(radiance, d_colour * weight), ANY)
                    else:
                        d_colour += weight * dr.forward_to(radiance, flags=ANY)
                colour = dr.detach(radiance)
            rest -= weight * dr.select(shown, colour, 0)
            rest_depth -= weight * (near + at)
            step_colour = passed * dr.select(shown, colour, 0) - rest
            step_depth = passed * (near + at) - rest_depth
            if dr.hint(adjoint is not None, mode="scalar"):
                slope = dr.dot(d_colour, step_colour) + d_depth * step_depth - d_through * total
                if dr.hint(moving, mode="scalar"):
                    with dr.resume_grad():
                        light = dr.select(here, density * (length * slope), 0)
                        light += dr.select(shown, dr.dot(radiance, d_colour * weight), 0)
                        dr.backward_from(light, ANY)
                        moved, turned = dr.grad(place), dr.grad(way)
                    moved = dr.select(here, moved, 0)
                    d_entry += moved
                    d_way += at * moved + dr.select(here, turned, 0)
                    d_near += d_depth * weight
                    along = offset * (dr.dot(moved, d) + d_depth * weight)
                    d_length += last * dr.select(here, dr.detach(density) * slope + along, 0)
                else:
                    # A density of 0 has no derivative: most steps are read again to save the sums of the others
                    dense = here & (dr.detach(density) > 0)
                    if dense:
                        with dr.resume_grad():
                            again, _ = field.density_at(p, dense)
                            dr.backward_from(again * (length * slope), ANY)
            else:
                if dr.hint(moving, mode="scalar"):
                    rate = length * change[0] + last * dr.select(here, dr.detach(density), 0) * d_length
                    d_colour += dr.select(shown, weight * types.Array3f(change[1], change[2], change[3]), 0)
                    d_depth += weight * (d_near + last * offset * d_length)
                else:
                    with dr.resume_grad():
                        rate = length * dr.forward_to(dr.select(here, density, 0), flags=ANY)
                d_colour += rate * step_colour
                d_depth += rate * step_depth
                d_through -= rate * total
            through = dr.select(here, passed, through)
            t += step
            active &= here & (t < far) & (through > OPAQUE)
        if dr.hint(moving and adjoint is not None, mode="scalar"):
            with dr.resume_grad():
                entry, way, length, near = _attached(field, *attached, crossing)
                moved = dr.dot(entry, d_entry) + dr.dot(way, d_way) + length * d_length + near * d_near
                dr.backward_from(moved, ANY)
    return d_colour, d_through, d_depth


def _attached(field, o, d, near, far, active) -> tuple:
    """Return place of entry, direction, length, and distance of entry of rays, attached; 0 where not ``active``."""
    types = field.types
    o = types.Array3f(*(dr.select(active, x, 0) for x in o))
    # Else parallel to the sides of the box
    d = types.Array3f(*(dr.select(active & (dr.abs(x) > 1e-10), x, 0) for x in d))
    entry, near, length, _ = box(field, o, d, near, far, active)
    return dr.select(active, entry, 0), d, dr.select(active, length, 0), dr.select(active, near, 0)


class _March(dr.CustomOp):
    def eval(self, arrays, field, o, d, near, far, active, offset):
        self.field, self.arguments = field, (o, d, near, far, active, offset)
        self.arrays = arrays
        self.marched = march(field.with_arrays(arrays), *self.arguments)
        return self.marched.colour, self.marched.transmittance, self.marched.depth

    def _attached(self):
        arrays = {name: type(value)(dr.detach(value)) for name, value in self.arrays.items()}
        dr.enable_grad(arrays)
        return arrays, self.field.with_arrays(arrays)

    def backward(self):
        arrays, field = self._attached()
        replay(field, *self.arguments, self.marched, *self.grad_out())
        self.set_grad_in("arrays", dr.grad(arrays))

    def forward(self):
        arrays, field = self._attached()
        dr.set_grad(arrays, self.grad_in("arrays"))
        self.set_grad_out(tangent(field, *self.arguments, self.marched))


def differentiable(field, o, d, near, far, active=True, offset=0.5) -> Marched:
    """March rays as :func:`march` does, with derivatives with respect to ``field.arrays``; rays are constants."""
    return Marched(*dr.custom(_March, field.arrays, field.with_arrays({}), o, d, near, far, active, offset))


class CountingField(VolumeField):
    """Field that counts the reads of density and radiance of another ``field``.

    ``reads_all``: no space is known to be empty, so every step up to an opaque part reads the density.
    """

    def __init__(self, field: VolumeField, reads_all: bool = False):
        super().__init__(field.types, field.lower, field.upper, field.voxel, field.arrays)
        self.field, self.reads_all, self.box, self.along = field, reads_all, field.box, field.along
        self.counts = dr.zeros(field.types.UInt32, 2)

    def _count(self, which: int, active) -> None:
        UInt32 = self.types.UInt32
        dr.scatter_add(self.counts, UInt32(1), UInt32(which), self.types.Bool(active))

    def density_at(self, p, active=True):
        self._count(0, active)
        return self.field.density_at(p, active)

    def radiance_at(self, point_data, p, d, active=True):
        self._count(1, active)
        return self.field.radiance_at(point_data, p, d, active)

    def free_distance(self, p, d, active=True):
        return self.types.Float(0) if self.reads_all else self.field.free_distance(p, d, active)


def count(field: VolumeField, o, d, near, far, active=True) -> dict[str, int]:
    """Return the numbers of ``rays``, of those ``crossing`` the field's box, and of those that end ``opaque``.

    ``steps`` is the number of steps in the box. Of these, ``hidden`` lie behind an opaque part, ``skipped`` in space
    known to be empty, ``looks`` read the density, and ``colours`` read the radiance, too. Two marches are needed.
    """
    types = field.types
    with dr.suspend_grad():
        o, active = types.Array3f(o), types.Bool(active)
        rays = dr.max(dr.width(o, d, near, far, active))
        entry, _, length, crossing = box(field, o, d, near, far, active)
        steps = dr.select(crossing, dr.ceil(field.along(entry, d).in_steps(length) / field.step), 0)
        skipping, all_steps = CountingField(field), CountingField(field, reads_all=True)
        marched = march(skipping, o, d, near, far, crossing)
        opaque = crossing & (marched.transmittance <= OPAQUE)
        dr.eval(march(all_steps, o, d, near, far, crossing).transmittance, opaque, steps)
        looks, colours = (int(n) for n in skipping.counts.numpy())
        reached = int(all_steps.counts[0])
        total = round(float(dr.sum(types.Float64(steps))[0]))
        return {
            "rays": rays, "crossing": int(dr.count(crossing)[0]), "opaque": int(dr.count(opaque)[0]), "steps": total,
            "hidden": max(0, total - reached), "skipped": max(0, reached - looks), "looks": looks, "colours": colours,
        }  # fmt: skip
