"""BRDFs that learned BSDFs are compared with: fits of the shifted gamma distribution, and networks of Neural-BRDF.

The modules :mod:`.shifted_gamma` and :mod:`.functions` of :mod:`mi_diffind.tasks.bsdf` define both, with their papers.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import drjit as dr
import numpy as np
from drjit import nn

from ...core.compat import backend_module
from ...fitting.loop import FitSettings, fit
from ...tasks.bsdf.directions import HORIZON, Samples
from ...tasks.bsdf.functions import LAYERS, half_and_difference
from ...tasks.bsdf.shifted_gamma import NUMBERS, shifted_gamma
from ...tasks.bsdf.training import BSDFProblem, non_negative
from .networks import Network

#: Widths α and exponents p of the distributions from which a fit may start.
SHAPES = tuple(itertools.product(np.geomspace(1e-4, 1, 9), (0.2, 0.6, 1.2)))

#: Starts that are trained, and samples that rank the shapes.
STARTS, RANKING = 4, 2**13

#: Training from each start; that from the best one goes on.
START_SETTINGS = FitSettings(steps=300, batch=2**13, lr=0.05, measure_every=300, check_every=50)

#: Numbers of a channel that may be negative; the others are trained as logarithms.
SIGNED = tuple(NUMBERS.index(name) for name in ("f0", "f1", "theta0"))


class PeerBRDF:
    """BRDF of a function ``value(wi, wo)``, without the cosine; ``eval`` is that of a ``mi.BSDF``."""

    def __init__(self, value: Callable):
        self.value = value

    def cosine_value(self, wi, wo) -> list:
        """Return f cos θ_o, three arrays."""
        return [v * wo.z for v in self.value(wi, wo)]

    def eval(self, context, si, wo) -> list:
        """Return f cos θ_o, 0 below the surface."""
        active = (si.wi.z > 0) & (wo.z > 0)
        return [dr.select(active, v, 0) for v in self.cosine_value(si.wi, wo)]


class ShiftedGamma(nn.Module):
    """Fit of the shifted gamma distribution: its numbers as they are trained (:func:`to_trained`), ``(33,)``."""

    DRJIT_STRUCT = {"numbers": object}  # noqa: RUF012
    nbytes = 4 * 3 * len(NUMBERS)

    def __init__(self, numbers):
        self.numbers = numbers

    def at(self, form=None, coordinates=(), is_rounded: bool = True, lanes: int = 1) -> PeerBRDF:
        """Return the BRDF; arguments are those of :meth:`.model.BSDFArrays.at`."""
        entries = self.numbers.array
        index = dr.uint32_array_t(type(entries))
        numbers = [dr.gather(type(entries), entries, dr.full(index, k, lanes)) for k in range(self.nbytes // 4)]
        numbers = [x if k // 3 in SIGNED else dr.exp(x) for k, x in enumerate(numbers)]
        return PeerBRDF(lambda wi, wo: [dr.maximum(v, 0) for v in shifted_gamma(numbers, wi, wo)])


def to_trained(numbers: np.ndarray) -> np.ndarray:
    """Return the numbers of a fit, ``(11, 3)``, as they are trained, ``(33,)``: positive ones as logarithms."""
    logarithms = np.log(np.maximum(numbers, 1e-6))
    logarithms[list(SIGNED)] = numbers[list(SIGNED)]
    return logarithms.ravel().astype(np.float32)


def gamma_starts(samples: Samples) -> list[np.ndarray]:
    """Return the :data:`STARTS` best starts as they are trained, ``(33,)``, by their mean absolute error.

    Colours of a diffuse term, and of Fresnel terms 1 and (1 − cos θ_d)⁵, are found by least squares for each shape.
    """
    types = backend_module(samples.weight)
    s = samples.at(dr.arange(types.UInt32, min(RANKING, dr.width(samples.weight))))
    weight = s.weight.numpy().astype(np.float64)[:, None]
    target = weight * np.stack([v.numpy() for v in s.value], axis=-1)
    # Squares of contributions count bright ones most: rows are scaled towards their roots
    rows = 1 / np.sqrt(np.maximum(target.mean(axis=1, keepdims=True), max(1e-2 * target.mean(), 1e-20)))
    ranked = []
    for alpha, p in SHAPES:
        shape = [alpha**p, alpha, p, 1, 0.1, 5, 0]  # masked at the horizon, and little elsewhere
        columns = []
        for colour in ((1, 0, 0, 0), (0, 1, 1, 0), (0, 1, 0, 0)):
            numbers = [dr.opaque(types.Float, float(x)) for x in np.repeat([*colour, *shape], 3)]
            columns.append((s.wo.z * shifted_gamma(numbers, s.wi, s.wo)[0]).numpy())
        basis = weight * np.stack(columns, axis=-1)
        diffuse, normal, grazing = non_negative((rows * basis).T @ (rows * basis), (rows * basis).T @ (rows * target))
        error = np.abs(basis @ np.stack([diffuse, normal, grazing]) - target).mean()
        specular = np.maximum(normal + grazing, 1e-5)
        colours = [diffuse, specular, normal / specular, 0 * diffuse]
        ranked.append((error, to_trained(np.stack([*colours, *(np.full(3, x) for x in shape)]))))
    return [numbers for _, numbers in sorted(ranked, key=lambda entry: entry[0])[:STARTS]]


def gamma_start(samples: Samples, measure: Callable) -> np.ndarray:
    """Return the numbers of the best of short trainings from :func:`gamma_starts`."""
    trained = []
    for numbers in gamma_starts(samples):
        problem = gamma_problem(numbers, samples, measure)
        best = next(iter(fit(problem, START_SETTINGS, progress=False).measured.values()))
        trained.append((best, problem.net.numbers.numpy()))
    return max(trained, key=lambda entry: entry[0])[1]


def gamma_problem(numbers: np.ndarray, samples: Samples, measure: Callable) -> BSDFProblem:
    """Return the training of a fit from numbers as they are trained."""
    net = ShiftedGamma(backend_module(samples.weight).TensorXf(numbers))
    return BSDFProblem(net, None, samples, measure)


class BRDFNetwork(Network):
    """Network of Neural-BRDF: inputs are the half and the difference vector, f is exp(x) − 1, at least 0."""

    def __init__(self):
        super().__init__(LAYERS[0], LAYERS[1], len(LAYERS) - 2, outputs=LAYERS[-1], activation=nn.ReLU)

    def at(self, form=None, coordinates=(), is_rounded: bool = True, lanes: int = 1) -> PeerBRDF:
        """Return the BRDF; arguments are those of :meth:`.model.BSDFArrays.at`."""
        return PeerBRDF(lambda wi, wo: [dr.maximum(dr.exp(x) - 1, 0) for x in self(half_and_difference(wi, wo))])


class NetworkProblem(BSDFProblem):
    """Training of a network as its authors do: absolute differences of log(1 + f cos θ), all samples count the same."""

    def __init__(self, samples: Samples, measure: Callable):
        types = backend_module(samples.weight)
        net = BRDFNetwork().alloc(types.TensorXf, LAYERS[0], dr.rng(seed=dr.opaque(types.UInt64, 1)))
        super().__init__(net, None, samples, measure)

    def value(self, net, s: Samples) -> list:
        return [dr.exp(x) - 1 for x in net(half_and_difference(s.wi, s.wo))]

    def error(self, value: list, s: Samples):
        pairs = zip(value, s.value, strict=True)
        errors = [dr.abs(dr.log(dr.fma(v, s.wo.z, 1)) - dr.log(1 + dr.maximum(t, 0))) for v, t in pairs]
        return dr.select(s.weight > 0, sum(errors[1:], errors[0]), 0)


def uniform_samples(truth, types, size: int, seed: int) -> Samples:
    """Return samples of a function at directions that are uniform in Rusinkiewicz's angles θ_h, θ_d and φ_d."""
    rng, limits = dr.rng(seed=dr.opaque(types.UInt64, seed)), (dr.pi / 2, dr.pi / 2, 2 * dr.pi)
    (sin_h, cos_h), (sin_d, cos_d), (sin_phi, cos_phi) = (dr.sincos(x * rng.random(types.Float, size)) for x in limits)
    half, x = types.Array3f(sin_h, 0, cos_h), sin_d * cos_phi
    wi = types.Array3f(dr.fma(cos_h, x, sin_h * cos_d), sin_d * sin_phi, dr.fma(cos_h, cos_d, -sin_h * x))
    wo = 2 * dr.dot(wi, half) * half - wi
    valid = (wi.z > HORIZON) & (wo.z > HORIZON)
    wi, wo = (dr.select(valid, w, types.Array3f(0, 0, 1)) for w in (wi, wo))
    with dr.suspend_grad():
        samples = Samples(wi, wo, dr.select(valid, types.Float(1), 0), [dr.detach(v) for v in truth.value(wi, wo)])
    dr.eval(samples.wi, samples.wo, samples.weight, samples.value)
    return samples
