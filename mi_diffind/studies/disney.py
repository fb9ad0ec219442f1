"""Study ``tradeoff disney``: accuracy of the Disney BRDF against time, with constant and with textured materials.

``disney`` evaluates formulas; ``neural_disney`` is measured with each preset in each storage. Networks
(:func:`.disney_network`) have as many bytes as the tables of each preset take in memory, in ``uint8``. Mitsuba's
``principled`` is timed beside them. Errors are measured against :mod:`~mi_diffind.tasks.disney.model`, formulas that no
plugin shares.
"""

from __future__ import annotations

import argparse
import functools
import itertools
from collections.abc import Callable, Sequence

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

#: Representations of the candidates.
REPRESENTATIONS = ("Mitsuba", "formulas", "arithmetic", "tables", "paper", "network")

#: The paper's count of operations of one evaluation (supplement, 1.2.1).
PAPER = {
    "exact, the paper's": Operations(add=92, mul=150, div=17, sqrt=5, log=1),
    "tables, the paper's": Operations(add=11, mul=26, div=2, gathers=5),
}

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

#: Candidates of a quick study that are rendered, and measured with textured materials.
QUICK = ("principled", "disney", "tables")


class DisneyStudy(Study):
    """Accuracy of the Disney BRDF against time."""

    name = "disney"
    title = "all forms of the Disney BRDF"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--only", action="append", default=[], choices=REPRESENTATIONS, metavar="REPRESENTATION",
            help=f"measure only one representation ({', '.join(REPRESENTATIONS)}); may be repeated",
        )  # fmt: skip

    def plan(self, arguments) -> Plan:
        return plan(arguments.quick, arguments.only)


STUDY = DisneyStudy()


def plan(quick: bool = False, only: Sequence[str] = ()) -> Plan:
    """Return the plan of the study in the current variant.

    ``quick``: fewer cases, fewer and smaller renders, short trainings. ``only``: representations that are measured
    (default: all).
    """
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
            candidates.append(
                Candidate(name, preset, storage, model.nbytes, _errors(lambda m=model: m.decoder))
            )  # fmt: skip
            plugins[name] = {"type": "neural_disney", "preset": preset, "storage": storage}
    trainings = {}
    for preset in PRESETS[:1] if quick else PRESETS:
        nbytes = TASK.open(mi.TensorXf, preset=preset, storage="uint8").memory_nbytes
        training = network_training(f"network, bytes of {preset}", nbytes, quick)
        trainings[training.name] = training
        candidates.append(_network_candidate(training))
    candidates = [c for c in candidates if not only or c.representation in only]
    names = [c.name for c in candidates]
    cases = []
    for material, lobes in itertools.product(("constant", "textured"), LOBES):
        small = quick and material == "textured"
        if quick and lobes != ("diffuse + specular" if small else "all lobes"):
            continue
        timed = {n: plugin for n, plugin in plugins.items() if n in names and (not small or n in QUICK)}
        bare = {n: trainings.get(n) for n in names if n not in plugins} if material == "constant" and mi.is_rgb else {}
        rendered = {n: plugin for n, plugin in timed.items() if not quick or n in QUICK}
        if timed or bare:
            details = {"material": material, "lobes": lobes, "base_color": BASE_COLOR, **LOBES[lobes]}
            queries = functools.partial(_queries, timed, bare, material, LOBES[lobes])
            passes = functools.partial(_passes, rendered, material, LOBES[lobes], quick)
            cases.append(Case(f"{material}, {lobes}", queries, passes if rendered and not small else None, details))
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
        details={"paper_operations": {name: o.asdict() for name, o in PAPER.items()}},
        jobs=[training for name, training in trainings.items() if name in names],
        jobs_fingerprint=fingerprint(code),
    )


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
        material, albedo, wi, wo = _constants(LOBES["all lobes"], 64)
        decoder = networks.NetworkDecoder(training.net.cooperative())
        return count_query(lambda: shade(decoder, material, albedo, wi, wo)) + training.net.products()

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


def _bsdf(plugin: dict, material: str, parameters: dict):
    """Return a loaded BSDF: its parameters are numbers, or for ``"textured"`` textures that vary around them."""
    color = {"type": "rgb", "value": list(BASE_COLOR)}
    if material == "textured":
        rng = np.random.default_rng(1)
        color = noise_texture(BASE_COLOR, rng)
        # `principled` takes no texture for `specular`, so it is a number for all
        parameters = {n: v if n == "specular" else noise_texture([v], rng) for n, v in parameters.items()}
    return mi.load_dict({**plugin, "base_color": color, **parameters})


def _queries(plugins: dict, bare: dict, material: str, parameters: dict, lanes: int) -> dict:
    """Return the queries of BSDFs, and ``eval`` of the networks of ``bare``; ``None`` stands for the formulas."""
    bsdfs = {name: _bsdf(plugin, material, parameters) for name, plugin in plugins.items()}
    functions = bsdf_queries(bsdfs, directions(lanes), material == "textured", QUERIES if plugins else ("eval",))
    constant, albedo, wi, wo = _constants(parameters, lanes)
    for name, training in bare.items():
        decoder = training and networks.NetworkDecoder(training.net.cooperative())
        functions["eval"][name] = lambda d=decoder: shade(d, constant, albedo, wi, wo)
    return functions


def _constants(parameters: dict, lanes: int) -> tuple:
    """Return a material, each parameter one number for all lanes as in a plugin, its albedo, ``wi`` and ``wo``."""
    values = {**dict.fromkeys(PARAMETERS, 0.0), **parameters}
    constants, albedo = {name: dr.opaque(mi.Float, value) for name, value in values.items()}, mi.Color3f(BASE_COLOR)
    dr.make_opaque(albedo)
    si, wo, *_ = directions(lanes)
    return Material(**constants), albedo, si.wi, wo


def _passes(plugins: dict, material: str, parameters: dict, quick: bool) -> dict:
    """Return renders of a sphere on a plane, both of the material, lit by a constant sky and one lamp."""
    size, spp = (64, 4) if quick else (256, 16)
    transform = mi.ScalarTransform4f
    renders = {}
    for name, plugin in plugins.items():
        bsdf = _bsdf(plugin, material, parameters)
        scene = mi.load_dict({
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 5, "rr_depth": 100},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": transform().look_at(origin=[0, -4.5, 2.2], target=[0, 0, 0.8], up=[0, 0, 1]),
                "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
                "sampler": {"type": "independent", "sample_count": spp},
            },
            "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.5}},
            "lamp": {
                "type": "rectangle",
                "to_world": transform().look_at(origin=[2, -2, 4], target=[0, 0, 0.5], up=[0, 1, 0]).scale(0.6),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 12.0}},
            },
            "floor": {"type": "rectangle", "to_world": transform().scale(6), "bsdf": bsdf},
            "ball": {"type": "sphere", "center": [0, 0, 1], "bsdf": bsdf},
        })  # fmt: skip
        renders[name] = lambda number, scene=scene: mi.render(scene, spp=spp, seed=number)
    return renders
