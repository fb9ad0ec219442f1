"""
Training of task 5: the arrays of a texture, for what they look like when they are shaded.

The loss is (1 − λ) · texture + λ · shading. The first is task 4's, in the units of its own recipe; the second the
difference between shaded values: what the arrays hold, through frozen tables of the Disney BRDF, against a reference
that shades first and filters then (:mod:`.reference`), for views and lights uniform over the hemisphere.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import drjit as dr

from ...fitting import FitResult
from ...indirection import unfolded
from ...maps.pyramid import Pyramid
from ...maps.source import Source
from ...tables import Table
from ...task import FitRequest
from ..disney.training import random_directions
from ..texture import training as textures
from ..texture.compressed import CompressedTexture, to_table
from ..texture.presets import PRESETS as TEXTURES
from .evaluation import TRUTHS as LETTERS
from .evaluation import ShadedEvaluation, reader
from .material import effects_of, frozen_decoder, shaded, surface_of
from .presets import ShadingRecipe
from .preview import write_preview
from .reference import reference

#: How much fewer of the samples that are shaded lie on each level than on the one below it, and the coarsest of all.
FALL, TOP = 0.7, 9


class ShadingProblem(textures.TextureProblem):
    """
    The training problem. ``net`` reads the stored channels, ``pyramid`` is the truth of the maps; ``evaluation`` are
    the images that decide which state is the best (``None``: the texture's own PSNR does).
    """

    #: dB of shaded images.
    tolerance = 0.02

    def __init__(
        self, net, pyramid: Pyramid, recipe: ShadingRecipe, digest: str = "", evaluation: ShadedEvaluation | None = None
    ):
        super().__init__(net, pyramid, TEXTURES[recipe.texture], digest)
        self.shading, self.evaluation = recipe, evaluation
        self.preview: Path | None = None
        self.effects, _ = effects_of(pyramid.layout)
        self.decoder = frozen_decoder(self.types)
        own = {k: v for k, v in dataclasses.asdict(recipe).items() if k != "settings"}
        self.identity = {**self.identity, "shading": own}

    def loss(self, net, rng, size: int):
        net, share = self.seen(unfolded(net)), self.shading.share
        losses = []
        if share < 1:
            inputs, targets = self.batch(rng, size)
            outputs = self.read(net, inputs)
            for name, target in targets.items():
                errors = [o - t for o, t in zip(outputs[name], target, strict=True)]
                squared = self.recipe.settings.loss == "mse"
                total = sum(dr.square(e) if squared else dr.abs(e) for e in errors)
                losses.append((1 - share) * self.weights[name] / (len(errors) * size) * total)
        if share > 0:
            losses.append(share / size * self.shading_errors(net, rng, size))
        return losses

    def shading_errors(self, net, rng, size: int):
        """The error of each of ``size`` samples: of shaded values, the mean over colours; ``net`` as it is seen."""
        recipe, types = self.shading, self.types
        (u, v, level), (wi, wo) = self.places(rng, size), random_directions(rng, types, size)
        truth = reference(recipe.reference, self.pyramid, u, v, level, wi, wo, self.effects, rng)
        dr.eval(u, v, level, wi, wo, truth)
        surface = surface_of(self.pyramid, net.filtered(u, v, level))
        limit = None if recipe.clip is None else recipe.clip * recipe.share / size
        value = shaded(self.decoder, surface, wi, wo, self.effects, limit)
        return self.differences(value, truth)

    def differences(self, value, truth):
        """The error of shaded values, the mean over colours."""
        bounded = _bounded if self.shading.bounded else (lambda x: x)
        errors = [bounded(a) - bounded(b) for a, b in zip(value, truth, strict=True)]
        squared = self.settings.loss == "mse"
        return sum(dr.square(e) if squared else dr.abs(e) for e in errors) / 3

    def places(self, rng, size: int) -> tuple:
        """Random ``(u, v, level)``, uniform in uv; the density of levels falls by :data:`FALL` from one to the next."""
        Float = self.types.Float
        u, v, level = (rng.random(Float, size) for _ in range(3))
        lowest = FALL ** min(len(self.sizes) - 1, TOP)
        return u, v, dr.log(1 - (1 - lowest) * level) * (1 / math.log(FALL))

    def measure(self, net) -> dict[str, float]:
        """PSNR of shaded images against the converged reference and the paper's, entries rounded, and the texture's."""
        texture = super().measure(net)
        if self.evaluation is None:
            return texture
        maps = CompressedTexture(self.pyramid.layout, textures.rounded(unfolded(net)))
        read = reader(maps, self.effects, self.decoder)
        found = self.evaluation.measure(read, flip=False)
        if self.preview is not None:
            write_preview(self.preview, self.evaluation, read)
        shading = {f"shaded_{LETTERS[k]}_db": own["mean_db"] for k, own in found.items()}
        return {**shading, **{f"texture_{name}": value for name, value in texture.items()}}


def _bounded(x):
    """Values up to 1, and beyond it ``1 + log x``, whose slope goes on from there: highlights rule no sum."""
    return dr.select(x > 1, 1 + dr.log(dr.maximum(x, 1)), x)


def start_of(table: Table, pyramid: Pyramid):
    """The arrays of a texture that was trained already, as they are trained further. Raises ``ValueError``."""
    found = CompressedTexture.of(table, pyramid.types.TensorXf, "float32")
    if found.layout != pyramid.layout:
        raise ValueError(f"{table.path}: stores other channels than a training of this source would")
    return found.net


def fit_shading(
    source: Source,
    start,
    recipe: ShadingRecipe,
    request: FitRequest,
    pyramid: Pyramid,
    evaluation: ShadedEvaluation | None = None,
    preview: Path | None = None,
) -> tuple[Table, FitResult]:
    """
    Train the arrays ``start`` (:func:`start_of`) of ``source`` for its shading and return them as a table of the task
    ``texture``, with their errors as a texture and as shaded images of the ``evaluation``, and the run's record. Which
    state is the best, other images of the same form decide; it may be the one that the training started from (settings
    ``kept_start``). ``preview`` is a picture that is written at each measurement.
    """
    request = dataclasses.replace(request, settings=recipe.settings)
    validation = None if evaluation is None else evaluation.another()
    problem = ShadingProblem(start, pyramid, recipe, source.digest, validation)
    first, before = textures.stored_form(start), {} if validation is None else problem.measure(start)
    problem.preview = preview
    result = request.train(problem, "shading")
    kept = any(before[name] > result.measured[name] for name in list(before)[:1])
    identity = {k: v for k, v in problem.identity.items() if k not in ("structure", "border")}
    settings = {**request.recorded(), **identity}
    if request.seconds is not None:
        settings["steps"] = result.steps
    if kept:
        settings["kept_start"] = True
    texture = CompressedTexture(pyramid.layout, first if kept else textures.stored_form(problem.net))
    table = to_table(texture, settings)
    table.preset, table.seed = request.preset, recipe.settings.seed
    found = CompressedTexture.of(table, request.types.TensorXf).measure(source)
    if evaluation is not None:
        shown = evaluation.measure(reader(texture, problem.effects, problem.decoder), flip=False)
        found = {**{f"shaded_{LETTERS[k]}_db": own["mean_db"] for k, own in shown.items()}, **found}
    table.measured = {k: float(f"{v:.5g}") for k, v in found.items()}
    return table, result
