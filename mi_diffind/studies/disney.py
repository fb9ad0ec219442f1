"""Study ``tradeoff disney``: accuracy of the Disney BRDF against time, with constant and with textured materials.

``disney`` evaluates formulas; ``neural_disney`` is measured with each preset, in each storage form, and with one of its
tables only. Networks (:func:`.disney_network`) have as many bytes as the tables of each preset take in memory, in
``uint8``. Mitsuba's ``principled`` is timed beside them. Errors are measured against
:mod:`~mi_diffind.tasks.disney.model`, formulas that no plugin shares.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.lookup import STORAGES
from ..core.runtime import array_module
from ..fitting.task import FitSettings
from ..measure.clock import FLOPS, Operations, count_query
from ..measure.renders import QUERIES, TEXTURE_SIZE, bsdf_queries, directions, noise_texture
from ..measure.report import grid
from ..measure.store import fingerprint, package_files
from ..measure.study import Candidate, Case, Measure, Plan, Study
from ..measure.training import ConvergenceTraining
from ..tasks.disney import TASK
from ..tasks.disney.decoder import Decoder
from ..tasks.disney.factored import FactoredDecoder
from ..tasks.disney.model import PARAMETERS, Material
from ..tasks.disney.training import measure, shade
from .baselines import networks

#: Representations of the candidates.
REPRESENTATIONS = ("Mitsuba", "formulas", "arithmetic", "tables", "paper", "one table", "network")

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


#: Parameters of a material that uses every part of the model, and of one with the two lobes that most materials have.
ALL_LOBES = {
    "roughness": 0.43, "anisotropic": 0.5, "metallic": 0.3, "specular": 0.6, "spec_tint": 0.4, "sheen": 0.5,
    "sheen_tint": 0.6, "flatness": 0.3, "clearcoat": 0.7, "clearcoat_gloss": 0.63,
}  # fmt: skip


DIFFUSE_SPECULAR = {"roughness": 0.43, "specular": 0.6}


BASE_COLOR = (0.8, 0.3, 0.2)


#: Name of the truth as a candidate, which is timed in ``eval`` only, with constant materials, in RGB.
FORMULAS = "formulas"


#: Presets of ``neural_disney`` that are measured.
PRESETS = ("tables", "paper")


#: Candidates of a quick study that are rendered, and measured with textured materials.
QUICK = ("principled", "disney", "tables")


#: Candidates of a quick study that are trained.
QUICK_PRESETS = ("tables",)


_PRINCIPLED_NOTE = "another model (full Fresnel terms, no flatness without `thin`): no error against this one"


_FORMULAS_NOTE = "the formulas alone, without a plugin's checks of directions and selection of lobes"


_NETWORK_NOTE = "in half precision; timed without a plugin's checks of directions and selection of lobes"


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
    candidates, plugins = _candidates(quick)
    trainings = _trainings(quick)
    candidates += [_network_candidate(training) for training in trainings.values()]
    candidates = [c for c in candidates if not only or c.representation in only]
    trainings = {name: training for name, training in trainings.items() if name in {c.name for c in candidates}}
    plugins = {name: build for name, build in plugins.items() if name in {c.name for c in candidates}}
    lobes = {"all lobes": ALL_LOBES, "diffuse + specular": DIFFUSE_SPECULAR}
    combinations = [(m, l) for m in ("constant", "textured") for l in lobes]
    if quick:
        combinations = [("constant", "all lobes"), ("textured", "diffuse + specular")]
        for candidate in candidates:
            candidate.in_passes &= candidate.name in QUICK
    rendered = {c.name: plugins[c.name] for c in candidates if c.in_passes}
    cases = []
    for material, name in combinations:
        parameters = lobes[name]
        bare = {}
        if material == "constant" and mi.is_rgb:
            bare = {
                FORMULAS: lambda: None,
                **{n: (lambda t=t: networks.NetworkDecoder(t.net.cooperative())) for n, t in trainings.items()},
            }
        names = [*plugins, *(c.name for c in candidates if c.name in bare)]
        if quick and cases:
            names = [n for n in QUICK if n in plugins]
        if not names:
            continue
        timed = {n: plugins[n] for n in names if n in plugins}
        evaluated = {n: bare[n] for n in names if n in bare}
        passes = rendered and not (quick and cases)
        cases.append(
            Case(
                f"{material}, {name}",
                lambda lanes, t=timed, b=evaluated, m=material, p=parameters: _queries(t, b, m, p, lanes),
                (lambda m=material, p=parameters: _passes(rendered, m, p, quick)) if passes else None,
                {"material": material, "lobes": name, "base_color": BASE_COLOR, **parameters},
                tuple(names),
                query_names=None if timed else ("eval",),
            )
        )
    code = package_files("fitting/loop.py", "studies/baselines/networks.py", "tasks/disney/*.py")
    return Plan(
        study="disney",
        title="Disney BRDF: accuracy against time",
        candidates=candidates,
        cases=cases,
        queries=QUERIES,
        accuracy="psnr_db_training",
        accuracy_label="PSNR of BRDF · cosine, dB",
        ratios=[
            ("principled", "disney"),
            *(("principled", name) for name in ("tables", "tables, uint8")),
            *((name, "disney") for name in ("tables", "tables, uint8", "paper", "paper, uint8")),
            (FORMULAS, "disney"),
        ],
        details={
            "paper_operations": {name: o.asdict() for name, o in PAPER.items()},
            "flops": FLOPS,
            "texture_size": TEXTURE_SIZE,
            "errors": "PSNR in dB and mean absolute error of BRDF · cosine, clipped to [0, 1], over random directions "
            "and materials with all lobes: distributed as in training, and uniformly",
        },
        jobs=list(trainings.values()),
        jobs_fingerprint=fingerprint(code),
        measures=tuple(Measure(f"dB, {name}", f"psnr_db_{name}") for name in ("training", "uniform")),
        conclusions=operation_table,
    )


def _trainings(quick: bool) -> dict[str, ConvergenceTraining]:
    """Return the trainings of networks, in the bytes in memory of each preset's tables in ``uint8``, by name."""
    return {
        f"network, bytes of {preset}": network_training(f"network, bytes of {preset}", _table_bytes(preset), quick)
        for preset in (QUICK_PRESETS if quick else PRESETS)
    }


