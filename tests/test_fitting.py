"""The training loop, on problems of a few entries: repeatable, resumable, interruptible, and hard to derail."""

import contextlib
import math
import os
import signal
import threading

import drjit as dr
import numpy as np
import pytest
from drjit import nn
from drjit.opt import Adam

from mi_diffind import DifferentiableArray, DiffindError, Indirection
from mi_diffind.core.files import OutputError
from mi_diffind.core.runtime import array_module
from mi_diffind.fitting import loop
from mi_diffind.fitting.loop import FitResult, FitSettings, FittingError, Problem, fit
from mi_diffind.fitting.task import LOSSES, SCHEDULES


class Curve(Problem):
    """Fit ``0.5 + 0.3 sin(6x)`` by an indirection; ``at`` maps numbers of calls to something to do in that batch."""

    def __init__(self, ad, at=None):
        self.ad, self.at, self.calls = ad, at or {}, 0
        primary = DifferentiableArray(16, 1, "ramp", fold=True)
        self.net = Indirection(primary, DifferentiableArray(8, 1)).alloc(ad.TensorXf)

    def target(self, x):
        return 0.5 + 0.3 * dr.sin(6 * x)

    def batch(self, rng, size):
        self.calls += 1
        x = rng.random(self.ad.Float, size)
        y = self.target(x)
        action = self.at.get(self.calls)
        return [x], {"y": [y if action is None else action(y)]}

    def predict(self, net, inputs):
        return {"y": net(inputs)}

    def measure(self, net):
        x = dr.linspace(self.ad.Float, 0, 1, 500)
        error = dr.mean(dr.square(self.predict(net, [x])["y"][0] - self.target(x)))
        return {"psnr_db": float(-10 * math.log10(error[0]))}


class Steps(Curve):
    """A problem that fits the curve of :class:`Curve` by a table of 64 numbers that is written in place."""

    sparse = True

    def __init__(self, ad, at=None):
        super().__init__(ad, at)
        self.net = {"steps": dr.full(ad.TensorXf, 0.5, (64,))}

    def predict(self, net, inputs):
        place = self.ad.UInt32(inputs[0] * 64)
        return {"y": [dr.gather(self.ad.Float, net["steps"].array, dr.minimum(place, 63))]}


def settings(**changes):
    return FitSettings(**{"steps": 60, "batch": 512, "lr": 1e-2, "measure_every": 20, "check_every": 5, **changes})


def contents(problem):
    return {key: problem.net[key].numpy().tobytes() for key in problem.net}


def run(problem, *args, **kwargs):
    messages = []
    result = fit(problem, *args, progress=False, log=messages.append, **kwargs)
    return result, messages


def nan(y):
    return y * math.nan


def interrupt(y):
    signal.raise_signal(signal.SIGINT)  # in this thread: two that arrive in others may become one
    return y


@pytest.mark.parametrize("loss", LOSSES)
def test_converges(ad, loss):
    problem = Curve(ad)
    before = problem.measure(problem.net)["psnr_db"]
    result, messages = run(problem, settings(steps=300, loss=loss, measure_every=50))
    assert before < 15 and result.measured["psnr_db"] > 35
    assert problem.measure(problem.net)["psnr_db"] == result.measured["psnr_db"]
    assert (result.steps, result.interrupted, result.restarts, messages) == (300, False, 0, [])
    assert [entry["step"] for entry in result.history] == [50, 100, 150, 200, 250, 300]
    assert result.history[-1]["loss"] < 0.1 * 0.2 and result.seconds > 0


