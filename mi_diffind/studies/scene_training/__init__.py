"""Study ``tradeoff scene-training``: training inside a scene against training for shading over the hemisphere.

:mod:`.plan` describes scenes, runs and errors.
"""

from __future__ import annotations

import argparse

from ...core.arguments import fraction, positive
from ...measure.study import Plan, Study
from ..equal_memory import add_without_option, check_without
from .conclusions import WAYS


class SceneTrainingStudy(Study):
    """Errors of renders of held-out views and lights, after trainings from the same start."""

    name = "scene-training"
    title = "textures trained inside a scene, and over the hemisphere for the same seconds"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("scenes", nargs="*", metavar="SCENE.xml",
                            help="scenes that read one compressed material, seen as training_balls is "
                            "unless it ships (default: scenes/training_*.xml; --quick: the first)")  # fmt: skip
        parser.add_argument(
            "--lambda",
            action="append",
            type=fraction,
            dest="lambdas",
            metavar="X",
            help="weight of the loss of renders; may be repeated (default: 0.5, 0.9, 1; --quick: 0.9)",
        )
        parser.add_argument(
            "--spp",
            action="append",
            type=positive,
            dest="counts",
            metavar="N",
            help="samples a pixel of trainings; may be repeated (default: 1, 4; --quick: 1)",
        )
        parser.add_argument("--steps", type=positive, metavar="N",
                            help="steps of each training inside a scene (default: 400; --quick: 2)")  # fmt: skip
        parser.add_argument("--width", type=positive, metavar="N",
                            help="pixels of a row of renders (default: 96; --quick: 16)")  # fmt: skip
        add_without_option(parser)

    def check(self, arguments) -> None:
        """Check that the scenes and the runs to leave out exist."""
        from .plan import scenes_of

        check_without(arguments.without, WAYS)
        arguments.paths = scenes_of(arguments.scenes, arguments.quick)

    def plan(self, arguments) -> Plan:
        from .plan import SceneTrainingSettings, plan

        settings = SceneTrainingSettings.quick() if arguments.quick else SceneTrainingSettings()
        lambdas = tuple(sorted(set(arguments.lambdas or settings.lambdas)))
        counts = tuple(sorted(set(arguments.counts or settings.counts)))
        changed = {
            "lambdas": lambdas,
            "counts": counts,
            "steps": arguments.steps or settings.steps,
            "width": arguments.width or settings.width,
        }
        return plan(arguments.paths, settings.changed(**changed), arguments.without)


STUDY = SceneTrainingStudy()
