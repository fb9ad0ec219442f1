"""Textures that are trained for their shaded appearance, not for their values (task 5), and recipes of their fits.

The truth is filtered appearance: the analytic Disney BRDF of task 2, averaged over footprints. The arrays are those of
task 4, shaded by frozen tables of task 2; the result is a file of the task ``texture``. Training through renders of a
scene is :mod:`mi_diffind.scenes.training`.

The training is :mod:`mi_diffind.tasks.texture.shading`; :mod:`.fit`: the command ``fit shading``.
"""

from __future__ import annotations

import math

from ...core.arguments import Argument, fraction, positive_or_none
from ...fitting.task import Task
from ...maps.arguments import LEVEL_BIAS, PREVIEW, SIZES, SOURCES
from ..texture import REFERENCES
from ..texture import SHADING_PRESETS as PRESETS


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
