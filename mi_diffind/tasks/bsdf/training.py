"""Training of a learned BSDF or a family: samples of the source, the proxy, then proxy and residual together."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import os
from collections.abc import Callable, Sequence
from threading import Event

import drjit as dr
import numpy as np

from ...arrays.indirection import DifferentiableArray, device_array
from ...core.compat import backend_module
from ...core.progress import interruptible
from ...fitting.loop import FitResult, Problem
from ...fitting.task import FitRequest, FitSettings, Stage
from .directions import Samples, SphereView, incident, outgoing
from .model import (
    ALPHA_MIN,
    BLACK,
    CHANNELS,
    DIFFUSE,
    LOBE,
    LOGARITHMS,
    PARAMETERS,
    PROXY_NODES,
    SCALE,
    TERMS,
    BSDFArrays,
    DirectionPair,
    Form,
    ProxyLobe,
    ResidualSizes,
    fourth_roots,
    opaque_numbers,
    points,
    table_nodes,
)

#: Samples of the source, of which each step draws a batch.
SAMPLES = 2**20

#: Samples that measure the proxy.
VALIDATION = 2**16

#: Members of a family from which samples are drawn.
MEMBERS = 128

#: Largest contribution of a sample to the loss, f cos θ over its density: rare samples of narrow lobes are limited.
LIMIT = 20.0

#: Number of starts from which the proxy is trained.
STARTS = 2

#: Share of a limited time in which the proxy is trained.
PRETRAINING = 0.3

#: Training of the proxy from each start, in logarithms of its parameters.
PROXY = FitSettings(steps=300, batch=2**13, lr=0.05, schedule="cosine", measure_every=250, check_every=50)

#: Training of the table of a family's proxy, from the proxy of the middle.
FAMILY_PROXY = FitSettings(steps=1000, batch=2**13, lr=0.05, schedule="cosine", measure_every=250, check_every=50)

#: Learning rate of the proxy's logarithms, relative to that of entries, while the residual is trained.
RATE = 0.3

#: Share of the residuals that lie within the range of the cascaded array before it is widened.
QUANTILE = 0.998

#: Least range of residuals, natural logarithms.
LEAST_RANGE = 0.01

#: Value, relative to the mean, below which a source counts as black.
DARK = 1e-3

#: Share of the training after which entries are rounded to bytes in each step.
ROUNDED = 0.5

#: Roughnesses of the lobes from which the proxy starts.
START_ALPHAS = tuple(float(a) for a in np.geomspace(0.003, 0.9, 13))


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


def draw_members(truth, types, size: int, members: int, seed: int, isotropic: bool) -> Samples:
    """Return ``size`` samples of ``members`` of a family (:class:`.truth.FamilyTruth`), in random order."""
    each, columns = size // members, []
    for k, coordinates in enumerate(points(members, len(truth.parameters), seed)):
        s = draw(truth.at(coordinates), types, each, 1000 * seed + k, isotropic)
        arrays = [c.numpy() for c in (*s.wi, *s.wo, s.weight, *s.value)]
        columns.append(np.stack([np.broadcast_to(a, each) for a in (*arrays, *coordinates)]))
    joined = np.concatenate(columns, axis=1, dtype=np.float32)
    joined = joined[:, np.random.default_rng(seed).permutation(joined.shape[1])]
    arrays = [device_array(types.Float, column) for column in joined]
    wi, wo = types.Array3f(*arrays[:3]), types.Array3f(*arrays[3:6])
    return Samples(wi, wo, arrays[6], arrays[7:10], arrays[10:])


def proxy_starts(samples: Samples, types) -> list[np.ndarray]:
    """Return the logarithms of the :data:`STARTS` best proxies, ``(22,)`` each, by their mean absolute error.

    The second is the best one with a lobe that is much narrower than those of the first, if there is room for one: a
    sharp coat of little light counts little in the error, but is seen.
    """
    index = dr.arange(types.UInt32, min(2**13, dr.width(samples.weight)))
    s = samples.at(index)
    g = DirectionPair.of(s.wi, s.wo)
    shapes = list(itertools.product(START_ALPHAS, (2.0, 6.0, 30.0)))  # of GGX, of a shorter tail, and nearly Beckmann's
    columns = [s.wo.z * dr.inv_pi]
    with dr.suspend_grad():
        for alpha, exponent in shapes:
            a, one = types.Float(alpha), [types.Float(1)] * 3
            value = s.wo.z * ProxyLobe.from_parameters((a,), types.Float(exponent), one, one).value(g)[0]
            columns += [value * (1 - g.schlick), value * g.schlick]
        dr.eval(columns, s.weight, s.value)
    weight = s.weight.numpy().astype(np.float64)
    basis = np.stack([c.numpy() for c in columns], axis=-1) * weight[:, None]
    target = np.stack([v.numpy() for v in s.value], axis=-1) * weight[:, None]
    # Squares of contributions count bright ones most: rows are scaled towards their roots
    rows = 1 / np.sqrt(np.maximum(target.mean(axis=1, keepdims=True), max(1e-2 * target.mean(), 1e-20)))
    gram, right = (rows * basis).T @ (rows * basis), (rows * basis).T @ (rows * target)
    ranked = []
    for i, j in itertools.combinations(range(len(shapes)), 2):
        chosen = [0, 2 * i + 1, 2 * i + 2, 2 * j + 1, 2 * j + 2]
        colours = non_negative(gram[np.ix_(chosen, chosen)], right[chosen])
        error = np.abs(basis[:, chosen] @ colours - target).mean()
        ranked.append((error, i, j, colours))
    ranked.sort(key=lambda entry: entry[0])
    narrowest = [min(shapes[i][0], shapes[j][0]) for _, i, j, _ in ranked]
    narrow = next((k for k, alpha in enumerate(narrowest) if alpha < 0.4 * narrowest[0]), 1)
    ranked.insert(1, ranked.pop(narrow))
    return [_logarithms(shapes[i], shapes[j], colours) for _, i, j, colours in ranked[:STARTS]]


def non_negative(gram: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return x ≥ 0, ``(n, 3)``, that minimises |Ax − b|² by sweeps over its entries, from AᵀA and Aᵀb."""
    x = np.zeros_like(right)
    diagonal = np.maximum(np.diag(gram), 1e-30)
    for _ in range(60):
        for k in range(len(x)):
            x[k] = np.maximum(x[k] + (right[k] - gram[k] @ x) / diagonal[k], 0)
    return x


