"""Study ``tradeoff scene``: error against render time of a scene, as written and with exact plugins.

Monte Carlo noise decreases with render time, the bias of learned tables does not; the study measures both and the
sample count at which they are equal (:mod:`~mi_diffind.measure.bias`).
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ...core.arguments import natural, positive
from ...measure.study import Study

if TYPE_CHECKING:
    from ...measure.study import Tradeoff


class SceneStudy(Study):
    """The error of a scene's image against render time, with learned and with exact plugins."""

    name = "scene"
    title = "a scene, learned and exact, at several sample counts"
    example = "scene.xml --spp 64"
    of_scene = True

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--spp", type=positive, help="most samples per pixel (default: the scene's; --quick: at most 4)"
        )
        parser.add_argument("--seed", type=natural, default=0, help="seed of the random numbers (default: 0)")

    def run(self, arguments) -> Tradeoff:
        from ...measure.report import publish
        from . import renders, report

        settings = renders.SceneStudySettings.choose(arguments.quick, arguments.spp)
        result = renders.measure(arguments.scene, settings, arguments.out, arguments.seed, arguments.defines)
        return publish(result, report.write(result, arguments.out), report.summary(result))


STUDY = SceneStudy()
