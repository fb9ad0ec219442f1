"""``fit bsdf SOURCE``: a reflecting BSDF, or a family, as a proxy, a residual, and a mixture that samples it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from threading import Event

import drjit as dr
import numpy as np

from ...arrays.tables import Table
from ...core.errors import UsageError
from ...core.progress import interruptible
from ...core.units import parse_bytes
from ...fitting.loop import FitResult
from ...fitting.task import FitRequest, Fitted
from . import energy, evaluation, measured, mixture, training
from .directions import SphereView
from .files import BSDFModel, allocate, to_table
from .measured import WHITE, FunctionTruth, Truth
from .model import BYTES, TERMS, ResidualSizes, points, sizes_within
from .pairs import error_floor
from .truth import FamilyTruth, is_function, parameter_ranges, recorded_source, truth_of

#: Members of a family whose pictures are compared during the training.
VIEWS = 8


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that exclude each other."""
    if request.options["source"] is None:
        raise UsageError("source: not given, a BSDF is needed: a scene, a .xml of one BSDF, or a measured file")
    if request.options["over"] and request.preset != "ours":
        raise UsageError(f'over: found the preset "{request.preset}", families have the preset "ours" alone')


def fit(request: FitRequest) -> Fitted:
    """Fit a BSDF or a family as requested, in the active variant. Raises :class:`UsageError`.

    Ctrl-C while the proxy is trained leaves the residual out: the file then holds the best proxy so far.
    """
    use_rgb_variant(request)
    options = request.options
    over = parameter_ranges(options["over"]) if options["over"] else {}
    uv = tuple(map(float, options["uv"]))
    source, types = options["source"], request.types
    truth = truth_of(source, types, options["material"], uv, options["angles"], options["illuminant"])
    if not over:
        with interruptible() as stop:
            return _fit_single(truth, request, stop)
    family = FamilyTruth(truth, over)
    try:
        with interruptible() as stop:
            return _fit_family(family, request, stop)
    finally:
        family.restore()


