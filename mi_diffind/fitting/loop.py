"""The training loop, one for all tasks: Adam on random batches, with schedules, checkpoints and guards.

A task describes itself as a :class:`Problem`; :func:`fit` does the rest. Everything random is drawn from the seed, the
step and the number of restarts, so that a run is repeatable and an interrupted one continues exactly where it stopped.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import drjit as dr
import numpy as np
from drjit.opt import Adam
from tqdm import tqdm

from ..arrays.indirection import aligned_copy, unfolded
from ..core import compat
from ..core.archives import Archive, ArchiveError, LimitError
from ..core.errors import reason
from ..core.files import irregular, replacing, shown, writable_file
from ..core.progress import Deadline, duration, in_terminal, interruptible, progress_bar
from .task import FitResult, FitSettings, FittingError

#: Columns that are updated together.
PACKET = 4


class SparseAdam(Adam):
    """Adam that updates, and loads, only those entries of a tensor that have a gradient.

    The values are those of ``Adam(mask_updates=True)``, but the entries of a tensor with columns in multiples of
    :data:`PACKET` are updated together if one of them has a gradient. If there is a tensor with as many rows and no
    columns, rows in which that one has no gradient are left alone, too. The time of a step grows with the entries that
    it reads, not with the table. Tables are written in place, so no one else should hold them during :meth:`step`: an
    array that is held is copied.
    """

    def step(self) -> None:
        """Take a step for the gradients of the parameters, which are evaluated first."""
        gradients = {key: value.grad.array for key, (value, *_) in self.state.items()}
        dr.eval(gradients)
        shapes = {key: value.shape for key, (value, *_) in self.state.items()}
        changed_rows = {}  # by the number of rows
        for key in sorted(shapes, key=lambda k: len(shapes[k])):
            shape = shapes[key]
            value, promoted, rate, (t, first, second, largest) = self.state.pop(key)
            tensor, flat = type(value), dr.detach(value).array
            del value
            packets = shape[1] // PACKET if len(shape) == 2 and shape[1] % PACKET == 0 else 0
            gradient = gradients.pop(key)
            changed = _changed_entries(gradient, packets, changed_rows.get(shape[0]))
            if len(shape) == 1:
                changed_rows[shape[0]] = changed
            if dr.width(changed):
                self._update(gradient, flat, first, second, packets, changed, rate if rate is not None else self.lr, t)
            value = tensor(flat, shape)
            dr.enable_grad(value)
            self.state[key] = value, promoted, rate, (t + 1, first, second, largest)

    def _update(self, gradient, flat, first, second, packets: int, changed, rate: float, t) -> None:
        """Update the ``changed`` groups of ``flat`` and its moments in place; ``t`` counts the steps before."""
        module = compat.backend_module(flat)
        Group = module.Array4f if packets else module.Float
        g, p, m, v = (dr.gather(Group, array, changed) for array in (gradient, flat, first, second))
        m = dr.lerp(g, m, self.beta_1)
        v = dr.lerp(dr.square(g), v, self.beta_2)
        number = int(t[0]) + 1
        scale = -rate * (1 - self.beta_2**number) ** 0.5 / (1 - self.beta_1**number)
        p = dr.fma(m * dr.rsqrt(v + self.epsilon**2), dr.opaque(module.Float, scale), p)
        dr.eval(p, m, v)  # before they are written, since arrays that are still read would be copied
        for array, values in ((flat, p), (first, m), (second, v)):
            dr.scatter(array, values, changed)
        dr.eval(flat, first, second)


def _changed_entries(gradient, packets: int, rows=None):
    """Return the numbers of the entries with a gradient or, if a row has ``packets``, those of its packets.

    Of packets, only those of ``rows`` are looked at, if these are given.
    """
    module = compat.backend_module(gradient)
    if not packets:
        return dr.compress(gradient != 0)
    if rows is None:
        group = dr.gather(module.Array4f, gradient, dr.arange(module.UInt32, dr.width(gradient) // PACKET))
        return dr.compress(dr.any(group != 0))
    lane = dr.arange(module.UInt32, dr.width(rows) * packets)
    packet = dr.fma(dr.gather(module.UInt32, rows, lane // packets), packets, lane % packets)
    kept = dr.compress(dr.any(dr.gather(module.Array4f, gradient, packet) != 0))
    return dr.gather(module.UInt32, packet, kept)


#: Most measurements of a training whose time is limited.
MEASUREMENTS = 10

#: Largest share of a limited time that measurements take.
MEASURING = 0.2

#: Share of the steps of the settings below which a training whose time is limited is unfinished.
UNFINISHED = 0.05

#: Rate of the exponential-like distribution on [0, 1]: half of the samples lie below 0.21.
EXPONENTIAL_RATE = 3.0


def exponential_like(u):
    """Return a number x in [0, 1] with density ∝ exp(−:data:`EXPONENTIAL_RATE`·x), from a uniform ``u`` in [0, 1)."""
    return dr.minimum(-dr.log(1 - u * (1 - math.exp(-EXPONENTIAL_RATE))) / EXPONENTIAL_RATE, 1)


def sample_losses(outputs: Mapping, targets: Mapping, weights: Mapping[str, float], size: int, loss: str) -> list:
    """Return the weighted absolute or squared differences (``loss``) between outputs and targets, one array a target.

    ``outputs`` and ``targets`` map names to lists of arrays with ``size`` entries; a missing weight counts 1. The sum
    of all entries of the result is the weighted mean.
    """
    losses = []
    for name, target in targets.items():
        errors = [o - t for o, t in zip(outputs[name], target, strict=True)]
        errors = [dr.abs(e) if loss == "mae" else dr.square(e) for e in errors]
        losses.append(weights.get(name, 1.0) / (len(errors) * size) * sum(errors[1:], errors[0]))
    return losses


class Problem:
    """Base class of problems: the arrays that a task trains, its loss and its measurement.

    Most problems draw samples (:meth:`batch`) and evaluate the tables for them (:meth:`predict`). Other problems
    replace :meth:`loss`, for instance by that of a render: ``net`` may then be the parameters of a loaded scene
    (``mi.SceneParameters``, reduced to the trained ones by ``keep``).
    """

    #: The trainable module (``drjit.nn.Module``), allocated, or another mapping of names to arrays with ``update``.
    net: object

    #: Weight of each named target in the loss; a missing name counts 1.
    weights: Mapping[str, float] = {}

    #: States whose first measured number differs by less than this count as equally good, and the later one is kept.
    tolerance: float = 0.0

    #: Adam's decay of squared gradients. A rare, large gradient moves an entry by ``1 / √(1 − beta_2)`` learning rates.
    beta_2: float = 0.999

    #: True if a step reads a small part of the tables: only entries with a gradient are updated
    #: (:class:`SparseAdam`). ``net`` is a dictionary then.
    sparse: bool = False

    #: Loss that is no explosion, however small the losses before: a training that starts next to its optimum first
    #: moves away from it, as far as its learning rate goes.
    harmless: float = 1e-6

    #: Content of a checkpoint beside the settings, as JSON; a checkpoint of another problem is refused.
    identity: Mapping = {}

    #: The settings of the training; set by :func:`fit`.
    settings: FitSettings = FitSettings()

    def begin(self, step: int, share: float) -> str:
        """Prepare step ``step`` of a problem that changes; ``share`` of the training is over.

        Returns the phase of the training: only losses of the same phase are compared.
        """
        return ""

    def batch(self, rng, size: int):
        """Draw ``size`` samples: ``(inputs, targets)``, the targets a dict of name → list of arrays."""
        raise NotImplementedError(f"{type(self).__name__} has neither batch() and predict() nor a loss() of its own")

    def predict(self, net, inputs) -> dict[str, list]:
        """Evaluate the tables for ``inputs``, in the form of the targets.

        ``net`` is a copy of the problem's, with entries that are folded already (:func:`.indirection.unfolded`).
        """
        raise NotImplementedError

    def loss(self, net, rng, size: int):
        """Return the loss of a step that may draw ``size`` samples from ``rng``.

        It is an array or a list of arrays, whose entries are summed later, so that one kernel writes them and sums all
        gradients. By default: :func:`sample_losses` of :meth:`predict` and the targets of :meth:`batch`.
        """
        inputs, targets = self.batch(rng, size)
        return sample_losses(self.predict(unfolded(net), inputs), targets, self.weights, size, self.settings.loss)

    def measure(self, net) -> dict[str, float]:
        """Return figures on held-out data; the first one decides which state is the best (higher is better)."""
        raise NotImplementedError

    def train(self, settings: FitSettings, *arguments, **options) -> FitResult:
        """Train :attr:`net` in place: :func:`fit` of this problem."""
        return fit(self, settings, *arguments, **options)


@dataclass
class _State:
    """State of a training: parameters and, for each, Adam's step count and moments, as Dr.Jit or NumPy arrays.

    Without ``moments``, Adam begins anew.
    """

    step: int
    lr_scale: float
    parameters: dict
    moments: dict[str, tuple]


@dataclass
class _Record:
    """Record of a training so far, which a checkpoint keeps beside the state.

    ``references`` are running means of the loss by phase, from its first step on, lest an explosion sets them.
    ``plateau`` holds the factor of the learning rate, the best loss and the step since which both are the same.
    """

    best: dict | None = None
    best_measured: dict | None = None
    best_step: int = 0
    history: list = field(default_factory=list)
    restarts: int = 0
    seconds: float = 0.0
    plateau: list = field(default_factory=lambda: [1.0, None, 0])
    references: dict = field(default_factory=dict)


def fit(
    problem: Problem,
    settings: FitSettings,
    checkpoint=None,
    resume=False,
    progress=True,
    log=None,
    title=None,
    deadline: Deadline | None = None,
    least: int = 1,
) -> FitResult:
    """Train ``problem.net`` in place and leave the best state of the training in it.

    - ``checkpoint``: file that keeps the state of the training, written at every measurement; with ``resume`` it is
      read first and must belong to the same settings.
    - ``title``: text before the progress bar.
    - ``log``: function that gets one sentence about each restart (default: print to stderr).
    - ``deadline``: the training and its last measurement end in time, though not before ``least`` steps; schedules
      follow the clock in place of the steps. There are at most :data:`MEASUREMENTS` measurements, fewer if they take
      long.

    Ctrl-C ends the training after the current step, which is measured, too, and keeps the best state so far. If the
    loss or a parameter becomes NaN, or the loss explodes, the last good state is restored and the learning rate halved.
    Raises :class:`FittingError` if the training diverges again and again, or the checkpoint does not fit.
    """
    net, problem.settings = problem.net, settings
    if checkpoint is not None:
        writable_file(checkpoint)
        if os.path.exists(checkpoint) and not resume and not _checkpoint_meta(checkpoint):
            raise FittingError(f'the checkpoint "{checkpoint}" would replace a file that is not one')
    elif resume:
        raise FittingError("resuming (--resume) needs the checkpoint (--checkpoint FILE) of the run to go on with")
    trainer, record = _Trainer(problem, settings), _Record()
    # The settings that a checkpoint has to agree in
    agreed = {**settings.common, **json.loads(json.dumps(dict(problem.identity)))}
    if resume:
        state, record = _load_checkpoint(checkpoint, agreed, trainer)
        trainer.restore(state)
        trainer.restarts = record.restarts
    start = time.perf_counter() - record.seconds
    clock = None if deadline is None else _Clock(start, deadline.left())

    def share() -> float:
        """Return the share of the training that is over."""
        if clock is None:
            return trainer.step / settings.steps
        return clock.share() if trainer.step >= least else min(clock.share(), 0.999)

    trainer.share = share()
    good = trainer.earlier()
    bar = _Bar(settings.steps, clock and clock.seconds, title, progress)
    planned = min(MEASUREMENTS, max(1, settings.steps // settings.measure_every))  # with a limit of time
    bar.show(trainer)
    log = log or (lambda message: tqdm.write(message, file=sys.stderr))
    interrupted = False

    def measure(loss: float | None):
        figures = problem.measure(net) if clock is None else clock.time_measurement(lambda: problem.measure(net))
        measured = {k: float(v) for k, v in figures.items()}
        name, value = next(iter(measured.items()))
        record.history.append({"step": trainer.step, "loss": loss, **measured})
        top = max((h[name] for h in record.history if math.isfinite(h[name])), default=value)
        if record.best is None or value >= top - problem.tolerance:
            record.best = trainer.snapshot(all_moments=False).parameters
            record.best_measured, record.best_step = measured, trainer.step
        bar.show_figure(name, f"{value:.2f}", refresh=True)

    with interruptible() as stop, cores(settings.deterministic), compat.room_for_sums(LARGEST_SUMS), bar.shown:
        while trainer.share < 1 and not stop.is_set():
            # A snapshot of tables that are written in place is a copy
            kept = not problem.sparse or (trainer.step + 1) % settings.check_every == 0
            before, share_before = trainer.earlier() if kept else good, trainer.share
            loss = trainer.take_step(record.plateau[0])
            if clock is not None:
                dr.eval(loss)
                dr.sync_thread()
            trainer.share = share()
            bar.show(trainer)
            last = trainer.share >= 1
            measured = trainer.step % settings.measure_every == 0
            if clock is not None:
                measured = int(planned * trainer.share) > int(planned * share_before) and not clock.slow
            due = trainer.step % settings.check_every == 0 or measured
            reference = record.references.get(trainer.phase)
            if not (due or last or reference is None):
                continue
            value = float(loss[0])
            exploded = reference is not None and value > 10 * reference + problem.harmless
            if not math.isfinite(value) or exploded or not trainer.finite():
                trainer.restarts = record.restarts = record.restarts + 1
                if record.restarts > 8:
                    raise FittingError(
                        f"the training diverged {record.restarts} times (last at step {trainer.step}, loss {value:g}): "
                        f"lower the learning rate, {settings.lr:g}"
                    )
                log(
                    f"step {trainer.step}: the loss is {value:g}; restored step {good.step} "
                    f"with half the learning rate ({settings.lr * good.lr_scale / 2:g})"
                )
                good.lr_scale /= 2
                trainer.restore(good)
                trainer.share = share()
                bar.show(trainer)
                continue
            record.references[trainer.phase] = value if reference is None else 0.5 * (reference + value)
            if settings.schedule == "plateau":
                record.plateau = _plateau_after(*record.plateau, trainer.step, value, settings)
            bar.show_figure("loss", f"{value:.3g}")
            good = before  # not the state after this step: nobody has seen its loss yet
            if measured or last:
                measure(value)
                if checkpoint is not None:
                    record.seconds = time.perf_counter() - start
                    _save_checkpoint(checkpoint, agreed, trainer.snapshot(), record)
        if stop.is_set() and trainer.share < 1:
            interrupted = True
            history = record.history
            if trainer.step > 0 and (not history or history[-1]["step"] != trainer.step) and trainer.finite():
                measure(None)

    if record.best is None:
        raise FittingError("the training was stopped before its first measurement: there is nothing to keep")
    net.update({key: type(trainer.optimizer[key])(value) for key, value in record.best.items()})
    spent = time.perf_counter() - start
    unfinished = clock is not None and not interrupted and trainer.step < UNFINISHED * settings.steps
    return FitResult(
        record.best_measured, record.best_step, trainer.step, spent, interrupted, record.restarts, record.history,
        stop.is_set(), unfinished,
    )  # fmt: skip


class _Clock:
    """Share of a training that is over, if its time is limited.

    The time of the last measurement, as the measurements so far took it, and that of half a step are kept for the end.
    """

    def __init__(self, start: float, seconds: float):
        self.start, self.seconds, self.over = start, seconds, 0.0
        self.measuring, self.measurement = 0.0, 0.0  # seconds of all measurements, and of one without compilation
        self.before, self.step = None, math.inf  # time of the step before, and the duration of the shortest one

    def share(self) -> float:
        """Return the share that is over, asked for after each step; it never falls."""
        now = time.perf_counter()
        if self.before is not None:
            self.step = min(self.step, now - self.before)
        self.before = now
        half = 0.5 * self.step if math.isfinite(self.step) else 0.0
        limit = max(self.seconds - self.measurement - half, 1e-9)
        self.over = min(1.0, max(self.over, (now - self.start) / limit))
        return self.over

    @property
    def slow(self) -> bool:
        """True if measurements take too much of the time, so that only the last one is still carried out."""
        return self.measuring > MEASURING * (self.before - self.start)

    def time_measurement(self, measure):
        """Return the result of a measurement, whose duration counts."""
        start = time.perf_counter()
        figures, self.measurement = duration(measure)
        self.before = time.perf_counter()  # the next step begins here
        self.measuring += self.before - start
        return figures


class _Bar:
    """Progress of a training, in steps, or in the seconds that are left."""

    def __init__(self, steps: int, seconds: float | None, title: str | None, progress: bool):
        self.seconds, self.text, self.lines = seconds, {}, not in_terminal()
        self.title = f"{title}: " if title and self.lines else ""
        if seconds is not None:
            self.shown = progress_bar(title, 1.0, "", progress, line=self._form(0, 0.0), bar_format=self._form(0, 0.0))
        else:
            line = "step {n_fmt} of {total_fmt}, {remaining} left{postfix}"
            self.shown = progress_bar(title, steps, "step", progress, line=line)

    def _form(self, step: int, share: float) -> str:
        left = tqdm.format_interval((1 - share) * self.seconds)
        return f"step {step}, {left} left{{postfix}}" if self.lines else "{l_bar}{bar}| {elapsed}<" + left + "{postfix}"

    def show(self, trainer: _Trainer) -> None:
        if self.seconds is not None:
            self.shown.bar_format = self.title + self._form(trainer.step, trainer.share)
        self.shown.update((trainer.step if self.seconds is None else trainer.share) - self.shown.n)

    def show_figure(self, name: str, value: str, refresh: bool = False) -> None:
        self.text[name] = value
        self.shown.set_postfix(self.text, refresh=refresh and not self.lines)


def _plateau_after(factor: float, best: float | None, since: int, step: int, loss: float, settings) -> list:
    """Return :attr:`_Record.plateau` after ``step``: the factor halves if no loss improved for a tenth of the steps."""
    if best is None or loss < 0.999 * best:
        return [factor, loss, step]
    if step - since >= max(settings.check_every, settings.steps // 10):
        return [factor / 2, best, step]
    return [factor, best, since]


class _Trainer:
    """Optimiser and its module; the only class that touches Adam's internals."""

    def __init__(self, problem: Problem, settings: FitSettings):
        self.problem, self.settings = problem, settings
        self.step, self.lr_scale, self.restarts, self.phase = 0, 1.0, 0, ""
        self.share = 0.0  # of the training that is over
        self.optimizer = (SparseAdam if problem.sparse else Adam)(lr=settings.lr, beta_2=problem.beta_2)
        self.optimizer.update(problem.net)
        self.module = compat.backend_module(next(iter(self.optimizer.values())))

    def take_step(self, plateau: float = 1.0):
        net, settings = self.problem.net, self.settings
        # A number that changes with the step must not be part of the kernel, or each step would compile anew:
        # the seed is opaque, and Adam makes a learning rate opaque if it is a Python float set parameter by parameter.
        # After a restart others are drawn, lest the same batch ends it again.
        drawn = self.restarts * settings.steps + self.step
        seed = dr.opaque(self.module.UInt64, ((settings.seed << 32) + drawn) % 2**64)
        rng = dr.rng(seed=seed)
        net.update(self.optimizer)
        self.phase = self.problem.begin(self.step, self.share)
        losses = self.problem.loss(net, rng, settings.batch)
        losses = losses if isinstance(losses, list) else [losses]
        losses = [values.array if dr.is_tensor_v(values) else values for values in losses]
        # The loss is the sum of these; the same kernel writes them and sums the gradients of the entries.
        dr.schedule(dr.detach(losses))
        for values in losses:
            dr.set_grad(values, 1)
            dr.enqueue(dr.ADMode.Backward, values)
        dr.traverse(dr.ADMode.Backward)
        rate = settings.lr * self.lr_scale
        if settings.schedule == "cosine":
            rate *= 0.5 * (1 + math.cos(math.pi * self.share))
        rate *= plateau
        self.optimizer.set_learning_rate({name: rate for name in self.optimizer})
        if self.problem.sparse:
            net.clear()  # the tables are written in place
        self.optimizer.step()
        net.update(self.optimizer)
        self.step += 1
        loss = sum(dr.sum(values) for values in dr.detach(losses))
        dr.schedule(loss)
        return loss

    def finite(self) -> bool:
        return all(bool(dr.all(dr.isfinite(v.array), axis=None)) for v in self.optimizer.values())

    def snapshot(self, all_moments: bool = True) -> _State:
        """Return the state. Large tables that are written in place are copied: without their moments, if so wished."""
        parameters, moments = {}, {}
        for key, (value, *moment) in compat.adam_state(self.optimizer).items():
            parameters[key] = dr.detach(value)
            if all_moments or not self.problem.sparse:
                moments[key] = tuple(moment)
        return _State(self.step, self.lr_scale, parameters, moments)

    def earlier(self) -> _State:
        """Return the state to which a training that diverges returns: copies of large tables in half precision."""
        state = self.snapshot(all_moments=False)
        if self.problem.sparse:
            state.parameters = {key: self.module.TensorXf16(value) for key, value in state.parameters.items()}
            dr.eval(state.parameters)
        return state

    def restore(self, state: _State) -> None:
        self.step, self.lr_scale = state.step, state.lr_scale
        for key, value in state.parameters.items():
            if (moments := state.moments.get(key)) is None:
                none = dr.zeros(type(value.array), dr.width(value))
                moments = 0, none, none
            compat.set_adam_state(self.optimizer, key, value, *moments)
        self.problem.net.update(self.optimizer)


