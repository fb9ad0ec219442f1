"""``fit bsdf SOURCE --over …``: a family of BSDFs over some parameters of a source."""

from __future__ import annotations

import dataclasses
import math
from threading import Event

import drjit as dr
import numpy as np

from ...arrays.indirection import DifferentiableArray
from ...core.errors import UsageError
from ...core.progress import interruptible
from ...core.units import parse_bytes
from ...fitting.loop import FitResult
from ...fitting.settings import FitSettings
from ...fitting.task import FitRequest, Fitted
from . import family_measurement, symmetry, training
from .family import CHANNELS, PROXY_NODES, SCALE, SIZES, FamilyArrays, FamilySizes, nodes_of, sizes_of  # fmt: skip
from .family_files import FamilyModel, allocate, to_table
from .family_sampling import fitted_mixture, fitted_scale
from .family_truth import MEMBERS, FamilySamples, FamilyTruth, constants, draw, parameters_of, points
from .fit import PRETRAINING, requested_truth, symmetry_line
from .model import ALPHA_MIN, BLACK, DIFFUSE, LOBE, PARAMETERS, TERMS, Form, LearnedBSDF, fourth_roots
from .truth import recorded_source
from .view import SphereView

#: Samples of the family's members, and those that measure the proxy.
SAMPLES, VALIDATION = 2**20, 2**16

#: Members whose pictures are compared during the training.
VIEWS = 8

#: Training of the proxy's table from the proxy of the middle.
PROXY = FitSettings(steps=1000, batch=2**13, lr=0.05, schedule="cosine", measure_every=250, check_every=50)


def fit_family(request: FitRequest) -> Fitted:
    """Fit a family as requested, measure it, and return its table and the record of its training.

    Raises :class:`UsageError`.
    """
    if request.preset != "ours":
        raise UsageError(f'over: found the preset "{request.preset}", families have the preset "ours" alone')
    over = parameters_of(request.options["over"])
    family = FamilyTruth(requested_truth(request), over)
    try:
        with interruptible() as stop:
            return _fitted(family, request, stop)
    finally:
        family.restore()


