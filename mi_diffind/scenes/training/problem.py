"""Training problem of a scene: (1 − λ) · loss of the texture + λ · difference between renders and references.

*Unbiased.* The derivative of a squared error is 2 (I − R) ∂I, a product of two random numbers if I is a render of few
samples. The product is right on average only if both are independent: the value I comes from one set of samples, its
derivative ∂I from another (``seed`` and ``seed_grad`` of ``mi.render``), and the reference R from a third. The result
equals the loss (I₁ − R)(I₂ − R) of two renders, at the price of one derivative. An absolute error, and an error beyond
the bound, contributes its sign, which follows the median of noisy pixels rather than their mean. In return, no pixel (a
highlight on metal, a firefly) has a larger gradient than the bound. A component of a BSDF in a scene has no gradient of
its own that could be clipped; the image has.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays.indirection import unfolded
from ...core.files import replacing
from ...fitting.loop import Problem
from ...images import srgb
from ...tasks.texture.appearance import titled
from ...tasks.texture.training import TextureProblem, rounded
from .options import SceneRecipe, View
from .references import SEEDS
from .trained_scene import JointProblem, TrainedScene

#: Share of the references' pixels that may be brighter than white.
BRIGHTER = 0.05

#: Smallest number of samples per pixel of a measured render, in two halves.
MEASURED = 16

#: Factor by which differences are amplified in the preview.
SHOWN = 4


def estimate_exposure(references: Sequence[np.ndarray]) -> float:
    """Return the factor that maps to 1 the channel value that :data:`BRIGHTER` of the pixels exceed (1 if black)."""
    brightest = np.concatenate([image.max(axis=2).ravel() for image in references])
    white = float(np.quantile(brightest, 1 - BRIGHTER))
    return 1 / white if white > 0 else 1.0


class SceneProblem(Problem):
    """Training problem (:mod:`mi_diffind.fitting.loop`) of a texture in a scene.

    ``texture`` is the problem of the same arrays without a scene, of one texture or several, whose ``net`` is trained;
    ``scene`` reads the arrays. ``trained`` and ``measured`` are pairs of a view and its reference, ``(height, width,
    channels)``. ``preview`` is a picture of the first measured view, written at each measurement: reference | render |
    :data:`SHOWN` times their difference.
    """

    #: Tolerance of the PSNR of renders, dB.
    tolerance = 0.02

    def __init__(
        self,
        texture: TextureProblem | JointProblem,
        scene: TrainedScene,
        trained: Sequence[tuple[View, np.ndarray]],
        measured: Sequence[tuple[View, np.ndarray]],
        recipe: SceneRecipe,
        digest: str = "",
        preview: Path | None = None,
    ):
        self.net, self.texture, self.scene, self.recipe, self.preview = texture.net, texture, scene, recipe, preview
        self.exposure = recipe.exposure or estimate_exposure([image for _, image in trained])
        self.views = [view for view, _ in trained]
        self.references = [mi.TensorXf(np.ascontiguousarray(self.exposure * image)) for _, image in trained]
        self.measured = [(view, self.exposure * image) for view, image in measured]
        recorded = {k: v for k, v in dataclasses.asdict(recipe).items() if k != "settings"}
        #: Samples per pixel of each half of a measured render.
        self.samples = max(MEASURED // 2, scene.spp)
        #: Samples per pixel of a trained render.
        self.drawn = max(scene.spp, math.ceil(recipe.samples / math.prod(self.references[0].shape[:2])))
        #: What the settings of all trained files have in common.
        self.common = {"scene": digest, "shading": recorded, "exposure": self.exposure}
        self.identity = {**texture.identity, **self.common}
        self._view = 0

    def begin(self, step: int, share: float) -> str:
        """Choose the view of a step: each once per round, in a new random order each round."""
        texture_step, n = self.texture.begin(step, share), len(self.views)
        order = np.random.default_rng((self.settings.seed, 2, step // n)).permutation(n)
        self._view = int(order[step % n])
        return f"{texture_step}, view {self._view}"

    def loss(self, net, rng, size: int):
        share, losses = self.recipe.share, []
        if share < 1:
            losses += [(1 - share) * values for values in self.texture.loss(net, rng, size)]
        if share > 0:
            losses.append(share * self.image_loss(net, rng))
        return losses

    def image_loss(self, net, rng):
        """Return the loss of the render of the step's view: one value for each pixel and channel, to be summed."""
        seeds = rng.integers(mi.UInt32, 2, 0, SEEDS - 1)
        value, derivative = (dr.gather(mi.UInt32, seeds, i) for i in range(2))
        self.scene.hold(self.texture.seen(unfolded(net)))
        self.scene.place(self.views[self._view])
        error = self.exposure * self.scene.render(value, derivative, self.drawn) - self.references[self._view]
        return self.errors(error.array) * (1 / math.prod(error.shape))

    def errors(self, error):
        """Return absolute or squared errors (``settings.loss``); squares continue linearly beyond the bound."""
        size, bound = dr.abs(error), self.recipe.bound
        if self.settings.loss == "mae":
            return size
        if bound is None:
            return dr.square(error)
        return dr.select(size < bound, dr.square(error), bound * (2 * size - bound))

    def measure(self, net) -> dict[str, float]:
        """Return ``psnr_db`` of renders of the measured views, with rounded entries, and the PSNR of the texture.

        Values are clipped to [0, 1]. The errors of two halves of the samples are multiplied, so that their variance
        does not count.
        """
        with dr.suspend_grad():
            self.scene.hold(rounded(unfolded(net)))
            errors = []
            for i, (view, reference) in enumerate(self.measured):
                self.scene.place(view)
                seeds = (dr.opaque(mi.UInt32, SEEDS - 1 - number) for number in (2 * i, 2 * i + 1))
                halves = (self.scene.render(seed, seed + SEEDS, self.samples).numpy() for seed in seeds)
                a, b = (self.exposure * np.nan_to_num(half) for half in halves)
                truth = np.clip(reference, 0, 1)
                errors.append(float(np.mean((np.clip(a, 0, 1) - truth) * (np.clip(b, 0, 1) - truth), dtype=np.float64)))
                if i == 0 and self.preview is not None:
                    self._write(reference, (a + b) / 2)
            texture = self.texture.measure(net)
        decibels = -10 * math.log10(max(float(np.mean(errors)), 1e-12))
        return {"psnr_db": decibels, **{f"texture_{name}": value for name, value in texture.items()}}

    def _write(self, reference: np.ndarray, image: np.ndarray) -> None:
        difference = SHOWN * np.abs(image - reference)
        picture = srgb.for_display(np.concatenate([reference, image, difference], axis=1))
        picture = titled(picture, ("reference", "render", f"{SHOWN}x difference"))
        with replacing(self.preview) as temporary:
            mi.Bitmap(np.ascontiguousarray(picture)).write(str(temporary))