def _save_checkpoint(path, settings: dict, state: _State, record: _Record) -> None:
    arrays = {}
    for key, value in state.parameters.items():
        t, m, v = state.moments[key]
        arrays |= {f"value/{key}": value.numpy(), f"m/{key}": m.numpy(), f"v/{key}": v.numpy()}
        arrays |= {f"t/{key}": np.int64(t[0]), f"best/{key}": np.asarray(record.best[key])}
    meta = {f.name: getattr(record, f.name) for f in fields(record) if f.name != "best"}
    meta |= {"step": state.step, "lr_scale": state.lr_scale, "settings": settings}
    arrays["meta"] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    with replacing(path) as temporary, open(temporary, "wb") as stream:
        np.savez(stream, **arrays)


def _checkpoint_meta(path) -> dict:
    """Return the description of a checkpoint, {} for another kind of file."""
    try:
        with Archive(path) as archive:
            meta = archive.json("meta")
            return meta if "lr_scale" in meta else {}
    except Exception:  # zipfile, json and numpy each have their own for another kind of file
        return {}


def _check_meta(meta: dict) -> None:
    """Raise ``KeyError`` or ``TypeError`` unless the numbers and lists of a checkpoint are those of a training."""
    for key in ("step", "best_step", "restarts"):
        if type(meta[key]) is not int or not 0 <= meta[key] < 2**63:
            raise TypeError(f"{key} is {meta[key]!r:.40}")
    for key in ("lr_scale", "seconds"):
        if type(meta[key]) not in (int, float) or not 0 <= meta[key] < math.inf:
            raise TypeError(f"{key} is {meta[key]!r:.40}")
    figures = [meta["best_measured"], *meta["history"]]
    values = [v for row in figures for v in row.values() if v is not None] + list(meta["references"].values())
    factor, best, since = meta["plateau"]
    numbers = all(type(v) in (int, float) for v in (*values, factor, since, best or 0))
    name = next(iter(figures[0]), None)
    if not numbers or any(name not in row or not isinstance(row.get("step", 0), int) for row in figures):
        raise TypeError("the measurements are not lists of numbers")


