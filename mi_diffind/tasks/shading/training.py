"""Training of task 5: arrays of a texture, trained for their shaded appearance.

The loss is (1 − λ) · texture + λ · shading. The first term is the loss of task 4, in the units of its own recipe. The
second compares shaded values, for views and lights uniform over the hemisphere: the arrays, shaded by frozen tables of
the Disney BRDF, against a reference that shades first and filters afterwards (:mod:`.reference`).
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import drjit as dr

from ...fitting import FitResult, sample_losses
from ...indirection import unfolded
from ...maps.pyramid import Pyramid
from ...maps.source import Source
from ...tables import Table
from ...task import FitRequest
from ..disney.training import random_directions
from ..texture import training as textures
from ..texture.compressed import CompressedTexture, to_table
from ..texture.presets import PRESETS as TEXTURES
from .evaluation import TRUTHS, ShadedEvaluation, reader
from .material import effects_of, frozen_decoder, shaded, surface_of
from .presets import ShadingRecipe
from .preview import write_preview
from .reference import reference

#: Factor of the number of shaded samples from one level to the next coarser one, and the last level that it counts for.
FALL, TOP = 0.7, 9


class ShadingProblem(textures.TextureProblem):
    """Training problem of shaded appearance.

    ``net`` reads the stored channels, ``pyramid`` is the truth of the maps. The images of ``evaluation`` decide which
    state is the best (``None``: the PSNR of the texture decides).
    """

    #: Tolerance of the PSNR of shaded images, dB.
    tolerance = 0.02

    def __init__(
        self, net, pyramid: Pyramid, recipe: ShadingRecipe, digest: str = "", evaluation: ShadedEvaluation | None = None
    ):
        super().__init__(net, pyramid, TEXTURES[recipe.texture], digest)
        self.shading, self.evaluation = recipe, evaluation
        self.preview: Path | None = None
        self.effects, _ = effects_of(pyramid.layout)
        self.decoder = frozen_decoder(self.types)
        recorded = {k: v for k, v in dataclasses.asdict(recipe).items() if k != "settings"}
        self.identity = {**self.identity, "shading": recorded}

    def loss(self, net, rng, size: int):
        net, share = self.seen(unfolded(net)), self.shading.share
        losses = []
        if share < 1:
            inputs, targets = self.batch(rng, size)
            weights = {name: (1 - share) * weight for name, weight in self.weights.items()}
            losses += sample_losses(self.read(net, inputs), targets, weights, size, self.recipe.settings.loss)
        if share > 0:
            losses.append(share / size * self.shading_errors(net, rng, size))
        return losses

    def shading_errors(self, net, rng, size: int):
        """Return the error of ``size`` shaded samples, the mean over colours; ``net`` is as training sees it."""
        recipe, types = self.shading, self.types
        (u, v, level), (wi, wo) = self.places(rng, size), random_directions(rng, types, size)
        truth = reference(recipe.reference, self.pyramid, u, v, level, wi, wo, self.effects, rng)
        dr.eval(u, v, level, wi, wo, truth)
        surface = surface_of(self.pyramid, net.filtered(u, v, level))
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
        """Return the PSNR of shaded images, entries rounded, against both references, and the PSNR of the texture."""
        texture = super().measure(net)
        if self.evaluation is None:
            return texture
        maps = CompressedTexture(self.pyramid.layout, textures.rounded(unfolded(net)))
        read = reader(maps, self.effects, self.decoder)
        if self.preview is not None:
            write_preview(self.preview, self.evaluation, read)
        shading = {f"shaded_{TRUTHS[k]}_db": f["mean_db"] for k, f in self.evaluation.measure(read, False).items()}
        return {**shading, **{f"texture_{name}": value for name, value in texture.items()}}


def _bounded(x):
    """Return values up to 1 unchanged, and ``1 + log x`` above: a rare highlight cannot dominate the loss."""
    return dr.select(x > 1, 1 + dr.log(dr.maximum(x, 1)), x)


def start_of(table: Table, pyramid: Pyramid):
    """Return the arrays of a trained texture for further training. Raises ``ValueError`` for other channels."""
    texture = CompressedTexture.of(table, pyramid.types.TensorXf, "float32")
    if texture.layout != pyramid.layout:
        raise ValueError(f"{table.path}: stores other channels than a training of this source would")
    return texture.net


def fit_shading(
    source: Source,
    start,
    recipe: ShadingRecipe,
    request: FitRequest,
    pyramid: Pyramid,
    evaluation: ShadedEvaluation | None = None,
    preview: Path | None = None,
) -> tuple[Table, FitResult]:
    """Train the arrays ``start`` (:func:`start_of`) of ``source`` for shading; return its table and the run's record.

    The table is of the task ``texture``, with its errors as a texture and as shaded images of the ``evaluation``. The
    best state is chosen by other images of the same form; it may be the start (settings ``kept_start``). The settings
    ``before`` are the errors of the start as shaded images. ``preview`` is a picture that is written at each
    measurement.
    """
    request = dataclasses.replace(request, settings=recipe.settings)
    validation = None if evaluation is None else evaluation.another()
    problem = ShadingProblem(start, pyramid, recipe, source.digest, validation)
    first, before = textures.stored_form(start), {}
    if validation is not None:
        # The measurement of the result takes as long
        begin = request.deadline.rehearse if request.deadline is not None else lambda measure: measure()
        before = begin(lambda: problem.measure(start))
    problem.preview = preview
    result = request.train(problem, "shading")
    kept = any(before[name] > result.measured[name] for name in list(before)[:1])
    identity = {k: v for k, v in problem.identity.items() if k not in ("structure", "border")}
    settings = {**request.recorded(result), **identity}
    if kept:
        settings["kept_start"] = True
    texture = CompressedTexture(pyramid.layout, first if kept else textures.stored_form(problem.net))
    table = to_table(texture, settings)
    table.preset, table.seed = request.preset, recipe.settings.seed
    errors = CompressedTexture.of(table, request.types.TensorXf).measure(source)
    if evaluation is not None:
        start_texture = CompressedTexture(pyramid.layout, first)
        both = (
            evaluation.measure(reader(t, problem.effects, problem.decoder), False) for t in (start_texture, texture)
        )
        before, after = ({f"shaded_{TRUTHS[k]}_db": f["mean_db"] for k, f in shown.items()} for shown in both)
        table.settings["before"] = {name: float(f"{value:.5g}") for name, value in before.items()}
        errors = {**after, **errors}
    table.measured = {k: float(f"{v:.5g}") for k, v in errors.items()}
    return table, result
