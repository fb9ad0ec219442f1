"""
Rays through a field: emission and absorption, from front to back, and the derivatives of what they see.

A ray is divided into steps of a fixed length from where it enters the box, from where distances are counted (from
afar, a step might be too short to change them at all), the last one cut where it ends. Each is of one density and
radiance, so that a medium that is the same everywhere is Beer–Lambert, exactly. Steps in which there is certainly
nothing are skipped, which changes nothing; no radiance is read where density is nothing; and the ray ends when it is
opaque (:data:`OPAQUE`).

Derivatives replay the ray (Vicini et al., *Path Replay Backpropagation*, SIGGRAPH 2021): with what is seen from a step
on, R, and the transmittance T behind it, ∂L/∂σ = δ (T c − R). Nothing is divided by.
"""

from __future__ import annotations

import drjit as dr

from ...rays import box_interval

#: The transmittance at which a ray ends.
OPAQUE = 1e-4

#: The weight of a step below which its radiance is not read.
NOTHING = 2e-7

#: Not all arrays have to be differentiated.
ANY = dr.ADFlag.Default | dr.ADFlag.AllowNoGrad


class Marched:
    """
    What a ray saw: ``colour`` (premultiplied), ``transmittance``, and ``depth``, Σ w t: by the opacity, a mean.
    """

    def __init__(self, colour=None, transmittance=None, depth=None):
        self.colour, self.transmittance, self.depth = colour, transmittance, depth

    @property
    def opacity(self):
        return 1 - self.transmittance


def box(field, o, d, near, far, active):
    """
    The part of each ray that lies in the field's box: the place where it begins, the distance to there, its length, and
    where there is one. NaN is nowhere.
    """
    types = field.types
    near, far = types.Float(near), types.Float(far)
    near, far, active = box_interval(o, d, *field.box, near, far, types.Bool(active))
    # Comparisons with NaN are false
    active &= (near < far) & dr.isfinite(near) & dr.isfinite(far)
    return types.Array3f(dr.fma(d, near, o)), near, far - near, active


@dr.syntax
def march(field, o, d, near, far, active=True, offset=0.5) -> Marched:
    """
    What rays ``o + t d``, t from ``near`` to ``far``, see of a field; ``d`` has unit length. ``offset`` in [0, 1) says
    where within a step it is looked at.
    """
    types = field.types
    with dr.suspend_grad():
        o, near, far, active = box(field, o, d, near, far, active)
        t, step = types.Float(0), dr.opaque(types.Float, field.step)
        seen, depth, through = types.Array3f(0), types.Float(0), types.Float(1)
        offset = types.Float(offset)
        while active:
            t, here = _next(field, o, d, t, far, step, offset, active)
            end = dr.minimum(t + step, far)
            at = dr.fma(offset, end - t, t)
            p = dr.fma(d, at, o)
            density, latent = field.look(p, here)
            passed = through * dr.exp(-density * (end - t))
            weight = dr.select(here, through - passed, 0)
            shown = here & (weight > NOTHING)
            colour = types.Array3f(0)
            if shown:
                colour = types.Array3f(*field.colour(latent, p, d, shown))
            seen += dr.select(shown, weight * colour, 0)
            depth += weight * (near + at)
            through = dr.select(here, passed, through)
            t += step
            active &= here & (t < far) & (through > OPAQUE)
    return Marched(seen, through, depth)


@dr.syntax
def _next(field, o, d, t, far, step, offset, active):
    """The next step, from the one at ``t`` on, in which something may be: where it begins, and whether there is one."""
    types = field.types
    t = types.Float(t)
    looking = types.Bool(active)
    found = types.Bool(False)
    while looking:
        at = dr.fma(offset, dr.minimum(t + step, far) - t, t)
        free = field.skip(dr.fma(d, at, o), d, looking)
        nothing = free > 0
        found |= looking & ~nothing
        t = dr.select(looking & nothing, dr.fma(dr.floor(free / step) + 1, step, t), t)
        looking &= nothing & (t < far)
    return t, found


def replay(field, o, d, near, far, active, offset, marched: Marched, d_colour, d_transmittance=0, d_depth=0) -> None:
    """
    Add to the gradients of ``field.arrays`` what those of :class:`Marched` make of them. ``marched`` is what
    :func:`march` returned for these arguments.
    """
    _follow(field, o, d, near, far, active, offset, marched, (d_colour, d_transmittance, d_depth), None)


def tangent(field, o, d, near, far, active, offset, marched: Marched) -> tuple:
    """The derivatives of colour, transmittance and depth along those that are set for ``field.arrays``."""
    return _follow(field, o, d, near, far, active, offset, marched, None, field)