def test_global_state_is_restored(ad):
    """Threads and the limit of expanded sums, after each end of a training."""

    def state():
        return dr.thread_count(), dr.expand_threshold()

    before, seen = state(), []
    for deterministic in (True, False):
        look = {3: lambda y: seen.append(state()) or y}
        run(Curve(ad, look), settings(steps=5, deterministic=deterministic))
        assert state() == before
    run(Curve(ad, {3: interrupt}), settings(steps=5))
    assert state() == before
    with pytest.raises(ZeroDivisionError):
        run(Curve(ad, {3: lambda y: 1 / 0}), settings(steps=5))
    assert state() == before
    assert [threads for threads, _ in seen] == [1, before[0]] and min(limit for _, limit in seen) > before[1]


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_resumed_equals_uninterrupted(ad, tmp_path, schedule):
    """Stopped by Ctrl-C between two checkpoints, or by a crash: the continued run is the same, bit by bit."""
    if ad.Float is not array_module("llvm").Float:
        pytest.skip("sums on CUDA are made by atomics, in any order")
    chosen = settings(schedule=schedule, steps=70, lr=0.05)
    whole = Curve(ad)
    expected, _ = run(whole, chosen)

    for kind, action in {"interrupt": interrupt, "crash": lambda y: 1 / 0}.items():
        path = tmp_path / f"{kind}.npz"
        with pytest.raises(ZeroDivisionError) if kind == "crash" else contextlib.nullcontext():
            result, _ = run(Curve(ad, {47: action}), chosen, checkpoint=path)
            assert result.interrupted and result.steps == 47
        continued = Curve(ad)
        result, _ = run(continued, chosen, checkpoint=path, resume=True)
        assert continued.calls == 30  # from step 40
        assert contents(continued) == contents(whole)
        assert (result.step, result.steps, result.restarts) == (expected.step, 70, 0)
        assert [h["loss"] for h in result.history] == [h["loss"] for h in expected.history]
        assert os.listdir(tmp_path).count(path.name) == 1
        finished = Curve(ad)
        assert run(finished, chosen, checkpoint=path, resume=True)[0].step == expected.step and finished.calls == 0
    assert len(os.listdir(tmp_path)) == 2  # nothing temporary


class Falling(Curve):
    """A problem whose measurements fall: the first measured state is the best."""

    def measure(self, net):
        self.states = [*getattr(self, "states", []), contents(self)]
        return {"psnr_db": 90.0 - self.calls, "mae": 1.0}


def test_why_an_earlier_state_is_kept(ad):
    """Ctrl-C at step 59 keeps step 33 with the two numbers that decided it; else there is nothing to explain."""
    result, _ = run(Falling(ad, {59: interrupt}), settings(measure_every=33, steps=200))
    assert (result.step, result.steps, result.interrupted) == (33, 59, True)
    assert result.outcome == "interrupted at step 59, kept step 33, which was better (psnr_db 57.00 against 31.00)"
    result, _ = run(Falling(ad, {33: interrupt}), settings(measure_every=33, steps=200))
    assert result.outcome == "interrupted at step 33, kept step 33"
    result, _ = run(Falling(ad), settings(measure_every=33))
    assert result.outcome == "best step 33"
    result = FitResult({"psnr_db": 1.0}, 20, 40, 0.0, True, 0, [])  # nothing was measured at its end
    assert result.outcome == "interrupted at step 40, kept step 20"


