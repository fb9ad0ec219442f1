"""Study ``tradeoff image``: quality of a compressed image or material against bytes, seconds of training and read time.

Codecs encode the same maps in the same bytes. :mod:`.plan` describes the contenders.
"""

from __future__ import annotations

import argparse

from ...core.arguments import positive
from ...measure.study import Plan, Study
from ..maps import add_astc_option

#: Options that may be repeated → help, type, choices.
_REPEATED = {
    "--compression": ("compression ratio, such as 12x (default)", str, None),
    "--seconds": ("seconds of each training by our preset (default: 60; --quick: 2)", positive, None),
    "--paper-seconds": ("seconds of each by the paper's preset (default: the longest of --seconds)", positive, None),
    "--dims": ("dimensions of the cascaded array, 2, 3 or 4 (default: all)", int, (2, 3, 4)),
}


class ImageStudy(Study):
    """Quality of a compressed image or material against bytes, seconds of training and time of a read."""

    name = "image"
    title = "a compressed image or material, in bytes, training and reads"
    example = "material.json"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument("source", metavar="IMAGE|MATERIAL.json")
        for option, (text, value_type, choices) in _REPEATED.items():
            parser.add_argument(option, action="append", default=[], type=value_type, choices=choices, metavar="N",
                                help=f"{text}; may be repeated")  # fmt: skip
        add_astc_option(parser)
        parser.add_argument("--ablation", action="store_true", help="also switch off each improvement of our preset")

    def check(self, arguments) -> None:
        """Check the options and load the source; raise as :func:`.load_source` does."""
        from ...core.units import parse_compression
        from ...maps.source import load_source

        arguments.compressions = tuple(map(parse_compression, arguments.compression)) or (12.0,)
        arguments.loaded = load_source(arguments.source)

    def plan(self, arguments) -> Plan:
        from .plan import ImageStudySettings, plan

        quick = arguments.quick
        seconds = tuple(map(float, arguments.seconds)) or (2.0 if quick else 60.0,)
        settings = ImageStudySettings(
            arguments.compressions[:1] if quick else arguments.compressions,
            seconds,
            tuple(map(float, arguments.paper_seconds)) or (max(seconds),),
            tuple(arguments.dims) or (2, 3, 4),
            arguments.ablation,
            "fast" if quick else arguments.astc,
            "fast" if quick else "medium",
        )
        return plan(arguments.loaded, arguments.source, settings)


STUDY = ImageStudy()