def _logarithms(first: tuple[float, float], second: tuple[float, float], colours: np.ndarray) -> np.ndarray:
    """Return the logarithms of a proxy, ``(22,)``, of lobes (roughness, exponent) and colours of all terms, (5, 3)."""
    colours, parts = np.log(np.maximum(colours, 1e-5)), []
    for k, (alpha, exponent) in enumerate((first, second)):
        parts += [np.log([alpha, alpha, exponent / 2]), colours[1 + 2 * k], colours[2 + 2 * k]]
    return np.concatenate([colours[0], [0.0], *parts])


def proxy_array(logarithms: np.ndarray, rate: float) -> DifferentiableArray:
    """Return logarithms of a proxy, ``(22,)``, or of a family's ``(nodes…, CHANNELS)``, divided by ``rate``."""
    values = (logarithms if logarithms.ndim > 1 else logarithms[:, None]) / rate
    return DifferentiableArray(values.shape[:-1], values.shape[-1], values.astype(np.float32))


class BSDFProblem(Problem):
    """Training problem of ``net``, in the form ``form``, on samples of a source.

    The loss is the mean of |f̂ − f| cos θ_o over the density of the sample: an error counts by the light that it adds to
    a surface in a constant environment. The first number of ``measure(at)`` decides which state is the best;
    ``at(coordinates)`` returns the members of a family, without an argument the BSDF.
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

    def value(self, net, s: Samples) -> list:
        """Return f of samples in a step."""
        return net.at(self.form, s.coordinates, self._share >= ROUNDED, dr.width(s.weight)).value(s.wi, s.wo)

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
            return self._measure(functools.partial(net.at, self.form))


def proxy_loss(samples: Samples) -> Callable:
    """Return a measurement: the mean error at samples, in dB below the mean value."""

    def measure(at: Callable) -> dict[str, float]:
        value = at(samples.coordinates).value(samples.wi, samples.wo)
        pairs = zip(value, samples.value, strict=True)
        error = sum(dr.mean(samples.weight * dr.abs(v * samples.wo.z - t)) for v, t in pairs)
        total = dr.maximum(sum(dr.mean(samples.weight * t) for t in samples.value), 1e-20)  # of a black source
        return {"error_db": -20 * math.log10(max(float((error / total)[0]), 1e-9))}

    return measure


def view_psnr(views: list[tuple[Sequence, SphereView]]) -> Callable:
    """Return a measurement: the mean PSNR of pictures, each with the coordinates of its member of a family, or ()."""

    def measure(at: Callable) -> dict[str, float]:
        members = [(view, at(opaque_numbers(view.types, x))) for x, view in views]
        figures = [view.psnr(lambda wi, wo, b=bsdf: [v * wo.z for v in b.value(wi, wo)]) for view, bsdf in members]
        return {"psnr_db": float(np.mean(figures))}

    return measure


def train_stage(problem: Problem, settings: FitSettings, request: FitRequest, name: str, title: str) -> FitResult:
    """Train a stage before the last one, which may take all of the time of the ``request``."""
    settings = dataclasses.replace(settings, deterministic=request.settings.deterministic)
    return request.run([Stage(name, problem, settings=settings, title=title)])[0]


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
        for k, start in enumerate(proxy_starts(smooth or validation, types)):
            net = BSDFArrays(None, proxy_array(start, 1.0)).alloc(types.TensorXf)
            problem = BSDFProblem(net, form, samples, proxy_loss(validation), {**identity, "start": k})
            settings, limited = dataclasses.replace(PROXY, seed=k), request.part(1 / (STARTS - k))
            result = train_stage(problem, settings, limited, f"start{k + 1}", f"proxy, start {k + 1} of {STARTS}")
            error = result.measured["error_db"]
            if judge is not None:
                with dr.suspend_grad():
                    error = next(iter(judge(functools.partial(net.at, form)).values()))
            if best is None or error > best[0]:
                best = error, net.proxy.numpy().ravel().copy()
            if stop.is_set():
                break
    return best[1]


def fit_family_proxy(
    truth, samples: Samples, validation: Samples, types, isotropic: bool, request: FitRequest, stop: Event
) -> np.ndarray:
    """Return the table of a family's proxy, ``(nodes…, CHANNELS)`` logarithms, trained from the proxy of the middle."""
    middle = draw(truth.at([0.5] * len(truth.parameters)), types, VALIDATION, request.settings.seed, isotropic)
    identity = {"source": truth.truth.digest, "over": [p.to_json() for p in truth.parameters]}
    start = fit_proxy(middle, middle, types, isotropic, request.part(PRETRAINING / 2), identity)
    nodes = table_nodes(truth.parameters, PROXY_NODES)
    table = np.broadcast_to(np.concatenate([start, np.zeros(CHANNELS - PARAMETERS)]), (*nodes, CHANNELS))
    net = BSDFArrays(None, proxy_array(table, 1.0)).alloc(types.TensorXf)
    problem = BSDFProblem(net, Form(isotropic=isotropic), samples, proxy_loss(validation), identity)
    if not stop.is_set():
        train_stage(problem, FAMILY_PROXY, request.part(PRETRAINING), "proxies", "proxies")
    return add_scale(net.proxy.numpy().astype(np.float64), isotropic).astype(np.float32)


