"""Study ``tradeoff ggx``: accuracy of the GGX distribution of normals against time and bytes.

Indirection at several sizes and in each storage form, single tables, networks and the formula are measured with two
parametrisations of their *inputs*: the plain one, (cos θ_h, α) as in the paper, and the logarithmic one of
``neural_ggx`` (:class:`~mi_diffind.tasks.ggx.model.Encoding`). All learn the same output, the bounded root of D, from
the same samples with the same error measure; candidates marked *raw* learn D itself, as the paper's recipe does. All
are trained until they converge (:mod:`~mi_diffind.measure.training`). The rough conductor that is built from the
distribution is timed beside Mitsuba's.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.indirection import DifferentiableArray
from ..arrays.lookup import STORAGES
from ..core.runtime import array_module
from ..fitting.loop import FitSettings
from ..measure.clock import Operations, count_query
from ..measure.renders import bsdf_queries, directions, noise_texture
from ..measure.store import fingerprint, package_files
from ..measure.study import FLOOR, Candidate, Case, Measure, Plan, Study
from ..measure.training import ConvergenceTraining
from ..tasks.ggx import TASK
from ..tasks.ggx.model import Encoding, LearnedGGX, ggx, indirection
from ..tasks.ggx.training import GGXProblem, draw, measure
from .baselines.networks import Network

#: Sides of the primary and the cascaded array of the equal-quality reference, the paper's sizes, and their entries.
PRIMARY = 16
CASCADED = 8
ENTRIES = 2 * PRIMARY**2 + CASCADED**2

#: Indirection of the paper's sizes, which ratios are to.
REFERENCE = f"{PRIMARY}→{CASCADED}"

#: Names of the cases, one for each parametrisation of the inputs.
PLAIN = "inputs as in the paper"
LOGARITHMIC = "logarithmic inputs"

#: Sides of the primary arrays, with cascaded ones half as long (ρ = 2).
SIZES = (8, 16, 32, 64)


#: Sizes of single tables, as multiples of ``ENTRIES``; the paper needs 512 for equal quality.
MULTIPLES = (1, 4, 16, 64, 512)


#: Width and hidden layers of the networks. The last has about as many parameters as the paper's.
NETWORKS = ((8, 2), (16, 2), (32, 3))


#: Training settings of each representation, chosen by experiment: indirection with plain inputs gains from a high
#: learning rate, networks from many small steps. ``steps`` is the length of the first run, ``longest`` of the longest.
SETTINGS = {
    "indirection, plain": {"lr": 5e-2, "batch": 16384, "steps": 2000, "longest": 16000},
    "indirection, logarithmic": {"lr": 1e-2, "batch": 16384, "steps": 2000, "longest": 16000},
    "single table": {"lr": 1e-2, "batch": 65536, "steps": 1000, "longest": 8000},
    "raw": {"lr": 1e-3, "batch": 65536, "steps": 2000, "longest": 8000},
    "network": {"lr": 1e-2, "batch": 1024, "steps": 8000, "longest": 32000},
    "wide network": {"lr": 5e-3, "batch": 1024, "steps": 8000, "longest": 32000},
}


#: Steps of the first run of a quick study; the longest run takes twice as many.
QUICK_STEPS = 80


#: Options of the hash grid in front of a network.
HASH_GRID = {
    "n_levels": 4, "n_features_per_level": 2, "hashmap_size": 2**12, "base_resolution": 4, "per_level_scale": 2,
    "align_corners": True, "init_scale": 1e-2,
}  # fmt: skip


#: How networks are read.
COOPERATIVE = "cooperative vectors"

#: Storage → its suffix in labels, bytes of an entry of four.
READ_AS = {"float32": ("", 4), "float16": (" f16", 2), "uint8": (" u8", 1), COOPERATIVE: ("", 4)}


class GGXStudy(Study):
    """Accuracy of the GGX distribution against time and bytes."""

    name = "ggx"
    title = "all forms of the GGX distribution"

    def plan(self, arguments) -> Plan:
        return plan(arguments.quick)


STUDY = GGXStudy()


@dataclass(frozen=True)
class GGXForm:
    """Representation of one size for one kind of ``inputs``, before its training.

    ``net`` is the module, not yet allocated, ``nbytes`` its bytes as it is trained, ``settings_key`` the key of
    :data:`SETTINGS`. It is read in each of the ``storages`` (:data:`READ_AS`).
    """

    label: str
    representation: str
    inputs: str
    net: object
    nbytes: int
    settings_key: str
    storages: tuple[str, ...] = (COOPERATIVE,)
    output: str = "root"

    def name(self, suffix: str = "") -> str:
        """Return the name of the training, or of the candidate with a suffix."""
        return self.label + suffix + ", log" * (self.inputs == "logarithmic")

    def training(self, types, quick: bool, quick_steps: int) -> ConvergenceTraining:
        """Return the training to convergence."""
        options = dict(SETTINGS[self.settings_key])
        longest = options.pop("longest")
        settings = FitSettings(seed=1, schedule="cosine", deterministic=False, **options)
        if quick:
            settings, longest = dataclasses.replace(settings, steps=quick_steps), 2 * quick_steps
        samples, encoding = "tables" if self.inputs == "logarithmic" else "paper", Encoding(self.inputs, self.output)

        def problem() -> GGXProblem:
            return GGXProblem(self.net.alloc(types.TensorXf, 2, dr.rng(seed=1)), types, samples, encoding)

        return ConvergenceTraining(self.name(), problem, settings, longest, 4 if quick else 20)

    def candidates(self, training: ConvergenceTraining, types) -> Iterator[tuple[Candidate, Callable]]:
        """Yield a candidate for each storage, with a function that returns the reader of the trained module."""

        @functools.cache
        def reader(storage: str) -> LearnedGGX:
            net = training.net.cooperative() if storage == COOPERATIVE else training.net.to(storage)
            return LearnedGGX(net, Encoding(self.inputs, self.output), tail=False)

        def count_operations(query: str) -> Operations:
            inputs = _inputs(types, 64)
            return count_query(lambda: [reader(COOPERATIVE)(*inputs)]) + training.net.products()

        for storage in self.storages:
            suffix, size = READ_AS[storage]
            yield Candidate(
                self.name(suffix), self.representation, storage, self.nbytes * size // 4,
                errors=lambda samples, storage=storage: measure(reader(storage), types, samples),
                label=self.label + suffix, job=training.name,
                operations=count_operations if storage == COOPERATIVE else None,
            ), functools.partial(reader, storage)  # fmt: skip


def forms(inputs: str, quick: bool) -> list[GGXForm]:
    """Return the representations for ``inputs``: indirection and single tables, networks; ``quick``: fewer."""
    plain = inputs == "plain"
    sizes, multiples = (SIZES, MULTIPLES) if plain else ((PRIMARY, 2 * PRIMARY), (1, 4))
    if quick:
        sizes, multiples = (sizes[:2], multiples[:2]) if plain else (sizes[:1], multiples[:1])

    def cascade(side: int) -> tuple:
        return f"{side}→{side // 2}", inputs, indirection(side, side // 2), 4 * (2 * side**2 + (side // 2) ** 2)

    def single(side: int) -> tuple:
        return f"{side}²", inputs, DifferentiableArray((side, side), 1, "constant", 0.5), 4 * side**2

    def form(representation: str, described: tuple, *options) -> GGXForm:
        label, *rest = described
        return GGXForm(label + " raw" * (representation == "raw"), representation, *rest, *options)

    chosen = [form("indirection", cascade(side), f"indirection, {inputs}", STORAGES) for side in sizes]
    for multiple in multiples:
        storages = STORAGES[: None if multiple == 1 else 1]
        chosen.append(form("single table", single(math.isqrt(ENTRIES * multiple)), "single table", storages))
    if plain and not quick:  # learn D as it is, at the paper's learning rate
        for described in (cascade(PRIMARY), single(math.isqrt(ENTRIES))):
            chosen.append(form("raw", described, "raw", STORAGES[:1], "raw"))
    nets = [(f"MLP {w}x{n}", "network", Network(2, w, n)) for w, n in (NETWORKS if plain else NETWORKS[1:])]
    if plain:
        nets.append(("grid + MLP 16", "hash grid + network", Network(2, 16, 1, HASH_GRID)))
    if quick:
        nets = [nets[0], nets[-1]] if plain else []
    for label, representation, network in nets:
        nbytes = network.alloc(array_module(mi.variant()).TensorXf, 2, dr.rng(seed=1)).nbytes
        key = "network" if network.width < 32 else "wide network"
        chosen.append(GGXForm(label, representation, inputs, network, nbytes, key))
    return chosen


def plan(quick: bool = False, quick_steps: int = QUICK_STEPS) -> Plan:
    """Return the plan of the study in the current variant.

    ``quick``: fewer candidates, whose first training takes ``quick_steps`` steps and whose longest twice as many.
    """
    types = array_module(mi.variant())
    candidates, trainings, cases, ratios = [], [], [], []
    for inputs, case in {"plain": PLAIN, "logarithmic": LOGARITHMIC}.items():
        readers = {}
        for form in forms(inputs, quick):
            training = form.training(types, quick, quick_steps)
            trainings.append(training)
            for candidate, reader in form.candidates(training, types):
                candidates.append(candidate)
                readers[candidate.name] = reader
        end = ", log" * (inputs == "logarithmic")
        reference, names = f"{REFERENCE}{end}", [f"{REFERENCE} f16", f"{REFERENCE} u8", f"{math.isqrt(ENTRIES)}²"]
        ratios += [*((name + end, reference) for name in names), (reference, "formula")]
        readers["formula"] = lambda: lambda cos, sin2, alpha: ggx(sin2, alpha)
        cases.append(Case(case, functools.partial(_reads, types, readers)))
    candidates += [
        Candidate("formula", "formula", is_truth=True), Candidate("roughconductor", "Mitsuba", is_truth=True)
    ]  # fmt: skip
    conductors = {"roughconductor": {"type": "roughconductor", "distribution": "ggx"}}
    for storage in STORAGES:
        name = "neural_ggx" + ("" if storage == "float32" else f", {storage}")
        conductors[name] = {"type": "neural_ggx", "storage": storage}
        model = TASK.open(types.TensorXf, storage=storage)
        candidates.append(Candidate(name, "indirection", storage, model.nbytes, model.measure))
        ratios.append((name, "roughconductor"))
    for roughness in ("constant",) if quick else ("constant", "textured"):
        queries = functools.partial(_conductor_queries, conductors, roughness)
        cases.append(Case(f"conductor, {roughness} roughness", queries, in_picture=False))
    code = package_files("arrays/lookup.py", "arrays/indirection.py", "fitting/loop.py", "tasks/*.py",
                         "tasks/ggx/*.py", "studies/baselines/networks.py")  # fmt: skip
    return Plan(
        study="ggx",
        title="GGX distribution of normals: accuracy against time and bytes",
        candidates=candidates,
        cases=cases,
        measures=(Measure("PSNR of D clipped to [0, 1], dB", "psnr_db"),),
        ratios=ratios,
        jobs=trainings,
        jobs_fingerprint=fingerprint(code),
        panels=("bytes",),
    )


def _inputs(types, lanes: int) -> tuple:
    """Return ``(cos θ_h, sin² θ_h, α)`` of ``lanes`` reads, evaluated."""
    samples = draw(dr.rng(seed=dr.opaque(types.UInt64, 7)), types, lanes)
    dr.make_opaque(*samples)
    return samples


def _reads(types, readers: dict[str, Callable], lanes: int) -> dict:
    """Return the reads of all candidates for one kind of inputs."""
    inputs = _inputs(types, lanes)
    functions = {FLOOR: lambda: list(inputs)}
    for name, reader in readers.items():
        functions[name] = lambda reader=reader: [reader()(*inputs)]
    return {"read": functions}


def _conductor_queries(plugins: dict, roughness: str, lanes: int) -> dict:
    def load(plugin: dict):
        alpha = noise_texture([0.2], np.random.default_rng(1)) if roughness == "textured" else 0.2
        return mi.load_dict({**plugin, "material": "Cu", "alpha": alpha})

    bsdfs = {name: load(plugin) for name, plugin in plugins.items()}
    return bsdf_queries(bsdfs, directions(lanes), roughness == "textured")
