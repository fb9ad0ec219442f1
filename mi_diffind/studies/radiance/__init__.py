"""``tradeoff field``: the radiance field of a capture in equal bytes, ours against grids, codebooks, planes and others.

The study measures errors in held-out views and the times of reads and renders (:mod:`.plan`).
"""

from __future__ import annotations

import argparse

from ...measure.study import Plan, Study
from ..equal_memory import add_without_option, check_without

#: Default budgets, as compression against a dense float32 grid. At the first one, all methods are trained and timed.
RATIOS = (75.0, 50.0, 200.0)

#: Default folder of the capture, and the scene that it is made from.
DEFAULT, SCENE = "captures/group", "scenes/capture_group.xml"


class RadianceStudy(Study):
    """Study of radiance fields in equal bytes: errors in held-out views, and the times of reads and renders."""

    name = "field"
    title = "the radiance field of a capture, in equal bytes, views, reads and renders"
    example = "views"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default=DEFAULT, metavar="FOLDER",
            help=f"folder of views, as mi-diffind capture writes it (default: {DEFAULT})",
        )  # fmt: skip
        parser.add_argument(
            "--compression", action="append", default=[], metavar="N",
            help="compression against a dense float32 grid; may be repeated (default: "
            f"{', '.join(f'{r:g}' for r in RATIOS)}; --quick: 75); all methods are trained and timed at the first one",
        )  # fmt: skip
        add_without_option(parser)
        parser.add_argument(
            "--resolution", type=int, default=0, metavar="N",
            help="nodes along the side of a cube of the same volume, of the initial grid (default: 128; --quick: 24)",
        )  # fmt: skip
        parser.add_argument(
            "--steps", type=int, default=0, metavar="N", help="steps of each training through the images (default: 500)"
        )
        parser.add_argument(
            "--seconds", type=float, default=0.0, metavar="S",
            help="seconds of each training of planes and of the network, whose steps take long (default: 90)",
        )  # fmt: skip

    def check(self, arguments) -> None:
        """Check the options and read the views; raise :class:`~mi_diffind.tasks.radiance.views.ViewsError`."""
        from pathlib import Path

        from ...core.units import parse_compression
        from ...tasks.radiance.views import load_views
        from .plan import KINDS

        default = ("75",) if arguments.quick else map(str, RATIOS)
        arguments.ratios = tuple(dict.fromkeys(map(parse_compression, arguments.compression or default)))
        check_without(arguments.without, KINDS)
        for name, least in (("resolution", 8), ("steps", 2)):
            value = getattr(arguments, name)
            if value and value < least:
                raise ValueError(f"--{name}: found {value}, at least {least} is needed")
        if not 0 <= arguments.seconds < float("inf"):
            raise ValueError(f"--seconds: found {arguments.seconds:g}, allowed are numbers that are not negative")
        if arguments.source == DEFAULT and not Path(DEFAULT).exists():
            raise ValueError(f'there is no folder "{DEFAULT}": make it by mi-diffind capture {SCENE} -o {DEFAULT}')
        arguments.views = tuple(load_views(arguments.source, split) for split in ("train", "test"))

    def plan(self, arguments) -> Plan:
        import mitsuba as mi

        from ...core.runtime import array_module
        from ...tasks.radiance.session import FieldSession
        from .plan import RadianceStudySettings, plan

        quick = arguments.quick
        settings = RadianceStudySettings(
            ratios=arguments.ratios,
            without=tuple(arguments.without),
            resolution=arguments.resolution or (24 if quick else 128),
            grid_steps=60 if quick else 0,
            steps=arguments.steps or (40 if quick else 500),
            seconds=arguments.seconds or (3.0 if quick else 90.0),
            film=48 if quick else 200,
        )
        session = FieldSession(array_module(mi.variant()), *arguments.views)
        return plan(session, arguments.source, settings)


STUDY = RadianceStudy()
