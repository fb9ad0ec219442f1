"""
Task 3: images and materials as one primary and one cascaded array.

Sources, and which of their channels are stored: :mod:`mi_diffind.maps`.

- :mod:`.arrays`: initial values; :mod:`.sizing`, :mod:`.search`: how large they are;
- :mod:`.presets`, :mod:`.training`, :mod:`.fit`: recipes, the problem, and what ``fit image`` does;
- :mod:`.compressed`, :mod:`.model`: the result, as an image and as a file.
"""

from __future__ import annotations

import argparse
import dataclasses

from ... import sizes
from ...arguments import Argument, positive
from ...maps.source import NONFINITE
from ..task import Request, Task
from .presets import IMPROVEMENTS, PRESETS, STRUCTURES, without


def _checked(parse):
    """A parser of ours as a type of ``argparse``, which shows the message of its own exception only."""

    def parsed(text: str):
        try:
            parse(text)
        except ValueError as e:
            raise argparse.ArgumentTypeError(str(e)) from None
        return text

    return parsed


def _decibels(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 120:
        raise ValueError(f"{text!r} is no PSNR, allowed are numbers of dB between 0 and 120")
    return value


_SIZES = (
    ("compression", sizes.parse_compression, "how many times smaller than the source, uncompressed (default: 12x)"),
    ("bytes", sizes.parse_bytes, "size of the arrays, as in 256k or 1.5M"),
    ("bpp", sizes.parse_bpp, "bits a texel of the image, all channels together"),
    ("psnr", _decibels, "the smallest file that reaches so many dB (several trainings)"),
)


class Image(Task):
    """The task. Its presets are the recipes of :mod:`.presets`; files are always stored as bytes, or fewer bits."""

    name = "image"
    title = "an image or the maps of a material"
    section = "supplemental 1.3"
    presets = {name: recipe.settings for name, recipe in PRESETS.items()}  # noqa: RUF012
    storages = ()
    arguments = (
        Argument("source", metavar="IMAGE|MATERIAL.json", help="an image, or a manifest of the maps of a material"),
        *(
            Argument(f"--{name}", group="size", type=_checked(kind), metavar="N", help=text)
            for name, kind, text in _SIZES
        ),
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
        Argument(
            "--border", choices=["auto", "repeat", "clamp"], default="auto",
            help="does the image go on at its other side? (default: auto, along u and v each)",
        ),
        Argument(
            "--nonfinite", choices=NONFINITE, default="error",
            help="NaN and infinity in the source: refuse (default), or replace by 0 and the largest value",
        ),
    )  # fmt: skip
    decode_arguments = (
        Argument("--map", action="append", metavar="NAME", help="only this map; may be repeated (default: all)"),
        Argument("--width", type=positive, help="width in texels (default: that of the source)"),
        Argument("--height", type=positive, help="height in texels (default: that of the source)"),
    )

    def settings(self, preset, given, options):
        own = without(PRESETS[preset], options["without"]).settings
        steps = given.get("steps", own.steps)
        return dataclasses.replace(own, measure_every=max(1, steps // 10), **given)

    def check(self, request: Request) -> None:
        from .fit import check

        check(request)

    def fit(self, request: Request):
        from .fit import fit

        return fit(request)

    def load(self, path):
        from .compressed import load

        return load(path)

    def model_class(self):
        from .model import ImageModel

        return ImageModel

    def allocate(self, table, dtype, storage=""):
        from .compressed import allocate

        return allocate(table, dtype, storage)


TASK = Image()
