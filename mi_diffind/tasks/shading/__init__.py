"""Textures that are trained for their shaded appearance, not for their values (task 5), and recipes of their fits.

The truth is filtered appearance: the analytic Disney BRDF of task 2, averaged over footprints. The arrays are those of
task 4, shaded by frozen tables of task 2; the result is a file of the task ``texture``. Training through renders of a
scene is :mod:`mi_diffind.scenes.training`.

:mod:`.material`: maps as parameters of the BRDF, and shading; :mod:`.evaluation`: references, images that measure, and
a preview; :mod:`.training`: the training problem; :mod:`.fit`: the command ``fit shading``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from ...core.arguments import Argument, fraction, positive_or_none
from ...fitting.task import FitSettings, Task
from ...maps.arguments import LEVEL_BIAS, PREVIEW, SIZES, SOURCES

#: Sample patterns of the reference (:data:`.evaluation.SAMPLES_PER_SIDE`).
REFERENCES = ("jittered", "prefiltered", "converged")


@dataclass(frozen=True)
class ShadingSettings(FitSettings):
    """Training for shaded appearance, which starts from a trained texture; the defaults are those of ``ours``.

    ``share``: λ, the share of the loss of shaded values. ``clip``: bound of the derivatives of a sample's error through
    the specular lobe (``None``: unlimited). ``reference``: sample pattern of the reference. ``bounded``: whether values
    above 1 are compared in log space. ``level_bias``: levels by which a footprint's level of detail is read finer
    (negative), stored in the file (``None``: chosen by images). ``extras``: whether the shape and weight of the
    specular lobe are tried as coarse extras, which ``neural_material`` alone reads. ``fixed``: whether the
    entries that fine levels read keep their values. ``beta_2``: Adam's decay of squared gradients; highlights are rare,
    and with 0.999 single ones tilt normals of glossy, flat pages by degrees. ``texture``: preset of task 4, which
    trains the start unless one is given, and defines the samples and the loss of the texture; ``loss`` is that of
    shaded values.
    """

    steps: int = 1500
    batch: int = 2**16
    lr: float = 5e-3
    loss: str = "mse"
    measure_every: int = 150
    share: float = 0.9
    clip: float | None = 1.0
    reference: str = "jittered"
    bounded: bool = True
    level_bias: float | None = None
    extras: bool = False
    fixed: bool = False
    beta_2: float = 0.99
    texture: str = "ours"


#: The first is the default. The paper's λ is 0.1 or 0.25, by its scene.
PRESETS = {
    "ours": ShadingSettings(),
    "paper": ShadingSettings(
        lr=1e-3, schedule="constant", loss="mae", share=0.25, clip=0.1, reference="prefiltered", bounded=False,
        level_bias=0.0, beta_2=0.999, texture="paper",
    ),
}  # fmt: skip


class Shading(Task):
    """Task ``shading``: presets are :data:`PRESETS`, files are those of the task ``texture``."""

    name = "shading"
    title = "a texture, for what it looks like when it is shaded"
    section = "supplemental 1.5"
    example = "material.json --compression 12x"
    presets = PRESETS
    storages = ()
    measurements = 10
    arguments = (
        Argument(
            "source", file="read", metavar="MATERIAL.json", help="a manifest of the maps of a material",
        ),
        *(size for size in SIZES if size.name != "psnr"),
        Argument(
            "--start", file="read", metavar="FILE.npz",
            help="arrays to start from, as written by fit texture (default: trained in two fifths of --seconds)",
        ),
        Argument(
            "--lambda", dest="share", type=fraction, metavar="L",
            help="share of the loss of shaded values, 0 to 1 "
            f"(default: {', '.join(f'{r.share} for {name}' for name, r in PRESETS.items())})",
        ),
        Argument(
            "--clip", type=positive_or_none, metavar="X",
            help="bound of the derivatives of a sample's error through the specular lobe, or none "
            f"(default: {', '.join(f'{r.clip:g} for {name}' for name, r in PRESETS.items())})",
        ),
        Argument(
            "--reference", choices=REFERENCES,
            help="samples of the reference: 16 unfiltered ones (jittered, default), the paper's 16 "
            "prefiltered ones (default of paper), or 256 unfiltered ones (converged)",
        ),
        LEVEL_BIAS,
        Argument(
            "--extras", choices=("auto", "off"), default="off",
            help="shape and weight of the highlight in coarse grids beside the maps, read by neural_material alone; "
            "auto keeps them if shaded images gain (default: off)",
        ),
        *SOURCES,
        PREVIEW,
    )  # fmt: skip

    def settings(self, preset, given, options):
        chosen = {name: options[name] for name in ("share", "clip", "reference", "level_bias")}
        chosen = {name: value for name, value in chosen.items() if value is not None}
        # Words and numbers that stand for None: a chosen bias, no bound
        chosen |= {name: None for name, value in chosen.items() if value in ("auto", math.inf)}
        return self.change_settings(PRESETS[preset], {**chosen, "extras": options["extras"] == "auto", **given})


TASK = Shading()
