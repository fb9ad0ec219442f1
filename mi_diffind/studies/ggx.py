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
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays.indirection import DifferentiableArray
from ..arrays.lookup import STORAGES
from ..core.runtime import array_module
from ..fitting.loop import FitSettings
from ..measure.clock import FLOPS, Operations, count_query
from ..measure.renders import bsdf_queries, directions, noise_texture
from ..measure.store import fingerprint, package_files
from ..measure.study import FLOOR, Candidate, Case, Measure, Plan, Study
from ..measure.training import ConvergenceTraining
from ..tasks.ggx import TASK
from ..tasks.ggx.model import INPUTS, Encoding, LearnedGGX, ggx, indirection
from ..tasks.ggx.training import GGXProblem, draw, measure
from .baselines.networks import Network

#: Sides of the primary and the cascaded array of the equal-quality reference, the paper's sizes, and their entries.
PRIMARY = 16
CASCADED = 8
ENTRIES = 2 * PRIMARY**2 + CASCADED**2

#: Names of the cases, one for each parametrisation of the inputs.
PLAIN = "inputs as in the paper"
LOGARITHMIC = "logarithmic inputs"

#: The paper's ratios to its own indirection at equal quality: flops, bytes read by a query, bytes stored; and those of
#: its indirection.
PAPER = {"network": (113.7, 256, 4), "single table": (0.33, 0.5, 512), "network + table": (28.4, 64, 0.5)}
PAPER_FLOPS = 36
PAPER_BYTES_READ = 16
PAPER_BYTES = 1024

#: PSNR, in dB, by which a candidate may be worse and still count as of equal quality.
EQUAL_DB = 0.25


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


#: Storage form → its suffix in labels, bytes of an entry.
_STORED = {"float32": ("", 4), "float16": (" f16", 2), "uint8": (" u8", 1)}


class GGXStudy(Study):
    """Accuracy of the GGX distribution against time and bytes."""

    name = "ggx"
    title = "all forms of the GGX distribution"

    def plan(self, arguments) -> Plan:
        return plan(arguments.quick)


STUDY = GGXStudy()


def plan(quick: bool = False, quick_steps: int = QUICK_STEPS) -> Plan:
    """Return the plan of the study in the current variant.

    ``quick``: fewer candidates, whose first training takes ``quick_steps`` steps and whose longest twice as many.
    """
    builder = GGXCandidates(array_module(mi.variant()), quick, quick_steps)
    for inputs in INPUTS[::-1]:
        builder.add_tables(inputs)
        builder.add_networks(inputs)
    builder.add_formula()
    cases = [
        builder.case(PLAIN, "plain", {"inputs": "cos θ_h and α, both vary", "output": "root, or raw where marked"}),
        builder.case(
            LOGARITHMIC, "logarithmic", {"inputs": "logarithms of sin²θ_h and α, both vary", "output": "root"}
        ),
        *builder.conductors(),
    ]
    code = package_files("arrays/lookup.py", "arrays/indirection.py", "fitting/loop.py", "tasks/*.py",
                         "tasks/ggx/*.py", "studies/baselines/networks.py")  # fmt: skip
    return Plan(
        study="ggx",
        title="GGX distribution of normals: accuracy against time and bytes",
        candidates=builder.candidates,
        cases=cases,
        measures=(Measure("PSNR of D clipped to [0, 1], dB", "psnr_db"),),
        ratios=builder.ratios,
        details={
            "flops": FLOPS,
            "paper": {"flops": PAPER_FLOPS, "bytes_read": PAPER_BYTES_READ, "bytes": PAPER_BYTES, "ratios": PAPER},
            "errors": "PSNR in dB and mean absolute error of D clipped to [0, 1], over cosine-weighted normals and "
            "exponential-like roughness; and by bands of roughness: the largest relative error at the normal, and the "
            "99th percentile of it where D is at least a tenth of the peak",
        },
        jobs=builder.trainings,
        jobs_fingerprint=fingerprint(code),
        panels=("bytes",),
    )


