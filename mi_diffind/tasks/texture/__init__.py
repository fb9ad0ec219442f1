"""
Task 4: textures and materials that are compressed and filtered in one, read at a place and a level of detail.

Sources, which of their channels are stored, and the truth, a mip pyramid: :mod:`mi_diffind.maps`.

- :mod:`.nets`: how arrays are read, the paper's layout and ours; :mod:`.arrays`: their initial values;
- :mod:`.memory_budget`: how large they are; :mod:`.sampling`: footprints, equations 3 to 9;
- :mod:`.presets`, :mod:`.training`, :mod:`.fit`: recipes, the problem, and what ``fit texture`` does;
- :mod:`.compressed`, :mod:`.model`: the result, as a texture and as a file.
"""

from __future__ import annotations

import argparse
import dataclasses

from ...arguments import Argument, positive
from ...maps.arguments import DECODED, SIZES, SOURCE, SOURCES
from ...task import Task
from .presets import PRESETS


def _structure(text: str) -> str:
    from .memory_budget import parse_structure

    try:
        if text not in ("auto", "pages"):
            parse_structure(text)
    except ValueError as e:
        raise argparse.ArgumentTypeError(str(e)) from None
    return text


def _whole(text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 3:
        raise argparse.ArgumentTypeError(f"found {text!r}, allowed are whole numbers from 0 on")
    return int(text)


class Texture(Task):
    """The task. Its presets are the recipes of :mod:`.presets`; files are always stored as bytes, or fewer bits."""

    name = "texture"
    title = "a texture or the maps of a material at every level of detail"
    files = "compressed"
    section = "supplemental 1.4"
    presets = {name: recipe.settings for name, recipe in PRESETS.items()}  # noqa: RUF012
    storages = ()
    arguments = (
        SOURCE,
        *(size for size in SIZES if size.name != "psnr"),
        Argument(
            "--structure", type=_structure, metavar="L:C:B,…",
            help="pages, or level, channels and bits of each fine array, as in 0:1:2,1:2:4 (default: auto)",
        ),
        Argument(
            "--skip", type=_whole, metavar="LEVEL",
            help="the level of detail from which on all have pointers of their own (default: chosen)",
        ),
        Argument(
            "--cascaded", type=positive, metavar="N", help="entries along each side of the cascaded array"
        ),
        Argument(
            "--footprint-samples", choices=["levels", "power", "exponential"],
            help="how levels of detail are drawn in training (default: levels for ours, power for paper)",
        ),
        Argument(
            "--axis", choices=["side", "area", "level"],
            help="what footprints of the preset paper measure (default: side)",
        ),
        *SOURCES,
    )  # fmt: skip
    decode_arguments = (
        *DECODED,
        Argument("--level", type=_whole, metavar="N", help="level of detail of a texture (default: 0, the source's)"),
    )

    def settings(self, preset, given, options):
        own = PRESETS[preset].settings
        steps = given.get("steps", own.steps)
        return dataclasses.replace(own, measure_every=max(1, steps // 10), **given)


TASK = Texture()
