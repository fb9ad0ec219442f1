"""Bounds of the values of a material's parameters, known before anything is rendered."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ValueBounds:
    """Bounds of a parameter: its values lie in ``[low, high]``.

    ``optimised``: a derivative with respect to it is tracked, and it may take any value. ``grey``: its channels are
    equal, if it is a colour.
    """

    low: float = 0.0
    high: float = 1.0
    optimised: bool = False
    grey: bool = False

    def is_always(self, value: float) -> bool:
        """Return whether the parameter is this constant and stays so."""
        return self.low == self.high == value and not self.optimised
