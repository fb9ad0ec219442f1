"""Adam for large tables of which a step reads a small part: entries without a gradient are left alone."""

from __future__ import annotations

import drjit as dr
from drjit.opt import Adam

from ..core import compat

#: Columns that are updated together.
PACKET = 4


class SparseAdam(Adam):
    """Adam that updates, and loads, only those entries of a tensor that have a gradient.

    The values are those of ``Adam(mask_updates=True)``, but the entries of a tensor with columns in multiples of
    :data:`PACKET` are updated together if one of them has a gradient. If there is a tensor with as many rows and no
    columns, rows in which that one has no gradient are left alone, too. The time of a step grows with the entries that
    it reads, not with the table. Tables are written in place, so no one else should hold them during :meth:`step`: an
    array that is held is copied.
    """

    def step(self) -> None:
        """Take a step for the gradients of the parameters, which are evaluated first."""
        gradients = {key: value.grad.array for key, (value, *_) in self.state.items()}
        dr.eval(gradients)
        shapes = {key: value.shape for key, (value, *_) in self.state.items()}
        changed_rows = {}  # by the number of rows
        for key in sorted(shapes, key=lambda k: len(shapes[k])):
            shape = shapes[key]
            value, promoted, rate, (t, first, second, largest) = self.state.pop(key)
            tensor, flat = type(value), dr.detach(value).array
            del value
            packets = shape[1] // PACKET if len(shape) == 2 and shape[1] % PACKET == 0 else 0
            gradient = gradients.pop(key)
            changed = _changed_entries(gradient, packets, changed_rows.get(shape[0]))
            if len(shape) == 1:
                changed_rows[shape[0]] = changed
            if dr.width(changed):
                self._update(gradient, flat, first, second, packets, changed, rate if rate is not None else self.lr, t)
            value = tensor(flat, shape)
            dr.enable_grad(value)
            self.state[key] = value, promoted, rate, (t + 1, first, second, largest)

    def _update(self, gradient, flat, first, second, packets: int, changed, rate: float, t) -> None:
        """Update the ``changed`` groups of ``flat`` and its moments in place; ``t`` counts the steps before."""
        module = compat.module_of(flat)
        Group = module.Array4f if packets else module.Float
        g, p, m, v = (dr.gather(Group, array, changed) for array in (gradient, flat, first, second))
        m = dr.lerp(g, m, self.beta_1)
        v = dr.lerp(dr.square(g), v, self.beta_2)
        number = int(t[0]) + 1
        scale = -rate * (1 - self.beta_2**number) ** 0.5 / (1 - self.beta_1**number)
        p = dr.fma(m * dr.rsqrt(v + self.epsilon**2), dr.opaque(module.Float, scale), p)
        dr.eval(p, m, v)  # before they are written, since arrays that are still read would be copied
        for array, values in ((flat, p), (first, m), (second, v)):
            dr.scatter(array, values, changed)
        dr.eval(flat, first, second)


def _changed_entries(gradient, packets: int, rows=None):
    """Return the numbers of the entries with a gradient or, if a row has ``packets``, those of its packets.

    Of packets, only those of ``rows`` are looked at, if these are given.
    """
    module = compat.module_of(gradient)
    if not packets:
        return dr.compress(gradient != 0)
    if rows is None:
        group = dr.gather(module.Array4f, gradient, dr.arange(module.UInt32, dr.width(gradient) // PACKET))
        return dr.compress(dr.any(group != 0))
    lane = dr.arange(module.UInt32, dr.width(rows) * packets)
    packet = dr.fma(dr.gather(module.UInt32, rows, lane // packets), packets, lane % packets)
    kept = dr.compress(dr.any(dr.gather(module.Array4f, gradient, packet) != 0))
    return dr.gather(module.UInt32, packet, kept)
