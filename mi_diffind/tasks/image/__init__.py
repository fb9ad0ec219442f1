"""
Task 3: images and materials as one primary and one cascaded array.

Sources, and which of their channels are stored: :mod:`mi_diffind.maps`.

- :mod:`.arrays`: initial values; :mod:`.memory_budget`, :mod:`.search`: how large they are;
- :mod:`.presets`, :mod:`.training`, :mod:`.fit`: recipes, the problem, and what ``fit image`` does;
- :mod:`.compressed`, :mod:`.model`: the result, as an image and as a file.
"""

from __future__ import annotations

import dataclasses

from ...arguments import Argument, positive
from ...maps.arguments import DECODED, SIZES, SOURCE, SOURCES
from ...task import Task
from .presets import IMPROVEMENTS, PRESETS, STRUCTURES, without


class Image(Task):
    """The task. Its presets are the recipes of :mod:`.presets`; files are always stored as bytes, or fewer bits."""

    name = "image"
    title = "an image or the maps of a material"
    files = "compressed"
    section = "supplemental 1.3"
    presets = {name: recipe.settings for name, recipe in PRESETS.items()}  # noqa: RUF012
    storages = ()
    arguments = (
        SOURCE,
        *SIZES,
        Argument(
            "--ratio-search", action="store_true",
            help="find sides, bits and dimensions of the arrays by short trainings",
        ),
        Argument(
            "--without", action="append", default=[], choices=list(IMPROVEMENTS),
            help="switch one of the improvements of our recipe off; may be repeated",
        ),
        Argument(
            "--structure", choices=["auto", *STRUCTURES],
            help="bits of an entry of the primary array, or of two (default: auto for ours, 8 bits for paper)",
        ),
        Argument("--dims", type=positive, choices=range(1, 5), help="dimensions of the cascaded array"),
        Argument(
            "--cascaded", type=positive, metavar="N", help="entries along each side of the cascaded array"
        ),
        *SOURCES,
    )  # fmt: skip
    decode_arguments = DECODED

    def settings(self, preset, given, options):
        own = without(PRESETS[preset], options["without"]).settings
        steps = given.get("steps", own.steps)
        return dataclasses.replace(own, measure_every=max(1, steps // 10), **given)


TASK = Image()