def _table_bytes(preset: str) -> int:
    return TASK.open(mi.TensorXf, preset=preset, storage="uint8").memory_nbytes


def network_training(name: str, nbytes: int, quick: bool = False) -> ConvergenceTraining:
    """Return the training to convergence of the widest network of ``nbytes``, in half precision."""
    types, steps, longest = array_module(mi.variant()), STEPS, LONGEST
    if quick:
        steps, longest = QUICK_STEPS, 2 * QUICK_STEPS

    def problem() -> networks.DisneyNetworkProblem:
        return networks.DisneyNetworkProblem(networks.disney_network(nbytes), types)

    def finish(net, record: dict) -> dict:
        details = {
            "inputs": net.inputs, "width": net.width, "layers": net.layers, "outputs": "four factors",
            "steps_first": steps, "steps_longest": longest, "batch": 2**12, "steps": record["steps"],
            "equal_to_bytes": nbytes,
        }  # fmt: skip
        return {"bytes": 2 * record["entries"], "details": details}

    settings = FitSettings(steps=steps, batch=2**12, lr=1e-2, loss="mse", seed=1)
    return ConvergenceTraining(name, problem, settings, longest, 10, True, finish)


def _network_candidate(training: ConvergenceTraining) -> Candidate:
    """Return the candidate of a trained network, which is timed in ``eval`` only, with constant materials, in RGB."""

    def counted(query: str) -> Operations:
        material, albedo, wi, wo = _constants(ALL_LOBES, 64)
        decoder = networks.NetworkDecoder(training.net.cooperative())
        return count_query(lambda: shade(decoder, material, albedo, wi, wo)) + training.net.products()

    return Candidate(
        training.name, "network", "float16", errors=_errors(lambda: networks.NetworkDecoder(training.net)),
        in_passes=False, job=training.name, queries=("eval",), operations=counted, note=_NETWORK_NOTE,
    )  # fmt: skip


def _errors(decoder: Callable[[], Decoder]) -> Callable[[int], dict[str, float]]:
    """Return a function that measures the errors of a form of the model with a number of samples."""

    def measure_errors(samples: int) -> dict[str, float]:
        types, form = array_module(mi.variant()), decoder()
        measured = {d: measure(form, types, samples, d) for d in ("training", "uniform")}
        return {f"{error}_{d}": m[error] for d, m in measured.items() for error in ("psnr_db", "mae")}

    return measure_errors