def test_equally_good_states(ad):
    """Within the tolerance of the first number, the later state is kept; the tables are those of the state."""
    for tolerance, expected in ((0.0, 20), (30.0, 40), (100.0, 60)):
        problem = Falling(ad)
        problem.tolerance = tolerance
        assert run(problem, settings())[0].step == expected
        assert contents(problem) == problem.states[expected // 20 - 1]
        assert len({str(state) for state in problem.states}) == 3


def test_second_interrupt_is_a_real_one(ad):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may start jobs with Ctrl-C ignored
    try:
        with pytest.raises(KeyboardInterrupt):
            run(Curve(ad, {7: lambda y: interrupt(interrupt(y))}), settings())
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("kind", [Curve, Steps])
def test_nan_restores_the_last_good_state(ad, kind):
    """NaN targets for three steps: back to a state whose loss was seen, at half the rate, and a sentence about it."""
    problem = kind(ad, dict.fromkeys((33, 34, 35), nan))
    result, messages = run(problem, settings(steps=300, measure_every=50))
    assert result.restarts == 1 and result.steps == 300 and result.measured["psnr_db"] > 35
    assert messages == ["step 35: the loss is nan; restored step 29 with half the learning rate (0.005)"]
    assert all(math.isfinite(h["loss"]) for h in result.history)
    assert problem.calls == 300 + 35 - 29


def test_entries_lost_in_a_step_whose_loss_was_fine(ad, monkeypatch):
    """The loss is that of the state before the step: what the last step did shows in the entries only."""
    original, spoiled = loop._Trainer.take_step, []

    def take_step(self, plateau=1.0):
        loss = original(self, plateau)
        if self.step == 60 and not spoiled:
            spoiled.append(True)
            self.optimizer["cascaded.data"] = self.optimizer["cascaded.data"] * math.nan
        return loss

    monkeypatch.setattr(loop._Trainer, "take_step", take_step)
    problem = Curve(ad)
    result, messages = run(problem, settings())
    assert spoiled and result.restarts == 1 and messages[0].startswith("step 60: ")
    assert all(np.isfinite(problem.net[key].numpy()).all() for key in problem.net)


class Stages(Curve):
    """From step 30 on, what is fitted lies 5 higher, and the problem says so if it is to."""

    def __init__(self, ad, tells, at=None):
        super().__init__(ad, at)
        self.tells, self.high = tells, False

    def begin(self, step, share):
        self.high = step >= 30
        return ("high" if self.high else "low") if self.tells else super().begin(step, share)

    def target(self, x):
        return super().target(x) + (5 if self.high else 0)


def test_losses_of_different_kinds_are_not_compared(ad, tmp_path):
    """A loss that rises since the problem changes is no explosion if it is said to; one within its kind is."""
    result, messages = run(Stages(ad, True), settings())
    assert (result.restarts, result.steps, messages) == (0, 60, [])
    assert result.history[-1]["loss"] > 10 * result.history[0]["loss"]
    with pytest.raises(FittingError, match="diverged 9 times"):
        run(Stages(ad, False), settings())
    for step in (20, 50):  # the first step of a kind is looked at, so that there is something to compare with
        result, messages = run(Stages(ad, True, {step: lambda y: y + 1e3}), settings())
        assert result.restarts == 1 and messages[0].startswith(f"step {step}: "), step
    # What to compare with is in the checkpoint, too: the first step after it (the 41st) explodes
    each, path = settings(check_every=1), tmp_path / "c.npz"
    run(Stages(ad, True, {42: interrupt}), each, checkpoint=path)
    result, messages = run(Stages(ad, True, {1: lambda y: y + 1e3}), each, checkpoint=path, resume=True)
    assert result.restarts == 1 and messages[0].startswith("step 41: ")


def test_diverging_again_and_again_is_an_error(ad, capsys):
    """Each restart is said on stderr, with or without progress; results belong to stdout."""

    class Hopeless(Curve):
        def target(self, x):
            return x * math.nan

    for progress in (True, False):
        with pytest.raises(FittingError, match=r"diverged 9 times .*lower the learning rate, 0\.01") as caught:
            fit(Hopeless(ad), settings(), progress=progress)
        captured = capsys.readouterr()
        assert "\n" not in str(caught.value) and captured.out == ""
        assert [captured.err.count(f"half the learning rate ({0.01 / 2**k:g})") for k in range(1, 9)] == [1] * 8
    with pytest.raises(FittingError, match="diverged 9 times"):
        run(Curve(ad), settings(lr=1e38))


class Far(Curve):
    """A problem of one number whose gradient never changes: each step of Adam is as long as the learning rate says."""

    def __init__(self, ad):
        super().__init__(ad)
        self.net, self.positions = DifferentiableArray(1, 1, value=0.0).alloc(ad.TensorXf), []

    def batch(self, rng, size):
        self.measure(self.net)
        return [self.ad.Float(0.5)], {"y": [self.ad.Float(1000.0)]}

    def measure(self, net):
        self.positions.append(float(net.numpy().ravel()[0]))
        return {"q": 0.0}


def rates(ad, **changes):
    """The learning rate of every step."""
    problem = Far(ad)
    run(problem, settings(batch=1, lr=1e-2, measure_every=10**6, **changes))
    return np.diff(problem.positions)


def test_schedules_of_the_step(ad):
    expected = 1e-2 * 0.5 * (1 + np.cos(np.pi * np.arange(40) / 40))
    np.testing.assert_allclose(rates(ad, schedule="cosine", steps=40), expected, rtol=1e-2, atol=1e-6)
    np.testing.assert_allclose(rates(ad, schedule="constant", steps=40), np.full(40, 1e-2), rtol=1e-3)


def test_plateau_schedule(ad):
    """This loss hardly improves: the rate halves each time a tenth of the steps has passed."""
    found = rates(ad, schedule="plateau", steps=100, check_every=1) / 1e-2
    halvings = np.rint(np.log2(1 / found)).astype(int)
    np.testing.assert_allclose(found, 0.5**halvings, rtol=2e-3)
    assert halvings[0] == 0 and halvings[-1] in (8, 9, 10)
    assert set(np.diff(halvings)) == {0, 1} and np.diff(np.flatnonzero(np.diff(halvings))).tolist() == [10] * 8
    improving = Curve(ad)
    improving.net = DifferentiableArray(16, 1, value=50.0).alloc(ad.TensorXf)
    losses = [h["loss"] for h in run(improving, settings(schedule="plateau", lr=0.1, steps=100))[0].history]
    assert losses[0] - losses[-1] == pytest.approx(0.1 * 80, rel=0.05)  # 80 steps at the full rate


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_no_compilation_after_the_first_steps(ad, schedule):
    """A step that changes a literal would compile a new kernel each time, which the cache on disk could hide."""
    seen, growth = set(), []

    class Counting(Curve):
        def batch(self, rng, size):
            seen.update(k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT)
            growth.append(len(seen))
            return super().batch(rng, size)

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        run(Counting(ad, {35: nan}), settings(steps=80, schedule=schedule))
    assert growth[5] >= 1
    # Measurements (step 20) and the restart (step 35) have kernels of their own, later steps have none.
    assert growth[-1] == growth[44] and growth[19] == growth[11] and growth[-1] <= growth[11] + 6
    assert len(growth) > 80


class Several(Curve):
    """Two indirections and an array, of which one is read by two targets."""

    def __init__(self, ad):
        super().__init__(ad)
        first = Indirection(DifferentiableArray(16, 2, "ramp", fold=True), DifferentiableArray((8, 8), 1, fold=True))
        second = Indirection(DifferentiableArray(8, 1, "ramp", fold=True), DifferentiableArray(8, 3))
        parts = (first, second, DifferentiableArray(9, 1, fold=True))
        self.net = nn.Sequential(*(part.alloc(ad.TensorXf) for part in parts))

    def batch(self, rng, size):
        x = rng.random(self.ad.Float, size)
        return [x], {"y": [self.target(x)] * 4, "z": [dr.square(x)]}

    def predict(self, net, inputs):
        first, second, third = net.layers
        return {"y": first(inputs) + second(inputs), "z": third(inputs)}

    def measure(self, net):
        return {"q": 1.0}


@pytest.mark.parametrize("problem", [Curve, Several])
def test_a_step_is_one_kernel(ad, problem):
    """Reads, losses and the sums of all gradients: what else there is has the sizes of the arrays."""
    trainer = loop._Trainer(problem(ad), settings(batch=1000))
    trainer.take_step()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for _ in range(2):
            dr.eval()
            dr.kernel_history_clear()
            dr.eval(trainer.take_step())
            kernels = [k["size"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
            assert kernels.count(1000) == 1 and max(k for k in kernels if k != 1000) <= 8 * 8


class Linear(Several):
    """Two targets of one array of two rows; the first has a weight, and channels that come twice."""

    weights = {"y": 3.0}  # noqa: RUF012

    def __init__(self, ad):
        super().__init__(ad)
        self.net = DifferentiableArray(2, 3, np.array([[0.2, 0.9, 0.4], [0.7, 0.1, 0.3]])).alloc(ad.TensorXf)

    def predict(self, net, inputs):
        a, b, c = net(inputs)
        return {"y": [a, b, a, b], "z": [c]}


def test_the_loss_and_its_gradient(ad):
    """A step of gradient descent on both targets, in NumPy; weights and numbers of channels count."""
    problem = Linear(ad)
    problem.settings = settings(batch=1000, loss="mse")
    trainer = loop._Trainer(problem, problem.settings)
    entries = problem.net.numpy().astype(np.float64)
    x = np.array(problem.batch(dr.rng(seed=dr.opaque(ad.UInt64, 0)), 1000)[0][0]).astype(np.float64)
    weights = np.stack([1 - x, x])
    errors = np.einsum("is,ic->cs", weights, entries) - np.stack([*[0.5 + 0.3 * np.sin(6 * x)] * 2, x**2])
    scale = np.array([[3 / 2], [3 / 2], [1]])
    gradient = np.einsum("cs,is->ic", 2 * scale * errors, weights) / 1000
    assert float(trainer.take_step()[0]) == pytest.approx(float((scale * errors**2).sum() / 1000), rel=1e-4)
    _, _, _, (_, moment, _, _) = trainer.optimizer.state["data"]
    found = np.array(moment).reshape(2, 4)[:, :3] / 0.1  # of Adam's first step: (1 - 0.9) times the gradient
    np.testing.assert_allclose(found, gradient, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"steps": 0}, "steps: found 0"), ({"batch": 0}, "batch: found 0"), ({"batch": -5}, "batch: found -5"),
        ({"lr": 0.0}, "lr: found 0"), ({"lr": -1.0}, "lr: found -1"), ({"lr": math.nan}, "lr: found nan"),
        ({"lr": math.inf}, "lr: found inf"), ({"schedule": "step"}, '"step", allowed are'),
        ({"loss": "huber"}, '"huber", allowed are'), ({"seed": -1}, "seed: found -1"),
        ({"measure_every": 0}, "measure_every"), ({"check_every": 0}, "check_every"),
        ({"steps": True}, "steps: found True, a whole number"), ({"batch": 2.0}, "batch: found 2.0, a whole number"),
    ],
)  # fmt: skip
def test_bad_settings(change, match):
    with pytest.raises(FittingError, match=match) as caught:
        settings(**change)
    assert "\n" not in str(caught.value) and isinstance(caught.value, DiffindError)