def use_rgb_variant(request: FitRequest) -> None:
    """Set an RGB variant of Mitsuba on the device of the request, if none is set."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("cuda_ad_rgb" if ".cuda." in request.types.__name__ else "llvm_ad_rgb")


def _fit_single(truth: Truth, request: FitRequest, stop: Event) -> Fitted:
    types, options, settings = request.types, request.options, request.settings
    with dr.suspend_grad():
        rows = not truth.function
        symmetries = measured.measure_row_symmetry(truth) if rows else measured.measure_symmetry(truth, types)
    isotropic, azimuth = _assumed_symmetry(symmetries, rows)
    lines = [*filter(None, [truth.remark]), symmetry_line(symmetries)]
    sizes = _sizes(request, plain=request.preset in ("table", "plain"))
    limit, trained = {}, truth
    if rows:
        samples, validation, smooth = measured.split(truth, types, isotropic, training.LIMIT, settings.seed)
        view = None
        if not any(dr.any(v > 0) for v in samples.value):
            raise UsageError(f"{truth.name}: all of its values are 0, which measures no material")
    else:
        view = SphereView(truth, types)
        trained = measured.fitted_part(truth, symmetries, azimuth == "mirror")
        if trained is not truth:
            limit = {"psnr_symmetric_part_db": view.psnr(trained.value)}
        samples = training.draw(trained, types, training.SAMPLES, settings.seed + 1, isotropic)
        smooth = validation = training.draw(trained, types, training.VALIDATION, settings.seed + 2, isotropic)
    lines += (remarks := truth.remarks(validation))
    angle = 0.0 if isotropic else measured.axes_angle(samples, trained)
    if angle:
        lines.append(f"axes at {math.degrees(angle):.1f} degrees")
    first, identity = request.part(training.PRETRAINING), {"source": truth.digest}
    judge = None if rows else training.view_psnr([((), view)])
    logarithms = training.fit_proxy(samples, validation, types, isotropic, first, identity, smooth, angle, judge)
    has_proxy = request.preset not in ("paper", "plain")  # there it gives the scale of u alone
    form = training.choose_form(logarithms, validation, isotropic, azimuth, angle, has_proxy)
    if rows and truth.scattered:
        (samples, validation), form, line = measured.remove_outliers(truth, [samples, validation], form, logarithms)
        lines.append(line)
    if rows:
        counted = [samples, validation] if truth.scattered else [validation]  # all cells of a grid measure
        floor = error_floor(counted, isotropic, azimuth == "mirror")
        limit = {} if floor is None else {"relative_error_floor": floor}
    identity = {"source": truth.digest, "structure": sizes.to_json(), "form": form.to_json()}
    judge = judge or training.proxy_loss(validation)
    problem = training.residual_problem(logarithms, form, sizes, samples, judge, identity)
    azimuths = (0.0,) if isotropic else tuple(math.pi * k / 8 for k in range(8))

    def finish(result: FitResult | None = None) -> tuple[Table, np.ndarray | None, float | None]:
        """Return the table of the arrays as they are, its limit of the albedo, and the PSNR without."""
        value = problem.net.at(form).cosine_value
        sampled = FunctionTruth(truth.name, value) if rows else truth
        sampled = measured.rotate_truth(sampled, -angle) if angle else sampled
        lobes, weights = mixture.fit_mixture(sampled, types, isotropic, form.scale[1] / form.scale[0])
        raw, scale = None if rows else view.psnr(value), None
        if options["energy"] == "source":
            scale = energy.fit_scale(value, WHITE if rows else trained, types, azimuths)
        sampling = {"lobes": [list(dataclasses.astuple(lobe)) for lobe in lobes]}
        recorded = _settings(request, result, truth, symmetries, sizes)
        table = to_table(problem.net, form, sampling, weights, scale, recorded)
        measure = (evaluation.measure_samples, validation) if rows else (evaluation.measure, truth, view)
        unlimited = {} if raw is None or scale is None else {"psnr_unlimited_db": raw}
        _complete(table, request, *measure, limit=limit | unlimited)
        table.settings |= {"remarks": remarks} if remarks else {}
        return table, scale, raw

    result = training.train_last(problem, request, finish, stop)
    table, scale, raw = finish(result)
    if scale is not None:
        limit, without = ("1", "") if raw is None else ("the source's and 1", f"; {raw:.2f} dB without")
        lines.append(f"albedo limited to {limit}: factors down to {scale.min():.4f}{without}")
    left_out = [name for name in TERMS if name not in form.terms]
    if left_out and form.terms:
        lines.append(f"the proxy has no {' and no '.join(left_out)} lobe: the source does not need it")
    return Fitted(table, result, lines, _figures(table, symmetries))


def _fit_family(truth: FamilyTruth, request: FitRequest, stop: Event) -> Fitted:
    types, options, settings, parameters = request.types, request.options, request.settings, truth.parameters
    sizes = _sizes(request, parameters)
    with dr.suspend_grad():
        truth.check_effects(types)
        symmetries = truth.symmetries(types)
    isotropic, azimuth = _assumed_symmetry(symmetries)
    members, count = training.MEMBERS, training.SAMPLES
    samples = training.draw_members(truth, types, count, members, settings.seed + 1, isotropic)
    validation = training.draw_members(truth, types, training.VALIDATION, members // 4, settings.seed + 2, isotropic)
    proxy = training.fit_family_proxy(truth, samples, validation, types, isotropic, request, stop)
    form = training.choose_form(proxy, validation, isotropic, azimuth)
    views = [(x, SphereView(truth.at(x), types, side=48, samples=32)) for x in points(VIEWS, len(parameters), seed=5)]
    described = [p.to_json() for p in parameters]
    identity = {
        "source": truth.truth.digest, "over": described, "form": form.to_json(),
        "structure": sizes.to_json(),
    }  # fmt: skip
    problem = training.residual_problem(proxy, form, sizes, samples, training.view_psnr(views), identity)
    azimuths = (0.0,) if isotropic else tuple(math.pi * k / 4 for k in range(4))

    def at(coordinates):
        with dr.suspend_grad():
            return problem.net.at(form, coordinates)

    def finish(result: FitResult | None = None) -> tuple[Table, np.ndarray | None]:
        """Return the table of the arrays as they are, and its limit of the albedo."""
        factors, weights = mixture.fit_family_mixture(truth, at, types, isotropic)
        scale = energy.fit_family_scale(truth, at, types, azimuths) if options["energy"] == "source" else None
        recorded = _settings(request, result, truth.truth, symmetries, sizes)
        recorded["over"] = {key: [p.low, p.high] for key, p in zip(truth.keys, parameters, strict=True)}
        sampling = {"family": described, "factors": list(factors)}
        table = to_table(problem.net, form, sampling, weights, scale, recorded)
        _complete(table, request, evaluation.measure_family, truth)
        return table, scale

    result = training.train_last(problem, request, finish, stop)
    table, scale = finish(result)
    lines = [symmetry_line(symmetries)]
    lines += [f"over {p.name} from {p.low:g} to {p.high:g}, by default {p.middle:.3g}" for p in parameters]
    if scale is not None:
        lines.append(f"albedo limited to the source's: factors down to {scale.min():.4f}")
    return Fitted(table, result, lines, {**_figures(table, symmetries), "family": described})


def _assumed_symmetry(symmetries: dict[str, float | None], rows: bool = False) -> tuple[bool, str]:
    """Return whether a source counts as isotropic, and what its residual assumes of the azimuth."""
    isotropic = (symmetries["isotropy"] or 0) <= measured.TOLERANCE
    tolerance = measured.MIRROR_TOLERANCE if isotropic and not rows else measured.TOLERANCE
    return isotropic, "mirror" if (symmetries["mirror"] or 0) <= tolerance else "half"


def _sizes(request: FitRequest, parameters=(), plain: bool = False) -> ResidualSizes:
    try:
        return sizes_within(parse_bytes(request.options["bytes"] or BYTES[len(parameters)]), parameters, plain)
    except ValueError as e:  # of the bytes, or of the budget
        raise UsageError(f"--bytes: {e}") from None


def _settings(request: FitRequest, result: FitResult | None, truth: Truth, symmetries: dict, sizes) -> dict:
    """Return what a table file records of a fit."""
    return {
        **request.recorded(result), "source": truth.digest, "name": truth.name, "symmetry": symmetries,
        "structure": sizes.to_json(),
    }  # fmt: skip


def _complete(table: Table, request: FitRequest, measure: Callable, *truth, limit: dict | None = None) -> None:
    """Add preset, seed, source and the figures ``measure(model, *truth)`` to a table; ``limit`` follows the first."""
    table.preset, table.seed, dtype = request.preset, request.settings.seed, request.types.TensorXf
    source = request.options["source"]
    paths = {} if is_function(source) else request.paths(source_path=source)
    table.settings |= paths | recorded_source(request.options)
    figures = list(measure(BSDFModel(table, allocate(table, dtype), dtype), *truth).items())
    figures = {**dict(figures[:1]), **(limit or {}), **dict(figures[1:])}
    table.measured = {name: float(f"{figure:.5g}") for name, figure in figures.items()}


def _figures(table: Table, symmetries: dict) -> dict:
    arrays = {name: list(array.shape) for name, array in table.arrays.items()}
    return {"symmetry": symmetries, "form": table.settings["form"], "arrays": arrays}


def symmetry_line(symmetries: dict[str, float | None]) -> str:
    """Return the measured symmetries as a line of text."""
    names = {"isotropy": "isotropic", "mirror": "symmetric about the plane of incidence", "reciprocity": "reciprocal"}
    parts = []
    for name, text in names.items():
        value = symmetries[name]
        share = "assumed: no rows to compare" if value is None else f"{100 * value:.2g}%"
        parts.append(f"{'not ' if (value or 0) > measured.TOLERANCE else ''}{text} ({share})")
    return "measured: " + ", ".join(parts)