def _candidates(quick: bool) -> tuple[list[Candidate], dict]:
    """Return the candidates (``quick``: without half precision) and the builders of their BSDFs.

    A builder is a function from parameters, as for ``mi.load_dict``, to a BSDF.
    """
    types = array_module(mi.variant())

    def errors(decoder):
        return _errors(lambda: decoder)

    def loaded(**plugin):
        return lambda parameters: mi.load_dict({**plugin, **parameters})

    def with_decoder(decoder):
        def build(parameters):
            bsdf = mi.load_dict({"type": "neural_disney", "preset": "tables", "storage": "float32", **parameters})
            bsdf.decoder = decoder(bsdf.decoder.arrays)
            bsdf.parameters_changed()  # evaluates constant factors again, with this decoder
            return bsdf

        return build

    candidates = [
        Candidate("principled", "Mitsuba", is_reference=True, note=_PRINCIPLED_NOTE),
        Candidate(FORMULAS, "formulas", is_truth=True, in_passes=False, queries=("eval",), note=_FORMULAS_NOTE),
        Candidate("disney", "arithmetic", errors=errors(Decoder())),
    ]
    plugins = {"principled": loaded(type="principled"), "disney": loaded(type="disney")}
    for preset in PRESETS:
        for storage in ("float32", "uint8") if quick else STORAGES:
            name = preset if storage == "float32" else f"{preset}, {storage}"
            model = TASK.open(types.TensorXf, preset=preset, storage=storage)
            candidates.append(Candidate(name, preset, storage, model.nbytes, None, errors(model.decoder)))
            plugins[name] = loaded(type="neural_disney", preset=preset, storage=storage)
    model = TASK.open(types.TensorXf, preset="tables")
    for factor in FactoredDecoder.FACTORS:
        name = f"only {factor} read"
        read = [n for n in model.arrays if n == factor or (factor == "alpha" and n.startswith("encoder"))]
        size = sum(model.arrays[n].nbytes for n in read)
        decoder = FactoredDecoder(model.layout, read=(factor,))
        once = "read once where the material is constant" if factor in ("alpha", "coat") else ""
        candidates.append(Candidate(name, "one table", factor, size, None, errors(decoder), in_passes=False, note=once))
        plugins[name] = with_decoder(lambda arrays, f=factor: FactoredDecoder(arrays, read=(f,)))
    return candidates, plugins


def _material(material: str, parameters: dict) -> dict:
    """Return parameters for ``mi.load_dict``: numbers, or for ``"textured"`` textures that vary around them."""
    if material == "constant":
        return {"base_color": {"type": "rgb", "value": list(BASE_COLOR)}, **parameters}
    rng = np.random.default_rng(1)
    # `principled` takes no texture for `specular`, so it is a number for all
    return {
        "base_color": noise_texture(BASE_COLOR, rng),
        **{name: value if name == "specular" else noise_texture([value], rng) for name, value in parameters.items()},
    }


def _queries(plugins: dict, bare: dict, material: str, parameters: dict, lanes: int) -> dict:
    """Return the queries of BSDFs, and ``eval`` of the forms of ``bare``: functions that return a decoder or ``None``.

    ``None`` stands for the published formulas.
    """
    bsdfs = {name: build(_material(material, parameters)) for name, build in plugins.items()}
    functions = bsdf_queries(bsdfs, directions(lanes), material == "textured")
    constant, albedo, wi, wo = _constants(parameters, lanes)
    decoders = {name: decoder() for name, decoder in bare.items()}
    for name, decoder in decoders.items():
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
    for name, build in plugins.items():
        bsdf = build(_material(material, parameters))
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


def operation_table(result: dict) -> list[str]:
    """Return tables of the operations of one evaluation of constant materials, beside the paper's."""
    names = [*FLOPS, "flops", "gathers", "bytes_gathered", "instructions"]
    lines = []
    for case, measured in result["cases"].items():
        if measured["details"]["material"] == "constant":
            counts = {name: t["operations"] for name, t in measured["queries"]["eval"].items()}
            if measured["details"]["lobes"] == "all lobes":
                unknown = dict.fromkeys(("bytes_gathered", "instructions"), "")
                counts = {name: o.asdict() | unknown for name, o in PAPER.items()} | counts
            lines.append(f"operations of one eval, {case} (add, mul 1 flop; div 2; sqrt, log 4)")
            lines += grid([["", *names], *([name, *(str(o[key]) for key in names)] for name, o in counts.items())])
    return lines
