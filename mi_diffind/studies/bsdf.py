"""Study ``tradeoff bsdf``: learned BSDFs against their sources, in accuracy, time, bytes and noise.

Each material is fitted with a proxy times an indirection (``ours``), a proxy times one array (``table``), an
indirection alone (``paper``), one array alone (``plain``), and networks of 675 weights, for raw and for warped inputs
(:class:`.NetworkBSDF`). Timed beside them are the material itself and ``principled``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import mitsuba as mi

from ..fitting.task import FitSettings, fit, load_model
from ..measure.renders import bsdf_queries, directions
from ..measure.store import file_name, fingerprint, package_files
from ..measure.study import Candidate, Case, Job, Measure, Plan, Study
from ..measure.training import ConvergenceTraining, halve
from ..tasks.bsdf import mixture
from ..tasks.bsdf.directions import SphereView
from ..tasks.bsdf.model import LearnedBSDF
from ..tasks.bsdf.truth import truth_of
from .baselines import networks


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
    "diffuse": ({"type": "diffuse", "reflectance": _rgb(0.2, 0.5, 0.9)}, "2k"),
    "anisotropic aluminium": (
        {"type": "roughconductor", "material": "Al", "alpha_u": 0.05, "alpha_v": 0.3, "distribution": "ggx"}, "8k",
    ),
}  # fmt: skip


#: Materials of a quick study.
QUICK_MATERIALS = ("plastic, nonlinear",)


#: Presets, the first is compared with the others.
PRESETS = ("ours", "table", "paper", "plain")


#: Methods that are timed.
QUERIES = ("eval", "eval_pdf", "sample")


#: Steps and batch of the fits of a quick study.
QUICK_FIT = {"steps": 40, "batch": 2**11, "measure_every": 40}


#: Cosines of the angles of incidence at which the noise of sampling is measured.
COSINES = (1.0, 0.7, 0.2)


#: Inputs of networks.
INPUTS = ("raw", "warped")

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


class BSDFTraining(Job):
    """Fit of one material with one preset, whose table file is kept."""

    separable = True

    def __init__(self, material: str, preset: str, quick: bool):
        self.material, self.preset, self.quick = material, preset, quick
        self.name = f"{material}, {preset}"
        self.path: Path | None = None

    def cached_record(self, folder: Path | None, record: dict | None) -> dict | None:
        """Return the record if the folder holds the file of an uninterrupted fit; without ``record``, measure it."""
        if folder is None or not self._file(folder).is_file():
            return None
        self.path = self._file(folder)
        return record or {"seconds": None, **self._measured()}

    def run(self, folder: Path | None, progress: bool) -> dict | None:
        """Fit, write the file, and return the record; ``None`` after Ctrl-C."""
        source, nbytes = MATERIALS[self.material]
        start = time.perf_counter()
        options = QUICK_FIT if self.quick else {}
        fitted = fit("bsdf", source, preset=self.preset, bytes=nbytes, progress=progress, **options)
        if fitted.result.interrupted:
            return None
        seconds = time.perf_counter() - start
        self.path = self._file(Path(folder or "."))
        fitted.save(self.path)
        return {"seconds": seconds, **self._measured()}

    def _measured(self) -> dict:
        """Return bytes, errors and details of the file: also the errors of the proxy alone and of both samplings."""
        model = load_model(self.path, mi.TensorXf)
        truth = truth_of(MATERIALS[self.material][0], model.types)
        errors = dict(model.table.measured)
        if model.bsdf.proxy is not None:
            proxy = LearnedBSDF(model.form, None, model.bsdf.proxy)
            errors["psnr_proxy_db"] = SphereView(truth, model.types).psnr(proxy.cosine_value)
        for name, sampled in (("learned", model.mixture), ("native", truth)):
            moments = [mixture.second_moment(truth, sampled, model.types, cos) for cos in COSINES]
            errors[f"moment_{name}"] = sum(moments) / len(moments)
        settings = model.table.settings
        details = {key: settings[key] for key in ("form", "symmetry", "steps")}
        return {"bytes": model.table.nbytes, "errors": errors, "details": details}

    def _file(self, folder: Path) -> Path:
        return Path(folder) / f"{file_name(self.name)}.npz"

    def load(self):
        """Return the plugin that reads the file."""
        return mi.load_dict({"type": "neural_bsdf", "filename": str(self.path)})

    def scale(self) -> tuple[float, float]:
        """Return the scale of the coordinate u of the fitted file."""
        return load_model(self.path, mi.TensorXf).form.scale


def network_training(material: str, inputs: str, scale) -> ConvergenceTraining:
    """Return the training of a network to convergence, for inputs in the scale of a learned BSDF, ``scale()``.

    The record has the PSNR of the weights in half precision, too.
    """

    def problem() -> networks.BSDFNetworkProblem:
        return networks.BSDFNetworkProblem(MATERIALS[material][0], inputs, scale())

    def finish(net, record: dict) -> dict:
        half = networks.bsdf_network().alloc(mi.TensorXf)
        for key in net:
            half[key] = net[key]
        halve(half)
        errors = {"psnr_db": record["psnr_db"], "psnr_half_db": problem().measure(half)["psnr_db"]}
        return {"bytes": 4 * record["entries"], "errors": errors}

    settings = FitSettings(steps=1000, batch=2**12, lr=2e-2, seed=1)
    training = ConvergenceTraining(f"{material}, network, {inputs}", problem, settings, 4000, finish=finish)
    training.separable = False  # its inputs are those of another job
    return training


def plan(materials: tuple[str, ...] = (), quick: bool = False) -> Plan:
    """Return the plan for some materials (default: all), in the current variant."""
    names = materials or (QUICK_MATERIALS if quick else tuple(MATERIALS))
    candidates, cases, jobs, ratios = [], [], [], []
    for material in names:
        case, its_candidates, its_jobs = _material(material, quick)
        cases.append(case)
        candidates += its_candidates
        jobs += its_jobs
        references = [c.name for c in its_candidates if c.is_truth or c.is_reference]
        learned = [c.name for c in its_candidates if c.name not in references]
        ratios += [(name, reference) for name in learned for reference in references]
    code = package_files("arrays/lookup.py", "arrays/indirection.py", "fitting/loop.py", "tasks/bsdf/*.py",
                         "studies/bsdf.py")  # fmt: skip
    return Plan(
        study="bsdf",
        title="Learned BSDFs: accuracy against time and bytes",
        candidates=candidates,
        cases=cases,
        queries=QUERIES,
        accuracy="psnr_db",
        accuracy_label="PSNR of a lit sphere, dB",
        ratios=ratios,
        jobs=jobs,
        jobs_fingerprint=fingerprint(code),
        bytes_by_case=True,
        sampled=False,
        measures=(
            Measure("PSNR, dB", "psnr_db", ".1f"),
            Measure("proxy, dB", "psnr_proxy_db", ".1f"),
            Measure("albedo", "albedo_excess", ".2%", False),
            Measure("E[w²]/E[w]²", "moment_learned", ".2f", False),
            Measure("source's", "moment_native", ".2f", False),
        ),
    )


def _material(material: str, quick: bool) -> tuple[Case, list[Candidate], list[Job]]:
    """Return the case of a material, its candidates and their jobs."""
    source, nbytes = MATERIALS[material]
    trainings = [BSDFTraining(material, preset, quick) for preset in (PRESETS[:1] if quick else PRESETS)]
    nets = []
    if not quick and nbytes == "2k":
        nets = [network_training(material, inputs, trainings[0].scale) for inputs in INPUTS]

    def learned(job, label: str, representation: str, **options) -> Candidate:
        return Candidate(
            f"{material}: {label}", representation, label, job=job.name, in_passes=False, label=label, **options
        )

    candidates = [
        Candidate(f"{material}: source", "source", is_truth=True, in_passes=False, label="source"),
        Candidate(
            f"{material}: principled", "Mitsuba", is_reference=True, in_passes=False, label="principled",
            note="another material",
        ),
        *(learned(job, job.preset, "learned") for job in trainings),
        *(
            learned(job, f"network, {inputs}", "network", queries=("eval",))
            for job, inputs in zip(nets, INPUTS, strict=False)
        ),
    ]  # fmt: skip

    def queries(lanes: int) -> dict:
        bsdfs = {f"{material}: source": mi.load_dict(source), f"{material}: principled": mi.load_dict(PEER)}
        bsdfs |= {f"{material}: {job.preset}": job.load() for job in trainings}
        bsdfs |= {
            f"{material}: network, {i}": job.problem().bsdf(job.net.cooperative())
            for job, i in zip(nets, INPUTS, strict=False)
        }
        return bsdf_queries(bsdfs, directions(lanes), False)

    members = tuple(candidate.name for candidate in candidates)
    return (
        Case(material, queries, None, {"material": source}, members, QUERIES),
        candidates,
        [*trainings, *nets],
    )
