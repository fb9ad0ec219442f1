"""Distributions that several tasks draw their training samples from."""

from __future__ import annotations

import math

import drjit as dr

#: Rate of the exponential-like distribution on [0, 1]: half of the samples lie below 0.21.
EXPONENTIAL_RATE = 3.0


def exponential_like(u, rate: float = EXPONENTIAL_RATE):
    """A number in [0, 1] with density ∝ exp(−rate·x) from a uniform one."""
    return dr.minimum(-dr.log(1 - u * (1 - math.exp(-rate))) / rate, 1)
