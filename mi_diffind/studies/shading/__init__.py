"""Study ``tradeoff shading``: textures trained for shading at several weights λ of the shading loss.

They are compared with textures trained without it and with classical filters of normals, as in the paper's figure 2.
:mod:`.plan` describes the contenders.
"""

from __future__ import annotations

import argparse

from ...core.arguments import fraction, positive
from ...measure.study import Plan, Study

#: Weights λ of the paper's figure 2.
LAMBDAS = (0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0)


#: Options with a positive number → help.
_NUMBERS = {
    "--seeds": "number of seeds of each training (default: 3; --quick: 1)",
    "--sweep-seeds": "number of seeds for weights other than 0 and the preset's (default: as --seeds)",
    "--seconds": "seconds of training for shading (default: 15; --quick: 1)",
    "--pretrain-seconds": "seconds of training as a texture before (default: 20; --quick: 1)",
    "--steps": "steps of training for shading in place of seconds, independent of the machine's speed; needs "
    "--pretrain-steps",
    "--pretrain-steps": "steps of training as a texture",
    "--side": "texels on a side of generated materials (default: 512; --quick: 64)",
    "--frames": "frames of the zoom (default: 60; --quick: 4)",
}


class ShadingStudy(Study):
    """Quality of shaded images against the weight of the shading loss, with and without its remedies."""

    name = "shading"
    title = "textures trained for their shading, by the weight of that, and classical filters of normals"
    example = "material.json"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "materials", nargs="*", default=[], metavar="MATERIAL.json|NAME",
            help="manifests of maps, or names of generated materials: hammered, weave, lacquer "
            "(default: scenes/assets/tiles.json, if the file exists, and these; --quick: hammered)",
        )  # fmt: skip
        parser.add_argument("--lambda", action="append", type=fraction, dest="lambdas", metavar="X",
                            help="weight of the shading loss; may be repeated; 0 is always among them (default: "
                            "0, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 1; --quick: 0, 0.9)")  # fmt: skip
        for option, text in _NUMBERS.items():
            parser.add_argument(option, type=positive, metavar="N", help=text)
        parser.add_argument("--compression", default="12x", metavar="N",
                            help="compression ratio of all trainings (default: 12x)")  # fmt: skip
        parser.add_argument("--preset", choices=("ours", "paper"), default="ours",
                            help="recipe of the trainings (default: ours); the paper's has no validation")  # fmt: skip
        parser.add_argument("--remedies", choices=("all", "both", "on", "clip"), default="all",
                            help="clipped derivatives and a falling rate: all four combinations, both or none, both "
                            "only, or clipped derivatives with either rate (default: all)")  # fmt: skip

        parser.add_argument("--extras", action="store_true",
                            help="also train arrays with extras beside them, as fit shading --extras auto")  # fmt: skip
        parser.add_argument("--renders", action="append", metavar="FILE.npz",
                            help="measure whole renders of one MATERIAL.json instead, with a file that was trained on "
                            "it; may be repeated")  # fmt: skip

    def check(self, arguments) -> None:
        """Check the options and load the materials; raise as :func:`.load_source` does."""
        from ...core.units import parse_compression
        from .plan import materials_of

        if (arguments.steps is None) != (arguments.pretrain_steps is None):
            raise ValueError("--steps and --pretrain-steps: found one of them, both or none are allowed")
        if arguments.steps and (arguments.seconds or arguments.pretrain_seconds):
            raise ValueError("--steps: found beside seconds, only one of them is allowed")
        if arguments.extras and arguments.preset == "paper":
            raise ValueError("--extras: the arrays of the preset paper have none")
        arguments.ratio = parse_compression(arguments.compression)
        arguments.loaded = materials_of(arguments.materials, arguments.side or (64 if arguments.quick else 512),
                                        arguments.quick)  # fmt: skip
        if arguments.renders:
            from ..texture.plan import tables_of

            if len(arguments.loaded) != 1:
                raise ValueError(f"--renders: found {len(arguments.loaded)} materials, one is needed")
            arguments.tables = tables_of(arguments.renders, *arguments.loaded.values())

    def run(self, arguments):
        """Measure renders if ``--renders`` asks for them."""
        if not arguments.renders:
            return None
        from .renders import RenderSettings, run

        film = {"film": (96, 64), "rounds": 1, "truth": 1, "step_film": (32, 32), "quick": True}
        ((name, source),) = arguments.loaded.items()
        return run(name, source, arguments.tables, RenderSettings(**film if arguments.quick else {}), arguments.out)

    def plan(self, arguments) -> Plan:
        from .plan import REMEDIES, ShadingStudySettings, plan

        quick = arguments.quick
        steps = {"all": slice(None), "both": slice(None, None, 3), "on": slice(1), "clip": slice(None, None, 2)}
        ways = REMEDIES[steps[arguments.remedies]]
        settings = ShadingStudySettings(
            tuple(sorted({0.0, *(arguments.lambdas or ((0.9,) if quick else LAMBDAS))})),
            ways[:: len(ways) - 1] if quick and len(ways) > 1 else ways,
            arguments.seeds or (1 if quick else 3),
            float(arguments.steps or arguments.seconds or (1 if quick else 15)),
            float(arguments.pretrain_steps or arguments.pretrain_seconds or (1 if quick else 20)),
            arguments.ratio,
            arguments.frames or (4 if quick else 60),
            quick,
            "steps" if arguments.steps else "s",
            arguments.sweep_seeds or arguments.seeds or 3,
            arguments.preset,
            arguments.extras,
        )
        return plan(arguments.loaded, settings)


STUDY = ShadingStudy()
