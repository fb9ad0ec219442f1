"""Limit a derivative on its way back: the remedy for the unbounded derivatives of highlights (supplemental 1.5)."""

from __future__ import annotations

import drjit as dr


class _Clipped(dr.CustomOp):
    """The identity, whose derivative is limited; NaN becomes 0."""

    def eval(self, value, limit):
        self.limit = limit
        self.add_input(value)
        return dr.detach(value)

    def forward(self):
        self.set_grad_out(self._limited(self.grad_in("value")))

    def backward(self):
        self.set_grad_in("value", self._limited(self.grad_out()))

    def _limited(self, gradient):
        limited = dr.clip(gradient, -self.limit, self.limit)
        return dr.select(dr.isnan(gradient), 0, limited)

    def name(self):
        return "clipped"


def clipped(value, limit: float):
    """
    ``value``, a float or a vector of Dr.Jit, unchanged, with each component of the derivative that flows back to it
    limited to ±``limit``, and NaN to 0. Numbers and what is not differentiated come back as they are.
    """
    if not dr.is_jit_v(value) or not dr.grad_enabled(value):
        return value
    return dr.custom(_Clipped, value, limit)
