"""Networks that learned BSDFs are compared with: 675 weights, for raw and for warped inputs.

The size is that of Sztrajman et al., *Neural BRDF Representation and Importance Sampling* (2021): two hidden layers of
21 units. The output is the logarithm of f, and starts at its mean.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays.lookup import clamp
from ...core.runtime import array_module
from ...fitting.settings import FitSettings
from ...measure.training import ConvergenceTraining
from ...tasks.bsdf import training
from ...tasks.bsdf.directions import SphereView
from ...tasks.bsdf.model import DirectionPair, Form, coordinate_u, coordinate_w
from ...tasks.bsdf.training import BSDFProblem
from ...tasks.bsdf.truth import truth_of
from ..baselines.networks import Network

#: Hidden units of both layers; the weights and biases of 6 inputs and 3 outputs are 675.
WIDTH = 21

#: Settings of the shortest training, and steps of the longest.
SETTINGS, LONGEST = FitSettings(steps=1000, batch=2**12, lr=2e-2, seed=1), 4000

#: Share of a training in which errors are those of logarithms; raw inputs stay near their start without it.
LOGARITHMIC = 0.3

#: Least f cos θ in errors of logarithms.
DARK = 1e-6

#: Limits of the output, a natural logarithm.
LIMITS = (-30.0, 20.0)

INPUTS = ("raw", "warped")


class NetworkBSDF:
    """BSDF of a network for one of :data:`INPUTS`, with ``value`` and, for timing, Mitsuba's ``eval``.

    Raw inputs are the half vector and the difference vector; warped ones u, v, w of :mod:`...tasks.bsdf.model`, cos
    θ_h, cos θ_d and cos θ_i cos θ_o. The output is added to ``mean``.
    """

    def __init__(self, network: Network, inputs: str, mean: float, form: Form):
        self.network, self.inputs, self.mean, self.form = network, inputs, mean, form

    def coordinates(self, wi, wo) -> list:
        """Return the inputs of the network, six arrays."""
        g = DirectionPair.of(wi, wo)
        h = g.half * dr.rsqrt(dr.squared_norm(g.half))
        if self.inputs == "warped":
            u = coordinate_u(g, self.form.scale)
            return [u, dr.sqrt(1 - g.cos_d), clamp(coordinate_w(g, self.form), 0, 1), h.z, g.cos_d, wi.z * wo.z]
        # wi in the frame of h whose first axis lies in the plane of the normal: turned about z, then about y
        r = dr.rsqrt(dr.maximum(dr.square(h.x) + dr.square(h.y), 1e-12))
        cos, sin = h.x * r, h.y * r
        x, y = dr.fma(cos, wi.x, sin * wi.y), dr.fma(cos, wi.y, -sin * wi.x)
        sin_h = dr.sqrt(dr.maximum(1 - dr.square(h.z), 0))
        return [h.x, h.y, h.z, dr.fma(h.z, x, -sin_h * wi.z), y, g.cos_d]

    def value(self, wi, wo) -> list:
        """Return f without the cosine, three arrays."""
        logarithms = self.network(self.coordinates(wi, wo))
        return [dr.exp(clamp(v + self.mean, *LIMITS)) for v in logarithms]

    def eval(self, context, si, wo, active=True):
        """Return f cos θ_o, as a BSDF of Mitsuba."""
        valid = (si.wi.z > 0) & (wo.z > 0)
        return dr.select(valid, wo.z * mi.Color3f(self.value(si.wi, wo)), 0)


class NetworkProblem(BSDFProblem):
    """Training problem of a network on samples of a source: errors of logarithms, then the loss of learned BSDFs."""

    def __init__(self, source: dict, inputs: str, scale: tuple[float, float]):
        types = array_module(mi.variant())
        truth = truth_of(source, types)
        samples = training.draw(truth, types, training.SAMPLES, SETTINGS.seed + 1, True)
        network = Network(6, WIDTH, 2, outputs=3).alloc(
            mi.TensorXf, rng=dr.rng(seed=dr.opaque(mi.UInt64, SETTINGS.seed))
        )
        super().__init__(network, Form(scale=scale), samples, training.view_psnr([((), SphereView(truth, types))]))
        self.inputs, self.mean = inputs, mean_logarithm(samples)
        self.identity = {"source": truth.digest, "inputs": inputs, "scale": list(scale)}

    def bsdf(self, net: Network) -> NetworkBSDF:
        """Return the BSDF of a network."""
        return NetworkBSDF(net, self.inputs, self.mean, self.form)

    def begin(self, step: int, share: float) -> str:
        self._share = share
        return "logarithms" if share < LOGARITHMIC else ""

    def value(self, net, s) -> list:
        return self.bsdf(net).value(s.wi, s.wo)

    def error(self, value: list, s):
        if self._share >= LOGARITHMIC:
            return super().error(value, s)
        pairs = zip(value, s.value, strict=True)
        return sum(dr.abs(dr.log(dr.maximum(v * s.wo.z, DARK)) - dr.log(dr.maximum(t, DARK))) for v, t in pairs)

    def measure(self, net) -> dict[str, float]:
        with dr.suspend_grad():
            return self._measure(lambda coordinates: self.bsdf(net))


def mean_logarithm(samples) -> float:
    """Return the mean of the logarithms of f over samples."""
    cos = dr.maximum(samples.wo.z, 1e-3)
    return sum(float(dr.mean(dr.log(dr.maximum(v, DARK) / cos))[0]) for v in samples.value) / 3


class NetworkTraining(ConvergenceTraining):
    """Training of a network to convergence, for inputs in the scale of a learned BSDF, ``scale()``.

    The record has the PSNR of the weights in half precision, too.
    """

    separable = False

    def __init__(self, material: str, source: dict, inputs: str, scale: Callable[[], tuple[float, float]]):
        def problem():
            return NetworkProblem(source, inputs, scale())

        super().__init__(f"{material}, network, {inputs}", problem, SETTINGS, LONGEST)

    def cached_record(self, folder: Path | None, record: dict | None = None) -> dict | None:
        return self._completed(super().cached_record(folder, record))

    def run(self, folder: Path | None = None, progress: bool = True) -> dict | None:
        return self._completed(super().run(folder, progress))

    def _completed(self, record: dict | None) -> dict | None:
        if record is None:
            return None
        problem = self.problem()
        half = Network(6, WIDTH, 2, outputs=3).alloc(mi.TensorXf)
        for key in self.net:
            half[key] = type(self.net[key])(self.net[key].numpy().astype(np.float16).astype(np.float32))
        errors = {"psnr_db": record["psnr_db"], "psnr_half_db": problem.measure(half)["psnr_db"]}
        return {**record, "bytes": 4 * record["entries"], "errors": errors}

    def bsdf(self) -> NetworkBSDF:
        """Return the trained BSDF, for inference."""
        return self.problem().bsdf(self.net.cooperative())
