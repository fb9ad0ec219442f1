"""Limits of the time of whole commands, and progress where stderr is no terminal; by a clock of their own."""

import io

import drjit as dr
import drjit.llvm.ad as types
import numpy as np
import pytest

from mi_diffind.core import progress
from mi_diffind.core.errors import UsageError
from mi_diffind.core.progress import Deadline
from mi_diffind.fitting import loop
from mi_diffind.fitting.loop import FitSettings, Problem, fit
from mi_diffind.fitting.task import FitRequest, tasks
from mi_diffind.maps.model import requested_bytes
from mi_diffind.maps.source import from_arrays
from mi_diffind.scenes.capture import CaptureSettings


class Clock:
    """A clock that stands still unless the work of a test takes time."""

    now = 100.0

    def take(self, seconds):
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(loop.time, "perf_counter", lambda: clock.now)
    monkeypatch.setattr("tqdm.std.time", lambda: clock.now)
    monkeypatch.setattr("mi_diffind.core.compat.compile_seconds", lambda history: 0.0)
    return clock


class Slow(Problem):
    """One number; a step and a measurement take the given seconds."""

    def __init__(self, clock, step, measurement):
        self.clock, self.step, self.measurement = clock, step, measurement
        self.net = {"x": types.TensorXf([1.0])}

    def loss(self, net, rng, size):
        self.clock.take(self.step)
        return dr.square(net["x"].array - 0.5)

    def measure(self, net):
        self.clock.take(self.measurement)
        return {"psnr_db": 1.0}


def settings(steps=1000):
    return FitSettings(steps=steps, batch=1, measure_every=max(1, steps // 10))


def request(seconds, **options):
    return FitRequest("", settings(), types, progress=False, deadline=Deadline(seconds), **options)


def test_parts_and_what_follows_share_the_time(clock):
    deadline = Deadline(40)
    clock.take(4)
    assert deadline.rehearse(lambda: clock.take(3) or "figures", times=2) == "figures"
    assert deadline.left() == 40 - 4 - 3 - 6
    stage = deadline.part(1 / 3)
    clock.take(5)
    assert stage.left() == 4 and deadline.left() == 22 and not stage.passed
    clock.take(4)
    assert stage.passed and not deadline.passed and 0 < stage.left() < 0.01
    assert deadline.spent() == 16 and stage.spent() == 9


@pytest.mark.parametrize(("step", "measurement", "ending"), [(0.1, 0.05, 2), (1, 3, 5), (2.5, 0.1, 0.1), (0.5, 8, 4)])
def test_a_limit_bounds_reading_training_and_measuring(clock, step, measurement, ending):
    start, limited = clock.now, request(40)
    clock.take(6)  # reading
    result = limited.train(Slow(clock, step, measurement), finish=lambda: clock.take(ending))
    clock.take(ending)
    assert 34 <= clock.now - start <= 46
    assert result.steps > 3 and result.unfinished == (result.steps < 50)


def test_measurements_that_take_long_are_fewer(clock):
    result = fit(Slow(clock, 0.1, 4), settings(), progress=False, deadline=Deadline(40))
    assert len(result.history) == 3 and result.history[-1]["step"] == result.steps


def test_too_few_steps_are_unfinished(clock):
    limited = request(10)
    clock.take(12)
    result = limited.train(Slow(clock, 2, 1))
    assert result.steps == 1 and result.outcome == "1 step: unfinished, best step 1"
    assert limited.train(Slow(clock, 2, 1), least=7).steps == 7
    assert fit(Slow(clock, 1, 1), settings(20), progress=False, deadline=Deadline(20)).outcome.startswith("best step")


@pytest.fixture
def log(monkeypatch):
    """Lines of a progress bar whose stderr is no terminal."""
    log = io.StringIO()
    monkeypatch.setattr(progress, "in_terminal", lambda: False)
    monkeypatch.setattr(progress, "sys", type("sys", (), {"stderr": log}))
    return log


def test_lines_of_a_training_in_a_log(clock, log):
    fit(Slow(clock, 0.5, 0), FitSettings(steps=100, batch=1, measure_every=20), title="a curve")
    lines = log.getvalue().splitlines()
    assert "\r" not in log.getvalue()
    assert lines[1].startswith("a curve: step 40 of 100, 00:30 left, loss=") and "psnr_db=1.00" in lines[1]
    assert [line.split()[3] for line in lines[:5]] == ["20", "40", "60", "80", "100"]


def test_lines_of_a_limited_training_in_a_log(clock, log):
    fit(Slow(clock, 0.5, 0), settings(), title="timed", deadline=Deadline(40))
    lines = log.getvalue().splitlines()
    assert 3 <= len(lines) <= 5 and all(line.startswith("timed: step ") and " left" in line for line in lines)


@pytest.mark.parametrize("shown", [True, False])
def test_short_and_quiet_jobs_write_no_line(clock, log, shown):
    with progress.progress_bar("render", 10, progress=shown) as bar:
        for _ in range(10):
            clock.take(0.5 if shown else 50)
            bar.update()
    assert log.getvalue() == ""


#: What asks for too much of a machine of 16 GiB, and the sentence.
TOO_MUCH = [
    (lambda: started("sdf", bytes=100 * 2**30), "--bytes: found 107,374,182,400 bytes, a table file holds"),
    (lambda: started("sdf", bytes=2**29), "--bytes: found 536,870,912, which takes about 32 GiB"),
    (lambda: started("field", resolution=100_000), "--resolution: found 100,000, which takes about 22,351,742"),
    (lambda: started("field", bytes=100 * 2**30), "--bytes: found 107,374,182,400 bytes"),
    (lambda: requested_bytes({"compression": None, "bpp": None, "bytes": 100 * 2**30}, IMAGE),
     "--bytes: found 107,374,182,400 bytes, a table file holds at most 1,073,741,824"),
    (lambda: CaptureSettings(resolution=100_000), "resolution: found 100,000, which takes about"),
    (lambda: CaptureSettings(views=10**9), "views: found 1,000,000,"),
]  # fmt: skip
IMAGE = from_arrays({"image": np.zeros((4, 4, 3), np.float32)})


def started(task, **options):
    chosen = tasks()[task]
    options = {argument.name: argument.default for argument in chosen.arguments} | {"source": "x"} | options
    chosen.check(FitRequest(next(iter(chosen.presets)), settings(), types, options=options))


@pytest.mark.parametrize(("action", "sentence"), TOO_MUCH)
def test_what_takes_too_much_is_refused(action, sentence, monkeypatch):
    monkeypatch.setattr("mi_diffind.core.units.memory", lambda: 2**34)
    with pytest.raises((UsageError, ValueError)) as error:
        action()
    assert str(error.value).startswith(sentence)