@pytest.fixture
def checkpoint(tmp_path):
    path = tmp_path / "c.npz"
    run(Curve(array_module("llvm")), settings(steps=20), checkpoint=path)
    return path


def not_resumable(path, match, problem=None, **changes):
    problem = problem or Curve(array_module("llvm"))
    start = contents(problem)
    with pytest.raises((FittingError, OutputError), match=match) as caught:
        run(problem, settings(**{"steps": 20, **changes}), checkpoint=path, resume=True)
    message = str(caught.value)
    assert str(path) in message and "\n" not in message
    assert contents(problem) == start


def test_damaged_checkpoint(checkpoint):
    content = checkpoint.read_bytes()
    for damaged in (b"", b"hello", content[:100], content[:-30], content[:500] + content[520:]):
        checkpoint.write_bytes(damaged)
        not_resumable(checkpoint, "is damaged or of another task")
    folder = checkpoint.parent / "folder.npz"
    folder.mkdir()
    not_resumable(folder, "folder")


def test_checkpoint_of_another_problem(ad, tmp_path):
    """The problem's identity is compared beside the settings; tuples are lists in a file."""

    class Named(Curve):
        def __init__(self, ad, **identity):
            super().__init__(ad)
            self.identity = identity

    path = tmp_path / "c.npz"
    run(Named(ad, samples="a", sizes=(1, 2)), settings(steps=20), checkpoint=path)
    run(Named(ad, samples="a", sizes=(1, 2)), settings(steps=20), checkpoint=path, resume=True)
    not_resumable(path, r"other settings \(samples\)", Named(ad, samples="b", sizes=(1, 2)))
    not_resumable(path, r"other settings \(sizes\)", Named(ad, samples="a", sizes=(1, 3)))
    not_resumable(path, r"other settings \(samples, sizes\)", Named(ad))
    source = Named(ad, source="x")
    run(source, settings(steps=20), checkpoint=path)
    not_resumable(path, "is of another source", Named(ad, source="y"))


