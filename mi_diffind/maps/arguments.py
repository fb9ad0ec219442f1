"""The arguments of tasks that store maps: what is compressed, to which size, and what is decoded."""

from __future__ import annotations

from pathlib import Path

from .. import units
from ..arguments import Argument, checked, decibels, positive
from ..errors import UsageError
from .source import NONFINITE, Source

_SIZES = (
    ("compression", units.parse_compression, "how many times smaller than the source, uncompressed (default: 12x)"),
    ("bytes", units.parse_bytes, "size of the arrays, as in 256k or 1.5M"),
    ("bpp", units.parse_bpp, "bits a texel of the image, all channels together"),
    ("psnr", decibels, "the smallest file that reaches so many dB (several trainings)"),
)

SOURCE = Argument("source", metavar="IMAGE|MATERIAL.json", help="an image, or a manifest of the maps of a material")

#: The size of the arrays, in one way or another.
SIZES = tuple(
    Argument(f"--{name}", group="size", type=checked(kind), metavar="N", help=text) for name, kind, text in _SIZES
)

#: How a source is read.
SOURCES = (
    Argument(
        "--border", choices=["auto", "repeat", "clamp"], default="auto",
        help="does the image go on at its other side? (default: auto, along u and v each)",
    ),
    Argument(
        "--nonfinite", choices=NONFINITE, default="error",
        help="NaN and infinity in the source: refuse (default), or replace by 0 and the largest value",
    ),
)  # fmt: skip

#: Picture of a training that is written at each measurement.
PREVIEW = Argument(
    "--preview", metavar="FILE.png", help="write reference | render | 4x their difference at measurements"
)

#: What is decoded.
DECODED = (
    Argument("--map", action="append", metavar="NAME", help="only this map; may be repeated (default: all)"),
    Argument("--width", type=positive, help="width in texels (default: that of the source)"),
    Argument("--height", type=positive, help="height in texels (default: that of the source)"),
)


def asked_bytes(options, source: Source) -> int:
    """The bytes that the options (:data:`SIZES`) ask for; a twelfth of the source's by default. Raises UsageError."""
    given = {k: options[k] for k in ("compression", "bpp")} | {"nbytes": options["bytes"]}
    if not any(given.values()):
        given["compression"] = 12
    try:
        return units.parse_size(source.nbytes, source.texels, **given)
    except ValueError as e:
        raise UsageError(str(e)) from None


def preview_path(request) -> Path | None:
    """Return the file of :data:`PREVIEW`: the given one, or ``…_preview.png`` beside the output (``None`` without)."""
    if request.options["preview"] is not None:
        return Path(request.options["preview"])
    return None if request.output is None else request.output.with_name(f"{request.output.stem}_preview.png")
