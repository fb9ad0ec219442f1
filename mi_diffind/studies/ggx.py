"""Study ``tradeoff ggx``: accuracy of the GGX distribution of normals against time and bytes.

Indirection at several sizes and in each storage form, single tables, networks and the formula are measured with two
parametrisations of their *inputs*: the plain one, (cos θ_h, α) as in the paper, and the logarithmic one of
``neural_ggx`` (:class:`~mi_diffind.tasks.ggx.model.Encoding`). All learn the same output, the bounded root of D, from
the same samples with the same error measure, until they converge (:mod:`~mi_diffind.measure.training`). The rough
conductor that is built from the distribution is timed beside Mitsuba's.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.indirection import DifferentiableArray
from ..arrays.lookup import STORAGES
from ..core.runtime import array_module
from ..fitting.loop import FitSettings
from ..measure.clock import Operations, count_query
from ..measure.renders import bsdf_queries, directions, noise_texture
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

#: Parametrisation of the inputs → the name of its case, and the end of the names of its candidates.
INPUTS = {"plain": ("inputs as in the paper", ""), "logarithmic": ("logarithmic inputs", ", log")}

#: Sides of the primary arrays, with cascaded ones half as long (ρ = 2).
SIZES = {"plain": (8, 16, 32, 64), "logarithmic": (16, 32)}

#: Sizes of single tables, as multiples of ``ENTRIES``; the paper needs 512 for equal quality.
MULTIPLES = {"plain": (1, 4, 16, 64, 512), "logarithmic": (1, 4)}

#: Options of the hash grid in front of a network.
HASH_GRID = {
    "n_levels": 4, "n_features_per_level": 2, "hashmap_size": 2**12, "base_resolution": 4, "per_level_scale": 2,
    "align_corners": True, "init_scale": 1e-2,
}  # fmt: skip

#: Label → network. The last has about as many parameters as the paper's.
NETWORKS = {
    "MLP 8x2": Network(2, 8, 2), "grid + MLP 16": Network(2, 16, 1, HASH_GRID), "MLP 16x2": Network(2, 16, 2),
    "MLP 32x3": Network(2, 32, 3),
}  # fmt: skip

#: Trainings of a quick study.
QUICK = ("8→4", "16→8", "24²", "48²", "MLP 8x2", "grid + MLP 16", "16→8, log", "24², log")

#: Training settings of each representation, chosen by experiment: indirection with plain inputs gains from a high
#: learning rate, networks from many small steps. ``steps`` is the length of the first run, ``longest`` of the longest.
SETTINGS = {
    "indirection, plain": {"lr": 5e-2, "batch": 16384, "steps": 2000, "longest": 16000},
    "indirection, logarithmic": {"lr": 1e-2, "batch": 16384, "steps": 2000, "longest": 16000},
    "single table": {"lr": 1e-2, "batch": 65536, "steps": 1000, "longest": 8000},
    "network": {"lr": 1e-2, "batch": 1024, "steps": 8000, "longest": 32000},
    "wide network": {"lr": 5e-3, "batch": 1024, "steps": 8000, "longest": 32000},
}

#: Steps of the first run of a quick study; the longest run takes twice as many.
QUICK_STEPS = 80

#: Storage of networks: how they are read.
COOPERATIVE = "cooperative vectors"

#: Storage → its suffix in labels.
SUFFIXES = {"float32": "", "float16": " f16", "uint8": " u8", COOPERATIVE: ""}


class GGXStudy(Study):
    """Accuracy of the GGX distribution against time and bytes."""

    name = "ggx"
    title = "all forms of the GGX distribution"

    def plan(self, arguments) -> Plan:
        return plan(arguments.quick)


STUDY = GGXStudy()


class GGXTraining(ConvergenceTraining):
    """Training of a ``representation`` for one parametrisation of the ``inputs``, which is read in some ``storages``.

    ``net`` is the module, not yet allocated; ``settings_key`` the key of :data:`SETTINGS`.
    """

    def __init__(
        self, label: str, inputs: str, representation: str, net, settings_key: str, quick: bool,
        storages: tuple[str, ...] = (COOPERATIVE,),
    ):  # fmt: skip
        self.types, self.encoding = array_module(mi.variant()), Encoding(inputs)
        self.representation, self.storages, self.end = representation, storages, INPUTS[inputs][1]
        samples = "tables" if inputs == "logarithmic" else "paper"
        options = dict(SETTINGS[settings_key])
        longest = options.pop("longest")
        settings = FitSettings(seed=1, schedule="cosine", deterministic=False, **options)
        if quick:
            settings, longest = dataclasses.replace(settings, steps=QUICK_STEPS), 2 * QUICK_STEPS

        def problem() -> GGXProblem:
            untrained = net.alloc(self.types.TensorXf, 2, dr.rng(seed=1))
            return GGXProblem(untrained, self.types, samples, self.encoding)

        super().__init__(label + self.end, problem, settings, longest, 4 if quick else 20)

    def reader(self, storage: str) -> LearnedGGX:
        """Return the trained module, read in a storage."""
        net = self.net.cooperative() if storage == COOPERATIVE else self.net.to(storage)
        return LearnedGGX(net, self.encoding, tail=False)

    def candidates(self) -> Iterator[tuple[Candidate, Callable]]:
        """Yield a candidate for each storage, with a function that returns its reader."""

        def count_operations(query: str) -> Operations:
            inputs = _inputs(self.types, 64)
            return count_query(lambda: [self.reader(COOPERATIVE)(*inputs)]) + self.net.products()

        untrained = self.problem().net
        for storage in self.storages:
            name = self.name.removesuffix(self.end) + SUFFIXES[storage] + self.end
            reader = functools.cache(functools.partial(self.reader, storage))
            yield Candidate(
                name, self.representation, storage,
                untrained.nbytes if storage == COOPERATIVE else untrained.to(storage).nbytes,
                errors=lambda samples, reader=reader: measure(reader(), self.types, samples),
                job=self.name, operations=count_operations if storage == COOPERATIVE else None,
            ), reader  # fmt: skip


def trainings(inputs: str, quick: bool) -> list[GGXTraining]:
    """Return the trainings for ``inputs``: indirection, single tables, networks; ``quick``: fewer and shorter ones."""
    rows = []
    for side in SIZES[inputs]:
        net = indirection(side, side // 2)
        rows.append((f"{side}→{side // 2}", "indirection", net, f"indirection, {inputs}", STORAGES))
    for multiple in MULTIPLES[inputs]:
        side = math.isqrt(ENTRIES * multiple)
        net = DifferentiableArray((side, side), 1, "constant", 0.5)
        rows.append((f"{side}²", "single table", net, "single table", STORAGES[: 1 if multiple > 1 else None]))
    for label, net in NETWORKS.items():
        if inputs == "plain" or label in ("MLP 16x2", "MLP 32x3"):
            family = "hash grid + network" if net.grid else "network"
            rows.append((label, family, net, "network" if net.width < 32 else "wide network"))
    return [
        GGXTraining(label, inputs, representation, net, key, quick, *more)
        for label, representation, net, key, *more in rows
        if not quick or label + INPUTS[inputs][1] in QUICK
    ]


def plan(quick: bool = False) -> Plan:
    """Return the plan of the study in the current variant; ``quick``: fewer candidates, short trainings."""
    types = array_module(mi.variant())
    candidates, jobs, cases, ratios = [], [], [], []
    for inputs, (case, end) in INPUTS.items():
        readers = {}
        for training in trainings(inputs, quick):
            jobs.append(training)
            for candidate, reader in training.candidates():
                candidates.append(candidate)
                readers[candidate.name] = reader
        reference = f"{PRIMARY}→{CASCADED}"
        names = [f"{reference} f16", f"{reference} u8", f"{math.isqrt(ENTRIES)}²"]
        ratios += [*((name + end, reference + end) for name in names), (reference + end, "formula")]
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
    return Plan(
        study="ggx",
        title="GGX distribution of normals: accuracy against time and bytes",
        candidates=candidates,
        cases=cases,
        measures=(Measure("PSNR of D clipped to [0, 1], dB", "psnr_db"),),
        ratios=ratios,
        notes=[
            "16→8: 16 × 16 pointers into a table of 8 × 8; 24²: one table of 24 × 24; MLP 32x3: a network of three "
            "layers of 32 units; f16, u8: entries of two bytes and of one; log: logarithmic inputs."
        ],
        jobs=jobs,
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
