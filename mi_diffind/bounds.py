"""What may be known about a parameter before anything is rendered: bounds of its values."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ValueBounds:
    """
    What is known about a parameter: its values lie in ``[low, high]``; ``optimised`` says that a derivative with
    respect to it is asked for, and that it may take any value. ``grey``: its channels are equal, if it is a colour.
    """

    low: float = 0.0
    high: float = 1.0
    optimised: bool = False
    grey: bool = False

    def is_always(self, value: float) -> bool:
        """Is the parameter this constant, and meant to stay so?"""
        return self.low == self.high == value and not self.optimised
