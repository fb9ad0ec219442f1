"""Study ``tradeoff bsdf``: learned BSDFs against their sources, in accuracy, time, bytes and noise.

Each material is fitted with a proxy times an indirection (``ours``), a proxy times one array (``table``), an
indirection alone (``paper``) and one array alone (``plain``). Timed beside them are the material itself and
``principled``.

A file of measured or learned data, ``FILE`` or ``FILE#NAME``, is fitted in several sizes. Beside the fits are a fit of
the shifted gamma distribution and a network of Neural-BRDF (:mod:`.baselines.brdfs`), which evaluate and do not sample.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
from pathlib import Path

import drjit as dr
import mitsuba as mi

from ..core.runtime import array_module
from ..fitting.loop import FitSettings
from ..fitting.task import fit, load_model
from ..measure.renders import bsdf_queries, directions
from ..measure.study import Candidate, Case, Measure, Plan, Study
from ..measure.training import Contender, NetworkContender
from ..tasks.bsdf import energy, measured, mixture, training
from ..tasks.bsdf.directions import SphereView
from ..tasks.bsdf.evaluation import ALBEDO_COSINES
from ..tasks.bsdf.model import LearnedBSDF
from ..tasks.bsdf.truth import truth_of
from .baselines import brdfs


def _rgb(*value):
    return {"type": "rgb", "value": list(value)}


def _plastic(alpha, *colour, **more):
    return {"type": "roughplastic", "alpha": alpha, "diffuse_reflectance": _rgb(*colour), **more}


def _metal(material, alpha, distribution="ggx"):
    return {"type": "roughconductor", "material": material, "alpha": alpha, "distribution": distribution}


def _blend(weight, a, b):
    return {"type": "blendbsdf", "weight": weight, "a": a, "b": b}


#: Material → its plugin as a dictionary of Mitsuba, and the size of the arrays.
MATERIALS = {
    "principled, coat + sheen": ({
        "type": "principled", "base_color": _rgb(0.7, 0.25, 0.1), "roughness": 0.35, "metallic": 0.2, "clearcoat": 1.0,
        "clearcoat_gloss": 0.8, "sheen": 0.6, "sheen_tint": 0.4,
    }, "2k"),
    "plastic, nonlinear": (_plastic(0.1, 0.1, 0.27, 0.36, nonlinear=True), "2k"),
    "plastic and Beckmann gold": (_blend(0.4, _plastic(0.2, 0.5, 0.1, 0.1), _metal("Au", 0.15, "beckmann")), "2k"),
    "blend of four": (
        _blend(
            0.5,
            _blend(0.5, {"type": "diffuse", "reflectance": _rgb(0.2, 0.5, 0.3)}, _plastic(0.05, 0.5, 0.5, 0.5)),
            _blend(0.5, _metal("Al", 0.3), {"type": "principled", "roughness": 0.6, "base_color": _rgb(0.6, 0.5, 0.1)}),
        ), "2k"),
    "GGX copper, α 0.01": (_metal("Cu", 0.01), "2k"),
    "Beckmann chrome, α 0.1": (_metal("Cr", 0.1, "beckmann"), "2k"),
    "Beckmann copper, α 0.01": (_metal("Cu", 0.01, "beckmann"), "2k"),
    "anisotropic aluminium": (
        {"type": "roughconductor", "material": "Al", "alpha_u": 0.05, "alpha_v": 0.3, "distribution": "ggx"}, "8k",
    ),
}  # fmt: skip

#: Materials of a quick study.
QUICK_MATERIALS = ("plastic, nonlinear",)

#: Presets of ``fit bsdf``.
PRESETS = ("ours", "table", "paper", "plain")

#: Presets and sizes of the fits to a file of data, the first of them in a quick study.
DATA_FITS = (("ours", "2k"), ("ours", "1k"), ("ours", "4k"), ("table", "2k"), ("plain", "2k"))

#: Shortest training of the peers. The longest of the network has as many samples as that of its authors.
GAMMA = FitSettings(steps=1000, batch=2**13, lr=0.02, deterministic=False)
NETWORK = FitSettings(steps=2500, batch=2**13, lr=5e-3, deterministic=False)

#: Change by a training of twice as many steps, in dB, below which a peer has converged.
PEER_GAIN = 0.1

#: Methods that are timed.
QUERIES = ("eval", "eval_pdf", "sample")

#: Steps and batch of the fits of a quick study.
QUICK_FIT = {"steps": 40, "batch": 2**11, "measure_every": 40}

#: Cosines of the angles of incidence at which the noise of sampling is measured.
COSINES = (1.0, 0.7, 0.2)

#: Plugin beside which all are timed.
PEER = {"type": "principled", "roughness": 0.35, "clearcoat": 1.0, "sheen": 0.6}


class BSDFStudy(Study):
    """Accuracy of learned BSDFs against time and bytes."""

    name = "bsdf"
    title = "learned BSDFs of several materials"
    example = '"plastic, nonlinear"'

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        text = "materials of the study (default: all), or files of data, FILE or FILE#NAME"
        parser.add_argument("materials", nargs="*", metavar="MATERIAL", help=text)

    def check(self, arguments) -> None:
        for name in arguments.materials:
            if name not in MATERIALS and not Path(name.partition("#")[0]).is_file():
                allowed = f"{', '.join(map(repr, MATERIALS))}, and files"
                raise ValueError(f'found the material "{name}", allowed are {allowed}')

    def plan(self, arguments) -> Plan:
        return plan(tuple(arguments.materials), arguments.quick)


STUDY = BSDFStudy()


class DataSource:
    """File of measured or learned data of an isotropic material, ``FILE`` or ``FILE#NAME``: samples and measurement."""

    def __init__(self, source: str):
        path, _, name = source.partition("#")
        self.options, self.types = {"source": path, "material": name}, array_module()

    @functools.cached_property
    def truth(self):
        return truth_of(self.options["source"], self.types, self.options["material"])

    @functools.cached_property
    def view(self) -> SphereView | None:
        """Sphere of a function; rows have none."""
        return SphereView(self.truth, self.types) if self.truth.function else None

    @functools.cached_property
    def samples(self) -> tuple:
        """Samples that train the shifted gamma distribution, those that train the network, and held-out ones."""
        if not self.truth.function:
            rows, held_out, _ = measured.split(self.truth, self.types, True, training.LIMIT, 1)
            return rows, dataclasses.replace(rows, weight=dr.full(self.types.Float, 1, len(rows.weight))), held_out
        weighted, held_out = (
            training.draw(self.truth, self.types, size, seed, True)
            for size, seed in ((training.SAMPLES, 2), (training.VALIDATION, 3))
        )
        return weighted, brdfs.uniform_samples(self.truth, self.types, training.SAMPLES, 4), held_out

    def accuracy(self, at) -> dict[str, float]:
        """Return the PSNR of the sphere of a function, and the relative error of held-out samples in dB."""
        sphere = training.view_psnr([((), self.view)])(at) if self.view else {}
        return sphere | training.proxy_loss(self.samples[2])(at)

    def errors(self, bsdf) -> dict[str, float]:
        """Return the accuracy, the irreciprocal share and the largest albedo of a BSDF."""
        fitted = measured.FunctionTruth("", bsdf.cosine_value)
        with dr.suspend_grad():
            errors = self.accuracy(lambda coordinates: bsdf)
            share = measured.measure_symmetry(fitted, self.types)["reciprocity"]
            largest = energy.albedos([bsdf.cosine_value], fitted, self.types, ALBEDO_COSINES).max()
        relative = {"relative_error": 10 ** (-errors["error_db"] / 20)}
        return {**errors, **relative, "irreciprocal_share": share, "albedo_largest": float(largest)}