def _fitted(truth: FamilyTruth, request: FitRequest, stop: Event) -> Fitted:
    types, options, settings = request.types, request.options, request.settings
    parameters, count = truth.parameters, len(truth.parameters)
    try:
        sizes = sizes_of(parse_bytes(options["bytes"] or SIZES[count - 1]), parameters)
    except ValueError as e:
        raise UsageError(f"--bytes: {e}") from None
    with dr.suspend_grad():
        truth.check_effects(types)
        symmetries = truth.symmetries(types)
    isotropic = symmetries["isotropy"] <= symmetry.TOLERANCE
    azimuth = "mirror" if symmetries["mirror"] <= symmetry.TOLERANCE else "half"
    samples = draw(truth, types, SAMPLES, MEMBERS, settings.seed + 1, isotropic)
    validation = draw(truth, types, VALIDATION, MEMBERS // 4, settings.seed + 2, isotropic)
    proxy = fit_proxy(truth, samples, validation, types, isotropic, request, stop)
    form = form_of(proxy, validation, isotropic, azimuth)
    members = [(x, SphereView(truth.at(x), types, side=48, samples=32)) for x in points(VIEWS, count, seed=5)]
    identity = {
        "source": truth.truth.digest, "over": [p.to_json() for p in parameters], "form": form.to_json(),
        "structure": dataclasses.asdict(sizes),
    }  # fmt: skip
    problem = residual_problem(proxy, form, sizes, samples, members, identity)

    def at(coordinates):
        with dr.suspend_grad():
            return problem.net.at(form, coordinates, True)

    def stored(result: FitResult | None = None) -> tuple:
        """Return the table of the arrays as they are, and its limit of the albedo."""
        factors, weights = fitted_mixture(truth, at, types, isotropic)
        scale = None
        if options["energy"] == "source":
            azimuths = (0.0,) if isotropic else tuple(math.pi * k / 4 for k in range(4))
            scale = fitted_scale(truth, at, types, azimuths)
        table = to_table(problem.net, form, parameters, factors, weights, scale, {
            **request.recorded(result), "source": truth.truth.digest, "name": truth.truth.name, "symmetry": symmetries,
            "structure": dataclasses.asdict(sizes),
            "over": {key: [p.low, p.high] for key, p in zip(truth.keys, parameters, strict=True)},
        })  # fmt: skip
        table.preset, table.seed = request.preset, settings.seed
        table.settings |= request.paths(source_path=options["source"]) | recorded_source(options)
        model = FamilyModel(table, allocate(table, types.TensorXf), types.TensorXf)
        measured = family_measurement.measure(model, truth)
        table.measured = {k: float(f"{v:.5g}") for k, v in measured.items()}
        return table, scale

    result = training.train_last(problem, request, stored, stop)
    table, scale = stored(result)
    lines = [symmetry_line(symmetries)]
    lines += [f"over {p.name} from {p.low:g} to {p.high:g}, by default {p.middle:.3g}" for p in parameters]
    if scale is not None:
        lines.append(f"albedo limited to the source's: factors down to {scale.min():.4f}")
    figures = {
        "symmetry": symmetries,
        "form": form.to_json(),
        "family": [p.to_json() for p in parameters],
        "arrays": {n: list(a.shape) for n, a in table.arrays.items()},
    }
    return Fitted(table, result, lines, figures)


class FamilyProblem(training.BSDFProblem):
    """Training problem of a family."""

    net: FamilyArrays
    samples: FamilySamples

    def value(self, net, s) -> list:
        return net.at(self.form, s.coordinates, self._share >= training.ROUNDED).value(s.wi, s.wo)

    def measure(self, net) -> dict[str, float]:
        with dr.suspend_grad():
            return self._measure(lambda coordinates: net.at(self.form, coordinates, True))


def fit_proxy(
    truth: FamilyTruth, samples: FamilySamples, validation: FamilySamples, types, isotropic: bool, request: FitRequest,
    stop: Event,
) -> np.ndarray:  # fmt: skip
    """Return the table of the proxy, ``(nodes…, CHANNELS)`` logarithms, trained from the proxy of the middle."""
    middle = training.draw(truth.at([0.5] * len(truth.parameters)), types, VALIDATION, request.settings.seed, isotropic)
    identity = {"source": truth.truth.digest, "over": [p.to_json() for p in truth.parameters]}
    start = training.fit_proxy(middle, middle, types, isotropic, request.part(PRETRAINING / 2), identity)
    nodes = nodes_of(truth.parameters, PROXY_NODES)
    table = np.broadcast_to(np.concatenate([start, np.zeros(CHANNELS - PARAMETERS)]), (*nodes, CHANNELS))
    net = FamilyArrays(DifferentiableArray(nodes, CHANNELS, table.astype(np.float32))).alloc(types.TensorXf)

    def measure_proxy(at):
        class Validation(LearnedBSDF):
            def __init__(self):
                pass

            def value(self, wi, wo, active=True):
                return at(validation.coordinates).value(wi, wo)

        return training.proxy_loss(validation)(Validation())

    problem = FamilyProblem(net, Form(isotropic=isotropic), samples, measure_proxy, identity)
    if not stop.is_set():
        training.train_stage(problem, PROXY, request.part(PRETRAINING), "proxies", "proxies")
    table = net.proxy.numpy().astype(np.float64)
    return with_scale(table, isotropic).astype(np.float32)


def with_scale(table: np.ndarray, isotropic: bool) -> np.ndarray:
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


def form_of(table: np.ndarray, samples: FamilySamples, isotropic: bool, azimuth: str) -> Form:
    """Return the form of a family: the terms that any member needs, and the range of the residuals of ``samples``."""
    terms = ["diffuse"] if table[..., DIFFUSE].max() > BLACK else []
    for k, name in enumerate(TERMS[1:]):
        a = 4 + k * LOBE
        terms += [name] if table[..., a + 3 : a + 9].max() > BLACK else []
    form = Form(tuple(terms), isotropic, azimuth)
    types = training.module_types(samples)
    with dr.suspend_grad():
        net = FamilyArrays(DifferentiableArray(table.shape[:-1], CHANNELS, table)).alloc(types.TensorXf)
        value = net.at(form, samples.coordinates, True).value(samples.wi, samples.wo)
    return dataclasses.replace(form, range=training.range_above(value, samples))


def residual_problem(
    table: np.ndarray, form: Form, sizes: FamilySizes, samples: FamilySamples, members: list, identity: dict
) -> FamilyProblem:
    """Return the problem of training proxies and residuals together, which starts from the proxies."""
    types = training.module_types(samples)
    low, step = fourth_roots(form.range)
    residual, mixing = sizes.arrays(float(np.clip((1 - low) / step, 0, 1)), form.azimuth)
    proxy = DifferentiableArray(table.shape[:-1], CHANNELS, table / training.RATE)
    net = FamilyArrays(proxy, residual, mixing, training.RATE).alloc(types.TensorXf)

    def measure_views(at):
        figures = []
        for coordinates, view in members:
            bsdf = at(constants(types, coordinates))
            figures.append(view.psnr(lambda wi, wo, bsdf=bsdf: [v * wo.z for v in bsdf.value(wi, wo)]))
        return {"psnr_db": float(np.mean(figures))}

    return FamilyProblem(net, form, samples, measure_views, identity)