def add_scale(table: np.ndarray, isotropic: bool) -> np.ndarray:
    """Return a table of logarithms of proxies with those of the scale of u: the width of the narrowest lobe."""
    table, scales = table.copy(), []
    for k in range(2):
        a = 4 + k * LOBE
        used = table[..., a + 3 : a + 9].max(axis=-1) > BLACK
        axes = [a, a if isotropic else a + 1]
        scales.append(np.where(used[..., None], table[..., axes], 0))
    narrower = scales[0].min(axis=-1) < scales[1].min(axis=-1)
    table[..., SCALE : SCALE + 2] = np.clip(np.where(narrower[..., None], *scales), math.log(ALPHA_MIN), 0)
    return table


def choose_form(
    logarithms: np.ndarray, samples: Samples, isotropic: bool, azimuth: str, angle: float = 0.0, has_proxy: bool = True
) -> Form:
    """Return the form of a fitted proxy, or of a table of proxies.

    It has the terms that are not black (without ``has_proxy``: none), the scale of u of a single proxy, and the range
    of the residuals of ``samples``.
    """
    lobes = {name: 4 + k * LOBE for k, name in enumerate(TERMS[1:])}
    lobes = {name: a for name, a in lobes.items() if logarithms[..., a + 3 : a + 9].max() > BLACK}
    terms = (*(["diffuse"] if logarithms[..., DIFFUSE].max() > BLACK else []), *lobes)
    terms = (terms or ("diffuse",)) if has_proxy else ()  # all of them black, or nearly so
    form = Form(terms, isotropic, azimuth, angle=angle)
    if logarithms.ndim == 1:
        axes = (0, 0 if isotropic else 1)
        scales = [tuple(float(np.clip(np.exp(logarithms[a + k]), 1e-3, 1)) for k in axes) for a in lobes.values()]
        form = dataclasses.replace(form, scale=min(scales, key=min) if scales else (1.0, 1.0))
    return dataclasses.replace(form, range=residual_range(form, logarithms, samples))