def fitted_contender(material: str, preset: str, nbytes: str, quick: bool, data: DataSource | None = None) -> Contender:
    """Return the contender of a preset of ``fit bsdf`` for a material; its model is the plugin that reads the file."""
    source = data.options if data else {"source": MATERIALS[material][0]}
    label = f"{preset}, {nbytes}" if data else preset

    def train(job: Contender, progress: bool) -> dict | None:
        """Fit, and return bytes and errors, also those of the proxy alone, and the noise of both samplings."""
        options = QUICK_FIT if quick else {}
        fitted = fit("bsdf", preset=preset, bytes=nbytes, progress=progress, **source, **options)
        if fitted.result.interrupted:
            return None
        fitted.save(job.file)
        model = load_model(job.file, mi.TensorXf)
        errors = dict(model.table.measured)
        if data:
            # No reciprocal model is nearer to a function, and none with the symmetries of the fit to rows
            errors.setdefault("relative_error_floor", model.table.settings["symmetry"]["reciprocity"])
            errors |= data.errors(model.bsdf)
        else:
            truth = truth_of(source["source"], model.types)
            if model.bsdf.proxy is not None:
                proxy = LearnedBSDF(model.form, None, model.bsdf.proxy)
                errors["psnr_proxy_db"] = SphereView(truth, model.types).psnr(proxy.cosine_value)
            for name, sampled in (("learned", model.mixture), ("native", truth)):
                moments = [mixture.second_moment(truth, sampled, model.types, cos) for cos in COSINES]
                errors[f"moment_{name}"] = sum(moments) / len(moments)
        return {"bytes": model.table.nbytes, "errors": errors, "details": {"steps": model.table.settings["steps"]}}

    read = lambda job: mi.load_dict({"type": "neural_bsdf", "filename": str(job.file)})  # noqa: E731
    return Contender(f"{material}: {label}", preset, 0, train, read, label, "learned", label)


