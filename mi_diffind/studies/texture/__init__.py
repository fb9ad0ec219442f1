"""Study ``tradeoff texture``: error and time of renders with filtered, compressed textures against bitmaps.

A texture that filters itself is compared with supersampled bitmaps, uncompressed mip maps, and ASTC with mip maps and a
network in equal bytes: by the error against the time of a render, the error of each level of detail, and the flicker of
a moving camera. :mod:`.plan` describes the contenders.
"""

from __future__ import annotations

import argparse

from ...core.arguments import positive
from ...measure.study import Plan, Study
from ..maps import add_astc_option

#: Methods of the candidates.
METHODS = ("bitmap", "bitmap, multijittered", "mip maps, uncompressed", "ours", "paper's preset", "ASTC with mip maps",
           "network")  # fmt: skip


class TextureStudy(Study):
    """Error and time of renders with filtered, compressed textures against supersampled bitmaps."""

    name = "texture"
    title = "a texture that filters itself, in renders, levels and flicker"
    example = "material.json"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default="scenes/assets/tiles.json", metavar="IMAGE|MATERIAL.json",
            help="8-bit maps, one of which has colours (default: scenes/assets/tiles.json)",
        )  # fmt: skip
        parser.add_argument("--map", default="", metavar="NAME", help="the map that is rendered (default: the albedo)")
        parser.add_argument(
            "--compression", action="append", default=[], metavar="N",
            help="compression ratio; may be repeated (default: 12x, 3x, 6x and 24x; --quick: 12x); only the first is "
            "measured with all filters",
        )  # fmt: skip
        parser.add_argument(
            "--table", action="append", default=[], metavar="FILE.npz",
            help="use a trained table of the source (trained with --border repeat, as in the renders) in place of a "
            "training; may be repeated; nothing is trained unless --compression is given, too",
        )  # fmt: skip
        parser.add_argument("--seconds", type=positive, metavar="N",
                            help="seconds of each training (default: 60; --quick: 2)")  # fmt: skip
        add_astc_option(parser)
        parser.add_argument("--footprints", action="store_true",
                            help="also train with each distribution of footprints and draw both")  # fmt: skip
        parser.add_argument("--only", action="append", default=[], choices=METHODS, metavar="METHOD",
                            help=f"measure only one method ({'; '.join(METHODS)}); may be repeated")  # fmt: skip
        parser.add_argument("--frames", type=positive, metavar="N", help="frames of the zoom (default: 60; --quick: 6)")
        parser.add_argument("--width", type=positive, metavar="N",
                            help="width of the stills; the height is 2/3 (default: 480; --quick: 96)")  # fmt: skip

    def check(self, arguments) -> None:
        """Check the options and load the source and tables; raise as :func:`.load_source` does."""
        from ...core.units import parse_compression
        from ...maps.source import load_source
        from .plan import colour_map, tables_of

        default = () if arguments.table else (12.0,) if arguments.quick else (12.0, 3.0, 6.0, 24.0)
        arguments.compressions = tuple(map(parse_compression, arguments.compression)) or default
        arguments.loaded = load_source(arguments.source)
        arguments.map = colour_map(arguments.loaded, arguments.map)
        arguments.tables = tables_of(arguments.table, arguments.loaded)

    def plan(self, arguments) -> Plan:
        from .plan import TextureStudySettings, plan

        quick = arguments.quick
        width = arguments.width or (96 if quick else 480)
        settings = TextureStudySettings(
            arguments.map,
            arguments.compressions,
            float(arguments.seconds or (2 if quick else 60)),
            "fast" if quick else arguments.astc,
            "fast" if quick else "medium",
            (width, max(2, width * 2 // 3)),
            (max(2, width // 2), max(2, width // 3)),
            arguments.frames or (6 if quick else 60),
            64 if quick else 256,
            1 if quick else 4,
            arguments.footprints,
            **({"network_steps": 30} if quick else {}),
            only=tuple(arguments.only),
        )
        return plan(arguments.loaded, arguments.source, settings, arguments.tables)


STUDY = TextureStudy()
