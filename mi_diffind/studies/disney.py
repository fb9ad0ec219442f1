"""Study ``tradeoff disney``: accuracy of the Disney BRDF against time, with constant and with textured materials.

``disney`` evaluates formulas; ``neural_disney`` is measured with each preset in each storage. Networks
(:func:`.disney_network`) have as many bytes as the tables of each preset take in memory, in ``uint8``. Mitsuba's
``principled`` is timed beside them. Errors are measured against :mod:`~mi_diffind.tasks.disney.model`, formulas that no
plugin shares.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.lookup import STORAGES
from ..core.runtime import array_module
from ..fitting.task import FitSettings
from ..measure.clock import Operations, count_query
from ..measure.renders import QUERIES, bsdf_queries, directions, noise_texture
from ..measure.store import fingerprint, package_files
from ..measure.study import Candidate, Case, Measure, Plan, Study
from ..measure.training import ConvergenceTraining
from ..tasks.disney import TASK
from ..tasks.disney.decoder import Decoder
from ..tasks.disney.model import PARAMETERS, Material
from ..tasks.disney.training import measure, shade
from .baselines import networks

#: Steps of the shortest training of a network, and of the longest; of a quick study (the longest takes twice as many).
#: The loss of longer ones is so small that a rare highlight in a batch looks like a divergence.
STEPS = 2000
LONGEST = 16000
QUICK_STEPS = 50

#: Name → parameters of a material that uses every part of the model, and of one with the two lobes that most have.
LOBES = {
    "all lobes": {
        "roughness": 0.43, "anisotropic": 0.5, "metallic": 0.3, "specular": 0.6, "spec_tint": 0.4, "sheen": 0.5,
        "sheen_tint": 0.6, "flatness": 0.3, "clearcoat": 0.7, "clearcoat_gloss": 0.63,
    },
    "diffuse + specular": {"roughness": 0.43, "specular": 0.6},
}  # fmt: skip

BASE_COLOR = (0.8, 0.3, 0.2)

#: Name of the truth as a candidate; it and networks are timed in ``eval`` only, with constant materials, in RGB.
FORMULAS = "formulas"

#: Presets of ``neural_disney`` that are measured; a quick study trains the network of the first.
PRESETS = ("tables", "paper")

#: Cases of a quick study → the plugins that are timed, or all.
QUICK = {"constant, all lobes": None, "textured, diffuse + specular": ("principled", "disney", "tables")}


class DisneyStudy(Study):
    """Accuracy of the Disney BRDF against time."""

    name = "disney"
    title = "all forms of the Disney BRDF"

    def plan(self, arguments) -> Plan:
        return plan(arguments.quick)


STUDY = DisneyStudy()


def plan(quick: bool = False) -> Plan:
    """Return the plan of the study in the current variant; ``quick``: fewer cases and storages, short trainings."""
    plugins = {"principled": {"type": "principled"}, "disney": {"type": "disney"}}
    candidates = [
        Candidate("principled", "Mitsuba", is_reference=True),
        Candidate(FORMULAS, "formulas", is_truth=True),
        Candidate("disney", "arithmetic", errors=_errors(Decoder)),
    ]
    for preset in PRESETS:
        for storage in ("float32", "uint8") if quick else STORAGES:
            name = preset if storage == "float32" else f"{preset}, {storage}"
            model = TASK.open(mi.TensorXf, preset=preset, storage=storage)
            candidates.append(Candidate(name, preset, storage, model.nbytes, _errors(lambda m=model: m.decoder)))
            plugins[name] = {"type": "neural_disney", "preset": preset, "storage": storage}
    trainings = []
    for preset in PRESETS[:1] if quick else PRESETS:
        nbytes = TASK.open(mi.TensorXf, preset=preset, storage="uint8").memory_nbytes
        trainings.append(network_training(f"network, bytes of {preset}", nbytes, quick))
        candidates.append(_network_candidate(trainings[-1]))
    cases = []
    for material, lobes in itertools.product(("constant", "textured"), LOBES):
        name = f"{material}, {lobes}"
        if quick and name not in QUICK:
            continue
        timed = {n: p for n, p in plugins.items() if not quick or n in (QUICK[name] or plugins)}
        bare = {FORMULAS: None, **{t.name: t for t in trainings}} if material == "constant" and mi.is_rgb else {}
        details = {"material": material, "lobes": lobes, "base_color": BASE_COLOR, **LOBES[lobes]}
        cases.append(Case(name, functools.partial(_queries, timed, bare, material, LOBES[lobes]), details=details))
    code = package_files("fitting/loop.py", "studies/baselines/networks.py", "tasks/disney/*.py")
    return Plan(
        study="disney",
        title="Disney BRDF: accuracy against time",
        candidates=candidates,
        cases=cases,
        measures=(
            Measure("PSNR of BRDF · cosine, dB", "psnr_db_training"),
            Measure("uniform materials, dB", "psnr_db_uniform"),
        ),
        ratios=[
            *(("principled", name) for name in ("disney", "tables", "tables, uint8")),
            *((name, "disney") for name in ("tables", "tables, uint8", "paper", "paper, uint8", FORMULAS)),
        ],
        notes=["arithmetic: the plugin disney; tables and paper: presets of neural_disney, in single precision unless "
               "named otherwise. constant, textured: the parameters of the material."],
        jobs=trainings,
        jobs_fingerprint=fingerprint(code),
    )  # fmt: skip


def network_training(name: str, nbytes: int, quick: bool = False) -> ConvergenceTraining:
    """Return the training to convergence of the widest network of ``nbytes``, in half precision."""
    types, steps = array_module(mi.variant()), QUICK_STEPS if quick else STEPS
    longest = 2 * QUICK_STEPS if quick else LONGEST

    def problem() -> networks.DisneyNetworkProblem:
        return networks.DisneyNetworkProblem(networks.disney_network(nbytes), types)

    def finish(net, record: dict) -> dict:
        sizes = {"width": net.width, "layers": net.layers, "steps": record["steps"], "steps_longest": longest}
        return {"bytes": 2 * record["entries"], "details": sizes}

    settings = FitSettings(steps=steps, batch=2**12, lr=1e-2, loss="mse", seed=1)
    return ConvergenceTraining(name, problem, settings, longest, 10, True, finish)


def _network_candidate(training: ConvergenceTraining) -> Candidate:
    """Return the candidate of a trained network."""

    def count_operations(query: str) -> Operations:
        return count_query(_bare_eval(training, LOBES["all lobes"], 64)) + training.net.products()

    return Candidate(
        training.name, "network", "float16", errors=_errors(lambda: networks.NetworkDecoder(training.net)),
        job=training.name, operations=count_operations,
    )  # fmt: skip


def _errors(decoder: Callable[[], Decoder]) -> Callable[[int], dict[str, float]]:
    """Return a function that measures the errors of a form of the model with a number of samples.

    They are PSNR in dB and mean absolute error of BRDF · cosine, clipped to [0, 1], over random directions and
    materials with all lobes: distributed as in training, and uniformly.
    """

    def measure_errors(samples: int) -> dict[str, float]:
        types, form = array_module(mi.variant()), decoder()
        measured = {d: measure(form, types, samples, d) for d in ("training", "uniform")}
        return {f"{error}_{d}": m[error] for d, m in measured.items() for error in ("psnr_db", "mae")}

    return measure_errors


def _queries(plugins: dict, bare: dict, material: str, parameters: dict, lanes: int) -> dict:
    """Return the queries of BSDFs, and ``eval`` of the networks of ``bare``; ``None`` stands for the formulas."""
    bsdfs = {name: _bsdf(plugin, material, parameters) for name, plugin in plugins.items()}
    functions = bsdf_queries(bsdfs, directions(lanes), material == "textured", QUERIES)
    functions["eval"] |= {name: _bare_eval(training, parameters, lanes) for name, training in bare.items()}
    return functions


def _bsdf(plugin: dict, material: str, parameters: dict):
    """Return a loaded BSDF: its parameters are numbers, or for ``"textured"`` textures that vary around them."""
    color = {"type": "rgb", "value": list(BASE_COLOR)}
    if material == "textured":
        rng = np.random.default_rng(1)
        color = noise_texture(BASE_COLOR, rng)
        # `principled` takes no texture for `specular`, so it is a number for all
        parameters = {n: v if n == "specular" else noise_texture([v], rng) for n, v in parameters.items()}
    return mi.load_dict({**plugin, "base_color": color, **parameters})


def _bare_eval(training: ConvergenceTraining | None, parameters: dict, lanes: int) -> Callable[[], object]:
    """Return ``eval`` of a network, or of the formulas, without a plugin.

    Each parameter of the material is one number for all lanes as in a plugin.
    """
    values = {**dict.fromkeys(PARAMETERS, 0.0), **parameters}
    material, albedo = Material(**{name: dr.opaque(mi.Float, v) for name, v in values.items()}), mi.Color3f(BASE_COLOR)
    dr.make_opaque(albedo)
    si, wo, *_ = directions(lanes)
    decoder = training and networks.NetworkDecoder(training.net.cooperative())
    return lambda: shade(decoder, material, albedo, si.wi, wo)
