"""Training to convergence: its length, models that are read again, interruption."""

import math
import os
import signal

import numpy as np
import pytest
from variants import BACKENDS

from mi_diffind.arrays.indirection import DifferentiableArray
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting.loop import FitSettings, Problem
from mi_diffind.measure.training import GAIN, ConvergenceTraining

SETTINGS = FitSettings(steps=10, batch=64, lr=1e-2, schedule="constant", seed=3, deterministic=False)


class Ramp(Problem):
    """Five numbers that are to become 1: Adam moves each by its rate a step, so 100 steps take them from 0 to there.

    Measurements after ``collapse`` batches lose 6 dB.
    """

    def __init__(self, log, target=1.0, interrupt=0, collapse=math.inf):
        self.types = array_module(BACKENDS[0])
        self.net = DifferentiableArray((5,), 1, "constant", 0.0).alloc(self.types.TensorXf)
        self.weights, self.target, self.log, self.interrupt = {}, target, log, interrupt
        self.collapse = collapse
        self.identity = {"target": target}

    def batch(self, rng, size):
        self.log.append("batch")
        if len(self.log) == self.interrupt:
            os.kill(os.getpid(), signal.SIGINT)
        return rng.random(self.types.Float, size), {"y": [self.types.Float(self.target)]}

    def predict(self, net, inputs):
        return {"y": net([inputs])}

    def measure(self, net):
        error = float(np.abs(net.numpy() - self.target).mean())
        return {"psnr_db": -20 * math.log10(max(error, 0.01)) - 6 * (len(self.log) > self.collapse)}


def training(log, **options):
    longest = options.pop("longest", 640)
    return ConvergenceTraining("a ramp", lambda: Ramp(log, **options), SETTINGS, longest)


def test_doubles_until_it_gains_nothing():
    log = []
    ramp = training(log)
    record = ramp.run(progress=False)
    steps = [run["steps"] for run in record["runs"]]
    assert steps == [10 * 2**k for k in range(len(steps))] and sum(steps) == len(log)
    gains = np.diff([run["psnr_db"] for run in record["runs"]])
    assert (gains[:-1] >= GAIN).all() and gains[-1] < GAIN
    assert record["converged"] and record["gain_db"] == pytest.approx(gains[-1])
    assert record["steps"] >= 80 and record["entries"] == 5
    assert np.allclose(ramp.net.numpy(), 1, atol=0.05)


def test_not_converged():
    record = training([], longest=40).run(progress=False)
    assert [run["steps"] for run in record["runs"]] == [10, 20, 40]
    assert not record["converged"] and record["gain_db"] > GAIN
    only = ConvergenceTraining("a ramp", lambda: Ramp([]), SETTINGS, 10).run(progress=False)
    assert only["gain_db"] is None and not only["converged"]


def test_a_collapse_is_no_convergence():
    """Runs of 10 and 20 steps gain; that of 40 loses, so the one of 20 counts."""
    ramp = training([], collapse=30)
    record = ramp.run(progress=False)
    assert [run["steps"] for run in record["runs"]] == [10, 20, 40] and record["gain_db"] < -GAIN
    assert not record["converged"] and record["steps"] == 20 and record["psnr_db"] == record["runs"][1]["psnr_db"]
    assert np.allclose(ramp.net.numpy(), 0.2, atol=0.02)


def test_trained_models_are_read(tmp_path):
    first = training([], longest=20)
    record = first.run(tmp_path, progress=False)
    assert sorted(os.listdir(tmp_path)) == ["a_ramp.json", "a_ramp.npz"]  # no checkpoint stays
    log = []
    again = training(log, longest=20)
    assert again.cached_record(tmp_path) == record and log == []
    assert np.array_equal(again.net.numpy(), first.net.numpy())


def test_models_of_other_settings_are_trained_again(tmp_path):
    training([], longest=40).run(tmp_path, progress=False)
    for options in ({"longest": 20}, {"longest": 40, "target": 0.3}):
        other = training([], **options)
        assert other.cached_record(tmp_path) is None
        other.run(tmp_path, progress=False)
    assert np.allclose(other.net.numpy(), 0.3, atol=0.05)
    (tmp_path / "a_ramp.npz").write_bytes(b"damaged")
    assert training([]).cached_record(tmp_path) is None


def test_interrupted_training_goes_on(tmp_path):
    whole = training([], longest=80).run(progress=False)
    assert training([], longest=80, interrupt=45).run(tmp_path, progress=False) is None
    assert len(list(tmp_path.glob("*.checkpoint"))) >= 1 and not list(tmp_path.glob("*.npz"))
    record = training([], longest=80).run(tmp_path, progress=False)
    assert [r["psnr_db"] for r in record["runs"]] == pytest.approx([r["psnr_db"] for r in whole["runs"]], abs=0.1)
    assert [record[k] for k in ("steps", "converged")] == [whole[k] for k in ("steps", "converged")]
    assert sorted(os.listdir(tmp_path)) == ["a_ramp.json", "a_ramp.npz"]
