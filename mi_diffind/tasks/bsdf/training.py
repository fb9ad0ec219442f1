"""Training of a learned BSDF: samples of the source, the proxy, then proxy and residual together."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
from collections.abc import Callable
from threading import Event

import drjit as dr
import numpy as np

from ...arrays.indirection import DifferentiableArray
from ...core.progress import interruptible
from ...fitting.loop import FitResult, Problem
from ...fitting.settings import FitSettings
from ...fitting.task import FitRequest
from .model import (
    BLACK,
    DIFFUSE,
    LOBE,
    LOGARITHMS,
    PARAMETERS,
    TERMS,
    BSDFArrays,
    Form,
    LearnedBSDF,
    ResidualSizes,
    fourth_roots,
)
from .pool import Samples, incident, outgoing
from .starts import starts
from .view import SphereView

#: Samples of the source, of which each step draws a batch, and samples that measure the proxy.
SAMPLES, VALIDATION = 2**20, 2**16

#: Largest contribution of a sample to the loss, f cos θ over its density: rare samples of narrow lobes are limited.
LIMIT = 20.0

#: Number of starts from which the proxy is trained.
STARTS = 2

#: Training of the proxy from each start, in logarithms of its parameters.
PROXY = FitSettings(steps=300, batch=2**13, lr=0.05, schedule="cosine", measure_every=250, check_every=50)

#: Learning rate of the proxy's logarithms, relative to that of entries, while the residual is trained.
RATE = 0.3

#: Share of the residuals that lie within the range of the cascaded array before it is widened, and the widening.
QUANTILE, MARGIN = 0.998, 0.25

#: Least residual range, and the value relative to the mean below which a source counts as black.
LEAST, DARK = 0.01, 1e-3

#: Least value of f relative to the largest where there is no proxy and a channel is black.
BLACK_CHANNEL = 1e-4

#: Share of the training after which entries are rounded to bytes in each step.
ROUNDED = 0.5


def draw(truth, types, size: int, seed: int, isotropic: bool) -> Samples:
    """Return samples of a source, with ``weight`` limited by :data:`LIMIT`, in random order."""
    rng = dr.rng(seed=dr.opaque(types.UInt64, seed))
    samples = outgoing(rng, types, incident(rng, types, size, isotropic), truth)
    with dr.suspend_grad():
        value = truth.value(samples.wi, samples.wo)
        largest = dr.maximum(dr.maximum(value[0], value[1]), value[2])
        samples.weight = dr.minimum(samples.weight, LIMIT * dr.rcp(dr.maximum(largest, 1e-6)))
        samples.value = [dr.detach(v) for v in value]
    dr.eval(samples.weight, samples.value)
    return samples


def proxy_array(logarithms: np.ndarray, rate: float) -> DifferentiableArray:
    """Return logarithms of a proxy, divided by ``rate``, as an array."""
    return DifferentiableArray((PARAMETERS,), 1, (logarithms / rate).reshape(PARAMETERS, 1).astype(np.float32))


class BSDFProblem(Problem):
    """Training problem of ``net``, in the form ``form``, on samples of a source.

    The loss is the mean of |f̂ − f| cos θ_o over the density of the sample: an error counts by the light that it adds to
    a surface in a constant environment. ``measure`` returns what decides which state is the best.
    """

    def __init__(self, net: BSDFArrays, form: Form, samples: Samples, measure: Callable, identity: dict | None = None):
        self.net, self.form, self.samples, self._measure = net, form, samples, measure
        self.identity, self._share = identity or {}, 0.0

    @functools.cached_property
    def harmless(self) -> float:
        """A tenth of the light of the samples: a loss that is no explosion."""
        with dr.suspend_grad():
            light = sum(dr.mean(self.samples.weight * v) for v in self.samples.value)
        return 0.1 / 3 * float(light[0])

    def begin(self, step: int, share: float) -> str:
        self._share = share
        return "rounded" if share >= ROUNDED else ""

    def trained(self, net: BSDFArrays) -> LearnedBSDF:
        """Return the BSDF that a step evaluates."""
        if net.residual is not None:
            net = net.rounded() if self._share >= ROUNDED else net.unfolded()
        return LearnedBSDF.of(self.form, net)

    def value(self, net: BSDFArrays, s: Samples) -> list:
        """Return f of samples in a step."""
        return self.trained(net).value(s.wi, s.wo)

    def loss(self, net, rng, size: int):
        # The samples are in random order: a run of them is a batch, and is read from memory in order
        Float, count = type(self.samples.weight), dr.width(self.samples.weight)
        UInt32 = dr.uint32_array_t(Float)
        s = self.samples.at((UInt32(rng.random(Float, 1) * count) + dr.arange(UInt32, size)) % count)
        return self.error(self.value(net, s), s) * (1 / (3 * size))

    def error(self, value: list, s: Samples):
        """Return the errors of f at samples, by their weight, the sum of all channels."""
        errors = [dr.abs(dr.fma(v, s.wo.z, -t)) for v, t in zip(value, s.value, strict=True)]
        return s.weight * sum(errors[1:], errors[0])

    def measure(self, net) -> dict[str, float]:
        with dr.suspend_grad():
            net = net.rounded() if net.residual is not None else net
            return self._measure(LearnedBSDF.of(self.form, net))


def proxy_loss(samples: Samples) -> Callable:
    """Return a measurement: the mean error of a BSDF at samples, in dB below the mean value."""

    def measure(bsdf: LearnedBSDF) -> dict[str, float]:
        value = bsdf.value(samples.wi, samples.wo)
        pairs = zip(value, samples.value, strict=True)
        error = sum(dr.mean(samples.weight * dr.abs(v * samples.wo.z - t)) for v, t in pairs)
        total = dr.maximum(sum(dr.mean(samples.weight * t) for t in samples.value), 1e-20)  # of a black source
        return {"error_db": -20 * math.log10(max(float((error / total)[0]), 1e-9))}

    return measure


def view_psnr(view: SphereView) -> Callable:
    """Return a measurement: the PSNR of a picture."""
    return lambda bsdf: {"psnr_db": view.psnr(lambda wi, wo: [v * wo.z for v in bsdf.value(wi, wo)])}


def train_stage(problem: Problem, settings: FitSettings, request: FitRequest, name: str, title: str) -> FitResult:
    """Train a stage before the last one, with its checkpoint beside that of the request: ``FILE.name``."""
    checkpoint = f"{request.checkpoint}.{name}" if request.checkpoint else None
    settings = dataclasses.replace(settings, deterministic=request.settings.deterministic)
    resume = request.resume and os.path.exists(checkpoint or "")
    stage = dataclasses.replace(request, settings=settings, checkpoint=checkpoint, resume=resume)
    return stage.train(problem, title)


def train_last(problem: Problem, request: FitRequest, finish: Callable, stop: Event) -> FitResult:
    """Train the last stage, or return a record without steps if an earlier one was interrupted (``stop``)."""
    if stop.is_set():
        figures = {name: float(value) for name, value in problem.measure(problem.net).items()}
        return FitResult(figures, 0, 0, 0.0, True, 0, asked_to_stop=True)
    begun = os.path.exists(request.checkpoint or "") or not os.path.exists(f"{request.checkpoint}.start1")
    return dataclasses.replace(request, resume=request.resume and begun).train(problem, finish=finish)


def fit_proxy(
    samples: Samples, validation: Samples, types, isotropic: bool, request: FitRequest, identity: dict,
    smooth: Samples | None = None, angle: float = 0.0, judge: Callable | None = None,
) -> np.ndarray:  # fmt: skip
    """Return the logarithms of the best proxy of :data:`STARTS` trainings, by ``judge`` (default: by their error).

    ``angle`` is that of the material's axes. The starts are found from ``smooth`` samples (default: ``validation``).
    With a checkpoint, each training has one of its own beside it; a limited time is shared; after Ctrl-C, no further
    start is trained.
    """
    best, form = None, Form(isotropic=isotropic, angle=angle)
    with interruptible() as stop:
        for k, start in enumerate(starts(smooth or validation, types, STARTS)):
            net = BSDFArrays(None, proxy_array(start, 1.0)).alloc(types.TensorXf)
            problem = BSDFProblem(net, form, samples, proxy_loss(validation), {**identity, "start": k})
            settings, limited = dataclasses.replace(PROXY, seed=k), request.part(1 / (STARTS - k))
            result = train_stage(problem, settings, limited, f"start{k + 1}", f"proxy, start {k + 1} of {STARTS}")
            error = result.measured["error_db"]
            if judge is not None:
                with dr.suspend_grad():
                    error = next(iter(judge(LearnedBSDF.of(form, net)).values()))
            if best is None or error > best[0]:
                best = error, net.proxy.numpy().ravel().copy()
            if stop.is_set():
                break
    return best[1]


def form_of(logarithms: np.ndarray, samples: Samples, isotropic: bool, azimuth: str, angle: float = 0.0) -> Form:
    """Return the form of a fitted proxy: its terms, the scale of u, and the range of the residuals of ``samples``."""
    values = np.exp(logarithms)
    terms = ["diffuse"] if logarithms[DIFFUSE].max() > BLACK else []
    scales = []
    for k, name in enumerate(TERMS[1:]):
        a = 4 + k * LOBE
        if logarithms[a + 3 : a + 9].max() > BLACK:
            terms.append(name)
            scales.append([float(np.clip(values[a + i], 1e-3, 1)) for i in (0, 0 if isotropic else 1)])
    scale = min(scales, key=min) if scales else [1.0, 1.0]
    terms = terms or ["diffuse"]  # black, or nearly so
    form = Form(tuple(terms), isotropic, azimuth, tuple(scale), angle=angle)
    return dataclasses.replace(form, range=residual_range(form, logarithms, samples))


def residual_range(form: Form, logarithms: np.ndarray, samples: Samples) -> tuple[float, float]:
    """Return the range of log(f / proxy) over samples, from quantiles; without a proxy, black channels count, too."""
    types = module_types(samples)
    if form.terms:
        net = BSDFArrays(None, proxy_array(logarithms, 1.0)).alloc(types.TensorXf)
        return range_above(LearnedBSDF.of(form, net).value(samples.wi, samples.wo), samples)
    low, high = range_above([1.0, 1.0, 1.0], samples)
    with dr.suspend_grad():
        light = [float(dr.mean(samples.weight * t)[0]) for t in samples.value]
    if not any(light):
        return LOGARITHMS[0] - LEAST, LOGARITHMS[0] + LEAST
    return (min(low, high + math.log(BLACK_CHANNEL)) if min(light) < DARK * max(light) else low), high


def range_above(value: list, samples: Samples) -> tuple[float, float]:
    """Return the range of log(f / ``value``) over samples of f, from quantiles; ``value`` has no cosine."""
    with dr.suspend_grad():
        least = DARK * sum(float(dr.mean(samples.weight * t)[0]) for t in samples.value) / 3
        ratios = [
            (dr.log(dr.maximum(t, 1e-12) / dr.maximum(v * samples.wo.z, 1e-12))).numpy()[
                (t * samples.weight).numpy() > least
            ]
            for v, t in zip(value, samples.value, strict=True)
        ]
    ratios = np.concatenate(ratios)
    if not len(ratios):
        return -LEAST, LEAST
    low, high = np.quantile(ratios, [1 - QUANTILE, QUANTILE])
    low, high = min(low, -LEAST), max(high, LEAST)
    margin = MARGIN * (high - low)
    return float(low - margin), float(high + margin)


def module_types(samples: Samples):
    """Return the module of the Dr.Jit types of samples."""
    from ...core.compat import module_of

    return module_of(samples.weight)


def residual_problem(
    logarithms: np.ndarray, form: Form, structure: ResidualSizes, samples: Samples, measure: Callable, identity: dict
) -> BSDFProblem:
    """Return the problem of training proxy and residual together, which starts from the proxy alone.

    The first number of ``measure(bsdf)`` decides which state is the best.
    """
    types = module_types(samples)
    low, high = form.range
    start = float(np.clip(-low / (high - low), 0, 1))
    if form.terms:
        low, step = fourth_roots(form.range)
        start = float(np.clip((1 - low) / step, 0, 1))
    proxy = proxy_array(logarithms, RATE) if form.terms else None
    net = BSDFArrays(structure.residual(start, form.azimuth), proxy, RATE).alloc(types.TensorXf)
    return BSDFProblem(net, form, samples, measure, identity)
