"""``fit bsdf SOURCE``: any reflecting BSDF as a proxy, a residual, and a mixture that samples it."""

from __future__ import annotations

import dataclasses
import math
from threading import Event

import drjit as dr

from ...core.errors import UsageError
from ...core.progress import interruptible
from ...core.units import parse_bytes
from ...fitting.loop import FitResult
from ...fitting.task import FitRequest, Fitted
from . import energy, mixture, scattered, symmetry, training
from .files import BSDFModel, allocate, to_table
from .measurement import cosine, measure, measure_samples
from .model import LearnedBSDF, structure_of
from .source import WHITE, FunctionTruth, Truth, TurnedTruth
from .truth import recorded_source, truth_of
from .view import SphereView

#: Share of a limited time in which the proxy is fitted.
PRETRAINING = 0.3


@dataclasses.dataclass(repr=False)
class FittedBSDF(Fitted):
    """Result of a fit, with its source."""

    truth: Truth | None = None


def check(request: FitRequest) -> None:
    """Raise :class:`UsageError` for options that exclude each other."""
    if request.options["source"] is None:
        raise UsageError("source: not given, a BSDF is needed: a scene, a .xml of one BSDF, or a measured file")


def fit(request: FitRequest) -> Fitted:
    """Fit a BSDF as requested on the command line, in the active variant. Raises :class:`UsageError`."""
    return fit_truth(requested_truth(request), request)


def requested_truth(request: FitRequest) -> Truth:
    """Return the source of a request. Raises :class:`UsageError`."""
    use_rgb_variant(request)
    options = request.options
    u, v = options["uv"]
    return truth_of(
        options["source"],
        request.types,
        options["material"],
        (float(u), float(v)),
        options["angles"],
        options["illuminant"],
    )


def use_rgb_variant(request: FitRequest) -> None:
    """Set an RGB variant of Mitsuba on the device of the request, if none is set."""
    import mitsuba as mi

    if mi.variant() is None:
        mi.set_variant("cuda_ad_rgb" if ".cuda." in request.types.__name__ else "llvm_ad_rgb")


def fit_truth(truth: Truth, request: FitRequest) -> FittedBSDF:
    """Fit a learned BSDF to a source, measure it, and return its table and the record of its training.

    Ctrl-C while the proxy is trained leaves the residual out: the file then holds the best proxy so far.
    """
    with interruptible() as stop:
        return _fitted(truth, request, stop)