def test_checkpoint_of_another_run(checkpoint):
    not_resumable(checkpoint, r"other settings \(lr\)", lr=0.5)
    not_resumable(checkpoint, r"other settings \(batch, seed\)", batch=7, seed=1)
    other = Curve(array_module("llvm"))
    larger = Indirection(DifferentiableArray(32, 1, "ramp", fold=True), DifferentiableArray(8, 1))
    for net, match in (
        (larger, r"other table sizes \(\"primary\.0\.data\"\)"),
        (DifferentiableArray(16, 1), "damaged or of another task"),
    ):
        other.net = net.alloc(other.ad.TensorXf)
        not_resumable(checkpoint, match, other)


def test_works_in_another_thread(ad):
    """Signals belong to the main thread; training elsewhere does without."""
    results = []
    thread = threading.Thread(target=lambda: results.append(run(Curve(ad), settings(steps=10))))
    thread.start()
    thread.join()
    assert results[0][0].steps == 10


@pytest.mark.parametrize("harmless, restarts", [(1e-6, 1), (10.0, 0)])
def test_losses_that_do_no_harm_are_no_explosions(ad, harmless, restarts):
    """A training that starts next to its optimum moves away from it at first, by a loss that its problem knows."""
    problem = Curve(ad, {35: lambda y: y + 2})
    problem.harmless = harmless
    result, messages = run(problem, settings())
    assert (result.restarts, len(messages), result.steps) == (restarts, restarts, 60)


