"""Contenders: the measurement itself, indirection in each storage form, and a single table of as many entries."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import drjit as dr
import mitsuba as mi

from mi_diffind.arrays.indirection import DifferentiableArray
from mi_diffind.arrays.lookup import STORAGES
from mi_diffind.core.runtime import array_module
from mi_diffind.measure.store import fingerprint
from mi_diffind.measure.study import FLOOR, Candidate, Case, Measure, Plan
from mi_diffind.measure.training import ConvergenceTraining

from . import measurement
from .task import SIZES, TASK
from .training import ProfileProblem, arrays, errors, exact


def plan(source: str, quick: bool) -> Plan:
    """The measurements in the variant that is set."""
    types, truth = array_module(mi.variant()), measurement.read(source)
    settings = dataclasses.replace(TASK.presets["default"], steps=50 if quick else 600)
    entries = sum(SIZES["default"])
    nets = {
        "indirection": lambda: arrays(*SIZES["default"]),
        "single table": lambda: DifferentiableArray(entries, 1, "constant", 0.5),
    }

    def problem(net):
        return lambda: ProfileProblem(net().alloc(types.TensorXf), truth, types)

    jobs = {name: ConvergenceTraining(name, problem(net), settings, settings.steps * 8) for name, net in nets.items()}
    data = exact(truth, types.TensorXf)
    readers, candidates = {"measurement": lambda: data}, []
    candidates.append(Candidate("measurement", "measurement", "float32", data.nbytes, is_truth=True))
    for name in nets:
        for storage in STORAGES:
            full = f"{name}, {storage}"
            readers[full] = lambda name=name, storage=storage: jobs[name].net.to(storage)
            candidates.append(
                Candidate(
                    full, name, storage, entries * {"float32": 4, "float16": 2, "uint8": 1}[storage],
                    errors=lambda samples, read=readers[full]: errors(read(), truth, types),
                    job=name,
                )
            )  # fmt: skip

    def queries(lanes: int) -> dict:
        x = dr.rng(seed=dr.opaque(types.UInt64, 7)).random(types.Float, lanes)
        dr.make_opaque(x)
        nets = {name: read() for name, read in readers.items()}
        return {"read": {FLOOR: lambda: [x], **{name: (lambda net=net: net([x])) for name, net in nets.items()}}}

    return Plan(
        study="profile",
        title="Goniometric profile: accuracy against time and bytes",
        candidates=candidates,
        cases=[Case("random angles", queries)],
        measures=(Measure("PSNR of the intensity relative to its peak, dB", "psnr_db"),),
        ratios=[("indirection, uint8", "indirection, float32"), ("single table, float32", "indirection, float32")],
        details={"source": truth.digest},
        jobs=list(jobs.values()),
        jobs_fingerprint=fingerprint(Path(__file__).resolve().parent.glob("*.py")),
        panels=("bytes",),
    )