def _fitted(truth: Truth, request: FitRequest, stop: Event) -> FittedBSDF:
    types, options, settings = request.types, request.options, request.settings
    with dr.suspend_grad():
        symmetries = symmetry.measured_symmetry(truth, types) if truth.function else scattered.measured_symmetry(truth)
    isotropic = (symmetries["isotropy"] or 0) <= symmetry.TOLERANCE
    azimuth = "mirror" if (symmetries["mirror"] or 0) <= symmetry.TOLERANCE else "half"
    lines = [*filter(None, [truth.remark]), symmetry_line(symmetries)]
    plain = request.preset in ("table", "plain")
    try:
        structure = structure_of(parse_bytes(options["bytes"] or "2k"), plain)
    except ValueError as e:
        raise UsageError(f"--bytes: {e}") from None
    if truth.function:
        samples = training.draw(truth, types, training.SAMPLES, settings.seed + 1, isotropic)
        validation = training.draw(truth, types, training.VALIDATION, settings.seed + 2, isotropic)
        lines += (remarks := truth.remarks(validation))
        view, smooth = SphereView(truth, types), validation
    else:
        samples, validation, smooth = scattered.split(truth, types, isotropic, training.LIMIT, settings.seed)
        view, remarks = None, []
        if not any(dr.any(v > 0) for v in samples.value):
            raise UsageError(f"{truth.name}: all of its values are 0, which measures no material")
    angle = 0.0 if isotropic else symmetry.axes_angle(samples, truth)
    if angle:
        lines.append(f"axes at {math.degrees(angle):.1f} degrees")
    first, identity = request.part(PRETRAINING), {"source": truth.digest}
    judge = None if view is None else training.view_psnr(view)
    logarithms = training.fit_proxy(samples, validation, types, isotropic, first, identity, smooth, angle, judge)
    form = training.form_of(logarithms, validation, isotropic, azimuth, angle)
    if request.preset in ("paper", "plain"):  # the proxy gives the scale of u alone
        form = dataclasses.replace(form, terms=())
        form = dataclasses.replace(form, range=training.residual_range(form, logarithms, validation))
    if not truth.function:
        (samples, validation), form, line = scattered.cleaned(truth, [samples, validation], form, logarithms)
        lines.append(line)
    identity = {"source": truth.digest, "structure": dataclasses.asdict(structure), "form": form.to_json()}
    judge = judge or training.proxy_loss(validation)
    problem = training.residual_problem(logarithms, form, structure, samples, judge, identity)
    azimuths = (0.0,) if isotropic else tuple(math.pi * k / 8 for k in range(8))

    def stored(result: FitResult | None = None) -> tuple:
        """Return the table of the arrays as they are, its limit of the albedo, and the PSNR without."""
        bsdf = LearnedBSDF.of(form, problem.net.rounded())
        sampled = truth if truth.function else FunctionTruth(truth.name, cosine(bsdf))
        sampled = TurnedTruth(sampled, -angle) if angle else sampled
        lobes, weights = mixture.fitted_mixture(sampled, types, isotropic, form.scale[1] / form.scale[0])
        scale, raw = None, None if view is None else view.psnr(cosine(bsdf))
        if options["energy"] == "source":
            scale = energy.fitted_scale(cosine(bsdf), truth if truth.function else WHITE, types, azimuths)
        table = to_table(problem.net, form, lobes, weights, scale, {
            **request.recorded(result), "source": truth.digest, "name": truth.name, "symmetry": symmetries,
            "structure": dataclasses.asdict(structure),
        })  # fmt: skip
        table.preset, table.seed = request.preset, settings.seed
        table.settings |= request.paths(source_path=options["source"]) | recorded_source(options)
        model = BSDFModel(table, allocate(table, types.TensorXf), types.TensorXf)
        figures = measure_samples(model, validation) if view is None else measure(model, truth, view)
        table.measured = {k: float(f"{v:.5g}") for k, v in figures.items()}
        table.settings |= {"remarks": remarks} if remarks else {}
        return table, scale, raw

    result = training.train_last(problem, request, stored, stop)
    table, scale, raw = stored(result)
    if scale is not None:
        limit = "1" if raw is None else "the source's"
        without = "" if raw is None else f"; {raw:.2f} dB without"
        lines.append(f"albedo limited to {limit}: factors down to {scale.min():.4f}{without}")
    left_out = [name for name in ("diffuse", "first", "second") if name not in form.terms]
    if left_out and form.terms:
        lines.append(f"the proxy has no {' and no '.join(left_out)} lobe: the source does not need it")
    figures = {
        "symmetry": symmetries,
        "form": form.to_json(),
        "arrays": {n: list(a.shape) for n, a in table.arrays.items()},
    }
    return FittedBSDF(table, result, lines, figures, truth=truth)


def symmetry_line(symmetries: dict[str, float | None]) -> str:
    """Return the measured symmetries as a line of text."""
    assumed = {
        "isotropy": ("isotropic", "anisotropic ({})"),
        "mirror": ("symmetric about the plane of incidence", "not symmetric about the plane of incidence ({})"),
        "reciprocity": (
            "reciprocal",
            "not reciprocal: {} of the light, weighted by both cosines; no reciprocal model can be nearer than that",
        ),
    }
    parts = []
    for name, (yes, no) in assumed.items():
        value = symmetries[name]
        if value is None:
            parts.append(f"{yes} (assumed: no rows to compare)")
        else:
            percent = f"{100 * value:.2g}%"
            parts.append(f"{yes} ({percent})" if value <= symmetry.TOLERANCE else no.format(percent))
    return "measured: " + ", ".join(parts)
