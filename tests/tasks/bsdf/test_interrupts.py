"""Ctrl-C in each phase of a fit, and fits that go on from checkpoints."""

import dataclasses
import signal

import pytest

import mi_diffind
from mi_diffind.arrays.tables import load_table
from mi_diffind.fitting.loop import FittingError
from mi_diffind.tasks.bsdf import TASK, directions, mixture, training

SOURCE = {"type": "roughplastic", "alpha": 0.2}

#: Steps of each of two starts of the proxy, and of the residual; all are measured at half of them.
PROXY, RESIDUAL = 20, 20


@pytest.fixture
def short(monkeypatch, mi_rgb):
    """Trainings of a second."""
    monkeypatch.setattr(training, "START_ALPHAS", (0.1, 0.3, 0.9))
    monkeypatch.setattr(mixture, "ALPHAS", (0.1, 0.3, 0.9))
    monkeypatch.setattr(training, "SAMPLES", 2**13)
    monkeypatch.setattr(training, "VALIDATION", 2**13)
    monkeypatch.setattr(
        training, "PROXY", dataclasses.replace(training.PROXY, steps=PROXY, batch=2**11, measure_every=10)
    )
    monkeypatch.setattr(directions.SphereView.__init__, "__defaults__", (7, 16, 16))


@pytest.fixture
def interrupted(monkeypatch):
    """Send Ctrl-C in one of the steps of all trainings together; 0: never."""
    begin, steps = training.BSDFProblem.begin, {"taken": 0, "last": 0}

    def counted(self, step, share):
        steps["taken"] += 1
        if steps["taken"] == steps["last"]:
            signal.raise_signal(signal.SIGINT)
        return begin(self, step, share)

    monkeypatch.setattr(training.BSDFProblem, "begin", counted)

    def at(step):
        steps.update(taken=0, last=step)
        return steps

    return at


def fitted(source=SOURCE, **options):
    short = {"steps": RESIDUAL, "batch": 2**11, "measure_every": 10, "energy": "raw", "progress": False}
    return mi_diffind.fit("bsdf", source, **short, **options)


def test_fits_go_on(short, interrupted, tmp_path):
    """A file of an interrupted fit holds the best so far; the end is that of an undisturbed one, bit for bit."""
    interrupted(0)
    undisturbed = fitted().save(tmp_path / "undisturbed.npz").read_bytes()
    for last in (35, 55):
        checkpoint, steps = tmp_path / f"state{last}.npz", interrupted(last)
        result = fitted(checkpoint=checkpoint)
        assert result.result.interrupted and steps["taken"] == last, "no phase follows one that was interrupted"
        assert result.result.steps == max(0, last - 2 * PROXY)
        path = result.save(tmp_path / "kept.npz")
        assert TASK.load(path).measured["psnr_db"] > 20 and load_table(path).settings["form"]["terms"]
        steps = interrupted(0)
        again = fitted(checkpoint=checkpoint, resume=True)
        assert steps["taken"] < 2 * PROXY + RESIDUAL - last + 10, "finished phases are not repeated"
        assert again.save(tmp_path / "again.npz").read_bytes() == undisturbed
    with pytest.raises(FittingError, match="is of another source, or the source has changed since"):
        fitted(source={**SOURCE, "alpha": 0.3}, checkpoint=checkpoint, resume=True)
