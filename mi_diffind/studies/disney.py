"""Study ``tradeoff disney``: accuracy of the Disney BRDF against time, with constant and with textured materials.

``disney`` evaluates formulas; ``neural_disney`` is measured with each preset in each storage. Mitsuba's ``principled``
is timed beside them. Errors are measured against :mod:`~mi_diffind.tasks.disney.model`, formulas that no plugin shares.
"""

import functools
import itertools
from collections.abc import Callable

import mitsuba as mi
import numpy as np

from ..arrays.lookup import STORAGES
from ..core.runtime import array_module
from ..measure.renders import bsdf_queries, directions, noise_texture
from ..measure.study import Candidate, Case, Measure, Plan, Study
from ..tasks.disney import TASK
from ..tasks.disney.decoder import Decoder
from ..tasks.disney.training import measure

#: Name → parameters of a material that uses every part of the model, and of one with the two lobes that most have.
LOBES = {
    "all lobes": {
        "roughness": 0.43, "anisotropic": 0.5, "metallic": 0.3, "specular": 0.6, "spec_tint": 0.4, "sheen": 0.5,
        "sheen_tint": 0.6, "flatness": 0.3, "clearcoat": 0.7, "clearcoat_gloss": 0.63,
    },
    "diffuse + specular": {"roughness": 0.43, "specular": 0.6},
}  # fmt: skip

BASE_COLOR = (0.8, 0.3, 0.2)

#: Presets of ``neural_disney`` that are measured.
PRESETS = ("tables", "paper")

#: Cases of a quick study.
QUICK = ("constant, all lobes", "textured, diffuse + specular")


class DisneyStudy(Study):
    """Accuracy of the Disney BRDF against time."""

    name = "disney"
    title = "all forms of the Disney BRDF"

    def plan(self, arguments) -> Plan:
        return plan(arguments.quick)


STUDY = DisneyStudy()


def plan(quick: bool = False) -> Plan:
    """Return the plan of the study in the current variant; ``quick``: fewer cases and storages."""
    plugins = {"principled": {"type": "principled"}, "disney": {"type": "disney"}}
    candidates = [
        Candidate("principled", "Mitsuba", is_reference=True),
        Candidate("disney", "arithmetic", errors=_errors(Decoder)),
    ]
    for preset in PRESETS:
        for storage in ("float32", "uint8") if quick else STORAGES:
            name = preset if storage == "float32" else f"{preset}, {storage}"
            model = TASK.open(mi.TensorXf, preset=preset, storage=storage)
            candidates.append(Candidate(name, preset, storage, model.nbytes, _errors(lambda m=model: m.decoder)))
            plugins[name] = {"type": "neural_disney", "preset": preset, "storage": storage}
    cases = []
    for material, lobes in itertools.product(("constant", "textured"), LOBES):
        name = f"{material}, {lobes}"
        if quick and name not in QUICK:
            continue
        details = {"material": material, "lobes": lobes, "base_color": BASE_COLOR, **LOBES[lobes]}
        cases.append(Case(name, functools.partial(_queries, plugins, material, LOBES[lobes]), details=details))
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
            *((name, "disney") for name in ("tables", "tables, uint8", "paper", "paper, uint8")),
        ],
        notes=["arithmetic: the plugin disney; tables and paper: presets of neural_disney, in single precision unless "
               "named otherwise. constant, textured: the parameters of the material."],
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


def _queries(plugins: dict, material: str, parameters: dict, lanes: int) -> dict:
    """Return the queries of BSDFs with a constant or a textured material."""
    bsdfs = {name: _bsdf(plugin, material, parameters) for name, plugin in plugins.items()}
    return bsdf_queries(bsdfs, directions(lanes), material == "textured")


def _bsdf(plugin: dict, material: str, parameters: dict):
    """Return a loaded BSDF: its parameters are numbers, or for ``"textured"`` textures that vary around them."""
    color = {"type": "rgb", "value": list(BASE_COLOR)}
    if material == "textured":
        rng = np.random.default_rng(1)
        color = noise_texture(BASE_COLOR, rng)
        # `principled` takes no texture for `specular`, so it is a number for all
        parameters = {n: v if n == "specular" else noise_texture([v], rng) for n, v in parameters.items()}
    return mi.load_dict({**plugin, "base_color": color, **parameters})