class GGXCandidates:
    """Builder of the plan: the candidates, their trainings, and the function that reads each of them."""

    def __init__(self, types, quick: bool, quick_steps: int):
        self.types, self.quick, self.quick_steps = types, quick, quick_steps
        self.candidates: list[Candidate] = []
        self.trainings: list[ConvergenceTraining] = []
        self.ratios: list[tuple[str, str]] = []
        #: Name of a candidate → function that returns its reader; and the inputs that it is read at.
        self.readers: dict[str, Callable[[], Callable]] = {}
        self.inputs: dict[str, str] = {}

    @staticmethod
    def name(label: str, inputs: str) -> str:
        return label if inputs == "plain" else f"{label}, log"

    def reference(self, inputs: str) -> str:
        """Return the name of the indirection of the paper's sizes."""
        return self.name(f"{PRIMARY}→{CASCADED}", inputs)

    def train(self, label: str, net: Callable, settings_key: str, encoding: Encoding) -> ConvergenceTraining:
        """Register a training by the settings :data:`SETTINGS` ``[settings_key]``."""
        options = dict(SETTINGS[settings_key])
        longest = options.pop("longest")
        settings = FitSettings(seed=1, schedule="cosine", deterministic=False, **options)
        if self.quick:
            settings, longest = dataclasses.replace(settings, steps=self.quick_steps), 2 * self.quick_steps
        samples = "tables" if encoding.inputs == "logarithmic" else "paper"

        def problem():
            return GGXProblem(net().alloc(self.types.TensorXf, 2, dr.rng(seed=1)), self.types, samples, encoding)

        name = self.name(label, encoding.inputs)
        self.trainings.append(ConvergenceTraining(name, problem, settings, longest, 4 if self.quick else 20))
        return self.trainings[-1]

    def add(self, label, representation, setting, size, training, form, encoding, operations=None):
        """Register a candidate; ``form(net)`` turns the trained module into the module to read."""
        name = self.name(label, encoding.inputs)
        reader = functools.cache(lambda: LearnedGGX(form(training.net), encoding, tail=False))
        self.candidates.append(
            Candidate(
                name, representation, setting, size,
                errors=lambda samples: measure(reader(), self.types, samples),
                label=label, job=training.name, operations=operations,
            )
        )  # fmt: skip
        self.readers[name], self.inputs[name] = reader, encoding.inputs

    def add_tables(self, inputs: str) -> None:
        """Register indirection at several sizes and single tables; with plain inputs also with raw output."""
        plain = inputs == "plain"
        sizes, multiples = (SIZES, MULTIPLES) if plain else ((PRIMARY, 2 * PRIMARY), (1, 4))
        if self.quick:
            sizes, multiples = sizes[:2] if plain else sizes[:1], multiples[:2] if plain else multiples[:1]
        encoding, reference = Encoding(inputs, "root"), self.reference(inputs)
        for side in sizes:
            self._add_table(side, f"indirection, {inputs}", encoding, STORAGES)
        self.ratios += [
            (self.name(f"{PRIMARY}→{CASCADED}{_STORED[storage][0]}", inputs), reference) for storage in STORAGES[1:]
        ]
        for multiple in multiples:
            storages = STORAGES if multiple == 1 else STORAGES[:1]
            self._add_table(math.isqrt(ENTRIES * multiple), "single table", encoding, storages)
        self.ratios.append((self.name(f"{math.isqrt(ENTRIES)}²", inputs), reference))
        if plain and not self.quick:
            for side, representation in ((PRIMARY, "indirection"), (math.isqrt(ENTRIES), "single table")):
                self._add_table(side, "raw", Encoding("plain", "raw"), STORAGES[:1], representation)

    def _add_table(
        self, side: int, settings_key: str, encoding: Encoding, storages: Sequence[str], representation: str = ""
    ) -> None:
        """Register a training, and a candidate in each storage form, of indirection or of a single table."""
        representation = representation or settings_key.split(",")[0]
        if representation == "indirection":
            label, entries = f"{side}→{side // 2}", 2 * side**2 + (side // 2) ** 2
            net = functools.partial(indirection, side, side // 2)
        else:
            label, entries = f"{side}²", side**2
            net = functools.partial(DifferentiableArray, (side, side), 1, "constant", 0.5)
        label += " raw" * (settings_key == "raw")
        training = self.train(label, net, settings_key, encoding)
        for storage in storages:
            suffix, size = _STORED[storage]
            form = lambda net, s=storage: net.to(s)  # noqa: E731
            self.add(label + suffix, representation, storage, size * entries, training, form, encoding)

    def add_networks(self, inputs: str) -> None:
        """Register networks as tensors and as cooperative vectors, after a hash grid, and in front of a table."""
        plain = inputs == "plain"
        networks = [(f"MLP {w}x{n}", "network", Network(2, w, n)) for w, n in (NETWORKS if plain else NETWORKS[1:])]
        if plain:
            networks.append(("grid + MLP 16", "hash grid + network", Network(2, 16, 1, HASH_GRID)))
            networks.append((f"MLP 8 + {PRIMARY}²", "network + table", Network(2, 8, 2, table=PRIMARY)))
        if self.quick:
            networks = [networks[0], *networks[-2:]] if plain else []
        encoding = Encoding(inputs, "root")
        for label, representation, network in networks:
            settings_key = "network" if network.width < 32 else "wide network"
            training = self.train(label, lambda n=network: n, settings_key, encoding)
            size = network.alloc(self.types.TensorXf, 2, dr.rng(seed=1)).nbytes
            operations = self._network_operations(training, encoding)
            self.add(label, representation, "cooperative vectors", size, training, Network.cooperative, encoding,
                     operations)  # fmt: skip
            self.add(f"{label} tensor", representation, "tensors", size, training, lambda net: net, encoding,
                     operations)  # fmt: skip

    def _network_operations(self, training: ConvergenceTraining, encoding: Encoding) -> Callable[[str], Operations]:
        """Return a counter of the operations in a kernel and of the matrix products, which a kernel does not show."""

        def counted(query: str) -> Operations:
            read, inputs = LearnedGGX(training.net.cooperative(), encoding), self.directions(64)
            return count_query(lambda: [read(*inputs)]) + training.net.products()

        return counted

    def add_formula(self) -> None:
        """Register the formula: the truth, read at both kinds of inputs."""
        self.candidates.append(Candidate("formula", "formula", is_truth=True, label="formula"))
        self.readers["formula"] = lambda: lambda cos, sin2, alpha: ggx(sin2, alpha)
        self.inputs["formula"] = "any"
        self.ratios += [(self.reference(inputs), "formula") for inputs in INPUTS[::-1]]

    def case(self, name: str, inputs: str, details: dict) -> Case:
        names = [n for n in self.readers if self.inputs[n] in (inputs, "any")]
        return Case(name, lambda lanes: self._queries(names, lanes), details=details)

    def _queries(self, names: list[str], lanes: int) -> dict:
        cos, sin2, alpha = directions = self.directions(lanes)
        functions = {FLOOR: lambda: list(directions)}
        for name in names:
            distribution = self.readers[name]()
            functions[name] = lambda d=distribution: [d(cos, sin2, alpha)]
        return {"read": functions}

    def directions(self, lanes: int) -> tuple:
        """Return ``(cos θ_h, sin² θ_h, α)`` of ``lanes`` reads, evaluated."""
        samples = draw(dr.rng(seed=dr.opaque(self.types.UInt64, 7)), self.types, lanes)
        dr.make_opaque(*samples)
        return samples

    def conductors(self) -> list[Case]:
        """Register ``neural_ggx`` with its shipped tables and ``roughconductor``; return a case per roughness."""
        plugins = {"roughconductor": {"type": "roughconductor", "distribution": "ggx"}}
        self.candidates.append(Candidate("roughconductor", "Mitsuba", is_truth=True))
        for storage in STORAGES:
            name = "neural_ggx" + ("" if storage == "float32" else f", {storage}")
            plugins[name] = {"type": "neural_ggx", "storage": storage}
            model = TASK.open(self.types.TensorXf, storage=storage)
            self.candidates.append(Candidate(name, "indirection", storage, model.nbytes, model.measure))
            self.ratios.append((name, "roughconductor"))
        return [
            Case(
                f"conductor, {roughness} roughness",
                lambda lanes, r=roughness: _conductor_queries(plugins, r, lanes),
                details={"material": "Cu", "alpha": 0.2, "roughness": roughness},
                in_picture=False,
            )
            for roughness in (("constant",) if self.quick else ("constant", "textured"))
        ]


def _conductor_queries(plugins: dict, roughness: str, lanes: int) -> dict:
    def load(plugin: dict):
        alpha = noise_texture([0.2], np.random.default_rng(1)) if roughness == "textured" else 0.2
        return mi.load_dict({**plugin, "material": "Cu", "alpha": alpha})

    bsdfs = {name: load(plugin) for name, plugin in plugins.items()}
    return bsdf_queries(bsdfs, directions(lanes), roughness == "textured")


@dataclass(frozen=True)
class EqualQuality:
    """The smallest member of a family as good as a reference, else its best member.

    ``ratios`` are flops, bytes read, bytes stored and time, relative to the reference; ``paper`` has the paper's first
    three.
    """

    family: str
    name: str
    psnr_db: float
    ratios: tuple[float, float, float, float]
    paper: tuple[float, float, float] | None
    converged: bool
    reaches: bool


def _psnr(result: dict, name: str) -> float:
    return result["candidates"][name]["errors"]["psnr_db"]


def equal_quality(result: dict, reference: str) -> list[EqualQuality]:
    """Return a member of each family beside the candidate ``reference``, for the inputs of the paper."""
    timings, candidates = result["cases"][PLAIN]["queries"]["read"], result["candidates"]
    goal, operations = _psnr(result, reference), timings[reference]["operations"]
    rows = []
    for family, paper in {**PAPER, "hash grid + network": None}.items():
        members = [
            name for name in timings
            if candidates[name]["representation"] == family and candidates[name]["setting"] not in STORAGES[1:]
            and "raw" not in name and candidates[name]["setting"] != "tensors"
        ]  # fmt: skip
        if not members:
            continue
        good = [name for name in members if _psnr(result, name) >= goal - EQUAL_DB]
        name = min(good or members, key=lambda n: candidates[n]["bytes"] if good else -_psnr(result, n))
        timing = timings[name]
        ratios = (
            timing["operations"]["flops"] / operations["flops"],
            timing["operations"]["bytes_gathered"] / operations["bytes_gathered"],
            candidates[name]["bytes"] / candidates[reference]["bytes"], timing["time"] / timings[reference]["time"],
        )  # fmt: skip
        converged = bool(candidates[name]["converged"])
        rows.append(EqualQuality(family, name, _psnr(result, name), ratios, paper, converged, bool(good)))
    return rows
