"""
Task 7: radiance fields, from images of a scene.

- :mod:`.views`: images and cameras; :mod:`.hull`: where something may be;
- :mod:`.field`, :mod:`.nodes`, :mod:`.march`: what fields offer, where their numbers lie, what rays see of them;
- :mod:`.target`, :mod:`.training`: the grid that is compressed, and training through images;
- :mod:`.coded`, :mod:`.palette`, :mod:`.compression`: ours; :mod:`.pairs`: the supplement's;
- :mod:`.presets`, :mod:`.fit`, :mod:`.files`, :mod:`.model`, :mod:`.decode`: how it is asked for, and the result.
"""

from __future__ import annotations

import dataclasses

from ... import units
from ...arguments import Argument, checked, decibels, positive
from ...task import Task
from .presets import PRESETS


class RadianceField(Task):
    """The task. Its presets are the recipes of :mod:`.presets`; files are always stored as bytes, but of ``grid``."""

    name = "field"
    title = "a radiance field, from images of a scene"
    section = "supplemental 1.7"
    presets = {name: recipe.settings for name, recipe in PRESETS.items()}  # noqa: RUF012
    storages = ()
    arguments = (
        Argument(
            "source", metavar="FOLDER", help="views (transforms_*.json): of mi-diffind capture, Blender or nerfstudio"
        ),
        Argument(
            "--bytes", group="size", type=checked(units.parse_bytes), metavar="N",
            help="size in memory, as in 512k or 1.5M",
        ),
        Argument(
            "--compression", group="size", type=checked(units.parse_compression), metavar="N",
            help="how many times smaller than the dense grid of float32 (default of paper: 50)",
        ),
        Argument(
            "--psnr", group="size", type=checked(decibels), metavar="N",
            help="the smallest of several sizes that reaches so many dB over white (several trainings)",
        ),
        Argument(
            "--resolution", type=positive, metavar="N",
            help="of the grid: nodes along the side of a cube of the same volume (default: 128)",
        ),
        Argument("--grid", metavar="FILE", help="the grid to compress; if there is no such file, it is written"),
    )  # fmt: skip
    decode_arguments = (
        Argument("--resolution", type=positive, metavar="N", help="nodes along the longest side (default: its own)"),
    )

    def settings(self, preset, given, options):
        own = self.presets[preset]
        steps = given.get("steps", own.steps)
        return dataclasses.replace(own, measure_every=max(1, steps // 2), **given)

    def allocate(self, table, dtype, storage=""):
        return {}

    def model(self, table, dtype, storage=""):
        return self.model_class()(table, {}, dtype, storage)


TASK = RadianceField()
