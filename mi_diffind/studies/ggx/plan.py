"""
The GGX distribution of normals: indirection at several sizes and in each storage form, single tables, networks, and
the formula; and the rough conductor that is made of it.

Everything is compared twice, on two kinds of *inputs*: plain ones, (cos θ_h, α) as the paper has them, and the
logarithmic ones of ``neural_ggx`` (:class:`.ggx.Encoding`). All learn the same output, the bounded root of D, with the
same error measure and samples, in the two kinds of input alike; what is marked *raw* learns D itself, as the paper's
recipe does. All of them are trained until that has converged (:mod:`~mi_diffind.measure.training`).
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ... import runtime
from ...fitting import FitSettings
from ...indirection import DifferentiableArray
from ...lookup import STORAGES
from ...measure.bsdf import QUERIES, bsdf_queries, directions, noise_texture
from ...measure.operations import FLOPS, Operations, count_query
from ...measure.store import fingerprint
from ...measure.study import FLOOR, Candidate, Case, Plan
from ...measure.training import ConvergenceTraining
from ...tasks.ggx import TASK
from ...tasks.ggx.model import INPUTS, Encoding, LearnedGGX, ggx, indirection
from ...tasks.ggx.training import GGXProblem, draw, measure
from ..baselines.networks import Network
from .conclusions import (
    CASCADED,
    ENTRIES,
    LOGARITHMIC,
    PAPER,
    PAPER_BYTES,
    PAPER_BYTES_READ,
    PAPER_FLOPS,
    PLAIN,
    PRIMARY,
    conclusions,
)

#: Sides of the primary arrays, with cascaded ones half as long (ρ = 2).
SIZES = (8, 16, 32, 64)

#: Sizes of single tables, as multiples of ``ENTRIES``; the paper needs 512 for equal quality.
MULTIPLES = (1, 4, 16, 64, 512)

#: Width and hidden layers of the networks. The last has about as many parameters as the paper's.
NETWORKS = ((8, 2), (16, 2), (32, 3))

#: How each is trained, found by trying: indirection gains from a large rate where its inputs are plain, networks from
#: many small steps. ``steps`` are those of the first run, ``longest`` those of the longest.
SETTINGS = {
    "indirection, plain": {"lr": 5e-2, "batch": 16384, "steps": 2000, "longest": 16000},
    "indirection, logarithmic": {"lr": 1e-2, "batch": 16384, "steps": 2000, "longest": 16000},
    "single table": {"lr": 1e-2, "batch": 65536, "steps": 1000, "longest": 8000},
    "raw": {"lr": 1e-3, "batch": 65536, "steps": 2000, "longest": 8000},
    "network": {"lr": 1e-2, "batch": 1024, "steps": 8000, "longest": 32000},
    "wide network": {"lr": 5e-3, "batch": 1024, "steps": 8000, "longest": 32000},
}

#: Those of the first run of a quick study, the longest takes twice as many.
QUICK_STEPS = 80

GRID = {
    "n_levels": 4, "n_features_per_level": 2, "hashmap_size": 2**12, "base_resolution": 4, "per_level_scale": 2,
    "align_corners": True, "init_scale": 1e-2,
}  # fmt: skip

#: Storage form → its mark in labels, bytes of an entry.
_STORED = {"float32": ("", 4), "float16": (" f16", 2), "uint8": (" u8", 1)}


def plan(quick: bool = False) -> Plan:
    """What is measured in the variant that is set; ``quick``: fewer candidates, trained for seconds."""
    types = runtime.array_module(mi.variant())
    made = _Made(types, quick)
    for inputs in INPUTS[::-1]:
        _add_tables(made, inputs)
        _add_networks(made, inputs)
    _add_formula(made)
    cases = [
        made.case(PLAIN, "plain", {"inputs": "cos θ_h and α, both vary", "output": "root, or raw where marked"}),
        made.case(LOGARITHMIC, "logarithmic", {"inputs": "logarithms of sin²θ_h and α, both vary", "output": "root"}),
        *_conductors(made),
    ]
    package = Path(__file__).resolve().parents[2]
    trained_by = [package / f"{name}.py" for name in ("lookup", "indirection", "fitting")]
    trained_by += [*(package / "tasks").glob("*.py"), *(package / "tasks" / "ggx").glob("*.py")]
    trained_by += [package / "studies" / "baselines" / "networks.py"]
    reference = made.name(f"{PRIMARY}→{CASCADED}", "plain")
    return Plan(
        study="ggx",
        title="GGX distribution of normals: accuracy against time and bytes",
        variant=mi.variant(),
        candidates=made.candidates,
        cases=cases,
        queries=("read",),
        accuracy="psnr_db",
        accuracy_label="PSNR of D clipped to [0, 1], dB",
        ratios=made.ratios,
        details={
            "flops": FLOPS,
            "paper": {"flops": PAPER_FLOPS, "bytes_read": PAPER_BYTES_READ, "bytes": PAPER_BYTES, "ratios": PAPER},
            "errors": "PSNR in dB and mean absolute error of D clipped to [0, 1], over cosine-weighted normals and "
            "exponential-like roughness; and by bands of roughness: the largest relative error at the normal, and the "
            "99th percentile of it where D is at least a tenth of the peak",
        },
        jobs=made.trainings,
        jobs_fingerprint=fingerprint(trained_by),
        bytes_by_case=True,
        conclusions=lambda result: conclusions(result, reference),
    )


class _Made:
    """The plan while it is made: candidates, their trainings, and how each is read."""

    def __init__(self, types, quick: bool):
        self.types, self.quick = types, quick
        self.candidates: list[Candidate] = []
        self.trainings: list[ConvergenceTraining] = []
        self.ratios: list[tuple[str, str]] = []
        self.readers: dict[str, Callable[[], Callable]] = {}
        self.inputs: dict[str, str] = {}

    @staticmethod
    def name(label: str, inputs: str) -> str:
        return label if inputs == "plain" else f"{label}, log"

    def train(self, label: str, net: Callable, how: str, encoding: Encoding) -> ConvergenceTraining:
        """Register a training; ``how`` is a key of :data:`SETTINGS`."""
        options = dict(SETTINGS[how])
        longest = options.pop("longest")
        settings = FitSettings(seed=1, schedule="cosine", deterministic=False, **options)
        if self.quick:
            settings, longest = dataclasses.replace(settings, steps=QUICK_STEPS), 2 * QUICK_STEPS
        samples = "tables" if encoding.inputs == "logarithmic" else "paper"

        def problem():
            return GGXProblem(net().alloc(self.types.TensorXf, 2, dr.rng(seed=1)), self.types, samples, encoding)

        name = self.name(label, encoding.inputs)
        self.trainings.append(ConvergenceTraining(name, problem, settings, longest, 4 if self.quick else 20))
        return self.trainings[-1]

    def add(self, label, representation, setting, size, training, form, encoding, operations=None, note=""):
        """Register a candidate; ``form(net)`` turns the trained module into what is read."""
        name = self.name(label, encoding.inputs)
        reader = functools.cache(lambda: LearnedGGX(form(training.net), encoding, tail=False))
        self.candidates.append(
            Candidate(
                name, representation, setting, size,
                errors=lambda samples: measure(reader(), self.types, samples),
                note=note, label=label, job=training.name, operations=operations, in_passes=False,
            )
        )  # fmt: skip
        self.readers[name], self.inputs[name] = reader, encoding.inputs

    def case(self, name: str, inputs: str, details: dict) -> Case:
        names = [n for n in self.readers if self.inputs[n] in (inputs, "any")]
        return Case(name, lambda lanes: self._queries(names, lanes), None, details, tuple(names))

    def _queries(self, names: list[str], lanes: int) -> dict:
        cos, sin2, alpha = directions = self.directions(lanes)
        found = {FLOOR: lambda: list(directions)}
        for name in names:
            distribution = self.readers[name]()
            found[name] = lambda d=distribution: [d(cos, sin2, alpha)]
        return {"read": found}

    def directions(self, lanes: int) -> tuple:
        """Inputs of ``lanes`` reads, evaluated."""
        found = draw(dr.rng(seed=dr.opaque(self.types.UInt64, 7)), self.types, lanes)
        dr.make_opaque(*found)
        return found


# -- candidates -------------------------------------------------------------------------------------------------------


def _add_tables(made: _Made, inputs: str) -> None:
    """Indirection at several sizes, single tables at multiples of the bytes; with plain inputs also the raw output."""
    plain = inputs == "plain"
    sizes, multiples = (SIZES, MULTIPLES) if plain else ((PRIMARY, 2 * PRIMARY), (1, 4))
    if made.quick:
        sizes, multiples = sizes[:2] if plain else sizes[:1], multiples[:2] if plain else multiples[:1]
    encoding, own = Encoding(inputs, "root"), made.name(f"{PRIMARY}→{CASCADED}", inputs)
    for n in sizes:
        _add_table(made, n, f"indirection, {inputs}", encoding, STORAGES)
    made.ratios += [(made.name(f"{PRIMARY}→{CASCADED}{_STORED[s][0]}", inputs), own) for s in STORAGES[1:]]
    for multiple in multiples:
        forms = STORAGES if multiple == 1 else STORAGES[:1]
        _add_table(made, math.isqrt(ENTRIES * multiple), "single table", encoding, forms)
    made.ratios.append((made.name(f"{math.isqrt(ENTRIES)}²", inputs), own))
    if plain and not made.quick:
        for n, representation in ((PRIMARY, "indirection"), (math.isqrt(ENTRIES), "single table")):
            _add_table(made, n, "raw", Encoding("plain", "raw"), STORAGES[:1], representation)


def _add_table(made: _Made, n: int, how: str, encoding: Encoding, forms, representation: str = "") -> None:
    """A training, and a candidate in each of ``forms``: indirection of a primary of side ``n``, or a table of it."""
    representation = representation or how.split(",")[0]
    if representation == "indirection":
        label, entries, net = f"{n}→{n // 2}", 2 * n**2 + (n // 2) ** 2, lambda: indirection(n, n // 2)
    else:
        label, entries, net = f"{n}²", n**2, lambda: DifferentiableArray((n, n), 1, "constant", 0.5)
    note = "learns D as it is, at the paper's learning rate" if how == "raw" else ""
    label += " raw" * (how == "raw")
    training = made.train(label, net, how, encoding)
    for storage in forms:
        mark, size = _STORED[storage]
        form = lambda net, s=storage: net.to(s)  # noqa: E731
        made.add(label + mark, representation, storage, size * entries, training, form, encoding, note=note)


def _add_networks(made: _Made, inputs: str) -> None:
    """Networks as tensors and as cooperative vectors, after a hash grid, and in front of a table."""
    plain = inputs == "plain"
    kinds = [(f"MLP {w}x{n}", "network", Network(2, w, n)) for w, n in (NETWORKS if plain else NETWORKS[1:])]
    if plain:
        kinds.append(("grid + MLP 16", "hash grid + network", Network(2, 16, 1, GRID)))
        kinds.append((f"MLP 8 + {PRIMARY}²", "network + table", Network(2, 8, 2, table=PRIMARY)))
    if made.quick:
        kinds = [kinds[0], *kinds[-2:]] if plain else []
    encoding = Encoding(inputs, "root")
    for label, representation, network in kinds:
        how = "network" if network.width < 32 else "wide network"
        training = made.train(label, lambda n=network: n, how, encoding)
        size = network.alloc(made.types.TensorXf, 2, dr.rng(seed=1)).nbytes
        for form, setting in ((Network.cooperative, "cooperative vectors"), (lambda net: net, "tensors")):
            shown = label if form is Network.cooperative else f"{label} tensor"
            operations = _network_operations(made, training, encoding)
            made.add(shown, representation, setting, size, training, form, encoding, operations)


def _network_operations(made: _Made, training: ConvergenceTraining, encoding: Encoding) -> Callable[[str], Operations]:
    """What a kernel of cooperative vectors shows, and the products by weights that it does not."""

    def counted(query: str) -> Operations:
        read, inputs = LearnedGGX(training.net.cooperative(), encoding), made.directions(64)
        return count_query(lambda: [read(*inputs)]) + training.net.products()

    return counted


def _add_formula(made: _Made) -> None:
    made.candidates.append(Candidate("formula", "formula", is_truth=True, label="formula", in_passes=False))
    made.readers["formula"] = lambda: lambda cos, sin2, alpha: ggx(sin2, alpha)
    made.inputs["formula"] = "any"
    for inputs in INPUTS[::-1]:
        made.ratios.append((made.name(f"{PRIMARY}→{CASCADED}", inputs), "formula"))


# -- the rough conductor ----------------------------------------------------------------------------------------------


def _conductors(made: _Made) -> list[Case]:
    """``neural_ggx`` with the tables that ship, and ``roughconductor``, of constant and of textured roughness."""
    plugins = {"roughconductor": {"type": "roughconductor", "distribution": "ggx"}}
    made.candidates.append(Candidate("roughconductor", "Mitsuba", is_truth=True, in_passes=False))
    for storage in STORAGES:
        name = "neural_ggx" + ("" if storage == "float32" else f", {storage}")
        plugins[name] = {"type": "neural_ggx", "storage": storage}
        model = TASK.open(made.types.TensorXf, storage=storage)
        made.candidates.append(
            Candidate(name, "indirection", storage, model.nbytes, None, model.measure, in_passes=False)
        )
        made.ratios.append((name, "roughconductor"))
    return [
        Case(
            f"conductor, {roughness} roughness",
            lambda lanes, r=roughness: _bsdf_queries(plugins, r, lanes),
            None,
            {"material": "Cu", "alpha": 0.2, "roughness": roughness},
            tuple(plugins),
            QUERIES,
            False,
        )
        for roughness in ("constant", "textured")
    ]


def _bsdf_queries(plugins: dict, roughness: str, lanes: int) -> dict:
    def load(plugin: dict):
        alpha = noise_texture([0.2], np.random.default_rng(1)) if roughness == "textured" else 0.2
        return mi.load_dict({**plugin, "material": "Cu", "alpha": alpha})

    bsdfs = {name: load(plugin) for name, plugin in plugins.items()}
    return bsdf_queries(bsdfs, directions(lanes), roughness == "textured")