def test_the_guard_survives_resuming(ad, tmp_path):
    """The halved rate and the number of restarts are part of the checkpoint."""
    path = tmp_path / "c.npz"
    run(Curve(ad, {35: nan, 57: interrupt}), settings(steps=80), checkpoint=path)
    result, messages = run(Curve(ad, {15: nan}), settings(steps=80), checkpoint=path, resume=True)
    assert result.restarts == 2 and "(0.0025)" in messages[0]


def sparse_steps(ad, optimizer, shape, steps=12):
    """Return a tensor of random numbers after steps that read few of its rows, and how often each row was read."""
    rng, width = np.random.default_rng(3), shape[1] if len(shape) == 2 else 1
    optimizer["x"] = ad.TensorXf(rng.normal(size=shape).astype(np.float32))
    reads = np.zeros(shape[0], int)
    for _ in range(steps):
        rows = rng.choice(shape[0], 5, replace=False)
        reads[rows] += 1
        entries = (rows[:, None] * width + np.arange(width)).reshape(-1)
        slopes = ad.Float(rng.normal(size=entries.size).astype(np.float32))
        read = dr.gather(ad.Float, optimizer["x"].array, ad.UInt32(entries.astype(np.uint32)))
        dr.backward(dr.sum(dr.square(read) * slopes))
        del read
        optimizer.step()
    return optimizer["x"].numpy(), reads


@pytest.mark.parametrize("shape", [(60,), (40, 12), (40, 3)])
def test_steps_of_the_sparse_optimiser(ad, shape):
    """Single entries and columns in packets move as in Adam; a rate of 0.1 moves entries by more than rounding."""
    values, reads = sparse_steps(ad, loop.SparseAdam(lr=0.1, beta_2=0.99), shape)
    expected, _ = sparse_steps(ad, Adam(lr=0.1, beta_2=0.99, mask_updates=True), shape)
    np.testing.assert_allclose(values, expected, rtol=0, atol=1e-5)
    begun, _ = sparse_steps(ad, loop.SparseAdam(lr=0.1), shape, steps=0)
    moved = np.abs(values - begun).reshape(shape[0], -1).max(axis=1)
    assert (moved[reads == 0] == 0).all() and (moved[reads > 0] > 1e-3).all() and (reads == 0).any()


def test_columns_move_together(ad):
    """A row of four of which one column has a gradient: the others continue as their moments say."""
    optimizer = loop.SparseAdam(lr=0.1)
    optimizer["x"] = ad.TensorXf(np.zeros((2, 4), np.float32))
    for columns in ((1, 1, 1, 1), (1, 0, 0, 0)):
        slopes = ad.Float(np.float32([*columns, 0, 0, 0, 0]))
        dr.backward(dr.sum(optimizer["x"].array * slopes))
        optimizer.step()
    values = optimizer["x"].numpy()
    assert (values[1] == 0).all() and values[0, 0] == pytest.approx(-0.2, abs=1e-3)
    assert (values[0, 1:] < -0.11).all() and (values[0, 1:] > -0.19).all()


def test_rows_without_a_gradient_in_the_column_of_their_own(ad):
    """A tensor of columns beside one without: rows that the latter does not read are left alone."""
    optimizer = loop.SparseAdam(lr=0.1)
    optimizer["density"], optimizer["colour"] = (ad.TensorXf(np.zeros(s, np.float32)) for s in ((3,), (3, 8)))
    read = ad.Float(np.float32([1, 0, 1])), ad.Float(np.float32([1] * 8 + [1] * 8 + [1] * 4 + [0] * 4))
    total = dr.sum(optimizer["density"].array * read[0]) + dr.sum(optimizer["colour"].array * read[1])
    dr.backward(total)
    del total
    optimizer.step()
    np.testing.assert_allclose(optimizer["density"].numpy(), [-0.1, 0, -0.1], atol=1e-5)
    expected = [[-0.1] * 8, [0] * 8, [-0.1] * 4 + [0] * 4]
    np.testing.assert_allclose(optimizer["colour"].numpy(), expected, atol=1e-5)