def peer_contenders(material: str, data: DataSource, quick: bool) -> list[NetworkContender]:
    """Return the fit of the shifted gamma distribution and the network, trained until they gain little."""
    start = functools.cache(lambda: brdfs.gamma_start(data.samples[0], data.accuracy))
    problems = {
        "shifted gamma": (lambda: brdfs.gamma_problem(start(), data.samples[0], data.accuracy), GAMMA, 8000),
        "network": (lambda: brdfs.NetworkProblem(data.samples[1], data.accuracy), NETWORK, 10_000),
    }

    def build(net) -> brdfs.PeerBRDF:
        return (net.cooperative() if isinstance(net, brdfs.BRDFNetwork) else net).at()

    def finish(net, record: dict) -> dict:
        return {"bytes": net.nbytes, "errors": data.errors(net.at()), "details": {"steps": record["steps"]}}

    contenders = []
    for label, (problem, settings, longest) in problems.items():
        if quick:
            settings, longest = dataclasses.replace(settings, steps=QUICK_FIT["steps"]), QUICK_FIT["steps"]
        training_options = problem, settings, longest, 10, False, finish, PEER_GAIN
        contenders.append(NetworkContender(f"{material}: {label}", label, 0, label, label, build, *training_options))
    return contenders


def plan(materials: tuple[str, ...] = (), quick: bool = False) -> Plan:
    """Return the plan for some materials (default: all), in the current variant."""
    candidates, cases, jobs, ratios = [], [], [], []
    for material in materials or (QUICK_MATERIALS if quick else MATERIALS):
        references = [Candidate(f"{material}: principled", "Mitsuba", is_reference=True, label="principled")]
        if material in MATERIALS:
            references.insert(0, Candidate(f"{material}: source", "source", is_truth=True, label="source"))
            presets, nbytes = PRESETS[:2] if quick else PRESETS, MATERIALS[material][1]
            learned = [fitted_contender(material, preset, nbytes, quick) for preset in presets]
            details, accuracy = {"material": MATERIALS[material][0]}, "psnr_db"
        else:
            data = DataSource(material)
            fits = DATA_FITS[:1] if quick else DATA_FITS
            learned = [fitted_contender(material, preset, nbytes, quick, data) for preset, nbytes in fits]
            learned += peer_contenders(material, data, quick)
            details, accuracy = {}, "error_db"
        queries = functools.partial(_queries, material, learned)
        cases.append(Case(material, queries, details=details, accuracy=accuracy))
        candidates += [*references, *(job.candidate() for job in learned)]
        ratios += [(job.name, reference.name) for job in learned for reference in references]
        jobs += learned
    return Plan(
        study="bsdf",
        title="Learned BSDFs: accuracy against time of eval",
        candidates=candidates,
        cases=cases,
        measures=(
            Measure("PSNR of a lit sphere, dB", "psnr_db", ".1f"),
            Measure("relative error", "relative_error", ".2%", False),
            Measure("its floor", "relative_error_floor", ".2%", False),
            Measure("irreciprocal", "irreciprocal_share", ".2%", False),
            Measure("proxy alone, dB", "psnr_proxy_db", ".1f"),
            Measure("excess of albedo", "albedo_excess", ".2%", False),
            Measure("largest albedo", "albedo_largest", ".3f", False),
            Measure("moment", "sample_weight_moment", ".2f", False),
            Measure("E[w²]/E[w]²", "moment_learned", ".2f", False),
            Measure("source's E[w²]/E[w]²", "moment_native", ".2f", False),
        ),
        ratios=ratios,
        notes=["Files of about equal bytes. ours: an analytic proxy times an indirection; table: the proxy times one "
               "array; paper, plain: an indirection and one array without a proxy. source: the material itself."],
        jobs=jobs,
    )  # fmt: skip


def _queries(material: str, learned: list[Contender], lanes: int) -> dict:
    """Return the queries of the source, ``principled`` and the contenders."""
    bsdfs, inputs = {f"{material}: principled": mi.load_dict(PEER)}, directions(lanes)
    if material in MATERIALS:
        bsdfs[f"{material}: source"] = mi.load_dict(MATERIALS[material][0])
    sampling = [job for job in learned if not isinstance(job, NetworkContender)]
    queries = bsdf_queries(bsdfs | {job.name: job.model for job in sampling}, inputs, False, QUERIES)
    peers = {job.name: job.model for job in learned if job not in sampling}
    queries["eval"] |= bsdf_queries(peers, inputs, False, ("eval",))["eval"]
    return queries
