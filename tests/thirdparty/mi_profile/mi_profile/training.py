"""Training of a 1D array of pointers into another 1D array, against the measurement at random angles."""

from __future__ import annotations

import math

import drjit as dr
import numpy as np

from mi_diffind import DifferentiableArray, Indirection
from mi_diffind.fitting.loop import Problem

from .measurement import Measurement


def arrays(primary: int, cascaded: int) -> Indirection:
    """The arrays, not yet allocated: pointers that begin as a ramp, answers that begin as a constant."""
    return Indirection(
        DifferentiableArray(primary, 1, "ramp", fold=True), DifferentiableArray(cascaded, 1, "constant", 0.5)
    )


def exact(truth: Measurement, dtype) -> DifferentiableArray:
    """The measurement, relative to its peak, linear in between: read at the angle over 90°."""
    return DifferentiableArray.from_numpy(truth.relative[:, None], dtype)


def errors(read, truth: Measurement, types) -> dict[str, float]:
    """Of a function of a list of one coordinate, the angle over 90°, against ``truth``: ``psnr_db`` for a peak of 1,
    and the largest difference, in cd.
    """
    x = np.linspace(0, 1, 8 * len(truth.intensity), dtype=np.float32)
    found = np.asarray(read([types.Float(x)])[0].numpy(), np.float64)
    error = found - np.interp(x, np.linspace(0, 1, len(truth.intensity)), truth.intensity / truth.peak)
    mse = float(np.mean(error**2))
    return {"psnr_db": -10 * math.log10(max(mse, 1e-12)), "largest_error_cd": truth.peak * float(np.abs(error).max())}


class ProfileProblem(Problem):
    """The problem: angles are drawn uniformly."""

    def __init__(self, net, truth: Measurement, types):
        self.net, self.truth, self.types = net, truth, types
        self.exact = exact(truth, types.TensorXf)
        self.identity = {"source": truth.digest}

    def batch(self, rng, size: int):
        x = (dr.arange(self.types.Float, size) + rng.random(self.types.Float, size)) / size
        return [x], {"intensity": self.exact([x])}

    def predict(self, net, inputs) -> dict[str, list]:
        return {"intensity": net(inputs)}

    def measure(self, net) -> dict[str, float]:
        return errors(net, self.truth, self.types)
