"""Training problem of a scene: (1 − λ) · loss of the texture + λ · difference between renders and references.

*Unbiased.* The derivative of a squared error is 2 (I − R) ∂I, a product of two random numbers if I is a render of few
samples. The product is right on average only if both are independent: the value I comes from one set of samples, its
derivative ∂I from another (``seed`` and ``seed_grad`` of ``mi.render``), and the reference R from a third. The result
equals the loss (I₁ − R)(I₂ − R) of two renders, at the price of one derivative. An absolute error, and an error beyond
the bound, contributes its sign, which follows the median of noisy pixels rather than their mean. In return, no pixel (a
highlight on metal, a firefly) has a larger gradient than the bound. A component of a BSDF in a scene has no gradient of
its own that could be clipped; the image has.
"""

import dataclasses
import math
import statistics
from collections.abc import Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...arrays.indirection import unfolded
from ...core.files import replacing
from ...fitting.loop import Problem, cores
from ...images import srgb
from ...maps.pyramid import decibel
from ...tasks.texture.appearance import titled
from ...tasks.texture.training import TextureProblem, rounded
from .options import FOOTPRINTS, SceneRecipe, View
from .references import SEEDS
from .trained_scene import JointProblem, TrainedScene

#: Share of the references' pixels that may be brighter than white.
BRIGHTER = 0.05

#: Samples of each half of a measured render during the training, if :data:`MOST_MEASURED` a pixel are not fewer.
MEASURED = 2**14

#: Largest number of samples per pixel of each half of a measured render during the training.
MOST_MEASURED = 16

#: Samples of a measurement before and after the training for each of one during the training. Noisy values that are
#: clipped make errors look smaller, by the same amount for all states, but in a figure that is printed.
FINER = 8

#: Loss of the PSNR at any footprint, in dB, up to which a state that gains in the mean is better than the start.
LOSS = 0.1

#: Factor by which differences are amplified in the preview.
SHOWN = 4


def product_error(halves: Sequence[np.ndarray], references: Sequence[np.ndarray]) -> float:
    """Return the mean squared error of an image in [0, 1], of which there are two halves, as of its reference.

    The errors of the halves are multiplied, so that the noise of neither image counts. The mean of clipped values is
    not the clipped mean: halves are clipped where their mean is, which is out of [0, 1] by noise in fewer pixels.
    """

    def clip(pair) -> list[np.ndarray]:
        mean = np.mean(pair, axis=0)
        inside = (mean > 0) & (mean < 1)
        return [np.clip(mean, 0, 1) + inside * (half - mean) for half in pair]

    a, b = (image - truth for image, truth in zip(clip(halves), clip(references), strict=True))
    return float(np.mean(a * b, dtype=np.float64))


def estimate_exposure(references: Sequence[np.ndarray]) -> float:
    """Return the factor that maps to 1 the channel value that :data:`BRIGHTER` of the pixels exceed (1 if black)."""
    brightest = np.concatenate([image.max(axis=2).ravel() for image in references])
    white = float(np.quantile(brightest, 1 - BRIGHTER))
    return 1 / white if white > 0 else 1.0


