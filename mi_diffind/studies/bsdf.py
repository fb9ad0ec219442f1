"""Study ``tradeoff bsdf``: learned BSDFs against their sources, in accuracy, time, bytes and noise.

Each material is fitted with a proxy times an indirection (``ours``), a proxy times one array (``table``), an
indirection alone (``paper``) and one array alone (``plain``). Timed beside them are the material itself and
``principled``.
"""

from __future__ import annotations

import argparse
import functools

import mitsuba as mi

from ..fitting.task import fit, load_model
from ..measure.renders import bsdf_queries, directions
from ..measure.study import Candidate, Case, Measure, Plan, Study
from ..measure.training import Contender
from ..tasks.bsdf import mixture
from ..tasks.bsdf.directions import SphereView
from ..tasks.bsdf.model import LearnedBSDF
from ..tasks.bsdf.truth import truth_of


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
        parser.add_argument("materials", nargs="*", metavar="MATERIAL", help="materials of the study (default: all)")

    def check(self, arguments) -> None:
        for name in arguments.materials:
            if name not in MATERIALS:
                raise ValueError(f'found the material "{name}", allowed are {", ".join(map(repr, MATERIALS))}')

    def plan(self, arguments) -> Plan:
        return plan(tuple(arguments.materials), arguments.quick)


STUDY = BSDFStudy()


def fitted_contender(material: str, preset: str, quick: bool) -> Contender:
    """Return the contender of a preset of ``fit bsdf`` for a material; its model is the plugin that reads the file."""
    source, nbytes = MATERIALS[material]

    def train(job: Contender, progress: bool) -> dict | None:
        """Fit, and return bytes and errors, also those of the proxy alone, and the noise of both samplings."""
        options = QUICK_FIT if quick else {}
        fitted = fit("bsdf", source, preset=preset, bytes=nbytes, progress=progress, **options)
        if fitted.result.interrupted:
            return None
        fitted.save(job.file)
        model = load_model(job.file, mi.TensorXf)
        truth, errors = truth_of(source, model.types), dict(model.table.measured)
        if model.bsdf.proxy is not None:
            proxy = LearnedBSDF(model.form, None, model.bsdf.proxy)
            errors["psnr_proxy_db"] = SphereView(truth, model.types).psnr(proxy.cosine_value)
        for name, sampled in (("learned", model.mixture), ("native", truth)):
            moments = [mixture.second_moment(truth, sampled, model.types, cos) for cos in COSINES]
            errors[f"moment_{name}"] = sum(moments) / len(moments)
        return {"bytes": model.table.nbytes, "errors": errors, "details": {"steps": model.table.settings["steps"]}}

    read = lambda job: mi.load_dict({"type": "neural_bsdf", "filename": str(job.file)})  # noqa: E731
    return Contender(f"{material}: {preset}", preset, 0, train, read, preset, "learned", preset)


def plan(materials: tuple[str, ...] = (), quick: bool = False) -> Plan:
    """Return the plan for some materials (default: all), in the current variant."""
    candidates, cases, jobs, ratios = [], [], [], []
    for material in materials or (QUICK_MATERIALS if quick else MATERIALS):
        learned = [fitted_contender(material, preset, quick) for preset in (PRESETS[:2] if quick else PRESETS)]
        references = [
            Candidate(f"{material}: source", "source", is_truth=True, label="source"),
            Candidate(f"{material}: principled", "Mitsuba", is_reference=True, label="principled"),
        ]
        queries = functools.partial(_queries, material, learned)
        cases.append(Case(material, queries, details={"material": MATERIALS[material][0]}))
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
            Measure("proxy alone, dB", "psnr_proxy_db", ".1f"),
            Measure("excess of albedo", "albedo_excess", ".2%", False),
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
    bsdfs = {f"{material}: source": mi.load_dict(MATERIALS[material][0]), f"{material}: principled": mi.load_dict(PEER)}
    return bsdf_queries(bsdfs | {job.name: job.model for job in learned}, directions(lanes), False, QUERIES)