def _load_checkpoint(path, settings: dict, trainer: _Trainer) -> tuple[_State, _Record]:
    if fault := irregular(path):
        raise FittingError(f'the checkpoint "{shown(path)}" {fault}')
    if not os.path.exists(path):
        raise FittingError(f'the checkpoint "{path}" does not exist, there is nothing to resume')
    try:
        with Archive(path) as archive:
            meta = archive.json("meta")
            arrays = {k: aligned_copy(archive.array(k)) for k in archive.members if k != "meta"}
        keys = list(trainer.optimizer)
        state = _State(
            meta["step"], meta["lr_scale"], {k: arrays[f"value/{k}"] for k in keys},
            {k: (int(arrays[f"t/{k}"]), arrays[f"m/{k}"], arrays[f"v/{k}"]) for k in keys},
        )  # fmt: skip
        best = {k: arrays[f"best/{k}"] for k in keys}
        _check_meta(meta)
        stored_settings = dict(meta["settings"])
    except (ArchiveError, LimitError) as e:
        raise FittingError(f"the checkpoint {e}") from None
    except Exception as e:  # zipfile, json and numpy each have their own for a damaged file
        raise FittingError(f'the checkpoint "{path}" is damaged or of another task ({reason(e)})') from None
    sources = [s["source"] for s in (stored_settings, settings) if "source" in s]
    if len(sources) == 2 and sources[0] != sources[1]:
        raise FittingError(f'the checkpoint "{path}" is of another source, or the source has changed since')
    for key in keys:
        shape = trainer.optimizer[key].shape
        moments_fit = all(m.shape == (math.prod(shape),) for m in state.moments[key][1:])  # Adam keeps them flat
        if state.parameters[key].shape != shape or best[key].shape != shape or not moments_fit:
            raise FittingError(f'the checkpoint "{path}" holds other table sizes ("{key}")')
    if stored_settings != settings:
        changed = [k for k in {**settings, **stored_settings} if stored_settings.get(k) != settings.get(k)]
        raise FittingError(f'the checkpoint "{path}" was made with other settings ({", ".join(changed)})')
    return state, _Record(best, **{f.name: meta[f.name] for f in fields(_Record) if f.name != "best"})


#: Entries, of all cores together, that the copies of an array may have in which each core sums gradients on its own: 2
#: to 3 times faster than together.
LARGEST_SUMS = 2**28


@contextlib.contextmanager
def cores(deterministic: bool):
    """Compute on one core in this context if the result is to be ``deterministic``."""
    _outside.append(dr.thread_count())
    if deterministic:
        compat.use_threads(1)
    try:
        yield
    finally:
        compat.use_threads(_outside.pop())


@contextlib.contextmanager
def all_cores():
    """Compute on as many cores as outside of :func:`cores` in this context, whose kernels must not sum gradients."""
    before = dr.thread_count()
    compat.use_threads(_outside[0] if _outside else before)
    try:
        yield
    finally:
        compat.use_threads(before)


#: Numbers of cores outside of the contexts in progress
_outside: list[int] = []