@dr.syntax
def _follow(field, o, d, near, far, active, offset, marched, adjoint, forward):
    types = field.types
    with dr.suspend_grad():
        o, near, far, active = box(field, o, d, near, far, active)
        t, step = types.Float(0), dr.opaque(types.Float, field.step)
        through = types.Float(1)
        offset = types.Float(offset)
        total = dr.detach(marched.transmittance)
        rest, rest_depth = types.Array3f(dr.detach(marched.colour)), types.Float(dr.detach(marched.depth))
        d_colour, d_through, d_depth = types.Array3f(0), types.Float(0), types.Float(0)
        if dr.hint(adjoint is not None, mode="scalar"):
            d_colour, d_through, d_depth = types.Array3f(adjoint[0]), types.Float(adjoint[1]), types.Float(adjoint[2])
        while active:
            t, here = _next(field, o, d, t, far, step, offset, active)
            end = dr.minimum(t + step, far)
            length = end - t
            at = dr.fma(offset, length, t)
            p = dr.fma(d, at, o)
            with dr.resume_grad():
                density, latent = field.look(p, here)
            passed = through * dr.exp(-dr.detach(density) * length)
            weight = dr.select(here, through - passed, 0)
            shown = here & (weight > NOTHING)
            colour = types.Array3f(0)
            if shown:
                # Nothing that is differentiated leaves this branch
                with dr.resume_grad():
                    found = types.Array3f(*field.colour(latent, p, d, shown))
                    if dr.hint(adjoint is not None, mode="scalar"):
                        dr.backward_from(dr.dot(found, d_colour * weight), ANY)
                    else:
                        d_colour += weight * dr.forward_to(found, flags=ANY)
                colour = dr.detach(found)
            rest -= weight * dr.select(shown, colour, 0)
            rest_depth -= weight * (near + at)
            step_colour = passed * dr.select(shown, colour, 0) - rest
            step_depth = passed * (near + at) - rest_depth
            if dr.hint(adjoint is not None, mode="scalar"):
                slope = dr.dot(d_colour, step_colour) + d_depth * step_depth - d_through * total
                with dr.resume_grad():
                    dr.backward_from(dr.select(here, density * (length * slope), 0), ANY)
            else:
                with dr.resume_grad():
                    rate = length * dr.forward_to(dr.select(here, density, 0), flags=ANY)
                d_colour += rate * step_colour
                d_depth += rate * step_depth
                d_through -= rate * total
            through = dr.select(here, passed, through)
            t += step
            active &= here & (t < far) & (through > OPAQUE)
    return d_colour, d_through, d_depth


@dr.syntax
def visibility(field, o, d, near, far, active, target) -> None:
    """
    The largest weight, transmittance times opacity of a step, that each cell of ``field.nodes`` has in one of these
    rays: raises the numbers of ``target``, one for each node, at the first of its corners.
    """
    types = field.types
    with dr.suspend_grad():
        o, near, far, active = box(field, o, d, near, far, active)
        t, step = types.Float(0), dr.opaque(types.Float, field.step)
        through = types.Float(1)
        while active:
            t, here = _next(field, o, d, t, far, step, types.Float(0.5), active)
            end = dr.minimum(t + step, far)
            p = dr.fma(d, dr.fma(0.5, end - t, t), o)
            density, _ = field.look(p, here)
            passed = through * dr.exp(-density * (end - t))
            dr.scatter_reduce(dr.ReduceOp.Max, target, through - passed, field.nodes.cell(p), here)
            through = dr.select(here, passed, through)
            t += step
            active &= here & (t < far) & (through > OPAQUE)


class _March(dr.CustomOp):
    def eval(self, arrays, field, o, d, near, far, active, offset):
        self.field, self.arguments = field, (o, d, near, far, active, offset)
        self.arrays = arrays
        found = march(field.with_arrays(arrays), *self.arguments)
        self.found = found
        return found.colour, found.transmittance, found.depth

    def _attached(self):
        arrays = {name: type(value)(dr.detach(value)) for name, value in self.arrays.items()}
        dr.enable_grad(arrays)
        return arrays, self.field.with_arrays(arrays)

    def backward(self):
        arrays, field = self._attached()
        replay(field, *self.arguments, self.found, *self.grad_out())
        self.set_grad_in("arrays", dr.grad(arrays))

    def forward(self):
        arrays, field = self._attached()
        dr.set_grad(arrays, self.grad_in("arrays"))
        self.set_grad_out(tangent(field, *self.arguments, self.found))


def differentiable(field, o, d, near, far, active=True, offset=0.5) -> Marched:
    """As :func:`march`, with derivatives with respect to ``field.arrays`` (rays are constants to them)."""
    return Marched(*dr.custom(_March, field.arrays, field.with_arrays({}), o, d, near, far, active, offset))
