"""
``tradeoff field``: the radiance field of a capture in equal bytes, ours beside grids, codebooks, planes, the
supplement's arrays and a hash grid with a network: views, reads and renders. :mod:`.candidates` says more.
"""

from __future__ import annotations

import argparse

from ...measure.study import Plan, Study
from ..equal_memory import add_without_option, check_without

#: What is asked for unless something else is: how many times smaller than a dense grid of float32. At the first one all
#: kinds are made, and reads and renders are timed.
RATIOS = (75.0, 50.0, 200.0)

#: Where the capture is that is looked for, and how it is made.
DEFAULT, SCENE = "captures/group", "scenes/capture_group.xml"


class FieldStudy(Study):
    """A radiance field in equal bytes: how views look that it was not trained by, and the time of reads and renders."""

    name = "field"
    title = "the radiance field of a capture, in equal bytes, views, reads and renders"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default=DEFAULT, metavar="FOLDER",
            help=f"views, as mi-diffind capture writes them (default: {DEFAULT})",
        )  # fmt: skip
        parser.add_argument(
            "--compression", action="append", default=[], metavar="N",
            help="how many times smaller than a dense grid of float32; may be repeated (default: "
            f"{', '.join(f'{r:g}' for r in RATIOS)}; --quick: 75); all kinds are made and timed at the first one",
        )  # fmt: skip
        add_without_option(parser)
        parser.add_argument(
            "--resolution", type=int, default=0, metavar="N",
            help="nodes of the grid that all begin with, of a cube of the same volume (default: 128; --quick: 24)",
        )  # fmt: skip
        parser.add_argument(
            "--steps", type=int, default=0, metavar="N", help="of each training through the images (default: 500)"
        )

    def check(self, arguments) -> None:
        """Also reads the views; raises :class:`~mi_diffind.tasks.radiance.views.ViewsError`."""
        from pathlib import Path

        from ...tasks.radiance.views import load_views
        from ...units import parse_compression
        from .plan import KINDS

        default = ("75",) if arguments.quick else map(str, RATIOS)
        arguments.ratios = tuple(dict.fromkeys(map(parse_compression, arguments.compression or default)))
        check_without(arguments.without, KINDS)
        for name, least in (("resolution", 8), ("steps", 2)):
            value = getattr(arguments, name)
            if value and value < least:
                raise ValueError(f"--{name}: found {value}, at least {least} is needed")
        if arguments.source == DEFAULT and not Path(DEFAULT).exists():
            raise ValueError(f'there is no folder "{DEFAULT}": make it by mi-diffind capture {SCENE} -o {DEFAULT}')
        arguments.views = tuple(load_views(arguments.source, split) for split in ("train", "test"))

    def plan(self, arguments) -> Plan:
        from .plan import Request, plan

        quick = arguments.quick
        request = Request(
            ratios=arguments.ratios,
            without=tuple(arguments.without),
            resolution=arguments.resolution or (24 if quick else 128),
            grid_steps=60 if quick else 0,
            steps=arguments.steps or (40 if quick else 500),
            seconds=3.0 if quick else 90.0,
            film=48 if quick else 200,
        )
        return plan(*arguments.views, arguments.source, request)


STUDY = FieldStudy()