def residual_range(form: Form, logarithms: np.ndarray, samples: Samples) -> tuple[float, float]:
    """Return the range of log(f / proxy) over samples, from quantiles; without a proxy, black channels count, too."""
    types, value = backend_module(samples.weight), [1.0, 1.0, 1.0]
    with dr.suspend_grad():
        if form.terms:
            net = BSDFArrays(None, proxy_array(logarithms, 1.0)).alloc(types.TensorXf)
            value = net.at(form, samples.coordinates).value(samples.wi, samples.wo)
        light, ratios = [float(dr.mean(samples.weight * t)[0]) for t in samples.value], []
        for v, t in zip(value, samples.value, strict=True):
            ratio = dr.log(dr.maximum(t, 1e-12) / dr.maximum(v * samples.wo.z, 1e-12))
            ratios.append(ratio.numpy()[(t * samples.weight).numpy() > DARK * sum(light) / 3])
    if not (form.terms or any(light)):
        return LOGARITHMS[0] - LEAST_RANGE, LOGARITHMS[0] + LEAST_RANGE
    ratios, low, high = np.concatenate(ratios), -LEAST_RANGE, LEAST_RANGE
    if len(ratios):
        ends = np.quantile(ratios, [1 - QUANTILE, QUANTILE])
        low, high = min(ends[0], low), max(ends[1], high)
        margin = 0.25 * (high - low)
        low, high = float(low - margin), float(high + margin)
    if not form.terms and min(light) < DARK * max(light):
        low = min(low, high + math.log(1e-4))  # a black channel, relative to the largest value
    return low, high


def residual_problem(
    logarithms: np.ndarray, form: Form, sizes: ResidualSizes, samples: Samples, measure: Callable, identity: dict
) -> BSDFProblem:
    """Return the problem of training proxy and residual together, which starts from the proxy alone."""
    low, high = form.range
    start = -low / (high - low)
    if form.terms:
        low, step = fourth_roots(form.range)
        start = (1 - low) / step
    residual, mixing = sizes.arrays(float(np.clip(start, 0, 1)), form.azimuth)
    proxy = proxy_array(logarithms, RATE) if form.terms else None
    net = BSDFArrays(residual, proxy, mixing, RATE).alloc(backend_module(samples.weight).TensorXf)
    return BSDFProblem(net, form, samples, measure, identity)
