"""
``tradeoff texture``: a texture that filters itself beside supersampled bitmaps and uncompressed mip maps, and ASTC with
mip maps at equal bytes: error against the time of a render, error of each level of detail, flicker of a moving camera.
:mod:`.candidates` says more.
"""

from __future__ import annotations

import argparse

from ...arguments import positive
from ...measure.study import Plan, Study

ASTC_PRESETS = ("fastest", "fast", "medium", "thorough", "verythorough", "exhaustive")


class TextureStudy(Study):
    """Error and time of renders with filtered, compressed textures against supersampled bitmaps."""

    name = "texture"
    title = "a texture that filters itself, in renders, levels and flicker"

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "source", nargs="?", default="scenes/assets/tiles.json", metavar="IMAGE|MATERIAL.json",
            help="8-bit maps, one of which has colours (default: scenes/assets/tiles.json)",
        )  # fmt: skip
        parser.add_argument("--map", default="", metavar="NAME", help="the map that is rendered (default: the albedo)")
        parser.add_argument("--compression", action="append", default=[], metavar="N",
                            help="3x, 6x, 12x and 24x by default, the first that is named is shown most; may be "
                            "repeated (--quick: 12x)")  # fmt: skip
        parser.add_argument("--table", action="append", default=[], metavar="FILE.npz",
                            help="a table of the source that was trained already (with --border repeat, as renders "
                            "repeat it), in place of a training; may be repeated; nothing is trained unless "
                            "--compression is given, too")  # fmt: skip
        parser.add_argument("--seconds", type=positive, metavar="N",
                            help="of each training (default: 60; --quick: 2)")  # fmt: skip
        parser.add_argument("--astc", choices=ASTC_PRESETS, default="exhaustive",
                            help="preset of the ASTC encoder (default: exhaustive)")  # fmt: skip
        parser.add_argument(
            "--footprints",
            action="store_true",
            help="also train with each distribution of footprints, and draw levels beside them",
        )
        parser.add_argument("--frames", type=positive, metavar="N", help="of the zoom (default: 60; --quick: 6)")
        parser.add_argument("--width", type=positive, metavar="N",
                            help="of the stills, the height is two thirds (default: 480; --quick: 96)")  # fmt: skip

    def check(self, arguments) -> None:
        """Also reads the source, before anything is made of it; raises what :func:`.load_source` does."""
        from ...maps.source import load_source
        from ...units import parse_compression
        from .plan import colour_map, tables_of

        given = tuple(map(parse_compression, arguments.compression))
        default = () if arguments.table else (12.0,) if arguments.quick else (12.0, 3.0, 6.0, 24.0)
        arguments.compressions = given or default
        arguments.loaded = load_source(arguments.source)
        arguments.map = colour_map(arguments.loaded, arguments.map)
        arguments.tables = tables_of(arguments.table, arguments.loaded)

    def plan(self, arguments) -> Plan:
        from .plan import Request, plan

        quick = arguments.quick
        width = arguments.width or (96 if quick else 480)
        request = Request(
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
        )
        return plan(arguments.loaded, arguments.source, request, arguments.tables)


STUDY = TextureStudy()
