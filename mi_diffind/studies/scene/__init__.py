"""
Noise or bias? A scene as written and with exact plugins, at several sample counts: error against render time.

``mi-diffind tradeoff scene SCENE.xml`` answers what an approximation means for a picture: the noise of its samples
becomes smaller with time, the bias of learned tables does not (:mod:`~mi_diffind.measure.bias`).
"""

from __future__ import annotations

import argparse

from ...arguments import natural, positive
from ...measure.study import Study


class SceneStudy(Study):
    """The error of a scene's image against render time, with learned and with exact plugins."""

    name = "scene"
    title = "a scene, learned and exact, at several sample counts"
    of_scene = True

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--spp", type=positive, help="most samples per pixel (default: the scene's; --quick: at most 4)"
        )
        parser.add_argument("--seed", type=natural, default=0, help="seed of the random numbers (default: 0)")

    def run(self, arguments) -> dict:
        from ...measure.report import publish
        from . import renders, report

        settings = renders.Settings.choose(arguments.quick, arguments.spp)
        result = renders.measure(arguments.scene, settings, arguments.out, arguments.seed, arguments.defines)
        return publish(result, report.write(result, arguments.out), report.summary(result))


STUDY = SceneStudy()