class SceneProblem(Problem):
    """Training problem (:mod:`mi_diffind.fitting.loop`) of a texture in a scene.

    ``texture`` is the problem of the same arrays without a scene, of one texture or several, whose ``net`` is trained;
    ``scene`` reads the arrays. ``trained`` and ``measured`` are pairs of a view and both halves of its reference,
    ``(2, height, width, channels)``. ``preview`` is a picture of the first measured view, written at each measurement:
    reference | render | :data:`SHOWN` times their difference.
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
        images = [halves.mean(axis=0) for _, halves in (*trained, *measured)]
        self.exposure = recipe.exposure or estimate_exposure(images)
        self.views = [view for view, _ in trained]
        self.references = [mi.TensorXf(self.exposure * image) for image in images[: len(trained)]]
        self.measured = [(view, self.exposure * halves) for view, halves in measured]
        #: Trained and measured footprints, in samples a pixel.
        self.footprints = [factor * recipe.spp for factor in FOOTPRINTS]
        pixels = math.prod(self.references[0].shape[:2])
        recorded = {k: v for k, v in dataclasses.asdict(recipe).items() if k != "settings"}
        recorded["footprints"] = self.footprints
        #: Samples per pixel of each half of a measured render.
        self.samples = max(recipe.spp, min(MOST_MEASURED, MEASURED // pixels))
        #: Samples per pixel of a trained render.
        self.drawn = max(recipe.spp, math.ceil(recipe.samples / pixels))
        #: What the settings of all trained files have in common.
        self.common = {"scene": digest, "shading": recorded, "exposure": self.exposure}
        self.identity = {**texture.identity, **self.common}
        self._view, self._footprint = 0, recipe.spp

    def begin(self, step: int, share: float) -> str:
        """Choose the view of a step: each once per round, in a new random order each round, and its footprints.

        A view has the next footprints in the next round.
        """
        texture_step, n = self.texture.begin(step, share), len(self.views)
        order = np.random.default_rng((self.settings.seed, 2, step // n)).permutation(n)
        self._view = int(order[step % n])
        self._footprint = self.footprints[(self._view + step // n) % len(self.footprints)]
        return f"{texture_step}, view {self._view}, footprints of {self._footprint} samples"

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
        self.scene.place(self.views[self._view], self._footprint)
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
        """Return the PSNR of renders of the measured views, with rounded entries, and the PSNR of the texture.

        ``psnr_db`` is the mean of ``psnr_N_spp_db``, those with the footprints of N samples a pixel, of which the first
        are as renders have them. The noise of renders and references does not count (:func:`product_error`).
        """
        figures = {}
        with dr.suspend_grad():
            self.scene.hold(rounded(unfolded(net)))
            for spp in self.footprints:
                errors = []
                for i, (view, references) in enumerate(self.measured):
                    self.scene.place(view, spp)
                    seeds = (dr.opaque(mi.UInt32, SEEDS - 1 - number) for number in (2 * i, 2 * i + 1))
                    halves = [self.scene.render(seed, seed + SEEDS, self.samples).numpy() for seed in seeds]
                    halves = [self.exposure * np.nan_to_num(half) for half in halves]
                    errors.append(product_error(halves, references))
                    if i == 0 and spp == self.footprints[0] and self.preview is not None:
                        self._write(references.mean(axis=0), sum(halves) / 2)
                figures[f"psnr_{spp}_spp_db"] = decibel(float(np.mean(errors)))
            texture = self.texture.measure(net)
        mean = statistics.fmean(figures.values())
        return {"psnr_db": mean, **figures, **{f"texture_{name}": value for name, value in texture.items()}}

    def measure_finely(self, factor: int = FINER) -> dict[str, float]:
        """Return :meth:`measure` of the current state with ``factor`` times as many samples."""
        samples, self.samples = self.samples, factor * self.samples
        try:
            with cores(self.recipe.settings.deterministic):
                return self.measure(self.net)
        finally:
            self.samples = samples

    def gains(self, before: dict[str, float], after: dict[str, float]) -> bool:
        """Return whether figures are better than those ``before``: in the mean, with a :data:`LOSS` at no footprint."""
        losses = [before[name] - after[name] for name in (f"psnr_{spp}_spp_db" for spp in self.footprints)]
        return after["psnr_db"] > before["psnr_db"] and max(losses) <= LOSS

    def _write(self, reference: np.ndarray, image: np.ndarray) -> None:
        difference = SHOWN * np.abs(image - reference)
        picture = srgb.for_display(np.concatenate([reference, image, difference], axis=1))
        picture = titled(picture, ("reference", "render", f"{SHOWN}x difference"))
        with replacing(self.preview) as temporary:
            mi.Bitmap(np.ascontiguousarray(picture)).write(str(temporary))
