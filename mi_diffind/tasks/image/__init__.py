"""Task 3: images and materials as a primary array that points into a cascaded one.

Sources and stored channels are in :mod:`mi_diffind.maps`.

- :mod:`.arrays`: initial arrays; :mod:`.memory_budget`, :mod:`.search`: resolutions.
- :mod:`.weights`: weights of maps in the training.
- :mod:`.presets`, :mod:`.training`, :mod:`.fit`: recipes, the training problem, the command ``fit image``.
- :mod:`.compressed`: the result as an image, as a table file and as a model.
"""

from __future__ import annotations

import dataclasses

from ...core.arguments import Argument, between, checked, positive
from ...fitting.task import Task
from ...maps.arguments import DECODED, SIZES, SOURCE, SOURCES
from .presets import IMPROVEMENTS, PRESETS, STRUCTURES, parse_weights, without


class Image(Task):
    """Task of images; presets are the recipes of :mod:`.presets`, entries have 8 bits or fewer."""

    name = "image"
    title = "an image or the maps of a material"
    files = "compressed"
    section = "supplemental 1.3"
    example = "material.json --compression 12x"
    plugin = ("texture", "neural_image")
    presets = {name: recipe.settings for name, recipe in PRESETS.items()}  # noqa: RUF012
    storages = ()
    arguments = (
        SOURCE,
        *SIZES,
        Argument(
            "--ratio-search", action="store_true",
            help="choose sides, bits and dimensions of the arrays by short trainings",
        ),
        Argument(
            "--without", action="append", default=[], choices=list(IMPROVEMENTS),
            help="switch one of the improvements of our recipe off; may be repeated",
        ),
        Argument(
            "--structure", choices=["auto", *STRUCTURES],
            help="bits of an entry of one or two primary arrays, or pages (default: auto for ours, 8 bits for paper)",
        ),
        Argument("--dims", type=positive, choices=range(1, 5), help="dimensions of the cascaded array"),
        Argument(
            "--cascaded", type=positive, metavar="N", help="entries along each side of the cascaded array"
        ),
        Argument(
            "--ratio", type=between(1, 1024), metavar="N",
            help="for paper: side of the primary over side of the cascaded array (default: by size and compression)",
        ),
        Argument(
            "--weights", type=checked(parse_weights), metavar="equal|auto|MAP=W,…", default="equal",
            help="weight of each map's errors: equal (default), by what they do to a shaded picture (auto), or numbers",
        ),
        *SOURCES,
    )  # fmt: skip
    decode_arguments = DECODED

    def settings(self, preset, given, options):
        defaults = without(PRESETS[preset], options["without"]).settings
        steps = given.get("steps", defaults.steps)
        return dataclasses.replace(defaults, **{"measure_every": max(1, steps // 10), **given})


TASK = Image()
