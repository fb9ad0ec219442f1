"""Training of task 5: arrays of a texture, trained for their shaded appearance.

The loss is (1 − λ) · texture + λ · shading. The first term is the loss of task 4, in the units of its own recipe. The
second compares shaded values, for views and lights uniform over the hemisphere: the arrays, shaded by frozen tables of
the Disney BRDF, against a reference that shades first and filters afterwards (:func:`.reference`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import drjit as dr
import numpy as np

from ...arrays import lookup
from ...arrays.indirection import unfolded
from ...arrays.tables import Table
from ...core.progress import duration
from ...fitting.loop import FitResult, checkpoint_settings, sample_losses
from ...fitting.task import FitRequest
from ...maps.model import significant
from ...maps.pyramid import Pyramid
from ...maps.source import Source
from ..disney.training import random_directions
from . import PRESETS as TEXTURES
from . import ShadingSettings
from . import training as textures
from .appearance import TRUTHS, ShadedEvaluation, reader, reference, write_preview
from .compressed import CompressedTexture, neutral_extras, to_table
from .surface import frozen_decoder, material_effects, shaded, surface_of

#: Factor of the number of shaded samples from one level to the next coarser one, up to level :data:`TOP`.
FALL = 0.7
TOP = 9

#: Level biases that are tried.
BIASES = (0.0, -0.5, -1.0)

#: Share of the steps, or of the time that is left, for which each of them is trained.
TRIAL = 0.08

#: Level biases that are tried with the finest arrays as they are, if each of :data:`BIASES` loses at some level.
FIXED_BIASES = (0.0, -0.25, -0.5)

#: Loss of a level that is none, dB.
ROUNDING = 1e-4

#: Least time of such a trial, in measurements; in less time, the biases of the start itself are compared.
SHORTEST = 4


class Trial(NamedTuple):
    """A short training, and what it decides: level bias, whether there are extras, whether fine levels are fixed."""

    bias: float
    extras: bool = False
    fixed: bool = False

    @property
    def name(self) -> str:
        return f"{self.bias:g}{', extras' * self.extras}{', fine levels fixed' * self.fixed}"


class ShadingProblem(textures.TextureProblem):
    """Training problem of shaded appearance.

    ``net`` reads the stored channels, ``pyramid`` is the truth of the maps. The images of ``evaluation`` decide which
    state is the best (``None``: the PSNR of the texture decides). Shaded values are read with the recipe's level bias,
    the texture's loss is that of the levels as they are stored. ``base`` is the PSNR of each level of the images that
    no state may fall below.
    """

    #: Tolerance of the PSNR of shaded images, dB.
    tolerance = 0.02

    def __init__(
        self, net, pyramid: Pyramid, recipe: ShadingSettings, digest: str = "",
        evaluation: ShadedEvaluation | None = None, base: Sequence[float] = (),
    ):  # fmt: skip
        super().__init__(net, pyramid, TEXTURES[recipe.texture], digest)
        self.shading, self.evaluation, self.base = recipe, evaluation, base
        self.level_bias = recipe.level_bias or 0.0
        self.beta_2 = recipe.beta_2 if recipe.share > 0 else self.beta_2
        #: Picture that is written at each measurement, and the images that it shows a part of
        self.preview: tuple[Path, ShadedEvaluation] | None = None
        #: Gain of each level over ``base`` in the last measurement, dB
        self.level_gains = np.zeros(0)
        self.effects, _ = material_effects(pyramid.layout)
        self.decoder = frozen_decoder(self.types)
        self.identity = {**self.identity, "shading": recipe.further}

    def loss(self, net, rng, size: int):
        net, share = self.seen(unfolded(net)), self.shading.share
        net = net.fixed_fine() if self.shading.fixed else net
        losses = []
        if share < 1:
            inputs, targets = self.batch(rng, size)
            weights = {name: (1 - share) * weight for name, weight in self.weights.items()}
            losses += sample_losses(self.read(net, inputs), targets, weights, size, self.recipe.loss)
        if share > 0:
            losses.append(share / size * self.shading_errors(net, rng, size))
        return losses

    def shading_errors(self, net, rng, size: int):
        """Return the error of ``size`` shaded samples, the mean over colours; ``net`` is as training sees it."""
        recipe, types = self.shading, self.types
        (u, v, level), (wi, wo) = self.places(rng, size), random_directions(rng, types, size)
        truth = reference(recipe.reference, self.pyramid, u, v, level, wi, wo, self.effects, rng)
        dr.eval(u, v, level, wi, wo, truth)
        if self.level_bias:  # opaque, so that one kernel serves all
            bias = dr.opaque(types.Float, self.level_bias)
            level = lookup.clamp(level + bias, 0.0, float(len(self.sizes) - 1))
        surface = surface_of(self.pyramid, net.filtered(u, v, level), net.extra(u, v, level))
        limit = None if recipe.clip is None else recipe.clip * recipe.share / size
        value = shaded(self.decoder, surface, wi, wo, self.effects, limit)
        bounded = _bounded if recipe.bounded else (lambda x: x)
        errors = [bounded(a) - bounded(b) for a, b in zip(value, truth, strict=True)]
        squared = self.settings.loss == "mse"
        return sum(dr.square(e) if squared else dr.abs(e) for e in errors) / 3

    def places(self, rng, size: int) -> tuple:
        """Draw ``(u, v, level)``, uniform in uv; the density falls by :data:`FALL` from one level to the next."""
        Float = self.types.Float
        u, v, level = (rng.random(Float, size) for _ in range(3))
        lowest = FALL ** min(len(self.sizes) - 1, TOP)
        return u, v, dr.log(1 - (1 - lowest) * level) * (1 / math.log(FALL))

    def measure(self, net) -> dict[str, float]:
        """Return the PSNR of shaded images, entries rounded, and the PSNR of the texture.

        With a ``base``, the first figure is ``gain_db``: the mean gain of all levels, if no level loses, else the
        largest loss of a level, negative.
        """
        texture = super().measure(net)
        if self.evaluation is None:
            return texture
        maps = CompressedTexture(self.pyramid.layout, textures.rounded(unfolded(net)), self.level_bias)
        read = reader(maps, self.effects, self.decoder)
        if self.preview is not None:
            write_preview(*self.preview, read)
        errors = self.evaluation.measure(read, False)
        if self.base:
            self.level_gains = np.subtract(errors["C"]["psnr_db"], self.base)
        gain = {"gain_db": mean_gain(self.level_gains)} if self.base else {}
        shading = {f"shaded_{TRUTHS[k]}_db": f["mean_db"] for k, f in errors.items()}
        return {**gain, **shading, **{f"texture_{name}": value for name, value in texture.items()}}


def mean_gain(gains: np.ndarray) -> float:
    """Return the mean gain of levels, in dB, if no level loses, else the largest loss, negative.

    Losses up to :data:`ROUNDING` are those of sums in another order.
    """
    return float(gains.mean() if gains.min() >= -ROUNDING else gains.min())


def _bounded(x):
    """Return values up to 1 unchanged, and ``1 + log x`` above: a rare highlight cannot dominate the loss."""
    return dr.select(x > 1, 1 + dr.log(dr.maximum(x, 1)), x)


def trainable_arrays(table: Table, pyramid: Pyramid):
    """Return the arrays of a trained texture for further training. Raises ``ValueError`` for other channels."""
    texture = CompressedTexture.from_table(table, pyramid.types.TensorXf, "float32")
    if texture.layout != pyramid.layout:
        raise ValueError(f"{table.path}: stores other channels than a training of this source would")
    return texture.net


def fit_shading(
    source: Source,
    start,
    recipe: ShadingSettings,
    request: FitRequest,
    pyramid: Pyramid,
    evaluation: ShadedEvaluation | None = None,
    preview: Path | None = None,
    start_bias: float = 0.0,
) -> tuple[Table, FitResult]:
    """Train arrays (``start``: :func:`trainable_arrays`) of ``source`` for shading; return the table and its record.

    The table is of the task ``texture``, with its errors as a texture and as shaded images of the ``evaluation``. Level
    bias and state are chosen by other images, under views and lights that neither training nor evaluation draws. If no
    state gains without a loss at some level, the table holds the start, read with its own ``start_bias`` (setting
    ``kept_start``). The setting ``before`` has the errors of the start as shaded images, ``level_biases`` the gains by
    which the bias was chosen (:func:`choose`). ``preview`` is a picture that is written at each measurement.
    """
    request = dataclasses.replace(request, settings=recipe)
    validation = None if evaluation is None else evaluation.another()
    effects, decoder = material_effects(pyramid.layout)[0], frozen_decoder(pyramid.types)
    texture = CompressedTexture(pyramid.layout, textures.stored_form(start), start_bias)
    base, before, stopped = [], {}, None
    choice, gains = recorded_choice(request)
    biases = BIASES if recipe.level_bias is None else (recipe.level_bias,)
    if choice is None and recipe.level_bias is not None and not recipe.extras:
        choice = Trial(recipe.level_bias)

    def shaded_errors(texture: CompressedTexture) -> dict[str, float]:
        errors = evaluation.measure(reader(texture, effects, decoder), False)
        return {f"shaded_{TRUTHS[k]}_db": f["mean_db"] for k, f in errors.items()}

    def build_problem(choice: Trial) -> ShadingProblem:
        net = start.changed(lambda array, bits: array.copy())
        if choice.extras and net.extras is None:
            layout = pyramid.layout
            net.extras = neutral_extras(layout.height, layout.width, net.border).alloc(pyramid.types.TensorXf)
        changed = dataclasses.replace(recipe, level_bias=choice.bias, extras=choice.extras, fixed=choice.fixed)
        return ShadingProblem(net, pyramid, changed, source.digest, validation, base)

    if evaluation is not None:
        # The measurement of the result takes as long
        begin = request.deadline.rehearse if request.deadline is not None else lambda measure: measure()
        before = begin(lambda: shaded_errors(texture))
        base = validation.measure(reader(texture, effects, decoder), False)["C"]["psnr_db"]
        if choice is None:
            choice, gains, stopped = choose(build_problem, request, biases)
    problem, result = stopped or (build_problem(choice or Trial(biases[0])), None)
    if result is None:
        problem.identity |= {"level_biases": gains} if gains else {}
        problem.preview = None if preview is None or evaluation is None else (preview, evaluation)
        result = request.train(problem, "shading")
    kept = bool(base) and result.measured["gain_db"] <= 0
    if kept:
        result = dataclasses.replace(result, step=0, measured={"gain_db": 0.0})
    else:
        texture = CompressedTexture(pyramid.layout, textures.stored_form(problem.net), problem.level_bias)
    settings = {**request.recorded(result), **problem.identity, "level_bias": texture.level_bias}
    settings |= {"kept_start": True} if kept else {}
    table = to_table(texture, settings)
    table.preset, table.seed = request.preset, recipe.seed
    errors = CompressedTexture.from_table(table, request.types.TensorXf).measure(source)
    if evaluation is not None:
        table.settings["before"] = significant(before)
        errors = {**(before if kept else shaded_errors(texture)), **errors}
    table.measured = significant(errors)
    return table, result


def choose(
    build_problem: Callable[[Trial], ShadingProblem], request: FitRequest, biases: Sequence[float]
) -> tuple[Trial, dict, tuple | None]:
    """Return the best :class:`Trial` after a short training with each, the gains, and ``None``.

    The best has the largest mean of levels among those that lose at no level, or among all if each loses somewhere. If
    each of ``biases`` does, :data:`FIXED_BIASES` follow, with fixed fine levels, unless the settings have a bias. One
    of these with a level whose loss the short training leaves as it is comes last. If the settings have extras, the
    best so far is trained with them, too. The gains are ``gain_db`` by the name of a choice. If Ctrl-C ends a training,
    its problem and record are returned in place of ``None``. If the time is too short (:data:`SHORTEST`), the untrained
    arrays are compared.
    """
    recipe, measured, constant, short = request.settings, {}, set(), None
    steps = max(1, round(TRIAL * recipe.steps))
    settings = dataclasses.replace(recipe, steps=steps, measure_every=steps)

    def best() -> Trial:
        def rank(choice: Trial) -> tuple:
            figures = measured[choice]
            return figures["gain_db"] >= 0, choice not in constant, figures["shaded_converged_db"]

        return max(measured, key=rank)

    def choices() -> Iterator[Trial]:
        yield from map(Trial, biases)
        if measured[best()]["gain_db"] < 0 and TEXTURES[recipe.texture].layered:
            fixed = FIXED_BIASES if recipe.level_bias is None else biases
            yield from (Trial(bias, fixed=True) for bias in fixed)
        if recipe.extras:
            yield best()._replace(extras=True)

    for choice in choices():
        problem = build_problem(choice)
        measured[choice], measurement = duration(lambda problem=problem: problem.measure(problem.net))
        untrained = problem.level_gains
        trial = dataclasses.replace(request.part(TRIAL), settings=settings, checkpoint=None, resume=False)
        limit = None if trial.deadline is None else trial.deadline.left()
        short = limit is not None and limit < SHORTEST * measurement if short is None else short
        if not short:
            result = trial.train(problem, f"level bias {choice.name}")
            if result.interrupted:
                return choice, {}, (problem, result)
            if choice.fixed and np.any((untrained < -ROUNDING) & (abs(problem.level_gains - untrained) < ROUNDING)):
                constant.add(choice)
            measured[choice] = result.measured
    return best(), {c.name: float(f"{m['gain_db']:.4g}") for c, m in measured.items()}, None


def recorded_choice(request: FitRequest) -> tuple[Trial | None, dict]:
    """Return the choice of the training that is resumed, or ``None``, and the gains that it was made by."""
    recorded = checkpoint_settings(request.checkpoint) if request.resume and request.checkpoint is not None else {}
    shading = recorded.get("shading", {})
    if "level_bias" not in shading:
        return None, {}
    choice = Trial(shading["level_bias"], *(bool(shading.get(name)) for name in ("extras", "fixed")))
    return choice, recorded.get("level_biases", {})
